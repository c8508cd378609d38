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
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ssp_lp.analysis.evaluation import evaluate
from ssp_lp.arrays import MACHINE_EPSILON, RELATIVE_GAP, FloatArray
from ssp_lp.column_generation.column import FailureRow
from ssp_lp.compiled.deadline import Stop, WithIncumbent, interrupted, until
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import (
    Argument,
    InfeasibleError,
    ModelError,
    OutOfTimeError,
    did_you_mean,
)
from ssp_lp.methods.frontier import Frontier, TraceLimits, traced_over_failure
from ssp_lp.methods.rows import rows_optimum, true_figures
from ssp_lp.model.arguments import explained
from ssp_lp.options import SolveOptions, deadline_of, progress_shown
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem, Restated, check_problem, compiled_constrained
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
    asked = _traceable(problem.unrolled, over, limits)

    def traced() -> Frontier:
        """The frontier, traced over failure alone or over any limit."""
        if over == FAILURE_ROW and not asked.has_rows:
            return traced_over_failure(asked, limits)
        return _Tracing(asked, over, limits).traced()

    with progress_shown(verbose), until(deadline) as ended:
        try:
            frontier = traced()
        except Stop:
            if ended.is_interrupted:
                raise interrupted() from None
            told = f"the time limit ended before the least {over} was known: allow more time"
            raise OutOfTimeError(told) from None
    status = ended.status(np.inf if frontier.ends_early else frontier.gap, gap)
    return replace(frontier, _problem=problem, status=status)


def _traceable(problem: Problem, over: str, limits: TraceLimits) -> Problem:
    """The problem that is solved, once it is known that what is traced can be.

    Raises:
        ModelError: it cannot: nothing of this name is limited from above, or no program says so.
    """
    name, asked = type(problem).__name__, problem.requirements
    if over == FAILURE_ROW:
        if asked.aim is not Aim.LEAST_COST or problem.semantics.forbids_failing:
            raise ModelError(f"{name} has no failure budget to trace: trace MCMP's")
        if not asked.rows:
            return problem
    else:
        names = [condition.name for condition in problem.conditions]
        if over not in names:
            nearest = did_you_mean(over, [FAILURE_ROW, *names], "they are")
            raise wrong_argument("over", "be 'failure' or the name of a limit", over, nearest)
        if problem.conditions[names.index(over)].lower is not None:
            raise ModelError(f"limit {over!r} bounds from below: state what is to be little, such "
                             "as 1 - end_probability(...) <= 0.1, to trace it")  # fmt: skip
    if asked.is_risk:
        raise ModelError(f"{name} is no linear program: trace the limits of another criterion")
    if limits.steepest_price is not None:
        raise ModelError(Argument("steepest_price"), " goes with the failure budget alone")
    return problem


@dataclass(frozen=True, eq=False)
class _Optimum:
    """The optimum at a bound, in what is minimised: a point, and a line below all policies."""

    spent: float  # of what is traced
    value: float
    goal: float
    bound: float
    proved: float  # of every policy that keeps to it
    price: float  # of the bound in that proof; infinite: no word of larger bounds
    policy: MixedPolicy


@dataclass(frozen=True, eq=False)
class _Lines:
    """What the prices of all optima prove at any bound."""

    bounds: FloatArray  # [optima] of each
    value: FloatArray  # [optima] attained at it
    proved: FloatArray  # [optima] at it
    prices: FloatArray  # [optima]
    least_goal: float | None  # that all lotteries have; None: nothing is counted given success
    is_failure: bool  # whether the bound is a failure budget

    def least(self, bound: float) -> float:
        """No policy that keeps to a bound has less: the least over t of the greatest line."""
        longest, beyond = self._longest(bound), bound - self.bounds
        tells = (beyond <= 0.0) | np.isfinite(self.prices)
        saved = np.where(np.isfinite(self.prices), self.prices, 0.0) * beyond
        height, slope = self.value[tells], (self.proved - self.value - saved)[tells]
        up, down = slope >= 0.0, slope < 0.0
        first = _rounded_down(height[up], slope[up], 1.0)
        last = _rounded_down(height[down], slope[down], longest)
        rise, turn = height[up][:, None], slope[up][:, None]
        t = (rise - height[down]) / (slope[down] - turn)
        crossing = _rounded_down(rise, turn, t)[(t >= 1.0) & (t <= longest)]
        return float(np.concatenate([[0.0], first, last, crossing]).max())

    def _longest(self, bound: float) -> float:
        """The greatest that 1 / goal may be."""
        if self.least_goal is None:
            return 1.0
        goal = max(self.least_goal, 1.0 - bound if self.is_failure else 0.0)
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
        least = 0.0 if self._lines is None else self._lines.least(budget)
        if self.maximises:
            return attained, max(worth(least), attained)
        return min(worth(least), attained), attained

    def _lottery(self, number: int, weights: FloatArray) -> MixedPolicy:
        """The lottery over the lotteries of turning points from one on."""
        return _mixed_of(self._members[number : number + len(weights)], weights)


class _Tracing:
    """Optima at bounds of one limit, the others held. Grows."""

    def __init__(self, problem: Problem, over: str, limits: TraceLimits) -> None:
        """Nothing is solved yet."""
        self.problem, self.over, self.limits = problem, over, limits
        self.calls, self.work = 0, Work()
        self.stated = compiled_constrained(problem)
        if over == FAILURE_ROW:  # whatever was allowed, even if that was the least
            self.stated = replace(self.stated, budget=1.0)
        self.truth = true_figures(problem, self.stated)
        self.options = SolveOptions(_FINER * limits.gap)
        self.optima: list[_Optimum] = []

    def add_at_least(self) -> bool:
        """Solve at the least that can be spent, or near it; whether that is where it began.

        Near it, where only policies spend the least that do not count: they never succeed.
        """
        least, free = self.least(), self.optima[0].spent
        if least >= free:
            return True
        for share in (0.0, *_NEAR):
            with suppress(InfeasibleError):
                self.add(least + share * (free - least))
                return share == 0.0
        return False

    def traced(self) -> Frontier:
        """The frontier.

        Raises:
            InfeasibleError: the other limits cannot be kept.
            Stop: the time ended before both ends were known.
        """
        _ = self.stated.pricing()  # for all bounds
        self.add(1.0 if self.over == FAILURE_ROW else np.inf)
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
                self.add(bound)
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
            np.array(each) for each in zip(*((o.bound, o.price) for o in self.optima), strict=True)
        )
        value, proved = np.array([(o.value, o.proved) for o in self.optima]).T
        goal = self.stated.least_goal if self.stated.ratio else None
        return _Lines(bounds, value, proved, prices, goal, self.over == FAILURE_ROW)

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
            (self._mixed(p, q, b) - lines.least(b), k)
            for k, share in enumerate(shares)
            for b in [p.spent + share * width]
        ]
        most, k = max(apart)
        split = 0.5 if shares[k] == _NARROW else shares[k]
        return most / self._scale(p, q), p.spent + split * width

    def least(self) -> float:
        """The least that can be spent of what is traced, the other limits held."""
        problem, name = self.problem, self.over
        semantics = replace(problem.semantics, aim=Aim.LEAST_COST, measure=None)
        conditions, objective = problem.conditions, None
        held = tuple(each for each in conditions if each.name != name)
        budget = 1.0 if name == FAILURE_ROW else problem.failure_budget
        if name == FAILURE_ROW:
            semantics = replace(semantics, aim=Aim.GREATEST_GOAL)
        else:
            objective = next(condition for condition in conditions if condition.name == name)
        asked = problem.model, problem.start, False, budget, semantics, held, problem.discount
        safest = compiled_constrained(Restated(*asked, objective))
        least = safest.sense.worth(rows_optimum(safest, self.options).value)
        return 1.0 - least if name == FAILURE_ROW else least

    def add(self, bound: float) -> None:
        """Solve at a bound of what is traced."""
        stated = self.stated
        budget = bound if self.over == FAILURE_ROW else stated.budget
        side = tuple(
            replace(row, bound=row.activity(bound)) if row.name == self.over else row
            for row in stated.side
        )
        found = rows_optimum(stated.bounded(budget, side), self.options, self.truth)
        at_least = found.compiled.budget is None, stated.budget is None
        if found.compiled.layers > stated.layers and at_least[0] == at_least[1]:
            self.stated = found.compiled.bounded(stated.budget, stated.side)  # begun there next
        evaluation = evaluate(found.policy, self.problem)
        failure = evaluation.limited_failure
        spent = {**evaluation.secondary_costs, FAILURE_ROW: failure}[self.over]
        tells = np.isfinite(bound) and found.bound > 0.0
        self.optima.append(_Optimum(
            spent=min(spent, bound), value=found.value, goal=1.0 - failure,
            bound=bound if np.isfinite(bound) else spent, proved=found.bound,
            price=found.prices.get(self.over, np.inf) if tells else 0.0, policy=found.policy,
        ))  # fmt: skip
        self.calls, self.work = self.calls + found.calls, self.work + found.work
        points = len(self.optima)
        _LOG.debug("%d pricing calls, %d bounds of %s", self.calls, points, self.over)
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
            "%d turning points over %s, gap %.1e", len(turning), self.over, max(below, default=0)
        )
        return LimitFrontier(
            spent=spent, goal=goal, cost=cost,
            price=np.abs(np.diff(objective) / np.diff(spent)),
            below=np.maximum(np.array(below), 0.0),
            tolerance=self.limits.gap,
            hidden=max(0.0, *own), ratio=self.stated.ratio, complete=True,
            pricing_calls=self.calls, work=self.work,
            _pricing=self.stated.pricing(), _columns=(),
            over=self.over, maximises=sense.constant is not None,
            _lines=lines, _members=tuple(o.policy for o in turning), _sense=sense,
        )  # fmt: skip


def _mixed_of(members: Sequence[MixedPolicy], weights: FloatArray) -> MixedPolicy:
    """The lottery over lotteries of which some are used."""
    used = [(member, w) for member, w in zip(members, weights.tolist(), strict=True) if w > 0.0]
    policies = tuple(policy for member, _ in used for policy in member.policies)
    return MixedPolicy(policies, np.concatenate([w * member.weights for member, w in used]))
