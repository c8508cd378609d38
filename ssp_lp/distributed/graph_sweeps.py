"""Searches of a graph whose pairs lie with several ranks: each sweeps its own, until nothing moves.

What is found is told to those who ask for it after each sweep, as one truth value for each state.
Within a sweep a rank goes as far as its own pairs lead, so that there are as many sweeps as a path
crosses ranks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.errors import optional_module
from ssp_lp.model.graph import Graph, drain, nearer_pairs, pairs_into, reaching_states

Told = Callable[[BoolArray], BoolArray]
"""What a sweep of this rank has found, [states], put together with what others have."""


def on_any(comm: Any, mask: BoolArray) -> BoolArray:
    """What some rank's sweep has found, [states]: all ranks know all states.

    Args:
        comm: of mpi4py.
        mask: what this one has found, [states].
    """
    found = np.empty_like(mask)
    comm.Allreduce(mask, found, op=optional_module("mpi4py.MPI", "distributed").LOR)
    return found


def reaching(comm: Any, told: Told, graph: Graph, ends: BoolArray) -> BoolArray:
    """States from which sweeps find a way to one of the given states, these included, [states].

    Args:
        comm: of mpi4py.
        told: exchanges what is found.
        graph: the states that this rank knows, and the pairs of its own.
        ends: the same on every rank that knows the state, [states].
    """
    while True:
        found = told(reaching_states(graph, ends))
        if not comm.allreduce(not np.array_equal(found, ends)):
            return found
        ends = found


def staying(
    comm: Any, told: Told, graph: Graph, own: BoolArray, usable: BoolArray, outside: BoolArray
) -> BoolArray:
    """The greatest set of states that sweeps find each to have a pair which stays in it, [states].

    Args:
        comm: of mpi4py.
        told: exchanges what is found.
        graph: the states that this rank knows, and the pairs of its own.
        own: states of this rank, [states].
        usable: pairs that may be taken, [pairs].
        outside: states that are not in it, the same on every rank, [states]; all others that have
            no pairs at all are.
    """
    acting = np.diff(graph.pair_offsets) > 0
    open_pairs = usable & ~outside[graph.pair_state]
    counts = np.bincount(graph.pair_state[open_pairs], minlength=graph.n_states)
    closed, known = outside, np.zeros_like(outside)
    while True:
        closed = told(closed | (own & acting & (counts == 0)))
        moved = closed & ~known
        if not comm.allreduce(bool(moved.any())):
            return ~closed
        drain(graph, open_pairs, counts, moved.nonzero()[0])
        known = closed


def approaching(comm: Any, told: Told, graph: Graph, leaving: BoolArray) -> IntArray:
    """A pair of each own state that comes nearer to a leaving pair, sweep by sweep, [states].

    Every such pair may lead to a state from which fewer sweeps, or fewer steps of one, are left.

    Args:
        comm: of mpi4py.
        told: exchanges what is found.
        graph: the states that this rank knows, and the pairs of its own.
        leaving: [pairs].

    Returns:
        [states] the pair, of this rank's; -1 at states of others, and where there is no way.
    """
    choice, reached = np.full(graph.n_states, -1), np.zeros(graph.n_states, dtype=np.bool_)
    while True:
        nearer = nearer_pairs(graph, leaving)
        choice = np.where(choice < 0, nearer, choice)
        found = told(reached | (choice >= 0))
        if not comm.allreduce(not np.array_equal(found, reached)):
            return choice
        leaving, reached = leaving | pairs_into(graph, found), found
