"""S3P: minimum expected cost given success, within a failure budget."""

from __future__ import annotations

from dataclasses import dataclass

from ssp_lp.formulation import (
    BUDGET_OR_SHARE,
    SSP,
    FailureBudget,
    Formulation,
    Start,
    wrong_argument,
)


@dataclass(frozen=True, eq=False)
class S3P(Formulation):
    """Minimise ``E[total cost | goal reached]`` subject to ``failure <= failure_budget`` (case S).

    Problem:
        the stochastic safest and shortest path problem of Teichteil-Koenigsbuch (2012), relaxed
        from least failure to a budget (paper, eq. JS3P_def and section 2.5).

    Program:
        minimise <cost, x> / <goal, x> subject to flow balance and <failure, x> <= budget over
        states x accumulated cost (section 3.1.1): the accumulated cost is charged on arrival at the
        goal. By Charnes and Cooper's scaling it is a linear program.

    Guarantee:
        a lottery over at most two deterministic policies of (state, accumulated cost) attains the
        optimum; with least failure (None) a policy of the state alone does.

    Semantics:
        failing episodes cost nothing, so giving up needs no charge: a policy fails by avoiding the
        goal in attention states. Accumulated cost is tracked up to a cap M; beyond M a policy
        follows one of its stationary tail policies (section 3.5). M grows until the certified gap
        meets the tolerance.

    Reference:
        Teichteil-Koenigsbuch, AAAI 2012 (S3P); paper, sections 2.3, 2.5 and 3.1.1.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``; the budget holds in expectation.
        failure_budget: largest failure probability; None: as low as possible.
        discount: None for exact probabilities, or gamma in (0, 1).
        cost_cap: fixed cap M on accumulated cost; None: M grows as described under Semantics.
        reach_fraction: instead of a budget, the least share of the greatest goal probability
            (undiscounted even if there is a ``discount``).
        cost_levels: greatest number of distinct total costs that the program counts; None: as many
            as costs and tolerance require. If costs have no common unit, the totals are all sums
            that can occur. If these are too many, totals are rounded to a grid; the gap that this
            leaves is reported.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least cost given success as ``objective``, a certified
        ``lower_bound``, the ``failure_price``, and a lottery over at most two policies.

    Raises:
        ModelError: a budget, a share, a discount or a cap out of range, a budget and a share at
            once, or an unknown start.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> round(solve(S3P(model, start="road", failure_budget=0.05)).objective, 6)  # 1.95/0.95
        2.052632
    """

    model: SSP
    start: Start
    failure_budget: FailureBudget = BUDGET_OR_SHARE
    discount: float | None = None
    cost_cap: float | None = None
    reach_fraction: float | None = None
    cost_levels: int | None = None

    ratio = True  # cost is counted given success

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cost_cap is not None and not 0.0 < self.cost_cap < float("inf"):
            raise wrong_argument("cost_cap", "be a positive cost", self.cost_cap)
