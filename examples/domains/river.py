"""The river: swim straight across above a waterfall, or walk the long way over the bridge.

A benchmark of the work on trading the probability of success against cost, by Freire and Delgado
("GUBS: a utility-based semantic for goal-directed Markov decision processes", AAMAS 2017) and
after. The problems 0 to 4 of PDDLGym's "river-alt" are `river(5, 5)`, `(5, 8)`, `(5, 15)`,
`(10, 10)` and `(10, 20)`.

    row height - 1   . . . . .    the bridge
                     . ~ ~ ~ .    . ground: every move succeeds
                     . ~ ~ ~ .    ~ water: the current may win
    row 1            S ~ ~ ~ .    S start, at the foot of the left bank
    row 0            # # # # G    # waterfall, G goal, at the foot of the right bank

A step in the water to the left, to the right or up succeeds with probability 1 - current; otherwise
the swimmer drifts one row down. A step down always succeeds. The bottom row, except for the goal,
belongs to the waterfall and is a dead-end. Walking needs
(height - 2) + (width - 1) + (height - 1) sure steps; swimming along row 1 takes width moves and
survives with probability (1 - current)^(width - 2).
"""

from examples.domains.domain import Domain
from examples.domains.outcomes import Actions, attempt
from examples.domains.parameters import Number, check_cost, check_count, check_probability
from ssp_lp import SSP

Cell = tuple[int, int]
"""(column, row), both from 0; column 0 is the left bank, row 0 the waterfall."""

_DIRECTIONS = {"down": (0, -1), "left": (-1, 0), "right": (1, 0), "up": (0, 1)}


def river(
    width: int,
    height: int,
    *,
    current: Number = 0.4,
    walk_cost: Number = 1,
    swim_cost: Number = 1,
) -> Domain:
    """Return the river as an SSP whose states are cells, and its start (0, 1).

    Args:
        width: columns, both banks included; at least 3.
        height: rows, waterfall and bridge included; at least 3.
        current: the probability that a stroke against or across the current fails.
        walk_cost: of each move that starts on the ground.
        swim_cost: of each move that starts in the water.

    Raises:
        ModelError: naming the parameter at fault.
    """
    check_count("width", width, 3)
    check_count("height", height, 3)
    check_probability("current", current)
    check_cost("walk_cost", walk_cost)
    check_cost("swim_cost", swim_cost)
    goal = (width - 1, 0)

    def moves(cell: Cell) -> Actions:
        column, row = cell
        if row == 0:
            return {}
        in_water = 0 < column < width - 1 and row < height - 1
        cost = swim_cost if in_water else walk_cost
        below = (column, row - 1)
        found: Actions = {}
        for name, (right, up) in _DIRECTIONS.items():
            target = (column + right, row + up)
            if 0 <= target[0] < width and target[1] < height:
                sure = not in_water or name == "down"
                found[name] = attempt(1 if sure else 1 - current, target, below, cost)
        return found

    start: Cell = (0, 1)
    model = SSP.from_successors(
        start,
        moves,
        goal={goal},
        state_limit=width * height,
        state_labels={"waterfall": lambda cell: cell[1] == 0 and cell != goal},
        treat_actionless_as_dead_ends=True,
    )
    return Domain(model, start)
