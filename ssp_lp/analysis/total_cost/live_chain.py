"""The part of policies' chains that can still reach the goal, and what is to come from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from ssp_lp.analysis.chain import Chain, reaching_in_chain
from ssp_lp.arrays import BoolArray, FloatArray, IntArray, read_only
from ssp_lp.dynamic_programming.equations import System

_FEW = 256  # nodes of which a table of all visits is kept


@dataclass(frozen=True, eq=False)
class ChainProspect:
    """A policy's chain, and what is still to come from each of its nodes."""

    chain: Chain
    alive: BoolArray  # [nodes] before the goal, and able to reach it
    goal: FloatArray  # [nodes] goal probability; 1 at goals
    cost: FloatArray  # [nodes] E[cost from here on; goal]

    @classmethod
    def of(cls, chain: Chain) -> ChainProspect:
        """The prospects of a live chain, by two linear solves."""
        alive = reaching_in_chain(chain, chain.goal > 0) & (chain.goal == 0)
        goal = chain.accumulate(chain.per_node(chain.goal[chain.target]), alive) + chain.goal
        paid = chain.per_node(goal[chain.target] * chain.cost)
        return cls(chain, alive, read_only(goal), read_only(chain.accumulate(paid, alive)))

    def exponential(self, rate: float) -> float:
        """E[exp(rate * C); goal], rate <= 0: what a step's factor takes away counts as given up."""
        chain = self.chain
        lost = chain.per_node(-np.expm1(rate * chain.cost))
        tilted = replace(
            chain,
            probability=chain.probability * np.exp(rate * chain.cost),
            give_up=chain.give_up + lost,
        )
        arriving = tilted.per_node(chain.goal[chain.target])
        return float(chain.start @ (tilted.accumulate(arriving, self.alive) + chain.goal))


@dataclass(frozen=True, eq=False)
class LiveChain:
    """The parts of one or several chains that can still reach the goal, the goals made one node.

    Moves that lose the goal for good are left out; what they take away is ``lost``.
    """

    start: FloatArray  # [nodes + 1] the goal is last, in all three
    goal: FloatArray  # [nodes + 1]
    cost: FloatArray  # [nodes + 1]
    lost: FloatArray  # [nodes] probability of losing the goal with the next decision
    source: IntArray  # [moves]
    target: IntArray  # [moves]
    probability: FloatArray  # [moves]
    paid: FloatArray  # [moves] cost

    @classmethod
    def of(cls, prospects: Sequence[ChainProspect], weights: FloatArray) -> LiveChain:
        """Live chains side by side, entered with the weights of a lottery."""
        size = sum(int(p.alive.sum()) for p in prospects)
        first, start, ahead, moves = 0, np.zeros(size + 1), np.zeros((3, size + 1)), []
        for prospect, weight in zip(prospects, weights, strict=True):
            chain, alive = prospect.chain, prospect.alive
            reached = chain.goal > 0
            own = slice(first, first + int(alive.sum()))
            number = np.full(chain.n_nodes, size, dtype=np.int64)
            number[alive] = np.arange(own.start, own.stop)
            start[own] = weight * chain.start[alive]
            start[size] += weight * float(chain.start[reached].sum())
            leaves = ~(alive | reached)[chain.target]
            lost = chain.give_up + chain.per_node(leaves.astype(np.float64))
            ahead[:, own] = prospect.goal[alive], prospect.cost[alive], lost[alive]
            kept = alive[chain.source] & ~leaves
            moves.append((number[chain.source[kept]], number[chain.target[kept]],
                          chain.probability[kept], chain.cost[kept]))  # fmt: skip
            first = own.stop
        ahead[0, size] = 1.0
        source, target, probability, paid = map(np.concatenate, zip(*moves, strict=True))
        return cls(start, ahead[0], ahead[1], ahead[2, :-1], source, target, probability, paid)


class FreeChainMoves:
    """What moves on at no cost before anything is paid: each layer is a chain of its own."""

    def __init__(self, live: LiveChain, free: BoolArray) -> None:
        """Take the moves marked ``free``, [moves], none of which leads to the goal."""
        n = len(live.lost)
        where = (live.source[free], live.target[free])
        inside = sp.csr_array((live.probability[free], where), shape=(n, n))
        inside.sum_duplicates()
        leak = np.bincount(live.source[~free], weights=live.probability[~free], minlength=n)
        self._inside, self._leaving = inside, leak + live.lost
        count, self._component = connected_components(inside, directed=False)
        self._busy = np.zeros(count, dtype=np.bool_)
        self._busy[self._component[where[0]]] = True

    def spread(self, inflow: FloatArray) -> FloatArray:
        """Expected visits by moves of a live chain within one layer, given what enters it, [nodes].

        Few nodes by a table that holds however hardly a loop is left; of many only the components
        that something enters are solved.
        """
        if inflow.size <= _FEW:
            return np.asarray(inflow @ self._visits)
        entered = np.zeros_like(self._busy)
        entered[self._component[np.flatnonzero(inflow)]] = True
        nodes = np.flatnonzero((entered & self._busy)[self._component])
        visits = inflow.copy()
        if nodes.size:
            every = nodes.size == inflow.size
            own = self._inside if every else sp.csr_array(self._inside[nodes][:, nodes])
            visits[nodes] = System(own, self._leaving[nodes]).solve_transposed(inflow[nodes])
        return visits

    @cached_property
    def _visits(self) -> FloatArray:
        """Expected visits of a live chain within a layer, [nodes entered, nodes]."""
        return self.gathered(np.eye(len(self._leaving)))

    def gathered(self, rewards: FloatArray) -> FloatArray:
        """Expected rewards of all visits of a live chain within one layer, by where it is entered.

        Args:
            rewards: of a visit, [nodes, rewards].
        """
        return System(self._inside, self._leaving).solve_by_reduction(rewards)
