"""Programs that are changed: bounds, starts, costs and rows; conflicts; solvers that fail."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from test_programs import DEPOT
from test_stated_programs import REENTERED, SLIP, TURNS, defined, drawn

from formulations import MCMP, S3P, MaxProb
from small_models import model_of
from ssp_lp import (
    InfeasibleError,
    ModelError,
    SolverError,
    evaluate,
    expected_cost,
    failure_probability,
    secondary_cost,
    solve,
    visits,
)

TWO_PLACES = model_of(
    {
        "s": {
            "road": [(0.99, "g", 9.0), (0.01, "pit", 9.0)],
            "alley": [(0.9, "g", 4.0), (0.1, "pit", 4.0)],
        },
        "t": {
            "back": [(0.5, "s", 1.0), (0.5, "t", 0.0)],
            "jump": [(0.7, "g", 1.0), (0.3, "pit", 1)],
        },
        "pit": {},
    }
)


@pytest.mark.parametrize("seed", range(12))
def test_starts_are_parameters(seed: int) -> None:
    model = drawn(seed)
    for start in ("a", {"b": 0.5, "d": 0.5}, {"a": 0.25, "c": 0.75}):
        try:
            known = solve(problem := MCMP(model, start, 0.9)).objective
            convex = MCMP(model, {"a": 0.5, "b": 0.5}, 0.9).program().to_cvxpy()
        except InfeasibleError:
            continue
        begun = [start] if isinstance(start, str) else list(start)
        if not all(map(convex.program.columns, [*begun, "a", "b"])):
            with pytest.raises(ModelError, match="episode ends where it begins"):
                convex.solve(cp.CLARABEL, start=start)
            continue
        measure = convex.solve(cp.CLARABEL, start=start)
        assert measure.objective == pytest.approx(known, rel=1e-6, abs=1e-6)
        assert measure.optimal_value_from_dual == pytest.approx(known, rel=1e-6, abs=1e-6)
        found = evaluate(measure.mixed_policy(), problem)
        assert found.objective <= known + 1e-6 * (1.0 + known)
        assert measure.program.solve().objective == pytest.approx(known, rel=1e-9, abs=1e-9)


def test_a_start_is_given_to_what_was_compiled() -> None:
    convex = MCMP(TWO_PLACES, "s", 0.05).program().to_cvxpy()
    stated = convex.problem
    for share in (0.0, 0.5, 1.0):
        start = {"s": share, "t": 1.0 - share}
        measure = convex.solve(cp.CLARABEL, start=start, failure=0.1)
        assert measure.objective == pytest.approx(solve(MCMP(TWO_PLACES, start, 0.1)).objective)
        assert convex.problem is stated
    convex.solve(cp.CLARABEL, start="t")
    assert convex.solve(cp.CLARABEL).program.process.start.tolist() == [0.0, 1.0]
    for start in ("g", {"s": 0.5, "pit": 0.5}):
        with pytest.raises(ModelError, match="make another from there"):
            convex.solve(start=start)
    with pytest.raises(ModelError, match="costs are told apart"):
        S3P(TURNS, "s", 0.3).program().to_cvxpy().solve(start="t")
    with pytest.raises(ModelError, match="'nowhere' is not a state"):
        convex.solve(start="nowhere")


@pytest.mark.parametrize("seed", range(16))
def test_costs_are_parameters(seed: int) -> None:
    """The optimum is that of a model with such costs, by the linear program of its definition."""
    rng, model = np.random.default_rng([28, seed]), drawn(seed)
    least = solve(MaxProb(model, "a")).failure_probability
    if least >= 1.0:
        return
    budget = min(least + 0.2, 1.0)
    problem = MCMP(model, "a", budget, give_up="anywhere", charge_failing_step=False)
    convex = problem.program().to_cvxpy()
    stated, first = convex.problem, convex.solve(cp.CLARABEL)
    for _ in range(3):
        fuel = rng.integers(0, 4, size=model.n_pairs).astype(float)
        spent = np.repeat(fuel, np.diff(model.outcome_offsets))
        known, _ = defined(replace(model, costs=spent), budget)
        measure = convex.solve(cp.CLARABEL, objective=secondary_cost(fuel))
        assert measure.minimised == pytest.approx(known, rel=1e-5, abs=1e-5)
        assert convex.problem is stated
    assert measure.optimal_value_from_dual is None
    again = convex.solve(cp.CLARABEL, objective=expected_cost())
    assert again.objective == pytest.approx(first.objective, rel=1e-6, abs=1e-6)


def test_a_constant_of_an_objective_counts() -> None:
    problem = MCMP(DEPOT, {"depot": 0.5, "wreck": 0.5}, 0.6)
    convex = problem.program().to_cvxpy()
    measure = convex.solve(cp.CLARABEL, objective=visits("wreck") + 0.25)
    assert measure.minimised == pytest.approx(0.755, abs=1e-6)
    assert "minimised 0.755" in repr(measure)


def test_a_sweep_begins_at_the_least_failure() -> None:
    for criterion, made in itertools.product((MCMP, S3P), (None, 0.0)):
        convex = criterion(TURNS, "s", made).program().to_cvxpy()
        for budget in (0.05, 0.3, 0.1):
            known = solve(criterion(TURNS, "s", budget)).objective
            measure = convex.solve(cp.CLARABEL, failure=budget)
            assert measure.objective == pytest.approx(known, rel=1e-6)
            assert measure.program.row("failure").bound == budget


def test_rows_that_are_added_have_slack_and_prices() -> None:
    convex = MCMP(SLIP, "s", 0.2).program().to_cvxpy()
    bound = cp.Parameter(value=1.0)
    convex.constraints["once"] = convex.visits("s", "slip") <= bound
    convex.constraints["some"] = convex.visits("s") >= 0.25
    measure = convex.solve(cp.CLARABEL)
    assert measure.slack["once"] == pytest.approx(0.0, abs=1e-6)
    assert measure.slack["some"] == pytest.approx(measure.activity["some"] - 0.25)
    assert measure.duals["some"] == pytest.approx(0.0, abs=1e-6)
    lines = repr(measure).splitlines()
    assert any(line.startswith("  once: 1 <= 1   price 0.5") for line in lines), lines
    assert any(line.startswith("  some: 1.5 >= 0.25   price") for line in lines), lines
    bound.value = 1.01
    moved = convex.solve(cp.CLARABEL).objective
    assert (measure.objective - moved) / 0.01 == pytest.approx(measure.duals["once"], rel=1e-4)


def test_rows_of_a_ratio_that_are_added_are_told_as_they_are() -> None:
    convex = S3P(TURNS, "s", 0.3).program().to_cvxpy()
    for limit in (0.5, 0.501):
        convex.constraints["seldom"] = convex.visits("s", "go") <= limit
        measure = convex.solve(cp.CLARABEL)
        row = measure.rows[-1]
        assert (row.name, row.bound) == ("seldom", pytest.approx(limit))
        assert row.spent == pytest.approx(limit, rel=1e-6)
        if limit == 0.5:
            first = measure
    slope = (first.objective - measure.objective) / 0.001
    assert slope == pytest.approx(first.duals["seldom"], rel=1e-2)
    price = first.duals["seldom"] * float(first.program.process.goal @ first.visits)
    assert first.rows[-1].price == pytest.approx(price, rel=1e-9)


def test_rows_that_are_deleted_or_replaced_are_not_printed_as_kept() -> None:
    convex = MCMP(DEPOT, "depot", 0.05).program().to_cvxpy()
    failure = convex.constraints.pop("failure")
    measure = convex.solve(cp.CLARABEL)
    assert measure.objective == pytest.approx(2.8)
    assert "failure" not in repr(measure)
    assert measure.residual <= 1e-9
    convex.constraints["failure"] = convex.expression(failure_probability()) <= 0.02
    measure = convex.solve(cp.CLARABEL)
    assert [row.name for row in measure.rows] == ["failure"]
    assert measure.rows[0].bound == 0.02
    known = solve(MCMP(DEPOT, "depot", 0.02))
    assert measure.duals["failure"] == pytest.approx(known.prices["failure"], rel=1e-5)
    convex.constraints["failure"] = failure
    measure = convex.solve(cp.CLARABEL)
    assert measure.optimal_value_from_dual == pytest.approx(6.2222222, rel=1e-6)
    free = MCMP(REENTERED, "a", 0.5).program().to_cvxpy()
    del free.constraints["failure"]
    assert "failure" not in repr(free.solve(cp.CLARABEL))


def test_rows_of_many_entries_are_told_one_by_one() -> None:
    convex = MCMP(DEPOT, "depot", 0.05).program().to_cvxpy()
    convex.constraints["each"] = convex.x <= np.array([0.6, 0.44])
    measure = convex.solve(cp.CLARABEL)
    assert measure.slack["each[0]"] == pytest.approx(0.04, abs=1e-6)
    assert measure.slack["each[1]"] == pytest.approx(0.0, abs=1e-6)
    convex.constraints["many"] = cp.multiply(np.ones(50), convex.x[0]) <= 3.0
    told = repr(convex.solve(cp.CLARABEL)).splitlines()
    assert told[-1] == "  and 33 rows more"


@pytest.mark.parametrize("seed", range(25))
def test_conflicts_are_irreducible(seed: int) -> None:
    """Against every subset of the rows, each solved by itself."""
    rng = np.random.default_rng([27, seed])
    model = drawn(seed)
    if solve(MaxProb(model, "a")).failure_probability >= 1.0:
        return
    names = {"a": visits("a"), "b": visits("b"), "cost": expected_cost()}
    limits = {name: quantity <= 1e6 for name, quantity in names.items()}
    program = MCMP(model, "a", 1.0, constraints=limits).program()
    at = program.solve()
    bounds = {n: float(rng.choice([0.5, 0.9, 1.1, 3.0])) * at.activity[n] for n in names}
    bounds = {name: bound for name, bound in bounds.items() if bound > 0.0}
    program = program.bounded_by(
        bounds | {"failure": float(rng.choice([0.2, 0.5, 1.0]))}, anew=False
    )

    def can_be_kept(kept: tuple[str, ...]) -> bool:
        convex = program.to_cvxpy()
        for row in program.rows:
            if row.name not in kept:
                del convex.constraints[row.name]
        try:
            convex.solve()
        except InfeasibleError:
            return False
        return True

    conflict = program.conflict()
    every = tuple(row.name for row in program.rows)
    assert bool(conflict) == (not can_be_kept(every))
    if conflict:
        assert not can_be_kept(tuple(conflict))
        for name in conflict:
            assert can_be_kept(tuple(other for other in conflict if other != name))
            assert f"  {name}: <= {program.row(name).bound:g}" in repr(conflict).splitlines()
    else:
        assert repr(conflict) == "no rows contradict each other"


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_conflicts_know_rows_that_are_added(criterion) -> None:
    convex = criterion(DEPOT, "depot", 0.05).program().to_cvxpy()
    convex.constraints["idle"] = convex.visits("depot") <= 5.0
    convex.constraints["seldom"] = convex.visits("depot", "road") <= 0.25
    with pytest.raises(InfeasibleError, match=r"conflict\(\) names those"):
        convex.solve(cp.CLARABEL)
    conflict = convex.conflict()
    assert conflict == {"failure": "<= 0.05", "seldom": "<= 0.25"}
    assert repr(conflict).splitlines() == [
        "rows that contradict each other:",
        "  failure: <= 0.05",
        "  seldom: <= 0.25",
    ]
    convex.bounds["failure"].value = 0.08
    assert not convex.conflict()
    assert convex.solve(cp.CLARABEL).activity["failure"] <= 0.08 + 1e-6


class Failing:
    """Stands for ``Problem.solve``: it fails the first times that it is called."""

    def __init__(self, times: int, how: Exception | None) -> None:
        self.left, self.how, self.seen, self.real = times, how, [], cp.Problem.solve

    def __call__(self, problem, *arguments, **options):
        self.seen.append(options)
        if self.left > 0:
            self.left -= 1
            if self.how is not None:
                raise self.how
        return self.real(problem, *arguments, **options)


def test_another_solver_is_asked_where_cvxpys_choice_fails(monkeypatch) -> None:
    failing = Failing(1, cp.SolverError("no luck"))
    monkeypatch.setattr(cp.Problem, "solve", lambda self, *a, **k: failing(self, *a, **k))
    convex = MCMP(DEPOT, "depot", 0.05).program().to_cvxpy()
    assert convex.solve().objective == pytest.approx(6.2222222)
    assert [call["solver"] for call in failing.seen] == [None, "SCIPY"]
    failing.left = 2
    with pytest.raises(SolverError, match="no luck"):
        convex.solve()


@pytest.mark.skipif("HIGHS" not in cp.installed_solvers(), reason="as of cvxpy 1.6")
def test_highs_is_asked_again_without_presolve(monkeypatch) -> None:
    failing = Failing(1, cp.SolverError("presolve went wrong"))
    monkeypatch.setattr(cp.Problem, "solve", lambda self, *a, **k: failing(self, *a, **k))
    measure = MCMP(DEPOT, "depot", 0.05).program().to_cvxpy().solve(cp.HIGHS)
    assert measure.objective == pytest.approx(6.2222222)
    assert [call.get("presolve") for call in failing.seen] == [None, "off"]
    failing.left = 2
    with pytest.raises(SolverError, match="presolve went wrong"):
        MCMP(DEPOT, "depot", 0.05).program().to_cvxpy().solve(cp.HIGHS)


def test_a_broken_budget_is_asked_again_and_tighter(monkeypatch) -> None:
    model = model_of(
        {
            "x": {"fast": [(1 - 1e-4, "g", 1.0), (1e-4, "d", 1.0)], "slow": [(1.0, "g", 2.0)]},
            "d": {},
        }
    )
    convex = MCMP(model, "x", 5e-5).program().to_cvxpy()
    convex.constraints["idle"] = convex.visits("x") <= 5.0
    real, seen, wrong = cp.Problem.solve, [], [1]

    def badly(problem, *arguments, **options) -> None:
        real(problem, *arguments, **options)
        seen.append(options)
        if len(seen) in wrong:
            (x,) = problem.variables()
            x.value = x.value + np.array([0.02, -0.02])

    monkeypatch.setattr(cp.Problem, "solve", badly)
    measure = convex.solve(cp.CLARABEL)
    assert len(seen) == 2
    assert seen[1]["tol_feas"] < 1e-9
    assert measure.activity["failure"] <= 5e-5 * (1.0 + 1e-5)
    assert measure.objective == pytest.approx(1.5, rel=1e-6)
    wrong += [3, 4]
    with pytest.raises(SolverError, match=r"breaks 'failure' by 4\.0e-02, relative to its bound"):
        convex.solve(cp.CLARABEL)


def test_what_cvxpy_refuses_is_said_in_words() -> None:
    program = MCMP(DEPOT, "depot", 0.05).program()
    convex = program.to_cvxpy()
    convex.constraints["alley"] = cp.square(convex.x[0]) >= 0.16
    with pytest.raises(ModelError, match=r"constraint 'alley' is not convex .*concave one"):
        convex.solve()
    convex.constraints["alley"] = visits("depot") <= 1.0
    with pytest.raises(ModelError, match=r"'alley' must compare expressions of cvxpy, such as"):
        convex.solve()
    convex.constraints["alley"] = convex.x[0] <= cp.Parameter(name="p")
    with pytest.raises(ModelError, match="parameter 'p' has no value"):
        convex.solve()
    del convex.constraints["alley"]
    with pytest.raises(ModelError, match="option of the solver"):
        convex.solve(cp.CLARABEL, failur=0.2)
    with pytest.raises(ModelError, match="failure must be a number"):
        convex.solve(cp.CLARABEL, failure="much")
    with pytest.raises(SolverError, match="NOPE"):
        convex.solve("NOPE")
    convex.objective = cp.entr(convex.x)
    with pytest.raises(ModelError, match="the objective must be one number"):
        convex.solve()
    convex.objective = cp.sum(cp.entr(convex.x))
    with pytest.raises(ModelError, match="the objective is not convex"):
        convex.solve()
    free = program.to_cvxpy()
    free.objective = -cp.sum(free.x)
    free.constraints.clear()
    with pytest.raises(SolverError, match="unbounded"):
        free.solve(cp.CLARABEL)
