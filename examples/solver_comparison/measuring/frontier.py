"""The whole frontier of an instance: its time, and the time that warm starts save."""

import time
from dataclasses import dataclass

import numpy as np

from examples.solver_comparison.instances.models import ReadyInstance
from ssp_lp import solve, trace_frontier

_SAMPLE = 12  # prices at which a cold call is timed


@dataclass(frozen=True)
class FrontierCost:
    """Pricing calls and seconds of tracing a frontier."""

    instance: str
    turning_points: int
    pricing_calls: int
    seconds: float
    warm_seconds: float  # mean of a pricing call while tracing
    cold_seconds: float  # the same without a warm start, at a sample of the prices
    gap: float

    @property
    def text(self) -> str:
        """Return the figures in a few lines."""
        calls = self.pricing_calls / self.turning_points
        share = self.warm_seconds / self.cold_seconds
        return "\n".join(
            [
                f"Frontier of {self.instance}, to a relative gap of {self.gap:.0e}",
                f"  turning points   {self.turning_points:,}",
                f"  pricing calls    {self.pricing_calls:,}   ({calls:.2f} per turning point)",
                f"  seconds          {self.seconds:.2f}",
                f"  a warm call      {1e3 * self.warm_seconds:.2f} ms",
                f"  a cold call      {1e3 * self.cold_seconds:.2f} ms   (warm / cold: {share:.2f})",
            ]
        )


def measure_frontier(ready: ReadyInstance, gap: float) -> FrontierCost:
    """Trace an instance's frontier and time its pricing calls, warm and cold."""
    solve(ready.problem())  # what compiles on first use is compiled
    ticks: list[float] = []
    began = time.perf_counter()
    frontier = trace_frontier(
        ready.problem(),
        gap=gap,
        progress=lambda calls, points: ticks.append(time.perf_counter()),
    )
    seconds = time.perf_counter() - began
    # Segments are split depth first, so neighbours in time are neighbours in price.
    warm = float(np.mean(np.diff(ticks))) if len(ticks) > 1 else float("nan")
    chosen = np.linspace(0, len(frontier.price) - 1, _SAMPLE).round().astype(int)
    prices = frontier.price[np.unique(chosen)]
    return FrontierCost(
        instance=ready.instance.name,
        turning_points=len(frontier.failure),
        pricing_calls=frontier.pricing_calls,
        seconds=seconds,
        warm_seconds=warm,
        cold_seconds=float(np.mean([_cold_seconds(ready, float(p)) for p in prices])),
        gap=gap,
    )


def _cold_seconds(ready: ReadyInstance, price: float) -> float:
    """Return the seconds of a first pricing call, without building the problem."""
    pricing = ready.problem().compile().pricing()
    began = time.perf_counter()
    pricing.minimise(price)
    return time.perf_counter() - began
