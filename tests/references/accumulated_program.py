"""Criteria of the law of success costs within a budget, by explicit linear programs.

The unknowns are the expected visits of the product of states and accumulated cost (layers 0, ...,
layers - 1) and of what lies beyond it. Failing for real is possible in attention states: a column
without successors, which stands for staying for ever as well. A free cycle can carry circulation,
which earns nothing and so does no harm. Beyond the layers there is one column for each way to go
on, with its success and its worth.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, hstack, vstack

from references import s3p
from references.accumulated import Start
from references.chain import PlainModel, State, policies, start_distribution
from references.linear_program import least

Node = tuple[State, int]
Ways = list[tuple[float, float]]
"""Ways to go on from (state, cost) beyond the layers: success, worth."""

LEVEL_ROUNDING = 1e-9
"""A conditional probability this near to the level counts as equal to it: HiGHS is right to 1e-10,
magnified by the price of the budget."""


@dataclass(frozen=True)
class Program:
    """The product's occupation polytope: flow @ x = start, x >= 0, with two coefficient rows."""

    flow: csr_array  # [nodes, columns]
    start: np.ndarray  # [nodes]
    success: np.ndarray  # [columns]
    worth: np.ndarray  # [columns]
    start_success: float
    start_worth: float


def program(
    model: PlainModel,
    start: Start,
    layers: int,
    arrival: Callable[[int], float],
    beyond: Callable[[State, int], Ways],
) -> Program:
    """Write out the product; `arrival(cost)` is the worth of arriving at the goal at that cost."""
    begin = start_distribution(start)
    order: list[Node] = [(s, 0) for s in begin if s not in model.goals]
    row = {node: k for k, node in enumerate(order)}
    columns: list[tuple[float, float]] = []
    entries: list[tuple[int, int, float]] = []
    for node in order:
        for onward, success, worth in _columns(model, node, layers, arrival, beyond):
            entries.append((row[node], len(columns), 1.0))
            for successor, p in onward:
                if successor not in row:
                    row[successor] = len(order)
                    order.append(successor)
                entries.append((row[successor], len(columns), -p))
            columns.append((success, worth))
    at_goal = sum(mass for s, mass in begin.items() if s in model.goals)
    table = np.array(columns).reshape(-1, 2)
    rows, cols, data = np.array(entries).reshape(-1, 3).T
    return Program(
        coo_array((data, (rows.astype(int), cols.astype(int))), (len(order), len(table))).tocsr(),
        np.array([begin[s] if spent == 0 and s in begin else 0.0 for s, spent in order]),
        table[:, 0],
        table[:, 1],
        at_goal,
        at_goal * arrival(0),
    )


def _columns(model, node, layers, arrival, beyond):
    """The columns of a node: (probability mass of successor nodes, success, worth)."""
    state, spent = node
    if state in model.attention:
        yield [], 0.0, 0.0
    if state in model.dead_ends:
        return
    if spent >= layers:
        yield from (([], success, worth) for success, worth in beyond(state, spent))
        return
    for outcomes in model.choices[state].values():
        home = [(p, spent + int(cost)) for p, s, cost in outcomes if s in model.goals]
        onward = [((s, spent + int(cost)), p) for p, s, cost in outcomes if s not in model.goals]
        yield onward, sum(p for p, _ in home), sum(p * arrival(cost) for p, cost in home)


def greatest(data: Program, budget: float) -> float:
    """The greatest worth whose failure is within the budget (which must leave some slack)."""
    value = least(
        -data.worth,
        A_ub=-data.success[None, :],
        b_ub=[budget - 1.0 + data.start_success],
        A_eq=data.flow,
        b_eq=data.start,
    )
    return data.start_worth - value


def least_ratio(data: Program, budget: float) -> float:
    """The least worth / success within the budget, by Charnes and Cooper's scaling."""
    flow = hstack([data.flow, coo_array(-data.start[:, None])])
    success = np.append(data.success, data.start_success)
    return least(
        np.append(data.worth, data.start_worth),
        A_ub=np.append(-data.success, 1.0 - budget - data.start_success)[None, :],
        b_ub=[0.0],
        A_eq=vstack([flow, coo_array(success[None, :])]).tocsr(),
        b_eq=np.append(np.zeros(flow.shape[0]), 1.0),
    )


def _extremes(model: PlainModel) -> dict[State, tuple[float, float]]:
    """The least and the greatest goal probability from each state."""
    return {s: s3p.goal_probability_range(model, s) for s in model.choices}


def reach_within(model: PlainModel, start: Start, bound: int, budget: float) -> float:
    """Max Pr(goal at cost <= bound) within the budget; beyond the bound success alone counts."""
    extremes = _extremes(model)
    return greatest(
        program(
            model,
            start,
            bound + 1,
            lambda cost: float(cost <= bound),
            lambda state, _: [(extremes[state][1], 0.0)],
        ),
        budget,
    )


def quantile(model: PlainModel, start: Start, level: float, budget: float) -> int:
    """The least B with max Pr(C <= B | goal) >= level within the budget.

    The maximum grows with B. It is enough at the quantile of any policy within the budget, so
    doubling B ends, for a level below 1; bisection finds the least.
    """
    extremes = _extremes(model)

    def reaches(bound: int) -> bool:
        data = program(
            model,
            start,
            bound + 1,
            lambda cost: -float(cost <= bound),
            lambda state, _: [(p, 0.0) for p in extremes[state]],
        )
        return -least_ratio(data, budget) >= level - LEVEL_ROUNDING

    low, high = -1, 0
    while not reaches(high):
        low, high = high, 2 * high + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if reaches(middle) else (middle, high)
    return high


def conditional_value_at_risk(
    model: PlainModel,
    start: Start,
    level: float,
    budget: float,
    *,
    tolerance: float = 1e-8,
    margins: tuple[int, ...] = (8, 32, 128),
) -> tuple[float, float]:
    """Lower and upper bound of the least z + E[(C - z)^+ | goal] / (1 - level) over integers z.

    For a fixed policy its quantile is a best z, so integers are enough, none greater than the
    optimum. For each z the layers go a margin beyond it; there the excess is linear in the cost,
    and the tail plays a stationary policy (upper bound), or arrives at no further cost (lower). The
    margin grows until the two optima meet.
    """
    ways = {s: _stationary(model, s) for s in model.choices}
    low, high = 0.0, np.inf
    for margin in margins:
        low = high = np.inf
        z = 0
        while z <= high:
            low = min(low, least_ratio(_excess(model, start, level, z, margin, ways, 0.0), budget))
            high = min(
                high, least_ratio(_excess(model, start, level, z, margin, ways, 1.0), budget)
            )
            z += 1
        if high - low <= tolerance * max(1.0, high):
            break
    return low, high


def _excess(model, start, level, z, margin, ways, onward) -> Program:
    """The program of one z; `onward` is 1 or 0: whether going on beyond the layers costs."""

    def beyond(state: State, spent: int) -> Ways:
        """Of the stationary policies of a state, success and worth."""
        tail = {(p, z * p + ((spent - z) * p + onward * c) / (1 - level)) for p, c in ways[state]}
        return sorted(tail)

    return program(model, start, z + margin, lambda c: z + max(c - z, 0) / (1 - level), beyond)


def _stationary(model: PlainModel, state: State) -> Ways:
    """(success, cost on success) from one state, of every stationary policy."""
    found = set()
    for policy in policies(model, [state], lambda s: list(model.choices[s])):
        weight, cost = s3p.values(model, policy, None)
        found.add((round(weight.get(state, 0.0), 14), round(cost.get(state, 0.0), 14)))
    return sorted(found)
