"""Policies on the original states, with the memory that they need."""

from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.deterministic import DeterministicPolicy
from ssp_lp.policies.episodes import Episode
from ssp_lp.policies.mixed import MixedPolicy
from ssp_lp.policies.policy import GIVE_UP, Decision, Policy
from ssp_lp.policies.stochastic import StochasticPolicy
from ssp_lp.policies.timed import TimedPolicy

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
