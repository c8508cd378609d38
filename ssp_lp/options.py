"""Solution methods, solver options, status codes and progress reporting."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import ClassVar, Self, TextIO

from ssp_lp.arrays import RELATIVE_GAP
from ssp_lp.errors import (
    ModelError,
    check_between_0_and_1,
    check_call,
    check_flag,
    form_of,
    is_number,
    wrong_argument,
)

BACKENDS = ("highs", "highs-simplex", "highs-ipx", "cvxpy")
"""Backends for linear programs."""


class Status(StrEnum):
    """Reason for which a call ended with the answer that it returns."""

    OPTIMAL = "optimal: the certified gap meets the tolerance"
    TIME_LIMIT = "stopped by the time limit: the best answer so far, with its certified gap"
    INTERRUPTED = "interrupted: the best answer so far, with its certified gap"
    TOLERANCE_MISSED = "the certified gap misses the tolerance"


Progress = Callable[[int, float, float], None]
"""Function called after each pricing call with (calls, failure price, objective)."""

LOGGER = "ssp_lp"
"""Logger of progress reports; its children, one for each phase ("ssp_lp.search", ...), are listed
in docs/solving.md. Finished work is logged at level INFO, progress at DEBUG, with the finished
``share`` as a field of the record if it is known."""

_SEARCH = logging.getLogger(f"{LOGGER}.search")
_PATIENCE = 1.0  # seconds before a line is shown that will be overwritten
_BETWEEN = 0.1  # seconds between two progress reports
_WIDTH, _BAR = 100, 20  # characters of a line, and of a bar in it


class _Option:
    """Mix-in of solution methods: an error for a misspelled option names the likely one."""

    def __new__(cls, *given: object, **named: object) -> Self:
        """Raise :class:`ModelError` for an unknown option."""
        check_call(cls.__name__, form_of(cls.__init__), (None, *given), named)
        return super().__new__(cls)


@dataclass(frozen=True)
class ColumnGeneration(_Option):
    """Column generation, the default: pricing adds policies one by one to a small program."""

    name: ClassVar[str] = "columns"


@dataclass(frozen=True)
class LinearProgramming(_Option):
    """The full linear program; pricing at its duals then finds the policies of the answer.

    Args:
        backend: "highs", "highs-simplex", "highs-ipx" or "cvxpy"; None: chosen by the
            size of the program.

    Raises:
        ModelError: an unknown backend.
    """

    backend: str | None = None

    name: ClassVar[str] = "lp"

    def __post_init__(self) -> None:
        if self.backend is not None and self.backend not in BACKENDS:
            backends = ", ".join(BACKENDS)
            raise wrong_argument("backend", f"be one of {backends}", self.backend)


@dataclass(frozen=True)
class Game(_Option):
    """The paper's value iteration and zero-sum game (section 3.5).

    Requires a discount and a budget above 0.

    Args:
        tail: in case S the paper's M, a total cost above 0. It restricts policies to Pi_{M,pi'_or}:
            once M is paid they fail as surely as possible. The cost of the answer is measured
            exactly, and the bound holds for all policies; :func:`ssp_lp.game.stationary_game` with
            this tail gives the paper's c-hat_M. None: M grows until the restriction costs nothing.

    Raises:
        ModelError: a tail that is not a number above 0.
    """

    tail: float | None = None

    name: ClassVar[str] = "game"

    def __post_init__(self) -> None:
        if self.tail is not None:
            object.__setattr__(self, "tail", check_tail(self.tail))


def check_tail(tail: object) -> float:
    """Return the game's M as a float; :class:`ModelError` unless it is above 0 and finite."""
    if not (is_number(tail) and 0.0 < float(tail) < float("inf")):
        raise wrong_argument("tail", "be a total cost above 0", tail)
    return float(tail)


@dataclass(frozen=True)
class DeterministicPolicies(_Option):
    """The best deterministic policy, by branch and bound.

    The action depends on the model's state; in case S on (state, accumulated cost).

    Args:
        relaxation: method that finds the best lottery, with which the search begins.

    Raises:
        ModelError: another method.
    """

    relaxation: ColumnGeneration | LinearProgramming | str = field(default_factory=ColumnGeneration)

    name: ClassVar[str] = "deterministic"

    def __post_init__(self) -> None:
        relaxation = parse_method(self.relaxation)
        if not isinstance(relaxation, (ColumnGeneration, LinearProgramming)):
            raise wrong_argument("relaxation", "be 'columns' or 'lp'", self.relaxation)


Method = ColumnGeneration | LinearProgramming | Game | DeterministicPolicies


def parse_method(method: Method | str | None) -> Method:
    """Return the method with a given name; a method unchanged; column generation for None.

    Raises:
        ModelError: no method or name of one.
    """
    if method is None:
        return _BY_NAME[ColumnGeneration.name]
    if isinstance(method, Method):
        return method
    if isinstance(method, str) and method in _BY_NAME:
        return _BY_NAME[method]
    names = ", ".join(repr(name) for name in _BY_NAME)
    wanted = f"be one of {names}, or a value such as LinearProgramming()"
    raise wrong_argument("method", wanted, method)


_BY_NAME: dict[str, Method] = {
    method.name: method
    for method in (ColumnGeneration(), LinearProgramming(), Game(), DeterministicPolicies())
}


@dataclass(frozen=True)
class SolveOptions:
    """Options of a search: tolerance, method and time limit."""

    tolerance: float = RELATIVE_GAP
    deadline: float = float("inf")  # on the clock of time.perf_counter
    progress: Progress | None = None
    program: LinearProgramming | None = None  # solve the full linear program first
    deterministic: bool = False  # the policy may not be a lottery
    tail: float | None = None  # the M of the game, in case S

    @property
    def method(self) -> str:
        """Name of the method."""
        if self.deterministic:
            return DeterministicPolicies.name
        return ColumnGeneration.name if self.program is None else self.program.name

    def after(self, calls: int) -> SolveOptions:
        """Return the options for a further search, whose reports also count earlier pricing calls.

        ``calls`` is the number of earlier calls.
        """
        progress = self.progress
        if progress is None:
            return self
        return replace(self, progress=lambda more, *rest: progress(calls + more, *rest))


CERTIFYING = SolveOptions()
"""Options of a certificate that must search for its bound."""


def options_of(
    method: Method,
    tolerance: float,
    began: float,
    time_limit: float | None,
    progress: Progress | None,
) -> SolveOptions:
    """Return checked options for a search.

    Args:
        method: :class:`LinearProgramming` solves the full linear program; for
            :class:`DeterministicPolicies` the options are those of its relaxation.
        tolerance: relative gap to reach.
        began: start of the call, on the clock of ``time.perf_counter``.
        time_limit: seconds from the start of the call; None: unlimited.
        progress: see ``Progress``.

    Raises:
        ModelError: a tolerance outside (0, 1), or a time limit that is not a number of seconds.
    """
    check_between_0_and_1("tolerance", tolerance)
    if progress is not None and not callable(progress):
        raise ModelError(f"progress must be a function or None, not {progress!r}: pass "
                         "verbose=True to show how far work has come")  # fmt: skip

    def report(calls: int, price: float, objective: float) -> None:
        """Report to the logger, then to the caller's ``progress``."""
        _SEARCH.debug("%d pricing calls, price %.6g, objective %.9g", calls, price, objective)
        if progress is not None:
            progress(calls, price, objective)

    deadline = deadline_of(time_limit, began)
    single = isinstance(method, DeterministicPolicies)
    tail = method.tail if isinstance(method, Game) else None
    if isinstance(method, DeterministicPolicies):
        method = parse_method(method.relaxation)
    program = method if isinstance(method, LinearProgramming) else None
    return SolveOptions(float(tolerance), deadline, report, program, single, tail)


def deadline_of(time_limit: float | None, began: float, name: str = "time_limit") -> float:
    """Return the time at which a time limit ends, on the clock of ``time.perf_counter``.

    It is infinite without a limit (None). ``name`` is the name of the option, for the error.

    Raises:
        ModelError: a limit that is not a number of seconds.
    """
    if time_limit is not None and not (is_number(time_limit) and time_limit >= 0.0):
        raise wrong_argument(name, "be a number of seconds", time_limit)
    return float("inf") if time_limit is None else began + float(time_limit)


@contextmanager
def progress_shown(verbose: bool = True, *, lasting: bool = True) -> Iterator[None]:
    """Show each phase of the library's work on standard error, while the context lasts.

    A terminal or a notebook also shows a bottom line with the progress of the current phase.
    Without this context nothing is shown; ``logging`` has the same reports under the name "ssp_lp".

    Args:
        verbose: False: show nothing.
        lasting: False: show a single line, from the first second on, which is overwritten and
            finally removed.

    Raises:
        ModelError: an argument is neither True nor False.

    Example:
        >>> with progress_shown():
        ...     pass  # SSP.from_successors(...), solve(...), trace_frontier(...)
    """
    check_flag("verbose", verbose)
    check_flag("lasting", lasting)
    logger = logging.getLogger(LOGGER)
    if not verbose or any(isinstance(known, _ProgressLines) for known in logger.handlers):
        yield
        return
    shown = _ProgressLines(sys.stderr, lasting)
    level, passed_on = logger.level, logger.propagate
    logger.addHandler(shown)
    logger.setLevel(logging.DEBUG)
    logger.propagate = False  # or handlers of the root logger would report it, too
    try:
        yield
    finally:
        logger.removeHandler(shown)
        logger.setLevel(level)
        logger.propagate = passed_on
        shown.close()


class _ProgressLines(logging.Handler):
    """Handler that prints a line for each finished phase, and one line for the current phase.

    The line of the current phase is overwritten, so it is shown only where that is possible.
    """

    def __init__(self, stream: TextIO, lasting: bool) -> None:
        super().__init__()
        self._stream, self._began, self._lasting = stream, time.perf_counter(), lasting
        self._overwrites = stream.isatty() or "ipykernel" in sys.modules
        self._told, self._under_way = 0.0, False

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line of progress in place of the line of the current phase."""
        now, done = time.perf_counter(), record.levelno > logging.DEBUG
        if not self._lasting and now - self._began < _PATIENCE:
            return
        done = done and self._lasting
        if not done and not (self._overwrites and now - self._told >= _BETWEEN):
            return
        phase = record.name.rpartition(".")[2]
        share: float | None = getattr(record, "share", None)
        bar = "" if share is None else f"[{'#' * int(_BAR * share):-<{_BAR}}] "
        line = f"{now - self._began:8.1f} s  {phase:<10}  {bar}{record.getMessage()}"
        self._clear()
        self._stream.write(f"{line}\n" if done else line[:_WIDTH])
        self._stream.flush()
        self._told, self._under_way = (self._told, False) if done else (now, True)

    def close(self) -> None:
        """Clear the line of the current phase, and close the handler."""
        self._clear()
        super().close()

    def _clear(self) -> None:
        """Clear the line of the current phase, if one is shown."""
        if self._under_way:
            self._stream.write(f"\r{' ' * _WIDTH}\r")
            self._under_way = False
