"""The domains of the literature: values found by hand, wrong parameters, and published models."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from bisimulation import compare
from cases import PUBLISHED, load_case
from examples.domains.domain import Domain
from examples.domains.navigation import GONE, navigation
from examples.domains.rectangle_tireworld import WRECK, rectangle_tireworld
from examples.domains.river import river
from examples.domains.triangle_tireworld import Car, triangle_tireworld
from examples.domains.windy_field import windy_field
from formulations import MCMP, S3P
from refusing import refused
from small_models import EXACT
from ssp_lp import SSP, solve
from ssp_lp.processes.goal_reach import max_goal_probability, min_goal_probability


def mcmp(domain, budget=None):
    """Least cost until success or failure within the budget; nothing is charged for failing."""
    return solve(MCMP(*domain, failure_budget=budget, **PUBLISHED)).objective


def s3p(domain, budget=None):
    """Least cost of the runs that succeed, within the budget."""
    return solve(S3P(*domain, failure_budget=budget)).objective


def greatest(domain):
    """The greatest probability of success from the start."""
    return max_goal_probability(domain.model)[domain.model.index_of(domain.start)]


def exactly(number):
    return pytest.approx(float(number), **EXACT)


def by_hand():
    """Domain, budget, least cost, least cost given success, greatest probability (None: unsaid)."""
    for (width, height), cost in product([(3, 3), (4, 4), (5, 8), (7, 3)], [1, Fraction(1, 3)]):
        bridge = (width + 2 * height - 4) * cost  # sure and long
        yield river(width, height, walk_cost=cost, swim_cost=cost), None, bridge, bridge, 1
    # five sure steps, or three that succeed with 0.6, for which the budget 0.1 has room in 1/4
    yield river(3, 3), 0.1, 0.75 * 5 + 0.25 * 2.6, (0.75 * 5 + 0.25 * 0.6 * 3) / 0.9, None
    # across with probability 0.9^3, and a successful run pays 1 + 3 cheap strokes + 1
    cheap = river(5, 4, current=Fraction(1, 10), swim_cost=Fraction(1, 2))
    yield cheap, 1 - 0.9**3 + 1e-9, None, 3.5, None
    yield river(4, 4, current=0), None, 4, None, None
    yield river(4, 4, current=1), None, 8, None, None
    for height, danger in product([2, 3, 6], [0, 0.3, Fraction(1, 7)]):  # crossed by luck
        survival, column = 1 - float(danger), navigation(1, height, disappearance=[danger])
        spent = 1 + sum(survival**k for k in range(height - 2))
        yield column, None, spent, height - 1, survival ** (height - 2)
    for danger, detour in (([0.1, 0.2, 0.6], 2), ([0.5, 0.1, 0.3], 1)):
        domain, survival = navigation(3, 5, disappearance=danger), 1 - danger[2 - detour]
        spent = detour + 1 + sum(survival**k for k in range(3)) + survival**3 * detour
        yield domain, None, spent, 2 * detour + 4, survival**3  # by the safest column
        yield domain, 1 - (1 - danger[2]) ** 3 + 1e-9, None, 4, None  # straight on
    for size, burst, change in product([1, 2, 3], [0, Fraction(1, 3), 0.5, 1], [1, 3]):
        # 4 n moves, and after each but the last a flat tyre with probability p; it never fails
        cost = 4 * size + burst * change * (4 * size - 1) if burst else 2 * size
        yield triangle_tireworld(size, burst=burst, change_cost=change), None, cost, None, 1
    for size in (1, 2, 3):  # 2 n moves at the bottom, the first 2 n - 1 maybe to a flat tyre
        domain = triangle_tireworld(size, burst=0.3, move_cost=2)
        yield domain, 1 - 0.7 ** (2 * size - 1) + 1e-9, None, 4 * size, None
    for size in (1, 2):  # each spare is loaded and put on
        domain = triangle_tireworld(size, burst=1, spares="carried", load_cost=2, change_cost=5)
        yield domain, None, 4 * size + (2 + 5) * (4 * size - 1), None, None
    # p = 1/2, unit costs: 6.25 with spares loaded ahead of need, 7 if only when needed
    yield triangle_tireworld(1, spares="carried"), None, 6.25, None, None
    # two sure moves, or one that succeeds with 0.8, which the budget 0.1 takes half
    yield rectangle_tireworld(2, 2), None, 2, None, None
    yield rectangle_tireworld(2, 2), 0.1, 1.5, None, None
    yield rectangle_tireworld(4, 4, success=0.9), 1 - 0.9**3 + 1e-9, None, 3, None
    domain = rectangle_tireworld(4, 3, safe_columns=(), safe_rows=(), success=Fraction(3, 4))
    yield domain, None, 5 / 0.75, None, None
    # the middle of the safe row is deadly: up first, which is uncertain there
    domain = rectangle_tireworld(3, 2, deadly={(1, 0)}, safe_columns=(), safe_rows=(0, 1))
    yield domain, None, 1 / 0.8 + 2, None, None


@pytest.mark.parametrize(("domain", "budget", "cost", "given_success", "best"), [*by_hand()])
def test_values_found_by_hand(domain, budget, cost, given_success, best):
    for value, found in ((cost, mcmp), (given_success, s3p)):
        assert value is None or found(domain, budget) == exactly(value)
    assert best is None or greatest(domain) == exactly(best)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_the_bottom_of_the_triangle_is_the_worst(size):
    model, start = triangle_tireworld(size, burst=0.3)
    least = min_goal_probability(model)[model.index_of(start)]
    assert least == exactly(0.7 ** (2 * size - 1))


@pytest.mark.parametrize("spares", ["mounted", "carried"])
@pytest.mark.parametrize("size", [1, 2])
def test_remembering_used_spares_changes_nothing_but_the_size(size, spares):
    small = triangle_tireworld(size, spares=spares)
    large = triangle_tireworld(size, spares=spares, remember_spares=True)
    assert len({car.place for car in small.model.states}) == (size + 1) * (2 * size + 1)
    assert small.start == Car((1, 1))
    assert small.model.n_states < large.model.n_states
    assert likeness(small, large).bisimilar


def test_states_and_labels():
    assert river(4, 5).model.n_states == 4 * 5
    assert river(4, 4).model.state_labels["waterfall"].size == 3
    model, start = navigation(4, 3)
    assert start == (3, 0)
    assert model.state_labels[GONE].tolist() == [model.index_of(GONE)]
    dangers = 1 - model.probabilities[model.successors != model.index_of(GONE)]
    inner = np.unique(np.round(dangers[dangers > 0], 12))  # even, and greatest at the start
    assert np.diff(inner) == pytest.approx([0.85 / 3] * 3)
    assert max_goal_probability(model)[model.index_of((0, 1))] == exactly(0.95)
    model = rectangle_tireworld(3, 2, deadly={(1, 0)}, safe_columns=(), safe_rows=(0, 1)).model
    assert model.state_labels["deadly"].tolist() == [model.index_of((1, 0))]
    assert model.state_labels[WRECK].tolist() == [model.index_of(WRECK)]


@pytest.mark.parametrize("diagonal", [1, 2**0.5, Fraction(7, 5)])
def test_the_smallest_field_is_crossed_at_once_or_from_below(diagonal):
    """A diagonal step arrives with 0.9; blown down, an upward one does so with 0.9 each time."""
    field = windy_field(2, diagonal=diagonal, seed=1)
    assert s3p(field, 0.0) == pytest.approx(float(diagonal) + 0.1 / 0.9, rel=1e-12)


def test_holes_are_dead_ends_and_prices_belong_to_cell_and_direction():
    model = windy_field(7, prices=[0.5, 2**0.5, 3.0], seed=3).model
    dead = np.flatnonzero(np.diff(model.pair_offsets) == 0)
    assert 1 < len(dead) < 15
    first = model.outcome_offsets[:-1]
    assert np.array_equal(model.costs[first], model.costs[model.outcome_offsets[1:] - 1])
    assert set(model.costs.tolist()) == {0.5, 2**0.5, 3.0}


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
    refused(name, build)


def published(name):
    """A published model, its states numbered breadth-first as the generators do."""
    case = load_case(name, "unit")
    moves, options = case.choices.__getitem__, {"treat_actionless_as_dead_ends": True}
    model = SSP.from_successors(case.start, moves, case.goal, **options)
    return case, Domain(model, case.start)


def likeness(one, other):
    starts = [domain.model.index_of(domain.start) for domain in (one, other)]
    return compare(one.model, starts[0], other.model, starts[1])


def published_dangers(case):
    """The probability of disappearing in each of the 20 columns, read off the second row."""
    dangers = {}
    bottom = case.start
    for column in reversed(range(20)):
        moves = {name.split(":")[1]: outcomes for name, outcomes in case.choices[bottom].items()}
        inner = case.choices[moves["up"][0][1]]
        dangers[column] = next(iter(inner.values()))[1][0]
        bottom = moves["left"][0][1] if column else bottom
    return [dangers[column] for column in range(20)]


COPIES = {
    "gubs_river4x4": lambda case: river(4, 4),
    "gubs_river-alt0": lambda case: river(5, 5),
    "gubs_river-alt1": lambda case: river(5, 8),
    "gubs_river-alt2": lambda case: river(5, 15),
    "gubs_river-alt3": lambda case: river(10, 10),
    "gubs_river-alt4": lambda case: river(10, 20),
    "gubs_navigation10": lambda case: navigation(20, 5, disappearance=published_dangers(case)),
    "gubs_tireworld1": lambda case: triangle_tireworld(1, remember_spares=True),
    "gubs_tireworld2": lambda case: triangle_tireworld(2, remember_spares=True),
    "gubs_tireworld3": lambda case: triangle_tireworld(3, remember_spares=True),
}
EQUIVALENTS = {
    "gubs_tireworld3": lambda: triangle_tireworld(3),
    "qcomp_triangle-tireworld.9": lambda: triangle_tireworld(1, spares="carried"),
    "qcomp_rectangle-tireworld.5": lambda: rectangle_tireworld(
        5, 5, safe_columns=(1, 3), safe_rows=(0, 2), as_published=True
    ),
}


@pytest.mark.parametrize("name", COPIES)
def test_published_models_are_copied_entry_by_entry(name):
    """Same states, pairs and outcomes in the same order, same probabilities and costs."""
    case, (model, _) = published(name)
    copy, start = COPIES[name](case)
    assert copy.index_of(start) == 0
    fields = ["pair_offsets", "outcome_offsets", "successors", "probabilities", "costs"]
    for field in [*fields, "goal_mask"]:
        np.testing.assert_array_equal(getattr(copy, field), getattr(model, field), err_msg=field)


def test_carried_spares_are_the_published_ones_state_by_state():
    """The order of actions differs, so states are compared by what they can do."""
    _, theirs = published("qcomp_triangle-tireworld.9")
    copy = triangle_tireworld(1, spares="carried", remember_spares=True)
    found = likeness(theirs, copy)
    assert found.bisimilar
    assert found.same_classes
    assert copy.model.n_states == theirs.model.n_states == 80


@pytest.mark.slow
@pytest.mark.parametrize("name", EQUIVALENTS)
def test_published_models_and_their_smaller_equivalents(name):
    """Bisimilar starts, hence equal values; the solver agrees."""
    _, theirs = published(name)
    ours = EQUIVALENTS[name]()
    assert likeness(theirs, ours).bisimilar
    assert ours.model.n_states < theirs.model.n_states
    assert greatest(ours) == pytest.approx(greatest(theirs), rel=1e-9)
    for criterion in (mcmp, s3p):
        mine, known = (
            [criterion(domain, budget) for budget in (None, 0.05, 0.3)] for domain in (ours, theirs)
        )
        assert mine == pytest.approx(known, rel=1e-9)


def test_the_likeness_of_models_is_not_always_found():
    """The check above can fail: without the slips of the pen the rectangle is another one."""
    _, theirs = published("qcomp_rectangle-tireworld.5")
    copy = rectangle_tireworld(5, 5, safe_columns=(1, 3), safe_rows=(0, 2))
    assert not likeness(theirs, copy).bisimilar
