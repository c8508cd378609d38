"""A question put to the library about one model, with its exact answer.

An answer comes with the numbers that count as equal to it. Three things make that more than one:

* a budget is a float and is kept within rounding: where the optimum falls steeply the neighbours of
  a budget count (`ROUNDING`; `ROOM` for limits, as the library documents);
* a policy that breaks its budget by `SPECK` is not told apart from one that keeps to it;
* at least failure the library keeps what lies within 1e-12 of the greatest goal probability, so
  the cheapest policy within `NEAR` of it counts as a near tie.
"""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from ssp_lp import SSP
from tests.campaigns.rational.policies import Evaluated, Exact

ROUNDING = Fraction(1, 10**14)  # relative, of budgets
ROOM = Fraction(2, 10**10)  # relative, of limits
SPECK = Fraction(2, 10**15)  # absolute, of failures
NEAR = Fraction(1, 10**11)  # relative, of the greatest goal probability


@dataclass(frozen=True)
class Question:
    """A criterion on a model, and what it is."""

    criterion: str
    asked: str  # the settings, in words
    problem: Callable[[SSP], Any]
    answer: Fraction | None  # None: infeasible
    equals: Callable[[], tuple[Fraction, Fraction]] | None = None  # least and greatest
    near_tie: Fraction | None = None  # what a tie within `NEAR` would give
    least: Fraction | None = None  # least failure, where the answer must have it
    budget: float | None = None
    tolerance: float = 1e-9


def total_cost(
    exact: Exact, one: Evaluated, give_up: str, charged: bool, *, second: bool, both: bool = False
) -> Fraction | None:
    """A cost of a policy; None if the policy does not count. `both`: neither cost is for ever."""
    totals = one.until_hopeless
    if give_up == "dead_ends":
        found = one.second_until_dead if both else one.until_dead
        if found is None:
            return None
        totals = found
    elif give_up == "attention" and not one.stops <= exact.attention:
        return None
    value = totals.second if second else totals.cost
    if charged:
        for state, mass in totals.ends.items():
            if give_up != "dead_ends" or state in exact.dead_ends:
                value += mass * exact.charge(state, give_up, second)
    return value
