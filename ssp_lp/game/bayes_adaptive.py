"""c* of the unapproximated game (paper, sections 3.2 to 3.4): the Bayes-adaptive construction.

J_obj is undiscounted and J_cond discounted: the problem that sections 3.2 to 3.4 solve, and that
section 3.5 approximates by discounting J_obj as well. The adversary's weight is a belief about
which MDP is being played. Both move alike, but M_{d,gamma} ends with probability 1 - gamma in each
step. So a run that goes on is evidence for M_o, the same evidence whatever happens in it: the
belief follows one trajectory from each start.
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import check_between_0_and_1, wrong_argument
from ssp_lp.game.bayes_cost_player import BayesCostPlayer
from ssp_lp.game.bayes_label_player import BayesLabelPlayer
from ssp_lp.game.best_response import check_alpha
from ssp_lp.game.label_player import LabelModels
from ssp_lp.game.optimum import GameSolution, find_optimum
from ssp_lp.game.setting import construct
from ssp_lp.options import Progress
from ssp_lp.problem import Problem


def bayes_player(problem: Problem) -> BayesLabelPlayer | BayesCostPlayer:
    """The operator T of section 3.3 in the problem's case.

    Raises:
        ModelError: no discount, or a budget that is not above 0.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    built = construct(problem)
    return BayesLabelPlayer(built) if isinstance(built, LabelModels) else BayesCostPlayer(built)


def bayes_adaptive(
    problem: Problem, *, tolerance: float = 1e-7, progress: Progress | None = None
) -> GameSolution:
    """Solve the game of section 3.2 over all policies, by the iteration of section 3.3.

    Args:
        problem: with a discount, which only J_cond sees, and a failure budget above 0.
        tolerance: relative distance between c* and its lower bound to reach.
        progress: told after each game of (responses, price of failure, upper end).

    Returns:
        c*: in case M J_obj, in case S J_obj / (1 - J_cond); its policies depend on time.

    Raises:
        ModelError: no discount, no budget or one of 0, a tolerance outside (0, 1), or a table of
            decisions that would be too large; it grows with the length of runs.
        InfeasibleError: the discounted failure of every policy exceeds the budget.
    """
    check_between_0_and_1("tolerance", tolerance)
    player = bayes_player(problem)
    return find_optimum(problem, player, tolerance=tolerance, progress=progress)


def posterior(alpha: float, discount: float) -> float:
    """nu(alpha)(M_o), the adversary's weight of M_o after one step of a run that goes on.

    Args:
        alpha: the weight before the step, in [0, 1].
        discount: gamma, with which M_{d,gamma} goes on after each step, in (0, 1).

    Returns:
        ``alpha / (alpha + gamma (1 - alpha))``, Bayes' rule (paper, section 3.3).

    Raises:
        ModelError: an argument out of range.
    """
    return float(belief_at(alpha, discount, np.array(1)))


def belief_at(alpha: float, discount: float, time: IntArray) -> FloatArray:
    """The adversary's weight of M_o after so many steps of a run that goes on.

    Args:
        alpha: the weight at the start, in [0, 1].
        discount: gamma, with which M_{d,gamma} goes on after each step, in (0, 1).
        time: numbers of steps, >= 0, in any shape.

    Returns:
        ``alpha / (alpha + gamma^t (1 - alpha))``, in the shape of ``time``: ``posterior`` applied
        t times (paper, section 3.3).

    Raises:
        ModelError: an argument out of range.
    """
    check_alpha(alpha)
    check_between_0_and_1("discount", discount)
    steps = np.asarray(time)
    if not np.issubdtype(steps.dtype, np.integer) or (steps < 0).any():
        raise wrong_argument("time", "be whole numbers >= 0", time)
    if alpha == 0.0:
        return np.zeros(steps.shape)  # also where gamma^t is 0 in double precision
    return np.asarray(alpha / (alpha + discount**steps * (1.0 - alpha)), dtype=np.float64)
