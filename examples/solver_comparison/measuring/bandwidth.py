"""The machine's memory bandwidth, and how near a Bellman sweep comes to it.

    python examples/solver_comparison/measuring/bandwidth.py INSTANCE REPORT

measures both in a separate process; see `process` for REPORT.
"""

import importlib.util
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from examples.solver_comparison.instances.instance import parse_instance
from examples.solver_comparison.instances.models import build
from examples.solver_comparison.measuring.memory import usable_cores
from examples.solver_comparison.measuring.process import DONE, Report
from ssp_lp.dynamic_programming.bellman import best_pairs
from ssp_lp.processes.explicit_process import ExplicitProcess

_READ_BYTES = 1 << 30  # far larger than any cache
_CHUNK = 1 << 16  # numbers summed in one go
_TRIALS = 7


@dataclass(frozen=True)
class SweepSpeed:
    """The speed of a Bellman sweep."""

    seconds: float  # the best of several
    bytes_read: int  # what a sweep must read at least
    gigabytes_per_second: float


def read_bandwidth() -> float:
    """Return how fast all cores together read a large array, in GB/s: the best of several."""
    numbers = np.ones(_READ_BYTES // 8)
    compiled = importlib.util.find_spec("numba") is not None
    read = _compiled_sum() if compiled else _threaded_sum
    return numbers.nbytes / _best_seconds(lambda: read(numbers)) / 1e9


def sweep_bandwidth(process: ExplicitProcess) -> SweepSpeed:
    """Return how fast a Bellman sweep reads the process: all pairs, their costs and the values."""
    offsets, steps, cost = process.pair_offsets, process.transitions, process.cost
    values = np.linspace(0.0, 1.0, steps.shape[1])
    seconds = _best_seconds(lambda: best_pairs(offsets, steps, cost, values))
    arrays = (steps.indices, steps.data, steps.indptr, cost, values, offsets)
    size = sum(a.nbytes for a in arrays)
    return SweepSpeed(seconds, size, size / seconds / 1e9)


def _compiled_sum() -> Callable[[np.ndarray], float]:
    """Return a sum over all cores; reordering it lets it run as fast as memory delivers."""
    import numba

    @numba.njit(parallel=True, fastmath=True)
    def total(numbers: np.ndarray) -> float:  # pragma: no cover - compiled
        sums = 0.0
        for chunk in numba.prange(numbers.size // _CHUNK):
            part = numbers[chunk * _CHUNK : (chunk + 1) * _CHUNK]
            share = 0.0
            for k in range(part.size):
                share += part[k]
            sums += share
        return sums

    return total


def _threaded_sum(numbers: np.ndarray) -> float:
    cores = usable_cores()
    with ThreadPoolExecutor(cores) as pool:
        return float(sum(pool.map(np.sum, np.array_split(numbers, 8 * cores))))


def _best_seconds(action: Callable[[], object]) -> float:
    """Return the least seconds of several calls after a first one, which may compile."""
    action()
    times = []
    for _ in range(_TRIALS):
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
    return min(times)


def main(arguments: list[str]) -> None:
    """Measure and report the memory's bandwidth and a sweep's."""
    report = Report(Path(arguments[1]))
    report.say(read=read_bandwidth())
    ready = build(parse_instance(arguments[0]))
    process = ready.problem().compile().explicit()
    report.say(sweep=asdict(sweep_bandwidth(process)), phase=DONE)


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("instance", metavar="INSTANCE")
    parser.add_argument("report", metavar="REPORT")
    asked = parser.parse_args()
    main([asked.instance, asked.report])
