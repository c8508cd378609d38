"""ssp-lp: reach the goal as cheaply as possible, and fail with probability at most epsilon."""

from ssp_lp.agreement import Agreement, cross_check
from ssp_lp.certificate import Certificate, certify
from ssp_lp.cost_law import CostLaw, success_costs
from ssp_lp.errors import (
    InfeasibleError,
    MissingDependencyError,
    ModelError,
    SolverError,
    SSPError,
)
from ssp_lp.evaluation import Evaluation, evaluate
from ssp_lp.frontier import Frontier, trace_frontier
from ssp_lp.model import SSP
from ssp_lp.policies import (
    GIVE_UP,
    CostAwarePolicy,
    DeterministicPolicy,
    MixedPolicy,
    StochasticPolicy,
    TimedPolicy,
)
from ssp_lp.process.semantics import GiveUp
from ssp_lp.simulation import simulate
from ssp_lp.solution import Solution
from ssp_lp.solve import solve

__version__ = "0.1.0"

__all__ = [
    "GIVE_UP",
    "SSP",
    "Agreement",
    "Certificate",
    "CostAwarePolicy",
    "CostLaw",
    "DeterministicPolicy",
    "Evaluation",
    "Frontier",
    "GiveUp",
    "InfeasibleError",
    "MissingDependencyError",
    "MixedPolicy",
    "ModelError",
    "SSPError",
    "Solution",
    "SolverError",
    "StochasticPolicy",
    "TimedPolicy",
    "certify",
    "cross_check",
    "evaluate",
    "simulate",
    "solve",
    "success_costs",
    "trace_frontier",
]
