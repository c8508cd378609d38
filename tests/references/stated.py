"""The optimum of a question as a certificate's file states it: one linear program, by scipy.

Written from the page on the format, in floats and plain loops, signed weights as they stand:
nothing is shared with the library nor with the scripts that check certificates.
"""

import json
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from scipy.optimize import linprog

MOST_STATES = 1000  # with steps taken
LEAST_ROOM = 1e-11  # beyond the least failure, where that is asked for


def optimum(
    lines: Sequence[bytes], most: int = 120, *, whole: bool = False, room: float = 1e-9
) -> float | None:
    """The optimum of the question in the first line, on the states of the others; None: none.

    Where totals count, so many states with totals are told apart; an OverflowError says that these
    are not all, where the whole is asked for. A quantile may be exceeded so much more often.
    """
    question, *states = [json.loads(line) for line in lines[: json.loads(lines[0])["states"] + 1]]
    if question["horizon"] is not None:
        question, states = within_steps(question, states)
    if question["quantile"] is not None:
        return quantile(question, states, whole=whole, room=room)
    if charged := bool(question["charge"]):
        question, states = by_totals(question, states, most, whole=whole)
    n = len(states)
    members = {name: set() for name in ["goal", "out of time", *question["sets"]]}
    for x, state in enumerate(states):
        for name in state["sets"]:
            members[name].add(x)
    actions = [[_action(stated) for stated in state["actions"]] for state in states]
    goal = members["goal"]
    hopeful = set(goal)
    while more := {x for x in set(range(n)) - hopeful
                   if any(y in hopeful for outs, _ in actions[x] for _, y in outs)}:  # fmt: skip
        hopeful |= more
    dead, live = set(range(n)) - hopeful, sorted(hopeful - goal)
    avoiding = set(range(n)) - goal
    while lost := {x for x in avoiding if actions[x]
                   and not any(_within(outs, avoiding) for outs, _ in actions[x])}:  # fmt: skip
        avoiding -= lost

    def charge(some: list) -> np.ndarray:
        """The least of each cost among some actions."""
        is_paid = some and question["charge_failing_step"]
        least = (
            np.min([paid for _, paid in some], axis=0) if is_paid else np.zeros(question["costs"])
        )
        if charged:
            least[-1] = 0.0  # the last of these costs is the charge of a total, which no step pays
        return least

    entering, stops = {x: charge(actions[x]) for x in dead}, dict[int, np.ndarray]()
    for x in live:
        staying = [a for a in actions[x] if _within(a[0], avoiding)]
        where = {"anywhere": actions[x], "attention": staying, "dead_ends": []}[question["give_up"]]
        if where and (question["give_up"] != "attention" or x in avoiding):
            stops[x] = charge(where)
    everything = [question["objective"], *(row["quantity"] for row in question["rows"])]
    counted = [term for quantity in everything for term in quantity["terms"] if Fraction(term[0])]
    costs = {what for _, kind, what in counted if kind == "cost"}
    seen = {x for _, kind, what in counted if kind == "visits" for x in members[what]}
    free = set(live)  # where one can go on for ever without adding to what is counted
    while lost := {
        x for x in free
        if not any(_within(outs, free - seen) and not any(paid[k] for k in costs)
                   for outs, paid in actions[x])
    }:  # fmt: skip
        free -= lost

    gamma = float(Fraction(question["discount"] or "1"))
    free = free if question["discount"] is None else set()
    # a column: where it is taken, where it leads, its mean costs, what fails at once
    columns = [(x, [(gamma * p, y) for p, y in outs], paid, 1.0 - gamma)
               for x in live for outs, paid in actions[x]]  # fmt: skip
    columns += [(x, [], paid, 1.0) for x, paid in stops.items()]
    columns += [(x, [], np.zeros(question["costs"]), 1.0) for x in free]
    start = [(float(Fraction(p)), x) for p, x in question["start"]]
    total = sum(p for p, _ in start)
    start = [(p / total, x) for p, x in start]

    def arriving(outs: list, terms: list) -> float:
        """What a quantity takes of arriving."""
        found = 0.0
        for weight, kind, what in terms:
            for p, y in outs:
                if kind == "cost":
                    found += (
                        float(Fraction(weight)) * p * (entering[y][what] if y in entering else 0.0)
                    )
                else:
                    found += float(Fraction(weight)) * p * (y in members[what])
        return found

    def row(quantity: dict) -> tuple[np.ndarray, float]:
        """What a quantity takes of each column, and at the start."""
        weights = np.zeros(question["costs"])
        for weight, kind, what in quantity["terms"]:
            if kind == "cost":
                weights[what] += float(Fraction(weight))
        takes = [weights @ paid + arriving(outs, quantity["terms"]) for _, outs, paid, _ in columns]
        return np.array(takes), float(Fraction(quantity["constant"])) + arriving(
            start, quantity["terms"]
        )

    balance, begins = np.zeros((len(live), len(columns))), np.zeros(len(live))
    place = {x: i for i, x in enumerate(live)}
    for j, (x, outs, _, _) in enumerate(columns):
        balance[place[x], j] += 1.0
        for p, y in outs:
            if y in place:
                balance[place[y], j] -= p
    for p, x in start:
        if x in place:
            begins[place[x]] += p
    fails = np.array(
        [stops + sum(p for p, y in outs if y in dead) for _, outs, _, stops in columns]
    )
    failed = sum(p for p, x in start if x in dead)

    def least(
        objective: np.ndarray, rows: list[tuple[np.ndarray, float]], at_start: float | None = None
    ) -> float | None:
        """The least of an objective within rows; given success, with what it takes at the start."""
        if not columns:
            is_kept = all(bound >= -1e-9 for _, bound in rows) and (
                at_start is None or failed < 1.0
            )
            return (at_start or 0.0) / (1.0 - failed * (at_start is not None)) if is_kept else None
        failing = fails
        upper = np.array([r for r, _ in rows]) if rows else None
        bounds = np.array([b for _, b in rows]) if rows else None
        equal, right = balance, begins
        if at_start is not None:  # all is scaled so that the goal has probability one
            objective = np.append(objective, at_start)
            upper = None if upper is None else np.column_stack([upper, -bounds])
            bounds = None if bounds is None else np.zeros(len(bounds))
            equal = np.column_stack([equal, -begins])
            equal = np.vstack([equal, np.append(-failing, 1.0 - failed)])
            right = np.append(np.zeros(len(begins)), 1.0)
        for presolve in (True, False):
            answer = linprog(
                objective, upper, bounds, equal, right, method="highs-ds",
                options={"primal_feasibility_tolerance": 1e-10,
                         "dual_feasibility_tolerance": 1e-10, "presolve": presolve},
            )  # fmt: skip
            if answer.status == 0:
                return float(answer.fun)
            if answer.status == 2:
                return None
        raise AssertionError(answer.message)

    rows, budget = [], question["failure"]
    if budget is not None:
        allowed = float(Fraction(budget)) if isinstance(budget, str) and budget != "least" else 0.0
        if budget == "least":
            allowed = (least(fails, []) or 0.0) + failed + LEAST_ROOM
        if isinstance(budget, dict):
            allowed = 1.0 - float(Fraction(budget["share"])) * (
                1.0 - failed - (least(fails, []) or 0.0)
            )
        rows.append((fails, allowed - failed))
    for stated in question["rows"]:
        takes, at_start = row(stated["quantity"])
        if "at_most" in stated:
            rows.append((takes, float(Fraction(stated["at_most"])) - at_start))
        else:
            rows.append((-takes, at_start - float(Fraction(stated["at_least"]))))
    sign = -1.0 if question["greatest"] else 1.0
    takes, at_start = row(question["objective"])

    if question["ratio"]:
        return least(takes, rows, at_start)
    found = least(sign * takes, rows)
    return None if found is None else sign * found + at_start


def within_steps(question: dict, states: list[dict]) -> tuple[dict, list[dict]]:
    """The same question on (state, steps taken), whose last ones have no actions."""
    n, horizon, told = len(states), question["horizon"], list[dict]()
    if n * (horizon + 1) > MOST_STATES:
        raise OverflowError
    needed = {x: 0 for x, state in enumerate(states) if "goal" in state["sets"]}
    while more := {x: 1 + min(needed[y] for y in after)
                   for x, state in enumerate(states) if x not in needed
                   if (after := [y for _, outs, _ in state["actions"] for p, y in outs
                                 if Fraction(p) and y in needed])}:  # fmt: skip
        needed |= more
    for h in range(horizon + 1):
        for x, state in enumerate(states):
            late = ["out of time"] * (needed.get(x, 0) > horizon - h)
            actions = [
                [name, [[p, (h + 1) * n + y] for p, y in outs], costs]
                for name, outs, costs in (state["actions"] if h < horizon else [])
            ]
            told.append({**state, "sets": [*state["sets"], *late], "actions": actions})
    return {**question, "horizon": None, "states": len(told)}, told


def _action(stated: list) -> tuple[list[tuple[float, int]], np.ndarray]:
    """Outcomes whose probabilities sum to one, and the mean of each cost."""
    _, told, costs = stated
    chances = np.array([float(Fraction(p)) for p, _ in told])
    chances = chances / chances.sum()
    paid = [
        chances
        @ np.array(
            [float(Fraction(c)) for c in (cost if isinstance(cost, list) else [cost] * len(told))]
        )
        for cost in costs
    ]
    outs = [(float(p), y) for p, (_, y) in zip(chances, told, strict=True) if p > 0]
    return outs, np.array(paid)


def _within(outs: list[tuple[float, int]], states: set[int]) -> bool:
    """Whether all outcomes lie in some states."""
    return all(y in states for _, y in outs)


def charge_of(steps: list, total: Fraction) -> Fraction:
    """What a total is charged: by the last step whose side holds of it."""
    _, at, value, slope = [
        step for step in steps
        if Fraction(step[1]) < total or (Fraction(step[1]) == total and step[0] == ">=")
    ][-1]  # fmt: skip
    return Fraction(value) + Fraction(slope) * (total - Fraction(at))


def by_totals(
    question: dict, states: list[dict], most: int, *, whole: bool
) -> tuple[dict, list[dict]]:
    """The same question on (state, total), the charge a cost; totals stop growing far out.

    They do where there are so many nodes.
    """
    paid, place, told = question["costs"], dict[tuple[int, Fraction], int](), list[dict]()
    nodes = list[tuple[int, Fraction]]()

    def at(x: int, total: Fraction) -> int:
        if "goal" in states[x]["sets"] or not states[x]["actions"]:
            total = Fraction(0)
        elif len(nodes) >= most:
            if whole:
                raise OverflowError
            total = max((r for y, r in nodes if y == x), default=total)
        if (x, total) not in place:
            place[x, total] = len(nodes)
            nodes.append((x, total))
        return place[x, total]

    start = [[p, at(x, Fraction(0))] for p, x in question["start"]]
    for x, total in nodes:  # it grows while it is walked
        actions = []
        for name, outs, costs in states[x]["actions"]:
            first = costs[0] if isinstance(costs[0], list) else [costs[0]] * len(outs)
            moved = [total + Fraction(c) for c in first]
            charged = [str(charge_of(question["charge"], t)) if "goal" in states[y]["sets"] else "0"
                       for (_, y), t in zip(outs, moved, strict=True)]  # fmt: skip
            leads = [[p, at(y, t)] for (p, y), t in zip(outs, moved, strict=True)]
            actions.append([name, leads, [*costs, charged]])
        told.append({**states[x], "actions": actions})
    objective = question["objective"]
    begun = sum(Fraction(p) for p, _ in question["start"])
    won = sum(Fraction(p) for p, x in question["start"] if "goal" in states[x]["sets"])
    constant = Fraction(objective["constant"])
    constant += won / begun * charge_of(question["charge"], Fraction(0))
    objective = {"constant": str(constant), "terms": [*objective["terms"], ["1", "cost", paid]]}
    question = {**question, "costs": paid + 1, "objective": objective, "start": start}
    return {**question, "states": len(nodes)}, told


def goal_totals(question: dict, states: list[dict], most: int, *, whole: bool) -> list[Fraction]:
    """The first totals at which the goal can be reached; an OverflowError if these are not all."""
    met = {(x, Fraction(0)) for _, x in question["start"]}
    begun = {Fraction(0) for _, x in question["start"] if "goal" in states[x]["sets"]}
    ends, ahead, hopeful = begun, sorted(met), set[int]()
    while more := {x for x, state in enumerate(states) if x not in hopeful and (
            "goal" in state["sets"] or any(y in hopeful and Fraction(p)
            for _, outs, _ in state["actions"] for p, y in outs))}:  # fmt: skip
        hopeful |= more
    while ahead and len(ends) < most:
        x, total = ahead.pop(0)
        for _, outs, costs in states[x]["actions"]:
            paid = costs[0] if isinstance(costs[0], list) else [costs[0]] * len(outs)
            for (p, y), c in zip(outs, paid, strict=True):
                node = y, total + Fraction(c)
                if "goal" in states[y]["sets"] and Fraction(p):
                    ends.add(node[1])
                elif Fraction(p) and y in hopeful and node not in met:
                    met.add(node)
                    ahead = sorted([*ahead, node], key=lambda node: node[1])
    if ahead and whole:
        raise OverflowError
    return sorted(ends)


def quantile(
    question: dict, states: list[dict], most: int = 12, *, whole: bool, room: float
) -> float | None:
    """The least of the first totals at the goal that is exceeded rarely enough; None: none is."""
    for total in goal_totals(question, states, most, whole=whole):
        late = [[">=", "0", "0", "0"], [">", str(total), "1", "0"]]
        late = {**question, "quantile": None, "charge": late}
        share = optimum([json.dumps(line).encode() for line in (late, *states)])
        if share is not None and share <= 1.0 - float(Fraction(question["quantile"])) + room:
            return float(total)
    return None
