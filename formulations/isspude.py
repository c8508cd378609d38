"""ISSPUDE: greatest goal probability first, then least cost of the successful runs."""

from __future__ import annotations

from dataclasses import dataclass

from ssp_lp.formulation import SSP, Formulation, Start


@dataclass(frozen=True, eq=False)
class ISSPUDE(Formulation):
    """Minimise ``E[total cost | goal reached]`` among policies of greatest goal probability.

    Problem:
        the SSP with unavoidable dead-ends and an infinite penalty: policies are compared by their
        goal probability first, and by the expected cost of their successful runs second.

    Program:
        two stages. The first computes Pmax, the greatest goal probability from each state
        (MAXPROB). The second minimises ``<cost * Pmax(successor), x> / Pmax(start)`` over the pairs
        that attain Pmax. No accumulated cost is needed, since Pmax says how probably a run in a
        state succeeds.

    Guarantee:
        a deterministic stationary policy attains the optimum; ``lower_bound`` comes from checked
        bounds of both stages.

    Semantics:
        the cost of failing runs does not matter. ``S3P(failure_budget=None)`` has the same optimum
        and the same policies; ``S3P(failure_budget=...)`` relaxes the first stage to a budget. S3P
        also allows any costs in dead-ends. ``MCMP`` with least failure shares the first stage; its
        second stage also counts the cost of failing runs, up to the failure.

    Reference:
        Kolobov, Mausam and Weld, UAI 2012; Teichteil-Koenigsbuch, AAAI 2012 (S3P).

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least cost given success as ``objective``, a certified
        ``lower_bound``, and one deterministic stationary policy.

    Raises:
        ModelError: an unknown start.

    ``solve`` raises ``InfeasibleError`` if the goal cannot be reached from the start.

    Example:
        >>> from ssp_lp import MCMP, SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.5, "home", 1.0), (0.5, "ditch", 7.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> solve(ISSPUDE(model, start="road")).objective, solve(MCMP(model, "road")).objective
        (1.0, 4.0)
    """

    model: SSP
    start: Start

    failure_budget = None  # as low as possible
    ratio = True  # cost is counted given success
