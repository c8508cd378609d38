"""Reward structures of PRISM's explicit files: which there are, and what each outcome costs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.decimals import decimal_sum
from ssp_lp.io.model_files.prism_text import read_table, structure_name


class Transitions(NamedTuple):
    """The transitions of a file, sorted by state and choice."""

    n_states: int
    keys: IntArray  # [outcomes, 3] state, choice, successor; [outcomes, 2] in a Markov chain


class Structure(NamedTuple):
    """The files of one reward structure."""

    name: str | None
    of_states: Path | None
    of_transitions: Path | None


def existing(base: Path, ending: str) -> Path | None:
    """The file with this ending, plain or gzip; None where there is none."""
    for name in (base.name + ending, base.name + ending + ".gz"):
        if (base.parent / name).is_file():
            return base.parent / name
    return None


def chosen_structure(base: Path, cost: str | None) -> Structure | None:
    """The reward structure that is the cost; None where there are no files of rewards.

    Args:
        base: the path of the files without an ending.
        cost: the structure's name; None: the only one.

    Raises:
        ModelError: there is none of this name, or several to choose from.
    """
    found = [_structure(base, ""), _structure(base, "1")]
    while found[-1] is not None:
        found.append(_structure(base, str(len(found))))
    structures = [structure for structure in found if structure is not None]
    if cost is not None:
        structures = [structure for structure in structures if structure.name == cost]
    if len(structures) == 1 or (cost is None and not structures):
        return structures[0] if structures else None
    names = ", ".join(repr(s.name) for s in found if s is not None) or "none"
    raise ModelError(f"{base}: choose one of the reward structures, cost=...: {names}")


def _structure(base: Path, number: str) -> Structure | None:
    """The structure whose files bear a number."""
    of_states = existing(base, f"{number}.srew")
    of_transitions = existing(base, f"{number}.trew")
    named = of_transitions or of_states
    if named is None:
        return None
    return Structure(structure_name(named), of_states, of_transitions)


def outcome_costs(structure: Structure, transitions: Transitions) -> FloatArray:
    """The reward of each outcome: of the state, and of the transition, [outcomes].

    Raises:
        ModelError: naming the file and what does not fit the transitions.
    """
    keys = transitions.keys
    of_state, of_transition = np.zeros(transitions.n_states), np.zeros(keys.shape[0])
    if structure.of_states is not None:
        table = read_table(structure.of_states, {2: 1})
        state = table.keys[:, 0]
        _check(structure.of_states, transitions.n_states, table.header, state)
        of_state[state] = table.values
    if structure.of_transitions is not None:
        width = keys.shape[1]
        table = read_table(structure.of_transitions, {width: width})
        _check(structure.of_transitions, transitions.n_states, table.header, table.keys[:, 0])
        of_transition = _matched(table.keys, table.values, keys, structure.of_transitions)
    return decimal_sum(of_transition, of_state[keys[:, 0]])


def _matched(listed: IntArray, values: FloatArray, keys: IntArray, path: Path) -> FloatArray:
    """The values listed for some rows of keys, 0 for the others, [keys].

    Raises:
        ModelError: a row is listed twice, or is none of the keys.
    """
    both = np.concatenate([listed, keys])
    order = np.lexsort(both.T[::-1])
    new = np.ones(order.size, dtype=np.bool_)
    new[1:] = (np.diff(both[order], axis=0) != 0).any(axis=1)
    row = np.empty(order.size, dtype=np.int64)
    row[order] = np.cumsum(new) - 1
    wanted, known = row[: listed.shape[0]], row[listed.shape[0] :]
    uses = np.bincount(wanted, minlength=order.size)
    exists = np.zeros(order.size, dtype=np.bool_)
    exists[known] = True
    if (uses > 1).any() or not exists[wanted].all():
        raise ModelError(f"{path}: a transition is there twice, or does not exist")
    paid = np.zeros(order.size)
    paid[wanted] = values
    return paid[known]


def _check(path: Path, n_states: int, header: Sequence[int], state: IntArray) -> None:
    """Raise :class:`ModelError` unless a file of rewards is one of these states."""
    if header[0] != n_states or (state < 0).any() or (state >= n_states).any():
        raise ModelError(f"{path}: the states are not the {n_states} of the transitions")
    if header[-1] != state.size:
        raise ModelError(f"{path}: the header says {header[-1]} rewards, there are {state.size}")
