"""Every kind of question is read by the checker, from the words of its file alone."""

from __future__ import annotations

import gzip
import json
import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given

from checks import library_model
from formulations import (
    EGUBS,
    GUBS,
    MCMP,
    S3P,
    AlphaMCMP,
    CostBoundedReach,
    CostQuantile,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
    MinProb,
)
from mazes import MAZE
from references.stated import optimum
from small_models import FIRST, FREE_LOOP, FREE_PAIR, PAYING_LOOP, TRIES, model_of, patience
from ssp_lp import (
    check_certificate,
    cross_check,
    end_probability,
    expected_cost,
    goal_probability,
    sha256_of,
    solve,
    visits,
    write_certificate,
)
from ssp_lp.processes import failure_semantics
from ssp_lp.verification import cross_check as reading
from strategies import discounts, often, problems, semantics

# A certificate of every kind of question; questions without a meaning are refused.


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
TRIED = model_of({"x": {"go": [(0.5, "g", 1.0), (0.5, "x", 1.0)]}})
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
    "late": MaxProb(
        TRIED, "x", horizon=3, constraints={"late": end_probability("out of time") <= 0.2}
    ),
    "worth it": EGUBS(MAZE, "start", -0.5, 0.7),
    "patient": GUBS(PITS, "x", patience, 1.0),
}
"""Certificates of every kind of question."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A certificate of each problem."""
    where = tmp_path_factory.mktemp("certificates")
    for name, problem in PROBLEMS.items():
        assert write_certificate(solve(problem), where / name).accepted
    return where


def lines_of(path):
    return gzip.decompress(path.read_bytes()).splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_a_certificate_of_each_kind_of_question_is_accepted(folder, name):
    checked = check_certificate(folder / name, problem=PROBLEMS[name])
    assert checked.accepted
    assert checked.lower <= checked.upper <= checked.lower + Fraction(1, 10**9)
    known = optimum(lines_of(folder / name))
    assert float(checked.lower) - 1e-7 <= known <= float(checked.upper) + 1e-7


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_file_answers_the_question_that_it_was_written_for(folder, name):
    """Another receiver's question has another SHA-256."""
    for other, problem in PROBLEMS.items():
        checked = check_certificate(folder / name, problem=problem)
        assert checked.accepted == (other == name or PROBLEMS[other] is PROBLEMS[name])
        assert checked.accepted or "answers another question" in checked.reason


def test_the_least_change_of_a_model_is_another_question(folder):
    """A cost of one action, the name of a state, and the order of actions."""
    table = {
        "depot": {
            "alley": [(0.90, "home", 4.0), (0.10, "wreck", 2.0)],
            "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
        },
        "wreck": {},
    }
    mine = sha256_of(MCMP(FIRST, "depot"))
    assert mine == check_certificate(folder / "least of a risk").digest
    assert mine == sha256_of(MCMP(model_of(table, "home"), "depot", None))
    table["depot"]["road"][1] = (0.01, "wreck", 5.000000000000001)
    assert mine != sha256_of(MCMP(model_of(table, "home"), "depot"))
    table["depot"] = dict(reversed(table["depot"].items()))
    assert mine != sha256_of(MCMP(model_of(table, "home"), "depot"))
    assert mine != sha256_of(MCMP(FIRST, "depot", 0.05))


@pytest.mark.parametrize(
    ("name", "key", "value", "words"),
    [
        ("sure", "objective", [["-1", "cost", 0]], "costs and visits count >= 0"),
        ("sure", "objective", [["-1", "visits", "goal"]], "costs and visits count >= 0"),
        ("quantity", "objective", [["1", "end", "town"]], "not all states end|there is no set"),
        ("thirds", "failure", "0", "needed: the goal can be reached surely"),
        ("thirds", "failure", "least", "."),
        ("discount", "discount", "0", "a discount lies in"),
        ("discount", "discount", "1.01", "a discount lies in"),
        ("share", "failure", {"share": "1.01"}, "a share is a probability"),
    ],
)
def test_questions_without_a_meaning_are_refused(folder, tmp_path, name, key, value, words):
    lines = lines_of(folder / name)
    question = json.loads(lines[0])
    question[key] = {"constant": "0", "terms": value} if key == "objective" else value
    lines[0] = json.dumps(question).encode()
    (tmp_path / "x").write_bytes(gzip.compress(b"".join(line + b"\n" for line in lines), 1))
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


# The model read twice: the rooms that all methods share beside plain loops over fractions.


WAITING = model_of(
    {
        "a": {"go": [(0.5, "g", 2.0), (0.5, "swamp", 1.0)], "wait": [(1.0, "a", 0.0)]},
        "swamp": {"swim": [(1.0, "swamp", 3.0)], "float": [(1.0, "swamp", 1.0)]},
        "g": {},
    },
    "g",
)


@often(20)
@given(drawn=problems(), meaning=semantics, discount=discounts)
def test_drawn_models_are_read_alike(drawn, meaning, discount):
    model = library_model(drawn)
    for criterion, said in ((MCMP, meaning), (S3P, {})):
        stated = criterion(model, drawn.start, failure_budget=0.5, discount=discount, **said)
        assert reading.second_reading(stated).faults == ()


def test_where_waiting_is_free_one_may_come_to_it_for_nothing():
    """In b one waits by going to a, at no cost: both readings count it."""
    ways = {
        "a": {"wait": [(1.0, "a", 0.0)], "on": [(1.0, "b", 1.0)]},
        "b": {"back": [(1.0, "a", 0.0)], "home": [(1.0, "g", 1.0)]},
        "d": {"stuck": [(1.0, "d", 2.0)]},
    }
    found = reading.second_reading(MCMP(model_of(ways, "g"), "a", failure_budget=0.5))
    assert (found.free, found.faults) == (2, ())


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_what_it_counts(criterion):
    """The swamp is a dead-end, and waiting in a is free: giving up there as well."""
    found = reading.second_reading(criterion(WAITING, "a", failure_budget=0.7))
    assert (found.dead_ends, found.giving_up, found.free, found.faults) == (1, 1, 1, ())
    assert str(found).startswith("read twice: 1 dead-ends, 1 states to give up in, 1 where")


def _elsewhere(charges):
    """Giving up allowed, free of charge, where it is not, and forbidden where it is."""
    return np.where(np.isfinite(charges), np.inf, 0.0)


@pytest.mark.parametrize(
    ("room", "wrong", "told"),
    [
        ("dead_end_charges", lambda right: 2.0 * right, "failing in 'swamp' charges 2, by the sec"),
        ("dead_end_charges", lambda right: 0.5 * right, "'swamp' charges 0.5, by the second"),
        ("give_up_charges", lambda right: right + 1.0, "failing in 'a' charges 1, by the second"),
        ("give_up_charges", _elsewhere, "is not a state to give up in"),
        ("hopeless_states", np.zeros_like, "'swamp' is not a dead-end"),
    ],
)
def test_a_misread_model_is_named(monkeypatch, room, wrong, told):
    """Where all methods start from the same mistake they agree; the comparison does not."""
    right = getattr(reading, room)
    monkeypatch.setattr(reading, room, lambda *given: wrong(right(*given)))
    found = cross_check(MCMP(WAITING, "a", failure_budget=0.7, charge_failing_step=True))
    assert not found.disagreeing
    assert not found.agrees
    assert any(told in each for each in found.reading.faults)
    assert found.summary().splitlines()[-1].startswith("THE MODEL IS MISREAD: ")


def test_a_large_model_is_not_read_again(monkeypatch):
    monkeypatch.setattr(reading, "MOST_OUTCOMES", 3)
    found = cross_check(MCMP(FIRST, "depot", failure_budget=0.05))
    assert found.reading is None
    assert found.agrees


def test_charges_come_from_one_room():
    assert reading.dead_end_charges is failure_semantics.dead_end_charges
