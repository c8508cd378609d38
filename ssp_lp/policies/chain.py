"""The Markov chain of a policy on a model: its nodes are (state, memory)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    entries_of,
    offsets_of,
    read_only,
    sorted_unique,
)
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.dynamic_programming.evaluation import evaluate_chain
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends, reached_along
from ssp_lp.policies.policy import GIVE_UP, GIVE_UP_CODE, MixedPolicy, Policy
from ssp_lp.policies.table import Decisions, Member, PolicyTable

_Step = tuple[IntArray, IntArray, FloatArray, FloatArray, IntArray, IntArray, IntArray, FloatArray]

_MOST_KEYS = 2_000_000_000
_MANY_ROUNDS = 64  # least number of rounds after which all possible nodes are searched at once
_PAIRS_IN_ROUND = 6_000  # memories times pairs that are searched in the time of one round
_FEW_NODES = 1_000_000  # most memories times pairs that are searched at once


@dataclass(frozen=True, eq=False)
class Chain:
    """The Markov chain of a policy, as far as it is reached from the start.

    Nodes are pairs (state, memory), sorted by memory, then by state. A branch is a possible
    decision at a node. A move is one outcome of a branch; moves with equal target are not merged,
    so that each has one cost. The chain ends at goals, in dead-ends and when the policy gives up.
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
    outcome: IntArray  # [moves] of the model, for other costs of the same outcomes
    branch_node: IntArray  # [branches]
    branch_pair: IntArray  # [branches] pair or GIVE_UP_CODE
    branch_probability: FloatArray  # [branches]
    _systems: dict[tuple[float, bytes], tuple[IntArray, System]] = field(
        default_factory=dict, init=False
    )  # equations by survival and nodes
    _arriving: dict[float, tuple[FloatArray, FloatArray]] = field(default_factory=dict, init=False)

    @property
    def n_nodes(self) -> int:
        """Number of (state, memory) nodes of the policy's chain."""
        return len(self.state)

    @cached_property
    def goal(self) -> FloatArray:
        """1 at goals of the policy's chain, 0 elsewhere, [nodes]."""
        return self.model.goal_mask[self.state].astype(np.float64)

    @cached_property
    def alive(self) -> BoolArray:
        """Nodes, goals excluded, from which the chain may reach the goal, [nodes]."""
        return np.asarray(self.reaching(self.goal > 0) & (self.goal == 0))

    @cached_property
    def settling(self) -> BoolArray:
        """Nodes from which the chain may end: at goals, dead-ends, or by giving up, [nodes]."""
        return self.reaching((self.goal > 0) | (self.dead > 0) | (self.give_up > 0))

    @cached_property
    def matrix(self) -> sp.csr_array:
        """Transition matrix of the chain, [nodes, nodes]; rows of goals and dead-ends are empty."""
        n = self.n_nodes
        return sp.csr_array((self.probability, (self.source, self.target)), shape=(n, n))

    def per_node(self, move_values: FloatArray) -> FloatArray:
        """Return the mean of ``move_values`` over the moves out of each node, [nodes].

        The mean is weighted by the probabilities of the moves; values are given for each move,
        [moves].
        """
        return np.bincount(
            self.source, weights=self.probability * move_values, minlength=self.n_nodes
        ).astype(np.float64)

    def ahead(self, values: FloatArray) -> FloatArray:
        """Return for each node the mean of ``values`` at the next node, [nodes] or [nodes, ...]."""
        return np.asarray(self.matrix @ values)

    def reaching(self, ends: BoolArray) -> BoolArray:
        """Return a mask of the nodes from which the chain may reach a node of ``ends``, [nodes]."""
        backward = self.matrix.tocsc()
        return reached_along(backward.indices, backward.indptr, np.flatnonzero(ends))

    def accumulate(
        self, reward: FloatArray, inside: BoolArray, survival: float = 1.0
    ) -> FloatArray:
        """Return the expected total reward from each node until the run leaves ``inside``.

        Args:
            reward: reward of each visit, [nodes] or [nodes, rewards].
            inside: mask of the nodes at which rewards are counted, [nodes]. A run must leave them
                with probability 1.
            survival: discount factor of every move.

        Returns:
            The expected totals, in the shape of ``reward``; 0 at nodes that are not in ``inside``.
            ``evaluate_chain`` checks the residuals.
        """
        result = np.zeros_like(reward)
        nodes, system = self._system(inside, survival)
        if nodes.size:
            own = reward[nodes].reshape(nodes.size, -1)
            result[nodes] = evaluate_chain(system, own).values.reshape(reward[nodes].shape)
        return result

    def arriving(self, survival: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """Return from each node the goal probability, and E[further cost; goal], [nodes] each.

        The second array is the expected cost from the node on, counted only in runs that reach the
        goal.

        Args:
            survival: discount factor of every move; the cost of the last move is not discounted.
        """
        if survival not in self._arriving:
            hits = self.per_node(self.goal[self.target])
            goal = survival * self.accumulate(hits, self.alive, survival) + self.goal
            paid = self.per_node(goal[self.target] * self.cost)
            cost = self.accumulate(paid, self.alive, survival)
            self._arriving[survival] = read_only(goal), read_only(cost)
        return self._arriving[survival]

    def visits(self, survival: float = 1.0) -> FloatArray:
        """Return the chain's expected visits of each node, discounted by ``survival``, [nodes].

        Raises:
            ModelError: the policy may wander for ever, so that visits are infinite.
        """
        if survival == 1.0 and not self.settling.all():
            raise ModelError("visits are infinite: the policy may wander for ever; let it give up")
        everywhere = np.ones(self.n_nodes, dtype=np.bool_)
        return self._system(everywhere, survival)[1].solve_transposed(self.start)

    def flows(self, survival: float = 1.0) -> FloatArray:
        """Return the expected number of times that each branch is taken, [branches].

        Raises:
            ModelError: as in :meth:`visits`.
        """
        return self.visits(survival)[self.branch_node] * self.branch_probability

    def _system(self, inside: BoolArray, survival: float) -> tuple[IntArray, System]:
        """Return the indices of the nodes in ``inside``, and their system of equations (cached)."""
        key = survival, inside.tobytes()
        if key not in self._systems:
            some = np.flatnonzero(inside)
            rows = self.matrix if some.size == self.n_nodes else self.matrix[some]
            own = sp.csr_array(rows[:, some] * survival)
            ending = (self.goal + self.dead)[some] > 0.0
            leaving = (1.0 - survival) + survival * self.give_up[some]
            leaving += rows @ np.where(inside, 0.0, survival)
            self._systems[key] = some, System(own, np.where(ending, 1.0, leaving))
        return self._systems[key]

    def decisions(self) -> Decisions:
        """Return the decisions of the policy's chain, those nearest to the start first."""
        begins = sp.csr_array((self.start[None, :] > 0.0).astype(np.float64))
        edges = sp.vstack([sp.hstack([self.matrix, sp.csr_array((self.n_nodes, 1))]),
                           sp.hstack([begins, sp.csr_array((1, 1))])], format="csr")  # fmt: skip
        reached = sp.csgraph.breadth_first_order(edges, self.n_nodes, return_predecessors=False)
        place = np.full(self.n_nodes + 1, self.n_nodes)
        place[reached] = np.arange(len(reached))
        order = np.argsort(place[self.branch_node], kind="stable")
        node = self.branch_node[order]
        return Decisions(
            self.state[node],
            self.memory[node],
            self.branch_pair[order],
            self.branch_probability[order],
        )


def reached_table(
    policy: MixedPolicy, start: FloatArray, most_nodes: float = np.inf
) -> PolicyTable:
    """Return a table of the decisions that a lottery reaches, nearest to the start first.

    Args:
        policy: the lottery.
        start: distribution over states, [states].
        most_nodes: greatest number of nodes of a member's chain.

    Raises:
        ModelError: a member is of a class with unknown memory, or has no decision in a state that
            it reaches; or its chain has too many nodes.
    """
    model = policy.model
    members = []
    for weight, member in policy.weighted:
        reached = policy_chain(model, member, start, most_nodes).decisions()
        words = dict(member.memories())
        members.append(Member(weight, member.remembers, words, partial(iter, (reached,))))
    return PolicyTable(model, tuple(members), GIVE_UP)


def policy_chain(
    model: SSP, policy: Policy, start: FloatArray, most_nodes: float = np.inf
) -> Chain:
    """Follow a policy from the start and build its chain.

    Args:
        model: the model.
        policy: policy on the model.
        start: distribution over states, [states].
        most_nodes: greatest number of nodes.

    Raises:
        ModelError: the policy has no decision in a state that it reaches, its memory grows without
            end, or its chain has too many nodes.
    """
    ended, first = policy.ended, np.flatnonzero(start > 0)
    dead = dead_ends(model) & ended
    memory = np.where(ended[first], 0, policy.start_memory(first))
    start_key = memory * model.n_states + first
    visited, waves, reached = np.zeros(model.n_states, dtype=np.bool_), list[_Step](), 0
    frontier = sorted_unique(start_key)
    size = policy.memory_size
    turn = max(_MANY_ROUNDS, (size or 0) * model.n_pairs // _PAIRS_IN_ROUND)
    if size == 1:
        frontier = _reachable_nodes(model, policy, frontier, ended, 1)
    while frontier.size:
        check_time()
        if len(waves) == turn and size is not None and size * model.n_pairs <= _FEW_NODES:
            visited = np.pad(visited, (0, max(size * model.n_states - visited.size, 0)))
            frontier = _reachable_nodes(model, policy, frontier, ended, size)
            frontier = frontier[~visited[frontier]]
        reached += frontier.size
        if reached > most_nodes and size != 1:
            raise ModelError(f"the policy's chain has more than {most_nodes:,} nodes")
        step = _expand_chain(model, policy, frontier, ended, size)
        policy.check_decided(step[6], step[5] % model.n_states)
        waves.append(step)
        if (last := max(int(frontier[-1]), int(step[1].max(initial=0)))) >= _MOST_KEYS:
            raise ModelError("the policy's chain is too large: its memory grows without end")
        if last >= visited.size:
            visited = np.pad(visited, (0, max(last + 1 - visited.size, visited.size)))
        visited[frontier] = True
        frontier = sorted_unique(step[1][~visited[step[1]]])

    # from keys to indices of the nodes
    source, target, chance, cost, outcome, node, pair, weight = [
        np.concatenate(part) for part in zip(*waves, strict=True)
    ]
    known = np.flatnonzero(visited)
    position = np.zeros(visited.size, dtype=np.int32)
    position[known] = np.arange(known.size)
    memory, state = np.divmod(known, model.n_states)
    begin = np.bincount(position[start_key], weights=start[first], minlength=known.size)
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
    )


def _reachable_nodes(
    model: SSP, policy: Policy, start: IntArray, ended: BoolArray, size: int
) -> IntArray:
    """Return the keys of the nodes that a policy reaches, by one search over all possible nodes.

    The key of the node (state, memory) is memory * n_states + state.

    Args:
        model: the model.
        policy: policy on the model.
        start: keys of the nodes in which the search begins.
        ended: states in which an episode is over, [states].
        size: number of values of the policy's memory.
    """
    every = np.arange(size * model.n_states)
    source, target = _expand_chain(model, policy, every, ended, size)[:2]
    offsets = offsets_of(np.bincount(source, minlength=every.size))
    return np.flatnonzero(reached_along(target, offsets, start))


def _expand_chain(
    model: SSP, policy: Policy, keys: IntArray, ended: BoolArray, size: int | None
) -> _Step:
    """Return the moves and the branches out of some nodes, as arrays of their fields in Chain.

    Nodes are given and returned by their keys, memory * n_states + state.
    """
    memory, state = np.divmod(keys, model.n_states)
    acting = ~ended[state]
    keys, memory, state = keys[acting], memory[acting], state[acting]
    branch = policy.branches(state, memory)
    moves = np.flatnonzero(branch.pair >= 0)
    outcome, count = entries_of(model.outcome_offsets, branch.pair[moves])
    taken = np.repeat(moves, count)  # branch of each outcome
    chance = branch.probability[taken] * model.probabilities[outcome]
    possible = chance > 0.0
    taken, outcome, chance = taken[possible], outcome[possible], chance[possible]
    kept = memory[branch.situation] if branch.memory is None else branch.memory
    successor, after = model.successors[outcome].astype(np.int64), kept[taken]
    if size != 1:
        after = policy.remember_outcomes(after, branch.pair[taken], outcome)
    target = np.where(ended[successor], 0, after) * model.n_states + successor
    source = keys[branch.situation]
    return (source[taken], target, chance, model.costs[outcome], outcome,
            source, branch.pair, branch.probability)  # fmt: skip
