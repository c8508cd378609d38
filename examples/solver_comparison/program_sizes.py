"""Seconds of occupation programs by size: built, compiled by cvxpy, written as MPS.

    python examples/solver_comparison/program_sizes.py --pairs 10000 100000 1000000

Seconds of one core: `MCMP` within a failure budget on a windy grid with about the given number of
pairs, and `S3P` on a river with a hundred distinguished accumulated costs and as many columns.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cvxpy as cp

from examples.solver_comparison.instances.families import FAMILIES
from ssp_lp import MCMP, S3P
from ssp_lp.problem import Problem

TOTALS = 100
BUDGET = 0.9  # of failing; nothing has to be worked out for it


def seconds_of(call: Callable[[], Any]) -> tuple[float, Any]:
    """Return the processor's seconds of a call, and its result."""
    began = time.process_time()
    result = call()
    return time.process_time() - began, result


def problems(pairs: int) -> list[tuple[str, Problem]]:
    """Yield the problems of one size, by name."""
    grid = FAMILIES["grid"](round((pairs / 4) ** 0.5))
    river = FAMILIES["river"](*2 * (max(round((pairs / TOTALS / 4) ** 0.5), 3),))
    return [
        ("MCMP", MCMP(grid, 0, BUDGET, give_up="dead_ends")),
        (f"S3P, {TOTALS} totals", S3P(river, 0, BUDGET, cost_cap=float(TOTALS))),
    ]


def measured(problem: Problem, compiles: bool) -> tuple[int, list[float]]:
    """Return the columns of a program, and seconds: built, compiled (nan if not), written."""
    made, program = seconds_of(problem.program)
    compiled = float("nan")
    if compiles:
        compiled, _ = seconds_of(lambda: program.to_cvxpy().problem.get_problem_data(cp.CLARABEL))
    with tempfile.TemporaryDirectory() as folder:
        written, _ = seconds_of(lambda: program.write(Path(folder) / "program.mps"))
    return program.process.n_pairs, [made, compiled, written]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each problem."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", nargs="+", type=int, default=[10_000, 100_000])
    parser.add_argument("--most-compiled", type=int, default=1_000_000, help="pairs, by cvxpy")
    options = parser.parse_args(arguments)
    measured(problems(100)[0][1], compiles=True)  # imports
    print(f"{'problem':<16} {'columns':>10} {'made':>8} {'cvxpy':>8} {'MPS':>8}")
    for pairs in options.pairs:
        for name, problem in problems(pairs):
            columns, times = measured(problem, pairs <= options.most_compiled)
            print(f"{name:<16} {columns:>10,}" + "".join(f" {t:8.3g}" for t in times), flush=True)


if __name__ == "__main__":
    main()
