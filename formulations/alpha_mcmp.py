"""AlphaMCMP: minimum expected cost with at least a share of the greatest goal probability."""

from __future__ import annotations

from dataclasses import dataclass

from ssp_lp.formulation import BUDGET_OR_SHARE, SSP, Formulation, GiveUp, Start


@dataclass(frozen=True, eq=False)
class AlphaMCMP(Formulation):
    """Minimise ``E[r_tau]`` subject to ``Pr(goal) >= reach_fraction * greatest probability``.

    Problem:
        MCMP with a failure budget relative to the least attainable failure, so that every share up
        to 1 is feasible. r_tau is the cost paid until the goal has become unreachable.

    Program:
        that of ``MCMP`` with ``failure_budget = 1 - reach_fraction * max Pr(goal)``.

    Guarantee:
        a lottery over at most two deterministic stationary policies attains the optimum. The cost
        is a convex function of the share. With the published semantics giving up at the start is
        free, so the cost is linear from share 0 up to the share of the policy with the least cost
        per goal probability.

    Semantics:
        as published: giving up is allowed anywhere and costs nothing. ``MCMP(reach_fraction=...)``
        is the same criterion and also takes a discount.

    Reference:
        alpha-MCMP, BRACIS 2023; the program is that of Trevizan, Teichteil-Koenigsbuch and
        Thiebaux, UAI 2017.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        reach_fraction: alpha in [0, 1].
        give_up: where a policy may give up: "anywhere", "attention" or "dead_ends".
        charge_failing_step: whether the step at which failure is declared is charged.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least cost as ``objective``, a certified ``lower_bound``,
        the ``failure_price``, and a lottery over at most two policies.

    Raises:
        ModelError: a share out of range, an unknown start or ``give_up``.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> shares = (0.45, 0.9, 0.95)
        >>> [round(solve(AlphaMCMP(model, "road", a)).objective, 9) for a in shares]
        [0.5, 1.0, 2.0]
    """

    model: SSP
    start: Start
    reach_fraction: float = 0.9
    give_up: str | GiveUp = GiveUp.ANYWHERE
    charge_failing_step: bool = False

    failure_budget = BUDGET_OR_SHARE  # computed on first use, so no field
