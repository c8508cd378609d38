"""Questions with a limit on a second cost."""

from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any

from formulations import ConstrainedCost, CostLimit
from ssp_lp import SSP
from tests.campaigns.rational.lotteries import Point, best_lottery
from tests.campaigns.rational.models import START
from tests.campaigns.rational.policies import Exact
from tests.campaigns.rational.question import NEAR, ROOM, ROUNDING, Question, total_cost

_NEARLY = Fraction(1, 10**8)  # relative; such a limit is an equation, which rounding decides


def limited(exact: Exact, give_up: str, charged: bool) -> Iterator[Question]:
    """A limit on the second cost: at least failure, or within a budget."""
    points = []
    for one in exact.policies:
        pair = [
            total_cost(exact, one, give_up, charged, second=second, both=True)
            for second in (False, True)
        ]
        if pair[0] is not None and pair[1] is not None:
            points.append(Point(one.failure, pair[0], pair[1]))
    least = min(one.failure for one in exact.policies)
    turn, near = exact.model.index % 4, None
    allowed: float | None = 1.0
    if turn < 2:
        allowed = None
        near = [p for p in points if p.failure <= least + NEAR * (1 - least)]
        points = [p for p in points if p.failure == least]
    elif turn == 2 and points:
        cheapest = min(points, key=lambda p: (p.cost, p.failure))
        allowed = float((least + cheapest.failure) / 2)
        allowed = allowed if allowed >= least else min(float(least) * (1 + 1e-9) + 1e-13, 1.0)
    yield from _limit(
        exact, points, near, allowed, {"give_up": give_up, "charge_failing_step": charged}
    )


def _limit(
    exact: Exact,
    points: list[Point],
    near: list[Point] | None,
    allowed: float | None,
    settings: Mapping[str, Any],
) -> Iterator[Question]:
    """One question, its bound between what is needed at least and what the cheapest spends."""
    if not points:
        return
    budget = Fraction(1 if allowed is None else min(allowed, 1.0))
    inside = [p for p in points if p.failure <= budget]
    needed = min(p.second for p in inside)
    share = Fraction(1, 2) if exact.model.index % 9 else Fraction(-3, 5)
    spent = min(inside, key=lambda p: (p.cost, p.second)).second
    bound = float(needed + share * (spent - needed if share > 0 else needed))
    if share > 0 and spent - needed <= needed * _NEARLY:
        bound *= 1.0 + 1e-6
    costs = {s: {a: float(c) for a, c in row.items()} for s, row in exact.model.second.items()}

    def answer(some: list[Point], more: Fraction, rounding: Fraction) -> Fraction | None:
        return best_lottery(
            some, min(budget * (1 + rounding), Fraction(1)), Fraction(bound) * (1 + more)
        )

    def problem(model: SSP) -> ConstrainedCost:
        limit = CostLimit(costs, bound)
        return ConstrainedCost(model, START, {"limit": limit}, failure_budget=allowed, **settings)

    def equals() -> tuple[Fraction, Fraction]:
        low = answer(points, ROOM, ROOM)
        high = answer(points, -ROUNDING, -ROUNDING)
        assert low is not None
        return low, low * 10**9 if high is None else high

    exactly = answer(points, Fraction(0), Fraction(0))
    yield Question(
        "ConstrainedCost" + (" least" if allowed is None else ""),
        f"{dict(settings)}, failure_budget={allowed!r}, limit {costs} <= {bound!r}",
        problem,
        exactly,
        equals=None if exactly is None else equals,
        near_tie=None if near is None or exactly is None else answer(near, ROOM, Fraction(0)),
        budget=allowed,
    )
