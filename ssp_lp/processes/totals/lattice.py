"""The lattice of accumulated costs (paper, Assumption 2-1): the common divisor of the costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from math import gcd, lcm
from numbers import Rational

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.chunks import chunks
from ssp_lp.processes.expectations import uniform_cost

_MOST_LAYERS_PER_STEP = 1_000_000
_SHORT = 9  # digits of a decimal that a person would write down
_MEANT = 1e-12  # relative distance at which a cost is such a decimal


def exact_cost(cost: float | Fraction) -> Fraction:
    """The number that a cost on a lattice stands for: a float means its shortest decimal.

    Sums of decimals that were rounded on the way are what they were meant to be: 0.1 * 3 is 0.3.
    """
    if isinstance(cost, Rational):
        return Fraction(cost)
    short = f"{cost:.{_SHORT}g}"
    is_short = abs(float(short) - cost) <= _MEANT * abs(cost)
    return Fraction(short if is_short else repr(float(cost)))


def last_layer(bound: float | Fraction, unit: Fraction) -> int:
    """The last layer of a lattice whose cost is at most a finite bound; negative: there is none.

    A float means its shortest decimal, to the last digit (three steps of 0.1 are within 0.3), or
    the whole number of layers of which it is the nearest float (2/3, where the unit is 1/3).
    """
    if not isinstance(bound, Rational):
        nearest = round(Fraction(float(bound)) / unit)
        if float(nearest * unit) == float(bound):
            return nearest
        bound = Fraction(repr(float(bound)))
    return int(Fraction(bound) // unit)


def layers_within(total: float | Fraction, unit: Fraction) -> int:
    """How many layers of a lattice cost at most so much: the first one beyond the total."""
    return max(last_layer(total, unit) + 1, 0)


def totals_of(layers: IntArray, unit: Fraction) -> FloatArray:
    """Total cost of whole layers of a lattice, rounded once, like ``layers``."""
    return np.asarray(layers * float(unit.numerator) / float(unit.denominator))


def common_unit(costs: FloatArray, exact: Mapping[float, Fraction]) -> Fraction:
    """The unit of a lattice: the greatest number of which every cost is a whole multiple.

    A float means a decimal (``exact_cost``) unless ``exact`` says which fraction it is.

    Args:
        costs: non-negative; zeros do not matter.
        exact: float cost -> the fraction meant.

    Returns:
        The unit; 1 where every cost is zero.
    """
    fractions = [exact.get(c, exact_cost(c)) for c in np.unique(costs).tolist() if c > 0]
    if not fractions:
        return Fraction(1)
    denominator = lcm(*(f.denominator for f in fractions))
    return Fraction(gcd(*(int(f * denominator) for f in fractions)), denominator)


def layers_of(costs: FloatArray, unit: Fraction, exact: Mapping[float, Fraction]) -> IntArray:
    """Whole number of a lattice's units in each cost, like ``costs``.

    Raises:
        ModelError: a single step passes too many layers for a table over accumulated cost.
    """
    distinct, back = np.unique(costs, return_inverse=True)
    counts = [int(exact.get(c, exact_cost(c)) / unit) if c > 0 else 0 for c in distinct.tolist()]
    if max(counts, default=0) > _MOST_LAYERS_PER_STEP:
        raise ModelError(
            f"the costs have the common unit {float(unit):g}, so the step of cost "
            f"{float(distinct[-1]):g} passes {max(counts):,} layers of accumulated cost; round "
            "the costs to a coarser grid (for instance to multiples of "
            f"{float(distinct[-1]) / 100:g}) when building the model"
        )
    return np.array(counts, dtype=np.int64)[back].reshape(np.shape(costs))


@dataclass(frozen=True, eq=False)
class Lattice:
    """The unit of accumulated cost, and how many units each outcome passes."""

    unit: Fraction
    ahead: IntArray  # [outcomes] layers ahead, of outcomes that go on
    width: int  # layers that one step can reach: 0 .. width - 1 ahead
    least: int  # layers ahead that the cheapest of them leads


def lattice_of(model: SSP, going_on: BoolArray) -> Lattice:
    """Place a model's costs on their common lattice.

    Args:
        model: the model.
        going_on: successors at which a run goes on, so that the cost of getting there must be
            remembered, [states].

    Raises:
        ModelError: the costs have no common unit that gives a sane number of layers.
    """
    exact = model.exact_costs
    same = uniform_cost(model)
    if same is not None:
        unit = common_unit(np.array([same]), exact)
        layer = layers_of(np.array([same]), unit, exact).astype(np.int32)
        return Lattice(
            unit, np.broadcast_to(layer, (model.n_outcomes,)), int(layer[0]) + 1, int(layer[0])
        )
    found = [np.zeros(0)]
    for some in chunks(model.n_outcomes):
        moving = going_on[model.successors[some]] & (model.probabilities[some] > 0)
        found.append(np.unique(model.costs[some][moving]))
    distinct = np.unique(np.concatenate(found))
    unit = common_unit(distinct, exact)
    layers = layers_of(distinct, unit, exact)
    ahead = np.zeros(model.n_outcomes, dtype=np.int32)
    for some in chunks(model.n_outcomes if distinct.size else 0):
        place = np.minimum(np.searchsorted(distinct, model.costs[some]), distinct.size - 1)
        moving = going_on[model.successors[some]] & (model.probabilities[some] > 0)
        ahead[some] = np.where(moving, layers[place], 0)
    least = int(layers.min()) if layers.size else 0
    return Lattice(unit, ahead, int(ahead.max(initial=0)) + 1, least)
