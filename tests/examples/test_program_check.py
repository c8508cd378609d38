"""The check of programs against their definitions, on its first draws."""

from collections import Counter

import pytest

from examples.checks.program_check import CHANGES, CRITERIA, check


def test_programs_are_those_of_the_definitions():
    tally = Counter[str]()
    for seed in range(len(CRITERIA) * len(CHANGES)):
        assert list(check(seed, tally)) == [], seed
    assert tally["optima"] > 40
    assert set(CHANGES) < set(tally)


@pytest.mark.parametrize("seed", [2431, 2461, 2797])
def test_draws_that_were_refused(seed):
    """States whose time is always out; noise of an interior point in a loop that is hardly left."""
    tally = Counter[str]()
    assert list(check(seed, tally)) == []
    assert tally["visits"] == 1
