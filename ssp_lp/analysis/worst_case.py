"""The worst case of a policy over all probabilities in boxes, separately for each measure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from ssp_lp.arrays import FloatArray, segment_sums
from ssp_lp.errors import ModelError
from ssp_lp.model.boxes import Boxes, greatest_mean
from ssp_lp.model.graph import dead_ends, end_marks
from ssp_lp.model.report import ByName, Facts, Table
from ssp_lp.policies.boxed_chain import BoxedChain, boxed_chain
from ssp_lp.policies.policy import MixedPolicy, Policy, as_lottery
from ssp_lp.problem import Problem, check_measures, check_problem, on_one_model
from ssp_lp.processes.failure_semantics import (
    Aim,
    FailureSemantics,
    GiveUp,
    dead_end_charges,
    give_up_charges,
)
from ssp_lp.processes.live_rows import costless_pairs


@dataclass(frozen=True, repr=False)
class WorstCase(Facts):
    """Worst measures of a policy over boxes, each at the probabilities that are worst for it.

    The measures need not occur together: probabilities that maximise the cost need not maximise the
    failure. If ``is_exact``, each measure is attained (or approached) by one choice of
    probabilities. Otherwise ``goal_probability`` is a lower bound, and all other measures are upper
    bounds.
    """

    goal_probability: float  # least
    failure_probability: float  # greatest; 1 - goal_probability
    expected_cost: float  # greatest E[r_tau]: until failure is declared, charges included
    objective: float  # worst value of the problem's objective
    ends: Mapping[str, float]  # greatest probability of each way to fail
    is_exact: bool

    @property
    def conditional_cost(self) -> float:
        """The worst cost given success, which is not available.

        Raises:
            ModelError: always.
        """
        raise ModelError(
            "the worst cost given success is not computed (worst cost divided by least goal "
            "probability may be far above it): use expected_cost and failure_probability"
        )

    def tables(self) -> list[Table]:
        """Return a table of all measures, with a note that they need not occur together."""
        note = "each at its own probabilities: they need not occur together"
        if not self.is_exact:
            note += "; bounds: each policy of a lottery, or each visit, has its own worst case"
        return [
            Table([
                ("worst objective", self.objective),
                ("goal, at least", self.goal_probability),
                ("failure, at most", self.failure_probability),
                ("cost until failure, at most", self.expected_cost),
                *((f"{name}, at most", share) for name, share in self.ends.items() if share),
                ("note", note),
            ])
        ]  # fmt: skip


def worst_case(policy: Policy | MixedPolicy, problem: Problem, boxes: Boxes) -> WorstCase:
    """Evaluate a policy at its worst probabilities in boxes.

    Failing is declared as soon as the goal cannot be reached by any outcomes that the boxes allow.

    Args:
        policy: on the problem's model, or on a model with other probabilities of the same outcomes.
        problem: problem with the start and the semantics.
        boxes: boxes of the problem's model.

    Raises:
        ModelError: boxes of another model; a problem with a horizon, a discount, constraints, or a
            cost given success or a measure of its law; or as in ``evaluate``.
    """
    check_problem(problem, "evaluate")
    check_measures(problem)
    if problem.box is not None:
        problem = replace(cast("Any", problem), box=None)
    boxes.check_model(problem.model)
    lottery = as_lottery(policy)
    if lottery.model is not problem.model and boxes.fits(lottery.model):
        restated = (replace(cast("Any", one), model=problem.model) for one in lottery.policies)
        lottery = MixedPolicy(tuple(restated), lottery.weights)
    lottery, problem = on_one_model(lottery, problem, "evaluate")
    start = problem.start_mass
    weights, members = zip(*((w, one) for w, one in lottery.weighted if w > 0.0), strict=True)
    chains = [boxed_chain(boxes, one, start) for one in members]
    measures = [_measures(boxed, problem, boxes) for boxed in chains]
    failure, cost, objective, *ends = (np.array(weights) @ np.array(measures)).tolist()
    failure = min(failure, 1.0)
    names = [*problem.model.state_labels, "dead_end", "gave_up", "wandering"]
    exact = len(chains) == 1 and chains[0].is_exact
    ways = ByName(zip(names, ends, strict=True))
    return WorstCase(1.0 - failure, failure, cost, objective, ways, exact)


def _measures(boxed: BoxedChain, problem: Problem, boxes: Boxes) -> list[float]:
    """Return a policy's worst failure, cost, objective and probability of each way to fail."""
    chain, semantics = boxed.chain, problem.semantics
    failing = boxed.failing()
    failure = float(chain.start @ failing)
    cost = _cost(boxed, semantics, boxes, 0.0)
    objective = cost
    if semantics.forbids_failing:
        objective = cost = np.inf if failure > 0.0 else cost
    elif semantics.penalty > 0.0:
        objective = _cost(boxed, semantics, boxes, semantics.penalty)
    elif semantics.aim is Aim.GREATEST_GOAL:
        objective = 1.0 - failure
    elif semantics.aim is Aim.LEAST_GOAL:
        objective = _reach(boxed, chain.goal)
    marks = end_marks(problem.model)[chain.state]
    over = ~boxed.acting & (chain.give_up == 0.0)
    ways = [
        _reach(boxed, (over & (marks == k)).astype(np.float64))
        for k in range(1, len(problem.model.state_labels) + 2)
    ]
    gave_up = _reach(boxed, np.zeros(chain.n_nodes), 1.0)
    wandering = boxed.staying(boxed.acting & (chain.give_up == 0.0))
    return [failure, cost, objective, *ways, gave_up, _reach(boxed, wandering.astype(np.float64))]


def _reach(boxed: BoxedChain, ends: FloatArray, at_stop: float = 0.0) -> float:
    """Return the greatest probability of reaching some nodes from the start.

    Args:
        boxed: the policy's chain, with intervals of its probabilities.
        ends: 1 at these nodes, 0 elsewhere, [nodes].
        at_stop: 1 if giving up counts as well, otherwise 0.
    """
    nothing, inside = np.zeros(len(boxed.low)), (ends == 0.0) & (boxed.chain.goal == 0.0)
    values = boxed.greatest(nothing, ends, inside, at_stop=at_stop)
    return float(boxed.chain.start @ values)


def _cost(boxed: BoxedChain, semantics: FailureSemantics, boxes: Boxes, penalty: float) -> float:
    """Return the greatest cost until failure from the start, with a penalty for failing."""
    chain = boxed.chain
    inside = boxed.acting if semantics.give_up is GiveUp.DEAD_ENDS else chain.alive
    stopping, entering = worst_charges(semantics, boxes)
    if np.isinf(stopping[chain.state[chain.give_up > 0.0]]).any():
        raise ModelError(f"the policy gives up where give_up={str(semantics.give_up)!r} forbids it")
    lost = ~inside & (chain.goal == 0.0)
    stop = np.where(chain.give_up > 0.0, stopping[chain.state], 0.0) + penalty
    ends = np.where(chain.dead > 0.0, entering[chain.state], stopping[chain.state])
    ends = np.where(lost, np.where(np.isinf(ends), 0.0, ends) + penalty, 0.0)
    if boxed.collects_for_ever(chain.cost, inside):
        return np.inf
    wandering = boxed.staying(inside & boxed.acting & (chain.give_up == 0.0))
    claim = np.where(wandering, penalty, 0.0)
    values = boxed.greatest(chain.cost, ends, inside, at_stop=stop, claim=claim)
    return float(chain.start @ values)


def worst_charges(semantics: FailureSemantics, boxes: Boxes) -> tuple[FloatArray, FloatArray]:
    """Return the worst charges of giving up, infinite if forbidden, and of dead-ends, [states]."""
    model = boxes.support
    chosen = greatest_mean(boxes.low, boxes.high, model.costs, model.outcome_offsets)
    costs = segment_sums(chosen * model.costs, model.outcome_offsets)
    wandering = np.zeros(model.n_states, dtype=np.bool_)
    if semantics.give_up is GiveUp.DEAD_ENDS:
        wandering = model.staying_free(costless_pairs(model))
    stopping = give_up_charges(model, wandering, semantics, costs)
    return stopping, dead_end_charges(model, dead_ends(model), semantics, costs)
