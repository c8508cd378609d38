"""Files of numpy arrays with a header in JSON, without pickle: .npz."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ssp_lp.errors import ModelError

_HEADER = "header"

Array = npt.NDArray[Any]


class Archive(NamedTuple):
    """What a file holds."""

    header: dict[str, Any]
    arrays: dict[str, Array]


class ArrayStore:
    """Arrays gathered for a file under names of its own; equal ones are kept once."""

    def __init__(self) -> None:
        self.arrays: dict[str, Array] = {}
        self._names: dict[tuple[str, tuple[int, ...], bytes], str] = {}

    def add(self, array: Array) -> str:
        """The name under which the array is found again."""
        key = array.dtype.str, array.shape, array.tobytes()
        if key not in self._names:
            self._names[key] = f"array{len(self._names)}"
            self.arrays[self._names[key]] = array
        return self._names[key]


def write_archive(
    path: str | PathLike[str],
    kind: str,
    version: int,
    header: Mapping[str, Any],
    arrays: Mapping[str, Array],
) -> None:
    """Write a compressed file; the same content gives the same bytes.

    Args:
        path: where to; no ending is added to it.
        kind: what the file is, "policy".
        version: of what ``kind`` files look like.
        header: values that JSON knows.
        arrays: by name.
    """
    told = json.dumps({"format": f"ssp-lp {kind}", "version": version, **header}, default=_plain)
    with Path(path).open("wb") as file:
        named: dict[str, Any] = {_HEADER: np.frombuffer(told.encode(), dtype=np.uint8), **arrays}
        np.savez_compressed(file, **named)


def read_archive(path: str | PathLike[str], kind: str, version: int) -> Archive:
    """Read a file of :func:`write_archive`; nothing in it is executed.

    Raises:
        ModelError: it is no such file, or of a later version than this library knows.
    """
    refused = ModelError(f"{path} is no ssp-lp {kind} file")
    try:
        arrays = _arrays_of(Path(path))
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError) as error:
        raise refused from error
    if _HEADER not in arrays:
        raise refused
    try:
        header = json.loads(arrays.pop(_HEADER).tobytes())
    except ValueError as error:
        raise refused from error
    if not isinstance(header, dict) or header.get("format") != f"ssp-lp {kind}":
        raise refused
    if header["version"] > version:
        raise ModelError(
            f"{path} has version {header['version']}, this library reads up to {version}: "
            "install a newer ssp-lp"
        )
    return Archive(header, arrays)


def _arrays_of(path: Path) -> dict[str, Array]:
    """All arrays of a file, in the machine's own byte order.

    Raises:
        ValueError: a file of one array, or one that holds objects.
    """
    with path.open("rb") as file:
        found = np.load(file, allow_pickle=False)
        if isinstance(found, np.ndarray):
            raise ValueError("one array, no archive")
        return {name: _native(found[name]) for name in found.files}


def _native(array: Array) -> Array:
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _plain(value: np.generic) -> Any:
    return value.item()
