"""The base class of all formulations: a criterion declares its semantics and inherits the rest.

A formulation is a frozen dataclass with a model, a start, and its own arguments. It declares the
worth of an episode (``semantics``), whether costs count given success (``ratio``), and the allowed
failure (``failure_budget``). These determine how states are augmented, the linear program, and the
methods that solve the problem. The pages of ``formulations`` import from this module only.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import (
    CostQuantileOf as CostQuantileOf,
    ExpectedUtility as ExpectedUtility,
    ExponentialUtility as ExponentialUtility,
    Measure,
    TailMeanOf as TailMeanOf,
    Utility as Utility,
    WithinBound as WithinBound,
)
from ssp_lp.arrays import IntArray
from ssp_lp.column_generation.compiled_layers import CompiledLayered
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, CompiledProblem, GoalFacts
from ssp_lp.errors import (
    InfeasibleError as InfeasibleError,
    ModelError as ModelError,
    as_percentage as as_percentage,
    attributes_of,
    check_call,
    check_whole,
    form_of,
    in_short,
    is_number,
    wrong_argument as wrong_argument,
)
from ssp_lp.model import SSP as SSP
from ssp_lp.model.boxes import Boxes as Boxes
from ssp_lp.model.graph import (
    attention_labels as attention_labels,
    dead_end_labels as dead_end_labels,
)
from ssp_lp.model.product import unroll_steps
from ssp_lp.model.ssp import ImplicitSSP
from ssp_lp.model.tracked_product import check_not_rounded, followed_in, track
from ssp_lp.problem import (
    BUDGET_OR_SHARE as BUDGET_OR_SHARE,
    FailureBudget as FailureBudget,
    Problem as Problem,
    Start as Start,
    TotalScale,
    as_float,
    as_stated,
    check_boxed,
    check_cost as check_cost,
    check_explorable,
    compiled_totals,
    has_boxes,
    limits_of,
)
from ssp_lp.processes.conditions import Condition
from ssp_lp.processes.failure_semantics import (
    Aim as Aim,
    FailureSemantics as FailureSemantics,
    GiveUp as GiveUp,
    check_failure_setting,
    check_penalty as check_penalty,
    parse_give_up,
)
from ssp_lp.processes.past_failing import labelled_past_failing
from ssp_lp.processes.quantities import (
    Constraint as Constraint,
    CostLimit as CostLimit,
    Quantity as Quantity,
    arrival_cost as arrival_cost,
    arrival_measure,
    conditions,
    constraints_of as constraints_of,
    end_probability as end_probability,
    expected_cost as expected_cost,
    failure_probability as failure_probability,
    goal_probability as goal_probability,
    objective_of,
    run_events,
    secondary_cost as secondary_cost,
    visits as visits,
)

if TYPE_CHECKING:
    from ssp_lp.programs.occupation_program import OccupationProgram

_COMPILING = logging.getLogger("ssp_lp.compiling")

_PAPER = {"give_up": GiveUp.ATTENTION, "charge_failing_step": True}
"""Default values of arguments that are None: the paper's rule for giving up (section 2.4)."""

_NUMBER = ("float", float)
_NUMBER_OR_NONE = ("float | None", float | None)
"""Annotations of number fields, which are converted to floats."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Formulation(Problem):
    """A criterion on a model with a start (see :class:`ssp_lp.problem.Problem`).

    By default there is no discount, all runs count, and failing is free and unlimited.

    Args:
        constraints: name -> constraint on a quantity (``ssp_lp.secondary_cost``, ``visits``,
            ``end_probability``, ...), such as ``{"fuel": secondary_cost(fuel) <= 3.0}``; every
            criterion takes any number of them, in addition to its failure budget.
        horizon: number of steps after which an episode without the goal fails, "out of time"; None:
            unlimited. Policies act on the model's states and count their steps.
    """

    constraints: Mapping[str, Constraint] = field(default_factory=dict)
    horizon: int | None = None

    def __new__(cls, *arguments: Any, **named: Any) -> Self:
        """Check the model and the arguments' names, before missing arguments raise an error.

        Raises:
            ModelError: no model, or an unknown argument name.
        """
        if arguments and not isinstance(arguments[0], SSP):
            first = next(part.name for part in fields(cls) if not part.kw_only)
            given = in_short(arguments[0])
            if first == "model":
                parts = [f".{name}" for name in attributes_of(arguments[0], "model", "start")]
                has = f"; it has {' and '.join(parts)}: pass them" if parts else ""
                takes = f"{cls.__name__} takes an SSP first, then the start"
                raise ModelError(f"{takes}, not {given}{has}")
        check_call(cls.__name__, form_of(cls.__init__), (None, *arguments), named)
        return super().__new__(cls)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments, so that the copy is checked on construction."""
        return object.__new__, (type(self),), self.__getstate__()

    def __init_subclass__(cls) -> None:
        """Give every criterion the repr of this class, which ``dataclass`` would replace."""
        cls.__repr__ = cls.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        """Return a line with the class, the model, the start, and all non-default arguments."""
        arguments, stated = [], as_stated(self)
        for part in sorted(fields(self), key=lambda part: part.kw_only is True):
            is_budget = part.name in stated
            value = stated[part.name] if is_budget else getattr(self, part.name)
            needed = part.default is MISSING and part.default_factory is MISSING
            default = None if is_budget else part.default
            if part.default_factory is not MISSING:
                default = part.default_factory()
            if part.name in _PAPER and default is None:
                default = _PAPER[part.name]
            if part.name == "model":
                arguments.append(repr(value))
            elif needed or (value is not default and in_short(value) != in_short(default)):
                arguments.append(f"{part.name}={in_short(value)}")
        return f"{type(self).__name__}({', '.join(arguments)})"

    def __post_init__(self) -> None:
        """Check the common arguments: start, budget, discount, giving up, limits.

        Raises:
            ModelError: no model, an unknown state, no distribution, a budget, a share or a discount
                out of range, an unknown ``give_up``, a horizon that is not a number of steps, or a
                wrong constraint.
        """
        given = vars(self)
        for part in fields(self):
            if part.type not in _NUMBER + _NUMBER_OR_NONE:
                continue
            name, is_needed = part.name, part.type in _NUMBER
            value = given.get(name)
            if (is_needed or value is not None) and not is_number(value):
                wanted = "be a number" if is_needed else "be a number or None"
                raise wrong_argument(name, wanted, value)
            if name in given:
                object.__setattr__(self, name, as_float(value))
        share = given.get("reach_fraction")
        budget = given.get("failure_budget", 1.0 if share is None else None)
        budget = given.get("_stated_budget", budget)
        charged = self.charge_failing_step
        check_failure_setting(budget, given.get("discount"), share, charged)
        if "give_up" in given:
            object.__setattr__(self, "give_up", parse_give_up(given["give_up"]))
        if not isinstance(self.model, SSP):
            raise ModelError(f"model must be an SSP, not {in_short(self.model)}")
        if isinstance(self.model, ImplicitSSP):
            if self.box is not None:
                raise ModelError("boxes need the whole model: build it by SSP.from_successors(...)")
            check_explorable(self)
            return  # states and their names are looked up as they are found
        _ = self.start_mass
        for name, number in (("horizon", self.horizon), ("cost_levels", self.cost_levels)):
            if number is not None:
                check_whole(name, number)
        if self.box is not None:
            check_boxed(self, self.box)
        for condition in self.conditions:
            _ = condition.rows
        _ = self.objective_condition

    def __getstate__(self) -> dict[str, Any]:
        """Return the arguments, for a pickle, and the restated problems if they were built.

        These are ``tracked`` and ``unrolled``. Derived values, such as arrays over all states, are
        recomputed after a pickle.
        """
        made, kind = vars(self), type(self)
        follows = (k for k in made if isinstance(getattr(kind, k, None), cached_property))
        return {
            k: made[k] for k in made.keys() - {*follows} | made.keys() & {"tracked", "unrolled"}
        }

    @cached_property
    def unrolled(self) -> Self:
        """The formulation as it is solved: itself, or restated on augmented states.

        With a horizon the states are (state, steps taken), as in
        :func:`~ssp_lp.model.product.within_steps`; a goal that is too far away is then unreachable.
        If a quantity is counted after failing, the states are (state, failure label), as in
        ``label_failing``. Built on first use.
        """
        if self.tracked is not self:
            return self.tracked.unrolled
        begin = self.start_mass.nonzero()[0]
        if self.horizon is not None:
            model = unroll_steps(self.model, self.horizon, begin.tolist(), is_hidden=True)
            return self._on_product(model, np.arange(begin.size), horizon=None).unrolled
        if self.model.failure_label is not None:
            return self
        asked = self.conditions, self.objective_condition, self.semantics
        label = labelled_past_failing(self.model, *asked, ratio=self.ratio, discount=self.discount)
        return self if label is None else self._on_product(label, begin)

    def _on_product(self, model: SSP, begin: IntArray, **changes: Any) -> Self:
        """Return the formulation on a product.

        Args:
            model: the product.
            begin: its states that stand for the start states, in their order.
            changes: other arguments that change.
        """
        shares = self.start_mass[self.start_mass > 0.0].tolist()
        start = zip(map(model.states.__getitem__, begin.tolist()), shares, strict=True)
        return self.with_arguments(model=model, start=dict(start), **changes)

    @cached_property
    def tracked(self) -> Self:
        """The formulation restated on a product with automata for limits on whole runs and tasks.

        The product's states are (state, value of an automaton). The horizon is unchanged. Without
        such limits and tasks this is the formulation itself.
        """
        if not self.all_constraints and self.quantity is None:
            return self
        model, begin = self.model, cast("IntArray", np.flatnonzero(self.start_mass))
        for followed in run_events(limit for _, limit in limits_of(self)):
            if followed_in(model, followed) is None:
                automaton = followed.automaton(model)
                limits = (pair for pair in limits_of(self) if automaton.unit > 0.0)
                if not all(followed.is_safe(limit, self.constraints.get(name) is limit)
                           for name, limit in limits):  # fmt: skip
                    raise ModelError(f"too many distinct totals in {followed!r}: round the "
                                     "amounts; they are rounded up automatically only for "
                                     "limits within(...) >= p and exceeds(...) <= p")  # fmt: skip
                product = track(model, automaton, followed, begin)
                model, begin = product, product.at(begin, product.first_memory(begin))
        return self if model is self.model else self._on_product(model, begin)

    @cached_property
    def objective_condition(self) -> Condition | None:
        """Quantity that is minimised instead of the cost, or None."""
        if self.quantity is None or self.semantics.counts_law:
            return None
        if self.horizon is not None or self.tracked is not self:
            return self.unrolled.objective_condition
        return objective_of(self.model, self.start_mass, self.quantity)

    @cached_property
    def conditions(self) -> tuple[Condition, ...]:
        """Constraints of the formulation, checked, with their costs by outcome."""
        if not self.all_constraints:
            return ()
        if self.horizon is not None or self.tracked is not self:
            return self.unrolled.conditions
        return conditions(self.model, self.start_mass, self.all_constraints)

    @property
    def measure(self) -> Measure | None:
        """Function of the total cost's distribution that is optimised instead of the mean, or None.

        Raises:
            ModelError: an arrival cost is not counted given success, or is discounted.
        """
        measure = None if self.quantity is None else arrival_measure(self.quantity)
        if measure is not None and (self.discount is not None or not self.ratio):
            flaw = "supports no discount" if self.ratio else "must be given success: ratio = True"
            raise ModelError(f"{type(self).__name__}: an arrival cost {flaw}")
        return measure

    @cached_property
    def semantics(self) -> FailureSemantics:
        """Value of an episode, from the attributes ``give_up``, ``penalty``, ``aim`` and others."""
        give_up, charged = GiveUp(str(self.give_up)), bool(self.charge_failing_step)
        return FailureSemantics(give_up, charged, float(self.penalty), self.aim, self.measure)

    def compile(self) -> CompiledProblem:
        """Return the compiled problem of a formulation: an augmented process, ready for a method.

        The states are augmented by the accumulated cost (paper, section 3.1.1) if costs count given
        success or a function of the total cost is optimised, and by the failure label (section
        3.1.2) otherwise. A horizon is unrolled first.
        """
        if self.box is not None:
            raise has_boxes("compile")
        if self.horizon is not None:
            return self.unrolled.compile()
        model, start, semantics = self.model, self.start_mass, self.semantics
        _COMPILING.info("%r", self)
        if semantics.counts_law or self.totals is TotalScale.SUMS:
            return compiled_totals(self)
        if self.ratio:
            cap = self.cost_cap
            return CompiledLayered.given_success(model, start, self.discount, fixed_cap=cap)
        return CompiledExplicit(GoalFacts(model, start, self.discount), semantics)

    def program(self) -> OccupationProgram:
        """Return the formulation's linear program over expected visits.

        Raises:
            ModelError: the criterion is not a linear program.
            InfeasibleError: the failure budget is below the least failure.
        """
        from ssp_lp.methods.labelled_program import program_of

        if self.box is not None:
            raise has_boxes("program")
        check_not_rounded(self.tracked.model, "program")
        return program_of(self)
