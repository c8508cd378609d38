"""A fingerprint of what a model says, alike in every process, and labels as JSON has them."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from fractions import Fraction
from hashlib import sha256
from math import isfinite
from typing import Any

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import kept
from ssp_lp.model.product import ProductSSP

_VERSION = "ssp-lp model 1"

_PIECE = 1 << 20
"""Entries of an array that are converted at a time, so that large models need little room."""


@explained
@kept
def fingerprint(model: SSP) -> str:
    """The SHA-256 of a model's content, in hexadecimal; worked out once and kept with the model.

    What counts: which pairs and outcomes there are and in which order, successors, probabilities,
    costs and the fractions that they were given as, goals, the labels of states, actions and sets
    of states; of a product its original model too. What does not: the types in which arrays are
    kept, the machine's byte order, the sign of zero, and whether states are numbered by default or
    are given the same numbers as labels.

    Each part goes into the hash as ``name length``, a line feed and its content: arrays as 8-byte
    little-endian whole numbers or IEEE doubles, the rest as JSON with sorted keys.

    Raises:
        ModelError: a label cannot be stated the same way in every process.

    Example:
        >>> from ssp_lp import SSP
        >>> model = SSP.from_transitions({"door": {"open": [(1.0, "out", 2.0)]}}, goal={"out"})
        >>> fingerprint(model)[:16]
        '91f3cedaabf4992f'
    """
    digest = sha256(_VERSION.encode())
    for name in ("pair_offsets", "outcome_offsets", "successors", "pair_action", "goal_mask"):
        _fingerprint_array(digest.update, name, getattr(model, name), "<i8")
    for name in ("probabilities", "costs"):
        _fingerprint_array(digest.update, name, getattr(model, name), "<f8")
    for name, value in _fingerprint_words(model):
        told = json.dumps(value, sort_keys=True, separators=(",", ":")).encode()
        digest.update(f"\n{name} {len(told)}\n".encode() + told)
    return digest.hexdigest()


@kept
def pair_print(model: SSP) -> str:
    """The SHA-256 of which state has how many pairs: what a policy needs of a model."""
    digest = sha256(b"ssp-lp pairs 1")
    _fingerprint_array(digest.update, "pair_offsets", model.pair_offsets, "<i8")
    return digest.hexdigest()


def _fingerprint_array(
    update: Callable[[bytes], None], name: str, array: FloatArray | IntArray | BoolArray, kind: str
) -> None:
    """Take an array into the fingerprint."""
    update(f"\n{name} {len(array)}\n".encode())
    for first in range(0, len(array), _PIECE):
        # adding zero turns -0.0 into 0.0
        update((array[first : first + _PIECE] + np.zeros(1, kind)).astype(kind).tobytes())


def _fingerprint_words(model: SSP) -> Iterator[tuple[str, object]]:
    """What a model's fingerprint takes in besides its numbers, by name."""
    yield "states", _fingerprint_labels(model.states)
    yield "actions", _fingerprint_labels(model.action_names)
    yield "state_labels", {name: found.tolist() for name, found in model.state_labels.items()}
    yield "exact_costs", [[float(k).hex(), str(v)] for k, v in sorted(model.exact_costs.items())]
    if isinstance(model, ProductSSP):
        yield "original", fingerprint(model.original)


def _fingerprint_labels(labels: Sequence[Hashable]) -> object:
    """Labels as JSON values; their number where they are the whole numbers in turn."""
    if are_numbers_in_turn(labels):
        return len(labels)
    return [stated_value(label) for label in labels]


def label_value(label: Hashable) -> Any:
    """A label as a JSON value: strings, numbers, True, False and None as they are, tuples as lists.

    Raises:
        ModelError: it is, or holds, anything else, or a number that is not finite.
    """
    plain = label.item() if isinstance(label, np.generic) else label
    match plain:
        case Enum():
            pass
        case None | bool() | str():
            return plain
        case int():
            return int(plain)
        case float() if isfinite(plain):
            return plain
        case tuple():
            return [label_value(part) for part in plain]
    raise ModelError(
        f"the label {label!r} cannot be written: str, int, float, bool, None and tuples of them can"
    )


def label_of(value: Any) -> Hashable:
    """The label that a value in JSON was: lists as tuples.

    Raises:
        ModelError: an object, which no label becomes.
    """
    if isinstance(value, list):
        return tuple(label_of(part) for part in value)
    if isinstance(value, dict):
        raise ModelError(f"{str(value)[:60]!r} is no name of a state or an action")
    found: Hashable = value
    return found


def stated_value(label: Hashable) -> Any:
    """As :func:`label_value`, and what else can be stated the same way in every process.

    Sets, fractions, members of enumerations and dataclasses become objects that name them.

    Raises:
        ModelError: it is, or holds, anything else.
    """
    match label:
        case Enum():
            return {"member": f"{type(label).__qualname__}.{label.name}"}
        case Fraction():
            return {"fraction": str(label)}
        case frozenset():
            return {"set": sorted((stated_value(part) for part in label), key=repr)}
        case tuple():
            return [stated_value(part) for part in label]
    if is_dataclass(label) and not isinstance(label, type):
        parts = {part.name: stated_value(getattr(label, part.name)) for part in fields(label)}
        return {"class": type(label).__qualname__, "fields": parts}
    return label_value(label)


def are_numbers_in_turn(labels: Sequence[Hashable]) -> bool:
    """Whether the labels need no JSON: the whole numbers 0, 1, ..."""
    if isinstance(labels, range):
        return labels == range(len(labels))
    return all(label == k for k, label in enumerate(labels))
