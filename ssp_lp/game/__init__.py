"""The paper's own construction as a second opinion: value iteration and a game, no LP anywhere."""

from ssp_lp.game.bayes_adaptive.belief import belief_at, posterior
from ssp_lp.game.bayes_adaptive.iteration import bayes_adaptive, bayes_player
from ssp_lp.game.equilibrium import Equilibrium, Game, play
from ssp_lp.game.mixture import DeltaMixture, delta_mixture
from ssp_lp.game.solution import GameSolution
from ssp_lp.game.stationary import stationary_game, stationary_player, thresholds

__all__ = [
    "DeltaMixture",
    "Equilibrium",
    "Game",
    "GameSolution",
    "bayes_adaptive",
    "bayes_player",
    "belief_at",
    "delta_mixture",
    "play",
    "posterior",
    "stationary_game",
    "stationary_player",
    "thresholds",
]
