"""Stationary policies: one decision per state, or a distribution in each situation."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, concatenated_ranges, read_only, segment_sums
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import check_model
from ssp_lp.policies.policy import GIVE_UP, GIVE_UP_CODE, UNDECIDED, Branches, Policy


@dataclass(frozen=True, eq=False, repr=False)
class DeterministicPolicy(Policy):
    """One decision per state: a pair of the model, giving up, or none where it never acts."""

    model: SSP
    decision: IntArray  # [states] pair, GIVE_UP_CODE or UNDECIDED
    is_stationary: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "decision", read_only(self.decision))
        if self.decision.shape != (self.model.n_states,):
            raise ModelError(f"a decision is needed for each of {self.model.n_states} states")
        check_decisions(self.model, self.decision)

    @classmethod
    @explained
    def from_actions(cls, model: SSP, actions: Mapping[Hashable, Hashable]) -> DeterministicPolicy:
        """Build a policy from ``{state: action}``; an action may be :data:`GIVE_UP`.

        Raises:
            ModelError: unknown state, or an action that the state does not have.
        """
        check_model(model, "from_actions")
        decision = np.full(model.n_states, UNDECIDED, dtype=np.int64)
        for state, action in actions.items():
            s = model.index_of(state)
            decision[s] = GIVE_UP_CODE if action is GIVE_UP else find_pair(model, s, action)
        return cls(model, decision)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The one decision of each state."""
        n = len(states)
        return Branches(np.arange(n), self.decision[states].astype(np.int64), np.ones(n))

    def actions(self) -> dict[Hashable, Hashable]:
        """``{state: action or GIVE_UP}`` over the states in which the policy has a decision."""
        return {
            self.model.states[s]: GIVE_UP if p == GIVE_UP_CODE else self.model.action_of(int(p))
            for s, p in enumerate(self.decision)
            if p != UNDECIDED
        }

    def __repr__(self) -> str:
        """One line: how many states it decides and in how many it gives up."""
        gives_up = int((self.decision == GIVE_UP_CODE).sum())
        decides = int((self.decision >= 0).sum())
        return f"DeterministicPolicy(acts in {decides:,} states, gives up in {gives_up:,})"


def find_pair(model: SSP, state: int, action: Hashable) -> int:
    """Index of the pair (state, action).

    Raises:
        ModelError: the state does not have the action.
    """
    for pair in range(int(model.pair_offsets[state]), int(model.pair_offsets[state + 1])):
        if model.action_of(pair) == action:
            return pair
    raise ModelError(model.no_such_action(state, action))


def check_decisions(model: SSP, decision: IntArray, *, as_positions: bool = False) -> None:
    """Raise :class:`ModelError` where a deterministic policy's decision is no pair of its state.

    Args:
        model: the model.
        decision: [..., states].
        as_positions: a decision is a position among the state's pairs.
    """
    low, high = model.pair_offsets[:-1], model.pair_offsets[1:]
    if as_positions:
        counts = high - low
        most = np.iinfo(decision.dtype).max if decision.dtype.kind == "i" else -1
        small = int(counts.max(initial=0)) <= most  # small integers compare fast
        counts = counts.astype(decision.dtype) if small else counts
        wrong = (decision < UNDECIDED) | (decision >= counts)
    else:
        wrong = (decision < UNDECIDED) | ((decision >= 0) & ((decision < low) | (decision >= high)))
    if wrong.any():
        name = model.states[int(np.argwhere(wrong)[0][-1])]
        raise ModelError(f"the decision in state {name!r} is no pair of that state")


@dataclass(frozen=True, eq=False, repr=False)
class StochasticPolicy(Policy):
    """A distribution over decisions in each situation, that is in each (state, memory).

    Situations are sorted by (memory, state). Memory moves as that of ``carrier`` does; without a
    carrier the policy is stationary on the model's states. The policy that is equivalent to a
    mixed policy (paper, section 2.2) has this form.
    """

    model: SSP
    situation_key: IntArray  # [situations] memory * n_states + state, increasing
    offsets: IntArray  # [situations + 1] branches of situation i: offsets[i] : offsets[i + 1]
    pair: IntArray  # [branches] pair of the model or GIVE_UP_CODE
    probability: FloatArray  # [branches], each situation's sum to one
    carrier: Policy | None = None

    def __post_init__(self) -> None:
        for name in ("situation_key", "offsets", "pair", "probability"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        sums = segment_sums(self.probability, self.offsets)
        if not ((self.probability >= 0).all() and (np.abs(sums - 1.0) <= 1e-9).all()):
            raise ModelError("the decisions of each state need probabilities that sum to one")

    @classmethod
    @explained
    def from_actions(
        cls, model: SSP, actions: Mapping[Hashable, Mapping[Hashable, float]]
    ) -> StochasticPolicy:
        """Build a stationary policy from ``{state: {action or GIVE_UP: probability}}``.

        Raises:
            ModelError: unknown state or action, or probabilities that do not sum to one.
        """
        check_model(model, "from_actions")
        rows = sorted((model.index_of(state), table) for state, table in actions.items())
        pairs = [
            GIVE_UP_CODE if a is GIVE_UP else find_pair(model, s, a) for s, t in rows for a in t
        ]
        return cls(
            model,
            np.array([s for s, _ in rows], dtype=np.int64),
            np.cumsum([0] + [len(table) for _, table in rows]),
            np.array(pairs, dtype=np.int64),
            np.array([w for _, table in rows for w in table.values()], dtype=np.float64),
        )

    @classmethod
    def from_flows(
        cls,
        model: SSP,
        keys: IntArray,
        pairs: IntArray,
        flows: FloatArray,
        carrier: Policy | None = None,
    ) -> StochasticPolicy:
        """The policy that takes each decision with its share of its situation's flow.

        Args:
            model: the model.
            keys: memory * n_states + state of each decision; any order, repetitions allowed.
            pairs: pair of the model or GIVE_UP_CODE, like ``keys``.
            flows: expected number of times that the decision is taken, like ``keys``.
            carrier: the policy whose memory is meant; None: no memory.
        """
        joint, back = np.unique(keys * (model.n_pairs + 1) + pairs + 1, return_inverse=True)
        flow = np.bincount(back, weights=flows).astype(np.float64)
        key, pair = np.divmod(joint, model.n_pairs + 1)
        situation, first = np.unique(key, return_index=True)
        offsets = np.append(first, key.size)
        total = np.repeat(segment_sums(flow, offsets), np.diff(offsets))
        even = 1.0 / np.repeat(np.diff(offsets), np.diff(offsets))  # where all visits underflow
        share = np.where(total > 0, flow / np.where(total > 0, total, 1.0), even)
        return cls(model, situation, offsets, pair - 1, share, carrier)

    def start_memory(self, states: IntArray) -> IntArray:
        """The carrier's start memory, [episodes]."""
        if self.carrier is None:
            return super().start_memory(states)
        return self.carrier.start_memory(states)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The decisions with their probabilities; UNDECIDED in situations that are not listed."""
        key = np.asarray(memory, dtype=np.int64) * self.model.n_states + states
        keys = np.append(self.situation_key, -1)  # a key that no situation has
        at = np.searchsorted(self.situation_key, key)
        known = keys[at] == key
        at = np.where(known, at, 0)
        if not known.any():
            nothing = np.full(len(states), UNDECIDED)
            return Branches(np.arange(len(states)), nothing, np.ones(len(states)))
        count = np.where(known, np.diff(self.offsets)[at], 1)
        index = concatenated_ranges(np.where(known, self.offsets[at], 0), count)
        listed = np.repeat(known, count)
        return Branches(
            np.repeat(np.arange(len(states)), count),
            np.where(listed, self.pair[index], UNDECIDED),
            np.where(listed, self.probability[index], 1.0),
        )

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Move the carrier's memory."""
        step = memory, pairs, successors, costs
        return memory if self.carrier is None else self.carrier.remember(*step)

    def __repr__(self) -> str:
        """One line: in how many situations it decides, and in how many at random."""
        random = int((np.diff(self.offsets) > 1).sum())
        return f"StochasticPolicy({len(self.situation_key):,} situations, {random:,} at random)"
