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
objective and each row, so that it takes at most u. By 1e-24 of its bound, or of 1, it may exceed
a row, which is told: what it attains is then attained within bounds that are so much looser, for
which the bound from below is proved, too: each price is paid for the bound, or for what the lottery
takes if that is more. So no interval ends below where it begins.

A ratio is objective / goal probability, "failure" its first row, with the bound 1 if none is asked:
N + price * F >= b of all lotteries within the rows bounds N / (1 - F) for each failure F that is
allowed, and is least at one of its ends. A lottery attains no more than its N / (1 - its F).

Totals: a charge is a function of what a run that reaches the goal has paid of the first cost, paid
with the step into the goal. Nodes are states with a total below the cap, of which the proof has
lines, and states from the cap on. A pair leads from a node to others by the model's own costs, and
a node that is led to must have a line; a value from the cap on is v + slope * (total - cap). From
there on charges are lines, so the inequality at the cap and slope(x) <= mean slope, that of the
charge at the goal, prove all others. Such slopes are at most 0 where the goal can be avoided for
ever: only there do runs go on without end, and totals grow no faster than steps, so that what runs
on elsewhere has no share in the limit. A quantile B is proved by a lottery that exceeds it rarely
enough, and by v for the charge 1 from B on: whatever is done, that is too often.

Cases: what is bounded from below may be told apart, each case with prices and v of its own; proved
is the least of their bounds. A tail mean is the least over thresholds z of the charge
z + max(T - z, 0) / (1 - level) of the total T. Given what a lottery does, that is convex in z and a
line between totals that occur, and z <= it: so z is a total at the goal, to which lines of the
proof must lead. A case holds the z up to its end, from the first one beyond the last end, by a
charge that is nowhere more than that of any such z. What is beyond all ends is at least the next
total, as z is. Above, the lottery is charged at one z; the tail mean is no more.

A deterministic policy takes one decision in each state, or at each total in each state: an action,
or to stop, which is to give up where it may, or to wander for ever where that is free. A tree of
cases tells apart what it decides at a node (a state, or a state with a total below the cap): parts
that together hold all decisions that are left there, each with a tree of its own. So a policy is in
a case all of whose parts hold its decisions, and v there need bound these alone: v(x) <= c(x, u) +
sum p v for the decisions u that are left, and v(x) <= what giving up takes if to stop is left. Who
goes on for ever comes, as above, to where that is free by the actions that are left, or passes the
cap; there v(x) <= what wandering takes. A file's lottery has one member, which exceeds no row.

After failing, runs may go on, and count. To fail is to enter a dead-end, or to give up. Then a run
goes on, in dead-ends by all actions, elsewhere by those after which the goal can still surely be
avoided, to its true end: a dead-end that has no actions, or lies in a set whose end the question
names; or it wanders for ever. So there is each state x, and x after failing; to give up where the
goal can be avoided is part of an action that avoids it, and elsewhere ends the run. Costs and
visits are counted until failing, or "through" it to the end of the run; ends are the true ones.
What failing charges belongs to costs until failing, and to those through it where the run ends with
it. All inequalities are those of these states. Totals are not told apart where the goal is lost.

Claim: what the solution that is proved said, at least and at most. It must hold the interval.
"""

import gzip
import hashlib
import json
import re
import sys
from bisect import bisect, bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache, lru_cache
from itertools import islice
from math import floor, lcm
from typing import Any, NamedTuple

FORMAT, ZERO = "ssp-lp certificate 1", Fraction(0)
ONE = 10**60  # units in 1 that a proof's numbers are compared in, rounded against the proof
EXCESS = Fraction(1, 10**24)  # of a bound, or of 1: so much a lottery may exceed it, told
LINE, FILE, TIMES = 1 << 24, 1 << 29, 100  # most bytes of a line; of all; per byte, behind a line's
SHORTEST = 24  # bytes of a line of a state, or of a node, at least
SHOWN = 200  # letters of a name, and ten times as many of a reason
KINDS = {"asked": str, "charge_failing_step": bool, "greatest": bool, "rows": list, "sets": list}
KEYS = "asked charge_failing_step costs discount failure format give_up greatest objective rows"
NUMBER = re.compile(r"-?[0-9]+(/[0-9]+|(\.[0-9]+)?([eE][-+]?[0-9]+)?)")
COUNTING = {"charge", "quantile", "tail_mean"}  # keys of questions, one at most, of totals
WHILE, THROUGH = ("cost", "visits", "end"), ("cost through", "visits through")  # failing
YES = ("ratio", "deterministic", "after_failing")  # keys of questions that may be left out
FAILURE = {"constant": "1", "terms": [["-1", "end", "goal"]]}
NOTHING: dict[str, Any] = {"constant": "0", "terms": []}
Pair = tuple[str, int, list[tuple[int, int, int]], list[Fraction]]
Charge = Callable[[int], int]  # of a total, in units
Step = tuple[int, Fraction, Fraction, Fraction]  # of a charge: start, value, slope, where from


class Case(NamedTuple):
    """Part of all that is to be bounded from below, with a proof of its own."""

    prices: list[Fraction]
    low: Charge | None  # of a total, at most any that is in question
    only: Mapping[int, Set[int]]  # decisions of nodes, -1 to stop; of others all are left


class RefusedError(Exception):
    """A claim that does not follow: which inequality fails, and where."""


def printable(text: str) -> str:
    """Text of the checked file, none of whose characters acts on what shows it; not all if long."""
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text[:SHOWN])


def need(holds: bool, *words: object) -> None:
    """Refuse the certificate being checked, in these words, unless something holds."""
    if not holds:
        raise RefusedError(" ".join(printable(str(word)) for word in words)[: 10 * SHOWN])


@lru_cache(1 << 14)
def number(text: str) -> Fraction:
    """Number that a text of the checked certificate states."""
    need(isinstance(text, str) and len(text) < 4000, "no text of a number:", repr(text)[:99])
    need(NUMBER.fullmatch(text) is not None, "no decimal and no fraction:", repr(text)[:99])
    exponent = text.lower().partition("e")[2]
    need(not exponent or abs(int(exponent)) < 4000, text, "has too large an exponent")
    return Fraction(text)


def read(line: bytes) -> Any:
    """Content of a line of the checked certificate, in which no key comes twice."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        need(len(dict(pairs)) == len(pairs), "a key comes twice:", *(key for key, _ in pairs))
        return dict(pairs)

    return json.loads(line, object_pairs_hook=once)


def fields(stated: Any, **kinds: type) -> list[Any]:
    """Values of an object in the checked certificate: of these keys, and types, and no others."""
    need(type(stated) is dict, "no object:", repr(stated)[:99])
    need(stated.keys() == kinds.keys(), "the keys", *stated, "where", *kinds, "should be")
    for key, kind in kinds.items():
        need(type(stated[key]) is kind, key, "is no", f"{kind.__name__}:", repr(stated[key])[:99])
    return [stated[key] for key in kinds]


def whole(value: Any, below: int) -> int:
    """Whole number >= 0 below another, in the checked certificate."""
    need(type(value) is int and 0 <= value < below, repr(value), "is no whole number below", below)
    return int(value)


class Lazily(dict[int, int]):
    """Numbers of the checked certificate, each worked out when it is asked for."""

    def __init__(self, work_out: Callable[[int], int]) -> None:
        self.work_out = work_out

    def __missing__(self, key: int) -> int:
        self[key] = result = self.work_out(key)
        return result


def read_state(line: bytes) -> list[Any]:
    """Name, sets and actions of a state of the checked model."""
    return fields(read(line), name=str, sets=list, actions=list)


def dot(weights: Iterable[Fraction], values: Iterable[Fraction]) -> Fraction:
    """Weighted sum of the checker's numbers."""
    return sum((w * c for w, c in zip(weights, values, strict=True) if w), ZERO)


class Quantity:
    """A quantity counted with weights >= 0, and a constant; as a row it has a bound."""

    def __init__(self, model: "Model", stated: Mapping[str, Any], sign: int, name: str) -> None:
        self.model, self.name = model, name
        self.stop = self.ending = ZERO  # of giving up or wandering; of ends, whichever they are
        # what a lottery keeps to; what none within the row exceeds; and what prices pay for
        self.bound = self.loose = self.paid = ZERO
        self.charge: Charge | None = None  # of the total at the goal
        self.free: set[int] | None = None  # where wandering is; None: as in all that is asked
        self.step = 0  # what a step takes
        self.weights: dict[str, dict[Any, Fraction]] = {kind: {} for kind in (*WHILE, THROUGH[1])}
        constant, terms = fields(stated, constant=str, terms=list)
        self.constant = sign * number(constant)
        for text, kind, what in terms:
            weight = sign * number(text)
            need(kind in WHILE + THROUGH[: 2 * bool(model.shift)], "no quantity is called", kind)
            if kind in ("cost", "cost through"):
                count = model.question["costs"]
                kind, what = "cost", whole(what, count) + count * (kind in THROUGH)
            else:
                need(what in model.sets, "there is no set", what)
            if kind == "end":
                model.need_ends(what)
                if weight < 0:  # P(end) = 1 - P(no such end)
                    self.constant += weight
                    self.stop = self.ending = self.stop - weight
            self.add(kind, what, weight)
        of_sets = [self.weights[kind] for kind in ("visits", "visits through")]
        less = {s for some in of_sets for s, weight in some.items() if weight < 0}
        self.is_mixed = bool(less)  # of sets that count negatively, and lie in others
        counts = [*self.weights["cost"].values(), *map(self.visits, model.states_of(less))]
        need(min(counts, default=0) >= 0, "costs or visits count negatively")

    def add(self, kind: str, what: Any, weight: Fraction) -> None:
        """Count more of a cost, or of a set of states of the checked model."""
        self.weights[kind][what] = self.weights[kind].get(what, ZERO) + weight

    def visits(self, x: int, *more: str) -> Fraction:
        """Checker's count of coming to a state, be it an end or not; of ends if that is named."""
        kinds, sets = self.model.kinds_of(x) + more, self.model.sets_of(x)
        some = [self.weights[kind] for kind in kinds if self.weights[kind]]
        return sum([weights[s] for weights in some for s in sets if s in weights], ZERO)

    def arrival(self, x: int) -> Fraction:
        """Checker's count of coming to a state, with what failing there charges."""
        model = self.model
        count = self.ending + self.visits(x, "end") if x in model.ended else self.visits(x)
        charges = x in model.failing and x not in model.giving_up
        return count + self.costs(model.failing[x]) if charges else count

    def costs(self, paid: Sequence[Fraction]) -> Fraction:
        """Checker's count of some costs."""
        return sum([weight * paid[at] for at, weight in self.weights["cost"].items()], ZERO)

    def at_stop(self, x: int) -> Fraction | None:
        """Checker's count of giving up in x, or of wandering in free states; None: not possible."""
        model = self.model
        if x in (model.free if self.free is None else self.free):
            return self.stop
        return self.stop + self.costs(model.failing[x]) if x in model.giving_up else None


class Model:
    """The question and the model of a file, and what follows from its graph."""

    one = ONE

    def __init__(self, question: dict[str, Any], states: Sequence[list[Any]]) -> None:
        need(question.get("format") == FORMAT, "this is no certificate of this format")
        known = {*KEYS.split(), "sets", "start", "states"}
        need(known <= set(question) <= known | COUNTING | {*YES}, "an unknown question")
        for key, kind in KINDS.items():
            need(type(question[key]) is kind, key, "is", repr(question[key])[:99])
        need(len(COUNTING & set(question)) <= 1, "one question of totals")
        self.question, self.n_costs, n = question, whole(question["costs"], 1000), len(states)
        self.sets: dict[str, set[int]] = {name: set() for name in ["goal", *question["sets"]]}
        self.gamma = number("1" if question["discount"] is None else question["discount"])
        need(0 < self.gamma <= 1, "a discount lies in (0, 1)")
        self.names, self.of, self.home = list[str](), list[range](), list[int]()
        self.pairs = list[Pair]()
        self.counts, self.unit = not COUNTING.isdisjoint(question), 1
        if self.counts:  # totals are multiples of 1 / unit
            first = [action[2][0] for state in states for action in state[2]]
            told = {t for cost in first for t in (cost if isinstance(cost, list) else [cost])}
            self.unit = lcm(*(number(text).denominator for text in told))
        self.within = [tuple(dict.fromkeys(sets)) for _, sets, _ in states]
        self.known_ends = set[str]()
        for x, (name, sets, actions) in enumerate(states):
            self.names.append(name)
            for one in sets:
                need(one in self.sets, "there is no set", one)
                self.sets[one].add(x)
            self.pairs += [self._pair(action, n) for action in actions]
            self.of.append(range(len(self.home), len(self.pairs)))  # the pairs of a state
            self.home += [x] * len(self.of[x])
        self.names.append("what a discount takes")  # state n: a dead-end without actions
        self.within.append(())
        self.of.append(range(0))
        goal, every, self.shift = self.sets["goal"], set(range(n + 1)), 0
        need(not goal & set(self.home), "a goal has actions")
        self._link()
        self.dead = every - self.reaching(self.every)
        self.ended, self.live = goal | self.dead, every - goal - self.dead
        start = [(number(p), whole(x, n)) for p, x in question["start"]]
        total = sum(p for p, _ in start) or ZERO
        need(total > 0 and min(start)[0] >= 0, "the start is no distribution")
        self.start = [(p / total, x) for p, x in start if p > 0]
        self.attention, stays = self.staying(every - goal, self.every)
        self._charge(self.attention, stays)
        self.ratio, self.is_single, goes_on = said = [question.get(key, False) for key in YES]
        for key, value in zip(YES, said, strict=True):
            need(type(value) is bool, key, "is", repr(value)[:99])
        self.still = self.ended  # where totals are no longer told apart
        if goes_on:
            self._go_on(stays)
        self._ask()
        self._keep_sure()

    def sets_of(self, x: int) -> Sequence[str]:
        """Sets that a state of the checked model lies in, after failing as before."""
        return self.within[x - self.shift if x >= self.shift > 0 else x]

    def kinds_of(self, x: int) -> tuple[str, ...]:
        """Visits that are counted on coming to a state of the checked model."""
        return THROUGH[1:] if x >= self.shift > 0 else ("visits", THROUGH[1])

    def states_of(self, sets: Iterable[str]) -> set[int]:
        """States of the checked model that lie in one of some sets, after failing as before."""
        inside = set[int]().union(*(self.sets[s] for s in sets))
        return inside | {x + self.shift for x in inside - self.sets["goal"] if self.shift}

    def need_ends(self, s: str) -> None:
        """Refuse the certificate being checked unless a run ends in each state of a set."""
        if s not in self.known_ends:
            need(self.states_of([s]) <= self.ended, "not all states end:", s)
            self.known_ends.add(s)

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

    def _link(self) -> None:
        """Pairs that may lead to each state of the checked model."""
        self.every = [True] * len(self.pairs)
        self.before: list[list[int]] = [[] for _ in self.names]
        for k, pair in enumerate(self.pairs):
            for _, y, _ in pair[2]:
                self.before[y].append(k)

    def _go_on(self, stays: Sequence[bool]) -> None:
        """Let runs of the checked model go on after failing: from state x, then called n + x.

        To give up where the goal can be avoided is part of an action that avoids it. Each cost is
        paid until failing, as it has been so far, and as a further one to the end of the run.
        """
        n, base, free = len(self.names), self.pairs, [ZERO] * self.n_costs
        told = [self.question["objective"], *(row["quantity"] for row in self.question["rows"])]
        named = {what for q in told for _, kind, what in q["terms"] if kind == "end"}
        ends = {x for x in self.dead if not self.of[x] or any(x in self.sets[s] for s in named)}
        quits = self.giving_up & self.attention
        old, self.pairs, self.of, self.home = self.of, list[Pair](), list[range](), list[int]()
        for state in range(2 * n):
            x, begun = state % n, len(self.pairs)
            for k in old[x] if x not in ends else ():
                name, total, moves, paid = base[k]
                later = [(a, y + n, 0) for a, y, _ in moves]
                if state in self.live:
                    self.pairs.append((name, total, moves, paid + paid))
                if state in quits and stays[k]:
                    owed = [total * c for c in self.failing[x]]
                    self.pairs.append((f"give up, {name}", total, later, owed + paid))
                if x in self.dead or (state - n in quits and stays[k]):
                    self.pairs.append((name, total, later, free + paid))
            self.of.append(range(begun, len(self.pairs)))
            self.home += [state] * len(self.of[state])
        self.names += [f"{name}, after failing" for name in self.names]
        self._link()
        every, goal = set(range(2 * n)), self.sets["goal"]
        self.failing = {x: c + (c if x in ends or x in self.live else free)
                        for x, c in self.failing.items() if x not in quits}  # fmt: skip
        self.giving_up, self.shift, self.n_costs = self.giving_up - quits, n, 2 * self.n_costs
        self.dead = every - goal - set(self.home)
        self.ended, self.live = goal | self.dead, set(self.home)
        self.still = goal | every - self.reaching(self.every)
        self.attention = self.staying(every - goal, self.every)[0]

    def _ask(self) -> None:
        """Objective and rows of the checked question, and where wandering is free in them."""
        question, budget = self.question, self.question["failure"]
        self.sign = -1 if question["greatest"] else 1
        need(not (question["greatest"] and self.ratio), "a ratio is to be small")
        alone = self.gamma == 1 and question["objective"] == NOTHING
        is_risk = "quantile" in question or "tail_mean" in question
        need(alone or not is_risk, "a quantile has no discount and no objective")
        need(self.ratio or not is_risk, "a quantile is one given success")
        self.share = number(*fields(budget, share=str)) if isinstance(budget, dict) else None
        need(self.share is None or 0 <= self.share <= 1, "a share is no probability")
        is_told = budget != "least" and self.share is None
        need(is_told or self.gamma == 1, "a share, or least failure, is without discount")
        is_limited = self.ratio or budget is not None
        self.rows = [Quantity(self, FAILURE, 1, "failure")] if is_limited else []
        if is_limited and is_told:
            self.rows[0].bound = self.rows[0].loose = self.rows[0].paid = number(
                "1" if budget is None else budget
            )
        for row in question["rows"]:
            sign, side = (1, "at_most") if "at_most" in row else (-1, "at_least")
            need(row.keys() == {"name", "quantity", side}, "a row has a name and one bound")
            self.rows.append(q := Quantity(self, row["quantity"], sign, str(row["name"])))
            q.bound = q.loose = q.paid = sign * number(row[side]) - q.constant
            q.constant = ZERO
        need(len({q.name for q in self.rows}) == len(self.rows), "two rows are called alike")
        self.objective = Quantity(self, question["objective"], self.sign, "objective")
        self.each = [self.objective, *self.rows]
        self.steps, self.slopes = (Quantity(self, NOTHING, 1, name) for name in ("1", "slope"))
        self.steps.step, self.steps.stop, self.slopes.free = 1, Fraction(1), self.attention
        paying = {k for q in self.each for k, weight in q.weights["cost"].items() if weight}
        counting = {(kind, s) for q in self.each if not q.is_mixed for kind in q.weights
                    for s, weight in q.weights[kind].items() if weight}  # fmt: skip
        mixed = [q for q in self.each if q.is_mixed]
        seen = {x for x in self.live if any(q.visits(x) for q in mixed) or not counting.isdisjoint(
            (kind, s) for kind in self.kinds_of(x) for s in self.sets_of(x))}  # fmt: skip
        costless = [not any(p[3][k] for k in paying) and all(y not in seen for _, y, _ in p[2])
                    for p in self.pairs]  # fmt: skip
        self.free = self.staying(self.live, costless)[0]
        self.waits = [free and not any(t for _, _, t in p[2])  # for nothing, the total as it is
                      for p, free in zip(self.pairs, costless, strict=True)]  # fmt: skip

    def _keep_sure(self) -> None:
        """States and pairs for the checker's lower bound: all, or those that keep the goal sure."""
        goal, budget = self.sets["goal"], self.question["failure"]
        sure, last, keeps = self.live, {-1}, self.every
        while sure != last:
            last = sure
            inside, keeps = self.staying(sure | goal, self.every)
            sure = (self.reaching(keeps) & inside) - goal
        is_sure = {x for _, x in self.start} <= sure | goal
        if budget == "least" and not is_sure:
            self.share = Fraction(1)  # all of the greatest goal probability
        self.may_fail = budget is None or self.share is not None or self.rows[0].bound != 0
        need(self.may_fail or is_sure, "failure 0: the goal can be reached surely, fails")
        self.moving, self.keeps = (self.live, self.every) if self.may_fail else (sure, keeps)

    def _pair(self, stated: Any, n: int) -> Pair:
        """A pair of the checked model: name, total T, outcomes (a, y, t), mean costs times T.

        With probability a / T it comes to y at t more units of the total. With a discount
        1 - gamma of every step comes to state n, whose failing costs nothing.
        """
        name, told, costs = stated
        need(type(name) is str, "an action is called", repr(name)[:99])
        need(type(costs) is list, name, "has for its costs", repr(costs)[:99])
        chances, where = [number(p) for p, _ in told], f"{self.names[-1]}, {name}:"
        scale = lcm(*(p.denominator for p in chances))
        parts = [p.numerator * (scale // p.denominator) for p in chances]
        need(sum(parts) > 0 and min(parts) >= 0, where, "probabilities >= 0, not all of them 0")
        need(len(costs) == self.n_costs, where, "as many costs as are said to be there")
        costs = [cost if isinstance(cost, list) else [cost] * len(parts) for cost in costs]
        each = [[number(text) for text in cost] for cost in costs]
        need(min(map(min, each)) >= 0, where, "costs >= 0")
        paid = [sum((a * c for a, c in zip(parts, cost, strict=True)), ZERO) for cost in each]
        (goes, of), total = self.gamma.as_integer_ratio(), sum(parts)
        steps = [int(c * self.unit) for c in each[0]] if self.counts else [0] * len(parts)
        outcomes = [(a * goes, whole(y, n), t)
                    for a, (_, y), t in zip(parts, told, steps, strict=True) if a]  # fmt: skip
        outcomes += [(total * (of - goes), n, 0)] if goes < of else []
        return name, total * of, outcomes, [of * cost for cost in paid]

    def down(self, value: Fraction) -> int:
        """Number of the checked certificate in units, rounded down; ``-down(-value)``: up."""
        return value.numerator * self.one // value.denominator

    def at_most(self, left: int, right: int, *words: object) -> None:
        """Refuse the certificate being checked unless an inequality in units holds."""
        if left > right:
            sides = f"{left / self.one:.17g} > {right / self.one:.17g}"
            need(False, *words, "fails:", sides)

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

    def spread(self, head: Mapping[str, Any], listed: Sequence[tuple[int, Fraction]]) -> None:
        """Nodes of the checked proof: all states from the cap on, and below it those listed."""
        cap, sign = number(head.get("cap", "0")) * self.unit, self.sign
        need(cap.denominator == 1 and cap >= 0, "the cap is a sum of costs, fails")
        one = number(head.get("one", str(ONE)))
        need(one >= 1 and one.denominator == 1, "units are parts of 1, fails")
        self.one = int(one)
        self.cap, self.place = int(cap), dict[tuple[int, int], int]()
        self.nodes = [(x, self.cap) for x in range(len(self.names))]
        for x, total in listed:
            need(x in self.live and 0 <= total * self.unit < cap, "a total below the cap, fails")
            self.place[x, int(total * self.unit)] = len(self.nodes)
            self.nodes.append((x, int(total * self.unit)))
        if "quantile" in self.question:  # what comes late, or in time, is told by two steps
            at, one = number(head["claim"][0]) * self.unit, Fraction(1)
            low, high = ([(-1, ZERO, ZERO, ZERO), (floor(late), one, ZERO, ZERO)]
                         for late in (-floor(-at) - one, at))  # fmt: skip
        elif "tail_mean" in self.question:
            low = high = self.excess(at := number(head["threshold"]), at)
        else:
            charge = self.question.get("charge", [])
            lists = type(charge) is list and all(type(s) is list and len(s) == 4 for s in charge)
            need(lists, "a charge is a list of lists of four numbers")
            steps = [(number(after), [sign * number(v) for v in values], sign * number(slope))
                     for after, *values, slope in charge]  # fmt: skip
            low, high = ([(floor(after * self.unit), most(values), slope, after)
                          for after, values, slope in steps] for most in (min, max))  # fmt: skip
            told = [step[0] for step in steps]
            is_told = told == sorted(set(told)) and (not told or told[0] <= 0)
            need(is_told, "a charge is told from 0 on")
        self.low: Charge | None = None
        self.beyond: Fraction | None = None  # what thresholds that no case holds are at least
        if self.counts:
            self.low, self.objective.charge = self.ladder(low, 1), self.ladder(high, -1)

    def excess(self, first: Fraction, last: Fraction) -> list[Step]:
        """Charge that no threshold z between two exceeds in the checked proof, which z = last has.

        ``max(first, min(t, last)) + max(t - last, 0) / share <= z + max(t - z, 0) / share``.
        """
        share = 1 - number(self.question["tail_mean"])
        need(0 < share <= 1, "a level lies in [0, 1)")
        return [(-1, first, ZERO, ZERO), (floor(first * self.unit), first, Fraction(1), first),
                (floor(last * self.unit), last, 1 / share, last)]  # fmt: skip

    def cases(
        self, stated: Any, low: Charge | None, only: Mapping[int, Set[int]]
    ) -> Iterator[Case]:
        """Cases of the checked proof: one with prices, or decisions of a node in several parts."""
        if self.is_single and stated.keys() != {"prices"}:
            x, total, parts = fields(stated, state=int, total=str, parts=list)
            i = self.at(whole(x, len(self.names)), floor(number(total) * self.unit))
            need(not self.counts or i >= len(self.names), "decisions below the cap, fails")
            places: dict[Any, int] = {"stop": -1, **dict(enumerate(self.of[x]))}
            left = only.get(i, {*places.values()})
            kept = [(left & {places.get(name, -2) for name in part}, some) for part, some in parts]
            need(left == set().union(*(part for part, _ in kept)), "each decision is in a part, "
                 "fails in", self.names[x])  # fmt: skip
            for part, some in kept:
                yield from self.cases(some, low, {**only, i: part})
            return
        prices = [number(text) for text in fields(stated, prices=list)[0]]
        need(min([ZERO, *prices]) >= 0, "prices are >= 0, fails")
        need(len(prices) == len(self.rows), len(prices), "prices of", len(self.rows), "rows")
        yield Case(prices, low, only)

    def thresholds(self, stated: Iterable[tuple[str, Any]]) -> Iterator[Case]:
        """Cases of the checked proof for thresholds up to one after the other; sets `beyond`."""
        leads = ((self.pairs[k][2], r) for x, r in self.nodes for k in self.of[x])
        goal, last = self.sets["goal"], Fraction(-1)
        totals = sorted({0, self.cap, *(r + t for to, r in leads for _, y, t in to if y in goal)})
        for text, some in stated:
            first, end = Fraction(totals[bisect(totals, last)], self.unit), number(text)
            yield from self.cases(some, self.ladder(self.excess(min(first, end), end), 1), {})
            last = end * self.unit
        self.beyond = Fraction(totals[bisect(totals, last)], self.unit)

    def ladder(self, steps: Sequence[Step], side: int) -> Charge:
        """Charge of totals in the checked proof, rounded down (side 1), or negative and up (-1)."""
        starts = [step[0] for step in steps]
        need(starts == sorted(starts), "a claim is a total, fails")
        need(len(starts) == 1 or starts[-1] < self.cap, "the charge is a line from the cap on")
        self.rise = steps[-1][2]
        need(self.rise >= 0, "the charge does not fall in the end, fails")

        @cache
        def charge(r: int) -> int:
            _, value, slope, after = steps[max(bisect_left(starts, r) - 1, 0)]
            return self.down(side * (value + slope * (Fraction(r, self.unit) - after)))

        return charge

    def at(self, x: int, r: int) -> int:
        """Node of a state of the checked model at a total."""
        if r >= self.cap or x in self.still:
            return x
        if (x, r) not in self.place:
            need(False, "no line tells of", self.names[x], "with", Fraction(r, self.unit))
        return self.place[x, r]

    def priced(self, case: Case) -> Quantity:
        """Checked objective, and at prices of a case the excess of rows over their bounds."""
        c = Quantity(self, self.question["objective"], self.sign, "priced")
        c.charge = case.low
        for price, row in zip(case.prices, self.rows, strict=True):
            c.constant += price * (row.constant - row.paid)
            c.stop += price * row.stop
            c.ending += price * row.ending
            for kind, weights in row.weights.items() if price else ():
                for what, weight in weights.items():
                    c.add(kind, what, price * weight)
        return c

    def prove(
        self, v: Mapping[int, int], q: Quantity, choice: Mapping[int, Sequence[int]],
        slope: Sequence[int] = (), words: str = "", begin: int = 0,
    ) -> Fraction:  # fmt: skip
        """Bound of a quantity that v proves at each choice; with words an upper one, by - v."""
        side, goal, gamma = -1 if words else 1, self.sets["goal"], self.gamma
        arrival = Lazily(lambda x: self.down(side * q.arrival(x)))
        after = Lazily(lambda i: arrival[self.nodes[i][0]] + v.get(i, 0))
        paid = Lazily(lambda k: self.down(side * (q.costs(self.pairs[k][3])
                                                  + q.step * self.pairs[k][1])))  # fmt: skip
        for i, value in v.items():
            x, r = self.nodes[i]
            for k in choice[i]:
                if k < 0:
                    name, total, most = "stop", 1, self.down(side * (q.at_stop(x) or ZERO))
                else:
                    name, total, moves, _ = self.pairs[k]
                    most = paid[k] + sum(a * after[self.at(y, r + t)] for a, y, t in moves)
                    if q.charge:
                        won = sum(a * q.charge(r + t) for a, y, t in moves if y in goal)
                        most += won // gamma.numerator * gamma.denominator  # in full
                    if slope and q.charge:
                        far = [(a * slope[y], r + t - self.cap) for a, y, t in moves]
                        most += sum(b * t for b, t in far if t > 0) // self.unit
                if value * total > most:
                    what = f"{words} {q.name} + sum p u <= u at" if words else "v <= c + sum p v at"
                    action = k - self.of[x].start if words and k >= 0 else name
                    sides = [side * bound for bound in (value, most // total)[::side]]
                    self.at_most(*sides, what, self.names[x], *self.below_cap(i), action)
        ends = {x: q.charge(0) if q.charge and x in goal else 0 for _, x in self.start}
        begun = [(p, after[self.at(x, begin)] + ends[x]) for p, x in self.start]
        return q.constant + side * sum((p * Fraction(value, self.one) for p, value in begun), ZERO)

    def below_cap(self, i: int) -> list[str]:
        """Total of a node of the checked proof, for messages; none from the cap on."""
        return [f"with {Fraction(self.nodes[i][1], self.unit)}"] if i >= len(self.names) else []

    def decisions(
        self, q: Quantity, size: int, only: Mapping[int, Set[int]]
    ) -> dict[int, list[int]]:
        """Decisions in a case of some first nodes, -1 to stop, that a checked v has to know."""
        stops = {x for x in self.moving if self.may_fail and q.at_stop(x) is not None}
        at = {x: [*filter(self.keeps.__getitem__, self.of[x]), *[-1][: x in stops]]
              for x in self.moving}  # fmt: skip
        found = {i: at[x] for i, (x, _) in enumerate(self.nodes[:size]) if x in self.moving}
        every = range(len(self.home))
        for total in {self.nodes[i][1] for i in only}:  # who does not stop may wander at it
            here = {self.nodes[i][0]: some for i, some in only.items() if self.nodes[i][1] == total}
            loops = [self.waits[k] and k in here.get(x, every) for k, x in enumerate(self.home)]
            wandering = self.staying(self.live, loops)[0]
            for x in here.keys() & self.moving:
                allowed = here[x] | ({-1} if x in wandering else set())
                i = self.at(x, total)
                found[i] = [k for k in found[i] if k in allowed]
        return found

    def below(
        self, v: Sequence[int], q: Quantity, slope: Sequence[int] = (), begin: int = 0,
        only: Mapping[int, Set[int]] | None = None,
    ) -> Fraction:  # fmt: skip
        """Checked lower bound of a quantity that v proves in a case, every inequality of it."""
        choice = self.decisions(q, len(v), only or {})
        return self.prove({i: v[i] for i in choice}, q, choice, slope, begin=begin)

    def above(self, member: Mapping[int, Sequence[Any]], words: str) -> list[Fraction]:
        """Checked upper bounds of a member's objective and rows."""
        n, each, choice = len(self.names), [self.steps, *self.each], dict[int, list[int]]()
        decided, slope = self.ended | member.keys(), [0] * n
        begun = {self.at(x, 0) for _, x in self.start}
        need(decided >= begun, words, "decides at the start, fails")
        for i, (decision, *values) in member.items():
            (x, r), size = self.nodes[i], len(each) + (self.counts and i < n)
            place = self.names[x], *self.below_cap(i)
            need(x in self.live, words, "decides where nothing has ended, fails in", *place)
            need(len(values) == size, words, "a number a row, fails in", *place)
            k = -1 if decision == "stop" else self.of[x].start + whole(decision, len(self.of[x]))
            may_stop = k >= 0 or self.objective.at_stop(x) is not None
            need(may_stop, words, "stops where it may, fails in", *place)
            ahead = {self.at(y, r + t) for _, y, t in self.pairs[k][2]} if k >= 0 else set()
            need(decided >= ahead, words, "decides after", *place)
            choice[i] = [k]
        u = {i: [self.down(-number(text)) for text in entry[1:]] for i, entry in member.items()}
        if self.counts:
            self.slopes.charge = lambda r: self.down(-self.rise)
            past = {i: q[-1] for i, q in u.items() if i < n}
            self.prove(past, self.slopes, choice, words=words)
            slope = [past.get(x, 0) for x in range(n)]
        return [self.prove({i: values[j] for i, values in u.items()}, q, choice, slope, words)
                for j, q in enumerate(each)][1:]  # fmt: skip

    def given_success(self, bound: Fraction, price: Fraction) -> Fraction:
        """Checked bound of cost / goal from that of cost + price * (failure - most failure)."""
        most = self.rows[0].paid  # a ratio of two lines, least at failure 0 or at the most
        need(most < 1 or bound >= 0, "0 <= cost + price * (failure - 1) of all policies, fails")
        return min([bound + price * most, *([bound / (1 - most)] if most < 1 else [])])

    def attain(
        self, weights: Sequence[Fraction], members: Sequence[Sequence[Fraction]]
    ) -> list[Fraction]:
        """Objective and rows of a checked lottery; prices pay for what it takes beyond a bound.

        So no lottery within bounds that are so much looser does less than is proved.
        """
        attained = [dot(weights, each) for each in zip(*members, strict=True)]
        for row, value in zip(self.rows, attained[1:], strict=True):
            row.paid = max(row.loose, value)
        return attained

    def set_share(self, w: Sequence[int], members: Iterable[Sequence[Fraction]]) -> None:
        """Set the checked budget 1 - share * greatest goal probability, from both sides."""
        failure, share = Quantity(self, FAILURE, 1, "w"), Fraction(self.share or 0)
        failure.free = self.attention
        self.rows[0].bound = 1 - share * (1 - self.below(w, failure, begin=self.cap))
        self.rows[0].loose = 1 - share * (1 - min(member[1] for member in members))


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
        asked = self.asked if self.asked.isprintable() else ascii(self.asked)
        lines = [f"accepted: {asked}", f"  SHA-256   {self.digest}"]
        for name, bound, side in (("at least", self.lower, 1), ("at most", self.upper, -1)):
            near = side * floor(side * bound * 10**25)  # rounded so that it holds
            exact, digits = str(bound), f"{abs(near):026d}"
            exact = exact if len(exact) < 60 else f"{exact[:24]}...{exact[-24:]}"
            sign = "-" if near < 0 else ""
            lines.append(f"  {name:<9} {sign}{digits[:-25]}.{digits[-25:]} = {exact}")
        lines.append(f"  width     {float(self.upper - self.lower):.1e}")
        for name, excess in self.exceeded.items():
            lines.append(f"  the lottery exceeds row {printable(name)} by {float(excess):.1e}: "
                         "it is one for a bound that is so much looser")  # fmt: skip
        return "\n".join(lines) if self.accepted else f"refused: {self.reason}"


def check_certificate(path: Any) -> Checked:
    """Check the certificate in a file of this name: an interval that holds the optimum.

    Where the answer is not ``accepted``, it says which inequality fails where.
    """
    if not (isinstance(path, str) or hasattr(path, "__fspath__")):
        told = "no path of a file, which ssp_lp.write_certificate(solution, path) writes"
        return Checked(False, f"{printable(type(path).__name__)} is {told}")
    try:
        with open(path, "rb") as packed, gzip.open(packed) as file:
            most = min(FILE, LINE + TIMES * packed.seek(0, 2))
            packed.seek(0)
            return check_lines(lines_of(file, most))
    except RefusedError as error:
        return Checked(False, str(error))
    except gzip.BadGzipFile:
        return Checked(False, "this is no certificate: ssp_lp.write_certificate writes one")
    except OSError as error:
        if error.errno:  # there is no such file
            raise
        return Checked(False, f"the file is damaged: {error}")
    except Exception as error:  # whatever a damaged file may lead to
        words = printable(f"{type(error).__name__}: {error}")
        return Checked(False, f"the file is damaged: {words}")


def lines_of(file: Any, most: int) -> Iterator[bytes]:
    """Lines of the checked file while it is unpacked, no more and no longer than is allowed."""
    left = most
    while line := file.readline(LINE + 1):
        left -= len(line)
        need(len(line) <= LINE, f"a line has more than {LINE:,} bytes")
        need(left >= 0, f"the lines have more than {most:,} bytes")
        yield line.removesuffix(b"\n")


def read_lines(
    lines: Iterable[bytes],
) -> tuple[Model, dict[str, Any], list[Fraction], list[Case], list[dict[str, Any]]]:
    """Model, head of the proof, weights, cases, and what is told of each node, in this order."""
    digest, some = hashlib.sha256(), iter(lines)
    need((first := next(some, None)) is not None, "the file is empty")
    question = read(first or b"")
    digest.update(first or b"")
    n, states = whole(question["states"], FILE // SHORTEST), list[list[Any]]()
    for line in islice(some, n):
        digest.update(b"\n" + line)
        is_head = b'"sha256"' in line and "sha256" in read(line)
        need(not is_head, len(states), "lines where there should be", n, "of states")
        states.append(read_state(line))
    need((line := next(some, b"")) != b"", len(states) + 1, "lines where there should be more")
    head = read(line)
    n_told = 2 * n if question.get("after_failing") else n  # states of which the proof has a line
    size = n_told + whole(head.get("nodes", 0), FILE // SHORTEST)
    proof = [read(line) for line in islice(some, size)]
    count = n + 2 + len(proof) + sum(1 for _ in islice(some, 1000))
    need(count == n + 2 + size, count, "lines where there should be", n + 2 + size)
    is_signed = digest.hexdigest() == head.get("sha256")
    need(is_signed, "the SHA-256 is not that of the question and the model")
    model = Model(question, states)
    told: dict[str, type] = {"cap": str, "nodes": int} if model.counts else {}
    is_mean, in_cases = "tail_mean" in question, "tail_mean" in question or model.is_single
    told |= {"threshold": str} if is_mean else {}
    told |= {"cases": list if is_mean else dict} if in_cases else {"prices": list}
    told |= {"one": str} if "one" in head else {}
    fields(head, sha256=str, claim=list, weights=list, **told)
    need(len(head["claim"]) == 2, "a claim is: at least, at most")
    weights = [number(text) for text in head["weights"]]
    need(min(weights) >= 0 and sum(weights) == 1, "weights are >= 0 and sum to 1, fails")
    need(max(weights) == 1 or not model.is_single, "no policies are mixed, fails")
    keys = {"v", "members", *["w"][: model.share is not None], *["slope"][: model.counts]}
    is_told = all(line.keys() == keys for line in proof[:n_told])
    is_told &= all(line.keys() == {"v", "members", "state", "total"} for line in proof[n_told:])
    is_told &= all(len(line["members"]) == len(weights) for line in proof if is_told)
    need(is_told, "a line of proof has values, and each member, fails")
    below = proof[n_told:]
    model.spread(head, [(whole(line["state"], n), number(line["total"])) for line in below])
    if is_mean:
        cases = list(model.thresholds(head["cases"]))
    else:
        stated = head["cases"] if in_cases else {"prices": head["prices"]}
        cases = list(model.cases(stated, model.low, {}))
    proof = proof if in_cases else [{**line, "v": [line["v"]]} for line in proof]
    is_told = all(type(line["v"]) is list and len(line["v"]) == len(cases) for line in proof)
    need(is_told and len(cases) > 0, "a value for each case, and one case at least, fails")
    none = {"v": ["0"] * len(cases), "members": [None] * len(weights), "w": "0", "slope": "0"}
    for place in range(n, n_told + 2, n + 1):  # what a discount takes
        proof.insert(place, none)
    return model, head, weights, cases, proof


def check_lines(lines: Iterable[bytes]) -> Checked:
    """Check the lines of a certificate's file; raises where it is refused."""
    model, head, weights, cases, proof = read_lines(lines)
    question, members = model.question, list[list[Fraction]]()
    for m in range(len(weights)):
        decided = {i: line["members"][m] for i, line in enumerate(proof)
                   if line["members"][m] is not None}  # fmt: skip
        members.append(model.above(decided, f"member {m}:"))
    if model.share is not None:
        w = [model.down(number(line["w"])) for line in proof[: len(model.names)]]
        model.set_share(w, members)
    upper, *taken = model.attain(weights, members)
    slope = list[int]()
    if model.counts:  # from the cap on v is a line, whose slope is at most that of the charge
        slope = [model.down(number(line["slope"])) if x in model.moving else 0
                 for x, line in enumerate(proof[: len(model.names)])]  # fmt: skip
        model.slopes.charge = lambda r: model.down(model.rise)
        model.below(slope, model.slopes)
    bounds = [] if model.beyond is None else [model.beyond]
    for j, case in enumerate(cases):
        v = [model.down(number(line["v"][j])) for line in proof]
        c, past = model.priced(case), slope if any(slope) else ()
        bound = model.below(v, c, past, only=case.only)
        bounds.append(model.given_success(bound, case.prices[0]) if model.ratio else bound)
    lower = min(bounds)
    exceeded = dict[str, Fraction]()
    for row, value in zip(model.rows, taken, strict=True):
        if value > row.bound:
            exceeded[row.name] = value - row.bound
            if value - row.bound > EXCESS * min(Fraction(1), abs(row.bound)):
                sides = -model.down(-value), model.down(row.bound)
                model.at_most(*sides, "lottery <= bound of row", row.name)
    need(not (exceeded and model.is_single), "a policy exceeds row", *exceeded)
    if model.ratio:
        need(taken[0] < 1, "the lottery reaches the goal, fails")
        upper = max(upper, upper / (1 - taken[0]))
    if "quantile" in question:
        late = 1 - number(question["quantile"])
        need(upper <= late, "the lottery exceeds the quantile as rarely, fails")
        need(not exceeded, "a quantile jumps where the lottery exceeds row", *exceeded)
        need(lower > late, "no lottery stays below the quantile as often, fails")
        lower = upper = number(head["claim"][0])
    lower, upper = ends = (-upper, -lower) if question["greatest"] else (lower, upper)
    need(lower <= upper, "at least", float(lower), "and at most", float(upper), "contradict")
    least, most = map(number, head["claim"])
    proved = f"proved from {float(lower)} to {float(upper)}"
    need(least <= lower, "claimed is at least", head["claim"][0], "fails,", proved)
    need(upper <= most, "claimed is at most", head["claim"][1], "fails,", proved)
    return Checked(True, "", *ends, exceeded, str(question["asked"]), head["sha256"])


if __name__ == "__main__":
    results = [check_certificate(path) for path in sys.argv[1:]]
    print("\n".join(map(str, results)) or __doc__)
    sys.exit(0 if results and all(result.accepted for result in results) else 1)
