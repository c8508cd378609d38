"""The accumulated-cost process of case S (paper, section 3.1.1), in layers.

States are (node, layer); the layer is the accumulated cost. All layers have the same structure,
which is stored once. A failing episode costs nothing, so a policy may fail at once where it can
avoid the goal surely (attention states). The process is truncated at a cap M,
where tail policies take over; sweeps solve it layer by layer.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.charges import TOTAL_COST, Charge, TailValues
from ssp_lp.accumulated_cost.totals import (
    StepClasses,
    Totals,
    last_steps,
    multiples_of_unit,
    step_costs,
    totals_of,
)
from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray, IntArray, csr_of, unsigned
from ssp_lp.dynamic_programming.bellman import PairCost, SparseRows, written_out
from ssp_lp.dynamic_programming.dynamics import Dynamics, without_self_loops
from ssp_lp.model import SSP
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.processes.conditions import UpperRow
from ssp_lp.processes.failure_semantics import (
    Aim,
    GiveUp,
    free_pairs,
    giving_up_states,
    survival_of,
)
from ssp_lp.processes.live_rows import (
    RowChoice,
    cost_means,
    live_rows,
    shared_live_rows,
    successor_means,
)
from ssp_lp.processes.quotient import Quotient, Spread, build_quotient

_MOST_TURNS = 300  # most iterations to bound the steps within a layer
_LAST_STEP = 0.4  # growth of the bound at which it ends; below 1/2 with a margin for rounding


@dataclass(frozen=True, eq=False)
class AccumulatedCost:
    """One layer of the process, with its transitions within the layer and to later layers."""

    quotient: Quotient
    step_classes: StepClasses  # outcomes by cost
    survival: float  # the discount, 1 in the exact setting
    instant: sp.csr_array  # [pairs, nodes] steps of cost 0, which stay in the layer
    later: SparseRows  # [pairs, (width - 1) * nodes] column 0 is one layer ahead
    gain: FloatArray  # [pairs] probability of stepping into the goal (weight gamma^t)
    gain_cost: FloatArray  # [pairs] E[stage cost; step into the goal]
    failure: FloatArray  # [pairs] mass that fails
    start: FloatArray  # [nodes]
    start_goal: float  # start mass on goals
    start_failure: float  # start mass on dead-ends
    escape: FloatArray  # [pairs] divisors of the rows, which count departures from a node
    arrivals: sp.csr_array | None = None  # [pairs, width] steps into the goal by layers ahead
    last_steps: FloatArray | None = None  # [width] their costs, if classes are indices of costs

    @property
    def exact_unit(self) -> Fraction:
        """Cost of one layer, as a fraction."""
        return self.step_classes.unit

    @cached_property
    def unit(self) -> float:
        """Cost of one layer, as a float."""
        return float(self.step_classes.unit)

    @cached_property
    def by_steps(self) -> bool:
        """Whether steps are classified by distinct costs, rather than by multiples of a unit."""
        return self.last_steps is not None

    @cached_property
    def width(self) -> int:
        """Number of classes of steps; with a unit, steps reach 0 .. width - 1 layers ahead."""
        return self.step_classes.width

    def totals(self, cap: int) -> Totals:
        """Return the multiples of the unit up to a cap, as totals."""
        return Totals.of_unit(self.exact_unit, cap, self.width)

    @cached_property
    def n_nodes(self) -> int:
        """Number of nodes of one layer."""
        return self.quotient.n_nodes

    @property
    def pair_offsets(self) -> IntArray:
        """Offsets of the pairs of each node in a layer, [nodes + 1]."""
        return self.quotient.pair_offsets

    @cached_property
    def instant_dynamics(self) -> Dynamics:
        """Dynamics of the steps of cost 0 within a layer; steps to later layers are exits."""
        onward = np.asarray(written_out(self.later).sum(axis=1)).ravel()
        exits = onward + self.survival * self.gain + self.failure
        return Dynamics(self.pair_offsets, self.instant, exits, is_reused=True)

    @cached_property
    def steps_within(self) -> FloatArray | None:
        """Upper bound of every policy's expected steps within a layer, [nodes]; None if too large.

        Backups raise a lower bound. Once a backup adds at most 1/2 to every state, twice the lower
        bound is an upper bound.
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
        """Transitions of steps, [pairs, width * nodes]; column = class of step * nodes + node."""
        later, n = written_out(self.later), self.n_nodes
        if len(self.instant.indices):
            return sp.csr_array(sp.hstack([self.instant, later]))
        columns = later.indices + np.asarray(n, dtype=later.indices.dtype)
        return csr_of(later.data, columns, later.indptr, (later.shape[0], n + later.shape[1]))

    @cached_property
    def steps_by_class(self) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
        """All steps in CSR form: offsets, [pairs + 1], and three arrays, [entries] each.

        These are the class of the step (0: within the layer), its target node and probability.
        """
        steps, n = self.steps, max(self.n_nodes, 1)
        classes, nodes = np.divmod(unsigned(steps.indices), np.uint32(n))
        smallest = np.uint8 if self.width <= 256 else np.uint32
        return unsigned(steps.indptr), classes.astype(smallest), nodes.astype(np.uint32), steps.data


def spread_layer(base: AccumulatedCost, spread: Spread, start: FloatArray) -> AccumulatedCost:
    """Return the process in which components are not collapsed and self-loops are not removed.

    Args:
        base: the process as methods use it, without discount.
        spread: the pairs of its quotient before components were collapsed.
        start: distribution over states, [states].
    """
    instant, later = _steps_by_cost(spread.quotient, base.step_classes, base.survival)
    arrivals, own = base.arrivals, np.maximum(spread.place, 0)
    if arrivals is not None:
        factor = np.where(spread.place >= 0, spread.escape, 0.0)
        arrivals = _scaled_rows(sp.csr_array(arrivals[own]), factor)
    return replace(
        base,
        quotient=spread.quotient,
        instant=instant,
        later=later,
        gain=spread.per_visit(base.gain),
        gain_cost=spread.per_visit(base.gain_cost),
        failure=spread.per_visit(base.failure),
        start=spread.quotient.gather(start),
        escape=np.ones(len(spread.place)),
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
    quotient: Quotient | None = None,
) -> AccumulatedCost:
    """Build one layer of the accumulated-cost process of case S.

    Args:
        model: the model.
        start: distribution over states, [states].
        discount: None keeps real probabilities; a number scales every transition by it.
        arrivals: also classify the steps into the goal, so that any function of the total cost can
            be charged.
        usable: pairs that may be used, [model pairs]. If given, no policy fails by choice:
            this is the second stage of a least-failure problem (mathematics, section 4).
        side: other limits of the problem. A pair is free only if it adds nothing to them.
        by_steps: classify steps by distinct costs, rather than by multiples of a common unit.
        quotient: the nodes and pairs of a layer, with pairs for giving up; None: built here.

    Raises:
        ModelError: the costs have no common unit, or one step passes too many layers.
    """
    survival = survival_of(discount)
    if quotient is None:
        free = free_pairs(model, Aim.LEAST_COST, side) if discount is None else None
        exits = giving_up_states(model, GiveUp.ATTENTION, usable)
        quotient = build_quotient(model, usable=usable, free=free, exits=exits)
    going_on = quotient.node_of >= 0
    counted = going_on | model.goal_mask if arrivals else going_on
    if by_steps:
        classes, (arriving, last) = step_costs(model)[0], last_steps(model)
    else:
        classes = arriving = multiples_of_unit(model, counted)
        last = None
    instant, later = _steps_by_cost(quotient, classes, survival)
    to_goal = None
    if arrivals:
        at_goal, width = np.where(model.goal_mask, 0, -1).astype(np.int32), arriving.width
        to_goal = RowChoice(model, at_goal, 1, quotient.pair_at, ahead=arriving.ahead, width=width)
    to_dead = quotient.at_pairs(successor_means(model, quotient.dead), 1.0)
    acting = quotient.pair_at >= 0
    base = AccumulatedCost(
        quotient=quotient,
        step_classes=classes,
        survival=survival,
        instant=instant,
        later=later,
        gain=quotient.at_pairs(successor_means(model, model.goal_mask)),
        gain_cost=quotient.at_pairs(cost_means(model, model.goal_mask)),
        failure=np.where(acting, (1.0 - survival) + survival * to_dead, 1.0),
        start=quotient.gather(start),
        start_goal=float(start[model.goal_mask].sum()),
        start_failure=float(start[quotient.dead].sum()),
        escape=np.ones(len(quotient.pair_at)),
        arrivals=None if to_goal is None else live_rows(to_goal).matrix,
        last_steps=last,
    )
    return base if discount is not None or instant.nnz == 0 else _departing(base)


def _departing(base: AccumulatedCost) -> AccumulatedCost:
    """Remove self-loops of cost 0: condition each pair on departing, which keeps all totals."""
    later = written_out(base.later)
    leak = base.gain + base.failure + np.asarray(later.sum(axis=1)).ravel()
    instant = base.instant.copy()
    instant.sum_duplicates()
    instant, escape = without_self_loops(instant, base.quotient.pair_node, leak)
    if (escape == 1.0).all():
        return base
    arrivals, share = base.arrivals, 1.0 / escape
    return replace(
        base,
        instant=instant,
        later=_scaled_rows(later, share),
        gain=base.gain / escape,
        gain_cost=base.gain_cost / escape,
        failure=base.failure / escape,
        escape=escape,
        arrivals=None if arrivals is None else _scaled_rows(arrivals, share),
    )


def _scaled_rows(matrix: sp.csr_array, factor: FloatArray) -> sp.csr_array:
    """Return a matrix with each row multiplied by a factor, [rows]."""
    data = matrix.data * np.repeat(factor, np.diff(matrix.indptr))
    return sp.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)


def _steps_by_cost(
    quotient: Quotient, classes: StepClasses, survival: float
) -> tuple[sp.csr_array, SparseRows]:
    """Return the steps of cost 0, and the steps to later layers."""
    model, n, width = quotient.model, quotient.n_nodes, classes.width
    rows = RowChoice(model, quotient.node_of, n, quotient.pair_at)
    if classes.least > 0:  # no step stays in its layer
        ahead = None if width == 2 else classes.ahead - 1
        rows = replace(rows, ahead=ahead, width=width - 1)
        none, indptr = np.zeros(0, dtype=np.int32), np.zeros(len(rows.pair_at) + 1, dtype=np.int32)
        instant = csr_of(np.zeros(0), none, indptr, (len(rows.pair_at), n))
        return instant, shared_live_rows(rows, survival)
    rows = replace(rows, ahead=classes.ahead, width=width)
    steps = live_rows(rows, survival).matrix
    return sp.csr_array(steps[:, :n]), sp.csr_array(steps[:, n:])


_TABLE = 1_000_000
"""Most charges (layers times pairs) computed at once."""


class ChargedLayers:
    """Layers of an accumulated-cost process, with the charges of steps into the goal."""

    base: AccumulatedCost
    totals: Totals  # the accumulated cost of each layer, and the layers that steps lead to
    charge: Charge

    @cached_property
    def cap(self) -> int:
        """Number of layers below the cap."""
        return self.totals.size

    @property
    def grows_evenly(self) -> bool:
        """Whether the charge is the total cost itself."""
        return self.charge.is_the_total

    def charged(self, layer: int) -> PairCost:
        """Return the expected charge of each pair's step into the goal from a layer, [pairs]."""
        base, totals = self.base, self.totals.values
        if self.grows_evenly or base.arrivals is None:
            return PairCost(base.gain_cost, base.gain, float(totals[layer]))
        size = max(_TABLE // max(len(base.gain), 1), 1)
        block, within = divmod(layer, size)
        if block not in self._blocks:
            some = slice(block * size, min((block + 1) * size, len(totals)))
            charged = np.zeros((some.stop - some.start, len(base.gain)))
            charged[:, self.arriving] = self.charged_arriving(some)
            self._blocks.clear()
            self._blocks[block] = charged
        return PairCost(self._blocks[block][within])

    @cached_property
    def _blocks(self) -> dict[int, FloatArray]:
        """Cache of the charges of one block of layers, [layers, pairs]."""
        return {}

    @cached_property
    def arriving(self) -> IntArray:
        """Pairs of a layer that may step into the goal, [arriving]."""
        arrivals = self.base.arrivals
        return (self.base.gain if arrivals is None else np.diff(arrivals.indptr)).nonzero()[0]

    def charged_arriving(self, some: slice) -> FloatArray:
        """Return ``charged`` for a range of layers and the arriving pairs, [some, arriving]."""
        base, arrivals, paid = self.base, self.base.arrivals, self.totals.values[some, None]
        if arrivals is None:
            return base.gain_cost[self.arriving] + paid * base.gain[self.arriving]
        classes, column = np.unique(arrivals.indices, return_inverse=True)
        if base.last_steps is not None:
            charged = self.charge.at(paid + base.last_steps[classes])
        else:
            ahead = np.arange(some.start, some.stop)[:, None] + classes
            charged = self.charge.at(totals_of(ahead, base.exact_unit))
        bounds = np.append(arrivals.indptr[self.arriving], len(column)).astype(np.int64)
        shape = len(self.arriving), len(classes)  # other rows have no entries
        rows = csr_of(arrivals.data, column.astype(np.int64), bounds, shape)
        return np.ascontiguousarray((rows @ charged.T).T)

    @cached_property
    def start_charge(self) -> float:
        """Expected charge of episodes that start in a goal."""
        return self.base.start_goal * float(self.charge.at(np.zeros(1))[0])


@dataclass(frozen=True, eq=False)
class LayeredTails:
    """Stationary policies (tails) that are followed beyond the cap, with values at each node.

    The policy of row 0 moves to the goal, with least failure if ``exact``. The policy of the last
    row has the greatest failure (the paper's pi'_or).
    """

    decisions: IntArray  # [tails, states]
    values: TailValues  # [tails, nodes] each
    greatest_goal: FloatArray  # [nodes] certified upper bound of E[gamma^T; goal]
    least_goal: FloatArray  # [nodes] certified lower bound of E[gamma^T; goal]
    exact: bool = True  # whether row 0 and the upper bound are those of least failure
    least_cost: FloatArray | None = None  # [nodes] certified lower bound of E[cost; goal]; None: 0
    greatest_moment: FloatArray | None = None  # [nodes] certified, of E[exp(rate * cost); goal]
    guess: tuple[float, float] | None = None  # approximate E[cost; goal] and goal, if row 0 fails

    @cached_property
    def first(self) -> TailValues:
        """Values of the first tail policy, [nodes] each."""
        return self.values.row(0)


@dataclass(frozen=True, eq=False)
class LayeredProcess(ChargedLayers):
    """The process with layers below ``cap``; beyond it a stationary tail policy is followed."""

    base: AccumulatedCost
    totals: Totals
    tails: LayeredTails
    charge: Charge = TOTAL_COST

    @cached_property
    def end(self) -> float:
        """Accumulated cost of the cap, in units."""
        return float(self.totals.values[-1]) if self.base.by_steps else self.cap

    @cached_property
    def beyond_units(self) -> FloatArray:
        """Accumulated costs at which tail policies take over, in units, [layers, 1]."""
        if not self.base.by_steps:
            return self.cap + np.arange(self.base.width - 1.0)[:, None]
        return self.totals.beyond[:, None]

    def threshold(self, price: float) -> FloatArray:
        """Return the accumulated cost from which the last tail is no worse than the first, [nodes].

        The value of tail k at accumulated cost r is price * (1 - goal_k) + slope * (r * early_k +
        cost_k) + offset * goal_k. The result is in units. Costs up to the cap are returned as
        -infinity, so that equal choices of tails have equal thresholds.

        Args:
            price: price of failure.
        """
        charge, first, last = self.charge, self.tails.first, self.tails.values.row(-1)
        saved = charge.slope * (first.early - last.early)
        owed = (price - charge.offset) * (first.goal - last.goal)
        owed = owed + charge.slope * (last.cost - first.cost)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            total = owed / saved
        total = np.where(saved > 0, total, np.where(owed < 0, -np.inf, np.inf)) / self.base.unit
        total = total if self.base.by_steps else np.ceil(total - 1e-9)
        return np.where(total <= self.end, -np.inf, total)

    def measures_beyond(self, price: float) -> FloatArray:
        """Return charge, failure and goal of the tail best at a price, [layers, nodes, 3]."""
        last = self.beyond_units >= self.threshold(price)[None, :]
        chosen, paid = self.tails.values.chosen(last), self.beyond_units * self.base.unit
        charged = self.charge.beyond(paid, chosen)
        return np.stack([charged, chosen.failure, chosen.goal], axis=-1)

    def beyond_value(self, price: float, failing: float) -> FloatArray:
        """Return the value of the tail chosen at a price of failure, [layers, nodes].

        Args:
            price: price of failure, kappa.
            failing: weight of failure, kappa or 0; the weight of the goal is failing - kappa.
        """
        charge, failure, goal = np.moveaxis(self.measures_beyond(price), -1, 0)
        return np.asarray(charge + failing * failure - (price - failing) * goal)

    def beyond_bound(self, failure_price: float, failing: float) -> FloatArray:
        """Return a lower bound of every policy's value beyond the cap, [layers, nodes].

        A run that succeeds after cost r is charged at least charge(r). The bound is therefore
        charge(r) * early + price * (1 - goal), with early = goal / gamma (mathematics, section 5:
        r + (kappa - r) F). It is exact where failing is optimal and possible.

        Args:
            failure_price: price of failure, kappa.
            failing: weight of failure, kappa or 0; the weight of the goal is failing - kappa.
        """
        tails, totals = self.tails, self.totals.beyond[:, None]
        paid = self.charge.at(totals) / self.base.survival
        goal = np.where(paid < failure_price, tails.greatest_goal, tails.least_goal)
        rest = failing * (1.0 - goal) - (failure_price - failing) * goal
        bound = paid * goal
        if tails.greatest_moment is not None:
            nothing, moment = (
                np.zeros_like(goal),
                np.broadcast_to(tails.greatest_moment, goal.shape),
            )
            most = TailValues(goal, 1.0 - goal, nothing, nothing, moment)
            bound = self.charge.beyond(totals, most)
        if tails.least_cost is not None:
            bound = bound + self.charge.slope * tails.least_cost
        terms = failing + (failure_price - failing + np.abs(paid)) * goal + np.abs(bound)
        rounding = np.where(goal == 0, 0.0, 8.0 * MACHINE_EPSILON * terms)  # rare goals keep digits
        return np.asarray(rest + bound - rounding)

    def policy(self, choice: IntArray, tail_price: float) -> CostAwarePolicy:
        """Return a choice of pairs as a cost-aware policy on the model.

        Args:
            choice: position among the pairs of its node, [cap, nodes].
            tail_price: price of failure at which the tails beyond the cap are chosen.
        """
        quotient, model = self.base.quotient, self.base.quotient.model
        threshold = np.full(model.n_states, np.inf)
        live = quotient.node_of >= 0
        threshold[live] = self.threshold(tail_price)[quotient.node_of[live]]
        first = self.base.pair_offsets[:-1]
        decision = quotient.positions(first, choice)
        return CostAwarePolicy(
            model=model,
            unit=self.base.unit,
            decision=decision,
            tails=self.tails.decisions,
            tail_threshold=threshold,
            levels=self.totals.values if self.base.by_steps else None,
        )
