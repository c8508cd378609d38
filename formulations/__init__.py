"""Formulations: one criterion of the literature per file, all solved by ``ssp_lp.solve``.

They are imported from ``ssp_lp``, whose wheel contains this folder: ``from ssp_lp import MCMP``.
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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
"""Module of each criterion, imported on first use."""

_ON_DEMAND = {name: f"{__name__}.{page}" for name, page in PAGES.items()} | {
    "CriteriaComparison": f"{__name__}.comparison",
    "CriterionRow": f"{__name__}.comparison",
    "compare_criteria": f"{__name__}.comparison",
    "CostLimit": "ssp_lp.formulation",
}

__all__ = sorted(_ON_DEMAND)


def __getattr__(name: str) -> object:
    """Import a page on first use, so that the command line starts at once."""
    if name not in _ON_DEMAND:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    member = getattr(import_module(_ON_DEMAND[name]), name)
    globals()[name] = member
    return member


if __name__ == "formulations":  # a checkout's folder by its bare name: the same modules, not twins
    for _page in {*PAGES.values(), "comparison", "command_line.arguments", "command_line.commands"}:
        import_module(f"ssp_lp.formulations.{_page}")
    for _name in [name for name in sys.modules if name.startswith("ssp_lp.formulations")]:
        sys.modules[_name.removeprefix("ssp_lp.")] = sys.modules[_name]
