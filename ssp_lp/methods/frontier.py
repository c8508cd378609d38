"""The trade-off between the objective and one limit: the turning points of the frontier.

The least objective is convex in the bound, and linear between turning points. Segments between
two points are split, the one with the largest gap below it first, until no policy lies below any
segment by more than the gap. Two searches find the split point:

- **Columns**, if only failure is limited. The pricing problem is solved at the slope of the
  segment: either no policy lies below it, or the column found is the next point.
- **Optima at bounds**, over any limit, with the other limits fixed. A mixture of the lotteries of
  two bounds attains every bound between them. The prices of an optimum with lower bound L prove,
  for every other bound, that no policy has less than ``L - price * (bound - its own bound)``. This
  is a line below the frontier. The problem is solved next where the lines of two neighbours meet.

**Given success** the objective is a ratio, for which prices prove ``cost / goal >= c - (c - L +
price * (bound - its own bound)) * t`` with the attained value c and ``t = 1 / goal``. Each optimum
proves such a line in t. The goal probability of a lottery is unknown, but every line holds at the
lottery's own t. The lower bound is therefore the least value over t >= 1 of the maximum of all
lines. It is tight on a segment of the frontier, where the lines of both ends meet in one point.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from itertools import count, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ssp_lp.analysis.evaluation import evaluate
from ssp_lp.arrays import (
    BELOW_RATIO,
    LEAST_BUDGET,
    MACHINE_EPSILON,
    RELATIVE_GAP,
    FloatArray,
)
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    PricingProblem,
    Proof,
    excess_failure,
    least_of,
)
from ssp_lp.column_generation.compiled_problem import (
    CompiledProblem,
    checked_least_failure,
)
from ssp_lp.column_generation.search import Pool, generate, master_at
from ssp_lp.compiled.deadline import Stop, WithIncumbent, closing, interrupted, is_late, until
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import (
    Argument,
    InfeasibleError,
    ModelError,
    OutOfTimeError,
    SolverError,
    as_percentage,
    check_between_0_and_1,
    check_whole,
    did_you_mean,
    is_number,
    optional_module,
    wrong_argument,
)
from ssp_lp.methods.rows import rows_optimum, true_figures
from ssp_lp.model.arguments import explained
from ssp_lp.model.report import Report, Table
from ssp_lp.model.tracked_product import check_not_rounded
from ssp_lp.options import SolveOptions, Status, deadline_of, progress_shown
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import (
    Problem,
    RestatedProblem,
    budget_of_share,
    check_problem,
    compiled_constrained,
    pulled_back,
)
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import Aim, ObjectiveSense

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LOG = logging.getLogger("ssp_lp.frontier")
_SHOWN = 5  # points in a summary
_BENT = 0.1  # least distance below the chord, relative to the height, of a bend
_AROUND = 3.0  # the region of interest, in distances to the bend
_REFINEMENTS = 6
_STEEP_SHARE = 3  # one in so many of the allowed points is at the steep end
_FINER = 0.1  # tolerance at each bound, relative to the gap
_STRAIGHT = 1e-11  # relative distance below its neighbours' line of a turning point
_NARROW = 1e-9  # width of the narrowest segment that is split, relative to the range
_NEAR = 1e-4, 1e-2, 0.1  # distances from a least that cannot be attained, relative to the range
_INSIDE = 1e-4  # least distance of a split from the ends, relative to the segment
_RAREST = 1e-12  # least goal probability for bounds of a cost given success
_SPLITS = 0.25, 0.5, 0.75  # further splits of a segment given success
_LEAST = 1e-300  # least divisor of relative costs


@explained
def trace_frontier(
    problem: Problem,
    over: str = FAILURE_ROW,
    *,
    gap: float = RELATIVE_GAP,
    steepest_price: float | None = None,
    point_limit: int | None = None,
    time_limit: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    verbose: bool = False,
) -> Frontier:
    """Trace the least objective as a function of a budget that rises from the least feasible one.

    The frontier ends where a larger budget no longer lowers the objective. There the price of
    failure is 0 in case M, and equals the objective in case S. Over the failure budget alone, the
    pricing problem is solved at the slope of each segment. If no policy lies below the segment, the
    segment is part of the frontier; otherwise the policy found splits the segment. Over another
    limit, or with other limits fixed, the problem is solved at one bound after another, each time
    where the gap between the upper and the lower bound of the frontier is largest.

    Args:
        problem: its bound on the traced quantity is ignored; all other limits hold.
        over: "failure", or the name of a limit that bounds a quantity from above.
        gap: largest distance of a policy below a segment, relative to the cost at the segment's
            safer end (over other limits: to the larger objective at the segment's ends).
        steepest_price: begin with the policy that is optimal at this price of failure (kappa in
            case S) rather than at the least failure, near which the price grows without bound.
        point_limit: stop splitting after this number of turning points. Segments with the largest
            gap are split first, and the frontier's ``gap`` is the one reached.
        time_limit: splitting stops after this many seconds, even within a pricing call. Ctrl-C
            stops it, too. The points found are kept, and ``open_segments`` lists where points may
            be missing.
        progress: called after each pricing call with (calls, turning points so far).
        verbose: show the progress (``ssp_lp.progress_shown``).

    Raises:
        ModelError: an argument out of range, a problem without a failure budget, an unknown limit,
            or a criterion that is not a linear program.
        InfeasibleError: case S, and the goal cannot be reached from the start; or no policy
            satisfies the other limits.
        OutOfTimeError: the time limit was reached before the first point.
        KeyboardInterrupt: Ctrl-C before the first point.

    Example:
        >>> from ssp_lp import MCMP, SSP, trace_frontier, visits
        >>> model = SSP.from_transitions(
        ...     {"a": {"fast": [(0.9, "g", 1.0), (0.1, "yard", 1.0)], "slow": [(1.0, "g", 10.0)]},
        ...      "yard": {"on": [(1.0, "g", 2.0)]}}, goal={"g"})
        >>> problem = MCMP(model, "a", constraints={"yard": visits("yard") <= 0.05})
        >>> trace_frontier(problem, over="yard").objective_at(0.05)
        5.6
    """
    check_problem(problem, "trace_frontier")
    deadline = deadline_of(time_limit, time.perf_counter())
    limits = _TraceLimits(gap, steepest_price, point_limit, deadline < np.inf, progress)
    asked = _traceable(problem.unrolled, over, limits)
    with progress_shown(verbose), until(deadline) as ended:
        try:
            if over == FAILURE_ROW and not asked.has_rows:
                frontier = _traced_by_columns(asked, limits)
            else:
                frontier = _Optima(asked, over, limits).traced()
        except Stop:
            if ended.is_interrupted:
                raise interrupted() from None
            told = f"the time limit ended before the least {over} was known: allow more time"
            raise OutOfTimeError(told) from None
        _LOG.info("%d turning points over %s, gap %.1e", len(frontier.spent), over, frontier.gap)
    status = ended.status(np.inf if frontier.ends_early else frontier.gap, gap)
    return replace(frontier, problem=problem, status=status)


def _traceable(problem: Problem, over: str, limits: _TraceLimits) -> Problem:
    """Return the problem after a check that its frontier over the limit can be traced.

    Raises:
        ModelError: no limit of this name bounds from above, or the criterion is not a linear
            program.
    """
    name, semantics = type(problem).__name__, problem.semantics
    if over == FAILURE_ROW:
        if semantics.aim is not Aim.LEAST_COST or semantics.forbids_failing:
            raise ModelError(f"{name} has no failure budget to trace: trace MCMP instead")
        if not problem.has_rows:
            return problem
    else:
        names = [condition.name for condition in problem.conditions]
        if over not in names:
            known = ", ".join(map(repr, names)) or "none"
            raise ModelError(
                Argument("over"), f" must be 'failure' or the name of a limit ({known}), not "
                f"{over!r}{did_you_mean(over, names)}",
            )  # fmt: skip
        if problem.conditions[names.index(over)].lower is not None:
            raise ModelError(f"limit {over!r} bounds from below: state it as an upper limit, such "
                             "as 1 - end_probability(...) <= 0.1, to trace it")  # fmt: skip
    if semantics.risk is not None:
        raise ModelError(f"{name} is not a linear program: trace the limit with another criterion")
    if limits.steepest_price is not None:
        raise ModelError(Argument("steepest_price"), " is for the failure budget alone")
    check_not_rounded(problem.tracked.model, "trace_frontier")
    return problem


@dataclass(frozen=True, eq=False, repr=False)
class Frontier(Report):
    """Turning points of the lower convex hull of (failure, cost), by increasing failure.

    Between two points a lottery of the two policies is optimal: the cost is piecewise linear and
    convex in the failure. In case S ``cost`` is E[cost; goal], and the objective is ``cost / goal``
    along a segment. Under a discount, cost, failure and goal are discounted. On a frontier over
    another limit, ``spent`` is the limited quantity, in place of the failure.
    """

    spent: FloatArray  # [points] increasing: the traced quantity, by default the failure
    goal: FloatArray  # [points] 1 - failure
    cost: FloatArray  # [points] decreasing
    price: FloatArray  # [points - 1] decreasing: minus the slope of the cost on each segment
    below: FloatArray  # [points - 1] largest distance of policies below, over the safer cost
    tolerance: float  # relative distance below a segment up to which it was not split
    hidden: float  # relative distance below due to the cap on accumulated cost
    ratio: bool  # case S
    complete: bool  # whether it begins at the least feasible bound
    pricing_calls: int
    work: Work  # passes over the process
    _points: _ColumnPoints | _OptimumPoints  # policies of the points, and proofs between them
    problem: Problem | None = None  # as stated
    ends_early: bool = False  # whether tracing was stopped before it found the other end
    status: Status = Status.OPTIMAL
    over: str = FAILURE_ROW  # the traced limit
    maximises: bool = False  # a maximisation: the objective grows, and "below" means above

    @property
    def failure(self) -> FloatArray:
        """Failure probability at each turning point, [points]."""
        return self.spent if self.over == FAILURE_ROW else 1.0 - self.goal

    @property
    def region(self) -> tuple[float, float]:
        """First and last value of the traced quantity in the part of the curve that bends.

        The bend is the point that lies most below the curve's chord. The part begins at the first
        point and ends at three times the distance to the bend, or at the last point if that comes
        first or there is no bend. Beyond it a larger budget lowers the objective little.
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
        """Upper bound of the relative distance by which a policy can lie below a segment."""
        return max(self.tolerance, self.hidden, float(self.below.max(initial=0.0)))

    @property
    def open_segments(self) -> tuple[int, ...]:
        """Indices of the segments below which points may be missing.

        Segment k joins the points k and k + 1. If tracing stopped before it knew the other end of
        the frontier, the index of the last point stands for the part after this point.
        """
        numbers = np.flatnonzero(self.below > self.tolerance).tolist()
        return (*numbers, len(self.price)) if self.ends_early else tuple(numbers)

    @property
    def objective(self) -> FloatArray:
        """Objective at each turning point, [points]."""
        return self.cost / self.goal if self.ratio else self.cost

    @explained
    def objective_at(self, budget: float) -> float:
        """Return the least objective within a failure budget, without a pricing call.

        The result is the objective of :meth:`policy_at`. It differs from the optimum by at most
        ``tolerance`` times the cost at the safer end of the segment. In case S this is divided by
        1 - budget, so that the error may be large relative to the objective near budget 1.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
            SolverError: tracing stopped before this segment was settled; the message has the bounds
                of :meth:`bounds_at`.
        """
        number, weight = self._locate(budget)
        share = self.hidden if weight == 0.0 else max(self.hidden, float(self.below[number]))
        share = np.inf if self.ends_early and number == len(self.price) else share
        if share > self.tolerance:
            low, high = self.bounds_at(budget)
            raise SolverError(
                f"the frontier is not settled at the budget {budget:g}: the least objective lies "
                f"between {low!r} and {high!r} (bounds_at), which a policy attains (policy_at). "
                "Set a higher ",
                Argument("point_limit"),
                " or ",
                Argument("time_limit"),
                " of trace_frontier",
            )
        return self._attained(number, weight)

    @explained
    def bounds_at(self, budget: float) -> tuple[float, float]:
        """Return certified lower and upper bounds of the least objective within a budget.

        One bound is the objective of :meth:`policy_at`: the upper bound or, if the objective is
        maximised, the lower bound. If failure is the only limit, the other bound takes one to three
        pricing calls: at the price of the segment and, if the segment is not settled, at the prices
        of its ends. Their results are cached for all budgets. With further limits the optima found
        while tracing prove the other bound, without a pricing call.

        Raises:
            InfeasibleError: the budget is below the least feasible one.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        attained = self._attained(number, weight)
        proved = self._points.proved(self, number, weight, budget, attained)
        return (attained, proved) if self.maximises else (proved, attained)

    def _attained(self, number: int, weight: float) -> float:
        """Return the objective of a lottery over a turning point and the next one."""
        if weight == 0.0:
            return float(self.objective[number])
        ends, pair = np.array([1.0 - weight, weight]), slice(number, number + 2)
        cost = float(ends @ self.cost[pair])
        return cost / float(ends @ self.goal[pair]) if self.ratio else cost

    @explained
    def policy_at(self, budget: float) -> MixedPolicy:
        """Return the lottery of the turning points around a budget, without a pricing call.

        The objective of the lottery is one of the two bounds of :meth:`bounds_at`.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        weights = {number: 1.0 - weight, number + 1: weight}
        mixed = [
            (policy, share * chance)
            for point, chance in weights.items()
            if chance > 0.0
            for share, policy in self._points.policy(point).weighted
        ]
        policies, shares = zip(*mixed, strict=True)
        lottery = MixedPolicy(policies, np.array(shares))
        return lottery if self.problem is None else pulled_back(lottery, self.problem)

    @explained
    def slopes_at(self, budget: float) -> list[float]:
        """Return the slope of the objective on each settled segment that contains the budget."""
        slopes = []
        for k in np.flatnonzero(self.below <= self.tolerance).tolist():
            if not self.spent[k] <= budget <= self.spent[k + 1]:
                continue
            width, cost, goal = (
                np.diff(x[k : k + 2])[0] for x in (self.spent, self.cost, self.goal)
            )
            if self.ratio:
                weight = (budget - self.spent[k]) / width
                here = self.goal[k] + weight * goal
                cost = (cost - self._attained(k, weight) * goal) / here
            slopes.append(float(cost / width))
        return slopes

    @property
    def axis(self) -> str:
        """Description of the traced bound."""
        return "failure budget" if self.over == FAILURE_ROW else f"bound on {self.over}"

    def plot(self, budget: float | None = None, *, ax: Axes | None = None, **style: Any) -> Axes:
        """Draw the frontier with :func:`ssp_lp.plotting.plot_frontier`."""
        pictures = optional_module("ssp_lp.plotting.curves", "plot")
        axes: Axes = pictures.plot_frontier(self, budget, ax=ax, **style)
        return axes

    def tables(self) -> list[Table]:
        """Return one table with a row for each turning point; printed text shows a few rows.

        The columns are the traced quantity (under its own name), goal, cost and objective of the
        point; then the price and the gap of the segment that begins there, empty in the last row.
        """
        price, below = ([*each.tolist(), None] for each in (self.price, self.below))
        points = (x.tolist() for x in (self.spent, self.goal, self.cost, self.objective))
        count = len(self.spent)
        shown = np.unique(np.linspace(0, count - 1, min(count, _SHOWN)).round().astype(int))
        return [
            Table(
                [*zip(*points, price, below, strict=True)],
                (self.over, "goal", "cost", "objective", "price", "below"),
                self._title,
                shown=shown.tolist(),
                hidden={"below"},
                left=0,
            )
        ]

    def __repr__(self) -> str:
        """Return the number of points, the ranges and the gap in one line."""
        return f"Frontier({self._title})"

    @property
    def _title(self) -> str:
        """Title of the table: number of points, ranges and gap."""
        spent, value, count = self.spent, self.objective, len(self.open_segments)
        unfinished = f", {count} segment{'s' * (count != 1)} open: {self.status}" if count else ""
        return (
            f"{len(spent):,} points, {self.over} {spent[0]:.6g} .. {spent[-1]:.6g}, "
            f"objective {value[0]:.6g} .. {value[-1]:.6g}, gap {self.gap:.1e}{unfinished}"
        )

    def _locate(self, budget: float) -> tuple[int, float]:
        """Return the turning point at or before a budget, and the weight of the next one."""
        if not is_number(budget):
            raise wrong_argument("budget", "be a number", budget)
        if self.over == FAILURE_ROW and budget > 1.0 + LEAST_BUDGET:
            raise ModelError(f"budget must be a probability, not {budget!r}{as_percentage(budget)}")
        lowest, spent = float(self.spent[0]), self.spent
        if not self.complete and not budget >= lowest:
            of_failure = self.over == FAILURE_ROW
            more = ": set a higher steepest_price" if of_failure else ""
            raise ModelError(
                f"the frontier was traced only from {self.over} {lowest:.12g}, above the budget "
                f"{budget!r}{more}"
            )
        if not budget >= lowest - LEAST_BUDGET:
            told = "fails with probability" if self.over == FAILURE_ROW else f"has {self.over!r} of"
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
        """Return the least failure probability of the problem.

        As this may take long, InfeasibleError gets the method itself, and calls it only when its
        attribute ``least_failure`` is read.
        """
        if self.problem is None:
            return float(self.failure.min())
        return budget_of_share(self.problem.model, self.problem.start, 1.0)


@dataclass(frozen=True)
class _TraceLimits:
    """Limits and options of a trace."""

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

    def report(self, calls: int, points: int) -> None:
        if self.progress is not None:
            self.progress(calls, points)

    @property
    def may_stop(self) -> bool:
        """Whether tracing may stop early, so that the order of splitting matters."""
        return self.point_limit is not None or self.has_deadline

    def allows(self, points: int) -> bool:
        """Return whether a frontier of so many points may still be split."""
        full = self.point_limit is not None and points >= self.point_limit
        return not full and not is_late()


@dataclass(frozen=True, eq=False)
class _ColumnPoints:
    """The turning points as columns, with the dual bounds proved so far, by price."""

    pricing: PricingProblem
    columns: tuple[Column, ...]  # [points]
    proofs: dict[tuple[float, bool], Proof] = field(default_factory=dict)  # by price and slack

    def policy(self, point: int) -> Policy:
        return self.pricing.policy(self.columns[point])

    def proved(
        self, frontier: Frontier, number: int, weight: float, budget: float, attained: float
    ) -> float:
        """Return a certified lower bound of the objective of all policies within a budget.

        The bound is proved at the prices of the segments next to the budget and, if such a segment
        is not settled, at the prices at which its end points were found.

        Args:
            frontier: the frontier of these points.
            number: the turning point at or before the budget.
            weight: weight of the next point in the lottery at the budget.
            budget: failure budget.
            attained: objective of that lottery.
        """
        last, open_below = len(self.columns) - 1, frontier.below > frontier.tolerance
        segments = {number} if weight > 0.0 else {max(number - 1, 0), number}
        proofs = [self._proof_below(frontier, segment) for segment in segments]
        if any(segment < last and open_below[segment] for segment in segments):
            for point in (number,) if weight == 0.0 else (number, number + 1):
                price = self.columns[point].found_at
                if point == last:
                    proofs.append(self._proof_below(frontier, last))
                elif price is not None:
                    proofs.append(self.proof(price, self.columns[point]))
        row = FailureRow(budget, frontier.ratio)
        return least_of(max(map(row.lower_bound, proofs)), attained)

    def _proof_below(self, frontier: Frontier, segment: int) -> Proof:
        """Return the dual bound at the price of a segment.

        No segment begins at the last point. The number of this point gives the dual bound for a
        slack budget.
        """
        column = self.columns[segment]
        if segment < len(self.columns) - 1:
            return self.proof(float(frontier.price[segment]), column)
        price = float(frontier.objective[-1]) * BELOW_RATIO if frontier.ratio else 0.0
        return self.proof(price, column, slack=frontier.ratio)

    def proof(self, price: float, column: Column, *, slack: bool = False) -> Proof:
        """Return the dual bound at a price, cached.

        Args:
            price: price of failure.
            column: a policy that is optimal, or nearly so, at this price.
            slack: use the form ``cost - price * goal`` (:class:`Proof`).
        """
        if (price, slack) not in self.proofs:
            proof = self.pricing.prove(price, column, slack=slack)
            self.proofs[price, slack] = replace(proof, values=np.zeros(0))  # only bounds are used
        return self.proofs[price, slack]


@dataclass(frozen=True, eq=False)
class _OptimumPoints:
    """The turning points as lotteries, and the lower bounds proved by all optima."""

    policies: tuple[MixedPolicy, ...]  # [points]
    sense: ObjectiveSense
    bounds: FloatArray  # [optima] at which the problem was solved
    value: FloatArray  # [optima] minimised value attained there
    bound: FloatArray  # [optima] lower bound proved there
    prices: FloatArray  # [optima] infinite: proves nothing of larger bounds
    least_goal: float | None  # least goal probability of all lotteries; None: not given success
    is_failure: bool  # whether the bounds are failure budgets

    def policy(self, point: int) -> MixedPolicy:
        return self.policies[point]

    def proved(
        self, frontier: Frontier, number: int, weight: float, budget: float, attained: float
    ) -> float:
        """Return a certified bound of the objective, given a bound of the traced quantity.

        Args:
            frontier: the frontier of these points.
            number: not used.
            weight: not used.
            budget: bound of the traced quantity.
            attained: objective of the lottery at this bound.
        """
        proved = self.sense.stated(self.least(budget))
        return max(proved, attained) if frontier.maximises else min(proved, attained)

    def least(self, bound: float) -> float:
        """Return a lower bound of the minimised value, given a bound of the traced quantity."""
        beyond = bound - self.bounds
        tells = (beyond <= 0.0) | np.isfinite(self.prices)
        saved = np.where(np.isfinite(self.prices), self.prices, 0.0) * beyond
        height, slope = self.value[tells], (self.bound - self.value - saved)[tells]
        longest = 1.0
        if self.least_goal is not None:
            goal = max(self.least_goal, 1.0 - bound if self.is_failure else 0.0)
            longest = 1.0 / max(goal, _RAREST)
        up, down = slope >= 0.0, slope < 0.0
        first = _rounded_down(height[up], slope[up], 1.0)
        last = _rounded_down(height[down], slope[down], longest)
        rise, turn = height[up][:, None], slope[up][:, None]
        t = (rise - height[down]) / (slope[down] - turn)
        crossing = _rounded_down(rise, turn, t)[(t >= 1.0) & (t <= longest)]
        return float(np.concatenate([[0.0], first, last, crossing]).max())


def _rounded_down(height: FloatArray, slope: FloatArray, t: FloatArray | float) -> FloatArray:
    """Return ``height + slope * t``, rounded down."""
    rise = slope * t
    return np.asarray(height + rise - 4.0 * MACHINE_EPSILON * (np.abs(height) + np.abs(rise)))


def _split(search: _Columns | _Optima, *, steep_only: bool = False) -> None:
    """Split segments until the gap below each segment is within the tolerance.

    If splitting may stop early, the segment with the largest gap is split first. Otherwise the
    newest segment is split first, because its policies are the best warm starts.

    Args:
        search: finds points below segments and splits them; updated.
        steep_only: split only the segment of steepest slope, until it is settled.
    """
    limits, waiting, numbers = search.limits, list[Any](), count()

    def look(p: Any, q: Any) -> None:
        """Put the segment from p to q on the heap, unless it is settled."""
        below, candidate = search.look(p, q)
        if candidate is not None:
            number = next(numbers)
            heappush(waiting, (-below if search.worst_first else -number, number, p, q))

    for p, q in pairwise(search.points):
        look(p, q)
    while waiting and limits.allows(len(search.points) * (_STEEP_SHARE if steep_only else 1)):
        *_, p, q = heappop(waiting)
        candidate: Any
        below, candidate = search.look(p, q)  # newer points may have closed it
        if candidate is None:
            continue
        if search.worst_first and waiting and below < -waiting[0][0]:
            heappush(waiting, (-below, next(numbers), p, q))
            continue
        ends = search.split(p, q, candidate)
        for left, right in [*pairwise(ends)][: 1 if steep_only else None]:
            look(left, right)


class _Columns:
    """Turning points over the failure budget, found by pricing at the slopes of segments. Mutable.

    Each point is a column of the process.
    """

    def __init__(self, compiled: CompiledProblem, limits: _TraceLimits) -> None:
        """Find the two ends of the frontier: the safest column, and the cheapest one.

        Raises:
            ModelError: failing is optimal at the steepest price.
        """
        self.limits, self.worst_first = limits, limits.may_stop
        self.pool, self.ratio = Pool(compiled.pricing()), compiled.ratio
        row, steepest = FailureRow(1.0, self.ratio), limits.steepest_price
        if steepest is None:
            safest = checked_least_failure(compiled, None).column
        else:
            weights = np.array([1.0, steepest])
            safest = self.pool.minimise(weights, self.pool.pricing.first())
            if row.ratio and row.objective(safest.cost, safest.goal) >= steepest:
                raise ModelError(
                    f"failing is optimal at a price of failure of {steepest:g}: "
                    "set steepest_price above the least cost given success"
                )
        free = generate(master_at(self.pool, row, safest), SolveOptions(limits.gap))
        last = free.columns[-1]
        self.ends_early = not free.finished
        self.ends = [safest] if last.failure <= safest.failure else [safest, last]
        self._priced: dict[float, Column] = {}  # columns by price
        self.begin()

    def begin(self) -> None:
        """Reset the points to both ends; columns that were found by pricing stay cached."""
        self._columns, self._below = [*self.ends], dict[float, float]()

    @property
    def points(self) -> list[Column]:
        """The turning points found so far, by increasing failure."""
        return sorted(self._columns, key=lambda column: column.failure)

    def look(self, p: Column, q: Column) -> tuple[float, Column | None]:
        """Solve the pricing problem at the slope of the segment from p to q.

        Returns:
            The relative gap below the segment, and the column that splits the segment, or None if
            the segment is settled.
        """
        price = max((p.cost - q.cost) / excess_failure(q, p), 0.0)
        below, gap = self._below.get(p.failure, 1.0), self.limits.gap
        column = self._priced.get(price)
        if price > 0.0 and below > gap and column is None:
            with WithIncumbent():
                column = replace(self.pool.minimise(np.array([1.0, price]), q), found_at=price)
                calls, points = self.pool.calls, len(self._columns)
                _LOG.debug("%d pricing calls, %d turning points", calls, points)
                self.limits.report(calls, points)
        if price == 0.0 or column is not None:
            below = _share_below(p, q, column, price)
        self._below[p.failure] = below
        waits = column is not None and below > gap
        if column is not None:  # only queued columns serve as warm starts
            self._priced[price] = column if waits else replace(column, totals=None)
        return below, column if waits else None

    def split(self, p: Column, q: Column, column: Column) -> tuple[Column, ...]:
        """Add the column below the segment from p to q to the points; return all three."""
        light = replace(column, totals=None)
        self._columns.append(light)
        self._priced[column.found_at or 0.0] = light
        self._below[column.failure] = self._below[p.failure] * p.cost / max(column.cost, _LEAST)
        return p, column, q

    def frontier(self) -> Frontier:
        columns = self.points
        spent, goal, cost = np.array([(c.failure, c.goal, c.cost) for c in columns]).T
        light = tuple(replace(column, totals=None) for column in columns)
        return Frontier(
            spent=spent, goal=goal, cost=cost, price=-np.diff(cost) / np.diff(spent),
            below=np.array([self._below[column.failure] for column in columns[:-1]]),
            tolerance=self.limits.gap, hidden=0.0, ratio=self.ratio,
            complete=self.limits.steepest_price is None, ends_early=self.ends_early,
            pricing_calls=self.pool.calls, work=self.pool.work,
            _points=_ColumnPoints(self.pool.pricing, light),
        )  # fmt: skip


def _share_below(p: Column, q: Column, column: Column | None, price: float) -> float:
    """Return the distance of a column below the segment from p to q, relative to the cost of p.

    The distance is 0 if there is no column, or if its failure is not between those of p and q.
    """
    if column is None or not p.failure < column.failure < q.failure:
        return 0.0
    below = p.cost - column.cost - price * (column.failure - p.failure)
    return max(below, 0.0) / max(p.cost, _LEAST)


def _traced_by_columns(problem: Problem, limits: _TraceLimits) -> Frontier:
    """Trace over the failure budget, on finer processes until the cap leaves a small enough gap.

    The gap is largest at the end of least failure, where the price is highest. A few pricing calls
    at that end determine how fine the process must be; then the whole frontier is traced.

    Raises:
        ModelError: the problem has no expected cost to trace.
        InfeasibleError: case S, and the goal cannot be reached from the start.
        Stop: the time limit was reached before the first point.
    """
    name, semantics = type(problem).__name__, problem.semantics
    if semantics.counts_law:
        raise ModelError(f"{name} has no expected cost to trace: trace S3P instead")
    if problem.several_rows:
        raise ModelError(
            f"{name} has too many distinct total costs and no common unit: round the costs, "
            "or trace MCMP instead"
        )
    compiled = problem.compile()
    if limits.steepest_price is None:
        compiled = compiled.for_program()
    elif compiled.is_guess:
        compiled = compiled.refined(limits.steepest_price) or compiled
    frontier: Frontier | None = None
    columns: _Columns | None = None
    calls, work, steep_only, attempts = 0, Work(), compiled.ratio, 2 * _REFINEMENTS
    while True:
        with WithIncumbent() as search:
            columns = columns or _Columns(compiled, limits)
            columns.begin()
            _split(columns, steep_only=steep_only)
        if search.stop or columns is None:
            if frontier is None:
                raise Stop from search.stop
            return frontier
        traced, attempts = columns.frontier(), attempts - 1
        lost = _share_lost(compiled, traced)
        spent = calls + traced.pricing_calls, work + traced.work
        frontier = replace(traced, hidden=lost, pricing_calls=spent[0], work=spent[1])
        is_fine = lost <= limits.gap or is_late()
        finer = None if is_fine else compiled.refined(float(traced.price[0]))
        if attempts == 0 or (finer is None and not steep_only):
            return frontier
        if finer is not None:
            (calls, work), compiled, columns = spent, finer, None
        steep_only = finer is not None


def _share_lost(compiled: CompiledProblem, traced: Frontier) -> float:
    """Return an upper bound of the frontier's relative error that the cap on the cost causes."""
    if len(traced.price) == 0:
        return 0.0
    lost = np.inf
    with WithIncumbent(), closing():
        lost = max(compiled.tail_loss(float(p)) for p in (traced.price[0], traced.price[-1]))
    return lost / max(float(traced.cost.min()), _LEAST) if lost > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class _Optimum:
    """The optimum at one bound of the traced quantity.

    ``spent`` and ``value`` are a point of the frontier; ``proved`` and ``price`` define a line that
    no policy lies below.
    """

    spent: float  # of the traced quantity
    value: float
    goal: float
    bound: float
    proved: float  # lower bound of every policy within it
    price: float  # of the bound in that proof; infinite: proves nothing of larger bounds
    policy: MixedPolicy


class _Optima:
    """Turning points over one limit, found by solving at several bounds of it. Mutable.

    The other limits of the problem stay fixed.
    """

    worst_first = True

    def __init__(self, problem: Problem, over: str, limits: _TraceLimits) -> None:
        """Compile the problem, without solving it."""
        self.problem, self.over, self.limits = problem, over, limits
        self.calls, self.work, self.optima = 0, Work(), list[_Optimum]()
        self.stated = compiled_constrained(problem)
        if over == FAILURE_ROW:  # the stated budget is ignored, even if it is the least
            self.stated = replace(self.stated, budget=1.0)
        self.truth = true_figures(problem, self.stated)
        self.options = SolveOptions(_FINER * limits.gap)

    def traced(self) -> Frontier:
        """Trace the frontier.

        Raises:
            InfeasibleError: no policy satisfies the other limits.
            Stop: the time limit was reached before both ends were known.
        """
        _ = self.stated.pricing()  # for all bounds
        self.add(1.0 if self.over == FAILURE_ROW else np.inf)
        least, free = self.least(), self.optima[0].spent
        is_least = least >= free
        # the least may be attained only by policies that never reach the goal
        for share in () if is_least else (0.0, *_NEAR):
            with suppress(InfeasibleError):
                self.add(least + share * (free - least))
                is_least = share == 0.0
                break
        with WithIncumbent():
            _split(self)
        return self.frontier(complete=is_least)

    @property
    def points(self) -> list[_Optimum]:
        """The optima that no other optimum dominates, by increasing traced quantity (``spent``)."""
        points: list[_Optimum] = []
        for one in sorted(self.optima, key=lambda o: (o.spent, o.value)):
            if not points or one.value < points[-1].value - _STRAIGHT * abs(points[-1].value):
                points.append(one)
        return points

    def look(self, p: _Optimum, q: _Optimum) -> tuple[float, float | None]:
        """Return the relative gap below the segment from p to q, and where to split the segment.

        The second result is the bound at which to solve next, or None if the segment is settled.
        """
        below, bound = self._apart(p, q)
        own = max((o.value - o.proved) for o in (p, q)) / self._scale(p, q)
        points = self.points
        narrow = _NARROW * (points[-1].spent - points[0].spent)
        settled = below <= max(self.limits.gap, 2.0 * own) or q.spent - p.spent <= narrow
        return below, None if settled else bound

    def split(self, p: _Optimum, q: _Optimum, bound: float) -> tuple[_Optimum, ...]:
        """Solve at a bound between p and q.

        Returns:
            The points from p to q, both included; empty if the new optimum is not between them.
        """
        self.add(bound)
        if not p.spent < self.optima[-1].spent < q.spent:
            return ()
        return tuple(o for o in self.points if p.spent <= o.spent <= q.spent)

    def lines(self, *turning: _Optimum) -> _OptimumPoints:
        """Return the turning points as lotteries, with the lower bounds proved by all optima."""
        told = [(o.bound, o.value, o.proved, o.price) for o in self.optima]
        bounds, value, proved, prices = np.array(told).T
        policies, goal = tuple(o.policy for o in turning), None
        if self.stated.ratio:
            goal = self.stated.least_goal
        told_of = policies, self.stated.sense, bounds, value, proved, prices
        return _OptimumPoints(*told_of, goal, self.over == FAILURE_ROW)

    def _scale(self, p: _Optimum, q: _Optimum) -> float:
        """Return the divisor of relative gaps: the larger absolute objective of p and q."""
        worth = self.stated.sense.stated
        return max(abs(worth(p.value)), abs(worth(q.value)), _LEAST)

    def _mixed(self, p: _Optimum, q: _Optimum, bound: float) -> float:
        """Return the value of the lottery over p and q whose traced quantity is ``bound``."""
        w = (bound - p.spent) / (q.spent - p.spent)
        goals = ((1.0 - w) * p.goal, w * q.goal) if self.stated.ratio else (1.0 - w, w)
        return (goals[0] * p.value + goals[1] * q.value) / sum(goals)

    def _apart(self, p: _Optimum, q: _Optimum) -> tuple[float, float]:
        """Return the largest relative gap below the segment from p to q, and where to split it."""
        width, share, lines = q.spent - p.spent, 0.5, self.lines()
        left, right = (o.price / (o.goal if self.stated.ratio else 1.0) for o in (p, q))
        if np.isfinite(left) and left > right:  # the lines of both ends meet
            share = (p.value - q.value - right * width) / ((left - right) * width)
        shares = [min(max(share, _INSIDE), 1.0 - _INSIDE), *(_SPLITS if self.stated.ratio else ())]
        shares += [] if np.isfinite(left) else [_NARROW]
        bounds = [p.spent + share * width for share in shares]
        most, k = max((self._mixed(p, q, b) - lines.least(b), k) for k, b in enumerate(bounds))
        split = 0.5 if shares[k] == _NARROW else shares[k]
        return most / self._scale(p, q), p.spent + split * width

    def least(self) -> float:
        """Return the least value of the traced quantity among policies within the other limits."""
        problem, of_failure = self.problem, self.over == FAILURE_ROW
        conditions = {condition.name: condition for condition in problem.conditions}
        objective = conditions.pop(self.over, None)
        aim = Aim.GREATEST_GOAL if of_failure else Aim.LEAST_COST
        semantics = replace(problem.semantics, aim=aim, measure=None)
        budget = 1.0 if of_failure else problem.failure_budget
        held = tuple(conditions.values())
        asked = problem.model, problem.start, False, budget, semantics, held, problem.discount
        safest = compiled_constrained(RestatedProblem(*asked, objective))
        least = safest.sense.stated(rows_optimum(safest, self.options).value)
        return 1.0 - least if of_failure else least

    def add(self, bound: float) -> None:
        """Solve the problem at a bound of the traced quantity, and add the optimum."""
        stated, over, budget = self.stated, self.over, self.stated.budget
        if over == FAILURE_ROW:
            budget = bound
        side = tuple(
            replace(row, bound=row.activity(bound)) if row.name == over else row
            for row in stated.side
        )
        optimum = rows_optimum(stated.bounded(budget, side), self.options, self.truth)
        compiled = optimum.compiled
        if compiled.layers > stated.layers and (compiled.budget is None) == (stated.budget is None):
            self.stated = compiled.bounded(stated.budget, stated.side)  # for the next bound
        found = evaluate(optimum.policy, self.problem)
        failure = found.limited_failure
        spent = failure if over == FAILURE_ROW else found.secondary_costs[over]
        price = (
            optimum.prices.get(over, np.inf) if np.isfinite(bound) and optimum.bound > 0.0 else 0.0
        )
        self.optima.append(_Optimum(
            spent=min(spent, bound), value=optimum.value, goal=1.0 - failure,
            bound=bound if np.isfinite(bound) else spent, proved=optimum.bound,
            price=price, policy=optimum.policy,
        ))  # fmt: skip
        self.calls, self.work = self.calls + optimum.calls, self.work + optimum.work
        _LOG.debug("%d pricing calls, %d bounds of %s", self.calls, len(self.optima), over)
        self.limits.report(self.calls, len(self.optima))

    def frontier(self, *, complete: bool) -> Frontier:
        """Return the frontier through all turning points.

        Args:
            complete: whether the first point is the least feasible bound.
        """
        points, sense, ratio = self.points, self.stated.sense, self.stated.ratio
        turning = points[:1]
        for one, after in pairwise(points[1:]):
            straight = self._mixed(turning[-1], after, one.spent)
            if one.value < straight - _STRAIGHT * self._scale(one, one):
                turning.append(one)
        turning += points[1:][-1:]
        spent, value, goal = np.array([(o.spent, o.value, o.goal) for o in turning]).T
        below = [max(self._apart(p, q)[0], 0.0) for p, q in pairwise(turning)]
        cost = value * goal if ratio else np.array([sense.stated(v) for v in value])
        objective = cost / goal if ratio else cost
        own = [(o.value - o.proved) / self._scale(o, o) for o in turning]
        return Frontier(
            spent=spent, goal=goal, cost=cost, price=np.abs(np.diff(objective) / np.diff(spent)),
            below=np.array(below), tolerance=self.limits.gap, hidden=max(0.0, *own), ratio=ratio,
            complete=complete, pricing_calls=self.calls, work=self.work,
            _points=self.lines(*turning), over=self.over, maximises=sense.constant is not None,
        )  # fmt: skip
