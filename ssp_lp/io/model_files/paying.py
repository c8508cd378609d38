"""States that pay the rest of a step, as we write them for other tools: taken out on reading."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.io.model_files.decimals import decimal_sum
from ssp_lp.io.model_files.raw_model import INITIAL, PAY, PAYING, RawModel, offsets_of


def without_paying_states(raw: RawModel, goals: IntArray) -> RawModel:
    """Give outcomes the cost that is paid in a state of its own.

    Such a state has the label "paying", one action, "pay", and one certain successor; it is what
    :func:`ssp_lp.io.model_files.exported.exported` makes where the outcomes of an action differ in
    cost. What is counted until a failure then holds the whole step again.

    Args:
        raw: what a file says.
        goals: the goal states.
    """
    paying = _paying(raw, goals)
    if not paying.any() or not (raw.costs >= 0.0).all():  # no sum may hide a wrong cost
        return raw
    sizes = np.diff(raw.outcome_offsets)
    # each paying state's one outcome, at other states anything
    firsts = np.minimum(raw.outcome_offsets[raw.pair_offsets[:-1]], raw.successors.size - 1)
    through = paying[raw.successors]
    rest = np.where(through, raw.costs[firsts[raw.successors]], 0.0)
    targets = np.where(through, raw.successors[firsts[raw.successors]], raw.successors)
    costs = decimal_sum(raw.costs, rest, raw.exact_costs)
    number = np.cumsum(~paying) - 1
    counts = np.diff(raw.pair_offsets)
    pairs = np.repeat(~paying, counts)
    outcomes = np.repeat(pairs, sizes)
    labels = {name: number[at[~paying[at]]] for name, at in raw.labels.items()}
    if not labels[PAYING].size:
        del labels[PAYING]
    kept = np.flatnonzero(~paying).tolist()
    return raw._replace(
        pair_offsets=offsets_of(counts[~paying]),
        outcome_offsets=offsets_of(sizes[pairs]),
        successors=number[targets[outcomes]],
        probabilities=raw.probabilities[outcomes],
        costs=costs[outcomes],
        actions=raw.actions and [raw.actions[k] for k in np.flatnonzero(pairs).tolist()],
        labels=labels,
        states=raw.states and [raw.states[k] for k in kept],
    )


def _paying(raw: RawModel, goals: IntArray) -> BoolArray:
    """Which states do nothing but pay, [states]."""
    n_states = raw.pair_offsets.size - 1
    paying = np.zeros(n_states, dtype=np.bool_)
    marked = raw.labels.get(PAYING)
    if marked is None or raw.actions is None:
        return paying
    paying[marked] = True
    paying[goals] = False
    paying[raw.labels.get(INITIAL, goals)] = False
    for state in np.flatnonzero(paying).tolist():
        pair, end = raw.pair_offsets[state : state + 2].tolist()
        paying[state] = end == pair + 1 and raw.actions[pair] == PAY and _is_certain(raw, pair)
    marked = np.flatnonzero(paying)
    followed = raw.successors[raw.outcome_offsets[raw.pair_offsets[marked]]]
    paying[marked[paying[followed]]] = False  # none pays for another
    return paying


def _is_certain(raw: RawModel, pair: int) -> bool:
    """Whether a pair has one outcome."""
    first, end = raw.outcome_offsets[pair : pair + 2].tolist()
    return bool(end == first + 1 and raw.probabilities[first] == 1.0)
