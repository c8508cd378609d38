"""Backward sweeps over all layers of a process in one compiled pass.

Layer by layer each step through the interpreter costs more than a layer of some hundred nodes
does, and equations of free steps more than turns over the layer (Gauss-Seidel), where any policy
leaves it after a few steps. Where free steps can be put in order one turn does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, TIED, FloatArray, IntArray, unsigned
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import pieces
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess

_MOST_CELLS = 8_000_000
"""Nodes times layers that steps lead to, four numbers each; more of them are swept one by one."""

_MOST_ENTRIES = 30_000
"""Entries of a layer without free steps from which calling a loop for each is next to nothing."""

_MOST_WITHIN = 20.0
"""Steps within a layer, of any policy: with more of them its equations are solved instead."""

_TURNS_A_STEP = 40.0  # that a policy takes within a layer: e^-40 of what was missing is left

_ACCURATE = 1e-14
"""Relative change of values and measures at which turns over a layer end: next to rounding."""

_MOST_CHARGES = 20_000_000
"""Charges, pairs that arrive times layers, where they do not grow evenly."""

_NONE = np.zeros(0)


@dataclass(frozen=True, eq=False)
class OnePass:
    """What the compiled pass reads, whatever is minimised."""

    process: LayeredProcess
    order: IntArray  # [nodes] each after those that its free steps lead to, as far as may be
    within: FloatArray | None  # [nodes] see ``steps_within``; None: free steps do not go round
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
        return self._measured(owed, values, measures, choice, keeps=False)

    def measure(self, measures: FloatArray, choice: IntArray) -> FloatArray:
        """Charge, failure and goal from the first layer under a choice, [nodes, 3].

        Args:
            measures: charge, failure and goal of the tails, [layers beyond, nodes, 3].
            choice: among each node's pairs, [cap, nodes].
        """
        return self._measured(_NONE, measures[:, :, 0], measures, choice, keeps=True)

    def _measured(
        self,
        owed: FloatArray,
        values: FloatArray,
        measures: FloatArray,
        choice: IntArray,
        *,
        keeps: bool,
    ) -> FloatArray:
        """Charge, failure and goal from the first layer, [nodes, 3], of a choice or the best."""
        from ssp_lp.compiled.backups import back_up_layers

        run: Callable[..., None] = back_up_layers
        base = self.process.base
        own = owed, base.gain, base.failure, base.survival, _ACCURATE, TIED
        for some, parts, (known, measured) in self._blocks(values, measures):
            run(*parts, *own, known.ravel(), measured.reshape(-1, 3), choice[some], keeps)
        return np.asarray(measured[0])

    def lowest(
        self,
        owed: FloatArray,
        saved: FloatArray,
        given: FloatArray,
        floor: float,
        beyond: FloatArray,
    ) -> Iterator[tuple[slice, FloatArray]]:
        """Checked lower bounds, rounding counted, block after block from the last layers on.

        Args:
            owed: non-negative, [pairs].
            saved: non-negative, [pairs].
            given: values that are not to be exceeded, [cap, nodes].
            floor: no value is less.
            beyond: lower bounds beyond the cap, [layers beyond, nodes].

        Yields:
            Layers, and the bounds there, [layers of the block, nodes].
        """
        from ssp_lp.compiled.backups import back_up_layers_safely

        run: Callable[..., None] = back_up_layers_safely
        within = _NONE if self.within is None else self.within
        for some, parts, (values,) in self._blocks(beyond):
            most = np.maximum(np.nan_to_num(given[some], nan=floor, posinf=np.inf), floor)
            counted = MACHINE_EPSILON, _ACCURATE, within, most
            run(*parts, owed, saved, *counted, values.ravel())
            yield some, values[: some.stop - some.start]

    def _blocks(
        self, *beyond: FloatArray
    ) -> Iterator[tuple[slice, tuple[Any, ...], list[FloatArray]]]:
        """Blocks of layers, the last ones first.

        Args:
            beyond: numbers that are known beyond the cap, [layers beyond, nodes, ...] each.

        Yields:
            The layers, what the compiled pass reads of them, and arrays with room for their numbers
            in front of those of the layers that they lead to.
        """
        process, ahead, whole = self.process, list(beyond), list[FloatArray]()
        base, cap, levels = process.base, process.cap, process.levels
        indptr, _, nodes, data = base.steps_by_kind
        steps = unsigned(base.pair_offsets), indptr, self.kinds, nodes, data
        steps_within = 1.0 if self.within is None else float(self.within.max())
        turns = 1 if self.within is None else int(np.ceil(_TURNS_A_STEP * steps_within))
        for turn in pieces(cap, int(cap * len(self.kinds) * steps_within)):
            some = slice(cap - turn.stop, cap - turn.start)
            many = some.stop - some.start
            leads = self.leads if len(self.leads) == 1 else self.leads[some] - some.start
            charge = self.charge if len(self.charge) == 1 else self.charge[some]
            paid = levels.totals[some], charge, self.slot, self.growth, 0, many
            if not whole:  # one after the other in the same memory; blocks differ by one layer
                size = many + 1 + max(levels.span, len(beyond[0]))
                whole = [np.zeros((size, *a.shape[1:])) for a in beyond]
            rooms = [room[: many + len(a)] for room, a in zip(whole, ahead, strict=True)]
            for room, known in zip(rooms, ahead, strict=True):
                room[many:] = known
            yield some, (self.order, turns, *steps, leads, *paid), rooms
            ahead = [room[: levels.span] for room in rooms]


def one_pass(process: LayeredProcess) -> OnePass | None:
    """The pass over a process; None where its layers are long, or free steps go round for long."""
    base, cap = process.base, process.cap
    cells = base.n_nodes * process.levels.span
    if cells > _MOST_CELLS or (base.instant.nnz == 0 and base.later.nnz > _MOST_ENTRIES):
        return None
    if base.n_nodes == 0 or not accelerated(base.later.nnz * cap):
        return None
    arriving = process.charges.arriving
    if not process.grows_evenly and (len(arriving) + 1) * cap > _MOST_CHARGES:
        return None
    order, goes_round = _order_of_pass(base)
    within = base.steps_within if goes_round else None
    if goes_round and (within is None or within.max() > _MOST_WITHIN):
        return None
    used, kinds = np.unique(base.steps_by_kind[1], return_inverse=True)
    kinds = kinds.astype(np.uint8 if len(used) <= 256 else np.uint32)
    ahead, slot = process.levels.ahead, np.arange(len(base.gain), dtype=np.uint32)
    leads = used[None, :] if ahead is None else process.levels.leads(base.width)[:, used]
    whole = process, order, within, kinds, leads.astype(np.int64)
    if process.grows_evenly:
        first = process.charged(0)
        return OnePass(*whole, first.fixed[None, :], slot, first.parts[1])
    charge = np.zeros((cap, len(arriving) + 1))
    charge[:, :-1] = process.charges.of_arriving(slice(0, cap))
    slot[:] = len(arriving)
    slot[arriving] = np.arange(len(arriving))
    return OnePass(*whole, charge, slot, _NONE)


def _order_of_pass(base: AccumulatedCost) -> tuple[IntArray, bool]:
    """Nodes, most of them after those that free steps lead to, and whether these go round."""
    n, instant = base.n_nodes, base.instant
    if instant.nnz == 0:
        return np.arange(n, dtype=np.uint32), False
    from ssp_lp.compiled.graphs import order_components

    owner = np.repeat(base.quotient.pair_node, np.diff(instant.indptr))
    first = unsigned(instant.indptr)[base.pair_offsets]
    _, order, found = order_components(first[:-1], first[1:], instant.indices, instant.data)
    return unsigned(order), bool(found < n or (instant.indices == owner).any())
