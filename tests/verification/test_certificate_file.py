"""Certificates in files: exact intervals, and files that were tampered with."""

import gzip
import json
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from cases import ROBOT_VALUES, published
from formulations import (
    EGUBS,
    GUBS,
    ISSPUDE,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostBoundedReach,
    CostBudgetedMaxProb,
    CostLimit,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
    MinProb,
)
from formulations.command_line import main
from mazes import MAZE
from references.stated import optimum
from refusing import refused
from small_models import (
    FIRST,
    FREE_LOOP,
    FREE_PAIR,
    PAYING_LOOP,
    ROAD,
    TRIES,
    TWO_MOVES,
    model_of,
    patience,
)
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    MixedPolicy,
    Quantity,
    SolverError,
    arrival_cost,
    certify,
    check_certificate,
    end_probability,
    expected_cost,
    failure_probability,
    goal_probability,
    secondary_cost,
    sha256_of,
    solve,
    visits,
    write_certificate,
)
from ssp_lp.formulation import Formulation
from ssp_lp.processes import failure_label, failure_semantics
from ssp_lp.verification import certificate_lines, exact_proof, expand, prove

THIRDS = model_of(
    {"x": {"go": [(1 / 3, "g", Fraction(1, 3)), (1 / 3, "x", 0.1), (1 / 3, "d", 0.7)]}, "d": {}}
)
STAYS = model_of({"x": {"stay": [(1.0, "x", 4.0)], "go": [(0.5, "g", 1.0), (0.5, "x", 1.0)]}})
PITS = model_of(
    {
        "x": {"fast": [(0.5, "g", 1.0), (0.5, "pit", 1.0)], "slow": [(1.0, "g", 5.0)]},
        "pit": {"a": [(0.5, "pit", 6.0), (0.5, "hole", 2.0)], "b": [(1.0, "hole", 9.0)]},
        "hole": {},
    },
    labels={"hurt": ["pit"]},
)
RARE = model_of({"x": {"go": [(1e-6, "g", 1.0), (0.999999, "x", 1.0)]}})
LATE = model_of({"x": {"go": [(0.5, "g", 1.0), (0.5, "x", 1.0)]}})
TOWN = model_of(
    {
        "road": {
            "fast": [(0.5, "home", 1.0), (0.4, "road", 1.0), (0.1, "ditch", 1.0)],
            "safe": [(1.0, "home", 4.0)],
        },
        "ditch": {},
    },
    "home",
)
ROOTS = model_of({"x": {"go": [(0.5, "g", 2**0.5), (0.5, "x", 2**0.5)]}})
ROBOT = published("prism_robot_goal1", "time")[0]
FUEL = {"road": {"fast": 4.0, "safe": 1.0}}
TIMELY = end_probability("out of time")
DITCH, CHEAP = end_probability("ditch"), {"c": expected_cost() <= 2.5}


def squares():
    """The square of a total up to 4, and its tangent from there on."""
    return arrival_cost(lambda c: np.where(c <= 4.0, c * c, 8.0 * c - 16.0), affine_from=4.0)


@dataclass(frozen=True, eq=False)
class Arrivals(Formulation):
    """What arriving costs, given success, of a criterion that is one's own."""

    model: SSP
    start: object
    quantity: Quantity
    failure_budget: float | None = 1.0
    ratio = True


KNOWN = [
    (MCMP(ROAD, "road", 0.05), 2),
    (MCMP(ROAD, "road"), 3),
    (MCMP(FIRST, "depot", 0.05), "20/3"),
    (MCMP(FIRST, "depot"), "224/25"),
    (AlphaMCMP(ROAD, "road", 0.95), 2),
    (AlphaMCMP(FIRST, "depot", 1.0), "224/25"),
    (MaxProb(FIRST, "depot"), "99/100"),
    (MinProb(ROAD, "road"), "9/10"),
    (MinCost(ROAD, "road"), 3),
    (MinCost(RARE, "x"), 10**6),
    (MinCost(TRIES, "door"), 2),
    (FinitePenalty(ROAD, "road", 10.0), 2),
    (FinitePenalty(model_of(FREE_LOOP), "x", 10.0, give_up="dead_ends"), 5),
    (FinitePenalty(model_of(FREE_LOOP), "x", 3.0, give_up="dead_ends"), 3),
    (FinitePenalty(model_of(PAYING_LOOP), "x", 3.0, give_up="dead_ends"), 5),
    (FinitePenalty(model_of(PAYING_LOOP), "x", 3.0), 3),
    (FinitePenalty(model_of(PAYING_LOOP), "x", 2.5, None, "attention", True), "9/2"),
    (MCMP(model_of(FREE_PAIR), "x", 0.25), "7/2"),
    (MCMP(STAYS, "x", 0.5), 2),
    (MCMP(STAYS, "x", 0.5, charge_failing_step=False), 1),
    (MCMP(PITS, "x", 0.25), 4),
    (MCMP(PITS, "x", 0.25, charge_failing_step=False), 3),
    (MCMP(model_of(TWO_MOVES), {"x": 0.5, "g": 0.25, "d": 0.25}, 0.26), "4/5"),
    (MCMP(ROAD, "road", 0.145, discount=0.9), 2),
    (MCMP(PITS, "x", 0.325, discount=0.9), "39/10"),
    (FinitePenalty(PITS, "x", 10.0, 0.9, charge_failing_step=True), 6),
    (MCMP(ROAD, "road", 0.05, horizon=1), 2),
    (MaxProb(LATE, "x", horizon=3), "7/8"),
    (MaxProb(LATE, "x", horizon=3, constraints={"late": TIMELY <= 0.125}), "7/8"),
    (MCMP(ROAD, "road", 1.0, constraints={"pit": DITCH <= 0.05}), 2),
    (MinCost(ROAD, "road", constraints={"fuel": secondary_cost(FUEL) <= 2.0}), 3),
    (MCMP(PITS, "x", constraints={"n": visits("pit") <= 0.0}), 5),
    (CostBudgetedMaxProb(ROAD, "road", 2.0), "19/20"),
    (ConstrainedCost(ROAD, "road", {"fuel": CostLimit(FUEL, 2.5)}, 1.0), 2),
    (LeastQuantity(ROAD, "road", expected_cost() - 4.0 * DITCH + 1.0, 0.05), "14/5"),
    (LeastQuantity(ROAD, "road", failure_probability(), constraints=CHEAP), "1/40"),
    (MCMP(ROAD, "road", 1.0, constraints={"ditch": DITCH == 0.02}), "13/5"),
    (MCMP(ROAD, "road", 1.0, constraints={"home": goal_probability() >= 0.96}), "11/5"),
    (MCMP(ROAD, "home", 0.1), 0),
    (MaxProb(ROAD, "ditch"), 0),
    (MCMP(THIRDS, "x", 1.0, give_up="dead_ends"), "17/30"),  # as a third of a cost is a third
]
KNOWN += [
    (S3P(ROAD, "road", 0.05), "39/19"),
    (S3P(ROAD, "road"), 3),
    (S3P(ROAD, "road", 1.0), 1),
    (S3P(STAYS, "x"), 2),
    (S3P(STAYS, "x", 0.5), 1),
    (S3P(ROAD, "road", 0.145, discount=0.9), "130/57"),
    (S3P(ROAD, "road", reach_fraction=0.95), "39/19"),
    (S3P(ROBOT, 0), "11/3"),
    (S3P(ROBOT, 0, 0.5), "11/3"),
    (ISSPUDE(THIRDS, "x"), "23/60"),
    (S3P(THIRDS, "x", 1.0), "23/60"),
    (CostBoundedReach(STAYS, "x", 2), "3/4"),
    (CostBoundedReach(LATE, "x", 2.5), "3/4"),
    (CostBoundedReach(ROAD, "road", 0), 0),
    (CostBoundedReach(ROAD, "road", 1, 0.05), "9/20"),
    (GUBS(ROAD, "road", patience, 0.0), "27/40"),
    (GUBS(ROAD, "road", patience, 10.0), "41/4"),
    (GUBS(ROAD, "road", patience, 10.0, -1.0), "41/4"),
    (EGUBS(ROAD, "road", -0.5, 10.0), Fraction(10.0 + np.exp(-1.5))),
    (CostQuantile(TOWN, "road", 0.75), 4),
    (CostQuantile(TOWN, "road", 0.75, 0.2), 2),
    (CostQuantile(TOWN, "road", 0.75, 1.0), 2),
    (S3P(TOWN, "road", 0.2), "5/3"),
    (CostQuantile(ROOTS, "x", 0.75), 2 * Fraction(str(2**0.5))),
    (S3P(ROOTS, "x"), 2 * Fraction(str(2**0.5))),
    (Arrivals(ROAD, "road", squares()), 1),
    (Arrivals(TOWN, "road", squares(), 0.0), 16),
]
KNOWN += [
    (MCMP(ROBOT, 0, 0.75, give_up=give_up, charge_failing_step=charged), known)
    for give_up, charged, known in ROBOT_VALUES
]


WIDE = {
    number: 1e-19 if problem.model is THIRDS else 1e-11
    for number, (problem, _) in enumerate(KNOWN)
    if isinstance(problem, S3P) and (problem.model is THIRDS or problem.model is ROBOT)
}
"""Widths of ratios whose budget is slack, and of totals that go on beyond every cap."""

SKID = model_of(
    {
        "a": {"fast": [(0.9, "g", 1.0), (0.1, "skid", 1.0)], "slow": [(1.0, "g", 10.0)]},
        "skid": {"slide": [(0.5, "wreck", 0.0), (0.5, "ash", 0.0)]},
        "wreck": {},
        "ash": {},
    },
    labels={"crash": ["wreck"]},
)


def few(label):
    """A crash may come after the skid that loses the goal, a dead-end does not."""
    return MCMP(SKID, "a", 0.1, constraints={"few": end_probability(label) <= 0.01})


@pytest.mark.parametrize("number", range(len(KNOWN)))
def test_the_interval_holds_what_is_known(number, tmp_path, monkeypatch):
    """The lottery and the prices of the solution are those of the proof: one round a program.

    A single policy, a penalty and a quantile take two; totals beyond every cap take many.
    """
    problem, known = KNOWN[number]
    rounds, values = [], exact_proof.Nodes.values
    monkeypatch.setattr(exact_proof.Nodes, "values", lambda *a: rounds.append(a) or values(*a))
    known, written = Fraction(known), write_certificate(solve(problem), tmp_path / "one")
    assert written.accepted
    if number not in WIDE:
        kinds = FinitePenalty, CostQuantile, AlphaMCMP, S3P, ISSPUDE
        assert len(rounds) <= len(written.programs) * (2 if isinstance(problem, kinds) else 1)
    room = Fraction(1, 10**20) if written.exceeded else Fraction(0)
    if isinstance(problem, EGUBS):  # a utility is stated in decimals
        room = Fraction(1, 10**15)
    assert written.lower - room <= known <= written.upper + room
    assert -room <= written.upper - written.lower < WIDE.get(number, 1e-25)
    assert check_certificate(tmp_path / "one", problem=problem) == written
    assert sha256_of(problem) == written.digest
    assert optimum(lines_of(tmp_path / "one")) == pytest.approx(float(known), rel=1e-8)


def test_the_members_of_another_policy(tmp_path):
    """A policy that does not attain what the solution says, or breaks a row, is seen."""
    solution = solve(MCMP(ROAD, "road", 0.05))
    safe, fast = (
        replace(solution, policy=MixedPolicy((member,), np.ones(1)))
        for action in ("safe", "fast")
        for member in [DeterministicPolicy.from_actions(ROAD, {"road": action})]
    )
    words = "the policy's objective is 3.0, the solution says 2.0"
    refused(words, write_certificate, safe, tmp_path / "x", error=SolverError)
    written = write_certificate(safe, tmp_path / "one", tolerance=1.0)
    assert (written.lower, written.upper) == (2, 2)
    words = "the policy fails with 0.1, above the budget 0.05"
    refused(words, write_certificate, fast, tmp_path / "x", error=SolverError)
    assert not (tmp_path / "x").exists()


def test_a_wrong_reading_of_the_model_is_seen(tmp_path, monkeypatch):
    """The solver's rooms broken on purpose: a file does not read what they read."""
    problem = MCMP(ROAD, "road", 1.0, charge_failing_step=False)
    with monkeypatch.context() as broken:  # whatever is not a goal counts as avoiding it
        broken.setattr(failure_semantics, "attention_states", lambda model: ~model.goal_mask)
        solution = solve(problem)
    assert solution.objective == 0.0
    refused("gives up in state 'road'", write_certificate, solution, tmp_path / "one")
    problem = FinitePenalty(model_of(PAYING_LOOP), "x", 3.0, give_up="dead_ends")
    with monkeypatch.context() as broken:  # loops that cost something count as free
        broken.setattr(failure_label, "free_pairs", lambda model, *_: np.full(model.n_pairs, True))
        solution = solve(problem)
    assert solution.objective == 3.0
    refused("gives up in state 'x'", write_certificate, solution, tmp_path / "one")
    with monkeypatch.context() as broken:  # dead-ends charge twice
        charges = failure_semantics.dead_end_charges
        broken.setattr(failure_semantics, "dead_end_charges", lambda *a: 2.0 * charges(*a))
        solution = solve(MCMP(PITS, "x", 0.25, give_up="dead_ends"))
    assert solution.objective == solution.lower_bound == 5.0
    refused("the answer is not proved", write_certificate, solution, tmp_path / "one",
            error=SolverError)  # fmt: skip


@pytest.mark.parametrize("price", [0.0, 5.0, 20.0, 1000.0])
@pytest.mark.parametrize(
    ("problem", "known"), [(MCMP(ROAD, "road", 0.05), 2), (S3P(ROAD, "road"), 3),
                           (MCMP(ROAD, "road", 0.1), 1), (S3P(ROAD, "road", 0.1), 1)],
)  # fmt: skip
def test_any_price_leads_to_the_optimum(price, problem, known, tmp_path):
    """Whether the optimum is a lottery, the safe road, or the fast one, which just may be taken."""
    solution = replace(solve(problem), prices={"failure": price}, failure_price=price)
    written = write_certificate(solution, tmp_path / "one", tolerance=1e3)
    assert written.lower <= known <= written.upper <= written.lower + Fraction(1, 10**20)


def test_a_proof_is_better_than_a_solution_that_was_cut_short(tmp_path):
    """The safe road costs 3 and the fast one arrives with 0.9; the file proves 2, and 1."""
    safe, fast = (solve(MCMP(ROAD, "road", budget)).policy for budget in (0.0, 1.0))
    cheapest, best = solve(MCMP(ROAD, "road", 0.05)), solve(MaxProb(ROAD, "road"))
    for cut_short, known in (
        (replace(cheapest, policy=safe, objective=3.0), 2),
        (replace(best, policy=fast, objective=0.9, lower_bound=0.9), 1),
    ):
        written = write_certificate(cut_short, tmp_path / "one")
        assert written.lower <= known <= written.upper <= written.lower + Fraction(1, 10**20)


@pytest.mark.parametrize(
    ("solution", "words"),
    [
        (MCMP(ROAD, "road", reach_fraction=0.9, discount=0.99), "MCMP with reach_fraction"),
        (CVaR(ROAD, "road", 0.9, 0.05), "CVaR: the question asks for a tail mean; certify"),
        (few("crash"), "MCMP: the question counts quantities after failing; certify"),
    ],
)
def test_what_is_not_covered_is_named(solution, words, tmp_path):
    solution = solve(solution)
    refused(f"cannot be written for {words}", write_certificate, solution, tmp_path / "one")
    assert certify(solution).accepted
    assert not (tmp_path / "one").exists()


def test_a_policy_that_must_not_be_mixed_is_proved_in_memory(tmp_path):
    """At least failure lotteries do no better, so that there the file proves it."""
    single = solve(MCMP(ROAD, "road", 0.05), "deterministic")
    words = "cannot be written for MCMP: the best deterministic policy is not covered"
    refused(words, write_certificate, single, tmp_path / "one")
    assert certify(single).accepted
    least = solve(MCMP(ROAD, "road"), "deterministic")
    assert write_certificate(least, tmp_path / "one").upper == 3
    assert write_certificate(solve(few("dead_end")), tmp_path / "one").accepted


SCRIPTS = [certificate_lines.__file__, expand.__file__, prove.__file__]


def test_the_scripts_stand_alone(tmp_path):
    """They import the standard library and each other alone, and run where they were copied to."""
    write_certificate(solve(MCMP(ROAD, "road", 0.05)), tmp_path / "road.cert")
    for script in SCRIPTS:
        shutil.copy(script, tmp_path)
        imported = re.findall(r"^\s*(?:import|from) (\w+)", Path(script).read_text(), re.MULTILINE)
        assert {*imported} <= {*sys.stdlib_module_names, "expand", "prove"}
    run = [sys.executable, "-S", "-E", "-s", "certificate_lines.py", "road.cert"]
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True)  # noqa: S603
    assert (done.returncode, done.stderr) == (0, "")
    assert "its optimum lies between 2.0 and 2.0" in done.stdout
    (tmp_path / "road.cert").write_bytes(b"none")
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True)  # noqa: S603
    assert done.returncode == 1
    assert done.stdout.startswith("refused: ")


def test_the_command_line(tmp_path, capsys):
    path = tmp_path / "road.cert"
    write_certificate(solve(MCMP(ROAD, "road", 0.05)), path)
    assert main(["check", str(path)]) == 0
    assert "accepted: least 1 cost 0; from 'road' (1); failure 0.05" in capsys.readouterr().out
    mine = {"road": {"fast": [[0.9, "home", 1], [0.1, "ditch", 1]], "safe": [[1, "home", 3]]}}
    (tmp_path / "road.json").write_text(json.dumps({**mine, "ditch": {}}))
    asked = ["check", str(path), "--model", str(tmp_path / "road.json"), "--goal", "home"]
    asked += ["--start", "road", "--failure-budget"]
    assert main([*asked, "0.05"]) == 0
    assert main([*asked, "0.06"]) == 1
    assert "the file answers another question" in capsys.readouterr().err
    assert main(["check", str(path), "--failure-budget", "0.05"]) == 2
    assert "add --model" in capsys.readouterr().err
    path.write_bytes(gzip.compress(b"\n".join([*lines_of(path)[:-1], b""])))
    assert main(["check", str(path)]) == 1
    assert "is refused: the file ends within a proof" in capsys.readouterr().err
    assert main(["check", str(tmp_path / "none")]) == 2


def lines_of(path):
    """The lines of a file."""
    return gzip.decompress(path.read_bytes()).splitlines()


HURT = {"hurt": end_probability("hurt") <= 0.06}
TAMPERED = {
    "budget": MCMP(MAZE, "start", 0.07),
    "limit": MCMP(MAZE, "start", 0.1, give_up="dead_ends", constraints=HURT),
    "share": AlphaMCMP(MAZE, "start", 0.93),
    "worth": LeastQuantity(
        MAZE, {"start": 0.5, "town": 0.5}, visits("town") + 2.0 * goal_probability()
    ),
    "sure": MinCost(MAZE, "start"),
    "given": S3P(MAZE, "start", 0.1),
    "often": CostQuantile(MAZE, "start", 0.9, 0.1),
    "worth it": EGUBS(MAZE, "start", -0.5, 0.7),
}  # fmt: skip

QUESTION, FIRST_STATE, ANSWER, HEAD, BEGIN, NODE = 0, 1, 5, 6, 7, 8
"""Lines of a file with four states; those of the first program, if there are two."""


def _set(*where, to):
    """Put something in a place."""

    def edit(content):
        for key in where[:-1]:
            content = content[key]
        content[where[-1]] = to

    return edit


CHANGES = [
    ("a charge's order", "worth it", QUESTION, _set("charge", 0, 1, to="1/2"), "begins at 0"),
    ("a charge", "worth it", QUESTION, _set("charge", 1, 2, to="2"), "v <= |u >= "),
    ("a charge's slope", "given", QUESTION, _set("charge", 0, 3, to="2"), "v <= |u >= "),
    ("what totals add", "given", FIRST_STATE, _set("actions", 0, 2, 0, to="1"), "v <= |columns"),
    ("a ratio", "given", QUESTION, _set("ratio", to=False), "no line of"),
    ("a level", "often", QUESTION, _set("quantile", to="0.99999"), "quantile rarely enough"),
    ("an answer", "often", ANSWER, _set("answer", to="3"), "v <= |u >= |quantile|columns"),
    ("an answer to another", "given", ANSWER, _set("answer", to="3"), "an answer is a quantile"),
    ("a bound", "budget", QUESTION, _set("failure", to="0.06"), "bound of row failure"),
    ("a bound", "limit", QUESTION, _set("rows", 0, "at_most", to="0.01"), "bound of row hurt"),
    ("a share", "share", QUESTION, _set("failure", "share", to="0.99"), "bound of row failure"),
    ("a start", "budget", QUESTION, _set("start", to=[["1", 2]]), "begin"),
    ("a probability", "budget", FIRST_STATE, _set("actions", 0, 1, 1, 0, to="0.3"), "u >= |v <= "),
    ("a successor", "sure", FIRST_STATE, _set("actions", 2, 1, 0, 1, to=2), "surely"),
    ("a cost", "budget", FIRST_STATE, _set("actions", 0, 2, 0, to="5"), "u >= |v <= "),
    ("a label", "limit", 3, _set("sets", to=[]), "v <= c|u >= "),
    ("a weight", "budget", HEAD, _set("weights", 0, to="0.9"), "weights are >= 0 and sum to 1"),
    ("two weights", "budget", HEAD, lambda c: c["weights"].reverse(), "bound of row failure"),
    ("a price", "budget", HEAD, _set("prices", 0, to="-1"), "prices are >= 0"),
    ("a greater price", "budget", HEAD, _set("prices", 0, to="1000"), ""),
    ("a smaller price", "budget", HEAD, _set("prices", 0, to="1"), "v <= "),
    ("a unit", "budget", HEAD, _set("unit", to=1), "v <= |u >= "),
    ("no unit", "budget", HEAD, _set("unit", to=0), "not a whole number below"),
    ("a cap", "given", HEAD, _set("cap", to="0"), "v <= |u >= |v is stated|decides|columns"),
    ("a ratio that is claimed", "given", HEAD, _set("ratio", to="7"), "objective >= ratio"),
    ("a greater ratio", "given", HEAD, _set("ratio", to="1000000"), "price of failure >= ratio"),
    ("a value", "budget", NODE, _set(1, to=f"1{60 * '0'}00"), "v <= "),
    ("a lower value", "budget", NODE, _set(1, to="1"), "v <= c"),
    ("a part of a unit", "budget", NODE, _set(1, to="1/2"), "no whole number of units"),
    ("no value", "budget", NODE, _set(1, to=None), "v is stated after"),
    ("a share's value", "share", NODE, _set(1, to=f"1{60 * '0'}00"), "v <= "),
    ("a decision", "sure", NODE, _set(2, 1, to=3), "decides on a column"),
    ("a vector", "budget", NODE, _set(2, 3, to="0"), "u >= c"),
    ("the steps", "worth", NODE, _set(2, 2, to=0), "t >= 1"),
    ("a member", "sure", NODE, _set(2, 0, to=7), "not a whole number below"),
    ("a node", "sure", NODE, _set(0, to=0), "nodes come in their order"),
    ("a node alone", "sure", NODE, lambda c: c.__setitem__(slice(1, 9), [None]), "nodes come"),
    ("a member's second line", "sure", NODE, lambda c: c.append(c[-1]), "member twice at"),
    ("a member's line", "sure", NODE + 1, lambda c: c.pop(), "decides at each successor"),
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("certificates")
    for name, problem in TAMPERED.items():
        assert write_certificate(solve(problem), where / name).accepted
    return where


def read(lines, path, **asked):
    """What is said of a file of these lines."""
    path.write_bytes(gzip.compress(b"".join(line + b"\n" for line in lines), 1))
    return check_certificate(path, **asked)


def check_true(checked, lines, words):
    """A file is refused with these words, or its interval holds the optimum of what it asks."""
    if checked.accepted:
        known = optimum(lines)
        assert known is not None
        assert float(checked.lower) - 1e-9 <= known <= float(checked.upper) + 1e-9
    else:
        assert re.search(words, checked.reason), checked.reason


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "name", "line", "edit", "words"), CHANGES, ids=[c[0] for c in CHANGES]
)
def test_a_change_is_refused_by_name_or_still_true(folder, tmp_path, what, name, line, edit, words):
    lines = lines_of(folder / name)
    content = json.loads(lines[line])
    edit(content)
    lines[line] = json.dumps(content).encode()
    if line < ANSWER:
        mine = read(lines, tmp_path / "mine", problem=TAMPERED[name])
        assert re.search("answers another question|" + words, mine.reason)
        assert not mine.accepted
    checked = read(lines, tmp_path / "changed")
    assert checked.accepted == (not words)
    check_true(checked, lines, words)


@pytest.mark.parametrize("name", TAMPERED)
def test_lines_that_are_dropped_or_exchanged(folder, tmp_path, name):
    lines = lines_of(folder / name)
    for k in range(1, len(lines)):
        checked = read(lines[:k] + lines[k + 1 :], tmp_path / "x")
        assert not checked.accepted
    assert "lines after its proof" in read([*lines, lines[-1]], tmp_path / "x").reason
    swapped = [*lines]
    swapped[NODE], swapped[NODE + 1] = lines[NODE + 1], lines[NODE]
    assert "nodes come in their order" in read(swapped, tmp_path / "x").reason


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("discount", "1.5", "a discount lies in"),
        ("discount", "0", "a discount lies in"),
        ("discount", 0, "no text of a number"),
        ("discount", False, "no text of a number"),
        ("horizon", "3", "not a whole number"),
        ("horizon", -1, "not a whole number"),
        ("give_up", "never", "give_up is never"),
        ("greatest", 1, "greatest is 1"),
        ("failure", {"share": "2"}, "a share is a probability"),
        ("failure", 0, "no text of a number"),
        ("failure", False, "no text of a number"),
        ("failure", "", "no decimal"),
        ("quantile", "0.5", "a quantile is one of the total alone"),
        ("format", "ssp-lp certificate 1", "of this format"),
        ("states", 10**7, "StopIteration|no line of"),
        ("costs", 2, "costs of"),
    ],
)
def test_questions_that_are_not_known(folder, tmp_path, name, value, words):
    lines = lines_of(folder / ("share" if value == {"share": "2"} else "budget"))
    lines[0] = json.dumps(json.loads(lines[0]) | {name: value}).encode()
    assert re.search(words, read(lines, tmp_path / "x").reason)


@pytest.mark.parametrize(
    "text",
    ["1_0", " 1", "1 ", "+1", ".5", "5.", "\u0661", "1/\u0663", "1e1_0", "0x1", "1/-2", "--1", "",
     "nan", "inf", "1e", "1/2/3", "1.0/2", "1e99999", "1/0", True, 1, 0.5, None],
)  # fmt: skip
def test_a_number_is_written_in_one_way(folder, tmp_path, text):
    """What two readers may take for two numbers, or for none, is none."""
    lines = lines_of(folder / "sure")
    for line, *where in [
        (QUESTION, "start", 0, 0),
        (FIRST_STATE, "actions", 0, 2, 0),
        (HEAD, "prices", 0),
        (NODE, 1),
    ]:
        content = json.loads(lines[line])
        _set(*where, to=text)(content)
        changed = [*lines]
        changed[line] = json.dumps(content).encode()
        reason = read(changed, tmp_path / "x").reason
        assert re.search("no text of a number|no decimal|v is stated", reason), where


AMBIGUOUS = [
    ("sure", QUESTION, b'"failure":"0"', b'"failure":"0","failure":null', "a key comes twice"),
    ("budget", QUESTION, b'"failure":"0.07"', b'"failure":"0.07","failure":"1"', "comes twice"),
    ("budget", QUESTION, b'"greatest":false', b'"greatest":"false"', "greatest is"),
    ("budget", QUESTION, b'"greatest":false', b'"greatest":NaN', "greatest is"),
    ("budget", QUESTION, b'step":true', b'step":"false"', "charge_failing_step is"),
    ("budget", QUESTION, b'step":true', b'step":1', "charge_failing_step is"),
    ("budget", QUESTION, b'"constant":"0"', b'"constant":"0","square":true', "no quantity"),
    ("share", QUESTION, b'"share":"0.93"', b'"share":"0.93","of":"each start"', "a share has"),
    ("budget", QUESTION, b'"rows":[]', b'"rows":{}', "rows is"),
    ("budget", QUESTION, b'"sets":[]', b'"sets":"ab"', "sets is"),
    ("sure", HEAD, b'"weights":["1"]', b'"weights":"1"', "weights is"),
    ("limit", QUESTION, b'"name":"hurt"', b'"name":"failure"', "two rows are called alike"),
    ("budget", FIRST_STATE, b'"actions"', b'"give_up":false,"actions"', "no line of"),
    ("budget", FIRST_STATE, b'"actions"', b'"actions":[],"actions"', "comes twice"),
    ("budget", FIRST_STATE, b'0]],["1"]', b'0]],"1"', "costs of"),
    ("budget", HEAD, b'"prices"', b'"prices":["0"],"prices"', "comes twice"),
    ("limit", 3, b'"sets":["hurt"]', b'"sets":["harmed"]', "there is no set harmed"),
    ("limit", QUESTION, b'"end","hurt"', b'"end","harmed"', "there is no set harmed"),
]


@pytest.mark.parametrize(("name", "line", "old", "new", "words"), AMBIGUOUS)
def test_what_may_be_read_in_two_ways_is_refused(folder, tmp_path, name, line, old, new, words):
    lines = lines_of(folder / name)
    assert old in lines[line], lines[line]
    lines[line] = lines[line].replace(old, new, 1)
    assert words in read(lines, tmp_path / "x").reason


@pytest.mark.parametrize("budget", [0.16, None])
@pytest.mark.parametrize("unit", [1.0, 1e-7])
def test_certificates_do_not_depend_on_the_unit_of_costs(unit, budget, tmp_path):
    """A ring with c* = 20/7 units: caps follow the greatest cost of a step, not the number 1."""
    ways = {
        s: {
            "on": [(0.5, "home", 3 * unit), (0.4, (s + 1) % 6, 2 * unit), (0.1, "ditch", unit)],
            "wait": [(0.3, "home", unit), (0.65, s, unit), (0.05, "ditch", unit)],
        }
        for s in range(6)
    }
    model = SSP.from_transitions(ways, goal={"home"}, dead_ends={"ditch"})
    written = write_certificate(solve(S3P(model, 0, budget)), tmp_path / "one")
    assert float(written.upper) == pytest.approx(20 / 7 * unit, rel=1e-10)
    assert 0 <= float(written.upper - written.lower) <= 1e-9 * float(written.upper)
