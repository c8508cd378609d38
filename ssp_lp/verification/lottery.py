"""A certificate's lottery: its weights, and what its members decide in the checker's model.

Nodes are states, or states with totals. What follows failing is read in another product than the
library's (``label_failing``), which ends runs where nothing counts any more, and names each pair by
what it is taken with. The checker derives its own: state x after failing is state ``shift + x``
there, and giving up by an action stands behind that action.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache
from itertools import pairwise

import numpy as np

from ssp_lp.arrays import FloatArray, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model.failure_product import FailureSSP
from ssp_lp.model.graph import Graph
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Policy
from ssp_lp.verification.checker import EXCESS, Model, dot
from ssp_lp.verification.exact_values import leads

NEARLY_MET = Fraction(1, 10**9)  # of a bound: rows as near to it are met exactly, where they can
_SHIFT = Fraction(1, 10**9)  # of the largest cost, which another lottery may take more or less


def graph_of(model: Model) -> Graph:
    """Graph of a checker's model, the states and pairs of what follows failing among them."""
    moves = [pair[2] for pair in model.pairs]
    entries = [(a / pair[1], y) for pair in model.pairs for a, y, _ in pair[2]]
    chances, successors = np.array(entries, dtype=np.float64).reshape(-1, 2).T
    return Graph(
        pair_offsets=read_only(np.cumsum([0, *map(len, model.of)])),
        outcome_offsets=read_only(np.cumsum([0, *map(len, moves)])),
        successors=read_only(successors, np.int32),
        probabilities=read_only(chances),
    )


def decisions(model: Model, policy: Policy) -> dict[int, int]:
    """A member's decisions in a certificate file by node; GIVE_UP_CODE: it stops or wanders.

    Raises:
        ModelError: it remembers something else than totals, draws its actions, or lacks a decision.
    """
    pair_at = _pairs_by_node(model, policy)
    if (label := policy.model.failure_label) is not None:
        pair_at = _relabelled(model, label, pair_at)
    return reached(model, pair_at)


def _pairs_by_node(model: Model, policy: Policy) -> Callable[[int, int], int]:
    """Pair, or a code, of a policy's model in a state of it and a total, for a certificate file."""
    if isinstance(policy, CostAwarePolicy) and model.counts:
        offsets = policy.model.pair_offsets[:-1]

        @cache
        def row(r: int) -> list[int]:
            """Pair of each state at a total."""
            total = float(Fraction(r, model.unit))
            if policy.levels is None:
                layer = round(total / policy.unit)
                place = float(layer)
            else:
                layer, place = int(np.abs(policy.levels - total).argmin()), total
            if layer < policy.cap:
                taken = policy.decision[layer].astype(np.int64)
                return list(np.where(taken < 0, taken, offsets + taken).tolist())
            tail = np.where(place >= policy.tail_threshold, len(policy.tails) - 1, 0)
            states = np.arange(len(offsets))
            return list(policy.tails[tail.astype(np.int64), states].tolist())

        return lambda x, r: row(r)[x]
    label = policy.model.failure_label
    states = np.array(sorted(model.live), dtype=np.int64)
    if label is not None:
        states = np.flatnonzero(~label.goal_mask & ~label.ended)
    branches = policy.branches(states, np.zeros(states.size, dtype=np.int64))
    if policy.memory_size != 1 or len(branches.situation) != states.size:
        raise ModelError("no certificate of a policy that remembers or draws its actions")
    taken = dict(zip(states.tolist(), branches.pair.tolist(), strict=True))
    return lambda x, r: taken.get(x, UNDECIDED)


def reached(model: Model, pair_at: Callable[[int, int], int]) -> dict[int, int]:
    """Part of a member met from the start, for a certificate file; endless parts stop at once.

    Args:
        model: the question and the model, its nodes spread.
        pair_at: pair, or a code, of each state and total in units.
    """
    met = {model.at(x, 0) for _, x in model.start if x in model.live}
    ahead, before, pairs = list(met), dict[int, list[int]](), dict[int, int]()
    ending = []
    while ahead:
        i = ahead.pop()
        x, r = model.nodes[i]
        pairs[i] = k = pair_at(x, r)
        if k == UNDECIDED:
            raise ModelError(f"the policy has no decision in state {model.names[x]!r}")
        after = {j for _, j in leads(model, k, r)} if k >= 0 else set()
        if k < 0 or after & model.ended:
            ending.append(i)
        for j in after - model.ended:
            before.setdefault(j, []).append(i)
        ahead += after - model.ended - met
        met |= after - model.ended
    ends = set(ending)
    while ending:
        more = set(before.get(ending.pop(), ())) - ends
        ends |= more
        ending += more
    return {i: pairs[i] if i in ends else GIVE_UP_CODE for i in met}


def _relabelled(
    model: Model, label: FailureSSP, pair_at: Callable[[int, int], int]
) -> Callable[[int, int], int]:
    """Decisions in the checker's product after failing, by state and total; or a code.

    Where the library's run is over, as nothing counts any more, it goes on to any end.

    Args:
        model: the checker's.
        label: the library's product.
        pair_at: pair of the library's product, or a code, by its state and a total.
    """
    n, original = model.shift, label.original
    places, quits = dict[tuple[int, int], int](), dict[int, int]()
    staying: dict[int, list[int]] = {}  # pairs by which one may give up, of the original
    bounds = list(pairwise(original.pair_offsets.tolist()))
    for s in sorted(model.live):
        x = s % n
        # after failing: all actions of a dead-end, else those that avoid the goal
        left = iter(range(*bounds[x]) if s < n or x in model.still else staying[x])
        k = UNDECIDED
        for place in model.of[s]:
            if s < n and s not in model.still and model.pairs[place][2][0][1] >= n:
                quits[k] = place
                staying.setdefault(x, []).append(k)
            else:
                k = next(left)
                places[s, k] = place
    onward = _onward(model)

    def decided(s: int, r: int) -> int:
        """Pair of the checker's product."""
        x = s % n
        p = pair_at(x if s < n else label.n_original + x, r)
        if p >= 0:
            k = int(label.original_pair[p])
            gives_up = bool(label.fails[p]) and s not in model.still
            return quits[k] if gives_up else places[s, k]
        if s in model.still:
            return onward[s]
        if p == GIVE_UP_CODE and x in staying and x not in model.free:
            return quits[staying[x][0]]
        return p

    return decided


def _onward(model: Model) -> dict[int, int]:
    """A way on after failing to where runs end, or may go about for nothing: pairs, or to stop."""
    failed = model.still & model.live
    onward = dict.fromkeys(failed & model.free, GIVE_UP_CODE)
    ahead = [*onward, *model.ended]
    for y in ahead:  # it grows while it is walked
        for k in model.before[y]:
            if (s := model.home[k]) in failed and s not in onward:
                onward[s] = k
                ahead.append(s)
    return onward


def exact_solution(
    table: Sequence[Sequence[Fraction]], right: Sequence[Fraction]
) -> list[Fraction]:
    """Exact solution of a small system by elimination, for a certificate file; or empty."""
    rows, n = [[*row, r] for row, r in zip(table, right, strict=True)], len(right)
    if any(len(row) != n + 1 for row in rows):
        return []
    for i in range(n):
        pivot = max(range(i, n), key=lambda k: abs(rows[k][i]))
        if rows[pivot][i] == 0:
            return []
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [a / rows[i][i] for a in rows[i]]
        for k in range(n):
            if k != i and rows[k][i]:
                rows[k] = [a - rows[k][i] * b for a, b in zip(rows[k], rows[i], strict=True)]
    return [row[n] for row in rows]


def lottery_weights(
    model: Model, drawn: FloatArray, totals: Sequence[Sequence[Fraction]]
) -> list[Fraction]:
    """Weights of a certificate file's lottery that keep every row exactly, where they can.

    They are those of the best lottery over the members, found in fractions, if it is as good as the
    one that was handed over, but for rounding. Where rows that are to be met exactly are rounded,
    they may be exceeded by as much as the checker allows.
    """
    weights = [Fraction(repr(w)) for w in drawn.tolist()]
    weights += [Fraction(0)] * (len(totals) - len(weights))
    largest = max(range(len(weights)), key=weights.__getitem__)
    weights[largest] += 1 - sum(weights)
    if model.is_single or not model.rows:
        return weights
    ratio = Fraction(0)
    if model.ratio:  # least cost + ratio * failure is least where the ratio is
        ratio = dot(weights, [t[0] for t in totals]) / max(
            1 - dot(weights, [t[1] for t in totals]), Fraction(1, model.one)
        )
    costs = [t[0] + ratio * t[1] if ratio else t[0] for t in totals]
    given, scale = dot(weights, costs), max(map(abs, costs))
    for room in (Fraction(0), EXCESS):
        beyond = [
            [total[j] - row.bound - room * min(abs(row.bound), Fraction(1)) for total in totals]
            for j, row in enumerate(model.rows, 1)
        ]
        best = best_mixture(costs, beyond)
        if best and abs(dot(best, costs) - given) <= _SHIFT * scale:
            return best
    return weights


def best_mixture(costs: Sequence[Fraction], beyond: Sequence[Sequence[Fraction]]) -> list[Fraction]:
    """Weights >= 0 of sum 1, of least cost, taking at most 0 of each row; empty: none do.

    The simplex method in fractions, in Bland's order, which ends in every case.

    Args:
        costs: of each member, [members].
        beyond: what each member takes of each row, [rows][members].
    """
    n, size = len(costs), len(beyond)
    # members, a slack for each row, and what is missing to the sum 1; and the right side
    table = [
        [*row, *(Fraction(i == j) for j in range(size)), Fraction(0), Fraction(0)]
        for i, row in enumerate(beyond)
    ]
    table.append([Fraction(1)] * n + [Fraction(0)] * size + [Fraction(1)] * 2)
    basis = [*range(n, n + size + 1)]
    missing = [Fraction(0)] * (n + size) + [Fraction(1)]
    for objective in (missing, [*costs, *[Fraction(0)] * (size + 1)]):
        while True:
            columns = range(n + size)
            reduced = (objective[j] - dot((objective[b] for b in basis), (row[j] for row in table))
                       for j in columns)  # fmt: skip
            entering = next((j for j, saved in zip(columns, reduced, strict=True) if saved < 0), -1)
            if entering < 0:
                break
            leaving = min(
                (i for i, row in enumerate(table) if row[entering] > 0),
                key=lambda i: (table[i][-1] / table[i][entering], basis[i]),
            )
            pivot = [a / table[leaving][entering] for a in table[leaving]]
            table = [
                pivot if i == leaving else
                [a - row[entering] * b for a, b in zip(row, pivot, strict=True)]
                if row[entering] else row
                for i, row in enumerate(table)
            ]  # fmt: skip
            basis[leaving] = entering
        if objective is missing and any(
            row[-1] for row, b in zip(table, basis, strict=True) if b == n + size
        ):
            return []
    values = {b: row[-1] for row, b in zip(table, basis, strict=True)}
    return [values.get(j, Fraction(0)) for j in range(n)]
