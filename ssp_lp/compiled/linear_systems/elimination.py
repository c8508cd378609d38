"""Compiled state reduction: equations of substochastic chains, solved without subtractions.

Grassmann, Taksar and Heyman (1985): a state is taken out by sending what would enter it to where it
goes next. The probability of departing is summed from where it goes, the exits among them, never
formed as 1 - p; all numbers stay non-negative and keep their relative accuracy, however seldom the
chain leaves (Alfa, Xue and Ye 2002).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]

_ROUNDS = 1_000
"""Rounds in one component that only rounding could need; what it costs shows in the bound."""


@njit(cache=True)
def solve_components(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    order: Array, offsets: Array, first: int, last: int, most: int, rewards: Array, x: Array,
) -> int:  # fmt: skip
    """Solve ``x = rewards + chain @ x`` on components ``first .. last - 1``, ends first.

    Args:
        indptr: [rows + 1].
        indices: [entries].
        data: [entries].
        exits: probability of leaving the chain, [rows].
        rows: the row of each state, [states].
        order: states, component by component, [states].
        offsets: of the components in the order, [components + 1].
        first: component to begin with; all before it are solved.
        last: where to end.
        most: states of the largest component.
        rewards: [states, rewards].
        x: written, [states, rewards].

    Returns:
        The first component that is never left; -1 if there is none.
    """
    inner, right = np.empty((most, most)), np.empty((most, rewards.shape[1]))
    low, leaving = np.empty(most, dtype=np.int64), np.empty(most)
    place = np.full(rows.size if most > 1 else 0, -1, dtype=np.int32)
    for c in range(first, last):
        begin, size = offsets[c], offsets[c + 1] - offsets[c]
        if size == 1:
            s = order[begin]
            if not _substitute(indptr, indices, data, exits, rows[s], s, rewards, x):
                return c
            continue
        for i in range(size):
            place[order[begin + i]] = i
        _gather(
            indptr, indices, data, exits, rows, order, begin, size, place, rewards, False, x,
            inner, low, leaving, right,
        )  # fmt: skip
        if not _eliminate(inner, low, leaving, right, size):
            return c
        for i in range(size):
            x[order[begin + i], :] = right[i, :]
            place[order[begin + i]] = -1
    return -1


@njit(cache=True, inline="always")
def _substitute(
    indptr: Array, indices: Array, data: Array, exits: Array, row: int, s: int,
    rewards: Array, x: Array,
) -> bool:  # fmt: skip
    """Solve a component of one state; false if it is never left."""
    departs = exits[row]
    for j in range(x.shape[1]):
        x[s, j] = rewards[s, j]
    for k in range(indptr[row], indptr[row + np.uint32(1)]):
        successor, p = indices[k], data[k]
        if successor != s and p > 0.0:
            departs += p
            for j in range(x.shape[1]):
                x[s, j] += p * x[successor, j]
    if departs <= 0.0:
        return False
    for j in range(x.shape[1]):
        x[s, j] /= departs
    return True


@njit(cache=True)
def _gather(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    order: Array, begin: int, size: int, place: Array, rewards: Array, by_row: bool, x: Array,
    inner: Array, low: Array, leaving: Array, right: Array,
) -> None:  # fmt: skip
    """One component as a matrix, what leaves it, and its rewards with what lies beyond.

    ``low[i]`` is the first column of the lower triangle, and the first row of the upper one, that
    is not zero beside the diagonal's entry i, when all later states have been taken out. ``rows``
    says which row belongs to each state; rewards are those of rows or of states.
    """
    for i in range(size):
        low[i] = i
    for i in range(size):
        s = rows[order[begin + i]]
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            other = np.int64(place[indices[k]])
            if other >= i:
                low[other] = min(low[other], i)
            elif other >= 0:
                low[i] = min(low[i], other)
    for i in range(size - 1, 1, -1):
        if low[i] < i - 1:
            low[i - 1] = min(low[i - 1], low[i])
    for i in range(size):
        for j in range(low[i], i + 1):
            inner[i, j] = inner[j, i] = 0.0
    for i in range(size):
        s = rows[order[begin + i]]
        leaving[i] = exits[s]
        owner = s if by_row else order[begin + i]
        for j in range(right.shape[1]):
            right[i, j] = rewards[owner, j]
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            successor, p = indices[k], data[k]
            if place[successor] >= 0:
                inner[i, place[successor]] += p
            elif p > 0.0:
                leaving[i] += p
                for j in range(right.shape[1]):
                    right[i, j] += p * x[successor, j]


@njit(cache=True)
def _eliminate(inner: Array, low: Array, leaving: Array, right: Array, size: int) -> bool:
    """Solve one component, in place; false if it is never left."""
    n_rewards = right.shape[1]
    for i in range(size - 1, -1, -1):
        departs = leaving[i]
        for j in range(low[i], i):
            departs += inner[i, j]
        if departs <= 0.0:
            return False
        for j in range(low[i], i):
            inner[i, j] /= departs
        leaving[i] /= departs
        for j in range(n_rewards):
            right[i, j] /= departs
        for r in range(low[i], i):
            weight = inner[r, i]
            if weight > 0.0:
                for j in range(low[i], i):
                    inner[r, j] += weight * inner[i, j]
                leaving[r] += weight * leaving[i]
                for j in range(n_rewards):
                    right[r, j] += weight * right[i, j]
    for i in range(1, size):
        for j in range(low[i], i):
            weight = inner[i, j]
            for k in range(n_rewards):
                right[i, k] += weight * right[j, k]
    return True


@njit(cache=True)
def improve_components(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array,
    order: Array, components: Array, most: int, cost: Array, noise: float,
    choice: Array, values: Array,
) -> int:  # fmt: skip
    """Least values of a process with small components, each solved once and for all, ends first.

    A component of one state takes its best pair; in a larger one Howard's rounds start from the
    given policy, which leaves it.

    Args:
        offsets: [states + 1].
        indptr: [pairs + 1].
        indices: [entries].
        data: [entries].
        exits: [pairs].
        order: states, component by component, [states].
        components: offsets of the components in the order, [components + 1].
        most: states of the largest component.
        cost: [pairs].
        noise: relative gain up to which a pair is kept.
        choice: pairs of a policy that leaves, improved in place, [states].
        values: written, [states].

    Returns:
        The first component that a policy does not leave; -1 if there is none.
    """
    inner, right = np.empty((most, most)), np.empty((most, 1))
    low, leaving = np.empty(most, dtype=np.int64), np.empty(most)
    place = np.full(values.size if most > 1 else 0, -1, dtype=np.int32)
    for c in range(components.size - 1):
        begin, end = components[c], components[c + 1]
        if end - begin > 1:
            _, leaves = improve_component(
                offsets, indptr, indices, data, exits, order[begin:end], place, cost, noise,
                _ROUNDS, choice, values, inner, low, leaving, right,
            )  # fmt: skip
            if not leaves:
                return c
            continue
        s = order[begin]
        pick, least, kept, _ = best_pair(
            offsets, indptr, indices, data, exits, cost, values, s, choice[s]
        )
        if least == np.inf:
            return c
        values[s] = least
        if least < kept:  # among equals the held one stays
            choice[s] = pick
    return -1


@njit(cache=True)
def improve_component(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array,
    states: Array, place: Array, cost: Array, noise: float, rounds: int,
    choice: Array, values: Array, inner: Array, low: Array, leaving: Array, right: Array,
) -> tuple[int, bool]:  # fmt: skip
    """Howard's rounds within one component, in place; a policy that does not leave is taken back.

    Returns:
        How often a pair was changed, and whether all policies left.
    """
    column, rewards = values.reshape(values.size, 1), cost.reshape(cost.size, 1)
    size, changed, leaves = states.size, 0, True
    held = np.empty(size, dtype=choice.dtype)
    for i in range(size):
        place[states[i]] = i
    for _ in range(rounds):
        _gather(
            indptr, indices, data, exits, choice, states, 0, size, place, rewards, True, column,
            inner, low, leaving, right,
        )  # fmt: skip
        if not _eliminate(inner, low, leaving, right, size):
            leaves = False
            if changed:
                for i in range(size):
                    choice[states[i]] = held[i]
            break
        now = 0
        for i in range(size):
            values[states[i]] = right[i, 0]
        for i in range(size):
            s = states[i]
            held[i] = choice[s]
            pick, least, kept, terms = best_pair(
                offsets, indptr, indices, data, exits, cost, values, s, choice[s]
            )
            if least < kept - noise * terms:
                choice[s] = pick
                now += 1
        changed += now
        if now == 0:
            break
    for i in range(size):
        place[states[i]] = -1
    return changed, leaves


@njit(cache=True)
def best_pair(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array,
    cost: Array, values: Array, s: int, held: int,
) -> tuple[int, float, float, float]:  # fmt: skip
    """The best pair of a state on departing, its value, that of the held one, and what it sums."""
    pick, least, kept, size = held, np.inf, np.inf, 0.0
    for pair in range(offsets[s], offsets[s + np.uint32(1)]):
        total, departs, whole = cost[pair], exits[pair], abs(cost[pair])
        for k in range(indptr[pair], indptr[pair + np.uint32(1)]):
            if indices[k] != s:
                departs += data[k]
                total += data[k] * values[indices[k]]
                whole += data[k] * abs(values[indices[k]])
        if departs > 0.0:
            total /= departs
            if pair == held:
                kept, size = total, whole / departs
            if total < least:
                pick, least = pair, total
    return pick, least, kept, size
