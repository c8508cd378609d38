"""The references against closed forms and one another: a yardstick that is itself measured."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st

import cost_law_models as models
from cases import ROBOT_VALUES, expected, load_case
from checks import plain
from references import combined, mcmp, mcmp_program, s3p, s3p_program
from references.chain import plain_model
from references.frontier import (
    Point,
    constrained_optimum,
    constrained_ratio,
    least_failure,
    lower_hull,
    price_interval,
)
from strategies import acyclic_problems, discounts, often, problems, semantics

EXACT = {"rel": 1e-12, "abs": 1e-12}


def case_model(name, cost):
    case = load_case(name, cost)
    return plain_model(case.floats(), case.goal), case.start


def hull_value(points, budget):
    """The frontier read off the lower hull instead of from pairs."""
    return float(np.interp(budget, *zip(*lower_hull(points), strict=True)))


FREE_LOOP = plain_model({"x": {"loop": [(1.0, "x", 0.0)], "out": [(1.0, "g", 5.0)]}}, {"g"})


@pytest.mark.parametrize("give_up", ["anywhere", "attention", "dead_ends"])
def test_wandering_in_a_free_loop_is_a_real_policy(give_up):
    """One state, a loop of cost 0, a way out of cost 5: at price 10 the way out is taken."""
    points = mcmp.points(FREE_LOOP, "x", give_up=give_up)
    assert sorted(set(points)) == [Point(0.0, 5.0), Point(1.0, 0.0)]
    assert min(cost + 10 * failure for failure, cost in points) == 5.0
    assert constrained_optimum(points, 0.25) == pytest.approx(3.75, **EXACT)
    assert price_interval(points, 0.25, 3.75) == pytest.approx((5.0, 5.0))


def test_a_paying_loop_is_given_up_on_entry_or_pays_for_ever():
    """Loop of cost 2: tau is 0 where giving up is allowed, never under "dead_ends"."""
    model = plain_model({"x": {"loop": [(1.0, "x", 2.0)], "out": [(1.0, "g", 5.0)]}}, {"g"})
    for give_up in ("anywhere", "attention"):
        assert min(mcmp.points(model, "x", give_up=give_up, charge_failing_step=False)) == (0, 5)
        charged = mcmp.points(model, "x", give_up=give_up)
        assert constrained_optimum(charged, 0.5) == pytest.approx(3.5, **EXACT)
    real = mcmp.points(model, "x", give_up="dead_ends")
    assert constrained_optimum(real, 0.5) == pytest.approx(5.0, **EXACT)
    discounted = mcmp.points(model, "x", give_up="dead_ends", discount=0.5)
    assert set(discounted) == {Point(0.5, 5.0), Point(1.0, 4.0)}


def test_charges_of_the_failing_step():
    """A dead-end charges its least action once on entry, one step after the action's own cost."""
    choices = {
        "x": {"go": [(0.5, "g", 1.0), (0.5, "d", 1.0)]},
        "d": {"a": [(1.0, "e", 7.0)], "b": [(1.0, "d", 3.0)]},
        "e": {"a": [(1.0, "d", 0.0)]},
    }
    model = plain_model(choices, {"g"})
    for give_up in ("attention", "dead_ends"):
        assert mcmp.points(model, "x", give_up=give_up) == [Point(0.5, 2.5)]
        assert mcmp.points(model, "x", give_up=give_up, discount=0.5) == [Point(0.75, 1.75)]
        assert mcmp.points(model, "d", give_up=give_up) == [Point(1.0, 3.0)]
    assert set(mcmp.points(model, "x", give_up="anywhere")) == {Point(0.5, 2.5), Point(1.0, 1.0)}
    assert mcmp.at_least_failure(model, "x", charge_failing_step=False) == (0.5, 1.0)


@pytest.mark.parametrize(("give_up", "charge", "value"), ROBOT_VALUES)
def test_four_numbers_of_the_robot(give_up, charge, value):
    """The robot of PRISM at P(goal) >= 1/4, under every meaning of giving up."""
    model, start = case_model("prism_robot_goal1", "time")
    points = mcmp.points(model, start, give_up=give_up, charge_failing_step=charge)
    assert constrained_optimum(points, 0.75) == pytest.approx(float(value), **EXACT)
    assert hull_value(points, 0.75) == pytest.approx(float(value), **EXACT)


def test_hand_cases_of_the_two_move_domain():
    """H1 = 79/49 and H2 = 8/5 at P >= 0.98."""
    model, start = case_model("gubs_test_domain", "unit")
    points = mcmp.points(model, start, give_up="anywhere", charge_failing_step=False)
    assert constrained_optimum(points, 0.02) == pytest.approx(8 / 5, **EXACT)
    assert constrained_ratio(s3p.stationary_points(model, start), 0.02) == pytest.approx(79 / 49)
    low, high = s3p_program.ratio_bounds(model, start, 0.02)
    assert (low, high) == pytest.approx((79 / 49, 79 / 49), rel=1e-9)


def test_hand_case_of_the_attack_tree():
    """H5: every successful run pays 15; the published MCMP of the same policies is 11.02."""
    model, start = case_model("prism_attacktree", "cost")
    assert s3p.at_least_failure(model, start)[1] == pytest.approx(15.0, rel=1e-12)
    least = mcmp.at_least_failure(model, start, charge_failing_step=False)
    assert least.cost == pytest.approx(11.02, rel=1e-12)


@pytest.mark.parametrize(
    "row",
    [
        row
        for row in expected()["cases"]
        if row["model"].split("_")[-1] in {"goal1", "goal2", "x1", "rewpoliter", "t1", "domain"}
    ],
    ids=lambda row: row["model"],
)
def test_enumeration_agrees_with_the_table(row):
    """The small models of the table, all columns that the references know."""
    model, start = case_model(row["model"], row["cost"])
    low, high = s3p.goal_probability_range(model, start)
    assert (low, high) == pytest.approx((row["minprob"], row["maxprob"]), rel=1e-9, abs=1e-9)
    least = mcmp.at_least_failure(model, start, charge_failing_step=False)
    assert least.cost == pytest.approx(row["mcmp_at_maxprob"], rel=1e-9)
    assert s3p.at_least_failure(model, start)[1] == pytest.approx(row["s3p_at_maxprob"], rel=1e-9)
    points = mcmp.points(model, start, give_up="anywhere", charge_failing_step=False)
    for share, value in row["min_cost_s.t._P>=f*maxprob"].items():
        budget = 1 - float(share) * high
        assert constrained_optimum(points, budget) == pytest.approx(value, rel=1e-9)
        assert hull_value(points, budget) == pytest.approx(value, rel=1e-9)


RISKY = plain_model(
    {
        "x": {"safe": [(1.0, "y", 2.0)], "fast": [(0.5, "g", 1.0), (0.5, "d", 0.0)]},
        "y": {"safe": [(0.5, "g", 1.0), (0.5, "x", 0.0)], "stay": [(1.0, "y", 1.0)]},
    },
    {"g"},
)


@pytest.mark.parametrize("discount", [None, 0.9])
@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_program_and_enumeration_of_the_product_agree(discount, share):
    """Every live state is an attention state, so six layers are exact for a small optimum."""
    model = plain_model(
        RISKY.choices | {"x": dict(RISKY.choices["x"], wait=[(1.0, "x", 1.0)])}, {"g"}
    )
    points = s3p.product_points(model, "x", 7, discount)
    least = min(p.failure for p in points)
    budget = least + share * (1 - least)
    low, high = s3p_program.ratio_bounds(model, "x", budget, discount=discount)
    assert high - low <= 1e-8
    assert constrained_ratio(points, budget) >= low - 1e-9
    assert constrained_ratio(points, budget) == pytest.approx(high, rel=1e-7)


def test_conditional_cost_of_a_geometric_trial():
    """Success p, else back at cost 1: E[cost; goal] = 1/p; discounted, q = p*g/(1-g(1-p))."""
    p, gamma = 0.25, 0.9
    model = plain_model({"x": {"try": [(p, "g", 1.0), (1 - p, "x", 1.0)]}}, {"g"})
    assert s3p.at_least_failure(model, "x") == pytest.approx((0.0, 1 / p))
    failure, value = s3p.at_least_failure(model, "x", gamma)
    turn = gamma * (1 - p)
    assert failure == pytest.approx(1 - gamma * p / (1 - turn))
    assert value == pytest.approx((p / (1 - turn) ** 2) / (1 - failure))
    assert s3p_program.ratio_bounds(model, "x", 0.5)[1] == pytest.approx(1 / p, rel=1e-9)


def test_the_price_of_the_program_is_recognised():
    """Two moves, 79/49 at budget 1/50: kappa = c* + price solves the two active inequalities."""
    model = plain_model(
        {"x": {"slow": [(1.0, "g", 2.0)], "fast": [(0.95, "g", 1.0), (0.05, "d", 1.0)]}}, {"g"}
    )
    value = 79 / 49
    price = (2 - value) / 0.02
    low, high = s3p_program.price_slack(model, "x", 0.02, value, price)
    assert (low, high) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert s3p_program.price_slack(model, "x", 0.02, value, price + 1)[0] < -1e-3
    assert s3p_program.price_slack(model, "x", 0.02, value, price - 1)[0] < -1e-3


shares = st.sampled_from([0.01, 0.1, 0.25, 0.5, 0.75, 0.95])
CLOSE = {"rel": 1e-7, "abs": 1e-8}


@often(20)
@given(problems(), semantics, discounts, shares)
def test_pairs_and_hull_and_program_give_one_frontier(drawn, meaning, discount, share):
    """The best lottery over two policies lies on the lower hull, and has a price there."""
    model = plain(drawn)
    points = mcmp.points(model, drawn.start, discount=discount, **meaning)
    data = mcmp_program.program(model, drawn.start, discount=discount, **meaning)
    least = least_failure(points)
    assert mcmp_program.least_failure(data) == pytest.approx(least, abs=1e-9)
    for budget in (least, least + share * (1 - least)):
        value = constrained_optimum(points, budget)
        assert value == pytest.approx(hull_value(points, budget), rel=1e-9, abs=1e-9)
        low, high = price_interval(points, budget, value)
        assert low <= high + 1e-6
    assert mcmp_program.least_cost(data, budget) == pytest.approx(value, **CLOSE)


@often(20)
@given(problems(), st.booleans())
def test_meanings_of_giving_up_agree_at_least_failure(drawn, charge):
    """Below it they are ordered: the freer the choice to stop, the lower the cost."""
    model = plain(drawn)
    best = mcmp.at_least_failure(model, drawn.start, charge_failing_step=charge)
    values = []
    for give_up in ("anywhere", "attention", "dead_ends"):
        points = mcmp.points(model, drawn.start, give_up=give_up, charge_failing_step=charge)
        assert least_failure(points) == pytest.approx(best.failure, abs=1e-12)
        at_least = constrained_optimum(points, best.failure)
        assert at_least == pytest.approx(best.cost, rel=1e-9, abs=1e-9)
        values.append(constrained_optimum(points, 0.5 + 0.5 * best.failure))
    assert values[0] <= values[1] + 1e-9
    assert values[1] <= values[2] + 1e-9


@often(13)
@given(acyclic_problems(), shares, discounts)
def test_product_by_enumeration_and_by_program(drawn, share, discount):
    """Runs of acyclic models end within ten layers: enumeration of the product is exact."""
    model = plain(drawn)
    least, value = s3p.at_least_failure(model, drawn.start, discount)
    if value is None:
        return
    budget = least + share * (1 - least)
    points = s3p.product_points(model, drawn.start, 10, discount)
    bounds = s3p_program.ratio_bounds(model, drawn.start, budget, discount=discount)
    assert bounds == pytest.approx([constrained_ratio(points, budget)] * 2, rel=1e-7)


@often(20)
@given(st.one_of(problems(most_live=3), problems(most_live=3, attention=True)), shares, discounts)
def test_memory_of_the_cost_never_hurts(drawn, share, discount):
    """The product's optimum is at most the best lottery over policies that see states only."""
    model = plain(drawn)
    least, value = s3p.at_least_failure(model, drawn.start, discount)
    if value is None:
        return
    budget = least + share * (1 - least)
    low, high = s3p_program.ratio_bounds(model, drawn.start, budget, discount=discount)
    stationary = constrained_ratio(s3p.stationary_points(model, drawn.start, discount), budget)
    assert low <= high + 1e-7
    assert high <= min(stationary, value) * (1 + 1e-7) + 1e-7


def test_a_false_answer_of_one_solver_is_corrected_by_another(monkeypatch):
    """HiGHS 1.8 calls some feasible programs infeasible; after two such answers they are named."""
    outs = [(0.9, "g", 1), (0.1, "d", 1)]
    task = combined.Task({"x": {"try": outs}, "d": {}, "g": {}}, frozenset({"g"}), {"x": 1.0}, {})
    task = task._replace(most_failure=None)
    written = combined.program(task, 0)
    cost, honest, wrong = written.parts["cost"], combined.linprog, [2]

    def linprog(*program, **how):
        return SimpleNamespace(status=wrong.pop(), message="") if wrong else honest(*program, **how)

    monkeypatch.setattr(combined, "linprog", linprog)
    assert combined.least(task, written, cost, ratio=False) == pytest.approx(1.0)
    wrong += [2, 2]
    with pytest.raises(AssertionError, match="least failure infeasible"):
        combined.least(task, written, cost, ratio=False)


@pytest.mark.parametrize("p", [0.5, 0.3])
def test_trying_again_until_it_works(p):
    """The geometric law, at least failure and within a budget that never helps."""
    model = plain_model(models.retry(p), {"g"})
    for bound in (0, 2, 5):
        value = models.retry_within(p, bound)
        assert s3p_program.reach_within(model, "x", bound, None) == pytest.approx(value, **CLOSE)
    for level in (0.2, 0.51, 0.75):
        for budget in (None, 0.5):
            tries = s3p_program.quantile(model, "x", level, budget)
            assert tries == models.retry_quantile(p, level)
        low, high = s3p_program.conditional_value_at_risk(model, "x", level, None)
        assert (low, high) == pytest.approx([models.retry_cvar(p, level)] * 2, **CLOSE)
    utility = s3p_program.exponential_utility(model, "x", -1.0, 2.0)
    assert utility == pytest.approx(models.retry_utility(p, -1.0) + 2.0, **CLOSE)
