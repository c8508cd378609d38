"""Occupation programs of random models beside linear programs written from the definitions.

    python tests/campaigns/program_check.py --count 3000 --seed 0
    python tests/campaigns/program_check.py --count 1500 --of after-failing
    python tests/campaigns/program_check.py --count 2000 --of rounded    (hard, tiny, shares)

Models have 2 to 30 states with self-loops, free loops, dead-ends, one start or several, and
outcomes that share a successor; problems are of 15 criteria, with a discount, a horizon, a memory
and up to four limits, on request of fuel, visits and ends that come after failing. In the reference
(`tests/references/combined.py`, plain dictionaries) x counts expected visits of states, and of
accumulated costs where these count; nothing is shared with the library.

Of each draw are compared: the optimum, and what the duals prove of it; what each method that
answers such a problem says, and its certificate; every dual with finite differences of the
reference; one bound moved up and one down; the visits with the exact chain of the randomised
policy, and both policies with rows and objective. Each draw has one change besides: a linear row on
visits, a quadratic, entropy or norm objective, or one action for each state (whole numbers; every
choice of actions on small models). Where few levels of the total cost are told apart, the truth
must lie between the two bounds. Prints what differs, and a table of counts.
"""

import argparse
import itertools
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np

from formulations import (
    EGUBS,
    GUBS,
    ISSPUDE,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostBoundedReach,
    CostBudgetedMaxProb,
    CostLimit,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
    MinProb,
)
from ssp_lp import (
    SSP,
    InfeasibleError,
    Memory,
    ModelError,
    ProductSSP,
    Quantity,
    SSPError,
    certify,
    end_probability,
    evaluate,
    expected_cost,
    failure_probability,
    goal_probability,
    product,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.linear_programming.linear_program import MeasuredRow
from ssp_lp.methods.approaches import refusal
from ssp_lp.options import parse_method
from ssp_lp.policies.policy import Policy
from ssp_lp.programs.occupation_measure import OccupationMeasure
from tests.campaigns.campaign import run, smaller_tables, smallest
from tests.references import combined
from tests.references.combined import Limit, Program, Task
from tests.support.own_criteria import Lateness

FAR = 10**12  # beyond all totals
LONGEST = 12  # steps of a horizon of costs, which the models that count them keep to
ENDS = ("home", "wall", "ditch")
GOAL = frozenset({"home"})
OPTIMUM, CONVEX, WHOLE = 1e-6, 2e-4, 2e-3  # relative differences that are rounding
SAME = 1e-9  # of a quantile's share
STEP = 1e-4  # of a bound, for finite differences
MOST = 50.0  # visits of an action that is open, in integer programs
FEW = 24  # choices of actions that are enumerated
PALETTES = (
    (Fraction("0.1"), Fraction("0.7"), Fraction("2.2")),  # 0.1 + 0.7 + 2.2 = 3
    (Fraction(2.0**0.5), Fraction(3.0**0.5), Fraction(np.pi)),
    (Fraction(1e-9), Fraction(2.0**0.5 * 1e-9), Fraction(3.3)),
    (Fraction(1, 3), Fraction(1, 7), Fraction("2.5")),
)
"""Costs in the place of 1, 2 and 3, in every fourth turn."""

CHANGES = ("row", "quadratic", "entropy", "norm", "one action")


class Asked(NamedTuple):
    """What a criterion may ask besides its limits."""

    level: float
    bound: int
    penalty: float
    give_up: str
    charged: bool
    discount: float | None


class Criterion(NamedTuple):
    """The library's problem and the reference's objective."""

    pose: Callable[..., Any]
    objective: Callable[[Task, Program, Asked], np.ndarray]
    minimised: tuple[str, ...] | None  # parts; None: the reference tells costs apart
    budget: Callable[[Task, Asked], float | None] = lambda task, asked: task.most_failure
    ratio: bool = False
    maximised: bool = False
    gives_up: str = ""  # where a policy may; empty: that may be asked
    charges: bool = False
    discounts: bool = False


def parts(**weights: float) -> Callable[[Task, Program, Asked], np.ndarray]:
    """A weighted sum of parts, as an objective; an underscore stands for a blank."""
    return lambda task, program, asked: np.sum(
        [weight * program.parts[name.replace("_", " ")] for name, weight in weights.items()], axis=0
    )


def worth(charge: Callable[[float, Asked], float]) -> Callable[..., np.ndarray]:
    """What the total cost of a success is charged, as an objective."""
    return lambda task, program, asked: combined.charged(program, lambda c: charge(c, asked))


def patience(cost: np.ndarray) -> np.ndarray:
    """A utility that is used up at 10."""
    return np.maximum(1.0 - cost / 10.0, 0.0)


def least_failure(task: Task, asked: Asked) -> float:
    """The failure that no policy goes below."""
    written = combined.program(task, 0, give_up="attention")
    found = combined.solved(written, written.parts["failure"], [], ratio=False)
    return found or 0  # there always is one


def costly(model: SSP, task: Task, asked: Asked, **beside: Any) -> ConstrainedCost:
    """Fuel as a limit of its own."""
    fuel = {"fuel": CostLimit(task.fuel, asked.penalty)}
    return ConstrainedCost(
        model, task.start, fuel, task.most_failure, asked.discount, asked.give_up, asked.charged,
        **beside,
    )  # fmt: skip


UNLIMITED: Callable[[Task, Asked], float] = lambda task, asked: 1.0  # noqa: E731
COST = parts(cost=1)
CRITERIA = {
    "MCMP": Criterion(
        lambda m, t, n, **k: MCMP(
            m, t.start, t.most_failure, n.discount, n.give_up, n.charged, **k
        ),
        COST, ("cost",), charges=True, discounts=True,
    ),
    "MCMP, least": Criterion(
        lambda m, t, n, **k: MCMP(m, t.start, None, None, n.give_up, n.charged, **k),
        COST, ("cost",), lambda t, n: None, charges=True,
    ),
    "AlphaMCMP": Criterion(
        lambda m, t, n, **k: AlphaMCMP(m, t.start, n.level, n.give_up, n.charged, **k),
        COST, ("cost",), lambda t, n: 1 - n.level * (1 - least_failure(t, n)), charges=True,
    ),
    "ConstrainedCost": Criterion(costly, COST, ("cost",), charges=True, discounts=True),
    "CostBudgetedMaxProb": Criterion(
        lambda m, t, n, **k: CostBudgetedMaxProb(m, t.start, n.bound / 2, n.give_up, **k),
        parts(goal=-1), ("cost",), UNLIMITED, maximised=True,
    ),
    "MinCost": Criterion(
        lambda m, t, n, **k: MinCost(m, t.start, **k),
        COST, ("cost",), lambda t, n: 0.0, gives_up="dead_ends",
    ),
    "FinitePenalty": Criterion(
        lambda m, t, n, **k: FinitePenalty(
            m, t.start, n.penalty, n.discount, n.give_up, charge_failing_step=n.charged, **k
        ),
        lambda t, p, n: p.parts["cost"] + n.penalty * p.parts["failure"],
        ("cost",), UNLIMITED, charges=True, discounts=True,
    ),
    "MaxProb": Criterion(
        lambda m, t, n, **k: MaxProb(m, t.start, **k),
        parts(goal=-1), (), UNLIMITED, maximised=True, gives_up="attention",
    ),
    "MinProb": Criterion(
        lambda m, t, n, **k: MinProb(m, t.start, **k),
        parts(goal=1), (), UNLIMITED, gives_up="attention",
    ),
    "LeastQuantity": Criterion(
        lambda m, t, n, **k: LeastQuantity(
            m, t.start, quantity_of(t, {"fuel": 1.0, "visits s1": 0.5, "end wall": -1.0}),
            t.most_failure, None, n.give_up, n.charged, **k,
        ),
        parts(fuel=1.0, visits_s1=0.5, end_wall=-1.0), ("fuel", "visits s1"), charges=True,
    ),
    "ISSPUDE": Criterion(
        lambda m, t, n, **k: ISSPUDE(m, t.start, **k),
        worth(lambda c, n: float(c)), None, lambda t, n: None, ratio=True, gives_up="attention",
    ),
    "S3P": Criterion(
        lambda m, t, n, **k: S3P(m, t.start, t.most_failure, n.discount, **k),
        worth(lambda c, n: float(c)), None, ratio=True, gives_up="attention", discounts=True,
    ),
    "CostBoundedReach": Criterion(
        lambda m, t, n, **k: CostBoundedReach(m, t.start, n.bound, t.most_failure, **k),
        worth(lambda c, n: -float(c <= n.bound)), None, maximised=True, gives_up="attention",
    ),
    "GUBS": Criterion(
        lambda m, t, n, **k: GUBS(m, t.start, patience, 0.7, **k),
        worth(lambda c, n: -float(patience(np.asarray(float(c)))) - 0.7),
        None, UNLIMITED, maximised=True, gives_up="attention",
    ),
    "EGUBS": Criterion(
        lambda m, t, n, **k: EGUBS(m, t.start, -0.4, 0.7, **k),
        worth(lambda c, n: -float(np.exp(-0.4 * c)) - 0.7),
        None, UNLIMITED, maximised=True, gives_up="attention",
    ),
}  # fmt: skip


LAWS = {
    "CVaR": Criterion(
        lambda m, t, n, **k: CVaR(m, t.start, n.level, t.most_failure, **k),
        worth(lambda c, n: float(c)), None, ratio=True, gives_up="attention",
    ),
    "CostQuantile": Criterion(
        lambda m, t, n, **k: CostQuantile(m, t.start, n.level, t.most_failure, **k),
        worth(lambda c, n: float(c)), None, ratio=True, gives_up="attention",
    ),
}  # fmt: skip
"""Criteria of the law of the total cost, each the best of programs: one for every total."""
OWN = {
    "LeastFuel": Criterion(
        lambda m, t, n, **k: LeastQuantity(
            m, t.start, secondary_cost(t.fuel), t.most_failure, n.discount, n.give_up, n.charged,
            **k,
        ),
        parts(fuel=1), ("fuel",), charges=True, discounts=True,
    ),
    "Lateness": Criterion(
        lambda m, t, n, **k: Lateness(m, t.start, n.bound, t.most_failure, **k),
        worth(lambda c, n: max(float(c) - n.bound, 0.0)), None, ratio=True, gives_up="attention",
    ),
}  # fmt: skip
"""A quantity that may be discounted, and a criterion of a user's own."""


def given_success(task: Task, program: Program, asked: Asked) -> np.ndarray:
    """E[cost; goal] of policies of least failure: what a step costs, times what it leaves."""
    reach: dict[str, Any] = dict.fromkeys(task.goals, Fraction(1))
    for state in task.choices.keys() - task.goals:
        alone = combined.program(task._replace(start={state: Fraction(1)}), 0)
        reach[state] = -combined.solved(alone, -alone.parts["goal"], [], ratio=False)
    steps = [task.choices.get(state, {}).get(action, []) for state, action in program.labels]
    worth = [sum(p * cost * reach[to] for p, to, cost in outs) for outs in steps]
    return np.array(worth, dtype=object) * ~program.failed


HARD = {
    name: CRITERIA[name]
    for name in ("MCMP", "MCMP, least", "AlphaMCMP", "ConstrainedCost", "CostBudgetedMaxProb",
                 "MinCost", "FinitePenalty", "MaxProb", "MinProb")
} | {
    "S3P, least": Criterion(
        lambda m, t, n, **k: S3P(m, t.start, **k),
        given_success, (), lambda t, n: None, ratio=True, gives_up="attention",
    ),
}  # fmt: skip
"""Criteria in fractions, on loops that are hardly left."""
TINY = {name: CRITERIA[name] for name in ("MaxProb", "MCMP", "MinCost")} | {
    "S3P, within": CRITERIA["S3P"]._replace(
        pose=lambda m, t, n, **k: S3P(m, t.start, t.most_failure, **k),
        objective=worth(lambda c, n: c),
    ),
}
"""Criteria in fractions, within limits of 1e-12 to 1e-6."""
SHARES = {
    "AlphaMCMP": CRITERIA["AlphaMCMP"],
    "MCMP, share": CRITERIA["AlphaMCMP"]._replace(
        pose=lambda m, t, n, **k: MCMP(
            m, t.start, give_up=n.give_up, charge_failing_step=n.charged,
            reach_fraction=n.level, **k,
        ),
    ),
    "S3P, share": TINY["S3P, within"]._replace(
        pose=lambda m, t, n, **k: S3P(m, t.start, reach_fraction=n.level, **k),
        budget=CRITERIA["AlphaMCMP"].budget,
    ),
}  # fmt: skip
"""Criteria in fractions that demand a share of a goal that is hardly ever reached."""
EXACT, SMALLEST = 1e-9, 1e-3  # of max(SMALLEST, |value|): the distance from an optimum in fractions
NEAR = Fraction(1, 10**11)  # of the goal's share: policies that are so near the least failure tie
ROUNDING = Fraction(1, 10**14), Fraction(2, 10**15)  # of a budget: relative and absolute
EQUAL = Fraction(2, 10**10)  # of a limit's bound: what lies so near counts as equal to it
KEPT = 1e-12  # of the bound itself: how far a limit may be exceeded
WIDE = 1e-8  # gap of an answer without a note

ALL = CRITERIA | LAWS | OWN | HARD | TINY | SHARES
ROUNDED = ("S3P", "CostBoundedReach", "GUBS", "CVaR", "CostQuantile")
"""Criteria of the total cost, which is rounded where few levels of it are told apart."""
MOST_LEVELS = 5
BETWEEN = 1e-9  # by which the truth may miss the bounds of a rounded answer; relative, of 1 + |it|
METHODS = ("columns", "lp", "game")


def outcomes_of(rng: np.random.Generator, ahead: Sequence[str], anywhere: Sequence[str]) -> list:
    """One action: steps that cost lead ahead, free ones anywhere; successors may repeat."""
    free = rng.random() < 0.3
    count = int(rng.integers(1, 4))
    successors = rng.choice([*(anywhere if free else ahead), *ENDS, "home"], size=count)
    weights = rng.integers(1, 6, size=count)
    return [
        (float(w), str(s), 0 if free else int(rng.integers(1, 4)))
        for w, s in zip(weights / weights.sum(), successors, strict=True)
    ]


def drawn_task(rng: np.random.Generator, *, loops: bool) -> Task:
    """A model of up to 30 states, a start and up to four limits.

    Args:
        rng: what is drawn from.
        loops: whether steps that cost something may lead anywhere; else on, to a later group.
    """
    size = int(
        rng.choice([2, 3, 4, 5, 8, 12, 20, 30], p=[0.1, 0.15, 0.2, 0.2, 0.15, 0.1, 0.06, 0.04])
    )
    live = [f"s{k}" for k in range(size)]
    group = np.sort(rng.integers(0, 3, size=size))
    choices: dict[str, dict[str, list]] = {}
    for k, state in enumerate(live):
        later = [s for s, g in zip(live, group, strict=True) if g > group[k]]
        here = [s for s, g in zip(live, group, strict=True) if g >= group[k]]
        ahead, anywhere = ([*live, state], [*live, state]) if loops else (later, here)
        count = int(rng.integers(1, 4))
        choices[state] = {f"a{j}": outcomes_of(rng, ahead, anywhere) for j in range(count)}
    choices["s0"]["go"] = [(0.6, "home", 2), (0.2, "home", 3), (0.2, "wall", 1)]
    choices |= {end: {} for end in ENDS}
    fuel = {s: {a: float(max(rng.integers(-2, 4), 0)) for a in choices[s]} for s in live}
    start = {"s0": 1.0}
    if (asked := rng.random()) > 0.6:
        start = {"s0": 0.5, "s1": 0.5}
    if asked > 0.9:
        start = {"s1": 0.5, "home": 0.25, "ditch": 0.25}
    limits = tuple(drawn_limit(rng) for _ in range(int(rng.integers(5))))
    budget = None if rng.random() < 0.1 else float(rng.choice([0.1, 0.2, 0.3, 0.5, 1.0]))
    return Task(choices, GOAL, start, fuel, limits, budget)


def going_on(task: Task, rng: np.random.Generator) -> Task:
    """The task with a dead-end in which steps go on and cost, and limits of what happens then."""
    ditch = {"roll": [(1.0, "ditch", 2)], "sink": [(0.5, "bog", 1), (0.5, "wall", 3)]}
    bog = {"rest": [(1.0, "bog", 0)]}
    kinds = "fuel through", "visits wall through", "visits ditch through", "end wall", "end ditch"
    parts = rng.choice(kinds, size=rng.integers(1, 3), replace=False).tolist()
    limits = [Limit({part: 1.0}, "<=", float(rng.choice([0.05, 0.2, 1.0, 2.5]))) for part in parts]
    return task._replace(
        choices={**task.choices, "ditch": ditch, "bog": bog},
        fuel={**task.fuel, "ditch": {"roll": 1.0, "sink": 2.0}},
        limits=(*task.limits[:2], *limits),
    )


def drawn_limit(rng: np.random.Generator) -> Limit:
    """One limit of any kind, that may or may not be kept."""

    def one(*values: float) -> float:
        return float(rng.choice(values))

    seen = f"visits {rng.choice(['s0', 's1', 'wall'])}"
    kinds = (
        Limit({"fuel": 1.0}, "<=", one(0.5, 1, 2, 3)),
        Limit({seen: 1.0}, "<=", one(0.5, 1.0, 1.2, 1.5)),
        Limit({"end wall": 1.0}, ">=", one(0.05, 0.1, 0.2)),
        Limit({"end wall": 1.0}, "<=", one(0.05, 0.1, 0.15)),
        Limit({"end wall": 1.0}, "==", one(0.05, 0.1, 0.2)),
        Limit({"goal": 1.0}, ">=", one(0.3, 0.5, 0.8)),
        Limit({"goal": 1.0}, "<=", one(0.5, 0.8)),
        Limit({"failure": 1.0}, "<=", one(0.2, 0.4)),
        Limit({"cost": 1.0}, "<=", one(1, 2, 4)),
        Limit({"goal": 1.0, "end ditch": 1.0}, ">=", one(0.4, 0.7)),
        Limit({"fuel": 1.0, seen: 0.5, "end wall": -2.0}, "<=", one(0.5, 1.0, 2.0)),
    )
    return kinds[rng.choice(len(kinds))]


def quantity_of(task: Task, weights: dict[str, float]) -> Quantity:
    """The quantity that a limit's parts make."""
    result = Quantity(())
    for part, weight in weights.items():
        kind, _, state = part.removesuffix(" through").partition(" ")
        through = part.endswith(" through")
        made = {
            "fuel": lambda through=through: secondary_cost(task.fuel, through_failure=through),
            "cost": expected_cost,
            "goal": goal_probability,
            "failure": failure_probability,
            "visits": lambda state=state, on=through: visits(state, through_failure=on),
            "end": lambda state=state: end_probability(state),
        }
        result = result + weight * made[kind]()
    return result


class Setting(NamedTuple):
    """What is asked of a model."""

    criterion: str
    asked: Asked
    horizon: int | None
    remembers: bool  # whether the first state was come to again; changes nothing of the optimum


class Draw(NamedTuple):
    """A problem, and its reference: the program and what of it is bounded."""

    name: str
    problem: Any
    task: Task  # on (state, step) under a horizon
    written: Program
    objective: np.ndarray
    criterion: Criterion
    model: Task  # as it was drawn
    setting: Setting

    @property
    def known(self) -> float | None:
        """The reference's optimum."""
        return optimum_of_law(self) if self.name in LAWS else self.optimum(self.task)

    def optimum(self, task: Task, objective: np.ndarray | None = None) -> float | None:
        """The reference's optimum within the limits of a task, as the library states it."""
        objective = self.objective if objective is None else objective
        found = combined.least(task, self.written, objective, ratio=self.criterion.ratio)
        return -found if found is not None and self.criterion.maximised else found


def drawn(
    seed: int, names: Sequence[str] = tuple(CRITERIA), *, after_failing: bool = False
) -> Draw:
    """One draw, of one of some criteria."""
    return posed(*drawn_case(seed, names, after_failing=after_failing))


def drawn_case(
    seed: int, names: Sequence[str] = tuple(CRITERIA), *, after_failing: bool = False
) -> tuple[Task, Setting]:
    """A model, and what is asked of it; limits of what happens after failing where these count."""
    rng = np.random.default_rng([seed, 3000])
    name = names[seed % len(names)]
    criterion = ALL[name]
    horizon = int(rng.integers(2, 4)) if rng.random() < 0.2 else None
    task = drawn_task(rng, loops=criterion.minimised is not None or horizon is not None)
    asked = Asked(
        float(rng.choice([0.3, 0.5, 0.8, 0.95])),
        int(rng.integers(1, 8)),
        float(rng.integers(1, 9)),
        criterion.gives_up or str(rng.choice(["anywhere", "attention", "dead_ends"])),
        criterion.charges and bool(rng.random() < 0.5),
        0.9 if criterion.discounts and rng.random() < 0.2 else None,
    )
    if asked.discount is not None:
        task = task._replace(most_failure=max(0.5, task.most_failure or 0.0))
    remembers = rng.random() < 0.2
    if seed // len(names) % 4 == 3:
        task = with_costs(task, PALETTES[int(rng.integers(len(PALETTES)))])
    if after_failing:
        task = going_on(task, rng)
    return task, Setting(name, asked, horizon, remembers)


def with_costs(task: Task, palette: Sequence[Fraction]) -> Task:
    """The same with other costs in the place of 1, 2 and 3."""
    choices = {
        state: {
            action: [(p, to, palette[int(cost) - 1] if cost else cost) for p, to, cost in outs]
            for action, outs in actions.items()
        }
        for state, actions in task.choices.items()
    }
    return task._replace(choices=choices)


def posed(task: Task, setting: Setting, *, exact: bool = False) -> Draw:
    """The problem that a setting asks of a model, and its reference; in fractions on request."""
    name, asked, horizon, remembers = setting
    criterion, start = ALL[name], task.start
    choices = {
        state: {
            action: [(p, to, float(cost)) for p, to, cost in outs]
            for action, outs in actions.items()
        }
        for state, actions in task.choices.items()
    }
    model = SSP.from_transitions(
        choices, goal=set(GOAL), treat_actionless_as_dead_ends=True,
        state_labels={"wall": ["wall"]},
    )  # fmt: skip
    if remembers:
        model = product(
            model,
            Memory(False, lambda seen, state, action, successor, cost: seen or successor == "s0"),
        )
        start = model.start(start)
    beside: dict[str, Any] = {"constraints": constraints_of(task), "horizon": horizon}
    if name == "S3P":
        beside["cost_cap"] = float(LONGEST)
    problem = criterion.pose(model, task._replace(start=start), asked, **beside)
    own: tuple[Limit, ...] = ()
    if name == "CostBudgetedMaxProb":
        own = (Limit({"cost": 1.0}, "<=", asked.bound / 2),)
    if name == "ConstrainedCost":
        own = (Limit({"fuel": 1.0}, "<=", asked.penalty),)
    if exact:
        task = exactly(task)
        asked = Asked(*(Fraction(v) if isinstance(v, float) else v for v in asked))
    told = task if horizon is None else combined.within_steps(task, horizon)
    told = told._replace(limits=task.limits + own, most_failure=criterion.budget(told, asked))
    horizon = FAR if exact else LONGEST
    written = combined.program(
        told, horizon if criterion.minimised is None else 0, give_up=asked.give_up,
        charged=asked.charged, minimised=criterion.minimised or (), discount=asked.discount or 1,
    )  # fmt: skip
    objective = criterion.objective(told, written, asked)
    return Draw(name, problem, told, written, objective, criterion, task, setting)


def exactly(task: Task) -> Task:
    """The task in fractions: probabilities divided by their sum."""
    choices: dict[str, dict[str, list]] = {}
    for state, actions in task.choices.items():
        choices[state] = {}
        for action, outs in actions.items():
            whole = sum(Fraction(p) for p, _, _ in outs)
            choices[state][action] = [(Fraction(p) / whole, to, Fraction(c)) for p, to, c in outs]
    return task._replace(
        choices=choices,
        start={state: Fraction(share) for state, share in task.start.items()},
        fuel={s: {a: Fraction(paid) for a, paid in us.items()} for s, us in task.fuel.items()},
        limits=tuple(limit._replace(bound=Fraction(limit.bound)) for limit in task.limits),
        most_failure=None if task.most_failure is None else Fraction(task.most_failure),
    )


def hard_case(seed: int) -> tuple[Task, Setting]:
    """Loops of two to five states that are left with 1e-3 to 1e-12 a step, with ties."""
    rng, name = np.random.default_rng([seed, 3003]), list(HARD)[seed % len(HARD)]
    live = [f"s{k}" for k in range(int(rng.choice([2, 2, 3, 3, 3, 4, 4, 5])))]
    choices: dict[str, dict[str, list]] = {}
    for state, ahead in zip(live, [*live[1:], live[0]], strict=True):
        actions = [hard_action(rng, live, state, ahead) for _ in range(int(rng.integers(1, 4)))]
        if rng.random() < 0.35:  # a tie, or the same exits at another speed
            (stay, *leave), speed = actions[0], 2.0 ** -int(rng.integers(0, 12))
            slower = [(p * speed, to, cost) for p, to, cost in leave]
            actions.append([(1.0 - sum(p for p, _, _ in slower), *stay[1:]), *slower])
        choices[state] = {f"a{k}": outs for k, outs in enumerate(actions)}
    choices["s0"]["go"] = [(0.5, "home", 2.0), (0.5, "wall", 1.0)]
    fuel = {s: {a: float(rng.integers(0, 3)) for a in us} for s, us in choices.items()}
    choices |= {end: {} for end in ENDS}
    spent = Limit({"fuel": 1}, "<=", float(rng.choice([1.0, 2.0, 1e3, 1e6, 1e12])))
    budget = float(rng.choice([0.1, 0.5, 0.5 + 1e-6, 1.0]))
    task = Task(choices, GOAL, {"s0": 1.0}, fuel, (spent,) * bool(rng.random() < 0.4), budget)
    criterion = HARD[name]
    where = criterion.gives_up or str(rng.choice(["anywhere", "attention", "dead_ends"]))
    charged = criterion.charges and bool(rng.random() < 0.5)
    asked = Asked(0.5, 4, float(rng.choice([0.5, 10.0, 1e3])), where, charged, None)
    return task, Setting(name, asked, None, False)


def tiny_case(seed: int) -> tuple[Task, Setting]:
    """Limits of 1e-12 to 1e-6 on fuel that spans 15 powers of ten, and on ends."""
    rng, name = np.random.default_rng([seed, 3004]), list(TINY)[seed % len(TINY)]
    task = drawn_task(rng, loops=name != "S3P, within")
    fuel = {
        s: {a: float(a != "go") * float(10.0 ** rng.uniform(-10.0, 5.0)) for a in actions}
        for s, actions in task.choices.items()
    }
    kinds = [("fuel", "<="), ("goal", ">="), ("end ditch", "<="), ("end wall", ">="),
             ("end ditch", "==")]  # fmt: skip
    chosen = [kinds[0], *(kinds[k] for k in rng.integers(0, 5, size=rng.integers(3)))]
    limits = [
        Limit({part: 1}, sense, float(10.0 ** rng.uniform(-12.0, -6.0))) for part, sense in chosen
    ]
    choices = dict(task.choices)
    if name == "MinCost":  # where every end is home, the goal is reached surely
        limits = limits[:1]
        choices = {
            s: {a: [(p, "home" if to in ENDS else to, c) for p, to, c in outs]
                for a, outs in actions.items()}
            for s, actions in choices.items()
        }  # fmt: skip
    where = TINY[name].gives_up or str(rng.choice(["anywhere", "dead_ends"]))
    budget = float(rng.choice([0.5, 0.9, 1.0]))
    task = Task(choices, GOAL, {"s0": 1.0}, fuel, tuple(limits), budget)
    return task, Setting(name, Asked(0.5, 1, 1.0, where, False, None), None, False)


def ladder_case(seed: int) -> tuple[Task, Setting]:
    """Rungs with two or three ways up of chance 1e-5 to 0.5, and a share of the greatest chance."""
    rng, name = np.random.default_rng([seed, 3005]), list(SHARES)[seed % len(SHARES)]
    rungs = [f"s{k}" for k in range(int(rng.integers(1, 7)))]
    choices: dict[str, dict[str, list]] = {end: {} for end in ENDS}
    for rung, above in zip(rungs, [*rungs[1:], "home"], strict=True):
        choices[rung] = {}
        for way in range(int(rng.integers(2, 4))):
            up, cost = float(10.0 ** -rng.uniform(0.3, 5.0)), float(rng.integers(1, 6))
            stays = 0.0 if name == "S3P, share" else float(rng.choice([0.0, 0.0, 0.3]))
            outs = [(up, above, cost), (1.0 - up - stays, "wall", cost), (stays, rung, cost)]
            choices[rung][f"a{way}"] = outs if stays else outs[:2]
    fuel = {s: {a: float(10.0 ** rng.uniform(-3.0, 3.0)) for a in choices[s]} for s in rungs}
    most = float(len(rungs) * 10.0 ** rng.uniform(-1.0, 3.0))
    limits = (Limit({"fuel": 1}, "<=", most),) * bool(rng.random() < 0.4)
    where = SHARES[name].gives_up or str(rng.choice(["anywhere", "dead_ends"]))
    asked = Asked(float(rng.uniform(0.01, 0.99)), 1, 1.0, where, bool(rng.integers(2)), None)
    return Task(choices, GOAL, {"s0": 1.0}, fuel, limits), Setting(name, asked, None, False)


def hard_action(rng: np.random.Generator, live: Sequence[str], state: str, ahead: str) -> list:
    """What stays, and rare exits; now and then a sure step or a coin."""
    kind, cost = rng.random(), float(rng.choice([0.0, 0.1, 0.3, 1.0, 2.0]))
    if kind < 0.12:
        return [(1.0, str(rng.choice([ahead, "home"])), cost)]
    if kind < 0.27:
        return [(0.5, str(rng.choice([*live, *ENDS])), cost) for _ in range(2)]
    ends = (["home"], ["wall"], ["home", "wall"], ["home", "ditch"], [live[-1]])
    exits = [
        (float(10.0 ** -rng.uniform(3.0, 12.0)), end, cost) for end in ends[rng.integers(len(ends))]
    ]
    return [
        (1.0 - sum(p for p, _, _ in exits), str(rng.choice([state, state, ahead])), cost),
        *exits,
    ]


def eased(draw: Draw) -> Task:
    """The task of a draw with all limits wider by what counts as equal to them."""
    budget, (relative, absolute) = draw.task.most_failure, ROUNDING
    if budget is None:
        failure = draw.written.parts["failure"]
        least = combined.solved(draw.written, failure, [], ratio=False)
        budget = least + NEAR * (1 - least)
    limits = tuple(
        each._replace(bound=each.bound * (1 + (EQUAL if each.sense == "<=" else -EQUAL)))
        for each in draw.task.limits
    )
    wider = budget * (1 + relative) + absolute
    if draw.name in SHARES:
        wider = 1 - (1 - budget) * (1 - Fraction(KEPT))
    budget = min(wider, Fraction(1))
    return draw.task._replace(limits=limits, most_failure=budget)


def wrong_hard(draw: Draw, seed: int, tally: Counter[str]) -> Iterator[str]:
    """What differs from the optimum in fractions, by more than rounding of a limit explains."""
    known, easy = draw.optimum(draw.task), draw.optimum(eased(draw))
    try:
        solution = solve(draw.problem)
    except InfeasibleError as error:
        tally["infeasible"] += 1
        if known is not None:
            yield f"refused as infeasible ({error}), the reference has {float(known)!r}"
        return
    if easy is None:
        yield f"{solution.objective!r}, the reference has none"
        return
    if known is None:
        tally["within rounding of a limit"] += 1
        return
    tally["optima"] += 1
    certificate = certify(solution)
    if not certificate.accepted:
        yield f"refused, {certificate.reason}"
    low, high = sorted((float(known), float(easy)))
    room = EXACT * max(SMALLEST, abs(high))
    told = solution.lower_bound, solution.objective
    if solution.upper_bound is not None:
        told = solution.objective, solution.upper_bound
    noted = bool(solution.note)
    if not (told[0] - room <= high and low <= told[1] + room):
        yield f"the truth {float(known)!r} does not lie in {told!r}"
    if not (low - room <= solution.objective <= high + room or noted):
        yield f"{solution.objective!r} for {float(known)!r}"
    if solution.gap > WIDE and not noted:
        yield f"gap {solution.gap:.1e} without a note"
    demanded = 0.0 if draw.task.most_failure is None else float(1 - draw.task.most_failure)
    if solution.evaluation.limited_goal < demanded * (1.0 - KEPT):
        yield f"reaches the goal with {solution.evaluation.limited_goal!r} of {demanded!r}"
    for condition in draw.problem.conditions:
        for row in condition.rows:
            spent = row.activity(solution.secondary_costs[condition.name])
            if spent > row.bound + KEPT * abs(row.bound):
                yield f"{row.name} is {spent!r} for {row.bound!r}"
    if (
        not 0.0 <= solution.goal_probability <= 1.0
        or not 0.0 <= solution.failure_probability <= 1.0
    ):
        yield f"no probabilities: {solution.goal_probability!r}, {solution.failure_probability!r}"


def rounded_case(seed: int) -> tuple[Task, Setting]:
    """A model of real costs, and a criterion of the total cost."""
    task, setting = drawn_case(seed, ROUNDED)
    task = task._replace(limits=task.limits[:1], most_failure=0.5)
    return with_costs(task, PALETTES[seed // len(ROUNDED) % len(PALETTES)]), setting


def wrong_rounded(draw: Draw, seed: int, tally: Counter[str]) -> Iterator[str]:
    """Whether the truth lies between the bounds of an answer on few levels of the total cost."""
    rng = np.random.default_rng([seed, 3002])
    known = draw.known
    levels = int(rng.integers(2, MOST_LEVELS + 1))
    capped = {"cost_cap": None} if draw.name == "S3P" else {}
    try:
        solution = solve(replace(draw.problem, cost_levels=levels, **capped))
    except InfeasibleError:
        tally["infeasible"] += 1
        if known is not None:
            yield f"refused as infeasible, the reference has {known!r}"
        return
    tally["rounded" if solution.gap > BETWEEN else "not rounded"] += 1
    if known is None:
        yield f"{solution.objective!r}, the reference has nothing"
        return
    low, high = solution.lower_bound, solution.objective
    if solution.upper_bound is not None:
        low, high = solution.objective, solution.upper_bound
    room = BETWEEN * (1.0 + abs(known))
    if not low - room <= known <= high + room:
        yield f"{known!r} does not lie in [{low!r}, {high!r}]; {solution.note}"


def optimum_of_law(draw: Draw) -> float | None:
    """The least tail mean or quantile of the total cost given success: of all totals' programs."""
    level, least = draw.setting.asked.level, float("inf")
    for total in sorted({cost for here in draw.written.arrivals for _, cost in here}):
        if total >= least:
            break  # no tail's mean lies below its threshold
        late = combined.charged(
            draw.written, lambda c, z=total: float(max(c - z, 0)) / (1.0 - level)
        )
        if draw.name == "CostQuantile":
            late = combined.charged(draw.written, lambda c, z=total: float(c > z))
        found = draw.optimum(draw.task, late)
        if found is None:
            return None
        if draw.name == "CVaR":
            least = min(least, float(total) + found)
        elif found <= 1.0 - level + SAME:
            return float(total)
    return None if least == float("inf") else least


def smaller(case: tuple[Task, Setting]) -> Iterator[tuple[Task, Setting]]:
    """The same with a limit, a memory, a horizon or a discount less, or a smaller model."""
    task, setting = case
    for k in range(len(task.limits)):
        yield task._replace(limits=task.limits[:k] + task.limits[k + 1 :]), setting
    if setting.remembers:
        yield task, setting._replace(remembers=False)
    if setting.horizon is not None:
        yield task, setting._replace(horizon=None)
    if setting.asked.discount is not None:
        yield task, setting._replace(asked=setting.asked._replace(discount=None))
    for table in smaller_tables(task.choices, kept=["s0"]):
        left = {s: {a: task.fuel[s][a] for a in table[s]} for s in task.fuel}
        yield task._replace(choices=table, fuel=left), setting


def constraints_of(task: Task) -> dict[str, Any]:
    """The limits of a task as constraints, by name."""
    made = {}
    for number, limit in enumerate(task.limits):
        quantity = quantity_of(task, dict(limit.weights))
        compared = {"<=": quantity.__le__, ">=": quantity.__ge__, "==": quantity.__eq__}
        made[f"limit {number}"] = compared[limit.sense](limit.bound)
    return made


def moved(task: Task, row: MeasuredRow, by: float) -> Task | None:
    """The task with another bound of a row, looser where ``by`` > 0; None: it is not the task's."""
    if row.name == "failure" and task.most_failure == row.bound:
        return task._replace(most_failure=min(row.bound + by, 1.0))
    kind, _, number = row.name.partition(" ")
    if kind != "limit" or not number.isdigit() or task.limits[int(number)].sense == "==":
        return None
    limits = list(task.limits)
    limit = limits[int(number)]
    sign = 1.0 if limit.sense == "<=" else -1.0
    limits[int(number)] = limit._replace(bound=limit.bound + sign * by)
    return task._replace(limits=tuple(limits))


def differs(value: float, known: float, room: float) -> bool:
    """Whether two numbers differ by more than rounding."""
    return not abs(value - known) <= room * (1.0 + abs(known))


def check(seed: int, tally: Counter[str]) -> Iterator[str]:
    """Compare the draw of a seed; yield what differs."""
    yield from compared_draw(drawn(seed), seed, tally)


def compared_draw(draw: Draw, seed: int, tally: Counter[str]) -> Iterator[str]:
    """Compare one draw; yield what differs."""
    if draw.name in LAWS:
        yield from wrong_law(draw, tally)
        return
    known = draw.optimum(draw.task)
    try:
        program = draw.problem.program()
        measure = program.solve()
    except InfeasibleError:
        tally["infeasible"] += 1
        if known is not None:
            yield f"refused as infeasible, the reference has {known!r}"
        return
    if known is None:
        yield f"optimum {measure.objective!r}, the reference has none"
        return
    tally["optima"] += 1
    if differs(measure.objective, known, OPTIMUM) or measure.residual > OPTIMUM:
        yield f"optimum {measure.objective!r} (residual {measure.residual:.0e}) for {known!r}"
        return
    proved = measure.optimal_value_from_dual
    if proved is None or differs(proved, known, OPTIMUM):
        yield f"the duals prove {proved!r} for {known!r}"
    yield from wrong_methods(draw, known, tally)
    yield from wrong_duals(draw, measure, known, tally)
    yield from wrong_visits(draw, measure, tally)
    yield from wrong_policies(draw, measure, tally)
    yield from wrong_bounds(draw, measure, tally, np.random.default_rng([seed, 3001]))
    if isinstance(draw.problem.model, ProductSSP):  # to wander there takes another round
        return
    yield from CHANGED[seed // len(CRITERIA) % len(CHANGES)](draw, measure, known, tally)


def wrong_law(draw: Draw, tally: Counter[str]) -> Iterator[str]:
    """What differs of a draw that is no program's optimum."""
    known = optimum_of_law(draw)
    try:
        solve(draw.problem)
    except InfeasibleError:
        tally["infeasible"] += 1
        if known is not None:
            yield f"refused as infeasible, the reference has {known!r}"
        return
    if known is None:
        yield "solved, where the reference has nothing"
        return
    tally["optima"] += 1
    yield from wrong_methods(draw, known, tally)


def wrong_methods(draw: Draw, known: float, tally: Counter[str]) -> Iterator[str]:
    """What each method that answers such a problem says of it, and what is certified."""
    for method in METHODS:
        if refusal(draw.problem, parse_method(method)) is not None:
            continue
        try:
            solution = solve(draw.problem, method)
        except ModelError as error:  # of a program of totals without end, say
            if method == "columns":
                yield f"refused: {error}"
            continue
        tally[f"solved by {method}"] += 1
        tally["priced"] += any(p > 0.0 for n, p in solution.prices.items() if n != "failure")
        ends = solution.lower_bound, solution.objective
        if solution.upper_bound is not None:
            ends = solution.objective, solution.upper_bound
        room = OPTIMUM * (1.0 + abs(known))
        if not ends[0] - room <= known <= ends[1] + room:
            yield f"{method}: {known!r} does not lie in {ends!r}"
        if differs(solution.objective, known, max(OPTIMUM, 2.0 * solution.gap)):
            yield f"{method}: {solution.objective!r} for {known!r}"
        certificate = certify(solution)
        if not certificate.accepted:
            yield f"{method}: refused, {certificate.reason}"


def wrong_duals(
    draw: Draw, measure: OccupationMeasure, known: float, tally: Counter[str]
) -> Iterator[str]:
    """Each dual against finite differences: a subgradient of what the reference says."""
    sign = -1.0 if draw.criterion.maximised else 1.0
    for row in measure.rows:
        step = STEP * max(abs(row.bound), 1.0)
        more, less = moved(draw.task, row, step), moved(draw.task, row, -step)
        if (
            more is None
            or less is None
            or row.dual is None
            or row.bound + step > 1.0 == (row.name == "failure")
        ):
            continue
        above, below = draw.optimum(more), draw.optimum(less)
        if above is None:
            continue
        least = sign * (known - above) / step
        most = np.inf if below is None else sign * (below - known) / step
        room = 1e-4 + 3e-3 * (1.0 + abs(row.dual))
        tally["duals"] += 1
        if not least - room <= row.dual <= most + room:
            yield f"dual of {row.name} {row.dual!r}, differences {least!r} and {most!r}"


def chain_visits(
    draw: Draw, policy: Policy, measure: OccupationMeasure
) -> Counter[tuple[str, str]]:
    """Expected visits of each (state, action) of a policy, on its own chain of (state, memory)."""
    program, model = measure.program, policy.model
    open_state = [bool(program.columns(state)) for state in model.states]
    start = {}
    for state in np.flatnonzero(program.augmented.start).tolist():
        if open_state[state]:
            memory = int(policy.start_memory(np.array([state]))[0])
            start[state, memory] = float(program.augmented.start[state])
    ahead, rows, columns, data, taken = list(start), [], [], [], []
    place = {where: k for k, where in enumerate(ahead)}
    discount = getattr(draw.problem, "discount", None) or 1.0
    while ahead:
        state, memory = ahead.pop()
        here = place[state, memory]
        found = policy.branches(np.array([state]), np.array([memory]))
        for pair, chance in zip(found.pair.tolist(), found.probability.tolist(), strict=True):
            if pair < 0 or chance == 0.0:
                continue
            taken.append((here, pair, chance))
            first, last = model.outcome_offsets[pair : pair + 2].tolist()
            for k in range(first, last):
                successor, p = int(model.successors[k]), float(model.probabilities[k])
                if p == 0.0 or not open_state[successor]:
                    continue
                after = int(
                    policy.remember(
                        *(np.array([v]) for v in (memory, pair, successor, model.costs[k]))
                    )[0]
                )
                if (successor, after) not in place:
                    place[successor, after] = len(place)
                    ahead.append((successor, after))
                rows.append(place[successor, after])
                columns.append(here)
                data.append(discount * p * chance)
    matrix = np.eye(len(place))
    np.subtract.at(matrix, (rows, columns), data)
    begun = np.zeros(len(place))
    for where, share in start.items():
        begun[place[where]] = share
    often = np.linalg.solve(matrix, begun) if len(place) else begun
    counted: Counter[tuple[str, str]] = Counter()
    for here, pair, chance in taken:
        state = model.states[int(model.pair_state[pair])]
        counted[base(state), str(model.action_of(pair))] += often[here] * chance
    return counted


def base(state: Any) -> str:
    """The state of the model that a state with steps or a memory stands for."""
    while isinstance(state, tuple):
        state = state[0]
    return str(state)


def wrong_visits(draw: Draw, measure: OccupationMeasure, tally: Counter[str]) -> Iterator[str]:
    """The measure's visits of each action against the chain of the randomised policy."""
    program = measure.program
    chain = chain_visits(draw, measure.randomised_policy(), measure)
    acting = {(base(s), a) for s in program.augmented.model.states for a in actions_of(draw, s)}
    tally["visits"] += 1
    for state, action in sorted(acting):
        told = float(program.visits(state, action) @ measure.visits)
        if differs(told, chain[state, action], OPTIMUM):
            yield f"visits of ({state}, {action}) {told!r}, on the chain {chain[state, action]!r}"
            return


def actions_of(draw: Draw, state: Any) -> list[str]:
    """Actions of a state of the original model that have columns."""
    return [
        a for (s, a) in set(draw.written.labels) if s == base(state) and a.startswith(("a", "go"))
    ]


def wrong_policies(draw: Draw, measure: OccupationMeasure, tally: Counter[str]) -> Iterator[str]:
    """Both policies, evaluated on the model: objective, and every limit."""
    for policy in (measure.mixed_policy(), measure.randomised_policy()):
        tally["policies"] += 1
        found = evaluate(policy, draw.problem)
        if differs(found.objective, measure.objective, OPTIMUM):
            yield f"a policy attains {found.objective!r}, the program {measure.objective!r}"
        for condition in draw.problem.conditions:
            spent = found.secondary_costs[condition.name]
            for row in condition.rows:
                if row.activity(spent) > row.bound + 1e-7 * (1.0 + abs(row.bound)):
                    yield f"{row.name} is {row.activity(spent)!r} for {row.bound!r}"


def wrong_bounds(
    draw: Draw, measure: OccupationMeasure, tally: Counter[str], rng: np.random.Generator
) -> Iterator[str]:
    """One bound moved up and down: by the problem, and as a parameter of cvxpy."""
    rows = [r for r in measure.rows if moved(draw.task, r, 0.0) is not None]
    if not rows:
        return
    row = rows[rng.integers(len(rows))]
    for share in (0.15, -0.15):
        by = share * max(abs(row.bound), 0.2)
        if row.name == "failure" and not 0.0 < row.bound + by <= 1.0:
            continue
        task = moved(draw.task, row, by)
        if task is None:
            continue
        known, tally["moved"] = draw.optimum(task), tally["moved"] + 1
        answers: list[Callable[[], OccupationMeasure]] = [
            lambda by=by: measure.program.bounded_by({row.name: row.bound + by}).solve(),
            lambda by=by: measure.program.to_cvxpy().solve(
                cp.CLARABEL, **{row.name: row.bound + by}
            ),
        ]
        for answer, room in zip(answers, (OPTIMUM, CONVEX), strict=True):
            try:
                value: float | None = answer().objective
            except InfeasibleError:
                value = None
            both = value is not None and known is not None
            if differs(value, known, room) if both else value != known:
                yield f"{row.name} moved by {by!r}: {value!r} for {known!r}"


def seen_states(draw: Draw, measure: OccupationMeasure) -> list[str]:
    """States whose visits a change counts: up to four that are visited."""
    known = {s for s, _ in draw.written.labels if s.startswith("s") and s != combined.SOURCE}
    often = {s: times_seen(measure, s) for s in sorted(known)}
    return [s for s, times in often.items() if times > 1e-3][:4]


def times_seen(measure: OccupationMeasure, state: str) -> float:
    """What the library counts as visits of a state."""
    coefficients, constant = measure.program.expression(visits(state))
    return float(coefficients @ measure.visits) + constant


def with_row(
    draw: Draw, measure: OccupationMeasure, known: float, tally: Counter[str]
) -> Iterator[str]:
    """A row on visits of a state, tighter than the optimum."""
    for state in seen_states(draw, measure)[:1]:
        bound = 0.9 * times_seen(measure, state)
        own = Limit({f"visits {state}": 1.0}, "<=", bound)
        best = draw.optimum(draw.task._replace(limits=(*draw.task.limits, own)))
        convex = measure.program.to_cvxpy()
        convex.constraints["own"] = convex.expression(visits(state)) <= bound
        tally["row"] += 1
        yield from compared(draw, convex, best, lambda m: m.objective, "with a row")


def with_convex(kind: str) -> Callable[..., Iterator[str]]:
    """An objective that is not linear: a quadratic, entropy or norm of visits beside its own."""

    def change(
        draw: Draw, measure: OccupationMeasure, known: float, tally: Counter[str]
    ) -> Iterator[str]:
        states = seen_states(draw, measure)
        chosen = "norm" if draw.criterion.ratio else kind  # of a ratio only what scales with it
        convex = measure.program.to_cvxpy()
        counted = [convex.expression(visits(state)) for state in states]
        scaled = [getattr(each, "scaled", each) for each in counted]
        if not states:
            return
        made = {
            "quadratic": cp.sum_squares,
            "entropy": lambda v: -cp.sum(cp.entr(v)),
            "norm": cp.norm2,
        }
        convex.objective = convex.objective + made[chosen](cp.hstack(scaled))
        written, task = draw.written, draw.task
        x = cp.Variable(len(draw.objective), nonneg=True)
        t = cp.Variable(nonneg=True) if draw.criterion.ratio else 1.0
        rows = [written.balance @ x == written.start * t]
        if draw.criterion.ratio:
            rows.append(written.parts["goal"] @ x == 1.0)
        for limit in reference_limits(draw, task):
            rows.append(limit[0] @ x <= limit[1] * t)
        own = cp.hstack([written.parts[f"visits {state}"] @ x for state in states])
        aim = cp.Minimize(draw.objective @ x + made[chosen](own))
        problem = cp.Problem(aim, rows)
        try:
            problem.solve(cp.CLARABEL)
        except cp.SolverError:
            tally["without a reference"] += 1
            return
        tally[chosen] += 1
        stated = program_cost(measure) - (-known if draw.criterion.maximised else known)
        solved = problem.status in ("optimal", "optimal_inaccurate")
        best = float(problem.value) + stated if solved else None
        yield from compared(draw, convex, best, lambda m: m.minimised, f"with a {chosen}")

    return change


def program_cost(measure: OccupationMeasure) -> float:
    """What the program minimises at a measure, constants of its own included."""
    process = measure.program.process
    reached = float(process.goal @ measure.visits) if measure.program.ratio else 1.0
    return float(process.cost @ measure.visits) / reached


def reference_limits(draw: Draw, task: Task) -> Iterator[tuple[np.ndarray, float]]:
    """Rows of the reference, ``<row, x> <= bound``."""
    written = draw.written
    if task.most_failure is None:
        failure = combined.solved(written, written.parts["failure"], [], ratio=False)
        yield written.parts["failure"], failure + 1e-9
    elif task.most_failure < 1.0:
        yield written.parts["failure"], task.most_failure
    for limit in task.limits:
        row = np.sum([w * written.parts[part] for part, w in limit.weights.items()], axis=0)
        if limit.sense != ">=":
            yield row, limit.bound
        if limit.sense != "<=":
            yield -row, -limit.bound


def one_action(
    draw: Draw, measure: OccupationMeasure, known: float, tally: Counter[str]
) -> Iterator[str]:
    """One action for each state, by whole numbers; every choice of actions by the reference."""
    labels = draw.written.labels
    acting: dict[str, list[str]] = {}
    for state, action in dict.fromkeys(labels):
        if state not in (combined.SOURCE,) and action not in (combined.STOP, "begin"):
            acting.setdefault(state, []).append(action)
    choices = [[(s, a) for a in actions] for s, actions in acting.items() if len(actions) > 1]
    # with the label of failing, giving up has names of its own for what is done then
    labelled = draw.problem.unrolled.model.failure_label is not None
    if labelled or not choices or np.prod([len(c) for c in choices]) > FEW:
        yield from with_row(draw, measure, known, tally)
        return
    convex, program = measure.program.to_cvxpy(), measure.program
    for state, actions in acting.items():
        if len(actions) < 2:
            continue
        opened = cp.Variable(len(actions), boolean=True)
        convex.constraints[f"one {state}"] = cp.sum(opened) == 1
        for k, action in enumerate(actions):
            if program.columns(state, action):
                often = convex.visits(state, action)
                room = MOST * opened[k]
                made = often.scaled <= room if draw.criterion.ratio else often <= room
                convex.constraints[f"{state} {action}"] = made
    best = None
    for chosen in itertools.product(*choices):
        closed = {pair for each in choices for pair in each} - set(chosen)
        value = enumerated(draw, closed)
        best = value if best is None or (value is not None and value < best) else best
    tally["one action"] += 1
    sign = -1.0 if draw.criterion.maximised else 1.0
    best = None if best is None else sign * best
    solver = getattr(cp, "HIGHS", cp.SCIPY)  # which older versions of cvxpy have
    yield from compared(draw, convex, best, lambda m: m.objective, "with one action", solver, WHOLE)


def enumerated(draw: Draw, closed: set[tuple[str, str]]) -> float | None:
    """The least objective without some actions, each other one taken ``MOST`` times at most."""
    labels = draw.written.labels
    limits = list(reference_limits(draw, draw.task))
    told = ~draw.written.failed  # what is done after failing is nobody's choice of an action
    beyond = np.array([float(label in closed) for label in labels])
    limits.append((beyond * told, 0.0))
    for label in set(labels):
        if label[1] not in (combined.STOP, "begin"):
            limits.append((np.array([float(each == label) for each in labels]) * told, MOST))
    if draw.criterion.ratio:  # what is open is bounded where the goal's probability is 1
        limits = limits[
            : -len({label for label in labels if label[1] not in (combined.STOP, "begin")})
        ]
    return combined.solved(draw.written, draw.objective, limits, ratio=draw.criterion.ratio)


def compared(
    draw: Draw,
    convex: Any,
    best: float | None,
    value_of: Callable[[OccupationMeasure], Any],
    told: str,
    solver: str = cp.CLARABEL,
    room: float = CONVEX,
) -> Iterator[str]:
    """A changed program beside the reference's optimum."""
    try:
        measure = convex.solve(solver)
    except InfeasibleError:
        if best is not None:
            yield f"{told}: refused as infeasible, the reference has {best!r}"
        return
    except SSPError as error:
        if "circulate for ever" in str(error):  # of a state that the start does not lead to
            return
        if best is not None:
            yield f"{told}: {type(error).__name__}: {error}, the reference has {best!r}"
        return
    value = value_of(measure)
    if best is None or (differs(value, best, room) and measure.beyond < 1e-9):
        yield f"{told}: {value!r} for {best!r}"
    proved = measure.optimal_value_from_dual
    if told == "with a row" and proved is not None and differs(proved, value, CONVEX):
        yield f"{told}: the duals prove {proved!r} of {value!r}"


CHANGED: tuple[Callable[..., Iterator[str]], ...] = (
    with_row, with_convex("quadratic"), with_convex("entropy"), with_convex("norm"), one_action,
)  # fmt: skip


def told(
    draw: Draw, seed: int, tally: Counter[str], compare: Callable = compared_draw
) -> list[str]:
    """What differs of a draw; an error of the library, too."""
    real = any(
        c != int(c) for us in draw.model.choices.values() for o in us.values() for *_, c in o
    )
    horizon, memory, discount = (
        draw.setting.horizon,
        draw.setting.remembers,
        draw.setting.asked.discount,
    )
    asked = {"limits": draw.model.limits, "real costs": real, "horizon": horizon,
             "discount": discount, "memory": memory}  # fmt: skip
    tally["with " + (", ".join(name for name, there in asked.items() if there) or "nothing")] += 1
    try:
        return [f"{draw.name}: {said}" for said in compare(draw, seed, tally)]
    except SSPError as error:
        return [f"{draw.name}: {type(error).__name__}: {error}"]


KINDS = {
    "answers": compared_draw,
    "after-failing": compared_draw,
    "rounded": wrong_rounded,
    "hard": wrong_hard,
    "tiny": wrong_hard,
    "shares": wrong_hard,
}
"""What a campaign draws, and how it is compared."""
DRAWS = {"rounded": rounded_case, "hard": hard_case, "tiny": tiny_case, "shares": ladder_case}
EXACTLY = ("hard", "tiny", "shares")


def wrong_of(kind: str, seed: int, tally: Counter[str]) -> list[str]:
    """What differs of a draw of a kind with draws of its own."""
    return told(posed(*DRAWS[kind](seed), exact=kind in EXACTLY), seed, tally, KINDS[kind])


def main(arguments: Sequence[str] | None = None) -> int:
    """Check draws from the command line; 1 if anything differs."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--criteria", nargs="+", choices=CRITERIA | LAWS, default=[*CRITERIA])
        parser.add_argument("--of", choices=KINDS, default="answers", help="what is drawn")

    def case(seed: int, asked: argparse.Namespace) -> tuple[Task, Setting]:
        if asked.of in DRAWS:
            return DRAWS[asked.of](seed)
        return drawn_case(seed, asked.criteria, after_failing=asked.of == "after-failing")

    def wrong(
        one: tuple[Task, Setting], seed: int, tally: Counter[str], asked: argparse.Namespace
    ) -> list[str]:
        return told(posed(*one, exact=asked.of in EXACTLY), seed, tally, KINDS[asked.of])

    def shrunk(seed: int, asked: argparse.Namespace) -> str:
        def fails(one: tuple[Task, Setting]) -> bool:
            try:
                return bool(wrong(one, seed, Counter(), asked))
            except SSPError:
                return False  # it says what is wrong with the question

        return "\n".join(map(str, smallest(case(seed, asked), smaller, fails)))

    return run(
        __doc__,
        lambda seed, tally, asked: wrong(case(seed, asked), seed, tally, asked),
        arguments, count=300, options=options, shrink=shrunk,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
