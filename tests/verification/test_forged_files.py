"""Files that claim too much, or are strange, are refused by name."""

from __future__ import annotations

import gzip
import json
import tracemalloc
from fractions import Fraction
from itertools import combinations
from time import process_time

import pytest

from forged import AWAY, COST, DEAD, GOAL, state, verdict
from formulations import MCMP, AlphaMCMP, FinitePenalty, LeastQuantity, MaxProb, MinCost
from mazes import MAZE
from small_models import FIRST, FREE_LOOP, FREE_PAIR, PAYING_LOOP, TRIES, model_of
from ssp_lp import (
    check_certificate,
    end_probability,
    goal_probability,
    solve,
    visits,
    write_certificate,
)
from ssp_lp.verification import checker

# Files forged by hand, some of which were once accepted: each is refused by what is wrong.


ENDED = {"v": "0", "slope": "0", "members": [None]}
SPENT = [["0", "0", "0", "1"]]  # a total is charged itself


STEP = state(go=([["1", 1]], ["1"]))  # of cost 1, to the goal
TWO = state(go=([["0.55", 1], ["0.45", 1]], [["1", "2"]]))  # 1 or 2
CHOICE = state(safe=([["1", 1]], ["10"]), risky=([["1", 1], ["1", 2]], ["1"]))


def one_step(value, slope="1", cap="0", prices=("0",), **rest):
    """A proof of one step to the goal."""
    own = {"v": value, "slope": slope, "members": [[0, "1", value, "0", slope]]}
    return {"prices": list(prices), "cap": cap, "nodes": 0, **rest}, [own, ENDED]


def test_a_step_of_cost_one_costs_one(tmp_path):
    asked = {"ratio": True, "failure": "0", "charge": SPENT}
    told = verdict(tmp_path / "x", [STEP, GOAL], *one_step("1"), **asked)
    assert (told.accepted, told.lower, told.upper) == (True, 1, 1)


@pytest.mark.parametrize(
    ("claim", "reason"),
    [
        (["1", "1"], ""),
        (["1.000001", "2"], "claimed is at least 1.000001 fails, proved from 1.0 to 1.0"),
        (["0", "0.99"], "claimed is at most 0.99 fails, proved from 1.0 to 1.0"),
        (["0"], "a claim is: at least, at most"),
        ([0, 2], "no text of a number"),
    ],
)
def test_a_claim_is_proved(claim, reason, tmp_path):
    asked = {"ratio": True, "failure": "0", "charge": SPENT}
    told = verdict(tmp_path / "x", [STEP, GOAL], *one_step("1", claim=claim), **asked)
    assert (told.accepted, told.reason[: len(reason)]) == (not reason, reason)


@pytest.mark.parametrize(
    ("one", "accepted"), [("3", True), ("1", False), ("1/3", False), ("0", False), (3, False)]
)
def test_units_are_parts_of_one(one, accepted, tmp_path):
    """In thirds a cost of 1/3 is a whole number, in units of 1 a value of it is rounded to 0."""
    third = state(go=([["1", 1]], ["1/3"]))
    member = [0, "1", "1/3"]
    proof = [{"v": "1/3", "members": [member]}, {"v": "0", "members": [None]}]
    head = {"prices": [], "one": one, "claim": ["1/3", "1/3"]}
    told = verdict(tmp_path / "x", [third, GOAL], head, proof, objective=COST)
    assert told.accepted == accepted


OFTEN = {"name": "few", "at_most": "1e12", "quantity": {
    "constant": "0", "terms": [["1e12", "end", "all"], ["1", "end", "dead"]]}}  # fmt: skip


@pytest.mark.parametrize("failure", ["least", {"share": "1"}])
def test_no_more_than_least_failure(failure, tmp_path):
    """By 2e-10 more the cost is 1 in place of 10."""
    both = state(
        safe=([["0.7", 1], ["0.3", 2]], ["10"]),
        risky=([["0.6999999998", 1], ["0.3000000002", 2]], ["1"]),
    )
    own = {"v": "1", "w": "0.3", "members": [[1, "1", "1", "0.3000000002"]]}
    proof = [own, {**AWAY, "w": "0"}, {**AWAY, "w": "0"}]
    states, head = [both, GOAL, DEAD], {"prices": ["0"]}
    told = verdict(tmp_path / "x", states, head, proof, objective=COST, failure=failure)
    assert "row failure fails" in told.reason


@pytest.mark.parametrize(
    ("action", "takes", "asked"),
    [
        (([["0.7499999998", 1], ["0.2500000002", 2]], ["1"]), "0.2500000002", {"failure": "0.25"}),
        (([["1", 1], ["1", 2]], ["1"]), "1000000000000.5", {"rows": [OFTEN]}),
    ],
)
def test_a_bound_leaves_no_room(action, takes, asked, tmp_path):
    """Nobody fails as rarely; nobody may fail, though all runs count a thousand billion."""
    goal, dead = {**GOAL, "sets": ["goal", "all"]}, {**DEAD, "sets": ["all", "dead"]}
    proof = [{"v": "1", "members": [[0, "1", "1", takes]]}, AWAY, AWAY]
    states, asked = [state(only=action), goal, dead], {"sets": ["all", "dead"], **asked}
    told = verdict(tmp_path / "x", states, {"prices": ["0"]}, proof, objective=COST, **asked)
    assert "lottery <= bound of row" in told.reason


@pytest.mark.parametrize("ratio", [True, False])
def test_no_cap_is_below_the_start(ratio, tmp_path):
    """Values there would be read at a total that no run has."""
    asked = {"ratio": ratio, "failure": "0", "charge": SPENT}
    told = verdict(tmp_path / "x", [STEP, GOAL], *one_step("-9", cap="-10"), **asked)
    assert told.reason.startswith("the cap")


@pytest.mark.parametrize("failure", [0, 0.0, False, "", []])
def test_a_budget_is_a_text(failure, tmp_path):
    """A number 0 is no missing budget."""
    away = {"v": "0", "members": [None]}
    proof = [{"v": "1", "members": [[1, "1", "1", "0.5"]]}, away, away]
    states = [CHOICE, GOAL, DEAD]
    told = verdict(
        tmp_path / "x", states, {"prices": ["0"]}, proof, failure=failure, objective=COST
    )
    assert not told.accepted


@pytest.mark.parametrize(
    ("rest", "v", "members", "price"),
    [
        ({"discount": "0.9"}, "0.4", ([0, "2", "1", "1", "0"], [0, "1", "0", "0.1"]), "0.5"),
        (
            {"failure": "0", "objective": {"constant": "0.1", "terms": []}},
            "0", ([0, "2", "1", "1", "0"], [0, "1", "0", "0"]), "0",
        ),
    ],
)  # fmt: skip
def test_a_quantile_is_of_the_law_alone(rest, v, members, price, tmp_path):
    """The median of a total of 1 (0.55) or 2 is 1: no discount, and no objective, makes it 2."""
    later, first = members
    head = {"prices": [price], "cap": "3", "nodes": 1, "claim": ["2", "2"]}
    proof = [{"v": v, "slope": "0", "members": [later]}, ENDED]
    proof += [
        {"state": 0, "total": "0", "v": "0.5" if price == "0.5" else "0.45", "members": [first]}
    ]
    asked = {"ratio": True, "quantile": "0.52", **rest}
    told = verdict(tmp_path / "x", [TWO, GOAL], head, proof, **asked)
    assert told.reason == "a quantile has no discount and no objective"


def test_a_quantile_jumps_where_a_row_is_exceeded(tmp_path):
    """Half of the runs of the cheap action fail, a little more than may."""
    away = {"v": "0", "slope": "0", "members": [None]}
    first = {"state": 0, "total": "0", "v": "1", "members": [[1, "1", "0", "0.5"]]}
    head = {"prices": ["1"], "cap": "11", "nodes": 1, "claim": ["1", "1"]}
    asked = {"ratio": True, "quantile": "1", "failure": f"0.4{25 * '9'}"}
    told = verdict(tmp_path / "x", [CHOICE, GOAL, DEAD], head, [away, away, away, first], **asked)
    assert told.reason.startswith("a quantile jumps where the lottery exceeds row failure")


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({"ratio": "false", "charge": SPENT}, "ratio is 'false'"),
        ({"charge": [["0", "7", "0"]]}, "a charge is a list"),
        ({"charge": ["0701"]}, "a charge is a list"),
        ({"charge": {"0071": 0}}, "a charge is a list"),
        ({"charge": [["0", "1", "5", "7", "0"]]}, "a charge is a list"),
    ],
)
def test_a_question_is_read_in_one_way(asked, reason, tmp_path):
    told = verdict(tmp_path / "x", [STEP, GOAL], *one_step("1"), failure="0", **asked)
    assert told.reason.startswith(reason)


def worst_half(path, cases, values=("1.9",), cap="3", threshold="1", **asked):
    """A total of 1 (0.55) or 2: the mean of the worse half is 1.9, whose threshold is 1."""
    own, n = [0, "1", "1.9", "0"], len(values)
    later = {"v": ["6.9"] * n, "slope": "2", "members": [None]}
    first = {"state": 0, "total": "0", "v": list(values), "members": [own]}
    proof = [later, {"v": ["0"] * n, "slope": "0", "members": [None]}, first]
    stated = [[end, {"prices": [price]}] for end, price in cases]
    head = {"threshold": threshold, "cases": stated, "cap": cap, "nodes": 1}
    return verdict(path, [TWO, GOAL], head, proof, **{"ratio": True, "tail_mean": "0.5", **asked})


@pytest.mark.parametrize(
    ("cases", "values", "lower"),
    [
        ([("1", "1.9")], ["1.9"], "1.9"),
        ([("2", "1.45")], ["1.45"], "1.45"),  # thresholds up to 2 charge a total of 2 with 2
        ([("1.5", "1.675"), ("2", "2")], ["1.675", "2"], "1.675"),
        ([("1.5", "1"), ("1", "1"), ("2", "2")], ["1", "1", "2"], "1"),  # a case too many
        ([("1/2", "2")], ["2"], "1"),  # beyond 1/2 a tail mean is at least 1, the next total
        ([("0", "1")], ["1"], "1"),
    ],
)
def test_cases_hold_all_thresholds(cases, values, lower, tmp_path):
    told = worst_half(tmp_path / "x", cases, values)
    assert (told.reason, told.lower, told.upper) == ("", Fraction(lower), Fraction("1.9"))


@pytest.mark.parametrize(
    ("cases", "rest", "reason"),
    [
        ([("2", "1.9")], {}, "v <= c + sum p v at s with 0 go fails"),
        ([("1.5", "1.9")], {}, "v <= c + sum p v at s with 0 go fails"),
        ([], {"values": ()}, "a value for each case, and one case at least"),
        ([("1", "1.9")] * 2, {}, "a value for each case, and one case at least"),
        ([("1", "-1.9")], {}, "prices are >= 0"),
        ([("3", "1.9")], {}, "the charge is a line from the cap on"),
        ([("1", "1.9")], {"cap": "1"}, "the charge is a line from the cap on"),
        ([("-2", "1.9")], {}, "a claim is a total"),
        ([("1", "1.9")], {"threshold": "-2"}, "a claim is a total"),
        ([("1", "1.9")], {"threshold": "3/2"}, "member 0: objective + sum p u <= u at s with 0"),
        ([("1", "1.9")], {"tail_mean": "0.6"}, "member 0: objective + sum p u <= u at s with 0"),
        ([("1", "1.9")], {"tail_mean": "1"}, "a level lies in [0, 1)"),
        ([("1", "1.9")], {"tail_mean": "-1"}, "a level lies in [0, 1)"),
        ([("1", "1.9")], {"ratio": False}, "a quantile is one given success"),
        ([("1", "1.9")], {"discount": "0.9"}, "a quantile has no discount and no objective"),
        ([("1", "1.9")], {"quantile": "0.5"}, "one question of totals"),
        ([("1", "1.9")], {"charge": SPENT}, "one question of totals"),
    ],
)
def test_cases_that_prove_nothing(cases, rest, reason, tmp_path):
    told = worst_half(tmp_path / "x", cases, **rest)
    assert told.reason.startswith(reason)


BOTH = state(
    left=([["1", 1], ["1", 2]], ["1"]), right=([["1", 1]], ["3"]), away=([["1", 2]], ["0"])
)
LEFT, RIGHT = {"prices": ["0"]}, {"prices": ["0"]}


def alone(path, cases, values, members=((1, "1", "3", "0"),), weights=("1",), **asked):
    """The goal for 3, or half of the time for 1: a lottery attains 2 with failure 0.25, alone 3."""
    ends = {"v": ["0"] * len(values), "members": [None] * len(members)}
    proof = [{"v": list(values), "members": [list(member) for member in members]}, ends, ends]
    head = {"weights": list(weights), "cases": cases}
    asked = {"deterministic": True, "failure": "0.25", "objective": COST, **asked}
    return verdict(path, [BOTH, GOAL, DEAD], head, proof, **asked)


def tree(*parts, state=0, total="0"):
    return {"state": state, "total": total, "parts": [list(part) for part in parts]}


def leaf(*prices):
    return {"prices": list(prices)}


@pytest.mark.parametrize(
    ("cases", "values", "lower"),
    [
        (leaf("4"), ["3"], 2),  # no lottery attains less
        (tree([[0, "stop"], leaf("100")], [[1], leaf("0")], [[2], leaf("9")]), ["51", "3", "9"], 3),
        (tree([[0, 2, "stop"], leaf("12")], [[1], leaf("0")]), ["7", "3"], 3),
        (tree([[0, 1, 2, "stop"], leaf("4")], [[], leaf("4")]), ["3", "9"], 2),
        (tree([[1, 0], leaf("4")], [[0, 2, "stop"], leaf("12")]), ["3", "7"], 2),  # 0 twice
        (
            tree([[0, 1], tree([[0], leaf("100")], [[1], leaf("0")])], [[2, "stop"], leaf("9")]),
            ["51", "3", "9"],
            3,
        ),
    ],
)
def test_a_tree_holds_all_decisions(cases, values, lower, tmp_path):
    told = alone(tmp_path / "x", cases, values)
    assert (told.reason, told.lower, told.upper) == ("", lower, 3)


@pytest.mark.parametrize(
    ("cases", "values", "rest", "reason"),
    [
        (tree([[0], leaf("100")], [[1], leaf("0")]), ["51", "3"], {}, "each decision is in a part"),
        (tree([[0, 2], leaf("12")], [[1], leaf("0")]), ["7", "3"], {}, "each decision is in a"),
        (tree([[0, 2, "stop"], leaf("12")], [["1"], leaf("0")]), ["7", "3"], {}, "each decision"),
        (tree(), [], {}, "each decision is in a part"),
        (tree([[1], leaf("0")], state=2), ["3"], {}, "each decision is in a part"),
        (tree([[1], leaf("0")], state=9), ["3"], {}, "9 is no whole number"),
        (
            tree([[0, 1], tree([[0], leaf("9")])], [[2, "stop"], leaf("9")]), ["9", "9"], {},
            "each decision is in a part",
        ),
        (tree([[0, 2, "stop"], leaf("4")], [[1], leaf("0")]), ["4", "3"], {}, "v <= c + sum p v"),
        (tree([[0, 2, "stop"], leaf("12")], [[1], leaf("0")]), ["7", "4"], {}, "v <= c + sum p v"),
        (tree([[0, 2, "stop"], leaf("12")], [[1], leaf("0")]), ["7"], {}, "a value for each case"),
        (tree([[0, 2, "stop"], leaf()], [[1], leaf("0")]), ["7", "3"], {}, "0 prices of 1 rows"),
        (tree([[0, 2, "stop"], leaf("-1")], [[1], leaf("0")]), ["7", "3"], {}, "prices are >= 0"),
        ([["1", leaf("0")]], ["0"], {}, "cases is no dict"),
        (leaf("4"), ["3"], {"deterministic": "true"}, "deterministic is"),
        (leaf("4"), ["3"], {"deterministic": False}, "the keys"),
        (leaf("4"), ["3"], {"members": [(0, "1", "1", "0.5")]}, "lottery <= bound of row failure"),
        (
            leaf("4"), ["3"], {"members": [(0, "1", "1", "0.5")], "failure": f"0.4{25 * '9'}"},
            "a policy exceeds row failure",
        ),
        (
            leaf("4"), ["3"],
            {"members": [(1, "1", "3", "0"), (0, "1", "1", "0.5")], "weights": ["0.5", "0.5"]},
            "no policies are mixed, fails",
        ),
    ],
)  # fmt: skip
def test_trees_and_policies_that_are_none(cases, values, rest, reason, tmp_path):
    told = alone(tmp_path / "x", cases, values, **rest)
    assert told.reason.startswith(reason), told.reason


@pytest.mark.parametrize(
    ("give_up", "actions", "lower"),
    [
        ("dead_ends", {"wait": ([["1", 0]], ["0"]), "go": ([["1", 1]], ["5"])}, 5),
        ("attention", {"wait": ([["1", 0]], ["1"]), "go": ([["1", 1]], ["5"])}, 5),
        ("attention", {"wait": ([["1", 0]], ["0"]), "go": ([["1", 1]], ["5"])}, 5),
    ],
)
def test_who_does_not_stop_may_wander(give_up, actions, lower, tmp_path):
    """To go costs 5; who neither goes nor stops wanders where that is free, and where not pays."""
    ends = {"v": ["0", "0"], "members": [None]}
    for wander, (stop, go) in {"0": (["stop"], [0, 1]), "1": (["stop", 0], [1])}.items():
        cases = tree([stop, leaf("9")], [go, leaf("0")])
        proof = [{"v": ["9", "5"], "members": [[1, "1", "5", "0"]]}, ends]
        asked = {"deterministic": True, "failure": "0.25", "objective": COST, "give_up": give_up}
        told = verdict(tmp_path / "x", [state(**actions), GOAL], {"cases": cases}, proof, **asked)
        free = actions["wait"][1] == ["0"]
        if wander == "0" and free:  # "stop" is not left, but to wait is
            assert told.reason.startswith("v <= c + sum p v at s")
        else:
            assert (told.reason, told.lower) == ("", lower)


SPIN = state(slide=([["1", 3]], ["0"]), spin=([["1", 2]], ["0"]))
FAST = state(fast=([["1", 1], ["1", 2]], ["1"]), safe=([["1", 1]], ["4"]))


def skidding(path, v, members, price="0", lines=8, **asked):
    """Half of the runs of "fast" skid, which fails; to slide then is to crash, to spin is not."""
    row = {"constant": "0", "terms": [["1", "end", "wreck"]]}
    asked = {
        "rows": [{"name": "few", "quantity": row, "at_most": "0.25"}], "sets": ["wreck"],
        "after_failing": True, "objective": COST, **asked,
    }  # fmt: skip
    proof = [{"v": v.get(i, "0"), "members": [members.get(i)]} for i in range(lines)]
    states = [FAST, GOAL, SPIN, {**DEAD, "sets": ["wreck"]}]
    return verdict(path, states, {"prices": [price]}, proof, **asked)


SPINS = {0: [0, "1.5", "1", "0"], 2: ["stop", "1", "0", "0"]}
SLIDES = {0: [0, "1.5", "1", "0.5"], 2: [0, "1", "0", "1"]}


def test_who_has_failed_may_wander(tmp_path):
    told = skidding(tmp_path / "x", {0: "1"}, SPINS)
    assert (told.reason, told.lower, told.upper) == ("", 1, 1)


@pytest.mark.parametrize(
    ("v", "members", "rest", "reason"),
    [
        ({0: "1"}, SLIDES, {}, "lottery <= bound of row few fails"),
        ({0: "3", 2: "4", 6: "4"}, SPINS, {"price": "4"}, "v <= c + sum p v at s"),
        ({0: "3", 2: "4"}, SPINS, {"price": "4"}, "v <= c + sum p v at s"),
        ({0: "1"}, SPINS, {"after_failing": False}, "14 lines where there should be 10"),
        ({0: "1"}, SPINS, {"after_failing": False, "lines": 4}, ""),
        ({0: "1"}, SPINS, {"after_failing": "true"}, "after_failing is"),
        ({0: "1"}, SPINS, {"lines": 4}, "10 lines where there should be 14"),
        ({0: "1"}, {0: SPINS[0]}, {}, "member 0: decides after s"),
        ({0: "1"}, {0: ["stop", "1", "0", "0"]}, {}, "member 0: stops where it may"),
        ({0: "1"}, {**SPINS, 6: [0, "1", "0", "0"]}, {}, "member 0: few + sum p u <= u"),
    ],
)
def test_what_follows_failing_is_read_in_one_way(v, members, rest, reason, tmp_path):
    told = skidding(tmp_path / "x", v, members, **rest)
    assert not told.accepted
    assert told.reason.startswith(reason), told.reason


# No proof claims more than is true: proofs are pushed as far as the checker lets them.


STEPS = [Fraction(4) ** power for power in range(4, -6, -1)]
NEAR = 20 * STEPS[-1]
LOW = Fraction(-300)
ROUNDING = Fraction(1, 10**9)  # of an optimum that solve says
ROUNDS = 8  # of a step, as numbers that say nothing can be moved for ever

STAYS = model_of({"x": {"stay": [(1.0, "x", 4.0)], "go": [(0.5, "g", 1.0), (0.5, "x", 1.0)]}})
PITS = model_of(
    {
        "x": {"fast": [(0.5, "g", 1.0), (0.5, "pit", 1.0)], "slow": [(1.0, "g", 5.0)]},
        "pit": {"a": [(0.5, "pit", 6.0), (0.5, "hole", 2.0)], "b": [(1.0, "hole", 9.0)]},
        "hole": {},
    }
)
RING = model_of(
    {
        "x": {"on": [(1.0, "y", 0.0)], "out": [(0.5, "g", 3.0), (0.5, "d", 3.0)]},
        "y": {"back": [(1.0, "x", 0.0)], "out": [(1.0, "g", 8.0)]},
        "d": {},
    },
    labels={"y": ["y"]},
)
HURT = {"hurt": end_probability("hurt") <= 0.06}

PROBLEMS = {
    "budget": MCMP(FIRST, "depot", 0.05),
    "least failure": MCMP(FIRST, "depot"),
    "maze": MCMP(MAZE, "start", 0.07),
    "maze to its end": MCMP(MAZE, "start", 0.1, give_up="dead_ends", constraints=HURT),
    "maze, by the way": LeastQuantity(MAZE, "start", visits("town") + 2.0 * goal_probability()),
    "most": MaxProb(MAZE, "start"),
    "discount": FinitePenalty(PITS, "x", 10.0, 0.9, charge_failing_step=True),
    "charges": MCMP(PITS, "x", 0.25),
    "sure": MinCost(TRIES, "door"),
    "loop that is left": MCMP(STAYS, "x", 0.5),
    "free loop": FinitePenalty(model_of(FREE_LOOP), "x", 3.0, give_up="dead_ends"),
    "free loop of no use": FinitePenalty(model_of(FREE_LOOP), "x", 10.0, give_up="dead_ends"),
    "paying loop": FinitePenalty(model_of(PAYING_LOOP), "x", 3.0, give_up="dead_ends"),
    "free pair": MCMP(model_of(FREE_PAIR), "x", 0.25),
    "ring": MCMP(RING, "x", 0.25, give_up="dead_ends"),
    "ring of no use": FinitePenalty(RING, "x", 100.0, give_up="dead_ends"),
    "ring that counts": MCMP(
        RING, "x", 0.5, give_up="dead_ends", constraints={"n": visits("y") <= 2.0}
    ),
    "share": AlphaMCMP(MAZE, "start", 0.93),
    "share of a ring": AlphaMCMP(RING, "x", 0.75, give_up="dead_ends"),
}


def accepted(lines):
    """What the checker says of these lines; None: it refuses them."""
    try:
        return checker.check_lines(
            [json.dumps(line, separators=(",", ":")).encode() for line in lines]
        )
    except checker.RefusedError:
        return None


def pushed(lines, places, towards, sizes):
    """The lines with sets of the numbers at some places moved while they are accepted.

    Args:
        lines: contents of an accepted file.
        places: (container, key) of numbers that may be moved.
        towards: 1 or -1.
        sizes: of the sets that are moved together.
    """
    groups = [group for size in sizes for group in combinations(places, size)]
    for step in STEPS:
        for _ in range(ROUNDS):
            moves = False
            for group in groups:
                before = [inside[key] for inside, key in group]
                for inside, key in group:
                    inside[key] = str(Fraction(inside[key]) + towards * step)
                if accepted(lines):
                    moves = True
                else:
                    for (inside, key), text in zip(group, before, strict=True):
                        inside[key] = text
            if not moves:
                break
    return accepted(lines)


@pytest.fixture(scope="module", params=PROBLEMS)
def certified(request, tmp_path_factory):
    """The optimum, as of a quantity that is to be small; a certificate; states, and who acts."""
    path = tmp_path_factory.mktemp("certificate") / "one"
    solution = solve(PROBLEMS[request.param])
    assert write_certificate(solution, path, tolerance=1e9).accepted
    lines = [json.loads(line) for line in checker.gzip.decompress(path.read_bytes()).splitlines()]
    n = len(lines) // 2 - 1
    best = Fraction(solution.objective) * (-1 if lines[0]["greatest"] else 1)
    return best, lines, n, [x for x in range(n) if lines[1 + x]["actions"]]


def of_members(lines, n):
    """The same lines with values that prove nothing and keep nothing from being accepted."""
    lines = json.loads(json.dumps(lines))
    for line in lines[n + 2 :]:
        line["v"] = str(LOW)
    return lines


def ends(checked, lines):
    """What values prove, and what members attain, as of a quantity that is to be small."""
    greatest = lines[0]["greatest"]
    return (-checked.upper, -checked.lower) if greatest else (checked.lower, checked.upper)


@pytest.mark.parametrize("name", ["v", "w"])
def test_values_prove_no_more_than_the_optimum(certified, name):
    """Raised, v from far below, alone and together, they end below it, and near it."""
    optimum, lines, n, acting = certified
    if name not in lines[n + 2]:
        return
    lines = json.loads(json.dumps(lines))
    places = [(lines[n + 2 + x], name) for x in acting]
    for inside, key in places:
        inside[key] = str(LOW) if name == "v" else inside[key]
    best = pushed(lines, places, 1, sorted({1, 2, len(places)}))
    proved, attained = ends(best, lines)
    assert proved <= optimum + ROUNDING
    assert attained >= optimum - ROUNDING
    near = NEAR * (1 + sum(map(Fraction, lines[n + 1]["prices"])))
    assert name == "w" or proved >= optimum - near


def test_members_attain_no_less_than_the_optimum(certified):
    """Vectors of steps, the objective and rows lowered, alone and together."""
    optimum, lines, n, _ = certified
    lines = of_members(lines, n)
    for j in range(len(lines[0]["rows"]) + 3):
        entries = [entry for line in lines[n + 2 :] for entry in line["members"] if entry]
        places = [(entry, 1 + j) for entry in entries if 1 + j < len(entry)]
        if places:
            _, attained = ends(pushed(lines, places, -1, (1, 2)), lines)
            assert optimum - ROUNDING <= attained <= optimum + ROUNDING


@pytest.mark.parametrize("decision", ["stop", 0, 1, 2, 3])
def test_other_decisions_attain_no_less_than_the_optimum(certified, decision):
    """Stopping, loops and other actions, for which all but the objective is said to be little."""
    optimum, lines, n, acting = certified
    for some in [*combinations(acting, 1), *combinations(acting, 2)]:
        for taken in ("0", "1"):
            changed = of_members(lines, n)
            entries = []
            for members in (changed[n + 2 + x]["members"] for x in some):
                for m, entry in enumerate(members):
                    if entry:
                        members[m] = [decision, "1000", "1000", *[taken] * (len(entry) - 3)]
                        entries.append((members[m], 2))
            if entries and accepted(changed):
                best = pushed(changed, entries, -1, sorted({1, len(entries)}))
                assert ends(best, changed)[1] >= optimum - ROUNDING


# Certificates that are small and unpack to much, that name things strangely, or have many rows.


STRANGE = "r\x1b[2J\r\n  at most   0\u202e\u2066\u2028\x00\x9b"
MANY = 3000
SECONDS = 15.0  # of the processor; all of these take less than one where nothing else runs


@pytest.mark.parametrize(
    ("head", "unit", "times", "reason"),
    [
        (b"", b"\0", 150 << 20, "a line has more than 16,777,216 bytes"),
        (b"[", b"[],", 8 << 20, "a line has more than 16,777,216 bytes"),
        (b'{"format":"', b"a", 1 << 24, "a line has more than 16,777,216 bytes"),
        (b"", b"\n", 20 << 20, "the file is damaged: JSONDecodeError"),
        (b"", b"0\n", 20 << 20, "the file is damaged: TypeError"),
    ],
)
def test_a_small_file_is_not_unpacked_to_a_large_one(head, unit, times, reason, tmp_path):
    (tmp_path / "x").write_bytes(gzip.compress(head + unit * times, 1))
    tracemalloc.start()
    said = check_certificate(tmp_path / "x")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert said.reason.startswith(reason)
    assert peak < 80 << 20


def test_lines_in_all_are_limited_by_the_size_of_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(checker, "LINE", 1 << 12)
    proof = [{"v": "1", "members": [[0, "1", "1"]]}, AWAY, *[AWAY] * MANY]
    states = [STEP, GOAL, *[DEAD] * MANY]
    said = verdict(tmp_path / "x", states, {"prices": []}, proof, objective=COST)
    most = (1 << 12) + checker.TIMES * (tmp_path / "x").stat().st_size
    assert said.reason == f"the lines have more than {most:,} bytes"


def strange(path, *, objective="1", budget="1", states=None, taken="0", **asked):
    """A file of one step all of whose names are strange, with a row that is so called."""
    step = {"name": STRANGE, "sets": [STRANGE], "actions": [[STRANGE, [["1", 1]], ["1"]]]}
    row = {"constant": "0", "terms": [["1", "cost", 0]]}
    asked = {
        "rows": [{"name": STRANGE, "quantity": row, "at_most": budget}], "sets": [STRANGE],
        "asked": STRANGE, "objective": COST, **asked,
    }  # fmt: skip
    proof = [{"v": objective, "members": [[0, "1", "1", taken]]}, AWAY]
    return verdict(path, states or [step, GOAL], {"prices": ["0"]}, proof, **asked)


@pytest.mark.parametrize(
    "change",
    [
        {"objective": "2"},  # the inequality at the state
        {"taken": "0.5"},  # that of the row
        {"taken": "1", "budget": "0.5"},  # the row's bound
        {"start": [[STRANGE, 0]]},
        {"states": [state(**{STRANGE: ([["0", 1]], ["1"])}), GOAL], "sets": [STRANGE]},
        {"states": [state(**{STRANGE: ([["1", 1]], STRANGE)}), GOAL]},
        {"states": [{**STEP, "sets": [f"{STRANGE} not"]}, GOAL]},
        {"give_up": STRANGE},
        {"failure": STRANGE},
        {"discount": STRANGE},
        {STRANGE: STRANGE},
        {"objective": "1", "charge": [[STRANGE] * 4]},
    ],
)  # fmt: skip
def test_names_in_a_refusal_are_shown_letter_by_letter(change, tmp_path):
    objective = {k: v for k, v in change.items() if k != "objective"}
    said = strange(tmp_path / "x", objective=change.get("objective", "1"), **objective)
    assert not said.accepted
    assert said.reason.isprintable(), said.reason
    assert str(said).isprintable()


def test_names_in_a_verdict_are_shown_letter_by_letter(tmp_path):
    said = strange(tmp_path / "x", taken="1", budget=f"0.{30 * '9'}")
    assert (said.reason, list(said.exceeded)) == ("", [STRANGE])
    lines = str(said).split("\n")
    assert all(line.isprintable() for line in lines)
    starts = ["accepted: ", "  SHA-256 ", "  at least ", "  at most ", "  width ", "  the lottery "]
    assert [line[: len(start)] for line, start in zip(lines, starts, strict=True)] == starts


def test_a_reason_is_no_longer_than_can_be_read(tmp_path):
    long = "a" * 10**6
    keys = {f"{long} {k}": k for k in range(20)}
    (tmp_path / "x").write_bytes(gzip.compress(json.dumps(keys).encode()))
    assert len(check_certificate(tmp_path / "x").reason) <= 10 * checker.SHOWN


@pytest.mark.parametrize(
    ("terms", "taken"),
    [
        ([], "0"),
        ([["0", "visits", "goal"]], "0"),
        ([["1", "visits", "all"]], "2"),
        ([["2", "visits", "all"], ["-1", "visits", "some"]], "2"),
        ([["1", "end", "dead"]], "0"),
        ([["-1", "end", "goal"]], "0"),
        ([["1", "cost", 0]], "1"),
    ],
)
def test_many_rows_of_many_states_take_the_time_of_their_sum(terms, taken, tmp_path):
    """A file of some 10 kB, which is true: rows count in sets of states, of which few are met."""
    states = [{**STEP, "sets": ["all"]}, {**GOAL, "sets": ["goal", "all"]}]
    states += [{**DEAD, "sets": ["all", "dead"]}] * MANY
    rows = [
        {"name": f"r{k}", "at_most": "4", "quantity": {"constant": "0", "terms": terms}}
        for k in range(MANY)
    ]
    own = {"v": "1", "members": [[0, "1", "1", *[taken] * MANY]]}
    asked = {"rows": rows, "sets": ["all", "some", "dead"], "objective": COST}
    head, began = {"prices": ["0"] * MANY}, process_time()
    said = verdict(tmp_path / "x", states, head, [own, AWAY, *[AWAY] * MANY], **asked)
    assert (said.reason, said.lower, said.upper) == ("", 1, 1)
    assert process_time() - began < SECONDS
    assert (tmp_path / "x").stat().st_size < 16_000


def test_a_long_way_of_risks_takes_the_time_of_its_length(tmp_path):
    """From state k one comes to the goal or to k - 1, from state 0 to a dead-end: none is sure."""
    leads = [[["1", k - 1 if k else MANY], ["1", MANY + 1]] for k in range(MANY)]
    chain = [state(go=(outcomes, ["1"])) for outcomes in leads]
    states, began = [*chain, DEAD, GOAL], process_time()
    asked = {"objective": COST, "start": [["1", MANY + 1]]}
    said = verdict(tmp_path / "x", states, {"prices": []}, [AWAY] * (MANY + 2), **asked)
    assert (said.reason, said.lower, said.upper) == ("", 0, 0)
    assert process_time() - began < SECONDS
