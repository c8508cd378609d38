"""Text files with an entry per line, plain or gzip: read in blocks, split by whole arrays."""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError

FilePath = str | PathLike[str]

_BLOCK = 1 << 21
"""Bytes read at a time; the tokens of a block are Python objects for a moment."""

_LONGEST_LINE = 1 << 24
"""Bytes of a line beyond which a file is taken for no text at all."""

_GZIP = b"\x1f\x8b"
_SPACE = np.zeros(256, dtype=np.bool_)
_SPACE[list(b" \t\r\n\v\f")] = True


class TextLines(NamedTuple):
    """Some whole lines of a file."""

    text: npt.NDArray[np.uint8]  # [bytes]
    first: int  # number of the first line
    lengths: IntArray  # [lines] in bytes, the line's end included
    words: IntArray  # [lines] how many words stand on each
    initial: npt.NDArray[np.uint8]  # [lines] first byte that is no space, 0 on an empty line

    @classmethod
    def of(cls, text: bytes, first: int) -> TextLines:
        """Find lines and words in a text that ends with the end of a line."""
        array = np.frombuffer(text, dtype=np.uint8)
        ends = np.flatnonzero(array == ord("\n")) + 1
        starts = np.concatenate([[0], ends[:-1]])
        space = _SPACE[array]
        begins = ~space
        begins[1:] &= space[:-1]
        words = np.add.reduceat(begins, starts, dtype=np.int64)
        initial = np.zeros(starts.size, dtype=np.uint8)
        where = np.concatenate([[0], np.cumsum(words)[:-1]])[words > 0]
        initial[words > 0] = array[np.flatnonzero(begins)[where]]
        return cls(array, first, np.diff(ends, prepend=0), words, initial)

    def select(self, mask: BoolArray) -> bytes:
        """The text of the lines of a mask, [lines]."""
        return self.text[np.repeat(mask, self.lengths)].tobytes()

    def numbers(self, mask: BoolArray) -> IntArray:
        """The numbers of the lines of a mask, [lines]."""
        return np.flatnonzero(mask) + self.first


class TextFile:
    """An open text file, plain or gzip, that knows where it stands. Moves on as it is read."""

    def __init__(self, path: FilePath, comment: bytes) -> None:
        """Open a file; ``comment`` is a pattern of what is left out."""
        self.path, self.number = Path(path), 0
        self._comment = re.compile(comment, re.MULTILINE)
        with self.path.open("rb") as stream:
            packed = stream.read(2) == _GZIP
        self._stream = cast(IO[bytes], (gzip.open if packed else open)(self.path, "rb"))

    def __enter__(self) -> TextFile:
        """The file itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file."""
        self._stream.close()

    def fault(self, complaint: str, number: int | None = None) -> ModelError:
        """The error that names the file and a line, the one last read if none is given."""
        line = self.number if number is None else number
        return ModelError(f"{self.path}, line {line}: {complaint}")

    def line(self) -> str | None:
        """The next line without its comment and outer spaces; None at the end.

        Raises:
            ModelError: a line without end, no UTF-8, or a broken gzip file.
        """
        raw = self._read(lambda: self._stream.readline(_LONGEST_LINE))
        if not raw:
            return None
        self.number += 1
        if len(raw) == _LONGEST_LINE:
            raise self.fault("the line is too long for a model")
        return self.text_of(self._comment.sub(b"", raw)).strip()

    def text_of(self, raw: bytes, number: int | None = None) -> str:
        """Decode UTF-8; raises :class:`ModelError` at the line if it is none."""
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise self.fault("the text is no UTF-8", number) from error

    def blocks(self) -> Iterator[TextLines]:
        """The lines that are left, some megabytes at a time.

        Raises:
            ModelError: a line without end, or a broken gzip file.
        """
        rest = b""
        while piece := self._read(lambda: self._stream.read(_BLOCK)):
            text = rest + piece
            end = text.rfind(b"\n") + 1
            rest = text[end:]
            if len(rest) > _LONGEST_LINE:
                raise self.fault("the line is too long for a model", self.number + 1)
            if end:
                yield self._lines(text[:end])
        if rest:
            yield self._lines(rest + b"\n")

    def rest(self) -> Iterator[str]:
        """The lines that are left, one by one, without comments and outer spaces.

        Raises:
            ModelError: a line without end, no UTF-8, or a broken gzip file.
        """
        for block in self.blocks():
            last = self.number
            lines = self.text_of(block.text.tobytes(), block.first).split("\n")[:-1]
            for self.number, line in enumerate(lines, start=block.first):
                yield line.strip()
            self.number = last

    def _lines(self, text: bytes) -> TextLines:
        """The lines of a piece of the text file."""
        found = TextLines.of(self._comment.sub(b"", text), self.number + 1)
        self.number += found.words.size
        return found

    def _read(self, take: Callable[[], bytes]) -> bytes:
        """What the text file gives; an error names it where its gzip is broken."""
        try:
            return take()
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise ModelError(f"{self.path}: the gzip file is broken ({error})") from error

    def integers(self, words: Sequence[bytes], numbers: IntArray) -> IntArray:
        """Words as integers, [words].

        Args:
            words: what was read.
            numbers: the line of each, [words].

        Raises:
            ModelError: naming the line of the first word that is no integer of 64 bits.
        """
        if words and b"_" not in b" ".join(words):
            try:
                return np.array(list(map(int, words)), dtype=np.int64)
            except (ValueError, OverflowError):
                pass
        for word, number in zip(words, numbers, strict=True):
            if not re.fullmatch(rb"-?\d{1,18}", word):
                raise self.fault(f"{_shown_word(word)} is no whole number", int(number))
        return np.array([int(word) for word in words], dtype=np.int64)

    def floats(self, words: Sequence[bytes], numbers: IntArray) -> FloatArray:
        """Words as floats, [words]; a fraction such as 1/3 is a number as well.

        Args:
            words: what was read.
            numbers: the line of each, [words].

        Raises:
            ModelError: naming the line of the first word that is no number.
        """
        if words and b"_" not in b" ".join(words):
            try:
                return np.array(list(map(float, words)))
            except ValueError:
                pass
        return np.array(
            [self._float(word, int(n)) for word, n in zip(words, numbers, strict=True)], dtype=float
        )

    def _float(self, word: bytes, number: int) -> float:
        """A word of the text file as a float."""
        above, slash, below = word.partition(b"/")
        try:
            value = int(above) / int(below) if slash else float(word)
        except (ValueError, ArithmeticError) as error:
            raise self.fault(f"{_shown_word(word)} is no number", number) from error
        if b"_" in word:
            raise self.fault(f"{_shown_word(word)} is no number", number)
        return value


def _shown_word(word: bytes) -> str:
    """A word from a file, short and printable."""
    return repr(word[:60].decode("utf-8", "replace"))
