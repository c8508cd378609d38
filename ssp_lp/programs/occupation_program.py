"""Occupation-measure programs with labelled columns and rows, for any solver.

    minimise    <cost, x>                     (case S: <cost, x> / <goal, x>)
    subject to  outflow(x) - inflow(x) = start
                <failure, x> <= budget
                <row_k, x> <= bound_k                 (any number of secondary costs, by name)
                x >= 0

x has the expected visits of each pair of the augmented process (paper, eq. JMCMP_def and JS3P_def;
mathematics, section 3). The ratio of case S becomes linear by the Charnes-Cooper transformation:
x and the start are multiplied by t >= 0, and a normalising row <goal, x> = 1 is added. The failure
row becomes <failure, x> - budget * t <= 0, and other rows change in the same way. Only the
normalising row has a nonzero right side, so its dual is c*.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ssp_lp.arrays import BELOW_RATIO, RESIDUAL, FloatArray
from ssp_lp.compiled.deadline import check_time, pieces
from ssp_lp.errors import InfeasibleError, ModelError, SolverError, is_number, wrong_argument
from ssp_lp.linear_programming.backends import answers_in_turn, backends_for, run_backend
from ssp_lp.linear_programming.linear_program import (
    LinearProgram,
    LPAnswer,
    as_latex,
    as_table,
    check_bounds,
    sums_as_latex,
    words_as_latex,
)
from ssp_lp.model.arguments import explained
from ssp_lp.model.report import ByName, Report, Table
from ssp_lp.policies.policy import GIVE_UP
from ssp_lp.processes.conditions import ArrivalTerm
from ssp_lp.processes.explicit_process import ExplicitProcess, PricedMinimum, priced_minimum
from ssp_lp.processes.failure_semantics import AS_IS, ObjectiveSense
from ssp_lp.processes.past_failing import check_counted_past_failing
from ssp_lp.processes.quantities import Quantity, objective_of
from ssp_lp.processes.quotient import Spread, unmerged
from ssp_lp.programs.augmented import BOUND_TO_START, START, STAY, AugmentedProcess, ColumnLabel
from ssp_lp.programs.occupation_measure import (
    ROUNDING,
    OccupationMeasure,
    StateValues,
    balanced_visits,
)

if TYPE_CHECKING:
    from ssp_lp.programs.convex_program import Conflict, ConvexProgram

_TRIFLE = 1e-13  # price times scale of a row, relative to the greatest cost, that counts as 0
_RATIOS = 4  # steps of Dinkelbach's iteration, which starts at a solver's optimum


@dataclass(frozen=True, eq=False)
class ProgramRow:
    """A row ``<coefficients, x> <= bound``: a quantity of the visits and its upper limit."""

    name: str
    coefficients: FloatArray  # [pairs]
    bound: float
    words: str  # the bounded quantity

    @property
    def largest(self) -> float:
        """Largest absolute value of a coefficient."""
        return float(np.abs(self.coefficients).max(initial=0.0))

    @property
    def scale(self) -> float:
        """Largest absolute value of the bound and the coefficients."""
        return max(abs(self.bound), self.largest)

    def violation(self, activity: float) -> float:
        """Return the excess of an activity over the bound, relative to the bound; 0 if none.

        An excess within the rounding error of the largest coefficient does not count.
        """
        excused = ROUNDING * self.largest
        left = max(activity - self.bound - excused, 0.0)
        return left / max(abs(self.bound), excused, 1e-300) if left else 0.0


def rows_program(
    process: ExplicitProcess, limits: Mapping[str, tuple[FloatArray, float]], ratio: bool
) -> LinearProgram:
    """Build the linear program of a process with named rows.

    Args:
        process: the process whose pairs are the columns.
        limits: name -> (coefficient of each pair, [pairs], and bound).
        ratio: whether the objective is <cost, x> / <goal, x> (case S); the last column is then t.
    """
    n_states, n_pairs, n_limits = process.n_states, process.n_pairs, len(limits)
    bounds, free = np.array([bound for _, bound in limits.values()]), np.full(n_limits, -np.inf)
    cost, upper = process.cost, np.concatenate([process.start, bounds])
    lower = np.concatenate([process.start, free])
    places = {name: slice(n_states + k, n_states + k + 1) for k, name in enumerate(limits)}
    rows = {"balance": slice(0, n_states)} | places
    taken = [row for row, _ in limits.values()]
    if ratio:
        taken, last = [*taken, process.goal], n_states + n_limits
        rows["normaliser"] = slice(last, last + 1)
    # one column for each pair, assembled as rows of the transposed matrix
    columns = list[sp.csr_array]()
    for some in pieces(n_pairs, process.transitions.nnz):
        count = some.stop - some.start
        place = np.ones(count), process.pair_state[some], np.arange(count + 1)
        balance = sp.csr_array(place, shape=(count, n_states)) - process.transitions[some]
        each = [sp.csr_array(row[some, None]) for row in taken]
        columns.append(sp.csr_array(sp.hstack([balance, *each])) if each else balance)
    if ratio:
        columns.append(sp.csr_array(np.append(-upper, 0.0)[None, :]))
        cost = np.append(cost, 0.0)
        upper = np.append(np.zeros(last), 1.0)
        lower = np.concatenate([np.zeros(n_states), free, [1.0]])
    check_time()
    matrix = sp.csc_array(sp.csr_array(sp.vstack(columns)).T)
    return LinearProgram(cost, matrix, lower, upper, rows)


@dataclass(frozen=True, eq=False)
class _Reduction:
    """A smaller program, which is solved in place of the stated program, and the map between them.

    In the smaller program, end components of cost 0 are merged and self-loops are removed.
    """

    program: OccupationProgram
    spread: Spread

    def _by_copy(self, values: FloatArray, made: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Apply a function to the values of each copy, and keep the last value, the source's.

        Args:
            values: [copies * width + 1].
            made: maps the values of one copy, [width], to new values.
        """
        copies = self.program.augmented.copies
        own = map(made, values[:-1].reshape(copies, -1))
        return np.concatenate([*own, values[-1:]])

    def row(self, stated: AugmentedProcess, coefficients: FloatArray) -> FloatArray:
        """Translate coefficients, [pairs], from the smaller program to the stated one."""
        taken = self.program.augmented.in_all_copies(coefficients)
        return self._by_copy(taken, self.spread.per_visit)[stated.part.pairs]

    def departures(self, stated: AugmentedProcess, visits: FloatArray) -> FloatArray:
        """Translate visits, [stated pairs], from the stated program to the smaller one, [pairs]."""
        gone = self._by_copy(stated.in_all_copies(visits), self.spread.departures)
        return gone[self.program.augmented.part.pairs]

    def lifted(self, stated: OccupationProgram, measure: OccupationMeasure) -> OccupationMeasure:
        """Translate a measure of the smaller program to the stated program.

        Visits of moves within merged components are added.
        """
        augmented = self.program.augmented
        own = map(self.spread.visits, augmented.flows(measure.visits))
        source = augmented.in_all_copies(measure.visits)[-1:]
        visits = np.concatenate([*own, source])[stated.augmented.part.pairs]
        values = None if measure.values is None else self.values(stated, measure.values)
        return replace(measure, program=stated, visits=visits, values=values, reduced=measure)

    def values(self, stated: OccupationProgram, found: StateValues) -> StateValues:
        """Translate values of states of the smaller program to the stated one."""
        augmented = self.program.augmented
        nodes = augmented.quotient.node_of[self.spread.quotient.first_states]
        every = np.zeros(augmented.copies * augmented.quotient.n_nodes + 1)
        every[augmented.part.states] = found.states
        states = self._by_copy(every, lambda values: values[nodes])
        states = states[stated.augmented.part.states]
        return StateValues(stated, states, self.row(stated.augmented, found.reduced_costs))


@dataclass(frozen=True, eq=False, repr=False)
class OccupationProgram(Report):
    """A linear program over the visits of an augmented process.

    Columns are the pairs of the process, including self-loops and steps of cost 0. The variable x
    is the expected number of times that each pair is taken. Case S has one more column, the
    Charnes-Cooper scale t: the columns are the visits times t, so that the goal probability becomes
    1.
    """

    title: str  # the formulation
    objective: str  # the minimised quantity, in a word
    augmented: AugmentedProcess
    rows: tuple[ProgramRow, ...]
    ratio: bool = False  # <cost, x> / <goal, x>
    sense: ObjectiveSense = AS_IS  # relation of <objective, x> to the problem's objective
    wants_ends: bool = False  # whether a row counts an end other than the goal
    at_least: bool = False  # whether only actions of greatest goal probability are included
    reduced: _Reduction | None = None  # the program that is solved; None: this one
    remade: Callable[..., OccupationProgram] | None = None  # rebuild from bounds and start

    @property
    def process(self) -> ExplicitProcess:
        """The process whose pairs are the columns."""
        return self.augmented.process

    @property
    def bounds(self) -> dict[str, float]:
        """Bound of each row, by name."""
        return {row.name: row.bound for row in self.rows}

    def bounded_by(self, bounds: Mapping[str, float], *, anew: bool = True) -> OccupationProgram:
        """Return the program with other bounds, by name of the row; see :meth:`row`.

        Two parts depend on the bounds and are rebuilt: the accumulated costs that are
        distinguished, and, with least failure, the actions that attain it.

        Args:
            bounds: bound of each row that changes, by name.
            anew: whether to rebuild the program if its columns depend on the bounds.

        Raises:
            ModelError: there is no such row, or a bound is not a number.
            InfeasibleError: the budget is below the least failure.
        """
        check_bounds(bounds)
        now = self.bounds
        make = self.remade if anew and (self.at_least or self.augmented.copies > 1) else None
        unstated = {"failure"} if self.at_least and make is not None else set[str]()
        then = now | {n if n in unstated else self.row(n).name: b for n, b in bounds.items()}
        if then == now:
            return self
        if make is not None:
            return make(then)
        return self.with_rows(lambda row: replace(row, bound=then[row.name]))

    @explained
    def with_rows(self, changed: Callable[[ProgramRow], ProgramRow | None]) -> OccupationProgram:
        """Return the program with each row replaced by ``changed(row)``; None removes the row."""
        inner = self.reduced and replace(
            self.reduced, program=self.reduced.program.with_rows(changed)
        )
        return replace(self, rows=tuple(filter(None, map(changed, self.rows))), reduced=inner)

    def started(self, start: Hashable | Mapping[Hashable, float]) -> OccupationProgram:
        """Return the program from another start: a state, or a distribution.

        Three parts depend on the start and are rebuilt: the accumulated costs that are
        distinguished, the steps under a horizon, and the source of episodes that end where they
        begin.

        Raises:
            ModelError: unknown states, or probabilities that are no distribution.
            InfeasibleError: the budget is below the least failure.
        """
        reduced, make = self.reduced, self.remade
        there = self.augmented.started(start)
        if there is not None:
            inner = reduced and replace(reduced, program=reduced.program.started(start))
            make = make and partial(make, start=start)
            return replace(self, augmented=there, reduced=inner, remade=make)
        if make is None:
            raise ModelError(BOUND_TO_START)
        return make(self.bounds, start=start)

    def spread_out(self) -> OccupationProgram:
        """Return the program with a column for each pair of the model, self-loops included.

        The present program, in which components are merged, remains as ``reduced``: it is solved in
        place of the result.
        """
        spread = unmerged(self.augmented.quotient, self.augmented.live.escape)
        if spread is None:
            return self
        reduction, augmented = _Reduction(self, spread), self.augmented.spread(spread)
        rows = (
            replace(row, coefficients=reduction.row(augmented, row.coefficients))
            for row in self.rows
        )
        return replace(self, augmented=augmented, rows=tuple(rows), reduced=reduction)

    @cached_property
    def linear(self) -> LinearProgram:
        """The program's arrays, for a solver."""
        return self._stated_on(self.process, ratio=self.ratio)

    def _stated_on(self, process: ExplicitProcess, *, ratio: bool) -> LinearProgram:
        """Return the arrays of the program on a process, which may have other costs.

        Args:
            process: has the costs.
            ratio: whether the objective is divided by the goal probability.
        """
        limits = {row.name: (row.coefficients, row.bound) for row in self.rows}
        return rows_program(process, limits, ratio)

    def label(self, column: int) -> ColumnLabel:
        """Return the state, action and accumulated cost whose visits a column counts.

        Raises:
            ModelError: there is no such pair; the scale t of case S has no label.
        """
        if not 0 <= column < self.process.n_pairs:
            raise ModelError(f"no pair has column {column}: pass 0 .. {self.process.n_pairs - 1:,}")
        label = self.augmented.label(int(self.augmented.part.pairs[column]))
        if label.action is GIVE_UP and self.reduced is not None:
            merged = self.reduced.program.augmented.quotient.merged
            if merged[self.augmented.model.index_of(label.state)]:
                return label._replace(action=STAY)
        return label

    @explained
    def columns(self, state: Hashable, action: Hashable | None = None) -> tuple[int, ...]:
        """Return the indices in x of an action in a state, in case S one per accumulated cost.

        Args:
            state: a state of the model, or of the model from which it was built as a product.
            action: one of its actions, ``GIVE_UP``, ``"stay for ever"``, or None for all of them.

        Raises:
            ModelError: unknown state or action.
        """
        augmented = self.augmented
        return tuple(augmented.pairs_of(augmented.model.places_of(state), action).tolist())

    @explained
    def visits(self, state: Hashable, action: Hashable | None = None) -> FloatArray:
        """Return the coefficients of x that count visits of a state or action, [pairs].

        Args:
            state: a state of the model, or of the model from which it was built as a product; for
                states in which episodes end, arrivals are counted.
            action: as in :meth:`columns`.

        Raises:
            ModelError: unknown state or action.
        """
        counted = np.zeros(self.process.n_pairs)
        counted[list(self.columns(state, action))] = 1.0
        if action is None:
            model = self.augmented.model
            there = np.isin(np.arange(model.n_states), model.places_of(state))
            ends = there & (self.augmented.quotient.node_of < 0)
            counted += self.augmented.counted(ArrivalTerm(model, ends))
        return counted

    @explained
    def expression(self, quantity: Quantity) -> tuple[FloatArray, float]:
        """Return a quantity as coefficients of x, [pairs], and a constant.

        Raises:
            ModelError: unknown states, actions or ends, costs of the wrong shape, or events after
                failing, which the program does not distinguish.
        """
        model, start = self.augmented.model, self.augmented.start
        stated = objective = objective_of(model, start, quantity, signed=True)
        if (label := model.failure_label) is not None:
            begun = start[: label.n_original]
            stated = objective_of(label.original, begun, quantity, signed=True)
        check_counted_past_failing(model, stated, self.augmented.semantics, ratio=self.ratio)
        terms = (weight * self.augmented.counted(term) for weight, term in objective.terms)
        return sum(terms, np.zeros(self.process.n_pairs)), objective.constant

    @explained
    def column(self, state: Hashable, action: Hashable, cost: float | None = None) -> int:
        """Return the index in x of an action in a state, in case S at an accumulated cost.

        Raises:
            ModelError: no such column, or several.
        """
        columns = self.columns(state, action)
        if cost is not None:
            columns = tuple(k for k in columns if self.label(k).cost == cost)
        if len(columns) == 1:
            return columns[0]
        at = "" if cost is None else f" at cost {cost:g}"
        if not columns:
            raise ModelError(f"action {action!r} of state {state!r}{at} has no column: no policy "
                             "of the program takes it there")  # fmt: skip
        raise ModelError(
            f"action {action!r} of state {state!r} has {len(columns):,} columns, one for each "
            "accumulated cost: give cost=..., or use columns(...)"
        )

    @explained
    def row(self, name: str) -> ProgramRow:
        """Return the row of a name.

        Raises:
            ModelError: no row has this name.
        """
        for row in self.rows:
            if row.name == name:
                return row
        names = ", ".join(repr(row.name) for row in self.rows) or "none"
        raise ModelError(f"no row is named {name!r}; there are {names}")

    @explained
    def solve(
        self,
        backend: str | None = None,
        *,
        time_limit: float = np.inf,
        warm_start: OccupationMeasure | None = None,
    ) -> OccupationMeasure:
        """Solve the program, and recompute the solver's answer from the model.

        Args:
            backend: "highs", "highs-simplex", "highs-ipx" or "cvxpy"; None: by size.
            time_limit: seconds.
            warm_start: the optimum at other bounds, costs or starts. HiGHS's simplex starts from it
                if its program has the same shape; other backends do not use it.

        Raises:
            ModelError: an unknown backend.
            InfeasibleError: no visits satisfy all rows.
            SolverError: no backend's answer has a small residual and a small proved gap.
        """
        if self.reduced is not None:
            inner = self.reduced.program
            optimum = inner.solve(backend, time_limit=time_limit, warm_start=warm_start)
            return self.reduced.lifted(self, optimum)
        tried, infeasible = list[str](), False
        basis = None if warm_start is None else warm_start.basis
        for answer in answers_in_turn(self.linear, backend, time_limit, basis):
            report = f"{answer.backend}: {answer.status}"
            refused = "infeasible" in answer.status.lower()
            infeasible = infeasible or refused
            has_scale = not self.ratio or answer.x[-1] > 0.0  # to divide visits by
            if not refused and has_scale and np.isfinite(answer.x).all():
                try:
                    measure = self._answered(answer)
                except SolverError as error:
                    report += f", {error}"
                else:
                    if measure.gap <= RESIDUAL and measure.residual <= RESIDUAL:
                        return measure
                    report += f", gap {measure.gap:.1e}, residual {measure.residual:.1e}"
            tried.append(report)
        if infeasible:
            raise self.infeasible()
        raise SolverError(f"no backend passes its check ({'; '.join(tried)}): use solve(problem)")

    def infeasible(self) -> InfeasibleError:
        """Return the error for rows that no visits satisfy together."""
        if self.remade is not None:
            try:  # names the least failure, or the rows in conflict
                self.remade(self.bounds)
            except InfeasibleError as error:
                return error
        return InfeasibleError(
            "no expected visits satisfy all rows of the program: program.conflict() names the rows "
            "that contradict each other",
            failure_budget=self.bounds.get("failure"),
            least_failure=float("nan"),
        )

    @explained
    def measure(self, x: npt.ArrayLike) -> OccupationMeasure:
        """Return visits, however they were found, as a measure without duals.

        The visits are not changed; ``residual`` is the amount by which they violate the rows.

        Args:
            x: expected visits of each pair, [pairs]; or, in case S, a value of each column of
                ``linear``, visits times the scale and then the scale, [pairs + 1].

        Raises:
            ModelError: another shape, or values that are not finite numbers.
        """
        values, n_pairs = np.asarray(x, dtype=np.float64), self.process.n_pairs
        if self.ratio and values.shape == (n_pairs + 1,):
            values = values[:-1] / values[-1]
        if values.shape != (n_pairs,) or not np.isfinite(values).all():
            raise ModelError(f"x must be {n_pairs:,} finite numbers, a value for each column")
        return OccupationMeasure(self, values, ByName(), None, "given", "as given", 0.0)

    def read_solution(self, path: str | Path) -> OccupationMeasure:
        """Read a solver's solution of the program that :meth:`write` wrote, as a measure.

        Args:
            path: a ``.sol`` file of HiGHS, or any text in which each name is followed by its value;
                columns that it does not name are 0.

        Raises:
            ModelError: the file cannot be read, or names no column of the program.
        """
        from ssp_lp.linear_programming.highs import read_columns

        return self.measure(read_columns(Path(path), self.process.n_pairs + self.ratio))

    def _answered(self, answer: LPAnswer) -> OccupationMeasure:
        """Return a solver's answer as a measure, with balanced visits and a proved bound."""
        rows, dual = self.linear.rows, answer.dual
        scale = float(answer.x[-1]) if self.ratio else 1.0
        prices = ByName({row.name: max(-float(dual[rows[row.name]][0]), 0.0) for row in self.rows})
        ratio = float(dual[rows["normaliser"]][0]) if self.ratio else 0.0
        visits = answer.x[: self.process.n_pairs] / scale
        origin = answer.backend, answer.status, answer.seconds
        measure = OccupationMeasure(self, visits, prices, None, *origin, basis=answer.basis)
        return self.optimal(measure, ratio)

    def optimal(self, measure: OccupationMeasure, ratio: float) -> OccupationMeasure:
        """Return a solver's optimum with exact flow balance and the bound that its duals prove.

        Args:
            measure: the solver's answer, whose visits balance within the solver's tolerance.
            ratio: in case S the dual of the normalising row.
        """
        if self.reduced is not None:
            departures = self.reduced.departures(self.augmented, measure.visits)
            inner = self.reduced.program
            reduced = inner.optimal(replace(measure, program=inner, visits=departures), ratio)
            return self.reduced.lifted(self, reduced)
        proved, value = self.proved(measure.prices, ratio)
        visits = proved.without_noise(measure.visits)
        gives_up = None if self.wants_ends else self.augmented.gives_up  # a run ends in either case
        visits = balanced_visits(self.process, visits, proved.choice, gives_up)
        values = StateValues(self, proved.values, proved.excess)
        return replace(measure, visits=visits, optimal_value_from_dual=value, values=values)

    def values_at(self, prices: Mapping[str, float], ratio: float = 0.0) -> StateValues:
        """Return the values of states at given prices of the rows.

        Args:
            prices: nonnegative prices by name; a row that is not named has price 0.
            ratio: in case S the reward for reaching the goal, which is c* at optimal prices.

        Raises:
            ModelError: a price or the ratio is not a finite number.
        """
        for name, price in {"ratio": ratio, **prices}.items():
            if not (is_number(price) and np.isfinite(float(price))):
                raise wrong_argument(name, "be a finite number", price)
        if self.reduced is not None:
            inner = self.reduced.program.values_at(prices, ratio)
            return self.reduced.values(self, inner)
        cost, _ = self._lagrangian(prices)
        priced = priced_minimum(self.process, cost - self.ratio * ratio * self.process.goal)
        return StateValues(self, priced.values, priced.excess)

    def proved(
        self, prices: Mapping[str, float], ratio: float = 0.0
    ) -> tuple[PricedMinimum, float]:
        """Return the best policy at prices of the rows, and the bound that they prove.

        For prices l >= 0 of the rows <q, x> <= b, every feasible measure satisfies ``<cost, x> >=
        <cost + l q, x> - l b``. The minimum of the right side over all x that satisfy flow balance
        is a lower bound of the program. The bound also holds for the problem if the program has all
        its columns.

        Args:
            prices: prices of the rows, by name, >= 0.
            ratio: in case S a value near the optimum.
        """
        least_worth = _TRIFLE * float(np.abs(self.process.cost).max(initial=0.0))
        worth = {row.name: prices.get(row.name, 0.0) * row.scale for row in self.rows}
        counting = {name: prices[name] for name, each in worth.items() if each > least_worth}
        minimum, value = self.least_of_visits(*self._lagrangian(counting), ratio)
        return minimum, self.sense.stated(value)

    def least_of_visits(
        self, cost: FloatArray, constant: float, ratio: float = 0.0
    ) -> tuple[PricedMinimum, float]:
        """Minimise ``<cost, x> + constant``, in case S divided by ``<goal, x>``.

        All visits x that satisfy flow balance are allowed. In case S, ``<cost, x> + constant - c
        <goal, x>`` is minimised for a given ratio c. If the minimum is at least D <= 0, no ratio is
        below ``c + D / g``, where g is the least goal probability within the rows.

        Args:
            cost: [pairs].
            constant: added to the expected cost.
            ratio: in case S a value c near the optimum, at which Dinkelbach's iteration starts.

        Returns:
            A best policy, and a proved lower bound of the minimum.
        """
        minimum, value = priced_minimum(self.process, cost - ratio * self.process.goal), -np.inf
        if not self.ratio:
            return minimum, minimum.bound + constant
        for _ in range(_RATIOS):
            left = minimum.bound + constant
            least = 1.0 if left >= 0.0 else self._least_goal
            if least <= 0.0:  # failing is free: lower the ratio so that it is strictly best
                ratio *= BELOW_RATIO
            else:
                if ratio + left / least <= value:
                    break
                value = ratio + left / least
                if minimum.goal <= 0.0 or left == 0.0:
                    break
                ratio += left / minimum.goal
            minimum = priced_minimum(self.process, cost - ratio * self.process.goal)
        return minimum, value

    def _lagrangian(self, prices: Mapping[str, float]) -> tuple[FloatArray, float]:
        """Return the Lagrangian of the rows at given prices: a cost, [pairs], and a constant."""
        cost, constant = self.process.cost, 0.0
        for row in self.rows:
            if price := prices.get(row.name, 0.0):  # a bound with price 0 may be infinite
                cost, constant = cost + price * row.coefficients, constant - price * row.bound
        return cost, constant

    @cached_property
    def _least_goal(self) -> float:
        """Proved lower bound of the goal probability of all measures within the rows."""
        priced, budget = self.process.goal, self.bounds.get("failure", np.inf)
        least = max(priced_minimum(self.process, priced).bound, 1.0 - budget)
        if least > 0.0:
            return least
        reach = self._stated_on(replace(self.process, cost=priced), ratio=False)
        name = backends_for(reach, None)[0]
        dual, paid = run_backend(reach, name, np.inf).dual, 0.0
        for row in self.rows:  # any prices >= 0 prove a bound
            price = max(-float(np.nan_to_num(dual[reach.rows[row.name]][0])), 0.0)
            priced, paid = priced + price * row.coefficients, paid + price * row.bound
        return max(priced_minimum(self.process, priced).bound - paid, 0.0)

    def to_cvxpy(self) -> ConvexProgram:
        """Write the program in cvxpy, to add convex objectives and constraints."""
        from ssp_lp.programs.convex_program import ConvexProgram

        return ConvexProgram(self)

    def conflict(self, solver: str | None = None) -> Conflict:
        """Find rows that cannot be satisfied together; empty if there are none."""
        return self.to_cvxpy().conflict(solver)

    @explained
    def write(self, path: str | Path) -> None:
        """Write the program as ``.mps``, ``.mps.gz`` or ``.lp``, with names.

        Raises:
            ModelError: another ending.
            SolverError: HiGHS cannot write there.
        """
        from ssp_lp.linear_programming.highs import write_program

        write_program(self.linear, Path(path), self._columns)

    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Compute the range of each bound in which the row's price stays constant, by name.

        HiGHS computes the ranges at a vertex. If a row has several optimal prices, the range
        belongs to one of them.

        Raises:
            ModelError: case S, in which prices change with every bound.
            SolverError: the program has no optimum.
        """
        from ssp_lp.linear_programming.highs import bound_ranges

        if self.ratio:
            raise ModelError("prices of a cost given success change with every bound: use "
                             "trace_frontier(problem) to see where policies change")  # fmt: skip
        program = self if self.reduced is None else self.reduced.program
        return ByName(bound_ranges(program.linear, [row.name for row in self.rows]))

    @property
    def _columns(self) -> list[str]:
        """Names of the columns: their labels, and "t" in case S."""
        return [*map(str, map(self.label, range(self.process.n_pairs))), *["t"] * self.ratio]

    @property
    def _rows(self) -> list[str]:
        """Names of all rows: states with their accumulated cost, named rows, the normaliser."""
        acting = map(self.label, self.process.pair_offsets[:-1].tolist())
        states = [START if k.state is None else f"{k.state}{k.paid}" for k in acting]
        return [*states, *(row.name for row in self.rows), *["normaliser"] * self.ratio]

    @property
    def aim(self) -> tuple[str, str]:
        """The verb, "minimise" or "maximise", and the objective in words."""
        verb, aim = "minimise", f"<{self.objective}, x>"
        if self.sense.offset:
            aim = f"{aim} - {self.sense.offset:g}"
        if self.sense.constant is not None:
            verb, aim = "maximise", f"{self.sense.constant:g} - {aim}"
        return verb, aim

    @property
    def _stated_rows(self) -> list[tuple[str, str]]:
        """Names of all rows except balance, and each row in words."""
        times = " t" * self.ratio
        rows = [(row.name, f"<{row.words}, x> <= {row.bound:g}{times}") for row in self.rows]
        return rows + [("normaliser", "<goal, x> = 1")] * self.ratio

    @property
    def _dual_of_normaliser(self) -> str:
        """Remark on the normaliser's dual in case S."""
        sense, optimum = self.sense, "c*"
        if sense.constant is not None:
            optimum = f"{sense.constant:g} - c*"
        elif sense.offset:
            optimum = f"c* + {sense.offset:g}"
        return f" (its dual is {optimum})"

    def to_latex(self) -> str:
        """Return the program in LaTeX, for a displayed equation; in full if it is small."""
        if self.linear.is_small:
            verb, names = "minimise", self._rows
            aim, *rows = sums_as_latex(self.linear, self._columns, scaled=self.ratio)
        else:
            balance = f"<outflow, x> - <inflow, x> = {'t ' * self.ratio}start"
            stated, verb = [("", balance), *self._stated_rows], self.aim[0]
            names = [name for name, _ in stated]
            aim, *rows = map(words_as_latex, (self.aim[1], *(words for _, words in stated)))
        if self.ratio:
            names[-1] += self._dual_of_normaliser
        return as_latex(verb, aim, zip(names, rows, strict=True), scaled=self.ratio)

    def tables(self) -> list[Table]:
        """Return the program in words and, if it is small, in full: a row for each column."""
        full = as_table(self.linear, self._columns, self._rows) if self.linear.is_small else None
        return [Table(self._page(), title=self.title), *([] if full is None else [full])]

    def __repr__(self) -> str:
        """Return the program in words, as in a paper."""
        return "\n".join(Table(self._page(), title=self.title).lines())

    def _page(self) -> list[tuple[str, str]]:
        """Return objective, rows and variables in words."""
        process, scale = self.process, "t " * self.ratio
        width = max((len(name) for name, _ in self._stated_rows), default=0) + 1
        page = [f"balance: outflow(x) - inflow(x) = {scale}start   ({process.n_states:,} rows)"]
        page += [f"{f'{name}:':<{width}} {words}" for name, words in self._stated_rows]
        matrix = self.linear.matrix
        size = f"({matrix.shape[1]:,} columns, {matrix.nnz:,} entries)"
        page += [f"x >= 0{', t >= 0' * self.ratio}   {size}"]
        if self.ratio:
            page[-2] += "  " + self._dual_of_normaliser
            given = f"<{self.objective}, x> is the {self.objective} given success"
            page.append(f"x: visits times the scale t, so that {given}")
        return [self.aim, *zip(["subject to", *[""] * len(page)], page, strict=False)]
