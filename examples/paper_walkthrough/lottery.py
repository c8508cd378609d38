"""The best lottery over the plans of the journey, and its game, in fractions."""

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache

from examples.paper_walkthrough.model import GAMMA, PLANS, Plan, Point, cost, failure, success_cost

Cost = Callable[[Plan, Fraction], Fraction]
ONE = Fraction(1)


class Lottery:
    """A mixture of a plan within the budget and a plan above it that uses the whole budget."""

    def __init__(self, safe: Point, risky: Point, budget: Fraction) -> None:
        """Compute the weight of the riskier plan, and the objective."""
        self.safe, self.risky, self.budget = safe, risky, budget
        self.weight = (budget - safe.condition) / (risky.condition - safe.condition)
        self.objective = safe.objective + self.weight * (risky.objective - safe.objective)

    @property
    def price(self) -> Fraction:
        """Price of a unit of failure: minus the slope between the two plans."""
        spared = self.safe.objective - self.risky.objective
        return spared / (self.risky.condition - self.safe.condition)


def points(of: Cost, discount: Fraction, gamma: Fraction) -> list[Point]:
    """Return all plans; J_obj is discounted with ``discount``, J_cond with ``gamma``."""
    return [Point(of(p, discount), failure(p, gamma), p) for p in PLANS]


def best_lottery(plans: Sequence[Point], budget: Fraction) -> Lottery:
    """Return the cheapest lottery of a budget that some plan exceeds."""
    safe = [p for p in plans if p.condition <= budget]
    risky = [p for p in plans if p.condition > budget]
    # Only a pair of neighbours on the lower hull can be best; trying all pairs needs no hull.
    return min((Lottery(s, r, budget) for s in safe for r in risky), key=lambda z: z.objective)


@cache
def optimum_m(discount: Fraction, gamma: Fraction, budget: Fraction) -> Lottery:
    """Return c* of case M (Theorem 3-2): discount 1 is the paper's J_obj, gamma section 3.5's."""
    return best_lottery(points(cost, discount, gamma), budget)


@cache
def numerator_s(discount: Fraction, gamma: Fraction, budget: Fraction) -> Lottery:
    """Return J_obj of case S at a budget; divided by 1 - budget it is c* of that budget."""
    return best_lottery(points(success_cost, discount, gamma), budget)


def adversary(objective: Fraction, price: Fraction, budget: Fraction) -> Fraction:
    """Return alpha* = J_obj / (J_obj + price * epsilon), the adversary's optimal weight.

    At alpha* the game charges failure its price: eta / epsilon (1 - alpha) / alpha = price. In case
    M J_obj = c* and the price is lambda; in case S J_obj = c* (1 - epsilon), the price kappa.
    """
    return objective / (objective + price * budget)


def payoff(plan: Point, alpha: Fraction, scale: Fraction) -> Fraction:
    """Return J_{c,gamma,epsilon}: a plan's line in alpha."""
    return alpha * plan.objective + (1 - alpha) * scale * plan.condition


def best_plan(plans: Sequence[Point], alpha: Fraction, scale: Fraction) -> Point:
    """Return the best response to alpha."""
    return min(plans, key=lambda p: payoff(p, alpha, scale))


def best_payoff(plans: Sequence[Point], alpha: Fraction, scale: Fraction) -> Fraction:
    """Return J*(alpha): the least of the plans' lines, so it is concave."""
    return payoff(best_plan(plans, alpha, scale), alpha, scale)


def game_value(plans: Sequence[Point], scale: Fraction) -> Fraction:
    """Return the game's value, at the crossing of a rising and a falling line."""
    rising = [p for p in plans if p.objective >= scale * p.condition]
    falling = [p for p in plans if p.objective < scale * p.condition]
    return min(_crossing(up, down, scale) for up in rising for down in falling)


def _crossing(up: Point, down: Point, scale: Fraction) -> Fraction:
    high = up.objective - scale * up.condition
    low = scale * down.condition - down.objective
    return (low * up.objective + high * down.objective) / (low + high)


BAYES_POINTS = points(cost, ONE, GAMMA)
"""The game of sections 3.2 to 3.4 in case M: J_obj undiscounted, J_cond discounted."""
