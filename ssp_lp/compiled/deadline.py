"""The end of the time that a call was given, looked at inside its loops; Ctrl-C ends them alike.

The deadline belongs to the call: ``until`` sets it for all that runs within, on the same thread,
and every pass over a process, compiled or not, looks at it. Loops that have an answer hand that
on (``WithIncumbent``); where nobody has one, the stop reaches the caller.
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
"""Seconds beyond the deadline for which a loop goes on: what small models need is soon done."""

_CLOSING = 0.65
"""Seconds beyond the deadline by which what an answer still needs is done: measures, a proof."""

READING = 10.0
"""Seconds that a number may take which is worked out where it is only read."""

_LEAST = 0.1  # seconds for each of them in any case
_PREPARED = 1.0  # seconds of a search after which an answer is to be in hand
_PREPARED_SHARE = 0.1  # of the time limit, where that is less
_PREPARED_UNLIMITED = 10.0  # the same where only Ctrl-C ends the search
_PREPARING = 0.9  # share of the time left that it may take
_CLOSING_SHARE = 0.1  # of what was spent before, where it was Ctrl-C that stopped the search
_PIECE = 1_000_000  # entries of a compiled loop between two looks: some hundredths of a second


class Stop(Exception):  # noqa: N818 (it steers, as StopIteration does)
    """A loop was told to end. It carries the policy that the loop had come to, if it had one.

    Args:
        choice: the policy, in the terms of the loop.
        told: what was known by then, in words.
    """

    def __init__(self, choice: Any = None, told: str = "") -> None:
        super().__init__(told)
        self.choice, self.told = choice, told


def interrupted(told: str = "") -> KeyboardInterrupt:
    """The error of a call that Ctrl-C ended before it had an answer; ``told``: what was known."""
    return KeyboardInterrupt("interrupted before there was an answer" + (told and f" ({told})"))


STOPS: Final = (Stop, KeyboardInterrupt)


@dataclass(eq=False)
class Deadline:
    """When a call has to end, and what ended it."""

    at: float = float("inf")  # on the clock of time.perf_counter
    grace: float = _GRACE
    began: float = 0.0
    is_interrupted: bool = False  # by Ctrl-C
    closes: float = float("inf")  # what an answer still needs is to be done by then
    was_met: bool = False  # whether some loop ended because of it
    prepare: Callable[[], Any] | None = None  # finds an answer where none is in hand soon
    prepared: Any = None  # what it found
    due: float = 0.0  # when a look at it is due: an answer is to be prepared, or it is past
    late: str = "the time limit ended before there was an answer: allow more time"
    _before: Token[Deadline | None] | None = None

    def __enter__(self) -> Deadline:
        """All that runs from now on, on this thread, ends with it."""
        self._before = _running.set(self)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """What was the deadline before is it again; no stop leaves the outermost of a call.

        Ctrl-C within it ends what is around it, too.

        Raises:
            OutOfTimeError: nobody within had an answer to go on with.
            KeyboardInterrupt: the same where Ctrl-C came.
        """
        if self._before is not None:
            _running.reset(self._before)
        if self.is_interrupted and is_within_call():
            end_with_incumbent(KeyboardInterrupt())
        if isinstance(error, Stop) and _running.get() is None:
            if self.is_interrupted:
                raise interrupted(error.told) from None
            raise OutOfTimeError(self.late) from None

    def find_incumbent(self) -> None:
        """Find an incumbent before the deadline, with a share of its time, where there is none."""
        prepare, self.prepare, now = self.prepare, None, time.perf_counter()
        if prepare is None or self.is_past():
            return
        with until(now + _PREPARING * (self.at - now)):
            self.prepared = prepare()

    def look(self) -> None:
        """Raise Stop in the loop that asks if the deadline is past; before that find an incumbent.

        Raises:
            Stop: the deadline has passed, with its grace, or Ctrl-C came.
        """
        if time.perf_counter() > self.due:
            self.find_incumbent()
            self.due = self.at + self.grace
        if self.is_past(self.grace):
            raise Stop

    def is_past(self, grace: float = 0.0) -> bool:
        """Whether the deadline is past, which is remembered."""
        past = self.is_interrupted or time.perf_counter() > self.at + grace
        self.was_met = self.was_met or past
        return past

    def status(self, gap: float, tolerance: float) -> Status:
        """Why a call ended with an answer of this gap: tolerance met, deadline, or neither."""
        if gap <= tolerance:
            return Status.OPTIMAL
        if self.is_interrupted:
            return Status.INTERRUPTED
        return Status.TIME_LIMIT if self.was_met else Status.TOLERANCE_MISSED


_running: ContextVar[Deadline | None] = ContextVar("deadline", default=None)


def until(
    at: float, *, is_closing: bool = False, prepare: Callable[[], Any] | None = None
) -> Deadline:
    """Context with a deadline: loops end at a point in time, or when Ctrl-C comes.

    Args:
        at: on the clock of ``time.perf_counter``; infinite: only Ctrl-C ends them.
        is_closing: there is no grace after that.
        prepare: finds an answer, and says what, if any. It is called in the middle of a search that
            goes on for a moment without one, with a share of the time that is left.
    """
    grace, more = (0.0, 0.0) if is_closing else (_GRACE, _CLOSING)
    now = time.perf_counter()
    soon = min(_PREPARED, _PREPARED_SHARE * (at - now)) if isfinite(at) else _PREPARED_UNLIMITED
    due = at + grace if prepare is None else now + soon
    return Deadline(at, grace, now, closes=at + more, prepare=prepare, due=due)


@contextmanager
def limited(time_limit: float | None, doing: str) -> Iterator[None]:
    """Context with a deadline some seconds ahead; None: the deadline of the surrounding call.

    Args:
        time_limit: seconds.
        doing: what is not done then, in words.

    Raises:
        ModelError: a limit that is no number of seconds.
        OutOfTimeError: the time ended before that.
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
    """Context past the deadline with a little time left to prove the incumbent.

    Ctrl-C within it ends it at once. Nothing changes where the deadline is not past.
    """
    outer = _running.get()
    if outer is None or not (outer.is_interrupted or time.perf_counter() > outer.at):
        yield
        return
    with until(max(outer.closes, time.perf_counter() + _LEAST), is_closing=True):
        yield


def has_time_for(seconds: float) -> bool:
    """Whether so many seconds of work fit before the deadline, time to prove included."""
    outer, now = _running.get(), time.perf_counter()
    if outer is None or not (outer.is_interrupted or now > outer.at):
        return True
    return seconds <= max(outer.closes - now, _LEAST)


def check_time() -> None:
    """Raise Stop in the loop that asks if the deadline is past.

    Raises:
        Stop: the deadline has passed, with its grace, or Ctrl-C came.
    """
    deadline = _running.get()
    if deadline is not None and (deadline.is_interrupted or time.perf_counter() > deadline.due):
        deadline.look()


def ensure_incumbent(*, by_itself: bool = False) -> None:
    """Make sure of an incumbent before a search that may last until the deadline.

    Args:
        by_itself: the search has one: none need be prepared. Where only Ctrl-C ends it, one is
            looked for as in every search, after some seconds.
    """
    deadline = _running.get()
    if deadline is not None and by_itself:
        deadline.prepare = None
    elif deadline is not None and isfinite(deadline.at):
        deadline.find_incumbent()


def prepared() -> Any:
    """The incumbent that was found beside the search; None: there is none."""
    deadline = _running.get()
    return None if deadline is None else deadline.prepared


def is_late() -> bool:
    """Whether the deadline tells a loop with an incumbent to end."""
    deadline = _running.get()
    return deadline is not None and deadline.is_past()


def is_within_call() -> bool:
    """Whether a deadline is set: this is part of a call that ends in time."""
    return _running.get() is not None


def is_limited() -> bool:
    """Whether the deadline is a time limit, not Ctrl-C alone."""
    deadline = _running.get()
    return deadline is not None and deadline.at < float("inf")


def seconds_left() -> float:
    """Seconds until the deadline; infinite where only Ctrl-C ends the call."""
    deadline = _running.get()
    return float("inf") if deadline is None else deadline.at - time.perf_counter()


def end_with_incumbent(stop: BaseException) -> None:
    """Tell the deadline that a stop was caught by who has an incumbent: other loops end too.

    Raises:
        KeyboardInterrupt: nobody said, by ``until``, that an answer so far is wanted.
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
    """Within it a stop, or Ctrl-C, ends the block and no more: there is an answer to go on with.

    with WithIncumbent() as search:
        column = pricing.minimise(price)
    if search.stop: ...
    """

    stop: BaseException | None = None
    """What ended the block, if anything did."""

    def __enter__(self) -> WithIncumbent:
        """The block begins."""
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        """Keep what ended it, if that was a stop."""
        if not isinstance(error, STOPS):
            return False
        end_with_incumbent(error)
        self.stop = error
        return True


def backward(end: int, begin: int = 0) -> Iterator[int]:
    """Layers or points in time, the last first, with a look at the time before each."""
    for layer in reversed(range(begin, end)):
        check_time()
        yield layer


def pieces(length: int, entries: int) -> Iterable[slice]:
    """A long loop in pieces, with a look at the deadline, and at Ctrl-C, before each.

    Args:
        length: turns of the loop.
        entries: that it passes over in all.
    """
    if entries > _PIECE:
        return _several_pieces(length, -(-entries // _PIECE))
    check_time()
    return (slice(0, length),)


def _several_pieces(length: int, count: int) -> Iterator[slice]:
    """Pieces of a loop between looks at the deadline, about as long as each other."""
    bounds = np.linspace(0, length, count + 1).astype(np.int64).tolist()
    for begin, end in pairwise(bounds):
        check_time()
        yield slice(begin, end)
