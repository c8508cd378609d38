"""Whether inner loops run compiled by numba (extra ``fast``) or as numpy expressions.

Every compiled loop has a numpy version, called its twin; results agree to rounding. The modules of
``ssp_lp.compiled`` import numba and are imported only for loops that are long enough.
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
"""Environment variable: "none", "numba" (compile every loop, however short), or unset (compile a
loop as soon as this saves time, if numba is installed)."""

_RATE: Final = 50_000_000
"""Entries that numpy expressions process in a second."""

_CALL: Final = 3_000
"""Entries that numpy processes in the time that the calls of one short expression take."""

_NUMBA: Final = 0.6 * _RATE
"""Entries processed by numpy after which numba is loaded."""

_LOADED: Final = 0.03 * _RATE
"""Entries processed by numpy after which a compiled loop is loaded from numba's cache."""

_COMPILED: Final = 1.0 * _RATE
"""Entries processed by numpy after which a loop is compiled, mostly in 0.3 to 2 seconds."""

_EARLIER: Final = 0.25
"""Weight of the entries that earlier processes have processed. If many short processes repeat the
same work, compiling adds at most a quarter to their total time."""

_COMPILING: Final = 20.0
"""Least time left, in seconds, to compile a loop in a call: three times the slowest loop."""

_LOADING: Final = 2.0
"""Least time left, in seconds, to load numba in a call."""

_RECORDED: Final = 0.02 * _RATE
"""Entries processed between two updates of the record beside the cache; an update takes 0.2 ms."""

_RECORD: Final = "passed_over.json"


def has_accelerator(wish: str | None = None) -> bool:
    """Load numba, unless it is missing or switched off; return whether it is loaded.

    Args:
        wish: the value of the environment variable; None: it is read.

    Raises:
        ModelError: the environment variable has another value.
    """
    wish = os.environ.get(SWITCH, "") if wish is None else wish
    if wish not in ("", "numba", "none"):
        raise ModelError(f"{SWITCH} must be 'numba' or 'none', not {wish!r}")
    return wish != "none" and not _loops.is_given_up and _is_installed() and _load()


def give_up_compiling() -> None:
    """Use numpy until the process ends, because numba was interrupted."""
    _loops.is_given_up = True
    message = "numba was interrupted while it compiled: this process goes on without it"
    logging.getLogger("ssp_lp.compiling").info(message)


@cache
def _load() -> bool:
    """Load numba once.

    Ctrl-C is deferred until numba is loaded, since a partly loaded numba would make every later
    loop of the process fail ("module 'numba' has no attribute 'core'"). After any other exception
    from outside, such as a caller's alarm, numba is not used any more.
    """
    try:
        with _interrupts_deferred():
            target = importlib.import_module("numba.core.registry").cpu_target
            target.typing_context.refresh()  # load what the first loop needs
            target.target_context.refresh()
            importlib.import_module("ssp_lp.compiled.half_compiled")
    except Exception:
        give_up_compiling()
        raise
    return True


def accelerated(entries: float, *loops: str) -> bool:
    """Return whether compiled loops replace a numpy expression.

    At first the numpy twin of a loop runs. Once the twin has run for about as long as loading the
    loop from numba's cache takes, or compiling it, the loop is loaded or compiled. The total time
    is therefore at most doubled. For compiling, the time that the twin ran in earlier processes
    counts in part. Each loop is judged separately.

    Args:
        entries: number of entries of the expression.
        loops: the compiled loops that replace it, as "module.function" of ``ssp_lp.compiled``.
    """
    wish = os.environ.get(SWITCH, "")
    if wish or not _is_installed():
        return wish != "none" and has_accelerator(wish)
    share = (entries + _CALL) / len(loops)
    judged = [_loops.runs_compiled(loop, share) for loop in loops]
    return all(judged) and has_accelerator(wish)


def may_compile(loop: str) -> bool:
    """Return whether numba may compile a loop now, for the argument types of this call."""
    if os.environ.get(SWITCH, "") == "numba" or _frames.depth == 0 or _loops.is_due(loop):
        _announce_compiling()
        return True
    _loops.refuse(loop)
    return False


class NotCompiledError(Exception):
    """Error: a loop is not compiled for the types of a call, and must not be compiled now.

    Args:
        loop: name of the loop.
    """

    def __init__(self, loop: str) -> None:
        super().__init__(f"{loop} is not compiled")
        self.loop = loop


def with_twin(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Wrap a function: if a loop in it must not be compiled now, the function starts again.

    After the second start the loop's numpy twin runs.

    Args:
        function: a function that calls ``accelerated`` for each of its loops, and changes none of
            its inputs before the first loop has run.
    """

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        refused = set[str]()
        while True:
            _frames.depth += 1
            try:
                return function(*args, **kwargs)
            except NotCompiledError as error:
                if error.loop in refused:
                    break  # numpy does not replace this loop: run it compiled
                refused.add(error.loop)
            finally:
                _frames.depth -= 1
        return function(*args, **kwargs)

    return run


class _Frames(threading.local):
    """Number of running functions that ``with_twin`` wraps, for each thread."""

    depth = 0


_frames: Final = _Frames()


@cache
def _is_installed() -> bool:
    """Return whether numba can be imported."""
    return importlib.util.find_spec("numba") is not None


@cache
def _announce_compiling() -> None:
    """Log, once, that loops are compiled for the first time."""
    message = "inner loops for the first time, about a second each; they are cached"
    logging.getLogger("ssp_lp.compiling").info(message)


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Defer Ctrl-C to the end of a block on the main thread; other threads are not interrupted."""
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
    """Record of the use of all loops so far; it decides when a loop is compiled."""

    def __init__(self) -> None:
        self.running = set[str]()  # loops that run compiled in this process
        self.cached = set[str]()  # loops on disk, by the names of numba's files
        self.passed = dict[str, float]()  # loop -> entries that its twin processed in this process
        self.earlier = dict[str, float]()  # loop -> entries in earlier processes
        self.recorded = dict[str, float]()  # loop -> part of ``passed`` that is in the record
        self.loadable = 0.0  # entries processed by twins of loops that are on disk
        self.unrecorded = 0.0
        self.is_given_up = False  # whether numba was interrupted
        self.places: list[Path] | None = None  # folders of numba's cache; None: not known yet

    def runs_compiled(self, loop: str, entries: float) -> bool:
        """Count the entries of a call, and return whether the loop should run compiled."""
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
        """Return whether to compile a loop.

        Its twin must have run for as long as compiling takes, and enough time must be left.
        """
        passed = self.passed.get(loop, 0.0) + _EARLIER * self.earlier.get(loop, 0.0)
        return passed >= _COMPILED and seconds_left() >= _COMPILING

    def refuse(self, loop: str) -> None:
        """Run the numpy twin of a loop until compiling the loop pays."""
        self.running.discard(loop)
        self.cached.discard(loop)

    def _record(self) -> None:
        """Add this process's counts of entries to those of all processes, and read the result.

        The record is a file beside numba's cache; an unreadable file counts as empty. If the file
        cannot be written, only this process's entries count. If two processes write at the same
        time, the later numbers are kept.
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
    """Return the folders in which numba may cache this library's loops, in order of preference."""
    sources = Path(__file__).resolve().parent
    own = f"{sources.name}_{hashlib.sha1(str(sources).encode(), usedforsecurity=False).hexdigest()}"
    if wished := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(wished) / own]
    home = Path.home()
    user = {"win32": home / "AppData/Local/numba/Cache", "darwin": home / "Library/Caches/numba"}
    cached = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "numba"
    return [sources / "__pycache__", user.get(sys.platform, cached) / own]


def cached_loops() -> set[str]:
    """Return the names of the loops that have a file in numba's cache.

    The file must belong to this version of Python and be newer than the loop's source. Whether the
    file has the loop for the needed types is known only after numba is loaded.
    """
    flags = "" if sys.platform == "win32" else sys.abiflags
    ending = f".py{sys.version_info[0]}{sys.version_info[1]}{flags}.nbi"
    found = set[str]()
    for index in (index for place in cache_folders() for index in place.glob(f"*-*{ending}")):
        name = index.name.partition("-")[0]
        source = Path(__file__).with_name(name.partition(".")[0] + ".py")
        with suppress(OSError):
            if source.stat().st_mtime <= index.stat().st_mtime:
                found.add(name)
    return found


def _read_record(path: Path) -> dict[str, float]:
    """Read the number of entries processed so far by each loop; a damaged file counts as empty."""
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        return {str(loop): max(float(n), 0.0) for loop, n in known.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _write_record(path: Path, passed: dict[str, float]) -> None:
    """Write the record atomically, so that no other process reads a part of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}.tmp")
    try:
        beside.write_text(json.dumps(passed), encoding="utf-8")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
