"""Occupation programs: their optimum, their duals, and the policies that their measures make."""

from __future__ import annotations

import gzip
from collections.abc import Iterator

import cvxpy as cp
import highspy
import numpy as np
import pytest

from formulations import (
    EGUBS,
    ISSPUDE,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostBoundedReach,
    CostLimit,
    CostQuantile,
    CVaR,
    FinitePenalty,
    MaxProb,
    MinProb,
)
from small_models import FREE_PAIR, model_of
from ssp_lp import GIVE_UP, SSP, InfeasibleError, ModelError, evaluate, solve
from ssp_lp.problem import Problem

DEPOT = model_of(
    {
        "depot": {
            "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
            "alley": [(0.9, "home", 3.0), (0.1, "wreck", 1.0)],
        },
        "wreck": {},
    },
    "home",
)


HIGHS = {
    "output_flag": False,
    "primal_feasibility_tolerance": 1e-10,
    "dual_feasibility_tolerance": 1e-10,
}


def drawn(seed: int) -> tuple[SSP, object, dict]:
    """A model of up to six live states, often with free cycles, and one start or several."""
    rng = np.random.default_rng([7, seed])
    n, costs = int(rng.integers(1, 7)), [0, 0, 1, 2] if rng.random() < 0.6 else [1, 2, 3]
    names = [*(f"s{i}" for i in range(n)), "g", "d"]
    chances = np.append(np.full(n, 0.8 / n), [0.13, 0.07])
    choices: dict = {"d": {}}
    for state in names[:n]:
        choices[state] = {}
        for action in range(int(rng.integers(1, 4))):
            ends = rng.choice(n + 2, size=int(rng.integers(1, 4)), replace=False, p=chances)
            share = rng.integers(1, 5, size=len(ends))
            choices[state][f"a{action}"] = [
                (float(p), names[end], float(rng.choice(costs)))
                for p, end in zip(share / share.sum(), ends, strict=True)
            ]
    start: object = "s0"
    if rng.random() < 0.4:
        some = rng.choice(n, size=int(rng.integers(1, n + 1)), replace=False)
        start = {names[i]: 0.8 / len(some) for i in some} | {"g": 0.1, "d": 0.1}
    return model_of(choices), start, choices


def problems_of(seed: int) -> Iterator[Problem]:
    """Every criterion that is a linear program, on a drawn model."""
    model, start, choices = drawn(seed)
    rng = np.random.default_rng([8, seed])
    least = solve(MaxProb(model, start)).failure_probability
    budget = least + (1.0 - least) * float(rng.choice([0.05, 0.1, 0.3, 0.5]))
    give_up = str(rng.choice(["anywhere", "attention", "dead_ends"]))
    more = min(budget + 0.2, 1.0)
    yield MCMP(model, start, failure_budget=budget, give_up=give_up)
    yield MCMP(model, start, failure_budget=more, discount=0.9, give_up=give_up)
    yield from (FinitePenalty(model, start, 5.0), AlphaMCMP(model, start, 0.8))
    yield from (MCMP(model, start), MaxProb(model, start), MinProb(model, start))
    yield CostBoundedReach(model, start, 3, failure_budget=budget)
    if least < 1.0:
        yield S3P(model, start, failure_budget=budget)
        yield S3P(model, start, failure_budget=more, discount=0.9)
        yield from (S3P(model, start), ISSPUDE(model, start), EGUBS(model, start, -0.2, 1.0))
    fuel = {s: {a: float(rng.integers(0, 3)) for a in choices[s]} for s in choices if choices[s]}
    loose = ConstrainedCost(
        model, start, {"fuel": CostLimit(fuel, 1e6)}, failure_budget=budget, give_up=give_up
    )
    spent = solve(loose).secondary_costs["fuel"]
    yield ConstrainedCost(
        model,
        start,
        {"fuel": CostLimit(fuel, 0.95 * spent)},
        failure_budget=budget,
        give_up=give_up,
    )


def check(problem: Problem, backend: str | None, accuracy: float) -> None:
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


@pytest.mark.parametrize("seed", range(30))
def test_the_program_has_the_optimum_and_its_policies_attain_it(seed: int) -> None:
    for problem in problems_of(seed):
        check(problem, None, 1e-9)


@pytest.mark.parametrize("backend", ["highs-ipx", "clarabel", "cvxpy"])
@pytest.mark.parametrize("seed", range(30, 34))
def test_every_backend_makes_policies(backend: str, seed: int) -> None:
    for problem in problems_of(seed):
        check(problem, backend, 1e-6)


def test_a_free_component_is_left_by_two_ways_at_once() -> None:
    problem = MCMP(model_of(FREE_PAIR), {"x": 0.3, "y": 0.7}, failure_budget=0.2)
    measure = problem.program().solve()
    policy = measure.randomised_policy()
    assert evaluate(policy, problem).objective == pytest.approx(measure.objective, abs=1e-12)
    assert measure.objective == pytest.approx(0.4 * 1.0 + 0.6 * 6.0)  # closed form: out of x, y
    assert evaluate(policy, problem).failure_probability == pytest.approx(0.2)


def test_it_reads_like_the_page_of_a_paper() -> None:
    program = MCMP(DEPOT, "depot", failure_budget=0.05).program()
    assert str(program).splitlines() == [
        "MCMP, failure budget 0.05",
        "  minimise    <cost, x>",
        "  subject to  balance: outflow(x) - inflow(x) = start   (1 rows)",
        "              failure: <failure, x> <= 0.05",
        "              x >= 0   (2 columns, 4 entries)",
        "                  minimise  depot  failure",
        "  (depot, road)       8.96      1     0.01",
        "  (depot, alley)       2.8      1      0.1",
        "                              = 1  <= 0.05",
    ]
    text = str(program.solve())
    assert text.startswith("objective 6.22222222 ")
    assert "c* 6.22222222 = (9.64444444 - 3.42222222): v(start) less price x bound" in text
    assert "failure: 0.05 <= 0.05   price 68.4444" in text


def test_columns_and_rows_have_names() -> None:
    program = MCMP(DEPOT, "depot", failure_budget=0.05).program()
    column = program.column("depot", "road")
    assert program.label(column)[:2] == ("depot", "road")
    assert program.row("failure").bound == 0.05
    assert program.row("failure").coefficients[column] == pytest.approx(0.01)
    with pytest.raises(ModelError, match="no row is named 'fuel'; there are 'failure'"):
        program.row("fuel")
    with pytest.raises(ModelError, match="no action 'river'"):
        program.column("depot", "river")
    with pytest.raises(ModelError, match="column 2 is no pair"):
        program.label(2)
    with pytest.raises(ModelError, match="backend must be one of"):
        program.solve("simplex")


def test_giving_up_is_a_column_where_it_is_allowed() -> None:
    program = MCMP(DEPOT, "depot", failure_budget=0.05, give_up="anywhere").program()
    assert str(program.label(program.column("depot", GIVE_UP))) == "(depot, give up)"
    with pytest.raises(ModelError, match="is no column"):
        MCMP(DEPOT, "depot", failure_budget=0.05).program().column("depot", GIVE_UP)


def test_case_s_has_a_column_for_each_accumulated_cost() -> None:
    model = model_of({"x": {"wait": [(0.5, "x", 2.0), (0.5, "g", 2.0)]}})
    program = S3P(model, "x", failure_budget=0.5).program()
    columns = program.columns("x", "wait")
    assert [program.label(k).cost for k in columns[:3]] == [0.0, 2.0, 4.0]
    assert program.column("x", "wait", cost=2.0) == columns[1]
    with pytest.raises(ModelError, match="say cost="):
        program.column("x", "wait")
    with pytest.raises(ModelError, match="is no column"):
        program.column("x", "wait", cost=1.0)


def test_the_dual_of_case_s_is_the_slope_in_the_budget() -> None:
    problem = S3P(DEPOT, "depot", failure_budget=0.05)
    measure, solution = problem.program().solve(), solve(problem)
    assert measure.duals["failure"] == pytest.approx(solution.budget_slope, rel=1e-9)


def test_any_convex_row_may_be_added() -> None:
    problem = MCMP(DEPOT, "depot", failure_budget=0.05)
    program = problem.program()
    convex = program.to_cvxpy()
    plain = convex.solve(solver=cp.CLARABEL)
    assert plain.optimal_value_from_dual == pytest.approx(plain.objective, rel=1e-6)
    alley = convex.x[program.column("depot", "alley")]
    convex.constraints["alley"] = cp.square(alley) <= 0.16
    measure = convex.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10)
    assert measure.optimal_value_from_dual is None
    assert measure.objective == pytest.approx(0.4 * 2.8 + 0.6 * 8.96, rel=1e-6)
    for policy in (measure.randomised_policy(), measure.mixed_policy()):
        assert evaluate(policy, problem).objective == pytest.approx(measure.objective, rel=1e-9)


def test_a_sweep_of_budgets_is_compiled_once() -> None:
    convex = MCMP(DEPOT, "depot", failure_budget=0.05).program().to_cvxpy()
    stated = convex.problem
    for budget in (0.02, 0.05, 0.08):
        convex.bounds["failure"].value = budget
        measure = convex.solve(solver=cp.CLARABEL)
        known = solve(MCMP(DEPOT, "depot", failure_budget=budget)).objective
        assert measure.objective == pytest.approx(known, rel=1e-6)
        assert measure.optimal_value_from_dual == pytest.approx(known, rel=1e-6)
        assert measure.program.row("failure").bound == budget
        assert convex.problem is stated
    convex.bounds["failure"].value = 0.001
    with pytest.raises(InfeasibleError):
        convex.solve(solver=cp.CLARABEL)


def test_another_objective_gives_another_policy() -> None:
    program = MCMP(DEPOT, "depot", failure_budget=0.08).program()
    convex = program.to_cvxpy()
    convex.objective = convex.objective - 100.0 * cp.sum(cp.entr(convex.x))
    measure = convex.solve(solver=cp.CLARABEL)
    policy, problem = measure.randomised_policy(), MCMP(DEPOT, "depot", failure_budget=0.08)
    assert evaluate(policy, problem).objective == pytest.approx(measure.objective, rel=1e-9)
    assert measure.objective > solve(problem).objective * (1.0 + 1e-4)
    assert len(measure.mixed_policy().weights) == 2


def test_rows_of_the_users_are_kept_where_nothing_can_come_of_going_on() -> None:
    """To patrol for half a step, at a place that is about to give up."""
    model = model_of(
        {
            "x": {"go": [(0.9, "g", 1.0), (0.1, "y", 1.0)]},
            "y": {"patrol": [(1.0, "y", 0.1)], "home": [(1.0, "g", 100.0)]},
        }
    )
    program = MCMP(model, "x", failure_budget=0.2).program()
    convex = program.to_cvxpy()
    patrol = program.column("y", "patrol")
    convex.constraints["patrol"] = convex.x[patrol] >= 0.5
    measure = convex.solve(solver=cp.CLARABEL)
    assert measure.visits[patrol] == pytest.approx(0.5, abs=1e-6)
    assert measure.objective == pytest.approx(1.06, abs=1e-6)


def test_replaced_rows_have_no_price() -> None:
    convex = MCMP(DEPOT, "depot", failure_budget=0.05).program().to_cvxpy()
    convex.constraints["failure"] = cp.SOC(
        cp.Constant(0.05), cp.multiply(convex.x, np.array([0.01, 0.1]))
    )
    measure = convex.solve(solver=cp.CLARABEL)
    assert measure.duals == {}
    assert measure.optimal_value_from_dual is None


def free_ring(size: int) -> SSP:
    """A ring that is moved about for free, backwards more easily, left at its two ends."""
    moves: dict = {
        i: {
            "on": [(1.0, (i + 1) % size, 0.0)],
            "back": [(1.0, max(i - 1, 0), 0.0)],
            "far back": [(1.0, max(i - 2, 0), 0.0)],
        }
        for i in range(size)
    }
    moves[size - 1]["cheap"] = [(0.9, "g", 3.0), (0.1, "d", 1.0)]
    moves[0]["road"] = [(0.99, "g", 9.0), (0.01, "d", 5.0)]
    return model_of(moves | {"d": {}})


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("size", [4, 20, 60, 400])
def test_large_free_components_are_left_as_the_measure_says(criterion, size: int) -> None:
    problem = criterion(free_ring(size), {1: 0.5, size // 2: 0.5}, failure_budget=0.05)
    measure = problem.program().solve()
    known = {
        MCMP: 4.0 / 9.0 * 2.8 + 5.0 / 9.0 * 8.96,
        S3P: (4.0 / 9.0 * 2.7 + 5.0 / 9.0 * 8.91) / 0.95,
    }
    assert measure.objective == pytest.approx(known[criterion], rel=1e-9)
    for policy in (measure.randomised_policy(), measure.mixed_policy()):
        found = evaluate(policy, problem)
        assert found.objective == pytest.approx(measure.objective, rel=1e-9)
        assert found.failure_probability == pytest.approx(0.05, rel=1e-9)


@pytest.mark.parametrize("seed", range(40, 50))
def test_budgets_at_the_least_failure(seed: int) -> None:
    model, start, _ = drawn(seed)
    least = solve(MaxProb(model, start)).failure_probability
    for criterion in (MCMP, S3P) if least < 1.0 else (MCMP,):
        problem = criterion(model, start, failure_budget=least)
        measure, known = problem.program().solve(), solve(problem).objective
        assert measure.objective == pytest.approx(known, rel=1e-7, abs=1e-9)
        assert measure.optimal_value_from_dual <= known + 1e-9 * max(known, 1.0)


def test_a_tiny_budget_is_enforced() -> None:
    model = model_of(
        {"x": {"fast": [(1 - 1e-9, "g", 1.0), (1e-9, "d", 1.0)], "slow": [(1.0, "g", 10.0)]}}
        | {"d": {}}
    )
    measure = MCMP(model, "x", failure_budget=5e-10).program().solve()
    assert measure.objective == pytest.approx(5.5, rel=1e-6)
    assert measure.activity["failure"] <= 5e-10 * (1.0 + 1e-6)


@pytest.mark.parametrize("passes", [1e6, 1e8])
def test_a_lottery_behind_a_chain_that_is_hardly_left(passes: float) -> None:
    p = 1.0 / passes
    model = model_of(
        {
            "a": {"go": [(1.0, "b", p)]},
            "b": {"go": [(1.0 - p, "a", p), (p, "y", p)]},
            "y": {
                "road": [(0.99, "g", 9.0), (0.01, "d", 5.0)],
                "alley": [(0.9, "g", 3.0), (0.1, "d", 1.0)],
            },
            "d": {},
        }
    )
    problem = MCMP(model, "a", failure_budget=0.01 + 8e-6)
    policy = problem.program().solve().mixed_policy()
    assert len(policy.weights) == 2
    assert policy.weights.min() == pytest.approx(8e-6 / 0.09, rel=1e-3)


def test_a_start_at_the_goal_has_one_column() -> None:
    program = S3P(model_of({"d": {}}), "g", failure_budget=0.5).program()
    assert program.label(0).action == "start"


def test_row_names_in_files_are_unique(tmp_path) -> None:
    fuel = CostLimit({"depot": {"road": 2.0, "alley": 4.0}}, 20.0)
    limits = {"fu el": fuel, "fu-el": fuel, "2nd fuel": fuel}
    path = tmp_path / "program.lp"
    ConstrainedCost(DEPOT, "depot", limits, failure_budget=0.06).program().write(path)
    solver = highspy.Highs()
    solver.setOptionValue("output_flag", False)
    assert solver.readModel(str(path)) == highspy.HighsStatus.kOk
    assert len(set(solver.getLp().row_names_)) == solver.getNumRow() == 5
    with pytest.raises(ModelError, match="'balance' names the rows of flow balance"):
        ConstrainedCost(DEPOT, "depot", {"balance": fuel})


@pytest.mark.parametrize("ending", ["mps", "lp"])
def test_a_file_is_solved_by_highs_alone(ending: str, tmp_path) -> None:
    for number, problem in enumerate(problems_of(3)):
        path = tmp_path / f"program{number}.{ending}"
        try:
            program = problem.program()
            known = program.solve().objective
        except InfeasibleError:
            continue
        program.write(path)
        solver = highspy.Highs()
        for name, value in HIGHS.items():
            solver.setOptionValue(name, value)
        assert solver.readModel(str(path)) == highspy.HighsStatus.kOk
        solver.run()
        found = program.sense.worth(solver.getInfo().objective_function_value)
        assert found == pytest.approx(known, rel=1e-7, abs=1e-7)
    with pytest.raises(ModelError, match="is written as"):
        program.write(tmp_path / "program.txt")


def test_a_written_program_has_names(tmp_path) -> None:
    MCMP(DEPOT, "depot", failure_budget=0.05).program().write(tmp_path / "depot.mps")
    text = (tmp_path / "depot.mps").read_text()
    assert "failure" in text
    assert "depot_road" in text
    packed = tmp_path / "depot.mps.gz"
    MCMP(DEPOT, "depot", failure_budget=0.05).program().write(packed)
    assert gzip.decompress(packed.read_bytes()).decode() == text


def test_limits_that_contradict_each_other() -> None:
    fuel = CostLimit({"depot": {"road": 2.0, "alley": 2.0}}, 1.0)
    problem = ConstrainedCost(DEPOT, "depot", {"fuel": fuel}, failure_budget=0.05)
    with pytest.raises(InfeasibleError, match="no expected visits satisfy all rows"):
        problem.program().solve()


@pytest.mark.parametrize("criterion", [CostQuantile, CVaR])
def test_a_search_over_programs_is_no_program(criterion) -> None:
    with pytest.raises(ModelError, match="no linear program but a search over many"):
        criterion(DEPOT, "depot", 0.9, 0.05).program()


def test_visits_that_never_succeed_have_no_cost_given_success() -> None:
    program = S3P(DEPOT, "depot", 0.05).program()
    nothing = program.measure(np.zeros(program.process.n_pairs))
    assert nothing.objective == np.inf
    assert nothing.residual == pytest.approx(1.0)
    assert not nothing.duals
    assert "objective inf" in str(nothing)
