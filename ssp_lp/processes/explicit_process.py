"""A substochastic process in explicit form, and its contraction at a vector of prices.

In a contraction components that are free at the prices become one state.

At prices some of which are 0 a process may hold end components that cost nothing though they cost
something in an unpriced row. They are free in the pricing problem (mathematics, section 4): every
state of such a component is worth the same. So a value function on the contracted process proves as
much as one on the process, a policy on it is one on the process that goes to the pair chosen, and
rounding has no cycle to go round in. Nobody may stay in one for ever by that: of the process only
pairs that stay are taken away, and none is added.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray, IntArray, offsets_of
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.dual_bound import DualBound, dual_bound, shortfall
from ssp_lp.dynamic_programming.dynamics import Dynamics, leaving_choice
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.errors import SolverError
from ssp_lp.model.graph import end_components, nearer_pairs, reached_along

_NOT_BEST = 1e-6  # excess, relative to the optimum, of pairs that no optimal measure uses
_LITTLE = 1e-5  # visits of such pairs that are noise of a solver


@dataclass(frozen=True, eq=False)
class ExplicitProcess:
    """A process from which goal, failure, giving up and discounting take mass out for good.

    The rows satisfy ``transitions.sum(axis=1) + goal + failure == 1``: what does not go on has
    reached the goal or counts as failure (mathematics, section 3).
    """

    pair_offsets: IntArray  # [states + 1]
    transitions: sp.csr_array  # [pairs, states]
    start: FloatArray  # [states]
    cost: FloatArray  # [pairs] non-negative
    failure: FloatArray  # [pairs] mass that fails
    goal: FloatArray  # [pairs] mass that reaches the goal

    @property
    def n_states(self) -> int:
        """Number of states of the explicit process."""
        return len(self.pair_offsets) - 1

    @property
    def n_pairs(self) -> int:
        """Number of pairs of the explicit process."""
        return len(self.cost)

    @cached_property
    def dynamics(self) -> Dynamics:
        """Dynamics of the explicit process, whatever it costs."""
        return Dynamics(self.pair_offsets, self.transitions, self.goal + self.failure)

    @cached_property
    def pair_state(self) -> IntArray:
        """The state of each pair of the explicit process, [pairs]."""
        return np.repeat(np.arange(self.n_states), np.diff(self.pair_offsets))


@dataclass(frozen=True, eq=False)
class ReachablePart:
    """The part of an explicit process that some policy comes to from the start."""

    process: ExplicitProcess  # on these states alone
    states: IntArray  # [its states] their numbers in the whole process, ascending
    pairs: IntArray  # [its pairs] likewise


def reachable_part(process: ExplicitProcess, start: FloatArray) -> ReachablePart:
    """Leave out the states of an explicit process that no policy comes to.

    Args:
        process: the whole process.
        start: the distribution to begin with, [states].
    """
    steps = process.transitions
    if not steps.data.all():
        steps = steps.copy()
        steps.eliminate_zeros()
    ends = steps.indptr[process.pair_offsets]
    reached = reached_along(steps.indices, ends, np.flatnonzero(start))
    states, pairs = np.flatnonzero(reached), np.flatnonzero(reached[process.pair_state])
    number = np.cumsum(reached, dtype=steps.indices.dtype) - 1
    rows = steps[pairs]
    part = ExplicitProcess(
        pair_offsets=offsets_of(np.diff(process.pair_offsets)[states]),
        transitions=sp.csr_array(
            (rows.data, number[rows.indices], rows.indptr), shape=(pairs.size, states.size)
        ),
        start=start[states],
        cost=process.cost[pairs],
        failure=process.failure[pairs],
        goal=process.goal[pairs],
    )
    return ReachablePart(part, states, pairs)


@dataclass(frozen=True, eq=False)
class Contraction:
    """The pairs of a process that leave its free components, sorted by node."""

    dynamics: Dynamics  # of the nodes
    pairs: IntArray  # [kept pairs] pair of the process
    node_of: IntArray  # [states]
    inside: BoolArray  # [pairs] of the process: pairs that stay in a component

    def least(self, values: FloatArray) -> FloatArray:
        """Least value over the explicit states of each contracted node, [nodes]."""
        result = np.full(self.dynamics.n_states, np.inf)
        np.minimum.at(result, self.node_of, values)
        return result

    def begun(self, process: ExplicitProcess, choice: IntArray) -> IntArray:
        """A policy that leaves the contraction, from one that leaves the explicit process, [nodes].

        Each node takes the pair of its state that is nearest to leaving, in number of steps: that
        pair leads out of the node, to a node that is nearer.

        Args:
            process: the process.
            choice: pair of the process, [states].
        """
        taken, distance = np.zeros(process.n_pairs, dtype=np.bool_), np.zeros_like(choice, np.int32)
        taken[choice] = True
        nearer_pairs(process.dynamics.graph, process.dynamics.exits > 0.0, taken, distance)
        order = np.argsort(distance, kind="stable")
        _, first = np.unique(self.node_of[order], return_index=True)
        place = np.full(process.n_pairs, -1)
        place[self.pairs] = np.arange(len(self.pairs))
        return place[choice[order[first]]]

    def expanded(self, process: ExplicitProcess, choice: IntArray) -> IntArray:
        """Policy on the explicit process that moves for free to the pairs chosen, [states].

        Args:
            process: the process.
            choice: pair of the contracted process, [nodes].
        """
        chosen = np.zeros(process.n_pairs, dtype=np.bool_)
        chosen[self.pairs[choice]] = True
        nearer = nearer_pairs(process.dynamics.graph, chosen, self.inside | chosen)
        return nearer.astype(np.int32)


def bound_of(
    process: ExplicitProcess,
    smaller: Contraction | None,
    pair_cost: FloatArray,
    values: FloatArray,
    floor: float = 0.0,
    choice: IntArray | None = None,
) -> DualBound:
    """Checked sub-solution of an explicit process, proved on its contraction.

    Args:
        process: the process.
        smaller: the process contracted at the cost, if there is anything to contract.
        pair_cost: [pairs].
        values: near-optimal ones, [states].
        floor: a constant that is known to be a sub-solution.
        choice: a policy of about these values, which leaves, [states].
    """
    # optimal where the cheapest way to end costs the same everywhere; lowering other values there
    # takes as many steps
    floor = max(floor, least_constant(process, pair_cost))
    if smaller is None:
        return dual_bound(process.dynamics, pair_cost, values, floor, choice)
    kept, least = pair_cost[smaller.pairs], smaller.least(values)
    bound = dual_bound(smaller.dynamics, kept, least, floor)
    return DualBound(bound.values[smaller.node_of], bound.low[smaller.node_of])


def least_constant(process: ExplicitProcess, pair_cost: FloatArray) -> float:
    """The greatest constant v with ``exit_u v <= c_u`` for every pair u of an explicit process.

    It is a sub-solution; -inf: none is, as a pair that does not end gains something.

    Args:
        process: the process.
        pair_cost: [pairs].
    """
    exits = process.dynamics.exits
    leaves = exits > 0.0
    if not leaves.any() or (pair_cost[~leaves] < 0.0).any():
        return -np.inf
    constant = float((pair_cost[leaves] / exits[leaves]).min())
    return constant - 4.0 * MACHINE_EPSILON * abs(constant)


def contract(process: ExplicitProcess, free: BoolArray) -> Contraction | None:
    """Contract the end components of an explicit process's pairs that cost nothing.

    Args:
        process: the process.
        free: pairs that cost nothing at the prices, [pairs].

    Returns:
        None where there are no such components.
    """
    free = free & (process.goal == 0.0) & (process.failure == 0.0)
    if not free.any():
        return None
    component, inside = end_components(process.dynamics.graph, free)
    if not inside.any():
        return None
    check_time()
    alone = component.max() + 1 + np.arange(process.n_states)
    component = np.where(component < 0, alone, component)
    _, node_of = np.unique(component, return_inverse=True)
    kept = (~inside).nonzero()[0]
    kept = kept[np.argsort(node_of[process.pair_state[kept]], kind="stable")]
    n_states, n_nodes = process.n_states, int(node_of.max()) + 1
    members = sp.csr_array(
        (np.ones(n_states), (np.arange(n_states), node_of)), shape=(n_states, n_nodes)
    )
    counts = np.bincount(node_of[process.pair_state[kept]], minlength=n_nodes)
    return Contraction(
        dynamics=Dynamics(
            pair_offsets=offsets_of(counts).astype(process.pair_offsets.dtype),
            transitions=sp.csr_array(process.transitions[kept] @ members),
            exits=process.dynamics.exits[kept],
        ),
        pairs=kept,
        node_of=node_of,
        inside=inside,
    )


@dataclass(frozen=True, eq=False)
class PricedMinimum:
    """The least expected total cost of a process, and a policy that attains it."""

    choice: IntArray  # [states]
    bound: float  # certified: no policy's is less
    goal: float  # what the policy reaches the goal with
    values: FloatArray  # [states] the least from each, the duals of balance
    excess: FloatArray  # [pairs] reduced costs: what each costs more than the best of its state

    def without_noise(self, visits: FloatArray) -> FloatArray:
        """Visits of an explicit process without those of pairs that are not optimal, [pairs].

        An interior point gives a little to every pair.
        """
        scale = 1.0 + abs(self.bound)
        noise = (self.excess > _NOT_BEST * scale) & (visits < _LITTLE)
        return np.where(noise, 0.0, visits)


def priced_minimum(process: ExplicitProcess, pair_cost: FloatArray) -> PricedMinimum:
    """Minimise a cost over all policies of an explicit process.

    Cycles that cost nothing are contracted first: rounding would find policies that stay there.

    Args:
        process: the process.
        pair_cost: [pairs]; where it is negative though the goal is not reached, the least may be
            unbounded, and its bound -inf.
    """
    reached = process.goal > 0.0
    floor = float((pair_cost[reached] / process.goal[reached]).min(initial=0.0))
    gainful = bool((pair_cost[~reached] < 0.0).any())  # no constant is known to be below
    leaving = leaving_choice(process.dynamics, process.goal)
    rewards, weights = np.stack([pair_cost, process.goal], axis=1), np.array([1.0, 0.0])
    smaller = contract(process, pair_cost == 0.0)
    try:
        if smaller is None:
            settled = iterate_policy(process.dynamics, rewards, weights, leaving)
            choice, totals = settled.choice, settled.totals
        else:
            begun = smaller.begun(process, leaving)
            settled = iterate_policy(smaller.dynamics, rewards[smaller.pairs], weights, begun)
            choice = smaller.expanded(process, settled.choice)
            totals = settled.totals[smaller.node_of]
    except SolverError:
        nothing = np.zeros(process.n_states), np.zeros(process.n_pairs)
        return PricedMinimum(leaving, -np.inf if gainful else floor, 0.0, *nothing)
    values, goal = totals[:, 0], float(process.start @ totals[:, 1])
    floor = -4.0 * float(np.abs(values).max(initial=0.0)) if gainful else floor
    below = bound_of(process, smaller, pair_cost, values, floor)
    bound = below.at(process.start)
    if (
        gainful
        and not below.low.any()
        and shortfall(process.dynamics, pair_cost, below.values).any()
    ):
        bound = -np.inf
    excess = pair_cost + process.transitions @ values - values[process.pair_state]
    return PricedMinimum(choice, bound, goal, values, excess)
