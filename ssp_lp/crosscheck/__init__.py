"""The paper's own construction as a second opinion: value iteration and a game, no LP anywhere."""

from ssp_lp.crosscheck.bayes import BayesAdaptive, bayes_adaptive
from ssp_lp.crosscheck.belief import belief_at, posterior
from ssp_lp.crosscheck.game import Equilibrium, Game, play
from ssp_lp.crosscheck.mixture import DeltaMixture, delta_mixture
from ssp_lp.crosscheck.stationary import StationaryGame, stationary_game, thresholds

__all__ = [
    "BayesAdaptive",
    "DeltaMixture",
    "Equilibrium",
    "Game",
    "StationaryGame",
    "bayes_adaptive",
    "belief_at",
    "delta_mixture",
    "play",
    "posterior",
    "stationary_game",
    "thresholds",
]
