"""Policies on the states of the original model, with their memory."""

from ssp_lp.policies.cost_aware import CostAwarePolicy as CostAwarePolicy
from ssp_lp.policies.policy import (
    GIVE_UP as GIVE_UP,
    Decision as Decision,
    DeterministicPolicy as DeterministicPolicy,
    Episode as Episode,
    MixedPolicy as MixedPolicy,
    Policy as Policy,
    StochasticPolicy as StochasticPolicy,
)
from ssp_lp.policies.remembering import (
    CompletePolicy as CompletePolicy,
    TimedPolicy as TimedPolicy,
)
