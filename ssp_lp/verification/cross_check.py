"""Cross-checks: a problem solved by the linear program, column generation and the paper's game.

The methods read the model by the same code: dead-ends, attention states, charges of failing and
states where wandering is free. ``ssp_lp.verification.expand`` recomputes all of these in fractions.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import combinations, permutations
from math import inf, isnan
from typing import Any

import numpy as np

from ssp_lp.analysis.evaluation import evaluate_each
from ssp_lp.arrays import LEAST_BUDGET, FloatArray
from ssp_lp.errors import InfeasibleError, ModelError, SolverError, SSPError, check_between_0_and_1
from ssp_lp.methods.approaches import refusal
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import drain, hopeless_states
from ssp_lp.model.report import Report, Table
from ssp_lp.options import LinearProgramming, parse_method, progress_shown
from ssp_lp.problem import Problem, check_problem
from ssp_lp.processes.failure_semantics import dead_end_charges, give_up_charges
from ssp_lp.processes.live_rows import costless_pairs
from ssp_lp.solution import Solution
from ssp_lp.solving import solve
from ssp_lp.verification.certificate_file import Statement, program_of

METHODS = ("lp", "columns", "game")

MOST_COLUMNS = 60_000
"""Most columns of a program that is solved by default. The paper's robot has 24,000 columns in case
M, which an interior point solves in seconds, and one to two million in case S, many minutes."""


@dataclass(frozen=True, eq=False)
class MethodResult:
    """Result of one method in a cross-check: an answer, or a note that says why there is none."""

    name: str
    answer: Solution | None = None
    note: str = ""
    error: SSPError | None = None  # the error in which the method ended
    seconds: float | None = None

    @property
    def objective(self) -> float | None:
        """The optimum c*; None without an answer."""
        return None if self.answer is None else self.answer.objective

    @cached_property
    def members(self) -> FloatArray:
        """Weight, J_obj and J_cond of each policy of the lottery, [members, 3].

        In the paper's notation J_obj is the expected cost (in case S of successful runs only), and
        J_cond is the failure that the budget limits.
        """
        if (one := self.answer) is None:
            return np.zeros((0, 3))
        each = evaluate_each(one.policy, one.problem)[1]
        failures = np.array([member.limited_failure for member in each])
        costs = np.array([member.objective for member in each])
        if one.problem.ratio:  # J_obj is E[cost; goal]
            costs = np.where(failures < 1.0, costs, 0.0) * (1.0 - failures)
        return np.column_stack([one.policy.weights, costs, failures])

    def row(self) -> tuple[str | float | None, ...]:
        """Return the values of this method's row in the table of :class:`CrossCheck`."""
        if (one := self.answer) is None:
            return (self.name, *[None] * (len(_COLUMNS) - 2), self.seconds)
        return (self.name, one.objective, one.lower_bound, one.gap, one.adversary_weight,
                one.failure_price, one.failure_probability, one.discounted_failure,
                one.expected_cost, one.conditional_cost, self.seconds)  # fmt: skip


def result_of(name: str, solution: Solution) -> MethodResult:
    """Return a solution as a result of the cross-check, with the notes on how it was found."""
    note = "; ".join(part for part in (solution.note, solution.run.program) if part)
    return MethodResult(name, solution, note, seconds=solution.seconds)


def result_by(
    name: str, problem: Problem, lp_backend: str | None = None, time_limit: float | None = None
) -> MethodResult:
    """Solve a problem by one method, or note why the method cannot solve it.

    Args:
        name: "lp", "columns" or "game".
        problem: the problem.
        lp_backend: the solver of the linear program, which is then solved whatever its size; None:
            chosen by size.
        time_limit: seconds for this method.
    """
    method = parse_method(name)
    reason = str(refusal(problem, method) or "")
    if name == LinearProgramming.name:
        method = LinearProgramming(lp_backend)
        if problem.failure_budget is None:
            reason = "least failure is solved by column generation in two stages only"
        elif lp_backend is None:
            columns = problem.compile().for_program().n_columns
            if columns > MOST_COLUMNS:
                reason = f"{columns:,} columns are too many: give lp_backend to solve it"
    if reason:
        return MethodResult(name, note=f"not run: {reason}")
    began = time.perf_counter()
    try:
        result = result_of(name, solve(problem, method, time_limit=time_limit))
    except InfeasibleError as error:
        result = MethodResult(name, note=f"infeasible: {error}", error=error)
    except (SolverError, ModelError) as error:
        if isinstance(error, ModelError) and name != "game":
            raise  # the model is at fault, not the size of this method's table
        result = MethodResult(name, note=f"failed: {error}", error=error)
    return replace(result, seconds=time.perf_counter() - began)


_NOTHING = 1e-12
"""Costs are compared relative to their size, but at least to this share of the greatest step cost:
below it lies the rounding of sums of such costs."""

_EDGE = 1e-9
"""Distance of a budget from the least failure within which methods may differ on feasibility."""

MOST_OUTCOMES = 1_000_000
"""Most outcomes of a model that is read a second time, at some ten microseconds each."""

_SAME = 1e-9  # relative distance of two charges: the library's is a sum of rounded terms

_LOG = logging.getLogger("ssp_lp.comparison")

_COLUMNS = (
    "method", "objective", "bound", "gap", "alpha", "price", "failure", "discounted", "cost",
    "given_success", "seconds",
)  # fmt: skip
_DIGITS = {"objective": 10, "bound": 10, "gap": 2, "seconds": 2}


@dataclass(frozen=True)
class SecondReading:
    """Comparison of two readings of a model by independent code.

    It has the numbers of dead-ends and of other kinds of states, and the differences that were
    found.
    """

    dead_ends: int
    giving_up: int  # states in which a policy may give up
    free: int  # states in which wandering costs nothing
    faults: tuple[str, ...]  # a sentence for each difference

    def __str__(self) -> str:
        """Return the second reading as one line."""
        counts = f"{self.dead_ends:,} dead-ends, {self.giving_up:,} states to give up in"
        return f"read twice: {counts}, {self.free:,} where wandering is free"


@dataclass(frozen=True, repr=False)
class CrossCheck(Report):
    """Results of all methods, and their disagreements.

    A method is named in ``disagreeing`` if

    - its c* lies outside the tolerance of the majority (all are named if no two methods agree),
    - its policy breaks the budget, or evaluates to another objective than stated,
    - its lower bound exceeds the value that another method's policy attains, or
    - it calls the problem infeasible and another method solves it.

    At a kink of the frontier the price is an interval: different prices are no disagreement if each
    is proved by its bound.
    """

    methods: tuple[MethodResult, ...]
    objective_distance: float  # largest relative distance between two c*
    weight_distance: float  # largest distance between two alpha*
    evaluated_distance: float  # largest relative distance between two policies' exact objectives
    budget_overrun: float  # greatest excess of a policy's failure over the budget; 0 if none
    disagreeing: tuple[str, ...]  # names of methods
    remarks: tuple[str, ...]  # a sentence for each finding
    reading: SecondReading | None = None  # second reading of the model

    @property
    def agrees(self) -> bool:
        """Whether all answers agree, and the second reading of the model is the same."""
        return not self.disagreeing and not (self.reading and self.reading.faults)

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the methods that ran and gave no answer."""
        return tuple(method.name for method in self.methods if method.error is not None)

    def __repr__(self) -> str:
        """Return the methods and the verdict in one line."""
        names = ", ".join(method.name for method in self.methods)
        return f"CrossCheck({names}: {self._verdict()})"

    def tables(self) -> list[Table]:
        """Return one table, a row for each method, with policies, remarks and verdict as notes."""
        notes = []
        for one in self.methods:
            if one.answer is not None:
                lottery = (f"{w:.6f} x ({c:.9g}, {f:.6g})" for w, c, f in one.members)
                notes.append(f"{one.name}: {' + '.join(lottery)}")
        notes += [f"{one.name}: {one.note}" for one in self.methods if one.note]
        notes += self.remarks
        if self.reading is not None:
            notes += map(str, (self.reading, *self.reading.faults))
        rows = [one.row() for one in self.methods]
        return [Table(rows, _COLUMNS, "", [*notes, self._verdict()], _DIGITS)]

    def _verdict(self) -> str:
        """Return the verdict in one line."""
        count = sum(method.answer is not None for method in self.methods)
        distances = (
            f"c* within {self.objective_distance:.1e}, alpha* within {self.weight_distance:.1e}, "
            f"policies within {self.evaluated_distance:.1e}, budget overrun "
            f"{self.budget_overrun:.1e}"
        )
        if self.reading is not None and self.reading.faults:
            return f"THE MODEL IS MISREAD: {self.reading.faults[0]}"
        if self.disagreeing:
            return f"DISAGREEMENT of {', '.join(self.disagreeing)}: {distances}"
        if count < 2:
            return "nothing to compare: fewer than two answers"
        return f"{count} methods agree: {distances}"


@explained
def cross_check(
    problem: Problem,
    *,
    tolerance: float = 1e-6,
    weight_tolerance: float = 1e-4,
    lp_backend: str | None = None,
    time_limit: float | None = None,
    verbose: bool = False,
) -> CrossCheck:
    """Cross-check a problem: solve it by every method, and compare the results.

    All methods read the model by the same code. The plain loops of the certificates' checker read
    the model a second time, and both readings are compared (:class:`SecondReading`).

    Args:
        problem: a formulation, such as ``MCMP(...)`` or ``S3P(...)``.
        tolerance: relative distance of costs that still counts as agreement.
        weight_tolerance: distance of two alpha* above which the prices must be proved.
        lp_backend: the solver of the linear program, see ``solve``. If it is given, the program is
            solved whatever its size.
        time_limit: seconds for each method.
        verbose: whether to show the progress (``ssp_lp.progress_shown``).

    Returns:
        The results of all methods. A method that cannot solve the problem has a note: the game
        needs a discount and a budget above 0, least failure has one method only, and a program
        may be too large to solve by default.

    Raises:
        ModelError: a wrong argument, or a problem with a risk measure or with limits, which the
            game does not support.
        InfeasibleError: every method finds that no policy satisfies the budget.
    """
    check_problem(problem, "cross_check")
    check_between_0_and_1("tolerance", tolerance)
    check_between_0_and_1("weight_tolerance", weight_tolerance)
    if problem.semantics.counts_law or problem.several_rows:
        raise ModelError(
            "cross_check supports expected costs with a failure budget alone, not this "
            f"{type(problem).__name__}: solve it with method='lp' and with method='columns', and "
            "compare"
        )
    methods = []
    with progress_shown(verbose):
        for number, name in enumerate(METHODS, start=1):
            methods.append(result_by(name, problem, lp_backend, time_limit))
            answer = methods[-1].note or f"c* {methods[-1].objective:.9g}"
            _LOG.info("%d of %d: %s, %s", number, len(METHODS), name, answer)
        for method in methods:
            if isinstance(method.error, InfeasibleError) and not any(r.answer for r in methods):
                raise method.error
        comparison = compare_methods(
            methods, problem, tolerance=tolerance, weight_tolerance=weight_tolerance
        )
        with suppress(ModelError):  # certificate files do not cover the criterion
            comparison = replace(comparison, reading=second_reading(problem))
        _LOG.info("%r", comparison)
    return comparison


def compare_methods(
    methods: Sequence[MethodResult],
    problem: Problem,
    *,
    tolerance: float = 1e-6,
    weight_tolerance: float = 1e-4,
) -> CrossCheck:
    """Compare the results of several methods for one problem.

    A policy may exceed the budget by up to LEAST_BUDGET: if the budget is below the least failure
    by no more than this, every method treats the two as equal.

    Args:
        methods: the results.
        problem: the problem.
        tolerance: relative distance of costs that still counts as agreement.
        weight_tolerance: distance of two alpha* above which the prices must be proved.
    """
    smallest = _NOTHING * float(problem.model.costs.max(initial=0.0))
    budget = 1.0 if problem.failure_budget is None else problem.failure_budget
    answers = {one.name: one.answer for one in methods if one.answer is not None}

    def distance(one: float, other: float) -> float:
        if isnan(one) or isnan(other):
            return inf
        return 0.0 if one == other else abs(one - other) / max(abs(one), abs(other), smallest)

    def agree(one: float, other: float) -> bool:
        return distance(one, other) <= tolerance

    findings, overrun = dict[str, str](), 0.0  # method -> objection
    for name, answer in answers.items():  # errors that need no second method
        stated, attained = answer.objective, answer.evaluation.objective
        if (spent := answer.evaluation.limited_failure) > budget + LEAST_BUDGET:
            overrun = max(overrun, spent - budget)
            findings[name] = f"its policy breaks the budget by {spent - budget:.1e}"
        elif not agree(stated, attained):
            findings[name] = f"it states c* = {stated:.12g}, but its policy attains {attained:.12g}"
    sound = {name: answer for name, answer in answers.items() if name not in findings}
    proved = {name: one for name, one in sound.items() if agree(one.objective, one.lower_bound)}
    if _spread(sound.values()) > weight_tolerance:
        for name in sound.keys() - proved.keys():
            missed = f"the bound misses c* by {sound[name].gap:.1e}"
            findings[name] = f"its price is not proved: {missed}"
    if answers:
        findings |= _infeasibility_objections(methods, budget)
    findings |= _mutual_objections(sound, agree)
    named = tuple(method.name for method in methods if method.name in findings)
    remarks = [f"{name}: {findings[name]}" for name in named]
    if _spread(proved.values()) > weight_tolerance:
        remarks.append("several prices are optimal")  # at a kink they form an interval

    def widest(costs: Iterable[float]) -> float:
        """Return the largest distance between two costs."""
        return max((distance(*both) for both in combinations(costs, 2)), default=0.0)

    return CrossCheck(
        methods=tuple(methods),
        objective_distance=widest(one.objective for one in answers.values()),
        weight_distance=_spread(answers.values()),
        evaluated_distance=widest(one.evaluation.objective for one in answers.values()),
        budget_overrun=overrun,
        disagreeing=named,
        remarks=tuple(remarks),
    )


def _spread(solutions: Iterable[Solution]) -> float:
    """Return the largest distance between two solutions' alpha*."""
    weights = [w for one in solutions if (w := one.adversary_weight) is not None]
    return max(weights) - min(weights) if weights else 0.0


def _infeasibility_objections(methods: Sequence[MethodResult], budget: float) -> dict[str, str]:
    """Return objections to methods that call a problem infeasible that another method has solved.

    The keys are the names of the methods.
    """
    findings = {}
    for method in methods:
        if isinstance(error := method.error, InfeasibleError):
            lowest = error.least_discounted_failure
            lowest = error.least_failure if lowest is None else lowest
            if lowest is not None and lowest - budget > _EDGE:
                findings[method.name] = f"it says that no policy fails less than {lowest:.12g}"
    return findings


def _mutual_objections(
    answers: Mapping[str, Solution], agree: Callable[[float, float], bool]
) -> dict[str, str]:
    """Return objections to methods whose results contradict those of others, by name of the method.

    A method's objective may differ from that of the majority. Or its lower bound may exceed the
    value of another method's policy.

    Args:
        answers: solution of each method that has one, by name.
        agree: whether two costs are equal within the tolerance.
    """
    findings = dict[str, str]()
    costs = {name: answer.objective for name, answer in answers.items()}
    near = [[name for name, cost in costs.items() if agree(own, cost)] for own in costs.values()]
    majority = max(near, key=len, default=[])
    if len(majority) == 1 < len(costs):
        findings = dict.fromkeys(costs, "no other method finds its c*")
    elif len(majority) < len(costs):
        reason = f"its c* differs from that of {', '.join(sorted(majority))}"
        findings = dict.fromkeys(costs.keys() - set(majority), reason)
    for name, other in permutations(answers, 2):
        low, value = answers[name].lower_bound, answers[other].evaluation.objective
        if low > value and not agree(low, value):
            findings[name] = (
                f"its lower bound {low:.12g} exceeds the {value:.12g} that the policy of {other} "
                "attains: one of the two is wrong"
            )
    return findings


def second_reading(problem: Problem) -> SecondReading | None:
    """Read a problem's model by the certificates' checker, and compare with the library's reading.

    The result is None if the model is too large.

    Raises:
        ModelError: certificate files do not cover the criterion.
    """
    problem = problem.unrolled
    model, semantics = problem.model, problem.semantics
    if model.n_outcomes > MOST_OUTCOMES:
        return None
    statement, total = Statement(problem), {"constant": "0", "terms": [["1", "cost", 0]]}
    always: dict[str, Any] = {"failure": (Fraction(1), Fraction(1)), "discount": None, "rows": []}
    asked = {**statement.question, **always, "objective": total, "charge": [], "greatest": False}
    apart = program_of(asked, statement)
    dead, nobody = hopeless_states(model), np.zeros(model.n_states, dtype=np.bool_)
    entering = dead_end_charges(model, dead, semantics)
    stopping = give_up_charges(model, nobody, semantics)
    may_stop = np.isfinite(stopping) & ~dead & ~model.goal_mask
    waits = costless_pairs(model) & ~dead[model.pair_state]  # for ever, or until it can leave
    left = np.bincount(model.pair_state[waits], minlength=model.n_states)
    drain(model, waits, left, np.flatnonzero(left == 0))
    faults: list[str] = []
    kinds = {
        "a dead-end": (dead, apart.dead),
        "a state to give up in": (may_stop, apart.giving_up),
        "a state where wandering is free": (left > 0, apart.waiting),
    }
    for part, (ours, theirs) in kinds.items():
        for x in sorted(theirs.symmetric_difference(np.flatnonzero(ours).tolist()))[:1]:
            where, word = repr(model.states[x]), "is" if ours[x] else "is not"
            faults.append(f"{where} {word} {part}, the second reading says otherwise")
    charged = np.where(dead, entering, np.where(may_stop, stopping, 0.0))
    for x in sorted(apart.dead | apart.giving_up):
        own, other = charged[x], float(apart.charges.get(x, [Fraction(0)])[0])
        if abs(own - other) > _SAME * max(abs(own), abs(other)):
            faults.append(f"failing in {model.states[x]!r} charges {own:.12g}, by the second "
                          f"reading {other:.12g}")  # fmt: skip
            break
    dead_ends, giving_up, free = (int(ours.sum()) for ours, _ in kinds.values())
    return SecondReading(dead_ends, giving_up, free, tuple(faults))
