"""The study of rounded totals, on the first of its models."""

from examples.checks.rounded_costs_check import Tally, check


def test_the_truth_lies_between_the_bounds_of_few_levels():
    tally = Tally()
    for seed in range(10):
        assert check(seed, tally) == []
    assert tally.counts["rounded"] > 20
