"""A basis of the linear program from the policies that column generation found.

A deterministic policy is a basis of the occupation-measure program: the columns of its pairs, one
per state, make the matrix (I - P_pi)^T, which is regular because the policy leaves the process
(and triangular, but for the order, where layers only lead on). The failure row needs one more
basic variable: its slack where one policy suffices; otherwise a pair of a second policy that
differs from the first in a single state and breaks the budget, which the first keeps. Case S adds
the scale t for the normaliser.

Such a basis is optimal if column generation was right. So a simplex method started at it does not
solve the program anew: it checks, by its own factorisation of the whole program and its own primal
and dual feasibility, that the answer is optimal, and moves on if it is not. The number of its
iterations says which of the two happened.
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.column_generation.compiled_problems.compiled_problem import CompiledProblem
from ssp_lp.column_generation.failure_row import FailureRow
from ssp_lp.column_generation.generation import Generated, generate
from ssp_lp.column_generation.initial_columns import columns_at, columns_by_pricing
from ssp_lp.column_generation.pricing.pricing_problem import Column
from ssp_lp.linear_programming.linear_program import PolicyBasis
from ssp_lp.options import SolveOptions
from ssp_lp.processes.explicit import ExplicitProcess

_TOLERANCE = 1e-12
"""Relative gap of the search: tight, so that its price is the program's dual up to rounding."""

_TIE = 1e-10
"""Excess, relative to the greatest value, up to which a pair counts as one of the best."""

_NEARBY = (1.0 - 1e-6, 1.0 + 1e-6)
"""Relative prices at which a policy on the other side of the budget is sought."""


def policy_basis(
    compiled: CompiledProblem, process: ExplicitProcess, row: FailureRow, deadline: float
) -> PolicyBasis:
    """Search for the optimal policies and make a basis of them.

    A policy's pairs that are not best at the price found, in states that it does not or hardly
    ever reach, make way for pairs that are.

    Args:
        compiled: brings the pricing.
        process: the problem's, written out.
        row: failure budget, above the least failure, and the form of the objective.
        deadline: on the clock of ``time.perf_counter``; the basis of a search that was cut short
            is a poorer start.

    Raises:
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    found, pricing = _searched_for_basis(compiled, row, deadline), compiled.pricing()
    best = pricing.minimise(found.price, found.columns[0])
    columns = [column for column in (*found.columns, best) if column.choice is not None]
    is_priced = found.price > (found.objective if row.ratio else 0.0)
    if is_priced and not all(_parted_for_basis(columns, row.budget)):  # but for rounding a policy's
        columns += [pricing.minimise(found.price * factor, best) for factor in _NEARBY]
    elsewhere = compiled.explicit_choice(best)
    is_best = _basis_pairs(process, found.price, elsewhere)
    inside, outside = (
        [
            mixed_choice(elsewhere, choice, np.flatnonzero(is_best[choice]))
            for choice in map(compiled.explicit_choice, side)
        ]
        for side in _parted_for_basis(columns, row.budget)
    )
    if inside and outside and not np.array_equal(inside[0], outside[0]):
        return _basis_between(process, row.budget, inside[0], outside[0])
    return PolicyBasis((inside + outside)[0], slack=True)


def _parted_for_basis(columns: list[Column], budget: float) -> tuple[list[Column], list[Column]]:
    """The columns that keep to the budget, and those that do not."""
    inside = [column for column in columns if column.failure <= budget]
    return inside, [column for column in columns if column.failure > budget]


def _searched_for_basis(compiled: CompiledProblem, row: FailureRow, deadline: float) -> Generated:
    """Column generation on the compiled problem as it stands."""
    options = SolveOptions(_TOLERANCE, deadline)
    rule = columns_by_pricing(compiled, row, None, options)
    if rule is None:
        rule = columns_at(compiled.pricing(), compiled.least_failure(), row)
    return generate(rule, options)


def _basis_pairs(process: ExplicitProcess, price: float, choice: IntArray) -> BoolArray:
    """Pairs that are as good as those of the best policy at a price of failure, [pairs]."""
    priced = process.cost + price * process.failure
    values = process.dynamics.chain(choice.astype(np.int32)).solve(priced[choice])
    excess = priced + process.transitions @ values - values[process.pair_state]
    return np.asarray(excess <= _TIE * float(np.abs(values).max(initial=0.0)))


def _basis_between(
    process: ExplicitProcess, budget: float, inside: IntArray, outside: IntArray
) -> PolicyBasis:
    """The basis of two policies on either side of the budget that differ in one state only.

    On the way from one policy to the other, a state at a time, failure passes the budget; where
    is found by bisection. If both are optimal at one price, so is every policy on the way.

    Args:
        process: the process.
        budget: failure budget.
        inside: pairs of a policy that keeps to it, [states].
        outside: pairs of a policy that does not, [states].
    """
    differing = np.flatnonzero(inside != outside)
    kept, broken = 0, differing.size  # states changed so far
    while broken - kept > 1:
        middle = (kept + broken) // 2
        choice = mixed_choice(inside, outside, differing[:middle]).astype(np.int32)
        failing = process.dynamics.chain(choice).solve(process.failure[choice])
        if float(process.start @ failing) <= budget:
            kept = middle
        else:
            broken = middle
    first = mixed_choice(inside, outside, differing[:kept])
    return PolicyBasis(np.append(first, outside[differing[kept]]), slack=False)


def mixed_choice(first: IntArray, second: IntArray, states: IntArray) -> IntArray:
    """The first choice of pairs, in some states the second, [states]."""
    mixed = first.copy()
    mixed[states] = second[states]
    return mixed
