"""Derivatives of the optimum by its numbers: closed forms, differences of optima, and refusals."""

import pickle
from argparse import Namespace
from collections import Counter
from time import perf_counter, sleep

import matplotlib.pyplot as plt
import numpy as np
import pytest

from formulations import ISSPUDE, MCMP, S3P, CVaR, FinitePenalty, MaxProb, MinCost, MinProb
from refusing import refused
from ssp_lp import SSP, Change, OutOfTimeError, Parameter, secondary_cost, solve, within_steps
from ssp_lp.analysis import what_if as analysis_of
from ssp_lp.analysis.what_if import what_if
from ssp_lp.plotting import plot_parameter, plot_tornado
from tests.campaigns import what_if_check

plt.switch_backend("Agg")

ALLEY, ROAD = 0.10, 0.01  # chances of a wreck


def depot(alley=4.0, road=9.0):
    """One choice between a cheap and a safe way, whose wrecks cost as much as arriving."""
    return SSP.from_transitions(
        {
            "depot": {
                "alley": [(1 - ALLEY, "home", alley), (ALLEY, "wreck", alley)],
                "road": [(1 - ROAD, "home", road), (ROAD, "wreck", road)],
            },
            "wreck": {},
        },
        goal={"home"},
        treat_actionless_as_dead_ends=True,
    )


def by_name(report):
    return {effect.number.name: effect for effect in report.effects}


def test_a_lottery_of_two_actions_has_its_closed_form():
    """At budget b the alley has weight w = (b - r) / (a - r); c* = w 4 + (1 - w) 9."""
    budget = 0.05
    weight = (budget - ROAD) / (ALLEY - ROAD)
    slope = (4.0 - 9.0) / (ALLEY - ROAD)
    found = by_name(solve(MCMP(depot(), "depot", budget)).what_if())
    assert found["cost of alley in depot"].derivative == pytest.approx(weight)
    assert found["cost of road in depot"].derivative == pytest.approx(1 - weight)
    assert found["failure budget"].derivative == pytest.approx(slope)
    wreck = found["chance of wreck by alley in depot"]
    assert wreck.derivative == pytest.approx(-slope * weight)
    assert wreck.left == wreck.right
    assert "chance of home by alley in depot" not in found  # it is the rest


def test_breakpoints_are_where_an_action_leaves_the_lottery():
    report = solve(MCMP(depot(), "depot", 0.05)).what_if()
    low, high = report.breakpoints(by_name(report)["failure budget"].number)
    assert report.breakpoints("failure budget") == (low, high)
    refused("has no number 'budget'; did you mean 'failure budget'", report.breakpoints, "budget")
    assert (low, high) == pytest.approx((ROAD - 0.05, ALLEY - 0.05), abs=1e-5)
    low, high = report.breakpoints(by_name(report)["cost of road in depot"].number)
    assert low == pytest.approx(4.0 - 9.0, abs=1e-4)
    tie = SSP.from_transitions({"a": {"x": [(1.0, "home", 5.0)], "y": [(1.0, "home", 5.0)]}},
                               {"home"})  # fmt: skip
    report = solve(MinCost(tie, "a")).what_if()
    ends = report.breakpoints(by_name(report)["cost of x in a"].number)
    assert min(map(abs, ends)) < 1e-9


def test_both_sides_of_a_kink_are_told():
    """Of two ways of equal cost the optimum takes the cheaper one."""
    ways = {"bus": [(1.0, "home", 5.0)], "tram": [(1.0, "home", 5.0)]}
    model = SSP.from_transitions({"depot": ways}, {"home"})
    found = by_name(solve(MinCost(model, "depot")).what_if())
    copied = pickle.loads(pickle.dumps(solve(MinCost(model, "depot")).what_if()))  # noqa: S301
    bus = copied.effect(by_name(copied)["cost of bus in depot"].number)
    assert (bus.left, bus.right) == pytest.approx((1.0, 0.0), abs=1e-9)
    for name in ("cost of bus in depot", "cost of tram in depot"):
        assert (found[name].left, found[name].right) == pytest.approx((1.0, 0.0), abs=1e-9)
        assert found[name].derivative is None


def test_at_the_least_failure_one_side_is_infeasible():
    found = by_name(solve(MCMP(depot(), "depot", ROAD)).what_if())
    budget = found["failure budget"]
    assert budget.left is None
    assert "infeasible" in budget.note
    assert budget.right == pytest.approx((4.0 - 9.0) / (ALLEY - ROAD), rel=1e-6)


def test_a_dead_end_is_not_opened():
    model = SSP.from_transitions(
        {"a": {"go": [(0.5, "home", 1.0), (0.5, "b", 1.0)]},
         "b": {"dig": [(1.0, "b", 1.0), (0.0, "home", 1.0)]}},
        goal={"home"},
    )  # fmt: skip
    report = solve(MCMP(model, "a")).what_if()
    opened = report.effect(Change(probabilities={2: -1.0, 3: 1.0}))
    assert opened.right is None
    assert "dead-ends" in opened.note


def test_a_successor_that_an_action_does_not_have_may_be_added():
    model = SSP.from_transitions(
        {"a": {"go": [(1.0, "home", 1.0), (0.0, "pit", 1.0)]}, "pit": {}},
        goal={"home"}, treat_actionless_as_dead_ends=True,
    )  # fmt: skip
    report = solve(MaxProb(model, "a")).what_if()
    added = report.effect(Change(probabilities={0: -1.0, 1: 1.0}))
    assert added.right == pytest.approx(-1.0)
    assert added.left is None


def test_a_free_component_is_not_made_costly():
    model = SSP.from_transitions(
        {"a": {"wait": [(1.0, "a", 0.0)], "go": [(0.5, "home", 1.0), (0.5, "pit", 1.0)]},
         "pit": {}},
        goal={"home"}, treat_actionless_as_dead_ends=True,
    )  # fmt: skip
    report = solve(FinitePenalty(model, "a", 1.0)).what_if()
    changed = report.effect(Change(costs={("cost", 0): 1.0}))
    assert changed.right is None
    assert "free components" in changed.note


def test_chances_that_decide_the_least_failure_are_refused():
    equal = {"left": [(0.9, "home", 1.0), (0.1, "pit", 1.0)],
             "right": [(0.9, "home", 2.0), (0.1, "pit", 2.0)]}  # fmt: skip
    model = SSP.from_transitions({"a": equal, "pit": {}}, {"home"}, dead_ends={"pit"})
    found = by_name(solve(MCMP(model, "a")).what_if())
    assert found["chance of pit by left in a"].derivative is None
    assert "equally safe" in found["chance of pit by left in a"].note
    assert found["cost of left in a"].derivative == pytest.approx(1.0)


def test_a_share_of_the_goal_moves_with_the_chances():
    found = by_name(solve(MCMP(depot(), "depot", reach_fraction=0.95)).what_if())
    assert found["chance of wreck by alley in depot"].derivative is None
    assert found["cost of road in depot"].derivative > 0.0


def test_numbers_move_together_by_a_key_of_the_users():
    solution = solve(S3P(depot(), "depot", 0.05))
    report = solution.what_if(by=lambda number: number.successor and f"to {number.successor}")
    assert {effect.number.name for effect in report.effects} == {"to home", "to wreck"}
    alone = by_name(solution.what_if())
    apart = sum(alone[f"chance of wreck by {a} in depot"].derivative for a in ("alley", "road"))
    assert by_name(report)["to wreck"].derivative == pytest.approx(apart)


def test_a_horizon_counts_a_number_in_every_step():
    """Three tries with success p each: 1 - (1 - p)^3."""
    tries = {"a": {"try": [(0.3, "home", 1.0), (0.7, "a", 1.0)]}}
    solution = solve(MaxProb(SSP.from_transitions(tries, {"home"}), "a", horizon=3))
    (home,) = solution.what_if().effects
    assert solution.objective == pytest.approx(1 - 0.7**3)
    assert home.derivative == pytest.approx(3 * 0.7**2)


def test_the_time_limit_ends_a_program_of_ever_more_totals():
    """Tries that succeed with chance 0.001 have more totals that matter than any cap allows."""
    tries = {
        k: {"try": [(0.001, "home", 1.0), (0.5, (k + 1) % 50, 1.0), (0.499, 2 * k % 50, 1.0)]}
        for k in range(50)
    }
    solution = solve(S3P(SSP.from_transitions(tries, {"home"}), 0))
    began = perf_counter()
    refused("time limit of 0.1 s", solution.what_if, error=OutOfTimeError, time_limit=0.1)
    assert perf_counter() - began < 3.0


def test_numbers_beyond_the_time_limit_have_a_note():
    def slowly(number):
        return sleep(0.16) or number.name

    solution = solve(MCMP(depot(), "depot", 0.05))
    late = solution.what_if(by=slowly, time_limit=1.0).effects
    assert {(effect.derivative, effect.note) for effect in late} == {
        (None, "time_limit ended before")}  # fmt: skip


def test_a_memory_of_the_users_has_numbers_of_its_own():
    """On (state, tries) each try is an action of its own: the second is made with chance 0.7."""
    tries = SSP.from_transitions({"a": {"try": [(0.3, "home", 1.0), (0.7, "a", 1.0)]}}, {"home"})
    counted = within_steps(tries, 2, start={"a"})
    report = solve(MaxProb(counted, counted.start("a"))).what_if()
    found = {effect.number.state: effect for effect in report.effects}
    assert sorted(effect.derivative for effect in found.values()) == pytest.approx([0.7, 0.7])


def test_the_table_of_numbers():
    report = solve(MCMP(depot(), "depot", 0.05)).what_if()
    frame = report.to_frame()
    assert list(frame["matters"]) == sorted(frame["matters"], reverse=True)
    assert "failure budget" in str(report)
    assert repr(report) == "WhatIf(5 numbers, most: cost of road in depot)"
    axes = report.plot(most=3)
    assert len(axes.patches) == 6
    plt.close("all")


def test_other_criteria_are_refused_by_name():
    for problem in (
        CVaR(depot(), "depot", 0.9, 0.05),
        MinProb(depot(), "depot"),
        ISSPUDE(depot(), "depot"),
    ):
        refused(f"what_if supports.*{type(problem).__name__}", solve(problem).what_if)


def test_a_limit_has_a_price_on_both_its_numbers():
    fuel = secondary_cost({"depot": {"alley": 3.0, "road": 1.0}}) <= 1.5
    problem = MCMP(depot(), "depot", 0.9, constraints={"fuel": fuel})
    found = by_name(solve(problem).what_if())
    assert found["limit 'fuel'"].derivative == pytest.approx((4.0 - 9.0) / 2.0)


def chain(count=20):
    """Alike stages, each slow or fast, so that many lotteries are optimal."""
    stages = {
        k: {
            "slow": [(0.9, k + 1, 2.0), (0.1, k, 2.0)],
            "fast": [(0.85, k + 1, 1.0), (0.10, k, 1.0), (0.05, "pit", 1.0)],
        }
        for k in range(count)
    }
    return SSP.from_transitions(stages | {"pit": {}}, {count}, dead_ends={"pit"})


def test_a_chain_given_success_is_solved_once_and_asked_on_both_sides(monkeypatch):
    problem, programs, solve_program = S3P(chain(), 0, 0.2), [], analysis_of._vertex_in_time
    monkeypatch.setattr(
        analysis_of, "_vertex_in_time", lambda *of: programs.append(of) or solve_program(*of)
    )
    effects = solve(problem).what_if().effects
    assert len(programs) <= 2
    assert {effect.note for effect in effects} == {"", "slope if the lottery does not change"}
    assert all(effect.right <= effect.left + 1e-6 for effect in effects)
    found = {effect.number.name: effect for effect in effects}
    effect = found["chance of 5 by fast in 4"]
    assert effect.left - effect.right > 1.0
    by_differences = dict(what_if_check.differences(problem, effect.number.change))
    assert effect.right == pytest.approx(by_differences["right"], rel=1e-6)


def test_a_row_that_the_solver_misses_by_a_trifle_has_its_price(monkeypatch):
    """HiGHS exceeds the budget of this chain by 1.4e-9: no number needs nearby programs for it."""
    rng, stages, programs, solve_program = (
        np.random.default_rng(0),
        {},
        [],
        analysis_of._vertex_in_time,
    )
    for k in range(20):
        p = round(float(rng.uniform(0.02, 0.08)), 3)
        stages[k] = {
            "slow": [(0.9, k + 1, 2.0), (0.1, k, 2.0)],
            "fast": [(0.9 - p, k + 1, 1.0), (0.1, k, 1.0), (p, "pit", 1.0)],
        }
    model = SSP.from_transitions(stages | {"pit": {}}, {20}, dead_ends={"pit"})
    monkeypatch.setattr(
        analysis_of, "_vertex_in_time", lambda *of: programs.append(of) or solve_program(*of)
    )
    report = solve(S3P(model, 0, 0.2)).what_if(lambda number: number.kind)
    assert len(programs) <= 2
    assert by_name(report)["bound"].derivative < 0.0


@pytest.mark.parametrize("seed", [70089, 70369])
def test_optimal_lotteries_that_the_solver_misses_by_rounding_count(seed):
    """Duals off by 1e-10 left out an action that is as good as a used one: sides were wrong."""
    asked = Namespace(small=False, numbers=1.0)
    assert not list(what_if_check.check(seed, Counter(), asked))


@pytest.mark.parametrize(("seed", "name"), [(80104, "failure budget"), (70119, "limit 'lost'")])
def test_prices_are_those_of_late_states_that_are_hardly_visited(seed, name):
    """HiGHS's own tolerance left a basis whose prices were wrong by 2e-5 of their size."""
    problem = what_if_check.drawn_problem(np.random.default_rng(seed), "S3P")
    (effect,) = what_if(
        problem, lambda number: number.name if number.name == name else None
    ).effects
    exact = solve(problem, tolerance=1e-11).objective
    by_differences = what_if_check.one_sided(problem, effect.number.change, 1.0, 1e-4, exact)
    assert effect.right == pytest.approx(by_differences, rel=1e-6)


def test_a_program_that_presolve_leaves_without_a_status_is_solved_without_it():
    """HiGHS's presolve ends on a program of this problem with the status "Not Set"."""
    problem = what_if_check.drawn_problem(np.random.default_rng(70119), "S3P")
    measure = problem.with_arguments(cost_cap=96.0).program().solve("highs-simplex")
    assert (measure.solver, measure.status) == ("highs-simplex", "Optimal")


def test_no_optimal_lottery_succeeds_beyond_the_last_total():
    """The solver's own lottery does not, but another optimal one did with probability 2e-5."""
    problem = what_if_check.drawn_problem(np.random.default_rng(306174), "S3P")
    name = "chance of home by a2 in 0"
    (effect,) = what_if(
        problem, lambda number: number.name if number.name == name else None
    ).effects
    assert effect.left == pytest.approx(effect.right, rel=1e-6)


def test_a_huge_penalty_elsewhere_does_not_tie_two_ways():
    """The tram costs 1e-4 more than the bus, far from a pit whose penalty is 1e7."""
    ways = {way: [(1.0, "ford", cost)] for way, cost in (("bus", 5.0), ("tram", 5.0001))}
    ford = {"wade": [(1 - 1e-9, "home", 1.0), (1e-9, "swamp", 1.0)]}
    swamp = {"swim": [(0.5, "home", 1.0), (0.5, "pit", 1.0)]}
    table = {"depot": ways, "ford": ford, "swamp": swamp, "pit": {}}
    model = SSP.from_transitions(table, {"home"}, dead_ends={"pit"})
    found = by_name(solve(FinitePenalty(model, "depot", 1e7, give_up="dead_ends")).what_if())
    assert found["cost of bus in depot"].derivative == pytest.approx(1.0)


@pytest.mark.parametrize("charged", [False, True])
def test_two_ways_rise_together_though_a_third_is_close(charged):
    """The third costs 1.5e-5 more; failing is charged the least."""
    at = {"bus": 5.0, "tram": 5.0, "ferry": 5.0 + 1.5e-5}
    ways = {way: [(0.9, "home", cost), (0.1, "pit", cost)] for way, cost in at.items()}
    model = SSP.from_transitions({"depot": ways, "pit": {}}, {"home"}, dead_ends={"pit"})

    def rising(number):
        return "fare" if number.kind == "cost" and number.action != "ferry" else None

    (both,) = solve(MCMP(model, "depot", 0.5, charge_failing_step=charged)).what_if(rising).effects
    assert (both.left, both.right) == pytest.approx((1.0, 1.0))


def test_a_derivative_that_changes_close_by_is_said_to():
    """The budget is that of a way; another one fails 1.5e-5 more often, at a tenth of the price."""
    at = {
        "walk": (0.05, 6.0),
        "bus": (0.1, 5.0),
        "tram": (0.1 + 1.5e-5, 5.0 - 1.5e-4),
        "car": (0.2, 4.9),
    }
    ways = {way: [(1.0 - p, "home", cost), (p, "pit", cost)] for way, (p, cost) in at.items()}
    model = SSP.from_transitions({"depot": ways, "pit": {}}, {"home"}, dead_ends={"pit"})
    budget = by_name(solve(MCMP(model, "depot", 0.1)).what_if())["failure budget"]
    assert budget.left == pytest.approx(-20.0)
    assert budget.right is None
    assert "right: the derivative changes when the number moves by 1e-05" in budget.note
    assert "solve both problems and compare" in budget.note


@pytest.mark.parametrize("dies", [{}, {"sink": [(1.0, "pit", 0.5)], "burn": [(1.0, "pit", 0.5)]}])
def test_both_sides_of_a_kink_with_charges_take_one_program(dies, monkeypatch):
    """Ties of ways and of charges: each side is a linear program over the optimal actions."""
    ways = {way: [(0.8, "home", 3.0), (0.2, "pit", 3.0)] for way in ("bus", "tram")}
    model = SSP.from_transitions({"depot": ways, "pit": dies}, {"home"}, dead_ends={"pit"})
    programs, solve_program = [], analysis_of._vertex_in_time
    monkeypatch.setattr(
        analysis_of, "_vertex_in_time", lambda *of: programs.append(of) or solve_program(*of)
    )
    problem = FinitePenalty(model, "depot", 20.0, charge_failing_step=True)
    found = by_name(solve(problem).what_if())
    assert len(programs) == 1
    bus = found["cost of bus in depot"]
    assert (bus.left, bus.right) == pytest.approx((1.0, 0.0), abs=1e-9)
    for way in dies:
        burning = found[f"cost of {way} in pit"]
        assert (burning.left, burning.right) == pytest.approx((0.2, 0.0), abs=1e-9)


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 5, 6, 7, 8])
def test_derivatives_are_differences_of_optima(seed):
    tally = Counter()
    assert list(what_if_check.check(seed, tally, Namespace(small=True, numbers=4.0))) == []


@pytest.mark.slow
def test_more_draws_of_derivatives():
    assert what_if_check.main(["--count", "40", "--seed", "100", "--small"]) == 0


def test_the_numbers_of_a_tornado_are_its_bars():
    report = solve(MCMP(depot(), "depot", 0.05)).what_if()
    axes = plot_tornado(report, share=0.2)
    widths = sorted(abs(bar.get_width()) for bar in axes.patches)
    expected = sorted(0.2 * effect.weight for effect in report.effects for _ in range(2))
    assert widths == pytest.approx(expected)
    plt.close("all")
    nothing = SSP.from_transitions({"a": {"go": [(1.0, "home", 0.0)]}}, {"home"})
    refused("nothing to draw", plot_tornado, solve(MaxProb(nothing, "a")).what_if())


def test_the_slopes_of_a_curve_are_one_sided_derivatives():
    crash = Parameter("crash", 0.2)
    ways = {"fast": [(1 - crash, "home", 1.0), (crash, "pit", 1.0)], "safe": [(1.0, "home", 2.0)]}
    model = SSP.from_transitions({"road": ways, "pit": {}}, {"home"}, dead_ends={"pit"})
    at = [0.05, 0.1, 0.2]
    solutions = [solve(MCMP(model.with_parameters(crash=p), "road", 0.1)) for p in (0.2, 0.05, 0.1)]
    axes = plot_parameter(solutions, "crash")
    *tangents, curve = axes.lines
    optima = [max(1.0, 2.0 - 0.1 / p) for p in at]  # the share 0.1 / p takes the fast road
    assert curve.get_xydata().ravel() == pytest.approx(np.stack([at, optima], axis=1).ravel())
    slopes = [np.diff(line.get_ydata())[0] / np.diff(line.get_xdata())[0] for line in tangents]
    assert slopes == pytest.approx([0.0, 0.0, 0.0, 10.0, 2.5, 2.5], abs=1e-6)
    plt.close("all")
    refused("two or more models", plot_parameter, solutions[:1], "crash")
    refused("two or more models", plot_parameter, [*solutions, 3], "fuel")


def test_what_no_run_visits_has_no_value_until_it_is_visited():
    """Values of unvisited states are not unique: the sides come from optima nearby."""
    p = Parameter("p", 0.0)
    ways = {
        "a": {"go": [(1.0 - p, "home", 1.0), (p, "b", 1.0)]},
        "b": {"short": [(1.0, "home", 5.0)], "long": [(1.0, "home", 7.0)]},
    }
    model = SSP.from_transitions(ways, {"home"})
    effect = by_name(solve(FinitePenalty(model, "a", 20.0, horizon=3)).what_if())["parameter p"]
    assert effect.right == pytest.approx(5.0, rel=1e-6)
    risky = {"x": [(1.0, "home", 1.0), (0.0, "pit", 1.0)], "y": [(1.0, "home", 3.0)]}
    model = SSP.from_transitions({"a": risky, "pit": {}}, {"home"}, dead_ends={"pit"})
    report = solve(MinCost(model, "a")).what_if()
    a, pit = map(model.index_of, ("a", "pit"))
    for change in (Change(probabilities={0: -1.0, 1: 1.0}), Change(start={a: -1.0, pit: 1.0})):
        effect = report.effect(change)
        assert effect.right is None
        assert effect.note


def test_a_change_is_a_vector():
    both = Change(bounds={"failure": 1.0}) + Change(bounds={"failure": 0.5}, start={0: 1.0})
    assert dict(both.bounds) == {"failure": 1.5}
    assert dict(both.start) == {0: 1.0}
    problem = MCMP(depot(), "depot", 0.05)
    moved = Change(bounds={"failure": 1.0}).applied(problem, 0.01)
    assert np.isclose(moved.failure_budget, 0.06)


def test_starts_of_a_horizon_are_states_of_the_users_model():
    """Half of the runs begin at s, half at t; two ways at each are equally cheap."""
    ways = {f"u{k}": {"w": [(1.0, "g", 1.0)]} for k in range(4)}
    ways |= {k: {way: [(1.0, "g", cost)] for way in "xy"} for k, cost in (("s", 1.0), ("t", 3.0))}
    problem = MCMP(SSP.from_transitions(ways, goal={"g"}), {"s": 0.5, "t": 0.5}, 0.5, horizon=1)
    effects = {effect.number.name: effect for effect in what_if(problem).effects}
    moved = [effect for name, effect in effects.items() if name.startswith("start")]
    assert moved
    assert all(effect.left is None or abs(effect.left) == pytest.approx(2.0) for effect in moved)
