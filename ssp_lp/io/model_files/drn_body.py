"""The states of a DRN file: lines of states, actions and transitions as arrays."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.io.model_files.decimals import decimal_sum
from ssp_lp.io.model_files.drn_header import DrnHeader
from ssp_lp.io.model_files.model_file import distinct_actions
from ssp_lp.io.model_files.raw_model import RawModel, offsets_of
from ssp_lp.io.model_files.text_file import Lines, TextFile

_STATE = re.compile(rb"state\s+(\d+)\s*(?:\[([^\]]*)\])?\s*(.*)")
_ACTION = re.compile(rb"action\s+([^\s\[]+)\s*(?:\[([^\]]*)\])?\s*(.*)")
_LABEL = re.compile(r'"([^"]*)"|(\S+)')
_NO_NAME = "__NOLABEL__"
_DIGITS = np.arange(ord("0"), ord("9") + 1, dtype=np.uint8)


def read_body(file: TextFile, header: DrnHeader, column: int | None) -> RawModel:
    """Read what follows ``@model``.

    Args:
        file: the file, of which the header is read.
        header: what the header says.
        column: the position of the cost among the rewards; None: the reward model without a name,
            or 1 for each action if there are no rewards at all.

    Raises:
        ModelError: naming the line that is no line of a model.
    """
    body = _Body(file, header, column)
    for lines in file.blocks():
        body.add(lines)
    return body.raw()


class _Body:
    """States, actions and transitions read so far, by blocks. Grows."""

    def __init__(self, file: TextFile, header: DrnHeader, column: int | None) -> None:
        self._file, self._header, self._column = file, header, column
        self._n_states = self._n_pairs = 0
        self._last_pair_state = -1
        self._rewarded = column is not None
        self._pair_states: list[IntArray] = []
        self._sources: list[IntArray] = []  # the pair of each transition
        self._successors: list[IntArray] = []
        self._probabilities: list[FloatArray] = []
        self._state_rewards: list[FloatArray] = []
        self._pair_rewards: list[FloatArray] = []
        self._names: list[str] = []
        self._intern: dict[bytes, str] = {}
        self._labels: dict[str, list[int]] = {}

    def add(self, lines: Lines) -> None:
        """Append the next lines; raises :class:`ModelError` at the first that is none."""
        initial = lines.initial
        state, action = initial == ord("s"), initial == ord("a")
        transition = np.isin(initial, _DIGITS)
        strange = ~(state | action | transition | (initial == 0))
        if strange.any():
            number = int(lines.numbers(strange)[0])
            raise self._file.fault("neither a state nor an action nor a transition", number)
        self._place(lines, state, action, transition)
        self._add_states(lines, state)
        self._add_actions(lines, action)
        self._add_transitions(lines, transition)

    def _place(
        self, lines: Lines, state: BoolArray, action: BoolArray, transition: BoolArray
    ) -> None:
        """Find the state of each action and the action of each transition."""
        states = self._n_states + np.cumsum(state)  # [lines] so far
        pairs = self._n_pairs + np.cumsum(action)
        pair_state = states[action] - 1
        known = np.concatenate([[self._last_pair_state], pair_state])
        owner = known[pairs - self._n_pairs]  # [lines] the state of the last action so far
        lost = (action & (states == 0)) | (transition & (owner != states - 1))
        lost |= transition & (pairs == 0)
        if lost.any():
            number = int(lines.numbers(lost)[0])
            raise self._file.fault("it stands before any state or action it belongs to", number)
        self._pair_states.append(pair_state)
        self._sources.append(pairs[transition] - 1)
        self._last_pair_state = int(known[-1])
        self._n_pairs = int(pairs[-1])

    def _add_states(self, lines: Lines, mask: BoolArray) -> None:
        numbers, rewards = lines.numbers(mask), []
        for line, number in zip(_split(lines, mask), numbers.tolist(), strict=True):
            match = _STATE.fullmatch(line)
            if match is None or int(match[1][:19]) != self._n_states:
                raise self._file.fault(f"state {self._n_states} should come here", number)
            rewards.append(self._reward(match[2], number))
            if match[3]:
                for label in self._label_names(match[3], number):
                    self._labels.setdefault(label, []).append(self._n_states)
            self._n_states += 1
        self._state_rewards.append(self._file.floats(rewards, numbers))

    def _label_names(self, text: bytes, number: int) -> Iterable[str]:
        """The labels of a line, each in quotation marks or not."""
        if text[:1] in b"{!":
            raise self._file.fault("observations and exit rates are not read", number)
        decoded = self._file.text_of(text, number)
        labels = [quoted or bare for quoted, bare in _LABEL.findall(decoded)]
        if any('"' in label for label in labels):
            raise self._file.fault("a quotation mark that has no partner", number)
        return dict.fromkeys(labels)

    def _add_actions(self, lines: Lines, mask: BoolArray) -> None:
        numbers, rewards = lines.numbers(mask), []
        for line, number in zip(_split(lines, mask), numbers.tolist(), strict=True):
            match = _ACTION.fullmatch(line)
            if match is None:
                raise self._file.fault("this is no action", number)
            rewards.append(self._reward(match[2], number))
            name = self._intern.get(match[1])
            if name is None:
                name = self._intern[match[1]] = self._file.text_of(match[1], number)
            self._names.append(name)
        self._pair_rewards.append(self._file.floats(rewards, numbers))

    def _reward(self, listed: bytes | None, number: int) -> bytes:
        """The reward that is the cost, of those in brackets; 0 where there are none."""
        if listed is None:
            return b"0"
        words = listed.split(b",") if listed.strip() else []
        if not words:
            return b"0"
        if len(words) != (len(self._header.reward_models) or 1):
            raise self._file.fault(
                f"{len(words)} rewards for {len(self._header.reward_models)} reward models", number
            )
        self._rewarded = True
        return words[self._column or 0].strip()

    def _add_transitions(self, lines: Lines, mask: BoolArray) -> None:
        """Take apart ``successor : probability``."""
        if not mask.any():
            return
        numbers = lines.numbers(mask)
        parts = Lines.of(lines.select(mask).replace(b":", b" : "), 0)
        words = parts.text.tobytes().split()
        broken = parts.words != 3
        if broken.any() or words[1::3] != [b":"] * broken.size:
            colons = np.zeros(broken.size, dtype=np.bool_)
            if not broken.any():
                colons = np.array([word != b":" for word in words[1::3]])
            number = int(numbers[np.flatnonzero(broken | colons)[0]])
            raise self._file.fault("a transition is written 'successor : probability'", number)
        successors = self._file.integers(words[0::3], numbers)
        outside = (successors < 0) | (successors >= self._header.n_states)
        if outside.any():
            raise self._file.fault(
                f"there is no state {successors[outside][0]}", int(numbers[outside][0])
            )
        self._successors.append(successors)
        self._probabilities.append(self._file.floats(words[2::3], numbers))

    def raw(self) -> RawModel:
        """What was read, checked against the header."""
        said = (self._header.n_states, self._header.n_choices)
        if said[0] != self._n_states or said[1] not in (None, self._n_pairs):
            raise self._file.fault(
                f"the header says {said[0]} states and {said[1]} choices, the file has "
                f"{self._n_states} and {self._n_pairs}"
            )
        pair_state = _joined(self._pair_states, np.int64)
        sizes = np.bincount(_joined(self._sources, np.int64), minlength=self._n_pairs)
        paid = np.ones(self._n_pairs)
        if self._rewarded:
            by_state = _joined(self._state_rewards, np.float64)
            paid = decimal_sum(_joined(self._pair_rewards, np.float64), by_state[pair_state])
        return RawModel(
            pair_offsets=offsets_of(np.bincount(pair_state, minlength=self._n_states)),
            outcome_offsets=offsets_of(sizes),
            successors=_joined(self._successors, np.int64),
            probabilities=_joined(self._probabilities, np.float64),
            costs=np.repeat(paid, sizes),
            actions=self._actions(pair_state),
            labels={name: np.array(at, dtype=np.int64) for name, at in self._labels.items()},
        )

    def _actions(self, pair_state: IntArray) -> Sequence[str]:
        """The names of the actions; those without one bear their numbers in the state, [pairs]."""
        names = self._names
        if _NO_NAME in names:
            first = np.searchsorted(pair_state, pair_state)
            numbers = (np.arange(pair_state.size) - first).tolist()
            pairs = zip(names, numbers, strict=True)
            names = [str(number) if name == _NO_NAME else name for name, number in pairs]
        return distinct_actions(names, pair_state)


def _split(lines: Lines, mask: BoolArray) -> list[bytes]:
    """The lines of a mask, without the spaces around them."""
    return [line.strip() for line in lines.select(mask).split(b"\n")[:-1]]


def _joined(arrays: Sequence[npt.NDArray[Any]], kind: npt.DTypeLike) -> npt.NDArray[Any]:
    """Arrays one after the other."""
    return np.concatenate([np.zeros(0, dtype=kind), *arrays])
