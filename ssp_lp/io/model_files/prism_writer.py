"""PRISM's explicit files, written: .tra, .lab, .sta, .srew and .trew beside each other."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence

import numpy as np

from ssp_lp.io.model_files.exported import Exported, exported, write_text
from ssp_lp.io.model_files.prism_reader import without_ending
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained

_PAIRS_AT_A_TIME = 10_000


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
    base, process = without_ending(path), exported(model, start)
    no_rewards = f'# Reward structure "cost"\n# State rewards\n{process.pair_offsets.size - 1} 0\n'
    texts: dict[str, Iterable[str]] = {
        ".tra": _prism_transitions(process),
        ".lab": _prism_label_lines(process),
        ".trew": _prism_rewards(process),
        ".srew": [no_rewards],
        ".sta": _prism_state_lines(process, model),
    }
    for ending, text in texts.items():
        write_text(base.with_name(base.name + ending), text)


def _prism_transitions(process: Exported) -> Iterator[str]:
    """The file of transitions."""
    n_states, n_pairs = process.pair_offsets.size - 1, process.costs.size
    yield f"{n_states} {n_pairs} {process.successors.size}\n"
    for state, number, pair, successor, chance in _prism_outcomes(process):
        yield f"{state} {number} {successor} {chance!r} {process.actions[pair]}\n"


def _prism_rewards(process: Exported) -> Iterator[str]:
    """The file of rewards: those that are not 0."""
    n_states, n_pairs = process.pair_offsets.size - 1, process.costs.size
    paid = np.repeat(process.costs != 0.0, np.diff(process.outcome_offsets))
    yield '# Reward structure "cost"\n# Transition rewards\n'
    yield f"{n_states} {n_pairs} {int(paid.sum())}\n"
    costs = process.costs.tolist()
    for state, number, pair, successor, _ in _prism_outcomes(process):
        if costs[pair]:
            yield f"{state} {number} {successor} {costs[pair]!r}\n"


def _prism_outcomes(process: Exported) -> Iterator[tuple[int, int, int, int, float]]:
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


def _prism_label_lines(process: Exported) -> Iterator[str]:
    """The file of labels."""
    yield " ".join(f'{k}="{name}"' for k, name in enumerate(process.labels)) + "\n"
    borne: dict[int, list[str]] = {}
    for number, members in enumerate(process.labels.values()):
        for state in np.asarray(members).tolist():
            borne.setdefault(state, []).append(str(number))
    for state in sorted(borne):
        yield f"{state}: {' '.join(borne[state])}\n"


def _prism_state_lines(process: Exported, model: SSP) -> Iterator[str]:
    """The file of states: what the model calls them, if those are tuples, else their numbers."""
    n_states = process.pair_offsets.size - 1
    length = _prism_variables(model.states) if n_states == model.n_states else 0
    if not length:
        yield "(x)\n"
        yield from (f"{k}:({k})\n" for k in range(n_states))
        return
    yield f"({','.join(f'x{k}' for k in range(length))})\n"
    for k, state in enumerate(model.states):
        values = state if isinstance(state, tuple) else ()
        yield f"{k}:({','.join(str(value).lower() for value in values)})\n"


def _prism_variables(states: Sequence[Hashable]) -> int:
    """How many variables name the states; 0 where they are no tuples of whole numbers."""
    first = states[0]
    length = len(first) if isinstance(first, tuple) else 0
    for state in states:
        if not isinstance(state, tuple) or len(state) != length:
            return 0
        if not all(type(value) in (int, bool) for value in state):
            return 0
    return length
