"""Answers on rounded totals enclose the truth: small drawn models, every total told apart.

    python tests/campaigns/rounded_costs_check.py --count 2000

Each model has rational, irrational or mixed costs (1e-6 beside 1e6) and a few states in a row, so
that only finitely many totals occur. The truth is the best lottery of policies of (state, total),
the total an exact fraction, found by backward induction with nothing of the library. The library
may tell only a few totals apart (``cost_levels``), and has to name two bounds with the truth
between them, for each criterion that depends on the total cost.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from formulations import GUBS, S3P, CostBoundedReach, CostQuantile, CVaR
from ssp_lp import SSP, Solution, SSPError, solve
from tests.campaigns.campaign import run, smaller_tables, smallest

ROOM = 1e-9  # relative
STATES = 5  # in a row, before the goal and the pit
LEVELS = 8  # of cost at most that the library may tell apart
BONUS = 0.25

Moves = dict[str, dict[str, list[tuple[float, str, float]]]]


class Palette(NamedTuple):
    """Costs that steps are drawn from."""

    name: str
    costs: tuple[float, ...]


PALETTES = (
    Palette("rational", (0.1, 0.25, 1.0, 1.7, 0.0)),
    Palette("irrational", (2.0**0.5, 3.0**0.5, float(np.pi) / 3.0, float(np.exp(1.0)) / 4.0)),
    Palette("mixed", (1e-6, 2.0**0.5 * 1e-6, 1e6, 3.3, 3e5 * 3.0**0.5)),
)


class Drawn(NamedTuple):
    """A model as the library and as the program sees it."""

    moves: Moves
    model: SSP
    costs: str


class Column(NamedTuple):
    """A deterministic policy of (state, total), by what it makes of a run from the start."""

    objective: float  # in what is minimised
    cost: float
    failure: float
    goal: float


class Totals:
    """All (state, exact total) that can occur, and the best policies on them."""

    def __init__(self, moves: Moves) -> None:
        """Write them out, each before those that it leads to."""
        self._choices: dict[tuple[str, Fraction], list[int]] = {}  # actions, numbered throughout
        self._ahead: list[list[tuple[float, tuple[str, Fraction]]]] = []
        self.arriving: list[dict[Fraction, float]] = []  # of each action: total -> probability
        self.failing: list[float] = []
        waiting: set[tuple[str, Fraction]] = {("s0", Fraction(0))}
        for state, actions in moves.items():  # steps lead on to later states alone
            for here in [place for place in waiting if place[0] == state]:
                numbers = range(len(self.failing), len(self.failing) + len(actions))
                self._choices[here] = list(numbers)
                for outcomes in actions.values():
                    waiting.update(self._write(here[1], outcomes))
        self.goal = np.array([sum(each.values()) for each in self.arriving])
        self.totals = sorted({total for each in self.arriving for total in each})

    def _write(
        self, paid: Fraction, outcomes: list[tuple[float, str, float]]
    ) -> list[tuple[str, Fraction]]:
        """One action at one total; where it leads."""
        arrived, lost, ahead = dict[Fraction, float](), 0.0, []
        for probability, target, cost in outcomes:
            total = paid + Fraction(repr(cost))
            if target == "goal":
                arrived[total] = arrived.get(total, 0.0) + probability
            elif target == "pit":
                lost += probability
            else:
                ahead.append((probability, (target, total)))
        self.arriving.append(arrived)
        self.failing.append(lost)
        self._ahead.append(ahead)
        return [place for _, place in ahead]

    def charged(self, charge: Callable[[float], float]) -> np.ndarray:
        """What each action is charged for arriving, [actions]."""
        return np.array(
            [sum(p * charge(float(total)) for total, p in each.items()) for each in self.arriving]
        )

    def least(self, cost: np.ndarray, budget: float, *, ratio: bool) -> float:
        """The least cost within a budget, or the least per success (Dinkelbach's iteration)."""
        paid, reached, _ = self._within(cost, cost, budget)
        while ratio:
            before = paid / reached
            paid, reached, _ = self._within(cost - before * self.goal, cost, budget)
            if not paid / reached < before * (1.0 - 1e-14):
                return min(before, paid / reached)
        return paid

    def _within(
        self, objective: np.ndarray, cost: np.ndarray, budget: float
    ) -> tuple[float, float, float]:
        """Cost, success and failure of the best lottery, an edge of the lower convex hull."""
        failing = np.array(self.failing)
        outer = self._best(objective, objective, cost)
        if outer.failure <= budget:
            return outer.cost, outer.goal, outer.failure
        inner = self._best(failing, objective, cost)
        while True:
            price = (inner.objective - outer.objective) / (outer.failure - inner.failure)
            found = self._best(objective + price * failing, objective, cost)
            known = inner.objective + price * inner.failure
            room = 1e-14 * (abs(inner.objective) + abs(outer.objective) + abs(known))
            if found.objective + price * found.failure >= known - room:
                break
            inner, outer = (found, outer) if found.failure <= budget else (inner, found)
        share = (budget - inner.failure) / (outer.failure - inner.failure)
        mixed = (1.0 - share) * np.array(inner) + share * np.array(outer)
        return float(mixed[1]), float(mixed[3]), float(mixed[2])

    def _best(self, weights: np.ndarray, objective: np.ndarray, cost: np.ndarray) -> Column:
        """The policy of least weight, by backward induction."""
        figures = np.stack([weights, objective, cost, np.array(self.failing), self.goal], axis=1)
        values: dict[tuple[str, Fraction], np.ndarray] = {}
        for here, actions in reversed(self._choices.items()):
            found = [
                figures[action] + sum(p * values[there] for p, there in self._ahead[action])
                for action in actions
            ]
            values[here] = min(found, key=lambda each: float(each[0]))
        return Column(*values["s0", Fraction(0)][1:].tolist())


def drawn(rng: np.random.Generator) -> Drawn:
    """A model whose steps lead on from state to state, into the goal or into a pit."""
    palette = PALETTES[int(rng.integers(len(PALETTES)))]
    moves: Moves = {}
    for number in range(STATES):
        ahead = [f"s{k}" for k in range(number + 1, STATES)]
        actions = {}
        for action in range(int(rng.integers(2, 4))):
            targets = rng.permutation([*ahead, "goal", "goal", "pit"])[:3].tolist()
            shares = rng.dirichlet(np.ones(len(targets)))
            costs = rng.choice(palette.costs, size=len(targets)).tolist()
            actions[f"a{action}"] = list(zip(shares.tolist(), targets, costs, strict=True))
        if rng.random() < 0.3:
            actions["quit"] = [(1.0, "pit", 0.0)]
        moves[f"s{number}"] = actions
    return Drawn(moves, model_of(moves), palette.name)


def model_of(moves: Moves) -> SSP:
    """The model of some moves."""
    return SSP.from_transitions(
        {**moves, "pit": {}}, goal={"goal"}, treat_actionless_as_dead_ends=True, normalise=True
    )


def questions(rng: np.random.Generator, case: Drawn) -> Iterator[tuple[Solution, float, float]]:
    """Solutions of all criteria on few levels, the truth, and the size of what is measured."""
    program = Totals(case.moves)
    reach = -program.least(-program.goal, 1.0, ratio=False)
    budget = 1.0 - float(rng.uniform(0.2, 0.95)) * reach
    level, levels = float(rng.uniform(0.3, 0.95)), int(rng.integers(2, LEVELS + 1))
    asked = {"failure_budget": budget, "cost_levels": levels}
    largest = float(program.totals[-1])
    yield (
        solve(S3P(case.model, "s0", **asked)),
        program.least(program.charged(lambda total: total), budget, ratio=True),
        largest,
    )
    bound = float(program.totals[int(rng.integers(len(program.totals)))])
    bound *= float(rng.choice([1.0, 1.1]))
    in_time = program.charged(lambda total: float(total <= bound * (1.0 + 1e-12)))
    problem = CostBoundedReach(case.model, "s0", bound, **asked)
    yield solve(problem), -program.least(-in_time, budget, ratio=False), 1.0

    def utility(total: np.ndarray | float) -> np.ndarray | float:
        return 1.0 / (1.0 + total / largest)

    worth = program.charged(lambda total: float(utility(total)) + BONUS)
    gubs = GUBS(case.model, "s0", utility, BONUS, cost_levels=levels)
    yield solve(gubs), -program.least(-worth, 1.0, ratio=False), 1.0
    tail = solve(CVaR(case.model, "s0", level, **asked))
    yield tail, tail_mean(program, level, budget), largest
    yield (
        solve(CostQuantile(case.model, "s0", level, **asked)),
        quantile(program, level, budget),
        0.0,
    )


def tail_mean(program: Totals, level: float, budget: float) -> float:
    """The least conditional value at risk given success, over all thresholds that can be best."""
    best, share = float("inf"), 1.0 - level
    for threshold in map(float, program.totals):
        if threshold >= best:
            break  # no tail's mean lies below its threshold
        charge = program.charged(lambda c, z=threshold: z + max(c - z, 0.0) / share)
        best = min(best, program.least(charge, budget, ratio=True))
    return best


def quantile(program: Totals, level: float, budget: float) -> float:
    """The least total that some policy keeps to with the level's share of its successes."""
    low, high = -1, len(program.totals) - 1
    while high - low > 1:
        middle = (low + high) // 2
        bound = float(program.totals[middle])
        late = program.charged(lambda total, bound=bound: float(total > bound * (1.0 + 1e-12)))
        kept = program.least(late, budget, ratio=True) <= 1.0 - level + 1e-9
        low, high = (low, middle) if kept else (middle, high)
    return float(program.totals[high])


def outside(solution: Solution, truth: float, size: float) -> str:
    """How the truth misses the bounds of a solution; empty if it lies between them."""
    room = ROOM * max(abs(truth), size) + 1e-12
    low, high = solution.lower_bound, solution.objective
    if solution.upper_bound is not None:
        low, high = solution.objective, solution.upper_bound
    if low - room <= truth <= high + room:
        return ""
    return f"{type(solution.problem).__name__}: {truth!r} does not lie in [{low!r}, {high!r}]"


def check(seed: int, tally: Counter[str]) -> list[str]:
    """Draw a model and compare all criteria on it; what is wrong, in words."""
    rng = np.random.default_rng(seed)
    return wrong(rng, drawn(rng), tally)


def wrong(rng: np.random.Generator, case: Drawn, tally: Counter[str]) -> list[str]:
    """Which questions about a model are answered wrongly."""
    found = []
    tally[f"models with {case.costs} costs"] += 1
    try:
        for solution, truth, size in questions(rng, case):
            tally["answers"] += 1
            tally["rounded"] += solution.gap > ROOM
            if told := outside(solution, truth, size):
                found.append(f"{case.costs} costs: {told}; {solution.note}")
    except SSPError as error:
        found.append(f"{case.costs} costs: {type(error).__name__}: {error}")
    return found


def shrunk(seed: int) -> Drawn:
    """The smallest model about which the questions of a seed are answered wrongly."""

    def fails(case: Drawn) -> bool:
        rng = np.random.default_rng(seed)
        drawn(rng)  # the numbers that were drawn before the questions
        try:
            return bool(wrong(rng, case, Counter()))
        except (SSPError, ValueError, ZeroDivisionError):
            return False

    def smaller(case: Drawn) -> Iterator[Drawn]:
        for moves in smaller_tables(case.moves, kept=["s0"]):
            yield Drawn(moves, model_of(moves), case.costs)

    return smallest(drawn(np.random.default_rng(seed)), smaller, fails)


def main(arguments: Sequence[str] | None = None) -> int:
    """Check drawn models from the command line; 1 if any answer was wrong."""
    return run(
        __doc__, lambda seed, tally, _: check(seed, tally), arguments,
        shrink=lambda seed, _: shrunk(seed).moves,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
