"""The answer to an occupation-measure program: visits, duals, and the policies they make."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.dynamic_programming.leaving import leaving_choice
from ssp_lp.errors import ModelError
from ssp_lp.model.naming import ByName
from ssp_lp.policies.mixed import MixedPolicy
from ssp_lp.policies.stochastic import StochasticPolicy
from ssp_lp.programs.decomposition import balanced_visits, decomposed

if TYPE_CHECKING:
    from ssp_lp.programs.occupation_program import OccupationProgram


_BALANCED = 1e-9  # imbalance of visits that are taken as a policy's own
_BEYOND = 1e-9  # probability of passing the last total from which it is told


class Told(NamedTuple):
    """What a solver said besides the visits, scaled as the program is."""

    prices: Mapping[str, float]  # of the rows, by name, >= 0
    ratio: float  # of case S: the normaliser's dual
    scale: float  # of case S: t
    solver: str
    status: str
    seconds: float

    def measure(
        self,
        program: OccupationProgram,
        visits: FloatArray,
        value: float | None = None,
        values: FloatArray | None = None,
    ) -> OccupationMeasure:
        """Visits as a measure, with the optimum that the duals prove, and those of balance."""
        duals = {name: price * self.scale for name, price in self.prices.items()}
        told = self.solver, self.status, self.seconds
        return OccupationMeasure(program, visits, duals, value, *told, values)


@dataclass(frozen=True, eq=False, repr=False)
class OccupationMeasure:
    """Expected visits of every pair of the process, with what the solver said besides.

    A solver's word is not taken: the visits are those of the policy that its answer makes, to
    rounding; objective, activity and residual are recomputed from them and the program. The
    residual says by how much a row is exceeded, which a solver's tolerance allows.
    """

    program: OccupationProgram
    visits: FloatArray  # [pairs] expected number of times that each is taken
    duals: Mapping[str, float]  # price of each row: how much a unit of its bound improves
    optimal_value_from_dual: float | None  # c*; None where rows or objectives were added
    solver: str
    status: str
    seconds: float
    values: FloatArray | None = None  # [process states] duals of balance; None: as of c*
    reduced: OccupationMeasure | None = None  # where it was found on the reduced program

    def __post_init__(self) -> None:
        object.__setattr__(self, "duals", ByName(self.duals))

    @cached_property
    def objective(self) -> float:
        """The program's objective at these visits."""
        process = self.program.process
        cost = float(process.cost @ self.visits)
        cost = cost / float(process.goal @ self.visits) if self.program.ratio else cost
        return self.program.sense.worth(cost)

    @cached_property
    def activity(self) -> Mapping[str, float]:
        """What is spent of each row's quantity, by name."""
        rows = self.program.rows
        return ByName({row.name: float(row.coefficients @ self.visits) for row in rows})

    @cached_property
    def imbalance(self) -> float:
        """By how much flow balance or x >= 0 is violated at most."""
        process = self.program.process
        outflow = np.bincount(process.pair_state, weights=self.visits, minlength=process.n_states)
        off = np.abs(outflow - process.transitions.T @ self.visits - process.start).max(initial=0.0)
        return max(float(off), float((-self.visits).max(initial=0.0)), 0.0)

    @property
    def residual(self) -> float:
        """By how much flow balance, x >= 0 or, relative to its bound, a row is violated at most."""
        over = [row.violation(self.activity[row.name]) for row in self.program.rows]
        return max(self.imbalance, *over, 0.0)

    def value(self, state: Hashable, cost: float | None = None) -> float:
        """The dual of a state's balance: the least that can follow, at the prices of the rows.

        The sum over the start, less price times bound of each row, is c*. In case S what follows is
        the cost less c* times the goal's probability, so that the same sum is 0; prices are those
        of the scaled program, ``duals`` for each success.

        Args:
            state: a state in which the problem is open.
            cost: in case S the cost paid before, one that the program tells apart.

        Raises:
            ModelError: no such state, or none that the program has, or nothing is known of duals.
        """
        if self.values is None:
            raise ModelError("nothing is known of duals where rows or objectives were added")
        program = self.program
        columns = [k for k in program.columns(state) if cost in (None, program.label(k).cost)]
        rows = np.unique(program.process.pair_state[columns].astype(np.int64))
        if len(rows) != 1:
            raise ModelError(
                f"state {state!r} has {len(rows):,} rows of balance at this cost: one is asked for"
            )
        return float(self.values[rows[0]])

    @property
    def beyond(self) -> float:
        """Probability of succeeding at a cost beyond those that the program tells apart.

        Such successes are charged as if the last of them had just been reached, too little; a
        greater ``cost_cap`` of the problem tells more apart.
        """
        augmented = self.program.augmented
        if augmented.copies == 1:
            return 0.0
        width = len(augmented.quotient.pair_at)
        last = slice((augmented.copies - 1) * width, augmented.copies * width)
        return float(self.program.process.goal[last] @ self.visits[last])

    @property
    def gap(self) -> float:
        """Distance of the objective from what the duals prove, relative; nan without a proof."""
        if self.optimal_value_from_dual is None:
            return float("nan")
        return abs(self.objective - self.optimal_value_from_dual) / max(abs(self.objective), 1.0)

    @cached_property
    def balanced(self) -> FloatArray:
        """Visits of the policy that draws each pair with its share of these, [pairs].

        Equal to them where they balance, but for what goes round and is never come to.

        Raises:
            SolverError: the policy never leaves.
        """
        process = self.program.process
        otherwise = leaving_choice(process.dynamics, process.goal)
        return balanced_visits(process, self.visits, otherwise)

    def randomised_policy(self) -> StochasticPolicy:
        """The policy that draws each action with its share of the visits: x / outflow.

        It lives on the model's states with the memory of the process, and visits every pair as
        often as the measure says (paper, section 2.2).

        Raises:
            ModelError: case S, and the measure follows both tails from one accumulated cost.
        """
        process = self.program.process
        return self.program.augmented.randomised_policy(
            self.visits, leaving_choice(process.dynamics, process.goal)
        )

    def mixed_policy(self) -> MixedPolicy:
        """The same visits as a lottery over deterministic policies, drawn once at the start.

        Where the measure is a vertex of the program there is at most one more member than there
        are rows met with equality; else finitely many. Of an optimal measure objective and failure
        are kept. Secondary costs, and the cost of a measure that other objectives or rows made, may
        come out lower: visits that go round for ever belong to no deterministic policy that
        leaves, and a member that cannot reach the goal any more has failed and pays no more.

        Raises:
            SolverError: no policy that leaves has such visits.
        """
        if self.reduced is not None:
            return self.reduced.mixed_policy()
        visits = self.visits if self.imbalance <= _BALANCED else self.balanced
        choices, weights = decomposed(self.program.process, visits)
        return MixedPolicy(tuple(self.program.augmented.policy(c) for c in choices), weights)

    def __repr__(self) -> str:
        """The objective, and each row with what is spent and its price."""
        lines = [f"objective {self.objective:.9g}   ({self.solver}: {self.status})"]
        for row in self.program.rows:
            spent, price = self.activity[row.name], self.duals.get(row.name)
            told = "" if price is None else f"   price {price:.6g}"
            lines.append(f"  {row.name}: {spent:.9g} <= {row.bound:g}{told}")
        if self.beyond > _BEYOND:
            lines.append(
                f"  {self.beyond:.3g} succeed beyond the last total that is told apart, charged "
                "as if there: a greater cost_cap tells more"
            )
        return "\n".join(lines)
