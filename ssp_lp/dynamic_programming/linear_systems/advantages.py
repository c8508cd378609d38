"""Advantages of pairs as differences: what is lost by cancellation never enters.

The advantage of pair u in state s at values v is ``c_u + P_u v - v_s``, written as ``c_u + sum_j
p_uj (v_j - v_s) - exit_u v_s``: where a process is hardly left all v_j are near v_s, and what
counts is small beside them. Values of twice the working precision are sums ``high + low``; sums and
products are then exact to twice the precision (Dekker 1971; Ogita, Rump and Oishi 2005).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.dynamic_programming.bellman import unsigned_parts

_SPLIT = 134217729.0  # 2**27 + 1 (Veltkamp)


def exact_sum(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """For precise advantages: ``a + b`` rounded, and what the rounding lost (Knuth)."""
    total = a + b
    back = total - a
    return total, (a - (total - back)) + (b - back)


def exact_product(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """For precise advantages: ``a * b`` rounded, and what the rounding lost (Dekker)."""
    total = a * b
    c, d = _SPLIT * a, _SPLIT * b
    a_high, b_high = c - (c - a), d - (d - b)
    a_low, b_low = a - a_high, b - b_high
    lost = a_low * b_low - (((total - a_high * b_high) - a_low * b_high) - a_high * b_low)
    return total, lost


def precise_advantages(
    home: IntArray,
    transitions: sp.csr_array,
    exits: FloatArray,
    cost: FloatArray,
    high: FloatArray,
    low: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Advantages of pairs at values ``high + low``, and bounds of their rounding.

    Args:
        home: state of each pair, [pairs].
        transitions: [pairs, states].
        exits: [pairs].
        cost: [pairs].
        high: [states].
        low: [states].

    Returns:
        Advantages and bounds of what each may be wrong by, [pairs] each.
    """
    if accelerated(len(transitions.indices)):
        from ssp_lp.compiled.precision import advantages_precisely

        result, rounding = np.empty(len(cost)), np.empty(len(cost))
        parts = unsigned_parts(home, transitions)
        run = advantages_precisely(len(transitions.indices))
        run(*parts, exits, cost, high, low, MACHINE_EPSILON, result, rounding)
        return result, rounding
    here, here_low = high[home], low[home]
    term, lost = exact_product(-exits, here)
    total, slip = exact_sum(cost, term)
    bit = exits * here_low
    rest, small, whole = slip + lost - bit, np.abs(slip) + np.abs(lost) + np.abs(bit), np.abs(term)
    begin, lengths = transitions.indptr[:-1], np.diff(transitions.indptr)
    for k in range(int(lengths.max(initial=0))):
        rows = np.flatnonzero(lengths > k)
        entry = begin[rows] + k
        column, p = transitions.indices[entry], transitions.data[entry]
        step, missed = exact_sum(high[column], -here[rows])
        missed = missed + (low[column] - here_low[rows])
        term, lost = exact_product(p, step)
        total[rows], slip = exact_sum(total[rows], term)
        bit = p * missed
        rest[rows] += slip + lost + bit
        small[rows] += np.abs(slip) + np.abs(lost) + np.abs(bit)
        whole[rows] += np.abs(term)
    result = total + rest
    terms = lengths + 4.0
    rounding = np.abs(result) + terms * (small + MACHINE_EPSILON * whole)
    return result, MACHINE_EPSILON * rounding


def safe_advantages(
    home: IntArray,
    transitions: sp.csr_array,
    exits: FloatArray,
    cost: FloatArray,
    values: FloatArray,
) -> FloatArray:
    """Advantages in working precision, less bounds of their rounding: never too high, [pairs].

    Args:
        home: state of each pair, [pairs].
        transitions: [pairs, states].
        exits: [pairs].
        cost: [pairs].
        values: [states].
    """
    if accelerated(len(transitions.indices)):
        from ssp_lp.compiled.precision import advantages_safely

        result = np.empty(len(cost))
        parts = unsigned_parts(home, transitions)
        run = advantages_safely(len(transitions.indices))
        run(*parts, exits, cost, values, MACHINE_EPSILON, result)
        return result
    here = values[home]
    term = exits * here
    total = cost - term
    rounded = np.where(exits == 0.0, 0.0, np.abs(total) + np.where(exits == 1.0, 0.0, np.abs(term)))
    begin, lengths = transitions.indptr[:-1], np.diff(transitions.indptr)
    for k in range(int(lengths.max(initial=0))):
        rows = np.flatnonzero(lengths > k)
        entry = begin[rows] + k
        term = transitions.data[entry] * (values[transitions.indices[entry]] - here[rows])
        total[rows] += term
        rounded[rows] += np.where(term == 0.0, 0.0, np.abs(total[rows]) + 2.0 * np.abs(term))
    return np.asarray(total - MACHINE_EPSILON * rounded)


def advantage_bounds(
    home: IntArray,
    transitions: sp.csr_array,
    exits: FloatArray,
    cost: FloatArray,
    values: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Bounds of advantages from below and from above, in working precision, [pairs] each.

    Args:
        home: state of each pair, [pairs].
        transitions: [pairs, states].
        exits: [pairs].
        cost: [pairs].
        values: [states].
    """
    if accelerated(len(transitions.indices)):
        arguments = home, transitions, exits
        return (
            safe_advantages(*arguments, cost, values),
            -safe_advantages(*arguments, -cost, -values),
        )
    here, lengths = values[home], np.diff(transitions.indptr)
    terms = transitions.data * (values[transitions.indices] - np.repeat(here, lengths))
    shape, ones = transitions.shape, np.ones(transitions.shape[1])
    total, whole = (
        sp.csr_array((part, transitions.indices, transitions.indptr), shape=shape) @ ones
        for part in (terms, np.abs(terms))
    )
    leaving = exits * here
    result = total + (cost - leaving)
    rounding = MACHINE_EPSILON * (
        (lengths + 2.0) * whole + np.abs(cost) + 2.0 * np.abs(leaving) + np.abs(result)
    )
    return result - rounding, result + rounding
