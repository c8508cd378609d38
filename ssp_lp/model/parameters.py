"""Parameters of a model: named numbers in the affine expressions of probabilities and costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import NoReturn

from ssp_lp.errors import ModelError, in_short, is_number


class Affine:
    """An affine expression of parameters: a constant and a slope for each parameter, by name."""

    __array_ufunc__ = None  # numpy's numbers are operands like others

    def __init__(
        self, constant: float, slopes: Mapping[str, float], values: Mapping[str, float]
    ) -> None:
        self.constant, self.slopes, self.values = constant, dict(slopes), dict(values)

    def __float__(self) -> float:
        """Return the value of the expression at its parameters' values."""
        terms = (slope * self.values[name] for name, slope in self.slopes.items())
        return float(self.constant + sum(terms))

    def __add__(self, other: Affine | float) -> Affine:
        """Return the sum.

        Raises:
            ModelError: one parameter has two values, or the other summand is not a number.
        """
        if not isinstance(other, Affine):
            return Affine(self.constant + _factor(other), self.slopes, self.values)
        for name in self.values.keys() & other.values.keys():
            if self.values[name] != other.values[name]:
                both = f"{self.values[name]:g} and {other.values[name]:g}"
                raise ModelError(f"parameter {name!r} has two values: {both}")
        slopes = {
            name: self.slopes.get(name, 0.0) + other.slopes.get(name, 0.0)
            for name in {**self.slopes, **other.slopes}
        }
        return Affine(self.constant + other.constant, slopes, {**self.values, **other.values})

    def __mul__(self, factor: float) -> Affine:
        times = _factor(factor)
        slopes = {name: times * slope for name, slope in self.slopes.items()}
        return Affine(times * self.constant, slopes, self.values)

    __radd__ = __add__
    __rmul__ = __mul__

    def __truediv__(self, divisor: float) -> Affine:
        return self * (1.0 / _factor(divisor))

    def _refuse(self, other: object) -> NoReturn:
        """Refuse a power, a division by the expression, or a comparison.

        Raises:
            ModelError: always.
        """
        raise ModelError(
            f"{self!r} is used in a comparison, divisor or power: expressions must be affine"
        )

    __rtruediv__ = __pow__ = __rpow__ = __lt__ = __le__ = __gt__ = __ge__ = _refuse

    def __neg__(self) -> Affine:
        return self * -1.0

    def __sub__(self, other: Affine | float) -> Affine:
        return self + -other

    def __rsub__(self, other: float) -> Affine:
        return -self + other

    def __repr__(self) -> str:
        """Return the expression as it would be typed."""
        signs = {1.0: "", -1.0: "-"}
        terms = [signs.get(s, f"{s:g} * ") + name for name, s in self.slopes.items()]
        constant = [f"{self.constant:g}"] if self.constant or not terms else []
        return " + ".join([*constant, *terms]).replace(" + -", " - ")


class Parameter(Affine):
    """A named number, on which probabilities and costs of a model may depend affinely.

    Args:
        name: name by which ``model.with_parameters`` and ``sweep`` change it.
        value: its value.

    Raises:
        ModelError: the name is not an identifier, or the value is not a number.

    Example:
        >>> from ssp_lp import SSP, Parameter
        >>> crash = Parameter("crash", 0.1)
        >>> model = SSP.from_transitions(
        ...     {"road": {"go": [(1 - crash, "home", 2.0), (crash, "ditch", 1 + 2 * crash)]}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> model.with_parameters(crash=0.25).probabilities.tolist()
        [0.75, 0.25]
    """

    def __init__(self, name: str, value: float) -> None:
        if not (isinstance(name, str) and name.isidentifier()):
            raise ModelError(f"a parameter's name must be a word such as 'p_crash', not {name!r}")
        if isinstance(value, bool) or not is_number(value):
            raise ModelError(f"the value of parameter {name!r} is not a number: {in_short(value)}")
        super().__init__(0.0, {name: 1.0}, {name: float(value)})


def _factor(value: float) -> float:
    """Return a number to combine with a parameter, as a float; :class:`ModelError` otherwise."""
    if isinstance(value, Affine):
        raise ModelError(f"{value!r} is multiplied by a parameter: expressions must be affine")
    if not isinstance(value, Real):
        raise ModelError(f"a parameter combines with numbers only, not with {in_short(value)}")
    return float(value)


@dataclass(frozen=True)
class PlacedParameter:
    """A parameter of a model: its value, and the derivatives of the model's data by it."""

    value: float
    probabilities: dict[int, float] = field(default_factory=dict, repr=False)  # by outcome
    costs: dict[tuple[str, int], float] = field(default_factory=dict, repr=False)
    """Derivatives by name of the cost ("cost" if it has none) and outcome."""
