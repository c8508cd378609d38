"""What a solver's duals prove: a lower bound of the program's optimum, recomputed.

For prices l >= 0 of the rows <q, x> <= b every measure satisfies ``<cost, x> >= <cost + l q, x> -
l b``, and what is minimised there has no rows but balance: policy iteration finds its optimum, and
a checked sub-solution bounds it. In case S, with the dual c of the normaliser, the same is done for
``cost - c goal``: where that cannot fall below D <= 0, no ratio lies below ``c + D / g`` for the
least goal probability g that the rows leave.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.dynamic_programming.dynamics import leaving_choice
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.errors import SolverError
from ssp_lp.processes.contraction import bound_of, contract
from ssp_lp.processes.explicit import ExplicitProcess

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
        pair_cost: negative only where the goal is reached, [pairs].
    """
    reached = process.goal > 0.0
    floor = float((pair_cost[reached] / process.goal[reached]).min(initial=0.0))
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
        return PricedMinimum(leaving, floor, 0.0, *nothing)
    values, goal = totals[:, 0], float(process.start @ totals[:, 1])
    bound = bound_of(process, smaller, pair_cost, values, floor).at(process.start)
    excess = pair_cost + process.transitions @ values - values[process.pair_state]
    return PricedMinimum(choice, bound, goal, values, excess)
