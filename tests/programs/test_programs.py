"""Occupation programs: their optimum, their columns, and policies that attain it."""

import gzip
import tracemalloc
from collections import deque

import cvxpy as cp
import highspy
import numpy as np
import pytest

from drawn_programs import (
    DEPOT,
    REENTERED,
    SLIP,
    TURNS,
    drawn,
    drawn_choices,
    measures_of,
    problems_of,
    with_room,
)
from examples.domains.river import river
from examples.domains.windy_field import windy_field
from formulations import MCMP, S3P, ConstrainedCost, CostLimit, CostQuantile, CVaR, MaxProb
from small_models import FREE_PAIR, model_of
from ssp_lp import (
    GIVE_UP,
    InfeasibleError,
    ModelError,
    SolverError,
    end_probability,
    evaluate,
    expected_cost,
    failure_probability,
    goal_probability,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.dynamic_programming import policy_iteration
from ssp_lp.linear_programming.backends import run_backend
from ssp_lp.programs.occupation_program import rows_program
from written_models import written

# Occupation programs: x is the expected visits of every pair, in the optimum and as stated.


criteria = pytest.mark.parametrize("criterion", [MCMP, S3P])


def check(problem, backend, accuracy):
    """A program's measure against the solution and against its own policies."""
    try:
        solution = solve(problem)
    except InfeasibleError:
        with pytest.raises(InfeasibleError):
            problem.program().solve(backend)
        return
    program = problem.program()
    measure = program.solve(backend)
    near = {"rel": accuracy, "abs": accuracy}
    assert measure.objective == pytest.approx(solution.objective, **near)
    assert measure.optimal_value_from_dual == pytest.approx(measure.objective, **near)
    assert measure.residual <= accuracy
    mixed = measure.mixed_policy()
    for policy in (mixed, measure.randomised_policy()):
        found = evaluate(policy, problem)
        assert found.objective == pytest.approx(measure.objective, rel=1e-9, abs=1e-9)
        failure = found.discounted_failure
        failure = found.failure_probability if failure is None else failure
        if "failure" in measure.activity:
            assert failure == pytest.approx(measure.activity["failure"], rel=1e-9, abs=1e-9)
        for name, spent in found.secondary_costs.items():
            assert spent <= measure.activity[name] * (1.0 + 1e-9) + 1e-9
    if backend is None:
        tight = [row for row in program.rows if measure.activity[row.name] >= row.bound - 1e-7]
        assert len(mixed.weights) <= len(tight) + 1


@pytest.mark.parametrize("seed", range(8))
def test_the_program_has_the_optimum_and_its_policies_attain_it(seed):
    for problem in problems_of(seed):
        check(problem, None, 1e-9)


@pytest.mark.parametrize("backend", ["highs-ipx", "cvxpy"])
@pytest.mark.parametrize("seed", range(30, 32))
def test_every_backend_makes_policies(backend, seed):
    for problem in problems_of(seed):
        check(problem, backend, 1e-6)


@pytest.mark.parametrize("seed", range(40, 50))
def test_budgets_at_the_least_failure(seed):
    model, start = drawn(seed), {"a": 0.5, "c": 0.5}
    least = solve(MaxProb(model, start)).failure_probability
    for criterion in (MCMP, S3P) if least < 1.0 else (MCMP,):
        problem = criterion(model, start, failure_budget=least)
        measure, known = problem.program().solve(), solve(problem).objective
        assert measure.objective == pytest.approx(known, rel=1e-7, abs=1e-9)
        assert measure.optimal_value_from_dual <= known + 1e-9 * max(known, 1.0)


# Pairs, states and the components that are left


@pytest.mark.parametrize(
    ("model", "start", "budget", "pair", "limited"),
    [(SLIP, "s", 0.2, ("s", "slip"), 2.5), (REENTERED, "a", 0.0, ("a", "try"), 3.5)],
    ids=["loop", "free component"],
)
def test_a_row_counts_each_time_that_a_pair_comes_back(model, start, budget, pair, limited):
    problem = MCMP(model, start, budget)
    program = problem.program()
    assert program.solve().visits[program.column(*pair)] == pytest.approx(2.0, rel=1e-12)
    convex = program.to_cvxpy()
    convex.constraints["once"] = convex.visits(*pair) <= 1.0
    measure = convex.solve(solver=cp.CLARABEL)
    assert measure.objective == pytest.approx(limited, rel=1e-7)
    for policy in (measure.mixed_policy(), measure.randomised_policy()):
        assert evaluate(policy, problem).objective == pytest.approx(limited, rel=1e-7)


def test_whoever_may_wander_for_ever_has_a_column_for_it():
    problem = MaxProb(REENTERED, "a")
    program = problem.program()
    sure = MCMP(REENTERED, "a", 0.0).program()
    labels = [str(sure.label(k)) for k in range(sure.process.n_pairs)]
    assert labels == ["(a, go)", "(a, try)", "(a, pay)", "(b, go)"]
    (stay,) = program.columns("b", "stay for ever")
    assert program.columns("b", GIVE_UP) == (stay,)
    assert (program.process.failure[stay], program.process.cost[stay]) == (1.0, 1.0)
    convex = program.to_cvxpy()
    convex.constraints["cost"] = convex.expression(expected_cost()) <= 1.0
    measure = convex.solve(solver=cp.CLARABEL)
    assert measure.objective == pytest.approx(0.5, rel=1e-6)  # one try, then stay
    found = evaluate(measure.mixed_policy(), problem)
    assert found.goal_probability == pytest.approx(0.5, rel=1e-6)


def test_a_free_component_is_left_by_two_ways_at_once():
    problem = MCMP(model_of(FREE_PAIR), {"x": 0.3, "y": 0.7}, failure_budget=0.2)
    measure = problem.program().solve()
    found = evaluate(measure.randomised_policy(), problem)
    assert found.objective == pytest.approx(measure.objective, abs=1e-12)
    assert measure.objective == pytest.approx(0.4 * 1.0 + 0.6 * 6.0)  # closed form: out of x, y
    assert found.failure_probability == pytest.approx(0.2)


def free_ring(size):
    """A ring that is moved about for free, backwards more easily, left at its two ends."""
    moves = {
        i: {
            "on": [(1.0, (i + 1) % size, 0.0)],
            "back": [(1.0, max(i - 1, 0), 0.0)],
            "far back": [(1.0, max(i - 2, 0), 0.0)],
        }
        for i in range(size)
    }
    moves[size - 1]["cheap"] = [(0.9, "g", 3.0), (0.1, "d", 1.0)]
    moves[0]["road"] = [(0.99, "g", 9.0), (0.01, "d", 5.0)]
    return model_of(moves)


@pytest.mark.parametrize(
    ("criterion", "known"), [(MCMP, 4 / 9 * 2.8 + 5 / 9 * 8.96), (S3P, (4 * 2.7 + 5 * 8.91) / 8.55)]
)
@pytest.mark.parametrize("size", [4, 20, 60, 400])
def test_large_free_components_are_left_as_the_measure_says(criterion, known, size):
    problem = criterion(free_ring(size), {1: 0.5, size // 2: 0.5}, failure_budget=0.05)
    measure = problem.program().solve()
    assert measure.objective == pytest.approx(known, rel=1e-9)
    for policy in (measure.randomised_policy(), measure.mixed_policy()):
        found = evaluate(policy, problem)
        assert found.objective == pytest.approx(measure.objective, rel=1e-9)
        assert found.failure_probability == pytest.approx(0.05, rel=1e-9)


@pytest.mark.parametrize("passes", [1e6, 1e8])
def test_a_lottery_behind_a_chain_that_is_hardly_left(passes):
    p = 1.0 / passes
    model = written(
        f"""
        a go: b {p}
        b go: {1.0 - p} a {p}, {p} y {p}
        y road: 0.99 g 9, 0.01 d 5
        y alley: 0.9 g 3, 0.1 d 1
        """
    )
    policy = MCMP(model, "a", failure_budget=0.01 + 8e-6).program().solve().mixed_policy()
    assert len(policy.weights) == 2
    assert policy.weights.min() == pytest.approx(8e-6 / 0.09, rel=1e-3)


def test_a_tiny_budget_is_enforced():
    model = written(f"x fast: {1 - 1e-9} g 1, 1e-9 d 1\n x slow: g 10")
    measure = MCMP(model, "x", failure_budget=5e-10).program().solve()
    assert measure.objective == pytest.approx(5.5, rel=1e-6)
    assert measure.activity["failure"] <= 5e-10 * (1.0 + 1e-6)


def test_visits_of_a_state_are_its_outflow_or_its_arrivals():
    program = MCMP(SLIP, {"s": 0.5, "pit": 0.25, "g": 0.25}, 0.5).program()
    x = program.solve().visits  # a half start, each goes round once
    seen = [program.visits(state) @ x for state in ("s", "pit", "g")]
    assert seen == pytest.approx([1.0, 0.25, 0.75])
    assert S3P(model_of({"d": {}}), "g", failure_budget=0.5).program().label(0).action == "start"


def test_visits_that_no_policy_comes_to_keep_no_row(monkeypatch):
    monkeypatch.setattr(policy_iteration, "MOST_ROUNDS", 100)  # at prices that pay for going round
    model = written("s go: g 1\n a round: b 0\n a out: g 1\n b round: a 0")
    convex = MCMP(model, "s", 0.5).program().to_cvxpy()
    convex.constraints["often"] = convex.visits("a", "round") >= 1.0
    with pytest.raises(SolverError, match="'often' is attained only by visits that circulate"):
        convex.solve(solver=cp.CLARABEL)
    del convex.constraints["often"]
    convex.objective = convex.objective - cp.sqrt(convex.visits("a", "round"))
    convex.constraints["seldom"] = convex.visits("a") <= 4.0
    with pytest.raises(SolverError, match="the objective's value is attained only by visits that"):
        convex.solve(solver=cp.CLARABEL)


# Case S


def test_case_s_has_a_column_for_each_accumulated_cost():
    program = S3P(written("x wait: 0.5 x 2, 0.5 g 2"), "x", failure_budget=0.5).program()
    columns = program.columns("x", "wait")
    assert [program.label(k).cost for k in columns[:3]] == [0.0, 2.0, 4.0]
    assert program.column("x", "wait", cost=2.0) == columns[1]
    with pytest.raises(ModelError, match="give cost="):
        program.column("x", "wait")
    with pytest.raises(ModelError, match="has no column"):
        program.column("x", "wait", cost=1.0)


def test_the_open_end_lets_every_action_go_on():
    model = written("a x: 0.5 g 1, 0.5 b 1\n a y: 0.02 g 1, 0.98 b 1\n b back: a 0")
    problem = S3P(model, "a", 1.0)
    convex = problem.program().to_cvxpy()
    convex.constraints["no x"] = convex.visits("a", "x") <= 0.0
    measure = convex.solve(solver=cp.CLARABEL)
    found = evaluate(measure.randomised_policy(), problem)
    assert [measure.objective, found.objective] == pytest.approx([50.0, 50.0], rel=1e-5)
    assert measure.beyond > 0.5
    assert "succeed beyond the last total" in repr(measure)
    wide = S3P(model, "a", 1.0, cost_cap=1500.0).program().to_cvxpy()
    wide.constraints["no x"] = wide.visits("a", "x") <= 0.0
    assert wide.solve(solver=cp.CLARABEL).beyond < 1e-9


def test_expressions_of_a_ratio_are_scaled_by_themselves():
    program = S3P(TURNS, "s", 0.3).program()
    convex = program.to_cvxpy()
    bound = cp.Parameter(value=0.5)
    convex.constraints["seldom"] = convex.visits("s", "go") - 0.25 <= bound - 0.15
    measure = convex.solve(solver=cp.CLARABEL)
    limited = S3P(TURNS, "s", 0.3, constraints={"go": end_probability("pit") <= 0.3 * 0.6})
    assert measure.objective == pytest.approx(solve(limited).objective, rel=1e-6)
    convex.constraints["seldom"] = convex.visits("s", "go") <= 0.1 * convex.visits("s") + bound
    convex.objective = convex.expression(expected_cost() + 3.0 * visits("t"))
    x = convex.solve(solver=cp.CLARABEL).visits
    assert program.visits("s", "go") @ x - 0.1 * program.visits("s") @ x <= 0.5 + 1e-6


def test_visits_that_never_succeed_have_no_cost_given_success():
    program = S3P(DEPOT, "depot", 0.05).program()
    nothing = program.measure(np.zeros(program.process.n_pairs))
    assert nothing.objective == np.inf
    assert nothing.residual == pytest.approx(1.0)
    assert not nothing.duals
    assert "objective inf" in str(nothing)


def test_programs_of_many_units_take_room_for_the_steps_that_occur_alone():
    """Three costs in 5,003 units: a table of layers by units would take 800 megabytes."""
    model = written(
        """
        s fast: 0.5 g 1, 0.3 s 7, 0.2 d 1
        s slow: 0.9 g 5003, 0.1 s 1
        """
    )
    few = {"few": visits("s") <= 1.3}
    tracemalloc.start()
    try:
        program = S3P(model, "s", 0.1, cost_cap=20_000.0, constraints=few).program()
        assert program.linear.matrix.shape[1] > 40_000
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()


# Bounds


@pytest.mark.parametrize(("made_for", "asked", "best"), [(0.0, 0.3, 1.0), (0.3, 0.05, 15.8295)])
def test_what_was_cut_off_for_another_bound_is_made_anew(made_for, asked, best):
    program = S3P(TURNS, "s", made_for).program().bounded_by({"failure": asked})
    assert repr(program) == repr(S3P(TURNS, "s", asked).program())
    measure = program.solve()
    assert measure.objective == pytest.approx(best, rel=1e-6)
    assert solve(S3P(TURNS, "s", asked)).objective == pytest.approx(measure.objective, rel=1e-9)


def test_bounds_that_no_policy_keeps_are_named():
    cheap = MCMP(SLIP, "s", 0.2, constraints={"cost": expected_cost() <= 2.5}).program()
    with pytest.raises(InfeasibleError, match=r"contradict|at least"):
        cheap.bounded_by({"cost": 0.5}).solve()
    forced = written("s dear: 0.9 g 3, 0.1 pit 3")
    with pytest.raises(InfeasibleError, match=r"at least 0\.1") as refused:
        MCMP(forced, "s", 0.2).program().bounded_by({"failure": 0.05}).solve()
    assert refused.value.least_failure == pytest.approx(0.1)
    for bound in (np.nan, "half", -np.inf):
        with pytest.raises(ModelError, match="cost must be a number, the bound of its row"):
            cheap.bounded_by({"cost": bound})
        with pytest.raises(ModelError, match="cost must be a number, the bound of its row"):
            cheap.to_cvxpy().solve(cp.CLARABEL, cost=bound)
    fuel = CostLimit({"depot": {"road": 2.0, "alley": 2.0}}, 1.0)
    problem = ConstrainedCost(DEPOT, "depot", {"fuel": fuel}, failure_budget=0.05)
    with pytest.raises(InfeasibleError, match="no expected visits satisfy all rows"):
        problem.program().solve()


@criteria
@pytest.mark.parametrize("name", ["failure", "seen"])
def test_an_infinite_bound_limits_nothing(criterion, name):
    program = criterion(SLIP, "s", 0.05, constraints={"seen": visits("s") <= 1.7}).program()
    free = program.bounded_by({name: 1e6 if name == "seen" else 1.0}).solve()
    measure = program.bounded_by({name: np.inf}).solve(warm_start=free)
    assert measure.objective == pytest.approx(free.objective, rel=1e-9)
    assert measure.gap <= 1e-9
    assert free.objective < program.solve().objective - 0.1 * (name == "seen") + 1e-9
    convex = program.to_cvxpy()
    with pytest.raises(ModelError, match=f"{name} must be finite.*del convex.constraints"):
        convex.solve(cp.CLARABEL, **{name: np.inf})
    if criterion is MCMP:
        del convex.constraints[name]
        assert convex.solve(cp.CLARABEL).objective == pytest.approx(free.objective, rel=1e-6)


# Any visits, and what else may be asked of them


def test_any_visits_make_a_measure():
    for problem in (MCMP(SLIP, "s", 0.2), S3P(TURNS, "s", 0.05)):
        program = problem.program()
        solved = program.solve()
        given = program.measure(solved.visits)
        assert (given.objective, given.residual) == (solved.objective, solved.residual)
        assert given.optimal_value_from_dual is None
        if program.ratio:
            scaled = program.measure(np.append(solved.visits * 3.0, 3.0))
            assert scaled.objective == pytest.approx(solved.objective)
        twice = program.measure(2.0 * solved.visits)
        assert twice.residual > 0.5
        found = evaluate(twice.mixed_policy(), problem)
        assert found.objective == pytest.approx(solved.objective, rel=1e-7)
        with pytest.raises(ModelError, match="finite numbers"):
            program.measure(solved.visits[1:])
        with pytest.raises(ModelError, match="x must be numbers, not 'often'"):
            program.measure("often")


@pytest.mark.parametrize("seed", range(10))
def test_expressions_are_what_evaluation_says(seed):
    start = {"a": 0.75, "b": 0.125, "g": 0.125}
    if (found := with_room(seed, start)) is None:
        return
    fuel = np.random.default_rng([26, seed]).integers(0, 3, size=found[0].n_pairs).astype(float)
    counted = {
        "fuel": secondary_cost(fuel),
        "end": end_probability("pit") + 0.25,
        "b": 2.0 * visits("b"),
        "failing": failure_probability() / 2.0,
    }
    limits = {name: quantity <= 1e6 for name, quantity in counted.items()}
    counted["goal"] = goal_probability()
    limits["goal"] = counted["goal"] >= 0.0
    for criterion in (MCMP, S3P):
        problem = criterion(found[0], start, min(found[1] + 0.3, 1.0), constraints=limits)
        program = problem.program()
        measure = program.solve()
        spent = evaluate(measure.randomised_policy(), problem).secondary_costs
        for name, quantity in counted.items():
            coefficients, constant = program.expression(quantity)
            value = float(coefficients @ measure.visits) + constant
            assert spent[name] == pytest.approx(value, rel=1e-7, abs=1e-7)


def test_whole_numbers_shared_budgets_and_horizons():
    """One action in each state; two programs within one budget; visits within so many steps."""
    convex = MCMP(DEPOT, "depot", 0.05).program().to_cvxpy()
    chosen = cp.Variable(2, boolean=True)
    for k, action in enumerate(("road", "alley")):
        convex.constraints[f"open {action}"] = convex.visits("depot", action) <= chosen[k]
    convex.constraints["one"] = cp.sum(chosen) == 1
    measure = convex.solve(solver=cp.SCIPY)
    assert measure.objective == pytest.approx(8.96)
    assert len(measure.mixed_policy().weights) == 1
    a, b = (MCMP(*posed, 1.0).program().to_cvxpy() for posed in ((DEPOT, "depot"), (SLIP, "s")))
    shared = a.expression(failure_probability()) + b.expression(failure_probability()) <= 0.05
    rows = [*a.constraints.values(), *b.constraints.values(), shared]
    cp.Problem(cp.Minimize(a.objective + b.objective), rows).solve(solver=cp.CLARABEL)
    assert a.measure().objective == pytest.approx(6.2222222, rel=1e-6)  # the budget all its own
    assert b.measure().objective == pytest.approx(2.0, rel=1e-6)
    program = MCMP(TURNS, "s", 1.0, give_up="dead_ends", horizon=3).program()
    gone = program.visits("s", "go")
    assert gone @ program.solve().visits == pytest.approx(1.0)
    convex = program.to_cvxpy()
    convex.constraints["later"] = convex.visits("s", "go") <= 0.5
    assert gone @ convex.solve(solver=cp.CLARABEL).visits <= 0.5 + 1e-6


@pytest.mark.parametrize(
    ("criterion", "field", "budget"),
    [
        (MCMP, river(5, 5), 0.2),
        (S3P, river(5, 5), 0.2),
        (MCMP, windy_field(8, diagonal=1), 0.2),
        (S3P, windy_field(3, diagonal=1), 0.15),  # of hundreds of members
    ],
)
def test_an_interior_point_makes_a_lottery(criterion, field, budget):
    """What it leaves on pairs that nobody takes is noise, however little balance it breaks."""
    problem = criterion(*field, budget)
    stated = problem.program().to_cvxpy()
    whole = cp.Problem(cp.Minimize(stated.objective), [*stated.constraints.values()])
    whole.solve(cp.CLARABEL, ignore_dpp=True)  # else cvxpy 1.5 warns of its parameters
    measure = stated.measure()
    best = solve(problem).objective
    for policy in (measure.mixed_policy(), measure.randomised_policy()):
        found = evaluate(policy, problem)
        assert found.objective == pytest.approx(best, rel=1e-6)
        assert found.failure_probability == pytest.approx(budget, abs=1e-6)


def test_any_convex_row_may_be_added():
    problem = MCMP(DEPOT, "depot", failure_budget=0.05)
    convex = problem.program().to_cvxpy()
    plain = convex.solve(solver=cp.CLARABEL)
    assert plain.optimal_value_from_dual == pytest.approx(plain.objective, rel=1e-6)
    convex.constraints["alley"] = cp.square(convex.visits("depot", "alley")) <= 0.16
    measure = convex.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10)
    assert measure.optimal_value_from_dual is None
    assert measure.objective == pytest.approx(0.4 * 2.8 + 0.6 * 8.96, rel=1e-6)
    for policy in (measure.randomised_policy(), measure.mixed_policy()):
        assert evaluate(policy, problem).objective == pytest.approx(measure.objective, rel=1e-9)


def test_rows_of_the_users_are_kept_where_nothing_can_come_of_going_on():
    """To patrol for half a step, at a place that is about to give up."""
    model = written("x go: 0.9 g 1, 0.1 y 1\n y patrol: y 0.1\n y home: g 100")
    program = MCMP(model, "x", failure_budget=0.2).program()
    convex, patrol = program.to_cvxpy(), program.column("y", "patrol")
    convex.constraints["patrol"] = convex.x[patrol] >= 0.5
    measure = convex.solve(solver=cp.CLARABEL)
    assert measure.visits[patrol] == pytest.approx(0.5, abs=1e-6)
    assert measure.objective == pytest.approx(1.06, abs=1e-6)


# Names, files and what is no program


def test_it_reads_like_the_page_of_a_paper():
    program = MCMP(DEPOT, "depot", failure_budget=0.05).program()
    assert str(program).splitlines() == [
        "MCMP, failure budget 0.05",
        "  minimise    <cost, x>",
        "  subject to  balance: outflow(x) - inflow(x) = start   (1 rows)",
        "              failure: <failure, x> <= 0.05",
        "              x >= 0   (2 columns, 4 entries)",
        "in full",
        "                  minimise  depot  failure",
        "  (depot, road)       8.96      1     0.01",
        "  (depot, alley)       2.8      1      0.1",
        "                              = 1  <= 0.05",
    ]
    text = str(program.solve())
    assert text.startswith("objective 6.22222222 ")
    assert "c* 6.22222222 = (9.64444444 - 3.42222222): v(start) less price x bound" in text
    assert "failure: 0.05 <= 0.05   price 68.4444" in text


def test_columns_and_rows_have_names():
    program = MCMP(DEPOT, "depot", failure_budget=0.05).program()
    column = program.column("depot", "road")
    assert program.label(column)[:2] == ("depot", "road")
    assert program.row("failure").bound == 0.05
    assert program.row("failure").coefficients[column] == pytest.approx(0.01)
    free = MCMP(DEPOT, "depot", failure_budget=0.05, give_up="anywhere").program()
    assert str(free.label(free.column("depot", GIVE_UP))) == "(depot, give up)"
    for ask, words in (
        (lambda: program.column("depot", GIVE_UP), "has no column"),
        (lambda: program.row("fuel"), "no row is named 'fuel'; there are 'failure'"),
        (lambda: program.column("depot", "river"), "no action 'river'"),
        (lambda: program.label(2), "no pair has column 2"),
        (lambda: program.solve("simplex"), "backend must be one of"),
    ):
        with pytest.raises(ModelError, match=words):
            ask()


def highs_of(path):
    """The file as HiGHS reads it."""
    solver = highspy.Highs()
    solver.setOptionValue("output_flag", False)
    for side in ("primal", "dual"):
        solver.setOptionValue(f"{side}_feasibility_tolerance", 1e-10)
    assert solver.readModel(str(path)) == highspy.HighsStatus.kOk
    return solver


@pytest.mark.parametrize("ending", ["mps", "lp"])
def test_a_file_is_solved_by_highs_alone_and_comes_back(ending, tmp_path):
    path = tmp_path / f"program.{ending}"
    stated = [
        MCMP(SLIP, "s", 0.2, constraints={name: visits("s") <= 1.9})
        for name in ("fuel", "balance.0", "x0")
    ]
    named = [(problem, problem.program().solve()) for problem in (*stated, S3P(TURNS, "s", 0.05))]
    for problem, known in [*measures_of(3), *named]:
        program = problem.program()
        program.write(path)
        solver = highs_of(path)
        solver.run()
        found = program.sense.stated(solver.getInfo().objective_function_value)
        assert found == pytest.approx(known.objective, rel=1e-7, abs=1e-7)
        solver.writeSolution(str(tmp_path / "program.sol"), 0)
        measure = program.read_solution(tmp_path / "program.sol")
        assert measure.residual <= 1e-6
        assert measure.objective == pytest.approx(known.objective, rel=1e-6, abs=1e-7)
    (tmp_path / "other.sol").write_text("nothing here 1.0")
    with pytest.raises(ModelError, match="names no column"):
        program.read_solution(tmp_path / "other.sol")
    with pytest.raises(ModelError, match="is written as"):
        program.write(tmp_path / "program.txt")


def test_a_written_program_has_names(tmp_path):
    program, plain, packed = (
        MCMP(DEPOT, "depot", failure_budget=0.05).program(),
        tmp_path / "depot.mps",
        tmp_path / "depot.mps.gz",
    )
    program.write(plain)
    program.write(packed)
    text = plain.read_text()
    assert "failure" in text
    assert "depot_road" in text
    assert gzip.decompress(packed.read_bytes()).decode() == text
    fuel = CostLimit({"depot": {"road": 2.0, "alley": 4.0}}, 20.0)
    limits = {"fu el": fuel, "fu-el": fuel, "2nd fuel": fuel}
    path = tmp_path / "program.lp"
    ConstrainedCost(DEPOT, "depot", limits, failure_budget=0.06).program().write(path)
    solver = highs_of(path)
    assert len(set(solver.getLp().row_names_)) == solver.getNumRow() == 5
    with pytest.raises(ModelError, match="'balance' names the rows of flow balance"):
        ConstrainedCost(DEPOT, "depot", {"balance": fuel})


@pytest.mark.parametrize("criterion", [CostQuantile, CVaR])
def test_a_search_over_programs_is_no_program(criterion):
    with pytest.raises(ModelError, match="not a linear program but a search over many"):
        criterion(DEPOT, "depot", 0.9, 0.05).program()


# Case S's program has a column for each action at each total that a run can come to, no more.


STARTS = ("a", {"b": 0.5, "d": 0.5}, {"a": 0.75, "b": 0.125, "g": 0.125})


def walked(choices: dict, start: object, cap: float) -> set[tuple]:
    """(state, action, total) along every walk of a model from its start, breadth first."""
    begun = [start] if isinstance(start, str) else list(start)
    places, ahead, taken = {(s, 0.0) for s in begun}, deque((s, 0.0) for s in begun), set()
    while ahead:
        state, paid = ahead.popleft()
        for action, ways in choices.get(state, {}).items():
            taken.add((state, action, paid))
            for chance, successor, cost in ways:
                place = successor, min(paid + cost, cap)
                if chance > 0.0 and place not in places:
                    places.add(place)
                    ahead.append(place)
    return taken


def problems(seed: int, **asked: object):
    """S3P on a drawn model from several starts, with room between least failure and budget."""
    for start in STARTS:
        if (found := with_room(seed, start)) is not None and found[1] < 0.9:
            yield start, S3P(found[0], start, found[1] + 0.5 * (1.0 - found[1]), **asked)


@pytest.mark.parametrize("seed", range(20))
def test_columns_are_those_of_the_walks_from_the_start(seed):
    choices = drawn_choices(seed)
    for cap in (None, 3.0):
        for start, problem in problems(seed, cost_cap=cap):
            program = problem.program()
            last = max(program.augmented.inner.totals.values.tolist())
            labels = [program.label(k) for k in range(program.process.n_pairs)]
            acting = {
                tuple(x) for x in labels if x.action not in (GIVE_UP, "stay for ever", "start")
            }
            open_states = {state for state, _, _ in acting}
            walks = {w for w in walked(choices, start, last) if w[0] in open_states}
            assert acting == walks
            assert len(set(labels)) == len(labels)
            begun = {start} if isinstance(start, str) else set(start)
            assert (labels[-1].action == "start") == bool(begun - open_states)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(7))
def test_nothing_is_lost_with_the_totals_that_no_run_comes_to(seed):
    """The optimum is `solve`'s and the one over all totals; duals and both policies attain it."""
    for limits in ({}, {"seen": visits("a") <= 1.5}):
        for discount in (None, 0.9):
            for _, problem in problems(seed, constraints=limits, discount=discount):
                try:
                    known = solve(problem)
                except InfeasibleError:  # a limit, or what a discount counts as failing
                    continue
                program = problem.program()
                measure = program.solve()
                assert measure.objective == pytest.approx(known.objective, rel=1e-8, abs=1e-8)
                proved = measure.optimal_value_from_dual
                assert proved == pytest.approx(known.objective, rel=1e-8, abs=1e-8)
                whole = program.augmented.inner.process
                if "seen" not in limits:
                    budget = {"failure": (whole.failure, problem.failure_budget)}
                    every = rows_program(whole, budget, ratio=True)
                    answer = run_backend(every, "highs-simplex", np.inf)
                    assert every.cost @ answer.x == pytest.approx(known.objective, rel=1e-7)
                for policy in (measure.mixed_policy(), measure.randomised_policy()):
                    found = evaluate(policy, problem)
                    assert found.objective == pytest.approx(known.objective, rel=1e-7, abs=1e-8)


def test_a_decision_of_one_total_has_a_price_and_values_at_it():
    program = S3P(DEPOT, "depot", failure_budget=0.05).program()
    assert program.linear.matrix.shape == (3, 3)
    measure = program.solve()
    assert measure.visits.tolist() == pytest.approx([5.0 / 9.0, 4.0 / 9.0])
    assert measure.objective == pytest.approx((5.0 * 8.91 + 4.0 * 2.7) / 8.55)
    assert solve(S3P(DEPOT, "depot", 0.05)).explain("depot").cost_paid == 0.0


def test_a_policy_of_the_program_decides_everywhere_below_its_last_total():
    """At a total that no run comes to the policy decides as at the one before."""
    policy = S3P(DEPOT, "depot", failure_budget=0.05).program().solve().mixed_policy()
    for member in policy.policies:
        assert len({row.action for row in member.table()}) == 1
