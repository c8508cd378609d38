"""GUBS: the greatest expected utility of the total cost together with a bonus for the goal."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from ssp_lp.formulation import SSP, ExpectedUtility, Formulation, Start, Utility, wrong_argument


@dataclass(frozen=True, eq=False)
class GUBS(Formulation):
    """Maximise ``E[utility(C)] + goal_bonus * Pr(goal)``; failing runs have an infinite cost.

    Problem:
        C is the total cost of a run, infinite if the goal is not reached (goals with
        utility-based semantics). The bonus states how much cost a small gain in probability is
        worth. Neither a lexicographic order nor a penalty can state this consistently.

    Program:
        minimise <-worth, x> subject to flow balance, x >= 0 over states x accumulated cost (paper,
        section 3.1.1): an arrival at total cost c is worth utility(c) + goal_bonus -
        utility_at_infinity more than failing. The process is that of ``S3P`` with another charge.

    Guarantee:
        a deterministic policy of (state, accumulated cost) attains the optimum. Beyond the last
        layer of cost the utility is at least its limit and at most its value at the last layer;
        layers are added until the certified gap meets the tolerance. If a utility is far from its
        limit after 100,000 layers, the reported gap stays above the tolerance.

    Semantics:
        exact. Wandering for ever is failure. ``utility`` must not increase, maps arrays to arrays,
        and is evaluated only at the total costs that the program counts.

    Reference:
        Freire and Delgado, AAMAS 2017 (GUBS). For the exponential utility see ``EGUBS``.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        utility: non-increasing function of the total cost, on arrays.
        goal_bonus: K_g >= 0.
        utility_at_infinity: limit of the utility, and the worth of failing.
        cost_levels: greatest number of distinct total costs that the program counts; see ``S3P``.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the greatest expected utility as ``objective``, a certified
        ``upper_bound``, and one deterministic policy of (state, accumulated cost).

    Raises:
        ModelError: a negative or infinite bonus, an infinite limit, an unknown start; when solved,
            a utility that increases, or that falls below its limit.

    Example:
        >>> import numpy as np
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> def patience(cost):
        ...     return np.maximum(1.0 - cost / 4.0, 0.0)
        >>> [round(solve(GUBS(model, "road", patience, k)).objective, 9) for k in (0.0, 10.0)]
        [0.675, 10.25]
    """

    model: SSP
    start: Start
    utility: Utility
    goal_bonus: float
    utility_at_infinity: float = 0.0
    cost_levels: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        limit = self.utility_at_infinity
        if not (self.goal_bonus >= 0.0 and isfinite(self.goal_bonus)):
            raise wrong_argument("goal_bonus", "be a number >= 0", self.goal_bonus)
        if not isfinite(limit):
            raise wrong_argument("utility_at_infinity", "be a finite number", limit)
        if not callable(self.utility):
            raise wrong_argument("utility", "be a function of the cost", self.utility)

    @property
    def measure(self) -> ExpectedUtility:
        """Measure of the total cost: its expected utility."""
        return ExpectedUtility(self.utility, self.goal_bonus, self.utility_at_infinity)
