"""Risk of the total cost given success: its quantile and its conditional value at risk."""

from ssp_lp.methods.risk.least_risk import risk_bound, solve_for_risk

__all__ = ["risk_bound", "solve_for_risk"]
