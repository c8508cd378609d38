"""The known name nearest to an unknown one, for errors; the work is bounded."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from difflib import get_close_matches
from itertools import islice
from typing import TypeVar

_Value = TypeVar("_Value")


class ByName(dict[str, _Value]):
    """Values by name, whose KeyError says which name was probably meant."""

    def __missing__(self, name: object) -> _Value:
        """Raise :class:`KeyError`."""
        names = ", ".join(map(repr, self)) or "none"
        nearest = did_you_mean(name, self) or f"; there are {names}"
        raise KeyError(f"{name!r} is no name here{nearest}")


_LOOKED_AT = 20_000
"""Names that are compared: beyond them a slip of the pen costs more time than it is worth."""


def did_you_mean(unknown: Hashable, names: Iterable[Hashable]) -> str:
    """A clause for the end of an error: "; did you mean 'depot'?", or nothing.

    A name that reads the same counts as nearest, such as 3 for '3' or (1, 2) for [1, 2].
    """
    some = list(islice(names, _LOOKED_AT))
    plain = _as_read(unknown)
    found = next((name for name in some if _as_read(name) == plain), None)
    if found is None and isinstance(unknown, str):
        words = [name for name in some if isinstance(name, str)]
        found = next(iter(get_close_matches(unknown, words, n=1)), None)
    return "" if found is None else f"; did you mean {found!r}?"


def _as_read(name: Hashable) -> str:
    """A name without what people slip on: quotes, brackets, blanks, capitals."""
    return str(name).translate(_DROPPED).casefold()


_DROPPED = str.maketrans("", "", "'\"()[] _-")
