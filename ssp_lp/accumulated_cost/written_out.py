"""The accumulated-cost process as an explicit process, for methods that need one.

:func:`materialise` writes out a layered process: beyond the cap a policy follows one of its tails.

:class:`OpenEnded` has one last layer for all costs beyond the cap, in which the policy is free. A
run that reaches the goal from there is charged as if the cap had just been reached, plus the least
cost of its steps in the last layer. This is too little, so that the optimum is a lower bound. All
other numbers (failure, visits, secondary costs, ends) are exact. Every policy of this process is a
policy of the model, so that its true objective is an upper bound. Both bounds meet as the cap grows
(paper, section 3.5, with a free tail).
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
    """Write out all layers of a layered process as an explicit process.

    State ``layer * nodes + node`` is a node of a layer. The layers below the cap are followed by
    those that a step can reach beyond it. There each node has one pair for each tail, which ends
    the run with the tail's totals. The last state is the source, where runs start.

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
    """Return an explicit process that starts at a source, its last state.

    Args:
        base: one layer.
        steps: transitions of all pairs but that of the source, in order, [some pairs, states] each.
        n_pairs: number of pairs of each state except the source, [states - 1].
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
    """Return the pair that a policy takes in each state of the explicit process, [states].

    Args:
        process: the layered process.
        choice: position among the pairs of its node, [cap, nodes].
        tail_price: price of failure at which the tails beyond the cap are chosen.
    """
    base, cap, n_tails = process.base, process.cap, len(process.tails.values.goal)
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
    """Return the transitions of the pairs of all layers, [layers * pairs, states].

    Args:
        base: one layer.
        leads: function from classes of steps to the layer to which each leads, and to the share of
            mass that goes to the layer after it, [layers, classes] each; None: no share.
        n_states: number of states of the process.
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


FIRST_LAYERS: Final = 64  # first cap of a charge that never settles
MOST_AT_FIRST: Final = 1_000  # layers of a first cap: a policy of higher cost may be a long shot
TYPICAL: Final = 2.5  # first cap, in costs given success of a typical policy
BEYOND: Final = 1e-9  # relative distance of a total that lies beyond another


MOST_WRITTEN: Final = 20_000_000
"""Most pairs of an explicit process."""


@dataclass(frozen=True, eq=False)
class OpenEnded(ChargedLayers):
    """A process of the states (node, layer) below the cap, one layer beyond it, and a source."""

    base: AccumulatedCost
    charge: Charge
    shift: float  # added to the charge of every episode
    totals: Totals  # accumulated cost of each layer; the last one stands for all beyond it
    start: FloatArray  # [states]
    least_goal: FloatArray | None = None  # [states] lower bound for every policy; None: unknown

    @cached_property
    def process(self) -> ExplicitProcess:
        """The explicit process.

        Raises:
            ModelError: it would have too many pairs.
        """
        check_room(self.base, self.cap, MOST_WRITTEN)
        base, copies = self.base, self.cap + 1
        steps = steps_of_layers(base, self.leads, copies * self.base.n_nodes + 1)
        check_time()
        steps.sum_duplicates()
        check_time()
        cost = self.own_cost + self.everywhere(*self.shift_of_ends)
        failure = self.everywhere(base.failure, base.start_failure)
        goal = self.everywhere(base.survival * base.gain, base.start_goal)
        n_pairs = np.tile(np.diff(base.pair_offsets), copies)
        return _entered_process(base, [steps], n_pairs, (cost, failure, goal))

    def reachable_part(self) -> ReachablePart:
        """Return the part of the process that runs can reach.

        The source state is needed only for runs that start in goals or dead-ends, and is otherwise
        left out.
        """
        process, base = self.process, self.base
        start = process.start
        if base.start_goal == 0.0 and base.start_failure == 0.0:
            start = np.append(base.start, np.zeros(process.n_states - self.base.n_nodes))
        return reachable_part(process, start)

    def everywhere(self, per_pair: FloatArray, at_source: float) -> FloatArray:
        """Repeat a layer's numbers for all layers, and append one for the source, [process pairs].

        Args:
            per_pair: a number for each pair of a layer, [pairs].
            at_source: the number for the source's pair.
        """
        return np.append(np.tile(per_pair, self.cap + 1), at_source)

    def counting(self, semantics: FailureSemantics) -> Counting:
        """Return the coefficients of quantities other than the total, for the pairs of a layer."""
        base = self.base
        goal = base.survival * base.gain
        return Counting(
            base.quotient, base.escape, goal, base.failure, self.start, semantics, base.survival
        )

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """Return a choice as a cost-aware policy; the choice in the last layer becomes the tail.

        Args:
            choice: pair of each state of the process, [process states].
        """
        base, n = self.base, self.base.n_nodes
        quotient, model = base.quotient, base.quotient.model
        inner = choice[: (self.cap + 1) * n].reshape(self.cap + 1, n) % max(len(base.gain), 1)
        first = np.zeros(base.n_nodes, dtype=np.int32)
        decision = quotient.positions(first, inner[: self.cap])
        never, beyond = np.full(model.n_states, np.inf), quotient.pull_back(inner[-1])[None, :]
        levels = self.totals.values if base.by_steps else None
        return CostAwarePolicy(model, base.unit, decision, beyond, never, levels=levels)

    def nearer_goal(self, *, safely: bool = False) -> None:
        """Return None: the caller then searches for pairs that lead nearer to the goal."""
        return

    @cached_property
    def own_cost(self) -> FloatArray:
        """Expected charge of each pair's step into the goal, [process pairs]."""
        each = [self.own_cost_from(layer) for layer in backward(self.cap + 1)][::-1]
        return np.append(np.concatenate(each), self.start_charge)

    def own_cost_from(self, layer: int) -> FloatArray:
        """Return the expected charge of each pair's step into the goal from a layer, [pairs]."""
        charged = self.charged(layer).total
        if layer < self.cap or self.charge.slope == 0.0:
            return charged
        return charged + self.charge.slope * self._step_beyond if self.is_settled else charged

    @property
    def is_settled(self) -> bool:
        """Whether the charge is affine at the cap and beyond."""
        return bool(self.totals.values[-1] >= (self.charge.affine_from_total or 0.0))

    @cached_property
    def _step_beyond(self) -> FloatArray:
        """Lower bound of E[cost of a step; success after it] beyond the cap, [pairs].

        Whatever the policy, success after the step has at least the probability ``least_goal``.
        """
        if self.least_goal is None:
            return np.zeros(len(self.base.gain))
        going_on = self.base.quotient.node_of >= 0
        return self.step_cost(np.where(going_on, self.least_goal, 0.0))

    def reaching(self, goal: FloatArray) -> FloatArray:
        """Convert goal probabilities of nodes to goal probabilities of states, [states]."""
        states = self.base.quotient.lift(goal)
        states[self.base.quotient.model.goal_mask] = 1.0
        return states

    def step_cost(self, goal: FloatArray) -> FloatArray:
        """Return E[cost of a step; success after it], [pairs].

        Args:
            goal: goal probability from each state, [states].
        """
        quotient = self.base.quotient
        return quotient.at_pairs(cost_means(quotient.model, goal)) / self.base.escape

    @cached_property
    def shift_of_ends(self) -> tuple[FloatArray, float]:
        """Expected charge ``shift`` for ending: by each pair, [pairs], and at the start."""
        base = self.base
        ends = base.survival * base.gain + base.failure
        return self.shift * ends, self.shift * (base.start_goal + base.start_failure)

    @cached_property
    def beyond(self) -> LastLayer:
        """The last layer as a separate process."""
        base, n = self.base, self.base.n_nodes
        steps = sp.csr_array(base.steps)
        onward = steps.data.copy(), steps.indices % max(n, 1), steps.indptr.copy()
        rows = sp.csr_array(onward, shape=(len(base.gain), n))
        rows.sum_duplicates()  # in place, on the copies
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
        """Return the layer to which each class of steps leads, and the share of the next layer.

        On a grid a step is rounded down, which never raises a charge. If the charge is concave, the
        step is split instead between the two layers around its total, since interpolation does not
        raise such a charge either.

        Returns:
            The layer, and the probability that the step leads to the layer after it, [layers,
            kinds] each.
        """
        below, share = self.totals.leads_by(kinds)
        return below, share if self.charge.is_concave else np.zeros_like(share)


@dataclass(frozen=True, eq=False)
class LastLayer:
    """The last layer of an open-ended process; steps stay in it until the episode ends."""

    process: ExplicitProcess
    layered: OpenEnded

    @property
    def own_cost(self) -> FloatArray:
        """Expected charge of each pair's step into the goal, [pairs]."""
        return self.layered.own_cost_from(self.layered.cap)

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """Return the cost-aware policy that takes a choice in all layers.

        Args:
            choice: pair of each node, [nodes].
        """
        return self.layered.policy(np.tile(choice, self.layered.cap + 1))

    def nearer_goal(self, *, safely: bool = False) -> None:
        """Return None: the caller then searches for pairs that lead nearer to the goal."""
        return


def check_room(base: AccumulatedCost, layers: int, most: int) -> None:
    """Raise :class:`ModelError` if all layers together have more than ``most`` pairs."""
    n_pairs = (layers + 1) * len(base.gain)
    if n_pairs > most:
        raise ModelError(
            f"{layers:,} layers of accumulated cost (unit {base.unit:g}) have {n_pairs:,} pairs, "
            f"more than the limit of {most:,}: use a coarser grid of costs"
        )


def first_cap(base: AccumulatedCost, charge: Charge, typical: float, fixed: float | None) -> int:
    """Return a first cap, in layers: where the charge becomes affine, plus a margin if it grows.

    Args:
        base: one layer of the process.
        charge: the charge.
        typical: cost given success of a typical policy.
        fixed: the user's cap on accumulated cost, or None.
    """
    if fixed is not None:
        return max(int(np.ceil(fixed / base.unit)), 1)
    if (settled := _settled_open_end(charge)) is None:
        return FIRST_LAYERS + base.width
    needed = max(layers_within(settled, base.exact_unit), 1)
    if charge.slope == 0.0:
        return needed
    return needed + int(min(TYPICAL * typical / base.unit, MOST_AT_FIRST)) + base.width


def first_total(charge: Charge, typical: float) -> float:
    """Return a first cap as an accumulated cost, for layers that are not multiples of a unit."""
    settled = _settled_open_end(charge)
    if settled is not None and charge.slope == 0.0:
        return settled * (1.0 + BEYOND)
    return (settled or 0.0) + TYPICAL * typical


def truncates(charge: Charge, total: float) -> bool:
    """Return whether a cap at a total is inexact, since the charge may grow beyond it."""
    if charge.slope > 0.0 or charge.affine_from_total is None:
        return True
    return total <= charge.affine_from_total or not charge.is_affine_beyond(total)


def _settled_open_end(charge: Charge) -> float | None:
    """Return the total beyond which the charge is affine; None if it never is exactly."""
    settled = charge.affine_from_total
    if settled is None or not charge.is_affine_beyond(settled * (1.0 + BEYOND)):
        return None
    return settled
