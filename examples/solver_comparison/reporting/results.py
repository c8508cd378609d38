"""The result of one run of one solver on one instance: a row of the comparison."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from enum import StrEnum
from typing import Any

REFERENCE = "columns"
_AGREEMENT = 1e-4  # relative; every solver is asked for more


class Outcome(StrEnum):
    """The end of a run."""

    SOLVED = "solved"
    TIME_OUT = "time-out"
    OUT_OF_MEMORY = "out of memory"
    FAILED = "failed"
    WRONG = "wrong"
    NOT_INSTALLED = "not installed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class SolverRun:
    """A row of the comparison; figures that a run did not reach are None."""

    instance: str
    solver: str
    outcome: Outcome
    time_limit: float  # seconds that the call was allowed
    states: int | None = None
    pairs: int | None = None
    transitions: int | None = None
    seconds: float | None = None  # of the call on the ready model: the least of `calls`
    calls: int = 0
    import_seconds: float | None = None
    model_seconds: float | None = None  # building the model
    convert_seconds: float | None = None  # writing it out in the solver's own form
    warm_up_seconds: float | None = None  # a first call, where something compiles on first use
    objective: float | None = None
    gap: float | None = None  # relative; ours is certified, that of an LP is its own
    excess: float | None = None  # max(failure - budget, 0)
    ready_memory: int | None = None  # bytes held before the first call
    peak_memory: int | None = None  # bytes, of the whole process
    backups: int | None = None  # Bellman sweeps over all pairs
    products: int | None = None  # products with the transitions of one policy
    note: str = ""  # in the table
    details: str = ""  # not in the table

    @property
    def build_seconds(self) -> float | None:
        """Seconds of the preparation: building the model in the solver's form."""
        parts = [s for s in (self.model_seconds, self.convert_seconds) if s is not None]
        return sum(parts) if parts else None

    @property
    def over_limit(self) -> bool:
        """Whether time or memory ran out."""
        return self.outcome in (Outcome.TIME_OUT, Outcome.OUT_OF_MEMORY)


def run_to_json(run: SolverRun) -> dict[str, Any]:
    """Return a run as a JSON object."""
    return asdict(run)


def run_from_json(entry: dict[str, Any]) -> SolverRun:
    """Return the run that a JSON object describes; unknown entries are ignored."""
    known = {field.name for field in fields(SolverRun)}
    kept = {name: value for name, value in entry.items() if name in known}
    return SolverRun(**{**kept, "outcome": Outcome(entry["outcome"])})


def reference_runs(runs: Iterable[SolverRun]) -> dict[str, SolverRun]:
    """Return the run of column generation on each instance that it solved."""
    return {
        run.instance: run
        for run in runs
        if run.solver == REFERENCE and run.outcome is Outcome.SOLVED
    }


def completed(runs: Sequence[SolverRun]) -> list[SolverRun]:
    """Return the runs, with missing sizes of the model taken from other runs on the instance."""
    known = {run.instance: run for run in runs if run.transitions is not None}
    return [_sized(run, known.get(run.instance, run)) for run in runs]


def _sized(run: SolverRun, other: SolverRun) -> SolverRun:
    return replace(run, states=other.states, pairs=other.pairs, transitions=other.transitions)


def judged(runs: Sequence[SolverRun]) -> list[SolverRun]:
    """Return the runs, marked as wrong if the objective is far from the certified one."""
    certified = {name: run.objective for name, run in reference_runs(runs).items()}
    return [_judge(run, certified.get(run.instance)) for run in runs]


def _judge(run: SolverRun, certified: float | None) -> SolverRun:
    if run.outcome is not Outcome.SOLVED or run.objective is None or certified is None:
        return run
    off = abs(run.objective - certified) / max(abs(certified), 1e-300)
    if off <= _AGREEMENT:
        return run
    note = f"off the certified value by {off:.1g}"
    return replace(run, outcome=Outcome.WRONG, note="; ".join(n for n in (note, run.note) if n))
