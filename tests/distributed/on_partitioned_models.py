"""Models that the ranks of PETSc make in parts, beside one process alone: a script for mpiexec.

It ends with an error where a part differs from the whole model's, or an answer from the local one.
Its argument is how many drawn models there are.
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from mpi4py import MPI
from on_every_rank import DUPLICATES, check_prices, least_failure

from examples.distributed.scaling import corridor
from examples.paper_robot.robot import RobotGrid, continuous_robot, grid_model, start_state
from formulations import MCMP, S3P, FinitePenalty, LeastQuantity, MaxProb, MinCost
from random_models import drawn_model, random_choices
from small_models import FIRST, FREE_PAIR, TWO_MOVES, model_of
from ssp_lp import (
    SSP,
    InfeasibleError,
    ModelError,
    Quadrature,
    Samples,
    certify,
    discretise,
    end_probability,
    evaluate,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.distributed import PartitionedModel, StateRows, narrow_order
from ssp_lp.distributed.order import reordered
from ssp_lp.distributed.slab import part_by_rows
from ssp_lp.io import save_model
from ssp_lp.model.graph import attention_states, hopeless_states

COMM = MPI.COMM_WORLD
ENDS = {
    "x": {"go": [(0.5, "g", 1.0), (0.5, "skid", 1.0)]},
    "skid": {"on": [(1.0, "wreck", 1.0)]},
    "wreck": {},
}
"""Who skids has failed, and comes to the wreck after that."""


def partitioned(model):
    """A model as its own rows make it, in parts."""

    def rows(first, end):
        """The rows of some states."""
        pairs = slice(*model.pair_offsets[[first, end]].tolist())
        outcomes = slice(*model.outcome_offsets[[pairs.start, pairs.stop]].tolist())
        return StateRows(
            np.diff(model.pair_offsets)[first:end],
            np.diff(model.outcome_offsets)[pairs],
            model.successors[outcomes],
            model.probabilities[outcomes],
            model.costs[outcomes],
            {name: costs[outcomes] for name, costs in model.named_costs.items()},
        )

    goals = np.flatnonzero(model.goal_mask)
    labels = {name: [model.states[k] for k in of] for name, of in model.state_labels.items()}
    return PartitionedModel.from_rows(
        rows, model.n_states, goals, states=model.states, state_labels=labels
    )


def check_parts(model, made):
    """Put together, the parts are the model, row by row, and so is what is known of its graph."""
    slab = made.slab
    first, end = slab.first, slab.end
    firsts, ends = zip(*COMM.allgather((first, end)), strict=True)
    assert (0, *ends) == (*firsts, model.n_states)
    pairs = slice(*model.pair_offsets[[first, end]].tolist())
    outcomes = slice(*model.outcome_offsets[[pairs.start, pairs.stop]].tolist())
    assert slab.n_pairs == pairs.stop - pairs.start
    assert np.array_equal(
        np.diff(slab.pair_offsets)[first:end], np.diff(model.pair_offsets)[first:end]
    )
    assert np.array_equal(np.diff(slab.outcome_offsets), np.diff(model.outcome_offsets)[pairs])
    for name in ("successors", "probabilities", "costs"):
        assert np.array_equal(getattr(slab, name), getattr(model, name)[outcomes])
    for name, costs in model.named_costs.items():
        assert np.array_equal(slab.named_costs[name], costs[outcomes])
    assert [*slab.states] == [*model.states]
    assert np.array_equal(slab.goal_mask, model.goal_mask)
    for fact in (hopeless_states, attention_states):
        assert np.array_equal(fact(slab), fact(model))


def check_the_same(model, made, criterion, *, optima=1, **asked):
    """All ranks have one answer, as good as the local one, and proved on the whole model.

    Where there may be several optima, they spend the same of what has a price.
    """
    answer, problem = made.solve(criterion, **asked), criterion(model, **asked)
    known = solve(problem)
    figures = answer.objective, answer.lower_bound, answer.failure, dict(answer.prices)
    assert COMM.allgather(figures) == [figures] * COMM.size
    assert answer.objective == pytest.approx(known.objective, rel=1e-9, abs=1e-12), problem
    if optima == 1 or answer.failure_price > 0.0:
        assert answer.failure == pytest.approx(known.budget_used, rel=1e-9, abs=1e-12), problem
    assert answer.failure <= problem.failure_budget + 1e-10, problem
    for name, spent in answer.spent.items():
        if optima == 1 or answer.prices[name] > 0.0:
            assert spent == pytest.approx(known.secondary_costs[name], rel=1e-8, abs=1e-10), problem
    assert answer.gap <= 1e-9, (problem, answer.gap)
    whole = answer.on(problem)
    if not problem.ratio:
        check_prices(problem, answer, known)
    for member, measured in zip(whole.policy.policies, answer.figures, strict=True):
        own = evaluate(member, problem)
        spent = [own.secondary_costs[name] for name in answer.spent]
        figures = [own.objective, own.limited_failure, *spent]
        assert measured == pytest.approx(figures, rel=1e-9, abs=1e-12), problem
    assert whole.evaluation.objective == pytest.approx(answer.objective, rel=1e-9, abs=1e-12)
    assert whole.failure_price == pytest.approx(answer.failure_price + problem.semantics.penalty)
    if whole.upper_bound is not None:
        assert known.objective <= whole.upper_bound + 1e-12
        assert whole.objective <= known.upper_bound + 1e-12
    if not problem.ratio:
        assert made.certify(answer).accepted
    stated = known.value_function
    if (
        stated is None or stated.shape == answer.value_function.shape
    ):  # else free states are one there
        assert certify(whole).accepted


def check_file(model):
    """A part that is read from the library's own file is that of the model."""
    with TemporaryDirectory() as folder:
        path = Path(COMM.bcast(folder)) / "model.npz"
        if COMM.rank == 0:
            save_model(model, path)
        COMM.barrier()
        read = PartitionedModel.from_file(path)
        check_parts(model, read)
        COMM.barrier()
    whole = PartitionedModel.from_model(model)
    check_parts(model, whole)
    fuel = {"constraints": {"fuel": secondary_cost("fuel") <= 6.2}}
    check_the_same(model, read, MCMP, start="x", failure_budget=0.3, **fuel)
    check_the_same(model, whole, MCMP, start="x", failure_budget=0.4, discount=0.9, **fuel)
    with pytest.raises(ModelError, match="is no ssp-lp model file"):
        PartitionedModel.from_file(__file__)
    with pytest.raises(ModelError, match="actions must have length 1, one a state, not 3"):
        PartitionedModel.from_rows(lambda *_: StateRows([0] * 3, [], [], [], 1.0), 40, [0])


def check_discretised():
    """A continuous world that ranks discretise in parts has the rows of the whole grid model."""
    turning = RobotGrid(segments=6, headings=4, quadrature=2, turning_cost=0.5)
    walls = RobotGrid(segments=7, headings=6, quadrature=2, wall_cost=100.0)
    for grid in (walls, turning):
        points = Quadrature(grid.quadrature)
        made = PartitionedModel.from_continuous(continuous_robot(grid), points)
        check_parts(grid_model(grid), made)
    narrow = {"allowed": lambda at, turn: (at[0] < 0.5) | (turn < 3)}
    world = replace(continuous_robot(walls), **narrow)
    check_parts(discretise(world, Quadrature(2)), PartitionedModel.from_continuous(world, points))
    asked = {"start": start_state(walls), "failure_budget": 0.9}
    check_the_same(grid_model(walls), PartitionedModel.from_continuous(
        continuous_robot(walls), points), MCMP, **asked)  # fmt: skip
    with pytest.raises(ModelError, match=r"such as Quadrature\(4\), not Samples"):
        PartitionedModel.from_continuous(world, Samples(3, 0))


def ghosts(slab):
    """Live states of other ranks to which the own rows lead."""
    ahead = np.unique(slab.successors)
    lost = slab.goal_mask | hopeless_states(slab)
    return np.count_nonzero(~lost[ahead] & ~slab.own_mask[ahead])


def check_order():
    """Reordered, a shuffled corridor has few ghosts; it is answered in its own numbers."""
    rows, n_states, start = corridor(20)
    tidy = part_by_rows(rows, 0, n_states, n_states, [n_states - 2])
    shuffle = np.random.default_rng(0).permutation(n_states)
    model = reordered(tidy, shuffle).with_labels({"midway": [20 * k + 50 for k in range(5)]})
    plain = PartitionedModel.from_model(model)
    narrow = PartitionedModel.from_model(model, narrow_order(model))
    asked = {"start": start, "failure_budget": 0.3}
    limits = {"constraints": {"seldom": visits("midway") <= 0.1}}
    check_the_same(model, plain, MCMP, **asked)
    check_the_same(model, narrow, MCMP, **asked)
    sent = [COMM.allreduce(made.ranks.bytes) for made in (plain, narrow)]
    check_the_same(model, narrow, MCMP, **asked, **limits, give_up="anywhere")
    check_the_same(model, narrow, MCMP, **asked | {"start": {start: 0.5, n_states - 2: 0.5}})
    counts = [COMM.allreduce(ghosts(made.slab)) for made in (plain, narrow)]
    if COMM.size > 1:
        assert counts[1] <= 0.25 * counts[0], counts
        assert 0 < sent[1] <= 0.25 * sent[0], sent
    check_the_same(model, narrow, S3P, **asked)
    check_the_same(model, narrow, S3P, optima=2, **asked, **limits, cost_cap=250.0)
    with pytest.raises(ModelError, match=r"each of the states 0 .. 2001 once"):
        PartitionedModel.from_model(model, np.zeros(n_states, dtype=np.int64))


def check_surely():
    """Who cannot fail fails with probability 0, whatever an evaluation began with."""
    for seed in (18, 36):
        choices = random_choices(np.random.default_rng(seed), 6 + seed % 14, free_share=0.0)
        model = SSP.from_transitions(choices, {"goal"}, treat_actionless_as_dead_ends=True)
        asked = {"start": "s0", "failure_budget": 0.0}
        asked["constraints"] = {"seen": visits("s1") <= 1e9}
        for order in (narrow_order(model), np.arange(model.n_states)[::-1].copy()):
            answer = PartitionedModel.from_model(model, order).solve(MCMP, **asked)
            assert not answer.figures[:, 1].any()
            assert answer.objective == pytest.approx(solve(MCMP(model, **asked)).objective)


def check_hardly_left():
    """Loops across ranks that are left once in a billion times are evaluated, as locally."""
    for seed in (133, 274, 296):
        choices = random_choices(np.random.default_rng(seed), 20, free_share=0.0)
        for k in range(0, 20, 2):
            onward = (1.0 - 1e-9, f"s{(k + 1) % 20}", 1e-3)
            choices[f"s{k}"]["loop"] = [onward, (1e-9, "goal", 1.0)]
            choices[f"s{k + 1}"]["loop"] = [(1.0, f"s{k}", 1e-3)]
        model = SSP.from_transitions(choices, {"goal"}, treat_actionless_as_dead_ends=True)
        known = solve(MCMP(model, "s0", 0.3)).objective
        answer = partitioned(model).solve(MCMP, start="s0", failure_budget=0.3)
        assert answer.objective == pytest.approx(known, rel=1e-9)
        assert answer.lower_bound <= known * (1.0 + 1e-9)


def check_that_rows_of_one_rank_fail_on_all():
    """Where one rank cannot make its rows, all raise its error; costs are given in any form."""

    def rows(first, end):
        """Rows that fail in the last state."""
        if end == 40 and first < 39:
            raise ZeroDivisionError("no rows here")
        n = end - first
        return StateRows([1] * n, [1] * n, [39] * n, [1.0] * n, 1.0)

    with pytest.raises(ZeroDivisionError, match="no rows here"):
        PartitionedModel.from_rows(rows, 40, [39])
    n = 70_000

    def walk(first, end):
        """A walk to the last state, whose pieces give their costs as numbers and by pairs."""
        here = np.arange(first, min(end, n - 1))
        ones, paid = np.ones(len(here), dtype=np.int64), float(1 + first // (1 << 16))
        return StateRows(
            np.append(ones, 0)[: end - first], ones, here + 1, ones.astype(float),
            paid if first % 2 == 0 else paid * ones,
        )  # fmt: skip

    made = PartitionedModel.from_rows(walk, n, [n - 1])
    assert COMM.allreduce(made.slab.n_pairs) == n - 1
    assert made.slab.costs.size == made.slab.n_outcomes


def with_fuel(model):
    """A model with a second cost by name, and its states numbered."""
    fuel = 1.0 + np.arange(model.n_outcomes) % 3
    return replace(model, named_costs={"fuel": fuel}).with_labels({"odd": ["x"]})


def questions():
    """Models with questions, of many sizes, which the ranks do not divide evenly."""
    yield FIRST, MCMP, {"start": "depot", "failure_budget": 0.05}
    yield model_of(TWO_MOVES), MCMP, {"start": "x", "failure_budget": 0.02}
    yield model_of(DUPLICATES), MCMP, {"start": "x", "failure_budget": 0.03}
    several = {"start": {"x": 0.25, "y": 0.75}, "failure_budget": 0.3, "discount": 0.9}
    yield model_of(DUPLICATES), MCMP, several
    yield (
        model_of(DUPLICATES),
        MCMP,
        {"start": {"x": 0.5, "g": 0.3, "d": 0.2}, "failure_budget": 0.3},
    )
    yield model_of(FREE_PAIR), MCMP, {"start": "x", "failure_budget": 0.25}
    yield model_of(FREE_PAIR), MCMP, {"start": "x", "failure_budget": 0.25, "give_up": "dead_ends"}
    few = {"few": visits("wreck") <= 0.04}
    yield FIRST, MCMP, {"start": "depot", "failure_budget": 0.09, "constraints": few}
    named = {"wrecks": end_probability("wreck") <= 0.04}
    ends = {"give_up": "dead_ends", "constraints": named}
    yield FIRST, MCMP, {"start": "depot", "failure_budget": 0.09} | ends
    seen = {"seen": visits("y") <= 1.2, "home": end_probability("goal") >= 0.885}
    yield model_of(DUPLICATES), MCMP, {"start": "x", "failure_budget": 0.2, "constraints": seen}
    for model, start in ((FIRST, "depot"), (model_of(DUPLICATES), "x"), (model_of(FREE_PAIR), "x")):
        yield model, MaxProb, {"start": start}
    yield model_of(DUPLICATES), FinitePenalty, {"start": "x", "penalty": 20.0}
    least = {"start": "x", "quantity": visits("y"), "failure_budget": 0.05}
    yield model_of(DUPLICATES), LeastQuantity, least
    for seed in range(int(sys.argv[1])):
        model, _ = drawn_model(seed, 11 + 3 * (seed % 12))
        discounted = {"start": {"s1": 0.5, "s5": 0.5}, "discount": 0.95, "give_up": "anywhere"}
        yield model, MaxProb, {"start": discounted["start"]}
        for question in ({"start": "s0"}, discounted):
            lowest = least_failure(model, question)
            yield model, MCMP, question | {"failure_budget": lowest + 0.3 * (1.0 - lowest)}
    coarse = RobotGrid(segments=12, headings=8)
    robot = {"start": start_state(coarse), "failure_budget": 0.5}
    yield grid_model(coarse), MCMP, robot
    few = {"constraints": {"walls": visits("wall") <= 0.005}}
    yield grid_model(coarse), MaxProb, {"start": start_state(coarse)} | few
    walls = {"give_up": "dead_ends", "constraints": {"walls": visits("wall") <= 0.05}}
    yield grid_model(coarse), MCMP, robot | walls


def check_errors(made):
    """What is not answered is named on every rank, and the next question is answered."""
    with pytest.raises(InfeasibleError) as caught:
        made.solve(MCMP, start="depot", failure_budget=0.001)
    assert caught.value.least_failure == pytest.approx(0.01)
    limits = {"few": visits("wreck") <= 0.009}
    with pytest.raises(InfeasibleError) as caught:
        made.solve(MCMP, start="depot", failure_budget=0.05, constraints=limits)
    assert caught.value.conflicting_rows == ("few",)
    for criterion in (S3P, MCMP):
        with pytest.raises(ModelError, match="answers costs within a failure budget"):
            made.solve(criterion, start="depot")
    with pytest.raises(ModelError, match="forbids failing, which asks for the whole graph"):
        made.solve(MinCost, start="depot")
    named = {"wrecks": end_probability("wreck") <= 0.04}
    with pytest.raises(ModelError, match="does not tell apart"):
        partitioned(model_of(ENDS)).solve(MCMP, start="x", failure_budget=0.5, constraints=named)
    with pytest.raises(ModelError, match="no horizon"):
        made.solve(MCMP, start="depot", failure_budget=0.05, horizon=3)
    with pytest.raises(InfeasibleError) as caught:
        made.solve(MCMP, start="depot", failure_budget=0.001, discount=0.5)
    assert caught.value.least_failure == pytest.approx(0.01)
    assert made.solve(MCMP, start="depot", failure_budget=0.05).gap <= 1e-9


if __name__ == "__main__":
    for model, criterion, asked in questions():
        made = partitioned(model)
        check_parts(model, made)
        check_the_same(model, made, criterion, **asked)
    check_file(with_fuel(model_of(DUPLICATES)))
    check_discretised()
    check_order()
    check_surely()
    check_hardly_left()
    check_that_rows_of_one_rank_fail_on_all()
    check_errors(partitioned(FIRST))
    if COMM.gather(True) is not None:
        print(f"{COMM.size} ranks: well")
