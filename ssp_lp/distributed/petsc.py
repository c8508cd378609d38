"""Pricing on PETSc of a model that every rank has: what ``ColumnGeneration(pricing=)`` takes.

Every rank asks for the same solution, as in any program under ``mpiexec``. The first one searches,
as one process does: price rules, master, refinement, proofs, the clock and Ctrl-C are its alone, so
that ranks cannot disagree. The others hold the rows of their own states and do what the first asks
for: the equations of a policy, solved by BiCGStab on a matrix of PETSc's whose rows are partitioned
by state, and Bellman backups of their states. What the equations are solved to is verified as ever
(``dynamic_programming.evaluation``), and so are bounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from ssp_lp.cargo import Cargo, models_of
from ssp_lp.column_generation.explicit_pricing import ExplicitPricing
from ssp_lp.distributed.dynamics import PartitionedDynamics
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.errors import ModelError
from ssp_lp.options import Partition, SolveOptions
from ssp_lp.problem import Problem
from ssp_lp.solution import Solution


@dataclass(frozen=True)
class Petsc:
    """Pricing within a failure budget, with any limits, by the ranks of PETSc.

    ``solve(problem, method=ColumnGeneration(pricing=Petsc()))`` asks for it. Under ``mpiexec -n 4
    python plan.py`` every rank states the same problem and gets the same solution, on its own
    model; without ``mpiexec`` there is one rank. It needs petsc4py and mpi4py. The equations of
    policies, and backups, are shared; the model is held by every rank, and the search on it by the
    first. :class:`PartitionedModel` is for models that no rank holds.
    """

    def on_every_rank(
        self, problem: Problem, options: SolveOptions, solved: Callable[[Partition], Solution]
    ) -> Solution:
        """The solution of a problem, on every rank of PETSc that asks for it.

        Args:
            problem: the same on every rank.
            options: tolerance and limits.
            solved: finds the solution, given what shares the pricing; called on the first rank.

        Raises:
            ModelError: the ranks do not ask for the same.
            SSPError: what the first rank raised, on every rank.
            MissingDependencyError: petsc4py or mpi4py is not installed.
        """
        ranks, cargo = Ranks.all(), Cargo()
        for place, model in enumerate(models_of([problem])):
            cargo.know(place, model)
        asked = ranks.comm.allgather(repr(problem))
        if len(set(asked)) > 1:
            raise ModelError(f"all ranks of PETSc must ask for the same, not {' and '.join(asked)}")
        if problem.requirements.counts_totals:
            return _solved_in_parts(problem, options)
        known: dict[int, tuple[object, PartitionedDynamics]] = {}

        def partition(pricing: ExplicitPricing) -> PartitionedDynamics:
            """The dynamics of a pricing problem, whose rows the ranks share."""
            whole = pricing.process.dynamics
            if id(whole) not in known:  # kept with it, for it is known by its identity
                known[id(whole)] = whole, PartitionedDynamics.handed_out(ranks, pricing)
            return known[id(whole)][1]

        return ranks.answered(cargo, lambda: solved(partition))


def _solved_in_parts(problem: Any, options: SolveOptions) -> Solution:
    """The solution on PETSc where the total cost counts: each rank takes its states' layers."""
    from ssp_lp.distributed.partitioned_model import PartitionedModel  # which names this method

    left = options.deadline - time.perf_counter()
    model = PartitionedModel.from_model(problem.model)
    asked = {one.name: getattr(problem, one.name) for one in fields(problem) if one.init}
    answer = model.solve(
        type(problem),
        tolerance=options.tolerance,
        time_limit=left if left < float("inf") else None,
        progress=options.progress,
        **{name: value for name, value in asked.items() if name != "model"},
    )
    return answer.on(problem)
