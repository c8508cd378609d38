"""An explicit substochastic process, and its contraction at a vector of prices.

An end component is *free* at the prices if its pairs cost nothing there. If some prices are 0, it
may be free although it adds to a row of price 0. A contraction merges each free end component to
one state:

- All states of a free end component have the same value (mathematics, section 4). A value function
  on the contraction therefore proves the same bound as one on the process.
- A policy on the contraction chooses one pair for a whole component. On the process it first moves,
  at no cost, to the state of this pair.
- Policy iteration on the process could go round in a free cycle because of rounding. The
  contraction has no such cycles.

A contraction removes only pairs that stay in a component. No policy may stay there for ever.
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

_NOT_BEST = 1e-6  # reduced cost, relative to the optimum, of a pair that is not optimal
_LITTLE = 1e-5  # visits of such a pair that are noise of a solver


@dataclass(frozen=True, eq=False)
class ExplicitProcess:
    """A process whose runs end by reaching the goal or by failing, which includes giving up.

    Each row satisfies ``transitions.sum(axis=1) + goal + failure == 1``: mass that leaves the
    process has reached the goal or has failed. With a discount, the mass that each step loses
    counts as failure (mathematics, section 3).
    """

    pair_offsets: IntArray  # [states + 1]
    transitions: sp.csr_array  # [pairs, states]
    start: FloatArray  # [states]
    cost: FloatArray  # [pairs] non-negative
    failure: FloatArray  # [pairs] mass that fails
    goal: FloatArray  # [pairs] mass that reaches the goal

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.pair_offsets) - 1

    @property
    def n_pairs(self) -> int:
        """Number of pairs."""
        return len(self.cost)

    @cached_property
    def dynamics(self) -> Dynamics:
        """Transitions of the process by pair, and the mass of each pair that ends; no costs."""
        return Dynamics(self.pair_offsets, self.transitions, self.goal + self.failure)

    @cached_property
    def pair_state(self) -> IntArray:
        """The state of each pair, [pairs]."""
        return np.repeat(np.arange(self.n_states), np.diff(self.pair_offsets))


@dataclass(frozen=True, eq=False)
class ReachablePart:
    """The part of an explicit process that is reachable from the start."""

    process: ExplicitProcess  # on the reachable states
    states: IntArray  # [its states] their indices in the whole process, ascending
    pairs: IntArray  # [its pairs] their indices in the whole process, ascending


def reachable_part(process: ExplicitProcess, start: FloatArray) -> ReachablePart:
    """Remove the unreachable states of an explicit process.

    Args:
        process: the whole process.
        start: the start distribution, [states].
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
    """A process in which each free end component is merged to one node.

    The pairs inside these components are removed. The other pairs are sorted by node.
    """

    dynamics: Dynamics  # of the nodes
    pairs: IntArray  # [kept pairs] pair of the process
    node_of: IntArray  # [states]
    inside: BoolArray  # [pairs] pairs of the process that stay in a component

    def least(self, values: FloatArray) -> FloatArray:
        """Return the least value over the states of each node, [nodes]."""
        result = np.full(self.dynamics.n_states, np.inf)
        np.minimum.at(result, self.node_of, values)
        return result

    def contracted_policy(self, process: ExplicitProcess, choice: IntArray) -> IntArray:
        """Translate a policy of the process to one of the contraction, [nodes].

        Each node takes the policy's pair in the member from which this policy needs the fewest
        steps to end a run. Under both policies every run ends.

        Args:
            process: the process.
            choice: a policy of the process by which every run ends: the pair of each state,
                [states].
        """
        taken, distance = np.zeros(process.n_pairs, dtype=np.bool_), np.zeros_like(choice, np.int32)
        taken[choice] = True
        nearer_pairs(process.dynamics.graph, process.dynamics.exits > 0.0, taken, distance)
        order = np.argsort(distance, kind="stable")
        _, first = np.unique(self.node_of[order], return_index=True)
        place = np.full(process.n_pairs, -1)
        place[self.pairs] = np.arange(len(self.pairs))
        return place[choice[order[first]]]

    def expanded_policy(self, process: ExplicitProcess, choice: IntArray) -> IntArray:
        """Translate a policy of the contraction to one of the process, [states].

        Within a free end component the policy moves, at no cost, to the state of the chosen pair.

        Args:
            process: the process.
            choice: the contraction's pair of each node, [nodes].
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
    floor: float = -np.inf,
    choice: IntArray | None = None,
) -> DualBound:
    """Return checked lower bounds of the least expected total cost from each state.

    The given values are lowered until a Bellman backup confirms that they are lower bounds.

    Args:
        process: the process.
        smaller: the contraction of end components of cost 0; None: there are none.
        pair_cost: [pairs].
        values: near-optimal values, [states].
        floor: a constant known to be a lower bound in every state.
        choice: a policy with about these values, by which every run ends, [states]; None: unknown.
    """
    # the least constant is optimal if the cheapest way to end costs the same everywhere;
    # lowering other values to it would take many steps
    floor = max(floor, least_constant(process, pair_cost))
    if smaller is None:
        return dual_bound(process.dynamics, pair_cost, values, floor, choice)
    kept, least = pair_cost[smaller.pairs], smaller.least(values)
    bound = dual_bound(smaller.dynamics, kept, least, floor)
    return DualBound(bound.values[smaller.node_of], bound.low[smaller.node_of])


def least_constant(process: ExplicitProcess, pair_cost: FloatArray) -> float:
    """Return a constant that is a lower bound of the cost from every state.

    It is the greatest v with ``exit_u v <= c_u`` for every pair u, where ``exit_u`` is the mass
    that ends. It is at least 0 if no cost is negative, and -inf if a pair that ends no mass has a
    negative cost.

    Args:
        process: the process.
        pair_cost: c, [pairs].
    """
    exits = process.dynamics.exits
    leaves = exits > 0.0
    if (pair_cost[~leaves] < 0.0).any():
        return -np.inf
    constant = float((pair_cost[leaves] / exits[leaves]).min(initial=np.inf))
    return 0.0 if constant == np.inf else constant - 4.0 * MACHINE_EPSILON * abs(constant)


def contract(process: ExplicitProcess, free: BoolArray) -> Contraction | None:
    """Merge each end component of pairs that cost nothing to one node.

    Args:
        process: the process.
        free: pairs that cost nothing at the prices, [pairs].

    Returns:
        The contraction; None if these pairs have no end component.
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
    bound: float  # certified lower bound of every policy's cost
    goal: float  # goal probability of the policy
    values: FloatArray  # [states] least cost from each state, the duals of flow balance
    excess: FloatArray  # [pairs] reduced costs

    def without_noise(self, visits: FloatArray) -> FloatArray:
        """Return visits, [pairs], in which small visits of suboptimal pairs are replaced by 0.

        Interior-point solvers give such visits to every pair.
        """
        scale = 1.0 + abs(self.bound)
        noise = (self.excess > _NOT_BEST * scale) & (visits < _LITTLE)
        return np.where(noise, 0.0, visits)


def priced_minimum(process: ExplicitProcess, pair_cost: FloatArray) -> PricedMinimum:
    """Minimise a cost over all policies of an explicit process.

    Free end components are contracted first, because rounding could make policies stay there for
    ever.

    Args:
        process: the process.
        pair_cost: [pairs]; if it is negative for a pair that does not reach the goal, the minimum
            may be unbounded, with bound -inf.
    """
    gainful = bool((pair_cost[process.goal == 0.0] < 0.0).any())  # without a constant lower bound
    leaving = leaving_choice(process.dynamics, process.goal)
    rewards, weights = np.stack([pair_cost, process.goal], axis=1), np.array([1.0, 0.0])
    smaller = contract(process, pair_cost == 0.0)
    try:
        if smaller is None:
            settled = iterate_policy(process.dynamics, rewards, weights, leaving)
            choice, totals = settled.choice, settled.totals
        else:
            begun = smaller.contracted_policy(process, leaving)
            settled = iterate_policy(smaller.dynamics, rewards[smaller.pairs], weights, begun)
            choice = smaller.expanded_policy(process, settled.choice)
            totals = settled.totals[smaller.node_of]
    except SolverError:
        nothing = np.zeros(process.n_states), np.zeros(process.n_pairs)
        least = -np.inf if gainful else least_constant(process, pair_cost)
        return PricedMinimum(leaving, least, 0.0, *nothing)
    values, goal = totals[:, 0], float(process.start @ totals[:, 1])
    floor = -4.0 * float(np.abs(values).max(initial=0.0)) if gainful else -np.inf
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
