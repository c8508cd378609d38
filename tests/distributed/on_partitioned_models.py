"""Models that ranks make in parts, beside one process alone: a script for mpiexec.

It ends with an error where a part differs from the whole model's, or an answer from the local one.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from mpi4py import MPI
from on_drawn_problems import check_the_same

from examples.paper_robot.robot import RobotGrid, continuous_robot, grid_model, start_state
from formulations import MCMP, S3P, MaxProb, MinCost
from partitioned import numbered, partitioned
from random_models import random_choices
from small_models import FIRST, FREE_PAIR, TWO_MOVES, model_of
from ssp_lp import (
    SSP,
    InfeasibleError,
    ModelError,
    Quadrature,
    Samples,
    end_probability,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.distributed import PartitionedModel, StateRows
from ssp_lp.io import save_model
from ssp_lp.model.graph import attention_states, hopeless_states

COMM = MPI.COMM_WORLD
DUPLICATES = {
    "x": {
        "go": [(0.25, "y", 1), (0.25, "x", 1), (0.25, "y", 2), (0.2, "x", 4), (0.05, "d", 0)],
        "walk": [(0.5, "y", 4.0), (0.5, "x", 4.0)],
    },
    "y": {"go": [(0.125, "x", 1.0), (0.125, "x", 3.0), (0.74, "g", 1.0), (0.01, "d", 1.0)]},
    "d": {},
}
"""Several outcomes of a pair lead to one state, and some back to where it was taken."""


def check_parts(model, made):
    """Put together, the parts are the model, row by row, and so is what is known of its graph."""
    part, halo = made.part, made.part.halo
    assert COMM.allreduce(halo.n_own) == model.n_states == halo.n_all
    pairs = slice(*model.pair_offsets[[halo.first, halo.end]].tolist())
    own = slice(*model.outcome_offsets[[pairs.start, pairs.stop]].tolist())
    counts = np.diff(model.pair_offsets)[halo.first : halo.end]
    assert np.array_equal(np.diff(part.pair_offsets)[: halo.n_own], counts)
    assert np.array_equal(np.diff(part.outcome_offsets), np.diff(model.outcome_offsets)[pairs])
    assert np.array_equal(halo.numbers[part.successors], model.successors[own])
    assert part.probabilities == pytest.approx(model.probabilities[own], rel=1e-15)
    assert np.array_equal(part.costs, model.costs[own])
    for name, costs in model.named_costs.items():
        assert np.array_equal(part.named_costs[name], costs[own])
    assert np.array_equal(part.goal_mask, model.goal_mask[halo.numbers])
    for fact in (hopeless_states, attention_states):
        assert np.array_equal(fact(part), fact(model)[halo.numbers])
    if COMM.size > 1:  # nobody keeps a vector over all states
        arrays = [value for value in vars(part).values() if isinstance(value, np.ndarray)]
        own_sizes = (
            part.n_states,
            part.n_states + 1,
            part.n_pairs,
            part.n_pairs + 1,
            part.n_outcomes,
        )
        assert all(array.size in own_sizes for array in arrays)


def check_file():
    """A part that is read from the library's own file is that of the model."""
    model = numbered(model_of(DUPLICATES))
    model = replace(model, named_costs={"fuel": 1.0 + np.arange(model.n_outcomes) % 3})
    model = model.with_labels({"lost": [3]})
    with TemporaryDirectory() as folder:
        path = Path(COMM.bcast(folder)) / "model.npz"
        if COMM.rank == 0:
            save_model(model, path)
        COMM.barrier()
        read = PartitionedModel.from_file(path)
        COMM.barrier()
    check_parts(model, read)
    assert read.part.words == partitioned(model).part.words
    limits = {"fuel": secondary_cost("fuel") <= 6.2, "lost": end_probability("lost") <= 0.29}
    check_the_same(model, read, MCMP, start=0, failure_budget=0.3, constraints=limits)
    with pytest.raises(ModelError, match="is not an ssp-lp model file"):
        PartitionedModel.from_file(__file__)


def check_discretised():
    """A continuous world that ranks discretise in parts has the rows of the whole grid model."""
    walls = RobotGrid(segments=7, headings=6, quadrature=2, wall_cost=100.0)
    made = PartitionedModel.from_continuous(continuous_robot(walls), Quadrature(2))
    check_parts(grid_model(walls), made)
    narrow = {"allowed": lambda at, turn: (at[0] < 0.5) | (turn < 3)}
    world = replace(continuous_robot(walls), **narrow)
    few = PartitionedModel.from_continuous(world, Quadrature(2))
    assert COMM.allreduce(few.part.n_pairs) < COMM.allreduce(made.part.n_pairs)
    asked = {"start": start_state(walls), "failure_budget": 0.9}
    check_the_same(grid_model(walls), made, MCMP, **asked)
    check_the_same(grid_model(walls), made, MCMP, **asked, discount=0.99)
    with pytest.raises(ModelError, match=r"such as Quadrature\(4\), not Samples"):
        PartitionedModel.from_continuous(world, Samples(3, 0))


def check_small_models():
    """Answers whose closed forms or brute force are tested elsewhere are the local ones."""
    for choices, start, budget in (
        (TWO_MOVES, 0, 0.02),
        (DUPLICATES, 0, 0.03),
        (FREE_PAIR, 0, 0.25),
    ):
        model = numbered(model_of(choices))
        for more in (
            {},
            {"give_up": "dead_ends"},
            {"discount": 0.9},
            {"charge_failing_step": True},
        ):
            check_the_same(
                model, partitioned(model), MCMP, start=start, failure_budget=budget, **more
            )
    spread = {"start": {0: 0.5, 2: 0.3, 3: 0.2}, "failure_budget": 0.4}  # in the goal and lost, too
    model = numbered(model_of(DUPLICATES))
    check_the_same(model, partitioned(model), MCMP, **spread)
    check_the_same(model, partitioned(model), MaxProb, start=spread["start"])


def check_errors():
    """What is not answered is named on every rank, and the next question is answered."""
    model = numbered(FIRST)
    made, start = partitioned(model), list(FIRST.states).index("depot")
    with pytest.raises(InfeasibleError) as caught:
        made.solve(MCMP, start=start, failure_budget=0.001)
    assert caught.value.least_failure == pytest.approx(0.01)
    wreck = list(FIRST.states).index("wreck")
    limits = {"few": visits(wreck) <= 0.009}
    with pytest.raises(InfeasibleError) as caught:
        made.solve(MCMP, start=start, failure_budget=0.05, constraints=limits)
    assert caught.value.conflicting_rows == ("few",)
    for criterion, asked, why in (
        (S3P, {"failure_budget": 0.05}, "S3P counts the total cost .* the whole model"),
        (MinCost, {}, "MinCost needs the whole graph"),
        (MCMP, {"failure_budget": 0.05, "horizon": 3}, "neither horizon"),
        (MCMP, {"reach_fraction": 0.9}, "nor reach_fraction"),
    ):
        with pytest.raises(ModelError, match=why):
            made.solve(criterion, start=start, **asked)
    assert made.solve(MCMP, start=start, failure_budget=0.05).objective == pytest.approx(20 / 3)
    skid = {"go": [(0.5, "g", 1.0), (0.5, "skid", 1.0)]}  # who skids has failed, and goes on
    later = numbered(model_of({"x": skid, "skid": {"on": [(1.0, "wreck", 1.0)]}, "wreck": {}}))
    limits = {"ends": visits(2, through_failure=True) <= 0.6}
    with pytest.raises(ModelError, match="counts events after failing"):
        partitioned(later).solve(MCMP, start=0, failure_budget=0.6, constraints=limits)


def check_surely():
    """Who cannot fail fails with probability 0, whatever an evaluation began with."""
    for seed in (18, 36):
        choices = random_choices(np.random.default_rng(seed), 6 + seed % 14, free_share=0.0)
        model = SSP.from_transitions(choices, {"goal"}, treat_actionless_as_dead_ends=True)
        asked = {"start": 0, "failure_budget": 0.0, "constraints": {"seen": visits(1) <= 1e9}}
        answer = partitioned(numbered(model)).solve(MCMP, **asked)
        assert not answer.figures[:, 1].any()
        known = solve(MCMP(numbered(model), **asked)).objective
        assert answer.objective == pytest.approx(known)


def check_hardly_left():
    """Loops across ranks that are left once in a billion times are evaluated, as locally."""
    for seed in (133, 274, 296):
        choices = random_choices(np.random.default_rng(seed), 20, free_share=0.0)
        for k in range(0, 20, 2):
            onward = (1.0 - 1e-9, f"s{(k + 1) % 20}", 1e-3)
            choices[f"s{k}"]["loop"] = [onward, (1e-9, "goal", 1.0)]
            choices[f"s{k + 1}"]["loop"] = [(1.0, f"s{k}", 1e-3)]
        model = SSP.from_transitions(choices, {"goal"}, treat_actionless_as_dead_ends=True)
        model = numbered(model)
        known = solve(MCMP(model, 0, 0.3)).objective
        answer = partitioned(model).solve(MCMP, start=0, failure_budget=0.3)
        assert answer.objective == pytest.approx(known, rel=1e-9)
        assert answer.lower_bound <= known * (1.0 + 1e-9)


def check_long_walks():
    """A chain of a long component, which no rank could solve from its own rows, by Krylov's way."""
    n = 1_500

    def rows(first, end):
        """Slowly and safely, or fast with a fall now and then; the goal and the pit are last."""
        here = np.arange(first, min(end, n))
        back = np.maximum(here - 1, 0)
        slow = np.stack([here + 1, back, here], axis=1)
        fast = np.stack([here + 1, back, np.full_like(here, n + 1)], axis=1)
        return StateRows(
            np.where(np.arange(first, end) < n, 2, 0), np.full(2 * len(here), 3),
            np.stack([slow, fast], axis=1).ravel(),
            np.tile([0.55, 0.25, 0.2, 0.8, 0.2 - 1e-4, 1e-4], len(here)), 1.0,
        )  # fmt: skip

    made, whole = PartitionedModel.from_rows(rows, n + 2, [n]), rows(0, n + 2)
    model = SSP.from_arrays(
        pair_offsets=np.append(0, np.cumsum(whole.actions)),
        outcome_offsets=3 * np.arange(2 * n + 1),
        successors=whole.successors, probabilities=whole.probabilities, costs=1.0, goal_states=[n],
        treat_actionless_as_dead_ends=True,
    )  # fmt: skip
    check_parts(model, made)
    check_the_same(model, made, MCMP, start=0, failure_budget=0.1)


def check_few_states():
    """Ranks without a state take part."""
    ends = StateRows([0], [], [], [], 1.0)
    nothing = PartitionedModel.from_rows(
        lambda first, end: ends._replace(actions=[0] * (end - first)), 4, range(4)
    )
    assert nothing.solve(MCMP, start=0, failure_budget=0.05).objective == 0.0


if __name__ == "__main__":
    for one in (
        check_file, check_discretised, check_small_models, check_errors, check_surely,
        check_hardly_left, check_long_walks, check_few_states,
    ):  # fmt: skip
        one()
    if COMM.gather(True) is not None:
        print(f"{COMM.size} ranks: well")
