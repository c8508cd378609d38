"""Evaluation of cost-aware policies by following their mass through layers of accumulated cost.

The probability mass of a policy is followed forwards from layer to layer, together with the cost
paid. Only the layers that one step can reach are in memory, as rows of a ring buffer. Steps of
cost 0 form a chain within a layer. Up to the cap, the last layer at which the policy depends on the
cost, this gives the value of the policy and the law of its total cost. Beyond the cap the policy
follows stationary policies (tails), whose chains are built explicitly.

If a policy never reaches the goal from a state, the goal can be avoided surely there, and the
policy may give up, since later costs do not change the cost given success.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.totals import exact_cost, totals_of
from ssp_lp.arrays import (
    SAME_TOTAL,
    BoolArray,
    FloatArray,
    IntArray,
    concatenated_ranges,
    offsets_of,
    read_only,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import backward, check_time, pieces
from ssp_lp.dynamic_programming.equations import System, strong_components
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_states, dead_ends, nearer_pairs, reached_along
from ssp_lp.policies import CostAwarePolicy, MixedPolicy
from ssp_lp.policies.chain import Chain, policy_chain
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, CostLayers, DeterministicPolicy, Policy

ENDED = -3
"""Code in place of a pair if the episode is over."""

_NO_CLASSES = np.zeros(0, dtype=np.uint8)
_NO_MARKS = np.zeros((0, 0), dtype=np.bool_)
_UNCHARGED = np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.bool_), False
_AT_ONCE = 1_000_000  # decisions between two checks of the time
_LOG = logging.getLogger("ssp_lp.evaluation")


@dataclass(frozen=True, eq=False)
class _Staying:
    """Moves of cost 0, which stay within a layer, among k of its states."""

    share: sp.csr_array  # [k, k] probabilities
    paid: sp.csr_array  # [k, k] probabilities times cost
    onward: FloatArray  # [k] probability of moving to a later layer

    def closed(self, among: BoolArray) -> BoolArray:
        """Return a mask of the states from which moves of cost 0 never leave the layer, [k].

        Args:
            among: states that may be in the mask; all other states count as leaving, [k].
        """
        closed = np.zeros(len(among), dtype=np.bool_)
        closed[System(self.share, np.where(among, self.onward, 1.0)).closed] = True
        return closed

    def visits(self, entering: FloatArray, inside: BoolArray, survival: float) -> FloatArray:
        """Return the expected visits of each state in the layer, in the shape of ``entering``.

        Args:
            entering: the mass that enters the layer and, in an optional second column, this mass
                times the cost paid before, [k, 1 or 2].
            inside: states whose moves are followed; runs must leave this set, [k].
            survival: discount of every move.
        """
        nodes, visits = np.flatnonzero(inside), entering.copy()
        rows = sp.csr_array(self.share[nodes] * survival)
        leaving = (
            (1.0 - survival) + survival * self.onward[nodes] + rows @ np.where(inside, 0.0, 1.0)
        )
        system = System(sp.csr_array(rows[:, nodes]), leaving)
        for column, mass in enumerate(visits.T):
            if column > 0:
                mass += survival * (self.paid[nodes].T @ visits[nodes, 0])
            mass[nodes] = system.solve_transposed(mass[nodes])
            mass += np.where(inside, 0.0, rows.T @ mass[nodes])
        return visits


@dataclass(frozen=True, eq=False)
class LayerMoves:
    """The steps of a model under a policy that depends on the layer of accumulated cost.

    All steps of a class have the same cost, so they pass the same number of layers. Mass that waits
    in later layers is stored in the rows of a ring buffer.
    """

    model: SSP
    layers: CostLayers

    @cached_property
    def acting(self) -> BoolArray:
        """Mask of the states at which episodes continue, [states]."""
        return ~(dead_ends(self.model) | self.model.goal_mask)

    @cached_property
    def classes(self) -> IntArray:
        """Index of each outcome's cost among the distinct costs, [outcomes]; one cost: empty."""
        costs, model = self.layers.costs, self.model
        if len(costs) == 1:
            return _NO_CLASSES
        result = np.empty(model.n_outcomes, dtype=np.min_scalar_type(len(costs)))
        for some in pieces(model.n_outcomes, model.n_outcomes):
            result[some] = np.searchsorted(costs, model.costs[some])
        return result

    @property
    def room(self) -> int:
        """Number of rows of the ring buffer: the layers that a step may reach."""
        return max(self.layers.width - 1, 1)

    def pairs(self, layer: int, states: IntArray) -> IntArray:
        """Return the policy's pair in a layer for each of some states.

        A negative code stands for giving up, for a missing decision, and (``ENDED``) for an end.
        """
        decision = self.layers.decision[layer][states]
        pair = np.where(decision < 0, decision, self.model.pair_offsets[states] + decision)
        return np.where(self.acting[states], pair, ENDED)

    def ring(self, layer: int) -> IntArray:
        """Return the row of the ring buffer to which each class of steps leads, [classes].

        The row is -1 if the steps stay in the layer.
        """
        leads, room = self.layers.leads(layer), self.room
        ring = leads + layer % room
        ring[ring >= room] -= room  # no step leads beyond the ring
        ring[leads <= 0] = -1
        return ring

    @cached_property
    def free_order(self) -> IntArray:
        """States of a layer, each after the states that it reaches at cost 0, [states]."""
        model = self.model
        staying = (self.layers.leads(0) <= 0)[self.classes if self.classes.size else [0]]
        begins = model.outcome_offsets[model.pair_offsets]
        return strong_components(begins, model.successors, model.probabilities * staying).order

    @with_twin
    def mark_backwards(self, begin: int, end: int, alive: BoolArray) -> None:
        """Mark the states, in a range of layers, from which the policy may reach marked states.

        Args:
            begin: the first layer. Between ``begin`` and ``end``, each class of steps must pass a
                fixed number of layers.
            end: the layer after the last one. Layers are marked from the last one backwards.
            alive: marks, updated, [layers + ``room``, states]: of all layers, and of those that
                steps reach beyond the last one.
        """
        check_time()
        model, leads, decision = self.model, self.layers.leads(begin), self.layers.decision
        if not model.n_outcomes:
            return
        if accelerated(model.n_outcomes * (end - begin), "layers.stream_marks"):
            from ssp_lp.compiled.layers import stream_marks

            own = decision[begin:end], self.acting, model.pair_offsets
            rest = leads, self.free_order, alive[begin:]
            stream_marks(decision[begin:end].size)(*own, *self.outcomes, *rest)
            return
        everywhere = np.arange(model.n_states)
        for layer in backward(end, begin):
            pairs = self.pairs(layer, everywhere)
            source, outcome, step = self._taken(pairs, leads >= 0)
            met = alive[layer + leads[step], model.successors[outcome]]
            alive[layer, source[met]] = True
            staying = self.staying(everywhere, pairs, self.ring(layer))
            if staying is not None:
                back, begins = staying.share.tocsc(), np.flatnonzero(alive[layer])
                alive[layer] |= reached_along(back.indices, back.indptr, begins)

    def follow(
        self,
        waiting: FloatArray,
        survivals: Sequence[float] = (1.0,),
        alive: BoolArray | None = None,
        first: int = 0,
    ) -> Iterator[tuple[int, IntArray, IntArray, FloatArray]]:
        """Follow mass layer by layer; mass beyond the last layer stays in the ring buffer.

        Args:
            waiting: mass in the rows of the ring buffer, [rows, states, columns], updated. With
                ``alive`` there are three columns for each discount: mass that has not lost the
                goal, this mass times the cost paid, and mass that has lost the goal. Without
                ``alive`` there is one column of mass.
            survivals: the discounts.
            alive: mask of the states from which the goal can be reached, [layers, states].
            first: the first layer.

        Yields:
            The layer, the k states with mass, their pairs, [k], and their expected visits, [k,
            columns], infinite if the visits never end. Mass that loses the goal in this layer
            counts in the first and in the third column.
        """
        everywhere, layers = np.arange(self.model.n_states), self.layers
        for layer in range(first, layers.count):
            share = layer / layers.count
            _LOG.debug("layer %d of %d", layer, layers.count, extra={"share": share})
            row, ring = waiting[layer % self.room], self.ring(layer)
            here: IntArray = np.flatnonzero(row @ np.ones(waiting.shape[2]))
            if (ring < 0).any():
                here = self.within(self.pairs(layer, everywhere), ring, here)
            pairs, visits = self.pairs(layer, here), row[here]
            row[here] = 0.0
            staying, moving = self.staying(here, pairs, ring), pairs >= 0
            hopes = moving if alive is None else alive[layer, here]
            closed = np.False_ if staying is None else staying.closed(moving)
            sent = np.empty_like(visits)
            for k, survival in enumerate(survivals):
                block = slice(3 * k, 3 * k + 3)
                own, lost = visits[:, block][:, :2], visits[:, block][:, 2:]
                if staying is not None:
                    own[:] = staying.visits(own, moving & hopes & ~closed, survival)
                lost[~hopes] += own[~hopes, :1]
                if staying is not None and lost.size:
                    ends = ~closed if survival == 1.0 else True
                    lost[:] = staying.visits(lost, moving & ~hopes & ends, survival)
                sent[:, block] = survival * visits[:, block]
                sent[:, block][~hopes, :2] = 0.0
                if staying is not None and lost.size and survival == 1.0 and closed.any():
                    stuck = np.flatnonzero(closed & (lost[:, 0] > 0.0))
                    lost[reached_along(staying.share.indices, staying.share.indptr, stuck)] = np.inf
            self.send(sent, pairs, ring, waiting)
            yield layer, here, pairs, visits

    def is_soon_followed(self, least_nodes: int) -> bool:
        """Return whether to follow the layers, rather than to build the policy's chain.

        Args:
            least_nodes: states times layers from which layers are always followed.
        """
        layers, nodes = self.layers, self.layers.count * self.model.n_states
        is_even = layers.even == layers.count and bool((layers.leads(0) > 0).all())
        return nodes >= least_nodes or (is_even and accelerated(nodes, "layers.stream_evenly"))

    @with_twin
    def follow_evenly(
        self,
        waiting: FloatArray,
        stopped: FloatArray,
        survivals: Sequence[float] = (1.0,),
        alive: BoolArray = _NO_MARKS,
        charged: tuple[FloatArray, FloatArray, BoolArray, bool] = _UNCHARGED,
    ) -> FloatArray | None:
        """Follow mass in one compiled pass through the first layers, as far as possible.

        In these layers no step has cost 0, and a class of steps passes a fixed number of layers.

        Args:
            waiting: mass, as for ``follow``.
            stopped: written: mass that ends in each state, and mass that gives up, [2, states].
            survivals: the discounts.
            alive: mask of the states from which the goal can be reached, [layers, states]; empty
                if ``waiting`` has one column.
            charged: mean cost of a step, [pairs]; cost of failing, [states]; whether giving up is
                forbidden, [states]; and whether costs are paid after the goal is lost.

        Returns:
            Goal, failure, cost of success and cost until failure, [layers, discounts, 4]; None if
            a decision is missing or not allowed.
        """
        model, layers, leads = self.model, self.layers, self.layers.leads(0)
        entries, several = model.n_outcomes * layers.even, _AT_ONCE // model.n_states + 1
        if (leads <= 0).any() or not accelerated(entries, "layers.stream_evenly"):
            return np.zeros((0, 1, 4))
        from ssp_lp.compiled.layers import stream_evenly

        totals = np.zeros((len(survivals), layers.even, 4))
        for k, survival in enumerate(survivals):
            ends = stopped if k == 0 else stopped.copy()
            for first in range(0, layers.even, several):
                check_time()
                some = slice(first, min(first + several, layers.even))
                if not stream_evenly(
                    waiting, first, layers.decision[some], alive[some], self.acting,
                    model.goal_mask, model.pair_offsets, *self.outcomes, leads, layers.costs,
                    *charged, 3 * k, survival, totals[k, some], ends,
                ):  # fmt: skip
                    return None
        return totals.swapaxes(0, 1)

    @with_twin
    def send(self, mass: FloatArray, pairs: IntArray, ring: IntArray, waiting: FloatArray) -> None:
        """Add the mass that k states send to later layers to the waiting mass.

        Args:
            mass: mass of the states, with the columns of ``follow``, [k, columns].
            pairs: pairs that are taken, [k].
            ring: row of the ring buffer for each class of steps, [classes].
            waiting: updated, [rows, states, columns].
        """
        check_time()
        costs = self.layers.costs
        if accelerated(self.model.n_outcomes, "layers.stream_mass"):
            from ssp_lp.compiled.layers import stream_mass

            stream_mass(mass, pairs, *self.outcomes, ring, costs, waiting)
            return
        source, outcome, step = self._taken(pairs, ring >= 0)
        place, moved = (ring[step], self.model.successors[outcome]), mass[source]
        moved[:, 1::3] += costs[step, None] * moved[:, ::3]
        np.add.at(waiting, place, moved * self.model.probabilities[outcome, None])

    def within(self, pairs: IntArray, ring: IntArray, begins: IntArray) -> IntArray:
        """Return the states that moves of cost 0 reach from some states, increasing.

        Args:
            pairs: pairs of all states, [states].
            ring: row of the ring buffer for each class of steps, [classes].
            begins: the first states, increasing; they belong to the result.
        """
        source, outcome, _ = self._taken(pairs, ring < 0)
        if not source.size:
            return begins
        offsets = offsets_of(np.bincount(source, minlength=len(pairs)))
        return np.flatnonzero(reached_along(self.model.successors[outcome], offsets, begins))

    def staying(self, states: IntArray, pairs: IntArray, ring: IntArray) -> _Staying | None:
        """Return the moves of cost 0 within a layer, or None if there are none.

        Args:
            states: states that these moves do not leave, increasing, [k].
            pairs: pairs that are taken, [k].
            ring: row of the ring buffer for each class of steps, [classes].
        """
        if (ring >= 0).all():
            return None
        source, outcome, step = self._taken(pairs, ring < 0)
        if not source.size:
            return None
        share, target = self.model.probabilities[outcome], self.model.successors[outcome]
        where, shape = (source, np.searchsorted(states, target)), (len(states), len(states))
        paid = sp.csr_array((share * self.layers.costs[step], where), shape=shape)
        onward = np.zeros(len(pairs))
        source, outcome, _ = self._taken(pairs, ring >= 0)
        np.add.at(onward, source, self.model.probabilities[outcome])
        return _Staying(sp.csr_array((share, where), shape=shape), paid, onward)

    @property
    def outcomes(self) -> tuple[IntArray, IntArray, FloatArray, IntArray]:
        """Offsets, successors, probabilities and classes of the outcomes, for compiled loops."""
        model = self.model
        successors = model.successors.view(np.uint32)
        return model.outcome_offsets, successors, model.probabilities, self.classes

    def _taken(self, pairs: IntArray, in_classes: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
        """Return the moves whose cost is in some classes.

        Args:
            pairs: the pair taken in each of k states, negative if none, [k].
            in_classes: mask of the classes of equal step cost, [classes].

        Returns:
            The position of the move's pair in ``pairs``, its outcome and its class, [moves] each.
        """
        where = np.flatnonzero(pairs >= 0)
        begin = self.model.outcome_offsets[pairs[where]]
        counts = self.model.outcome_offsets[pairs[where] + 1] - begin
        outcome, source = concatenated_ranges(begin, counts), np.repeat(where, counts)
        kept = self.model.probabilities[outcome] > 0.0
        if self.classes.size:
            kept &= in_classes[self.classes[outcome]]
        elif not in_classes.all():
            kept[:] = False
        source, outcome = source[kept], outcome[kept]
        return source, outcome, self.classes[outcome] if self.classes.size else 0 * outcome


def giving_up_where_lost(policy: MixedPolicy) -> MixedPolicy:
    """Return a lottery whose cost-aware members give up once the goal is lost.

    The goal can be lost at attention states only.

    Raises:
        Stop: the time limit was reached.
    """
    members = list(policy.policies)
    if not any(isinstance(member, CostAwarePolicy) for member in members):
        return policy
    acting = np.diff(policy.model.pair_offsets) > 0
    if not (attention_states(policy.model) & acting).any():
        return policy
    for k, member in enumerate(members):
        layers = member.layers()
        if isinstance(member, CostAwarePolicy) and layers is not None:
            moves = LayerMoves(member.model, layers)
            lost = (~hopes for hopes in alive_layers(moves))
            decision, tails = (
                np.where(moves.acting & (taken >= 0) & there[: len(taken)], GIVE_UP_CODE, taken)
                for taken, there in zip((layers.decision, layers.tails), lost, strict=True)
            )
            members[k] = replace(member, decision=decision, tails=tails)
    return replace(policy, policies=tuple(members))


def alive_layers(moves: LayerMoves) -> tuple[BoolArray, BoolArray]:
    """Return masks of the states from which a cost-aware policy may reach the goal.

    Returns:
        A mask for the layers below the cap and the ``moves.room`` layers after them, which a step
        can reach, [layers + room, states]; and a mask for the tails, [tails, states].

    Raises:
        Stop: the time limit was reached.
    """
    model, layers, count = moves.model, moves.layers, moves.layers.count
    beyond = np.empty(layers.tails.shape, dtype=np.bool_)  # states where a tail reaches the goal
    for number, tail in enumerate(layers.tails):
        followed = np.zeros(model.n_pairs, dtype=np.bool_)
        followed[tail[tail >= 0]] = True
        nearer = nearer_pairs(model, None, followed, ends=model.goal_mask)
        beyond[number] = model.goal_mask | (nearer >= 0)
    alive = np.empty((count + moves.room, model.n_states), dtype=np.bool_)
    alive[:count] = model.goal_mask
    for layer in range(count, len(alive)):
        alive[layer] = beyond[layers.tail_at(layer), np.arange(model.n_states)]
    end, several = count, max(_AT_ONCE // max(model.n_states, 1), 1)
    while end > 0:
        begin = max(end - several, 0) if end <= layers.even else end - 1
        moves.mark_backwards(begin, end, alive)
        end = begin
    return alive, beyond


def landed_chains(moves: LayerMoves, waiting: FloatArray) -> Iterator[tuple[Chain, FloatArray]]:
    """Yield each tail's chain with the mass that reaches it from the layers below the cap.

    Args:
        moves: the policy's moves.
        waiting: mass that ``LayerMoves.follow`` left in the ring buffer, [rows, states, columns].

    Yields:
        The chain, and the mass that enters it in each layer beyond the cap, [layers ahead, nodes,
        columns].

    Raises:
        ModelError: a tail has no decision in a state that it reaches.
    """
    model, count = moves.model, moves.layers.count + np.arange(moves.room)
    rows = count % moves.room
    held: BoolArray = np.any(waiting, axis=2)[rows]
    tail_at = np.stack([moves.layers.tail_at(layer) for layer in count.tolist()])
    for number, tail in enumerate(moves.layers.tails):
        own = held & (tail_at == number)
        reached = own.any(axis=0)
        if reached.any():
            chain = policy_chain(model, DeterministicPolicy(model, tail), reached.astype(float))
            entering = waiting[rows[:, None], chain.state]
            yield chain, np.where(own[:, chain.state, None], entering, 0.0)


LARGE = 300_000
"""Most nodes, states times layers, of a chain that is built explicitly."""

_NOTHING = np.zeros(0, dtype=np.int64)

_FEW_NODES = 1_000
"""Nodes up to which the chain of any policy is built, since its law is then computed quickly."""


def chain_of_law(
    model: SSP, policy: Policy, start: FloatArray, *, least_nodes: int = LARGE
) -> Chain:
    """Return a chain whose total cost has the law of a policy's total cost.

    It is the policy's own chain or, if that is large, a smaller one built from the law by layers.
    If the policy rounds costs up, the smaller chain has the law of the rounded costs.

    Args:
        model: the model.
        policy: policy on the model.
        start: distribution over states, [states].
        least_nodes: states times layers from which the smaller chain is always used.

    Raises:
        ModelError: the policy has no decision in a state that it reaches.
    """
    layers = policy.layers()
    moves = None if layers is None else LayerMoves(model, layers)
    if moves is not None and moves.is_soon_followed(least_nodes):
        law = _law_forwards(moves, start)
        if law is not None:
            return _block_chain_of_law(moves, *law)
    return policy_chain(model, policy, start)


def chains_of_law(
    model: SSP, policy: Policy, start: FloatArray, chain: Chain | None = None, *, soon: bool = False
) -> tuple[Chain, Chain]:
    """Return a chain with the law of a policy's total cost, and one with costs rounded up.

    The second chain rounds costs up as the layers of the policy do. Both chains are one object if
    the policy does not round costs up, or if the chain with true costs would be too large.

    Args:
        model: the model.
        policy: policy on the model.
        start: distribution over states, [states].
        chain: chain of the policy, if known.
        soon: never build a chain of many nodes with true costs.

    Raises:
        ModelError: the policy has no decision in a state that it reaches.
    """
    layers = policy.layers()
    if layers is None or not layers.rounds_up:
        own = chain or chain_of_law(model, policy, start)
        return own, own
    counted = chain_of_law(model, policy, start, least_nodes=0)
    many = soon or layers.count * model.n_states >= LARGE
    try:
        paid = chain or policy_chain(model, policy, start, _FEW_NODES if many else np.inf)
    except ModelError:
        return counted, counted
    return counted if many and len(paid.start) > _FEW_NODES else paid, counted


def _law_forwards(moves: LayerMoves, start: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Compute the law of a layered policy's total cost by following its mass forwards.

    Returns:
        The mass that reaches the goal in each layer below the cap, [layers], and the mass left
        beyond it, as ``LayerMoves.follow`` leaves it. None if a decision is missing, or if the
        policy does not round costs up and a cost is not an exact multiple of the unit.
    """
    layers, exact = moves.layers, moves.model.exact_costs
    if layers.unit is None:
        return None
    if not layers.rounds_up:
        unit, *costs = (exact_cost(cost, exact) for cost in (layers.unit, *layers.costs.tolist()))
        if any(c != k * unit for c, k in zip(costs, layers.leads(0).tolist(), strict=True)):
            return None
    waiting, goal = np.zeros((moves.room, len(start), 1)), np.zeros(layers.count)
    waiting[0, :, 0] = start
    if (together := moves.follow_evenly(waiting, np.zeros((2, len(start))))) is None:
        return None
    goal[: len(together)] = together[:, 0, 0]
    for layer, here, pairs, visits in moves.follow(waiting, first=len(together)):
        if (pairs == UNDECIDED).any():
            return None
        goal[layer] = visits[moves.model.goal_mask[here], 0].sum()
    return goal, waiting


def _block_chain_of_law(moves: LayerMoves, arrived: FloatArray, waiting: FloatArray) -> Chain:
    """Return a small chain whose total cost has the law of a layered policy.

    Its nodes are blocks of layers, the goal, and the nodes of the tails' chains. A block moves to
    the next block, or to the goal at the cost of one of its layers. The last block also moves to
    the tails beyond the cap. The start has only the mass that does not fail below the cap.

    Args:
        moves: the policy's moves.
        arrived: mass that reaches the goal in each layer, [layers].
        waiting: mass beyond the cap, as ``LayerMoves.follow`` leaves it.
    """
    model, layers, block = moves.model, moves.layers, moves.room  # about the longest move
    count, unit = -(-layers.count // block), layers.unit or 0.0
    own, tails, first = np.zeros(count + 1), list[Chain](), count + 1
    reached = np.flatnonzero(arrived)
    links = [(reached // block, np.full(reached.size, count), arrived[reached], reached)]
    ends = list[tuple[IntArray, IntArray]]()  # of the moves of each tail: source, target
    for chain, entering in landed_chains(moves, waiting):
        if layers.rounds_up:
            passed = np.ceil(chain.cost / unit * (1.0 - SAME_TOTAL)).astype(np.int64)
            chain = replace(chain, cost=totals_of(passed, exact_cost(unit)))
        ahead, node = np.nonzero(entering[:, :, 0])
        last = np.full(ahead.size, count - 1)
        links.append((last, first + node, entering[ahead, node, 0], layers.count + ahead))
        ends.append((chain.source + first, chain.target + first))
        tails.append(chain)
        first += chain.n_nodes
    taken = sum(np.bincount(link[0], weights=link[2], minlength=count) for link in links)
    left = np.cumsum(np.asarray(taken)[::-1])[::-1]  # from each block on
    onward = np.flatnonzero(left[1:])
    links.append((onward, onward + 1, left[1:][onward], (onward + 1) * block))
    source, target, mass, layer = (np.concatenate(part) for part in zip(*links, strict=True))
    ahead = layer - source * block
    paid = totals_of(ahead, exact_cost(unit)) if layers.rounds_up else ahead * unit
    state = np.append(np.full(count, np.argmin(model.goal_mask)), np.argmax(model.goal_mask))
    state, start = np.concatenate([state, *(c.state for c in tails)]), np.zeros(first)
    start[0] = left[0]
    return Chain(
        model=model,
        state=read_only(state),
        memory=read_only(np.zeros(len(state), dtype=np.int64)),
        start=read_only(start),
        give_up=read_only(np.concatenate([own, *(c.give_up for c in tails)])),
        dead=read_only(np.concatenate([own, *(c.dead for c in tails)])),
        source=np.concatenate([source, *(begin for begin, _ in ends)]),
        target=np.concatenate([target, *(end for _, end in ends)]),
        probability=np.concatenate([mass / left[source], *(c.probability for c in tails)]),
        cost=np.concatenate([paid, *(c.cost for c in tails)]),
        outcome=_NOTHING,
        branch_node=_NOTHING,
        branch_pair=_NOTHING,
        branch_probability=np.zeros(0),
    )
