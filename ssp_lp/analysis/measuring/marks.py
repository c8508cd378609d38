"""What a run may still come to from each state of a layer, decided on the graph."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.analysis.measuring.moves import Staying
from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.model.graph.reachability import reached_along
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED

HOPEFUL, OPEN, WRONG, ENDLESS, FAILS = 1, 2, 4, 8, 16
"""Bits: the goal can be reached; some end can; a decision that is missing or not allowed can;
a loop that costs something and is never left can; failing can, where that is forbidden."""


def marks_of(
    pairs: IntArray,
    staying: Staying | None,
    met: IntArray,
    ended: IntArray,
    forbidden: BoolArray,
    *,
    forbids_failing: bool,
    paying: BoolArray | None,
) -> IntArray:
    """The marks of a layer's states, [states].

    Args:
        pairs: [states].
        staying: moves within the layer; None: there are none.
        met: marks that may be met in later layers, [states].
        ended: marks of goals and dead-ends, 0 elsewhere, [states].
        forbidden: where the policy may not give up, [states].
        forbids_failing: whether failing is forbidden.
        paying: states whose decision may cost something, where loops that are never left cost
            without end, [states]; None: nothing is paid in them.
    """
    quits, missing = pairs == GIVE_UP_CODE, pairs == UNDECIDED
    marks = met | ended
    marks[quits] |= OPEN | (FAILS if forbids_failing else 0)
    marks[missing | (quits & forbidden)] |= WRONG
    acting = ended == 0
    for bit in (HOPEFUL, OPEN):
        _spread(marks, bit, staying)
    if forbids_failing:
        marks[acting & ((marks & HOPEFUL) == 0)] |= FAILS
    if paying is not None and staying is not None:
        never = acting & ((marks & OPEN) == 0)
        marks[closed_states(staying.share, staying.onward, never) & paying] |= ENDLESS
    for bit in (WRONG, ENDLESS, FAILS):
        _spread(marks, bit, staying)
    return marks


def _spread(marks: IntArray, bit: int, staying: Staying | None) -> None:
    """Mark, in place, all states from which a marked one can be reached within the layer."""
    begins = np.flatnonzero(marks & bit)
    if staying is None or not begins.size or begins.size == marks.size:
        return
    backward = staying.share.tocsc()
    marks[reached_along(backward.indices, backward.indptr, begins)] |= bit


def closed_states(share: sp.csr_array, onward: FloatArray, among: BoolArray) -> BoolArray:
    """States of classes that are never left, [states].

    Args:
        share: moves, [states, states].
        onward: probability of leaving otherwise, [states].
        among: states outside of which every move leaves, [states].
    """
    _, label = csgraph.connected_components(share, connection="strong")
    entry = share.tocoo()
    leaves = ~among | (onward > 0.0)
    leaves[entry.row[label[entry.row] != label[entry.col]]] = True
    return np.asarray(~np.isin(label, np.unique(label[leaves])))
