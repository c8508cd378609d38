"""Growth of column generation's work from one refinement of a model to the next."""

from collections.abc import Sequence
from dataclasses import dataclass

from examples.solver_comparison.instances.instance import parse_instance
from examples.solver_comparison.reporting.results import Outcome, SolverRun


@dataclass(frozen=True)
class Work:
    """Work of column generation on one member of a family.

    A sweep is one pass over all transitions. A product with the transitions of one policy reads
    the rows of one pair per state, and counts as that share of a sweep.
    """

    instance: str
    group: str
    transitions: int
    backups: int
    products: int
    sweeps: float
    seconds: float

    @property
    def per_transition(self) -> float:
        """Seconds per sweep and transition."""
        return self.seconds / (self.sweeps * self.transitions)


def work_of(run: SolverRun) -> Work | None:
    """Return the work of a solved run; None if it is not reported, or no sweep was needed."""
    if run.outcome is not Outcome.SOLVED or not (run.backups or run.products):
        return None
    if not (run.seconds and run.transitions and run.pairs and run.states):
        return None
    products = run.products or 0
    return Work(
        instance=run.instance,
        group=parse_instance(run.instance).group,
        transitions=run.transitions,
        backups=run.backups or 0,
        products=products,
        sweeps=(run.backups or 0) + products * run.states / run.pairs,
        seconds=run.seconds,
    )


def growth_text(runs: Sequence[SolverRun], solver: str = "columns") -> str:
    """Return sweeps and seconds per sweep and transition, with their growth; "" without any."""
    counted = map(work_of, (run for run in runs if run.solver == solver))
    works = [work for work in counted if work is not None]
    if not works:
        return ""
    head = f"{'instance':<18}{'backups':>9}{'products':>10}{'sweeps':>9}{'growth':>8}"
    lines = [f"{head}{'ns per sweep and transition':>30}{'growth':>8}"]
    previous: dict[str, Work] = {}
    for work in sorted(works, key=lambda w: (w.group, w.transitions)):
        before = previous.get(work.group)
        sweeps = f"{work.sweeps / before.sweeps:.2f}" if before else "-"
        speed = f"{work.per_transition / before.per_transition:.2f}" if before else "-"
        lines.append(
            f"{work.instance:<18}{work.backups:>9,}{work.products:>10,}{work.sweeps:>9,.0f}"
            f"{sweeps:>8}{1e9 * work.per_transition:>30.3f}{speed:>8}"
        )
        previous[work.group] = work
    return "\n".join(lines)
