"""Shares of goals that are reached with 1e-3 down to 1e-30, against exact fractions.

    python tests/campaigns/goal_shares.py --count 200 --seed 0

Ladders whose rungs are climbed by chance, in MCMP, AlphaMCMP and S3P, exact and discounted, with
and without a limit on a second cost. Checked: the optimum, both sides of it, that the share and
the limit are kept to 1e-12 of their own size, and the certificate.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from formulations import MCMP, S3P, AlphaMCMP
from ssp_lp import SSP, InfeasibleError, SSPError, certify, secondary_cost, solve
from tests.campaigns.campaign import run
from tests.support.exact_programs import ExactModel

CLOSE = 1e-9
KEPT = 1e-12


def ladder(rng: np.random.Generator) -> dict[Any, dict[Any, list[Any]]]:
    """Rungs with two or three ways up; who does not get up falls, or stays now and then."""
    n = int(rng.integers(1, 7))
    table: dict[Any, dict[Any, list[Any]]] = {}
    for rung in range(n):
        table[rung] = {}
        for way in range(int(rng.integers(2, 4))):
            up = float(10.0 ** -rng.uniform(0.3, 5.0))
            stays = float(rng.choice([0.0, 0.0, 0.3]))
            cost = float(rng.integers(1, 6))
            moves = [(up, rung + 1, cost), (1.0 - up - stays, "pit", cost)]
            table[rung][way] = [*moves, *([(stays, rung, cost)] if stays else [])]
    return {**table, n: {}, "pit": {}}


def drawn(seed: int) -> tuple[Any, ExactModel, list[tuple[Any, str, Any]], Fraction]:
    """A problem, its exact model and limits, and the goal probability that is demanded."""
    rng = np.random.default_rng(seed)
    criterion = (MCMP, S3P, AlphaMCMP)[seed % 3]
    table = ladder(rng)
    n = len(table) - 2
    if criterion is S3P:  # runs of finitely many totals
        for state, actions in table.items():
            for moves in actions.values():
                kept = [move for move in moves if move[1] != state]
                whole = sum(p for p, _, _ in kept)
                moves[:] = [(p / whole, to, c) for p, to, c in kept]
    discount = 0.95 if criterion is not AlphaMCMP and rng.random() < 0.3 else None
    model = SSP.from_transitions(table, goal={n}, treat_actionless_as_dead_ends=True)
    exact = ExactModel(table, n, 0, "attention" if criterion is S3P else "anywhere")
    goal = exact.into([n])
    greatest = -exact.least([-each for each in goal], [])
    share = float(rng.uniform(0.01, 0.99))
    demanded = Fraction(share) * greatest
    if discount is not None:
        exact = ExactModel(table, n, 0, exact.quits, discount=discount)
        discounted = exact.into([n])
        most = -exact.least([-each for each in discounted], [])
        share *= 0.9 * float(most / greatest)
        demanded, goal = Fraction(share) * greatest, discounted
    limits: list[tuple[Any, str, Any]] = [(goal, ">=", demanded)]
    how: dict[str, Any] = {"reach_fraction": share}
    if discount is not None:
        how["discount"] = discount
    if criterion is S3P:
        exact = exact.by_total()
        limits = [(exact.into([n]), ">=", demanded)]
    if rng.random() < 0.4:
        fuel = {
            s: {a: float(10.0 ** rng.uniform(-3.0, 3.0)) for a in acts}
            for s, acts in table.items()
            if acts
        }
        values = (
            fuel if criterion is not S3P else {x: fuel[x[0]] for x, a in exact.table.items() if a}
        )
        spent = exact.spread(values)
        least = exact.least(spent, limits)
        bound = float(least) * float(1.0 + 10.0 ** rng.uniform(-3.0, 1.0))
        how["constraints"] = {"fuel": secondary_cost(fuel) <= bound}
        limits.append((spent, "<=", bound))
    return criterion(model, 0, **how), exact, limits, demanded


def wrong(seed: int) -> Iterator[str]:
    """What is wrong with the library's answer to the problem of a seed."""
    problem, exact, limits, demanded = drawn(seed)
    optimum = exact.least(exact.cost, limits, given_success=problem.ratio)
    if optimum is None:
        return
    value = float(optimum)
    try:
        solution = solve(problem)
    except InfeasibleError as error:
        yield f"said to be infeasible: {error}"
        return
    if abs(solution.objective - value) > CLOSE * value:
        yield f"{solution.objective!r} is not {value!r}"
    if solution.lower_bound > value * (1.0 + 1e-13):
        yield f"the bound {solution.lower_bound!r} is beyond {value!r}"
    if solution.gap > CLOSE:
        yield f"gap {solution.gap:.1e}: {solution.note}"
    if solution.evaluation.limited_goal < float(demanded) * (1.0 - KEPT):
        yield f"reaches the goal with {solution.evaluation.limited_goal!r} of {float(demanded)!r}"
    for name, limit in problem.constraints.items():
        if solution.secondary_costs[name] > limit.upper * (1.0 + KEPT):
            yield f"{name} is {solution.secondary_costs[name]!r}, {limit.upper!r} allowed"
    certificate = certify(solution)
    if not certificate.accepted or certificate.gap > 10.0 * CLOSE:
        yield f"certificate: {certificate}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Check problems from the command line; 1 if anything was found."""

    def check(seed: int, counts: Counter[str], _: argparse.Namespace) -> list[str]:
        counts[(MCMP, S3P, AlphaMCMP)[seed % 3].__name__] += 1
        try:
            return list(wrong(seed))
        except SSPError as error:
            return [f"{type(error).__name__}: {error}"]

    return run(__doc__, check, arguments)


if __name__ == "__main__":
    sys.exit(main())
