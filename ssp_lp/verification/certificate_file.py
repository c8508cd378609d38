"""Proofs in files: an exact model, the question, and numbers whose inequalities prove the optimum.

What a file holds, and why it proves anything, stands in ``ssp_lp.verification.checker``, which
shares nothing with the library; nothing is to be believed of what is written here. A float means
its shortest decimal, a cost that was given as a fraction that fraction.

Values come from policy iteration at the solution's prices, refined in integers until their rounding
is far below what is lost on purpose: every value is moved by a tiny share of the steps that may
follow, so that each inequality holds by more than the last digits that are left out.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog
from scipy.sparse.linalg import splu

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import Argument, ModelError, SolverError
from ssp_lp.model import SSP
from ssp_lp.model.graph import end_components, nearer_pairs
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Policy
from ssp_lp.problem import Problem, conditions_of, objective_of, requirements
from ssp_lp.processes.conditions import Condition, StepTerm
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.solution import Solution, as_solved
from ssp_lp.verification import checker
from ssp_lp.verification.checker import ONE, Checked, down

_LOST = 10**24
"""Values are moved by at most one part in so many of the largest: far more than rounding in units
of 1/ONE, far less than anybody looks at."""

_ROUNDS = 60
"""Refinements of a system, each of which gains the digits that its condition leaves of 16."""

_IMPROVEMENTS = 500  # of a policy, until which iteration has always ended
_UNITS = 4.0  # of 1/ONE: what equations may lack in the end
_WORSE = ONE // 10**45  # values that differ by less may differ by rounding alone
_PRICE_MOVES = 1e-6  # of a price, by which it may be corrected
_RAISES = 60  # of a price that is not known
_SHIFT = Fraction(1, 10**9)  # of a lottery, which may be moved to another one


def write_certificate(solution: Solution, path: str | Path) -> Checked:
    """Write a proof of a solution's optimum that others can check without this library.

    Covered are criteria of case M in the exact setting: expected costs and quantities with a
    failure budget, a share of the greatest goal probability, a penalty or failing forbidden, the
    greatest and the least goal probability, each with any limits and any start, within a horizon
    too. At least failure is covered where the goal can be reached surely: elsewhere two policies
    would have to be shown to fail exactly alike, which no inequality between rounded numbers does.

    Args:
        solution: of ``solve``; its policy and its prices are what is proved to be best.
        path: of the file, which is gzip whatever it is called.

    Returns:
        What the file proves: the checker's verdict on it.

    Raises:
        ModelError: a criterion that is not covered.
        SolverError: the answer could not be proved: the policy breaks a row by more than rounding.
    """
    asked, solved = repr(solution.problem), as_solved(solution, "write_certificate")
    statement = _Statement(solved.problem, asked)
    lines = list(statement.lines())
    question = json.loads(lines[0])
    try:
        model = checker.Model(question, lines[1:])
    except checker.RefusedError as error:
        raise ModelError(f"no certificate: {error}") from error
    digest = sha256(b"\n".join(lines)).hexdigest()
    lines += _proof(model, solved, digest)
    content = b"\n".join(lines)
    try:
        found = checker.check_lines(lines)
    except checker.RefusedError as error:
        raise SolverError(f"the answer is not proved: {error}") from error
    with open(path, "wb") as raw, gzip.GzipFile("", "wb", fileobj=raw, mtime=0) as file:
        file.write(content)
    return found


def _line(content: Mapping[str, Any]) -> bytes:
    """A line of the file."""
    return json.dumps(content, separators=(",", ":")).encode()


@cache
def _decimal_of(value: float) -> str:
    """The shortest decimal of a float."""
    return repr(value).removesuffix(".0")


def _check_covered(problem: Problem) -> None:
    """Refuse criteria whose proofs take more than is written here.

    Raises:
        ModelError: the criterion, and what of it is not covered.
    """
    asks, name = requirements(problem), type(problem).__name__
    if problem.discount is not None:
        told = Argument("discount"), ": certificates are of exact probabilities"
        raise ModelError(f"no certificate of {name} with a ", *told)
    if asks.ratio or asks.measure is not None or asks.counts_totals:
        raise ModelError(f"no certificate of {name}: its cost counts by the total of a run that "
                         "succeeds, which certificates do not tell apart yet")  # fmt: skip


@dataclass
class _Statement:
    """The question and the model, line by line. Sets and costs are gathered while it is made."""

    problem: Problem
    asked: str
    costs: list[tuple[FloatArray, Mapping[float, Fraction]]] = field(default_factory=list)
    sets: dict[str, BoolArray] = field(default_factory=dict)

    def lines(self) -> Iterator[bytes]:
        """The question, and a line for each state."""
        model = self.problem.model
        _check_covered(self.problem)
        self.costs.append((model.costs, model.exact_costs))
        yield _line(self._question())
        texts = [
            [str(exact[c]) if c in exact else _decimal_of(c) for c in costs.tolist()]
            for costs, exact in self.costs
        ]
        chances = [_decimal_of(p) for p in model.probabilities.tolist()]
        successors, pairs = model.successors.tolist(), model.pair_offsets.tolist()
        bounds = model.outcome_offsets.tolist()
        goal = model.goal_mask.tolist()
        for x in range(model.n_states):
            actions = []
            for k in range(pairs[x], pairs[x + 1]):
                some = slice(bounds[k], bounds[k + 1])
                told = [list(pair) for pair in zip(chances[some], successors[some], strict=True)]
                paid = [t[some] if len(set(t[some])) > 1 else t[some][0] for t in texts]
                actions.append([str(model.action_of(k)), told, paid])
            sets = [name for name, mask in self.sets.items() if mask[x]]
            sets = ["goal", *sets] if goal[x] else sets
            yield _line({"name": str(model.states[x]), "sets": sets, "actions": actions})

    def _question(self) -> dict[str, Any]:
        """What is asked, in the checker's terms."""
        problem, semantics = self.problem, self.problem.semantics
        objective, to_goal = objective_of(problem), [["1", "end", "goal"]]
        penalty = 0.0 if semantics.forbids_failing else semantics.penalty
        least = {"constant": _decimal_of(penalty), "terms": [["1", "cost", 0]]}
        if penalty > 0.0:
            least["terms"] += [[f"-{_decimal_of(penalty)}", "end", "goal"]]
        if objective is not None:
            least = self._quantity(objective, getattr(problem, "quantity", None))
        elif semantics.aim is not Aim.LEAST_COST:
            least = {"constant": "0", "terms": to_goal}
        rows = []
        stated = {**getattr(problem, "own_constraints", {}), **getattr(problem, "constraints", {})}
        for condition in conditions_of(problem):
            quantity = getattr(stated.get(condition.name), "quantity", None)
            row = {"quantity": self._quantity(condition, quantity)}
            for upper in condition.rows:
                side = "at_most" if upper.sign > 0.0 else "at_least"
                bound = condition.upper if upper.sign > 0.0 else condition.lower
                rows.append({"name": upper.name, **row, side: _decimal_of(float(bound or 0.0))})
        start = problem.start if isinstance(problem.start, Mapping) else {problem.start: 1.0}
        begins = [[_text_of(p), problem.model.index_of(x)] for x, p in start.items()]
        return {
            "format": checker.FORMAT,
            "asked": self.asked,
            "states": problem.model.n_states,
            "costs": len(self.costs),
            "sets": list(self.sets),
            "start": begins,
            "give_up": str(semantics.give_up),
            "charge_failing_step": bool(semantics.charge_failing_step),
            "greatest": objective is None and semantics.aim is Aim.GREATEST_GOAL,
            "objective": least,
            "failure": self._failure(),
            "rows": rows,
        }

    def _failure(self) -> Any:
        """How much failing is allowed."""
        problem, share = self.problem, getattr(self.problem, "reach_fraction", None)
        if problem.semantics.forbids_failing:
            return "0"
        if share is not None:
            return {"share": _decimal_of(float(share))}
        budget = problem.failure_budget
        if budget is None:
            return "least"
        return None if budget >= 1.0 else _decimal_of(max(float(budget), 0.0))

    def _quantity(self, condition: Condition, stated: Any) -> dict[str, Any]:
        """A quantity whose words were looked up."""
        terms: list[list[Any]] = []
        constant = Fraction(_decimal_of(condition.constant if stated is None else stated.constant))
        for weight, term in condition.terms:
            text, less = _decimal_of(weight), _decimal_of(-weight)
            if isinstance(term, StepTerm):
                terms.append([text, "cost", self._cost(term.model)])
            elif term.others:
                constant += Fraction(text)
                terms.append([less, "end", self._set(term.states)])
            else:
                terms.append([text, "end" if term.final else "visits", self._set(term.states)])
        return {"constant": str(constant), "terms": terms}

    def _cost(self, model: SSP) -> int:
        """The position of a cost among those that are written."""
        for number, (costs, _) in enumerate(self.costs):
            if costs is model.costs or np.array_equal(costs, model.costs):
                return number
        self.costs.append((model.costs, model.exact_costs))
        return len(self.costs) - 1

    def _set(self, mask: BoolArray) -> str:
        """The name of a set of states: the goal, a label's own, or a number."""
        model = self.problem.model
        if np.array_equal(mask, model.goal_mask):
            return "goal"
        known = next((name for name, has in self.sets.items() if np.array_equal(has, mask)), None)
        if known is None:
            members = mask.nonzero()[0]
            known = f"set {len(self.sets) + 1}"
            for label, states in model.state_labels.items():
                if label != "goal" and np.array_equal(np.sort(states), members):
                    known = str(label)
            if members.size == 1:
                known = str(model.states[int(members[0])])
            known = known if known not in {"goal", *self.sets} else f"set {len(self.sets) + 1}"
            self.sets[known] = mask
        return known


def _text_of(value: Any) -> str:
    """A number as a text: a fraction as it is, else the shortest decimal."""
    return str(value) if isinstance(value, (int, Fraction)) else _decimal_of(float(value))


def _proof(model: checker.Model, solution: Solution, digest: str) -> Iterator[bytes]:
    """The lines of a proof: its head, and a line for each state."""
    ssp, weights = solution.problem.model, solution.policy.weights
    drawn = zip(solution.policy.policies, weights.tolist(), strict=True)
    members = [_decisions(model, policy) for policy, weight in drawn if weight > 0.0]
    w = [0] * len(model.names)
    if model.share is not None:  # a member of weight 0 shows how likely the goal can be
        failure, free = model.rows[0], model.staying(model.live, model.every)[0]
        w, likely = _Priced(model, ssp, failure, free).sub_solution(members)
        members.append(_reached(model, likely))
    vectors = [_member_vectors(model, decided) for decided in members]
    totals = [model.above(entries, f"member {m}") for m, entries in enumerate(vectors)]
    if model.share is not None:
        model.set_share(w, totals)
    chosen = _weights(model, weights[weights > 0.0], totals)
    prices, v = _priced_values(model, solution, members, totals)
    yield _line({
        "sha256": digest,
        "prices": [str(price) for price in prices],
        "weights": [str(weight) for weight in chosen],
    })  # fmt: skip
    for x in range(len(model.names)):
        line = {"v": _decimal(v[x]), "members": [entries.get(x) for entries in vectors]}
        yield _line(line if model.share is None else {**line, "w": _decimal(w[x])})


def _priced_values(
    model: checker.Model,
    solution: Solution,
    members: Sequence[Mapping[int, int]],
    totals: Sequence[Sequence[Fraction]],
) -> tuple[list[Fraction], list[int]]:
    """Prices of the rows, and values that bound all policies at these, in units."""
    given = [max(solution.prices.get(row.name, 0.0), 0.0) for row in model.rows]
    prices, at = [Fraction(_decimal_of(price)) for price in given], None
    weighed = totals[: int((solution.policy.weights > 0.0).sum())]
    some = [j for j, price in enumerate(given) if price > 0.0 and (j > 0 or model.may_fail)]
    if not model.may_fail:
        prices[0] = Fraction(0)  # only what keeps the goal sure counts
    elif model.rows and model.rows[0].name == "failure" and solution.failure_price is None:
        at = 0  # the budget was met by failing as little as possible, which has no price
    if len(weighed) > 1 and some and at is None:
        # the members are alike at the right prices: take away by what they differ still
        worth = [t[0] + sum(prices[j] * t[1 + j] for j in some) for t in weighed]
        table = [[float(t[1 + j] - weighed[0][1 + j]) for j in some] for t in weighed[1:]]
        step = np.linalg.lstsq(table, [float(worth[0] - each) for each in worth[1:]])[0]
        if all(abs(d) <= _PRICE_MOVES * given[j] for d, j in zip(step, some, strict=True)):
            for d, j in zip(step.tolist(), some, strict=True):
                prices[j] += Fraction(d)
    best: tuple[Fraction, list[Fraction], list[int]] | None = None
    for _ in range(_RAISES if at is not None else 1):
        c = model.priced(prices)
        v, _ = _Priced(model, solution.problem.model, c, model.free).sub_solution(members)
        bound = c.constant + sum(p * (c.arrival[x] + Fraction(v[x], ONE)) for p, x in model.start)
        if best is not None and bound <= best[0]:
            break
        best = bound, list(prices), v
        if at is not None:
            prices[at] = max(8 * prices[at], abs(totals[0][0]), Fraction(1, 1000))
    if best is None:
        raise SolverError("no price was tried")
    return best[1], best[2]


def _decimal(value: int) -> str:
    """A number in units of 1/ONE as a decimal."""
    digits = f"{abs(value):061d}"
    text = f"{digits[:-60]}.{digits[-60:]}".rstrip("0").rstrip(".")
    return f"-{text}" if value < 0 else text


def _decisions(model: checker.Model, policy: Policy) -> dict[int, int]:
    """A member's pair at each state that it comes to; GIVE_UP_CODE where it stops or wanders.

    Raises:
        ModelError: it remembers something, draws its actions, or lacks a decision.
    """
    live = np.array(sorted(model.live), dtype=np.int64)
    found = policy.branches(live, np.zeros(live.size, dtype=np.int64))
    if not policy.is_stationary or len(found.situation) != live.size:
        raise ModelError("no certificate of a policy that remembers or draws its actions")
    return _reached(model, dict(zip(live.tolist(), found.pair.tolist(), strict=True)))


def _reached(model: checker.Model, pair_at: Mapping[int, int]) -> dict[int, int]:
    """The part of a policy that is met from the start; who can never end stops at once."""
    met = {x for _, x in model.start if x in model.live}
    ahead, before = list(met), dict[int, list[int]]()
    ending = []
    while ahead:
        x = ahead.pop()
        if (k := pair_at[x]) == UNDECIDED:
            raise ModelError(f"the policy has no decision in state {model.names[x]!r}")
        after = {y for _, y in model.pairs[k][2]} if k >= 0 else set()
        if k < 0 or after & model.ended:
            ending.append(x)
        for y in after & model.live:
            before.setdefault(y, []).append(x)
        ahead += (after & model.live) - met
        met |= after & model.live
    ends = set(ending)
    while ending:
        more = set(before.get(ending.pop(), ())) - ends
        ends |= more
        ending += more
    return {x: pair_at[x] if x in ends else GIVE_UP_CODE for x in met}


Row = tuple[int, list[tuple[int, int]], int]
"""A total T, outcomes (a, place) of probability a / T, and T times what the step takes, in units."""


class _Chain:
    """The equations of a chain that ends, solved in units of 1/ONE."""

    def __init__(self, rows: Sequence[Row]) -> None:
        """Factorise in working precision."""
        self.rows, n = rows, len(rows)
        at = [(i, j, a / total) for i, (total, some, _) in enumerate(rows) for a, j in some]
        i, j, p = zip(*at, strict=True) if at else ((), (), ())
        matrix = sp.csc_array(
            (np.array(p, dtype=float), (np.array(i, dtype=int), np.array(j, dtype=int))),
            shape=(n, n),
        )
        self.factors = splu(sp.csc_array(sp.identity(n, format="csc") - matrix))

    def solve(self, own: Sequence[int]) -> list[int]:
        """Values whose equations hold but for some units.

        Args:
            own: T times what each step takes, in units.
        """
        values, last = [0] * len(self.rows), np.inf
        for _ in range(_ROUNDS):
            lack = [
                (mine + sum(a * values[j] for a, j in some) - total * values[i]) / total
                for i, ((total, some, _), mine) in enumerate(zip(self.rows, own, strict=True))
            ]
            worst = max(map(abs, lack), default=0.0)
            if worst <= _UNITS or not worst < 0.5 * last:
                return values
            last = worst
            more = self.factors.solve(np.array(lack))
            values = [value + int(step) for value, step in zip(values, more.tolist(), strict=True)]
        return values


def _member_vectors(model: checker.Model, decided: Mapping[int, int]) -> dict[int, list[Any]]:
    """What the checker is to read of a member: its decisions and its vectors, rounded up."""
    place = {x: i for i, x in enumerate(decided)}
    own: list[list[int]] = [[] for _ in model.each]
    arrivals = [[-down(-a) for a in q.arrival] for q in model.each]
    rows: list[Row] = []
    for x, k in decided.items():
        total, outcomes, paid = model.pairs[k][1:] if k >= 0 else (1, [], [])
        rows.append((total, [(a, place[y]) for a, y in outcomes if y in place], 0))
        for mine, q, arrival in zip(own, model.each, arrivals, strict=True):
            stop = q.at_stop(model, x, model.free) if k < 0 else checker.dot(q.costs, paid)
            if stop is None:
                raise ModelError(f"the policy gives up in state {model.names[x]!r}: it may not")
            mine.append(-down(-stop) + sum(a * arrival[y] for a, y in outcomes))
    chain = _Chain(rows)
    steps = chain.solve([total * ONE for total, _, _ in rows])
    grid = ONE // 1000
    rounded = [-(-(t + t // 100) // grid) * grid for t in steps]  # t >= 1 + P t with room
    vectors = [rounded]
    for mine in own:
        if not any(mine):  # then nothing is taken, exactly
            vectors.append(mine)
            continue
        values = chain.solve(mine)
        short = _shortened(values)
        if all(
            paid + sum(a * short[j] for a, j in some) <= short[i] * total
            for i, ((total, some, _), paid) in enumerate(zip(rows, mine, strict=True))
        ):
            vectors.append(short)
            continue
        share = max(map(abs, values)) // (_LOST * (max(rounded) // ONE + 1)) + 8
        grid = 10 ** (len(str(share // 4)) - 1)
        vectors.append([-(-(u * ONE + share * t) // (ONE * grid)) * grid
                        for u, t in zip(values, rounded, strict=True)])  # fmt: skip
    told = {x: "stop" if k < 0 else k - model.first[x] for x, k in decided.items()}
    return {x: [told[x], *(_decimal(vector[i]) for vector in vectors)] for x, i in place.items()}


def _shortened(values: Sequence[int]) -> list[int]:
    """Values without their last digits, which are rounding; decimals are exact then."""
    return [(value + _WORSE // 2) // _WORSE * _WORSE for value in values]


class _Priced:
    """The process at prices; what may be gone about in for nothing is one node."""

    def __init__(
        self, model: checker.Model, ssp: SSP, c: checker.Quantity, free: set[int]
    ) -> None:
        """Lay out the rows of all nodes, sorted by node."""
        self.model, self.ssp = model, ssp
        self.moving = sorted(model.moving)
        arrival, inside = [down(a) for a in c.arrival], set(self.moving)
        own = {
            k: down(checker.dot(c.costs, model.pairs[k][3]))
            + sum(a * arrival[y] for a, y in model.pairs[k][2])
            for x in self.moving
            for k in model.of(x)
            if model.keeps[k]
        }
        costless = np.zeros(ssp.n_pairs, dtype=np.bool_)
        for k, paid in own.items():
            costless[k] = paid == 0 and all(y in inside for _, y in model.pairs[k][2])
        component, self.within = end_components(ssp, costless)
        self.node = {
            x: int(component[x]) if component[x] >= 0 else x + ssp.n_states for x in self.moving
        }
        number = {node: i for i, node in enumerate(dict.fromkeys(self.node.values()))}
        self.node = {x: number[node] for x, node in self.node.items()}
        found: list[tuple[int, int, Row]] = []
        for x in self.moving:
            for k in model.of(x):
                if k in own and not self.within[k]:
                    outcomes = [(a, self.node[y]) for a, y in model.pairs[k][2] if y in inside]
                    found.append((self.node[x], k, (model.pairs[k][1], outcomes, own[k])))
            if model.may_fail and (stop := c.at_stop(model, x, free)) is not None:
                found.append((self.node[x], GIVE_UP_CODE, (1, [], down(stop))))
        found.sort(key=lambda row: row[0])
        self.n_nodes, self.rows = len(number), [row for _, _, row in found]
        self.row_node = np.array([node for node, _, _ in found], dtype=np.int64)
        self.row_pair = [k for _, k, _ in found]

    def sub_solution(
        self, members: Sequence[Mapping[int, int]]
    ) -> tuple[list[int], dict[int, int]]:
        """Values of states whose inequalities hold, in units, and the pairs that attain them.

        Args:
            members: policies that are near the best.
        """
        values = [0] * len(self.model.names)
        if not self.moving:
            return values, {}
        rows, choice = self.rows, self._proper_choice(members)
        floats = _Rows(
            self.row_node, rows, np.array([own / (total * ONE) for total, _, own in rows])
        )
        choice = floats.improved(choice)
        for _ in range(_IMPROVEMENTS):
            some = [rows[r] for r in choice.tolist()]
            v = _Chain(some).solve([own for _, _, own in some])
            slack = [
                (own + sum(a * v[j] for a, j in outcomes)) // total - v[node]
                for node, (total, outcomes, own) in zip(self.row_node.tolist(), rows, strict=True)
            ]
            better = [r for r, room in enumerate(slack) if room < -_WORSE]
            if not better:
                break
            for r in sorted(better, key=slack.__getitem__, reverse=True):
                choice[self.row_node[r]] = r
        short = _shortened(v)
        if all(
            short[node] * total <= own + sum(a * short[j] for a, j in outcomes)
            for node, (total, outcomes, own) in zip(self.row_node.tolist(), rows, strict=True)
        ):
            for x in self.moving:
                values[x] = short[self.node[x]]
            return values, self._on_states([self.row_pair[r] for r in choice.tolist()])
        # lower by a share of the longest way that there is among rows as good as the best
        lost = max(max(map(abs, v)) // _LOST, 4 * _WORSE)
        tied = np.array([room <= lost for room in slack]).nonzero()[0]
        tied = np.union1d(tied, choice)
        steps = _Rows(
            self.row_node[tied], [rows[r] for r in tied.tolist()], np.full(tied.size, -1.0)
        )
        h = -steps.values(steps.improved(np.searchsorted(tied, choice)))
        share = lost // int(4.0 * h.max() + 4.0)
        grid = 10 ** (len(str(max(share // 4, 1))) - 1)
        v = [(value - share * int(1024.0 * n + 1.0) // 1024) // grid * grid
             for value, n in zip(v, h.tolist(), strict=True)]  # fmt: skip
        for x in self.moving:
            values[x] = v[self.node[x]]
        return values, self._on_states([self.row_pair[r] for r in choice.tolist()])

    def _proper_choice(self, members: Sequence[Mapping[int, int]]) -> IntArray:
        """A row of each node by which it may come nearer to an end, a member's where that does."""
        choice = np.full(self.n_nodes, -1, dtype=np.int64)
        row_at = {k: r for r, k in enumerate(self.row_pair) if k >= 0}
        preferred = {row_at[k] for member in members for k in member.values() if k in row_at}
        for allowed in (preferred, range(len(self.rows))):
            before: dict[int, list[int]] = {}
            ahead = []
            for r in allowed:
                total, outcomes, _ = self.rows[r]
                if sum(a for a, _ in outcomes) < total or any(choice[j] >= 0 for _, j in outcomes):
                    ahead.append(r)
                for _, j in outcomes:
                    before.setdefault(j, []).append(r)
            for r in ahead:  # it grows while it is walked
                node = int(self.row_node[r])
                if choice[node] < 0:
                    choice[node] = r
                    ahead += before.get(node, [])
        return choice

    def _on_states(self, pairs: Sequence[int]) -> dict[int, int]:
        """The pairs of nodes as pairs of states, which move to where their node is left."""
        chosen = np.zeros(self.ssp.n_pairs, dtype=np.bool_)
        chosen[[k for k in pairs if k >= 0]] = True
        nearer = nearer_pairs(self.ssp, chosen, chosen | self.within)
        return {x: GIVE_UP_CODE if pairs[self.node[x]] < 0 else int(nearer[x]) for x in self.moving}


class _Rows:
    """Rows in working precision, for policy iteration."""

    def __init__(self, node: IntArray, rows: Sequence[Row], cost: FloatArray) -> None:
        """Rows sorted by node; their cost takes the place of what they take."""
        self.cost, n = cost, int(node[-1]) + 1
        lengths = [len(outcomes) for _, outcomes, _ in rows]
        chances = [a / total for total, outcomes, _ in rows for a, _ in outcomes]
        columns = np.array([j for _, outcomes, _ in rows for _, j in outcomes], dtype=np.int64)
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        self.matrix = sp.csr_array(
            (np.array(chances, dtype=float), columns, offsets), shape=(len(rows), n)
        )
        self.first, self.node = np.searchsorted(node, np.arange(n)), node

    def values(self, choice: IntArray) -> FloatArray:
        """The totals of a choice, [nodes]."""
        system = sp.identity(choice.size, format="csc") - sp.csc_array(self.matrix[choice])
        return np.asarray(splu(sp.csc_array(system)).solve(self.cost[choice]))

    def improved(self, choice: IntArray) -> IntArray:
        """Policy iteration from a choice that ends."""
        for _ in range(_IMPROVEMENTS):
            values = self.values(choice)
            worth = self.cost + self.matrix @ values
            least = np.minimum.reduceat(worth, self.first)
            better = least < values - 1e-12 * np.abs(values).max()
            if not better.any():
                return choice
            best = np.flatnonzero(worth == least[self.node])
            first = best[np.unique(self.node[best], return_index=True)[1]]
            choice = np.where(better, first, choice)
        return choice


def _weights(
    model: checker.Model, drawn: FloatArray, totals: Sequence[Sequence[Fraction]]
) -> list[Fraction]:
    """Weights near those of the lottery at which every row is kept exactly, where that can be."""
    weights = [Fraction(_decimal_of(w)) for w in drawn.tolist()]
    weights += [Fraction(0)] * (len(totals) - len(weights))
    largest = max(range(len(weights)), key=weights.__getitem__)
    weights[largest] += 1 - sum(weights)
    beyond = [[total[j] - row.bound for total in totals] for j, row in enumerate(model.rows, 1)]
    excess = [sum(w * e for w, e in zip(weights, each, strict=True)) for each in beyond]
    if max(excess, default=Fraction(0)) <= 0:
        return weights
    # the lottery that keeps most room in every row, of which as much is mixed in as is needed
    scale = np.array([max([abs(float(e)) for e in each] + [1e-300]) for each in beyond])
    table = np.array([[float(e) for e in each] for each in beyond]) / scale[:, None]
    roomy = linprog(
        np.append(np.zeros(len(totals)), -1.0),
        np.column_stack([table, np.ones(len(scale))]), np.zeros(len(scale)),
        np.append(np.ones(len(totals)), 0.0)[None, :], [1.0],
        bounds=[(0.0, 1.0)] * len(totals) + [(None, 1.0)],
    )  # fmt: skip
    if roomy.status != 0:
        return weights
    other = [Fraction(_decimal_of(max(float(w), 0.0))) for w in roomy.x[:-1]]
    other = [w / sum(other) for w in other]
    room = [-sum(w * e for w, e in zip(other, each, strict=True)) for each in beyond]
    needed = [
        e / (e + r) if e + r > 0 else Fraction(1)
        for e, r in zip(excess, room, strict=True)
        if e > 0
    ]
    part = max(needed)
    if part > _SHIFT or any(r <= 0 for r, e in zip(room, excess, strict=True) if e > 0):
        return weights
    part = Fraction(-down(-part), ONE)
    return [w + part * (o - w) for w, o in zip(weights, other, strict=True)]
