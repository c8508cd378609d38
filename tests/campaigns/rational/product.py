"""Cost given success within a budget: a program over states and accumulated cost, in floats.

The product is written out up to a horizon. Beyond it two tails: *restricted* plays a stationary
policy or fails where it can (an upper bound), *relaxed* arrives at no further cost with any success
that some policy can have (a lower bound). The answer counts where both agree to 1e-8.
"""

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array

from tests.campaigns.rational.models import GOAL, START, Model
from tests.campaigns.rational.policies import Exact

HORIZONS = (8, 24, 72)
AGREED = 1e-8
TIGHT = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}

Node = tuple[str, int]
Column = tuple[Node, dict[Node, float], float, float]  # from, to, success, cost on success
Ways = dict[str, list[tuple[float, float]]]  # success, cost on success


def cost_given_success(exact: Exact, budget: float) -> float | None:
    """The least cost given success; None where the tails do not meet."""
    ends = _stationary(exact)
    for horizon in HORIZONS:
        low = _least(_columns(exact, horizon, ends, relaxed=True), budget)
        high = _least(_columns(exact, horizon, ends, relaxed=False), budget)
        if low is None or high is None:
            return None
        if high - low <= AGREED * max(1.0, high):
            return high
    return None


def _stationary(exact: Exact) -> Ways:
    """What the stationary policies attain from each state."""
    found: Ways = {}
    for state in exact.rows:
        shifted = Exact(_from(exact.model, state))
        pairs = {
            (float(1 - p.failure), float(p.success_cost)) for p in shifted.policies if not p.stops
        }
        found[state] = sorted(pairs)
    return found


def _from(model: Model, state: str) -> Model:
    """The model started in another state, the two names exchanged."""
    swap = {state: START, START: state}
    rows = {
        swap.get(s, s): {
            a: tuple((p, swap.get(t, t), c) for p, t, c in row) for a, row in actions.items()
        }
        for s, actions in model.rows.items()
    }
    second = {swap.get(s, s): costs for s, costs in model.second.items()}
    return Model(rows, second, model.family, model.index)


def _columns(exact: Exact, horizon: int, ends: Ways, *, relaxed: bool) -> list[Column]:
    """Every node's ways to go on, the nodes in order of discovery."""
    order: list[Node] = [(START, 0)]
    seen, columns = set(order), []
    for node in order:
        for column in _at(exact, node, horizon, ends[node[0]], relaxed):
            columns.append(column)
            order += [n for n in column[1] if n not in seen]
            seen |= set(column[1])
    return columns


def _at(
    exact: Exact, node: Node, horizon: int, ends: list[tuple[float, float]], relaxed: bool
) -> list[Column]:
    """Fail if it can, then the actions or, beyond the horizon, a tail."""
    state, spent = node
    found: list[Column] = [(node, {}, 0.0, 0.0)] if state in exact.attention else []
    if state in exact.dead_ends:
        return found
    if spent >= horizon:
        if relaxed:
            return found + [(node, {}, s, spent * s) for s in (ends[0][0], ends[-1][0])]
        return found + [(node, {}, s, spent * s + c) for s, c in ends]
    for row in exact.rows[state].values():
        onward: dict[Node, float] = {}
        success = paid = 0.0
        for p, target, cost in row:
            if target == GOAL:
                success += float(p)
                paid += float(p * (spent + cost))
            else:
                there = (target, spent + int(cost))
                onward[there] = onward.get(there, 0.0) + float(p)
        found.append((node, onward, success, paid))
    return found


def _least(columns: list[Column], budget: float) -> float | None:
    """Charnes and Cooper's program: visits and start scaled until the success is 1."""
    index = {node: k for k, node in enumerate(dict.fromkeys(c[0] for c in columns))}
    entries = [(index[c[0]], k, 1.0) for k, c in enumerate(columns)]
    entries += [(index[n], k, -p) for k, c in enumerate(columns) for n, p in c[1].items()]
    entries += [(0, len(columns), -1.0)]
    entries += [(len(index), k, c[2]) for k, c in enumerate(columns) if c[2]]
    rows, cols, data = (np.array(part) for part in zip(*entries, strict=True))
    size = (len(index) + 1, len(columns) + 1)
    limit = np.append([-c[2] for c in columns], 1.0 - budget)
    answer = linprog(
        [*(c[3] for c in columns), 0.0],
        A_ub=limit[None, :],
        b_ub=[0.0],
        A_eq=coo_array((data, (rows, cols)), shape=size).tocsr(),
        b_eq=np.append(np.zeros(len(index)), 1.0),
        method="highs",
        options=TIGHT,
    )
    return float(answer.fun) if answer.status == 0 else None
