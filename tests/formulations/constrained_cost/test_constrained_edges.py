"""ConstrainedCost beside MCMP, in larger models, its certificates, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from scipy.optimize import linprog

from charged_problems import charged_problems, limits_of
from checks import CLOSE, library_model
from constrained_models import FUEL, RISKY, THREE, TIME, attempt, check
from formulations import MCMP, ConstrainedCost, CostLimit
from small_models import EXACT, model_of
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    LinearProgramming,
    MixedPolicy,
    ModelError,
    SolverError,
    certify,
    cross_check,
    evaluate,
    simulate,
    solve,
    trace_frontier,
    visits,
)
from ssp_lp.column_generation.restricted_master import solve_master
from ssp_lp.column_generation.search import generate
from ssp_lp.linear_programming.highs import solve_with_highs
from ssp_lp.methods.rows import phase_one
from ssp_lp.options import SolveOptions
from ssp_lp.problem import compiled_constrained
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.programs.program_rows import rows_program
from strategies import discounts, often, problems, semantics


def ring_model(n, rng):
    """Live states in free rings of ten, from which dearer actions lead anywhere; some fail."""
    successors = rng.integers(0, n, size=(n, 3, 4))
    state = np.arange(n)
    successors[:, 0] = (state // 10 * 10 + (state + 1) % 10)[:, None]
    successors[:, 1:, 0] = np.where(rng.random((n, 2)) < 0.3, n, successors[:, 1:, 0])
    successors[:, 1:, 1] = np.where(rng.random((n, 2)) < 0.05, n + 1, successors[:, 1:, 1])
    costs = rng.integers(1, 9, size=(n, 3)).astype(float)
    costs[:, 0] = 0.0
    model = SSP.from_arrays(
        pair_offsets=np.append(np.arange(n + 1) * 3, [3 * n] * 2),
        outcome_offsets=np.arange(3 * n + 1) * 4,
        successors=successors.ravel(),
        probabilities=np.full(12 * n, 0.25),
        costs=costs.ravel(),
        goal_states=[n],
        treat_actionless_as_dead_ends=True,
    )
    return model, rng.integers(0, 9, size=3 * n).astype(float)


@pytest.mark.parametrize("n", [1_200, 9_000])
def test_free_rings_in_a_larger_model(n):
    """Evaluations are rough there: rounding must not find that going round for ever is cheap."""
    model, fuel = ring_model(n, np.random.default_rng(5))
    free = solve(MCMP(model, 0, failure_budget=0.25, give_up="dead_ends"))
    for steps, most, method in ((1e6, 40.0, "columns"), (12.0, 30.0, "columns"), (1e6, 40.0, "lp")):
        if method == "lp" and n > 1_200:
            continue
        limits = {"steps": CostLimit(np.ones(3 * n), steps), "fuel": CostLimit(fuel, most)}
        problem = ConstrainedCost(model, 0, limits, failure_budget=0.25, give_up="dead_ends")
        solution = solve(problem, method)
        assert solution.gap <= 1e-9
        certificate = certify(solution)
        assert certificate.accepted, certificate.reason
        assert certificate.gap <= 1e-8
        assert solution.objective >= free.objective * (1.0 - 1e-9)
        assert solution.secondary_costs["steps"] <= steps * (1 + 1e-10)
        assert solution.secondary_costs["fuel"] <= most * (1 + 1e-10)
        for name, price in solution.prices.items():
            spent = {"failure": solution.failure_probability, **solution.secondary_costs}[name]
            allowed = {"failure": 0.25, "steps": steps, "fuel": most}[name]
            assert price * (allowed - spent) <= 1e-8 * solution.objective


@often(60)
@given(problems(), semantics, discounts)
def test_without_limits_it_is_mcmp(drawn, meaning, discount):
    """No limits at all: the same optimum, the same price, the same failure."""
    model = library_model(drawn)
    for budget in (None, 0.3, 1.0):
        setting = {"failure_budget": budget, "discount": discount if budget else None} | meaning
        known = attempt(MCMP(model, drawn.start, **setting))
        found = attempt(ConstrainedCost(model, drawn.start, **setting))
        assert type(known) is type(found)
        if isinstance(found, InfeasibleError):
            assert found.least_failure == pytest.approx(known.least_failure, **EXACT)
            assert str(found) == str(known)
            continue
        assert found.objective == pytest.approx(known.objective, **CLOSE)
        assert found.gap <= 1e-8
        assert set(found.prices) <= {"failure"}


@often(80)
@given(charged_problems(), semantics, discounts)
def test_a_secondary_cost_is_the_cost_of_the_model_that_has_it(drawn_charges, meaning, discount):
    """Of every stationary policy, by every semantics: evaluated with the costs exchanged."""
    drawn, charges = drawn_charges
    model = library_model(drawn)
    limits = limits_of(model, charges, [1.0] * len(charges))
    setting = {"failure_budget": 1.0, "discount": discount} | meaning
    problem = ConstrainedCost(model, drawn.start, limits, **setting)
    first = model.pair_offsets[:-1]
    for shift in range(2):
        chosen = np.where(np.diff(model.pair_offsets) > shift, first + shift, first)
        decision = np.where(np.diff(model.pair_offsets) > 0, chosen, -1)
        found = evaluate(DeterministicPolicy(model, decision), problem).secondary_costs
        for condition in problem.conditions:
            ((_, term),) = condition.terms
            other = MCMP(term.model, drawn.start, **setting)
            policy = DeterministicPolicy(term.model, decision)
            assert found[condition.name] == pytest.approx(
                evaluate(policy, other).objective, **EXACT
            )


def test_the_program_of_a_ratio_with_side_rows():
    """Case S with fuel: 7/20 of the first action and 13/20 of the second, cost 1.65 / 0.965."""
    process = ExplicitProcess(
        pair_offsets=np.array([0, 3]),
        transitions=sp.csr_array((3, 1)),
        start=np.ones(1),
        cost=np.array([1.0, 2.0, 4.0]),
        failure=np.array([0.1, 0.0, 0.0]),
        goal=np.array([0.9, 1.0, 1.0]),
    )
    limits = {"failure": (process.failure, 0.05), "fuel": (np.array([3.0, 1.0, 0.0]), 1.7)}
    program = rows_program(process, limits, ratio=True)
    answer = solve_with_highs(program, "highs-simplex", np.inf)
    objective = 330 / 193
    assert program.cost @ answer.x == pytest.approx(objective, **EXACT)
    assert answer.dual[program.rows["normaliser"]] == pytest.approx(objective, **EXACT)
    assert answer.dual[program.rows["failure"]] == pytest.approx(0.0, abs=1e-12)
    assert answer.dual[program.rows["fuel"]] < 0.0


@pytest.mark.parametrize("seed", range(60))
def test_the_master_program(seed):
    """Weights and prices against another solver, with ties and costs of very different sizes."""
    rng = np.random.default_rng(seed)
    n_rows, n_columns = int(rng.integers(1, 6)), int(rng.integers(1, 30))
    activity = rng.integers(0, 6, size=(n_rows, n_columns)).astype(float)
    cost = rng.integers(0, 9, size=n_columns) * 10.0 ** rng.integers(0, 7, size=n_columns)
    bounds = activity @ rng.dirichlet(np.ones(n_columns)) * rng.choice([1.0, 1.2])
    scales = np.maximum(bounds, 1.0)
    found = solve_master(cost, activity, bounds, scales, elastic=False)
    known = linprog(
        cost, A_ub=activity, b_ub=bounds, A_eq=np.ones((1, n_columns)), b_eq=[1.0], method="highs"
    )
    assert found.value == pytest.approx(known.fun, rel=1e-7, abs=1e-9)
    assert (activity @ found.weights <= bounds + 1e-12 * scales).all()
    assert (found.weights > 0).sum() <= n_rows + 1
    dual = float((cost + found.prices @ activity).min() - found.prices @ bounds)
    assert dual == pytest.approx(found.value, rel=1e-10, abs=1e-9)
    half = solve_master(cost, activity, 0.5 * bounds, scales, elastic=True)
    assert half.value == pytest.approx(float(half.excess.sum()))
    excess = np.maximum(activity @ half.weights - 0.5 * bounds, 0.0) / scales
    assert half.value == pytest.approx(float(excess.sum()), abs=1e-12)
    bound = float((half.prices @ activity).min() - 0.5 * half.prices @ bounds)
    assert bound == pytest.approx(half.value, abs=1e-12)


@pytest.mark.parametrize("elastic", [False, True])
@pytest.mark.parametrize("dear", [1e12, 1e20, 1e60])
@pytest.mark.parametrize("seed", range(5))
def test_a_policy_of_endless_steps_is_as_good_as_none(seed, dear, elastic):
    """On windy grids some policies take 1e20 steps: beside others their weight is 0."""
    rng = np.random.default_rng(seed)
    activity, cost = rng.random((2, 6)) + 0.5, rng.random(6) + 1.0
    bounds = activity @ rng.dirichlet(np.ones(6)) * (0.5 if elastic else 1.0)
    known = solve_master(cost, activity, bounds, bounds, elastic=elastic)
    endless = np.column_stack([activity, [0.0, dear]])
    found = solve_master(np.append(cost, dear), endless, bounds, bounds, elastic=elastic)
    assert found.value == pytest.approx(known.value, rel=1e-9, abs=1e-12)
    assert found.weights[-1] <= 2.0 / dear


@pytest.mark.parametrize("in_between", [0.0, 0.3, 0.9])
def test_stabilised_prices_end_at_the_same_optimum(in_between):
    """How prices are tried decides how long it takes, not what is found."""
    model, fuel = ring_model(300, np.random.default_rng(1))
    limits = {"steps": CostLimit(np.ones(900), 9.0), "fuel": CostLimit(fuel, 24.0)}
    problem = ConstrainedCost(model, 0, limits, failure_budget=0.2)
    instance = compiled_constrained(problem).settled()
    opened = phase_one(instance, instance, SolveOptions(1e-9))
    found = generate(replace(opened, in_between=in_between), SolveOptions(1e-9))
    assert found.finished
    assert found.objective == pytest.approx(solve(problem).objective, rel=1e-9)
    assert found.lower_bound == pytest.approx(found.objective, rel=1e-9)


def test_many_rows_are_thinned_out():
    """Rows are left out while the rest contradict."""
    limits = {f"easy{k}": CostLimit({"a": {"x": 1, "y": 2, "z": 1}}, 1.9) for k in range(4)}
    limits |= {"fuel": CostLimit(FUEL, 1), "time": CostLimit({"a": {"y": 2, "z": 9}}, 1)}
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(THREE, "a", limits))
    assert set(caught.value.conflicting_rows) == {"fuel", "time"}


def test_a_solution_can_be_played():
    """Simulation knows the criterion's semantics."""
    limits = {"fuel": CostLimit({"a": {"fast": 3, "slow": 1}}, 1.3)}
    problem = ConstrainedCost(RISKY, "a", limits, failure_budget=0.01)
    report = simulate(solve(problem).policy, problem, episodes=500, rng=np.random.default_rng(0))
    assert report.episodes == 500


def test_certificates_are_not_taken_in():
    """A policy that breaks a row, a false price and a false value function."""
    limits = {"fuel": CostLimit(FUEL, 3), "time": CostLimit(TIME, 2)}
    solution = solve(ConstrainedCost(THREE, "a", limits))
    members = solution.policy.policies
    cheap = next(m for m in members if evaluate(m, solution.problem).objective == 1)
    greedy = replace(solution, policy=MixedPolicy((cheap,), np.ones(1)))
    assert "spends 4 of 'fuel', 3 allowed" in certify(greedy).reason
    assert not certify(greedy).accepted
    assert certify(replace(solution, prices={"fuel": -1.0, "time": 0.0})).reason
    dear = certify(replace(solution, prices={"fuel": 2.0, "time": 1.0}))
    assert dear.accepted
    assert dear.lower_bound < solution.objective - 0.1
    assert certify(replace(solution, value_function=np.full(1, 99.0))).gap <= 1e-9
    with pytest.raises(ModelError):
        certify(replace(solution, value_function=np.zeros(7)))
    with pytest.raises(ModelError):
        certify(replace(solution, value_function=None))


def test_a_policy_that_fails_more_than_the_least_is_refused():
    """At least failure the failure itself is limited, though by no row."""
    problem = ConstrainedCost(RISKY, "a", {"fuel": CostLimit({}, 3)})
    fast = DeterministicPolicy(RISKY, np.array([0, -1, -1]))
    risky = replace(solve(problem), policy=MixedPolicy((fast,), np.ones(1)))
    assert "fails with 0.05" in certify(risky).reason


def test_what_is_refused():
    """Methods and questions that know one row only."""
    problem = ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, 3)}, failure_budget=0.5)
    for method in ("game", "deterministic"):
        with pytest.raises(ModelError, match="ConstrainedCost"):
            solve(problem, method)
    with pytest.raises(ModelError, match="ConstrainedCost"):
        cross_check(problem)


def test_a_frontier_holds_the_limits():
    """Over failure, with the fuel held at its bound."""
    problem = ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, 3)}, failure_budget=0.5)
    assert trace_frontier(problem).objective_at(0.5) == pytest.approx(solve(problem).objective)


@pytest.mark.parametrize("backend", ["highs", "highs-simplex", "highs-ipx", "clarabel", "cvxpy"])
def test_every_backend(backend):
    """The full program with any solver ends at the same prices."""
    limits = {"fuel": CostLimit(FUEL, 3), "time": CostLimit(TIME, 2)}
    solution = solve(ConstrainedCost(THREE, "a", limits), LinearProgramming(backend))
    check(solution, 5 / 3, fuel=1, time=1 / 3)
    assert solution.method == "lp"
    assert solution.run.program


def test_a_time_limit_leaves_an_honest_gap():
    """Out of time: a policy with its gap, or the word that none was found."""
    easy = ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, 9)})
    assert solve(easy, time_limit=1e-9).gap <= 1e-9
    hard = ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, 1), "time": CostLimit(TIME, 2)})
    found = attempt(hard, time_limit=1e-9)
    if isinstance(found, SolverError):
        assert "time limit" in str(found)
    else:
        assert found.lower_bound <= found.objective


def test_progress_and_the_run():
    """Each pricing call is reported."""
    calls = []
    limits = {"fuel": CostLimit(FUEL, 3), "time": CostLimit(TIME, 2)}
    solution = solve(
        ConstrainedCost(THREE, "a", limits), progress=lambda n, price, value: calls.append(n)
    )
    assert calls == sorted(calls)
    assert calls[-1] <= solution.run.pricing_calls
    assert "2 rows" in solution.run.reason


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"failure": CostLimit({}, 1)}, "failure budget"),
        ({"": CostLimit({}, 1)}, "word"),
        ({3: CostLimit({}, 1)}, "word"),
        ({"fuel": 3}, "CostLimit"),
        ({"fuel": CostLimit({}, -1)}, "'fuel'.*finite"),
        ({"fuel": CostLimit({}, np.inf)}, "'fuel'.*finite"),
        ({"fuel": CostLimit({}, "much")}, "'fuel'.*finite"),
        ({"fuel": CostLimit({"nowhere": {"x": 1}}, 1)}, "'fuel'.*'nowhere'"),
        ({"fuel": CostLimit({"a": {"jump": 1}}, 1)}, "'fuel'.*'a'.*'jump'"),
        ({"fuel": CostLimit({"a": {"x": -1}}, 1)}, "'fuel'.*'x'.*'a'"),
        ({"fuel": CostLimit({"a": {"x": np.nan}}, 1)}, "'fuel'.*'x'.*'a'"),
        ({"fuel": CostLimit({"a": 1}, 1)}, "'fuel'.*'a'"),
        ({"fuel": CostLimit({"g": {"x": 1}}, 1)}, "'fuel'.*'g'"),
        ({"fuel": CostLimit([1.0, 2.0], 1)}, "'fuel'.*shape"),
        ({"fuel": CostLimit([[1.0, 2.0, 3.0]], 1)}, "'fuel'.*shape"),
        ({"fuel": CostLimit([1.0, -2.0, 3.0], 1)}, "'fuel'.*'y'.*'a'"),
        ({"fuel": CostLimit([1.0, np.inf, 3.0], 1)}, "'fuel'.*'y'.*'a'"),
        ({"fuel": CostLimit("cheap", 1)}, "'fuel'.*has no cost 'cheap'"),
        ([("fuel", 3)], "limits must be"),
    ],
)
def test_limits_are_checked(limits, message):
    """Each complaint names the limit, and the state and the action where there are."""
    with pytest.raises(ModelError, match=message):
        ConstrainedCost(THREE, "a", limits)


def test_the_setting_is_checked():
    """Budget, discount, give_up and start, as for MCMP."""
    for wrong in ({"failure_budget": 2.0}, {"discount": 0.9}, {"give_up": "never"}):
        with pytest.raises(ModelError):
            ConstrainedCost(THREE, "a", **wrong)
    with pytest.raises(ModelError):
        ConstrainedCost(THREE, "b")
    with pytest.raises(ModelError, match="another model"):
        evaluate(DeterministicPolicy(model_of({"a": {"x": [(1.0, "g", 1)]}}), np.array([0, -1])),
                 ConstrainedCost(THREE, "a"))  # fmt: skip
    assert isinstance(THREE, SSP)


@pytest.mark.parametrize("seed", range(12))
def test_free_moves_beside_steps_straight_to_the_goal(seed, accelerate):
    """Pairs that have no outcome but an end stand among those that go round for nothing."""
    accelerate(False)
    rng = np.random.default_rng(seed)
    n, choices = int(rng.integers(2, 6)), {"d": {}}
    for state in range(n):
        choices[state] = {"home": [(1.0, "g", 5.0)]}
        for action in range(int(rng.integers(1, 4))):
            free, to = rng.random() < 0.5, int(rng.integers(n))
            risky = [(0.7, "g", 2.0), (0.2, "d", 2.0), (0.1, to, 2.0)]
            choices[state][action] = [(1.0, to, 0.0)] if free else risky
    limits = {"v": visits(n - 1) <= 0.5, "w": visits(0) <= 3.0}
    problem = MCMP(model_of(choices, "g"), 0, 0.3, give_up="anywhere", constraints=limits)
    try:
        known = problem.program().solve().objective
    except InfeasibleError:
        with pytest.raises(InfeasibleError):
            solve(problem)
        return
    assert solve(problem).objective == pytest.approx(known, rel=1e-7)
