"""The error tree, one class per remedy, all under :class:`SSPError`, and checks of arguments."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence, Sized
from difflib import get_close_matches
from fractions import Fraction
from functools import cache
from importlib import import_module
from inspect import Parameter, Signature, isroutine, signature
from itertools import islice
from numbers import Integral, Real
from types import ModuleType
from typing import Any, NamedTuple, TypeGuard, cast

import numpy as np

_LONGEST = 60  # characters of a value in an error
_LISTED = 4  # entries of a table in an error
_NAMED = 8  # names listed in an error if none is similar
_DIGITS = 1_024 // 3  # of a number in an error: a few more than the greatest float has
_MOST_COUNTED = 2**63 - 1
_LOOKED_AT = 20_000  # names that are compared, so that a hint is found quickly
_ABSENT = object()  # instead of an attribute that does not exist


class Argument(NamedTuple):
    """An argument named in an error, written as in Python code.

    The command line replaces it by the option of the command.
    """

    name: str
    value: object = ...  # value to give; ...: the message has it already

    def __str__(self) -> str:
        """Return ``discount``, or with a value ``failure_budget=None``."""
        return self.name if self.value is ... else f"{self.name}={self.value!r}"


class SSPError(Exception):
    """Base class of all errors that this library raises on purpose.

    The message has several parts (``args``) if it names an :class:`Argument`.
    """

    is_of_argument = False  # wrong type of an argument: the caller names its own argument instead

    def __str__(self) -> str:
        """Return the message, with arguments as Python code writes them."""
        return "".join(map(str, self.args))

    def __reduce__(self) -> tuple[Callable[..., SSPError], tuple[object, ...], dict[str, object]]:
        """Pickle the message and the attributes, whatever the arguments of the constructor are."""
        return type(self).__new__, (type(self), *self.args), vars(self)


class ModelError(SSPError, ValueError):
    """The model or the problem is stated wrongly; the message names the place and the remedy."""


class ModelWarning(UserWarning):
    """The model can be solved as it stands, but may not be what was meant."""


class InfeasibleError(SSPError):
    """No policy satisfies the failure budget and the limits.

    Attributes:
        failure_budget: the failure budget of the problem, ``None`` if it has none.
        least_failure: the least failure probability of the known policies; computed on first use if
            the graph alone shows that the problem is infeasible.
        least_failure_interval: certified bounds of the least failure probability of all policies;
            the second is ``least_failure``, the first is 0 if nothing is proved.
        least_discounted_failure: the least discounted failure, ``None`` in the exact setting. It
            can exceed the budget although the least failure does not (paper, Theorem t2-2).
        conflicting_rows: names of the fewest rows found that contradict each other: limits, and
            "failure" for the budget; empty if no such rows were sought.
    """

    def __init__(
        self,
        *message: str | Argument,
        failure_budget: float | None,
        least_failure: float | Callable[[], float],
        least_discounted_failure: float | None = None,
        conflicting_rows: tuple[str, ...] = (),
        least_failure_bound: float = 0.0,
    ) -> None:
        super().__init__(*message)
        self._least_failure_bound = least_failure_bound
        self.failure_budget = failure_budget
        self._least_failure = least_failure
        self.least_discounted_failure = least_discounted_failure
        self.conflicting_rows = conflicting_rows

    @property
    def least_failure(self) -> float:
        """Least failure probability of any known policy."""
        least = self._least_failure
        self._least_failure = least() if callable(least) else least
        return self._least_failure

    @property
    def least_failure_interval(self) -> tuple[float, float]:
        """Certified bounds of the least failure: a lower bound, and the least of a known policy."""
        return min(self._least_failure_bound, self.least_failure), self.least_failure

    def __reduce__(self) -> tuple[Callable[..., SSPError], tuple[object, ...], dict[str, object]]:
        """Pickle the message and the numbers."""
        self._least_failure = self.least_failure
        return super().__reduce__()


class SolverError(SSPError, RuntimeError):
    """A method gave no answer that passes its check; the message says what was tried."""


class OutOfTimeError(SolverError):
    """The time limit passed before a task was finished.

    ``solve`` raises it if no policy that satisfies all limits was found. Other functions raise it
    if their own task is unfinished, which the message names, such as "a bound was proved".
    """


class MissingDependencyError(SSPError, ImportError):
    """An optional package is not installed; the message carries the pip line.

    Args:
        package: the package that could not be imported.
        extra: the extra of ``ssp-lp`` that brings it.
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(
            f"{package} is not installed: pip install '.[{extra}]' in a checkout of ssp-lp"
        )
        self.package = package
        self.extra = extra


def optional_module(name: str, extra: str) -> ModuleType:
    """Import an optional package's module, or raise the error with the pip line.

    Args:
        name: full name of the module ("matplotlib.pyplot").
        extra: the extra of ``ssp-lp`` that brings the package.

    Raises:
        MissingDependencyError: the package is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingDependencyError(name.partition(".")[0], extra) from error


def wrong_argument(name: str, requirement: str, value: object, hint: str = "") -> ModelError:
    """Return the error for a wrong argument: the requirement, the value, and a hint."""
    return ModelError(Argument(name), f" must {requirement}, not {in_short(value)}{hint}")


def attributes_of(thing: object, *names: str) -> dict[str, Any]:
    """Return the values of named attributes, name -> value, for those that the object has."""
    found = {name: getattr(thing, name, _ABSENT) for name in names}
    return {name: value for name, value in found.items() if value is not _ABSENT}


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a real number that fits a float.

    Numbers of Python and of numpy count, and fractions.
    """
    try:
        return isinstance(value, Real) and float(value) is not None
    except OverflowError:
        return False


def is_amount(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite number >= 0 that a float can hold."""
    return is_number(value) and 0.0 <= float(value) < math.inf


def as_percentage(share: object) -> str:
    """Return a hint that a share above 1 may be meant as a percentage; empty for other values."""
    if not (is_number(share) and 1.0 < share <= 100.0):
        return ""
    return f"; did you mean {float(share) / 100.0:.12g}?"


def check_between_0_and_1(name: str, value: object, hint: str = "") -> None:
    """Raise :class:`ModelError` unless an argument lies strictly between 0 and 1."""
    if not (is_number(value) and 0.0 < float(value) < 1.0):
        raise wrong_argument(name, "lie strictly between 0 and 1", value, hint)


def check_whole(name: str, value: object, least: int = 1, most: int = _MOST_COUNTED) -> None:
    """Raise :class:`ModelError` unless an argument is a whole number from ``least`` to ``most``."""
    counts = isinstance(value, Integral) and not isinstance(value, bool)
    if not (counts and least <= int(cast("int", value)) <= most):
        upto = f" and <= {most:,}" if counts and most < _MOST_COUNTED else ""
        raise wrong_argument(name, f"be a whole number >= {least}{upto}", value)


def check_flag(name: str, value: object) -> None:
    """Raise :class:`ModelError` unless an argument is True or False, of Python or of numpy."""
    if not isinstance(value, (bool, np.bool_)):
        raise wrong_argument(name, "be True or False", value)


_MEANT = {
    "failure_budget": "budget epsilon eps risk risk_budget delta max_failure failure_probability",
    "discount": "gamma discount_factor",
    "start": "initial_state initial init s0 x0 start_state",
    "constraints": "limits constraint limit rows",
    "method": "solver algorithm backend",
    "backend": "solver",
    "time_limit": "timeout max_time seconds",
    "tolerance": "tol eps gap rtol",
    "cost": "reward rewards costs",
    "costs": "reward rewards cost",
    "goal": "goals goal_states target targets terminal",
    "dead_ends": "dead_end deadends traps failures",
    "state_labels": "labels label",
    "seed": "rng random_state",
    "episodes": "n runs n_episodes num_episodes samples",
    "max_steps": "horizon steps n_steps",
    "horizon": "steps max_steps n_steps",
    "verbose": "verbosity log",
}
"""Names of arguments, each with the words that other libraries use for it."""


def meant_argument(word: str, own: Collection[str]) -> str | None:
    """Return the argument that is probably meant by a name that a function does not have, or None.

    ``own`` has the names of the function's arguments.
    """
    meant = next((one for one in own if word in _MEANT.get(one, "").split()), None)
    return cast("str | None", nearest_name(word, own)) if meant is None else meant


form_of = cache(signature)
"""Cached signature of a function: finding it takes longer than many calls do."""


def check_call(name: str, form: Signature, given: Sequence[object], named: Collection[str]) -> None:
    """Check that the arguments of a call exist, are given once, and are complete.

    Args:
        name: name of the function.
        form: its signature.
        given: positional arguments, with ``self`` if the signature has it.
        named: names of the keyword arguments.

    Raises:
        ModelError: a call that does not fit; the error names the wrong argument, and the argument
            that is probably meant or the correct call.
    """
    parts = form.parameters.values()
    own = [part.name for part in parts if part.name not in ("self", "cls")]
    kinds = {part.kind for part in parts}
    for word in () if Parameter.VAR_KEYWORD in kinds else named:
        if word not in own:
            meant = meant_argument(word, own)
            listed = f"; its arguments: {', '.join(own)}"
            nearest = listed if meant is None else f"; did you mean {meant!r}?"
            raise ModelError(f"{name} has no argument {word!r}{nearest}")
    placed = [part for part in parts if part.kind < Parameter.VAR_POSITIONAL]
    if len(given) > len(placed) and Parameter.VAR_POSITIONAL not in kinds:
        others = ", ".join(f"{part.name}=..." for part in parts if part not in placed)
        hint = f"; give others by name: {others}" if others else ""
        taken = ", ".join(part.name for part in placed if part.name in own)
        told = f"({taken})" if taken else "nothing"
        raise ModelError(f"{name} takes {told} by position{hint}")
    for part in placed[: len(given)]:
        if part.name in named:
            raise ModelError(f"{name} is given {part.name!r} twice, by position and by name")
    needed = [p for p in parts if p.default is p.empty and p.kind not in _REST and p.name in own]
    reached = {part.name for part in placed[: len(given)]}
    if missing := [part.name for part in needed if part.name not in reached.union(named)]:
        written = ", ".join(f"{p.name}=..." if p.kind is p.KEYWORD_ONLY else p.name for p in needed)
        listed = ", ".join(map(repr, missing))
        raise ModelError(f"{name} needs {listed}: write {name}({written})")


_REST = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
"""Kinds of parameters for any number of arguments, also none: ``*args`` and ``**kwargs``."""


def in_short(value: Any) -> str:
    """Return a value's repr for an error, or its type and size if the repr is long."""
    if isinstance(value, enum.Enum):
        return repr(str(value.value))
    if isinstance(value, (int, Fraction)) and not isinstance(value, bool):
        bits = max(value.numerator.bit_length(), value.denominator.bit_length())
        digits = int(bits * math.log10(2.0))
        return str(value) if digits <= _DIGITS else f"<{type(value).__name__} of {digits:,} digits>"
    if isinstance(value, np.ndarray):
        return f"<array of shape {value.shape}>"
    if isinstance(value, np.generic):
        return repr(value.item())
    if isinstance(value, Mapping) and len(value) <= _LISTED:
        text = ", ".join(f"{in_short(k)}: {in_short(v)}" for k, v in value.items())
        return f"{{{text}}}"
    if isroutine(value) or isinstance(value, (type, np.ufunc)):
        return f"<{value.__name__}>".replace("<<lambda>>", "<lambda>")
    if isinstance(value, Sized) and not isinstance(value, str) and len(value) > _LISTED:
        return f"<{type(value).__name__} of {len(value):,}>"
    if type(value) in (list, tuple):
        text = ", ".join(map(in_short, value))
        return f"[{text}]" if isinstance(value, list) else f"({text}{',' * (len(value) == 1)})"
    text = repr(value)
    return text if len(text) <= _LONGEST or value is None else f"{text[: _LONGEST - 3]}..."


def nearest_name(unknown: Hashable, names: Iterable[Hashable]) -> Hashable | None:
    """Return the existing name that is probably meant by an unknown one, or None.

    A name that prints in the same way counts as nearest, such as 3 for '3' or (1, 2) for [1, 2].
    """
    some = list(islice(names, _LOOKED_AT))
    plain = _as_read_for_error(unknown)
    meant = next((name for name in some if _as_read_for_error(name) == plain), None)
    if meant is None and isinstance(unknown, str):
        words = {name.casefold(): name for name in some if isinstance(name, str)}
        near = get_close_matches(unknown.casefold(), words, n=1)
        meant = words[near[0]] if near else None
    return meant


def did_you_mean(unknown: Hashable, names: Iterable[Hashable], listed: str = "") -> str:
    """Return a clause for the end of an error: "; did you mean 'depot'?", or nothing.

    Args:
        unknown: the name that was given.
        names: the existing names.
        listed: words before a list of the first names if none is near, such as "it has".
    """
    some = names if isinstance(names, Collection) else list(names)
    if (meant := nearest_name(unknown, some)) is not None:
        return f"; did you mean {meant!r}?"
    more = f", ... ({len(some):,})" if len(some) > _NAMED else ""
    first = ", ".join(map(repr, islice(some, _NAMED))) or "none"
    return f"; {listed} {first}{more}" if listed else ""


def _as_read_for_error(name: Hashable) -> str:
    """Return a name in lower case without quotes, brackets and blanks, for comparison."""
    return str(name).translate(_DROPPED).casefold()


_DROPPED = str.maketrans("", "", "'\"()[] _-")
