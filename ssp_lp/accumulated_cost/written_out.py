"""The accumulated-cost process written out state by state, for methods that need it so.

:func:`materialise` ends with the tails of a layered process. :class:`OpenEnded` has one place for
all costs beyond the cap: there a policy goes on as it likes, but does not count the cost any more:
arriving there is charged as if the cap had just been reached, and each step what it costs those
that succeed at least. That is too little, so that the least objective bounds every policy's from
below; everything else (failing, visits, secondary costs, ends) is exact. As every policy of this
process is one of the model, too, its true objective bounds the optimum from above, and the two meet
as the cap grows (paper, section 3.5, with a tail that is free to choose).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.charges import Charge, TailValues
from ssp_lp.accumulated_cost.process import AccumulatedCost, ChargedLayers, LayeredProcess
from ssp_lp.accumulated_cost.totals import Totals, layers_within
from ssp_lp.arrays import FloatArray, IntArray, csr_of, offsets_of
from ssp_lp.compiled.deadline import backward, check_time, pieces
from ssp_lp.errors import ModelError
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.processes.explicit_process import ExplicitProcess, ReachablePart, reachable_part
from ssp_lp.processes.failure_semantics import Counting, FailureSemantics
from ssp_lp.processes.live_rows import cost_means


def materialise(process: LayeredProcess) -> ExplicitProcess:
    """Write all layers of the accumulated-cost process out: state = layer * nodes + node.

    The layers beyond the cap that a step can reach follow, with one pair for each tail policy,
    so that the written-out process can do all that either tail can; the source state comes last.

    Args:
        process: the layered process.
    """
    base, cap, beyond = process.base, process.cap, process.totals.beyond
    each = TailValues(*(values.T for values in process.tails.values))  # [nodes, tails]
    tails_cost = process.charge.beyond(beyond[:, None, None], each)
    tails_failure, tails_goal = (
        np.broadcast_to(values, tails_cost.shape) for values in (each.failure, each.goal)
    )
    n_beyond, n_tails = len(beyond) * base.n_nodes, len(each.goal.T)
    n_states = cap * base.n_nodes + n_beyond + 1
    steps = steps_of_layers(base, lambda kinds: (process.totals.reached_by(kinds), None), n_states)
    own_pairs, failure, goal = (
        np.tile(per_pair, cap)
        for per_pair in (np.diff(base.pair_offsets), base.failure, base.survival * base.gain)
    )
    charged = [process.charged(layer).total for layer in backward(cap)][::-1]
    rewards = (
        np.concatenate([*charged, tails_cost.ravel(), [process.start_charge]]),
        np.concatenate([failure, tails_failure.ravel(), [base.start_failure]]),
        np.concatenate([goal, tails_goal.ravel(), [base.start_goal]]),
    )
    every_step = [steps, sp.csr_array((tails_cost.size, n_states))]
    return _entered_process(
        base, every_step, np.append(own_pairs, np.full(n_beyond, n_tails)), rewards
    )


def _entered_process(
    base: AccumulatedCost,
    steps: list[sp.csr_array],
    n_pairs: IntArray,
    rewards: tuple[FloatArray, FloatArray, FloatArray],
) -> ExplicitProcess:
    """A written-out process that is entered by a source, its last state, where nothing is paid.

    Args:
        base: one layer.
        steps: of all pairs but the source's, in order, [some pairs, states] each.
        n_pairs: of each state but the source, [states - 1].
        rewards: cost, failure and goal, [pairs + 1] each.
    """
    source = np.zeros(len(n_pairs) + 1)
    source[-1] = 1.0
    entry = sp.csr_array(np.append(base.start, np.zeros(len(source) - base.n_nodes))[None, :])
    blocks = [*steps, entry]
    counts = np.concatenate([np.diff(block.indptr) for block in blocks])
    check_time()
    offsets, columns = offsets_of(counts), [block.indices for block in blocks]
    index = np.int32 if offsets[-1] <= np.iinfo(np.int32).max else np.int64
    indices: IntArray = np.concatenate(columns, dtype=index, casting="same_kind")
    check_time()
    data = np.concatenate([block.data for block in blocks])
    check_time()
    transitions = csr_of(data, indices, offsets.astype(index), (len(counts), len(source)))
    return ExplicitProcess(offsets_of(np.append(n_pairs, 1)), transitions, source, *rewards)


def chosen_pairs(process: LayeredProcess, choice: IntArray, tail_price: float) -> IntArray:
    """The pair that a policy takes in each state of the written-out process, [states].

    Args:
        process: the layered process.
        choice: position among the pairs of its node, [cap, nodes].
        tail_price: the price of failure by which tails are chosen beyond the cap.
    """
    base, cap, n_tails = process.base, process.cap, len(process.tails.goal)
    within = np.arange(cap)[:, None] * len(base.gain) + base.pair_offsets[:-1] + choice
    last = (process.beyond_units >= process.threshold(tail_price)).ravel()
    beyond = cap * len(base.gain) + np.arange(last.size) * n_tails + last * (n_tails - 1)
    source = cap * len(base.gain) + last.size * n_tails
    return np.concatenate([within.ravel(), beyond, [source]])


def steps_of_layers(
    base: AccumulatedCost,
    leads: Callable[[IntArray], tuple[IntArray, FloatArray | None]],
    n_states: int,
) -> sp.csr_array:
    """Transitions of the pairs of all layers, [layers * pairs, states].

    Args:
        base: one layer.
        leads: classes of steps -> the layer to which each leads, [layers, classes], and the share
            of it that goes to the layer after that one, likewise; None: nothing does.
        n_states: of the process.
    """
    steps, n = base.steps, base.n_nodes
    ahead, node = np.divmod(steps.indices.astype(np.int64), max(n, 1))
    kinds, classes = np.unique(ahead, return_inverse=True)
    check_time()
    reached, share = leads(kinds)
    layers, n_entries = len(reached), len(reached) * steps.nnz
    index = np.int32 if max(n_states, n_entries) <= np.iinfo(np.int32).max else np.int64
    table = np.empty((layers, steps.nnz), dtype=index)
    for some in pieces(layers, n_entries):
        table[some] = reached[some][:, classes] * n + node
    columns = table.ravel()
    check_time()
    row_ends = np.tile(steps.indptr[1:].astype(np.int64), layers)
    row_ends += np.repeat(np.arange(layers, dtype=np.int64) * steps.nnz, len(base.gain))
    indptr, shape = np.append(0, row_ends).astype(index), (layers * len(base.gain), n_states)
    data: FloatArray = np.tile(steps.data, layers)
    check_time()
    if share is None or not share.any():
        return sp.csr_array((data, columns, indptr), shape=shape)
    upper = share[:, classes].ravel()
    following = np.where(upper > 0.0, columns + n, columns).astype(index)
    below: sp.csr_array
    below = sp.csr_array((data * (1.0 - upper), columns, indptr), shape=shape)
    check_time()
    above: sp.csr_array = sp.csr_array((data * upper, following, indptr), shape=shape)
    check_time()
    return sp.csr_array(below + above)


_FIRST_LAYERS = 64  # of accumulated cost, where nothing says how many are needed
_MOST_AT_FIRST = 1_000  # layers of a first attempt: a policy of higher cost may be a long shot
_TYPICAL = 2.5  # layers of a first attempt, in costs given success of the safest policy
_BEYOND = 1e-9  # relative distance of a total that lies beyond another


MOST_WRITTEN: Final = 20_000_000
"""Pairs of a process that is written out."""


@dataclass(frozen=True, eq=False)
class OpenEnded(ChargedLayers):
    """States (node, layer) below the cap, then the nodes beyond it, then the source."""

    base: AccumulatedCost
    charge: Charge
    shift: float  # what every episode is charged on top
    totals: Totals  # what each layer stands for, the last for all beyond it as well
    start: FloatArray  # [states]
    least_goal: FloatArray | None = None  # [states] of every policy that counts; None: unknown

    @property
    def n_nodes(self) -> int:
        """States of one layer of the open-ended table."""
        return self.base.n_nodes

    @cached_property
    def process(self) -> ExplicitProcess:
        """The open-ended table written out; ModelError: there is no room for it."""
        check_room(self.base, self.cap, MOST_WRITTEN)
        base, copies = self.base, self.cap + 1
        steps = steps_of_layers(base, self.leads, copies * self.n_nodes + 1)
        check_time()
        steps.sum_duplicates()
        check_time()
        cost = self.own_cost + self.everywhere(*self.shift_of_ends)
        failure = self.everywhere(base.failure, base.start_failure)
        goal = self.everywhere(base.survival * base.gain, base.start_goal)
        n_pairs = np.tile(np.diff(base.pair_offsets), copies)
        return _entered_process(base, [steps], n_pairs, (cost, failure, goal))

    def reachable_part(self) -> ReachablePart:
        """The open-ended table's states, each at the totals that a run can come to.

        The source is left out where no start mass lies on goals and dead-ends.
        """
        process, base = self.process, self.base
        start = process.start
        if base.start_goal == 0.0 and base.start_failure == 0.0:
            start = np.append(base.start, np.zeros(process.n_states - self.n_nodes))
        return reachable_part(process, start)

    def everywhere(self, per_pair: FloatArray, at_source: float) -> FloatArray:
        """A number per pair of a layer, written out for all layers and the source.

        Args:
            per_pair: [pairs of a layer].
            at_source: at the only pair of the source.
        """
        return np.append(np.tile(per_pair, self.cap + 1), at_source)

    def counting(self, semantics: FailureSemantics) -> Counting:
        """Counting of quantities other than the total at the pairs of a layer written out."""
        base = self.base
        goal = base.survival * base.gain
        return Counting(
            base.quotient, base.departs, goal, base.failure, self.start, semantics, base.survival
        )

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """The cost-aware policy of a choice in the open-ended table, its last layer for all beyond.

        Args:
            choice: one pair of each state of the process, [process states].
        """
        base, n = self.base, self.n_nodes
        quotient, model = base.quotient, base.quotient.model
        inner = choice[: (self.cap + 1) * n].reshape(self.cap + 1, n) % max(len(base.gain), 1)
        first = np.zeros(base.n_nodes, dtype=np.int32)
        decision = quotient.positions(first, inner[: self.cap])
        never, beyond = np.full(model.n_states, np.inf), quotient.pull_back(inner[-1])[None, :]
        levels = self.totals.values if base.by_steps else None
        return CostAwarePolicy(model, base.unit, decision, beyond, never, levels=levels)

    def nearer_goal(self, *, safely: bool = False) -> None:
        """None: pairs nearer to the goal have to be found on the written-out process."""
        return

    @cached_property
    def own_cost(self) -> FloatArray:
        """Charges of arriving in the open-ended table, [process pairs]."""
        each = [self.own_cost_from(layer) for layer in backward(self.cap + 1)][::-1]
        return np.append(np.concatenate(each), self.start_charge)

    def own_cost_from(self, layer: int) -> FloatArray:
        """Charges of arriving from a layer of the open-ended table, [pairs]."""
        charged = self.charged(layer).total
        if layer < self.cap or self.charge.slope == 0.0:
            return charged
        return charged + self.charge.slope * self._step_beyond if self.is_settled else charged

    @property
    def is_settled(self) -> bool:
        """Whether the open end's charge has become its line at the cap, or only comes near one."""
        return bool(self.totals.values[-1] >= (self.charge.settled or 0.0))

    @cached_property
    def _step_beyond(self) -> FloatArray:
        """Least cost of a step in the open end beyond the cap, to runs that succeed, [pairs].

        However a policy goes on, it reaches the goal with the least probability that there is.
        """
        if self.least_goal is None:
            return np.zeros(len(self.base.gain))
        going_on = self.base.quotient.node_of >= 0
        return self.step_cost(np.where(going_on, self.least_goal, 0.0))

    def reaching(self, goal: FloatArray) -> FloatArray:
        """Probability of succeeding from each state, [states], by that of each node."""
        states = self.base.quotient.lift(goal)
        states[self.base.quotient.model.goal_mask] = 1.0
        return states

    def step_cost(self, goal: FloatArray) -> FloatArray:
        """Cost of a step to those of the open-ended table's runs that succeed after it, [pairs].

        Args:
            goal: probability of succeeding from each state on, [states].
        """
        quotient = self.base.quotient
        return quotient.at_pairs(cost_means(quotient.model, goal)) / self.base.departs

    @cached_property
    def shift_of_ends(self) -> tuple[FloatArray, float]:
        """Charge of every episode on top where it ends, [pairs], and at the written-out source."""
        base = self.base
        ends = base.survival * base.gain + base.failure
        return self.shift * ends, self.shift * (base.start_goal + base.start_failure)

    @cached_property
    def beyond(self) -> LastLayer:
        """The open end by itself, which stands for all costs beyond the cap."""
        base, n = self.base, self.n_nodes
        steps = sp.csr_array(base.steps)
        onward = steps.data.copy(), steps.indices % max(n, 1), steps.indptr.copy()
        rows = sp.csr_array(onward, shape=(len(base.gain), n))
        rows.sum_duplicates()  # in place: hence the copies
        process = ExplicitProcess(
            pair_offsets=base.pair_offsets,
            transitions=rows,
            start=np.zeros(n),
            cost=self.own_cost_from(self.cap) + self.shift_of_ends[0],
            failure=base.failure,
            goal=base.survival * base.gain,
        )
        return LastLayer(process, self)

    def leads(self, kinds: IntArray) -> tuple[IntArray, FloatArray]:
        """Layer of the open-ended table that steps lead to; share of the next, [layers, kinds].

        On a grid a step is rounded down, whence no charge is more; where interpolating the charge
        does not exceed it either, it leads to both neighbours of what it makes.
        """
        below, share = self.totals.leads_by(kinds)
        return below, share if self.charge.is_concave else np.zeros_like(share)


@dataclass(frozen=True, eq=False)
class LastLayer:
    """The open end by itself: whatever is paid there, one stays in it until the episode ends."""

    process: ExplicitProcess
    layered: OpenEnded

    @property
    def own_cost(self) -> FloatArray:
        """Charges of arriving from the open end, [pairs]."""
        return self.layered.own_cost_from(self.layered.cap)

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """The policy of a choice in the open end: one decision for each state.

        Args:
            choice: one pair of each node, [nodes].
        """
        return self.layered.policy(np.tile(choice, self.layered.cap + 1))

    def nearer_goal(self, *, safely: bool = False) -> None:
        """None: pairs of the open end nearer to the goal have to be found on the process itself."""
        return


def check_room(base: AccumulatedCost, layers: int, most: int) -> None:
    """Raise :class:`ModelError` where so many layers written out have too many pairs."""
    n_pairs = (layers + 1) * len(base.gain)
    if n_pairs > most:
        raise ModelError(
            f"{layers:,} layers of accumulated cost (unit {base.unit:g}) make {n_pairs:,} pairs, "
            f"of which there is room for {most:,}; a coarser grid of costs makes it less"
        )


def first_cap(
    base: AccumulatedCost, charge: Charge | None, typical: float, fixed: float | None
) -> int:
    """A cap of the open-ended table: as many layers as the charge needs to settle, or some more.

    Args:
        base: one layer of the process.
        charge: of arriving; None: nothing is told apart.
        typical: a cost given success.
        fixed: the user's cap on accumulated cost.
    """
    if charge is None:
        return 1
    if fixed is not None:
        return max(int(np.ceil(fixed / base.unit)), 1)
    if (settled := _settled_open_end(charge)) is None:
        return _FIRST_LAYERS + base.width
    needed = max(layers_within(settled, base.exact_unit), 1)
    if charge.slope == 0.0:
        return needed
    return needed + int(min(_TYPICAL * typical / base.unit, _MOST_AT_FIRST)) + base.width


def first_total(charge: Charge, typical: float) -> float:
    """A cap of the open-ended table as a total, where layers are no multiples of a unit."""
    settled = _settled_open_end(charge)
    if settled is not None and charge.slope == 0.0:
        return settled * (1.0 + _BEYOND)
    return (settled or 0.0) + _TYPICAL * typical


def truncates(charge: Charge | None, total: float) -> bool:
    """Whether the open end may lose something: the charge still changes beyond the cap."""
    if charge is None or charge.slope > 0.0:
        return charge is not None
    settled = charge.settled
    return settled is None or total <= settled or not charge.is_affine_beyond(total)


def _settled_open_end(charge: Charge) -> float | None:
    """Total beyond which the open end's charge is its line; None: it only comes near it."""
    settled = charge.settled
    if settled is None or not charge.is_affine_beyond(settled * (1.0 + _BEYOND)):
        return None
    return settled
