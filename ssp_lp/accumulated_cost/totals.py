"""Totals (accumulated costs) as layers: multiples of a unit, sums that can occur, or a grid.

- If costs have a common unit (paper, Assumption 2-1), every multiple of it is a total, and a step
  of k units leads k totals ahead.
- Otherwise the totals are the sums of step costs that can occur, and a table gives the total to
  which each step leads.
- If these sums are too many, the totals are a grid. A step that ends between two grid totals leads
  to both, with probabilities that preserve the mean. The process on a grid gives a lower bound of
  case S (paper, section 3.1.1): at a price of failure the value is concave in the cost paid, as a
  minimum of one affine function per policy, and interpolation never exceeds a concave function.

A step beyond the cap leads to a separate total, at which a tail takes over.
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

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, concatenated_ranges, read_only
from ssp_lp.compiled.deadline import pieces
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends, stored_with_model
from ssp_lp.processes.live_rows import uniform_cost

_MOST_LAYERS_PER_STEP = 1_000_000
_SHORT = 9  # most digits of a short decimal
_MEANT = 1e-12  # relative distance at which a cost means a short decimal
_NO_COSTS: Mapping[float, Fraction] = MappingProxyType({})


def exact_cost(cost: float | Fraction, exact: Mapping[float, Fraction] = _NO_COSTS) -> Fraction:
    """Return the fraction that a cost stands for: by default its shortest decimal.

    Rounded sums of decimals stand for the short decimal nearby: 0.1 * 3 stands for 0.3.

    Args:
        cost: the cost.
        exact: float cost -> the fraction that it stands for.
    """
    if isinstance(cost, Rational):
        return Fraction(cost)
    if cost in exact:
        return exact[cost]
    short = f"{cost:.{_SHORT}g}"
    is_short = abs(float(short) - cost) <= _MEANT * abs(cost)
    return Fraction(short if is_short else repr(float(cost)))


def last_layer(bound: float | Fraction, unit: Fraction) -> int:
    """Return the number of units in a finite bound, rounded down; negative for a negative bound.

    A float that is the double nearest to a multiple of the unit stands for this multiple: 2/3 for
    the unit 1/3, and three steps of 0.1 are within 0.3. Any other float stands for its shortest
    decimal.
    """
    if not isinstance(bound, Rational):
        nearest = round(Fraction(float(bound)) / unit)
        if float(nearest * unit) == float(bound):
            return nearest
        bound = Fraction(repr(float(bound)))
    return int(Fraction(bound) // unit)


def layers_within(total: float | Fraction, unit: Fraction) -> int:
    """Return the number of layers, multiples of a unit, up to a total."""
    return max(last_layer(total, unit) + 1, 0)


def totals_of(layers: IntArray, unit: Fraction) -> FloatArray:
    """Convert totals in units to floats, each rounded once, in the shape of ``layers``."""
    return np.asarray(layers * float(unit.numerator) / float(unit.denominator))


def common_unit(costs: FloatArray, exact: Mapping[float, Fraction]) -> Fraction:
    """Return the common unit of costs: their greatest common divisor.

    A float stands for a decimal (``exact_cost``), unless ``exact`` gives its fraction.

    Args:
        costs: non-negative; zeros do not matter.
        exact: float cost -> the fraction that it stands for.

    Returns:
        The unit; 1 if every cost is zero.
    """
    distinct = np.unique(costs)
    distinct = distinct[distinct > 0]
    if not distinct.size:
        return Fraction(1)
    for digits in range(_SHORT if not exact else 0):  # all of them short decimals
        whole = np.rint(distinct * 10.0**digits)
        if whole[-1] < 10.0**_SHORT and (whole / 10.0**digits == distinct).all():
            return Fraction(int(np.gcd.reduce(whole.astype(np.int64))), 10**digits)
    fractions = [exact_cost(c, exact) for c in distinct.tolist()]
    denominator = lcm(*[f.denominator for f in fractions])
    return Fraction(gcd(*[int(f * denominator) for f in fractions]), denominator)


def layers_of(costs: FloatArray, unit: Fraction, exact: Mapping[float, Fraction]) -> IntArray:
    """Return the number of units in each cost, in the shape of ``costs``.

    Raises:
        ModelError: a single step passes too many layers for a table over accumulated cost.
    """
    distinct, back = np.unique(costs, return_inverse=True)
    counts = [int(exact_cost(c, exact) / unit) if c > 0 else 0 for c in distinct.tolist()]
    if max(counts, default=0) > _MOST_LAYERS_PER_STEP:
        raise ModelError(
            f"the costs have the common unit {float(unit):g}, so that the step of cost "
            f"{float(distinct[-1]):g} passes {max(counts):,} layers of accumulated cost: round "
            "the costs to a coarser grid (for instance to multiples of "
            f"{float(distinct[-1]) / 100:g}) when building the model"
        )
    return np.array(counts, dtype=np.int64)[back].reshape(np.shape(costs))


@dataclass(frozen=True, eq=False)
class StepClasses:
    """Classes of steps: a step's cost in units, or its index among the distinct costs."""

    unit: Fraction
    ahead: IntArray  # [outcomes] class of each counted outcome; 0 for others
    width: int  # classes: 0 .. width - 1
    least: int  # the cheapest class

    @classmethod
    def of(
        cls, model: SSP, counted: BoolArray, unit: Fraction, costs: FloatArray, classes: IntArray
    ) -> StepClasses:
        """Return the class of each outcome by its cost.

        Impossible outcomes, and outcomes into states that are not counted, have class 0.

        Args:
            model: the model.
            counted: states whose incoming costs must be remembered, [states].
            unit: cost of a layer, or 1.
            costs: distinct costs of the steps into counted states, increasing, [costs].
            classes: class of each cost, [costs].
        """
        least, classes = int(classes.min()) if classes.size else 0, classes.astype(np.int32)
        if uniform_cost(model) is not None and costs.size <= 1:
            ahead = np.broadcast_to(np.int32(least), (model.n_outcomes,))
            return cls(unit, ahead, least + 1, least)
        ahead = np.zeros(model.n_outcomes, dtype=np.int32)
        for some in pieces(model.n_outcomes if costs.size else 0, model.n_outcomes):
            place = np.minimum(np.searchsorted(costs, model.costs[some]), costs.size - 1)
            ahead[some] = np.where(_is_counted(model, counted, some), classes[place], 0)
        return cls(unit, ahead, int(classes.max(initial=0)) + 1, least)


def _is_counted(model: SSP, counted: BoolArray, some: slice) -> BoolArray:
    """Return whether each outcome of a range is possible and leads to a counted state, [some]."""
    return np.asarray(counted[model.successors[some]] & (model.probabilities[some] > 0))


def _costs_into(model: SSP, counted: BoolArray) -> FloatArray:
    """Return the distinct costs of the steps into counted states, increasing."""
    same, costs = uniform_cost(model), [np.zeros(0)]
    for some in pieces(model.n_outcomes, model.n_outcomes):
        is_counted = _is_counted(model, counted, some)
        if same is None:
            costs.append(np.unique(model.costs[some][is_counted]))
        elif is_counted.any():
            return np.array([same])
    return np.unique(np.concatenate(costs))


def multiples_of_unit(model: SSP, counted: BoolArray) -> StepClasses:
    """Return the classes of steps by the number of layers that they pass.

    Args:
        model: the model.
        counted: states such that the cost of a step into them must be remembered, [states].

    Raises:
        ModelError: the costs have no common unit, or too small a one for the number of layers.
    """
    costs = _costs_into(model, counted)
    unit = common_unit(costs, model.exact_costs)
    layers = layers_of(costs, unit, model.exact_costs)
    return StepClasses.of(model, counted, unit, costs, layers)


MOST_SUMS = 20_000
"""Most sums that are exact layers, if they fit into memory."""

_PRODUCTS = 4  # sums formed at once, as a multiple of those that may be kept
_MOST_PLACES = 300_000  # most pairs of state and sum that walks reach
_MOST_FOLLOWED = 3_000_000  # most steps of these walks, and most sums times kinds of steps
_MOST_MARKS = 30_000_000  # most sums times states, reached or not
_UNKNOWN, _BEYOND = -2, -1  # codes instead of the number of a total
_MOST_ROUNDS = 1_000

_SAME = 1e-11
"""Distance, relative to the cap, up to which two sums count as equal; it is at most ``_SHARE`` of
the cheapest step."""

_SHARE = 1e-3  # of the cheapest step


@stored_with_model
def step_costs(model: SSP) -> tuple[StepClasses, FloatArray]:
    """Return the classes and distinct costs of the steps that do not end the episode."""
    return _numbered_costs(model, ~(dead_ends(model) | model.goal_mask))


@stored_with_model
def last_steps(model: SSP) -> tuple[StepClasses, FloatArray]:
    """Return the classes and distinct costs of the steps into a goal."""
    return _numbered_costs(model, model.goal_mask)


def _numbered_costs(model: SSP, counted: BoolArray) -> tuple[StepClasses, FloatArray]:
    """Return the classes and distinct costs of the steps into counted states; class 0: cost 0."""
    costs = _costs_into(model, counted)
    steps = np.union1d(0.0, costs)
    number = np.searchsorted(steps, costs)
    return StepClasses.of(model, counted, Fraction(1), costs, number), read_only(steps)


def room_of(steps: FloatArray, cap: float) -> float:
    """Return the difference up to which two sums of step costs count as one total.

    Args:
        steps: distinct costs of a step, the first of which is 0, [steps].
        cap: the greatest total.
    """
    cheapest = float(steps[1]) if len(steps) > 1 else cap
    return min(_SAME * cap, _SHARE * cheapest)


def sums_of(steps: FloatArray, cap: float, max_sums: int) -> FloatArray | None:
    """Return the sums of step costs below a cap, increasing; None if more than ``max_sums``."""
    moves, sums, room = steps[1:], np.zeros(1), room_of(steps, cap)
    if moves.size and cap > (max_sums + 1) * float(moves[0]):
        return None  # the multiples of the cheapest step are too many
    fresh, chunk = sums, max(_PRODUCTS * (max_sums + 1) // max(moves.size, 1), 1)
    while fresh.size:
        together = sums
        for begin in range(0, fresh.size, chunk):
            reached = (fresh[begin : begin + chunk, None] + moves).ravel()
            reached = reached[reached < cap - room]
            together = np.unique(np.concatenate([together, reached]))
            together = together[np.diff(together, prepend=-np.inf) > room]
            if together.size > max_sums:
                return None
        nearest = np.append(sums, np.inf)[np.searchsorted(sums, together - room)]
        fresh, sums = together[nearest - together > room], together
    return sums


def sums_in(model: SSP, cap: float, max_sums: int) -> FloatArray | None:
    """Return the totals below a cap that can occur in a model, increasing; None if too many.

    All sums of step costs are returned if they are few, otherwise the sums along walks through the
    model.
    """
    steps = step_costs(model)[1]
    sums = sums_of(steps, cap, max_sums)
    return _sums_of_walks(model, steps, cap, max_sums) if sums is None else sums


def _sums_of_walks(model: SSP, steps: FloatArray, cap: float, max_sums: int) -> FloatArray | None:
    """Return the sums along walks from any state, found breadth first; None if too many.

    Totals are numbered as they are found. The successor of a total by a kind of step is computed
    once for all states.
    """
    n, kinds, room = model.n_states, len(steps), room_of(steps, cap)
    offsets, target, kind = _steps_to_sum(model, steps)
    state, number = np.arange(n), np.zeros(n, dtype=np.int64)
    sums, seen = np.zeros(1), np.ones(n, dtype=np.bool_)  # by total, then by state
    leads = np.full(kinds, _UNKNOWN)  # successor of each total by each kind of step
    followed = 0
    for _ in range(_MOST_ROUNDS):
        count = offsets[state + 1] - offsets[state]
        followed += int(count.sum())
        if followed > _MOST_FOLLOWED:
            return None
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
        if len(sums) > min(max_sums, _MOST_MARKS // max(n, 1), _MOST_FOLLOWED // kinds):
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
    """Return the distinct (successor, cost class) of each state's steps: offsets and two arrays."""
    pair = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    ended = dead_ends(model) | model.goal_mask
    moving = (model.probabilities > 0.0) & ~ended[model.successors] & ~ended[model.pair_state[pair]]
    place = model.pair_state[pair[moving]].astype(np.int64) * model.n_states
    place = place + model.successors[moving]
    every = np.unique(place * len(steps) + np.searchsorted(steps, model.costs[moving]))
    place, kind = np.divmod(every, len(steps))
    source, target = np.divmod(place, model.n_states)
    return np.searchsorted(source, np.arange(model.n_states + 1)), target, kind


_SUMS_PER_TOTAL = 5  # most exact sums for each total of a grid
_ULPS = 1e-15  # relative rounding error of one sum


@dataclass(frozen=True, eq=False)
class Totals:
    """The totals of the layers in increasing order; the last one is the cap.

    There are two tables of the layer that a step from a total below the cap reaches:

    - ``reached`` has the exact total. Totals beyond the cap are layers, too (``beyond``), at which
      tails take over.
    - ``leads`` has no layers beyond the cap: the last layer stands for all totals from the cap on.
      On a grid the total is rounded down, and a share of the mass goes to the next layer.
    """

    values: FloatArray  # [totals] the first is 0
    steps: FloatArray  # [steps] distinct costs of a step, increasing, the first is 0
    complete: bool = False  # whether these are known to be all sums below the cap
    unit: Fraction | None = None  # if they are all multiples of it

    @classmethod
    def of_unit(cls, unit: Fraction, cap: int, width: int) -> Totals:
        """Return the multiples of a unit up to a cap, for steps of 0 .. width - 1 units."""
        values, steps = totals_of(np.arange(cap + 1), unit), totals_of(np.arange(width), unit)
        return cls(read_only(values), read_only(steps), complete=True, unit=unit)

    @cached_property
    def size(self) -> int:
        """Number of totals below the cap."""
        return len(self.values) - 1

    @cached_property
    def exact(self) -> bool:
        """Whether every sum of step costs up to the cap is the total of a layer."""
        if self.complete:
            return True
        below, share = self.leads
        gap = np.diff(self.values, append=np.inf)[below]
        return bool(((share == 0.0) | ((1.0 - share) * gap <= self._room)).all())

    @cached_property
    def leads(self) -> tuple[IntArray, FloatArray]:
        """The layer to which each step leads from each total, at most the last layer.

        Returns:
            The layer of the greatest total up to the exact sum, and the share of mass that goes to
            the next layer to preserve the mean, [totals, steps] each.
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
        return below, np.where(share * gap <= self._room, 0.0, share)  # rounded down: a lower bound

    def leads_by(self, kinds: IntArray) -> tuple[IntArray, FloatArray]:
        """Return the columns of :attr:`leads` for some classes of steps, [totals, classes] each."""
        if self.unit is None:
            below, share = self.leads
            return below[:, kinds], share[:, kinds]
        ahead = np.arange(self.size + 1)[:, None] + kinds
        return np.minimum(ahead, self.size), np.zeros(ahead.shape)

    @property
    def _room(self) -> float:
        """Difference up to which two sums count as one total."""
        return room_of(self.steps, float(self.values[-1]))

    @cached_property
    def beyond(self) -> FloatArray:
        """The totals at or beyond the cap that a step from below the cap reaches, increasing.

        Shape [beyond]. If ``complete``, sums between the last layer and the cap are included. No
        run reaches them, but the tables have an entry for every step from every layer.
        """
        if self.unit is not None:
            return totals_of(self.size + np.arange(len(self.steps) - 1), self.unit)
        reached = self.values[:-1, None] + self.steps[1:]
        least = self.values[-2] + self._room if self.complete else self.values[-1] - self._room
        beyond = np.unique(reached[reached > least])
        return beyond[np.diff(beyond, prepend=-np.inf) > self._room]

    @property
    def with_beyond(self) -> FloatArray:
        """The totals below the cap, followed by those of :attr:`beyond`."""
        return np.append(self.values[:-1], self.beyond)

    @property
    def reached(self) -> IntArray:
        """Index, in ``with_beyond``, of the total that each step reaches.

        [totals below the cap, steps].
        """
        return self.reached_by(np.arange(len(self.steps)))

    def reached_by(self, kinds: IntArray) -> IntArray:
        """Return the columns of :attr:`reached` for some classes of steps, [totals, classes]."""
        if self.unit is not None:
            return np.arange(self.size)[:, None] + kinds
        sums = self.values[:-1, None] + self.steps[kinds]
        return np.searchsorted(self.with_beyond, sums - self._room)

    @cached_property
    def ahead(self) -> IntArray | None:
        """Number of layers that each step passes from each total, less 1.

        [totals below the cap, steps - 1]; None for multiples of a unit, where the class of the step
        is the number of layers.
        """
        if self.unit is not None:
            return None
        return read_only(self.reached[:, 1:] - np.arange(1, self.size + 1)[:, None])

    @cached_property
    def span(self) -> int:
        """Number of layers ahead that a sweep stores: as many as the farthest step passes."""
        farthest = -1 if self.ahead is None else int(self.ahead.max(initial=-1))
        return max(len(self.beyond), farthest + 1)


_MOST_ON_GRID = 1600  # most totals of a grid, unless the user sets more

FIRST_TOTALS = 200
"""Totals on a first grid."""

CAP_MARGIN = 1.02  # factor of the cap that a price implies, as the price still changes a little
MOST_GROWTH = 4  # most growth of a cap in one step: more comes from a high, early price
_FEW = 16  # most layers a step may pass for multiples of a unit without comparing sums
_STEPS_AHEAD = 32  # length, in the most expensive steps, of the comparison of layers and sums
_FEWER = 4  # ratio of layers to sums from which sums are used
_LEAST_STEPS = 4.0  # least cap, in the most expensive steps
_MOST_ENTRIES = 200_000_000  # layers times pairs beyond which a grid is used
_NEARBY = 1.1  # least factor by which a cap is raised


@dataclass(frozen=True)
class Resolution:
    """A choice of totals that are not multiples of a unit: the cap, and sums of costs or a grid."""

    cap: float | None = None  # the last total; None: a first guess
    grid: int = FIRST_TOTALS  # totals of a grid, if there are too many sums
    most: int = 0  # most sums as exact layers; 0: a multiple of the grid's size
    turn: int = 0  # number of refinements
    fixed: tuple[float, ...] | None = None  # given totals

    def totals(self, model: SSP, first: float, room: int, *, grows: bool = True) -> Totals:
        """Return the totals of a model at this resolution.

        Args:
            model: the model.
            first: the cap if the resolution has none.
            room: most totals that fit into memory.
            grows: whether the charge still grows at the cap.
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
        moving = int(min(np.ceil(2.0 * cap / steps[1]), 1e9))  # a step must not round to 0
        size = min(max(self.grid, min(moving, self.most or MOST_SUMS)), room)
        return Totals(read_only(np.linspace(0.0, cap, size + 1)), steps)

    def up_to(self, total: float) -> Resolution:
        """Return the resolution; if it has no cap, its cap becomes a little more than ``total``.

        Args:
            total: accumulated cost from which failing is optimal; 0: unknown.
        """
        return replace(self, cap=CAP_MARGIN * total) if self.cap is None and total > 0.0 else self

    def finer(self, totals: Totals, enough: float | None, most: int) -> Resolution | None:
        """Return a resolution with a higher cap or a finer grid.

        The result is None if no more totals fit into memory, or if more totals would not help.

        Args:
            totals: the present totals.
            enough: total from which failing is optimal; 0 or infinite: unknown; None: the cap
                causes no error.
            most: most totals that fit into memory.
        """
        cap, wanted = float(totals.values[-1]), CAP_MARGIN * (enough or 0.0)
        wanted = wanted if wanted < np.inf else 0.0  # without a policy there is no price
        if enough is not None and (totals.exact or _NEARBY * cap < wanted):
            higher = wanted if _NEARBY * cap < wanted <= MOST_GROWTH * cap else 2.0 * cap
            return replace(self, cap=higher) if totals.size < most else None
        finest, grid = min(self.most or _MOST_ON_GRID, most), max(self.grid, totals.size)
        if grid >= finest or totals.exact:
            return None
        lower = enough is not None and self.turn % 3 == 2  # cap and grid may both lose
        higher = 2.0 * cap if lower else cap
        return replace(self, cap=higher, grid=min(2 * grid, finest), turn=self.turn + 1)


def resolution_for(
    model: SSP, most: int | None, cap: float | None, *, of_law: bool
) -> Resolution | None:
    """Return the resolution that a problem needs, or None if multiples of a unit are enough.

    Multiples are not enough if the costs have no common unit, or a unit so small that far fewer
    sums than multiples can occur.

    Args:
        model: the model.
        most: the user's number of totals, or None.
        cap: the user's cap, or None.
        of_law: whether the cost of the last step into the goal matters as well.
    """
    if most is not None:
        return Resolution(cap, grid=min(int(most), FIRST_TOTALS), most=int(most))
    wanted = resolution_of_law(model) if of_law else resolution_of_costs(model)
    return wanted if wanted is None or cap is None else replace(wanted, cap=cap)


@stored_with_model
def resolution_of_costs(model: SSP) -> Resolution | None:
    """Return the resolution of totals without the cost of the step that ends a run.

    None if multiples of a unit are enough.
    """
    return _resolution(model, step_costs(model)[1])


@stored_with_model
def resolution_of_law(model: SSP) -> Resolution | None:
    """Return the resolution of totals that include the cost of the step into the goal.

    None if multiples of a unit are enough.
    """
    return _resolution(model, np.union1d(step_costs(model)[1], last_steps(model)[1]))


def _resolution(model: SSP, steps: FloatArray) -> Resolution | None:
    """Return the resolution for given step costs, or None if multiples of a unit are enough."""
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
    # few layers for each step, but maybe too many for the last step into the goal
    last = _STEPS_AHEAD * float(last_steps(model)[1][-1])
    unit = common_unit(steps, model.exact_costs)
    if not steps[-1] > 0.0 or last * model.n_pairs <= _MOST_ENTRIES * float(unit):
        return None
    return None if sums_in(model, last, MOST_SUMS) is None else Resolution(most=MOST_SUMS)
