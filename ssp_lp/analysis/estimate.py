"""Estimates from simulation, with confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray


class Estimate(NamedTuple):
    """A mean and its confidence interval."""

    value: float
    low: float
    high: float
    confidence: float

    def __str__(self) -> str:
        """The mean and the interval."""
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"


def proportion_estimate(hits: int, trials: int, confidence: float) -> Estimate:
    """Estimate a probability by Clopper and Pearson's exact interval."""
    from scipy import special

    miss = (1.0 - confidence) / 2.0
    low = 0.0 if hits == 0 else float(special.betaincinv(hits, trials - hits + 1, miss))
    high = 1.0 if hits == trials else float(special.betaincinv(hits + 1, trials - hits, 1.0 - miss))
    return Estimate(hits / trials, low, high, confidence)


def mean_estimate(sample: FloatArray, confidence: float) -> Estimate:
    """Normal interval of a mean; nan for an empty sample, infinitely wide for a single value.

    Where an episode pays for ever, the mean is infinite, and so are both ends.
    """
    if sample.size == 0:
        return Estimate(float("nan"), float("nan"), float("nan"), confidence)
    mean = float(sample.mean())
    if sample.size == 1 or mean == float("inf"):
        return Estimate(
            mean, -float("inf") if mean < float("inf") else mean, float("inf"), confidence
        )
    from scipy import special

    quantile = float(special.ndtri(0.5 + confidence / 2.0))
    half = quantile * float(sample.std(ddof=1)) / float(np.sqrt(sample.size))
    return Estimate(mean, mean - half, mean + half, confidence)
