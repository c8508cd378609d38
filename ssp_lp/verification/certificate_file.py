"""Certificate files: a problem's question and model, exactly, and a proof of its optimum.

``certificate_lines.py``, with ``expand.py`` and ``prove.py``, checks a file and prints the question
and the result. These scripts share nothing with the library, so this module need not be trusted. In
a file, a float is written as its shortest decimal, and a cost that was given as a fraction as this
fraction.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property, lru_cache
from hashlib import sha256
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import Any, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import (
    Charge,
    ExpectedArrivalCost,
    Reward,
    TailMeanOf,
    TotalCostCharge,
    WithinBound,
)
from ssp_lp.arrays import LEAST_BUDGET, BoolArray, FloatArray, IntArray
from ssp_lp.errors import Argument, ModelError, SolverError
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.implicit import ExploredSSP
from ssp_lp.model.product import LATE, HorizonSSP
from ssp_lp.model.tracked_product import check_not_rounded
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import UNDECIDED, Policy
from ssp_lp.problem import Problem, as_stated, check_problem
from ssp_lp.processes.conditions import Condition, StepTerm
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.solution import Solution, as_solved
from ssp_lp.verification import certificate_lines as reading
from ssp_lp.verification.certificate_lines import NOTHING
from ssp_lp.verification.exact_proof import Decide, Nodes, line_of, proof_of
from ssp_lp.verification.expand import Program, State
from ssp_lp.verification.prove import Bounds, RefusedError, number

_CAPS, _NARROW = 12, 1e-10  # number of caps to try, and the relative width that ends the trials
_MOST_NODES = 2_000_000
_AIM = 1e-12  # relative width for which a cap is chosen by the rate of the earlier ones
_STEEP = 1000.0  # price of failing with least failure, times 1 + |objective|
_FARTHEST, _USED_UP = 10**6, 1e-11  # total, and share left of a utility, at which its steps end
_TOTAL = [[">=", "0", "0", "1"]]
_NO_FILE = "a certificate file cannot be written for"
_IN_MEMORY = "; certify(solution) proves the optimum in memory"


@dataclass(frozen=True)
class Checked:
    """Result of checking a certificate: an interval that contains the optimum, or a refusal."""

    accepted: bool
    reason: str = ""  # reason for a refusal: the inequality that fails, and where
    lower: Fraction = Fraction(0)
    upper: Fraction = Fraction(0)  # objective of the lottery
    exceeded: Mapping[str, Fraction] = field(default_factory=dict)  # row -> the lottery's excess
    asked: str = ""  # the question in the file, in words
    digest: str = ""  # SHA-256 of the question and the model
    programs: tuple[str, ...] = ()  # SHA-256 of the text of each program

    def __str__(self) -> str:
        """Return the verdict in a few lines."""
        if not self.accepted:
            return f"refused: {self.reason}"
        lines = [f"accepted: {self.asked}", f"  SHA-256   {self.digest}"]
        for name, bound, side in (("at least", self.lower, 1), ("at most", self.upper, -1)):
            near = side * math.floor(side * bound * 10**25)  # rounded so that it holds
            digits = f"{abs(near):026d}"
            sign = "-" if near < 0 else ""
            lines.append(f"  {name:<9} {sign}{digits[:-25]}.{digits[-25:]}")
        lines.append(f"  width     {float(self.upper - self.lower):.1e}")
        lines += [f"  the lottery exceeds row {name!a} by {float(excess):.1e}"
                  for name, excess in self.exceeded.items()]  # fmt: skip
        return "\n".join(lines)


@explained
def check_certificate(path: str | Path, *, problem: Problem | None = None) -> Checked:
    """Check the certificate in a file, which proves an interval that contains the optimum.

    Args:
        path: path of the file.
        problem: the problem that the file must answer, with your own model; a file for another
            problem is refused. None: every problem is accepted, and the verdict states the file's
            question in words.

    Returns:
        The verdict. If it is not ``accepted``, it names the inequality that fails, and where.
    """
    if not isinstance(path, (str, PathLike)):
        how = "is not a path of a file: write one by ssp_lp.write_certificate(solution, path)"
        return Checked(False, f"{type(path).__name__} {how}")
    expected = None if problem is None else sha256_of(problem)
    try:
        return _checked(reading.lines_of(path), expected)
    except RefusedError as error:
        reason = str(error)
    except gzip.BadGzipFile:
        reason = "this is not a certificate: ssp_lp.write_certificate writes one"
    except Exception as error:  # damaged files may raise any error
        if isinstance(error, OSError) and error.errno:  # there is no such file
            raise
        reason = f"the file is damaged: {type(error).__name__}: {ascii(str(error))[:200]}"
    return Checked(False, reason)


def _checked(lines: reading.Lines, expected: str | None = None) -> Checked:
    """Check the lines of a certificate and return the verdict; raise an error if they are refused.

    Args:
        lines: function that returns an iterator over all lines of the file.
        expected: SHA-256 that the question and the model must have; None: any.
    """
    bounds, question, digests = reading.check(lines, expected)
    names = {}
    states = islice(lines(), 1, 1 + question["states"])
    begin = {x for _, x in question["start"]}
    for x, line in enumerate(states):
        if x in begin:
            names[x] = reading.read(line, name=str, sets=list, actions=list)["name"]
    asked = in_words(question, names)
    return Checked(True, "", *bounds, asked, digests[0], tuple(digests[1:]))


def in_words(question: Mapping[str, Any], names: Mapping[int, str]) -> str:
    """Return a checked question as a sentence, with its own names.

    Args:
        question: question of a certificate.
        names: names of the start states, by number.
    """

    def quantity(stated: Mapping[str, Any]) -> str:
        words = [f"{weight} {kind} {what!a}" for weight, kind, what in stated["terms"]]
        constant = stated["constant"]
        return " + ".join([*words, *([constant] if constant != "0" or not words else [])])

    sought, charge = quantity(question["objective"]), question["charge"]
    if question["quantile"] is not None:
        sought = f"{question['quantile']}-quantile of the total of cost 0"
    elif charge:
        total = f"{'total' if charge == _TOTAL else f'charge {charge} of the total'} of cost 0"
        sought = total if question["objective"] == NOTHING else f"{sought} + {total}"
    start = ", ".join(f"{names[x]!a} ({p})" for p, x in question["start"])
    most = "greatest" if question["greatest"] else "least"
    parts = [f"{most} {sought}{' given the goal' * question['ratio']}", f"from {start}"]
    for key in ("failure", "discount", "horizon", "give_up"):
        value = question[key]
        value = f"of a share {value['share']} of the goal" if isinstance(value, dict) else value
        parts += [] if value is None else [f"{key} {value}"]
    parts += ["the failing step charged"] * question["charge_failing_step"]
    for row in question["rows"]:
        side = "at_most" if "at_most" in row else "at_least"
        limit = f"{side.replace('_', ' ')} {row[side]}"
        parts.append(f"{row['name']!a}: {quantity(row['quantity'])} {limit}")
    return "; ".join(parts)


@explained
def sha256_of(problem: Problem) -> str:
    """Return the SHA-256 of a problem's question and model, which identifies it in certificates.

    Raises:
        ModelError: certificate files do not cover the question.
    """
    check_problem(problem, "sha256_of")
    return sha256(b"".join(Statement(problem).lines())).hexdigest()


def _refused(problem: Problem, why: str) -> ModelError:
    """Return the ModelError for a problem whose question certificate files do not cover."""
    return ModelError(f"{_NO_FILE} {type(problem).__name__}: {why}")


class Statement:
    """A problem's question and model in the format of certificate files.

    The model has no copies of states for different times: a horizon is a field of the question.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem = problem.tracked
        semantics = problem.semantics
        charge = semantics.charge(problem.ratio)
        if isinstance(semantics.risk, TailMeanOf):
            raise _refused(problem, f"the question asks for a tail mean{_IN_MEMORY}")
        if problem.unrolled.model.failure_label is not None:
            raise _refused(problem, f"the question counts quantities after failing{_IN_MEMORY}")
        if problem.discount is not None and problem.reach_fraction is not None:
            both = Argument("reach_fraction"), " and ", Argument("discount")
            raise ModelError(f"{_NO_FILE} {type(problem).__name__} with ", *both)
        known = TotalCostCharge, Reward, ExpectedArrivalCost
        if charge is not None and not isinstance(charge, known):
            raise _refused(problem, f"charge {type(charge).__name__} is not supported{_IN_MEMORY}")
        self.flat, self.charge = problem, charge
        if problem.horizon is not None:
            labels = {**problem.model.state_labels, LATE: np.zeros(0, dtype=np.int64)}
            model = replace(problem.model, state_labels=labels)
            on_it: dict[str, Any] = {"model": model, "horizon": None, **as_stated(problem)}
            self.flat = cast("Problem", replace(cast("Any", problem), **on_it))
        model = self.flat.model
        self.costs: list[tuple[FloatArray, Mapping[float, Fraction]]] = []
        self._cost(model)
        self.sets: dict[str, BoolArray] = {}
        self.question = self._question()
        if charge is not None and semantics.risk is None and not self.flat.objective_condition:
            self.question["charge"] = self._steps(charge)

    @cached_property
    def states(self) -> list[bytes]:
        """The lines of the model, one for each state."""
        model = self.flat.model
        texts = [[str(exact[c]) if c in exact else text_of(c) for c in costs.tolist()]
                 for costs, exact in self.costs]  # fmt: skip
        chances = list(map(text_of, model.probabilities.tolist()))
        successors, pairs = model.successors.tolist(), model.pair_offsets.tolist()
        bounds, goal = model.outcome_offsets.tolist(), model.goal_mask.tolist()
        lines = list[bytes]()
        for x in range(model.n_states):
            actions = []
            for k in range(pairs[x], pairs[x + 1]):
                some = slice(bounds[k], bounds[k + 1])
                moves = [list(one) for one in zip(chances[some], successors[some], strict=True)]
                paid = [t[some] if len(set(t[some])) > 1 else t[some][0] for t in texts]
                actions.append([str(model.action_of(k)), moves, paid])
            sets = ["goal"] * goal[x] + [name for name, mask in self.sets.items() if mask[x]]
            lines.append(line_of({"name": str(model.states[x]), "sets": sets, "actions": actions}))
        return lines

    @cached_property
    def model(self) -> list[State]:
        """The model's states, as the checker reads them from their lines."""
        return [reading.read_state(line, self.question) for line in self.states]

    @property
    def scale(self) -> Fraction:
        """Unit of caps on total costs: the greatest cost of a step, at most 1; or 1 if it is 0."""
        costs, exact = self.costs[0]
        most = float(costs.max(initial=0.0))
        return min(exact.get(most, Fraction(text_of(most))), Fraction(1)) or Fraction(1)

    def lines(self) -> list[bytes]:
        """Return the lines of the question and of the model, one for each state."""
        return [line_of(self.question), *self.states]

    def _question(self) -> dict[str, Any]:
        """Return the question in the certificate's format."""
        problem, semantics, flat = self.problem, self.problem.semantics, self.flat
        objective = flat.objective_condition
        penalty = 0.0 if semantics.forbids_failing else semantics.penalty
        sought: dict[str, Any] = {"constant": text_of(penalty), "terms": [["1", "cost", 0]]}
        sought["terms"] += [[f"-{text_of(penalty)}", "end", "goal"]] if penalty > 0.0 else []
        if objective is not None:
            sought = self._quantity(objective, problem.quantity)
        elif self.charge is not None:
            worth = semantics.failing_value if semantics.maximises else 0.0
            sought = {"constant": text_of(worth), "terms": []}
        elif semantics.aim is not Aim.LEAST_COST:
            sought = {"constant": "0", "terms": [["1", "end", "goal"]]}
        rows, stated = list[dict[str, Any]](), problem.all_constraints
        for condition in flat.conditions:
            quantity = stated[condition.name].quantity if condition.name in stated else None
            row = self._quantity(condition, quantity)
            for upper in condition.rows:
                is_most = upper.sign > 0.0
                bound = text_of((condition.upper if is_most else condition.lower) or 0.0)
                side = "at_most" if is_most else "at_least"
                rows.append({"name": upper.name, "quantity": row, side: bound})
        start = problem.start if isinstance(problem.start, Mapping) else {problem.start: 1.0}
        failure: Any = "least"
        if problem.reach_fraction is not None:
            failure = {"share": text_of(problem.reach_fraction)}
        elif semantics.forbids_failing:
            failure = "0"
        elif (budget := problem.failure_budget) is not None:
            failure = None if budget >= 1.0 else text_of(max(budget, 0.0))
        greatest = semantics.aim is Aim.GREATEST_GOAL or semantics.maximises
        return {
            "format": reading.FORMAT, "states": flat.model.n_states, "costs": len(self.costs),
            "sets": list(self.sets),
            "start": [[text_of(p), problem.model.index_of(x)] for x, p in start.items()],
            "give_up": str(semantics.give_up),
            "charge_failing_step": bool(semantics.charge_failing_step),
            "greatest": objective is None and greatest, "objective": sought, "failure": failure,
            "discount": None if problem.discount is None else text_of(problem.discount),
            "horizon": problem.horizon, "rows": rows, "ratio": bool(problem.ratio), "charge": [],
            "quantile": None if semantics.risk is None else text_of(semantics.risk.level),
        }  # fmt: skip

    def _steps(self, charge: Charge) -> list[list[str]]:
        """Return a charge of the total cost as linear pieces, each a list of texts.

        A piece has the relation ">=" or ">", the total from which on it holds, the charge there,
        and the slope. A charge that is not piecewise linear gets a constant piece for each possible
        total at the goal.
        """
        if isinstance(charge, TotalCostCharge):
            return _TOTAL
        if isinstance(charge, WithinBound):
            return [[">=", "0", "1", "0"], [">", text_of(charge.bound), "0", "0"]]
        most, sign = Fraction(1), -1.0 if charge.lowest < 0.0 else 1.0
        worth = charge.offset - float(charge.at(np.zeros(1))[0])
        if isinstance(charge, ExpectedArrivalCost):
            most = Fraction(charge.affine_from)
        while isinstance(charge, Reward) and most < _FARTHEST:  # until little is left
            if charge.offset - float(charge.at(np.array([float(most)]))[0]) <= _USED_UP * worth:
                break
            most *= 2
        totals = [t for t in goal_totals(self.question, self, most + self.scale) if t <= most]
        values = (sign * charge.at(np.array(list(map(float, totals))))).tolist()
        steps = [[">=", str(t), text_of(v), "0"] for t, v in zip(totals, values, strict=True)]
        if isinstance(charge, ExpectedArrivalCost):
            line = text_of(float(charge.at(np.array([charge.affine_from]))[0]))
            return [*steps, [">", text_of(charge.affine_from), line, text_of(charge.slope)]]
        return [*steps, [">", str(totals[-1]), text_of(sign * charge.offset), "0"]]

    def _quantity(self, condition: Condition, stated: Any) -> dict[str, Any]:
        """Return a quantity in the format of certificate files; add its costs and sets to the file.

        Args:
            condition: the quantity, looked up in the model.
            stated: the quantity before that, whose constant is used; None: the constant of
                ``condition``.
        """
        terms = list[list[Any]]()
        constant = Fraction(text_of(condition.constant if stated is None else stated.constant))
        for weight, term in condition.terms:
            text = text_of(weight)
            if isinstance(term, StepTerm):
                terms.append([text, "cost", self._cost(term.model)])
            elif term.others:
                constant += Fraction(text)
                terms.append([text_of(-weight), "end", self._set(term.states)])
            else:
                kind = "end" if term.final else "visits"
                terms.append([text, kind, self._set(term.states)])
        return {"constant": str(constant), "terms": terms}

    def _cost(self, model: SSP) -> int:
        """Return the index of a model's cost among the file's costs; add the cost if it is new."""
        for position, (costs, exact) in enumerate(self.costs):
            if exact == model.exact_costs and np.array_equal(costs, model.costs):
                return position
        self.costs.append((model.costs, model.exact_costs))
        return len(self.costs) - 1

    def _set(self, mask: BoolArray) -> str:
        """Return the name of a set of states in the file; add the set if it is new.

        The name is "goal", "out of time", a label of exactly these states, the name of a single
        state, or "set" with a number.
        """
        model, members = self.flat.model, mask.nonzero()[0]
        if np.array_equal(mask, model.goal_mask):
            return "goal"
        if self.problem.horizon is not None and not members.size:
            return LATE
        known = next((name for name, has in self.sets.items() if np.array_equal(has, mask)), None)
        if known is None:
            known = f"set {len(self.sets) + 1}"
            names = [str(label) for label, states in model.state_labels.items()
                     if np.array_equal(np.sort(states), members)]  # fmt: skip
            names += [str(model.states[int(members[0])])] if members.size == 1 else []
            known = next((n for n in names if n not in {"goal", LATE, *self.sets}), known)
            self.sets[known] = mask
        return known


@lru_cache(1 << 14)
def text_of(value: float | Fraction) -> str:
    """Return a number as a text: a fraction such as "1/3", or a float's shortest decimal."""
    if isinstance(value, (int, Fraction)):
        return str(value)
    return repr(float(value)).removesuffix(".0")


def program_of(asked: dict[str, Any], statement: Statement, cap: Fraction = Fraction(0)) -> Program:
    """Build the linear program of one step of a question, such as its least failure.

    Args:
        asked: the question of the step, as ``certificate_lines.stated`` returns it.
        statement: has the model.
        cap: total cost from which on totals are not distinguished.

    Raises:
        ModelError: the program has too many nodes, or the question is refused.
    """
    try:
        return Program(asked, lambda: statement.model, str(cap), _MOST_NODES)
    except RefusedError as error:
        raise ModelError(f"no certificate file: {error}") from error


def goal_totals(question: dict[str, Any], statement: Statement, cap: Fraction) -> list[Fraction]:
    """Return the possible total costs at the goal, sorted, with 0 always among them.

    Args:
        question: the question of the file.
        statement: has the model.
        cap: only steps that begin at a total below the cap are followed.
    """
    any_failure = {"failure": (Fraction(1), Fraction(1)), "charge": _TOTAL, "greatest": False}
    program = program_of({**question, **any_failure}, statement, cap)
    ends = {r + t for x, r in program.place for action in program.model[x].actions
            for _, y, t in action.outcomes if y in program.graph.goal}  # fmt: skip
    return [Fraction(total, program.unit) for total in sorted(ends | {0})]


@explained
def write_certificate(solution: Solution, path: str | Path, *, tolerance: float = 1e-6) -> Checked:
    """Write a certificate: a proof of a solution's optimum, to be checked without this library.

    Covered criteria, each with any limits and any start, also within a horizon:

    - expected costs and quantities, also discounted, with a failure budget, a share of the greatest
      goal probability, a penalty for failing, or failing forbidden;
    - the greatest and the least goal probability;
    - of the total cost: the mean given success, quantiles, utilities, arrival costs, and the
      probability of reaching the goal within a cost.

    Not covered, but proved by :func:`ssp_lp.certify` in memory: tail means (CVaR), quantities that
    count after failing, and the optimality of deterministic policies.

    Args:
        solution: a solution of ``solve``.
        path: path of the file, which is compressed by gzip whatever its name.
        tolerance: largest error, relative to max(1, abs(objective)). The file is written only if
            the proved interval agrees with the solution's objective and bound, and the policy
            attains the objective, up to this error.

    Returns:
        The verdict, with the proved interval.

    Raises:
        ModelError: the criterion is not covered, or the model is implicit.
        SolverError: the solution is not proved, because no policy satisfies a row up to rounding,
            or because the solution disagrees with the proof.
    """
    if isinstance(solution.problem.model, ExploredSSP):
        raise ModelError(
            "a certificate file needs the whole model, of which only a part was explored: use "
            "certify(solution), which proves the optimum in memory and states its assumption"
        )
    problem, evaluation, said = solution.problem, solution.evaluation, solution.objective
    room, budget = tolerance * max(1.0, abs(said)), problem.failure_budget
    failure, reason = evaluation.limited_failure, ""
    if budget is not None and failure > budget + LEAST_BUDGET:
        reason = f"the policy fails with {failure:.12g}, above the budget {budget:.12g}"
    elif not abs(evaluation.objective - said) <= room:
        reason = f"the policy's objective is {evaluation.objective!r}, the solution says {said!r}"
    if reason:
        raise SolverError(f"the answer is not proved: {reason}")
    lines = certificate_of(solution)
    try:
        checked = _checked(lambda: iter(lines))
    except RefusedError as error:
        raise SolverError(f"the answer is not proved: {error}") from error
    least, most = solution.lower_bound - room, said + room
    if solution.upper_bound is not None:
        least, most = said - room, solution.upper_bound + room
    if checked.lower < least or checked.upper > most:
        lower, upper = float(checked.lower), float(checked.upper)
        raise SolverError(f"the answer is not proved: the proof gives {lower!r} to {upper!r}, the "
                          f"solution says {least!r} to {most!r}")  # fmt: skip
    with open(path, "wb") as raw, gzip.GzipFile("", "wb", fileobj=raw, mtime=0) as file:
        file.writelines(lines)
    return checked


def certificate_of(solution: Solution) -> list[bytes]:
    """Return the lines of a solution's certificate.

    Raises:
        ModelError: the criterion is not covered.
        SolverError: the solution's policy does not fit the solution.
    """
    solved = as_solved(solution, "write_certificate")
    problem = solution.problem
    check_not_rounded(problem.tracked.model, "a certificate file")
    if solution.run.deterministic and problem.failure_budget is not None:
        raise _refused(problem, f"the best deterministic policy is not covered{_IN_MEMORY}")
    statement = Statement(problem)
    question, answer, done = statement.question, None, dict[str, Bounds]()
    if question["quantile"] is not None:
        near = Fraction(text_of(solution.objective))
        totals = goal_totals(question, statement, near + statement.scale)
        answer = str(min(totals, key=lambda total: abs(total - near)))
    lines = [*statement.lines(), line_of({"answer": answer})]
    for step in reading.steps_of(question):
        asked = reading.stated(question, step, answer, done)
        proof, done[step] = _best_proof(asked, statement, solved, step)
        lines += proof
    return lines


def _best_proof(
    asked: dict[str, Any], statement: Statement, solved: Solution, step: str
) -> tuple[list[bytes], Bounds]:
    """Return the lines of the best proof of one program of a certificate, and the proved interval.

    The cap on total costs is raised until the interval is narrow, or hardly gets narrower: first to
    twice its value, then by the rate at which the width has fallen.

    Args:
        asked: the question of the program.
        statement: has the model.
        solved: the solution, whose policies and prices start the search for a proof.
        step: name of the program: "least", "main", "late" or "from".
    """
    scale = statement.scale
    cap = more = _first_cap(asked, solved, scale)
    widths = [math.inf]
    for _ in range(_CAPS):
        nodes = Nodes(program_of(asked, statement, cap), len(statement.model))
        first = solved.policy.policies if step != "least" else ()
        members = [nodes.member(_decider(nodes, one, solved)) for one in first]
        prices = _prices(nodes.program, solved, is_main=step == "main")
        proof, bounds = proof_of(nodes, members, prices)
        widths.append(float((bounds.upper - bounds.lower) / (scale + abs(bounds.upper))))
        if len(widths) == 2 or widths[-1] < widths[-2]:
            best = proof, bounds
        if not asked["charge"] or widths[-1] <= _NARROW or widths[-1] > 0.9 * widths[-2]:
            break
        if nodes.size > _MOST_NODES // 2:
            break
        if len(widths) > 2:
            ahead = math.log(widths[-1] / _AIM) / math.log(widths[-2] / widths[-1])
            more = min(max(more * Fraction(ahead), cap / 8), 3 * cap)
        cap += math.ceil(more / scale) * scale
    return best


def _prices(program: Program, solved: Solution, *, is_main: bool) -> list[Fraction]:
    """Return the prices of the rows from which the search for a proof starts, [rows].

    They are the solution's prices in the main program, and 0 in all other programs. For a ratio,
    the solution's objective is added to the price of failure.
    """
    of_failure, asked = solved.failure_price, program.question
    if of_failure is None or not math.isfinite(of_failure):
        of_failure = _STEEP * (1.0 + abs(solved.objective)) * (asked["failure"][1] < 1)
    given = [of_failure, *(solved.prices.get(row.name, 0.0) for row in program.rows[1:])]
    prices = [is_main * Fraction(text_of(max(price, 0.0))) for price in given]
    prices[0] += Fraction(text_of(solved.objective)) * asked["ratio"] * is_main
    return prices


def _first_cap(asked: Mapping[str, Any], solved: Solution, scale: Fraction) -> Fraction:
    """Return the first cap to try: total costs of at least the cap are not distinguished."""
    if not asked["charge"]:
        return Fraction(0)
    cap = max(number(at) for _, at, _, _ in asked["charge"]) + scale
    if len(asked["charge"]) == 1:
        cap = max(cap, 2 * Fraction(text_of(solved.objective)))
    for policy in solved.policy.policies:
        if isinstance(policy, CostAwarePolicy):
            last = policy.cap * policy.unit if policy.levels is None else policy.levels[-1]
            cap = max(cap, Fraction(float(last)))
    return math.ceil(cap / scale) * scale


def _decider(nodes: Nodes, policy: Policy, solved: Solution) -> Decide:
    """Return a function from a program's node to the position of the column that a policy takes.

    Raises:
        ModelError: the policy remembers more than the total cost, or draws its actions at random.
    """
    model, program = solved.problem.model, nodes.program
    every = [i for block in nodes.blocks for i in block if i]
    states: IntArray = np.array([nodes.state_of(i) for i in every], dtype=np.int64)
    totals = np.array([nodes.where.get(i, (0, program.cap))[1] / program.unit for i in every])
    if isinstance(model, HorizonSSP) and program.question["horizon"] is not None:
        steps, states = np.divmod(states, program.question["states"])
        states = model.table[states, steps]
    live = (np.diff(model.pair_offsets) > 0) & ~model.goal_mask
    acting: IntArray = np.flatnonzero(live[states] & (states >= 0))
    states, memory = states[acting], np.zeros_like(acting)
    if isinstance(policy, CostAwarePolicy) and program.steps:
        paid = totals[acting]
        if policy.levels is None:  # the cap may lie between two layers
            paid = np.rint(paid / policy.unit) * policy.unit
        memory = policy.remember(memory, memory, states, paid)
    elif policy.memory_size != 1:
        raise ModelError(f"{_NO_FILE} a policy that remembers more than the total cost")
    branches = policy.branches(states, memory)
    if len(branches.situation) != acting.size:
        raise ModelError(f"{_NO_FILE} a policy that draws its actions at random")
    taken = np.where(branches.pair < 0, UNDECIDED, branches.pair - model.pair_offsets[states])
    table = dict(zip([every[k] for k in acting.tolist()], taken.tolist(), strict=True))

    def decide(i: int) -> int:
        actions, position = nodes.actions[nodes.state_of(i)], table.get(i, UNDECIDED)
        return actions.index(position) if position in actions else nodes.stop(i)

    return decide
