"""Pictures: what is drawn is what is computed, on axes that come in and go out."""

import subprocess
import sys

import numpy as np
import pytest

from formulations import MCMP, S3P
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    Memory,
    MissingDependencyError,
    ModelError,
    StochasticPolicy,
    expected_cost,
    product,
    solve,
    success_costs,
    trace_frontier,
    within_steps,
)
from ssp_lp.analysis.evaluation import pair_visits

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.quiver import Quiver  # noqa: E402

from small_models import model_of  # noqa: E402
from ssp_lp.plotting import (  # noqa: E402
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

MOVES = {"east": (1, 0), "south": (0, -1)}
CELLS = row_major(2, 3)


def field():
    """Cells 0 1 2 over 3 4 5: the goal is 5; south of 0 is safe, east is quick, 4 is a pit."""
    return model_of(
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


PROBLEM = MCMP(field(), 0, failure_budget=0.05)


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


def test_the_library_does_not_import_matplotlib():
    code = "import sys, ssp_lp, ssp_lp.plotting; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)  # noqa: S603


def test_without_matplotlib_the_pip_line_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'ssp-lp\[plot\]'"):
        trace_frontier(PROBLEM).plot()


def test_visits_of_pairs_balance():
    """What flows in, with the start, flows out or ends; costs and failure are linear in it."""
    solution = solve(PROBLEM)
    model, (pairs, gave_up) = PROBLEM.model, pair_visits(solution.policy, PROBLEM)
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
    model = PROBLEM.model
    safe = DeterministicPolicy.from_actions(model, {0: "south", 3: "east"})
    ax = plt.figure().subplots()
    assert plot_grid_policy(safe, PROBLEM, CELLS, MOVES, ax=ax) is ax
    assert arrows(ax) == {(0.0, 1.0): (0.0, -1.0), (0.0, 0.0): (1.0, 0.0)}
    (shades,) = [c for c in ax.collections if not isinstance(c, Quiver)]
    assert sorted(shades.get_array()) == pytest.approx([1.0, 2.0])  # half of the steps stay at 0
    assert words(ax) == ["dead-end", "goal", "start"]
    quits = DeterministicPolicy.from_actions(model, {0: "east", 1: GIVE_UP})
    assert words(plot_grid_policy(quits, PROBLEM, CELLS, MOVES)) == [
        "dead-end", "goal", "start", "gives up",
    ]  # fmt: skip


def test_several_actions_in_a_cell_are_marked():
    model = PROBLEM.model
    coin = StochasticPolicy.from_actions(
        model, {0: {"east": 0.5, "south": 0.5}, 1: {"east": 1}, 2: {"south": 1}, 3: {"east": 1}}
    )
    lottery = solve(PROBLEM).policy
    assert len(lottery.policies) == 2
    for policy in (coin, lottery):
        ax = plot_grid_policy(policy, PROBLEM, CELLS, MOVES, walls=[(3, 0)])
        assert words(ax) == ["dead-end", "wall", "goal", "start", "by chance or memory"]
    axes = plot_lottery(lottery, PROBLEM, CELLS, MOVES)
    assert [ax.get_title() for ax in axes] == ["with probability 0.5"] * 2
    assert {arrows(ax)[0.0, 1.0] for ax in axes} == {(1.0, 0.0), (0.0, -1.0)}
    assert all(len(arrows(ax)) in {2, 3} for ax in axes)


def test_a_memory_is_added_up_or_left_out():
    model = PROBLEM.model
    memory = Memory(start=0, update=lambda n, state, action, to, cost: min(n + 1, 1))
    made = product(model, memory, start=[0])
    problem = MCMP(made, made.start(0), failure_budget=1.0, give_up="dead_ends")
    policy = solve(problem).policy
    whole = plot_grid_policy(policy, problem, lambda label: CELLS(label[0]), MOVES)
    later = plot_grid_policy(
        policy, problem, lambda label: CELLS(label[0]) if label[1] else None, MOVES
    )
    assert len(arrows(whole)) == len(arrows(later)) + 1
    with pytest.raises(ModelError, match="no state has a point"):
        plot_grid_policy(policy, problem, {}, MOVES)
    with pytest.raises(ModelError, match="must lie at a point"):
        plot_grid_policy(policy, problem, lambda label: (1, 2, 3), MOVES)


def test_a_cell_is_a_dead_end_where_all_its_states_are():
    """Within three steps one may be late anywhere; only the pit is a dead-end at every time."""
    made = within_steps(PROBLEM.model, 3, start=[0])
    problem = MCMP(made, made.start(0), failure_budget=1.0, give_up="dead_ends")
    ax = plot_grid_policy(
        solve(problem).policy, problem, lambda label: CELLS(label[0]), MOVES, walls=[(7, 7)]
    )
    hatched = [patch.get_xy() for patch in ax.patches if patch.get_hatch()]
    assert hatched == [(0.5, -0.5)]


def test_cells_are_numbered_by_rows_from_above():
    place = row_major(8, 8)
    assert [place(k) for k in (0, 1, 8, 63)] == [(0, 7), (1, 7), (0, 6), (7, 0)]


def test_episodes_are_those_of_the_seed():
    policy = solve(PROBLEM).policy
    first, again, other = (
        plot_episodes(policy, PROBLEM, CELLS, episodes=60, rng=seed) for seed in (1, 1, 2)
    )
    drawn = [[line.get_xydata().tolist() for line in ax.lines] for ax in (first, again, other)]
    assert drawn[0] == drawn[1] != drawn[2]
    told = words(first)
    assert sum(int(word.split()[0]) for word in told if word[0].isdigit()) == 60
    assert any(word.endswith("fail: pit") for word in told)
    ax = plot_paths([np.zeros((3, 2)), np.ones((2, 3)), np.zeros((0, 2))], ["b", "a", "a"])
    assert words(ax) == ["2 a", "1 b"]


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_the_frontier_is_drawn_between_its_bounds(criterion):
    whole = trace_frontier(criterion(steep(), "s"))
    part = trace_frontier(criterion(steep(), "s"), point_limit=3)
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
    with pytest.raises(InfeasibleError):
        plot_frontier(whole, float(whole.failure[0]) - 1e-3)


@pytest.mark.parametrize(("gap", "digits"), [(1e-9, 5), (1e-3, 3), (0.1, 2)])
def test_a_coarse_frontier_shows_no_digit_that_is_not_sure(gap, digits):
    frontier = trace_frontier(MCMP(steep(), "s"), gap=gap)
    value = float(f"{frontier.objective_at(0.123):.{digits}g}")
    assert f"budget 0.123: {value:.5g}" in words(frontier.plot(0.123))


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_the_tangent_has_the_slope_of_the_optimum(criterion):
    frontier = trace_frontier(criterion(steep(), "s"))
    budget = float(frontier.failure[3:5].mean())
    solution = solve(criterion(steep(), "s", failure_budget=budget))
    ax = frontier.plot(budget)
    (tangent,) = [
        line for line in ax.lines if line.get_linestyle() == "-." and len(line.get_xdata())
    ]
    (x0, y0), (x1, y1) = tangent.get_xydata()[[0, -1]]
    assert (y1 - y0) / (x1 - x0) == pytest.approx(-solution.budget_slope, rel=1e-6)
    price = f"{solution.failure_price:.4g}"
    assert f"tangent: failure price {price}" in words(ax)
    kink = frontier.plot(float(frontier.failure[3]))
    assert any(word.startswith("tangents: failure price") for word in words(kink))


def steep():
    """One state whose actions lie on a convex curve, so that there are many turning points."""
    pairs = {k: (0.05 * k, 1.0 + 9.0 * (1.0 - 0.05 * k) ** 3) for k in range(12)}
    return model_of(
        {"s": {k: [(1.0 - f, "g", c), (f, "d", c)] for k, (f, c) in pairs.items()}, "d": {}}
    )


def test_bars_are_the_law():
    model = model_of({"s": {"try": [(0.5, "g", 1.0), (0.4, "s", 1.0), (0.1, "d", 1.0)]}, "d": {}})
    problem = S3P(model, "s", failure_budget=0.5)
    policy = DeterministicPolicy.from_actions(model, {"s": "try"})
    law = success_costs(policy, problem)
    ax = plot_cost_law(law, 0.8)
    body, tail = np.zeros(20), np.zeros(20)
    for bar in ax.patches:
        (tail if bar.get_hatch() else body)[round(bar.get_x() + 0.5 * bar.get_width())] += (
            bar.get_height()
        )
    shown = np.flatnonzero(body + tail)
    assert (body + tail)[shown] == pytest.approx(0.6 * 0.4 ** (shown - 1.0))
    assert 0.999 <= (body + tail).sum() <= 1.0
    assert body[:3] == pytest.approx([0.0, 0.6, 0.2])  # of the 0.24 that cost 2, 0.04 are the tail
    assert tail.sum() == pytest.approx(0.2, abs=1e-3)
    assert [round(line.get_xdata()[0], 9) for line in ax.lines] == [
        round(law.conditional_mean, 9), 2.0, round(law.tail_mean(0.8), 9),
    ]  # fmt: skip
    with pytest.raises(ModelError, match="never reaches"):
        plot_cost_law(
            success_costs(DeterministicPolicy.from_actions(model, {"s": GIVE_UP}), problem)
        )


def test_many_costs_are_counted_in_intervals():
    rare = SSP.from_transitions({"s": {"try": [(0.01, "g", 1.0), (0.99, "s", 1.0)]}}, goal={"g"})
    problem = S3P(rare, "s", failure_budget=0.5)
    law = success_costs(DeterministicPolicy.from_actions(rare, {"s": "try"}), problem)
    ax = plot_cost_law(law)
    assert len({round(bar.get_x(), 6) for bar in ax.patches}) == 150
    assert 0.999 <= sum(bar.get_height() for bar in ax.patches) <= 1.0


def test_bounds_close_in_on_the_optimum():
    for criterion in (MCMP, S3P):
        record = BoundsRecord()
        problem = criterion(steep(), "s", failure_budget=0.12)
        solution = solve(problem, progress=record)
        ax = plot_bounds(record, solution)
        upper, lower = (line.get_ydata() for line in ax.lines)
        assert (np.diff(upper) <= 0.0).all()
        assert (np.diff(lower) >= 0.0).all()
        assert lower[-1] <= upper[-1] == pytest.approx(solution.objective)
        assert (lower <= solution.objective * (1 + 1e-9)).all()
        assert lower[-2] == pytest.approx(solution.lower_bound, rel=1e-6)  # its price proves it
    limited = MCMP(steep(), "s", failure_budget=0.12, constraints={"cost": expected_cost() <= 9.0})
    record = BoundsRecord()
    assert len(plot_bounds(record, solve(limited, progress=record)).lines[1].get_ydata()) == 1
