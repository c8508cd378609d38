"""Counter-based random numbers of simulations: each is determined by its seed, episode and step.

A process that plays a part of the episodes draws the same numbers for them as any other would. The
generator is Philox 4x64 with ten rounds, as in numpy (Salmon, Moraes, Dror and Shaw, "Parallel
random numbers: as easy as 1, 2, 3", SC 2011); choices are made in whole numbers, so that the order
of summation has no effect.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import FloatArray, IntArray, entries_of, offsets_of, segment_chunks
from ssp_lp.model import SSP

Words = npt.NDArray[np.uint64]

_ROUNDS = 10
_FACTORS = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_STEPS = 0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B  # increments of the key
_SIZE = 1 << 64
_HALF, _LOW = np.uint64(32), np.uint64(0xFFFFFFFF)
_UNITS = 2.0**62  # whole-number scale of probabilities: a pair's sum fits into a word


def counted_words(seed: int, episode: IntArray, step: int) -> tuple[Words, Words, Words, Words]:
    """Return four random words for each of some simulated episodes at a step, [episodes] each.

    Args:
        seed: in 0 .. 2^64 - 1.
        episode: numbers of the episodes, [episodes].
        step: number of the step.
    """
    a = np.asarray(episode, dtype=np.uint64)
    b, c, d = np.full_like(a, step), np.zeros_like(a), np.zeros_like(a)
    for k in range(_ROUNDS):
        first, second = (np.uint64((seed * (1 - j) + k * _STEPS[j]) % _SIZE) for j in range(2))
        a, b, c, d = (
            high_product(c, _FACTORS[1]) ^ b ^ first, c * _FACTORS[1],
            high_product(a, _FACTORS[0]) ^ d ^ second, a * _FACTORS[0],
        )  # fmt: skip
    return a, b, c, d


def high_product(one: Words, other: Words | np.uint64) -> Words:
    """Return the upper halves of the 128-bit products of random words, like ``one``."""
    one_low, one_high, low, high = one & _LOW, one >> _HALF, other & _LOW, other >> _HALF
    middle = one_high * low + ((one_low * low) >> _HALF)
    crossed = one_low * high + (middle & _LOW)
    return np.asarray(one_high * high + (middle >> _HALF) + (crossed >> _HALF))


def drawn_segments(shares: FloatArray, offsets: IntArray, words: Words) -> IntArray:
    """Return an entry of each segment, drawn by random words with its share, [segments].

    Args:
        shares: >= 0, [entries]; each segment's sum to about 1.
        offsets: of the segments, none of which is empty, [segments + 1].
        words: [segments].
    """
    units = np.rint(shares * _UNITS).astype(np.uint64)
    upto = np.cumsum(units, dtype=np.uint64)  # it may overflow: differences do not
    lengths, begins = np.diff(offsets), offsets[:-1]
    upto -= np.repeat((upto - units)[begins], lengths)
    level = high_product(words, upto[offsets[1:] - 1])
    passed = np.add.reduceat(upto <= np.repeat(level, lengths), begins, dtype=np.int64)
    return np.asarray(begins + passed)


def drawn_entries(shares: FloatArray, words: Words) -> IntArray:
    """Return the entries of one distribution, each drawn by a random word, [words].

    Args:
        shares: >= 0, with a sum of about 1, [entries].
        words: [words].
    """
    upto = np.cumsum(np.rint(shares * _UNITS).astype(np.uint64), dtype=np.uint64)
    return np.searchsorted(upto, high_product(words, upto[-1]), side="right")


def drawn_outcomes(model: SSP, pairs: IntArray, words: Words) -> IntArray:
    """Return an outcome of each pair, drawn by random words, [pairs given].

    Args:
        model: model of the pairs and outcomes.
        pairs: [pairs given].
        words: [pairs given].
    """
    drawn = np.zeros(len(pairs), dtype=np.int64)
    lengths = model.outcome_offsets[pairs + 1] - model.outcome_offsets[pairs]
    for some in segment_chunks(offsets_of(lengths)):
        entries, counts = entries_of(model.outcome_offsets, pairs[some])
        shares, offsets = model.probabilities[entries], offsets_of(counts)
        drawn[some] = entries[drawn_segments(shares, offsets, words[some])]
    return drawn
