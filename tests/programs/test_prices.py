"""Prices, values, slack and ranges by name: each beside what it means."""

import itertools
import re

import numpy as np
import pytest

from drawn_programs import DEPOT, REENTERED, TURNS, drawn, measures_of, with_room
from formulations import MCMP, S3P, FinitePenalty, MaxProb
from small_models import model_of
from ssp_lp import GIVE_UP, ModelError, evaluate, solve, visits
from written_models import table

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
            worth = program.sense.worth(left)
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
        worth = 0.75 * measure.value("a") + 0.25 * measure.value("b") - paid
        assert worth == pytest.approx(measure.objective, rel=1e-7, abs=1e-9)
    with pytest.raises(ModelError, match="0 rows of balance"):
        measure.value("g")
    with pytest.raises(ModelError, match="nothing is known of duals"):
        program.measure(measure.visits).value("a")


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
        assert measure.value(name) == pytest.approx(known[name], rel=1e-9)
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
                change = program.sense.worth(at.objective) - program.sense.worth(moved)
                worth = at.duals[name] * (other - bound)
                if at.activity[name] < bound - 1e-9:  # then it has no price
                    assert abs(change) <= 1e-7 * (1.0 + abs(moved))
                assert change <= worth + 1e-6 * (1.0 + abs(worth))


def test_a_frame_has_a_row_for_each_column():
    measure = MCMP(DEPOT, "depot", 0.05).program().solve()
    frame = measure.to_frame()
    assert frame["action"].tolist() == ["road", "alley"]
    assert frame["probability"].tolist() == pytest.approx([5.0 / 9.0, 4.0 / 9.0])
    assert frame["value"].tolist() == pytest.approx([measure.value("depot")] * 2)
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
