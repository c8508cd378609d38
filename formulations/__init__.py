"""Formulations: one criterion of the literature per file, all solved by ``ssp_lp.solve``."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from formulations.alpha_mcmp import AlphaMCMP as AlphaMCMP
    from formulations.comparison import (
        CriteriaComparison as CriteriaComparison,
        CriterionRow as CriterionRow,
        compare_criteria as compare_criteria,
    )
    from formulations.constrained_cost import ConstrainedCost as ConstrainedCost
    from formulations.cost_bounded_reach import CostBoundedReach as CostBoundedReach
    from formulations.cost_budgeted_maxprob import CostBudgetedMaxProb as CostBudgetedMaxProb
    from formulations.cost_quantile import CostQuantile as CostQuantile
    from formulations.cvar import CVaR as CVaR
    from formulations.egubs import EGUBS as EGUBS
    from formulations.finite_penalty import FinitePenalty as FinitePenalty
    from formulations.gubs import GUBS as GUBS
    from formulations.isspude import ISSPUDE as ISSPUDE
    from formulations.least_quantity import LeastQuantity as LeastQuantity
    from formulations.maxprob import MaxProb as MaxProb
    from formulations.mcmp import MCMP as MCMP
    from formulations.min_cost import MinCost as MinCost
    from formulations.minprob import MinProb as MinProb
    from formulations.s3p import S3P as S3P
    from ssp_lp.formulation import CostLimit as CostLimit

PAGES = {
    "AlphaMCMP": "alpha_mcmp",
    "ConstrainedCost": "constrained_cost",
    "CostBoundedReach": "cost_bounded_reach",
    "CostBudgetedMaxProb": "cost_budgeted_maxprob",
    "CostQuantile": "cost_quantile",
    "CVaR": "cvar",
    "EGUBS": "egubs",
    "FinitePenalty": "finite_penalty",
    "GUBS": "gubs",
    "ISSPUDE": "isspude",
    "LeastQuantity": "least_quantity",
    "MaxProb": "maxprob",
    "MCMP": "mcmp",
    "MinCost": "min_cost",
    "MinProb": "minprob",
    "S3P": "s3p",
}
"""The page of each criterion, imported when it is first asked for."""

_ON_DEMAND = {name: f"formulations.{page}" for name, page in PAGES.items()} | {
    "CriteriaComparison": "formulations.comparison",
    "CriterionRow": "formulations.comparison",
    "compare_criteria": "formulations.comparison",
    "CostLimit": "ssp_lp.formulation",
}

__all__ = sorted(_ON_DEMAND)


def __getattr__(name: str) -> object:
    """Import a page when it is first asked for, so that the command line begins at once."""
    if name not in _ON_DEMAND:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    member = getattr(import_module(_ON_DEMAND[name]), name)
    globals()[name] = member
    return member
