"""The paper's game where searches are cut short, where nothing is at stake, and on bad input."""

import pytest

from formulations import MCMP, S3P
from games import WASTE, hand_problem
from small_models import EXACT, model_of
from ssp_lp import Game, InfeasibleError, MixedPolicy, ModelError, Status, certify, evaluate, solve
from ssp_lp.analysis.evaluation import equivalent_randomised_policy
from ssp_lp.game import (
    Game as GameAtC,
    bayes_adaptive,
    play,
    stationary_game,
    stationary_player,
    thresholds,
)
from ssp_lp.policies import DeterministicPolicy
from ssp_lp.policies.policy import Policy
from written_models import written

FOUR_MOVES = written(
    """
    x good: 0.75 g 5, 0.25 d 0
    x safe: 0.87 g 20, 0.13 d 0
    x rash: 0.125 g 10, 0.875 d 0
    x dear: 0.49 g 25, 0.51 d 0
    """
)
"""The least cost given success, 5 / 0.99, is that of a move well within the budget."""

CORRIDOR = {
    f"c{i}": {"go": [(0.9, f"c{i + 1}" if i < 4 else "g", 1), (0.1, "d", 1)],
              "wait": [(1.0, f"c{i}", 1)]}
    for i in range(5)
} | {"d": {}}  # fmt: skip


def ratio_problem(budget=0.73, **setting):
    return S3P(FOUR_MOVES, start="x", failure_budget=budget, discount=0.99, **setting)


def test_a_search_cut_short_claims_no_more_than_it_proved():
    """Between the extremes lies a better policy that an interrupted search has not met."""
    best = 5 / 0.99
    assert solve(ratio_problem(), method="game").objective == pytest.approx(best, **EXACT)
    hasty = solve(ratio_problem(), method="game", time_limit=1e-9)
    assert hasty.lower_bound <= best
    assert hasty.status is Status.TIME_LIMIT


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_at_the_goal_nothing_is_at_stake(criterion):
    problem = criterion(FOUR_MOVES, start="g", failure_budget=0.5, discount=0.9)
    assert solve(problem, method="game").objective == 0.0
    assert bayes_adaptive(problem).objective == 0.0


@pytest.mark.parametrize("tolerance", [0.05, 1e-2, 1e-3, 1e-7])
@pytest.mark.parametrize("budget", [0.9, 1.0])
def test_a_slack_budget_is_bounded_at_any_tolerance(budget, tolerance):
    problem = S3P(model_of(CORRIDOR), start="c0", failure_budget=budget, discount=0.9)
    for game in (stationary_game, bayes_adaptive):
        found = game(problem, tolerance=tolerance)
        assert (1 - tolerance) * found.objective <= found.lower_bound <= found.objective


@pytest.mark.parametrize("tail", [2, 300])
def test_a_fixed_cap_is_answered_by_a_policy_and_a_bound_of_all(tail):
    """What the policy costs is measured like any other's; c-hat_M, which is more, is told."""
    problem = hand_problem(S3P, WASTE, 0.5, 0.99)
    capped, best = stationary_game(problem, tail=tail), solve(problem, method="game")
    solution = solve(problem, method=Game(tail=tail))
    assert best.lower_bound <= solution.lower_bound * (1 + 1e-9)
    assert solution.lower_bound <= best.objective <= solution.objective * (1 + 1e-12)
    assert solution.objective <= capped.objective * (1 + 1e-12)
    assert f"c-hat_M is {capped.objective:.10g} where M is {tail:g}" in solution.note
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.objective == pytest.approx(solution.objective, rel=1e-12)
    assert certificate.lower_bound <= best.objective * (1 + 1e-12)
    assert (solution.gap <= 1e-9) == (tail == 300)  # by when hardly a run goes on


def test_which_fixed_caps_there_are():
    for tail in (0.0, -1.0, float("inf"), float("nan"), "far"):
        with pytest.raises(ModelError, match="tail must be a total cost above 0"):
            Game(tail=tail)
        with pytest.raises(ModelError, match="tail must be a total cost above 0"):
            stationary_game(ratio_problem(), tail=tail)
    in_case_m = MCMP(FOUR_MOVES, start="x", failure_budget=0.5, discount=0.99)
    with pytest.raises(ModelError, match="a tail is for a cost given success, not MCMP"):
        solve(in_case_m, method=Game(tail=2))
    with pytest.raises(ModelError, match="tail must be None in case M"):
        stationary_game(in_case_m, tail=2)


@pytest.mark.parametrize("game", [stationary_game, bayes_adaptive])
@pytest.mark.parametrize("tolerance", [0.0, 1.0, -1e-3])
def test_a_tolerance_is_a_share(game, tolerance):
    with pytest.raises(ModelError, match="tolerance"):
        game(ratio_problem(), tolerance=tolerance)


@pytest.mark.parametrize("budget", [0.0, 1.0, 1.5])
def test_the_scan_over_budgets_refuses_those_without_a_game(budget):
    with pytest.raises(ModelError, match="not defined"):
        thresholds(ratio_problem(), [0.5, budget])


def test_the_scan_over_budgets_says_what_is_feasible():
    with pytest.raises(InfeasibleError) as caught:
        thresholds(ratio_problem(), [1e-3])
    assert caught.value.least_failure == pytest.approx(0.13, **EXACT)
    assert caught.value.least_discounted_failure == pytest.approx(1 - 0.99 * 0.87, rel=1e-9)


def test_a_budget_just_above_the_least_failure_is_feasible():
    problem = MCMP(model_of(CORRIDOR), start="c0", failure_budget=0.5, discount=0.99)
    least = 1 - (0.99 * 0.9) ** 5
    for step in (1e-9, 1e-6):
        tight = MCMP(problem.model, start="c0", failure_budget=least * (1 + step), discount=0.99)
        assert bayes_adaptive(tight).objective >= stationary_game(tight).lower_bound


def test_of_two_policies_that_fail_least_the_cheaper_is_found():
    """Their failures are one number, computed twice: 5 steps of cost 1 or of cost 2 in the mean."""
    choices = {
        "x": {"dear": [(0.2, "g", 0), (0.8, "x", 2)], "fair": [(0.2, "g", 2), (0.8, "x", 1)]}
    }
    for discount in (0.9, 0.9999, 0.999999):
        goal = 0.2 * discount / (1 - 0.8 * discount)
        for criterion in (MCMP, S3P):
            problem = criterion(
                model_of(choices), start="x", failure_budget=1 - goal, discount=discount
            )
            found, column = solve(problem, method="game"), solve(problem)
            assert found.objective == pytest.approx(column.objective, rel=1e-8)
            assert found.gap <= 1e-8


def test_a_policy_of_unknown_memory_has_no_equivalent():
    class Secretive(Policy):
        """A user's own policy, whose memory nobody else understands."""

        model = FOUR_MOVES

        def start_memory(self, states):
            return 0 * states

        def branches(self, states, memory):
            raise NotImplementedError

        def remember(self, memory, pairs, successors, costs):
            return memory

    problem = ratio_problem()
    plain = DeterministicPolicy.from_actions(problem.model, {"x": "good"})
    lottery = MixedPolicy((plain, Secretive()), [0.5, 0.5])
    with pytest.raises(ModelError, match="Secretive"):
        equivalent_randomised_policy(lottery, problem)


def wandering(costs):
    """Four places with two ways on of three costs each, and a dear one that is nearly safe."""
    dear, mid, cheap = costs
    return {
        i: {
            "on": [(0.5, (i + 1) % 4, mid), (0.2, "g", cheap), (0.3, "d", cheap)],
            "back": [(0.6, (i + 3) % 4, cheap), (0.3, "g", mid), (0.1, "d", mid)],
            "dear": [(0.55, "g", dear), (0.4, (i + 2) % 4, mid), (0.05, "d", cheap)],
        }
        for i in range(4)
    } | {"d": {}}


@pytest.mark.parametrize("costs", [(2.0**0.5, 1.0, 0.0), (3.0, 1.41, 0.7)])
def test_the_game_and_column_generation_agree_on_costs_without_a_unit(costs):
    problem = S3P(model_of(wandering(costs)), 0, failure_budget=0.3, discount=0.9)
    played, best = solve(problem, method="game"), solve(problem)
    assert played.objective == pytest.approx(best.objective, rel=1e-9)
    assert played.gap <= 1e-9
    certificate = certify(played)
    assert certificate.accepted
    assert certificate.gap <= 1e-9


@pytest.mark.slow
def test_the_unapproximated_game_without_a_unit_tends_to_that_with_one():
    """Its value is continuous in the costs, and its policy costs what the game says."""
    near, exact = (
        bayes_adaptive(S3P(model_of(wandering(costs)), 0, failure_budget=0.7, discount=0.6))
        for costs in ((1.5, 1.0 + 1e-9 * 2.0**0.5, 0.5), (1.5, 1.0, 0.5))
    )
    assert near.objective == pytest.approx(exact.objective, rel=1e-6)
    assert near.lower_bound <= near.objective * (1.0 + 1e-12)


def test_above_c_star_the_mixture_pays_both_mdps_alike_and_leaves_some_of_the_budget():
    """Two actions: at c = 2 the line of their mixtures meets J = (c / epsilon) L by hand.

    L is 0.1 of the safe and 0.2 + 0.8 * 0.1 of the rash action, their J is 3 and 1. J = 8 L at the
    weight w of the rash one with 3 - 2 w = 8 (0.1 + 0.18 w); c* = 4 / 3 has L = 0.25.
    """
    model = written("x safe: 1 g 3\nx rash: 0.8 g 1, 0.2 d 1")
    problem = MCMP(
        model, start="x", failure_budget=0.25, discount=0.9, give_up="dead_ends",
        charge_failing_step=False,
    )  # fmt: skip
    player = stationary_player(problem)
    found = play(player, GameAtC(2.0, 0.25))
    weight = 2.2 / 3.44
    assert found.weight == pytest.approx(weight, **EXACT)
    assert found.failure_price == pytest.approx(2 / 0.18, **EXACT)
    played = evaluate(found.policy(player), problem)
    assert played.objective == pytest.approx(3 - 2 * weight, **EXACT)
    assert played.discounted_failure == pytest.approx(0.1 + 0.18 * weight, **EXACT)
    assert play(player, GameAtC(4 / 3, 0.25)).upper == pytest.approx(4 / 3, **EXACT)
