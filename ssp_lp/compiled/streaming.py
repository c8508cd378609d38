"""Compiled passes over one layer of a policy's chain, read off the model's outcomes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.compiled.cores import one_or_all_cores

Array = np.ndarray[Any, Any]


@njit(cache=True)
def stream_mass(
    mass: Array, pairs: Array, offsets: Array, successors: Array, probabilities: Array,
    classes: Array, slots: Array, waiting: Array,
) -> None:  # fmt: skip
    """Send the mass of a layer on to later ones, in place; one core: the sums keep their order.

    Args:
        mass: [states].
        pairs: of each state, negative where none is taken, [states].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: of the step costs, [outcomes]; empty: all outcomes are of class 0.
        slots: where the layer lies that a class of steps leads to, -1: this one, [classes].
        waiting: written, [slots, states].
    """
    for s in range(pairs.size):
        if pairs[s] >= 0 and mass[s] > 0.0:
            for outcome in range(offsets[pairs[s]], offsets[pairs[s] + 1]):
                kind = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                if slots[kind] >= 0:
                    waiting[slots[kind], successors[outcome]] += mass[s] * probabilities[outcome]


@njit(cache=True)
def stream_layers(
    waiting: Array, heads: Array, links: Array,
    indptr: Array, indices: Array, data: Array, first: int, arrived: Array,
) -> int:  # fmt: skip
    """Settle layers of a ring one after the other: send their mass on, and say what arrives.

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


@njit(cache=True)
def follow_layer(
    mass: Array, position: Array,
    offsets: Array, indptr: Array, begins: Array, indices: Array, data: Array,
    charge: Array, growth: Array, layer: float, gain: Array, failure: Array, survival: float,
    onward: Array, sums: Array,
) -> None:  # fmt: skip
    """Send the mass of a layer on by a choice, and add up what it is charged, fails and arrives.

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
        gain: [pairs].
        failure: [pairs].
        survival: the discount.
        onward: mass of what the columns stand for, added to, [columns].
        sums: charge, failure and goal, and what was rounded off them, [3, 2], added to.
    """
    terms = np.zeros(3)
    for s in range(mass.size):
        if mass[s] <= 0.0:
            continue
        pair = offsets[s] + np.uint64(position[s])
        stage = charge[pair]
        if layer != 0.0:
            stage += layer * growth[pair]
        terms[0], terms[1], terms[2] = stage, failure[pair], survival * gain[pair]
        for j in range(3):  # what a sum loses is kept beside it
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


@njit(cache=True)
def stream_arrivals(
    pairs: Array, offsets: Array, successors: Array, probabilities: Array, classes: Array,
    slots: Array, arriving: Array,
) -> None:  # fmt: skip
    """Mark where the moves of a layer to later ones may arrive, in place.

    Args:
        pairs: of each state that is left, negative where none is taken, [k].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: of the step costs, [outcomes]; empty: all outcomes are of class 0.
        slots: where the layer lies that a class of steps leads to, -1: this one, [classes].
        arriving: marked, [slots, states].
    """
    for s in range(pairs.size):
        if pairs[s] >= 0:
            for outcome in range(offsets[pairs[s]], offsets[pairs[s] + 1]):
                kind = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                if slots[kind] >= 0 and probabilities[outcome] > 0.0:
                    arriving[slots[kind], successors[outcome]] = True


@one_or_all_cores
def stream_hope(
    decision: Array, acting: Array, pair_offsets: Array,
    offsets: Array, successors: Array, probabilities: Array, classes: Array,
    leads: Array, order: Array, hopeful: Array,
) -> None:  # fmt: skip
    """Mark where decisions may lead to what is marked, from the last layer on.

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
                        kind = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                        later = layer + leads[kind]
                        if probabilities[outcome] > 0.0 and hopeful[later, successors[outcome]]:
                            hopeful[layer, s] = True
                            marked += 1
                            break
            if not stays:
                break


@one_or_all_cores
def stream_totals(
    pairs: Array, offsets: Array, successors: Array, probabilities: Array, classes: Array,
    slots: Array, costs: Array, worth: Array, marks: Array, priced: Array,
    sums: Array, found: Array,
) -> None:  # fmt: skip
    """Expected totals after moves to later layers, and the marks that may be met there.

    Args:
        pairs: of each state that is asked for, negative where none is taken, [k].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: of the step costs, [outcomes]; empty: all outcomes are of class 0.
        slots: where the layer lies that a class of steps leads to, -1: this one, [classes].
        costs: [totals that are priced, classes].
        worth: totals from there on, [slots, states, columns].
        marks: bits, [slots, states].
        priced: columns (from, to): the worth in one, times the cost, counts in the other, [.., 2].
        sums: written, [k, columns].
        found: written, [k].
    """
    n_columns = sums.shape[1]
    for s in prange(pairs.size):
        found[s] = 0
        for k in range(n_columns):
            sums[s, k] = 0.0
        if pairs[s] < 0:
            continue
        begin, end = offsets[pairs[s]], offsets[pairs[s] + 1]
        for first in range(0, n_columns, 4):  # four at a time, in registers
            last = n_columns - 1
            second, third, fourth = min(first + 1, last), min(first + 2, last), min(first + 3, last)
            one, two, three, four = 0.0, 0.0, 0.0, 0.0
            for outcome in range(begin, end):
                kind = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                slot, share = slots[kind], probabilities[outcome]
                if slot < 0 or share <= 0.0:
                    continue
                to = successors[outcome]
                if first == 0:
                    found[s] |= marks[slot, to]
                one += share * worth[slot, to, first]
                two += share * worth[slot, to, second]
                three += share * worth[slot, to, third]
                four += share * worth[slot, to, fourth]
            sums[s, first], sums[s, second] = one, two
            sums[s, third], sums[s, fourth] = three, four
        for j in range(priced.shape[0]):
            paid = 0.0
            for outcome in range(begin, end):
                kind = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                slot, share = slots[kind], probabilities[outcome]
                if slot >= 0 and share > 0.0:
                    paid += share * costs[j, kind] * worth[slot, successors[outcome], priced[j, 0]]
            sums[s, priced[j, 1]] += paid
