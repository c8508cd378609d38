"""A sweep of a bound: one program within many failure budgets.

Least cost: budgets are parameters of cvxpy, and `convex.solve(failure=...)` does not compile again.
Cost given success: `program.bounded_by` recomputes the accumulated costs that another budget must
distinguish. Both follow the frontier of a river, which `trace_frontier` computes directly, and one
more unit of the bound saves the frontier's slope.

    python examples/formulating/sweep.py
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator

import cvxpy as cp

from examples.domains.domain import Domain
from examples.domains.river import river
from ssp_lp import MCMP, S3P, trace_frontier
from ssp_lp.programs.occupation_measure import OccupationMeasure

BUDGETS = (0.2, 0.05, 0.3, 0.5, 0.15)
"""Not in order, as a program does not depend on the bound before."""


def crossing() -> Domain:
    """Return the river and the start on its bank."""
    return river(6, 5, current=0.2)


def least_cost() -> Iterator[tuple[float, OccupationMeasure, float]]:
    """Yield each budget with the least cost within it, and the frontier's cost."""
    problem = MCMP(*crossing(), failure_budget=BUDGETS[0], give_up="dead_ends")
    convex, frontier = problem.program().to_cvxpy(), trace_frontier(problem)
    for budget in BUDGETS:
        yield budget, convex.solve(cp.CLARABEL, failure=budget), frontier.objective_at(budget)


def cost_given_success() -> Iterator[tuple[float, OccupationMeasure, float]]:
    """Yield each budget with the least cost given success, and the frontier's cost."""
    problem = S3P(*crossing(), failure_budget=BUDGETS[0])
    program, frontier = problem.program(), trace_frontier(problem)
    for budget in BUDGETS:
        measure = program.bounded_by({"failure": budget}).solve()
        yield budget, measure, frontier.objective_at(budget)


def main() -> None:
    """Print both sweeps."""
    for what, sweep in (("least cost", least_cost()), ("given success", cost_given_success())):
        print(f"{what:13} {'budget':>6} {'program':>11} {'frontier':>11} {'saved by more':>14}"
              f" {'columns':>8}")  # fmt: skip
        for budget, measure, known in sweep:
            columns = measure.program.process.n_pairs
            print(f"{'':13} {budget:6.2f} {measure.objective:11.7f} {known:11.7f}"
                  f" {measure.duals['failure']:14.6f} {columns:8,}")  # fmt: skip


if __name__ == "__main__":
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    main()
