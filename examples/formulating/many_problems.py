"""Many problems in parallel: failure budgets from the least to 60 % on five robots.

All processes share the memory of the five models; a problem takes some two hundred bytes.

    python examples/formulating/many_problems.py --budgets 200 --workers 0 1 2

solves a thousand problems, first in this process (0), then by one and by two others; takes a
minute.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterable, Sequence
from time import perf_counter

import numpy as np

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from ssp_lp import S3P, MaxProb, Solution, SSPError, solve, solve_many, sweep
from ssp_lp.formulation import Problem

SEGMENTS = (5, 6, 7, 8, 9)
"""Numbers of cells along each side of the robots' grids."""


def questions(budgets: int, segments: Iterable[int] = SEGMENTS) -> list[Problem]:
    """Return S3P of each robot for a number of failure budgets."""
    asked: list[Problem] = []
    for one in segments:
        grid = RobotGrid(segments=one, headings=6, quadrature=2)
        model, start = grid_model(grid), start_state(grid)
        least = 1.0 - solve(MaxProb(model, start)).objective
        asked += sweep(S3P, model, start, failure_budget=np.linspace(least + 1e-3, 0.6, budgets))
    return asked


def report(asked: Sequence[Problem], workers: Sequence[int]) -> None:
    """Print a line for each number of processes: seconds, questions a second, costs."""
    print(f"{'processes':>9} {'questions':>9} {'seconds':>8} {'a second':>8} {'mean cost':>10}")
    for count in workers:
        began = perf_counter()
        answers: Iterable[Solution | SSPError]
        answers = solve_many(asked, workers=count) if count else [*map(solve, asked)]
        took = perf_counter() - began
        mean = np.mean([one.objective for one in answers if isinstance(one, Solution)])
        print(f"{count:9} {len(asked):9,} {took:8.1f} {len(asked) / took:8.1f} {mean:10.6f}")


def main() -> None:
    """Solve the problems and print the table."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--budgets", type=int, default=20, metavar="N", help="for each robot; 20")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 2], metavar="N", help="0 2")
    given = parser.parse_args()
    report(questions(given.budgets), given.workers)


if __name__ == "__main__":
    main()
