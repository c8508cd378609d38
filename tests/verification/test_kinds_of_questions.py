"""A certificate of every kind of question; questions without a meaning are refused."""

from __future__ import annotations

import gzip
import json
import re
from fractions import Fraction
from hashlib import sha256

import numpy as np
import pytest

from formulations import (
    EGUBS,
    GUBS,
    MCMP,
    S3P,
    AlphaMCMP,
    CostBoundedReach,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
    MinProb,
)
from mazes import MAZE
from small_models import FIRST, FREE_LOOP, FREE_PAIR, PAYING_LOOP, TRIES, model_of
from ssp_lp import (
    check_certificate,
    end_probability,
    expected_cost,
    goal_probability,
    solve,
    visits,
    write_certificate,
)

PITS = model_of(
    {
        "x": {"fast": [(0.5, "g", 1.0), (0.5, "pit", 1.0)], "slow": [(1.0, "g", 5.0)]},
        "pit": {"a": [(0.5, "pit", 6.0), (0.5, "hole", 2.0)], "b": [(1.0, "hole", 9.0)]},
        "hole": {},
    },
)
CELLAR = model_of(
    {
        "x": {"fast": [(0.5, "g", 1.0), (0.5, "pit", 1.0)], "slow": [(1.0, "g", 5.0)]},
        "pit": {"dear": [(1.0, "hole", 9.0)], "cheap": [(0.5, "pit", 6.0), (0.5, "hole", 2.0)]},
        "hole": {},
    }
)
STAYS = model_of({"x": {"go": [(0.5, "g", 1.0), (0.5, "x", 1.0)], "stay": [(1.0, "x", 4.0)]}})
CHAIN = model_of(
    {
        "x": {"short": [(1.0, "y", 1.0)], "long": [(1.0, "g", 9.0)]},
        "y": {"on": [(0.5, "z", 1.0), (0.5, "g", 1.0)]},
        "z": {"jump": [(0.5, "g", 1.0), (0.5, "d", 1.0)]},
        "d": {},
    }
)
SLOPE = model_of(
    {
        "x": {
            "fast": [(0.5, "g", 1.0), (0.25, "x", 1.0), (0.25, "d", 1.0)],
            "slow": [(1.0, "g", 9.0)],
        },
        "d": {},
    },
    labels={"Gefälle": ["d"]},
)
SLIPS = end_probability("Gefälle")
THIRDS = model_of(
    {"x": {"go": [(1 / 3, "g", Fraction(1, 3)), (1 / 3, "x", 0.1), (1 / 3, "d", 0.7)]}, "d": {}}
)
FEW = {"few": end_probability("hurt") <= 0.06}
MIXED_PITS = {"x": 0.75, "g": 0.25}
MIXED = {"start": 0.5, "town": 0.25, "goal": 0.25}


def patience(cost):
    """A utility that is used up at 4."""
    return np.maximum(1.0 - cost / 4.0, 0.0)


PROBLEMS = {
    **{
        f"{give_up} {'charged' if charged else 'free'}": MCMP(
            MAZE, "start", 0.07, give_up=give_up, charge_failing_step=charged
        )
        for give_up in ("anywhere", "attention", "dead_ends")
        for charged in (True, False)
    },
    "least failure": MCMP(MAZE, "start"),
    "limit": MCMP(MAZE, "start", 0.1, give_up="dead_ends", constraints=FEW),
    "equality": MCMP(SLOPE, "x", 1.0, give_up="dead_ends", constraints={"slips": SLIPS == 0.05}),
    "at least": MCMP(MAZE, "start", 1.0, constraints={"home": goal_probability() >= 0.93}),
    "discount": MCMP(MAZE, "start", 0.2, discount=0.97),
    "discounted charge": FinitePenalty(PITS, "x", 10.0, 0.9, charge_failing_step=True),
    "horizon": MCMP(MAZE, "start", 0.2, horizon=4),
    "dearer first": MCMP(CELLAR, "x", 0.25),
    "charge of staying": MCMP(STAYS, "x", 0.5, give_up="attention"),
    "surely by a chain": MinCost(CHAIN, "x"),
    "least of a risk": MCMP(FIRST, "depot"),
    "share": AlphaMCMP(MAZE, "start", 0.93),
    "share of a start": AlphaMCMP(FIRST, "depot", 0.995),
    "most": MaxProb(MAZE, "start"),
    "fewest": MinProb(PITS, "x"),
    "sure": MinCost(MAZE, "start"),
    "sure loop": MinCost(TRIES, "door"),
    "quantity": LeastQuantity(MAZE, "start", visits("town") + 2.0 * goal_probability()),
    "worth": LeastQuantity(
        SLOPE, "x", expected_cost() - 4.0 * SLIPS + 1.0, 0.3, give_up="dead_ends"
    ),
    "labels": MCMP(SLOPE, "x", 0.4, give_up="dead_ends", constraints={"slips": SLIPS <= 0.2}),
    "visits": MCMP(PITS, "x", constraints={"n": visits("pit") <= 0.0}),
    "thirds": MCMP(THIRDS, "x", 1.0, give_up="dead_ends"),
    "charges": MCMP(PITS, {"x": 0.75, "pit": 0.25}, 0.5),
    "free loop": FinitePenalty(model_of(FREE_LOOP), "x", 3.0, give_up="dead_ends"),
    "paying loop": FinitePenalty(model_of(PAYING_LOOP), "x", 2.5, None, "attention", True),
    "free pair": MCMP(model_of(FREE_PAIR), "x", 0.25),
    "given": S3P(MAZE, "start", 0.1),
    "given least failure": S3P(MAZE, "start"),
    "given a share": S3P(MAZE, "start", reach_fraction=0.95),
    "given, with a limit": S3P(SLOPE, "x", 0.3, constraints={"n": visits("x") <= 1.2}),
    "given, at a discount": S3P(PITS, MIXED_PITS, 0.6, discount=0.9),
    "given, in thirds": S3P(THIRDS, "x", 1.0),
    "given, in loops": S3P(SLOPE, "x", 0.3),
    "in time": CostBoundedReach(MAZE, "start", 4.5, 0.2),
    "often": CostQuantile(MAZE, "start", 0.9, 0.1),
    "often in loops": CostQuantile(SLOPE, "x", 0.75, 0.3),
    "worst": CVaR(SLOPE, "x", 0.75, 0.3),
    "unmixed": MCMP(MAZE, "start", 0.07),
    "unmixed, given": S3P(SLOPE, "x", 0.3),
    "worth it": EGUBS(MAZE, "start", -0.5, 0.7),
    "patient": GUBS(PITS, "x", patience, 1.0),
}
"""Certificates of every kind of question."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A certificate of each problem."""
    where = tmp_path_factory.mktemp("certificates")
    for name, problem in PROBLEMS.items():
        method = "deterministic" if name.startswith("unmixed") else None
        assert write_certificate(solve(problem, method), where / name, tolerance=1e9).accepted
    return where


def lines_of(path):
    return gzip.decompress(path.read_bytes()).splitlines()


def signed(lines, n):
    """The same lines with the SHA-256 made anew."""
    digest = sha256(b"\n".join(lines[: n + 1])).hexdigest()
    head = json.loads(lines[n + 1]) | {"sha256": digest}
    return [*lines[: n + 1], json.dumps(head).encode(), *lines[n + 2 :]]


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_a_certificate_of_each_kind_of_question_is_accepted(folder, name):
    checked = check_certificate(folder / name)
    assert checked.accepted
    assert checked.lower <= checked.upper


@pytest.mark.parametrize(
    ("name", "key", "value", "words"),
    [
        ("sure", "objective", [["-1", "cost", 0]], "costs .*count negatively"),
        ("sure", "objective", [["-1", "visits", "goal"]], "visits count negatively"),
        ("quantity", "objective", [["1", "end", "town"]], "ends in state|not all states end"),
        ("thirds", "failure", "0", "the goal can be reached surely, fails"),
        ("thirds", "failure", "least", "."),
        ("discount", "failure", "least", "without discount"),
        ("discount", "discount", "0", "a discount lies in"),
        ("discount", "discount", "1.01", "a discount lies in"),
        ("share", "failure", {"share": "1.01"}, "a share is no probability"),
    ],
)
def test_questions_without_a_meaning_are_refused(folder, tmp_path, name, key, value, words):
    lines = lines_of(folder / name)
    question = json.loads(lines[0])
    question[key] = {"constant": "0", "terms": value} if key == "objective" else value
    lines[0] = json.dumps(question).encode()
    lines = signed(lines, question["states"])
    (tmp_path / "x").write_bytes(gzip.compress(b"\n".join(lines), 1))
    checked = check_certificate(tmp_path / "x")
    assert not checked.accepted
    assert re.search(words, checked.reason)


def test_many_digits_and_many_states(tmp_path):
    """A line of states with a loop each, the value of which is a sum of 1 / (1 - p)."""
    size = 400
    model = model_of(
        {
            f"s{k}": {
                "on": [
                    (k % 7 / 8, f"s{k}", 1.0),
                    (1 - k % 7 / 8, f"s{k + 1}" if k < size else "g", 1.0),
                ]
            }
            for k in range(1, size + 1)
        }
    )
    known = sum(8 / Fraction(8 - k % 7) for k in range(1, size + 1))
    write_certificate(solve(MinCost(model, "s1")), tmp_path / "line")
    checked = check_certificate(tmp_path / "line")
    assert checked.lower <= known <= checked.upper < checked.lower + Fraction(1, 10**20)
