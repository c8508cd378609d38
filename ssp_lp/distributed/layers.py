"""Case S over ranks: the layers of accumulated cost, each partitioned by state.

All ranks go through the layers together, each over its own nodes: what a step leads to is the
rank's own or a ghost (``halo``), told after each layer. Beyond the cap lies the open end
(``accumulated_cost.written_out``), a process as that of case M, which the ranks solve as such. The
first rank searches; of a policy it has what is done beyond the cap, and what is counted from the
start. Its choice in the layers stays where it was made, under a number.

The open end counts too little. What a policy costs truly follows from what its tail costs those
that succeed: from there on the totals that are swept are the true ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import count
from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.charges import Charge, TailValues
from ssp_lp.accumulated_cost.process import AccumulatedCost, accumulate_cost
from ssp_lp.accumulated_cost.sweep import OwnNodes, Priced, at_weights
from ssp_lp.accumulated_cost.written_out import LastLayer, OpenEnded, first_cap, truncates
from ssp_lp.arrays import (
    MACHINE_EPSILON,
    FloatArray,
    IntArray,
    expected,
    least_integer_type,
)
from ssp_lp.column_generation.column import Column, Proof, pricing_weights, required
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, unreachable
from ssp_lp.column_generation.explicit_pricing import costs_less_earned
from ssp_lp.column_generation.layered_pricing import (
    OpenEndedPricing,
    ahead_of,
    open_sweep,
    swept,
)
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.distributed.dynamics import PartitionedDynamics
from ssp_lp.distributed.partitioned_pricing import (
    Checkpoint,
    ChosenPairs,
    CompiledPartitioned,
    PartitionedPricing,
)
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.distributed.share import Share
from ssp_lp.dynamic_programming.bellman import SharedRows, SparseRows, Work, written_out
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.errors import ModelError
from ssp_lp.policies.policy import UNDECIDED, Policy
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.processes.failure_label import FailureLabelled
from ssp_lp.processes.failure_semantics import GiveUp, giving_up_states
from ssp_lp.processes.quotient import build_quotient


@dataclass(frozen=True, eq=False)
class OwnLayers:
    """A rank's part of a question about accumulated cost, whatever the cap is."""

    compiled: CompiledExplicit
    base: AccumulatedCost  # with the pairs of the own nodes
    own: slice  # nodes
    rows: tuple[tuple[FloatArray, float], ...]  # limited ones, [pairs] each, and at the source
    choices: dict[int, IntArray] = field(default_factory=dict)
    """Of the policies that were found, by number: [layers + 1, own nodes], the last beyond."""

    @classmethod
    def of(cls, ranks: Ranks, compiled: CompiledExplicit) -> OwnLayers:
        """Compile the question's layers on the slabs; all ranks at the same time.

        Raises:
            ModelError: a step costs nothing, or the costs have no common unit.
        """
        slab: Any = compiled.model
        exits = giving_up_states(slab, GiveUp.ATTENTION) & slab.own_mask
        base = accumulate_cost(
            slab,
            compiled.start,
            compiled.discount,
            arrivals=compiled.semantics.counts_law,
            quotient=build_quotient(slab, exits=exits),
        )
        _check_that_steps_cost(ranks, base)
        live = base.quotient.node_of >= 0
        own = slice(*(int(np.count_nonzero(live[:k])) for k in (slab.first, slab.end)))
        layers = cls(compiled, base, own, ())
        counting = layers.table(1).counting(compiled.semantics)
        return replace(layers, rows=tuple(row.at(counting) for row in compiled.side))

    @property
    def onward(self) -> Dynamics:
        """Steps from the own nodes, whichever layer they lead to, made anew."""
        base, n = self.base, self.base.n_nodes
        later = written_out(base.later)
        nodes = later.indices if base.width <= 2 else later.indices % n
        rows = sp.csr_array((later.data, nodes, later.indptr), shape=(len(base.gain), n))
        return Dynamics(base.pair_offsets, rows, base.survival * base.gain + base.failure)

    def known_by(self, size: int, places: IntArray) -> OwnLayers:
        """The same with later steps of the nodes that the rank knows, in place of all nodes.

        Args:
            size: number of known nodes.
            places: among these, of the nodes that steps lead to, [entries].
        """
        base, later, known = self.base, self.base.later, places
        if base.width > 2:  # else each step leads to the next layer
            known = later.indices // later.indices.dtype.type(base.n_nodes)
            known *= known.dtype.type(size)
            known += places
        shape = len(base.gain), (base.width - 1) * size
        if isinstance(later, SharedRows):
            rows: SparseRows = replace(later, indices=known, shape=shape)
        else:
            rows = sp.csr_array((later.data, known, later.indptr), shape=shape)
        return replace(self, base=replace(base, later=rows))

    def table(self, cap: int) -> OpenEnded:
        """The rank's part of the open-ended table with so many layers below the cap."""
        compiled, totals = self.compiled, self.base.totals(cap)
        charge: Any = compiled.charge
        return OpenEnded(self.base, charge, compiled.sense.shift, totals, compiled.start)

    def end(self, table: OpenEnded) -> LastLayer:
        """The rank's part of a table's open end, without its rows."""
        base = self.base
        cost = table.own_cost_from(table.cap) + table.shift_of_ends[0]
        counted = cost, base.failure, base.survival * base.gain
        start, nothing = np.zeros(base.n_nodes), sp.csr_array((len(cost), base.n_nodes))
        return LastLayer(ExplicitProcess(base.pair_offsets, nothing, start, *counted), table)

    def positions(self, number: int) -> IntArray:
        """Positions of actions, or codes, that a policy takes by layer, [layers + 1, own states].

        The last layer stands for all costs from the cap on.
        """
        choice, quotient = self.choices[number], self.base.quotient
        slab: Any = quotient.model
        live = quotient.node_of[slab.own] >= 0  # each a node, in this order
        offsets, firsts = self.base.pair_offsets[self.own], slab.pair_offsets[slab.own][live]
        most = int(np.diff(slab.pair_offsets).max(initial=1))
        shape = len(choice), len(live)
        placed = np.full(shape, UNDECIDED, dtype=least_integer_type(most))
        for layer, chosen in enumerate(choice):
            pairs = quotient.pair_at[offsets + chosen]
            placed[layer, live] = np.where(pairs < 0, pairs, pairs - firsts)
        return placed


def _check_that_steps_cost(ranks: Ranks, base: AccumulatedCost) -> None:
    """Raise :class:`ModelError`, on all ranks, where a step of one's layer costs nothing."""
    free = np.flatnonzero(np.diff(base.instant.indptr))
    named = base.quotient.named(int(free[0])) if free.size else None
    for found in ranks.comm.allgather(named):
        if found is not None:
            raise ModelError(
                f"action {found[1]!r} of state {found[0]!r} may cost nothing on the way: layers of "
                "accumulated cost on a partitioned model take steps that all cost something"
            )


class LayeredShare(Share):
    """A rank's rows beyond a cap, as of any process, and its sweeps over the layers below it."""

    def __init__(self, ranks: Ranks, compiled: CompiledExplicit) -> None:
        """Compile a question's layers on the slabs, the cap being one; all ranks do so together.

        Args:
            ranks: all of them.
            compiled: the question.

        Raises:
            ModelError: a step costs nothing, or the costs have no common unit.
        """
        layers, self._ranks = OwnLayers.of(ranks, compiled), ranks
        own, nothing = layers.own, np.zeros((len(layers.base.gain), 0))
        super().__init__(ranks.comm, ranks.petsc, layers.onward, nothing, own.start, own.stop)
        self.layers = layers.known_by(self.halo.size, self.dynamics.transitions.indices)
        # all ranks sweep in the same way
        follows = accelerated(layers.base.later.nnz, "layers.follow_layer")
        self._follows = all(ranks.comm.allgather(follows))
        self._take(1)

    def _take(self, cap: int) -> None:
        """Take a cap."""
        layers = self.layers
        table, base = layers.table(cap), layers.base
        known, process = tuple(row for row, _ in layers.rows), layers.end(table).process
        share = OwnNodes(layers.own, self.halo, self._follows)
        self._sweep, self._table = open_sweep(table, known, share, by_goal=False), table
        self.rewards = np.stack([process.cost, base.failure, *known], axis=1)
        self._labelled = FailureLabelled(process, base.quotient, base.departs)

    def labelled_anew(self, setting: Any) -> Share:
        """The rows with another cap, and maybe another discount: ``setting`` is both."""
        (discount, cap), compiled = setting, self.layers.compiled
        share = copy(self)
        share._equations = None
        if discount != compiled.discount:
            share = LayeredShare(self._ranks, replace(compiled, discount=discount))
        share._take(cap)
        return share

    def step_costs(self, goal: FloatArray, choice: IntArray) -> FloatArray:
        """Cost of a policy's steps beyond the cap to those that succeed after it, [own nodes].

        Args:
            goal: probability of succeeding from each node on, [nodes].
            choice: [own nodes].
        """
        quotient = self.layers.base.quotient
        states = quotient.lift(goal)
        states[quotient.model.goal_mask] = 1.0
        return self._table.step_cost(states)[choice]

    def sweep(
        self,
        number: int,
        weights: FloatArray | None,
        choice: IntArray,
        totals: FloatArray,
        tail_cost: FloatArray,
    ) -> FloatArray:
        """Sweep for a policy, which is kept under a number; what it counts from the own start.

        Args:
            number: of the policy.
            weights: at which the best is done in each layer, [rewards]; None: always the same.
            choice: what is done beyond the cap, [own nodes].
            totals: what the open end counts of it, [own nodes, rewards].
            tail_cost: what it costs those that succeed, beside what is paid before, [own nodes].

        Returns:
            Its true totals, [rewards].
        """
        sweep, table = self._sweep, self._table
        beyond = np.array(ahead_of(table, totals))
        if truncates(table.charge, float(table.totals.values[-1])):
            paid, failure = table.totals.beyond[:, None], totals[:, 1]
            goal = 1.0 - failure
            tail = TailValues(
                goal, failure, goal / table.base.survival, tail_cost, np.zeros_like(goal)
            )
            # of an exponential the line to which it falls: no reward is more certain
            beyond[:, :, 0] = Charge.beyond(table.charge, paid, tail) + table.shift
        position = choice - sweep.first_pairs
        self.layers.choices[number], figures = swept(sweep, position, weights, totals, beyond)
        return figures

    def lower(self, weights: FloatArray, lowest: FloatArray) -> FloatArray:
        """Lower bounds of all policies' values by a sweep, from the own start, [1].

        Args:
            weights: of the rewards, >= 0, [rewards].
            lowest: of what lies beyond the cap, [own nodes].
        """
        return self._lower(
            at_weights(self._sweep, weights, ahead_of(self._table, lowest), bounds=True)
        )

    def lower_less(self, ratio: float) -> FloatArray:
        """Lower bounds of all policies' costs, less a ratio for success, as of :meth:`lower`.

        Beyond the cap it is a constant: 0, or what arriving there at once costs less than it earns.

        Args:
            ratio: what success earns.
        """
        base, exits, nothing = self._table.base, self.dynamics.exits, np.zeros(len(self.rewards))
        earned, own = ratio * base.survival * base.gain, self._table.own_cost_from(self._table.cap)
        end = costs_less_earned(own, own, earned)
        ends = (end < 0.0) & (exits > 0.0)
        least = float((end[ends] / exits[ends]).min(initial=0.0))
        constant = min(self._comm.allgather(least)) * (1.0 + 4.0 * MACHINE_EPSILON)
        beyond = ahead_of(self._table, np.full(self._sweep.n_nodes, constant))
        return self._lower(Priced(nothing, earned, beyond))

    def _lower(self, priced: Priced) -> FloatArray:
        """The part of a lower bound that episodes make that begin here, [1].

        Args:
            priced: what is asked, with lower bounds beyond the cap.
        """
        anything = np.broadcast_to(np.inf, (self._table.cap, self._sweep.n_nodes))
        return self._sweep.bound(priced, anything, keeps=False)[0][:1]


@dataclass(frozen=True, eq=False)
class TailColumn(Column):
    """What is done beyond the cap on ranks; none of it is counted from the start."""

    ahead: FloatArray = field(kw_only=True)  # [nodes] cost to those that succeed, where that counts


@dataclass(frozen=True, eq=False)
class PartitionedColumn(Column):
    """A column whose choice in the layers lies with the ranks, under a number."""

    number: int = -1


@dataclass(frozen=True, eq=False)
class PartitionedLayers(OpenEndedPricing):
    """Layered pricing on ranks: of the table, what is asked here concerns its size alone."""

    end: PartitionedPricing = field(kw_only=True)  # the pricing problem beyond the cap
    numbers: Iterator[int] = field(kw_only=True)  # of policies, given to no two of them
    kept: Checkpoint = field(kw_only=True)

    @classmethod
    def begun(cls, ranks: Ranks, share: LayeredShare, fixed_cap: float | None) -> PartitionedLayers:
        """The pricing problem with a first cap.

        Args:
            ranks: which hold their shares.
            share: of the first rank.
            fixed_cap: the user's cap on accumulated cost; None: chosen by what runs cost that go
                for the goal.
        """
        layers, kept, typical = share.layers, Checkpoint(None, ""), 0.0
        table, start = layers.table(1), layers.base.start
        end = cls._held_beyond(ranks, table, layers, kept)
        pricing = cls(table, False, layers.rows, end=end, numbers=count(), kept=kept)
        if fixed_cap is None and table.charge.slope > 0.0:
            tail = pricing.tail(end.first())
            goal = float(start @ (1.0 - required(tail.totals)[:, 1]))
            typical = float(expected(start, tail.ahead)) / max(goal, 1e-300)
        cap = first_cap(layers.base, table.charge, typical, fixed_cap)
        return pricing.capped(layers, cap)

    @staticmethod
    def _held_beyond(
        ranks: Ranks, table: OpenEnded, layers: OwnLayers, kept: Checkpoint
    ) -> PartitionedPricing:
        """The pricing problem of the open end that the ranks hold."""
        held, rows = PartitionedDynamics.held_by(ranks), tuple(row for row, _ in layers.rows)
        return PartitionedPricing(layers.end(table), rows=rows, shared=held, kept=kept)

    def capped(self, layers: OwnLayers, cap: int) -> PartitionedLayers:
        """The pricing problem on layered rows with another cap, or another discount.

        Args:
            layers: of the first rank, as they have become.
            cap: number of layers below it.
        """
        ranks, table = self.ranks, layers.table(cap)
        ranks.order("label", ((layers.compiled.discount, cap),))
        end = self._held_beyond(ranks, table, layers, self.kept)
        return replace(self, augmented=table, rows=layers.rows, end=end)

    @property
    def ranks(self) -> Ranks:
        """The ranks that share the layered pricing."""
        return self.end.shared.ranks

    @cached_property
    def _beyond(self) -> PartitionedPricing:
        """The pricing problem of the ranks' open end, in the precision that is asked for."""
        return replace(self.end, precise=True) if self.precise else self.end

    def tail(self, last: Column) -> TailColumn:
        """What is done beyond the cap on ranks, with what it costs those that succeed."""
        dynamics, choice = self.end.shared, required(last.choice)
        ahead = np.zeros(len(choice))
        if self.augmented.charge.slope > 0.0:
            goal = 1.0 - required(last.totals)[:, 1]
            own = [(pairs,) for pairs in dynamics.own_pairs(choice)]
            steps = np.concatenate(dynamics.order("step_costs", (goal,), own))
            ahead = dynamics.chain(choice).solve(steps)
        stated = {part.name: getattr(last, part.name) for part in fields(Column)}
        return TailColumn(**stated, ahead=ahead)

    def first(self) -> Column:
        """The policy that leaves the ranks' open end, whatever has been paid."""
        return self._swept(self.tail(self._beyond.first()), None)

    def _swept(self, last: Column, weights: FloatArray | None) -> Column:
        """A policy with its true totals from the start, found by all ranks layer by layer."""
        dynamics, number, tail = self.end.shared, next(self.numbers), cast("TailColumn", last)
        choice, totals = required(tail.choice), required(tail.totals)
        cut = dynamics.by_state
        vectors = dynamics.own_pairs(choice), cut(totals), cut(tail.ahead)
        parts = dynamics.order("sweep", (number, weights), list(zip(*vectors, strict=True)))
        figures = np.sum(parts, axis=0) + self._at_source
        work = last.work + Work(1, 1)
        return PartitionedColumn.of_figures(figures, choice, number=number, beyond=tail, work=work)

    def _proved(self, weights: FloatArray, values: FloatArray, best: Column | None) -> Proof:
        """Best lower bound of layered pricing that the ranks' sweep gives."""
        last = self._beyond.lowered(weights, self._asked_beyond(values, weights, best)).rounded
        dynamics = self.end.shared
        parts = dynamics.order("lower", (weights,), [(part,) for part in dynamics.by_state(last)])
        bound = _summed(np.concatenate(parts), (weights * self._at_source).tolist())
        return Proof(float(weights[1]), float(weights[1]), bound, self.anything)

    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Best lower bound that the ranks' sweep gives.

        Where the budget is slack failing counts nothing and success earns the price, which is exact
        where nothing but failing pays: no large number is taken from another.
        """
        layered, weights = self.augmented, pricing_weights(price)
        if not slack or layered.shift > 0.0 or len(weights) > 2:
            return super().prove(weights, best)
        price = float(weights[1])
        parts = self.end.shared.order("lower_less", (price,))
        at_source = [layered.start_charge, -price * layered.base.start_goal]
        bound = _summed(np.concatenate(parts), at_source)
        return Proof(price, 0.0, bound, self.anything)

    def check_less(
        self, weights: FloatArray, ratio: float, paid: float, values: FloatArray
    ) -> float:
        """Nothing: layered pricing on ranks proves by :meth:`check` alone."""
        return -np.inf

    def pulled_back(self, column: Column) -> Policy:
        """A layered column's totals, with the number of its choice, which the ranks keep."""
        own: Any = column
        model = self.augmented.base.quotient.model
        parts = [np.array([own.number])] * self.ranks.comm.size
        return ChosenPairs(model, parts, column.figures)


def _summed(parts: FloatArray, at_source: Sequence[float]) -> float:
    """Lower bound of ranks' parts and of what ends before the first step, rounded down."""
    terms = [*parts[parts != 0.0].tolist(), *(value for value in at_source if value != 0.0)]
    lost = len(terms) * MACHINE_EPSILON * sum(map(abs, terms))
    return float(sum(terms) - lost)


@dataclass(frozen=True, eq=False)
class CompiledLayers(CompiledPartitioned):
    """Case S compiled on a partitioned model, with a cap."""

    shared: PartitionedLayers = field(kw_only=True)  # type: ignore[assignment]
    own: OwnLayers = field(kw_only=True)  # of the first rank

    @classmethod
    def begun(cls, ranks: Ranks, share: LayeredShare) -> CompiledLayers:
        """The compiled question with a first cap.

        Raises:
            InfeasibleError: the goal cannot be reached, where costs are given success.
        """
        own, compiled = share.layers, share.layers.compiled
        if compiled.ratio and not (own.base.start_goal or own.base.start.any()):
            setting = compiled.budget, compiled.discount
            raise unreachable(compiled.model, compiled.start, *setting)
        pricing = PartitionedLayers.begun(ranks, share, compiled.fixed_cap)
        stated = {part.name: getattr(compiled, part.name) for part in fields(CompiledExplicit)}
        return cls(**stated, shared=pricing, own=own)

    @property
    def ranks(self) -> Ranks:
        """The ranks that share the layers."""
        return self.shared.ranks

    @property
    def base(self) -> AccumulatedCost:
        """The first rank's part of a layer."""
        return self.own.base

    @property
    def layers(self) -> int:
        """Number of layers below the cap of the compiled question."""
        return self.shared.augmented.cap

    @property
    def greatest_goal(self) -> float:
        """Upper bound of the goal probability within the compiled question: what none exceeds."""
        return 1.0

    @property
    def least_goal(self) -> float:
        """Goal probability that the compiled question's budget asks for."""
        return max(1.0 - (1.0 if self.budget is None else self.budget), 0.0)

    @property
    def _is_swept(self) -> bool:
        """Always, of layers on ranks."""
        return True

    def failure_at_least(self, discount: float | None) -> float:
        """The least failure of all policies on the partitioned layers, for an error."""
        ranks = self.ranks
        if discount == self.discount and ranks.held_by is self.shared.end.shared:
            return self.least_failure().column.failure
        ranks.order("label", ((discount, 1),))
        held: Any = ranks.share
        anew = CompiledLayers.begun(ranks, held)
        return anew.least_failure().column.failure

    def refined(self, price: float) -> CompiledLayers | None:  # type: ignore[override]
        """The compiled question with more layers on all ranks; None: no room, or no need."""
        finer = CompiledExplicit.refined(self, price)
        if finer is None or finer.cap is None:
            return None
        return replace(self, cap=finer.cap, shared=self.shared.capped(self.own, finer.cap))
