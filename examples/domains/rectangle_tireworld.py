"""The rectangle tireworld: slow and safe straight moves, quick and risky diagonal ones.

Olivier Buffet's relative of the triangle tireworld for the planning competition of 2008, without
spare tyres. The car crosses a rectangle from the lower left to the upper right corner.

- A straight move along a safe column or row succeeds surely; elsewhere with probability `success`,
  else the car stays where it is.
- A diagonal move succeeds with probability `success`, else the car is wrecked for good.
- A deadly place is never left alive; here the run ends on arrival.

The model "rectangle-tireworld.5" of the Quantitative Verification Benchmark Set, a square of 5 with
the safe columns 1 and 3 and the safe rows 0 and 2, differs in two moves, apparently by mistake, and
`as_published=True` repeats these mistakes: a sure move down is offered where the
*row's* number is that of a safe column, a sure move left where the *column's* number is that of a
safe row; uncertain moves are offered beside them outside safe columns and rows, as for up and
right. Its wrecked cars wander as ghosts, at a cost; here they stay, which matters only where the
cost of failing is charged.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from examples.domains.domain import Domain
from examples.domains.outcomes import Actions, attempt
from examples.domains.parameters import Number, check_cost, check_count, check_probability
from ssp_lp import SSP, ModelError

WRECK = "wreck"
"""The state of a wrecked car."""

Cell = tuple[int, int]
"""(column, row), both from 0."""

_STRAIGHT = {"left": (-1, 0), "right": (1, 0), "up": (0, 1), "down": (0, -1)}
_DIAGONAL = {"up left": (-1, 1), "up right": (1, 1), "down left": (-1, -1), "down right": (1, -1)}


def rectangle_tireworld(
    width: int,
    height: int,
    *,
    safe_columns: Collection[int] | None = None,
    safe_rows: Collection[int] | None = None,
    deadly: Collection[Cell] = (),
    success: Number = 0.8,
    move_cost: Number = 1,
    as_published: bool = False,
) -> Domain:
    """Return the rectangle as an SSP whose states are cells and `WRECK`, and its start (0, 0).

    Args:
        width: columns; at least 2.
        height: rows; at least 2.
        safe_columns: columns along which moves are sure; the odd ones if left out.
        safe_rows: rows along which moves are sure; the even ones if left out.
        deadly: places where every car is lost; neither the start nor the goal.
        success: the probability that an uncertain move succeeds.
        move_cost: of each move.
        as_published: repeat the two slips of the published model, see above.

    Raises:
        ModelError: naming the parameter at fault.
    """
    check_count("width", width, 2)
    check_count("height", height, 2)
    check_probability("success", success)
    check_cost("move_cost", move_cost)
    start, goal = (0, 0), (width - 1, height - 1)
    rules = _Rules(
        width,
        height,
        _numbers("safe_columns", safe_columns, range(1, width, 2), width),
        _numbers("safe_rows", safe_rows, range(0, height, 2), height),
        _places(deadly, width, height),
        success,
        move_cost,
        as_published,
    )
    model = SSP.from_successors(
        start,
        rules.actions,
        goal={goal},
        state_limit=width * height + 1,
        state_labels={WRECK: lambda state: state == WRECK, "deadly": rules.deadly.__contains__},
        treat_actionless_as_dead_ends=True,
    )
    return Domain(model, start)


def _numbers(
    name: str, given: Collection[int] | None, default: range, length: int
) -> frozenset[int]:
    """Return the given columns or rows, checked to be inside."""
    chosen = frozenset(default if given is None else given)
    for number in chosen:
        check_count(name, number, 0)
        if number >= length:
            raise ModelError(f"{name} has {number}, but the last one is {length - 1}")
    return chosen


def _places(deadly: Collection[Cell], width: int, height: int) -> frozenset[Cell]:
    """Return the deadly places, checked to be inside, and not the start or the goal."""
    inner = {(column, row) for column in range(width) for row in range(height)}
    wrong = frozenset(deadly) - (inner - {(0, 0), (width - 1, height - 1)})
    if wrong:
        raise ModelError(f"deadly has {min(wrong)}, which is the start, the goal or outside")
    return frozenset(deadly)


@dataclass(frozen=True)
class _Rules:
    """The actions of a car in a rectangle."""

    width: int
    height: int
    safe_columns: frozenset[int]
    safe_rows: frozenset[int]
    deadly: frozenset[Cell]
    success: Number
    move_cost: Number
    as_published: bool

    def actions(self, cell: Cell | str) -> Actions:
        """Return straight moves, sure and uncertain ones, then diagonal moves."""
        if isinstance(cell, str) or cell in self.deadly:  # a wreck, or about to be one
            return {}
        found: Actions = {}
        for name, target in self._targets(cell, _STRAIGHT):
            if self._sure(name, cell):
                found[f"{name}, surely"] = attempt(1, target, cell, self.move_cost)
            if not self._along_safe(name, cell):
                found[name] = attempt(self.success, target, cell, self.move_cost)
        for name, target in self._targets(cell, _DIAGONAL):
            found[name] = attempt(self.success, target, WRECK, self.move_cost)
        return found

    def _targets(
        self, cell: Cell, directions: dict[str, tuple[int, int]]
    ) -> Iterator[tuple[str, Cell]]:
        """Yield the directions that stay inside, with the cells to which they lead."""
        for name, (right, up) in directions.items():
            column, row = cell[0] + right, cell[1] + up
            if 0 <= column < self.width and 0 <= row < self.height:
                yield name, (column, row)

    def _along_safe(self, name: str, cell: Cell) -> bool:
        """Return whether a straight move runs along a safe column or row."""
        if name in ("up", "down"):
            return cell[0] in self.safe_columns
        return cell[1] in self.safe_rows

    def _sure(self, name: str, cell: Cell) -> bool:
        """Return whether the straight move of a name is offered as a sure one in a cell."""
        column, row = cell
        if self.as_published and name == "down":
            return row in self.safe_columns
        if self.as_published and name == "left":
            return column in self.safe_rows
        return self._along_safe(name, cell)
