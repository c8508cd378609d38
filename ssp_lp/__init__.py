"""ssp-lp: reach the goal as cheaply as possible, and fail with probability at most epsilon."""

from importlib import import_module
from typing import TYPE_CHECKING

from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.analysis.total_cost.cost_law import CostLaw, success_costs
from ssp_lp.errors import (
    InfeasibleError,
    MissingDependencyError,
    ModelError,
    OutOfTimeError,
    SolverError,
    SSPError,
)
from ssp_lp.model import SSP
from ssp_lp.options import (
    ColumnGeneration,
    DeterministicPolicies,
    Game,
    LinearProgramming,
    Status,
    progress_shown,
)
from ssp_lp.policies import (
    GIVE_UP,
    CostAwarePolicy,
    DeterministicPolicy,
    MixedPolicy,
    StochasticPolicy,
    TimedPolicy,
)
from ssp_lp.processes.failure_semantics import GiveUp
from ssp_lp.processes.quantities.quantity import (
    Constraint,
    Quantity,
    end_probability,
    expected_cost,
    failure_probability,
    goal_probability,
    secondary_cost,
    visits,
)
from ssp_lp.solution import Solution
from ssp_lp.solve import solve
from ssp_lp.verification.certificate import Certificate
from ssp_lp.verification.certifying import certify

if TYPE_CHECKING:
    from ssp_lp.analysis.frontier import Frontier
    from ssp_lp.analysis.frontier_tracing import trace_frontier
    from ssp_lp.analysis.simulation import simulate
    from ssp_lp.formulation import Formulation
    from ssp_lp.model.discretisation.continuous_model import ContinuousModel
    from ssp_lp.model.discretisation.discretise import discretise
    from ssp_lp.model.discretisation.distribution import Distribution
    from ssp_lp.model.discretisation.grid import Axis, Grid
    from ssp_lp.model.discretisation.points import Quadrature, Samples
    from ssp_lp.model.discretisation.simulator import WorldSimulator
    from ssp_lp.model.product import Memory, ProductSSP, product
    from ssp_lp.model.within_steps import HorizonSSP, within_steps
    from ssp_lp.policies.remembering import on_original
    from ssp_lp.programs.occupation_measure import OccupationMeasure
    from ssp_lp.programs.occupation_program import OccupationProgram
    from ssp_lp.verification.cross_check import CrossCheck, cross_check

__version__ = "0.1.0"

__all__ = [
    "GIVE_UP",
    "SSP",
    "Axis",
    "Certificate",
    "ColumnGeneration",
    "Constraint",
    "ContinuousModel",
    "CostAwarePolicy",
    "CostLaw",
    "CrossCheck",
    "DeterministicPolicies",
    "DeterministicPolicy",
    "Distribution",
    "Evaluation",
    "Formulation",
    "Frontier",
    "Game",
    "GiveUp",
    "Grid",
    "HorizonSSP",
    "InfeasibleError",
    "LinearProgramming",
    "Memory",
    "MissingDependencyError",
    "MixedPolicy",
    "ModelError",
    "OccupationMeasure",
    "OccupationProgram",
    "OutOfTimeError",
    "ProductSSP",
    "Quadrature",
    "Quantity",
    "SSPError",
    "Samples",
    "Solution",
    "SolverError",
    "Status",
    "StochasticPolicy",
    "TimedPolicy",
    "WorldSimulator",
    "certify",
    "cross_check",
    "discretise",
    "end_probability",
    "evaluate",
    "expected_cost",
    "failure_probability",
    "goal_probability",
    "on_original",
    "product",
    "progress_shown",
    "secondary_cost",
    "simulate",
    "solve",
    "success_costs",
    "trace_frontier",
    "visits",
    "within_steps",
]

_ON_DEMAND = {
    "Axis": "ssp_lp.model.discretisation.grid",
    "ContinuousModel": "ssp_lp.model.discretisation.continuous_model",
    "Distribution": "ssp_lp.model.discretisation.distribution",
    "Grid": "ssp_lp.model.discretisation.grid",
    "Quadrature": "ssp_lp.model.discretisation.points",
    "Samples": "ssp_lp.model.discretisation.points",
    "WorldSimulator": "ssp_lp.model.discretisation.simulator",
    "discretise": "ssp_lp.model.discretisation.discretise",
    "Formulation": "ssp_lp.formulation",
    "Memory": "ssp_lp.model.product",
    "ProductSSP": "ssp_lp.model.product",
    "product": "ssp_lp.model.product",
    "HorizonSSP": "ssp_lp.model.within_steps",
    "within_steps": "ssp_lp.model.within_steps",
    "on_original": "ssp_lp.policies.remembering",
    "OccupationMeasure": "ssp_lp.programs.occupation_measure",
    "OccupationProgram": "ssp_lp.programs.occupation_program",
    "CrossCheck": "ssp_lp.verification.cross_check",
    "cross_check": "ssp_lp.verification.cross_check",
    "Frontier": "ssp_lp.analysis.frontier",
    "trace_frontier": "ssp_lp.analysis.frontier_tracing",
    "simulate": "ssp_lp.analysis.simulation",
}


def __getattr__(name: str) -> object:
    """Import what most processes never use when it is first asked for."""
    if name not in _ON_DEMAND:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_ON_DEMAND[name]), name)
    globals()[name] = found
    return found
