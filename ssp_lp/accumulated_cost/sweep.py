"""Sweeps over the layers of an accumulated-cost process: backward for values, forward for mass.

Backward, a sweep finds the best choice, what a choice is worth, or lower bounds of every policy's
values. Layer by layer each step through the interpreter costs more than a layer of some hundred
nodes does, and equations of free steps more than turns over the layer (Gauss-Seidel), where any
policy leaves it after a few steps: such processes are swept in one compiled pass. Where free steps
can be put in order one turn does.

Forward, one number of each node is sent on, and only from where the choice comes to; a sweep
backwards gathers three numbers for every node of every layer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import fsum
from typing import Any

import numpy as np

from ssp_lp.accumulated_cost.process import AccumulatedCost, LayeredProcess
from ssp_lp.accumulated_cost.totals import Totals
from ssp_lp.arrays import MACHINE_EPSILON, TIED, FloatArray, IntArray, least_integer_type, unsigned
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time, pieces
from ssp_lp.dynamic_programming.bellman import (
    PairCost,
    backup_rounding,
    best_pairs,
    chosen_product,
    row_parts,
)
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy

_ONE = np.ones(1)


def is_acyclic(base: AccumulatedCost) -> bool:
    """Whether every step between states costs something, so that layers need no solving."""
    return base.instant.nnz == 0


def room_for_choice(process: LayeredProcess) -> IntArray:
    """Room for positions among the pairs of each node, in the smallest integers, [cap, nodes]."""
    base = process.base
    most = int(np.diff(base.pair_offsets).max(initial=1))
    return np.empty((process.cap, base.n_nodes), dtype=least_integer_type(most))


def best_of_layer(
    base: AccumulatedCost, cost: PairCost, ahead: FloatArray, inner: IntArray
) -> tuple[IntArray, FloatArray]:
    """The pairs of least value in a layer and their values, [nodes] each.

    Args:
        base: one layer of the process.
        cost: of the pairs, priced.
        ahead: values of what steps lead to, [layers * nodes].
        inner: pairs to begin with where the layer has free steps, [nodes].
    """
    if is_acyclic(base):
        backup = best_pairs(base.pair_offsets, base.later, cost, ahead, tied=TIED)
        return backup.choice, backup.minima
    onward = (cost.total + base.later @ ahead)[:, None]
    settled = iterate_policy(base.instant_dynamics, onward, _ONE, inner)
    return settled.choice, settled.values


def measures_of_layer(
    base: AccumulatedCost, chosen: IntArray, charge: PairCost, ahead: FloatArray
) -> FloatArray:
    """(charge, failure, goal) of a layer's choice, [nodes, 3].

    Args:
        base: one layer of the process.
        chosen: a pair of each node, [nodes].
        charge: of arriving by the pairs.
        ahead: measures of what steps lead to, [layers * nodes, 3].
    """
    totals = np.empty((base.n_nodes, 3))
    totals[:, 0] = charge.fixed[chosen]
    if charge.slope is not None:
        totals[:, 0] += charge.factor * charge.slope[chosen]
    totals[:, 1] = base.failure[chosen]
    totals[:, 2] = base.survival * base.gain[chosen]
    totals += chosen_product(base.later, chosen, ahead)
    if not is_acyclic(base):
        totals = base.instant_dynamics.chain(chosen).solve(totals)
    return totals


def measures_backwards(process: LayeredProcess, choice: IntArray, beyond: FloatArray) -> FloatArray:
    """(charge, failure, goal) of a choice over all layers, from the first one, [nodes, 3].

    Args:
        process: the process.
        choice: position among the pairs of each node, [cap, nodes].
        beyond: the measures beyond the cap, [layers beyond, nodes, 3].
    """
    base = process.base
    measured, totals = process.window(beyond), np.zeros((base.n_nodes, 3))
    for layer in reversed(range(process.cap)):
        check_time()
        chosen = base.pair_offsets[:-1] + choice[layer]
        totals = measures_of_layer(base, chosen, process.charged(layer), measured.flat)
        measured.push(totals)
    return totals


Summands = tuple[PairCost, FloatArray, FloatArray]
"""The parts of each pair's backup, for counting rounding: cost, magnitude and what is counted once
(see ``safe_minima``), [pairs] each."""


def bound_free_steps(
    base: AccumulatedCost,
    sums: Summands,
    ahead: FloatArray,
    given: FloatArray,
    inner: IntArray,
    floor: float,
) -> tuple[FloatArray, IntArray]:
    """Lower bounds of a layer with steps inside it, [nodes], and its best choice.

    Args:
        base: one layer of the process.
        sums: what its pairs cost.
        ahead: bounds of what they lead to in later layers, [layers * nodes].
        given: values that are not to be exceeded, [nodes].
        inner: a choice to begin with, [nodes].
        floor: no value is less.
    """
    cost, magnitude, alone = sums
    growth = 0.0 if cost.slope is None else cost.factor * cost.slope
    size = (magnitude + growth) + base.later @ np.abs(ahead)
    onward = (cost.fixed + growth) + base.later @ ahead
    onward = np.where(size == alone, onward, onward - backup_rounding(base.later) * size)
    settled = iterate_policy(base.instant_dynamics, onward[:, None], _ONE, inner)
    given = np.minimum(settled.values, given)
    return sub_solution(base.instant_dynamics, onward, given, floor), settled.choice


def priced_layers(process: LayeredProcess, owed: FloatArray) -> Callable[[int], PairCost]:
    """What each pair costs at a layer: the charge of arriving and what is owed, [pairs].

    Args:
        process: the process.
        owed: the same in all layers, [pairs].
    """
    if not process.grows_evenly:
        return lambda layer: PairCost(process.charged(layer).fixed + owed)
    even, totals = process.charged(0), process.totals.values
    paid = PairCost(even.fixed + owed, even.slope)
    return lambda layer: replace(paid, factor=float(totals[layer]))


def summed_layers(
    process: LayeredProcess, owed: FloatArray, saved: FloatArray
) -> Callable[[int], Summands]:
    """The parts of ``charge + owed - saved`` at a layer.

    Args:
        process: the process.
        owed: non-negative, [pairs].
        saved: non-negative, [pairs].
    """
    if process.grows_evenly:
        even, totals = process.charged(0), process.totals.values
        paid = even.fixed + owed
        cost, whole = PairCost(paid - saved, even.slope), paid + saved
        return lambda layer: (replace(cost, factor=float(totals[layer])), whole, owed)

    def summed(layer: int) -> Summands:
        """What the pairs of a layer sum up, each layer's charges by themselves."""
        fixed = process.charged(layer).fixed
        return PairCost(fixed + owed - saved), np.abs(fixed) + owed + saved, owed

    return summed


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
        from ssp_lp.compiled.layers import back_up_layers

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
        from ssp_lp.compiled.layers import back_up_layers_safely

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
        base, cap, totals = process.base, process.cap, process.totals
        indptr, _, nodes, data = base.steps_by_class
        steps = unsigned(base.pair_offsets), indptr, self.kinds, nodes, data
        steps_within = 1.0 if self.within is None else float(self.within.max())
        turns = 1 if self.within is None else int(np.ceil(_TURNS_A_STEP * steps_within))
        for turn in pieces(cap, int(cap * len(self.kinds) * steps_within)):
            some = slice(cap - turn.stop, cap - turn.start)
            many = some.stop - some.start
            leads = self.leads if len(self.leads) == 1 else self.leads[some] - some.start
            charge = self.charge if len(self.charge) == 1 else self.charge[some]
            paid = totals.values[some], charge, self.slot, self.growth, 0, many
            if not whole:  # one after the other in the same memory; blocks differ by one layer
                size = many + 1 + max(totals.span, len(beyond[0]))
                whole = [np.zeros((size, *a.shape[1:])) for a in beyond]
            rooms = [room[: many + len(a)] for room, a in zip(whole, ahead, strict=True)]
            for room, known in zip(rooms, ahead, strict=True):
                room[many:] = known
            yield some, (self.order, turns, *steps, leads, *paid), rooms
            ahead = [room[: totals.span] for room in rooms]


def one_pass(process: LayeredProcess) -> OnePass | None:
    """The pass over a process; None where its layers are long, or free steps go round for long."""
    base, cap = process.base, process.cap
    cells = base.n_nodes * process.totals.span
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
    used, kinds = np.unique(base.steps_by_class[1], return_inverse=True)
    kinds = kinds.astype(np.uint8 if len(used) <= 256 else np.uint32)
    ahead, slot = process.totals.ahead, np.arange(len(base.gain), dtype=np.uint32)
    leads = used[None, :] if ahead is None else process.totals.reached[:, used]
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
    mass, sums = LayerMass(process.base.start, process.totals), list[list[float]]()
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
    mass, free = LayerMass(process.base.start, process.totals), PairCost(process.base.gain_cost)
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
    mass = LayerMass(base.start, base.totals(0))
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
    from ssp_lp.compiled.layers import follow_layer

    found = np.zeros((3, 2))  # sums, and what was rounded off them
    follow_layer(
        mass.here, choice, unsigned(base.pair_offsets), *row_parts(base.later), *charge.parts,
        base.gain, base.failure, base.survival, mass.onward, found,
    )  # fmt: skip
    mass.step()
    return np.asarray(found.sum(axis=1))


class LayerMass:
    """The mass of a layer and of those that its steps lead to, layer after layer."""

    def __init__(self, start: FloatArray, totals: Totals) -> None:
        """Begin in the first layer.

        Args:
            start: its mass, [nodes].
            totals: which step leads where.
        """
        self._span, self._leads, self._layer = totals.span, totals.ahead, 0
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
