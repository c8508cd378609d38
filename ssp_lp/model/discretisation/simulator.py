"""Episodes in the continuous world, of a policy that is told the cell only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model.arguments import check_fields
from ssp_lp.model.discretisation.continuous_model import ContinuousModel, take_step_in_world
from ssp_lp.model.discretisation.distribution import Distribution
from ssp_lp.model.ssp import SSP


@dataclass(frozen=True, eq=False)
class WorldSimulator:
    """The world itself, many episodes at a time: ``simulate(..., simulator=WorldSimulator(...))``.

    The episodes are independent of how the grid model was made, so the interval that ``simulate``
    gives for the probability of the goal (Clopper and Pearson's, exact for every probability and
    number of episodes) holds for the policy in the world. A policy that gives up ends its episode,
    as a failure.

    Attributes:
        world: what a step does.
        start: for each axis a number, or the distribution it is drawn from.
    """

    world: ContinuousModel
    start: Sequence[float | Distribution]

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for no world, or a start with another number of coordinates."""
        check_fields(self)
        axes = self.world.grid.axes
        if len(self.start) != len(axes):
            raise ModelError(f"start needs {len(axes)} coordinates, not {len(self.start)}")

    def check_model(self, model: SSP) -> None:
        """Raise :class:`ModelError` for a model with other states than the world's cells make."""
        if model.n_states != self.world.n_states:
            raise ModelError(
                f"the simulator's world has {self.world.n_states:,} states, the policy's model "
                f"{model.n_states:,}: take the world that the model was made of"
            )

    def reset(self, episodes: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
        """Draw starts: coordinates, [episodes, axes], and cells, [episodes].

        Raises:
            ModelError: a start outside the box.
        """
        levels = rng.random((episodes, len(self.start)))
        columns = [
            first.at(levels[:, k])
            if isinstance(first, Distribution)
            else np.full(episodes, float(first))
            for k, first in enumerate(self.start)
        ]
        world = np.stack(columns, axis=1)
        return world, self.world.grid.cell_of(world)

    def step(
        self, world: FloatArray, pair: IntArray, rng: np.random.Generator
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """Take one step from coordinates, [k, axes], by pairs of the grid model, [k].

        Returns:
            The coordinates, those of periodic axes within the box, the states of the grid model,
            and the costs, [k] each.
        """
        model, grid = self.world, self.world.grid
        levels = rng.random((len(pair), len(model.noise)))
        noise = [draw.at(levels[:, k]) for k, draw in enumerate(model.noise)]
        pairs = model.allowed_pairs
        action = np.asarray(pair if pairs is None else pairs[pair]) % len(model.actions)
        after, paid = np.empty_like(world), np.empty(len(pair))
        state = np.empty(len(pair), dtype=np.int64)
        for number in np.unique(action):
            some = np.flatnonzero(action == number)
            point = tuple(world[some].T)
            drawn = tuple(values[some] for values in noise)
            taken = take_step_in_world(model, point, int(number), drawn, (len(some),))
            for k, (axis, values) in enumerate(zip(grid.axes, taken.point, strict=True)):
                after[some, k] = axis.wrapped(values)
            ended = grid.n_cells - 1 + taken.end.astype(np.int64)
            state[some] = np.where(taken.end != 0, ended, grid.number(taken.heights))
            paid[some] = taken.cost
        return after, state, paid
