"""What can be counted and limited: named linear functionals of an occupation measure.

A quantity says what it counts in the model's own words; what it is at the pairs of an augmented
process is worked out when a problem is stated (``processes.quantities.conditions``). Quantities
add and scale, and comparing one with a number makes a constraint:

    secondary_cost(fuel) + 2.0 * visits("ward") <= 12.0
    end_probability("wall") >= 0.1
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from math import isfinite

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError, in_short, is_number

NestedCosts = Mapping[Hashable, Mapping[Hashable, float]]


@dataclass(frozen=True, eq=False, repr=False)
class StageCosts:
    """A cost of steps: None: the model's own; else by pair, by outcome, or nested dicts."""

    cost: NestedCosts | npt.ArrayLike | None = None

    def __repr__(self) -> str:
        """What was called, without the costs."""
        return "expected_cost()" if self.cost is None else "secondary_cost(...)"


@dataclass(frozen=True, repr=False)
class Visits:
    """How often some states are entered or started in; names are states or labels of states."""

    of: tuple[Hashable, ...]

    def __repr__(self) -> str:
        """What was called."""
        return f"visits({', '.join(map(repr, self.of))})"


@dataclass(frozen=True, repr=False)
class Ends:
    """The probability of ending in one of several ways, or, as ``others``, in none of them."""

    ways: tuple[Hashable, ...]
    others: bool = False

    def __repr__(self) -> str:
        """What was called."""
        ways = f"end_probability({', '.join(map(repr, self.ways))})"
        return f"1 - {ways}" if self.others else ways


@dataclass(frozen=True, eq=False, repr=False)
class ArrivalCosts:
    """What arriving at the goal costs: a function of the total cost, in the end a line."""

    function: Callable[[FloatArray], FloatArray]
    affine_from: float

    def __repr__(self) -> str:
        """What was called."""
        return "arrival_cost(...)"


Counted = StageCosts | Visits | Ends | ArrivalCosts


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


def expected_cost() -> Quantity:
    """The model's own expected total cost, counted as the criterion counts costs."""
    return Quantity(((1.0, StageCosts()),))


def secondary_cost(cost: NestedCosts | npt.ArrayLike) -> Quantity:
    """The expected total of another cost, counted as the model's own is.

    Args:
        cost: ``{state: {action: cost}}``, pairs that are not listed costing nothing; or an array,
            [pairs], or [outcomes]; finite and >= 0.
    """
    return Quantity(((1.0, StageCosts(cost)),))


def visits(*states: Hashable) -> Quantity:
    """How often some states are entered or started in, in expectation; staying counts each time.

    Counted until the goal is reached or failure declared; a dead-end is entered once at most.

    Args:
        states: states, or labels of states.

    Raises:
        ModelError: none is given, or a list in place of a state.
    """
    _check_quantity_names("visits", states)
    return Quantity(((1.0, Visits(states)),))


def end_probability(*ways: Hashable) -> Quantity:
    """The probability that an episode ends in one of some ways.

    Args:
        ways: "goal", a label of dead-ends, "dead_end" (one without a label), as in the ``ends`` of
            reports; or a state at which episodes end.
    """
    _check_quantity_names("end_probability", ways)
    return Quantity(((1.0, Ends(ways)),))


def goal_probability() -> Quantity:
    """The probability of reaching the goal."""
    return end_probability("goal")


def failure_probability() -> Quantity:
    """The probability of never reaching the goal."""
    return Quantity(((1.0, Ends(("goal",), others=True)),))


def arrival_cost(
    function: Callable[[FloatArray], FloatArray] | None = None, *, affine_from: float = 0.0
) -> Quantity:
    """What arriving at the goal costs, a function of the total cost: minimised given success.

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
    return Quantity(((1.0, ArrivalCosts(np.asarray if function is None else function, line)),))


def _check_quantity_names(verb: str, names: tuple[object, ...]) -> None:
    """Raise :class:`ModelError` unless a quantity takes its names one by one."""
    for name in names:
        if not isinstance(name, Hashable):
            raise ModelError(f"{verb} takes names one by one, {verb}('a', 'b'), not {name!r}")


def _quantity_number(value: object) -> float:
    """A finite number that a quantity goes with."""
    if is_number(value) and isfinite(number := float(value)):
        return number
    told = f"a quantity goes with finite numbers, not with {in_short(value)}"
    raise ModelError(told + beside_cvxpy(value))


_WITH_CVXPY = (
    ": with cvxpy's parameters and variables goes what it is in a program, "
    "convex.expression(quantity) * parameter; costs of actions that are such are "
    "convex.visits(state, action) * parameter, summed"
)


def beside_cvxpy(value: object) -> str:
    """What to write, in an error, where a number is to be an expression of cvxpy."""
    return _WITH_CVXPY if hasattr(value, "is_dcp") else ""
