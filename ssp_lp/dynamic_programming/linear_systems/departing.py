"""Rows of a process seen only when it departs from where it is."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray


def without_self_loops(
    rows: sp.csr_array, home: IntArray, leak: FloatArray
) -> tuple[sp.csr_array, FloatArray]:
    """Rows of transitions seen only when the process departs from where it is.

    Waiting in place changes no total but divides everything else by the probability of departing.
    That is summed from what leaves, never formed as 1 - p, which would cancel for slow loops.

    Args:
        rows: [rows, states], without duplicates.
        home: the state that each row belongs to, [rows].
        leak: mass of each row that goes elsewhere than into ``rows``, [rows].

    Returns:
        The rows without self-loops, divided by the probability of departing, and that
        probability, [rows]. A row that never departs is left as it is, with 1.
    """
    entry = rows.tocoo()
    away = entry.col != home[entry.row]
    departs = leak + np.bincount(entry.row[away], weights=entry.data[away], minlength=rows.shape[0])
    kept = away | (departs[entry.row] == 0)
    departs = np.where(departs == 0, 1.0, departs)
    loops = np.zeros(rows.shape[0], dtype=np.bool_)
    loops[entry.row[~away]] = True
    departs = np.where(loops, departs, 1.0)  # rows without a self-loop depart for sure
    scaled = entry.data[kept] / departs[entry.row[kept]]
    return sp.csr_array((scaled, (entry.row[kept], entry.col[kept])), shape=rows.shape), departs
