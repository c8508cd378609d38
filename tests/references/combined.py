"""Criteria of the total cost with further limits: one linear program written from the definitions.

States are (state, cost paid), the cost counted one by one up to a horizon and not beyond; a policy
moves, or stops where the goal can be avoided for sure (anywhere, if asked). Everything is plain
dictionaries and one call of scipy: nothing is shared with the library.
"""

from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array

Number = int | Fraction

Choices = Mapping[str, Mapping[str, list[tuple[float, str, Number]]]]
"""State -> action -> [(probability, successor, exact cost)]; states without actions are ends."""

STOP = "stop"


class Task(NamedTuple):
    """A model with its start, and what of it is limited."""

    choices: Choices
    goals: frozenset[str]
    start: Mapping[str, float]
    fuel: Mapping[str, Mapping[str, float]]  # a secondary cost
    most_fuel: float = np.inf
    watched: str = ""  # a live state
    most_visits: float = np.inf
    least_end: tuple[str, float] = ("", 0.0)  # a final state, and its least probability
    most_end: tuple[str, float] = ("", 1.0)
    most_failure: float = 1.0
    most_cost: float = np.inf


def dead_ends(task: Task) -> set[str]:
    """States from which the goal cannot be reached."""
    hopeful = set(task.goals)
    while True:
        more = {
            s
            for s, actions in task.choices.items()
            if any(p > 0 and t in hopeful for outs in actions.values() for p, t, _ in outs)
        }
        if more <= hopeful:
            return set(task.choices) - hopeful
        hopeful |= more


def avoiding(task: Task) -> set[str]:
    """Live states in which some policy surely avoids the goal."""
    found, dead = set(task.choices) - task.goals, dead_ends(task)
    while True:
        kept = {
            s
            for s in found
            if s in dead
            or any(
                all(t in found for p, t, _ in outs if p > 0) for outs in task.choices[s].values()
            )
        }
        if kept == found:
            return found - dead
        found = kept


class Program(NamedTuple):
    """Columns of the visits program with what each takes of every row."""

    balance: csr_array
    start: np.ndarray
    goal: np.ndarray
    failure: np.ndarray
    fuel: np.ndarray
    visits: np.ndarray
    least_end: np.ndarray
    most_end: np.ndarray
    wall: np.ndarray  # steps into the state of that name
    cost: np.ndarray  # of steps
    arrivals: list[list[tuple[float, Number]]]  # per column: probability and total cost at the goal


def places(task: Task, horizon: float, live: list[str]) -> dict[tuple[str, Number], int]:
    """The pairs of a state and a cost paid that can occur, numbered."""
    found = {(state, 0): 0 for state in task.start if state in live}
    ahead = list(found)
    while ahead:
        state, paid = ahead.pop()
        for outs in task.choices[state].values():
            for p, successor, cost in outs:
                there = successor, min(paid + cost, horizon)
                if p > 0 and successor in live and there not in found:
                    found[there] = 0
                    ahead.append(there)
    return {where: number for number, where in enumerate(found)}


def program(task: Task, horizon: float, *, anywhere: bool = False) -> Program:
    """Write the program out, costs told apart below the horizon (0: not at all)."""
    dead, may_stop = dead_ends(task), avoiding(task)
    live = [s for s in task.choices if s not in dead and s not in task.goals]
    place = places(task, horizon, live)
    rows, columns, entries = [], [], []
    parts: dict[str, list[float]] = {name: [] for name in Program._fields[2:10]}
    arrivals: list[list[tuple[float, Number]]] = []
    for (state, paid), row in place.items():
        stops = [(STOP, [])] if anywhere or state in may_stop else []
        for action, outs in [*task.choices[state].items(), *stops]:
            column = len(arrivals)
            rows.append(row), columns.append(column), entries.append(1.0)
            taken = dict.fromkeys(parts, 0.0)
            taken["failure"] = float(action == STOP)
            taken["fuel"] = task.fuel.get(state, {}).get(action, 0.0)
            here = []
            for p, successor, cost in outs:
                total = min(paid + cost, horizon)
                taken["cost"] += p * float(cost)
                taken["visits"] += p * (successor == task.watched)
                taken["least_end"] += p * (successor == task.least_end[0])
                taken["most_end"] += p * (successor == task.most_end[0])
                taken["wall"] += p * (successor == "wall")
                if successor in task.goals:
                    taken["goal"] += p
                    here.append((p, total))
                elif successor in dead:
                    taken["failure"] += p
                elif p > 0:
                    rows.append(place[successor, total])
                    columns.append(column), entries.append(-p)
            arrivals.append(here)
            for name, value in taken.items():
                parts[name].append(value)
    start = np.zeros(len(place))
    for state, share in task.start.items():
        start[place[state, 0]] += share
    shape = len(place), len(arrivals)
    arrays = {name: np.array(values) for name, values in parts.items()}
    return Program(csr_array((entries, (rows, columns)), shape), start, arrivals=arrivals, **arrays)


def charged(written: Program, charge: Callable[[Number], float]) -> np.ndarray:
    """E[charge of the total cost; goal] of each column."""
    return np.array([sum(p * charge(c) for p, c in here) for here in written.arrivals], float)


def least(task: Task, written: Program, objective: np.ndarray, *, ratio: bool) -> float | None:
    """The least objective, or its ratio to the goal probability, within all limits; None: none."""
    begun = task.start.get(task.watched, 0.0)
    limits = [
        (written.failure, task.most_failure),
        (written.fuel, task.most_fuel),
        (written.cost, task.most_cost),
        (written.visits, task.most_visits - begun),
        (-written.least_end, -task.least_end[1]),
        (written.most_end, task.most_end[1]),
    ]
    limits = [(row, bound) for row, bound in limits if np.isfinite(bound)]
    upper = np.array([row for row, _ in limits])
    bounds = np.array([bound for _, bound in limits])
    equal, right = written.balance.toarray(), written.start
    if ratio:  # Charnes and Cooper: visits times t, with goal probability times t equal to 1
        objective = np.append(objective, 0.0)
        upper, bounds = np.hstack([upper, -bounds[:, None]]), np.zeros(len(bounds))
        equal = np.block([[equal, -right[:, None]], [written.goal, 0.0]])
        right = np.append(np.zeros(len(right)), 1.0)
    for presolve in (True, False):  # HiGHS 1.8 takes some bounded programs for unbounded
        options = dict.fromkeys(
            ("primal_feasibility_tolerance", "dual_feasibility_tolerance"), 1e-10
        )
        answer = linprog(
            objective, upper, bounds, equal, right,
            method="highs-ds", options=options | {"presolve": presolve},
        )  # fmt: skip
        if answer.status == 0:
            return float(answer.fun)
        if answer.status == 2:
            return None
    raise AssertionError(answer.message)
