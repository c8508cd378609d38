"""Gymnasium's frozen lake: a certified policy, simulated in the environment.

    python examples/formulating/frozen_lake.py

The environment ends every episode after 100 steps. The policy of a model that counts steps fails no
more often in the environment than certified; the policy of a model without steps does.
"""

import sys
import warnings

import gymnasium as gym

from ssp_lp import MCMP, solve
from ssp_lp.io import StepLimitWarning, from_gymnasium, rollout

if {"-h", "--help"} & set(sys.argv):
    print(__doc__)
    sys.exit()

warnings.simplefilter("ignore", StepLimitWarning)  # the second round is about it
env = gym.make("FrozenLake-v1", map_name="8x8")
for horizon in ("env", None):
    world = from_gymnasium(env, horizon=horizon)
    solution = solve(MCMP(world.model, world.start, failure_budget=0.4))
    print(f"steps are counted up to {world.horizon}: {world.model!r}")
    print(f"certified failure {solution.failure_probability:.4f}, steps {solution.objective:.3f}")
    print(rollout(env, solution.policy, episodes=1000, seed=0).summary())
