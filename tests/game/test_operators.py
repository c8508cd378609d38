"""The players' best responses against the operators of the paper, written out literally."""

import numpy as np
import pytest
from hypothesis import given, reject, strategies as st

from checks import library_model, plain
from formulations import MCMP, S3P
from games import RETRY, hand_problem
from operators import bayes_label, cost_game, cost_tail, stationary_label
from references import s3p
from references.chain import mean, plain_model, policies, start_distribution
from small_models import TWO_MOVES, model_of
from ssp_lp import Game, InfeasibleError, solve
from ssp_lp.game import stationary_game
from ssp_lp.game.optimum import bayes_player, stationary_player
from strategies import Draw, often, problems
from written_models import drawn_table, written

few = often(12)
alphas = st.sampled_from([0.5, 0.1, 0.9, 0.99])
scales = st.sampled_from([4.0, 1.0, 20.0])


def _at_start(drawn, values):
    begin = {(x, "s"): mass for x, mass in start_distribution(drawn.start).items()}
    return mean(begin, values)


@pytest.mark.slow
@few
@given(problems(most_live=2), st.sampled_from([0.5, 0.8]), alphas, scales)
def test_the_bayes_operator_of_case_m(drawn, gamma, alpha, scale):
    """Section 3.3: T^N 0 increases to J*(x', alpha), which is the player's best response.

    Labels, END and all of U(x') as in the paper; G-bar is summed once.
    """
    reference = plain(drawn)
    problem = MCMP(library_model(drawn), start=drawn.start, failure_budget=0.5, discount=gamma)
    reply = bayes_player(problem).response(alpha, (1 - alpha) * scale, 1e-11)
    before = 0.0
    for depth in (5, 40, 400):
        value = _at_start(drawn, bayes_label(reference, gamma, alpha, scale, depth))
        assert value >= before - 1e-12
        before = value
    assert reply.payoff(alpha, (1 - alpha) * scale) == pytest.approx(before, rel=1e-8, abs=1e-10)
    assert reply.bound == pytest.approx(before, rel=1e-8, abs=1e-10)


def test_the_bayes_operator_as_printed_weighs_the_stage_cost_twice():
    """Section 3.3 on TWO_MOVES: alpha J_obj + (1 - alpha) scale J_cond of ``slow`` is 1.05.

    G-bar holds the probabilities of w' already; the printed T multiplies it by q-bar again.
    """
    gamma, alpha, scale = 0.9, 0.5, 1.0
    model = plain_model(TWO_MOVES, {"g"})
    right = bayes_label(model, gamma, alpha, scale, 200)["x", "s"]
    fast = alpha * 1.0 + (1 - alpha) * (1 - 0.95 * gamma)
    assert right == pytest.approx(min(alpha * 2.0 + (1 - alpha) * (1 - gamma), fast), rel=1e-9)
    printed = bayes_label(model, gamma, alpha, scale, 200, printed=True)["x", "s"]
    assert printed < right - 0.02
    player = bayes_player(hand_problem(MCMP, TWO_MOVES, 0.5, gamma))
    assert player.response(alpha, 1 - alpha, 1e-12).bound == pytest.approx(right, rel=1e-9)


@few
@given(problems(most_live=2), st.sampled_from([0.5, 0.8]), alphas, scales)
def test_the_stationary_operator_of_case_m(drawn, gamma, alpha, scale):
    """Section 3.5.2: T_alpha^N 0 tends to the player's best response; (u, f) for staying u only."""
    reference = plain(drawn)
    problem = MCMP(library_model(drawn), start=drawn.start, failure_budget=0.5, discount=gamma)
    reply = stationary_player(problem).response(alpha, (1 - alpha) * scale, 1e-12)
    values = stationary_label(reference, gamma, alpha, scale, 150, leaving=False)
    assert reply.payoff(alpha, (1 - alpha) * scale) == pytest.approx(
        _at_start(drawn, values), rel=1e-8, abs=1e-10
    )


@pytest.mark.slow
def test_a_failed_run_may_still_reach_the_goal_as_printed():
    """U(x') of section 3.3 lists (u, f) for actions u that leave the attention states.

    Under discounting the penalty at (0, f) is gamma^2 / (1 - gamma) only: here a policy declares
    failure, is spared the cost 100 of the last step, and reaches the goal all the same. The
    penalty grows beyond every cost as gamma -> 1; without a discount it is infinite (section 3.3).
    """
    choices = {
        "x": {"go": [(1.0, "z", 1)], "wait": [(1.0, "x", 1)]},
        "z": {"b": [(1.0, "g", 100)]},
    }
    model, alpha, scale = plain_model(choices, {"g"}), 0.5, 1000.0
    for gamma, cheats in ((0.5, True), (0.9, True), (0.999, False)):
        depth = 40 if gamma < 0.9 else 600 if gamma < 0.99 else 30_000
        honest = stationary_label(model, gamma, alpha, scale, depth, leaving=False)["x", "s"]
        printed = stationary_label(model, gamma, alpha, scale, depth, leaving=True)["x", "s"]
        failed = (1 - alpha) * scale * (1 - gamma**2)
        assert honest == pytest.approx(
            min(alpha * (1 + gamma * 100) + failed, alpha + (1 - alpha) * scale), rel=1e-6
        )
        if cheats:
            penalty = alpha * (1 + gamma**2 / (1 - gamma))
            assert printed == pytest.approx(penalty + failed, rel=1e-6)
            assert printed < honest - 1.0
        else:
            assert printed == pytest.approx(honest, rel=1e-9)
        player = stationary_player(hand_problem(MCMP, choices, 0.5, gamma))
        reply = player.response(alpha, (1 - alpha) * scale, 1e-12)
        assert reply.bound == pytest.approx(honest, rel=1e-6)


def dearer(drawn):
    """The drawn problem whose steps cost 1 more, as the operators of case S want it."""
    choices = {
        s: {a: [(p, x, cost + 1) for p, x, cost in outcomes] for a, outcomes in actions.items()}
        for s, actions in drawn.choices.items()
    }
    return Draw(choices, drawn.goals, drawn.start)


def in_case_s(drawn, gamma, **tail):
    """The drawn problem, its model written out, and its player; unless the goal is out of reach."""
    problem = S3P(library_model(drawn), drawn.start, failure_budget=0.5, discount=gamma)
    try:
        return plain(drawn), problem, stationary_player(problem, **tail)
    except InfeasibleError:
        reject()


def rule_of(model, tails):
    """pi'_or of a player, by state."""
    pairs = zip(model.states, tails.decisions[-1].tolist(), strict=True)
    return {state: model.action_of(pair) for state, pair in pairs if pair >= 0}


def literal(drawn, reference, gamma, alpha, scale, cap, tail, *, bayes):
    """The value of case S at the start; on a dead-end failure is all there is."""
    return sum(
        mass * cost_game(reference, x, gamma, alpha, scale, cap, tail, bayes=bayes)
        for x, mass in start_distribution(drawn.start).items()
    )


draws_of_s = problems(most_live=2, most_cost=1).map(dearer)


@few
@given(draws_of_s, alphas, scales)
def test_the_operators_of_case_s_on_drawn_models(drawn, alpha, scale):
    """T_alpha of 3.5.1 and T of 3.3, over policies that follow pi'_or beyond all that matters."""
    gamma, cap = 0.5, 60
    reference, problem, player = in_case_s(drawn, gamma)
    rule, weights = rule_of(problem.model, player.tails), (alpha, (1 - alpha) * scale)
    tails = [cost_tail(reference, rule, gamma, scale, discounted=d) for d in (True, False)]
    for bayes, tail, found in (
        (False, tails[0], player.response(*weights, 1e-12)),
        (True, tails[1], bayes_player(problem).response(*weights, 1e-10)),
    ):
        exact = literal(drawn, reference, gamma, alpha, scale, cap, tail, bayes=bayes)
        assert found.payoff(*weights) == pytest.approx(exact, rel=1e-7, abs=1e-9)
        assert found.bound == pytest.approx(exact, rel=1e-7, abs=1e-9)


def minprob_rules(model, gamma=None):
    """Pi_{d,or} of section 2.3: stationary policies of least goal probability from every state.

    With ``gamma`` the discounted probability, E[gamma^T; goal].
    """
    rules = list(policies(model, model.choices, lambda state: list(model.choices[state])))
    reaches = [s3p.values(model, rule, gamma)[0] for rule in rules]
    least = {state: min(goal.get(state, 0.0) for goal in reaches) for state in model.choices}
    return [
        rule
        for rule, goal in zip(rules, reaches, strict=True)
        if all(goal.get(state, 0.0) <= bound + 1e-12 for state, bound in least.items())
    ]


@pytest.mark.slow
@often(13)
@given(draws_of_s, st.sampled_from([0.5, 0.9, 0.99]), alphas, scales)
def test_the_operator_of_case_s_at_a_fixed_cap(drawn, gamma, alpha, scale):
    """T_alpha of 3.5.1 as printed: a rule of Pi_{d,or}, undiscounted beyond M, at every M.

    The rule comes from an enumeration of policies; where several are of least goal probability,
    one of them holds at every M.
    """
    weights, before, rules = (alpha, (1 - alpha) * scale), float("inf"), None
    for cap in (0.5, 1, 2, 3, 7):
        reference, problem, player = in_case_s(drawn, gamma, tail=cap)
        rules = minprob_rules(reference) if rules is None else rules
        found = player.response(*weights, 1e-12)

        def exact(rule, reference=reference, cap=cap):
            tail = cost_tail(reference, rule, gamma, scale, discounted=False)
            return literal(drawn, reference, gamma, alpha, scale, cap, tail, bayes=False)

        payoff = pytest.approx(found.payoff(*weights), rel=1e-11, abs=1e-13)
        rules = [rule for rule in rules if exact(rule) == payoff]
        assert rules
        assert found.payoff(*weights) * (1 - 1e-11) - 1e-13 <= found.bound
        assert found.bound <= found.payoff(*weights) + 1e-13
        assert found.payoff(*weights) <= before + 1e-11
        before = found.payoff(*weights)
    assert stationary_player(problem).response(*weights, 1e-12).bound <= before * (1 + 1e-11)


@pytest.mark.slow
def test_the_tail_is_of_least_undiscounted_goal_probability():
    """T_alpha of 3.5.1 on random models, many of which have another rule under the discount."""
    rng, gamma, alpha, scale, told_apart = np.random.default_rng(3), 0.3, 0.5, 8.0, 0
    for _ in range(150):
        choices = drawn_table(rng, "xyz", "ggd", [1, 2], actions=2) | {"d": {}}
        model = plain_model(choices, {"g"})
        rules, hasty = minprob_rules(model), minprob_rules(model, gamma)
        told_apart += all(rule not in rules for rule in hasty)
        problem = S3P(model_of(choices), "x", failure_budget=0.5, discount=gamma)
        for cap in () if "x" in model.dead_ends else (1, 3):
            reply = stationary_player(problem, tail=cap).response(alpha, (1 - alpha) * scale, 1e-12)
            tails = (cost_tail(model, rule, gamma, scale, discounted=False) for rule in rules)
            exact = [cost_game(model, "x", gamma, alpha, scale, cap, t, bayes=False) for t in tails]
            assert reply.payoff(alpha, (1 - alpha) * scale) in map(pytest.approx, exact)
    assert told_apart >= 5


def test_a_detour_of_greater_goal_probability_is_no_tail():
    """pi'_or takes a: 1/2 is below the detour's 3/5, although discounted 0.4 is above 0.384.

    It pays 2, discounted once on the way to y (M = 1 is paid there): 0.8 / 0.32 = 2.5.
    """
    model = written(
        """
        x on: y 1
        y a: 1/2 g 1, 1/2 d 1
        y b: z 1
        z c: 3/5 g 1, 2/5 d 1
        """
    )
    cheapest = stationary_game(S3P(model, "x", failure_budget=0.95, discount=0.8), tail=1)
    assert cheapest.objective == pytest.approx(2.5, rel=1e-12)
    tight = S3P(model, "x", failure_budget=0.69, discount=0.8)
    assert solve(tight, method=Game(tail=1)).objective == pytest.approx(2.5, rel=1e-12)
    assert stationary_game(tight, tail=1).objective == pytest.approx(2.5, rel=1e-12)


@pytest.mark.parametrize("weight", [1.0, 10.0, 100.0])
def test_a_bound_is_none_of_more_than_is_paid_where_the_goal_is_rare(weight):
    """J_cond counts from 1: 3e-5 or 16e-5 is paid for reaching the goal with 0.9e-5 or 1.8e-5."""
    risk = {"go": [(1e-5, "g", 3.0), (1 - 1e-5, "d", 1.0)]}
    model = model_of({"x": risk | {"slow": [(2e-5, "g", 8.0), (1 - 2e-5, "d", 1.0)]}, "d": {}})
    player = stationary_player(S3P(model, "x", failure_budget=0.999995, discount=0.9))
    reply, known = (
        player.response(1.0, weight, 1e-9),
        min(3e-5 - 0.9e-5 * weight, 16e-5 - 1.8e-5 * weight),
    )
    assert reply.origin == 1.0
    assert reply.payoff(1.0, weight) == pytest.approx(known, rel=1e-9)
    assert reply.bound == pytest.approx(known, rel=1e-9)


def test_a_budget_below_the_least_failure_is_refused_where_the_goal_is_rare():
    """The goal is reached with 2e-5, one step ahead: 0.9 times that at most, and not 2.25e-5."""
    model = model_of({"x": {"slow": [(2e-5, "g", 8.0), (1 - 2e-5, "d", 1.0)]}, "d": {}})
    with pytest.raises(InfeasibleError):
        solve(S3P(model, "x", failure_budget=1 - 2.25e-5, discount=0.9), method="game")
    attained = solve(S3P(model, "x", failure_budget=1 - 1.75e-5, discount=0.9), method="game")
    assert attained.objective == pytest.approx(8.0 / 0.9, rel=1e-9)


def test_the_sweeps_of_every_table_are_counted(monkeypatch):
    """A player that needs a larger table than the first says how much it did for both."""
    model = model_of({"x": {"go": [(0.9, "x", 1.0), (0.05, "g", 1.0), (0.05, "d", 1.0)]}, "d": {}})
    player, tables = stationary_player(S3P(model, "x", failure_budget=0.9, discount=0.99)), []
    sweep = type(player)._swept

    def counted(self, *given):
        tables.append(sweep(self, *given))
        return tables[-1]

    monkeypatch.setattr(type(player), "_swept", counted)
    assert player.response(1.0, 100.0, 1e-12).sweeps == sum(table.sweeps for table in tables)
    assert len(tables) > 1


@pytest.mark.parametrize("alpha", [0.2, 0.5, 0.9])
def test_the_operators_of_case_s(alpha):
    """Sections 3.3 and 3.5.1 on RETRY; pi'_or is ``rush``.

    The tail beyond M is undiscounted as printed, so that c-hat depends on M a little; discounted
    like the rest, it tends to the same value from above and does so sooner.
    """
    model, gamma, scale, rush = plain_model(RETRY, {"g"}), 0.95, 5.0, {"x": "rush"}
    problem = hand_problem(S3P, RETRY, 0.5, gamma)
    weights = alpha, (1 - alpha) * scale
    reply = stationary_player(problem).response(*weights, 1e-12)
    tails = [cost_tail(model, rush, gamma, scale, discounted=d) for d in (True, False)]
    for cap, error in ((5, 1.0), (20, 1e-1), (80, 1e-4), (120, 1e-9)):
        ours, printed = (
            cost_game(model, "x", gamma, alpha, scale, cap, tail, bayes=False) for tail in tails
        )
        assert reply.bound - 1e-10 <= ours <= printed + 1e-12
        assert printed == pytest.approx(reply.bound, abs=error)
    reply = bayes_player(problem).response(*weights, 1e-11)
    exact = cost_game(model, "x", gamma, alpha, scale, 150, tails[1], bayes=True)
    assert reply.payoff(*weights) == pytest.approx(exact, rel=1e-9)
