"""The nearly optimal mixed policy z*_delta of section 3.4 of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.game.best_responses.best_response import BestResponse, Player
from ssp_lp.game.equilibrium import Game, matrix_game
from ssp_lp.policies import MixedPolicy

_ACCURACY = 1e-12


@dataclass(frozen=True, eq=False)
class DeltaMixture:
    """A lottery over the best responses to alpha* - delta and alpha* + delta (Theorem 3-4)."""

    delta: float
    game: Game
    minus: BestResponse  # best response to alpha* - delta
    plus: BestResponse  # best response to alpha* + delta
    weight: float  # of ``plus``: the player's solution of the 2 x 2 game

    @property
    def objective(self) -> float:
        """J_obj(x'; z*_delta)."""
        return (1.0 - self.weight) * self.minus.objective + self.weight * self.plus.objective

    @property
    def condition(self) -> float:
        """J_cond(x'; z*_delta)."""
        return (1.0 - self.weight) * self.minus.condition + self.weight * self.plus.condition

    @property
    def value(self) -> float:
        """What the lottery pays at worst; it tends to the value of the game as delta goes to 0."""
        return max(self.objective, self.game.scale * self.condition)

    def policy(self, player: Player) -> MixedPolicy:
        """The lottery on the original states."""
        weights = np.array([1.0 - self.weight, self.weight])
        used = np.flatnonzero(weights > 0.0)
        members = tuple(player.policy((self.minus, self.plus)[k]) for k in used)
        return MixedPolicy(members, weights[used])


def delta_mixture(player: Player, game: Game, alpha: float, delta: float) -> DeltaMixture:
    """Mix the best responses on the two sides of alpha*.

    Where no other kink of ``J*(alpha)`` lies within delta of alpha*, the two are the policies that
    meet there and the mixture is optimal. Otherwise each pays at alpha* at most delta times its
    slope more than the game is worth, and so does the mixture, which pays at worst what both pay
    where they cross (the proof of Theorem 3-4 allows 2 delta times the steepest slope).

    Args:
        player: finds best responses.
        game: at c*, and in case S at epsilon*.
        alpha: alpha*.
        delta: distance from it, above 0; the two sides end at 0 and 1.
    """
    minus = game.best_response(player, max(alpha - delta, 0.0), _ACCURACY)
    plus = game.best_response(player, min(alpha + delta, 1.0), _ACCURACY)
    return DeltaMixture(delta, game, minus, plus, matrix_game(game, minus, plus))
