"""C-SSP by enumeration: every policy's cost, failure and secondary costs, and the best lottery.

A secondary cost is the cost of the same model with other costs on its outcomes, so each policy is
evaluated once for every cost, by dense solves of its own. The optimum over lotteries is a small
linear program with one column per policy.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from references import mcmp
from references.chain import (
    Action,
    PlainModel,
    State,
    plain_model,
    policies,
    start_distribution,
)

Charges = Mapping[State, Mapping[Action, Sequence[float]]]
"""A secondary cost of each outcome of an action, in the order of the outcomes."""

LEAST_ROOM = 1e-9
"""Failures this near to the least one are equal to it: the rest is rounding of the solves."""


class Measured(NamedTuple):
    """One policy."""

    cost: float
    failure: float
    secondary: tuple[float, ...]


def measured(
    choices: Mapping,
    goals: Sequence[State],
    start: State | Mapping[State, float],
    charges: Sequence[Charges],
    *,
    give_up: str = "attention",
    charge_failing_step: bool = True,
    discount: float | None = None,
) -> list[Measured]:
    """All deterministic stationary policies of finite costs; they may give up where it is allowed.

    Under "dead_ends" staying for ever is also allowed where it costs nothing at all, in any cost.
    """
    models = [plain_model(choices, goals)]
    models += [plain_model(priced(choices, charge), goals) for charge in charges]
    begin, found = start_distribution(start), []
    for policy in policies(models[0], begin, mcmp.allowed(models[0], give_up)):
        points = [
            mcmp.evaluate(model, begin, policy, give_up, charge_failing_step, discount)
            for model in models
        ]
        costs = tuple(point.cost for point in points)
        if np.isfinite(costs).all():
            found.append(Measured(costs[0], points[0].failure, costs[1:]))
    return found


def priced(choices: Mapping, charge: Charges) -> dict:
    """The model with a secondary cost in place of its own."""
    return {
        state: {
            action: [
                (p, successor, other)
                for (p, successor, _), other in zip(outcomes, charge[state][action], strict=True)
            ]
            for action, outcomes in actions.items()
        }
        for state, actions in choices.items()
    }


def of_least_failure(
    model: PlainModel, start: State | Mapping[State, float], every: Sequence[Measured]
) -> list[Measured]:
    """The policies of least failure."""
    least = min(point.failure for point in mcmp.points(model, start, give_up="dead_ends"))
    return [one for one in every if one.failure <= least + LEAST_ROOM]


def best_lottery(
    every: Sequence[Measured], budget: float | None, bounds: Sequence[float]
) -> float | None:
    """Least cost of a lottery within the budget (None: no budget) and the bounds; None: none."""
    cost = np.array([one.cost for one in every])
    rows, right = limits(every, budget, bounds)
    limited = {"A_ub": np.array(rows), "b_ub": np.array(right)} if rows else {}
    answer = linprog(cost, A_eq=np.ones((1, len(cost))), b_eq=[1.0], method="highs", **limited)
    return float(answer.fun) if answer.status == 0 else None


def limits(
    every: Sequence[Measured], budget: float | None, bounds: Sequence[float]
) -> tuple[list[list[float]], list[float]]:
    """The rows of both programs over lotteries, and their right-hand sides."""
    rows = [[one.secondary[k] for one in every] for k in range(len(bounds))]
    if budget is None:
        return rows, list(bounds)
    return [*rows, [one.failure for one in every]], [*bounds, budget]


def least_total(every: Sequence[Measured], row: int) -> float:
    """The least of a secondary cost over the policies."""
    return min(one.secondary[row] for one in every)


def least_excess(every: Sequence[Measured], budget: float | None, bounds: Sequence[float]) -> float:
    """The least sum of violations of the rows by a lottery."""
    rows, right = limits(every, budget, bounds)
    n, count = len(every), len(right)
    answer = linprog(
        np.append(np.zeros(n), np.ones(count)),
        A_ub=np.hstack([np.array(rows).reshape(count, n), -np.eye(count)]),
        b_ub=np.array(right),
        A_eq=np.append(np.ones(n), np.zeros(count))[None, :],
        b_eq=[1.0],
        method="highs",
    )
    return float(answer.fun)
