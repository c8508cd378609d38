"""What must not change the answer: one model stated in two ways, on 100 to 100,000 states.

    python tests/campaigns/metamorphic.py --count 300 --states 100 3000
    python tests/campaigns/metamorphic.py --count 40 --states 1000 100000 --time-limit 60

A model of a family is changed by a relation that keeps its optimum, or multiplies it: costs in
another unit, states, actions and outcomes in another order, actions and outcomes twice, outcomes
merged, states split in two, a part that is never reached, a free step before the start. The
certified intervals of both answers must meet; so must the optima, where both searches ended.
Models of up to 300 states that fail are made as small as they go.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from formulations import (
    EGUBS,
    MCMP,
    S3P,
    AlphaMCMP,
    CostBoundedReach,
    CostQuantile,
    CVaR,
    FinitePenalty,
    MaxProb,
    MinProb,
)
from ssp_lp import SSP, InfeasibleError, SSPError, solve
from tests.campaigns.campaign import run, smallest_model
from tests.campaigns.family_draws import SIZES, drawn_model

AGREED = 1e-6
"""Relative difference of two optima whose gaps are closed to a tenth of it."""


class Stated(NamedTuple):
    """A model by its outcomes, a start, and by what the model's costs were multiplied."""

    n_states: int
    home: np.ndarray  # [pairs] the state of each
    pair: np.ndarray  # [outcomes] the pair of each
    to: np.ndarray  # [outcomes]
    chance: np.ndarray  # [outcomes]
    cost: np.ndarray  # [outcomes]
    goals: np.ndarray  # [states] whether it is one
    start: int = 0
    unit: float = 1.0

    @property
    def model(self) -> SSP:
        """The model for the library, its pairs in the order of their states."""
        pairs = np.argsort(self.home, kind="stable")
        place = np.empty_like(pairs)
        place[pairs] = np.arange(len(pairs))
        outcomes = np.argsort(place[self.pair], kind="stable")
        counts = np.bincount(self.home, minlength=self.n_states)
        sizes = np.bincount(place[self.pair], minlength=len(pairs))
        return SSP.from_arrays(
            pair_offsets=np.append(0, np.cumsum(counts)),
            outcome_offsets=np.append(0, np.cumsum(sizes)),
            successors=self.to[outcomes],
            probabilities=self.chance[outcomes],
            costs=self.cost[outcomes],
            goal_states=np.flatnonzero(self.goals),
            treat_actionless_as_dead_ends=True,
        )


def stated(model: SSP) -> Stated:
    """A model's outcomes; it starts in its first state."""
    counts, sizes = np.diff(model.pair_offsets), np.diff(model.outcome_offsets)
    return Stated(
        model.n_states,
        np.repeat(np.arange(model.n_states), counts),
        np.repeat(np.arange(model.n_pairs), sizes),
        np.array(model.successors),
        np.array(model.probabilities),
        np.broadcast_to(model.costs, len(model.successors)).copy(),
        np.array(model.goal_mask),
    )


Relation = Callable[[Stated, np.random.Generator], Stated]


def in_other_units(one: Stated, rng: np.random.Generator) -> Stated:
    """Costs times a number."""
    unit = float(rng.choice([0.25, 3.0, 1000.0]))
    return one._replace(cost=unit * one.cost, unit=unit)


def in_another_order(one: Stated, rng: np.random.Generator) -> Stated:
    """States, the pairs of each and their outcomes in another order."""
    name = rng.permutation(one.n_states)
    pairs, outcomes = rng.permutation(len(one.home)), rng.permutation(len(one.to))
    number = np.empty_like(pairs)
    number[pairs] = np.arange(len(pairs))
    goals = np.empty_like(one.goals)
    goals[name] = one.goals
    return Stated(
        one.n_states, name[one.home[pairs]], number[one.pair[outcomes]], name[one.to[outcomes]],
        one.chance[outcomes], one.cost[outcomes], goals, int(name[one.start]),
    )  # fmt: skip


def with_actions_twice(one: Stated, rng: np.random.Generator) -> Stated:
    """Three in ten actions twice, under another name, some of them dearer."""
    again = np.flatnonzero(rng.random(len(one.home)) < 0.3)
    number = np.full(len(one.home), -1)
    number[again] = len(one.home) + np.arange(len(again))
    more = np.flatnonzero(number[one.pair] >= 0)
    dearer = rng.integers(2, size=len(one.home))[one.pair[more]]
    return one._replace(
        home=np.append(one.home, one.home[again]),
        pair=np.append(one.pair, number[one.pair[more]]),
        to=np.append(one.to, one.to[more]),
        chance=np.append(one.chance, one.chance[more]),
        cost=np.append(one.cost, one.cost[more] + dearer),
    )


def with_outcomes_in_halves(one: Stated, rng: np.random.Generator) -> Stated:
    """Three in ten outcomes as two, each with half of the probability."""
    halved = rng.random(len(one.to)) < 0.3
    chance = np.where(halved, 0.5, 1.0) * one.chance
    return one._replace(
        pair=np.append(one.pair, one.pair[halved]),
        to=np.append(one.to, one.to[halved]),
        chance=np.append(chance, chance[halved]),
        cost=np.append(one.cost, one.cost[halved]),
    )


def with_outcomes_merged(one: Stated, rng: np.random.Generator) -> Stated:
    """Outcomes of a pair that cost the same and lead to the same state as one."""
    key = np.stack([one.pair, one.to, one.cost])
    (pair, to, cost), which = np.unique(key, axis=1, return_inverse=True)
    chance = np.bincount(which.ravel(), one.chance)
    return one._replace(pair=pair.astype(int), to=to.astype(int), chance=chance, cost=cost)


def with_states_split(one: Stated, rng: np.random.Generator) -> Stated:
    """Two in ten states twice: half of what leads to such a one leads to the other."""
    split = np.flatnonzero((rng.random(one.n_states) < 0.2) & ~one.goals)
    twin = np.full(one.n_states, -1)
    twin[split] = one.n_states + np.arange(len(split))
    pairs = np.flatnonzero(twin[one.home] >= 0)
    number = np.full(len(one.home), -1)
    number[pairs] = len(one.home) + np.arange(len(pairs))
    more = np.flatnonzero(number[one.pair] >= 0)
    both = one._replace(
        n_states=one.n_states + len(split),
        home=np.append(one.home, twin[one.home[pairs]]),
        pair=np.append(one.pair, number[one.pair[more]]),
        to=np.append(one.to, one.to[more]),
        chance=np.append(one.chance, one.chance[more]),
        cost=np.append(one.cost, one.cost[more]),
        goals=np.append(one.goals, np.zeros(len(split), dtype=bool)),
    )
    shared = twin[both.to] >= 0
    chance = np.where(shared, 0.5, 1.0) * both.chance
    return both._replace(
        pair=np.append(both.pair, both.pair[shared]),
        to=np.append(both.to, twin[both.to[shared]]),
        chance=np.append(chance, chance[shared]),
        cost=np.append(both.cost, both.cost[shared]),
    )


def with_a_part_beyond(one: Stated, rng: np.random.Generator) -> Stated:
    """The same once more, dearer, beside it: no step leads there."""
    n, m = one.n_states, len(one.home)
    return one._replace(
        n_states=2 * n,
        home=np.append(one.home, one.home + n),
        pair=np.append(one.pair, one.pair + m),
        to=np.append(one.to, one.to + n),
        chance=np.append(one.chance, one.chance),
        cost=np.append(one.cost, 3.0 * one.cost),
        goals=np.append(one.goals, one.goals),
    )


def after_a_free_step(one: Stated, rng: np.random.Generator) -> Stated:
    """A state before the start, left at no cost."""
    return one._replace(
        n_states=one.n_states + 1,
        home=np.append(one.home, one.n_states),
        pair=np.append(one.pair, len(one.home)),
        to=np.append(one.to, one.start),
        chance=np.append(one.chance, 1.0),
        cost=np.append(one.cost, 0.0),
        goals=np.append(one.goals, False),
        start=one.n_states,
    )


RELATIONS: dict[str, Relation] = {
    relation.__name__: relation
    for relation in (
        in_other_units, in_another_order, with_actions_twice, with_outcomes_in_halves,
        with_outcomes_merged, with_states_split, with_a_part_beyond, after_a_free_step,
    )
}  # fmt: skip
TIMED = ("after_a_free_step",)
"""Relations that take a step more: another problem under a discount or a horizon."""


class Asked(NamedTuple):
    """Numbers of a question, in the units of the first statement."""

    budget: float
    typical: float  # cost
    level: float


Pose = Callable[[SSP, int, Asked, float], Any]
CRITERIA: dict[str, Pose] = {
    "MCMP": lambda m, s, n, u: MCMP(m, s, n.budget),
    "MCMP, until a dead-end": lambda m, s, n, u: MCMP(
        m, s, n.budget, give_up="dead_ends", charge_failing_step=False
    ),
    "MCMP, discounted": lambda m, s, n, u: MCMP(m, s, max(n.budget, 0.5), discount=0.999),
    "MCMP, least": lambda m, s, n, u: MCMP(m, s),
    "MCMP, horizon": lambda m, s, n, u: MCMP(m, s, max(n.budget, 0.9), horizon=8),
    "S3P": lambda m, s, n, u: S3P(m, s, n.budget),
    "S3P, discounted": lambda m, s, n, u: S3P(m, s, max(n.budget, 0.5), discount=0.999),
    "S3P, least": lambda m, s, n, u: S3P(m, s),
    "MaxProb": lambda m, s, n, u: MaxProb(m, s),
    "MinProb": lambda m, s, n, u: MinProb(m, s),
    "AlphaMCMP": lambda m, s, n, u: AlphaMCMP(m, s, n.level),
    "FinitePenalty": lambda m, s, n, u: FinitePenalty(m, s, penalty=2.0 * u * n.typical),
    "CVaR": lambda m, s, n, u: CVaR(m, s, n.level, n.budget),
    "CostQuantile": lambda m, s, n, u: CostQuantile(m, s, n.level, n.budget),
    "CostBoundedReach": lambda m, s, n, u: CostBoundedReach(m, s, u * round(n.typical), 1.0),
    "EGUBS": lambda m, s, n, u: EGUBS(m, s, -1.0 / (u * (1.0 + n.typical)), 0.5),
}
UNITLESS = ("MaxProb", "MinProb", "CostBoundedReach", "EGUBS")
"""Criteria whose optimum does not grow with the costs."""


def answer(problem: Any, limit: float) -> tuple[float, float, float] | str:
    """Lower and upper end of a certified answer, and its gap; or that there is none."""
    try:
        solution = solve(problem, time_limit=limit)
    except InfeasibleError:
        return "infeasible"
    high = solution.objective if solution.upper_bound is None else solution.upper_bound
    low = solution.lower_bound if solution.upper_bound is None else solution.objective
    return low, high, solution.gap


def compared(
    one: Stated, criterion: str, relation: str, asked: Asked, rng: np.random.Generator, limit: float
) -> list[str]:
    """How the answers to two statements of one problem disagree."""
    other = RELATIONS[relation](one, rng)
    first, second = (
        answer(CRITERIA[criterion](each.model, each.start, asked, each.unit), limit)
        for each in (one, other)
    )
    if isinstance(first, str) or isinstance(second, str):
        same = first == second or not limit > 5.0
        return [] if same else [f"{criterion}, {relation}: {first} became {second}"]
    unit = 1.0 if criterion in UNITLESS else other.unit
    low, high = (end / unit for end in second[:2])
    room = AGREED * max(abs(first[1]), abs(high), 1e-9)
    if low > first[1] + room or first[0] > high + room:
        return [f"{criterion}, {relation}: [{first[0]!r}, {first[1]!r}] became [{low!r}, {high!r}]"]
    closed = max(first[2], second[2]) <= 0.1 * AGREED
    if closed and criterion != "CostQuantile" and abs(high - first[1]) > room:
        return [f"{criterion}, {relation}: {first[1]!r} became {high!r}, both proved"]
    return []


def numbers_of(model: SSP, rng: np.random.Generator, limit: float) -> Asked:
    """Numbers that mean something on a model."""
    reach = solve(MaxProb(model, 0), time_limit=limit).objective
    budget = 1.0 - float(rng.uniform(0.5, 0.95)) * reach
    cheapest = MCMP(model, 0, budget, give_up="dead_ends", charge_failing_step=False)
    typical = solve(cheapest, time_limit=limit, tolerance=1e-3).objective / max(1.0 - budget, 1e-9)
    return Asked(budget, typical, float(rng.choice([0.5, 0.8, 0.9])))


def check(seed: int, tally: Counter[str], asked: argparse.Namespace) -> list[str]:
    """Compare the two statements of a draw."""
    rng, model, criterion, relation = drawn(seed, asked)
    tally[criterion] += 1
    tally[relation] += 1
    try:
        numbers = numbers_of(model, rng, asked.time_limit)
        rest = rng, asked.time_limit
        return compared(stated(model), criterion, relation, numbers, *rest)
    except SSPError as error:
        return [f"{criterion}, {relation}: {type(error).__name__}: {error}"]


def drawn(seed: int, asked: argparse.Namespace) -> tuple[np.random.Generator, SSP, str, str]:
    """A draw: what is drawn next, the model, the criterion and the relation."""
    rng = np.random.default_rng([seed, 4000])
    relation = str(rng.choice(asked.relations))
    timed = relation in TIMED
    known = [c for c in asked.criteria if not (timed and c.endswith(("discounted", "horizon")))]
    criterion = str(rng.choice(known))
    return rng, drawn_model(rng, str(rng.choice(sorted(SIZES))), asked.states), criterion, relation


def shrunk(seed: int, asked: argparse.Namespace) -> object:
    """The smallest model on which the draw's relation changes the answer."""
    rng, model, criterion, relation = drawn(seed, asked)
    numbers = numbers_of(model, rng, asked.time_limit)

    def fails(case: SSP) -> list[str]:
        again = np.random.default_rng(seed)
        return compared(stated(case), criterion, relation, numbers, again, 5.0)

    return smallest_model(model, fails), numbers


def main(arguments: Sequence[str] | None = None) -> int:
    """Check draws from the command line; 1 if any relation changed an answer."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--states", nargs=2, type=float, default=[100, 3000], help="from, to")
        parser.add_argument("--relations", nargs="+", choices=RELATIONS, default=list(RELATIONS))
        parser.add_argument("--criteria", nargs="+", choices=CRITERIA, default=list(CRITERIA))
        parser.add_argument("--time-limit", type=float, default=30.0, help="of one answer")

    return run(__doc__, check, arguments, count=100, options=options, shrink=shrunk)


if __name__ == "__main__":
    sys.exit(main())
