"""The checks of `examples/checks` on their first draws, and draws that were once told wrongly."""

from collections import Counter

import pytest

from examples.checks import (
    certificate_check,
    failure_check,
    family_draws,
    program_check,
    rounded_costs_check,
)
from examples.solver_comparison.instances.families import FAMILIES


def test_certificates_and_changed_ones():
    tally = Counter()
    for seed in range(8 * len(certificate_check.EXACT)):
        assert list(certificate_check.check(seed, 1, tally)) == [], seed
    assert tally["certificates"] > 30
    assert sum(count for name, count in tally.items() if name.startswith("changed")) > 30


def test_programs_are_those_of_the_definitions():
    """Each criterion with two of the changes."""
    tally, criteria = Counter(), len(program_check.CRITERIA)
    for criterion in range(criteria):
        for change in (criterion % 5, (criterion + 2) % 5):
            seed = criterion + criteria * change
            assert list(program_check.check(seed, tally)) == [], seed
    assert tally["optima"] > 16
    assert set(program_check.CHANGES) < set(tally)


@pytest.mark.parametrize("seed", [2431, 2461, 2797])
def test_programs_that_were_refused(seed):
    """States whose time is always out; noise of an interior point in a loop that is hardly left."""
    tally = Counter()
    assert list(program_check.check(seed, tally)) == []
    assert tally["visits"] == 1


@pytest.mark.parametrize("criterion", failure_check.CRITERIA)
def test_limits_after_failing_are_those_of_the_definitions(criterion):
    counts = Counter()
    for seed in range(7):
        problem = failure_check.drawn(seed, criterion)
        assert failure_check.wrong(problem, counts, by_program=seed % 3 == 0) == [], seed
    assert counts["with a price on what is limited"] > 1


def test_the_truth_lies_between_the_bounds_of_few_levels():
    tally = rounded_costs_check.Tally()
    for seed in (0, 1, 2, 3, 6, 7):  # 4, 5 and 8 take long
        assert rounded_costs_check.check(seed, tally) == []
    assert tally.counts["rounded"] > 20


def test_small_draws_of_families_are_closed(capsys):
    assert family_draws.SIZES.keys() <= FAMILIES.keys()
    small = ["--states", "60", "120", "--families", "blocks", "factored", "tandem"]
    asked = ["--criteria", "MCMP", "S3P least", "MaxProb", "--draws", "3", *small]
    assert family_draws.main(asked) == 0
    *lines, counts = capsys.readouterr().out.splitlines()
    assert counts == "3 closed"
    assert all("proof" in line for line in lines)


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"end": "killed"}, ["without a policy"]),
        ({"end": "answer", "gap": 1e-4, "seconds": 1.0}, ["open"]),
        ({"end": "answer", "gap": 0.0, "seconds": 9.0}, ["late", "closed"]),
        ({"end": "answer", "gap": 1e-4, "seconds": 1.0, "room": 1e-3}, ["closed"]),
        ({"end": "answer", "gap": 0.0, "seconds": 1.0, "proof": "no"}, ["closed", "refused"]),
        ({"end": "cannot", "seconds": 1.0}, ["closed"]),
    ],
)
def test_verdicts_on_draws_of_families(told, words):
    assert family_draws.verdict({**told, "hung": False}, 5.0) == words
