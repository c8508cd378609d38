"""Labels of states and actions as JSON values."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from fractions import Fraction
from math import isfinite
from typing import Any

import numpy as np

from ssp_lp.errors import ModelError


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
