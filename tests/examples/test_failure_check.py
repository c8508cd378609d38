"""The check of limits on what happens after failing, on some of its draws."""

from collections import Counter

import pytest

from examples.checks.failure_check import CRITERIA, drawn, wrong


@pytest.mark.parametrize("criterion", CRITERIA)
def test_limits_after_failing_are_those_of_the_definitions(criterion):
    counts = Counter[str]()
    for seed in range(7):
        told = wrong(drawn(seed, criterion), counts, by_program=seed % 3 == 0)
        assert told == [], seed
    assert counts["with a price on what is limited"] > 1
