"""Truths about the robot example's grid model and about its continuous world."""

import io
import itertools
import math
from collections import Counter
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from examples.paper_robot.arena import TOLERANCE
from examples.paper_robot.grid import N_ACTIONS, NOISE, START_POINT, STEP_LENGTH, TURN_STEP
from examples.paper_robot.progress_bar import progress_bar
from examples.paper_robot.robot import (
    Arena,
    Box,
    Place,
    RobotGrid,
    grid_model,
    robot_simulator,
    start_state,
)
from terminal import Terminal

SMALL = RobotGrid(segments=10, headings=8, quadrature=3)
GRIDS = [RobotGrid(), SMALL, RobotGrid(quadrature=2, along_segment=True)]


def outcomes(model, pair):
    """One pair's successors with their probabilities."""
    some = slice(model.outcome_offsets[pair], model.outcome_offsets[pair + 1])
    return dict(zip(model.successors[some], model.probabilities[some], strict=True))


def brute_force(grid, pair):
    """One pair's outcomes by loops over its sampled points, in exact fractions where it matters."""
    cell, action = divmod(pair, N_ACTIONS)
    position, heading = divmod(cell, grid.headings)
    column, row = divmod(position, grid.segments)
    parts = [Fraction(2 * k + 1, 2 * grid.quadrature) for k in range(grid.quadrature)]
    share = Fraction(1, 2 * grid.quadrature**4)
    found = Counter()
    result = {}
    for x, y, turn, error in itertools.product(parts, repeat=4):
        circles = (heading + turn - Fraction(1, 2)) / grid.headings
        circles += Fraction(action - 2, 12) + (2 * error - 1) / 24
        angle = 2 * math.pi * float(circles)
        begin = float((column + x) / grid.segments), float((row + y) / grid.segments)
        motion = STEP_LENGTH * math.cos(angle), STEP_LENGTH * math.sin(angle)
        end = begin[0] + motion[0], begin[1] + motion[1]
        place = slow_place(grid, begin, motion, end)
        if place is not Place.FREE:
            found[grid.end_state(place)] += 2
            continue
        spot = [math.floor(z * grid.segments + TOLERANCE) for z in end]
        for side in (math.ceil, math.floor):
            sign = 1 if side is math.floor else -1
            new = side(circles * grid.headings + sign * Fraction(1, 2)) % grid.headings
            found[(spot[0] * grid.segments + spot[1]) * grid.headings + new] += 1
    for state, count in found.items():
        result[state] = count * share
    return result


def slow_place(grid, begin, motion, end):
    """What a step meets: at its end, or at the first of 2,000 points along it."""
    times = [k / 2000 for k in range(2001)] if grid.along_segment else [1.0]
    for time in times:
        x, y = end if time == 1.0 else [b + time * m for b, m in zip(begin, motion, strict=True)]
        for box in grid.arena.obstacles:
            if box.left <= x <= box.right and box.bottom <= y <= box.top:
                return Place.OBSTACLE
        if min(x, y) <= 0.0 or max(x, y) >= 1.0:
            return Place.WALL
        goal = grid.arena.goal
        if goal.left <= x <= goal.right and goal.bottom <= y <= goal.top:
            return Place.GOAL
    return Place.FREE


def test_size_of_the_papers_model(robot):
    grid, model = RobotGrid(), robot[0]
    assert grid.n_cells == 4800
    assert model.n_states == 4803
    assert model.n_pairs == 24_000 + 2
    assert model.n_outcomes == 219_480 + 2
    assert start_state(grid) == 504


@pytest.mark.parametrize("grid", GRIDS)
def test_probabilities_are_counts_that_sum_to_one(grid):
    model = grid_model(grid)
    doubled = model.probabilities * (2 * grid.quadrature**4)
    assert np.abs(doubled - np.rint(doubled)).max() < 1e-9
    sums = np.add.reduceat(model.probabilities, model.outcome_offsets[:-1])
    assert np.abs(sums - 1.0).max() < 1e-12


@pytest.mark.parametrize("grid", GRIDS)
def test_successors_are_distinct_and_ascend(grid):
    model = grid_model(grid)
    pairs = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    same_pair = pairs[1:] == pairs[:-1]
    assert np.all(np.diff(model.successors)[same_pair] > 0)


@pytest.mark.parametrize("grid", GRIDS)
def test_random_pairs_against_plain_loops(grid):
    model, rng = grid_model(grid), np.random.default_rng(5)
    for pair in rng.choice(N_ACTIONS * grid.n_cells, size=12, replace=False):
        expected = {s: float(p) for s, p in brute_force(grid, int(pair)).items()}
        assert outcomes(model, int(pair)) == pytest.approx(expected, abs=1e-12)


def test_progress_rises_to_its_total_and_changes_nothing():
    told = []
    model = grid_model(SMALL, lambda done, total: told.append((done, total)))
    total = told[0][1]
    done = [pairs for pairs, _ in told]
    assert done == sorted(set(done))
    assert done[-1] == total
    assert model.probabilities.tobytes() == grid_model(SMALL).probabilities.tobytes()


def test_the_progress_bar_is_for_terminals():
    file, terminal = io.StringIO(), Terminal()
    for stream in (file, terminal):
        model = grid_model(SMALL, progress=progress_bar("transitions", stream))
        assert model.n_states == SMALL.n_cells + 3
    assert file.getvalue() == ""
    lines = terminal.getvalue().split("\r")[1:]
    assert lines[-1].endswith("\n")
    assert all(line.startswith("transitions [") for line in lines)
    assert len({len(line.split("]")[0]) for line in lines}) == 1


def test_a_mirrored_arena_gives_the_mirrored_model():
    """Swapping x with y turns heading h into quarter circle - h and action a into - a."""
    swapped = Arena(
        obstacles=tuple(Box(b.bottom, b.top, b.left, b.right) for b in Arena().obstacles),
        goal=Box(0.8, 0.95, 0.75, 0.9),
    )
    grid = RobotGrid(segments=20, headings=12)
    first, second = grid_model(grid), grid_model(replace(grid, arena=swapped))

    def mirror(state):
        if state >= grid.n_cells:
            return state
        position, heading = divmod(state, grid.headings)
        column, row = divmod(position, grid.segments)
        return (row * grid.segments + column) * grid.headings + (3 - heading) % 12

    for pair in np.random.default_rng(6).choice(N_ACTIONS * grid.n_cells, size=200):
        cell, action = divmod(int(pair), N_ACTIONS)
        twin = mirror(cell) * N_ACTIONS + (N_ACTIONS - 1 - action)
        mirrored = {mirror(int(s)): p for s, p in outcomes(first, int(pair)).items()}
        assert outcomes(second, twin) == pytest.approx(mirrored, abs=1e-15)


def test_steering_error_spreads_over_neighbouring_headings_as_a_triangle():
    """Heading in the cell plus error is triangular: 1/8 beyond either side, 3/4 in the middle."""
    grid = RobotGrid(arena=Arena(obstacles=(), goal=Box(2.0, 3.0, 2.0, 3.0)))
    model = grid_model(grid)
    middle = (10 * grid.segments + 10) * grid.headings  # far from the wall, heading 0
    chances = np.zeros(grid.headings)
    for state, chance in outcomes(model, middle * N_ACTIONS + 2).items():
        chances[state % grid.headings] += chance
    assert chances[[-1, 0, 1]] == pytest.approx([1 / 8, 3 / 4, 1 / 8], abs=1e-15)


def test_wall_cost_is_the_only_cost_that_changes(robot):
    cheap = robot[0]
    dear = grid_model(RobotGrid(wall_cost=100.0))
    changed = np.flatnonzero(np.asarray(dear.costs) != np.asarray(cheap.costs))
    assert changed.tolist() == [dear.n_outcomes - 1]
    assert dear.costs[-1] == 100.0
    assert dear.successors[-1] == RobotGrid().end_state(Place.WALL)


def test_points_on_edges_belong_to_obstacles_and_wall_before_the_goal():
    arena = Arena()
    x = np.array([0.15, 0.7, 1.0, 1.0, 0.5, 0.75, 0.9, 0.7499, 0.3])
    y = np.array([0.3, 0.4, 0.7, 0.5, 0.0, 0.8, 0.95, 0.8, 0.3 - 1e-6])
    places = [Place(p).name for p in arena.classify(x, y)]
    collisions = ["OBSTACLE", "OBSTACLE", "OBSTACLE", "WALL", "WALL"]
    assert places == [*collisions, "GOAL", "GOAL", "FREE", "FREE"]


def test_first_contact_by_hand():
    arena = Arena(obstacles=(Box(0.4, 0.6, 0.4, 0.6),), goal=Box(0.8, 0.9, 0.8, 0.9))
    begin = np.array([[0.3, 0.5], [0.35, 0.55], [0.3, 0.3], [0.95, 0.85], [0.05, 0.5], [0.5, 0.1]])
    motion = np.array([[0.4, 0.0], [0.1, 0.1], [0.0, 0.4], [-0.2, 0.0], [-0.1, 0.0], [0.0, 0.2]])
    place, time = arena.first_contact(*begin.T, *motion.T)
    expected = [Place.OBSTACLE, Place.OBSTACLE, Place.FREE, Place.GOAL, Place.WALL, Place.FREE]
    assert place.tolist() == expected
    assert time == pytest.approx([0.25, 0.5, 1.0, 0.25, 0.5, 1.0], abs=1e-8)


def test_meeting_an_obstacle_and_the_wall_at_once_is_hitting_the_obstacle():
    """Askew into the corner (1, 0.75) of B and the wall: times equal to rounding are equal."""
    share, side = np.linspace(0.01, 0.99, 99), STEP_LENGTH * np.sqrt(0.5)
    begin_x, begin_y = 1.0 - share * side, 0.75 + share * side
    place, time = Arena().first_contact(begin_x, begin_y, np.asarray(side), np.asarray(-side))
    assert (place == Place.OBSTACLE).all()
    assert time == pytest.approx(share, abs=1e-7)


def test_testing_along_the_segment_only_moves_mass_to_ends_on_a_thin_obstacle():
    """A wall thinner than a step can be jumped over; tested along the step it cannot."""
    arena = Arena(obstacles=(Box(0.5, 0.51, 0.0, 1.0),), goal=Box(2.0, 3.0, 2.0, 3.0))
    jumping = RobotGrid(segments=10, headings=12, arena=arena)
    sliding = replace(jumping, along_segment=True)
    ends_only, whole = grid_model(jumping), grid_model(sliding)
    pair = ((4 * 10 + 5) * 12) * N_ACTIONS + 2  # x in [0.4, 0.5], heading 0, straight on
    obstacle = jumping.end_state(Place.OBSTACLE)
    before, after = outcomes(ends_only, pair), outcomes(whole, pair)
    assert before.get(obstacle, 0.0) < 0.5 < after[obstacle]
    assert all(after[s] <= before[s] + 1e-15 for s in after if s < jumping.n_cells)
    beyond = [s for s in after if s < jumping.n_cells and s // 120 >= 5]
    assert beyond == []


@pytest.mark.parametrize("along_segment", [False, True])
def test_continuous_steps_agree_with_the_grid(along_segment):
    """One-step frequencies from worlds uniform in a cell, against a fine quadrature of the cell.

    Width: 200,000 draws give a standard error of at most 0.0012 per successor, and 12 points
    per dimension an error of at most some 0.004; 0.01 covers both.
    """
    grid = RobotGrid(quadrature=12, along_segment=along_segment)
    model, rng = grid_model(grid), np.random.default_rng(7)
    robot, draws = robot_simulator(grid), 200_000
    for column, row, heading, action in [
        (10, 10, 3, 2),
        (4, 4, 2, 2),
        (18, 17, 6, 1),
        (1, 9, 5, 4),
    ]:
        cell = (column * grid.segments + row) * grid.headings + heading
        low = np.array([column / 20, row / 20, (heading - 0.5) * np.pi / 6])
        world = low + rng.uniform(size=(draws, 3)) * [0.05, 0.05, np.pi / 6]
        pair = cell * N_ACTIONS + action
        _, states, costs = robot.step(world, np.full(draws, pair), rng)
        frequency = np.bincount(states, minlength=grid.n_cells + 3) / draws
        expected = np.zeros(grid.n_cells + 3)
        for state, chance in outcomes(model, pair).items():
            expected[state] = chance
        assert np.abs(frequency - expected).max() < 0.01
        assert np.all(costs == 1.0)


def test_continuous_runs_start_in_the_designs_cell():
    grid = RobotGrid()
    world, states = robot_simulator(grid).reset(10_000, np.random.default_rng(8))
    assert world.min(axis=0) == pytest.approx([0.1, 0.1, -NOISE], abs=1e-3)
    assert world.max(axis=0) == pytest.approx([0.15, 0.15, NOISE], abs=1e-3)
    assert set(states.tolist()) == {start_state(grid)}


def test_actions_turn_by_thirty_degrees():
    grid, rng = RobotGrid(), np.random.default_rng(9)
    world = np.tile([0.5, 0.5, 0.0], (5, 1))
    after, _, _ = robot_simulator(grid).step(world, np.arange(5), rng)
    turned = (after[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.all(np.abs(turned - TURN_STEP * np.arange(-2, 3)) <= NOISE)
    assert np.hypot(*(after[:, :2] - world[:, :2]).T) == pytest.approx(STEP_LENGTH)
    assert START_POINT[:2] == (0.125, 0.125)
