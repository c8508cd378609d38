"""A small chain with the law of a policy that remembers its cost: its layers made a few nodes.

Below the cap the cost paid is the layer, so that all that a law needs of a layer is how much mass
arrives at the goal with it. One sweep forwards finds that, layer by layer. What reaches the cap
goes on by the policy's tails, whose chains are written out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import scipy.sparse as sp

from ssp_lp.analysis.chain import Chain, policy_chain
from ssp_lp.analysis.layers.layer_moves import LayerMoves, Staying, closed_states
from ssp_lp.analysis.layers.layered_measures import LARGE
from ssp_lp.arrays import SAME_TOTAL, FloatArray, IntArray, read_only
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.model import SSP
from ssp_lp.policies.policy import UNDECIDED, CostLayers, Policy
from ssp_lp.policies.stationary import DeterministicPolicy
from ssp_lp.processes.totals.lattice import exact_cost, totals_of

_NOTHING = np.zeros(0, dtype=np.int64)


def chain_of_law(
    model: SSP, policy: Policy, start: FloatArray, *, least_nodes: int = LARGE
) -> Chain:
    """A chain with the law of a policy's total cost: its own, or a smaller one where that is large.

    The smaller one of a policy that rounds costs up has the law of the rounded costs.

    Args:
        model: the model.
        policy: on the model.
        start: distribution over states, [states].
        least_nodes: states times layers from which a policy is not written out.

    Raises:
        ModelError: the policy has no decision in a state that it reaches.
    """
    layers = policy.layers()
    if (
        layers is None
        or layers.count * model.n_states < least_nodes
        or not _is_exact_law(model, layers)
    ):
        return policy_chain(model, policy, start)
    found = _law_forwards(LayerMoves(model, layers), start)
    return (
        policy_chain(model, policy, start) if found is None else _spine_of_law(model, layers, found)
    )


def _is_exact_law(model: SSP, layers: CostLayers) -> bool:
    """Whether every cost is a whole number of layers, and not only as a float, or made one."""
    if layers.unit is None or layers.rounds_up:
        return layers.rounds_up
    unit, steps = _exact_cost_of_law(model, layers.unit), layers.leads(0).tolist()
    costs = layers.costs.tolist()
    return all(_exact_cost_of_law(model, c) == k * unit for c, k in zip(costs, steps, strict=True))


def _exact_cost_of_law(model: SSP, cost: float) -> Fraction:
    """A cost of the law's chain as the fraction that it is."""
    return model.exact_costs.get(cost, exact_cost(cost))


@dataclass(frozen=True, eq=False)
class _Arrived:
    """What one sweep forwards finds."""

    goal: FloatArray  # [layers] mass that arrives at the goal, the layers beyond the cap included
    landed: FloatArray  # [layers beyond the cap, states] mass that goes on there


def _law_forwards(moves: LayerMoves, start: FloatArray) -> _Arrived | None:
    """Follow the law's mass layer by layer; None where a decision is missing."""
    layers, room = moves.layers, moves.layers.width
    goals = np.flatnonzero(moves.model.goal_mask)
    waiting, goal = np.zeros((room, len(start))), np.zeros(layers.count + room)
    waiting[0], everywhere = start, np.arange(len(start))
    for layer in range(layers.count + room):
        mass = waiting[layer % room]
        if layer < layers.count:
            pairs, leads = moves.pairs(layer, everywhere), layers.leads(layer)
            if (mass[pairs == UNDECIDED] > 0.0).any():
                return None
            staying = moves.staying(everywhere, pairs, np.where(leads > 0, 0, -1))
            if staying is not None:
                mass = _visits_within_law(staying, pairs, mass)
            moves.send(mass, pairs, np.where(leads > 0, (layer + leads) % room, -1), waiting)
            goal[layer] = mass[goals].sum()
            waiting[layer % room] = 0.0
        else:
            goal[layer] = mass[goals].sum()
            waiting[layer % room, ~moves.acting] = 0.0
    order = (layers.count + np.arange(room)) % room
    return _Arrived(goal, waiting[order])


def _spine_of_law(model: SSP, layers: CostLayers, found: _Arrived) -> Chain:
    """One node of the law's chain per block of layers below the cap, then the tails.

    A node goes on to the next block, or to the goal at the cost of each layer of its own; the last
    one to where the mass lands beyond the cap. Mass that fails below the cap never starts.
    """
    block = len(found.landed)  # as many layers as a step may pass: no move is much longer
    count, last = -(-layers.count // block), (layers.count - 1) // block
    tail_at = np.stack([layers.tail_at(layers.count + k) for k in range(block)])
    parts, first = list[tuple[int, Chain]](), count + 1
    moves = list[tuple[IntArray, IntArray, FloatArray, IntArray]]()  # from, to, mass, layer
    for number, tail in enumerate(layers.tails):
        entering = np.where(tail_at == number, found.landed, 0.0)
        total = entering.sum(axis=0)
        if not (total > 0.0).any():
            continue
        chain = policy_chain(model, DeterministicPolicy(model, tail), total)
        if layers.rounds_up and layers.unit is not None:
            chain = replace(chain, cost=_rounded_up(chain.cost, layers.unit))
        place = np.full(model.n_states, -1, dtype=np.int64)
        place[chain.state] = np.arange(first, first + chain.n_nodes)
        ahead, state = np.nonzero(entering)
        source = np.full(len(ahead), last)
        moves.append((source, place[state], entering[ahead, state], layers.count + ahead))
        parts.append((first, chain))
        first += chain.n_nodes
    arriving = np.flatnonzero(found.goal[1:] > 0.0) + 1
    source = np.minimum(arriving // block, last)
    moves.append((source, np.full(len(arriving), count), found.goal[arriving], arriving))
    taken = np.zeros(count)
    for source, _, mass, _ in moves:
        np.add.at(taken, source, mass)
    left = np.cumsum(taken[::-1])[::-1]  # from each block on
    every = np.arange(count - 1)
    moves.append((every, every + 1, left[1:], (every + 1) * block))
    mass = np.concatenate([part[2] for part in moves])
    kept = np.flatnonzero(mass > 0.0)
    source, target, there = (np.concatenate([part[i] for part in moves])[kept] for i in (0, 1, 3))
    unit, ahead = float(layers.unit or 0.0), there - source * block
    paid = totals_of(ahead, exact_cost(unit)) if layers.rounds_up else ahead * unit
    own = source, target, np.asarray(mass[kept] / left[source]), np.asarray(paid)
    return _joined_chain_of_law(model, own, parts, count, float(left[0]), float(found.goal[0]))


def _rounded_up(costs: FloatArray, unit: float) -> FloatArray:
    """Costs of the law as whole multiples of a unit, rounded once each, like ``costs``."""
    layers = np.ceil(costs / unit * (1.0 - SAME_TOTAL)).astype(np.int64)
    return totals_of(layers, exact_cost(unit))


def _joined_chain_of_law(
    model: SSP,
    own: tuple[IntArray, IntArray, FloatArray, FloatArray],
    parts: list[tuple[int, Chain]],
    count: int,
    begins: float,
    arrived: float,
) -> Chain:
    """The spine's nodes, the goal, and the tails' chains, as one chain."""
    acting = int(np.argmin(model.goal_mask))
    goal = int(np.argmax(model.goal_mask))
    state = np.concatenate([np.full(count, acting), [goal], *(c.state for _, c in parts)])
    start = np.zeros(len(state))
    start[0], start[count] = begins, arrived
    nothing, chains = np.zeros(count + 1), [chain for _, chain in parts]
    source, target, probability, cost = own
    return Chain(
        model=model,
        state=read_only(state),
        memory=read_only(np.zeros(len(state), dtype=np.int64)),
        start=read_only(start),
        give_up=read_only(np.concatenate([nothing, *(c.give_up for c in chains)])),
        dead=read_only(np.concatenate([nothing, *(c.dead for c in chains)])),
        source=np.concatenate([source, *(c.source + first for first, c in parts)]),
        target=np.concatenate([target, *(c.target + first for first, c in parts)]),
        probability=np.concatenate([probability, *(c.probability for c in chains)]),
        cost=np.concatenate([cost, *(c.cost for c in chains)]),
        outcome=_NOTHING,
        branch_node=_NOTHING,
        branch_pair=_NOTHING,
        branch_probability=np.zeros(0),
    )


def _visits_within_law(staying: Staying, pairs: IntArray, mass: FloatArray) -> FloatArray:
    """Expected visits within a layer, given what enters it, [states]."""
    inside = (pairs >= 0) & ~closed_states(staying.share, staying.onward, pairs >= 0)
    nodes, others = np.flatnonzero(inside), np.flatnonzero(~inside)
    rows = staying.share[nodes]
    exits = staying.onward[nodes] + rows @ (~inside).astype(np.float64)
    visits = mass.copy()
    visits[nodes] = System(sp.csr_array(rows[:, nodes]), exits).solve_transposed(mass[nodes])
    visits[others] += sp.csr_array(rows[:, others]).T @ visits[nodes]
    return visits
