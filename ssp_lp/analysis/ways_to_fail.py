"""How a policy fails, in words: each labelled end, dead-ends, giving up, wandering."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import start_distribution

_ROUNDING = 64 * MACHINE_EPSILON
"""As little wandering as this is rounding: it is what the other ends leave of 1."""

_WORDS = {"dead_end": "dead-end", "gave_up": "gave up", "wandering": "wandering"}


def ways_to_fail(ends: Mapping[str, float]) -> dict[str, float]:
    """The ends other than the goal that occur, with their probabilities."""
    return {
        name: share
        for name, share in ends.items()
        if name != "goal" and share > (_ROUNDING if name == "wandering" else 0.0)
    }


def failing_in_words(ends: Mapping[str, float], at_start: float = 0.0) -> str:
    """The ways to fail in one line: "crash 0.03, gave up 0.02 (before the first step)".

    Args:
        ends: probability of each end, as in ``Evaluation.ends``.
        at_start: probability of giving up before the first step.
    """
    parts = []
    for name, share in ways_to_fail(ends).items():
        told = f"{_WORDS.get(name, name)} {share:.6g}"
        if name == "gave_up" and at_start > 0.0:
            of_it = "" if at_start > share - _ROUNDING else f"{at_start:.6g} of it "
            told += f" ({of_it}before the first step)"
        parts.append(told)
    return ", ".join(parts)


def giving_up_at_start(policy: MixedPolicy, problem: Problem) -> float:
    """Probability that the policy gives up before its first step."""
    start = start_distribution(problem.model, problem.start)
    states = np.flatnonzero((start > 0.0) & (np.diff(problem.model.pair_offsets) > 0))
    total = 0.0
    for member, weight in zip(policy.policies, policy.weights, strict=True):
        found = member.branches(states, member.start_memory(states))
        gives_up = found.pair == GIVE_UP_CODE
        share = start[states[found.situation]] * found.probability
        total += float(weight) * float(share[gives_up].sum())
    return total
