"""Constrained cost (C-SSP): minimum expected cost with bounds on other expected costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ssp_lp.formulation import (
    SSP,
    Constraint,
    CostLimit,
    Formulation,
    GiveUp,
    Start,
    constraints_of,
)


@dataclass(frozen=True, eq=False)
class ConstrainedCost(Formulation):
    """Minimise ``E[r_tau]`` subject to ``E[secondary cost k] <= bound k`` and a failure budget.

    Problem:
        minimise r_tau, the cost paid until the goal has become unreachable, within a failure budget
        or with least failure, as in MCMP. There may be any number of secondary costs, such as fuel,
        time or exposure, each with an upper bound on its expected total. If the goal can be reached
        surely, ``failure_budget=None`` is the C-SSP of Trevizan et al.

    Program:
        minimise <cost, x> subject to flow balance, <row_k, x> <= bound_k, <failure, x> <=
        failure_budget, x >= 0, where x counts the expected visits of each (state, action).

    Guarantee:
        the optimum is attained by a lottery over at most (active rows + 1) deterministic stationary
        policies; ``prices`` holds the dual of each row by name: minus the slope of the optimal cost
        in the row's bound. If no policy satisfies all rows, the error names rows that contradict
        each other and carries a proof.

    Semantics:
        every secondary cost is counted like the cost: until failure is declared, and discounted if
        there is a ``discount``. With ``charge_failing_step``, failing in a state is also charged
        the state's least secondary cost. Policies that pay any of the costs for ever are excluded.
        With least failure the limits choose among the policies of the greatest goal probability.

    Reference:
        Trevizan, Thiebaux, Santana, Williams: Heuristic search in dual space for constrained
        stochastic shortest path problems, ICAPS 2016. Altman: Constrained Markov decision
        processes, 1999.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``; the bounds hold in expectation.
        limits: name -> ``CostLimit(cost, bound)``. The cost is ``{state: {action: cost}}``, in
            which missing entries are 0, or an array with a cost for each pair or for each outcome.
        failure_budget: largest failure probability; None: as low as possible; 1: unlimited.
        discount: None for exact numbers, or gamma in (0, 1).
        give_up: where a policy may give up: "anywhere", "attention" (the paper) or "dead_ends".
        charge_failing_step: whether the step at which failure is declared is charged (the paper's
            section 3.1.2).
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least cost as ``objective``, a certified ``lower_bound``,
        the ``prices`` and ``secondary_costs`` by name, and a lottery over at most (active rows + 1)
        policies. ``InfeasibleError.conflicting_rows`` names a smallest set of conflicting rows.

    Raises:
        ModelError: a budget or a discount out of range, an unknown start or ``give_up``, a limit
            that is stated wrongly.

    Example:
        >>> from ssp_lp import SSP, CostLimit, solve
        >>> model = SSP.from_transitions(
        ...     {"depot": {"motorway": [(1.0, "shop", 2.0)], "lane": [(1.0, "shop", 5.0)]}},
        ...     goal={"shop"})
        >>> fuel = CostLimit({"depot": {"motorway": 4.0, "lane": 1.0}}, bound=3.0)
        >>> solution = solve(ConstrainedCost(model, start="depot", limits={"fuel": fuel}))
        >>> round(solution.objective, 9), round(solution.prices["fuel"], 9)
        (3.0, 1.0)
    """

    model: SSP
    start: Start
    limits: Mapping[str, CostLimit] = field(default_factory=dict)
    failure_budget: float | None = None
    discount: float | None = None
    give_up: str | GiveUp = GiveUp.ATTENTION
    charge_failing_step: bool = True

    @property
    def own_constraints(self) -> Mapping[str, Constraint]:
        """Upper bounds of ``limits`` as constraints, by name."""
        return constraints_of(self.limits)
