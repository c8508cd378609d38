"""Programs that are changed: bounds, starts, costs and rows; conflicts; solvers that fail."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import linprog
from test_programs import DEPOT
from test_stated_programs import REENTERED, SLIP, TURNS, defined, drawn

from formulations import MCMP, S3P, MaxProb
from references.linear_program import SHARP
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
    with pytest.raises(ModelError, match="'nowhere' is not a state"):
        convex.solve(start="nowhere")


def test_what_is_made_for_its_start_is_made_anew() -> None:
    ends = MCMP(TWO_PLACES, "s", 0.6).program().to_cvxpy()
    half = {"s": 0.5, "pit": 0.5}
    assert ends.solve(cp.CLARABEL, start=half).objective == pytest.approx(2.0, rel=1e-6)
    assert ends.solve(cp.CLARABEL, start="g").objective == pytest.approx(0.0, abs=1e-6)
    steps = MCMP(TWO_PLACES, "s", 0.5, horizon=3).program()
    for start in ("t", {"s": 0.5, "t": 0.5}):
        for made in (steps, S3P(TWO_PLACES, "s", 0.5).program(), steps.started("t")):
            again = made.started(start).bounded_by({"failure": 0.25})
            posed = replace(made.remade.args[0], start=start, failure_budget=0.25)
            known = solve(posed).objective
            assert again.solve().objective == pytest.approx(known, rel=1e-9)
            found = made.to_cvxpy().solve(cp.CLARABEL, start=start, failure=0.25)
            assert found.objective == pytest.approx(known, rel=1e-6)


def test_starts_of_a_ratio_are_set_by_hand_or_refused() -> None:
    least = S3P(TWO_PLACES, "s").program().to_cvxpy()
    assert least.solve(cp.CLARABEL).objective == pytest.approx(9.0)
    least.start.value = np.array([0.5, 0.5])
    shared = solve(S3P(TWO_PLACES, {"s": 0.5, "t": 0.5})).objective
    assert shared > 9.1
    measure = least.solve(cp.CLARABEL)
    assert measure.objective == pytest.approx(shared, rel=1e-6)
    assert measure.optimal_value_from_dual == pytest.approx(shared, rel=1e-6)
    told = S3P(TWO_PLACES, "s", 0.05).program().to_cvxpy()
    told.start.value = np.roll(told.start.value, 1)
    with pytest.raises(ModelError, match=r"solve\(start=...\) makes the program anew"):
        told.solve(cp.CLARABEL)
    told = S3P(TWO_PLACES, "s", 0.05).program().to_cvxpy()
    told.constraints["once"] = told.visits("s") <= 1.0
    with pytest.raises(ModelError, match="make another from there"):
        told.solve(cp.CLARABEL, start="t")


def test_lotteries_of_a_solvers_visits_keep_its_rows() -> None:
    """Noise is left out where it is, not every share that is as small; or the row is named."""
    idle = model_of(
        {
            "s": {
                "wait": [(1.0, "s", 1e-9)],
                "good": [(1.0, "g", 1.0)],
                "rash": [(0.5, "g", 0.0), (0.5, "pit", 0.0)],
            },
            "u": {"loop": [(1.0, "u", 1.0)], "leave": [(1.0, "s", 1.0)]},
            "pit": {},
        }
    )
    problem = MCMP(idle, "s", 0.4)
    taken = {("s", "wait"): 4e6, ("s", "good"): 0.2 + 2e-9, ("s", "rash"): 0.8, ("u", "loop"): 5e-8}
    program = problem.program()
    x = np.zeros(program.process.n_pairs)
    for (state, action), times in taken.items():
        x[program.column(state, action)] = times
    found = evaluate(program.measure(x).mixed_policy(), problem)
    assert found.failure_probability == pytest.approx(0.4, rel=1e-7)
    rare = model_of(
        {
            "s": {"go": [(1 - 1.1e-4, "g", 1.0), (1.1e-4, "r", 1.0)]},
            "r": {"sink": [(1.0, "pit", 0.0)], "save": [(1.0, "g", 9.0)]},
            "pit": {},
        }
    )
    program = MCMP(rare, "s", 1e-4).program()
    x = np.zeros(program.process.n_pairs)
    x[program.column("s", "go")], x[program.column("r", "sink")] = 1.0, 1e-4
    with pytest.raises(SolverError, match=r"lottery of these visits breaks 'failure' by 1\.0e-01"):
        program.measure(x).mixed_policy()


@pytest.mark.parametrize("seed", range(40))
def test_duals_of_all_rows_prove_the_optimum(seed: int) -> None:
    """Beside the program's own arrays with further rows, by another solver."""
    rng, model = np.random.default_rng([29, seed]), drawn(seed)
    least = solve(MaxProb(model, "a")).failure_probability
    if least >= 1.0:
        return
    for criterion in (MCMP, S3P):
        program = criterion(model, "a", min(least + 0.2, 1.0)).program()
        linear, convex, n = program.linear, program.to_cvxpy(), program.process.n_pairs
        seen = {name: program.visits(name) for name in "abcd" if program.columns(name)}
        at = program.solve().visits
        cost, rows, upper = linear.cost.copy(), [], []
        if rng.random() < 0.5:
            fuel = rng.integers(0, 4, size=model.n_pairs).astype(float)
            taken, constant = program.expression(secondary_cost(fuel) + 0.25)
            convex.objective = convex.objective + 2.0 * getattr(
                fueled := convex.expression(secondary_cost(fuel) + 0.25), "scaled", fueled
            )
            cost[:n] += 2.0 * taken
            constant *= 2.0
        else:
            constant = 0.0
        for name in rng.choice(list(seen), size=min(2, len(seen)), replace=False):
            spent = float(seen[name] @ at)
            bound, sense = spent * float(rng.choice([0.9, 1.0, 1.1])), rng.choice(["<", ">", "="])
            counted = convex.visits(name)
            made = {"<": counted <= bound, ">": counted >= bound, "=": counted == bound}
            convex.constraints[f"own {name}"] = made[sense]
            for sign in {"<": (1.0,), ">": (-1.0,), "=": (1.0, -1.0)}[sense]:
                beyond = [-bound] if program.ratio else []
                rows.append(sign * np.append(seen[name], beyond))
                upper.append(0.0 if program.ratio else sign * bound)
        equal = linear.equality
        matrix = linear.matrix.toarray()
        known = linprog(
            cost if not program.ratio else np.append(cost[:n], constant),
            np.vstack([matrix[~equal], *rows]),
            np.append(linear.upper[~equal], upper),
            matrix[equal],
            linear.upper[equal],
            options=SHARP,
        )
        if not known.success:
            with pytest.raises((InfeasibleError, SolverError)):
                convex.solve(cp.CLARABEL)
            continue
        value = known.fun + (0.0 if program.ratio else constant)
        measure = convex.solve(cp.CLARABEL)
        reached = measure.objective if measure.minimised is None else measure.minimised
        assert reached == pytest.approx(value, rel=1e-5, abs=1e-5)
        proved = measure.optimal_value_from_dual
        assert proved == pytest.approx(value, rel=2e-5, abs=2e-5)
        assert proved <= value + 1e-9 * (1.0 + abs(value))
        assert measure.gap <= 4e-5
        assert f"c* {proved:.9g} by the prices of all rows" in repr(measure)


def test_nothing_is_proved_by_rows_that_are_not_linear() -> None:
    convex = MCMP(DEPOT, "depot", 0.05).program().to_cvxpy()
    convex.constraints["even"] = cp.sum_squares(convex.x) <= 4.0
    measure = convex.solve(cp.CLARABEL)
    assert measure.optimal_value_from_dual is None
    assert np.isnan(measure.gap)
    del convex.constraints["even"]
    room = cp.Variable(nonneg=True)
    convex.constraints["room"] = convex.visits("depot", "road") <= 0.5 + room
    convex.objective = convex.objective + 3.0 * room
    assert convex.solve(cp.CLARABEL).optimal_value_from_dual is None
    convex = MCMP(DEPOT, "depot", 0.05).program().to_cvxpy()
    convex.objective = convex.objective + cp.sum_squares(convex.x)
    assert convex.solve(cp.CLARABEL).optimal_value_from_dual is None


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
    assert measure.optimal_value_from_dual == pytest.approx(known, rel=1e-5, abs=1e-5)
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


def test_parameters_go_with_expressions_and_else_the_error_says_so() -> None:
    toll = cp.Parameter(nonneg=True, value=0.5)
    how = r"convex\.expression\(quantity\) \* parameter"
    for wrong in (
        lambda: toll * visits("depot"),
        lambda: visits("depot") * toll,
        lambda: visits("depot") <= toll,
        lambda: MCMP(DEPOT, "depot", 0.05).program().expression(
            secondary_cost({"depot": {"road": toll}})
        ),
    ):  # fmt: skip
        with pytest.raises(ModelError, match=how):
            wrong()
    assert repr(np.float64(2.0) * visits("depot")) == repr(visits("depot") * 2.0)
    for criterion in (MCMP, S3P):
        convex = criterion(DEPOT, "depot", 0.05).program().to_cvxpy()
        row = convex.visits("depot", "road") * toll <= 0.3
        assert row.is_dcp(dpp=True)
        convex.constraints["tolls"] = row
        for value, most in ((0.5, 0.6), (0.45, 0.3 / 0.45)):
            toll.value = value
            measure = convex.solve(cp.CLARABEL)
            assert measure.program.visits("depot", "road") @ measure.visits <= most + 1e-6
    assert criterion is S3P
    with pytest.raises(ModelError, match="stands to the left"):
        _ = toll * convex.visits("depot", "road")
