"""Every kind of question is read by the checker, from the words of its file alone."""

from __future__ import annotations

import gzip
import json
import re
from fractions import Fraction
from hashlib import sha256

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
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
    MinProb,
)
from mazes import MAZE
from references.stated import optimum
from small_models import FIRST, FREE_LOOP, FREE_PAIR, PAYING_LOOP, TRIES, model_of
from ssp_lp import (
    check_certificate,
    cross_check,
    end_probability,
    expected_cost,
    goal_probability,
    solve,
    visits,
    write_certificate,
)
from ssp_lp.processes import failure_semantics
from ssp_lp.verification import checker, cross_check as reading
from ssp_lp.verification.certificate_file import Statement
from ssp_lp.verification.decision_cases import cases_of_decisions
from ssp_lp.verification.exact_values import proved_bound, values_below
from ssp_lp.verification.lottery import graph_of
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


# Trees of cases: whichever way decisions are told apart, no more is proved than the optimum.


LOOPS = model_of(
    {
        "x": {
            "rest": [(1.0, "y", 0.0)],
            "dare": [(0.6, "g", 2.0), (0.4, "d", 1.0)],
            "ask": [(0.8, "y", 1.0), (0.2, "g", 0.0)],
        },
        "y": {"back": [(1.0, "x", 0.0)], "climb": [(0.9, "g", 4.0), (0.1, "d", 0.0)]},
        "d": {},
    }
)
ALONE = [
    MCMP(model, start, budget, give_up=give_up)
    for model, start in ((MAZE, "start"), (LOOPS, "x"))
    for budget in (0.15, 0.45)
    for give_up in ("attention", "dead_ends")
]


def told_apart(model, rng, only, depth):
    """Cases of a random tree: decisions of a state in two parts, which may overlap."""
    x = int(rng.choice(sorted(model.live)))
    left = rng.permutation(sorted(only.get(x, {-1, *model.of[x]}))).tolist()
    if depth == 0:
        prices = [Fraction(int(rng.integers(0, 12))) for _ in model.rows]
        yield checker.Case(prices, None, only)
        return
    cut, again = rng.integers(0, len(left) + 1, size=2).tolist()
    for part in (set(left[:cut]), set(left[min(cut, again) :])):
        yield from told_apart(model, rng, {**only, x: part}, depth - 1)


@pytest.mark.parametrize("problem", ALONE, ids=range(len(ALONE)))
def test_no_tree_proves_more_than_the_optimum(problem):
    lines = list(Statement(problem, "", is_single=True).lines())
    model = checker.Model(json.loads(lines[0]), list(map(checker.read_state, lines[1:])))
    model.spread({}, [])
    best, rng = optimum(lines), np.random.default_rng(28)
    for depth in (0, 1, 2, 3, 3, 3):
        bounds = []
        for case in told_apart(model, rng, {}, depth):
            c = model.priced(case)
            v, _ = values_below(model, graph_of(model), c, [], only=case.only)
            bounds.append(model.below(v, c, only=case.only))
            assert bounds[-1] == proved_bound(model, c, v)
        assert float(min(bounds)) <= best + 1e-9


@pytest.mark.parametrize("problem", ALONE, ids=range(len(ALONE)))
def test_branch_and_bound_closes(problem):
    lines = list(Statement(problem, "", is_single=True).lines())
    model = checker.Model(json.loads(lines[0]), list(map(checker.read_state, lines[1:])))
    model.spread({}, [])
    solution = solve(problem, "deterministic")
    upper = Fraction(solution.objective)
    proved = cases_of_decisions(model, problem.model, [], [], upper)
    assert float(proved.bound) == pytest.approx(solution.objective, rel=1e-9)
    assert not proved.is_cut
    assert optimum(lines) == pytest.approx(solution.objective, rel=1e-8)


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


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_what_it_counts(criterion):
    """The swamp is a dead-end, and waiting in a is free: giving up there as well."""
    found = reading.second_reading(criterion(WAITING, "a", failure_budget=0.7))
    assert (found.dead_ends, found.giving_up, found.free, found.faults) == (1, 1, 1, ())
    assert str(found).startswith("read twice: 1 dead-ends, 1 states to give up in, 1 where")


@pytest.mark.parametrize(
    ("room", "wrong", "told"),
    [
        ("dead_end_charges", lambda right: 2.0 * right, "failing in 'swamp' charges 2, by the sec"),
        ("give_up_charges", lambda right: right + 1.0, "failing in 'a' charges 1, by the second"),
        ("attention_states", np.logical_not, "is not a state to give up in"),
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
