"""Discretisation of a continuous world: each action is tried from several points of each cell."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Final, NamedTuple

import numpy as np

from ssp_lp.arrays import (
    FloatArray,
    IntArray,
    offsets_of,
    read_only,
)
from ssp_lp.errors import ModelError, check_whole, in_short
from ssp_lp.model.arguments import explained, explained_class
from ssp_lp.model.continuous_model import ContinuousModel, Coordinates, take_step_in_world
from ssp_lp.model.ssp import SSP
from ssp_lp.model.state_rows import Outcomes, joined_outcomes

_MOST_POINTS = 1_000_000  # along one axis


class _Trials(NamedTuple):
    """Trials of a step from a cell: each has a point in the cell and values of the noise."""

    shape: tuple[int, ...]  # dimensions of the trials of one cell
    weights: FloatArray | None  # [trials], ordered as in shape; None: all equal
    draw: Callable[[IntArray], tuple[Coordinates, Coordinates]]
    """Cells -> points and noise, arrays that broadcast to [*shape, cells]."""
    repeatable: bool  # whether a cell has the same trials every time


@explained_class
@dataclass(frozen=True)
class Quadrature:
    """Trials at every combination of quadrature points along the axes and of levels of the noise.

    Attributes:
        points: number of points for each axis and each random number: one number for all, or one
            for each axis and then for each random number. Noise with finitely many values uses
            these values instead.
        rule: "midpoint": equal parts with a point in the middle of each, and equal weights.
            "gauss-legendre": the nodes and weights of Gauss and Legendre, which average smooth
            costs over a cell more accurately. For probabilities, which are integrals of functions
            with jumps, midpoints are as accurate, and they preserve symmetries exactly.
    """

    points: int | Sequence[int] = 4
    rule: str = "midpoint"

    def trials(self, model: ContinuousModel) -> _Trials:
        """Return the quadrature points, one dimension for each axis and each random number.

        Raises:
            ModelError: a wrong number of points, or an unknown rule.
        """
        parts, axes = self._parts(model), model.grid.axes
        placed = []
        for k, (nodes, _) in enumerate(parts):
            form = [1] * (len(parts) + 1)
            form[k] = len(nodes)
            placed.append(nodes.reshape(form))
        noise = tuple(placed[len(axes) :])

        def draw(cells: IntArray) -> tuple[Coordinates, Coordinates]:
            """Return the quadrature points in some cells, and the values of the noise."""
            index = zip(axes, model.grid.index_of(cells), placed, strict=False)
            return tuple(axis.low + (k + node) * axis.width for axis, k, node in index), noise

        shares = [weights for _, weights in parts]
        equal = all(np.ptp(weights) == 0.0 for weights in shares)
        combined = reduce(np.multiply.outer, shares).ravel()
        return _Trials(tuple(map(len, shares)), None if equal else combined, draw, repeatable=True)

    def _parts(self, model: ContinuousModel) -> list[tuple[FloatArray, FloatArray]]:
        """Return points and weights for each axis, then for each random number.

        Points of an axis are fractions of a cell's width, in (0, 1).
        """
        n_axes, n_noise = len(model.grid.axes), len(model.noise)
        given = self.points
        counts: list[Any] = np.ravel(given).tolist() * (1 if np.ndim(given) else n_axes + n_noise)
        whole = all(isinstance(n, (int, np.integer)) and 1 <= n <= _MOST_POINTS for n in counts)
        if len(counts) != n_axes + n_noise or not whole:
            raise ModelError(
                f"points must be a number >= 1 (<= {_MOST_POINTS:,}), or {n_axes} of them for the "
                f"axes and {n_noise} for the noise, not {in_short(given)}"
            )
        within = [self._levels(int(n)) for n in counts]
        noise = zip(model.noise, within[n_axes:], strict=True)
        return within[:n_axes] + [
            (draw.at(levels), weights)
            if draw.values is None or draw.probabilities is None
            else (draw.values, draw.probabilities)  # of a discrete distribution
            for draw, (levels, weights) in noise
        ]

    def _levels(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return quadrature points in (0, 1) and weights that sum to 1."""
        if self.rule == "midpoint":
            return (np.arange(count) + 0.5) / count, np.full(count, 1.0 / count)
        if self.rule == "gauss-legendre":
            nodes, weights = np.polynomial.legendre.leggauss(count)
            return (nodes + 1.0) / 2.0, weights / 2.0
        raise ModelError(f"rule must be 'midpoint' or 'gauss-legendre', not {self.rule!r}")


@explained_class
@dataclass(frozen=True)
class Samples:
    """Independent samples of each pair: a point uniform in the cell, and a value of the noise.

    Attributes:
        number: number of samples of each pair.
        seed: a number or a generator; the same number gives the same model.
    """

    number: int
    seed: np.random.Generator | int

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for less than one sample, or for a wrong seed."""
        check_whole("number", self.number)
        is_number = isinstance(self.seed, (int, np.integer)) and self.seed >= 0
        if not (is_number or isinstance(self.seed, np.random.Generator)):
            raise ModelError(f"seed must be a number such as 0 or a generator, not {self.seed!r}")

    def trials(self, model: ContinuousModel) -> _Trials:
        """Return trials with random points and noise, drawn again at every call of ``draw``."""
        rng, axes = np.random.default_rng(self.seed), model.grid.axes

        def draw(cells: IntArray) -> tuple[Coordinates, Coordinates]:
            """Return random points in some cells, and the noise drawn at each point."""
            shape = (int(self.number), len(cells))
            index = zip(axes, model.grid.index_of(cells), strict=True)
            point = tuple(axis.low + (k + rng.random(shape)) * axis.width for axis, k in index)
            return point, tuple(random.at(rng.random(shape)) for random in model.noise)

        return _Trials((int(self.number),), None, draw, repeatable=False)

    @explained
    def deviation(self, pairs: int, reachable: int, confidence: float = 0.95) -> float:
        """Return a bound of the L1 distance between sampled and true probabilities of a pair.

        With probability ``confidence`` the bound holds for all ``pairs`` jointly: theorem 2.1 of
        Weissman et al. (2003) for each pair, and the union bound over pairs. The true probabilities
        are those of a point that is uniform in the cell.

        If the bound holds, the failure probabilities of any policy in the true and in the sampled
        grid model differ by at most half the bound times the policy's expected number of steps in
        the sampled model (the mean of a function with values in [0, 1] changes by at most half the
        L1 distance in each step). This does not extend to the continuous world: see ``simulate``.

        Args:
            pairs: number of sampled pairs.
            reachable: upper bound of the number of true successors of a pair, known beforehand. The
                number seen in the samples may be too small; the number of states is always valid.
            confidence: probability that the bound holds, in (0, 1).

        Raises:
            ModelError: a number out of range.
        """
        if pairs < 1 or reachable < 1 or not 0.0 < confidence < 1.0:
            raise ModelError("deviation needs pairs and reachable >= 1 and 0 < confidence < 1")
        if reachable == 1:
            return 0.0
        sides = reachable * math.log(2.0) + math.log1p(-(2.0 ** (1 - reachable)))  # 2^a - 2
        logarithm = sides + math.log(pairs) - math.log1p(-confidence)
        return min(2.0, math.sqrt(2.0 * logarithm / self.number))


def tally_outcomes(states: IntArray, weights: FloatArray | None, costs: FloatArray) -> Outcomes:
    """Return the outcomes of pairs, one for each distinct successor among the trials of a pair.

    Args:
        states: successor in each trial, [pairs, trials].
        weights: weight of each trial, [trials]; None: equal weights, which are counted exactly.
        costs: one number, [pairs, 1] or [pairs, trials]. The cost of an outcome is the mean over
            its trials.
    """
    varies = costs.ndim == 2 and costs.shape[1] > 1
    n_trials, are_counted = states.shape[1], weights is None and not varies
    share = np.full(n_trials, 1.0) if weights is None else weights
    if are_counted:
        ordered = np.sort(states, axis=1)
    else:  # the trial's number is stored in the lower digits
        packed = states.astype(np.int64) * n_trials + np.arange(n_trials)
        packed.sort(axis=1)
        ordered = packed // n_trials
        trial = packed - ordered * n_trials
        taken = share[trial].ravel()
    begins = np.ones(ordered.shape, dtype=np.bool_)
    np.not_equal(ordered[:, 1:], ordered[:, :-1], out=begins[:, 1:])
    firsts, lengths = np.flatnonzero(begins), np.count_nonzero(begins, axis=1)
    counts = np.diff(firsts, append=ordered.size)
    mass = counts if are_counted else np.add.reduceat(taken, firsts)
    paid = costs
    if varies:
        each = np.take_along_axis(costs, trial, axis=1).ravel()
        low, high = np.minimum.reduceat(each, firsts), np.maximum.reduceat(each, firsts)
        # equal costs stay exact to the last bit: criteria that add up costs rely on it
        paid = np.clip(np.add.reduceat(taken * each, firsts) / mass, low, high)
    elif costs.ndim == 2:
        paid = np.repeat(costs[:, 0], lengths)
    successors = ordered.ravel()[firsts].astype(np.int32)
    return Outcomes(lengths, successors, mass / share.sum(), paid)


TRIALS: Final = 1 << 19
"""Number of trials processed at a time: scratch arrays of some tens of megabytes."""

MIDPOINTS: Final = Quadrature()

_SPREAD: Final = 4
"""Greatest group number of ``alike`` for each pair; above it the groups are renumbered."""

_BUILDING = logging.getLogger("ssp_lp.building")


@explained
def discretise(
    world: ContinuousModel,
    points: Quadrature | Samples = MIDPOINTS,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> SSP:
    """Discretise a continuous world: a finite model whose states are the grid's cells.

    In the model each step begins at a point uniform in its cell, independently of the past. In the
    world the point depends on the past, so a certificate of the model does not hold in the world.
    Play the policy in the world (``WorldSimulator``) to obtain an exact interval of its failure
    probability.

    Args:
        world: the step function and the grid.
        points: a :class:`Quadrature`, or :class:`Samples`.
        progress: called with the number of finished pairs and the total.

    Returns:
        The model. Its states are the cells 0, 1, ..., as ``world.grid.cell_of`` numbers them, then
        the goal, then the dead-ends, which are absorbing and bear their labels. Outcomes of a pair
        with the same successor are merged, with the mean of their costs.

    Raises:
        ModelError: the step function returns a value of a wrong form, or leaves the box.
    """
    actions, outcomes = discretised_rows(world, points, 0, world.n_states, progress=progress)
    lengths, successors, probabilities, costs = outcomes
    model = SSP.from_arrays(
        pair_offsets=offsets_of(actions),
        outcome_offsets=offsets_of(lengths),
        successors=successors,
        probabilities=probabilities,
        costs=costs,
        goal_states=np.array([world.end_state("goal")]),
        state_labels={name: [world.end_state(name)] for name in world.dead_ends},
    )
    names: dict[str, Any] = {"action_names": tuple(world.actions)}
    if (pairs := world.allowed_pairs) is not None:
        taken = np.append(pairs % len(world.actions), np.zeros(len(world.dead_ends), np.int64))
        names["pair_action"] = read_only(taken)
    model = replace(model, **names)
    _BUILDING.info("%r", model)
    return model


def discretised_rows(
    world: ContinuousModel,
    points: Quadrature | Samples,
    first: int,
    end: int,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[IntArray, Outcomes]:
    """Return the outcomes of consecutive states of the model that :func:`discretise` would build.

    With a quadrature the outcomes of a state do not depend on the range. If ``world.alike`` groups
    pairs, the outcomes of one pair of each group in the range are computed and copied.

    Args:
        world: the step function and the grid.
        points: as :func:`discretise` takes them.
        first: number of the first state.
        end: number of the last state plus 1.
        progress: called with the number of finished pairs and the total.

    Returns:
        Number of actions of each state in the range, [states in the range], and the outcomes of
        their pairs.

    Raises:
        ModelError: as :func:`discretise` does.
    """
    if not isinstance(points, (Quadrature, Samples)):
        raise ModelError(f"points must be Quadrature(4) or Samples(1000, seed=0), not {points!r}")
    trials, n_cells, n_actions = points.trials(world), world.grid.n_cells, len(world.actions)
    begin, behind = min(first, n_cells), min(end, n_cells)
    pairs = world.pairs_between(begin, behind)
    actions = np.bincount(pairs // n_actions - begin, minlength=behind - begin)
    parts = _rows_of_pairs(world, trials, pairs, progress)

    # at the ends: the goal has no actions, dead-ends are absorbing
    goal, ends = world.end_state("goal"), np.arange(max(first, n_cells), max(end, n_cells))
    dead_ends = list(world.dead_ends.values())
    for state in ends[ends > goal].tolist():
        cost = np.asarray(float(dead_ends[state - goal - 1]))
        once = np.ones(1, np.int64)
        parts.append(Outcomes(once, np.array([state], np.int32), np.ones(1), cost))
    return np.append(actions, ends > goal), joined_outcomes(parts)


def _rows_of_pairs(
    world: ContinuousModel,
    trials: _Trials,
    pairs: IntArray,
    progress: Callable[[int, int], None] | None,
) -> list[Outcomes]:
    """Return the outcomes of pairs in increasing order, as one or several blocks.

    If ``world.alike`` groups pairs, only the first pair of each group is tried.
    """
    distinct, row_of_pair = _distinct_pairs(world, pairs)
    parts, size = list[Outcomes](), max(1, TRIALS // math.prod(trials.shape))
    for begin in range(0, len(distinct), size):
        parts.append(_discretised_rows(world, trials, distinct[begin : begin + size]))
        done = min(begin + size, len(distinct))
        share = {"share": done / len(distinct)}
        _BUILDING.debug("%d of %d pairs tried", done, len(distinct), extra=share)
        if progress is not None:
            progress(done, len(distinct))
    if row_of_pair is None:
        return parts
    return [_repeated_rows(world, trials, joined_outcomes(parts), pairs, distinct, row_of_pair)]


def _discretised_rows(world: ContinuousModel, trials: _Trials, pairs: IntArray) -> Outcomes:
    cells, action = np.divmod(pairs, len(world.actions))
    rows = [np.flatnonzero(action == number) for number in np.unique(action)]
    made = [_rows_of_action(world, trials, cells[some], int(action[some[0]])) for some in rows]
    return joined_outcomes(made).rows(np.argsort(np.concatenate(rows)))


def _rows_of_action(
    world: ContinuousModel, trials: _Trials, cells: IntArray, action: int
) -> Outcomes:
    """Return the outcomes of one action in some cells."""
    point, noise = trials.draw(cells)
    shape = (*trials.shape, len(cells))
    taken = take_step_in_world(world, point, action, noise, shape)
    reached = world.grid.numbers_about(taken.heights)  # several where edges are split
    if taken.end.any():
        ends = taken.end.astype(np.int32) + np.int32(world.grid.n_cells - 1)
        reached = [np.where(taken.end == 0, cell, ends) for cell in reached]

    def by_cell(numbers: Any) -> Any:
        """Return values, one for each trial, as an array with a row for each cell."""
        return np.broadcast_to(numbers, shape).reshape(-1, len(cells)).T

    states = np.empty((len(cells), len(reached), math.prod(trials.shape)), dtype=np.int32)
    for side, state in enumerate(reached):
        states[:, side] = by_cell(state)
    weights = None if trials.weights is None else np.tile(trials.weights, len(reached))
    costs = taken.cost
    if costs.size == 1:
        costs = costs.reshape(())
    elif costs.size == costs.shape[-1]:  # the same in all trials of a cell
        costs = costs.reshape(-1, 1)
    else:
        costs = np.tile(by_cell(costs), len(reached))
    return tally_outcomes(states.reshape(len(cells), -1), weights, costs)


def _distinct_pairs(world: ContinuousModel, pairs: IntArray) -> tuple[IntArray, IntArray | None]:
    """Return the first pair of each group of ``world.alike``, and the group of each pair.

    Groups are numbered in the order of their first pairs. Without ``alike`` the results are
    ``pairs`` and None.
    """
    if world.alike is None or not len(pairs):
        return pairs, None
    n_actions = len(world.actions)
    begin, last = int(pairs[0]) // n_actions, int(pairs[-1]) // n_actions
    cells = np.arange(begin, last + 1)
    index = tuple(places[:, None] for places in world.grid.index_of(cells))
    alike = np.asarray(world.alike(index, np.arange(n_actions)[None, :]))
    if alike.ndim > 2 or alike.dtype.kind not in "iu" or alike.min() < 0:
        raise ModelError("alike() must return whole numbers >= 0")
    kinds = np.broadcast_to(alike, (len(cells), n_actions)).ravel()
    kinds = kinds if len(pairs) == len(kinds) else kinds[pairs - begin * n_actions]
    kinds = kinds - kinds.min()
    if int(kinds.max()) > _SPREAD * len(kinds):
        kinds = np.unique(kinds, return_inverse=True)[1]
    first = np.full(int(kinds.max()) + 1, -1, dtype=pairs.dtype)
    first[kinds[::-1]] = np.arange(len(kinds), dtype=pairs.dtype)[::-1]  # first pairs win
    distinct = np.sort(first[first >= 0])
    place = np.empty(len(kinds), dtype=pairs.dtype)
    place[distinct] = np.arange(len(distinct), dtype=pairs.dtype)
    return pairs[distinct], place[first[kinds]]


def _repeated_rows(
    world: ContinuousModel,
    trials: _Trials,
    found: Outcomes,
    pairs: IntArray,
    distinct: IntArray,
    row_of_pair: IntArray,
    most_checks: int = 30,
) -> Outcomes:
    """Return the outcomes of all pairs, copied from the first pair of each ``world.alike`` group.

    As a check, up to ``most_checks`` of the copied pairs are computed, too.

    Raises:
        ModelError: the computed outcomes of a pair differ from the copied ones.
    """
    repeated = np.flatnonzero(distinct[row_of_pair] != pairs)
    checks = min(most_checks, len(repeated)) if trials.repeatable else 0
    for k in repeated[np.linspace(0, len(repeated) - 1, checks).astype(np.int64)]:
        own = _discretised_rows(world, trials, pairs[k, None])
        shared = found.rows(row_of_pair[k, None])
        if not np.array_equal(own.successors, shared.successors) or not all(
            np.allclose(*numbers, rtol=1e-9, atol=1e-9)
            for numbers in zip(own[2:], shared[2:], strict=True)
        ):
            cell, action = divmod(int(pairs[k]), len(world.actions))
            raise ModelError(
                f"alike groups action {world.actions[action]!r} in cell {cell} with a pair whose "
                "outcomes differ: correct alike"
            )
    return found.rows(row_of_pair)
