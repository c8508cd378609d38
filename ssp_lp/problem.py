"""What makes a problem: a formulation hands this to ``solve``, ``evaluate`` and ``simulate``."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from numbers import Integral, Real
from typing import Protocol, cast, overload

from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.column_generation.compiled_problems.compiled_problem import CompiledProblem
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.in_short import in_short
from ssp_lp.processes.failure_semantics import FailureSemantics, start_distribution
from ssp_lp.processes.goal_reach import greatest_goal_reach
from ssp_lp.processes.layered.arrival_cost import TOTAL_COST
from ssp_lp.processes.quantities.conditions import Condition
from ssp_lp.processes.totals.ladder import Rungs, rungs_for
from ssp_lp.processes.totals.sums import MOST_SUMS


class Problem(Protocol):
    """A criterion on a model with a start and a failure budget.

    ``formulations`` holds the criteria of the literature; a class of your own with these members
    is a first-class problem too. Where failing is not limited but has its price, ``failure_budget``
    is 1 and ``semantics`` names the penalty; where only the goal counts, ``semantics`` says so.
    """

    @property
    def model(self) -> SSP:
        """The model."""
        ...

    @property
    def start(self) -> Hashable | Mapping[Hashable, float]:
        """A state, or a distribution over states."""
        ...

    @property
    def failure_budget(self) -> float | None:
        """Allowed failure probability; None: as low as possible."""
        ...

    @property
    def discount(self) -> float | None:
        """None: exact; a number: the surrogate of section 3.5 of the paper."""
        ...

    @property
    def ratio(self) -> bool:
        """Whether cost is counted given success (case S)."""
        ...

    @property
    def semantics(self) -> FailureSemantics:
        """What an episode is worth: what is counted and what failing costs."""
        ...

    def compile(self) -> CompiledProblem:
        """The augmented process, ready for a method."""
        ...


def conditions_of(problem: Problem) -> tuple[Condition, ...]:
    """The constraints of a problem beside its failure budget; a class of your own may have none."""
    found: tuple[Condition, ...] = getattr(problem, "conditions", ())
    return found


def objective_of(problem: Problem) -> Condition | None:
    """The quantity that a problem minimises in place of its cost; None: there is none."""
    found: Condition | None = getattr(problem, "objective_condition", None)
    return found


def has_rows(problem: Problem) -> bool:
    """Whether a problem has constraints or an objective that only the methods for rows know."""
    return bool(conditions_of(problem)) or objective_of(problem) is not None


def rungs_of(problem: Problem) -> Rungs | None:
    """What is asked of the totals that are told apart; None where multiples of a unit serve."""
    asked: int | None = getattr(problem, "cost_levels", None)
    cap: float | None = getattr(problem, "cost_cap", None)
    of_law = problem.semantics.measure is not None
    if not of_law and not problem.ratio:
        return None
    if not of_law and asked is None and problem.failure_budget is None and not has_rows(problem):
        return None  # at least failure no cost has to be remembered
    return rungs_for(problem.model, asked, cap, of_law=of_law)


def by_sums(problem: Problem) -> bool:
    """Whether totals are the sums that can occur, each a layer of backward sweeps."""
    of_law = problem.semantics.measure is not None
    if has_rows(problem) or (not of_law and _is_cut(problem)):
        return False
    return (rungs := rungs_of(problem)) is not None and rungs.most == MOST_SUMS


def _is_cut(problem: Problem) -> bool:
    """Whether case S is discounted, or its costs are told apart up to a cap of the user's."""
    return problem.discount is not None or getattr(problem, "cost_cap", None) is not None


def by_rows(problem: Problem) -> bool:
    """Whether the methods for several rows solve a problem."""
    return has_rows(problem) or (rungs_of(problem) is not None and not by_sums(problem))


def compiled_constrained(problem: Problem) -> CompiledConstrained:
    """The process of a problem with constraints, and its rows."""
    measure, objective = problem.semantics.measure, objective_of(problem)
    charge = TOTAL_COST if problem.ratio else None
    return CompiledConstrained(
        model=problem.model,
        start=start_distribution(problem.model, problem.start),
        semantics=problem.semantics,
        discount=problem.discount,
        side=tuple(row for condition in conditions_of(problem) for row in condition.rows),
        budget=problem.failure_budget,
        charge=charge if measure is None else measure.charge,
        ratio=problem.ratio,
        fixed_cap=getattr(problem, "cost_cap", None),
        objective=None if objective is None else objective.minimised(),
        rungs=rungs_of(problem),
    )


class _WithReachFraction(Protocol):
    """A problem whose budget may be stated as a share of the greatest goal probability."""

    @property
    def model(self) -> SSP: ...

    @property
    def start(self) -> Hashable | Mapping[Hashable, float]: ...

    @property
    def reach_fraction(self) -> float | None: ...


class _Shared(float):
    """A budget that a share made: handed on to a copy of its problem, it states nothing."""


class FailureBudget:
    """The field ``failure_budget`` of a problem that may be given ``reach_fraction`` instead.

    The budget is then ``1 - reach_fraction * greatest goal probability``, worked out when it is
    first asked for: stating a problem solves nothing.
    """

    def __set__(self, problem: _WithReachFraction, value: float | None) -> None:
        """Keep what was stated."""
        vars(problem)["_stated_budget"] = None if isinstance(value, _Shared) else value

    @overload
    def __get__(self, problem: None, owner: type[object]) -> None: ...
    @overload
    def __get__(self, problem: _WithReachFraction, owner: type[object]) -> float | None: ...
    def __get__(self, problem: _WithReachFraction | None, owner: type[object]) -> float | None:
        """The budget; asked of the class, the default: least failure."""
        if problem is None:
            return None
        share, known = problem.reach_fraction, vars(problem)
        if share is None:
            return stated_budget(problem)
        if "_budget" not in known:
            known["_budget"] = _Shared(budget_of_share(problem.model, problem.start, share))
        found: float = known["_budget"]
        return found


BUDGET_OR_SHARE = FailureBudget()
"""The default of the field; what is stated is kept in the problem, so that one serves all."""


def stated_budget(problem: _WithReachFraction) -> float | None:
    """The budget that a problem was given, whatever its ``reach_fraction`` makes of it."""
    stated: float | None = vars(problem)["_stated_budget"]
    return stated


def budget_of_share(
    model: SSP, start: Hashable | Mapping[Hashable, float], reach_fraction: float
) -> float:
    """The failure budget that asks for a share of the greatest goal probability.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        reach_fraction: the share, in [0, 1].
    """
    greatest = float(start_distribution(model, start) @ greatest_goal_reach(model).goal)
    return min(max(1.0 - reach_fraction * greatest, 0.0), 1.0)


def is_whole(value: object) -> bool:
    """Whether a value is a whole number, Python's or numpy's, and no truth value."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def check_problem(problem: object, verb: str) -> None:
    """Check that what should be a problem has a start and says what is asked.

    Raises:
        ModelError: a model alone, or something else; ``verb`` is what was to be done with it.
    """
    if not (hasattr(problem, "model") and hasattr(problem, "semantics")):
        raise ModelError(
            f"{verb} takes a problem, such as MCMP(model, start=..., failure_budget=...), not "
            f"{in_short(problem)}"
        )


def check_policy(policy: object, problem: object, verb: str) -> None:
    """Check that a policy and a problem are what they should be, on one model.

    Raises:
        ModelError: a solution, or something else, in place of the policy; no problem; two models.
    """
    check_problem(problem, verb)
    if hasattr(policy, "policy") and hasattr(policy, "problem"):
        raise ModelError(f"{verb} takes a policy: pass solution.policy")
    if not hasattr(policy, "model") or hasattr(policy, "semantics"):
        raise ModelError(
            f"{verb} takes a policy, such as solution.policy or DeterministicPolicy.from_actions("
            f"model, {{state: action}}), not {in_short(policy)}"
        )
    theirs, mine = policy.model, cast("Problem", problem).model
    if theirs is not mine:
        of_product = getattr(theirs, "original", None) is mine
        told = "; on_original(policy) acts on the original model" if of_product else ""
        raise ModelError(f"the policy was made for another model object{told}")


def check_numbers(**named: object) -> None:
    """Check that arguments are numbers: Python's, numpy's or fractions.

    Raises:
        ModelError: one is not; it is named.
    """
    for name, value in named.items():
        if not isinstance(value, Real):
            raise ModelError(f"{name} must be a number, not {value!r}")


def check_penalty(penalty: float) -> None:
    """Check the price of failing.

    Raises:
        ModelError: it is not a positive number, or is infinite.
    """
    if not isinstance(penalty, Real) or not 0.0 < penalty < float("inf"):
        raise ModelError(
            f"penalty must be a positive number, not {penalty!r}; MinCost forbids failing"
        )


def check_setting(
    failure_budget: float | None, discount: float | None, reach_fraction: float | None = None
) -> None:
    """Check budget, discount and share.

    Raises:
        ModelError: a budget or a share outside [0, 1], both of them, a discount outside (0, 1), or
            least failure together with a discount.
    """
    named = {
        "failure_budget": failure_budget,
        "discount": discount,
        "reach_fraction": reach_fraction,
    }
    for name, value in named.items():
        if value is not None and not isinstance(value, Real):
            raise ModelError(f"{name} must be a number or None, not {value!r}")
    if reach_fraction is not None and failure_budget is not None:
        raise ModelError("give failure_budget or reach_fraction, not both: each says the other")
    if reach_fraction is not None and not 0.0 <= reach_fraction <= 1.0:
        raise ModelError(
            f"reach_fraction must lie between 0 and 1, not {reach_fraction!r}"
            f"{_as_percentage(reach_fraction)}"
        )
    if failure_budget is not None and not -LEAST_BUDGET <= failure_budget <= 1.0 + LEAST_BUDGET:
        raise ModelError(
            f"failure_budget must be a probability or None, not {failure_budget!r}"
            f"{_as_percentage(failure_budget)}"
        )
    if discount is not None and not 0.0 < discount < 1.0:
        raise ModelError(
            f"discount must lie strictly between 0 and 1, not {discount!r}; None means exact"
        )
    if failure_budget is None and reach_fraction is None and discount is not None:
        raise ModelError(
            "failure_budget=None (least failure) is exact only: leave discount out, or give a "
            "budget for the discounted surrogate"
        )


def _as_percentage(share: float) -> str:
    """What a number may have meant that is no probability."""
    return f"; did you mean {float(share) / 100.0:.12g}?" if 1.0 < share <= 100.0 else ""
