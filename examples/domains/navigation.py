"""Navigation: cross a field in which the robot may disappear, most likely on the nearest way.

The domain of the probabilistic track of the planning competition of 2011 (Sanner and Yoon, IPPC
2011), there in RDDL; also in the later work on dead-ends and risk. PDDLGym's "navigation10" is
`navigation(20, 5, disappearance=...)` with probabilities that rise from 0.052 to 0.925, not evenly.

    row height - 1   . . . . G    safe
                     ? ? ? ? ?    each move out of such a cell makes the robot
                     ? ? ? ? ?    disappear with the probability of the column
    row 0            . . . . S    safe

Start and goal lie at the two ends of the last column, which is the most dangerous one by default. A
robot that has disappeared never comes back. Crossing in a column of survival s succeeds with
probability s^(height - 2); a column k further to the left costs 2 k moves more.
"""

from collections.abc import Sequence

from examples.domains.domain import Domain
from examples.domains.outcomes import Actions, attempt
from examples.domains.parameters import Number, check_cost, check_count, check_probability
from ssp_lp import SSP, ModelError

GONE = "gone"
"""The state of a robot that has disappeared."""

Cell = tuple[int, int]
"""(column, row), both from 0."""

LEAST_DANGER, GREATEST_DANGER = 0.05, 0.9
"""Disappearance in the first and in the last column, unless probabilities are given."""

_DIRECTIONS = {"down": (0, -1), "left": (-1, 0), "right": (1, 0), "up": (0, 1)}


def navigation(
    width: int,
    height: int,
    *,
    disappearance: Sequence[Number] | None = None,
    move_cost: Number = 1,
) -> Domain:
    """Return the field as an SSP whose states are cells and `GONE`, and its start.

    Args:
        width: columns; at least 1.
        height: rows, the two safe ones included; at least 2.
        disappearance: [width] probability that a move out of an inner cell of the column fails;
            evenly from `LEAST_DANGER` to `GREATEST_DANGER` if left out.
        move_cost: of each move, the one that fails included.

    Raises:
        ModelError: naming the parameter at fault.
    """
    check_count("width", width, 1)
    check_count("height", height, 2)
    check_cost("move_cost", move_cost)
    danger = _even_danger(width) if disappearance is None else _checked(disappearance, width)

    def moves(cell: Cell | str) -> Actions:
        if isinstance(cell, str):  # gone
            return {}
        column, row = cell
        survival = 1 - danger[column] if 0 < row < height - 1 else 1
        found: Actions = {}
        for name, (right, up) in _DIRECTIONS.items():
            target = (column + right, row + up)
            if 0 <= target[0] < width and 0 <= target[1] < height:
                found[name] = attempt(survival, target, GONE, move_cost)
        return found

    start: Cell = (width - 1, 0)
    model = SSP.from_successors(
        start,
        moves,
        goal={(width - 1, height - 1)},
        state_limit=width * height + 1,
        state_labels={GONE: lambda state: state == GONE},
        treat_actionless_as_dead_ends=True,
    )
    return Domain(model, start)


def _even_danger(width: int) -> list[Number]:
    """Return probabilities at equal distances; a single column has the greatest."""
    step = (GREATEST_DANGER - LEAST_DANGER) / max(width - 1, 1)
    return [GREATEST_DANGER - step * (width - 1 - column) for column in range(width)]


def _checked(disappearance: Sequence[Number], width: int) -> list[Number]:
    """Check the probabilities, one for each column."""
    danger = list(disappearance)
    if len(danger) != width:
        raise ModelError(f"disappearance has {len(danger)} probabilities for width {width}")
    for column, probability in enumerate(danger):
        check_probability(f"disappearance[{column}]", probability)
    return danger
