"""PRISM's explicit files, read: .tra, .lab, .sta, .srew and .trew beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, count
from pathlib import Path

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, offsets_of
from ssp_lp.errors import Argument, ModelError
from ssp_lp.io.model_files.decimals import decimal_sum
from ssp_lp.io.model_files.prism_text import (
    Table,
    read_labels,
    read_states,
    read_table,
    structure_name,
)
from ssp_lp.io.model_files.raw_model import (
    ModelFile,
    RawModel,
    distinct_actions,
    finished,
)
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.model.arguments import explained


@explained
def read_prism(path: FilePath, *, goal: str, cost: str | None = None) -> ModelFile:
    """Read a Markov decision process or Markov chain from PRISM's explicit files.

    The files are ``path.tra`` and ``path.lab``; where they are there, ``path.sta``, which names
    the states; and rewards, ``path.srew`` and ``path.trew``, or ``path1.srew`` and so on for
    several structures. Each may be gzip, with a further .gz. The cost of an outcome is the reward
    of its transition plus that of its state. Actions of goal states are dropped, and of states
    with the label "deadlock" that no action leaves: they are dead-ends.

    Args:
        path: the path of the files without an ending, or that of the .tra file.
        goal: the label of the goal states.
        cost: the name of a reward structure; None: the only one, or 1 for each action if there is
            none.

    Returns:
        The model and its initial states: those with the label "init", or state 0.

    Raises:
        ModelError: naming the file and the line, or the state and the action.
    """
    base = without_ending(path)
    transitions, labels = _existing_prism_file(base, ".tra"), _existing_prism_file(base, ".lab")
    if transitions is None or labels is None:
        raise ModelError(f"{base}.tra and {base}.lab must be there")
    table = read_table(transitions, {2: 2, 3: 3})
    n_states = table.header[0]
    raw, keys = _sorted_prism_rows(table, transitions)
    structure = _chosen_prism_rewards(base, cost)
    states = _existing_prism_file(base, ".sta")
    raw = raw._replace(
        costs=np.ones(len(keys)) if structure is None else _prism_costs(*structure, n_states, keys),
        labels={"init": np.zeros(1, dtype=np.int64)} | read_labels(labels, n_states),
        states=None if states is None else read_states(states, n_states),
    )
    return finished(raw, goal, transitions)


def without_ending(path: FilePath) -> Path:
    """A path without the ending of a file of transitions."""
    base = Path(path)
    return base.with_name(base.name.removesuffix(".gz").removesuffix(".tra"))


def _sorted_prism_rows(table: Table, path: Path) -> tuple[RawModel, IntArray]:
    """Transitions by state and choice, without costs and labels, and the keys of each.

    The keys are state, choice and successor, [outcomes, 3]; no choice in a Markov chain.

    Raises:
        ModelError: the file does not hold what its header says.
    """
    n_states, chain = table.header[0], len(table.header) == 2
    ends = table.keys[:, [0, -1]]
    # each state stands on a line, so that a header alone cannot ask for memory
    if n_states > ends.size or (ends < 0).any() or (ends >= n_states).any():
        raise ModelError(f"{path}: the states of the lines are not those of the header, {n_states}")
    choice = np.zeros(ends.shape[0], dtype=np.int64) if chain else table.keys[:, 1]
    order = np.lexsort((choice, ends[:, 0]))
    keys, choice = table.keys[order], choice[order]
    new = np.ones(order.size, dtype=np.bool_)
    new[1:] = (np.diff(keys[:, 0]) != 0) | (np.diff(choice) != 0)
    firsts = np.flatnonzero(new)
    sizes = (order.size,) if chain else (firsts.size, order.size)
    if tuple(table.header[1:]) != sizes:
        raise ModelError(f"{path}: the header says {table.header[1:]}, the file has {list(sizes)}")
    owner = keys[firsts, 0]
    names: Sequence[str] | None = None
    if any(table.names):
        first = zip(order[firsts].tolist(), choice[firsts].tolist(), strict=True)
        names = distinct_actions([table.names[k] or str(number) for k, number in first], owner)
    raw = RawModel(
        pair_offsets=offsets_of(np.bincount(owner, minlength=n_states)),
        outcome_offsets=np.append(firsts, order.size),
        successors=keys[:, -1],
        probabilities=table.values[order],
        costs=np.zeros(0),
        actions=names,
        labels={},
    )
    return raw, keys


def _existing_prism_file(base: Path, ending: str) -> Path | None:
    """The file with this ending, plain or gzip; None where there is none."""
    for name in (base.name + ending, base.name + ending + ".gz"):
        if (base.parent / name).is_file():
            return base.parent / name
    return None


def _chosen_prism_rewards(base: Path, cost: str | None) -> tuple[Path | None, Path | None] | None:
    """The rewards of states and of transitions that are the cost; None: no files of rewards.

    Args:
        base: the path of the files without an ending.
        cost: the name of the reward structure; None: the only one.

    Raises:
        ModelError: there is none of this name, or several to choose from.
    """
    found: dict[tuple[Path | None, Path | None], str | None] = {}
    for number in chain(("",), map(str, count(1))):
        files = (
            _existing_prism_file(base, f"{number}.srew"),
            _existing_prism_file(base, f"{number}.trew"),
        )
        named = files[1] or files[0]
        if named is not None:
            found[files] = structure_name(named)
        elif number not in ("", "1"):
            break
    chosen = [files for files, name in found.items() if cost in (None, name)]
    if len(chosen) == 1 or (cost is None and not chosen):
        return chosen[0] if chosen else None
    names = ", ".join(map(repr, found.values())) or "none"
    told = f"{base}: choose one of the reward structures ("
    raise ModelError(told, Argument("cost"), f"): {names}")


def _prism_costs(
    of_states: Path | None, of_transitions: Path | None, n_states: int, keys: IntArray
) -> FloatArray:
    """The reward of each outcome: of the state, and of the transition, [outcomes].

    Raises:
        ModelError: naming the file and what does not fit the transitions.
    """
    by_state, paid = np.zeros(n_states), np.zeros(keys.shape[0])
    if of_states is not None:
        table = read_table(of_states, {2: 1})
        _check_prism_rewards(of_states, n_states, table)
        by_state[table.keys[:, 0]] = table.values
    if of_transitions is not None:
        width = keys.shape[1]
        table = read_table(of_transitions, {width: width})
        _check_prism_rewards(of_transitions, n_states, table)
        paid = _matched_prism_rows(table.keys, table.values, keys, of_transitions)
    return decimal_sum(paid, by_state[keys[:, 0]])


def _matched_prism_rows(
    listed: IntArray, values: FloatArray, keys: IntArray, path: Path
) -> FloatArray:
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


def _check_prism_rewards(path: Path, n_states: int, table: Table) -> None:
    """Raise :class:`ModelError` unless a file of rewards is one of these states."""
    state = table.keys[:, 0]
    if table.header[0] != n_states or (state < 0).any() or (state >= n_states).any():
        raise ModelError(f"{path}: the states are not the {n_states} of the transitions")
    if table.header[-1] != state.size:
        raise ModelError(
            f"{path}: the header says {table.header[-1]} rewards, there are {state.size}"
        )
