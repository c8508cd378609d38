"""Episodes side by side: each is what it would be alone, giving up and lotteries included."""

from __future__ import annotations

import numpy as np
import pytest

from formulations import MCMP, S3P
from small_models import FIRST, TRIES
from ssp_lp import GIVE_UP, ModelError, evaluate, solve


def test_each_remembers_its_own_costs_and_gives_up_by_itself() -> None:
    """Three tries, as budget 1/8 allows; an episode that waited has fewer left."""
    policy = solve(S3P(TRIES, start="door", failure_budget=0.125)).policy
    batch = policy.start_many(3, 0)
    assert batch.actions(["door"] * 3) == ["try"] * 3
    batch.observe(["door", "door", "out"], [1.0, 3.0, 1.0])  # what came of it, whatever it was
    assert batch.actions(["door", "door", "out"]) == ["try", GIVE_UP, None]
    batch.observe(["door", "door", "out"], [1.0, 0.0, 0.0])
    assert batch.actions(["door", "out", "door"]) == ["try", GIVE_UP, None]
    batch.observe(["door", "door", "out"], [1.0, 0.0, 0.0])
    assert batch.actions(["door", "door", "out"]) == [GIVE_UP, GIVE_UP, None]


def test_a_lottery_is_drawn_for_each_episode() -> None:
    solution = solve(MCMP(FIRST, "depot", failure_budget=0.05))
    actions = solution.policy.start_many(9000, 1).actions(["depot"] * 9000)
    deviation = (5 / 9 * 4 / 9 / 9000) ** 0.5
    assert abs(actions.count("road") / 9000 - 5 / 9) < 4 * deviation
    mixed = solution.randomised_policy.start_many(9000, 2).actions(["depot"] * 9000)
    assert abs(mixed.count("road") / 9000 - 5 / 9) < 4 * deviation


def test_the_same_seed_plays_the_same_and_one_alone_as_a_single_episode() -> None:
    """A policy that draws: with one episode the draws are those of ``start``."""
    policy = solve(MCMP(FIRST, "depot", failure_budget=0.05)).randomised_policy
    for seed in range(20):
        single = policy.start(seed).action("depot")
        assert policy.start_many(1, seed).actions(["depot"]) == [single]
    once, again = (policy.start_many(50, 3).actions(["depot"] * 50) for _ in range(2))
    assert once == again


def test_a_loop_of_ones_own_fails_as_often_as_evaluated() -> None:
    rng, episodes = np.random.default_rng(0), 4000
    problem = S3P(TRIES, "door", failure_budget=0.2)
    policy = solve(problem).policy
    batch = policy.start_many(episodes, rng)
    states, going = ["door"] * episodes, True
    while going:
        actions = batch.actions(states)
        states = [
            "out" if action == "try" and rng.random() < 0.5 else state
            for state, action in zip(states, actions, strict=True)
        ]
        batch.observe(states, [3.0 if action == "wait" else 1.0 for action in actions])
        going = any(action not in (None, GIVE_UP) for action in actions)
    failure = evaluate(policy, problem).failure_probability
    deviation = (failure * (1 - failure) / episodes) ** 0.5
    assert abs(states.count("door") / episodes - failure) < 4 * deviation


def test_what_cannot_be_played_is_named() -> None:
    lottery = solve(MCMP(FIRST, "depot", failure_budget=0.05)).policy
    with pytest.raises(ModelError, match="needs a random generator"):
        lottery.start_many(2)
    batch = lottery.start_many(2, 0)
    with pytest.raises(ModelError, match="1 states given for 2 episodes"):
        batch.actions(["depot"])
    with pytest.raises(ModelError, match="'nowhere' is not a state"):
        batch.actions(["depot", "nowhere"])
    batch.actions(["depot", "home"])
    with pytest.raises(ModelError, match="1 costs given for 2 episodes"):
        batch.observe(["home", "home"], [1.0])
    with pytest.raises(ModelError, match="episodes must be a whole number >= 1"):
        lottery.start_many(0, 0)
