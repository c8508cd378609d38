"""The trade-off between the objective and any limit, the other limits held at their bounds.

Over the failure budget alone columns are priced (:mod:`ssp_lp.methods.frontier`). Over a named
limit, and wherever others are held, the problem is solved at one bound after another, with all its
rows. An optimum at a bound says two things of every other bound:

- its lottery, mixed with that of another bound, attains what lies between the two;
- its prices prove how far below no policy lies: ``cost >= L - price * (bound - its own bound)``.

The least objective is convex in the bound, and linear between turning points. Where the lines that
two neighbours prove meet below the line between their optima, the problem is solved next: either
that is a turning point, or it lies on a segment, whose price it proves at both ends.

**Given success** the objective is a ratio, of which prices prove ``cost / goal >= c - (c - L +
price * (bound - its own bound)) * t``, where c is what was attained and ``t = 1 / goal``. The goal
probability of a lottery is not known, but it is one number in all these lines: the least that their
greatest comes to for any t >= 1 is a bound. Lines proved inside of a segment pass through both its
ends, and meet nowhere else: there the bound is tight.

**Over two limits** what optima prove are planes, and what they attain all lotteries over them. The
problem is solved next at those bounds, of a grid, where both lie apart most.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from ssp_lp.analysis.evaluation import evaluate
from ssp_lp.arrays import MACHINE_EPSILON, RELATIVE_GAP, FloatArray, ReadOnlyCopies
from ssp_lp.column_generation.column import FailureRow
from ssp_lp.column_generation.restricted_master import solve_master
from ssp_lp.compiled.deadline import Deadline, Stop, WithIncumbent, interrupted, until
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import (
    Argument,
    InfeasibleError,
    ModelError,
    OutOfTimeError,
    did_you_mean,
    is_number,
    optional_module,
    wrong_argument,
)
from ssp_lp.methods.frontier import Frontier, TraceLimits, traced_over_failure
from ssp_lp.methods.rows import rows_optimum, true_figures
from ssp_lp.model.arguments import explained
from ssp_lp.model.report import Facts, Table
from ssp_lp.options import SolveOptions, Status, deadline_of, progress_shown
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import (
    Problem,
    Restated,
    check_problem,
    compiled_constrained,
    conditions_of,
    has_rows,
    pulled_back,
    requirements,
    unrolled,
)
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import AS_ASKED, Aim, ObjectiveSense

_LOG = logging.getLogger("ssp_lp.frontier")
_FINER = 0.1  # of the gap that is asked for: how exactly the problem is solved at each bound
_STRAIGHT = 1e-11  # relative: a point so little below the line of its neighbours is none that turns
_NARROW = 1e-9  # of the whole range: segments are not split further
_NEAR = 1e-4, 1e-2, 0.1  # of the range: so near to a least that no policy that counts attains
_INSIDE = 1e-4  # of a segment: so far from its ends it is split at least
_RAREST = 1e-12  # goal probability below which nothing is proved of a cost given success
_SPLITS = 0.25, 0.5, 0.75  # of a segment, given success, where lines meet nowhere in particular


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
    """Trace the frontier over a budget, from the least of it to where more of it buys nothing.

    Over the failure budget each segment is priced at its own slope: either no policy lies below it
    and it is part of the frontier, or the policy found splits it. Case M ends at price 0; case S
    where the price falls to the ratio itself, beyond which failing more does not lower the cost
    given success. Over another limit, and where others are held at their bounds, the problem is
    solved at one bound after another, where its bounds from above and below lie apart most.

    Args:
        problem: what it allows of what is traced does not matter; all other limits are kept.
        over: "failure", or the name of a limit that bounds a quantity from above.
        gap: how far a policy may lie below a segment, as a share of the cost at its safer end
            (over other limits of the larger objective at its ends).
        steepest_price: begin with the policy that is best at this price of failure (kappa in case
            S) rather than at the least failure, near which the price grows without bound.
        point_limit: stop splitting after so many turning points, of which the segments with most
            below them get theirs first; ``gap`` is then what was reached.
        time_limit: seconds after which splitting stops, also within a pricing call, as Ctrl-C does
            at once. The points found are kept; ``open_segments`` says where others may be missing.
        progress: called after each pricing call with (calls, turning points so far).
        verbose: show how far it has come (``ssp_lp.progress_shown``).

    Raises:
        ModelError: an argument out of range, a problem without a failure budget, no such limit, or
            a criterion that is no linear program.
        InfeasibleError: case S, and the goal cannot be reached from the start; or the other limits
            cannot be kept.
        OutOfTimeError: the time limit passed before there was a point.
        KeyboardInterrupt: Ctrl-C came before there was one.

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
    limits = TraceLimits(gap, steepest_price, point_limit, deadline < np.inf, progress)
    asked = _traceable(unrolled(problem), over, limits)

    def traced() -> Frontier:
        """The frontier, traced over failure alone or over any limit."""
        if over == FAILURE_ROW and not has_rows(asked):
            return traced_over_failure(asked, limits)
        return _Tracing(asked, [over], limits).traced()

    frontier, ended = _within_time(traced, deadline, over, verbose=verbose)
    status = ended.status(np.inf if frontier.ends_early else frontier.gap, gap)
    return replace(frontier, _problem=problem, status=status)


def trace_surface(
    problem: Problem,
    over: Sequence[str],
    *,
    gap: float = 1e-3,
    point_limit: int = 200,
    time_limit: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    verbose: bool = False,
) -> Surface:
    """Trace the least objective over two limits (or more) at once, all others held.

    The problem is solved at those bounds where what is attained and what is proved lie apart most,
    of a grid over all bounds that matter, until they do so nowhere by more than the gap.

    Args:
        problem: what it allows of what is traced does not matter; all other limits are kept.
        over: "failure", or names of limits that bound a quantity from above.
        gap: how far both bounds may lie apart on the grid, as a share of the largest objective.
        point_limit: most bounds at which the problem is solved.
        time_limit: seconds after which no further ones are solved.
        progress: called after each of them with (pricing calls, how many were solved).
        verbose: show how far it has come (``ssp_lp.progress_shown``).

    Raises:
        ModelError: an argument out of range, no such limit, the same one twice, or a criterion that
            is no linear program.
        InfeasibleError: the other limits cannot be kept.
        OutOfTimeError: the time limit passed before there was a point.
        KeyboardInterrupt: Ctrl-C came before there was one.

    Example:
        >>> from ssp_lp import MCMP, SSP, trace_surface, visits
        >>> model = SSP.from_transitions(
        ...     {"a": {"fast": [(0.9, "g", 1.0), (0.1, "yard", 1.0)], "slow": [(1.0, "g", 10.0)]},
        ...      "yard": {"on": [(0.5, "g", 2.0), (0.5, "pit", 2.0)]}, "pit": {}}, goal={"g"},
        ...     treat_actionless_as_dead_ends=True)
        >>> problem = MCMP(model, "a", constraints={"yard": visits("yard") <= 0.05})
        >>> surface = trace_surface(problem, ["failure", "yard"])
        >>> [round(bound, 6) for bound in surface.bounds_at(0.02, 0.05)]
        [6.48, 6.48]
    """
    check_problem(problem, "trace_surface")
    over = over if isinstance(over, str) else list(over)
    if isinstance(over, str) or len(set(over)) != len(over) or len(over) < 2:
        raise wrong_argument("over", "be several different limits", over)
    deadline = deadline_of(time_limit, time.perf_counter())
    limits = TraceLimits(gap, None, point_limit, deadline < np.inf, progress)
    inner = unrolled(problem)
    for name in over:
        inner = _traceable(inner, name, limits)
    surface, ended = _within_time(
        lambda: _surface_of(_Tracing(inner, over, limits), problem),
        deadline,
        " and ".join(over),
        verbose=verbose,
    )
    return replace(surface, status=ended.status(surface.gap, gap))


_Traced = TypeVar("_Traced")


def _within_time(
    trace: Callable[[], _Traced], deadline: float, over: str, *, verbose: bool
) -> tuple[_Traced, Deadline]:
    """What was traced by a deadline, and how that ended it.

    Raises:
        OutOfTimeError: the time ended before there was a point.
        KeyboardInterrupt: Ctrl-C came before there was one.
    """
    with progress_shown(verbose), until(deadline) as ended:
        try:
            return trace(), ended
        except Stop:
            if ended.is_interrupted:
                raise interrupted() from None
            told = f"the time limit ended before the least {over} was known: allow more time"
            raise OutOfTimeError(told) from None


def _traceable(problem: Problem, over: str, limits: TraceLimits) -> Problem:
    """The problem that is solved, once it is known that what is traced can be.

    Raises:
        ModelError: it cannot: nothing of this name is limited from above, or no program says so.
    """
    name, asked = type(problem).__name__, requirements(problem)
    if over == FAILURE_ROW:
        if asked.aim is not Aim.LEAST_COST or problem.semantics.forbids_failing:
            raise ModelError(f"{name} has no failure budget to trace: trace MCMP's")
        if not asked.rows:
            return problem
    else:
        names = [condition.name for condition in conditions_of(problem)]
        if over not in names:
            known = ", ".join(map(repr, names)) or "none"
            raise ModelError(
                Argument("over"), f" must be 'failure' or the name of a limit ({known}), not "
                f"{over!r}{did_you_mean(over, names)}",
            )  # fmt: skip
        if conditions_of(problem)[names.index(over)].lower is not None:
            raise ModelError(f"limit {over!r} bounds from below: state what is to be little, such "
                             "as 1 - end_probability(...) <= 0.1, to trace it")  # fmt: skip
    if asked.is_risk:
        raise ModelError(f"{name} is no linear program: trace the limits of another criterion")
    if limits.steepest_price is not None:
        raise ModelError(Argument("steepest_price"), " goes with the failure budget alone")
    return problem


@dataclass(frozen=True, eq=False)
class _Optimum:
    """The optimum at some bounds, in what is minimised: a point, and a plane below all policies."""

    spends: FloatArray  # [limits] of what is traced
    value: float
    goal: float
    bounds: FloatArray  # [limits]
    proved: float  # of every policy that keeps to them
    prices: FloatArray  # [limits] of the bounds in that proof; infinite: no word of larger bounds
    policy: MixedPolicy

    @property
    def spent(self) -> float:
        """What is spent of the limit that is traced, or of the first of them."""
        return float(self.spends[0])

    @property
    def price(self) -> float:
        """The price of its bound."""
        return float(self.prices[0])


@dataclass(frozen=True, eq=False)
class _Lines:
    """What the prices of all optima prove at any bounds."""

    bounds: FloatArray  # [optima, limits] of each
    value: FloatArray  # [optima] attained at them
    proved: FloatArray  # [optima] at them
    prices: FloatArray  # [optima, limits]
    least_goal: float | None  # that all lotteries have; None: nothing is counted given success
    failure: int | None  # which of the bounds is a failure budget

    def least(self, bounds: FloatArray) -> float:
        """No policy that keeps to bounds has less: the least over t of the greatest line.

        Args:
            bounds: [limits].
        """
        longest, beyond = self._longest(bounds), bounds - self.bounds
        tells = ((beyond <= 0.0) | np.isfinite(self.prices)).all(axis=1)
        finite = np.where(np.isfinite(self.prices), self.prices, 0.0)
        saved = (finite * beyond).sum(axis=1)
        height, slope = self.value[tells], (self.proved - self.value - saved)[tells]
        up, down = slope >= 0.0, slope < 0.0
        first = _rounded_down(height[up], slope[up], 1.0)
        last = _rounded_down(height[down], slope[down], longest)
        rise, turn = height[up][:, None], slope[up][:, None]
        t = (rise - height[down]) / (slope[down] - turn)
        crossing = _rounded_down(rise, turn, t)[(t >= 1.0) & (t <= longest)]
        return float(np.concatenate([[0.0], first, last, crossing]).max())

    def _longest(self, bounds: FloatArray) -> float:
        """The greatest that 1 / goal may be."""
        if self.least_goal is None:
            return 1.0
        goal = max(self.least_goal, 0.0 if self.failure is None else 1.0 - bounds[self.failure])
        return 1.0 / max(goal, _RAREST)


def _rounded_down(height: FloatArray, slope: FloatArray, t: FloatArray | float) -> FloatArray:
    """``height + slope * t``, rounding counted against it."""
    rise = slope * t
    return np.asarray(height + rise - 4.0 * MACHINE_EPSILON * (np.abs(height) + np.abs(rise)))


@dataclass(frozen=True, eq=False, repr=False)
class LimitFrontier(Frontier):
    """A frontier of optima at bounds; its turning points may be lotteries themselves."""

    _lines: _Lines | None = None
    _members: tuple[MixedPolicy, ...] = ()  # [points]
    _sense: ObjectiveSense = AS_ASKED

    def bounds_at(self, budget: float) -> tuple[float, float]:
        """What the optimum within a bound surely lies between; nothing is solved.

        One of them is what :meth:`policy_at` attains, the other is proved by the prices of all
        optima on the way.

        Raises:
            InfeasibleError: no policy keeps to the bound.
        """
        number, weight = self._locate(budget)
        attained = self._attained(number, weight, FailureRow(budget, self.ratio))
        worth = self._sense.worth
        least = 0.0 if self._lines is None else self._lines.least(np.array([budget]))
        if self.maximises:
            return attained, max(worth(least), attained)
        return min(worth(least), attained), attained

    def _lottery(self, number: int, weights: FloatArray) -> MixedPolicy:
        """The lottery over the lotteries of turning points from one on."""
        return _mixed_of(self._members[number : number + len(weights)], weights)


class _Tracing:
    """Optima at bounds of some limits, the others held. Grows."""

    def __init__(self, problem: Problem, over: Sequence[str], limits: TraceLimits) -> None:
        """Nothing is solved yet."""
        self.problem, self.over, self.limits = problem, tuple(over), limits
        self.calls, self.work = 0, Work()
        self.stated = compiled_constrained(problem)
        if FAILURE_ROW in self.over:  # whatever was allowed, even if that was the least
            self.stated = replace(self.stated, budget=1.0)
        self.truth = true_figures(problem, self.stated)
        self.options = SolveOptions(_FINER * limits.gap)
        self.optima: list[_Optimum] = []

    @property
    def unlimited(self) -> list[float]:
        """Bounds of what is traced that allow everything."""
        return [1.0 if name == FAILURE_ROW else np.inf for name in self.over]

    def begin(self) -> None:
        """Solve where nothing of what is traced is limited."""
        _ = self.stated.pricing()  # for all bounds
        self.add(self.unlimited)

    def add_at_least(self) -> bool:
        """Solve at the least that can be spent, or near it; whether that is where it began.

        Near it, where only policies spend the least that do not count: they never succeed.
        """
        least, free = self.least(0), self.optima[0].spent
        if least >= free:
            return True
        for share in (0.0, *_NEAR):
            with suppress(InfeasibleError):
                self.add([least + share * (free - least)])
                return share == 0.0
        return False

    def traced(self) -> Frontier:
        """The frontier.

        Raises:
            InfeasibleError: the other limits cannot be kept.
            Stop: the time ended before both ends were known.
        """
        self.begin()
        complete = self.add_at_least()
        settled: set[tuple[float, float]] = set()
        with WithIncumbent():
            while self.limits.allows(len(points := self._points())):
                lines = self.lines
                worst = max(
                    ((*self._apart(p, q, lines), p, q) for p, q in pairwise(points)
                     if (p.spent, q.spent) not in settled),
                    key=lambda found: found[0], default=None,
                )  # fmt: skip
                if worst is None or worst[0] <= self.limits.gap:
                    break
                share, bound, p, q = worst
                own = max((o.value - o.proved) for o in (p, q)) / self._scale(p, q)
                width = q.spent - p.spent
                whole = points[-1].spent - points[0].spent
                if share <= 2.0 * own or width <= _NARROW * whole:
                    settled.add((p.spent, q.spent))
                    continue
                self.add([bound])
                if not any(p.spent < o.spent < q.spent for o in self.optima):
                    settled.add((p.spent, q.spent))
        return replace(self._frontier(), complete=complete)

    def _points(self) -> list[_Optimum]:
        """The optima that cost less than all that spend no more, by what they spend."""
        points: list[_Optimum] = []
        for one in sorted(self.optima, key=lambda o: (o.spent, o.value)):
            if not points or one.value < points[-1].value - _STRAIGHT * abs(points[-1].value):
                points.append(one)
        return points

    @property
    def lines(self) -> _Lines:
        """What the optima so far prove."""
        bounds, prices = (
            np.array(each)
            for each in zip(*((o.bounds, o.prices) for o in self.optima), strict=True)
        )
        value, proved = np.array([(o.value, o.proved) for o in self.optima]).T
        goal = self.stated.least_goal if self.stated.ratio else None
        failure = self.over.index(FAILURE_ROW) if FAILURE_ROW in self.over else None
        return _Lines(bounds, value, proved, prices, goal, failure)

    def _scale(self, p: _Optimum, q: _Optimum) -> float:
        """To which what lies below a segment is compared: the larger objective of its ends."""
        worth = self.stated.sense.worth
        return max(abs(worth(p.value)), abs(worth(q.value)), 1e-300)

    def _mixed(self, p: _Optimum, q: _Optimum, bound: float) -> float:
        """What the lottery of two optima that meets a bound in between attains."""
        w = (bound - p.spent) / (q.spent - p.spent)
        if not self.stated.ratio:
            return (1.0 - w) * p.value + w * q.value
        goals = (1.0 - w) * p.goal, w * q.goal
        return (goals[0] * p.value + goals[1] * q.value) / sum(goals)

    def _apart(self, p: _Optimum, q: _Optimum, lines: _Lines) -> tuple[float, float]:
        """How far below a segment policies may lie, as a share, and the bound to split it at."""
        width, share = q.spent - p.spent, 0.5
        left, right = (o.price / (o.goal if self.stated.ratio else 1.0) for o in (p, q))
        if np.isfinite(left) and left > right:  # where the lines of both ends meet
            share = (p.value - q.value - right * width) / ((left - right) * width)
        shares = [min(max(share, _INSIDE), 1.0 - _INSIDE), *(_SPLITS if self.stated.ratio else ())]
        shares += [] if np.isfinite(left) else [_NARROW]
        apart = [
            (self._mixed(p, q, b) - lines.least(np.array([b])), k)
            for k, share in enumerate(shares)
            for b in [p.spent + share * width]
        ]
        most, k = max(apart)
        split = 0.5 if shares[k] == _NARROW else shares[k]
        return most / self._scale(p, q), p.spent + split * width

    def least(self, number: int) -> float:
        """The least that can be spent of one of what is traced, the limits that are not, held."""
        problem, name = self.problem, self.over[number]
        semantics = replace(problem.semantics, aim=Aim.LEAST_COST, measure=None)
        conditions, objective = conditions_of(problem), None
        held = tuple(each for each in conditions if each.name not in self.over)
        budget = 1.0 if FAILURE_ROW in self.over else problem.failure_budget
        if name == FAILURE_ROW:
            semantics = replace(semantics, aim=Aim.GREATEST_GOAL)
        else:
            objective = next(condition for condition in conditions if condition.name == name)
        asked = problem.model, problem.start, False, budget, semantics, held, problem.discount
        safest = compiled_constrained(Restated(*asked, objective))
        least = safest.sense.worth(rows_optimum(safest, self.options).value)
        return 1.0 - least if name == FAILURE_ROW else least

    def _spent(self, policy: MixedPolicy) -> tuple[FloatArray, float]:
        """What a policy spends of what is traced, [limits], and its goal probability."""
        found = evaluate(policy, self.problem)
        failure = found.limited_failure
        spent = {**found.secondary_costs, FAILURE_ROW: failure}
        return np.array([spent[name] for name in self.over]), 1.0 - failure

    def add(self, bounds: Sequence[float]) -> None:
        """Solve at some bounds.

        Args:
            bounds: of what is traced, in its order.
        """
        asked, stated = dict(zip(self.over, bounds, strict=True)), self.stated
        budget = asked.get(FAILURE_ROW, stated.budget)
        side = tuple(
            replace(row, bound=row.activity(asked[row.name])) if row.name in asked else row
            for row in stated.side
        )
        found = rows_optimum(stated.bounded(budget, side), self.options, self.truth)
        at_least = found.compiled.budget is None, stated.budget is None
        if found.compiled.layers > stated.layers and at_least[0] == at_least[1]:
            self.stated = found.compiled.bounded(stated.budget, stated.side)  # begun there next
        spends, goal = self._spent(found.policy)
        tells = np.isfinite(bounds) if found.bound > 0.0 else np.zeros(len(bounds), dtype=np.bool_)
        self.optima.append(_Optimum(
            spends=np.minimum(spends, bounds), value=found.value, goal=goal,
            bounds=np.where(np.isfinite(bounds), bounds, spends), proved=found.bound,
            prices=np.where(tells, [found.prices.get(name, np.inf) for name in self.over], 0.0),
            policy=found.policy,
        ))  # fmt: skip
        self.calls, self.work = self.calls + found.calls, self.work + found.work
        points = len(self.optima)
        _LOG.debug("%d pricing calls, %d bounds of %s", self.calls, points, ", ".join(self.over))
        if self.limits.progress is not None:
            self.limits.progress(self.calls, points)

    def _frontier(self) -> LimitFrontier:
        """The frontier through all points that turn."""
        points, lines, sense = self._points(), self.lines, self.stated.sense
        turning = points[:1]
        for one, after in pairwise(points[1:]):
            straight = self._mixed(turning[-1], after, one.spent)
            if one.value < straight - _STRAIGHT * self._scale(one, one):
                turning.append(one)
        turning += points[1:][-1:]
        spent, value, goal = np.array([(o.spent, o.value, o.goal) for o in turning]).T
        below = [self._apart(p, q, lines)[0] for p, q in pairwise(turning)]
        cost = value * goal if self.stated.ratio else np.array([sense.worth(v) for v in value])
        objective = cost / goal if self.stated.ratio else cost
        own = [(o.value - o.proved) / self._scale(o, o) for o in turning]
        _LOG.info(
            "%d turning points over %s, gap %.1e", len(turning), self.over[0], max(below, default=0)
        )
        return LimitFrontier(
            spent=spent, goal=goal, cost=cost,
            price=np.abs(np.diff(objective) / np.diff(spent)),
            below=np.maximum(np.array(below), 0.0),
            tolerance=self.limits.gap,
            hidden=max(0.0, *own), ratio=self.stated.ratio, complete=True,
            pricing_calls=self.calls, work=self.work,
            _pricing=self.stated.pricing(), _columns=(),
            over=self.over[0], maximises=sense.constant is not None,
            _lines=lines, _members=tuple(o.policy for o in turning), _sense=sense,
        )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Surface(Facts, ReadOnlyCopies):
    """The least objective over several limits at once, between what is attained and proved.

    Policies mix: at any bounds the best lottery over all points attains the upper bound. The prices
    of the points prove the lower one.
    """

    problem: Problem
    over: tuple[str, ...]
    gap: float  # on the grid both lie apart by no more than this share of the largest objective
    ratio: bool
    maximises: bool
    pricing_calls: int
    work: Work
    _optima: tuple[_Optimum, ...]
    _lines: _Lines
    _sense: ObjectiveSense
    status: Status = Status.OPTIMAL

    @property
    def spent(self) -> FloatArray:
        """What each point spends of what is traced, [points, limits]."""
        return np.array([o.spends for o in self._optima])

    @property
    def objective(self) -> FloatArray:
        """Objective of each point, [points]."""
        return np.array([self._sense.worth(o.value) for o in self._optima])

    @property
    def price(self) -> FloatArray:
        """Prices of the bounds at which each point was solved, [points, limits]."""
        return np.array([o.prices for o in self._optima])

    def bounds_at(self, *bounds: float) -> tuple[float, float]:
        """What the optimum within bounds surely lies between; nothing is solved.

        Args:
            bounds: in the order of ``over``.

        Raises:
            ModelError: another number of bounds, or one that is no number >= 0.
            InfeasibleError: no lottery over the points keeps to them.
        """
        asked, attained, _ = self._best_at(bounds)
        low, high = (
            self._sense.worth(v) for v in (min(self._lines.least(asked), attained), attained)
        )
        return (high, low) if self.maximises else (low, high)

    def policy_at(self, *bounds: float) -> MixedPolicy:
        """A lottery that keeps to bounds, and attains the upper one of :meth:`bounds_at`.

        Raises:
            ModelError: another number of bounds, or one that is no number >= 0.
            InfeasibleError: no lottery over the points keeps to them.
        """
        *_, weights = self._best_at(bounds)
        return pulled_back(_mixed_of([o.policy for o in self._optima], weights), self.problem)

    def _best_at(self, bounds: tuple[float, ...]) -> tuple[FloatArray, float, FloatArray]:
        """Bounds as an array, [limits], the least that a lottery attains within, and its weights.

        Raises:
            ModelError: another number of bounds, or one that is no number >= 0.
            InfeasibleError: no lottery over the points keeps to them.
        """
        if len(bounds) != len(self.over) or not all(
            is_number(b) and 0.0 <= b < np.inf for b in bounds
        ):
            raise ModelError(
                f"give a finite bound >= 0 for each of {', '.join(self.over)}: {bounds!r}"
            )
        asked = np.array(bounds, dtype=np.float64)
        attained, weights = _best_lottery(self._optima, asked, ratio=self.ratio)
        if not np.isfinite(attained):
            named = dict(zip(self.over, bounds, strict=True))
            told = ", ".join(f"{name} <= {bound:g}" for name, bound in named.items())
            raise InfeasibleError(
                f"no lottery over what was found keeps to {told}",
                failure_budget=named.get(FAILURE_ROW, self.problem.failure_budget),
                least_failure=1.0 - max(o.goal for o in self._optima),
            )
        return asked, attained, weights

    def tables(self) -> list[Table]:
        """What was traced, how finely, and between which bounds."""
        ends = zip(self.over, self.spent.min(axis=0), self.spent.max(axis=0), strict=True)
        return [
            Table(
                [
                    (
                        "over",
                        ", ".join(f"{name} {low:.4g} .. {high:.4g}" for name, low, high in ends),
                    ),
                    ("points", f"{len(self.objective):,}"),
                    ("objective", f"{self.objective.min():.6g} .. {self.objective.max():.6g}"),
                    ("gap on the grid", f"{self.gap:.1e}"),
                    ("pricing calls", f"{self.pricing_calls:,}"),
                ]
            )
        ]

    def to_frame(self) -> Any:
        """The points as a table of pandas.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        pandas = optional_module("pandas", "frames")
        columns = {name: self.spent[:, k] for k, name in enumerate(self.over)}
        columns["objective"] = self.objective
        columns |= {f"price of {name}": self.price[:, k] for k, name in enumerate(self.over)}
        return pandas.DataFrame(columns)


_GRID = 16  # bounds of each limit at which a surface is compared
_MOST_PLACES = 1_000  # of the grid


def _surface_of(tracing: _Tracing, problem: Problem) -> Surface:
    """The surface, solved where its bounds lie apart most.

    Raises:
        InfeasibleError: the other limits cannot be kept.
        Stop: the time ended before the ends were known.
    """
    tracing.begin()
    least = np.minimum(
        [tracing.least(k) for k in range(len(tracing.over))], tracing.optima[0].spends
    )
    for k, low in enumerate(least.tolist()):  # where one is tight more of the others may help
        with suppress(InfeasibleError):
            tracing.add([low if k == j else b for j, b in enumerate(tracing.unlimited)])
    ends = list(zip(least, np.max([o.spends for o in tracing.optima], axis=0), strict=True))
    many = max(min(_GRID, int(_MOST_PLACES ** (1.0 / len(ends)))), 2)
    axes = (np.linspace(low, high, many) for low, high in ends)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(ends))
    apart = np.full(len(grid), np.inf)  # what was known when each place was last looked at
    looked = np.zeros(len(grid), dtype=np.int64)  # how many optima were known then
    is_kept, is_solved = np.ones(len(grid), dtype=np.bool_), np.zeros(len(grid), dtype=np.bool_)

    def look(place: int) -> None:
        """How far what is attained and what is proved lie apart at a place, with all optima."""
        bounds, optima = grid[place], tracing.optima
        looked[place], worth = len(optima), tracing.stated.sense.worth
        attained, _ = _best_lottery(optima, bounds, ratio=tracing.stated.ratio)
        if np.isfinite(attained):
            scale = max(abs(worth(value)) for value in (attained, *(o.value for o in optima)))
            apart[place] = (attained - tracing.lines.least(bounds)) / (scale or 1.0)

    with WithIncumbent():
        while tracing.limits.allows(len(tracing.optima)):
            place = int(np.argmax(np.where(is_kept & ~is_solved, apart, -1.0)))
            if apart[place] <= tracing.limits.gap or is_solved[place] or not is_kept[place]:
                break
            if looked[place] < len(tracing.optima):  # others may have closed it since
                look(place)
                continue
            is_solved[place] = True
            try:
                tracing.add(grid[place].tolist())
            except InfeasibleError:  # nor is it kept to where less is allowed
                is_kept &= (grid > grid[place]).any(axis=1)
    for place in np.flatnonzero(is_kept & (looked < len(tracing.optima))).tolist():
        look(place)
    sense = tracing.stated.sense
    return Surface(
        problem=problem,
        over=tracing.over,
        gap=max(float(apart[is_kept].max(initial=0.0)), 0.0),
        ratio=tracing.stated.ratio,
        maximises=sense.constant is not None,
        pricing_calls=tracing.calls,
        work=tracing.work,
        _optima=tuple(tracing.optima),
        _lines=tracing.lines,
        _sense=sense,
    )


def _best_lottery(
    optima: Sequence[_Optimum], bounds: FloatArray, *, ratio: bool
) -> tuple[float, FloatArray]:
    """The least that a lottery over optima within bounds attains, infinite for none; its weights.

    Args:
        optima: at any bounds.
        bounds: [limits].
        ratio: whether it is a cost given success (Charnes and Cooper: optima are weighed by the
            goal mass that they bring).
    """
    spent, (value, goal) = (
        np.array([o.spends for o in optima]),
        np.array([(o.value, o.goal) for o in optima]).T,
    )
    mass = goal if ratio else np.ones(len(optima))
    taken = (spent - bounds).T / mass  # of a unit of mass
    scales = np.maximum(np.abs(bounds), np.abs(spent).max(axis=0))
    scales = np.where(scales > 0.0, scales, 1.0)
    limits = np.zeros(len(bounds)), scales
    weights = solve_master(value, taken, *limits, elastic=True).weights
    if (taken @ weights > 1e-12 * scales).any():
        return np.inf, weights
    weights = solve_master(value, taken, *limits, elastic=False).weights
    attained = float(value @ weights)
    weights = weights / mass
    return attained, weights / weights.sum()


def _mixed_of(members: Sequence[MixedPolicy], weights: FloatArray) -> MixedPolicy:
    """The lottery over lotteries of which some are used."""
    used = [(member, w) for member, w in zip(members, weights.tolist(), strict=True) if w > 0.0]
    policies = tuple(policy for member, _ in used for policy in member.policies)
    return MixedPolicy(policies, np.concatenate([w * member.weights for member, w in used]))
