"""Limits of 1e-12 to 1e-6 on coefficients that span 15 powers of ten, against exact fractions.

    python tests/campaigns/tiny_limits.py --count 2000 --seed 0

Criteria: MaxProb, MCMP, MinCost and S3P, with one to three limits, <=, >= or ==, on costs and ends.
Checked: the optimum, both sides of it, and that every limit is kept to 1e-12 of its own size.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from formulations import MCMP, S3P, MaxProb, MinCost
from ssp_lp import (
    SSP,
    Constraint,
    InfeasibleError,
    SSPError,
    certify,
    end_probability,
    goal_probability,
    secondary_cost,
    solve,
)
from tests.campaigns.campaign import run
from tests.support.exact_programs import ExactModel

KEPT = 1e-12
"""Share of its own size to which every limit holds."""

NEAR = 1e-10
"""Share of a bound by which it may lie below what is attainable and count as equal."""

CLOSE = 1e-9
"""Relative distance from the exact optimum."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A problem, and the program that is its optimum in fractions."""

    problem: Any
    exact: ExactModel
    objective: Any  # of each pair
    limits: list[tuple[Any, str, float]]
    sign: int = 1  # -1: the optimum is minus the least objective


def _table(rng: np.random.Generator, *, loops: bool) -> dict[Any, dict[Any, list[Any]]]:
    """Two to four states, and the ends "g", "pit" and "bog"; from state 0 one may go home free."""
    n, table = int(rng.integers(2, 5)), {}
    for state in range(n):
        table[state] = {}
        for action in range(int(rng.integers(1, 4))):
            shares = rng.dirichlet(np.ones(int(rng.integers(1, 4))))
            places = [
                *range(0 if loops and rng.random() < 0.3 else state + 1, n),
                "g",
                "pit",
                "bog",
            ]
            ends = rng.permutation(len(places))[: shares.size]
            moves = [
                (float(p), places[k], float(rng.integers(1, 4)))
                for p, k in zip(shares, ends, strict=False)
            ]
            total = sum(p for p, _, _ in moves)
            table[state][action] = [(p / total, to, c) for p, to, c in moves]
    table[0]["home"] = [(0.75, "g", 3.0), (0.25, "pit", 3.0)]
    return {**table, "g": {}, "pit": {}, "bog": {}}


def _fuel(rng: np.random.Generator, table: dict[Any, Any]) -> dict[Any, dict[Any, float]]:
    """A second cost over 15 powers of ten, nothing on the way home."""
    return {
        state: {
            action: 0.0 if action == "home" else float(10.0 ** rng.uniform(-10.0, 5.0))
            for action in actions
        }
        for state, actions in table.items()
        if actions
    }


def drawn(seed: int) -> Drawn:
    """The problem of a seed: its criterion in turn, its limits at random."""
    rng = np.random.default_rng(seed)
    criterion = (MaxProb, MCMP, S3P, MinCost)[seed % 4]
    table = _table(rng, loops=criterion is not S3P)
    if criterion is MinCost:
        table = {
            s: {
                a: [(p, "g" if to in ("pit", "bog") else to, c) for p, to, c in moves]
                for a, moves in actions.items()
            }
            for s, actions in table.items()
        }
    model = SSP.from_transitions(table, goal={"g"}, treat_actionless_as_dead_ends=True)
    give_up = str(rng.choice(["anywhere", "dead_ends"]))
    quits = {MCMP: give_up.replace("dead_ends", ""), MinCost: ""}.get(criterion, "attention")
    exact = ExactModel(table, "g", 0, quits=quits)
    if criterion is S3P:
        exact = exact.by_total()
    named: dict[str, Constraint] = {}
    limits: list[tuple[Any, str, float]] = []

    def spread(values: dict[Any, dict[Any, float]]) -> list[Any]:
        if criterion is S3P:
            values = {node: values[node[0]] for node, acts in exact.table.items() if acts}
        return exact.spread(values)

    def into(end: str) -> list[Any]:
        ends = (
            [end]
            if criterion is not S3P or end == "g"
            else [node for node in exact.table if node[0] == end]
        )
        return exact.into(ends)

    for number in range(int(rng.integers(1, 4))):
        bound = float(10.0 ** rng.uniform(-12.0, -6.0))
        kind = rng.random()
        name = f"limit {number}"
        if kind < 0.6 or number == 0 or criterion is MinCost:
            values = _fuel(rng, table)
            named[name] = secondary_cost(values) <= bound
            limits.append((spread(values), "<=", bound))
        elif kind < 0.75 and not quits:  # who gives up comes to some end all the same
            named[name] = end_probability("bog") <= bound
            limits.append((into("bog"), "<=", bound))
        elif kind < 0.9:
            end = "g" if quits else str(rng.choice(["bog", "g"]))
            quantity = goal_probability() if end == "g" else end_probability(end)
            named[name] = quantity >= bound
            limits.append((into(end), ">=", bound))
        elif not quits:
            named[name] = end_probability("bog") == bound
            limits.append((into("bog"), "==", bound))
    how: dict[str, Any] = {"constraints": named}
    budget = float(rng.uniform(0.3, 1.0)) if rng.random() < 0.7 else 1.0
    if criterion in (MCMP, S3P) and budget < 1.0:
        how["failure_budget"] = budget
        # failing is all that does not come to the goal
        limits.append((into("g"), ">=", Fraction(1) - Fraction(budget)))  # type: ignore[arg-type]
    elif criterion in (MCMP, S3P):
        how["failure_budget"] = 1.0
    if criterion is MCMP:
        how |= {"give_up": give_up, "charge_failing_step": False}
    problem = criterion(model, 0, **how)
    if criterion is MaxProb:
        return Drawn(problem, exact, [-each for each in into("g")], limits, -1)
    if criterion is MinCost:
        limits.append((into("g"), "==", 1.0))
    return Drawn(problem, exact, exact.cost, limits)


def broken(problem: Any, solution: Any) -> Iterator[str]:
    """Limits that a solution does not keep to a share of their own size."""
    spent = solution.secondary_costs
    for name, constraint in problem.constraints.items():
        for bound, side in ((constraint.upper, 1.0), (constraint.lower, -1.0)):
            if bound is not None and side * (spent[name] - bound) > KEPT * abs(bound):
                yield f"{name} is {spent[name]!r}, {bound!r} allowed"
    budget = problem.failure_budget
    if budget is not None and solution.failure_probability > budget * (1.0 + KEPT):
        yield f"fails with {solution.failure_probability!r}, {budget!r} allowed"


def wrong(drawn: Drawn, *, certified: bool = True) -> Iterator[str]:
    """What is wrong with the library's answer."""
    ratio = drawn.problem.ratio
    optimum = drawn.exact.least(drawn.objective, drawn.limits, given_success=ratio)
    try:
        solution = solve(drawn.problem)
    except InfeasibleError as error:
        if optimum is not None:
            yield f"said to be infeasible ({error}), {float(drawn.sign * optimum)!r} is feasible"
        return
    if optimum is None:
        eased = [(c, k, b if k == "==" and b == 1.0 else _eased(b, k)) for c, k, b in drawn.limits]
        if drawn.exact.least(drawn.objective, eased, given_success=ratio) is None:
            yield f"infeasible, said to be {solution.objective!r}"
        return
    value = float(drawn.sign * optimum)
    size = CLOSE * abs(value)
    if abs(solution.objective - value) > size:
        yield f"{solution.objective!r} is not {value!r}"
    bound = solution.lower_bound if solution.upper_bound is None else solution.upper_bound
    outside = value - bound if drawn.sign < 0 else bound - value
    if outside > 1e-13 * abs(value):
        yield f"the bound {bound!r} is beyond {value!r}"
    if solution.gap > CLOSE and not solution.note:  # a wide gap is told
        yield f"gap {solution.gap:.1e}"
    yield from broken(drawn.problem, solution)
    if certified and not (certificate := certify(solution)).accepted:
        yield f"certificate refused: {certificate.reason}"


def _eased(bound: float, kind: str) -> float:
    """A bound moved by what counts as equal to it."""
    return bound * (1.0 + NEAR if kind == "<=" else 1.0 - NEAR)


def main(arguments: Sequence[str] | None = None) -> int:
    """Check problems from the command line; 1 if anything was found."""

    def check(seed: int, counts: Counter[str], _: argparse.Namespace) -> list[str]:
        one = drawn(seed)
        counts[type(one.problem).__name__] += 1
        try:
            return list(wrong(one))
        except SSPError as error:
            return [f"{type(error).__name__}: {error}"]

    return run(__doc__, check, arguments)


if __name__ == "__main__":
    sys.exit(main())
