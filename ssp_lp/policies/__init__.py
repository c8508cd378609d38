"""Policies on the original states, with the memory that they need."""

from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import GIVE_UP, Decision, Episode, MixedPolicy, Policy
from ssp_lp.policies.remembering import TimedPolicy
from ssp_lp.policies.stationary import DeterministicPolicy, StochasticPolicy

__all__ = [
    "GIVE_UP",
    "CostAwarePolicy",
    "Decision",
    "DeterministicPolicy",
    "Episode",
    "MixedPolicy",
    "Policy",
    "StochasticPolicy",
    "TimedPolicy",
]
