"""The two MDPs of a problem's case, from which every player of the game is made."""

from __future__ import annotations

from ssp_lp.game.models import LabelModels, label_models
from ssp_lp.game.setting import check_reachable, checked_setting
from ssp_lp.problem import Problem, unrolled
from ssp_lp.processes.failure_semantics import start_distribution
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost, accumulate_cost


def construct(problem: Problem) -> LabelModels | AccumulatedCost:
    """Build M_o and M_{d,gamma} of section 3.1: labelled in case M, with the cost in case S.

    Raises:
        ModelError: no discount, or a budget that is not above 0.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    discount, problem = checked_setting(problem)[1], unrolled(problem)
    start = start_distribution(problem.model, problem.start)
    if not problem.ratio:
        return label_models(problem.model, start, problem.semantics, discount)
    check_reachable(problem)
    return accumulate_cost(problem.model, start, discount)
