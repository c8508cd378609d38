"""Grid models of continuous worlds: closed forms, symmetries, samples, episodes in the world."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from examples.paper_robot.robot import RobotGrid, continuous_robot
from formulations import MCMP
from refusing import refused
from ssp_lp import (
    GIVE_UP,
    Axis,
    ContinuousModel,
    DeterministicPolicy,
    Distribution,
    Grid,
    Quadrature,
    Samples,
    WorldSimulator,
    discretise,
    evaluate,
    simulate,
    solve,
)
from ssp_lp.io import fingerprint
from ssp_lp.model import discretise as building

HOPS = Distribution.discrete([-1.0, 1.0, 2.0], [0.35, 0.4, 0.25])


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
    told = []
    again = discretise(drift(), Quadrature(3), progress=lambda *done: told.append(done))
    assert fingerprint(again) == whole
    assert told[-1] == (105, 105)
    assert len(told) > 20
    assert fingerprint(discretise(robot, Quadrature(2))) == fingerprint(shared)
    # what is known of pairs that are alike changes the work, not the model
    assert fingerprint(discretise(replace(robot, alike=None), Quadrature(2))) == fingerprint(shared)


def in_ranges(world, points, size):
    """Actions and outcomes of all states, from rows of ranges of so many."""
    parts = [
        building.discretised_rows(world, points, k, min(k + size, world.n_states))
        for k in range(0, world.n_states, size)
    ]
    actions, outcomes = zip(*parts, strict=True)
    *arrays, paid = building.joined_outcomes(outcomes)
    return [np.concatenate(actions), *arrays, np.broadcast_to(paid, arrays[1].shape)]


def test_joined_pieces_keep_their_own_costs():
    robot = continuous_robot(RobotGrid(segments=4, headings=4, quadrature=2, wall_cost=5.0))
    goal = robot.end_state("goal")
    cells = building.discretised_rows(robot, Quadrature(2), 0, goal)[1]
    ends = building.discretised_rows(robot, Quadrature(2), goal, robot.n_states)[1]
    assert cells.costs.shape == ()  # one number for all outcomes
    assert 5.0 in ends.costs
    joined = building.joined_outcomes([cells, ends]).costs
    assert joined[: len(cells.successors)].tolist() == [1.0] * len(cells.successors)
    assert joined[len(cells.successors) :].tolist() == ends.costs.tolist()


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_rows_of_ranges_of_states_are_those_of_the_model(size):
    robot = continuous_robot(RobotGrid(segments=4, headings=4, quadrature=2, wall_cost=5.0))
    far = replace(robot, alike=lambda cell, turn: 10**6 * robot.alike(cell, turn))
    early = replace(drift(), allowed=lambda at, action: (at[0] < 1.0) | (action == 1))
    for world in (robot, far, drift(), early):
        model = discretise(world, Quadrature(2))
        whole = [
            np.diff(model.pair_offsets), np.diff(model.outcome_offsets), model.successors,
            model.probabilities, model.costs,
        ]  # fmt: skip
        for one, other in zip(in_ranges(world, Quadrature(2), size), whole, strict=True):
            assert np.array_equal(one, other)


def test_equal_costs_stay_what_they_are_to_the_last_bit():
    world = drift()

    def step(at, action, draws):
        moved, _, end = world.step(at, action, draws)
        return moved, np.where(end == 0, 0.1, 0.7), end

    model = discretise(replace(world, step=step), Quadrature(3, "gauss-legendre"))
    assert (model.costs[:-2] == np.where(np.isin(model.successors[:-2], [35, 36]), 0.7, 0.1)).all()


def mirrored(at, action, draws):
    """X -> 2 - x, angle -> -angle."""
    moved, cost, end = drift().step((2.0 - at[0], -at[1]), action, draws)
    return (2.0 - moved[0], -moved[1]), cost, end


def swapped(at, action, draws):
    moved, cost, end = drift().step(at[::-1], action, draws)
    return moved[::-1], cost, end


@pytest.mark.parametrize(
    ("step", "axes", "twin"),
    [
        (mirrored, drift().grid.axes, lambda column, angle: (6 - column) * 5 + 4 - angle),
        (swapped, drift().grid.axes[::-1], lambda column, angle: angle * 7 + column),
    ],
    ids=["mirrored", "swapped"],
)
def test_a_world_seen_differently_relabels_the_model(step, axes, twin):
    """Cells are renumbered, nothing else changes."""
    first = discretise(drift(), Quadrature(3))
    second = discretise(replace(drift(), grid=Grid(axes), step=step), Quadrature(3))
    twins = [twin(*divmod(cell, 5)) for cell in range(35)] + [35, 36, 37]
    for cell in range(35):
        for action in range(3):
            expected = {twins[s]: p for s, p in row(first, cell, action).items()}
            assert row(second, twins[cell], action) == pytest.approx(expected, abs=1e-14)


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


def test_actions_that_are_allowed_in_some_cells_only():
    """The model is that of all actions without the pairs that are not there."""

    def early(middle, action):
        return (middle[0] < 3.0) | (action == "creep")

    whole, some = discretise(corridor()), discretise(corridor(allowed=early))
    assert (whole.n_pairs, some.n_pairs) == (12, 9)
    for state in range(6):
        names = [some.action_of(k) for k in range(*some.pair_offsets[state : state + 2].tolist())]
        assert names == (["creep", "hop"] if state < 3 else ["creep"])
        for number in range(len(names)):
            assert row(some, state, number) == row(whole, state, number)
    assert solve(MCMP(some, 0, 0.0)).objective == 4.0  # two hops, two steps
    assert fingerprint(discretise(corridor(allowed=lambda *_: np.True_))) == fingerprint(whole)
    alike = corridor(allowed=early, alike=lambda c, a: 6 * a + c[0])
    assert fingerprint(discretise(alike)) == fingerprint(some)
    world, problem = corridor(allowed=early), MCMP(some, 0, failure_budget=0.0)
    play = {"episodes": 20, "seed": 0, "simulator": WorldSimulator(world, [0.5])}
    assert simulate(solve(problem).policy, problem, **play).conditional_cost.value == 4.0


def walk(hops=HOPS):
    """Whole hops on a line of six cells: the goal beyond the right end, a pit beyond the left."""

    def step(at, action, draws):
        moved = at[0] + draws[0] * (1.0 if action == "hop" else 0.5)
        return (moved,), 1.0, np.where(moved > 6.0, 1, np.where(moved < 0.0, 2, 0))

    return ContinuousModel(Grid([Axis(0.0, 6.0, 6)]), ["hop", "creep"], step, [hops], {"pit": 0.0})


def always(model, action):
    """The policy of one action."""
    return DeterministicPolicy.from_actions(model, dict.fromkeys(range(6), action))


def test_a_seed_is_a_model():
    first, again, other = (discretise(walk(), Samples(20, rng)) for rng in (3, 3, 4))
    assert fingerprint(first) == fingerprint(again) != fingerprint(other)
    generator = np.random.default_rng(3)
    assert fingerprint(discretise(walk(), Samples(20, generator))) == fingerprint(first)


def test_the_deviation_is_weissmans_bound():
    """Two outcomes: (2^2 - 2) exp(-n d^2 / 2) = 5 %; several pairs share what may be lost."""
    samples = Samples(1000, 0)
    assert samples.deviation(1, 2) == pytest.approx(math.sqrt(2 * math.log(2 / 0.05) / 1000))
    several = math.sqrt(2 * math.log(6 * 10 / 0.1) / 1000)
    assert samples.deviation(10, 3, 0.9) == pytest.approx(several)
    assert samples.deviation(10**6, 1) == 0.0
    assert samples.deviation(5, 10**6) == 2.0  # says nothing, and cannot be more


def test_samples_are_as_near_as_stated_and_so_is_failing():
    """Whole hops make the true grid model known: that of its discrete noise."""

    def told(model):
        """Each cell's probabilities when hopping, and what comes of it from cell 2."""
        exact = evaluate(always(model, "hop"), MCMP(model, 2, 1.0))
        rows = [[row(model, cell).get(s, 0.0) for s in range(8)] for cell in range(6)]
        return np.array(rows), exact.failure_probability, exact.expected_cost

    rows, failure, _ = told(discretise(walk(), Quadrature(1)))
    missed = 0
    for seed in range(20):
        samples = Samples(100, seed)
        drawn, fail, steps = told(discretise(walk(), samples))
        worst = np.abs(drawn - rows).sum(axis=1).max()
        missed += worst > samples.deviation(6, 3, confidence=0.8)
        assert abs(fail - failure) <= worst / 2 * steps + 1e-12
    assert missed <= 4  # at most a fifth; the bound is generous


def test_where_cells_are_exact_so_is_the_interval():
    """Whole hops from cell to cell: the world is the chain, whatever the point in the cell."""
    model = discretise(walk(), Quadrature(3))
    problem, policy = MCMP(model, 2, 1.0), always(model, "hop")
    exact = evaluate(policy, problem)
    world = WorldSimulator(walk(), [Distribution.uniform(2.0, 3.0)])
    report = simulate(policy, problem, episodes=20_000, seed=1, simulator=world, confidence=0.99)
    failed = report.failure_probability
    assert failed.low < exact.failure_probability < failed.high
    assert failed.value == pytest.approx(report.ends["pit"] / 20_000, rel=1e-12)
    assert failed.low == pytest.approx(1.0 - report.goal_probability.high)
    assert report.expected_cost.low < exact.expected_cost < report.expected_cost.high


def test_giving_up_ends_an_episode_as_a_failure():
    world = walk(Distribution.discrete([1.0], [1.0]))
    model = discretise(world, Quadrature(1))
    decisions = {cell: "hop" if cell < 4 else GIVE_UP for cell in range(6)}
    policy = DeterministicPolicy.from_actions(model, decisions)
    play = {"episodes": 7, "seed": 0, "simulator": WorldSimulator(world, [2.5]), "record": 1}
    report = simulate(policy, MCMP(model, 2, 1.0, give_up="anywhere"), **play)
    assert report.ends["gave_up"] == 7
    assert report.failure_probability.value == 1.0
    assert report.paths[0].ravel().tolist() == [2.5, 3.5, 4.5]


def test_a_step_of_the_world_is_a_step_of_the_model():
    """Frequencies from points uniform in a cell, both actions; the axis wraps."""
    grid, noise = Grid([Axis(-0.5, 7.5, 8, periodic=True)]), Distribution.uniform(0.0, 1.5)

    def step(at, turn, draw):
        return (at[0] + turn + draw[0],), 2.0, 0

    world = ContinuousModel(grid, [2.0, 5.0], step, [noise])
    model = discretise(world, Quadrature(40))
    draws, rng = 40_000, np.random.default_rng(2)
    for action in (0, 1):
        begin, pair = 5.5 + rng.random((draws, 1)), np.full(draws, 12 + action)
        after, state, cost = WorldSimulator(world, [0.0]).step(begin, pair, rng)
        share = np.bincount(state, minlength=9) / draws
        # 40,000 draws: a standard error of at most 0.0025; 40 points: at most 1 / 80
        assert all(abs(share[s] - p) < 0.02 for s, p in row(model, 6, action).items())
        assert after.min() >= -0.5
        assert after.max() < 7.5
        assert (cost == 2.0).all()


def test_reprs_are_short():
    assert repr(walk()) == (
        "ContinuousModel(the box [0, 6], 6 cells, 2 actions, 1 random numbers; ends: goal, pit)"
    )
    assert repr(HOPS) == "Distribution(3 values)"
    assert repr(Distribution(np.sqrt)) == "Distribution(<sqrt>)"


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (lambda at, a, d: (at, 1.0), "new point, cost, end"),
        (lambda at, a, d: ((at[0], at[0]), 1.0, 0), "2 coordinates"),
        (lambda at, a, d: ((at[0].ravel()[:3],), 1.0, 0), "shape"),
        (lambda at, a, d: (("left",), 1.0, 0), "real numbers"),
        (lambda at, a, d: (at, 1.0, 0.5), "whole numbers"),
        (lambda at, a, d: (at, 1.0, 3), r"outside 0 \.\. 2"),
        (lambda at, a, d: (at, 1.0, -1), r"outside 0 \.\. 2"),
        (lambda at, a, d: (at, -1.0, 0), "'hop' leads from .* to a cost"),
        (lambda at, a, d: (at, np.where(at[0] > 3, np.nan, 1.0), 0), "from .3.*to a cost"),
        (lambda at, a, d: ((np.where(at[0] > 2, np.nan, 1.0),), 1.0, 0), "NaN as coordinate 0"),
        (lambda at, a, d: ((at[0] + 9.0,), 1.0, 0), r"to \[9\..*outside the box \[0, 6\]"),
    ],
)
def test_wrong_answers_are_named(step, words):
    refused(words, discretise, replace(walk(), step=step))


def test_leaving_the_box_may_be_an_end():
    world = replace(walk(), step=lambda at, a, d: ((at[0] + 9.0,), 1.0, 0), outside="pit")
    model = discretise(world)
    assert (model.successors == world.end_state("pit")).all()
    nowhere = replace(walk(), step=lambda at, a, d: ((np.nan * at[0],), 1.0, 1))
    assert (discretise(nowhere).successors[:-1] == world.end_state("goal")).all()
    assert len(np.unique(discretise(TWO_COSTS).costs)) > 1


def allowing(allowed):
    return discretise(corridor(allowed=allowed))


TWO_COSTS = replace(walk(), step=lambda at, a, d: ((at[0] * 0.0,), at[0], 1))
"""Two cells with one successor: a claim that they are alike is refused."""

MODEL, FINE = discretise(walk()), replace(walk(), grid=Grid([Axis(0.0, 6.0, 12)]))
FINER = {"episodes": 10, "simulator": WorldSimulator(FINE, start=(3.5,))}


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: Axis(1.0, 1.0, 3), "greater high"),
        (lambda: Axis(0.0, math.inf, 3), "greater high"),
        (lambda: Axis(0.0, 1.0, 2.5), "whole number of cells"),
        (lambda: Grid([]), "at least one axis"),
        (lambda: Grid([Axis(0.0, 1.0, 70_000)] * 2), "too large"),
        (lambda: walk().grid.cell_of((6.1,)), "lies outside the box"),
        (lambda: walk().grid.cell_of((math.nan,)), "lies outside the box"),
        (lambda: walk().grid.cell_of((1.0, 2.0)), "1 coordinates"),
        (lambda: walk().grid.centre(6), r"0 \.\. 5"),
        (lambda: Distribution.uniform(1.0, 0.0), "low <= high"),
        (lambda: Distribution.discrete([0.0, 1.0], [0.5, 0.4]), "sum to 1"),
        (lambda: Distribution.discrete([0.0, 1.0], [1.5, -0.5]), "sum to 1"),
        (lambda: Distribution.discrete([0.0, math.nan], [0.5, 0.5]), "not finite"),
        (lambda: Distribution.discrete([0.0], [0.5, 0.5]), "as many values"),
        (lambda: discretise(walk(Distribution(lambda u: u / 0.0))), "finite number"),
        (lambda: replace(walk(), actions=[]), "needs actions"),
        (lambda: replace(walk(), actions=["hop", "hop"]), "needs actions"),
        (lambda: replace(walk(), outside="hole"), "not one of the dead-ends"),
        (lambda: walk().end_state("hole"), "goal, pit"),
        (lambda: walk().end_state(3), r"1 \.\. 2"),
        (lambda: discretise(walk(), 4), "Quadrature"),
        (lambda: discretise(walk(), Quadrature(0)), "number >= 1"),
        (lambda: discretise(walk(), Quadrature((4, 4, 4))), "1 of them for the axes"),
        (lambda: discretise(walk(), Quadrature(4, "simpson")), "gauss-legendre"),
        (lambda: Samples(0, 0), "whole number >= 1"),
        (lambda: Samples(5, None), "seed must be a number such as 0"),
        (lambda: Samples(5, 0).deviation(1, 0), "reachable"),
        (lambda: discretise(replace(walk(), alike=lambda c, a: a * 0.5)), "whole numbers"),
        (lambda: discretise(replace(walk(), alike=lambda c, a: c[0])), "'creep' in cell 0"),
        (lambda: WorldSimulator(walk(), [7.0]).reset(3, np.random.default_rng(0)), "outside"),
        (
            lambda: allowing(lambda at, action: at[0] < 3.0),
            r"no action .* around \[3.5\]",
        ),
        (lambda: allowing(lambda at, action: 1.0), r"allowed\(\) must return True or False"),
        (lambda: allowing(lambda at, action: [True]), r"allowed\(\) must return True or False"),
        (lambda: allowing(lambda at: True), "allowed must be a function of 2 arguments"),
        (lambda: discretise(replace(TWO_COSTS, alike=lambda c, a: c * 0)), "alike"),
        (lambda: simulate(always(MODEL, "hop"), MCMP(MODEL, 3, 1.0), seed=0, **FINER), "14 states"),
    ],
)
def test_what_cannot_be_is_refused(build, words):
    with np.errstate(divide="ignore", invalid="ignore"):
        refused(words, build)


def test_a_grid_places_its_states_in_pictures():
    """Cells lie where their middles do, ends nowhere; further axes do not count."""
    grid = Grid([Axis(0.0, 1.0, cells=2), Axis(-1.0, 1.0, cells=4), Axis(0.0, 6.0, cells=3)])
    for cell in range(grid.n_cells):
        x, y, _ = grid.centre(cell)
        assert grid.place(cell) == (int(x / 0.5), int((y + 1.0) / 0.5))
    assert grid.place(grid.n_cells) is None
    refused("whole numbers", grid.place, -1)
    refused(
        "grid.place needs a grid of at least two axes", Grid([Axis(0.0, 1.0, cells=2)]).place, 0
    )
