"""Stationary deterministic policies: one decision per state."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, read_only
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

    def start_memory(self, states: IntArray) -> IntArray:
        """No memory: zeros, [episodes]."""
        return np.zeros(len(states), dtype=np.int64)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The one decision of each state."""
        n = len(states)
        return Branches(np.arange(n), self.decision[states].astype(np.int64), np.ones(n))

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """No memory to move."""
        return memory

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
