"""Policies on the original states, with the memory that they need."""

from ssp_lp.policies.cost_aware import CostAwarePolicy as CostAwarePolicy
from ssp_lp.policies.policy import (
    GIVE_UP as GIVE_UP,
    Decision as Decision,
    Episode as Episode,
    MixedPolicy as MixedPolicy,
    Policy as Policy,
)
from ssp_lp.policies.remembering import TimedPolicy as TimedPolicy
from ssp_lp.policies.stationary import (
    DeterministicPolicy as DeterministicPolicy,
    StochasticPolicy as StochasticPolicy,
)
