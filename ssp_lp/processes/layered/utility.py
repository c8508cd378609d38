"""Utilities of the total cost, as a user gives them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError

Utility = Callable[[FloatArray], FloatArray]
"""A non-increasing function of the total cost, on arrays."""


def utilities(utility: Utility, costs: FloatArray) -> FloatArray:
    """The utility of each cost, like ``costs``.

    Raises:
        ModelError: the function does not take an array, or does not return as many finite numbers.
    """
    try:
        worth = np.asarray(utility(costs), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"utility must take an array of costs: {error}") from error
    if worth.shape != costs.shape or not np.isfinite(worth).all():
        raise ModelError("utility must map an array of costs to as many finite numbers")
    return worth
