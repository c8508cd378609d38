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

    The accumulated cost is counted in layers: layer k stands for the cost k * ``unit``. Below the
    cap the memory is the layer. At the cap the policy switches for good to one of its tail
    policies, which are stationary, and the memory is ``cap`` plus the number of this tail. The
    policy switches to the last tail if the layer is at least the state's ``tail_threshold``, else
    to the first tail. The last tail fails where it can (the paper's pi'_or of section 3.5).

    With ``rounds_up``, the cost of a step is rounded up to whole layers. The true cost is then at
    most the cost in the memory, so success within a cost is never overstated.

    With ``levels``, layer k stands for the total cost ``levels[k]``, and the last level is the cap.
    After a step the memory is the level nearest to the sum of the previous level and the step's
    cost, so any observed cost is accepted. If the levels are all sums that can occur, the level is
    the exact cost paid; otherwise the cost is rounded at every step. Thresholds are then total
    costs instead of layers.

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
        """Number of layers below the cap, each with decisions of its own."""
        return int(self.decision.shape[0])

    @property
    def last_total(self) -> float:
        """Accumulated cost at the cap."""
        return self.cap * self.unit if self.levels is None else float(self.levels[-1])

    @property
    def memory_size(self) -> int:
        """Number of layers below the cap plus number of tail policies."""
        return self.cap + len(self.tails)

    @property
    def meaning(self) -> tuple[object, ...]:
        """Key of the memory's meaning: its layers, and the rule for choosing a tail policy."""
        levels = b"" if self.levels is None else self.levels.tobytes()
        kept = self.cap, self.unit, self.rounds_up, len(self.tails)
        return *kept, self.tail_threshold.tobytes(), levels

    @property
    def remembers(self) -> str:
        """Name of the quantity that the policy remembers."""
        return "cost paid"

    def memories(self) -> list[tuple[int, Hashable]]:
        """Return the values of the memory with their names: a cost paid, or "tail 0", "tail 1"."""
        layers = [layer * self.unit for layer in range(self.cap)]
        paid = layers if self.levels is None else self.levels[:-1].tolist()
        return list(enumerate([*paid, *(f"tail {k}" for k in range(len(self.tails)))]))

    def start_memory(self, states: IntArray) -> IntArray:
        """Return the memory at the start of episodes in these states, [episodes].

        It is layer 0, or a tail if the cap is 0.
        """
        nothing = np.zeros(len(states), dtype=np.int64)
        return self._memory_at(nothing, self.tail_threshold[states] <= 0.0)

    def layers(self) -> CostLayers | None:
        """Return the decisions by layer of the cost paid, for a sweep over layers.

        None if some cost is not a multiple of the unit, or if the layers would be too many.
        """
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
        """Return the decision in each (state, memory), as one branch of probability 1."""
        below = memory < self.cap
        pair = np.empty(len(states), dtype=np.int64)
        some = states[below]
        place = self.decision[memory[below], some]
        pair[below] = np.where(place < 0, place, self.model.pair_offsets[some] + place)
        pair[~below] = self.tails[memory[~below] - self.cap, states[~below]]
        return Branches(np.arange(len(states)), pair, np.ones(len(states)))

    def remember(self, memory: IntArray, *step: *Step) -> IntArray:
        """Return the memory after steps: the layer that is reached or, from the cap on, a tail.

        Raises:
            ModelError: a cost is negative or not finite, or is not a multiple of the unit and is
                not rounded.
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
        """Return the number of layers that costs pass, and a mask of costs between two layers.

        ``units`` are costs divided by the unit. With ``rounds_up`` no cost is between layers.
        """
        if self.rounds_up:
            passed = np.minimum(np.ceil(units * (1.0 - SAME_TOTAL)), _FAR)
            return passed, np.zeros(units.shape, dtype=np.bool_)
        steps = np.rint(units)
        return steps, ~(np.abs(units - steps) <= _NEAR)

    def _level_layers(self, levels: FloatArray) -> CostLayers | None:
        """Return the decisions by layer of a policy with levels; None if there are too many.

        Each level is a layer. Further layers beyond the cap distinguish totals that lead to
        different tails. A cost that occurs only in steps that end an episode counts as one layer,
        since no further layer is reached.
        """
        cap, costs, last = self.cap, np.unique(self.model.costs), len(self.tails) - 1
        goes_on = (self.tails[0] != UNDECIDED)[self.model.successors]
        moving = np.isin(costs, self.model.costs[goes_on])  # of steps that may go on
        edges = self._separating(levels, costs[moving])
        if len(edges) * self.model.n_states > _MOST_BEYOND:
            return None
        farthest = levels[-2] + costs[moving].max(initial=0.0)
        asks = np.searchsorted(edges, self.tail_threshold, side="right") - 1
        beyond_all = max(cap, len(edges))  # rank of a total that no layer exceeds
        rank = np.where(self.tail_threshold > farthest, beyond_all, asks)

        def reached(total: FloatArray, nearest: IntArray | None = None) -> IntArray:
            """Return the layer of each total, in the shape of ``total``.

            ``nearest`` has the level nearest to each total, if known.
            """
            nearest = _nearest_cost_level(levels, total) if nearest is None else nearest
            beyond = np.searchsorted(edges, total, side="right")
            return np.where(nearest < cap, nearest, cap + beyond)

        passed = np.where(moving, reached(costs), 1)
        is_even = _evenly_spaced(levels, costs[moving])
        # with one tail for all layers beyond the cap, all levels lead on alike
        alike = max(cap - 1 - int(passed.max(initial=0)), 0) if edges.size else cap
        even = alike if is_even else 0

        def leads(level: int) -> IntArray:
            """Return the number of layers that a step of each cost passes from a level, [costs]."""
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
        """Return the tail thresholds that distinguish totals beyond the cap, increasing.

        If no total can lie between two thresholds, only one of them is returned.

        Args:
            levels: levels of accumulated cost, increasing; the last one is the cap.
            costs: costs of steps after which an episode may go on, increasing.
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
        """Return the memory at a layer: the layer itself below the cap, else the code of a tail.

        The tail is the last one where ``is_late``, else the first one.
        """
        tail = np.where(is_late, len(self.tails) - 1, 0)
        return np.where(layer < self.cap, layer, self.cap + tail)

    def __repr__(self) -> str:
        """Return a line with the cap and the unit."""
        if self.levels is not None:
            return f"CostAwarePolicy({self.cap:,} levels below cost {self.levels[-1]:g})"
        return f"CostAwarePolicy({self.cap} layers of cost {self.unit:g})"


def _evenly_spaced(levels: FloatArray, costs: FloatArray) -> bool:
    """Return whether a step of each cost passes equally many levels from every level.

    Args:
        levels: levels of a cost-aware policy, [levels].
        costs: costs of its steps, [costs].
    """
    units, count = costs / levels[1], np.arange(len(levels))
    is_even = np.abs(levels / levels[1] - count).max() <= _ROUNDING
    is_apart = (np.abs(units - np.floor(units) - 0.5) > 2.0 * _ROUNDING).all()
    return bool(is_even and is_apart)


def _nearest_cost_level(levels: FloatArray, totals: FloatArray) -> IntArray:
    """Return the index of the level nearest to each total; of two equally near, the lower one."""
    above = np.clip(np.searchsorted(levels, totals), 1, len(levels) - 1)
    is_below = totals - levels[above - 1] <= levels[above] - totals
    return np.where(is_below, above - 1, above)


def levels_of(policies: Iterable[Policy], layers: int | None = None) -> FloatArray | None:
    """Return the levels of the first policy that has levels, [levels]; None if none has.

    Args:
        policies: members of a lottery.
        layers: number of levels below the last one that the policy must have; None: any number.
    """
    found = (p.levels for p in policies if isinstance(p, CostAwarePolicy))
    told_apart = (levels for levels in found if levels is not None)
    return next((each for each in told_apart if layers in {None, len(each) - 1}), None)
