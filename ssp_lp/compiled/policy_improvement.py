"""Compiled policy improvement: component by component, and state by state in a given order."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssp_lp.arrays import LEAST_RISE
from ssp_lp.compiled.cores import compiled_loop
from ssp_lp.compiled.equations import eliminate_component, gather_component

Array = np.ndarray[Any, Any]
Rows = tuple[Array, Array, Array, Array, Array]
"""A process: offsets of each state's pairs, [states + 1], and of each pair's entries, [pairs + 1];
columns and probabilities, [entries] each; and the probability of leaving for good, [pairs]."""

_LEAST_POSITIVE = float(np.nextafter(0.0, 1.0))
_MOST_ROUNDS = 1_000
"""Most rounds in one component. Only rounding could lead to more; the bound shows the loss."""


@compiled_loop
def improve_components(
    rows: Rows, order: Array, components: Array, largest: int, cost: Array, noise: float,
    choice: Array, values: Array,
) -> int:  # fmt: skip
    """Improve a policy until its values are least, component by component.

    The first components are those that lead to no other. A component of one state takes its best
    pair. In a larger component Howard's policy iteration starts from the given policy, which must
    leave the component.

    Args:
        rows: the process.
        order: states, component by component, each component after those that it leads to,
            [states].
        components: offsets of the components in the order, [components + 1].
        largest: number of states of the largest component.
        cost: [pairs].
        noise: relative gain up to which the present pair is kept.
        choice: pairs of a policy by which every run ends, improved in place, [states].
        values: written, [states].

    Returns:
        The first component that the policy does not leave; -1 if there is none.
    """
    dense, rhs = np.empty((largest, largest)), np.empty((largest, 1))
    low, outflow = np.empty(largest, dtype=np.int64), np.empty(largest)
    place = np.full(values.size if largest > 1 else 0, -1, dtype=np.int32)
    for c in range(components.size - 1):
        begin, end = components[c], components[c + 1]
        if end - begin > 1:
            if not _improve_component(
                rows, order[begin:end], place, cost, noise, choice, values,
                dense, low, outflow, rhs,
            ):  # fmt: skip
                return c
            continue
        s = order[begin]
        pick, least, kept, _ = _best_pair(rows, cost, values, s, choice[s])
        if least == np.inf:
            return c
        values[s] = least
        if least < kept:  # the present pair is kept if it is equally good
            choice[s] = pick
    return -1


@compiled_loop
def improve_acyclic(
    rows: Rows, order: Array, rewards: Array, cost: Array, is_fixed: bool, epsilon: float,
    choice: Array, x: Array, runs: Array, missed: Array,
) -> bool:  # fmt: skip
    """Improve a policy in one pass over a process without cycles, and compute all totals.

    The rounding of each total is summed as well (a running error analysis, Higham 2002).

    Args:
        rows: the process.
        order: states, each after the states that it leads to, [states].
        rewards: [pairs, rewards].
        cost: the weighted sum of the rewards, which is minimised, [pairs].
        is_fixed: True: evaluate the given pairs without improving them.
        epsilon: the machine epsilon.
        choice: the given pairs, overwritten by better ones unless ``is_fixed``, [states].
        x: written: expected totals, [states, rewards].
        runs: written: expected steps, [states].
        missed: written: for each reward the greatest value, over the states, of half the error
            bound of the state's total divided by its expected steps, [rewards].

    Returns:
        False if some state is never left.
    """
    _, indptr, indices, data, exits = rows
    n_rewards, unit = rewards.shape[1], 0.51 * epsilon  # above 0.5, for products of roundings
    values, wrong = np.empty(runs.size), np.empty(x.shape)
    missed[:] = 0.0
    for s in order:
        if not is_fixed:
            pick, values[s], kept, _ = _best_pair(rows, cost, values, s, choice[s])
            if values[s] < kept:
                choice[s] = pick
        pick, slip, steps = choice[s], 0.0, 1.0
        escape = exits[pick]
        for k in range(indptr[pick], indptr[pick + np.uint32(1)]):
            if indices[k] != s:
                escape += data[k]
                slip += escape
                steps += data[k] * runs[indices[k]]
        if escape <= 0.0:
            return False
        runs[s] = steps / escape
        for j in range(n_rewards):
            total, rounded, error = rewards[pick, j], 0.0, 0.0
            for k in range(indptr[pick], indptr[pick + np.uint32(1)]):
                if indices[k] != s:
                    term = data[k] * x[indices[k], j]
                    total += term
                    rounded += abs(total) + abs(term)
                    error += data[k] * wrong[indices[k], j]
            x[s, j] = total / escape
            rounded += abs(x[s, j]) * (slip + escape)
            wrong[s, j] = (error + unit * rounded) / escape
            missed[j] = max(missed[j], 0.5 * wrong[s, j] / runs[s])
    return True


@compiled_loop
def _improve_component(
    rows: Rows, states: Array, position: Array, cost: Array, noise: float,
    choice: Array, values: Array, dense: Array, low: Array, outflow: Array, rhs: Array,
) -> bool:  # fmt: skip
    """Improve a policy within a component by Howard's policy iteration.

    Args:
        rows: the process.
        states: states of the component.
        position: working memory, filled with -1, [all states].
        cost: [pairs].
        noise: relative gain up to which the present pair is kept.
        choice: pairs of the policy, improved in place, [all states].
        values: values; written for the component, [all states].
        dense: working memory for ``gather_component``, as are ``low``, ``outflow`` and ``rhs``.

    Returns:
        False if a policy never leaves the component from some state.
    """
    _, indptr, indices, data, exits = rows
    column, rewards = values.reshape(values.size, 1), cost.reshape(cost.size, 1)
    size, leaves = states.size, True
    for i in range(size):
        position[states[i]] = i
    for _ in range(_MOST_ROUNDS):
        gather_component(
            indptr, indices, data, exits, choice, states, 0, size, position, rewards, True, column,
            dense, low, outflow, rhs,
        )  # fmt: skip
        leaves = eliminate_component(dense, low, outflow, rhs, size)
        if not leaves:
            break
        for i in range(size):
            values[states[i]] = rhs[i, 0]
        changed = False
        for s in states:
            pick, least, kept, terms = _best_pair(rows, cost, values, s, choice[s])
            if least < kept - noise * terms:
                choice[s], changed = pick, True
        if not changed:
            break
    for i in range(size):
        position[states[i]] = -1
    return leaves


@compiled_loop
def _best_pair(
    rows: Rows, cost: Array, values: Array, s: int, current: int
) -> tuple[int, float, float, float]:
    """Return the first best pair of a state, and its value.

    The value of a pair is conditioned on departing: without the self-loop, and divided by the
    probability of departing.

    Args:
        rows: the process.
        cost: [pairs].
        values: [states].
        s: the state.
        current: its present pair.

    Returns:
        The best pair, its value, the present pair's value, and the sum of the absolute terms of the
        present pair's value.
    """
    offsets, indptr, indices, data, exits = rows
    pick, least, kept, size = current, np.inf, np.inf, 0.0
    for pair in range(offsets[s], offsets[s + np.uint32(1)]):
        total, escape, whole = cost[pair], exits[pair], abs(cost[pair])
        for k in range(indptr[pair], indptr[pair + np.uint32(1)]):
            if indices[k] != s:
                escape += data[k]
                total += data[k] * values[indices[k]]
                whole += data[k] * abs(values[indices[k]])
        if escape > 0.0:
            total /= escape
            if pair == current:
                kept, size = total, whole / escape
            if total < least:
                pick, least = pair, total
    return pick, least, kept, size


@compiled_loop
def improve_states(
    rows: Rows, order: Array, cost: Array, noise: float, floor: float, choice: Array, values: Array
) -> int:
    """Improve a policy and its values in place, state by state.

    Args:
        rows: the process.
        order: the states to visit, in this order.
        cost: [pairs].
        noise: relative gain up to which the present pair is kept.
        floor: absolute gain up to which the present pair is kept.
        choice: pair of each state, updated, [states].
        values: updated, [states].

    Returns:
        The number of pairs that changed.
    """
    offsets, indptr, indices, data, _ = rows
    changed = 0
    for s in order:
        least, pick, kept = np.inf, choice[s], values[s]
        for pair in range(offsets[s], offsets[s + np.uint32(1)]):
            total = 0.0
            for k in range(indptr[pair], indptr[pair + np.uint32(1)]):
                total += data[k] * values[indices[k]]
            total += cost[pair]
            if pair == choice[s]:
                kept = total
            if total < least:
                least, pick = total, pair
        if least < kept - noise * abs(kept) - floor:
            changed += 1
            choice[s], values[s] = pick, least
        else:
            values[s] = kept
    return changed


@compiled_loop
def sweep_reach(
    rows: Rows, order: Array, hit: Array, epsilon: float, up: bool, choice: Array, values: Array
) -> float:
    """Update bounds of the greatest probability of leaving by an exit, by one sweep over states.

    Lower bounds are backups rounded down: a value never falls, and if it rises, the state takes the
    pair that raises it. Upper bounds are backups rounded up: a value is at most 1, and the choice
    does not change.

    Args:
        rows: the process.
        order: the states to visit.
        hit: probability of leaving by the exit in one step, [pairs].
        epsilon: the machine epsilon.
        up: True for upper bounds, False for lower bounds.
        choice: pair of each state, updated, [states].
        values: updated, [states].

    Returns:
        The greatest rise of a value.
    """
    offsets, indptr, indices, data, _ = rows
    most, sign = 0.0, 1.0 if up else -1.0
    for s in order:
        greatest, pick = -1.0, choice[s]
        for pair in range(offsets[s], offsets[s + np.uint32(1)]):
            total, begin, end = hit[pair], indptr[pair], indptr[pair + np.uint32(1)]
            for k in range(begin, end):
                total += data[k] * values[indices[k]]
            total += sign * (float(end - begin) + 4.0) * epsilon * total
            if total > greatest:
                greatest, pick = total, pair
        rise = min(greatest, 1.0) - values[s]
        most = max(most, rise)
        if up:
            values[s] = min(greatest, 1.0)
        elif rise > LEAST_RISE:
            values[s], choice[s] = greatest, pick
    return most


@compiled_loop
def reach_in_order(
    offsets: Array, bounds: Array, successors: Array, probabilities: Array, goals: Array,
    epsilon: float, begin: int, end: int, decision: Array, values: Array,
) -> bool:  # fmt: skip
    """Compute the greatest goal probabilities if each step leads to a later state, the last first.

    Args:
        offsets: pairs of each state, [states + 1].
        bounds: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        goals: mask of the goals, [states].
        epsilon: the machine epsilon.
        begin: number of states, from the last one, that are finished already.
        end: number of states, from the last one, that must be finished.
        decision: negative numbers; replaced by a best pair of each state from which the goal can be
            reached and which is no goal, [states].
        values: written: probabilities of the goal and of missing it under these decisions, an upper
            bound of the greatest of the former, and a lower bound of the least of the latter,
            [states, 4].

    Returns:
        False if a step leads to the same or to an earlier state; then the results are incomplete.
    """
    for s in range(goals.size - 1 - begin, goals.size - 1 - end, -1):
        hit = most = 1.0 if goals[s] else 0.0
        miss = least = 1.0 - hit
        for pair in range(offsets[s], offsets[s + 1]):
            reached = missed = upper = lower = 0.0
            is_sure = is_lost = True
            for k in range(bounds[pair], bounds[pair + 1]):
                chance, t = probabilities[k], successors[k]
                if chance > 0.0:
                    if t <= s:
                        return False
                    is_sure &= values[t, 1] == 0.0
                    is_lost &= values[t, 2] == 0.0
                    reached += chance * values[t, 0]
                    missed += chance * values[t, 1]
                    upper += chance * values[t, 2]
                    lower += chance * values[t, 3]
            if is_sure or is_lost:  # by the graph, whatever the rounding of probabilities
                reached = upper = 0.0 if is_lost else 1.0
                missed = lower = 1.0 - reached
            else:
                rounding = (float(bounds[pair + 1] - bounds[pair]) + 2.0) * epsilon
                upper, lower = upper * (1.0 + rounding), lower * (1.0 - rounding)
                upper = max(upper, _LEAST_POSITIVE)  # products below it are rounded to 0
            most, least = max(most, upper), min(least, lower)
            is_first = decision[s] < 0 and not is_lost and not goals[s]
            if is_first or (reached > hit if min(reached, hit) < 0.5 else missed < miss):
                hit, miss, decision[s] = reached, missed, pair
        values[s, 0], values[s, 1], values[s, 2], values[s, 3] = hit, miss, most, least
    return True


@compiled_loop
def follow_reach(
    starts: Array, ends: Array, indices: Array, data: Array, order: Array, hit: Array,
    epsilon: float, is_reversed: bool, values: Array,
) -> None:  # fmt: skip
    """Update lower bounds of a policy's probability of leaving by an exit, state by state.

    Args:
        starts: position of the first entry in the row of each visited state's pair, [visited].
        ends: position after the last entry of this row, [visited].
        indices: [entries].
        data: [entries].
        order: the states to visit, [visited].
        hit: probability of leaving by the exit in one step, by the pair of each visited state,
            [visited].
        epsilon: the machine epsilon.
        is_reversed: whether to visit the last state first.
        values: the bounds, updated, [all states].
    """
    for number in range(order.size):
        i = np.uint64(order.size - 1 - number if is_reversed else number)
        s, total, begin, end = order[i], hit[i], starts[i], ends[i]
        for k in range(begin, end):
            total += data[k] * values[indices[k]]
        total *= 1.0 - (float(end - begin) + 5.0) * epsilon
        if total - values[s] > LEAST_RISE:
            values[s] = total
