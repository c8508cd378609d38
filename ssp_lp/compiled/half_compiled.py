"""Exceptions that end numba's compiler halfway, such as Ctrl-C or an alarm of the caller's.

A loop that was left half compiled, or a registry of numba's that was left half filled, would break
whatever is compiled later in the process ("no compiled object yet").
"""

from __future__ import annotations

import sys
import threading
from typing import Any

from numba.core import event

from ssp_lp.compiled.accelerator import give_up_compiling


class _Compiling(event.Listener):
    """Watches numba's compiler lock, which is held whenever anything is compiled or loaded."""

    def __init__(self) -> None:
        self._thread = threading.local()

    def on_start(self, event: Any) -> None:
        """The lock is taken, perhaps while an exception is being handled by the caller."""
        self._thread.depth = getattr(self._thread, "depth", 0) + 1
        if self._thread.depth == 1:
            self._thread.handled = sys.exc_info()[1]

    def on_end(self, event: Any) -> None:
        """The lock is given back; an exception that is on its way out of numba came in between.

        An error of this package was raised before the compiler began.
        """
        self._thread.depth -= 1
        error = sys.exc_info()[1]
        is_own = type(error).__module__.partition(".")[0] == __package__.partition(".")[0]
        if self._thread.depth == 0 and error is not self._thread.handled and not is_own:
            give_up_compiling()


event.register("numba:compiler_lock", _Compiling())
