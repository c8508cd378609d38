"""Values whose inequalities hold exactly: what a certificate's checker is to read.

Policy iteration in integers, units of 1/ONE: systems are solved by factors in working precision and
refined until their equations hold but for some units, in sixty digits. What is then lowered, by a
tiny share of the steps that may follow among rows as good as the best, leaves every inequality more
room than the digits that are left out. An upper vector is a lower one with its sign turned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from ssp_lp.errors import ModelError, SolverError
from ssp_lp.model import SSP
from ssp_lp.model.graph import end_components, nearer_pairs
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.verification.checker import ONE, Model, Quantity, dot, down

_LOST = 10**28
"""Values are lowered by at most one part in so many of the largest."""

_REFINEMENTS = 60  # of a system, each of which gains the digits that its condition leaves of 16
_IMPROVEMENTS = 500  # of a policy, until which iteration has always ended
_UNITS = 4.0  # what an equation may lack in the end
_ROUNDING = ONE // 10**45  # values that differ by less may differ by rounding alone


class Row(NamedTuple):
    """A way to go on from a node."""

    node: int
    total: int
    outcomes: list[tuple[int, int]]  # (a, node): with probability a / total
    own: int  # total times what the step takes, in units


def decimal_text(value: int) -> str:
    """Exact number in units as a decimal text."""
    digits = f"{abs(value):061d}"
    text = f"{digits[:-60]}.{digits[-60:]}".rstrip("0").rstrip(".")
    return f"-{text}" if value < 0 else text


def member_vectors(model: Model, decided: Mapping[int, int]) -> dict[int, list[Any]]:
    """Exact values of a lottery's member for the checker: decisions, steps, quantities.

    Args:
        model: the question and the model.
        decided: pair, or GIVE_UP_CODE, of each state that it comes to, from all of which it ends.

    Raises:
        ModelError: it gives up where it may not.
    """
    place, vectors = {x: i for i, x in enumerate(decided)}, list[list[int]]()
    for q in [None, *model.each]:
        arrival, rows = [0 if q is None else down(-a) for a in (q or model.objective).arrival], []
        for x, k in decided.items():
            _, total, outcomes, paid = model.pairs[k] if k >= 0 else ("", 1, [], [])
            own = -total * ONE
            if q is not None:
                takes = q.at_stop(model, x, model.free) if k < 0 else dot(q.costs, paid)
                if takes is None:
                    raise ModelError(
                        f"the policy gives up in state {model.names[x]!r}: not so here"
                    )
                own = down(-takes) + sum(a * arrival[y] for a, y in outcomes)
            after = [(a, place[y]) for a, y in outcomes if y in place]
            rows.append(Row(place[x], total, after, own))
        if q is None:  # so many steps, a few digits of which serve as a witness
            steps = best_values(rows, range(len(rows)))[1]
            vectors.append([n * 101 // ONE * (ONE // 100) for n in steps])
        else:  # what takes nothing takes exactly nothing
            nothing = not any(row.own for row in rows)
            vectors.append([0] * len(rows) if nothing else sub_solution(rows, range(len(rows)))[1])
    return {
        x: ["stop" if k < 0 else k - model.of[x].start]
        + [decimal_text(-values[place[x]]) for values in vectors]
        for x, k in decided.items()
    }


def values_below(
    model: Model, ssp: SSP, c: Quantity, free: set[int], members: Sequence[Mapping[int, int]]
) -> tuple[list[int], dict[int, int]]:
    """Exact values that bound a quantity of all policies from below, in units; a best policy.

    States that may be gone about in for nothing are one node, as such loops say nothing of them.

    Args:
        model: the question and the model.
        ssp: the same model, for its graph.
        c: the quantity, such as the objective at prices of the rows.
        free: where wandering is free.
        members: policies near the best one.
    """
    arrival = [down(a) for a in c.arrival]
    own = {
        k: down(dot(c.costs, model.pairs[k][3])) + sum(a * arrival[y] for a, y in model.pairs[k][2])
        for x in model.moving
        for k in model.of[x]
        if model.keeps[k]
    }
    costless = np.zeros(ssp.n_pairs, dtype=np.bool_)
    for k, paid in own.items():
        costless[k] = paid == 0 and all(y in model.moving for _, y in model.pairs[k][2])
    component, inside = end_components(ssp, costless)
    group = {x: int(component[x]) if component[x] >= 0 else -1 - x for x in model.moving}
    number = {name: i for i, name in enumerate(dict.fromkeys(group.values()))}
    node = {x: number[name] for x, name in group.items()}
    rows, pairs = list[Row](), list[int]()
    for x in model.moving:
        for k in model.of[x]:
            if k in own and not inside[k]:
                _, total, outcomes, _ = model.pairs[k]
                after = [(a, node[y]) for a, y in outcomes if y in node]
                rows.append(Row(node[x], total, after, own[k]))
                pairs.append(k)
        stop = c.at_stop(model, x, free) if model.may_fail else None
        if stop is not None:
            rows.append(Row(node[x], 1, [], down(stop)))
            pairs.append(GIVE_UP_CODE)
    chosen = {k for member in members for k in member.values() if k >= 0}
    first = _leaving_choice(rows, len(number), [k in chosen for k in pairs])
    choice, values = sub_solution(rows, first)
    taken = np.zeros(ssp.n_pairs, dtype=np.bool_)
    taken[[pairs[r] for r in choice if pairs[r] >= 0]] = True
    nearer = nearer_pairs(ssp, taken, taken | inside)  # within a node to where it is left
    best = {x: GIVE_UP_CODE if pairs[choice[i]] < 0 else int(nearer[x]) for x, i in node.items()}
    return [values[node[x]] if x in node else 0 for x in range(len(model.names))], best


def sub_solution(rows: Sequence[Row], choice: Sequence[int]) -> tuple[Sequence[int], list[int]]:
    """Exact sub-solution v of ``v <= own + mean v`` for each row, near the greatest; a choice.

    Args:
        rows: of all nodes.
        choice: a row of each node, by which all of them are left.
    """
    choice, values, room = best_values(rows, choice)
    short = [(value + _ROUNDING // 2) // _ROUNDING * _ROUNDING for value in values]
    if all(
        short[row.node] * row.total <= row.own + sum(a * short[j] for a, j in row.outcomes)
        for row in rows
    ):
        return choice, short  # decimals, which are exact
    lost = max(max(map(abs, values)) // _LOST, 4 * _ROUNDING)
    tied = sorted({r for r, spare in enumerate(room) if spare <= lost}.union(choice))
    place = {r: i for i, r in enumerate(tied)}
    slow = [rows[r]._replace(own=-rows[r].total * ONE) for r in tied]
    steps = best_values(slow, [place[r] for r in choice])[1]  # negative: the longest way
    share = max(lost * ONE // (4 * (ONE - min(steps))), 8)
    grid = 10 ** (len(str(share // 4)) - 1)
    return choice, [
        (v + share * n // ONE) // grid * grid for v, n in zip(values, steps, strict=True)
    ]


def best_values(
    rows: Sequence[Row], choice: Sequence[int]
) -> tuple[Sequence[int], list[int], list[int]]:
    """Policy iteration in exact values: a best choice, its values, each row's excess.

    Raises:
        SolverError: it does not end.
    """
    if not rows:
        return choice, [], []
    for _ in range(_IMPROVEMENTS):
        values = _solved([rows[r] for r in choice])
        room = [
            (row.own + sum(a * values[j] for a, j in row.outcomes)) // row.total - values[row.node]
            for row in rows
        ]
        better = [r for r, spare in enumerate(room) if spare < -_ROUNDING]
        if not better:
            return choice, values, room
        choice = list(choice)
        for r in sorted(better, key=room.__getitem__, reverse=True):
            choice[rows[r].node] = r
    raise SolverError("no policy is best for a certificate: are costs near 1e-40 apart?")


def _solved(chosen: Sequence[Row]) -> list[int]:
    """Exact values of nodes, in units, at which a row each holds as an equation."""
    n, entries = (
        len(chosen),
        [(i, j, a / row.total) for i, row in enumerate(chosen) for a, j in row.outcomes],
    )
    at, there, chances = np.array(entries).reshape(-1, 3).T
    steps = sp.csc_array((chances, (at.astype(int), there.astype(int))), shape=(n, n))
    factors = splu(sp.csc_array(sp.identity(n, format="csc") - steps))
    values, last = [0] * n, np.inf
    for _ in range(_REFINEMENTS):
        lack = [
            (row.own + sum(a * values[j] for a, j in row.outcomes) - row.total * value) / row.total
            for row, value in zip(chosen, values, strict=True)
        ]
        worst = max(map(abs, lack))
        if worst <= _UNITS or not worst < 0.5 * last:
            break
        last, more = worst, factors.solve(np.array(lack))
        values = [value + int(step) for value, step in zip(values, more.tolist(), strict=True)]
    return values


def _leaving_choice(rows: Sequence[Row], n_nodes: int, preferred: Sequence[bool]) -> list[int]:
    """Choice of a row per node that comes nearer to an end, for exact values."""
    choice = [-1] * n_nodes
    for some in ([r for r, first in enumerate(preferred) if first], range(len(rows))):
        before: dict[int, list[int]] = {}
        for r in some:
            for _, j in rows[r].outcomes:
                before.setdefault(j, []).append(r)
        ahead = [r for r in some if sum(a for a, _ in rows[r].outcomes) < rows[r].total
                 or any(choice[j] >= 0 for _, j in rows[r].outcomes)]  # fmt: skip
        for r in ahead:  # it grows while it is walked
            if choice[rows[r].node] < 0:
                choice[rows[r].node] = r
                ahead += before.get(rows[r].node, [])
    return choice
