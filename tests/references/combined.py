"""Any criterion with limits of any kind: a linear program written from the definitions.

States are (state, cost paid), the cost counted one by one up to a horizon of costs; a policy moves,
gives up where that is allowed, or stays for ever among steps that add nothing to what is minimised
and limited. After failing, in a dead-end or by giving up, it moves on at no cost, where it cannot
reach the goal, to an end that is asked for or has no steps. Everything is plain dictionaries and
one call of scipy: nothing is shared with the library. Where all numbers of a task are fractions, so
is the program, and its optimum is that of a simplex method in fractions.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from .chain import plain_model
from .linear_program import SHARP
from .simplex import simplex

Number = int | Fraction

Choices = Mapping[str, Mapping[str, list[tuple[float, str, Number]]]]
"""State -> action -> [(probability, successor, exact cost)]; states without actions are ends."""

STOP, SOURCE, FAILED = "stop", "source", "failed"
OVER = "over"  # what ends after failing, a part that no limit has
LEAST_ROOM = 1e-11  # beyond the least failure, where that is asked for


class Limit(NamedTuple):
    """A weighted sum of parts and a constant, and a bound of it.

    A part is "fuel", "cost", "goal", "failure", "visits" of a state, or the "end" in one of them;
    fuel and visits count after failing, too, as "fuel through" and "visits s through".
    """

    weights: Mapping[str, float]
    sense: str  # "<=", ">=" or "=="
    bound: float
    constant: float = 0.0


class Task(NamedTuple):
    """A model with its start, and what of it is limited."""

    choices: Choices
    goals: frozenset[str]
    start: Mapping[str, float]
    fuel: Mapping[str, Mapping[str, float]]  # a secondary cost
    limits: tuple[Limit, ...] = ()
    most_failure: float | None = 1.0  # None: as little as possible


def named(state: str) -> str:
    """The state that a copy of it after so many steps stands for."""
    return state.partition("@")[0]


def within_steps(task: Task, steps: int) -> Task:
    """The task on (state, steps taken), in which nothing goes on after the last step."""
    choices: dict[str, dict[str, list[tuple[float, str, Number]]]] = {
        f"{state}@{taken}": {
            action: [(p, f"{successor}@{taken + 1}", cost) for p, successor, cost in outs]
            for action, outs in actions.items()
            if taken < steps
        }
        for state, actions in task.choices.items()
        for taken in range(steps + 1)
    }
    goals = frozenset(f"{goal}@{taken}" for goal in task.goals for taken in range(steps + 1))
    start = {f"{state}@0": share for state, share in task.start.items()}
    return task._replace(choices=choices, goals=goals, start=start)


def stays(outs: list[tuple[float, str, Number]], states: set[str]) -> bool:
    """Whether all that can happen lies in some states."""
    return all(to in states for p, to, _ in outs if p > 0)


class Program(NamedTuple):
    """Columns of the visits program with what each takes of every part."""

    balance: np.ndarray
    start: np.ndarray
    parts: dict[str, np.ndarray]
    arrivals: list[list[tuple[float, Number]]]  # per column: probability and total cost at the goal
    labels: list[tuple[str, str]]  # per column: the state and the action
    failed: np.ndarray  # per column: whether it is one after failing


def places(
    task: Task, horizon: float, live: list[str], going: set[str]
) -> dict[tuple[str, Number | str], int]:
    """The pairs of a state and a cost paid that can occur, numbered after the source.

    Then the states in which one may be after failing, which have no cost.
    """
    found = {(SOURCE, 0): 0} | {(state, 0): 0 for state in task.start if state in live}
    ahead = list(found)[1:]
    while ahead:
        state, paid = ahead.pop()
        for outs in task.choices[state].values():
            for p, successor, cost in outs:
                there = successor, min(paid + cost, horizon)
                if p > 0 and successor in live and there not in found:
                    found[there] = 0
                    ahead.append(there)
    every = [*found, *((state, FAILED) for state in task.choices if state in going)]
    return {where: number for number, where in enumerate(every)}


def least_paid(task: Task, state: str, actions: Iterable[str]) -> dict[str, float]:
    """The least that some actions of a state take of each cost; nothing where there are none."""
    costs = [
        (
            sum(p * cost for p, _, cost in task.choices[state][action]),
            task.fuel.get(named(state), {}).get(action, 0),
        )
        for action in actions
    ]
    if not costs:
        return {}
    cost, fuel = zip(*costs, strict=True)
    return {"cost": min(cost), "fuel": min(fuel)}


def program(
    task: Task,
    horizon: float,
    *,
    give_up: str = "attention",
    charged: bool = False,
    minimised: Iterable[str] = (),
    discount: float = 1,
) -> Program:
    """Write the program out, costs told apart below the horizon (0: not at all).

    ``charged`` says whether the step that fails is paid, ``minimised`` what the objective counts.
    """
    model = plain_model(task.choices, task.goals)
    dead, avoids = set(model.dead_ends), set(model.attention - model.dead_ends)
    live = [s for s in task.choices if s not in dead and s not in task.goals]
    asked = {part for limit in task.limits for part in limit.weights} | set(minimised)
    ends = {s for s in dead if not task.choices[s] or f"end {named(s)}" in asked}
    place = places(task, horizon, live, (avoids | dead) - ends)
    names = sorted({named(state) for state in task.choices})
    every = ["goal", "failure", "cost", "fuel", "fuel through", OVER]
    every += [f"visits {name}{how}" for name in names for how in ("", " through")]
    every += [f"end {name}" for name in names]
    rows, columns, entries = [], [], []
    taken_by_column: list[Mapping[str, float]] = []
    arrivals: list[list[tuple[float, Number]]] = []
    labels: list[tuple[str, str]] = []
    failed: list[bool] = []
    entering = {
        state: least_paid(task, state, task.choices[state]) if charged else {} for state in dead
    }

    def add(
        where: tuple[str, Number | str],
        taken: Mapping[str, float],
        steps: Mapping[int, float] | None = None,
        here: Sequence = (),
        action: str = STOP,
    ) -> None:
        """One more column."""
        row = place[where]
        labels.append((named(where[0]), action))
        failed.append(where[1] == FAILED)
        led = {t: (t == row) - p for t, p in (steps or {}).items()}
        for at, entry in ({row: 1} | led).items():
            rows.append(at), columns.append(len(arrivals)), entries.append(entry)
        taken_by_column.append(taken)
        arrivals.append(list(here))

    def step(paid: Number | str, outs: list, survival: float) -> tuple[dict, dict, list]:
        """What a step takes of every part, where it leads, and what arrives at the goal."""
        taken: dict[str, float] = defaultdict(int)
        steps: dict[int, float] = defaultdict(int)
        here = []
        for p, to, cost in outs:
            over = to in task.goals or to in ends
            taken[f"end {named(to)}"] += survival * p * over
            taken[f"visits {named(to)} through"] += survival * p
            if paid == FAILED:
                taken[OVER] += p * over
            else:
                taken["cost"] += p * cost
                taken[f"visits {named(to)}"] += survival * p
                taken["failure"] += survival * p * (to in dead)
                for part, charge in entering.get(to, {}).items():
                    taken[part] += survival * p * charge
                if to in ends:  # elsewhere it is paid by going on
                    taken["fuel through"] += survival * p * entering[to].get("fuel", 0)
            if to in task.goals:
                taken["goal"] += survival * p
                here.append((p, min(paid + cost, horizon)))
            if p > 0 and not over:
                failed = paid == FAILED or to in dead
                there = place[to, FAILED if failed else min(paid + cost, horizon)]
                steps[there] += survival * p
        return taken, steps, here

    def fuel_of(state: str, action: str) -> float:
        return task.fuel.get(named(state), {}).get(action, 0)

    for state, paid in place:
        if paid == FAILED:
            for action, outs in task.choices[state].items():
                if state in dead or stays(outs, avoids | dead):
                    taken, steps, here = step(paid, outs, discount)
                    taken["fuel through"] += fuel_of(state, action)
                    add((state, paid), taken, steps, here, action)
            continue
        begins = [(share, s, 0) for s, share in task.start.items()]
        actions = {"begin": begins} if state == SOURCE else task.choices[state]
        for action, outs in actions.items():
            survival = 1 if state == SOURCE else discount
            taken, steps, here = step(paid, outs, survival)
            for part in ("fuel", "fuel through"):
                taken[part] += fuel_of(state, action)
            taken["failure"] += 1 - survival
            add((state, paid), taken, steps, here, action)
        allowed = {"anywhere": True, "attention": state in avoids, "dead_ends": False}
        if state != SOURCE and allowed[give_up]:
            staying = [a for a, outs in actions.items()
                       if give_up == "anywhere" or stays(outs, avoids | dead)]  # fmt: skip
            paid_once = least_paid(task, state, staying) if charged else {}
            taken = {"failure": 1} | paid_once
            onward = {place[state, FAILED]: 1} if state in avoids else {}
            if not onward:
                taken["fuel through"] = taken.get("fuel", 0)
            add((state, paid), taken, onward)
    counted = {part for limit in task.limits for part in limit.weights} | set(minimised)
    counted -= {part for part in every if part.startswith("end") or part in ("goal", "failure")}
    inside = list(place.values())[1:]  # nobody wanders before the start
    for row in wandering(inside, rows, columns, taken_by_column, counted):
        where = list(place)[row]
        add(where, {"failure": int(where[1] != FAILED)})
    parts = {name: _array(t.get(name, 0) for t in taken_by_column) for name in every}
    start = np.zeros(len(place), dtype=int)
    start[0] = 1
    balance = np.zeros((len(place), len(arrivals)), dtype=_array(entries).dtype)
    np.add.at(balance, (rows, columns), entries)
    return Program(balance, start, parts, arrivals, labels, np.array(failed))


def wandering(
    everywhere: Iterable[int],
    rows: list[int],
    columns: list[int],
    taken: list[Mapping[str, float]],
    counted: set[str],
) -> set[int]:
    """Places to which one may come back for ever by steps that add nothing to what is counted.

    A place from which such steps only lead there is none: who goes there is seen on the way.
    """
    reached: dict[int, set[int]] = {}
    home: dict[int, int] = {}
    for row, column in zip(rows, columns, strict=True):  # a column's first row is its own
        home.setdefault(column, row)
        reached.setdefault(column, set()).add(row)
    inside = set(everywhere)
    free = [
        column
        for column in reached
        if reached[column] <= inside
        and not any(taken[column].get(part) for part in (*counted, "goal", "failure", OVER))
    ]
    while True:
        steps = [(home[column], row) for column in free for row in reached[column]]
        ends = np.array(steps, dtype=int).reshape(-1, 2).T
        graph = csr_array((np.ones(len(steps)), ends), shape=2 * (max(home.values()) + 1,))
        _, part_of = connected_components(graph, connection="strong")
        kept = [c for c in free if len({part_of[row] for row in reached[c]}) == 1]
        if len(kept) == len(free):
            return {home[column] for column in free}
        free = kept


def charged(written: Program, charge: Callable[[Number], float]) -> np.ndarray:
    """E[charge of the total cost; goal] of each column."""
    return _array(sum(p * charge(c) for p, c in here) for here in written.arrivals)


def least(task: Task, written: Program, objective: np.ndarray, *, ratio: bool) -> float | None:
    """The least objective, or its ratio to the goal probability, within all limits; None: none."""
    limits = []
    if task.most_failure is None:
        failure = solved(written, written.parts["failure"], [], ratio=False)
        if failure is None:  # some policy always exists
            raise AssertionError("HiGHS calls the program of the least failure infeasible")
        room = 0 if isinstance(failure, Fraction) else LEAST_ROOM
        limits.append((written.parts["failure"], failure + room))
    elif task.most_failure < 1.0:
        limits.append((written.parts["failure"], task.most_failure))
    for limit in task.limits:
        counted = [weight * written.parts[part] for part, weight in limit.weights.items()]
        row = sum(counted, np.zeros(objective.size, dtype=int))
        bound = limit.bound - limit.constant
        if limit.sense != ">=":
            limits.append((row, bound))
        if limit.sense != "<=":
            limits.append((-row, -bound))
    return solved(written, objective, limits, ratio=ratio)


def _array(numbers: Iterable[float]) -> np.ndarray:
    """Numbers as an array; of fractions if one of them is one, else of floats."""
    every = list(numbers)
    exact = any(isinstance(number, Fraction) for number in every)
    return np.array(every, dtype=object if exact else float)


def _exact(numbers: Iterable[float]) -> list[Fraction]:
    return [each if isinstance(each, Fraction) else Fraction(float(each)) for each in numbers]


def solved(
    written: Program,
    objective: np.ndarray,
    limits: list[tuple[np.ndarray, float]],
    *,
    ratio: bool,
) -> float | None:
    """The optimum of the program with further rows; None: there is none."""
    upper = np.array([row for row, _ in limits]).reshape(-1, objective.size)
    bounds = np.array([bound for _, bound in limits])
    equal, right = written.balance, written.start
    if ratio:  # Charnes and Cooper: visits times t, with goal probability times t equal to 1
        objective = np.append(objective, 0)
        upper, bounds = np.hstack([upper, -bounds[:, None]]), np.zeros(len(bounds), dtype=int)
        equal = np.vstack(
            [np.hstack([equal, -right[:, None]]), np.append(written.parts["goal"], 0)]
        )
        right = np.append(np.zeros(len(right), dtype=int), 1)
    if written.balance.dtype == object:
        slack = np.eye(len(bounds), dtype=int)
        equal = np.hstack([equal, np.zeros((len(equal), len(bounds)), dtype=int)])
        rows = [*equal.tolist(), *np.hstack([upper, slack]).tolist()]
        aim = np.append(objective, np.zeros(len(bounds), dtype=int))
        return simplex(_exact(aim), [*map(_exact, rows)], _exact([*right, *bounds]))
    # HiGHS 1.8 takes some bounded programs for unbounded, and some feasible ones for infeasible
    answers = []
    for method, presolve in (("highs-ds", True), ("highs-ds", False), ("highs-ipm", False)):
        options = SHARP | {"presolve": presolve}
        answer = linprog(objective, upper, bounds, equal, right, method=method, options=options)
        if answer.status == 0:
            return float(answer.fun)
        answers.append(answer)
        if [each.status for each in answers].count(2) == 2:
            return None
    raise AssertionError("; ".join(answer.message for answer in answers))
