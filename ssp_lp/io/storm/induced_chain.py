"""The Markov chain that a policy makes of its model, as a model of one action."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

import numpy as np

from ssp_lp.analysis.chain import Chain, policy_chain, reaching_in_chain
from ssp_lp.arrays import FloatArray, IntArray, offsets_of
from ssp_lp.io.model_files.exported import GOAL
from ssp_lp.io.model_files.raw_model import ModelFile
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.policies import MixedPolicy, Policy
from ssp_lp.policies.mixed import as_lottery
from ssp_lp.processes.failure_semantics import start_distribution

START, GAVE_UP = "start", "gave up"
"""States of the chain besides those of the policy: where its lottery is drawn, and its end."""

_Rows = tuple[IntArray, IntArray, FloatArray, FloatArray]
"""Source, target, probability and cost of each step."""


@explained
def induced_chain(
    policy: Policy | MixedPolicy, start: Hashable | Mapping[Hashable, float]
) -> ModelFile:
    """Make the Markov chain of a policy, whatever its memory, as a model with one action.

    Its states are (state, memory), where there is a lottery (member, state, memory); "start", from
    which a free step draws the member and the first state, and "gave up", where the policy gives
    up. A state from which the policy does not come to the goal is an end. Costs stay with their
    outcomes; labels of states are the model's, and "gave up". Any tool that reads the chain's file
    can check what is said of the policy: the chance of the goal is the policy's, and its expected
    total cost is the policy's cost until failure is certain (without that of a failing step).

    Args:
        policy: a policy or a lottery.
        start: a state, or ``{state: probability}``.

    Returns:
        The chain and its initial state, "start".

    Raises:
        ModelError: the start is wrong, or the policy has no decision in a state that it reaches.
    """
    model, lottery = policy.model, as_lottery(policy)
    begin = start_distribution(model, start)
    chains = [policy_chain(model, member, begin) for member in lottery.policies]
    firsts = offsets_of(np.array([chain.n_nodes for chain in chains]))
    n_states = int(firsts[-1]) + 2
    draw, end = n_states - 2, n_states - 1
    parts = [_start_of_chain(chains, lottery.weights, draw)]
    parts += [
        _rows_of_chain(chain, int(first), end) for chain, first in zip(chains, firsts, strict=False)
    ]
    source, target, chance, cost = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.argsort(source, kind="stable")
    acting, sizes = np.unique(source, return_counts=True)
    states = [*_names_in_chain(chains), START, GAVE_UP]
    goals = _nodes_in_chain(chains, firsts, np.flatnonzero(model.goal_mask))
    if not goals.size:  # a model has a goal, though this one is not reached
        states.append(GOAL)
        goals = np.array([n_states])
        n_states += 1
    chain = SSP.from_arrays(
        pair_offsets=offsets_of(np.bincount(acting, minlength=n_states)),
        outcome_offsets=offsets_of(sizes),
        successors=target[order],
        probabilities=chance[order],
        costs=cost[order],
        goal_states=goals,
        states=states,
        state_labels={
            name: [states[i] for i in _nodes_in_chain(chains, firsts, at)]
            for name, at in model.state_labels.items()
        }
        | {GAVE_UP: [GAVE_UP]},
        exact_costs=model.exact_costs,
        treat_actionless_as_dead_ends=True,
        normalise=True,
    )
    return ModelFile(chain, (START,))


def _start_of_chain(chains: list[Chain], weights: FloatArray, draw: int) -> _Rows:
    """The free step that draws the lottery and the first state."""
    chance = np.concatenate([w * chain.start for w, chain in zip(weights, chains, strict=True)])
    target = np.flatnonzero(chance > 0.0)
    return np.full(target.size, draw), target, chance[target], np.zeros(target.size)


def _rows_of_chain(chain: Chain, first: int, end: int) -> _Rows:
    """The steps of one member's chain while the goal is in reach, the last of them giving up."""
    hopeful = reaching_in_chain(chain, chain.goal > 0.0)
    quits = np.flatnonzero((chain.give_up > 0.0) & hopeful)
    moves = np.flatnonzero(hopeful[chain.source])
    return (
        np.concatenate([chain.source[moves], quits]) + first,
        np.concatenate([chain.target[moves] + first, np.full(quits.size, end)]),
        np.concatenate([chain.probability[moves], chain.give_up[quits]]),
        np.concatenate([chain.cost[moves], np.zeros(quits.size)]),
    )


def _names_in_chain(chains: list[Chain]) -> list[Hashable]:
    """(state, memory) of each node, with the member's number before where there are several."""
    states = chains[0].model.states
    nodes = [zip(chain.state.tolist(), chain.memory.tolist(), strict=True) for chain in chains]
    if len(chains) == 1:
        return [(states[state], memory) for state, memory in nodes[0]]
    return [(k, states[state], memory) for k, some in enumerate(nodes) for state, memory in some]


def _nodes_in_chain(chains: list[Chain], firsts: IntArray, states: IntArray) -> IntArray:
    """The nodes at some of the model's states, [members]."""
    found = [
        np.flatnonzero(np.isin(chain.state, states)) + first
        for chain, first in zip(chains, firsts, strict=False)
    ]
    return np.concatenate(found)
