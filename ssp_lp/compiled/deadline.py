"""Time limits and Ctrl-C: long loops check whether the call should stop.

The deadline belongs to the call: ``until`` sets it for all code that runs within, on the same
thread. Every pass over a process, compiled or not, checks it and raises :class:`Stop`. A loop with
an incumbent (the best solution so far) catches the stop and returns the incumbent
(``WithIncumbent``). If no loop has an incumbent, the stop reaches the caller as an error.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar, Token
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isfinite
from typing import Any, Final

import numpy as np

from ssp_lp.errors import OutOfTimeError
from ssp_lp.options import Status, deadline_of

_GRACE = 0.25
"""Seconds beyond the deadline for which a loop goes on, so that small models are finished."""

_CLOSING = 0.65
"""Seconds beyond the deadline in which the answer is completed: evaluation and proof."""

READING = 10.0
"""Seconds allowed for an attribute that is computed when it is read."""

_LEAST = 0.1  # least seconds for completing an answer
_PREPARED = 1.0  # seconds of a search after which an incumbent must exist
_PREPARED_SHARE = 0.1  # the same as a share of the time limit; the shorter time counts
_PREPARED_UNLIMITED = 10.0  # the same in seconds if only Ctrl-C ends the search
_PREPARING = 0.9  # greatest share of the remaining time for finding an incumbent
_CLOSING_SHARE = 0.1  # time for completing an answer after Ctrl-C, as a share of the time so far
_PIECE = 1_000_000  # entries of a loop between two checks of the time: some hundredths of a second


class Stop(Exception):  # noqa: N818 (no error, as StopIteration)
    """Exception that ends a loop, with the policy that the loop has found so far, if any.

    Args:
        choice: the policy, in the loop's own form.
        note: the results so far, in words, for the error's message.
    """

    def __init__(self, choice: Any = None, note: str = "") -> None:
        super().__init__(note)
        self.choice, self.note = choice, note


def interrupted(note: str = "") -> KeyboardInterrupt:
    """Return the error for Ctrl-C before there was an answer; ``note``: the results so far."""
    return KeyboardInterrupt("interrupted before there was an answer" + (note and f" ({note})"))


STOPS: Final = (Stop, KeyboardInterrupt)


@dataclass(eq=False)
class Deadline:
    """The time at which a call must end, and the reason for which it ended."""

    at: float = float("inf")  # time by time.perf_counter
    grace: float = _GRACE
    began: float = 0.0
    is_interrupted: bool = False  # by Ctrl-C
    closes: float = float("inf")  # time by which the answer must be completed
    was_met: bool = False  # whether a loop ended because of the deadline
    prepare: Callable[[], Any] | None = None  # finds an incumbent for a search without one
    prepared: Any = None  # the incumbent that ``prepare`` found
    due: float = 0.0  # time of the next check: to prepare an incumbent, or to stop
    late: str = "the time limit ended before there was an answer: allow more time"
    _before: Token[Deadline | None] | None = None

    def __enter__(self) -> Deadline:
        """Set the deadline for all code that runs from now on, on this thread."""
        self._before = _running.set(self)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Restore the previous deadline; the outermost one turns a stop into an error.

        Ctrl-C also ends the surrounding calls.

        Raises:
            OutOfTimeError: the time ended before there was an answer.
            KeyboardInterrupt: Ctrl-C was pressed before there was an answer.
        """
        if self._before is not None:
            _running.reset(self._before)
        if self.is_interrupted and is_within_call():
            end_with_incumbent(KeyboardInterrupt())
        if isinstance(error, Stop) and _running.get() is None:
            if self.is_interrupted:
                raise interrupted(error.note) from None
            raise OutOfTimeError(self.late) from None

    def find_incumbent(self) -> None:
        """Find an incumbent by ``prepare``, if set, within a share of the remaining time."""
        prepare, self.prepare, now = self.prepare, None, time.perf_counter()
        if prepare is None or self.is_past():
            return
        with until(now + _PREPARING * (self.at - now)):
            self.prepared = prepare()

    def look(self) -> None:
        """Find an incumbent if it is time for one; raise Stop if the deadline has passed.

        Raises:
            Stop: the deadline and its grace period have passed, or Ctrl-C was pressed.
        """
        if time.perf_counter() > self.due:
            self.find_incumbent()
            self.due = self.at + self.grace
        if self.is_past(self.grace):
            raise Stop

    def is_past(self, grace: float = 0.0) -> bool:
        """Return whether time is up (deadline plus grace, or Ctrl-C); if so, set ``was_met``."""
        past = self.is_interrupted or time.perf_counter() > self.at + grace
        self.was_met = self.was_met or past
        return past

    def status(self, gap: float, tolerance: float) -> Status:
        """Return the status of a call: optimal, interrupted, time limit or tolerance missed."""
        if gap <= tolerance:
            return Status.OPTIMAL
        if self.is_interrupted:
            return Status.INTERRUPTED
        return Status.TIME_LIMIT if self.was_met else Status.TOLERANCE_MISSED


_running: ContextVar[Deadline | None] = ContextVar("deadline", default=None)


def until(
    at: float, *, is_closing: bool = False, prepare: Callable[[], Any] | None = None
) -> Deadline:
    """Return a context with a deadline, at which loops end; Ctrl-C ends them as well.

    Args:
        at: time by ``time.perf_counter``; infinite: only Ctrl-C ends the loops.
        is_closing: True: there is no grace period after this time.
        prepare: function that finds and returns an incumbent, or None. It is called if a search has
            no incumbent after a while, and may take a share of the remaining time.
    """
    grace, more = (0.0, 0.0) if is_closing else (_GRACE, _CLOSING)
    now = time.perf_counter()
    soon = min(_PREPARED, _PREPARED_SHARE * (at - now)) if isfinite(at) else _PREPARED_UNLIMITED
    due = at + grace if prepare is None else now + soon
    return Deadline(at, grace, now, closes=at + more, prepare=prepare, due=due)


@contextmanager
def limited(time_limit: float | None, doing: str) -> Iterator[None]:
    """Set a time limit for a context; None: keep the deadline of the surrounding call.

    Args:
        time_limit: seconds.
        doing: clause of the error that says when the task is done, such as "a bound was proved".

    Raises:
        ModelError: the limit is not a number of seconds.
        OutOfTimeError: the time ended before the task was done.
    """
    if time_limit is None:
        yield
        return
    late = f"the time limit of {time_limit:g} s ended before {doing}: allow more time"
    try:
        with replace(until(deadline_of(time_limit, time.perf_counter())), late=late):
            yield
    except Stop:
        raise OutOfTimeError(late) from None


@contextmanager
def closing() -> Iterator[None]:
    """Allow a little time after the deadline to evaluate the incumbent and to prove its bound.

    A further Ctrl-C ends this extra time. Before the deadline the context changes nothing.
    """
    outer = _running.get()
    if outer is None or not (outer.is_interrupted or time.perf_counter() > outer.at):
        yield
        return
    with until(max(outer.closes, time.perf_counter() + _LEAST), is_closing=True):
        yield


def has_time_for(seconds: float) -> bool:
    """Return whether there is time for work of some seconds.

    Before the deadline there always is. After the deadline the work must fit into the extra time of
    ``closing``.
    """
    outer, now = _running.get(), time.perf_counter()
    if outer is None or not (outer.is_interrupted or now > outer.at):
        return True
    return seconds <= max(outer.closes - now, _LEAST)


def check_time() -> None:
    """Raise Stop in the calling loop if the deadline has passed.

    Raises:
        Stop: the deadline and its grace period have passed, or Ctrl-C was pressed.
    """
    deadline = _running.get()
    if deadline is not None and (deadline.is_interrupted or time.perf_counter() > deadline.due):
        deadline.look()


def ensure_incumbent(*, by_itself: bool = False) -> None:
    """Find an incumbent now, before a search that may last until the deadline.

    Without a time limit it is found later, if the search takes long.

    Args:
        by_itself: whether the search finds incumbents itself; then none is prepared.
    """
    deadline = _running.get()
    if deadline is not None and by_itself:
        deadline.prepare = None
    elif deadline is not None and isfinite(deadline.at):
        deadline.find_incumbent()


def prepared() -> Any:
    """Return the incumbent that was prepared during the search; None if there is none."""
    deadline = _running.get()
    return None if deadline is None else deadline.prepared


def is_late() -> bool:
    """Return whether the deadline has passed, so that a loop with an incumbent should end."""
    deadline = _running.get()
    return deadline is not None and deadline.is_past()


def is_within_call() -> bool:
    """Return whether a deadline is set by a surrounding call."""
    return _running.get() is not None


def is_limited() -> bool:
    """Return whether there is a time limit (Ctrl-C alone does not count)."""
    deadline = _running.get()
    return deadline is not None and deadline.at < float("inf")


def seconds_left() -> float:
    """Return the seconds until the deadline; infinite if only Ctrl-C ends the call."""
    deadline = _running.get()
    return float("inf") if deadline is None else deadline.at - time.perf_counter()


def end_with_incumbent(stop: BaseException) -> None:
    """Record that a loop with an incumbent was stopped, so that later loops of the call end too.

    Raises:
        KeyboardInterrupt: no deadline is set, so that no call returns an incumbent.
    """
    deadline = _running.get()
    if isinstance(stop, KeyboardInterrupt):
        if deadline is None:
            raise stop
        deadline.is_interrupted, now = True, time.perf_counter()
        deadline.closes = now + max(_CLOSING, _CLOSING_SHARE * (now - deadline.began))
    if deadline is not None:
        deadline.was_met = True


class WithIncumbent:
    """Context in which a stop or Ctrl-C ends only the block, since there is an incumbent.

    with WithIncumbent() as search:
        column = pricing.minimise(price)
    if search.stop: ...
    """

    stop: BaseException | None = None
    """The stop or interrupt that ended the block, if any."""

    def __enter__(self) -> WithIncumbent:
        """Return the context itself."""
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        """Store and suppress a stop or interrupt that ended the block."""
        if not isinstance(error, STOPS):
            return False
        end_with_incumbent(error)
        self.stop = error
        return True


def backward(end: int, begin: int = 0) -> Iterator[int]:
    """Yield the numbers end - 1 down to begin, checking the deadline before each."""
    for layer in reversed(range(begin, end)):
        check_time()
        yield layer


def pieces(length: int, entries: int) -> Iterable[slice]:
    """Split a long loop into pieces, checking the deadline before each.

    Args:
        length: number of iterations of the loop.
        entries: number of entries in all iterations.
    """
    if entries > _PIECE:
        return _several_pieces(length, -(-entries // _PIECE))
    check_time()
    return (slice(0, length),)


def _several_pieces(length: int, count: int) -> Iterator[slice]:
    """Yield pieces of a loop of about equal length, checking the deadline before each."""
    bounds = np.linspace(0, length, count + 1).astype(np.int64).tolist()
    for begin, end in pairwise(bounds):
        check_time()
        yield slice(begin, end)
