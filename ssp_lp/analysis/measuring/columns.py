"""What is totalled over a policy's chain: rewards of decisions, and the worth of where it ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.analysis.failure_costs import state_give_up_charges
from ssp_lp.arrays import BoolArray, FloatArray
from ssp_lp.model.graph.reachability import dead_ends, end_marks
from ssp_lp.problem import Problem
from ssp_lp.processes.expectations import cost_means
from ssp_lp.processes.failure_semantics import GiveUp, dead_end_charges, survival_of


@dataclass(frozen=True, eq=False)
class Column:
    """One total: ``v(x) = reward + survival * E[v(next)]`` where something is still open."""

    ends: FloatArray  # [states] value at goals and dead-ends
    survival: float = 1.0  # factor of what is to come
    until_lost: bool = True  # open while the goal can be reached; else while some end can be
    each: float = 0.0  # reward of every decision
    reward: FloatArray | None = None  # [pairs] beside it
    gives_up: FloatArray | float = 0.0  # [states] reward of giving up
    lost: FloatArray | float = 0.0  # [states] value where nothing is open
    goes_on: bool = False  # costs go on where the goal is lost, until a dead-end is entered
    prices: int | None = None  # the column whose next value, times the cost, counts besides


GOAL, FAILED, SUCCESS_COST, STOPPED = range(4)


@dataclass(frozen=True, eq=False)
class Columns:
    """All that an evaluation totals: the first four undiscounted, then by end, then discounted."""

    columns: tuple[Column, ...]
    names: tuple[str, ...]  # of the ends that may occur, but the goal
    forbidden: BoolArray  # [states] where the policy may not give up
    forbids_failing: bool


def columns_of(problem: Problem, *, gives_up: bool) -> Columns:
    """The totals of a problem that limits nothing but failure.

    Args:
        problem: the problem.
        gives_up: whether the policy does so anywhere.
    """
    model, semantics = problem.model, problem.semantics
    goal, dead = model.goal_mask.astype(np.float64), dead_ends(model).astype(np.float64)
    charge = state_give_up_charges(model, semantics)
    entering = dead_end_charges(model, dead_ends(model), semantics)
    goes_on, stage = semantics.give_up is GiveUp.DEAD_ENDS, cost_means(model)
    allowed = np.where(np.isinf(charge), 0.0, charge)

    def four(survival: float, first: int) -> list[Column]:
        """Goal, failure, cost of success and cost until failure."""
        leak = 1.0 - survival
        return [
            Column(goal, survival),
            Column(dead, survival, each=leak, gives_up=survival, lost=1.0),
            Column(0.0 * goal, survival, prices=first + GOAL),
            Column(entering, survival, reward=stage, gives_up=allowed, lost=allowed,
                   goes_on=goes_on),
        ]  # fmt: skip

    marks, names, ends = end_marks(model), list[str](), list[Column]()
    for number, name in enumerate((*model.state_labels, "dead_end"), start=1):
        if (marks == number).any():
            names.append(name)
            ends.append(Column((marks == number).astype(np.float64), until_lost=False))
    if gives_up:
        names.append("gave_up")
        ends.append(Column(0.0 * goal, until_lost=False, gives_up=1.0))
    found, gamma = four(1.0, 0) + ends, survival_of(problem.discount)
    if gamma < 1.0:
        found += four(gamma, len(found))
    return Columns(tuple(found), tuple(names), np.isinf(charge), semantics.forbids_failing)
