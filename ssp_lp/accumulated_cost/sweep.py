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

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import fsum
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, cast

import numpy as np

from ssp_lp.accumulated_cost.process import AccumulatedCost, LayeredProcess
from ssp_lp.accumulated_cost.totals import Totals, Window
from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, least_integer_type, unsigned
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import STOPS, Stop, backward, check_time, end_with_incumbent, pieces
from ssp_lp.dynamic_programming.bellman import (
    PairCost,
    SparseRows,
    backup_rounding,
    best_pairs,
    chosen_product,
    row_parts,
    safe_minima,
)
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import approach_leaving
from ssp_lp.dynamic_programming.equations import COMPONENTS
from ssp_lp.dynamic_programming.evaluation import evaluate_chain
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy

if TYPE_CHECKING:
    from ssp_lp.compiled.layers import Layers

_ONE, _NONE = np.ones(1), np.zeros(0)

_BELOW_EVERY_VALUE = 1e-6
"""No value is below minus the price; a floor this much lower leaves room to count rounding."""

KEPT_VALUES = 25_000_000
"""Largest table of checked values that is kept, nodes x layers: 0.2 GB. Of a larger one only the
shape is: infinite values ask for the best that can be proved, which one more sweep gives."""

_SAME = 1e-14
"""Relative difference of values below which there is only rounding."""


_MOST_CELLS = 8_000_000
"""Nodes times layers that steps lead to, four numbers each; more of them are swept one by one."""

_MOST_ENTRIES = 30_000
"""Entries of a layer without free steps from which calling a loop for each is next to nothing."""

_MOST_WITHIN = 20.0
"""Steps within a layer, of any policy: with more of them its equations are solved instead."""

_TURNS_A_STEP = 40.0  # that a policy takes within a layer: e^-40 of what was missing is left

_MOST_CHARGES = 20_000_000
"""Charges, pairs that arrive times layers, where they do not grow evenly."""


CompiledPass: TypeAlias = "tuple[Layers, FloatArray]"
"""Its layers, all of them, and at least one more than after the free steps of any pair, [nodes];
empty where free steps do not go round."""


class PartOfSweep(NamedTuple):
    """Part of a sweep for the best choice that was done when it was stopped."""

    choice: IntArray  # [cap, nodes] of which the layers from ``layer`` on are written
    price: float  # of failure
    layer: int
    measures: FloatArray | None  # [nodes, 3] from that layer on; None: a choice can be followed


@dataclass(frozen=True, eq=False)
class Sweep:
    """The sweeps over one process, and what they share.

    At a price of failure a run is worth its charge, ``failing`` where it fails and ``failing -
    price`` where it arrives: with ``failing`` equal to the price this is ``charge + price *
    failure``; with 0 it is ``charge - price * goal``, where no digit is lost if failing is likely.
    A choice is the position of a pair among those of its node, [cap, nodes].
    """

    process: LayeredProcess

    def room_for_choice(self) -> IntArray:
        """An array for the choice of a sweep over layers, in the smallest integers that hold it."""
        base = self.process.base
        most = int(np.diff(base.pair_offsets).max(initial=1))
        return np.empty((self.process.cap, base.n_nodes), dtype=least_integer_type(most))

    @with_twin
    def minimise(self, price: float, failing: float, choice: IntArray) -> FloatArray:
        """Best choice of a backward sweep at a price, written; its charge, failure and goal, [3].

        Raises:
            Stop: with the part of the sweep that was done.
        """
        process, base = self.process, self.process.base
        values, measures = process.beyond_value(price, failing), process.measures_beyond(price)
        if (one_pass := self.one_pass) is not None:
            owed, saved = self._owed(price, failing)
            blocks = self._blocks(one_pass, owed, saved, values, measures, choice)
            return np.asarray(base.start @ deque(blocks, maxlen=1)[0][2][0])
        cost, inner = self._pair_costs(price, failing), self._first_choice

        def best(
            layer: int, ahead: FloatArray, measured: FloatArray | None = None
        ) -> tuple[FloatArray, ...]:
            """The values of the best choice, which is written, and its measures if asked for."""
            nonlocal inner
            if self.is_acyclic:
                pair_cost = cost(layer)[0]
                backup = best_pairs(base.pair_offsets, base.later, pair_cost, ahead)
                inner, least = backup.choice, backup.minima
            else:
                onward = (cost(layer)[0].total + base.later @ ahead)[:, None]
                settled = iterate_policy(base.instant_dynamics, onward, _ONE, inner)
                inner, least = settled.choice, settled.values
            choice[layer] = inner - base.pair_offsets[:-1]
            return (least,) if measured is None else (least, self._measures(layer, inner, measured))

        part = PartOfSweep(choice, price, process.cap, None)
        try:
            beyond = (values,) if self.can_follow else (values, measures)
            for layer, numbers in self._backward(best, *beyond):
                part = part._replace(layer=layer, measures=(*numbers, None)[1])
            if part.measures is None:
                return self.follow(choice, price)
            return np.asarray(base.start @ part.measures)
        except STOPS as stop:
            end_with_incumbent(stop)
            raise Stop(part) from stop

    @with_twin
    def measure(self, choice: IntArray, tail_price: float) -> FloatArray:
        """Charge, failure and goal of a choice by a sweep over the layers, from the start on, [3].

        Args:
            choice: [cap, nodes].
            tail_price: the price of failure by which tails are chosen beyond the cap.
        """
        base, beyond = self.process.base, self.process.measures_beyond(tail_price)
        if (one_pass := self.one_pass) is not None:
            given = _NONE, _NONE, beyond[:, :, 0], beyond, choice
            blocks = self._blocks(one_pass, *given, keeps=True)
            return np.asarray(base.start @ deque(blocks, maxlen=1)[0][2][0])
        if self.can_follow:
            return self.follow(choice, tail_price)

        def measured(layer: int, ahead: FloatArray) -> tuple[FloatArray]:
            """The measures of a layer's choice."""
            return (self._measures(layer, base.pair_offsets[:-1] + choice[layer], ahead),)

        swept = self._backward(measured, beyond)
        return np.asarray(base.start @ deque(swept, maxlen=1)[0][1][0])

    def bound(
        self,
        price: float,
        failing: float,
        given: FloatArray,
        beyond: FloatArray,
        choice: IntArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Lower bounds of all policies' values at a price, by a backward sweep; rounding counts.

        Args:
            price: of failure.
            failing: what failing counts.
            given: values that are not to be exceeded, [cap, nodes]; infinite: none.
            beyond: lower bounds beyond the cap, [layers beyond, nodes].
            choice: written by compiled loops where there are no free steps: whose values these
                are, [cap, nodes].

        Returns:
            The bound if an episode began in each layer, [cap]; and the values, [cap, nodes],
            infinite where they are too many to be kept.
        """
        process, base, inner = self.process, self.process.base, self._first_choice
        floor = -(price - failing - process.charge.lowest) * (1.0 + _BELOW_EVERY_VALUE)

        def lower(layer: int, ahead: FloatArray) -> tuple[FloatArray]:
            """Lower bounds of a layer; within one with free steps its best choice is kept."""
            nonlocal inner
            most, is_free = given[layer], bool(np.isposinf(given[layer]).all())
            if not is_free:
                most = _at_least(most, floor)
            pair_cost, size, alone = cost(layer)
            if self.is_acyclic:
                position = None if choice is None else choice[layer]
                sums = pair_cost, size, alone, ahead, position
                lowest = safe_minima(base.pair_offsets, base.later, *sums)
                return (lowest if is_free else np.minimum(lowest, most),)
            growth = 0.0 if pair_cost.slope is None else pair_cost.factor * pair_cost.slope
            size = (size + growth) + base.later @ np.abs(ahead)
            onward = (pair_cost.fixed + growth) + base.later @ ahead
            onward = np.where(size == alone, onward, onward - backup_rounding(base.later) * size)
            settled = iterate_policy(base.instant_dynamics, onward[:, None], _ONE, inner)
            inner, most = settled.choice, np.minimum(settled.values, most)
            return (sub_solution(base.instant_dynamics, onward, most, floor),)

        blocks: Iterable[tuple[slice, FloatArray]]
        if (one_pass := self.one_pass) is None:
            cost = self._pair_costs(price, failing, sizes=True)
            layers = self._backward(lower, beyond)
            blocks = ((slice(layer, layer + 1), lowest[None]) for layer, (lowest,) in layers)
        else:
            owed = self._owed(price, failing)
            swept = self._blocks(one_pass, *owed, beyond, limits=(given, floor))
            blocks = ((some, lowest) for some, lowest, _ in swept)
        is_kept = given.size <= KEPT_VALUES
        kept = np.empty(given.shape) if is_kept else np.broadcast_to(np.inf, given.shape)
        begun, sizes = np.zeros((2, process.cap))
        entries = np.flatnonzero(base.start)
        shares = base.start[entries]
        for some, lowest in blocks:
            begun[some] = lowest[:, entries] @ shares
            sizes[some] = np.abs(lowest[:, entries]) @ shares
            if is_kept:
                kept[some] = lowest
        ended = [failing * base.start_failure, -(price - failing) * base.start_goal]
        ended.append(process.start_charge)
        terms = max(len(entries) + int(np.count_nonzero(ended)) - 1, 0)
        loss = terms * MACHINE_EPSILON * (sizes + float(np.abs(ended).sum()))
        return begun + sum(ended) - loss, kept

    def lost_beyond(self, price: float, failing: float) -> FloatArray:
        """Worth of the tails above the sweep's lower bound beyond the cap, [layers, nodes]."""
        tails = self.process.beyond_value(price, failing)
        bound = self.process.beyond_bound(price, failing)
        same = tails - bound <= _SAME * (np.abs(tails) + np.abs(bound))
        return np.where(same, 0.0, tails - bound)

    def follow(self, choice: IntArray, tail_price: float) -> FloatArray:
        """Charge, failure and goal of a choice by a forward sweep of its mass, [3]."""
        process, mass = self.process, self._begun_mass
        sums = [mass.follow(choice[k], process.charged(k)).tolist() for k in range(process.cap)]
        beyond = process.beyond(tail_price)
        sums.append([float((mass.left[: len(each)] * each).sum()) for each in beyond])
        return np.array([fsum(each) for each in zip(*sums, strict=True)])

    @property
    def _begun_mass(self) -> LayerMass:
        """The mass of the sweep's first layer, to be followed forwards."""
        return LayerMass(LayerRows.of(self.process.base), self.process.totals)

    def mass_beyond(self, choice: IntArray) -> FloatArray:
        """Mass of a choice that gets beyond the cap, by a forward sweep, [layers beyond, nodes]."""
        base, mass = self.process.base, self._begun_mass
        for chosen in choice:
            mass.follow(chosen, PairCost(base.gain_cost))
        return mass.left

    def _blocks(
        self,
        compiled: CompiledPass,
        owed: FloatArray,
        saved: FloatArray,
        values: FloatArray,
        measures: FloatArray | None = None,
        choice: IntArray | None = None,
        *,
        keeps: bool = False,
        limits: tuple[FloatArray, float] | None = None,
    ) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Sweep block after block of layers in the compiled pass, the last first.

        Args:
            compiled: the pass.
            owed: what pairs cost beside the charge, non-negative, [pairs].
            saved: what they earn, non-negative, [pairs].
            values: beyond the cap, [layers beyond, nodes].
            measures: charge, failure and goal there, [layers beyond, nodes, 3]; None: not asked.
            choice: written, or given where ``keeps``, [cap, nodes].
            keeps: whether the choice is given; then values do not matter.
            limits: values not to be exceeded, [cap, nodes], and one that no value lies below:
                lower bounds are asked for, rounding counted; None: the least values.

        Yields:
            The layers of the block, their values, [layers, nodes], and measures, [layers, nodes,
            3]. The memory is the next block's as well.
        """
        from ssp_lp.compiled.layers import sweep_layers

        (whole, within), run = compiled, cast(Callable[..., None], sweep_layers)
        cap, span = self.process.cap, self.process.totals.span
        ahead = [values, np.zeros((len(values), 0, 3)) if measures is None else measures]
        position = np.zeros((0, 0), dtype=np.int8) if choice is None else choice
        rooms = list[FloatArray]()
        for turn in pieces(cap, int(cap * len(whole.classes) * within.max(initial=1.0))):
            some = slice(cap - turn.stop, cap - turn.start)
            many = some.stop - some.start
            layers = whole._replace(
                leads=whole.leads if len(whole.leads) == 1 else whole.leads[some] - some.start,
                paid=whole.paid[some],
                charge=whole.charge if len(whole.charge) == 1 else whole.charge[some],
            )
            if not rooms:  # one after the other in the same memory; blocks differ by one layer
                size = many + 1 + max(span, len(values))
                make = np.empty if whole.turns == 1 else np.zeros
                rooms = [make((size, *a.shape[1:])) for a in ahead]
            parts = [room[: many + len(a)] for room, a in zip(rooms, ahead, strict=True)]
            for part, later in zip(parts, ahead, strict=True):
                part[many:] = later
            given = np.zeros((0, 0))
            if limits is not None:
                given = _at_least(limits[0][some], limits[1])
            own = parts[0].ravel(), parts[1].reshape(-1, 3), position[some], keeps
            run(layers, owed, saved, *own, within, given)
            yield some, parts[0][:many], parts[1][:many]
            ahead = [part[:span] for part in parts]

    def _owed(self, price: float, failing: float) -> tuple[FloatArray, FloatArray]:
        """Costs of pairs beside the charge in a sweep, and savings, non-negative, [pairs] each."""
        base = self.process.base
        return failing * base.failure, (price - failing) * base.survival * base.gain

    def _pair_costs(
        self, price: float, failing: float, *, sizes: bool = False
    ) -> Callable[[int], tuple[PairCost, FloatArray, FloatArray]]:
        """Pair costs of a sweep by layer, ``charge + owed - saved``, with sizes if asked for."""
        process, (owed, saved) = self.process, self._owed(price, failing)
        if process.grows_evenly:
            even, totals = process.charged(0), process.totals.values
            cost, size = PairCost(even.fixed + owed - saved, even.slope), even.fixed + owed + saved
            return lambda layer: (replace(cost, factor=float(totals[layer])), size, owed)

        def summed(layer: int) -> tuple[PairCost, FloatArray, FloatArray]:
            """What the pairs of a layer sum up, each layer's charges by themselves."""
            fixed = process.charged(layer).fixed
            size = np.abs(fixed) + owed + saved if sizes else owed
            return PairCost(fixed + owed - saved), size, owed

        return summed

    def _backward(
        self, step: Callable[..., tuple[FloatArray, ...]], *beyond: FloatArray
    ) -> Iterator[tuple[int, tuple[FloatArray, ...]]]:
        """Sweep backward layer by layer, each from the values of the layers that it leads to.

        Args:
            step: of a layer and the numbers of what its steps lead to, [layers * nodes, ...] each.
            beyond: those beyond the cap, [layers beyond, nodes, ...] each.

        Yields:
            The layer, and its numbers, [nodes, ...] each.
        """
        windows = [Window(numbers, self.process.totals) for numbers in beyond]
        for layer in backward(self.process.cap):
            swept = step(layer, *(window.flat for window in windows))
            for window, numbers in zip(windows, swept, strict=True):
                window.push(numbers)
            yield layer, swept

    def _measures(self, layer: int, chosen: IntArray, ahead: FloatArray) -> FloatArray:
        """(charge, failure, goal) of a layer's choice in the sweep, [nodes, 3].

        Args:
            layer: the layer.
            chosen: a pair of each node, [nodes].
            ahead: measures of what steps lead to, [layers * nodes, 3].
        """
        base, charge = self.process.base, self.process.charged(layer)
        measures = np.empty((base.n_nodes, 3))
        measures[:, 0] = charge.fixed[chosen]
        if charge.slope is not None:
            measures[:, 0] += charge.factor * charge.slope[chosen]
        measures[:, 1] = base.failure[chosen]
        measures[:, 2] = base.survival * base.gain[chosen]
        measures += chosen_product(base.later, chosen, ahead)
        if not self.is_acyclic:
            chain = base.instant_dynamics.chain(chosen)
            solved = chain.solve(measures)
            missing = np.abs(solved[:, 1:].sum(axis=1) - 1.0)  # whatever fails not reaches the goal
            if missing.max(initial=0.0) <= _ALL_ENDS:
                return solved
            measures = evaluate_chain(chain, measures).values
        return measures

    @cached_property
    def is_acyclic(self) -> bool:
        """Whether every step between states costs something, so that a sweep solves no layer."""
        return self.process.base.instant.nnz == 0

    @property
    def can_follow(self) -> bool:
        """Whether a choice can be swept forwards, in compiled loops."""
        return self.is_acyclic and accelerated(self.process.base.later.nnz, "layers.follow_layer")

    @property
    def one_pass(self) -> CompiledPass | None:
        """The layers as the compiled backward sweep reads them; None: it does not run compiled."""
        process, base = self.process, self.process.base
        cells = base.n_nodes * process.totals.span
        if cells > _MOST_CELLS or (base.instant.nnz == 0 and base.later.nnz > _MOST_ENTRIES):
            return None
        loops = ("layers.sweep_layers", *(COMPONENTS if base.instant.nnz else ()))
        if base.n_nodes == 0 or not accelerated(base.later.nnz * process.cap, *loops):
            return None
        return self._compiled_pass

    @cached_property
    def _compiled_pass(self) -> CompiledPass | None:
        """The layers as the compiled backward sweep reads them, whatever is asked for.

        None where layers are long, or free steps go round for long.
        """
        process, base, cap = self.process, self.process.base, self.process.cap
        arriving = process.arriving
        if not process.grows_evenly and (len(arriving) + 1) * cap > _MOST_CHARGES:
            return None
        from ssp_lp.compiled.layers import Layers

        order: IntArray = np.arange(base.n_nodes, dtype=np.uint32)
        within, turns, instant = _NONE, 1, base.instant
        if instant.nnz:
            from ssp_lp.compiled.graphs import order_components

            owner = np.repeat(base.quotient.pair_node, np.diff(instant.indptr))
            begins = unsigned(instant.indptr)[base.pair_offsets]
            _, order, n_components = order_components(
                begins[:-1], begins[1:], instant.indices, instant.data
            )
            order = unsigned(order)
            if n_components < base.n_nodes or (instant.indices == owner).any():  # they go round
                if base.steps_within is None or base.steps_within.max() > _MOST_WITHIN:
                    return None
                within = base.steps_within
                turns = int(np.ceil(_TURNS_A_STEP * within.max()))
        indptr, classes, nodes, data = base.steps_by_class
        used, classes = np.unique(classes, return_inverse=True)
        classes = classes.astype(np.uint8 if len(used) <= 256 else np.uint32)
        ahead, column = process.totals.ahead, np.arange(len(base.gain), dtype=np.uint32)
        leads = used[None, :] if ahead is None else process.totals.reached[:, used]
        if process.grows_evenly:
            even = process.charged(0)
            charge, growth = even.fixed[None, :], even.parts[1]
        else:
            charge, growth = np.zeros((cap, len(arriving) + 1)), _NONE
            charge[:, :-1] = process.charged_arriving(slice(0, cap))
            column[:] = len(arriving)
            column[arriving] = np.arange(len(arriving))
        layers = Layers(
            order, turns, unsigned(base.pair_offsets), indptr, classes, nodes, data,
            leads.astype(np.int64), process.totals.values, charge, column, growth,
            base.failure, base.survival * base.gain,
        )  # fmt: skip
        return layers, within

    @cached_property
    def _first_choice(self) -> IntArray:
        """The sweep's first choice, by which each layer with free steps is left, [nodes]."""
        base = self.process.base
        if self.is_acyclic:
            return base.pair_offsets[:-1]
        leaving = (base.gain > 0) | (base.failure > 0) | (np.diff(base.later.indptr) > 0)
        return approach_leaving(base.instant_dynamics, leaving)


def _at_least(values: FloatArray, floor: float) -> FloatArray:
    """Values of a sweep raised to a floor, which also stands for what is no number."""
    return np.maximum(np.nan_to_num(values, nan=floor, posinf=np.inf), floor)


_ALL_ENDS = 1e-9
"""Mass by which failure and goal may miss 1 before runs within a layer are evaluated with care."""

_ON_ITS_WAY = 0.01
"""Share of what has arrived that may be on its way still, where a rule is followed for a guess."""

_LAYERS_BETWEEN = 8  # two looks at that

_DROPPED = 1e-9
"""Mass of a node that a guess leaves out, so that it follows what matters."""


def follow_rule(
    base: AccumulatedCost, rule: IntArray, most_layers: int
) -> tuple[float, float] | None:
    """(E[cost; goal], goal), about, of taking the same pair per node in all layers, swept forwards.

    Args:
        base: one layer of a process without free steps.
        rule: position among the pairs of each node, [nodes].
        most_layers: layers to follow it through.

    Returns:
        None where nothing is seen to arrive, or much is still on its way by then.
    """
    mass, sums = LayerMass(LayerRows.of(base), base.totals(0)), np.zeros(3)
    for layer in range(most_layers):
        mass.here[mass.here < _DROPPED] = 0.0
        sums += mass.follow(rule, PairCost(base.gain_cost, base.gain, layer * base.unit))
        if layer % _LAYERS_BETWEEN == 0 and mass.left.sum() <= _ON_ITS_WAY * sums[2]:
            return (float(sums[0]), float(sums[2])) if sums[2] > 0.0 else None
    return None


class LayerRows(NamedTuple):
    """One layer of a process without free steps, as far as mass is sent on from it."""

    later: SparseRows  # [pairs, layers ahead * nodes]
    pair_offsets: IntArray  # [nodes that have pairs + 1]
    gain: FloatArray  # [pairs]
    failure: FloatArray  # [pairs]
    survival: float
    start: FloatArray  # [nodes]

    @classmethod
    def of(cls, base: AccumulatedCost) -> LayerRows:
        """The layer of an accumulated-cost process."""
        return cls(*(getattr(base, name) for name in cls._fields))


class LayerMass:
    """The mass of a layer and of those that its steps lead to. Mutable: layer after layer."""

    def __init__(self, rows: LayerRows, totals: Totals) -> None:
        """Begin in the first layer of a process without free steps.

        Args:
            rows: of one layer of it.
            totals: of the layers, and which step leads where.
        """
        self._rows, self._span, self._leads = rows, totals.span, totals.ahead
        self._buffer = np.zeros((2 * self._span + 1, len(rows.start)))
        self._buffer[0], self._front, self._layer = rows.start, 0, 0
        classes = 0 if self._leads is None else self._leads.shape[1]
        self._by_class = np.zeros((classes, len(rows.start)))

    @property
    def here(self) -> FloatArray:
        """The mass of the layer, [nodes]; where a node has no pairs it must be 0."""
        here: FloatArray = self._buffer[self._front]
        return here

    @property
    def left(self) -> FloatArray:
        """The mass of the layer and of those after it, [layers, nodes]."""
        return self._buffer[self._front :]

    def follow(self, choice: IntArray, charge: PairCost) -> FloatArray:
        """Send the layer's mass on, and go on to the next layer.

        Args:
            choice: position among the pairs of each node, [nodes].
            charge: of arriving by the pairs.

        Returns:
            What it is charged, fails and arrives, [3].
        """
        from ssp_lp.compiled.layers import follow_layer

        check_time()
        rows, sums = self._rows, np.zeros((3, 2))  # and what was rounded off them
        first, leads = self._front + 1, self._leads
        onward = self._buffer[first : first + self._span] if leads is None else self._by_class
        follow_layer(
            self.here, choice, unsigned(rows.pair_offsets), *row_parts(rows.later), *charge.parts,
            rows.gain, rows.failure, rows.survival, onward.reshape(-1), sums,
        )  # fmt: skip
        if leads is not None:
            for mass, lead in zip(self._by_class, leads[self._layer].tolist(), strict=True):
                self._buffer[first + lead] += mass
            self._by_class[:] = 0.0
        self._layer, self._front = self._layer + 1, first
        if self._front + self._span >= len(self._buffer):
            left = self.left.copy()
            self._buffer[:] = 0.0
            self._buffer[: len(left)], self._front = left, 0
        return np.asarray(sums.sum(axis=1))
