"""Column generation (Dantzig-Wolfe) over deterministic policies.

1. The **restricted master** mixes the columns that are known into the best lottery within the rows;
   its duals are prices of the rows.
2. The **pricing problem** finds a policy of least cost plus priced rows: the column of least
   **reduced cost** (``minimise`` of a :class:`~ssp_lp.column_generation.column.PricingProblem`).
3. Where that lies below the master's own valuation it enters; else the search **stops**: the least
   priced cost, less what the rows allow at these prices, is a lower bound of the optimum
   (Lagrange).

:func:`generate` is that loop. A price rule keeps the lottery and says where the next column is
sought: :class:`Secant` for the failure row alone, :class:`StabilisedMaster` for any rows.

**One failure row.** The master program has the failure row and convexity, so its optimum lies on an
edge of the lower convex hull of the points (failure, cost). The rule keeps a feasible column A and
an infeasible column B, prices failure at the slope between them, and ends when no policy lies below
their line. In case S the objective is the ratio ``cost / (1 - failure)`` (paper, eq.
s3p_gamma_j_obj): as long as no column is infeasible the price is the ratio itself (Dinkelbach's
iteration).

**First columns** lie on both sides of the budget, and are found by pricing alone. The cheapest
policy of least failure takes two stages to find. A search does not need it: any policy that keeps
to the budget will do to begin with, and one is found at a steep price of failure, if not at the
first guess then at a steeper one. Only where that fails, because the budget is near the least
failure or below it, is the least failure itself worked out.

**Any number of rows.** For prices y >= 0 the least of ``cost + y @ activity`` over all policies,
minus ``y @ bounds``, is a lower bound of the optimum (Lagrange); the policy that attains it enters
the master wherever it lies below the master's own valuation. Far from the optimum the master's
prices zig-zag, so that pricing happens in between them and the best prices known (Wentges 1997,
"Weighted Dantzig-Wolfe decomposition"); where that finds nothing new, at the master's prices
themselves. Phase 1 is the same search with the violation of the rows in place of the cost.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    PricingProblem,
    Proof,
    excess_failure,
    least_of,
)
from ssp_lp.column_generation.compiled_problem import CompiledProblem, LeastFailure
from ssp_lp.column_generation.explicit_pricing import ExplicitPricing
from ssp_lp.column_generation.layered_pricing import OpenEndedPricing
from ssp_lp.column_generation.restricted_master import MasterOptimum, solve_master
from ssp_lp.compiled import deadline
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy

_NEVER = 1e-14  # a goal probability that is the rounding of none


@dataclass(frozen=True, eq=False)
class Generated:
    """Result of the loop: the best lottery over columns, and prices that prove it."""

    columns: tuple[Column, ...]
    weights: FloatArray  # [columns]
    prices: FloatArray  # [rows] at which the bound holds
    objective: float  # of the lottery; in phase 1 by how much it violates the rows
    lower_bound: float  # of the optimum
    finished: bool  # false: stopped by the time limit
    values: FloatArray | None = None  # the checked sub-solution, where the bound is certified
    excess: FloatArray = field(default_factory=partial(np.zeros, 0))
    """Phase 1: the violation in units of the rows' scales, [rows]."""

    @property
    def price(self) -> float:
        """Price of the only row that column generation ended with."""
        return float(self.prices[0])

    @property
    def figures(self) -> FloatArray:
        """Rewards of column generation's lottery, [rewards]: cost, failure and rows."""
        if len(self.columns) == 1:
            return self.columns[0].figures
        return np.asarray(self.weights @ np.stack([column.figures for column in self.columns]))

    @property
    def failure(self) -> float:
        """Failure of column generation's lottery."""
        return float(self.weights @ [column.failure for column in self.columns])

    @property
    def goal(self) -> float:
        """Goal probability of column generation's lottery.

        Summed over the members' own goal probabilities, which are exact where the sum is small.
        """
        return float(self.weights @ [column.goal for column in self.columns])

    @property
    def ratio(self) -> float:
        """Cost given success of column generation's lottery; infinite where there is no success."""
        goal, never = self.goal, 0.0 if self.columns[0].by_goal else _NEVER
        return float(self.figures[0]) / goal if goal > never else float("inf")

    def lottery(self, pricing: PricingProblem) -> MixedPolicy:
        """Column generation's lottery over policies of the model."""
        return MixedPolicy(tuple(pricing.policy(column) for column in self.columns), self.weights)


def generate(rule: Secant | StabilisedMaster, options: SolveOptions) -> Generated:
    """Column generation: add columns until the price rule finds none worth having, or time is up.

    Args:
        rule: where to begin; it moves on.
        options: tolerance, deadline, and who is told after each pricing call.
    """
    begun, finished = rule.calls, False
    with deadline.WithIncumbent():
        for _ in range(rule.most_rounds):
            if rule.calls > begun and deadline.is_late():
                break
            column = rule.seek(options.tolerance)
            told = column is not None and options.progress is not None
            report = rule.report() if told else None
            finished = column is None or rule.learn(column, options.tolerance)
            if options.progress is not None and report is not None:
                options.progress(rule.calls, *report)
            if finished:
                break
    return rule.concluded(options.tolerance, finished=finished)


_SHARE = 0.25  # of a search that its bounds on the way may take
_LONG = 0.1  # seconds of a pricing call, below which its proof can wait for the end
_SAME_COST = 1e-15  # relative; a weight so far below 1 is 1
_SAME_FAILURE = 1e-15  # of columns, one of which is the other, found again
_SAME_SMALL = 1e-14  # the same, relative to failures that are small and to goals that are rare


@dataclass(eq=False)
class Secant:
    """The two columns between which the lottery lies; ``outside`` is missing while none is."""

    pricing: PricingProblem
    row: FailureRow
    inside: Column  # keeps to the budget
    outside: Column | None = None  # cheaper, and breaks it
    last: Column | None = None  # found last: a warm start
    calls: int = 0
    work: Work = field(default_factory=Work)
    proof: Proof | None = None  # the best one so far
    took: float = 0.0  # seconds of the longest pricing call; a proof needs about as many
    _spent: float = 0.0  # seconds on proofs
    _since: float = field(default_factory=time.perf_counter)

    most_rounds: ClassVar[int] = 200

    @property
    def slope(self) -> float:
        """The secant's price of failure, at which both columns are worth the same; or the ratio."""
        if self.outside is not None:
            saved = self.inside.cost - self.outside.cost
            return max(saved / excess_failure(self.outside, self.inside), 0.0)
        return self.row.objective(self.inside.cost, self.inside.goal) if self.row.ratio else 0.0

    @property
    def weight(self) -> float:
        """Weight of the secant's column beyond the budget at which the lottery meets the budget."""
        if self.outside is None:
            return 0.0
        room = self.row.spare(self.inside) / excess_failure(self.outside, self.inside)
        if room * abs(self.inside.cost - self.outside.cost) <= _SAME_COST * abs(self.inside.cost):
            return 0.0  # what it would save is rounding
        return 1.0 if room > 1.0 - _SAME_COST else float(max(room, 0.0))

    @property
    def objective(self) -> float:
        """Objective of the lottery over the secant's two columns."""
        w = self.weight
        if self.outside is None or w == 0.0:
            return self.row.objective(self.inside.cost, self.inside.goal)
        return self.row.objective(
            (1.0 - w) * self.inside.cost + w * self.outside.cost,
            (1.0 - w) * self.inside.goal + w * self.outside.goal,
        )

    def report(self) -> tuple[float, float]:
        """The secant's price of failure and objective so far, for progress."""
        return self.slope, self.objective

    def seek(self, tolerance: float) -> Column:
        """The best column at the secant's slope, unless the last one is known to be that."""
        price, last = self.slope, self.last or self.inside
        if last.found_at != price:
            warm = last, self.inside, self.outside
            began, last = time.perf_counter(), self.pricing.minimise(price, *warm)
            self.took = max(self.took, time.perf_counter() - began)
            self.calls, self.work = self.calls + 1, self.work + last.work
            self._prove_on_the_way(price, last, began)
        self.last = last
        return last

    def learn(self, column: Column, tolerance: float) -> bool:
        """Replace one end of the secant by a column that lies below its line.

        One that never succeeds has no ratio: the price was too low, nothing is learnt. Where none
        lies below the line and the budget is slack, Dinkelbach's iteration goes on.
        """
        price, outside = self.slope, self.outside
        below = self.inside.cost - column.cost - price * excess_failure(column, self.inside)
        scale = abs(self.objective) * (self.inside.goal if self.row.ratio else 1.0)
        if not below > 0.1 * tolerance * max(scale, 1e-300):
            slack = self.row.ratio and outside is not None and price < self.objective
            self.outside = None if slack else outside
            return not slack
        if outside is not None and column.cost >= outside.cost - _SAME_COST * abs(outside.cost):
            same = min(_SAME_FAILURE, _SAME_SMALL * min(outside.failure, outside.goal))
            if abs(excess_failure(column, outside)) <= same:
                return True  # the one beyond the budget again
        if self.row.breaks(column):
            self.outside = column
        elif self.row.objective(column.cost, column.goal) < np.inf:
            self.inside = column
        return False

    def concluded(self, tolerance: float, *, finished: bool) -> Generated:
        """The lottery of the secant's ends, and a certified bound at its slope."""
        row, price, last = self.row, self.slope, self.last or self.inside
        if self.outside is not None and deadline.has_time_for(self.took):
            # with the tails of this price, if one is still on each side of the budget
            with deadline.WithIncumbent(), deadline.closing():
                both = [self.pricing.aligned(c, price) for c in (self.inside, self.outside)]
                if row.breaks(both[1]) and not row.breaks(both[0]):
                    self.inside, self.outside = both
        weight, best = self.weight, self.objective
        columns: tuple[Column, ...] = (self.inside,)
        weights = np.ones(1)
        if self.outside is not None and weight == 1.0:
            columns = (self.outside,)
        elif self.outside is not None and weight > 0.0:
            columns, weights = (self.inside, self.outside), np.array([1.0 - weight, weight])
        price = max(price, best) if row.ratio else price
        slack = row.ratio and price <= best  # then prove it just below it: Row.lower_bound
        at = price * (1.0 - 0.25 * tolerance) if slack else price
        proof = self._proved(at, last, slack=slack or row.is_rare)
        price = price if proof.price == at else max(proof.price, best if row.ratio else 0.0)
        self.work = self.work + proof.work
        bound = least_of(row.lower_bound(proof), best)
        return Generated(columns, weights, np.array([price]), best, bound, finished, proof.values)

    def _prove_on_the_way(self, price: float, best: Column, began: float) -> None:
        """Prove the secant's bound at a price, if there is a time limit and proofs take little.

        Args:
            price: of failure.
            best: a policy of least value at this price.
            began: when its pricing began, on the clock of ``time.perf_counter``.
        """
        now = time.perf_counter()
        if (
            not deadline.is_limited()
            or now - began < _LONG
            or self._spent > _SHARE * (now - self._since)
        ):
            return
        with deadline.WithIncumbent():
            proof = self.pricing.prove(price, best, slack=self.row.is_rare)
            bound = self.row.lower_bound
            if self.proof is None or bound(proof) > bound(self.proof):
                self.proof = proof
        self._spent += time.perf_counter() - now

    def _proved(self, price: float, best: Column, *, slack: bool) -> Proof:
        """The secant's final proof; where there is no time for it the best so far, or the trivial.

        The values of a trivial bound ask a certificate for the best that can be had.
        """
        with deadline.WithIncumbent():
            if deadline.has_time_for(self.took):
                with deadline.closing():
                    return self.pricing.prove(price, best, slack=slack)
        return self.proof or Proof(price, price, -np.inf, self.pricing.anything)


_STEEP = 5.0  # first price of failure, in costs of a policy that goes for the goal
_STEPS = (3.0, 15.0, 255.0)  # relative steps of the price until both sides are known
_LEAST_FACTOR = 1.5  # by which the price moves at least while it is a guess
_HINTED_STEPS = (1.0, 1e2, 1e4, 1e6)  # the same from a guess, in units of the guess's uncertainty


@dataclass(frozen=True)
class DualGuess:
    """A price to begin with, such as the dual of a linear program or of a coarser process."""

    price: float
    spread: float  # relative uncertainty
    slack: bool = False  # whether the budget was slack there, so that one side is all there is


def columns_at(pricing: PricingProblem, least: LeastFailure, row: FailureRow) -> Secant:
    """Begin the secant at the policy of least failure; rounding raises the budget to it."""
    return Secant(pricing, row.raised_to(least.column), least.column)


def columns_by_pricing(
    compiled: CompiledProblem, row: FailureRow, guess: DualGuess | None, options: SolveOptions
) -> Secant | None:
    """Begin the secant: price failure up and down until columns lie on both sides of the budget.

    Args:
        compiled: says the process and the pricing.
        row: budget and form of the objective.
        guess: a price to begin with; None: a multiple of what a run costs.
        options: deadline, and who is told after each pricing call.

    Raises:
        Stop: the time ended before a column that keeps to the budget was found.

    Returns:
        None where no column that keeps to the budget was found.
    """
    last, doing = None, "the process was still being built"
    with deadline.WithIncumbent() as search:
        pricing = compiled.pricing()
        doing = "the totals of a first policy were being worked out"
        if guess is None:
            last = pricing.first()
            typical = last.cost if last.goal <= 0.0 else row.objective(last.cost, last.goal)
            if row.is_rare and last.goal > 0.0:
                typical = last.cost / last.goal
            price = _STEEP * typical if typical > 0.0 else 1.0
        else:
            price = guess.price
    if search.stop:
        raise deadline.Stop(told=doing) from search.stop
    steps = _STEPS if guess is None else tuple(guess.spread * step for step in _HINTED_STEPS)
    one_sided = price == 0.0 or (guess is not None and guess.slack)
    inside: Column | None = None
    outside: Column | None = None
    work, calls, began, took = Work(), 0, time.perf_counter(), 0.0
    with deadline.WithIncumbent() as search:
        for step in (*steps, None):
            began = time.perf_counter()
            last, calls = pricing.minimise(price, last, inside, outside), calls + 1
            took = max(took, time.perf_counter() - began)
            work, value = work + last.work, row.objective(last.cost, last.goal)
            if row.breaks(last):
                outside = last
            elif value < np.inf:
                inside = last
                deadline.ensure_incumbent(by_itself=True)
            if options.progress is not None:
                options.progress(calls, price, value if last is inside else np.inf)
            enough = one_sided or outside is not None or deadline.is_late()
            if step is None or (inside is not None and enough):
                break
            size, ends = 1.0 + step, (last.failure, row.budget)
            if row.is_rare:
                ends = last.goal, row.demanded
            if guess is None and min(ends) > 0.0:
                # failure falls about as fast as the price rises; the square of their ratio
                # overshoots, so that the columns lie on both sides and not far apart
                ratio = max(ends) / min(ends)
                size = min(max(ratio * ratio, _LEAST_FACTOR), size)
            price = price * size if row.spare(last) < 0.0 else price / size
    if search.stop:
        took = max(took, time.perf_counter() - began)
        inside = last = _initial_column_within(pricing, row, search.stop, inside, last)
    if inside is None or last is None:
        return None
    return Secant(pricing, row, inside, outside, last, calls, work, took=took)


def _initial_column_within(
    pricing: PricingProblem, row: FailureRow, stop: BaseException, *candidates: Column | None
) -> Column:
    """Best known column within the budget to begin with, when the time ends.

    Args:
        pricing: was stopped.
        row: the budget.
        stop: what stopped it.
        candidates: columns so far.

    Raises:
        Stop: none of them keeps to the budget.
    """

    def is_answer(column: Column) -> bool:
        """Whether a column is a policy, no guess at one, that has a worth within the budget."""
        is_policy = column.choice is not None or column.policy is not None
        has_worth = row.objective(column.cost, column.goal) < np.inf
        return is_policy and has_worth and not row.breaks(column)

    columns = [column for column in candidates if column is not None]
    with deadline.WithIncumbent(), deadline.closing():
        if not any(map(is_answer, columns)):
            reached = pricing.incumbent(stop.choice) if isinstance(stop, deadline.Stop) else None
            columns.append(pricing.first() if reached is None else reached)
    answers = list(filter(is_answer, columns))
    if not answers:
        least_failure = min((column.failure for column in columns), default=1.0)
        raise deadline.Stop(
            told=f"the safest policy known by then fails with {least_failure:.6g}"
        ) from stop
    return min(answers, key=lambda column: row.objective(column.cost, column.goal))


_IN_BETWEEN = 0.5  # share of the best known prices in those that are tried
_SLIGHT = 1e-6  # worth of a row, relative to the objective, that a price in between may neglect
_ROUNDING = 1e-15  # relative, of weighted totals
_FEASIBLE = 1e-15
"""Sum of the rows' violations, relative to their sizes, that is no more than rounding."""


@dataclass(eq=False)
class StabilisedMaster:
    """One phase on a pool of policies, some lottery over which keeps to the rows, unless elastic.

    Elastic: minimise the violation of the rows, each relative to its scale, not the cost.
    """

    pool: Pool
    rows: Rows
    prices: FloatArray  # [rows] the best that are known, or thought to be good
    bound: float = 0.0  # of the optimum at these prices, uncertified
    elastic: bool = False
    in_between: float = _IN_BETWEEN
    share: float = field(init=False)  # of the best known prices in those that are tried next
    master: MasterOptimum = field(init=False)
    tried: FloatArray = field(init=False)  # [rows] prices of the last pricing call

    most_rounds: ClassVar[int] = 2_000

    def __post_init__(self) -> None:
        """Begin with prices in between."""
        self.share = self.in_between

    @property
    def calls(self) -> int:
        """Pricing calls of the stabilised search so far, those of earlier phases included."""
        return self.pool.calls

    def seek(self, tolerance: float) -> Column | None:
        """A best column at stabilised prices; None where all rows are kept in phase 1."""
        self.master = self._solved()
        if self.master.value - self.bound <= self._near(tolerance):
            self.share = 0.0
        if self.elastic and self.master.value <= _FEASIBLE:
            self.prices = self.master.prices
            return None
        self.tried = self._between()
        weights = self.rows.weights(self.tried, 0.0 if self.elastic else 1.0)
        return self.pool.priced(weights)

    def report(self) -> tuple[float, float]:
        """The price of failure and the objective of the stabilised search so far."""
        failure = float(self.tried[self.rows.index == 1].sum())
        return failure, np.inf if self.elastic else self.master.value

    def learn(self, column: Column, tolerance: float) -> bool:
        """Stabilised search: keep the better bound, and a column below the master's valuation."""
        best, near = self.master.value, self._near(tolerance)
        value = self._value(column, self.tried)
        beyond = np.abs(column.figures[self.rows.index] - self.rows.bounds)
        objective = abs(self._objective(column))
        rounding = _ROUNDING * (objective + float(self.master.prices @ beyond))
        below = best - self._value(column, self.master.prices)
        new = below > max(near, rounding) and self.pool.add(column)
        finished = self.share == 0.0 and (not new or best - value <= near)
        if finished or value > self.bound:
            self.prices, self.bound = self.tried, value
        self.share = self.in_between if new else 0.0
        return finished

    def concluded(self, tolerance: float, *, finished: bool) -> Generated:
        """Stabilised search concluded: the lottery, and the bound at the best prices."""
        master = self.master if finished else self._solved()
        used = np.flatnonzero(master.weights > 0.0)
        lottery = tuple(self.pool.columns[k] for k in used.tolist()), master.weights[used]
        prices, value = self.prices, master.value
        return Generated(*lottery, prices, value, self.bound, finished, excess=master.excess)

    def _near(self, tolerance: float) -> float:
        """Gap at which column generation goes on without stabilisation, or ends."""
        return 0.1 * tolerance * abs(self.master.value)

    def _between(self) -> FloatArray:
        """Stabilised prices, between the best and the master's; at a share of 0 these, [rows]."""
        best, share = self.master.value, self.share
        own = without_negligible_prices(self.master.prices, self.pool.sizes(self.rows), best)
        if share == 0.0:
            return own
        mixed = share * self.prices + (1.0 - share) * own
        return without_negligible_prices(mixed, self.rows.scales, best, _SLIGHT)

    def _solved(self) -> MasterOptimum:
        """Stabilised search: the restricted master's best lottery over the pool's columns."""
        figures, rows = self.pool.figures, self.rows
        cost, taken = rows.objective(figures), figures[rows.index]
        return solve_master(cost, taken, rows.bounds, rows.scales, elastic=self.elastic)

    def _value(self, column: Column, prices: FloatArray) -> float:
        """Lagrangian value of a column; its coefficient in a row is counted from the bound."""
        beyond = column.figures[self.rows.index] - self.rows.bounds
        return self._objective(column) + float(prices @ beyond)

    def _objective(self, column: Column) -> float:
        """Stabilised search: the objective of a column in the master."""
        return 0.0 if self.elastic else float(self.rows.objective(column.figures))


def without_negligible_prices(
    prices: FloatArray, sizes: FloatArray, objective: float, trifle: float = 1e-12
) -> FloatArray:
    """The master's prices in the search, those too small to matter set to 0, [rows].

    Args:
        prices: [rows].
        sizes: of each row: what policies take of it, for a price that is to prove a bound; what is
            allowed of it is not enough, since the saving of a policy that takes more counts.
        objective: to which a price's worth is compared.
        trifle: share of it that does not matter.
    """
    return np.where(prices * sizes <= trifle * abs(objective), 0.0, prices)


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows that are limited: which, by how much, and the size of their numbers."""

    index: IntArray  # [rows] position among the pricing problem's rewards
    bounds: FloatArray  # [rows]
    scales: FloatArray  # [rows] > 0
    n_rewards: int
    ratio: float = 0.0  # what failing counts in the objective besides (Dinkelbach)

    def among(self, some: tuple[int, ...]) -> Rows:
        """Rows of a column search by their positions in the pool."""
        k = list(some)
        return replace(self, index=self.index[k], bounds=self.bounds[k], scales=self.scales[k])

    def relaxed(self, excess: FloatArray) -> Rows:
        """Rows of a column search, bounds raised by an excess in units of scales, [rows]."""
        return replace(self, bounds=self.bounds + np.maximum(excess, 0.0) * self.scales)

    def objective(self, figures: FloatArray) -> FloatArray:
        """Objective of columns in the pool by totals that begin with cost and failure, [...]."""
        return np.asarray(figures[0] + self.ratio * figures[1] if self.ratio else figures[0])

    def weights(self, prices: FloatArray, cost: float = 1.0) -> FloatArray:
        """Weights of the rewards in pricing columns, by prices of rows and cost, [rewards]."""
        weights = np.zeros(self.n_rewards)
        weights[self.index] = prices
        weights[0] = cost
        weights[1] += cost * self.ratio
        return weights


@dataclass(eq=False)
class Pool:
    """The policies found so far, in every phase, and the work that it took."""

    pricing: ExplicitPricing | OpenEndedPricing
    columns: list[Column]
    calls: int = 0
    work: Work = field(default_factory=Work)

    @property
    def figures(self) -> FloatArray:
        """Rewards of all columns in the pool, [rewards, columns]."""
        return np.stack([column.figures for column in self.columns], axis=1)

    def sizes(self, rows: Rows) -> FloatArray:
        """Size of each row: its bound, or the most that a column of the pool takes, [rows]."""
        taken = np.abs(self.figures[rows.index]).max(axis=1, initial=0.0)
        return np.asarray(np.maximum(np.abs(rows.bounds), taken))

    def best(self, weights: FloatArray) -> Column:
        """The column of the pool of least weighted totals."""
        return self.columns[int(np.argmin(weights @ self.figures))]

    def priced(self, weights: FloatArray) -> Column:
        """Price a new column of least weighted totals, improved from the pool's best one."""
        column = self.pricing.minimise(weights, self.best(weights))
        self.calls, self.work = self.calls + 1, self.work + column.work
        return column

    def proved(self, weights: FloatArray) -> Proof:
        """Checked lower bound of every column's weighted totals, lowered as little as can be."""
        return self.pricing.prove_afresh(weights, self.best(weights))

    def add(self, column: Column) -> bool:
        """Keep a column in the pool; false where one with the same totals is known."""
        if any(np.array_equal(column.figures, known.figures) for known in self.columns):
            return False
        self.columns.append(column)
        return True

    def rows(self, index: IntArray, bounds: FloatArray) -> Rows:
        """The pool's rows with scales: the bound, or, of a bound of 0, what columns take.

        Args:
            index: of the limited rows among the rewards, [rows].
            bounds: [rows].
        """
        taken = np.abs(self.figures[index]).max(axis=1, initial=0.0)
        scales = np.where(bounds == 0.0, taken, np.abs(bounds))
        scales = np.where(scales > 0.0, scales, 1.0)
        return Rows(index, bounds, scales, self.pricing.n_rewards)
