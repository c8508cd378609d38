"""c* of the unapproximated game (paper, sections 3.2 to 3.4): the Bayes-adaptive construction.

J_obj is undiscounted and J_cond discounted: the problem that sections 3.2 to 3.4 solve, and that
section 3.5 approximates by discounting J_obj as well.
"""

from __future__ import annotations

from dataclasses import dataclass

from ssp_lp.crosscheck.bayes_cost import BayesCostPlayer
from ssp_lp.crosscheck.bayes_label import BayesLabelPlayer
from ssp_lp.crosscheck.models import label_models
from ssp_lp.crosscheck.optimum import Optimum, find_optimum
from ssp_lp.crosscheck.setting import check_reachable, checked_setting
from ssp_lp.crosscheck.stationary import lottery
from ssp_lp.crosscheck.threshold import ENDLESS, Patience
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.process.accumulated_cost import accumulate_cost
from ssp_lp.process.semantics import start_distribution

BayesPlayer = BayesLabelPlayer | BayesCostPlayer


@dataclass(frozen=True, eq=False)
class BayesAdaptive:
    """c*_{gamma,epsilon} with its proof, alpha*, and the non-stationary mixed policy."""

    problem: Problem
    player: BayesPlayer
    optimum: Optimum

    @property
    def objective(self) -> float:
        """c*, attained by the policy: undiscounted J_obj, in case S over 1 - J_cond."""
        return self.optimum.objective

    @property
    def lower_bound(self) -> float:
        """No policy within the budget has less; J_cond, the budget's row, is discounted."""
        return self.optimum.lower_bound

    @property
    def alpha(self) -> float:
        """alpha*: the adversary's weight of the objective MDP at epsilon*."""
        return self.optimum.alpha

    @property
    def policy(self) -> MixedPolicy:
        """A lottery over one or two deterministic policies that depend on time."""
        return lottery(self.player, self.optimum.threshold)


def bayes_player(problem: Problem) -> BayesPlayer:
    """The operator T of section 3.3 in the problem's case.

    Raises:
        ModelError: no discount, or a budget that is not above 0.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    discount = checked_setting(problem)[1]
    start = start_distribution(problem.model, problem.start)
    if not problem.ratio:
        return BayesLabelPlayer(label_models(problem.model, start, problem.semantics, discount))
    check_reachable(problem)
    return BayesCostPlayer(accumulate_cost(problem.model, start, discount))


def bayes_adaptive(
    problem: Problem, *, tolerance: float = 1e-7, patience: Patience = ENDLESS
) -> BayesAdaptive:
    """Solve the game of section 3.2 over all policies, by the iteration of section 3.3.

    Args:
        problem: with a discount, which only J_cond sees, and a failure budget above 0.
        tolerance: relative distance between c* and its lower bound to reach.
        patience: when to stop before that, with the bounds as they are.

    Raises:
        ModelError: no discount, no budget, or a table of decisions that would be too large.
        InfeasibleError: the discounted failure of every policy exceeds the budget.
    """
    player = bayes_player(problem)
    optimum = find_optimum(problem, player, tolerance=tolerance, patience=patience)
    return BayesAdaptive(problem, player, optimum)
