"""The model: a stochastic shortest path problem with dead-ends, and facts about its graph."""

from ssp_lp.model.ssp import SSP

__all__ = ["SSP"]
