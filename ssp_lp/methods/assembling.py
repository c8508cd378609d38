"""The one place that puts a solution together, whatever method found it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ssp_lp.arrays import FloatArray, read_only
from ssp_lp.column_generation.failure_row import least_of
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import AS_ASKED, ObjectiveSense
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.solution import Run, Solution


@dataclass(frozen=True, eq=False)
class Found:
    """What a method found, in what it minimises."""

    policy: MixedPolicy | Policy
    value: float
    bound: float  # no policy that keeps to the limits has less; rounding above the value is cut
    failure: float  # of the policy
    price: float | None = None  # multiplier of the failure row; None where there is none
    values: FloatArray | None = None  # the checked sub-solution
    prices: Mapping[str, float] = field(default_factory=dict)  # multipliers of all rows, by name
    note: str = ""


def assembled(
    problem: Problem, found: Found, run: Run, sense: ObjectiveSense = AS_ASKED
) -> Solution:
    """The solution, assembled in the problem's own terms.

    Args:
        problem: the problem.
        found: what was found.
        run: how.
        sense: how what was minimised stands for what is asked.

    Raises:
        SolverError: the bound lies above the value by more than rounding.
    """
    policy = found.policy
    if not isinstance(policy, MixedPolicy):
        policy = MixedPolicy((policy,), np.ones(1))
    bound = sense.settled_bound(found.value, least_of(found.bound, found.value))
    objective, limit = sense.worth(found.value), sense.worth(bound)
    maximised, prices = sense.constant is not None, found.prices
    if not prices and found.price is not None and not problem.semantics.forbids_failing:
        prices = {FAILURE_ROW: found.price}
    return Solution(
        problem=problem,
        policy=policy,
        objective=objective,
        lower_bound=objective if maximised else limit,
        failure_price=None if found.price is None else found.price + problem.semantics.penalty,
        value_function=None if found.values is None else read_only(found.values),
        budget_used=found.failure,
        run=run,
        note=found.note,
        upper_bound=max(limit, objective) if maximised else None,
        prices=prices,
    )
