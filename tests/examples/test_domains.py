"""The domains of the literature: values that can be found by hand, and wrong parameters."""

from fractions import Fraction

import numpy as np
import pytest

from bisimulation import compare
from cases import PUBLISHED
from examples.domains.navigation import GONE, navigation
from examples.domains.rectangle_tireworld import WRECK, rectangle_tireworld
from examples.domains.river import river
from examples.domains.triangle_tireworld import Car, triangle_tireworld
from examples.domains.windy_field import windy_field
from formulations import MCMP, S3P
from small_models import EXACT
from ssp_lp import ModelError, solve
from ssp_lp.processes.goal_reach import max_goal_probability, min_goal_probability


def mcmp(domain, budget):
    """Least cost until success or failure within the budget; nothing is charged for failing."""
    return solve(MCMP(*domain, failure_budget=budget, **PUBLISHED))


def s3p(domain, budget):
    """Least cost of the runs that succeed, within the budget."""
    return solve(S3P(*domain, failure_budget=budget))


def greatest(domain):
    """The greatest probability of success from the start."""
    return max_goal_probability(domain.model)[domain.model.index_of(domain.start)]


# ------------------------------------------------------------------ values by hand: river


@pytest.mark.parametrize(("width", "height"), [(3, 3), (4, 4), (5, 8), (7, 3)])
@pytest.mark.parametrize("cost", [1, Fraction(1, 3)])
def test_the_bridge_is_sure_and_long(width, height, cost):
    domain = river(width, height, walk_cost=cost, swim_cost=cost)
    assert domain.model.n_states == width * height
    assert greatest(domain) == pytest.approx(1, **EXACT)
    steps = (height - 2) + (width - 1) + (height - 1)
    for solution in (mcmp(domain, None), s3p(domain, None)):
        assert solution.objective == pytest.approx(float(steps * cost), **EXACT)


def test_a_short_swim_in_the_lottery():
    """3 x 3: five sure steps, or three that succeed with 0.6; the budget 0.1 swims with 1/4."""
    domain = river(3, 3)
    assert mcmp(domain, 0.1).objective == pytest.approx(0.75 * 5 + 0.25 * 2.6, **EXACT)
    cost_of_success = (0.75 * 5 + 0.25 * 0.6 * 3) / 0.9
    assert s3p(domain, 0.1).objective == pytest.approx(cost_of_success, **EXACT)


def test_swimming_straight_across_and_its_cost():
    """5 x 4 with cheap strokes: P = 0.9^3, and a successful run pays 1 + 3 strokes + 1."""
    domain = river(5, 4, current=Fraction(1, 10), swim_cost=Fraction(1, 2))
    swim = s3p(domain, 1 - 0.9**3 + 1e-9)
    assert swim.objective == pytest.approx(3.5, **EXACT)


def test_still_water_and_a_torrent():
    assert mcmp(river(4, 4, current=0), None).objective == pytest.approx(4, **EXACT)
    assert mcmp(river(4, 4, current=1), None).objective == pytest.approx(8, **EXACT)
    model, _ = river(4, 4)
    assert model.state_labels["waterfall"].size == 3


# ------------------------------------------------------------------ values by hand: navigation


@pytest.mark.parametrize("height", [2, 3, 6])
@pytest.mark.parametrize("danger", [0, 0.3, Fraction(1, 7)])
def test_one_column_is_crossed_by_luck(height, danger):
    domain = navigation(1, height, disappearance=[danger])
    survival = 1 - float(danger)
    assert greatest(domain) == pytest.approx(survival ** (height - 2), **EXACT)
    assert s3p(domain, None).objective == pytest.approx(height - 1, **EXACT)
    spent = 1 + sum(survival**k for k in range(height - 2))
    assert mcmp(domain, None).objective == pytest.approx(spent, **EXACT)


@pytest.mark.parametrize(("danger", "safest"), [([0.1, 0.2, 0.6], 0), ([0.5, 0.1, 0.3], 1)])
def test_the_safest_column_costs_the_detour(danger, safest):
    """At least failure the robot crosses there; a budget that allows it goes straight."""
    height, detour = 5, 2 - safest
    domain = navigation(3, height, disappearance=danger)
    survival = 1 - danger[safest]
    assert greatest(domain) == pytest.approx(survival**3, **EXACT)
    assert s3p(domain, None).objective == pytest.approx(2 * detour + height - 1, **EXACT)
    spent = detour + 1 + sum(survival**k for k in range(3)) + survival**3 * detour
    assert mcmp(domain, None).objective == pytest.approx(spent, **EXACT)
    straight = 1 - (1 - danger[2]) ** 3
    assert s3p(domain, straight + 1e-9).objective == pytest.approx(height - 1, **EXACT)


def test_the_default_danger_is_even_and_greatest_at_the_start():
    model, start = navigation(4, 3)
    chance = max_goal_probability(model)
    assert start == (3, 0)
    assert chance[model.index_of((0, 1))] == pytest.approx(0.95, **EXACT)
    assert model.state_labels[GONE].tolist() == [model.index_of(GONE)]
    dangers = 1 - model.probabilities[model.successors != model.index_of(GONE)]
    inner = np.unique(np.round(dangers[dangers > 0], 12))
    assert np.diff(inner) == pytest.approx([0.85 / 3] * 3)


# ------------------------------------------------------------------ values by hand: tireworlds


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("burst", [0, Fraction(1, 3), 0.5, 1])
@pytest.mark.parametrize("change", [1, 3])
def test_the_long_way_around_the_triangle(size, burst, change):
    """4 n moves, and after each but the last a flat tyre with probability p; it never fails."""
    domain = triangle_tireworld(size, burst=burst, change_cost=change)
    assert greatest(domain) == pytest.approx(1, **EXACT)
    cost = 4 * size + float(burst) * change * (4 * size - 1) if burst else 2 * size
    assert mcmp(domain, None).objective == pytest.approx(cost, **EXACT)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_the_bottom_road_of_the_triangle(size):
    """2 n moves, and any of the first 2 n - 1 may end on a flat tyre."""
    domain = triangle_tireworld(size, burst=0.3, move_cost=2)
    chance = 0.7 ** (2 * size - 1)
    assert s3p(domain, 1 - chance + 1e-9).objective == pytest.approx(4 * size, **EXACT)
    model, start = domain
    assert min_goal_probability(model)[model.index_of(start)] == pytest.approx(chance, **EXACT)


@pytest.mark.parametrize("size", [1, 2])
def test_with_every_tyre_bursting_each_spare_is_loaded_and_put_on(size):
    domain = triangle_tireworld(size, burst=1, spares="carried", load_cost=2, change_cost=5)
    cost = 4 * size + (2 + 5) * (4 * size - 1)
    assert mcmp(domain, None).objective == pytest.approx(cost, **EXACT)


def test_a_spare_aboard_is_worth_a_load_ahead_of_need():
    """Size 1, p = 1/2, unit costs: 6.25 with spares loaded ahead, 7 if only when needed."""
    domain = triangle_tireworld(1, spares="carried")
    assert mcmp(domain, None).objective == pytest.approx(6.25, **EXACT)


@pytest.mark.parametrize("spares", ["mounted", "carried"])
@pytest.mark.parametrize("size", [1, 2])
def test_remembering_used_spares_changes_nothing_but_the_size(size, spares):
    small, start = triangle_tireworld(size, spares=spares)
    large, _ = triangle_tireworld(size, spares=spares, remember_spares=True)
    assert len({car.place for car in small.states}) == (size + 1) * (2 * size + 1)
    assert start == Car((1, 1))
    assert small.n_states < large.n_states
    assert compare(small, small.index_of(start), large, large.index_of(start)).bisimilar


def test_the_rectangle_by_straight_and_by_diagonal_moves():
    """2 x 2: two sure moves, or one that succeeds with 0.8, which the budget 0.1 takes half."""
    assert mcmp(rectangle_tireworld(2, 2), None).objective == pytest.approx(2, **EXACT)
    assert mcmp(rectangle_tireworld(2, 2), 0.1).objective == pytest.approx(1.5, **EXACT)
    cube = s3p(rectangle_tireworld(4, 4, success=0.9), 1 - 0.9**3 + 1e-9)
    assert cube.objective == pytest.approx(3, **EXACT)


def test_the_rectangle_without_safe_columns_and_rows():
    domain = rectangle_tireworld(4, 3, safe_columns=(), safe_rows=(), success=Fraction(3, 4))
    assert mcmp(domain, None).objective == pytest.approx(5 / 0.75, **EXACT)


def test_deadly_places_of_the_rectangle_are_dead_ends():
    """3 x 2 with the middle of the safe row deadly: up first, which is uncertain there."""
    domain = rectangle_tireworld(3, 2, deadly={(1, 0)}, safe_columns=(), safe_rows=(0, 1))
    assert mcmp(domain, None).objective == pytest.approx(1 / 0.8 + 2, **EXACT)
    labels = domain.model.state_labels
    assert labels["deadly"].tolist() == [domain.model.index_of((1, 0))]
    assert labels[WRECK].tolist() == [domain.model.index_of(WRECK)]


# ------------------------------------------------------------------ values by hand: windy field


@pytest.mark.parametrize("diagonal", [1, 2**0.5, Fraction(7, 5)])
def test_the_smallest_field_is_crossed_at_once_or_from_below(diagonal):
    """A diagonal step arrives with 0.9; blown down, an upward one does so with 0.9 each time."""
    field = windy_field(2, diagonal=diagonal, seed=1)
    assert s3p(field, 0.0).objective == pytest.approx(float(diagonal) + 0.1 / 0.9, rel=1e-12)


def test_holes_are_dead_ends_and_prices_belong_to_cell_and_direction():
    model = windy_field(7, prices=[0.5, 2**0.5, 3.0], seed=3).model
    dead = np.flatnonzero(np.diff(model.pair_offsets) == 0)
    assert 1 < len(dead) < 15
    first = model.outcome_offsets[:-1]
    assert np.array_equal(model.costs[first], model.costs[model.outcome_offsets[1:] - 1])
    assert set(model.costs.tolist()) == {0.5, 2**0.5, 3.0}


# ------------------------------------------------------------------ wrong parameters


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda: river(2, 5), "width"),
        (lambda: river(5, 2.5), "height"),
        (lambda: river(5, 5, current=1.5), "current"),
        (lambda: river(5, 5, walk_cost=-1), "walk_cost"),
        (lambda: river(5, 5, swim_cost=float("inf")), "swim_cost"),
        (lambda: navigation(0, 5), "width"),
        (lambda: navigation(3, 1), "height"),
        (lambda: navigation(3, 3, disappearance=[0.1, 0.2]), "disappearance"),
        (lambda: navigation(2, 3, disappearance=[0.1, float("nan")]), r"disappearance\[1\]"),
        (lambda: navigation(3, 3, move_cost=None), "move_cost"),
        (lambda: triangle_tireworld(0), "size"),
        (lambda: triangle_tireworld(True), "size"),
        (lambda: triangle_tireworld(2, burst=-0.1), "burst"),
        (lambda: triangle_tireworld(2, spares="lent"), "spares"),
        (lambda: triangle_tireworld(2, move_cost="1"), "move_cost"),
        (lambda: triangle_tireworld(2, change_cost=-1), "change_cost"),
        (lambda: triangle_tireworld(2, load_cost=-1), "load_cost"),
        (lambda: triangle_tireworld(9, state_limit=100), "state_limit"),
        (lambda: rectangle_tireworld(1, 5), "width"),
        (lambda: rectangle_tireworld(5, 1), "height"),
        (lambda: rectangle_tireworld(5, 5, safe_columns=(5,)), "safe_columns"),
        (lambda: rectangle_tireworld(5, 5, safe_rows=(-1,)), "safe_rows"),
        (lambda: rectangle_tireworld(5, 5, deadly={(0, 0)}), "deadly"),
        (lambda: rectangle_tireworld(5, 5, success=2), "success"),
        (lambda: windy_field(1), "size"),
        (lambda: windy_field(3, diagonal=-1.0), "diagonal"),
        (lambda: windy_field(3, prices=[1.0, float("inf")]), r"prices\[1\]"),
    ],
)
def test_errors_name_the_parameter(build, name):
    with pytest.raises(ModelError, match=name):
        build()
