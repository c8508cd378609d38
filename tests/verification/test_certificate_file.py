"""Certificates in files: exact intervals, and files that were tampered with."""

import gzip
import json
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from fractions import Fraction
from hashlib import sha256

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
from small_models import FIRST, FREE_LOOP, FREE_PAIR, PAYING_LOOP, TRIES, TWO_MOVES, model_of
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    MixedPolicy,
    Quantity,
    SolverError,
    arrival_cost,
    check_certificate,
    end_probability,
    expected_cost,
    failure_probability,
    goal_probability,
    secondary_cost,
    solve,
    visits,
    write_certificate,
)
from ssp_lp.formulation import Formulation
from ssp_lp.processes import failure_label, failure_semantics
from ssp_lp.verification import checker, exact_values

ROAD = model_of(
    {
        "road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)], "safe": [(1.0, "home", 3.0)]},
        "ditch": {},
    },
    "home",
)
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
DITCH, CHEAP = end_probability("ditch"), {"c": expected_cost() <= 2.5}


def patience(cost):
    """A utility that is used up at 4."""
    return np.maximum(1.0 - cost / 4.0, 0.0)


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
    (CVaR(TOWN, "road", 0.0, 0.2), "5/3"),
    (CVaR(TOWN, "road", 0.5, 0.2), "7/3"),
    (CVaR(TOWN, "road", 0.9, 0.2), 4),
    (CVaR(ROAD, "road", 0.25, 0.05), "137/57"),
    (CVaR(ROAD, "road", 0.9, 0.05), 3),
    (CVaR(ROAD, "road", 0.9, 0.05, constraints={"ditch": DITCH <= 0.0}), 3),
    (CVaR(LATE, "x", 0.5), 3),
    (CVaR(LATE, {"x": 0.5, "g": 0.5}, 0.5), 2),
    (CVaR(ROOTS, "x", 0.75), 4 * Fraction(str(2**0.5))),
    (CVaR(STAYS, "x", 0.3, 0.5), 1),
]
KNOWN += [
    (MCMP(ROBOT, 0, 0.75, give_up=give_up, charge_failing_step=charged), known)
    for give_up, charged, known in ROBOT_VALUES
]


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


THIRD = model_of(
    {
        "s": {"go": [(0.6, "x", 1.0), (0.4, "g", 1.0)], "safe": [(1.0, "g", 10.0)]},
        "x": {"u": [(0.7, "x", 1.0), (0.1, "d", 1.0), (0.2, "g", 1.0)]},
        "d": {},
    }
)
"""From x a third fails, from s a fifth."""

SINGLE = [
    (MCMP(THIRD, "s", 0.2), 3),
    (S3P(THIRD, "s", 0.2), "8/3"),
    (MCMP(ROAD, "road", 0.05), 3),
    (MCMP(FIRST, "depot", 0.05), "224/25"),
    (MCMP(ROAD, {"road": 0.5, "home": 0.5}, 0.05), "1/2"),
    (AlphaMCMP(ROAD, "road", 0.95), 3),
    (MCMP(ROAD, "road", 0.145, discount=0.9), 3),
    (MCMP(PITS, "x", 0.25), 5),
    (MCMP(STAYS, "x", 0.5), 2),
    (MCMP(model_of(FREE_PAIR), "x", 0.25), 6),
    (FinitePenalty(ROAD, "road", 10.0), 2),
    (MinCost(TRIES, "door"), 2),
    (MCMP(ROAD, "road"), 3),  # at least failure nobody gains by mixing
    (S3P(ROAD, "road", 0.05), 3),
    (S3P(TOWN, "road", 0.1), "25/9"),
    (S3P(STAYS, "x", 0.5), 1),
    (MCMP(ROBOT, 0, 0.6), "11/3"),
]


@pytest.mark.parametrize(("problem", "known"), SINGLE, ids=range(len(SINGLE)))
def test_no_policy_does_better_alone(problem, known, tmp_path):
    written = write_certificate(solve(problem, "deterministic"), tmp_path / "one")
    lines = lines_of(tmp_path / "one")
    assert written.lower <= Fraction(known) <= written.upper < written.lower + Fraction(1, 10**9)
    assert check_certificate(tmp_path / "one") == written
    is_single = problem.failure_budget is not None
    assert (
        (b'"deterministic":true' in lines[0]) == written.asked.endswith(", not mixed") == is_single
    )
    if not problem.ratio:  # all policies, one by one
        assert optimum(lines) == pytest.approx(float(Fraction(known)), rel=1e-8)


KNOWN += [
    (few("crash"), "41/5"),
    (S3P(SKID, "a", 0.1, constraints={"few": end_probability("crash") <= 0.01}), "409/49"),
    (MCMP(PITS, "x", 1.0, constraints={"n": visits("pit", through_failure=True) <= 0.25}), 4),
    (
        MCMP(
            PITS, "x", 1.0,
            constraints={"a": secondary_cost({"pit": {"a": 1.0}}, through_failure=True) <= 0.0},
        ),
        3,
    ),
    (MCMP(PITS, "x", constraints={"n": visits("pit", through_failure=True) <= 0.25}), 5),
    (
        LeastQuantity(
            SKID, "a", end_probability("crash"), constraints={"c": expected_cost() <= 5.5}
        ),
        "1/40",
    ),
]  # fmt: skip


BETWEEN = {5, 47, 48, 49, 58, 67}
"""Intervals that are no fraction: a higher price, or cap, would prove more; an exponential."""


@pytest.mark.parametrize("number", range(len(KNOWN)))
def test_the_interval_holds_what_is_known(number, tmp_path):
    problem, known = KNOWN[number]
    known, written = Fraction(known), write_certificate(solve(problem), tmp_path / "one")
    assert written.accepted
    room = Fraction(1, 10**20) if written.exceeded else Fraction(0)
    assert written.lower <= known <= written.upper + room
    width = 1e-20 if problem.model is THIRDS and not problem.ratio else 1e-9
    assert -room <= written.upper - written.lower < width
    assert number in BETWEEN or written.lower == known == written.upper
    assert check_certificate(tmp_path / "one") == written
    lines = lines_of(tmp_path / "one")
    assert optimum(lines) == pytest.approx(float(known), rel=1e-8)


def test_the_members_of_another_policy(tmp_path):
    """What is proved is the lottery that is handed over, however far from the best."""
    solution = solve(MCMP(ROAD, "road", 0.05))
    safe, fast = (
        replace(solution, policy=MixedPolicy((member,), np.ones(1)))
        for action in ("safe", "fast")
        for member in [DeterministicPolicy.from_actions(ROAD, {"road": action})]
    )
    words = "claimed is at most 2.000002 fails, proved from 2.0 to 3.0"
    refused(words, write_certificate, safe, tmp_path / "x", error=SolverError)
    written = write_certificate(safe, tmp_path / "one", tolerance=1.0)
    assert (written.lower, written.upper) == (2, 3)
    words = "bound of row failure fails"
    refused(words, write_certificate, fast, tmp_path / "x", error=SolverError)
    assert not (tmp_path / "x").exists()


def test_decimals_do_where_fractions_do_not(tmp_path, monkeypatch):
    """What stops the exact attempts leaves the proof in decimals."""
    known = exact_values.best_values

    def failing(rows, choice, one):
        if one != checker.ONE:
            raise SolverError("no policy is best")
        return known(rows, choice, one)

    monkeypatch.setattr(exact_values, "best_values", failing)
    written = write_certificate(solve(MCMP(FIRST, "depot", 0.05)), tmp_path / "one")
    assert written.lower < Fraction(20, 3) <= written.upper < written.lower + Fraction(1, 10**12)


def test_a_wrong_reading_of_the_model_is_seen(tmp_path, monkeypatch):
    """The solver's rooms broken on purpose: a file does not read what they read."""
    problem = MCMP(ROAD, "road", 1.0, charge_failing_step=False)
    with monkeypatch.context() as broken:  # whatever is no goal counts as avoiding it
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
    words = "claimed is at least 4.999995 fails, proved from 3.0 to 5.0"
    refused(words, write_certificate, solution, tmp_path / "one", error=SolverError)


@pytest.mark.parametrize("price", [0.0, 5.0, 20.0, 1000.0])
def test_any_price_proves_something_true(price, tmp_path):
    solution = replace(solve(MCMP(ROAD, "road", 0.05)), prices={"failure": price})
    solution = replace(solution, failure_price=price)
    written = write_certificate(solution, tmp_path / "one", tolerance=1e3)
    assert written.lower <= 2 <= written.upper


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        (MCMP(ROAD, "road", reach_fraction=0.9, discount=0.99), "MCMP with reach_fraction"),
    ],
)
def test_what_is_not_covered_is_named(problem, words, tmp_path):
    refused(f"no certificate of {words}", write_certificate, solve(problem), tmp_path / "one")
    assert write_certificate(solve(few("dead_end")), tmp_path / "one").accepted


def test_the_checker_stands_alone(tmp_path):
    """It imports the standard library alone, and runs where it was copied to."""
    write_certificate(solve(MCMP(ROAD, "road", 0.05)), tmp_path / "road.cert")
    shutil.copy(checker.__file__, tmp_path / "copied.py")
    run = [sys.executable, "-I", "-S", "copied.py", "road.cert"]
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True)  # noqa: S603
    assert done.returncode == 0
    assert "at least  2.0" in done.stdout
    (tmp_path / "road.cert").write_bytes(b"none")
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True)  # noqa: S603
    assert done.returncode == 1
    assert done.stdout.startswith("refused: this is no certificate")


def test_the_command_line(tmp_path, capsys):
    path = tmp_path / "road.cert"
    write_certificate(solve(MCMP(ROAD, "road", 0.05)), path)
    assert main(["check", str(path)]) == 0
    assert "accepted: MCMP" in capsys.readouterr().out
    path.write_bytes(gzip.compress(b"\n".join(lines_of(path)[:-1])))
    assert main(["check", str(path)]) == 1
    assert "is refused: 7 lines where there should be 8" in capsys.readouterr().err
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
    "worst": CVaR(MAZE, "start", 0.9, 0.1),
    "alone": MCMP(MAZE, "start", 0.15),
}  # fmt: skip

QUESTION, FIRST_STATE, HEAD, PROOF, NODES = 0, 1, 5, 6, 10
"""Lines of a file with four states."""


def _set(*where, to):
    """Put something in a place."""

    def edit(content):
        for key in where[:-1]:
            content = content[key]
        content[where[-1]] = to

    return edit


CHANGES = [
    ("a charge's order", "worth it", QUESTION, _set("charge", 0, 0, to="1/2"), "told from 0 on"),
    ("a charge", "worth it", QUESTION, _set("charge", 1, 2, to="2"), "v <= "),
    ("a charge's slope", "given", QUESTION, _set("charge", 0, 3, to="2"), "sum p u <= u|v <= "),
    ("what totals add", "given", FIRST_STATE, _set("actions", 0, 2, 0, to="1"), "v <= "),
    ("a ratio", "given", QUESTION, _set("ratio", to=False), ""),
    ("a level", "often", QUESTION, _set("quantile", to="0.99999"), "quantile as rarely"),
    ("a mean's level", "worst", QUESTION, _set("tail_mean", to="0.95"), "sum p u <= u|v <= "),
    ("a threshold", "worst", HEAD, _set("threshold", to="3"), "sum p u <= u"),
    ("a case's end", "worst", HEAD, _set("cases", 0, 0, to="1/2"), "v <= "),
    ("a case's price", "worst", HEAD, _set("cases", 1, 1, "prices", 0, to="1"), "v <= "),
    ("a negative price", "worst", HEAD, _set("cases", 1, 1, "prices", 0, to="-1"), "prices are"),
    ("a case", "worst", HEAD, lambda c: c["cases"].pop(), "a value for each case"),
    ("two cases", "worst", HEAD, lambda c: c["cases"].reverse(), "v <= "),
    ("a case's value", "worst", PROOF, _set("v", 1, to="1000"), "v <= "),
    ("mixing", "alone", QUESTION, _set("deterministic", to=False), "the keys"),
    ("a lottery's bound", "alone", QUESTION, _set("failure", to="0.05"), "bound of row failure"),
    ("a part", "alone", HEAD, lambda c: c["cases"]["parts"].pop(), "each decision is in a part"),
    ("a decision", "alone", HEAD, lambda c: c["cases"]["parts"][0][0].pop(), "each decision"),
    ("a tree's state", "alone", HEAD, _set("cases", "state", to=1), "each decision|v <= |a value"),
    ("a leaf price", "alone", HEAD, _set("cases", "parts", 0, 1, "prices", 0, to="1"), "v <= |at"),
    ("a value of no case", "worst", PROOF, lambda c: c["v"].append("0"), "a value for each case"),
    ("a claim", "often", HEAD, _set("claim", to=["3", "3"]), "v <= |sum p u|quantile"),
    ("a line of a total", "given", NODES, _set("total", to="1"), "no line tells of|fails"),
    ("a slope", "given", PROOF, _set("slope", to="1000"), "v <= "),
    ("a bound", "budget", QUESTION, _set("failure", to="0.06"), "bound of row failure"),
    ("a bound", "limit", QUESTION, _set("rows", 0, "at_most", to="0.01"), "bound of row hurt"),
    ("a share", "share", QUESTION, _set("failure", "share", to="0.99"), "bound of row failure"),
    ("a start", "budget", QUESTION, _set("start", to=[["1", 2]]), "row failure"),
    ("a probability", "budget", FIRST_STATE, _set("actions", 0, 1, 1, 0, to="0.3"), "sum p u <= u"),
    ("a successor", "sure", FIRST_STATE, _set("actions", 2, 1, 0, 1, to=2), "failure 0: the goal"),
    ("a cost", "budget", FIRST_STATE, _set("actions", 0, 2, 0, to="5"), "objective [+]"),
    ("a label", "limit", 3, _set("sets", to=[]), "v <= c"),
    ("a weight", "budget", HEAD, _set("weights", 0, to="0.9"), "weights are >= 0 and sum to 1"),
    ("two weights", "budget", HEAD, lambda c: c["weights"].reverse(), "bound of row failure"),
    ("a price", "budget", HEAD, _set("prices", 0, to="-1"), "prices are >= 0"),
    ("a greater price", "budget", HEAD, _set("prices", 0, to="1000"), "claimed is at least"),
    ("a smaller price", "budget", HEAD, _set("prices", 0, to="1"), "v <= "),
    ("the SHA-256", "budget", HEAD, _set("sha256", to="0" * 64), "SHA-256"),
    ("a value", "budget", PROOF, _set("v", to="100"), "v <= "),
    ("a lower value", "budget", PROOF, _set("v", to="1"), "claimed is at least"),
    ("a claim", "budget", HEAD, _set("claim", 0, to="4.81"), "claimed is at least 4.81 fails"),
    ("a share's value", "share", PROOF, _set("w", to="0.2"), "v <= "),
    ("a decision", "sure", PROOF, _set("members", 0, 0, to=3), "sum p u <= u at start 3 fails"),
    ("giving up", "sure", PROOF, _set("members", 0, 0, to="stop"), "stops where it may"),
    ("a vector", "budget", PROOF, _set("members", 0, 2, to="0"), "objective [+] sum p u <= u"),
    ("the steps", "worth", PROOF, _set("members", 0, 1, to="0"), "1 [+] sum p u <= u"),
    ("two members", "budget", PROOF, lambda c: c["members"].reverse(), "member|row failure"),
    ("a member's line", "sure", PROOF + 1, _set("members", 0, to=None), "decides after start"),
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("certificates")
    for name, problem in TAMPERED.items():
        solution = solve(problem, "deterministic" if name == "alone" else None)
        assert write_certificate(solution, where / name).accepted
    return where


def read(lines, path):
    """What is said of a file of these lines."""
    path.write_bytes(gzip.compress(b"\n".join(lines)))
    return check_certificate(path)


def check_true(checked, lines, words):
    """A file is refused with these words, or its interval holds the optimum of what it asks."""
    if checked.accepted:
        known = optimum(lines[:HEAD])
        assert known is not None
        assert float(checked.lower) - 1e-9 <= known <= float(checked.upper) + 1e-9
    else:
        assert re.search(words, checked.reason), checked.reason


def signed(lines):
    """The same lines with the SHA-256 made anew, and little claimed but of a quantile."""
    head = json.loads(lines[HEAD]) | {"sha256": sha256(b"\n".join(lines[:HEAD])).hexdigest()}
    if b'"quantile"' not in lines[0]:
        head["claim"] = ["-1e9", "1e9"]
    return [*lines[:HEAD], json.dumps(head).encode(), *lines[PROOF:]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "name", "line", "edit", "words"), CHANGES, ids=[c[0] for c in CHANGES]
)
def test_a_change_is_refused_by_name_or_still_true(folder, tmp_path, what, name, line, edit, words):
    lines = lines_of(folder / name)
    content = json.loads(lines[line])
    edit(content)
    lines[line] = json.dumps(content).encode()
    stated = line in (QUESTION, FIRST_STATE, 3)
    if stated:
        assert "SHA-256" in read(lines, tmp_path / "unsigned").reason
        lines = signed(lines)
    checked = read(lines, tmp_path / "changed")
    assert checked.accepted == (not words)
    check_true(checked, lines, words)


@pytest.mark.parametrize("name", TAMPERED)
def test_lines_that_are_dropped_or_exchanged(folder, tmp_path, name):
    lines = lines_of(folder / name)
    for k in range(1, len(lines)):
        checked = read(lines[:k] + lines[k + 1 :], tmp_path / "x")
        assert "lines where there should be" in checked.reason
    swapped = [*lines]
    swapped[PROOF], swapped[PROOF + 1] = lines[PROOF + 1], lines[PROOF]
    check_true(read(swapped, tmp_path / "x"), lines, "fails|decides")  # true where they are alike


@pytest.mark.parametrize(
    ("name", "value"),
    {
        "discount": "1.5",
        "horizon": 3,
        "give_up": "never",
        "greatest": 1,
        "failure": {"share": "2"},
    }.items(),
)
def test_questions_that_are_not_known(folder, tmp_path, name, value):
    lines = lines_of(folder / "budget")
    lines[0] = json.dumps(json.loads(lines[0]) | {name: value}).encode()
    assert not read(signed(lines), tmp_path / "x").accepted


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
        (PROOF, "v"),
    ]:
        content = json.loads(lines[line])
        _set(*where, to=text)(content)
        changed = [*lines]
        changed[line] = json.dumps(content).encode()
        reason = read(signed(changed), tmp_path / "x").reason
        assert re.search("no text of a number|no decimal|too large|division by|Fraction", reason), (
            where
        )


AMBIGUOUS = [
    ("sure", QUESTION, b'"failure":"0"', b'"failure":"0","failure":null', "a key comes twice"),
    ("budget", QUESTION, b'"failure":"0.07"', b'"failure":"0.07","failure":"1"', "comes twice"),
    ("budget", QUESTION, b'"greatest":false', b'"greatest":"false"', "greatest is"),
    ("budget", QUESTION, b'"greatest":false', b'"greatest":0', "greatest is"),
    ("budget", QUESTION, b'"greatest":false', b'"greatest":NaN', "greatest is"),
    ("budget", QUESTION, b'step":true', b'step":"false"', "charge_failing_step is"),
    ("budget", QUESTION, b'step":true', b'step":1', "charge_failing_step is"),
    ("budget", QUESTION, b'"constant":"0"', b'"constant":"0","square":true', "the keys"),
    ("share", QUESTION, b'"share":"0.93"', b'"share":"0.93","of":"each start"', "the keys"),
    ("budget", QUESTION, b'"rows":[]', b'"rows":{}', "rows is"),
    ("budget", QUESTION, b'"sets":[]', b'"sets":"ab"', "sets is"),
    ("sure", HEAD, b'"weights":["1"]', b'"weights":"1"', "weights is no list"),
    ("limit", QUESTION, b'"name":"hurt"', b'"name":"failure"', "two rows are called alike"),
    ("budget", FIRST_STATE, b'"actions"', b'"give_up":false,"actions"', "the keys"),
    ("budget", FIRST_STATE, b'"actions"', b'"actions":[],"actions"', "comes twice"),
    ("budget", FIRST_STATE, b'0]],["1"]', b'0]],"1"', "has for its costs"),
    ("budget", HEAD, b'"prices"', b'"prices":["0"],"prices"', "comes twice"),
    ("budget", PROOF, b'"members"', b'"members":[null,null],"members"', "comes twice"),
    ("sure", PROOF, b'"members":[[', b'"members":[0,[', "has values, and each member"),
]


@pytest.mark.parametrize(("name", "line", "old", "new", "words"), AMBIGUOUS)
def test_what_may_be_read_in_two_ways_is_refused(folder, tmp_path, name, line, old, new, words):
    lines = lines_of(folder / name)
    assert old in lines[line]
    lines[line] = lines[line].replace(old, new, 1)
    lines = signed(lines) if line in (QUESTION, FIRST_STATE) else lines
    assert words in read(lines, tmp_path / "x").reason


def test_a_question_in_words_cannot_pose_as_a_verdict(folder, tmp_path):
    lines = lines_of(folder / "sure")
    content = json.loads(lines[QUESTION]) | {"asked": "MinCost\n  at most   0.0 = 0\x1b[8m"}
    lines[QUESTION] = json.dumps(content).encode()
    checked = read(signed(lines), tmp_path / "x")
    assert checked.accepted
    assert str(checked).startswith("accepted: 'MinCost\\n  at most   0.0 = 0\\x1b[8m'\n  SHA-256 ")


def test_a_row_is_not_exceeded_by_less_than_the_units_of_a_proof(tmp_path):
    """A bound of 0 leaves no room, and half of a tenth of a unit is more than nothing."""
    row = {"constant": "0", "terms": [["1e-61", "cost", 0]]}
    question = {
        "format": checker.FORMAT, "asked": "", "states": 2, "costs": 1, "sets": [],
        "start": [["1", 0], ["1", 1]], "give_up": "dead_ends", "charge_failing_step": False,
        "greatest": False, "objective": {"constant": "0", "terms": [["1", "cost", 0]]},
        "failure": None, "discount": None,
    }  # fmt: skip
    states = [
        {"name": "x", "sets": [], "actions": [["go", [["1", 1]], ["1"]]]},
        {"name": "g", "sets": ["goal"], "actions": []},
    ]
    proof = [{"v": "1", "members": [[0, "1", "1", "1e-60"]]}, {"v": "0", "members": [None]}]
    for bound, accepted in (("0", False), ("1e-60", True)):
        asked = question | {"rows": [{"name": "r", "quantity": row, "at_most": bound}]}
        lines = [json.dumps(line).encode() for line in (asked, *states)]
        head = {"sha256": sha256(b"\n".join(lines)).hexdigest(), "claim": ["0.5", "0.5"]}
        head |= {"prices": ["0"], "weights": ["1"]}
        lines += [json.dumps(line).encode() for line in (head, *proof)]
        checked = read(lines, tmp_path / "x")
        assert checked.accepted == accepted
        assert accepted or "lottery <= bound of row r fails" in checked.reason
