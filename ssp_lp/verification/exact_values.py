"""Values whose inequalities hold exactly: what a certificate's checker is to read.

Policy iteration in integers, units of the model's own: systems are solved by factors in working
precision and refined until their equations hold but for some units, in sixty digits. What is then
lowered, by a tiny share of the steps that may follow among rows as good as the best, leaves every
inequality more room than the digits that are left out. An upper vector is a lower one with its sign
turned. In a unit that all values are multiples of they are exact, and nothing is lowered.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from ssp_lp.errors import ModelError, SolverError
from ssp_lp.model.graph import Graph, end_components, nearer_pairs
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED
from ssp_lp.verification.checker import ONE, Case, Model, Quantity

_LOST = 10**28
"""Values are lowered by at most one part in so many of the largest."""

_KEPT_PARTS = 10**32  # parts of 1 of a value that follows from others directly
_IMPROVEMENTS = 500  # of a policy, until which iteration has always ended
_UNITS = 4  # what an equation may lack in the end
_ROUNDING_PARTS = 10**45  # values that differ by less than a part of 1 may differ by rounding alone
_BITS = 960  # of whole numbers of which floats are made
_ENDLESS = 10**9  # what a node takes in a case that leaves it no end


class Row(NamedTuple):
    """A way to go on from a node."""

    node: int
    total: int
    outcomes: list[tuple[int, int]]  # (a, node): with probability a / total
    own: int  # total times what the step takes, in units


def text_of(value: int, one: int = ONE) -> str:
    """Exact number in units as a decimal text, or as a fraction."""
    if one != ONE:
        return str(Fraction(value, one))
    digits = f"{abs(value):061d}"
    text = f"{digits[:-60]}.{digits[-60:]}".rstrip("0").rstrip(".")
    return f"-{text}" if value < 0 else text


def layers_of(model: Model, *, below: bool) -> Iterator[list[int]]:
    """Nodes for exact values, all of one total each, the states from the cap on first.

    Args:
        model: the question and the model, its nodes spread.
        below: whether totals below the cap follow, the highest first.
    """
    yield list(range(len(model.names)))
    later: dict[int, list[int]] = {}
    for i in range(len(model.names), len(model.nodes) if below else 0):
        later.setdefault(model.nodes[i][1], []).append(i)
    for total in sorted(later, reverse=True):
        yield later[total]


def member_vectors(model: Model, decided: Mapping[int, int]) -> dict[int, list[Any]]:
    """Exact values of a lottery's member for the checker: decisions, steps, quantities, slope.

    Args:
        model: the question and the model, its nodes spread.
        decided: pair, or GIVE_UP_CODE, of each node that it comes to, from all of which it ends.

    Raises:
        ModelError: it gives up where it may not.
    """
    n, slope, vectors = len(model.names), list[int](), list[list[int]]()
    if model.counts:
        model.slopes.charge = lambda r: model.down(-model.rise)
        late = {i: k for i, k in decided.items() if i < n}
        slope = _member_values(model, late, model.slopes, [])
    for q in [model.steps, *model.each]:
        vectors.append(_member_values(model, decided, q, slope if any(slope) else []))
    return {
        i: ["stop" if k < 0 else k - model.of[model.nodes[i][0]].start]
        + [text_of(-values[i], model.one) for values in vectors]
        + ([text_of(-slope[i], model.one)] if model.counts and i < n else [])
        for i, k in decided.items()
    }


def leads(model: Model, k: int, r: int) -> list[tuple[int, int]]:
    """Nodes that a pair leads to from a total, for exact values: (a, node)."""
    return [(a, model.at(y, r + t)) for a, y, t in model.pairs[k][2]]


def charged(model: Model, k: int, r: int, q: Quantity, slope: Sequence[int]) -> int:
    """What a pair takes by totals, times its total, in exact units: at the goal, past the cap."""
    if q.charge is None:
        return 0
    moves, goal, (goes, of) = model.pairs[k][2], model.sets["goal"], model.gamma.as_integer_ratio()
    won = sum(a * q.charge(r + t) for a, y, t in moves if y in goal) // goes * of
    far = [(a * slope[y], r + t - model.cap) for a, y, t in moves] if slope else []
    return won + sum(b * t for b, t in far if t > 0) // model.unit


def _member_values(
    model: Model, decided: Mapping[int, int], q: Quantity, slope: Sequence[int]
) -> list[int]:
    """Exact values of one quantity of a member, negative, [nodes]; of steps with some more."""
    arrival = [model.down(-q.arrival(x)) for x in range(len(model.names))]
    values = [0] * len(model.nodes)
    after = [arrival[x] for x, _ in model.nodes]
    for layer in layers_of(model, below=True):
        here = [i for i in layer if i in decided]
        place, rows = {i: row for row, i in enumerate(here)}, list[Row]()
        for i in here:
            (x, r), k = model.nodes[i], decided[i]
            if k < 0:
                if (takes := q.at_stop(x)) is None:
                    raise ModelError(
                        f"the policy gives up in state {model.names[x]!r}: not so here"
                    )
                rows.append(Row(place[i], 1, [], model.down(-takes)))
                continue
            _, total, _, paid = model.pairs[k]
            ahead = leads(model, k, r)
            inside = [(a, place[j]) for a, j in ahead if j in place]
            own = model.down(-q.costs(paid) - q.step * total) + charged(model, k, r, q, slope)
            own += sum(a * after[j] for a, j in ahead)  # nothing but the arrival yet, if inside
            rows.append(Row(place[i], total, inside, own))
        for i, value in zip(
            here, _one_way_values(rows, model.one, is_steps=q is model.steps), strict=True
        ):
            values[i] = value
            after[i] += value
    return values


def _one_way_values(rows: Sequence[Row], one: int, *, is_steps: bool) -> list[int]:
    """Exact values of nodes that have one row each."""
    if not any(row.own for row in rows):
        return [0] * len(rows)  # what takes nothing takes exactly nothing
    if not any(row.outcomes for row in rows):
        values = [_shortened(row.own // row.total, one) for row in rows]
    elif not is_steps:
        return sub_solution(rows, range(len(rows)), one)[1]
    else:
        values = best_values(rows, range(len(rows)), one)[1]
    # of steps a few digits serve as a witness
    return [v * 101 // one * one // 100 for v in values] if is_steps else values


def proved_bound(model: Model, c: Quantity, values: Sequence[int] | None) -> Fraction:
    """Bound that exact values prove of a quantity from the start on; None: values of 0."""
    bound, goal = c.constant, model.sets["goal"]
    for p, x in model.start:
        own = 0 if values is None else values[model.at(x, 0)]
        won = c.charge(0) if c.charge and x in goal else 0
        bound += p * (c.arrival(x) + Fraction(own + won, model.one))
    return bound


def case_values(
    model: Model,
    ssp: Graph,
    case: Case,
    members: Sequence[Mapping[int, int]],
    slope: Sequence[int] = (),
) -> tuple[list[int], Fraction]:
    """Exact values of a case of a proof, in units, and the bound of all its policies they prove.

    Args:
        model: the question and the model, its nodes spread.
        ssp: the same model, for its graph.
        case: its prices, and the decisions that it leaves.
        members: policies near the best one.
        slope: of the values in the total, from the cap on; empty: none.
    """
    c = model.priced(case)
    values, _ = values_below(model, ssp, c, members, slope, only=case.only)
    if model.ratio and not any(case.prices):
        values = [max(value, 0) for value in values]  # what is paid is no less than nothing
    return values, proved_bound(model, c, values)


def values_below(
    model: Model,
    ssp: Graph,
    c: Quantity,
    members: Sequence[Mapping[int, int]],
    slope: Sequence[int] = (),
    *,
    below: bool = True,
    only: Mapping[int, Set[int]] | None = None,
) -> tuple[list[int], dict[int, int]]:
    """Exact values that bound a quantity of all policies from below, in units; a best policy.

    States that may be gone about in for nothing are one node, as such loops say nothing of them.

    Args:
        model: the question and the model, its nodes spread.
        ssp: the same model, for its graph.
        c: the quantity, such as the objective at prices of the rows.
        members: policies near the best one.
        slope: of the values in the total, from the cap on; empty: none.
        below: whether the nodes below the cap are asked for.
        only: decisions of nodes that are left in a case, pairs or GIVE_UP_CODE; of others all are.
    """
    paid = [model.down(c.costs(pair[3])) for pair in model.pairs]
    chosen = {k for member in members for k in member.values() if k >= 0}
    n = len(model.names)
    arrival = [model.down(c.arrival(x)) for x in range(n)]
    values = [0] * (len(model.nodes) if below else n)
    after, best = [arrival[x] for x, _ in model.nodes[: len(values)]], dict[int, int]()
    choice = model.decisions(c, len(values), only or {})
    still = {model.home[k] for k, moves in enumerate(p[2] for p in model.pairs)
             if any(t == 0 and y in model.moving for _, y, t in moves)}  # fmt: skip
    for layer in layers_of(model, below=below):
        here = [i for i in layer if model.nodes[i][0] in model.moving]
        r, own, ahead = model.nodes[layer[0]][1], dict[int, int](), dict[int, list[Any]]()
        for k in (k for i in here for k in choice[i] if k >= 0):
            ahead[k] = leads(model, k, r)
            own[k] = paid[k] + sum(a * after[j] for a, j in ahead[k])
            own[k] += charged(model, k, r, c, slope)
        stops = {i: c.at_stop(model.nodes[i][0]) if choice[i][-1:] == [-1] else None
                 for i in here}  # fmt: skip
        if layer[0] >= n and not any(model.nodes[i][0] in still for i in here):
            for i in here:
                worth = {k: own[k] // model.pairs[k][1] for k in choice[i] if k >= 0}
                if (stop := stops[i]) is not None:
                    worth[GIVE_UP_CODE] = model.down(stop)
                worth = worth or {UNDECIDED: _ENDLESS * model.one}
                best[i] = min(worth, key=worth.__getitem__)
                values[i] = _shortened(worth[best[i]], model.one)
        else:
            found = _connected_values(model, ssp, here, own, ahead, stops, chosen)
            for i, (value, k) in found.items():
                values[i], best[i] = value, k
        for i in here:
            after[i] += values[i]
    return values, best


def _connected_values(
    model: Model,
    ssp: Graph,
    here: Sequence[int],
    own: Mapping[int, int],
    ahead: Mapping[int, Sequence[tuple[int, int]]],
    stops: Mapping[int, Fraction | None],
    chosen: set[int],
) -> dict[int, tuple[int, int]]:
    """Exact values of nodes of one total that lead to each other, and a best decision of each."""
    met = set(here)
    costless = np.zeros(ssp.n_pairs, dtype=np.bool_)
    for k, takes in own.items():
        costless[k] = takes == 0 and all(j in met for _, j in ahead[k])
    component, inside = end_components(ssp, costless)
    at = {i: model.nodes[i][0] for i in here}
    group = {i: int(component[x]) if component[x] >= 0 else -1 - x for i, x in at.items()}
    number = {name: i for i, name in enumerate(dict.fromkeys(group.values()))}
    node = {i: number[name] for i, name in group.items()}
    rows, pairs = list[Row](), list[int]()
    for i, x in at.items():
        for k in model.of[x]:
            if k in own and not inside[k]:
                after = [(a, node[j]) for a, j in ahead[k] if j in node]
                rows.append(Row(node[i], model.pairs[k][1], after, own[k]))
                pairs.append(k)
        if (stop := stops[i]) is not None:
            rows.append(Row(node[i], 1, [], model.down(stop)))
            pairs.append(GIVE_UP_CODE)
    first = _leaving_choice(rows, len(number), [k in chosen for k in pairs])
    for g in (g for g, row in enumerate(first) if row < 0):  # whatever is done, it has no end
        first[g] = len(rows)
        rows.append(Row(g, 1, [], _ENDLESS * model.one))
        pairs.append(GIVE_UP_CODE)
    choice, values = sub_solution(rows, first, model.one)
    taken = np.zeros(ssp.n_pairs, dtype=np.bool_)
    taken[[pairs[r] for r in choice if pairs[r] >= 0]] = True
    nearer = nearer_pairs(ssp, taken, taken | inside)  # within a node to where it is left
    return {
        i: (values[g], GIVE_UP_CODE if pairs[choice[g]] < 0 else int(nearer[at[i]]))
        for i, g in node.items()
    }


def _shortened(value: int, one: int) -> int:
    """Exact value rounded down to the digits that a file keeps of it, where no row needs more."""
    kept = 1 if one != ONE else one // _KEPT_PARTS
    return value // kept * kept


def sub_solution(
    rows: Sequence[Row], choice: Sequence[int], one: int
) -> tuple[Sequence[int], list[int]]:
    """Exact sub-solution v of ``v <= own + mean v`` for each row, near the greatest; a choice.

    Args:
        rows: of all nodes.
        choice: a row of each node, by which all of them are left.
        one: units in 1; other than of sixty digits values are whole numbers of them.
    """
    choice, values, room = best_values(rows, choice, one)
    if one != ONE:
        return choice, values
    rounding = one // _ROUNDING_PARTS
    short = [(value + rounding // 2) // rounding * rounding for value in values]
    if all(
        short[row.node] * row.total <= row.own + sum(a * short[j] for a, j in row.outcomes)
        for row in rows
    ):
        return choice, short  # decimals, which are exact
    lost = max(max(map(abs, values)) // _LOST, 4 * rounding)
    tied = sorted({r for r, spare in enumerate(room) if spare <= lost}.union(choice))
    place = {r: i for i, r in enumerate(tied)}
    slow = [rows[r]._replace(own=-rows[r].total * one) for r in tied]
    steps = best_values(slow, [place[r] for r in choice], one)[1]  # negative: the longest way
    share = max(lost * one // (4 * (one - min(steps))), 8)
    grid = 10 ** (len(str(share // 4)) - 1)
    lowered = [(v + share * n // one) // grid * grid for v, n in zip(values, steps, strict=True)]
    return choice, _ended_exactly(rows, lowered, lost)


def _ended_exactly(rows: Sequence[Row], values: Sequence[int], lost: int) -> list[int]:
    """Exact sub-solution in which nodes that best end at once have what ending takes, if may be."""
    ends = {row.node: row.own // row.total for row in rows if not row.outcomes}
    ends = {i: end for i, end in ends.items() if 0 < end - values[i] <= 2 * lost}
    for row in rows:  # the least of several
        if not row.outcomes and row.node in ends:
            ends[row.node] = min(ends[row.node], row.own // row.total)
    while ends:
        raised = [ends.get(i, value) for i, value in enumerate(values)]
        wrong = {
            row.node
            for row in rows
            if row.node in ends
            and raised[row.node] * row.total > row.own + sum(a * raised[j] for a, j in row.outcomes)
        }
        if not wrong:
            return raised
        ends = {i: end for i, end in ends.items() if i not in wrong}
    return list(values)


def best_values(
    rows: Sequence[Row], choice: Sequence[int], one: int
) -> tuple[Sequence[int], list[int], list[int]]:
    """Policy iteration in exact values: a best choice, its values, each row's excess.

    Raises:
        SolverError: it does not end.
    """
    if not rows:
        return choice, [], []
    for _ in range(_IMPROVEMENTS):
        values = _solved([rows[r] for r in choice], 0 if one != ONE else _UNITS)
        room = [
            (row.own + sum(a * values[j] for a, j in row.outcomes)) // row.total - values[row.node]
            for row in rows
        ]
        better = [r for r, spare in enumerate(room) if spare < -(one // _ROUNDING_PARTS)]
        if not better:
            return choice, values, room
        choice = list(choice)
        for r in sorted(better, key=room.__getitem__, reverse=True):
            choice[rows[r].node] = r
    raise SolverError("no policy is best for a certificate: are costs near 1e-40 apart?")


def _solved(chosen: Sequence[Row], enough: int) -> list[int]:
    """Exact values of nodes, in units, at which a row each holds as an equation.

    Args:
        chosen: a row of each node.
        enough: units that an equation may lack.
    """
    n = len(chosen)
    entries = [(i, j, a / row.total) for i, row in enumerate(chosen) for a, j in row.outcomes]
    at, there, chances = np.array(entries).reshape(-1, 3).T
    steps = sp.csc_array((chances, (at.astype(int), there.astype(int))), shape=(n, n))
    factors = splu(sp.csc_array(sp.identity(n, format="csc") - steps))
    values, last = [0] * n, None
    while True:
        lack = [
            row.own + sum(a * values[j] for a, j in row.outcomes) - row.total * value
            for row, value in zip(chosen, values, strict=True)
        ]
        worst = max(-(-abs(own) // row.total) for own, row in zip(lack, chosen, strict=True))
        if worst <= enough or (last is not None and 2 * worst > last):
            return values
        finer = max(worst.bit_length() - _BITS, 0)
        scaled = [(own >> finer) / row.total for own, row in zip(lack, chosen, strict=True)]
        last, more = worst, factors.solve(np.array(scaled))
        values = [v + (round(step) << finer) for v, step in zip(values, more.tolist(), strict=True)]


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
