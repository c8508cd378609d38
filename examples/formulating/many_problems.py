"""Many questions at once: failure budgets from the least to 60 % on five robots, side by side.

Each process maps the same five models into its memory; a question takes some two hundred bytes.

    python examples/formulating/many_problems.py --budgets 200 --workers 0 1 2

asks a thousand, first in a loop of this process (0), then of one and of two; takes a minute.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterable, Sequence
from time import perf_counter

import numpy as np

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from ssp_lp import S3P, MaxProb, Solution, SSPError, solve, solve_many, sweep
from ssp_lp.formulation import Problem

SEGMENTS = (5, 6, 7, 8, 9)
"""Of the grids along which the robots move, to a side."""


def questions(budgets: int, segments: Iterable[int] = SEGMENTS) -> list[Problem]:
    """The least cost given success of each robot within so many failure budgets."""
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
    """Ask and print."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--budgets", type=int, default=20, metavar="N", help="for each robot; 20")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 2], metavar="N", help="0 2")
    given = parser.parse_args()
    report(questions(given.budgets), given.workers)


if __name__ == "__main__":
    main()
