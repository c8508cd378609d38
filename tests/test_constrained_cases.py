"""ConstrainedCost by hand: closed forms, conflicts, refusals, identities; the goal is "g"."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings

from checks import CLOSE, library_model
from formulations import MCMP, ConstrainedCost, CostLimit
from small_models import EXACT, FREE_LOOP, FREE_PAIR, each_meaning, model_of
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    MixedPolicy,
    ModelError,
    SolverError,
    certify,
    cross_check,
    evaluate,
    solve,
    trace_frontier,
)
from ssp_lp.process.side_rows import side_rows
from strategies import problems
from test_constrained_cost import charged_problems, discounts, limits_of, meanings

each_engine = pytest.mark.parametrize("engine", ["columns", "lp"])
THREE = model_of({"a": {"x": [(1.0, "g", 1)], "y": [(1.0, "g", 2)], "z": [(1.0, "g", 5)]}})
FUEL = {"a": {"x": 4, "y": 2}}
TIME = {"a": {"x": 1, "y": 4, "z": 1}}


def attempt(problem, **arguments):
    """The solution, or the error that says that there is none."""
    try:
        return solve(problem, **arguments)
    except (InfeasibleError, SolverError) as error:
        return error


def check(solution, objective, **prices):
    """The value, its proof, and the prices by name."""
    assert solution.objective == pytest.approx(objective, **EXACT)
    certificate = certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= 1e-9
    assert solution.evaluation.objective == pytest.approx(objective, **EXACT)
    for name, price in prices.items():
        assert solution.prices[name] == pytest.approx(price, **EXACT), name


@each_engine
def test_two_rows(engine):
    """7/12 x + 1/3 y + 1/12 z spends 3 of fuel and 2 of time and costs 5/3."""
    limits = {"fuel": CostLimit(FUEL, 3), "time": CostLimit(TIME, 2)}
    solution = solve(ConstrainedCost(THREE, "a", limits), engine)
    check(solution, 5 / 3, fuel=1, time=1 / 3)
    assert solution.secondary_costs == pytest.approx({"fuel": 3, "time": 2}, **EXACT)
    assert sorted(solution.policy.weights) == pytest.approx([1 / 12, 1 / 3, 7 / 12], **EXACT)
    assert set(solution.prices) == {"fuel", "time"}
    assert solution.failure_price is None
    assert "fuel" in solution.summary()
    mixed = evaluate(solution.randomised_policy, solution.problem).secondary_costs
    assert mixed == pytest.approx(solution.secondary_costs, **EXACT)


@each_engine
def test_three_rows(engine):
    """Each dearer action spares one row: weights 1/4, 1/6 and 1/10 of them are needed."""
    model = model_of(
        {"a": {name: [(1.0, "g", cost)] for name, cost in zip("xabc", (1, 3, 4, 5), strict=True)}}
    )
    limits = {
        name: CostLimit({"a": {other: 2.0 for other in "xabc" if other != name}}, bound)
        for name, bound in (("a", 3 / 2), ("b", 5 / 3), ("c", 9 / 5))
    }
    solution = solve(ConstrainedCost(model, "a", limits), engine)
    check(solution, 12 / 5, a=1, b=3 / 2, c=2)
    assert len(solution.policy.policies) == 4


@each_engine
def test_redundant_and_duplicated_rows(engine):
    """A row that follows from another has price 0; two equal rows share one price."""
    limits = {"fuel": CostLimit(FUEL, 3), "wide": CostLimit(FUEL, 3.5)}
    solution = solve(ConstrainedCost(THREE, "a", limits), engine)
    check(solution, 3 / 2, fuel=1 / 2, wide=0)
    twice = {"fuel": CostLimit(FUEL, 3), "again": CostLimit(FUEL, 3)}
    solution = solve(ConstrainedCost(THREE, "a", twice), engine)
    check(solution, 3 / 2)
    assert sum(solution.prices.values()) == pytest.approx(1 / 2, **EXACT)
    assert len(solution.policy.policies) == 2


@each_engine
def test_a_row_that_is_never_active(engine):
    """What is not short has no price, and one policy is enough."""
    solution = solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, 9)}), engine)
    check(solution, 1, fuel=0)
    assert solution.prices["fuel"] == 0.0
    assert len(solution.policy.policies) == 1


@each_engine
def test_contradictory_rows_are_named(engine):
    """The smallest conflict is named, with the sum that proves it; the others are left out."""
    seven = {"a": {"x": 1, "y": 0, "z": 1}}
    limits = {
        "noise": CostLimit({"a": {"x": 1}}, 2),
        "fuel": CostLimit(FUEL, 1),
        "time": CostLimit({"a": {"y": 2, "z": 9}}, 1),
        "wear": CostLimit(seven, 5),
    }
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(THREE, "a", limits), engine)
    error = caught.value
    assert error.conflicting_rows == ("fuel", "time")
    assert error.failure_budget is None
    assert error.least_failure == 0.0
    assert "no policy keeps to 'fuel' <= 1 and 'time' <= 1 together" in str(error)
    assert "under every policy" in str(error)
    limits["low"] = CostLimit({"a": {"x": 9, "y": 4.2, "z": 5}}, 3)
    with pytest.raises(
        InfeasibleError, match=r"'low' is at least 4\.2 under every policy.*, 3 all"
    ):
        solve(ConstrainedCost(THREE, "a", limits), engine)


@each_engine
def test_a_bound_at_the_least_attainable_value(engine):
    """Exactly there, or by rounding below it, only the policies of that value are left."""
    third = {"a": {"x": 1.0, "y": 0.7, "z": 0.7}}
    for bound, noted in ((0.7, False), (0.7 * (1 - 1e-11), True)):
        solution = solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(third, bound)}), engine)
        check(solution, 2)
        assert ("counts as equal" in solution.note) == noted
    with pytest.raises(InfeasibleError):
        solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(third, 0.7 * (1 - 1e-8))}), engine)


@each_engine
def test_a_zero_bound_forbids(engine):
    """What must not be spent at all."""
    solution = solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, 0)}), engine)
    check(solution, 5)
    assert solution.secondary_costs["fuel"] == 0.0
    both = {"fuel": CostLimit(FUEL, 0), "time": CostLimit(TIME, 0)}
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(THREE, "a", both), engine)
    assert caught.value.conflicting_rows == ("time",)


@each_engine
@pytest.mark.parametrize("bound", [1e-3, 1e-6, 1e-9, 1e-12])
def test_tiny_bounds(engine, bound):
    """The saving of y per unit of fuel is 3/2, that of x only 1."""
    solution = solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, bound)}), engine)
    check(solution, 5 - 1.5 * bound)
    assert solution.secondary_costs["fuel"] == pytest.approx(bound, rel=1e-9)


@each_engine
def test_costs_by_pair_and_by_outcome(engine):
    """An array of pairs, one of outcomes and nested dicts state the same."""
    model = model_of({"a": {"x": [(0.5, "g", 1), (0.5, "b", 1)], "z": [(1.0, "g", 5)]},
                      "b": {"x": [(1.0, "g", 1)]}})  # fmt: skip
    forms = ({"a": {"x": 2}, "b": {"x": 2}}, [2, 0, 2], [1, 3, 0, 2])
    for cost in forms:
        solution = solve(ConstrainedCost(model, "a", {"fuel": CostLimit(cost, 1)}), engine)
        check(solution, 1.5 / 3 + 2 * 5 / 3, fuel=3.5 / 3)


@each_engine
def test_discounted_rows(engine):
    """The second step's fuel counts gamma, as its cost does."""
    model = model_of({"a": {"two": [(1.0, "b", 1)], "one": [(1.0, "g", 3)]},
                      "b": {"on": [(1.0, "g", 1)]}})  # fmt: skip
    limits = {"fuel": CostLimit({"b": {"on": 2}}, 0.9)}
    problem = ConstrainedCost(model, "a", limits, failure_budget=1.0, discount=0.9)
    solution = solve(problem, engine)
    check(solution, (1.9 + 3) / 2, fuel=1.1 / 1.8, failure=0)
    assert solution.secondary_costs["fuel"] == pytest.approx(0.9, **EXACT)


@each_engine
def test_a_start_distribution_shares_the_bound(engine):
    """Fuel is spent where it saves most: all of x at "b", which saves 9, before "a", which saves 4.

    Half of the starts are at "b" and take 2 of the 3 that are allowed; the third one goes to half
    of those at "a".
    """
    model = model_of({"a": {"x": [(1.0, "g", 1)], "z": [(1.0, "g", 5)]},
                      "b": {"x": [(1.0, "g", 1)], "z": [(1.0, "g", 10)]}})  # fmt: skip
    limits = {"fuel": CostLimit({"a": {"x": 4}, "b": {"x": 4}}, 3)}
    solution = solve(ConstrainedCost(model, {"a": 0.5, "b": 0.5}, limits), engine)
    check(solution, 2, fuel=1)


RISKY = model_of(
    {
        "a": {
            "fast": [(0.95, "g", 1), (0.05, "d", 1)],
            "slow": [(1.0, "g", 3.5)],
            "dear": [(1.0, "g", 4)],
        },
        "d": {},
    }
)


@each_engine
def test_a_failure_budget_and_a_row(engine):
    """Failure allows 1/5 fast, fuel 7/10 slow beside it; 1/10 goes the dear way."""
    limits = {"fuel": CostLimit({"a": {"fast": 3, "slow": 1}}, 1.3)}
    solution = solve(ConstrainedCost(RISKY, "a", limits, failure_budget=0.01), engine)
    check(solution, 3.05, fuel=0.5, failure=30)
    assert solution.failure_price == solution.prices["failure"] == solution.budget_slope
    assert solution.failure_probability == pytest.approx(0.01, **EXACT)
    assert solution.adversary_weight is None
    none = solve(ConstrainedCost(RISKY, "a", limits, failure_budget=0.0), engine)
    check(none, 3.5)
    assert "least failure" in none.note
    assert none.failure_price is None


@each_engine
def test_a_conflict_with_the_failure_budget(engine):
    """To fail half the time takes 1 of fuel, to succeed 4: at least 5/2, and 2 is too little."""
    model = model_of({"a": {"out": [(1.0, "g", 5)], "wait": [(1.0, "a", 2)]}})
    limits = {"fuel": CostLimit({"a": {"out": 4, "wait": 1}}, 5 / 2)}
    solution = solve(ConstrainedCost(model, "a", limits, failure_budget=0.5), engine)
    check(solution, 7 / 2)
    low = {"fuel": CostLimit(limits["fuel"].cost, 2)}
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(model, "a", low, failure_budget=0.5), engine)
    assert set(caught.value.conflicting_rows) == {"failure", "fuel"}
    assert caught.value.failure_budget == 0.5
    assert caught.value.least_failure == 0.0
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(model, "a", low, failure_budget=0.0), engine)
    assert caught.value.conflicting_rows == ("failure", "fuel")
    with pytest.raises(InfeasibleError, match="'fuel' is at least 4") as caught:
        solve(ConstrainedCost(model, "a", low, failure_budget=0.5, give_up="dead_ends"), engine)
    assert caught.value.conflicting_rows == ("fuel",)
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(RISKY_AT_BEST, "a", failure_budget=0.1), engine)
    assert caught.value.conflicting_rows == ("failure",)


RISKY_AT_BEST = model_of({"a": {"go": [(0.5, "g", 1), (0.5, "d", 1)]}, "d": {}})


@each_engine
@pytest.mark.parametrize(("charged", "paid", "burnt"), [(True, 1, 1), (False, 0, 0)])
@pytest.mark.parametrize("give_up", ["anywhere", "attention"])
def test_giving_up_charges_the_least_of_each_cost(engine, charged, paid, burnt, give_up):
    """Two ways to stay: one is the cheapest, the other takes the least fuel."""
    model = model_of({"a": {"out": [(1.0, "g", 5)], "w": [(1.0, "a", 2)], "v": [(1.0, "a", 1)]}})
    limits = {"fuel": CostLimit({"a": {"out": 4, "w": 1, "v": 3}}, 9)}
    problem = ConstrainedCost(
        model, "a", limits, failure_budget=1.0, give_up=give_up, charge_failing_step=charged
    )
    solution = solve(problem, engine)
    check(solution, paid, fuel=0)
    assert solution.secondary_costs["fuel"] == pytest.approx(burnt, **EXACT)


@each_engine
def test_a_free_cycle_that_burns_fuel_is_no_place_to_stay(engine):
    """Staying for ever costs nothing but fuel: no policy does; giving up there takes one step's."""
    limits = {"fuel": CostLimit({"x": {"loop": 1}}, 3)}
    never = {"failure_budget": 1.0, "give_up": "dead_ends"}
    model = model_of(FREE_LOOP)
    check(solve(ConstrainedCost(model, "x", limits, **never), engine), 5, fuel=0)
    check(solve(ConstrainedCost(model, "x", {"f": CostLimit({}, 0)}, **never), engine), 0)
    gives_up = ConstrainedCost(model, "x", limits, failure_budget=1.0)
    check(solve(gives_up, engine), 0, fuel=0)
    short = {"fuel": CostLimit({"x": {"loop": 1}}, 1 / 4)}
    check(solve(ConstrainedCost(model, "x", short, failure_budget=1.0), engine), 15 / 4, fuel=5)


@each_engine
@each_meaning
def test_a_free_cycle_of_two_states(engine, give_up):
    """At price 0 the cycle is free: the proof holds although no value there has any slack."""
    fuel = {"x": {"swap": 1}, "y": {"swap": 1}}
    model = model_of(FREE_PAIR)
    for bound, objective in ((9, 1), (1, 1)):
        problem = ConstrainedCost(
            model, "y", {"fuel": CostLimit(fuel, bound)}, failure_budget=0.5, give_up=give_up
        )
        check(solve(problem, engine), objective if give_up == "dead_ends" else min(objective, 3))
    least = ConstrainedCost(model, "x", {"fuel": CostLimit(fuel, 9)}, give_up=give_up)
    check(solve(least, engine), 6, fuel=0)
    tight = ConstrainedCost(
        model, "y", {"fuel": CostLimit(fuel, 0.5)}, failure_budget=0.4, give_up="dead_ends"
    )
    check(solve(tight, engine), 7 / 2, fuel=5)


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
    for steps, most, engine in ((1e6, 40.0, "columns"), (12.0, 30.0, "columns"), (1e6, 40.0, "lp")):
        if engine == "lp" and n > 1_200:
            continue
        limits = {"steps": CostLimit(np.ones(3 * n), steps), "fuel": CostLimit(fuel, most)}
        problem = ConstrainedCost(model, 0, limits, failure_budget=0.25, give_up="dead_ends")
        solution = solve(problem, engine)
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


@settings(max_examples=60, deadline=None, derandomize=True)
@given(problems(), meanings, discounts)
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


@settings(max_examples=80, deadline=None, derandomize=True)
@given(charged_problems(), meanings, discounts)
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
        for row in side_rows(model, limits):
            other = MCMP(row.model, drawn.start, **setting)
            policy = DeterministicPolicy(row.model, decision)
            assert found[row.name] == pytest.approx(evaluate(policy, other).objective, **EXACT)


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
    """Engines and questions that know one row only."""
    problem = ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, 3)}, failure_budget=0.5)
    for arguments in (
        {"engine": "game"},
        {"policy_class": "deterministic"},
        {"engine": "lp", "backend": "highs-warm"},
    ):
        with pytest.raises(ModelError, match=r"ConstrainedCost|highs-warm"):
            solve(problem, **arguments)
    for question in (trace_frontier, cross_check):
        with pytest.raises(ModelError, match="ConstrainedCost"):
            question(problem)


@pytest.mark.parametrize("backend", ["highs", "highs-simplex", "highs-ipx", "clarabel", "cvxpy"])
def test_every_backend(backend):
    """The full program with any solver ends at the same prices."""
    limits = {"fuel": CostLimit(FUEL, 3), "time": CostLimit(TIME, 2)}
    solution = solve(ConstrainedCost(THREE, "a", limits), "lp", backend=backend)
    check(solution, 5 / 3, fuel=1, time=1 / 3)
    assert solution.engine == "lp"
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
    """Each oracle call is reported."""
    calls = []
    limits = {"fuel": CostLimit(FUEL, 3), "time": CostLimit(TIME, 2)}
    solution = solve(
        ConstrainedCost(THREE, "a", limits), progress=lambda n, price, value: calls.append(n)
    )
    assert calls == sorted(calls)
    assert calls[-1] <= solution.run.oracle_calls
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
        ({"fuel": CostLimit("cheap", 1)}, "'fuel'.*numbers"),
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
