"""Whether inner loops run compiled by numba (extra ``fast``) or as numpy expressions.

Every compiled loop has a numpy twin of the same shape; results agree to rounding. The modules of
``ssp_lp.compiled`` import numba and are imported only when a loop is long enough to be worth it.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from pathlib import Path
from typing import Final, ParamSpec, TypeVar

from ssp_lp.compiled.deadline import seconds_left
from ssp_lp.errors import ModelError

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

SWITCH: Final = "SSP_LP_ACCELERATOR"
"""Environment variable: "none", "numba" (every loop is compiled, however short), or unset: a
loop is once that is worth it, where numba is installed."""

_RATE: Final = 50_000_000
"""Entries that numpy expressions pass over in a second."""

_CALL: Final = 3_000
"""Entries that take as long as the calls around a short loop of numpy expressions."""

_NUMBA: Final = 0.6 * _RATE
"""Entries passed over that are worth loading numba."""

_LOADED: Final = 0.03 * _RATE
"""Entries passed over that are worth loading one compiled loop from numba's cache."""

_COMPILED: Final = 1.0 * _RATE
"""Entries passed over that are worth compiling a loop; most take a third of a second to two."""

_EARLIER: Final = 0.25
"""Weight of the entries that earlier processes passed over: short processes seldom end together
with what they repeat, and compiling adds at most a quarter to the time of all of them."""

_COMPILING: Final = 20.0
"""Seconds that a call must have left where a loop is compiled in it: three times the slowest."""

_LOADING: Final = 2.0
"""Seconds that a call must have left where numba is loaded in it."""

_RECORDED: Final = 0.02 * _RATE
"""Entries passed over between two entries in the record beside the cache, which take 0.2 ms."""

_RECORD: Final = "passed_over.json"


def has_accelerator() -> bool:
    """Whether the accelerator, numba's compiled loops, is installed and not switched off; load it.

    Raises:
        ModelError: the environment variable holds another word.
    """
    wish = os.environ.get(SWITCH, "")
    if wish not in ("", "numba", "none"):
        raise ModelError(f"{SWITCH} must be 'numba' or 'none', not {wish!r}")
    return wish != "none" and not _loops.is_given_up and _is_installed() and _load()


def give_up_compiling() -> None:
    """Go on in numpy until the process ends, as numba was left halfway."""
    _loops.is_given_up = True
    message = "numba was interrupted while it compiled: this process goes on without it"
    logging.getLogger("ssp_lp.compiling").info(message)


@cache
def _load() -> bool:
    """Load numba, once.

    Ctrl-C waits for the second that loading takes: what is loaded by half would stay so, and every
    later loop of the process would fail ("module 'numba' has no attribute 'core'"). After any other
    exception from outside, such as an alarm of the caller's, numba is not used any more.
    """
    try:
        with _interrupts_deferred():
            target = importlib.import_module("numba.core.registry").cpu_target
            target.typing_context.refresh()  # what the first loop would load besides
            target.target_context.refresh()
            importlib.import_module("ssp_lp.compiled.half_compiled")
    except Exception:
        give_up_compiling()
        raise
    return True


def accelerated(entries: float, *loops: str) -> bool:
    """Whether compiled loops take the place of a numpy expression over so many entries.

    Each loop is judged by itself. It is loaded from numba's cache, or compiled, once the entries
    that its numpy twin has passed over took about as long as that takes: so time spent on it is at
    most doubled. A loop that is to be compiled counts what earlier processes passed over, too.

    Args:
        entries: of the expression.
        loops: the compiled loops that take its place, as "module.function" of ``ssp_lp.compiled``.
    """
    wish = os.environ.get(SWITCH, "")
    if wish or not _is_installed():
        return wish != "none" and has_accelerator()
    share = (entries + _CALL) / len(loops)
    judged = [_loops.is_worth(loop, share) for loop in loops]
    return all(judged) and has_accelerator()


def may_compile(loop: str) -> bool:
    """Whether numba, which finds no compiled loop for an argument's types, is to compile it."""
    if os.environ.get(SWITCH, "") == "numba" or _frames.depth == 0 or _loops.is_due(loop):
        _announce_compiling()
        return True
    _loops.refuse(loop)
    return False


class NotCompiledError(Exception):
    """A loop is not compiled for these types, and must not be now.

    Args:
        loop: its name.
    """

    def __init__(self, loop: str) -> None:
        super().__init__(f"{loop} is not compiled")
        self.loop = loop


def with_twin(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Begin a function again with numpy's twin where one of its loops must not be compiled.

    The function asks ``accelerated`` about each of its loops, and changes nothing that it reads
    before the first of them has run.
    """

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        """The function, begun again for each loop that must not be compiled now."""
        refused = set[str]()
        while True:
            _frames.depth += 1
            try:
                return function(*args, **kwargs)
            except NotCompiledError as error:
                if error.loop in refused:
                    break  # the function has no twin of it
                refused.add(error.loop)
            finally:
                _frames.depth -= 1
        return function(*args, **kwargs)

    return run


class _Frames(threading.local):
    """Functions with a twin that this thread is in."""

    depth = 0


_frames: Final = _Frames()


@cache
def _is_installed() -> bool:
    """Whether numba can be imported."""
    return importlib.util.find_spec("numba") is not None


@cache
def _announce_compiling() -> None:
    """Log, once, that the accelerator compiles loops for the first time."""
    message = "inner loops for the first time, a second for most of them; kept"
    logging.getLogger("ssp_lp.compiling").info(message)


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """While the accelerator is loaded Ctrl-C waits; only the main thread is interrupted."""
    before, heard = signal.getsignal(signal.SIGINT), list[int]()
    if threading.current_thread() is not threading.main_thread() or before is None:
        yield
        return
    signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if heard:
            signal.raise_signal(signal.SIGINT)


class _Loops:
    """What is known of each compiled loop; it decides on speed only."""

    def __init__(self) -> None:
        self.running = set[str]()  # in use in this process
        self.cached = set[str]()  # on disk, by the names of numba's files
        self.passed = dict[str, float]()  # entries that its twin has passed over in this process
        self.earlier = dict[str, float]()  # in earlier processes
        self.recorded = dict[str, float]()  # of ``passed``, what the record knows
        self.loadable = 0.0  # entries of loops that are on disk
        self.unrecorded = 0.0
        self.is_given_up = False  # numba was left halfway
        self.places: list[Path] | None = None  # folders of numba's cache; None: not looked for

    def is_worth(self, loop: str, entries: float) -> bool:
        """Whether a loop is to run compiled, given the entries that it would pass over now."""
        if loop in self.running:
            return True
        if self.places is None:
            self.places = cache_folders()
            self.cached = cached_loops()
        self.passed[loop] = passed = self.passed.get(loop, 0.0) + entries
        self.unrecorded += entries
        if self.unrecorded > _RECORDED:
            self._record()
        if loop in self.cached:
            self.loadable += entries
            is_loaded = _load.cache_info().currsize > 0
            if not is_loaded:
                is_loaded = self.loadable >= _NUMBA and seconds_left() >= _LOADING
            worth = is_loaded and passed >= _LOADED
        else:
            worth = self.is_due(loop)
        if worth:
            self.running.add(loop)
        return worth

    def is_due(self, loop: str) -> bool:
        """Whether a loop is to be compiled: its twin took as long, and the call has the time."""
        passed = self.passed.get(loop, 0.0) + _EARLIER * self.earlier.get(loop, 0.0)
        return passed >= _COMPILED and seconds_left() >= _COMPILING

    def refuse(self, loop: str) -> None:
        """Go on without a loop until it is due."""
        self.running.discard(loop)
        self.cached.discard(loop)

    def _record(self) -> None:
        """Add what was passed over to the record beside the cache, and read what others did.

        A record that cannot be read counts as empty; where none can be written the process counts
        alone. Of two processes that write at once the later one's numbers are kept.
        """
        self.unrecorded = 0.0
        for place in self.places or ():
            known = _read_record(place / _RECORD)
            added = {loop: n - self.recorded.get(loop, 0.0) for loop, n in self.passed.items()}
            total = {loop: known.get(loop, 0.0) + n for loop, n in added.items()}
            try:
                _write_record(place / _RECORD, known | total)
            except OSError:
                continue
            self.recorded = dict(self.passed)
            self.earlier = {k: n - self.passed.get(k, 0.0) for k, n in (known | total).items()}
            return


_loops: Final = _Loops()


def cache_folders() -> list[Path]:
    """The folders in which numba may keep this library's compiled loops, the first it can use."""
    sources = Path(__file__).resolve().parent
    own = f"{sources.name}_{hashlib.sha1(str(sources).encode(), usedforsecurity=False).hexdigest()}"
    if wished := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(wished) / own]
    home = Path.home()
    user = {"win32": home / "AppData/Local/numba/Cache", "darwin": home / "Library/Caches/numba"}
    cached = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "numba"
    return [sources / "__pycache__", user.get(sys.platform, cached) / own]


def cached_loops() -> set[str]:
    """Loops of this version of the library and of Python that numba's cache seems to hold.

    Whether it does for the types at hand, numba says once it is loaded.
    """
    ending = f".py{sys.version_info[0]}{sys.version_info[1]}{getattr(sys, 'abiflags', '')}.nbi"
    found = set[str]()
    for index in (index for place in cache_folders() for index in place.glob(f"*-*{ending}")):
        name = index.name.partition("-")[0]
        source = Path(__file__).with_name(name.partition(".")[0] + ".py")
        with suppress(OSError):
            if source.stat().st_mtime <= index.stat().st_mtime:
                found.add(name)
    return found


def _read_record(path: Path) -> dict[str, float]:
    """Entries passed over by processes so far, by loop; a damaged record is empty."""
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        return {str(loop): max(float(n), 0.0) for loop, n in known.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _write_record(path: Path, passed: dict[str, float]) -> None:
    """Write the record in one step, so that no other process reads a part of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}.tmp")
    try:
        beside.write_text(json.dumps(passed), encoding="utf-8")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
