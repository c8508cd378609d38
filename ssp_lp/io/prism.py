"""PRISM's explicit files: .tra, .lab, .sta, .srew and .trew beside each other."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from pathlib import Path

import numpy as np

from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.exported import Exported, exported, write_text
from ssp_lp.io.model_files.model_file import ModelFile, distinct_actions, finished
from ssp_lp.io.model_files.prism_rewards import (
    Transitions,
    chosen_structure,
    existing,
    outcome_costs,
)
from ssp_lp.io.model_files.prism_text import Table, read_labels, read_states, read_table
from ssp_lp.io.model_files.raw_model import RawModel, offsets_of
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.model import SSP

_PAIRS_AT_A_TIME = 10_000


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
    base = _base(path)
    transitions, labels = existing(base, ".tra"), existing(base, ".lab")
    if transitions is None or labels is None:
        raise ModelError(f"{base}.tra and {base}.lab must be there")
    table = read_table(transitions, {2: 2, 3: 3})
    raw, known = _sorted(table, transitions)
    structure = chosen_structure(base, cost)
    states = existing(base, ".sta")
    marked = {"init": np.zeros(1, dtype=np.int64)} | read_labels(labels, known.n_states)
    raw = raw._replace(
        costs=np.ones(raw.successors.size)
        if structure is None
        else outcome_costs(structure, known),
        labels=marked,
        states=None if states is None else read_states(states, known.n_states),
    )
    return finished(raw, goal, transitions)


def _base(path: FilePath) -> Path:
    """A path without the ending of a file of transitions."""
    base = Path(path)
    return base.with_name(base.name.removesuffix(".gz").removesuffix(".tra"))


def _sorted(table: Table, path: Path) -> tuple[RawModel, Transitions]:
    """Transitions by state and choice, without costs and labels.

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
    return raw, Transitions(n_states, keys)


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
    base, process = _base(path), exported(model, start)
    texts = {
        ".tra": _transitions(process),
        ".lab": _label_lines(process),
        ".trew": _rewards(process),
        ".srew": _no_state_rewards(process),
        ".sta": _state_lines(process, model),
    }
    for ending, text in texts.items():
        write_text(base.with_name(base.name + ending), text)


def _transitions(process: Exported) -> Iterator[str]:
    """The file of transitions."""
    n_states, n_pairs = process.pair_offsets.size - 1, process.costs.size
    yield f"{n_states} {n_pairs} {process.successors.size}\n"
    for state, number, pair, successor, chance in _outcomes(process):
        yield f"{state} {number} {successor} {chance!r} {process.actions[pair]}\n"


def _rewards(process: Exported) -> Iterator[str]:
    """The file of rewards: those that are not 0."""
    n_states, n_pairs = process.pair_offsets.size - 1, process.costs.size
    paid = np.repeat(process.costs != 0.0, np.diff(process.outcome_offsets))
    yield '# Reward structure "cost"\n# Transition rewards\n'
    yield f"{n_states} {n_pairs} {int(paid.sum())}\n"
    costs = process.costs.tolist()
    for state, number, pair, successor, _ in _outcomes(process):
        if costs[pair]:
            yield f"{state} {number} {successor} {costs[pair]!r}\n"


def _outcomes(process: Exported) -> Iterator[tuple[int, int, int, int, float]]:
    """State, choice, pair, successor and probability of each outcome, some pairs at a time."""
    n_pairs = process.costs.size
    states = np.repeat(np.arange(process.pair_offsets.size - 1), np.diff(process.pair_offsets))
    for first in range(0, n_pairs, _PAIRS_AT_A_TIME):
        end = min(first + _PAIRS_AT_A_TIME, n_pairs)
        sizes = np.diff(process.outcome_offsets[first : end + 1])
        pairs = np.repeat(np.arange(first, end), sizes)
        state = states[pairs]
        some = slice(process.outcome_offsets[first], process.outcome_offsets[end])
        yield from zip(
            state.tolist(),
            (pairs - process.pair_offsets[state]).tolist(),
            pairs.tolist(),
            process.successors[some].tolist(),
            process.probabilities[some].tolist(),
            strict=True,
        )


def _label_lines(process: Exported) -> Iterator[str]:
    """The file of labels."""
    yield " ".join(f'{k}="{name}"' for k, name in enumerate(process.labels)) + "\n"
    borne: dict[int, list[str]] = {}
    for number, members in enumerate(process.labels.values()):
        for state in np.asarray(members).tolist():
            borne.setdefault(state, []).append(str(number))
    for state in sorted(borne):
        yield f"{state}: {' '.join(borne[state])}\n"


def _no_state_rewards(process: Exported) -> Iterator[str]:
    """The file of state rewards: there are none."""
    yield f'# Reward structure "cost"\n# State rewards\n{process.pair_offsets.size - 1} 0\n'


def _state_lines(process: Exported, model: SSP) -> Iterator[str]:
    """The file of states: what the model calls them, if those are tuples, else their numbers."""
    n_states = process.pair_offsets.size - 1
    length = _variables(model.states) if n_states == model.n_states else 0
    if not length:
        yield "(x)\n"
        yield from (f"{k}:({k})\n" for k in range(n_states))
        return
    yield f"({','.join(f'x{k}' for k in range(length))})\n"
    for k, state in enumerate(model.states):
        values = state if isinstance(state, tuple) else ()
        yield f"{k}:({','.join(str(value).lower() for value in values)})\n"


def _variables(states: Sequence[Hashable]) -> int:
    """How many variables name the states; 0 where they are no tuples of whole numbers."""
    first = states[0]
    length = len(first) if isinstance(first, tuple) else 0
    for state in states:
        if not isinstance(state, tuple) or len(state) != length:
            return 0
        if not all(type(value) in (int, bool) for value in state):
            return 0
    return length
