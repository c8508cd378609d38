"""The check of programs against their definitions, on its first draws."""

from collections import Counter

from examples.checks.program_check import CHANGES, CRITERIA, check


def test_programs_are_those_of_the_definitions() -> None:
    tally = Counter[str]()
    for seed in range(len(CRITERIA) * len(CHANGES)):
        assert list(check(seed, tally)) == [], seed
    assert tally["optima"] > 40
    assert set(CHANGES) < set(tally)
