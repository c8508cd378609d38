"""What users get wrong is told on every rank, in words that say where and what to do: for mpiexec.

The script ends with an error where a mistake is passed over, or is told on some ranks alone; where
it hangs, the test ends it.
"""

import pickle
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from mpi4py import MPI

from formulations import MCMP, S3P, MaxProb
from random_models import drawn_model
from small_models import FIRST
from ssp_lp import SSP, ModelError, visits
from ssp_lp.distributed import PartitionedModel, PartitionedPolicy, StateRows, narrow_order
from ssp_lp.distributed.slab import Slab, rows_checksum

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
        ({"actions": lambda a: a[:-1]}, r"rows\(\d, \d\): actions must have length 1, one a state"),
        ({"actions": lambda a: -a}, "actions must be >= 0"),
        ({"outcomes": lambda a: a[:-1]}, "outcomes must have length 2, one a pair, not 1"),
        ({"outcomes": lambda a: 3}, "outcomes must be one row of whole numbers"),
        ({"successors": lambda a: a[:-1]}, "successors must have length 6, one an outcome"),
        ({"successors": lambda a: a + 0.5}, "successors must be one row of whole numbers"),
        ({"successors": lambda a: a + 2**32}, "has a successor that is no state"),
        ({"successors": lambda a: a - 2}, "has a successor that is no state"),
        ({"probabilities": lambda a: a.reshape(-1, 3)}, "probabilities must be one row of numbers"),
        ({"costs": lambda a: "free"}, "costs must be numbers, not 'free'"),
        ({"costs": lambda a: [1.0] * 5}, r"costs must be one number, \d \(one a pair\) or"),
        ({"named_costs": lambda a: [2.0]}, "named_costs must be costs by name"),
        ({"named_costs": lambda a: {"fuel": "much"}}, "cost 'fuel' must be numbers"),
    ):
        refused(why, lambda arrays=arrays: made(changed(**arrays)))
    refused("must be StateRows, not None", lambda: made(lambda first, end: None))
    for n_states in (0, -6, 6.0, "6"):
        refused("n_states must be a whole number >= 1",
                lambda n=n_states: PartitionedModel.from_rows(walk, n, [6]))  # fmt: skip
    refused("the model has no goal state", lambda: made(goal_states=[]))
    refused("model must be an SSP", lambda: PartitionedModel.from_model(made()))
    refused("model must be an SSP", lambda: narrow_order(made()))
    refused("world must be a ContinuousModel", lambda: PartitionedModel.from_continuous(FIRST))
    named = [{"fuel": 1.0}, {"petrol": 1.0}]
    n = 70_000  # states in several pieces

    def alternating(first, end):
        """Rows whose costs have other names from piece to piece."""
        return walk(first, end, n)._replace(named_costs=named[first >= 1 << 15])

    refused("the ranks state different models|has the named costs", lambda: made(alternating, n))


def check_few_states():
    """Ranks without a state take part."""
    assert made(partial(walk, cells=1), 1).solve(MCMP, **ASKED).objective == pytest.approx(
        1 / 0.901
    )
    ends = StateRows([0], [], [], [], 1.0)
    nothing = PartitionedModel.from_rows(
        lambda first, end: ends._replace(actions=[0] * (end - first)), 4, range(4)
    )
    assert nothing.solve(MCMP, **ASKED).objective == 0.0


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
        refused(
            "the ranks state different questions", lambda stated=ASKED | stated: asked(**stated)
        )
    criterion = S3P if other else MCMP
    refused("the criterion is 'MCMP' on rank 0, 'S3P'", lambda: model.solve(criterion, **ASKED))
    refused("tolerance must lie", lambda: asked(**ASKED, tolerance=-1.0 if other else 1e-9))
    played = partial(model.simulate, policy, MCMP, **ASKED)
    refused("different simulations: seed is 1", lambda: played(seed=1 + other))
    refused("seed must be a whole number", lambda: played(seed=-1 if other else 1))
    measured = partial(model.evaluate, criterion=MCMP, **ASKED)
    refused("policy must be a Part", lambda: measured(None if other else policy))
    weights = PartitionedPolicy(model, [0.5 - 0.1 * other, 0.5 + 0.1 * other],
                                np.repeat(policy.positions[:1], 2, axis=0))  # fmt: skip
    refused("different policies: the members' weights", lambda: measured(weights))


def check_questions(model, answer):
    """Questions that are none are told by the argument."""
    refused("criterion must be a class such as MCMP", lambda: model.solve("MCMP", **ASKED))
    refused("criterion must be a class", lambda: model.solve(MCMP(FIRST, "depot", 0.05)))
    refused("MCMP needs 'start'", lambda: model.solve(MCMP, failure_budget=0.05))
    refused("77 is not a state", lambda: model.solve(MCMP, start=77, failure_budget=0.05))
    refused("such as answer.policy", lambda: model.evaluate(answer, MCMP, **ASKED))
    refused("answer must be a PartitionedSolution", lambda: model.certify(answer.policy))
    refused("of 8 states: this one has 3", lambda: answer.on(MCMP(FIRST, "depot", 0.05)))
    refused("problem must be the question", lambda: answer.on(FIRST))
    for kept in (answer, answer.policy, model):
        refused(r"answer.policy.save\(\) keeps", lambda kept=kept: pickle.dumps(kept))
    assert repr(answer).startswith("PartitionedSolution(MCMP: objective 6.64081737, gap ")
    assert made().solve(MaxProb, start=0).objective == 1.0
    order = [*range(FIRST.n_states)][::-1]
    turned = PartitionedModel.from_model(FIRST, order)
    assert turned.solve(MCMP, start="depot", failure_budget=0.05).objective == pytest.approx(20 / 3)


def check_stopped_searches(model):
    """What a function that is told of progress raises, all raise; then the next is answered."""

    def breaks(*_):
        """Raise on the first rank, where it is called."""
        raise ZeroDivisionError("mine")

    for criterion in (MCMP, S3P):
        with pytest.raises(ZeroDivisionError, match="mine"):
            model.solve(criterion, **ASKED, progress=breaks)
    assert model.solve(MCMP, **ASKED).gap <= 1e-9


def check_checkpoints(model, folder):
    """A checkpoint that is none, or in no folder, is told before the search."""
    kept = folder / "search.npz"
    asked = partial(model.solve, MCMP, **ASKED)
    asked(checkpoint=kept)
    whole = kept.read_bytes()
    refused("is in no folder: make", lambda: asked(checkpoint=folder / "nowhere" / "a.npz"))
    refused("is no checkpoint: .*; delete it", lambda: asked(checkpoint=folder))
    for number, damaged in enumerate((b"", b"text", whole[: len(whole) // 2])):
        path = folder / f"{number}.npz"
        if COMM.rank == 0:
            path.write_bytes(damaged)
        COMM.barrier()
        refused("is no checkpoint: .*; delete it", lambda path=path: asked(checkpoint=path))
    assert asked(checkpoint=kept).objective == pytest.approx(6.64081736668104)
    refused("the checkpoint .* is of", lambda: asked(start=1, checkpoint=kept))
    dearer = made(changed(costs=lambda one: 2.0 * one))
    refused("the checkpoint .* is of", lambda: dearer.solve(MCMP, **ASKED, checkpoint=kept))
    swapped = made(changed(successors=lambda a: a.reshape(-1, 2, 3)[:, ::-1].ravel()))
    refused("the checkpoint .* is of", lambda: swapped.solve(MCMP, **ASKED, checkpoint=kept))


def check_checksums():
    """The rows' checksum is the same however ranks share them, and another for other rows."""
    model, others = drawn_model(3, 23)[0], [drawn_model(4, 23)[0]]
    whole = SSP.from_arrays(
        **{name: getattr(model, name) for name in ("pair_offsets", "outcome_offsets",
                                                   "successors", "probabilities", "costs")},
        goal_states=np.flatnonzero(model.goal_mask), treat_actionless_as_dead_ends=True,
    )  # fmt: skip
    alone = {one.name: getattr(whole, one.name) for one in fields(SSP)}
    single = Slab(**alone, comm=MPI.COMM_SELF, first=0, end=whole.n_states)
    shared = PartitionedModel.from_model(whole).slab
    assert rows_checksum(shared) == rows_checksum(single)
    others += [
        replace(whole, costs=whole.costs + 1e-12),
        replace(whole, named_costs={"a": whole.costs}),
    ]
    for other in others:
        assert rows_checksum(PartitionedModel.from_model(other).slab) != rows_checksum(shared)


if __name__ == "__main__":
    walked = made()
    found = walked.solve(MCMP, **ASKED)
    check_rows()
    check_checksums()
    check_few_states()
    check_that_ranks_differ(walked, found.policy)
    check_questions(walked, found)
    check_stopped_searches(walked)
    with TemporaryDirectory() as own:
        check_checkpoints(walked, Path(COMM.bcast(own)))
        COMM.barrier()
    if COMM.gather(True) is not None:
        print(f"{COMM.size} ranks: well")
