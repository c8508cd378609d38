"""The checker in C and the checker in Python say the same of every file, true or false."""

from __future__ import annotations

import gzip
import json
import random
import re
import subprocess
from copy import deepcopy
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
from tests.campaigns.two_checkers import difference

CHANGES = 40
"""So many files that were tampered with of each certificate."""

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


def run(program, path):
    """What the program says of a file: its status, its words, the ends of its interval."""
    done = subprocess.run([program, path], capture_output=True, text=True)  # noqa: S603
    ends = [Fraction(end) for end in re.findall(r"at (?:least|most) .* = (\S+)", done.stdout)]
    return done.returncode, done.stdout, ends


def agreed(program, path):
    """What the checker in C says of a file, of which both must say the same."""
    assert difference(program, path) == ""
    return run(program, path)[1]


def written(lines, path):
    """The file of these lines, at this path."""
    path.write_bytes(gzip.compress(b"\n".join(lines), 1))
    return path


def lines_of(path):
    return gzip.decompress(path.read_bytes()).splitlines()


def states_of(lines):
    """How many states a file of these lines has."""
    return json.loads(lines[0])["states"]


def signed(lines, n):
    """The same lines with the SHA-256 made anew."""
    digest = sha256(b"\n".join(lines[: n + 1])).hexdigest()
    head = json.loads(lines[n + 1]) | {"sha256": digest}
    if b'"quantile"' not in lines[0]:
        head["claim"] = ["-1e9", "1e9"]
    return [*lines[: n + 1], json.dumps(head).encode(), *lines[n + 2 :]]


@pytest.mark.parametrize("name", PROBLEMS)
def test_both_prove_the_same_interval(program, folder, name):
    assert agreed(program, folder / name).startswith("accepted: ")


def places(content, *path):
    """Where something stands in a line."""
    for key in content if isinstance(content, dict) else range(len(content)):
        yield *path, key
        if isinstance(content[key], (dict, list)):
            yield from places(content[key], *path, key)


STRANGE = ["0", "-1", "1/3", "1_0", " 1", "+1", ".5", "1e3", "1e99999", "1/0", "nan", "goal", "end",
           "stop", "", True, None, 1, -1, 2.5, float("nan"), [], {}, ["1"], 10**30]  # fmt: skip


def changed(line, rng):
    """A line in which something was changed, dropped, repeated or exchanged."""
    content = json.loads(line)
    *above, last = rng.choice(list(places(content)))
    inside = content
    for key in above:
        inside = inside[key]
    old, way = inside[last], rng.random()
    if way < 0.2:
        inside[last] = rng.choice(STRANGE)
    elif way < 0.3:
        del inside[last]
    elif way < 0.4 and isinstance(inside, list):
        inside.insert(last, deepcopy(old))
    elif way < 0.4:
        inside["more"] = old
    elif isinstance(old, bool):
        inside[last] = not old
    elif isinstance(old, str) and re.fullmatch("-?[0-9./]+", old):
        factor = rng.choice([Fraction(1, 2), Fraction(2), Fraction(999, 1000), Fraction(-1)])
        term = rng.choice([Fraction(0), Fraction(1, 10**9), -Fraction(1, 10**9)])
        inside[last] = str(Fraction(old) * factor + term)
    elif isinstance(old, int):
        inside[last] = old + rng.choice([-1, 1])
    elif isinstance(old, list):
        inside[last] = old[::-1]
    return json.dumps(content).encode()


@pytest.mark.parametrize("name", PROBLEMS)
def test_both_say_the_same_of_what_was_tampered_with(program, folder, tmp_path, name):
    """Numbers, names, lines and lists changed at random, most of them signed anew."""
    lines, rng = lines_of(folder / name), random.Random(name)
    n = states_of(lines)
    for _ in range(CHANGES):
        tampered, way = [*lines], rng.random()
        k = rng.choice([0, rng.randrange(1, n + 1), n + 1, rng.randrange(n + 2, len(lines))])
        i = rng.randrange(len(lines))
        if way < 0.05:
            tampered[k], tampered[i] = tampered[i], tampered[k]
        elif way < 0.08:
            del tampered[k]
        elif way < 0.1:
            tampered.insert(i, tampered[k])
        else:
            tampered[k] = changed(tampered[k], rng)
        if way > 0.2 and all(key in tampered[n + 1] for key in (b'"sha256"', b'"claim"')):
            tampered = signed(tampered, n)
        agreed(program, written(tampered, tmp_path / "x"))


def moved(value, step):
    """A number, or the first one of a list, and a little more."""
    if isinstance(value, list):
        return [moved(value[0], step), *value[1:]]
    return str(Fraction(value) + step)


def low(line):
    """A line of proof with values that prove little."""
    stated = json.loads(line)
    return stated | {"v": ["-1000"] * len(stated["v"]) if type(stated["v"]) is list else "-1000"}


def edges(lines):
    """Files that differ in a number of the proof by next to nothing, or in a decision."""
    n = states_of(lines)
    question = json.loads(lines[0])
    limited = question["failure"] is not None or question.get("ratio", False)
    rows = len(question["rows"]) + limited
    for k in range(n + 2, len(lines)):
        stated = json.loads(lines[k])
        acts = len(json.loads(lines[1 + stated.get("state", k - n - 2)])["actions"])
        for name in ("v", "w", "slope"):
            if name not in stated:
                continue
            for step in ("1e-30", "1e-61"):
                yield k, stated | {name: moved(stated[name], Fraction(step))}
        for m, entry in enumerate(stated["members"]):
            others = [None, *(["stop", *range(acts + 1)])]
            big = ["1000", "1000", *["1"] * rows, *["9"] * ("slope" in stated)]
            changes = [[other, *big] if other is not None else None for other in others]
            for j in range(1, len(entry or "")):
                for step in ("1e-30", "1e-61"):
                    lower = str(Fraction(entry[j]) - Fraction(step))
                    changes.append([*entry[:j], lower, *entry[j + 1 :]])
            for change in changes:
                members = [*stated["members"][:m], change, *stated["members"][m + 1 :]]
                yield k, stated | {"members": members}


@pytest.mark.parametrize("name", PROBLEMS)
def test_both_say_the_same_at_the_edge(program, folder, tmp_path, name):
    """Each number of a proof by a little more than is true, and each decision by another."""
    lines = lines_of(folder / name)
    n = states_of(lines)
    every = list(edges(lines))
    lowered = [json.dumps(low(line)).encode() for line in lines[n + 2 :]]
    for k, stated in random.Random(name).sample(every, min(len(every), 60)):
        tampered = [*lines]
        if any(entry and entry[1] == "1000" for entry in stated["members"]):
            tampered[n + 2 :] = lowered  # so that only members are in question
            stated["v"] = json.loads(lowered[k - n - 2])["v"]
        tampered[k] = json.dumps(stated).encode()
        agreed(program, written(tampered, tmp_path / "x"))


@pytest.mark.parametrize("lowered", ["0", "1e-30", "1/100"])
@pytest.mark.parametrize("name", ["share", "share of a start", "least of a risk"])
def test_both_find_the_same_budget_of_a_share(program, folder, tmp_path, name, lowered):
    """It lies between what w proves of failing and what a member attains."""
    lines = lines_of(folder / name)
    n = states_of(lines)
    for bounds in ({}, {"prices": ["3"]}):
        for weights in (
            {},
            {"weights": ["0", "0", "1"][-len(json.loads(lines[n + 1])["weights"]) :]},
        ):
            changed = [*lines]
            changed[n + 1] = json.dumps(json.loads(lines[n + 1]) | bounds | weights).encode()
            for k in range(n + 2, 2 * n + 2):
                line = json.loads(lines[k])
                line["w"] = str(Fraction(line["w"]) - Fraction(lowered))
                line["v"] = "-1000" if bounds else line["v"]
                changed[k] = json.dumps(line).encode()
            agreed(program, written(changed, tmp_path / "x"))


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
def test_questions_without_a_meaning_are_refused(
    program, folder, tmp_path, name, key, value, words
):
    lines = lines_of(folder / name)
    question = json.loads(lines[0])
    question[key] = {"constant": "0", "terms": value} if key == "objective" else value
    lines[0] = json.dumps(question).encode()
    path = written(signed(lines, states_of(lines)), tmp_path / "x")
    assert agreed(program, path).startswith("refused")
    assert re.search(words, run(program, path)[1])
    assert re.search(words, check_certificate(path).reason)


AMBIGUOUS = [
    (0, b'"failure":"0.07"', b'"failure":"0.07","failure":"1"', "failure"),
    (0, b'"rows":[]', b'"rows":[],"horizon":3', "horizon"),
    (0, b'"greatest":false', b'"greatest":"false"', "neither true nor false"),
    (0, b'"greatest":false', b'"greatest":NaN', "no value"),
    (0, b'"constant":"0"', b'"constant":"0","square":true', "square"),
    (0, b'"sets":[', b'"sets":["g\\u006fal",', "escaped"),
    (0, b'"0.07"', b'"0.0\\u0661"', "no number"),
    (0, b'"states"', b'"states" \r', "ASCII"),
    (0, b'"states":4', b'"states":04', "no whole number"),
    (0, b'"states":4', b'"states":4.0', "4.0|[.]0"),
    (0, b'"states":4', b'"states":2000000000', "no whole number below"),
    (0, b'"states":4', b'"states":20000000', "name"),
    (0, b'"states":4', b'"states":3', "no whole number below 3"),
    (1, b'"actions"', b'"actions":[],"actions"', "actions"),
    (1, b'"sets":[', b'"sets":["goal","hole",', "no value"),
    (1, b'"sets":[', b'"sets":["hole"', "there is no set|should be"),
]


@pytest.mark.parametrize(("line", "old", "new", "words"), AMBIGUOUS)
def test_what_may_be_read_in_two_ways_is_refused(program, folder, tmp_path, line, old, new, words):
    lines = lines_of(folder / "anywhere charged")
    assert old in lines[line]
    lines[line] = lines[line].replace(old, new, 1)
    status, said, _ = run(program, written(signed(lines, 4), tmp_path / "x"))
    assert status == 1
    assert re.search(words, said), said


def test_two_proofs_and_halves_of_files(program, folder, tmp_path):
    lines, packed = lines_of(folder / "sure"), (folder / "sure").read_bytes()
    for more in (lines, lines[-5:], [lines[-1]], [b""], [b"", b""]):
        assert agreed(program, written(lines + more, tmp_path / "x")) or more == [b""]
    for size in (0, 5, len(packed) // 2, len(packed) - 1):
        (tmp_path / "x").write_bytes(packed[:size])
        agreed(program, tmp_path / "x")
    (tmp_path / "x").write_bytes(packed[:-6] + b"\0\0" + packed[-4:])
    assert "the gzip file is damaged" in agreed(program, tmp_path / "x")
    (tmp_path / "x").write_bytes(b"\n".join(lines))
    assert "is not gzip" in agreed(program, tmp_path / "x")


def test_where_it_cannot_work(program, folder, tmp_path):
    """A file that is not there, none at all, and one that goes by but once."""
    assert run(program, tmp_path / "none")[0] == 2
    done = subprocess.run([program], capture_output=True, text=True)  # noqa: S603
    assert (done.returncode, done.stderr) == (2, "usage: check FILE\n")
    packed = (folder / "sure").read_bytes()
    done = subprocess.run([program, "/dev/stdin"], input=packed, capture_output=True)  # noqa: S603
    assert (done.returncode, done.stderr[:30]) == (2, b"the file cannot be read twice,")


def test_names_in_other_scripts_are_sets_of_their_own(program, folder, tmp_path):
    """A set is known by its letters, however they must be escaped."""
    lines = lines_of(folder / "labels")
    assert b"Gef\\u00e4lle" in lines[0]
    upper = [line.replace(b"Gef\\u00e4lle", b"Gef\\u00E4lle") for line in lines]
    status, words, _ = run(program, written(signed(upper, states_of(lines)), tmp_path / "x"))
    assert (status, "escaped" in words) == (1, True)


def test_many_digits_and_many_states(program, tmp_path):
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
    agreed(program, tmp_path / "line")
    _, _, (lower, upper) = run(program, tmp_path / "line")
    assert lower <= known <= upper < lower + Fraction(1, 10**20)
