"""Pricing layer by layer: how it begins, what a stopped sweep is, and the process written out."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from examples.domains.navigation import navigation
from examples.domains.windy_field import windy_field
from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from examples.solver_comparison.instances.families import holes
from formulations import GUBS, MCMP, S3P, CostBoundedReach, CostQuantile, CVaR, MaxProb
from small_models import model_of
from ssp_lp import (
    SSP,
    InfeasibleError,
    certify,
    evaluate,
    goal_probability,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.accumulated_cost import sweep
from ssp_lp.accumulated_cost.charges import TOTAL_COST
from ssp_lp.accumulated_cost.sweep import PartOfSweep, Sweep, at_price
from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.arrays import read_only, weighted
from ssp_lp.column_generation import compiled_problem
from ssp_lp.column_generation.column import FailureRow, required
from ssp_lp.column_generation.compiled_layers import LayeredPricing
from ssp_lp.column_generation.explicit_pricing import values_less_constant
from ssp_lp.column_generation.layered_pricing import OpenEndedPricing
from ssp_lp.column_generation.search import _initial_column_within
from ssp_lp.compiled import deadline
from ssp_lp.compiled.deadline import Stop, until
from ssp_lp.methods.rows import rows_optimum
from ssp_lp.options import SolveOptions
from ssp_lp.problem import compiled_constrained
from ssp_lp.processes.failure_semantics import FailureSemantics
from written_models import drawn_table, written

FIELD = navigation(6, 5)
WINDY = windy_field(6, diagonal=1.4)


# With a guess at the cap, which is no policy, and a bound at hand


@pytest.fixture
def guessing(monkeypatch, accelerate):
    """Begin as with a large process."""
    pytest.importorskip("numba")
    monkeypatch.setattr(compiled_problem, "_LARGE", 0)
    monkeypatch.setattr(Sweep, "one_pass", None)
    accelerate(True)


def test_a_guess_leads_to_the_same_optimum(request):
    grid = RobotGrid(segments=8, headings=8)
    problems = [S3P(*FIELD, 0.9), S3P(*FIELD, 0.6), S3P(grid_model(grid), start_state(grid), 0.3)]
    before = [solve(problem, tolerance=1e-13) for problem in problems]
    request.getfixturevalue("guessing")
    for problem, known in zip(problems, before, strict=True):
        problem = replace(problem)
        assert problem.compile().pricing().first().policy is None
        found = solve(problem, tolerance=1e-13)
        assert found.objective == pytest.approx(known.objective, rel=1e-12)
        certificate = certify(found)
        assert certificate.accepted
        assert max(found.gap, certificate.gap) <= 1e-9


@pytest.mark.usefixtures("guessing")
@pytest.mark.parametrize("budget", [0.6, 0.9])
def test_a_guess_is_no_policy_to_stop_with(budget):
    """What half a sweep found is taken, though the guess would seem to keep to the budget."""
    pricing = S3P(*FIELD, 0.9).compile().pricing()
    guess, half = pricing.first(), pricing.minimise(100.0)
    row, swept = FailureRow(budget, ratio=True), required(half.choice)
    part = PartOfSweep(swept, 100.0, 0, None)  # all layers, as it happens
    found = _initial_column_within(pricing, row, Stop(part), guess)
    assert (found.cost, found.failure, found.goal) == (half.cost, half.failure, half.goal)
    assert found.policy is not None


@pytest.mark.parametrize("discount", [None, 0.97])
@pytest.mark.parametrize("compiled", [False, True])
def test_one_sweep_prices_all_lower_prices(compiled, discount, accelerate):
    """Each layer's column is worth as much as pricing finds at its price, next to the budget."""
    accelerate(compiled)
    least = 1.0 - solve(MaxProb(*WINDY)).objective
    for budget in (least + 0.05, 0.5, 0.8) if discount is None else (0.8,):
        problem = S3P(*WINDY, budget, discount=discount)
        pricing, row = problem.compile().pricing(), FailureRow(budget, ratio=True)
        swept = pricing.minimise(pricing.covered_price)
        nearest, other = pricing.nearby_columns(swept, row)
        price = required(nearest.found_at)
        anew = pricing.minimise(price)
        worth = anew.cost + price * anew.failure
        assert nearest.cost + price * nearest.failure == pytest.approx(worth, rel=1e-9)
        assert row.is_violated_by(nearest) != row.is_violated_by(other)
        for column in (nearest, other):
            policy = pricing.policy(column)
            played = evaluate(policy, problem)
            assert played.goal_probability == pytest.approx(column.goal, rel=1e-9) or discount
            assert column.cost / column.goal == pytest.approx(played.objective, rel=1e-9)


@pytest.mark.parametrize("cost", [1.0, 0.7, Fraction(1, 3)])
def test_the_fewest_steps_are_a_bound(cost):
    """Met where the way is sure, else below the optimum."""
    line = {k: {"go": [(1.0, k + 1, cost)]} for k in range(4)}
    sure = S3P(SSP.from_transitions(line, goal={4}), 0, 0.5)
    assert sure.compile().lowest == pytest.approx(4 * float(cost), rel=1e-14)
    assert solve(sure).lower_bound <= solve(sure).objective
    for k in range(4):  # it may wait, for another cost, or fall
        line[k] = {"go": [(0.6, k + 1, cost), (0.2, k, 2 * cost), (0.2, "pit", cost)]}
    problem = S3P(model_of(line, 4), {0: 0.5, 1: 0.5}, 0.95)
    lowest = problem.compile().lowest
    assert lowest == pytest.approx(3 * float(cost), rel=1e-14)
    assert lowest < solve(problem).objective
    for discount in (None, 0.9):
        at_goal = S3P(sure.model, {0: 0.5, 4: 0.5}, 0.5, discount=discount)
        assert at_goal.compile().lowest == 0.0


def test_a_first_policy_that_never_arrives_starts_the_search(monkeypatch):
    """Dashing is nearest to the goal and arrives with 1e-400; who walks pays 800."""
    length, budget = 400, 0.3
    way = {}
    for k in range(length):
        on = k + 1 if k + 1 < length else "goal"
        way[k] = {"dash": [(0.1, on, 1.0), (0.9, "pit", 1.0)], "walk": [(1.0, f"by {k}", 1.0)]}
        way[f"by {k}"] = {"on": [(1.0, on, 1.0)]}

    def never(*_):
        raise AssertionError("the least failure is not needed")

    monkeypatch.setattr("ssp_lp.methods.columns.checked_least_failure", never)
    meaning = {"give_up": "anywhere", "charge_failing_step": False}
    problem = MCMP(model_of(way, "goal"), 0, budget, **meaning)
    assert solve(problem).objective == pytest.approx((1.0 - budget) * 2.0 * length, rel=1e-9)


# A backward sweep that is stopped half-way is a whole sweep at a lower price of failure


@pytest.mark.parametrize("discount", [None, 0.97])
@pytest.mark.parametrize("layers", [0, 8, 25, 40])
@pytest.mark.parametrize("price", [80.0, 55.0])
def test_layers_swept_by_then_are_an_optimum_at_a_lower_price(monkeypatch, discount, layers, price):
    """At the price of 55 most tails beyond the layers are others than at the lower price."""
    problem = S3P(*FIELD, 0.9, discount=discount, cost_cap=60.0)
    pricing, looks = problem.compile().pricing(), iter(range(10**9))
    monkeypatch.setattr(Sweep, "one_pass", None)

    def end():
        if next(looks) >= layers:
            raise Stop

    with monkeypatch.context() as patched, until(float("inf")):
        patched.setattr(deadline, "check_time", end)
        with pytest.raises(Stop) as stopped:
            pricing.minimise(price)
    found = pricing.incumbent(stopped.value.choice)
    if layers == 0:
        assert found is None
        proved, checked = pricing.prove(price), pricing.check(price, pricing.infinite)
        assert proved.bound == pytest.approx(checked.bound, rel=1e-12)
        return
    process = replace(pricing.process, totals=pricing.process.base.totals(layers))
    paid = (pricing.process.cap - layers) * process.base.unit
    same = replace(pricing, process=process).minimise(price - paid / process.base.survival)
    assert found.failure == pytest.approx(same.failure, rel=1e-13)
    assert found.cost == pytest.approx(same.cost, rel=1e-12)
    played = evaluate(found.policy, problem)
    if found.goal > 0.0:
        assert played.objective == pytest.approx(found.cost / found.goal, rel=1e-12)


# Limits on accumulated costs: the same as on the process written out


def limited(rng):
    """Up to eight states with loops, each step for one, two or three; one to three limits."""
    live = [f"s{k}" for k in range(int(rng.integers(2, 9)))]
    choices = drawn_table(rng, live, ["g", "pit", "g"], [1.0, 2.0, 3.0])
    choices["s0"]["go"] = [(0.6, "g", 2.0), (0.2, "pit", 1.0), (0.2, "s1", 1.0)]
    model = model_of(choices)
    fuel = np.round(rng.uniform(0.0, 2.0, model.n_pairs), 1)
    limits = [
        visits("s0") <= float(rng.uniform(1.0, 2.5)),
        secondary_cost(fuel) <= float(rng.uniform(1.0, 8.0)),
        goal_probability() >= float(rng.uniform(0.1, 0.6)),
    ]
    return model, {f"limit {k}": limits[k] for k in range(3) if k == 0 or rng.random() < 0.6}


@pytest.mark.parametrize("seed", range(8))
def test_pricing_by_layers_is_pricing_on_the_process_written_out(seed):
    """Least priced totals, a policy's own totals and checked bounds, at prices some of them 0."""
    rng = np.random.default_rng(seed)
    model, limits = limited(rng)
    compiled = compiled_constrained(S3P(model, "s0", 0.4, constraints=limits))
    layered, written_out = compiled.augmented, compiled.explicit_pricing
    assert isinstance(layered, OpenEnded)
    counting = layered.counting(FailureSemantics())
    swept = OpenEndedPricing(layered, tuple(row.at(counting) for row in compiled.side))
    assert swept.value_shape == written_out.value_shape
    assert swept.n_rewards == written_out.n_rewards
    np.testing.assert_allclose(swept.first().rewards, written_out.first().rewards, rtol=1e-9)
    for _ in range(6):
        weights = rng.uniform(0.0, 30.0, swept.n_rewards) * (rng.random(swept.n_rewards) < 0.7)
        weights[0] = float(rng.integers(2))
        column, known = swept.minimise(weights), written_out.minimise(weights)
        least = float(known.rewards @ weights)
        assert float(column.rewards @ weights) == pytest.approx(least, rel=1e-9, abs=1e-9)
        bound = swept.prove(weights, column).bound
        assert bound <= least + 1e-12 * abs(least)
        assert bound == pytest.approx(least, rel=1e-9, abs=1e-9)
        again = swept.check(weights, swept.prove(weights, column).values).bound
        assert again == pytest.approx(bound, rel=1e-9, abs=1e-9)
        lowered = written_out.check(weights, weighted(known.totals, weights)).values - 1.0
        assert swept.check(weights, lowered).bound <= least
        weights[0], ratio = 1.0, float(rng.choice([1e-3, 3.0]))  # which success earns
        priced = weights + ratio * (np.arange(len(weights)) == 1)
        for pricing in (swept, written_out):
            proof = pricing.prove(priced, pricing.minimise(priced))
            less = pricing.bound_less_constant(weights, ratio, ratio, proof.values)
            assert less == pytest.approx(proof.bound - ratio, rel=1e-9, abs=1e-9)
        rounded = ratio * (1.0 + np.array([0.0, 3e-16, -3e-16, 1.0]))
        assert values_less_constant(rounded, ratio).tolist() == [0.0, 0.0, 0.0, ratio]


@pytest.mark.parametrize("seed", range(8))
def test_optima_by_layers_are_those_on_the_process_written_out(seed, monkeypatch):
    rng = np.random.default_rng(100 + seed)
    (model, limits), budget = limited(rng), float(rng.choice([0.2, 0.4, 0.7, 1.0]))
    discount = None if rng.random() < 0.7 else 0.95
    level, bound = float(rng.choice([0.5, 0.8])), float(rng.integers(3, 9))
    for problem in (
        S3P(model, "s0", budget, discount=discount, constraints=limits),
        CVaR(model, "s0", level, budget, constraints=limits),
        CostQuantile(model, "s0", level, budget, constraints=limits),
        GUBS(model, "s0", lambda cost: np.exp(-cost / 4.0), 0.5, constraints=limits),
        CostBoundedReach(model, "s0", bound, budget, constraints=limits),
    ):
        found = []
        for least in (0, 10**9):  # entries of a layer
            monkeypatch.setattr(compiled_problem, "_WORTH_SWEEPING", least)
            try:
                found.append(solve(problem))
            except InfeasibleError as error:
                found.append(error.least_failure)
        swept, known = found
        if isinstance(known, float):
            assert swept == known
            continue
        assert swept.objective == pytest.approx(known.objective, rel=1e-8, abs=1e-9)
        proof = certify(swept)
        assert proof.accepted
        assert max(swept.gap, proof.gap) <= max(1e-9, 2.0 * known.gap)


def test_the_open_end_of_a_slow_walk_is_bounded_by_a_constant():
    """Where failing is best beyond the cap, its price bounds all values, however long a walk is.

    Each step leads on with probability 1e-3 and back to the beginning else: 1e12 steps. The cost
    given success at a budget of 0.5 is that of the short way.
    """
    model = written(
        """
        a short: 0.6 g 3, 0.4 pit 3
        a walk: 0.001 b 1, 0.999 a 1
        b walk: 0.001 c 1, 0.999 a 1
        c walk: 0.001 d 1, 0.999 a 1
        d walk: 0.001 g 1, 0.999 a 1
        """
    )
    solution = solve(S3P(model, "a", 0.5, constraints={"start": visits("a") <= 10.0}))
    assert solution.objective == pytest.approx(3.0, rel=1e-9)
    assert solution.gap <= 1e-9


def test_a_tail_is_kept_beyond_the_cap_only_where_no_place_gains(monkeypatch):
    """A place that nobody visits takes 1e13 of fuel: it hides no gain elsewhere.

    Half of the runs go on beyond the bound, where a half is burnt safely or half fail: at most a
    fifth may, and a quarter of the fuel lets them.
    """
    monkeypatch.setattr(compiled_problem, "_WORTH_SWEEPING", 0)
    ways = {
        "s": {"fast": [(0.5, "g", 1.0), (0.5, "t", 5.0)], "far": [(1.0, "z", 1.0)]},
        "t": {"safe": [(1.0, "g", 1.0)], "risky": [(0.5, "g", 1.0), (0.5, "pit", 1.0)]},
        "z": {"on": [(1.0, "g", 1.0)]},
        "pit": {},
    }
    ways["s"]["slow"] = [(0.4, "g", 1.0), (0.6, "g", 5.0)]
    fuel = secondary_cost({"t": {"safe": 1.0}, "z": {"on": 1e13}})
    asked = CostBoundedReach(model_of(ways, "g"), "s", 2.0, 0.2, constraints={"fuel": fuel <= 0.25})
    solution = solve(asked)
    assert solution.objective == pytest.approx(0.5, abs=1e-12)
    assert solution.gap <= 1e-9


@pytest.mark.parametrize("compiled", [True, False])
def test_one_product_is_not_taken_for_exact(compiled, accelerate):
    """A bound of a single rounded product lies below the fraction that it stands for."""
    accelerate(compiled)
    rng = np.random.default_rng(0)
    ways = {"s": {"go": [(0.3, "g", 0.0), (0.7, "pit", 1.0)]}, "pit": {}}
    pricing = S3P(model_of(ways, "g"), "s", 0.9).compile().pricing()
    failed = Fraction(float(pricing.process.base.failure[0]))
    for price in rng.uniform(0.1, 5.0, 20).tolist():
        assert Fraction(pricing.prove(price, slack=True).bound) <= -Fraction(price) * Fraction(0.3)
        least = min(Fraction(price) * failed, Fraction(price))
        assert Fraction(pricing.prove(price).bound) <= least


def test_policies_are_taken_on_to_a_higher_cap(monkeypatch):
    """Where runs cannot fail at will no cap is beyond loss: each higher one takes a few calls."""
    monkeypatch.setattr(compiled_problem, "_WORTH_SWEEPING", 0)
    steps = {}
    for k in range(12):
        on = [(0.75, f"s{k + 1}", 1.0), (0.2, f"s{max(k - 2, 0)}", 1.0), (0.05, "pit", 1.0)]
        steps[f"s{k}"] = {"on": on}
        if k % 3 == 0:
            steps[f"s{k}"]["surely"] = [(1.0, f"s{k + 1}", 1.0)]
    model = SSP.from_transitions(steps, goal={"s12"}, dead_ends={"pit"})
    fuel = secondary_cost([action == "surely" for choices in steps.values() for action in choices])
    problem = S3P(model, "s0", 1.0, constraints={"fuel": fuel <= 4.5})
    begun = replace(compiled_constrained(problem), cap=3)
    low, high = begun.pricing(), replace(begun, cap=9).pricing()
    assert isinstance(low, OpenEndedPricing)
    column = low.minimise(np.array([1.0, 4.0, 0.5]))
    (longer,) = high.reevaluated([column])
    acts = evaluate(low.policy(column), problem)
    true = acts.objective * acts.goal_probability
    assert acts == evaluate(high.policy(longer), problem)
    assert column.cost < longer.cost < true  # each counts what is paid up to its cap
    np.testing.assert_allclose(column.rewards[1:], longer.rewards[1:], rtol=1e-12)
    for pricing, each in ((low, column), (high, longer)):
        assert pricing.true_cost(each) == pytest.approx(true, rel=1e-12)
    optimum = rows_optimum(begun, SolveOptions(1e-9))
    assert optimum.compiled.layers > 4 * 3  # raised twice
    at_once = rows_optimum(replace(begun, cap=optimum.compiled.layers), SolveOptions(1e-9))
    for found in (optimum, at_once):
        assert found.gap <= 1e-9
        assert found.value == pytest.approx(solve(problem).objective, rel=1e-9)
        assert found.value == pytest.approx(evaluate(found.policy, problem).objective, rel=1e-12)


def fine_costs(seed):
    """A windy field with costs of two digits: no step passes fewer than 50 layers."""
    field = windy_field(4, diagonal=1.0)
    costs = np.round(np.random.default_rng(seed).uniform(0.5, 2.0, field.model.n_outcomes), 2)
    return S3P(replace(field.model, costs=read_only(costs), exact_costs={}), field.start, 0.3)


@pytest.mark.parametrize("price", [3.0, 8.0])
def test_blocks_of_layers_are_as_layer_by_layer(accelerate, monkeypatch, price):
    """Values, choices, measures and dual bounds, to the last digit."""
    accelerate(True)
    process = fine_costs(1).compile().charging(TOTAL_COST, 600).process
    limits = np.random.default_rng(2).uniform(-5.0, 0.0, (process.cap, process.base.n_nodes))
    numbers = list[list[np.ndarray]]()
    for least in (16, process.cap):
        monkeypatch.setattr(sweep, "_LEAST_BLOCK", least)
        pricing = LayeredPricing(process)
        assert pricing.sweep.by_blocks is (least == 16)
        choice, begun = pricing.sweep.empty_choice(), np.zeros((process.cap, 4))
        task = at_price(pricing.sweep, price, 0.0)
        measures = pricing.sweep.minimise(task, choice, begun)
        proof, lowered = pricing.prove(price, slack=True), pricing.check(price, limits, slack=True)
        proved = proof.by_layer, proof.values, lowered.by_layer, lowered.values
        numbers.append([measures, choice, begun, *proved])
        again = pricing.sweep.measure(choice, process.measures_beyond(price))
        followed = pricing.sweep.follow(choice, process.measures_beyond(price))
        np.testing.assert_allclose(again, measures, rtol=1e-13)
        np.testing.assert_allclose(followed, measures, rtol=1e-13)
    for blocks, layers in zip(*numbers, strict=True):
        np.testing.assert_array_equal(blocks, layers)


@pytest.mark.parametrize("discount", [None, 0.98])
def test_one_sweep_proves_what_it_finds(accelerate, monkeypatch, discount):
    """The column, and its dual bounds at all lower prices, are those of sweeps of their own."""
    accelerate(True)
    process = replace(fine_costs(3), discount=discount).compile().charging(TOTAL_COST, 900).process
    pricing = LayeredPricing(process)
    price = float(process.totals.values[process.cap - 1])
    column, row = pricing.minimise(price), FailureRow(0.3, ratio=True)
    assert column.totals is not None
    beside = pricing.nearby_columns(column, row)
    assert len(beside) == 2
    monkeypatch.setattr(sweep, "_LEAST_BLOCK", process.cap)
    alone = LayeredPricing(process)
    assert alone.minimise(price).cost == pytest.approx(column.cost, rel=1e-9)
    found = beside[0].found_at
    assert found is not None
    for slack in (False, True):
        proof = pricing.prove(found, beside[0], slack=slack)
        own = alone.prove(found, slack=slack)
        assert row.lower_bound(proof) == pytest.approx(row.lower_bound(own), rel=1e-12)
        assert alone.check(found, proof.values, slack=slack).bound == pytest.approx(own.bound)


def test_a_true_cost_is_unknown_where_runs_beyond_the_cap_are_endless():
    """Rounding of the goal probability, times 1e30 steps, made the cost of failing -5e16."""
    model = holes(40)
    free = {"fuel": secondary_cost(np.ones(model.n_pairs)) <= 1e9}
    stated = compiled_constrained(S3P(model, 0, 0.05, constraints=free))
    pricing = replace(stated.with_tails(exact=False), cap=40).pricing()
    failing, safe = (pricing.minimise(np.array([1.0, price, 0.0])) for price in (1.0, 100.0))
    assert pricing.true_cost(failing) is None
    acts = evaluate(pricing.policy(safe), S3P(model, 0, 1.0))
    known = pricing.true_cost(safe)
    assert known == pytest.approx(acts.objective * acts.goal_probability, rel=1e-12)
