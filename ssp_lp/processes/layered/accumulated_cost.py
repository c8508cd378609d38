"""The accumulated cost of case S (paper, section 3.1.1) as a layered substochastic process.

States are (node, layer), the layer being the cost paid so far in units of the cost lattice. Only
one layer's structure is stored: it is the same in all of them. A failing episode costs nothing
here, so where the goal can be avoided for sure (attention states) a policy may fail at once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, csr_of, unsigned
from ssp_lp.dynamic_programming.bellman import PairCost, SparseRows, written_out
from ssp_lp.dynamic_programming.dynamics import Dynamics, without_self_loops
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import attention_states
from ssp_lp.processes.expectations import cost_means, successor_means
from ssp_lp.processes.failure_semantics import Aim, survival_of
from ssp_lp.processes.flow import Spread
from ssp_lp.processes.layered.charges import Charge, TotalCostCharge
from ssp_lp.processes.live_rows import RowChoice, live_rows, shared_live_rows
from ssp_lp.processes.quantities.conditions import UpperRow, free_pairs
from ssp_lp.processes.quotient import Quotient, build_quotient
from ssp_lp.processes.totals.lattice import Lattice, lattice_of, totals_of
from ssp_lp.processes.totals.step_sums import last_steps, step_lattice

_MOST_TURNS = 300  # to bound the steps within a layer
_LAST_STEP = 0.4  # what another one adds by then; a half would do but for rounding


@dataclass(frozen=True, eq=False)
class AccumulatedCost:
    """One layer of the process, and how its pairs lead to the same and to later layers."""

    quotient: Quotient
    lattice: Lattice  # of the costs
    survival: float  # the discount, 1 in the exact setting
    instant: sp.csr_array  # [pairs, nodes] steps that cost nothing and stay in the layer
    later: SparseRows  # [pairs, (width - 1) * nodes] column 0 is one layer ahead
    gain: FloatArray  # [pairs] probability of stepping into the goal (weight gamma^t)
    gain_cost: FloatArray  # [pairs] E[stage cost; step into the goal]
    failure: FloatArray  # [pairs] mass that fails
    start: FloatArray  # [nodes]
    start_goal: float  # start mass on goals
    start_failure: float  # start mass on dead-ends
    departs: FloatArray  # [pairs] what rows were divided by: they count departures from a node
    arrivals: sp.csr_array | None = None  # [pairs, width] steps into the goal by layers ahead
    last_steps: FloatArray | None = None  # [width] their costs, where layers are kinds of steps

    @property
    def exact_unit(self) -> Fraction:
        """Cost of one layer."""
        return self.lattice.unit

    @cached_property
    def unit(self) -> float:
        """The same as a float."""
        return float(self.lattice.unit)

    @property
    def by_steps(self) -> bool:
        """Whether "layers" are kinds of steps, in place of multiples of a common unit."""
        return self.last_steps is not None

    @property
    def width(self) -> int:
        """Layers that one step can reach: 0 .. width - 1 ahead."""
        return self.lattice.width

    @property
    def n_nodes(self) -> int:
        """States of one layer."""
        return self.quotient.n_nodes

    @property
    def pair_offsets(self) -> IntArray:
        """Pairs of each node, [nodes + 1]."""
        return self.quotient.pair_offsets

    @cached_property
    def instant_dynamics(self) -> Dynamics:
        """Steps that cost nothing; whatever goes on to a later layer leaves."""
        onward = np.asarray(written_out(self.later).sum(axis=1)).ravel()
        exits = onward + self.survival * self.gain + self.failure
        return Dynamics(self.pair_offsets, self.instant, exits, is_reused=True)

    @cached_property
    def steps_within(self) -> FloatArray | None:
        """At least one more than after the free steps of any pair, [nodes]; None: it is large.

        So it bounds the steps that a policy takes before it leaves a layer. Where another step
        adds at most half a one, twice as many do.
        """
        steps = np.ones(self.n_nodes)
        for _ in range(_MOST_TURNS):
            after = self.instant @ steps
            more = 1.0 + np.maximum.reduceat(after, self.pair_offsets[:-1])
            if (more - steps).max(initial=0.0) <= _LAST_STEP:
                return 2.0 * steps
            steps = more
        return None

    @property
    def steps(self) -> sp.csr_array:
        """All steps, [pairs, width * nodes]; column = layers ahead * nodes + node."""
        later, n = written_out(self.later), self.n_nodes
        if len(self.instant.indices):
            return sp.csr_array(sp.hstack([self.instant, later]))
        columns = later.indices + np.asarray(n, dtype=later.indices.dtype)
        return csr_of(later.data, columns, later.indptr, (later.shape[0], n + later.shape[1]))

    @cached_property
    def steps_by_kind(self) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
        """Rows of all steps, what kind each entry is of (0: free), where it leads, and its share.

        [pairs + 1], and [entries] each.
        """
        steps, n = self.steps, max(self.n_nodes, 1)
        kinds, nodes = np.divmod(unsigned(steps.indices), np.uint32(n))
        kind_type = np.uint8 if self.width <= 256 else np.uint32
        return unsigned(steps.indptr), kinds.astype(kind_type), nodes.astype(np.uint32), steps.data


def spread_layer(base: AccumulatedCost, spread: Spread, start: FloatArray) -> AccumulatedCost:
    """One layer of the states themselves, nothing collapsed and every self-loop in its place.

    Args:
        base: the layer as methods take it, without discount.
        spread: its quotient's pairs, each by itself.
        start: distribution over states, [states].
    """
    instant, later = _steps_by_cost(spread.quotient, base.lattice, base.survival)
    arrivals, own = base.arrivals, np.maximum(spread.place, 0)
    if arrivals is not None:
        factor = np.where(spread.place >= 0, spread.departs, 0.0)
        arrivals = _scaled_rows(sp.csr_array(arrivals[own]), factor)
    return replace(
        base,
        quotient=spread.quotient,
        instant=instant,
        later=later,
        gain=spread.per_taking(base.gain),
        gain_cost=spread.per_taking(base.gain_cost),
        failure=spread.per_taking(base.failure),
        start=spread.quotient.gather(start),
        departs=np.ones(len(spread.place)),
        arrivals=arrivals,
    )


def accumulate_cost(
    model: SSP,
    start: FloatArray,
    discount: float | None,
    *,
    arrivals: bool = False,
    usable: BoolArray | None = None,
    side: Iterable[UpperRow] = (),
    by_steps: bool = False,
) -> AccumulatedCost:
    """Build the process of case S.

    Args:
        model: the model.
        start: distribution over states, [states].
        discount: None keeps real probabilities; a number scales every transition by it.
        arrivals: place the costs of arriving at the goal on the lattice too, so that any function
            of the total cost can be charged.
        usable: pairs that may be used, [model pairs]; with it nobody may fail by choice, which is
            the second stage of a least-failure problem (mathematics, section 4).
        side: what is limited besides.
        by_steps: "layers" are distinct costs of a step, in place of multiples of a common unit.

    Raises:
        ModelError: the costs have no common unit that gives a sane number of layers.
    """
    survival = survival_of(discount)
    free = free_pairs(model, Aim.LEAST_COST, side) if discount is None else None
    exits = attention_states(model) if usable is None else None
    quotient = build_quotient(model, usable=usable, free=free, exits=exits)
    going_on = quotient.node_of >= 0
    counted = going_on | model.goal_mask if arrivals else going_on
    told_apart = _kinds_of_costs(model) if by_steps else _multiples_of_unit(model, counted)
    lattice, arriving, last = told_apart
    instant, later = _steps_by_cost(quotient, lattice, survival)
    to_dead = quotient.at_pairs(successor_means(model, quotient.dead), 1.0)
    acting = quotient.pair_at >= 0
    base = AccumulatedCost(
        quotient=quotient,
        lattice=lattice,
        survival=survival,
        instant=instant,
        later=later,
        gain=quotient.at_pairs(successor_means(model, model.goal_mask)),
        gain_cost=quotient.at_pairs(cost_means(model, model.goal_mask)),
        failure=np.where(acting, (1.0 - survival) + survival * to_dead, 1.0),
        start=quotient.gather(start),
        start_goal=float(start[model.goal_mask].sum()),
        start_failure=float(start[quotient.dead].sum()),
        departs=np.ones(len(quotient.pair_at)),
        arrivals=_arrivals_by_cost(quotient, arriving) if arrivals else None,
        last_steps=last,
    )
    return base if discount is not None or instant.nnz == 0 else _departing(base)


def _kinds_of_costs(model: SSP) -> tuple[Lattice, Lattice, FloatArray | None]:
    """Distinct costs of steps as layers; those into the goal, and what these cost, [kinds]."""
    return step_lattice(model)[0], *last_steps(model)


def _multiples_of_unit(
    model: SSP, counted: BoolArray
) -> tuple[Lattice, Lattice, FloatArray | None]:
    """Multiples of the common unit of the steps into some states, [states], for all steps."""
    lattice = lattice_of(model, counted)
    return lattice, lattice, None


def _departing(base: AccumulatedCost) -> AccumulatedCost:
    """Pairs of accumulated cost seen on departing only: waiting for free changes no total."""
    later = written_out(base.later)
    leak = base.gain + base.failure + np.asarray(later.sum(axis=1)).ravel()
    instant = base.instant.copy()
    instant.sum_duplicates()
    instant, departs = without_self_loops(instant, base.quotient.pair_node, leak)
    if (departs == 1.0).all():
        return base
    arrivals, share = base.arrivals, 1.0 / departs
    return replace(
        base,
        instant=instant,
        later=_scaled_rows(later, share),
        gain=base.gain / departs,
        gain_cost=base.gain_cost / departs,
        failure=base.failure / departs,
        departs=departs,
        arrivals=None if arrivals is None else _scaled_rows(arrivals, share),
    )


def _scaled_rows(matrix: sp.csr_array, factor: FloatArray) -> sp.csr_array:
    """A matrix with each row multiplied by a factor, [rows]."""
    data = matrix.data * np.repeat(factor, np.diff(matrix.indptr))
    return sp.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)


def _arrivals_by_cost(quotient: Quotient, lattice: Lattice) -> sp.csr_array:
    """Probability of stepping into the goal by the accumulated cost of the step, [pairs, width]."""
    at_goal = np.where(quotient.model.goal_mask, 0, -1).astype(np.int32)
    rows = RowChoice(
        quotient.model, at_goal, 1, quotient.pair_at, ahead=lattice.ahead, width=lattice.width
    )
    return live_rows(rows).matrix


def _steps_by_cost(
    quotient: Quotient, lattice: Lattice, survival: float
) -> tuple[sp.csr_array, SparseRows]:
    """Steps that cost nothing, and steps that add to the accumulated cost; one is often empty."""
    model, n, width = quotient.model, quotient.n_nodes, lattice.width
    rows = RowChoice(model, quotient.node_of, n, quotient.pair_at)
    if lattice.least > 0:  # no step stays in its layer
        ahead = None if width == 2 else lattice.ahead - 1
        rows = replace(rows, ahead=ahead, width=width - 1)
        none, indptr = np.zeros(0, dtype=np.int32), np.zeros(len(rows.pair_at) + 1, dtype=np.int32)
        instant = csr_of(np.zeros(0), none, indptr, (len(rows.pair_at), n))
        return instant, shared_live_rows(rows, survival)
    rows = replace(rows, ahead=lattice.ahead, width=width)
    steps = live_rows(rows, survival).matrix
    return sp.csr_array(steps[:, :n]), sp.csr_array(steps[:, n:])


_TABLE = 1_000_000
"""Charges, layers x pairs or x layers of a step, that are worked out together."""


@dataclass(frozen=True, eq=False)
class ArrivalCharges:
    """A charge of the total cost at the pairs of an accumulated-cost process."""

    base: AccumulatedCost
    charge: Charge
    totals: FloatArray  # [layers] what has been paid there

    @property
    def grow_evenly(self) -> bool:
        """Whether the charge is the total cost itself, so that a layer adds the same everywhere."""
        return isinstance(self.charge, TotalCostCharge)

    def from_layer(self, layer: int) -> PairCost:
        """Expected charge of arriving at the goal by each pair from a layer, [pairs]."""
        base = self.base
        if self.grow_evenly or base.arrivals is None:
            return PairCost(base.gain_cost, base.gain, float(self.totals[layer]))
        size = max(_TABLE // max(len(base.gain), 1), 1)
        block, place = divmod(layer, size)
        if block not in self._blocks:
            some = slice(block * size, min((block + 1) * size, len(self.totals)))
            charged = np.zeros((some.stop - some.start, len(base.gain)))
            charged[:, self.arriving] = self.of_arriving(some)
            self._blocks.clear()
            self._blocks[block] = charged
        return PairCost(self._blocks[block][place])

    @cached_property
    def arriving(self) -> IntArray:
        """Pairs by which the goal can be reached, [arriving]."""
        arrivals = self.base.arrivals
        return (self.base.gain if arrivals is None else np.diff(arrivals.indptr)).nonzero()[0]

    def of_arriving(self, some: slice) -> FloatArray:
        """Expected charge of arriving by the pairs that may, from some layers, [some, arriving]."""
        base, arrivals = self.base, self.base.arrivals
        if arrivals is None:
            return (
                base.gain_cost[self.arriving] + self.totals[some, None] * base.gain[self.arriving]
            )
        kinds, place = np.unique(arrivals.indices, return_inverse=True)
        if base.last_steps is not None:
            charged = self.charge.at(self.totals[some, None] + base.last_steps[kinds])
        else:
            ahead = np.arange(some.start, some.stop)[:, None] + kinds
            charged = self.charge.at(totals_of(ahead, base.exact_unit))
        bounds = np.append(arrivals.indptr[self.arriving], len(place)).astype(np.int64)
        shape = len(self.arriving), len(kinds)  # other rows have no entries
        rows = csr_of(arrivals.data, place.astype(np.int64), bounds, shape)
        return np.ascontiguousarray((rows @ charged.T).T)

    @property
    def at_start(self) -> float:
        """Charge of the start mass that lies on goals."""
        return self.base.start_goal * float(self.charge.at(np.zeros(1))[0])

    @cached_property
    def _blocks(self) -> dict[int, FloatArray]:
        """Charges of a block of layers, kept: [layers, pairs] by the number of the block."""
        return {}
