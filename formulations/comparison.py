"""Criteria side by side: a model solved under every criterion of the literature."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from ssp_lp import SSP, InfeasibleError, Solution, progress_shown, solve
from ssp_lp.errors import did_you_mean
from ssp_lp.formulation import CostLimit, Problem
from ssp_lp.model.arguments import explained
from ssp_lp.model.report import Report, Table

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
    """One criterion's optimum in the comparison; if it is infeasible, the note says why."""

    criterion: str  # the formulation and its parameters
    solution: Solution | None
    note: str = ""

    @property
    def numbers(self) -> tuple[float | None, ...]:
        """Numbers of a compared criterion: objective, costs, failure probability and price.

        Rows are not comparable in every respect, since each follows the default semantics of its
        criterion. ``MCMP`` and ``ConstrainedCost`` charge the step at which failure is declared.
        The other criteria do not, so a policy may cost less in their rows. ``FinitePenalty`` and
        ``AlphaMCMP`` let a policy give up anywhere.
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
    """One row per criterion, in the order of the comparison."""

    rows: tuple[CriterionRow, ...]

    def __getitem__(self, criterion: str) -> CriterionRow:
        """Return the row of a criterion by its name.

        Raises:
            KeyError: no row has this name.
        """
        for row in self.rows:
            if row.criterion == criterion:
                return row
        nearest = did_you_mean(criterion, [row.criterion for row in self.rows], "there are")
        raise KeyError(f"{criterion!r} is not a row of the table{nearest}")

    def __repr__(self) -> str:
        """Return a line with the number of criteria; :meth:`summary` is the table."""
        unmet = sum(row.solution is None for row in self.rows)
        infeasible = f", {unmet} infeasible" if unmet else ""
        return f"CriteriaComparison({len(self.rows)} criteria{infeasible})"

    def tables(self) -> list[Table]:
        """Return a table with a row for each criterion; notes explain rows without numbers."""
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
    """Solve a model under every criterion and return one table.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        failure_budgets: budgets of ``MCMP`` and ``S3P``, in addition to least failure.
        penalties: penalties D of ``FinitePenalty``, in units of cost.
        reach_fractions: shares of the greatest goal probability for ``AlphaMCMP``.
        cost_bounds: bounds of ``CostBoundedReach``; for each bound a row without a failure budget,
            and one for each budget.
        levels: levels of ``CostQuantile`` and ``CVaR``; for each level a row for least failure, and
            one for each budget.
        exponential_utilities: pairs (risk factor, goal bonus) for ``EGUBS``.
        limits: limits of ``ConstrainedCost``; a row for least failure, and one for each budget.
        horizon: greatest number of steps to the goal, in every row; None: unlimited.
        verbose: show progress (``ssp_lp.progress_shown``).

    Returns:
        A table with one row per criterion and setting, such as "MCMP, failure budget 0.05". The row
        of an infeasible problem has the reason instead of numbers.

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

    def asked(criterion: type[Any], words: str, *given: Any, **named: Any) -> tuple[str, Problem]:
        """Return the name of a row, such as "MCMP, failure budget 0.05", and its problem."""
        problem = criterion(model, start, *given, horizon=horizon, **named)
        return f"{criterion.__name__}{words}", problem

    budgets = [(budget, f"failure budget {float(budget):g}") for budget in failure_budgets]
    within = [(None, "least failure"), *budgets]
    problems = [
        *(asked(criterion, "") for criterion in (MaxProb, MinProb, MinCost)),
        *(asked(criterion, ", least failure") for criterion in (MCMP, S3P)),
        asked(ISSPUDE, ""),
        *(asked(c, f", {words}", failure_budget=b) for b, words in budgets for c in (MCMP, S3P)),
        *(asked(AlphaMCMP, f", reach fraction {float(a):g}", a) for a in reach_fractions),
        *(asked(FinitePenalty, f", penalty {float(price):g}", price) for price in penalties),
        *(
            asked(CostBoundedReach, f", cost {float(bound):g}{words}", bound, budget)
            for bound in cost_bounds
            for budget, words in [(1.0, ""), *((b, f", {words}") for b, words in budgets)]
        ),
        *(
            asked(criterion, f" {float(level):g}, {words}", level, budget)
            for level in levels
            for budget, words in within
            for criterion in (CostQuantile, CVaR)
        ),
        *(asked(ConstrainedCost, f", {words}", limits, b) for b, words in within if limits),
        *(
            asked(EGUBS, f", risk factor {float(r):g}, goal bonus {float(bonus):g}", r, bonus)
            for r, bonus in exponential_utilities
        ),
    ]
    rows = []
    with progress_shown(verbose):
        for number, (name, problem) in enumerate(problems, 1):
            _LOG.info("%d of %d: %s", number, len(problems), name)
            try:
                rows.append(CriterionRow(name, solve(problem)))
            except InfeasibleError as error:  # the rest of its message is a remedy
                rows.append(CriterionRow(name, None, str(error.args[0])))
    return CriteriaComparison(tuple(rows))
