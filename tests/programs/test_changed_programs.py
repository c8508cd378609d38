"""Programs with bounds and rows of one's own, and the prices of all rows."""

import itertools
import pickle
import re
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import linprog

from drawn_programs import (
    DEPOT,
    REENTERED,
    SLIP,
    TURNS,
    drawn,
    drawn_choices,
    measures_of,
    with_room,
)
from examples.domains.river import river
from formulations import MCMP, S3P, FinitePenalty, MaxProb
from references import mcmp_program
from references.chain import plain_model
from references.linear_program import SHARP
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
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
from ssp_lp.linear_programming import highs
from written_models import table, written

# Programs that are changed: bounds, starts, costs and rows; conflicts; solvers that fail.


TWO_PLACES = written(
    """
    s road: 0.99 g 9, 0.01 pit 9
    s alley: 0.9 g 4, 0.1 pit 4
    t back: 0.5 s 1, 0.5 t 0
    t jump: 0.7 g 1, 0.3 pit 1
    """
)
criteria = pytest.mark.parametrize("criterion", [MCMP, S3P])


def depot(criterion=MCMP):
    return criterion(DEPOT, "depot", 0.05).program().to_cvxpy()


# Starts


@pytest.mark.parametrize("seed", range(12))
def test_starts_are_parameters(seed):
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


def test_a_start_is_given_to_what_was_compiled():
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


def test_what_is_made_for_its_start_is_made_anew():
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


def test_starts_of_a_ratio_are_set_by_hand_or_refused():
    least = S3P(TWO_PLACES, "s").program().to_cvxpy()
    assert least.solve(cp.CLARABEL).objective == pytest.approx(9.0)
    least.start.value = np.array([0.5, 0.5])
    shared = solve(S3P(TWO_PLACES, {"s": 0.5, "t": 0.5})).objective
    assert shared > 9.1
    measure = least.solve(cp.CLARABEL)
    assert measure.objective == pytest.approx(shared, rel=1e-6)
    assert measure.optimal_value_from_dual == pytest.approx(shared, rel=1e-6)
    for start in ("s", "t"):  # of one state and total, not a state of the model; of several
        told = S3P(TWO_PLACES, start, 0.5).program().to_cvxpy()
        told.start.value = np.roll(told.start.value, 1) / 2.0
        with pytest.raises(ModelError, match=r"solve\(start=...\), which rebuilds"):
            told.solve(cp.CLARABEL)
    told = S3P(TWO_PLACES, "s", 0.05).program().to_cvxpy()
    told.constraints["once"] = told.visits("s") <= 1.0
    with pytest.raises(ModelError, match="build a program from the new start"):
        told.solve(cp.CLARABEL, start="t")


# Bounds and costs


@pytest.mark.parametrize(
    ("make", "budgets"),
    [
        (lambda b: MCMP(DEPOT, "depot", b), (0.05, 0.02, 0.08)),
        (lambda b: MCMP(SLIP, "s", b), (1.0, 0.0, 0.05)),
        *((lambda b, c=c: c(TURNS, "s", b), (m, 0.3, 0.1)) for c in (MCMP, S3P) for m in (None, 0)),
    ],
    ids=["depot", "slip", "least", "none", "ratio of least", "ratio of none"],
)
def test_a_sweep_of_budgets_is_stated_once(make, budgets):
    convex = make(budgets[0]).program().to_cvxpy()
    stated = convex.problem
    for budget in (0.05, *budgets[1:]):
        known = solve(make(budget)).objective
        measure = convex.solve(cp.CLARABEL, failure=budget)
        assert measure.objective == pytest.approx(known, rel=1e-6)
        assert measure.program.row("failure").bound == budget
        if budgets[0]:  # else what is best at the least failure alone had been left out
            assert convex.problem is stated
            assert measure.optimal_value_from_dual == pytest.approx(known, rel=1e-6)


def test_bounds_are_parameters_that_may_be_too_tight():
    convex = depot()
    convex.bounds["failure"].value = 0.08
    known = solve(MCMP(DEPOT, "depot", 0.08)).objective
    assert convex.solve(cp.CLARABEL).objective == pytest.approx(known, rel=1e-6)
    convex.bounds["failure"].value = 0.001
    with pytest.raises(InfeasibleError):
        convex.solve(cp.CLARABEL)


@pytest.mark.parametrize("seed", range(16))
def test_costs_are_parameters(seed):
    """The optimum is that of a model with such costs, by the linear program of its definition."""
    rng, choices = np.random.default_rng([28, seed]), drawn_choices(seed)
    if (found := with_room(seed)) is None:
        return
    meaning = {"give_up": "anywhere", "charge_failing_step": False}
    budget, pairs = min(found[1] + 0.2, 1.0), [(s, a) for s in choices for a in choices[s]]
    convex = MCMP(found[0], "a", budget, **meaning).program().to_cvxpy()
    stated, first = convex.problem, convex.solve(cp.CLARABEL)
    for _ in range(3):
        fuel = rng.integers(0, 4, size=len(pairs)).astype(float)
        paid = dict(zip(pairs, fuel.tolist(), strict=True))
        priced = {
            s: {a: [(p, x, paid[s, a]) for p, x, _ in ways] for a, ways in choices[s].items()}
            for s in choices
        }
        program = mcmp_program.program(plain_model(priced, {"g"}), "a", **meaning)
        known = mcmp_program.least_cost(program, budget)
        measure = convex.solve(cp.CLARABEL, objective=secondary_cost(fuel))
        assert measure.minimised == pytest.approx(known, rel=1e-5, abs=1e-5)
        assert convex.problem is stated
    assert measure.optimal_value_from_dual == pytest.approx(known, rel=1e-5, abs=1e-5)
    again = convex.solve(cp.CLARABEL, objective=expected_cost())
    assert again.objective == pytest.approx(first.objective, rel=1e-6, abs=1e-6)


def test_a_constant_of_an_objective_counts():
    convex = MCMP(DEPOT, {"depot": 0.5, "wreck": 0.5}, 0.6).program().to_cvxpy()
    measure = convex.solve(cp.CLARABEL, objective=visits("wreck") + 0.25)
    assert measure.minimised == pytest.approx(0.755, abs=1e-6)
    assert "minimised 0.755" in repr(measure)


# Rows


@pytest.mark.parametrize("seed", range(8))
def test_duals_of_all_rows_prove_the_optimum(seed):
    """Beside the program's own arrays with further rows, by another solver."""
    rng = np.random.default_rng([29, seed])
    if (found := with_room(seed)) is None:
        return
    model, least = found
    for criterion in (MCMP, S3P):
        program = criterion(model, "a", min(least + 0.2, 1.0)).program()
        linear, convex, n = program.linear, program.to_cvxpy(), program.process.n_pairs
        seen = {name: program.visits(name) for name in "abcd" if program.columns(name)}
        at = program.solve().visits
        cost, constant, rows, upper = linear.cost.copy(), 0.0, [], []
        if rng.random() < 0.5:
            fuel = secondary_cost(rng.integers(0, 4, size=model.n_pairs).astype(float)) + 0.25
            taken, constant = program.expression(fuel)
            stated = convex.expression(fuel)
            convex.objective = convex.objective + 2.0 * getattr(stated, "scaled", stated)
            cost[:n] += 2.0 * taken
            constant *= 2.0
        for name in rng.choice(list(seen), size=min(2, len(seen)), replace=False):
            bound = float(seen[name] @ at) * float(rng.choice([0.9, 1.0, 1.1]))
            sense, counted = rng.choice(["<", ">", "="]), convex.visits(name)
            made = {"<": counted <= bound, ">": counted >= bound, "=": counted == bound}
            convex.constraints[f"own {name}"] = made[sense]
            for sign in {"<": (1.0,), ">": (-1.0,), "=": (1.0, -1.0)}[sense]:
                rows.append(sign * np.append(seen[name], [-bound] if program.ratio else []))
                upper.append(0.0 if program.ratio else sign * bound)
        equal, matrix = linear.equality, linear.matrix.toarray()
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


def test_nothing_is_proved_by_rows_that_are_not_linear():
    convex = depot()
    convex.constraints["even"] = cp.sum_squares(convex.x) <= 4.0
    measure = convex.solve(cp.CLARABEL)
    assert measure.optimal_value_from_dual is None
    assert np.isnan(measure.gap)
    del convex.constraints["even"]
    room = cp.Variable(nonneg=True)
    convex.constraints["room"] = convex.visits("depot", "road") <= 0.5 + room
    convex.objective = convex.objective + 3.0 * room
    assert convex.solve(cp.CLARABEL).optimal_value_from_dual is None
    convex = depot()
    convex.objective = convex.objective + cp.sum_squares(convex.x)
    assert convex.solve(cp.CLARABEL).optimal_value_from_dual is None


def test_rows_that_are_added_have_slack_and_prices():
    convex = MCMP(SLIP, "s", 0.2).program().to_cvxpy()
    bound = cp.Parameter(value=1.0)
    convex.constraints["once"] = convex.visits("s", "slip") <= bound
    convex.constraints["some"] = convex.visits("s") >= 0.25
    measure = convex.solve(cp.CLARABEL)
    assert measure.slack["once"] == pytest.approx(0.0, abs=1e-6)
    assert measure.slack["some"] == pytest.approx(measure.activity["some"] - 0.25)
    assert measure.duals["some"] == pytest.approx(0.0, abs=1e-6)
    assert "\n  once: 1 <= 1   price 0.5" in repr(measure)
    assert "\n  some: 1.5 >= 0.25   price" in repr(measure)
    bound.value = 1.01
    moved = convex.solve(cp.CLARABEL).objective
    assert (measure.objective - moved) / 0.01 == pytest.approx(measure.duals["once"], rel=1e-4)


def test_rows_of_a_ratio_that_are_added_are_told_as_they_are():
    convex, found = S3P(TURNS, "s", 0.3).program().to_cvxpy(), []
    for limit in (0.5, 0.501):
        convex.constraints["seldom"] = convex.visits("s", "go") <= limit
        found.append(convex.solve(cp.CLARABEL))
        row = found[-1].rows[-1]
        assert (row.name, row.bound) == ("seldom", pytest.approx(limit))
        assert row.spent == pytest.approx(limit, rel=1e-6)
    first, slope = found[0], (found[0].objective - found[1].objective) / 0.001
    assert slope == pytest.approx(first.duals["seldom"], rel=1e-2)
    price = first.duals["seldom"] * float(first.program.process.goal @ first.visits)
    assert first.rows[-1].price == pytest.approx(price, rel=1e-9)


def test_rows_that_are_deleted_or_replaced_are_not_printed_as_kept():
    convex = depot()
    failure = convex.constraints.pop("failure")
    measure = convex.solve(cp.CLARABEL)
    assert measure.objective == pytest.approx(2.8)
    assert "failure" not in repr(measure)
    assert measure.residual <= 1e-9
    convex.constraints["failure"] = convex.expression(failure_probability()) <= 0.02
    measure = convex.solve(cp.CLARABEL)
    assert [(row.name, row.bound) for row in measure.rows] == [("failure", 0.02)]
    known = solve(MCMP(DEPOT, "depot", 0.02))
    assert measure.duals["failure"] == pytest.approx(known.prices["failure"], rel=1e-5)
    convex.constraints["failure"] = failure
    measure = convex.solve(cp.CLARABEL)
    assert measure.optimal_value_from_dual == pytest.approx(6.2222222, rel=1e-6)
    cone = cp.SOC(cp.Constant(0.05), cp.multiply(convex.x, np.array([0.01, 0.1])))
    convex.constraints["failure"] = cone
    measure = convex.solve(cp.CLARABEL)
    assert measure.duals == {}
    assert measure.optimal_value_from_dual is None
    free = MCMP(REENTERED, "a", 0.5).program().to_cvxpy()
    del free.constraints["failure"]
    assert "failure" not in repr(free.solve(cp.CLARABEL))


def test_rows_of_many_entries_are_told_one_by_one():
    convex = depot()
    convex.constraints["each"] = convex.x <= np.array([0.6, 0.44])
    measure = convex.solve(cp.CLARABEL)
    slack = [measure.slack["each[0]"], measure.slack["each[1]"]]
    assert slack == pytest.approx([0.04, 0.0], abs=1e-6)
    convex.constraints["many"] = cp.multiply(np.ones(50), convex.x[0]) <= 3.0
    assert repr(convex.solve(cp.CLARABEL)).splitlines()[-1] == "  and 33 more rows"


def test_lotteries_of_a_solvers_visits_keep_its_rows():
    """Noise is left out where it is, not every share that is as small; or the row is named."""
    idle = written(
        """
        s wait: s 1e-9
        s good: g 1
        s rash: 0.5 g 0, 0.5 pit 0
        u loop: u 1
        u leave: s 1
        """
    )
    rare = written(f"s go: {1 - 1.1e-4} g 1, 1.1e-4 r 1\n r sink: pit 0\n r save: g 9")

    def lottery(problem, **taken):
        program = problem.program()
        x = np.zeros(program.process.n_pairs)
        for pair, times in taken.items():
            x[program.column(*pair.split("_"))] = times
        return program.measure(x).mixed_policy()

    problem = MCMP(idle, "s", 0.4)
    policy = lottery(problem, s_wait=4e6, s_good=0.2 + 2e-9, s_rash=0.8, u_loop=5e-8)
    assert evaluate(policy, problem).failure_probability == pytest.approx(0.4, rel=1e-7)
    with pytest.raises(SolverError, match=r"lottery of these visits breaks 'failure' by 1\.0e-01"):
        lottery(MCMP(rare, "s", 1e-4), s_go=1.0, r_sink=1e-4)


@pytest.mark.parametrize("seed", range(25))
def test_conflicts_are_irreducible(seed):
    """Against every subset of the rows, each solved by itself."""
    rng = np.random.default_rng([27, seed])
    if (found := with_room(seed)) is None:
        return
    names = {"a": visits("a"), "b": visits("b"), "cost": expected_cost()}
    limits = {name: quantity <= 1e6 for name, quantity in names.items()}
    program = MCMP(found[0], "a", 1.0, constraints=limits).program()
    at = program.solve()
    bounds = {n: float(rng.choice([0.5, 0.9, 1.1, 3.0])) * at.activity[n] for n in names}
    bounds = {name: bound for name, bound in bounds.items() if bound > 0.0}
    bounds["failure"] = float(rng.choice([0.2, 0.5, 1.0]))
    program = program.bounded_by(bounds, anew=False)

    def can_be_kept(kept):
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
    assert bool(conflict) == (not can_be_kept({row.name for row in program.rows}))
    if not conflict:
        assert repr(conflict) == "no rows contradict each other"
        return
    assert not can_be_kept({*conflict})
    for name in conflict:
        assert can_be_kept({*conflict} - {name})
        assert f"  {name}: <= {program.row(name).bound:g}" in repr(conflict).splitlines()


@criteria
def test_conflicts_know_rows_that_are_added(criterion):
    convex = depot(criterion)
    convex.constraints["idle"] = convex.visits("depot") <= 5.0
    convex.constraints["seldom"] = convex.visits("depot", "road") <= 0.25
    with pytest.raises(InfeasibleError, match=r"conflict\(\) names the rows"):
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


# Solvers that fail, and what cvxpy refuses


@pytest.mark.parametrize(
    ("solver", "option", "second"),
    [
        (None, "solver", "SCIPY"),
        pytest.param(
            "HIGHS",
            "presolve",
            "off",
            marks=pytest.mark.skipif("HIGHS" not in cp.installed_solvers(), reason="cvxpy < 1.6"),
        ),
    ],
)
def test_another_solver_is_asked_or_highs_without_presolve(solver, option, second, monkeypatch):
    real, seen, failures = cp.Problem.solve, [], [True]

    def failing(*arguments, **options):
        seen.append(options.get(option))
        if failures:
            failures.pop()
            raise cp.SolverError("no luck")
        return real(*arguments, **options)

    monkeypatch.setattr(cp.Problem, "solve", failing)
    assert depot().solve(solver).objective == pytest.approx(6.2222222)
    assert seen == [None, second]
    failures += [True, True]
    with pytest.raises(SolverError, match="no luck"):
        depot().solve(solver)


def test_a_broken_budget_is_asked_again_and_tighter(monkeypatch):
    model = written(f"x fast: {1 - 1e-4} g 1, 1e-4 d 1\n x slow: g 2")
    convex = MCMP(model, "x", 5e-5).program().to_cvxpy()
    convex.constraints["idle"] = convex.visits("x") <= 5.0
    real, seen, wrong = cp.Problem.solve, [], [1]

    def badly(problem, *arguments, **options):
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


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (lambda x: cp.square(x[0]) >= 0.16, r"constraint 'own' is not convex .*concave one"),
        (lambda x: visits("depot") <= 1.0, r"'own' must compare expressions of cvxpy, such as"),
        (lambda x: x[0] <= cp.Parameter(name="p"), "parameter 'p' has no value"),
    ],
    ids=["concave", "no expression", "no value"],
)
def test_rows_that_cvxpy_refuses_are_named(row, words):
    convex = depot()
    convex.constraints["own"] = row(convex.x)
    with pytest.raises(ModelError, match=words):
        convex.solve()


def test_what_cvxpy_refuses_is_said_in_words():
    convex = depot()
    with pytest.raises(ModelError, match="options of the solver"):
        convex.solve(cp.CLARABEL, failur=0.2)
    with pytest.raises(ModelError, match="failure must be a number"):
        convex.solve(cp.CLARABEL, failure="much")
    with pytest.raises(SolverError, match="NOPE"):
        convex.solve("NOPE")
    convex.objective = cp.entr(convex.x)
    with pytest.raises(ModelError, match="the objective must be a scalar"):
        convex.solve()
    convex.objective = cp.sum(cp.entr(convex.x))
    with pytest.raises(ModelError, match="is not convex as cvxpy"):
        convex.solve()
    free = depot()
    free.objective = -cp.sum(free.x)
    free.constraints.clear()
    with pytest.raises(SolverError, match="unbounded"):
        free.solve(cp.CLARABEL)


def test_parameters_go_with_expressions_and_else_the_error_says_so():
    toll = cp.Parameter(nonneg=True, value=0.5)
    fuel = {"depot": {"road": toll}}
    program = MCMP(DEPOT, "depot", 0.05).program()
    for wrong in (
        lambda: toll * visits("depot"),
        lambda: visits("depot") * toll,
        lambda: visits("depot") <= toll,
        lambda: program.expression(secondary_cost(fuel)),
    ):
        with pytest.raises(ModelError, match=r"convex\.expression\(quantity\) \* parameter"):
            wrong()
    assert repr(np.float64(2.0) * visits("depot")) == repr(visits("depot") * 2.0)
    for criterion in (MCMP, S3P):
        convex = depot(criterion)
        row = convex.visits("depot", "road") * toll <= 0.3
        assert row.is_dcp(dpp=True)
        convex.constraints["tolls"] = row
        for value, most in ((0.5, 0.6), (0.45, 0.3 / 0.45)):
            toll.value = value
            measure = convex.solve(cp.CLARABEL)
            assert measure.program.visits("depot", "road") @ measure.visits <= most + 1e-6
    with pytest.raises(ModelError, match="must be the left operand"):
        _ = toll * convex.visits("depot", "road")


# From the optimum at another bound or start


@criteria
@pytest.mark.parametrize("seed", range(20))
def test_the_optimum_is_that_of_a_program_that_begins_anew(seed, criterion):
    if (found := with_room(seed)) is None:
        return
    (model, least), cap = found, {"cost_cap": 12.0} if criterion is S3P else {}
    program = criterion(model, "a", 1.0, constraints={"seen": visits("a") <= 5.0}, **cap).program()
    warm, points = None, []
    for share in (0.5, 0.05, 0.9, 0.2, 0.21):
        within = program.bounded_by({"failure": least + share * (1.0 - least)})
        try:
            cold = within.solve()
        except InfeasibleError:
            with pytest.raises(InfeasibleError):
                within.solve(warm_start=warm)
            continue
        warm = within.solve(warm_start=warm)
        assert warm.objective == pytest.approx(cold.objective, rel=1e-9, abs=1e-9)
        assert max(warm.gap, warm.residual) <= 1e-9
        points.append((within.row("failure").bound, cold.objective, warm.duals["failure"]))
    if criterion is MCMP:  # at kinks one of several duals: a subgradient of the frontier
        for bound, value, dual in points:
            for other, beside, _ in points:
                assert beside >= value - dual * (other - bound) - 1e-7 * (1.0 + abs(value))


def steps_of(program, basis):
    """Iterations of HiGHS's simplex, to the optimum."""
    solved = program if program.reduced is None else program.reduced.program
    solver = highs._solved_by_highs(solved.linear, "highs-simplex", np.inf, basis)
    assert solver.modelStatusToString(solver.getModelStatus()) == "Optimal"
    return int(solver.getInfo().simplex_iteration_count)


@pytest.mark.slow
def test_a_sweep_takes_a_tenth_of_the_steps():
    model, start = river(30, 30, current=0.2)
    program = MCMP(model, start, 0.9, give_up="dead_ends").program()
    warm, anew, saved = program.solve(), 0, 0
    assert warm.solver == "highs-ipx"  # whose crossover ends at a basis, too
    for budget in np.linspace(0.8, 0.1, 20):
        within = program.bounded_by({"failure": float(budget)})
        anew, saved = anew + steps_of(within, None), saved + steps_of(within, warm.basis)
        warm = within.solve(warm_start=warm)
        assert warm.solver == "highs-simplex"
    assert saved <= anew / 10.0


def test_starts_and_costs_change_and_the_basis_stays():
    model = drawn(3)
    program = MCMP(model, "a", 0.9).program()
    dear = MCMP(replace(model, costs=model.costs + 1.0), "a", 0.9).program()
    warm = program.solve("highs-simplex")
    for other in (*map(program.started, ("b", {"b": 0.5, "d": 0.5}, "a")), dear):
        warm = other.solve(warm_start=warm)
        assert warm.objective == pytest.approx(other.solve().objective, rel=1e-9, abs=1e-9)


def test_what_is_no_basis_of_the_program_is_left():
    """Other shapes, other solvers' answers, and any nonsense: the answer is the same."""
    program, rng = MCMP(TURNS, "s", 0.1).program(), np.random.default_rng(7)
    known, beside = program.solve(), MCMP(DEPOT, "depot", 0.05).program().solve()
    drawn_bases = [rng.permutation(known.basis) for _ in range(20)]
    zeros = np.zeros_like(known.basis)
    for basis in (None, beside.basis, zeros, zeros + 1, *drawn_bases):
        found = program.solve(warm_start=replace(known, basis=basis))
        assert found.objective == pytest.approx(known.objective, rel=1e-9)
        assert found.gap <= 1e-9
    assert program.solve("cvxpy").basis is None
    assert program.solve("cvxpy", warm_start=known).solver == "cvxpy"
    told = S3P(TURNS, "s", 0.1).program()
    assert told.solve(warm_start=known).objective == pytest.approx(told.solve().objective)


def test_bounds_that_contradict_are_told_from_a_basis_too():
    program = MCMP(TURNS, "s", 0.3, constraints={"seldom": visits("s") <= 9.0}).program()
    warm = pickle.loads(pickle.dumps(program.solve()))  # noqa: S301
    with pytest.raises(InfeasibleError):
        program.bounded_by({"failure": 1e-6}).solve(warm_start=warm)
    again = program.bounded_by({"failure": 0.2})
    assert again.solve(warm_start=warm).objective == pytest.approx(again.solve().objective)


# Prices, values, slack and ranges by name: each beside what it means.


LIMIT = {"rare": visits("depot") <= 40.0}


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_one_price_has_one_name(criterion):
    problem = criterion(DEPOT, "depot", failure_budget=0.05, constraints=LIMIT)
    measure, solution = problem.program().solve(), solve(problem)
    assert measure.prices["failure"] == pytest.approx(solution.prices["failure"], rel=1e-9)
    assert measure.duals["failure"] == pytest.approx(solution.budget_slope, rel=1e-9)
    price, dual = f"{measure.prices['failure']:.6g}", f"{measure.duals['failure']:.6g}"
    more = f" of the ratio: {dual} for another unit of the bound" if criterion is S3P else ""
    assert f"failure: 0.05 <= 0.05   price {price}{more}" in repr(measure).splitlines()[2]
    found = evaluate(measure.randomised_policy(), problem)
    assert measure.activity["failure"] == pytest.approx(found.failure_probability, rel=1e-9)
    assert measure.slack["rare"] == pytest.approx(39.0)


@pytest.mark.parametrize("seed", range(8))
def test_the_start_and_the_bounds_pay_for_the_optimum_by_the_prices_of_solutions(seed):
    for problem, measure in measures_of(seed):
        program, prices = measure.program, solve(problem).prices
        for row in measure.rows:
            assert measure.slack[row.name] == row.bound - row.spent
            assert row.price * measure.slack[row.name] == pytest.approx(0.0, abs=1e-7)
            if row.spent > 0.0 and prices.get(row.name, 0.0) > 0.0:
                assert row.price == pytest.approx(prices[row.name], rel=1e-7)
        begun = float(program.process.start @ measure.values.states)
        left = begun - sum(row.price * row.bound for row in measure.rows)
        if program.ratio:
            assert left == pytest.approx(0.0, abs=1e-8 * max(measure.objective, 1.0))
        else:
            worth = program.sense.stated(left)
            assert worth == pytest.approx(measure.objective, rel=1e-7, abs=1e-8)
        excess = measure.values.reduced_costs
        assert excess.min() >= -1e-8 * (1.0 + abs(begun))
        assert float(np.abs(excess * measure.visits).max()) <= 1e-7 * (1.0 + abs(begun))
        (line,) = (line for line in repr(measure).splitlines() if line.startswith("  c* "))
        first, second = map(float, re.search(r"\((\S+) - (\S+)\)", line).groups())
        assert first - second == pytest.approx(left, abs=1e-7 * (1.0 + abs(first)))


@pytest.mark.parametrize("seed", range(10))
def test_duals_of_balance_and_of_rows_make_the_optimum(seed):
    start = {"a": 0.75, "b": 0.25}
    if (found := with_room(seed, start)) is None:
        return
    limits = {"fuel": visits("b", "c") <= 50.0}
    program = MCMP(found[0], start, min(found[1] + 0.2, 1.0), constraints=limits).program()
    measure = program.solve()
    paid = sum(measure.duals[row.name] * row.bound for row in program.rows)
    if program.columns("a") and program.columns("b"):  # else one is a dead-end, charged at once
        worth = 0.75 * measure.values["a"] + 0.25 * measure.values["b"] - paid
        assert worth == pytest.approx(measure.objective, rel=1e-7, abs=1e-9)
    with pytest.raises(ModelError, match="0 rows of balance"):
        measure.values.at("g")
    assert program.measure(measure.visits).values is None


def least_from(price, actions):
    """The least cost and price of failing from each state, over all choices (give up: price)."""
    best, names = dict.fromkeys(actions, np.inf), list(actions)
    stops = {"give up": [(1.0, "pit", 0.0)]}
    for taken in itertools.product(*((actions[name] | stops).values() for name in names)):
        moves, paid = np.eye(len(names)), np.zeros(len(names))
        for i, outcomes in enumerate(taken):
            for p, to, cost in outcomes:
                paid[i] += p * (cost + price * (to == "pit"))
                if to in names:
                    moves[i, names.index(to)] -= p
        if abs(np.linalg.det(moves)) > 1e-9:
            for name, value in zip(names, np.linalg.solve(moves, paid), strict=True):
                best[name] = min(best[name], value)
    return best


@pytest.mark.parametrize("budget", [0.05, 0.12, 0.5])
def test_values_of_states_are_the_least_of_all_policies_at_the_price(budget):
    actions = table(
        """
        a x: 0.5 a 1, 0.4 b 1, 0.1 pit 1
        a y: 0.9 g 9, 0.1 b 2
        b x: 0.7 g 1, 0.3 pit 1
        b y: a 0
        b z: 0.3 b 0.5, 0.65 g 4, 0.05 pit 4
        """
    )
    problem = MCMP(model_of(actions), "a", budget, give_up="anywhere", charge_failing_step=False)
    solution, measure = solve(problem), problem.program().solve()
    price = solution.prices["failure"]
    known = least_from(price, actions)
    ahead = known | {"pit": price, "g": 0.0}
    for values, name in itertools.product((solution.values, measure.values), actions):
        assert values[name] == pytest.approx(known[name], rel=1e-9)
        for action, outcomes in actions[name].items():
            follows = sum(p * (cost + ahead[to]) for p, to, cost in outcomes)
            assert values.at(name, action) == pytest.approx(follows, rel=1e-8)
            excess = values.advantage(name, action)
            assert excess == pytest.approx(follows - known[name], abs=1e-8)
        assert values.advantage(name, GIVE_UP) == pytest.approx(price - known[name], abs=1e-8)


def test_values_of_a_solution_are_those_of_its_penalty():
    for name in "abcd":
        solution = solve(FinitePenalty(drawn(3), name, 5.0))
        assert solution.values[name] == pytest.approx(solution.objective, rel=1e-9, abs=1e-9)
    probability = solve(MaxProb(REENTERED, "a"))
    assert probability.values["a"] == pytest.approx(1.0 - probability.objective, abs=1e-9)
    with pytest.raises(ModelError, match="'nowhere' is not a state"):
        probability.values["nowhere"]


def test_values_of_case_s_are_the_cost_less_what_success_earns():
    solution = solve(S3P(DEPOT, "depot", failure_budget=0.05))
    optimum, price = solution.objective, solution.prices["failure"]
    for action, value in (
        ("road", 0.99 * (9.0 - optimum) + 0.01 * price),
        ("alley", 0.9 * (3.0 - optimum) + 0.1 * price),
        (None, 0.05 * price),
    ):
        asked = ("depot",) if action is None else ("depot", action)
        assert solution.values.at(*asked, cost=0.0) == pytest.approx(value, rel=1e-9)
        assert solution.values.at(*asked) == solution.values.at(*asked, cost=0.0)
    with pytest.raises(ModelError, match=r"rows of balance at this cost: .* 's' at cost 0"):
        solve(S3P(TURNS, "s", failure_budget=0.2)).values["s"]


@pytest.mark.parametrize("price", [10**400, float("nan"), float("inf"), "1", None])
def test_values_at_what_is_no_price_are_refused(price):
    program = S3P(DEPOT, "depot", failure_budget=0.05).program()
    with pytest.raises(ModelError, match="failure must be a finite number"):
        program.values_at({"failure": price})
    with pytest.raises(ModelError, match="ratio must be a finite number"):
        program.values_at({"failure": 1.0}, price)


@pytest.mark.slow
def test_prices_hold_within_their_ranges():
    ranges = MCMP(DEPOT, "depot", 0.05, constraints=LIMIT).program().ranges()
    assert ranges["failure"] == pytest.approx((0.01, 0.1))
    assert ranges["rare"] == pytest.approx((1.0, np.inf))
    for _, at in itertools.chain.from_iterable(map(measures_of, (*range(6), 75))):
        program = at.program
        if program.ratio:
            with pytest.raises(ModelError, match="trace_frontier"):
                program.ranges()
            continue
        for name, (low, high) in program.ranges().items():
            bound = program.row(name).bound
            assert low - 1e-9 <= bound <= high + 1e-9
            for other in (low + 1e-3 * (bound - low), bound + 0.999 * (min(high, 1e3) - bound)):
                if abs(other - bound) < 1e-6 or (name == "failure" and other > 1.0):
                    continue
                moved = program.bounded_by({name: other}).solve().objective
                change = program.sense.stated(at.objective) - program.sense.stated(moved)
                worth = at.duals[name] * (other - bound)
                if at.activity[name] < bound - 1e-9:  # then it has no price
                    assert abs(change) <= 1e-7 * (1.0 + abs(moved))
                assert change <= worth + 1e-6 * (1.0 + abs(worth))


def test_a_frame_has_a_row_for_each_column():
    measure = MCMP(DEPOT, "depot", 0.05).program().solve()
    frame = measure.to_frame()
    assert frame["action"].tolist() == ["road", "alley"]
    assert frame["probability"].tolist() == pytest.approx([5.0 / 9.0, 4.0 / 9.0])
    assert frame["value"].tolist() == pytest.approx([measure.values["depot"]] * 2)
    assert frame["advantage"].tolist() == pytest.approx([0.0, 0.0], abs=1e-9)
    given = measure.program.measure(measure.visits).to_frame()
    assert list(given.columns) == ["state", "action", "cost", "visits", "probability"]
    free = MCMP(REENTERED, "a", 0.0).program().solve().to_frame()
    assert free["visits"].tolist() == pytest.approx([0.0, 2.0, 0.0, 1.0])
    assert free["advantage"].tolist() == pytest.approx([0.0, 0.0, 3.0, 0.0])


def test_small_programs_are_written_in_full():
    """One decision: two actions, the scale t, and the normaliser of case S."""
    program = S3P(DEPOT, "depot", 0.05).program()
    assert str(program).splitlines() == [
        "S3P, failure budget 0.05",
        "  minimise    <cost, x>",
        "  subject to  balance: outflow(x) - inflow(x) = t start   (1 rows)",
        "              failure:    <failure, x> <= 0.05 t",
        "              normaliser: <goal, x> = 1   (its dual is c*)",
        "              x >= 0, t >= 0   (3 columns, 8 entries)",
        "              x: visits times the scale t, so that <cost, x> is the cost given success",
        "in full",
        "                            minimise  depot at cost 0  failure  normaliser",
        "  (depot, road) at cost 0       8.91                1     0.01        0.99",
        "  (depot, alley) at cost 0       2.7                1      0.1         0.9",
        "  t                                                -1    -0.05",
        "                                                  = 0     <= 0         = 1",
    ]
    told = repr(program.solve())
    scale = "  normaliser: <goal, x> = 1   dual c*, at the scale t = 1 / 0.95 = 1.05263"
    assert told.splitlines()[-1] == scale
    wide = S3P(TURNS, "s", 0.05).program()
    assert str(wide) == repr(wide)


def test_latex_is_the_program():
    told = MCMP(DEPOT, "depot", 0.05).program().to_latex()
    told = told.replace("(depot, road)", "r").replace("(depot, alley)", "a")
    assert told.splitlines() == [
        r"\begin{aligned}",
        r"\min_{x \ge 0} \quad & 8.96\,x_{\text{r}} + 2.8\,x_{\text{a}} \\",
        r"& x_{\text{r}} + x_{\text{a}} = 1 && \text{depot} \\",
        r"& 0.01\,x_{\text{r}} + 0.1\,x_{\text{a}} \le 0.05 && \text{failure}",
        r"\end{aligned}",
    ]
    told = S3P(DEPOT, "depot", 0.05).program().to_latex()
    told = told.replace("(depot, road)", "r").replace("(depot, alley)", "a")
    assert told.replace(" at cost 0", "").splitlines() == [
        r"\begin{aligned}",
        r"\min_{x \ge 0,\ t \ge 0} \quad & 8.91\,x_{\text{r}} + 2.7\,x_{\text{a}} \\",
        r"& x_{\text{r}} + x_{\text{a}} - t = 0 && \text{depot} \\",
        r"& 0.01\,x_{\text{r}} + 0.1\,x_{\text{a}} - 0.05\,t \le 0 && \text{failure} \\",
        r"& 0.99\,x_{\text{r}} + 0.9\,x_{\text{a}} = 1 && \text{normaliser (its dual is c*)}",
        r"\end{aligned}",
    ]
    large = S3P(TURNS, "s", 0.05, constraints={"50 % & more": visits("s") <= 9.0})
    told = large.program().to_latex()
    assert r"\min_{x \ge 0,\ t \ge 0} \quad & \langle \text{cost}, x \rangle \\" in told
    assert r"\langle \text{inflow}, x \rangle = t \text{start} &&" in told
    assert r"\langle \text{failure}, x \rangle \le 0.05 \, t && \text{failure}" in told
    assert r"\langle \text{goal}, x \rangle = 1 && \text{normaliser (its dual is c*)}" in told
    assert r"50 \% \& more" in told
    odd = MCMP(DEPOT, "depot", 0.05, constraints={"x^2 ~ y": visits("depot") <= 9.0})
    assert r"\text{x\^{}2 \~{} y}" in odd.program().to_latex()
