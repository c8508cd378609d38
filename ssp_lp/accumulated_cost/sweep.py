"""Sweeps over the layers of an accumulated-cost process: backward for values, forward for mass.

A choice takes one pair in each node of each layer. A backward sweep finds the optimal choice,
evaluates a choice, or computes lower bounds of the values of every policy. A process is swept in
one compiled pass in two cases:

- Its layers have only some hundred nodes: one call of numpy for each layer would take longer than
  the arithmetic.
- It has steps of cost 0 (free steps), and every policy leaves a layer after a few of them:
  Gauss-Seidel iterations over the layer are faster than solving equations. If the free steps have
  no cycles, one iteration is enough.

A forward sweep evaluates a choice at less work: it follows one number per node, the mass, and only
nodes that the choice reaches. A backward sweep computes all rewards at every node of every layer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import fsum
from typing import NamedTuple, TypeAlias, cast

import numpy as np

from ssp_lp.accumulated_cost.process import AccumulatedCost, ChargedLayers, LayeredProcess
from ssp_lp.accumulated_cost.totals import Totals
from ssp_lp.arrays import (
    MACHINE_EPSILON,
    FloatArray,
    IntArray,
    csr_of,
    expected,
    least_integer_type,
    unsigned,
    weighted,
    weighted_rounding,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import STOPS, Stop, backward, check_time, end_with_incumbent, pieces
from ssp_lp.dynamic_programming.bellman import (
    PairCost,
    backup_rounding,
    best_pairs,
    chosen_product,
    row_parts,
    safe_minima,
)
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.equations import COMPONENTS
from ssp_lp.dynamic_programming.evaluation import evaluate_chain
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.model.graph import nearer_pairs

_ONE, _NONE, _NO_LIMITS = np.ones(1), np.zeros(0), np.zeros((0, 0))

_BELOW_EVERY_VALUE = 1e-6
"""Relative margin for rounding by which the lower bound of all values is lowered."""

KEPT_VALUES = 4_000_000
"""Most checked values that are kept, nodes x layers: 32 MB. A larger table is replaced by infinite
values, with which the bound is computed again by one more sweep when it is checked."""


_MOST_CELLS = 8_000_000
"""Most nodes times layers ahead, four numbers each, of a compiled pass."""

_MOST_ENTRIES = 30_000
"""Entries of a layer without free steps from which the overhead of a call per layer is small."""

_FEW_CELLS = 1_000_000
"""Most entries of all layers without free steps for one pass by numpy."""

_LEAST_BLOCK = 16  # layers of a block for a pass by blocks

_MOST_WITHIN = 20.0
"""Most expected steps of a policy within a layer for Gauss-Seidel instead of equations."""

_TURNS_A_STEP = 40.0  # turns for each expected step within a layer: the error falls to e^-40

_MOST_CHARGES = 20_000_000
"""Most charges, arriving pairs times layers, if the charge is not the total cost."""


class _Layers(NamedTuple):
    """A block of layers, as input of a pass over them."""

    order: IntArray  # [nodes] each after the nodes its free steps lead to, as far as possible
    turns: int  # most sweeps over a layer; 1: free steps have no cycles
    offsets: IntArray  # [nodes + 1] pairs of each node
    indptr: IntArray  # [pairs + 1]
    classes: IntArray  # [entries] class of the step; 0: a free step within the layer
    nodes: IntArray  # [entries] successor
    data: FloatArray  # [entries]
    leads: IntArray  # [layers, classes] layer that a step leads to; or [1, classes] layers ahead
    paid: FloatArray  # [layers] total
    charge: FloatArray  # [layers or 1, columns] charge of arriving
    column: IntArray  # [pairs] column of the charge
    growth: FloatArray  # [pairs] increase of the charge per unit of the total, or empty
    counted: FloatArray  # [pairs, counted] quantities in addition to the charge


_OnePass: TypeAlias = tuple[_Layers, FloatArray, bool]
"""The layers; the bound of the steps within a layer, [nodes], empty if free steps are acyclic; and
whether the pass is compiled."""


class SweepCosts(NamedTuple):
    """Data of a minimisation: costs of pairs and of ends, and values beyond the cap."""

    owed: FloatArray  # [pairs] cost in addition to the charge, non-negative
    saved: FloatArray  # [pairs] earnings, non-negative
    beyond: FloatArray  # [layers beyond, nodes] values beyond the cap, or lower bounds
    measures: FloatArray = _NONE  # [layers beyond, nodes, 1 + counted] totals there
    charged: float = 1.0  # weight of the charge
    floor: float = 0.0  # lower bound of all values
    at_start: tuple[tuple[float, float], ...] = ()
    """Pairs of weight and amount for episodes that end before the first step."""
    price: float = 0.0  # price of failure, if failure alone is priced


class PartOfSweep(NamedTuple):
    """The finished part of a stopped sweep for the optimal choice."""

    choice: IntArray  # [cap, nodes] of which the layers from ``layer`` on are written
    price: float  # of failure
    layer: int
    measures: FloatArray | None  # [nodes, 1 + counted] from there on; None: follow the choice


@dataclass(frozen=True, eq=False)
class Sweep:
    """The sweeps over the layers of one process, with shared data.

    A choice gives the position of a pair among the pairs of its node, [cap, nodes]. Its measures
    are the expected charge and the expected totals of the rewards ``counted``. If there are free
    steps, ``counted`` must consist of failure and the goal.
    """

    process: ChargedLayers
    counted: FloatArray  # [pairs, counted] rewards in addition to the charge
    added: FloatArray | None = None  # [pairs] added to the charge in every layer

    @classmethod
    def of_ends(cls, process: ChargedLayers) -> Sweep:
        """Return the sweeps that count two rewards: failing and reaching the goal."""
        base = process.base
        return cls(process, np.stack([base.failure, base.survival * base.gain], axis=1))

    @cached_property
    def first_pairs(self) -> IntArray:
        """First pair of each node, [nodes]."""
        return self.process.base.pair_offsets[:-1]

    def charged(self, layer: int) -> PairCost:
        """Return the charges of the pairs of a layer, with the field ``added`` added, [pairs]."""
        charge = self.process.charged(layer)
        return charge if self.added is None else replace(charge, fixed=charge.fixed + self.added)

    def empty_choice(self, layers: int | None = None) -> IntArray:
        """Allocate an array for the choice in each layer, in the smallest integer type."""
        most = int(np.diff(self.process.base.pair_offsets).max(initial=1))
        size = self.process.cap if layers is None else layers, len(self.first_pairs)
        return np.empty(size, dtype=least_integer_type(most))

    @with_twin
    def minimise(
        self, costs: SweepCosts, choice: IntArray, interrupted: FloatArray | None = None
    ) -> FloatArray:
        """Find the optimal choice; return its measures from the start, [1 + counted].

        Args:
            costs: costs to minimise, and values beyond the cap.
            choice: written, [cap, nodes].
            interrupted: written: value and, if computed, measures of an episode that begins in each
                layer, [cap, 1 + 1 + counted].

        Raises:
            Stop: the time limit was reached; it carries the finished part of the sweep.
        """
        base, values, measures = self.process.base, costs.beyond, costs.measures
        entries = np.flatnonzero(base.start)
        shares = base.start[entries]
        if (one_pass := self.one_pass) is not None:
            for some, swept, last in self._blocks(one_pass, costs, values, measures, choice):
                measures = last
                if interrupted is not None:
                    interrupted[some, 0] = swept[:, entries] @ shares
                    interrupted[some, 1:] = shares @ measures[:, entries]
            return expected(base.start, measures[0])
        cost, inner = self._pair_costs(costs), self._first_choice

        def best(
            layer: int, ahead: FloatArray, measures: FloatArray | None = None
        ) -> tuple[FloatArray, ...]:
            """Write a layer's optimal choice; return its values, and its measures if needed."""
            nonlocal inner
            if self.is_acyclic:
                pair_cost = cost(layer)[0]
                backup = best_pairs(base.pair_offsets, base.later, pair_cost, ahead)
                inner, least = backup.choice, backup.minima
            else:
                onward = (cost(layer)[0].total + base.later @ ahead)[:, None]
                settled = iterate_policy(base.instant_dynamics, onward, _ONE, inner)
                inner, least = settled.choice, settled.values
            choice[layer] = inner - self.first_pairs
            if interrupted is not None:
                interrupted[layer, 0] = least[entries] @ shares
            return (least,) if measures is None else (least, self._measures(layer, inner, measures))

        part = PartOfSweep(choice, costs.price, self.process.cap, None)
        try:
            beyond = (values,) if self.can_follow else (values, measures)
            for layer, numbers in self._backward(best, *beyond):
                part = part._replace(layer=layer, measures=(*numbers, None)[1])
            if part.measures is None:
                return self.follow(choice, measures)
            return expected(base.start, part.measures)
        except STOPS as stop:
            end_with_incumbent(stop)
            raise Stop(part) from stop

    @with_twin
    def measure(self, choice: IntArray, beyond: FloatArray) -> FloatArray:
        """Evaluate a choice by a backward sweep; return its measures from the start, [1 + counted].

        Args:
            choice: [cap, nodes].
            beyond: measures beyond the cap, [layers beyond, nodes, 1 + counted].
        """
        start = self.process.base.start
        one_pass = None if self.by_blocks and self.can_follow else self.one_pass
        if one_pass is not None:
            given = SweepCosts(_NONE, _NONE, _NONE), beyond[:, :, 0], beyond, choice
            blocks = self._blocks(one_pass, *given, is_fixed=True)
            return expected(start, deque(blocks, maxlen=1)[0][2][0])
        if self.can_follow:
            return self.follow(choice, beyond)

        def measures(layer: int, ahead: FloatArray) -> tuple[FloatArray]:
            """Return the measures of each node of a layer if it takes the pairs of ``choice``."""
            return (self._measures(layer, self.first_pairs + choice[layer], ahead),)

        swept = self._backward(measures, beyond)
        return expected(start, deque(swept, maxlen=1)[0][1][0])

    def bound(
        self, costs: SweepCosts, ceiling: FloatArray, choice: IntArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return lower bounds of the values of all policies, rounded down, by a backward sweep.

        Args:
            costs: costs to minimise, and lower bounds of the values beyond the cap.
            ceiling: numbers that the bounds must not exceed, [cap, nodes]; infinite: no limit.
            choice: written: the minimising choice, [cap, nodes]; None if there are free steps.

        Returns:
            The bound for an episode that begins in each layer, [cap]; and the values, [cap, nodes].
            If the table of values would be too large to store, every value returned is infinite.
        """
        process, base = self.process, self.process.base
        inner, floor = self._first_choice, costs.floor

        def lower(layer: int, ahead: FloatArray) -> tuple[FloatArray]:
            """Return the lower bounds of a layer; with steps of cost 0, by policy iteration."""
            nonlocal inner
            most, is_free = ceiling[layer], bool(np.isposinf(ceiling[layer]).all())
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
            cost = self._pair_costs(costs, sizes=True)
            layers = self._backward(lower, costs.beyond)
            blocks = ((slice(layer, layer + 1), lowest[None]) for layer, (lowest,) in layers)
        else:
            swept = self._blocks(one_pass, costs, costs.beyond, choice=choice, limits=ceiling)
            blocks = ((some, lowest) for some, lowest, _ in swept)
        is_kept = ceiling.size <= KEPT_VALUES
        kept = (
            np.empty(ceiling.shape, order="F" if self.by_blocks else "C")
            if is_kept
            else np.broadcast_to(np.inf, ceiling.shape)
        )
        begun, sizes = np.zeros((2, process.cap))
        entries = np.flatnonzero(base.start)
        shares = base.start[entries]
        for some, lowest in blocks:
            begun[some] = lowest[:, entries] @ shares
            sizes[some] = np.abs(lowest[:, entries]) @ shares
            if is_kept:
                kept[some] = lowest
        ended = np.array(costs.at_start).reshape(-1, 2).prod(axis=1)
        terms = len(entries) + int(np.count_nonzero(ended))  # number of products in the sum
        if terms == 1 and (
            shares[0] == 1.0
            if len(entries)
            else all(Fraction(w) * Fraction(a) == Fraction(w * a) for w, a in costs.at_start)
        ):
            terms = 0  # a single exact product
        loss = terms * MACHINE_EPSILON * (sizes + float(np.abs(ended).sum()))
        return begun + sum(ended.tolist()) - loss, kept

    def follow(self, choice: IntArray, beyond: FloatArray) -> FloatArray:
        """Evaluate a choice by a forward sweep of its mass; return its measures, [1 + counted].

        Args:
            choice: [cap, nodes].
            beyond: measures beyond the cap, [layers beyond, nodes, 1 + counted].
        """
        process, sums = self.process, list[list[float]]()
        if self.by_blocks and (one_pass := self.one_pass) is not None:
            from ssp_lp.compiled.layers import follow_layers

            layers, cap, span = one_pass[0], process.cap, process.totals.span
            ring = np.zeros((span + 1, process.base.n_nodes))
            swept = np.zeros((1 + self.counted.shape[1], 2))
            ring[0] = process.base.start
            for some in pieces(cap, cap * process.base.n_nodes):
                follow_layers(layers, some.start, choice[some], ring, swept)
            sums, left = [swept.sum(axis=1).tolist()], ring[np.arange(cap, cap + span) % len(ring)]
        else:
            mass = self._start_mass
            for layer in range(process.cap):
                sums.append(mass.follow(choice[layer], self.charged(layer)).tolist())
            left = mass.left
        for beyond_cap, each in zip(left, beyond, strict=False):
            sums.append((beyond_cap @ each).tolist())
        return np.array([fsum(each) for each in zip(*sums, strict=True)])

    @property
    def _start_mass(self) -> _LayerMass:
        return _LayerMass(self.process.base, self.counted, self.process.totals)

    def mass_beyond(self, choice: IntArray) -> FloatArray:
        """Return a choice's mass beyond the cap, by a forward sweep, [layers beyond, nodes]."""
        mass = self._start_mass
        for chosen in choice:
            mass.follow(chosen, PairCost(self.process.base.gain_cost))
        return mass.left

    def _blocks(
        self,
        compiled: _OnePass,
        costs: SweepCosts,
        values: FloatArray,
        measures: FloatArray | None = None,
        choice: IntArray | None = None,
        *,
        is_fixed: bool = False,
        limits: FloatArray | None = None,
    ) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Sweep blocks of layers in the compiled pass, the last block first.

        Args:
            compiled: input of the pass.
            costs: costs to minimise.
            values: values beyond the cap, [layers beyond, nodes].
            measures: measures beyond the cap, [layers beyond, nodes, 1 + counted], or None.
            choice: written, or given if ``is_fixed``, [cap, nodes].
            is_fixed: whether to evaluate the given choice; the values then have no effect.
            limits: upper limits, [cap, nodes], to compute lower bounds, rounded down; None:
                compute the least values.

        Yields:
            The layers of the block, their values, [layers, nodes], and measures, [layers, nodes,
            1 + counted]. The next block reuses the memory.
        """
        run: Callable[..., None] = _sweep_plainly
        whole, within, is_compiled = compiled
        cap, span, block = self.process.cap, self.process.totals.span, self.block
        by_blocks = is_compiled and block >= _LEAST_BLOCK
        if by_blocks:
            from ssp_lp.compiled.layers import sweep_blocks
        elif is_compiled:
            from ssp_lp.compiled.layers import sweep_layers as run
        counts = 1 + self.counted.shape[1]
        ahead = [values, np.zeros((len(values), 0, counts)) if measures is None else measures]
        position = np.zeros((0, 0), dtype=np.int8) if choice is None else choice
        rooms = list[FloatArray]()
        entries = cap * len(whole.classes) // (_LEAST_BLOCK if by_blocks else 1)
        for turn in pieces(cap, int(entries * within.max(initial=1.0))):
            some = slice(cap - turn.stop, cap - turn.start)
            many = some.stop - some.start
            layers = whole._replace(
                leads=whole.leads if len(whole.leads) == 1 else whole.leads[some] - some.start,
                paid=whole.paid[some],
                charge=whole.charge if len(whole.charge) == 1 else whole.charge[some],
            )
            if not rooms:  # all blocks share this memory; their sizes differ by one layer
                size = many + 1 + max(span, len(values))
                shapes = [(size, *a.shape[1:]) for a in ahead]
                if by_blocks:
                    rooms = [np.empty(shape, order="F") for shape in shapes]
                else:
                    rooms = [(np.empty if whole.turns == 1 else np.zeros)(s) for s in shapes]
            parts = [room[: many + len(a)] for room, a in zip(rooms, ahead, strict=True)]
            for part, later in zip(parts, ahead, strict=True):
                part[many:] = later
            given, task = _NO_LIMITS, (costs.charged, costs.owed, costs.saved)
            if limits is not None and not (by_blocks and bool(np.isposinf(limits[some]).all())):
                given = _at_least(limits[some], costs.floor)
            if by_blocks:
                numbers, how = (room.T for room in rooms), (is_fixed, limits is not None, given)
                sweep_blocks(layers, block, *task, *numbers, position[some], *how)
            else:
                own = parts[0].ravel(), parts[1].reshape(-1, counts), position[some], is_fixed
                run(layers, *task, *own, within, given)
            yield some, parts[0][:many], parts[1][:many]
            ahead = [part[:span] for part in parts]

    def _pair_costs(
        self, costs: SweepCosts, *, sizes: bool = False
    ) -> Callable[[int], tuple[PairCost, FloatArray, FloatArray]]:
        """Return a function that computes a layer's pair costs, ``charge + owed - saved``.

        With the costs it returns two sizes of each pair, which bound the rounding: the sum of the
        terms' absolute values, and the greatest absolute value of a term.

        Args:
            costs: costs to minimise.
            sizes: whether the sizes are needed; if not, the function may return wrong ones.
        """
        process, (owed, saved), weight = self.process, costs[:2], costs.charged
        alone = np.maximum(owed, saved)
        if process.grows_evenly:
            even, totals = self.charged(0), process.totals.values
            fixed, slope = weight * even.fixed, even.slope
            cost = PairCost(fixed + owed - saved, None if slope is None else weight * slope)
            sizes_of = fixed + owed + saved, np.maximum(alone, fixed)
            return lambda layer: (replace(cost, factor=float(totals[layer])), *sizes_of)

        def summed(layer: int) -> tuple[PairCost, FloatArray, FloatArray]:
            """Return pair costs, and sizes for rounding, of a layer that has its own charges."""
            fixed = weight * self.charged(layer).fixed
            size, most = (np.abs(fixed) + owed + saved, np.abs(fixed)) if sizes else (owed, owed)
            return PairCost(fixed + owed - saved), size, np.maximum(alone, most)

        return summed

    def _backward(
        self, step: Callable[..., tuple[FloatArray, ...]], *beyond: FloatArray
    ) -> Iterator[tuple[int, tuple[FloatArray, ...]]]:
        """Sweep backward layer by layer.

        Args:
            step: function (layer, values in the layers ahead, [layers * nodes, ...] each) -> values
                in the layer, [nodes, ...] each.
            beyond: values in the layers beyond the cap, [layers beyond, nodes, ...] each.

        Yields:
            The number of the layer, and the values of its nodes, [nodes, ...] each.
        """
        leads, span = self.process.totals.ahead, self.process.totals.span
        size = _SLACK * span + 1  # of the numbers at hand, the nearest layer in front
        rooms = [np.zeros((size, *numbers.shape[1:])) for numbers in beyond]
        for room, numbers in zip(rooms, beyond, strict=True):
            room[size - span :][: len(numbers)] = numbers
        front = size - span
        for layer in backward(self.process.cap):
            ahead = slice(front, front + span) if leads is None else front + leads[layer]
            swept = step(layer, *(room[ahead].reshape(-1, *room.shape[2:]) for room in rooms))
            if front == 0:
                front = size - span
                for room in rooms:
                    room[front:] = room[:span]
            front -= 1
            for room, numbers in zip(rooms, swept, strict=True):
                room[front] = numbers
            yield layer, swept

    def _measures(self, layer: int, chosen: IntArray, ahead: FloatArray) -> FloatArray:
        """Return the measures of a layer's choice, [nodes, 1 + counted].

        Args:
            layer: the layer.
            chosen: a pair of each node, [nodes].
            ahead: measures of the layers ahead, [layers * nodes, 1 + counted].
        """
        base, charge = self.process.base, self.charged(layer)
        measures = np.empty((len(chosen), 1 + self.counted.shape[1]))
        measures[:, 0] = charge.fixed[chosen]
        if charge.slope is not None:
            measures[:, 0] += charge.factor * charge.slope[chosen]
        measures[:, 1:] = self.counted[chosen]
        measures += chosen_product(base.later, chosen, ahead)
        if not self.is_acyclic:
            chain = base.instant_dynamics.chain(chosen)
            solved = chain.solve(measures)
            missing = np.abs(solved[:, 1:].sum(axis=1) - 1.0)  # failure + goal = 1
            if missing.max(initial=0.0) <= _ALL_ENDS:
                return solved
            measures = evaluate_chain(chain, measures).values
        return measures

    @cached_property
    def is_acyclic(self) -> bool:
        """Whether no step costs 0, so that no equations are solved within a layer."""
        return self.process.base.instant.nnz == 0

    @property
    def can_follow(self) -> bool:
        """Whether a forward sweep is possible: no step costs 0, and loops are compiled."""
        if self.by_blocks:
            return accelerated(self.process.cap * self.process.base.n_nodes, "layers.follow_layers")
        entries = self.process.cap * self.process.base.later.nnz
        return self.is_acyclic and accelerated(entries, "layers.follow_layer")

    @cached_property
    def block(self) -> int:
        """Least number of layers that a step passes, or 1 if it is not known."""
        classes = self.process.base.steps_by_class[1]
        is_even = classes.size > 0 and self.process.totals.ahead is None
        return int(classes.min()) if is_even else 1

    @property
    def by_blocks(self) -> bool:
        """Whether a backward sweep runs over blocks of layers, in a compiled pass."""
        one_pass = self.one_pass if self.block >= _LEAST_BLOCK else None
        return one_pass is not None and one_pass[2]

    @property
    def one_pass(self) -> _OnePass | None:
        """Input of a backward sweep in one pass; None if the sweep must go layer by layer."""
        process, base = self.process, self.process.base
        cells = base.n_nodes * process.totals.span * (1 + self.counted.shape[1]) // 3
        by_blocks = self.block >= _LEAST_BLOCK
        few = _MOST_ENTRIES * (1 if process.grows_evenly else 2)  # charges of a layer take time
        is_long = self.is_acyclic and base.later.nnz > few and not by_blocks
        if cells > _MOST_CELLS or is_long or base.n_nodes == 0:
            return None
        loop = "layers.sweep_blocks" if by_blocks else "layers.sweep_layers"
        loops = (loop, *(COMPONENTS if base.instant.nnz else ()))
        is_compiled = accelerated(base.later.nnz * process.cap, *loops)
        is_plain = self.is_acyclic and (base.later.nnz + len(base.gain)) * process.cap <= _FEW_CELLS
        whole = self._whole_pass if is_compiled or is_plain else None
        return None if whole is None else (*whole, is_compiled)

    @cached_property
    def _whole_pass(self) -> tuple[_Layers, FloatArray] | None:
        """Input of a backward sweep in one pass, whether or not one pass is faster.

        It is None if there are too many charges, or if policies may take too many free steps in a
        row.
        """
        process, base, cap = self.process, self.process.base, self.process.cap
        arriving = process.arriving
        columns = len(base.gain) if self.added is not None else len(arriving) + 1
        if not process.grows_evenly and columns * cap > _MOST_CHARGES:
            return None
        order: IntArray = np.arange(base.n_nodes, dtype=np.uint32)
        within, turns, instant = _NONE, 1, base.instant
        if instant.nnz:
            from ssp_lp.compiled.graphs import order_components

            owner = np.repeat(base.quotient.pair_node, np.diff(instant.indptr))
            begins = unsigned(instant.indptr)[base.pair_offsets]
            entries = begins, instant.indices, instant.data
            _, order, n_components = order_components(*entries, by_height=False)
            order = unsigned(order)
            if n_components < base.n_nodes or (instant.indices == owner).any():  # cycles
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
            even = self.charged(0)
            charge, growth = even.fixed[None, :], even.parts[1]
        elif self.added is not None:
            charge, growth = np.tile(self.added, (cap, 1)), _NONE
            charge[:, arriving] += process.charged_arriving(slice(0, cap))
        else:
            charge, growth = np.zeros((cap, columns)), _NONE
            charge[:, :-1] = process.charged_arriving(slice(0, cap))
            column[:] = len(arriving)
            column[arriving] = np.arange(len(arriving))
        layers = _Layers(
            order, turns, unsigned(base.pair_offsets), indptr, classes, nodes, data,
            leads.astype(np.int64), process.totals.values, charge, column, growth,
            self.counted,
        )  # fmt: skip
        return layers, within

    @cached_property
    def _first_choice(self) -> IntArray:
        """Pairs with which every node leaves its layer, [nodes]."""
        base = self.process.base
        if self.is_acyclic:
            return self.first_pairs
        leaving = (base.gain > 0) | (base.failure > 0) | (np.diff(base.later.indptr) > 0)
        return nearer_pairs(base.instant_dynamics.graph, leaving)


def _sweep_plainly(
    layers: _Layers, weight: float, owed: FloatArray, saved: FloatArray, values: FloatArray,
    measures: FloatArray, position: IntArray, is_fixed: bool, _: FloatArray, ceiling: FloatArray,
) -> None:  # fmt: skip
    """Do the work of ``layers.sweep_layers`` in numpy, for layers without steps of cost 0."""
    n, offsets, nodes = layers.offsets.size - 1, layers.offsets.astype(np.int64), layers.nodes
    width, number = (int(layers.leads.max(initial=0)) + 1) * n, np.arange(offsets[-1])
    begins, lengths, is_even = offsets[:-1], np.diff(offsets), len(layers.leads) == 1

    def columns(leads: IntArray) -> IntArray:
        """Return the index, among the values ahead, to which each step leads, [entries]."""
        return (leads * n)[layers.classes].astype(np.int32) + nodes.view(np.int32)

    indptr, shape = layers.indptr.view(np.int32), (number.size, width)
    steps = csr_of(layers.data, columns(layers.leads[0]), indptr, shape)
    alone, rounding = np.maximum(owed, saved), backup_rounding(steps)
    for layer in range(len(layers.paid) - 1, -1, -1):
        if not is_even:
            steps.indices[:] = columns(layers.leads[layer])
        here, first = slice(layer * n, (layer + 1) * n), layer * n if is_even else 0
        ahead = slice(first, first + width)
        charged = layers.charge[layer if len(layers.charge) > 1 else 0][layers.column]
        growth = layers.paid[layer] * layers.growth if layers.growth.size else 0.0
        if not is_fixed:
            own, more = weight * charged, weight * growth
            total = own + more + owed - saved + steps @ values[ahead]
            if ceiling.size:
                size = np.abs(own) + more + owed + saved + steps @ np.abs(values[ahead])
                single = size == np.maximum(alone, np.abs(own))
                total = np.where(single, total, total - rounding * size)
            least = np.minimum.reduceat(total, begins)
            values[here] = np.minimum(least, ceiling[layer]) if ceiling.size else least
            if not ceiling.size:
                nearest = np.where(total == least.repeat(lengths), number, number.size)
                position[layer] = np.minimum.reduceat(nearest, begins) - begins
        if measures.size:
            pick = begins + position[layer]
            measures[here] = (steps @ measures[ahead])[pick]
            measures[here, 0] += (charged + growth)[pick]
            measures[here, 1:] += layers.counted[pick]


def at_weights(
    sweep: Sweep,
    weights: FloatArray,
    beyond: FloatArray,
    measures: FloatArray = _NONE,
    *,
    bounds: bool = False,
) -> SweepCosts:
    """Return the costs to minimise for weights of the charge and the counted rewards.

    Args:
        sweep: the sweeps.
        weights: [1 + counted].
        beyond: values beyond the cap, or lower bounds, [layers beyond, nodes].
        measures: measures beyond the cap, [layers beyond, nodes, 1 + counted]; none for bounds.
        bounds: whether to round the pair costs down, for lower bounds.
    """
    owed, saved = np.zeros((2, len(sweep.counted)))
    for counted, weight in zip(sweep.counted.T, weights[1:].tolist(), strict=True):
        part = weight * counted  # a column at a time: numpy sums short rows slowly
        owed, saved = owed + np.maximum(part, 0.0), saved - np.minimum(part, 0.0)
    if bounds:
        saved += weighted_rounding(sweep.counted, weights[1:]) * (owed + saved)
    return SweepCosts(owed, saved, beyond, measures, float(weights[0]))


def at_price(sweep: Sweep, price: float, failing: float, *, bounds: bool = False) -> SweepCosts:
    """Return the costs to minimise at a price of failure; the sweep must count failure and goal.

    The cost of a run is its charge plus ``failing`` if it fails, or plus ``failing - price`` if it
    reaches the goal. With ``failing`` equal to the price this is ``charge + price * failure``. With
    0 it is ``charge - price * goal``, which is exact even if failure is almost sure. The values
    beyond the cap are those of the tails chosen at this price or, for bounds, lower bounds of every
    policy's value.
    """
    process, earned, measures = cast("LayeredProcess", sweep.process), price - failing, _NONE
    weights = np.array([1.0, failing, -earned])
    if bounds:
        beyond = process.beyond_bound(price, failing)
    else:
        measures = process.measures_beyond(price)
        beyond = weighted(measures.reshape(-1, 3), weights).reshape(measures.shape[:-1])
    base = process.base
    return at_weights(sweep, weights, beyond, measures, bounds=bounds)._replace(
        floor=-(earned - process.charge.lowest) * (1.0 + _BELOW_EVERY_VALUE),
        at_start=(
            (failing, base.start_failure),
            (-earned, base.start_goal),
            (1.0, process.start_charge),
        ),
        price=price,
    )


def _at_least(values: FloatArray, floor: float) -> FloatArray:
    """Return values raised to at least a floor; nan becomes the floor."""
    return np.maximum(np.nan_to_num(values, nan=floor, posinf=np.inf), floor)


_ALL_ENDS = 1e-9
"""Deviation of failure + goal from 1 above which a layer is evaluated with the exact method."""

_ON_ITS_WAY = 0.01
"""Waiting mass, as a share of the arrived mass, at which the sweep of a guess ends."""

_LAYERS_BETWEEN = 8  # layers between two checks of it

_SLACK = 4  # a room holds this many windows, so that all is moved once in three windows

_DROPPED = 1e-9
"""Mass of a node below which the sweep of a guess ignores it."""


def follow_rule(
    base: AccumulatedCost, rule: IntArray, most_layers: int
) -> tuple[float, float] | None:
    """Return approximate (E[cost; goal], Pr(goal)) of a stationary choice, by a forward sweep.

    Args:
        base: one layer of a process without free steps.
        rule: position among the pairs of each node, [nodes].
        most_layers: most layers of the sweep.

    Returns:
        Both numbers; None if no mass arrives, or if much mass still waits after the last layer.
    """
    counted = np.stack([base.failure, base.survival * base.gain], axis=1)
    mass, sums = _LayerMass(base, counted, base.totals(0)), np.zeros(3)
    for layer in range(most_layers):
        mass.here[mass.here < _DROPPED] = 0.0
        sums += mass.follow(rule, PairCost(base.gain_cost, base.gain, layer * base.unit))
        if layer % _LAYERS_BETWEEN == 0 and mass.left.sum() <= _ON_ITS_WAY * sums[2]:
            return (float(sums[0]), float(sums[2])) if sums[2] > 0.0 else None
    return None


class _LayerMass:
    """The mass of a layer and of the layers ahead, in a forward sweep. Mutable."""

    def __init__(self, base: AccumulatedCost, counted: FloatArray, totals: Totals) -> None:
        """Start with the start mass in the first layer.

        Args:
            base: one layer, without free steps.
            counted: rewards in addition to the charge, [pairs, counted].
            totals: the totals of the layers, and the layers that steps lead to.
        """
        self._base, self._counted = base, counted
        self._span, self._leads = totals.span, totals.ahead
        self._buffer = np.zeros((2 * self._span + 1, base.n_nodes))
        self._buffer[0], self._front, self._layer = base.start, 0, 0
        classes = 0 if self._leads is None else self._leads.shape[1]
        self._by_class = np.zeros((classes, base.n_nodes))

    @property
    def here(self) -> FloatArray:
        """The mass of the current layer, [nodes]."""
        here: FloatArray = self._buffer[self._front]
        return here

    @property
    def left(self) -> FloatArray:
        """The mass of the current layer and of the layers after it, [layers, nodes]."""
        return self._buffer[self._front :]

    def follow(self, choice: IntArray, charge: PairCost) -> FloatArray:
        """Send the mass of the current layer on, and make the next layer the current one.

        Args:
            choice: position among the pairs of each node, [nodes].
            charge: charges of the pairs.

        Returns:
            The charge and the counted rewards that this mass collects, [1 + counted].
        """
        from ssp_lp.compiled.layers import follow_layer

        check_time()
        base, counted = self._base, self._counted
        sums = np.zeros((1 + counted.shape[1], 2))  # sums, and their rounding errors
        first, leads = self._front + 1, self._leads
        onward = self._buffer[first : first + self._span] if leads is None else self._by_class
        follow_layer(
            self.here, choice, unsigned(base.pair_offsets), *row_parts(base.later), *charge.parts,
            counted, onward.reshape(-1), sums,
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
