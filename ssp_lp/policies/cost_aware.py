"""Semi-Markov policies: decisions that depend on the state and on the cost paid so far."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import SAME_TOTAL, BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError, check_flag, is_number, wrong_argument
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained_class
from ssp_lp.policies.policy import (
    UNDECIDED,
    Branches,
    CostLayers,
    Policy,
    Step,
    check_costs,
    check_decisions,
)

_MOST_BEYOND = 4_000_000  # most states times layers beyond the last level
_FAR = 1e15  # most layers that a step may pass
_MOST_PASSED = 20_000_000  # most states times layers of one step, if costs are rounded up
_CHECKED = 1_000_000  # decisions checked together
_ROUNDING = 1e-9  # of a level: above the rounding of a total of many levels
_NEAR = 1e-6  # of a layer or a level: far above the rounding of a sum of costs, far below a step


@explained_class
@dataclass(frozen=True, eq=False, repr=False)
class CostAwarePolicy(Policy):
    """A deterministic decision for each (state, accumulated cost) below a cap, then a tail policy.

    Costs are counted in layers of ``unit``. Memory below ``cap`` is the layer. At the cap the
    policy switches for good to one of its stationary tails: to the last one (which fails where it
    can, the paper's pi'_or of section 3.5) if the layer has reached ``tail_threshold`` of the
    state, otherwise to the first; memory is then ``cap + tail``.

    If it ``rounds_up``, the cost of a step is rounded up to whole layers. The cost paid is then at
    most the cost in the memory, so a law of rounded costs never overstates success.

    ``levels`` replace the layers by given totals, the last of which is the cap. After a step the
    memory is the level nearest to the sum of the previous level and the step's cost, so that any
    observed cost is accepted. If the levels are all the sums that can occur, the level is the cost
    paid; on a grid, the cost is rounded at every step. Thresholds are then totals.

    Raises:
        ModelError: levels that do not rise from 0, or are not one more than the layers.
    """

    model: SSP
    unit: float  # cost of one layer
    decision: IntArray  # [cap, states] position in the state's pairs, GIVE_UP_CODE or UNDECIDED
    tails: IntArray  # [tails, states] pair, GIVE_UP_CODE or UNDECIDED
    tail_threshold: FloatArray  # [states] layer from which the last tail is followed
    levels: FloatArray | None = None  # [cap + 1] totals, the first of which is 0; None: multiples
    rounds_up: bool = False  # costs that are no whole number of layers

    def __post_init__(self) -> None:
        check_flag("rounds_up", self.rounds_up)
        self.keep_read_only("decision", "tails", "tail_threshold")
        self.keep_read_only("levels", dtype=np.float64)
        if self.levels is not None:
            rising = len(self.levels) > 1 and bool((np.diff(self.levels) > 0.0).all())
            if not (rising and self.levels[0] == 0.0 and np.isfinite(self.levels[-1])):
                raise ModelError("levels of accumulated cost must rise from 0 and be finite")
            if len(self.levels) != len(self.decision) + 1:
                raise ModelError("a policy needs a decision for each level below the last")
        elif not (is_number(self.unit) and 0.0 < self.unit < np.inf):
            raise wrong_argument("the unit of accumulated cost", "be > 0 and finite", self.unit)
        else:
            object.__setattr__(self, "unit", float(self.unit))
        several, positions = max(_CHECKED // max(self.model.n_states, 1), 1), self.decision
        for first in range(0, self.cap, several):
            check_decisions(self.model, positions[first : first + several], as_positions=True)
        check_decisions(self.model, self.tails)

    @property
    def cap(self) -> int:
        """Number of the cost-aware policy's layers, accumulated costs with their own decisions."""
        return int(self.decision.shape[0])

    @property
    def last_total(self) -> float:
        """Accumulated cost at the cap."""
        return self.cap * self.unit if self.levels is None else float(self.levels[-1])

    @property
    def memory_size(self) -> int:
        """Number of layers and tails."""
        return self.cap + len(self.tails)

    @property
    def meaning(self) -> tuple[object, ...]:
        """Layers, and the rule that chooses a tail."""
        levels = b"" if self.levels is None else self.levels.tobytes()
        kept = self.cap, self.unit, self.rounds_up, len(self.tails)
        return *kept, self.tail_threshold.tobytes(), levels

    @property
    def remembers(self) -> str:
        """The cost-aware policy's memory, in words."""
        return "cost paid"

    def memories(self) -> list[tuple[int, Hashable]]:
        """Return what each memory means: a layer's cost paid so far, or the number of a tail."""
        layers = [layer * self.unit for layer in range(self.cap)]
        paid = layers if self.levels is None else self.levels[:-1].tolist()
        return list(enumerate([*paid, *(f"tail {k}" for k in range(len(self.tails)))]))

    def start_memory(self, states: IntArray) -> IntArray:
        """Return the cost-aware policy's memory at the start: layer 0, [episodes]."""
        nothing = np.zeros(len(states), dtype=np.int64)
        return self._memory_at(nothing, self.tail_threshold[states] <= 0.0)

    def layers(self) -> CostLayers | None:
        """Return the decisions by layers of cost; None if a cost is no multiple, or too large."""
        if self.levels is not None:
            return self._level_layers(self.levels)
        given = self.model.costs
        costs = np.unique(given[:1] if given.strides == (0,) else given)  # one for all outcomes
        steps, off = self._passed(costs / self.unit)
        if off.any() or self.cap == 0:
            return None
        if self.rounds_up and steps.max(initial=0.0) * self.model.n_states > _MOST_PASSED:
            return None
        passed = steps.astype(np.int64)
        return CostLayers(
            decision=self.decision,
            tails=self.tails,
            tail_at=lambda layer: np.where(layer >= self.tail_threshold, len(self.tails) - 1, 0),
            costs=costs,
            leads=lambda layer: passed,
            unit=self.unit,
            width=int(passed.max(initial=0)) + 1,
            rounds_up=self.rounds_up,
            even=self.cap,
        )

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the cost-aware policy's one decision of each (state, cost paid)."""
        below = memory < self.cap
        pair = np.empty(len(states), dtype=np.int64)
        some = states[below]
        place = self.decision[memory[below], some]
        pair[below] = np.where(place < 0, place, self.model.pair_offsets[some] + place)
        pair[~below] = self.tails[memory[~below] - self.cap, states[~below]]
        return Branches(np.arange(len(states)), pair, np.ones(len(states)))

    def remember(self, memory: IntArray, *step: *Step) -> IntArray:
        """Add a cost to the cost-aware policy's memory; at the cap switch to a tail.

        Raises:
            ModelError: a cost is negative or not finite, or no whole number of layers and not
                rounded.
        """
        _, successors, costs = step
        check_costs(costs)
        cap, threshold = self.cap, self.tail_threshold[successors]
        acting = (self.tails[0, successors] != UNDECIDED) & (memory < cap)
        if self.levels is not None:
            total = self.levels[np.minimum(memory, cap)] + costs
            layer, is_late = _nearest_cost_level(self.levels, total), total >= threshold
        else:
            steps, off = self._passed(np.asarray(costs / self.unit))
            off = acting & (off | (steps > _FAR))
            if off.any():
                unit, cost = self.unit, float(costs[int(np.argmax(off))])
                raise ModelError(f"observed cost {cost!r} is not a multiple of the unit {unit!r}")
            layer = memory + np.where(acting, steps, 0.0).astype(np.int64)
            is_late = layer >= threshold
        return np.where(acting, self._memory_at(layer, is_late), memory)

    def _passed(self, units: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return the numbers of whole layers in costs, and a mask of costs that are no multiple."""
        if self.rounds_up:
            passed = np.minimum(np.ceil(units * (1.0 - SAME_TOTAL)), _FAR)
            return passed, np.zeros(units.shape, dtype=np.bool_)
        steps = np.rint(units)
        return steps, ~(np.abs(units - steps) <= _NEAR)

    def _level_layers(self, levels: FloatArray) -> CostLayers | None:
        """Return the decisions by levels of cost, then by the tails that are followed.

        Steps that only end episodes lead to the next layer, where that makes no difference. None if
        the layers beyond are too many.
        """
        cap, costs, last = self.cap, np.unique(self.model.costs), len(self.tails) - 1
        goes_on = (self.tails[0] != UNDECIDED)[self.model.successors]
        moving = np.isin(costs, self.model.costs[goes_on])  # of steps that may go on
        edges = self._separating(levels, costs[moving])
        if len(edges) * self.model.n_states > _MOST_BEYOND:
            return None
        farthest = levels[-2] + costs[moving].max(initial=0.0)
        asks = np.searchsorted(edges, self.tail_threshold, side="right") - 1
        rank = np.where(self.tail_threshold > farthest, cap, asks)  # of a total beyond no layer

        def reached(total: FloatArray, nearest: IntArray | None = None) -> IntArray:
            """Return the layer that each total leads to, in the shape of ``total``."""
            nearest = _nearest_cost_level(levels, total) if nearest is None else nearest
            beyond = np.searchsorted(edges, total, side="right")
            return np.where(nearest < cap, nearest, cap + beyond)

        passed = np.where(moving, reached(costs), 1)
        is_even = _evenly_spaced(levels, costs[moving])
        even = max(cap - 1 - int(passed.max(initial=0)), 0) if is_even else 0
        even = cap if is_even and not edges.size else even  # one tail for all layers beyond

        def leads(level: int) -> IntArray:
            """Return the layers that a step of each cost passes from a level, [costs]."""
            if level < even:
                return passed
            nearest = level + passed if is_even else None
            return np.where(moving, reached(levels[level] + costs, nearest) - level, 1)

        leads_to = reached(levels[:cap] + costs[moving].max(initial=0.0))
        return CostLayers(
            decision=self.decision,
            tails=self.tails,
            tail_at=lambda layer: np.where(layer - cap > rank, last, 0),
            costs=costs,
            leads=leads,
            unit=None,
            width=max(int((leads_to - np.arange(cap)).max(initial=1)), 1) + 1,
            even=even,
        )

    def _separating(self, levels: FloatArray, costs: FloatArray) -> FloatArray:
        """Return the tail thresholds that lie between possible totals, increasing.

        Args:
            levels: increasing, the last one after all layers.
            costs: of steps after which an episode may go on, increasing.
        """
        near = levels[:-1][levels[:-1] >= levels[-2] - costs.max(initial=0.0)]
        last = levels[-2] + costs.max(initial=0.0)
        edges, end = np.unique(self.tail_threshold), 0.5 * (levels[-2] + levels[-1])
        edges = edges[(edges > (1.0 - _NEAR) * end) & (edges <= last)]
        if edges.size * near.size > _CHECKED * 10:  # too many to compare
            return np.asarray(edges)
        room = edges[:, None] - near
        below, upto = (
            np.searchsorted(costs, room + side * _NEAR * last).sum(axis=1) for side in (-1.0, 1.0)
        )
        is_apart = np.append(True, upto[1:] != below[:-1])
        return np.asarray(edges[is_apart[: len(edges)]])

    def _memory_at(self, layer: IntArray, is_late: BoolArray) -> IntArray:
        """Return the memory at a layer or, from the cap on, of a tail: the last tail if late."""
        tail = np.where(is_late, len(self.tails) - 1, 0)
        return np.where(layer < self.cap, layer, self.cap + tail)

    def __repr__(self) -> str:
        """Return a line with the cap and the unit."""
        if self.levels is not None:
            return f"CostAwarePolicy({self.cap:,} levels below cost {self.levels[-1]:g})"
        return f"CostAwarePolicy({self.cap} layers of cost {self.unit:g})"


def _evenly_spaced(levels: FloatArray, costs: FloatArray) -> bool:
    """Return whether a step passes equally many levels from each, up to the last level.

    Args:
        levels: levels of a cost-aware policy, [levels].
        costs: costs of its steps.
    """
    units, count = costs / levels[1], np.arange(len(levels))
    is_even = np.abs(levels / levels[1] - count).max() <= _ROUNDING
    is_apart = (np.abs(units - np.floor(units) - 0.5) > 2.0 * _ROUNDING).all()
    return bool(is_even and is_apart)


def _nearest_cost_level(levels: FloatArray, totals: FloatArray) -> IntArray:
    """Return the cost-aware policy's level nearest to each total, the lower of two."""
    above = np.clip(np.searchsorted(levels, totals), 1, len(levels) - 1)
    is_below = totals - levels[above - 1] <= levels[above] - totals
    return np.where(is_below, above - 1, above)


def levels_of(policies: Iterable[Policy], layers: int | None = None) -> FloatArray | None:
    """Return the totals that a lottery's cost-aware member distinguishes; None: multiples of units.

    Args:
        policies: the members.
        layers: number of levels below the last; None: any number.
    """
    found = (p.levels for p in policies if isinstance(p, CostAwarePolicy))
    told_apart = (levels for levels in found if levels is not None)
    return next((each for each in told_apart if layers in {None, len(each) - 1}), None)
