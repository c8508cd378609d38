"""MCMP: minimum expected cost until failure is declared, within a failure budget."""

from __future__ import annotations

from dataclasses import dataclass

from ssp_lp.formulation import BUDGET_OR_SHARE, SSP, FailureBudget, Formulation, GiveUp, Start


@dataclass(frozen=True, eq=False)
class MCMP(Formulation):
    """Minimise ``E[r_tau]`` subject to ``failure probability <= failure_budget`` (case M).

    Problem:
        r_tau is the cost paid until the goal has become unreachable under the policy, all of it if
        the goal is reached (paper, eq. JMCMP_def and section 2.5; min-cost given max-prob of
        Trevizan et al. 2017 at ``failure_budget=None``).

    Program:
        minimise <cost, x> subject to flow balance, <failure, x> <= failure_budget, x >= 0, where x
        counts the expected visits of each (state, action) before failure is declared (label s of
        section 3.1.2).

    Guarantee:
        the optimum is attained by a lottery over at most two deterministic stationary policies; the
        dual of the failure row, ``failure_price``, is minus the slope of the optimal cost.

    Semantics:
        ``give_up``: where a policy may declare failure (``GiveUp``); ``charge_failing_step``:
        whether the step at which failure is declared is paid. The defaults are the paper's,
        "attention" and True; with ``reach_fraction`` they are "anywhere" and False, as published
        for alpha-MCMP. With a ``discount`` both cost and failure are discounted (section 3.5).

    Reference:
        paper, sections 2.4, 2.5 and 3.1.2; Trevizan, Teichteil-Koenigsbuch and Thiebaux, UAI 2017
        (with "anywhere" and nothing charged).

    Args:
        model: the model.
        start: a state, or ``{state: probability}``; the budget holds in expectation.
        failure_budget: largest failure probability; None: as low as possible.
        discount: None for exact probabilities, or gamma in (0, 1).
        give_up: where a policy may give up: "anywhere", "attention" (the paper) or "dead_ends";
            None: the default under Semantics.
        charge_failing_step: whether the step at which failure is declared is charged (the paper's
            section 3.1.2); None: the default under Semantics.
        reach_fraction: instead of a budget, the least share of the greatest goal probability
            (undiscounted even if there is a ``discount``).
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least cost as ``objective``, a certified ``lower_bound``,
        the ``failure_price``, and a lottery over at most two policies.

    Raises:
        ModelError: a budget, a share or a discount out of range, a budget and a share at once, an
            unknown start or ``give_up``.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> round(solve(MCMP(model, start="road", failure_budget=0.05)).objective, 9)
        2.0
    """

    model: SSP
    start: Start
    failure_budget: FailureBudget = BUDGET_OR_SHARE
    discount: float | None = None
    give_up: str | GiveUp | None = None
    charge_failing_step: bool | None = None
    reach_fraction: float | None = None

    def __post_init__(self) -> None:
        published = self.reach_fraction is not None
        if self.give_up is None:
            object.__setattr__(self, "give_up", "anywhere" if published else "attention")
        if self.charge_failing_step is None:
            object.__setattr__(self, "charge_failing_step", not published)
        super().__post_init__()
