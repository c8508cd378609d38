"""The live part of a model: states that are neither goals nor dead-ends, grouped into nodes.

A node is one live state, or a maximal end component of pairs that cost nothing: moving about in
such a component is free, so an exact process treats it as one place (DESIGN, section 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, segment_sums
from ssp_lp.linear import without_self_loops
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends, end_components
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Nodes and the pairs by which they can be left, in the order of the nodes."""

    model: SSP
    dead: BoolArray  # [states] dead-ends
    node_of: IntArray  # [states] node, -1 at goals and dead-ends
    n_nodes: int
    inside: BoolArray  # [model pairs] pairs that stay in a collapsed component
    merged: BoolArray  # [states] members of collapsed components
    pair_at: IntArray  # [pairs] pair of the model, or GIVE_UP_CODE for giving up
    pair_node: IntArray  # [pairs] increasing
    pair_offsets: IntArray  # [nodes + 1]

    @cached_property
    def outcomes(self) -> sp.csr_array:
        """Probability of going from each pair to each node, [pairs, nodes]."""
        return self.matrix(self.model.probabilities, np.zeros(self.model.n_outcomes, np.int64), 1)

    @cached_property
    def departures(self) -> tuple[sp.csr_array, FloatArray]:
        """Outcomes seen on departing from a node only, [pairs, nodes], and the mass that departs.

        For exact processes: waiting in place changes no total (see ``without_self_loops``).
        """
        ended = np.where(self.node_of[self.model.successors] < 0, 1.0, 0.0)
        return without_self_loops(self.outcomes, self.pair_node, self.expectation(ended, 1.0))

    def matrix(self, weights: FloatArray, layer: IntArray, width: int) -> sp.csr_array:
        """Sum outcome weights by pair and (layer, node), [pairs, width * nodes].

        Args:
            weights: [outcomes]; outcomes into goals and dead-ends are left out.
            layer: block of columns of each outcome, 0 .. width - 1, [outcomes].
        """
        target = self.node_of[self.model.successors]
        live = (target >= 0) & (weights != 0)
        column = layer[live] * self.n_nodes + target[live]
        before = np.concatenate([[0], np.cumsum(live)])
        full = sp.csr_array(
            (weights[live], column, before[self.model.outcome_offsets]),
            shape=(self.model.n_pairs, width * self.n_nodes),
        )
        chosen = sp.csr_array(full[np.maximum(self.pair_at, 0)] if self.model.n_pairs else full)
        gives_up = np.flatnonzero(self.pair_at < 0)
        if gives_up.size:
            keep = np.ones(len(self.pair_at))
            keep[gives_up] = 0.0
            chosen = sp.csr_array(sp.diags_array(keep) @ chosen)
            chosen.eliminate_zeros()
        chosen.sum_duplicates()
        return chosen

    def expectation(self, weights: FloatArray, give_up: float | FloatArray = 0.0) -> FloatArray:
        """Expectation of outcome weights under each pair, [pairs].

        Args:
            weights: [outcomes].
            give_up: value of the pairs that give up: a number, or one per node.
        """
        per_pair = segment_sums(self.model.probabilities * weights, self.model.outcome_offsets)
        acting = self.pair_at >= 0
        result = np.broadcast_to(np.asarray(give_up, dtype=np.float64), (self.n_nodes,))[
            self.pair_node
        ].copy()
        result[acting] = per_pair[self.pair_at[acting]]
        return result

    def least_over_members(self, values: FloatArray) -> FloatArray:
        """Minimum of state values over the members of each node, [nodes]."""
        result = np.full(self.n_nodes, np.inf)
        live = self.node_of >= 0
        np.minimum.at(result, self.node_of[live], values[live])
        return result

    def lift(self, values: FloatArray) -> FloatArray:
        """Values of nodes as values of states, 0 at goals and dead-ends, [states]."""
        result = np.zeros(self.model.n_states)
        live = self.node_of >= 0
        result[live] = values[self.node_of[live]]
        return result

    def gather(self, distribution: FloatArray) -> FloatArray:
        """Sum a distribution over states by node, [nodes]."""
        live = self.node_of >= 0
        return np.bincount(
            self.node_of[live], weights=distribution[live], minlength=self.n_nodes
        ).astype(np.float64)

    def pull_back(self, choice: IntArray) -> IntArray:
        """Decisions on states from one chosen pair per node.

        Inside a component the other members move, for free, to the member whose pair is chosen.

        Args:
            choice: position among this skeleton's pairs, [nodes].

        Returns:
            [states] pair of the model, GIVE_UP_CODE or UNDECIDED.
        """
        decision = np.full(self.model.n_states, UNDECIDED, dtype=np.int64)
        chosen = self.pair_at[choice]
        live = self.node_of >= 0
        gives_up = np.zeros(self.model.n_states, dtype=np.bool_)
        gives_up[live] = chosen[self.node_of[live]] == GIVE_UP_CODE
        decision[gives_up] = GIVE_UP_CODE
        acting = chosen[chosen >= 0]
        decision[self.model.pair_state[acting]] = acting
        return self._routed(decision)

    def _routed(self, decision: IntArray) -> IntArray:
        lost = self.merged & (decision == UNDECIDED)
        if not lost.any():
            return decision
        pairs = np.flatnonzero(self.inside)
        possible = self.model.probabilities > 0
        while lost.any():
            settled = possible & ~lost[self.model.successors]
            hits = segment_sums(settled.astype(np.float64), self.model.outcome_offsets)[pairs] > 0
            useful = pairs[hits & lost[self.model.pair_state[pairs]]]
            decision[self.model.pair_state[useful]] = useful
            lost[self.model.pair_state[useful]] = False
        return decision


def build_skeleton(
    model: SSP,
    *,
    usable: BoolArray | None = None,
    free: BoolArray | None = None,
    exits: BoolArray | None = None,
    free_exits: bool = False,
) -> Skeleton:
    """Group the live states into nodes and list the pairs by which each can be left.

    Args:
        usable: pairs of the model that may be used, [model pairs]; all if left out.
        free: usable pairs that cost nothing; their end components are collapsed. None: no
            collapsing (discounted processes leak mass everywhere and need none).
        exits: states in which giving up is allowed, [states].
        free_exits: also allow giving up in collapsed components, that is staying for ever.
    """
    dead = dead_ends(model)
    live = ~dead & ~model.goal_mask
    usable = np.ones(model.n_pairs, dtype=np.bool_) if usable is None else usable
    usable = usable & live[model.pair_state]
    if free is None:
        component = np.full(model.n_states, -1)
        inside = np.zeros(model.n_pairs, dtype=np.bool_)
    else:
        component, inside = end_components(model, free & usable)
    group = np.where(component >= 0, component + model.n_states, np.arange(model.n_states))
    node_of = np.full(model.n_states, -1, dtype=np.int64)
    _, node_of[live] = np.unique(_first_member(group, live)[live], return_inverse=True)
    merged = component >= 0
    leaving = np.zeros(model.n_states, dtype=np.bool_) if exits is None else exits & live
    if free_exits:
        leaving = leaving | merged
    return _with_pairs(model, dead, node_of, inside, merged, usable & ~inside, leaving)


def _first_member(group: IntArray, live: BoolArray) -> IntArray:
    """The least state of each state's group, so that nodes keep the order of the states."""
    _, first, back = np.unique(group, return_index=True, return_inverse=True)
    return np.asarray(np.where(live, first[back], -1))


def _with_pairs(
    model: SSP,
    dead: BoolArray,
    node_of: IntArray,
    inside: BoolArray,
    merged: BoolArray,
    kept: BoolArray,
    leaving: BoolArray,
) -> Skeleton:
    n_nodes = int(node_of.max(initial=-1)) + 1
    pairs = np.flatnonzero(kept)
    exit_nodes = np.unique(node_of[leaving])
    pair_at = np.concatenate([np.full(exit_nodes.size, GIVE_UP_CODE), pairs])  # ties: give up
    pair_node = np.concatenate([exit_nodes, node_of[model.pair_state[pairs]]])
    order = np.argsort(pair_node, kind="stable")
    counts = np.bincount(pair_node, minlength=n_nodes)
    return Skeleton(
        model=model,
        dead=dead,
        node_of=node_of,
        n_nodes=n_nodes,
        inside=inside,
        merged=merged,
        pair_at=pair_at[order],
        pair_node=pair_node[order],
        pair_offsets=np.concatenate([[0], np.cumsum(counts)]),
    )


def costless_pairs(model: SSP) -> BoolArray:
    """Pairs whose every possible outcome costs nothing, [pairs]."""
    paid = segment_sums(
        ((model.probabilities > 0) & (model.costs > 0)).astype(np.float64), model.outcome_offsets
    )
    return np.asarray(paid == 0)
