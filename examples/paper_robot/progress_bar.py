"""A progress bar on one line of text, for steps that take longer than a moment."""

import sys
from collections.abc import Callable
from typing import TextIO

Progress = Callable[[int, int], None]
"""Called with the number of steps done and their total."""

_WIDTH = 30


def progress_bar(words: str, stream: TextIO | None = None) -> Progress:
    """Return a callback that draws a bar; it writes nothing where the stream is no terminal.

    words: what is being done, written before the bar.
    stream: stderr if left out.
    """
    out = sys.stderr if stream is None else stream

    def show(done: int, total: int) -> None:
        if out.isatty():
            full = _WIDTH * done // max(total, 1)
            end = "\n" if done >= total else ""
            out.write(f"\r{words} [{'#' * full}{'.' * (_WIDTH - full)}] {done}/{total}{end}")
            out.flush()

    return show
