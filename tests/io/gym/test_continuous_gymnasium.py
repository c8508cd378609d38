"""Environments of coordinates as continuous worlds: their own steps, on a grid."""

import numpy as np
import pytest

from formulations import MaxProb
from refusing import refused
from ssp_lp import Axis, Grid, Quadrature, Samples, discretise, solve
from ssp_lp.io import continuous_from_gymnasium, fingerprint, from_gymnasium

gym = pytest.importorskip("gymnasium")
CAR = Grid([Axis(-1.2, 0.6, cells=12), Axis(-0.07, 0.07, cells=10)])
POLE = Grid(
    [Axis(-2.4, 2.4, cells=3), Axis(-3, 3, cells=4), Axis(-0.2, 0.2, cells=4), Axis(-3, 3, cells=4)]
)


@pytest.mark.parametrize(
    ("name", "grid", "end"), [("MountainCar-v0", CAR, 1), ("CartPole-v1", POLE, 2)]
)
def test_steps_are_the_environments(name, grid, end):
    """The car arrives (1), the pole fails (2)."""
    world = continuous_from_gymnasium(
        gym.make(name), grid, goal=lambda point: end == 1,
        cost=lambda point, action, after, reward: 1.0 + action,
    )  # fmt: skip
    rng, other = np.random.default_rng(3), gym.make(name)
    low, high = np.array([(axis.low, axis.high) for axis in grid.axes]).T
    points = rng.uniform(low, high, (40, len(grid.axes)))
    for action in world.actions:
        after, paid, ends = world.step(tuple(points.T), action, ())
        assert np.array_equal(paid, np.full(40, 1.0 + action))
        for k, point in enumerate(points):
            other.reset(seed=0)
            other.unwrapped.state = np.array(point, dtype=np.float64)
            _, _, terminated, _, _ = other.step(action)
            assert np.allclose([part[k] for part in after], other.unwrapped.state)
            assert ends[k] == end * terminated
    assert discretise(world, Samples(3, seed=0)).n_states == grid.n_cells + 3


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("FrozenLake-v1", "must be 2 coordinates"),
        ("CartPole-v1", "must be 2 coordinates"),
        ("MountainCarContinuous-v0", "no discrete actions"),
    ],
)
def test_what_is_no_world_of_coordinates_is_refused(name, complaint):
    refused(complaint, continuous_from_gymnasium, gym.make(name), CAR, goal=bool)
    if name == "CartPole-v1":
        refused("continuous_from_gymnasium", from_gymnasium, gym.make(name))


@pytest.mark.slow
def test_a_grid_is_discretised_in_one_call():
    """The same model as by hand; on it, as on any other, surviving can be the goal."""
    grid = Grid([Axis(-1.2, 0.6, cells=12), Axis(-0.07, 0.07, cells=8)])
    hill = {"goal": lambda point: True, "start": (-0.5, 0.0)}
    made = from_gymnasium(gym.make("MountainCar-v0"), grid=grid, **hill)
    car = continuous_from_gymnasium(gym.make("MountainCar-v0"), grid, goal=lambda point: True)
    assert fingerprint(made.model) == fingerprint(discretise(car, Quadrature(3)))
    assert made.start == {grid.cell_of((-0.5, 0.0)): 1.0}
    assert (made.step_limit, made.horizon) == (200, None)
    assert made.continuous is not None
    axes = [Axis(-2.5, 2.5, 3), Axis(-4, 4, 6), Axis(-0.22, 0.22, 6), Axis(-4, 4, 6)]
    pole = {"grid": Grid(axes), "goal": lambda point: False, "start": (0.0, 0.0, 0.1, 1.0)}
    env, balanced = gym.make("CartPole-v1"), []
    for steps in (2, 5, 9):
        world = from_gymnasium(env, horizon=steps, survive=True, **pole)
        balanced.append(solve(MaxProb(world.model, world.start)).objective)
    assert 1.0 > balanced[0] > balanced[1] > balanced[2] > 0.0
    refused("survive=True needs a number of steps", from_gymnasium, env, survive=True, **pole)
    refused("give start in coordinates", from_gymnasium, env, **{**pole, "start": None})
