"""ssp-lp: reach the goal as cheaply as possible, and fail with probability at most epsilon.

Public names are imported on first use, the criteria of ``formulations`` included:
``from ssp_lp import SSP, MCMP, solve``.
"""

import sys
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ssp_lp.accumulated_cost.cost_law import CostLaw as CostLaw
    from ssp_lp.analysis.evaluation import (
        Evaluation as Evaluation,
        evaluate as evaluate,
        success_costs as success_costs,
    )
    from ssp_lp.analysis.simulation import simulate as simulate
    from ssp_lp.analysis.what_if import (
        Change as Change,
        Effect as Effect,
        Number as Number,
        WhatIf as WhatIf,
    )
    from ssp_lp.analysis.worst_case import WorstCase as WorstCase
    from ssp_lp.answers import Answers as Answers, solve_many as solve_many, sweep as sweep
    from ssp_lp.errors import (
        InfeasibleError as InfeasibleError,
        MissingDependencyError as MissingDependencyError,
        ModelError as ModelError,
        ModelWarning as ModelWarning,
        OutOfTimeError as OutOfTimeError,
        SolverError as SolverError,
        SSPError as SSPError,
    )
    from ssp_lp.formulation import Formulation as Formulation
    from ssp_lp.formulations import (
        EGUBS as EGUBS,
        GUBS as GUBS,
        ISSPUDE as ISSPUDE,
        MCMP as MCMP,
        S3P as S3P,
        AlphaMCMP as AlphaMCMP,
        ConstrainedCost as ConstrainedCost,
        CostBoundedReach as CostBoundedReach,
        CostBudgetedMaxProb as CostBudgetedMaxProb,
        CostLimit as CostLimit,
        CostQuantile as CostQuantile,
        CriteriaComparison as CriteriaComparison,
        CriterionRow as CriterionRow,
        CVaR as CVaR,
        FinitePenalty as FinitePenalty,
        LeastQuantity as LeastQuantity,
        MaxProb as MaxProb,
        MinCost as MinCost,
        MinProb as MinProb,
        compare_criteria as compare_criteria,
    )
    from ssp_lp.methods.frontier import Frontier as Frontier, trace_frontier as trace_frontier
    from ssp_lp.model import SSP as SSP
    from ssp_lp.model.boxes import Boxes as Boxes, posterior_draws as posterior_draws
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
    from ssp_lp.model.parameters import Parameter as Parameter
    from ssp_lp.model.product import (
        HorizonSSP as HorizonSSP,
        Memory as Memory,
        ProductSSP as ProductSSP,
        product as product,
        within_steps as within_steps,
    )
    from ssp_lp.model.task import Task as Task, reach as reach, task as task
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
    from ssp_lp.processes.promises import (
        exceeds as exceeds,
        holds as holds,
        within as within,
    )
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
    from ssp_lp.programs.occupation_program import OccupationProgram as OccupationProgram
    from ssp_lp.solution import Solution as Solution
    from ssp_lp.solving import solve as solve
    from ssp_lp.tightening import Tightened as Tightened, tighten as tighten
    from ssp_lp.verification.certificate_file import (
        Checked as Checked,
        check_certificate as check_certificate,
        sha256_of as sha256_of,
        write_certificate as write_certificate,
    )
    from ssp_lp.verification.certify import Certificate as Certificate, certify as certify
    from ssp_lp.verification.cross_check import CrossCheck as CrossCheck, cross_check as cross_check
    from ssp_lp.verification.vipr import to_vipr as to_vipr

__version__ = "0.1.0"

_MODULES = {
    "accumulated_cost.cost_law": "CostLaw",
    "analysis.evaluation": "Evaluation evaluate success_costs",
    "analysis.simulation": "simulate",
    "analysis.worst_case": "WorstCase",
    "analysis.what_if": "Change Effect Number WhatIf",
    "answers": "Answers solve_many sweep",
    "errors": (
        "InfeasibleError MissingDependencyError ModelError ModelWarning OutOfTimeError "
        "SSPError SolverError"
    ),
    "formulation": "Formulation",
    "methods.frontier": "Frontier trace_frontier",
    "model": "SSP",
    "model.boxes": "Boxes posterior_draws",
    "model.continuous_model": "Axis ContinuousModel Distribution Grid WorldSimulator",
    "model.discretise": "Quadrature Samples discretise",
    "model.parameters": "Parameter",
    "model.product": "HorizonSSP Memory ProductSSP product within_steps",
    "model.task": "Task reach task",
    "options": (
        "ColumnGeneration DeterministicPolicies Game LinearProgramming Status progress_shown"
    ),
    "policies": (
        "CostAwarePolicy DeterministicPolicy GIVE_UP MixedPolicy StochasticPolicy TimedPolicy"
    ),
    "policies.remembering": "acting_everywhere on_original",
    "processes.failure_semantics": "GiveUp",
    "processes.promises": "exceeds holds within",
    "processes.quantities": (
        "Constraint Quantity arrival_cost end_probability expected_cost failure_probability "
        "goal_probability secondary_cost visits"
    ),
    "programs.occupation_measure": "OccupationMeasure StateValues",
    "programs.occupation_program": "OccupationProgram",
    "solution": "Solution",
    "solving": "solve",
    "tightening": "Tightened tighten",
    "verification.certificate_file": "Checked check_certificate sha256_of write_certificate",
    "verification.certify": "Certificate certify",
    "verification.cross_check": "CrossCheck cross_check",
    "verification.vipr": "to_vipr",
}
_ON_DEMAND = {name: f"{__name__}.{of}" for of, names in _MODULES.items() for name in names.split()}


def _add_formulations() -> None:
    """Make the criteria importable: an installed wheel holds them inside, a checkout beside it.

    In both cases the modules have the same name, so that a pickle made with the one is read with
    the other, and another package called ``formulations`` does no harm.
    """
    inner = f"{__name__}.formulations"
    if find_spec(inner) is None:
        beside = Path(__file__).parents[1] / "formulations" / "__init__.py"
        spec = spec_from_file_location(inner, beside)
        if spec is None or spec.loader is None or not beside.exists():
            raise ImportError(f"{__name__} is not complete: there is no {beside}")
        sys.modules[inner] = globals()["formulations"] = module_from_spec(spec)
        spec.loader.exec_module(sys.modules[inner])
    for name in import_module(inner).__all__:
        _ON_DEMAND.setdefault(name, inner)


_add_formulations()
__all__ = sorted(_ON_DEMAND)


def __dir__() -> list[str]:
    """Return the public names, whether they have been asked for or not."""
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> object:
    """Import a name on first use: the help of the command line needs no such import."""
    if name in _ON_DEMAND:
        globals()[name] = member = getattr(import_module(_ON_DEMAND[name]), name)
        return member
    if name.isidentifier() and name[0] != "_" and find_spec(f"{__name__}.{name}"):
        return import_module(f"{__name__}.{name}")
    if name[:1] == "_":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ssp_lp.errors import did_you_mean

    message = f"there is no {name} in {__name__}{did_you_mean(name, __all__)}"
    # ``from ssp_lp import`` replaces the text of an AttributeError, and ``hasattr`` needs one
    if sys._getframe(1).f_code.co_name == "_handle_fromlist":
        raise ImportError(message, name=__name__)
    raise AttributeError(message)
