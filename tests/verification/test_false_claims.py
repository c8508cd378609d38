"""No proof claims more than is true: proofs are pushed as far as the checker lets them.

From values so low that they prove nothing, sets of them are raised together, and vectors of members
lowered, while the file is accepted. What is then claimed is the greatest claim that any file makes
of the question, as far as the steps tell; the optimum lies within it, and it is not far.
"""

from __future__ import annotations

import json
from fractions import Fraction
from itertools import combinations

import pytest

from formulations import MCMP, AlphaMCMP, FinitePenalty, LeastQuantity, MaxProb, MinCost
from mazes import MAZE
from small_models import FIRST, FREE_LOOP, FREE_PAIR, PAYING_LOOP, TRIES, model_of
from ssp_lp import end_probability, goal_probability, solve, visits, write_certificate
from ssp_lp.verification import checker

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
