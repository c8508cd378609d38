"""Proofs in files: an exact model, the question, and numbers whose inequalities prove the optimum.

What a file holds, and why it proves anything, stands in ``ssp_lp.verification.checker``, which
shares nothing with the library; nothing is to be believed of what is written here. A float means
its shortest decimal, a cost that was given as a fraction that fraction.

Values come from policy iteration at the solution's prices (``exact_values``).
"""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from fractions import Fraction
from functools import cached_property, lru_cache
from hashlib import sha256
from heapq import heappop, heappush
from pathlib import Path
from typing import Any, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import (
    TOTAL_COST,
    Charge,
    ExcessCharge,
    ExpectedArrivalCost,
    ExpectedUtility,
    ExponentialUtility,
    Reward,
    TailMeanOf,
    TotalCostCharge,
    WithinBound,
)
from ssp_lp.analysis.evaluation import success_costs
from ssp_lp.arrays import SAME_TOTAL, BoolArray, FloatArray
from ssp_lp.errors import Argument, ModelError, SolverError
from ssp_lp.formulation import Formulation
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import Graph
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import UNDECIDED
from ssp_lp.problem import Problem, as_stated
from ssp_lp.processes.conditions import Condition, StepTerm
from ssp_lp.processes.failure_semantics import Aim, FailureSemantics, GiveUp
from ssp_lp.solution import Solution, as_solved
from ssp_lp.solving import solve
from ssp_lp.verification import checker
from ssp_lp.verification.checker import Checked
from ssp_lp.verification.decision_cases import cases_of_decisions
from ssp_lp.verification.exact_values import (
    case_values,
    member_vectors,
    text_of,
    values_below,
)
from ssp_lp.verification.lottery import (
    NEARLY_MET,
    decisions,
    exact_solution,
    graph_of,
    lottery_weights,
    reached,
)

_ROUNDED_ROW = Fraction(1, 10**12)  # of a bound, or of 1, to which solutions keep rows
_ROUNDED_NUMBER = Fraction(1, 2**51)  # of a bound as it is stated, which is a float
_MOVED = Fraction(1, 10**6)  # of a price, by which it may be corrected
_RAISES = 60  # of a price that is not known
_LESS = Fraction(1, 10**12)  # of a ratio, than which nothing less is told apart where totals count
_SMALLER = Fraction(1, 10**4)  # by so much a ratio may be proved to be at least
_LEAST_ROOM = Fraction(1, 10**12)  # relative, to which cases are to prove a bound
_CAPS, _WIDTH = 12, 1e-10  # of totals tried, until an interval is as narrow as this
_MANY, _WIDER = 20_000, 1e-7  # nodes, of more of which an interval of this width will do
_MOST_NODES = 2_000_000
_FEW = 500  # nodes, of which proofs in fractions are tried
_DIGITS = (120, 960)  # by which fractions are told
_LONGEST = 6000  # bits of a common denominator
_TABLES = (ExpectedUtility, ExponentialUtility, ExpectedArrivalCost)
"""Charges that are told of one total after the other, as far as they change."""

_ROUNDED = 1e-15  # of an exponential
_FARTHEST, _USED_UP = 10**6, 1e-11  # total up to which a utility is told, or what is left there
_ENDLESS = 1e300  # claimed where a solution states no bound


@explained
def write_certificate(solution: Solution, path: str | Path, *, tolerance: float = 1e-6) -> Checked:
    """Write a certificate file: a proof of a solution's optimum, to check without this library.

    Covered are expected costs and quantities, also with a discount, with a failure budget, a share
    of the greatest goal probability, a penalty or failing forbidden, the greatest and the least
    goal probability; and of the total cost its mean given success, the mean of its costliest runs
    (CVaR), what arriving costs, the goal within a cost, utilities and quantiles; each with any
    limits and any start, within a horizon too, and with quantities of what comes after failing. A
    charge of the total cost that is none of these is refused by name, and a share with a discount.
    A deterministic policy (``method="deterministic"``) is proved among its like by a tree of at
    most some hundred cases, except at least failure, where lotteries do no better. At least failure
    the policy may be shown to fail more than the least by the last digits of the proof, unless
    these are exact or the goal is sure: that is told as a row exceeded. Where a policy exceeds a
    bound by the rounding of floats, the file asks with a bound that is so much looser, and says so.

    Args:
        solution: of ``solve``; its policy and its prices are what is proved to be best.
        path: of the file, which is gzip whatever it is called.
        tolerance: the file claims the solution's bound and objective but for this part of the
            objective (or of 1), and is refused where it does not prove as much.

    Returns:
        What the file proves: the checker's verdict on it.

    Raises:
        ModelError: a criterion that is not covered.
        SolverError: the answer is not proved: the policy breaks a row by more than rounding, or
            the proof leaves more open than the solution does, or contradicts it.
    """
    asked, solved = repr(solution.problem), as_solved(solution, "write_certificate")
    # at least failure no lottery does better than its members
    is_single = solution.run.deterministic and solved.problem.failure_budget is not None
    statement = Statement(
        _before_labelling(solved.problem), f"{asked}, not mixed" if is_single else asked,
        is_single, solved.problem.model.failure_label is not None,
    )  # fmt: skip
    try:
        try:
            checked, proved = _proved(statement, solved, tolerance)
        except checker.RefusedError:
            if not statement.excess:
                raise
            statement.asked += f", but for rounding of {', '.join(statement.excess)}"
            checked, proved = _proved(statement, solved, tolerance)
    except checker.RefusedError as error:
        raise SolverError(f"the answer is not proved: {error}") from error
    with open(path, "wb") as raw, gzip.GzipFile("", "wb", fileobj=raw, mtime=0) as file:
        file.write(b"\n".join(proved))
    return checked


def _proved(
    statement: Statement, solution: Solution, tolerance: float
) -> tuple[Checked, list[bytes]]:
    """What the best certificate file of a question proves, and its lines.

    Raises:
        RefusedError: none is accepted; the statement then says which bounds it exceeds by rounding.
    """
    lines = list(statement.lines())
    try:
        model = _Draft(lines)
        charge = solution.problem.semantics.charge(solution.problem.ratio)
        if isinstance(charge, _TABLES) and model.counts:
            statement.totals = _told_apart(model, charge)
            lines = list(statement.lines())
            model = _Draft(lines)
    except checker.RefusedError as error:
        raise ModelError(f"no certificate of {type(solution.problem).__name__}: {error}") from error
    head = {"sha256": sha256(b"\n".join(lines)).hexdigest(), "claim": _claim(solution, tolerance)}
    try:
        return _best_proof(lines, _proofs(model, solution, head), statement.is_single)
    finally:
        statement.excess = model.rounded


class _Draft(checker.Model):
    """A certificate's question and model, whose proof may be made before its inequalities hold."""

    def __init__(self, lines: Sequence[bytes]) -> None:
        super().__init__(json.loads(lines[0]), list(map(checker.read_state, lines[1:])))
        self.is_checked = True
        self.charged: dict[tuple[float, float], Solution] = {}  # of thresholds between two
        self.rounded: dict[str, Fraction] = {}  # of rows that are kept but for rounding, by so much
        self._stated = {
            str(row["name"]): abs(checker.number(row.get("at_most", row.get("at_least"))))
            for row in self.question["rows"]
        }

    def attain(
        self, weights: Sequence[Fraction], members: Sequence[Sequence[Fraction]]
    ) -> list[Fraction]:
        """Objective and rows of a lottery in a certificate; notes the rows that are rounded."""
        attained = super().attain(weights, members)
        beyond = zip(self.rows, attained[1:], strict=True)
        excess = {row.name: value - row.bound for row, value in beyond}
        most = {row.name: min(abs(row.bound), Fraction(1)) for row in self.rows}
        digits = {name: self._stated.get(name, Fraction(0)) * _ROUNDED_NUMBER for name in most}
        self.rounded = {
            name: more for name, more in excess.items()
            if most[name] * checker.EXCESS < more <= max(most[name] * _ROUNDED_ROW, digits[name])
            and (name != "failure" or self.share is None)
        }  # fmt: skip
        return attained

    def at_most(self, left: int, right: int, *words: object) -> None:
        """Refuse the certificate unless an inequality holds, or the proof is a draft."""
        if self.is_checked:
            super().at_most(left, right, *words)


def _best_proof(
    lines: Sequence[bytes], proofs: Iterable[Sequence[bytes]], is_single: bool
) -> tuple[Checked, list[bytes]]:
    """What the best of some certificate files proves, and its lines: the first that is exact.

    Of a policy that must not be mixed the first one that is accepted, as trees take their time.

    Raises:
        RefusedError: the first is refused, and no other is better.
    """
    best, refused = list[tuple[Checked, list[bytes]]](), list[checker.RefusedError]()
    for proof in proofs:
        try:
            checked = checker.check_lines([*lines, *proof])
        except checker.RefusedError as error:
            refused.append(error)
            continue
        best.append((checked, [*lines, *proof]))
        if is_single or (checked.lower == checked.upper and not checked.exceeded):
            break
    if not best:
        raise refused[0]
    return min(best, key=lambda one: (one[0].upper - one[0].lower, len(one[0].exceeded)))


def _before_labelling(problem: Problem) -> Problem:
    """The problem of a certificate file on the model without the label of failing."""
    if (label := problem.model.failure_label) is None:
        return problem
    start = {state: p for (state, _), p in cast("Mapping[Any, float]", problem.start).items()}
    on_it: dict[str, Any] = {"model": label.original, "start": start, **as_stated(problem)}
    return cast("Problem", replace(cast("Any", problem), **on_it))


def _claim(solution: Solution, tolerance: float) -> list[str]:
    """What a certificate file claims of the optimum: at least, and at most."""
    room = tolerance * max(1.0, abs(solution.objective))
    ends = solution.lower_bound - room, solution.objective + room
    if solution.upper_bound is not None:
        ends = solution.objective - room, solution.upper_bound + room
    return [_decimal_of(min(max(end, -_ENDLESS), _ENDLESS)) for end in ends]


def _line(content: Mapping[str, Any]) -> bytes:
    """A line of a certificate file."""
    return json.dumps(content, separators=(",", ":")).encode()


@lru_cache(1 << 14)
def _decimal_of(value: float) -> str:
    """Shortest decimal of a float, for a certificate file."""
    return repr(value).removesuffix(".0")


def _check_covered(problem: Problem) -> None:
    """Refuse criteria whose proofs no certificate file can hold.

    Raises:
        ModelError: the criterion, and what of it is not covered.
    """
    asks, name = problem.requirements, type(problem).__name__
    if problem.discount is not None and problem.reach_fraction is not None:
        shares = Argument("reach_fraction"), " and ", Argument("discount")
        raise ModelError(f"no certificate of {name} with ", *shares)
    charge = problem.semantics.charge(problem.ratio)
    if asks.counts_totals and not isinstance(charge, (TotalCostCharge, WithinBound, *_TABLES)):
        raise ModelError(f"no certificate of {name}: its charge of the total cost, a "
                         f"{type(charge).__name__}, is none that certificates know")  # fmt: skip


@dataclass
class Statement:
    """The question and the model, line by line. Sets and costs are gathered while it is made."""

    problem: Problem
    asked: str
    is_single: bool = False  # whether policies must not be mixed
    goes_on: bool = False  # whether something counts after failing
    costs: list[tuple[FloatArray, Mapping[float, Fraction]]] = field(default_factory=list)
    sets: dict[str, BoolArray] = field(default_factory=dict)
    totals: Sequence[Fraction] = ()  # that a charge is told of one by one
    excess: Mapping[str, Fraction] = field(default_factory=dict)  # of a bound that was rounded

    def lines(self) -> Iterator[bytes]:
        """Lines of a certificate file for the question and each state."""
        model = self.problem.model
        _check_covered(self.problem)
        self.costs, self.sets = [(model.costs, model.exact_costs)], {}
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
                moves = [list(pair) for pair in zip(chances[some], successors[some], strict=True)]
                paid = [t[some] if len(set(t[some])) > 1 else t[some][0] for t in texts]
                actions.append([str(model.action_of(k)), moves, paid])
            sets = [name for name, mask in self.sets.items() if mask[x]]
            sets = ["goal", *sets] if goal[x] else sets
            yield _line({"name": str(model.states[x]), "sets": sets, "actions": actions})

    def _question(self) -> dict[str, Any]:
        """The question of a certificate file, in the checker's terms."""
        problem, semantics = self.problem, self.problem.semantics
        objective, to_goal = problem.objective_condition, [["1", "end", "goal"]]
        charge = semantics.charge(problem.ratio) if objective is None else None
        penalty = 0.0 if semantics.forbids_failing else semantics.penalty
        least: dict[str, Any] = {"constant": _decimal_of(penalty), "terms": [["1", "cost", 0]]}
        if penalty > 0.0:
            least["terms"] += [[f"-{_decimal_of(penalty)}", "end", "goal"]]
        if objective is not None:
            least = self._quantity(objective, problem.quantity)
        elif charge is not None:
            worth = semantics.failing_worth if semantics.maximises else 0.0
            least = {"constant": _decimal_of(worth), "terms": []}
        elif semantics.aim is not Aim.LEAST_COST:
            least = {"constant": "0", "terms": to_goal}
        rows = []
        stated = {**problem.own_constraints, **problem.constraints}
        for condition in problem.conditions:
            quantity = getattr(stated.get(condition.name), "quantity", None)
            row = {"quantity": self._quantity(condition, quantity)}
            for upper in condition.rows:
                side = "at_most" if upper.sign > 0.0 else "at_least"
                bound = condition.upper if upper.sign > 0.0 else condition.lower
                rows.append(
                    {"name": upper.name, **row, side: self._bound(upper.name, bound, upper.sign)}
                )
        start = problem.start if isinstance(problem.start, Mapping) else {problem.start: 1.0}
        begins = [[_text_of(p), problem.model.index_of(x)] for x, p in start.items()]
        return {
            "format": checker.FORMAT,
            "asked": self.asked,
            "states": problem.model.n_states,
            "costs": len(self.costs),
            "sets": list(self.sets),
            "start": begins,
            "give_up": str(GiveUp.ATTENTION if charge and self.goes_on else semantics.give_up),
            "charge_failing_step": bool(semantics.charge_failing_step),
            "greatest": objective is None
            and (semantics.aim is Aim.GREATEST_GOAL or semantics.maximises),
            "objective": least,
            "failure": self._failure(),
            "discount": None if problem.discount is None else _decimal_of(problem.discount),
            "rows": rows,
            **({"ratio": True} if problem.ratio else {}),
            **({"deterministic": True} if self.is_single else {}),
            **({"after_failing": True} if self.goes_on else {}),
            **({} if charge is None else self._totals(charge)),
        }

    def _totals(self, charge: Charge) -> dict[str, Any]:
        """What is asked of totals in a certificate file."""
        risk = self.problem.semantics.risk
        if risk is not None:
            key = "tail_mean" if isinstance(risk, TailMeanOf) else "quantile"
            return {key: _decimal_of(risk.level)}
        is_table = isinstance(charge, _TABLES) and len(self.totals) > 0
        told = charge if is_table or not isinstance(charge, _TABLES) else TOTAL_COST
        return {"charge": _charge_steps(told, self.totals)}

    def _failure(self) -> Any:
        """Allowed failure in a certificate file's question."""
        problem, share = self.problem, self.problem.reach_fraction
        if problem.semantics.forbids_failing:
            return "0"
        if share is not None:
            return {"share": _decimal_of(float(share))}
        budget = problem.failure_budget
        if budget is None:
            return "least"
        return None if budget >= 1.0 else self._bound("failure", max(float(budget), 0.0), 1.0)

    def _bound(self, name: str, bound: float | None, sign: float) -> str:
        """A row's bound in a certificate file, beyond which that of the solution is not rounded."""
        text = _decimal_of(float(bound or 0.0))
        if not (excess := self.excess.get(name)):
            return text
        place = len(str(excess.denominator // excess.numerator))  # of the excess's first digit
        side = 1 if sign > 0.0 else -1
        least = math.floor((side * Fraction(text) + excess) * 10**place) + 1
        return f"{Decimal(side * least).scaleb(-place):f}"

    def _quantity(self, condition: Condition, stated: Any) -> dict[str, Any]:
        """A quantity of the model, looked up, in a certificate file."""
        terms: list[list[Any]] = []
        constant = Fraction(_decimal_of(condition.constant if stated is None else stated.constant))
        for weight, term in condition.terms:
            text, less = _decimal_of(weight), _decimal_of(-weight)
            further = " through" if term.through and self.goes_on else ""
            if isinstance(term, StepTerm):
                terms.append([text, f"cost{further}", self._cost(term.model)])
            elif term.others:
                constant += Fraction(text)
                terms.append([less, "end", self._set(term.states)])
            else:
                kind = "end" if term.final else f"visits{further}"
                terms.append([text, kind, self._set(term.states)])
        return {"constant": str(constant), "terms": terms}

    def _cost(self, model: SSP) -> int:
        """Position of a cost among those in the certificate file."""
        for number, (costs, exact) in enumerate(self.costs):
            if exact == model.exact_costs and np.array_equal(costs, model.costs):
                return number
        self.costs.append((model.costs, model.exact_costs))
        return len(self.costs) - 1

    def _set(self, mask: BoolArray) -> str:
        """Name of a set of states in a certificate file: the goal, a label, or a number."""
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


def _charge_steps(charge: Charge, totals: Sequence[Fraction]) -> list[list[str]]:
    """A charge of totals in a certificate file: after which total, its least, greatest, slope.

    Args:
        charge: of the problem; where much is better it is less than nothing.
        totals: that can occur at the goal, where they have to be told apart; the last is a cap.
    """
    if isinstance(charge, WithinBound):
        return [["-1", "1", "1", "0"], [_text_of(charge.bound), "0", "0", "0"]]
    if isinstance(charge, TotalCostCharge):
        return [["0", "0", "0", "1"]]
    sign = -1.0 if charge.lowest < 0.0 else 1.0
    values = (sign * charge.at(np.array([float(t) for t in totals]))).tolist()
    room = _ROUNDED if isinstance(charge, ExponentialUtility) else 0.0
    steps, last = list[list[str]](), "-1"
    for total, value in zip(totals, values, strict=True):
        ends = [_decimal_of(value * (1.0 + side * room)) for side in (-1.0, 1.0)]
        steps.append([last, *ends, "0"])
        last = str(total)
    if isinstance(charge, ExpectedArrivalCost):
        value = _decimal_of(float(charge.at(np.array([charge.affine_from]))[0]))
        return [*steps, [_decimal_of(charge.affine_from), value, value, _decimal_of(charge.slope)]]
    return [*steps, [last, _decimal_of(sign * charge.offset), steps[-1][2], "0"]]


def _told_apart(model: checker.Model, charge: Charge) -> list[Fraction]:
    """Totals at the goal that a certificate file's charge is told of, one by one."""
    most = Fraction(1)
    worth = -float(charge.at(np.zeros(1))[0]) + charge.offset
    while isinstance(charge, Reward) and most < _FARTHEST:  # until a utility is used up
        left = -float(charge.at(np.array([float(most)]))[0]) + charge.offset
        if left <= _USED_UP * worth:
            break
        most *= 2
    if isinstance(charge, ExpectedArrivalCost):
        most = Fraction(charge.affine_from)
    return _goal_totals(model, most)


def _goal_totals(model: checker.Model, most: Fraction) -> list[Fraction]:
    """Totals at which the goal of a certificate's model can be reached, 0, and none beyond some."""
    cap = Fraction(math.ceil(most * model.unit) + 1, model.unit)
    nodes, goal = _nodes_below(model, cap), model.sets["goal"]
    lasts = [{t for k in model.of[x] for _, y, t in model.pairs[k][2] if y in goal}
             for x in range(len(model.names))]  # fmt: skip
    ends = {total + Fraction(t, model.unit) for x, total in nodes for t in lasts[x]}
    return sorted(t for t in ends | {Fraction(0)} if t <= most)


def _text_of(value: Any) -> str:
    """A number as a text of a certificate file: a fraction, else the shortest decimal."""
    return str(value) if isinstance(value, (int, Fraction)) else _decimal_of(float(value))


def _proofs(model: _Draft, solution: Solution, head: dict[str, Any]) -> Iterator[list[bytes]]:
    """Lines of a certificate file's proof, its head and a line a node: in decimals, then exact."""
    if not model.counts:
        model.spread({}, [])
        yield _proof_at(model, solution, solution, {**head})[1]
        yield from _exact_proofs(model, solution, solution, head, [])
        return
    dual, risk = solution, solution.problem.semantics.risk
    if risk is not None:  # a quantile is a total that occurs
        is_mean, near = isinstance(risk, TailMeanOf), solution.objective
        if is_mean:
            near = success_costs(solution.policy, solution.problem).quantile(risk.level)
        totals = _goal_totals(model, Fraction(_text_of(near)) + Fraction(1, 10**6))
        at = str(min(totals, key=lambda total: abs(total - Fraction(_text_of(near)))))
        head |= {"threshold": at} if is_mean else {"claim": [at, at]}
        # below a quantile too much is late, which is a problem of its own
        dual = solution if is_mean else _late_from(solution)
    cap, lines, last, failed = _first_cap(model, solution), list[bytes](), np.inf, 0
    for _ in range(_CAPS):
        nodes = _nodes_below(model, cap)
        model.spread({**head, "cap": str(cap)}, nodes)
        width, more, is_cut = _proof_at(model, solution, dual, {**head})
        failed += width >= 0.9 * last
        if width < last:
            lines, last, told = more, width, ({**head, "cap": str(cap)}, nodes)
        is_narrow = last <= (_WIDTH if len(nodes) < _MANY else _WIDER)
        if is_narrow or failed > 1 or is_cut or len(nodes) > _MOST_NODES // 2:
            break
        cap = cap * 2
    yield lines
    yield from _exact_proofs(model, solution, dual, *told)


def _exact_proofs(
    model: _Draft,
    solution: Solution,
    dual: Solution,
    head: dict[str, Any],
    nodes: Sequence[tuple[int, Fraction]],
) -> Iterator[list[bytes]]:
    """Proofs in a unit that all their numbers are multiples of, where nodes are few.

    Their policies' equations have a solution in fractions. Its digits are computed, as many as it
    takes to tell the fractions by: those of least denominators that are as near.
    """
    uncertain = any(step[1] != step[2] for step in model.question.get("charge", []))
    if len(model.nodes) > _FEW or uncertain:
        return
    for digits in _DIGITS:
        try:
            model.spread({**head, "one": str(10**digits)}, nodes)
            model.is_checked = False
            draft = _proof_at(model, solution, dual, {**head})[1]
            one, model.is_checked = _common_unit(model, draft, digits), True
            if one is None:
                continue
            model.spread({**head, "one": str(one)}, nodes)
            proof = _proof_at(model, solution, dual, {**head, "one": str(one)})[1]
        except (checker.RefusedError, SolverError):
            continue  # of more digits there may be other fractions; decimals there are
        yield proof


def _common_unit(model: checker.Model, proof: Sequence[bytes], digits: int) -> int | None:
    """Units in 1 of which all numbers of a certificate's proof are multiples; None: not told."""
    head, *lines = map(json.loads, proof)
    known = ("w", "slope") if model.is_single else ("v", "w", "slope")  # of cases v is rounded
    told = [line.get(key, []) for line in lines for key in known]
    told += [one[2:] for line in lines for one in line["members"] if one]  # but for the steps
    stated = [] if model.is_single else [head.get("prices", []), head.get("cases", [])]
    prices = {*_numbers_in(stated)}
    near, one = 10 ** (digits // 2 - 10), checker.ONE  # of steps some digits
    for number in {*_numbers_in(told)}:
        one = math.lcm(one, number.limit_denominator(near).denominator)
        if one.bit_length() > _LONGEST:
            return None
    priced = math.lcm(*(price.limit_denominator(near).denominator for price in prices))
    return priced * math.lcm(
        one, *(q.arrival(x).denominator for q in model.each for x in range(len(model.names)))
    )


def _numbers_in(content: Any) -> Iterator[Fraction]:
    """Numbers that texts within some content of a certificate file stand for."""
    if isinstance(content, str) and checker.NUMBER.fullmatch(content):
        yield checker.number(content)
    elif isinstance(content, (list, dict)):
        for part in content.values() if isinstance(content, dict) else content:
            yield from _numbers_in(part)


def _proof_at(
    model: _Draft, solution: Solution, dual: Solution, head: dict[str, Any]
) -> tuple[float, list[bytes], bool]:
    """Relative width of what some nodes prove, a certificate's lines, and whether cases lack."""
    weights, n = solution.policy.weights, len(model.names)
    ssp: Graph = solution.problem.model if not model.shift else graph_of(model)
    drawn = zip(solution.policy.policies, weights.tolist(), strict=True)
    members = [decisions(model, policy) for policy, weight in drawn if weight > 0.0]
    w = [0] * n
    if model.share is not None:  # a member of weight 0 shows how likely the goal can be
        failure = checker.Quantity(model, checker.FAILURE, 1, "w")
        failure.free = model.attention
        w, likely = values_below(model, ssp, failure, members, below=False)
        pairs = [likely.get(x, UNDECIDED) for x in range(n)]
        members.append(reached(model, lambda x, r: pairs[x]))
    vectors = [member_vectors(model, decided) for decided in members]
    totals = [model.above(entries, f"member {m}") for m, entries in enumerate(vectors)]
    if model.share is not None:
        model.set_share(w, totals)
    slope = [0] * n
    if model.counts:
        model.slopes.charge = lambda r: model.down(model.rise)
        rising, _ = values_below(model, ssp, model.slopes, members, below=False)
        slope = [max(one, 0) for one in rising]
    chosen = lottery_weights(model, weights[weights > 0.0], totals)
    upper, *taken = model.attain(chosen, totals)
    if model.ratio:
        upper /= max(1 - taken[0], Fraction(1, model.one))
    weighed = [] if "quantile" in model.question else totals[: int((weights > 0.0).sum())]
    is_cut = False
    if "tail_mean" in model.question:
        head["cases"], values, bound = _cases_of_thresholds(
            model, ssp, dual, members, weighed, Fraction(head["threshold"]), slope, upper
        )
    elif model.is_single:
        past = slope if any(slope) else []
        found = cases_of_decisions(model, ssp, members, past, upper)
        head["cases"], values, bound, is_cut = found
    else:
        is_attained = "quantile" not in model.question
        enough = upper - _LESS * max(abs(upper), Fraction(1)) if is_attained else math.inf
        asked = members, weighed, slope, enough
        case, v, bound = _priced_values(model, ssp, model.low, dual, *asked)
        head["prices"], values = [str(price) for price in case.prices], [v]
    head["weights"] = [str(weight) for weight in chosen]
    lines = _proof_lines(model, head, values, vectors, slope, w)
    return abs(float(upper - bound)) / max(1.0, abs(float(upper))), lines, is_cut


def _proof_lines(
    model: checker.Model,
    head: dict[str, Any],
    values: Sequence[Sequence[int]],
    vectors: Sequence[Mapping[int, list[Any]]],
    slope: Sequence[int],
    w: Sequence[int],
) -> list[bytes]:
    """A certificate file's proof: its head, and a line for each state and each node.

    Args:
        model: the question and the model, its nodes spread.
        head: with prices or cases, and weights.
        values: of each case, [nodes].
        vectors: of each member, by node.
        slope: of the values in the total, [states].
        w: what bounds failing from below, where a share is asked, [states].
    """
    n = len(model.names)
    if model.counts:
        head |= {"cap": str(Fraction(model.cap, model.unit)), "nodes": len(model.nodes) - n}
    lines = [_line(head)]
    own = [x for x in range(n) if (x + 1) % (model.shift or n)]  # but not what a discount takes
    for i in [*own, *range(n, len(model.nodes))]:
        line: dict[str, Any] = {}
        if i >= n:
            x, total = model.nodes[i]
            line = {"state": x, "total": str(Fraction(total, model.unit))}
        texts = [text_of(v[i], model.one) for v in values]
        line |= {"v": texts if "cases" in head else texts[0]}
        line |= {"members": [entries.get(i) for entries in vectors]}
        if model.counts and i < n:
            line["slope"] = text_of(slope[i], model.one)
        if model.share is not None and i < n:
            line["w"] = text_of(w[i], model.one)
        lines.append(_line(line))
    return lines


@dataclass(frozen=True, eq=False)
class _Arriving(Formulation):
    """Least cost of arriving given success: the problem whose prices a proof of risks takes."""

    model: SSP
    start: Any
    charge: ExpectedArrivalCost
    failure_budget: float | None = 1.0

    ratio = True

    @cached_property
    def semantics(self) -> FailureSemantics:
        """Semantics of what arriving costs in a certificate file's proof of risks."""
        return FailureSemantics(measure=self.charge)


def _charging(solution: Solution, charge: ExpectedArrivalCost) -> Solution:
    """Solution of a certificate's problem with another cost of arriving."""
    problem = solution.problem
    limits = problem.constraints
    asked = (problem.model, problem.start, charge, problem.failure_budget)
    return solve(_Arriving(*asked, constraints=limits))


def _late_from(solution: Solution) -> Solution:
    """Solution of the problem whose proof a certificate's quantile takes: least from it on."""
    first = solution.objective * (1.0 - SAME_TOTAL)
    late = ExpectedArrivalCost(
        lambda total: (total >= first).astype(np.float64), solution.objective
    )
    return _charging(solution, late)


def _cases_of_thresholds(
    model: _Draft,
    ssp: Graph,
    solution: Solution,
    members: Sequence[Mapping[int, int]],
    weighed: Sequence[Sequence[Fraction]],
    threshold: Fraction,
    slope: Sequence[int],
    upper: Fraction,
) -> tuple[list[Any], list[list[int]], Fraction]:
    """Cases of a certificate's tail mean: intervals of thresholds, halved until they prove it.

    Args:
        model: the question and the model, its nodes spread.
        ssp: the same model, for its graph.
        solution: of the problem.
        members: of its lottery, decisions by node.
        weighed: what each of them takes, the objective that of a threshold.
        threshold: this.
        slope: of the values in the total, from the cap on.
        upper: what the lottery attains, beyond which no threshold is looked at.

    Returns:
        The cases as the file states them, the values of each, and what they prove.
    """
    share = 1.0 - cast("TailMeanOf", solution.problem.semantics.risk).level
    totals = [total for total in _goal_totals(model, upper) if total < upper] or [Fraction(0)]
    room = _LEAST_ROOM if model.one == checker.ONE else 0
    enough, proved = upper * (1 - room), list[tuple[Fraction, checker.Case, list[int]]]()
    ahead, least = [(0, len(totals))], list[Fraction]()
    while ahead:
        first, last = ahead.pop()
        a, b = float(totals[first]), float(totals[last - 1])
        charge = ExpectedArrivalCost(ExcessCharge(b, share, a).at, b)
        low = model.ladder(model.excess(totals[first], totals[last - 1]), 1)
        if (a, b) not in model.charged:
            model.charged[a, b] = _charging(solution, charge)
        dual = model.charged[a, b]
        own = weighed if totals[first] == totals[last - 1] == threshold else []
        case, v, bound = _priced_values(model, ssp, low, dual, members, own, slope, enough)
        if bound < enough and last - first > 1:
            middle = (first + last) // 2
            ahead += [(middle, last), (first, middle)]
            continue
        least.append(bound)
        proved.append((totals[last - 1], case, v))
    stated = [
        [str(end), {"prices": [str(price) for price in case.prices]}] for end, case, _ in proved
    ]
    return stated, [v for _, _, v in proved], min([*least, upper])


def _first_cap(model: checker.Model, solution: Solution) -> Fraction:
    """Total from which on a certificate's proof tells none apart, at first."""
    longest = max((t for pair in model.pairs for _, _, t in pair[2]), default=0)
    breaks = [checker.number(step[0]) for step in model.question.get("charge", [])]
    if solution.problem.semantics.risk is not None:
        breaks = [Fraction(_text_of(solution.objective))]
    cap = max(Fraction(2 * longest, model.unit), max(breaks) + 1)
    if isinstance(solution.problem.semantics.charge(model.ratio), TotalCostCharge):
        cap = max(cap, 2 * Fraction(_decimal_of(solution.objective)))
    for policy in solution.policy.policies:
        if isinstance(policy, CostAwarePolicy):
            last = policy.cap * policy.unit if policy.levels is None else policy.levels[-1]
            cap = max(cap, Fraction(last))
    return Fraction(math.ceil(cap * model.unit), model.unit)


def _nodes_below(model: checker.Model, cap: Fraction) -> list[tuple[int, Fraction]]:
    """Nodes of a certificate's proof: states with the totals below a cap at which they are met.

    Raises:
        ModelError: they are too many.
    """
    unit = model.unit
    steps = [
        sorted({(y, t) for k in model.of[x] if model.keeps[k] for _, y, t in model.pairs[k][2]
                if y in model.live - model.still})
        for x in range(len(model.names))
    ]  # fmt: skip
    met: dict[int, set[int]] = {0: {x for _, x in model.start if x in model.live - model.still}}
    last, ahead, count = int(cap * unit), [0], 0
    nodes = list[tuple[int, Fraction]]()
    while ahead:
        r = heappop(ahead)
        states, stack = met[r], list(met[r])
        while stack:
            for y, t in steps[stack.pop()]:
                if r + t < last:
                    if (there := met.get(r + t)) is None:
                        there = met[r + t] = set()
                        heappush(ahead, r + t)
                    if y not in there:
                        there.add(y)
                        if t == 0:
                            stack.append(y)
        count += len(states)
        if count > _MOST_NODES:
            raise ModelError(f"no certificate: more than {_MOST_NODES:,} states with totals")
        total = Fraction(r, unit)
        nodes += [(x, total) for x in sorted(met.pop(r))]
    return nodes


def _priced_values(
    model: checker.Model,
    ssp: Graph,
    low: checker.Charge | None,
    solution: Solution,
    members: Sequence[Mapping[int, int]],
    weighed: Sequence[Sequence[Fraction]],
    slope: Sequence[int],
    enough: Fraction | float = math.inf,
) -> tuple[checker.Case, list[int], Fraction]:
    """Prices of the rows, values that bound all policies, in units of a file, and that bound."""
    prices, at = _first_prices(model, solution, weighed)
    best: tuple[Fraction, checker.Case, list[int]] | None = None
    less, past = _LESS, slope if any(slope) else []
    for _ in range(_RAISES):
        case = checker.Case(list(prices), low, {})
        v, bound = case_values(model, ssp, case, members, past)
        if model.ratio and bound < 0 and model.rows[0].paid == 1:
            # no policy goes below a somewhat smaller ratio; of few digits, which are exact
            prices[0] = Fraction(math.floor(prices[0] * (1 - less) * 10**20), 10**20)
            prices = prices if less < _SMALLER else [Fraction(0)] * len(prices)
            less *= 100
            continue
        if model.ratio:
            bound = model.given_success(bound, prices[0])
        if best is not None and bound <= best[0] + (_LESS * abs(best[0]) if model.counts else 0):
            break
        best = bound, case, v
        if at is None or bound >= enough:
            break
        scale = abs(Fraction(_decimal_of(solution.objective)))
        prices[at] = max(8 * prices[at], scale, Fraction(1, 1000))
    if best is None:
        raise SolverError("no price was tried")
    return best[1], best[2], best[0]


def _first_prices(
    model: checker.Model, solution: Solution, weighed: Sequence[Sequence[Fraction]]
) -> tuple[list[Fraction], int | None]:
    """Prices of a certificate's rows to begin with, and the row whose price may be raised.

    Args:
        model: the question and the model.
        solution: whose prices they are but for rounding.
        weighed: what each member of its lottery takes; empty: of those of another problem.
    """
    given = [max(solution.prices.get(row.name, 0.0), 0.0) for row in model.rows]
    prices, ratio = [Fraction(_decimal_of(price)) for price in given], Fraction(0)
    at: int | None = None
    some = [j for j, price in enumerate(given) if price > 0.0 and (j > 0 or model.may_fail)]
    if not model.may_fail:
        prices[0] = Fraction(0)  # only what keeps the goal sure counts
    elif model.question["failure"] is not None and solution.failure_price is None:
        at = 0  # the budget was met by failing as little as possible, which has no price
    elif model.counts and len(weighed) == 1 and model.rows and _is_met(model, weighed[0]):
        at = 0  # a budget that only one policy keeps to: any price that is high enough
    if at is None and weighed:  # at the right prices all members are worth the same
        first, *others = weighed
        table = [[t[1 + j] - first[1 + j] for j in some] for t in others]
        right = [first[0] - t[0] for t in others]
        if model.ratio:  # and their cost is the ratio times their goal probability
            beyond = [[model.rows[j].bound - t[1 + j] for j in some] for t in weighed]
            table = [[1 - t[1], *row] for t, row in zip(weighed, beyond, strict=True)]
            right = [t[0] for t in weighed]
        exact = exact_solution(table, right)
        if exact and model.ratio:
            ratio, *exact = exact
        if exact and all(
            abs(e - prices[j]) <= _MOVED * prices[j] for e, j in zip(exact, some, strict=True)
        ):
            for e, j in zip(exact, some, strict=True):
                prices[j] = e
    if model.ratio and model.may_fail:  # failing goes without the ratio besides
        ratio = ratio or Fraction(_decimal_of(solution.objective))
        prices[0] += ratio
    return [Fraction(model.down(price), model.one) for price in prices], at


def _is_met(model: checker.Model, total: Sequence[Fraction]) -> bool:
    """Whether the only member of a certificate's lottery uses the budget up, but for rounding."""
    row = model.rows[0]
    return row.name == "failure" and row.bound < 1 and total[1] >= row.bound - NEARLY_MET
