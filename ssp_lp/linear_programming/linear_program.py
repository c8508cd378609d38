"""A linear program with named rows, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class LinearProgram:
    """``minimise cost @ x`` with ``lower <= matrix @ x <= upper`` and ``x >= 0``, rows named."""

    cost: FloatArray  # [columns]
    matrix: sp.csc_array  # [rows, columns]
    lower: FloatArray  # [rows]
    upper: FloatArray  # [rows]
    rows: Mapping[str, slice]  # "balance", the limited rows and, in case S, "normaliser"

    @property
    def equality(self) -> BoolArray:
        """Rows whose two sides are equal, [rows]."""
        return np.asarray(self.lower == self.upper)
