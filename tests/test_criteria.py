"""The criteria beside MCMP and S3P with a budget: enumeration, identities, refusals."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from checks import CLOSE, GAP, check_certificate, check_evaluation, library_model, plain
from formulations import ISSPUDE, MCMP, S3P, AlphaMCMP, FinitePenalty, MaxProb, MinCost, MinProb
from references import mcmp, s3p
from references.chain import start_distribution
from references.frontier import constrained_optimum, least_failure
from small_models import EXACT, FREE_LOOP, FREE_PAIR, TWO_MOVES, each_engine, model_of
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    MixedPolicy,
    ModelError,
    certify,
    cross_check,
    evaluate,
    simulate,
    solve,
    trace_frontier,
)
from ssp_lp.engines.label_instance import LabelInstance
from ssp_lp.process.semantics import GiveUp, Semantics
from ssp_lp.process.semantics import start_distribution as distribution_of
from strategies import discounts, problems

ENGINES = ("lp", "columns")
PUBLISHED = {"give_up": "anywhere", "charge_failing_step": False}
meanings = st.fixed_dictionaries(
    {
        "give_up": st.sampled_from(["anywhere", "attention", "dead_ends"]),
        "charge_failing_step": st.booleans(),
    }
)
penalties = st.sampled_from([0.1, 1.0, 3.0, 10.0, 1000.0])
shares = st.sampled_from([0.0, 0.1, 0.5, 0.9, 0.999, 1.0])


def often(examples):
    """The same settings everywhere; only the number of examples differs."""
    return settings(max_examples=examples, deadline=None, derandomize=True)


def check_all(solution, value):
    """The value, a small gap on the right side, the evaluation and the certificate."""
    assert solution.objective == pytest.approx(value, **CLOSE)
    assert 0.0 <= solution.gap <= GAP
    check_evaluation(solution)
    certificate = certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= GAP
    assert certificate.objective == pytest.approx(value, **CLOSE)


@often(100)
@given(problems())
def test_extreme_probabilities(drawn):
    """MAXPROB and MINPROB by enumeration, for every kind of start."""
    model, reference = library_model(drawn), plain(drawn)
    low = high = 0.0
    for state, mass in start_distribution(drawn.start).items():
        one, other = (
            (1.0, 1.0) if state in drawn.goals else s3p.goal_probability_range(reference, state)
        )
        low, high = low + mass * one, high + mass * other
    for engine in ENGINES:
        greatest = solve(MaxProb(model, drawn.start), engine)
        check_all(greatest, high)
        assert greatest.lower_bound <= high * (1 + 1e-9) + 1e-12
        assert greatest.upper_bound >= high * (1 - 1e-9) - 1e-12
        least = solve(MinProb(model, drawn.start), engine)
        check_all(least, low)
        assert least.lower_bound <= low * (1 + 1e-9) + 1e-12
        assert least.upper_bound is None
    assert MaxProb(model, drawn.start).dead_ends == reference.dead_ends
    assert MinProb(model, drawn.start).attention_states == reference.attention


@often(100)
@given(problems())
def test_the_plain_problem(drawn):
    """The cheapest policy that reaches the goal surely, if there is one."""
    points = mcmp.points(plain(drawn), drawn.start, give_up="dead_ends", charge_failing_step=False)
    proper = [point.cost for point in points if point.failure <= 1e-11]
    problem = MinCost(library_model(drawn), drawn.start)
    for engine in ENGINES:
        if proper:
            solution = solve(problem, engine)
            check_all(solution, min(proper))
            assert solution.failure_price == np.inf
            assert solution.budget_slope is None
            continue
        with pytest.raises(InfeasibleError, match="surely from state") as caught:
            solve(problem, engine)
        assert caught.value.least_failure == pytest.approx(least_failure(points), abs=1e-12)


@often(100)
@given(problems(), penalties, meanings, discounts)
def test_a_finite_penalty(drawn, penalty, meaning, discount):
    """The least of cost + penalty * failure over all policies, exact or discounted."""
    points = mcmp.points(plain(drawn), drawn.start, discount=discount, **meaning)
    value = min(point.cost + penalty * point.failure for point in points)
    problem = FinitePenalty(
        library_model(drawn), drawn.start, penalty, discount=discount, **meaning
    )
    for engine in ENGINES:
        solution = solve(problem, engine)
        check_all(solution, value)
        check_certificate(solution)
        assert solution.failure_price == penalty
        assert solution.budget_slope == 0.0
        assert len(solution.policy.policies) == 1


@often(50)
@given(problems(), shares, meanings)
def test_a_share_of_the_greatest_probability(drawn, share, meaning):
    """The best lottery whose goal probability is the share of the greatest one."""
    points = mcmp.points(plain(drawn), drawn.start, **meaning)
    budget = 1.0 - share * (1.0 - least_failure(points))
    value = constrained_optimum(points, budget)
    model = library_model(drawn)
    for engine in ENGINES:
        for problem in (
            AlphaMCMP(model, drawn.start, share, **meaning),
            MCMP(model, drawn.start, reach_fraction=share, **meaning),
        ):
            assert problem.failure_budget == pytest.approx(budget, abs=1e-12)
            check_all(solve(problem, engine), value)


@often(40)
@given(problems(), st.sampled_from([0.5, 0.9, 1.0]))
def test_s3p_and_isspude(drawn, share):
    """At least failure S3P is iSSPUDE, and a share is a budget."""
    model, begin = library_model(drawn), drawn.start
    least, cost = s3p.at_least_failure(plain(drawn), begin)
    if least >= 1 - 1e-12:
        with pytest.raises(InfeasibleError):
            solve(ISSPUDE(model, begin))
        return
    check_all(solve(ISSPUDE(model, begin)), cost)
    assert solve(S3P(model, begin)).objective == pytest.approx(cost, **CLOSE)
    problem = S3P(model, begin, reach_fraction=share)
    same = S3P(model, begin, failure_budget=1.0 - share * (1.0 - least))
    assert solve(problem).objective == pytest.approx(solve(same).objective, **CLOSE)


@often(40)
@given(problems(), meanings)
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


@often(40)
@given(problems())
def test_the_cost_of_a_share_is_linear_up_to_the_best_ratio(drawn):
    """Giving up at the start is free: linear up to the least cost per probability, then convex."""
    model = library_model(drawn)
    points = mcmp.points(plain(drawn), drawn.start, **PUBLISHED)
    greatest = 1.0 - least_failure(points)
    hopeful = [(c / (1 - f), 1 - f) for f, c in points if f < 1 - 1e-12 and np.isfinite(c)]
    if not hopeful or any(start in drawn.goals for start in start_distribution(drawn.start)):
        return
    ratio = min(hopeful)[0]
    reach = max(goal for slope, goal in hopeful if slope <= ratio * (1 + 1e-12))
    grid = np.linspace(0.0, 1.0, 9)
    costs = [solve(AlphaMCMP(model, drawn.start, share)).objective for share in grid]
    for share, cost in zip(grid, costs, strict=True):
        line = ratio * share * greatest
        if share * greatest <= reach:
            assert cost == pytest.approx(line, **CLOSE)
        else:
            assert cost >= line - 1e-9
    assert (np.diff(costs, 2) >= -1e-9 * (1.0 + max(costs))).all()


@each_engine
def test_loops_that_cost_nothing_do_not_fool_the_plain_problem(engine):
    assert solve(MinCost(model_of(FREE_LOOP), "x"), engine).objective == pytest.approx(5, **EXACT)
    assert solve(MinCost(model_of(FREE_PAIR), "x"), engine).objective == pytest.approx(6, **EXACT)


@each_engine
def test_extreme_probabilities_where_one_may_wander(engine):
    model = model_of(FREE_PAIR)
    assert solve(MaxProb(model, "x"), engine).objective == pytest.approx(1.0, **EXACT)
    assert solve(MinProb(model, "x"), engine).objective == 0.0
    assert MaxProb(model, "x").dead_ends == {"d"}
    assert MinProb(model, "x").attention_states == {"x", "y", "d"}


@pytest.mark.parametrize(
    "backend", ["highs-simplex", "highs-ipx", "highs-warm", "clarabel", "cvxpy"]
)
def test_every_backend_answers(backend):
    model = model_of(TWO_MOVES)
    for problem, value in (
        (MaxProb(model, "x"), 1.0),
        (MinProb(model, "x"), 0.95),
        (MinCost(model, "x"), 2.0),
        (FinitePenalty(model, "x", 10.0), 1.5),
        (AlphaMCMP(model, "x", 0.975), 1.5),
    ):
        found = solve(problem, "lp", backend=backend)
        assert found.objective == pytest.approx(value, **EXACT)
        assert found.engine == "lp"
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
    for price in (9.0, -1.0, np.nan, np.inf):
        assert not certify(replace(solution, failure_price=price)).accepted
    for values in (2.0 * solution.value_function, 0.5 * solution.value_function):
        wrong = certify(replace(solution, value_function=values))
        assert wrong.lower_bound <= solution.objective * (1 + 1e-12)
    slow = MixedPolicy((DeterministicPolicy.from_actions(model, {"x": "slow"}),), np.ones(1))
    worse = certify(replace(solution, policy=slow))
    assert worse.accepted
    assert worse.gap == pytest.approx(0.25)
    fast = MixedPolicy((DeterministicPolicy.from_actions(model, {"x": "fast"}),), np.ones(1))
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


FINED = Semantics(GiveUp.ANYWHERE, charge_failing_step=False, penalty=10.0)


@dataclass(frozen=True)
class Fined:
    """A user's own problem: the penalty is one more word of the semantics."""

    model: SSP
    start: str
    failure_budget: float
    discount: None = None
    ratio: bool = False
    semantics: Semantics = FINED

    def instance(self) -> LabelInstance:
        return LabelInstance(self.model, distribution_of(self.model, self.start), self.semantics)


def test_a_penalty_and_a_budget_go_together():
    """Cost 1 + 10 * 0.05 beats 2; within a budget of 0.02 the lottery pays 2 - 0.4 * 0.5."""
    solution = solve(Fined(model_of(TWO_MOVES), "x", failure_budget=0.02))
    assert solution.objective == pytest.approx(1.8, **EXACT)
    assert solution.failure_price == pytest.approx(20.0, **EXACT)
    assert solution.budget_slope == pytest.approx(10.0, **EXACT)
    assert trace_frontier(solution.problem).price == pytest.approx([10.0], **EXACT)
    check_certificate(solution)


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


def test_words_for_people():
    model = model_of(TWO_MOVES)
    for problem, words in (
        (MaxProb(model, "x"), "MaxProb, greatest goal probability, exact"),
        (MinProb(model, "x"), "MinProb, least goal probability, exact"),
        (MinCost(model, "x"), "MinCost, no failure, exact"),
        (FinitePenalty(model, "x", 10), "FinitePenalty, penalty 10, exact"),
    ):
        assert solve(problem).summary().startswith(words)
    assert "upper bound" in solve(MaxProb(model, "x")).summary()


def test_the_other_verbs_take_every_criterion():
    model = model_of(FREE_PAIR)
    rng = np.random.default_rng(7)
    for problem in (
        MaxProb(model, "x"),
        MinProb(model, "x"),
        MinCost(model, "x"),
        FinitePenalty(model, "x", 3.0),
        AlphaMCMP(model, "x"),
        ISSPUDE(model, "x"),
    ):
        solution = solve(problem)
        agreement = cross_check(problem)
        assert agreement.agrees, agreement.summary()
        played = simulate(solution.policy, problem, episodes=200, rng=rng)
        assert played.episodes == 200
