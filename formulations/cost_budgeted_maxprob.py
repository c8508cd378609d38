"""CostBudgetedMaxProb: the greatest probability of reaching the goal within an expected cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ssp_lp.formulation import (
    SSP,
    Aim,
    Constraint,
    Formulation,
    GiveUp,
    Start,
    check_cost,
    expected_cost,
)

COST_BUDGET = "cost budget"
"""Name of the constraint on the expected cost."""


@dataclass(frozen=True, eq=False)
class CostBudgetedMaxProb(Formulation):
    """Maximise the probability of reaching the goal subject to ``E[cost] <= cost_budget``.

    Problem:
        max of Pr(the goal is ever reached) over the policies whose expected cost until failure is
        declared is at most the budget: MAXPROB with a bounded resource. The same problem is
        ``MaxProb(model, start, constraints={"cost budget": expected_cost() <= cost_budget})``, with
        the same ``give_up``.

    Program:
        minimise <failure, x> subject to flow balance, <cost, x> <= cost_budget, x >= 0, where x
        counts the expected visits of each (state, action). This least failure is 1 - ``objective``.

    Guarantee:
        the optimum is attained by a lottery over at most (active rows + 1) deterministic stationary
        policies. The optimum is concave in the budget, and ``prices["cost budget"]`` is its slope.
        ``upper_bound`` is certified. If every policy costs more, ``solve`` raises
        ``InfeasibleError``.

    Semantics:
        as in ``MaxProb``, wandering for ever is failure. The cost is counted until failure is
        declared, in expectation over all runs, and giving up is not charged. ``give_up`` says where
        giving up is allowed:

        - "attention" (the paper's stopping time, the default): where the goal can be avoided
          surely.
        - "dead_ends": nowhere, so that runs pay until they end in the goal or a dead-end, and
          policies that pay for ever are excluded (constrained Markov decision processes, and
          multi-objective model checking).
        - "anywhere": in every state, at no cost (flows may vanish in any state), so that no budget
          is too small.

        The greatest probability with "attention" is at least that with "dead_ends", and at most
        that with "anywhere".

    Reference:
        Altman: Constrained Markov decision processes, 1999; Forejt, Kwiatkowska, Norman, Parker,
        Qu: Quantitative multi-objective verification for probabilistic systems, TACAS 2011;
        Trevizan, Teichteil-Koenigsbuch, Thiebaux: Efficient solutions for stochastic shortest path
        problems with dead ends, UAI 2017 ("anywhere").

    Args:
        model: the model.
        start: a state, or ``{state: probability}``; the budget holds in expectation.
        cost_budget: the largest expected total cost, a number, finite and not negative.
        give_up: where a policy may give up, see above: "attention" (the paper), "dead_ends" or
            "anywhere".
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the greatest probability as ``objective``, a certified
        ``upper_bound``, the price of the budget in ``prices``, the cost in ``secondary_costs``, and
        a lottery.

    Raises:
        ModelError: a budget that is not a number or out of range, an unknown start or ``give_up``,
            or a further constraint that is named "cost budget".

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.5, "home", 1.0), (0.5, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> solution = solve(CostBudgetedMaxProb(model, "road", cost_budget=2.0))
        >>> round(solution.objective, 9), round(solution.prices["cost budget"], 9)
        (0.75, 0.25)
    """

    model: SSP
    start: Start
    cost_budget: float
    give_up: str | GiveUp = GiveUp.ATTENTION

    aim = Aim.GREATEST_GOAL

    def __post_init__(self) -> None:
        check_cost("cost_budget", self.cost_budget)
        super().__post_init__()

    @property
    def own_constraints(self) -> Mapping[str, Constraint]:
        """Upper bound of the expected cost as a constraint, under the name "cost budget"."""
        return {COST_BUDGET: expected_cost() <= self.cost_budget}
