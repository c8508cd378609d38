"""Errors that name an argument of a wrong type: values are compared with annotations."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence, Set
from fractions import Fraction
from functools import wraps
from inspect import get_annotations, signature
from itertools import islice, repeat
from numbers import Integral
from os import PathLike
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from ssp_lp.errors import ModelError, SSPError, check_call, check_flag, in_short, is_number

_Given = ParamSpec("_Given")
_Answer = TypeVar("_Answer")
_Made = TypeVar("_Made")


class _Numbers:
    """Stand-in for ``ArrayLike`` in annotations: any value that numpy converts to an array."""


_NUMPY = SimpleNamespace(ArrayLike=_Numbers, NDArray=npt.NDArray, DTypeLike=Any)

_WORDS: dict[Any, tuple[str, str]] = {
    int: ("a whole number", "whole numbers"),
    float: ("a number", "numbers"),
    str: ("a string", "strings"),
    bool: ("True or False", "truth values"),
    NoneType: ("None", "None"),
    np.ndarray: ("an array", "arrays"),
    Mapping: ("a dict", "dicts"),
    PathLike: ("a path", "paths"),
    Hashable: ("hashable", "hashable things"),
    tuple: ("a tuple", "tuples"),
    Sequence: ("a list", "lists"),
    Iterable: ("a list", "lists"),
    _Numbers: ("numbers", "numbers"),
}
"""Words for a type in errors, singular and plural."""

_MADE_BY = {
    "Frontier": "trace_frontier(problem)",
    "CostLaw": "success_costs(policy, problem)",
    "Solution": "solve(problem)",
    "GymnasiumWorld": "from_gymnasium(env)",
    "OccupationMeasure": "problem.program().solve()",
}
"""Name of a class of results -> call that makes an object of it, for errors."""

_FITS: dict[Any, Callable[[Any], bool]] = {
    Any: lambda value: True,
    bool: lambda value: isinstance(value, (bool, np.bool_)),
    int: lambda value: isinstance(value, Integral) and value is not True,
    float: lambda value: is_number(value) and value is not True,
    Fraction: lambda value: isinstance(value, Fraction) and is_number(value),
    Hashable: lambda value: _goes_into(hash, value),
    tuple: lambda value: isinstance(value, (tuple, list)),
    Iterable: lambda value: isinstance(value, Iterable) and not isinstance(value, str),
    Sequence: lambda value: (
        isinstance(value, Collection) and not isinstance(value, (str, Mapping, Set))
    ),
    np.ndarray: lambda value: (
        isinstance(value, (np.ndarray, list, tuple)) and _FITS[_Numbers](value)
    ),
    _Numbers: lambda value: value is not None and _goes_into(np.asarray, value, np.float64),
}
"""Type -> test of a value; a list is accepted as a tuple, numpy's numbers as Python's."""


def explained(public: Callable[_Given, _Answer]) -> Callable[_Given, _Answer]:
    """Wrap a function so that an error caused by an argument of a wrong type names the argument.

    Arguments are compared with the annotations only after the call has failed. A
    :class:`ModelError` then names the first argument that does not fit its annotation; if all fit,
    the error of the call is raised unchanged. Arguments annotated as ``bool`` are checked before
    the call, since Python accepts any value as a condition and the call would not fail.

    Args:
        public: a function or method that users call.
    """
    form = signature(public)
    flags = [name for name, hint in public.__annotations__.items() if hint == "bool"]
    placed = [part.name for part in form.parameters.values() if part.kind < part.VAR_POSITIONAL]

    @wraps(public)
    def call(*given: _Given.args, **named: _Given.kwargs) -> _Answer:
        """Check the bool arguments, call the function, and explain its error."""
        stated = dict(zip(placed, given, strict=False)) | named if flags else {}
        for flag in flags:
            check_flag(flag, stated.get(flag, False))
        try:
            return public(*given, **named)
        except (SSPError, *_BARE) as error:
            if isinstance(error, SSPError) and not error.is_of_argument:
                raise
            name = _name_of(public, given[0] if placed[:1] == ["self"] else None)
            check_call(name, form, given, named)
            fault = _misfit_among(public, form.bind(*given, **named).arguments)
            if fault is None:
                raise
            told = ModelError(f"{name}: {fault}")
            told.is_of_argument = True
            raise told from error

    return call


_BARE = (TypeError, AttributeError, LookupError, ValueError, OverflowError)
"""Errors of Python and numpy that an argument of a wrong type may cause."""


def _name_of(public: Callable[..., Any], of: object) -> str:
    """Return the name of a function for an error; of a method with its class, ``SSP.with_cost``."""
    name = public.__qualname__.replace(".<locals>", "")
    name = name if of is None else f"{type(of).__name__}.{public.__name__}"
    return name.removesuffix(".__init__")


def explained_class(made: type[_Made]) -> type[_Made]:
    """Wrap the constructor of a class by :func:`explained`; return the class."""
    made.__init__ = explained(made.__init__)  # type: ignore[method-assign]
    return made


def check_fields(made: object) -> None:
    """Raise :class:`ModelError` for a field of a dataclass that does not fit its annotation."""
    for base in type(made).__mro__[-2::-1]:
        if (fault := _misfit_among(base, vars(made))) is not None:
            raise ModelError(f"{type(made).__name__}: {fault}")


def _misfit_among(annotated: Any, values: Mapping[str, Any]) -> str | None:
    """Return an error text for the first value that does not fit its annotation, else None."""
    names = {**vars(sys.modules[annotated.__module__]), "npt": _NUMPY}
    for part, annotation in get_annotations(annotated).items():
        if part not in values:
            continue
        try:
            stated = SimpleNamespace(__annotations__={"it": annotation})
            hint = get_type_hints(stated, names)["it"]
        except (NameError, AttributeError):  # a name that only a type checker imports
            continue
        if (fault := _misfit(part, values[part], hint)) is not None:
            return fault
    return None


def _misfit(place: str, value: Any, hint: Any, *, most: int = 10_000) -> str | None:
    """Return an error text for a value that does not fit its annotation, else None.

    The text names the value, or the entry of it that does not fit, and the expected type. At most
    ``most`` entries of a dict or a list are examined.
    """
    kind, parts = get_origin(hint) or hint, get_args(hint)
    wrong = f"{place} must be {_in_words(hint)}, not {in_short(value)}"
    if kind in (Union, UnionType):
        faults = [_misfit(place, value, part) for part in parts]
        inner = [fault for fault in faults if fault and not fault.startswith(f"{place} ")]
        return None if None in faults else inner[0] if inner else wrong
    if not _fits(value, kind, parts):
        made = _MADE_BY.get(getattr(kind, "__name__", ""))
        return wrong + (holder_of(value, kind) or (f"; {made} makes one" if made else ""))

    # entries of a table, a tuple or a list
    is_table = isinstance(value, Mapping)
    listed = isinstance(value, Collection) and is_table == (kind is Mapping)
    if not (parts and listed) or kind in (Literal, Callable, np.ndarray):
        return None
    is_fixed = kind is tuple and Ellipsis not in parts
    if is_fixed and len(value) != len(parts):
        return f"{place} must have {len(parts)} entries, not {in_short(value)}"
    hints = parts if is_fixed else repeat(parts[0] if kind is tuple else parts[-1])
    entries = value.items() if is_table else enumerate(value)
    within = islice(zip(entries, hints, strict=False), most)
    inside = (_misfit(f"{place}[{key!r}]", one, of) for (key, one), of in within)
    return next(filter(None, inside), None)


def holder_of(value: object, kind: Any) -> str:
    """Return a hint that an attribute of a value has the expected type; empty if none has.

    The hint names ``.policy``, ``.model`` or ``.problem``, and is a clause for the end of an error.
    """
    for name in ("policy", "model", "problem") if kind not in _WORDS else ():
        if hasattr(value, name) and _fits(getattr(value, name), kind):
            return f"; it has one: .{name}"
    return ""


def _fits(value: Any, kind: Any, parts: tuple[Any, ...] = ()) -> bool:
    """Return whether a value has the annotated type; entries of a list or dict are not checked."""
    if kind is Literal:
        return value in parts
    if kind is Callable:
        if not callable(value) or not parts or parts[0] is Ellipsis:
            return callable(value)
        try:
            return _goes_into(signature(value).bind, *parts[0])
        except ValueError:  # of a built-in
            return True
    if kind in _FITS:
        return _FITS[kind](value)
    return not isinstance(kind, type) or isinstance(value, kind)


def _goes_into(function: Callable[..., object], *arguments: Any) -> bool:
    """Return whether a function can be called with these arguments without an error."""
    try:
        function(*arguments)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


def _class_name(kind: Any) -> str:
    """Return the name of a class; an empty string for an annotation that is not a class."""
    return kind.__name__ if isinstance(kind, type) else ""


def _in_words(hint: Any, *, several: bool = False) -> str:
    """Return a type hint in words, such as "a list of numbers"; ``several``: in the plural."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return " or ".join(dict.fromkeys(_in_words(part, several=several) for part in parts))
    if kind is Literal:
        return " or ".join(map(repr, parts))
    if kind is Callable:
        has_parts = bool(parts) and parts[0] is not Ellipsis
        return f"a function of {len(parts[0])} arguments" if has_parts else "a function"
    if kind in _WORDS:
        of = _in_words(parts[0], several=True) if kind in (Sequence, Iterable) and parts else ""
        return _WORDS[kind][several] + (f" of {of}" if of else "")
    name = _class_name(kind)
    if several or name in ("", "Any"):
        return "" if name == "Any" else name
    return f"{'an' if name[0] in 'AEIO' or name[:2].isupper() else 'a'} {name}"
