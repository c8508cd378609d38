"""Compiled passes over the layers of accumulated cost, backward and forward.

No fast-math: sums run in the order of scipy's products, so that both agree to the last bit.
Index arrays come as unsigned views: signed ones cost a test for negative positions at each access.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from ssp_lp.arrays import MACHINE_EPSILON
from ssp_lp.compiled.cores import compiled_loop, one_or_all_cores

Array = np.ndarray[Any, Any]

ACCURATE = 1e-14
"""Relative change of values and measures at which turns over a layer end: next to rounding."""

_LOWERINGS = 16
"""Turns in which bounds within a layer follow each other's rounding: more than halving it takes."""


class OneLayer(NamedTuple):
    """What changes from layer to layer of a compiled pass."""

    begin: Array  # [classes] where the values of the layer begin that a step leads to
    charged: Array  # [columns] for arriving
    factor: float  # of the growth
    weight: float  # of the charge
    owed: Array  # [pairs] cost beside the charge, non-negative
    saved: Array  # [pairs] earned, non-negative


@compiled_loop(inline="always")
def _best_pair(
    pick: Any, past: Any, layers: Any, one: OneLayer, values: Array,
) -> tuple[float, Any]:  # fmt: skip
    """Compiled: least value of a node's pairs in a layer, and the first pair that attains it."""
    least = np.inf
    for pair in range(pick, past):
        total = 0.0
        for k in range(layers.indptr[pair], layers.indptr[pair + 1]):
            total += layers.data[k] * values[one.begin[layers.classes[k]] + layers.nodes[k]]
        own = one.weight * one.charged[layers.column[pair]]
        stage = own + one.owed[pair] - one.saved[pair]
        if one.factor != 0.0:
            stage += one.weight * one.factor * layers.growth[pair]
        total = stage + total
        if total < least:
            least, pick = total, pair
    return least, pick


@compiled_loop(inline="always")
def _measure_of(
    pick: Any, layers: Any, one: OneLayer, measured: Array, here: Array,
) -> None:  # fmt: skip
    """Compiled: measures of a pair in a layer, written, [1 + counted]."""
    for j in range(here.size):
        here[j] = 0.0
    for k in range(layers.indptr[pick], layers.indptr[pick + 1]):
        place, share = one.begin[layers.classes[k]] + layers.nodes[k], layers.data[k]
        for j in range(here.size):
            here[j] += share * measured[place, j]
    if one.factor != 0.0:
        here[0] += one.factor * layers.growth[pick]
    here[0] += one.charged[layers.column[pick]]
    for j in range(1, here.size):
        here[j] += layers.counted[pick, j - 1]


@compiled_loop
def _settle(
    layers: Any, one: OneLayer, row: Any, values: Array, picks: Array, measured: Array,
    here: Array,
) -> None:  # fmt: skip
    """Compiled: least values of a layer of cost, and the pairs that attain them, written.

    Where free steps go round, the layer is gone over forwards and backwards (Gauss-Seidel): a
    choice is followed until nothing changes, and then made anew. Where they do not, the measures
    of the choice are written as well, while its pair is at hand.
    """
    n, is_greedy = picks.size, True
    if layers.turns == 1:
        for s in layers.order:
            first = np.uint64(layers.offsets[s])
            past = np.uint64(layers.offsets[s + 1])
            least, pick = _best_pair(first, past, layers, one, values)
            _measure_of(pick, layers, one, measured, here)
            values[row + s], picks[s] = least, pick - first
            for j in range(here.size):
                measured[row + s, j] = here[j]
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
    layers: Any, one: OneLayer, picks: Array, row: Any, measured: Array, here: Array,
) -> None:  # fmt: skip
    """Compiled: measures of a layer's choice, written; unmet nodes keep 0."""
    n = picks.size
    for turn in range(layers.turns):
        is_same = True
        for i in range(n):
            s = layers.order[i] if turn % 2 == 0 else layers.order[n - 1 - i]
            pick, was = np.uint64(layers.offsets[s]) + np.uint64(picks[s]), measured[row + s]
            _measure_of(pick, layers, one, measured, here)
            for j in range(here.size):
                if layers.turns > 1 and abs(here[j] - was[j]) > ACCURATE * abs(here[j]):
                    is_same = False
                was[j] = here[j]
        if is_same:
            break


@compiled_loop
def _lower(
    layers: Any, one: OneLayer, row: Any, values: Array, within: Array,
) -> None:  # fmt: skip
    """Compiled: values of a layer lowered to their backups, rounding counted against each.

    Where free steps go round each value is lowered by its own. What values exceed their backups by
    after some turns, times the steps that any policy takes within a layer, is taken off all of
    them: then they are a sub-solution.
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
                if size != max(one.owed[pair], one.saved[pair], abs(own)):  # else all is one number
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
        values[row + s] -= excess * within[s] * (1.0 + 4.0 * MACHINE_EPSILON)


@compiled_loop
def sweep_layers(
    layers: Any, weight: float, owed: Array, saved: Array, values: Array, measured: Array,
    position: Array, keeps: bool, within: Array, given: Array,
) -> None:  # fmt: skip
    """Compiled backward sweep over a block of layers in one pass, the last of them first.

    Args:
        layers: what the pass reads of the process, ``accumulated_cost.sweep.Layers``.
        weight: of the charge.
        owed: what a pair costs beside the charge, non-negative, [pairs].
        saved: and what it earns, [pairs].
        values: of the layers and those that they lead to, these given, [all layers * nodes].
        measured: the measures, likewise, [all layers * nodes, 1 + counted]; empty: not asked for.
        position: the choice among each node's pairs, [layers, nodes].
        keeps: whether the choice is given, rather than written; then values do not matter.
        within: at least one more than after the free steps of any pair, [nodes].
        given: what lower bounds are not to exceed, [layers, nodes]; empty: the least values
            themselves are asked for.
    """
    n, is_bound = layers.order.size, given.size > 0
    rows = max(values.size, measured.shape[0]) // n
    begin, unkept = np.empty(layers.leads.shape[1], np.uint64), np.empty(n, position.dtype)
    here = np.empty(measured.shape[1])
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
            values[row : row + n] = given[layer]
        elif not keeps:
            if layers.turns > 1:
                values[row : row + n] = values[later : later + n]
            _settle(layers, one, row, values, picks, measured, here)
            if is_bound:
                values[row : row + n] = np.minimum(values[row : row + n], given[layer])
        if is_bound:
            _lower(layers, one, row, values, within)
        elif keeps or layers.turns > 1:
            if layers.turns > 1:
                measured[row : row + n] = 0.0
            _measure(layers, one, picks, row, measured, here)


@compiled_loop
def stream_mass(
    mass: Array, pairs: Array, offsets: Array, successors: Array, probabilities: Array,
    classes: Array, ring: Array, costs: Array, waiting: Array,
) -> None:  # fmt: skip
    """Send the mass of a layer on to later ones, in place; one core: the sums keep their order.

    Args:
        mass: one column, or three for each discount, the second of which is the first times the
            cost paid, [k, columns].
        pairs: of the states that have it, negative where none is taken, [k].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: of the step costs, [outcomes]; empty: all outcomes are of class 0.
        ring: row of the layer that a class of steps leads to, -1: this one, [classes].
        costs: [classes].
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
    waiting: Array, first: int, decision: Array, hopeful: Array, acting: Array, at_goal: Array,
    pair_offsets: Array, offsets: Array, successors: Array, probabilities: Array, classes: Array,
    leads: Array, costs: Array, stage: Array, stopping: Array, forbidden: Array, goes_on: bool,
    column: int, survival: float, totals: Array, stopped: Array,
) -> bool:  # fmt: skip
    """Compiled: follow a policy's mass through layers that all lead equally many layers ahead.

    Args:
        waiting: mass, that times the cost paid, and mass that lost the goal; written, [rows of the
            ring, states, 3 * discounts]; or mass alone, [rows, states, 1].
        first: the first layer.
        decision: position in the state's pairs, or a code, [layers, states].
        hopeful: whence the goal can be reached, [layers, states]; empty: it does not matter.
        acting: states at which episodes go on, [states].
        at_goal: [states].
        pair_offsets: [states + 1].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: of the step costs, [outcomes]; empty: all outcomes are of class 0.
        leads: layers that each class of steps passes, at least 1, [classes].
        costs: [classes].
        stage: mean cost of a step, [pairs]; or empty, as the next two are.
        stopping: what failing in a state costs, [states].
        forbidden: where giving up is not allowed, [states].
        goes_on: whether costs are paid where the goal is lost.
        column: the first of three that are followed.
        survival: the discount of these.
        totals: goal, failure, cost of success, cost until failure; written, [layers, 4].
        stopped: what ends in each state, and what gives up there; written, [2, states].

    Returns:
        Whether all decisions are there and allowed.
    """
    room, several, is_charged = waiting.shape[0], waiting.shape[2] > 1, stage.size > 0
    for layer in range(decision.shape[0]):
        row, sums = waiting[(first + layer) % room].copy(), totals[layer]
        waiting[(first + layer) % room, :, column : column + 3] = 0.0  # the longest lead here
        for s in range(row.shape[0]):
            mass, paid, lost = row[s, column], 0.0, 0.0
            if several:
                paid, lost = row[s, column + 1], row[s, column + 2]
            if mass == 0.0 and lost == 0.0:
                continue
            hopes = hopeful.size == 0 or hopeful[layer, s]
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
    """Compiled: settle the arrivals of a ring's layers one after the other, sending mass on.

    Only where mass waits is looked at: lists say so, of each layer of the ring.

    Args:
        waiting: mass, whose last node is the goal, [layers of the ring * nodes]; written.
        heads: a place of each layer where mass waits, -1: none; written.
        links: another place of the same layer, -1: none, like ``waiting``; written.
        indptr: moves of each node but the goal, [nodes].
        indices: to where they lead, counted from the node's own layer, [moves].
        data: [moves].
        first: the first layer.
        arrived: written, [layers to settle].

    Returns:
        Moves followed.
    """
    size, followed = indptr.size, 0
    for ahead in range(arrived.size):
        row = (first + ahead) % heads.size
        while heads[row] >= 0:
            here = heads[row]
            heads[row], mass, node = links[here], waiting[here], here - row * size
            waiting[here] = 0.0
            if node == size - 1:
                arrived[ahead] += mass
                continue
            followed += indptr[node + 1] - indptr[node]
            for k in range(indptr[node], indptr[node + 1]):
                to = row * size + indices[k]
                to = to if to < waiting.size else to - waiting.size
                share = data[k] * mass
                if waiting[to] == 0.0 and share > 0.0:  # what is too small for a number is nothing
                    links[to], heads[to // size] = heads[to // size], to
                waiting[to] += share
    return followed


@compiled_loop
def follow_layer(
    mass: Array, position: Array,
    offsets: Array, indptr: Array, begins: Array, indices: Array, data: Array,
    charge: Array, growth: Array, layer: float, counted: Array, onward: Array, sums: Array,
) -> None:  # fmt: skip
    """Compiled: send the mass of a layer on by a choice; its measures.

    Args:
        mass: [nodes].
        position: of the chosen pair among those of each node, [nodes].
        offsets: pairs of each node, [nodes + 1].
        indptr: where the columns of each pair begin, [pairs + 1].
        begins: and where its numbers do, [pairs].
        indices: columns.
        data: numbers.
        charge: of arriving, [pairs].
        growth: what a unit of the total adds to it, [pairs] or empty.
        layer: the total paid.
        counted: beside the charge, [pairs, counted].
        onward: mass of what the columns stand for, added to, [columns].
        sums: the measures, and what was rounded off them, [1 + counted, 2], added to.
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
        for j in range(terms.size):  # what a sum loses is kept beside it
            term = mass[s] * terms[j]
            whole = sums[j, 0] + term
            if abs(sums[j, 0]) >= abs(term):
                sums[j, 1] += (sums[j, 0] - whole) + term
            else:
                sums[j, 1] += (term - whole) + sums[j, 0]
            sums[j, 0] = whole
        first, begin = indptr[pair], begins[pair]
        for k in range(indptr[pair + np.uint64(1)] - first):
            onward[indices[first + k]] += mass[s] * data[begin + k]


@one_or_all_cores
def stream_marks(
    decision: Array, acting: Array, pair_offsets: Array,
    offsets: Array, successors: Array, probabilities: Array, classes: Array,
    leads: Array, order: Array, hopeful: Array,
) -> None:  # fmt: skip
    """Compiled: mark, layer by layer backwards, where decisions may lead to a marked state.

    Where free steps go round, a layer is gone over until nothing is marked any more.

    Args:
        decision: position in the state's pairs, negative where none is taken, [layers, states].
        acting: states at which episodes go on, [states].
        pair_offsets: [states + 1].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: of the step costs, [outcomes]; empty: all outcomes are of class 0.
        leads: layers that each class of steps passes, [classes].
        order: states, each after those that its free steps lead to, as far as may be, [states].
        hopeful: written, [layers and those behind them, states].
    """
    n_layers, n = decision.shape
    stays = leads.min() == 0
    for back in range(n_layers):
        layer, marked = n_layers - 1 - back, 1
        while marked > 0:
            marked = 0
            for i in prange(n):
                s = order[i]
                if decision[layer, s] >= 0 and acting[s] and not hopeful[layer, s]:
                    pair = pair_offsets[s] + decision[layer, s]
                    for outcome in range(offsets[pair], offsets[pair + 1]):
                        step = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                        later = layer + leads[step]
                        if probabilities[outcome] > 0.0 and hopeful[later, successors[outcome]]:
                            hopeful[layer, s] = True
                            marked += 1
                            break
            if not stays:
                break
