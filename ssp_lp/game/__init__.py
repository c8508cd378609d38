"""The paper's own construction as a second opinion: value iteration and a game, no LP anywhere."""

from ssp_lp.game.equilibrium import Equilibrium, Game, Mixture, delta_mixture, play
from ssp_lp.game.optimum import (
    GameSolution,
    bayes_adaptive,
    bayes_player,
    belief_at,
    posterior,
    stationary_game,
    stationary_player,
    thresholds,
)

__all__ = [
    "Equilibrium",
    "Game",
    "GameSolution",
    "Mixture",
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
