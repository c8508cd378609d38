"""Many layers of accumulated cost at once: the transition of 2^k layers, by repeated squaring.

A chain of few nodes that is hardly left arrives in millions of layers. One layer is a matrix on the
places where mass can wait, and its powers of two lead to any layer in as many products as the layer
has binary digits. What leaves is carried as data and sums up without a subtraction; the rows of a
power are scaled to what it leaves over, so that the rounding of a probability of staying near 1 is
not raised to the power of the layers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, concatenated_ranges

MOST_LEVELS = 62
"""Layers are counted up to 2^62, as far as integers of 64 bits go."""

_MOSTLY_STAYS = 0.5
"""Exits up to which what stays is taken from them; above, the subtraction would lose digits."""


class _LayerPower(NamedTuple):
    """2^k layers as one step."""

    onward: FloatArray  # [places, places]
    lands: FloatArray  # [places] probability of having arrived at the goal
    leaves: FloatArray  # [places] probability of having lost it

    def scaled(self) -> _LayerPower:
        """The same power, where the probabilities of going on add up to what the exits leave."""
        exits, total = self.lands + self.leaves, self.onward.sum(axis=1)
        stays = exits <= _MOSTLY_STAYS
        factor = np.divide(1.0 - exits, total, out=np.ones_like(exits), where=stays)
        return self._replace(onward=self.onward * factor[:, None])

    def doubled(self) -> _LayerPower:
        """The power of twice as many layers."""
        lands = self.lands + self.onward @ self.lands
        leaves = self.leaves + self.onward @ self.leaves
        return _LayerPower(self.onward @ self.onward, lands, leaves).scaled()


class LayerPowers:
    """Powers of two of one layer's transition, squared when they are first needed. Mutable."""

    def __init__(self, onward: FloatArray, lands: FloatArray, leaves: FloatArray) -> None:
        """Begin with one layer.

        Args:
            onward: probabilities of waiting at a place after the layer, [places, places].
            lands: probability of arriving at the goal in the layer, [places].
            leaves: probability of losing it in the layer, [places].
        """
        self._levels = [_LayerPower(onward, lands, leaves).scaled()]

    def after(self, waiting: FloatArray, layers: int) -> tuple[float, FloatArray]:
        """What has arrived after some layers, and what waits then.

        Args:
            waiting: mass before the first of them, [places].
            layers: how many, at least 0 and less than 2^62.
        """
        arrived = 0.0
        for k in range(layers.bit_length()):
            if layers >> k & 1:
                level = self._level(k)
                arrived += float(waiting @ level.lands)
                waiting = waiting @ level.onward
        return arrived, waiting

    def until(self, waiting: FloatArray, mass: float) -> int | None:
        """How many layers pass before the one in which the arrivals reach a mass.

        Args:
            waiting: mass before the first layer, [places].
            mass: above 0.

        Returns:
            The layers, or None where 2^62 of them are not enough.
        """
        k = 0
        while float(waiting @ self._level(k).lands) < mass:
            k += 1
            if k > MOST_LEVELS:
                return None
        layers, arrived = 0, 0.0
        for j in reversed(range(k)):
            level = self._level(j)
            more = arrived + float(waiting @ level.lands)
            if more < mass:
                layers, arrived, waiting = layers + (1 << j), more, waiting @ level.onward
        return layers

    def _level(self, k: int) -> _LayerPower:
        """The transition of ``2^k`` layers."""
        while len(self._levels) <= k:
            self._levels.append(self._levels[-1].doubled())
        return self._levels[k]


@dataclass(frozen=True, eq=False)
class LayerPlaces:
    """Where mass can wait: at a node, some layers ahead. Those of a node follow each other."""

    node: IntArray  # [places] the goal is the last node
    delay: IntArray  # [places] layers ahead
    first: IntArray  # [nodes] the place of each node with no delay

    @classmethod
    def upto(cls, dearest: IntArray) -> LayerPlaces:
        """The places that steps lead to, and one without delay at each node.

        Args:
            dearest: layers that a step into the node passes at most, [nodes].
        """
        count = np.maximum(dearest, 1)
        node = np.repeat(np.arange(len(count)), count)
        delay = concatenated_ranges(np.zeros_like(count), count)
        return cls(node, delay, np.cumsum(count) - count)

    @property
    def size(self) -> int:
        """Number of places in which mass waits within a layer's power."""
        return len(self.node)

    def columns(self, n_nodes: int) -> IntArray:
        """Where steps that lead to each place stand among (layers passed, node), [places]."""
        return np.asarray((self.delay + 1) * n_nodes + self.node)

    def powers(self, leaving: FloatArray) -> LayerPowers:
        """The transition of one layer: mass without delay leaves, the rest comes one layer nearer.

        Args:
            leaving: where it goes: to each place, to the goal within the layer, or lost,
                [nodes before the goal, places + 2].
        """
        goal = self.first[-1]
        onward = np.zeros((self.size, self.size))
        lands, leaves = np.zeros(self.size), np.zeros(self.size)
        waits = np.flatnonzero(self.delay > 0)
        onward[waits, waits - 1] = 1.0
        begin = self.first[:-1]
        onward[begin], lands[begin], leaves[begin] = leaving[:, :-2], leaving[:, -2], leaving[:, -1]
        lands[goal] = 1.0
        return LayerPowers(onward, lands, leaves)
