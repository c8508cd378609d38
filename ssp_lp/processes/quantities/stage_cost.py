"""Secondary costs as users state them, spread over the outcomes of a model and checked."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import FloatArray, read_only
from ssp_lp.errors import ModelError, in_short, is_number
from ssp_lp.model import SSP
from ssp_lp.model.product import ProductSSP
from ssp_lp.processes.quantities.quantity import (
    Constraint,
    NestedCosts,
    beside_cvxpy,
    secondary_cost,
)


@dataclass(frozen=True, eq=False)
class CostLimit:
    """An upper bound on the expected total of a secondary cost: ``secondary_cost(cost) <= bound``.

    Args:
        cost: ``{state: {action: cost}}``, pairs that are not listed costing nothing; or an array,
            [pairs], or [outcomes].
        bound: the largest expected total, in the unit of the cost, >= 0.
    """

    cost: NestedCosts | npt.ArrayLike = field(repr=False)
    bound: float


def constraints_of(limits: Mapping[str, CostLimit]) -> dict[str, Constraint]:
    """Limits of secondary costs as constraints.

    Raises:
        ModelError: no mapping, no limit, or a bound that is not a finite number >= 0.
    """
    if not isinstance(limits, Mapping):
        raise ModelError(f"limits must be {{name: CostLimit(cost, bound)}}, not {limits!r}")
    for name, limit in limits.items():
        if not isinstance(limit, CostLimit):
            raise ModelError(f"limit {name!r} must be CostLimit(cost, bound), not {limit!r}")
        if not is_amount(limit.bound):
            raise ModelError(
                f"the bound of limit {name!r} must be finite and >= 0: {in_short(limit.bound)}"
            )
    return {name: secondary_cost(limit.cost) <= limit.bound for name, limit in limits.items()}


def outcome_costs(model: SSP, name: str, cost: NestedCosts | npt.ArrayLike) -> FloatArray:
    """A cost by outcome, [outcomes].

    Args:
        model: the model.
        name: of the limit, for errors.
        cost: ``{state: {action: cost}}``, or an array, [pairs] or [outcomes].

    Raises:
        ModelError: a cost that is not a finite number >= 0, an array of the wrong length, an
            unknown state or action.
    """
    if isinstance(cost, Mapping):
        given = np.repeat(_listed_costs(model, name, cost), np.diff(model.outcome_offsets))
    else:
        given = _spread_costs(model, name, _cost_array(name, cost))
    costs = read_only(given, np.float64)
    wrong = ~(np.isfinite(costs) & (costs >= 0.0))
    if wrong.any():
        outcome = int(np.argmax(wrong))
        pair = int(np.searchsorted(model.outcome_offsets, outcome, side="right")) - 1
        raise ModelError(
            f"limit {name!r}, {model.describe_pair(pair)}: the cost must be finite and >= 0, not "
            f"{float(costs[outcome])!r}"
        )
    return costs


def is_amount(value: object) -> bool:
    """Whether a value is a finite number >= 0, and no integer beyond all floats."""
    return is_number(value) and 0.0 <= float(value) < float("inf")


def _listed_costs(model: SSP, name: str, cost: NestedCosts) -> FloatArray:
    """Costs from nested dicts, 0 where nothing is listed, [pairs]."""
    result = np.zeros(model.n_pairs)
    for state, actions in cost.items():
        try:
            places = model.places_of(state)
        except ModelError as error:
            raise ModelError(f"limit {name!r}: {error}") from error
        if not isinstance(actions, Mapping):
            raise ModelError(f"limit {name!r}, state {state!r}: not {{action: cost}}: {actions!r}")
        acting = [int(k) for k in places if model.pair_offsets[k] < model.pair_offsets[k + 1]]
        if not acting and isinstance(model, ProductSSP) and model.find(state) is None:
            _listed_costs(model.original, name, {state: actions})  # nobody acts there: a check only
            continue
        for place in acting or places.tolist():
            _list_pair_costs(model, name, place, actions, result)
    return result


def _list_pair_costs(
    model: SSP, name: str, state: int, actions: Mapping[Hashable, float], result: FloatArray
) -> None:
    """Write the costs of a state's actions into the costs of all pairs."""
    begin, end = model.pair_offsets[state : state + 2].tolist()
    pair_of = {model.action_of(pair): pair for pair in range(begin, end)}
    for action, value in actions.items():
        if action not in pair_of:
            raise ModelError(f"limit {name!r}: {model.no_such_action(state, action)}")
        if not is_amount(value):
            raise ModelError(
                f"limit {name!r}, action {action!r} of state {model.states[state]!r}: the cost "
                f"must be finite and >= 0, not {in_short(value)}" + beside_cvxpy(value)
            )
        result[pair_of[action]] = float(value)


def _cost_array(name: str, cost: npt.ArrayLike) -> FloatArray:
    """Costs as an array of numbers."""
    try:
        return _cost_numbers(cost)
    except (TypeError, ValueError, OverflowError) as error:
        raise ModelError(f"limit {name!r}: the cost is no array of numbers: {error}") from error


def _spread_costs(model: SSP, name: str, given: FloatArray) -> FloatArray:
    """Costs from an array of pairs or of outcomes, also of a product's original, [outcomes]."""
    if isinstance(model, ProductSSP) and model.is_hidden:
        return np.asarray(_spread_costs(model.original, name, given)[model.original_outcome])
    own, theirs = _costs_by_outcome(model, given), None
    if isinstance(model, ProductSSP):
        theirs = _costs_by_outcome(model.original, given)
        theirs = None if theirs is None else theirs[model.original_outcome]
    if own is not None and theirs is not None and not np.array_equal(own, theirs):
        raise ModelError(
            f"limit {name!r}: an array of shape {given.shape} fits both the product and its "
            "original: give {state: {action: cost}}"
        )
    found = theirs if own is None else own
    if found is None:
        raise ModelError(
            f"limit {name!r}: the cost has shape {given.shape}; {model.n_pairs} pairs or "
            f"{model.n_outcomes} outcomes are needed"
        )
    return found


def _costs_by_outcome(model: SSP, given: FloatArray) -> FloatArray | None:
    """Costs by pair or by outcome, [outcomes]; None if they are neither."""
    if given.shape == (model.n_outcomes,):
        return given
    if given.shape == (model.n_pairs,):
        return np.repeat(given, np.diff(model.outcome_offsets))
    return None


def _cost_numbers(cost: npt.ArrayLike) -> FloatArray:
    """A copy as floats; complex numbers and texts, which numpy would convert, are refused."""
    given = np.array(cost)
    if given.dtype.kind not in "biufO":
        raise TypeError(f"{given.dtype} is no type of real numbers")
    return given.astype(np.float64)
