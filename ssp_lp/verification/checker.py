"""Check a certificate of an optimum by exact inequalities: ``python checker.py FILE``.

It needs Python's standard library alone, solves nothing, and trusts nothing but the question and
the model in the file. The file is gzip, a JSON text a line: the question, a line a state, the head
of the proof with the SHA-256 of all lines before, a line of proof a state. Numbers are texts;
probabilities of an action, and of the start, are divided by their exact sum.

Question: a policy moves until it comes to the goal, comes to a dead-end (no way leads from there
to the goal), gives up where it may, or wanders for ever. Quantities are sums of expected costs,
visits (arrivals, the start among them) and probabilities of ends. If the failing step is charged,
each cost charges on entering a dead-end the least mean of its actions, and on giving up that of
all actions ("anywhere") or of those after which the goal can still be avoided surely ("attention").
Sought is the best lottery over policies within the rows.

Proof: rows become q <= b where costs, visits and ends have weights >= 0, ends of negative weight by
their complement. Let c = objective + prices * rows, prices >= 0. Below: v(x) <= c(x, u) + sum p v(y) for
 each action, v(x) <= what giving up takes. A policy within the rows goes on for ever by actions
that are free in the objective and all rows, else it pays infinitely much; so it comes to where they
can go on for ever, and there v(x) <= what wandering takes. So no lottery within the rows attains
less than v at the start less prices * b. Where no failure is allowed, only actions count that keep
the goal sure. Above: on the states that a member of the lottery comes to, t >= 1 + sum p t, so that
it ends, and u >= own + sum p u for the objective and each row, so that it takes at most u.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import sys
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from math import lcm
from typing import Any

FORMAT, ZERO = "ssp-lp certificate 1", Fraction(0)
ONE = 10**60  # a proof's numbers are compared in units of 1/ONE, rounded against the proof
EXCESS = Fraction(1, 10**9)  # of a bound: so much a lottery may exceed it, which is told
KEYS = "asked charge_failing_step costs failure format give_up greatest objective rows sets"
FAILURE = {"constant": "1", "terms": [["-1", "end", "goal"]]}


class RefusedError(Exception):
    """What is claimed does not follow: which inequality fails, and where."""


def need(holds: bool, *words: Any) -> None:
    """Refuse, in these words, unless something holds."""
    if not holds:
        raise RefusedError(" ".join(map(str, words)))


@cache
def number(text: str) -> Fraction:
    """The number that a text states."""
    need(isinstance(text, str) and len(text) < 4000, "no text of a number:", repr(text)[:99])
    exponent = text.lower().partition("e")[2]
    need(not exponent or abs(int(exponent)) < 4000, text, "has too large an exponent")
    return Fraction(text)


def whole(value: Any, below: int) -> int:
    """A whole number >= 0 below another."""
    need(type(value) is int and 0 <= value < below, repr(value), "is no whole number below", below)
    return int(value)


def down(value: Fraction) -> int:
    """A number in units of 1/ONE, rounded down; ``-down(-value)`` rounds up."""
    return value.numerator * ONE // value.denominator


def mean(weights: Sequence[Fraction], costs: Sequence[Fraction]) -> Fraction:
    """A weighted sum of costs."""
    return sum((w * c for w, c in zip(weights, costs, strict=True) if w), ZERO)


class Quantity:
    """What is counted, with weights >= 0, and a constant."""

    def __init__(self, model: Model, stated: dict[str, Any], sign: int = 1) -> None:
        """Read ``sign`` times what is stated."""
        n = len(model.names)
        self.constant, self.stop = sign * number(stated["constant"]), ZERO
        self.costs, self.visits, ends = [ZERO] * model.n_costs, [ZERO] * n, [ZERO] * n
        for text, kind, what in stated["terms"]:
            weight = sign * number(text)
            need(kind in ("cost", "visits", "end"), "no quantity is called", kind)
            if kind == "cost":
                self.costs[whole(what, model.n_costs)] += weight
                continue
            states, counts = model.sets[what], self.visits if kind == "visits" else ends
            need(kind == "visits" or states <= model.ended, "not all states end:", what)
            if kind == "end" and weight < 0:  # P(end) = 1 - P(no such end)
                self.constant, self.stop = self.constant + weight, self.stop - weight
                states, weight = model.ended - states, -weight
            for x in states:
                counts[x] += weight
        need(min([*self.costs, *self.visits]) >= 0, "costs or visits count negatively")
        self.arrival = [a + b for a, b in zip(self.visits, ends, strict=True)]  # on coming to x
        for x in model.dead:
            self.arrival[x] += mean(self.costs, model.entering[x])

    def add(self, price: Fraction, other: Quantity) -> None:
        """Add a multiple of another quantity."""
        self.constant += price * other.constant
        self.stop += price * other.stop
        for mine, theirs in ((self.costs, other.costs), (self.arrival, other.arrival)):
            mine[:] = [a + price * b if b else a for a, b in zip(mine, theirs, strict=True)]

    def at_stop(self, model: Model, x: int, free: set[int]) -> Fraction | None:
        """What giving up takes in x, or wandering in free states; None: neither is possible."""
        if x in free or x not in model.leaving:
            return self.stop if x in free else None
        return self.stop + mean(self.costs, model.leaving[x])


@dataclass
class Row:
    """``quantity <= bound``, which a lottery keeps to; whatever keeps to the row has <= loose."""

    name: str
    quantity: Quantity
    bound: Fraction
    loose: Fraction


class Model:
    """The question and the model of a file, and what follows from its graph."""

    def __init__(self, question: dict[str, Any], lines: Sequence[bytes]) -> None:
        """Read a question and the lines of its states."""
        need(question.get("format") == FORMAT, "this is no certificate of this format")
        need(sorted(question) == sorted([*KEYS.split(), "start", "states"]), "unknown questions")
        for name in ("charge_failing_step", "greatest"):
            need(type(question[name]) is bool, name, "is no truth value")
        self.question, self.n_costs, n = question, whole(question["costs"], 1000), len(lines)
        self.sets: dict[str, set[int]] = {name: set() for name in ["goal", *question["sets"]]}
        self.names, self.first, self.home = list[str](), [0], list[int]()
        self.pairs: list[tuple[str, int, list[tuple[int, int]], list[Fraction]]] = []
        for x, line in enumerate(lines):
            state = json.loads(line)
            self.names.append(str(state["name"]))
            for name in state["sets"]:
                self.sets[name].add(x)
            self.pairs += [self._pair(action, n) for action in state["actions"]]
            self.home += [x] * (len(self.pairs) - self.first[-1])
            self.first.append(len(self.pairs))  # the pairs of x: first[x] .. first[x + 1]
        goal, every, allowed = self.sets["goal"], set(range(n)), [True] * len(self.pairs)
        need(not goal & set(self.home), "a goal has actions")
        self.before: list[list[int]] = [[] for _ in lines]  # pairs that may lead to a state
        for k, pair in enumerate(self.pairs):
            for _, y in pair[2]:
                self.before[y].append(k)
        self.dead = every - self.reaching(allowed)
        self.ended, self.live = goal | self.dead, every - goal - self.dead
        start = [(number(p), whole(x, n)) for p, x in question["start"]]
        total = sum((p for p, _ in start), ZERO)
        need(total > 0 and min(start)[0] >= 0, "the start is no distribution")
        self.start = [(p / total, x) for p, x in start if p > 0]
        attention, stays = self.staying(every - goal, allowed)
        self.entering = {x: self._least(self.of(x)) for x in self.dead}
        places = {
            "anywhere": self.live,
            "attention": self.live & attention,
            "dead_ends": set[int](),
        }
        self.leaving = {
            x: self._least(k for k in self.of(x) if stays[k] or question["give_up"] == "anywhere")
            for x in places[question["give_up"]]
        }
        self._ask()

    def _pair(self, stated: Any, n: int) -> tuple[str, int, list[tuple[int, int]], list[Fraction]]:
        """Name, total T, outcomes (a, y) of probability a / T, and each mean cost times T."""
        name, told, costs = stated
        chances, where = [number(p) for p, _ in told], f"{self.names[-1]}, {name}:"
        scale = lcm(*(p.denominator for p in chances))
        parts = [p.numerator * (scale // p.denominator) for p in chances]
        need(sum(parts) > 0 and min(parts) >= 0, where, "probabilities >= 0, not all of them 0")
        need(len(costs) == self.n_costs, where, "as many costs as are said to be there")
        costs = [cost if isinstance(cost, list) else [cost] * len(parts) for cost in costs]
        each = [[number(text) for text in cost] for cost in costs]
        need(min(map(min, each)) >= 0, where, "costs >= 0")
        paid = [sum((a * c for a, c in zip(parts, cost, strict=True)), ZERO) for cost in each]
        outcomes = [(a, whole(y, n)) for a, (_, y) in zip(parts, told, strict=True) if a]
        return str(name), sum(parts), outcomes, paid

    def _least(self, pairs: Iterable[int]) -> list[Fraction]:
        """What failing charges of each cost, where one of these pairs is what is paid."""
        each = [[cost / self.pairs[k][1] for cost in self.pairs[k][3]] for k in pairs]
        charged = each and self.question["charge_failing_step"]
        return list(map(min, zip(*each, strict=True))) if charged else [ZERO] * self.n_costs

    def of(self, x: int) -> range:
        """The pairs of a state."""
        return range(self.first[x], self.first[x + 1])

    def reaching(self, allowed: Sequence[bool]) -> set[int]:
        """States from which allowed pairs may lead to the goal."""
        found, ahead = set(self.sets["goal"]), list(self.sets["goal"])
        while ahead:
            more = {self.home[k] for k in self.before[ahead.pop()] if allowed[k]} - found
            found |= more
            ahead += more
        return found

    def staying(self, states: set[int], allowed: Sequence[bool]) -> tuple[set[int], list[bool]]:
        """The largest part of some states where each has an allowed pair that surely stays in it.

        States without any pairs stay. Also which pairs stay.
        """
        inside, stays = set(states), [allowed[k] and x in states for k, x in enumerate(self.home)]
        left = [sum(stays[k] for k in self.of(x)) for x in range(len(self.names))]
        lost = [x for x in range(len(left)) if x not in states or (self.of(x) and not left[x])]
        while lost:
            inside.discard(y := lost.pop())
            for k in self.before[y]:
                if stays[k]:
                    stays[k], x = False, self.home[k]
                    left[x] -= 1
                    lost += [] if left[x] else [x]
        return inside, stays

    def _ask(self) -> None:
        """The objective and the rows, where wandering is free, and what keeps the goal sure."""
        question, goal, budget = self.question, self.sets["goal"], self.question["failure"]
        self.objective = Quantity(self, question["objective"], -1 if question["greatest"] else 1)
        self.share = number(budget["share"]) if isinstance(budget, dict) else None
        need(self.share is None or 0 <= self.share <= 1, "a share lies between 0 and 1")
        self.rows = list[Row]()
        if budget is not None:
            known = ZERO if self.share is not None or budget == "least" else number(budget)
            self.rows.append(Row("failure", Quantity(self, FAILURE), known, known))
        for row in question["rows"]:
            need(("at_most" in row) != ("at_least" in row), "a row has one bound")
            sign, text = (1, row["at_most"]) if "at_most" in row else (-1, row["at_least"])
            quantity = Quantity(self, row["quantity"], sign)
            bound, quantity.constant = sign * number(text) - quantity.constant, ZERO
            self.rows.append(Row(str(row["name"]), quantity, bound, bound))
        self.each = [self.objective, *(row.quantity for row in self.rows)]
        paying = [k for k in range(self.n_costs) if any(q.costs[k] for q in self.each)]
        seen = {x for x in self.live if any(q.visits[x] for q in self.each)}
        free = [
            not any(paid[k] for k in paying) and all(y not in seen for _, y in outcomes)
            for _, _, outcomes, paid in self.pairs
        ]
        self.free, self.sure, self.keeps = self.staying(self.live, free)[0], self.live, free[:0]
        while budget is not None and self.share is None and self.rows[0].bound == 0:
            sure, self.keeps = (
                self.sure,
                [
                    x in self.sure and all(y in self.sure or y in goal for _, y in pair[2])
                    for x, pair in zip(self.home, self.pairs, strict=True)
                ],
            )
            self.sure = self.reaching(self.keeps) & sure
            if self.sure == sure:
                need({x for _, x in self.start} <= sure | goal, "failure 0: the goal can be sure")
                break

    def priced(self, prices: Sequence[Fraction]) -> Quantity:
        """The objective and, at prices, by how much the rows' bounds are exceeded."""
        c = Quantity(self, self.question["objective"], -1 if self.question["greatest"] else 1)
        for price, row in zip(prices, self.rows, strict=True):
            c.add(price, row.quantity)
            c.constant -= price * row.loose
        return c

    def below(self, v: list[int], c: Quantity, free: set[int], sure: bool) -> Fraction:
        """The least of c that v proves, every inequality of which is checked."""
        moving = self.sure if sure else self.live
        after = [down(a) + (v[x] if x in moving else 0) for x, a in enumerate(c.arrival)]
        for x in moving:
            stop = None if sure else c.at_stop(self, x, free)
            if stop is not None and v[x] > down(stop):
                refuse("v <= giving up or wandering", self.names[x], v[x], down(stop))
            for k in self.of(x):
                action, total, outcomes, paid = self.pairs[k]
                most = sum(a * after[y] for a, y in outcomes) + down(mean(c.costs, paid))
                if v[x] * total > most and (not sure or self.keeps[k]):
                    refuse("v <= c + sum p v", f"{self.names[x]}, {action}", v[x], most // total)
        return c.constant + sum((p * Fraction(after[x], ONE) for p, x in self.start), ZERO)

    def above(self, member: dict[int, list[Any]], words: str) -> list[Fraction]:
        """What a member takes at most of the objective and of each row."""
        arrival = [[-down(-a) for a in q.arrival] for q in self.each]
        u = {x: [-down(-number(text)) for text in entry[1:]] for x, entry in member.items()}
        after = [[*[0] * len(self.names)], *arrival]  # steps, objective, rows
        after = [
            [a + (u[x][j] if x in u else 0) for x, a in enumerate(values)]
            for j, values in enumerate([[0] * len(self.names), *arrival])
        ]
        decided = self.ended | member.keys()
        need(decided >= {x for _, x in self.start}, words, "decides at the start")
        for x, (decision, *_) in member.items():
            need(x in self.live, words, "decides where no episode has ended, not in", self.names[x])
            total, outcomes, own = 1, list[tuple[int, int]](), [Fraction(1)]
            if decision == "stop":
                stops = [q.at_stop(self, x, self.free) for q in self.each]
                own += [stop for stop in stops if stop is not None]
                need(None not in stops, words, "gives up where it may, not in", self.names[x])
            else:
                k = self.first[x] + whole(decision, len(self.of(x)))
                total, outcomes, paid = self.pairs[k][1:]
                own = [Fraction(total), *(mean(q.costs, paid) for q in self.each)]
            need(decided >= {y for _, y in outcomes}, words, "decides after", self.names[x])
            for j, (mine, value) in enumerate(zip(own, u[x], strict=True)):
                least = -down(-mine) + sum(a * after[j][y] for a, y in outcomes)
                if value * total < least:
                    what = f"{words}: {(['1', 'objective', *(row.name for row in self.rows)][j])} + sum p u <= u"
                    refuse(what, f"{self.names[x]}, {decision}", -(-least // total), value)
        return [
            q.constant + sum((p * Fraction(after[j][x], ONE) for p, x in self.start), ZERO)
            for j, q in enumerate(self.each, start=1)
        ]


def refuse(words: str, where: str, left: int, right: int) -> None:
    """Refuse because of an inequality."""
    raise RefusedError(f"{words} fails in {where}: {left / ONE:.17g} > {right / ONE:.17g}")


@dataclass(frozen=True)
class Checked:
    """What a certificate proves."""

    accepted: bool
    reason: str = ""  # which inequality fails where, if it is refused
    lower: Fraction = ZERO  # the optimum of the question is at least this
    upper: Fraction = ZERO  # and at most this
    exceeded: dict[str, Fraction] = field(default_factory=dict)  # rows, and by how much
    asked: str = ""  # the question in the writer's words, from which nothing is concluded
    digest: str = ""  # SHA-256 of the question and the model

    def __str__(self) -> str:
        """The verdict in a few lines."""
        if not self.accepted:
            return f"refused: {self.reason}"
        lines = [f"accepted: {self.asked}", f"  SHA-256   {self.digest}"]
        for name, bound in (("at least ", self.lower), ("at most  ", self.upper)):
            exact, digits = str(bound), f"{abs(round(bound * 10**25)):026d}"
            exact = exact if len(exact) < 60 else f"{exact[:24]}...{exact[-24:]}"
            sign = "-" if bound < 0 else ""
            lines.append(f"  {name} {sign}{digits[:-25]}.{digits[-25:]} = {exact}")
        lines.append(f"  width     {float(self.upper - self.lower):.1e}")
        for name, excess in self.exceeded.items():
            lines.append(f"  the lottery exceeds row {name} by {float(excess):.1e}")
        return "\n".join(lines if self.exceeded else [*lines, "  all rows are kept exactly"])


def check_certificate(path: Any) -> Checked:
    """Check the certificate in a file.

    Args:
        path: of the file.

    Returns:
        An interval that holds the optimum; where it is not ``accepted``, which inequality fails.
    """
    with open(path, "rb") as file:
        packed = file.read()
    try:
        return checked(gzip.decompress(packed).splitlines())
    except RefusedError as error:
        return Checked(False, str(error))
    except (ArithmeticError, AttributeError, EOFError, LookupError, OSError, RecursionError,
            TypeError, ValueError, zlib.error) as error:  # fmt: skip
        return Checked(False, f"the file is damaged: {type(error).__name__}: {error}")


def checked(lines: list[bytes]) -> Checked:
    """Check the lines of a file."""
    question = json.loads(lines[0])
    n = whole(question["states"], len(lines))
    need(len(lines) == 2 * n + 2, len(lines), "lines where there should be", 2 * n + 2)
    digest, head = hashlib.sha256(b"\n".join(lines[: n + 1])).hexdigest(), json.loads(lines[n + 1])
    need(digest == head["sha256"], "the SHA-256 is not that of the question and the model")
    model, proof = Model(question, lines[1 : n + 1]), [json.loads(line) for line in lines[n + 2 :]]
    weights, prices = [[number(text) for text in head[name]] for name in ("weights", "prices")]
    need(min(weights) >= 0 and sum(weights) == 1, "weights are >= 0 and sum to 1")
    need(min([ZERO, *prices]) >= 0, "prices are >= 0")
    members = list[list[Fraction]]()
    for m in range(len(weights)):
        decided = {x: line["members"][m] for x, line in enumerate(proof) if line["members"][m]}
        members.append(model.above(decided, f"member {m}"))
    if model.share is not None:  # 1 - share * greatest goal probability, from both sides
        row, free = model.rows[0], model.staying(model.live, [True] * len(model.pairs))[0]
        w = [down(number(line["w"])) for line in proof]
        row.bound = 1 - model.share * (1 - model.below(w, row.quantity, free, sure=False))
        row.loose = 1 - model.share * (1 - min(member[1] for member in members))
    v = [down(number(line["v"])) for line in proof]
    lower = model.below(v, model.priced(prices), model.free, sure=bool(model.keeps))
    attained = [
        sum(map(Fraction.__mul__, weights, taken), ZERO) for taken in zip(*members, strict=True)
    ]
    exceeded = {}
    for row, taken in zip(model.rows, attained[1:], strict=True):
        if taken > row.bound:
            exceeded[row.name] = taken - row.bound
            if taken - row.bound > EXCESS * abs(row.bound):
                refuse("lottery <= bound", f"row {row.name}", down(taken), down(row.bound))
    ends = (-attained[0], -lower) if question["greatest"] else (lower, attained[0])
    return Checked(True, "", *ends, exceeded, str(question["asked"]), digest)


if __name__ == "__main__":
    results = [check_certificate(path) for path in sys.argv[1:]]
    print("\n".join(map(str, results)) or __doc__)
    sys.exit(0 if results and all(result.accepted for result in results) else 1)
