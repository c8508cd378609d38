"""MinCost: the plain stochastic shortest path problem, without failing."""

from __future__ import annotations

from dataclasses import dataclass, field

from ssp_lp.formulation import SSP, Boxes, Formulation, GiveUp, Start


@dataclass(frozen=True, eq=False)
class MinCost(Formulation):
    """Minimise the expected cost of reaching the goal, which must be reached surely.

    Problem:
        min over proper policies, those that reach the goal with probability one, of E[total cost].

    Program:
        minimise <cost, x> subject to flow balance, x >= 0, over the pairs that never leave the set
        of states from which the goal can be reached surely.

    Guarantee:
        a deterministic stationary policy attains the optimum; ``lower_bound`` comes from a checked
        sub-solution of Bellman's equation. End components of cost 0 are collapsed first and must be
        left by the policy: a loop of cost 0 is not a solution.

    Semantics:
        exact. If no proper policy exists from the start, ``solve`` raises an error; ``evaluate``
        gives an improper policy the objective infinity. Whether a policy is proper is decided on
        the graph, so no probability is ever compared with 1.

    Reference:
        Bertsekas and Tsitsiklis, Mathematics of Operations Research 16, 1991.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        box: intervals of the probabilities; the worst case over all of them counts.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least cost as ``objective``, a certified ``lower_bound``,
        and one deterministic stationary policy; ``failure_price`` is infinite.

    Raises:
        ModelError: an unknown start.

    ``solve`` raises ``InfeasibleError`` naming a state of the start from which the goal cannot be
    reached surely; it carries the least failure probability.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(0.5, "home", 3.0), (0.5, "road", 1.0)],
        ...               "wait": [(1.0, "road", 0.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> solve(MinCost(model, start="road")).objective
        4.0
    """

    model: SSP
    start: Start
    box: Boxes | None = field(default=None, kw_only=True)

    give_up = GiveUp.DEAD_ENDS
    penalty = float("inf")  # failing is forbidden
