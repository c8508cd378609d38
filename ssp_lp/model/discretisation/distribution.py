"""The distribution of one random number that a step, or a start, draws."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import PROBABILITY_SUM, FloatArray, ReadOnlyCopies, read_only
from ssp_lp.errors import ModelError, in_short
from ssp_lp.model.arguments import check_fields, explained


@dataclass(frozen=True, eq=False, repr=False)
class Distribution(ReadOnlyCopies):
    """A random number, given by its quantile function; drawn independently of all others.

    ``Distribution(scipy.stats.norm(0.0, 0.1).ppf)`` is a normal one: any vectorised function from
    levels in (0, 1) to values that does not fall. :meth:`uniform` and :meth:`discrete` make others.
    """

    quantile: Callable[[FloatArray], npt.ArrayLike]
    values: FloatArray | None = None  # [atoms], of a discrete one
    probabilities: FloatArray | None = None  # [atoms]

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for a quantile function that is none."""
        check_fields(self)

    @classmethod
    @explained
    def uniform(cls, low: float, high: float) -> Distribution:
        """Uniform between two numbers; raises :class:`ModelError` unless low <= high, finite."""
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            raise ModelError(f"a uniform distribution needs low <= high, not {low!r}, {high!r}")
        return cls(_Uniform(float(low), float(high)))

    @classmethod
    @explained
    def discrete(cls, values: npt.ArrayLike, probabilities: npt.ArrayLike) -> Distribution:
        """Finitely many values, [atoms], with their probabilities, [atoms].

        Raises:
            ModelError: other shapes, a value that is not finite, or no probabilities.
        """
        atoms = np.asarray(values, dtype=np.float64)
        chance = np.asarray(probabilities, dtype=np.float64)
        if atoms.ndim != 1 or atoms.size == 0 or atoms.shape != chance.shape:
            raise ModelError("a discrete distribution needs as many values as probabilities")
        if not np.isfinite(atoms).all():
            raise ModelError("a value of a discrete distribution is not finite")
        total = float(chance.sum())
        if not (chance >= 0.0).all() or not abs(total - 1.0) <= PROBABILITY_SUM:
            raise ModelError(f"probabilities of a distribution must be >= 0 and sum to 1: {total}")
        atoms, chance = atoms[chance > 0.0], chance[chance > 0.0] / total
        quantile = partial(_atoms_at, atoms, np.cumsum(chance[:-1]))
        return cls(quantile, read_only(atoms), read_only(chance))

    def __repr__(self) -> str:
        """The quantile function, or how many values there are."""
        told = in_short(self.quantile) if self.values is None else f"{self.values.size} values"
        return f"Distribution({told})"

    @explained
    def at(self, levels: FloatArray) -> FloatArray:
        """Values at levels in (0, 1); raises :class:`ModelError` if they are no finite numbers."""
        found = np.asarray(self.quantile(levels))
        real = found.dtype.kind in "biuf" and found.shape == levels.shape
        if not real or not np.isfinite(found).all():
            raise ModelError("a quantile function must return a finite number for each level")
        return found.astype(np.float64, copy=False)


@dataclass(frozen=True)
class _Uniform:
    """The quantile function of a uniform distribution."""

    low: float
    high: float

    def __call__(self, levels: FloatArray) -> FloatArray:
        """The value at each level, like ``levels``."""
        return self.low + (self.high - self.low) * levels


def _atoms_at(atoms: FloatArray, cumulative: FloatArray, levels: FloatArray) -> FloatArray:
    """The atom of a discrete distribution at each level, like ``levels``."""
    return np.asarray(atoms[np.searchsorted(cumulative, levels, side="right")])
