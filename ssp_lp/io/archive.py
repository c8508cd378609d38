"""The library's own files: numpy arrays with a header in JSON, without pickle (.npz)."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.text_file import FilePath

Array = npt.NDArray[Any]

_HEADER = "header"
_MOST_PACKED = 1100
"""Bytes that one packed byte can become, a little above the 1032 of the packing method."""

_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    KeyError,
    ValueError,
    RuntimeError,  # RecursionError, too
)
"""What reading a damaged archive may raise: an offset before its beginning is an OSError."""


def write_archive(
    path: FilePath, kind: str, version: int, header: Mapping[str, Any], arrays: Mapping[str, Array]
) -> None:
    """Write a compressed archive; the same content gives the same bytes.

    Args:
        path: where to; no ending is added to it.
        kind: what the file is, "policy".
        version: of what ``kind`` files look like.
        header: values that JSON knows.
        arrays: by name.
    """
    whole = {"format": f"ssp-lp {kind}", "version": version, **header}
    told = json.dumps(whole, default=np.generic.item)
    with Path(path).open("wb") as file:
        named: dict[str, Any] = {_HEADER: np.frombuffer(told.encode(), dtype=np.uint8), **arrays}
        np.savez_compressed(file, **named)


def read_archive(path: FilePath, kind: str, version: int) -> tuple[Any, dict[str, Array]]:
    """The header and the arrays of an archive; nothing in it is executed.

    Raises:
        ModelError: naming the file: it is none, broken, or of a later version than this library
            knows.
        OSError: the file cannot be opened.
    """
    with Path(path).open("rb") as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                arrays = {
                    entry.filename.removesuffix(".npy"): _archived_array(archive, entry)
                    for entry in archive.infolist()
                }
            header = json.loads(arrays.pop(_HEADER, np.frombuffer(b"null", np.uint8)).tobytes())
        except _BROKEN as error:
            raise ModelError(f"{path} is no ssp-lp {kind} file: {error}") from error
    found = header.get("format", "") if isinstance(header, dict) else None
    if found != f"ssp-lp {kind}":
        what = "it was not written by ssp-lp" if found is None else f"it says {str(found)[:60]!r}"
        raise ModelError(f"{path} is no ssp-lp {kind} file: {what}")
    told = header.get("version")
    if type(told) is not int or not 1 <= told <= version:
        newer = type(told) is int and told > version
        remedy = "install a newer ssp-lp" if newer else f"write the {kind} anew with this one"
        raise ModelError(
            f"{path} has version {told!r}, this ssp-lp reads up to {version}: {remedy}"
        )
    return header, arrays


@contextmanager
def damage_named(path: FilePath) -> Iterator[None]:
    """Raise :class:`ModelError`, naming the archive, for what only a damaged one can say."""
    try:
        yield
    except ModelError as error:
        raise ModelError(f"{path}: ", *error.args) from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise ModelError(f"{path} is damaged: {error!r}") from error


def _archived_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Array:
    """One array, in the machine's own byte order; its size is bounded by that of the file."""
    name = entry.filename.removesuffix(".npy")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ModelError(f"the array {name} is packed by another method")
    if entry.file_size > _MOST_PACKED * (entry.compress_size + 1):
        raise ModelError(f"the array {name} cannot be as large as it says")
    stream = io.BytesIO(archive.read(entry))
    try:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0}[version]
        shape, by_columns, kind = read(stream)
    except (ValueError, KeyError, SyntaxError, TypeError, RecursionError) as error:
        raise ModelError(f"the array {name} is no array") from error
    rest = stream.getbuffer()[stream.tell() :]
    if kind.hasobject or min(shape, default=0) < 0 or prod(shape) * kind.itemsize != len(rest):
        raise ModelError(f"the array {name} has another type or size than it should")
    found = np.frombuffer(rest, dtype=kind).reshape(shape, order="F" if by_columns else "C")
    return found.astype(kind.newbyteorder("="), copy=False)
