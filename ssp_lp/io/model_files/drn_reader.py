"""Storm's explicit format DRN, read: Markov decision processes and Markov chains with numbers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, offsets_of
from ssp_lp.errors import Argument, ModelError
from ssp_lp.io.model_files.decimals import decimal_sum
from ssp_lp.io.model_files.raw_model import (
    ModelFile,
    RawModel,
    distinct_actions,
    finished,
)
from ssp_lp.io.model_files.text_file import FilePath, TextFile, TextLines
from ssp_lp.model.arguments import explained

_COMMENT = rb"//[^\n]*"
_KINDS = ("MDP", "DTMC")
_NUMBERS = ("double", "rational")
_ONE_LINE = ("@parameters", "@reward_models", "@nr_states", "@nr_choices")
_STATE = re.compile(rb"state\s+(\d+)\s*(?:\[([^\]]*)\])?\s*(.*)")
_ACTION = re.compile(rb"action\s+([^\s\[]+)\s*(?:\[([^\]]*)\])?\s*(.*)")
_LABEL = re.compile(r'"([^"]*)"|(\S+)')
_NO_NAME = "__NOLABEL__"
_DIGITS = np.arange(ord("0"), ord("9") + 1, dtype=np.uint8)


@explained
def read_drn(path: FilePath, *, goal: str, cost: str | None = None) -> ModelFile:
    """Read a model from a DRN file of Storm, plain or gzip.

    The cost of an action is its reward plus that of its state. Actions of goal states are dropped,
    and of states with the label "deadlock" that no action leaves: they are dead-ends. Other labels
    of states become ``state_labels``, but for names that reports use for something else.

    Args:
        path: the file; its type is MDP or DTMC, its probabilities and rewards are numbers.
        goal: the label of the goal states.
        cost: the name of a reward model, "" for Storm's without a name; None: the only one, or 1
            for each action if there is none.

    Returns:
        The model, whose states are the numbers of the file, and its initial states.

    Raises:
        ModelError: naming the file and the line, or the state and the action.
        OSError: the file cannot be opened.
    """
    with TextFile(path, _COMMENT) as file:
        header = _read_drn_header(file)
        rewards = [word.strip('"') for word in header.get("@reward_models", "").split()]
        body = _DrnBody(file, header, len(rewards), _drn_reward_column(rewards, cost, file))
        for lines in file.blocks():
            body.add(lines)
        return finished(body.raw(), goal, file.path)


def _read_drn_header(file: TextFile) -> dict[str, str]:
    """The sections up to the line ``@model``, by name.

    Raises:
        ModelError: naming the line: a section that is unknown, twice there or missing, or a model
            of another type, with parameters or with intervals.
    """
    found: dict[str, str] = {}
    while (line := file.line()) != "@model":
        if line is None:
            raise file.fault("the file ends before @model")
        if not line:
            continue
        name, _, value = line.partition(":")
        if name in found:
            raise file.fault(f"{name} is there twice")
        if name in _ONE_LINE:
            value = file.line() or ""
        elif name not in ("@type", "@value_type"):
            raise file.fault(f"{name[:60]!r} is no section that can be read")
        found[name] = value.strip()
        _check_drn_section(name, found[name], file)
    if "@type" not in found or "@nr_states" not in found:
        raise file.fault("@type and @nr_states must come before @model")
    return found


def _check_drn_section(name: str, value: str, file: TextFile) -> None:
    """Raise :class:`ModelError` for a value that is not understood."""
    if name == "@type" and value.upper() not in _KINDS:
        raise file.fault(f"models of type {value[:60]!r} are not read, only {' and '.join(_KINDS)}")
    if name == "@value_type" and value not in _NUMBERS:
        raise file.fault(f"values of type {value[:60]!r} are not read, only double and rational")
    if name == "@parameters" and value:
        raise file.fault("a model with parameters has no numbers; instantiate it first")
    if name in ("@nr_states", "@nr_choices") and not re.fullmatch(r"\d{1,18}", value, re.ASCII):
        raise file.fault(f"{name} is followed by {value[:60]!r}, which is no number")


def _drn_reward_column(rewards: Sequence[str], cost: str | None, file: TextFile) -> int | None:
    """Position of the reward model that is the cost; None: the header names none.

    Raises:
        ModelError: there is none of this name, or several to choose from.
    """
    if cost == "" and not rewards:
        return None  # Storm's model without a name, which the header does not show
    known = ", ".join(map(repr, rewards)) or "none"
    if cost is None and len(rewards) > 1:
        told = f"{file.path}: choose one of the reward models ("
        raise ModelError(told, Argument("cost"), f"): {known}")
    if cost is None:
        return 0 if rewards else None
    if cost not in rewards:
        raise ModelError(f"{file.path}: no reward model {cost!r}; there are: {known}")
    return rewards.index(cost)


class _DrnBody:
    """States, actions and transitions read so far, by blocks. Grows."""

    def __init__(
        self, file: TextFile, header: Mapping[str, str], n_rewards: int, column: int | None
    ) -> None:
        """Begin with the header; ``column`` is the position of the cost among the rewards."""
        self._file, self._n_rewards, self._column = file, n_rewards, column
        self._said = int(header["@nr_states"]), int(header.get("@nr_choices", -1))
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

    def add(self, lines: TextLines) -> None:
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
        self, lines: TextLines, state: BoolArray, action: BoolArray, transition: BoolArray
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

    def _add_states(self, lines: TextLines, mask: BoolArray) -> None:
        """Add the states of a block of a DRN file's lines."""
        numbers, rewards = lines.numbers(mask), []
        for line, number in zip(_drn_lines(lines, mask), numbers.tolist(), strict=True):
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

    def _add_actions(self, lines: TextLines, mask: BoolArray) -> None:
        """Add the actions of a block of a DRN file's lines."""
        numbers, rewards = lines.numbers(mask), []
        for line, number in zip(_drn_lines(lines, mask), numbers.tolist(), strict=True):
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
        if len(words) != (self._n_rewards or 1):
            told = f"{len(words)} rewards for {self._n_rewards} reward models"
            raise self._file.fault(told, number)
        self._rewarded = True
        return words[self._column or 0].strip()

    def _add_transitions(self, lines: TextLines, mask: BoolArray) -> None:
        """Take apart ``successor : probability``."""
        if not mask.any():
            return
        numbers = lines.numbers(mask)
        parts = TextLines.of(lines.select(mask).replace(b":", b" : "), 0)
        words = parts.text.tobytes().split()
        broken = parts.words != 3
        if broken.any() or words[1::3] != [b":"] * broken.size:
            colons = np.zeros(broken.size, dtype=np.bool_)
            if not broken.any():
                colons = np.array([word != b":" for word in words[1::3]])
            number = int(numbers[np.flatnonzero(broken | colons)[0]])
            raise self._file.fault("a transition is written 'successor : probability'", number)
        successors = self._file.integers(words[0::3], numbers)
        outside = (successors < 0) | (successors >= self._said[0])
        if outside.any():
            raise self._file.fault(
                f"there is no state {successors[outside][0]}", int(numbers[outside][0])
            )
        self._successors.append(successors)
        self._probabilities.append(self._file.floats(words[2::3], numbers))

    def raw(self) -> RawModel:
        """What was read, checked against the header."""
        states, choices = self._said
        if states != self._n_states or choices not in (-1, self._n_pairs):
            told = "" if choices < 0 else f" and {choices} choices"
            raise self._file.fault(
                f"the header says {states} states{told}, the file has {self._n_states} and "
                f"{self._n_pairs}"
            )
        pair_state = _joined_drn(self._pair_states, np.int64)
        sizes = np.bincount(_joined_drn(self._sources, np.int64), minlength=self._n_pairs)
        paid = np.ones(self._n_pairs)
        if self._rewarded:
            by_state = _joined_drn(self._state_rewards, np.float64)
            paid = decimal_sum(_joined_drn(self._pair_rewards, np.float64), by_state[pair_state])
        return RawModel(
            pair_offsets=offsets_of(np.bincount(pair_state, minlength=self._n_states)),
            outcome_offsets=offsets_of(sizes),
            successors=_joined_drn(self._successors, np.int64),
            probabilities=_joined_drn(self._probabilities, np.float64),
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


def _drn_lines(lines: TextLines, mask: BoolArray) -> list[bytes]:
    """The lines of a mask, without the spaces around them."""
    return [line.strip() for line in lines.select(mask).split(b"\n")[:-1]]


def _joined_drn(arrays: Sequence[npt.NDArray[Any]], kind: npt.DTypeLike) -> npt.NDArray[Any]:
    """Arrays one after the other."""
    return np.concatenate([np.zeros(0, dtype=kind), *arrays])
