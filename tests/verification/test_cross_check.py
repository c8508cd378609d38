"""The comparison of the methods: one answer on drawn problems; who is named, and for what."""

import time
from dataclasses import replace
from functools import cache
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from checks import library_model
from formulations import MCMP, S3P, CVaR
from refusing import refused
from small_models import FIRST, model_of
from ssp_lp import (
    DeterministicPolicy,
    Game,
    InfeasibleError,
    LinearProgramming,
    MixedPolicy,
    ModelError,
    certify,
    cross_check,
    evaluate,
    expected_cost,
    solve,
)
from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.errors import SolverError
from ssp_lp.verification import cross_check as checking
from ssp_lp.verification.cross_check import (
    METHODS,
    MethodResult,
    SecondReading,
    compare_methods,
    result_by,
    result_of,
)
from strategies import acyclic_problems, often, problems, semantics

discounts = st.sampled_from([0.9, 0.99, 0.5, 0.999])
shares = st.sampled_from([0.25, 0.02, 0.1, 0.5, 0.75, 0.95, 1.0])
"""Where the budget lies between the least discounted failure (0) and 1."""


def first(criterion=MCMP, budget=0.05, discount=0.999, **options):
    return criterion(FIRST, "depot", failure_budget=budget, discount=discount, **options)


@cache
def answer(name, budget=0.05):
    """One method's row, maybe of another budget."""
    return result_of(name, solve(first(budget=budget), name))


def judged(**others):
    """Compare the rows of the three methods, some of them replaced or of changed solutions."""
    rows = {name: answer(name) for name in METHODS}
    for name, other in others.items():
        if isinstance(other, dict):
            other = replace(rows[name], answer=replace(rows[name].answer, **other))
        rows[name] = other
    return compare_methods(list(rows.values()), first())


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_three_roads_agree(criterion):
    problem = first(criterion)
    found = cross_check(problem)
    assert (found.agrees, found.failed, found.budget_overrun) == (True, (), 0.0)
    assert [method.name for method in found.methods] == list(METHODS)
    assert all(method.answer for method in found.methods)
    assert max(found.objective_distance, found.evaluated_distance) <= 1e-9
    assert found.weight_distance <= 1e-9
    for method in found.methods:
        weights, costs, failures = method.members.T
        assert (weights.sum(), weights @ failures) == pytest.approx((1.0, 0.05))
        success = 1.0 - 0.05 if problem.ratio else 1.0
        assert weights @ costs / success == pytest.approx(method.objective)
    lines = found.summary().splitlines()
    assert lines[0].split()[:3] == ["method", "objective", "bound"]
    assert len({len(line) for line in lines[:4]}) == 1
    assert lines[-1].startswith("3 methods agree: c* within ")


SAFE = model_of({"a": {"go": [(1.0, "g", 1.0)]}})


@pytest.mark.parametrize(
    ("problem", "answered", "note", "verdict"),
    [
        (first(discount=None), "110", "not run: the game needs a discount", "2 methods agree"),
        (MCMP(SAFE, "a", failure_budget=0.0), "110", "", "2 methods agree"),
        (
            first(budget=None, discount=None),
            "010",
            "",
            "nothing to compare: fewer than two answers",
        ),
        (
            first(S3P, cost_cap=50.0),
            "110",
            "not run: the game chooses its own cap M: leave cost_cap out",
            "2 methods agree",
        ),
    ],
    ids=["exact", "a budget of zero", "least failure", "a cap"],
)
def test_roads_that_are_not_asked(problem, answered, note, verdict):
    found = cross_check(problem)
    assert found.agrees
    assert [method.answer is not None for method in found.methods] == [
        one == "1" for one in answered
    ]
    assert not found.failed
    assert found.methods[2].note.startswith(note)
    assert found.summary().splitlines()[-1].startswith(verdict)


def test_a_large_program_is_not_asked(monkeypatch):
    monkeypatch.setattr(checking, "MOST_COLUMNS", 1)
    found = cross_check(first())
    assert found.methods[0].note.startswith("not run: ")
    assert "columns are too many" in found.methods[0].note
    assert found.agrees
    assert cross_check(first(), lp_backend="highs").methods[0].answer


def planted(monkeypatch, method, error):
    """The comparison where one method ends in an error."""

    def failing(problem, asked, **rest):
        if asked == method:
            raise error
        return solve(problem, asked, **rest)

    monkeypatch.setattr(checking, "solve", failing)
    return cross_check(first())


def test_a_road_that_fails_is_listed(monkeypatch):
    found = planted(monkeypatch, LinearProgramming(), SolverError("no backend"))
    assert (found.agrees, found.failed) == (True, ("lp",))
    assert found.methods[0].note == "failed: no backend"


@pytest.mark.parametrize(("above", "named"), [(1e-3, ("game",)), (5e-10, ())])
def test_infeasible_for_one_road_alone(monkeypatch, above, named):
    """A disagreement, except within rounding of the least failure."""
    least = {"least_failure": 0.0, "least_discounted_failure": 0.05 + above}
    found = planted(monkeypatch, Game(), InfeasibleError("no", failure_budget=0.05, **least))
    assert (found.disagreeing, found.failed) == (named, ("game",))
    assert found.methods[2].note == "infeasible: no"


def test_what_is_infeasible_for_all_or_asked_wrongly_is_raised():
    with pytest.raises(InfeasibleError) as caught:
        cross_check(first(budget=0.005))
    assert caught.value.least_discounted_failure == pytest.approx(0.01099)
    for wrong in ({"tolerance": 0.0}, {"weight_tolerance": 2.0}):
        refused("toler", cross_check, first(), **wrong)


@pytest.mark.parametrize("name", METHODS)
def test_an_answer_to_another_budget_is_named(name):
    """With a smaller one it keeps to ours, but costs more: it is outvoted."""
    found = judged(**{name: answer(name, 0.04)})
    assert found.disagreeing == (name,)
    assert found.objective_distance > 1e-2
    assert found.summary().splitlines()[-1].startswith(f"DISAGREEMENT of {name}: ")
    found = judged(**{name: answer(name, 0.06)})
    assert found.disagreeing == (name,)
    assert found.budget_overrun == pytest.approx(0.01)


def test_a_policy_that_does_not_attain_what_is_stated_is_named():
    solution = solve(first(), "columns")
    safe = solution.policy.policies[int(np.argmax(solution.policy.weights))]
    wrong = replace(solution, policy=MixedPolicy((safe,), np.ones(1)))
    found = judged(columns=result_of("columns", wrong))
    assert found.disagreeing == ("columns",)
    assert found.evaluated_distance > 1e-2


def test_two_roads_that_differ_are_both_named():
    rows = [answer("lp"), answer("columns")]
    assert compare_methods(rows, first()).agrees
    found = compare_methods([rows[0], answer("columns", 0.04)], first())
    assert set(found.disagreeing) == {"lp", "columns"}


def test_several_prices_at_a_kink_are_no_disagreement():
    """At a kink each price with a bound that meets c* is optimal."""
    found = judged(game={"failure_price": 90.0})
    assert (found.agrees, found.remarks) == (True, ("several prices are optimal",))
    assert found.weight_distance == pytest.approx(0.1, abs=2e-3)


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("lp", {"lower_bound": 7.0}),
        ("game", {"failure_price": 90.0, "lower_bound": 6.0}),
        ("game", {"objective": float("nan")}),
    ],
    ids=["a bound above what is attained", "a price that no bound proves", "no number"],
)
def test_what_cannot_be_true_is_named(name, changed):
    found = judged(**{name: changed})
    assert found.disagreeing == (name,)
    assert name == "game" or "one of the two is wrong" in found.remarks[0]


def least_failure(problem):
    """The least discounted failure."""
    return problem.compile().least_failure().column.failure


def check_agreement(problem):
    """No disagreement; the solutions."""
    solutions = {name: solve(problem, name) for name in METHODS}
    found = compare_methods([result_of(name, s) for name, s in solutions.items()], problem)
    assert found.agrees, found.summary()
    return solutions, found


def check_roads(problem):
    """No disagreement, and the game's own proof holds."""
    solutions, found = check_agreement(problem)
    assert found.objective_distance <= 1e-7
    game = solutions["game"]
    certificate = certify(game)
    assert certificate.accepted, certificate.reason
    assert max(certificate.gap, game.gap) <= 1e-8
    objective = evaluate(game.policy, problem).objective
    assert objective == pytest.approx(game.objective, rel=1e-9, abs=1e-12)


def check_infeasible(problem):
    """Every method says so, with the same least failure."""
    least = []
    for name in METHODS:
        with pytest.raises(InfeasibleError) as caught:
            solve(problem, name)
        least.append(caught.value.least_discounted_failure)
    assert max(least) - min(least) <= 1e-9


def check_at(criterion, model, start, discount, share, **meaning):
    """At a share of the way from the least discounted failure to 1."""
    loose = criterion(model, start, failure_budget=1.0, discount=discount, **meaning)
    least = least_failure(loose)
    if criterion is S3P and least >= 1.0 - 1e-12:
        check_infeasible(loose)
    else:
        check_roads(replace(loose, failure_budget=min(least + share * (1.0 - least), 1.0)))


@pytest.mark.slow
@often(45)
@given(problems(), semantics, discounts, shares)
def test_three_roads_agree_on_mcmp(drawn, meaning, discount, share):
    """Ties, free cycles, sure failure, every semantics, starts on goals and dead-ends."""
    check_at(MCMP, library_model(drawn), drawn.start, discount, share, **meaning)


layered = [problems(most_live=3, attention=True), acyclic_problems(), problems(most_live=3)]
"""Every live state can wait; every run ends; cycles, where what follows beyond M matters."""


@pytest.mark.slow
@pytest.mark.parametrize("drawing", layered, ids=["waiting", "acyclic", "cycles"])
@often(26)
@given(data=st.data(), discount=discounts, share=shares)
def test_three_roads_agree_on_s3p(drawing, data, discount, share):
    drawn = data.draw(drawing)
    check_at(S3P, library_model(drawn), drawn.start, discount, share)


@pytest.mark.slow
@often(13)
@given(problems(), discounts, st.sampled_from([0.5, 0.9, 0.999]), st.sampled_from([MCMP, S3P]))
def test_three_roads_agree_that_nothing_is_feasible(drawn, discount, part, criterion):
    """A budget clearly below the least discounted failure."""
    loose = criterion(library_model(drawn), drawn.start, failure_budget=1.0, discount=discount)
    least = least_failure(loose)
    if least > 1e-6:
        check_infeasible(replace(loose, failure_budget=part * least))


@pytest.mark.slow
@often(13)
@given(problems(most_live=3), discounts, st.sampled_from([MCMP, S3P]))
def test_three_roads_agree_at_the_least_failure(drawn, discount, criterion):
    """The budget equal to the least discounted failure: the cheapest policy of least failure."""
    loose = criterion(library_model(drawn), drawn.start, failure_budget=1.0, discount=discount)
    least = least_failure(loose)
    if 0.0 < least < 1.0 - 1e-12:
        solutions, _ = check_agreement(replace(loose, failure_budget=least))
        assert certify(solutions["game"]).accepted


def walk(cost=1.0, wait=None, slip=0.1):
    """A corridor of three cells with a risky short cut; `wait` adds free or paid waiting."""
    choices = {"wreck": {}}
    for state, ahead in {"a": "b", "b": "c", "c": "home"}.items():
        choices[state] = {
            "step": [(0.5, ahead, cost), (0.5, state, cost)],
            "jump": [(1.0 - slip, "home", cost), (slip, "wreck", cost)],
        }
        if wait is not None:
            choices[state]["wait"] = [(1.0, state, wait)]
    return model_of(choices, "home")


@pytest.mark.parametrize("give_up", ["anywhere", "dead_ends"])
def test_a_slow_loop_takes_few_sweeps(give_up):
    """Improving the greedy policy by its own values spares the 1 / (1 - gamma) sweeps."""
    crawl, dash = [(1e-5, "g", 3.0), (1.0 - 1e-5, "a", 0.0)], [(0.5, "g", 1.0), (0.5, "d", 0.0)]
    model = model_of({"a": {"crawl": crawl, "dash": dash}, "d": {}})
    problem = MCMP(model, "a", failure_budget=0.3, discount=0.999999, give_up=give_up)
    game = solve(problem, "game")
    assert game.gap <= 1e-9
    assert game.run.work.backups <= 5_000
    check_roads(problem)


def test_free_steps_within_a_layer_take_no_time():
    """The choice of the layer after it is improved, no iteration begins at 0."""
    rng, choices = np.random.default_rng(5), {"wreck": {}}
    for i in range(20):
        moves = [f"s{int(j)}" for j in rng.integers(0, 20, 4)]
        choices[f"s{i}"] = {
            "free": [(0.5, moves[0], 0.0), (0.5, moves[1], 0.0)],
            "paid": [(0.5, moves[2], 1.0), (0.5, moves[3], 0.0)],
            "end": [(0.4, "home", 3.0), (0.6, "wreck" if i % 3 else moves[0], 1.0)],
        }
    problem = S3P(model_of(choices, "home"), "s0", failure_budget=0.4, discount=0.999)
    began = time.process_time()
    check_roads(problem)
    assert time.process_time() - began <= 5.0


ALMOST_ONE = {"a": 0.1, "b": 0.2, "c": 0.7}
FREE = MCMP(walk(cost=0.0, wait=0.0), "a", failure_budget=0.5, discount=0.9, give_up="anywhere")
EDGES = [
    S3P(walk(wait=wait, slip=slip), "a", failure_budget=1.0, discount=discount)
    for discount, wait, slip in product([0.5, 0.9, 0.999], [None, 0, 1], [0.1, 0.3, 1 / 3, 0.82])
]
EDGES += [MCMP(walk(), ALMOST_ONE, failure_budget=0.2, discount=0.99), FREE]
"""Slack budgets in case S: sure failure counts 0 in the bound of the least ratio, at budget 1 too.
0.1 + 0.2 + 0.7 < 1 in floating point, and no mass lies on goals. c* = 0: the game has no stake."""


@pytest.mark.parametrize("problem", EDGES)
def test_three_roads_agree_at_the_edges(problem):
    check_roads(problem)
    assert problem is not FREE or solve(problem, "game").objective == 0.0


def test_a_bracket_that_rounding_holds_open_is_left():
    """Just above the least failure the price is steep; the games do not repeat themselves."""
    choices = {
        "safe": [(0.9, "home", 2.0), (0.1, "wreck", 0.0)],
        "near": [(0.9 - 2e-7, "home", 1.0), (0.1 + 2e-7, "wreck", 0.0)],
        "rash": [(0.1, "home", 0.0), (0.9, "wreck", 0.0)],
    }
    model = model_of({"a": choices, "wreck": {}}, "home")
    loose = MCMP(model, "a", failure_budget=1.0, discount=0.9)
    problem = replace(loose, failure_budget=least_failure(loose) + 4e-10)
    assert solve(problem, "game", tolerance=1e-13).run.pricing_calls <= 40
    check_agreement(problem)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_least_failure_at_any_unit_of_cost(scale, criterion):
    """Steep prices are multiples of what the goal costs."""
    model = walk(cost=scale, wait=scale, slip=0.05)
    loose = criterion(model, "a", failure_budget=1.0, discount=0.9)
    check_roads(replace(loose, failure_budget=least_failure(loose)))


# The comparison by hand: answers that are given by their numbers alone.


def stated(objective, low=None, attained=None, failure=0.05, weight=0.5, gap=0.125):
    """An answer of these numbers; its bound and its policy attain the optimum unless said."""
    evaluation = SimpleNamespace(
        objective=objective if attained is None else attained, limited_failure=failure
    )
    return SimpleNamespace(
        objective=objective, lower_bound=objective if low is None else low,
        evaluation=evaluation, adversary_weight=weight, gap=gap,
    )  # fmt: skip


def compared(*answers, problem=None, **tolerances):
    """The comparison of methods "a", "b", ... with these answers or errors."""
    rows = [
        MethodResult(name, None, "failed", one)
        if isinstance(one, Exception)
        else MethodResult(name, one)
        for name, one in zip("abcd", answers, strict=False)
    ]
    return compare_methods(rows, problem or first(), **tolerances)


def test_distances_are_relative_to_the_greater_cost():
    """1 of 11, and of 1e-12 of the greatest step where costs are less than that (9 here)."""
    found = compared(stated(10.0), stated(11.0, attained=11.0), stated(10.5))
    assert found.objective_distance == pytest.approx(1 / 11)
    assert found.evaluated_distance == pytest.approx(1 / 11)
    assert found.disagreeing == ("a", "b", "c")
    tiny = compared(stated(0.0), stated(9e-19))
    assert tiny.objective_distance == pytest.approx(1e-7, rel=1e-12)
    assert tiny.agrees
    assert not compared(stated(0.0), stated(9e-17)).agrees
    assert compared(stated(-8.0), stated(-8.0)).objective_distance == 0.0
    assert compared(stated(-8.0), stated(-10.0)).objective_distance == pytest.approx(0.2)
    assert compared(stated(8.0)).objective_distance == 0.0
    assert compared(stated(-10.0), stated(-8.0)).objective_distance == pytest.approx(0.2)
    for pair in ((8.0, float("nan")), (float("nan"), 8.0)):
        assert compared(*map(stated, pair)).objective_distance == float("inf")
    cheap = MCMP(model_of({"a": {"go": [(1.0, "g", 1e-6)]}}), "a", failure_budget=0.5)
    assert compared(stated(0.0), stated(1e-19), problem=cheap).objective_distance == pytest.approx(
        0.1
    )


@pytest.mark.parametrize("tolerance", [1e-6, 1e-3])
def test_costs_agree_up_to_the_tolerance(tolerance):
    for factor, agrees in ((1 + 0.9 * tolerance, True), (1 + 1.1 * tolerance, False)):
        found = compared(stated(8.0), stated(8.0 * factor, low=8.0), tolerance=tolerance)
        assert found.agrees is agrees
        assert found.disagreeing == (() if agrees else ("a", "b"))


def test_the_one_outside_of_the_majority_is_named():
    found = compared(stated(8.0), stated(9.0, low=8.0), stated(8.0))
    assert found.remarks == ("b: its c* differs from that of a, c",)
    all_apart = compared(stated(8.0, low=6.0), stated(9.0, low=8.0), stated(7.0, low=6.0))
    assert all_apart.disagreeing == ("a", "b", "c")
    assert "exceeds the 7 that the policy of c attains" in all_apart.remarks[1]
    assert "no other method finds its c*" in all_apart.remarks[0]


def test_a_policy_beyond_the_budget_is_named_before_all_else():
    """By what a budget may lie below the least failure, 1e-10, nothing is said."""
    for beyond, named in ((0.5 * LEAST_BUDGET, ()), (2.0 * LEAST_BUDGET, ("b",))):
        found = compared(stated(8.0), stated(8.0, failure=0.05 + beyond), stated(8.0))
        assert found.disagreeing == named
        assert found.budget_overrun == pytest.approx(beyond if named else 0.0, rel=1e-5)
    worst = compared(stated(8.0, failure=0.3), stated(7.0, failure=0.1), stated(8.0))
    assert worst.disagreeing == ("a", "b")
    assert worst.budget_overrun == pytest.approx(0.25)
    assert "breaks the budget by 2.5e-01" in worst.remarks[0]
    free = compared(stated(8.0, failure=0.9), problem=first(budget=None, discount=None))
    assert (free.agrees, free.budget_overrun) == (True, 0.0)


def test_a_policy_that_attains_another_cost_is_named():
    found = compared(stated(8.0), stated(8.0, attained=9.0), stated(8.0))
    assert found.remarks == ("b: it states c* = 8, but its policy attains 9",)
    assert found.evaluated_distance == pytest.approx(1 / 9)


def test_prices_that_differ_must_be_proved():
    """A bound that meets c* proves its price; weights within the tolerance need no proof."""
    apart = stated(8.0, weight=0.6)
    assert compared(stated(8.0), apart).remarks == ("several prices are optimal",)
    assert compared(stated(8.0), apart).weight_distance == pytest.approx(0.1)
    unproved = stated(8.0, weight=0.6, low=7.0)
    found = compared(stated(8.0), unproved, stated(8.0))
    assert found.remarks == ("b: its price is not proved: the bound misses c* by 1.2e-01",)
    for distance, named in ((0.9e-4, ()), (1.1e-4, ("b",))):
        by_default = compared(stated(8.0), stated(8.0, weight=0.5 + distance, low=7.0))
        assert by_default.disagreeing == named
    near = compared(stated(8.0), stated(8.0, weight=0.6, low=7.0), weight_tolerance=0.2)
    assert (near.agrees, near.remarks) == (True, ())
    unknown = compared(stated(8.0), stated(8.0, weight=None), stated(8.0, weight=None, low=7.0))
    assert (unknown.agrees, unknown.weight_distance, unknown.remarks) == (True, 0.0, ())


def test_a_bound_above_what_is_attained_is_named():
    """A bound that passes an attained cost by rounding is none."""
    found = compared(stated(8.0, low=8.0 * (1 + 1e-4)), stated(8.0), stated(8.0))
    assert found.disagreeing == ("a",)
    assert "its lower bound 8.0008 exceeds the 8 that the policy of " in found.remarks[0]
    assert compared(stated(8.0, low=8.0 * (1 + 1e-7)), stated(8.0)).agrees


@pytest.mark.parametrize(
    ("least", "discounted", "named"),
    [
        (0.0, 0.05 + 2e-9, True), (0.0, 0.05 + 0.5e-9, False), (0.05 + 2e-9, None, True),
        (0.05 + 0.5e-9, None, False), (0.9, 0.0, False), (None, None, False),
    ],
)  # fmt: skip
def test_who_calls_infeasible_what_another_one_solves(least, discounted, named):
    """By the failure that the budget limits, and not within 1e-9 of it."""
    error = InfeasibleError(
        "no", failure_budget=0.05, least_failure=least, least_discounted_failure=discounted
    )
    found = compared(stated(8.0), error)
    assert found.disagreeing == (("b",) if named else ())
    assert found.failed == ("b",)
    assert compared(error, error).disagreeing == ()


def test_what_a_comparison_shows():
    lone = compared(stated(8.0), SolverError("x"))
    assert repr(lone) == "CrossCheck(a, b: nothing to compare: fewer than two answers)"
    both = repr(compared(stated(8.0), stated(8.0)))
    assert both.startswith("CrossCheck(a, b: 2 methods agree: c* within 0.0e+00, alpha* within")
    assert "DISAGREEMENT of a, b: " in repr(compared(stated(8.0), stated(9.0, low=8.0)))
    row = MethodResult("lp", note="not run", seconds=0.5)
    assert row.members.shape == (0, 3)
    assert row.objective is None
    found = compare_methods([row, answer("columns")], first())
    (table,) = found.tables()
    assert table.rows[0] == ("lp", *[None] * 9, 0.5)
    assert table.rows[1][:3] == ("columns", answer("columns").answer.objective,
                                 answer("columns").answer.lower_bound)  # fmt: skip
    assert len(table.rows[1]) == len(table.columns)
    assert "lp: not run" in table.notes
    assert sum(note.startswith("columns: ") and " x (" in note for note in table.notes) == 1
    apart = compare_methods([answer("columns"), answer("lp", 0.04)], first())
    read = replace(apart, reading=SecondReading(1, 2, 3, ("a fault",)))
    notes = read.tables()[0].notes
    assert {*apart.remarks} < {*notes}
    assert [note for note in notes if "read twice" in note or note == "a fault"] == [
        "read twice: 1 dead-ends, 2 states to give up in, 3 where wandering is free", "a fault"
    ]  # fmt: skip


def test_members_of_case_s_count_their_cost_with_their_success():
    """The safe road alone: 9 of E[cost; goal] = 0.99 * 9, and a failure of 1 - 0.999 * 0.99."""
    problem = first(S3P, budget=0.5, discount=0.9)
    weights, costs, failures = result_of("columns", solve(problem)).members.T
    assert weights @ costs / (1.0 - weights @ failures) == pytest.approx(solve(problem).objective)
    sure = model_of({"x": {"lost": [(1.0, "d", 1.0)], "go": [(0.5, "g", 2.0), (0.5, "d", 3.0)]},
                     "d": {}})  # fmt: skip
    lost, go = (DeterministicPolicy.from_actions(sure, {"x": name}) for name in ("lost", "go"))
    problem = S3P(sure, "x", failure_budget=1.0)
    mixed = replace(solve(problem), policy=MixedPolicy((lost, go), np.array([0.25, 0.75])))
    assert result_of("columns", mixed).members == pytest.approx(
        np.array([[0.25, 0.0, 1.0], [0.75, 1.0, 0.5]])
    )


def test_a_model_at_fault_is_no_result_of_a_method(monkeypatch):
    """The game's own limits are noted, what others refuse is raised; laws are not compared."""
    failing = ModelError("too many states")
    assert planted(monkeypatch, Game(), failing).methods[2].note == "failed: too many states"
    with pytest.raises(ModelError, match="too many states"):
        planted(monkeypatch, LinearProgramming(), failing)
    limits = {"c": expected_cost() <= 9.0}
    for problem in (CVaR(FIRST, "depot", 0.9, 0.05), MCMP(FIRST, "depot", 0.5, constraints=limits)):
        refused("cross_check supports expected costs with a failure budget alone", cross_check,
                problem)  # fmt: skip


def test_a_method_is_timed_and_given_its_time(monkeypatch):
    given, clock, known = [], iter([3.0, 5.5]), answer("lp").answer
    monkeypatch.setattr(checking.time, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(
        checking, "solve", lambda p, m, time_limit: given.append((m, time_limit)) or known
    )
    found = result_by("lp", first(), "highs", time_limit=7.0)
    assert (found.seconds, given) == (2.5, [(LinearProgramming("highs"), 7.0)])


def test_a_loop_that_costs_is_no_free_waiting():
    """In x one may stay for 4 a step, in y for nothing: both readings count y alone."""
    ways = {
        "x": {"stay": [(1.0, "x", 4.0)], "go": [(0.5, "y", 1.0), (0.5, "d", 1.0)]},
        "y": {"rest": [(1.0, "y", 0.0)], "go": [(1.0, "g", 1.0)]},
        "d": {},
    }
    found = checking.second_reading(MCMP(model_of(ways), "x", failure_budget=0.7))
    assert (found.dead_ends, found.free, found.faults) == (1, 1, ())
