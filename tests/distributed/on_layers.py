"""Costs given success, and what is made of a total cost, over ranks: a script for mpiexec.

It ends with an error where an answer differs from the local one. Its argument is how many drawn
models there are.
"""

import sys

import numpy as np
import pytest
from mpi4py import MPI
from on_every_rank import DUPLICATES, least_failure
from on_partitioned_models import partitioned

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from formulations import EGUBS, GUBS, S3P, CostBoundedReach, CostQuantile
from random_models import random_choices
from small_models import FIRST, model_of
from ssp_lp import (
    SSP,
    InfeasibleError,
    ModelError,
    certify,
    end_probability,
    solve,
    visits,
)
from ssp_lp.distributed import PartitionedModel

COMM = MPI.COMM_WORLD
ONE_STEP = {"x": {"go": [(0.75, "g", 2.0), (0.25, "d", 1.0)], "wait": [(1.0, "d", 1.0)]}, "d": {}}
"""No step leads from one state to another at which something is still to be done."""
GIVEN_UP = {
    "x": {"go": [(0.3, "y", 3.0), (0.6, "x", 2.0), (0.1, "d", 1.0)], "wait": [(1.0, "d", 1.0)]},
    "y": {"go": [(0.7, "g", 2.0), (0.3, "x", 1.0)], "wait": [(1.0, "d", 1.0)]},
    "d": {},
}
"""One may fail surely from everywhere: nothing is above the price of failing but by rounding."""
SURE = {
    "x": {"go": [(0.5, "g", 1.0), (0.5, "x", 1.0)], "try": [(0.9, "g", 1.0), (0.1, "d", 1.0)]},
    "d": {},
}
"""The goal can be reached surely, after any number of steps."""


def drawn(seed, n_states):
    """A random model in which every step costs something."""
    choices = random_choices(np.random.default_rng(seed), n_states, free_share=0.0)
    return SSP.from_transitions(choices, goal={"goal"}, treat_actionless_as_dead_ends=True)


def patience(cost):
    """A utility that ends at a total of eight."""
    return np.maximum(1.0 - cost / 8.0, 0.0)


def questions():
    """Models with questions, of many sizes, which the ranks do not divide evenly."""
    yield FIRST, S3P, {"start": "depot", "failure_budget": 0.05}
    yield FIRST, S3P, {"start": {"depot": 0.5, "home": 0.4, "wreck": 0.1}, "failure_budget": 0.15}
    yield model_of(ONE_STEP), S3P, {"start": "x", "failure_budget": 0.5}
    yield model_of(GIVEN_UP), S3P, {"start": {"x": 0.7, "y": 0.3}, "failure_budget": 1.0}
    yield model_of(SURE), S3P, {"start": "x", "failure_budget": 0.05}
    yield model_of(SURE), S3P, {"start": "x", "failure_budget": 0.05, "cost_cap": 60.0}
    duplicates = model_of(DUPLICATES)
    yield duplicates, S3P, {"start": {"x": 0.25, "y": 0.75}, "failure_budget": 0.1}
    yield duplicates, S3P, {"start": "x", "failure_budget": 0.4, "discount": 0.9}
    seen = {"seen": visits("y") <= 1.2, "home": end_probability("goal") >= 0.885}
    yield duplicates, S3P, {"start": "x", "failure_budget": 0.2, "constraints": seen}
    yield duplicates, CostBoundedReach, {"start": "x", "cost_bound": 5}
    yield duplicates, CostBoundedReach, {"start": "x", "cost_bound": 6, "failure_budget": 0.115}
    yield duplicates, GUBS, {"start": "x", "utility": patience, "goal_bonus": 0.5}
    yield duplicates, EGUBS, {"start": "x", "risk_factor": -0.3, "goal_bonus": 0.5}
    few = {"start": "x", "cost_bound": 5, "constraints": {"seen": visits("y") <= 1.2}}
    yield duplicates, CostBoundedReach, few
    for seed in range(int(sys.argv[1])):
        model = drawn(seed, 11 + 3 * (seed % 12))
        discounted = {"start": {"s1": 0.5, "s5": 0.5}, "discount": 0.95}
        for question in ({"start": "s0"}, discounted):
            lowest = least_failure(model, question)
            yield model, S3P, question | {"failure_budget": lowest + 0.3 * (1.0 - lowest)}
    coarse = RobotGrid(segments=12, headings=8)
    robot = {"start": start_state(coarse), "failure_budget": 0.5}
    yield grid_model(coarse), S3P, robot
    walls = {"constraints": {"walls": visits("wall") <= 0.05}}
    yield grid_model(coarse), CostBoundedReach, robot | {"cost_bound": 12} | walls


def check_the_same(model, criterion, **asked):
    """All ranks have one answer, as good as the local one, and proved on the whole model."""
    answer, problem = partitioned(model).solve(criterion, **asked), criterion(model, **asked)
    known = solve(problem)
    figures = answer.objective, answer.lower_bound, answer.failure, dict(answer.prices)
    assert COMM.allgather(figures) == [figures] * COMM.size
    assert answer.objective == pytest.approx(known.objective, rel=1e-9, abs=1e-12), problem
    if answer.failure_price > 0.0:  # else several policies may be as good
        assert answer.failure == pytest.approx(known.budget_used, rel=1e-9, abs=1e-12), problem
    for name, spent in answer.spent.items():
        assert spent == pytest.approx(known.secondary_costs[name], rel=1e-8, abs=1e-10)
    assert answer.gap <= 1e-9, (problem, answer.gap)
    whole = answer.on(problem)
    assert whole.evaluation.objective == pytest.approx(answer.objective, rel=1e-9, abs=1e-12)
    assert certify(whole).accepted, problem


def check_order():
    """States in another order among the ranks: what is done is told by the model's own numbers."""
    model = model_of(DUPLICATES)
    asked = {"start": {"x": 0.25, "y": 0.75}, "failure_budget": 0.1}
    problem, shuffled = S3P(model, **asked), np.array([2, 0, 3, 1])
    answer = PartitionedModel.from_model(model, shuffled).solve(S3P, **asked)
    assert certify(answer.on(problem)).accepted
    assert answer.objective == pytest.approx(solve(problem).objective, rel=1e-9)
    assert answer.policy.weights @ answer.figures[:, 1] == pytest.approx(answer.failure)


def check_cut_short():
    """A search that Ctrl-C ends has a lottery that keeps to the budget, and an honest bound."""
    grid = RobotGrid(segments=20, headings=12)
    made, asked = partitioned(grid_model(grid)), {"start": start_state(grid), "failure_budget": 0.1}
    whole = made.solve(S3P, **asked)

    def interrupts(calls, price, objective):
        """End the search once there is a first lottery."""
        if np.isfinite(objective):
            raise KeyboardInterrupt

    answer = made.solve(S3P, **asked, progress=interrupts)
    assert answer.note
    assert answer.run.pricing_calls < whole.run.pricing_calls
    assert answer.failure <= 0.1 + 1e-12
    assert answer.lower_bound <= whole.objective <= answer.objective * (1.0 + 1e-9)


def check_errors():
    """What is not answered is named on every rank, and the next question is answered."""
    made = partitioned(FIRST)
    for discounted in ({}, {"discount": 0.5}):
        with pytest.raises(InfeasibleError) as caught:
            made.solve(S3P, start="depot", failure_budget=0.001, **discounted)
        assert caught.value.least_failure == pytest.approx(0.01)
    limits = {"few": visits("wreck") <= 0.009}
    with pytest.raises(InfeasibleError) as caught:
        made.solve(S3P, start="depot", failure_budget=0.05, constraints=limits)
    assert caught.value.conflicting_rows == ("few",)
    asked = {"start": "depot", "failure_budget": 0.4, "discount": 0.9}
    asked["constraints"] = {"few": visits("wreck") <= 0.008}
    with pytest.raises(InfeasibleError) as known:
        solve(S3P(FIRST, **asked))
    with pytest.raises(InfeasibleError) as caught:
        made.solve(S3P, **asked)
    for least in ("least_failure", "least_discounted_failure"):
        assert getattr(caught.value, least) == pytest.approx(getattr(known.value, least))
    for budget in (0.5, 1.0):
        with pytest.raises(InfeasibleError, match="the goal cannot be reached"):
            made.solve(S3P, start="wreck", failure_budget=budget)
    for criterion, more in ((CostQuantile, {"level": 0.9}), (S3P, {"cost_levels": 7})):
        with pytest.raises(ModelError, match=r"within a failure budget|knows no cost_levels"):
            made.solve(criterion, start="depot", failure_budget=0.05, **more)
    with pytest.raises(ModelError, match="takes a failure budget below 1"):
        made.solve(S3P, start="depot", failure_budget=1.0, constraints=limits)
    free = model_of(
        {"x": {"go": [(0.5, "y", 0.0), (0.5, "g", 1.0)]}, "y": DUPLICATES["y"], "d": {}}
    )
    with pytest.raises(ModelError, match="action 0 of state 'x' may cost nothing"):
        partitioned(free).solve(S3P, start="x", failure_budget=0.5)
    with pytest.raises(ModelError, match="a checkpoint keeps policies of case M"):
        made.solve(S3P, start="depot", failure_budget=0.05, checkpoint="none.npz")
    assert made.solve(S3P, start="depot", failure_budget=0.05).gap <= 1e-9


if __name__ == "__main__":
    for model, criterion, asked in questions():
        check_the_same(model, criterion, **asked)
    check_order()
    check_cut_short()
    check_errors()
    if COMM.gather(True) is not None:
        print(f"{COMM.size} ranks: well")
