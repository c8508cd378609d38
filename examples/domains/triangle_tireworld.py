"""The triangle tireworld: the short road has no spare tyres, the long one has them everywhere.

The domain with which Little and Thiebaux ("Probabilistic planning vs replanning", ICAPS workshop
on the planning competition, 2007) showed a weakness of replanning for the likeliest course; later
in the planning competitions. With `remember_spares=True` the sizes 1 to 3 are problems 1 to 3
of PDDLGym's "tireworld", and size 1 with `spares="carried"` is "triangle-tireworld.9" of the
Quantitative Verification Benchmark Set, where a stranded car idles; here it has no action.

Places lie in a triangle of side 2 size + 1 and are called row-column, 1-1 at the left end of the
bottom row, which is the longest. The triangle is a lattice of small ones of side 2, with corners
where row and column are odd. Roads are one-way:

- up the left edge of each small triangle, right along its bottom, down its third side;
- within it, from the middle of the bottom up, and from the middle of the left edge down.

Start is 1-1, goal is the right end of the bottom row, 1-(2 size + 1). Every move bursts a tyre with
probability p on arrival, and a car with a flat tyre does not move. (The goal is reached on a flat
tyre too.) Spares lie in all even rows, on the left edge and on the right edge, none in row 1. So
the bottom road takes 2 size moves and arrives with probability (1 - p)^(2 size - 1), and the way
around by the two edges takes 4 size moves, changes tyres on the way, and always arrives.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from examples.domains.domain import Domain
from examples.domains.outcomes import Actions, attempt
from examples.domains.parameters import Number, check_cost, check_count, check_probability
from ssp_lp import SSP, ModelError

Place = tuple[int, int]
"""(row, column), both from 1."""


class Car(NamedTuple):
    """A state: the car's place and condition, and the spares that are used."""

    place: Place
    flat: bool = False
    carrying: bool = False
    used: frozenset[Place] = frozenset()


def triangle_tireworld(
    size: int,
    *,
    burst: Number = 0.5,
    spares: str = "mounted",
    remember_spares: bool = False,
    move_cost: Number = 1,
    change_cost: Number = 1,
    load_cost: Number = 1,
    state_limit: int = 1_000_000,
) -> Domain:
    """Return the tireworld as an SSP whose states are cars, and its start ``Car((1, 1))``.

    Args:
        size: small triangles along an edge, at least 1; there are (size + 1)(2 size + 1) places.
        burst: the probability p that a move ends with a flat tyre.
        spares: "mounted": a spare is put on where it lies, in place of a flat tyre.
            "carried": a spare is first loaded, at any time, one at a time; the spare aboard is
            put on anywhere.
        remember_spares: keep every used spare in the state, as the published models do. No road
            leads back, so this changes no policy and no value, but it makes the number of states
            grow exponentially with the size; without it there are about 5 size^2.
        move_cost: of each move.
        change_cost: of putting on a spare.
        load_cost: of taking one aboard.
        state_limit: give up when more states than this are found.

    Raises:
        ModelError: naming the parameter at fault, or that the limit was passed.
    """
    check_count("size", size, 1)
    check_probability("burst", burst)
    check_cost("move_cost", move_cost)
    check_cost("change_cost", change_cost)
    check_cost("load_cost", load_cost)
    if spares not in ("mounted", "carried"):
        raise ModelError(f'spares must be "mounted" or "carried", not {spares!r}')
    side = 2 * size + 1
    rules = _Rules(
        side, burst, spares == "carried", remember_spares, move_cost, change_cost, load_cost
    )
    start = Car((1, 1))
    model = SSP.from_successors(
        start,
        rules.actions,
        goal=rules.arrived,
        state_limit=state_limit,
        state_labels={"stranded": lambda car: not rules.arrived(car) and not rules.actions(car)},
        treat_actionless_as_dead_ends=True,
    )
    return Domain(model, start)


def roads_from(place: Place, side: int) -> Iterator[Place]:
    """Yield the places to which a road leads from `place` in a triangle of a given side."""
    row, column = place
    inside = row + column <= side  # not on the right edge
    if row > 1 and (row % 2 == 0 or column % 2 == 1):
        yield row - 1, column + 1
    if inside and row % 2 == 1:
        yield row, column + 1
    if inside and (row % 2 == 1 or column % 2 == 1):
        yield row + 1, column


def has_spare(place: Place, side: int) -> bool:
    """Return whether a spare tyre lies there at first."""
    row, column = place
    on_an_edge = column == 1 or row + column == side + 1
    return row % 2 == 0 or (row > 1 and on_an_edge)


@dataclass(frozen=True)
class _Rules:
    """The actions of a car in a triangle."""

    side: int
    burst: Number
    carried: bool
    remember_spares: bool
    move_cost: Number
    change_cost: Number
    load_cost: Number

    def arrived(self, car: Car) -> bool:
        """Return whether the car is at the goal, with or without a flat tyre."""
        return car.place == (1, self.side)

    def actions(self, car: Car) -> Actions:
        """Return the moves first, then the actions on spares."""
        spare_here = has_spare(car.place, self.side) and car.place not in car.used
        found: Actions = {}
        if not car.flat:
            used = car.used if self.remember_spares else frozenset()
            for target in roads_from(car.place, self.side):
                there = Car(target, False, car.carrying, used)
                flat = there._replace(flat=True)
                name = f"move to {target[0]}-{target[1]}"
                found[name] = attempt(self.burst, flat, there, self.move_cost)
        if self.carried:
            found |= self._load(car, spare_here)
        elif car.flat and spare_here:
            mounted = car._replace(flat=False, used=car.used | {car.place})
            found["change tyre"] = [(1, mounted, self.change_cost)]
        return found

    def _load(self, car: Car, spare_here: bool) -> Actions:
        """Return the actions of loading this place's spare and of putting on the loaded one."""
        found: Actions = {}
        if spare_here:
            loaded = car._replace(carrying=True, used=car.used | {car.place})
            found["load spare"] = [(1, loaded, self.load_cost)]
        if car.carrying:
            changed = car._replace(flat=False, carrying=False)
            found["change tyre"] = [(1, changed, self.change_cost)]
        return found
