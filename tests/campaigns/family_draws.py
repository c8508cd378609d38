"""Families of the comparison, each with a criterion drawn for it: how many are answered in time.

    python tests/campaigns/family_draws.py --count 40 --time-limit 30
    python tests/campaigns/family_draws.py --families holes --states 1000 40000 --count 100

Sizes are drawn evenly on a logarithmic scale. Every draw runs in a process of its own and is told
in one line: the states, the criterion, the objective, its gap, the gap that the certificate
proves, and the seconds of the solve. Counted are the answers closed to a relative gap of 1e-6
(1e-3 for a frontier), those without a policy, and those that came too late. What the start cannot
do at all (a goal that is not reached surely, ...) is an answer, too.
"""

import argparse
import math
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from queue import Empty
from typing import Any

import numpy as np

from examples.solver_comparison.instances.families import FAMILIES, RANDOM
from formulations import (
    EGUBS,
    GUBS,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostBoundedReach,
    CostBudgetedMaxProb,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
)
from ssp_lp import (
    SSP,
    InfeasibleError,
    SSPError,
    certify,
    secondary_cost,
    solve,
    trace_frontier,
    visits,
)
from ssp_lp.formulation import CostLimit
from tests.campaigns.campaign import run, smallest_model

CLOSED, CLOSED_FRONTIER = 1e-6, 1e-3
LATE = 2.0  # seconds after the time limit that a call may take, with the process's noise
_END = 120.0  # seconds after which a process is ended
SOON = 5.0  # seconds that a smaller model is given
WRONG = {"without a policy", "refused"}

SIZES: dict[str, Callable[[float], tuple[int, ...]]] = {
    "layered": lambda n: (round(math.sqrt(n)), round(math.sqrt(n))),
    "scattered": lambda n: (round(n),),
    "grid": lambda n: (round(math.sqrt(n)),),
    "river": lambda n: (round(math.sqrt(n)), round(math.sqrt(n))),
    "corridor": lambda n: (round(n),),
    "rooms": lambda n: (max(round(n / 100), 1), 10),
    "ring": lambda n: (round(n),),
    "holes": lambda n: (round(math.sqrt(n)),),
    "headings": lambda n: (max(round(math.sqrt(n / 8)), 5),),
    "racetrack": lambda n: (max(round(math.sqrt(n / 49)), 6),),
    "tandem": lambda n: (round(math.sqrt(n)),),
    "inventory": lambda n: (round(math.sqrt(n / 2)), round(math.sqrt(2 * n))),
    "sysadmin": lambda n: (min(round(math.log2(n)), 14),),
    "factored": lambda n: (min(round(math.log2(n)), 16),),
    "blocks": lambda n: (3 if n < 1_000 else 4 if n < 15_000 else 5,),
}
"""The size of a family with about so many states; families without one are not drawn."""


def problem_of(name: str, model: SSP, rng: np.random.Generator) -> Any:
    """A criterion with numbers that mean something on the model, by the cheapest policies."""
    reach = solve(MaxProb(model, 0), time_limit=20.0).objective
    budget = 1.0 - float(rng.uniform(0.5, 0.99)) * reach
    cheapest = MCMP(model, 0, budget, give_up="dead_ends", charge_failing_step=False)
    typical = solve(cheapest, time_limit=20.0, tolerance=1e-3).objective / max(1.0 - budget, 1e-9)
    bound = float(round(typical * rng.uniform(0.8, 1.5)))
    risky = np.ones(model.n_pairs)
    level = float(rng.choice([0.5, 0.8, 0.9]))
    return {
        "MCMP": lambda: replace(cheapest, give_up="attention", charge_failing_step=True),
        "MCMP least": lambda: MCMP(model, 0),
        "S3P": lambda: S3P(model, 0, budget),
        "S3P least": lambda: S3P(model, 0),
        "MaxProb": lambda: MaxProb(model, 0),
        "MinCost": lambda: MinCost(model, 0),
        "AlphaMCMP": lambda: AlphaMCMP(model, 0, float(rng.uniform(0.5, 0.95))),
        "FinitePenalty": lambda: FinitePenalty(model, 0, penalty=2.0 * typical),
        "ConstrainedCost": lambda: ConstrainedCost(
            model, 0, {"steps": CostLimit(risky, bound)}, budget
        ),
        "GUBS": lambda: GUBS(model, 0, lambda c: np.exp(-c / (1.0 + typical)), 0.5),
        "EGUBS": lambda: EGUBS(model, 0, -1.0 / (1.0 + typical), 0.5),
        "CVaR": lambda: CVaR(model, 0, level, budget),
        "CostQuantile": lambda: CostQuantile(model, 0, level, budget),
        "CostBoundedReach": lambda: CostBoundedReach(model, 0, bound, 1.0),
        "CostBudgetedMaxProb": lambda: CostBudgetedMaxProb(model, 0, bound),
        "LeastQuantity": lambda: LeastQuantity(model, 0, secondary_cost(risky), budget),
        "limited S3P": lambda: S3P(model, 0, budget, constraints={"start": visits(0) <= 1.5}),
        "frontier": lambda: MCMP(model, 0, budget),
    }[name]()


CRITERIA = (
    "MCMP", "MCMP least", "S3P", "S3P least", "MaxProb", "MinCost", "AlphaMCMP", "FinitePenalty",
    "ConstrainedCost", "GUBS", "EGUBS", "CVaR", "CostQuantile", "CostBoundedReach",
    "CostBudgetedMaxProb", "LeastQuantity", "limited S3P", "frontier",
)  # fmt: skip


def drawn_model(rng: np.random.Generator, family: str, states: tuple[float, float]) -> SSP:
    """A model of a family; one in four has real costs where it had whole ones."""
    size = SIZES[family](float(np.exp(rng.uniform(*np.log(states)))))
    drawn = {"seed": int(rng.integers(1 << 30))} if family in RANDOM else {}
    if family == "holes":
        drawn |= {"slip": float(rng.uniform(0.05, 0.5)), "share": float(rng.uniform(0.05, 0.1))}
    model = FAMILIES[family](*size, **drawn)
    if rng.random() < 0.25:
        model = replace(model, costs=model.costs * rng.uniform(0.5, 2.0, model.n_outcomes))
    return model


def drawn(seed: int, asked: argparse.Namespace) -> tuple[np.random.Generator, str, str]:
    """A draw: what is drawn next, and the names of the family and the criterion."""
    rng = np.random.default_rng(seed)
    return rng, str(rng.choice(asked.families)), str(rng.choice(asked.criteria))


def answered(
    model: SSP, criterion: str, rng: np.random.Generator, limit: float
) -> Iterator[dict[str, Any]]:
    """Solve a problem about a model, and tell more and more of it."""
    told: dict[str, Any] = {}
    began = time.perf_counter()
    try:
        problem = problem_of(criterion, model, rng)
        began = time.perf_counter()
        if criterion == "frontier":
            frontier = trace_frontier(problem, gap=CLOSED_FRONTIER, time_limit=limit)
            told |= {"end": "answer", "gap": frontier.gap, "room": CLOSED_FRONTIER}
        else:
            solution = solve(problem, time_limit=limit)
            told |= {"end": "answer", "objective": solution.objective, "gap": solution.gap}
        told["seconds"] = time.perf_counter() - began
        yield dict(told)
        if criterion != "frontier":
            proof = certify(solution)
            told["proof"] = proof.gap if proof.accepted else proof.reason
    except InfeasibleError as error:
        if told:  # a certificate that calls an answered problem infeasible
            told["proof"] = str(error)[:120]
        else:
            told |= {"end": "cannot", "why": str(error)[:120]}
    except (SSPError, KeyboardInterrupt) as error:
        told |= {"end": "nothing", "why": f"{type(error).__name__}: {str(error)[:200]}"}
    yield {"seconds": time.perf_counter() - began, **told}


def answer(seed: int, asked: argparse.Namespace, queue: Any) -> None:
    """Solve one draw and put what is to be told of it."""
    rng, family, criterion = drawn(seed, asked)
    told = {"name": f"{seed} {family}", "criterion": criterion, "end": "killed"}
    queue.put(dict(told))
    model = drawn_model(rng, family, tuple(asked.states))
    told["name"] += f" {model.n_states:,}"
    queue.put(dict(told))
    for more in answered(model, criterion, rng, asked.time_limit):
        queue.put({**told, **more})


def watched(seed: int, asked: argparse.Namespace) -> dict[str, Any]:
    """What a draw's process told last, before it ended or was ended."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=answer, args=(seed, asked, queue))
    process.start()
    process.join(asked.time_limit + _END)
    alive = process.is_alive()
    process.kill()
    process.join()
    told: dict[str, Any] = {"name": str(seed), "criterion": "?", "end": "killed"}
    while True:
        try:
            told = queue.get(timeout=0.2)
        except Empty:
            return {**told, "hung": alive}


def verdict(told: dict[str, Any], limit: float) -> list[str]:
    """How a draw is counted."""
    if told["end"] in ("killed", "nothing"):
        return ["without a policy"]
    words = ["late"] if told["seconds"] > limit + LATE else []
    if told["end"] == "cannot" or told["gap"] <= told.get("room", CLOSED):
        words.append("closed")
    proof = told.get("proof", 0.0)
    if isinstance(proof, str):
        words.append("refused")
    if told["hung"]:
        words.append("certificate without end")
    return words or ["open"]


def check(seed: int, tally: Counter[str], asked: argparse.Namespace) -> list[str]:
    """Tell of a draw in one line; what is wrong with it."""
    told = watched(seed, asked)
    words = verdict(told, asked.time_limit)
    tally.update(words)
    figures = [
        f"{key} {told[key]:.9g}" if isinstance(told[key], float) else f"{key} {told[key]}"
        for key in ("objective", "gap", "proof", "seconds", "why")
        if key in told
    ]
    line = f"{told['name']} {told['criterion']}: {', '.join(words)}; {', '.join(figures)}"
    print(line, flush=True)
    return [line] if WRONG.intersection(words) else []


def shrunk(seed: int, asked: argparse.Namespace) -> object:
    """The smallest model about which a draw goes wrong in the same way, if its process goes on."""
    rng, family, criterion = drawn(seed, asked)
    model, numbers = drawn_model(rng, family, tuple(asked.states)), rng.bit_generator.state

    def wrong(case: SSP) -> set[str]:
        rng.bit_generator.state = numbers
        *_, told = answered(case, criterion, rng, min(asked.time_limit, SOON))
        return WRONG.intersection(verdict({**told, "hung": False}, asked.time_limit))

    kind = wrong(model)
    return smallest_model(model, lambda m: wrong(m) == kind) if kind else "it was ended, or late"


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw from the command line; 1 if any draw had no policy or a certificate was refused."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--families", nargs="+", choices=sorted(SIZES), default=sorted(SIZES))
        parser.add_argument("--criteria", nargs="+", choices=CRITERIA, default=CRITERIA)
        parser.add_argument("--states", nargs=2, type=float, default=[300, 1e5], help="from, to")
        parser.add_argument("--time-limit", type=float, default=30.0)

    return run(__doc__, check, arguments, count=40, options=options, shrink=shrunk)


if __name__ == "__main__":
    sys.exit(main())
