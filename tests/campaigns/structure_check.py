"""Every criterion on models of every structure: certified, and equal to linear programs and Storm.

    python tests/campaigns/structure_check.py --family grid --sizes 50 100 --count 10
    python tests/campaigns/structure_check.py --family corridor --sizes 12000 --storm
    SSP_LP_ACCELERATOR=none python tests/campaigns/structure_check.py --family grid --sizes 50

Each model is asked for the greatest goal probability, for the cheapest policy of least failure
(MCMP and S3P), for budgets above it under every `give_up`, and with a limit on expected steps too.
Each answer must be certified, with a gap of at most 1e-9; up to `--program-states` states it must
equal the full linear program's to 1e-6, and with `--storm` Storm's to its precision.
"""

import argparse
import multiprocessing
import queue
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from examples.solver_comparison.instances.families import FAMILIES, RANDOM, SQUARES
from formulations import MCMP, S3P, ConstrainedCost, MaxProb
from ssp_lp import SSP, Solution, SolverError, SSPError, certify, evaluate, solve
from ssp_lp.formulation import CostLimit
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import GiveUp
from tests.campaigns.campaign import run, smallest_model

GAP = 1e-9
PROGRAM = 1e-6  # relative difference from the full linear program
STORM = 1e-3  # absolute and relative difference from Storm, whose precision is 1e-4
SHARES = (0.05, 0.3)  # of the failure that could be allowed, in budgets
LONGEST = 30.0  # seconds that Storm is given
WINDS = (0.0, 0.1, 0.3)


def models(seed: int, asked: argparse.Namespace) -> Iterator[tuple[str, SSP]]:
    """The models of a draw with their names: one of each size, and of each wind on a grid."""
    family, drawn = FAMILIES[asked.family], {"seed": seed} if asked.family in RANDOM else {}
    if not drawn and seed > asked.seed:  # always the same
        return
    for size in asked.sizes:
        sizes = (size,) if asked.family in SQUARES else (size, max(asked.width, 2))
        for wind in WINDS if asked.family == "grid" else (None,):
            windy = {} if wind is None else {"wind": wind}
            name = f"{asked.family} {size}" + "".join(f" wind {share}" for share in windy.values())
            yield name, family(*sizes, **drawn, **windy)


def check(seed: int, tally: Counter[str], asked: argparse.Namespace) -> Iterator[str]:
    """Put all problems about the models of a draw; yield what is wrong."""
    for name, model in models(seed, asked):
        tally["models"] += 1
        yield from (f"{name}: {said}" for said in told(model, tally, asked))


def shrunk(seed: int, asked: argparse.Namespace) -> object:
    """The smallest model of those of a draw that something is wrong with."""

    def fails(model: SSP) -> list[str]:
        return list(told(model, Counter(), asked))

    return smallest_model(next(m for _, m in models(seed, asked) if fails(m)), fails)


def told(model: SSP, tally: Counter[str], asked: argparse.Namespace) -> Iterator[str]:
    """Put all problems about one model; yield what is wrong."""
    small = model.n_states <= asked.program_states
    for problem in problems(model):
        tally["problems"] += 1
        name = f"{type(problem).__name__}({problem.failure_budget}, {problem.semantics.give_up})"
        try:
            solution = solve(problem)
            proof = certify(solution)
        except SSPError as error:
            yield f"{name}: {type(error).__name__}: {error}"
            continue
        wrong = [] if proof.accepted else [f"refused: {proof.reason}"]
        if max(solution.gap, proof.gap) > GAP:
            wrong.append(f"gaps {solution.gap:.1e} and {proof.gap:.1e}; {solution.note}")
        if small:
            try:
                wrong += disagreement(solution, _by_program(problem), PROGRAM, "linear program")
                tally["linear programs"] += 1
            except SolverError:  # its numbers are too far apart for HiGHS, and it says so
                tally["refused as linear programs"] += 1
        if asked.storm and is_for_storm(problem):
            told_by_storm = _in_time(_by_storm, problem)
            if told_by_storm is not None:
                wrong += disagreement(solution, told_by_storm, STORM, "Storm")
            tally["without end by Storm" if told_by_storm is None else "by Storm"] += 1
        yield from (f"{name}: {reason}" for reason in wrong)


def is_for_storm(problem: Problem) -> bool:
    """Whether Storm is asked: where giving up is free its search hardly ever ends."""
    asked = isinstance(problem, MCMP) and problem.failure_budget is not None
    return asked and problem.semantics.give_up is GiveUp.DEAD_ENDS


def _in_time(call: Callable[[Problem], float], problem: Problem) -> float | None:
    """What a call returns, in a process of its own; None where it takes too long."""
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    process = context.Process(target=lambda: answers.put(call(problem)))
    process.start()
    try:
        return float(answers.get(timeout=LONGEST))
    except queue.Empty:
        return None
    finally:
        process.kill()
        process.join()


def problems(model: SSP) -> Iterator[Problem]:
    """The problems of one model, each with the model's start 0."""
    yield MaxProb(model, 0)
    least = 1.0 - solve(MaxProb(model, 0)).objective
    if least >= 1.0:
        return
    yield MCMP(model, 0)
    yield S3P(model, 0)
    budgets = [least + share * (1.0 - least) for share in SHARES]
    for give_up in ("anywhere", "attention", "dead_ends"):
        yield MCMP(model, 0, budgets[0], give_up=give_up)
    yield MCMP(model, 0, budgets[1], give_up="dead_ends")
    yield _hurried(model, budgets[0])


def _hurried(model: SSP, budget: float) -> ConstrainedCost:
    """A limit on expected steps half-way between the fewest and those of the cheapest policy."""
    each = np.ones(model.n_pairs)
    slow = ConstrainedCost(model, 0, {"steps": CostLimit(each, 1e300)}, budget)
    taken = evaluate(solve(slow).policy, slow).secondary_costs["steps"]
    fewest = solve(MCMP(replace(model, costs=np.ones(model.n_outcomes)), 0, budget)).objective
    return replace(slow, limits={"steps": CostLimit(each, 0.5 * (taken + fewest))})


def disagreement(solution: Solution, other: float, room: float, name: str) -> list[str]:
    """What is wrong if an objective differs from a peer's by more than its precision."""
    if abs(solution.objective - other) <= room * max(1.0, abs(other)):
        return []
    return [f"{solution.objective!r}, {name} {other!r}"]


def _by_program(problem: Problem) -> float:
    return solve(problem, method="lp").objective


def _by_storm(problem: MCMP) -> float:
    import stormpy

    from examples.solver_comparison.solvers.explicit import reachable_part
    from examples.solver_comparison.solvers.storm import least_cost_within, storm_model

    model = storm_model(reachable_part(problem.compile().explicit()))
    result = stormpy.model_checking(model, least_cost_within(problem.failure_budget))
    return float(result.get_value(model.initial_states[0]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Check models from the command line; 1 if anything was found."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--family", choices=sorted(FAMILIES), default="grid")
        parser.add_argument("--sizes", nargs="+", type=int, default=[50, 100])
        parser.add_argument(
            "--width", type=int, default=100, help="the other size, if there is one"
        )
        parser.add_argument("--program-states", type=int, default=0, help="up to here by HiGHS too")
        parser.add_argument("--storm", action="store_true", help="also by Storm, budgets only")

    return run(__doc__, check, arguments, count=3, options=options, shrink=shrunk)


if __name__ == "__main__":
    sys.exit(main())
