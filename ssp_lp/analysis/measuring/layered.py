"""The measures of a policy that remembers its cost, by one sweep over its layers."""

from __future__ import annotations

import numpy as np

from ssp_lp.analysis.measuring.columns import FAILED, GOAL, STOPPED, SUCCESS_COST, columns_of
from ssp_lp.analysis.measuring.marks import ENDLESS, FAILS, WRONG
from ssp_lp.analysis.measuring.measures import Measures
from ssp_lp.analysis.measuring.moves import Moves
from ssp_lp.analysis.measuring.sweep import Sweep, Values
from ssp_lp.analysis.quantity_values import complement
from ssp_lp.arrays import FloatArray
from ssp_lp.policies.policy import GIVE_UP_CODE, Policy
from ssp_lp.problem import Problem, conditions_of, objective_of

LARGE = 300_000
"""Nodes, states times layers, above which a chain is not written out."""


class LayeredMeasures:
    """The measures of one policy after another; tails that they share are totalled once. Grows."""

    def __init__(self, problem: Problem, start: FloatArray, least_nodes: int = LARGE) -> None:
        """Nothing is known yet.

        Args:
            problem: says the semantics and the discount.
            start: distribution over states, [states].
            least_nodes: states times layers from which a policy is not written out.
        """
        self._problem, self._begins, self._least = problem, np.flatnonzero(start), least_nodes
        self._weights = start[self._begins]
        self._tails: dict[tuple[str, ...], dict[bytes, Values]] = {}

    def of(self, policy: Policy) -> Measures | None:
        """The measures of a policy; None where its chain is to be written out.

        That is where it is small, where the policy remembers something else than its cost, where
        quantities beside the cost are asked for, or where a decision is missing or not allowed,
        which the written-out chain names.
        """
        problem, layers = self._problem, policy.layers()
        if layers is None or layers.count * problem.model.n_states < self._least:
            return None
        if conditions_of(problem) or objective_of(problem) is not None:
            return None
        quits = any((part == GIVE_UP_CODE).any() for part in (layers.decision, layers.tails))
        asked = columns_of(problem, gives_up=quits)
        tails = self._tails.setdefault(asked.names, {})
        found = Sweep(Moves(problem.model, layers), asked, tails).at_start()
        marks = int(np.bitwise_or.reduce(found.marks[self._begins]))
        if marks & WRONG:
            return None
        total = (self._weights @ found.totals[self._begins]).tolist()
        return _measures(problem, asked.names, total, marks)


def _measures(problem: Problem, names: tuple[str, ...], total: list[float], marks: int) -> Measures:
    """The measures from the totals of ``columns_of`` at the start, and what may be met."""
    later = len(total) - 4 if problem.discount is not None else 0  # where the discounted begin
    goal, failure = _both(total[GOAL], total[FAILED])
    kept, surrogate = _both(total[later + GOAL], total[later + FAILED])
    stopped = float("inf") if marks & (ENDLESS | FAILS) else total[STOPPED]
    endless = marks & (FAILS if later else ENDLESS | FAILS)
    target = float("inf") if endless else total[later + STOPPED]
    ends = dict.fromkeys(["goal", *problem.model.state_labels, "dead_end", "gave_up"], 0.0)
    ends |= {"goal": total[GOAL]} | dict(zip(names, total[4:], strict=False))
    return Measures(
        goal=goal,
        failure=failure,
        success_cost=total[SUCCESS_COST],
        expected_cost=stopped,
        discounted_goal=kept,
        discounted_failure=surrogate,
        discounted_cost=total[later + SUCCESS_COST] if problem.ratio else target,
        ends=ends | {"wandering": complement(sum(ends.values()))},
        secondary={},
    )


def _both(goal: float, failure: float) -> tuple[float, float]:
    """Goal and failure within [0, 1]; none of either where the other is sure."""
    if failure == 0.0:
        return 1.0, 0.0
    return min(goal, 1.0), 1.0 if goal <= 0.0 else min(failure, 1.0)
