"""The whole trade-off between cost and failure: the turning points of the optimal frontier."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import heappop, heappush
from typing import TYPE_CHECKING, Any

import numpy as np

from ssp_lp.arrays import BELOW_RATIO, LEAST_BUDGET, FloatArray
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    PricingProblem,
    Proof,
    excess_failure,
    least_of,
)
from ssp_lp.column_generation.compiled_problem import CompiledProblem, checked_least_failure
from ssp_lp.column_generation.search import generate, master_at
from ssp_lp.compiled.deadline import Stop, WithIncumbent, closing, is_late
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import (
    Argument,
    InfeasibleError,
    ModelError,
    SolverError,
    check_between_0_and_1,
    check_whole,
    is_number,
    optional_module,
    wrong_argument,
)
from ssp_lp.model.text_tables import html_table
from ssp_lp.options import SolveOptions, Status
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem, budget_of_share, check_numbers, pulled_back, requirements
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import as_percentage

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_SHOWN = 5  # points that a repr lists
_BENT = 0.1  # of its height: a frontier that lies less below its chord has no bend
_AROUND = 3.0  # times as far as the bend of a frontier is worth looking at


@dataclass(frozen=True, eq=False, repr=False)
class Frontier:
    """Turning points of the lower convex hull of (failure, cost), by increasing failure.

    Between two of them the optimum is their lottery: cost is piecewise linear and convex in the
    failure. In case S ``cost`` is E[cost; goal], and the objective is cost / goal along a segment.
    Under a discount all three are discounted. Over another limit, ``spent`` is what is spent of it,
    and takes the place of the failure.
    """

    spent: FloatArray  # [points] increasing: of what is traced, failure unless ``over`` says else
    goal: FloatArray  # [points] 1 - failure
    cost: FloatArray  # [points] decreasing
    price: FloatArray  # [points - 1] of what is traced, on each segment, decreasing
    below: FloatArray  # [points - 1] no policy lies further below, as a share of the safer cost
    tolerance: float  # share below a segment up to which it was not split
    hidden: float  # share by which what a cap on the accumulated cost hides may lie below
    ratio: bool  # case S
    complete: bool  # whether it begins at the least, not at a price asked for or near the least
    pricing_calls: int
    work: Work  # passes over the process
    _pricing: PricingProblem
    _columns: tuple[Column, ...]
    _problem: Problem | None = None  # as stated
    ends_early: bool = False  # whether tracing was stopped before it found the other end
    status: Status = Status.OPTIMAL
    over: str = FAILURE_ROW  # the limit that is traced
    maximises: bool = False  # then the objective grows, and what is said to lie below lies above

    @classmethod
    def through(
        cls,
        columns: Sequence[Column],
        below: Mapping[float, float],
        pricing: PricingProblem,
        **told: Any,
    ) -> Frontier:
        """The frontier through some columns, in any order.

        Args:
            columns: its turning points.
            below: how far below each segment policies may lie, by the failure at its safer end.
            pricing: what made the columns.
            told: the other fields, by name.
        """
        ordered = tuple(sorted(columns, key=lambda c: c.failure))
        failure, cost = np.array([c.failure for c in ordered]), np.array([c.cost for c in ordered])
        return cls(
            spent=failure,
            goal=np.array([c.goal for c in ordered]),
            cost=cost,
            price=-np.diff(cost) / np.diff(failure),
            below=np.array([below[column.failure] for column in ordered[:-1]]),
            hidden=0.0,
            _pricing=pricing,
            _columns=ordered,
            **told,
        )

    @property
    def failure(self) -> FloatArray:
        """What fails at each turning point, [points]."""
        return self.spent if self.over == FAILURE_ROW else 1.0 - self.goal

    @property
    def problem(self) -> Problem | None:
        """The problem as it was stated."""
        return self._problem

    @property
    def region(self) -> tuple[float, float]:
        """The bounds worth looking at: three times as far as the curve lies most below its chord.

        Beyond, more of the budget buys little; all of them where the curve has no such bend.
        """
        first, last = float(self.spent[0]), float(self.spent[-1])
        if len(self.spent) < 3:
            return first, last
        along = (self.spent - first) / (last - first)
        up = (self.objective - self.objective[-1]) / (self.objective[0] - self.objective[-1])
        below = 1.0 - along - up
        if below.max() < _BENT:
            return first, last
        bend = float(self.spent[int(np.argmax(below))])
        return first, min(first + _AROUND * (bend - first), last)

    @property
    def gap(self) -> float:
        """Gap of the frontier: how far policies may lie below a segment."""
        return max(self.tolerance, self.hidden, float(self.below.max(initial=0.0)))

    @property
    def priced(self) -> dict[float, Column]:
        """The frontier's turning points that were found by pricing, by price."""
        return {c.found_at: c for c in self._columns if c.found_at is not None}

    @property
    def open_segments(self) -> tuple[int, ...]:
        """Numbers of the frontier's segments below which points may be missing, from point k."""
        numbers = np.flatnonzero(self.below > self.tolerance).tolist()
        return (*numbers, len(self.price)) if self.ends_early else tuple(numbers)

    @property
    def objective(self) -> FloatArray:
        """Objective at each turning point of the frontier, [points]."""
        return self.cost / self.goal if self.ratio else self.cost

    def objective_at(self, budget: float) -> float:
        """The frontier's least objective within a failure budget; no pricing call is made.

        Too high by at most ``tolerance`` times the cost at the safer end of the segment, in case S
        divided by 1 - budget: at budgets near 1 that may be a larger share of what is returned.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
            SolverError: tracing was cut short there, and a cheaper policy is known to exist; the
                message has :meth:`bounds_at`.
        """
        number, weight = self._locate(budget)
        share = self.hidden if weight == 0.0 else max(self.hidden, float(self.below[number]))
        share = np.inf if self.ends_early and number == len(self.price) else share
        if share > self.tolerance:
            low, high = self.bounds_at(budget)
            raise SolverError(
                f"the frontier is not settled at the budget {budget:g}: the least objective lies "
                f"between {_digits_apart(low, high)} (bounds_at); policy_at attains the latter. "
                "A higher ",
                Argument("point_limit"),
                " or ",
                Argument("time_limit"),
                " of trace_frontier settles more",
            )
        return self._attained(number, weight, FailureRow(budget, self.ratio))

    def bounds_at(self, budget: float) -> tuple[float, float]:
        """Certified bounds of the frontier's least objective within a failure budget.

        The upper bound is what :meth:`policy_at` attains. The lower one is proved afresh, at the
        price of the segment, and where that is not settled also at those at which its ends are
        best: one to three pricing calls, remembered for every budget.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        row = FailureRow(budget, self.ratio)
        high = self._attained(number, weight, row)
        low = max(row.lower_bound(proof) for proof in self._proofs_near(number, weight))
        return least_of(low, high), high

    def _attained(self, number: int, weight: float, row: FailureRow) -> float:
        """Objective of a lottery over a turning point of the frontier and the next one."""
        if weight == 0.0:
            return row.objective(float(self.cost[number]), float(self.goal[number]))
        ends = np.array([1.0 - weight, weight])
        pair = slice(number, number + 2)
        return row.objective(float(ends @ self.cost[pair]), float(ends @ self.goal[pair]))

    def _proofs_near(self, number: int, weight: float) -> list[Proof]:
        """Proofs at the prices that matter between two turning points of the frontier."""
        last = len(self._columns) - 1
        segments = {number} if weight > 0.0 else {max(number - 1, 0), number}
        proofs = [self._segment_proof(k) for k in segments]
        if any(k < last and self.below[k] > self.tolerance for k in segments):
            for point in (number,) if weight == 0.0 else (number, number + 1):
                price = self._columns[point].found_at
                if point == last:
                    proofs.append(self._segment_proof(last))
                elif price is not None:
                    proofs.append(self._proof(price, self._columns[point]))
        return proofs

    def _segment_proof(self, segment: int) -> Proof:
        """Proof at a frontier segment's price; beyond the last, at that of the best policy."""
        column = self._columns[segment]
        if segment < len(self._columns) - 1:
            return self._proof(float(self.price[segment]), column)
        price = float(self.objective[-1]) * BELOW_RATIO if self.ratio else 0.0
        return self._proof(price, column, slack=self.ratio)

    def _proof(self, price: float, column: Column, *, slack: bool = False) -> Proof:
        """Proof for the frontier at a price; ``column`` is a policy perhaps near to the best."""
        if (price, slack) not in self._proofs:
            proof = self._pricing.prove(price, column, slack=slack)
            self._proofs[price, slack] = replace(proof, values=np.zeros(0))  # only bounds are asked
        return self._proofs[price, slack]

    @cached_property
    def _proofs(self) -> dict[tuple[float, bool], Proof]:
        """The frontier's proofs by price, filled as they are asked for."""
        return {}

    def policy_at(self, budget: float) -> MixedPolicy:
        """Lottery of the frontier's turning points around a budget; no pricing call is made.

        It attains the upper end of :meth:`bounds_at`, which is :meth:`objective_at` where settled.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        weights = np.ones(1) if weight == 0.0 else np.array([1.0 - weight, weight])
        lottery = self._lottery(number, weights)
        return lottery if self._problem is None else pulled_back(lottery, self._problem)

    def _lottery(self, number: int, weights: FloatArray) -> MixedPolicy:
        """The lottery over turning points from one on, on the model of the problem solved."""
        some = self._columns[number : number + len(weights)]
        return MixedPolicy(tuple(self._pricing.policy(column) for column in some), weights)

    def slopes_at(self, budget: float) -> list[float]:
        """Slopes of the objective in the budget, of each segment that meets it and is settled."""
        slopes = []
        for k in np.flatnonzero(self.below <= self.tolerance).tolist():
            if not self.spent[k] <= budget <= self.spent[k + 1]:
                continue
            width, cost, goal = (
                np.diff(x[k : k + 2])[0] for x in (self.spent, self.cost, self.goal)
            )
            if self.ratio:
                w = (budget - self.spent[k]) / width
                here = (1.0 - w) * self.goal[k] + w * self.goal[k + 1]
                cost = (
                    cost - ((1.0 - w) * self.cost[k] + w * self.cost[k + 1]) / here * goal
                ) / here
            slopes.append(float(cost / width))
        return slopes

    @property
    def axis(self) -> str:
        """What is traced, in words."""
        return "failure budget" if self.over == FAILURE_ROW else f"bound on {self.over}"

    def plot(self, budget: float | None = None, *, ax: Axes | None = None, **style: Any) -> Axes:
        """Draw the frontier: :func:`ssp_lp.plotting.plot_frontier`."""
        pictures = optional_module("ssp_lp.plotting.curves", "plot")  # which know frontiers
        axes: Axes = pictures.plot_frontier(self, budget, ax=ax, **style)
        return axes

    def to_frame(self) -> Any:
        """The turning points as a pandas ``DataFrame``, a row for each.

        Columns: what is traced by its name, goal, cost, objective; price and below of the segment
        that begins at the point, nan at the last.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        columns = {
            self.over: self.spent,
            "goal": self.goal,
            "cost": self.cost,
            "objective": self.objective,
            "price": np.append(self.price, np.nan),
            "below": np.append(self.below, np.nan),
        }
        return optional_module("pandas", "frames").DataFrame(columns)

    def __repr__(self) -> str:
        """One line, and a few of the points."""
        rows = "".join(
            f"\n  {self.over} {failure:<12} objective {objective:<12} price {price}"
            for failure, objective, price in self._some()
        )
        return f"Frontier({self._title}){rows}"

    def summary(self) -> str:
        """One line, and a few of the points."""
        return repr(self)

    def _repr_html_(self) -> str:
        """A few of the frontier's points as a table, for notebooks."""
        head = (self.over, "objective", "price from here on")
        return html_table(f"Frontier: {self._title}", self._some(), head)

    @property
    def _title(self) -> str:
        """Title of the frontier's table: how many points, from where to where, and how near."""
        spent, value, count = self.spent, self.objective, len(self.open_segments)
        unfinished = f", {count} segment{'s' * (count != 1)} open: {self.status}" if count else ""
        return (
            f"{len(spent):,} points, {self.over} {spent[0]:.6g} .. {spent[-1]:.6g}, "
            f"objective {value[0]:.6g} .. {value[-1]:.6g}, gap {self.gap:.1e}{unfinished}"
        )

    def _some(self) -> list[tuple[str, str, str]]:
        """Spent, objective and price from there on, of a few points from first to last."""
        count = len(self.spent)
        shown = np.unique(np.linspace(0, count - 1, min(count, _SHOWN)).round().astype(int))
        price = [f"{p:.6g}" for p in self.price] + ["-"]
        return [
            (f"{self.spent[k]:.6g}", f"{self.objective[k]:.6g}", price[k]) for k in shown.tolist()
        ]

    def _locate(self, budget: float) -> tuple[int, float]:
        """The frontier's turning point at or before a budget, and the weight of the next one."""
        check_numbers(budget=budget)
        if self.over == FAILURE_ROW and budget > 1.0 + LEAST_BUDGET:
            raise ModelError(f"budget must be a probability, not {budget!r}{as_percentage(budget)}")
        lowest, spent = float(self.spent[0]), self.spent
        if not self.complete and not budget >= lowest:
            of_failure = self.over == FAILURE_ROW
            more = "; a steeper steepest_price traces more of it" if of_failure else ""
            raise ModelError(
                f"the frontier was traced from {self.over} {lowest:.12g} on, which the budget "
                f"{budget!r} is below{more}"
            )
        if not budget >= lowest - LEAST_BUDGET:
            told = "fails with" if self.over == FAILURE_ROW else f"takes of {self.over!r}"
            raise InfeasibleError(
                f"every policy {told} at least {lowest:.12g}, above the budget {budget!r}",
                failure_budget=budget if self.over == FAILURE_ROW else None,
                least_failure=lowest if self.over == FAILURE_ROW else self._least_failure,
                conflicting_rows=(self.over,),
            )
        number = max(int(np.searchsorted(spent, budget, side="right")) - 1, 0)
        if number == len(spent) - 1 or budget <= lowest:
            return number, 0.0
        width = float(spent[number + 1] - spent[number])
        return number, (budget - float(spent[number])) / width

    def _least_failure(self) -> float:
        """The least failure probability of all policies, worked out where an error asks for it."""
        if self._problem is None:
            return float(self.failure.min())
        return budget_of_share(self._problem.model, self._problem.start, 1.0)


def _digits_apart(low: float, high: float) -> str:
    """Two numbers of the frontier with the digits that tell them apart, or all of them."""
    digits = next((k for k in range(9, 17) if f"{low:.{k}g}" != f"{high:.{k}g}"), 17)
    return f"{low:.{digits}g} and {high:.{digits}g}"


_REFINEMENTS = 6
_STEEP_SHARE = 3  # one in so many of the points that are allowed is sought at the steep end
_LOG = logging.getLogger("ssp_lp.frontier")


def traced_over_failure(problem: Problem, limits: TraceLimits) -> Frontier:
    """The frontier over the failure budget alone, of a problem without other limits.

    Raises:
        ModelError: it has no failure budget, or no mean of costs, to trace.
        InfeasibleError: case S, and the goal cannot be reached from the start.
        Stop: the time ended before there was a point.
    """
    name, asked = type(problem).__name__, requirements(problem)
    if asked.law:
        raise ModelError(f"{name} is no mean of costs to trace: trace S3P's")
    if asked.several_rows:
        raise ModelError(
            f"{name}'s costs have no common unit and too many sums to tell apart: round them, or "
            "trace MCMP's frontier"
        )
    traced = _traced_and_refined(problem.compile(), limits)
    _LOG.info("%d turning points, gap %.1e", len(traced.spent), traced.gap)
    return traced


def _traced_and_refined(compiled: CompiledProblem, limits: TraceLimits) -> Frontier:
    """Trace the frontier, and again more finely while a cap on the cost hides more than the gap.

    It hides most where the price is steepest, so that a few pricing calls at that end tell first
    how fine a process is needed; the rest is then traced once.
    """
    if limits.steepest_price is None:
        compiled = compiled.for_program()
    elif compiled.is_trial:
        compiled = compiled.refined(limits.steepest_price) or compiled
    calls, work, frontier, begun, steep_only = 0, Work(), None, None, compiled.ratio
    for _ in range(2 * _REFINEMENTS):
        with WithIncumbent() as search:
            traced = _traced(compiled, limits, begun, steep_only=steep_only)
        if search.stop:
            if frontier is None:
                raise Stop from search.stop
            return frontier
        lost = _share_lost_in_tracing(compiled, traced)
        calls, work = calls + traced.pricing_calls, work + traced.work
        frontier = replace(traced, hidden=lost, pricing_calls=calls, work=work)
        is_fine = lost <= limits.gap or is_late()
        finer = None if is_fine else compiled.refined(float(traced.price[0]))
        if finer is None and not steep_only:
            break
        begun, compiled = (traced, compiled) if finer is None else (None, finer)
        steep_only = finer is not None
    return frontier or traced


@dataclass(frozen=True)
class TraceLimits:
    """How far to trace."""

    gap: float
    steepest_price: float | None
    point_limit: int | None
    has_deadline: bool
    progress: Callable[[int, int], None] | None

    def __post_init__(self) -> None:
        check_between_0_and_1("gap", self.gap)
        most, steepest = self.point_limit, self.steepest_price
        if most is not None:
            check_whole("point_limit", most, 2)
        if steepest is not None and not (is_number(steepest) and 0.0 < steepest < np.inf):
            raise wrong_argument("steepest_price", "be a positive number", steepest)

    @property
    def may_stop(self) -> bool:
        """Whether some segments may be left, so that it matters which are split."""
        return self.point_limit is not None or self.has_deadline

    def allows(self, points: int) -> bool:
        """Whether a segment may still be split."""
        full = self.point_limit is not None and points >= self.point_limit
        return not full and not is_late()


def _share_lost_in_tracing(compiled: CompiledProblem, traced: Frontier) -> float:
    """Share by which the cap on the cost may hide policies below the traced frontier."""
    if len(traced.price) == 0:
        return 0.0
    lost = np.inf
    with WithIncumbent(), closing():
        lost = max(compiled.tail_loss(float(p)) for p in (traced.price[0], traced.price[-1]))
    return lost / max(float(traced.cost.min()), 1e-300) if lost > 0.0 else 0.0


def _ends(compiled: CompiledProblem, limits: TraceLimits) -> tuple[list[Column], bool, int, Work]:
    """First and last point of the frontier to be traced; whether the last is known; work.

    Raises:
        ModelError: at the steepest price it is best to fail.
    """
    pricing, row = compiled.pricing(), FailureRow(1.0, compiled.ratio)
    steepest, calls = limits.steepest_price, 0
    if steepest is None:
        safest = checked_least_failure(compiled, None).column
    else:
        safest, calls = pricing.minimise(steepest, pricing.first()), 1
        if row.ratio and row.objective(safest.cost, safest.goal) >= steepest:
            raise ModelError(
                f"at the price {steepest:g} of failure it is best to fail: "
                "steepest_price must lie above the least cost given success"
            )
    master = master_at(pricing, row, safest, calls=calls, work=safest.work)
    free = generate(master, SolveOptions(limits.gap))
    last = free.columns[-1]
    columns = [safest] if last.failure <= safest.failure else [safest, last]
    return columns, free.finished, master.pool.calls, master.pool.work


def _traced(
    compiled: CompiledProblem, limits: TraceLimits, begun: Frontier | None, *, steep_only: bool
) -> Frontier:
    """The frontier's turning points in one process.

    Args:
        compiled: the problem.
        limits: how far to trace.
        begun: what is known of the same process.
        steep_only: split only the first segment, until it is settled.
    """
    pricing = compiled.pricing()
    waiting = _WaitingSegments(pricing, compiled.ratio, limits)
    if begun is None:
        columns, is_known, waiting.calls, work = _ends(compiled, limits)
        open_below = [1.0] * (len(columns) - 1)
    else:
        columns, is_known, work = list(begun._columns), not begun.ends_early, Work()
        open_below, waiting.priced = begun.below.tolist(), begun.priced
        if limits.point_limit is not None and len(columns) > 2:  # the worst segments come first
            columns, open_below = [columns[0], columns[-1]], [1.0]
    for inside, outside, below in zip(columns, columns[1:], open_below, strict=False):
        waiting.add(inside, outside, len(columns), below)
    columns = [replace(column, totals=None) for column in columns]
    while waiting.found and limits.allows(len(columns) * (_STEEP_SHARE if steep_only else 1)):
        inside, found, outside = heappop(waiting.found)[2]  # its ends, and the policy between them
        columns.append(replace(found, totals=None))  # only those waiting start others warmly
        at_most = waiting.below[inside.failure]
        beyond = at_most * inside.cost / max(found.cost, 1e-300)
        waiting.below[found.failure] = beyond
        waiting.add(inside, found, len(columns), at_most)
        if not steep_only:
            waiting.add(found, outside, len(columns), beyond)
    return Frontier.through(
        columns, waiting.below, pricing,
        tolerance=limits.gap, ends_early=not is_known, ratio=compiled.ratio,
        complete=limits.steepest_price is None,
        pricing_calls=waiting.calls, work=work + waiting.work,
    )  # fmt: skip


class _WaitingSegments:
    """Segments with a policy below them, the worst first where not all can be split. Grows."""

    def __init__(self, pricing: PricingProblem, ratio: bool, limits: TraceLimits) -> None:
        """Nothing waits."""
        self.found: list[tuple[float, int, tuple[Column, Column, Column]]] = []  # a heap
        self.calls, self.work = 0, Work()
        self.priced: dict[float, Column] = {}  # what was found before, by price
        self._pricing, self._ratio, self._limits = pricing, ratio, limits
        self.below: dict[float, float] = {}  # by a segment's safer failure; see Frontier.below

    def add(self, inside: Column, outside: Column, points: int, at_most: float = 1.0) -> None:
        """Price a segment of the frontier, and keep it if a policy lies below by more than the gap.

        Args:
            inside: its safer end.
            outside: its other end.
            points: turning points so far.
            at_most: the share by which policies may lie below it, as far as is known.
        """
        price = max((inside.cost - outside.cost) / excess_failure(outside, inside), 0.0)
        if price == 0.0 or at_most <= self._limits.gap:
            self.below[inside.failure] = 0.0 if price == 0.0 else at_most
            return
        with WithIncumbent() as search:
            column = self.priced.get(price)
            if column is None:
                column = replace(self._pricing.minimise(price, outside), found_at=price)
                self.calls, self.work = self.calls + 1, self.work + column.work
        if search.stop or column is None:
            self.below[inside.failure] = at_most
            return
        below = self.below[inside.failure] = _share_below_segment(inside, outside, column, price)
        if below > self._limits.gap:
            urgency = -below if self._limits.may_stop else -float(self.calls)
            heappush(self.found, (urgency, self.calls, (inside, column, outside)))
        _LOG.debug("%d pricing calls, %d turning points", self.calls, points)
        with WithIncumbent():
            if self._limits.progress is not None:
                self._limits.progress(self.calls, points)


def _share_below_segment(inside: Column, outside: Column, found: Column, price: float) -> float:
    """Distance of a column below a segment of the frontier, relative to its cost; else 0."""
    if not inside.failure < found.failure < outside.failure:
        return 0.0
    below = inside.cost - found.cost - price * (found.failure - inside.failure)
    return max(below, 0.0) / max(inside.cost, 1e-300)
