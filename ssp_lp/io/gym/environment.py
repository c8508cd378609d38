"""What an environment of Gymnasium's says of itself: its name, and when it cuts episodes off."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ssp_lp.errors import ModelError, in_short, optional_module

if TYPE_CHECKING:
    import gymnasium


def step_limit_of(env: gymnasium.Env[Any, Any]) -> int | None:
    """The steps after which the environment's ``TimeLimit`` cuts an episode off; None: never.

    Raises:
        MissingDependencyError: gymnasium is not installed.
        ModelError: it is no environment.
    """
    base, wrappers = (optional_module(name, "gym") for name in ("gymnasium", "gymnasium.wrappers"))
    if not hasattr(env, "unwrapped"):
        told = "an environment is needed, such as gymnasium.make('FrozenLake-v1'), not "
        raise ModelError(f"{told}{in_short(env)}")
    limits, layer = [], env
    while isinstance(layer, base.Wrapper):
        if isinstance(layer, wrappers.TimeLimit):
            limits.append(int(layer._max_episode_steps))
        layer = layer.env
    return min(limits, default=None)


def name_of_environment(env: Any) -> str:
    """What Gymnasium calls an environment, or what its class is called."""
    return str(env.spec.id if env.spec is not None else type(env.unwrapped).__name__)
