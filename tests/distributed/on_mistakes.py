"""What users get wrong ends all ranks with words that say where and what to do: for mpiexec.

The script ends with an error where a mistake is passed over, or is told on some ranks alone; where
it hangs, the test ends it.
"""

import pickle
import sys
from functools import partial

import numpy as np
import pytest
from mpi4py import MPI

from formulations import MCMP, S3P
from small_models import FIRST
from ssp_lp import ModelError, visits
from ssp_lp.distributed import PartitionedModel, PartitionedPolicy, StateRows

COMM = MPI.COMM_WORLD
CELLS = 6
ASKED = {"start": 0, "failure_budget": 0.05}


def walk(first, end, cells=CELLS):
    """A walk through some cells to the goal, or faster, at the risk of the ditch behind it."""
    here = np.arange(first, min(end, cells))
    run = np.stack([here + 1, here, np.full_like(here, cells + 1)], axis=1)
    slow = np.stack([here + 1, here, here], axis=1)
    return StateRows(
        actions=np.where(np.arange(first, end) < cells, 2, 0),
        outcomes=np.full(2 * len(here), 3),
        successors=np.stack([run, slow], axis=1).ravel(),
        probabilities=np.tile([0.9, 0.099, 0.001, 0.5, 0.25, 0.25], len(here)),
        costs=1.0,
    )


def made(rows=walk, cells=CELLS, **stated):
    """The walk, in parts."""
    return PartitionedModel.from_rows(rows, cells + 2, **{"goal_states": [cells]} | stated)


def refused(why, ask):
    """A mistake is told on every rank."""
    with pytest.raises(ModelError, match=why):
        ask()
    COMM.barrier()


def changed(**arrays):
    """The walk's rows with some arrays changed by functions of them."""

    def rows(first, end):
        """The rows of some states."""
        own = walk(first, end)
        return own._replace(**{name: make(getattr(own, name)) for name, make in arrays.items()})

    return rows


def check_rows():
    """Rows that do not fit are told by the call and the array."""
    for arrays, why in (
        ({"actions": lambda a: a[:-1]}, r"rows\(\d, \d\): actions must be 1 numbers, one for each"),
        ({"actions": lambda a: -a}, "actions must be"),
        ({"outcomes": lambda a: a[:-1]}, "outcomes must be 2 numbers, one for each pair"),
        ({"outcomes": lambda a: 3}, "outcomes must be"),
        ({"successors": lambda a: a[:-1]}, "successors must be 6 numbers, one for each outcome"),
        ({"successors": lambda a: a + 0.5}, "successors must be"),
        ({"successors": lambda a: a + 2**32}, "has a successor that is not a state"),
        ({"successors": lambda a: a - 2}, "has a successor that is not a state"),
        ({"probabilities": lambda a: a.reshape(-1, 3)}, "probabilities must be 6 numbers"),
        ({"probabilities": lambda a: 1.1 * a}, r"of state \d+: probabilities sum to 1.1"),
        ({"costs": lambda a: [1.0] * 5}, "costs must be a number"),
    ):
        refused(why, lambda arrays=arrays: made(changed(**arrays)))
    refused("must be StateRows, not None", lambda: made(lambda first, end: None))
    for n_states in (0, -6, 6.0, "6"):
        refused("n_states must be a whole number >= 1",
                lambda n=n_states: PartitionedModel.from_rows(walk, n, [6]))  # fmt: skip
    refused("the model has no goal state", lambda: made(goal_states=[]))
    refused("goal_states must be numbers of states", lambda: made(goal_states=[CELLS + 2]))
    refused("wet must be numbers of states", lambda: made(state_labels={"wet": ["x"]}))
    refused("world must be a ContinuousModel", lambda: PartitionedModel.from_continuous(FIRST))

    def rows(first, end):
        """Rows that fail on the last rank."""
        if (end == CELLS + 2 and first < end - 1) or COMM.size == 1:
            raise ZeroDivisionError("no rows here")
        return walk(first, end)

    with pytest.raises((ZeroDivisionError, ModelError), match="no rows here"):
        made(rows)


def check_that_ranks_differ(model, policy):
    """What ranks state differently is told, before they wait for each other."""
    other = COMM.rank == COMM.size - 1 > 0
    if COMM.size == 1:
        return
    for stated in (
        {"goal_states": [CELLS + other]},
        {"state_labels": {"wet": [1]} if other else {}},
        {"state_labels": {"wet": [1 + other]}},
        {"cells": CELLS + other, "rows": partial(walk, cells=CELLS + other)},
    ):
        refused("the ranks state different models", lambda stated=stated: made(**stated))
    asked = partial(model.solve, MCMP)
    for stated in (
        {"start": int(other)},
        {"start": {0: 0.5, 1 + other: 0.5}},
        {"failure_budget": 0.05 + 0.1 * other},
        {"discount": 0.9 - 0.1 * other},
        {"give_up": "dead_ends" if other else "anywhere"},
        {"constraints": {"few": visits(3) <= 1.2} if other else {}},
    ):
        refused("the ranks state different questions", lambda s=ASKED | stated: asked(**s))
    refused("S3P counts the total|rank . failed", lambda: model.solve(
        S3P if other else MCMP, **ASKED))  # fmt: skip
    refused("tolerance must lie", lambda: asked(**ASKED, tolerance=-1.0 if other else 1e-9))
    measured = partial(model.evaluate, criterion=MCMP, **ASKED)
    refused("policy must be a policy of this model|failed", lambda: measured(
        None if other else policy))  # fmt: skip
    positions = np.repeat(policy.positions[:1], 2, axis=0)
    weights = PartitionedPolicy(model.part, [0.5 - 0.1 * other, 0.5 + 0.1 * other], positions)
    refused("different policies: the members' weights", lambda: measured(weights))


def check_questions(model, answer):
    """Questions that are none are told by the argument."""
    refused("criterion must be a class such as MCMP", lambda: model.solve("MCMP", **ASKED))
    refused("criterion must be a class", lambda: model.solve(MCMP(FIRST, "depot", 0.05)))
    refused("MCMP needs 'start'", lambda: model.solve(MCMP, failure_budget=0.05))
    refused("77 is not a state.*0 .. 7", lambda: model.solve(MCMP, start=77, failure_budget=0.05))
    refused("must be a policy of this model", lambda: model.evaluate(answer, MCMP, **ASKED))
    refused("of 8 states: this one has 3", lambda: answer.policy.on(FIRST))
    worse = answer.policy.positions + 9
    wrong = PartitionedPolicy(model.part, answer.policy.weights, worse)
    refused("is not a pair of that state|failed", lambda: model.evaluate(wrong, MCMP, **ASKED))
    for kept in (answer, answer.policy, model):
        refused(r"use answer.policy.save\(\)", lambda kept=kept: pickle.dumps(kept))
    assert repr(answer).startswith("PartitionedSolution(MCMP: objective 6.64081737, gap ")


def breaks(*_):
    """Raise on the first rank, where it is called."""
    raise ZeroDivisionError("mine")


if __name__ == "__main__":
    walked = made()
    if sys.argv[1:] == ["breaks"]:
        walked.solve(MCMP, **ASKED, progress=breaks)
    found = walked.solve(MCMP, **ASKED)
    check_rows()
    check_that_ranks_differ(walked, found.policy)
    check_questions(walked, found)
    if COMM.gather(True) is not None:
        print(f"{COMM.size} ranks: well")
