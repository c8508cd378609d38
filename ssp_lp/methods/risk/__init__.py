"""Risk of the total cost given success: its quantile and its conditional value at risk."""

from ssp_lp.methods.risk.question import Near, pose_compiled
from ssp_lp.methods.risk.solving import risk_bound, solve_for_risk

__all__ = ["Near", "pose_compiled", "risk_bound", "solve_for_risk"]
