"""Text files with an entry per line, plain or gzip, whose errors name the file and the line."""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Iterable, Iterator
from os import PathLike
from pathlib import Path

from ssp_lp.errors import ModelError

FilePath = str | PathLike[str]

_LONGEST_LINE = 1 << 24
"""Bytes of a line beyond which a file is taken for no text at all."""

_GZIP = b"\x1f\x8b"
_GZIP_LEVEL = 6  # the usual compromise of size and time; 9 takes several times as long
WHOLE = re.compile(r"-?\d{1,18}", re.ASCII)  # of 64 bits


class TextFile:
    """A text file, plain or gzip, that knows the line where it stands. Moves on as it is read."""

    def __init__(self, path: FilePath, comment: str) -> None:
        """Name a file; ``comment`` is a pattern of what is left out of its lines."""
        self.path, self.number = Path(path), 0
        self._comment = re.compile(comment)

    def lines(self) -> Iterator[str]:
        """The lines without comments and outer spaces.

        Raises:
            ModelError: a line without end, no UTF-8, or a broken gzip file.
            OSError: the file cannot be opened.
        """
        with self.path.open("rb") as stream:
            packed = stream.read(2) == _GZIP
        with gzip.open(self.path) if packed else self.path.open("rb") as stream:
            while True:
                try:
                    raw = stream.readline(_LONGEST_LINE)
                except (gzip.BadGzipFile, EOFError, zlib.error) as error:
                    raise ModelError(f"{self.path}: the gzip file is broken ({error})") from error
                if not raw:
                    return
                self.number += 1
                if len(raw) == _LONGEST_LINE:
                    raise self.fault("the line is too long for a model")
                try:
                    text = raw.decode("utf-8")
                except UnicodeDecodeError as error:
                    raise self.fault("the text is no UTF-8") from error
                yield self._comment.sub("", text).strip()

    def fault(self, complaint: str) -> ModelError:
        """The error that names the file and the line last read."""
        return ModelError(f"{self.path}, line {self.number}: {complaint}")

    def integer(self, word: str) -> int:
        """A word as a whole number of 64 bits; raises :class:`ModelError` where it is none."""
        if not WHOLE.fullmatch(word):
            raise self.fault(f"{word[:60]!r} is no whole number")
        return int(word)

    def float(self, word: str) -> float:
        """A word as a number, a fraction such as 1/3 too; raises :class:`ModelError` else."""
        above, slash, below = word.partition("/")
        try:
            value = int(above) / int(below) if slash else float(word)
        except (ValueError, ArithmeticError) as error:
            raise self.fault(f"{word[:60]!r} is no number") from error
        if "_" in word or not word.isascii():
            raise self.fault(f"{word[:60]!r} is no number")
        return value


def write_text(path: FilePath, pieces: Iterable[str]) -> None:
    """Write pieces of text one after the other; gzip where the name ends in .gz."""
    place = Path(path)
    if place.suffix == ".gz":
        with gzip.open(place, "wt", _GZIP_LEVEL, encoding="utf-8", newline="\n") as packed:
            packed.writelines(pieces)
    else:
        with place.open("w", encoding="utf-8", newline="\n") as plain:
            plain.writelines(pieces)
