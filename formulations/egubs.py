"""EGUBS: expected exponential utility of the total cost together with a bonus for the goal."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from ssp_lp.formulation import SSP, ExponentialUtility, Formulation, Start, wrong_argument


@dataclass(frozen=True, eq=False)
class EGUBS(Formulation):
    """Maximise ``E[exp(risk_factor * C); goal] + goal_bonus * Pr(goal)``, risk_factor < 0.

    Problem:
        ``GUBS`` with the exponential utility: C is the total cost, infinite if the goal is not
        reached, so that failing is worth 0.

    Program:
        minimise <-worth, x> subject to flow balance, x >= 0 over states x accumulated cost (paper,
        section 3.1.1). The worth of reaching the goal at total cost c is exp(risk_factor * c) +
        goal_bonus.

    Guarantee:
        a deterministic policy of (state, accumulated cost) attains the optimum. Beyond a finite
        accumulated cost, ``cost_horizon``, a stationary policy is optimal: it has the greatest goal
        probability and, among such policies, the greatest exponential moment. The layers of cost
        end there, so that nothing is truncated; ``upper_bound`` is checked.

    Semantics:
        exact. Wandering for ever is failure. Without a bonus the stationary risk-sensitive policy
        is optimal, and ``cost_horizon`` is 0.

    Reference:
        Freire and Delgado, AAMAS 2017 (GUBS); Freire, Delgado and Reis, ICAPS 2019 (eGUBS and its
        exact cost horizon).

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        risk_factor: lambda < 0, per unit of cost.
        goal_bonus: K_g >= 0.
        cost_levels: greatest number of distinct total costs that the program counts; see ``S3P``.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the greatest expected utility as ``objective``, a certified
        ``upper_bound``, and one deterministic policy of (state, accumulated cost).

    Raises:
        ModelError: a risk factor that is not negative, a negative bonus, an unknown start.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> [round(solve(EGUBS(model, "road", -0.5, k)).objective, 9) for k in (0.0, 10.0)]
        [0.545877594, 10.22313016]
    """

    model: SSP
    start: Start
    risk_factor: float
    goal_bonus: float
    cost_levels: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.risk_factor < 0.0 and isfinite(self.risk_factor)):
            raise wrong_argument("risk_factor", "be a number below 0", self.risk_factor)
        if not (self.goal_bonus >= 0.0 and isfinite(self.goal_bonus)):
            raise wrong_argument("goal_bonus", "be a number >= 0", self.goal_bonus)

    @property
    def cost_horizon(self) -> float:
        """C_max of eGUBS: accumulated cost from which a stationary policy is optimal."""
        return self.compile().cost_horizon

    @property
    def measure(self) -> ExponentialUtility:
        """Measure of the total cost: its exponential utility."""
        return ExponentialUtility(self.risk_factor, self.goal_bonus)
