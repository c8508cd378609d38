"""The memory that a process holds and has held at most, and what the machine has."""

import os
import sys
from pathlib import Path


def process_memory(pid: int | str = "self") -> tuple[int, int] | None:
    """Return the bytes that a process holds and its peak, or None where they cannot be had.

    Linux counts a peak per memory image. `ru_maxrss` would not do: a child process starts with
    the peak of the process that forked it.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return _own_memory() if pid == "self" else None
    sizes = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith("Vm")}
    if "VmHWM" not in sizes:  # the process has ended
        return None
    return 1024 * int(sizes["VmRSS"]), 1024 * int(sizes["VmHWM"])


def _own_memory() -> tuple[int, int]:
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    peak = peak if sys.platform == "darwin" else 1024 * peak
    return peak, peak


def physical_memory() -> int:
    """Return the bytes of memory of the machine."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def usable_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
