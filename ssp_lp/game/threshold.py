"""The least c whose game the player can hold at eta: c* of eq. def_c* and c-hat of section 3.5."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET, MACHINE_EPSILON
from ssp_lp.compiled.deadline import WithIncumbent, is_late
from ssp_lp.game.best_response import BestResponse
from ssp_lp.game.equilibrium import Equilibrium, Game, cheapest_crossing, play, unplayed_game
from ssp_lp.game.player import Player
from ssp_lp.options import Progress

_STEEP = (1e3, 1e6, 1e9)
"""Prices of failure at which cheap policies among those of least failure are looked for, as
multiples of what the goal costs under one of them."""

_LEAST_SUCCESS = 1e-6
"""Success that a price of failing is related to, where success is what failing leaves over."""

_ROOM = 1.0 + 1e-6
"""A budget below the least failure times this counts as tight."""

_CANCELLED = 4.0 * MACHINE_EPSILON
"""Relative rounding of the difference in which a steep price cancels."""

_LEAST_ACCURACY = 1e-9
"""Relative accuracy of the least failure, on which feasibility hangs, however coarse the search."""

_SAME = 1e-13
"""Failures this near to the least are the least, computed twice: the cheaper policy may be used.
Relative to the success where that is what is counted."""

_MOST_GAMES = 100

_STALLED = 0.75
"""Two games, one of them halfway, halve the bracket, unless rounding has the last word."""


@dataclass(frozen=True, eq=False)
class Threshold:
    """c* of one epsilon between two bounds, and the mixed policy that attains the upper one."""

    budget: float  # epsilon
    low: float  # no policy within the budget is cheaper
    high: float  # what the mixture costs
    game: Equilibrium  # the last game, at c = high where the search was not cut short
    members: tuple[BestResponse, ...]  # one or two policies
    weights: tuple[float, ...]
    games: int  # played, each at another c: whether it can be held says on which side c* lies
    responses: tuple[BestResponse, ...]
    in_time: bool = True  # whether the search ended by itself, not by its deadline

    @property
    def failure_price(self) -> float:
        """Price of failure at the threshold c: lambda in case M, kappa in case S."""
        return self.game.failure_price

    @property
    def condition(self) -> float:
        """J_cond of the mixture at the threshold c."""
        return sum(w * r.condition for w, r in zip(self.weights, self.members, strict=True))


def find_threshold(
    player: Player,
    budget: float,
    share: float,
    previous: Sequence[BestResponse],
    *,
    room: float | None = None,
    tolerance: float,
    progress: Progress | None = None,
) -> Threshold:
    """Bracket the threshold ``min{c > 0 : game value <= eta(epsilon; c) = share * c}``, and close.

    Each game moves an end of the bracket. Its value at alpha*, a bound for every policy, gives
    ``J_obj >= (value - (1 - alpha*) eta) / alpha*`` for all that keep to the budget: the lower end.
    Its policies, mixed so as to spend the budget, give the upper end. The next game is played at
    the upper end, every second one halfway, so that the bracket shrinks whatever happens.

    Args:
        player: finds best responses.
        budget: epsilon.
        share: 1 in case M, 1 - epsilon in case S.
        previous: responses met before, ``extremes`` at least. A budget that none of them keeps to
            is the least failure but for their accuracy, and counts as equal to it.
        room: the budget counted from the responses' origin, where that has more digits.
        tolerance: relative width of the bracket to reach.
        progress: told after each game of (responses, price of failure, upper end).
    """
    accuracy = 0.1 * tolerance
    responses = [*previous, *_cheap_near_least_failure(player, budget, previous, accuracy)]
    least_failure = min(r.failing for r in responses)
    same = _SAME * (abs(least_failure) if responses[0].origin else 1.0)
    attained = [r.failing for r in responses if r.failing <= least_failure + same]
    room = max([budget - responses[0].origin if room is None else room, *attained])
    budget = responses[0].origin + room
    low, high = 0.0, cheapest_mixture(responses, room)[2] / share
    games = 0
    width = np.inf  # of the bracket after the last game at its upper end
    while True:
        at = high if games % 2 == 0 else 0.5 * (low + high)
        game = Game(share * at, budget, room)
        equilibrium: Equilibrium | None = None
        with WithIncumbent():
            equilibrium = play(player, game, responses, accuracy=accuracy)
        played = equilibrium or unplayed_game(game, responses)
        responses = list(played.responses)
        games += 1
        low = max(low, _threshold_from_game_value(played) / share)
        members, weights, cost = cheapest_mixture(responses, room)
        high = cost / share
        answer = Threshold(
            budget, min(low, high), high, played, members, weights, games, tuple(responses)
        )  # fmt: skip
        with WithIncumbent():  # a stop that is asked for by who is told ends the search
            if progress is not None:
                progress(len(responses), answer.failure_price, high)
        late = is_late() or games >= _MOST_GAMES
        if late or (high - low <= tolerance * high and at == high):
            return replace(answer, in_time=not is_late())
        if games % 2 == 1:
            if high - low > _STALLED * width:
                return answer
            width = high - low


def extremes(player: Player, accuracy: float) -> tuple[BestResponse, ...]:
    """Policies between which the threshold c is sought: that of least failure, and the cheapest."""
    safest = player.response(0.0, 1.0, min(accuracy, _LEAST_ACCURACY))
    with WithIncumbent():
        return safest, player.response(1.0, 0.0, accuracy)
    return safest, safest


def _cheap_near_least_failure(
    player: Player, budget: float, previous: Sequence[BestResponse], accuracy: float
) -> Iterator[BestResponse]:
    """At a threshold without room, cheap policies among those that fail least.

    The least failure alone does not ask what its policy costs.
    """
    safest = min(previous, key=lambda r: r.failing)
    if budget > safest.condition * _ROOM + LEAST_BUDGET:
        return
    worth = safest.objective / max(safest.success, 0.0 if safest.origin else _LEAST_SUCCESS)
    for price in _STEEP:
        with WithIncumbent() as search:
            response = player.response(1.0, price * (worth or 1.0), accuracy)
        if search.stop:
            return
        yield response
        if response.failing <= safest.failing:
            return


def _threshold_from_game_value(played: Equilibrium) -> float:
    """Threshold c implied by the game's value at alpha*: the cost of policies within the budget."""
    if played.alpha == 0.0:
        return 0.0
    owed = played.game.owed(played.alpha, played.origin)
    rounding = _CANCELLED * (abs(played.least) + abs(owed))
    return (played.least - owed - rounding) / played.alpha


def cheapest_mixture(
    responses: Sequence[BestResponse], room: float
) -> tuple[tuple[BestResponse, ...], tuple[float, ...], float]:
    """Cheapest lottery over one or two policies within the budget of the threshold.

    Args:
        responses: some of which keep to it.
        room: the budget, counted from the responses' origin.

    Returns:
        The members, their weights, and the lottery's J_obj.
    """
    safe = [r for r in responses if r.failing <= room]
    risky = [r for r in responses if r.failing > room]
    alone = min(safe, key=lambda r: r.objective)
    if risky:
        *both, share, cost = cheapest_crossing(safe, risky, lambda r: r.failing - room)
        if cost < alone.objective:
            return (both[0], both[1]), (1.0 - share, share), cost
    return (alone,), (1.0,), alone.objective
