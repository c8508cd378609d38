"""Promises against a linear program on (state, totals) and against products with a memory.

    python tests/campaigns/promised_totals.py --count 500

Every draw has a small model with two quantities and one to three promises, `within` or `exceeds`.
Case M is solved again by a linear program that is written here from dictionaries; case S, the
greatest goal probability, horizons and the charge of failing by a product with a `Memory`, in
which the promises are end probabilities and visits of named states.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linprog

from formulations import MCMP, S3P, MaxProb
from ssp_lp import (
    SSP,
    InfeasibleError,
    Memory,
    Quantity,
    certify,
    end_probability,
    evaluate,
    exceeds,
    product,
    secondary_cost,
    solve,
    visits,
    within,
)
from tests.campaigns.campaign import run

CLOSE = 1e-7
GIVE_UP = ("anywhere", "attention", "dead_ends")
Transitions = dict[Hashable, dict[Hashable, list[tuple[float, Hashable, dict[str, float]]]]]


@dataclass(frozen=True)
class Promise:
    """A limit on a total: of "fuel" or of visits of "ward", at most and at which probability."""

    of: str
    bound: float
    at_least: float | None = None  # within; None: exceeds
    at_most: float = 1.0

    @property
    def limit(self) -> Any:
        quantity = secondary_cost("fuel") if self.of == "fuel" else visits("ward")
        if self.at_least is not None:
            return within(quantity, self.bound) >= self.at_least
        return exceeds(quantity, self.bound) <= self.at_most

    def used(self, to: Hashable, costs: Mapping[str, float]) -> float:
        return costs["fuel"] if self.of == "fuel" else float(to in WARD)


WARD = ("s1", "s2")
BEYOND = 99.0
"""In place of any total beyond its bound."""


def drawn(rng: np.random.Generator, unit: float, *, seen: bool) -> Transitions:
    """A model of a few states, every step of which costs time.

    seen: whether successor and time say how much fuel a step took.
    """
    states = [f"s{k}" for k in range(int(rng.integers(3, 7)))]
    transitions: Transitions = {}
    for k, state in enumerate(states):
        transitions[state] = {}
        for action in range(int(rng.integers(1, 4))):
            ends = rng.choice([*states[max(k - 1, 0) :], "goal", "home", "pit"], size=3)
            ends[0] = ends[0] if k or action else "goal"
            weights = rng.integers(1, 6, size=3)
            steps = []
            for weight, end in zip(weights, ends, strict=True):
                time, fuel = float(rng.integers(1, 4)), float(rng.integers(0, 3)) * unit
                time += seen * fuel / (10.0 * unit)
                steps.append(
                    (float(weight / weights.sum()), str(end), {"time": time, "fuel": fuel})
                )
            transitions[state][action] = steps
    return transitions | {"pit": {}}


def promises_of(rng: np.random.Generator, unit: float) -> list[Promise]:
    """One to three promises."""
    made = []
    for _ in range(int(rng.integers(1, 4))):
        of = str(rng.choice(["fuel", "fuel", "ward"]))
        bound = float(rng.integers(0, 6)) * (unit if of == "fuel" else 1.0)
        chance = float(rng.choice([0.05, 0.2, 0.4, 0.6, 0.75]))
        made.append(
            Promise(of, bound, chance) if rng.random() < 0.6 else Promise(of, bound, None, chance)
        )
    return made


def _moved(promises: list[Promise], totals: tuple[float, ...], to: Hashable, costs: Any) -> Any:
    """Totals after a step, as far as they matter."""
    after = (t + p.used(to, costs) for t, p in zip(totals, promises, strict=True))
    return _capped(promises, after)


def _begun(promises: list[Promise], start: str) -> tuple[float, ...]:
    """Totals at the start."""
    return _capped(promises, (float(p.of == "ward" and start in WARD) for p in promises))


def _capped(promises: list[Promise], totals: Iterable[float]) -> tuple[float, ...]:
    """Totals within their bounds, or beyond."""
    each = zip(totals, promises, strict=True)
    return tuple(round(t, 9) if t <= p.bound + 1e-9 else BEYOND for t, p in each)


def _avoiding(transitions: Transitions, goals: Iterable[str]) -> set[Hashable]:
    """States from which some policy surely avoids the goal."""
    left = {state for state in transitions if state not in goals}
    while True:
        kept = {
            state
            for state in left
            if not transitions[state]
            or any(all(to in left for _, to, _ in steps) for steps in transitions[state].values())
        }
        if kept == left:
            return left
        left = kept


def _dead_ends(transitions: Transitions, goals: Iterable[str]) -> set[Hashable]:
    """States from which no policy comes to the goal."""
    hopeful = set(goals)
    for _ in transitions:
        for state, actions in transitions.items():
            if any(to in hopeful for steps in actions.values() for _, to, _ in steps):
                hopeful.add(state)
    return set(transitions) - hopeful


def reference(
    transitions: Transitions, start: str, promises: list[Promise], budget: float, give_up: str
) -> float:
    """Least expected time by a linear program on (state, totals); infinite if there is none."""
    goals = ("goal", "home")
    avoiding, dead = _avoiding(transitions, goals), _dead_ends(transitions, goals)
    begin = (start, _begun(promises, start))
    nodes, columns = {begin: 0}, []
    pending = [begin]
    while pending:
        state, totals = node = pending.pop()
        if give_up == "anywhere" or (give_up == "attention" and state in avoiding):
            columns.append((node, {}, 0.0, 1.0, [0.0] * len(promises)))
        for steps in transitions[state].values():
            into, paid, fails, rows = Counter[Any](), 0.0, 0.0, [0.0] * len(promises)
            for chance, to, costs in steps:
                paid += chance * costs["time"]
                after = _moved(promises, totals, to, costs)
                for k, promise in enumerate(promises):
                    if promise.at_least is not None:
                        rows[k] += chance * (to in goals and after[k] < BEYOND)
                    else:
                        rows[k] += chance * (after[k] == BEYOND > totals[k])
                if to in dead:
                    fails += chance
                elif to not in goals:
                    into[to, after] += chance
                    if (to, after) not in nodes:
                        nodes[to, after] = len(nodes)
                        pending.append((to, after))
            columns.append((node, into, paid, fails, rows))
    balance = np.zeros((len(nodes), len(columns)))
    for k, (node, into, *_) in enumerate(columns):
        balance[nodes[node], k] += 1.0
        for there, chance in into.items():
            balance[nodes[there], k] -= chance
    taken = np.array([rows for *_, rows in columns]).T
    begun = [float(begin[1][k] == BEYOND) for k in range(len(promises))]
    upper, bounds = [np.array([column[3] for column in columns])], [budget]
    for row, promise, at_once in zip(taken, promises, begun, strict=True):
        is_within = promise.at_least is not None
        upper.append(-row if is_within else row)
        bounds.append(-promise.at_least if is_within else promise.at_most - at_once)
    cost = np.array([column[2] for column in columns])
    right = np.zeros(len(nodes))
    right[0] = 1.0
    sharp = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    answer = linprog(
        cost, A_ub=np.array(upper), b_ub=bounds, A_eq=balance, b_eq=right, options=sharp
    )
    return float(answer.fun) if answer.status == 0 else np.inf


def by_memory(model: SSP, start: str, promises: list[Promise]) -> tuple[SSP, Any, dict[str, Any]]:
    """The product with a memory of the totals, its start, and the promises as limits on it."""

    def update(kept: Any, state: Any, action: Any, to: Any, cost: float) -> Any:
        costs = {"fuel": spent[state, action, to, cost]}
        totals = kept[0]
        after = _moved(promises, totals, to, costs)
        passed = tuple(b == BEYOND > a for a, b in zip(totals, after, strict=True))
        return after, passed

    spent = {}
    for pair in range(model.n_pairs):
        state, action = model.states[int(model.pair_state[pair])], model.action_of(pair)
        for k in range(model.outcome_offsets[pair], model.outcome_offsets[pair + 1]):
            key = state, action, model.states[int(model.successors[k])], float(model.costs[k])
            spent[key] = float(model.named_costs["fuel"][k])
    totals = _begun(promises, start)
    begin = totals, tuple(total == BEYOND for total in totals)
    made = product(model, Memory(start=begin, update=update), start=[start])
    limits: dict[str, Any] = {}
    for k, promise in enumerate(promises):
        if promise.at_least is not None:
            kept = [s for s in made.states if s[0] in ("goal", "home") and s[1][0][k] < BEYOND]
            kept_to = end_probability(*kept) if kept else Quantity(())
            limits[str(k)] = kept_to >= promise.at_least
        else:
            passing = [s for s in made.states if s[1][1][k]]
            if passing:
                limits[str(k)] = visits(*passing) <= promise.at_most
    return made, (start, begin), limits


def answer(problem: Any) -> Any:
    """The proved solution of a problem whose policy attains it; None: it is infeasible."""
    try:
        solution = solve(problem)
    except InfeasibleError:
        return None
    assert certify(solution).accepted, "the certificate is refused"
    found = evaluate(solution.policy, problem)
    assert abs(found.objective - solution.objective) <= 1e-8 * (1 + abs(solution.objective))
    return solution.objective


def compare(seed: int) -> str:
    """Solve a draw both ways; a word for it, "wrong: ..." if they differ."""
    rng = np.random.default_rng(seed)
    unit, to_memory = float(rng.choice([1.0, 0.1, np.sqrt(2.0)])), bool(rng.random() < 0.5)
    transitions = drawn(rng, unit, seen=to_memory)
    model = SSP.from_transitions(
        transitions, ["goal", "home"], cost="time", state_labels={"ward": WARD}, dead_ends=["pit"]
    )
    promises = promises_of(rng, unit)
    constraints = {str(k): promise.limit for k, promise in enumerate(promises)}
    budget, give_up = float(rng.choice([0.1, 0.3, 0.6, 1.0])), str(rng.choice(GIVE_UP))
    settings: dict[str, Any] = {"failure_budget": budget}
    if not to_memory:
        criterion, kind = MCMP, f"program, {len(promises)} promises"
        settings |= {"give_up": give_up, "charge_failing_step": False}
        least = reference(transitions, "s0", promises, budget, give_up)
        expected = None if least == np.inf else least
    else:
        criterion = (S3P, S3P, MaxProb, MCMP)[int(rng.integers(4))]
        kind = f"memory, {criterion.__name__}"
        settings = {} if criterion is MaxProb else settings
        if criterion is MCMP:
            settings |= {"give_up": give_up, "charge_failing_step": bool(rng.random() < 0.5)}
        if rng.random() < 0.3:
            settings["horizon"], kind = int(rng.integers(2, 6)), f"{kind}, horizon"
        made, start, limits = by_memory(model, "s0", promises)
        expected = answer(criterion(made, start, constraints=limits, **settings))
    got = answer(criterion(model, "s0", constraints=constraints, **settings))
    if (got is None) != (expected is None):
        return f"wrong: {got} and {expected}, {kind} {settings} {promises}"
    if got is not None and abs(got - expected) > CLOSE * (1.0 + abs(expected)):
        return f"wrong: {got!r} and {expected!r}, {kind} {settings} {promises}"
    return f"{kind}{': infeasible' * (got is None)}"


def check(seed: int, tally: Counter[str], asked: argparse.Namespace) -> Iterable[str]:
    """What is wrong with a draw, counted."""
    word = compare(seed)
    tally[word if not word.startswith("wrong") else "wrong"] += 1
    return [word] if word.startswith("wrong") else []


if __name__ == "__main__":
    sys.exit(run(__doc__, check))
