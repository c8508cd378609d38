"""PRISM's explicit text files, one by one: transitions, labels, states and rewards."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.io.model_files.text_file import TextFile, TextLines

_COMMENT = rb"^#[^\n]*"
_NO_COMMENT = rb"(?!)"
_LABEL = re.compile(r'(\d{1,9})="([^"]*)"', re.ASCII)
_STRUCTURE = re.compile(r'#\s*Reward structure\s*"([^"]*)"')
_WHOLE = re.compile(r"-?\d{1,18}", re.ASCII)
_MOST_DIGITS = 19  # a number with fewer fits in 64 bits
_TRUTH = {"true": True, "false": False}


@dataclass(frozen=True)
class Table:
    """Lines of some whole numbers with one real number each."""

    header: Sequence[int]
    keys: IntArray  # [lines, columns]
    values: FloatArray  # [lines]
    names: Sequence[str]  # [lines] the word behind the number, "" where there is none


def read_table(path: Path, widths: dict[int, int]) -> Table:
    """Read the text of PRISM's file of transitions or rewards.

    Args:
        path: the file.
        widths: how many whole numbers begin a line, by how many numbers the first line has.

    Raises:
        ModelError: naming the line at fault.
    """
    with TextFile(path, _COMMENT) as file:
        header = _prism_header(file, widths)
        width = widths[len(header)]
        parts = [part for lines in file.blocks() for part in _prism_parts(file, lines, width)]
        none = np.zeros((0, width), dtype=np.int64)
        return Table(
            header,
            np.concatenate([none, *(part.keys for part in parts)]),
            np.concatenate([np.zeros(0), *(part.values for part in parts)]),
            [name for part in parts for name in part.names],
        )


def _prism_header(file: TextFile, widths: dict[int, int]) -> list[int]:
    """The numbers of the first line that is not empty."""
    line = file.line()
    while line == "":
        line = file.line()
    words = (line or "").split()
    if len(words) not in widths or not all(re.fullmatch(r"\d{1,18}", w, re.ASCII) for w in words):
        wanted = " or ".join(map(str, sorted(widths)))
        raise file.fault(f"the first line must have {wanted} whole numbers")
    return [int(word) for word in words]


def _prism_parts(file: TextFile, lines: TextLines, width: int) -> Iterator[Table]:
    """The lines of a block, those without a word and those with one."""
    strange = (lines.words != 0) & (lines.words != width + 1) & (lines.words != width + 2)
    if strange.any():
        raise file.fault(
            f"the line must have {width + 1} numbers, and perhaps a word",
            int(lines.numbers(strange)[0]),
        )
    for length in (width + 1, width + 2):
        mask = lines.words == length
        if mask.any():
            words, numbers = lines.select(mask).split(), lines.numbers(mask)
            columns = [file.integers(words[k::length], numbers) for k in range(width)]
            values = file.floats(words[width::length], numbers)
            found = words[width + 1 :: length] if length > width + 1 else [b""] * values.size
            text = {word: file.text_of(word, int(numbers[0])) for word in set(found)}
            yield Table((), np.stack(columns, axis=1), values, [text[word] for word in found])


def read_labels(path: Path, n_states: int) -> dict[str, IntArray]:
    """Read the text of PRISM's labels, ``0="init" 1="deadlock"`` and then ``state: number ...``.

    Raises:
        ModelError: naming the line at fault.
    """
    with TextFile(path, _COMMENT) as file:
        line = file.line() or ""
        names = dict(_LABEL.findall(line))
        if not names or _LABEL.sub("", line).strip():
            raise file.fault('the first line must say 0="init" and so on')
        members: dict[str, list[int]] = {number: [] for number in names}
        for state, listed in _prism_entries(file, n_states):
            for number in listed.split():
                if number not in members:
                    raise file.fault(f"there is no label {number[:20]}")
                members[number].append(state)
        return {names[k]: np.unique(np.array(at, dtype=np.int64)) for k, at in members.items()}


def _prism_entries(file: TextFile, n_states: int) -> Iterator[tuple[int, str]]:
    """Lines ``state: ...``, taken apart."""
    for line in file.rest():
        if not line:
            continue
        state, colon, listed = line.partition(":")
        plain = state.isascii() and state.isdigit() and len(state) < _MOST_DIGITS
        if not colon or not plain or int(state) >= n_states:
            raise file.fault(f"the line must begin with a state, 0 to {n_states - 1}, and a colon")
        yield int(state), listed


def read_states(path: Path, n_states: int) -> Sequence[Hashable] | None:
    """Read the text of PRISM's states, ``(x,y)`` and then ``0:(1,2)``: tuples of values.

    Returns:
        The states; None if they are but numbered, by one variable.

    Raises:
        ModelError: naming the line at fault.
    """
    with TextFile(path, _COMMENT) as file:
        variables = (file.line() or "").strip("()").split(",")
        states: list[Hashable] = [None] * n_states
        for state, listed in _prism_entries(file, n_states):
            words = listed.strip().strip("()").split(",")
            if len(words) != len(variables) or states[state] is not None:
                raise file.fault(f"state {state} is there twice, or has not its variables' values")
            states[state] = tuple(_prism_value(word.strip(), file) for word in words)
        if None in states:
            raise file.fault(f"state {states.index(None)} is missing")
        return None if all(s == (k,) for k, s in enumerate(states)) else states


def _prism_value(word: str, file: TextFile) -> int | bool:
    """A value of PRISM's text: a whole number, true or false."""
    if word in _TRUTH:
        return _TRUTH[word]
    if not _WHOLE.fullmatch(word):
        raise file.fault(f"{word[:60]!r} is neither a whole number nor true nor false")
    return int(word)


def structure_name(path: Path) -> str | None:
    """The name of the reward structure that a file of rewards gives; None where it gives none."""
    with TextFile(path, _NO_COMMENT) as file:
        match = _STRUCTURE.match(file.line() or "")
        return match[1] if match else None
