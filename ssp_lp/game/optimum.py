"""The optimum c* of a problem by the paper's game, without linear programs.

At a failure budget epsilon, c* is the least c for which the game's value is at most the stake: c in
case M, and c (1 - epsilon) in case S (eq. def_c*, where eta is the stake). In case M epsilon is the
problem's budget. In case S it is the epsilon' of least c* up to this budget.

``stationary_game`` finds c-hat, the approximation of c* in section 3.5 of the paper, where J_obj is
discounted like J_cond. ``bayes_adaptive`` finds c* without this approximation.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.accumulated_cost.process import accumulate_cost
from ssp_lp.accumulated_cost.totals import resolution_of_costs
from ssp_lp.arrays import LEAST_BUDGET, MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.column_generation.compiled_problem import unreachable
from ssp_lp.compiled.deadline import WithIncumbent, closing, is_late
from ssp_lp.errors import (
    Argument,
    InfeasibleError,
    ModelError,
    SolverError,
    check_between_0_and_1,
    wrong_argument,
)
from ssp_lp.game.equilibrium import Equilibrium, Game, cheapest_crossing, play, unplayed_game
from ssp_lp.game.player import BayesPlayer, BestResponse, Player, check_alpha, label_process
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import dead_ends
from ssp_lp.model.report import Facts, Table
from ssp_lp.options import Progress, check_tail
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import goal_out_of_reach
from ssp_lp.processes.goal_reach import max_goal_probability

_MOST_ROUNDS = 100  # most games, and most responses in a row
_MARGINS = (0.25, 4.0, 64.0, 1024.0)
"""Multiples of the tolerance by which a ratio is lowered until it is proved to be a bound."""

_STEEP = (1e3, 1e6, 1e9)
"""Prices of failure to search for cheap policies of least failure, in multiples of the cost of
reaching the goal under one of these policies."""

_LEAST_SUCCESS = 1e-6
"""Least probability of success, if computed as 1 - failure, by which a cost is divided."""

_ROOM = 1.0 + 1e-6
"""A budget up to this multiple of the least failure counts as tight."""

_CANCELLED = 4.0 * MACHINE_EPSILON
"""Relative rounding of a difference of payoffs in which a high price of failure cancels."""

_LEAST_ACCURACY = 1e-9
"""Greatest relative error of the least failure, on which feasibility depends."""

_SAME = 1e-13
"""Distance of failures that counts as rounding, so that the cheaper policy may be used; relative to
the success if J_cond is counted from 1."""

_STALLED = 0.75
"""Two games, one of them at the midpoint, shrink the bracket to less than this share, unless
rounding prevents it."""


@dataclass(frozen=True, eq=False)
class Threshold:
    """Bounds of c* at one epsilon, and the mixed policy that attains the upper bound."""

    budget: float  # epsilon
    low: float  # no policy within the budget is cheaper
    high: float  # cost of the mixture
    game: Equilibrium  # the last game, at c = high unless the search was stopped
    members: tuple[BestResponse, ...]  # one or two policies
    weights: tuple[float, ...]
    games: int  # number of games, each at another c
    in_time: bool = True  # whether the search ended before its deadline

    @property
    def failure_price(self) -> float:
        """Price of failure: lambda in case M, kappa in case S."""
        return self.game.failure_price

    @property
    def condition(self) -> float:
        """J_cond of the mixture: the discounted failure probability."""
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
    """Bracket c* at a budget epsilon: ``min{c > 0 : value of the game at c <= share * c}``.

    Each game moves an end of the bracket. The value of a game at alpha* gives the lower end, since
    all policies within the budget have ``J_obj >= (value - (1 - alpha*) eta) / alpha*``. The game's
    policies, mixed so that they use the whole budget, give the upper end. Games are played at the
    upper end and at the midpoint in turn, so that the bracket always shrinks.

    Args:
        player: finds best responses.
        budget: epsilon.
        share: 1 in case M, 1 - epsilon in case S.
        previous: responses of earlier searches and of ``extremes``. If all of them exceed the
            budget, the excess is due to rounding, and their least failure replaces the budget.
        room: the budget minus the responses' origin, if known more accurately than this difference.
        tolerance: relative width of the bracket to reach.
        progress: called after each game with (responses, price of failure, upper end).
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
        answer = Threshold(budget, min(low, high), high, played, members, weights, games)
        with WithIncumbent():  # the callback may stop the search
            if progress is not None:
                progress(len(responses), answer.failure_price, high)
        late = is_late() or games >= _MOST_ROUNDS
        if late or (high - low <= tolerance * high and at == high):
            return replace(answer, in_time=not is_late())
        if games % 2 == 1:
            if high - low > _STALLED * width:
                return answer
            width = high - low


def extremes(player: Player, accuracy: float) -> tuple[BestResponse, ...]:
    """Find the policy of least failure and the cheapest policy."""
    safest = player.response(0.0, 1.0, min(accuracy, _LEAST_ACCURACY))
    with WithIncumbent():
        return safest, player.response(1.0, 0.0, accuracy)
    return safest, safest


def _cheap_near_least_failure(
    player: Player, budget: float, previous: Sequence[BestResponse], accuracy: float
) -> Iterator[BestResponse]:
    """Yield best responses at high prices of failure if the budget is near the least failure.

    Each fails about as rarely as the safest policy, which was found without regard to cost, but
    costs less.
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
    """Return a lower bound of J_obj for all policies within the budget, from a game's value."""
    if played.alpha == 0.0:
        return 0.0
    owed = played.game.failure_term(played.alpha, played.origin)
    rounding = _CANCELLED * (abs(played.least) + abs(owed))
    return (played.least - owed - rounding) / played.alpha


def cheapest_mixture(
    responses: Sequence[BestResponse], room: float
) -> tuple[tuple[BestResponse, ...], tuple[float, ...], float]:
    """Find the lottery of least J_obj over one or two policies that satisfies the budget.

    Args:
        responses: policies, at least one of them within the budget.
        room: the failure budget minus the responses' ``origin``, which is 0 or 1.

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


def checked_setting(problem: Problem) -> tuple[float, float]:
    """Return the failure budget and the discount, checked for the game.

    Raises:
        ModelError: no discount, no budget above 0, or a criterion other than expected cost.
    """
    budget, discount = problem.failure_budget, problem.discount
    if not problem.semantics.counts_cost_alone:
        raise ModelError(
            f"the game supports costs with a failure budget, not {type(problem).__name__}: use ",
            Argument("method", "columns"),
        )
    if discount is None:
        raise ModelError(
            "the game needs a discount (paper, section 2.5): give ",
            Argument("discount", 0.999),
            ", or solve the exact problem with ",
            Argument("method", "columns"),
        )
    if budget is None or budget <= 0.0:
        raise ModelError(
            "the game needs ",
            Argument("failure_budget"),
            f" above 0, not {budget!r}, as its stakes are divided by it (paper, eq. j_c_gamma_def)",
        )
    return budget, discount


def check_budget(
    problem: Problem, budget: float, safest: BestResponse, tail: float | None = None
) -> None:
    """Raise :class:`InfeasibleError` if every policy's discounted failure exceeds the budget."""
    discounted = safest.bound + safest.origin
    if discounted <= budget + LEAST_BUDGET:
        return
    problem = problem.unrolled
    start = problem.start_mass
    real = max(1.0 - float(start @ max_goal_probability(problem.model)), 0.0)
    if goal_out_of_reach(problem.model, start):
        setting = problem.model, start, budget, problem.discount
        raise unreachable(*setting, f"every policy fails surely, above the budget {budget:g}")
    could = real < budget and tail is None
    nearer = "; a discount nearer to 1 is feasible" if could else ""
    among = "" if tail is None else f" that follows pi'_or from a total cost of {tail:g} on"
    raise InfeasibleError(
        f"the discounted failure of every policy{among} is at least {discounted:.12g}, above the "
        f"budget {budget:g}; the least real failure probability is {real:.12g}{nearer}",
        failure_budget=budget,
        least_failure=real,
        least_discounted_failure=discounted,
    )


def construct(kind: type[Player], problem: Problem, tail: float | None = None) -> Player:
    """Build a player of a given class, with the objective MDP and the failure MDP of a problem.

    Args:
        kind: the class; ``BayesPlayer`` leaves J_obj undiscounted.
        problem: gives the case, the start and the discount (paper, section 3.1).
        tail: in case S the total cost M at which pi'_or takes over (section 3.5.1), or None.

    Raises:
        ModelError: no discount, or a budget that is not above 0.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    discount, problem = checked_setting(problem)[1], problem.unrolled
    model, start = problem.model, problem.start_mass
    if not problem.ratio:
        later = 1.0 if kind is BayesPlayer else discount
        base, paid = label_process(model, start, problem.semantics, discount, later=later)
        return kind(base, counts_total=False, start_cost=paid)
    if not (start[~dead_ends(model)] > 0.0).any():
        raise unreachable(model, start, problem.failure_budget, discount)
    by_steps = resolution_of_costs(model) is not None
    return kind(accumulate_cost(model, start, discount, by_steps=by_steps), tail=tail)


@dataclass(frozen=True, eq=False, repr=False)
class GameSolution(Facts):
    """The optimum c* of a problem by the paper's game, with a bound and a mixed policy."""

    problem: Problem
    player: Player  # the construction: the class of policies and their costs
    threshold: Threshold  # the games at epsilon*, with the mixed policy
    spent: float  # epsilon*: the budget; in case S the epsilon' in (0, epsilon] of least c*
    objective: float  # c*, attained by the policy; c-hat of the stationary construction
    lower_bound: float  # no policy with J_cond within the budget has less
    alpha: float  # alpha*: the adversary's weight of the objective MDP at epsilon*
    price: float  # weight of J_cond against J_obj at alpha*: lambda in case M, kappa in case S

    def tables(self) -> list[Table]:
        """Return a table of the optimum, its bound, the adversary's weight and the price."""
        facts = [
            ("c*", self.objective),
            ("lower bound", self.lower_bound),
            ("alpha*", self.alpha),
            ("price", self.price),
            ("epsilon*", self.spent),
            ("weights", [f"{weight:.4f}" for weight in self.threshold.weights]),
        ]
        return [Table(facts, digits={"c*": 9, "lower bound": 9})]

    @property
    def policy(self) -> MixedPolicy:
        """The optimal lottery over one or two policies on the original states."""
        members = tuple(self.player.policy(r) for r in self.threshold.members)
        return MixedPolicy(members, np.array(self.threshold.weights))


def find_optimum(
    problem: Problem, player: Player, *, tolerance: float, progress: Progress | None = None
) -> GameSolution:
    """Find the optimum c* by best responses of a player.

    In case M, c* is the least c whose game value is at most c.

    In case S, c* is the least value of c*(e) over all budgets e in (0, epsilon] (Theorem 3-1). Here
    c*(e) = F(e) / (1 - e), and F(e), the least J_obj at J_cond = e, is convex. c*(e) falls while
    ``-F'(e) > c*(e)`` and rises after that. Either c*(e) still falls at epsilon, and its minimum is
    c*(epsilon). Or the minimum lies at an e where the price of failure -F'(e) is c*, and a single
    policy attains it.

    Args:
        problem: gives the case and the budget.
        player: a player of the same case.
        tolerance: relative distance between c* and its lower bound to reach.
        progress: called after each game with (responses, price of failure, upper end).

    Raises:
        InfeasibleError: the discounted failure of every policy exceeds the budget.
    """
    budget, share, best, is_least = float(problem.failure_budget or 0.0), 1.0, None, True
    spent, room = budget, None
    responses = extremes(player, 0.1 * tolerance)
    check_budget(problem, budget, responses[0], player.tail)
    if problem.ratio:
        best, responses, is_least = _least_ratio(player, responses, tolerance)
        at_goal = best.condition == 0.0  # the goal is the start: c* of every epsilon' is 0
        room = 0.5 * budget if at_goal else min(best.failing, budget - best.origin)
        share, spent = (1.0 - best.origin) - room, best.origin + room
    threshold = find_threshold(
        player, spent, share, responses, room=room, tolerance=tolerance, progress=progress
    )
    c, lower = threshold.high, threshold.low
    is_slack = best is not None and best.failing <= budget - best.origin
    if is_slack or not (best is None or is_least or best.ratio < lower):
        lower = _slack_bound_of_optimum(player, c, budget, tolerance)
    alpha, price = (share, c) if is_slack else (threshold.game.alpha, threshold.failure_price)
    spent = spent if is_slack else threshold.budget
    return GameSolution(problem, player, threshold, spent, c, lower, alpha, price)


def _slack_bound_of_optimum(player: Player, ratio: float, budget: float, tolerance: float) -> float:
    """Prove a lower bound, a little below a given ratio, of every policy's cost given success.

    A ratio is proved if failing surely is optimal when failing costs this ratio. If rounding errors
    prevent the proof, the bound is lowered by what a policy within the budget may gain by them.
    """
    best = 0.0
    for share in _MARGINS:
        below = ratio * (1.0 - share * tolerance)
        if below <= 0.0:
            break
        with WithIncumbent() as search, closing():
            surplus = player.surplus(below, 0.1 * tolerance)
        if search.stop:
            break
        if surplus >= 0.0:
            return max(best, below)
        if budget < 1.0:
            best = max(best, below + surplus / (1.0 - budget))
    return best


def _least_ratio(
    player: Player, responses: tuple[BestResponse, ...], tolerance: float
) -> tuple[BestResponse, tuple[BestResponse, ...], bool]:
    """Find the policy of least J_obj / (1 - J_cond) by Dinkelbach's iteration.

    A ratio c is the least one if ``J_obj + c J_cond >= c`` for every policy. A policy that violates
    this has a smaller ratio, which replaces c.

    Returns:
        The policy, all responses, and whether the search was completed.

    Raises:
        SolverError: every policy fails with probability 1 to rounding.
    """
    tried = list(responses)
    hopeful = [r for r in tried if r.has_conditional_cost]
    if not hopeful:
        raise SolverError(
            "the game cannot compute costs given success: the goal is reached with a (discounted) "
            f"probability of at most {responses[0].success:.1e}; use a discount nearer to 1"
        )
    best = min(hopeful, key=lambda r: r.ratio)
    for _ in range(_MOST_ROUNDS):
        c = best.ratio
        if is_late():
            break
        with WithIncumbent() as search:
            response = player.response(1.0, c, 0.1 * tolerance)
        if search.stop:
            break
        if not response.has_conditional_cost or response.ratio >= c * (1.0 - 1e-15):
            return best, tuple(tried), True
        tried.append(response)
        best = response
    return best, tuple(tried), False


@explained
def stationary_player(problem: Problem, tail: float | None = None) -> Player:
    """Build the player of the stationary game, with the operator T_alpha of the problem's case.

    Args:
        problem: gives the case, the start and the discount.
        tail: in case S the total cost M of section 3.5.1: once M is paid, pi'_or is followed, and
            J_obj is no longer discounted. None: M grows until the optimum no longer depends on M.

    Raises:
        ModelError: no discount, a budget that is not above 0, an invalid tail, or one in case M.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    if tail is not None and not problem.ratio:
        raise wrong_argument("tail", "be None in case M, where no cost is accumulated", tail)
    return construct(Player, problem, None if tail is None else check_tail(tail))


@explained
def stationary_game(
    problem: Problem,
    *,
    tail: float | None = None,
    tolerance: float = 1e-9,
    progress: Progress | None = None,
) -> GameSolution:
    """Solve a problem by the paper's game and value iteration (Theorems 3-5 and 3-11).

    The policies are stationary in the state, in case S in the state and the accumulated cost; J_obj
    and J_cond are both discounted.

    Args:
        problem: with a discount and a failure budget above 0.
        tail: in case S the M of section 3.5.1 (see :func:`stationary_player`). The result is then
            c-hat_M, the least c of policies in Pi_{M,pi'_or}. As M grows, it falls to the c-hat of
            ``tail=None``.
        tolerance: relative distance between c-hat and its lower bound to reach.
        progress: called after each game with (responses, price of failure, upper end).

    Raises:
        ModelError: no discount, no budget or one of 0, a tolerance outside (0, 1), an invalid
            tail, or a table of decisions that would be too large.
        InfeasibleError: the discounted failure of every policy exceeds the budget.
    """
    check_between_0_and_1("tolerance", tolerance)
    player = stationary_player(problem, tail)
    return find_optimum(problem, player, tolerance=tolerance, progress=progress)


@explained
def thresholds(
    problem: Problem,
    budgets: Iterable[float],
    *,
    tail: float | None = None,
    tolerance: float = 1e-9,
) -> list[Threshold]:
    """Compute c* of each epsilon' separately: the curve that Theorem 3-1 minimises in case S.

    Args:
        problem: gives the case, the start and the discount. Its own failure budget must be above 0
            but has no effect.
        budgets: each at least the least discounted failure, and in case S below 1.
        tail: the M of section 3.5.1, as in :func:`stationary_game`.
        tolerance: relative distance between each c* and its lower bound to reach.

    Raises:
        ModelError: no discount, no budget, or one of the budgets outside (0, 1], in case S (0, 1).
        InfeasibleError: a budget below the least discounted failure.
    """
    check_between_0_and_1("tolerance", tolerance)
    player = stationary_player(problem, tail)
    responses: tuple[BestResponse, ...] = extremes(player, 0.1 * tolerance)
    curve: list[Threshold] = []
    for budget in budgets:
        if not 0.0 < budget <= 1.0 or (problem.ratio and budget == 1.0):
            raise ModelError(f"c* is not defined at the budget {budget!r}: use budgets above 0, in "
                             "case S below 1")  # fmt: skip
        check_budget(problem, budget, responses[0], tail)
        share = 1.0 - budget if problem.ratio else 1.0
        curve.append(find_threshold(player, budget, share, responses, tolerance=tolerance))
        responses = curve[-1].game.responses
    return curve


@explained
def bayes_player(problem: Problem) -> Player:
    """Build the player of the Bayes-adaptive game, with the operator T of section 3.3.

    Raises:
        ModelError: no discount, or a budget that is not above 0.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    return construct(BayesPlayer, problem)


@explained
def bayes_adaptive(
    problem: Problem, *, tolerance: float = 1e-7, progress: Progress | None = None
) -> GameSolution:
    """Solve the Bayes-adaptive game of section 3.2 by the iteration of section 3.3.

    J_obj is undiscounted and J_cond discounted: sections 3.2 to 3.4 solve this problem, and section
    3.5 approximates it by discounting J_obj as well. The adversary's weight is a belief about which
    MDP is being played. Both have the same transitions, but M_{d,gamma} ends with probability 1 -
    gamma in each step. So each further step is evidence for M_o, and the belief is a function of
    its initial value and the number of steps alone.

    Args:
        problem: with a discount, which applies to J_cond only, and a failure budget above 0.
        tolerance: relative distance between c* and its lower bound to reach.
        progress: called after each game with (responses, price of failure, upper end).

    Returns:
        c*, which is J_obj in case M and J_obj / (1 - J_cond) in case S, with policies that depend
        on time.

    Raises:
        ModelError: no discount, no budget or one of 0, a tolerance outside (0, 1), or runs so long
            that the table of decisions would be too large.
        InfeasibleError: the discounted failure of every policy exceeds the budget.
    """
    check_between_0_and_1("tolerance", tolerance)
    player = bayes_player(problem)
    return find_optimum(problem, player, tolerance=tolerance, progress=progress)


def posterior(alpha: float, discount: float) -> float:
    """Return the adversary's weight nu(alpha)(M_o) of the objective MDP after one more step.

    Args:
        alpha: the weight before the step, in [0, 1].
        discount: gamma, the probability with which the failure MDP goes on after a step, in (0, 1).

    Returns:
        ``alpha / (alpha + gamma (1 - alpha))``, Bayes' rule (paper, section 3.3).

    Raises:
        ModelError: an argument out of range.
    """
    return float(belief_at(alpha, discount, np.array(1)))


def belief_at(alpha: float, discount: float, time: IntArray) -> FloatArray:
    """Return the adversary's weight of the objective MDP after each given number of steps.

    Args:
        alpha: the weight at the start, in [0, 1].
        discount: gamma, the probability with which the failure MDP goes on after a step, in (0, 1).
        time: numbers of steps, >= 0, in any shape.

    Returns:
        ``alpha / (alpha + gamma^t (1 - alpha))``, in the shape of ``time``: ``posterior`` applied
        t times (paper, section 3.3).

    Raises:
        ModelError: an argument out of range.
    """
    check_alpha(alpha)
    check_between_0_and_1("discount", discount)
    steps = np.asarray(time)
    if not np.issubdtype(steps.dtype, np.integer) or (steps < 0).any():
        raise wrong_argument("time", "be whole numbers >= 0", time)
    if alpha == 0.0:
        return np.zeros(steps.shape)  # even if gamma^t is 0 in double precision
    return np.asarray(alpha / (alpha + discount**steps * (1.0 - alpha)), dtype=np.float64)
