"""Draws of family and criterion: each is told in a line and counted."""

import pytest

from examples.checks import family_draws
from examples.solver_comparison.instances.families import FAMILIES


def test_small_draws_are_closed(capsys):
    small = ["--states", "60", "120", "--families", "blocks", "factored", "tandem"]
    asked = ["--criteria", "MCMP", "S3P least", "MaxProb", "--draws", "3", *small]
    assert family_draws.main(asked) == 0
    *lines, counts = capsys.readouterr().out.splitlines()
    assert counts == "3 closed"
    assert all("proof" in line for line in lines)


def test_sizes_are_those_of_known_families():
    assert family_draws.SIZES.keys() <= FAMILIES.keys()


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
def test_verdicts(told, words):
    assert family_draws.verdict({**told, "hung": False}, 5.0) == words
