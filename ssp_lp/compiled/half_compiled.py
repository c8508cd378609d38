"""Detection of exceptions that interrupt numba's compiler, such as Ctrl-C or a caller's alarm.

They may leave a loop partly compiled, or a registry of numba partly filled. Every later compilation
in the process would then fail ("no compiled object yet").
"""

from __future__ import annotations

import sys
import threading
from typing import Any

from numba.core import event

from ssp_lp.compiled.accelerator import give_up_compiling


class _LockDepth(threading.local):
    """Number of times that a thread holds numba's compiler lock, which it may take repeatedly."""

    depth = 0


class _Compiling(event.Listener):
    """Listener on numba's compiler lock, which is held while anything is compiled or loaded."""

    def __init__(self) -> None:
        self._thread = _LockDepth()

    def on_start(self, event: Any) -> None:
        """Store the exception that is being handled when the lock is taken, if any."""
        self._thread.depth = self._thread.depth + 1
        if self._thread.depth == 1:
            self._thread.handled = sys.exc_info()[1]

    def on_end(self, event: Any) -> None:
        """Give up compiling if numba releases the lock because of an exception.

        Errors of this package are raised before the compiler starts, and do not count.
        """
        self._thread.depth -= 1
        error = sys.exc_info()[1]
        is_own = type(error).__module__.partition(".")[0] == __package__.partition(".")[0]
        if self._thread.depth == 0 and error is not self._thread.handled and not is_own:
            give_up_compiling()


event.register("numba:compiler_lock", _Compiling())
