"""Solutions of occupation-measure programs: visits, duals, and the policies they describe."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    RESIDUAL,
    BoolArray,
    FloatArray,
    IntArray,
    first_minimisers,
    segment_minima,
    segment_sums,
)
from ssp_lp.dynamic_programming.dynamics import leaving_choice
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.errors import ModelError, SolverError, optional_module
from ssp_lp.linear_programming.linear_program import MeasuredRow
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import nearer_pairs
from ssp_lp.model.report import ByName
from ssp_lp.policies.policy import MixedPolicy, StochasticPolicy
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.programs.augmented import ColumnLabel

if TYPE_CHECKING:
    from ssp_lp.programs.occupation_program import OccupationProgram

ROUNDING: Final = 1e-9
"""Rounding of an optimum, up to which numbers count as 0.

These are visits and shares of visits; reduced costs, relative to the greatest value; excesses over
a row, relative to its greatest coefficient; and probabilities.
"""

_LEVELS = (1e-8, 1e-7, 1e-6)
NOISES = (
    (ROUNDING, 0.0),
    *((level, 0.0) for level in _LEVELS),
    *zip(_LEVELS, _LEVELS, strict=True),
)
"""Noise levels to try: outflow of a state, and share of it, up to which visits count as 0."""

_DUST = 1e-12  # share of a state's visits, or of all weight, below which the rest is rounding
_ROUNDED = 1e-15  # share of a state's visits that is left by subtraction
_ABOVE = 10.0  # visits count from this multiple of rounding on
_WRONG = 1e-8  # share of a state's visits by which members may exceed the measure
_BALANCED = 1e-13  # imbalance up to which visits count as those of a policy
_LISTED = 20  # number of rows that are printed


@dataclass(frozen=True, eq=False, repr=False)
class OccupationMeasure:
    """Expected visits of every pair of the process, with the prices and the status of the solver.

    Up to rounding, they are the visits of the policy that the solver's answer describes. Objective,
    activities (left sides of rows) and residual (largest violation of a row) are recomputed from
    the visits and the program.
    """

    program: OccupationProgram
    visits: FloatArray  # [pairs] expected number of times that each pair is taken
    prices: Mapping[str, float]  # multiplier of each row, as ``Solution.prices``
    optimal_value_from_dual: float | None  # c*, as proved by the duals of all rows
    solver: str
    status: str
    seconds: float
    values: StateValues | None = None  # duals of balance; None if they are not known
    reduced: OccupationMeasure | None = None  # of the reduced program, if that was solved
    own: tuple[MeasuredRow, ...] = ()  # rows that the user added
    minimised: float | None = None  # value of the user's objective, if it was changed
    basis: BoolArray | None = None  # basis at a vertex: [columns + rows] of the solved program

    @cached_property
    def rows(self) -> tuple[MeasuredRow, ...]:
        """Rows of the program with activity, price and dual, followed by rows that the user added.

        In case S the price is a multiplier of the ratio: for every policy, c* is at most ``cost +
        price * (spent - bound)`` divided by the goal probability. The dual is the improvement of c*
        per unit of the bound: the price divided by the goal probability. With goal probability 0
        there are neither c* nor duals.
        """
        success = self._goal if self.program.ratio else 1.0
        stated = []
        for row in self.program.rows:
            price = self.prices.get(row.name)
            dual = None if price is None or success <= 0.0 else price / success
            spent = float(row.coefficients @ self.visits)
            stated.append(MeasuredRow(row.name, spent, row.bound, "<=", price, dual))
        return *stated, *self.own

    @cached_property
    def duals(self) -> Mapping[str, float]:
        """Dual of each row, by name: improvement of c* per unit of the bound."""
        return ByName({row.name: row.dual for row in self.rows if row.dual is not None})

    @cached_property
    def activity(self) -> Mapping[str, float]:
        """Activity (value of the left side) of each row, by name."""
        return ByName({row.name: row.spent for row in self.rows})

    @cached_property
    def slack(self) -> Mapping[str, float]:
        """Slack of each row, by name."""
        return ByName({row.name: row.slack for row in self.rows})

    @property
    def _goal(self) -> float:
        """Goal probability; discounted if the problem has a discount."""
        return float(self.program.process.goal @ self.visits)

    @cached_property
    def objective(self) -> float:
        """The program's objective; infinite in case S if the goal probability is 0."""
        cost, goal = float(self.program.process.cost @ self.visits), self._goal
        if self.program.ratio:
            cost = cost / goal if goal > 0.0 else np.inf
        return self.program.sense.stated(cost)

    @cached_property
    def imbalance(self) -> float:
        """Largest violation of flow balance or of x >= 0, in visits."""
        process = self.program.process
        outflow = np.bincount(process.pair_state, weights=self.visits, minlength=process.n_states)
        off = np.abs(outflow - process.transitions.T @ self.visits - process.start).max(initial=0.0)
        return max(float(off), float((-self.visits).max(initial=0.0)), 0.0)

    @property
    def residual(self) -> float:
        """Largest violation of flow balance, of x >= 0, or (relative to its bound) of a row."""
        over = [row.violation(self.activity[row.name]) for row in self.program.rows]
        return max(self.imbalance, *over, 0.0)

    @property
    def beyond(self) -> float:
        """Probability of reaching the goal from an accumulated cost above the program's cap.

        The program underestimates the cost of these runs, as it charges them the cap only. If the
        probability is not small, give the problem a greater ``cost_cap``.
        """
        return float(self.program.process.goal @ (self.visits * self.program.augmented.is_late))

    @property
    def gap(self) -> float:
        """Relative gap between the objective and the proved bound; nan without a bound."""
        if self.optimal_value_from_dual is None:
            return float("nan")
        value = self.objective if self.minimised is None else self.minimised
        return abs(value - self.optimal_value_from_dual) / max(abs(value), 1.0)

    def balanced(self, noise: tuple[float, float] = NOISES[0]) -> OccupationMeasure:
        """Return the measure of the policy that these visits describe.

        In each state the policy draws a pair in proportion to the pair's visits. If the visits
        satisfy flow balance, the result differs from them only by visits of endless cycles, which
        the policy never enters.

        Args:
            noise: visits up to these two limits count as 0: the total visits of a state, and the
                share of a pair in its state's visits.
        """
        process = self.program.process
        otherwise = leaving_choice(process.dynamics, process.goal)
        visits = balanced_visits(process, self.visits, otherwise, noise=noise)
        return replace(self, visits=visits)

    def randomised_policy(self) -> StochasticPolicy:
        """Return the randomised policy that draws each pair with probability x / outflow.

        The policy acts on the model's states with the memory of the process, and visits every pair
        as often as the measure says (paper, section 2.2).

        Raises:
            ModelError: case S, and the measure mixes, from one accumulated cost, the two policies
                that are possible above the cap.
        """
        process = self.program.process
        return self.program.augmented.randomised_policy(
            self.visits, leaving_choice(process.dynamics, process.goal)
        )

    def mixed_policy(self) -> MixedPolicy:
        """Return a lottery over deterministic policies, drawn at the start, with these visits.

        If the measure is a vertex of the program, there is at most one member more than there are
        rows that hold with equality; otherwise there may be more members.

        If the measure is optimal, the lottery has the same objective and failure. Its secondary
        costs may be lower than those of the measure; so may its cost, if the measure was found with
        another objective or other rows. There are two reasons: visits of endless cycles are left
        out, and a policy that can no longer reach the goal has failed, and pays nothing more.

        If the visits satisfy flow balance only within a solver's tolerance, visits up to a noise
        level are set to 0. The level is the smallest one at which they are the visits of a policy.

        Raises:
            SolverError: no policy that ends every run has such visits, or the lottery violates a
                row by more than the measure does.
        """
        if self.reduced is not None:
            return self.reduced.mixed_policy()
        process, refusal = self.program.process, ""
        for noise in (None,) if self.imbalance <= _BALANCED else NOISES:
            try:
                taken = self if noise is None else self.balanced(noise)
                choices, weights, followed = _decomposed(process, taken.visits)
            except SolverError as error:
                refusal = refusal or str(error)
                continue
            over = {r.violation(float(r.coefficients @ followed)): r for r in self.program.rows}
            if (worst := max(over, default=0.0)) <= max(self.residual, RESIDUAL):
                return MixedPolicy(tuple(map(self.program.augmented.policy, choices)), weights)
            refusal = (
                "without solver noise, the lottery of these visits breaks "
                f"{over[worst].name!r} by {worst:.1e}, relative to its bound: find visits that "
                "balance better, by a simplex method or at tighter tolerances"
            )
        raise SolverError(refusal)

    def to_frame(self) -> Any:
        """Return a pandas ``DataFrame`` with a row for each column of the program.

        Columns of the frame: state, action, cost (accumulated before the action, in case S),
        visits, and probability (share in the state's visits). If duals are known, there are two
        more: value (of taking the action first) and advantage (reduced cost).

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        process, labels = self.program.process, map(self.program.label, range(len(self.visits)))
        frame = optional_module("pandas", "frames").DataFrame(labels, columns=ColumnLabel._fields)
        outflow = segment_sums(self.visits, process.pair_offsets)[process.pair_state]
        frame["visits"], seen = self.visits, outflow > 0.0
        frame["probability"] = np.divide(self.visits, outflow, where=seen, out=0.0 * outflow)
        if self.values is not None:
            excess = self.values.reduced_costs
            frame["value"] = self.values.states[process.pair_state] + excess
            frame["advantage"] = excess
        return frame

    def __repr__(self) -> str:
        """Return the objective, the derivation of c*, and each row's activity and price."""
        lines = [f"objective {self.objective:.9g}   ({self.solver}: {self.status})"]
        if self.minimised is not None:
            lines.append(f"  minimised {self.minimised:.9g}")
        if self.values is None and self.optimal_value_from_dual is not None:
            lines.append(f"  c* {self.optimal_value_from_dual:.9g} by the prices of all rows")
        if self.values is not None and self.optimal_value_from_dual is not None:
            begun = float(self.program.process.start @ self.values.states)
            paid = sum(row.price * row.bound for row in self.rows if row.price is not None)
            made, optimum = f"({begun:.9g} - {paid:.9g})", f"{self.optimal_value_from_dual:.9g}"
            stated = self.program.aim[1].replace(f"<{self.program.objective}, x>", made)
            sentence = f"c* {optimum} = {stated}"
            if self.program.ratio:
                sentence = f"c* {optimum}, subtracted at the goal, leaves {made} = 0"
            lines.append(f"  {sentence}: v(start) less price x bound of each row")
        lines += [f"  {row}" for row in self.rows[:_LISTED]]
        if len(self.rows) > _LISTED:
            lines.append(f"  and {len(self.rows) - _LISTED:,} more rows")
        if self.program.ratio and self.values is not None and self._goal > 0.0:
            lines.append(f"  normaliser: <goal, x> = 1   dual c*, at the scale t = 1 / "
                         f"{self._goal:.6g} = {1.0 / self._goal:.6g}")  # fmt: skip
        if self.beyond > ROUNDING:
            lines.append(
                f"  {self.beyond:.3g} succeed beyond the last total that is distinguished, and are "
                "charged that total: raise cost_cap to distinguish more"
            )
        return "\n".join(lines)

    summary = __repr__


@dataclass(frozen=True, eq=False)
class StateValues:
    """Values of states: the least expected cost from a state, with each row charged at its price.

    They are the duals of flow balance; ``values["depot"]`` is the value of a state. The mean value
    of the start is c* plus the sum of price times bound over the rows. In case S, c* times the goal
    probability is subtracted from the cost, so the mean is this sum without c*.
    """

    program: OccupationProgram
    states: FloatArray  # [process states]
    reduced_costs: FloatArray  # [pairs] excess over the best pair of the same state

    def __getitem__(self, state: Hashable) -> float:
        """Return the value of a state."""
        return self.at(state)

    @explained
    def at(
        self, state: Hashable, action: Hashable | None = None, cost: float | None = None
    ) -> float:
        """Return the value of a state, or of taking an action there first.

        Args:
            state: a live state: neither goal nor dead-end.
            action: one of its actions, ``GIVE_UP`` or ``"stay for ever"``.
            cost: in case S the accumulated cost, one that the program distinguishes.

        Raises:
            ModelError: an unknown state or action, or a state without exactly one row of balance.
        """
        if action is not None:
            return self.at(state, cost=cost) + self.advantage(state, action, cost)
        program = self.program
        columns = [k for k in program.columns(state) if cost in (None, program.label(k).cost)]
        rows = np.unique(program.process.pair_state[columns].astype(np.int64))
        if len(rows) != 1:
            like = map(program.label, columns[:1])
            such = "".join(f", such as that of {label.state!r}{label.paid}" for label in like)
            complaint = f"state {state!r} has {len(rows):,} rows of balance at this cost"
            raise ModelError(f"{complaint}: name exactly one{such}")
        return float(self.states[rows[0]])

    @explained
    def advantage(self, state: Hashable, action: Hashable, cost: float | None = None) -> float:
        """Return the reduced cost of an action, which is 0 for optimal actions.

        Raises:
            ModelError: no such column, or several.
        """
        return float(self.reduced_costs[self.program.column(state, action, cost)])


def balanced_visits(
    process: ExplicitProcess,
    visits: FloatArray,
    otherwise: IntArray,
    gives_up: BoolArray | None = None,
    noise: tuple[float, float] = NOISES[0],
) -> FloatArray:
    """Return the visits of the policy that a solver's visits describe, [pairs].

    In each state the policy draws a pair in proportion to the solver's visits. The solver's visits
    satisfy flow balance only within a tolerance, the result satisfies it up to rounding. Visits of
    endless cycles are left out, since the policy never enters them.

    Args:
        process: the process.
        visits: the solver's visits, [pairs].
        otherwise: a policy that ends every run, taken in states that the solver hardly visits,
            [states].
        gives_up: which pairs give up, [pairs]. If given, the policy gives up, where it may, in
            states from which it cannot reach the goal.
        noise: visits up to these two limits count as 0: the total visits of a state, and the share
            of a pair in its state's visits.
    """
    kept = np.maximum(visits, 0.0)
    outflow = segment_sums(kept, process.pair_offsets)
    unseen = outflow <= noise[0] * min(float(outflow.max(initial=0.0)), 1.0)
    kept[kept <= noise[1] * outflow[process.pair_state]] = 0.0
    share = shares_of_visits(process, kept, unseen, otherwise)
    if gives_up is not None:
        reaching = (share > 0.0) & (process.goal > 0.0)
        lost = nearer_pairs(process.dynamics.graph, reaching, share > 0.0) < 0
        lost &= segment_sums(gives_up.astype(np.float64), process.pair_offsets) > 0.0
        if lost.any():
            price = np.where(gives_up, process.cost, np.inf)
            share = shares_of_visits(process, share, lost, _least_pairs(process, price))
    for _ in range(len(otherwise) + 1):
        _, chain = drawn_chain(process, share)
        if not chain.closed.size:
            break
        rounds = np.bincount(chain.closed, minlength=process.n_states) > 0
        share = shares_of_visits(process, share, rounds, otherwise)
    return np.asarray(chain.solve_transposed(process.start)[process.pair_state] * share)


def drawn_chain(process: ExplicitProcess, share: FloatArray) -> tuple[sp.csr_array, System]:
    """Return the draws of a randomised policy as a matrix, and the policy's Markov chain.

    Args:
        process: the process.
        share: probability of each pair in its state, [pairs].

    Returns:
        The probabilities, [states, pairs], and the chain on the states.
    """
    drawn, shape = np.flatnonzero(share), (process.n_states, process.n_pairs)
    draws = sp.csr_array((share[drawn], (process.pair_state[drawn], drawn)), shape=shape)
    exits = np.asarray(draws @ process.dynamics.exits)
    return draws, System(sp.csr_array(draws @ process.transitions), exits)


def shares_of_visits(
    process: ExplicitProcess, visits: FloatArray, unseen: BoolArray, otherwise: IntArray
) -> FloatArray:
    """Return the share of each pair in the visits of its state, [pairs].

    Args:
        process: the process.
        visits: visits of each pair, [pairs].
        unseen: states whose visits are ignored, [states].
        otherwise: the pair of each such state that gets share 1, [states].
    """
    share = np.where(unseen[process.pair_state], 0.0, visits)
    share[otherwise[unseen]] = 1.0
    return np.asarray(share / segment_sums(share, process.pair_offsets)[process.pair_state])


def _decomposed(
    process: ExplicitProcess, visits: FloatArray
) -> tuple[tuple[IntArray, ...], FloatArray, FloatArray]:
    """Decompose an occupation measure into deterministic policies and weights.

    Each step subtracts the measure of a policy that takes only pairs with positive visits, with the
    greatest weight that leaves no visit negative, so that the visits of at least one pair become 0
    (Altman 1999; paper, section 2.2). If k more pairs than states have positive visits, there are
    at most k + 1 policies; at a vertex of a program, k is the number of rows that hold with
    equality. Visits that remain at the end belong to endless cycles.

    Args:
        process: the process.
        visits: visits that satisfy flow balance, [pairs].

    Returns:
        The pair of each state for each policy, [members][states]; the weights of the policies,
        which sum to one, [members]; and the visits of this lottery, [pairs].

    Raises:
        SolverError: no policy has these visits.
    """
    left, members, weights = visits.copy(), [], []
    followed = np.zeros_like(visits)
    outflow, remaining = segment_sums(visits, process.pair_offsets), 1.0
    leaving = leaving_choice(process.dynamics, process.goal)
    safe = nearer_to_leaving(process, visits > 0.0, leaving)
    while remaining > 0.0:
        rounding = max(_DUST * remaining, _ROUNDED) * outflow[process.pair_state]
        left[left <= rounding] = 0.0
        most = _least_pairs(process, -left)  # of each state the pair that is visited most
        choice = np.where(left[most] > 0.0, most, safe)
        chain = process.dynamics.chain(choice.astype(np.int32))
        if chain.closed.size:
            choice = nearer_to_leaving(process, left > 0.0, safe)
            chain = process.dynamics.chain(choice)
        own = chain.solve_transposed(process.start)
        visited = (own * remaining > _ABOVE * rounding[choice]) & (left[choice] > 0.0)
        if not visited.any():
            break
        weight = min(float((left[choice[visited]] / own[visited]).min()), remaining)
        weight = remaining if remaining - weight <= _DUST else weight
        members.append(choice)
        weights.append(weight)
        spent = np.zeros_like(left)
        spent[choice] = weight * own
        followed += spent
        used_up = np.abs(left - spent) <= ROUNDING * spent
        left = np.where(used_up, 0.0, np.maximum(left - spent, 0.0))
        remaining -= weight
    subtracted = _ABOVE * _ROUNDED * max(float(outflow.max(initial=0.0)), 1.0)
    taken, often = visits > 0.0, outflow[process.pair_state]
    excess = (followed - visits - subtracted)[taken] / often[taken]
    wrong = max(float(excess.max(initial=0.0)), remaining)
    if wrong > _WRONG:
        raise SolverError(f"the lottery misses the program's visits by {wrong:.1e}: use solve()")
    total = np.sum(weights)
    return tuple(members), np.array(weights) / total, followed / total


def _least_pairs(process: ExplicitProcess, values: FloatArray) -> IntArray:
    """Return the pair of least value in each state, [states]."""
    offsets = process.pair_offsets
    return first_minimisers(values, segment_minima(values, offsets), offsets)


def nearer_to_leaving(process: ExplicitProcess, usable: BoolArray, otherwise: IntArray) -> IntArray:
    """Return a policy that ends runs in the fewest steps by usable pairs, [states].

    Args:
        process: the process.
        usable: mask of the pairs that may be taken, [pairs].
        otherwise: pair of each state from which usable pairs cannot end a run, [states].
    """
    exits = process.dynamics.exits > 0.0
    nearer = nearer_pairs(process.dynamics.graph, usable & exits, usable)
    return np.where(nearer >= 0, nearer, otherwise).astype(np.int32)
