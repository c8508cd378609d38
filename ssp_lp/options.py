"""Methods of solution, which are values, and the options that go with every one of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import ClassVar

from ssp_lp.arrays import RELATIVE_GAP
from ssp_lp.errors import ModelError

BACKENDS = ("highs", "highs-simplex", "highs-ipx", "highs-warm", "clarabel", "cvxpy")
"""Solvers of linear programs."""

Progress = Callable[[int, float, float], None]
"""Called after each pricing call with (calls, failure price, objective)."""


@dataclass(frozen=True)
class ColumnGeneration:
    """Policies priced one by one into a small master program; what is chosen unless asked."""

    name: ClassVar[str] = "columns"


@dataclass(frozen=True)
class LinearProgramming:
    """The full linear program, whose duals then price the policies of the answer.

    Args:
        backend: "highs", "highs-simplex", "highs-ipx", "clarabel" or "cvxpy"; None: chosen by the
            size of the program. "highs-warm" is a check of optimality by HiGHS's simplex method,
            started at column generation's policies, not a cold solve; ``run.program`` tells how
            many iterations it took from there.

    Raises:
        ModelError: an unknown backend.
    """

    backend: str | None = None

    name: ClassVar[str] = "lp"

    def __post_init__(self) -> None:
        if self.backend is not None and self.backend not in BACKENDS:
            known = ", ".join(BACKENDS)
            raise ModelError(f"backend must be one of {known}, not {self.backend!r}")


@dataclass(frozen=True)
class Game:
    """The paper's value iteration and zero-sum game (section 3.5).

    It needs a discount and a budget above 0.
    """

    name: ClassVar[str] = "game"


@dataclass(frozen=True)
class DeterministicPolicies:
    """The best single policy that never tosses a coin, by mixed-integer programs.

    Stationary in the model's states; in case S in (state, accumulated cost).

    Args:
        relaxation: what finds the best lottery, with which the search begins.
    """

    relaxation: ColumnGeneration | LinearProgramming = field(default_factory=ColumnGeneration)

    name: ClassVar[str] = "deterministic"


Method = ColumnGeneration | LinearProgramming | Game | DeterministicPolicies

_BY_NAME: dict[str, Method] = {
    method.name: method
    for method in (ColumnGeneration(), LinearProgramming(), Game(), DeterministicPolicies())
}


def parse_method(method: Method | str | None) -> Method:
    """A method, by itself or by its name; None: column generation.

    Raises:
        ModelError: it is neither.
    """
    if method is None:
        return ColumnGeneration()
    if isinstance(method, Method):
        return method
    if isinstance(method, str) and method in _BY_NAME:
        return _BY_NAME[method]
    known = ", ".join(repr(name) for name in _BY_NAME)
    raise ModelError(f"method must be one of {known}, or a value such as LinearProgramming(), not "
                     f"{method!r}")  # fmt: skip


@dataclass(frozen=True)
class SolveOptions:
    """How exactly to search, by what, and for how long."""

    tolerance: float = RELATIVE_GAP
    deadline: float = float("inf")  # on the clock of time.perf_counter
    progress: Progress | None = None
    program: LinearProgramming | None = None  # solve the full linear program first

    @property
    def method(self) -> str:
        """The name of the method."""
        return ColumnGeneration.name if self.program is None else self.program.name

    def after(self, calls: int) -> SolveOptions:
        """The same, where so many pricing calls have been made before."""
        progress = self.progress
        if progress is None:
            return self
        return replace(self, progress=lambda more, *rest: progress(calls + more, *rest))


CERTIFYING = SolveOptions()
"""The options of a certificate that has to search for its bound."""


def options_of(
    method: Method,
    tolerance: float,
    began: float,
    time_limit: float | None,
    progress: Progress | None,
) -> SolveOptions:
    """Check tolerance and time limit.

    Args:
        method: says whether the full linear program is solved first.
        tolerance: relative gap to reach.
        began: on the clock of ``time.perf_counter``.
        time_limit: seconds from then.
        progress: see ``Progress``.

    Raises:
        ModelError: a tolerance outside (0, 1), or a time limit that is no number of seconds.
    """
    if not 0.0 < tolerance < 1.0:
        raise ModelError(f"tolerance must lie strictly between 0 and 1, not {tolerance!r}")
    if time_limit is not None and not (isinstance(time_limit, Real) and time_limit >= 0.0):
        raise ModelError(f"time_limit must be a number of seconds or None, not {time_limit!r}")
    deadline = float("inf") if time_limit is None else began + float(time_limit)
    asked = method.relaxation if isinstance(method, DeterministicPolicies) else method
    program = asked if isinstance(asked, LinearProgramming) else None
    return SolveOptions(tolerance, deadline, progress, program)
