"""Truths about grid models of continuous worlds: closed forms, symmetries, what is left alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from examples.paper_robot.robot import RobotGrid, continuous_robot
from formulations import MCMP
from ssp_lp import (
    Axis,
    ContinuousModel,
    Distribution,
    Grid,
    ModelError,
    Quadrature,
    Samples,
    WorldSimulator,
    discretise,
    simulate,
    solve,
)
from ssp_lp.io import fingerprint
from ssp_lp.model import discretise as building


def row(model, state, action=0):
    """The successors of a pair with their probabilities."""
    pair = int(model.pair_offsets[state]) + action
    some = slice(model.outcome_offsets[pair], model.outcome_offsets[pair + 1])
    return dict(zip(model.successors[some].tolist(), model.probabilities[some], strict=True))


def ring(shift, noise, **axis):
    """Ten cells of width 1 in a ring; each step shifts, adds noise and costs 1."""
    line = Axis(0.0, 10.0, 10, periodic=True, **axis)
    return ContinuousModel(
        Grid([line]), ["on"], lambda at, _, draw: ((at[0] + shift + draw[0],), 1.0, 0), [noise]
    )


@pytest.mark.parametrize("points", [2, 4, 10])
def test_uniform_noise_of_a_cells_width_is_a_triangle_on_a_ring(points):
    """A uniform point plus uniform noise of the same width: 1/8, 3/4, 1/8, across the seam too."""
    noise = Distribution.uniform(-0.5, 0.5)
    model = discretise(ring(0.0, noise, split_edges=True), Quadrature(points))
    for cell in (0, 4, 9):
        expected = {(cell - 1) % 10: 1 / 8, cell: 3 / 4, (cell + 1) % 10: 1 / 8}
        assert row(model, cell) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("shift", [-0.4, 0.1, 0.5, 2.3])
def test_a_shift_divides_its_mass_by_the_cells_it_covers(shift):
    """Ten midpoints are exact for a kernel that is linear between tenths."""
    model = discretise(ring(shift, Distribution.discrete([0.0], [1.0])), Quadrature(10))
    whole = int(np.floor(shift))
    part = shift - whole
    expected = {(5 + whole) % 10: 1 - part, (6 + whole) % 10: part}
    assert row(model, 5) == pytest.approx(expected, abs=1e-15)


def test_discrete_noise_takes_its_own_values_and_normal_noise_is_even():
    steps = Distribution.discrete([-1.0, 2.0, 7.0], [0.3, 0.7, 0.0])
    assert row(discretise(ring(0.0, steps)), 4) == pytest.approx({3: 0.3, 6: 0.7}, abs=1e-15)
    bell = discretise(ring(0.0, Distribution(norm(0.0, 1.0).ppf)), Quadrature((20, 200)))
    chance = row(bell, 5)
    assert chance[4] == pytest.approx(chance[6], abs=1e-12)
    # a uniform point plus a normal number stays in the cell with 2 Phi(1) - 1 - 2 (phi(0) - phi(1))
    stays = 2 * norm.cdf(1) - 1 - 2 * (norm.pdf(0) - norm.pdf(1))
    assert chance[5] == pytest.approx(stays, abs=2e-3)


def test_gauss_and_legendre_average_a_cubic_cost_exactly():
    """Two nodes integrate x^3 from k to k + 1, ((k + 1)^4 - k^4) / 4; midpoints miss (2k+1)/32."""
    world = ContinuousModel(
        Grid([Axis(0.0, 5.0, 5)]), ["pay"], lambda at, _, __: (at, at[0] ** 3, 0)
    )
    model = discretise(world, Quadrature(2, rule="gauss-legendre"))
    edges = np.arange(6.0) ** 4
    assert model.costs == pytest.approx(np.diff(edges) / 4, rel=1e-14)
    missed = np.diff(edges) / 4 - discretise(world, Quadrature(2)).costs
    assert missed == pytest.approx((2 * np.arange(5) + 1) / 32, abs=1e-12)


def drift():
    """A plane with a goal, two ways to fail, costs that vary, and an axis that wraps."""

    def step(at, action, draws):
        (x, angle), (gust, slip) = at, draws
        moved = x + action * np.cos(angle) * 0.3 + gust
        end = np.where(moved > 2.0, 1, np.where((moved < 0.2) & (slip > 0.5), 2, 0))
        return (moved, angle + 0.4 * action + gust), 0.1 + np.abs(gust) * (moved > 1.0), end

    grid = Grid([Axis(0.0, 2.0, 7), Axis(0.0, 2 * np.pi, 5, periodic=True, split_edges=True)])
    noise = [Distribution.uniform(-0.2, 0.2), Distribution.discrete([0.0, 1.0], [0.25, 0.75])]
    return ContinuousModel(grid, (-1, 1, 2), step, noise, {"hole": 1.0, "off": 3.0}, outside="off")


@pytest.mark.parametrize("points", [Quadrature(3), Quadrature(2, "gauss-legendre"), Samples(9, 0)])
def test_what_comes_out_is_a_model_in_order(points):
    model = discretise(drift(), points)
    assert list(model.states) == list(range(38))
    assert tuple(model.action_names) == (-1, 1, 2)
    assert model.goal_mask.nonzero()[0].tolist() == [35]
    assert {k: v.tolist() for k, v in model.state_labels.items()} == {"hole": [36], "off": [37]}
    assert row(model, 37) == {37: 1.0}
    assert model.costs[-1] == 3.0
    sums = np.add.reduceat(model.probabilities, model.outcome_offsets[:-1])
    assert sums == pytest.approx(1.0, abs=1e-14)
    pair = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    assert (np.diff(model.successors)[np.diff(pair) == 0] > 0).all()


def test_pieces_change_nothing(monkeypatch):
    whole = fingerprint(discretise(drift(), Quadrature(3)))
    robot = continuous_robot(RobotGrid(segments=5, headings=4, quadrature=2))
    shared = discretise(robot, Quadrature(2))
    monkeypatch.setattr(building, "TRIALS", 200)
    monkeypatch.setattr(building, "PAIRS", 3)
    told = []
    again = discretise(drift(), Quadrature(3), progress=lambda *done: told.append(done))
    assert fingerprint(again) == whole
    assert told[-1] == (105, 105)
    assert len(told) > 20
    assert fingerprint(discretise(robot, Quadrature(2))) == fingerprint(shared)
    # what is known of pairs that are alike changes the work, not the model
    assert fingerprint(discretise(replace(robot, alike=None), Quadrature(2))) == fingerprint(shared)


def test_equal_costs_stay_what_they_are_to_the_last_bit():
    world = drift()

    def step(at, action, draws):
        moved, _, end = world.step(at, action, draws)
        return moved, np.where(end == 0, 0.1, 0.7), end

    model = discretise(replace(world, step=step), Quadrature(3, "gauss-legendre"))
    assert (model.costs[:-2] == np.where(np.isin(model.successors[:-2], [35, 36]), 0.7, 0.1)).all()


def test_a_mirrored_world_gives_the_mirrored_model():
    """X -> 2 - x, angle -> -angle: cells and actions are renumbered, nothing else changes."""
    world = drift()

    def mirrored(at, action, draws):
        moved, cost, end = world.step((2.0 - at[0], -at[1]), action, (draws[0], draws[1]))
        return (2.0 - moved[0], -moved[1]), cost, end

    first = discretise(world, Quadrature(3))
    second = discretise(replace(world, step=mirrored), Quadrature(3))

    def twin(state):
        column, angle = divmod(state, 5)
        return state if state >= 35 else (6 - column) * 5 + 4 - angle

    for cell in range(35):
        for action in range(3):
            expected = {twin(s): p for s, p in row(first, cell, action).items()}
            assert row(second, twin(cell), action) == pytest.approx(expected, abs=1e-14)


def test_coordinates_in_another_order_relabel_the_states():
    world = drift()

    def swapped(at, action, draws):
        moved, cost, end = world.step((at[1], at[0]), action, draws)
        return (moved[1], moved[0]), cost, end

    other = replace(world, grid=Grid(world.grid.axes[::-1]), step=swapped)
    first, second = discretise(world, Quadrature(2)), discretise(other, Quadrature(2))

    def twin(state):
        return state if state >= 35 else state % 5 * 7 + state // 5

    for cell in range(35):
        expected = {twin(s): p for s, p in row(first, cell, 2).items()}
        assert row(second, twin(cell), 2) == pytest.approx(expected, abs=1e-15)


def test_every_centre_lies_in_its_cell():
    grid = drift().grid
    cells = np.arange(grid.n_cells)
    assert (grid.cell_of(grid.centre(cells)) == cells).all()
    assert grid.cell_of((2.0, 0.0)) == 30  # the upper end belongs to the last cell
    assert grid.cell_of((0.0, -0.1)) == 4 == grid.cell_of((0.0, 4 * np.pi - 0.1))


def corridor(**more):
    """Six cells and a goal behind them; hopping takes two cells, creeping one."""

    def hop(at, action, noise):
        there = at[0] + (2.0 if action == "hop" else 1.0)
        return (there,), 1.0, (there >= 6.0).astype(np.int64)

    axis = Axis(0.0, 6.0, 6)
    return ContinuousModel(Grid([axis]), ("creep", "hop"), hop, **more)


def no_hopping_beyond(limit):
    return lambda middle, action: (middle[0] < limit) | (action == "creep")


def test_actions_that_are_allowed_in_some_cells_only():
    """The model is that of all actions without the pairs that are not there."""
    whole, some = discretise(corridor()), discretise(corridor(allowed=no_hopping_beyond(3.0)))
    assert (whole.n_pairs, some.n_pairs) == (12, 9)
    for state in range(6):
        names = [some.action_of(k) for k in range(*some.pair_offsets[state : state + 2].tolist())]
        assert names == (["creep", "hop"] if state < 3 else ["creep"])
        for number in range(len(names)):
            assert row(some, state, number) == row(whole, state, number)
    assert solve(MCMP(some, 0, 0.0)).objective == 4.0  # two hops, two steps
    assert fingerprint(discretise(corridor(allowed=lambda *_: np.True_))) == fingerprint(whole)
    alike = corridor(allowed=no_hopping_beyond(3.0), alike=lambda c, a: 6 * a + c[0])
    assert fingerprint(discretise(alike)) == fingerprint(some)


def test_the_world_takes_the_actions_that_its_cells_allow():
    world = corridor(allowed=no_hopping_beyond(3.0))
    model = discretise(world)
    problem = MCMP(model, 0, failure_budget=0.0)
    played = simulate(
        solve(problem).policy, problem, episodes=20, rng=0, simulator=WorldSimulator(world, [0.5])
    )
    assert played.conditional_cost.value == 4.0


@pytest.mark.parametrize(
    ("allowed", "words"),
    [
        (lambda middle, action: middle[0] < 3.0, r"no action is allowed in the cell about \[3.5\]"),
        (lambda middle, action: 1.0, "allowed must return a truth value"),
        (lambda middle, action: [True], "allowed must return a truth value"),
        (lambda middle: True, "allowed must be a function of 2 arguments"),
    ],
)
def test_what_allows_nothing_or_says_no_truth_is_refused(allowed, words):
    with pytest.raises(ModelError, match=words):
        discretise(corridor(allowed=allowed))
