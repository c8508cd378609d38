"""Check a certificate of an optimum by exact inequalities: ``python checker.py FILE``.

It needs Python's standard library alone, solves nothing, and trusts nothing but the question and
the model in the file. The file is gzip, a JSON text a line: the question, a line a state, the head
of the proof with the SHA-256 of all lines before, a line of proof a state. Numbers are texts;
probabilities of an action, and of the start, are divided by their exact sum. With a discount gamma
each step goes on, or ends, with probability gamma times its own; its costs are paid in full.

Question: a policy moves until it comes to the goal, comes to a dead-end (no way leads from there
to the goal), gives up where it may, or wanders for ever. Quantities are sums of expected costs,
visits (arrivals, the start among them) and probabilities of ends. If the failing step is charged,
each cost charges on entering a dead-end the least mean of its actions, and on giving up that of
all actions ("anywhere") or of those after which the goal can still surely be avoided ("attention").
Sought is the best lottery over policies within the rows.

Proof: rows become q <= b where costs, visits and ends have weights >= 0, ends of negative weight by
their complement. Let c = objective + prices * rows, prices >= 0. Below: v(x) <= c(x, u) + sum p v
for each action, v(x) <= what giving up takes. A policy within the rows goes on for ever by actions
that are free in the objective and all rows, else it pays infinitely much; so it comes to where they
can go on for ever, and there v(x) <= what wandering takes. So no lottery within the rows attains
less than v at the start less prices * b. Where no failure is allowed, only actions count that keep
the goal sure. A share of the greatest goal probability, or all of it ("least"), is bounded from two
sides: failure by w as the objective is by v, and by what a member fails. Above: on the states that
a member of the lottery comes to, t >= 1 + sum p t, so that it ends, and u >= own + sum p u for the
objective and each row, so that it takes at most u.
"""

import gzip
import hashlib
import json
import re
import sys
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from math import lcm
from typing import Any

FORMAT, ZERO = "ssp-lp certificate 1", Fraction(0)
ONE = 10**60  # a proof's numbers are compared in units of 1/ONE, rounded against the proof
EXCESS = Fraction(1, 10**9)  # of a bound: so much a lottery may exceed it, which is told
KEYS = "asked charge_failing_step costs discount failure format give_up greatest objective rows"
OPTIONAL = {"charge", "ratio"}  # keys of questions that have them
NUMBER = re.compile(r"-?[0-9]+(/[0-9]+|(\.[0-9]+)?([eE][-+]?[0-9]+)?)")
Pair = tuple[str, int, list[tuple[int, int]], list[Fraction], list[Fraction]]
Charge = Callable[[int], int]  # of a total, in units
FAILURE = {"constant": "1", "terms": [["-1", "end", "goal"]]}
NOTHING: dict[str, Any] = {"constant": "0", "terms": []}


class RefusedError(Exception):
    """A claim that does not follow: which inequality fails, and where."""


def need(holds: bool, *words: object) -> None:
    """Refuse the certificate being checked, in these words, unless something holds."""
    if not holds:
        raise RefusedError(" ".join(map(str, words)))


def at_most(left: int, right: int, *words: object) -> None:
    """Refuse the certificate being checked unless an inequality in units holds."""
    if left > right:
        need(False, *words, "fails:", f"{left / ONE:.17g} > {right / ONE:.17g}")


@cache
def number(text: str) -> Fraction:
    """Number that a text of the checked certificate states."""
    need(isinstance(text, str) and len(text) < 4000, "no text of a number:", repr(text)[:99])
    need(NUMBER.fullmatch(text) is not None, "no decimal and no fraction:", repr(text)[:99])
    exponent = text.lower().partition("e")[2]
    need(not exponent or abs(int(exponent)) < 4000, text, "has too large an exponent")
    return Fraction(text)


def whole(value: Any, below: int) -> int:
    """Whole number >= 0 below another, in the checked certificate."""
    need(type(value) is int and 0 <= value < below, repr(value), "is no whole number below", below)
    return int(value)


def down(value: Fraction) -> int:
    """Number of the checked certificate in units of 1/ONE, rounded down; ``-down(-value)``: up."""
    return value.numerator * ONE // value.denominator


def dot(weights: Iterable[Fraction], values: Iterable[Fraction]) -> Fraction:
    """Weighted sum of the checker's numbers."""
    return sum((w * c for w, c in zip(weights, values, strict=True) if w), ZERO)


class Places(dict[tuple[int, int], int]):
    """Nodes of the checked proof, by state and total."""

    def __missing__(self, key: tuple[int, int]) -> int:
        raise RefusedError(f"no line of the proof tells of state {key[0]} at total {key[1]} units")


class Quantity:
    """A quantity counted with weights >= 0, and a constant; as a row it has a bound."""

    charge: Charge | None = None  # of the total at the goal

    def __init__(self, model: "Model", stated: Mapping[str, Any], sign: int, name: str) -> None:
        n, self.name, self.stop = len(model.names), name, ZERO
        self.bound = self.loose = ZERO  # what a lottery keeps to; what none within the row exceeds
        self.constant = sign * number(stated["constant"])
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
            self.arrival[x] += dot(self.costs, model.failing[x])

    def at_stop(self, model: "Model", x: int, free: set[int]) -> Fraction | None:
        """Checker's count of giving up in x, or of wandering in free states; None: not possible."""
        if x in free or x not in model.giving_up:
            return self.stop if x in free else None
        return self.stop + dot(self.costs, model.failing[x])


class Model:
    """The question and the model of a file, and what follows from its graph."""

    def __init__(self, question: dict[str, Any], lines: Sequence[bytes]) -> None:
        need(question.get("format") == FORMAT, "this is no certificate of this format")
        known = {*KEYS.split(), "sets", "start", "states"}
        need(known <= set(question) <= known | OPTIONAL, "an unknown question")
        self.question, self.n_costs, n = question, whole(question["costs"], 1000), len(lines)
        self.sets: dict[str, set[int]] = {name: set() for name in ["goal", *question["sets"]]}
        gamma = number("1" if question["discount"] is None else question["discount"])
        need(0 < gamma <= 1, "a discount lies in (0, 1)")
        self.gamma, self.counts = gamma, "charge" in question
        self.names, self.of, self.home = list[str](), list[range](), list[int]()
        self.pairs = list[Pair]()
        for x, state in enumerate(map(json.loads, lines)):
            self.names.append(str(state["name"]))
            for name in state["sets"]:
                self.sets[name].add(x)
            self.pairs += [self._pair(action, n, gamma) for action in state["actions"]]
            self.of.append(range(len(self.home), len(self.pairs)))  # the pairs of a state
            self.home += [x] * len(self.of[x])
        self.names.append("what a discount takes")  # state n: a dead-end without actions
        self.of.append(range(0))
        goal, states, self.every = self.sets["goal"], set(range(n + 1)), [True] * len(self.pairs)
        need(not goal & set(self.home), "a goal has actions")
        self.before: list[list[int]] = [[] for _ in self.names]  # pairs that may lead to a state
        for k, pair in enumerate(self.pairs):
            for _, y in pair[2]:
                self.before[y].append(k)
        self.dead = states - self.reaching(self.every)
        self.ended, self.live = goal | self.dead, states - goal - self.dead
        start = [(number(p), whole(x, n)) for p, x in question["start"]]
        total = sum(p for p, _ in start) or ZERO
        need(total > 0 and min(start)[0] >= 0, "the start is no distribution")
        self.start = [(p / total, x) for p, x in start if p > 0]
        self._charge(*self.staying(states - goal, self.every))
        self._ask(gamma == 1)
        self._keep_sure()

    def _charge(self, attention: set[int], stays: Sequence[bool]) -> None:
        """States where the checked model may give up, and what failing charges of each cost."""
        where, charged = self.question["give_up"], self.question["charge_failing_step"]
        need(where in ("anywhere", "attention", "dead_ends"), "give_up is", where)
        places = {"anywhere": self.live, "attention": self.live & attention}
        self.giving_up, self.failing = places.get(where, set()), dict[int, list[Fraction]]()
        for x in self.dead | self.giving_up:
            paid = [k for k in self.of[x] if charged and (stays[k] or where == "anywhere")]
            means = [[c / self.pairs[k][1] for c in self.pairs[k][3]] for k in paid]
            self.failing[x] = list(map(min, zip(*means, strict=True))) or [ZERO] * self.n_costs

    def _ask(self, exact: bool) -> None:
        """Objective and rows of the checked question, and where wandering is free in them."""
        question, budget = self.question, self.question["failure"]
        self.sign = -1 if question["greatest"] else 1
        self.objective = Quantity(self, question["objective"], self.sign, "objective")
        self.share = number(budget["share"]) if isinstance(budget, dict) else None
        need(self.share is None or 0 <= self.share <= 1, "a share is no probability")
        exact = exact or (self.share is None and budget != "least")
        need(exact, "a share, or least failure, is of the real probability: without discount")
        self.ratio = question.get("ratio", False)
        need(self.ratio in (False, not question["greatest"]), "a ratio is to be small")
        is_limited = self.ratio or budget is not None
        self.rows = [Quantity(self, FAILURE, 1, "failure")] if is_limited else []
        if is_limited and budget != "least" and self.share is None:
            self.rows[0].bound = self.rows[0].loose = number(budget or "1")
        for row in question["rows"]:
            sign, side = (1, "at_most") if "at_most" in row else (-1, "at_least")
            need(row.keys() == {"name", "quantity", side}, "a row has a name and one bound")
            self.rows.append(q := Quantity(self, row["quantity"], sign, str(row["name"])))
            q.bound = q.loose = sign * number(row[side]) - q.constant
            q.constant = ZERO
        self.each, self.slopes = [self.objective, *self.rows], Quantity(self, NOTHING, 1, "slope")
        paying = [k for k in range(self.n_costs) if any(q.costs[k] for q in self.each)]
        seen = {x for x in self.live if any(q.visits[x] for q in self.each)}
        costless = [not any(p[3][k] for k in paying) and all(y not in seen for _, y in p[2])
                    for p in self.pairs]  # fmt: skip
        self.free = self.staying(self.live, costless)[0]

    def _keep_sure(self) -> None:
        """States and pairs for the checker's lower bound: all, or those that keep the goal sure."""
        goal, budget = self.sets["goal"], self.question["failure"]
        sure, last, keeps = self.live, {-1}, self.every
        while sure != last:
            last = sure
            keeps = [x in last and all(y in last or y in goal for _, y in p[2])
                     for x, p in zip(self.home, self.pairs, strict=True)]  # fmt: skip
            sure = self.reaching(keeps) & last
        is_sure = {x for _, x in self.start} <= sure | goal
        if budget == "least" and not is_sure:
            self.share = Fraction(1)  # all of the greatest goal probability
        self.may_fail = budget is None or self.share is not None or self.rows[0].bound != 0
        need(self.may_fail or is_sure, "failure 0: the goal can be reached surely, fails")
        self.moving, self.keeps = (self.live, self.every) if self.may_fail else (sure, keeps)

    def _pair(self, stated: Any, n: int, gamma: Fraction) -> Pair:
        """A pair of the checked model: name, total T, outcomes (a, y) of probability a / T, costs.

        With a discount 1 - gamma of every step comes to state n, whose failing costs nothing.
        """
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
        goes, of, total = gamma.numerator, gamma.denominator, sum(parts)
        outcomes = [(a * goes, whole(y, n)) for a, (_, y) in zip(parts, told, strict=True) if a]
        outcomes += [(total * (of - goes), n)] if goes < of else []
        first = [c for a, c in zip(parts, (each or [[ZERO] * len(parts)])[0], strict=True) if a]
        first += [ZERO] * (len(outcomes) - len(first))
        return str(name), total * of, outcomes, [of * cost for cost in paid], first

    def reaching(self, allowed: Sequence[bool]) -> set[int]:
        """States of the checked model from which allowed pairs may lead to the goal."""
        reached, ahead = set(self.sets["goal"]), list(self.sets["goal"])
        while ahead:
            more = {self.home[k] for k in self.before[ahead.pop()] if allowed[k]} - reached
            reached.update(more)
            ahead.extend(more)
        return reached

    def staying(self, states: set[int], allowed: Sequence[bool]) -> tuple[set[int], list[bool]]:
        """Largest part of some checked states with no pairs, or an allowed one that stays."""
        inside, stays = set(states), [allowed[k] and x in states for k, x in enumerate(self.home)]
        left = [sum(stays[k] for k in self.of[x]) for x in range(len(self.names))]
        lost = [x for x in range(len(left)) if x not in states or (self.of[x] and not left[x])]
        while lost:
            inside.discard(y := lost.pop())
            for k in self.before[y]:
                if stays[k]:
                    stays[k], x = False, self.home[k]
                    left[x] -= 1
                    lost += [] if left[x] else [x]
        return inside, stays

    def spread(self, cap: Fraction, listed: Sequence[tuple[int, Fraction]]) -> None:
        """Nodes of the checked proof: all states from a total on, and below it those listed.

        Totals are told in a unit of which each is a multiple, as each step of the first cost.
        """
        stated = self.question.get("charge", [])
        steps = [(number(after), value, number(slope)) for after, value, slope in stated]
        told = {cap, *(t for _, t in listed), *(t for t, _, _ in steps)}
        told.update(*(pair[4] for pair in self.pairs) if self.counts else ())
        self.unit = lcm(*(t.denominator for t in told))
        self.cap, goes, of = int(cap * self.unit), *self.gamma.as_integer_ratio()
        self.nodes, self.place = [(x, self.cap) for x in range(len(self.names))], Places()
        for x, total in listed:
            need(x in self.live and 0 <= total < cap, "a line is of a total below the cap, fails")
            self.place[x, int(total * self.unit)] = len(self.nodes)
            self.nodes.append((x, int(total * self.unit)))
        if self.counts:
            self.moves = [[(a, y, int(t * self.unit)) for (a, y), t in zip(p[2], p[4], strict=True)]
                          for p in self.pairs]  # fmt: skip
            self.comes = [[(a // goes * of, t) for a, y, t in moves if y in self.sets["goal"]]
                          for moves in self.moves]  # fmt: skip
            low, high = ([(t, self.sign * number(v[i] if isinstance(v, list) else v), self.sign * s)
                          for t, v, s in steps] for i in (0, -1)[:: self.sign])  # fmt: skip
            self.low, self.objective.charge = self.ladder(low, 1), self.ladder(high, -1)

    def ladder(self, steps: Sequence[tuple[Fraction, ...]], side: int) -> Charge:
        """Charge of totals in the checked proof, rounded down (side 1), or negative and up (-1).

        After each start, the first of which is <= 0, it is a value and a slope times the excess.
        """
        starts = [int(start * self.unit) for start, _, _ in steps]
        need(starts[0] <= 0 and starts == sorted(set(starts)), "a charge begins at 0, fails")
        need(len(starts) == 1 or starts[-1] < self.cap, "the charge is a line from the cap on")
        need(steps[-1][2] >= 0, "the charge does not fall in the end, fails")
        self.rise = steps[-1][2]

        @cache
        def charge(r: int) -> int:
            k = max(bisect_left(starts, r) - 1, 0)
            _, value, slope = steps[k]
            return down(side * (value + slope * Fraction(r - starts[k], self.unit)))

        return charge

    def at(self, x: int, r: int) -> int:
        """Node of a state of the checked model at a total."""
        return x if r >= self.cap or x in self.ended else self.place[x, r]

    def leads(self, k: int, r: int) -> list[tuple[int, int]]:
        """Nodes that a checked pair leads to from a total: (a, node), of probability a / T."""
        if not self.counts:
            return self.pairs[k][2]
        return [(a, self.at(y, r + t)) for a, y, t in self.moves[k]]

    def charged(self, k: int, r: int, charge: Charge | None, slope: Sequence[int]) -> int:
        """T times what a checked pair takes by totals: at the goal, and by slopes past the cap."""
        if charge is None:
            return 0
        taken, far = sum(a * charge(r + t) for a, t in self.comes[k]), r - self.cap
        if not slope:
            return taken
        past = sum(a * slope[y] * (far + t) for a, y, t in self.moves[k] if far + t > 0)
        return taken + past // self.unit

    def begin(self, after: Sequence[int], r: int, charge: Charge | None) -> Fraction:
        """Checked mean over the start at a total, of what comes after arriving."""
        charges = {x: charge(0) if charge and x in self.sets["goal"] else 0 for _, x in self.start}
        return sum(
            (p * Fraction(after[self.at(x, r)] + charges[x], ONE) for p, x in self.start), ZERO
        )

    def priced(self, prices: Sequence[Fraction]) -> Quantity:
        """Checked objective, and at prices the excess of rows over their bounds."""
        c = Quantity(self, self.question["objective"], self.sign, "priced")
        c.charge = self.low if self.counts else None
        for price, row in zip(prices, self.rows, strict=True):
            c.constant += price * (row.constant - row.loose)
            c.stop += price * row.stop
            c.costs = [a + price * b for a, b in zip(c.costs, row.costs, strict=True)]
            c.arrival = [a + price * b if b else a
                         for a, b in zip(c.arrival, row.arrival, strict=True)]  # fmt: skip
        return c

    def below(
        self, v: Sequence[int], c: Quantity, free: set[int], slope: Sequence[int] = ()
    ) -> Fraction:
        """Checked lower bound of c that v proves, every inequality of it."""
        nodes, own = self.nodes[: len(v)], [down(dot(c.costs, p[3])) for p in self.pairs]
        arrival = [down(a) for a in c.arrival]
        after = [arrival[x] + (v[i] if x in self.moving else 0) for i, (x, _) in enumerate(nodes)]
        for i, (x, r) in enumerate(nodes):
            if x not in self.moving:
                continue
            stop = c.at_stop(self, x, free) if self.may_fail else None
            if stop is not None:
                at_most(v[i], down(stop), "v <= giving up or wandering in", self.name_of(i))
            for k in self.of[x]:
                if self.keeps[k]:
                    most = own[k] + sum(a * after[j] for a, j in self.leads(k, r))
                    most += self.charged(k, r, c.charge, slope)
                    name, total, *_ = self.pairs[k]
                    if v[i] * total > most:
                        at_most(v[i], most // total, "v <= c + sum p v at", self.name_of(i), name)
        r = 0 if len(v) == len(self.nodes) else self.cap
        return c.constant + self.begin(after, r, c.charge)

    def name_of(self, i: int) -> str:
        """Name of a node of the checked proof."""
        (x, r), total = self.nodes[i], "" if i < len(self.names) else " at total "
        return self.names[x] + (total and f"{total}{Fraction(r, self.unit)}")

    def above(self, member: Mapping[int, Sequence[Any]], words: str) -> list[Fraction]:
        """Checked upper bound of a member's objective and rows. Values are those of - u."""
        each, n = [self.slopes, *self.each, *[self.slopes][: self.counts]], len(self.names)
        u = {i: [down(-number(text)) for text in entry[1:]] for i, entry in member.items()}
        sizes = {len(q) - (self.counts and i < n) for i, q in u.items()}
        need(sizes <= {1 + len(self.each)}, words, "a number a row, fails")
        arrival = [[down(-a) for a in q.arrival] for q in each]
        after = [[values[x] + (u[i][j] if i in u and j < len(u[i]) else 0)
                  for i, (x, _) in enumerate(self.nodes)]
                 for j, values in enumerate(arrival)]  # fmt: skip
        decided, names = self.ended | member.keys(), ["1", *(q.name for q in each[1:])]
        self.slopes.charge = lambda r: down(-self.rise)
        charges = [None, *(q.charge for q in each[1:])]
        slope = [u[x][-1] if self.counts and x in u else 0 for x in range(n)]
        need(
            decided >= {self.at(x, 0) for _, x in self.start}, words, "decides at the start, fails"
        )
        for i, (decision, *_) in member.items():
            x, r = self.nodes[i]
            need(x in self.live, words, "decides where nothing has ended, fails in", self.names[x])
            total, leads, own, k = 1, list[tuple[int, int]](), [Fraction(1)], -1
            if decision == "stop":
                stops = [q.at_stop(self, x, self.free) for q in each[1:]]
                own += [stop for stop in stops if stop is not None]
                need(None not in stops, words, "stops where it may, fails in", self.names[x])
            else:
                k = self.of[x].start + whole(decision, len(self.of[x]))
                total, leads = self.pairs[k][1], self.leads(k, r)
                own = [Fraction(total), *(dot(q.costs, self.pairs[k][3]) for q in each[1:])]
            need(decided >= {j for _, j in leads}, words, "decides after", self.name_of(i))
            for j, value in enumerate(u[i]):
                most = down(-own[j]) + sum(a * after[j][y] for a, y in leads)
                most += self.charged(k, r, charges[j], slope if j == 1 else ()) if k >= 0 else 0
                if value * total > most:
                    what = words, names[j], "+ sum p u <= u at", self.name_of(i), decision
                    at_most(-(most // total), -value, *what)
        return [q.constant - self.begin(values, 0, q.charge)
                for q, values in zip(self.each, after[1:], strict=False)]  # fmt: skip

    def slopes_below(self, proof: Sequence[Mapping[str, Any]]) -> list[int]:
        """Checked slopes of v in the total, of each state from the cap on; empty if all are 0."""
        slope = [
            down(number(line["slope"])) if x in self.moving else 0 for x, line in enumerate(proof)
        ]
        slope, self.slopes.charge = [*slope, 0], lambda r: down(self.rise)
        self.below(slope, self.slopes, self.staying(self.live, self.every)[0])
        return slope if any(slope) else []

    def given_success(self, bound: Fraction, price: Fraction) -> Fraction:
        """Checked bound of cost / goal from that of cost + price * (failure - most failure)."""
        most = self.rows[0].loose  # a ratio of two lines, least at failure 0 or at the most
        need(most < 1 or bound >= 0, "0 <= cost + price * (failure - 1) of all policies, fails")
        return min([bound + price * most, *([bound / (1 - most)] if most < 1 else [])])

    def set_share(self, w: Sequence[int], members: Iterable[Sequence[Fraction]]) -> None:
        """Set the checked budget 1 - share * greatest goal probability, from both sides."""
        row, free = self.rows[0], self.staying(self.live, self.every)[0]
        row.bound = 1 - Fraction(self.share or 0) * (1 - self.below(w, row, free))
        row.loose = 1 - Fraction(self.share or 0) * (1 - min(member[1] for member in members))


@dataclass(frozen=True)
class Checked:
    """Proved result of a certificate: an interval that holds the optimum, or why it is refused."""

    accepted: bool
    reason: str = ""  # the inequality that fails, and where
    lower: Fraction = ZERO
    upper: Fraction = ZERO  # what the lottery attains
    exceeded: Mapping[str, Fraction] = field(default_factory=dict)  # rows, and by how much
    asked: str = ""  # the question in the writer's words, from which nothing is concluded
    digest: str = ""  # SHA-256 of the question and the model

    def __str__(self) -> str:
        """The verdict in a few lines."""
        lines = [f"accepted: {self.asked}", f"  SHA-256   {self.digest}"]
        for name, bound in (("at least", self.lower), ("at most", self.upper)):
            exact, digits = str(bound), f"{abs(round(bound * 10**25)):026d}"
            exact = exact if len(exact) < 60 else f"{exact[:24]}...{exact[-24:]}"
            sign = "-" if bound < 0 else ""
            lines.append(f"  {name:<9} {sign}{digits[:-25]}.{digits[-25:]} = {exact}")
        lines.append(f"  width     {float(self.upper - self.lower):.1e}")
        for name, excess in self.exceeded.items():
            lines.append(f"  the lottery exceeds row {name} by {float(excess):.1e}")
        return "\n".join(lines) if self.accepted else f"refused: {self.reason}"


def check_certificate(path: Any) -> Checked:
    """Check the certificate in a file of this name: an interval that holds the optimum.

    Where the answer is not ``accepted``, it says which inequality fails where.
    """
    with open(path, "rb") as file:
        packed = file.read()
    try:
        return check_lines(gzip.decompress(packed).splitlines())
    except RefusedError as error:
        return Checked(False, str(error))
    except Exception as error:  # whatever a damaged file may lead to
        return Checked(False, f"the file is damaged: {type(error).__name__}: {error}")


def check_lines(lines: Sequence[bytes]) -> Checked:
    """Check the lines of a certificate's file; raises where it is refused."""
    question = json.loads(lines[0])
    n = whole(question["states"], len(lines))
    need(len(lines) >= 2 * n + 2, len(lines), "lines where there should be", 2 * n + 2)
    digest, head = hashlib.sha256(b"\n".join(lines[: n + 1])).hexdigest(), json.loads(lines[n + 1])
    need(digest == head.get("sha256"), "the SHA-256 is not that of the question and the model")
    model, proof = Model(question, lines[1 : n + 1]), [json.loads(line) for line in lines[n + 2 :]]
    expected = {"sha256", "prices", "weights", *["cap"][: model.counts]}
    need(head.keys() == expected, "the proof has no head in line", n + 2)
    need(model.counts or len(proof) == n, len(lines), "lines where there should be", 2 * n + 2)
    weights, prices = [[number(text) for text in head[name]] for name in ("weights", "prices")]
    need(min(weights) >= 0 and sum(weights) == 1, "weights are >= 0 and sum to 1, fails")
    need(min([ZERO, *prices]) >= 0, "prices are >= 0, fails")
    need(len(prices) == len(model.rows), len(prices), "prices of", len(model.rows), "rows")
    keys = {"v", "members", *["w"][: model.share is not None], *["slope"][: model.counts]}
    told = {line.keys() == keys and len(line["members"]) for line in proof[:n]}
    keys = {"v", "members", "state", "total"}
    told |= {line.keys() == keys and len(line["members"]) for line in proof[n:]}
    need(told == {len(weights)}, "a line of proof has values, and each member, fails")
    listed = [(whole(line["state"], n), number(line["total"])) for line in proof[n:]]
    model.spread(number(head.get("cap", "0")), listed)
    places, members = [*range(n), *range(n + 1, len(proof) + 1)], list[list[Fraction]]()
    for m in range(len(weights)):
        decided = {i: line["members"][m] for i, line in zip(places, proof, strict=True)
                   if line["members"][m]}  # fmt: skip
        members.append(model.above(decided, f"member {m}:"))
    if model.share is not None:
        model.set_share([down(number(line["w"])) for line in proof[:n]], members)
    c, v = model.priced(prices), [down(number(line["v"])) for line in proof]
    v[n:n] = [0]
    slope = model.slopes_below(proof[:n]) if model.counts else []
    lower, exceeded = model.below(v, c, model.free, slope), dict[str, Fraction]()
    upper, *taken = [dot(weights, each) for each in zip(*members, strict=True)]
    for row, value in zip(model.rows, taken, strict=True):
        if value > row.bound:
            exceeded[row.name] = value - row.bound
            if value - row.bound > EXCESS * abs(row.bound):
                at_most(down(value), down(row.bound), "lottery <= bound of row", row.name)
    if model.ratio:
        need(taken[0] < 1, "the lottery reaches the goal, fails")
        lower = model.given_success(lower, prices[0])
        upper = max(upper, upper / (1 - taken[0]))
    ends = (-upper, -lower) if question["greatest"] else (lower, upper)
    return Checked(True, "", *ends, exceeded, str(question["asked"]), digest)


if __name__ == "__main__":
    results = [check_certificate(path) for path in sys.argv[1:]]
    print("\n".join(map(str, results)) or __doc__)
    sys.exit(0 if results and all(result.accepted for result in results) else 1)
