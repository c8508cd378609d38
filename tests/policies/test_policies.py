"""Policies: built by hand, played step by step, evaluated, simulated in another world."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from formulations import MCMP, S3P
from small_models import TRIES
from ssp_lp import (
    GIVE_UP,
    CostAwarePolicy,
    DeterministicPolicy,
    MixedPolicy,
    ModelError,
    StochasticPolicy,
    evaluate,
    simulate,
    solve,
)


def test_an_episode_step_by_step() -> None:
    """With budget 1/8 for S3P one tries three times and then fails: 1/2 + 2/4 + 3/8 over 7/8."""
    solution = solve(S3P(TRIES, start="door", failure_budget=0.125))
    assert solution.objective == pytest.approx((0.5 + 0.5 + 0.375) / 0.875)
    episode = solution.policy.start(0)
    for _ in range(3):
        assert episode.action("door") == "try"
        episode.observe("door", 1.0)
    assert episode.action("door") is GIVE_UP
    episode.continue_after_give_up()
    assert episode.action("door") == "wait"
    episode.observe("door", 3.0)
    assert episode.action("door") == "wait"
    assert solution.policy.start(0).action("door") == "try"


def test_playing_needs_honest_costs() -> None:
    fresh = solve(S3P(TRIES, start="door", failure_budget=0.125)).policy.start(0)
    with pytest.raises(ModelError, match="before the first action"):
        fresh.observe("door", 1.0)
    fresh.action("door")
    for cost in (0.5, -1.0, float("nan"), float("inf")):
        with pytest.raises(ModelError, match="observed cost"):
            fresh.observe("door", cost)
    with pytest.raises(ModelError, match="not a state"):
        fresh.action("window")


def test_a_lottery_is_drawn_once() -> None:
    stay = DeterministicPolicy.from_actions(TRIES, {"door": "wait"})
    go = DeterministicPolicy.from_actions(TRIES, {"door": "try"})
    lottery = MixedPolicy((stay, go), np.array([0.25, 0.75]))
    with pytest.raises(ModelError, match="random generator"):
        lottery.start()
    rng, drawn = np.random.default_rng(3), []
    for _ in range(2000):
        episode = lottery.start(rng)
        first = episode.action("door")
        assert episode.action("door") == first
        drawn.append(first == "wait")
    assert np.mean(drawn) == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 2000))


def test_lotteries_that_are_none() -> None:
    go = DeterministicPolicy.from_actions(TRIES, {"door": "try"})
    for weights in ([0.5], [-0.5], [np.nan], [0.5, 0.5], []):
        with pytest.raises(ModelError):
            MixedPolicy((go,), np.array(weights))
    with pytest.raises(ModelError):
        DeterministicPolicy.from_actions(TRIES, {"door": "knock"})
    with pytest.raises(ModelError):
        StochasticPolicy.from_actions(TRIES, {"door": {"try": 0.5}})


def test_wandering_is_failure_and_costs_what_the_semantics_say() -> None:
    wait = DeterministicPolicy.from_actions(TRIES, {"door": "wait"})
    for give_up, charge, cost in [
        ("attention", True, 3.0),
        ("attention", False, 0.0),
        ("anywhere", True, 1.0),
        ("dead_ends", True, np.inf),
    ]:
        problem = MCMP(TRIES, start="door", give_up=give_up, charge_failing_step=charge)
        found = evaluate(wait, problem)
        assert found.failure_probability == 1.0
        assert found.ends["wandering"] == 1.0
        assert found.expected_cost == pytest.approx(cost)
        assert np.isnan(found.conditional_cost)


def test_a_randomised_policy_by_hand() -> None:
    policy = StochasticPolicy.from_actions(TRIES, {"door": {"try": 0.75, GIVE_UP: 0.25}})
    problem = MCMP(TRIES, start="door", charge_failing_step=False)
    found = evaluate(policy, problem)
    # x = 3/8 (1 + ...) : success s = 3/8 + 3/8 s, cost c = 3/4 + 3/8 c
    assert found.goal_probability == pytest.approx(0.6)
    assert found.expected_cost == pytest.approx(1.2)
    assert found.ends["gave_up"] == pytest.approx(0.4)
    report = simulate(
        policy, problem, episodes=20_000, rng=np.random.default_rng(1), confidence=0.9999
    )
    assert report.goal_probability.low <= 0.6 <= report.goal_probability.high
    assert report.expected_cost.low <= 1.2 <= report.expected_cost.high


def test_giving_up_where_it_is_forbidden() -> None:
    policy = DeterministicPolicy.from_actions(TRIES, {"door": GIVE_UP})
    with pytest.raises(ModelError, match="gives up"):
        evaluate(policy, MCMP(TRIES, start="door", give_up="dead_ends"))


def test_a_policy_that_knows_too_little() -> None:
    policy = DeterministicPolicy.from_actions(TRIES, {})
    with pytest.raises(ModelError, match="no decision in state 'door'"):
        evaluate(policy, MCMP(TRIES, start="door"))
    with pytest.raises(ModelError, match="no decision in state 'door'"):
        simulate(policy, MCMP(TRIES, start="door"), rng=np.random.default_rng(0))


class KindDoor:
    """A world in which the second try always succeeds; its world is the number of tries."""

    def reset(self, episodes: int, rng: np.random.Generator) -> Any:
        return np.zeros((episodes, 1)), np.zeros(episodes, dtype=np.int64)

    def step(self, world: Any, pair: Any, rng: np.random.Generator) -> Any:
        tried = world + 1
        return tried, np.where(tried[:, 0] >= 2, 1, 0), np.ones(len(pair))


def test_a_world_of_the_users_own() -> None:
    policy = DeterministicPolicy.from_actions(TRIES, {"door": "try"})
    problem, asked = MCMP(TRIES, start="door"), {"episodes": 10, "simulator": KindDoor()}
    report = simulate(policy, problem, rng=np.random.default_rng(0), record=3, **asked)
    assert report.ends["goal"] == 10
    assert report.conditional_cost.value == 2.0
    assert [len(path) for path in report.paths] == [3, 3, 3]
    short = simulate(policy, problem, rng=np.random.default_rng(0), max_steps=1, **asked)
    assert short.ends["unfinished"] == 10


def test_a_world_that_cannot_be() -> None:
    class Broken(KindDoor):
        def step(self, world: Any, pair: Any, rng: np.random.Generator) -> Any:
            return world, np.full(len(pair), -1), np.ones(len(pair))

    policy = DeterministicPolicy.from_actions(TRIES, {"door": "try"})
    with pytest.raises(ModelError, match="left the model"):
        simulate(
            policy, MCMP(TRIES, start="door"), rng=np.random.default_rng(0), simulator=Broken()
        )


def test_cost_aware_members_share_one_table() -> None:
    solution = solve(S3P(TRIES, start="door", failure_budget=0.2))
    assert all(isinstance(p, CostAwarePolicy) for p in solution.policy.policies)
    found = evaluate(solution.randomised_policy, solution.problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-12)
    assert found.failure_probability == pytest.approx(0.2, abs=1e-12)
