"""A program's x is the occupation measure: expected visits of every pair of the model."""

from __future__ import annotations

import tracemalloc

import cvxpy as cp
import highspy
import numpy as np
import pytest
from scipy.optimize import linprog

from examples.domains.river import river
from examples.domains.windy_field import windy_field
from formulations import MCMP, S3P, MaxProb
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
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

SLIP = model_of(
    {
        "s": {
            "slip": [(0.5, "s", 1.0), (0.5, "g", 1.0)],
            "dear": [(0.9, "g", 3.0), (0.1, "pit", 3.0)],
        },
        "pit": {},
    }
)
REENTERED = model_of(
    {
        "a": {
            "go": [(1.0, "b", 0.0)],
            "try": [(0.5, "g", 1.0), (0.5, "b", 1.0)],
            "pay": [(1.0, "g", 5.0)],
        },
        "b": {"go": [(1.0, "a", 0.0)]},
    }
)
TURNS = model_of(
    {
        "s": {
            "go": [(0.7, "g", 1.0), (0.3, "pit", 1.0)],
            "wait": [(0.05, "g", 1.0), (0.95, "t", 1.0)],
        },
        "t": {"wait": [(0.05, "g", 1.0), (0.95, "s", 1.0)]},
        "pit": {},
    }
)
TWO_WAYS = model_of(
    {
        "a": {
            "x": [(0.5, "g", 1.0), (0.5, "b", 1.0)],
            "y": [(0.02, "g", 1.0), (0.98, "b", 1.0)],
        },
        "b": {"back": [(1.0, "a", 0.0)]},
    }
)


def test_a_row_on_a_pair_that_loops_counts_each_time() -> None:
    problem = MCMP(SLIP, "s", 0.2)
    program = problem.program()
    measure = program.solve()
    assert measure.visits[program.column("s", "slip")] == pytest.approx(2.0, rel=1e-12)
    convex = program.to_cvxpy()
    convex.constraints["once"] = convex.visits("s", "slip") <= 1.0
    measure = convex.solve(solver=cp.CLARABEL)
    assert measure.objective == pytest.approx(2.5, rel=1e-7)
    for policy in (measure.mixed_policy(), measure.randomised_policy()):
        assert evaluate(policy, problem).objective == pytest.approx(2.5, rel=1e-7)


def test_a_pair_that_comes_back_to_a_free_component_is_counted_each_time() -> None:
    program = MCMP(REENTERED, "a", 0.0).program()
    labels = [str(program.label(k)) for k in range(program.process.n_pairs)]
    assert labels == ["(a, go)", "(a, try)", "(a, pay)", "(b, go)"]
    assert program.solve().visits.tolist() == pytest.approx([0.0, 2.0, 0.0, 1.0])
    convex = program.to_cvxpy()
    convex.constraints["once"] = convex.visits("a", "try") <= 1.0
    assert convex.solve(solver=cp.CLARABEL).objective == pytest.approx(3.5, rel=1e-7)


def test_whoever_may_wander_for_ever_has_a_column_for_it() -> None:
    problem = MaxProb(REENTERED, "a")
    program = problem.program()
    (stay,) = program.columns("b", "stay for ever")
    assert program.columns("b", GIVE_UP) == (stay,)
    assert str(program.label(stay)) == "(b, stay for ever)"
    assert (program.process.failure[stay], program.process.cost[stay]) == (1.0, 1.0)
    convex = program.to_cvxpy()
    convex.constraints["cost"] = convex.expression(expected_cost()) <= 1.0
    measure = convex.solve(solver=cp.CLARABEL)
    assert measure.objective == pytest.approx(0.5, rel=1e-6)  # one try, then stay
    found = evaluate(measure.mixed_policy(), problem)
    assert found.goal_probability == pytest.approx(0.5, rel=1e-6)


@pytest.mark.parametrize(("made_for", "asked", "best"), [(0.0, 0.3, 1.0), (0.3, 0.05, 15.8295)])
def test_what_was_cut_off_for_another_bound_is_made_anew(
    made_for: float, asked: float, best: float
) -> None:
    program = S3P(TURNS, "s", made_for).program().bounded_by({"failure": asked})
    assert repr(program) == repr(S3P(TURNS, "s", asked).program())
    measure = program.solve()
    assert measure.objective == pytest.approx(best, rel=1e-6)
    assert solve(S3P(TURNS, "s", asked)).objective == pytest.approx(measure.objective, rel=1e-9)


def test_bounds_that_no_policy_keeps_are_named() -> None:
    cheap = MCMP(SLIP, "s", 0.2, constraints={"cost": expected_cost() <= 2.5}).program()
    with pytest.raises(InfeasibleError, match=r"contradict|at least"):
        cheap.bounded_by({"cost": 0.5}).solve()
    forced = model_of({"s": {"dear": [(0.9, "g", 3.0), (0.1, "pit", 3.0)]}, "pit": {}})
    with pytest.raises(InfeasibleError, match=r"at least 0\.1") as refused:
        MCMP(forced, "s", 0.2).program().bounded_by({"failure": 0.05}).solve()
    assert refused.value.least_failure == pytest.approx(0.1)
    for bound in (np.nan, "half", -np.inf):
        with pytest.raises(ModelError, match="cost must be a number, the bound of its row"):
            cheap.bounded_by({"cost": bound})
        with pytest.raises(ModelError, match="cost must be a number, the bound of its row"):
            cheap.to_cvxpy().solve(cp.CLARABEL, cost=bound)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("name", ["failure", "seen"])
def test_an_infinite_bound_limits_nothing(criterion: type, name: str) -> None:
    problem = criterion(SLIP, "s", 0.05, constraints={"seen": visits("s") <= 1.7})
    program = problem.program()
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


def test_the_open_end_lets_every_action_go_on() -> None:
    problem = S3P(TWO_WAYS, "a", 1.0)
    program = problem.program()
    convex = program.to_cvxpy()
    convex.constraints["no x"] = convex.visits("a", "x") <= 0.0
    measure = convex.solve(solver=cp.CLARABEL)
    policy = measure.randomised_policy()
    assert measure.objective == pytest.approx(50.0, rel=1e-5)
    assert evaluate(policy, problem).objective == pytest.approx(50.0, rel=1e-5)
    assert measure.beyond > 0.5
    assert "succeed beyond the last total" in repr(measure)
    wide = S3P(TWO_WAYS, "a", 1.0, cost_cap=1500.0).program().to_cvxpy()
    wide.constraints["no x"] = wide.visits("a", "x") <= 0.0
    assert wide.solve(solver=cp.CLARABEL).beyond < 1e-9


def drawn(seed: int) -> SSP:
    """A small model with self-loops and free loops, dead-ends within reach."""
    rng = np.random.default_rng([25, seed])
    names, table = ["a", "b", "c", "d"], {"pit": {}}
    for name in names:
        table[name] = {}
        for action in ("one", "two", "three")[: int(rng.integers(1, 4))]:
            ends = rng.choice(
                [*names, name, "g", "pit"], size=int(rng.integers(1, 4)), replace=False
            )
            share = rng.integers(1, 5, size=len(ends))
            table[name][action] = [
                (float(p), str(end), float(rng.choice([0.0, 0.0, 1.0, 2.0])))
                for p, end in zip(share / share.sum(), ends, strict=True)
            ]
    return model_of(table)


def defined(
    model: SSP, budget: float, row: tuple[int, float] | None = None
) -> tuple[float, np.ndarray]:
    """Case M from its definition, the least cost and visits: a column for each pair, and quitting.

    Nobody pays for giving up, and anybody may: ``charge_failing_step=False``.
    """
    dead = ~np.isin(model.states, ["a", "b", "c", "d"]) & ~model.goal_mask
    live = [s for s in range(model.n_states) if not (dead | model.goal_mask)[s]]
    pairs = [k for k in range(model.n_pairs) if int(model.pair_state[k]) in live]
    balance = np.zeros((len(live), len(pairs) + len(live)))
    cost, failure = np.zeros(len(pairs) + len(live)), np.zeros(len(pairs) + len(live))
    for k, pair in enumerate(pairs):
        balance[live.index(int(model.pair_state[pair])), k] += 1.0
        for j in range(model.outcome_offsets[pair], model.outcome_offsets[pair + 1]):
            p, to = model.probabilities[j], int(model.successors[j])
            cost[k] += p * model.costs[j]
            failure[k] += p * dead[to]
            if to in live:
                balance[live.index(to), k] -= p
    for i in range(len(live)):
        balance[i, len(pairs) + i], failure[len(pairs) + i] = 1.0, 1.0
    limits, bounds = [failure], [budget]
    if row is not None:
        limits.append(np.eye(len(cost))[pairs.index(row[0])])
        bounds.append(row[1])
    start = np.zeros(len(live))
    start[live.index(model.index_of("a"))] = 1.0
    found = linprog(cost, np.array(limits), np.array(bounds), balance, start, method="highs")
    return (float(found.fun), found.x) if found.success else (np.inf, np.zeros(0))


@pytest.mark.parametrize("seed", range(40))
def test_rows_on_visits_are_those_of_the_definition(seed: int) -> None:
    model = drawn(seed)
    least = solve(MaxProb(model, "a")).failure_probability
    if least >= 1.0:
        return
    budget = min(least + 0.2, 1.0)
    problem = MCMP(model, "a", budget, give_up="anywhere", charge_failing_step=False)
    program = problem.program()
    measure = program.solve()
    assert measure.objective == pytest.approx(defined(model, budget)[0], rel=1e-7, abs=1e-8)
    for pair in range(model.n_pairs):
        state, action = model.states[int(model.pair_state[pair])], model.action_of(pair)
        columns = program.columns(state, action)
        if not columns:
            continue
        taken = float(program.visits(state, action) @ measure.visits)
        if taken < 0.05:
            continue
        best, _ = defined(model, budget, (pair, 0.6 * taken))
        convex = program.to_cvxpy()
        convex.constraints["less"] = convex.visits(state, action) <= 0.6 * taken
        if best == np.inf:
            with pytest.raises((InfeasibleError, SolverError)):
                convex.solve(solver=cp.CLARABEL)
            continue
        limited = convex.solve(solver=cp.CLARABEL)
        assert limited.objective == pytest.approx(best, rel=1e-5, abs=1e-5)
        for policy in (limited.mixed_policy(), limited.randomised_policy()):
            found = evaluate(policy, problem)
            assert found.failure_probability <= budget + 1e-6
            assert found.objective <= best + 1e-5 * (1.0 + best)


@pytest.mark.parametrize("seed", range(40))
def test_expressions_are_what_evaluation_says(seed: int) -> None:
    model = drawn(seed)
    least = solve(MaxProb(model, "a")).failure_probability
    if least >= 1.0:
        return
    rng = np.random.default_rng([26, seed])
    fuel = rng.integers(0, 3, size=model.n_pairs).astype(float)
    counted = {
        "fuel": secondary_cost(fuel),
        "end": end_probability("pit") + 0.25,
        "b": 2.0 * visits("b"),
        "goal": goal_probability(),
        "failing": failure_probability() / 2.0,
    }
    limits = {name: quantity <= 1e6 for name, quantity in counted.items() if name != "goal"}
    limits["goal"] = counted["goal"] >= 0.0
    start = {"a": 0.75, "b": 0.125, "g": 0.125}
    for criterion in (MCMP, S3P):
        problem = criterion(model, start, min(least + 0.3, 1.0), constraints=limits)
        program = problem.program()
        measure = program.solve()
        found = evaluate(measure.randomised_policy(), problem)
        for name, quantity in counted.items():
            coefficients, constant = program.expression(quantity)
            value = float(coefficients @ measure.visits) + constant
            assert found.secondary_costs[name] == pytest.approx(value, rel=1e-7, abs=1e-7)


def test_visits_of_a_state_are_its_outflow_or_its_arrivals() -> None:
    program = MCMP(SLIP, {"s": 0.5, "pit": 0.25, "g": 0.25}, 0.5).program()
    x = program.solve().visits
    assert program.visits("s") @ x == pytest.approx(1.0)  # a half start, each goes round once
    assert program.visits("pit") @ x == pytest.approx(0.25)
    assert program.visits("g") @ x == pytest.approx(0.75)


def test_expressions_of_a_ratio_are_scaled_by_themselves() -> None:
    problem = S3P(TURNS, "s", 0.3)
    convex = problem.program().to_cvxpy()
    bound = cp.Parameter(value=0.5)
    convex.constraints["seldom"] = convex.visits("s", "go") - 0.25 <= bound - 0.15
    measure = convex.solve(solver=cp.CLARABEL)
    limited = S3P(TURNS, "s", 0.3, constraints={"go": end_probability("pit") <= 0.3 * 0.6})
    assert measure.objective == pytest.approx(solve(limited).objective, rel=1e-6)
    convex.constraints["seldom"] = convex.visits("s", "go") <= 0.1 * convex.visits("s") + bound
    convex.objective = convex.expression(expected_cost() + 3.0 * visits("t"))
    measure = convex.solve(solver=cp.CLARABEL)
    x = measure.visits
    program = problem.program()
    within = program.visits("s", "go") @ x - 0.1 * program.visits("s") @ x
    assert within <= 0.5 + 1e-6


def test_visits_that_no_policy_comes_to_keep_no_row() -> None:
    model = model_of(
        {
            "s": {"go": [(1.0, "g", 1.0)]},
            "a": {"round": [(1.0, "b", 0.0)], "out": [(1.0, "g", 1.0)]},
            "b": {"round": [(1.0, "a", 0.0)]},
        }
    )
    convex = MCMP(model, "s", 0.5).program().to_cvxpy()
    convex.constraints["often"] = convex.visits("a", "round") >= 1.0
    with pytest.raises(SolverError, match="'often' is kept only by visits that go round"):
        convex.solve(solver=cp.CLARABEL)
    del convex.constraints["often"]
    convex.objective = convex.objective - cp.sqrt(convex.visits("a", "round"))
    convex.constraints["seldom"] = convex.visits("a") <= 4.0
    with pytest.raises(SolverError, match="the objective's value is kept only by visits that go"):
        convex.solve(solver=cp.CLARABEL)


def test_two_programs_share_one_budget() -> None:
    depot = model_of(
        {
            "s": {
                "road": [(0.99, "g", 9.0), (0.01, "pit", 9.0)],
                "alley": [(0.9, "g", 4.0), (0.1, "pit", 4.0)],
            },
            "pit": {},
        }
    )
    one, other = MCMP(depot, "s", 1.0).program(), MCMP(SLIP, "s", 1.0).program()
    a, b = one.to_cvxpy(), other.to_cvxpy()
    shared = a.expression(failure_probability()) + b.expression(failure_probability()) <= 0.05
    rows = [*a.constraints.values(), *b.constraints.values(), shared]
    cp.Problem(cp.Minimize(a.objective + b.objective), rows).solve(solver=cp.CLARABEL)
    first, second = a.measure(), b.measure()
    assert first.objective == pytest.approx(9.0 - 5.0 * 4.0 / 9.0, rel=1e-6)  # 0.05 all its own
    assert second.objective == pytest.approx(2.0, rel=1e-6)
    assert max(first.residual, second.residual) <= 1e-6
    assert evaluate(first.mixed_policy(), MCMP(depot, "s", 1.0)).failure_probability == (
        pytest.approx(0.05, abs=1e-6)
    )


def test_visits_of_an_action_are_counted_within_a_horizon() -> None:
    problem = MCMP(TURNS, "s", 1.0, give_up="dead_ends", horizon=3)
    program = problem.program()
    convex = program.to_cvxpy()
    convex.constraints["later"] = convex.visits("s", "go") <= 0.5
    measure = convex.solve(solver=cp.CLARABEL)
    assert program.visits("s", "go") @ measure.visits <= 0.5 + 1e-6
    free = program.solve()
    assert program.visits("s", "go") @ free.visits == pytest.approx(1.0)
    with pytest.raises(ModelError, match="no action 'fly'"):
        program.visits("s", "fly")


def test_any_visits_make_a_measure() -> None:
    for problem in (MCMP(SLIP, "s", 0.2), S3P(TURNS, "s", 0.05)):
        program = problem.program()
        solved = program.solve()
        given = program.measure(solved.visits)
        assert given.objective == solved.objective
        assert given.optimal_value_from_dual is None
        assert given.residual == solved.residual
        scaled = np.append(solved.visits * 3.0, 3.0)
        if program.ratio:
            assert program.measure(scaled).objective == pytest.approx(solved.objective)
        twice = program.measure(2.0 * solved.visits)
        assert twice.residual > 0.5
        found = evaluate(twice.mixed_policy(), problem)
        assert found.objective == pytest.approx(solved.objective, rel=1e-7)
        with pytest.raises(ModelError, match="finite numbers"):
            program.measure(solved.visits[1:])
        with pytest.raises(ModelError, match="x must be numbers, not 'often'"):
            program.measure("often")


def test_one_action_in_each_state_by_whole_numbers() -> None:
    model = model_of(
        {
            "s": {
                "road": [(0.99, "g", 9.0), (0.01, "pit", 9.0)],
                "alley": [(0.9, "g", 4.0), (0.1, "pit", 4.0)],
            },
            "pit": {},
        }
    )
    problem = MCMP(model, "s", 0.05)
    convex = problem.program().to_cvxpy()
    chosen = cp.Variable(2, boolean=True)
    for k, action in enumerate(("road", "alley")):
        convex.constraints[f"open {action}"] = convex.visits("s", action) <= chosen[k]
    convex.constraints["one"] = cp.sum(chosen) == 1
    measure = convex.solve(solver=cp.SCIPY)
    assert measure.objective == pytest.approx(9.0)
    assert len(measure.mixed_policy().weights) == 1


@pytest.mark.parametrize("ending", ["mps", "lp"])
@pytest.mark.parametrize("limit", ["fuel", "balance.0", "x0"])
def test_a_file_goes_to_another_solver_and_back(ending: str, limit: str, tmp_path) -> None:
    limits = {limit: visits("s") <= 1.9}
    for problem in (MCMP(SLIP, "s", 0.2, constraints=limits), S3P(TURNS, "s", 0.05)):
        program = problem.program()
        program.write(tmp_path / f"program.{ending}")
        solver = highspy.Highs()
        solver.setOptionValue("output_flag", False)
        solver.readModel(str(tmp_path / f"program.{ending}"))
        solver.run()
        solver.writeSolution(str(tmp_path / "program.sol"), 0)
        measure = program.read_solution(tmp_path / "program.sol")
        assert measure.residual <= 1e-6
        assert measure.objective == pytest.approx(solve(problem).objective, rel=1e-6)
    (tmp_path / "other.sol").write_text("nothing here 1.0")
    with pytest.raises(ModelError, match="names no column"):
        program.read_solution(tmp_path / "other.sol")


def test_a_bound_may_be_given_where_it_is_solved() -> None:
    convex = MCMP(SLIP, "s", 1.0).program().to_cvxpy()
    for budget in (0.0, 0.05):
        best = solve(MCMP(SLIP, "s", budget)).objective
        assert convex.solve(cp.CLARABEL, failure=budget).objective == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize("seed", range(10))
def test_duals_of_balance_and_of_rows_make_the_optimum(seed: int) -> None:
    model = drawn(seed)
    start = {"a": 0.75, "b": 0.25}
    least = solve(MaxProb(model, start)).failure_probability
    if least >= 1.0:
        return
    limits = {"fuel": visits("b", "c") <= 50.0}
    problem = MCMP(model, start, min(least + 0.2, 1.0), constraints=limits)
    program = problem.program()
    measure = program.solve()
    paid = sum(measure.duals[row.name] * row.bound for row in program.rows)
    if not (
        program.columns("a") and program.columns("b")
    ):  # one is a dead-end, charged at the start
        return
    worth = 0.75 * measure.value("a") + 0.25 * measure.value("b") - paid
    assert worth == pytest.approx(measure.objective, rel=1e-7, abs=1e-9)
    with pytest.raises(ModelError, match="0 rows of balance"):
        measure.value("g")
    with pytest.raises(ModelError, match="nothing is known of duals"):
        program.measure(measure.visits).value("a")


@pytest.mark.parametrize("field", [river(5, 5), windy_field(8, diagonal=1)])
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_an_interior_point_makes_a_lottery(field: tuple, criterion: type) -> None:
    """What it leaves on pairs that nobody takes is noise, however little balance it breaks."""
    problem = criterion(*field, 0.2)
    stated = problem.program().to_cvxpy()
    whole = cp.Problem(cp.Minimize(stated.objective), [*stated.constraints.values()])
    whole.solve(cp.CLARABEL, ignore_dpp=True)  # else cvxpy 1.5 warns of its parameters
    measure = stated.measure()
    best = solve(problem).objective
    for policy in (measure.mixed_policy(), measure.randomised_policy()):
        found = evaluate(policy, problem)
        assert found.objective == pytest.approx(best, rel=1e-6)
        assert found.failure_probability == pytest.approx(0.2, abs=1e-6)


def test_programs_of_many_units_take_room_for_the_steps_that_occur_alone() -> None:
    """Three costs in 5,003 units: a table of layers by units would take 800 megabytes."""
    table = {
        "s": {
            "fast": [(0.5, "g", 1.0), (0.3, "s", 7.0), (0.2, "d", 1.0)],
            "slow": [(0.9, "g", 5003.0), (0.1, "s", 1.0)],
        },
        "d": {},
    }
    model = SSP.from_transitions(table, goal={"g"}, treat_actionless_as_dead_ends=True)
    few = {"few": visits("s") <= 1.3}
    tracemalloc.start()
    try:
        program = S3P(model, "s", 0.1, cost_cap=20_000.0, constraints=few).program()
        assert program.linear.matrix.shape[1] > 40_000
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
