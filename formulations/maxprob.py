"""MaxProb: the greatest probability of reaching the goal."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field

from ssp_lp.formulation import SSP, Aim, Boxes, Formulation, GiveUp, Start, dead_end_labels


@dataclass(frozen=True, eq=False)
class MaxProb(Formulation):
    """Maximise the probability of reaching the goal; costs do not count (MAXPROB).

    Problem:
        max over policies of Pr(the goal is ever reached).

    Program:
        minimise <failure, x> subject to flow balance, x >= 0, on the process in which every closed
        end component is collapsed into one state. This least failure is 1 - ``objective``.

    Guarantee:
        one deterministic stationary policy attains the greatest probability from every state.
        ``upper_bound`` comes from a checked super-solution of the optimality equations;
        ``lower_bound`` is the policy's own probability, and ``gap`` their distance.

    Semantics:
        exact; wandering for ever is failure. Any policy of greatest probability may be returned:
        ``MCMP`` and ``S3P`` with least failure choose the cheapest. Limited quantities are counted
        until failure is declared: ``give_up`` says where a policy may declare it. With "dead_ends"
        they are counted until the goal is reached or unreachable. If nothing is counted after
        that, this is the query ``multi(Pmax=? [F "goal"], R<=b [C])`` of Storm and PRISM, whose
        ``[C]`` counts over the whole run.

    Reference:
        Kolobov, Mausam, Weld and Geffner, 2011; paper, section 2.3.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        give_up: where a policy may give up: "anywhere", "attention" (the paper) or "dead_ends". The
            argument matters only if there are constraints.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        box: intervals of the probabilities; the worst case over all of them counts.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the greatest probability as ``objective``, a certified
        ``upper_bound``, and one deterministic stationary policy.

    Raises:
        ModelError: an unknown start or ``give_up``.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "wait": [(1.0, "road", 0.0)]}, "ditch": {}},
        ...     goal={"home"}, dead_ends={"ditch"})
        >>> problem = MaxProb(model, start="road")
        >>> solve(problem).objective, sorted(problem.dead_ends)
        (0.9, ['ditch'])
    """

    model: SSP
    start: Start
    give_up: str | GiveUp = GiveUp.ATTENTION
    box: Boxes | None = field(default=None, kw_only=True)

    aim = Aim.GREATEST_GOAL

    @property
    def dead_ends(self) -> frozenset[Hashable]:
        """Dead-ends, where MAXPROB is 0: no policy reaches the goal, X_{d,all}."""
        return dead_end_labels(self.model)
