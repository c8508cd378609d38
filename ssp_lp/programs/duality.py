"""What duals prove of a program's optimum, recomputed, and its value function.

For prices l >= 0 of the rows <q, x> <= b every measure satisfies ``<cost, x> >= <cost + l q, x> -
l b``, and what is minimised there has no rows but balance: policy iteration finds its optimum, and
a checked sub-solution bounds it. In case S, with the dual c of the normaliser, the same is done for
``cost - c goal``: where that cannot fall below D <= 0, no ratio lies below ``c + D / g`` for the
least goal probability g that the rows leave.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.dynamic_programming.dual_bound import shortfall
from ssp_lp.dynamic_programming.dynamics import leaving_choice
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.processes.contraction import bound_of, contract
from ssp_lp.processes.explicit import ExplicitProcess

if TYPE_CHECKING:
    from ssp_lp.programs.occupation_program import OccupationProgram

_NOT_BEST = 1e-6  # excess, relative to the optimum, of pairs that no optimal measure uses
_LITTLE = 1e-5  # visits of such pairs that are noise of a solver


@dataclass(frozen=True, eq=False)
class PricedMinimum:
    """The least expected total cost of a process, and a policy that attains it."""

    choice: IntArray  # [states]
    bound: float  # certified: no policy's is less
    goal: float  # what the policy reaches the goal with
    values: FloatArray  # [states] the least from each, the duals of balance
    excess: FloatArray  # [pairs] reduced costs: what each costs more than the best of its state

    def without_noise(self, visits: FloatArray) -> FloatArray:
        """A solver's visits without those of pairs that are not optimal, [pairs].

        An interior point gives a little to every pair.
        """
        scale = 1.0 + abs(self.bound)
        noise = (self.excess > _NOT_BEST * scale) & (visits < _LITTLE)
        return np.where(noise, 0.0, visits)


def priced_minimum(process: ExplicitProcess, pair_cost: FloatArray) -> PricedMinimum:
    """Minimise a cost over all policies.

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


@dataclass(frozen=True, eq=False)
class StateValues:
    """The least that can follow, what each row counts charged at its price.

    ``values["depot"]`` is a state's value. Over the start they sum to c* plus price times bound of
    each row. In case S what follows is the cost less c* times the goal's probability, so that the
    sum is price times bound alone.
    """

    program: OccupationProgram
    states: FloatArray  # [process states]
    reduced_costs: FloatArray  # [pairs] what each costs more than the best of its state

    def __getitem__(self, state: Hashable) -> float:
        """A state's value."""
        return self.at(state)

    def at(
        self, state: Hashable, action: Hashable | None = None, cost: float | None = None
    ) -> float:
        """A state's value; with an action, the least that follows where that is taken first.

        Args:
            state: a state in which the problem is open.
            action: one of its actions, ``GIVE_UP`` or ``"stay for ever"``.
            cost: in case S the cost paid before, one that the program tells apart.

        Raises:
            ModelError: no such state or action, or none that the program has.
        """
        if action is not None:
            return self.at(state, cost=cost) + self.advantage(state, action, cost)
        program = self.program
        columns = [k for k in program.columns(state) if cost in (None, program.label(k).cost)]
        rows = np.unique(program.process.pair_state[columns].astype(np.int64))
        if len(rows) != 1:
            like = map(program.label, columns[:1])
            such = "".join(f", such as that of {label.state!r}{label.paid}" for label in like)
            told = f"state {state!r} has {len(rows):,} rows of balance at this cost"
            raise ModelError(f"{told}: one is asked for{such}")
        return float(self.states[rows[0]])

    def advantage(self, state: Hashable, action: Hashable, cost: float | None = None) -> float:
        """What an action costs more than the best one of its state: 0 of those that are optimal.

        Raises:
            ModelError: no such column, or several.
        """
        return float(self.reduced_costs[self.program.column(state, action, cost)])
