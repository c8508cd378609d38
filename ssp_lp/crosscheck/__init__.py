"""The paper's own construction as a second opinion: value iteration and a game, no LP anywhere."""

from ssp_lp.crosscheck.stationary import StationaryGame, stationary_game, thresholds

__all__ = ["StationaryGame", "stationary_game", "thresholds"]
