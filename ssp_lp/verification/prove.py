"""Bounds of a linear program by inequalities between whole numbers: nothing is solved or rounded.

A program has nodes, and mass 1 starts in node 0. A column (i, D, a, c) takes mass out of node i and
moves a_j / D of it to each node j; per unit of mass it adds c_0 to the objective and c_k to row k.
The program minimises the objective over x >= 0, one number for each column, such that at each node
as much mass leaves as enters, and each row is at most its bound. A bound is given as an interval
[least, most] that contains it. Numbers of a proof are whole multiples of 1 / ``unit``.

Lower bound: the proof has prices p >= 0 and a value v at some nodes, node 0 included. The columns
of these nodes lead only to these nodes. Every x has objective + sum p_k row_k >= v_0 (weak duality)
if, for each of these columns,

    D v_i <= D (c_0 + sum p_k c_k) + sum a_j v_j.

Upper bound: a member of a lottery chooses one column at each node that it reaches, and has numbers
t >= 0 and u there. Its mass leaves the program, so that x is finite, and each quantity of x is at
most its u_0, if

    D t_i >= D + sum a_j t_j   and   D u_i >= D c + sum a_j u_j   for the objective and each row.

The quantities of a lottery are the weighted means of its members' quantities. It satisfies a row if
its value is at most `least`; prices are multiplied by `most`, or by the lottery's value if greater.

Ratio objective / (1 - row 0): it is at least r if objective + r row 0 >= r. This holds if p_0 >= r
and bound >= r (1 - bound_0): then p_0 - r is the price of row 0 as a limit.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache
from itertools import groupby
from typing import Any, NamedTuple

ZERO = Fraction(0)
EXCESS = Fraction(1, 10**24)  # times min(|bound|, 1): excess over a row that a lottery may have
NUMBER = re.compile(r"-?[0-9]+(/[1-9][0-9]*|(\.[0-9]+)?([eE][-+]?[0-9]{1,3})?)")
DIGITS = 4000  # characters of a number, below Python's limit for conversion
REASON = 2000  # characters of the text of a refusal

Counts = tuple[Fraction, ...]


class RefusedError(Exception):
    """Error: the claim of a file does not follow. The text names the inequality that fails."""


class Column(NamedTuple):
    """A decision at a node, and where it leads.

    A move (a, j) takes the share a / total of the mass to node j.
    """

    node: int
    name: str
    total: int
    moves: list[tuple[int, int]]
    counts: Counts  # of the objective and of each row


class Row(NamedTuple):
    """A row of a program, whose bound is known to lie between two numbers."""

    name: str
    least: Fraction
    most: Fraction


@dataclass
class Member:
    """A policy of the lottery, with the numbers of its proof, each by node.

    The numbers are the position of the column that is taken, t, and u of each quantity.
    """

    decision: dict[int, int] = field(default_factory=dict)
    t: dict[int, int] = field(default_factory=dict)
    u: dict[int, list[int]] = field(default_factory=dict)


@dataclass
class Proof:
    """The numbers of a proof; the values v and u of nodes are in units of 1 / ``unit``."""

    unit: int
    prices: list[Fraction]
    weights: list[Fraction]
    ratio: Fraction | None  # a lower bound of the ratio; None: the objective is not a ratio
    v: dict[int, int]
    members: list[Member]


class Bounds(NamedTuple):
    """An interval that contains the optimum, and the excess of the lottery over rows, by name."""

    lower: Fraction
    upper: Fraction
    exceeded: Mapping[str, Fraction]


def need(holds: bool, *words: object) -> None:
    """Raise RefusedError with these words unless a condition holds."""
    if not holds:
        raise RefusedError(" ".join(ascii(str(word))[1:-1] for word in words)[:REASON])


@lru_cache(1 << 16)
def number(text: Any) -> Fraction:
    """Return the exact value of a text, which is a decimal or a fraction."""
    need(isinstance(text, str) and len(text) < DIGITS, "no text of a number:", repr(text)[:99])
    need(NUMBER.fullmatch(text) is not None, "no decimal and no fraction:", repr(text)[:99])
    return Fraction(text)


def whole(value: Any, below: int) -> int:
    """Return a value after checking that it is a whole number from 0 to ``below`` - 1."""
    if not (type(value) is int and 0 <= value < below):
        need(False, repr(value)[:99], "is not a whole number below", repr(below)[:99])
    return int(value)


def check_node(columns: list[Column], proof: Proof, price: Callable[[Counts], Fraction]) -> None:
    """Check the inequalities of the columns of one node; raise RefusedError if one fails.

    Args:
        columns: all columns of the node.
        proof: the numbers of the proof.
        price: counts -> cost of a column at the proof's prices.
    """
    node, unit = columns[0].node, proof.unit
    if node in proof.v:
        for _, name, total, moves, counts in columns:
            need(all(j in proof.v for _, j in moves), "v is stated after", node, name, "fails")
            left = total * proof.v[node] - sum(a * proof.v[j] for a, j in moves)
            need(left <= price(counts) * (total * unit), "v <= c + sum a v at", node, name, "fails")
    for m, member in enumerate(proof.members):
        if node not in member.decision:
            continue
        k = member.decision[node]
        need(k < len(columns), "member", m, "decides on a column at", node, "fails")
        _, name, total, moves, counts = columns[k]
        place, t, u = ("member", m, "at", node, name), member.t, member.u
        need(all(j in t for _, j in moves), *place, "decides at each successor, fails")
        enough = total * t[node] >= total + sum(a * t[j] for a, j in moves)
        need(enough, *place, "t >= 1 + sum a t fails")
        for q, count in enumerate(counts):
            left = total * u[node][q] - sum(a * u[j][q] for a, j in moves)
            need(left >= count * (total * unit), *place, "u >= c + sum a u fails")


def prove(
    columns: Iterable[Column], constant: Fraction, rows: list[Row], follows: Mapping[int, int],
    proof: Proof,
) -> Bounds:  # fmt: skip
    """Check a proof of a program and return the interval that it proves.

    Args:
        columns: columns of the program, node by node.
        constant: constant term of the objective.
        rows: rows of the program; for a ratio, the divisor is 1 - row 0.
        follows: node -> another node, at which a member must take the column of equal position.
        proof: the numbers of the proof.

    Raises:
        RefusedError: an inequality fails.
    """
    prices, members, unit = proof.prices, proof.members, Fraction(1, proof.unit)
    need(len(prices) == len(rows), len(prices), "prices of", len(rows), "rows")
    need(min(prices) >= 0, "needed: prices are >= 0")
    is_lottery = min(proof.weights, default=-1) >= 0 and sum(proof.weights) == 1
    need(is_lottery, "needed: weights are >= 0 and sum to 1")

    @lru_cache(1 << 16)
    def priced(counts: Counts) -> Fraction:
        return sum((p * c for p, c in zip(prices, counts[1:], strict=True) if c), counts[0])

    missing = {0} | proof.v.keys() | set[int]().union(*(member.decision for member in members))
    for node, some in groupby(columns, key=lambda column: column.node):
        check_node(list(some), proof, priced)
        missing.discard(node)
    need(not missing, "each node of the proof has columns; none at", *sorted(missing)[:3])
    need(0 in proof.v, "needed: v is stated of the beginning")
    for m, member in enumerate(members):
        need(0 in member.decision, "member", m, "begins, fails")
        for i, j in follows.items():
            alike = i not in member.decision or member.decision[i] == member.decision.get(j)
            need(alike, "member", m, "decides at", i, "as at", j, "fails")
    drawn = list(zip(proof.weights, members, strict=True))
    objective, *means = (
        sum((w * one.u[0][q] for w, one in drawn), ZERO) * unit for q in range(len(rows) + 1)
    )
    exceeded, paid = dict[str, Fraction](), list[Fraction]()
    for value, row in zip(means, rows, strict=True):
        paid.append(max(row.most, value))
        if value > row.least:
            exceeded[row.name] = excess = value - row.least
            is_rounding = excess <= EXCESS * min(abs(row.least), Fraction(1))
            need(is_rounding, "lottery <= bound of row", row.name, "fails by", float(excess))
    price = sum((p * bound for p, bound in zip(prices, paid, strict=True)), ZERO)
    lower = constant + proof.v[0] * unit - price
    upper = constant + objective
    if proof.ratio is not None:
        need(prices[0] >= proof.ratio, "needed: price of failure >= ratio")
        need(lower >= proof.ratio * (1 - paid[0]), "needed: objective >= ratio * goal probability")
        need(means[0] < 1, "needed: the lottery reaches the goal")
        lower, upper = proof.ratio, max(upper, upper / (1 - means[0]))
    return Bounds(lower, upper, exceeded)
