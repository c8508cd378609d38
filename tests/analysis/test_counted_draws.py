"""Random numbers that are counted are numpy's own, and choose entries with their shares."""

from __future__ import annotations

import numpy as np
import pytest

from small_models import FIRST
from ssp_lp.analysis.counted_draws import (
    counted_words,
    drawn_entries,
    drawn_outcomes,
    drawn_segments,
    high_product,
)

LARGEST = 2**64 - 1


@pytest.mark.parametrize("seed", [0, 1, 2**40 + 3, LARGEST])
def test_the_words_are_those_of_numpys_philox(seed: int) -> None:
    episodes = np.array([0, 1, 7, 2**40])
    for step in (1, 5, 2**33):
        words = np.stack(counted_words(seed, episodes, step))
        for k, episode in enumerate(episodes.tolist()):
            before = episode + (step << 64) - 1  # numpy adds one before it draws
            counter = np.array([before & LARGEST, before >> 64, 0, 0], dtype=np.uint64)
            key = np.array([seed, 0], dtype=np.uint64)
            known = np.random.Philox(key=key, counter=counter).random_raw(4)
            assert words[:, k].tolist() == known.tolist()


def test_the_upper_word_of_a_product_is_exact() -> None:
    numbers = [0, 1, 2**32 - 1, 2**32, 2**63 + 12345, LARGEST]
    for one in numbers:
        for other in numbers:
            high = high_product(np.array([one], dtype=np.uint64), np.uint64(other))
            assert int(high[0]) == one * other >> 64


def test_a_draw_depends_on_its_own_word_alone() -> None:
    rng = np.random.default_rng(3)
    lengths = rng.integers(1, 9, size=3000)  # their sum wraps around
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    shares = rng.random(offsets[-1])
    shares /= np.repeat(np.add.reduceat(shares, offsets[:-1]), lengths)
    words = counted_words(5, np.arange(lengths.size), 1)[0]
    drawn = drawn_segments(shares, offsets, words)
    for k in range(lengths.size):
        own = shares[offsets[k] : offsets[k + 1]]
        assert drawn[k] - offsets[k] == drawn_entries(own, words[k : k + 1])[0]
        alone = drawn_segments(own, np.array([0, own.size]), words[k : k + 1])
        assert drawn[k] - offsets[k] == alone[0]


def test_entries_are_drawn_with_their_shares_and_impossible_ones_never() -> None:
    shares, n = np.array([0.0, 0.25, 0.0, 0.5, 0.25, 0.0]), 40_000
    drawn = drawn_entries(shares, counted_words(1, np.arange(n), 0)[2])
    counts = np.bincount(drawn, minlength=shares.size)
    assert (np.abs(counts - n * shares) <= 5.0 * np.sqrt(n * shares * (1.0 - shares))).all()
    ends = np.array([0, LARGEST], dtype=np.uint64)
    assert drawn_entries(shares, ends).tolist() == [1, 4]


def test_outcomes_are_those_of_the_pairs() -> None:
    pairs = np.array([1, 0, 1, 0, 0])
    words = np.array([0, 0, LARGEST, LARGEST, 2**63], dtype=np.uint64)
    assert drawn_outcomes(FIRST, pairs, words).tolist() == [2, 0, 3, 1, 0]
