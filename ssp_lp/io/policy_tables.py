"""Policies as tables: one row for each decision."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from itertools import product as every_choice
from typing import Any, NamedTuple

import numpy as np

from ssp_lp.arrays import IntArray
from ssp_lp.errors import ModelError, optional_module
from ssp_lp.model.arguments import explained
from ssp_lp.policies import (
    GIVE_UP,
    CostAwarePolicy,
    DeterministicPolicy,
    MixedPolicy,
    StochasticPolicy,
    TimedPolicy,
)
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Policy, as_lottery
from ssp_lp.policies.remembering import JointMemory, RememberingPolicy, memory_size


class PolicyRow(NamedTuple):
    """One decision of a policy."""

    state: Hashable
    memory: Hashable  # None: nothing is remembered; else see policy_table
    action: Hashable  # or GIVE_UP
    probability: float
    member: int = 0  # of a lottery


@explained
def policy_table(policy: Policy | MixedPolicy) -> list[PolicyRow]:
    """The decisions of a policy, in the order of members, memories and states.

    States in which the policy never acts have no row. Memory is told by

    - the cost paid so far (cost-aware policies, cost levels), "tail k" from the cap on;
    - the time step, or (time step, memory of the stage) (timed policies);
    - the product's memory, or (it, memory of the inner policy);
    - a tuple, where several of these are kept side by side.

    Args:
        policy: any policy of the library.

    Raises:
        ModelError: the policy is of a class whose memory is not known.

    Example:
        >>> from ssp_lp import SSP, DeterministicPolicy
        >>> model = SSP.from_transitions({"door": {"open": [(1.0, "out", 2.0)]}}, goal={"out"})
        >>> policy_table(DeterministicPolicy.from_actions(model, {"door": "open"}))
        [PolicyRow(state='door', memory=None, action='open', probability=1.0, member=0)]
    """
    members = enumerate(as_lottery(policy).policies)
    return [row for k, member in members for row in _table_rows(member, k)]


@explained
def to_frame(policy: Policy | MixedPolicy) -> Any:
    """:func:`policy_table` as a pandas ``DataFrame``, with a column for each field of a row.

    Raises:
        MissingDependencyError: pandas is not installed.
        ModelError: the policy is of a class whose memory is not known.
    """
    pandas = optional_module("pandas", "frames")
    return pandas.DataFrame(policy_table(policy), columns=list(PolicyRow._fields))


def _table_rows(policy: Policy, member: int) -> Iterator[PolicyRow]:
    """The rows of a policy's table, a member's decisions."""
    model, names = policy.model, policy.model.states
    for code, told in memories_of(policy):
        states = _table_states(policy, code)
        found = policy.branches(states, np.full(len(states), code, dtype=np.int64))
        decided = np.flatnonzero((found.pair != UNDECIDED) & (found.probability > 0.0))
        here = states[found.situation[decided]].tolist()
        pairs, shares = found.pair[decided].tolist(), found.probability[decided].tolist()
        for state, pair, share in zip(here, pairs, shares, strict=True):
            action = GIVE_UP if pair == GIVE_UP_CODE else model.action_of(pair)
            yield PolicyRow(names[state], told, action, share, member)


def _table_states(policy: Policy, memory: int) -> IntArray:
    """The states that a table lists for a memory, [states]."""
    if isinstance(policy, RememberingPolicy):
        number = memory % len(policy.product.memories)
        return np.flatnonzero(policy.product.table[:, number] >= 0)
    if isinstance(policy, StochasticPolicy):
        key, states = np.divmod(policy.situation_key, policy.model.n_states)
        return np.asarray(states[key == memory])
    return np.arange(policy.model.n_states)


def memories_of(policy: Policy) -> list[tuple[int, Hashable]]:
    """Every memory of a policy, and how a table tells of it.

    Raises:
        ModelError: the policy is of a class whose memory is not known.
    """
    match policy:
        case DeterministicPolicy() | StochasticPolicy(carrier=None):
            return [(0, None)]
        case StochasticPolicy(carrier=Policy() as carrier):
            return memories_of(carrier)
        case CostAwarePolicy():
            told = [layer * policy.unit for layer in range(policy.cap)]
            told = told if policy.levels is None else policy.levels[:-1].tolist()
            return list(enumerate([*told, *(f"tail {k}" for k in range(len(policy.tails)))]))
        case TimedPolicy():
            return _joined_in_table(range(len(policy.stages)), memories_of(policy.stages[0]))
        case RememberingPolicy():
            return _joined_in_table(policy.product.memories, memories_of(policy.inner))
        case JointMemory(keepers=(keeper,)):
            return memories_of(keeper)
        case JointMemory():
            sizes = [memory_size(keeper) for keeper in policy.keepers]
            parts = every_choice(*(memories_of(keeper) for keeper in policy.keepers))
            known = [tuple(zip(*some, strict=True)) for some in parts]
            return [(int(np.ravel_multi_index(codes, sizes)), told) for codes, told in known]
    raise ModelError(f"what a {type(policy).__name__} remembers is not known")


def _joined_in_table(
    last: Sequence[Hashable], inner: list[tuple[int, Hashable]]
) -> list[tuple[int, Hashable]]:
    """Two memories in one number, the inner one its leading digit."""
    return [
        (code * len(last) + k, outer if told is None else (outer, told))
        for k, outer in enumerate(last)
        for code, told in inner
    ]
