"""The criteria beside MCMP and S3P with a budget: closed forms, refusals, wrong proofs."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from checks import GAP, check_certificate
from formulations import ISSPUDE, MCMP, S3P, AlphaMCMP, FinitePenalty, MaxProb, MinCost, MinProb
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
    simulate,
    solve,
    trace_frontier,
)
from ssp_lp.column_generation.compiled_problem import CompiledExplicit
from ssp_lp.compiled.deadline import check_time, is_limited
from ssp_lp.processes.failure_semantics import (
    FailureSemantics,
    GiveUp,
    start_distribution as distribution_of,
)


@each_method
def test_loops_that_cost_nothing_do_not_fool_the_plain_problem(method):
    assert solve(MinCost(model_of(FREE_LOOP), "x"), method).objective == pytest.approx(5, **EXACT)
    assert solve(MinCost(model_of(FREE_PAIR), "x"), method).objective == pytest.approx(6, **EXACT)


@each_method
def test_extreme_probabilities_where_one_may_wander(method):
    model = model_of(FREE_PAIR)
    assert solve(MaxProb(model, "x"), method).objective == pytest.approx(1.0, **EXACT)
    assert solve(MinProb(model, "x"), method).objective == 0.0
    assert MaxProb(model, "x").dead_ends == {"d"}
    assert MinProb(model, "x").attention_states == {"x", "y", "d"}


@pytest.mark.parametrize("backend", ["highs-simplex", "highs-ipx", "clarabel", "cvxpy"])
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


FINED = FailureSemantics(GiveUp.ANYWHERE, charge_failing_step=False, penalty=10.0)


@dataclass(frozen=True)
class Fined:
    """A user's own problem: the penalty is one more word of the semantics."""

    model: SSP
    start: str
    failure_budget: float
    discount: None = None
    ratio: bool = False
    semantics: FailureSemantics = FINED

    def compile(self) -> CompiledExplicit:
        return CompiledExplicit(self.model, distribution_of(self.model, self.start), self.semantics)


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
    with pytest.raises(OutOfTimeError, match="failure_budget followed from reach_fraction"):
        _ = problem.failure_budget
    assert solve(problem).failure_probability <= 0.02 * (1.0 + 1e-12)
    assert limited == [True, False]


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
