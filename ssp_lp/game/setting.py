"""What a problem must bring so that the paper's game can be played on it, and its two MDPs."""

from __future__ import annotations

from ssp_lp.accumulated_cost.process import AccumulatedCost, accumulate_cost
from ssp_lp.accumulated_cost.totals import resolution_of_costs
from ssp_lp.errors import Argument, InfeasibleError, ModelError
from ssp_lp.game.label_player import LabelModels, label_models
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.problem import Problem, unrolled
from ssp_lp.processes.failure_semantics import start_distribution
from ssp_lp.processes.goal_reach import max_goal_probability


def checked_setting(problem: Problem) -> tuple[float, float]:
    """The failure budget and the discount.

    Raises:
        ModelError: the paper's construction needs a discount and a budget above 0.
    """
    budget, discount = problem.failure_budget, problem.discount
    if not problem.semantics.counts_cost_alone:
        raise ModelError(
            f"the game is about cost and a failure budget, {type(problem).__name__} is not: take ",
            Argument("method", "columns"),
        )
    if discount is None:
        raise ModelError(
            "the game needs a discount (paper, section 2.5): give ",
            Argument("discount", 0.999),
            ", or solve the exact problem with ",
            Argument("method", "columns"),
        )
    if budget is None or budget <= 0.0:
        raise ModelError(
            "the game needs ",
            Argument("failure_budget"),
            f" above 0, not {budget!r}: its stakes are divided by it (paper, eq. j_c_gamma_def)",
        )
    return budget, discount


def infeasible(problem: Problem, budget: float, discounted: float) -> InfeasibleError:
    """The game's setting is infeasible: no policy's discounted failure keeps to the budget."""
    problem = unrolled(problem)
    start = start_distribution(problem.model, problem.start)
    real = max(1.0 - float(start @ max_goal_probability(problem.model)), 0.0)
    nearer = "; a discount nearer to 1 is feasible" if real < budget else ""
    return InfeasibleError(
        f"the discounted failure of every policy is at least {discounted:.12g}, above the budget "
        f"{budget:g}; the least real failure probability is {real:.12g}{nearer}",
        failure_budget=budget,
        least_failure=real,
        least_discounted_failure=discounted,
    )


def check_reachable(problem: Problem) -> None:
    """Check that a cost given success exists.

    Raises:
        InfeasibleError: the goal cannot be reached from the start.
    """
    start = start_distribution(problem.model, problem.start)
    if (start[~dead_ends(problem.model)] > 0.0).any():
        return
    raise InfeasibleError(
        "the goal cannot be reached from the start: no cost given success exists",
        failure_budget=problem.failure_budget,
        least_failure=1.0,
        least_discounted_failure=1.0,
    )


def construct(problem: Problem) -> LabelModels | AccumulatedCost:
    """Build the setting's M_o and M_{d,gamma} of section 3.1: in case M labelled.

    Raises:
        ModelError: no discount, or a budget that is not above 0.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    discount, problem = checked_setting(problem)[1], unrolled(problem)
    start = start_distribution(problem.model, problem.start)
    if not problem.ratio:
        return label_models(problem.model, start, problem.semantics, discount)
    check_reachable(problem)
    by_steps = resolution_of_costs(problem.model) is not None
    return accumulate_cost(problem.model, start, discount, by_steps=by_steps)
