"""Small models whose occupation programs are asked about, and every criterion on drawn ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from formulations import (
    EGUBS,
    ISSPUDE,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostBoundedReach,
    CostLimit,
    FinitePenalty,
    MaxProb,
    MinProb,
)
from small_models import model_of
from ssp_lp import SSP, InfeasibleError, solve
from ssp_lp.problem import Problem
from ssp_lp.programs.occupation_program import OccupationMeasure
from written_models import drawn_table, written

DEPOT = written(
    """
    depot road: 0.99 home 9, 0.01 wreck 5
    depot alley: 0.9 home 3, 0.1 wreck 1
    """,
    "home",
)
SLIP = written(
    """
    s slip: 0.5 s 1, 0.5 g 1
    s dear: 0.9 g 3, 0.1 pit 3
    """
)
REENTERED = written(
    """
    a go: b 0
    a try: 0.5 g 1, 0.5 b 1
    a pay: g 5
    b go: a 0
    """
)
TURNS = written(
    """
    s go: 0.7 g 1, 0.3 pit 1
    s wait: 0.05 g 1, 0.95 t 1
    t wait: 0.05 g 1, 0.95 s 1
    """
)


def drawn_choices(seed: int, live: int = 4) -> dict:
    """States a, b, ... with self-loops and free loops, dead-ends within reach."""
    rng = np.random.default_rng([25, seed])
    return drawn_table(rng, "abcdef"[:live], ["g", "pit"], [0, 0, 1, 2]) | {"pit": {}}


def drawn(seed: int, live: int = 4) -> SSP:
    return model_of(drawn_choices(seed, live))


def with_room(seed: int, start: object = "a") -> tuple[SSP, float] | None:
    """A drawn model and its least failure, unless that is sure."""
    model = drawn(seed)
    least = solve(MaxProb(model, start)).failure_probability
    return (model, least) if least < 1.0 else None


def problems_of(seed: int) -> Iterator[Problem]:
    """Every criterion that is a linear program, on a drawn model with one start or several."""
    rng = np.random.default_rng([8, seed])
    model, start = drawn(seed, n := int(rng.integers(1, 7))), "a"
    if rng.random() < 0.4:
        start = dict.fromkeys("abcdef"[:n], 0.8 / n) | {"g": 0.1, "pit": 0.1}
    least = solve(MaxProb(model, start)).failure_probability
    budget = least + (1.0 - least) * float(rng.choice([0.05, 0.1, 0.3, 0.5]))
    give_up = str(rng.choice(["anywhere", "attention", "dead_ends"]))
    more = min(budget + 0.2, 1.0)
    yield MCMP(model, start, failure_budget=budget, give_up=give_up)
    yield MCMP(model, start, failure_budget=more, discount=0.9, give_up=give_up)
    yield from (FinitePenalty(model, start, 5.0), AlphaMCMP(model, start, 0.8))
    yield from (MCMP(model, start), MaxProb(model, start), MinProb(model, start))
    yield CostBoundedReach(model, start, 3, failure_budget=budget)
    if least < 1.0:
        yield S3P(model, start, failure_budget=budget)
        yield S3P(model, start, failure_budget=more, discount=0.9)
        yield from (S3P(model, start), ISSPUDE(model, start), EGUBS(model, start, -0.2, 1.0))
    fuel = rng.integers(0, 3, model.n_pairs).astype(float)
    asked = {"failure_budget": budget, "give_up": give_up}
    loose = ConstrainedCost(model, start, {"fuel": CostLimit(fuel, 1e6)}, **asked)
    spent = solve(loose).secondary_costs["fuel"]
    yield ConstrainedCost(model, start, {"fuel": CostLimit(fuel, 0.95 * spent)}, **asked)


def measures_of(seed: int) -> Iterator[tuple[Problem, OccupationMeasure]]:
    """The problems that have an optimum, and its measure."""
    for problem in problems_of(seed):
        try:
            yield problem, problem.program().solve()
        except InfeasibleError:
            continue
