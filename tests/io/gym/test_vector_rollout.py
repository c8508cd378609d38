"""Policies in several environments side by side: the episodes of a single one, whatever resets."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from formulations import MCMP
from ssp_lp import GIVE_UP, DeterministicPolicy, solve
from ssp_lp.io import RolloutReport, StepLimitWarning, from_gymnasium, rollout
from ssp_lp.policies import MixedPolicy

CONFIDENCE = 0.999


def lake(**options: Any) -> gym.Env:
    return gym.make("FrozenLake-v1", **options)


def told(report: RolloutReport) -> tuple[Any, ...]:
    ends = report.goal, report.failed, report.gave_up, report.truncated
    return *ends, report.mean_steps, report.success_costs.tolist()


@pytest.fixture(scope="module")
def crossing() -> MixedPolicy:
    world = from_gymnasium(lake())
    return solve(MCMP(world.model, world.start, failure_budget=0.3)).policy


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
def test_one_alone_plays_the_episodes_of_a_single_one(
    kind: Any, mode: AutoresetMode, crossing: MixedPolicy
) -> None:
    envs = kind([lake], autoreset_mode=mode)
    assert told(rollout(envs, crossing, episodes=20, seed=4)) == told(
        rollout(lake(), crossing, episodes=20, seed=4)
    )
    envs.close()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_many_fail_as_often_as_certified(mode: AutoresetMode, crossing: MixedPolicy) -> None:
    envs = SyncVectorEnv([lake] * 7, autoreset_mode=mode)
    report = rollout(envs, crossing, episodes=120, seed=1, confidence=CONFIDENCE)
    assert (report.episodes, report.step_limit) == (120, 100)
    first, again = (rollout(envs, crossing, episodes=10, seed=1) for _ in range(2))
    assert told(first) == told(again)
    assert report.failure_probability.low <= 0.3 <= report.failure_probability.high


def test_what_a_process_of_its_own_shows_is_the_same(crossing: MixedPolicy) -> None:
    reports = []
    for kind in (SyncVectorEnv, AsyncVectorEnv):
        envs = kind([lake] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
        reports.append(told(rollout(envs, crossing, episodes=15, seed=2)))
        envs.close()
    assert reports[0] == reports[1]


def test_made_by_gymnasium_and_cut_off_by_it() -> None:
    world = from_gymnasium(lake(map_name="8x8"), horizon=None)
    policy = solve(MCMP(world.model, world.start, failure_budget=0.05)).policy
    envs = gym.make_vec("FrozenLake-v1", num_envs=5, map_name="8x8")
    with pytest.warns(StepLimitWarning, match="max_episode_steps=100"):
        report = rollout(envs, policy, episodes=60, seed=0)
    assert report.truncated > 0
    assert report.episodes == 60


def test_giving_up_ends_an_episode_and_no_other() -> None:
    model = from_gymnasium(lake(), horizon=None).model
    acting = np.flatnonzero(np.diff(model.pair_offsets))
    quits = DeterministicPolicy.from_actions(model, {model.states[s]: GIVE_UP for s in acting})
    report = rollout(SyncVectorEnv([lake] * 3), quits, episodes=7, seed=0)
    assert (report.gave_up, report.goal, report.mean_steps) == (7, 0, 0.0)
