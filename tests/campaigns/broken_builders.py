"""Builders of the library broken on purpose: what a certificate's checker says of wrong answers.

    python tests/campaigns/broken_builders.py --count 200 --seed 0

The library's methods, its evaluation and `certify` read a model through the same builders: what
failing charges, where the goal can be avoided, which loops are free, what arriving costs. With one
of them broken in every room at once all of them may agree on a wrong answer. A certificate's
checker reads the model by itself. Models have up to six states, dead-ends with actions that cost,
loops that are free in some of what is counted, and states in which the goal can be avoided. Of each
problem whose answer becomes wrong, for the optimum lies beyond the bounds that it states, it is
counted whether its certificate is refused, or accepted. None may be.
"""

import argparse
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from formulations import MCMP, S3P, CostBoundedReach, FinitePenalty, LeastQuantity
from ssp_lp import SSP, SSPError, secondary_cost, solve, visits, write_certificate
from ssp_lp.accumulated_cost import process
from ssp_lp.compiled.accelerator import SWITCH
from ssp_lp.model import graph
from ssp_lp.processes import failure_semantics, live_rows

BEYOND = 1e-5  # of 1 + |value|: by so much an optimum lies beyond bounds; files claim to 1e-6
LONGEST = 5.0  # seconds that a library that is broken is given


FAULTS: dict[str, tuple[Any, str, Callable[[Any], Any]]] = {
    "giving up charges the least of all actions": (
        failure_semantics, "attention_pairs",
        lambda known: lambda model, *_: np.ones(model.n_pairs, dtype=np.bool_),
    ),
    "dead-ends charge twice": (
        failure_semantics, "dead_end_charges",
        lambda known: lambda *a, **k: 2.0 * known(*a, **k),
    ),
    "nothing but dead-ends avoids the goal": (
        graph, "attention_states", lambda known: graph.dead_ends
    ),
    "every state avoids the goal": (
        failure_semantics, "attention_states", lambda known: lambda model: ~model.goal_mask
    ),
    "loops are free where the cost is": (
        failure_semantics, "free_pairs",
        lambda known: lambda model, *_, **__: live_rows.costless_pairs(model),
    ),
    "the last step costs nothing": (
        process, "cost_means", lambda known: lambda *a, **k: 0.0 * known(*a, **k)
    ),
    "steps cost more in one room": (
        failure_semantics, "cost_means", lambda known: lambda *a, **k: 1.25 * known(*a, **k)
    ),
}  # fmt: skip
"""Where a builder stands, its name, and what it is replaced by, made from itself."""

ONE_ROOM = set(FAULTS) - {
    "dead-ends charge twice", "nothing but dead-ends avoids the goal",
    "loops are free where the cost is",
}  # fmt: skip
"""Faults of one room alone, in which others would not run."""


def problem_of(seed: int) -> Any:
    """A problem on a model in which whatever the builders tell apart occurs."""
    rng = np.random.default_rng([seed, 77])
    rooms, ends = [f"s{k}" for k in range(int(rng.integers(2, 5)))], ["pit", "hole"]
    choices: dict[str, dict[str, list[tuple[float, str, float]]]] = {}
    for state in rooms:
        choices[state] = {}
        for k in range(int(rng.integers(2, 4))):
            ahead = rng.choice([*rooms, *ends, "home", "home"], size=int(rng.integers(1, 4)))
            weights = rng.integers(1, 6, size=len(ahead))
            cost = float(rng.choice([0.0, 1.0, 2.0, 4.0]))
            choices[state][f"a{k}"] = [
                (float(w), str(y), cost)
                for w, y in zip(weights / weights.sum(), ahead, strict=True)
            ]
        if rng.random() < 0.4:
            choices[state]["stay"] = [(1.0, state, float(rng.choice([0.0, 1.0, 3.0])))]
    choices["s0"]["go"] = [(0.7, "home", 3.0), (0.3, "pit", 1.0)]
    choices["pit"] = {"out": [(0.5, "pit", 6.0), (0.5, "hole", 2.0)], "in": [(1.0, "pit", 5.0)]}
    choices["yard"] = {"on": [(1.0, "home", 2.0)]}  # from where the goal is sure
    choices["hole"] = {"rest": [(1.0, "hole", float(rng.integers(1, 4)))]}
    model = SSP.from_transitions(choices, goal={"home"})
    fuel = {s: {a: float(rng.choice([0.0, 0.0, 1.0, 2.0])) for a in choices[s]} for s in rooms}
    give_up = str(rng.choice(["anywhere", "attention", "dead_ends"]))
    charged, budget = bool(rng.random() < 0.7), float(rng.choice([0.2, 0.4, 0.6, 1.0]))
    rest: dict[str, Any] = {"constraints": {"n": visits("s0") <= 1.5}} if rng.random() < 0.2 else {}
    semantics: dict[str, Any] = {"give_up": give_up, "charge_failing_step": charged}
    start = {"s0": 0.5, "yard": 0.5} if rng.random() < 0.4 else "s0"
    kind = int(rng.integers(6))
    if kind == 0:
        return MCMP(model, start, budget, **semantics, **rest)
    if kind == 1:
        return FinitePenalty(model, start, float(rng.integers(1, 9)), **semantics, **rest)
    if kind < 4:
        worth = secondary_cost(fuel) + 0.5 * visits("s1")
        return LeastQuantity(model, start, worth, budget, **semantics, **rest)
    if kind == 4:
        return S3P(model, start, budget, **rest)
    return CostBoundedReach(model, start, int(rng.integers(1, 9)), budget, **rest)


@contextmanager
def broken(fault: str) -> Iterator[None]:
    """A builder broken in every room that uses it, or in its own."""
    room, name, make = FAULTS[fault]
    known = getattr(room, name)
    rooms = [module for key, module in sys.modules.items()
             if key.startswith("ssp_lp") and getattr(module, name, None) is known]  # fmt: skip
    other, patches = make(known), list[Any]()
    for module in [room] if fault in ONE_ROOM else rooms:
        patches.append(patch.object(module, name, other))
        patches[-1].start()
    try:
        yield
    finally:
        for one in patches:
            one.stop()


def answer(seed: int) -> Any:
    """The answer to a problem stated anew; None: there is none."""
    try:
        return solve(problem_of(seed), time_limit=LONGEST)
    except Exception:  # whatever a library that is broken may raise
        return None


def is_accepted(solution: Any, path: Path) -> bool:
    """Whether a certificate is made of a wrong answer by a library that is still broken."""
    try:
        return write_certificate(solution, path).accepted
    except SSPError:
        return False


def check(seed: int, fault: str, right: Any, tally: Counter[str], folder: Path) -> Iterator[str]:
    """One problem and one fault; yield what is accepted though it is wrong."""
    with broken(fault):
        wrong = answer(seed)
        if wrong is None or right is None:
            return
        room, known = BEYOND * (1.0 + abs(right.objective)), right.objective
        most = wrong.objective if wrong.upper_bound is None else wrong.upper_bound
        if wrong.lower_bound - room <= known <= most + room or right.gap > BEYOND:
            return
        believed = is_accepted(wrong, folder / "one.cert")
    tally["accepted" if believed else "refused"] += 1
    if believed:
        yield f"{fault}: {wrong.objective!r} is accepted, right is {right.objective!r}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Check faults from the command line; 1 if a wrong answer was accepted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="of problems")
    parser.add_argument("--seed", type=int, default=0, help="of the first one")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), help="some of them")
    options = parser.parse_args(arguments)
    os.environ[SWITCH] = "none"  # compiled loops trust their arrays
    tallies = {fault: Counter[str]() for fault in options.faults}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(options.seed, options.seed + options.count):
            right = answer(seed)
            for fault, tally in tallies.items():
                for said in check(seed, fault, right, tally, Path(folder)):
                    print(f"seed {seed}: {said}", flush=True)
    for fault, tally in tallies.items():
        counts = ", ".join(f"{said} {tally[said]}" for said in ("refused", "accepted"))
        print(f"{fault:<45} {tally.total():>5} wrong answers: {counts}")
    return int(any(tally["accepted"] for tally in tallies.values()))


if __name__ == "__main__":
    sys.exit(main())
