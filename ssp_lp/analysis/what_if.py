"""Sensitivity: derivatives of the optimum by a problem's probabilities, costs and bounds.

By the envelope theorem the derivative of the optimum is the derivative of the Lagrangian at an
optimal lottery and optimal prices. Let x be the expected number of times that the lottery takes a
pair. The worth of an outcome o of this pair, at the prices, is

    worth(o) = cost + sum of price * quantity + value of its successor.

The value of a dead-end is the price of failing plus the charges there. The derivatives are:

- x * (worth(o') - worth(o)) for moving probability from outcome o to o',
- x * probability for the cost of an outcome,
- minus its price for a bound,
- a difference of values for the start.

In case S the formulas hold at each accumulated cost, with -c* as the value of the goal, and are
divided by the goal probability.

If the prices are unique but several lotteries are optimal, the derivative to the right is the least
value of the formula over all optimal lotteries, and the derivative to the left is the greatest
value (Danskin's theorem; the reverse for a maximum). Each is a linear program over the optimal
actions. If several prices are optimal, the problem is solved again with slightly smaller and
slightly greater numbers. The formula is evaluated there, and checked against differences of the
optimum.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.arrays import BoolArray, FloatArray, IntArray, entries_of, segment_minima, segment_sums
from ssp_lp.compiled.deadline import Stop, check_time, is_late, limited, seconds_left
from ssp_lp.dynamic_programming.dynamics import leaving_choice
from ssp_lp.errors import (
    InfeasibleError,
    ModelError,
    SolverError,
    SSPError,
    did_you_mean,
    optional_module,
)
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_pairs, attention_states, dead_ends
from ssp_lp.model.product import ProductSSP
from ssp_lp.model.report import Report, Table
from ssp_lp.problem import Problem, as_stated
from ssp_lp.processes.conditions import FAILURE_ROW, StepTerm, UpperRow
from ssp_lp.processes.failure_semantics import (
    Aim,
    GiveUp,
    dead_end_charges,
    survival_of,
)
from ssp_lp.processes.live_rows import cost_means, costless_pairs
from ssp_lp.programs.occupation_measure import (
    ROUNDING,
    OccupationMeasure,
    StateValues,
    drawn_chain,
    shares_of_visits,
)

_STEP = 1e-5  # to the nearby numbers of one-sided derivatives
_AGREES = 1e-4  # relative difference of a one-sided derivative and of optima
_ACCURACY = 1e-6  # relative: of breakpoints, and of worths of outcomes that make up a value
_BEYOND = 1e-12  # probability of success beyond the last total that is distinguished
_FIRST_CAP, _LAST_CAP = 16.0, 5000.0  # of distinguished totals, in greatest costs of a step
_SHOWN = 15  # rows of the text


def _added(one: Mapping[Any, float], other: Mapping[Any, float]) -> dict[Any, float]:
    """Return the sum of two vectors given by their nonzero entries."""
    return {key: one.get(key, 0.0) + other.get(key, 0.0) for key in (*one, *other)}


def _opens(numbers: FloatArray, slopes: Mapping[int, float]) -> bool:
    """Return whether a change with these slopes raises one of the numbers that are 0."""
    return any(slope > 0.0 and numbers[place] == 0.0 for place, slope in slopes.items())


@dataclass(frozen=True, eq=False)
class Change:
    """A direction in which a problem's data move: changes of data per unit of the step."""

    probabilities: Mapping[int, float] = field(
        default_factory=dict
    )  # by outcome; of each pair the sum is 0
    costs: Mapping[tuple[str, int], float] = field(default_factory=dict)  # by name and outcome
    bounds: Mapping[str, float] = field(default_factory=dict)  # by name of the row, or "penalty"
    start: Mapping[int, float] = field(default_factory=dict)  # by state; sum 0

    def __add__(self, other: Change) -> Change:
        """Return the sum of two changes."""
        return Change(
            _added(self.probabilities, other.probabilities),
            _added(self.costs, other.costs),
            _added(self.bounds, other.bounds),
            _added(self.start, other.start),
        )

    def applied(self, problem: Problem, step: float) -> Problem:
        """Return the problem with its numbers changed by a step in this direction.

        Raises:
            ModelError: the criterion rejects the numbers.
        """
        stated: dict[str, Any] = as_stated(problem)
        if self.probabilities or self.costs:
            stated["model"] = problem.model.with_moves(self.probabilities, self.costs, step)
        if self.start:
            start = problem.start_mass.copy()
            for state, slope in self.start.items():
                start[state] += step * slope
            used = np.flatnonzero(start).tolist()
            stated["start"] = {problem.model.states[k]: float(start[k]) for k in used}
        if "penalty" in self.bounds:
            stated["penalty"] = problem.penalty + step * self.bounds["penalty"]
        if FAILURE_ROW in self.bounds:
            stated["failure_budget"] = problem.failure_budget + step * self.bounds[FAILURE_ROW]  # type: ignore[operator]
        limits = dict(problem.constraints)
        for name in limits.keys() & self.bounds.keys():
            limit, slope = limits[name], step * self.bounds[name]
            lower = None if limit.lower is None else limit.lower + slope
            upper = None if limit.upper is None else limit.upper + slope
            limits[name] = replace(limit, lower=lower, upper=upper)
        return cast("Problem", replace(cast("Any", problem), constraints=limits, **stated))

    def most(self, problem: Problem, sign: float) -> float:
        """Return the greatest step for which all probabilities and costs stay at least 0.

        Args:
            problem: the problem.
            sign: 1 for steps in this direction, -1 for steps in the opposite direction.
        """
        costs = problem.model.costs_by_name
        start = problem.start_mass if self.start else np.zeros(0)
        at = [
            *((problem.model.probabilities[k], slope) for k, slope in self.probabilities.items()),
            *((costs[name][k], slope) for (name, k), slope in self.costs.items()),
            *((start[k], slope) for k, slope in self.start.items()),
        ]
        return min((-v / (sign * slope) for v, slope in at if sign * slope < 0.0), default=np.inf)


@dataclass(frozen=True, eq=False)
class Number:
    """A number of a problem (a probability, a cost, a bound), or several that move together."""

    kind: str  # "probability", "cost", "bound", "start", "parameter" or "group"
    name: str
    value: float | None  # None: of a group
    change: Change = field(repr=False)  # per unit by which it rises; other probabilities fall
    state: Hashable = None
    action: Hashable = None
    successor: Hashable = None
    is_rest: bool = False  # the likelier of two outcomes, whose derivative is minus the other's

    @property
    def scale(self) -> float:
        """Size of the number, by which effects are weighted: its absolute value.

        For a probability p it is min(p, 1 - p); without a value (a group) it is 1.
        """
        size = 1.0 if self.value is None else abs(self.value)
        return min(size, 1.0 - size) if self.kind in ("probability", "start") else size


@dataclass(frozen=True)
class Effect:
    """Derivatives of the optimum by one number of the problem, to the left and to the right."""

    number: Number
    left: float | None  # None: see the note
    right: float | None
    note: str = ""

    @property
    def derivative(self) -> float | None:
        """Derivative if both sides agree, otherwise None."""
        left, right = self.left, self.right
        if left is None or right is None:
            return None
        same = abs(left - right) <= _AGREES * max(abs(left), abs(right))
        return (left + right) / 2.0 if same or left == right else None

    @property
    def weight(self) -> float:
        """Size of the number times the greater of the two derivatives' absolute values."""
        return max(abs(side or 0.0) for side in (self.left, self.right)) * self.number.scale


@dataclass(frozen=True, eq=False)
class _Optimum:
    """An optimal lottery and optimal prices of a problem, with derivatives of the optimum.

    Arrays belong to the model that is solved. With a horizon its states are (state, steps taken).
    """

    problem: Problem  # the one that is solved
    measure: OccupationMeasure
    cap: float = 0.0  # in case S the greatest total that is distinguished

    @classmethod
    def of(cls, problem: Problem, cap: float = 0.0, near: _Optimum | None = None) -> _Optimum:
        """Solve the problem's program.

        In case S the program distinguishes total costs up to a cap. The cap is raised until no run
        of an optimal lottery succeeds beyond it.

        Args:
            problem: the problem.
            cap: in case S the first cap; 0: a default.
            near: optimum of a problem with nearby numbers, from which the solver starts.

        Raises:
            InfeasibleError: no policy satisfies the limits.
            SolverError: the program is too large, or too many totals matter.
            Stop: the deadline has passed.
        """
        solved = problem.unrolled
        begun = None if near is None else near.measure
        if not solved.ratio:
            return cls(solved, _vertex_in_time(solved, begun))
        most = max(float(solved.model.costs.max(initial=0.0)), 1.0)
        first, last = _FIRST_CAP * most if near is None else near.cap, _LAST_CAP * most
        cap = min(cap or first, last)
        while cap <= last:
            measure = _vertex_in_time(solved.with_arguments(cost_cap=cap), begun)
            optimum = cls(solved, measure, cap)
            if measure.beyond <= _BEYOND and not optimum.beyond_by_others > ROUNDING:  # or nan
                return optimum
            cap *= 2.0
        raise SolverError("too many total costs given success for derivatives: round the costs")

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle: all fields and cached numbers except ``optima``."""
        return {name: value for name, value in self.__dict__.items() if name != "optima"}

    @cached_property
    def scale(self) -> float:
        """Factor from derivatives of the Lagrangian to derivatives of the optimum.

        It is 1, negative for a maximum; in case S it is divided by the goal probability.
        """
        program = self.measure.program
        sign = 1.0 if program.sense.constant is None else -1.0
        goal = float(program.process.goal @ self.measure.visits) if program.ratio else 1.0
        return sign / goal

    @property
    def duals(self) -> StateValues:
        """Duals of the program's flow balance: state values and reduced costs."""
        return cast("StateValues", self.measure.values)

    @cached_property
    def values(self) -> FloatArray:
        """Value of each node at each total cost, nan if no run reaches it, [copies * nodes]."""
        augmented = self.measure.program.augmented
        every = np.full(augmented.copies * augmented.quotient.n_nodes + 1, np.nan)
        every[augmented.part.states] = self.duals.states
        return every

    @cached_property
    def size(self) -> float:
        """1 plus the greatest absolute value in ``values``, to which tolerances are relative."""
        return 1.0 + float(np.nanmax(np.abs(self.values)))

    @cached_property
    def best(self) -> BoolArray:
        """Mask of the program's pairs that are optimal in a visited state, [pairs]."""
        process = self.measure.program.process
        often = np.bincount(process.pair_state, self.measure.visits, process.n_states)
        is_optimal = self.duals.reduced_costs <= ROUNDING * self.size
        return np.asarray((often > ROUNDING)[process.pair_state] & is_optimal)

    @cached_property
    def rows(self) -> list[tuple[float, UpperRow]]:
        """Price and row for each limit of the problem that has a positive price."""
        prices, bounds = self.measure.prices, self.measure.program.bounds
        priced = list[tuple[float, UpperRow]]()
        for row in (row for condition in self.problem.conditions for row in condition.rows):
            if row.name in bounds and prices.get(row.name, 0.0) > 0.0:
                direct, bound = row.direct, bounds[row.name]
                is_direct = direct is not None and bound == direct.bound != row.bound
                priced.append((prices[row.name], cast("UpperRow", direct) if is_direct else row))
        return priced

    @cached_property
    def paid(self) -> list[tuple[float, SSP]]:
        """Step costs in the Lagrangian: for each, its weight and a model whose own cost it is."""
        model, semantics = self.problem.model, self.problem.semantics
        counts = not self.problem.ratio and semantics.aim is Aim.LEAST_COST
        own = [(1.0, model)] if counts else []
        terms = ((price * w, term) for price, row in self.rows for w, term in row.terms)
        return own + [(weight, term.model) for weight, term in terms if isinstance(term, StepTerm)]

    @cached_property
    def failing(self) -> float:
        """Price of failing: the budget's price plus the penalty; 1 if the goal is maximised."""
        semantics = self.problem.semantics
        if semantics.aim is Aim.GREATEST_GOAL:
            return 1.0
        penalty = 0.0 if semantics.forbids_failing else semantics.penalty
        return float(self.measure.prices.get(FAILURE_ROW, 0.0)) + penalty

    @cached_property
    def ends(self) -> tuple[FloatArray, float]:
        """Charges in the Lagrangian: of entering each state, [states], and of an end by discount.

        The charge of entering a state does not include the state's value.
        """
        quotient = self.measure.program.augmented.quotient
        model, goal, dead = self.problem.model, self.problem.model.goal_mask, quotient.dead
        ended, entering, leak = quotient.node_of < 0, np.zeros(model.n_states), self.failing
        ratio = self.measure.objective if self.problem.ratio else 0.0
        entering += self.failing * dead - ratio * goal
        for weight, costs in self.paid:
            entering += weight * dead_end_charges(costs, dead, self.problem.semantics)
        for price, row in self.rows:
            entering += price * row.constant * ended
            leak += price * row.constant
            for weight, term in row.terms:
                if isinstance(term, StepTerm):
                    continue
                if term.others:
                    leak += price * weight
                    is_goal = (term.states == goal).all()
                    entering += price * weight * (dead if is_goal else ended & ~term.states)
                else:
                    entering += price * weight * term.states
        return entering, leak

    @cached_property
    def outcomes(self) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
        """Outcomes of all columns (pairs) of the program, with their worths (see the file's text).

        Returns:
            Four arrays, [entries] each: the column; the outcome of the model; the position of the
            successor in ``values``, -1 for an end; and the worth.

        Raises:
            ModelError: the worths do not explain the value of a state, since the problem counts a
                quantity that is unknown here.
        """
        augmented, model = self.measure.program.augmented, self.problem.model
        quotient, survival = augmented.quotient, survival_of(self.problem.discount)
        numbers = augmented.part.pairs
        own = np.flatnonzero(numbers < augmented.copies * augmented.width)
        copy, inner = np.divmod(numbers[own], augmented.width)
        pair = quotient.pair_at[inner]
        own, copy, pair = own[pair >= 0], copy[pair >= 0], pair[pair >= 0]
        outcome, _ = entries_of(model.outcome_offsets, pair)
        each = np.repeat(np.arange(len(own)), np.diff(model.outcome_offsets)[pair])
        successor = model.successors[outcome]
        node = quotient.node_of[successor]
        entering, leak = self.ends
        worth = survival * entering[successor]
        for weight, costs in self.paid:
            worth += weight * costs.costs[outcome]
        then: IntArray = np.zeros(len(each), dtype=np.int64)
        if isinstance(augmented.inner, OpenEnded):
            ahead = augmented.inner.base.step_classes.ahead
            kinds, kind = np.unique(ahead, return_inverse=True)
            then = augmented.inner.leads(kinds)[0][copy[each], kind[outcome]]
            if self.problem.ratio:
                total = augmented.inner.totals.values[copy[each]] + model.costs[outcome]
                worth += np.where(model.goal_mask[successor], total, 0.0)
        place = np.where(node >= 0, then * quotient.n_nodes + node, -1)
        worth = worth + np.where(place >= 0, survival * self.values[place], 0.0)
        parts = np.nan_to_num(model.probabilities[outcome] * worth)
        after = np.bincount(each, parts, len(own)) + (1 - survival) * leak
        state = self.measure.program.process.pair_state[own]
        value = self.duals.states[state] + self.duals.reduced_costs[own]
        wrong = np.abs(after - value) > _ACCURACY * (1.0 + np.abs(value).max(initial=0.0))
        wrong &= (copy < augmented.copies - 1) | (augmented.copies == 1)
        if wrong.any():
            label = self.measure.program.label(int(own[np.argmax(wrong)]))
            raise ModelError(f"the value of {label} is inaccurate: solve at two values and compare")
        return own[each], outcome, place, worth

    @cached_property
    def by_probability(self) -> FloatArray:
        """Derivative by the probability of each outcome, [outcomes].

        For the outcomes of one pair, the derivatives are determined up to a common constant only,
        since the probabilities sum to 1.
        """
        column, outcome, _, worth = self.outcomes
        taken = self.measure.visits[column]
        change = np.where(taken > 0.0, taken * worth, 0.0)
        total = np.bincount(outcome, change, self.problem.model.n_outcomes).astype(np.float64)
        for weight, costs, mass, some in self.charged:
            total[some] += weight * mass * costs.costs[some]
        return self._stated(self.scale * total)

    @cached_property
    def by_cost(self) -> dict[str, FloatArray]:
        """Derivative by each cost of the model, by name, [outcomes]."""
        model, (column, outcome, _, _) = self.problem.model, self.outcomes
        often = self.measure.visits[column] * model.probabilities[outcome]
        met = np.bincount(outcome, often, model.n_outcomes)
        total = {name: np.zeros(model.n_outcomes) for name in model.costs_by_name}
        for weight, costs in self.paid:
            if (name := self._name_of(costs)) is not None:
                total[name] += weight * met
        for weight, costs, mass, some in self.charged:
            if (name := self._name_of(costs)) is not None:
                total[name][some] += weight * mass * model.probabilities[some]
        if self.problem.ratio:
            total[next(iter(total))] += self._met_on_the_way_to_success
        return {name: self._stated(self.scale * part) for name, part in total.items()}

    @cached_property
    def counts_cost(self) -> dict[str, bool]:
        """Whether each cost of the model affects the optimum, by name."""
        by_name = self.problem.model.costs_by_name
        paid = {self._name_of(costs) for _, costs in self.paid}
        own = next(iter(by_name)) if self.problem.ratio else None
        return {name: name in paid or name == own for name in by_name}

    def _name_of(self, costs: SSP) -> str | None:
        """Return the name that the problem gives to the own cost of a model; None: no name."""
        by_name = self.problem.model.costs_by_name.items()
        return next((name for name, each in by_name if each is costs.costs), None)

    @cached_property
    def _met_on_the_way_to_success(self) -> FloatArray:
        """Expected number of occurrences of each outcome in runs that later succeed, [outcomes]."""
        model, (column, outcome, place, _) = self.problem.model, self.outcomes
        process, visits = self.measure.program.process, self.measure.visits
        survival = survival_of(self.problem.discount)
        unseen = segment_sums(visits, process.pair_offsets) <= 0.0
        leaving = leaving_choice(process.dynamics, process.goal)
        draws, chain = drawn_chain(process, shares_of_visits(process, visits, unseen, leaving))
        success = np.zeros_like(self.values)
        part = self.measure.program.augmented.part
        success[part.states] = chain.solve(draws @ process.goal / survival)
        reached = np.where(place >= 0, survival * success[place], 0.0)
        reached[model.goal_mask[model.successors[outcome]]] = 1.0
        often = visits[column] * model.probabilities[outcome] * reached
        return np.bincount(outcome, often, model.n_outcomes).astype(np.float64)

    @cached_property
    def failures(self) -> sp.csr_array:
        """Expected number of failures that charge an action's cost, [process pairs + 1, states].

        Entry (pair, state) counts failures that charge the cheapest action of the state, per visit
        of the pair. The last row counts failures at the start.
        """
        program, model = self.measure.program, self.problem.model
        quotient, (column, outcome, _, _) = program.augmented.quotient, self.outcomes
        solved = program if program.reduced is None else program.reduced.program
        gives_up, to = np.flatnonzero(program.augmented.gives_up), model.successors[outcome]
        acting = quotient.first_states[quotient.pair_node[program.augmented.part.pairs[gives_up]]]
        lost = survival_of(self.problem.discount) * model.probabilities[outcome] * quotient.dead[to]
        begun = self.problem.start_mass * quotient.dead
        last = np.full(model.n_states, program.process.n_pairs)
        mass = np.concatenate([lost, ~solved.augmented.quotient.merged[acting], begun])
        columns = np.concatenate([column, gives_up, last])
        states = np.concatenate([to, acting, np.arange(model.n_states)])
        return sp.csr_array((mass, (columns, states)), (last[0] + 1, model.n_states))

    @cached_property
    def failing_mass(self) -> FloatArray:
        """Probability of a failure for which an action of each state is charged, [states]."""
        return np.asarray(np.append(self.measure.visits, 1.0) @ self.failures)

    @cached_property
    def cheapest(self) -> list[tuple[float, SSP, BoolArray]]:
        """Cheapest actions of each state, one of which a run pays when it fails there.

        For each cost the weight, a model whose own cost it is, and a mask of the model's pairs.
        """
        model, semantics = self.problem.model, self.problem.semantics
        home, dead = model.pair_state, self.measure.program.augmented.quotient.dead
        stays = attention_pairs(model, attention_states(model)) | dead[home]
        stays |= semantics.give_up is GiveUp.ANYWHERE
        cheapest = list[tuple[float, SSP, BoolArray]]()
        for weight, costs in self.paid if semantics.charge_failing_step else ():
            mean = np.where(stays, cost_means(costs), np.inf)
            least = segment_minima(mean, model.pair_offsets)[home]
            cheapest.append((weight, costs, stays & (mean <= least + ROUNDING * (1.0 + least))))
        return cheapest

    @cached_property
    def charged(self) -> list[tuple[float, SSP, FloatArray, IntArray]]:
        """Outcomes of the actions whose cost runs may pay when they fail.

        For each cost the weight, a model whose own cost it is, the probability of the failure (0
        for all but the first of equally cheap actions), and the outcomes.
        """
        model, charges = self.problem.model, list[tuple[float, SSP, FloatArray, IntArray]]()
        for weight, costs, tied in self.cheapest:
            pairs = np.flatnonzero(tied & (self.failing_mass > 0.0)[model.pair_state])
            some, counts = entries_of(model.outcome_offsets, pairs)
            state = model.pair_state[pairs]
            mass = np.where(np.diff(state, prepend=-1) > 0, self.failing_mass[state], 0.0)
            charges.append((weight, costs, np.repeat(mass, counts), some))
        return charges

    @cached_property
    def by_start(self) -> FloatArray:
        """Derivative by the probability of starting in each state, [states]; nan if unknown."""
        quotient, (entering, _) = self.measure.program.augmented.quotient, self.ends
        live = quotient.node_of >= 0
        begun = np.where(live, self.values[np.where(live, quotient.node_of, 0)], entering)
        for price, row in self.rows:
            for weight, term in row.terms:
                if not (isinstance(term, StepTerm) or term.final):
                    begun = begun + price * weight * (term.states & live)
        if (counting := self.counting_steps) is None:
            return self.scale * begun
        first = np.flatnonzero(counting.labels.number == 0)
        stated = np.full(counting.original.n_states, np.nan)
        stated[counting.original_state[first]] = self.scale * begun[first]
        return stated

    @cached_property
    def by_bound(self) -> dict[str, float]:
        """Derivative by each bound: the budget, limits by name, and the penalty."""
        measure, bounds = self.measure, dict[str, float]()
        for row in (row for condition in self.problem.conditions for row in condition.rows):
            price = -self.scale * measure.prices.get(row.name, 0.0) * row.sign
            bounds[row.condition.name] = bounds.get(row.condition.name, 0.0) + price
        if FAILURE_ROW in measure.program.bounds:
            bounds[FAILURE_ROW] = -self.scale * measure.prices.get(FAILURE_ROW, 0.0)
        bounds["penalty"] = self.scale * float(measure.program.process.failure @ measure.visits)
        return bounds

    @property
    def counting_steps(self) -> ProductSSP | None:
        """Product model with states (state, steps taken); None if the problem has no horizon."""
        model = self.problem.model
        return model if isinstance(model, ProductSSP) and model.is_hidden else None

    def _stated(self, per_outcome: FloatArray) -> FloatArray:
        """Sum values over the steps of a horizon: one sum for each outcome that the user stated."""
        if (counting := self.counting_steps) is None:
            return per_outcome
        places, size = counting.original_outcome, counting.original.n_outcomes
        return np.bincount(places, per_outcome, size).astype(np.float64)

    def along(self, change: Change) -> float:
        """Return the derivative of the optimum in the direction of a change."""
        return float(sum((
            *(slope * self.by_probability[k] for k, slope in change.probabilities.items()),
            *(slope * self.by_cost[name][k] for (name, k), slope in change.costs.items()),
            *(slope * self.by_bound.get(name, np.nan) for name, slope in change.bounds.items()),
            *(slope * self.by_start[k] for k, slope in change.start.items()),
        ), start=0.0))  # fmt: skip

    @cached_property
    def support(self) -> frozenset[Hashable]:
        """Indices of the columns (pairs) that the lottery uses, and names of rows with a price."""
        pairs = self.measure.program.augmented.part.pairs[self.measure.visits > ROUNDING]
        return frozenset(pairs.tolist()) | self._priced

    @cached_property
    def is_unique(self) -> bool:
        """Whether the optimal lottery and the optimal prices are proved to be unique.

        Four conditions are sufficient:

        - Every optimal pair of a visited state is used.
        - The number of these pairs is the number of visited states plus the number of tight rows.
        - Every tight row has a price.
        - Where failing is charged the cost of an action, all other actions of the state have other
          costs.
        """
        unused = (self.best & (self.measure.visits <= ROUNDING)).any()
        alone = self.has_one_price and self._priced == {*self.tight} and not unused
        return alone and all((mass > 0.0).all() for _, _, mass, _ in self.charged)

    @property
    def _priced(self) -> set[str]:
        """Names of the rows with a price."""
        prices = self.measure.prices.items()
        return {name for name, price in prices if price > ROUNDING * self.size}

    @cached_property
    def tight(self) -> list[str]:
        """Names of the rows that have a price or are met with equality."""
        slack = self.measure.slack  # a solver may miss a row with a price by more than rounding
        met = (row.name for row in self.measure.program.rows
               if abs(slack[row.name]) <= ROUNDING * (1.0 + abs(row.bound)))  # fmt: skip
        return [*self._priced.union(met)]

    @cached_property
    def has_one_price(self) -> bool:
        """Whether the prices are unique.

        They are if the number of pairs that the vertex uses is the number of visited states plus
        the number of tight rows.
        """
        used = self.measure.visits > ROUNDING
        visited = np.unique(self.measure.program.process.pair_state[used]).size
        return int(used.sum()) - visited == len(self.tight)

    @cached_property
    def optima(self) -> Callable[[FloatArray], float] | None:
        """Function that minimises a linear function of the visits over all optimal lotteries.

        Its argument has the coefficients and the constant, [pairs + 1]. It returns the least value,
        in case S divided by the goal probability; nan if there is none. The property is None if
        several prices may be optimal.
        """
        if not self.has_one_price:
            return None
        from ssp_lp.linear_programming.highs import minimiser

        program, used = self.measure.program, self.measure.visits > ROUNDING
        linear, home, above = program.linear, program.process.pair_state, self.duals.reduced_costs
        room = ROUNDING * (1.0 + np.abs(self.duals.states))  # a far price may be huge
        np.maximum.at(room, home[used], 2.0 * above[used])  # of used columns it is rounding
        best = used | (above <= room[home])
        columns = np.flatnonzero(np.append(best, program.ratio))
        lower, matrix = np.array(linear.lower), linear.matrix[:, columns]
        for place in (linear.rows[name] for name in self._priced):
            lower[place] = linear.upper[place]
        least = minimiser(replace(linear, cost=np.zeros(columns.size), matrix=matrix, lower=lower))
        # in case S the last column is the factor by which all visits are multiplied
        return lambda taken: least(taken[columns]) + (0.0 if program.ratio else taken[-1])

    @property
    def beyond_by_others(self) -> float:
        """Greatest probability of success beyond the cap by an optimal lottery, given success.

        The program charges such successes too little. It is 0 if the lottery is the only optimal
        one, or if the other ones are not compared.
        """
        program = self.measure.program
        if self.is_unique or self.optima is None:
            return 0.0
        late = np.where(program.augmented.is_late, program.process.goal, 0.0)
        return -self.optima(np.append(-late, 0.0))

    def sides(self, change: Change) -> tuple[float, float] | None:
        """Return the derivatives to the left and right in the direction of a change.

        The result is None if several prices may be optimal. It is also None if the change leads to
        a state that no optimal run visits, because the value of such a state is not unique.
        """
        (column, outcome, _, worth), counting = self.outcomes, self.counting_steps
        model, process = self.problem.model, self.measure.program.process
        given, begun = model.probabilities, self.problem.start_mass
        if counting is not None:
            given = counting.original.probabilities
            size, places = counting.original.n_states, counting.original_state
            begun = np.bincount(places, begun, size).astype(np.float64)
        opens = _opens(given, change.probabilities) or _opens(begun, change.start)
        if self.optima is None or opens:
            return None

        def slopes(of: Mapping[int, float]) -> FloatArray:
            """Return the change of each outcome's number, given changes of the user's model."""
            each = np.zeros(given.size)
            each[list(of)] = list(of.values())
            return each if counting is None else np.asarray(each[counting.original_outcome])

        rises, own = slopes(change.probabilities), list[FloatArray]()
        gain = np.where(rises[outcome] == 0.0, 0.0, rises[outcome] * worth)
        for weight, costs in self.paid:
            name = self._name_of(costs)
            moved = {k: slope for (cost, k), slope in change.costs.items() if cost == name}
            own.append(model.probabilities * slopes(moved))
            gain += weight * own[-1][outcome]
        per = np.bincount(column, gain, process.n_pairs) + change.bounds.get("penalty", 0.0) * (
            process.failure)  # fmt: skip
        bounds = {name: slope for name, slope in change.bounds.items() if name != "penalty"}
        fixed = self.along(Change(bounds=bounds, start=change.start)) / self.scale
        if not np.isfinite(per.sum() + fixed):
            return None
        sides = list[float]()
        for sign in (-1.0, 1.0):
            taken = sign * np.append(per, fixed)
            # ``cheapest`` is empty if failing steps are not charged
            for (weight, costs, tied), moves in zip(self.cheapest, own, strict=False):
                mean = segment_sums(rises * costs.costs + moves, model.outcome_offsets)
                charge = segment_minima(np.where(tied, sign * mean, np.inf), model.pair_offsets)
                taken += weight * (self.failures @ np.where(np.isfinite(charge), charge, 0.0))
            sides.append(sign * float(np.sign(self.scale)) * self.optima(taken))
        return (sides[0], sides[1]) if np.isfinite(sides).all() else None


def _vertex_in_time(problem: Problem, begun: OccupationMeasure | None) -> OccupationMeasure:
    """Solve a problem's program at a vertex, where prices are exact.

    Args:
        problem: the problem.
        begun: optimum of a program of the same shape, for a warm start; or None.

    Raises:
        SolverError: the optimum that was found is not a vertex.
        Stop: the deadline of the call has passed.
    """
    check_time()
    limit, program = seconds_left(), problem.program()
    begun = begun and (begun.reduced or begun)
    try:
        for backend in (None, "highs-simplex"):  # interior points may find no vertex
            measure: OccupationMeasure = program.solve(
                backend, time_limit=seconds_left(), warm_start=begun
            )
            if (vertex := measure.reduced or measure).basis is not None:
                if begun is None:  # a start from a basis makes the prices more accurate
                    left = seconds_left()
                    measure = program.solve("highs-simplex", time_limit=left, warm_start=vertex)
                return measure
    except SolverError as error:
        if is_late():
            raise Stop from error
        raise
    if 2.0 * seconds_left() < limit:
        raise Stop  # the limit has cut the solver short of a vertex
    raise SolverError("the LP solver found no vertex, no prices: solve at two values and compare")


def _facts(model: SSP) -> dict[str, Any]:
    """Return facts about a model's graph by name, such as its dead-ends.

    If a change of numbers changes one of them, the optimum may jump.
    """
    attention = attention_states(model)
    return {
        "dead-ends": dead_ends(model),
        "attention states": attention,
        "actions that stay among attention states": attention_pairs(model, attention),
        "free components": model.staying_free(costless_pairs(model)),
    }


@dataclass(frozen=True, eq=False, repr=False)
class WhatIf(Report):
    """Derivatives of an optimum by its problem's numbers, the most important first.

    The importance of a number is its derivative times its size (for a probability p: min(p, 1 -
    p)). Numbers that are not listed belong to actions that are not optimal: a slight change of them
    does not change the optimum.
    """

    problem: Problem
    optimum: _Optimum = field(repr=False)
    effects: tuple[Effect, ...] = ()

    def effect(self, number: Number | Change) -> Effect:
        """Return the derivatives of the optimum by a number, or by several that move together."""
        if isinstance(number, Change):
            number = Number("group", "change", None, number)
        change = number.change
        if note := self._refused(change):
            return Effect(number, None, None, note)
        own = next(iter(self.problem.model.costs_by_name))
        if self.problem.ratio and any(name == own for name, _ in change.costs):
            slope = self.optimum.along(change)
            return Effect(number, slope, slope, "slope if the lottery does not change")
        ends = [change.most(self.problem, sign) for sign in (-1.0, 1.0)]
        is_unique, slope = self.optimum.is_unique, self.optimum.along(change)
        at_least = self.optimum.measure.program.at_least and self.problem.failure_budget is not None
        if is_unique and min(ends) > 0.0 and np.isfinite(slope) and not at_least:
            return Effect(number, slope, slope)
        sides = None if at_least else self.optimum.sides(change)
        (left, why), (right, also) = (
            self._side(change, sign) if sides is None or end <= 0.0 else (side, "")
            for sign, end, side in zip((-1.0, 1.0), ends, sides or (None, None), strict=True)
        )
        return Effect(number, left, right, "; ".join(dict.fromkeys(filter(None, (why, also)))))

    def _refused(self, change: Change) -> str:
        """Return why the optimum has no derivative in a direction; empty: it has one."""
        problem, model = self.problem, self.problem.model
        if (change.probabilities or change.start) and problem.reach_fraction is not None:
            return "the failure budget changes with the greatest goal probability"
        measure, program = self.optimum.measure, self.optimum.measure.program
        if change.probabilities and problem.failure_budget is None and program.at_least:
            acting = np.diff(program.process.pair_offsets)[program.process.pair_state] > 1
            if (measure.visits[acting] > ROUNDING).any():
                return "two actions are equally safe: after a change only the safer one is allowed"
        costs = model.costs_by_name
        rises = _opens(model.probabilities, change.probabilities)
        rises |= any(s > 0.0 == costs[name][k] for (name, k), s in change.costs.items())
        if rises:
            step = min(_STEP, change.most(problem, 1.0) / 2.0)
            now, then = _facts(model), _facts(change.applied(problem, step).model)
            for name, states in now.items():
                if not np.array_equal(states, then[name]):
                    return f"the optimum may jump, as the model then has other {name}"
        return ""

    def _side(self, change: Change, sign: float) -> tuple[float | None, str]:
        """Extrapolate a one-sided derivative from optima at nearby numbers.

        Args:
            change: the direction.
            sign: 1 for the right side, -1 for the left side.

        Returns:
            The derivative and an empty text; or None and the reason.
        """
        side, most = "left" if sign < 0.0 else "right", change.most(self.problem, sign)
        if most <= 0.0:
            return None, f"{side}: a number would be negative"
        step = sign * min(_STEP, most / 4.0)
        try:
            near, far, last = (
                _Optimum.of(change.applied(self.problem, k * step), near=self.optimum)
                for k in (1, 2, 3)
            )
            slopes = near.along(change), far.along(change), last.along(change)
        except InfeasibleError:
            return None, f"{side}: infeasible"
        except SSPError as error:
            return None, f"{side}: {error}"
        slope = 3.0 * (slopes[0] - slopes[1]) + slopes[2]  # a parabola through them, at 0
        bend = abs(slopes[1] - slopes[0])
        here, beside = self.optimum.measure.objective, near.measure.objective
        between = (far.measure.objective - beside) / step
        room, before = _AGREES * (1.0 + abs(slope)) + bend, (beside - here) / step
        moved = f"when the number moves by {step:.1g}: solve both problems and compare"
        if abs(before - slope) > max(room, _AGREES * (1.0 + abs(here)) / abs(step)):
            return None, f"{side}: the optimum jumps from {here:.6g} to {beside:.6g} {moved}"
        if abs(between - (slopes[0] + slopes[1]) / 2.0) > room or abs(before - slope) > room:
            return None, f"{side}: the derivative changes {moved}"
        return float(slope), ""

    def breakpoints(self, number: str | Number | Change) -> tuple[float, float]:
        """Return how far a number may fall and rise without a change of the optimal actions.

        At a kink of the optimum one of the two steps is 0. The steps are found by bisection on
        solutions of the program, to a relative accuracy of 1e-6. No step is longer than 1,000 or
        makes a number negative.

        Args:
            number: a name in the table (such as "failure budget"), a number or a change.

        Raises:
            ModelError: the table has no number of this name.
        """
        if isinstance(number, str):
            names = {effect.number.name: effect.number for effect in self.effects}
            if number not in names:
                told = did_you_mean(number, names, "there are")
                raise ModelError(f"the table has no number {number!r}{told}")
            number = names[number]
        change = number.change if isinstance(number, Number) else number
        return -self._reach(change, -1.0), self._reach(change, 1.0)

    def _reach(self, change: Change, sign: float) -> float:
        """Return how far a change can go in one direction before the optimal actions change.

        Args:
            change: the direction.
            sign: 1 for steps in this direction, -1 for steps in the opposite direction.
        """
        end = min(change.most(self.problem, sign), 1e3)  # farther ones are not sought

        def stays(step: float) -> bool:
            """Return whether the same pairs are used and the same rows have prices after a step."""
            try:
                moved = change.applied(self.problem, sign * step)
                beside = _Optimum.of(moved, near=self.optimum)
            except SSPError:
                return False
            return beside.support == self.optimum.support

        low, high = 0.0, min(_STEP, end)
        while high < end and stays(high):
            low, high = high, min(2.0 * high, end)
        while high - low > max(_ACCURACY * high, _ACCURACY * _STEP):
            middle = (low + high) / 2.0
            low, high = (middle, high) if stays(middle) else (low, middle)
        return high if high == end else low

    def tables(self) -> list[Table]:
        """Return a table with a row for each number, the most important first."""
        rows = [
            (e.number.name, e.number.value, e.derivative, e.left, e.right, e.weight, e.note,
             e.number.kind, e.number.state, e.number.action, e.number.successor)
            for e in self.effects
        ]  # fmt: skip
        head = ("number", "at", "derivative", "left", "right", "matters", "note",
                "kind", "state", "action", "successor")  # fmt: skip
        smooth = all(effect.left == effect.right for effect in self.effects[:_SHOWN])
        hidden = (*head[7:], *(("left", "right") if smooth else ()),
                  *(() if any(row[6] for row in rows[:_SHOWN]) else ("note",)))  # fmt: skip
        more = [f"and {len(rows) - _SHOWN:,} more: to_frame() has all"] * (len(rows) > _SHOWN)
        title = f"the optimum {self.optimum.measure.objective:.9g} moves with each number by"
        return [Table(rows, head, title, more, shown=range(min(len(rows), _SHOWN)), hidden=hidden)]

    def plot(self, *, share: float = 0.1, most: int = 12, ax: Any = None) -> Any:
        """Draw a tornado of the numbers: :func:`ssp_lp.plotting.plot_tornado`."""
        pictures = optional_module("ssp_lp.plotting.curves", "plot")
        return pictures.plot_tornado(self, share=share, most=most, ax=ax)

    def __repr__(self) -> str:
        """Return a line with the number of effects, and the greatest one."""
        most = f", most: {self.effects[0].number.name}" if self.effects else ""
        return f"WhatIf({len(self.effects):,} numbers{most})"


def what_if(
    problem: Problem,
    by: Callable[[Number], Hashable] | None = None,
    *,
    time_limit: float | None = None,
    cap: float = 0.0,
) -> WhatIf:
    """Return the derivatives of a problem's optimum by its numbers: see :meth:`Solution.what_if`.

    Args:
        problem: the problem.
        by: function from a number to its group, None to leave the number out.
        time_limit: seconds; None: unlimited.
        cap: in case S a guess of the greatest total cost of a run that succeeds; 0: no guess.

    Raises:
        ModelError: a criterion whose optimum has no such derivatives.
        OutOfTimeError: the time limit passed before the program was solved.
    """
    with limited(time_limit, "the program was solved"):
        _check_criterion(problem)
        report = WhatIf(problem, _Optimum.of(problem, cap))
        effects = list[Effect]()
        for number in _grouped(_numbers(problem, report.optimum), by):
            effect = Effect(number, None, None, "time_limit ended before")
            with suppress(Stop):
                effect = effect if is_late() else report.effect(number)
            effects.append(effect)
    effects.sort(key=lambda effect: -effect.weight)
    return replace(report, effects=tuple(effects))


def _grouped(numbers: Iterator[Number], by: Callable[[Number], Hashable] | None) -> list[Number]:
    """Return a number for each group of ``by``.

    Without ``by`` each number is a group of its own; if a pair has two outcomes, only the less
    likely one is returned.
    """
    if by is None:
        return [number for number in numbers if not number.is_rest]
    groups = dict[Hashable, list[Number]]()
    for number in numbers:
        if (key := by(number)) is not None:
            groups.setdefault(key, []).append(number)
    grouped = list[Number]()
    for key, some in groups.items():
        values, change = {n.value for n in some}, sum((n.change for n in some), Change())
        together = Number("group", str(key), values.pop() if len(values) == 1 else None, change)
        grouped.append(together if len(some) > 1 else replace(some[0], name=str(key)))
    return grouped


def _check_criterion(problem: Problem) -> None:
    """Raise :class:`ModelError` for a criterion whose optimum has no derivatives here."""
    semantics, name = problem.semantics, type(problem).__name__
    if semantics.counts_law or semantics.aim is Aim.LEAST_GOAL or problem.quantity is not None:
        reason = "is no expected cost, cost given success or goal probability"
    elif problem.own_constraints:
        reason = "has limits of its own: state them as constraints of MCMP or MaxProb"
    elif problem.ratio and "cost_cap" not in {part.name for part in fields(cast("Any", problem))}:
        reason = "does not count totals: use S3P"
    elif problem.unrolled.model.failure_label is not None:
        reason = "limits quantities after failing"
    else:
        return
    raise ModelError(f"what_if supports MCMP, S3P, MaxProb, MinCost and FinitePenalty: {name} "
                     f"{reason}")  # fmt: skip


def _numbers(problem: Problem, optimum: _Optimum) -> Iterator[Number]:
    """Yield the :class:`Number` objects of a problem that may affect its optimum.

    They are parameters of the model, bounds, probabilities of the start, and the probabilities and
    costs of optimal actions.
    """
    model = problem.model
    for parameter, placed in model.parameters.items():
        moved = Change(probabilities=placed.probabilities, costs=placed.costs)
        yield Number("parameter", f"parameter {parameter}", placed.value, moved)
    budget = 1.0 if problem.reach_fraction is not None else problem.failure_budget
    if budget is not None and budget < 1.0:
        yield Number("bound", "failure budget", budget, Change(bounds={FAILURE_ROW: 1.0}))
    if 0.0 < problem.penalty < np.inf:
        yield Number("bound", "penalty", problem.penalty, Change(bounds={"penalty": 1.0}))
    for name, limit in problem.constraints.items():
        at = limit.lower if limit.upper is None else limit.upper
        yield Number("bound", f"limit {name!r}", at, Change(bounds={name: 1.0}))
    start = problem.start_mass
    for state in np.flatnonzero(start).tolist() if (start > 0.0).sum() > 1 else ():
        change = Change(start=_in_proportion(start, [*np.flatnonzero(start)], state))
        name, at = f"start in {model.states[state]}", float(start[state])
        yield Number("start", name, at, change, model.states[state])
    for pair in _optimal_pairs(optimum).tolist():
        yield from _numbers_of_pair(model, pair, optimum)


def _optimal_pairs(optimum: _Optimum) -> IntArray:
    """Return the pairs of the user's model that are optimal in a visited state, or charged.

    A charged pair is one whose cost a failing run pays.
    """
    column, outcome, _, _ = optimum.outcomes
    charged = [some for *_, some in optimum.charged]
    used = np.concatenate([outcome[optimum.best[column]], *charged]).astype(np.int64)
    model = optimum.problem.model
    if (counting := optimum.counting_steps) is not None:
        used = counting.original_outcome[used].astype(np.int64)
        model = counting.original
    return np.asarray(np.unique(np.searchsorted(model.outcome_offsets, used, side="right") - 1))


def _in_proportion(shares: FloatArray, places: list[int], place: int) -> dict[int, float]:
    """Return changes in which one share rises at rate 1, and the others fall in proportion."""
    rest = 1.0 - float(shares[place])
    paid = {k: -float(shares[k]) / rest for k in places if k != place and shares[k] > 0.0}
    return {place: 1.0, **paid}


def _numbers_of_pair(model: SSP, pair: int, optimum: _Optimum) -> Iterator[Number]:
    """Yield the probabilities of a pair's outcomes, and those costs that affect the optimum.

    If all outcomes of the pair have the same cost, this cost is one number.
    """
    outcomes = [*range(int(model.outcome_offsets[pair]), int(model.outcome_offsets[pair + 1]))]
    state, action = model.states[int(model.pair_state[pair])], model.action_of(pair)
    chances, successors = model.probabilities, model.successors
    for k in outcomes:
        if 0.0 < chances[k] < 1.0:
            to, change = model.states[int(successors[k])], _in_proportion(chances, outcomes, k)
            name, at = f"chance of {to} by {action} in {state}", float(chances[k])
            others = [other for other in change if other != k]
            rest = len(others) == 1 and (at, k) > (chances[others[0]], others[0])
            moved = Change(probabilities=change)
            yield Number("probability", name, at, moved, state, action, to, bool(rest))
    for cost, costs in model.costs_by_name.items():
        if not optimum.counts_cost[cost]:
            continue
        word = f"{cost} of {action} in {state}"
        if np.ptp(costs[outcomes]) == 0.0:
            moved = Change(costs={(cost, k): 1.0 for k in outcomes})
            yield Number("cost", word, float(costs[outcomes[0]]), moved, state, action)
            continue
        for k in outcomes:
            to, moved = model.states[int(successors[k])], Change(costs={(cost, k): 1.0})
            yield Number("cost", f"{word} to {to}", float(costs[k]), moved, state, action, to)
