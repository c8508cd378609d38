"""The chain of a policy whose probabilities nature chooses, within the box of each decision."""

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
    """A policy's chain on all outcomes that boxes allow, with the boxes of its moves."""

    chain: Chain
    offsets: IntArray  # [decisions + 1] moves of each decision, a pair taken at a node
    low: FloatArray  # [moves]
    high: FloatArray  # [moves]

    @cached_property
    def share(self) -> FloatArray:
        """Probability of the decision to which a move belongs, [moves]."""
        shares = segment_sums(self.chain.probability, self.offsets)
        return np.asarray(shares[segment_ids(self.offsets)])

    @cached_property
    def acting(self) -> BoolArray:
        """Nodes with decisions other than giving up, [nodes]."""
        return np.bincount(self.chain.source, minlength=self.chain.n_nodes) > 0

    @property
    def is_exact(self) -> bool:
        """Whether each pair is taken at one node only, so that nature chooses once."""
        first = self.chain.outcome[self.offsets[:-1]]
        return len(np.unique(first)) == len(first)

    def at(self, chosen: FloatArray, inside: BoolArray) -> Chain:
        """Return the chain at chosen probabilities, with the moves out of some nodes only.

        Args:
            chosen: probabilities within the boxes, [moves].
            inside: the nodes, [nodes].
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
        """Return the greatest subset of nodes in which nature can stay for ever, [nodes].

        Nodes without moves are never left.
        """
        kept = inside
        while (fewer := kept & self._keeping(kept[self.chain.target])).sum() < kept.sum():
            kept = fewer
        return kept

    def _keeping(self, within: BoolArray) -> BoolArray:
        """Return the nodes at which nature can surely choose one of some moves, [nodes].

        Args:
            within: the moves, [moves].
        """
        leaving = forced(self.low, self.high, ~within, self.offsets)
        keeping = np.ones(self.chain.n_nodes, dtype=np.bool_)
        keeping[self.chain.source[self.offsets[:-1][leaving]]] = False
        return keeping

    def collects_for_ever(self, reward: FloatArray, inside: BoolArray) -> bool:
        """Return whether nature can collect a reward infinitely often within some nodes.

        It can if an end component of nature's choices has a move with a reward.

        Args:
            reward: >= 0, [moves].
            inside: nodes, [nodes].
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

        Nature's policy iteration (Puterman, Markov Decision Processes, 1994, section 7.2): rewards
        are not negative, so that it ends at the optimum if a choice is changed for a strict gain
        only.

        Args:
            reward: of moves out of nodes inside, >= 0, never collected for ever, [moves].
            at_end: worth of reaching a node outside, >= 0, [nodes].
            inside: nodes at which the run goes on, [nodes].
            at_stop: worth of giving up, >= 0, [nodes].
            claim: worth of ending the run at a node inside, if nature prefers that, >= 0, [nodes].

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
        raise SolverError("nature's choices within the boxes do not converge")

    def failing(self) -> FloatArray:
        """Return the greatest probability of never reaching the goal from each node, [nodes].

        It is 1 at nodes where nature can avoid the goal; from all others every choice ends the run.
        """
        missed = self.chain.goal == 0.0
        lost = self.staying(missed)
        nothing = np.zeros(len(self.low))
        return self.greatest(nothing, lost.astype(np.float64), missed & ~lost, at_stop=1.0)


def boxed_chain(boxes: Boxes, policy: Policy, start: FloatArray) -> BoxedChain:
    """Follow a policy along all outcomes that boxes allow.

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
