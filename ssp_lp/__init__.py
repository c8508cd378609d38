"""ssp-lp: reach the goal as cheaply as possible, and fail with probability at most epsilon."""

from importlib import import_module
from typing import TYPE_CHECKING

from ssp_lp.accumulated_cost.cost_law import CostLaw as CostLaw
from ssp_lp.analysis.evaluation import Evaluation as Evaluation, evaluate as evaluate
from ssp_lp.analysis.success_costs import success_costs as success_costs
from ssp_lp.errors import (
    InfeasibleError as InfeasibleError,
    MissingDependencyError as MissingDependencyError,
    ModelError as ModelError,
    ModelWarning as ModelWarning,
    OutOfTimeError as OutOfTimeError,
    SolverError as SolverError,
    SSPError as SSPError,
)
from ssp_lp.model import SSP as SSP
from ssp_lp.model.product import (
    HorizonSSP as HorizonSSP,
    Memory as Memory,
    ProductSSP as ProductSSP,
    product as product,
    within_steps as within_steps,
)
from ssp_lp.options import (
    ColumnGeneration as ColumnGeneration,
    DeterministicPolicies as DeterministicPolicies,
    Game as Game,
    LinearProgramming as LinearProgramming,
    Status as Status,
    progress_shown as progress_shown,
)
from ssp_lp.policies import (
    GIVE_UP as GIVE_UP,
    CostAwarePolicy as CostAwarePolicy,
    DeterministicPolicy as DeterministicPolicy,
    MixedPolicy as MixedPolicy,
    StochasticPolicy as StochasticPolicy,
    TimedPolicy as TimedPolicy,
)
from ssp_lp.policies.remembering import (
    acting_everywhere as acting_everywhere,
    on_original as on_original,
)
from ssp_lp.processes.failure_semantics import GiveUp as GiveUp
from ssp_lp.processes.quantities import (
    Constraint as Constraint,
    Quantity as Quantity,
    arrival_cost as arrival_cost,
    end_probability as end_probability,
    expected_cost as expected_cost,
    failure_probability as failure_probability,
    goal_probability as goal_probability,
    secondary_cost as secondary_cost,
    visits as visits,
)
from ssp_lp.programs.occupation_measure import (
    OccupationMeasure as OccupationMeasure,
    StateValues as StateValues,
)
from ssp_lp.solution import Solution as Solution
from ssp_lp.solve import solve as solve
from ssp_lp.verification.certify import Certificate as Certificate, certify as certify

if TYPE_CHECKING:
    from ssp_lp.analysis.simulation import simulate as simulate
    from ssp_lp.answers import Answers as Answers, solve_many as solve_many, sweep as sweep
    from ssp_lp.formulation import Formulation as Formulation
    from ssp_lp.methods.frontier import Frontier as Frontier
    from ssp_lp.methods.trade_off import (
        Surface as Surface,
        trace_frontier as trace_frontier,
        trace_surface as trace_surface,
    )
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
    from ssp_lp.programs.occupation_program import OccupationProgram as OccupationProgram
    from ssp_lp.verification.certificate_file import write_certificate as write_certificate
    from ssp_lp.verification.checker import (
        Checked as Checked,
        check_certificate as check_certificate,
    )
    from ssp_lp.verification.cross_check import CrossCheck as CrossCheck, cross_check as cross_check

__version__ = "0.1.0"

_MODULES = {
    "analysis.simulation": "simulate",
    "answers": "Answers solve_many sweep",
    "formulation": "Formulation",
    "methods.frontier": "Frontier",
    "methods.trade_off": "Surface trace_frontier trace_surface",
    "model.continuous_model": "Axis ContinuousModel Distribution Grid WorldSimulator",
    "model.discretise": "Quadrature Samples discretise",
    "programs.occupation_program": "OccupationProgram",
    "verification.certificate_file": "write_certificate",
    "verification.checker": "Checked check_certificate",
    "verification.cross_check": "CrossCheck cross_check",
}
_ON_DEMAND = {name: f"{__name__}.{of}" for of, names in _MODULES.items() for name in names.split()}
_OWN = [name for name, what in globals().items() if __name__ in getattr(what, "__module__", "")]
__all__ = sorted([*_OWN, *_ON_DEMAND])


def __getattr__(name: str) -> object:
    """Import what most processes never use when it is first asked for."""
    if name not in _ON_DEMAND:
        if name[:1].isupper():  # ``from ssp_lp import`` would not tell what an AttributeError says
            raise ImportError(
                f"there is no {name} in {__name__}; if it is a criterion: "
                f"from formulations import {name}"
            )
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    member = getattr(import_module(_ON_DEMAND[name]), name)
    globals()[name] = member
    return member
