"""The Markov chain that a policy makes of a model: the nodes are (state, memory)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    concatenated_ranges,
    read_only,
    sorted_unique,
)
from ssp_lp.errors import ModelError
from ssp_lp.linear import accumulate, without_self_loops
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Policy

_MOST_KEYS = 2_000_000_000


@dataclass(frozen=True, eq=False)
class Chain:
    """The part of a policy's chain that is reached from the start, sorted by memory and state.

    Nodes at goals and dead-ends and decisions to give up end it. ``move`` holds each node's steps
    once per outcome, so that costs stay attached to their outcomes.
    """

    model: SSP
    state: IntArray  # [nodes]
    memory: IntArray  # [nodes]
    start: FloatArray  # [nodes]
    give_up: FloatArray  # [nodes] probability of giving up at once
    dead: FloatArray  # [nodes] 1 at dead-ends
    source: IntArray  # [moves] node
    target: IntArray  # [moves] node
    probability: FloatArray  # [moves]
    cost: FloatArray  # [moves]
    outcome: IntArray  # [moves] of the model: by it costs can be exchanged
    branch_node: IntArray  # [branches]
    branch_pair: IntArray  # [branches] pair or GIVE_UP_CODE
    branch_probability: FloatArray  # [branches]
    layered: bool  # memory never decreases

    @property
    def n_nodes(self) -> int:
        """Number of (state, memory) nodes."""
        return len(self.state)

    @cached_property
    def goal(self) -> FloatArray:
        """1 at goals, [nodes]."""
        return self.model.goal_mask[self.state].astype(np.float64)

    @cached_property
    def matrix(self) -> sp.csr_array:
        """Transition probabilities, [nodes, nodes]; rows of goals and dead-ends are empty."""
        n = self.n_nodes
        return sp.csr_array((self.probability, (self.source, self.target)), shape=(n, n))

    def per_node(self, move_values: FloatArray) -> FloatArray:
        """Expected value of the next move from each node, [nodes]."""
        return np.bincount(
            self.source, weights=self.probability * move_values, minlength=self.n_nodes
        ).astype(np.float64)

    def accumulate(
        self, reward: FloatArray, inside: BoolArray, survival: float = 1.0
    ) -> FloatArray:
        """Expected total reward from each node while the chain moves within ``inside``.

        Blocks of equal memory are solved last first, since no move leads back to an earlier one.

        Args:
            reward: [nodes] or [nodes, rewards]; counted at nodes of ``inside`` only.
            inside: nodes, from all of which the chain leaves for good, [nodes].
            survival: factor of every move.

        Returns:
            Like ``reward``; zero outside.
        """
        result = np.zeros_like(reward)
        matrix = self.matrix
        for begin, end, moves_inside in self._blocks:
            block = _rows(matrix, begin, end)
            ahead = reward[begin:end] + survival * (block @ result)
            here = inside[begin:end]
            if moves_inside and here.any():
                nodes = np.flatnonzero(here)
                own, departs = self._own(block, begin, nodes, survival)
                scaled = (ahead[nodes].T / departs).T
                result[begin + nodes] = accumulate(own, scaled)
            else:
                result[begin:end][here] = ahead[here]
        return result

    def push(self, inflow: FloatArray, survival: float = 1.0) -> FloatArray:
        """Expected visits of each node, given what enters each from outside, [nodes]."""
        visits = np.array(inflow, dtype=np.float64)
        matrix = self.matrix
        for begin, end, moves_inside in reversed(self._blocks):
            block = _rows(matrix, begin, end)
            if moves_inside:
                own, departs = self._own(block, begin, np.arange(end - begin), survival)
                visits[begin:end] = accumulate(sp.csr_array(own.T), visits[begin:end]) / departs
            onward = survival * (block.T @ visits[begin:end])
            onward[begin:end] = 0.0
            visits += onward
        return visits

    def _own(
        self, block: sp.csr_array, begin: int, nodes: IntArray, survival: float
    ) -> tuple[sp.csr_array, FloatArray]:
        """Moves among nodes of a block seen on departing only, and the mass that departs."""
        own = sp.csr_array(block[nodes][:, begin + nodes] * survival)
        own.sum_duplicates()
        own.eliminate_zeros()
        outside = np.ones(self.n_nodes)
        outside[begin + nodes] = 0.0
        leak = survival * (block[nodes] @ outside) + (1.0 - survival)
        leak += survival * self.give_up[begin + nodes]
        return without_self_loops(own, np.arange(nodes.size), leak)

    @cached_property
    def _blocks(self) -> list[tuple[int, int, bool]]:
        """Ranges of nodes with equal memory, last first, and whether they move inside."""
        n = self.n_nodes
        if not self.layered:
            return [(0, n, True)]
        cuts = np.flatnonzero(np.diff(self.memory, prepend=-1, append=-1))
        stays = self.memory[self.source] == self.memory[self.target]
        busy = np.zeros(n + 1, dtype=np.bool_)
        busy[self.source[stays]] = True
        ranges = zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)
        return [(b, e, bool(busy[b:e].any())) for b, e in reversed(list(ranges))]


def _rows(matrix: sp.csr_array, begin: int, end: int) -> sp.csr_array:
    """A block of rows, sharing the matrix's data."""
    first, last = matrix.indptr[begin], matrix.indptr[end]
    return sp.csr_array(
        (
            matrix.data[first:last],
            matrix.indices[first:last],
            matrix.indptr[begin : end + 1] - first,
        ),
        shape=(end - begin, matrix.shape[1]),
    )


def policy_chain(model: SSP, policy: Policy, start: FloatArray) -> Chain:
    """Follow a policy from the start and build its chain.

    Args:
        start: distribution over states, [states].

    Raises:
        ModelError: the policy has no decision in a state that it reaches, or its memory grows
            without end.
    """
    dead = dead_ends(model)
    ended = dead | model.goal_mask
    first = np.flatnonzero(start > 0)
    memory = np.where(ended[first], 0, policy.start_memory(first))
    start_key = memory * model.n_states + first
    visited = np.zeros(0, dtype=np.bool_)
    frontier, found = sorted_unique(start_key), []
    while frontier.size:
        visited = _marked(visited, frontier)
        step = _expand(model, policy, frontier, ended)
        found.append(step)
        visited = _grown(visited, int(step[1].max(initial=0)))
        frontier = sorted_unique(step[1][~visited[step[1]]])
    return _assemble(model, visited, start_key, start[first], dead, found, policy.monotone)


def _marked(visited: BoolArray, keys: IntArray) -> BoolArray:
    visited = _grown(visited, int(keys[-1]))
    visited[keys] = True
    return visited


def _grown(visited: BoolArray, key: int) -> BoolArray:
    if key < visited.size:
        return visited
    if key >= _MOST_KEYS:
        raise ModelError("the policy's chain is too large: its memory does not settle")
    wider = np.zeros(max(key + 1, 2 * visited.size), dtype=np.bool_)
    wider[: visited.size] = visited
    return wider


Step = tuple[IntArray, IntArray, FloatArray, FloatArray, IntArray, IntArray, IntArray, FloatArray]


def _expand(model: SSP, policy: Policy, keys: IntArray, ended: BoolArray) -> Step:
    """Moves and branches out of the given nodes, all as keys."""
    memory, state = np.divmod(keys, model.n_states)
    acting = ~ended[state]
    keys, memory, state = keys[acting], memory[acting], state[acting]
    branch = policy.branches(state, memory)
    if (branch.pair == UNDECIDED).any():
        where = int(branch.situation[int(np.argmax(branch.pair == UNDECIDED))])
        raise ModelError(f"the policy has no decision in state {model.states[int(state[where])]!r}")
    moves = branch.pair != GIVE_UP_CODE
    pair, situation = branch.pair[moves], branch.situation[moves]
    begin = model.outcome_offsets[pair]
    count = model.outcome_offsets[pair + 1] - begin
    outcome = concatenated_ranges(begin, count)
    chance = np.repeat(branch.probability[moves], count) * model.probabilities[outcome]
    situation, outcome = np.repeat(situation, count)[chance > 0], outcome[chance > 0]
    successor = model.successors[outcome].astype(np.int64)
    cost = model.costs[outcome]
    after = policy.remember(memory[situation], successor, cost)
    after = np.where(ended[successor], 0, after)
    target = after * model.n_states + successor
    return (keys[situation], target, chance[chance > 0], cost, outcome,
            keys[branch.situation], branch.pair, branch.probability)  # fmt: skip


def _assemble(
    model: SSP,
    visited: BoolArray,
    start_key: IntArray,
    start: FloatArray,
    dead: BoolArray,
    found: list[Step],
    layered: bool,
) -> Chain:
    source, target, chance, cost, outcome, node, pair, weight = (
        np.concatenate([step[i] for step in found]) for i in range(8)
    )
    known = np.flatnonzero(visited)
    position = np.zeros(visited.size, dtype=np.int32)
    position[known] = np.arange(known.size)
    memory, state = np.divmod(known, model.n_states)
    begin = np.bincount(position[start_key], weights=start, minlength=known.size)
    node = position[node]
    gives_up = pair == GIVE_UP_CODE
    give_up = np.bincount(node[gives_up], weights=weight[gives_up], minlength=known.size)
    return Chain(
        model=model,
        state=read_only(state),
        memory=read_only(memory),
        start=read_only(begin),
        give_up=read_only(give_up.astype(np.float64)),
        dead=read_only(dead[state].astype(np.float64)),
        source=position[source],
        target=position[target],
        probability=chance,
        cost=cost,
        outcome=outcome,
        branch_node=node,
        branch_pair=pair,
        branch_probability=weight,
        layered=layered,
    )


def reaching(chain: Chain, ends: BoolArray) -> BoolArray:
    """Nodes from which the chain may come to one of the given nodes, [nodes]."""
    mask = ends.copy()
    backward = chain.matrix.tocsc()
    frontier: IntArray = np.flatnonzero(mask)
    while frontier.size:
        begin = backward.indptr[frontier]
        before = backward.indices[concatenated_ranges(begin, backward.indptr[frontier + 1] - begin)]
        frontier = sorted_unique(before[~mask[before]])
        mask[frontier] = True
    return mask
