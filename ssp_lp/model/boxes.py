"""Boxes: an interval for each probability of a model, for example computed from counts.

Nature chooses the probabilities of every pair within its box, independently of all other pairs
((s, a)-rectangular uncertainty: Nilim and El Ghaoui, Operations Research 53, 2005; Iyengar,
Mathematics of Operations Research 30, 2005).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import (
    PROBABILITY_SUM,
    BoolArray,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    read_only,
    segment_ids,
    segment_sums,
)
from ssp_lp.errors import ModelError, as_percentage, check_between_0_and_1, check_whole, is_number
from ssp_lp.model.arguments import explained, explained_class
from ssp_lp.model.report import Report, Table
from ssp_lp.model.ssp import SSP

USEFUL_COUNT = 1_000
"""Observations of a pair that give an interval of about +- 0.05 at confidence 95 %."""

FORCED = 1e-12
"""Differences of probabilities up to this one are attributed to the rounding of sums."""


@explained_class
@dataclass(frozen=True, eq=False, repr=False)
class Boxes(Report, ReadOnlyCopies):
    """An interval for the probability of each outcome of a model.

    Intervals are narrowed to the values that a distribution within the box can have.

    Raises:
        ModelError: arrays without a number for each outcome, bounds outside [0, 1] or in the wrong
            order, or the box of a pair that contains no distribution.

    Example:
        >>> model = SSP.from_transitions(
        ...     {"road": {"go": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)]}, "ditch": {}},
        ...     goal={"home"}, dead_ends={"ditch"})
        >>> boxes = Boxes(model, low=[0.8, 0.0], high=[1.0, 0.3])
        >>> boxes.high.round(9).tolist()
        [1.0, 0.2]
    """

    model: SSP
    low: FloatArray  # [outcomes]
    high: FloatArray  # [outcomes]
    confidence: float | None = None  # that all boxes hold at once; None: not from counts

    def __post_init__(self) -> None:
        self.keep_read_only("low", "high", dtype=np.float64)
        if self.confidence is not None:
            check_between_0_and_1("confidence", self.confidence, as_percentage(self.confidence))
        model, low, high = self.model, self.low, self.high
        if low.shape != (model.n_outcomes,) or high.shape != low.shape:
            raise ModelError(f"low and high must have a number for each of {model.n_outcomes}"
                             " outcomes")  # fmt: skip
        offsets, pair = model.outcome_offsets, segment_ids(model.outcome_offsets)
        least, most = segment_sums(low, offsets)[pair], segment_sums(high, offsets)[pair]
        wrong = ~((low >= 0.0) & (low <= high) & (high <= 1.0))
        wrong |= (least > 1.0 + PROBABILITY_SUM) | (most < 1.0 - PROBABILITY_SUM)
        if wrong.any():
            named = model.describe_pair(int(pair[int(np.argmax(wrong))]))
            raise ModelError(f"{named}: no distribution lies in its box: it must have 0 <= low <= "
                             "high <= 1, a sum of low <= 1 and a sum of high >= 1")  # fmt: skip
        forced, left = 1.0 - (most - high), 1.0 - (least - low)
        narrowed = {"low": np.where(forced > low + FORCED, forced, low),
                    "high": np.where(left < high - FORCED, left, high)}  # fmt: skip
        for name, array in narrowed.items():
            object.__setattr__(self, name, read_only(array))

    @classmethod
    @explained
    def from_counts(cls, model: SSP, confidence: float = 0.95) -> Boxes:
        """Return confidence intervals of all probabilities, from the counts of a model's outcomes.

        The intervals are those of Clopper and Pearson (1934). All of them hold at once with the
        given confidence: the probability of error, 1 - ``confidence``, is divided equally among
        them (union bound). A pair with one successor needs no interval. A pair with two successors
        needs one interval, since the other one is its complement. A successor without a row in the
        table of counts is taken to be impossible. For a possible successor that was never seen, add
        a row with count 0.

        Args:
            model: model made by :meth:`ssp_lp.SSP.from_counts`.
            confidence: probability that all intervals contain the true probabilities, in (0, 1).

        Raises:
            ModelError: a model without counts, or a confidence out of range.
        """
        from scipy.special import betaincinv  # no other module loads it

        check_between_0_and_1("confidence", confidence, as_percentage(confidence))
        counts, offsets = counts_of(model), model.outcome_offsets
        widths = np.diff(offsets)
        intervals = int(np.where(widths > 2, widths, widths - 1).sum())
        error = (1.0 - confidence) / max(2 * intervals, 1)  # on each side
        total = segment_sums(counts, offsets)[segment_ids(offsets)]
        alone, none, every = widths[segment_ids(offsets)] == 1, counts == 0.0, counts == total
        low = betaincinv(np.where(none, 1.0, counts), total - counts + 1.0, error)
        high = betaincinv(counts + 1.0, np.where(every, 1.0, total - counts), 1.0 - error)
        low, high = np.where(none, 0.0, low), np.where(every, 1.0, high)
        return cls(model, np.where(alone, 1.0, low), np.where(alone, 1.0, high), float(confidence))

    @cached_property
    def support(self) -> SSP:
        """The model with a positive probability for each outcome that its box allows."""
        offsets = self.model.outcome_offsets
        shares = self.high / segment_sums(self.high, offsets)[segment_ids(offsets)]
        return replace(self.model, probabilities=read_only(shares))

    def fits(self, model: SSP) -> bool:
        """Return whether a model has the same names and outcomes as the boxes' model."""
        own = self.model
        return model is own or (
            np.array_equal(model.pair_offsets, own.pair_offsets)
            and np.array_equal(model.outcome_offsets, own.outcome_offsets)
            and np.array_equal(model.successors, own.successors)
            and np.array_equal(model.pair_action, own.pair_action)
            and [*model.action_names] == [*own.action_names]
            and [*model.states] == [*own.states]
        )

    def check_model(self, model: SSP) -> None:
        """Raise :class:`ModelError` unless the boxes belong to this model."""
        if not self.fits(model):
            raise ModelError(f"box: the boxes belong to another model, {self.model!r}")

    def __repr__(self) -> str:
        """Return a line with the model, the widest interval and the confidence."""
        width = float((self.high - self.low).max(initial=0.0))
        sure = "" if self.confidence is None else f", confidence {self.confidence:g}"
        return f"Boxes({self.model!r}, widest {width:.3g}{sure})"

    def tables(self) -> Sequence[Table]:
        """Return a table of counts, probabilities and intervals, with notes on too few data."""
        model = self.model
        pair = segment_ids(model.outcome_offsets)
        counts = np.full(len(pair), np.nan) if model.counts is None else model.counts
        columns = (pair, model.successors, counts, model.probabilities, self.low, self.high)
        rows = [
            (model.states[model.pair_state[k]], model.action_of(k), model.states[there], *numbers)
            for k, there, *numbers in zip(*(column.tolist() for column in columns), strict=True)
        ]
        head = ("state", "action", "successor", "count", "probability", "low", "high")
        title = "Boxes" if self.confidence is None else f"Boxes, confidence {self.confidence:g}"
        return [Table(rows, head, title, self._remarks(), left=3)]

    def _remarks(self) -> list[str]:
        """Return notes on successors that were never seen and on pairs with few observations."""
        model, counts = self.model, self.model.counts
        if counts is None or self.confidence is None:
            return []
        never = np.flatnonzero(counts == 0.0)
        totals, notes = segment_sums(counts, model.outcome_offsets), []
        if never.size:
            most = float(self.high[never].max())
            notes.append(f"successors never seen: {never.size:,}; of probability up to {most:.2g}")
        few = (totals < USEFUL_COUNT) & (np.diff(model.outcome_offsets) > 1)
        if few.any():
            wide = f"the widest interval is {float((self.high - self.low).max()):.2g}"
            notes.append(f"pairs of fewer than {USEFUL_COUNT:,} counts: {int(few.sum()):,}; {wide}")
        return notes


def counts_of(model: SSP) -> FloatArray:
    """Return the number of observations of each outcome, [outcomes], or raise ModelError."""
    if model.counts is None:
        raise ModelError("the model has no counts: build it by SSP.from_counts(table, goal)")
    return model.counts


@explained
def posterior_draws(
    model: SSP, draws: int, seed: int | np.random.Generator, *, prior: float = 1.0
) -> list[SSP]:
    """Return models with probabilities drawn from the posterior of a model's counts.

    The probabilities of each pair have an independent Dirichlet distribution, whose parameters are
    the counts plus ``prior``. Solve the models by ``solve_many``, or evaluate one policy on each:
    the spread of the results is the uncertainty that the counts leave.

    Args:
        model: model made by :meth:`ssp_lp.SSP.from_counts`.
        draws: number of models.
        seed: a number or a generator.
        prior: number added to the count of each outcome, > 0.

    Raises:
        ModelError: a model without counts, or a prior that is not positive.
    """
    check_whole("draws", draws)
    if not (is_number(prior) and 0.0 < prior < float("inf")):
        raise ModelError(f"prior must be a positive number, not {prior!r}")
    offsets, rng = model.outcome_offsets, np.random.default_rng(seed)
    pair, shape = segment_ids(offsets), counts_of(model) + prior
    drawn = rng.standard_gamma(shape, (draws, shape.size))
    return [
        replace(model, probabilities=read_only(row / segment_sums(row, offsets)[pair]))
        for row in drawn
    ]


def forced(low: FloatArray, high: FloatArray, chosen: BoolArray, offsets: IntArray) -> BoolArray:
    """Return the groups in which every distribution makes some chosen entry possible, [groups].

    A group holds the outcomes of one pair or decision. A distribution gives each entry a
    probability within the entry's interval.

    Args:
        low: least probability of each entry, [entries].
        high: greatest probability of each entry, [entries].
        chosen: mask of the chosen entries, [entries].
        offsets: group k has the entries ``offsets[k] : offsets[k + 1]``, [groups + 1].
    """
    mass = segment_sums(np.where(chosen, low, 0.0), offsets)
    room = segment_sums(np.where(chosen, 0.0, high), offsets)
    return (mass > 0.0) | (room < 1.0 - FORCED)


def greatest_mean(
    low: FloatArray, high: FloatArray, values: FloatArray, offsets: IntArray
) -> FloatArray:
    """Return the distribution of each group that has the greatest mean of given values, [entries].

    A group holds the outcomes of one pair or decision. Each entry first gets its least probability.
    The remaining probability goes to the entries of greatest value, each up to its greatest
    probability.

    Args:
        low: least probability of each entry, [entries].
        high: greatest probability of each entry, [entries].
        values: value of each entry, [entries].
        offsets: group k has the entries ``offsets[k] : offsets[k + 1]``, [groups + 1].
    """
    order, lengths = np.lexsort((-values, segment_ids(offsets))), np.diff(offsets)
    chosen, missing = np.array(low), 1.0 - segment_sums(low, offsets)
    for place in range(int(lengths.max(initial=0))):
        some = np.flatnonzero(lengths > place)
        best = order[offsets[some] + place]
        given = np.clip(missing[some], 0.0, (high - low)[best])
        chosen[best] += given
        missing[some] -= given
    return chosen
