"""Results of a solver's module for the process that times it."""

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Answer:
    """The result of one call of a solver."""

    objective: float
    gap: float | None = None  # relative
    note: str = ""
    details: str = ""
    unsolved: str = ""  # why this is no solution; empty for a solution
    in_time: bool = True
    backups: int | None = None
    products: int | None = None
    excess: Callable[[], float] | None = None  # max(failure - budget, 0); not timed


@dataclass(frozen=True)
class Prepared:
    """An instance in a solver's own form: `call` is what is timed."""

    call: Callable[[], Answer]
    warm_up: Callable[[], object] | None = None  # where something compiles on first use
    note: str = ""
    details: str = ""


def infeasible(case: str) -> Answer:
    """Return the answer that no policy satisfies an instance's case."""
    what = "reaches the goal surely" if case == "C" else "satisfies the failure budget"
    return Answer(math.inf, note=f"no policy {what}")


def joined(*words: str) -> str:
    """Return words in one line, without the empty ones."""
    return "; ".join(w for w in words if w)
