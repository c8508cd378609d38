"""Compiled passes over the layers of accumulated cost, backward and forward.

A layer is one accumulated cost; ``layers`` is a block of layers
(``accumulated_cost.sweep._Layers``). A class of steps has one cost. The measures of a pair are the
expected charge and the expected totals of counted rewards, from the pair to the end of the run.
Free steps have cost 0 and stay in their layer.

Without fast-math sums run in the order of scipy's products, so that both agree to the last bit.
Index arrays are unsigned views, because numba tests signed indices for negative values.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from ssp_lp.arrays import MACHINE_EPSILON
from ssp_lp.compiled.cores import compiled_loop, one_or_all_cores

Array = np.ndarray[Any, Any]

ACCURATE = 1e-14
"""Relative change of values and measures at which sweeps over a layer end: near rounding."""

_LOWERINGS = 16
"""Most sweeps that lower the bounds of a layer to their backups, whose rounding depends on them."""


class OneLayer(NamedTuple):
    """Data of one layer for a compiled pass."""

    begin: Array  # [classes] position of the first value of the layer that a step leads to
    charged: Array  # [columns] charge of arriving
    factor: float  # accumulated cost, by which the growth of a charge is multiplied
    weight: float  # weight of the charge
    owed: Array  # [pairs] cost in addition to the charge, non-negative
    saved: Array  # [pairs] reward, non-negative


@compiled_loop(inline="always")
def _best_pair(
    first: Any, end: Any, layers: Any, one: OneLayer, values: Array,
) -> tuple[float, Any]:  # fmt: skip
    """Return the least value of a node's pairs in a layer, and the first pair that attains it."""
    least = np.inf
    for pair in range(first, end):
        total = 0.0
        for k in range(layers.indptr[pair], layers.indptr[pair + 1]):
            total += layers.data[k] * values[one.begin[layers.classes[k]] + layers.nodes[k]]
        own = one.weight * one.charged[layers.column[pair]]
        stage = own + one.owed[pair] - one.saved[pair]
        if one.factor != 0.0:
            stage += one.weight * one.factor * layers.growth[pair]
        total = stage + total
        if total < least:
            least, first = total, pair
    return least, first


@compiled_loop(inline="always")
def _measure_of(
    pair: Any, layers: Any, one: OneLayer, measures: Array, result: Array,
) -> None:  # fmt: skip
    """Write the measures of a pair in a layer to ``result``, [1 + counted]."""
    for j in range(result.size):
        result[j] = 0.0
    for k in range(layers.indptr[pair], layers.indptr[pair + 1]):
        place, share = one.begin[layers.classes[k]] + layers.nodes[k], layers.data[k]
        for j in range(result.size):
            result[j] += share * measures[place, j]
    if one.factor != 0.0:
        result[0] += one.factor * layers.growth[pair]
    result[0] += one.charged[layers.column[pair]]
    for j in range(1, result.size):
        result[j] += layers.counted[pair, j - 1]


@compiled_loop
def _settle(
    layers: Any, one: OneLayer, row: Any, values: Array, picks: Array, measures: Array,
    result: Array,
) -> None:  # fmt: skip
    """Write the least value of each node in a layer, and the pair that attains it.

    If free steps have cycles, Gauss-Seidel sweeps evaluate a choice until its values do not change,
    and then improve it. If there are no cycles, one sweep suffices, which also writes the measures.
    """
    n, is_greedy = picks.size, True
    if layers.turns == 1:
        for s in layers.order:
            first = np.uint64(layers.offsets[s])
            past = np.uint64(layers.offsets[s + 1])
            least, pick = _best_pair(first, past, layers, one, values)
            _measure_of(pick, layers, one, measures, result)
            values[row + s], picks[s] = least, pick - first
            for j in range(result.size):
                measures[row + s, j] = result[j]
        return
    for turn in range(layers.turns):
        change, scale = 0.0, 0.0
        for i in range(n):
            s = layers.order[i] if turn % 2 == 0 else layers.order[n - 1 - i]
            first = np.uint64(layers.offsets[s])
            pick = first if is_greedy else first + np.uint64(picks[s])
            past = np.uint64(layers.offsets[s + 1]) if is_greedy else pick + np.uint64(1)
            least, pick = _best_pair(pick, past, layers, one, values)
            change, scale = max(change, abs(least - values[row + s])), max(scale, abs(least))
            values[row + s], picks[s] = least, pick - first
        is_same = change <= ACCURATE * scale
        if is_same and is_greedy:
            break
        is_greedy = is_same


@compiled_loop
def _measure(
    layers: Any, one: OneLayer, picks: Array, row: Any, measures: Array, result: Array,
) -> None:  # fmt: skip
    """Write the measures of the chosen pair of each node in a layer."""
    n = picks.size
    for turn in range(layers.turns):
        is_same = True
        for i in range(n):
            s = layers.order[i] if turn % 2 == 0 else layers.order[n - 1 - i]
            pick, was = np.uint64(layers.offsets[s]) + np.uint64(picks[s]), measures[row + s]
            _measure_of(pick, layers, one, measures, result)
            for j in range(result.size):
                if layers.turns > 1 and abs(result[j] - was[j]) > ACCURATE * abs(result[j]):
                    is_same = False
                was[j] = result[j]
        if is_same:
            break


@compiled_loop
def _lower(
    layers: Any, one: OneLayer, row: Any, values: Array, free_steps: Array,
) -> None:  # fmt: skip
    """Reduce the values of a layer until none exceeds its Bellman backup, rounded down.

    If free steps have cycles, some sweeps lower each value to its backup. The greatest remaining
    excess, times a bound of the expected number of free steps, is then subtracted from the values.
    """
    n, excess, largest = layers.order.size, 0.0, 0.0
    for turn in range(_LOWERINGS + 1 if layers.turns > 1 else 1):
        excess = 0.0
        for i in range(n):
            s = layers.order[i]
            least = np.inf
            for pair in range(layers.offsets[s], layers.offsets[s + 1]):
                total, size = 0.0, 0.0
                for k in range(layers.indptr[pair], layers.indptr[pair + 1]):
                    term = layers.data[k] * values[one.begin[layers.classes[k]] + layers.nodes[k]]
                    total += term
                    size += abs(term)
                own = one.weight * one.charged[layers.column[pair]]
                stage = own + one.owed[pair] - one.saved[pair]
                whole = abs(own) + one.owed[pair] + one.saved[pair]
                if one.factor != 0.0:
                    stage += one.weight * one.factor * layers.growth[pair]
                    whole += one.weight * one.factor * layers.growth[pair]
                total, size = stage + total, whole + size
                if size != max(one.owed[pair], one.saved[pair], abs(own)):  # one term: no rounding
                    terms = float(layers.indptr[pair + 1] - layers.indptr[pair]) + 4.0
                    total -= (terms * MACHINE_EPSILON) * size
                least = min(least, total)
            excess = max(excess, values[row + s] - least)
            if turn < _LOWERINGS:
                values[row + s] = min(values[row + s], least)
            largest = max(largest, abs(values[row + s]))
        if layers.turns == 1 or excess == 0.0:
            return
    excess += 8.0 * MACHINE_EPSILON * (largest + excess)
    for s in range(n):
        values[row + s] -= excess * free_steps[s] * (1.0 + 4.0 * MACHINE_EPSILON)


@compiled_loop
def sweep_layers(
    layers: Any, weight: float, owed: Array, saved: Array, values: Array, measures: Array,
    position: Array, is_fixed: bool, free_steps: Array, ceiling: Array,
) -> None:  # fmt: skip
    """Compute values, or their lower bounds, by one backward sweep over a block of layers.

    Args:
        layers: the block of layers.
        weight: weight of the charge.
        owed: cost of a pair in addition to the charge, non-negative, [pairs].
        saved: reward of a pair, non-negative, [pairs].
        values: values of all layers: those of the block are written, those of later layers are
            read, [all layers * nodes].
        measures: measures, in the same order, [all layers * nodes, 1 + counted]; empty: not
            computed.
        position: the choice among each node's pairs, [layers, nodes].
        is_fixed: True: ``position`` is given, and only ``measures`` is computed; False:
            ``position`` is written.
        free_steps: for each node a bound t of the expected number of free steps in a row: t >= 1 +
            (mean of t after a free step), [nodes].
        ceiling: numbers that lower bounds must not exceed, [layers, nodes]; empty: compute least
            values instead of lower bounds.
    """
    n, is_bound = layers.order.size, ceiling.size > 0
    rows = max(values.size, measures.shape[0]) // n
    begin, unkept = np.empty(layers.leads.shape[1], np.uint64), np.empty(n, position.dtype)
    result = np.empty(measures.shape[1])
    for layer in range(layers.paid.size - 1, -1, -1):
        ahead = layers.leads[0] + layer if layers.leads.shape[0] == 1 else layers.leads[layer]
        for step in range(begin.size):
            begin[step] = np.uint64(ahead[step] * n)
        charged = layers.charge[layer if layers.charge.shape[0] > 1 else 0]
        factor = layers.paid[layer] if layers.growth.size > 0 else 0.0
        one = OneLayer(begin, charged, factor, weight, owed, saved)
        row, later = np.uint64(layer * n), (layer + 1) % rows * n
        picks = unkept if is_bound else position[layer]
        if is_bound and layers.turns == 1:
            values[row : row + n] = ceiling[layer]
        elif not is_fixed:
            if layers.turns > 1:
                values[row : row + n] = values[later : later + n]
            _settle(layers, one, row, values, picks, measures, result)
            if is_bound:
                values[row : row + n] = np.minimum(values[row : row + n], ceiling[layer])
        if is_bound:
            _lower(layers, one, row, values, free_steps)
        elif is_fixed or layers.turns > 1:
            if layers.turns > 1:
                measures[row : row + n] = 0.0
            _measure(layers, one, picks, row, measures, result)


@compiled_loop(inline="always")
def _total_of(
    pair: Any, layers: Any, at: int, many: int, values: Array, total: Array, size: Array,
) -> None:  # fmt: skip
    """Write the expected value after a pair for each layer of a block.

    Args:
        pair: the pair.
        layers: the layers.
        at: first layer of the block.
        many: number of layers in the block.
        values: [nodes, all layers].
        total: written: expected values, [many].
        size: written: sums of the absolute terms of the expected values, [many]; empty: not needed.
    """
    is_sized = size.size > 0
    total[:many] = 0.0
    if is_sized:
        size[:many] = 0.0
    for k in range(layers.indptr[pair], layers.indptr[pair + 1]):
        share, row = layers.data[k], values[layers.nodes[k]]
        begin = np.uint64(at + layers.leads[0, layers.classes[k]])
        if is_sized:
            for j in range(many):
                term = share * row[begin + np.uint64(j)]
                total[j] += term
                size[j] += abs(term)
        else:
            for j in range(many):
                total[j] += share * row[begin + np.uint64(j)]


@compiled_loop(inline="always")
def _measure_run(
    pair: Any, layers: Any, at: int, first: int, past: int, measures: Array, result: Array, s: int,
) -> None:  # fmt: skip
    """Write the measures of a node's pair in successive layers of a block.

    Args:
        pair: the pair.
        layers: the layers.
        at: first layer of the block.
        first: first layer to write, counted from ``at``.
        past: the layer after the last one, counted from ``at``.
        measures: updated, [1 + counted, nodes, all layers].
        result: working memory for the sums, [layers of a block].
        s: the node.
    """
    charge_row = 0
    for j in range(measures.shape[0]):
        result[first:past] = 0.0
        for k in range(layers.indptr[pair], layers.indptr[pair + 1]):
            share, row = layers.data[k], measures[j, layers.nodes[k]]
            begin = np.uint64(at + layers.leads[0, layers.classes[k]])
            for i in range(first, past):
                result[i] += share * row[begin + np.uint64(i)]
        for i in range(first, past):
            if j > 0:
                measures[j, s, at + i] = result[i] + layers.counted[pair, j - 1]
                continue
            if layers.charge.shape[0] > 1:
                charge_row = at + i
            if layers.growth.size > 0 and layers.paid[at + i] != 0.0:
                result[i] += layers.paid[at + i] * layers.growth[pair]
            measures[j, s, at + i] = result[i] + layers.charge[charge_row, layers.column[pair]]


@compiled_loop
def sweep_blocks(
    layers: Any, block: int, weight: float, owed: Array, saved: Array, values: Array,
    measures: Array, position: Array, is_fixed: bool, is_bound: bool, ceiling: Array,
) -> None:  # fmt: skip
    """Sweep backward like ``sweep_layers``, in blocks of layers that do not lead to each other.

    The numbers of one node for all layers lie side by side in memory, so that vector instructions
    compute several layers together. Terms are summed in the order of ``sweep_layers``.

    Args:
        layers: the layers; each class of steps passes a fixed number of them, at least ``block``.
        block: number of layers in a block.
        weight: weight of the charge.
        owed: as in ``sweep_layers``.
        saved: as in ``sweep_layers``.
        values: values of all layers: those of the swept layers are written, those of later layers
            are read, [nodes, all layers].
        measures: measures of the same layers, [1 + counted, nodes, all layers]; no nodes: not
            computed.
        position: the choice among each node's pairs, [layers, nodes].
        is_fixed: True: ``position`` is given, and only ``measures`` is computed; False:
            ``position`` is written.
        is_bound: whether lower bounds are computed, rounded down, rather than least values.
        ceiling: numbers that lower bounds must not exceed, [layers, nodes]; empty: no limits.
    """
    n, top = layers.offsets.size - 1, layers.paid.size
    total, size = np.empty(block), np.empty(block if is_bound else 0)
    least, own, picks = np.empty(block), np.empty(block), np.zeros(block, np.int64)
    while top > 0:
        many = min(block, top)
        at = top - many
        for s in range(n):
            first = np.int64(layers.offsets[s])
            if not is_fixed:
                least[:] = np.inf
                for pair in range(first, np.int64(layers.offsets[s + 1])):
                    _total_of(pair, layers, at, many, values, total, size)
                    terms = float(layers.indptr[pair + 1] - layers.indptr[pair]) + 4.0
                    factor = terms * MACHINE_EPSILON if is_bound else 0.0
                    growth = layers.growth[pair] if layers.growth.size > 0 else 0.0
                    column, alone = layers.column[pair], max(owed[pair], saved[pair])
                    if layers.charge.shape[0] > 1:
                        own[:many] = weight * layers.charge[at:top, column]
                    else:
                        own[:many] = weight * layers.charge[0, column]
                    for j in range(many):
                        more = weight * layers.paid[at + j] * growth
                        total[j] = own[j] + owed[pair] - saved[pair] + more + total[j]
                        if is_bound:
                            whole = abs(own[j]) + owed[pair] + saved[pair] + more + size[j]
                            is_single = whole == max(alone, abs(own[j]))  # one term: no rounding
                            total[j] -= 0.0 if is_single else factor * whole
                    number = pair - first
                    for j in range(many):
                        picks[j] = number if total[j] < least[j] else picks[j]
                        least[j] = min(least[j], total[j])
                for j in range(many):
                    values[s, at + j] = least[j]
                    if ceiling.size > 0:
                        values[s, at + j] = min(least[j], ceiling[at + j, s])
                    if position.size > 0:
                        position[at + j, s] = picks[j]
            if measures.shape[1] == 0:
                continue
            begun = 0
            for j in range(1, many + 1):
                if j == many or position[at + j, s] != position[at + begun, s]:
                    pick = np.uint64(first) + np.uint64(position[at + begun, s])
                    _measure_run(pick, layers, at, begun, j, measures, total, s)
                    begun = j
        top = at


@compiled_loop
def stream_mass(
    mass: Array, pairs: Array, offsets: Array, successors: Array, probabilities: Array,
    classes: Array, ring: Array, costs: Array, waiting: Array,
) -> None:  # fmt: skip
    """Send the mass of a layer to later layers, on one core for a fixed order of summation.

    Args:
        mass: mass of k states, [k, 1]; or for each discount three columns: mass, mass times
            accumulated cost, and mass that can no longer reach the goal, [k, 3 * discounts].
        pairs: pair taken in each state with mass, negative if none is taken, [k].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: class of the step cost, [outcomes]; empty: all outcomes are of class 0.
        ring: row of ``waiting`` to which a class of steps leads, -1: this layer, [classes].
        costs: cost of each class, [classes].
        waiting: written, [rows, states, columns].
    """
    for s in range(pairs.size):
        if pairs[s] >= 0:
            for outcome in range(offsets[pairs[s]], offsets[pairs[s] + 1]):
                step = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                if ring[step] >= 0:
                    to, share = waiting[ring[step], successors[outcome]], probabilities[outcome]
                    for k in range(0, to.size, 3):
                        to[k] += mass[s, k] * share
                        if to.size > 1:
                            to[k + 1] += (mass[s, k + 1] + costs[step] * mass[s, k]) * share
                            to[k + 2] += mass[s, k + 2] * share


@compiled_loop
def stream_evenly(
    waiting: Array, first: int, decision: Array, alive: Array, acting: Array, at_goal: Array,
    pair_offsets: Array, offsets: Array, successors: Array, probabilities: Array, classes: Array,
    leads: Array, costs: Array, stage: Array, stopping: Array, forbidden: Array, goes_on: bool,
    column: int, survival: float, totals: Array, stopped: Array,
) -> bool:  # fmt: skip
    """Follow a policy's mass through layers; each class of steps passes a fixed number of them.

    Args:
        waiting: a ring buffer of layers, updated: for each discount mass, mass times accumulated
            cost, and mass that can no longer reach the goal, [rows, states, 3 * discounts]; or mass
            alone, [rows, states, 1].
        first: the first layer.
        decision: position in the state's pairs, or a code, [layers, states].
        alive: whether the goal can be reached, [layers, states]; empty: everywhere.
        acting: whether episodes go on, [states].
        at_goal: [states].
        pair_offsets: [states + 1].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: class of the step cost, [outcomes]; empty: all outcomes are of class 0.
        leads: layers that each class of steps passes, at least 1, [classes].
        costs: [classes].
        stage: mean cost of a step, [pairs]; if empty, ``stopping`` and ``forbidden`` are empty.
        stopping: cost of failing in a state, [states].
        forbidden: whether giving up is not allowed, [states].
        goes_on: whether costs are paid after the goal is out of reach.
        column: index of the first of the three columns that are followed.
        survival: discount of these columns.
        totals: goal, failure, cost of success, cost until failure; written, [layers, 4].
        stopped: mass that ends in each state, and mass that gives up; written, [2, states].

    Returns:
        Whether all decisions exist and are allowed.
    """
    room, several, is_charged = waiting.shape[0], waiting.shape[2] > 1, stage.size > 0
    for layer in range(decision.shape[0]):
        row, sums = waiting[(first + layer) % room].copy(), totals[layer]
        # the row is free for the layer to which the longest steps lead
        waiting[(first + layer) % room, :, column : column + 3] = 0.0
        for s in range(row.shape[0]):
            mass, paid, lost = row[s, column], 0.0, 0.0
            if several:
                paid, lost = row[s, column + 1], row[s, column + 2]
            if mass == 0.0 and lost == 0.0:
                continue
            hopes = alive.size == 0 or alive[layer, s]
            code = np.int64(decision[layer, s])
            quits, moves = acting[s] and code == -1, acting[s] and code >= 0
            if (quits and is_charged and forbidden[s]) or (acting[s] and code < -1):
                return False
            pair, cost, failing = pair_offsets[s] + max(code, np.int64(0)), 0.0, 0.0
            if is_charged and not at_goal[s]:
                failing = stopping[s]
                cost = stage[pair] if moves else failing
            if at_goal[s]:
                sums[0] += mass
                sums[2] += paid / survival
            if not hopes:
                sums[1] += mass
                lost += mass
            elif moves:
                sums[1] += (1.0 - survival) * mass
            if hopes:
                sums[3] += mass * cost
            elif goes_on:
                sums[3] += lost * cost if cost > 0.0 else 0.0
            else:
                sums[3] += mass * failing
            stopped[1 if quits else 0, s] += mass if hopes else lost
            if not moves:
                continue
            mass, paid = mass if hopes else 0.0, paid if hopes else 0.0
            for outcome in range(offsets[pair], offsets[pair + 1]):
                step = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                to = waiting[(first + layer + leads[step]) % room, successors[outcome]]
                share = survival * probabilities[outcome]
                to[column] += mass * share
                if not several:
                    continue
                to[column + 1] += (paid + costs[step] * mass) * share
                to[column + 2] += lost * share
    return True


@compiled_loop
def stream_layers(
    waiting: Array, heads: Array, links: Array,
    indptr: Array, indices: Array, data: Array, first: int, arrived: Array,
) -> int:  # fmt: skip
    """Follow mass from layer to layer: collect it at the goal, send it on elsewhere.

    The mass waits in a ring buffer of layers. Only entries with mass are visited: they form a
    linked list for each layer.

    Args:
        waiting: mass; the last node of each layer is the goal; updated, [layers of the ring *
            nodes].
        heads: first entry with mass of each layer, -1: none; updated, [layers of the ring].
        links: next entry of the same layer, -1: none; updated, in the shape of ``waiting``.
        indptr: offsets of the moves of each node except the goal, [nodes].
        indices: successors, relative to the node's own layer, [moves].
        data: probabilities, [moves].
        first: the first layer.
        arrived: written: mass at the goal of each layer, [layers to follow].

    Returns:
        The number of moves followed.
    """
    size, followed = indptr.size, 0
    for ahead in range(arrived.size):
        row = (first + ahead) % heads.size
        while heads[row] >= 0:
            result = heads[row]
            heads[row], mass, node = links[result], waiting[result], result - row * size
            waiting[result] = 0.0
            if node == size - 1:
                arrived[ahead] += mass
                continue
            followed += indptr[node + 1] - indptr[node]
            for k in range(indptr[node], indptr[node + 1]):
                to = row * size + indices[k]
                to = to if to < waiting.size else to - waiting.size
                share = data[k] * mass
                if waiting[to] == 0.0 and share > 0.0:  # underflow counts as 0
                    links[to], heads[to // size] = heads[to // size], to
                waiting[to] += share
    return followed


@compiled_loop(inline="always")
def _add_exactly(sums: Array, j: int, term: float) -> None:
    """Add a term to one of several sums, by compensated summation.

    Args:
        sums: sums and their rounding errors, updated, [sums, 2].
        j: index of the sum.
        term: the term.
    """
    whole = sums[j, 0] + term
    if abs(sums[j, 0]) >= abs(term):
        sums[j, 1] += (sums[j, 0] - whole) + term
    else:
        sums[j, 1] += (term - whole) + sums[j, 0]
    sums[j, 0] = whole


@compiled_loop
def follow_layer(
    mass: Array, position: Array,
    offsets: Array, indptr: Array, starts: Array, indices: Array, data: Array,
    charge: Array, growth: Array, layer: float, counted: Array, onward: Array, sums: Array,
) -> None:  # fmt: skip
    """Move the mass of a layer by the chosen pairs, and add the charges and rewards to ``sums``.

    Args:
        mass: [nodes].
        position: position of the chosen pair among the node's pairs, [nodes].
        offsets: pairs of each node, [nodes + 1].
        indptr: position of each pair's first column, [pairs + 1].
        starts: position of each pair's first number, [pairs].
        indices: columns.
        data: numbers.
        charge: charge of arriving, [pairs].
        growth: increase of the charge per unit of the total, [pairs] or empty.
        layer: accumulated cost of the layer.
        counted: quantities in addition to the charge, [pairs, counted].
        onward: mass that arrives at each column, added to, [columns].
        sums: the measures and their rounding errors, [1 + counted, 2], added to.
    """
    terms = np.zeros(len(sums))
    for s in range(mass.size):
        if mass[s] <= 0.0:
            continue
        pair = offsets[s] + np.uint64(position[s])
        stage = charge[pair]
        if layer != 0.0:
            stage += layer * growth[pair]
        terms[0] = stage
        for j in range(1, terms.size):
            terms[j] = counted[pair, j - 1]
        for j in range(terms.size):
            _add_exactly(sums, j, mass[s] * terms[j])
        first, begin = indptr[pair], starts[pair]
        for k in range(indptr[pair + np.uint64(1)] - first):
            onward[indices[first + k]] += mass[s] * data[begin + k]


@compiled_loop
def follow_layers(
    layers: Any, first: int, position: Array, ring: Array, sums: Array,
) -> None:  # fmt: skip
    """Move mass by the chosen pairs, layer by layer, and add the charges and rewards to ``sums``.

    Each class of steps must pass a fixed number of layers.

    Args:
        layers: all layers.
        first: the first layer that is followed.
        position: position of the chosen pair among the node's pairs, [followed, nodes].
        ring: mass; that of a layer is in row (layer modulo rows); updated, [rows, nodes].
        sums: the measures and their rounding errors, [1 + counted, 2], added to.
    """
    rows, to = ring.shape[0], np.empty(layers.leads.shape[1], np.int64)
    for layer in range(first, first + position.shape[0]):
        result, even = ring[layer % rows], 0 if layers.charge.shape[0] == 1 else layer
        for step in range(to.size):
            to[step] = (layer + layers.leads[0, step]) % rows
        for s in range(result.size):
            mass = result[s]
            if mass <= 0.0:
                continue
            result[s] = 0.0
            pair = layers.offsets[s] + np.uint64(position[layer - first, s])
            for j in range(sums.shape[0]):
                if j > 0:
                    term = mass * layers.counted[pair, j - 1]
                else:
                    term = layers.charge[even, layers.column[pair]]
                    if layers.growth.size > 0:
                        term += layers.paid[layer] * layers.growth[pair]
                    term *= mass
                _add_exactly(sums, j, term)
            for k in range(layers.indptr[pair], layers.indptr[pair + np.uint64(1)]):
                ring[to[layers.classes[k]], layers.nodes[k]] += mass * layers.data[k]


@one_or_all_cores
def stream_marks(
    decision: Array, acting: Array, pair_offsets: Array,
    offsets: Array, successors: Array, probabilities: Array, classes: Array,
    leads: Array, order: Array, alive: Array,
) -> None:  # fmt: skip
    """Mark, layer by layer backwards, the states from which a policy may reach a marked state.

    If free steps have cycles, a layer is swept until no further state is marked.

    Args:
        decision: position in the state's pairs, negative if none is taken, [layers, states].
        acting: whether episodes go on, [states].
        pair_offsets: [states + 1].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: class of the step cost, [outcomes]; empty: all outcomes are of class 0.
        leads: layers that each class of steps passes, [classes].
        order: states, each after the states its free steps lead to, as far as possible, [states].
        alive: marks; those of the layers are written, those of later layers are read, [all
            layers, states].
    """
    n_layers, n = decision.shape
    stays = leads.min() == 0
    for back in range(n_layers):
        layer, marked = n_layers - 1 - back, 1
        while marked > 0:
            marked = 0
            for i in prange(n):
                s = order[i]
                if decision[layer, s] >= 0 and acting[s] and not alive[layer, s]:
                    pair = pair_offsets[s] + decision[layer, s]
                    for outcome in range(offsets[pair], offsets[pair + 1]):
                        step = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                        later = layer + leads[step]
                        if probabilities[outcome] > 0.0 and alive[later, successors[outcome]]:
                            alive[layer, s] = True
                            marked += 1
                            break
            if not stays:
                break
