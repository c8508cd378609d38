"""The linear program of a question about a model, with its columns in fractions.

This module proves nothing; it interprets a question: which states are dead-ends, where a policy
may give up, what failing costs, where waiting for ever is free, how totals are counted.
``prove.py`` reads the resulting program and uses none of these terms. "Definition 4"
and so on refer to the documentation's page on the certificate format.
``program.columns()`` yields the program's columns.
"""

from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from math import gcd, lcm
from operator import mul
from typing import Any, NamedTuple

if __package__:
    from .prove import Column, Counts, Row, need, number, whole
else:  # this file was copied elsewhere
    from prove import Column, Counts, Row, need, number, whole  # type: ignore

ZERO, ONE = Fraction(0), Fraction(1)
LONGEST = 1 << 16  # most bits of a common denominator
SPARSE = 1000  # most pairs (state, steps taken) for each line of a file
COSTS = 63  # costs are fewer, so that a set of them fits a machine word


class Action(NamedTuple):
    """An action of a state.

    An outcome (a, y, t) leads to state y with probability a / ``total`` at cost t; if the model has
    several costs, t is the first one.
    """

    name: str
    total: int
    outcomes: list[tuple[int, int, Any]]  # t is a fraction; in a program a number of units
    costs: list[Fraction]  # mean of each cost


class State(NamedTuple):
    """A state of the model: its name, the names of the sets that contain it, and its actions."""

    name: str
    sets: list[str]
    actions: list[Action]


def in_parts(numbers: Sequence[Fraction]) -> tuple[list[int], int]:
    """Return whole numbers n and the least whole number p such that the given numbers are n / p."""
    parts = 1
    for denominator in {one.denominator for one in numbers}:
        parts = lcm(parts, denominator)
        need(parts.bit_length() <= LONGEST, "a common denominator is too long")
    return [one.numerator * (parts // one.denominator) for one in numbers], parts


class _Graph:
    """The graph of a model: the successors of each action. Actions are numbered state by state."""

    def __init__(self, states: Iterable[State], sets: Iterable[str]) -> None:
        self.sets = {name: set[int]() for name in ("goal", "out of time", *sets)}
        self.home, self.first = array("q"), array("q", [0])  # state of each action; first of each
        self.to, self.ends = array("q"), array("q", [0])  # successors; end of each action's
        self.paid = array("q")  # costs that are not 0, as bits
        for x, state in enumerate(states):
            for name in state.sets:
                need(name in self.sets, "there is no set", name)
                self.sets[name].add(x)
            for action in state.actions:
                self.home.append(x)
                self.to.extend({y for _, y, _ in action.outcomes})
                self.ends.append(len(self.to))
                self.paid.append(sum(1 << j for j, cost in enumerate(action.costs) if cost))
            self.first.append(len(self.home))
        self.size, self.goal = len(self.first) - 1, self.sets["goal"]
        self.every = [True] * len(self.home)
        self.before = [array("q") for _ in range(self.size)]
        for k in range(len(self.home)):
            for y in self.after(k):
                self.before[y].append(k)

    def after(self, k: int) -> Sequence[int]:
        """Return the states that an action may lead to."""
        return self.to[self.ends[k] : self.ends[k + 1]]

    def distances(self, allowed: Sequence[bool]) -> dict[int, int]:
        """Return for each state that can reach the goal the least number of steps to it.

        Args:
            allowed: whether a step may take each action, [actions].
        """
        steps = dict.fromkeys(self.goal, 0)
        queue = list(steps)
        for y in queue:  # the queue grows in the loop
            for k in self.before[y]:
                if allowed[k] and self.home[k] not in steps:
                    steps[self.home[k]] = steps[y] + 1
                    queue.append(self.home[k])
        return steps

    def staying(self, states: set[int], allowed: Sequence[bool]) -> set[int]:
        """Return the largest subset of some states in which a run can stay for ever.

        Each of its states has no actions, or an allowed action whose successors are in the subset.
        """
        inside, stays, counts = set(states), list(allowed), [0] * self.size
        for k, x in enumerate(self.home):
            counts[x] += stays[k]
        queue = [x for x in range(self.size) if x not in states]
        queue += [x for x in states if not counts[x] and self.first[x] < self.first[x + 1]]
        for y in queue:  # the queue grows in the loop
            inside.discard(y)
            for k in self.before[y]:
                if stays[k]:
                    stays[k], x = False, self.home[k]
                    counts[x] -= 1
                    if not counts[x]:
                        queue.append(x)
        return inside


class _Quantity:
    """A weighted sum of a run's costs and of its arrivals in states."""

    def __init__(self, stated: Any, sign: int, n_costs: int, graph: _Graph, dead: set[int]) -> None:
        need(type(stated) is dict and stated.keys() == {"constant", "terms"}, "no quantity")
        self.constant, self.costs = sign * number(stated["constant"]), [ZERO] * n_costs
        self.arrivals, self.visited = defaultdict[int, Fraction](Fraction), set[int]()
        for text, kind, what in stated["terms"]:
            weight = sign * number(text)
            need(kind in ("cost", "visits", "end"), "no quantity is called", kind)
            need(weight >= 0 or kind == "end", "needed: costs and visits count >= 0")
            if kind == "cost":
                self.costs[whole(what, n_costs)] += weight
                continue
            need(what in graph.sets, "there is no set", what)
            states = graph.sets[what]
            need(kind == "visits" or states <= dead | graph.goal, "not all states end:", what)
            self.visited |= states if weight and kind == "visits" else set()
            for x in states:
                self.arrivals[x] += weight

    def mean(self, costs: Sequence[Fraction]) -> Fraction:
        """Return the weighted sum of an action's mean costs, [costs]."""
        return sum(map(mul, self.costs, costs), ZERO)


class Program:
    """The linear program of a question: nodes, rows, and the columns at each node.

    Args:
        question: question of a certificate; its entry "failure" is an interval that contains the
            allowed failure probability.
        states: returns the states of the model, from the first one at each call.
        cap: total costs of at least this number are not distinguished.
        lines: number of nodes for which the proof has a line; it limits the work.
    """

    def __init__(
        self, question: dict[str, Any], states: Callable[[], Iterable[State]], cap: str, lines: int
    ) -> None:
        self.question, self.states, self.lines = question, states, lines
        self.graph = _Graph(states(), question["sets"])
        n = self.graph.size
        if question["horizon"] is not None:
            self._count_steps(n, question["horizon"])
        graph, every = self.graph, set(range(self.graph.size))
        self.dead = every - graph.distances(graph.every).keys()
        self.live = every - self.dead - graph.goal
        self.attention = graph.staying(every - graph.goal, graph.every)
        self.discount = ONE if question["discount"] is None else number(question["discount"])
        need(0 < self.discount <= 1, "needed: a discount lies in (0, 1]")
        start = [(number(p), whole(x, n)) for p, x in question["start"]]
        total = sum((p for p, _ in start), ZERO)
        need(min(start, default=(-1,))[0] >= 0 < total, "needed: the start is a distribution")
        self.start = [(p / total, x) for p, x in start if p]
        self._ask()
        self._decide(question["give_up"])
        self._charge(question["charge"], cap)

    def _count_steps(self, n: int, horizon: int) -> None:
        """Replace each state by one copy for each number of steps taken (definition 1)."""
        most = SPARSE * (n + self.lines)
        need(n * (whole(horizon, most) + 1) <= most, "the horizon is too far for so few lines")
        needed, flat = self.graph.distances(self.graph.every), list(self.states())

        def states() -> Iterator[State]:
            """Yield all states at step 0, then all at step 1, and so on up to the horizon."""
            for h in range(horizon + 1):
                for x, (name, sets, actions) in enumerate(flat):
                    late = ["out of time"] * (needed.get(x, 0) > horizon - h)
                    after = [
                        one._replace(outcomes=[(a, (h + 1) * n + y, t) for a, y, t in one.outcomes])
                        for one in (actions if h < horizon else [])
                    ]
                    yield State(f"{name}, step {h}", [*sets, *late], after)

        self.states, self.graph = states, _Graph(states(), self.graph.sets)

    def _ask(self) -> None:
        """Read the objective and the rows; row 0 limits the failure probability (definition 3)."""
        question, self.sign = self.question, -1 if self.question["greatest"] else 1
        known = whole(question["costs"], COSTS), self.graph, self.dead
        self.objective = _Quantity(question["objective"], self.sign, *known)
        failing = _Quantity({"constant": "0", "terms": []}, 1, *known)
        failing.arrivals.update(dict.fromkeys(self.dead, ONE))
        self.each, self.rows = [self.objective, failing], [Row("failure", *question["failure"])]
        for row in question["rows"]:
            sign, side = (1, "at_most") if "at_most" in row else (-1, "at_least")
            need(row.keys() == {"name", "quantity", side}, "needed: a row has a name and one bound")
            need(row["name"] not in {one.name for one in self.rows}, "two rows are called alike")
            self.each.append(_Quantity(row["quantity"], sign, *known))
            bound = sign * number(row[side]) - self.each[-1].constant
            self.rows.append(Row(row["name"], bound, bound))

    def _decide(self, give_up: str) -> None:
        """Determine allowed actions, giving up, waiting and charges (definitions 4 to 7)."""
        graph, live, every = self.graph, self.live, range(self.graph.size)
        places = {"anywhere": live, "attention": live & self.attention, "dead_ends": set[int]()}
        need(give_up in places, "give_up is", give_up)
        weighed = map(any, zip(*(q.costs for q in self.each), strict=True))
        paying = sum(1 << j for j, is_weighed in enumerate(weighed) if is_weighed)
        seen = set[int]().union(*(q.visited for q in self.each))
        free = [not paid & paying and seen.isdisjoint(graph.after(k))
                for k, paid in enumerate(graph.paid)]  # fmt: skip
        self.giving_up, self.keeps = places[give_up], graph.every
        self.waiting = graph.staying(live, free) if self.discount == 1 else set[int]()
        if self.rows[0].most == 0:  # only actions that keep the goal sure count
            self.giving_up, self.waiting, last = set(), set(), None
            while last != self.live:
                last = self.live
                self.keeps = [
                    x in last and all(y in last or y in graph.goal for y in graph.after(k))
                    for k, x in enumerate(graph.home)
                ]
                self.live = graph.distances(self.keeps).keys() & last
            is_sure = all(x in self.live or x in graph.goal for _, x in self.start)
            need(is_sure, "needed: the goal can be reached surely")
        self.charges = dict[int, list[Fraction]]()  # of failing in a state, for each cost
        fail = self.dead | self.giving_up if self.question["charge_failing_step"] else set[int]()
        where = every if give_up == "anywhere" else self.attention
        for x, state in enumerate(self.states() if fail else ()):
            some = (one for one in state.actions if all(y in where for _, y, _ in one.outcomes))
            stay = [one.costs for one in some]
            if stay:
                self.charges[x] = list(map(min, zip(*stay, strict=True)))
        for q in self.each:
            for x in self.dead & self.charges.keys():
                q.arrivals[x] += q.mean(self.charges[x])

    def _charge(self, stated: list[Any], cap: str) -> None:
        """Read the charge of the total cost, and number the program's nodes (definition 8).

        The nodes are, in this order: the beginning; the states at the cap; the states for the
        excess over the cap, if the charge grows there; the states at each total below the cap.
        """
        n, sides, sign = self.graph.size, [">=", ">"], self.sign
        steps = [((number(at), sides.index(side)), sign * number(value), sign * number(slope))
                 for side, at, value, slope in stated]  # fmt: skip
        self.steps: list[tuple[tuple[Fraction, int], Fraction, Fraction]] = steps
        starts = [at for at, _, _ in steps]
        is_function = starts == sorted({(ZERO, 0), *starts}) or not starts
        need(is_function, "needed: a charge begins at 0 and has one step after the other")
        least, self.rise = (number(cap), steps[-1][2]) if starts else (ZERO, ZERO)
        need(least >= 0 and (len(starts) < 2 or starts[-1][0] < least), "the cap is too low")
        need(self.rise >= 0, "needed: the charge does not fall in the end")
        self.follows = {1 + n + x: 1 + x for x in range(n * (self.rise > 0))}
        self.size, self.unit, self.cap = 1 + n + len(self.follows), 1, 0
        self.model, self.place = list[State](), dict[tuple[int, int], int]()
        self._fixed = dict[int, tuple[Fraction, Counts, list[Any], list[Any]]]()
        if not starts:
            return
        flat = list(self.states())
        paid = {t for state in flat for one in state.actions for _, _, t in one.outcomes} | {least}
        parts, self.unit = in_parts(list(paid))  # totals are whole numbers of 1 / unit
        units = dict(zip(paid, parts, strict=True))
        self.cap, self.states = units[least], lambda: self.model
        for name, sets, actions in flat:
            outcomes = [[(a, y, units[t]) for a, y, t in one.outcomes] for one in actions]
            each = zip(actions, outcomes, strict=True)
            self.model.append(State(name, sets, [one._replace(outcomes=o) for one, o in each]))
        queue = [(0, x) for _, x in self.start if x in self.live and self.cap]
        met = set(queue)
        for r, x in queue:  # the queue grows in the loop
            for k, action in enumerate(self.model[x].actions, self.graph.first[x]):
                for _, y, t in action.outcomes if self.keeps[k] else ():
                    if y in self.live and r + t < self.cap and (r + t, y) not in met:
                        met.add((r + t, y))
                        queue.append((r + t, y))
            need(len(met) <= self.lines, "needed: each node below the cap has a line")
        self.place = {(x, r): i for i, (r, x) in enumerate(sorted(met), self.size)}
        self.size += len(met)

    def charge(self, total: int) -> Fraction:
        """Return the charge of reaching the goal at a total, given in units."""
        exact = Fraction(total, self.unit)
        (at, _), value, slope = max(one for one in self.steps if one[0] <= (exact, 0))
        return value + slope * (exact - at)

    def columns(self) -> Iterator[Column]:
        """Yield all columns, node by node."""
        parts, scale = in_parts([p for p, _ in self.start])
        outcomes = [(a, x, 0) for a, (_, x) in zip(parts, self.start, strict=True)]
        begin = Action("begin", scale, outcomes, [ZERO] * len(self.objective.costs))
        yield self.column(0, -1, begin, 0)
        for x, state in enumerate(self.states()):
            if x in self.live:
                yield from self.decisions(1 + x, x, state.actions, self.cap)
        for x in sorted(self.live) if self.rise else ():
            yield from self.decisions(1 + self.graph.size + x, x, self.model[x].actions, None)
        for (x, r), node in self.place.items():
            yield from self.decisions(node, x, self.model[x].actions, r)

    def decisions(
        self, node: int, x: int, actions: list[Action], r: int | None
    ) -> Iterator[Column]:
        """Yield the columns of a node (definitions 9 and 10).

        Args:
            node: number of the node.
            x: its state.
            actions: actions of the state.
            r: its total in units; None: the node counts the excess over the cap.
        """
        for k, action in enumerate(actions, self.graph.first[x]):
            if self.keeps[k]:
                yield self.column(node, k, action, r)
        counts = [ZERO, ZERO if r is None else ONE, *[ZERO] * len(self.rows[1:])]
        if x in self.giving_up:
            charges = () if r is None else self.charges.get(x, ())
            taken = [c + q.mean(charges) for c, q in zip(counts, self.each, strict=True)]
            yield Column(node, "give up", 1, [], tuple(taken))
        avoids = x in self.attention and x not in self.giving_up and self.rows[0].most > 0
        if x in self.waiting or (r is None and avoids):
            yield Column(node, "wait", 1, [], tuple(counts))

    def column(self, node: int, k: int, action: Action, r: int | None) -> Column:
        """Return the column of an action at a node.

        Args:
            node: number of the node.
            k: number of the action; -1: the beginning, which is not discounted.
            action: the action.
            r: total in units; None: the node counts the excess over the cap.
        """
        n, discount = self.graph.size, self.discount if k >= 0 else ONE
        if (fixed := self._fixed.get(k)) is None:
            share, counts = discount / action.total, [q.mean(action.costs) for q in self.each]
            for a, y, _ in action.outcomes:
                for i, q in enumerate(self.each):
                    if y in q.arrivals:
                        counts[i] += share * a * q.arrivals[y]
            counts[1] += 1 - discount
            ends = [(a, t) for a, y, t in action.outcomes if self.steps and y in self.graph.goal]
            moves = [(a, y, t) for a, y, t in action.outcomes if y in self.live]
            fixed = share, tuple(counts), ends, moves
            if self.steps:
                self._fixed[k] = fixed
        (share, taken, ends, moves), parts = fixed, defaultdict[int, int](int)
        if r is None:
            won = sum(a for a, _ in ends) * self.rise
            taken = won / action.total, *[ZERO] * len(self.rows)
        elif ends:
            won = sum((a * self.charge(r + t) for a, t in ends), ZERO)
            taken = taken[0] + won / action.total, *taken[1:]
        for a, y, t in moves:
            beyond = 0 if r is None else r + t - self.cap
            at = 1 + y if r is not None else 1 + n + y
            parts[self.place[y, beyond + self.cap] if beyond < 0 else at] += a * self.unit
            if self.rise and beyond > 0:
                parts[1 + n + y] += a * beyond
        total, goes = self.unit * share.denominator, share.numerator
        divisor = gcd(total, *(a * goes for a in parts.values()))
        weights = [(a * goes // divisor, j) for j, a in sorted(parts.items())]
        return Column(node, action.name, total // divisor, weights, taken)
