"""The measures of a policy that remembers its cost, by one sweep over its layers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from ssp_lp.analysis.layers.layer_moves import ENDLESS, FAILS, WRONG, LayerMoves
from ssp_lp.analysis.layers.layer_sweep import Column, LayerSweep
from ssp_lp.analysis.quantity_values import complement, state_give_up_charges
from ssp_lp.arrays import FloatArray
from ssp_lp.model.graph.reachability import dead_ends, end_marks
from ssp_lp.policies.policy import GIVE_UP_CODE, Policy
from ssp_lp.problem import Problem, conditions_of, objective_of
from ssp_lp.processes.expectations import cost_means
from ssp_lp.processes.failure_semantics import GiveUp, dead_end_charges, survival_of

LARGE = 300_000
"""Nodes, states times layers, above which a chain is not written out."""


GOAL, FAILED, SUCCESS_COST, STOPPED = range(4)


@dataclass(frozen=True)
class Measures:
    """Quantities of a policy that are linear in the start lottery."""

    goal: float
    failure: float  # 1 - goal, summed from its own exits
    success_cost: float
    expected_cost: float
    discounted_goal: float  # E[gamma^T; goal]
    discounted_failure: float  # 1 - that, likewise
    discounted_cost: float  # case M: discounted E[r_tau]; case S: E[gamma^(T - 1) r_T; goal]
    ends: Mapping[str, float]
    secondary: Mapping[str, float]  # discounted like the cost


def mean_of(parts: list[Measures], weights: FloatArray) -> Measures:
    """Mean of measures over a lottery; an infinite cost of weight 0 does not count."""
    used = [(p, float(w)) for p, w in zip(parts, weights, strict=True) if w > 0]
    scalars = {
        f.name: sum(w * getattr(p, f.name) for p, w in used)
        for f in fields(Measures)
        if f.name not in ("ends", "secondary")
    }
    names = list(dict.fromkeys(name for p, _ in used for name in p.ends))
    return Measures(
        **scalars,
        ends={n: sum(w * p.ends.get(n, 0.0) for p, w in used) for n in names},
        secondary={n: sum(w * p.secondary[n] for p, w in used) for n in used[0][0].secondary},
    )


def layered_measures(
    policy: Policy, problem: Problem, start: FloatArray, least_nodes: int = LARGE
) -> Measures | None:
    """The measures of a policy; None where its chain is to be written out.

    That is where it is small, where the policy remembers something else than its cost, where
    quantities beside the cost are asked for, or where a decision is missing or not allowed,
    which the written-out chain names.

    Args:
        policy: on the problem's model.
        problem: says the semantics and the discount.
        start: distribution over states, [states].
        least_nodes: states times layers from which a policy is not written out.
    """
    layers = policy.layers()
    if layers is None or layers.count * problem.model.n_states < least_nodes:
        return None
    if conditions_of(problem) or objective_of(problem) is not None:
        return None
    quits = any((part == GIVE_UP_CODE).any() for part in (layers.decision, layers.tails))
    charge, semantics = state_give_up_charges(problem.model, problem.semantics), problem.semantics
    columns, names = _measured_columns(problem, np.where(np.isinf(charge), 0.0, charge), quits)
    moves, begins = LayerMoves(problem.model, layers), np.flatnonzero(start)
    sweep = LayerSweep(moves, tuple(columns), np.isinf(charge), semantics.forbids_failing)
    totals, marks = sweep.at_start(begins)
    found = int(np.bitwise_or.reduce(marks))
    if found & WRONG:
        return None
    # the measures from the totals of ``_measured_columns`` at the start, and what may be met
    total = (start[begins] @ totals).tolist()
    later = len(total) - 4 if problem.discount is not None else 0  # where the discounted begin
    goal, failure = _both_measures(total[GOAL], total[FAILED])
    kept, surrogate = _both_measures(total[later + GOAL], total[later + FAILED])
    stopped = float("inf") if found & (ENDLESS | FAILS) else total[STOPPED]
    endless = found & (FAILS if later else ENDLESS | FAILS)
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


def _measured_columns(
    problem: Problem, charge: FloatArray, gives_up: bool
) -> tuple[list[Column], list[str]]:
    """What is totalled: the first four undiscounted, then by end, then discounted.

    Args:
        problem: it limits nothing but failure.
        charge: of giving up, [states].
        gives_up: whether the policy does so anywhere.

    Returns:
        The columns, and the names of the ends that may occur, but the goal.
    """
    model, semantics = problem.model, problem.semantics
    goal, dead = model.goal_mask.astype(np.float64), dead_ends(model).astype(np.float64)
    entering = dead_end_charges(model, dead_ends(model), semantics)
    goes_on, stage = semantics.give_up is GiveUp.DEAD_ENDS, cost_means(model)

    def four(survival: float, first: int) -> list[Column]:
        """Goal, failure, cost of success and cost until failure."""
        leak = 1.0 - survival
        return [
            Column(goal, survival),
            Column(dead, survival, each=leak, gives_up=survival, lost=1.0),
            Column(0.0 * goal, survival, prices=first + GOAL),
            Column(entering, survival, reward=stage, gives_up=charge, lost=charge,
                   goes_on=goes_on),
        ]  # fmt: skip

    marks, names, ends = end_marks(model), list[str](), list[Column]()
    for number, name in enumerate((*model.state_labels, "dead_end"), start=1):
        if (marks == number).any():
            names.append(name)
            ends.append(Column((marks == number).astype(np.float64), until_lost=False))
    if gives_up:
        names.append("gave_up")
        ends.append(Column(0.0 * goal, until_lost=False, gives_up=1.0))
    found, gamma = four(1.0, 0) + ends, survival_of(problem.discount)
    if gamma < 1.0:
        found += four(gamma, len(found))
    return found, names


def _both_measures(goal: float, failure: float) -> tuple[float, float]:
    """Goal and failure within [0, 1]; none of either where the other is sure."""
    if failure == 0.0:
        return 1.0, 0.0
    return min(goal, 1.0), 1.0 if goal <= 0.0 else min(failure, 1.0)
