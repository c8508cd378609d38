"""CostQuantile: the least quantile of the total cost given success, within a failure budget."""

from __future__ import annotations

from dataclasses import dataclass

from ssp_lp.formulation import (
    SSP,
    CostQuantileOf,
    Formulation,
    Start,
    as_percentage,
    wrong_argument,
)


@dataclass(frozen=True, eq=False)
class CostQuantile(Formulation):
    """Minimise the ``level``-quantile of the total cost given success.

    Problem:
        the least B for which some policy within the failure budget has ``Pr(C <= B | goal) >=
        level``: a promise of the form "in 95 of 100 runs that succeed the cost is at most B".

    Program:
        for a bound B, minimise <late, x> / <goal, x> subject to flow balance, <failure, x> <=
        failure_budget, x >= 0 over states x accumulated cost (paper, section 3.1.1), where late
        counts the arrivals beyond B: the program of ``S3P`` with another charge. The optimum
        decreases in B, and Newton's method finds the least B whose optimum is at most 1 - level.
        For given prices, one sweep shows which values of B these prices prove to be too small.

    Guarantee:
        a lottery over at most two deterministic policies of (state, accumulated cost) attains the
        optimum. ``lower_bound`` is the least B that no checked sub-solution rules out; it equals
        the objective unless time runs out.

    Semantics:
        exact, as in ``S3P``: failing costs nothing and is limited by the budget alone. Without a
        budget (1.0) the optimum is the least cost with which the goal can be reached at all, since
        all other runs may fail. The probability is compared with ``level`` at a relative tolerance
        of 1e-12.

    Reference:
        quantiles: Baier, Daum, Dubslaff, Klein and Klueppelholz, NFM 2014; Randour, Raskin and
        Sankur, CAV 2015. Given success within a budget: ours.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``; the budget holds in expectation.
        level: strictly between 0 and 1.
        failure_budget: largest failure probability; None: as low as possible.
        cost_levels: greatest number of distinct total costs that the program counts; see ``S3P``.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least quantile as ``objective``, a certified
        ``lower_bound``, and a lottery over at most two policies. Among the lotteries with this
        quantile, its cost is most often within the quantile.

    Raises:
        ModelError: a level or a budget that is not a number or out of range, or an unknown start.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.5, "home", 1.0), (0.4, "road", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 4.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> [solve(CostQuantile(model, "road", 0.75, e)).objective for e in (None, 0.1, 0.2)]
        [4.0, 4.0, 2.0]
    """

    model: SSP
    start: Start
    level: float
    failure_budget: float | None = None
    cost_levels: int | None = None

    ratio = True  # given success

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.level < 1.0:
            wanted = "lie strictly between 0 and 1"
            raise wrong_argument("level", wanted, self.level, as_percentage(self.level))

    @property
    def measure(self) -> CostQuantileOf:
        """Measure of the total cost: its quantile."""
        return CostQuantileOf(self.level)
