"""The criteria beside MCMP and S3P with a budget: enumeration, identities, closed forms, edges."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from checks import CLOSE, GAP, check_certificate, check_evaluation, library_model, plain
from formulations import (
    ISSPUDE,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostLimit,
    FinitePenalty,
    MaxProb,
    MinCost,
    MinProb,
)
from references import mcmp, s3p
from references.frontier import least_failure
from small_models import EXACT, FREE_LOOP, FREE_PAIR, TWO_MOVES, each_method, model_of
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    LinearProgramming,
    MixedPolicy,
    ModelError,
    OutOfTimeError,
    certify,
    cross_check,
    evaluate,
    expected_cost,
    simulate,
    solve,
    trace_frontier,
)
from ssp_lp.compiled.deadline import check_time, is_limited
from ssp_lp.formulation import GiveUp
from strategies import often, problems, semantics

METHODS = ("lp", "columns")


def check_all(problem, value):
    """By both methods the value, a small gap on the right side, the evaluation, the certificate."""
    for method in METHODS:
        solution = solve(problem, method)
        assert solution.objective == pytest.approx(value, **CLOSE)
        assert 0.0 <= solution.gap <= GAP
        assert solution.lower_bound <= value * (1 + 1e-9) + 1e-12
        if solution.upper_bound is not None:
            assert solution.upper_bound >= value * (1 - 1e-9) - 1e-12
        check_evaluation(solution)
        certificate = certify(solution)
        assert certificate.accepted, certificate.reason
        assert certificate.gap <= GAP
        assert certificate.objective == pytest.approx(value, **CLOSE)
    return solution


@pytest.mark.slow
@often(33)
@given(problems())
def test_extreme_probabilities_and_the_plain_problem(drawn):
    """By enumeration, for every kind of start: MAXPROB, MINPROB, the cheapest proper policy."""
    model, reference = library_model(drawn), plain(drawn)
    low, high = s3p.goal_probability_range(reference, drawn.start)
    check_all(MaxProb(model, drawn.start), high)
    assert check_all(MinProb(model, drawn.start), low).upper_bound is None
    assert MaxProb(model, drawn.start).dead_ends == reference.dead_ends
    assert MinProb(model, drawn.start).attention_states == reference.attention
    points = mcmp.points(reference, drawn.start, give_up="dead_ends", charge_failing_step=False)
    proper = [point.cost for point in points if point.failure <= 1e-11]
    problem = MinCost(model, drawn.start)
    if proper:
        solution = check_all(problem, min(proper))
        assert solution.failure_price == np.inf
        assert solution.budget_slope is None
        return
    for method in METHODS:
        with pytest.raises(InfeasibleError, match="surely from state") as caught:
            solve(problem, method)
        assert caught.value.least_failure == pytest.approx(least_failure(points), abs=1e-12)


@often(13)
@given(problems(), semantics)
def test_penalties_run_along_the_frontier(drawn, meaning):
    """The optimum at penalty D is where the frontier's tangent of slope -D meets failure 0.

    That is the least of cost + D * failure over the frontier's turning points.
    """
    model = library_model(drawn)
    frontier = trace_frontier(MCMP(model, drawn.start, **meaning))
    for penalty in (0.5, 2.0, 25.0):
        solution = solve(FinitePenalty(model, drawn.start, penalty, **meaning))
        tangent = float((frontier.cost + penalty * frontier.failure).min())
        assert solution.objective == pytest.approx(tangent, **CLOSE)
        budget = solution.failure_probability
        on_frontier = frontier.objective_at(min(budget + 1e-12, 1.0))
        assert solution.expected_cost == pytest.approx(on_frontier, rel=1e-6, abs=1e-9)


@each_method
def test_loops_that_cost_nothing(method):
    """They do not fool the plain problem, and one may wander in them."""
    assert solve(MinCost(model_of(FREE_LOOP), "x"), method).objective == pytest.approx(5, **EXACT)
    model = model_of(FREE_PAIR)
    assert solve(MinCost(model, "x"), method).objective == pytest.approx(6, **EXACT)
    assert solve(MaxProb(model, "x"), method).objective == pytest.approx(1.0, **EXACT)
    assert solve(MinProb(model, "x"), method).objective == 0.0
    assert MaxProb(model, "x").dead_ends == {"d"}
    assert MinProb(model, "x").attention_states == {"x", "y", "d"}


class ChargedS3P(S3P):
    """The cost given success; until failing the cheapest step of a dead-end is paid as well."""

    charge_failing_step = True


TRAP = model_of(
    {
        "a": {"fast": [(0.8, "g", 1), (0.2, "pit", 1)], "slow": [(1.0, "g", 10)]},
        "pit": {"roll": [(1.0, "pit", 6)], "sink": [(0.5, "bog", 3), (0.5, "pit", 1)]},
        "bog": {},
    }
)
"""Going fast fails with 1/5 in a pit where steps go on, the cheapest of them for 2."""
HALVES, FUEL = {"a": 0.5, "pit": 0.5}, {"a": {"fast": 1}, "pit": {"roll": 1, "sink": 3}}
ENTERED = [
    # half go fast, and pay 1 and, in a fifth of the cases, 2 for the pit: 0.5 * 1.4 + 0.5 * 10
    *((MCMP(TRAP, "a", 0.1, None, stop, True), 5.7, 5.7) for stop in GiveUp),
    *((MCMP(TRAP, "a", 0.1, None, stop, False), 5.5, 5.5) for stop in GiveUp),
    (MCMP(TRAP, HALVES, 0.55), (5.7 + 2) / 2, 3.85),  # to begin there is to enter it
    (MCMP(TRAP, HALVES, 0.55, charge_failing_step=False), 5.5 / 2, 2.75),
    (MCMP(TRAP, "a", 0.19, 0.9), 0.5 * (1 + 0.9 * 0.4) + 5, None),  # a step later
    (FinitePenalty(TRAP, "a", 10.0, charge_failing_step=True), 3.4, 1.4),  # all go fast
    (ChargedS3P(TRAP, "a", 0.1), (0.4 * 1 + 0.5 * 10) / 0.9, 5.7),  # a success pays no failing
    (S3P(TRAP, "a", 0.1), 6, 5.5),
    (ConstrainedCost(TRAP, "a", {"fuel": CostLimit(FUEL, 0.6)}, 1.0), 5.7, 5.7),
    (ConstrainedCost(TRAP, HALVES, {"fuel": CostLimit(FUEL, 0.8)}, 1.0), (5.7 + 2) / 2, 3.85),
]


@pytest.mark.parametrize(("problem", "value", "paid"), ENTERED)
def test_entering_a_dead_end_costs_its_cheapest_step_once(problem, value, paid):
    """By every method, evaluation, certificate and simulation."""
    solution = check_all(problem, value)
    if problem.discount is not None:
        game = solve(problem, "game")
        assert game.objective == pytest.approx(value, rel=1e-6)
        return
    assert solution.expected_cost == pytest.approx(paid, **CLOSE)
    played = simulate(solution.policy, problem, episodes=4_000, seed=1, confidence=0.9999)
    assert played.expected_cost.low <= paid <= played.expected_cost.high


@pytest.mark.parametrize("backend", ["highs-simplex", "highs-ipx", "cvxpy"])
def test_every_backend_answers(backend):
    model = model_of(TWO_MOVES)
    for problem, value in (
        (MaxProb(model, "x"), 1.0),
        (MinProb(model, "x"), 0.95),
        (MinCost(model, "x"), 2.0),
        (FinitePenalty(model, "x", 10.0), 1.5),
        (AlphaMCMP(model, "x", 0.975), 1.5),
    ):
        found = solve(problem, LinearProgramming(backend))
        assert found.objective == pytest.approx(value, **EXACT)
        assert found.method == "lp"
        assert found.run.program


def test_tiny_probabilities_keep_their_digits():
    """A chain of ten moves at 1e-3 each: 1e-30, with a gap relative to that."""
    chain = {k: {"go": [(1e-3, k + 1 if k < 9 else "g", 1), (0.999, "d", 1)]} for k in range(10)}
    solution = solve(MaxProb(model_of({**chain, "d": {}}), 0))
    assert solution.objective == pytest.approx(1e-30, rel=1e-12)
    assert solution.gap <= GAP


def test_an_improper_policy_costs_infinity_in_the_plain_problem():
    model = model_of({**TWO_MOVES, "x": {**TWO_MOVES["x"], "wait": [(1.0, "x", 0)]}})
    problem = MinCost(model, "x")
    for action, cost in (("slow", 2.0), ("fast", np.inf), ("wait", np.inf)):
        policy = DeterministicPolicy.from_actions(model, {"x": action})
        assert evaluate(policy, problem).objective == cost
        certificate = certify(replace(solve(problem), policy=MixedPolicy((policy,), np.ones(1))))
        assert certificate.accepted is (cost == 2.0)


def test_a_failure_that_floats_cannot_see_is_still_a_failure():
    """Failing with 1e-18 leaves the goal probability at 1.0, but there is no proper policy."""
    model = model_of({"x": {"go": [(1.0, "g", 1), (1e-18, "d", 1)]}, "d": {}})
    assert solve(MaxProb(model, "x")).objective == 1.0
    with pytest.raises(InfeasibleError, match="from state 'x'"):
        solve(MinCost(model, "x"))


def test_wrong_proofs_are_refused_or_widen_the_gap():
    model = model_of(TWO_MOVES)
    solution = solve(FinitePenalty(model, "x", 10.0))
    assert (solution.failure_price, solution.budget_slope) == (10.0, 0.0)
    check_certificate(solution)
    for price in (9.0, -1.0, np.nan, np.inf):
        assert not certify(replace(solution, failure_price=price)).accepted
    for values in (2.0 * solution.value_function, 0.5 * solution.value_function):
        wrong = certify(replace(solution, value_function=values))
        assert wrong.lower_bound <= solution.objective * (1 + 1e-12)
    slow, fast = (
        MixedPolicy((DeterministicPolicy.from_actions(model, {"x": action}),), np.ones(1))
        for action in ("slow", "fast")
    )
    worse = certify(replace(solution, policy=slow))
    assert worse.accepted
    assert worse.gap == pytest.approx(0.25)
    timid = certify(replace(solve(MaxProb(model, "x")), policy=fast))
    assert (timid.objective, timid.upper_bound) == pytest.approx((0.95, 1.0))
    assert timid.gap == pytest.approx(0.05)


def test_costs_do_not_matter_to_isspude_where_they_are_of_no_use():
    """Dearer dead-ends change MCMP and leave iSSPUDE alone."""
    values = []
    for cost in (1, 50):
        model = SSP.from_transitions(
            {"x": {"go": [(0.5, "g", 1), (0.5, "d", cost)]}, "d": {"stay": [(1.0, "d", cost)]}},
            goal={"g"},
        )
        values.append([solve(c(model, "x")).objective for c in (ISSPUDE, S3P, MCMP)])
    assert values[0][:2] == values[1][:2] == [1.0, 1.0]
    assert values[0][2] < values[1][2]


@pytest.mark.parametrize(
    "build",
    [
        lambda m: FinitePenalty(m, "x", 0.0),
        lambda m: FinitePenalty(m, "x", float("inf")),
        lambda m: FinitePenalty(m, "x", "much"),
        lambda m: FinitePenalty(m, "x", 1.0, give_up="never"),
        lambda m: AlphaMCMP(m, "x", 1.5),
        lambda m: AlphaMCMP(m, "x", -0.1),
        lambda m: MCMP(m, "x", failure_budget=0.1, reach_fraction=0.9),
        lambda m: S3P(m, "x", failure_budget=0.1, reach_fraction=0.9),
        lambda m: S3P(m, "x", reach_fraction=2.0),
        lambda m: MaxProb(m, "nowhere"),
        lambda m: MinCost(m, "nowhere"),
        lambda m: solve(MaxProb(m, "x"), "game"),
        lambda m: solve(FinitePenalty(m, "x", 1.0, discount=0.9), "game"),
        lambda m: trace_frontier(MinCost(m, "x")),
        lambda m: trace_frontier(MaxProb(m, "x")),
    ],
)
def test_refusals(build):
    with pytest.raises(ModelError):
        build(model_of(TWO_MOVES))


def test_stating_a_share_solves_nothing_and_asks_once():
    problem = S3P(model_of(TWO_MOVES), "x", reach_fraction=0.98)
    assert "_budget" not in vars(problem)
    assert problem.failure_budget == pytest.approx(0.02)
    assert vars(problem)["_budget"] == problem.failure_budget
    assert solve(problem).objective == pytest.approx(79 / 49, rel=1e-9)
    assert MCMP.failure_budget is None


def test_reading_a_budget_of_a_share_ends_soon(monkeypatch):
    """``solve`` works it out for as long as it is given; an attribute starts no unlimited work."""
    limited = []

    def endless(*given):
        limited.append(is_limited())
        while limited[-1]:
            check_time()
        return 0.02

    monkeypatch.setattr("ssp_lp.problem.budget_of_share", endless)
    monkeypatch.setattr("ssp_lp.problem.READING", 1e-3)
    problem = MCMP(model_of(TWO_MOVES), "x", reach_fraction=0.98)
    with pytest.raises(OutOfTimeError, match="failure_budget was computed from reach_fraction"):
        _ = problem.failure_budget
    assert solve(problem).failure_probability <= 0.02 * (1.0 + 1e-12)
    assert limited == [True, False]


def test_the_other_verbs_and_words_for_people():
    model, rng = model_of(FREE_PAIR), np.random.default_rng(7)
    for problem, words in (
        (MaxProb(model, "x"), "MaxProb, greatest goal probability, exact"),
        (MinProb(model, "x"), "MinProb, least goal probability, exact"),
        (MinCost(model, "x"), "MinCost, no failure, exact"),
        (FinitePenalty(model, "x", 3.0), "FinitePenalty, penalty 3, exact"),
        (AlphaMCMP(model, "x"), "AlphaMCMP"),
        (ISSPUDE(model, "x"), "ISSPUDE"),
    ):
        solution, agreement = solve(problem), cross_check(problem)
        assert solution.summary().startswith(words)
        assert agreement.agrees, agreement.summary()
        assert simulate(solution.policy, problem, episodes=200, seed=rng).episodes == 200
    assert "upper bound" in solve(MaxProb(model, "x")).summary()


@each_method
def test_policies_that_fail_alike_and_rarely_are_told_apart_by_cost(method: str) -> None:
    """Every policy without "turn" fails with 1e-9 exactly; goal probabilities near 1 round more."""
    near, far = 999_999e-15, 999e-12
    model = model_of(
        {
            "x": {
                "dear": [(1.0 - near - 1e-6, "g", 2.0), (near, "d", 2.0), (1e-6, "y", 0.0)],
                "cheap": [(0.25, "x", 0.0), (0.75, "y", 1.0)],
            },
            "y": {
                "go": [(far, "d", 1.0), (1.0 - far - 1e-3, "g", 0.0), (1e-3, "x", 5.0)],
                "turn": [(0.25, "x", 1.0), (0.75, "d", 2.0)],
            },
            "d": {},
        }
    )
    start = {"x": 0.5, "y": 0.5}
    solution = solve(S3P(model, start), method=method)
    assert solution.failure_probability == pytest.approx(1e-9, rel=1e-6)
    assert solution.objective == pytest.approx(0.506006006006006, rel=1e-9)
    assert certify(solution).accepted
    within = solve(MCMP(model, start, 1.1e-9, give_up="dead_ends"), method=method)
    assert within.objective <= 0.5060060071


def test_a_limit_on_the_cost_counts_what_entering_a_dead_end_costs_given_success():
    """Failing costs 100: mean costs are 21 on the fast way, 10 on the slow one, 15.5 allowed."""

    class ChargedS3P(S3P):
        charge_failing_step = True

    ways = {
        "a": {"fast": [(0.8, "g", 1.0), (0.2, "pit", 1.0)], "slow": [(1.0, "g", 10.0)]},
        "pit": {"roll": [(1.0, "pit", 104.0)], "sink": [(0.5, "bog", 101.0), (0.5, "pit", 99.0)]},
        "bog": {},
    }
    limits = {"cost": expected_cost() <= 15.5}
    problem = ChargedS3P(model_of(ways, "g"), "a", 1.0, constraints=limits)
    for method in ("columns", "lp"):
        solution = solve(problem, method=method)
        assert solution.objective == pytest.approx((0.5 * 0.8 * 1.0 + 0.5 * 10.0) / 0.9)
        assert certify(solution).accepted
    assert problem.program().solve().objective == pytest.approx(6.0)
