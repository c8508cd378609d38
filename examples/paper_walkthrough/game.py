"""Sections 3.1 to 3.4 of the paper on the journey: two MDPs, their game, beliefs, the mixture."""

from fractions import Fraction
from functools import cache

import numpy as np

from examples.paper_walkthrough.lottery import (
    BAYES_POINTS,
    ONE,
    adversary,
    best_payoff,
    best_plan,
    game_value,
    numerator_s,
    optimum_m,
)
from examples.paper_walkthrough.model import (
    BUDGET,
    FOR_EVER,
    GAMMA,
    START,
    Plan,
    Row,
    cost,
    failure,
    journey,
    success_cost,
    timed_policy,
)
from ssp_lp import GIVE_UP, MCMP, S3P, DeterministicPolicy, evaluate
from ssp_lp.game import (
    Game,
    GameSolution,
    bayes_adaptive,
    belief_at,
    delta_mixture,
    play,
    posterior,
)
from ssp_lp.game.optimum import bayes_player
from ssp_lp.model import SSP
from ssp_lp.policies import Policy
from ssp_lp.policies.remembering import TimedPolicy

G = float(GAMMA)
THRICE = Plan(False, 3)
DELTAS = (Fraction(1, 10), Fraction(1, 100), Fraction(1, 1000))


def problem_m(model: SSP) -> MCMP:
    """Return case M at the walkthrough's budget and discount."""
    return MCMP(model, start=START, failure_budget=float(BUDGET), discount=G)


@cache
def solved_m() -> GameSolution:
    """Return the game of sections 3.2 to 3.4 in case M, solved."""
    return bayes_adaptive(problem_m(journey()), tolerance=1e-10)


def section_3_1() -> list[Row]:
    """Compare the two MDPs' pairs, and J_obj and J_cond of a plan (bridge, three tries).

    J_obj is not discounted, J_cond is, in both cases. Value iteration in either MDP alone finds the
    plan that costs least, (ford, give up), and the one that fails least, (bridge, for ever).
    """
    model = journey()
    problem = problem_m(model)
    policy = timed_policy(model, THRICE)
    m = evaluate(policy, problem)
    ratio = S3P(model, start=START, failure_budget=0.1, discount=G)
    s = evaluate(policy, ratio)
    condition = failure(THRICE, GAMMA)
    surrogate = s.success_cost / (1.0 - (s.discounted_failure or 0.0))
    players = {"M": (bayes_player(problem), cost), "S": (bayes_player(ratio), success_cost)}
    process = players["M"][0].base
    alone = []
    for case, (player, of) in players.items():
        cheapest, safest = player.response(1.0, 0.0, 1e-11), player.response(0.0, 1.0, 1e-11)
        alone += [
            Row(f"{case}: least J_obj", cheapest.objective, of(Plan(True, 0), ONE)),
            Row(f"{case}: least J_cond", safest.condition, failure(Plan(False, FOR_EVER), GAMMA)),
        ]
    return [
        Row("M: live states labelled s", process.n_nodes, 4),
        Row("M: pairs, (wait, f) among them", len(process.quotient.gives_up), 7),
        Row("M: pairs labelled f", process.quotient.gives_up.sum(), 1),
        Row("M: J_obj", m.expected_cost, cost(THRICE)),
        Row("M: J_cond", m.discounted_failure or 0.0, condition),
        Row("S: J_obj", s.success_cost, success_cost(THRICE)),
        Row("S: J_cond", s.discounted_failure or 0.0, condition),
        *alone,
        Row("t3-0: J^gamma_S3P", surrogate, success_cost(THRICE) / (1 - condition)),
        Row("t3-0: at least J_S3P", float(surrogate >= s.conditional_cost), 1),
    ]


def section_3_2() -> list[Row]:
    """Check the game at a given c: J*(alpha) is concave, c* is the least c with value at most c."""
    found, best = solved_m(), optimum_m(ONE, GAMMA, BUDGET)
    c, player = best.objective, found.player
    game = Game(stake=float(c), budget=float(BUDGET))
    rows = []
    for alpha in (Fraction(k, 8) for k in range(1, 8)):
        response = game.best_response(player, float(alpha), 1e-11)
        theory = best_payoff(BAYES_POINTS, alpha, c / BUDGET)
        rows.append(Row(f"J*({alpha})", game.payoff(float(alpha), response), theory))
    values = [row.computed for row in rows]
    rows.append(Row("J* is concave there", float(np.max(np.diff(values, 2)) <= 1e-12), 1))
    for share in (Fraction(9, 10), Fraction(1), Fraction(11, 10)):
        stake = share * c
        value = play(player, Game(float(stake), float(BUDGET))).upper
        rows.append(Row(f"value - c at c = {float(share):g} c*", value - float(stake),
                        game_value(BAYES_POINTS, stake / BUDGET) - stake,
                        bound=1e-9 * float(c)))  # fmt: skip
    alpha_star = adversary(c, best.price, BUDGET)
    return [
        *rows,
        Row("alpha* at c*", play(player, game).alpha, alpha_star),
        Row("c*, the least c (t3-2)", found.objective, c),
        Row("its lower bound", found.lower_bound, c),
    ]


def section_3_3() -> list[Row]:
    """Check Bayes-adaptive value iteration, whose belief and policy depend on time alone.

    T as printed weights G-bar by probabilities twice; correct is the sum of G-bar + q-bar J. And
    the choices (u, f) in U(x') must be for u that stay in the attention set, else J_cond is not 1.
    """
    found, best = solved_m(), optimum_m(ONE, GAMMA, BUDGET)
    price = best.price
    alpha = adversary(best.objective, price, BUDGET)
    belief, rows = found.alpha, [Row("alpha_0 = alpha*", found.alpha, alpha)]
    for time in range(1, 5):
        belief = posterior(belief, G)
        rows.append(Row(f"alpha_{time}, by Bayes", belief,
                        alpha / (alpha + GAMMA**time * (1 - alpha))))  # fmt: skip
    last = float(belief_at(found.alpha, G, np.array(4)))
    rows.append(Row("alpha_4, on the trajectory", last, Fraction(belief)))
    # With the weight w = price gamma^t left to failing, giving up costs 1 + w, one more try before
    # it 9/2 + w (1 - gamma / 2): giving up is best once w <= 7 / gamma, so ever later in time.
    tries = sorted(_tries(p) for p in found.policy.policies)
    hand = sorted(p.plan.tries for p in (best.safe, best.risky))
    rows += [Row("tries of one member", tries[0], hand[0]),
             Row("tries of the other", tries[1], hand[1]),
             Row("price = 7 / gamma^(t + 1), t = 1 + fewer tries", float(price),
                 7 / GAMMA ** (hand[0] + 2)),
             Row("M: c*", found.objective, best.objective)]  # fmt: skip
    ratio = S3P(journey(), start=START, failure_budget=float(BUDGET), discount=G)
    bayes_s, hand_s = bayes_adaptive(ratio, tolerance=1e-10), numerator_s(ONE, GAMMA, BUDGET)
    return [
        *rows,
        Row("S: c*", bayes_s.objective, hand_s.objective / (1 - BUDGET)),
        Row("S: alpha*", bayes_s.alpha, adversary(hand_s.objective, hand_s.price, BUDGET)),
    ]


def _tries(policy: Policy) -> int:
    """Count how often a timed policy goes at the crossing, from time 1 on, before it gives up."""
    if not isinstance(policy, TimedPolicy):
        raise TypeError("policies of section 3.4 depend on time")
    later = [p for p in policy.stages[1:] if isinstance(p, DeterministicPolicy)]
    return [p.actions()["crossing"] for p in later].index(GIVE_UP)


def section_3_4() -> list[Row]:
    """Check the mixture of the best responses to alpha* - delta and alpha* + delta (t3-4).

    Minus is best at alpha* - delta, so at alpha* its payoff exceeds J*(alpha*) by at most delta
    times its slope; likewise plus, best at alpha* + delta. The mixture has the payoff of both where
    their lines cross, which exceeds J*(alpha*) no more than theirs.
    """
    found, best = solved_m(), optimum_m(ONE, GAMMA, BUDGET)
    c = best.objective
    game, scale = Game(float(c), float(BUDGET)), c / BUDGET
    alpha = adversary(c, best.price, BUDGET)
    rows = []
    for delta in DELTAS:
        mixture = delta_mixture(found.player, game, found.alpha, float(delta))
        pair = [best_plan(BAYES_POINTS, alpha + side, scale) for side in (-delta, delta)]
        slope = max(abs(p.objective - scale * p.condition) for p in pair)
        at = f"delta = {float(delta):g}: "
        rows += [Row(at + "worst payoff", mixture.value, game_value(pair, scale)),
                 Row(at + "its distance to c*", mixture.value, c,
                     bound=float(delta * slope))]  # fmt: skip
    # alpha* is where the two plans of the optimum cross: near enough, they are the responses.
    return [
        *rows,
        Row("J_obj of the last", mixture.objective, c),
        Row("J_cond of the last", mixture.condition, BUDGET),
        Row("its weight of the riskier plan", mixture.weight, best.weight),
    ]
