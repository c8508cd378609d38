"""Case S as an explicit Charnes-Cooper linear program over states and accumulated cost.

The product is written out up to a horizon. Beyond it there are two tails: *restricted* plays one
of the model's stationary policies or fails where it can (real policies, hence an upper bound of
the optimum), *relaxed* arrives at no further cost with any success that some policy can have
(hence a lower bound). Where the two agree the value is exact.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.sparse import coo_array, hstack, vstack

from references.chain import PlainModel, State, policies, start_distribution
from references.linear_program import least
from references.s3p import Start, values

Node = tuple[State, int]


@dataclass(frozen=True)
class Program:
    """The product's occupation polytope: flow @ x = start, x >= 0, with two coefficient rows."""

    flow: coo_array  # [nodes, columns]
    start: np.ndarray  # [nodes]
    success: np.ndarray  # [columns]
    cost: np.ndarray  # [columns], cost on success
    start_at_goal: float


@dataclass(frozen=True)
class _Column:
    """One state-action pair of the product: where it leaves, goes, and what it earns."""

    node: Node
    successors: dict[Node, float]
    success: float
    cost: float


def program(
    model: PlainModel,
    start: Start,
    horizon: int,
    *,
    discount: float | None = None,
    relaxed: bool = False,
) -> Program:
    """Write out the product up to accumulated cost `horizon`, with one of the two tails."""
    gamma = 1.0 if discount is None else discount
    begin = start_distribution(start)
    ends = cache(lambda state: _stationary(model, state, discount))
    columns: list[_Column] = []
    order: list[Node] = [(s, 0) for s in begin if s not in model.goals]
    seen = set(order)
    for node in order:
        new = list(_columns(model, node, gamma, horizon, ends, relaxed))
        columns += new
        fresh = [n for n in dict.fromkeys(n for c in new for n in c.successors) if n not in seen]
        seen.update(fresh)
        order += fresh
    index = {node: row for row, node in enumerate(order)}
    entries = [(index[c.node], k, 1.0) for k, c in enumerate(columns)]
    entries += [(index[n], k, -p) for k, c in enumerate(columns) for n, p in c.successors.items()]
    rows, cols, data = (
        (np.array(part) for part in zip(*entries, strict=True)) if entries else 3 * [np.array([])]
    )
    return Program(
        coo_array((data, (rows, cols)), shape=(len(order), len(columns))),
        np.array([begin.get(s, 0.0) if spent == 0 else 0.0 for s, spent in order]),
        np.array([c.success for c in columns]),
        np.array([c.cost for c in columns]),
        sum(mass for s, mass in begin.items() if s in model.goals),
    )


def _stationary(
    model: PlainModel, state: State, discount: float | None
) -> list[tuple[float, float]]:
    """(success, cost on success) from one state, of every stationary policy."""
    found = set()
    for policy in policies(model, [state], lambda s: list(model.choices[s])):
        weight, cost = values(model, policy, discount)
        found.add((weight.get(state, 0.0), cost.get(state, 0.0)))
    return sorted(found)


def _columns(
    model: PlainModel,
    node: Node,
    gamma: float,
    horizon: int,
    ends: Callable[[State], list[tuple[float, float]]],
    relaxed: bool,
) -> Iterator[_Column]:
    """The columns of a node: fail if it can, then its actions or, beyond the horizon, a tail."""
    state, spent = node
    if state in model.attention:
        yield _Column(node, {}, 0.0, 0.0)
    if state in model.dead_ends:
        return
    if spent < horizon:
        for outcomes in model.choices[state].values():
            yield _step(model, node, gamma, outcomes)
    elif relaxed:
        for success in (ends(state)[0][0], ends(state)[-1][0]):
            yield _Column(node, {}, success, spent * success / gamma)
    else:
        for success, cost in ends(state):
            yield _Column(node, {}, success, spent * success / gamma + cost)


def _step(model: PlainModel, node: Node, gamma: float, outcomes: list) -> _Column:
    """One ordinary action: mass to the next layers, and what arrives at the goal."""
    spent = node[1]
    onward: dict[Node, float] = {}
    success = paid = 0.0
    for p, successor, cost in outcomes:
        if successor in model.goals:
            success += gamma * p
            paid += p * (spent + int(cost))
        else:
            target = (successor, spent + int(cost))
            onward[target] = onward.get(target, 0.0) + gamma * p
    return _Column(node, onward, success, paid)


def least_ratio(data: Program, budget: float) -> float:
    """Least cost on success over success, within the budget (which must leave some slack)."""
    scale = coo_array(-data.start[:, None])
    flow = hstack([data.flow, scale])
    normal = coo_array(np.append(data.success, data.start_at_goal)[None, :])
    limit = np.append(-data.success, 1.0 - budget - data.start_at_goal)
    return least(
        np.append(data.cost, 0.0),
        A_ub=limit[None, :],
        b_ub=[0.0],
        A_eq=vstack([flow, normal]).tocsr(),
        b_eq=np.append(np.zeros(flow.shape[0]), 1.0),
    )


def least_difference(data: Program, worth: float) -> float:
    """Least (cost on success) - worth * success over all policies, without any budget."""
    reduced = data.cost - worth * data.success
    value = least(reduced, A_eq=data.flow.tocsr(), b_eq=data.start)
    return value - worth * data.start_at_goal


def ratio_bounds(
    model: PlainModel,
    start: Start,
    budget: float,
    *,
    discount: float | None = None,
    tolerance: float = 1e-8,
    horizons: tuple[int, ...] = (8, 32, 128, 512),
) -> tuple[float, float]:
    """Lower and upper bound of the optimum, from growing horizons until they meet."""
    low, high = 0.0, np.inf
    for horizon in horizons:
        tails = (
            program(model, start, horizon, discount=discount, relaxed=relaxed)
            for relaxed in (True, False)
        )
        low, high = (least_ratio(data, budget) for data in tails)
        if high - low <= tolerance * max(1.0, high):
            break
    return low, high


def price_slack(
    model: PlainModel,
    start: Mapping[State, float] | State,
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
    worth = value + price
    low, high = (
        least_difference(program(model, start, horizon, discount=discount, relaxed=relaxed), worth)
        for relaxed in (True, False)
    )
    return low + price * (1.0 - budget), high + price * (1.0 - budget)
