"""A windy field with holes, crossed in eight directions, with costs without a common unit.

    row size - 1   . . . . G
                   . o . . .    o a hole, which is never left
                   . . . o .
    row 0          S . . . .

Each step leads to its aim with probability 0.8 and is blown one cell further to the right or one
down with 0.1 each; the edge of the field stops it. A step along an axis costs 1 and a diagonal one
`diagonal`, or every pair of cell and direction has a cost drawn from a list of prices.
"""

from collections.abc import Sequence
from random import Random

from examples.domains.domain import Domain
from examples.domains.outcomes import Outcomes
from examples.domains.parameters import Number, check_cost, check_count
from ssp_lp import SSP

Cell = tuple[int, int]
"""(column, row), both from 0."""

DIRECTIONS: dict[str, Cell] = {
    "right": (1, 0), "up": (0, 1), "left": (-1, 0), "down": (0, -1),
    "right up": (1, 1), "right down": (1, -1), "left up": (-1, 1), "left down": (-1, -1),
}  # fmt: skip

_WIND: tuple[tuple[float, Cell], ...] = ((0.8, (0, 0)), (0.1, (1, 0)), (0.1, (0, -1)))
_HOLES = 0.1  # share of the cells


def windy_field(
    size: int, *, diagonal: Number = 2**0.5, prices: Sequence[Number] = (), seed: int = 0
) -> Domain:
    """Return the field as an SSP whose states are cells, and its start.

    Args:
        size: columns and rows; at least 2.
        diagonal: cost of a diagonal step.
        prices: costs of steps, drawn for every cell and direction; empty: costs by length.
        seed: seed of the holes and of the prices drawn.

    Raises:
        ModelError: naming the parameter at fault.
    """
    check_count("size", size, 2)
    check_cost("diagonal", diagonal)
    for number, price in enumerate(prices):
        check_cost(f"prices[{number}]", price)
    rng, goal = Random(seed), (size - 1, size - 1)
    cells = [(column, row) for column in range(size) for row in range(size)]
    holes = {cell for cell in cells if rng.random() < _HOLES} - {(0, 0), goal}
    transitions: dict[Cell, dict[str, Outcomes]] = {hole: {} for hole in holes}
    for cell in cells:
        if cell == goal or cell in holes:
            continue
        steps = transitions[cell] = {}
        for name, (right, up) in DIRECTIONS.items():
            by_length = diagonal if right and up else 1
            cost = rng.choice(prices) if prices else by_length
            steps[name] = [
                (chance, _stopped(cell, (right + east, up + north), size), cost)
                for chance, (east, north) in _WIND
            ]
    model = SSP.from_transitions(transitions, goal={goal}, treat_actionless_as_dead_ends=True)
    return Domain(model, (0, 0))


def _stopped(cell: Cell, move: Cell, size: int) -> Cell:
    """Return the cell that a move leads to, stopped at the edge."""
    column, row = (
        min(max(here + step, 0), size - 1) for here, step in zip(cell, move, strict=True)
    )
    return column, row
