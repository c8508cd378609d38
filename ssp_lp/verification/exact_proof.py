"""Proofs of a certificate's programs: exact bounds and lotteries by column generation.

This module need not be trusted, since ``prove.py`` checks its results. Numbers are whole multiples
of 1 / ``ONE``, called units.

- Values at given prices come from policy iteration, which starts from a policy that is optimal in
  double precision. The equations of a policy are solved by a factorisation in double precision,
  with iterative refinement until they hold up to some units.
- The values are then lowered slightly, in proportion to the longest run among optimal columns. So
  every inequality holds with a margin, and fewer digits have to be written.
- An upper bound of a member's quantity is a lower bound of the quantity with the opposite sign.
- The master program over the members is solved in fractions.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from fractions import Fraction
from itertools import repeat
from operator import mul
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import offsets_of
from ssp_lp.column_generation.restricted_master import ExactSimplex
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.errors import SolverError
from ssp_lp.model.graph import end_components, nearer_pairs
from ssp_lp.verification.expand import ZERO, Program
from ssp_lp.verification.prove import EXCESS, Bounds, Column, Counts, Row

ONE = 10**60
_LOST = 10**28  # values are lowered by at most the largest value divided by this
_ROUNDING = 10**15  # units: smaller differences may be rounding
_UNITS = 4  # residual of an equation, in units, that ends the refinement
_BITS = 960  # most bits of whole numbers that are converted to floats
_IMPROVEMENTS = 500  # most steps of policy iteration, which has always ended before
_ROUNDS = 60  # most rounds of column generation
_PARTS = 10**30  # prices, and values without equations, are multiples of 1 / this = this / ONE
_LESS = Fraction(1, 10**20)  # share by which the proved ratio is lower if failure is not limited
_FAR = 10**6  # factor of prices while no lottery satisfies the rows
_NARROW, _MANY = Fraction(1, 10**11), 20_000  # width that suffices for programs of more nodes

Decide = Callable[[int], int]  # node -> position of the column that a policy takes


class _Way(NamedTuple):
    """A column of a program, restricted to a block of nodes.

    Each entry (a, j) of ``outcomes`` leads from ``node`` to node j with probability a / ``total``.
    """

    node: int
    total: int
    outcomes: list[tuple[int, int]]
    own: int  # total times the cost of the step, in units


class Member(NamedTuple):
    """A deterministic policy of a program, with its values in the proof, by node."""

    decision: dict[int, int]
    t: dict[int, int]
    u: list[dict[int, int]]  # for the objective and each row

    @property
    def totals(self) -> list[Fraction]:
        """Upper bounds of the member's objective and of its rows' values."""
        return [Fraction(values[0], ONE) for values in self.u]


class _Lottery(NamedTuple):
    """The best lottery over known members, and the prices of the rows at this optimum."""

    weights: list[Fraction]  # [members]; empty if no lottery satisfies the rows
    prices: list[Fraction]  # [rows]; if infeasible, every member violates the rows at them
    value: Fraction  # the least objective, or ratio


class Nodes:
    """The columns of a program by node, and the nodes in blocks.

    The columns of a block lead only to nodes of this block and of earlier ones, so blocks can be
    solved one after another.
    """

    def __init__(self, program: Program, n_states: int) -> None:
        self.program, n = program, program.graph.size
        self.where = {node: at for at, node in program.place.items()}
        self.kept = defaultdict[int, list[Column]](list)
        self.last = dict[int, int]()  # node -> best decision at the last prices
        first, keeps = program.graph.first, program.keeps
        self.actions = [  # [states] positions of the actions that count
            [k - first[x] for k in range(first[x], first[x + 1]) if keeps[k]] for x in range(n)
        ]
        for column in program.columns():
            if column.node in self.where and program.size > _MANY:
                break  # too many to store: `at` builds them
            self.kept[column.node].append(column)
        every = self.kept.keys() | self.where.keys()
        if not self.where:
            every = _closure([0], lambda i: (j for c in self.kept[i] for _, j in c.moves))
        blocks = defaultdict[tuple[int, int, int], list[int]](list)
        for i in every:
            x, r = self.where.get(i, ((i - 1) % n, 0))
            kind = 2 if i in self.where else int(i <= n)
            step = 0 if program.question["horizon"] is None else -(x // n_states)
            blocks[(kind, -r, step) if i else (3, 0, 0)].append(i)
        self.blocks = [sorted(blocks[key]) for key in sorted(blocks)]
        self.size = sum(map(len, self.blocks))

    def at(self, node: int) -> list[Column]:
        """Return the columns of a node."""
        if node in self.kept or node not in self.where:
            return self.kept[node]
        x, r = self.where[node]
        return list(self.program.decisions(node, x, self.program.model[x].actions, r))

    def values(self, prices: Sequence[Fraction]) -> dict[int, int]:
        """Return a value of each node such that the values prove a lower bound at given prices.

        They satisfy the inequality of every column, and are almost the greatest such values.

        Args:
            prices: prices of the rows, >= 0, [rows].

        Returns:
            Node -> value, in units.
        """
        value, costs = dict[int, int](), dict[Counts, Fraction]()

        def priced(counts: Counts) -> Fraction:
            if (cost := costs.get(counts)) is None:
                cost = costs[counts] = sum(map(mul, prices, counts[1:]), counts[0]) * ONE
            return cost

        for block in self.blocks:
            columns = [column for i in block for column in self.at(i)]
            ways = _ways_of(columns, (priced(column.counts) for column in columns), value)
            first = {column.node: w for w, column in reversed([*enumerate(columns)])}
            for i, (least, w) in zip(block, _best_of_block(ways), strict=True):
                value[i] = max(least, 0) if i in self.program.follows else least
                self.last[i] = w - first[i]
        return value

    def stop(self, node: int, *, must_wait: bool = False) -> int:
        """Return the position of a node's column for waiting for ever or, without one, giving up.

        Args:
            node: the node.
            must_wait: whether giving up is not allowed.

        Raises:
            SolverError: the node has no such column.
        """
        program, x = self.program, self.state_of(node)
        stops = (x in program.giving_up) + (x in program.waiting)
        if not stops or (must_wait and x not in program.waiting):
            raise SolverError("the answer is not proved: a policy gives up where this is forbidden")
        return len(self.actions[x]) + stops - 1

    def state_of(self, node: int) -> int:
        """Return the number of a node's state; with a horizon, of its pair (state, steps taken)."""
        return self.where[node][0] if node in self.where else (node - 1) % self.program.graph.size

    def member(self, decide: Decide) -> Member:
        """Return a policy with the numbers t and u that prove its quantities (see ``prove.py``).

        Where the policy would never end, it takes the column that waits for ever, which must be
        free.

        Args:
            decide: node -> position of the column that the policy takes.

        Raises:
            SolverError: the policy goes on for ever where waiting is not free.
        """
        above, decision, chosen = self.program.follows, dict[int, int](), dict[int, Column]()

        def taken(i: int) -> list[int]:
            """Record the decision at a node, and return the nodes that it leads to."""
            decision[i] = decide(above.get(i, i)) if i else 0
            chosen[i] = self.at(i)[decision[i]]
            return [j for _, j in chosen[i].moves]

        _closure([0], taken)
        before, ends = defaultdict[int, list[int]](list), list[int]()
        for i, column in chosen.items():
            within = [a for a, j in column.moves if i in above or j not in above]
            ends += [i] * (not i or sum(within) < column.total)  # nothing stops at the beginning
            for _, j in column.moves:
                before[j].append(i)
        ending = _closure(ends, lambda j: before[j] if j not in above else ())
        stopped = {i: self.stop(i, must_wait=True) for i in chosen.keys() - ending - above.keys()}
        stopped |= {i: stopped[j] for i, j in above.items() if i in chosen and j in stopped}
        decision |= stopped
        chosen |= {i: self.at(i)[k] for i, k in stopped.items()}
        met = _closure([0], lambda i: (j for _, j in chosen[i].moves))
        steps, widest, u = dict[int, int](), 1, [dict[int, int]() for _ in self.program.each]
        for block in self.blocks:
            some = [chosen[i] for i in block if i in met]
            widest = max(widest, *(-(-sum(a for a, _ in c.moves) // c.total) for c in some), 1)
            at = [column.node for column in some]
            steps |= zip(at, solved(_ways_of(some, repeat(Fraction(-ONE)), steps)), strict=True)
            for q, known in enumerate(u):
                ways = _ways_of(some, (-column.counts[q] * ONE for column in some), known)
                known |= zip(at, sub_solution(ways, range(len(ways)))[1], strict=True)
        # whole numbers: rounding each t up adds less than 1 + widest to its successors' mean
        t = {i: -(step * 2 * (1 + widest) // ONE) for i, step in steps.items()}
        kept = {i: decision[i] for i in met}
        return Member(kept, t, [{i: -v for i, v in values.items()} for values in u])


def _closure(begin: Iterable[int], after: Callable[[int], Iterable[int]]) -> set[int]:
    """Return the nodes that can be reached from given nodes, including these.

    Args:
        begin: the given nodes.
        after: node -> nodes that it leads to.
    """
    queue = list(begin)
    met = set(queue)
    for i in queue:  # the queue grows in the loop
        more = set(after(i)) - met
        met |= more
        queue += more
    return met


def _ways_of(
    columns: Sequence[Column], costs: Iterable[Fraction], known: Mapping[int, int]
) -> list[_Way]:
    """Return a block's columns, restricted to the block, whose nodes are numbered from 0.

    Args:
        columns: columns of the block, node by node.
        costs: cost of each column, in units.
        known: values of nodes outside the block, in units; they become part of the cost.
    """
    nodes = dict.fromkeys(column.node for column in columns)
    place, ways = {i: n for n, i in enumerate(nodes)}, list[_Way]()
    for (node, _, total, moves, _), cost in zip(columns, costs, strict=False):
        inner = [(a, place[j]) for a, j in moves if j in place]
        ahead = sum(a * known[j] for a, j in moves if j not in place)
        ways.append(_Way(place[node], total, inner, math.floor(cost * total) + ahead))
    return ways


def _best_of_block(ways: Sequence[_Way]) -> Iterable[tuple[int, int]]:
    """Return for each node of a block its least value, in units, and the index of a best way.

    The nodes of a free end component are solved as one node and get the same value, because a
    policy that stays there has no unique values.
    """
    if not any(way.outcomes for way in ways):
        return ((value, w) for w, value in zip(*sub_solution(ways, ()), strict=True))
    dynamics = _dynamics_of(ways, ways[-1].node + 1)
    free = (dynamics.exits == 0.0) & np.array([way.own == 0 for way in ways])
    component, stays = end_components(dynamics.graph, free)
    names = [c if c >= 0 else -1 - n for n, c in enumerate(component.tolist())]
    number = {name: g for g, name in enumerate(dict.fromkeys(names))}
    group = [number[name] for name in names]
    leaving = np.flatnonzero(~stays).tolist()
    leaving.sort(key=lambda w: group[ways[w].node])
    grouped = [_Way(group[node], total, [(a, group[j]) for a, j in outcomes], own)
               for node, total, outcomes, own in map(ways.__getitem__, leaving)]  # fmt: skip
    contracted = _dynamics_of(grouped, len(number)) if stays.any() else dynamics
    best, values = sub_solution(grouped, near_choice(grouped, contracted))
    taken = np.zeros(len(ways), dtype=np.bool_)
    taken[[leaving[w] for w in best]] = True
    # in a component: to where it is left
    nearer = nearer_pairs(dynamics.graph, taken, taken | stays).tolist()
    return [(values[g], w) for g, w in zip(group, nearer, strict=True)]


def sub_solution(ways: Sequence[_Way], choice: Sequence[int]) -> tuple[Sequence[int], list[int]]:
    """Return a best choice, and almost greatest values that satisfy the inequality of every way.

    With values v, the inequality is: v at the way's node <= cost of the way + mean of v over its
    outcomes.

    Args:
        ways: ways of all nodes, node by node.
        choice: a way for each node, by which every run ends; not used if no way has outcomes.

    Returns:
        The index of a way for each node, and the values in units.
    """
    if not any(way.outcomes for way in ways):
        best = dict[int, tuple[int, int]]()
        for w, way in enumerate(ways):
            worth = way.own // way.total // _PARTS * _PARTS, w
            best[way.node] = min(best.get(way.node, worth), worth)
        return [w for _, w in best.values()], [value for value, _ in best.values()]
    if not any(way.own for way in ways):
        return choice, [0] * len(choice)
    choice, values, room = best_values(ways, choice)
    short = [(value + _ROUNDING // 2) // _ROUNDING * _ROUNDING for value in values]
    if not _too_high(ways, short):
        return choice, short  # decimals, which are exact
    lost = max(max(map(abs, values)) // _LOST, 4 * _ROUNDING)
    tied = sorted({n for n, spare in enumerate(room) if spare <= lost}.union(choice))
    place = {n: i for i, n in enumerate(tied)}
    slow = [ways[n]._replace(own=-ways[n].total * ONE) for n in tied]
    steps = best_values(slow, [place[n] for n in choice])[1]  # negative: the longest run
    share = max(lost * ONE // (4 * (ONE - min(steps))), 8)
    grid = 10 ** (len(str(share // 4)) - 1)
    lowered = [(v + share * n // ONE) // grid * grid for v, n in zip(values, steps, strict=True)]
    # if failure is not limited, a ratio needs the value of failing surely to the last digit:
    ends = dict[int, int]()  # the cost of ending at once, which values reach where they may
    for way in ways:
        if not way.outcomes:
            end = way.own // way.total
            ends[way.node] = min(ends.get(way.node, end), end)
    ends = {i: end for i, end in ends.items() if 0 < end - lowered[i] <= 2 * lost}
    while ends:
        raised = [ends.get(i, value) for i, value in enumerate(lowered)]
        if not (wrong := ends.keys() & _too_high(ways, raised)):
            return choice, raised
        ends = {i: end for i, end in ends.items() if i not in wrong}
    return choice, lowered


def _too_high(ways: Sequence[_Way], values: Sequence[int]) -> set[int]:
    """Return the nodes whose value is too high for the inequality of one of their columns."""
    return {node for node, total, outcomes, own in ways
            if values[node] * total > own + sum(a * values[j] for a, j in outcomes)}  # fmt: skip


def best_values(
    ways: Sequence[_Way], choice: Sequence[int]
) -> tuple[Sequence[int], list[int], list[int]]:
    """Find a best choice by policy iteration, up to some units.

    Args:
        ways: ways of all nodes, node by node.
        choice: a way for each node, by which every run ends.

    Returns:
        The best way of each node, the value of each node, and the reduced cost of each way.

    Raises:
        SolverError: policy iteration does not end.
    """
    for _ in range(_IMPROVEMENTS):
        values = solved([ways[n] for n in choice])
        room = [(w.own + sum(a * values[j] for a, j in w.outcomes)) // w.total - values[w.node]
                for w in ways]  # fmt: skip
        better = [n for n, spare in enumerate(room) if spare < -_ROUNDING]
        if not better:
            return choice, values, room
        choice = list(choice)
        for n in sorted(better, key=room.__getitem__, reverse=True):
            choice[ways[n].node] = n
    raise SolverError("policy iteration does not end: round costs that differ by about 1e-40")


def near_choice(ways: Sequence[_Way], dynamics: Dynamics) -> list[int]:
    """Return a nearly best way for each node, computed in double precision; by them every run ends.

    Args:
        ways: ways of all nodes, node by node.
        dynamics: the process of these ways in double precision.

    Raises:
        SolverError: from some node no run can end.
    """
    costs, leaves = np.array([way.own / way.total / ONE for way in ways]), dynamics.exits > 0.0
    choice = nearer_pairs(dynamics.graph, leaves)
    if choice.min() < 0:
        raise SolverError("the answer is not proved: from some states no run can end")
    # to a cheap exit where there is one: giving up everywhere would be undone state by state
    cheap = nearer_pairs(dynamics.graph, leaves & (costs <= costs[leaves].mean()))
    choice = np.where(cheap < 0, choice, cheap)
    with suppress(SolverError):
        choice = iterate_policy(dynamics, costs[:, None], np.ones(1), choice, precise=False).choice
    return list(map(int, choice))


def _dynamics_of(ways: Sequence[_Way], n_nodes: int) -> Dynamics:
    """Return the columns of all nodes, node by node, as a process in double precision."""
    counts = np.bincount([way.node for way in ways], minlength=n_nodes)
    exits = [(way.total - sum(a for a, _ in way.outcomes)) / way.total for way in ways]
    entries = [(w, j, a / way.total) for w, way in enumerate(ways) for a, j in way.outcomes]
    rows = _matrix(entries, (len(ways), n_nodes))
    return Dynamics(offsets_of(counts), rows, np.array(exits))


def _matrix(entries: Sequence[tuple[int, int, float]], shape: tuple[int, int]) -> sp.csr_array:
    """Return a sparse matrix from entries (row, column, value); entries at one place are summed."""
    rows, columns, values = np.array(entries, dtype=np.float64).reshape(-1, 3).T
    return sp.csr_array((values, (rows.astype(np.int64), columns.astype(np.int64))), shape=shape)


def solved(chosen: Sequence[_Way]) -> list[int]:
    """Solve the equations of a policy with one way for each node; return its values in units.

    The equations hold up to some units, by iterative refinement.
    """
    if not any(way.outcomes for way in chosen):
        return [way.own // way.total for way in chosen]
    size, values, last = len(chosen), [0] * len(chosen), 0
    entries = [(i, i, 1.0) for i in range(size)]
    entries += [(i, j, -a / way.total) for i, way in enumerate(chosen) for a, j in way.outcomes]
    factors = sp.linalg.splu(sp.csc_array(_matrix(entries, (size, size))))
    while True:
        lack = [way.own + sum(a * values[j] for a, j in way.outcomes) - way.total * value
                for way, value in zip(chosen, values, strict=True)]  # fmt: skip
        worst = max(-(-abs(own) // way.total) for own, way in zip(lack, chosen, strict=True))
        if worst <= _UNITS or 0 < last < 2 * worst:
            return values
        finer = max(worst.bit_length() - _BITS, 0)
        scaled = [(own >> finer) / way.total for own, way in zip(lack, chosen, strict=True)]
        last, more = worst, factors.solve(np.array(scaled)).tolist()
        values = [v + (round(step) << finer) for v, step in zip(values, more, strict=True)]


def best_lottery(
    members: Sequence[Sequence[Fraction]], rows: Sequence[Row], room: Fraction, *, ratio: bool
) -> _Lottery:
    """Solve the master program in fractions: the lottery of least objective within the rows.

    If no lottery satisfies the rows, the weights may sum to less than 1, and the missing weight is
    minimised instead of the objective. At the prices of this problem every member violates the
    rows.

    Args:
        members: objective and row values of each member, [members][1 + rows].
        rows: rows that the lottery must satisfy.
        room: share of min(|bound|, 1) by which the lottery may exceed a row.
        ratio: whether the objective is divided by the goal probability, 1 - row 0.
    """
    n, size = len(members), len(rows)
    entries = [
        [*(one[1 + k] - row.least - room * min(abs(row.least), Fraction(1))
           for k, row in enumerate(rows)), 1 - ratio * one[1]] for one in members
    ]  # fmt: skip
    units = [[Fraction(j == k) for j in range(size + 1)] for k in range(size + 1)]
    costs, unpaid = [one[0] for one in members], [ZERO] * size
    goal = {m: entry[-1] for m, entry in enumerate(entries) if entry[-1] > 0}
    if goal:  # the cheapest member and all slacks are dual feasible
        begin = min(goal, key=lambda m: costs[m] / goal[m])
        master = ExactSimplex([*entries, *units[:size]], [*costs, *unpaid])
        if basis := master.solved([*range(n, n + size), begin]):
            weights, duals = (
                dict(zip(basis, master.values(basis), strict=True)),
                master.duals(basis),
            )
            drawn = [weights.get(m, ZERO) for m in range(n)]
            return _Lottery(drawn, [-dual for dual in duals[:size]], duals[size])
    # the last unit vector is the weight that is missing
    master = ExactSimplex([*entries, *units], [*[ZERO] * n, *unpaid, Fraction(1)])
    duals = master.duals(master.solved(range(n, n + size + 1)) or ())
    return _Lottery([], [-dual for dual in duals[:size]], Fraction(1))


def lower_bound(
    program: Program, prices: Sequence[Fraction], begin: int, rows: Sequence[Fraction]
) -> Fraction | None:
    """Return the lower bound of the objective, or of the ratio, that a value at the start proves.

    The result is None if no bound of the ratio is proved.

    Args:
        program: the program.
        prices: prices of its rows.
        begin: value of node 0, where runs begin, at these prices, in units.
        rows: the bound of each row.
    """
    bound = program.objective.constant + Fraction(begin, ONE) - sum(map(mul, prices, rows), ZERO)
    if not program.question["ratio"]:
        return bound
    goal = 1 - rows[0]
    if bound >= prices[0] * goal:
        return prices[0]
    return bound / goal if goal > 0 else None


def proof_of(
    nodes: Nodes, first: Sequence[Member], prices: Sequence[Fraction]
) -> tuple[list[bytes], Bounds]:
    """Find the best proof of a program, by column generation until both bounds agree.

    Args:
        nodes: nodes of the program.
        first: members of a nearly optimal lottery. If the best lottery over these members mixes
            several, the search starts at its prices.
        prices: nearly optimal prices, at which the search starts otherwise.

    Returns:
        The lines of the proof in a file, and the interval that it proves.

    Raises:
        SolverError: no lottery satisfies the rows.
    """
    program, rows, ratio = nodes.program, nodes.program.rows, bool(nodes.program.question["ratio"])
    members = {frozenset(one.decision.items()): one for one in first}
    most, less, far, is_new = [row.most for row in rows], _LESS, Fraction(1), True
    best: tuple[Fraction, Sequence[Fraction], dict[int, int]] | None = None
    is_exact, lower, lottery = False, None, _Lottery([], [ZERO] * len(rows), ZERO)
    for turn in range(_ROUNDS):
        if members:
            totals = [one.totals for one in members.values()]
            lottery = best_lottery(totals, rows, EXCESS, ratio=ratio)
        if lottery.weights and not (turn and lower is None and not is_new):
            width = ONE if best is None else lottery.value + program.objective.constant - best[0]
            enough = (_NARROW if nodes.size > _MANY else _LESS) * (1 + abs(lottery.value))
            if width <= enough or (is_exact and not is_new):
                break
            if is_exact := turn > 0 or sum(map(bool, lottery.weights)) > 1:
                prices, less = list(map(_of_few_digits, lottery.prices)), _LESS
                prices[0] += ratio * lottery.value * (1 - _LESS * (most[0] >= 1))
        elif lottery.weights:  # try to prove a slightly smaller ratio
            prices, less = [_of_few_digits(prices[0] * (1 - less)), *prices[1:]], less * 10**4
        elif members:
            if not is_new and far > 10**30:
                break
            far *= _FAR
            prices = [_of_few_digits(far * price) for price in lottery.prices]
        values = nodes.values(prices)
        lower = lower_bound(program, prices, values[0], most)
        if lower is not None and (best is None or lower > best[0]):
            best = lower, prices, values
        member = nodes.member(nodes.last.__getitem__)
        is_new = (key := frozenset(member.decision.items())) not in members
        members[key] = member
        priced = map(mul, [Fraction(1), *prices], member.totals)
        attained = lower_bound(program, prices, math.floor(sum(priced) * ONE), most)
        if lower is not None and attained is not None and lottery.weights:
            worth = lottery.value + program.objective.constant
            if attained >= worth - _LESS * (1 + abs(worth)):
                break  # no policy improves the lottery: the rest of the width is the cap's
    if best is None or not lottery.weights:
        raise SolverError(_broken(rows, members.values(), lottery.prices))
    exact = best_lottery(totals, rows, ZERO, ratio=ratio)
    if exact.weights and exact.value <= lottery.value + _NARROW * (1 + abs(lottery.value)):
        lottery = exact
    chosen = zip(lottery.weights, members.values(), strict=False)  # without one of a last round
    drawn = [(w / sum(lottery.weights), one) for w, one in chosen if w]
    means = [sum((w * one.totals[q] for w, one in drawn), ZERO) for q in range(len(rows) + 1)]
    paid = [max(one) for one in zip(most, means[1:], strict=True)]
    lower = lower_bound(program, best[1], best[2][0], paid) or ZERO
    upper = program.objective.constant + means[0]
    cap, weights = Fraction(program.cap, program.unit), [str(w) for w, _ in drawn]
    head: dict[str, Any] = {"cap": str(cap), "prices": [*map(str, best[1])], "weights": weights}
    if ratio:
        lower, upper = _of_few_digits(lower), max(upper, upper / (1 - means[1]))
        head["ratio"] = str(lower)
    return _in_lines(head, best[2], [one for _, one in drawn]), Bounds(lower, upper, {})


def _in_lines(
    head: dict[str, Any], values: Mapping[int, int], members: Sequence[Member]
) -> list[bytes]:
    """Return a proof as lines of a certificate file.

    Args:
        head: fields of the first line; ``unit`` and ``lines`` are added.
        values: node -> value of the lower bound, in units of 1 / ``ONE``.
        members: members of the lottery. Values are written as multiples of the largest unit that
            divides all of them.
    """
    vectors = [values, *(vector for one in members for vector in one.u)]
    unit = math.gcd(ONE, *(value for vector in vectors for value in vector.values()))
    nodes = sorted(set(values).union(*(one.decision for one in members)))
    head |= {"unit": ONE // unit, "lines": len(nodes)}
    lines = [line_of(head)]
    for i in nodes:
        entries = [[m, one.decision[i], one.t[i], *(str(vector[i] // unit) for vector in one.u)]
                   for m, one in enumerate(members) if i in one.decision]  # fmt: skip
        lines.append(line_of([i, str(values[i] // unit) if i in values else None, *entries]))
    return lines


def line_of(content: object) -> bytes:
    """Return an object as a line of a certificate file: compact JSON in bytes."""
    return json.dumps(content, separators=(",", ":")).encode() + b"\n"


def _broken(rows: Sequence[Row], members: Iterable[Member], prices: Sequence[Fraction]) -> str:
    """Return the message for a program of which no lottery satisfies the rows.

    It names the row of the greatest price, and the least amount by which a member exceeds its
    bound.
    """
    k = max(range(len(rows)), key=prices.__getitem__)
    least = min(one.totals[1 + k] for one in members)
    return (f"no policy satisfies row {rows[k].name!r} exactly: {float(least)!r} is more than "
            f"{float(rows[k].least)!r} by {float(least - rows[k].least):.1e}")  # fmt: skip


def _of_few_digits(price: Fraction) -> Fraction:
    """Return a price rounded down to fewer digits, which is allowed: any price proves a bound."""
    return Fraction(math.floor(price * _PARTS), _PARTS)
