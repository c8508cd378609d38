"""Costs without a common unit, split for case S and rounded for the law: bounds and their proof."""

from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import product

import numpy as np
import pytest

from examples.domains.windy_field import windy_field
from examples.formulating import real_costs
from examples.solver_comparison.instances import families
from formulations import EGUBS, GUBS, S3P, CostBoundedReach, CostQuantile, CVaR, MaxProb
from small_models import model_of
from ssp_lp import (
    CostAwarePolicy,
    MixedPolicy,
    ModelError,
    Status,
    certify,
    evaluate,
    solve,
)
from ssp_lp.accumulated_cost.sweep import Sweep
from ssp_lp.analysis import evaluation
from ssp_lp.arrays import read_only
from ssp_lp.column_generation.compiled_layers import LayeredPricing
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.methods import rounding
from ssp_lp.methods.rounding import is_split, split_optimum, with_split_costs
from ssp_lp.model.graph import dead_ends
from ssp_lp.options import SolveOptions
from ssp_lp.processes.live_rows import cost_means
from ssp_lp.verification.certify import certificate_of
from written_models import written

STEP = 2.0**0.5
of_every_size = partial(evaluation.layered_measures, least_nodes=0)


def corridor(costs, dear):
    """Rooms in a row; a lift is quick, may fall, and may ask for a dear rescue."""
    rooms = {
        f"r{k}": {
            "walk": [(0.8, f"r{k + 1}", costs[0]), (0.2, f"r{max(k - 1, 0)}", costs[1])],
            "lift": [(0.93, f"r{k + 1}", costs[2]), (0.05, "shaft", 0.0), (0.02, "r0", dear)],
        }
        for k in range(5)
    }
    return model_of(rooms, "r5")


REAL = corridor([1.3, STEP, 0.4], 2.0)


def questions(model, levels):
    """One of each criterion, on few levels."""

    def utility(total):
        return 1.0 / (1.0 + total / 10.0)

    return [
        CVaR(model, "r0", 0.8, 0.2, cost_levels=levels),
        CostQuantile(model, "r0", 0.9, 0.2, cost_levels=levels),
        CostBoundedReach(model, "r0", 9.0, 0.2, cost_levels=levels),
        GUBS(model, "r0", utility, 0.5, cost_levels=levels),
        EGUBS(model, "r0", -0.1, 0.5, cost_levels=levels),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("number", range(5))
def test_a_certificate_proves_the_gap_that_the_solution_states(number):
    """Costs of one kind as well, whose rounded multiples have a unit of their own."""
    for costs in ([STEP, STEP, STEP], [STEP, 3.0**0.5, np.pi / 3.0]):
        solution = solve(questions(corridor(costs, 3.0 * STEP), 50)[number])
        certificate = certify(solution)
        assert certificate.accepted
        assert certificate.gap <= 1.1 * solution.gap + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("dear", [1e4, 1e8, 1e12])
def test_a_policy_beside_a_dear_step_can_be_evaluated(dear):
    problem = CostBoundedReach(corridor([1.3, STEP, 0.4], dear), "r0", 9.0, 0.2, cost_levels=50)
    solution = solve(problem)
    assert certify(solution).accepted
    attained = evaluate(solution.policy, problem).objective
    assert solution.objective - 1e-9 <= attained <= solution.upper_bound + 1e-9


def test_where_nothing_costs_anything_the_bound_may_be_far():
    model = corridor([0.0, 0.0, 0.0], 0.0)
    within = solve(CostBoundedReach(model, "r0", 1e9, 0.2))
    assert within.objective == pytest.approx(1.0, abs=1e-9)
    assert solve(CVaR(model, "r0", 0.8, 0.2)).objective == 0.0


def test_a_bound_that_the_policy_exceeds_is_refused():
    """From above as from below: one of the two is wrong."""
    problem = questions(REAL, 50)[2]
    found = evaluate(solve(problem).policy, problem)
    assert not certificate_of(found, 0.9 * found.objective, 1.0, above=True).accepted
    assert not certificate_of(found, 1.1 * found.objective, 1.0).accepted
    assert certificate_of(found, 1.1 * found.objective, 1.0, above=True).accepted


def test_a_unit_must_be_one_and_one_too_small_proves_nothing_false():
    """Steps that pass more layers than there are numbers overstate no success."""
    solution = solve(questions(REAL, 20)[0])
    members, least = solution.policy.policies, solution.lower_bound
    for unit in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ModelError, match="unit"):
            replace(members[0], unit=unit)
    tiny = tuple(replace(policy, unit=1e-300) for policy in members)
    forged = replace(solution, policy=MixedPolicy(tiny, solution.policy.weights))
    assert evaluate(forged.policy, solution.problem).objective >= least - 1e-9
    assert certify(forged).objective >= least - 1e-9


def pressed_at(turn, work):
    """A function at whose k-th call somebody presses Ctrl-C."""
    calls = iter(range(10))

    def interrupted(*asked):
        if next(calls) == turn:
            raise KeyboardInterrupt
        return work(*asked)

    return interrupted


def interrupted(problem, name, turn, best):
    """As good a policy as the one known, bounds that hold, and why the search ended."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(rounding, name, pressed_at(turn, getattr(rounding, name)))
        solution = solve(problem)
    assert solution.status is Status.INTERRUPTED
    evaluated = evaluate(solution.policy, best.problem).objective
    assert evaluated == pytest.approx(evaluate(best.policy, best.problem).objective, rel=1e-12)
    if solution.upper_bound is None:
        assert solution.lower_bound <= min(best.objective, solution.objective) + 1e-12
    else:
        assert solution.upper_bound >= max(best.objective, solution.objective) - 1e-12
    assert certify(solution).accepted
    return solution


@pytest.mark.parametrize("turn", [0, 1])
@pytest.mark.parametrize("number", range(5))
def test_ctrl_c_while_a_bound_is_worked_out_keeps_the_policy(number, turn, monkeypatch):
    """Units of 128 and 200 in the totals that matter: the bound of the first or of the second."""
    problem = questions(REAL, 200)[number]
    best = solve(replace(problem, cost_levels=128) if turn == 0 else problem)
    interrupted(problem, "lattice_bound", turn, best)


def test_ctrl_c_while_the_answer_is_measured_keeps_it():
    """A utility that never settles is measured beyond its table, last of all."""
    problem = questions(REAL, 50)[3]
    best = solve(problem)
    solution = interrupted(problem, "measured_costs", 0, best)
    assert solution.upper_bound == pytest.approx(best.upper_bound, rel=1e-14)
    assert solution.gap > best.gap


@pytest.mark.parametrize("budget", [None, 0.25])
@pytest.mark.parametrize("level", [0.5, 0.9])
def test_a_quantile_is_one_of_the_totals(level, budget):
    """Rounded costs find what all sums say, and prove it up to what rounding takes away."""
    exact = solve(CostQuantile(REAL, "r0", level, budget))
    solution = solve(CostQuantile(REAL, "r0", level, budget, cost_levels=1_000))
    assert solution.objective == pytest.approx(exact.objective, rel=1e-12)
    assert solution.lower_bound <= exact.objective * (1.0 + 1e-12)
    certificate = certify(solution)
    assert certificate.accepted
    assert exact.gap <= 1e-9
    assert certificate.gap <= solution.gap <= 2e-2


@pytest.mark.parametrize("budget", [None, 0.25, 1.0])
def test_a_quantile_is_nothing_where_enough_begins_at_the_goal(budget):
    start = {"r0": 0.5, "r5": 0.5}
    solution = solve(CostQuantile(REAL, start, 0.4, budget, cost_levels=200))
    assert solution.objective == solution.lower_bound == 0.0
    assert certify(solution).accepted


@pytest.mark.parametrize("levels", [None, 5])
@pytest.mark.parametrize("seed", range(4))
def test_a_stationary_optimum_needs_no_rounding(seed, levels):
    """Without a bonus the moments of the 16 stationary policies say it all."""
    draw, places = np.random.default_rng(seed), ("s0", "s1", "s2", "s3", "home", "pit")
    shares, costs = draw.dirichlet(np.ones(3), (4, 2)), draw.uniform(0.3, 2.0, (4, 2, 3))
    after = draw.integers(0, 4, (4, 2, 3))
    after[:, :, 1] = draw.integers(4, 6, (4, 2))
    choices = {
        places[s]: {
            f"a{a}": [(shares[s, a, k], places[after[s, a, k]], costs[s, a, k]) for k in range(3)]
            for a in range(2)
        }
        for s in range(4)
    }
    best = 0.0
    for chosen in product(range(2), repeat=4):
        moves, at = np.zeros((4, 6)), (np.arange(4), chosen)
        np.add.at(moves, (np.arange(4)[:, None], after[at]), shares[at] * np.exp(-costs[at]))
        best = max(best, float(np.linalg.solve(np.eye(4) - moves[:, :4], moves[:, 4])[0]))
    solution = solve(EGUBS(model_of(choices, "home"), "s0", -1.0, 0.0, cost_levels=levels))
    assert solution.objective == pytest.approx(best, rel=1e-12)
    assert solution.gap <= 1e-12
    assert certify(solution).accepted


def test_a_safest_policy_that_loses_the_goal_on_the_way_makes_no_budget_infeasible(monkeypatch):
    """Free steps may take it so long that rounding fails it: that says nothing of any budget."""
    solution = solve(CVaR(REAL, "r0", 0.8, 0.2, cost_levels=200))
    within = LayeredPricing.minimise

    def lost(self, price, *warm):
        found = within(self, price, *warm)
        return replace(found, failure=found.failure + 0.5, goal=found.goal - 0.5)

    monkeypatch.setattr(LayeredPricing, "minimise", lost)
    with pytest.raises(ModelError, match="run too long for its failure probability"):
        CVaR(corridor([1.0, 1.0, 0.0], 2.0), "r0", 0.8, 0.2).compile().least_failure()
    certificate = certify(solution)  # what the cheapest way costs, in place of a search
    assert certificate.accepted
    assert 0.0 < certificate.lower_bound <= solution.lower_bound


def test_runs_within_a_layer_that_hardly_end_are_evaluated_with_care():
    """A solver that loses a part of what ends is seen, and its totals are verified."""
    model = written("a go: 0.5 b 0, 0.3 g 1, 0.2 d 1\n b go: 0.75 a 0, 0.25 g 2")
    sweep = S3P(model, "a", 0.9).compile().pricing().sweep
    choice = sweep.empty_choice()
    choice[:] = 0
    beyond = sweep.process.measures_beyond(1.0)
    exact = sweep.measure(choice, beyond)
    with pytest.MonkeyPatch.context() as broken:
        broken.setattr(Sweep, "one_pass", None)
        solved = System.solve
        broken.setattr(System, "solve", lambda self, right, *a: 1.1 * solved(self, right, *a))
        anew = Sweep.of_ends(sweep.process)
        assert np.allclose(anew.measure(choice, beyond), exact, rtol=1e-12)


# Case S on a grid: costs split between two multiples of a unit

EXACT, FEW = 20_000, 300  # totals that are told apart


def field(size, prices, seed):
    """A windy field with prices that share no unit."""
    drawn = np.random.default_rng(seed).uniform(0.5, 2.0, prices)
    return windy_field(size, prices=drawn.tolist(), seed=seed)


def check_enclosed(found, exact, most=10**9):
    """Both sides of the optimum, by members that tell so many totals apart at most."""
    assert found.lower_bound <= exact.objective * (1.0 + 1e-9)
    assert found.objective >= exact.lower_bound * (1.0 - 1e-9)
    members = [p for p in found.policy.policies if isinstance(p, CostAwarePolicy)]
    assert all(member.cap <= most for member in members)


@pytest.mark.parametrize("unit", [Fraction(1, 7), Fraction(1, 4), Fraction(3)])
def test_splitting_keeps_every_mean(unit):
    model = field(5, 40, 1).model
    split = with_split_costs(model, unit)
    ended = dead_ends(model) | model.goal_mask
    units = split.costs[~ended[split.successors]] / float(unit)
    np.testing.assert_allclose(units, np.rint(units), atol=1e-12)
    sums = np.add.reduceat(split.probabilities, split.outcome_offsets[:-1])
    np.testing.assert_allclose(sums, 1.0, rtol=1e-14)
    weights = np.random.default_rng(0).random(model.n_states)
    means = (cost_means(each, weights) for each in (split, model))
    np.testing.assert_allclose(*means, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("discount", [None, 0.97])
def test_both_sides_enclose_the_optimum(seed, discount):
    model, start = field(4, 5, seed)
    least = 1.0 - solve(MaxProb(model, start)).objective
    budget = [least, least + 0.05, 0.5, 0.9][seed % 4] if discount is None else 0.7
    exact = solve(S3P(model, start, budget, discount, cost_levels=EXACT))
    problem = S3P(model, start, budget, discount, cost_levels=FEW)
    assert is_split(problem)
    found = solve(problem)
    check_enclosed(found, exact, FEW)
    assert found.gap < 2e-2
    played = evaluate(found.policy, problem)
    assert played.objective == pytest.approx(found.objective, rel=1e-12)
    proof = certify(found)
    assert proof.accepted
    assert proof.lower_bound <= exact.objective * (1.0 + 1e-9)
    assert proof.gap <= 1.2 * found.gap + 1e-9


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_no_more_totals_are_told_apart_than_asked(levels):
    model, start = field(4, 5, 0)
    exact = solve(S3P(model, start, 0.3, cost_levels=EXACT))
    check_enclosed(solve(S3P(model, start, 0.3, cost_levels=levels)), exact, levels)
    unit = Fraction(1, 100)
    outcome = split_optimum(exact.problem, unit, SolveOptions(), None, most=levels)
    assert outcome.compiled.layers <= levels


@pytest.mark.parametrize(
    "model",
    [
        families.hub(5, 9),
        families.ladder(3, 4),
        families.ring(30, leak=0.02),
        families.scattered(60),
        families.layered(8, 6),
    ],
    ids=["hub", "ladder", "ring", "scattered", "layered"],
)
def test_real_costs_on_every_structure(model):
    """Units far below a step, or, with few levels, far above it: both sides enclose the optimum."""
    problem = S3P(families.priced(model), 0, 0.3)
    found = solve(problem, tolerance=1e-3)
    assert found.gap <= 1e-3
    assert evaluate(found.policy, problem).objective == pytest.approx(found.objective, rel=1e-9)
    check_enclosed(solve(replace(problem, cost_levels=40), tolerance=1e-3), found)


def test_finer_units_bring_the_bounds_together_and_a_thousand_prices_are_soon_settled():
    model, start = field(6, 30, 2)
    gaps = [solve(S3P(model, start, 0.3, cost_levels=n)).gap for n in (60, 240, 960)]
    assert gaps[2] < 0.5 * gaps[1] < 0.25 * gaps[0]
    found = solve(S3P(*field(4, 1000, 0), 0.4), tolerance=1e-5)
    assert found.gap <= 1e-5
    assert found.budget_used <= 0.4 + 1e-12


@pytest.mark.slow
def test_little_time_for_many_sums_gives_a_certified_answer_on_a_grid():
    problem = S3P(*real_costs.field(24, "3 costs"), 0.3)
    assert not is_split(problem)
    found = solve(problem, time_limit=2.0)
    assert found.gap < 0.1
    proof = certify(found)
    assert proof.accepted
    assert proof.lower_bound <= proof.objective == pytest.approx(found.objective, rel=1e-12)


def test_what_failing_steps_cost_changes_nothing():
    model, start = field(4, 30, 1)
    dear = np.where(dead_ends(model)[model.successors], 1e6, model.costs)
    dearer = replace(model, costs=read_only(dear), exact_costs={})
    one, other = (solve(S3P(each, start, 0.4, cost_levels=FEW)) for each in (model, dearer))
    assert other.objective == pytest.approx(one.objective, rel=1e-12)
    assert other.lower_bound == pytest.approx(one.lower_bound, rel=1e-12)


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_rare_goals_are_measured_by_themselves(share):
    drawn, step = np.random.default_rng(0), 1e-9 ** (1 / 6)
    moves = {
        f"s{k}": {
            action: [(p, f"s{k + 1}", c * float(drawn.uniform(0.5, 2.0))), (1.0 - p, "pit", 1.0)]
            for action, p, c in [("safe", step, 3.0), ("quick", 0.9 * step, 1.0)]
        }
        for k in range(6)
    }
    problem = S3P(model_of(moves, "s6"), "s0", reach_fraction=share, cost_levels=20)
    assert is_split(problem)
    found = solve(problem)
    played = evaluate(found.policy, problem)
    assert played.objective == pytest.approx(found.objective, rel=1e-12)
    assert played.goal_probability >= share * 1e-9 * (1.0 - 1e-6)  # a budget near 1 is no finer


def test_a_gap_of_nothing_is_proved_at_once():
    model, start = field(4, 30, 2)
    least = 1.0 - solve(MaxProb(model, start)).objective
    found = solve(S3P(model, start, least, cost_levels=FEW))
    proof = certify(replace(found, lower_bound=found.objective))
    assert proof.accepted
    assert proof.gap <= 1e-9


def with_odd_costs(model, change):
    """The model with a few costs changed: those of its outcomes, [outcomes], by a function."""
    costs = np.array(model.costs)
    change(costs)
    return replace(model, costs=read_only(costs), exact_costs={})


def coarser(problem):
    return rounding.coarser_unit(problem)


def test_one_odd_cost_is_not_told_apart_where_it_hardly_matters():
    """It has a thousand times as many totals, and the optimum that never meets it does not know."""
    field = windy_field(10, diagonal=1.0)

    def odd(costs):
        costs[field.model.n_outcomes // 2] = 1.001

    model = with_odd_costs(field.model, odd)
    problem = S3P(model, field.start, 0.3)
    assert coarser(problem) == (Fraction(1), True)
    even, found = solve(S3P(field.model, field.start, 0.3)), solve(problem)
    assert "split" in found.run.reason
    assert found.objective == pytest.approx(even.objective, rel=1e-12)
    assert evaluate(found.policy, problem).objective == pytest.approx(found.objective, rel=1e-12)
    assert max(found.gap, certify(found).gap) <= 1e-9
    assert certify(found).accepted


@pytest.mark.parametrize("discount", [None, 0.97])
def test_a_policy_that_takes_no_split_cost_is_the_same_with_split_costs(discount, monkeypatch):
    """Its figures are taken from there; any other policy is evaluated on the true model."""
    field = windy_field(10, diagonal=1.0)

    def odd(costs):
        costs[:3] = 1.001, 1.003, 1.007

    problem = S3P(with_odd_costs(field.model, odd), field.start, 0.3, discount=discount)
    outcome = split_optimum(problem, Fraction(1), SolveOptions(1e-6), None)
    pricing, evaluated, takes = outcome.compiled.pricing(), [], []

    def figures(policy, stated):
        evaluated.append(evaluation.success_figures(policy, stated))
        return evaluated[-1]

    monkeypatch.setattr(rounding, "success_figures", figures)
    for price in (30.0, 60.0, 500.0):
        split = pricing.minimise(price)
        known = rounding._true_column(problem, outcome, pricing.policy(split), split)
        takes.append(rounding._takes_split_costs(pricing.policy(split), outcome, problem.model))
        told = known.cost, known.failure, known.goal
        assert told == pytest.approx(figures(known.policy, problem), rel=1e-12)
        full = evaluate(known.policy, problem)
        assert known.cost / known.goal == pytest.approx(full.objective, rel=1e-12)
        assert known.failure == pytest.approx(full.limited_failure, rel=1e-12)
    assert len(evaluated) == 3 + sum(takes) < 6, takes


@pytest.mark.parametrize("discount", [None, 0.97])
def test_many_totals_begin_at_the_price_of_fewer(discount, monkeypatch):
    """Costs of two digits: the answer is that of the search on all totals."""
    monkeypatch.setattr(rounding, "_MANY", 20.0)
    monkeypatch.setattr(rounding, "_OUTCOMES", 0)
    monkeypatch.setattr(rounding, "_FEWER", 2.0)
    model = corridor([1.13, 1.27, 0.71], 2.04)
    problem = S3P(model, "r0", 0.3, discount=discount)
    unit, is_of_most = coarser(problem)
    assert not is_of_most
    assert 4 * Fraction(1, 100) <= unit <= Fraction(71, 100)
    found = solve(problem)
    assert "then" in found.run.reason
    monkeypatch.setattr(rounding, "_MANY", np.inf)
    assert coarser(problem) is None
    known = solve(problem)
    assert found.objective == pytest.approx(known.objective, rel=1e-9)
    assert max(found.gap, certify(found).gap) <= 1e-9


def test_a_coarser_unit_is_no_larger_than_a_step(monkeypatch):
    """Else steps would be free that are not, and go round within a layer."""
    monkeypatch.setattr(rounding, "_OUTCOMES", 0)
    model = corridor([1.3, 1.4, 0.01], 2.0)
    assert coarser(S3P(model, "r0", 0.3)) is None


def test_a_coarser_unit_of_fractions_stays_one(monkeypatch):
    """Thirds, and one odd cost: what the unit makes of them is meant as fractions, too."""
    monkeypatch.setattr(rounding, "_OUTCOMES", 0)
    third, rooms = Fraction(1, 3), {}
    for k in range(8):
        cost = third * (1 + k % 3)
        on = [(0.7, f"r{k + 1}", cost), (0.2, f"r{max(k - 2, 0)}", cost), (0.1, "pit", cost)]
        rooms[f"r{k}"] = {"on": on, "slow": [(0.5, f"r{k + 1}", cost), (0.5, f"r{k}", cost)]}
    odd = Fraction(1001, 3000)
    rooms["r3"]["odd"] = [(0.9, "r4", odd), (0.1, "pit", odd)]
    problem = S3P(model_of(rooms, "r8"), "r0", 0.5)
    assert coarser(problem) == (third, True)
    found = solve(problem)
    monkeypatch.setattr(rounding, "_MANY", np.inf)
    assert found.objective == pytest.approx(solve(problem).objective, rel=1e-9)
    assert max(found.gap, certify(found).gap) <= 1e-9


@pytest.mark.parametrize("discount", [None, 0.97])
def test_both_sides_of_many_levels_meet_and_enclose_the_optimum(discount):
    """The unit follows from the first gap; the policies are measured at the true costs."""
    for seed in range(3):
        model, start = field(4, 5, seed)
        exact = solve(S3P(model, start, 0.7, discount, cost_levels=EXACT))
        split = S3P(model, start, 0.7, discount)
        found = rounding.solve_on_split_costs(split, SolveOptions(1e-4))
        check_enclosed(found, exact)
        assert found.gap <= 1e-4
        assert found.budget_used <= 0.7 * (1.0 + 1e-12)
        played = evaluate(found.policy, split)
        assert played.objective == pytest.approx(found.objective, rel=1e-12)
        assert played.limited_failure == pytest.approx(found.budget_used, rel=1e-12)


def test_levels_that_lie_evenly_lead_as_the_first_one_does():
    """Also where costs lie halfway between two levels, which a trifle tells apart."""
    model = corridor([0.75, 1.25, 0.5], 2.0)
    problem = S3P(model, "r0", 0.3)
    outcome = split_optimum(problem, Fraction(1, 2), SolveOptions(1e-6), None)
    policy = outcome.generated.columns[0].policy or outcome.policy.policies[0]
    assert isinstance(policy, CostAwarePolicy)
    column = rounding._true_column(problem, outcome, policy)
    layers = column.policy.layers()
    assert layers.even > 0
    nearest = np.abs(column.policy.levels[:-1] - model.costs.max()).argmin()
    for level in range(layers.even):
        assert (layers.leads(level) == layers.leads(0)).all()
    assert layers.leads(0).max() == nearest


def test_compiled_layers_add_up_what_layer_after_layer_does(accelerate):
    for discount in (None, 0.97):
        problem = S3P(*field(6, 30, 1), 0.7, discount)
        found = rounding.solve_on_split_costs(problem, SolveOptions(1e-4))
        measured = []
        for on in (False, True):
            accelerate(on)
            with pytest.MonkeyPatch.context() as patched:
                patched.setattr(evaluation, "layered_measures", of_every_size)
                measured.append(evaluate(found.policy, problem))
        one, other = measured
        assert one.objective == pytest.approx(other.objective, rel=1e-12)
        assert one.goal_probability == pytest.approx(other.goal_probability, rel=1e-12)
        assert one.expected_cost == pytest.approx(other.expected_cost, rel=1e-12)
        assert one.ends == pytest.approx(other.ends, rel=1e-10, abs=1e-14)
