"""The two-person zero-sum game at a fixed c (paper, section 3.2), and the lotteries of section 3.4.

The adversary mixes two MDPs: the objective MDP with weight alpha, and the failure MDP. The player
chooses a policy. The payoff ``alpha * J_obj + (1 - alpha) * (eta / epsilon) * J_cond``, which the
player minimises, is linear in alpha for each policy. The least payoff ``J*(alpha)`` over all
policies is therefore concave and piecewise linear. Its maximum lies where the lines of two policies
cross: one policy fails less, the other costs less.

If the goal is hardly ever reached, J_cond is nearly 1. To keep the digits of J_cond, payoffs then
contain J_cond - 1 in place of J_cond: J_cond is *counted from the origin* 1 rather than 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.errors import ModelError, check_between_0_and_1, wrong_argument
from ssp_lp.game.player import BestResponse, Player, check_alpha
from ssp_lp.model.arguments import explained
from ssp_lp.policies import MixedPolicy

_MOST_ROUNDS = 1_000
_ACCURACY = 1e-12
_LEVEL = 1e-12
"""Slope, as a share of eta, up to which a line is level. Level lines count as rising, so that among
all alpha of a flat maximum the greatest is found, which gives the best bound of c*."""


@dataclass(frozen=True)
class Game:
    """The game of the paper's equation j_c_gamma_def at a given stake and failure budget."""

    stake: float  # eta(epsilon; c): c in case M, c * (1 - epsilon) in case S
    budget: float  # epsilon
    room: float | None = None  # epsilon - origin, if it has more digits than the budget

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for a stake below 0, or a budget that is not above 0."""
        if not (self.stake >= 0.0 and self.budget > 0.0):
            raise ModelError(f"a game needs a stake >= 0 and a budget above 0: {self!r}")

    @property
    def scale(self) -> float:
        """Factor of J_cond in the payoff: eta / epsilon, the stake divided by the budget."""
        return self.stake / self.budget

    def payoff(self, alpha: float, response: BestResponse) -> float:
        """Return a policy's payoff at a weight alpha, with J_cond counted from its origin."""
        return response.payoff(alpha, (1.0 - alpha) * self.scale)

    def size(self, alpha: float, response: BestResponse) -> float:
        """Return the sum of the absolute terms of a payoff, to which tolerances are relative."""
        return response.size(alpha, (1.0 - alpha) * self.scale)

    def failure_term(self, alpha: float, origin: float) -> float:
        """Return the failure term of the payoff if the whole budget is used: (1 - alpha) eta.

        If ``origin`` is 1, J_cond is counted from 1.
        """
        if origin == 0.0:
            return (1.0 - alpha) * self.stake
        room = self.budget - origin if self.room is None else self.room
        return (1.0 - alpha) * self.scale * room

    def excess(self, response: BestResponse) -> float:
        """Return the slope in alpha of a policy's payoff: J_obj - scale * J_cond."""
        return response.objective - self.scale * response.condition

    def rises_with_alpha(self, response: BestResponse) -> bool:
        """Return whether a policy's payoff increases with alpha or is constant."""
        return self.excess(response) >= -_LEVEL * self.stake

    def best_response(self, player: Player, alpha: float, accuracy: float) -> BestResponse:
        """Find a policy of least payoff at alpha, with a lower bound of this payoff."""
        return player.response(alpha, (1.0 - alpha) * self.scale, accuracy)


@dataclass(frozen=True, eq=False)
class Mixture:
    """A lottery over two policies, weighted by the solution of the 2 x 2 game of section 3.4."""

    game: Game
    minus: BestResponse  # optimal just below alpha*: it fails less and costs more
    plus: BestResponse  # optimal just above alpha*

    @cached_property
    def weight(self) -> float:
        """Weight of ``plus``: the equilibrium of the 2 x 2 game of section 3.4, in closed form.

        The rows of this game are the two policies, its columns the two MDPs. A policy's payoffs are
        J_obj and (eta / epsilon) J_cond. The greater of the mixture's two payoffs is a convex
        function of the weight. It is least where both payoffs are equal, or at weight 0 or 1.
        """
        low, high = self.game.excess(self.minus), self.game.excess(self.plus)
        weights = [0.0, 1.0] + ([low / (low - high)] if low * high < 0.0 else [])
        return min(weights, key=lambda weight: self._worst(*self._costs(weight)))

    def _costs(self, weight: float) -> tuple[float, float]:
        """Return J_obj and J_cond of the mixture with a given weight of ``plus``."""
        minus, plus = self.minus, self.plus
        objective = (1.0 - weight) * minus.objective + weight * plus.objective
        return objective, (1.0 - weight) * minus.condition + weight * plus.condition

    def _worst(self, objective: float, condition: float) -> float:
        """Return the greater of the payoffs against the two MDPs, from J_obj and J_cond."""
        return max(objective, self.game.scale * condition)

    @property
    def objective(self) -> float:
        """J_obj of the mixture: the expected cost, in case S of successful runs only."""
        return self._costs(self.weight)[0]

    @property
    def condition(self) -> float:
        """J_cond of the mixture: the discounted failure probability."""
        return self._costs(self.weight)[1]

    @property
    def value(self) -> float:
        """Greater of the mixture's payoffs against the two MDPs."""
        return self._worst(self.objective, self.condition)

    def policy(self, player: Player) -> MixedPolicy:
        """Return the mixture as a policy on the original states."""
        weights = np.array([1.0 - self.weight, self.weight])
        used = np.flatnonzero(weights > 0.0)
        members = tuple(player.policy((self.minus, self.plus)[k]) for k in used)
        return MixedPolicy(members, weights[used])


@dataclass(frozen=True, eq=False)
class Equilibrium(Mixture):
    """Bounds of a game's value, and the two policies whose payoffs are equal at alpha*."""

    alpha: float  # alpha*: the adversary's weight of the objective MDP
    bound: float  # of every policy's payoff at alpha, with J_cond counted from the origin
    responses: tuple[BestResponse, ...]  # every policy found during the search

    @property
    def most(self) -> float:
        """Upper bound of the mixture's payoff, with J_cond counted from the origin."""
        return min(self.game.payoff(self.alpha, side) for side in (self.minus, self.plus))

    @property
    def least(self) -> float:
        """Lower bound of J*(alpha*), with J_cond counted from the origin."""
        return min(self.bound, self.most)

    @property
    def origin(self) -> float:
        """Origin from which J_cond is counted: 1 if the goal is hardly ever reached, else 0."""
        return self.minus.origin

    @property
    def lower(self) -> float:
        """Lower bound of the game's value: no lottery guarantees less than J*(alpha*)."""
        return self.least + self._shift

    @property
    def upper(self) -> float:
        """Upper bound of the game's value: the mixture of the two policies pays at most this."""
        return self.most + self._shift

    @property
    def _shift(self) -> float:
        """Part of a payoff that is left out if J_cond is counted from the origin."""
        return (1.0 - self.alpha) * self.game.scale * self.origin

    @property
    def failure_price(self) -> float:
        """Price of failure in units of J_obj: (eta / epsilon) (1 - alpha) / alpha.

        At c* it is lambda in case M, kappa in case S.
        """
        return self.game.scale * (1.0 - self.alpha) / self.alpha if self.alpha > 0.0 else np.inf


def crossing(game: Game, minus: BestResponse, plus: BestResponse) -> float:
    """Return the alpha in [0, 1] at which two policies have equal payoffs.

    If rounding moves this point outside [0, 1], the nearer end of the interval is returned.
    """
    spared = minus.objective - plus.objective
    risked = game.scale * (plus.failing - minus.failing)
    return min(max(risked / (spared + risked), 0.0), 1.0)


@explained
def play(
    player: Player, game: Game, known: Sequence[BestResponse] = (), *, accuracy: float = 1e-11
) -> Equilibrium:
    """Find the equilibrium of a game: the adversary's alpha* and two policies of equal payoff.

    The payoffs of two policies are lines in alpha. Their value where they cross is an upper bound
    of the maximum of the concave ``J*(alpha)``. The best response at this alpha replaces one of the
    two policies. The search ends when the best response's payoff is no longer below the crossing
    (paper, sections 3.2 and 3.4).

    Args:
        player: finds best responses, such as ``stationary_player(problem)``.
        game: the game, with its stake in units of cost and the failure budget.
        known: policies found in games at other values of c; every game has the same policies.
        accuracy: relative distance between the two bounds of the value, in (0, 1).

    Returns:
        alpha*, bounds of the game's value in units of cost, and the policies that are optimal just
        below and just above alpha*.

    Raises:
        ModelError: an argument of a wrong type, or an accuracy outside (0, 1).
    """
    check_between_0_and_1("accuracy", accuracy)
    responses = list(known)
    minus, plus = _closest_to_equilibrium(game, responses)
    if minus is None:
        minus = game.best_response(player, 0.0, accuracy)
        responses.append(minus)
        if not game.rises_with_alpha(minus):
            return Equilibrium(game, minus, minus, 0.0, minus.bound, tuple(responses))
    if plus is None:
        plus = game.best_response(player, 1.0, accuracy)
        responses.append(plus)
        if game.rises_with_alpha(plus):
            return Equilibrium(game, plus, plus, 1.0, plus.bound, tuple(responses))
    while True:  # until no response lies below the crossing of the two lines
        alpha = crossing(game, minus, plus)
        upper = min(game.payoff(alpha, minus), game.payoff(alpha, plus))
        size = min(game.size(alpha, minus), game.size(alpha, plus))
        response = game.best_response(player, alpha, accuracy)
        responses.append(response)
        done = upper - response.bound <= accuracy * size
        stalled = game.payoff(alpha, response) >= upper - 1e-15 * size
        if done or stalled or len(responses) > _MOST_ROUNDS:
            return Equilibrium(game, minus, plus, alpha, response.bound, tuple(responses))
        if game.rises_with_alpha(response):
            minus = response
        else:
            plus = response


def unplayed_game(game: Game, responses: Sequence[BestResponse]) -> Equilibrium:
    """Return the result of a game without time to play it: the best mixture of known policies.

    The lower bound of the game's value is -infinity.
    """
    minus, plus = _closest_to_equilibrium(game, responses)
    if minus is None or plus is None:
        minus = plus = minus or plus or responses[0]
    alpha = crossing(game, minus, plus) if minus is not plus else 1.0
    return Equilibrium(game, minus, plus, alpha, -np.inf, tuple(responses))


def _closest_to_equilibrium(
    game: Game, responses: Sequence[BestResponse]
) -> tuple[BestResponse | None, BestResponse | None]:
    """Find the rising and the falling policy whose mixture with equal payoffs is cheapest.

    A policy rises if its payoff does not decrease with alpha. The policy of a kind is None if no
    response is of this kind.
    """
    rising = [r for r in responses if game.rises_with_alpha(r)]
    falling = [r for r in responses if not game.rises_with_alpha(r)]
    if not rising or not falling:
        return next(iter(rising), None), next(iter(falling), None)
    minus, plus, *_ = cheapest_crossing(rising, falling, lambda r: -game.excess(r))
    return minus, plus


def cheapest_crossing(
    left: Sequence[BestResponse],
    right: Sequence[BestResponse],
    position: Callable[[BestResponse], float],
) -> tuple[BestResponse, BestResponse, float, float]:
    """Find the lottery of least J_obj over two policies whose positions have the mean 0.

    Args:
        left: policies with positions <= 0, up to rounding.
        right: policies with positions > 0.
        position: returns a policy's position, such as its failure minus the budget.

    Returns:
        The policy from ``left``, the policy from ``right``, the weight of the second policy, and
        the lottery's J_obj.
    """
    at, beyond = (np.array([position(r) for r in side]) for side in (left, right))
    share = -at[:, None] / (beyond - at[:, None])
    costs, further = (np.array([r.objective for r in side]) for side in (left, right))
    pays = (1.0 - share) * costs[:, None] + share * further
    i, j = divmod(int(np.argmin(pays)), len(right))
    return left[i], right[j], float(share[i, j]), float(pays[i, j])


def delta_mixture(player: Player, game: Game, alpha: float, delta: float) -> Mixture:
    """Mix the best responses to alpha* - delta and alpha* + delta (Theorem 3-4).

    The mixture's worst payoff, the greater of the payoffs against the two MDPs, tends to the game's
    value as delta goes to 0. It exceeds this value by at most delta times the steeper slope of the
    two policies' payoffs (the proof of Theorem 3-4 allows twice as much). If no other kink of
    ``J*(alpha)`` lies within delta of alpha*, the mixture is optimal.

    Args:
        player: finds best responses.
        game: the game at c*, in case S also at epsilon*.
        alpha: alpha*.
        delta: distance from alpha*, above 0. Values of alpha* - delta and alpha* + delta outside
            [0, 1] are replaced by 0 and 1.

    Raises:
        ModelError: an alpha or a delta out of range.
    """
    check_alpha(alpha)
    if not delta > 0.0:
        raise wrong_argument("delta", "be above 0", delta)
    minus = game.best_response(player, max(alpha - delta, 0.0), _ACCURACY)
    plus = game.best_response(player, min(alpha + delta, 1.0), _ACCURACY)
    return Mixture(game, minus, plus)
