"""Several memories kept side by side, so that the members of a lottery can be told apart later."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.deterministic import DeterministicPolicy
from ssp_lp.policies.mixed import MixedPolicy
from ssp_lp.policies.policy import Branches, Policy
from ssp_lp.policies.stochastic import StochasticPolicy
from ssp_lp.policies.timed import TimedPolicy


@dataclass(frozen=True, eq=False)
class JointMemory(Policy):
    """The memories of several policies in one number, while one of them decides.

    The memory is a mixed-radix number, the first policy's memory its leading digit.
    """

    keepers: tuple[Policy, ...]  # one for each memory
    decider: Policy  # remembers what one of the keepers does, or nothing

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", self.decider.model)

    def followed_by(self, decider: Policy) -> JointMemory:
        """The same memories with another policy to decide."""
        return JointMemory(self.keepers, decider)

    def start_memory(self, states: IntArray) -> IntArray:
        """Each keeper's start memory, [episodes]."""
        return self._joined([k.start_memory(states) for k in self.keepers])

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """What the decider does, given its own part of the memory."""
        meanings = [meaning_of(k) for k in self.keepers]
        mine = meaning_of(self.decider)
        if mine in meanings:
            part = self._parts(memory)[meanings.index(mine)]
        else:
            part = self.decider.start_memory(states)
        return self.decider.branches(states, part)

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Move each keeper's memory."""
        parts = zip(self.keepers, self._parts(memory), strict=True)
        return self._joined([k.remember(part, pairs, successors, costs) for k, part in parts])

    def _joined(self, parts: list[IntArray]) -> IntArray:
        """The joint memory that the keepers' parts make."""
        return np.asarray(np.ravel_multi_index(parts, self._sizes))

    def _parts(self, memory: IntArray) -> tuple[IntArray, ...]:
        """Each keeper's part of a joint memory."""
        return np.unravel_index(memory, self._sizes)

    @property
    def _sizes(self) -> tuple[int, ...]:
        """How many values each keeper's memory takes."""
        return tuple(memory_size(keeper) for keeper in self.keepers)


def common_memory(policy: MixedPolicy) -> JointMemory | None:
    """All that the members of a lottery remember, decided by the first; None: nothing.

    Raises:
        ModelError: a member is of a class whose memory is not known here.
    """
    keepers: dict[tuple[object, ...], Policy] = {}
    for member in policy.policies:
        if memory_size(member) > 1:
            keepers.setdefault(meaning_of(member), member)
    return JointMemory(tuple(keepers.values()), policy.policies[0]) if keepers else None


def memory_size(policy: Policy) -> int:
    """How many values the memory of a policy takes at most.

    Raises:
        ModelError: the policy is of a class whose memory is not known here.
    """
    match policy:
        case TimedPolicy():
            return len(policy.stages) * memory_size(policy.stages[0])
        case CostAwarePolicy():
            return policy.cap + len(policy.tails)
        case JointMemory():
            return prod(memory_size(keeper) for keeper in policy.keepers)
        case StochasticPolicy():
            return 1 if policy.carrier is None else memory_size(policy.carrier)
        case DeterministicPolicy():
            return 1
    raise ModelError(f"what a {type(policy).__name__} remembers is not known")


def meaning_of(policy: Policy) -> tuple[object, ...]:
    """What a joint memory means: equal for policies that understand each other's memory."""
    match policy:
        case TimedPolicy():
            return len(policy.stages), *meaning_of(policy.stages[0])
        case CostAwarePolicy():
            rule = policy.tail_threshold if policy.tail_table is None else policy.tail_table
            levels = b"" if policy.levels is None else policy.levels.tobytes()
            kept = policy.cap, policy.unit, policy.rounds_up, len(policy.tails)
            return *kept, rule.tobytes(), levels
        case JointMemory():
            return tuple(meaning_of(keeper) for keeper in policy.keepers)
        case StochasticPolicy(carrier=Policy() as carrier):
            return meaning_of(carrier)
    return ()
