"""Episodes of a policy in Gymnasium environments, one or several side by side."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError, optional_module
from ssp_lp.io.gym.environment import step_limit_of
from ssp_lp.io.gym.from_gymnasium import EnvironmentSSP, gym_value
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.policies.mixed import MixedPolicy
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Policy, check_costs

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv
    from typing_extensions import TypeIs


class _EpisodePlayer:
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


class GymParty:
    """The players of a lottery, and what their episodes have in common."""

    def __init__(self, policy: MixedPolicy, rng: np.random.Generator, most: int) -> None:
        """Play episodes of at most so many steps."""
        self.model = cast(EnvironmentSSP, policy.model)
        self.most, self._rng = most, rng
        self.over = dead_ends(policy.model) | policy.model.goal_mask  # [states]
        self._players = [_EpisodePlayer(member, rng) for member in policy.policies]
        self._weights = policy.weights
        self._known: set[tuple[int, int]] = set()  # pairs and successors of the table
        self.cut_off = 0  # episodes that an environment did

    def begin(self, shown: Any) -> GymEpisode:
        """An episode in what an environment shows after its reset."""
        player = self._players[int(self._rng.choice(len(self._players), p=self._weights))]
        return GymEpisode(self, player, gym_value(shown))

    def check(self, pair: int, successor: int, terminated: bool) -> None:
        """Raise :class:`ModelError` if the table does not know of a step."""
        if (pair, successor) in self._known:
            return
        model = self.model
        listed = slice(int(model.outcome_offsets[pair]), int(model.outcome_offsets[pair + 1]))
        if successor not in model.successors[listed]:
            raise ModelError(
                f"{model.describe_pair(pair)} led to {model.states[successor]!r}, which the "
                "environment's table does not list: env.unwrapped.P does not tell all"
            )
        if terminated and not self.over[successor]:
            raise ModelError(
                f"the environment terminated in {model.states[successor]!r} against its table"
            )
        self._known.add((pair, successor))


class GymEpisode:
    """An episode: where it stands, what it has cost, and how it ended, once it has."""

    def __init__(self, party: GymParty, player: _EpisodePlayer, shown: Hashable) -> None:
        self._party, self._player, self._shown = party, player, shown
        self._state, self.cost, self.steps = party.model.index_of(shown), 0.0, 0
        self._pair = self._memory = 0
        self.end: str | None = None  # a count of the report
        if party.over[self._state]:
            self._finish(self._state)
        else:
            self._memory = player.start(self._state)

    def action(self) -> Hashable:
        """What the policy does; where it gives up the episode has ended."""
        self._pair = self._player.decide(self._state, self._memory)
        if self._pair == GIVE_UP_CODE:
            self.end = "gave_up"
            return None
        return self._party.model.action_of(self._pair)

    def observe(self, shown: Any, reward: Any, terminated: Any, truncated: Any) -> None:
        """Take what the environment shows after a step."""
        party, model, there = self._party, self._party.model, gym_value(shown)
        successor = model.index_of(model.label(there, bool(terminated)))
        party.check(self._pair, successor, bool(terminated))
        action = model.action_of(self._pair)
        paid = float(model.step_cost(self._shown, action, there, float(reward)))
        check_costs(paid)
        self.cost += paid
        self.steps += 1
        if party.over[successor]:
            self._finish(successor)
        elif truncated or self.steps == party.most:
            party.cut_off += bool(truncated)
            self.end = "truncated"
        else:
            self._memory = self._player.remember(self._memory, self._pair, successor, paid)
        self._state, self._shown = successor, there

    def _finish(self, state: int) -> None:
        """End the episode in the environment."""
        self.end = "goal" if self._party.model.goal_mask[state] else "failed"


def is_vector(env: object) -> TypeIs[VectorEnv[Any, Any, Any]]:
    """Whether these are several environments side by side.

    Raises:
        MissingDependencyError: gymnasium is not installed.
    """
    return isinstance(env, optional_module("gymnasium.vector", "gym").VectorEnv)


def vector_episodes(
    envs: VectorEnv[Any, Any, Any], party: GymParty, count: int
) -> list[GymEpisode]:
    """Play rounds of one episode for each environment; a round ends with the last of them.

    An environment whose episode has ended is moved on by an action that changes nothing of ours,
    whatever its way of resetting, until the others are done; then all are reset. Each round is
    finished, so that short episodes count no more than long ones.

    Args:
        envs: several environments, of one kind.
        party: the players.
        count: how many episodes to play.
    """
    played: list[GymEpisode] = []
    while len(played) < count:
        played += _round_of_episodes(envs, party, min(envs.num_envs, count - len(played)))
    return played


def _round_of_episodes(
    envs: VectorEnv[Any, Any, Any], party: GymParty, count: int
) -> list[GymEpisode]:
    """One episode in each of the first environments."""
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import iterate

    mode = envs.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
    shown, _ = envs.reset()
    first = list(iterate(envs.observation_space, shown))[:count]
    episodes = [party.begin(one) for one in first]
    idle, over = party.model.action_of(0), np.zeros(envs.num_envs, dtype=np.bool_)
    while True:
        actions = [idle] * envs.num_envs
        for k, episode in enumerate(episodes):
            if episode.end is None:
                action = episode.action()
                actions[k] = idle if episode.end is not None else action
        if all(episode.end is not None for episode in episodes):
            return episodes
        acting = [k for k, episode in enumerate(episodes) if episode.end is None]
        if mode is AutoresetMode.DISABLED and over.any():
            envs.reset(options={"reset_mask": over})
        shown, rewards, terminated, truncated, infos = envs.step(_episode_actions(envs, actions))
        seen = list(iterate(envs.observation_space, shown))
        over = terminated | truncated
        for k in acting:
            last = over[k] and mode is AutoresetMode.SAME_STEP
            there = infos["final_obs"][k] if last else seen[k]
            episodes[k].observe(there, rewards[k], terminated[k], truncated[k])


def _episode_actions(envs: VectorEnv[Any, Any, Any], actions: Sequence[Hashable]) -> Any:
    """Actions as the environments take them together."""
    from gymnasium.vector.utils import concatenate, create_empty_array

    empty: Any = create_empty_array(envs.single_action_space, n=envs.num_envs)
    return concatenate(envs.single_action_space, actions, empty)


def step_limit_of_vector(envs: VectorEnv[Any, Any, Any]) -> int | None:
    """The steps after which each environment's ``TimeLimit`` cuts an episode off; None: never."""
    made = getattr(envs.unwrapped, "envs", None)  # of ones that step one after the other
    if made:
        return step_limit_of(made[0])
    makers = getattr(envs.unwrapped, "env_fns", None)
    if not makers:
        return envs.spec.max_episode_steps if envs.spec is not None else None
    env = makers[0]()
    limit = step_limit_of(env)
    env.close()
    return limit
