"""Environments of coordinates as continuous worlds: their own steps, on a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ssp_lp import Axis, Grid, ModelError, Samples, discretise
from ssp_lp.io import continuous_from_gymnasium, from_gymnasium

gymnasium = pytest.importorskip("gymnasium")
CAR = Grid([Axis(-1.2, 0.6, cells=12), Axis(-0.07, 0.07, cells=10)])
POLE = Grid(
    [Axis(-2.4, 2.4, cells=3), Axis(-3, 3, cells=4), Axis(-0.2, 0.2, cells=4), Axis(-3, 3, cells=4)]
)


@pytest.mark.parametrize(("name", "grid"), [("MountainCar-v0", CAR), ("CartPole-v1", POLE)])
def test_steps_are_the_environments(name: str, grid: Grid) -> None:
    world = continuous_from_gymnasium(
        gymnasium.make(name), grid, goal=lambda point: name.startswith("Mountain"),
        cost=lambda point, action, after, reward: 1.0 + action,
    )  # fmt: skip
    generator, other = np.random.default_rng(3), gymnasium.make(name)
    low, high = np.array([(axis.low, axis.high) for axis in grid.axes]).T
    points = generator.uniform(low, high, (40, len(grid.axes)))
    for action in world.actions:
        after, paid, ends = world.step(tuple(points.T), action, ())
        assert np.array_equal(paid, np.full(40, 1.0 + int(str(action))))
        for k, point in enumerate(points):
            other.reset(seed=0)
            other.unwrapped.state = np.array(point, dtype=np.float64)
            _, _, terminated, _, _ = other.step(action)
            assert np.allclose([part[k] for part in after], other.unwrapped.state)
            assert ends[k] == (0 if not terminated else 1 if name.startswith("Mountain") else 2)
    model = discretise(world, Samples(3, rng=0))
    assert model.n_states == grid.n_cells + 3


def test_what_is_no_world_of_coordinates_is_refused() -> None:
    def made(name: str, grid: Any = CAR) -> None:
        continuous_from_gymnasium(gymnasium.make(name), grid, goal=bool)

    for name, complaint in (
        ("FrozenLake-v1", "must be 2 coordinates"),
        ("CartPole-v1", "must be 2 coordinates"),
        ("MountainCarContinuous-v0", "no discrete actions"),
    ):
        with pytest.raises(ModelError, match=complaint):
            made(name)
    with pytest.raises(ModelError, match="continuous_from_gymnasium"):
        from_gymnasium(gymnasium.make("CartPole-v1"))
