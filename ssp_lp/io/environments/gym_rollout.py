"""Policies played back in the Gymnasium environment that their model was made from."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ssp_lp.analysis.estimate import Estimate, mean_estimate, proportion_estimate
from ssp_lp.arrays import FloatArray, IntArray, read_only
from ssp_lp.errors import ModelError
from ssp_lp.io.environments.gym_environments import EnvironmentSSP, step_limit_of
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.model.product import ProductSSP
from ssp_lp.policies.mixed import MixedPolicy, as_lottery
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Policy
from ssp_lp.policies.remembering import on_original

if TYPE_CHECKING:
    import gymnasium

MOST_STEPS = 10_000
"""Steps after which an episode is cut off where nothing else does, as in ``simulate``."""


class StepLimitWarning(UserWarning):
    """The environment cut episodes off by a step limit that the policy's model does not have."""


@dataclass(frozen=True, eq=False)
class RolloutReport:
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
        ends = f"goal {self.goal:,}, failed {self.failed:,}, gave up {self.gave_up:,}"
        return (
            f"{self.episodes:,} episodes: {ends}, truncated {self.truncated:,}\n"
            f"  failure {failure.value:.4f} [{failure.low:.4f}, {failure.high:.4f}], cost given "
            f"success {cost.value:.4f} [{cost.low:.4f}, {cost.high:.4f}]"
        )


def rollout(
    env: gymnasium.Env[Any, Any],
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

    Args:
        env: the environment; it is reset once for each episode, and not closed.
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
    if not 0.0 < confidence < 1.0:
        raise ModelError(f"confidence must lie strictly between 0 and 1, not {confidence!r}")
    if episodes < 1 or (max_steps is not None and max_steps < 1):
        raise ModelError("episodes and max_steps must be at least 1")
    played, horizon = _on_environment(policy)
    limit = step_limit_of(env)
    most = min(m for m in (max_steps or MOST_STEPS, horizon) if m is not None)
    theirs, ours = np.random.SeedSequence(seed).spawn(2)  # one stream would couple their draws
    party = _Party(env, played, np.random.default_rng(ours), most)
    env.reset(seed=int(theirs.generate_state(1)[0]))
    ends = [party.episode() for _ in range(episodes)]
    if party.cut_off and (horizon is None or limit is None or horizon > limit):
        _warn(env, limit, party.cut_off, episodes)
    return _report(ends, limit, confidence)


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


class _Player:
    """A policy whose decisions and memories are asked for once, then kept."""

    def __init__(self, policy: Policy, rng: np.random.Generator) -> None:
        self._policy, self._rng = policy, rng
        self._decisions: dict[tuple[int, int], tuple[IntArray, FloatArray]] = {}
        self._memories: dict[tuple[int, int, int, float], int] = {}

    def start(self, state: int) -> int:
        """The memory at the start."""
        return int(self._policy.start_memory(np.array([state]))[0])

    def decide(self, state: int, memory: int) -> int:
        """A pair, or GIVE_UP_CODE."""
        key = state, memory
        if key not in self._decisions:
            found = self._policy.branches(np.array([state]), np.array([memory]))
            self._decisions[key] = found.pair, np.cumsum(found.probability)
        pairs, cumulative = self._decisions[key]
        drawn = 0
        if len(pairs) > 1:
            level = self._rng.random() * cumulative[-1]
            drawn = int(np.searchsorted(cumulative, level, side="right"))
        pair = int(pairs[min(drawn, len(pairs) - 1)])
        if pair == UNDECIDED:
            name = self._policy.model.states[state]
            raise ModelError(f"the policy has no decision in state {name!r}")
        return pair

    def remember(self, memory: int, pair: int, successor: int, cost: float) -> int:
        """The memory after a step."""
        key = memory, pair, successor, cost
        if key not in self._memories:
            step = np.array([memory]), np.array([pair]), np.array([successor]), np.array([cost])
            self._memories[key] = int(self._policy.remember(*step)[0])
        return self._memories[key]


@dataclass(frozen=True)
class _End:
    """How an episode ended."""

    name: str  # a count of the report
    cost: float
    steps: int


class _Party:
    """An environment and the players of a lottery; counts the episodes the environment cut off."""

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        policy: MixedPolicy,
        rng: np.random.Generator,
        most: int,
    ) -> None:
        self._env, self._most, self._rng = env, most, rng
        self._model = cast("EnvironmentSSP", policy.model)
        self._over = dead_ends(policy.model) | policy.model.goal_mask
        self._players = [_Player(member, rng) for member in policy.policies]
        self._weights = policy.weights
        self._known: set[tuple[int, int]] = set()  # pairs and successors of the table
        self.cut_off = 0

    def episode(self) -> _End:
        """Play one."""
        model, cost = self._model, 0.0
        player = self._players[int(self._rng.choice(len(self._players), p=self._weights))]
        shown, _ = self._env.reset()
        state = model.index_of(shown)
        if self._is_over(state):
            return _End(self._name(state), cost, 0)
        memory = player.start(state)
        for steps in range(self._most):
            pair = player.decide(state, memory)
            if pair == GIVE_UP_CODE:
                return _End("gave_up", cost, steps)
            shown, successor, paid, truncated = self._step(shown, pair)
            cost += paid
            if self._is_over(successor):
                return _End(self._name(successor), cost, steps + 1)
            if truncated:
                self.cut_off += 1
                return _End("truncated", cost, steps + 1)
            if steps + 1 < self._most:
                memory = player.remember(memory, pair, successor, paid)
            state = successor
        return _End("truncated", cost, self._most)

    def _step(self, shown: Hashable, pair: int) -> tuple[Hashable, int, float, bool]:
        """What the environment shows, the model's state, the cost, whether it was cut off."""
        model, action = self._model, self._model.action_of(pair)
        there, reward, terminated, truncated, _ = self._env.step(action)
        successor = model.index_of(model.label(there, terminated))
        if (pair, successor) not in self._known:
            self._check(pair, successor, terminated)
            self._known.add((pair, successor))
        paid = float(model.step_cost(shown, action, there, float(reward)))
        return there, successor, paid, truncated

    def _check(self, pair: int, successor: int, terminated: bool) -> None:
        """Raise if the table does not know of a step."""
        model = self._model
        listed = slice(int(model.outcome_offsets[pair]), int(model.outcome_offsets[pair + 1]))
        if successor not in model.successors[listed]:
            raise ModelError(
                f"{model.describe_pair(pair)} led to {model.states[successor]!r}, which the "
                "environment's table does not list: env.unwrapped.P does not tell all"
            )
        if terminated and not self._is_over(successor):
            raise ModelError(
                f"the environment terminated in {model.states[successor]!r} against its table"
            )

    def _is_over(self, state: int) -> bool:
        return bool(self._over[state])

    def _name(self, state: int) -> str:
        return "goal" if self._model.goal_mask[state] else "failed"


def _warn(env: gymnasium.Env[Any, Any], limit: int | None, cut_off: int, episodes: int) -> None:
    name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    told = "a wrapper of its own" if limit is None else f"TimeLimit, max_episode_steps={limit}"
    warnings.warn(
        f"{name} cut off {cut_off:,} of {episodes:,} episodes ({told}), which the policy does not "
        "know of: from_gymnasium(env, horizon=...) counts steps",
        StepLimitWarning,
        stacklevel=3,
    )


def _report(ends: list[_End], limit: int | None, confidence: float) -> RolloutReport:
    count, episodes = Counter(end.name for end in ends), len(ends)
    costs = np.array([end.cost for end in ends if end.name == "goal"])
    return RolloutReport(
        episodes=episodes,
        goal=count["goal"],
        failed=count["failed"],
        gave_up=count["gave_up"],
        truncated=count["truncated"],
        goal_probability=proportion_estimate(count["goal"], episodes, confidence),
        failure_probability=proportion_estimate(episodes - count["goal"], episodes, confidence),
        conditional_cost=mean_estimate(costs, confidence),
        success_costs=read_only(costs),
        mean_steps=float(np.mean([end.steps for end in ends])),
        step_limit=limit,
    )
