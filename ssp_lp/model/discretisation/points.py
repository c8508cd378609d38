"""The points of a cell, and of the noise, from which a step is tried: a quadrature, or samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError, check_whole, in_short
from ssp_lp.model.arguments import explained
from ssp_lp.model.discretisation.continuous_model import ContinuousModel
from ssp_lp.model.discretisation.distribution import Distribution
from ssp_lp.model.discretisation.grid import Coordinates

_MOST_POINTS = 1_000_000  # along one axis


class Trials(NamedTuple):
    """From where, and with which noise, a step is tried in each cell."""

    shape: tuple[int, ...]  # dimensions of the trials of one cell
    weights: FloatArray | None  # [trials], ordered as in shape; None: all the same
    draw: Callable[[IntArray], tuple[Coordinates, Coordinates]]
    """Cells -> points and noise, arrays that broadcast to [*shape, cells]."""
    repeatable: bool  # whether a cell gets the same trials every time


@dataclass(frozen=True)
class Quadrature:
    """Every combination of points in the cell, axis by axis, and of levels of the noise.

    Attributes:
        points: along each axis and in each random number: one number for all of them, or one for
            each axis and then for each random number. Discrete noise takes its own values.
        rule: "midpoint": equal parts, a point in the middle of each, equally weighted.
            "gauss-legendre": its nodes and weights. Probabilities of cells integrate a function
            that jumps, for which the midpoints are as good and keep symmetries exact; where
            smooth costs are averaged over a cell, Gauss and Legendre's rule is better.
    """

    points: int | Sequence[int] = 4
    rule: str = "midpoint"

    def trials(self, model: ContinuousModel) -> Trials:
        """All combinations of points, a dimension for each axis, then one for each random number.

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
            """The nodes in some cells, and those of the noise."""
            index = zip(axes, model.grid.index_of(cells), placed, strict=False)
            return tuple(axis.low + (k + node) * axis.width for axis, k, node in index), noise

        shares = [weights for _, weights in parts]
        equal = all(np.ptp(weights) == 0.0 for weights in shares)
        combined = reduce(np.multiply.outer, shares).ravel()
        return Trials(tuple(map(len, shares)), None if equal else combined, draw, repeatable=True)

    def _parts(self, model: ContinuousModel) -> list[tuple[FloatArray, FloatArray]]:
        """Points and weights of each axis, in widths of a cell, and of each random number."""
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
        return within[:n_axes] + [_noise_points(draw, *levels) for draw, levels in noise]

    def _levels(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Points in (0, 1) and weights that sum to 1."""
        if self.rule == "midpoint":
            return (np.arange(count) + 0.5) / count, np.full(count, 1.0 / count)
        if self.rule == "gauss-legendre":
            nodes, weights = np.polynomial.legendre.leggauss(count)
            return (nodes + 1.0) / 2.0, weights / 2.0
        raise ModelError(f"rule must be 'midpoint' or 'gauss-legendre', not {self.rule!r}")


@dataclass(frozen=True)
class Samples:
    """Independent samples of each pair: a point uniform in the cell, and noise as it is drawn.

    Attributes:
        number: of samples of each pair.
        rng: a generator or a seed; the same seed gives the same model.
    """

    number: int
    rng: np.random.Generator | int

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for less than one sample, or for a seed that is none."""
        check_whole("number", self.number)
        seed = isinstance(self.rng, (int, np.integer)) and self.rng >= 0
        if not (seed or isinstance(self.rng, np.random.Generator)):
            raise ModelError(f"rng must be a generator or a seed such as 0, not {self.rng!r}")

    def trials(self, model: ContinuousModel) -> Trials:
        """Fresh sample points at every call, in one dimension."""
        rng, axes = np.random.default_rng(self.rng), model.grid.axes

        def draw(cells: IntArray) -> tuple[Coordinates, Coordinates]:
            """Points drawn in some cells, and the noise at each."""
            shape = (int(self.number), len(cells))
            index = zip(axes, model.grid.index_of(cells), strict=True)
            point = tuple(axis.low + (k + rng.random(shape)) * axis.width for axis, k in index)
            return point, tuple(random.at(rng.random(shape)) for random in model.noise)

        return Trials((int(self.number),), None, draw, repeatable=False)

    @explained
    def deviation(self, pairs: int, reachable: int, confidence: float = 0.95) -> float:
        """By how much, in the sum of absolute differences, any pair's sampled outcomes are off.

        The statement: with at least this confidence over the samples, every one of ``pairs`` has
        sampled probabilities within this distance of the true ones, those of a point uniform in
        the cell. Weissman et al. (2003), theorem 2.1, for one pair; the union bound for all.

        Then, for every policy at once, its failure probability in the true grid model exceeds or
        undercuts that in the sampled one by at most half the deviation times its expected number of
        steps in the sampled one (each step errs by at most half the distance, for a function with
        values in [0, 1]). Nothing follows for the continuous world: see ``simulate``.

        Args:
            pairs: how many pairs are sampled.
            reachable: a number of states that no pair's true outcomes exceed, known beforehand;
                those seen in the samples may be too few, the number of states is always safe.
            confidence: of the statement.

        Raises:
            ModelError: a number that cannot be.
        """
        if pairs < 1 or reachable < 1 or not 0.0 < confidence < 1.0:
            raise ModelError("deviation needs pairs and reachable >= 1 and 0 < confidence < 1")
        if reachable == 1:
            return 0.0
        sides = reachable * math.log(2.0) + math.log1p(-(2.0 ** (1 - reachable)))  # 2^a - 2
        logarithm = sides + math.log(pairs) - math.log1p(-confidence)
        return min(2.0, math.sqrt(2.0 * logarithm / self.number))


def _noise_points(
    draw: Distribution, levels: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Points of a random number with their weights; a discrete one has its own."""
    if draw.values is not None and draw.probabilities is not None:
        return draw.values, draw.probabilities
    return draw.at(levels), weights
