"""CostBoundedReach: the greatest probability of reaching the goal within a total cost."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from ssp_lp.formulation import SSP, Formulation, Start, WithinBound, check_cost


@dataclass(frozen=True, eq=False)
class CostBoundedReach(Formulation):
    """Maximise ``Pr(goal, total cost <= cost_bound)`` subject to ``failure <= failure_budget``.

    Problem:
        a deadline or a tank: reach the goal before the cost exceeds the bound. A run that reaches
        the goal later is late but has not failed; the failure budget limits the runs that never
        reach it at any cost.

    Program:
        minimise <-in time, x> subject to flow balance, <failure, x> <= failure_budget, x >= 0 over
        states x accumulated cost (paper, section 3.1.1), where "in time" counts arrivals at the
        goal within the bound. There is one layer per unit of cost up to the bound, and none beyond
        it, since only the goal probability counts there.

    Guarantee:
        a lottery over at most two deterministic policies of (state, accumulated cost) attains the
        optimum; without a budget one policy suffices. The layers end at the bound, so nothing is
        truncated. ``upper_bound`` comes from a checked sub-solution of the pricing problem.

    Semantics:
        exact; costs and bound are compared as exact decimals or fractions, so that three steps of
        0.1 satisfy a bound of 0.3. Wandering for ever is failure. ``failure_budget=1.0`` limits
        nothing; ``None`` admits only policies that fail least.

    Reference:
        Andova, Hermanns and Katoen, FORMATS 2003 (reward-bounded reachability); Hartmanns, Junges,
        Katoen and Quatmann, TACAS 2018 (by unfolding the cost). The budget is ours.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``; the budget holds in expectation.
        cost_bound: greatest total cost, a number or a fraction, not negative.
        failure_budget: largest failure probability; None: as low as possible.
        cost_levels: greatest number of distinct total costs that the program counts; see ``S3P``.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the greatest probability as ``objective``, a certified
        ``upper_bound``, the ``failure_price`` (the gain per unit of budget), and a lottery over at
        most two policies of (state, accumulated cost).

    Raises:
        ModelError: a bound or a budget that is not a number or out of range, or an unknown start.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.6, "home", 1.0), (0.3, "road", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> [round(solve(CostBoundedReach(model, "road", b)).objective, 9) for b in (0.5, 1, 2, 3)]
        [0.0, 0.6, 0.78, 1.0]
        >>> round(solve(CostBoundedReach(model, "road", 2, failure_budget=0.05)).objective, 9)
        0.3
    """

    model: SSP
    start: Start
    cost_bound: float | Fraction
    failure_budget: float | None = 1.0
    cost_levels: int | None = None

    def __post_init__(self) -> None:
        check_cost("cost_bound", self.cost_bound)
        super().__post_init__()

    @property
    def measure(self) -> WithinBound:
        """Measure of the total cost: reaching the goal within the bound."""
        return WithinBound(self.cost_bound)
