"""The best single deterministic policy: enumeration, closed forms, honest gaps."""

import pytest
from hypothesis import given

from checks import CLOSE, budget_of, library_model, plain
from formulations import MCMP, S3P, MaxProb
from references import mcmp, s3p
from references.chain import plain_model
from references.frontier import least_failure
from small_models import model_of
from ssp_lp import (
    ColumnGeneration,
    DeterministicPolicies,
    InfeasibleError,
    LinearProgramming,
    ModelError,
    evaluate,
    solve,
)
from strategies import acyclic_problems, budgets, discounts, often, problems, semantics

TWO_ROADS = {
    "road": {
        "fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        "safe": [(1.0, "home", 3.0)],
    },
    "ditch": {},
}
"""One decision: fail with 1/10 at cost 1, or never at cost 3."""

THREE_BRIDGES = {
    f"bridge{k}": {
        "run": [(1.0 - share, f"bridge{k + 1}", 1.0), (share, "river", 1.0)],
        "walk": [(1.0, f"bridge{k + 1}", 4.0)],
    }
    for k, share in enumerate((0.1, 0.2, 0.3))
} | {"river": {}}
"""Three decisions in a row: eight policies."""


def check_single(solution, mixed, budget):
    """What holds for every answer: one member, within the budget, measured, bounds in order."""
    assert len(solution.policy.policies) == 1
    assert solution.budget_used <= budget + 1e-12
    measured = evaluate(solution.policy, solution.problem)
    assert measured.objective == pytest.approx(solution.objective, **CLOSE)
    failure = measured.failure_probability
    if measured.discounted_failure is not None:
        failure = measured.discounted_failure
    assert failure <= budget + 1e-12
    assert failure == pytest.approx(solution.budget_used, abs=1e-9)
    assert solution.lower_bound <= solution.objective
    assert solution.lower_bound >= mixed.lower_bound * (1 - 1e-12) - 1e-12
    assert solution.objective >= mixed.objective * (1 - 1e-9) - 1e-12
    assert solution.failure_price == pytest.approx(mixed.failure_price, **CLOSE)
    assert "deterministic: the mixed optimum is" in solution.note


def outside_the_search(solution):
    """Whether the solution says that a gap is left by policies that are not searched."""
    return "outside the search" in solution.note


@often(250)
@given(problems(), semantics, discounts, budgets)
def test_mcmp_against_all_deterministic_policies(drawn, meaning, discount, place):
    """The enumerated best lies between the bound and the answer, and where the gap closes is it."""
    points = mcmp.points(plain(drawn), drawn.start, discount=discount, **meaning)
    budget = budget_of(place, points)
    model = library_model(drawn)
    problem = MCMP(model, start=drawn.start, failure_budget=budget, discount=discount, **meaning)
    if least_failure(points) > budget + 1e-10:
        with pytest.raises(InfeasibleError):
            solve(problem, method="deterministic")
        return
    best = min(p.cost for p in points if p.failure <= budget + 1e-10)
    strict = min((p.cost for p in points if p.failure <= budget - 1e-10), default=float("inf"))
    solution, mixed = solve(problem, method="deterministic"), solve(problem)
    check_single(solution, mixed, max(budget, least_failure(points)))
    room = 1e-8 * (1 + best)
    assert solution.objective >= best - room
    assert solution.lower_bound <= strict + room
    if not outside_the_search(solution):
        assert solution.objective <= strict + room
        assert solution.objective - solution.lower_bound <= room


@often(40)
@given(acyclic_problems(most_live=2, most_actions=2), discounts, budgets)
def test_s3p_against_all_policies_of_state_and_cost(drawn, discount, place):
    """Acyclic models: the product with accumulated cost is finite."""
    points = s3p.product_points(plain(drawn), drawn.start, 12, discount)
    least = least_failure(points)
    budget = budget_of(place, points)
    problem = S3P(library_model(drawn), start=drawn.start, failure_budget=budget, discount=discount)
    if least > budget + 1e-10 or least >= 1 - 1e-12:
        with pytest.raises(InfeasibleError):
            solve(problem, method="deterministic")
        return
    solution, mixed = solve(problem, method="deterministic"), solve(problem)
    check_single(solution, mixed, max(budget, least))
    ratios = [(p.failure, p.cost / (1 - p.failure)) for p in points if p.failure < 1 - 1e-12]
    best = min(ratio for failure, ratio in ratios if failure <= budget + 1e-10)
    strict = min((r for failure, r in ratios if failure <= budget - 1e-10), default=float("inf"))
    room = 1e-7 * (1 + best)
    assert solution.objective >= best - room
    assert solution.lower_bound <= strict + room
    if not outside_the_search(solution):
        assert solution.objective <= strict + room
        assert solution.objective - solution.lower_bound <= room


@often(60)
@given(problems(most_live=3), discounts, budgets)
def test_s3p_with_cycles_has_honest_bounds(drawn, discount, place):
    """Policies that look at states only are among those that count: the bound is below them."""
    points = s3p.stationary_points(plain(drawn), drawn.start, discount)
    least = least_failure(points)
    budget = budget_of(place, points)
    if least > budget + 1e-10 or least >= 1 - 1e-12:
        return
    problem = S3P(library_model(drawn), start=drawn.start, failure_budget=budget, discount=discount)
    solution = solve(problem, method="deterministic", time_limit=5.0)
    check_single(solution, solve(problem), max(budget, least))
    ratios = [(p.failure, p.cost / (1 - p.failure)) for p in points if p.failure < 1 - 1e-12]
    strict = min((r for f, r in ratios if f <= budget - 1e-10), default=float("inf"))
    assert solution.lower_bound <= strict + 1e-7 * (1 + solution.lower_bound)


@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_ways_out_of_a_free_cycle_that_depend_on_the_way_in(formulation):
    """From b walk, from a run: the best policy, 3.5 in case M, is not searched but counted."""
    choices = {
        "s": {"go": [(0.5, "a", 1.0), (0.5, "b", 1.0)]},
        "a": {"swap": [(1.0, "b", 0.0)], "run": [(0.9, "home", 1.0), (0.1, "pit", 1.0)]},
        "b": {"swap": [(1.0, "a", 0.0)], "walk": [(1.0, "home", 4.0)]},
        "pit": {},
    }
    problem = formulation(model_of(choices, "home"), start="s", failure_budget=0.06)
    solution = solve(problem, method="deterministic")
    check_single(solution, solve(problem), 0.06)
    best = 3.5 if formulation is MCMP else (0.5 * 5 + 0.45 * 2) / 0.95
    assert solution.lower_bound <= best <= solution.objective
    assert outside_the_search(solution)
    assert "costs at most" in solution.note


@pytest.mark.parametrize("formulation", [MCMP, S3P])
@pytest.mark.parametrize("relaxation", [ColumnGeneration(), LinearProgramming()])
def test_a_budget_between_two_policies_buys_the_safer_one(formulation, relaxation):
    problem = formulation(model_of(TWO_ROADS, "home"), start="road", failure_budget=0.05)
    solution = solve(problem, DeterministicPolicies(relaxation))
    assert solution.objective == pytest.approx(3.0, abs=1e-12)
    assert solution.budget_used == 0.0
    assert solution.gap <= 1e-8
    check_single(solution, solve(problem), 0.05)


@pytest.mark.parametrize("budget", [0.05, 0.1, 0.15, 0.28, 0.3, 0.45])
def test_bridges(budget):
    """Running over some of three bridges: costs and failures by hand."""
    model = model_of(THREE_BRIDGES, "bridge3")
    problem = MCMP(model, start="bridge0", failure_budget=budget, charge_failing_step=False)
    best = min(cost for failure, cost in _bridges() if failure <= budget + 1e-12)
    assert best == pytest.approx(solve_single(problem), rel=1e-9)


def _bridges():
    """Failure and cost of the eight policies."""
    for mask in range(8):
        alive, cost = 1.0, 0.0
        for k, share in enumerate((0.1, 0.2, 0.3)):
            runs = bool(mask >> k & 1)
            cost += alive * (1.0 if runs else 4.0)
            alive *= 1.0 - share if runs else 1.0
        yield 1.0 - alive, cost


def solve_single(problem):
    solution = solve(problem, method="deterministic")
    assert solution.gap <= 1e-7
    return solution.objective


def test_a_loop_is_bounded_by_what_it_may_cost():
    """States that are visited again and again: geometric runs beside a risky short cut."""
    choices = {
        "a": {
            "try": [(0.1, "b", 1.0), (0.9, "a", 1.0)],
            "jump": [(0.9, "b", 1.0), (0.1, "pit", 1.0)],
        },
        "b": {
            "try": [(0.1, "home", 1.0), (0.9, "a", 1.0)],
            "jump": [(0.8, "home", 1.0), (0.2, "pit", 1.0)],
        },
        "pit": {},
    }
    problem = MCMP(model_of(choices, "home"), start="a", failure_budget=0.25)
    points = mcmp.points(plain_model(choices, {"home"}), "a")
    best = min(cost for failure, cost in points if failure <= 0.25)
    assert solve_single(problem) == pytest.approx(best, rel=1e-9)


def test_ways_between_two_policies_may_go_in_circles():
    """Each of two corridors leads to the other: half of either policy never leaves."""
    choices = {
        k: {
            "left": [(0.95, k - 1 if k else "home", 1.0), (0.05, "pit", 1.0)],
            "right": [(1.0, k + 1 if k < 5 else "home", 3.0)],
        }
        for k in range(6)
    } | {"pit": {}}
    for start in range(6):
        points = mcmp.points(plain_model(choices, {"home"}), start, give_up="dead_ends")
        for budget in (0.03, 0.08, 0.12, 0.2):
            problem = MCMP(
                model_of(choices, "home"), start=start, failure_budget=budget, give_up="dead_ends"
            )
            best = min(cost for failure, cost in points if failure <= budget)
            assert solve_single(problem) == pytest.approx(best, rel=1e-8)


def test_no_time_gives_the_safest_member_and_an_honest_gap():
    problem = MCMP(model_of(THREE_BRIDGES, "bridge3"), start="bridge0", failure_budget=0.15)
    mixed = solve(problem)
    solution = solve(problem, method="deterministic", time_limit=1e-9)
    best = solve(problem, method="deterministic")
    assert solution.objective >= best.objective - 1e-12
    assert solution.lower_bound <= mixed.objective + 1e-12
    assert solution.gap > 0.0
    assert "stopped" in solution.note
    assert solution.budget_used <= 0.15


@pytest.mark.parametrize("tolerance", [0.5, 0.1, 1e-3])
def test_a_tolerance_ends_the_search_early(tolerance):
    problem = MCMP(model_of(THREE_BRIDGES, "bridge3"), start="bridge0", failure_budget=0.15)
    best = solve(problem, method="deterministic").objective
    solution = solve(problem, method="deterministic", tolerance=tolerance)
    assert solution.gap <= tolerance * 1.001 + 1e-8
    assert best - 1e-9 <= solution.objective <= best * (1 + 2 * tolerance)


def test_problems_whose_optimum_is_one_policy_are_left_alone():
    model = model_of(TWO_ROADS, "home")
    for problem in (MCMP(model, start="road"), MaxProb(model, start="road")):
        plainly, single = solve(problem), solve(problem, method="deterministic")
        assert single.objective == plainly.objective
        assert len(single.policy.policies) == 1


def test_arguments():
    problem = MCMP(model_of(TWO_ROADS, "home"), start="road", failure_budget=0.05)
    with pytest.raises(ModelError, match="method must be one of"):
        solve(problem, method="pure")
    infeasible = MCMP(
        model_of({"road": {"fast": TWO_ROADS["road"]["fast"]}, "ditch": {}}, "home"),
        start="road",
        failure_budget=0.05,
    )
    with pytest.raises(InfeasibleError):
        solve(infeasible, method="deterministic")
