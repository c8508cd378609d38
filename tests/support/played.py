"""Small models and policies of every class, and the episodes that they play."""

from __future__ import annotations

import numpy as np

from formulations import MCMP, S3P
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    Memory,
    MixedPolicy,
    StochasticPolicy,
    TimedPolicy,
    on_original,
    product,
    solve,
)

START = ("hall", 0)

ROOT = 2.0**0.5


def hall(cost: float = 3.0) -> SSP:
    """Halls and a door: a fast way that may end in a pit, a slow one, a loop; labels are tuples."""

    def fast(k: int) -> list[tuple[float, object, float]]:
        return [(0.7, ("hall", k + 1), 1.0), (0.2, ("hall", k), 2.0), (0.1, "pit", 1.0)]

    choices = {
        ("hall", k): {
            "fast": fast(k),
            ("slow", 1): [(0.75, ("hall", k + 1), cost), (0.25, START, 1.0)],
        }
        for k in range(3)
    }
    return model_of({**choices, "pit": {}, ("hall", 3): {}}, ("hall", 3), labels={"fall": ["pit"]})


def ferry() -> SSP:
    """Two hops, straight or diagonal at cost 1.4142...; the diagonal one sinks with 0.2."""
    across = [(0.8, "mid", ROOT), (0.2, "sea", 1.0)]
    return model_of(
        {
            "quay": {"straight": [(1.0, "mid", 2.0)], "across": across},
            "mid": {"straight": [(1.0, "home", 2.0)], "across": [(0.8, "home", ROOT), *across[1:]]},
            "sea": {},
            "home": {},
        },
        "home",
    )


def slow_falls(falls, state, action, successor, cost):
    return min(falls + (action == "fast"), 2)


def task(model: SSP) -> SSP:
    """At most two steps in a hurry are counted."""
    return product(model, Memory(start=0, update=slow_falls))


def everywhere(model: SSP, action: object) -> DeterministicPolicy:
    return DeterministicPolicy.from_actions(model, {("hall", k): action for k in range(3)})


def policies(model: SSP) -> dict[str, object]:
    """Policies of every class that act on the model."""
    fast, slow = everywhere(model, "fast"), everywhere(model, ("slow", 1))
    cautious = solve(S3P(model, START, failure_budget=0.2))
    aware = cautious.policy.policies[0]
    toss = {
        ("hall", 0): {"fast": 0.25, ("slow", 1): 0.75},
        ("hall", 1): {"fast": 0.5, GIVE_UP: 0.5},
        ("hall", 2): {"fast": 1.0},
    }
    return {
        "deterministic": fast,
        "gives up": DeterministicPolicy.from_actions(
            model, {("hall", 0): "fast", ("hall", 1): GIVE_UP, ("hall", 2): "fast"}
        ),
        "stochastic": StochasticPolicy.from_actions(model, toss),
        "cost aware": aware,
        "carried": cautious.randomised_policy,
        "timed": TimedPolicy((slow, fast, slow)),
        "mixed": MixedPolicy((fast, slow), np.array([0.25, 0.75])),
        "solution": cautious.policy,
    }


def level_policy(model: SSP) -> MixedPolicy:
    """Of the ferry: decisions by the level of the cost paid."""
    return solve(S3P(model, "quay", failure_budget=0.1)).policy


def remembering(model: SSP) -> MixedPolicy:
    """Acts on the original of a task and carries its memory."""
    return on_original(solve(MCMP(model, model.start(START), failure_budget=0.2)).policy)


def traces(policy, start, seed: int, episodes: int = 30) -> list[list[tuple[str, str, float]]]:
    """(state, action, cost) of episodes that a policy plays in its own model."""
    rng, model = np.random.default_rng(seed), policy.model
    found = []
    for _ in range(episodes):
        episode = policy.start(rng)
        state, steps = start, []
        while len(steps) < 40 and np.diff(model.pair_offsets)[model.index_of(state)]:
            action = episode.action(state)
            if action is GIVE_UP:
                steps.append((repr(state), "give up", 0.0))
                break
            successor, cost = step(model, state, action, rng)
            episode.observe(successor, cost)
            steps.append((repr(state), repr(action), cost))
            state = successor
        found.append(steps)
    return found


def step(model: SSP, state, action, rng: np.random.Generator):
    """Where an action leads, and what it costs."""
    s = model.index_of(state)
    pairs = range(int(model.pair_offsets[s]), int(model.pair_offsets[s + 1]))
    pair = next(k for k in pairs if model.action_of(k) == action)
    some = slice(int(model.outcome_offsets[pair]), int(model.outcome_offsets[pair + 1]))
    k = rng.choice(some.stop - some.start, p=model.probabilities[some])
    return model.states[int(model.successors[some][k])], float(model.costs[some][k])
