"""The paper's construction as an independent method: value iteration and a game, without any LP."""

from ssp_lp.game.equilibrium import (
    Equilibrium as Equilibrium,
    Game as Game,
    Mixture as Mixture,
    delta_mixture as delta_mixture,
    play as play,
)
from ssp_lp.game.optimum import (
    GameSolution as GameSolution,
    bayes_adaptive as bayes_adaptive,
    bayes_player as bayes_player,
    belief_at as belief_at,
    posterior as posterior,
    stationary_game as stationary_game,
    stationary_player as stationary_player,
    thresholds as thresholds,
)
