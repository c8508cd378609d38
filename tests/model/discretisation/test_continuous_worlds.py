"""Continuous worlds: what samples say, episodes played in the world, and answers that cannot be."""

import math
from dataclasses import replace

import numpy as np
import pytest

from formulations import MCMP
from ssp_lp import (
    GIVE_UP,
    Axis,
    ContinuousModel,
    DeterministicPolicy,
    Distribution,
    Grid,
    ModelError,
    Quadrature,
    Samples,
    WorldSimulator,
    discretise,
    evaluate,
    simulate,
)
from ssp_lp.io import fingerprint

HOPS = Distribution.discrete([-1.0, 1.0, 2.0], [0.35, 0.4, 0.25])
SURE = Distribution.discrete([1.0], [1.0])


def walk(hops=HOPS):
    """Whole hops on a line of six cells: the goal beyond the right end, a pit beyond the left."""

    def step(at, action, draws):
        moved = at[0] + draws[0] * (1.0 if action == "hop" else 0.5)
        return (moved,), 1.0, np.where(moved > 6.0, 1, np.where(moved < 0.0, 2, 0))

    return ContinuousModel(Grid([Axis(0.0, 6.0, 6)]), ["hop", "creep"], step, [hops], {"pit": 0.0})


def always(model, action):
    """The policy of one action."""
    return DeterministicPolicy.from_actions(model, dict.fromkeys(range(6), action))


# ------------------------------------------------------------------ samples


def test_a_seed_is_a_model():
    first, again, other = (discretise(walk(), Samples(20, rng)) for rng in (3, 3, 4))
    assert fingerprint(first) == fingerprint(again) != fingerprint(other)
    generator = np.random.default_rng(3)
    assert fingerprint(discretise(walk(), Samples(20, generator))) == fingerprint(first)


def test_the_deviation_is_weissmans_bound():
    """Two outcomes: (2^2 - 2) exp(-n d^2 / 2) = 5 %; several pairs share what may be lost."""
    samples = Samples(1000, 0)
    assert samples.deviation(1, 2) == pytest.approx(math.sqrt(2 * math.log(2 / 0.05) / 1000))
    assert samples.deviation(10, 3, 0.9) == pytest.approx(
        math.sqrt(2 * math.log(6 * 10 / 0.1) / 1000)
    )
    assert samples.deviation(10**6, 1) == 0.0
    assert samples.deviation(5, 10**6) == 2.0  # says nothing, and cannot be more


def test_samples_are_as_near_as_stated_and_so_is_failing():
    """Whole hops make the true grid model known: that of its discrete noise."""
    true = discretise(walk(), Quadrature(1))
    missed = 0
    for seed in range(20):
        drawn = discretise(walk(), Samples(100, seed))
        bound = Samples(100, seed).deviation(6, 3, confidence=0.8)
        worst = max(distance(true, drawn, 2 * cell) for cell in range(6))
        missed += worst > bound
        if worst > 0:
            fail, steps = played(drawn)
            assert abs(fail - played(true)[0]) <= worst / 2 * steps + 1e-12
    assert missed <= 4  # at most a fifth; the bound is generous


def distance(true, drawn, pair):
    """The sum of absolute differences of a pair's probabilities."""
    chances = np.zeros((2, true.n_states))
    for k, model in enumerate((true, drawn)):
        some = slice(*model.outcome_offsets[pair : pair + 2])
        chances[k, model.successors[some]] = model.probabilities[some]
    return float(np.abs(chances[0] - chances[1]).sum())


def played(model):
    """Failure probability and expected steps of hopping from cell 2."""
    exact = evaluate(always(model, "hop"), MCMP(model, 2, 1.0))
    return exact.failure_probability, exact.expected_cost


# ------------------------------------------------------------------ episodes in the world


def test_where_cells_are_exact_so_is_the_interval():
    """Whole hops from cell to cell: the world is the chain, whatever the point in the cell."""
    world = walk()
    model = discretise(world, Quadrature(3))
    problem = MCMP(model, 2, 1.0)
    policy = always(model, "hop")
    exact = evaluate(policy, problem)
    simulator = WorldSimulator(world, [Distribution.uniform(2.0, 3.0)])
    report = simulate(policy, problem, episodes=20_000, rng=1, simulator=simulator, confidence=0.99)
    failed = report.failure_probability
    assert failed.low < exact.failure_probability < failed.high
    assert failed.value == pytest.approx(report.ends["pit"] / 20_000, rel=1e-12)
    assert failed.low == pytest.approx(1.0 - report.goal_probability.high)
    assert report.expected_cost.low < exact.expected_cost < report.expected_cost.high


def test_giving_up_ends_an_episode_as_a_failure():
    world = walk(SURE)
    model = discretise(world, Quadrature(1))
    decisions = {cell: "hop" if cell < 4 else GIVE_UP for cell in range(6)}
    policy = DeterministicPolicy.from_actions(model, decisions)
    problem = MCMP(model, 2, 1.0, give_up="anywhere")
    report = simulate(
        policy, problem, episodes=7, rng=0, simulator=WorldSimulator(world, [2.5]), record=1
    )
    assert report.ends["gave_up"] == 7
    assert report.failure_probability.value == 1.0
    assert report.paths[0].ravel().tolist() == [2.5, 3.5, 4.5]


def test_a_step_of_the_world_is_a_step_of_the_model():
    """Frequencies from points uniform in a cell, both actions; the axis wraps."""
    axis = Axis(-0.5, 7.5, 8, periodic=True)
    noise = Distribution.uniform(0.0, 1.5)

    def step(at, turn, draw):
        return (at[0] + turn + draw[0],), 2.0, 0

    world = ContinuousModel(Grid([axis]), [2.0, 5.0], step, [noise])
    model = discretise(world, Quadrature(40))
    draws, rng = 40_000, np.random.default_rng(2)
    for pair in (12, 13):
        begin = 5.5 + rng.random((draws, 1))
        after, state, cost = WorldSimulator(world, [0.0]).step(begin, np.full(draws, pair), rng)
        some = slice(*model.outcome_offsets[pair : pair + 2])
        share = np.bincount(state, minlength=9)[model.successors[some]] / draws
        # 40,000 draws: a standard error of at most 0.0025; 40 points: at most 1 / 80
        assert np.abs(share - model.probabilities[some]).max() < 0.02
        assert after.min() >= -0.5
        assert after.max() < 7.5
        assert (cost == 2.0).all()


def test_reprs_are_short():
    assert repr(walk()) == (
        "ContinuousModel(the box [0, 6], 6 cells, 2 actions, 1 random numbers; ends: goal, pit)"
    )
    assert repr(HOPS) == "Distribution(3 values)"
    assert repr(Distribution(np.sqrt)) == "Distribution(<sqrt>)"


# ------------------------------------------------------------------ what cannot be


def with_step(step, **changes):
    """The walk with another step function."""
    return replace(walk(), step=step, **changes)


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
    with pytest.raises(ModelError, match=words):
        discretise(with_step(step))


def test_leaving_the_box_may_be_an_end():
    world = with_step(lambda at, a, d: ((at[0] + 9.0,), 1.0, 0), outside="pit")
    model = discretise(world)
    assert (model.successors == world.end_state("pit")).all()
    nowhere = with_step(lambda at, a, d: ((np.nan * at[0],), 1.0, 1))
    assert (discretise(nowhere).successors[:-1] == world.end_state("goal")).all()


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
        (lambda: replace(walk(), noise=[0.1]), r"noise\[0\] must be a Distribution"),
        (lambda: replace(walk(), outside="hole"), "none of the dead-ends"),
        (lambda: walk().end_state("hole"), "goal, pit"),
        (lambda: walk().end_state(3), r"1 \.\. 2"),
        (lambda: discretise(walk(), 4), "Quadrature"),
        (lambda: discretise(walk(), Quadrature(0)), "number >= 1"),
        (lambda: discretise(walk(), Quadrature((4, 4, 4))), "1 of them for the axes"),
        (lambda: discretise(walk(), Quadrature(4, "simpson")), "gauss-legendre"),
        (lambda: Samples(0, 0), "whole number >= 1"),
        (lambda: Samples(5, None), "seed such as 0"),
        (lambda: Samples(5, 0).deviation(1, 0), "reachable"),
        (lambda: discretise(replace(walk(), alike=lambda c, a: a * 0.5)), "whole numbers"),
        (lambda: discretise(replace(walk(), alike=lambda c, a: c[0])), "'creep' in cell 0"),
        (lambda: WorldSimulator(walk(), [1.0, 2.0]).reset(3, np.random.default_rng(0)), "1 coord"),
        (lambda: WorldSimulator(walk(), [7.0]).reset(3, np.random.default_rng(0)), "outside"),
    ],
)
def test_what_cannot_be_is_refused(build, words):
    with np.errstate(divide="ignore", invalid="ignore"), pytest.raises(ModelError, match=words):
        build()


def test_alike_pairs_cost_alike():
    """Two cells with one successor and two costs: a claim that they are alike is refused."""
    world = with_step(lambda at, a, d: ((at[0] * 0.0,), at[0], 1))
    assert len(np.unique(discretise(world).costs)) > 1
    with pytest.raises(ModelError, match="alike"):
        discretise(replace(world, alike=lambda cells, action: cells * 0))


def test_a_world_of_another_grid_is_no_simulator():
    model = discretise(walk())
    problem = MCMP(model, 3, failure_budget=1.0)
    other = replace(walk(), grid=Grid([Axis(0.0, 6.0, 12)]))
    simulator = WorldSimulator(other, start=(3.5,))
    with pytest.raises(ModelError, match="14 states"):
        simulate(always(model, "hop"), problem, episodes=10, rng=0, simulator=simulator)
