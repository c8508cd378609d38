"""Rows of your own: additional constraints on how a river is crossed.

A river is crossed to the far foot of a waterfall, by the bridge or by swimming, which fails if the
current carries the swimmer over the edge. With the least cost in a failure budget, failing happens
where it is cheapest: from the bank, on purpose. Rows that no criterion has are added one after
another: no jumps, a limit on failure per stroke, few strokes, few visits of one cell, and a convex
row that spreads the strokes over the water.

    python examples/formulating/rows_of_ones_own.py
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Hashable, Iterator
from typing import Any

import cvxpy as cp

from examples.domains.river import Cell, river
from ssp_lp import MCMP, evaluate, failure_probability
from ssp_lp.programs.occupation_measure import OccupationMeasure

WIDTH, HEIGHT, BUDGET = 5, 5, 0.3
WATER: list[Cell] = [(x, y) for x in range(1, WIDTH - 1) for y in range(1, HEIGHT - 1)]
MIDDLE: Hashable = (2, 2)

PER_STROKE, STROKES, PASSES, SPREAD = 0.1, 2.5, 0.2, 0.8
"""Bounds of the rows."""


def crossing() -> MCMP:
    """State the crossing; a policy may give up only at the waterfall."""
    model, start = river(WIDTH, HEIGHT)
    return MCMP(model, start, failure_budget=BUDGET, give_up="dead_ends")


def rows(convex: Any) -> Iterator[tuple[str, Any]]:
    """Yield the rows by name, stated on a program in cvxpy."""
    strokes = [convex.visits(cell) for cell in WATER]
    edge = [(x, 1) for x in range(WIDTH - 1)]
    yield "jumps", cp.sum([convex.visits(cell, "down") for cell in edge]) <= 0.0
    yield "rate", convex.expression(failure_probability()) <= PER_STROKE * cp.sum(strokes)
    yield "strokes", cp.sum(strokes) <= STROKES
    yield "middle", convex.visits(MIDDLE) <= PASSES
    yield "spread", cp.norm(cp.hstack(strokes)) <= SPREAD


def crossings(problem: MCMP) -> dict[str, OccupationMeasure]:
    """Find the optimum without additional rows, and with one row more each time, by its name."""
    program = problem.program()
    convex, found = program.to_cvxpy(), {"none": program.solve()}
    for name, row in rows(convex):
        convex.constraints[name] = row
        found[name] = convex.solve(cp.CLARABEL)
    return found


def main() -> None:
    """Print the effect of each further row on cost, failure and strokes, and its price."""
    problem = crossing()
    print(f"{'row':>8} {'cost':>9} {'failure':>9} {'strokes':>9} {'price':>9}  as it is played")
    for name, measure in crossings(problem).items():
        strokes = sum(measure.program.visits(cell) @ measure.visits for cell in WATER)
        price = f"{measure.duals[name]:9.4f}" if name in measure.duals else f"{'':9}"
        played = evaluate(measure.randomised_policy(), problem)
        print(f"{name:>8} {measure.objective:9.5f} {measure.activity['failure']:9.5f}"
              f" {strokes:9.5f} {price}  {played.objective:.5f}"
              f" {played.failure_probability:.5f}")  # fmt: skip


if __name__ == "__main__":
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    main()
