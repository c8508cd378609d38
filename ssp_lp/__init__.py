"""ssp-lp: reach the goal as cheaply as possible, and fail with probability at most epsilon."""

from importlib import import_module
from typing import TYPE_CHECKING

from ssp_lp.analysis.cost_law import CostLaw, success_costs
from ssp_lp.analysis.evaluation import Evaluation, evaluate
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
from ssp_lp.processes.quantities import (
    Constraint,
    Quantity,
    arrival_cost,
    end_probability,
    expected_cost,
    failure_probability,
    goal_probability,
    secondary_cost,
    visits,
)
from ssp_lp.solution import Solution
from ssp_lp.solve import solve
from ssp_lp.verification.certify import Certificate, certify

if TYPE_CHECKING:
    from ssp_lp.analysis.frontier import Frontier as Frontier, trace_frontier as trace_frontier
    from ssp_lp.analysis.simulation import simulate as simulate
    from ssp_lp.formulation import Formulation as Formulation
    from ssp_lp.model.continuous_model import (
        Axis as Axis,
        ContinuousModel as ContinuousModel,
        Distribution as Distribution,
        Grid as Grid,
        WorldSimulator as WorldSimulator,
    )
    from ssp_lp.model.discretise import (
        Quadrature as Quadrature,
        Samples as Samples,
        discretise as discretise,
    )
    from ssp_lp.model.product import (
        HorizonSSP as HorizonSSP,
        Memory as Memory,
        ProductSSP as ProductSSP,
        product as product,
        within_steps as within_steps,
    )
    from ssp_lp.policies.remembering import on_original as on_original
    from ssp_lp.programs.occupation_measure import (
        OccupationMeasure as OccupationMeasure,
        StateValues as StateValues,
    )
    from ssp_lp.programs.occupation_program import OccupationProgram as OccupationProgram
    from ssp_lp.verification.cross_check import CrossCheck as CrossCheck, cross_check as cross_check

__version__ = "0.1.0"

__all__ = [
    "GIVE_UP",
    "SSP",
    "Certificate",
    "ColumnGeneration",
    "Constraint",
    "CostAwarePolicy",
    "CostLaw",
    "DeterministicPolicies",
    "DeterministicPolicy",
    "Evaluation",
    "Game",
    "GiveUp",
    "InfeasibleError",
    "LinearProgramming",
    "MissingDependencyError",
    "MixedPolicy",
    "ModelError",
    "OutOfTimeError",
    "Quantity",
    "SSPError",
    "Solution",
    "SolverError",
    "Status",
    "StochasticPolicy",
    "TimedPolicy",
    "arrival_cost",
    "certify",
    "end_probability",
    "evaluate",
    "expected_cost",
    "failure_probability",
    "goal_probability",
    "progress_shown",
    "secondary_cost",
    "solve",
    "success_costs",
    "visits",
]

_MODULES = {
    "analysis.frontier": "Frontier trace_frontier",
    "analysis.simulation": "simulate",
    "formulation": "Formulation",
    "model.continuous_model": "Axis ContinuousModel Distribution Grid WorldSimulator",
    "model.discretise": "Quadrature Samples discretise",
    "model.product": "HorizonSSP Memory ProductSSP product within_steps",
    "policies.remembering": "on_original",
    "programs.occupation_measure": "OccupationMeasure StateValues",
    "programs.occupation_program": "OccupationProgram",
    "verification.cross_check": "CrossCheck cross_check",
}
_ON_DEMAND = {name: f"{__name__}.{of}" for of, names in _MODULES.items() for name in names.split()}
__all__ += sorted(_ON_DEMAND)


def __getattr__(name: str) -> object:
    """Import what most processes never use when it is first asked for."""
    if name not in _ON_DEMAND:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_ON_DEMAND[name]), name)
    globals()[name] = found
    return found
