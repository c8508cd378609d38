"""A campaign: problems of every kind on the ranks of PETSc beside one process alone, for mpiexec.

    mpiexec -n 2 python tests/distributed/on_drawn_problems.py --count 300 --seed 0

Models have free cycles, several outcomes that lead to one state, and numbers of states that ranks
do not divide; questions have one start or several, discounts, every place to give up, limits that
bind, and some that cannot be kept. Each is put to a model that the ranks make in parts, to one in
Cuthill and McKee's order, and to one that every rank has: objective, failure, gap, and each
member's figures must be the local ones to 1e-9, prices too, or support the optimum.
"""

import os
import sys
import traceback
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from mpi4py import MPI
from on_every_rank import check_the_same as check_on_every_rank, least_failure
from on_partitioned_models import check_the_same, partitioned

from formulations import MCMP
from random_models import random_choices
from ssp_lp import (
    SSP,
    InfeasibleError,
    ModelError,
    SolverError,
    end_probability,
    evaluate,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.distributed import PartitionedModel, narrow_order
from tests.campaigns.campaign import run

LOOSE = 1e9  # bound of a limit that does not bind
GIVE_UP = ["dead_ends", "attention", "anywhere"]


def drawn_model(rng):
    """A random model with a second cost, in which some outcomes are split in two."""
    n_states = int(rng.integers(4, 60))
    choices = random_choices(rng, n_states, free_share=float(rng.choice([0.0, 0.3, 0.7])))
    for actions in choices.values():
        for name, outcomes in actions.items():
            if rng.random() < 0.3:
                chance, successor, cost = outcomes[0]
                halves = [(0.5 * chance, successor, cost), (0.5 * chance, successor, cost + 1)]
                actions[name] = [*halves, *outcomes[1:]]
    model = SSP.from_transitions(choices, goal={"goal"}, treat_actionless_as_dead_ends=True)
    model = replace(model, named_costs={"fuel": rng.integers(0, 4, model.n_outcomes).astype(float)})
    return model.with_labels({"pit": ["pit"], "some": [f"s{k}" for k in range(1, n_states, 3)]})


def drawn_question(rng, model):
    """A question about a model: start, failure budget, discount, where to give up, and limits."""
    states = [f"s{k}" for k in range(model.n_states - 3)]
    starts = dict.fromkeys(rng.choice([*states, "goal", "pit"], size=4).tolist(), 0.125)
    several = {**starts, "s0": 1.0 - 0.125 * (len(starts) - ("s0" in starts))}
    question = {
        "start": several if rng.random() < 0.4 else "s0",
        "discount": [None, None, 0.9, 0.999][int(rng.integers(4))],
        "give_up": str(rng.choice(GIVE_UP)),
    }
    least = least_failure(model, question)
    question["failure_budget"] = least + float(rng.choice([0.05, 0.3, 0.8])) * (1.0 - least)
    quantities = {
        "fuel": secondary_cost("fuel"),
        "some": visits("some"),
        "pit": end_probability("pit"),
    }
    names = [name for name in quantities if rng.random() < 0.35]
    if not names:
        return question
    loose = {name: quantities[name] <= LOOSE for name in names}
    problem = MCMP(model, **question, constraints=loose)
    spent = evaluate(solve(problem).policy, problem).secondary_costs
    share = float(rng.choice([0.7, 0.9, 0.99, 1.1]))
    limits = {name: quantities[name] <= share * spent[name] for name in names}
    return question | {"constraints": limits}


def check(seed, tally, _):
    """Put the problem of a seed in three ways; yield what is wrong."""
    rng = np.random.default_rng(seed)
    model = drawn_model(rng)
    asked = drawn_question(rng, model)
    problem = MCMP(model, **asked)
    try:
        solve(problem)
        refused = None
    except InfeasibleError as error:
        refused = error
    tally["discounted" if asked["discount"] else "exact"] += 1
    tally["within limits"] += "constraints" in asked
    tally["several starts"] += not isinstance(asked["start"], str)
    ways = {
        "in parts": partial(asked_of, lambda: partitioned(model), model, asked),
        "in a narrow order": partial(
            asked_of, lambda: PartitionedModel.from_model(model, narrow_order(model)), model, asked
        ),
        "on every rank": lambda: check_on_every_rank(problem, optima=2),
    }
    for way, put in ways.items():
        try:
            put()
            tally[f"{way}: the same"] += 1
            if refused is not None:
                yield f"{way}: answered, but it is infeasible: {refused}"
        except AssertionError as error:
            yield f"{way}: {traceback.extract_tb(error.__traceback__)[-1].line}: {error}"
        except ModelError as error:
            if "does not tell apart" not in str(error):
                yield f"{way}: {error}"
            tally[f"{way}: refused"] += 1
        except InfeasibleError as error:
            if refused is None:
                yield f"{way}: infeasible: {error}"
            elif not np.isclose(error.least_failure, refused.least_failure, rtol=1e-9, atol=1e-12):
                yield f"{way}: least failure {error.least_failure}, not {refused.least_failure}"
            tally[f"{way}: infeasible"] += 1
        except SolverError as error:
            yield f"{way}: {error}"


def asked_of(make, model, asked):
    """Put a question to a model that the ranks share."""
    check_the_same(model, make(), MCMP, optima=2, **asked)


if __name__ == "__main__":
    with Path(os.devnull).open("w") as nowhere:
        aloud = sys.stdout if MPI.COMM_WORLD.rank == 0 else nowhere
        with redirect_stdout(aloud):
            wrong = run(__doc__, check)
    sys.exit(wrong)
