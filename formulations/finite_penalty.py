"""FinitePenalty: expected cost plus a price for failing (fSSPUDE)."""

from __future__ import annotations

from dataclasses import dataclass, field

from ssp_lp.formulation import SSP, Boxes, Formulation, GiveUp, Start, check_penalty


@dataclass(frozen=True, eq=False)
class FinitePenalty(Formulation):
    """Minimise ``E[r_tau] + penalty * failure probability``: failing is allowed, at a price.

    Problem:
        r_tau is the cost paid until the goal has become unreachable under the policy, all of it if
        the goal is reached; runs that fail pay the penalty in addition (fSSPUDE).

    Program:
        minimise ``<cost + penalty * failure, x>`` subject to flow balance, x >= 0, over the process
        of ``MCMP``, without a failure row.

    Guarantee:
        a deterministic stationary policy attains the optimum. ``failure_price`` is the penalty. The
        policy is also optimal for ``MCMP`` if the budget is the policy's failure probability: the
        optimum is the point at which a line of slope ``-penalty`` touches MCMP's frontier.

    Semantics:
        ``give_up`` and ``charge_failing_step`` as in ``MCMP``, by default as published: a policy
        may give up anywhere and pays only the penalty. With a ``discount`` the cost is discounted
        and the penalty multiplies the discounted failure. ``expected_cost`` is the cost without the
        penalty.

    Reference:
        Kolobov, Mausam and Weld, UAI 2012 (fSSPUDE). Their Theorem 7, on its relation to the
        infinite penalty, was withdrawn; nothing here relies on it.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        penalty: paid for failing, a positive number.
        discount: None for exact probabilities, or gamma in (0, 1).
        give_up: where a policy may give up: "anywhere", "attention" or "dead_ends".
        charge_failing_step: whether the step at which failure is declared is charged, too.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        box: intervals of the probabilities; the worst case over all of them counts.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has cost plus penalty as ``objective``, a certified
        ``lower_bound``, and one deterministic stationary policy.

    Raises:
        ModelError: a penalty that is not positive and finite, a discount out of range, an unknown
            start or ``give_up``.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> [round(solve(FinitePenalty(model, "road", d)).objective, 9) for d in (1, 10, 100)]
        [1.0, 2.0, 3.0]
    """

    model: SSP
    start: Start
    penalty: float = field()  # required here; other criteria have 0
    discount: float | None = None
    give_up: str | GiveUp = GiveUp.ANYWHERE
    charge_failing_step: bool = False
    box: Boxes | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        check_penalty(self.penalty)
        super().__post_init__()
