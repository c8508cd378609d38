"""The best single deterministic policy: enumeration, closed forms, honest gaps."""

import pytest
from hypothesis import given

from checks import CLOSE, budget_of, library_model, plain
from formulations import MCMP, S3P, MaxProb
from references import mcmp, s3p
from references.chain import plain_model
from references.frontier import Point, least_failure
from small_models import model_of
from ssp_lp import (
    SSP,
    ColumnGeneration,
    DeterministicPolicies,
    InfeasibleError,
    LinearProgramming,
    ModelError,
    Status,
    certify,
    evaluate,
    solve,
)
from strategies import acyclic_problems, budgets, discounts, often, problems, semantics
from written_models import table, written

TWO_ROADS = written("road fast: 0.9 g 1, 0.1 ditch 1\n road safe: g 3")
THREE_BRIDGES = table(
    """
    a run: 0.9 b 1, 0.1 river 1
    a walk: b 4
    b run: 0.8 c 1, 0.2 river 1
    b walk: c 4
    c run: 0.7 g 1, 0.3 river 1
    c walk: g 4
    """
) | {"river": {}}
"""Three decisions in a row: eight policies."""

LOOP = table(
    """
    a try: 0.1 b 1, 0.9 a 1
    a jump: 0.9 b 1, 0.1 pit 1
    b try: 0.1 g 1, 0.9 a 1
    b jump: 0.8 g 1, 0.2 pit 1
    """
) | {"pit": {}}
"""States that are visited again and again: geometric runs beside a risky short cut."""

CORRIDORS = {
    k: {
        "left": [(0.95, k - 1 if k else "g", 1.0), (0.05, "pit", 1.0)],
        "right": [(1.0, k + 1 if k < 5 else "g", 3.0)],
    }
    for k in range(6)
} | {"pit": {}}
"""Each of two corridors leads to the other: half of either policy never leaves."""


def bridges():
    return MCMP(model_of(THREE_BRIDGES), start="a", failure_budget=0.15)


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
    assert solution.method == "deterministic"
    is_slack = mixed.failure_price == 0.0 and len(mixed.policy.policies) == 1
    assert solution.failure_price == (0.0 if is_slack else None)
    assert "deterministic: the mixed optimum is" in solution.note


def outside_the_search(solution):
    """Whether the solution says that a gap is left by policies that are not searched."""
    return "outside the search" in solution.note


def check_drawn(problem, points, *, all_searched=True, room=1e-8, **options):
    """The enumerated best lies between the bound and the answer, and where the gap closes is it."""
    least, budget = least_failure(points), problem.failure_budget
    hopeless = isinstance(problem, S3P) and least >= 1 - 1e-12
    if least > budget + 1e-10 or hopeless:
        with pytest.raises(InfeasibleError):
            solve(problem, method="deterministic")
        return
    best = min(p.cost for p in points if p.failure <= budget + 1e-10)
    strict = min((p.cost for p in points if p.failure <= budget - 1e-10), default=float("inf"))
    solution = solve(problem, method="deterministic", **options)
    check_single(solution, solve(problem), max(budget, least))
    room *= 1 + best
    assert solution.lower_bound <= strict + room
    if not all_searched:
        return
    assert solution.objective >= best - room
    if not outside_the_search(solution):
        assert solution.objective <= strict + room
        assert solution.objective - solution.lower_bound <= room


def ratios(points):
    """Failure and cost given success."""
    return [Point(p.failure, p.cost / (1 - p.failure)) for p in points if p.failure < 1 - 1e-12] + [
        p._replace(cost=float("inf")) for p in points if p.failure >= 1 - 1e-12
    ]


@pytest.mark.slow
@often(40)
@given(problems(), semantics, discounts, budgets)
def test_mcmp_against_all_deterministic_policies(drawn, meaning, discount, place):
    points = mcmp.points(plain(drawn), drawn.start, discount=discount, **meaning)
    budget = budget_of(place, points)
    check_drawn(MCMP(library_model(drawn), drawn.start, budget, discount, **meaning), points)


@pytest.mark.slow
@often(13)
@given(acyclic_problems(most_live=2, most_actions=2), discounts, budgets)
def test_s3p_against_all_policies_of_state_and_cost(drawn, discount, place):
    """Acyclic models: the product with accumulated cost is finite."""
    points = s3p.product_points(plain(drawn), drawn.start, 12, discount)
    problem = S3P(library_model(drawn), drawn.start, budget_of(place, points), discount)
    check_drawn(problem, ratios(points), room=1e-7)


@pytest.mark.slow
@often(20)
@given(problems(most_live=3), discounts, budgets)
def test_s3p_with_cycles_has_honest_bounds(drawn, discount, place):
    """Policies that look at states only are among those that count: the bound is below them."""
    points = s3p.stationary_points(plain(drawn), drawn.start, discount)
    problem = S3P(library_model(drawn), drawn.start, budget_of(place, points), discount)
    check_drawn(problem, ratios(points), all_searched=False, room=1e-7, time_limit=60.0)


@pytest.mark.parametrize(
    ("choices", "start", "budget"),
    [
        *((THREE_BRIDGES, "a", budget) for budget in (0.05, 0.1, 0.15, 0.28, 0.3, 0.45)),
        (LOOP, "a", 0.25),
        *((CORRIDORS, s, budget) for s in range(6) for budget in (0.03, 0.08, 0.12, 0.2)),
    ],
)
def test_decisions_that_are_enumerated(choices, start, budget):
    meaning = {"give_up": "dead_ends", "charge_failing_step": False}
    points = mcmp.points(plain_model(choices, {"g"}), start, **meaning)
    best = min(cost for failure, cost in points if failure <= budget + 1e-12)
    problem = MCMP(model_of(choices), start, budget, **meaning)
    solution = solve(problem, method="deterministic")
    assert solution.gap <= 1e-7
    assert solution.objective == pytest.approx(best, rel=1e-8)


ALLEY_OR_ROAD = written(
    """
    depot alley: 0.90 home 4, 0.10 wreck 2
    depot road: 0.99 home 9, 0.01 wreck 5
    """,
    goal="home",
)


@pytest.mark.parametrize("relaxation", [ColumnGeneration(), LinearProgramming()])
@pytest.mark.parametrize(("formulation", "road"), [(MCMP, 0.99 * 9 + 0.01 * 5), (S3P, 9.0)])
def test_the_best_of_two_policies_is_proved_by_their_values(formulation, road, relaxation):
    """The alley fails with 0.1, the road with 0.01: only the road keeps to 0.05.

    The certificate is that of lotteries, whose price and values it works out itself.
    """
    problem = formulation(ALLEY_OR_ROAD, "depot", failure_budget=0.05)
    single, mixed = solve(problem, DeterministicPolicies(relaxation)), solve(problem)
    assert single.objective == pytest.approx(road, rel=1e-15)
    assert single.gap <= 1e-9
    assert single.status is Status.OPTIMAL
    assert single.method == "deterministic"
    assert single.failure_price is single.budget_slope is single.adversary_weight is None
    assert "failure price" not in single.summary()
    certificate = certify(single)
    assert certificate.accepted
    assert certificate.lower_bound == pytest.approx(mixed.objective, rel=1e-12)


def test_equally_good_policies_are_proved_by_their_values_one_by_one():
    """Three forks without a difference: eight best policies beside the risky one."""
    forks = {f"f{k}": {a: [(1.0, f"f{k + 1}", 1.0)] for a in "lr"} for k in range(3)}
    risky = {"f0": {"risk": [(0.5, "g", 0.5), (0.5, "pit", 0.5)], **forks["f0"]}}
    end = {"f3": {"on": [(1.0, "g", 1.0)]}, "pit": {}}
    solution = solve(
        MCMP(model_of(forks | risky | end), "f0", failure_budget=0.25), method="deterministic"
    )
    assert solution.objective == pytest.approx(4.0, rel=1e-15)
    assert solution.gap <= 1e-9


@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_ways_out_of_a_free_cycle_that_depend_on_the_way_in(formulation):
    """From b walk, from a run: the best policy, 3.5 in case M, is not searched but counted."""
    model = written(
        """
        s go: 0.5 a 1, 0.5 b 1
        a swap: b 0
        a run: 0.9 g 1, 0.1 pit 1
        b swap: a 0
        b walk: g 4
        """
    )
    problem = formulation(model, start="s", failure_budget=0.06)
    solution = solve(problem, method="deterministic")
    check_single(solution, solve(problem), 0.06)
    best = 3.5 if formulation is MCMP else (0.5 * 5 + 0.45 * 2) / 0.95
    assert solution.lower_bound <= best <= solution.objective
    assert outside_the_search(solution)
    assert "costs at most" in solution.note


@pytest.mark.parametrize("formulation", [MCMP, S3P])
@pytest.mark.parametrize("relaxation", [ColumnGeneration(), LinearProgramming()])
def test_a_budget_between_two_policies_buys_the_safer_one(formulation, relaxation):
    problem = formulation(TWO_ROADS, start="road", failure_budget=0.05)
    solution = solve(problem, DeterministicPolicies(relaxation))
    assert solution.objective == pytest.approx(3.0, abs=1e-12)
    assert solution.budget_used == 0.0
    assert solution.gap <= 1e-8
    check_single(solution, solve(problem), 0.05)


def test_no_time_gives_the_safest_member_and_an_honest_gap():
    solution = solve(bridges(), method="deterministic", time_limit=1e-9)
    assert solution.objective >= solve(bridges(), method="deterministic").objective - 1e-12
    assert solution.lower_bound <= solve(bridges()).objective + 1e-12
    assert solution.gap > 0.0
    assert "stopped" in solution.note
    assert solution.budget_used <= 0.15


@pytest.mark.parametrize("tolerance", [0.5, 0.1, 1e-3])
def test_a_tolerance_ends_the_search_early(tolerance):
    best = solve(bridges(), method="deterministic").objective
    solution = solve(bridges(), method="deterministic", tolerance=tolerance)
    assert solution.gap <= tolerance * 1.001 + 1e-8
    assert best - 1e-9 <= solution.objective <= best * (1 + 2 * tolerance)


def test_problems_whose_optimum_is_one_policy_are_left_alone():
    for problem in (MCMP(TWO_ROADS, start="road"), MaxProb(TWO_ROADS, start="road")):
        single = solve(problem, method="deterministic")
        assert single.objective == solve(problem).objective
        assert len(single.policy.policies) == 1


def test_arguments():
    with pytest.raises(ModelError, match="method must be one of"):
        solve(bridges(), method="pure")
    infeasible = written("road fast: 0.9 g 1, 0.1 ditch 1")
    with pytest.raises(InfeasibleError):
        solve(MCMP(infeasible, start="road", failure_budget=0.05), method="deterministic")


def test_the_bound_of_a_hopeless_part_passes_the_best_policy_clearly():
    """Steps that hardly end make prices of 1e7: the gap was 1e-7."""
    moves = {
        "s0": {
            "u0": [(0.99, "s0", 3.14159265), (0.01, "pit", 3.14159265)],
            "u1": [(0.5, "s2", 1.414213), (0.5, "s1", 0.123456)],
        },
        "s1": {"u0": [(0.99, "s1", 0.123456), (0.01, "s1", 0.123456)]},
        "s2": {"u0": [(0.9, "s3", 0.123456), (0.1, "s2", 3.14159265)]},
        "s3": {"u0": [(0.001, "g", 3.14159265), (0.999, "pit", 1.414213)]},
        "pit": {},
    }
    model = SSP.from_transitions(moves, {"g"}, dead_ends={"pit"})
    problem = MCMP(model, "s0", 0.99975, give_up="attention", charge_failing_step=False)
    assert solve(problem, method="deterministic").gap <= 1e-9
