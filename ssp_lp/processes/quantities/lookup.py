"""From a user's words to conditions on a model: states, actions, labels and ends are looked up."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import replace
from itertools import chain

import numpy as np

from ssp_lp.accumulated_cost.charges import ExpectedArrivalCost
from ssp_lp.arrays import BoolArray, FloatArray
from ssp_lp.errors import ModelError, did_you_mean
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import end_marks
from ssp_lp.processes.quantities.conditions import (
    OBJECTIVE,
    RESERVED,
    ArrivalTerm,
    Condition,
    StepTerm,
    Term,
)
from ssp_lp.processes.quantities.quantity import (
    ArrivalCosts,
    Constraint,
    Counted,
    Ends,
    Quantity,
    StageCosts,
    Visits,
)
from ssp_lp.processes.quantities.stage_cost import outcome_costs


def conditions(
    model: SSP, start: FloatArray, constraints: Mapping[str, Constraint]
) -> tuple[Condition, ...]:
    """Check constraints, and look up what they count.

    Args:
        model: the model.
        start: distribution over states, [states].
        constraints: name -> constraint.

    Raises:
        ModelError: a name that is no text or is reserved, no constraint, an unknown state, action,
            label or end, costs of the wrong shape or below 0, or a lower bound of costs or visits.
    """
    if not isinstance(constraints, Mapping):
        raise ModelError(f"constraints must be {{name: quantity <= bound}}, not {constraints!r}")
    found = tuple(_looked_up_condition(model, start, name, c) for name, c in constraints.items())
    named = [row.name for condition in found for row in condition.rows]
    if len(set(named)) < len(named):
        twice = next(name for name in named if named.count(name) > 1)
        raise ModelError(f"two rows would be named {twice!r}: give one constraint another name")
    return found


def objective_of(
    model: SSP, start: FloatArray, quantity: Quantity, *, signed: bool = False
) -> Condition:
    """Look up what a quantity that is to be minimised counts.

    Args:
        model: the model.
        start: distribution over states, [states].
        quantity: the quantity.
        signed: whether costs and visits may be subtracted, as in an expression.

    Raises:
        ModelError: no quantity, an unknown state, action, label or end, costs of the wrong shape
            or below 0, or costs or visits that would be maximised.
    """
    if not isinstance(quantity, Quantity):
        raise ModelError(f"the objective must be a quantity, such as visits(...), not {quantity!r}")
    found = _looked_up_terms(model, start, OBJECTIVE, Constraint(quantity))
    if not signed:
        found.minimised()
    return found


def arrival_measure(quantity: Quantity | None) -> ExpectedArrivalCost | None:
    """The measure of a quantity that is made of arrival costs; None: it is not.

    Raises:
        ModelError: other quantities are added to it, or it is to be large.
    """
    terms = quantity.terms if isinstance(quantity, Quantity) else ()
    costs = [(weight, counted) for weight, counted in terms if isinstance(counted, ArrivalCosts)]
    if quantity is None or not costs:
        return None
    if len(costs) < len(terms) or min(weight for weight, _ in costs) < 0.0:
        raise ModelError(
            "an arrival cost goes with other arrival costs, at weights >= 0: limit what is counted "
            "on the way"
        )
    constant = quantity.constant

    def function(totals: FloatArray) -> FloatArray:
        """The weighted sum of all of them."""
        charges = [weight * np.asarray(counted.function(totals)) for weight, counted in costs]
        return np.asarray(np.sum(charges, axis=0) + constant)

    line = max(counted.affine_from for _, counted in costs)
    return ExpectedArrivalCost(function, line)


def _looked_up_condition(
    model: SSP, start: FloatArray, name: str, constraint: Constraint
) -> Condition:
    """A constraint, checked and looked up in the model."""
    if not isinstance(name, str) or not name:
        raise ModelError(f"the name of a limit must be a word, not {name!r}")
    if name in RESERVED:
        raise ModelError(f"{name!r} names {RESERVED[name]}: give the limit another name")
    if not isinstance(constraint, Constraint):
        raise ModelError(f"limit {name!r} must be a quantity <= or >= a number: {constraint!r}")
    return _looked_up_terms(model, start, name, constraint)


def _looked_up_terms(model: SSP, start: FloatArray, name: str, constraint: Constraint) -> Condition:
    """A constraint whose terms were looked up."""
    quantity = constraint.quantity
    terms = tuple(
        (weight, _looked_up_term(model, name, c)) for weight, c in _merged_terms(quantity)
    )
    live = end_marks(model) < 0
    begun = sum(
        weight * float(start[term.states & live].sum())
        for weight, term in terms
        if isinstance(term, ArrivalTerm) and not term.final
    )
    stated = constraint.lower, constraint.upper
    return Condition(name, model, terms, quantity.constant + begun, *stated)


def _merged_terms(quantity: Quantity) -> list[tuple[float, Counted]]:
    """The terms, those that count the same added up, without those that cancel."""
    weights: dict[object, float] = {}
    first: dict[object, Counted] = {}
    for weight, counted in quantity.terms:
        key: object = id(counted) if isinstance(counted, StageCosts) else counted
        first.setdefault(key, counted)
        weights[key] = weights.get(key, 0.0) + weight
    return [(weight, first[key]) for key, weight in weights.items() if weight != 0.0]


def _looked_up_term(model: SSP, name: str, counted: Counted) -> Term:
    """What one counted thing is in the model, looked up."""
    match counted:
        case StageCosts(cost):
            if cost is None:
                return StepTerm(model)
            costs = outcome_costs(model, name, cost)
            return StepTerm(replace(model, costs=costs, exact_costs={}))
        case ArrivalCosts():
            raise ModelError(
                f"limit {name!r}: an arrival cost depends on the total of a whole run; it is "
                "minimised given success (ratio = True), not limited"
            )
        case Visits(of):
            return ArrivalTerm(model, _looked_up_states(model, name, of))
        case Ends(ways, others):
            return ArrivalTerm(model, _looked_up_ends(model, name, ways), final=True, others=others)


def _looked_up_states(model: SSP, name: str, of: tuple[Hashable, ...]) -> BoolArray:
    """States looked up by their own names or by that of a label, [states]."""
    mask = np.zeros(model.n_states, dtype=np.bool_)
    for one in of:
        if isinstance(one, str) and one in model.state_labels:
            mask[model.state_labels[one]] = True
            continue
        try:
            mask[model.places_of(one)] = True
        except ModelError as error:
            names = chain(model.state_labels, model.states)
            raise ModelError(
                f"limit {name!r}: {one!r} is neither a state nor a label of states"
                f"{did_you_mean(one, names)}"
            ) from error
    return mask


def _looked_up_ends(model: SSP, name: str, ways: tuple[Hashable, ...]) -> BoolArray:
    """States in which an episode ends in one of some ways, [states]."""
    marks = end_marks(model)
    named: list[Hashable] = ["goal", *model.state_labels, "dead_end"]
    mask = np.zeros(model.n_states, dtype=np.bool_)
    for way in ways:
        if way in named:
            mask |= marks == named.index(way)
            continue
        try:
            states = model.places_of(way)
        except ModelError as error:
            known = ", ".join(repr(k) for k in named)
            raise ModelError(
                f"limit {name!r}: {way!r} is no way to end ({known}) and no state"
                f"{did_you_mean(way, chain(named, model.states))}"
            ) from error
        if states.size and (marks[states] < 0).all():  # a horizon may leave none
            raise ModelError(f"limit {name!r}: no episode ends in state {way!r}: take visits(...)")
        mask[states[marks[states] >= 0]] = True
    return mask
