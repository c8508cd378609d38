"""Backward sweeps over all layers of a small process in one compiled pass.

Layer by layer each step through the interpreter costs more than a layer of some hundred nodes
does. Where the free steps within a layer can be put in order they belong to the pass as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, unsigned
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess

_MOST_CELLS = 2_000_000
"""Nodes times layers held at once, with four numbers each; larger layers are swept one by one."""

_MOST_ENTRIES = 60_000
"""Entries of a layer beyond which calling a loop for each is nothing beside what it does."""

_MOST_CHARGES = 4_000_000
"""Charges, pairs times layers, where they do not grow evenly."""

_NONE = np.zeros(0)


@dataclass(frozen=True, eq=False)
class OnePass:
    """What the compiled pass reads, whatever is minimised."""

    process: LayeredProcess
    order: IntArray  # [nodes] each after those that its free steps lead to
    charge: FloatArray  # [layers or 1, pairs]
    growth: FloatArray  # [pairs] or empty

    def minimise(
        self, owed: FloatArray, values: FloatArray, measures: FloatArray, choice: IntArray
    ) -> FloatArray:
        """Charge, failure and goal from the first layer under the best choice, [nodes, 3].

        Args:
            owed: what pairs cost beside the charge, [pairs].
            values: of the tails beyond the cap, [layers beyond, nodes].
            measures: charge, failure and goal of the tails, [layers beyond, nodes, 3].
            choice: written, [cap, nodes].
        """
        from ssp_lp.compiled.layers import back_up_layers

        run: Callable[..., None] = back_up_layers
        base, measured = self.process.base, self._with_room(measures)
        run(
            *self._parts, owed, base.gain, base.failure, base.survival,
            self._with_room(values).ravel(), measured.reshape(-1, 3), choice,
        )  # fmt: skip
        return np.asarray(measured[0])

    def lowest(
        self, owed: FloatArray, saved: FloatArray, given: FloatArray, beyond: FloatArray
    ) -> FloatArray:
        """Checked lower bounds, rounding counted, [cap, nodes].

        Args:
            owed: non-negative, [pairs].
            saved: non-negative, [pairs].
            given: values that are not to be exceeded, [cap, nodes].
            beyond: lower bounds beyond the cap, [layers beyond, nodes].
        """
        from ssp_lp.compiled.layers import back_up_layers_safely

        run: Callable[..., None] = back_up_layers_safely
        values = self._with_room(beyond)
        run(*self._parts, owed, saved, MACHINE_EPSILON, given, values.ravel())
        return np.asarray(values[: self.process.cap])

    def _with_room(self, beyond: FloatArray) -> FloatArray:
        """An array for all layers that ends with those beyond the cap."""
        cap = self.process.cap
        whole = np.empty((cap + len(beyond), *beyond.shape[1:]))
        whole[cap:] = beyond
        return whole

    @property
    def _parts(self) -> tuple[Any, ...]:
        base, levels = self.process.base, self.process.levels
        steps, offsets = base.steps_by_kind, unsigned(base.pair_offsets)
        paid = levels.totals[: self.process.cap]
        leads = levels.leads(base.width)
        return self.order, offsets, *steps, leads, paid, self.charge, self.growth


def one_pass(process: LayeredProcess) -> OnePass | None:
    """The pass over a process; None where it is too large for one, or its free steps go round."""
    base, cap = process.base, process.cap
    cells = base.n_nodes * len(process.levels.totals)
    if cells > _MOST_CELLS or base.later.nnz > _MOST_ENTRIES:
        return None
    if not accelerated(base.later.nnz * cap):
        return None
    if not process.grows_evenly and len(base.gain) * cap > _MOST_CHARGES:
        return None
    order = _order(base)
    if order is None:
        return None
    first = process.charged(0)
    if process.grows_evenly:
        return OnePass(process, order, first.fixed[None, :], first.parts[1])
    charge = np.stack([process.charged(layer).fixed for layer in range(cap)])
    return OnePass(process, order, charge, _NONE)


def _order(base: AccumulatedCost) -> IntArray | None:
    """Nodes, each after those that its free steps lead to; None where these go round."""
    n, instant = base.n_nodes, base.instant
    order = np.arange(n, dtype=np.uint32)
    if instant.nnz == 0:
        return order
    from ssp_lp.compiled.graphs.order import order_components

    owner = np.repeat(base.quotient.pair_node, np.diff(instant.indptr))
    if (instant.indices == owner).any():
        return None
    first = unsigned(instant.indptr)[base.pair_offsets]
    label = np.empty(n, dtype=np.int32)
    found = order_components(
        first[:-1], first[1:], unsigned(instant.indices), instant.data, label, order
    )
    return order if found == n else None
