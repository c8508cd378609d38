"""Episodes of a policy in several environments side by side, as Gymnasium vectorises them."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ssp_lp.errors import MissingDependencyError
from ssp_lp.io.environments.gym_environments import step_limit_of
from ssp_lp.io.environments.gym_episode import End, Party

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv
    from typing_extensions import TypeIs


def is_vector(env: object) -> TypeIs[VectorEnv[Any, Any, Any]]:
    """Whether these are several environments side by side.

    Raises:
        MissingDependencyError: gymnasium is not installed.
    """
    try:
        from gymnasium.vector import VectorEnv
    except ImportError as error:
        raise MissingDependencyError("gymnasium", "gym") from error
    return isinstance(env, VectorEnv)


def vector_episodes(envs: VectorEnv[Any, Any, Any], party: Party, count: int) -> list[End]:
    """Play rounds of one episode for each environment; a round ends with the last of them.

    An environment whose episode has ended is moved on by an action that changes nothing of ours,
    whatever its way of resetting, until the others are done; then all are reset. Each round is
    finished, so that short episodes count no more than long ones.

    Args:
        envs: several environments, of one kind.
        party: the players.
        count: how many episodes to play.
    """
    ends: list[End] = []
    while len(ends) < count:
        ends += _round(envs, party, min(envs.num_envs, count - len(ends)))
    return ends


def _round(envs: VectorEnv[Any, Any, Any], party: Party, count: int) -> list[End]:
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
            return [episode.end for episode in episodes if episode.end is not None]
        acting = [k for k, episode in enumerate(episodes) if episode.end is None]
        if mode is AutoresetMode.DISABLED and over.any():
            envs.reset(options={"reset_mask": over})
        shown, rewards, terminated, truncated, infos = envs.step(_batch(envs, actions))
        seen = list(iterate(envs.observation_space, shown))
        over = terminated | truncated
        for k in acting:
            last = over[k] and mode is AutoresetMode.SAME_STEP
            there = infos["final_obs"][k] if last else seen[k]
            episodes[k].observe(there, rewards[k], terminated[k], truncated[k])


def _batch(envs: VectorEnv[Any, Any, Any], actions: Sequence[Hashable]) -> Any:
    """Actions as the environments take them together."""
    from gymnasium.vector.utils import concatenate, create_empty_array

    empty: Any = create_empty_array(envs.single_action_space, n=envs.num_envs)
    return concatenate(envs.single_action_space, actions, empty)


def step_limit_of_vector(envs: VectorEnv[Any, Any, Any]) -> int | None:
    """The steps after which each environment's ``TimeLimit`` cuts an episode off; None: never."""
    makers = getattr(envs.unwrapped, "env_fns", None)
    if not makers:
        return envs.spec.max_episode_steps if envs.spec is not None else None
    env = makers[0]()
    limit = step_limit_of(env)
    env.close()
    return limit
