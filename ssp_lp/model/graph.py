"""The graph of a model or a process: successors, components, and reachability of the goal.

Facts about a model, such as its dead-ends, are computed once and stored with the model.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    csr_of,
    entries_of,
    narrow,
    offsets_of,
    read_only,
    run_starts,
    segment_ids,
    sorted_unique,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time

if TYPE_CHECKING:
    from ssp_lp.model.ssp import SSP

Fact = TypeVar("Fact")

_FAR = np.iinfo(np.int32).max - 1  # distance of states that cannot be reached
_MANY_OUTCOMES = 128_000  # from which a short search saves a round of long ones
_SEARCH = "graphs.take_from_queue"  # the compiled search
_FEW, _FEW_ENTRIES = 32, 128  # states, and their predecessors, that a loop handles faster


@dataclass(frozen=True, eq=False)
class _Predecessors:
    """The pairs that lead to each state with positive probability, ascending.

    A pair is listed once for each of its outcomes with that successor.
    """

    offsets: IntArray  # [states + 1] entries of state s: offsets[s] : offsets[s + 1]
    pairs: IntArray  # [entries]


@dataclass(frozen=True, eq=False, repr=False)
class Graph:
    """A graph of pairs and their successors, of a model or of a process."""

    pair_offsets: IntArray  # [states + 1] pairs of state s: pair_offsets[s] : pair_offsets[s + 1]
    outcome_offsets: IntArray  # [pairs + 1] outcomes of pair k, likewise
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes], each pair's sum to one

    @cached_property
    def n_states(self) -> int:
        """Number of states, goals included."""
        return len(self.pair_offsets) - 1

    @cached_property
    def n_pairs(self) -> int:
        """Number of state-action pairs."""
        return len(self.outcome_offsets) - 1

    @cached_property
    def n_outcomes(self) -> int:
        """Number of outcomes of all pairs."""
        return len(self.successors)

    @cached_property
    def pair_state(self) -> IntArray:
        """State of each pair, [pairs]."""
        return read_only(segment_ids(self.pair_offsets))

    @cached_property
    @with_twin
    def predecessors(self) -> _Predecessors:
        """Pairs that may lead to each state: the reversed graph; computed on first use."""
        arrays = self.outcome_offsets, self.successors, self.probabilities
        if accelerated(self.n_outcomes, "graphs.count_and_place"):
            from ssp_lp.compiled.graphs import transpose

            offsets, pairs = transpose(self.n_states, *arrays)
        else:
            ends, columns = possible_steps(*arrays)
            present, shape = np.ones(columns.size, dtype=np.bool_), (self.n_pairs, self.n_states)
            ends = narrow(ends)
            rows = csr_of(present, columns.astype(ends.dtype, copy=False), ends, shape).tocsc()
            offsets, pairs = rows.indptr.astype(np.int64), rows.indices.astype(np.int32, copy=False)
        return _Predecessors(read_only(offsets), read_only(pairs))


def possible_steps(
    outcome_offsets: IntArray,
    successors: IntArray,
    probabilities: FloatArray,
    chosen: BoolArray | None = None,
) -> tuple[IntArray, IntArray]:
    """Return the edges of a graph: the outcomes of positive probability.

    Args:
        outcome_offsets: [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        chosen: mask of the pairs whose outcomes are used, [pairs]; None: all pairs.

    Returns:
        Offsets: pair k has the edges ``offsets[k] : offsets[k + 1]``, [pairs + 1]; and the
        successor of each edge, [edges].
    """
    check_time()
    kept = probabilities > 0
    if chosen is not None:
        kept &= np.repeat(chosen, np.diff(outcome_offsets))
    if kept.all():
        return np.asarray(outcome_offsets), successors
    return offsets_of(kept.view(np.int8))[outcome_offsets], successors[kept]


def stored_with_model(find: Callable[[SSP], Fact]) -> Callable[[SSP], Fact]:
    """Decorate a function of a model so that its result is computed once and stored with the model.

    Arrays in the result become read-only.
    """

    @wraps(find)
    def _fact(model: SSP) -> Fact:
        facts = model.cached_facts
        if find.__name__ not in facts:
            check_time()
            fact = find(model)
            for array in fact if isinstance(fact, tuple) else (fact,):
                if isinstance(array, np.ndarray):
                    array.flags.writeable = False
            facts[find.__name__] = fact
        result: Fact = facts[find.__name__]
        return result

    return _fact


@stored_with_model
def hopeless_states(model: SSP) -> BoolArray:
    """Return the states from which no policy reaches the goal, X_{d,all}, [states]."""
    return ~reaching_states(model, model.goal_mask)


def dead_ends(model: SSP) -> BoolArray:
    """Return the dead-ends: states in which a run ends without the goal, [states].

    In an ordinary model these are the hopeless states, from which no policy reaches the goal. In a
    product with the failure label only some hopeless states are dead-ends, since in the others a
    run may continue after failing.
    """
    label = model.failure_label
    return hopeless_states(model) if label is None else label.ended


def reaching_states(model: Graph, ends: BoolArray) -> BoolArray:
    """Return the states from which some policy may reach one of the given states, [states].

    Args:
        ends: mask of the given states, [states].
    """
    before, home, frontier = model.predecessors, model.pair_state, ends.nonzero()[0]
    if not accelerated(len(before.pairs), _SEARCH):
        return reached_along(home[before.pairs], before.offsets, frontier)
    wanted = (~ends).astype(np.int64)
    drain(model, np.ones(len(home), dtype=np.bool_), wanted, frontier)
    return np.asarray(wanted <= 0)


@stored_with_model
def attention_states(model: SSP) -> BoolArray:
    """Return the states from which some policy surely avoids the goal, X_{d,or}, [states].

    They form the greatest set of non-goal states in which each state has no action, or an action
    whose successors all lie in the set (section 2.3). Dead-ends belong to the set. The complement
    is computed: the least set that contains the goals, and every state all of whose actions may
    lead into the set.
    """
    open_pairs = np.ones(model.n_pairs, dtype=np.bool_)
    open_counts = np.diff(model.pair_offsets)
    idle = open_counts == 0
    drain(model, open_pairs, open_counts, model.goal_mask.nonzero()[0])
    return np.asarray(~model.goal_mask & (idle | (open_counts > 0)))


@stored_with_model
def surely_reaching(model: SSP) -> tuple[BoolArray, BoolArray, IntArray]:
    """Return the states from which some policy reaches the goal with probability one, and a policy.

    The greatest set of states each of which can reach the goal by pairs that never leave the set.
    In rounds, states that cannot reach the goal are dropped, with all pairs that may lead to them.

    Returns:
        A mask of the states, goals included, [states]; a mask of the pairs that never leave them,
        [pairs]; and the policy: for each state one of these pairs, which may lead nearer to the
        goal, -1 at goals and outside the mask, [states].
    """
    hopeless = hopeless_states(model) if model.n_outcomes > _MANY_OUTCOMES else None
    return surely_ending(model, model.goal_mask, hopeless)


def surely_ending(
    model: Graph, ends: BoolArray, hopeless: BoolArray | None = None
) -> tuple[BoolArray, BoolArray, IntArray]:
    """Return the states from which some policy surely reaches an end, and a policy.

    The results are those of :func:`surely_reaching`, with ``ends`` in place of the goals.

    Args:
        model: the graph.
        ends: states in which a run ends, [states].
        hopeless: mask of the states from which no policy reaches one of ``ends``, [states]; None:
            not known.
    """
    open_pairs = np.ones(len(model.pair_state), dtype=np.bool_)
    open_counts = np.diff(model.pair_offsets) + ends  # so that ``ends`` are never closed
    lost = open_counts == 0 if hopeless is None else hopeless
    while True:
        open_pairs &= ~lost[model.pair_state]
        open_counts[lost] = 0
        drain(model, open_pairs, open_counts, lost.nonzero()[0])
        kept = open_counts > 0
        nearer = nearer_pairs(model, None, open_pairs, ends=ends)
        lost = kept & ~ends & (nearer < 0)
        if not lost.any():
            return kept, open_pairs, nearer


def pairs_into(model: Graph, states: BoolArray) -> BoolArray:
    """Return the pairs that may lead to one of the given states, [pairs].

    Args:
        states: mask of the given states, [states].
    """
    check_time()
    ends = narrow(model.outcome_offsets)
    columns = model.successors.astype(ends.dtype, copy=False)
    steps = csr_of(model.probabilities, columns, ends, (model.n_pairs, model.n_states))
    return np.asarray(steps @ states.astype(np.float64) > 0.0)


def attention_pairs(model: SSP, attention: BoolArray) -> BoolArray:
    """Return the pairs of attention states whose successors are all attention states, [pairs].

    Args:
        attention: the result of :func:`attention_states`, [states].
    """
    return np.asarray(attention[model.pair_state] & ~pairs_into(model, ~attention))


def reached_along(columns: IntArray, offsets: IntArray, start: IntArray) -> BoolArray:
    """Return a mask of the states that can be reached from the start along edges, [states].

    Args:
        columns: target of each edge, [edges].
        offsets: state s has the edges ``offsets[s] : offsets[s + 1]``, [states + 1].
        start: indices of the states in which the search begins.
    """
    n_states = len(offsets) - 1
    linked = np.concatenate([columns, np.asarray(start, dtype=columns.dtype)])
    graph = edges(linked, np.append(offsets, linked.size))
    check_time()
    order = sp.csgraph.breadth_first_order(graph, n_states, return_predecessors=False)
    mask = np.zeros(n_states + 1, dtype=np.bool_)
    mask[order] = True
    return mask[:n_states]


def edges(columns: IntArray, offsets: IntArray) -> sp.csr_array:
    """Return the adjacency matrix of a graph for scipy: every weight is 1, stored once."""
    weights: FloatArray = np.broadcast_to(np.float64(1.0), columns.shape)
    shape, offsets = (len(offsets) - 1, len(offsets) - 1), narrow(offsets)
    return csr_of(weights, columns.astype(offsets.dtype, copy=False), offsets, shape)


@stored_with_model
def goal_approach(model: SSP) -> tuple[IntArray, IntArray]:
    """Return for each state a pair on a shortest path to a goal, and the length of the path.

    Returns:
        The pairs, -1 at goals and where no goal can be reached, [states]; and the lengths in steps,
        0 where there is no pair, [states].
    """
    distance = np.zeros(model.n_states, dtype=np.int32)
    return nearer_pairs(model, None, distance=distance, ends=model.goal_mask), distance


@with_twin
def nearer_pairs(
    graph: Graph,
    target_pairs: BoolArray | None,
    usable: BoolArray | None = None,
    distance: IntArray | None = None,
    *,
    ends: BoolArray | None = None,
) -> IntArray:
    """Return a pair of each state on a shortest path to a target: a pair or a state.

    A state that has a target pair takes it. Of several pairs at the least distance the first one is
    taken.

    Args:
        graph: graph of a model, or of a process.
        target_pairs: mask of the target pairs, [pairs]; None: none.
        usable: mask of the pairs that may be taken, also as targets, [pairs]; None: all.
        distance: array of zeros that is overwritten with the number of steps before a target pair
            is taken, or until a target state, [states] int32.
        ends: mask of the target states, if there are no target pairs, [states].

    Returns:
        The pair of each state; -1 in ``ends`` and where no target can be reached, [states].
    """
    before, pair_state, n = graph.predecessors, graph.pair_state, graph.n_states
    choice = np.full(n, -1, dtype=np.int64)
    if target_pairs is None:
        taken: IntArray = np.zeros(0, dtype=np.int64) if ends is None else ends.nonzero()[0]
    else:
        useful = (target_pairs if usable is None else target_pairs & usable).nonzero()[0]
        begun = useful[run_starts(pair_state[useful])]
        taken = pair_state[begun]
        choice[taken] = begun
    if accelerated(len(before.pairs), _SEARCH):
        from ssp_lp.compiled.graphs import search_backwards

        wanted = np.ones(n, dtype=np.int64)
        wanted[taken] = 0
        open_pairs = np.ones(len(pair_state), dtype=np.bool_) if usable is None else usable.copy()
        reversed_graph = before.offsets, before.pairs, pair_state
        search_backwards(reversed_graph, open_pairs, wanted, taken, choice, distance)
        return choice
    # Search breadth-first against the edges, from an added node n before all targets.
    # Unusable pairs are given to n itself, so that they reach no state. scipy returns the parent
    # of each state in the tree of the search, and doubling the jumps counts the steps to n.
    home = pair_state if usable is None else np.where(usable, pair_state, n)
    sources = np.concatenate([home[before.pairs], taken])
    links = edges(sources, np.append(before.offsets, sources.size))
    check_time()
    parent = sp.csgraph.breadth_first_order(links, n)[1]
    check_time()
    reached = parent >= 0
    steps, parent[~reached] = reached.astype(np.int32), n
    while (more := steps[parent]).any():
        steps += more
        parent = parent[parent]
    if distance is not None:
        distance[:] = steps[:n] - reached[:n]
    steps[:n][~reached[:n]] = _FAR
    after = np.repeat(steps[:n], np.diff(before.offsets)) + 1
    nearest = np.zeros(len(pair_state), dtype=np.bool_)
    nearest[before.pairs[steps[sources[: after.size]] == after]] = True
    best: IntArray = nearest.nonzero()[0]
    first = best[run_starts(pair_state[best])]
    choice[pair_state[first]] = first
    return choice


@with_twin
def drain(
    model: Graph, open_pairs: BoolArray, open_counts: IntArray, closed_states: IntArray
) -> None:
    """Close the pairs that may lead to a closed state, then states with no pair left, and so on.

    Args:
        open_pairs: mask of the open pairs, changed in place, [pairs].
        open_counts: number of open pairs of each state, changed in place, [states].
        closed_states: indices of the states that are closed first; they have no open pairs.
    """
    if not closed_states.size:
        return
    before = model.predecessors
    if accelerated(len(before.pairs), _SEARCH):
        from ssp_lp.compiled.graphs import search_backwards

        reversed_graph = before.offsets, before.pairs, model.pair_state
        search_backwards(reversed_graph, open_pairs, open_counts, closed_states)
        return
    while closed_states.size:
        check_time()
        entries = (before.offsets[closed_states + 1] - before.offsets[closed_states]).sum()
        if closed_states.size < _FEW and entries < _FEW_ENTRIES:
            closed_states = _drain_one_by_one(model, open_pairs, open_counts, closed_states)
            continue
        if _FEW * entries > model.n_outcomes:  # a pass over all pairs is faster
            closed = np.bincount(closed_states, minlength=model.n_states) > 0
            pairs: IntArray = (open_pairs & pairs_into(model, closed)).nonzero()[0]
        else:
            pairs = before.pairs[entries_of(before.offsets, closed_states)[0]]
            pairs = sorted_unique(pairs[open_pairs[pairs]])
        closed_states = close_pairs(model, open_pairs, open_counts, pairs)


def _drain_one_by_one(
    model: Graph, open_pairs: BoolArray, open_counts: IntArray, closed_states: IntArray
) -> IntArray:
    """Continue :func:`drain` one state at a time; if many states wait to be closed, return them."""
    before, waiting = model.predecessors, deque(closed_states.tolist())
    is_open, counts = open_pairs.data, open_counts.data  # faster entry by entry
    home_of, offsets = model.pair_state.data, before.offsets.data
    while 0 < len(waiting) < _FEW:
        check_time()
        state = waiting.popleft()
        for pair in before.pairs[offsets[state] : offsets[state + 1]].tolist():
            if is_open[pair]:
                is_open[pair] = False
                home = home_of[pair]
                counts[home] -= 1
                if counts[home] == 0:
                    waiting.append(home)
    return np.array(waiting, dtype=np.int64)


def close_pairs(
    model: Graph, open_pairs: BoolArray, open_counts: IntArray, pairs: IntArray
) -> IntArray:
    """Close open pairs, in place; return the states that have no open pair left."""
    open_pairs[pairs] = False
    state = model.pair_state[pairs]
    np.subtract.at(open_counts, state, 1)
    closed = state[open_counts[state] == 0]
    return np.asarray(closed[run_starts(closed)])


def end_marks(model: SSP) -> IntArray:
    """Return numbers that say how a run ends in each state; -1: the run goes on, [states].

    With k state labels in the model: 0 is the goal; 1 .. k are dead-ends with a label, numbered by
    their first label; k + 1 is a dead-end without a label; k + 2 is having given up.
    """
    if model.failure_label is not None:
        return model.failure_label.end_marks
    dead = dead_ends(model)
    mark = np.where(dead, len(model.state_labels) + 1, -1)
    for number, members in reversed(list(enumerate(model.state_labels.values(), start=1))):
        mark[members[dead[members]]] = number
    mark[model.goal_mask] = 0
    return mark


def stop_marks(model: SSP) -> IntArray:
    """Return numbers that say how a run ends if the policy stops it in each state, [states].

    The number is that of :func:`end_marks` for having given up. In the dead-ends of a product with
    the failure label, it is the number of the dead-end instead.
    """
    if model.failure_label is not None:
        return model.failure_label.stop_marks
    return np.full(model.n_states, len(model.state_labels) + 2)


def dead_end_labels(model: SSP) -> frozenset[Hashable]:
    """Return the labels of the dead-ends X_{d,all}, from which no policy reaches the goal."""
    return frozenset(model.states[i] for i in dead_ends(model).nonzero()[0].tolist())


def attention_labels(model: SSP) -> frozenset[Hashable]:
    """Return the labels of the attention states X_{d,or}: there a policy surely avoids the goal."""
    return frozenset(model.states[i] for i in attention_states(model).nonzero()[0].tolist())


def end_components(model: Graph, allowed: BoolArray) -> tuple[IntArray, BoolArray]:
    """Return the maximal end components of a graph, restricted to the allowed pairs.

    An end component is a set of states and of pairs whose successors all stay in the set, that is
    strongly connected by these pairs. In rounds, states and pairs that cannot stay among the
    allowed pairs are dropped, then pairs that leave their strong component; components that lost
    a pair are examined again.

    Args:
        model: the model, or a process.
        allowed: pairs that may be part of a component, in which no run ends, [pairs].

    Returns:
        The component of each state, [states], numbered from 0 in the order of their first states,
        -1 for a state in no component; and a mask of the pairs inside a component, [pairs].
    """
    inside = allowed.copy()
    component = np.full(model.n_states, -1, dtype=np.int64)
    if not inside.any():
        return component, inside
    counts = np.bincount(model.pair_state[inside], minlength=model.n_states)
    label = np.full(model.n_states, -1, dtype=np.int32)
    closed: IntArray = (counts == 0).nonzero()[0]
    pending = np.ones(model.n_states, dtype=np.bool_)
    while True:
        drain(model, inside, counts, closed)
        label[counts == 0] = -1
        pending &= counts > 0
        if not pending.any():
            break
        # each pending state is labelled by the first one of its strong component, by scipy
        links = inside & pending[model.pair_state]
        steps = model.outcome_offsets, model.successors, model.probabilities
        ends, columns = possible_steps(*steps, links)
        shape, present = (model.n_states, model.n_states), np.ones(columns.size, dtype=np.bool_)
        offsets = narrow(ends[model.pair_offsets])
        once = sp.csr_array((present, columns.copy(), offsets), shape=shape)
        once.sum_duplicates()
        check_time()
        strong = sp.csgraph.connected_components(
            edges(once.indices, once.indptr), connection="strong"
        )[1]
        _, first, back = np.unique(strong, return_index=True, return_inverse=True)
        label[pending] = first[back[pending]]
        here = label[model.pair_state].repeat(np.diff(model.outcome_offsets))
        away = (label[model.successors] != here) & (model.probabilities > 0)
        crossing = np.zeros(model.n_pairs, dtype=np.bool_)
        crossing[segment_ids(model.outcome_offsets)[away]] = True
        leaving = (links & crossing).nonzero()[0]
        torn = np.zeros_like(pending)
        torn[label[model.pair_state[leaving]]] = True
        closed = close_pairs(model, inside, counts, leaving)
        pending &= torn[label]
    members = counts > 0
    component[members] = np.unique(label[members], return_inverse=True)[1]
    return component, inside
