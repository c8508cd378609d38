"""The paper's robot (section 4): its grid model and world, and answers that are proved."""

import io
import itertools
import math
from collections import Counter
from dataclasses import replace
from fractions import Fraction
from functools import cache

import numpy as np
import pytest

from examples.paper_robot import obstacle_avoidance
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
from examples.paper_robot.study import BUDGET, DESIGNS, DISCOUNT, IN_BETWEEN, READINGS, try_out
from examples.paper_robot.tables import PAPER
from examples.paper_robot.true_costs import TOLERANCE as TRUE_GAP, designed, main as true_costs
from formulations import MCMP, S3P
from ssp_lp import ModelError, certify, evaluate, solve
from terminal import Terminal

SMALL = RobotGrid(segments=10, headings=8, quadrature=3)
PAPERS = READINGS[0].grid
GRIDS = [RobotGrid(), SMALL, RobotGrid(quadrature=2, points_on_the_way=None), PAPERS]
each_case = pytest.mark.parametrize("criterion", [MCMP, S3P])
each_discount = pytest.mark.parametrize("discount", [None, 0.999])


def outcomes(model, pair):
    """One pair's successors with their probabilities."""
    some = slice(model.outcome_offsets[pair], model.outcome_offsets[pair + 1])
    return dict(zip(model.successors[some], model.probabilities[some], strict=True))


def points_of(grid):
    """How many points there are in x, y, theta and the steering error."""
    return grid.quadrature if isinstance(grid.quadrature, tuple) else (grid.quadrature,) * 4


def brute_force(grid, pair):
    """One pair's outcomes by loops over its sampled points, in exact fractions where it matters."""
    cell, action = divmod(pair, N_ACTIONS)
    position, heading = divmod(cell, grid.headings)
    column, row = divmod(position, grid.segments)
    parts = [[Fraction(2 * k + 1, 2 * n) for k in range(n)] for n in points_of(grid)]
    share = Fraction(1, 2 * math.prod(points_of(grid)))
    found = Counter()
    for x, y, turn, error in itertools.product(*parts):
        circles = (heading + turn - Fraction(1, 2)) / grid.headings
        circles += Fraction(action - 2, 12) + (2 * error - 1) / 24
        angle = 2 * math.pi * float(circles)
        begin = float((column + x) / grid.segments), float((row + y) / grid.segments)
        motion = STEP_LENGTH * math.cos(angle), STEP_LENGTH * math.sin(angle)
        end = begin[0] + motion[0], begin[1] + motion[1]
        place = slow_place(grid, begin, motion, end)
        if place is not Place.FREE:
            found[grid.end_state(place)] += 2 * share
            continue
        spot = [math.floor(z * grid.segments + TOLERANCE) for z in end]
        for side in (math.ceil, math.floor):
            sign = 1 if side is math.floor else -1
            new = side(circles * grid.headings + sign * Fraction(1, 2)) % grid.headings
            found[(spot[0] * grid.segments + spot[1]) * grid.headings + new] += share
    return found


def slow_place(grid, begin, motion, end):
    """What a step meets: at the first of so many points along it, 2,000 for anywhere."""
    points = grid.points_on_the_way or 2000
    times = [k / points for k in range(1 if grid.points_on_the_way else 0, points + 1)]
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
    assert (grid.n_cells, model.n_states, start_state(grid)) == (4800, 4803, 504)
    assert (model.n_pairs, model.n_outcomes) == (24_000 + 2, 219_480 + 2)


@pytest.mark.parametrize("grid", GRIDS)
def test_probabilities_are_counts_and_those_of_plain_loops(grid):
    model, rng = grid_model(grid), np.random.default_rng(5)
    doubled = model.probabilities * (2 * math.prod(points_of(grid)))
    assert np.abs(doubled - np.rint(doubled)).max() < 1e-9
    sums = np.add.reduceat(model.probabilities, model.outcome_offsets[:-1])
    assert np.abs(sums - 1.0).max() < 1e-12
    pairs = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    assert np.all(np.diff(model.successors)[np.diff(pairs) == 0] > 0)
    for pair in rng.choice(N_ACTIONS * grid.n_cells, size=12, replace=False):
        expected = {s: float(p) for s, p in brute_force(grid, int(pair)).items()}
        assert outcomes(model, int(pair)) == pytest.approx(expected, abs=1e-12)


def test_progress_rises_to_its_total_and_is_shown_on_terminals():
    told = []
    model = grid_model(SMALL, lambda *done: told.append(done))
    done = [pairs for pairs, _ in told]
    assert done == sorted(set(done))
    assert done[-1] == told[0][1]
    file, terminal = io.StringIO(), Terminal()
    for stream in (file, terminal):
        again = grid_model(SMALL, progress=progress_bar("transitions", stream))
        assert again.probabilities.tobytes() == model.probabilities.tobytes()
    assert file.getvalue() == ""
    lines = terminal.getvalue().split("\r")[1:]
    assert lines[-1].endswith("\n")
    assert all(line.startswith("transitions [") for line in lines)
    assert len({len(line.split("]")[0]) for line in lines}) == 1


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
    sliding = replace(jumping, points_on_the_way=None)
    ends_only, whole = grid_model(jumping), grid_model(sliding)
    pair = ((4 * 10 + 5) * 12) * N_ACTIONS + 2  # x in [0.4, 0.5], heading 0, straight on
    obstacle = jumping.end_state(Place.OBSTACLE)
    before, after = outcomes(ends_only, pair), outcomes(whole, pair)
    assert before.get(obstacle, 0.0) < 0.5 < after[obstacle]
    assert all(after[s] <= before[s] + 1e-15 for s in after if s < jumping.n_cells)
    beyond = [s for s in after if s < jumping.n_cells and s // 120 >= 5]
    assert beyond == []


def test_continuous_runs_start_in_the_designs_cell_and_turn_by_thirty_degrees():
    grid = RobotGrid()
    world, states = robot_simulator(grid).reset(10_000, np.random.default_rng(8))
    assert world.min(axis=0) == pytest.approx([0.1, 0.1, -NOISE], abs=1e-3)
    assert world.max(axis=0) == pytest.approx([0.15, 0.15, NOISE], abs=1e-3)
    assert set(states.tolist()) == {start_state(grid)}
    rng = np.random.default_rng(9)
    world = np.tile([0.5, 0.5, 0.0], (5, 1))
    after, _, _ = robot_simulator(grid).step(world, np.arange(5), rng)
    turned = (after[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.all(np.abs(turned - TURN_STEP * np.arange(-2, 3)) <= NOISE)
    assert np.hypot(*(after[:, :2] - world[:, :2]).T) == pytest.approx(STEP_LENGTH)
    assert START_POINT[:2] == (0.125, 0.125)


@cache
def solved(criterion, model, start, discount=None):
    """The robot within its budget, for all tests of one worker."""
    return solve(criterion(model, start, failure_budget=BUDGET, discount=discount))


@each_discount
@each_case
def test_answers_are_certified_and_one_randomised_policy_does_as_much(robot, criterion, discount):
    """Section 2.2: one randomised stationary policy does what the lottery does."""
    solution = solved(criterion, *robot, discount)
    certificate = certify(solution)
    assert certificate.accepted
    assert max(certificate.gap, solution.gap) <= 1e-8
    assert len(solution.policy.policies) <= 2
    limited = solution.discounted_failure if discount else solution.failure_probability
    assert solution.failure_probability - 1e-12 <= limited <= BUDGET + 1e-12  # t2-2
    objective = evaluate(solution.policy, solution.problem).objective
    assert objective == pytest.approx(solution.objective, rel=1e-10)
    found = evaluate(solution.randomised_policy, solution.problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-9)
    limited = found.discounted_failure if discount else found.failure_probability
    assert limited == pytest.approx(BUDGET, abs=1e-11)


@pytest.mark.slow
def test_the_full_linear_program_agrees_in_case_m():
    grid = RobotGrid(segments=12, headings=8, quadrature=3)
    columns = solved(MCMP, grid_model(grid), start_state(grid))
    program = solve(columns.problem, "lp")
    assert (columns.method, program.method) == ("columns", "lp")
    assert program.objective == pytest.approx(columns.objective, rel=1e-7)
    assert program.failure_price == pytest.approx(columns.failure_price, rel=1e-6)
    printed = float(program.run.program.split()[1].rstrip(","))
    assert printed == pytest.approx(columns.objective, rel=1e-7)


def test_a_dearer_wall_changes_only_case_m(robot):
    grid = RobotGrid(wall_cost=100.0)
    dear = grid_model(grid), start_state(grid)
    (cost, conditional), (dearer, same) = (
        [solved(criterion, *one).objective for criterion in (MCMP, S3P)] for one in (robot, dear)
    )
    assert same == pytest.approx(conditional, rel=1e-12)
    assert dearer > cost + 0.1


@cache
def priced(wall_cost):
    """The paper's grid at a wall cost, and its model."""
    grid = replace(PAPERS, wall_cost=wall_cost)
    return grid, grid_model(grid)


def of_episodes(evaluation):
    """Cost given success, and the collisions with obstacles and the wall in 100,000 episodes."""
    counts = [evaluation.ends[name] * 100_000 for name in ("obstacle", "wall")]
    return evaluation.conditional_cost, *counts


EXACT = {
    ("S max", 1.0): (19.341, 0, 0),
    ("M max", 100.0): (19.341, 0, 0),
    ("S mod", 1.0): (15.854, 3253, 228),
    ("M mod", 1.0): (15.854, 3253, 228),
    ("M mod", 100.0): (16.053, 3461, 2),
    ("S, c = 18", 1.0): (16.146, 2725, 230),
    ("M, c = 17", 1.0): (16.101, 2806, 230),
    ("M, c = 17", 100.0): (16.272, 3064, 2),
}
"""Cost given success and collisions with A, B and the wall of 100,000, on the paper's model."""


@pytest.mark.parametrize(("name", "wall_cost"), EXACT)
def test_the_papers_model_has_its_numbers_and_at_a_given_c_those_of_the_papers_tables(
    name, wall_cost
):
    """Costs within 0.4 %, collisions within one standard error, at the wall three and a half."""
    grid, model = priced(wall_cost)
    (design,) = (one for one in DESIGNS if one.name == name)
    trial = try_out(design, model, grid, episodes=4000, seed=[7])
    found = of_episodes(trial.evaluation)
    assert found == pytest.approx(EXACT[name, wall_cost], abs=0.5)
    assert found[0] == pytest.approx(EXACT[name, wall_cost][0], abs=5e-4)
    assert trial.gap <= 1e-9
    failure = trial.chain.failure_probability
    assert failure.low <= trial.evaluation.failure_probability <= failure.high
    if design.given_c is not None:
        cost, *collisions = PAPER[wall_cost][design.published]
        assert found[0] == pytest.approx(cost, rel=0.004)
        for count, printed, errors in zip(found[1:], collisions, (1.0, 3.5), strict=True):
            assert abs(count - printed) <= errors * math.sqrt(count)


def test_at_a_given_c_the_cost_is_the_worth_of_the_failure_and_the_least_at_it():
    """J_obj = (eta / epsilon) L, and no policy with this L has less, by column generation."""
    (design,) = (one for one in DESIGNS if one.name == "M, c = 17")
    grid, model = priced(100.0)
    found = try_out(design, model, grid, episodes=10, seed=[7]).evaluation
    spent = found.discounted_failure
    assert found.objective == pytest.approx(design.given_c / BUDGET * spent, rel=1e-9)
    least = solve(MCMP(model, start_state(grid), failure_budget=spent, discount=DISCOUNT))
    assert found.objective == pytest.approx(least.objective, rel=1e-9)


def test_the_heading_is_what_drives_robots_into_a_dear_wall():
    """Spread over its cell, with everything else as in the paper's model, and a wall of 100."""
    (design,) = IN_BETWEEN.designs
    assert replace(IN_BETWEEN.grid, quadrature=PAPERS.quadrature) == PAPERS
    walls = []
    for grid in (PAPERS, IN_BETWEEN.grid):
        dear = replace(grid, wall_cost=100.0)
        problem = design.criterion(grid_model(dear), start_state(dear), BUDGET, discount=DISCOUNT)
        walls.append(solve(problem).evaluation.ends["wall"])
    assert walls[1] > 100 * walls[0]


@pytest.mark.parametrize("points", [0, -1])
def test_a_step_without_a_point_to_collide_at_is_refused(points):
    with pytest.raises(ModelError, match="points_on_the_way"):
        RobotGrid(points_on_the_way=points)


def test_more_points_on_the_way_see_all_that_fewer_see_and_the_whole_way_sees_all():
    rng, arena = np.random.default_rng(4), Arena()
    x, y, angle = rng.random(2000), rng.random(2000), 2 * np.pi * rng.random(2000)
    free = arena.classify(x, y) == Place.FREE
    x, y, angle = x[free], y[free], angle[free]
    motion = STEP_LENGTH * np.cos(angle), STEP_LENGTH * np.sin(angle)
    places, times = zip(
        *(arena.first_contact(x, y, *motion, points) for points in (1, 4, 16, None)), strict=True
    )
    assert (places[0] == arena.classify(x + motion[0], y + motion[1])).all()
    for fewer, more in itertools.pairwise(range(4)):
        assert (places[more][places[fewer] != Place.FREE] != Place.FREE).all()
        assert (times[more] <= times[fewer] + 1e-8).all()
        assert (times[more] < 1).any()


@pytest.mark.slow
def test_the_script_prints_the_paper_then_both_readings_and_draws_six_pictures(
    tmp_path, capsys, monkeypatch
):
    """On a coarse grid, where few policies fail in less than half of the episodes."""

    def tried_out(design, *rest):
        budget = None if design.failure_budget is None else 0.9
        return try_out(replace(design, failure_budget=budget), *rest)

    for name, coarse in (("try_out", tried_out), ("BUDGET", 0.9), ("POINTS", 3)):
        monkeypatch.setattr(obstacle_avoidance, name, coarse)
    asked = ["--episodes", "100", "--segments", "6", "--headings", "6", "--output", str(tmp_path)]
    obstacle_avoidance.main(asked)
    printed = capsys.readouterr().out
    assert (tmp_path / "tables.txt").read_text(encoding="utf-8").strip() in printed
    for table in printed.split("Stage cost after")[1:]:
        heads = ["The paper,", "Ours, as in the paper", "Ours, as the robot moves"]
        assert sorted(heads, key=table.index) == heads
        assert "reconstruction" in table.split("The paper,")[0]
    drawn = {path.name for path in tmp_path.glob("*.png")}
    paths = {f"trajectories_{c}_{kind}.png" for c in "sm" for kind in ("max", "mod")}
    assert drawn == paths | {"arena.png", "frontier.png"}


@pytest.mark.parametrize("turning_cost", [0.0, 0.05])
def test_true_costs_are_proved_and_played_inside_their_intervals(turning_cost):
    grid = RobotGrid(
        segments=8, headings=12, quadrature=2, points_on_the_way=None, turning_cost=turning_cost
    )
    found = designed(grid, episodes=20_000, seed=1)
    assert found.certificate.accepted
    assert found.certificate.gap <= TRUE_GAP
    assert found.certificate.objective == pytest.approx(found.solution.objective, rel=1e-9)
    cost, failure = found.chain.conditional_cost, found.chain.failure_probability
    assert cost.low <= found.solution.objective <= cost.high
    assert failure.low <= BUDGET <= failure.high


@pytest.mark.slow
def test_sums_are_told_apart_on_the_whole_grid_of_the_paper():
    """Some 1,200 sums on 4,800 cells; a table cut short of them proves nothing."""
    grid = RobotGrid(points_on_the_way=None, turning_cost=0.2)
    solution = solve(
        S3P(grid_model(grid), start=start_state(grid), failure_budget=BUDGET), tolerance=TRUE_GAP
    )
    assert solution.gap <= TRUE_GAP
    assert solution.objective == pytest.approx(3.2077, abs=4e-4)


@pytest.mark.slow
def test_the_script_prints_a_line_for_a_price_and_draws(tmp_path, capsys):
    asked = ["--episodes", "500", "--segments", "12", "--turning-costs", "0"]
    true_costs([*asked, "--output", str(tmp_path)])
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["turning_cost_0.png"]
