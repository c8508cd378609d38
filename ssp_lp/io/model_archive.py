"""The library's own files of models: arrays and JSON texts in a zip archive (.npz)."""

from __future__ import annotations

import io
import json
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import read_only
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import check_model

_FORMAT, _VERSION = "ssp-lp model", 1
_ARRAYS = {
    "pair_action": np.dtype("<i8"),
    "pair_offsets": np.dtype("<i8"),
    "outcome_offsets": np.dtype("<i8"),
    "successors": np.dtype("<i4"),
    "probabilities": np.dtype("<f8"),
    "costs": np.dtype("<f8"),
    "goal_states": np.dtype("<i8"),
    "label_offsets": np.dtype("<i8"),
    "label_members": np.dtype("<i8"),
    "texts": np.dtype("|u1"),
}
"""The arrays of an archive, each one-dimensional. The texts are JSON: format, version, labels."""

_MOST_PACKED = 1100
"""Bytes that one packed byte can become, a little above the 1032 of the packing method."""

_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    RuntimeError,
)
"""What reading a damaged archive may raise: an offset before its beginning is an OSError."""

_FRACTION = re.compile(r"\d{1,4000}(/\d{1,4000})?", re.ASCII)


@explained
def save_model(model: SSP, path: FilePath) -> None:
    """Write a model with all that it says, to be read by :func:`load_model`.

    Args:
        model: the model; its states and actions are called by strings, numbers, truth values, and
            tuples of those.
        path: the file, written as it is named (``.npz`` is usual).

    Raises:
        ModelError: a state or an action is called by something else.
    """
    check_model(model, "save_model")
    uniform = model.costs.strides == (0,) and model.costs.size > 0
    members = list(model.state_labels.values())
    texts = {
        "format": _FORMAT,
        "version": _VERSION,
        "states": _names(model.states, "state"),
        "actions": _names(model.action_names, "action"),
        "state_labels": list(model.state_labels),
        "exact_costs": [[cost, str(exact)] for cost, exact in model.exact_costs.items()],
    }
    found = {name: getattr(model, name) for name in _ARRAYS if hasattr(model, name)} | {
        "costs": model.costs[:1] if uniform else model.costs,
        "goal_states": np.flatnonzero(model.goal_mask),
        "label_offsets": np.cumsum([0, *(len(at) for at in members)]),
        "label_members": np.concatenate([np.zeros(0, dtype=np.int64), *members]),
        "texts": np.frombuffer(json.dumps(texts).encode(), dtype=np.uint8),
    }
    arrays: dict[str, Any] = {name: found[name].astype(kind) for name, kind in _ARRAYS.items()}
    with Path(path).open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def _names(names: Sequence[Hashable], what: str) -> list[Any] | None:
    """Names as JSON has them, tuples as lists; None where they are their positions."""
    if isinstance(names, range):
        return None
    return [_plain(name, name, what) for name in names]


def _plain(name: Any, whole: Hashable, what: str) -> Any:
    """One name, or raise :class:`ModelError`: it could not be read back."""
    if isinstance(name, tuple):
        return [_plain(part, whole, what) for part in name]
    if isinstance(name, np.generic):
        name = name.item()
    if isinstance(name, (str, int, float)):
        return name
    raise ModelError(
        f"the {what} {whole!r} cannot be written: only strings, numbers, truth values and tuples "
        "of those can; give it such a name"
    )


@explained
def load_model(path: FilePath) -> SSP:
    """Read a model that :func:`save_model` wrote; nothing in the file is run.

    Args:
        path: the file.

    Returns:
        The same model.

    Raises:
        ModelError: naming the file: it is none of this format, of a newer version, or what it says
            makes no model.
        OSError: the file cannot be opened.
    """
    place = Path(path)
    with place.open("rb") as stream:
        try:
            return _model(stream)
        except ModelError as error:
            raise ModelError(f"{place}: {error}") from error
        except _BROKEN as error:
            raise ModelError(f"{place}: the archive is broken ({error})") from error


def _model(stream: IO[bytes]) -> SSP:
    with zipfile.ZipFile(stream) as archive:
        texts = _texts(_array(archive, "texts"))
        arrays = {name: _array(archive, name) for name in _ARRAYS if name != "texts"}
    n_states = arrays["pair_offsets"].size - 1
    states = _labels(texts, "states", max(n_states, 0))
    actions = _labels(texts, "actions", None)
    if not isinstance(actions, range):
        chosen = arrays["pair_action"]
        if ((chosen < 0) | (chosen >= len(actions))).any():
            raise ModelError("pair_action names actions that are not there")
        actions = [actions[k] for k in chosen.tolist()]
    costs = arrays["costs"]
    model = SSP.from_arrays(
        pair_offsets=arrays["pair_offsets"],
        outcome_offsets=arrays["outcome_offsets"],
        successors=arrays["successors"],
        probabilities=arrays["probabilities"],
        costs=costs[0] if costs.size == 1 else costs,
        goal_states=arrays["goal_states"],
        states=None if isinstance(states, range) else states,
        actions=None if isinstance(actions, range) else actions,
        state_labels=_state_labels(texts, arrays, states),
        exact_costs=_exact_costs(texts),
        treat_actionless_as_dead_ends=True,
    )
    return replace(model, probabilities=read_only(arrays["probabilities"]))  # not rounded again


def _array(archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    """One array, of the type that it must have; its size is bounded by that of the file."""
    member = f"{name}.npy"
    if member not in archive.namelist():
        raise ModelError(f"the array {name} is missing")
    entry = archive.getinfo(member)
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ModelError(f"the array {name} is packed by another method")
    if entry.file_size > _MOST_PACKED * (entry.compress_size + 1):
        raise ModelError(f"the array {name} cannot be as large as it says")
    stream = io.BytesIO(archive.read(entry))
    try:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0}[version]
        shape, _, kind = read(stream)
    except (ValueError, KeyError, SyntaxError, TypeError, RecursionError) as error:
        raise ModelError(f"the array {name} is no array") from error
    rest = stream.getbuffer()[stream.tell() :]
    size = shape[0] if len(shape) == 1 else -1
    if kind != _ARRAYS[name] or size * kind.itemsize != len(rest):
        raise ModelError(f"the array {name} has another type or size than it should")
    return np.frombuffer(rest, dtype=kind)


def _texts(array: npt.NDArray[Any]) -> Mapping[str, Any]:
    """The texts of an archive, of a version that can be read."""
    try:
        texts = json.loads(array.tobytes())
    except (ValueError, RecursionError) as error:
        raise ModelError("the texts are no JSON") from error
    if not isinstance(texts, dict) or texts.get("format") != _FORMAT:
        raise ModelError(f"the format is not {_FORMAT!r}")
    version = texts.get("version")
    if type(version) is not int or not 1 <= version <= _VERSION:
        raise ModelError(
            f"the format has version {version!r}, this library reads up to {_VERSION}: update it"
        )
    return texts


def _labels(texts: Mapping[str, Any], name: str, size: int | None) -> Sequence[Hashable]:
    """Names of states or actions; a range where they are their positions."""
    given = texts.get(name, ())
    if given is None:
        return range(size or 0)
    if not isinstance(given, list) or (size is not None and len(given) != size):
        raise ModelError(f"the names of {name} are not one for each")
    return [_name(part) for part in given]


def _name(part: Any) -> Hashable:
    """A name as JSON has it, made what it was."""
    if isinstance(part, list):
        return tuple(_name(inner) for inner in part)
    if not isinstance(part, (str, int, float)):
        raise ModelError(f"{str(part)[:60]!r} is no name of a state or an action")
    return part


def _state_labels(
    texts: Mapping[str, Any], arrays: Mapping[str, Any], states: Sequence[Hashable]
) -> Mapping[str, Sequence[Hashable]]:
    """Members of each label, by name."""
    names: Any = texts.get("state_labels")
    offsets, members = arrays["label_offsets"], arrays["label_members"]
    fits = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not fits or offsets.size != len(names) + 1 or offsets[0] != 0:
        raise ModelError("the labels of states have no names, or no members")
    inside = (np.diff(offsets) >= 0).all() and offsets[-1] == members.size
    if not inside or ((members < 0) | (members >= len(states))).any():
        raise ModelError("the labels of states have members that are no states")
    bounds = offsets.tolist()
    return {
        name: [states[k] for k in members[bounds[i] : bounds[i + 1]].tolist()]
        for i, name in enumerate(names)
    }


def _exact_costs(texts: Mapping[str, Any]) -> Mapping[float, Fraction]:
    """Costs that were given as fractions."""
    exact: dict[float, Fraction] = {}
    given = texts.get("exact_costs")
    for entry in given if isinstance(given, list) else [None]:
        if not isinstance(entry, list) or len(entry) != 2 or not isinstance(entry[0], float):
            raise ModelError("the exact costs are no list of numbers and fractions")
        number, text = entry
        if not isinstance(text, str) or not _FRACTION.fullmatch(text):
            raise ModelError(f"the exact cost {str(text)[:60]!r} is no fraction")
        above, _, below = text.partition("/")
        if int(below or 1) == 0 or not math.isfinite(number):
            raise ModelError(f"the exact cost {text[:60]!r} is no number")
        exact[number] = Fraction(int(above), int(below or 1))
    return exact
