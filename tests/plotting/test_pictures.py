"""Pictures: what is drawn is what is computed, on axes that come in and go out."""

import subprocess
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.quiver import Quiver

from formulations import MCMP, S3P
from refusing import refused
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    DeterministicPolicy,
    InfeasibleError,
    Memory,
    MissingDependencyError,
    StochasticPolicy,
    expected_cost,
    product,
    solve,
    success_costs,
    trace_frontier,
    within_steps,
)
from ssp_lp.analysis.evaluation import pair_visits
from ssp_lp.plotting import (
    BoundsRecord,
    plot_bounds,
    plot_cost_law,
    plot_episodes,
    plot_frontier,
    plot_grid_policy,
    plot_lottery,
    plot_paths,
    row_major,
)

plt.switch_backend("Agg")

MOVES = {"east": (1, 0), "south": (0, -1)}
CELLS = row_major(2, 3)


FIELD = model_of(
    {
        0: {"east": [(0.9, 1, 1.0), (0.1, 4, 1.0)], "south": [(0.5, 3, 1.0), (0.5, 0, 1.0)]},
        1: {"east": [(1.0, 2, 1.0)]},
        2: {"south": [(1.0, 5, 1.0)]},
        3: {"east": [(1.0, 5, 7.0)]},
        4: {},
    },
    5,
    labels={"pit": [4]},
)
"""Cells 0 1 2 over 3 4 5: the goal is 5; south of 0 is safe, east is quick, 4 is a pit."""

CURVE = {k: (0.05 * k, 1.0 + 9.0 * (1.0 - 0.05 * k) ** 3) for k in range(12)}
STEEP = model_of(
    {"s": {k: [(1.0 - f, "g", c), (f, "d", c)] for k, (f, c) in CURVE.items()}, "d": {}}
)
"""One state whose actions lie on a convex curve, so that there are many turning points."""

PROBLEM = MCMP(FIELD, 0, failure_budget=0.05)
each_criterion = pytest.mark.parametrize("criterion", [MCMP, S3P])


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def arrows(ax):
    """Cell -> direction, of the pictures with an arrow each."""
    (found,) = [one for one in ax.collections if isinstance(one, Quiver)]
    ways = np.column_stack([found.U, found.V])
    middles = np.round(found.XY + 0.5 * ways)
    unit = ways / np.hypot(*ways.T)[:, None]
    return {tuple(m): tuple(w.round(9)) for m, w in zip(middles.tolist(), unit, strict=True)}


def words(ax):
    legend = ax.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


def test_matplotlib_is_imported_by_pictures_alone(monkeypatch):
    code = "import sys, ssp_lp, ssp_lp.plotting; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)  # noqa: S603
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    plot = trace_frontier(PROBLEM).plot
    refused(r"pip install '\.\[plot\]'", plot, error=MissingDependencyError)


def test_visits_of_pairs_balance():
    """What flows in, with the start, flows out or ends; costs and failure are linear in it."""
    solution = solve(PROBLEM)
    model, (pairs, gave_up) = FIELD, pair_visits(solution.policy, PROBLEM)
    spread = np.repeat(pairs, np.diff(model.outcome_offsets)) * model.probabilities
    arriving = np.bincount(model.successors, spread, model.n_states)
    arriving[model.index_of(0)] += 1.0
    leaving = np.add.reduceat(np.append(pairs, 0.0), model.pair_offsets[:-1])
    leaving[np.diff(model.pair_offsets) == 0] = 0.0
    ends = arriving - leaving - gave_up
    assert ends[[model.index_of(k) for k in range(4)]] == pytest.approx(0.0, abs=1e-12)
    assert ends[model.index_of(4)] + gave_up.sum() == pytest.approx(0.05)
    cost = np.add.reduceat(model.probabilities * model.costs, model.outcome_offsets[:-1])
    assert pairs @ cost == pytest.approx(solution.objective)


def test_arrows_and_shades_are_the_policy():
    safe = DeterministicPolicy.from_actions(FIELD, {0: "south", 3: "east"})
    ax = plt.figure().subplots()
    assert plot_grid_policy(safe, PROBLEM, CELLS, MOVES, ax=ax) is ax
    assert arrows(ax) == {(0.0, 1.0): (0.0, -1.0), (0.0, 0.0): (1.0, 0.0)}
    (shades,) = [c for c in ax.collections if not isinstance(c, Quiver)]
    assert sorted(shades.get_array()) == pytest.approx([1.0, 2.0])  # half of the steps stay at 0
    assert words(ax) == ["dead-end", "goal", "start"]
    quits = DeterministicPolicy.from_actions(FIELD, {0: "east", 1: GIVE_UP})
    ax = plot_grid_policy(quits, PROBLEM, CELLS, MOVES)
    assert words(ax) == ["dead-end", "goal", "start", "gives up"]


def test_several_actions_in_a_cell_are_marked():
    sure = {1: {"east": 1}, 2: {"south": 1}, 3: {"east": 1}}
    coin = StochasticPolicy.from_actions(FIELD, {0: {"east": 0.5, "south": 0.5}, **sure})
    lottery = solve(PROBLEM).policy
    assert len(lottery.policies) == 2
    for policy in (coin, lottery):
        ax = plot_grid_policy(policy, PROBLEM, CELLS, MOVES, walls=[(3, 0)])
        assert words(ax) == ["dead-end", "wall", "goal", "start", "by chance or memory"]
    axes = plot_lottery(lottery, PROBLEM, CELLS, MOVES)
    assert [ax.get_title() for ax in axes] == ["with probability 0.5"] * 2
    assert {arrows(ax)[0.0, 1.0] for ax in axes} == {(1.0, 0.0), (0.0, -1.0)}
    assert all(len(arrows(ax)) in {2, 3} for ax in axes)


def plotted(made, cells, **options):
    """The picture of the cheapest policy of a product, whose labels are (cell, memory)."""
    problem = MCMP(made, made.start(0), failure_budget=1.0, give_up="dead_ends")
    return plot_grid_policy(solve(problem).policy, problem, cells, MOVES, **options)


def test_a_memory_is_added_up_or_left_out():
    memory = Memory(start=0, update=lambda n, state, action, to, cost: min(n + 1, 1))
    made = product(FIELD, memory, start=[0])
    whole = plotted(made, lambda label: CELLS(label[0]))
    later = plotted(made, lambda label: CELLS(label[0]) if label[1] else None)
    assert len(arrows(whole)) == len(arrows(later)) + 1
    refused("no state has a point", plotted, made, {})
    refused("the point of .* must be", plotted, made, lambda label: (1, 2, 3))


def test_a_cell_is_a_dead_end_where_all_its_states_are():
    """Within three steps one may be late anywhere; only the pit is a dead-end at every time."""
    made = within_steps(FIELD, 3, start=[0])
    ax = plotted(made, lambda label: CELLS(label[0]), walls=[(7, 7)])
    assert [patch.get_xy() for patch in ax.patches if patch.get_hatch()] == [(0.5, -0.5)]
    cell = row_major(8, 8)  # numbered by rows from above
    assert [cell(k) for k in (0, 1, 8, 63)] == [(0, 7), (1, 7), (0, 6), (7, 0)]


@pytest.mark.slow
def test_episodes_are_those_of_the_seed():
    policy = solve(PROBLEM).policy
    first, again, other = (
        plot_episodes(policy, PROBLEM, CELLS, episodes=60, seed=seed) for seed in (1, 1, 2)
    )
    drawn = [[line.get_xydata().tolist() for line in ax.lines] for ax in (first, again, other)]
    assert drawn[0] == drawn[1] != drawn[2]
    told = words(first)
    assert sum(int(word.split()[0]) for word in told if word[0].isdigit()) == 60
    assert any(word.endswith("fail: pit") for word in told)
    ax = plot_paths([np.zeros((3, 2)), np.ones((2, 3)), np.zeros((0, 2))], ["b", "a", "a"])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x", "y")
    assert words(ax) == ["2 a", "1 b"]


@each_criterion
def test_the_frontier_is_drawn_between_its_bounds(criterion):
    whole = trace_frontier(criterion(STEEP, "s"))
    part = trace_frontier(criterion(STEEP, "s"), point_limit=3)
    ax = whole.plot(look=1)
    assert words(ax) == ["least cost, gap 1.0e-09"]
    line = ax.lines[0].get_xydata()
    for budget, value in line[:: len(line) // 20]:
        assert whole.objective_at(float(budget)) == pytest.approx(value, rel=1e-12)
    ax = part.plot(float(part.failure[:2].mean()))
    assert "the optimum lies in here" in words(ax)
    assert any(" to " in word for word in words(ax))
    (band,) = ax.collections
    inside = band.get_paths()[0]
    for budget in np.linspace(*part.failure[[0, -1]], 40)[1:-1]:
        low, high = part.bounds_at(float(budget))
        if high - low > 1e-3:
            assert inside.contains_point((budget, 0.5 * (low + high)))
            assert not inside.contains_point((budget, low - 0.1))
    below = float(whole.failure[0]) - 1e-3
    refused(None, plot_frontier, whole, below, error=InfeasibleError)


@pytest.mark.parametrize(("gap", "digits"), [(1e-9, 5), (1e-3, 3), (0.1, 2)])
def test_a_coarse_frontier_shows_no_digit_that_is_not_sure(gap, digits):
    frontier = trace_frontier(MCMP(STEEP, "s"), gap=gap)
    value = float(f"{frontier.objective_at(0.123):.{digits}g}")
    assert f"budget 0.123: {value:.5g}" in words(frontier.plot(0.123))


@each_criterion
def test_the_tangent_has_the_slope_of_the_optimum(criterion):
    frontier = trace_frontier(criterion(STEEP, "s"))
    budget = float(frontier.failure[3:5].mean())
    solution = solve(criterion(STEEP, "s", failure_budget=budget))
    ax = frontier.plot(budget)
    dashed = [line for line in ax.lines if line.get_linestyle() == "-."]
    (tangent,) = [line for line in dashed if len(line.get_xdata())]
    (x0, y0), (x1, y1) = tangent.get_xydata()[[0, -1]]
    assert (y1 - y0) / (x1 - x0) == pytest.approx(-solution.budget_slope, rel=1e-6)
    price = f"{solution.failure_price:.4g}"
    assert f"tangent: failure price {price}" in words(ax)
    kink = frontier.plot(float(frontier.failure[3]))
    assert any(word.startswith("tangents: failure price") for word in words(kink))


def test_bars_are_the_law():
    model = model_of({"s": {"try": [(0.5, "g", 1.0), (0.4, "s", 1.0), (0.1, "d", 1.0)]}, "d": {}})
    problem = S3P(model, "s", failure_budget=0.5)
    law, never = (
        success_costs(DeterministicPolicy.from_actions(model, {"s": action}), problem)
        for action in ("try", GIVE_UP)
    )
    ax = plot_cost_law(law, 0.8)
    body, tail = np.zeros(20), np.zeros(20)
    for bar in ax.patches:
        place = round(bar.get_x() + 0.5 * bar.get_width())
        (tail if bar.get_hatch() else body)[place] += bar.get_height()
    shown = np.flatnonzero(body + tail)
    assert (body + tail)[shown] == pytest.approx(0.6 * 0.4 ** (shown - 1.0))
    assert 0.999 <= (body + tail).sum() <= 1.0
    assert body[:3] == pytest.approx([0.0, 0.6, 0.2])  # of the 0.24 that cost 2, 0.04 are the tail
    assert tail.sum() == pytest.approx(0.2, abs=1e-3)
    marks = [law.conditional_mean, 2.0, law.tail_mean(0.8)]
    assert [line.get_xdata()[0] for line in ax.lines] == pytest.approx(marks, rel=0.0, abs=5e-10)
    refused("never reaches", plot_cost_law, never)
    rare = model_of({"s": {"try": [(0.01, "g", 1.0), (0.99, "s", 1.0)]}})
    policy = DeterministicPolicy.from_actions(rare, {"s": "try"})
    ax = plot_cost_law(success_costs(policy, S3P(rare, "s", failure_budget=0.5)))
    assert len({round(bar.get_x(), 6) for bar in ax.patches}) == 150  # counted in intervals
    assert 0.999 <= sum(bar.get_height() for bar in ax.patches) <= 1.0


CHEAP = {"cost": expected_cost() <= 9.0}


@pytest.mark.parametrize(
    "problem",
    [MCMP(STEEP, "s", 0.12), S3P(STEEP, "s", 0.12), MCMP(STEEP, "s", 0.12, constraints=CHEAP)],
    ids=["mcmp", "s3p", "within limits"],
)
def test_bounds_close_in_on_the_optimum(problem):
    record = BoundsRecord()
    solution = solve(problem, progress=record)
    ax = plot_bounds(record, solution)
    assert ax.get_xlim()[0] == record.seconds[0]
    upper, lower = (line.get_ydata() for line in ax.lines)
    assert (np.diff(upper) <= 0.0).all()
    assert (np.diff(lower) >= 0.0).all()
    assert lower[-1] <= upper[-1] == pytest.approx(solution.objective)
    assert (lower <= solution.objective * (1 + 1e-9)).all()
    if problem.constraints:
        assert len(lower) == 1
    else:
        assert lower[-2] == pytest.approx(solution.lower_bound, rel=1e-6)  # its price proves it
