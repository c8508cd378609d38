"""Units of which costs are made multiples, where the sums of costs are too many to tell apart."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from ssp_lp.arrays import SAME_TOTAL
from ssp_lp.problem import Problem, compiled_constrained
from ssp_lp.processes.layered.measures_of_law import WithinBound

_FIRST = 128  # units in the totals that matter, at first
_FINER = 4.0  # times as many next
_QUICK = 3e8  # units times outcomes that a sweep soon passes over
_MOST = 8_192  # unless more are asked for
_ROOM = 6_000_000  # states times units
_FINEST = 65_536  # in any case
_ROOM_FOR_DIGITS = 1.1  # by which a number of two digits may lie above another
_WORTH_WHILE = 1.5  # times as many units: no reason to search again for fewer
_TYPICAL = 2.0  # costs given success of the safest policy: beyond them few totals matter
_RARE = 20.0  # times as dear as all that matters may a single step be


def rounding_units(
    problem: Problem, span: float, *, cheapest: float = np.inf, finest: bool = False
) -> Iterator[Fraction]:
    """Smaller and smaller units, as far as is asked for.

    Args:
        problem: with ``cost_levels`` if these are limited.
        span: the totals that matter.
        cheapest: step that is to be a unit at least, if that makes no great many.
        finest: as far as there is room, whatever is asked for.
    """
    asked: int | None = None if finest else getattr(problem, "cost_levels", None)
    room = min(max(_MOST, _ROOM // problem.model.n_states), _FINEST)
    most = asked or room
    least = _ROOM_FOR_DIGITS * span / cheapest
    is_quick = least * problem.model.n_outcomes <= _QUICK
    many = float(min(max(_FIRST, least if is_quick else 0.0), most))
    while many <= most:
        yield short_decimal(span / many)
        many = min(_FINER * many, float(most)) if _WORTH_WHILE * many <= most else _FINER * many


def short_decimal(size: float) -> Fraction:
    """The least number of two digits that is no smaller: its multiples are short decimals."""
    power = Fraction(10) ** (int(np.floor(np.log10(size))) - 1)
    return int(np.ceil(size / float(power) * (1.0 - SAME_TOTAL))) * power


def span_of_totals(problem: Problem, dearest: float | None = None) -> float:
    """The totals that matter: up to the bound, or some typical costs.

    Args:
        problem: the problem.
        dearest: the greatest cost of a single step to be remembered; None: of any step.
    """
    measure = problem.semantics.measure
    dearest = float(problem.model.costs.max(initial=0.0)) if dearest is None else dearest
    if isinstance(measure, WithinBound) and measure.bound > 0.0:
        return float(measure.bound)
    typical = _TYPICAL * compiled_constrained(problem).typical_cost
    return max(typical, dearest / _RARE) or 1.0
