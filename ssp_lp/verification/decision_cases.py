"""Cases of a proof about policies that must not be mixed: the leaves of a branch-and-bound tree.

A leaf leaves some nodes (states, or states with totals) some of their decisions. Prices of its rows
come from a linear program in working precision: the dual of its lotteries' occupation measures,

    maximise    start v - prices bound
    subject to  v(i) <= own + sum p v + prices row      for each decision that is left at node i
                prices >= 0,

whose own dual is the occupation measure. The values that are handed on are exact ones at these
prices. Where a leaf proves too little, the node that its measure splits most is told apart: the
decision taken most often, and all others.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from fractions import Fraction
from heapq import heappop, heappush
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from ssp_lp.model.graph import Graph
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.verification.checker import Case, Model, Quantity
from ssp_lp.verification.exact_values import case_values, charged, leads, proved_bound

_PROOF = logging.getLogger("ssp_lp.proof")
_ROOM = Fraction(1, 10**11)  # relative, to which cases are to prove what the policy attains
_MOST_CASES, _MOST_VALUES = 400, 100_000  # leaves, and values in all of them
_SPLIT = 1e-9  # visits from which on a node counts as one that is come to
_LEAST_PRICE = 1e-11  # relative to what is proved: less is rounding


@dataclass(eq=False)
class _Leaf:
    """A case and what it proves; or, told apart, a node and its parts. Mutable: it is split."""

    case: Case
    values: list[int]  # [nodes]
    bound: Fraction
    flows: Mapping[int, Mapping[int, float]]  # visits of nodes by decision
    node: int = -1
    parts: list[tuple[Set[int], _Leaf]] = field(default_factory=list)

    def stated(self, model: Model) -> dict[str, Any]:
        """The case, or the tree of cases, as a certificate file states it."""
        if not self.parts:
            return {"prices": [str(price) for price in self.case.prices]}
        (x, r), unit = model.nodes[self.node], model.unit
        names = {GIVE_UP_CODE: "stop", **{k: k - model.of[x].start for k in model.of[x]}}
        return {
            "state": x,
            "total": str(Fraction(r, unit) if model.counts else 0),
            "parts": [
                [[names[k] for k in sorted(part)], leaf.stated(model)] for part, leaf in self.parts
            ],
        }

    def leaves(self) -> Iterator[_Leaf]:
        """The cases in the order in which they are stated."""
        if not self.parts:
            yield self
        for _, leaf in self.parts:
            yield from leaf.leaves()


class CasesProved(NamedTuple):
    """Cases that hold every policy that is not mixed."""

    stated: dict[str, Any]  # as a certificate file states them
    values: list[list[int]]  # of each, [nodes]
    bound: Fraction  # the least that they prove
    is_cut: bool  # whether the search ended for their number


def cases_of_decisions(
    model: Model,
    ssp: Graph,
    members: Sequence[Mapping[int, int]],
    slope: Sequence[int],
    upper: Fraction,
) -> CasesProved:
    """Split decisions until all cases prove what a policy attains, or there are too many.

    Args:
        model: the question and the model, its nodes spread.
        ssp: the same model, for its graph.
        members: the policy, and others near it, decisions by node.
        slope: of the values in the total, from the cap on; empty: none.
        upper: what the policy attains.
    """
    enough = upper - _ROOM * abs(upper)

    def leaf(only: Mapping[int, Set[int]]) -> _Leaf:
        """A case, proved."""
        prices, flows = _prices_and_flows(model, slope, upper, only)
        case = Case(prices, model.low, only)
        values, bound = case_values(model, ssp, case, members, slope)
        if model.ratio and bound < 0 and model.rows[0].paid == 1:
            # nothing is known of a ratio where success may be as rare as one likes
            case = Case([Fraction(0)] * len(prices), model.low, only)
            values, bound = case_values(model, ssp, case, members, slope)
        if model.ratio:
            bound = model.given_success(bound, case.prices[0])
        return _Leaf(case, values, bound, flows)

    root = leaf({})
    count, ahead, least = 1, [(root.bound, 0, root)], [upper]
    most = min(_MOST_CASES, _MOST_VALUES // len(model.nodes))
    while ahead:
        bound, _, worst = heappop(ahead)
        split = _split_node(model, worst) if bound < enough and count < most else None
        if split is None:
            least.append(bound)
            continue
        worst.node, parts = split
        for part in parts:
            one = leaf({**worst.case.only, worst.node: part})
            worst.parts.append((part, one))
            heappush(ahead, (one.bound, count, one))
            count += 1
    leaves = list(root.leaves())
    is_cut = min(least) < enough and count >= most
    if is_cut:
        _PROOF.warning("%d cases prove %.9g of %.9g", count, float(min(least)), float(upper))
    return CasesProved(root.stated(model), [one.values for one in leaves], min(least), is_cut)


def _split_node(model: Model, leaf: _Leaf) -> tuple[int, list[Set[int]]] | None:
    """Node that the measure of a case splits most, and parts of its decisions; None: none."""
    best: tuple[tuple[float, float], int, int] | None = None
    for i, by_decision in leaf.flows.items():
        if model.counts and i < len(model.names):
            continue  # beyond the cap decisions differ by the total
        x = model.nodes[i][0]
        left = leaf.case.only.get(i, {GIVE_UP_CODE, *model.of[x]})
        flows = {k: flow for k, flow in by_decision.items() if k in left}
        if len(flows) < 2 or sum(flows.values()) <= _SPLIT:
            continue
        first = max(flows, key=flows.__getitem__)
        rank = sum(flows.values()) - flows[first], flows[first]
        if best is None or rank > best[0]:
            best = rank, i, first
    if best is None:
        return None
    _, i, first = best
    left = leaf.case.only.get(i, {GIVE_UP_CODE, *model.of[model.nodes[i][0]]})
    others = {k for k in leaf.flows[i] if k in left and k != first}
    return i, [left - others, others]


def _prices_and_flows(
    model: Model, slope: Sequence[int], upper: Fraction, only: Mapping[int, Set[int]]
) -> tuple[list[Fraction], dict[int, dict[int, float]]]:
    """Prices of the rows that prove most of a case, and its occupation measure by node."""
    none = Case([Fraction(0)] * len(model.rows), model.low, only)
    each = [model.priced(none), *model.rows]
    choice = model.decisions(each[0], len(model.nodes), only)
    place = {i: j for j, i in enumerate(choice)}
    pairs = [(i, k) for i, some in choice.items() for k in some]
    n, n_rows = len(place), len(model.rows)
    takes = np.array([[_taken(model, q, i, k, slope) for q in each] for i, k in pairs])
    takes = takes.reshape(-1, 1 + n_rows)
    entries = [(row, place[i], 1.0) for row, (i, _) in enumerate(pairs)]
    for row, (i, k) in enumerate(pairs):
        if k >= 0:
            total = model.pairs[k][1]
            entries += [(row, place[j], -a / total)
                        for a, j in leads(model, k, model.nodes[i][1]) if j in place]  # fmt: skip
    at, there, chances = np.array(entries).reshape(-1, 3).T
    flow = sp.csr_array((chances, (at.astype(int), there.astype(int))), shape=(len(pairs), n))
    # what is proved, z, by v and prices: z <= start v - prices bound, of a ratio in two ways
    begun = np.zeros(n)
    for p, x in model.start:
        if (i := model.at(x, 0)) in place:
            begun[place[i]] += float(p)
    excess = [float(row.constant - row.paid + _arriving(model, row)) for row in model.rows]
    constant = float(each[0].constant + _arriving(model, each[0]))
    most = float(model.rows[0].paid) if model.ratio else 0.0
    ends = [(1.0, excess)]
    if model.ratio:
        ends = [(1.0, [excess[0] + most, *excess[1:]]), (1.0 - most, excess)]
    last = np.array([[*-begun, *(-e for e in beyond), z] for z, beyond in ends])
    height = 2.0 * abs(float(upper)) + 1.0
    table: Any = sp.vstack([
        sp.hstack([flow, sp.csr_array(-takes[:, 1:]), sp.csr_array((len(pairs), 1))]),
        sp.csr_array(last),
    ])  # fmt: skip
    found = linprog(
        np.append(np.zeros(n + n_rows), -1.0),
        table, np.append(takes[:, 0], [constant] * len(ends)),
        bounds=[(-np.inf, np.inf)] * n + [(0.0, np.inf)] * n_rows + [(-np.inf, height)],
        method="highs-ds",
    )  # fmt: skip
    prices, visits = np.zeros(n_rows), np.zeros(len(pairs))
    if found.status == 0 and found.x is not None:
        prices, visits = found.x[n : n + n_rows], -found.ineqlin.marginals[: len(pairs)]
        prices = np.where(prices > _LEAST_PRICE * height, prices, 0.0)
    flows: dict[int, dict[int, float]] = {i: {} for i in choice}
    for (i, k), visit in zip(pairs, visits.tolist(), strict=True):
        flows[i][k] = visit
    return [Fraction(repr(price)) for price in prices.tolist()], flows


def _taken(model: Model, q: Quantity, i: int, k: int, slope: Sequence[int]) -> float:
    """What a decision at a node takes of a quantity, its arrival included."""
    x, r = model.nodes[i]
    if k < 0:
        return float(q.at_stop(x) or 0)
    _, total, moves, paid = model.pairs[k]
    own = q.costs(paid) + sum(a * q.arrival(y) for a, y, _ in moves)
    return float((own + Fraction(charged(model, k, r, q, slope), model.one)) / total)


def _arriving(model: Model, q: Quantity) -> Fraction:
    """What the start itself takes of a quantity."""
    return proved_bound(model, q, None) - q.constant
