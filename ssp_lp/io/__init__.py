"""Models, policies and solutions in and out: files, arrays, environments of others."""

from ssp_lp.io.gym_environments import GymnasiumWorld, from_gymnasium
from ssp_lp.io.gym_rollout import RolloutReport, StepLimitWarning, rollout

__all__ = [
    "GymnasiumWorld",
    "RolloutReport",
    "StepLimitWarning",
    "from_gymnasium",
    "rollout",
]
