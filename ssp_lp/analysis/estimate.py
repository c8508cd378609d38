"""Estimates from simulation, with confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import FloatArray, segment_ids, segment_minima
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import dead_ends

_MOST_WORK = 300_000_000  # outcomes looked at for the dearest way, a few seconds


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


def mean_estimate(sample: FloatArray, confidence: float, most: float) -> Estimate:
    """Estimate a mean cost by an interval that holds for any law of costs; nan for no sample.

    Where an episode pays for ever, the mean is infinite, and so are both ends.

    It holds for rare dear events that the sample need not show, of which normal intervals and the
    bootstrap know nothing: the upper end is the empirical Bernstein bound, which counts what costs
    up to ``most`` may add. The lower end asks for no greatest cost: it is the integral of the
    sample's survival function less what that may exceed the law's by.

    Args:
        sample: of costs in [0, most], each drawn alike.
        confidence: of the interval, half of the rest on either side.
        most: the greatest cost that can occur.

    Reference:
        Maurer and Pontil, COLT 2009, theorem 4; Anderson, Confidence limits for the expected value
        of an arbitrary bounded random variable, 1969, with Massart's constant (1990).
    """
    if sample.size == 0:
        return Estimate(float("nan"), float("nan"), float("nan"), confidence)
    mean, most = float(sample.mean()), max(most, float(sample.max()))
    if sample.size == 1 or mean == float("inf"):
        return Estimate(mean, 0.0 if mean < float("inf") else mean, most, confidence)
    log = float(np.log(4.0 / (1.0 - confidence)))
    spread = float(np.sqrt(2.0 * log / sample.size) * sample.std(ddof=1))
    unseen = 7.0 * log / (3.0 * (sample.size - 1))  # times the range: what the spread may miss
    exceed = float(np.sqrt(np.log(2.0 / (1.0 - confidence)) / (2.0 * sample.size)))
    above = np.arange(sample.size, 0, -1) / sample.size  # share of the sample, from each cost on
    low = float(np.diff(np.sort(sample), prepend=0.0) @ np.maximum(above - exceed, 0.0))
    return Estimate(mean, low, min(mean + spread + unseen * most, most), confidence)


def greatest_total(model: SSP, steps: int) -> float:
    """What an episode of at most so many steps costs at most, whatever it does.

    Steps within a strong component may be repeated, others come once: they add up to the dearest
    way through the components.
    """
    over = dead_ends(model) | model.goal_mask
    starts = model.outcome_offsets[model.pair_offsets]  # of each state's outcomes, [states + 1]
    source = segment_ids(starts)
    entries = np.ones(model.n_outcomes), (source, model.successors)
    graph = sp.csr_array(entries, shape=(model.n_states, model.n_states))
    label = csgraph.connected_components(graph, connection="strong")[1]
    going, again = ~over[source], label[source] == label[model.successors]
    dearest = steps * float(model.costs[going].max(initial=0.0))
    repeated = steps * float(model.costs[going & again].max(initial=0.0))
    paid, total = np.where(going & ~again, model.costs, -np.inf), np.zeros(model.n_states)
    for sweep in range(steps):
        before = total
        total = np.maximum(-segment_minima(-(paid + before[model.successors]), starts), 0.0)
        if (total == before).all():
            break
        if sweep * model.n_outcomes > _MOST_WORK:
            return dearest
    return min(dearest, repeated + float(total.max()))
