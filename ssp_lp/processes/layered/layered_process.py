"""The accumulated-cost process cut at a cap M, with the tail policies that take over there.

Sweeps take it layer by layer; for methods that need it so it is written out state by state.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.dynamic_programming.bellman import PairCost
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost, ArrivalCharges
from ssp_lp.processes.layered.charges import TOTAL_COST, Charge, TailValues
from ssp_lp.processes.totals.ladder import Ladder
from ssp_lp.processes.totals.levels import Levels, Window


@dataclass(frozen=True, eq=False)
class LayeredTails:
    """Stationary policies for accumulated costs beyond the cap, as values per node.

    Row 0 goes for the goal, where ``exact`` with the least failure; the last row fails most (the
    paper's pi'_or).
    """

    decisions: IntArray  # [tails, states]
    values: TailValues  # [tails, nodes] each
    greatest_goal: FloatArray  # [nodes] checked upper bound of E[gamma^T; goal]
    least_goal: FloatArray  # [nodes] checked lower bound of it
    exact: bool = True  # whether row 0 and the upper bound are those of the least failure
    least_cost: FloatArray | None = None  # [nodes] checked: of E[cost; goal], none where it is 0
    greatest_moment: FloatArray | None = None  # [nodes] checked: of E[exp(rate * cost); goal]
    guess: tuple[float, float] | None = None  # E[cost; goal] and goal, where row 0 only fails

    @property
    def goal(self) -> FloatArray:
        """E[gamma^T; goal], [tails, nodes]."""
        return self.values.goal

    def bounding(self, goal: FloatArray) -> TailValues:
        """As if one policy had a goal probability and the greatest moment, like ``goal``."""
        nothing = np.zeros_like(goal)
        moment = nothing if self.greatest_moment is None else nothing + self.greatest_moment
        return TailValues(goal, 1.0 - goal, nothing, nothing, moment)

    @property
    def first(self) -> TailValues:
        """The values of row 0, [nodes] each."""
        return self.values.row(0)

    def threshold(self, failure_price: float, charge: Charge) -> FloatArray:
        """Total from which the last tail is no worse than the first at this price, [nodes].

        The value of tail k at accumulated cost r is price * (1 - goal_k) + slope * (r * early_k +
        cost_k) + offset * goal_k.
        """
        first, last = self.values.row(0), self.values.row(-1)
        saved = charge.slope * (first.early - last.early)
        owed = (failure_price - charge.offset) * (first.goal - last.goal)
        owed = owed + charge.slope * (last.cost - first.cost)
        with np.errstate(divide="ignore", invalid="ignore"):
            total = owed / saved
        return np.where(saved > 0, total, np.where(owed < 0, -np.inf, np.inf))


@dataclass(frozen=True, eq=False)
class LayeredProcess:
    """States (node, layer) for layers below ``cap``; beyond it a policy follows a tail for good."""

    base: AccumulatedCost
    cap: int
    tails: LayeredTails
    charge: Charge = TOTAL_COST
    ladder: Ladder | None = None  # the totals, where they are no multiples of a unit

    @cached_property
    def levels(self) -> Levels:
        """The totals that layers stand for, and which step leads where."""
        if self.ladder is not None:
            return Levels.of_sums(self.ladder)
        return Levels.of_lattice(self.base.exact_unit, self.cap, self.base.width)

    @property
    def end(self) -> float:
        """The total at which the table ends, in units."""
        return self.cap if self.ladder is None else float(self.ladder.rungs[-1])

    def window(self, beyond: FloatArray) -> Window:
        """Values of the layers ahead, beginning with those beyond the cap, [layers, ...]."""
        return Window(beyond, self.levels)

    @cached_property
    def charges(self) -> ArrivalCharges:
        """What arriving is charged from each layer."""
        return ArrivalCharges(self.base, self.charge, self.levels.totals[: self.cap])

    @property
    def grows_evenly(self) -> bool:
        """Whether the charge is the total cost itself, so that a layer adds the same everywhere."""
        return self.charges.grow_evenly

    def charged(self, layer: int) -> PairCost:
        """Expected charge of arriving at the goal by each pair from a layer, [pairs]."""
        return self.charges.from_layer(layer)

    @property
    def start_charge(self) -> float:
        """Charge of the start mass that lies on goals."""
        return self.charges.at_start

    @property
    def beyond_units(self) -> FloatArray:
        """The totals at which tails take over, in units, [layers, 1]."""
        if self.ladder is None:
            return self.cap + np.arange(self.base.width - 1.0)[:, None]
        return self.levels.totals[self.cap :, None]

    def threshold(self, price: float) -> FloatArray:
        """Total, in units, from which the last tail is followed at a price of failure, [nodes].

        -infinity where it is followed from the cap on, so that equal rules compare equal.
        """
        total = self.tails.threshold(price, self.charge) / self.base.unit
        total = np.ceil(total - 1e-9) if self.ladder is None else total
        return np.where(total <= self.end, -np.inf, total)

    def beyond(self, price: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(charge, failure, goal) of the tails that a price chooses beyond the cap.

        Returns:
            3 x [layers, nodes].
        """
        last = self.beyond_units >= self.threshold(price)[None, :]
        chosen, paid = self.tails.values.chosen(last), self.beyond_units * self.base.unit
        return self.charge.beyond(paid, chosen), chosen.failure, chosen.goal

    def measures_beyond(self, price: float) -> FloatArray:
        """The same, [layers, nodes, 3]."""
        return np.stack(self.beyond(price), axis=-1)

    def beyond_value(self, price: float, failing: float) -> FloatArray:
        """What the tails that a price chooses are worth at it, [layers, nodes].

        Args:
            price: kappa.
            failing: what failing counts: kappa, or 0 with -kappa for success.
        """
        charge, failure, goal = self.beyond(price)
        return charge + failing * failure - (price - failing) * goal

    def beyond_bound(self, failure_price: float, failing: float) -> FloatArray:
        """Lower bound of every policy's value beyond the cap, [layers, nodes].

        Every success is charged at least what it would be if it came at once: charge(r) * early +
        price * (1 - goal) with early = goal / gamma (mathematics, section 5: r + (kappa - r) F). It
        is exact where it is best to fail and possible.

        Args:
            failure_price: kappa.
            failing: what failing counts: kappa, or 0 with -kappa for success.
        """
        tails, totals = self.tails, self.levels.totals[self.cap :, None]
        paid = self.charge.at(totals) / self.base.survival
        goal = np.where(paid < failure_price, tails.greatest_goal, tails.least_goal)
        rest = failing * (1.0 - goal) - (failure_price - failing) * goal
        least = paid * goal
        if tails.greatest_moment is not None:
            least = self.charge.beyond(totals, tails.bounding(goal))
        if tails.least_cost is not None:
            least = least + self.charge.slope * tails.least_cost
        size = np.where(goal == 0, 0.0, (np.abs(paid) + failure_price) * MACHINE_EPSILON)
        return np.asarray(rest + least - 8.0 * size)

    def policy(self, choice: IntArray, tail_price: float) -> CostAwarePolicy:
        """Pull a choice back to the model.

        Args:
            choice: position among the pairs of its node, [cap, nodes].
            tail_price: the price of failure by which tails are chosen beyond the cap.
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
            levels=None if self.ladder is None else self.ladder.rungs,
        )


def materialise(process: LayeredProcess) -> ExplicitProcess:
    """Write all layers of the process out: state = layer * nodes + node.

    The layers beyond the cap that a step can reach follow, with one pair for each tail policy,
    so that the written-out process can do all that either tail can; the source state comes last.

    Args:
        process: the layered process.
    """
    base, n, cap = process.base, process.base.n_nodes, process.cap
    n_beyond = (len(process.levels.totals) - cap) * n
    n_states = cap * n + n_beyond + 1
    tails_cost, tails_failure, tails_goal = _tail_pairs(process)
    steps = _layer_steps(process, n_states)
    entry = sp.csr_array(
        (base.start, (np.zeros(n, dtype=np.int64), np.arange(n))), shape=(1, n_states)
    )
    cost = np.stack([process.charged(layer).total for layer in range(cap)])
    own_pairs = np.tile(np.diff(base.pair_offsets), cap)
    counts = np.concatenate([own_pairs, np.full(n_beyond, tails_cost.shape[1]), [1]])
    start = np.zeros(n_states)
    start[-1] = 1.0
    return ExplicitProcess(
        pair_offsets=np.concatenate([[0], np.cumsum(counts)]),
        transitions=sp.csr_array(
            sp.vstack([steps, sp.csr_array((tails_cost.size, n_states)), entry])
        ),
        start=start,
        cost=np.concatenate([cost.ravel(), tails_cost.ravel(), [process.start_charge]]),
        failure=np.concatenate(
            [np.tile(base.failure, cap), tails_failure.ravel(), [base.start_failure]]
        ),
        goal=np.concatenate(
            [np.tile(base.survival * base.gain, cap), tails_goal.ravel(), [base.start_goal]]
        ),
    )


def chosen_pairs(process: LayeredProcess, choice: IntArray, tail_price: float) -> IntArray:
    """The pair that a policy takes in each state of the written-out process, [states].

    Args:
        process: the layered process.
        choice: position among the pairs of its node, [cap, nodes].
        tail_price: the price of failure by which tails are chosen beyond the cap.
    """
    base, cap, n_tails = process.base, process.cap, len(process.tails.goal)
    within = np.arange(cap)[:, None] * len(base.gain) + base.pair_offsets[:-1] + choice
    last = (process.beyond_units >= process.threshold(tail_price)).ravel()
    beyond = cap * len(base.gain) + np.arange(last.size) * n_tails + last * (n_tails - 1)
    source = cap * len(base.gain) + last.size * n_tails
    return np.concatenate([within.ravel(), beyond, [source]])


def _layer_steps(process: LayeredProcess, n_states: int) -> sp.csr_array:
    """Transitions of the pairs of all layers of the process, [cap * pairs, states]."""
    base, n, cap = process.base, process.base.n_nodes, process.cap
    n_pairs, per_layer = len(base.gain), base.steps.nnz
    ahead, node = np.divmod(base.steps.indices.astype(np.int64), max(n, 1))
    columns = (process.levels.leads(base.width)[:, ahead] * n + node).ravel()
    row_ends = np.tile(base.steps.indptr[1:].astype(np.int64), cap)
    row_ends += np.repeat(np.arange(cap, dtype=np.int64) * per_layer, n_pairs)
    index = np.int32 if max(n_states, columns.size) <= np.iinfo(np.int32).max else np.int64
    indptr = np.concatenate([[0], row_ends]).astype(index)
    return sp.csr_array(
        (np.tile(base.steps.data, cap), columns.astype(index), indptr),
        shape=(cap * n_pairs, n_states),
    )


def _tail_pairs(process: LayeredProcess) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Charge, failure and goal mass of the tails beyond the layered process's cap.

    Returns:
        3 x [layers * nodes, tails].
    """
    tails = process.tails
    values = tails.values
    each = TailValues(
        values.goal.T, values.failure.T, values.early.T, values.cost.T, values.moment.T
    )
    cost = process.charge.beyond(process.levels.totals[process.cap :, None, None], each)
    all_three = (cost, *(np.broadcast_to(v[None], cost.shape) for v in (each.failure, each.goal)))
    failed, reached = (v.reshape(-1, cost.shape[-1]) for v in all_three[1:])
    return cost.reshape(-1, cost.shape[-1]), failed, reached
