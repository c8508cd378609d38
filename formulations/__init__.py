"""Formulations: one criterion of the literature per file, all solved by ``ssp_lp.solve``."""

from formulations.alpha_mcmp import AlphaMCMP
from formulations.comparison import CriteriaComparison, CriterionRow, compare_criteria
from formulations.constrained_cost import ConstrainedCost
from formulations.cost_bounded_reach import CostBoundedReach
from formulations.cost_budgeted_maxprob import CostBudgetedMaxProb
from formulations.cost_quantile import CostQuantile
from formulations.cvar import CVaR
from formulations.egubs import EGUBS
from formulations.finite_penalty import FinitePenalty
from formulations.gubs import GUBS
from formulations.isspude import ISSPUDE
from formulations.least_quantity import LeastQuantity
from formulations.maxprob import MaxProb
from formulations.mcmp import MCMP
from formulations.min_cost import MinCost
from formulations.minprob import MinProb
from formulations.s3p import S3P
from ssp_lp.formulation import CostLimit

__all__ = [
    "EGUBS",
    "GUBS",
    "ISSPUDE",
    "MCMP",
    "S3P",
    "AlphaMCMP",
    "CVaR",
    "ConstrainedCost",
    "CostBoundedReach",
    "CostBudgetedMaxProb",
    "CostLimit",
    "CostQuantile",
    "CriteriaComparison",
    "CriterionRow",
    "FinitePenalty",
    "LeastQuantity",
    "MaxProb",
    "MinCost",
    "MinProb",
    "compare_criteria",
]
