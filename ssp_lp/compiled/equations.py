"""Compiled equations of substochastic chains: reduction, sweeps, sums in twice the precision.

State reduction (Grassmann, Taksar and Heyman 1985): to eliminate a state, the probability of
entering the state is moved to its successors. The probability of departing is summed over
successors and exits, never computed as 1 - p. All numbers stay non-negative and accurate relative
to their size, however rarely the chain is left (Alfa, Xue and Ye 2002). Large components are solved
by sweeps and a Krylov method.

The advantage of a pair is its cost plus the expected value of its successor, minus the value of its
state. Advantages with a bound of their rounding, or in twice the precision, have numpy twins in
``bellman``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from ssp_lp.arrays import exact_product, exact_sum
from ssp_lp.compiled.cores import compiled_loop, one_or_all_cores

Array = np.ndarray[Any, Any]


@compiled_loop
def solve_by_elimination(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    order: Array, offsets: Array, first: int, last: int, largest: int, rewards: Array, x: Array,
) -> int:  # fmt: skip
    """Solve ``x = rewards + chain @ x`` on the components ``first .. last - 1``, in this order.

    A component leads only to itself and to components before it.

    Args:
        indptr: [rows + 1].
        indices: [entries].
        data: [entries].
        exits: probability of leaving the chain, [rows].
        rows: the row of each state, [states].
        order: states, component by component, [states].
        offsets: offsets of the components in the order, [components + 1].
        first: first component to solve; all before it are solved.
        last: the component after the last one to solve.
        largest: number of states of the largest component.
        rewards: [states, rewards].
        x: written, [states, rewards].

    Returns:
        The first component that is never left; -1 if there is none.
    """
    dense, rhs = np.empty((largest, largest)), np.empty((largest, rewards.shape[1]))
    low, outflow = np.empty(largest, dtype=np.int64), np.empty(largest)
    place = np.full(rows.size if largest > 1 else 0, -1, dtype=np.int32)
    for c in range(first, last):
        begin, size = offsets[c], offsets[c + 1] - offsets[c]
        if size == 1:
            s = order[begin]
            if not _eliminate_one_state(indptr, indices, data, exits, rows[s], s, rewards, x):
                return c
            continue
        for i in range(size):
            place[order[begin + i]] = i
        gather_component(
            indptr, indices, data, exits, rows, order, begin, size, place, rewards, False, x,
            dense, low, outflow, rhs,
        )  # fmt: skip
        if not eliminate_component(dense, low, outflow, rhs, size):
            return c
        for i in range(size):
            x[order[begin + i], :] = rhs[i, :]
            place[order[begin + i]] = -1
    return -1


@compiled_loop(inline="always")
def _eliminate_one_state(
    indptr: Array, indices: Array, data: Array, exits: Array, row: int, s: int,
    rewards: Array, x: Array,
) -> bool:  # fmt: skip
    """Solve the equation of a component of one state; return False if the state is never left."""
    escape = exits[row]
    for j in range(x.shape[1]):
        x[s, j] = rewards[s, j]
    for k in range(indptr[row], indptr[row + np.uint32(1)]):
        successor, p = indices[k], data[k]
        if successor != s and p > 0.0:
            escape += p
            for j in range(x.shape[1]):
                x[s, j] += p * x[successor, j]
    if escape <= 0.0:
        return False
    for j in range(x.shape[1]):
        x[s, j] /= escape
    return True


@compiled_loop
def gather_component(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    order: Array, begin: int, size: int, position: Array, rewards: Array, by_row: bool, x: Array,
    dense: Array, low: Array, outflow: Array, rhs: Array,
) -> None:  # fmt: skip
    """Write a component's equations: a dense matrix, exit probabilities, and right sides.

    Args:
        indptr: [rows + 1].
        indices: [entries].
        data: [entries].
        exits: [rows].
        rows: the row of each state, [states].
        order: states, component by component, [states].
        begin: position of the component's first state in the order.
        size: number of its states.
        position: position of each of its states in the component, -1 elsewhere, [states].
        rewards: rewards of rows or of states.
        by_row: True: ``rewards`` has a row for each row of the chain; False: for each state.
        x: totals, known for the successors outside the component, [states, rewards].
        dense: written: the matrix, [size, size].
        low: written: for each i the least j <= i such that entry (i, j) or (j, i) can differ from 0
            after all later states are eliminated, [size].
        outflow: written: probability of leaving the component, [size].
        rhs: written: rewards plus expected totals outside, [size, rewards].
    """
    for i in range(size):
        low[i] = i
    for i in range(size):
        s = rows[order[begin + i]]
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            other = np.int64(position[indices[k]])
            if other >= i:
                low[other] = min(low[other], i)
            elif other >= 0:
                low[i] = min(low[i], other)
    for i in range(size - 1, 1, -1):
        if low[i] < i - 1:
            low[i - 1] = min(low[i - 1], low[i])
    for i in range(size):
        for j in range(low[i], i + 1):
            dense[i, j] = dense[j, i] = 0.0
    for i in range(size):
        s = rows[order[begin + i]]
        outflow[i] = exits[s]
        owner = s if by_row else order[begin + i]
        for j in range(rhs.shape[1]):
            rhs[i, j] = rewards[owner, j]
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            successor, p = indices[k], data[k]
            if position[successor] >= 0:
                dense[i, position[successor]] += p
            elif p > 0.0:
                outflow[i] += p
                for j in range(rhs.shape[1]):
                    rhs[i, j] += p * x[successor, j]


@compiled_loop
def eliminate_component(dense: Array, low: Array, outflow: Array, rhs: Array, size: int) -> bool:
    """Solve a component's dense equations in place; return False if the component is never left.

    The arguments are those that ``gather_component`` has written.
    """
    flat, width = dense.reshape(-1), dense.shape[1]
    if not eliminate_states(flat, width, 0, low, outflow, size):
        return False
    solve_eliminated(flat, width, 0, low, rhs, size)
    return True


@compiled_loop
def eliminate_states(
    dense: Array, width: int, shift: int, low: Array, outflow: Array, size: int
) -> bool:
    """Eliminate the states of a chain, last first, in place.

    Args:
        dense: ``dense[i * width + shift + j]`` is the probability of going from i to j. On return
            it is, for j < i, the reduced probability divided by the probability of departing; for
            j = i the probability of departing; for j > i the reduced probability with which i
            leads to j when j is eliminated.
        width: length of a row: the number of states, or twice the bandwidth.
        shift: position of the first row.
        low: for each state the first one that it leads to or is reached from, after all later
            states are eliminated, [states].
        outflow: probability of leaving from each state, [states]; overwritten.
        size: number of states.

    Returns:
        False if the chain is never left.
    """
    for i in range(size - 1, -1, -1):
        row, first, escape = i * width + shift, low[i], outflow[i]
        for j in range(first, i):
            escape += dense[row + j]
        if escape <= 0.0:
            return False
        for j in range(first, i):
            dense[row + j] /= escape
        dense[row + i] = escape
        outflow[i] /= escape
        for r in range(first, i):
            other = r * width + shift
            weight = dense[other + i]
            if weight > 0.0:
                for j in range(first, i):
                    dense[other + j] += weight * dense[row + j]
                outflow[r] += weight * outflow[i]
    return True


@compiled_loop
def solve_eliminated(
    dense: Array, width: int, shift: int, low: Array, rhs: Array, size: int
) -> None:
    """Solve for right sides, in place, after ``eliminate_states``.

    Args:
        dense: from ``eliminate_states``, as are ``width``, ``shift`` and ``low``.
        rhs: right sides, overwritten by the solution, [states, rewards].
        size: number of states.
    """
    for i in range(size - 1, -1, -1):
        for k in range(rhs.shape[1]):
            rhs[i, k] /= dense[i * width + shift + i]
        for r in range(low[i], i):
            weight = dense[r * width + shift + i]
            if weight > 0.0:
                for k in range(rhs.shape[1]):
                    rhs[r, k] += weight * rhs[i, k]
    for i in range(1, size):
        for j in range(low[i], i):
            weight = dense[i * width + shift + j]
            if weight > 0.0:
                for k in range(rhs.shape[1]):
                    rhs[i, k] += weight * rhs[j, k]


@one_or_all_cores
def gather_inside(
    indptr: Array, indices: Array, data: Array, exits: Array, states: Array, position: Array,
    own_indptr: Array, own_indices: Array, own_data: Array, escape: Array, outflow: Array,
) -> None:  # fmt: skip
    """Write a component's equations for sweeps, each divided by its state's ``escape``.

    Args:
        indptr: offsets of the chain's rows, [states + 1].
        indices: [entries].
        data: [entries].
        exits: probability of leaving the chain, [states].
        states: the members, in the order in which they are swept, [members].
        position: position of each state among the members, -1 for other states, [states].
        own_indptr: offsets of the members' rows, [members + 1].
        own_indices: written: positions of successors among the members; the member's own position
            in unused entries, [own entries].
        own_data: written: probabilities divided by ``escape``; 0 in unused entries, [own entries].
        escape: written: the probability of leaving the state, [members].
        outflow: written: the probability of leaving the component, [members].
    """
    for i in prange(states.size):
        s, at = states[i], np.int64(own_indptr[i])
        leaves, stays = exits[s], 0.0
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            j, p = indices[k], data[k]
            if j == s or p <= 0.0:
                continue
            if position[j] < 0:
                leaves += p
                continue
            stays += p
            own_indices[at], own_data[at] = position[j], p
            at += 1
        escape[i], outflow[i] = leaves + stays, leaves
        for k in range(np.int64(own_indptr[i]), at):
            own_data[k] /= escape[i]
        for k in range(at, np.int64(own_indptr[i + 1])):
            own_indices[k], own_data[k] = position[s], 0.0


@one_or_all_cores
def gather_outside(
    indptr: Array, indices: Array, data: Array, states: Array, position: Array, escape: Array,
    rewards: Array, x: Array, rhs: Array,
) -> None:  # fmt: skip
    """Write a component's right sides: rewards plus expected totals of successors outside.

    Each is divided by ``escape``, the probability of leaving its state. The arguments are those of
    ``gather_inside``, and:

    Args:
        rewards: [states, rewards].
        x: totals, [states, rewards].
        rhs: written, [members, rewards].
    """
    for i in prange(states.size):
        s = states[i]
        for j in range(rewards.shape[1]):
            rhs[i, j] = rewards[s, j]
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            if position[indices[k]] < 0:
                for j in range(rewards.shape[1]):
                    rhs[i, j] += data[k] * x[indices[k], j]
        for j in range(rewards.shape[1]):
            rhs[i, j] /= escape[i]


@compiled_loop
def sweep(indptr: Array, indices: Array, data: Array, rhs: Array, x: Array) -> tuple[float, float]:
    """Sweep over equations by Gauss-Seidel: set each x in turn to ``rhs + rows @ x``.

    It runs on one core, so that the result does not depend on timing; two cores would save less
    time than the immediate use of new values.

    Returns:
        The greatest change and the greatest absolute value.
    """
    change, size = 0.0, 0.0
    if x.shape[1] == 2:  # both columns in one pass, so that each entry of the matrix is read once
        for s in range(rhs.shape[0]):
            first, second = rhs[s, 0], rhs[s, 1]
            for k in range(indptr[s], indptr[np.uint32(s + 1)]):
                weight, column = data[k], indices[k]
                first += weight * x[column, 0]
                second += weight * x[column, 1]
            change = max(change, max(abs(first - x[s, 0]), abs(second - x[s, 1])))
            size = max(size, max(abs(first), abs(second)))
            x[s, 0], x[s, 1] = first, second
        return change, size
    for s in range(rhs.shape[0]):
        for j in range(x.shape[1]):
            total = rhs[s, j]
            for k in range(indptr[s], indptr[np.uint32(s + 1)]):
                total += data[k] * x[indices[k], j]
            change = max(change, abs(total - x[s, j]))
            size = max(size, abs(total))
            x[s, j] = total
    return change, size


@compiled_loop
def _residual_of_sweep(indptr: Array, indices: Array, data: Array, x: Array, miss: Array) -> None:
    """Write the residual ``x - G x`` to ``miss``; G is a Gauss-Seidel sweep without rewards."""
    miss[:] = x
    for s in range(x.size):
        total = 0.0
        for k in range(indptr[s], indptr[np.uint32(s + 1)]):
            total += data[k] * miss[indices[k]]
        miss[s] = total
    for s in range(x.size):
        miss[s] = x[s] - miss[s]


def start_bicgstab(residual: Array) -> tuple[Array, Array, Array, Array]:
    """Return the initial state of ``bicgstab``: shadow, p and v, [members] each, and rho, [1]."""
    rho = np.zeros(1)
    _square_in_sweep(residual, rho)
    return residual.copy(), residual.copy(), np.zeros_like(residual), rho


@compiled_loop
def _square_in_sweep(residual: Array, rho: Array) -> None:
    """Add the squared norm of a residual to ``rho``, [1]; the sum has the order of the states."""
    for s in range(residual.size):
        rho[0] += residual[s] * residual[s]


@compiled_loop
def bicgstab(
    indptr: Array, indices: Array, data: Array,
    residual: Array, target: float, most_steps: int, x: Array,
    shadow: Array, p: Array, v: Array, scalar: Array,
) -> tuple[int, bool]:  # fmt: skip
    """Run BiCGStab: add to ``x`` until ``residual`` is at most ``target``.

    BiCGStab of van der Vorst (1992) solves ``x - G x = g``, where G is one Gauss-Seidel sweep. The
    sweep is the preconditioner, and takes no longer than a product with the matrix. ``residual`` is
    ``g - (x - G x)``. The arrays ``shadow``, ``p``, ``v`` and ``scalar`` are updated, so that a
    later call can go on.

    Returns:
        The number of sweeps; and True if the target is reached or no progress is possible, False
        after ``most_steps``.
    """
    n = residual.size
    t, rho = np.empty(n), scalar[0]
    for step in range(most_steps):
        _residual_of_sweep(indptr, indices, data, p, v)
        along = 0.0
        for s in range(n):
            along += shadow[s] * v[s]
        if along == 0.0 or not np.isfinite(along):
            return 2 * step + 1, True
        alpha = rho / along
        for s in range(n):
            residual[s] -= alpha * v[s]
        _residual_of_sweep(indptr, indices, data, residual, t)
        cross, square = 0.0, 0.0
        for s in range(n):
            cross += t[s] * residual[s]
            square += t[s] * t[s]
        omega = cross / square if square > 0.0 else 0.0
        following, size = 0.0, 0.0
        for s in range(n):
            x[s] += alpha * p[s] + omega * residual[s]
            residual[s] -= omega * t[s]
            following += shadow[s] * residual[s]
            size = max(size, abs(residual[s]))
        if size <= target or omega == 0.0 or following == 0.0 or not np.isfinite(following):
            return 2 * step + 2, True
        beta = following / rho * (alpha / omega)
        rho = scalar[0] = following
        for s in range(n):
            p[s] = residual[s] + beta * (p[s] - omega * v[s])
    return 2 * most_steps, False


@compiled_loop
def work_of_levels(indptr: Array, indices: Array) -> tuple[int, float]:
    """Estimate the work of a direct solution of a component, by distances from its first state.

    A level is the set of states at one distance. Nested dissection (George 1973) cuts a piece of m
    states at one level, here at most as large as the greatest level of the first m states. A level
    becomes a dense block, and the multiplications of these blocks are summed over pieces of all
    sizes.

    Returns:
        The greatest number of states at one distance, and the number of multiplications.
    """
    n = indptr.size - 1
    seen, queue = np.zeros(n, dtype=np.bool_), np.empty(n, dtype=np.uint32)
    seen[0], queue[0] = True, 0
    begin, filled, widest, work = 0, 1, 1, 0.0
    while begin < filled:
        end = filled
        for head in range(begin, end):
            s = queue[head]
            for k in range(indptr[s], indptr[s + np.uint32(1)]):
                if not seen[indices[k]]:
                    seen[indices[k]] = True
                    queue[filled] = indices[k]
                    filled += 1
        widest, begin = max(widest, filled - end), end
        work += float(widest) ** 3 * n * (1.0 / end - 1.0 / filled)
    return widest, work


_LOWERINGS = 8  # most reductions of a value by its excess over a backup; two usually suffice
_exact_sum = compiled_loop(exact_sum, inline="always")
_exact_product = compiled_loop(exact_product, inline="always")


@compiled_loop(inline="always")
def precise_advantage(
    row: int, s: int, indptr: Array, indices: Array, data: Array, exits: Array, cost: float,
    high: Array, low: Array, epsilon: float,
) -> tuple[float, float]:  # fmt: skip
    """Compute a pair's advantage at values ``high + low`` in twice the working precision.

    Args:
        row: the pair's row.
        s: its state.
        indptr: [rows + 1].
        indices: [entries].
        data: [entries].
        exits: [rows].
        cost: the pair's cost.
        high: [states].
        low: [states].
        epsilon: the machine epsilon.

    Returns:
        The advantage, and a bound of its rounding error.
    """
    total, rest, small, whole = cost, 0.0, 0.0, 0.0
    if exits[row] != 0.0:
        term, lost = _exact_product(-exits[row], high[s])
        total, slip = _exact_sum(total, term)
        bit = exits[row] * low[s]
        rest += slip + lost - bit
        small += abs(slip) + abs(lost) + abs(bit)
        whole += abs(term)
    for k in range(indptr[row], indptr[row + np.uint32(1)]):
        j, p = indices[k], data[k]
        step, missed = _exact_sum(high[j], -high[s])
        missed += low[j] - low[s]
        term, lost = _exact_product(p, step)
        total, slip = _exact_sum(total, term)
        bit = p * missed
        rest += slip + lost + bit
        small += abs(slip) + abs(lost) + abs(bit)
        whole += abs(term)
    total += rest
    terms = float(indptr[row + np.uint32(1)] - indptr[row]) + 4.0
    return total, epsilon * (abs(total) + terms * (small + epsilon * whole))


@compiled_loop(inline="always")
def safe_advantage(
    row: int, s: int, indptr: Array, indices: Array, data: Array, exits: Array, cost: float,
    values: Array, epsilon: float,
) -> float:  # fmt: skip
    """Return a lower bound of a pair's advantage: the sum less a bound of its rounding.

    Args:
        row: the pair's row.
        s: its state.
        indptr: [rows + 1].
        indices: [entries].
        data: [entries].
        exits: [rows].
        cost: the pair's cost.
        values: [states].
        epsilon: the machine epsilon.
    """
    here, leaves = values[s], exits[row]
    total, rounded = cost, 0.0
    if leaves != 0.0:
        term = leaves * here
        total -= term
        rounded += abs(total)
        if leaves != 1.0:
            rounded += abs(term)
    for k in range(indptr[row], indptr[row + np.uint32(1)]):
        term = data[k] * (values[indices[k]] - here)
        if term != 0.0:
            total += term
            rounded += abs(total) + 2.0 * abs(term)
    return total - epsilon * rounded


@one_or_all_cores
def advantages_precisely(
    owner: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    high: Array, low: Array, epsilon: float, result: Array, rounding: Array,
) -> None:  # fmt: skip
    """Compute all pairs' advantages in twice the working precision.

    ``result`` and the bounds of its rounding errors, ``rounding``, are written, [pairs] each.
    """
    for row in prange(owner.size):
        result[row], rounding[row] = precise_advantage(
            row, owner[row], indptr, indices, data, exits, cost[row], high, low, epsilon
        )


@one_or_all_cores
def advantages_safely(
    owner: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    values: Array, epsilon: float, result: Array,
) -> None:  # fmt: skip
    """Write lower bounds of all pairs' advantages, in working precision, to ``result``, [pairs]."""
    for row in prange(owner.size):
        result[row] = safe_advantage(
            row, owner[row], indptr, indices, data, exits, cost[row], values, epsilon
        )


@one_or_all_cores
def shortfalls_safely(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    values: Array, epsilon: float, result: Array,
) -> None:  # fmt: skip
    """Compute upper bounds of the excess of each state's value over its backup.

    They are written to ``result``, [states]. They are at least 0, and infinite where an advantage
    is nan.
    """
    for s in prange(result.size):
        worst = 0.0
        for row in range(offsets[s], offsets[s + np.uint32(1)]):
            ahead = safe_advantage(row, s, indptr, indices, data, exits, cost[row], values, epsilon)
            worst = max(worst, -ahead) if ahead == ahead else np.inf
        result[s] = worst


@compiled_loop
def lower_in_order(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array, order: Array,
    cost: Array, epsilon: float, values: Array,
) -> None:  # fmt: skip
    """Reduce the values of a process without cycles until none exceeds its backup.

    Args:
        offsets: offsets of the states' pairs, [states + 1].
        indptr: offsets of the pairs' entries, [pairs + 1].
        indices: successors, [entries].
        data: their probabilities, [entries].
        exits: probability that the pair ends the run, [pairs].
        order: states, each after the states that it leads to, [states].
        cost: [pairs].
        epsilon: the machine epsilon.
        values: values to reduce, updated, [states].
    """
    for s in order:
        for row in range(offsets[s], offsets[s + np.uint32(1)]):
            escape = exits[row]
            for k in range(indptr[row], indptr[row + np.uint32(1)]):
                escape += data[k] if indices[k] != s else 0.0
            for _ in range(_LOWERINGS):
                lack = -safe_advantage(
                    row, s, indptr, indices, data, exits, cost[row], values, epsilon
                )
                if not (lack > 0.0 and escape > 0.0):
                    break
                values[s] -= max(lack / escape, epsilon * abs(values[s]))


@compiled_loop
def evaluate_precisely(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    order: Array, offsets: Array, largest: int, rewards: Array, accuracy: float, worst: float,
    corrections: int, epsilon: float, x: Array, low: Array, runs: Array, residuals: Array,
) -> bool:  # fmt: skip
    """Solve a policy's equations in twice the working precision; the solution is ``x + low``.

    The expected numbers of steps, t, are computed as well, and it is checked that 2 t is an upper
    bound of the exact numbers.

    Args:
        indptr: [rows + 1].
        indices: [entries].
        data: [entries].
        exits: [rows].
        rows: the row of each state, [states].
        order: states, component by component, each component after those that it leads to,
            [states].
        offsets: offsets of the components in the order, [components + 1].
        largest: number of states of the largest component.
        rewards: [rows, rewards].
        accuracy: error to reach, relative to the greatest total.
        worst: error that is accepted if corrections do not reach ``accuracy``.
        corrections: most corrections.
        epsilon: the machine epsilon.
        x: written, [states, rewards].
        low: written, [states, rewards].
        runs: written: t, [states].
        residuals: written: greatest residual of the equations, [rewards].

    Returns:
        Whether the check has succeeded and the errors are small enough; False if some state is
        never left.
    """
    n, k = x.shape
    rhs, solved = np.ones((n, k + 1)), np.empty((n, k + 1))
    for s in range(n):
        rhs[s, :k] = rewards[rows[s], :]
    chain = indptr, indices, data, exits, rows
    if solve_by_elimination(*chain, order, offsets, 0, offsets.size - 1, largest, rhs, solved) >= 0:
        return False
    longest = 0.0
    for s in range(n):
        x[s, :], low[s, :], runs[s] = solved[s, :k], 0.0, -solved[s, k]
        longest = max(longest, solved[s, k])
    for s in range(n):
        row = rows[s]
        if not safe_advantage(row, s, indptr, indices, data, exits, -0.5, runs, epsilon) >= 0.0:
            return False
    runs *= -1.0
    before = np.full(k, np.inf)
    rhs, solved = np.empty((n, k)), np.empty((n, k))
    is_verified = False
    for _ in range(corrections):
        _precise_residuals(*chain, rewards, x, low, epsilon, rhs, residuals)
        is_verified, enough, better = True, True, False
        for j in range(k):
            scale = 0.0
            for s in range(n):
                scale = max(scale, abs(x[s, j]))
            enough &= 2.0 * longest * residuals[j] <= accuracy * scale
            is_verified &= 2.0 * longest * residuals[j] <= worst * scale
            better |= residuals[j] < 0.5 * before[j]
        if enough or not better:
            break
        before[:] = residuals
        solve_by_elimination(*chain, order, offsets, 0, offsets.size - 1, largest, rhs, solved)
        for s in range(n):
            for j in range(k):
                x[s, j], low[s, j] = _exact_sum(x[s, j], low[s, j] + solved[s, j])
    return is_verified


@compiled_loop
def _precise_residuals(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    rewards: Array, x: Array, low: Array, epsilon: float, off: Array, residuals: Array,
) -> None:  # fmt: skip
    """Compute residuals of totals ``x + low`` in twice the working precision.

    The residuals are written to ``off``, [states, rewards], and a bound of their greatest absolute
    value to ``residuals``, [rewards].
    """
    for j in range(x.shape[1]):
        residuals[j] = 0.0
        for s in range(x.shape[0]):
            row = rows[s]
            off[s, j], rounding = precise_advantage(
                row, s, indptr, indices, data, exits, rewards[row, j], x[:, j], low[:, j], epsilon
            )
            wrong = abs(off[s, j]) + rounding
            residuals[j] = max(residuals[j], wrong) if wrong == wrong else np.inf
