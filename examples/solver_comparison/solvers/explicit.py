"""The augmented process written out state by state, the input of the comparison's peers."""

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from examples.solver_comparison.instances.models import ReadyInstance
from ssp_lp.processes.explicit_process import ExplicitProcess


def written_out(ready: ReadyInstance) -> ExplicitProcess:
    """Return the part of an instance's augmented process that its start can reach.

    Instances without a budget use the process of case M.

    Raises:
        ValueError: case S without a cap on accumulated cost has no finite process.
    """
    if ready.instance.case == "S" and ready.instance.cost_cap is None:
        raise ValueError(f"only a cap can be written out: {ready.instance.name}80")
    if ready.instance.case in "PC":
        ready = replace(ready, instance=replace(ready.instance, case="M"))
    return reachable_part(ready.problem().compile().explicit())


def reachable_part(process: ExplicitProcess) -> ExplicitProcess:
    """Return a process without the states that its start cannot reach."""
    kept = _reachable(process)
    pairs = kept[process.pair_state]
    counts = np.diff(process.pair_offsets)[kept]
    return ExplicitProcess(
        pair_offsets=np.concatenate([[0], np.cumsum(counts)]),
        transitions=sp.csr_array(process.transitions[pairs][:, kept]),
        start=process.start[kept],
        cost=process.cost[pairs],
        failure=process.failure[pairs],
        goal=process.goal[pairs],
    )


def describe(process: ExplicitProcess) -> str:
    """Return all sizes of a process in words."""
    return (
        f"written out: {process.n_states:,} states, {process.n_pairs:,} pairs, "
        f"{process.transitions.nnz:,} transitions"
    )


def size_of(process: ExplicitProcess) -> str:
    """Return the size of a process in a few words."""
    return f"{process.n_states:,} states written out"


def _reachable(process: ExplicitProcess) -> np.ndarray:
    """Return whether a state can be reached from the start, breadth-first, [states]."""
    n = process.n_states
    entries, steps = np.flatnonzero(process.start), process.transitions
    ends = np.append(steps.indptr[process.pair_offsets], steps.nnz + len(entries))
    columns = np.concatenate([steps.indices, entries]).astype(np.int32)
    follows = sp.csr_array((np.ones(len(columns), dtype=np.int8), columns, ends), (n + 1, n + 1))
    order = csgraph.breadth_first_order(follows, n, return_predecessors=False)
    kept = np.zeros(n + 1, dtype=np.bool_)
    kept[order] = True
    return kept[:n]
