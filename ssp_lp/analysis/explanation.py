"""Reasons for an action of a solution: a state's actions compared at the optimal prices."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.dynamic_programming.dynamics import leaving_choice
from ssp_lp.errors import ModelError
from ssp_lp.model.report import Report, Table
from ssp_lp.policies.policy import MixedPolicy, Policy
from ssp_lp.programs.occupation_measure import ROUNDING, StateValues, nearer_to_leaving

if TYPE_CHECKING:
    from ssp_lp.programs.occupation_program import OccupationProgram


class ActionValue(NamedTuple):
    """An action of the explained state, with the expected amounts that follow it."""

    action: Hashable  # of the model, ``GIVE_UP`` or "stay for ever"
    share: float  # probability of the action in the solution; nan in a state that it never reaches
    amounts: tuple[float, ...]  # of each quantity in ``Explanation.quantities``
    value: float  # the amounts weighted by ``Explanation.weights``
    excess: float  # value minus the least value of the state's actions


@dataclass(frozen=True, repr=False)
class Explanation(Report):
    """The actions of a state, the best first.

    The value of an action is the expected cost plus, for each row of the program, price times
    amount, if the action is taken once and a policy that is optimal at the optimal prices is
    followed after that. In case S, c* times the goal probability is subtracted. An action with
    excess 0 is optimal. A lottery mixes policies that take different optimal actions.
    """

    state: Hashable
    cost_paid: float | None  # before, in case S; None if the total cost does not matter
    quantities: tuple[str, ...]  # "cost", "goal" in case S, "failure", then each other row
    weights: tuple[float, ...]  # 1, -c* for the goal, the price of each row; 0 without a price
    actions: tuple[ActionValue, ...]

    def tables(self) -> list[Table]:
        """Return a table with a row for each action; its title has the weights."""
        paid = "" if self.cost_paid is None else f" after a cost of {self.cost_paid:g}"
        terms = [
            f"{'-' if weight < 0.0 else '+'} {abs(weight):.6g} x {name}"
            for name, weight in zip(self.quantities[1:], self.weights[1:], strict=True)
            if weight
        ]
        return [
            Table(
                [(a.action, a.share, *a.amounts, a.value, a.excess) for a in self.actions],
                ["action", "taken", *self.quantities, "value", "excess"],
                " ".join([f"{self.state}{paid}: value =", self.quantities[0], *terms]),
                digits={"taken": 4},
            )
        ]


def explanation(
    values: StateValues,
    prices: Mapping[str, float],
    ratio: float,
    policy: Policy | MixedPolicy,
    state: Hashable,
    cost_paid: float | None = None,
) -> Explanation:
    """Explain the actions of a state by the state values of the problem's program.

    Args:
        values: state values at the optimal prices.
        prices: prices of the rows, by name.
        ratio: c* in case S.
        policy: randomised policy equivalent to the solution.
        state: state of the model, or of the product that is solved.
        cost_paid: in case S, one of the program's totals; None: the least of them.

    Raises:
        ModelError: the program has no such state, or not at this cost.
    """
    program, process = values.program, values.program.process
    labels = {column: program.label(column) for column in program.columns(state)}
    costs = sorted({label.cost for label in labels.values() if label.cost is not None})
    total = next(iter(costs), None) if cost_paid is None else cost_paid
    columns = np.array([k for k, label in labels.items() if label.cost == total], dtype=np.int64)
    if len(np.unique(process.pair_state[columns])) != 1:
        if not labels:
            raise ModelError(
                f"the solution has no decision in {state!r}: it is a goal, a dead-end, or "
                "out of reach from the start"
            )
        some = [f"{label.state!r}{label.paid}" for label in labels.values()]
        there = " or ".join(dict.fromkeys(some[:3]))
        raise ModelError(
            f"there are several decisions, or none, in {state!r} at cost {total}: ask for {there}"
        )
    names, weights, rewards = zip(*_counted_quantities(program, prices, ratio), strict=True)
    amounts = _following(values, np.stack(rewards))[:, columns]
    worth = np.array(weights) @ amounts
    excess = worth - worth.min()
    excess[excess <= ROUNDING * np.abs(worth).max()] = 0.0  # rounding
    shares = {
        row.action: row.probability
        for row in policy.table()
        if row.state == state and (total is None or row.memory == total)
    }
    actions = [
        ActionValue(
            labels[column].action,
            shares.get(labels[column].action, 0.0) if shares else float("nan"),
            tuple(amounts[:, k].tolist()),
            float(worth[k]),
            float(excess[k]),
        )
        for k, column in enumerate(columns.tolist())
    ]
    best_first = tuple(sorted(actions, key=lambda action: action.excess))
    return Explanation(state, total, names, weights, best_first)


def _counted_quantities(
    program: OccupationProgram, prices: Mapping[str, float], ratio: float
) -> list[tuple[str, float, FloatArray]]:
    """Return the quantities whose weighted sum is the value of an action.

    They are the objective, in case S the goal, failure, and each other row of the program. Each has
    its name, weight, and amount of each pair, [pairs].
    """
    process = program.process
    counted = [(program.objective, 1.0, process.cost)]
    if program.ratio:
        counted.append(("goal", -ratio, process.goal))
    rows = {row.name: row.coefficients for row in program.rows}
    for name, coefficients in {"failure": process.failure, **rows}.items():
        if name != program.objective:
            counted.append((name, prices.get(name, 0.0), coefficients))
    return counted


def _following(values: StateValues, rewards: FloatArray) -> FloatArray:
    """Return the expected amount of each quantity after taking a pair once, [quantities, pairs].

    A policy that is optimal at the optimal prices is followed after that.

    Args:
        values: state values at the optimal prices.
        rewards: amount of each quantity in a step, [quantities, pairs].
    """
    process, size = values.program.process, float(np.abs(values.states).max(initial=0.0))
    tight = values.reduced_costs <= ROUNDING * max(size, 1.0)
    leaving = leaving_choice(process.dynamics, process.goal)
    choice = nearer_to_leaving(process, tight, leaving)
    after = process.dynamics.chain(choice).solve(np.ascontiguousarray(rewards[:, choice].T))
    return np.asarray(rewards + (process.transitions @ after).T)
