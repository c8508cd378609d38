"""Drawn problems under a discount on all three roads: one answer, and the faults found so far."""

import time

import numpy as np
import pytest
from hypothesis import given, strategies as st

from checks import library_model
from formulations import MCMP, S3P
from small_models import model_of
from ssp_lp import InfeasibleError, certify, evaluate, solve
from ssp_lp.verification.cross_check import METHODS, compare_methods, result_of
from strategies import acyclic_problems, often, problems, semantics

discounts = st.sampled_from([0.9, 0.99, 0.5, 0.999])
shares = st.sampled_from([0.25, 0.02, 0.1, 0.5, 0.75, 0.95, 1.0])
"""Where the budget lies between the least discounted failure (0) and 1."""


def least_failure(problem):
    """The least discounted failure."""
    return problem.compile().least_failure().column.failure


def check_roads(problem):
    """No disagreement, and the game's own proof holds."""
    solutions = {name: solve(problem, name) for name in METHODS}
    found = compare_methods([result_of(name, s) for name, s in solutions.items()], problem)
    assert found.agrees, found.summary()
    assert found.objective_distance <= 1e-7
    game = solutions["game"]
    certificate = certify(game)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= 1e-8
    assert game.gap <= 1e-8
    assert evaluate(game.policy, problem).objective == pytest.approx(
        game.objective, rel=1e-9, abs=1e-12
    )


def check_infeasible(problem):
    """Every method says so, with the same least failure."""
    least = []
    for name in METHODS:
        with pytest.raises(InfeasibleError) as caught:
            solve(problem, name)
        least.append(caught.value.least_discounted_failure)
    assert max(least) - min(least) <= 1e-9


def check_s3p(drawn, discount, share):
    """Case S at a share of the way from the least discounted failure to 1."""
    model = library_model(drawn)
    anything = S3P(model, start=drawn.start, failure_budget=1.0, discount=discount)
    least = least_failure(anything)
    if least >= 1.0 - 1e-12:
        check_infeasible(anything)
        return
    budget = min(least + share * (1.0 - least), 1.0)
    check_roads(S3P(model, start=drawn.start, failure_budget=budget, discount=discount))


@often(560)
@given(problems(), semantics, discounts, shares)
def test_three_roads_agree_on_mcmp(drawn, meaning, discount, share):
    """Ties, free cycles, sure failure, every semantics, starts on goals and dead-ends."""
    model = library_model(drawn)

    def problem(budget):
        return MCMP(model, start=drawn.start, failure_budget=budget, discount=discount, **meaning)

    least = least_failure(problem(1.0))
    check_roads(problem(min(least + share * (1.0 - least), 1.0)))


@often(160)
@given(problems(most_live=3, attention=True), discounts, shares)
def test_three_roads_agree_on_s3p_where_every_state_can_wait(drawn, discount, share):
    """Every live state is an attention state."""
    check_s3p(drawn, discount, share)


@often(140)
@given(acyclic_problems(), discounts, shares)
def test_three_roads_agree_on_s3p_where_every_run_ends(drawn, discount, share):
    """Finitely many layers."""
    check_s3p(drawn, discount, share)


@often(140)
@given(problems(most_live=3), discounts, shares)
def test_three_roads_agree_on_s3p_with_cycles(drawn, discount, share):
    """Cycles outside the attention states: what follows beyond M matters."""
    check_s3p(drawn, discount, share)


@often(60)
@given(problems(), discounts, st.sampled_from([0.5, 0.9, 0.999]), st.booleans())
def test_three_roads_agree_that_nothing_is_feasible(drawn, discount, part, ratio):
    """A budget clearly below the least discounted failure."""
    criterion, model = S3P if ratio else MCMP, library_model(drawn)
    loose = criterion(model, start=drawn.start, failure_budget=1.0, discount=discount)
    least = least_failure(loose)
    if least > 1e-6:
        check_infeasible(
            criterion(model, start=drawn.start, failure_budget=part * least, discount=discount)
        )


@often(60)
@given(problems(most_live=3), discounts, st.booleans())
def test_three_roads_agree_at_the_least_failure(drawn, discount, ratio):
    """The budget equal to the least discounted failure: the cheapest policy of least failure."""
    criterion, model = S3P if ratio else MCMP, library_model(drawn)
    loose = criterion(model, start=drawn.start, failure_budget=1.0, discount=discount)
    least = least_failure(loose)
    if 0.0 < least < 1.0 - 1e-12:
        problem = criterion(model, start=drawn.start, failure_budget=least, discount=discount)
        found = compare_methods(
            [result_of(name, solve(problem, name)) for name in METHODS], problem
        )
        assert found.agrees, found.summary()
        assert certify(solve(problem, "game")).accepted


def walk(cost=1.0, wait=None, slip=0.1):
    """A corridor of three cells with a risky short cut; `wait` adds free or paid waiting."""
    ahead = {"a": "b", "b": "c", "c": "home"}
    choices = {
        state: {
            "step": [(0.5, successor, cost), (0.5, state, cost)],
            "jump": [(1.0 - slip, "home", cost), (slip, "wreck", cost)],
        }
        for state, successor in ahead.items()
    }
    for state in ahead:
        if wait is not None:
            choices[state]["wait"] = [(1.0, state, wait)]
    choices["wreck"] = {}
    return model_of(choices, "home")


def test_a_slow_loop_takes_few_sweeps():
    """Improving the greedy policy by its own values spares the 1 / (1 - gamma) sweeps."""
    choices = {
        "a": {
            "crawl": [(1e-5, "home", 3.0), (1.0 - 1e-5, "a", 0.0)],
            "dash": [(0.5, "home", 1.0), (0.5, "wreck", 0.0)],
        },
        "wreck": {},
    }
    model = model_of(choices, "home")
    for give_up in ("anywhere", "dead_ends"):
        problem = MCMP(model, start="a", failure_budget=0.3, discount=0.999999, give_up=give_up)
        game = solve(problem, "game")
        assert game.gap <= 1e-9
        assert game.run.backups <= 5_000
        check_roads(problem)


def test_free_steps_within_a_layer_take_no_time():
    """The choice of the layer after it is improved, no iteration begins at 0."""
    rng = np.random.default_rng(5)
    choices = {"wreck": {}}
    for i in range(20):
        moves = [f"s{int(j)}" for j in rng.integers(0, 20, 4)]
        choices[f"s{i}"] = {
            "free": [(0.5, moves[0], 0.0), (0.5, moves[1], 0.0)],
            "paid": [(0.5, moves[2], 1.0), (0.5, moves[3], 0.0)],
            "end": [(0.4, "home", 3.0), (0.6, "wreck" if i % 3 else moves[0], 1.0)],
        }
    model = model_of(choices, "home")
    problem = S3P(model, start="s0", failure_budget=0.4, discount=0.999)
    began = time.perf_counter()
    check_roads(problem)
    assert time.perf_counter() - began <= 5.0


def test_a_slack_budget_in_case_s_is_proved():
    """Sure failure counts 0 in the bound of the least ratio, at budget 1 too."""
    for slip in (0.1, 0.3, 1.0 / 3.0, 0.82):
        for wait in (None, 0.0, 1.0):
            for discount in (0.5, 0.9, 0.999):
                model = walk(wait=wait, slip=slip)
                problem = S3P(model, start="a", failure_budget=1.0, discount=discount)
                game = solve(problem, "game")
                assert game.gap <= 1e-8
                check_roads(problem)


def test_a_start_whose_probabilities_sum_to_almost_one():
    """0.1 + 0.2 + 0.7 < 1 in floating point, and no mass lies on goals."""
    start = {"a": 0.1, "b": 0.2, "c": 0.7}
    problem = MCMP(walk(), start=start, failure_budget=0.2, discount=0.99)
    check_roads(problem)


def test_a_bracket_that_rounding_holds_open_is_left():
    """Just above the least failure the price is steep; the games do not repeat themselves."""
    choices = {
        "a": {
            "safe": [(0.9, "home", 2.0), (0.1, "wreck", 0.0)],
            "near": [(0.9 - 2e-7, "home", 1.0), (0.1 + 2e-7, "wreck", 0.0)],
            "rash": [(0.1, "home", 0.0), (0.9, "wreck", 0.0)],
        },
        "wreck": {},
    }
    model = model_of(choices, "home")
    loose = MCMP(model, start="a", failure_budget=1.0, discount=0.9)
    budget = least_failure(loose) + 4e-10
    problem = MCMP(model, start="a", failure_budget=budget, discount=0.9)
    assert solve(problem, "game", tolerance=1e-13).run.pricing_calls <= 40
    found = compare_methods([result_of(name, solve(problem, name)) for name in METHODS], problem)
    assert found.agrees, found.summary()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_least_failure_at_any_unit_of_cost(scale):
    """Steep prices are multiples of what the goal costs."""
    model = walk(cost=scale, wait=scale, slip=0.05)
    for criterion in (MCMP, S3P):
        loose = criterion(model, start="a", failure_budget=1.0, discount=0.9)
        problem = criterion(model, start="a", failure_budget=least_failure(loose), discount=0.9)
        check_roads(problem)


def test_a_free_optimum():
    """c* = 0: the game has no stake."""
    problem = MCMP(
        walk(cost=0.0, wait=0.0), start="a", failure_budget=0.5, discount=0.9, give_up="anywhere"
    )
    assert solve(problem, "game").objective == 0.0
    check_roads(problem)
