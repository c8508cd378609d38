"""The base class of problems for ``solve``, ``evaluate`` and ``simulate``, and checks of them."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from types import MappingProxyType
from typing import Any, Self, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import TOTAL_COST, ExponentialUtility
from ssp_lp.accumulated_cost.totals import MOST_SUMS, Resolution, resolution_for, sums_in
from ssp_lp.arrays import FloatArray, IntArray, ReadOnlyCopies, read_only, segment_ids
from ssp_lp.column_generation.compiled_layers import CompiledLayered
from ssp_lp.column_generation.compiled_problem import (
    CompiledExplicit,
    CompiledProblem,
    GoalFacts,
    LayerAndTails,
)
from ssp_lp.compiled.deadline import READING, is_within_call, limited
from ssp_lp.errors import (
    Argument,
    InfeasibleError,
    ModelError,
    attributes_of,
    in_short,
    is_amount,
    is_number,
    wrong_argument,
)
from ssp_lp.model import SSP
from ssp_lp.model.boxes import Boxes
from ssp_lp.model.implicit import ExploredSSP
from ssp_lp.model.product import ProductSSP, check_product
from ssp_lp.model.ssp import ImplicitSSP
from ssp_lp.policies.policy import GIVE_UP_CODE, Branches, MixedPolicy, Policy, Step, as_lottery
from ssp_lp.policies.remembering import (
    CompletePolicy,
    LabelledPolicy,
    RememberingPolicy,
    on_original,
)
from ssp_lp.processes.conditions import Condition
from ssp_lp.processes.failure_semantics import (
    Aim,
    FailureSemantics,
    GiveUp,
    GoalShare,
    start_distribution,
    survival_of,
)
from ssp_lp.processes.goal_reach import greatest_goal_from, greatest_goal_reach
from ssp_lp.processes.quantities import Constraint, Quantity, beyond_exploring

Start = Hashable | Mapping[Hashable, float]
"""A state, or a distribution over states."""

EXACT = FailureSemantics()
"""Default worth of an episode: its cost until the goal or failing; failing costs nothing."""


class Problem(ReadOnlyCopies):
    """Base class of a criterion on a model with a start and a failure budget.

    The class attributes are the defaults: no discount, the cost of all runs counts (not only of
    those that succeed), and no limit except the failure budget. If failing has a price instead of a
    limit, ``failure_budget`` is 1 and ``semantics`` has the penalty. ``semantics.aim`` says whether
    the cost or only the goal counts.
    """

    model: SSP
    start: Start
    failure_budget: float | FailureBudget | None = 1.0  # None: as low as possible
    give_up: str | GiveUp | None = GiveUp.ATTENTION
    charge_failing_step: bool | None = False
    discount: float | None = None  # None: exact; a number: the surrogate of section 3.5
    ratio = False  # whether the cost counts given success (case S)
    horizon: int | None = None
    cost_cap: float | None = None  # accumulated cost beyond which totals are not distinguished
    cost_levels: int | None = None  # number of levels of the grid, if costs have no unit
    reach_fraction: float | None = None  # share of the greatest goal probability, for a budget
    quantity: Quantity | None = None  # replaces the cost as the objective
    box: Boxes | None = None  # intervals of probabilities; their worst case counts
    penalty: float = 0.0  # price of failing; infinite: failing is forbidden
    aim = Aim.LEAST_COST
    constraints: Mapping[str, Constraint] = MappingProxyType({})

    @cached_property
    def start_mass(self) -> FloatArray:
        """Distribution of the start over states, read-only, [states]."""
        mass: FloatArray = read_only(start_distribution(self.model, self.start))
        return mass

    @property
    def semantics(self) -> FailureSemantics:
        """Value of an episode: which cost counts, and what failing costs."""
        return EXACT

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Constraints in addition to the failure budget, checked."""
        return ()

    @property
    def objective_condition(self) -> Condition | None:
        """Quantity that replaces the cost as the objective, checked; None: the cost."""
        return None

    @property
    def own_constraints(self) -> Mapping[str, Constraint]:
        """Constraints that belong to the criterion; none by default."""
        return {}

    @property
    def all_constraints(self) -> Mapping[str, Constraint]:
        """Constraints that belong to the criterion, and the argument ``constraints``.

        Raises:
            ModelError: no mapping of constraints, or two constraints with the same name.
        """
        own, stated = self.own_constraints, self.constraints
        if not isinstance(stated, Mapping):
            raise ModelError(f"constraints must be {{name: quantity <= bound}}, not {stated!r}")
        if both := own.keys() & stated.keys():
            raise ModelError(f"{min(both)!r} names a limit of {type(self).__name__} already")
        return {**own, **stated}

    def with_arguments(self, **changes: Any) -> Self:
        """Return a copy with other arguments; ``reach_fraction`` is kept as it was given."""
        return cast("Self", replace(cast("Any", self), **changes, **as_stated(self)))

    @property
    def tracked(self) -> Problem:
        """The problem restated on a product with automata for limits on whole runs and tasks.

        If there are no such limits and tasks, this is the problem itself.
        """
        return self

    @property
    def unrolled(self) -> Problem:
        """The problem as it is solved: itself, or restated on augmented states.

        The augmented states are (state, steps taken) or (state, failure label).
        """
        return self

    @property
    def has_rows(self) -> bool:
        """Whether the problem has constraints other than the budget, or minimises a quantity."""
        return bool(self.conditions) or self.objective_condition is not None

    @property
    def counts_totals(self) -> bool:
        """Whether a problem depends on the total cost of a run that succeeds."""
        return self.ratio or self.semantics.counts_law

    @cached_property
    def totals(self) -> TotalScale:
        """Scale of the total costs of successful runs: the values that a total can take."""
        if not self.counts_totals:
            return TotalScale.NONE
        resolution = resolution_of(self)
        if resolution is None:
            return TotalScale.UNITS
        is_cut = self.discount is not None or self.cost_cap is not None
        is_whole = self.semantics.counts_law or not is_cut
        by_sums = is_whole and not self.has_rows and resolution.most == MOST_SUMS
        return TotalScale.SUMS if by_sums else TotalScale.GRID

    @property
    def several_rows(self) -> bool:
        """Whether :attr:`has_rows` is True, or total costs are rounded to the levels of a grid."""
        return self.has_rows or self.totals is TotalScale.GRID

    @property
    def is_mean_within_budget(self) -> bool:
        """Whether the problem is case S, and its only limit is the failure budget."""
        plain = self.ratio and not (self.semantics.counts_law or self.has_rows)
        return plain and self.failure_budget is not None

    def compile(self) -> CompiledProblem:
        """Return the compiled problem: an augmented process, ready for a method."""
        raise NotImplementedError

    def program(self) -> Any:
        """Return the problem's linear program over expected visits.

        Raises:
            ModelError: the class has none.
        """
        name = type(self).__name__
        raise ModelError(f"{name} has no linear program: derive it from Formulation")


NEEDED = cast("Problem", None)
"""Default of a required argument, so that leaving it out raises ModelError, not TypeError."""


def resolution_of(problem: Problem) -> Resolution | None:
    """Return how total costs are rounded or summed up in a problem.

    None if total costs are not needed, or are multiples of a unit.
    """
    levels, cap = problem.cost_levels, problem.cost_cap
    of_law = problem.semantics.counts_law
    if not of_law and not problem.ratio:
        return None
    if not of_law and levels is None and problem.failure_budget is None and not problem.has_rows:
        return None  # with least failure no cost must be remembered
    resolution = resolution_for(problem.model, levels, cap, of_law=of_law)
    charge = problem.semantics.charge(problem.ratio)
    if resolution is None or not isinstance(charge, ExponentialUtility) or problem.has_rows:
        return resolution
    # do few totals lie below the cost from which a stationary policy is optimal?
    most, facts = min(levels or MOST_SUMS, MOST_SUMS), problem.model.cached_facts
    if (key := f"{most} sums: {charge}") not in facts:
        facts_of = GoalFacts(problem.model, problem.start_mass)
        horizon = LayerAndTails(facts_of, utility=charge).cost_horizon
        facts[key] = sums_in(problem.model, horizon, most) is not None
    return Resolution(most=MOST_SUMS) if facts[key] else resolution


class TotalScale(StrEnum):
    """Scales of total costs: the values that a total cost can take in a program."""

    NONE = "no total is counted"
    UNITS = "multiples of a unit"
    SUMS = "the sums that can occur, each a layer of backward sweeps"
    GRID = "levels of a grid"


def least_failure_bound(problem: Problem) -> float | None:
    """Return a certified lower bound of the failure of all policies; None with a failure budget."""
    if problem.failure_budget is not None:
        return None
    model, start, survival = problem.model, problem.start_mass, survival_of(problem.discount)
    return greatest_goal_reach(model, survival, start, precise=False).least_failure(start)


def compiled_constrained(problem: Problem) -> CompiledExplicit:
    """Compile a problem with constraints to its process, with a row for each constraint."""
    logging.getLogger("ssp_lp.compiling").info("%r, with its rows", problem)
    objective, model, start = problem.objective_condition, problem.model, problem.start_mass
    if (label := model.failure_label) is not None and start[~label.finite[0]].any():
        begun = start[: label.n_original]
        raise InfeasibleError(
            "a quantity counted after failing grows without end under every policy",
            failure_budget=problem.failure_budget,
            least_failure=lambda: max(1.0 - greatest_goal_from(label.original, begun), 0.0),
        )
    facts, semantics = GoalFacts(model, start, problem.discount), problem.semantics
    side = tuple(row for condition in problem.conditions for row in condition.rows)
    charge, resolution = semantics.charge(problem.ratio), resolution_of(problem)
    layer = None
    if charge is not None:
        layer = LayerAndTails(facts, semantics.counts_law, resolution is not None, side=side)
    return CompiledExplicit(
        facts,
        semantics,
        side,
        problem.failure_budget,
        charge=charge,
        layer=layer,
        ratio=problem.ratio,
        fixed_cap=problem.cost_cap,
        objective=None if objective is None else objective.minimised(),
        resolution=resolution,
    )


def compiled_totals(problem: Problem, *, may_sum: bool = True) -> CompiledLayered:
    """Compile a problem that counts total costs and has no limit but the failure budget.

    Args:
        problem: the problem.
        may_sum: whether the totals may be the sums of costs that can occur (``problem.totals``);
            False: multiples of the costs' unit.
    """
    charge = problem.semantics.charge(problem.ratio) or TOTAL_COST
    by_sums = may_sum and problem.totals is TotalScale.SUMS
    facts = GoalFacts(problem.model, problem.start_mass)
    utility = charge if isinstance(charge, ExponentialUtility) else None
    layer = LayerAndTails(facts, True, by_sums, may_fail=problem.ratio, utility=utility)
    return CompiledLayered(facts, layer, charge, problem.ratio)


@dataclass(frozen=True, eq=False)
class RestatedProblem(Problem):
    """A problem that a method solves in place of another one, with other costs or semantics."""

    model: SSP
    start: Start
    ratio: bool = field()
    failure_budget: float | None = field()
    semantics: FailureSemantics = EXACT
    conditions: tuple[Condition, ...] = ()
    discount: float | None = None
    objective_condition: Condition | None = None

    def compile(self) -> CompiledLayered:
        """Compile the problem, with total costs as multiples of a unit."""
        return compiled_totals(self, may_sum=False)


_FOLLOWS = "failure_budget was computed from reach_fraction (solve has its own time limit)"


class FailureBudget:
    """Descriptor of the field ``failure_budget``, which may be replaced by ``reach_fraction``.

    If ``reach_fraction`` is given, the budget is computed from a share of the greatest goal
    probability. This is done on first use, since stating a problem solves nothing. ``solve`` does
    it within its own time limit. Reading the attribute does it within some seconds, or raises
    OutOfTimeError.
    """

    def __set__(self, problem: object, value: float | None) -> None:
        """Store the budget that was given."""
        is_followed = isinstance(value, GoalShare)  # not given: ``replace`` passes it on
        vars(problem)["_stated_budget"] = None if is_followed else as_float(value)

    def __get__(self, problem: Any, owner: type[object]) -> float | None:
        """Return the budget; if read from the class, None, the default (least failure)."""
        if problem is None:
            return None
        fields, key, share = vars(problem), "_stated_budget", problem.reach_fraction
        if share is not None:
            if (asked := problem.unrolled) is not problem:
                return cast("float | None", asked.failure_budget)  # kept in one place
            if (key := "_budget") not in fields:
                with limited(None if is_within_call() else READING, _FOLLOWS):
                    fields[key] = budget_of_share(asked.model, asked.start, share)
        return cast("float | None", fields[key])


BUDGET_OR_SHARE = FailureBudget()
"""Default of the field; one descriptor serves all problems, which store their budgets."""


def as_stated(problem: object) -> dict[str, Any]:
    """Return the argument ``failure_budget`` of a problem as it was given, to copy the problem.

    Returns:
        A dict with this argument; empty if the problem's class has no such argument.
    """
    fields = vars(problem)
    return {"failure_budget": fields["_stated_budget"]} if "_stated_budget" in fields else {}


def budget_of_share(
    model: SSP, start: Hashable | Mapping[Hashable, float], reach_fraction: float
) -> GoalShare:
    """Return the failure budget that allows a share of the greatest goal probability.

    Args:
        model: the model.
        start: a state, or ``{state: probability}``.
        reach_fraction: the share, in [0, 1].
    """
    begun = start_distribution(model, start)
    return GoalShare(min(max(reach_fraction * greatest_goal_from(model, begun), 0.0), 1.0))


def check_problem(problem: object, verb: str) -> None:
    """Check that an argument is a problem, with a start and a semantics.

    Raises:
        ModelError: a model alone, or something else; ``verb`` names the function that was called.
    """
    if not isinstance(problem, Problem):
        raise ModelError(
            f"{verb}() takes a problem, such as MCMP(model, start=..., failure_budget=...), not "
            f"{in_short(problem)}"
        )


def check_explorable(problem: Problem) -> None:
    """Check that exploration can solve a problem on an implicit model.

    Raises:
        ModelError: a start that the model does not name, a function of the total cost of a run, a
            horizon, a share of the greatest goal probability, or a limit that the explored part
            does not bound.
    """
    whole, start = cast("ImplicitSSP", problem.model), problem.start
    for state in start if isinstance(start, Mapping) else [start]:
        if state not in whole.begin:
            raise ModelError(f"start: {state!r} is not a state in which {whole!r} may begin")
    name, more = type(problem).__name__, ": build the whole model, SSP.from_successors(...)"
    if problem.ratio or problem.semantics.counts_law:
        raise ModelError(f"{name} needs the total cost of a run, which implicit models lack{more}")
    if problem.horizon is not None:
        hint = ", or count the steps in its states"
        raise ModelError(Argument("horizon"), f" does not support an implicit model{more}{hint}")
    if problem.reach_fraction is not None:
        raise ModelError(
            Argument("reach_fraction"),
            " does not support an implicit model: solve MaxProb first, and state failure_budget",
        )
    if problem.failure_budget is None and problem.own_constraints:
        raise ModelError(
            f"{name} with least failure needs the whole model: give ", Argument("failure_budget")
        )
    for limit, constraint in limits_of(problem):
        if (fault := beyond_exploring(constraint)) is not None:
            raise ModelError(f"limit {limit!r}: {fault}{more}")


def check_boxed(problem: Problem, box: object) -> None:
    """Check that a problem has a robust optimum that this library computes.

    Args:
        problem: the problem.
        box: its boxes, intervals of the probabilities.

    Raises:
        ModelError: no boxes, or boxes of another model; constraints, a horizon or a discount;
            failing at dead-ends only, or charged by costs that depend on the successor.
    """
    name, semantics = type(problem).__name__, problem.semantics
    if not isinstance(box, Boxes):
        raise wrong_argument("box", "be Boxes, such as Boxes.from_counts(model)", box)
    box.check_model(problem.model)
    check_measures(problem)
    if semantics.forbids_failing or semantics.aim is not Aim.LEAST_COST:
        return
    if semantics.give_up is GiveUp.DEAD_ENDS:
        raise ModelError(f"{name} over boxes does not support give_up='dead_ends'")
    costs, offsets = problem.model.costs, problem.model.outcome_offsets
    if semantics.charge_failing_step and (costs != costs[offsets[segment_ids(offsets)]]).any():
        raise ModelError(
            f"{name} over boxes supports charge_failing_step only where the cost of each action is "
            "the same for all its successors: use charge_failing_step=False"
        )


def has_boxes(verb: str) -> ModelError:
    """Return the error for a problem over boxes, given to a function without support for boxes."""
    return ModelError(
        f"{verb} needs one choice of probabilities, and the problem has boxes: pass box= to "
        "evaluate, or solve it and take solution.problem, which has the worst probabilities"
    )


def check_measures(problem: Problem) -> None:
    """Raise :class:`ModelError` if a measure of the problem has no known worst case over boxes."""
    name = type(problem).__name__
    if problem.ratio or problem.semantics.counts_law:
        raise ModelError(
            f"{name} counts a cost given success, whose worst case over boxes is not computed "
            "(the worst cost divided by the least goal probability may be far above it): use MCMP, "
            "MaxProb, MinCost or FinitePenalty"
        )
    for word, given in (("a horizon", problem.horizon is not None),
                        ("a discount", problem.discount is not None),
                        ("constraints", problem.has_rows)):  # fmt: skip
        if given:
            raise ModelError(f"boxes do not support {word}: leave it out of the problem")


def limits_of(problem: Problem) -> list[tuple[str, Constraint]]:
    """Return the constraints of a problem, (name, constraint) each.

    A quantity that the problem minimises is added as the constraint "objective".
    """
    limits = problem.all_constraints.items()
    asked = [(str(name), limit) for name, limit in limits if isinstance(limit, Constraint)]
    if isinstance(problem.quantity, Quantity):
        asked.append(("objective", Constraint(problem.quantity, upper=0.0)))
    return asked


def on_one_model(
    policy: Policy | MixedPolicy, problem: Problem, verb: str
) -> tuple[MixedPolicy, Problem]:
    """Check that a policy and a problem share a model; return both on the model that is solved.

    Returns:
        The policy as a lottery, and the problem unrolled. With a horizon their model has the states
        (state, steps taken).

    Raises:
        ModelError: no policy (a solution, for instance); no problem; or two models.
    """
    is_policy = isinstance(policy, Policy | MixedPolicy)
    if not is_policy and len(attributes_of(policy, "policy", "problem")) == 2:
        raise ModelError(f"{verb}() takes a policy: pass solution.policy and its problem")
    check_problem(problem, verb)
    if not is_policy:
        raise ModelError(
            f"{verb}() takes a policy, such as solution.policy or DeterministicPolicy.from_actions("
            f"model, {{state: action}}), not {in_short(policy)}"
        )
    if problem.box is not None:
        raise has_boxes(verb)
    theirs = policy.model
    if isinstance(theirs, ExploredSSP) and theirs.whole is problem.model:
        problem = problem.with_arguments(model=theirs)
    solved = problem.unrolled
    if theirs is solved.model:
        return until_failing(as_lottery(policy)), solved
    if theirs is not problem.model:
        of_product = isinstance(theirs, ProductSSP) and theirs.original is problem.model
        hint = "; on_original(policy) acts on the original model" if of_product else ""
        remedy = hint or ": pass a problem on policy.model, or solve this problem"
        raise ModelError(f"the policy was made for another model object{remedy}")
    lottery = on_product(policy, check_product(solved.model))
    return lottery if solved.model.failure_label is not None else until_failing(lottery), solved


def pulled_back(policy: MixedPolicy, problem: Problem) -> MixedPolicy:
    """Translate a policy on the model of the unrolled problem to the model of the problem."""
    while policy.model is not problem.model:
        policy = on_original(policy)
    return policy


def as_float(value: Any) -> Any:
    """Return a number, such as a fraction, as a float, and any other argument unchanged."""
    return value if type(value) in (bool, int, float) or not is_number(value) else float(value)


def check_cost(name: str, value: object) -> None:
    """Raise :class:`ModelError` unless an argument is a finite number >= 0."""
    if not is_amount(value):
        raise wrong_argument(name, "be a cost" if is_number(value) else "be a number", value)


@dataclass(frozen=True, eq=False, repr=False)
class _InProduct(Policy):
    """A policy of the original model, restated on a product whose memory it ignores."""

    inner: Policy  # on the original
    model: ProductSSP

    def start_memory(self, states: IntArray) -> IntArray:
        """Return the memory with which episodes begin, [episodes]."""
        return self.inner.start_memory(self.model.original_state[states])

    @property
    def goes_on(self) -> bool:  # type: ignore[override]
        """Whether the inner policy goes on after failing, and the product has no failure label."""
        return self.inner.goes_on and self.model.failure_label is None

    @property
    def declares_failing(self) -> bool:
        """Whether the inner policy declares failing and then goes on."""
        return self.inner.goes_on

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the decisions of the inner policy as pairs of the product."""
        product, label = self.model, self.model.failure_label
        branches = self.inner.branches(product.original_state[states], memory)
        kept = branches.kept(memory)
        pair, there = np.maximum(branches.pair, 0), states[branches.situation]
        taken = product.placed(there, pair)
        if label is not None:
            quits = (kept != memory[branches.situation]) & ~label.after[there]
            taken = np.where(quits, label.giving_up_by(pair), taken)
        pair = np.where(branches.pair >= 0, taken, branches.pair)
        if label is not None:  # the inner policy may have no decision there
            beyond = label.is_open[label.original_state] & (label.after | label.lost)
            pair = np.where(beyond[there] & (pair < 0), GIVE_UP_CODE, pair)
        return Branches(branches.situation, pair, branches.probability, kept)

    def remember(self, memory: IntArray, *step: *Step) -> IntArray:
        """Return the inner policy's memory after a step of the product, [episodes]."""
        pairs, successors, costs = step
        there, pair = self.model.original_state[successors], self.model.original_pair[pairs]
        return self.inner.remember(memory, pair, there, costs)


@dataclass(frozen=True, eq=False, repr=False)
class _UntilFailing(Policy):
    """A policy that gives up where another one goes on after failing.

    For problems that count nothing after failing.
    """

    carrier: Policy

    @property
    def model(self) -> SSP:  # type: ignore[override]
        return self.carrier.model

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the decisions, with giving up instead of decisions that go on after failing."""
        branches = self.carrier.branches(states, memory)
        pair = np.where(branches.gives_up(memory), GIVE_UP_CODE, branches.pair)
        return Branches(branches.situation, pair, branches.probability)


def until_failing(lottery: MixedPolicy) -> MixedPolicy:
    """Return a lottery whose policies give up instead of going on after failing."""
    for member in lottery.policies:
        if member.goes_on:
            return replace(lottery, policies=tuple(map(_UntilFailing, lottery.policies)))
    return lottery


def on_product(policy: Policy | MixedPolicy, product: ProductSSP) -> MixedPolicy:
    """Translate a policy of the original model to a policy on a product.

    A policy that :func:`on_original` made from one on this product is translated back. Any other
    policy ignores the product's memory.

    Args:
        policy: policy or lottery on the original model.
        product: product of the model that the policy acts on.
    """
    lottery = as_lottery(policy)
    if product.original is not lottery.model and isinstance(product.original, ProductSSP):
        lottery = on_product(lottery, product.original)
    carried = (m.inner if isinstance(m, CompletePolicy) else m for m in lottery.policies)
    members = tuple(
        inner.inner
        if isinstance(inner, RememberingPolicy | LabelledPolicy) and inner.product is product
        else _InProduct(member, product)
        for inner, member in zip(carried, lottery.policies, strict=True)
    )
    return MixedPolicy(members, lottery.weights)
