"""Case M as an explicit occupation-measure program, for models too large to enumerate.

One column per state-action pair, one for giving up where the semantics allow it, and one for
wandering at no cost wherever that is possible: in the greatest set of states each of which has an
action that costs nothing and stays in the set.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, lil_array

from references.chain import Outcome, PlainModel, State, start_distribution
from references.linear_program import least
from references.mcmp import charge


@dataclass(frozen=True)
class Program:
    """flow @ x = start, x >= 0, with a cost and a failure coefficient per column."""

    flow: csr_array  # [live states, columns]
    start: np.ndarray  # [live states]
    cost: np.ndarray  # [columns]
    failure: np.ndarray  # [columns]
    start_cost: float
    start_failure: float


def program(
    model: PlainModel,
    start: State | Mapping[State, float],
    *,
    give_up: str,
    charge_failing_step: bool,
    discount: float | None = None,
) -> Program:
    """Write the program out."""
    gamma = 1.0 if discount is None else discount
    dead = {s: charge(model, s, give_up) * charge_failing_step for s in model.dead_ends}
    live = [s for s in model.choices if s not in model.dead_ends]
    row = {s: k for k, s in enumerate(live)}
    columns: list[tuple[State, list[Outcome], float, float]] = []
    for state in live:
        for action, outcomes in model.choices[state].items():
            lost = sum(p for p, s, _ in outcomes if s in dead)
            paid = sum(p * gamma * dead.get(s, 0.0) for p, s, _ in outcomes)
            cost = model.mean_cost(state, action) + paid
            columns.append((state, outcomes, cost, 1.0 - gamma + gamma * lost))
        if give_up == "anywhere" or (give_up == "attention" and state in model.attention):
            columns.append((state, [], charge(model, state, give_up) * charge_failing_step, 1.0))
    columns += [(state, [], 0.0, 1.0) for state in free_wandering(model)]
    flow = lil_array((len(live), len(columns)))
    for k, (state, outcomes, _, _) in enumerate(columns):
        flow[row[state], k] += 1.0
        for p, successor, _ in outcomes:
            if successor in row:
                flow[row[successor], k] -= gamma * p
    begin = start_distribution(start)
    return Program(
        flow=csr_array(flow),
        start=np.array([begin.get(s, 0.0) for s in live]),
        cost=np.array([cost for _, _, cost, _ in columns]),
        failure=np.array([failure for _, _, _, failure in columns]),
        start_cost=sum(mass * dead.get(s, 0.0) for s, mass in begin.items()),
        start_failure=sum(mass for s, mass in begin.items() if s in dead),
    )


def free_wandering(model: PlainModel) -> set[State]:
    """Live states from which one can wander for ever at no cost."""
    inside = set(model.choices) - model.dead_ends

    def stays(outcomes: list[Outcome]) -> bool:
        return all(cost == 0 and successor in inside for _, successor, cost in outcomes)

    while True:
        leaving = {s for s in inside if not any(map(stays, model.choices[s].values()))}
        if not leaving:
            return inside
        inside -= leaving


def least_failure(data: Program) -> float:
    """The least failure of any policy."""
    return least(data.failure, **_rows(data)) + data.start_failure


def least_cost(data: Program, budget: float) -> float:
    """The least cost within the budget (which must leave some slack)."""
    row = {"A_ub": data.failure[None, :], "b_ub": [budget - data.start_failure]}
    return least(data.cost, **_rows(data), **row) + data.start_cost


def least_priced(data: Program, price: float) -> float:
    """The least cost + price * failure of any policy."""
    at_start = data.start_cost + price * data.start_failure
    return least(data.cost + price * data.failure, **_rows(data)) + at_start


def _rows(data: Program) -> dict[str, object]:
    """The flow balance, as `linprog` wants it."""
    return {"A_eq": data.flow, "b_eq": data.start}
