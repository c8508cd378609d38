"""Quantities: linear functionals of an occupation measure, to minimise or limit.

A quantity is stated with names of a model: states, labels, ends and costs. When a problem is
stated, the names are looked up in its model (``processes.conditions``). This gives the coefficient
of each pair of an augmented process. Quantities can be added and scaled; comparing one with a
number makes a constraint:

    secondary_cost(fuel) + 2.0 * visits("ward") <= 12.0
    end_probability("wall") >= 0.1
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import isfinite

import numpy as np
import numpy.typing as npt

from ssp_lp.accumulated_cost.charges import ExpectedArrivalCost
from ssp_lp.arrays import BoolArray, FloatArray, read_only
from ssp_lp.errors import (
    ModelError,
    attributes_of,
    did_you_mean,
    in_short,
    is_amount,
    is_number,
    nearest_name,
)
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained, explained_class
from ssp_lp.model.graph import end_marks
from ssp_lp.model.product import ProductSSP
from ssp_lp.model.tracked_product import Automaton, TrackedSSP, followed_in
from ssp_lp.processes.conditions import OBJECTIVE, RESERVED, ArrivalTerm, Condition, StepTerm, Term
from ssp_lp.processes.past_failing import past_failing_term

NestedCosts = Mapping[Hashable, Mapping[Hashable, float]]


@dataclass(frozen=True, eq=False, repr=False)
class _StageCosts:
    """The expected total of a cost of steps.

    ``cost`` is None for the model's own cost, the name of another cost of the model, an array per
    pair or per outcome, or nested dicts.
    """

    cost: NestedCosts | npt.ArrayLike | str | None = None
    through_failure: bool = False

    def __repr__(self) -> str:
        """Return the call that creates the quantity, as text without the costs."""
        told = repr(self.cost) if isinstance(self.cost, str) else "..."
        return "expected_cost()" if self.cost is None else f"secondary_cost({told})"


@dataclass(frozen=True, repr=False)
class _Visits:
    """The expected visits of states, the start included; ``of`` has states or labels of states."""

    of: tuple[Hashable, ...]
    through_failure: bool = False

    def __repr__(self) -> str:
        """Return the call that creates the quantity, as text."""
        return f"visits({', '.join(map(repr, self.of))})"


@dataclass(frozen=True, repr=False)
class _Ends:
    """The probability that a run ends in one of ``ways``; if ``others``, in none of them."""

    ways: tuple[Hashable, ...]
    others: bool = False

    def __repr__(self) -> str:
        """Return the call that creates the quantity, as text."""
        ways = f"end_probability({', '.join(map(repr, self.ways))})"
        return f"1 - {ways}" if self.others else ways


@dataclass(frozen=True, eq=False, repr=False)
class _ArrivalCosts:
    """A charge at the goal: a function of the total cost that is affine above ``affine_from``."""

    function: Callable[[FloatArray], FloatArray]
    affine_from: float

    def __repr__(self) -> str:
        """Return the call that creates the quantity, as text without the function."""
        return "arrival_cost(...)"


class RunEvent(ABC):
    """An event of a whole run, whose probability is a quantity.

    An automaton follows the run and decides whether the event occurs (``model.tracked_product``).
    """

    @abstractmethod
    def automaton(self, model: SSP) -> Automaton:
        """Return the automaton that follows runs of a model.

        Raises:
            ModelError: an unknown name, or too many values.
        """

    @abstractmethod
    def term(self, product: TrackedSSP) -> ArrivalTerm:
        """Return the term that counts the event, as arrivals in states of the product."""

    def rounded_down(self) -> RunEvent:
        """Return the event whose amounts, if the automaton rounds them, are rounded down."""
        return self

    def is_safe(self, constraint: Constraint, is_stated: bool) -> bool:
        """Return whether a limit is satisfied if it is satisfied with rounded amounts.

        Args:
            constraint: the limit, or the objective as a limit.
            is_stated: whether it is one of the problem's ``constraints``.
        """
        return is_stated or constraint.quantity is not None

    def looked_up(self, model: SSP) -> ArrivalTerm:
        """Return the term that counts the event, on a model built from the automaton's product."""
        found = followed_in(model, self)
        if found is None:
            raise ModelError(f"{self!r} can be limited in a problem's constraints only")
        term = self.term(found[0])
        return replace(term, model=model, states=term.states[found[1]])


Counted = _StageCosts | _Visits | _Ends | _ArrivalCosts | RunEvent


@dataclass(frozen=True, eq=False, repr=False)
class Quantity:
    """A quantity to minimise or limit: a weighted sum of terms, and a constant."""

    terms: tuple[tuple[float, Counted], ...]
    constant: float = 0.0
    __array_ufunc__ = None  # so that NumPy numbers can scale it

    def __array__(self, *_: object) -> None:
        """Raise an error: ``parameter * quantity`` would treat the quantity as an array (cvxpy).

        Raises:
            ModelError: always.
        """
        raise ModelError(f"{self!r} is not an array{_WITH_CVXPY}")

    def __add__(self, other: Quantity | float) -> Quantity:
        """Return the sum with another quantity or a number."""
        if isinstance(other, Quantity):
            return Quantity(self.terms + other.terms, self.constant + other.constant)
        return Quantity(self.terms, self.constant + _quantity_number(other))

    def __mul__(self, factor: float) -> Quantity:
        """Return the quantity times a number."""
        times = _quantity_number(factor)
        terms = tuple((weight * times, counted) for weight, counted in self.terms)
        return Quantity(terms, self.constant * times)

    def __truediv__(self, divisor: float) -> Quantity:
        """Return the quantity divided by a number."""
        return self * (1.0 / _quantity_number(divisor))

    __radd__ = __add__
    __rmul__ = __mul__

    def __neg__(self) -> Quantity:
        """Return the quantity with the opposite sign."""
        return self * -1.0

    def __sub__(self, other: Quantity | float) -> Quantity:
        """Return the quantity minus another quantity or a number."""
        return self + -1.0 * (other if isinstance(other, Quantity) else _quantity_number(other))

    def __rsub__(self, other: float) -> Quantity:
        """Return a number minus the quantity."""
        return -self + other

    def __le__(self, bound: Quantity | float) -> Constraint:
        """Return the constraint "at most a number, or another quantity"."""
        if isinstance(bound, Quantity):
            return Constraint(self - bound, upper=0.0)
        return Constraint(self, upper=_quantity_number(bound))

    def __ge__(self, bound: Quantity | float) -> Constraint:
        """Return the constraint "at least a number, or another quantity"."""
        if isinstance(bound, Quantity):
            return Constraint(self - bound, lower=0.0)
        return Constraint(self, lower=_quantity_number(bound))

    def __lt__(self, bound: object) -> Constraint:
        """Raise an error: a limit includes its bound (``<=`` or ``>=``).

        Raises:
            ModelError: always.
        """
        raise ModelError(f"a limit includes its bound: write {self!r} <= {bound!r}")

    def __gt__(self, bound: object) -> Constraint:
        """Raise an error: a limit includes its bound (``<=`` or ``>=``).

        Raises:
            ModelError: always.
        """
        raise ModelError(f"a limit includes its bound: write {self!r} >= {bound!r}")

    def __eq__(self, value: float) -> Constraint:  # type: ignore[override]
        """Return the constraint "exactly a number"."""
        return Constraint(self, lower=_quantity_number(value), upper=_quantity_number(value))

    def __repr__(self) -> str:
        """Return the weighted sum of the terms, as Python code."""
        parts = [f"{c!r}" if w == 1.0 else f"{w:g} * {c!r}" for w, c in self.terms]
        parts += [f"{self.constant:g}"] if self.constant or not parts else []
        return " + ".join(parts)


@dataclass(frozen=True, eq=False, repr=False)
class Constraint:
    """A limit on a quantity: a lower bound, an upper bound, or both."""

    quantity: Quantity
    lower: float | None = None
    upper: float | None = None

    def __repr__(self) -> str:
        """Return the quantity between its bounds, as text."""
        low = "" if self.lower is None else f"{self.lower:g} <= "
        high = "" if self.upper is None else f" <= {self.upper:g}"
        return f"{low}{self.quantity!r}{high}"

    def __bool__(self) -> bool:
        """Raise an error: ``0.1 <= quantity <= 0.2`` would silently drop its first half.

        Raises:
            ModelError: always.
        """
        raise ModelError(
            "a constraint has no truth value: write low <= quantity <= high as two constraints, "
            "each under its own name"
        )


@explained
def expected_cost() -> Quantity:
    """Return the quantity "expected total cost", counted as the criterion counts costs."""
    return Quantity(((1.0, _StageCosts()),))


@explained
def secondary_cost(
    cost: NestedCosts | npt.ArrayLike | str, *, through_failure: bool = False
) -> Quantity:
    """Return the quantity "expected total of another cost", counted until failing.

    Args:
        cost: the name of a cost of the model, such as "fuel"; ``{state: {action: cost}}``, 0 for
            pairs that are not listed; or an array, [pairs] or [outcomes]; finite and >= 0.
        through_failure: also count the steps after failing, to the true end of the run
            (mathematics, section 2); then no charge of failing is added.
    """
    return Quantity(((1.0, _StageCosts(cost, through_failure)),))


@explained
def visits(*states: Hashable, through_failure: bool = False) -> Quantity:
    """Return the quantity "expected visits" of some states.

    Starting in a state, entering it and staying in it for a step each count as a visit. Visits
    count until the goal is reached or the run fails; a dead-end is entered at most once.

    Args:
        states: states, or labels of states.
        through_failure: also count after failing, to the true end of the run (mathematics,
            section 2).

    Raises:
        ModelError: no state, or a list instead of states.
    """
    _check_quantity_names("visits", states)
    return Quantity(((1.0, _Visits(states, through_failure)),))


@explained
def end_probability(*ways: Hashable) -> Quantity:
    """Return the quantity "probability that an episode ends in one of some ways".

    After failing, costs are not counted, but the run goes on: from a dead-end with actions, and
    from a state where the policy gave up, it continues to its true end (mathematics, section 2).
    The true end is the goal, the first dead-end with one of the names used in the problem, or else
    the place where the run can go no further.

    Args:
        ways: "goal", a label of dead-ends, "dead_end" (without a label), as in the ``ends`` of
            reports; or a state at which episodes end.
    """
    _check_quantity_names("end_probability", ways)
    return Quantity(((1.0, _Ends(ways)),))


@explained
def goal_probability() -> Quantity:
    """Return the quantity "probability of reaching the goal"."""
    return end_probability("goal")


@explained
def failure_probability() -> Quantity:
    """Return the quantity "probability of never reaching the goal"."""
    return Quantity(((1.0, _Ends(("goal",), others=True)),))


@explained
def arrival_cost(
    function: Callable[[FloatArray], FloatArray] | None = None, *, affine_from: float = 0.0
) -> Quantity:
    """Return the quantity "charge of the total cost at the goal", to minimise given success.

    As the ``quantity`` of your own criterion with ``ratio = True`` it means E[f(C) | goal], such as
    the mean lateness ``arrival_cost(lambda c: np.maximum(c - due, 0.0), affine_from=due)``. Several
    arrival costs can be added and scaled. They can neither be limited nor added to other
    quantities, since a program has no row for a function of a run's total cost.

    Args:
        function: f, on arrays of total costs: non-negative, non-decreasing; None: the total cost.
        affine_from: a total from which f is affine.

    Raises:
        ModelError: not a function, or a total that is not a number >= 0.
    """
    if function is not None and not callable(function):
        raise ModelError(f"arrival_cost takes a function of total costs, not {in_short(function)}")
    if (line := _quantity_number(affine_from)) < 0.0:
        raise ModelError(f"affine_from must be at least 0, not {line:g}")
    return Quantity(((1.0, _ArrivalCosts(np.asarray if function is None else function, line)),))


def _check_quantity_names(verb: str, names: tuple[object, ...]) -> None:
    """Check that names are given one by one; else raise :class:`ModelError`."""
    for name in names:
        if not isinstance(name, Hashable):
            raise ModelError(f"{verb}() takes names one by one, {verb}('a', 'b'), not {name!r}")


def _quantity_number(value: object) -> float:
    """Return a finite number to scale, shift or bound a quantity."""
    if is_number(value) and isfinite(number := float(value)):
        return number
    complaint = f"a quantity can be combined with finite numbers, not with {in_short(value)}"
    raise ModelError(complaint + cvxpy_hint(value))


_WITH_CVXPY = (
    ": with parameters and variables of cvxpy, use its expression in a program, "
    "convex.expression(quantity) * parameter; for costs of actions, sum "
    "convex.visits(state, action) * parameter"
)


def cvxpy_hint(value: object) -> str:
    """Return a hint for an expression of cvxpy in place of a number; else an empty string."""
    return _WITH_CVXPY if attributes_of(value, "is_dcp") else ""


@explained_class
@dataclass(frozen=True, eq=False)
class CostLimit:
    """An upper bound on an expected secondary cost: ``secondary_cost(cost) <= bound``.

    Args:
        cost: ``{state: {action: cost}}``, 0 for pairs that are not listed; or an array, [pairs] or
            [outcomes].
        bound: the largest expected total, in the unit of the cost, >= 0.
    """

    cost: NestedCosts | npt.ArrayLike = field(repr=False)
    bound: float


def constraints_of(limits: Mapping[str, CostLimit]) -> dict[str, Constraint]:
    """Convert limits of secondary costs to constraints on quantities, by name.

    Raises:
        ModelError: not a mapping of limits, or a bound that is not a finite number >= 0.
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


def outcome_costs(model: SSP, cost: NestedCosts | npt.ArrayLike | str) -> FloatArray:
    """Return a cost by outcome, [outcomes].

    Args:
        model: the model.
        cost: the name of a cost of the model, ``{state: {action: cost}}``, or an array, [pairs] or
            [outcomes].

    Raises:
        ModelError: an unknown name, a cost that is not a finite number >= 0, an array of a wrong
            length, or an unknown state or action.
    """
    if isinstance(cost, str):
        return model.cost_named(cost)
    if isinstance(cost, Mapping):
        given = np.repeat(_listed_costs(model, cost), np.diff(model.outcome_offsets))
    else:
        try:
            numbers = np.array(cost)
            if numbers.dtype.kind not in "biufO":  # NumPy would convert complex numbers and text
                raise TypeError(f"{numbers.dtype} is not a type of real numbers")
            numbers = numbers.astype(np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise ModelError(f"the cost is not an array of numbers: {error}") from error
        given = _spread_costs(model, numbers)
    costs = read_only(given, np.float64)
    wrong = ~(np.isfinite(costs) & (costs >= 0.0))
    if wrong.any():
        outcome = int(np.argmax(wrong))
        complaint = f"the cost must be finite and >= 0, not {float(costs[outcome])!r}"
        raise ModelError(f"{model._describe_outcome(outcome)}: {complaint}")
    return costs


def _listed_costs(model: SSP, cost: NestedCosts) -> FloatArray:
    """Return costs from nested dicts, 0 for pairs that are not listed, [pairs]."""
    result = np.zeros(model.n_pairs)
    for state, actions in cost.items():
        places = model.places_of(state)
        if not isinstance(actions, Mapping):
            raise ModelError(f"costs of state {state!r} must be {{action: cost}}, not {actions!r}")
        acting = [int(k) for k in places if model.pair_offsets[k] < model.pair_offsets[k + 1]]
        if not acting and isinstance(model, ProductSSP) and model.find(state) is None:
            _listed_costs(model.original, {state: actions})  # without actions there: only check
            continue
        for place in acting or places.tolist():
            pair_of = {model.action_of(pair): pair for pair in model.pairs_of(place)}
            for action, value in actions.items():
                if action not in pair_of:
                    raise ModelError(model.no_such_action(place, action))
                if not is_amount(value):
                    raise ModelError(
                        f"action {action!r} of state {model.states[place]!r}: the cost must be "
                        f"finite and >= 0, not {in_short(value)}{cvxpy_hint(value)}"
                    )
                result[pair_of[action]] = float(value)
    return result


def _spread_costs(model: SSP, given: FloatArray) -> FloatArray:
    """Return costs by outcome, [outcomes], from an array per pair or per outcome.

    The array may belong to the model, or to the model from which it was built as a product.
    """
    if isinstance(model, ProductSSP) and model.is_hidden:
        return np.asarray(_spread_costs(model.original, given)[model.original_outcome])
    own, theirs = _costs_by_outcome(model, given), None
    if isinstance(model, ProductSSP):
        theirs = _costs_by_outcome(model.original, given)
        theirs = None if theirs is None else theirs[model.original_outcome]
    if own is not None and theirs is not None and not np.array_equal(own, theirs):
        raise ModelError(
            f"an array of shape {given.shape} fits both the product and its original: give "
            "{state: {action: cost}}"
        )
    spread = theirs if own is None else own
    if spread is None:
        raise ModelError(
            f"the cost has shape {given.shape}: give an array of {model.n_pairs} pairs or "
            f"{model.n_outcomes} outcomes"
        )
    return spread


def _costs_by_outcome(model: SSP, given: FloatArray) -> FloatArray | None:
    """Return costs by outcome, [outcomes], from an array per pair or per outcome; None: neither."""
    if given.shape == (model.n_outcomes,):
        return given
    if given.shape == (model.n_pairs,):
        return np.repeat(given, np.diff(model.outcome_offsets))
    return None


def conditions(
    model: SSP, start: FloatArray, constraints: Mapping[str, Constraint]
) -> tuple[Condition, ...]:
    """Check constraints on quantities, and look up their names in the model.

    Args:
        model: the model.
        start: distribution over states, [states].
        constraints: name -> constraint.

    Raises:
        ModelError: a name that is not text or is reserved, not a constraint, an unknown state,
            action, label or end, costs of a wrong shape or below 0, or a lower bound of costs or
            visits.
    """
    looked_up = []
    for name, constraint in constraints.items():
        if not isinstance(name, str) or not name:
            raise ModelError(f"the name of a limit must be a word, not {name!r}")
        if name in RESERVED:
            raise ModelError(f"{name!r} names {RESERVED[name]}: give the limit another name")
        if not isinstance(constraint, Constraint):
            raise ModelError(f"limit {name!r} must be a quantity <= or >= a number: {constraint!r}")
        looked_up.append(_looked_up_terms(model, start, name, constraint))
    named = [row.name for condition in looked_up for row in condition.rows]
    if len(set(named)) < len(named):
        twice = next(name for name in named if named.count(name) > 1)
        raise ModelError(f"two rows would be named {twice!r}: give one constraint another name")
    return tuple(looked_up)


def objective_of(
    model: SSP, start: FloatArray, quantity: Quantity, *, signed: bool = False
) -> Condition:
    """Return the objective, with the names of its quantity looked up in the model.

    Args:
        model: the model.
        start: distribution over states, [states].
        quantity: the quantity.
        signed: whether costs and visits may be subtracted, as in an expression.

    Raises:
        ModelError: not a quantity, an unknown state, action, label or end, costs of a wrong shape
            or below 0, or costs or visits that would be maximised.
    """
    if not isinstance(quantity, Quantity):
        raise ModelError(f"the objective must be a quantity, such as visits(...), not {quantity!r}")
    objective = _looked_up_terms(model, start, OBJECTIVE, Constraint(quantity))
    if not signed:
        objective.minimised()
    return objective


def words_visited(constraint: Constraint) -> list[Hashable]:
    """Return the names of states and labels whose visits a constraint counts."""
    counted = (counted for _, counted in constraint.quantity.terms)
    return [word for one in counted if isinstance(one, _Visits) for word in one.of]


def run_events(constraints: Iterable[Constraint]) -> list[RunEvent]:
    """Return the events of whole runs (:class:`Followed`) that constraints count, each once."""
    terms = (counted for each in constraints for _, counted in each.quantity.terms)
    return list(dict.fromkeys(counted for counted in terms if isinstance(counted, RunEvent)))


def run_amounts(model: SSP, quantity: Quantity) -> tuple[FloatArray, FloatArray]:
    """Return the amounts that a run adds to its total of a quantity.

    Args:
        model: the model.
        quantity: a sum of costs and visits, with weights >= 0.

    Returns:
        The amount of each outcome, [outcomes], and of beginning in each state, [states].

    Raises:
        ModelError: the quantity has other terms, or a weight below 0.
    """
    amounts, begun = np.zeros(model.n_outcomes), np.zeros(model.n_states)
    for weight, counted in quantity.terms:
        if weight < 0.0:
            raise ModelError(f"the total of {quantity!r} may decrease: give weights >= 0")
        match counted:
            case _StageCosts(cost, False):
                costs = model.costs if cost is None else outcome_costs(model, cost)
                amounts = amounts + weight * costs
            case _Visits(of, False):
                there = _looked_up_states(model, of).astype(np.float64)
                amounts, begun = amounts + weight * there[model.successors], begun + weight * there
            case _:
                told = "the total of a run can count costs and visits, without through_failure"
                raise ModelError(f"{told}, not {counted!r}")
    return amounts, begun


def beyond_exploring(constraint: Constraint) -> str | None:
    """Return why a partly explored, implicit model cannot bound a quantity; None: it can."""
    for _, counted in constraint.quantity.terms:
        match counted:
            case _StageCosts(_, True) | _Visits(_, True):
                return f"{counted!r} counts events after failing, which are not explored"
            case _StageCosts(cost, _) if not (cost is None or isinstance(cost, str)):
                return "costs of an implicit model have names: secondary_cost('fuel')"
            case RunEvent():
                return f"{counted!r} depends on whole runs, which are not explored"
            case _Ends(ways) if ways != ("goal",):
                unknown = "counts ends that may not be explored: limit visits of these states"
                return f"{counted!r} {unknown}"
    return None


def arrival_measure(quantity: Quantity) -> ExpectedArrivalCost | None:
    """Return the expected charge that a sum of arrival costs describes; None without such costs.

    Raises:
        ModelError: other quantities are added, or a weight is negative.
    """
    terms = quantity.terms if isinstance(quantity, Quantity) else ()
    costs = [(weight, counted) for weight, counted in terms if isinstance(counted, _ArrivalCosts)]
    if not costs:
        return None
    if len(costs) < len(terms) or min(weight for weight, _ in costs) < 0.0:
        raise ModelError(
            "an arrival cost can be added only to arrival costs, with weights >= 0: put other "
            "quantities into constraints"
        )
    constant = quantity.constant

    def function(totals: FloatArray) -> FloatArray:
        charges = [weight * np.asarray(counted.function(totals)) for weight, counted in costs]
        return np.asarray(np.sum(charges, axis=0) + constant)

    line = max(counted.affine_from for _, counted in costs)
    return ExpectedArrivalCost(function, line)


def _looked_up_terms(model: SSP, start: FloatArray, name: str, constraint: Constraint) -> Condition:
    """Return a constraint with the terms of its quantity looked up in the model."""
    weights: dict[Counted, float] = {}
    for weight, counted in constraint.quantity.terms:  # weights of equal terms are added
        weights[counted] = weights.get(counted, 0.0) + weight
    try:
        terms = tuple((w, _looked_up_term(model, c)) for c, w in weights.items() if w != 0.0)
    except ModelError as error:
        raise ModelError(f"limit {name!r}: {error}") from error
    live = end_marks(model) < 0
    begun = sum(
        weight * float(start[term.states & live].sum())
        for weight, term in terms
        if isinstance(term, ArrivalTerm) and not term.final
    )
    stated = constraint.lower, constraint.upper
    return Condition(name, model, terms, constraint.quantity.constant + begun, *stated)


def _looked_up_term(model: SSP, counted: Counted) -> Term:
    """Return a term of a quantity, looked up in the model."""
    if (label := model.failure_label) is not None:
        return past_failing_term(label, _looked_up_term(label.original, counted))
    match counted:
        case _StageCosts(cost, through):
            if cost is None:
                return StepTerm(model)
            costs = outcome_costs(model, cost)
            return StepTerm(replace(model, costs=costs, exact_costs={}), through)
        case _ArrivalCosts():
            raise ModelError(
                "an arrival cost depends on the total of a whole run and cannot be limited: "
                "minimise it given success (ratio = True)"
            )
        case RunEvent():
            return counted.looked_up(model)
        case _Visits(of, through):
            return ArrivalTerm(model, _looked_up_states(model, of), through=through)
        case _Ends(ways, others):
            ends = _looked_up_states(model, ways, final=True)
            return ArrivalTerm(model, ends, final=True, others=others)


def _as_an_action(model: SSP, word: Hashable) -> str:
    """Return a hint if an unknown name of a state is, or resembles, the name of an action."""
    meant = nearest_name(word, model.action_names)
    if meant is None or nearest_name(word, model.states) is not None:
        return ""
    told = "it is an action" if meant == word else f"did you mean the action {meant!r}"
    return f"; {told}: secondary_cost({{state: {{{meant!r}: 1.0}}}}) counts how often it is taken"


def _looked_up_states(model: SSP, words: tuple[Hashable, ...], *, final: bool = False) -> BoolArray:
    """Return a mask of the states that some words name, [states].

    Args:
        model: the model.
        words: states and labels of states.
        final: whether the words name ways to end: "goal", labels of dead-ends, "dead_end", or
            states at which episodes end.
    """
    marks, labels = end_marks(model), model.state_labels
    named: list[Hashable] = ["goal", *labels, "dead_end"]
    mask = np.zeros(model.n_states, dtype=np.bool_)
    for word in words:
        labelled = labels[word] if isinstance(word, str) and word in labels else None
        if final and word in named:
            ends = marks == named.index(word)
            if labelled is not None:  # a goal with this label is an end, too
                ends[labelled] |= model.goal_mask[labelled]
                if labelled.size and not ends.any():
                    raise ModelError(f"no episode ends in a state labelled {word!r}{_NO_END}")
            mask |= ends
            continue
        if labelled is not None:
            mask[labelled] = True
            continue
        try:
            states = model.places_of(word)
        except ModelError as error:
            known: list[Hashable] = [*labels]
            told = "neither a state nor a label of states"
            if final:
                known, told = named, f"neither an end ({', '.join(map(repr, named))}) nor a state"
            others = did_you_mean(word, [*known, *model.states], "there are")
            raise ModelError(f"{word!r} is {told}{_as_an_action(model, word) or others}") from error
        if final and states.size and (marks[states] < 0).all():  # a horizon may leave none
            raise ModelError(f"no episode ends in state {word!r}{_NO_END}")
        mask[states[marks[states] >= 0] if final else states] = True
    return mask


_NO_END = ": use visits(...)"
