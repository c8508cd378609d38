"""Column generation (Dantzig-Wolfe) over deterministic policies.

1. The **restricted master** finds the best lottery of known columns within the limits; its duals
   are the prices of the limits.
2. The **pricing problem** finds the policy of least cost plus price times limited quantity: the
   column of least **reduced cost** (``minimise`` of a
   :class:`~ssp_lp.column_generation.column.PricingProblem`).
3. A column of negative reduced cost enters the master. Without one the search **stops**: the least
   priced cost minus the sum of price times bound is a lower bound of the optimum (Lagrange).

:func:`generate` is this loop, on a :class:`Master` of any number of limits.

**One limit.** The optimum of the master lies on an edge of the lower convex hull of the points
(limited quantity, cost): it is the **secant** through a column that satisfies the limit and one
that violates it, and the price is its slope. All other columns can be dropped.

**Two or more limits.** The master is a small linear program (``restricted_master``). Far from the
optimum its prices zig-zag. Pricing therefore uses a mean of the master's prices and the best known
prices (Wentges 1997, "Weighted Dantzig-Wolfe decomposition"), and the master's prices themselves
if the mean gives no new column. Phase 1 is the same search, minimising the violation of the limits
instead of the cost.

**Given success** (case S) the objective is the ratio ``cost / goal`` (paper, eq. s3p_gamma_j_obj).
Between two pricing calls the master minimises ``cost + ratio * failure`` with the ratio of its
last lottery, until the ratio stops falling (Dinkelbach 1967).

**The first columns**, if failure is the only limit, are found by pricing: one satisfies the budget,
one violates it. The price of failure rises until a policy satisfies the budget. If no price gives
such a policy, the budget is near the least failure or below it. Only then is the least failure
computed, which takes two stages.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    PricingProblem,
    Proof,
    excess_failure,
    least_of,
)
from ssp_lp.column_generation.compiled_problem import CompiledProblem
from ssp_lp.column_generation.restricted_master import MasterOptimum, solve_master
from ssp_lp.compiled import deadline
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy

_NEVER = 1e-14  # a goal probability this small is a rounded 0


@dataclass(frozen=True, eq=False)
class Generated:
    """Result of column generation: the best lottery, a lower bound, and its prices."""

    columns: tuple[Column, ...]
    weights: FloatArray  # [columns]
    prices: FloatArray  # [limits] at which the bound was computed
    ratio: float  # case S: the ratio at which the bound was computed
    objective: float  # of the lottery; in phase 1 the violation of the limits
    lower_bound: float  # of the optimum
    finished: bool  # false: stopped by the time limit
    values: FloatArray | None = None  # the checked sub-solution, if the bound is certified
    excess: FloatArray = field(default_factory=partial(np.zeros, 0))
    """Phase 1: the violation in units of the limits' scales, [limits]."""

    @property
    def price(self) -> float:
        """Price of failure: the price of the first limit; in case S plus the ratio."""
        return float(self.prices[:1].sum()) + self.ratio

    @property
    def rewards(self) -> FloatArray:
        """Expected rewards of the lottery, [rewards]: cost, failure and limits."""
        if len(self.columns) == 1:
            return self.columns[0].rewards
        return np.asarray(self.weights @ np.stack([column.rewards for column in self.columns]))

    @property
    def failure(self) -> float:
        """Failure probability of the lottery."""
        return float(self.weights @ [*map(attrgetter("failure"), self.columns)])

    @property
    def goal(self) -> float:
        """Goal probability of the lottery.

        It is the weighted sum of the members' goal probabilities, so that a small one is exact.
        """
        return float(self.weights @ [*map(attrgetter("goal"), self.columns)])

    @property
    def given_success(self) -> float:
        """Expected cost given success; infinite if the goal probability is 0."""
        goal, never = self.goal, 0.0 if self.columns[0].by_goal else _NEVER
        return float(self.rewards[0]) / goal if goal > never else np.inf

    def lottery(self, pricing: PricingProblem) -> MixedPolicy:
        """Return the lottery as a mixed policy on the model."""
        return MixedPolicy(tuple(pricing.policy(column) for column in self.columns), self.weights)


def generate(master: Master, options: SolveOptions) -> Generated:
    """Add columns until none has a negative reduced cost, or the time limit is reached.

    Args:
        master: the first restricted master; updated in place.
        options: tolerance, deadline and progress callback, called after each pricing call.
    """
    begun, finished = master.pool.calls, False
    with deadline.WithIncumbent():
        for _ in range(_MOST_ROUNDS):
            if master.pool.calls > begun and deadline.is_late():
                break
            before, column = master.pool.calls, master.seek(options.tolerance)
            known = np.inf if master.elastic else master.objective
            finished = column is None or master.learn(column, options.tolerance)
            if options.progress and master.tried is not None and master.pool.calls > before:
                options.progress(master.pool.calls, float(master.tried[1]), known)
            if finished:
                break
    if not finished:
        master.solve()
    return master.generated(finished=finished)


_SHARE = 0.25  # share of the search time for intermediate proofs
_LONG = 0.1  # seconds; a shorter pricing call is proved at the end only
_MOST_ROUNDS = 2_000
_NEAR = 0.1  # of the tolerance: a smaller reduced cost does not justify a column
_RATIOS = 40  # steps of Dinkelbach's iteration between two pricing calls
_SETTLED = 1e-14  # relative change of a ratio that is rounding
_STEEP_RATIO = 1e3  # factor of the ratio while no lottery reaches the goal
_STEEPEST = 1e15  # times the first ratio: no lottery reaches the goal at all
_SAME_COST = 1e-15  # relative difference of cost between equal columns
_SAME_FAILURE = 1e-15  # absolute difference of failure between equal columns
_SAME_SMALL = 1e-14  # the same, relative to a small failure or a rare goal
_IN_BETWEEN = 0.5  # weight of the best known prices in the mean
_SLIGHT = 1e-6  # worth of a limit, relative to the objective, below which the mean drops its price
_ROUNDING = 1e-15  # relative rounding error of weighted totals
_FEASIBLE = 1e-15
"""Feasibility tolerance: sum of the violations, each relative to its scale."""
_KEPT = 1e-12  # feasibility tolerance of a row by figures of the model, relative to its bound
_MET = 4.0 * MACHINE_EPSILON
"""Feasibility tolerance of one limit, relative to its bound."""


@dataclass(eq=False)
class Master:
    """The restricted master over a pool of columns that can satisfy the limits.

    If elastic (phase 1), it minimises the violation of the limits, each relative to its scale,
    instead of the cost.
    """

    pool: Pool
    rows: Rows  # in case S with the ratio of the lottery
    prices: FloatArray  # [limits] best known prices, or a guess
    bound: float = 0.0  # lower bound of the optimum at these prices, not certified
    elastic: bool = False
    given_success: bool = False
    floor: float = 0.0  # a goal probability this small is a rounded 0
    limit: FailureRow | None = None  # if failure alone is limited: gives intermediate proofs
    lottery: tuple[tuple[Column, ...], FloatArray] = ((), np.zeros(0))  # columns, their weights
    objective: float = np.inf  # of the lottery
    tried: FloatArray | None = None  # [rewards] weights of the last pricing call
    last: Column | None = None  # the column that it found
    best: Column | None = None  # the column found at the best prices
    proof: Proof | None = None  # the best intermediate proof
    optimum: MasterOptimum = field(init=False)  # at the ratio
    basic: Column = field(init=False)  # a column of the optimum: its reduced cost is 0
    size: float = 0.0  # magnitude of the optimum, for relative tolerances
    in_between: float = _IN_BETWEEN  # weight of the best known prices in the mean
    share: float = _IN_BETWEEN  # the same in the next pricing call
    _asked: FloatArray = field(init=False)  # [limits] prices of the last pricing call
    _first_ratio: float = 0.0
    _spent: float = 0.0  # seconds on proofs
    _since: float = field(default_factory=time.perf_counter)

    def begin_at_bound(self, budget: float) -> None:
        """Set the price and the lower bound from columns that are optimal at a known price.

        Args:
            budget: failure budget, the only limit.
        """
        for column in self.pool.columns:
            if (price := column.found_at) is None or self.rows.by_goal:
                continue
            self.solve()
            self.prices = np.full(len(self.prices), price - self.rows.ratio)
            owed = float(self.prices.sum()) * budget
            self.bound = column.cost + price * column.failure - owed

    def seek(self, tolerance: float) -> Column | None:
        """Solve the master, then the pricing problem at its prices or at a mean of prices.

        Returns:
            The column found. None if the search is finished without a pricing call: phase 1
            satisfies the limits, or the gap is small.
        """
        self.solve()
        best, own = self.optimum.value, self.optimum.prices
        is_near = best - self.bound <= _NEAR * tolerance * self.size
        if len(own) <= 1 or is_near:
            self.share = 0.0
        if self.limit is not None and is_near and self.bound > 0.0:
            return None
        if self.elastic and best <= _FEASIBLE:
            self.prices = own
            return None
        if len(own) > 1:
            own = without_negligible_prices(own, self.pool.sizes(self.rows), best)
        if self.share > 0.0:  # a mean of the best prices and the master's
            mixed = self.share * self.prices + (1.0 - self.share) * own
            own = without_negligible_prices(mixed, self.rows.scales, best, _SLIGHT)
        weights = self.rows.weights(own, 0.0 if self.elastic else 1.0)
        if self.last is None or self.tried is None or not np.array_equal(weights, self.tried):
            began = time.perf_counter()
            self.last = self.pool.minimise(weights, *self.lottery[0])
            if self.limit is not None and deadline.is_limited():
                self._prove_on_the_way(self.limit, weights, self.last, began)
        self._asked, self.tried = own, weights
        return self.last

    def learn(self, column: Column, tolerance: float) -> bool:
        """Update the bound by a priced column, and add the column if its reduced cost is negative.

        Args:
            column: the column that :meth:`seek` found.
            tolerance: relative gap.

        Returns:
            Whether the search is finished.
        """
        own, settled = self.optimum.prices, _NEAR * tolerance * self.size
        best, near, several = self.optimum.value, settled, len(own) > 1
        beyond = column.rewards[self.rows.index] - self.rows.bounds
        earned = 0.0 if self.elastic else 1.0
        objective = earned * float(column.rewards[0] + self.rows.ratio * column.rewards[1])
        value = objective + float(self._asked @ beyond)
        weights = self.rows.weights(own, earned)
        below = float(weights @ (self.basic.rewards - column.rewards))
        if several:
            paid = float(own @ np.abs(beyond))
            near = max(near, _ROUNDING * (abs(objective) + paid))
        new = below > near and self.pool.add(column)
        finished = self.share == 0.0 and (not new or best - value <= settled)
        if finished and self.given_success and self.objective > self.rows.ratio * (1.0 + _SETTLED):
            return self._begin_at_larger_ratio()
        if finished or value > self.bound:
            self.prices, self.bound, self.best = self._asked, value, column
        self.share = self.in_between if new and several else 0.0
        return finished

    def solve(self) -> None:
        """Compute the best lottery of the pool's columns, in case S by Dinkelbach's iteration."""
        rows, columns = self.rows, self.pool.columns
        if len(columns) == 1 >= len(rows.bounds) and not (self.elastic or self.given_success):
            self.basic, none, all_of_it = columns[0], np.zeros(len(rows.bounds)), np.ones(1)
            self.optimum = MasterOptimum(self.basic.cost, all_of_it, none, none)
            self.lottery, self.objective = ((self.basic,), all_of_it), self.basic.cost
            self.size = abs(self.objective)
            return
        figures = self.pool.rewards
        for _ in range(_RATIOS):
            cost, taken = figures[0] + self.rows.ratio * figures[1], figures[rows.index]
            if self.elastic or len(taken) > 1:
                how = rows.bounds, rows.scales
                self.optimum = solve_master(cost, taken, *how, elastic=self.elastic)
            else:
                self.optimum = secant(cost, taken.ravel(), rows.bounds)
            used = np.flatnonzero(self.optimum.weights)
            used = used[np.argsort(figures[1, used], kind="stable")]  # the safest first
            mixed = tuple(map(columns.__getitem__, used.tolist()))
            self.basic, weights = mixed[0], self.optimum.weights[used]
            attained, goal = float(figures[0, used] @ weights), 0.0
            self.size = abs(self.optimum.value)
            if not self.given_success:
                self.lottery, self.objective = (mixed, weights), attained
                break
            for column, weight in zip(mixed, weights.tolist(), strict=True):
                goal += weight * column.goal
            attained = attained / goal if goal > self.floor else np.inf
            if not self.lottery[0] or attained < self.objective * (1.0 - _SETTLED):
                self.lottery, self.objective = (mixed, weights), attained
            if not attained < self.rows.ratio * (1.0 - _SETTLED):
                break
            self._price_success_at(attained)
        if self.given_success and np.isfinite(self.objective):
            self.size = abs(self.objective) * self.basic.goal
        if self.pool.forgets:
            self.pool.columns = list(dict.fromkeys((*self.lottery[0], *mixed)))

    def generated(self, *, finished: bool) -> Generated:
        """Return the lottery of the solved master, with the best known prices."""
        return Generated(
            *self.lottery,
            prices=self.prices,
            ratio=self.rows.ratio if self.given_success else 0.0,
            objective=self.optimum.value if self.elastic else self.objective,
            lower_bound=self.bound,
            finished=finished,
            excess=self.optimum.excess,
        )

    def _begin_at_larger_ratio(self) -> bool:
        """Raise the ratio to that of the lottery; return whether the search must stop.

        While no lottery reaches the goal, the ratio is multiplied by a factor; beyond a limit the
        search stops.
        """
        attained, steeper = self.objective, self.rows.ratio * _STEEP_RATIO
        self._first_ratio = self._first_ratio or max(self.rows.ratio, 1.0)
        if not np.isfinite(attained) and steeper > _STEEPEST * self._first_ratio:
            return True
        self._price_success_at(attained if np.isfinite(attained) else steeper)
        self.share = self.in_between
        return False

    def _price_success_at(self, ratio: float) -> None:
        """Change the ratio, and lower the dual bound by the change, since failure is at most 1."""
        rise = ratio - self.rows.ratio
        self.bound -= max(rise if self.rows.by_goal else -rise, 0.0)
        self.rows = replace(self.rows, ratio=ratio)

    def _prove_on_the_way(
        self, limit: FailureRow, weights: FloatArray, best: Column, began: float
    ) -> None:
        """Prove an intermediate bound, if proofs take only a small share of the search time.

        Args:
            limit: the failure row.
            weights: weights of the rewards at which the bound is proved, [rewards].
            best: an optimal policy at these weights.
            began: time at which the pricing call of ``best`` began, by ``time.perf_counter``.
        """
        now = time.perf_counter()
        if now - began < _LONG or self._spent > _SHARE * (now - self._since):
            return
        with deadline.WithIncumbent():
            proof = self.pool.pricing.prove(weights, best, slack=limit.is_rare)
            if self.proof is None or limit.lower_bound(proof) > limit.lower_bound(self.proof):
                self.proof = proof
        self._spent += time.perf_counter() - now


def secant(cost: FloatArray, taken: FloatArray, bounds: FloatArray) -> MasterOptimum:
    """Solve the restricted master of at most one limit in closed form.

    Plot each column at (value in the limit, cost). Consider all lines through a column within the
    limit and one beyond it. The line that is lowest at the bound is an edge of the lower convex
    hull, and its two columns are the optimal lottery. If no line falls, the cheapest column within
    the limit is optimal.

    Args:
        cost: [columns].
        taken: value of each column in the limit, [columns]; empty: no limit.
        bounds: the bound of the limit, [1], or empty.
    """
    weights, price, bound = np.zeros(len(cost)), 0.0, float(bounds.sum())
    spent = taken if len(bounds) else np.zeros(len(cost))
    most = max(bound + _MET * abs(bound), float(spent.min()))  # rounding leaves a column within
    is_within, value = spent <= most, np.inf
    inside = outside = -1
    for i in np.flatnonzero(is_within).tolist():
        if cost[i] < value:
            value, price, inside, outside = cost[i], 0.0, i, i
        for j in np.flatnonzero(~is_within).tolist():
            slope = (cost[i] - cost[j]) / (spent[j] - spent[i])
            height = cost[i] - slope * max(bound - spent[i], 0.0)
            if slope > 0.0 and (height < value or (height == value and slope > price)):
                value, price, inside, outside = height, slope, i, j
    room, left = bound - spent[inside], spent[outside] - bound
    earns_nothing = room <= most - bound and price * room <= _ROUNDING * abs(value)
    if inside == outside or room <= 0.0 or earns_nothing:
        weights[inside] = 1.0
    else:  # each computed separately, so that the small one is exact
        weights[[inside, outside]] = np.array([left, room]) / (left + room)
    prices = np.full(len(bounds), float(price))
    return MasterOptimum(float(value), weights, prices, np.zeros(len(bounds)))


def certified(master: Master, row: FailureRow, generated: Generated, tolerance: float) -> Generated:
    """Return the result of a search whose only limit is on failure, with a certified bound.

    If there is no time to prove the final bound, the best intermediate bound is used. If there is
    none, the bound is -inf, and the values are infinite: a later certificate can start from them.

    Args:
        master: the final master of the search.
        row: the failure row.
        generated: result of the search.
        tolerance: relative gap.
    """
    pricing, pool, best = master.pool.pricing, master.pool, generated.objective
    price, last = generated.price, master.best or master.last or generated.columns[0]
    price = max(price, best) if row.ratio else price
    slack = row.ratio and price <= best  # then prove it just below it: FailureRow.lower_bound
    at = price * (1.0 - 0.25 * tolerance) if slack else price
    proof = master.proof
    with deadline.WithIncumbent():
        if deadline.has_time_for(pool.took):
            with deadline.closing():
                weights = np.array([1.0, at])
                proof = pricing.prove(weights, last, slack=slack or row.is_rare)
    proof = proof or Proof(at, at, -np.inf, pricing.infinite)
    price = price if proof.price == at else max(proof.price, best if row.ratio else 0.0)
    pool.work = pool.work + proof.work
    base = best if row.ratio else 0.0
    return replace(
        generated,
        prices=np.full(1, price - base),
        ratio=base,
        lower_bound=least_of(row.lower_bound(proof), best),
        values=proof.values,
    )


_STEEP = 5.0  # first price of failure, in units of the first policy's cost
_STEPS = (3.0, 15.0, 255.0)  # relative steps of the price until columns lie on both sides
_LEAST_FACTOR = 1.5  # least factor of a step
_HINTED_STEPS = (1.0, 30.0, 1e3, 1e6)  # steps from a dual guess, in units of its spread


@dataclass(frozen=True)
class DualGuess:
    """A first price of failure, such as the dual of a linear program or of a coarser process."""

    price: float
    spread: float  # relative uncertainty
    slack: bool = False  # whether the budget was slack there, so that one column is enough


def master_at(pool: Pool, row: FailureRow, *known: Column | None) -> Master:
    """Return the restricted master whose only limit is a failure budget.

    Args:
        pool: receives the columns; updated in place.
        row: the budget and the form of the objective.
        known: first columns, of which the first satisfies the budget; None entries are ignored.
    """
    by_goal = pool.pricing.by_goal
    for column in filter(None, known):
        same = column.by_goal == by_goal
        pool.columns.append(column if same else replace(column, by_goal=by_goal))
    pool.forgets, rows = True, Rows.of_failure(row, pool.pricing)
    if row.ratio:
        rows = replace(rows, ratio=row.objective(pool.columns[0].cost, pool.columns[0].goal))
    return Master(pool, rows, np.zeros(len(rows.bounds)), given_success=row.ratio, limit=row)


def columns_by_pricing(
    compiled: CompiledProblem, row: FailureRow, guess: DualGuess | None, options: SolveOptions
) -> Master | None:
    """Find first columns by pricing, on both sides of the failure budget.

    The price of failure rises while the columns violate the budget, and falls while they satisfy
    it.

    Args:
        compiled: the problem.
        row: the budget and the form of the objective.
        guess: a first price; None: a multiple of the first policy's cost.
        options: deadline and progress callback, called after each pricing call.

    Raises:
        Stop: the time limit was reached before a column satisfied the budget.

    Returns:
        The master of these columns; None if no column satisfies the budget.
    """
    last, dearest, doing = None, 0.0, "the process was being built"
    with deadline.WithIncumbent() as search:
        pricing = compiled.pricing()
        if row.by_goal:
            pricing = pricing.counting_success()
        doing = "the first policy was being evaluated"
        if guess is None:
            last = pricing.first()
            counts_success = (row.ratio or row.is_rare) and last.goal > 0.0
            typical = last.cost / last.goal if counts_success else last.cost
            price = _STEEP * typical if typical > 0.0 else 1.0
        else:
            price = guess.price
        if row.ratio and (covered := pricing.covered_price) > 0.0 and not (guess and guess.slack):
            dearest, price = price, covered  # one sweep covers all lower prices
            if guess is not None:
                price = min(max(guess.price, covered), guess.price * (1.0 + guess.spread))
    if search.stop:
        raise deadline.Stop(note=doing) from search.stop
    steps = _STEPS if guess is None else tuple(guess.spread * step for step in _HINTED_STEPS)
    one_sided = price == 0.0 or (guess is not None and guess.slack)
    has_beside = row.ratio and not one_sided
    inside: Column | None = None
    outside: Column | None = None
    pool = Pool(pricing)
    with deadline.WithIncumbent() as search:
        for step in (*steps, None):
            last, value = pool.minimise(np.array([1.0, price]), last, inside, outside), np.inf
            for column in (last, *pricing.nearby_columns(last, row)) if has_beside else (last,):
                if row.is_violated_by(column):
                    outside = column
                elif (worth := row.objective(column.cost, column.goal)) < np.inf:
                    inside, value = column, worth
                    deadline.ensure_incumbent(by_itself=True)
            if options.progress is not None:
                options.progress(pool.calls, price, value)
            enough = one_sided or outside is not None or deadline.is_late()
            if step is None or (inside is not None and enough):
                break
            size, ends = 1.0 + step, (last.failure, row.budget)
            if row.is_rare:
                ends = last.goal, row.required
            if guess is None and min(ends) > 0.0:
                # failure falls about as fast as the price rises: the square of their ratio
                # overshoots, so that the columns lie on both sides, close together
                ratio = max(ends) / min(ends)
                size = min(max(ratio * ratio, _LEAST_FACTOR), size)
            price = max(price, dearest) * size if row.slack(last) < 0.0 else price / size
            dearest = 0.0
    if search.stop:
        inside = last = _initial_column_within(pricing, row, search.stop, inside, last)
    if inside is None or last is None:
        return None
    master = master_at(pool, row, inside, outside)
    master.last, master.tried = last, np.array([1.0, price])
    if row.ratio:
        master.begin_at_bound(row.budget)
    return master


def _initial_column_within(
    pricing: PricingProblem, row: FailureRow, stop: BaseException, *candidates: Column | None
) -> Column:
    """Return the best known column within the budget, when the time limit stopped the search.

    Args:
        pricing: the pricing problem that was being solved.
        row: the budget.
        stop: the exception that stopped it, with the policy reached.
        candidates: known columns; None entries are ignored.

    Raises:
        Stop: no known column satisfies the budget.
    """

    def is_answer(column: Column) -> bool:
        """Return whether a column has a policy, a finite objective, and failure within budget."""
        is_policy = column.choice is not None or column.policy is not None
        has_worth = row.objective(column.cost, column.goal) < np.inf
        return is_policy and has_worth and not row.is_violated_by(column)

    columns = [column for column in candidates if column is not None]
    with deadline.WithIncumbent(), deadline.closing():
        if not any(map(is_answer, columns)):
            reached = pricing.incumbent(stop.choice) if isinstance(stop, deadline.Stop) else None
            columns.append(pricing.first() if reached is None else reached)
    answers = list(filter(is_answer, columns))
    if not answers:
        least_failure = min((column.failure for column in columns), default=1.0)
        raise deadline.Stop(
            note=f"the safest policy found fails with probability {least_failure:.6g}"
        ) from stop
    return min(answers, key=lambda column: row.objective(column.cost, column.goal))


def lottery_within(
    pricing: PricingProblem,
    columns: Sequence[Column],
    rows: Rows,
    *,
    ratio: bool,
    floor: float = 0.0,
) -> Generated | None:
    """Return the best lottery within the rows over given columns; no further column is priced.

    Args:
        pricing: the pricing problem that found the columns.
        columns: columns with their rewards on the model, which may differ from the process.
        rows: the limited rows.
        ratio: whether the objective is a cost given success.
        floor: a goal probability of at most this counts as 0.

    Returns:
        None if no lottery satisfies the rows and, if ``ratio``, reaches the goal.
    """
    counted = [replace(column, by_goal=rows.by_goal) for column in columns]
    pool, none = Pool(pricing, counted), np.zeros(len(rows.index))
    elastic = Master(pool, rows, none, elastic=True)
    elastic.solve()
    within = elastic.generated(finished=True)
    if (within.rewards[rows.index] > rows.bounds + _KEPT * np.abs(rows.bounds)).any():
        return None
    master = Master(pool, replace(rows, ratio=0.0), none, given_success=ratio, floor=floor)
    if ratio and within.goal > floor:
        master.lottery, master.objective = elastic.lottery, within.given_success
        master.rows = replace(rows, ratio=within.given_success)
    elif ratio:
        dearest = max(column.cost / max(column.goal, 1e-300) for column in counted)
        master.rows = replace(rows, ratio=dearest + 1.0)
    master.solve()
    return master.generated(finished=True) if np.isfinite(master.objective) else None


def without_negligible_prices(
    prices: FloatArray, sizes: FloatArray, objective: float, negligible_share: float = 1e-12
) -> FloatArray:
    """Return the prices, [rows], with those set to 0 that hardly affect the objective.

    Args:
        prices: [rows].
        sizes: size of each row, [rows]: its bound or, for prices that prove a lower bound, the
            largest value of a policy in the row.
        objective: the objective.
        negligible_share: a price is negligible if price times size is at most this share of the
        objective.
    """
    return np.where(prices * sizes <= negligible_share * abs(objective), 0.0, prices)


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows that have a bound: for each its bound, scale, and position among the rewards."""

    index: IntArray  # [rows] position among the pricing problem's rewards
    bounds: FloatArray  # [rows]
    scales: FloatArray  # [rows] > 0
    n_rewards: int
    by_goal: bool  # the second reward is minus the goal probability instead of failure
    ratio: float = 0.0  # weight of failure in the objective (Dinkelbach)

    @classmethod
    def of_failure(cls, row: FailureRow, pricing: PricingProblem) -> Rows:
        """Return the failure row as the only row; no row if the budget is 1."""
        bounds = np.full(int(row.required > 0.0), -row.required if pricing.by_goal else row.budget)
        ones = np.ones(len(bounds))
        return cls(ones.astype(np.int64), bounds, ones, pricing.n_rewards, pricing.by_goal)

    def weights(self, prices: FloatArray, cost: float = 1.0) -> FloatArray:
        """Return the weight of each reward, [rewards].

        Args:
            prices: prices of the rows, [rows].
            cost: weight of the cost; 0 in phase 1.
        """
        weights = np.zeros(self.n_rewards)
        weights[self.index] = prices
        weights[0] = cost
        weights[1] += cost * self.ratio
        return weights


@dataclass(eq=False)
class Pool:
    """The columns found so far, in all phases, and the work of finding them."""

    pricing: PricingProblem
    columns: list[Column] = field(default_factory=list)
    calls: int = 0
    work: Work = field(default_factory=Work)
    took: float = 0.0  # seconds of the longest pricing call, about those of a proof
    forgets: bool = False  # whether columns outside the lottery are dropped

    @property
    def rewards(self) -> FloatArray:
        """Rewards of all columns, [rewards, columns]."""
        return np.stack(tuple(map(attrgetter("rewards"), self.columns)), axis=1)

    def sizes(self, rows: Rows) -> FloatArray:
        """Return the size of each row, [rows].

        It is the largest absolute value of the row's bound and of the columns' values in the row.
        """
        taken = np.abs(self.rewards[rows.index]).max(axis=1, initial=0.0)
        return np.asarray(np.maximum(np.abs(rows.bounds), taken))

    def best(self, weights: FloatArray) -> Column:
        """Return the column of least weighted rewards."""
        return self.columns[-1 - int(np.argmin((weights @ self.rewards)[::-1]))]

    def minimise(self, weights: FloatArray, *warm: Column | None) -> Column:
        """Solve the pricing problem at the weights, starting from known columns.

        Args:
            weights: weights of the rewards, [rewards].
            warm: columns to start from, by default the pool's best one; None entries are ignored.
        """
        began = time.perf_counter()
        try:
            column = self.pricing.minimise(weights, *(warm or (self.best(weights),)))
        finally:
            self.took = max(self.took, time.perf_counter() - began)
        self.calls, self.work = self.calls + 1, self.work + column.work
        return column

    def first_ratio(self, lottery: Generated) -> float:
        """Return a positive first ratio for case S.

        It is the cost given success of a lottery or, if that is infinite or 0, the largest finite
        one among the columns.
        """
        attained = lottery.given_success
        if np.isfinite(attained) and attained > 0.0:
            return attained
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = self.rewards[0] / [column.goal for column in self.columns]
        return float(ratios[np.isfinite(ratios)].max(initial=0.0)) or 1.0

    def proved(self, weights: FloatArray) -> Proof:
        """Prove a lower bound of the weighted rewards of every column."""
        return self.pricing.minimise_and_prove(weights, self.best(weights))

    def add(self, column: Column) -> bool:
        """Add a column; return whether it is new."""
        if any(_is_same(column, known) for known in self.columns):
            return False
        self.columns.append(column)
        return True

    def rows(self, index: IntArray, bounds: FloatArray) -> Rows:
        """Return the limited rows, with scales for phase 1.

        A scale is the absolute bound or, if that is 0, the columns' largest value in the row.

        Args:
            index: positions of the limited rows among the rewards, [rows].
            bounds: [rows].
        """
        taken = np.abs(self.rewards[index]).max(axis=1, initial=0.0)
        scales = np.where(bounds == 0.0, taken, np.abs(bounds))
        scales = np.where(scales > 0.0, scales, 1.0)
        return Rows(index, bounds, scales, self.pricing.n_rewards, self.pricing.by_goal)


def _is_same(column: Column, known: Column) -> bool:
    """Return whether two columns are equal up to rounding of cost and failure."""
    same = min(_SAME_FAILURE, _SAME_SMALL * min(known.failure, known.goal))
    return (
        abs(column.cost - known.cost) <= _SAME_COST * abs(known.cost)
        and abs(excess_failure(column, known)) <= same
        and column.rows == known.rows
    )
