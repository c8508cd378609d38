"""ConstrainedCost by hand: closed forms, conflicts, numbers far apart, certificates, refusals.

Beside a reference it stands in `test_combined_criteria.py`; the goal is "g".
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, strategies as st
from scipy.optimize import linprog

from checks import CLOSE, library_model
from formulations import MCMP, ConstrainedCost, CostLimit
from small_models import EXACT, FREE_LOOP, FREE_PAIR, deciding, each_method, model_of
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
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.programs.occupation_program import rows_program
from strategies import discounts, often, problems, semantics

each_bound = pytest.mark.parametrize("bound", [1e-9, 1e-12, 1e-15])


def sure(**costs):
    """At "a" each action leads to the goal at its cost."""
    return deciding("a", **{action: [(1.0, "g", cost)] for action, cost in costs.items()})


THREE = sure(x=1, y=2, z=5)
FUEL, TIME = CostLimit({"a": {"x": 4, "y": 2}}, 3), CostLimit({"a": {"x": 1, "y": 4, "z": 1}}, 2)
BOTH = {"fuel": FUEL, "time": TIME}
FAST = [(0.95, "g", 1), (0.05, "d", 1)]
RISKY = deciding("a", fast=FAST, slow=[(1.0, "g", 3.5)], dear=[(1.0, "g", 4)])
BURNT = {"fuel": CostLimit({"a": {"fast": 3, "slow": 1}}, 1.3)}


def of(bound, **spent):
    """A limit named fuel on what the actions of "a" spend."""
    return {"fuel": CostLimit({"a": spent}, bound)}


def check(solution, objective, **prices):
    """The value, its proof, and the prices by name."""
    assert solution.objective == pytest.approx(objective, **EXACT)
    certificate = certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= 1e-9
    assert solution.evaluation.objective == pytest.approx(objective, **EXACT)
    for name, price in prices.items():
        assert solution.prices[name] == pytest.approx(price, **EXACT), name
    return solution


def refused(problem, method="columns", match=None):
    with pytest.raises(InfeasibleError, match=match) as caught:
        solve(problem, method)
    return caught.value


@each_method
def test_two_rows(method):
    """7/12 x + 1/3 y + 1/12 z spends 3 of fuel and 2 of time and costs 5/3."""
    solution = solve(ConstrainedCost(THREE, "a", BOTH), method)
    check(solution, 5 / 3, fuel=1, time=1 / 3)
    assert solution.secondary_costs == pytest.approx({"fuel": 3, "time": 2}, **EXACT)
    assert sorted(solution.policy.weights) == pytest.approx([1 / 12, 1 / 3, 7 / 12], **EXACT)
    assert set(solution.prices) == {"fuel", "time"}
    assert solution.failure_price is None
    assert "fuel" in solution.summary()
    mixed = evaluate(solution.randomised_policy, solution.problem).secondary_costs
    assert mixed == pytest.approx(solution.secondary_costs, **EXACT)


@pytest.mark.parametrize("backend", ["highs", "highs-simplex", "highs-ipx", "cvxpy"])
def test_every_backend(backend):
    """The full program with any solver ends at the same prices."""
    solution = solve(ConstrainedCost(THREE, "a", BOTH), LinearProgramming(backend))
    check(solution, 5 / 3, fuel=1, time=1 / 3)
    assert solution.method == "lp"
    assert solution.run.program


def free(limits, start="x", choices=FREE_LOOP, budget=1.0, **meaning):
    """A problem with a loop that costs nothing."""
    return ConstrainedCost(model_of(choices), start, limits, failure_budget=budget, **meaning)


def spares(**bounds):
    """Of x, a, b and c each spares the row of its name, of which the others spend 2."""
    spent = {name: {"a": {other: 2.0 for other in "xabc" if other != name}} for name in bounds}
    return {name: CostLimit(spent[name], bound) for name, bound in bounds.items()}


TWO_STEPS = model_of({"a": {"x": [(0.5, "g", 1), (0.5, "b", 1)], "z": [(1.0, "g", 5)]},
                      "b": {"x": [(1.0, "g", 1)]}})  # fmt: skip
LATER = model_of({"a": {"two": [(1.0, "b", 1)], "one": [(1.0, "g", 3)]},
                  "b": {"on": [(1.0, "g", 1)]}})  # fmt: skip
TWO_STARTS = model_of({"a": {"x": [(1.0, "g", 1)], "z": [(1.0, "g", 5)]},
                       "b": {"x": [(1.0, "g", 1)], "z": [(1.0, "g", 10)]}})  # fmt: skip
WAITS = model_of({"a": {"out": [(1.0, "g", 5)], "w": [(1.0, "a", 2)], "v": [(1.0, "a", 1)]}})
LOOPS, SWAPS = {"x": {"loop": 1}}, {"x": {"swap": 1}, "y": {"swap": 1}}
VALUES = [
    (ConstrainedCost(THREE, "a", BOTH), 5 / 3, {"fuel": 1, "time": 1 / 3}),
    # a row that follows from another has price 0, and so has what is not short
    (ConstrainedCost(THREE, "a", {"fuel": FUEL, "wide": replace(FUEL, bound=3.5)}), 3 / 2,
     {"fuel": 1 / 2, "wide": 0}),
    (ConstrainedCost(THREE, "a", {"fuel": replace(FUEL, bound=9)}), 1, {"fuel": 0}),
    # each dearer action spares one row: weights 1/4, 1/6 and 1/10 of them are needed
    (ConstrainedCost(sure(x=1, a=3, b=4, c=5), "a", spares(a=3 / 2, b=5 / 3, c=9 / 5)), 12 / 5,
     {"a": 1, "b": 3 / 2, "c": 2}),
    # nested dicts, an array of pairs and one of outcomes state the same
    *((ConstrainedCost(TWO_STEPS, "a", {"fuel": CostLimit(cost, 1)}), 1.5 / 3 + 2 * 5 / 3,
       {"fuel": 3.5 / 3}) for cost in ({"a": {"x": 2}, "b": {"x": 2}}, [2, 0, 2], [1, 3, 0, 2])),
    # the second step's fuel counts gamma, as its cost does
    (ConstrainedCost(LATER, "a", {"fuel": CostLimit({"b": {"on": 2}}, 0.9)}, failure_budget=1.0,
                     discount=0.9), (1.9 + 3) / 2, {"fuel": 1.1 / 1.8, "failure": 0}),
    # half of the starts are at b, where x saves 9, and take 2 of 3; the third goes to a half at a
    (ConstrainedCost(TWO_STARTS, {"a": 0.5, "b": 0.5},
                     {"fuel": CostLimit({"a": {"x": 4}, "b": {"x": 4}}, 3)}), 2, {"fuel": 1}),
    # two ways to stay: one is the cheapest, the other takes the least fuel
    *((ConstrainedCost(WAITS, "a", of(spent + 0.5, out=4, w=1, v=3), failure_budget=1.0,
                       give_up=give_up, charge_failing_step=charged), spent, {"fuel": 0})
      for spent, charged in ((1, True), (0, False)) for give_up in ("anywhere", "attention")),
    # no policy stays for ever where that burns fuel alone; giving up there takes one step's
    (free({"fuel": CostLimit(LOOPS, 3)}, give_up="dead_ends"), 5, {"fuel": 0}),
    (free({"f": CostLimit({}, 0)}, give_up="dead_ends"), 0, {}),
    (free({"fuel": CostLimit(LOOPS, 3)}), 0, {"fuel": 0}),
    (free({"fuel": CostLimit(LOOPS, 1 / 4)}), 15 / 4, {"fuel": 5}),
    # at price 0 a cycle is free: the proof holds although no value there has any slack
    *((free({"fuel": CostLimit(SWAPS, bound)}, start, FREE_PAIR, budget, give_up=stop), value, {})
      for stop in ("anywhere", "attention", "dead_ends")
      for start, bound, budget, value in (("y", 9, 0.5, 1), ("y", 1, 0.5, 1), ("x", 9, None, 6))),
    (free({"fuel": CostLimit(SWAPS, 0.5)}, "y", FREE_PAIR, 0.4, give_up="dead_ends"), 7 / 2,
     {"fuel": 5}),
    # y saves 3/2 for each unit of fuel, x only 1; what is allowed is worth nothing
    *((ConstrainedCost(THREE, "a", {"fuel": replace(FUEL, bound=bound)}), 5 - 1.5 * bound, {})
      for bound in (0, 1e-3, 1e-6, 1e-9, 1e-12)),
    *((ConstrainedCost(sure(x=1, z=1 + saving), "a", of(bound, x=1)), 1 + saving * (1 - bound),
       {"fuel": saving}) for saving in (5e-4, 1e-6) for bound in (1e-9, 1e-10, 1e-13)),
    # bounds far from what is taken: the master's basis is completed by slacks
    *((ConstrainedCost(sure(x=1, z=2), "a", {
        f"r{k}": CostLimit({"a": {"x": amount}}, 1) for k, amount in enumerate(taken)
    }), 2 - 1 / max(taken), {})
      for taken in ((1, 1e9), (1, 100, 1e9), (1e8, 2, 1e10), (1e9, 1, 1e9))),
    # a master that HiGHS calls unbounded: no lottery has a cost below the least one
    (ConstrainedCost(sure(x=718.95, y=169.26, z=46.66), "a", {
        "r0": CostLimit({"a": {"x": 0.2, "y": 0.2}}, 2e-10),
        "r1": CostLimit({"a": {"x": 0.2}}, 2e-14),
        "r2": CostLimit({"a": {"x": 0.01, "y": 0.01}}, 1e-7),
    }), 46.66, {"r0": 0, "r1": 0, "r2": 0}),
]  # fmt: skip


@each_method
@pytest.mark.parametrize(("problem", "objective", "prices"), VALUES)
def test_closed_forms(problem, objective, prices, method):
    """One more policy than rows that are short; what is not short has no price."""
    solution = check(solve(problem, method), objective, **prices)
    short = 0
    for name, limit in problem.limits.items():
        spent = solution.secondary_costs[name]
        assert spent <= limit.bound * (1 + 1e-9)
        if solution.prices[name] > 0.0:
            short += 1
            assert spent == pytest.approx(limit.bound, rel=1e-9, abs=0.0)
    assert len(solution.policy.policies) <= 2 + short


@each_method
def test_equal_rows_share_one_price(method):
    twice = {"fuel": FUEL, "again": FUEL}
    solution = check(solve(ConstrainedCost(THREE, "a", twice), method), 3 / 2)
    assert sum(solution.prices.values()) == pytest.approx(1 / 2, **EXACT)
    assert len(solution.policy.policies) == 2


@each_method
def test_contradictory_rows_are_named(method):
    """The smallest conflict is named, with the sum that proves it; the others are left out."""
    limits = {
        "noise": CostLimit({"a": {"x": 1}}, 2),
        "fuel": replace(FUEL, bound=1),
        "time": CostLimit({"a": {"y": 2, "z": 9}}, 1),
        "wear": CostLimit({"a": {"x": 1, "z": 1}}, 5),
    }
    error = refused(ConstrainedCost(THREE, "a", limits), method)
    assert error.conflicting_rows == ("fuel", "time")
    assert (error.failure_budget, error.least_failure) == (None, 0.0)
    assert "no policy satisfies 'fuel' <= 1 and 'time' <= 1 together" in str(error)
    assert "under every policy" in str(error)
    limits["low"] = CostLimit({"a": {"x": 9, "y": 4.2, "z": 5}}, 3)
    told = r"'low' is at least 4\.2 under every policy.*, 3 all"
    refused(ConstrainedCost(THREE, "a", limits), method, told)
    easy = {f"easy{k}": CostLimit({"a": {"x": 1, "y": 2, "z": 1}}, 1.9) for k in range(4)}
    many = easy | {name: limits[name] for name in ("fuel", "time")}
    error = refused(ConstrainedCost(THREE, "a", many), method)
    assert set(error.conflicting_rows) == {"fuel", "time"}
    both = {"fuel": replace(FUEL, bound=0), "time": replace(TIME, bound=0)}
    assert refused(ConstrainedCost(THREE, "a", both), method).conflicting_rows == ("time",)


@each_method
def test_bounds_at_the_least_attainable_value(method):
    """Exactly there, or by rounding below it, only the policies of that value are left."""
    for bound, noted in ((0.7, False), (0.7 * (1 - 1e-11), True)):
        limits = of(bound, x=1.0, y=0.7, z=0.7)
        solution = check(solve(ConstrainedCost(THREE, "a", limits), method), 2)
        assert ("counts as equal" in solution.note) == noted
    refused(ConstrainedCost(THREE, "a", of(0.7 * (1 - 1e-8), x=1.0, y=0.7, z=0.7)), method)


@each_method
def test_a_failure_budget_and_a_row(method):
    """Failure allows 1/5 fast, fuel 7/10 slow beside it; 1/10 goes the dear way."""
    solution = solve(ConstrainedCost(RISKY, "a", BURNT, failure_budget=0.01), method)
    check(solution, 3.05, fuel=0.5, failure=30)
    assert solution.failure_price == solution.prices["failure"] == solution.budget_slope
    assert solution.failure_probability == pytest.approx(0.01, **EXACT)
    assert solution.adversary_weight is None
    none = check(solve(ConstrainedCost(RISKY, "a", BURNT, failure_budget=0.0), method), 3.5)
    assert "least failure" in none.note
    assert none.failure_price is None


@each_method
def test_a_conflict_with_the_failure_budget(method):
    """To fail half the time takes 1 of fuel, to succeed 4: at least 5/2, and 2 is too little."""
    model = deciding("a", out=[(1.0, "g", 5)], wait=[(1.0, "a", 2)])
    enough, low = (of(bound, out=4, wait=1) for bound in (5 / 2, 2))
    check(solve(ConstrainedCost(model, "a", enough, failure_budget=0.5), method), 7 / 2)
    error = refused(ConstrainedCost(model, "a", low, failure_budget=0.5), method)
    assert set(error.conflicting_rows) == {"failure", "fuel"}
    assert (error.failure_budget, error.least_failure) == (0.5, 0.0)
    error = refused(ConstrainedCost(model, "a", low, failure_budget=0.0), method)
    assert error.conflicting_rows == ("failure", "fuel")
    real = ConstrainedCost(model, "a", low, failure_budget=0.5, give_up="dead_ends")
    assert refused(real, method, "'fuel' is at least 4").conflicting_rows == ("fuel",)
    at_best = deciding("a", go=[(0.5, "g", 1), (0.5, "d", 1)])
    error = refused(ConstrainedCost(at_best, "a", failure_budget=0.1), method)
    assert error.conflicting_rows == ("failure",)


@pytest.mark.parametrize("budget", [1e-11, 5e-11, 9e-11])
def test_a_budget_slightly_above_the_least_failure_is_not_equal_to_it(budget):
    """To fail with 1e-10 saves 99: at least failure 100 would be no bound of the optimum."""
    rare = [(1 - 1e-10, "g", 1), (1e-10, "d", 1)]
    model = deciding("a", x=rare, z=[(1.0, "g", 100)])
    setting = {"failure_budget": budget, "charge_failing_step": False}
    solution = check(solve(ConstrainedCost(model, "a", **setting)), 100 - 99 * budget / 1e-10)
    assert solution.objective == pytest.approx(solve(MCMP(model, "a", **setting)).objective)
    assert solution.prices["failure"] == pytest.approx(99e10, **EXACT)


@each_method
@each_bound
def test_a_conflict_of_a_tiny_bound(method, bound):
    """The risky way saves 1/10 of fuel, but no more risk is allowed than a trifle."""
    limits = of(3.99, safe=4, risky=3.9) | {"risk": CostLimit({"a": {"risky": 1}}, bound)}
    problem = ConstrainedCost(sure(safe=1, risky=1), "a", limits)
    error = refused(problem, method, r"at least 3\.63636 under every policy")
    assert error.conflicting_rows == ("fuel", "risk")


def test_a_conflict_under_a_discount_says_both_least_failures():
    model = deciding("a", go=[(0.5, "g", 1), (0.5, "d", 1)])
    problem = ConstrainedCost(model, "a", of(1.0, go=2), failure_budget=0.9, discount=0.9)
    error = refused(problem, match="'fuel' is at least")
    assert error.least_failure == pytest.approx(0.5, rel=1e-12)
    assert error.least_discounted_failure == pytest.approx(0.55, rel=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308, -1e308])
def test_certificates_do_not_overflow(value):
    """Absurd prices are refused, absurd values prove no more than a constant; neither warns.

    On one state the greatest constant sub-solution is the optimum itself.
    """
    solution = solve(ConstrainedCost(THREE, "a", of(3e10, x=4e10, y=2e10)))
    assert not certify(replace(solution, prices={"fuel": value})).accepted
    absurd = certify(replace(solution, value_function=np.array([value])))
    assert absurd.accepted
    assert solution.objective * (1.0 - 1e-14) <= absurd.lower_bound <= solution.objective


def test_certificates_are_not_taken_in():
    """A policy that breaks a row, a false price and a false value function."""
    solution = solve(ConstrainedCost(THREE, "a", BOTH))
    cheap = next(
        m for m in solution.policy.policies if evaluate(m, solution.problem).objective == 1
    )
    greedy = certify(replace(solution, policy=MixedPolicy((cheap,), np.ones(1))))
    assert "spends 4 of 'fuel', 3 allowed" in greedy.reason
    assert not greedy.accepted
    assert certify(replace(solution, prices={"fuel": -1.0, "time": 0.0})).reason
    dear = certify(replace(solution, prices={"fuel": 2.0, "time": 1.0}))
    assert dear.accepted
    assert dear.lower_bound < solution.objective - 0.1
    assert certify(replace(solution, value_function=np.full(1, 99.0))).gap <= 1e-9
    for wrong in (np.zeros(7), None):
        with pytest.raises(ModelError):
            certify(replace(solution, value_function=wrong))
    # at least failure the failure itself is limited, though by no row
    least = solve(ConstrainedCost(RISKY, "a", {"fuel": CostLimit({}, 3)}))
    fast = DeterministicPolicy.from_actions(RISKY, {"a": "fast"})
    assert "fails with 0.05" in certify(
        replace(least, policy=MixedPolicy((fast,), np.ones(1)))
    ).reason  # fmt: skip


def test_what_else_is_done_with_it_and_what_is_refused():
    problem = ConstrainedCost(RISKY, "a", BURNT, failure_budget=0.01)
    assert simulate(solve(problem).policy, problem, episodes=500, seed=1).episodes == 500
    for ask in (
        lambda: solve(problem, "game"),
        lambda: solve(problem, "deterministic"),
        lambda: cross_check(problem),
    ):
        with pytest.raises(ModelError, match="ConstrainedCost"):
            ask()
    wide = replace(problem, failure_budget=0.5)  # a frontier over failure holds the fuel
    assert trace_frontier(wide).objective_at(0.5) == pytest.approx(solve(wide).objective)
    calls = []
    solution = solve(
        ConstrainedCost(THREE, "a", BOTH), progress=lambda n, price, value: calls.append(n)
    )
    assert calls == sorted(calls)
    assert calls[-1] <= solution.run.pricing_calls
    assert "2 rows" in solution.run.reason


def test_a_time_limit_leaves_an_honest_gap():
    """Out of time: a policy with its gap, or the word that none was found."""
    easy = ConstrainedCost(THREE, "a", {"fuel": replace(FUEL, bound=9)})
    assert solve(easy, time_limit=1e-9).gap <= 1e-9
    hard = ConstrainedCost(THREE, "a", BOTH | {"fuel": replace(FUEL, bound=1)})
    try:
        found = solve(hard, time_limit=1e-9)
    except SolverError as error:
        found = error
    honest = "time limit" in str(found) or found.lower_bound <= found.objective
    assert honest
    for wrong in (float("nan"), -1.0, "soon"):
        with pytest.raises(ModelError, match="time_limit"):
            solve(easy, time_limit=wrong)


def by(cost, bound=1):
    return {"fuel": CostLimit(cost, bound)}


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"failure": CostLimit({}, 1)}, "failure budget"),
        ({"": CostLimit({}, 1)}, "word"),
        ({3: CostLimit({}, 1)}, "word"),
        ({"fuel": 3}, "CostLimit"),
        ([("fuel", 3)], "limits must be"),
        *((by({}, bound), "'fuel'.*finite") for bound in (-1, np.inf, "much")),
        (by({}, 10**400), "'fuel'"),
        (by({"nowhere": {"x": 1}}), "'fuel'.*'nowhere'"),
        (by({"a": {"jump": 1}}), "'fuel'.*'a'.*'jump'"),
        *((by({"a": {"x": cost}}), "'fuel'.*'x'.*'a'") for cost in (-1, np.nan)),
        (by({"a": {"x": 10**400}}), "'fuel'"),
        (by({"a": 1}), "'fuel'.*'a'"),
        (by({"g": {"x": 1}}), "'fuel'.*'g'"),
        *((by(cost), "'fuel'.*shape") for cost in ([1.0, 2.0], [[1.0, 2.0, 3.0]])),
        *((by([1.0, cost, 3.0]), "'fuel'.*'y'.*'a'") for cost in (-2.0, np.inf)),
        (by("cheap"), "'fuel'.*has no cost 'cheap'"),
        *((by(np.array(costs)), "'fuel'") for costs in ([1j, 0, 0], ["1", "2", "3"])),
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
        evaluate(DeterministicPolicy(sure(x=1), np.array([0, -1])), ConstrainedCost(THREE, "a"))


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


@pytest.mark.parametrize("n", [1_200, 3_000])
def test_free_rings_in_a_larger_model(n):
    """Evaluations are rough there: rounding must not find that going round for ever is cheap."""
    model, fuel = ring_model(n, np.random.default_rng(5))
    free = solve(MCMP(model, 0, failure_budget=0.25, give_up="dead_ends"))
    for steps, most, method in ((1e6, 40.0, "columns"), (12.0, 30.0, "columns"), (1e6, 40.0, "lp")):
        if method == "lp" and n > 1_200:
            continue
        limits = {"steps": CostLimit(np.ones(3 * n), steps), "fuel": CostLimit(fuel, most)}
        problem = ConstrainedCost(model, 0, limits, failure_budget=0.25, give_up="dead_ends")
        solution, allowed = solve(problem, method), {"failure": 0.25, "steps": steps, "fuel": most}
        assert solution.gap <= 1e-9
        certificate = certify(solution)
        assert certificate.accepted, certificate.reason
        assert certificate.gap <= 1e-8
        assert solution.objective >= free.objective * (1.0 - 1e-9)
        spent = {"failure": solution.failure_probability, **solution.secondary_costs}
        for name, price in solution.prices.items():
            assert spent[name] <= allowed[name] * (1 + 1e-10)
            assert price * (allowed[name] - spent[name]) <= 1e-8 * solution.objective


@pytest.mark.slow
@often(20)
@given(problems(), semantics, discounts)
def test_without_limits_it_is_mcmp(drawn, meaning, discount):
    """No limits at all: the same optimum, the same failure, the same words of refusal."""

    def attempt(criterion, budget):
        setting = {"failure_budget": budget, "discount": discount if budget else None} | meaning
        try:
            return solve(criterion(library_model(drawn), drawn.start, **setting))
        except InfeasibleError as error:
            return error

    for budget in (None, 0.3, 1.0):
        known, found = (attempt(criterion, budget) for criterion in (MCMP, ConstrainedCost))
        assert type(known) is type(found)
        if isinstance(found, InfeasibleError):
            assert found.least_failure == pytest.approx(known.least_failure, **EXACT)
            assert str(found) == str(known)
            continue
        assert found.objective == pytest.approx(known.objective, **CLOSE)
        assert found.gap <= 1e-8
        assert set(found.prices) <= {"failure"}


@pytest.mark.slow
@often(26)
@given(problems(most_live=3), semantics, discounts, st.integers(0, 99))
def test_a_secondary_cost_is_the_cost_of_the_model_that_has_it(drawn, meaning, discount, seed):
    """Of stationary policies, by every semantics: evaluated with the costs exchanged."""
    model, rng = library_model(drawn), np.random.default_rng(seed)
    charges = rng.choice([0.0, 1.0, 0.0, 2.0, 5.0], (2, model.n_outcomes))
    limits = {f"r{k}": CostLimit(charge, 1.0) for k, charge in enumerate(charges)}
    setting = {"failure_budget": 1.0, "discount": discount} | meaning
    problem = ConstrainedCost(model, drawn.start, limits, **setting)
    counts, first = np.diff(model.pair_offsets), model.pair_offsets[:-1]
    for shift in range(2):
        decision = np.where(counts > 0, first + shift * (counts > shift), -1)
        found = evaluate(DeterministicPolicy(model, decision), problem).secondary_costs
        for condition in problem.conditions:
            other = condition.terms[0][1].model
            known = evaluate(
                DeterministicPolicy(other, decision), MCMP(other, drawn.start, **setting)
            )
            assert found[condition.name] == pytest.approx(known.objective, **EXACT)


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
    assert program.cost @ answer.x == pytest.approx(330 / 193, **EXACT)
    assert answer.dual[program.rows["normaliser"]] == pytest.approx(330 / 193, **EXACT)
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
    known = linprog(cost, activity, bounds, np.ones((1, n_columns)), [1.0], method="highs")
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
    instance = compiled_constrained(problem).at_least_failure()
    opened = phase_one(instance, instance, SolveOptions(1e-9))
    found = generate(replace(opened, in_between=in_between), SolveOptions(1e-9))
    assert found.finished
    assert found.objective == pytest.approx(solve(problem).objective, rel=1e-9)
    assert found.lower_bound == pytest.approx(found.objective, rel=1e-9)


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
        refused(problem)
    else:
        assert solve(problem).objective == pytest.approx(known, rel=1e-7)
