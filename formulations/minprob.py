"""MinProb: the least probability of reaching the goal."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

from ssp_lp.formulation import SSP, Aim, Formulation, Start, attention_labels


@dataclass(frozen=True, eq=False)
class MinProb(Formulation):
    """Minimise the probability of reaching the goal; costs do not count (MINPROB).

    Problem:
        min over policies of Pr(the goal is ever reached): the probability that the goal cannot be
        avoided.

    Program:
        minimise <goal, x> subject to flow balance, x >= 0, where mass may leave for good at the
        attention states, in which the goal can be avoided for ever.

    Guarantee:
        one deterministic stationary policy attains the least probability from every state.
        ``lower_bound`` comes from a checked sub-solution of the optimality equations.

    Semantics:
        exact; a run that wanders for ever does not reach the goal. At an attention state that is
        not a dead-end the policy gives up; ``acting_everywhere`` extends it by actions that avoid
        the goal.

    Reference:
        paper, section 2.3.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        constraints: name -> constraint on a quantity; see ``Formulation``.
        horizon: greatest number of steps to the goal; a longer episode fails; None: unlimited.

    Returns:
        the problem; its solution has the least probability as ``objective``, a certified
        ``lower_bound``, and one deterministic stationary policy.

    Raises:
        ModelError: an unknown start.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.5, "home", 1.0), (0.5, "inn", 1.0)]},
        ...      "inn": {"stay": [(1.0, "inn", 1.0)], "leave": [(1.0, "home", 1.0)]}},
        ...     goal={"home"})
        >>> problem = MinProb(model, start="road")
        >>> solve(problem).objective, sorted(problem.attention_states)
        (0.5, ['inn'])
    """

    model: SSP
    start: Start

    aim = Aim.LEAST_GOAL

    @property
    def attention_states(self) -> frozenset[Hashable]:
        """Attention states, where MINPROB is 0: some policy surely avoids the goal, X_{d,or}."""
        return attention_labels(self.model)
