"""One call of HiGHS with sharp tolerances."""

from typing import Any

import numpy as np
from scipy.optimize import linprog

SHARP = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
"""HiGHS's own 1e-7 moves an optimum by as much; the programs here are small and well scaled."""


def least(objective: np.ndarray, **rows: Any) -> float:
    """The optimal value of min <objective, x> over x >= 0 and the given rows of `linprog`.

    The simplex method can stop short of a sharp tolerance; the interior point method with
    crossover is then asked instead.
    """
    for method in ("highs-ds", "highs-ipm"):
        answer = linprog(objective, method=method, options=SHARP, **rows)
        if answer.status == 0:
            return float(answer.fun)
    raise ArithmeticError(answer.message)
