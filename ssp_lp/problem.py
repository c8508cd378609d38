"""What makes a problem: a formulation hands this to ``solve``, ``evaluate`` and ``simulate``."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from numbers import Real
from typing import Protocol

from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.engines.instance import Instance
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.process.semantics import Semantics


class Problem(Protocol):
    """A criterion on a model with a start and a failure budget.

    ``formulations`` holds the criteria of the literature; a class of your own with these members
    is a first-class problem too.
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
    def semantics(self) -> Semantics:
        """What a failing episode costs."""
        ...

    def instance(self) -> Instance:
        """The augmented process, ready for an engine."""
        ...


def check_setting(failure_budget: float | None, discount: float | None) -> None:
    """Check budget and discount.

    Raises:
        ModelError: a budget outside [0, 1], a discount outside (0, 1), or least failure together
            with a discount.
    """
    for name, value in (("failure_budget", failure_budget), ("discount", discount)):
        if value is not None and not isinstance(value, Real):
            raise ModelError(f"{name} must be a number or None, not {value!r}")
    if failure_budget is not None and not -LEAST_BUDGET <= failure_budget <= 1.0 + LEAST_BUDGET:
        raise ModelError(f"failure_budget must be a probability or None, not {failure_budget!r}")
    if discount is not None and not 0.0 < discount < 1.0:
        raise ModelError(
            f"discount must lie strictly between 0 and 1, not {discount!r}; None means exact"
        )
    if failure_budget is None and discount is not None:
        raise ModelError(
            "failure_budget=None (least failure) is exact only: leave discount out, or give a "
            "budget for the discounted surrogate"
        )
