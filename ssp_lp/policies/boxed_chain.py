"""The chain of a policy in a model over boxes: nature chooses probabilities within the box."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import IMPROVEMENT, BoolArray, FloatArray, IntArray, segment_ids, segment_sums
from ssp_lp.compiled.deadline import check_time
from ssp_lp.errors import SolverError
from ssp_lp.model.boxes import Boxes, forced, greatest_mean
from ssp_lp.model.graph import edges
from ssp_lp.policies.chain import Chain, policy_chain
from ssp_lp.policies.policy import Policy

MOST_ROUNDS = 1_000
"""Greatest number of rounds of policy iteration; it usually takes about ten."""


@dataclass(frozen=True, eq=False)
class BoxedChain:
    """A policy's chain with all outcomes that boxes allow, and an interval for each move.

    Nodes are pairs (state, memory). A decision is a pair that is taken at a node, and a move is one
    outcome of a decision. Nature, the opponent, chooses the probabilities of moves within their
    intervals.
    """

    chain: Chain
    offsets: IntArray  # [decisions + 1] moves of each decision, a pair taken at a node
    low: FloatArray  # [moves]
    high: FloatArray  # [moves]

    @cached_property
    def share(self) -> FloatArray:
        """For each move, the probability that the policy takes the move's decision, [moves]."""
        shares = segment_sums(self.chain.probability, self.offsets)
        return np.asarray(shares[segment_ids(self.offsets)])

    @cached_property
    def acting(self) -> BoolArray:
        """Mask of nodes with a decision other than giving up, [nodes]."""
        return np.bincount(self.chain.source, minlength=self.chain.n_nodes) > 0

    @property
    def is_exact(self) -> bool:
        """Whether no pair is taken at several nodes, so that nature chooses once for each pair."""
        first = self.chain.outcome[self.offsets[:-1]]
        return len(np.unique(first)) == len(first)

    def at(self, chosen: FloatArray, inside: BoolArray) -> Chain:
        """Return the chain at given probabilities, with only the moves out of given nodes.

        Args:
            chosen: probabilities within the boxes, [moves].
            inside: mask of the nodes whose moves are kept, [nodes].
        """
        chain = self.chain
        used = (chosen > 0.0) & inside[chain.source]
        return replace(
            chain,
            source=chain.source[used],
            target=chain.target[used],
            probability=(self.share * chosen)[used],
            cost=chain.cost[used],
            outcome=chain.outcome[used],
        )

    def staying(self, inside: BoolArray) -> BoolArray:
        """Return the greatest subset of nodes in which nature can keep a run for ever, [nodes].

        ``inside`` is the mask of the nodes to choose from. A node without moves is never left.
        """
        kept = inside
        while (fewer := kept & self._keeping(kept[self.chain.target])).sum() < kept.sum():
            kept = fewer
        return kept

    def _keeping(self, within: BoolArray) -> BoolArray:
        """Return the nodes at which nature can give all other moves probability 0, [nodes].

        Args:
            within: mask of the moves that may keep a positive probability, [moves].
        """
        leaving = forced(self.low, self.high, ~within, self.offsets)
        keeping = np.ones(self.chain.n_nodes, dtype=np.bool_)
        keeping[self.chain.source[self.offsets[:-1][leaving]]] = False
        return keeping

    def collects_for_ever(self, reward: FloatArray, inside: BoolArray) -> bool:
        """Return whether nature can collect a reward infinitely often within given nodes.

        Nature can do so if an end component of its choices has a move with a positive reward.

        Args:
            reward: reward of each move, >= 0, [moves].
            inside: mask of the given nodes, [nodes].
        """
        source, target, n = self.chain.source, self.chain.target, self.chain.n_nodes
        kept = self.staying(inside & self.acting & (self.chain.give_up == 0.0))
        while kept.any():
            within = kept[source] & kept[target]
            steps = sp.csr_array((within[within], (source[within], target[within])), shape=(n, n))
            links = edges(steps.indices, steps.indptr)
            strong = sp.csgraph.connected_components(links, connection="strong")[1]
            within &= strong[source] == strong[target]
            fewer = kept & self._keeping(within)
            if fewer.sum() == kept.sum():
                return bool((within & (reward > 0.0)).any())
            kept = fewer
        return False

    def greatest(
        self,
        reward: FloatArray,
        at_end: FloatArray,
        inside: BoolArray,
        *,
        at_stop: FloatArray | float = 0.0,
        claim: FloatArray | float = 0.0,
    ) -> FloatArray:
        """Return the greatest expected total reward from each node over nature's choices, [nodes].

        Computed by policy iteration over nature's choices (Puterman, Markov Decision Processes,
        1994, section 7.2). No reward is negative and choices change only for a strict gain, so the
        iteration ends at the optimum.

        Args:
            reward: reward of each move out of a node in ``inside``, >= 0, [moves]; nature must not
                be able to collect rewards for ever.
            at_end: reward of reaching a node that is not in ``inside``, >= 0, [nodes].
            inside: mask of the nodes at which the run goes on, [nodes].
            at_stop: reward if the policy gives up at a node, >= 0, [nodes].
            claim: reward if nature ends the run at a node in ``inside``, >= 0, [nodes]; nature may
                do so where this reward is positive.

        Raises:
            SolverError: nature's choices do not converge.
        """
        chain, offsets, n = self.chain, self.offsets, self.chain.n_nodes
        claimed = np.where(inside, claim, 0.0)
        stops, ends = claimed > 0.0, np.where(inside, 0.0, at_end)
        values = np.where(stops, claimed, ends)
        chosen = greatest_mean(self.low, self.high, reward + values[chain.target], offsets)
        decision, node = segment_ids(offsets), chain.source[offsets[:-1]]
        share = self.share[offsets[:-1]]
        for _ in range(MOST_ROUNDS):
            check_time()
            going = inside & ~stops
            moving = self.at(chosen, going)
            base = np.where(stops, claimed, ends)
            mean = segment_sums(chosen * (reward + base[chain.target]), offsets)
            gain = np.bincount(node, share * mean, n) + chain.give_up * at_stop
            alive = going & moving.reaching(going & (gain > 0.0))
            values = base + moving.accumulate(np.where(alive, gain, 0.0), alive)
            worth = reward + values[chain.target]
            best = greatest_mean(self.low, self.high, worth, offsets)
            slack = IMPROVEMENT * float(values.max(initial=0.0))
            mean = segment_sums(best * worth, offsets)
            better = mean > segment_sums(chosen * worth, offsets) + slack
            goes_on = np.bincount(node, share * mean, n) + chain.give_up * at_stop
            turned = inside & (np.where(stops, goes_on, claimed) > values + slack)
            if not (better & inside[node]).any() and not turned.any():
                return values
            chosen = np.where(better[decision], best, chosen)
            stops = stops ^ turned
        raise SolverError("rounding makes the worst probabilities repeat; please report the model")

    def failing(self) -> FloatArray:
        """Return the greatest probability of never reaching the goal from each node, [nodes].

        It is 1 at nodes where nature can surely avoid the goal. From all other nodes the run ends
        with probability 1, whatever nature chooses.
        """
        missed = self.chain.goal == 0.0
        lost = self.staying(missed)
        nothing = np.zeros(len(self.low))
        return self.greatest(nothing, lost.astype(np.float64), missed & ~lost, at_stop=1.0)


def boxed_chain(boxes: Boxes, policy: Policy, start: FloatArray) -> BoxedChain:
    """Build the chain of a policy over all outcomes that boxes allow.

    Args:
        boxes: boxes of the policy's model.
        policy: policy on that model.
        start: distribution over states, [states].

    Raises:
        ModelError: the policy has no decision in a state that it may reach.
    """
    chain = policy_chain(boxes.support, policy, start)
    source, outcome = chain.source, chain.outcome
    begins = np.ones(len(source) + 1, dtype=np.bool_)  # the moves of a decision ascend
    begins[1:-1] = (np.diff(source) != 0) | (np.diff(outcome) <= 0)
    begins[1:-1] |= np.diff(segment_ids(boxes.model.outcome_offsets)[outcome]) != 0
    offsets = np.flatnonzero(begins)
    return BoxedChain(chain, offsets, boxes.low[outcome], boxes.high[outcome])
