"""Public names of ``ssp_lp``, which Python and type checkers read here."""

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

__version__: str
__all__: list[str]
