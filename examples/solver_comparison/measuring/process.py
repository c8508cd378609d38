"""Run a command in a separate process and end it when its time or memory is used up.

The process reports by appending JSON objects, one per line, to a file whose path is its last
argument. Their entries are merged, so that the reports of a process that had to be ended are not
lost. The entry "phase" names the current phase; each report restarts the clock.
"""

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from examples.solver_comparison.measuring.memory import process_memory
from examples.solver_comparison.reporting.results import Outcome

PREPARING, DONE = "preparing", "done"
_POLL = 0.02  # seconds
_NO_MEMORY = ("SIGKILL", "MemoryError", "bad_alloc", "memory allocation")
"""Signs in a process's end that memory was refused, or that the system ended it for memory."""


@dataclass(frozen=True)
class Limits:
    """Limits of a process on time and memory."""

    prepare_seconds: float = 1800.0  # until its first call begins
    call_seconds: float = 60.0
    memory: float = math.inf  # bytes

    def seconds(self, phase: str) -> float:
        """Return the seconds until the next report is due.

        A solver with a time limit of its own gets a moment more, to report it.
        """
        return self.prepare_seconds if phase == PREPARING else 1.02 * self.call_seconds + 1.0


@dataclass(frozen=True)
class Ending:
    """The end of a process, and the entries that it reported."""

    entries: Mapping[str, Any]
    outcome: Outcome | None  # why it was ended or failed; None: it ended by itself, in order
    reason: str
    peak_memory: int | None  # as seen from outside


class Report:
    """The file to which a process reports."""

    def __init__(self, path: Path) -> None:
        """Report to a file."""
        self._path = path

    def say(self, **entries: Any) -> None:
        """Report entries."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entries) + "\n")


def python_command(script: str, *arguments: str) -> list[str]:
    """Return the command that runs a script of this folder in a fresh interpreter."""
    return [sys.executable, "-m", f"{__package__}.{script}", *arguments]


def watch(
    command: Sequence[str], limits: Limits, environment: Mapping[str, str] | None = None
) -> Ending:
    """Run a command within limits; the path of its report is appended to its arguments."""
    found_here = os.pathsep.join(filter(None, sys.path))  # what we can import, it can
    with tempfile.TemporaryDirectory() as folder:
        report, log = Path(folder, "report"), Path(folder, "log")
        report.touch()
        with log.open("wb") as output:
            process = subprocess.Popen(  # noqa: S603 - the command is our own
                [*command, str(report)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONPATH": found_here, **(environment or {})},
                start_new_session=True,
            )
        try:
            return _wait(process, report, log, limits)
        finally:
            _end(process)


def _wait(process: subprocess.Popen[bytes], report: Path, log: Path, limits: Limits) -> Ending:
    heard, since, peak = -1, time.monotonic(), None
    while True:
        code = process.poll()  # before reading: nothing is written after the end
        reports = _read(report)
        entries = {name: value for line in reports for name, value in line.items()}
        if len(reports) > heard:
            heard, since = len(reports), time.monotonic()
        memory = process_memory(process.pid)
        held, peak = memory or (0, peak)
        phase = entries.get("phase", PREPARING)
        if code is not None:
            if code == 0 and phase == DONE:
                return Ending(entries, None, "", peak)
            words = _last_words(code, log)
            greedy = any(sign in words for sign in _NO_MEMORY)
            outcome = Outcome.OUT_OF_MEMORY if greedy else Outcome.FAILED
            return Ending(entries, outcome, words, peak)
        if held > limits.memory:
            words = f"more than {limits.memory / 1e9:.3g} GB while {phase}"
            return Ending(entries, Outcome.OUT_OF_MEMORY, words, peak)
        if time.monotonic() - since > limits.seconds(phase):
            return Ending(entries, Outcome.TIME_OUT, f"ended while {phase}", peak)
        time.sleep(_POLL)


def _read(report: Path) -> list[dict[str, Any]]:
    whole, _, _ = report.read_text(encoding="utf-8").rpartition("\n")
    return [json.loads(line) for line in whole.splitlines()]


def _last_words(code: int, log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    how = signal.Signals(-code).name if code < 0 else f"exit status {code}"
    return f"{how}: {lines[-1][:200]}" if lines else how


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and all processes that it started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
