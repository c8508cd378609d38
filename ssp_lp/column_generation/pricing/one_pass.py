"""Backward sweeps over all layers of a small process in one compiled pass.

Layer by layer each step through the interpreter costs more than a layer of some hundred nodes
does. Where the free steps within a layer can be put in order they belong to the pass as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, unsigned
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import pieces
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess

_MOST_CELLS = 8_000_000
"""Nodes times layers held at once, with four numbers each; larger layers are swept one by one."""

_MOST_ENTRIES = 30_000
"""Entries of a layer beyond which calling a loop for each is nothing beside what it does."""

_MOST_CHARGES = 4_000_000
"""Charges, pairs that arrive times layers, where they do not grow evenly."""

_NONE = np.zeros(0)


@dataclass(frozen=True, eq=False)
class OnePass:
    """What the compiled pass reads, whatever is minimised."""

    process: LayeredProcess
    order: IntArray  # [nodes] each after those that its free steps lead to
    kinds: IntArray  # [entries] of steps, numbered as they are used
    leads: IntArray  # [layers, kinds] where they lead; or [1, kinds] how many layers ahead
    charge: FloatArray  # [layers or 1, slots]
    slot: IntArray  # [pairs]
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
        from ssp_lp.compiled.backups import back_up_layers

        run: Callable[..., None] = back_up_layers
        base, measured = self.process.base, self._with_room(measures)
        known = self._with_room(values).ravel(), measured.reshape(-1, 3)
        for part in self._pieces():
            run(*self._parts, *part, owed, base.gain, base.failure, base.survival, *known, choice)
        return np.asarray(measured[0])

    def measure(self, measures: FloatArray, choice: IntArray) -> FloatArray:
        """Charge, failure and goal from the first layer under a choice, [nodes, 3].

        Args:
            measures: charge, failure and goal of the tails, [layers beyond, nodes, 3].
            choice: among each node's pairs, [cap, nodes].
        """
        from ssp_lp.compiled.backups import measure_layers

        run: Callable[..., None] = measure_layers
        base, measured = self.process.base, self._with_room(measures)
        ends = base.gain, base.failure, base.survival
        for part in self._pieces():
            run(*self._parts, *part, *ends, measured.reshape(-1, 3), choice)
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
        from ssp_lp.compiled.backups import back_up_layers_safely

        run: Callable[..., None] = back_up_layers_safely
        values = self._with_room(beyond)
        for part in self._pieces():
            run(*self._parts, *part, owed, saved, MACHINE_EPSILON, given, values.ravel())
        return np.asarray(values[: self.process.cap])

    def _pieces(self) -> Iterator[tuple[int, int]]:
        """First layer and end of each part of a sweep, the last part first."""
        cap = self.process.cap
        for some in pieces(cap, cap * len(self.kinds)):
            yield cap - some.stop, cap - some.start

    def _with_room(self, beyond: FloatArray) -> FloatArray:
        """An array for all layers that ends with those beyond the cap."""
        cap = self.process.cap
        whole = np.empty((cap + len(beyond), *beyond.shape[1:]))
        whole[cap:] = beyond
        return whole

    @property
    def _parts(self) -> tuple[Any, ...]:
        """What the compiled pass reads of the process."""
        base, levels = self.process.base, self.process.levels
        indptr, _, nodes, data = base.steps_by_kind
        steps = unsigned(base.pair_offsets), indptr, self.kinds, nodes, data, self.leads
        paid = levels.totals[: self.process.cap]
        return self.order, *steps, paid, self.charge, self.slot, self.growth


def one_pass(process: LayeredProcess) -> OnePass | None:
    """The pass over a process; None where it is too large for one, or its free steps go round."""
    base, cap = process.base, process.cap
    cells = base.n_nodes * len(process.levels.totals)
    if cells > _MOST_CELLS or base.later.nnz > _MOST_ENTRIES:
        return None
    if not accelerated(base.later.nnz * cap):
        return None
    arriving = process.charges.arriving
    if not process.grows_evenly and (len(arriving) + 1) * cap > _MOST_CHARGES:
        return None
    order = _order_of_pass(base)
    if order is None:
        return None
    used, kinds = np.unique(base.steps_by_kind[1], return_inverse=True)
    kinds = kinds.astype(np.uint8 if len(used) <= 256 else np.uint32)
    ahead, slot = process.levels.ahead, np.arange(len(base.gain), dtype=np.uint32)
    leads = used[None, :] if ahead is None else process.levels.leads(base.width)[:, used]
    if process.grows_evenly:
        first = process.charged(0)
        whole = first.fixed[None, :], slot, first.parts[1]
        return OnePass(process, order, kinds, leads.astype(np.int64), *whole)
    charge = np.zeros((cap, len(arriving) + 1))
    charge[:, :-1] = process.charges.of_arriving(slice(0, cap))
    slot[:] = len(arriving)
    slot[arriving] = np.arange(len(arriving))
    return OnePass(process, order, kinds, leads.astype(np.int64), charge, slot, _NONE)


def _order_of_pass(base: AccumulatedCost) -> IntArray | None:
    """Nodes, each after those that its free steps lead to; None where these go round."""
    n, instant = base.n_nodes, base.instant
    if instant.nnz == 0:
        return np.arange(n, dtype=np.uint32)
    from ssp_lp.compiled.graph_components import order_components

    owner = np.repeat(base.quotient.pair_node, np.diff(instant.indptr))
    if (instant.indices == owner).any():
        return None
    first = unsigned(instant.indptr)[base.pair_offsets]
    _, order, found = order_components(first[:-1], first[1:], instant.indices, instant.data)
    return unsigned(order) if found == n else None
