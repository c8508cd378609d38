"""Files on which Storm would end the process: refused by name before it sees them.

What is looked at is what brought Storm down when every part of such files was damaged in turn: in
JANI, types that are neither words nor objects; in UMB archives, packing that is broken, and lists
that tell where others begin (Storm follows them without a look).
"""

from __future__ import annotations

import json
import lzma
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from ssp_lp.arrays import IntArray
from ssp_lp.errors import ModelError

_PIECE = 1 << 20  # bytes of a list that are looked at at a time
_LONGEST_INDEX = 1 << 26  # bytes
_OFFSET_BYTES, _POSITION_BYTES = 8, 4
_INDEX = "index.json"
_ZSTANDARD = b"\x28\xb5\x2f\xfd"  # packing that only Storm reads
_OFFSETS = {
    "state-to-choices.bin": ("#states", "#choices"),
    "choice-to-branches.bin": ("#choices", "#branches"),
}
"""Lists that begin with 0, do not fall, and end with the length of what they point into."""

_ACTIONS = {"actions/choices/": "#choice-actions", "actions/branches/": "#branch-actions"}
"""Folders of names, and what the index says of how many there are."""


def check_jani(file: Path) -> None:
    """Raise :class:`ModelError` unless a file is JSON of a model whose types are types."""
    try:
        table = json.loads(file.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{file} is no JSON: {error}") from error
    if not isinstance(table, dict) or not isinstance(table.get("automata"), list):
        raise ModelError(f"{file} is no JANI model: it must be an object that lists its automata")
    open_parts: list[Any] = [table]
    while open_parts:
        part = open_parts.pop()
        if isinstance(part, list):
            open_parts += part
        elif isinstance(part, dict):
            for key in ("type", "base"):
                if not isinstance(part.get(key, ""), (str, dict)):
                    raise ModelError(
                        f"{file}: {part.get('name', 'something')!r} has the {key} "
                        f"{json.dumps(part[key])[:60]}, which is neither a word nor an object"
                    )
            open_parts += [inner for key, inner in part.items() if key != "metadata"]


def check_umb(file: Path) -> None:
    """Raise :class:`ModelError` for an archive whose packing or lists of places are broken."""
    with file.open("rb") as stream:
        if stream.read(len(_ZSTANDARD)) == _ZSTANDARD:
            return
    try:
        with tarfile.open(file, "r:*") as archive:
            broken = _broken_part(archive)
    except (tarfile.TarError, OSError, EOFError, zlib.error, lzma.LZMAError) as error:
        raise ModelError(f"{file}: the archive is broken ({error})") from error
    if broken is not None:
        raise ModelError(f"{file}: {broken} of the archive says what cannot be")


def _broken_part(archive: tarfile.TarFile) -> str | None:
    """The first part of a file that is not sound; the whole archive is unpacked once on the way."""
    parts = {member.name: member for member in archive if member.isfile()}
    for member in parts.values():
        for _ in _numbers_of_part(archive, member, 1):
            pass  # a wrong checksum is told at the end
    try:
        with _opened_part(archive, parts[_INDEX]) as stream:
            counts = dict(json.loads(stream.read(_LONGEST_INDEX))["transition-system"])
    except (KeyError, TypeError, ValueError, RecursionError):
        return _INDEX
    for name, (counted, into) in _OFFSETS.items():
        ends = counts.get(counted), counts.get(into)
        if name in parts and not _are_sound_offsets(archive, parts[name], *ends):
            return name
    for name, member in parts.items():
        folder, found, _ = name.rpartition("string-mapping.bin")
        if not found:
            continue
        named = counts.get(_ACTIONS.get(folder, ""), member.size // _OFFSET_BYTES - 1)
        words, values = parts.get(f"{folder}strings.bin"), parts.get(f"{folder}values.bin")
        if words is None or not _are_sound_offsets(archive, member, named, words.size):
            return name
        several = () if values is None else _numbers_of_part(archive, values, _POSITION_BYTES)
        if any((piece >= named).any() for piece in several):
            return f"{folder}values.bin"
    return None


def _opened_part(archive: tarfile.TarFile, member: tarfile.TarInfo) -> IO[bytes]:
    """A part of an archive that must be sound, opened."""
    found = archive.extractfile(member)
    if found is None:
        raise EOFError(member.name)
    return found


def _numbers_of_part(
    archive: tarfile.TarFile, member: tarfile.TarInfo, width: int
) -> Iterator[IntArray]:
    """The whole numbers of a part, some at a time."""
    with _opened_part(archive, member) as stream:
        while piece := stream.read(_PIECE):
            yield np.frombuffer(piece[: len(piece) // width * width], dtype=f"<u{width}")


def _are_sound_offsets(
    archive: tarfile.TarFile, member: tarfile.TarInfo, count: Any, end: Any
) -> bool:
    """Whether a part is ``count + 1`` numbers that do not fall, from 0 to ``end``."""
    counted = type(count) is int and type(end) is int
    if not counted or member.size != _OFFSET_BYTES * (count + 1):
        return False
    last = np.zeros(1, dtype=np.uint64)
    for number, piece in enumerate(_numbers_of_part(archive, member, _OFFSET_BYTES)):
        rising = np.concatenate([last, piece])
        if (rising[1:] < rising[:-1]).any() or (number == 0 and piece[0] != 0):
            return False
        last = rising[-1:]
    return bool(last[0] == end)
