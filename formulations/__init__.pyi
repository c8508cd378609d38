"""Public names of ``formulations``, which Python and type checkers read here."""

from ssp_lp.formulation import CostLimit as CostLimit

from .alpha_mcmp import AlphaMCMP as AlphaMCMP
from .comparison import (
    CriteriaComparison as CriteriaComparison,
    CriterionRow as CriterionRow,
    compare_criteria as compare_criteria,
)
from .constrained_cost import ConstrainedCost as ConstrainedCost
from .cost_bounded_reach import CostBoundedReach as CostBoundedReach
from .cost_budgeted_maxprob import CostBudgetedMaxProb as CostBudgetedMaxProb
from .cost_quantile import CostQuantile as CostQuantile
from .cvar import CVaR as CVaR
from .egubs import EGUBS as EGUBS
from .finite_penalty import FinitePenalty as FinitePenalty
from .gubs import GUBS as GUBS
from .isspude import ISSPUDE as ISSPUDE
from .least_quantity import LeastQuantity as LeastQuantity
from .maxprob import MaxProb as MaxProb
from .mcmp import MCMP as MCMP
from .min_cost import MinCost as MinCost
from .minprob import MinProb as MinProb
from .s3p import S3P as S3P

__all__: list[str]
PAGES: dict[str, str]
