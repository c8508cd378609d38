"""Implicit models against the same models built whole, drawn at random.

    python tests/campaigns/explored_models.py --count 2000

Every draw has a model, bounds (none, half, random admissible, exact), a criterion with its settings
(`give_up`, the charge, limits, a discount) and a growth. The answer must be that of the whole model
to 1e-9, or be infeasible where that one is.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from formulations import MCMP, FinitePenalty, LeastQuantity, MaxProb, MinCost, MinProb
from ssp_lp import (
    SSP,
    Formulation,
    InfeasibleError,
    ModelError,
    certify,
    evaluate,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.reductions import exploration

CLOSE = 1e-9
BOUNDS = ("none", "half", "random", "exact")
Transitions = Mapping[Hashable, Mapping[Hashable, list[tuple[float, Hashable, Any]]]]


@dataclass(frozen=True)
class Told:
    """A model as nested dicts, whole and by its successor function."""

    transitions: Transitions
    goal: frozenset[Hashable]
    start: Hashable
    labels: Mapping[str, frozenset[Hashable]] = field(default_factory=dict)
    cost: str | None = None

    def whole(self) -> SSP:
        return SSP.from_transitions(
            self.transitions,
            self.goal,
            cost=self.cost,
            state_labels=self.labels,
            treat_actionless_as_dead_ends=True,
        )

    def implicit(self, bounds: tuple[Any, Any], growth: float) -> SSP:
        return SSP.implicit(
            self.start,
            lambda state: self.transitions.get(state, {}),
            self.goal,
            cost=self.cost,
            cost_bound=bounds[0],
            failure_bound=bounds[1],
            growth=growth,
            state_labels=self.labels,
        )


def drawn(rng: np.random.Generator, most: int = 14) -> Told:
    """A sparse model of a few states: loops, free steps, dead-ends with and without actions."""
    n = int(rng.integers(3, most))
    states = [f"s{k}" for k in range(n)]
    transitions: dict[Hashable, dict[Hashable, list[tuple[float, Hashable, Any]]]] = {}
    for k, state in enumerate(states):
        transitions[state] = {}
        for action in range(int(rng.integers(0 if k else 1, 4))):
            ends = rng.choice(
                [*states, "goal", "home", "pit", "swamp"], size=int(rng.integers(1, 4))
            )
            weights = rng.integers(1, 5, size=len(ends))
            paid = [_paid(rng) for _ in ends]
            transitions[state][action] = [
                (float(w / weights.sum()), str(end), cost)
                for w, end, cost in zip(weights, ends, paid, strict=True)
            ]
    transitions["pit"] = {}
    transitions["swamp"] = {"wade": [(1.0, "swamp", _paid(rng))]}
    if rng.random() < 0.5:
        transitions["swamp"]["dive"] = [(0.5, "swamp", _paid(rng)), (0.5, "bog", _paid(rng))]
        transitions["bog"] = {"rest": [(1.0, "bog", _paid(rng))]}
    labels = {"early": frozenset(states[: n // 2]), "pits": frozenset({"pit"})}
    return Told(transitions, frozenset({"goal", "home"}), "s0", labels, "time")


def _paid(rng: np.random.Generator) -> dict[str, float]:
    free = rng.random() < 0.3
    return {"time": 0.0 if free else float(rng.integers(1, 5)), "fuel": float(rng.integers(0, 3))}


def bounds_of(told: Told, kind: str, rng: np.random.Generator) -> tuple[Any, Any]:
    """Bounds of a kind: the least cost of a way to the goal, and the least failure."""
    if kind == "none":
        return None, None
    model = told.whole()
    begins = np.asarray(model.outcome_offsets)[model.pair_offsets]
    source = np.repeat(np.arange(model.n_states), np.diff(begins))
    possible = model.probabilities > 0.0
    least = np.full((model.n_states, model.n_states), np.inf)
    np.minimum.at(least, (source[possible], model.successors[possible]), model.costs[possible])
    finite = np.isfinite(least)
    places = [axis.astype(np.int32) for axis in np.nonzero(finite)]  # SciPy 1.12 knows no others
    graph = sp.csr_array((least[finite] + 1e-300, places), shape=least.shape)
    way = csgraph.dijkstra(graph.T, indices=np.flatnonzero(model.goal_mask), min_only=True)
    greatest = np.array([
        0.0 if not np.isfinite(w) else solve(MaxProb(model, s)).objective if not g else 1.0
        for s, w, g in zip(model.states, way, model.goal_mask, strict=True)
    ])  # fmt: skip
    share = {"half": 0.5, "exact": 1.0}.get(kind)
    shares = (
        rng.random((2, model.n_states)) if share is None else np.full((2, model.n_states), share)
    )
    way[way < 1e-200] = 0.0  # free steps
    costs = np.where(np.isfinite(way), way, 0.0) * shares[0]
    if kind == "exact":
        costs = way
    fails = np.maximum(1.0 - greatest - 1e-12, 0.0) * shares[1]
    at = {state: k for k, state in enumerate(model.states)}
    return lambda s: float(costs[at[s]]), lambda s: float(fails[at[s]])


def question(
    rng: np.random.Generator, whole: SSP
) -> tuple[Callable[..., Formulation], dict[str, Any]]:
    """A criterion and its settings."""
    limits: dict[str, Any] = {}
    if rng.random() < 0.3:
        limits["fuel"] = secondary_cost("fuel") <= float(rng.integers(1, 7)) / 2
    if rng.random() < 0.3:
        limits["early"] = visits("early") <= float(rng.integers(2, 8)) / 2
    give_up = str(rng.choice(["anywhere", "attention", "dead_ends"]))
    if rng.random() < 0.2:
        limits["pits"] = visits("pits") <= float(rng.random())
    kind = str(rng.choice(["MCMP"] * 8 + ["MinCost", "MaxProb", "MinProb", "Penalty", "Least"]))
    if kind == "MCMP":
        discount = float(rng.choice([0.9, 0.99])) if rng.random() < 0.25 else None
        budget = float(rng.choice([0.0, 0.1, 0.3, 0.5, 0.8, 1.0]))
        least = discount is None and rng.random() < 0.2
        return MCMP, {
            "failure_budget": None if least else budget,
            "discount": discount,
            "give_up": give_up,
            "charge_failing_step": bool(rng.random() < 0.5),
            "constraints": limits,
        }
    if kind == "Penalty":
        return FinitePenalty, {"penalty": float(rng.integers(1, 12)), "constraints": limits}
    if kind == "Least":
        quantity = secondary_cost("fuel") if rng.random() < 0.5 else visits("early")
        return LeastQuantity, {"quantity": quantity, "failure_budget": float(rng.random())}
    return {"MinCost": MinCost, "MaxProb": MaxProb, "MinProb": MinProb}[kind], {
        "constraints": limits if kind != "MinProb" else {}
    }


def answer(problem: Formulation) -> Any:
    """The solution, or why there is none."""
    try:
        return solve(problem)
    except InfeasibleError:
        return "infeasible"


def compare(seed: int, most: int = 14) -> str:
    """Solve one draw both ways; a word for what came of it, "wrong: ..." if they differ."""
    rng = np.random.default_rng(seed)
    told = drawn(rng, most)
    kind = BOUNDS[int(rng.integers(4))]
    whole = told.whole()
    bounds, growth = bounds_of(told, kind, rng), float(rng.choice([1.01, 1.25, 2.0]))
    exploration.FIRST = int(rng.choice([1, 3]))  # the models are small
    criterion, settings = question(rng, whole)
    try:
        full = answer(criterion(whole, told.start, **settings))
    except ModelError as error:
        full = error
    try:
        part = answer(criterion(told.implicit(bounds, growth), told.start, **settings))
    except ModelError as error:
        if "after failing" in str(error):
            return "refused"
        return "refused" if isinstance(full, ModelError) else f"wrong: {error}"
    if isinstance(full, str) or isinstance(part, str) or isinstance(full, ModelError):
        return "infeasible" if full == part else f"wrong: {full} and {part}"
    scale = CLOSE * max(1.0, abs(full.objective))
    if abs(full.objective - part.objective) > scale + full.gap * abs(full.objective):
        return f"wrong: {full.objective!r} and {part.objective!r}, {kind} {criterion} {settings}"
    proof = certify(part)
    if (
        not proof.accepted
        or abs(evaluate(part.policy, part.problem).objective - part.objective) > scale
    ):
        return f"wrong: {proof}"
    return "equal, not all explored" if part.problem.model.fringe.any() else "equal"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--states", type=int, default=14)
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    began = time.perf_counter()
    for seed in range(options.first, options.first + options.count):
        told = compare(seed, options.states)
        counts[told.partition(":")[0]] += 1
        if told.startswith("wrong"):
            print(seed, told, flush=True)
    print(dict(counts), f"{time.perf_counter() - began:.0f} s")
    return int(counts["wrong"] > 0)


if __name__ == "__main__":
    sys.exit(main())
