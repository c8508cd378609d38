"""LeastQuantity: the least of any quantity of the expected visits."""

from __future__ import annotations

from dataclasses import dataclass, field

from ssp_lp.formulation import SSP, Formulation, GiveUp, Quantity, Start


@dataclass(frozen=True, eq=False)
class LeastQuantity(Formulation):
    """Minimise a quantity of your own subject to a failure budget and any constraints.

    Problem:
        min over policies of ``quantity``: a sum of multiples of secondary costs, visits of states
        and probabilities of ends. An end with a negative weight is made likely.

    Program:
        minimise <quantity, x> subject to flow balance, <failure, x> <= failure_budget, <row_k, x>
        <= bound_k, x >= 0, where x counts the expected visits of each (state, action).

    Guarantee:
        a lottery over at most (active rows + 1) deterministic stationary policies attains the
        optimum; ``lower_bound`` is certified.

    Semantics:
        as in ``MCMP``, with the quantity in place of the cost; by default giving up adds nothing to
        the quantity. If an end has a negative weight, failing is declared only on giving up or
        entering a dead-end.

    Reference:
        Altman: Constrained Markov decision processes, 1999.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        quantity: the objective, such as ``visits("ward") + 2.0 * secondary_cost(fuel)``.
        failure_budget: largest failure probability; None: as low as possible; 1: unlimited.
        discount: None for exact numbers, or gamma in (0, 1).
        give_up: where a policy may give up: "anywhere", "attention" (the paper) or "dead_ends".
        charge_failing_step: whether the step at which failure is declared is charged (the paper's
            section 3.1.2).
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least value as ``objective``, a certified ``lower_bound``,
        the ``prices`` of all rows, and a lottery over at most (active rows + 1) policies.

    Raises:
        ModelError: a budget or a discount out of range, an unknown start or ``give_up``, or a
            negative weight of costs or visits, which would be maximised.

    Example:
        >>> from ssp_lp import SSP, end_probability, solve, visits
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.5, "home", 1.0), (0.3, "yard", 1.0), (0.2, "ditch", 1.0)],
        ...               "safe": [(0.2, "home", 3.0), (0.8, "yard", 3.0)]},
        ...      "yard": {"on": [(1.0, "home", 1.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> solution = solve(LeastQuantity(model, "road", visits("yard"), failure_budget=0.1))
        >>> round(solution.objective, 9)
        0.55
    """

    model: SSP
    start: Start
    quantity: Quantity = field()  # required here; None in other criteria
    failure_budget: float | None = 1.0
    discount: float | None = None
    give_up: str | GiveUp = GiveUp.ATTENTION
    charge_failing_step: bool = False
