"""The criteria side by side: the same question asked in every way that the literature asks it."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from ssp_lp import SSP, InfeasibleError, Solution, progress_shown, solve
from ssp_lp.errors import did_you_mean
from ssp_lp.formulation import CostLimit, Problem
from ssp_lp.model.arguments import explained
from ssp_lp.model.report import Report, Table
from ssp_lp.problem import as_stated

from .alpha_mcmp import AlphaMCMP
from .constrained_cost import ConstrainedCost
from .cost_bounded_reach import CostBoundedReach
from .cost_quantile import CostQuantile
from .cvar import CVaR
from .egubs import EGUBS
from .finite_penalty import FinitePenalty
from .isspude import ISSPUDE
from .maxprob import MaxProb
from .mcmp import MCMP
from .min_cost import MinCost
from .minprob import MinProb
from .s3p import S3P

_HEAD = "criterion", "objective", "cost", "given_success", "failure", "price", "note"
_LOG = logging.getLogger("ssp_lp.comparison")


@dataclass(frozen=True)
class CriterionRow:
    """One criterion's optimum in the comparison; without a solution only the note says why."""

    criterion: str  # the formulation and what was asked of it
    solution: Solution | None
    note: str = ""

    @property
    def numbers(self) -> tuple[float | None, ...]:
        """A compared criterion's numbers: objective, costs, failure probability and price.

        Each under the criterion's own semantics: by default ``MCMP`` and ``ConstrainedCost`` charge
        the failing step, the others do not, so that the same policy may cost less in their rows.
        ``FinitePenalty`` and ``AlphaMCMP`` let a policy give up anywhere.
        """
        solution = self.solution
        if solution is None:
            return (None,) * 5
        return (
            solution.objective,
            solution.expected_cost,
            solution.conditional_cost if solution.goal_probability > 0.0 else None,
            solution.failure_probability,
            solution.failure_price,
        )


@dataclass(frozen=True, repr=False)
class CriteriaComparison(Report):
    """One row per criterion, in the order in which they were asked."""

    rows: tuple[CriterionRow, ...]

    def __getitem__(self, criterion: str) -> CriterionRow:
        """The row of a criterion by its name.

        Raises:
            KeyError: no row has this name.
        """
        for row in self.rows:
            if row.criterion == criterion:
                return row
        nearest = did_you_mean(criterion, [row.criterion for row in self.rows], "there are")
        raise KeyError(f"{criterion!r} is no row{nearest}")

    def __repr__(self) -> str:
        """One line: how many criteria there are; :meth:`summary` is the table."""
        unmet = sum(row.solution is None for row in self.rows)
        infeasible = f", {unmet} that no policy meets" if unmet else ""
        return f"CriteriaComparison({len(self.rows)} criteria{infeasible})"

    def tables(self) -> list[Table]:
        """One table with a row for each criterion; those without numbers say why."""
        rows = [(row.criterion, *row.numbers, row.note) for row in self.rows]
        notes = [f"{row.criterion}: {row.note}" for row in self.rows if row.note]
        return [Table(rows, _HEAD, notes=notes, hidden={"note"})]


@explained
def compare_criteria(
    model: SSP,
    start: Hashable | Mapping[Hashable, float],
    *,
    failure_budgets: Sequence[float] = (0.05,),
    penalties: Sequence[float] = (10.0, 100.0),
    reach_fractions: Sequence[float] = (0.9,),
    cost_bounds: Sequence[float | Fraction] = (),
    levels: Sequence[float] = (),
    exponential_utilities: Sequence[tuple[float, float]] = (),
    limits: Mapping[str, CostLimit] | None = None,
    horizon: int | None = None,
    verbose: bool = False,
) -> CriteriaComparison:
    """Solve a model under every criterion and put the answers side by side.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        failure_budgets: budgets of ``MCMP`` and ``S3P``, besides least failure.
        penalties: penalties D of ``FinitePenalty``, in units of cost.
        reach_fractions: shares of the greatest goal probability asked of ``AlphaMCMP``.
        cost_bounds: bounds of ``CostBoundedReach``, without and within each budget.
        levels: levels of ``CostQuantile`` and ``CVaR``, at least failure and within each budget.
        exponential_utilities: (risk factor, goal bonus) of ``EGUBS``.
        limits: of ``ConstrainedCost``, at least failure and within each budget.
        horizon: of every criterion: the goal counts only within so many steps.
        verbose: show how far it has come (``ssp_lp.progress_shown``).

    Returns:
        One row per criterion. One that no policy meets stays as a row with the reason.

    Raises:
        ModelError: an unknown start, or an argument out of range.

    Example:
        >>> from ssp_lp import SSP
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> print(compare_criteria(model, "road", penalties=(10.0,)).summary())
        criterion                      objective  cost  given_success  failure    price
        MaxProb                                1     3              3        0        -
        MinProb                              0.9     1              1      0.1        -
        MinCost                                3     3              3        0      inf
        MCMP, least failure                    3     3              3        0        -
        S3P, least failure                     3     3              3        0        -
        ISSPUDE                                3     3              3        0        -
        MCMP, failure budget 0.05              2     2        2.05263     0.05       20
        S3P, failure budget 0.05         2.05263     2        2.05263     0.05  18.9474
        AlphaMCMP, reach fraction 0.9          1     1              1      0.1  1.11111
        FinitePenalty, penalty 10              2     1              1      0.1       10
    """
    problems = [
        *_compared_problems(model, start, failure_budgets, penalties, reach_fractions),
        *_compared_risks(model, start, failure_budgets, cost_bounds, levels),
    ]
    for budget, words in _compared_budgets(failure_budgets) if limits else ():
        problem = ConstrainedCost(model, start, limits or {}, failure_budget=budget)
        problems.append((f"ConstrainedCost, {words}", problem))
    for factor, bonus in exponential_utilities:
        name = f"EGUBS, risk factor {float(factor):g}, goal bonus {float(bonus):g}"
        problems.append((name, EGUBS(model, start, factor, bonus)))
    rows = []
    with progress_shown(verbose):
        for number, (name, question) in enumerate(problems, 1):
            _LOG.info("%d of %d: %s", number, len(problems), name)
            rows.append(_criterion_row(name, question, horizon))
    return CriteriaComparison(tuple(rows))


def _compared_problems(
    model: SSP,
    start: Hashable | Mapping[Hashable, float],
    budgets: Sequence[float],
    penalties: Sequence[float],
    fractions: Sequence[float],
) -> Iterator[tuple[str, Problem]]:
    """The problems of all criteria that are compared, with their names."""
    yield "MaxProb", MaxProb(model, start)
    yield "MinProb", MinProb(model, start)
    yield "MinCost", MinCost(model, start)
    yield "MCMP, least failure", MCMP(model, start)
    yield "S3P, least failure", S3P(model, start)
    yield "ISSPUDE", ISSPUDE(model, start)
    for budget in budgets:
        yield f"MCMP, failure budget {float(budget):g}", MCMP(model, start, failure_budget=budget)
        yield f"S3P, failure budget {float(budget):g}", S3P(model, start, failure_budget=budget)
    for fraction in fractions:
        yield f"AlphaMCMP, reach fraction {float(fraction):g}", AlphaMCMP(model, start, fraction)
    for penalty in penalties:
        yield f"FinitePenalty, penalty {float(penalty):g}", FinitePenalty(model, start, penalty)


def _compared_risks(
    model: SSP,
    start: Hashable | Mapping[Hashable, float],
    budgets: Sequence[float],
    bounds: Sequence[float | Fraction],
    levels: Sequence[float],
) -> Iterator[tuple[str, Problem]]:
    """The problems of risk that are compared, with their names."""
    within = _compared_budgets(budgets)
    for bound in bounds:
        name = f"CostBoundedReach, cost {float(bound):g}"
        yield name, CostBoundedReach(model, start, bound)
        for budget, words in within[1:]:
            yield f"{name}, {words}", CostBoundedReach(model, start, bound, failure_budget=budget)
    for level in levels:
        for budget, words in within:
            at = f"{float(level):g}, {words}"
            yield f"CostQuantile {at}", CostQuantile(model, start, level, budget)
            yield f"CVaR {at}", CVaR(model, start, level, budget)


def _compared_budgets(budgets: Sequence[float]) -> list[tuple[float | None, str]]:
    """Least failure and each budget that is compared, with their names."""
    return [(None, "least failure"), *((b, f"failure budget {float(b):g}") for b in budgets)]


def _criterion_row(name: str, problem: Any, horizon: int | None) -> CriterionRow:
    """A criterion's row of the comparison."""
    if horizon is not None:
        problem = replace(problem, horizon=horizon, **as_stated(problem))
    try:
        return CriterionRow(name, solve(problem))
    except InfeasibleError as error:
        return CriterionRow(name, None, str(error.args[0]))  # the rest is a remedy
