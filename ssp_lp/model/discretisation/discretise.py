"""The grid model of a continuous world: cells as states, probabilities from trials of its step."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, least_integer_type, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model.arguments import explained
from ssp_lp.model.discretisation.continuous_model import ContinuousModel, take_step_in_world
from ssp_lp.model.discretisation.outcomes import Outcomes, OutcomeStore, tally_outcomes
from ssp_lp.model.discretisation.points import Quadrature, Samples, Trials
from ssp_lp.model.ssp import SSP

TRIALS: Final = 1 << 19
"""Trials that are worked on at a time: scratch arrays of some tens of megabytes."""

PAIRS: Final = 1 << 13
"""Pairs whose outcomes are copied at a time, likewise."""

SPOT_CHECKS: Final = 30
"""Pairs that are worked out once more where a user says that some are alike."""

MIDPOINTS: Final = Quadrature()

_BUILDING = logging.getLogger("ssp_lp.building")


@explained
def discretise(
    world: ContinuousModel,
    points: Quadrature | Samples = MIDPOINTS,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> SSP:
    """Make a finite model whose states are the cells of a continuous world's grid.

    In the model each step begins at a point uniform in its cell, whatever came before. The world
    remembers where in the cell it was: nothing certified of the model is certain there. Play the
    policy in the world (:class:`.WorldSimulator`), and read the exact interval of its failures.

    Args:
        world: the step function and the grid.
        points: a :class:`Quadrature`, or :class:`Samples`.
        progress: called with the number of pairs worked out and their total.

    Returns:
        The model. Its states are the cells 0, 1, ..., as ``world.grid.cell_of`` numbers them, then
        the goal, then the dead-ends, which stay where they are and bear their labels. Outcomes of a
        pair that share a successor are one, with the mean of their costs.

    Raises:
        ModelError: the step function's answer is of a wrong form, or it leaves the box.
    """
    if not isinstance(points, (Quadrature, Samples)):
        raise ModelError(f"points must be Quadrature(4) or Samples(1000, rng=0), not {points!r}")
    trials = points.trials(world)
    n_all = world.grid.n_cells * len(world.actions)
    distinct, row_of_pair = _distinct_pairs(world, n_all)
    store = OutcomeStore()
    n_distinct = n_all if distinct is None else len(distinct)
    size = max(1, TRIALS // math.prod(trials.shape))
    for begin in range(0, n_distinct, size):
        some = np.arange(begin, min(begin + size, n_distinct), dtype=least_integer_type(n_all))
        store.append(_discretised_rows(world, trials, some if distinct is None else distinct[some]))
        done = int(some[-1]) + 1
        share = {"share": done / n_distinct}
        _BUILDING.debug("%d of %d pairs tried", done, n_distinct, extra=share)
        if progress is not None:
            progress(done, n_distinct)
    if row_of_pair is not None:
        store = _repeated_rows(world, trials, store.outcomes(), row_of_pair)
    model = _discretised_model(world, store)
    _BUILDING.info("%r", model)
    return model


class _Tried(NamedTuple):
    """What came of one action."""

    rows: IntArray  # [cells] which of the pairs
    states: list[IntArray]  # [trials, cells] each; several where edges are split
    cost: FloatArray  # [trials or 1, cells or 1]


def _discretised_rows(world: ContinuousModel, trials: Trials, pairs: IntArray) -> Outcomes:
    """The outcomes of some pairs, in increasing order."""
    cells, action = np.divmod(pairs, len(world.actions))
    tried = [
        _try_in_cells(world, trials, cells, int(a), np.flatnonzero(action == a))
        for a in np.unique(action)
    ]
    sides = max(len(part.states) for part in tried)  # 1, 2, 4, ...
    count = math.prod(trials.shape)
    states = np.empty((len(pairs), sides, count), dtype=np.int32)
    for part in tried:
        for side in range(sides):
            states[part.rows, side] = part.states[side % len(part.states)].T
    weights = None if trials.weights is None else np.tile(trials.weights, sides)
    return tally_outcomes(
        states.reshape(len(pairs), -1), weights, _discretised_costs(tried, len(pairs), sides)
    )


def _try_in_cells(
    world: ContinuousModel, trials: Trials, cells: IntArray, action: int, rows: IntArray
) -> _Tried:
    """Take the step of one action in those of the cells that are listed."""
    point, noise = trials.draw(cells[rows])
    shape = (*trials.shape, len(rows))
    taken = take_step_in_world(world, point, action, noise, shape)
    states = world.grid.numbers_about(taken.heights)
    if taken.end.any():
        ends = taken.end.astype(np.int32) + np.int32(world.grid.n_cells - 1)
        states = [np.where(taken.end == 0, cell, ends) for cell in states]
    reached = [np.broadcast_to(state, shape).reshape(-1, len(rows)) for state in states]
    cost = taken.cost
    if any(n > 1 for n in cost.shape[:-1]):
        cost = np.broadcast_to(cost, shape)
    return _Tried(rows, reached, cost.reshape(-1, cost.shape[-1]))


def _discretised_costs(tried: list[_Tried], n_pairs: int, sides: int) -> FloatArray:
    """Discretised costs: a number, [pairs, 1], or [pairs, trials] where they differ."""
    first = tried[0].cost.flat[0]
    if all(part.cost.size == 1 and part.cost.flat[0] == first for part in tried):
        return np.asarray(first)
    width = max(len(part.cost) for part in tried)
    costs = np.empty((n_pairs, width))
    for part in tried:
        costs[part.rows] = part.cost.T
    return costs if width == 1 else np.tile(costs, sides)


def _distinct_pairs(world: ContinuousModel, n_all: int) -> tuple[IntArray | None, IntArray | None]:
    """Discretised pairs with different outcomes, in order, and each pair's place among them.

    None and None where nothing is known of pairs that are alike, and all are allowed.
    """
    pairs = world.allowed_pairs
    if world.alike is None:
        return pairs, None
    sizes = (*world.grid.shape, len(world.actions))
    *index, actions = np.ogrid[tuple(slice(size) for size in sizes)]
    told = np.asarray(world.alike(tuple(index), actions))
    if told.ndim > len(sizes) or told.dtype.kind not in "iu" or told.min() < 0:
        raise ModelError("alike must return whole numbers >= 0")
    kinds = np.broadcast_to(told, sizes).ravel()
    kinds = kinds if pairs is None else kinds[pairs]
    number = least_integer_type(n_all)
    first = np.full(int(kinds.max()) + 1, -1, dtype=number)
    first[kinds[::-1]] = np.arange(len(kinds), dtype=number)[::-1]  # each kind's first comes last
    distinct = np.sort(first[first >= 0])
    place = np.empty(len(kinds), dtype=number)
    place[distinct] = np.arange(len(distinct), dtype=number)
    return distinct if pairs is None else pairs[distinct], place[first[kinds]]


def _check_alike(
    world: ContinuousModel, trials: Trials, found: Outcomes, row_of_pair: IntArray
) -> None:
    """Discretise some pairs by themselves; raise :class:`ModelError` for one that is not alike."""
    known = world.allowed_pairs
    for k in np.unique(np.linspace(0, len(row_of_pair) - 1, SPOT_CHECKS).astype(np.int64)):
        pair = k if known is None else known[k]
        own, shared = _discretised_rows(world, trials, pair[None]), found.rows(row_of_pair[k, None])
        same = np.array_equal(own.successors, shared.successors) and all(
            np.allclose(getattr(own, name), getattr(shared, name), rtol=1e-9, atol=1e-9)
            for name in ("probabilities", "costs")
        )
        if not same:
            cell, action = divmod(int(pair), len(world.actions))
            raise ModelError(
                f"alike says that action {world.actions[action]!r} in cell {cell} has the outcomes "
                "of another pair; it has others"
            )


def _repeated_rows(
    world: ContinuousModel, trials: Trials, found: Outcomes, row_of_pair: IntArray
) -> OutcomeStore:
    """The rows of all discretised pairs, from those of the distinct ones."""
    if trials.repeatable:
        _check_alike(world, trials, found, row_of_pair)
    lengths = np.diff(found.outcome_offsets)
    store = OutcomeStore(int(lengths[row_of_pair].sum()) + len(world.dead_ends))
    for begin in range(0, len(row_of_pair), PAIRS):
        store.append(found.rows(row_of_pair[begin : begin + PAIRS]))
    return store


def _discretised_model(world: ContinuousModel, store: OutcomeStore) -> SSP:
    """The model of all pairs of the cells, with the ends added."""
    n_cells, n_actions, pairs = world.grid.n_cells, len(world.actions), world.allowed_pairs
    goal = world.end_state("goal")
    for state, cost in enumerate(world.dead_ends.values(), goal + 1):
        one = np.ones(1)
        store.append(Outcomes(np.array([0, 1]), np.array([state]), one, np.asarray(float(cost))))
    offsets = np.arange(0, n_cells * n_actions + 1, n_actions)
    if pairs is not None:
        offsets = np.searchsorted(pairs, offsets)
    model = SSP.from_arrays(
        pair_offsets=np.append(offsets, offsets[-1] + np.arange(len(world.dead_ends) + 1)),
        **store.outcomes()._asdict(),
        goal_states=np.array([goal]),
        state_labels={name: [world.end_state(name)] for name in world.dead_ends},
    )
    if pairs is None:
        return replace(model, action_names=tuple(world.actions))
    action = np.append(pairs % n_actions, np.zeros(len(world.dead_ends), dtype=np.int64))
    return replace(model, action_names=tuple(world.actions), pair_action=read_only(action))
