"""The check of certificates of random problems, on its first draws."""

from collections import Counter

from examples.checks.certificate_check import EXACT, check


def test_certificates_and_changed_ones():
    tally = Counter[str]()
    for seed in range(16 * len(EXACT)):
        assert list(check(seed, 1, tally)) == [], seed
    assert tally["certificates"] > 60
    assert sum(count for name, count in tally.items() if name.startswith("changed")) > 60
