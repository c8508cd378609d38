"""Occupation programs of random models beside linear programs written from the definitions.

    python tests/campaigns/program_check.py --count 3000 --seed 0
    python tests/campaigns/program_check.py --count 1500 --after-failing
    python tests/campaigns/program_check.py --count 2000 --rounded

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
    return found or 0.0  # there always is one


def costly(model: SSP, task: Task, asked: Asked, **beside: Any) -> ConstrainedCost:
    """Fuel as a limit of its own."""
    fuel = {"fuel": CostLimit(task.fuel, asked.penalty)}
    return ConstrainedCost(
        model, task.start, fuel, task.most_failure, asked.discount, asked.give_up, asked.charged,
        **beside,
    )  # fmt: skip


UNLIMITED: Callable[[Task, Asked], float] = lambda task, asked: 1.0  # noqa: E731
COST = parts(cost=1.0)
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
        COST, ("cost",), lambda t, n: 1.0 - n.level * (1.0 - least_failure(t, n)), charges=True,
    ),
    "ConstrainedCost": Criterion(costly, COST, ("cost",), charges=True, discounts=True),
    "CostBudgetedMaxProb": Criterion(
        lambda m, t, n, **k: CostBudgetedMaxProb(m, t.start, n.bound / 2, n.give_up, **k),
        parts(goal=-1.0), ("cost",), UNLIMITED, maximised=True,
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
        parts(goal=-1.0), (), UNLIMITED, maximised=True, gives_up="attention",
    ),
    "MinProb": Criterion(
        lambda m, t, n, **k: MinProb(m, t.start, **k),
        parts(goal=1.0), (), UNLIMITED, gives_up="attention",
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

ALL = CRITERIA | LAWS
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


def posed(task: Task, setting: Setting) -> Draw:
    """The problem that a setting asks of a model, and its reference."""
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
    told = task if horizon is None else combined.within_steps(task, horizon)
    told = told._replace(limits=task.limits + own, most_failure=criterion.budget(told, asked))
    written = combined.program(
        told, LONGEST if criterion.minimised is None else 0, give_up=asked.give_up,
        charged=asked.charged, minimised=criterion.minimised or (), discount=asked.discount or 1.0,
    )  # fmt: skip
    objective = criterion.objective(told, written, asked)
    return Draw(name, problem, told, written, objective, criterion, task, setting)


def rounded_case(seed: int) -> tuple[Task, Setting]:
    """A model of real costs, and a criterion of the total cost."""
    task, setting = drawn_case(seed, ROUNDED)
    task = task._replace(limits=task.limits[:1], most_failure=0.5)
    return with_costs(task, PALETTES[seed // len(ROUNDED) % len(PALETTES)]), setting


def wrong_rounded(draw: Draw, seed: int, tally: Counter[str]) -> Iterator[str]:
    """Whether the truth lies between the bounds of an answer on few levels of the total cost."""
    rng = np.random.default_rng([seed, 3002])
    known = optimum_of_law(draw) if draw.name in LAWS else draw.optimum(draw.task)
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
        if "go round for ever" in str(error):  # of a state that the start does not lead to
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Check draws from the command line; 1 if anything differs."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--criteria", nargs="+", choices=ALL, default=list(CRITERIA))
        parser.add_argument("--after-failing", action="store_true", help="limit what comes then")
        parser.add_argument("--rounded", action="store_true", help="few levels of the total cost")

    def case(seed: int, asked: argparse.Namespace) -> tuple[Task, Setting]:
        if asked.rounded:
            return rounded_case(seed)
        return drawn_case(seed, asked.criteria, after_failing=asked.after_failing)

    def wrong(
        one: tuple[Task, Setting], seed: int, tally: Counter[str], asked: argparse.Namespace
    ) -> list[str]:
        return told(posed(*one), seed, tally, wrong_rounded if asked.rounded else compared_draw)

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
