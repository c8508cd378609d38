"""Arguments of a wrong type, told by name: each is held against the annotation that it has."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from fractions import Fraction
from functools import wraps
from inspect import signature
from itertools import islice
from numbers import Integral
from os import PathLike
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from ssp_lp.errors import ModelError, SSPError, check_flag, in_short, is_number

_Given = ParamSpec("_Given")
_Answer = TypeVar("_Answer")
_Made = TypeVar("_Made")


class _Numbers:
    """Stands for what numpy makes an array of."""


_NUMPY = SimpleNamespace(ArrayLike=_Numbers, NDArray=npt.NDArray, DTypeLike=Any)

_LOOKED_AT = 10_000  # entries of a table or a list
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
    _Numbers: ("numbers", "numbers"),
}
"""What a type is called, and several of it."""


def explained(public: Callable[_Given, _Answer]) -> Callable[_Given, _Answer]:
    """A function whose bare errors say which argument is of a wrong type, where one is.

    Only a call that fails is looked at: its arguments are held against their annotations, and one
    that does not fit becomes a :class:`ModelError`. What fails otherwise is raised as it is. Truth
    values alone are looked at before, as anything would do for one.

    Args:
        public: a function or method that users call.
    """
    order = list(signature(public).parameters)
    flags = [name for name, hint in public.__annotations__.items() if hint == "bool"]

    @wraps(public)
    def call(*given: _Given.args, **named: _Given.kwargs) -> _Answer:
        """The function, once its flags have been checked."""
        stated = dict(zip(order, given, strict=False)) | named if flags else {}
        for flag in flags:
            check_flag(flag, stated.get(flag, False))
        try:
            return public(*given, **named)
        except SSPError:
            raise
        except (TypeError, AttributeError, LookupError, ValueError, OverflowError) as error:
            told = _wrong_argument(public, given, named)
            if told is None:
                raise
            raise ModelError(told) from error

    return call


def explained_class(made: type[_Made]) -> type[_Made]:
    """A class whose constructor is :func:`explained`."""
    made.__init__ = explained(made.__init__)  # type: ignore[method-assign]
    return made


def _wrong_argument(
    public: Callable[..., Any], given: Sequence[Any], named: Mapping[str, Any]
) -> str | None:
    """What to say of the first argument that does not fit; None: all do, or one is missing."""
    try:
        bound = signature(public).bind(*given, **named).arguments
    except TypeError:
        return None
    name = public.__qualname__.removesuffix(".__init__").replace(".<locals>", "")
    for part, annotation in public.__annotations__.items():
        hint = _argument_hint(annotation, sys.modules[public.__module__])
        if part in bound and (fault := _misfit_of_argument(part, bound[part], hint)) is not None:
            return f"{name}: {fault}"
    return None


def check_fields(made: object) -> None:
    """Raise :class:`ModelError` for a field of a dataclass that does not fit its annotation."""
    for base in type(made).__mro__[-2::-1]:
        for part, annotation in vars(base).get("__annotations__", {}).items():
            hint = _argument_hint(annotation, sys.modules[base.__module__])
            fault = _misfit_of_argument(part, getattr(made, part, None), hint)
            if fault is not None:
                raise ModelError(f"{type(made).__name__}: {fault}")


def _argument_hint(annotation: Any, module: Any) -> Any:
    """What an annotation says; Any where it names what only a type checker imports."""
    stated = SimpleNamespace(__annotations__={"it": annotation})
    try:
        return get_type_hints(stated, {**vars(module), "npt": _NUMPY})["it"]
    except (NameError, AttributeError):
        return Any


def _misfit_of_argument(place: str, value: Any, hint: Any) -> str | None:
    """What to say of an argument that is not what its hint says: which part, and the remedy."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    wrong = f"{place} must be {_hint_in_words(hint)}, not {in_short(value)}"
    if kind in (_Numbers, np.ndarray):
        listed = kind is _Numbers or isinstance(value, (np.ndarray, list, tuple))
        return None if listed and _are_number_arguments(value) else wrong
    if kind in (Union, UnionType):
        faults = [_misfit_of_argument(place, value, part) for part in parts]
        inner = [fault for fault in faults if fault and not fault.startswith(f"{place} ")]
        return None if None in faults else inner[0] if inner else wrong
    if kind is Literal:
        return None if value in parts else wrong
    if kind is Callable:
        return None if _argument_takes(value, parts) else wrong
    if not isinstance(kind, type) or kind in (Any, object):
        return None
    if not _is_argument_of(value, kind):
        parts_of = (name for name in ("policy", "model", "problem") if hasattr(value, name))
        own = [
            name
            for name in parts_of
            if kind not in _WORDS and _is_argument_of(getattr(value, name), kind)
        ]
        return wrong + "".join(f"; it has one: .{name}" for name in own[:1])
    return _misfit_inside(place, value, kind, parts) or None


def _misfit_inside(place: str, value: Any, kind: type, parts: tuple[Any, ...]) -> str | None:
    """The same of the entries of an argument that is a table, a tuple or a list."""
    entries: Iterable[tuple[Any, Any, Any]] = ()
    if kind is Mapping and parts:
        entries = ((key, one, parts[1]) for key, one in value.items())
    elif kind is tuple and Ellipsis not in parts and parts:
        if len(value) != len(parts):
            return f"{place} must have {len(parts)} entries, not {in_short(value)}"
        entries = zip(range(len(parts)), value, parts, strict=True)
    elif parts and isinstance(value, Collection) and not isinstance(value, Mapping):
        entries = ((k, one, parts[0]) for k, one in enumerate(value))
    found = (
        _misfit_of_argument(f"{place}[{k!r}]", one, hint)
        for k, one, hint in islice(entries, _LOOKED_AT)
    )
    return next((fault for fault in found if fault is not None), None)


def _is_argument_of(value: Any, kind: type) -> bool:
    """Whether a value is of a kind, as far as calls are concerned: lists for tuples, numpy's."""
    if kind is bool:
        return isinstance(value, (bool, np.bool_))
    if kind in (int, float):
        fits = is_number(value) if kind is float else isinstance(value, Integral)
        return fits and value is not True
    if kind is Hashable:
        try:
            return hash(value) is not None
        except TypeError:
            return False
    if kind is tuple:
        return isinstance(value, (tuple, list))
    if kind is Iterable:
        return isinstance(value, Iterable) and not isinstance(value, str)
    if kind is Sequence:
        return (
            hasattr(value, "__len__")
            and hasattr(value, "__getitem__")
            and not isinstance(value, (str, Mapping))
        )
    if getattr(kind, "_is_protocol", False):
        names = (name for name in vars(kind) if not name.startswith("_"))
        return all(hasattr(value, name) for name in names)
    return isinstance(value, kind) and (kind is not Fraction or is_number(value))


def _are_number_arguments(value: Any) -> bool:
    """Whether an argument is made of numbers."""
    try:
        return value is not None and np.asarray(value, dtype=np.float64) is not None
    except (TypeError, ValueError, OverflowError):
        return False


def _argument_takes(value: Any, parts: tuple[Any, ...]) -> bool:
    """Whether a value is a function of so many arguments, as far as can be told."""
    if not callable(value) or not parts or parts[0] is Ellipsis:
        return callable(value)
    try:
        signature(value).bind(*parts[0])
    except TypeError:
        return False
    except ValueError:  # of a built-in
        return True
    return True


def _hint_in_words(hint: Any, *, several: bool = False) -> str:
    """What an argument's hint asks for."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return " or ".join(dict.fromkeys(_hint_in_words(part, several=several) for part in parts))
    if kind is Literal:
        return " or ".join(map(repr, parts))
    if kind is Callable:
        known = bool(parts) and parts[0] is not Ellipsis
        return f"a function of {len(parts[0])} arguments" if known else "a function"
    if hint in _WORDS or kind in _WORDS:
        return _WORDS[hint if hint in _WORDS else kind][several]
    if kind in (Sequence, Iterable, list, set, frozenset):
        of = _hint_in_words(parts[0], several=True) if parts else ""
        return f"{'lists' if several else 'a list'}{f' of {of}' if of else ''}"
    name = getattr(kind, "__name__", "")
    if several or name in ("", "Any"):
        return "" if name == "Any" else name
    return f"{'an' if name[0] in 'AEIO' or name[:2].isupper() else 'a'} {name}"
