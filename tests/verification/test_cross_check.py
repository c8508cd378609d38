"""The comparison of the methods: who is named, and for what."""

from dataclasses import replace

import numpy as np
import pytest

from formulations import MCMP, S3P
from small_models import FIRST
from ssp_lp import (
    SSP,
    CrossCheck,
    Game,
    InfeasibleError,
    LinearProgramming,
    MixedPolicy,
    ModelError,
    cross_check,
    solve,
)
from ssp_lp.errors import SolverError
from ssp_lp.verification import cross_check as checking
from ssp_lp.verification.cross_check import METHODS, compare_methods, result_of

PROBLEM = MCMP(FIRST, start="depot", failure_budget=0.05, discount=0.999)


def results():
    """The rows of the three methods."""
    return {name: result_of(name, solve(PROBLEM, name)) for name in METHODS}


def judged(**changed):
    """Compare the rows with some fields of some methods changed."""
    rows = results()
    rows |= {name: replace(rows[name], **fields) for name, fields in changed.items()}
    return compare_methods(list(rows.values()), PROBLEM)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_three_roads_agree(criterion):
    problem = criterion(FIRST, start="depot", failure_budget=0.05, discount=0.999)
    found = cross_check(problem)
    assert isinstance(found, CrossCheck)
    assert found.agrees
    assert found.failed == ()
    assert [method.name for method in found.methods] == list(METHODS)
    assert all(method.answered for method in found.methods)
    assert max(found.objective_distance, found.evaluated_distance) <= 1e-9
    assert found.weight_distance <= 1e-9
    assert found.budget_overrun == 0.0
    for method in found.methods:
        assert sum(m.weight for m in method.members) == pytest.approx(1.0)
        spent = sum(m.weight * m.failure for m in method.members)
        cost = sum(m.weight * m.cost for m in method.members)
        assert spent == pytest.approx(0.05)
        assert cost / (1.0 - spent if problem.ratio else 1.0) == pytest.approx(method.objective)


def test_the_summary_is_an_aligned_table_with_a_verdict():
    text = cross_check(PROBLEM).summary()
    lines = text.splitlines()
    assert lines[0].split()[:3] == ["method", "c*", "lower"]
    assert len({len(line) for line in lines[:4]}) == 1
    assert lines[-1].startswith("3 methods agree: c* within ")


def test_an_exact_problem_has_two_results():
    found = cross_check(MCMP(FIRST, start="depot", failure_budget=0.05))
    assert found.agrees
    game = found.methods[2]
    assert not game.answered
    assert not game.failed
    assert game.note.startswith("not asked: the game needs a discount")
    assert found.summary().splitlines()[-1].startswith("2 methods agree")


def test_a_budget_of_zero_has_two_results():
    safe = SSP.from_transitions({"a": {"go": [(1.0, "home", 1.0)]}}, goal={"home"})
    found = cross_check(MCMP(safe, start="a", failure_budget=0.0))
    assert found.agrees
    assert [method.answered for method in found.methods] == [True, True, False]


def test_at_least_failure_there_is_one_road():
    found = cross_check(MCMP(FIRST, start="depot", failure_budget=None))
    assert [method.answered for method in found.methods] == [False, True, False]
    assert found.agrees
    assert found.summary().endswith("nothing to compare: one method answered")


def test_a_large_program_is_not_asked(monkeypatch):
    monkeypatch.setattr(checking, "MOST_COLUMNS", 1)
    found = cross_check(PROBLEM)
    assert found.methods[0].note.startswith("not asked: ")
    assert "columns are too many" in found.methods[0].note
    assert found.agrees
    assert cross_check(PROBLEM, lp_backend="highs").methods[0].answered


def test_a_cap_of_the_users_leaves_the_game_out():
    problem = S3P(FIRST, start="depot", failure_budget=0.05, discount=0.999, cost_cap=50.0)
    found = cross_check(problem)
    assert found.agrees
    assert found.methods[2].note == "not asked: the game chooses its own cap M: leave cost_cap out"


def test_a_road_that_fails_is_listed(monkeypatch):
    def failing(problem, method, **rest):
        if method == LinearProgramming():
            raise SolverError("no backend")
        return solve(problem, method, **rest)

    monkeypatch.setattr(checking, "solve", failing)
    found = cross_check(PROBLEM)
    assert found.failed == ("lp",)
    assert found.methods[0].note == "failed: no backend"
    assert found.agrees


def test_infeasible_for_all_is_raised():
    with pytest.raises(InfeasibleError) as caught:
        cross_check(MCMP(FIRST, start="depot", failure_budget=0.005, discount=0.999))
    assert caught.value.least_discounted_failure == pytest.approx(0.01099)


@pytest.mark.parametrize(("above", "named"), [(1e-3, ("game",)), (5e-10, ())])
def test_infeasible_for_one_road_alone(monkeypatch, above, named):
    """A disagreement, except within rounding of the least failure."""

    def refusing(problem, method, **rest):
        if method == Game():
            least = problem.failure_budget + above
            raise InfeasibleError(
                "no", failure_budget=0.05, least_failure=0.0, least_discounted_failure=least
            )
        return solve(problem, method, **rest)

    monkeypatch.setattr(checking, "solve", refusing)
    found = cross_check(PROBLEM)
    assert found.disagreeing == named
    assert found.failed == ("game",)
    assert found.methods[2].note == "infeasible: no"


@pytest.mark.parametrize("name", METHODS)
def test_another_optimum_is_outvoted(name):
    """One method solved a problem with a smaller budget: it keeps to ours, but costs more."""
    other = replace(PROBLEM, failure_budget=0.04)
    rows = results() | {name: result_of(name, solve(other, name))}
    found = compare_methods(list(rows.values()), PROBLEM)
    assert name in found.disagreeing
    assert set(found.disagreeing) == {name}
    assert found.objective_distance > 1e-2
    assert found.summary().splitlines()[-1].startswith(f"DISAGREEMENT of {name}: ")


@pytest.mark.parametrize("name", METHODS)
def test_a_policy_over_budget_is_named(name):
    """One method solved a problem with a larger budget."""
    other = solve(replace(PROBLEM, failure_budget=0.06), name)
    found = compare_methods(list((results() | {name: result_of(name, other)}).values()), PROBLEM)
    assert found.disagreeing == (name,)
    assert found.budget_overrun == pytest.approx(0.01)


def test_a_policy_that_does_not_attain_what_is_stated_is_named():
    solution = solve(PROBLEM, "columns")
    safe = int(np.argmax(solution.policy.weights))
    wrong = MixedPolicy((solution.policy.policies[safe],), np.ones(1))
    planted = replace(solution, policy=wrong)
    rows = results() | {"columns": result_of("columns", planted)}
    found = compare_methods(list(rows.values()), PROBLEM)
    assert found.disagreeing == ("columns",)
    assert found.evaluated_distance > 1e-2


def test_two_roads_that_differ_are_both_named():
    problem = MCMP(FIRST, start="depot", failure_budget=0.05)
    rows = [result_of(name, solve(problem, name)) for name in ("lp", "columns")]
    dearer = result_of("columns", solve(replace(problem, failure_budget=0.04)))
    found = compare_methods([rows[0], dearer], problem)
    assert set(found.disagreeing) == {"lp", "columns"}
    assert compare_methods(rows, problem).agrees


def test_a_bound_above_what_is_attained_is_named():
    found = judged(lp={"lower_bound": 7.0})
    assert found.disagreeing == ("lp",)
    assert "one of the two is wrong" in found.remarks[0]


def test_several_prices_at_a_kink_are_no_disagreement():
    """At a kink each price with a bound that meets c* is optimal."""
    found = judged(game={"adversary_weight": 0.6, "failure_price": 90.0})
    assert found.agrees
    assert found.remarks == ("several prices are optimal",)
    assert found.weight_distance == pytest.approx(0.1, abs=2e-3)


def test_a_price_that_no_bound_proves_is_named():
    bound = 0.9 * solve(PROBLEM).objective
    found = judged(game={"adversary_weight": 0.6, "lower_bound": bound, "gap": 0.1})
    assert found.disagreeing == ("game",)


def test_a_number_that_is_none_is_no_agreement():
    found = judged(game={"objective": float("nan")})
    assert found.disagreeing == ("game",)


@pytest.mark.parametrize("wrong", [{"tolerance": 0.0}, {"weight_tolerance": 2.0}])
def test_wrong_tolerances(wrong):
    with pytest.raises(ModelError):
        cross_check(PROBLEM, **wrong)
