"""The questions put to the library about one model."""

from collections.abc import Iterator
from fractions import Fraction

from formulations import (
    ISSPUDE,
    MCMP,
    S3P,
    FinitePenalty,
    MaxProb,
    MinCost,
    MinProb,
)
from tests.campaigns.rational.limits import limited
from tests.campaigns.rational.lotteries import Point, at_budget, lower_hull
from tests.campaigns.rational.models import START
from tests.campaigns.rational.policies import Exact
from tests.campaigns.rational.product import cost_given_success
from tests.campaigns.rational.question import NEAR, ROUNDING, SPECK, Question, total_cost

GIVE_UP = ("attention", "anywhere", "dead_ends")


def questions(exact: Exact) -> Iterator[Question]:
    """All questions about a model."""
    turn = exact.model.index
    give_up, charged = GIVE_UP[turn % 3], turn % 2 == 0
    yield from _extremes(exact)
    yield from _given_success(exact)
    yield from _case_m(exact, give_up, charged)
    if turn % 3:
        yield from _case_m(exact, GIVE_UP[(turn + 1) % 3], True)
    yield from limited(exact, GIVE_UP[(turn + 1) % 3], charged)
    penalty = (0.5, 10.0, 1000.0)[turn % 3]
    points = _points(exact, "anywhere", False)
    worth = min(p.cost + Fraction(penalty) * p.failure for p in points)
    yield Question(
        "FinitePenalty", f"penalty={penalty}", lambda m: FinitePenalty(m, START, penalty), worth
    )
    if exact.model.family == "ordinary" and turn % 4 == 0:
        yield from _given_success_within(exact)


def _points(exact: Exact, give_up: str, charged: bool) -> list[Point]:
    """Policies of finite cost with the give-up choice, once each."""
    found = []
    for one in exact.policies:
        cost = total_cost(exact, one, give_up, charged, second=False)
        if cost is not None:
            found.append(Point(one.failure, cost))
    return list(dict.fromkeys(found))


def _extremes(exact: Exact) -> Iterator[Question]:
    """The extreme goal probabilities, and the plain shortest path."""
    failures = [one.failure for one in exact.policies if not one.stops]
    yield Question("MaxProb", "", lambda m: MaxProb(m, START), 1 - min(failures))
    yield Question("MinProb", "", lambda m: MinProb(m, START), 1 - max(failures))
    sure = [p.cost for p in _points(exact, "anywhere", False) if p.failure == 0]
    yield Question("MinCost", "", lambda m: MinCost(m, START), min(sure, default=None))


def _given_success(exact: Exact) -> Iterator[Question]:
    """Cost given success at least failure."""
    least = min(one.failure for one in exact.policies)
    answer = near = None
    if least < 1:
        room = NEAR * (1 - least)
        ratios = [
            (one.failure, one.success_cost / (1 - one.failure))
            for one in exact.policies
            if one.failure <= least + room
        ]
        answer = min(ratio for failure, ratio in ratios if failure == least)
        near = min(ratio for _, ratio in ratios)
    for name, criterion in (
        ("S3P", lambda m: S3P(m, START)),
        ("ISSPUDE", lambda m: ISSPUDE(m, START)),
    ):
        yield Question(f"{name} least", "", criterion, answer, near_tie=near, least=least)


def _given_success_within(exact: Exact) -> Iterator[Question]:
    """Cost given success within a budget, by a program in floats."""
    failures = [one.failure for one in exact.policies]
    least = min(failures)
    if least == 1:
        return
    budget = float(least + (1 - least) * Fraction(3, 10))
    found = cost_given_success(exact, budget)
    if found is not None:
        yield Question(
            "S3P budget",
            f"failure_budget={budget!r}",
            lambda m: S3P(m, START, failure_budget=budget),
            Fraction(found),
            budget=budget,
            tolerance=1e-7,
        )


def _case_m(exact: Exact, give_up: str, charged: bool) -> Iterator[Question]:
    """MCMP at least failure and within budgets."""
    points = _points(exact, give_up, charged)
    least = min(one.failure for one in exact.policies)
    asked = f"give_up={give_up!r}, charge_failing_step={charged}"
    settings = {"give_up": give_up, "charge_failing_step": charged}
    room = NEAR * (1 - least)
    yield Question(
        "MCMP least",
        asked,
        lambda m: MCMP(m, START, **settings),
        min(p.cost for p in points if p.failure == least),
        near_tie=min(p.cost for p in points if p.failure <= least + room),
        least=least,
    )
    hull = lower_hull(points)
    budgets = {"near": min(float(least) * (1 + 1e-6) + 1e-13, 1.0), "one": 1.0}
    if len(hull) > 1:
        budgets["half"] = float((hull[0].failure + hull[-1].failure) / 2)
    for name, budget in budgets.items():
        yield Question(
            f"MCMP {name}",
            f"{asked}, failure_budget={budget!r}",
            lambda m, b=budget: MCMP(m, START, failure_budget=b, **settings),
            at_budget(hull, Fraction(budget)),
            equals=lambda b=budget: _around(hull, Fraction(b)),
            near_tie=at_budget(hull, Fraction(budget) + SPECK),
            budget=budget,
        )


def _around(hull: list[Point], budget: Fraction) -> tuple[Fraction, Fraction]:
    """The optimum at the neighbours of a budget."""
    below = at_budget(hull, max(budget * (1 - ROUNDING), hull[0].failure))
    above = at_budget(hull, budget * (1 + ROUNDING))
    assert below is not None and above is not None  # noqa: PT018 (both at least the least)
    return above, below
