"""PRISM's explicit files: .tra, .lab, .sta, .srew and .trew beside each other."""

from __future__ import annotations

import re
from array import array
from collections.abc import Hashable, Iterable, Iterator, Sequence
from itertools import chain, count
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, offsets_of
from ssp_lp.errors import Argument, ModelError
from ssp_lp.io.model_files.raw_model import (
    Exported,
    ModelFile,
    RawModel,
    decimal_sum,
    distinct_actions,
    exported,
    finished,
)
from ssp_lp.io.model_files.text_file import WHOLE, FilePath, TextFile, write_text
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained

_COMMENT, _NO_COMMENT = r"^#.*", r"(?!)"
_LABEL = re.compile(r'(\d{1,9})="([^"]*)"', re.ASCII)
_STRUCTURE = re.compile(r'#\s*Reward structure\s*"([^"]*)"')
_TRUTH = {"true": True, "false": False}


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
    base = _without_ending(path)
    transitions, labels = _existing(base, ".tra"), _existing(base, ".lab")
    if transitions is None or labels is None:
        raise ModelError(f"{base}.tra and {base}.lab must be there")
    table = _read_table(transitions, {2: 2, 3: 3})
    n_states, is_chain = table.header[0], len(table.header) == 2
    ends = table.keys[:, [0, -1]]
    # each state stands on a line, so that a header alone cannot ask for memory
    if n_states > ends.size or (ends < 0).any() or (ends >= n_states).any():
        raise ModelError(
            f"{transitions}: the states of the lines are not those of the header, {n_states}"
        )
    choice = np.zeros(len(ends), dtype=np.int64) if is_chain else table.keys[:, 1]
    order = np.lexsort((choice, ends[:, 0]))
    keys, choice = table.keys[order], choice[order]
    new = (np.diff(keys[:, 0], prepend=-1) != 0) | (np.diff(choice, prepend=-1) != 0)
    firsts = np.flatnonzero(new)
    sizes = [order.size] if is_chain else [firsts.size, order.size]
    if table.header[1:] != sizes:
        raise ModelError(f"{transitions}: the header says {table.header[1:]}, the file has {sizes}")
    owner, names = keys[firsts, 0], None
    if any(table.names):
        first = zip(order[firsts].tolist(), choice[firsts].tolist(), strict=True)
        names = distinct_actions([table.names[k] or str(number) for k, number in first], owner)
    structure, states = _chosen_rewards(base, cost), _existing(base, ".sta")
    raw = RawModel(
        pair_offsets=offsets_of(np.bincount(owner, minlength=n_states)),
        outcome_offsets=np.append(firsts, order.size),
        successors=keys[:, -1],
        probabilities=table.values[order],
        costs=np.ones(len(keys)) if structure is None else _costs(*structure, n_states, keys),
        actions=names,
        labels={"init": np.zeros(1, dtype=np.int64)} | _read_labels(labels, n_states),
        states=None if states is None else _read_states(states, n_states),
    )
    return finished(raw, goal, transitions)


def _without_ending(path: FilePath) -> Path:
    """A path without the ending of a file of transitions."""
    base = Path(path)
    return base.with_name(base.name.removesuffix(".gz").removesuffix(".tra"))


def _existing(base: Path, ending: str) -> Path | None:
    """The file with this ending, plain or gzip; None where there is none."""
    files = (base.with_name(base.name + ending + packed) for packed in ("", ".gz"))
    return next((file for file in files if file.is_file()), None)


class _Table(NamedTuple):
    """Lines of some whole numbers with one real number each."""

    header: list[int]
    keys: IntArray  # [lines, columns]
    values: FloatArray  # [lines]
    names: Sequence[str]  # [lines] the word behind the number, "" where there is none


def _read_table(path: Path, widths: dict[int, int]) -> _Table:
    """Read the text of PRISM's file of transitions or rewards.

    Args:
        path: the file.
        widths: how many whole numbers begin a line, by how many numbers the first line has.

    Raises:
        ModelError: naming the line at fault.
    """
    file = TextFile(path, _COMMENT)
    lines = filter(None, file.lines())
    first = next(lines, "").split()
    if len(first) not in widths or not all(re.fullmatch(r"\d{1,18}", w, re.ASCII) for w in first):
        wanted = " or ".join(map(str, sorted(widths)))
        raise file.fault(f"the first line must have {wanted} whole numbers")
    width, keys, values, names = widths[len(first)], array("q"), array("d"), list[str]()
    for line in lines:
        words = line.split()
        if len(words) not in (width + 1, width + 2):
            raise file.fault(f"the line must have {width + 1} numbers, and perhaps a word")
        keys.extend(map(file.integer, words[:width]))
        values.append(file.float(words[width]))
        names.append("".join(words[width + 1 :]))
    table = np.array(keys).reshape(-1, width)
    return _Table(list(map(int, first)), table, np.array(values), names)


def _read_labels(path: Path, n_states: int) -> dict[str, IntArray]:
    """Read the text of PRISM's labels, ``0="init" 1="deadlock"`` and then ``state: number ...``.

    Raises:
        ModelError: naming the line at fault.
    """
    file = TextFile(path, _COMMENT)
    lines = file.lines()
    line = next(lines, "")
    names = dict(_LABEL.findall(line))
    if not names or _LABEL.sub("", line).strip():
        raise file.fault('the first line must say 0="init" and so on')
    members: dict[str, list[int]] = {number: [] for number in names}
    for state, listed in _entries(file, lines, n_states):
        for number in listed.split():
            if number not in members:
                raise file.fault(f"there is no label {number[:20]}")
            members[number].append(state)
    return {names[k]: np.unique(np.array(at, dtype=np.int64)) for k, at in members.items()}


def _entries(file: TextFile, lines: Iterator[str], n_states: int) -> Iterator[tuple[int, str]]:
    """Lines ``state: ...``, taken apart."""
    for line in filter(None, lines):
        state, colon, listed = line.partition(":")
        if not colon or not WHOLE.fullmatch(state) or not 0 <= int(state) < n_states:
            raise file.fault(f"the line must begin with a state, 0 to {n_states - 1}, and a colon")
        yield int(state), listed


def _read_states(path: Path, n_states: int) -> Sequence[Hashable] | None:
    """Read the text of PRISM's states, ``(x,y)`` and then ``0:(1,2)``: tuples of values.

    Returns:
        The states; None if they are but numbered, by one variable.

    Raises:
        ModelError: naming the line at fault.
    """
    file = TextFile(path, _COMMENT)
    lines = file.lines()
    variables = next(lines, "").strip("()").split(",")
    states: list[Hashable] = [None] * n_states
    for state, listed in _entries(file, lines, n_states):
        words = [word.strip() for word in listed.strip().strip("()").split(",")]
        if len(words) != len(variables) or states[state] is not None:
            raise file.fault(f"state {state} is there twice, or has not its variables' values")
        for word in words:
            if word not in _TRUTH and not WHOLE.fullmatch(word):
                raise file.fault(f"{word[:60]!r} is neither a whole number nor true nor false")
        states[state] = tuple(_TRUTH[word] if word in _TRUTH else int(word) for word in words)
    if None in states:
        raise file.fault(f"state {states.index(None)} is missing")
    return None if all(s == (k,) for k, s in enumerate(states)) else states


def _chosen_rewards(base: Path, cost: str | None) -> tuple[Path | None, Path | None] | None:
    """The rewards of states and of transitions that are the cost; None: no files of rewards.

    Args:
        base: the path of the files without an ending.
        cost: the name of the reward structure; None: the only one.

    Raises:
        ModelError: there is none of this name, or several to choose from.
    """
    known: dict[tuple[Path | None, Path | None], str | None] = {}
    for number in chain(("",), map(str, count(1))):
        files = _existing(base, f"{number}.srew"), _existing(base, f"{number}.trew")
        if (named := files[1] or files[0]) is not None:
            match = _STRUCTURE.match(next(TextFile(named, _NO_COMMENT).lines(), ""))
            known[files] = match[1] if match else None
        elif number not in ("", "1"):
            break
    chosen = [files for files, name in known.items() if cost in (None, name)]
    if len(chosen) == 1 or (cost is None and not chosen):
        return chosen[0] if chosen else None
    names = ", ".join(map(repr, known.values())) or "none"
    told = f"{base}: choose one of the reward structures ("
    raise ModelError(told, Argument("cost"), f"): {names}")


def _costs(
    of_states: Path | None, of_transitions: Path | None, n_states: int, keys: IntArray
) -> FloatArray:
    """The reward of each outcome: of the state, and of the transition, [outcomes].

    Raises:
        ModelError: naming the file and what does not fit the transitions.
    """
    by_state, paid = np.zeros(n_states), np.zeros(len(keys))
    if of_states is not None:
        table = _read_rewards(of_states, {2: 1}, n_states)
        by_state[table.keys[:, 0]] = table.values
    if of_transitions is not None:
        width = keys.shape[1]
        table = _read_rewards(of_transitions, {width: width}, n_states)
        rows, known = map(tuple, table.keys.tolist()), list(map(tuple, keys.tolist()))
        listed = dict(zip(rows, table.values.tolist(), strict=True))
        if len(listed) < len(table.values) or not listed.keys() <= set(known):
            raise ModelError(f"{of_transitions}: a transition is there twice, or does not exist")
        paid = np.array([listed.get(key, 0.0) for key in known])
    return decimal_sum(paid, by_state[keys[:, 0]])


def _read_rewards(path: Path, widths: dict[int, int], n_states: int) -> _Table:
    """A file of rewards; raises :class:`ModelError` unless it is one of these states."""
    table = _read_table(path, widths)
    state = table.keys[:, 0]
    if table.header[0] != n_states or (state < 0).any() or (state >= n_states).any():
        raise ModelError(f"{path}: the states are not the {n_states} of the transitions")
    if table.header[-1] != state.size:
        raise ModelError(
            f"{path}: the header says {table.header[-1]} rewards, there are {state.size}"
        )
    return table


@explained
def write_prism(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as PRISM's explicit files: .tra, .lab, .sta, .srew and .trew.

    States, costs and labels are those of :func:`ssp_lp.io.write_drn`; the reward structure is
    "cost". Where each state is a tuple of as many whole numbers or truth values, and each action
    has one cost, ``path.sta`` names the states so; else it numbers them.

    Args:
        model: the model.
        path: the path of the files without an ending, or that of the .tra file.
        start: the initial state.

    Raises:
        ModelError: the start is no state, or a label cannot be written.
    """
    base, process = _without_ending(path), exported(model, start)
    n_states, n_pairs = process.pair_offsets.size - 1, process.costs.size
    sizes = np.diff(process.outcome_offsets)
    n_paid = int(sizes[process.costs != 0.0].sum())
    texts: dict[str, Iterable[str]] = {
        ".tra": chain(
            [f"{n_states} {n_pairs} {process.successors.size}\n"],
            (
                f"{state} {number} {successor} {chance!r} {process.actions[pair]}\n"
                for state, number, pair, _, moves in process.pairs()
                for successor, chance in moves
            ),
        ),
        ".lab": _label_lines(process),
        ".trew": chain(
            [f'# Reward structure "cost"\n# Transition rewards\n{n_states} {n_pairs} {n_paid}\n'],
            (
                f"{state} {number} {successor} {cost!r}\n"
                for state, number, _, cost, moves in process.pairs()
                for successor, _ in moves
                if cost
            ),
        ),
        ".srew": [f'# Reward structure "cost"\n# State rewards\n{n_states} 0\n'],
        ".sta": _state_lines(n_states, model),
    }
    for ending, text in texts.items():
        write_text(base.with_name(base.name + ending), text)


def _label_lines(process: Exported) -> Iterator[str]:
    """The file of labels."""
    yield " ".join(f'{k}="{name}"' for k, name in enumerate(process.labels)) + "\n"
    borne: dict[int, list[str]] = {}
    for number, members in enumerate(process.labels.values()):
        for state in np.asarray(members).tolist():
            borne.setdefault(state, []).append(str(number))
    for state in sorted(borne):
        yield f"{state}: {' '.join(borne[state])}\n"


def _state_lines(n_states: int, model: SSP) -> Iterator[str]:
    """The file of states: what the model calls them, if those are tuples, else their numbers."""
    rows: list[tuple[Hashable, ...]] = [s for s in model.states if isinstance(s, tuple)]
    plain = n_states == len(rows) and len(set(map(len, rows))) == 1 and rows[0] != ()
    if not plain or any(type(value) not in (int, bool) for row in rows for value in row):
        yield "(x)\n"
        yield from (f"{k}:({k})\n" for k in range(n_states))
        return
    yield f"({','.join(f'x{k}' for k in range(len(rows[0])))})\n"
    for k, row in enumerate(rows):
        yield f"{k}:({','.join(str(value).lower() for value in row)})\n"
