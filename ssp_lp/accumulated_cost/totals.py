"""The totals that are told apart: multiples of a unit, the sums that can occur, or a grid.

Where costs have a common unit (paper, Assumption 2-1) every multiple of it is a total, and a step
leads as many of them ahead as it has units. Elsewhere the totals are the sums of step costs that
can occur, and a table says where each step leads. Where these are too many they are a grid,
and a step that ends between two of its totals leads to both, in shares that keep its mean: as the
value at a price is concave in the cost already paid (each policy's is affine, and the best one's is
the least of them), interpolating it between totals never exceeds it. So the process on a grid
bounds the optimum of case S from below (paper, section 3.1.1). A step beyond the cap leads to a
total of its own, at which a tail takes over.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import gcd, lcm
from numbers import Rational
from types import MappingProxyType

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, chunks, concatenated_ranges, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends, kept
from ssp_lp.processes.live_rows import uniform_cost

_MOST_LAYERS_PER_STEP = 1_000_000
_SHORT = 9  # digits of a decimal that a person would write down
_MEANT = 1e-12  # relative distance at which a cost is such a decimal
_NO_COSTS: Mapping[float, Fraction] = MappingProxyType({})


def exact_cost(cost: float | Fraction, exact: Mapping[float, Fraction] = _NO_COSTS) -> Fraction:
    """The fraction that a cost on a lattice of totals stands for: a float's shortest decimal.

    Sums of decimals that were rounded on the way are what they were meant to be: 0.1 * 3 is 0.3.

    Args:
        cost: the cost.
        exact: float cost -> the fraction that it means instead.
    """
    if isinstance(cost, Rational):
        return Fraction(cost)
    if cost in exact:
        return exact[cost]
    short = f"{cost:.{_SHORT}g}"
    is_short = abs(float(short) - cost) <= _MEANT * abs(cost)
    return Fraction(short if is_short else repr(float(cost)))


def last_layer(bound: float | Fraction, unit: Fraction) -> int:
    """The last layer of a lattice of totals within a finite bound; negative: there is none.

    A float means its shortest decimal, to the last digit (three steps of 0.1 are within 0.3), or
    the whole number of layers of which it is the nearest float (2/3, where the unit is 1/3).
    """
    if not isinstance(bound, Rational):
        nearest = round(Fraction(float(bound)) / unit)
        if float(nearest * unit) == float(bound):
            return nearest
        bound = Fraction(repr(float(bound)))
    return int(Fraction(bound) // unit)


def layers_within(total: float | Fraction, unit: Fraction) -> int:
    """Number of layers of a lattice with a total of at most so much."""
    return max(last_layer(total, unit) + 1, 0)


def totals_of(layers: IntArray, unit: Fraction) -> FloatArray:
    """Totals of whole layers of a lattice, rounded once, like ``layers``."""
    return np.asarray(layers * float(unit.numerator) / float(unit.denominator))


def common_unit(costs: FloatArray, exact: Mapping[float, Fraction]) -> Fraction:
    """The unit of a lattice of totals: the greatest number that divides every cost.

    A float means a decimal (``exact_cost``) unless ``exact`` says which fraction it is.

    Args:
        costs: non-negative; zeros do not matter.
        exact: float cost -> the fraction meant.

    Returns:
        The unit; 1 where every cost is zero.
    """
    fractions = [exact_cost(c, exact) for c in np.unique(costs).tolist() if c > 0]
    if not fractions:
        return Fraction(1)
    denominator = lcm(*[f.denominator for f in fractions])
    return Fraction(gcd(*[int(f * denominator) for f in fractions]), denominator)


def layers_of(costs: FloatArray, unit: Fraction, exact: Mapping[float, Fraction]) -> IntArray:
    """Whole number of a lattice's units in each cost, like ``costs``.

    Raises:
        ModelError: a single step passes too many layers for a table over accumulated cost.
    """
    distinct, back = np.unique(costs, return_inverse=True)
    counts = [int(exact_cost(c, exact) / unit) if c > 0 else 0 for c in distinct.tolist()]
    if max(counts, default=0) > _MOST_LAYERS_PER_STEP:
        raise ModelError(
            f"the costs have the common unit {float(unit):g}, so the step of cost "
            f"{float(distinct[-1]):g} passes {max(counts):,} layers of accumulated cost; round "
            "the costs to a coarser grid (for instance to multiples of "
            f"{float(distinct[-1]) / 100:g}) when building the model"
        )
    return np.array(counts, dtype=np.int64)[back].reshape(np.shape(costs))


@dataclass(frozen=True, eq=False)
class StepClasses:
    """The steps of a model by what they cost: whole layers of a unit, or a number for each cost."""

    unit: Fraction
    ahead: IntArray  # [outcomes] class of each one that is counted: layers, or a number; 0: none
    width: int  # classes: 0 .. width - 1
    least: int  # the cheapest class of all

    @classmethod
    def of(
        cls, model: SSP, counted: BoolArray, unit: Fraction, costs: FloatArray, classes: IntArray
    ) -> StepClasses:
        """Class, among steps that totals tell apart, of each outcome into some states, [states].

        Args:
            model: the model.
            counted: the states.
            unit: cost of a layer, or 1.
            costs: of the steps into them, increasing, [costs].
            classes: [costs].
        """
        least, classes = int(classes.min()) if classes.size else 0, classes.astype(np.int32)
        if uniform_cost(model) is not None and costs.size <= 1:
            ahead = np.broadcast_to(np.int32(least), (model.n_outcomes,))
            return cls(unit, ahead, least + 1, least)
        ahead = np.zeros(model.n_outcomes, dtype=np.int32)
        for some in chunks(model.n_outcomes if costs.size else 0):
            place = np.minimum(np.searchsorted(costs, model.costs[some]), costs.size - 1)
            ahead[some] = np.where(_is_counted(model, counted, some), classes[place], 0)
        return cls(unit, ahead, int(classes.max(initial=0)) + 1, least)


def _is_counted(model: SSP, counted: BoolArray, some: slice) -> BoolArray:
    """Outcomes, of some, that lead to a state in which a total counts, [some]."""
    return np.asarray(counted[model.successors[some]] & (model.probabilities[some] > 0))


def _costs_into(model: SSP, counted: BoolArray) -> FloatArray:
    """The distinct costs of the steps into some states, [states], increasing."""
    same, costs = uniform_cost(model), [np.zeros(0)]
    for some in chunks(model.n_outcomes):
        is_counted = _is_counted(model, counted, some)
        if same is None:
            costs.append(np.unique(model.costs[some][is_counted]))
        elif is_counted.any():
            return np.array([same])
    return np.unique(np.concatenate(costs))


def multiples_of_unit(model: SSP, counted: BoolArray) -> StepClasses:
    """Steps by the number of layers that they pass, totals being multiples of a common unit.

    Args:
        model: the model.
        counted: successors of steps whose cost must be remembered, [states].

    Raises:
        ModelError: the costs have no common unit that gives a sane number of layers.
    """
    costs = _costs_into(model, counted)
    unit = common_unit(costs, model.exact_costs)
    layers = layers_of(costs, unit, model.exact_costs)
    return StepClasses.of(model, counted, unit, costs, layers)


MOST_SUMS = 20_000
"""Sums up to which all of them are told apart, where there is room."""

_PRODUCTS = 50  # sums that are formed at once, times those that may be kept
_MOST_PLACES = 300_000  # states times sums that are followed through a model
_MOST_MARKS = 30_000_000  # sums times states, or times steps, whether they are met or not
_UNKNOWN, _BEYOND = -2, -1  # in place of the number of a total
_MOST_ROUNDS = 1_000

_SAME = 1e-11
"""Totals this near to each other, relative to the cap, are one summed in two ways; yet never so far
from each other as a small share of the cheapest step."""

_SHARE = 1e-3  # of the cheapest step


@kept
def step_costs(model: SSP) -> tuple[StepClasses, FloatArray]:
    """Steps that go on, by the number of their cost, and the costs that add up to totals."""
    return _numbered_costs(model, ~(dead_ends(model) | model.goal_mask))


@kept
def last_steps(model: SSP) -> tuple[StepClasses, FloatArray]:
    """Steps into a goal, by the number of their cost: totals end with them."""
    return _numbered_costs(model, model.goal_mask)


def _numbered_costs(model: SSP, counted: BoolArray) -> tuple[StepClasses, FloatArray]:
    """The distinct costs of the steps into some states, [states], numbered from 0 for none."""
    costs = _costs_into(model, counted)
    steps = np.union1d(0.0, costs)
    number = np.searchsorted(steps, costs)
    return StepClasses.of(model, counted, Fraction(1), costs, number), read_only(steps)


def room_of(steps: FloatArray, cap: float) -> float:
    """Difference up to which two sums of steps below a cap are one total.

    Args:
        steps: distinct costs of a step, the first of which is 0, [steps].
        cap: the greatest total.
    """
    cheapest = float(steps[1]) if len(steps) > 1 else cap
    return min(_SAME * cap, _SHARE * cheapest)


def sums_of(steps: FloatArray, cap: float, most: int) -> FloatArray | None:
    """Totals that sums of steps make below a cap, increasing; None: there are more than so many."""
    moves, sums, room = steps[1:], np.zeros(1), room_of(steps, cap)
    if moves.size and cap > (most + 1) * float(moves[0]):
        return None  # the multiples of the cheapest are too many
    fresh, chunk = sums, max(_PRODUCTS * (most + 1) // max(moves.size, 1), 1)
    while fresh.size:
        together = sums
        for begin in range(0, fresh.size, chunk):
            reached = (fresh[begin : begin + chunk, None] + moves).ravel()
            reached = reached[reached < cap - room]
            together = np.unique(np.concatenate([together, reached]))
            together = together[np.diff(together, prepend=-np.inf) > room]
            if together.size > most:
                return None
        nearest = np.append(sums, np.inf)[np.searchsorted(sums, together - room)]
        fresh, sums = together[nearest - together > room], together
    return sums


def sums_in(model: SSP, cap: float, most: int) -> FloatArray | None:
    """Totals below a cap that can occur in a model, increasing; None: there are too many.

    All sums of steps, if these are few, else those that some walk through the model makes.
    """
    steps = step_costs(model)[1]
    sums = sums_of(steps, cap, most)
    return _sums_of_walks(model, steps, cap, most) if sums is None else sums


def _sums_of_walks(model: SSP, steps: FloatArray, cap: float, most: int) -> FloatArray | None:
    """Totals that walks from any state make, breadth first.

    Totals are numbered as they are found: which one a total and a kind of step lead to is worked
    out once for all states.
    """
    n, kinds, room = model.n_states, len(steps), room_of(steps, cap)
    offsets, target, kind = _steps_to_sum(model, steps)
    state, number = np.arange(n), np.zeros(n, dtype=np.int64)
    sums, seen = np.zeros(1), np.ones(n, dtype=np.bool_)  # of totals by number, then the state
    leads = np.full(kinds, _UNKNOWN)  # number that a total and a kind of step lead to
    for _ in range(_MOST_ROUNDS):
        count = offsets[state + 1] - offsets[state]
        edge = concatenated_ranges(offsets[state], count)
        taken = np.repeat(number, count) * kinds + kind[edge]
        is_taken = np.zeros(len(leads), dtype=np.bool_)
        is_taken[taken] = True
        new = np.flatnonzero(is_taken & (leads == _UNKNOWN))
        reached = sums[new // kinds] + steps[new % kinds]
        leads[new] = _BEYOND
        new, reached = new[reached < cap - room], reached[reached < cap - room]
        every = np.concatenate([sums, reached])
        order = np.argsort(every, kind="stable")
        group = np.cumsum(np.diff(every[order], prepend=-np.inf) > room)
        name = np.empty(len(every), dtype=np.int64)
        name[order] = group - 1
        first = np.full(group[-1], len(every))
        np.minimum.at(first, name, np.arange(len(every)))
        fresh = np.sort(first[first >= len(sums)])
        first[name[fresh]] = np.arange(len(sums), len(sums) + len(fresh))
        leads[new] = first[name[len(sums) :]]
        sums = np.append(sums, every[fresh])
        if len(sums) > most or len(sums) * max(n, kinds) > _MOST_MARKS:
            return None
        leads = np.append(leads, np.full(len(fresh) * kinds, _UNKNOWN))
        before = np.append(seen, np.zeros(len(fresh) * n, dtype=np.bool_))
        seen, inside = before.copy(), leads[taken] != _BEYOND
        seen[leads[taken[inside]] * n + target[edge[inside]]] = True
        number, state = np.divmod(np.flatnonzero(seen & ~before), n)
        if not state.size:
            return np.sort(sums)
        if np.count_nonzero(seen) > _MOST_PLACES:
            return None
    return None


def _steps_to_sum(model: SSP, steps: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Distinct (successor, class) of each state's steps that add to totals: offsets, both."""
    pair = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    ended = dead_ends(model) | model.goal_mask
    moving = (model.probabilities > 0.0) & ~ended[model.successors] & ~ended[model.pair_state[pair]]
    place = model.pair_state[pair[moving]].astype(np.int64) * model.n_states
    place = place + model.successors[moving]
    every = np.unique(place * len(steps) + np.searchsorted(steps, model.costs[moving]))
    place, kind = np.divmod(every, len(steps))
    source, target = np.divmod(place, model.n_states)
    return np.searchsorted(source, np.arange(model.n_states + 1)), target, kind


_SUMS_PER_TOTAL = 5  # sums told apart rather than a grid of so many fewer
_ULPS = 1e-15  # relative: the rounding of one sum


@dataclass(frozen=True, eq=False)
class Totals:
    """Totals in increasing order, the last of which is the cap and stands for all beyond it.

    A step from below the cap leads to the total that it makes: one beyond the cap has a place of
    its own (``beyond``), at which a tail takes over. Where the last total stands for all beyond it
    instead, and on a grid, ``leads`` rounds.
    """

    values: FloatArray  # [totals] the first is 0
    steps: FloatArray  # [steps] distinct costs of a step, increasing, the first is 0
    complete: bool = False  # known to be all sums that can occur below the cap
    unit: Fraction | None = None  # of which they are the multiples

    @classmethod
    def of_unit(cls, unit: Fraction, cap: int, width: int) -> Totals:
        """The multiples of a unit below a cap, where steps pass 0 .. width - 1 of them."""
        values, steps = (read_only(totals_of(np.arange(n), unit)) for n in (cap + 1, width))
        return cls(values, steps, complete=True, unit=unit)

    @cached_property
    def size(self) -> int:
        """Number of totals below the cap."""
        return len(self.values) - 1

    @cached_property
    def exact(self) -> bool:
        """Whether every sum of steps up to the cap is a total."""
        if self.complete:
            return True
        below, share = self.leads
        gap = np.diff(self.values, append=np.inf)[below]
        return bool(((share == 0.0) | ((1.0 - share) * gap <= self._room)).all())

    @cached_property
    def leads(self) -> tuple[IntArray, FloatArray]:
        """The total to which each step leads from each, the last for all beyond it as well.

        Returns:
            The total below, and the share that goes to the one above that, [totals, steps] each.
        """
        if self.unit is not None:
            return self.leads_by(np.arange(len(self.steps)))
        last, reached = self.size, self.values[:, None] + self.steps
        nearly = self._room if self.complete else _ULPS * reached
        below = np.searchsorted(self.values, reached + nearly, side="right") - 1
        below = np.minimum(below, last)
        below[last] = last
        gap = np.diff(self.values, append=2.0 * self.values[-1] + 1.0)[below]
        share = np.where(below < last, np.clip((reached - self.values[below]) / gap, 0.0, 1.0), 0.0)
        return below, np.where(share * gap <= self._room, 0.0, share)  # down: never too dear

    def leads_by(self, kinds: IntArray) -> tuple[IntArray, FloatArray]:
        """Totals to which some classes of steps lead, and shares of the next, [totals, classes]."""
        if self.unit is None:
            below, share = self.leads
            return below[:, kinds], share[:, kinds]
        ahead = np.arange(self.size + 1)[:, None] + kinds
        return np.minimum(ahead, self.size), np.zeros(ahead.shape)

    @property
    def _room(self) -> float:
        """Difference up to which two sums are one total."""
        return room_of(self.steps, float(self.values[-1]))

    @cached_property
    def beyond(self) -> FloatArray:
        """The totals from the cap on that steps from below it make, increasing, [beyond]."""
        if self.unit is not None:
            return totals_of(self.size + np.arange(len(self.steps) - 1), self.unit)
        reached = self.values[:-1, None] + self.steps[1:]
        beyond = np.unique(reached[reached >= self.values[-1] - self._room])
        return beyond[np.diff(beyond, prepend=-np.inf) > self._room]

    @property
    def with_beyond(self) -> FloatArray:
        """The totals below the cap, and those that steps make from there on."""
        return np.append(self.values[:-1], self.beyond)

    @property
    def reached(self) -> IntArray:
        """Number of the total that each step makes, totals beyond the cap included.

        [totals below the cap, steps].
        """
        return self.reached_by(np.arange(len(self.steps)))

    def reached_by(self, kinds: IntArray) -> IntArray:
        """Number of the total that some classes of steps make, [totals below the cap, classes]."""
        if self.unit is not None:
            return np.arange(self.size)[:, None] + kinds
        sums = self.values[:-1, None] + self.steps[kinds]
        return np.searchsorted(self.with_beyond, sums - self._room)

    @cached_property
    def ahead(self) -> IntArray | None:
        """The total that a step leads to, less the next one, [totals below the cap, steps - 1].

        None where each step leads to as many totals ahead as it costs units.
        """
        if self.unit is not None:
            return None
        return read_only(self.reached[:, 1:] - np.arange(1, self.size + 1)[:, None])

    @cached_property
    def span(self) -> int:
        """Number of totals that must be at hand: up to the farthest that steps lead to."""
        farthest = -1 if self.ahead is None else int(self.ahead.max(initial=-1))
        return max(len(self.beyond), farthest + 1)


_MOST_ON_GRID = 1600  # of a grid, unless more are asked for

FIRST_TOTALS = 200
"""Totals on a first grid."""

_MARGIN = 1.02  # beyond what a price asks for: the price still moves a little
_FEW = 16  # layers that a step may pass before sums are thought of
_STEPS_AHEAD = 32  # steps whose sums are counted
_FEWER = 4  # times as many layers as sums make the sums worth while
_LEAST_STEPS = 4.0  # a cap allows for, of the dearest
_MOST_ENTRIES = 200_000_000  # layers times pairs beyond which a grid is taken
_NEARBY = 1.1  # times a cap: no reason to move it by less
_GROWTH = 2.0  # of a cap that loses something


@dataclass(frozen=True)
class Resolution:
    """Resolution of totals that are no multiples of a unit: how finely they are told apart."""

    cap: float | None = None  # the last total; None: a first guess
    grid: int = FIRST_TOTALS  # totals on it, where the sums are too many
    most: int = 0  # sums that are told apart rather than taking a grid; 0: by the grid's size
    turn: int = 0  # of refining
    fixed: tuple[float, ...] | None = None  # the totals themselves

    def totals(self, model: SSP, first: float, room: int, *, grows: bool = True) -> Totals:
        """Totals of a model at this resolution.

        Args:
            model: the model.
            first: the last total of a first attempt.
            room: totals for which there is room.
            grows: whether what arriving is charged still grows there.
        """
        steps = step_costs(model)[1]
        if self.fixed is not None:
            sums = sums_in(model, self.fixed[-1], len(self.fixed))
            below = np.array(self.fixed[:-1])
            complete = sums is not None and len(sums) == len(below) and np.allclose(sums, below)
            return Totals(read_only(np.array(self.fixed)), steps, complete)
        cap = first if self.cap is None else self.cap
        least = _LEAST_STEPS * float(steps[-1]) if grows else _SHARE * float(steps[1:2].sum())
        cap = max(cap, least) or 1.0
        most = self.most or min(MOST_SUMS, _SUMS_PER_TOTAL * self.grid)
        sums = sums_in(model, cap, min(most, room))
        if sums is not None:
            return Totals(read_only(np.append(sums, cap)), steps, complete=True)
        moving = int(min(np.ceil(2.0 * cap / steps[1]), 1e9))  # a step must not round to nothing
        size = min(max(self.grid, min(moving, self.most or MOST_SUMS)), room)
        return Totals(read_only(np.linspace(0.0, cap, size + 1)), steps)

    def up_to(self, total: float) -> Resolution:
        """Resolution of totals up to where failing is best, where about that is known."""
        return replace(self, cap=_MARGIN * total) if self.cap is None and total > 0.0 else self

    def finer(self, totals: Totals, enough: float | None, most: int) -> Resolution | None:
        """Totals with a higher cap or on a finer grid; None: no room, or nothing to be gained.

        Args:
            totals: the present ones.
            enough: total from which on failing is best, 0: unknown; None: the cap loses nothing.
            most: totals that there is room for.
        """
        cap, wanted = float(totals.values[-1]), _MARGIN * (enough or 0.0)
        if enough is not None and (totals.exact or _NEARBY * cap < wanted):
            higher = wanted if _NEARBY * cap < wanted <= 4.0 * cap else _GROWTH * cap
            return replace(self, cap=higher) if totals.size < most else None
        finest, grid = min(self.most or _MOST_ON_GRID, most), max(self.grid, totals.size)
        if grid >= finest or totals.exact:
            return None
        lower = enough is not None and self.turn % 3 == 2  # either of the two may lose
        higher = cap * _GROWTH if lower else cap
        return replace(self, cap=higher, grid=min(2 * grid, finest), turn=self.turn + 1)


def resolution_for(
    model: SSP, most: int | None, cap: float | None, *, of_law: bool
) -> Resolution | None:
    """Resolution of totals that a problem asks for; None where multiples of a unit serve.

    They do not where costs that are told apart have no common unit, or one so small that the sums
    that can occur are far fewer than its multiples.

    Args:
        model: the model.
        most: totals at most, as a user says; None: nothing is said.
        cap: the last total, likewise.
        of_law: whether steps into the goal have to be told apart as well.
    """
    if most is not None:
        return Resolution(cap, grid=min(int(most), FIRST_TOTALS), most=int(most))
    wanted = resolution_of_law(model) if of_law else resolution_of_costs(model)
    return wanted if wanted is None or cap is None else replace(wanted, cap=cap)


@kept
def resolution_of_costs(model: SSP) -> Resolution | None:
    """Resolution of a model's totals; None where multiples of its unit serve."""
    return _resolution(model, step_costs(model)[1])


@kept
def resolution_of_law(model: SSP) -> Resolution | None:
    """Resolution of a model's totals, steps into the goal told apart as well."""
    return _resolution(model, np.union1d(step_costs(model)[1], last_steps(model)[1]))


def _resolution(model: SSP, steps: FloatArray) -> Resolution | None:
    """Resolution of totals by some step costs; None where their unit's multiples serve."""
    if uniform_cost(model) is not None:
        return None
    ahead, per_step = _STEPS_AHEAD * float(steps[-1]), 0
    if len(steps) > 2:
        try:
            unit = common_unit(steps, model.exact_costs)
            per_step = int(layers_of(steps[-1:], unit, model.exact_costs)[0])
        except ModelError:
            is_grid = sums_in(model, ahead, MOST_SUMS) is None
            return Resolution() if is_grid else Resolution(most=MOST_SUMS)
    if per_step > _FEW:
        layers = _STEPS_AHEAD * per_step
        if sums_in(model, ahead, min(layers // _FEWER, MOST_SUMS)) is not None:
            return Resolution(most=MOST_SUMS)
        return Resolution() if layers * model.n_pairs > _MOST_ENTRIES else None
    # few layers for each step that goes on, yet maybe too many for the last one
    last = _STEPS_AHEAD * float(last_steps(model)[1][-1])
    unit = common_unit(steps, model.exact_costs)
    if not steps[-1] > 0.0 or last * model.n_pairs <= _MOST_ENTRIES * float(unit):
        return None
    return None if sums_in(model, last, MOST_SUMS) is None else Resolution(most=MOST_SUMS)
