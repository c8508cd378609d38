"""Policies played back in the Gymnasium environment that their model was made from."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ssp_lp.analysis.estimate import (
    Estimate,
    greatest_total,
    mean_estimate,
    proportion_estimate,
)
from ssp_lp.arrays import FloatArray, ReadOnlyCopies, read_only
from ssp_lp.errors import ModelError, check_between_0_and_1, check_whole
from ssp_lp.io.gym.environment import name_of_environment, step_limit_of
from ssp_lp.io.gym.from_gymnasium import EnvironmentSSP
from ssp_lp.io.gym.gym_episodes import (
    GymEpisode,
    GymParty,
    is_vector,
    step_limit_of_vector,
    vector_episodes,
)
from ssp_lp.model.arguments import explained
from ssp_lp.model.product import ProductSSP
from ssp_lp.policies.mixed import MixedPolicy, as_lottery
from ssp_lp.policies.policy import MOST_EPISODES, Policy
from ssp_lp.policies.remembering import on_original

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

MOST_STEPS = 10_000
"""Steps after which an episode is cut off where nothing else does, as in ``simulate``."""


class StepLimitWarning(UserWarning):
    """The environment cut episodes off by a step limit that the policy's model does not have."""


@dataclass(frozen=True, eq=False)
class RolloutReport(ReadOnlyCopies):
    """What happened in the episodes."""

    episodes: int
    goal: int  # reached it
    failed: int  # ended elsewhere, or where the goal is out of reach
    gave_up: int  # the policy gave up, as where too few steps are left
    truncated: int  # cut off by a limit on the steps
    goal_probability: Estimate
    failure_probability: Estimate  # whatever the reason
    conditional_cost: Estimate  # mean cost of the episodes that reached the goal
    success_costs: FloatArray  # [goal] their costs
    mean_steps: float
    step_limit: int | None  # the environment's own

    def summary(self) -> str:
        """Two lines for a person."""
        failure, cost = self.failure_probability, self.conditional_cost
        cut = ", cut where truncated" if self.truncated else ""
        ends = f"goal {self.goal:,}, failed {self.failed:,}, gave up {self.gave_up:,}"
        return (
            f"{self.episodes:,} episodes: {ends}, truncated {self.truncated:,}\n"
            f"  failure {failure.value:.4f} [{failure.low:.4f}, {failure.high:.4f}], cost given "
            f"success {cost.value:.4f} [{cost.low:.4f}, {cost.high:.4f}]{cut}"
        )


@explained
def rollout(
    env: gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any],
    policy: Policy | MixedPolicy,
    *,
    episodes: int,
    seed: int,
    max_steps: int | None = None,
    confidence: float = 0.95,
) -> RolloutReport:
    """Play a policy in the environment, step by step, and count how the episodes end.

    A lottery draws one member for each episode. An episode ends at a goal or a dead-end of the
    model, when the policy gives up, or when it is cut off: by the environment, by the horizon that
    the policy was made for, or after ``max_steps``.

    Several environments side by side (``gymnasium.make_vec``) play rounds of one episode each; what
    they do once their episode has ended is left out. One alone plays as a single one does, unless
    it resets itself in the step that ends an episode, which moves its seed on.

    Args:
        env: the environment, or several of them; each is reset before an episode, and not closed.
        policy: of a problem on ``from_gymnasium(env).model``, or on a product with that model.
        episodes: how many to play.
        seed: of the environment and of the policy's draws.
        max_steps: steps after which an episode is cut off; None: 10,000.
        confidence: of the intervals.

    Raises:
        MissingDependencyError: gymnasium is not installed.
        ModelError: wrong arguments, another policy, or an environment that leaves its table.

    Warns:
        StepLimitWarning: the environment cut off episodes by a step limit that the policy does
            not know of, so that what is certified for it need not hold there.
    """
    check_between_0_and_1("confidence", confidence)
    check_whole("episodes", episodes, most=MOST_EPISODES)
    check_whole("max_steps", MOST_STEPS if max_steps is None else max_steps)
    check_whole("seed", seed, 0)
    played, horizon = _on_environment(policy)
    limit = step_limit_of_vector(env) if is_vector(env) else step_limit_of(env)
    most = min(m for m in (max_steps or MOST_STEPS, horizon) if m is not None)
    theirs, ours = np.random.SeedSequence(seed).spawn(2)  # one stream would couple their draws
    party = GymParty(played, np.random.default_rng(ours), most)
    env.reset(seed=int(theirs.generate_state(1)[0]))
    if is_vector(env):
        played_out = vector_episodes(env, party, episodes)
    else:
        played_out = _rollout_episodes(env, party, episodes)
    if party.cut_off and (horizon is None or limit is None or horizon > limit):
        _warn_of_rollout(env, limit, party.cut_off, episodes)
    return _rollout_report(played_out, limit, confidence, greatest_total(played.model, most))


def _on_environment(policy: Policy | MixedPolicy) -> tuple[MixedPolicy, int | None]:
    """The policy on the environment's states, and the fewest steps that it was made for."""
    lottery = as_lottery(policy)
    while isinstance(lottery.model, ProductSSP):
        lottery = on_original(lottery)
    if not isinstance(lottery.model, EnvironmentSSP):
        raise ModelError("the policy's model is of no environment: make it by from_gymnasium(env)")
    limits = [member.step_limit for member in lottery.policies]
    known = [limit for limit in limits if limit is not None]
    return lottery, min(known) if len(known) == len(limits) else None


def _rollout_episodes(
    env: gymnasium.Env[Any, Any], party: GymParty, count: int
) -> list[GymEpisode]:
    """Episodes of a rollout one after the other."""
    played = []
    for _ in range(count):
        shown, _ = env.reset()
        episode = party.begin(shown)
        while episode.end is None:
            action = episode.action()
            if episode.end is None:
                shown, reward, terminated, truncated, _ = env.step(action)
                episode.observe(shown, reward, terminated, truncated)
        played.append(episode)
    return played


def _warn_of_rollout(env: Any, limit: int | None, cut_off: int, episodes: int) -> None:
    """Warn of a rollout whose episodes were cut off."""
    name = name_of_environment(env)
    told = "a wrapper of its own" if limit is None else f"TimeLimit, max_episode_steps={limit}"
    warnings.warn(
        f"{name} cut off {cut_off:,} of {episodes:,} episodes ({told}), which the policy does not "
        "know of: a model with a horizon counts steps",
        StepLimitWarning,
        stacklevel=4,  # beyond this function, the rollout and what explains its errors
    )


def _rollout_report(
    played: list[GymEpisode], limit: int | None, confidence: float, most: float
) -> RolloutReport:
    """The report of a rollout's episodes."""
    count, episodes = Counter(one.end for one in played), len(played)
    costs = np.array([one.cost for one in played if one.end == "goal"])
    return RolloutReport(
        episodes=episodes,
        goal=count["goal"],
        failed=count["failed"],
        gave_up=count["gave_up"],
        truncated=count["truncated"],
        goal_probability=proportion_estimate(count["goal"], episodes, confidence),
        failure_probability=proportion_estimate(episodes - count["goal"], episodes, confidence),
        conditional_cost=mean_estimate(costs, confidence, most),
        success_costs=read_only(costs),
        mean_steps=float(np.mean([one.steps for one in played])),
        step_limit=limit,
    )
