"""What can be counted and limited: named linear functionals of an occupation measure.

A quantity says what it counts in the model's own words; what it is at the pairs of an augmented
process is worked out when a problem is stated: words are looked up in the model and become
``processes.conditions``. Quantities add and scale, and comparing one with a number makes a
constraint:

    secondary_cost(fuel) + 2.0 * visits("ward") <= 12.0
    end_probability("wall") >= 0.1
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import update_wrapper
from inspect import signature
from math import isfinite
from typing import Generic, ParamSpec

import numpy as np
import numpy.typing as npt

from ssp_lp.accumulated_cost.charges import ExpectedArrivalCost
from ssp_lp.arrays import BoolArray, FloatArray, read_only
from ssp_lp.errors import ModelError, did_you_mean, in_short, is_number, nearest_name
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained, explained_class
from ssp_lp.model.graph import end_marks
from ssp_lp.model.product import ProductSSP
from ssp_lp.model.tracked_product import Automaton, TrackedSSP, followed_in
from ssp_lp.processes.conditions import OBJECTIVE, RESERVED, ArrivalTerm, Condition, StepTerm, Term
from ssp_lp.processes.past_failing import past_failing_term

_Given = ParamSpec("_Given")

NestedCosts = Mapping[Hashable, Mapping[Hashable, float]]


@dataclass(frozen=True, eq=False, repr=False)
class _StageCosts:
    """A cost of steps: None: the model's own; else a name, by pair, by outcome, or nested dicts."""

    cost: NestedCosts | npt.ArrayLike | str | None = None
    through_failure: bool = False

    def __repr__(self) -> str:
        """What was called, without the costs."""
        told = repr(self.cost) if isinstance(self.cost, str) else "..."
        return "expected_cost()" if self.cost is None else f"secondary_cost({told})"


@dataclass(frozen=True, repr=False)
class _Visits:
    """How often some states are entered or started in; names are states or labels of states."""

    of: tuple[Hashable, ...]
    through_failure: bool = False

    def __repr__(self) -> str:
        """What was called."""
        return f"visits({', '.join(map(repr, self.of))})"


@dataclass(frozen=True, repr=False)
class _Ends:
    """The probability of ending in one of several ways, or, as ``others``, in none of them."""

    ways: tuple[Hashable, ...]
    others: bool = False

    def __repr__(self) -> str:
        """What was called."""
        ways = f"end_probability({', '.join(map(repr, self.ways))})"
        return f"1 - {ways}" if self.others else ways


@dataclass(frozen=True, eq=False, repr=False)
class _ArrivalCosts:
    """What arriving at the goal costs: a function of the total cost, in the end a line."""

    function: Callable[[FloatArray], FloatArray]
    affine_from: float

    def __repr__(self) -> str:
        """What was called."""
        return "arrival_cost(...)"


class Followed(ABC):
    """Runs that a quantity counts by an automaton that follows them (``model.tracked_product``)."""

    @abstractmethod
    def automaton(self, model: SSP) -> Automaton:
        """The automaton, on a model.

        Raises:
            ModelError: a word that the model does not know, or too many values.
        """

    @abstractmethod
    def term(self, product: TrackedSSP) -> ArrivalTerm:
        """The runs counted, as arrivals in states of the product with the automaton."""

    def looked_up(self, model: SSP) -> ArrivalTerm:
        """The runs counted, as arrivals in states of a product made of the automaton's."""
        found = followed_in(model, self)
        if found is None:
            raise ModelError(f"{self!r} is limited in a problem's constraints only")
        term = self.term(found[0])
        return replace(term, model=model, states=term.states[found[1]])


Counted = _StageCosts | _Visits | _Ends | _ArrivalCosts | Followed


@dataclass(frozen=True, eq=False, repr=False)
class Quantity:
    """A weighted sum of what is counted, and a constant."""

    terms: tuple[tuple[float, Counted], ...]
    constant: float = 0.0
    __array_ufunc__ = None  # numbers of numpy's go with it as others do

    def __array__(self, *_: object) -> None:
        """Refused: ``parameter * quantity``, of cvxpy, takes it for an array.

        Raises:
            ModelError: always.
        """
        raise ModelError(f"{self!r} is no array{_WITH_CVXPY}")

    def __add__(self, other: Quantity | float) -> Quantity:
        """The sum."""
        if isinstance(other, Quantity):
            return Quantity(self.terms + other.terms, self.constant + other.constant)
        return Quantity(self.terms, self.constant + _quantity_number(other))

    def __mul__(self, factor: float) -> Quantity:
        """The multiple."""
        times = _quantity_number(factor)
        terms = tuple((weight * times, counted) for weight, counted in self.terms)
        return Quantity(terms, self.constant * times)

    def __truediv__(self, divisor: float) -> Quantity:
        """The quotient by a number."""
        return self * (1.0 / _quantity_number(divisor))

    __radd__ = __add__
    __rmul__ = __mul__

    def __neg__(self) -> Quantity:
        """The opposite."""
        return self * -1.0

    def __sub__(self, other: Quantity | float) -> Quantity:
        """The difference."""
        return self + -1.0 * (other if isinstance(other, Quantity) else _quantity_number(other))

    def __rsub__(self, other: float) -> Quantity:
        """The difference."""
        return -self + other

    def __le__(self, bound: Quantity | float) -> Constraint:
        """At most a number, or another quantity."""
        if isinstance(bound, Quantity):
            return Constraint(self - bound, upper=0.0)
        return Constraint(self, upper=_quantity_number(bound))

    def __ge__(self, bound: Quantity | float) -> Constraint:
        """At least a number, or another quantity."""
        if isinstance(bound, Quantity):
            return Constraint(self - bound, lower=0.0)
        return Constraint(self, lower=_quantity_number(bound))

    def __lt__(self, bound: object) -> Constraint:
        """Refused: a limit includes its bound.

        Raises:
            ModelError: always.
        """
        raise ModelError(f"a limit includes its bound: write {self!r} <= {bound!r}")

    def __gt__(self, bound: object) -> Constraint:
        """Refused: a limit includes its bound.

        Raises:
            ModelError: always.
        """
        raise ModelError(f"a limit includes its bound: write {self!r} >= {bound!r}")

    def __eq__(self, value: float) -> Constraint:  # type: ignore[override]
        """Exactly a number."""
        return Constraint(self, lower=_quantity_number(value), upper=_quantity_number(value))

    def __repr__(self) -> str:
        """The sum as it would be typed."""
        parts = [f"{c!r}" if w == 1.0 else f"{w:g} * {c!r}" for w, c in self.terms]
        parts += [f"{self.constant:g}"] if self.constant or not parts else []
        return " + ".join(parts)


@dataclass(frozen=True, eq=False, repr=False)
class Constraint:
    """A quantity with bounds."""

    quantity: Quantity
    lower: float | None = None
    upper: float | None = None

    def __repr__(self) -> str:
        """The quantity between its bounds."""
        low = "" if self.lower is None else f"{self.lower:g} <= "
        high = "" if self.upper is None else f" <= {self.upper:g}"
        return f"{low}{self.quantity!r}{high}"

    def __bool__(self) -> bool:
        """Refused: ``0.1 <= quantity <= 0.2`` would silently drop its first half.

        Raises:
            ModelError: always.
        """
        raise ModelError("a constraint has no truth value: state two, each under its own name")


class QuantityFunction(Generic[_Given]):
    """A function that makes a quantity; comparing or adding the function itself is an error."""

    def __init__(self, make: Callable[_Given, Quantity]) -> None:
        update_wrapper(self, make)
        self._make = explained(make)

    def __call__(self, *arguments: _Given.args, **named: _Given.kwargs) -> Quantity:
        """Make the quantity."""
        return self._make(*arguments, **named)

    def __reduce__(self) -> str:
        """Pickled by its name, as functions are."""
        return self._make.__qualname__

    def __repr__(self) -> str:
        """The function's name and arguments."""
        return f"{self._make.__name__}{signature(self._make)}"

    def _uncalled(self, other: object) -> Quantity:
        """Refused: the function has not been called.

        Raises:
            ModelError: always.
        """
        name = self._make.__name__
        inside = "..." if signature(self._make).parameters else ""
        raise ModelError(f"{name} is a function: call it, such as {name}({inside}) <= 5")

    __le__ = __ge__ = __lt__ = __gt__ = __add__ = __radd__ = __mul__ = __rmul__ = _uncalled


@QuantityFunction
def expected_cost() -> Quantity:
    """The quantity "expected total cost" of the model, counted as the criterion counts costs."""
    return Quantity(((1.0, _StageCosts()),))


@QuantityFunction
def secondary_cost(
    cost: NestedCosts | npt.ArrayLike | str, *, through_failure: bool = False
) -> Quantity:
    """The expected total of another cost, counted as the model's own is: until failing.

    Args:
        cost: the name of a cost of the model's, "fuel"; ``{state: {action: cost}}``, pairs that are
            not listed costing nothing; or an array, [pairs], or [outcomes]; finite and >= 0.
        through_failure: count it to the true end of the run (mathematics, section 2): each step
            that is taken after failing, and no charge in its place.
    """
    return Quantity(((1.0, _StageCosts(cost, through_failure)),))


@QuantityFunction
def visits(*states: Hashable, through_failure: bool = False) -> Quantity:
    """The quantity "expected visits" of some states, entered or begun in; staying counts too.

    Counted until the goal is reached or failure declared; a dead-end is entered once at most.

    Args:
        states: states, or labels of states.
        through_failure: count after failing too, to the true end of the run (mathematics, section
            2).

    Raises:
        ModelError: none is given, or a list in place of a state.
    """
    _check_quantity_names("visits", states)
    return Quantity(((1.0, _Visits(states, through_failure)),))


@QuantityFunction
def end_probability(*ways: Hashable) -> Quantity:
    """The quantity "probability that an episode ends in one of some ways".

    Failing ends the cost, not the run: from a dead-end that has actions, and from where a policy
    gave up, it goes on to its true end (mathematics, section 2). That is the goal, the first
    dead-end that bears one of the names a problem asks for, else where it can go no further.

    Args:
        ways: "goal", a label of dead-ends, "dead_end" (one without a label), as in the ``ends`` of
            reports; or a state at which episodes end.
    """
    _check_quantity_names("end_probability", ways)
    return Quantity(((1.0, _Ends(ways)),))


@QuantityFunction
def goal_probability() -> Quantity:
    """The quantity "probability of reaching the goal"."""
    return end_probability("goal")


@QuantityFunction
def failure_probability() -> Quantity:
    """The quantity "probability of never reaching the goal"."""
    return Quantity(((1.0, _Ends(("goal",), others=True)),))


@QuantityFunction
def arrival_cost(
    function: Callable[[FloatArray], FloatArray] | None = None, *, affine_from: float = 0.0
) -> Quantity:
    """The quantity "cost of arriving", a function of the total cost: minimised given success.

    As the ``quantity`` of a criterion of one's own with ``ratio = True`` it is E[f(C) | goal], such
    as the mean lateness ``arrival_cost(lambda c: np.maximum(c - due, 0.0), affine_from=due)``.
    Several add and scale. What depends on the total of a whole run is no row of a program: it is
    not limited, nor added to what is counted on the way.

    Args:
        function: f, on arrays of total costs: at least 0, and non-decreasing; None: the total cost.
        affine_from: a total from which on f is a line.

    Raises:
        ModelError: no function, or a total that is no number >= 0.
    """
    if function is not None and not callable(function):
        raise ModelError(f"arrival_cost takes a function of total costs, not {in_short(function)}")
    if (line := _quantity_number(affine_from)) < 0.0:
        raise ModelError(f"affine_from must be at least 0, not {line:g}")
    return Quantity(((1.0, _ArrivalCosts(np.asarray if function is None else function, line)),))


def _check_quantity_names(verb: str, names: tuple[object, ...]) -> None:
    """Raise :class:`ModelError` unless a quantity takes its names one by one."""
    for name in names:
        if not isinstance(name, Hashable):
            raise ModelError(f"{verb} takes names one by one, {verb}('a', 'b'), not {name!r}")


def _quantity_number(value: object) -> float:
    """A finite number that a quantity goes with."""
    if is_number(value) and isfinite(number := float(value)):
        return number
    complaint = f"a quantity goes with finite numbers, not with {in_short(value)}"
    raise ModelError(complaint + cvxpy_hint(value))


_WITH_CVXPY = (
    ": with cvxpy's parameters and variables goes what it is in a program, "
    "convex.expression(quantity) * parameter; costs of actions that are such are "
    "convex.visits(state, action) * parameter, summed"
)


def cvxpy_hint(value: object) -> str:
    """Hint of an error for a quantity's number that is to be an expression of cvxpy."""
    return _WITH_CVXPY if hasattr(value, "is_dcp") else ""


@explained_class
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
    """Limits of secondary costs as constraints on quantities.

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


def outcome_costs(model: SSP, cost: NestedCosts | npt.ArrayLike | str) -> FloatArray:
    """A quantity's cost by outcome, [outcomes].

    Args:
        model: the model.
        cost: the name of one of the model's; ``{state: {action: cost}}``, or an array, [pairs] or
            [outcomes].

    Raises:
        ModelError: no cost of this name, one that is not a finite number >= 0, an array of the
            wrong length, an unknown state or action.
    """
    if isinstance(cost, str):
        return model.cost_named(cost)
    if isinstance(cost, Mapping):
        given = np.repeat(_listed_costs(model, cost), np.diff(model.outcome_offsets))
    else:
        try:
            numbers = np.array(cost)
            if numbers.dtype.kind not in "biufO":  # complex ones and texts numpy would convert
                raise TypeError(f"{numbers.dtype} is no type of real numbers")
            numbers = numbers.astype(np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise ModelError(f"the cost is no array of numbers: {error}") from error
        given = _spread_costs(model, numbers)
    costs = read_only(given, np.float64)
    wrong = ~(np.isfinite(costs) & (costs >= 0.0))
    if wrong.any():
        outcome = int(np.argmax(wrong))
        complaint = f"the cost must be finite and >= 0, not {float(costs[outcome])!r}"
        raise ModelError(f"{model._describe_outcome(outcome)}: {complaint}")
    return costs


def is_amount(value: object) -> bool:
    """Whether a quantity's bound or cost is a finite number >= 0 that a float can hold."""
    return is_number(value) and 0.0 <= float(value) < float("inf")


def _listed_costs(model: SSP, cost: NestedCosts) -> FloatArray:
    """A quantity's costs from nested dicts, 0 where nothing is listed, [pairs]."""
    result = np.zeros(model.n_pairs)
    for state, actions in cost.items():
        places = model.places_of(state)
        if not isinstance(actions, Mapping):
            raise ModelError(f"state {state!r}: not {{action: cost}}: {actions!r}")
        acting = [int(k) for k in places if model.pair_offsets[k] < model.pair_offsets[k + 1]]
        if not acting and isinstance(model, ProductSSP) and model.find(state) is None:
            _listed_costs(model.original, {state: actions})  # nobody acts there: a check only
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
    """A quantity's costs from an array of pairs or outcomes, also of an original, [outcomes]."""
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
            f"the cost has shape {given.shape}; {model.n_pairs} pairs or {model.n_outcomes} "
            "outcomes are needed"
        )
    return spread


def _costs_by_outcome(model: SSP, given: FloatArray) -> FloatArray | None:
    """A quantity's costs by pair or by outcome, [outcomes]; None if they are neither."""
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
        ModelError: a name that is no text or is reserved, no constraint, an unknown state, action,
            label or end, costs of the wrong shape or below 0, or a lower bound of costs or visits.
    """
    if not isinstance(constraints, Mapping):
        raise ModelError(f"constraints must be {{name: quantity <= bound}}, not {constraints!r}")
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
    """The quantity to be minimised, its names looked up in the model.

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
    objective = _looked_up_terms(model, start, OBJECTIVE, Constraint(quantity))
    if not signed:
        objective.minimised()
    return objective


def words_visited(constraint: Constraint) -> list[Hashable]:
    """Names of states and labels whose visits a constraint's quantity counts."""
    counted = (counted for _, counted in constraint.quantity.terms)
    return [word for one in counted if isinstance(one, _Visits) for word in one.of]


def followed_by(constraints: Iterable[Constraint]) -> list[Followed]:
    """Runs that constraints count by automata, each once."""
    terms = (counted for each in constraints for _, counted in each.quantity.terms)
    return list(dict.fromkeys(counted for counted in terms if isinstance(counted, Followed)))


def run_amounts(model: SSP, quantity: Quantity) -> tuple[FloatArray, FloatArray]:
    """Amounts of a quantity that a run adds up: of each outcome, and at each start.

    Args:
        model: the model.
        quantity: costs and visits, at weights >= 0.

    Returns:
        [outcomes], and [states] for a visit at the start.

    Raises:
        ModelError: something else is counted, or a weight is below 0.
    """
    amounts, begun = np.zeros(model.n_outcomes), np.zeros(model.n_states)
    for weight, counted in quantity.terms:
        if weight < 0.0:
            raise ModelError(f"the total of {quantity!r} may fall: give weights >= 0")
        match counted:
            case _StageCosts(cost, False):
                costs = model.costs if cost is None else outcome_costs(model, cost)
                amounts = amounts + weight * costs
            case _Visits(of, False):
                there = _looked_up_states(model, of).astype(np.float64)
                amounts, begun = amounts + weight * there[model.successors], begun + weight * there
            case _:
                told = "a total that ends with the goal or failing is one of costs and visits"
                raise ModelError(f"{told}, without through_failure, not of {counted!r}")
    return amounts, begun


def beyond_exploring(constraint: Constraint) -> str | None:
    """Why no explored part of an implicit model bounds a constraint's quantity; None: it does."""
    for _, counted in constraint.quantity.terms:
        match counted:
            case _StageCosts(_, True) | _Visits(_, True):
                return f"{counted!r} counts what comes after failing, which is not explored"
            case _StageCosts(cost, _) if not (cost is None or isinstance(cost, str)):
                return "costs of an implicit model have names: secondary_cost('fuel')"
            case Followed():
                return f"{counted!r} depends on whole runs, which are not explored"
            case _Ends(ways) if ways != ("goal",):
                unknown = "counts ends that may not be explored: limit visits of these states"
                return f"{counted!r} {unknown}"
    return None


def arrival_measure(quantity: Quantity) -> ExpectedArrivalCost | None:
    """The measure of a quantity that is made of arrival costs; None: it is not.

    Raises:
        ModelError: other quantities are added to it, or it is to be large.
    """
    terms = quantity.terms if isinstance(quantity, Quantity) else ()
    costs = [(weight, counted) for weight, counted in terms if isinstance(counted, _ArrivalCosts)]
    if not costs:
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


def _looked_up_terms(model: SSP, start: FloatArray, name: str, constraint: Constraint) -> Condition:
    """A constraint with the terms of its quantity looked up in the model."""
    weights: dict[Counted, float] = {}
    for weight, counted in constraint.quantity.terms:  # those that count the same are added up
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
    """One term of a quantity, looked up in the model."""
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
                "an arrival cost depends on the total of a whole run; it is minimised given "
                "success (ratio = True), not limited"
            )
        case Followed():
            return counted.looked_up(model)
        case _Visits(of, through):
            return ArrivalTerm(model, _looked_up_states(model, of), through=through)
        case _Ends(ways, others):
            ends = _looked_up_states(model, ways, final=True)
            return ArrivalTerm(model, ends, final=True, others=others)


def _as_an_action(model: SSP, word: Hashable) -> str:
    """For an error: a clause for a word in the place of a state that names an action, or nearly."""
    meant = nearest_name(word, model.action_names)
    if meant is None or nearest_name(word, model.states) is not None:
        return ""
    told = "it is an action" if meant == word else f"did you mean the action {meant!r}"
    return f"; {told}: secondary_cost({{state: {{{meant!r}: 1.0}}}}) counts how often it is taken"


def _looked_up_states(model: SSP, words: tuple[Hashable, ...], *, final: bool = False) -> BoolArray:
    """A quantity's states, by their names or a label's; or those that end in a way, [states]."""
    marks, labels = end_marks(model), model.state_labels
    named: list[Hashable] = ["goal", *labels, "dead_end"]
    mask = np.zeros(model.n_states, dtype=np.bool_)
    for word in words:
        labelled = labels[word] if isinstance(word, str) and word in labels else None
        if final and word in named:
            ends = marks == named.index(word)
            if labelled is not None:  # a goal that bears it is an end, too
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
                known, told = named, f"no way to end ({', '.join(map(repr, named))}) and no state"
            others = did_you_mean(word, [*known, *model.states], "there are")
            raise ModelError(f"{word!r} is {told}{_as_an_action(model, word) or others}") from error
        if final and states.size and (marks[states] < 0).all():  # a horizon may leave none
            raise ModelError(f"no episode ends in state {word!r}{_NO_END}")
        mask[states[marks[states] >= 0] if final else states] = True
    return mask


_NO_END = ": take visits(...)"
