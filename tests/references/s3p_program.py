"""Criteria of what successful runs cost, by linear programs over states and accumulated cost.

The unknowns are the expected visits of (state, cost paid) below a horizon of costs. Failing for
real is possible in attention states: a column without successors, which stands for staying for ever
as well. A free cycle can carry circulation, which earns nothing and so does no harm. Beyond the
horizon there is one column for each way to go on, with its success and its worth: real policies
bound a least worth from above, to arrive at no further cost bounds it from below.

With a discount gamma success is E[gamma^T; goal], and the cost on success E[gamma^(T-1) C; goal].
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, exp

import numpy as np
from scipy.sparse import coo_array, csr_array, hstack, vstack

from references.chain import PlainModel, State, policies, start_distribution
from references.linear_program import least
from references.s3p import Start, values

Ways = list[tuple[float, float]]
"""Ways to go on from (state, cost) beyond the horizon: success, worth."""

LEVEL_ROUNDING = 1e-9
"""A conditional probability this near to the level counts as equal to it: HiGHS is right to 1e-10,
magnified by the price of the budget."""
SAME = 1e-11
"""Probabilities nearer than this are one number computed twice."""
VANISHED = 36.0
"""exp(-36) = 2e-16: utilities beyond this exponent are below rounding."""


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
    horizon: int,
    arrival: Callable[[int], float],
    beyond: Callable[[State, int], Ways],
    discount: float | None = None,
) -> Program:
    """Write out the product; `arrival(cost)` is the worth of arriving at the goal at that cost."""
    begin, gamma = start_distribution(start), 1.0 if discount is None else discount
    order = [(state, 0) for state in begin if state not in model.goals]
    row = {node: k for k, node in enumerate(order)}
    columns: list[tuple[float, float]] = []
    entries: list[tuple[int, int, float]] = []
    for node in order:
        state, spent = node
        listed: list[tuple[list, float, float]] = []  # where a column leads, success, worth
        if state in model.attention:
            listed.append(([], 0.0, 0.0))
        if spent >= horizon and state not in model.dead_ends:
            listed += [([], success, worth) for success, worth in beyond(state, spent)]
        elif state not in model.dead_ends:
            for outcomes in model.choices[state].values():
                home = [(p, spent + int(c)) for p, to, c in outcomes if to in model.goals]
                onward = [((to, spent + int(c)), gamma * p)
                          for p, to, c in outcomes if to not in model.goals]  # fmt: skip
                earned = sum(p * arrival(cost) for p, cost in home)
                listed.append((onward, gamma * sum(p for p, _ in home), earned))
        for onward, success, worth in listed:
            entries.append((row[node], len(columns), 1.0))
            for there, p in onward:
                if there not in row:
                    row[there] = len(order)
                    order.append(there)
                entries.append((row[there], len(columns), -p))
            columns.append((success, worth))
    at_goal = sum(mass for state, mass in begin.items() if state in model.goals)
    table = np.array(columns).reshape(-1, 2)
    rows, cols, data = np.array(entries).reshape(-1, 3).T
    return Program(
        coo_array((data, (rows.astype(int), cols.astype(int))), (len(order), len(table))).tocsr(),
        np.array([begin.get(state, 0.0) * (spent == 0) for state, spent in order]),
        *table.T,
        at_goal,
        at_goal * arrival(0),
    )


def greatest(data: Program, budget: float = 1.0) -> float:
    """The greatest worth whose failure is within the budget (which must leave some slack)."""
    limit = {"A_ub": -data.success[None, :], "b_ub": [budget - 1.0 + data.start_success]}
    limit = limit if budget < 1.0 else {}
    return data.start_worth - least(-data.worth, A_eq=data.flow, b_eq=data.start, **limit)


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


def stationary(model: PlainModel, discount: float | None = None) -> dict[State, Ways]:
    """(success, cost on success) from each state, of every stationary policy; sorted."""
    ways = {}
    for state in model.choices:
        found = set()
        for policy in policies(model, [state], lambda s: list(model.choices[s])):
            weight, cost = values(model, policy, discount)
            found.add((round(weight.get(state, 0.0), 14), round(cost.get(state, 0.0), 14)))
        ways[state] = sorted(found)
    return ways


def linear(ways: dict[State, Ways], discount: float | None = None) -> Callable:
    """Ways beyond a horizon where a cost C on success is worth a + b C, going on at `onward` C."""
    gamma = 1.0 if discount is None else discount

    def beyond(state: State, spent: int, a: float, b: float, onward: float) -> Ways:
        return sorted({(p, a * p + b * (spent * p / gamma + onward * c)) for p, c in ways[state]})

    return beyond


def at_least_failure(model: PlainModel) -> tuple[PlainModel, dict[State, Ways]]:
    """The model with the actions that policies of least failure take, and their stationary ways.

    There is no way to stay.
    """
    best = {state: ways[-1][0] for state, ways in stationary(model).items()}
    best |= dict.fromkeys(model.goals, 1.0)
    kept = {
        state: {
            action: outcomes
            for action, outcomes in actions.items()
            if sum(p * best[to] for p, to, _ in outcomes) >= best[state] - SAME
        }
        for state, actions in model.choices.items()
    }
    must = replace(model, choices=kept, attention=model.dead_ends)
    return must, {
        state: [way for way in ways if way[0] >= best[state] - SAME]
        for state, ways in stationary(must).items()
    }


def ratio_bounds(
    model: PlainModel,
    start: Start,
    budget: float,
    *,
    discount: float | None = None,
    tolerance: float = 1e-8,
    horizons: tuple[int, ...] = (8, 32, 128, 512),
) -> tuple[float, float]:
    """Lower and upper bound of S3P's optimum, from growing horizons until they meet."""
    beyond = linear(stationary(model, discount), discount)
    for horizon in horizons:
        low, high = (
            least_ratio(
                program(model, start, horizon, float,
                        partial(beyond, a=0.0, b=1.0, onward=onward), discount),
                budget,
            )
            for onward in (0.0, 1.0)
        )  # fmt: skip
        if high - low <= tolerance * max(1.0, high):
            break
    return low, high


def price_slack(
    model: PlainModel,
    start: Start,
    budget: float,
    value: float,
    price: float,
    *,
    discount: float | None = None,
    horizon: int = 32,
) -> tuple[float, float]:
    """Bounds of min over policies of cost - value * success + price * (failure - budget).

    The price is an optimal multiplier if and only if this minimum is 0 at the optimal value.
    """
    beyond, slacks = linear(stationary(model, discount), discount), []
    for onward in (0.0, 1.0):
        ways = partial(beyond, a=0.0, b=1.0, onward=onward)
        data = program(model, start, horizon, float, ways, discount)
        net = (value + price) * data.success - data.worth
        gain = greatest(replace(data, worth=net, start_worth=(value + price) * data.start_success))
        slacks.append(price * (1.0 - budget) - gain)
    return slacks[0], slacks[1]


def reach_within(model: PlainModel, start: Start, bound: int, budget: float | None = 1.0) -> float:
    """Max Pr(goal at cost <= bound) within the budget (None: at least failure)."""
    model, ways = at_least_failure(model) if budget is None else (model, stationary(model))
    data = program(model, start, bound + 1, lambda cost: float(cost <= bound),
                   lambda state, _: [(ways[state][-1][0], 0.0)])  # fmt: skip
    return greatest(data, 1.0 if budget is None else budget)


def expected_utility(
    model: PlainModel,
    start: Start,
    utility: Callable[[int], float],
    goal_bonus: float,
    horizon: int,
    at_infinity: float = 0.0,
    limit: float | None = None,
) -> tuple[float, float]:
    """Lower and upper bound of max E[u(C)] + bonus * Pr(goal).

    Beyond the horizon a run that succeeds earns between `limit` (that of u; `at_infinity` unless
    told) and u(horizon).
    """
    most = {state: ways[-1][0] for state, ways in stationary(model).items()}
    low, high = (
        at_infinity
        + greatest(
            program(
                model,
                start,
                horizon,
                lambda cost: utility(cost) - at_infinity + goal_bonus,
                lambda state, _, last=last: [
                    (most[state], (last - at_infinity + goal_bonus) * most[state])
                ],
            )
        )
        for last in (at_infinity if limit is None else limit, utility(horizon))
    )
    return low, high


def exponential_utility(model: PlainModel, start: Start, rate: float, goal_bonus: float) -> float:
    """The optimum of eGUBS, right to about 1e-15 + rounding."""
    horizon = ceil(VANISHED / -rate)
    return expected_utility(model, start, lambda c: exp(rate * c), goal_bonus, horizon)[0]


def quantile(model: PlainModel, start: Start, level: float, budget: float | None) -> int:
    """The least B with max Pr(C <= B | goal) >= level within the budget (None: at least failure).

    The maximum grows with B. It is enough at the quantile of any policy within the budget, so
    doubling B ends, for a level below 1; bisection finds the least.
    """
    model, ways = at_least_failure(model) if budget is None else (model, stationary(model))

    def reaches(bound: int) -> bool:
        data = program(model, start, bound + 1, lambda cost: -float(cost <= bound),
                       lambda state, _: [(ways[state][k][0], 0.0) for k in (0, -1)])  # fmt: skip
        return -least_ratio(data, 1.0 if budget is None else budget) >= level - LEVEL_ROUNDING

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
    budget: float | None,
    *,
    tolerance: float = 1e-8,
    margins: tuple[int, ...] = (8, 32, 128),
) -> tuple[float, float]:
    """Lower and upper bound of the least z + E[(C - z)^+ | goal] / (1 - level) over integers z.

    For a fixed policy its quantile is a best z, so integers are enough, none greater than the
    optimum. For each z the horizon lies a margin beyond it, where the excess is linear in the cost;
    the margin grows until the two optima meet.
    """
    model, tails = at_least_failure(model) if budget is None else (model, stationary(model))
    beyond, rate = linear(tails), 1.0 / (1.0 - level)

    def least_at(z: int, margin: int, onward: float) -> float:
        ways = partial(beyond, a=z - rate * z, b=rate, onward=onward)
        data = program(model, start, z + margin, lambda cost: z + rate * max(cost - z, 0), ways)
        return least_ratio(data, 1.0 if budget is None else budget)

    low = high = np.inf
    for margin in margins:
        low = high = np.inf
        z = 0
        while z <= high:
            low = min(low, least_at(z, margin, 0.0))
            high = min(high, least_at(z, margin, 1.0))
            z += 1
        if high - low <= tolerance * max(1.0, high):
            break
    return low, high
