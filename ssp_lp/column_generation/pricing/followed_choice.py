"""What a choice is worth, by following its mass forwards through the layers of accumulated cost.

One number of each node is sent on, and only from where the choice comes to; a sweep backwards
gathers three numbers for every node of every layer.
"""

from __future__ import annotations

from math import fsum

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, unsigned
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.bellman import PairCost, row_parts
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess
from ssp_lp.processes.totals.levels import Levels

_ON_ITS_WAY = 0.01
"""Share of what has arrived that may be on its way still, where a rule is followed for a guess."""

_LAYERS_BETWEEN = 8  # two looks at that

_DROPPED = 1e-9
"""Mass of a node that a guess leaves out, so that it follows what matters."""


def follow_choice(
    process: LayeredProcess, choice: IntArray, beyond: tuple[FloatArray, FloatArray, FloatArray]
) -> FloatArray:
    """(charge, failure, goal) of a choice from the start on.

    Args:
        process: without free steps.
        choice: position among the pairs of each node, [cap, nodes].
        beyond: charge, failure and goal of the tails beyond the cap, [layers beyond, nodes] each.
    """
    mass, sums = LayerMass(process.base.start, process.levels), list[list[float]]()
    for layer in range(process.cap):
        check_time()
        charge = process.charged(layer)
        sums.append(_followed_layer(process.base, charge, choice[layer], mass).tolist())
    left = mass.left[: len(beyond[0])]
    sums.append([float((left * each).sum()) for each in beyond])
    return np.array([fsum(each) for each in zip(*sums, strict=True)])


def mass_beyond(process: LayeredProcess, choice: IntArray) -> FloatArray:
    """The mass with which a choice gets beyond the cap, [layers beyond, nodes] at least.

    Args:
        process: without free steps.
        choice: position among the pairs of each node, [cap, nodes].
    """
    mass, free = LayerMass(process.base.start, process.levels), PairCost(process.base.gain_cost)
    for layer in range(process.cap):
        check_time()
        _followed_layer(process.base, free, choice[layer], mass)
    return mass.left


def follow_rule(
    base: AccumulatedCost, rule: IntArray, most_layers: int
) -> tuple[float, float] | None:
    """(E[cost; goal], goal) from the start, about, of a pair for each node whatever has been paid.

    Args:
        base: one layer of a process without free steps.
        rule: position among the pairs of each node, [nodes].
        most_layers: layers to follow it through.

    Returns:
        None where nothing is seen to arrive, or much is still on its way by then.
    """
    mass = LayerMass(base.start, Levels.of_lattice(base.exact_unit, 0, base.width))
    found: FloatArray = np.zeros(3)
    for layer in range(most_layers):
        check_time()
        charge = PairCost(base.gain_cost, base.gain, layer * base.unit)
        mass.here[mass.here < _DROPPED] = 0.0
        found = found + _followed_layer(base, charge, rule, mass)
        if layer % _LAYERS_BETWEEN == 0 and mass.left.sum() <= _ON_ITS_WAY * found[2]:
            return (float(found[0]), float(found[2])) if found[2] > 0.0 else None
    return None


def _followed_layer(
    base: AccumulatedCost, charge: PairCost, choice: IntArray, mass: LayerMass
) -> FloatArray:
    """Charge, failure and goal of a layer's choice, [nodes]; its mass goes on to the next."""
    from ssp_lp.compiled.streaming import follow_layer

    found = np.zeros((3, 2))  # sums, and what was rounded off them
    follow_layer(
        mass.here, choice, unsigned(base.pair_offsets), *row_parts(base.later), *charge.parts,
        base.gain, base.failure, base.survival, mass.onward, found,
    )  # fmt: skip
    mass.step()
    return np.asarray(found.sum(axis=1))


class LayerMass:
    """The mass of a layer and of those that its steps lead to, layer after layer."""

    def __init__(self, start: FloatArray, levels: Levels) -> None:
        """Begin in the first layer.

        Args:
            start: its mass, [nodes].
            levels: which step leads where.
        """
        self._span, self._leads, self._layer = levels.span, levels.ahead, 0
        self._buffer = np.zeros((2 * self._span + 1, len(start)))
        self._buffer[0], self._front = start, 0
        kinds = 0 if self._leads is None else self._leads.shape[1]
        self._by_kind = np.zeros((kinds, len(start)))

    @property
    def here(self) -> FloatArray:
        """The mass of the layer, [nodes]."""
        here: FloatArray = self._buffer[self._front]
        return here

    @property
    def left(self) -> FloatArray:
        """The mass of the layer and of those after it, [layers, nodes]."""
        return self._buffer[self._front :]

    @property
    def onward(self) -> FloatArray:
        """Where the mass of its steps is added up, as their columns are, [layers * nodes]."""
        if self._leads is not None:
            return self._by_kind.reshape(-1)
        return self._buffer[self._front + 1 : self._front + 1 + self._span].reshape(-1)

    def step(self) -> None:
        """On to the next layer."""
        if self._leads is not None:
            for kind, lead in enumerate(self._leads[self._layer].tolist()):
                self._buffer[self._front + 1 + lead] += self._by_kind[kind]
            self._by_kind[:] = 0.0
        self._layer, self._front = self._layer + 1, self._front + 1
        if self._front + self._span >= len(self._buffer):
            left = self.left.copy()
            self._buffer[:] = 0.0
            self._buffer[: len(left)], self._front = left, 0
