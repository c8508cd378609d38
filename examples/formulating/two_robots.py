"""Two robots with one budget: two programs in one problem of cvxpy.

One robot crosses a long river and another a slow one, and the expected number of lost robots is
limited. The problem divides the budget so that the price of failure is equal for both. Merging the
segments of their two frontiers, the steepest first, gives the same division.

    python examples/formulating/two_robots.py
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from dataclasses import replace

import cvxpy as cp
import numpy as np

from examples.domains.river import river
from ssp_lp import MCMP, Frontier, evaluate, failure_probability, solve, trace_frontier
from ssp_lp.programs.occupation_measure import OccupationMeasure

BUDGETS = (0.05, 0.1, 0.2, 0.4)


def robots() -> tuple[MCMP, MCMP]:
    """State each robot's problem, without a limit on its own failure."""
    long, slow = river(5, 8), river(6, 5, current=0.2)
    return MCMP(*long, 1.0, give_up="dead_ends"), MCMP(*slow, 1.0, give_up="dead_ends")


def shared(
    problems: tuple[MCMP, MCMP], budget: float
) -> tuple[OccupationMeasure, OccupationMeasure, float]:
    """Return the measures of both within one budget, and the budget's price."""
    both = [problem.program().to_cvxpy() for problem in problems]
    lost = sum(robot.expression(failure_probability()) for robot in both) <= budget
    rows = [row for robot in both for row in robot.constraints.values()]
    cost = sum(robot.objective for robot in both)
    cp.Problem(cp.Minimize(cost), [*rows, lost]).solve(cp.CLARABEL)
    first, second = (robot.measure() for robot in both)
    return first, second, float(lost.dual_value)


def merged(frontiers: tuple[Frontier, Frontier], budget: float) -> float:
    """Return the least cost of both by their frontiers, taking the steepest segments first."""
    lost, cost = (sum(getattr(f, what)[0] for f in frontiers) for what in ("failure", "cost"))
    widths = np.concatenate([np.diff(f.failure) for f in frontiers])
    prices = np.concatenate([-np.diff(f.cost) / np.diff(f.failure) for f in frontiers])
    for k in np.argsort(-prices):
        bought = min(widths[k], budget - lost)
        lost, cost = lost + bought, cost - bought * prices[k]
    return float(cost)


def main() -> None:
    """Print the division of each budget, and the cost of equal halves."""
    problems = robots()
    frontiers = trace_frontier(problems[0]), trace_frontier(problems[1])
    print(f"{'budget':>6} {'long':>8} {'slow':>8} {'cost':>10} {'frontiers':>10} {'halves':>9}"
          f" {'price':>8}")  # fmt: skip
    for budget in BUDGETS:
        first, second, price = shared(problems, budget)
        played = [
            evaluate(measure.randomised_policy(), problem)
            for measure, problem in zip((first, second), problems, strict=True)
        ]
        cost = sum(each.objective for each in played)
        halves = sum(solve(replace(p, failure_budget=budget / 2.0)).objective for p in problems)
        print(f"{budget:6.2f} {played[0].failure_probability:8.5f}"
              f" {played[1].failure_probability:8.5f} {cost:10.6f}"
              f" {merged(frontiers, budget):10.6f} {halves:9.5f} {price:8.4f}")  # fmt: skip


if __name__ == "__main__":
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    main()
