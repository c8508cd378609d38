"""Convergence of the constructions of section 3 on the paper's robot as gamma -> 1."""

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from ssp_lp import MCMP, InfeasibleError, evaluate, solve
from ssp_lp.game import bayes_adaptive, stationary_game

GAMMAS = (0.99, 0.999, 0.9999, 0.99999)
BUDGET = 0.05


def robot_text(grid: RobotGrid) -> str:
    """Return the table of case M, at a budget of 5 %."""
    model, start = grid_model(grid), start_state(grid)
    lines = [
        "| gamma | c-hat (3.5) | c* (3.2 to 3.4) | true cost of the stationary policy |",
        "|---|---|---|---|",
    ]
    for gamma in GAMMAS:
        problem = MCMP(model, start=start, failure_budget=BUDGET, discount=gamma)
        lines.append(f"| {gamma:g} | {_numbers(problem)} |")
    exact = solve(MCMP(model, start=start, failure_budget=BUDGET)).objective
    return "\n".join([*lines, f"| exact | {exact:.6f} | {exact:.6f} | {exact:.6f} |"])


def _numbers(problem: MCMP) -> str:
    # A budget near the least failure may be too small for gamma: success at step t counts as
    # failure to the extent of 1 - gamma^t.
    try:
        hat = stationary_game(problem)
    except InfeasibleError as error:
        return f"infeasible: L_d is at least {error.least_discounted_failure:.6f} | |"
    star = bayes_adaptive(problem)
    true = evaluate(hat.policy, problem).expected_cost
    return f"{hat.objective:.6f} | {star.objective:.6f} | {true:.6f}"
