"""scikit-decide's heuristic searches on the augmented process, without a heuristic.

CIDual (Trevizan et al. 2016) answers case M, GPCI (Teichteil-Konigsbuch 2012) case P, and ILAO*
(Hansen and Zilberstein 2001) case C. Every state is a number, and each mass that leaves the
process leads to the goal or, by failing, to an end of its own:

- In case M both ends are goals, and the mass that fails is the secondary cost, limited by the
  budget.
- In case P failing is an end that is no goal.
- In case C failing costs `_DEAR`, so that a policy that reaches the goal surely is better.

Transitions are Python objects: the time of a call is mostly that of making them.
"""

import math
from typing import Any

import numpy as np
from skdecide import DiscreteDistribution, Domain, EnumerableSpace, ImplicitSpace, Value
from skdecide.builders.domain import (
    Actions,
    Constrained,
    EnumerableTransitions,
    FullyObservable,
    Goals,
    Markovian,
    PositiveCosts,
    Sequential,
    SingleAgent,
)
from skdecide.core import BoundConstraint
from skdecide.hub.solver.gpci import GPCI
from skdecide.hub.solver.idual import CIDual
from skdecide.hub.solver.ilaostar import ILAOstar

from examples.solver_comparison.instances.models import ReadyInstance
from examples.solver_comparison.solvers.answer import Answer, Prepared, joined
from examples.solver_comparison.solvers.catalogue import Order
from examples.solver_comparison.solvers.explicit import describe, size_of, written_out
from ssp_lp.processes.explicit_process import ExplicitProcess

_DEAR = 1e6  # cost of failing where the goal must be reached surely
_NO_VALUE = "no value: its utility has the limit's price in it, its policy no rare states"
_EPSILON = 1e-6  # residual at which ILAO* and GPCI stop


def prepare(ready: ReadyInstance, order: Order) -> Prepared:
    """Prepare to solve an instance with the solver of its case; it has no time limit."""
    process, asked = written_out(ready), ready.instance

    def call() -> Answer:
        def domain() -> WrittenOut:
            return WrittenOut(process, asked.case, asked.failure_budget)

        start = process.n_states + 2
        if asked.case == "M":
            with CIDual(domain_factory=domain) as search:
                search.solve(from_memory=start)
                return Answer(math.nan, note=_NO_VALUE)
        if asked.case == "P":
            with GPCI(domain_factory=domain, epsilon=_EPSILON) as search:
                search.solve(from_memory=start)
                return Answer(search.get_goal_probability(start))
        with ILAOstar(domain_factory=domain, epsilon=_EPSILON) as search:
            search.solve(from_memory=start)
            return Answer(search.get_utility(start).cost)

    return Prepared(call, note=joined("no heuristic", size_of(process)), details=describe(process))


class WrittenOut(
    Domain,
    SingleAgent,
    Sequential,
    EnumerableTransitions,
    Actions,
    Goals,
    Markovian,
    FullyObservable,
    PositiveCosts,
    Constrained,
):
    """A process as a domain: states 0, ..., n - 1, the goal n, failure n + 1 and a source n + 2."""

    T_state = int
    T_observation = int
    T_event = int
    T_value = float
    T_predicate = bool
    T_info = None

    def __init__(self, process: ExplicitProcess, case: str, budget: float) -> None:
        self.process, self.case, self.budget = process, case, budget
        self.n = process.n_states

    def _get_next_state_distribution(self, memory: int, action: int) -> Any:
        process, n = self.process, self.n
        if memory >= n:
            begun = process.start if memory == n + 2 else np.zeros(0)
            ends = [(int(s), float(begun[s])) for s in np.flatnonzero(begun)]
            return DiscreteDistribution(ends or [(memory, 1.0)])
        row = slice(process.transitions.indptr[action], process.transitions.indptr[action + 1])
        steps = process.transitions
        outcomes = list(zip(steps.indices[row].tolist(), steps.data[row].tolist(), strict=True))
        ends = (n, float(process.goal[action])), (n + 1, float(process.failure[action]))
        return DiscreteDistribution([*outcomes, *(end for end in ends if end[1] > 0.0)])

    def _get_transition_value(
        self, memory: int, action: int, next_state: int | None = None
    ) -> Value[float]:
        if memory >= self.n:
            return Value(cost=0.0)
        lost = _DEAR * float(self.process.failure[action]) if self.case == "C" else 0.0
        return Value(cost=float(self.process.cost[action]) + lost)

    def _is_transition_value_dependent_on_next_state_(self) -> bool:
        return False

    def _is_terminal(self, state: int) -> bool:
        return state in (self.n, self.n + 1)

    def _get_action_space_(self) -> Any:
        return ImplicitSpace(lambda _: True)

    def _get_applicable_actions_from(self, memory: int) -> Any:
        if memory >= self.n:
            return Listed([-1] if memory == self.n + 2 else [])
        offsets = self.process.pair_offsets
        return Listed(range(int(offsets[memory]), int(offsets[memory + 1])))

    def _get_goals_(self) -> Any:
        return ImplicitSpace(
            lambda state: state == self.n or (state == self.n + 1 and self.case != "P")
        )

    def _get_initial_state_(self) -> int:
        return self.n + 2

    def _get_observation_space_(self) -> Any:
        return ImplicitSpace(lambda _: True)

    def _get_constraints_(self) -> list[Any]:
        def failing(memory: int, action: int, next_state: int | None = None) -> float:
            return float(self.process.failure[action]) if memory < self.n else 0.0

        return [BoundConstraint(failing, "<=", self.budget, depends_on_next_state=False)]


class Listed(EnumerableSpace):
    """A finite space of actions, in the form that scikit-decide asks for."""

    def __init__(self, actions: Any) -> None:
        self.actions = list(actions)

    def get_elements(self) -> Any:
        """Return the actions."""
        return self.actions

    def contains(self, x: int) -> bool:
        """Return whether a number is one of the actions."""
        return x in self.actions
