"""Models in files of the library's own, with all that they say (.npz)."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from ssp_lp.arrays import read_only
from ssp_lp.errors import ModelError
from ssp_lp.io.archive import Array, damage_named, read_archive, write_archive
from ssp_lp.io.json_labels import label_of, label_value
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.checked_arrays import check_offsets
from ssp_lp.model.ssp import check_model

_VERSION = 1
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
}
"""The arrays of a model's file, each one-dimensional."""

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
    header = {
        "states": _names_in_archive(model.states),
        "actions": _names_in_archive(model.action_names),
        "state_labels": list(model.state_labels),
        "exact_costs": [[cost, str(exact)] for cost, exact in model.exact_costs.items()],
    }
    found = {name: getattr(model, name) for name in _ARRAYS if hasattr(model, name)} | {
        "costs": model.costs[:1] if uniform else model.costs,
        "goal_states": np.flatnonzero(model.goal_mask),
        "label_offsets": np.cumsum([0, *(len(at) for at in members)]),
        "label_members": np.concatenate([np.zeros(0, dtype=np.int64), *members]),
    }
    arrays = {name: found[name].astype(kind) for name, kind in _ARRAYS.items()}
    write_archive(path, "model", _VERSION, header, arrays)


def _names_in_archive(names: Sequence[Hashable]) -> list[Any] | None:
    """Names as JSON has them; None where they are their positions."""
    if isinstance(names, range):
        return None
    return [name if isinstance(name, float) else label_value(name) for name in names]


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
    header, arrays = read_archive(path, "model", _VERSION)
    with damage_named(path):
        return _model_in_archive(header, arrays)


def _model_in_archive(texts: Mapping[str, Any], arrays: Mapping[str, Array]) -> SSP:
    """The model that an archive's texts and arrays state, checked."""
    for name, kind in _ARRAYS.items():
        if name not in arrays:
            raise ModelError(f"the array {name} is missing")
        if arrays[name].ndim != 1 or arrays[name].dtype != kind:
            raise ModelError(f"the array {name} has another type or size than it should")
    n_states = arrays["pair_offsets"].size - 1
    states = _labels_in_archive(texts, "states", max(n_states, 0))
    actions = _labels_in_archive(texts, "actions", None)
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
        state_labels=_state_labels_in_archive(texts, arrays, states),
        exact_costs=_exact_costs_in_archive(texts),
        treat_actionless_as_dead_ends=True,
    )
    return replace(model, probabilities=read_only(arrays["probabilities"]))  # not rounded again


def _labels_in_archive(texts: Mapping[str, Any], name: str, size: int | None) -> Sequence[Hashable]:
    """Names of states or actions in an archive; a range where they are their positions."""
    given = texts.get(name, ())
    if given is None:
        return range(size or 0)
    if not isinstance(given, list) or (size is not None and len(given) != size):
        raise ModelError(f"the names of {name} are not one for each")
    return [label_of(part) for part in given]


def _state_labels_in_archive(
    texts: Mapping[str, Any], arrays: Mapping[str, Array], states: Sequence[Hashable]
) -> Mapping[str, Sequence[Hashable]]:
    """Members of each state label in a model's archive, by name."""
    offsets, members = arrays["label_offsets"], arrays["label_members"]
    check_offsets("label_offsets", offsets, members.size)
    if ((members < 0) | (members >= len(states))).any():
        raise ModelError("the labels of states have members that are no states")
    several = np.split(members, offsets[1:-1])[: offsets.size - 1]
    pairs = zip(texts["state_labels"], several, strict=True)
    return {name: [states[k] for k in some.tolist()] for name, some in pairs}


def _exact_costs_in_archive(texts: Mapping[str, Any]) -> Mapping[float, Fraction]:
    """Costs that were given as fractions; digits are counted before they are read."""
    exact: dict[float, Fraction] = {}
    for number, text in texts["exact_costs"]:
        if not _FRACTION.fullmatch(text):
            raise ModelError(f"the exact cost {text[:60]!r} is no fraction")
        exact[float(number)] = Fraction(text)
    return exact
