"""The agreement of the methods: the linear program, column generation and the paper's game."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

from ssp_lp.errors import ModelError, check_between_0_and_1
from ssp_lp.model.html_table import html_text
from ssp_lp.options import progress_shown
from ssp_lp.problem import Problem, by_rows, check_problem
from ssp_lp.verification.method_comparison import MethodComparison
from ssp_lp.verification.method_result import METHODS, Member, MethodResult, result_by

_LOG = logging.getLogger("ssp_lp.comparison")

_DIGITS = {"c*": 10, "lower bound": 10, "gap": 2, "seconds": 2}
"""Significant digits of a column, where they are not six."""


@dataclass(frozen=True, repr=False)
class CrossCheck:
    """The methods side by side, and what they disagree about.

    A method is named in ``disagreeing`` where its c* lies outside the tolerance of the majority
    (where no two methods agree, all are named), where its policy breaks the budget or evaluates to
    another objective than stated, where its lower bound exceeds what another method's policy
    attains, or where it alone calls the problem infeasible. At a kink of the frontier the price is
    an interval: different prices are no disagreement as long as each is proved by its bound.
    """

    methods: tuple[MethodResult, ...]
    objective_distance: float  # largest relative distance between two c*
    weight_distance: float  # largest distance between two alpha*
    evaluated_distance: float  # largest relative distance between two policies' exact objectives
    budget_overrun: float  # by which the worst policy breaks the budget; 0 if none does
    disagreeing: tuple[str, ...]  # names of methods
    remarks: tuple[str, ...]  # a sentence for each thing that was noticed

    @property
    def agrees(self) -> bool:
        """Whether no method that answered disagrees."""
        return not self.disagreeing

    @property
    def failed(self) -> tuple[str, ...]:
        """The methods that were asked and gave no answer."""
        return tuple(method.name for method in self.methods if method.failed)

    def __repr__(self) -> str:
        """One line: the methods and the verdict."""
        names = ", ".join(method.name for method in self.methods)
        return f"CrossCheck({names}: {self._verdict()})"

    def __str__(self) -> str:
        """The table."""
        return self.summary()

    def _repr_html_(self) -> str:
        """The table, for notebooks."""
        return html_text(self.summary())

    def summary(self) -> str:
        """The methods as a table, their policies, the remarks, and one line with the verdict."""
        lines = _cross_check_table(self.methods)
        lines += [f"  {r.name}: {_lottery_in_table(r.members)}" for r in self.methods if r.members]
        lines += [f"  {r.name}: {r.note}" for r in self.methods if r.note]
        lines += [f"  {remark}" for remark in self.remarks]
        return "\n".join([*lines, self._verdict()])

    def _verdict(self) -> str:
        """The verdict on methods that were checked against each other."""
        count = sum(method.answered for method in self.methods)
        distances = (
            f"c* within {self.objective_distance:.1e}, alpha* within {self.weight_distance:.1e}, "
            f"policies within {self.evaluated_distance:.1e}, budget overrun "
            f"{self.budget_overrun:.1e}"
        )
        if self.disagreeing:
            return f"DISAGREEMENT of {', '.join(self.disagreeing)}: {distances}"
        if count < 2:
            return "nothing to compare: one method answered"
        return f"{count} methods agree: {distances}"


def cross_check(
    problem: Problem,
    *,
    tolerance: float = 1e-6,
    weight_tolerance: float = 1e-4,
    lp_backend: str | None = None,
    time_limit: float | None = None,
    verbose: bool = False,
) -> CrossCheck:
    """Solve a problem on every method there is, and compare.

    Args:
        problem: a formulation, such as ``MCMP(...)`` or ``S3P(...)``.
        tolerance: relative distance of costs that still counts as agreement.
        weight_tolerance: distance of two alpha* beyond which their prices are looked at.
        lp_backend: the solver of the linear program, see ``solve``; given one, a program of any
            size is solved.
        time_limit: seconds for each method.
        verbose: show how far it has come (``ssp_lp.progress_shown``).

    Returns:
        The methods side by side. One that cannot be asked stays as a row with a note: the game
        needs a discount and a budget above 0, least failure has one method only, and a program may
        be too large to solve from nothing.

    Raises:
        ModelError: a wrong argument, or a problem with a measure or with limits, which the game
            does not know.
        InfeasibleError: every method says that no policy keeps to the budget.
    """
    check_problem(problem, "cross_check")
    check_between_0_and_1("tolerance", tolerance)
    check_between_0_and_1("weight_tolerance", weight_tolerance)
    if problem.semantics.measure is not None:
        raise ModelError(
            f"the game knows costs only, not {type(problem).__name__}: method='lp' compares the "
            "linear program with column generation"
        )
    if by_rows(problem):
        raise ModelError(
            f"the comparison knows one row only, not {type(problem).__name__}: method='lp' "
            "compares the linear program with column generation"
        )
    methods = []
    with progress_shown(verbose):
        for number, name in enumerate(METHODS, start=1):
            methods.append(result_by(name, problem, lp_backend, time_limit))
            told = methods[-1].note or f"c* {methods[-1].objective:.9g}"
            _LOG.info("%d of %d: %s, %s", number, len(METHODS), name, told)
        for method in methods:
            if method.infeasible is not None and not any(r.answered for r in methods):
                raise method.infeasible
        found = compare_methods(
            methods, problem, tolerance=tolerance, weight_tolerance=weight_tolerance
        )
        _LOG.info("%r", found)
    return found


def compare_methods(
    methods: Sequence[MethodResult],
    problem: Problem,
    *,
    tolerance: float = 1e-6,
    weight_tolerance: float = 1e-4,
) -> CrossCheck:
    """Cross-check the methods' rows of one problem, wherever they come from."""
    costliest = float(problem.model.costs.max(initial=0.0))
    comparison = MethodComparison(problem.failure_budget, costliest, tolerance, weight_tolerance)
    answered = [method for method in methods if method.answered]
    unsound = comparison.unsound(answered)
    sound = [method for method in answered if method.name not in unsound]
    findings = unsound | comparison.unproved(sound) | comparison.refusing(methods)
    findings |= comparison.outvoted(sound) | comparison.refuted(sound)
    named = tuple(method.name for method in methods if method.name in findings)
    costs = [r.objective for r in answered if r.objective is not None]
    exact = [r.evaluated for r in answered if r.evaluated is not None]
    weights = [r.adversary_weight for r in answered if r.adversary_weight is not None]
    return CrossCheck(
        methods=tuple(methods),
        objective_distance=_widest_between_methods(costs, comparison.distance),
        weight_distance=_widest_between_methods(weights, lambda one, other: abs(one - other)),
        evaluated_distance=_widest_between_methods(exact, comparison.distance),
        budget_overrun=max((comparison.overrun(r) for r in answered), default=0.0),
        disagreeing=named,
        remarks=(*(f"{n}: {findings[n]}" for n in named), *comparison.several_prices(sound)),
    )


def _widest_between_methods(
    values: Sequence[float], distance: Callable[[float, float], float]
) -> float:
    """The widest distance between answers of two methods."""
    return max((distance(one, other) for one, other in combinations(values, 2)), default=0.0)


def _lottery_in_table(members: Sequence[Member]) -> str:
    """A policy by its members: weight x (cost, failure)."""
    return " + ".join(f"{m.weight:.6f} x ({m.cost:.9g}, {m.failure:.6g})" for m in members)


def _cross_check_table(methods: Sequence[MethodResult]) -> list[str]:
    """One line per method, aligned; policies follow below as weight x (cost, failure)."""
    columns: dict[str, Callable[[MethodResult], float | None]] = {
        "c*": lambda r: r.objective,
        "lower bound": lambda r: r.lower_bound,
        "gap": lambda r: r.gap,
        "alpha*": lambda r: r.adversary_weight,
        "price": lambda r: r.failure_price,
        "failure": lambda r: r.failure_probability,
        "discounted": lambda r: r.discounted_failure,
        "cost": lambda r: r.expected_cost,
        "given success": lambda r: r.conditional_cost,
        "seconds": lambda r: r.seconds,
    }
    rows = [["method", *columns]]
    for method in methods:
        rows.append(
            [
                method.name,
                *(_cross_check_text(name, value(method)) for name, value in columns.items()),
            ]
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows
    ]


def _cross_check_text(name: str, value: float | None) -> str:
    """A number as its column shows it; a dash where there is none."""
    if value is None:
        return "-"
    return f"{value:.{_DIGITS.get(name, 6)}g}"
