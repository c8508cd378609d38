"""CVaR: the least conditional value at risk of the total cost given success."""

from __future__ import annotations

from dataclasses import dataclass

from ssp_lp.formulation import SSP, Formulation, Start, TailMeanOf, as_percentage, wrong_argument


@dataclass(frozen=True, eq=False)
class CVaR(Formulation):
    """Minimise the mean of the costliest ``1 - level`` of the runs that succeed.

    Problem:
        min over policies within the failure budget of CVaR_level(C | goal) = min over z of ``z +
        E[(C - z)^+ | goal] / (1 - level)``. Level 0 is ``S3P``; as the level grows to 1, only the
        worst runs count.

    Program:
        for a threshold z, minimise <integrand, x> / <goal, x> subject to flow balance, <failure, x>
        <= failure_budget, x >= 0 over states x accumulated cost (paper, section 3.1.1): the program
        of ``S3P``, where an arrival at total cost c is charged the integrand, z + (c - z)^+ / (1 -
        level). For every policy the minimum over z is attained at the policy's quantile, which is a
        total that can occur.

    Guarantee:
        a lottery over at most two deterministic policies of (state, accumulated cost) attains the
        optimum. For every threshold z there is a lower bound of the objective: from a checked
        sub-solution for z, from one for an interval around z, or z itself, since no tail mean is
        below its threshold. ``lower_bound`` is the least of these bounds.

    Semantics:
        exact, as in ``S3P``: failing costs nothing and is limited by the budget alone. If a part of
        the runs cost exactly the quantile, the tail takes only as many of them as it needs to have
        the share ``1 - level``.

    Reference:
        Rockafellar and Uryasev, Journal of Risk 2, 2000; for stochastic shortest paths
        Meggendorfer, AAAI 2022. Given success within a budget: ours.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``; the budget holds in expectation.
        level: at least 0 and below 1.
        failure_budget: largest failure probability; None: as low as possible.
        cost_levels: greatest number of distinct total costs that the program counts; see ``S3P``.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least conditional value at risk as ``objective``, a
        certified ``lower_bound``, the ``failure_price``, and a lottery over at most two policies.

    Raises:
        ModelError: a level or a budget that is not a number or out of range, or an unknown start.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.5, "home", 1.0), (0.4, "road", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 4.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> [round(solve(CVaR(model, "road", x, 0.2)).objective, 6) for x in (0.0, 0.5, 0.9)]
        [1.666667, 2.333333, 4.0]
    """

    model: SSP
    start: Start
    level: float
    failure_budget: float | None = None
    cost_levels: int | None = None

    ratio = True  # given success

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.level < 1.0:
            wanted = "be at least 0 and below 1"
            raise wrong_argument("level", wanted, self.level, as_percentage(self.level))

    @property
    def measure(self) -> TailMeanOf:
        """Measure of the total cost: the mean of its tail."""
        return TailMeanOf(self.level)
