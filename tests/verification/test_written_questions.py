"""What a certificate file says: its question in words, the sets that it names, and its numbers."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise

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
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
    MinProb,
)
from refusing import refused
from small_models import FIRST, ROAD, model_of, patience
from ssp_lp import (
    SSP,
    MixedPolicy,
    Quantity,
    SolverError,
    StochasticPolicy,
    TimedPolicy,
    arrival_cost,
    check_certificate,
    end_probability,
    expected_cost,
    secondary_cost,
    sha256_of,
    solve,
    visits,
    write_certificate,
)
from ssp_lp.formulation import Formulation
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.verification import certificate_file as files, certificate_lines as reading
from ssp_lp.verification.certificate_file import Checked, Statement, text_of
from ssp_lp.verification.prove import Bounds

FUEL = {"road": {"fast": 4.0, "safe": 1.0}}


CHARGED = "give_up attention; the failing step charged"


@pytest.mark.parametrize(
    ("problem", "sought", "rest"),
    [
        (MCMP(ROAD, "road", 0.05), "least 1 cost 0", f"failure 0.05; {CHARGED}"),
        (MCMP(ROAD, "road", 1.0), "least 1 cost 0", CHARGED),
        (MCMP(ROAD, "road"), "least 1 cost 0", f"failure least; {CHARGED}"),
        (MinCost(ROAD, "road"), "least 1 cost 0", "failure 0; give_up dead_ends"),
        (AlphaMCMP(ROAD, "road", 0.9), "least 1 cost 0",
         "failure of a share 0.9 of the goal; give_up anywhere"),
        (MaxProb(ROAD, "road"), "greatest 1 end 'goal'", "give_up attention"),
        (MinProb(ROAD, "road"), "least 1 end 'goal'", "give_up attention"),
        (S3P(ROAD, "road", 0.05), "least total of cost 0 given the goal",
         "failure 0.05; give_up attention"),
        (FinitePenalty(ROAD, "road", 10.0), "least 1 cost 0 + -10 end 'goal' + 10",
         "give_up anywhere"),
        (FinitePenalty(ROAD, "road", 0.5), "least 1 cost 0 + -0.5 end 'goal' + 0.5",
         "give_up anywhere"),
        (CostQuantile(ROAD, "road", 0.75, 0.05),
         "least 0.75-quantile of the total of cost 0 given the goal",
         "failure 0.05; give_up attention"),
        (MCMP(ROAD, "road", 0.2, discount=0.9), "least 1 cost 0",
         f"failure 0.2; discount 0.9; {CHARGED}"),
        (MCMP(ROAD, "road", 0.2, horizon=3), "least 1 cost 0",
         f"failure 0.2; horizon 3; {CHARGED}"),
        (LeastQuantity(ROAD, "road", 0.0 * expected_cost(), 0.5), "least 0",
         "failure 0.5; give_up attention"),
        (LeastQuantity(ROAD, "road", visits("road") + 2.0 * end_probability("ditch") + 1.0, 0.5),
         "least 1 visits 'road' + 2 end 'ditch' + 1", "failure 0.5; give_up attention"),
        (MCMP(ROAD, "road", 0.5, constraints={"f": secondary_cost(FUEL) <= 2.5,
                                              "d": end_probability("ditch") >= 0.01}),
         "least 1 cost 0",
         f"failure 0.5; {CHARGED}; 'f': 1 cost 1 at most 2.5; 'd': 1 end 'ditch' at least 0.01"),
        (CostBoundedReach(ROAD, "road", 1, 0.05),
         "greatest charge [['>=', '0', '1', '0'], ['>', '1', '0', '0']] of the total of cost 0",
         "failure 0.05; give_up attention"),
        (GUBS(ROAD, "road", patience, 10.0), "greatest charge [['>=', '0', '11', '0'], ['>=', '1', "
         "'10.75', '0'], ['>=', '3', '10.25', '0'], ['>', '3', '10', '0']] of the total of cost 0",
         "give_up attention"),
    ],
    ids=range(18),
)  # fmt: skip
def test_a_question_in_words(problem, sought, rest, tmp_path):
    """The whole question in the order of its file; a budget of 1 is none."""
    words = write_certificate(solve(problem), tmp_path / "x").asked
    begin, _, end = words.partition("; from 'road' (1); ")
    assert (begin, end) == (sought, rest)


def test_the_states_of_a_start_by_name(tmp_path):
    for start in ({"road": 0.75, "ditch": 0.25}, {"ditch": 0.25, "road": 0.75}):
        words = write_certificate(solve(MaxProb(ROAD, start)), tmp_path / "x").asked
        stated = ", ".join(f"{name!r} ({share})" for name, share in start.items())
        assert words.split("; ")[1] == f"from {stated}"


@pytest.mark.parametrize(("lower", "upper"), [
    ("1/3", "2/3"), ("-2/3", "-1/3"), ("-1/3", "1/3"), ("0", "12345678901234567890/7"), ("2", "2"),
])  # fmt: skip
def test_the_digits_of_a_verdict_are_rounded_outwards(lower, upper):
    """To 25 places: the interval that is shown holds the one that is proved."""
    exact = Fraction(lower), Fraction(upper)
    lines = str(Checked(True, "", *exact, {}, "what is asked", "abc")).splitlines()
    assert lines[:2] == ["accepted: what is asked", "  SHA-256   abc"]
    shown = [Fraction(line.split()[-1]) for line in lines[2:4]]
    assert [line[:11] for line in lines[2:4]] == ["  at least ", "  at most  "]
    assert shown[0] <= exact[0] < shown[0] + Fraction(1, 10**25)
    assert shown[1] - Fraction(1, 10**25) < exact[1] <= shown[1]
    assert lines[4:] == [f"  width     {float(exact[1] - exact[0]):.1e}"]
    refusal = Checked(False, "v <= c", exceeded={"row": Fraction(1)})
    assert str(refusal) == "refused: v <= c"
    beyond = str(Checked(True, exceeded={"row": Fraction(1, 10**30)})).splitlines()[-1]
    assert beyond == "  the lottery exceeds row 'row' by 1.0e-30"


# Sets and costs are called as nothing else is.


def called(name):
    """A cheap way by a place of this name, and a dear one past it."""
    table = {"x": {"by": [(1.0, name, 1.0)], "past": [(1.0, "g", 5.0)]},
             name: {"on": [(1.0, "g", 0.0)]}}  # fmt: skip
    return model_of(table)


@pytest.mark.parametrize("name", ["goal", "out of time", "set 1", "here"])
@pytest.mark.parametrize("horizon", [None, 3])
def test_a_state_may_be_called_like_a_set_of_the_format(name, horizon, tmp_path):
    """Half of the runs may go by it, for 1, the others pay 5."""
    if horizon is not None and name == "out of time":
        return  # there the words stand for the runs that the horizon ends
    few = {"few": visits(name) <= 0.5, "most": visits("x") <= 1.0}
    problem = MCMP(called(name), "x", 1.0, constraints=few, horizon=horizon)
    written = write_certificate(solve(problem), tmp_path / "x")
    assert written.lower <= 3 <= written.upper + Fraction(1, 10**20)
    taken = name if name not in {"goal", "out of time"} else "set 1"
    assert f"'few': 1 visits {taken!r} at most 0.5" in written.asked


def test_equal_costs_and_equal_sets_are_stated_once():
    """A cost that repeats the model's is cost 0; another one is a cost of its own."""
    again = {"road": {"fast": 1.0, "safe": 3.0}}
    rows = {
        "same": secondary_cost(again) <= 9.0, "other": secondary_cost(FUEL) <= 9.0,
        "twice": secondary_cost(FUEL) <= 8.0, "d": end_probability("ditch") <= 0.5,
        "e": end_probability("ditch") >= 0.0,
    }  # fmt: skip
    statement = Statement(MCMP(ROAD, "road", 1.0, constraints=rows))
    terms = [row["quantity"]["terms"] for row in statement.question["rows"]]
    assert terms == [[["1", "cost", k]] for k in (0, 1, 1)] + [[["1", "end", "ditch"]]] * 2
    assert statement.question["costs"] == len(statement.costs) == 2
    assert statement.question["sets"] == ["ditch"]
    line = json.loads(statement.states[ROAD.index_of("road")])
    paid = {name: costs for name, _, costs in line["actions"]}
    assert paid == {"fast": ["1", "4"], "safe": ["3", "1"]}


def test_numbers_are_their_shortest_decimals():
    for value, text in (
        (1.0, "1"), (0.1, "0.1"), (1e-9, "1e-09"), (Fraction(1, 3), "1/3"), (3, "3"),
        (-0.5, "-0.5"), (1e22, "1e+22"), (2.0**0.5, repr(2.0**0.5)),
    ):  # fmt: skip
        assert text_of(value) == text
        assert Fraction(text) == (value if isinstance(value, Fraction) else Fraction(repr(value)))


# Charges of the total in the file, whose steps end where they should.


@dataclass(frozen=True, eq=False)
class Arrivals(Formulation):
    """What arriving costs, given success."""

    model: SSP
    start: object
    quantity: Quantity
    failure_budget: float | None = 1.0
    ratio = True


def squares():
    """The square of a total up to 4, and its tangent from there on."""
    return arrival_cost(lambda c: np.where(c <= 4.0, c * c, 8.0 * c - 16.0), affine_from=4.0)


@pytest.mark.parametrize(("cost", "known"), [(1.0, 1), (3.0, 9), (4.0, 16), (4.5, 20), (5.0, 24)])
def test_a_charge_is_that_of_each_total(cost, known, tmp_path):
    """At the beginning of the tangent, too, where the last step costs nothing."""
    model = model_of({"x": {"go": [(1.0, "y", cost)]}, "y": {"in": [(1.0, "g", 0.0)]}})
    written = write_certificate(solve(Arrivals(model, "x", squares())), tmp_path / "x")
    assert written.lower <= known <= written.upper


@pytest.mark.parametrize("steps", [1, 3, 60])
def test_a_utility_that_is_not_used_up_has_as_many_steps_as_it_needs(steps, tmp_path):
    """exp(-c / 2) on a sure way of so many steps of 1: the totals go on until 1e-11 is left."""
    table = {k: {"on": [(1.0, k + 1 if k < steps else "g", 1.0)]} for k in range(1, steps + 1)}
    problem = EGUBS(model_of(table), 1, -0.5, 10.0)
    written = write_certificate(solve(problem), tmp_path / "x")
    known = Fraction(10.0 + np.exp(-0.5 * steps))
    assert abs(written.lower - known) < Fraction(1, 10**10)
    assert written.upper - written.lower < Fraction(1, 10**10)


# Caps, from which on totals are not distinguished.


@pytest.mark.parametrize(
    ("widths", "best"),
    [
        ([1e-3, 1e-11, 1e-20], 1), ([1e-3, 1e-5, 0.95e-5, 1e-7], 2), ([1e-3, 1e-5, 2e-5, 1e-7], 1),
        ([1e-3, 2e-3, 1e-7], 0), ([1e-11, 1e-20], 0), ([0.5**k for k in range(20)], 11),
    ],
)  # fmt: skip
def test_caps_rise_until_the_interval_is_narrow(widths, best, monkeypatch):
    """Up to 1e-10 of 1 + the optimum, while each is a tenth narrower; the narrowest is kept.

    The second cap is twice the first; from then on the rate of the width's fall, as of a geometric
    series, says how far the next one goes, at most fourfold.
    """
    caps, programs = [], iter(widths)
    solution = solve(S3P(ROAD, "road", 0.05))
    monkeypatch.setattr(files, "_first_cap", lambda *given: Fraction(3))
    program_of = files.program_of
    monkeypatch.setattr(
        files, "program_of", lambda asked, statement, cap: caps.append(cap) or program_of(
            asked, statement, cap)
    )  # fmt: skip

    def proof(nodes, members, prices):
        width = next(programs)
        return [b"proof %d" % (len(caps) - 1)], Bounds(Fraction(9), 9 + Fraction(10 * width), {})

    monkeypatch.setattr(files, "proof_of", proof)
    statement = Statement(solution.problem)
    asked = reading.stated(statement.question, "main", None, {})
    lines, bounds = files._best_proof(asked, statement, solution, "main")
    assert lines == [b"proof %d" % best]
    assert float(bounds.upper - 9) == pytest.approx(10 * widths[best])
    assert caps[:2] == [3, 6][: len(caps)]
    if len(caps) > 2:  # 1e-3 at 3, 1e-5 at 6: 1e-12 would be reached at 16.5
        assert caps[2] == (17 if widths[1] == 1e-5 else 24)
    assert all(one < other <= 4 * one + 1 for one, other in pairwise(caps))
    assert len(caps) <= 12


@pytest.mark.parametrize("problem", [MCMP(ROAD, "road", 0.05), S3P(ROAD, "road", 0.05)])
def test_a_charge_or_many_nodes_end_the_doubling(problem, monkeypatch):
    """Without a charge of the total there is no cap; a program of more nodes is not tried."""
    tried = []
    solution, proof_of = solve(problem), files.proof_of
    monkeypatch.setattr(files, "proof_of", lambda *given: tried.append(given) or proof_of(*given))
    monkeypatch.setattr(files, "_NARROW", -1.0)
    monkeypatch.setattr(files, "_MOST_NODES", 4)
    files.certificate_of(solution)
    assert len(tried) == 1


@pytest.mark.parametrize("problem", [S3P(ROAD, "road", 0.05), CostBoundedReach(ROAD, "road", 7.5),
                                     CostQuantile(ROAD, "road", 0.75, 0.05)])  # fmt: skip
def test_the_first_cap_reaches_the_steps_of_the_charge(problem):
    """Beyond the last step of the charge; twice the mean of a linear one; the policy's own cap."""
    solution = solve(problem)
    line, step = [">=", "0", "0", "1"], [">", "7.5", "0", "0"]
    twice = 2 * Fraction(str(solution.objective))
    for charge, least in (([], 0), ([line], twice), ([line, step], Fraction(17, 2))):
        cap = files._first_cap({"charge": charge}, solution, Fraction(1))
        assert cap.denominator == 1
        last = max((policy.cap * float(policy.unit) for policy in solution.policy.policies
                    if isinstance(policy, CostAwarePolicy)), default=0.0)  # fmt: skip
        assert cap == 0 if not charge else max(least, last) <= cap < max(least, last) + 2


# What is not written.


def test_what_is_no_certificate(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"none")
    told = check_certificate(path)
    assert told.reason == "this is not a certificate: ssp_lp.write_certificate writes one"
    assert check_certificate(3).reason.startswith("int is not a path of a file")
    with pytest.raises(FileNotFoundError):
        check_certificate(tmp_path / "missing")


def test_a_program_of_too_many_nodes_is_refused(tmp_path, monkeypatch):
    solution = solve(MCMP(ROAD, "road", 0.5, horizon=2_000))
    monkeypatch.setattr(files, "_MOST_NODES", 0)
    words = "no certificate file: the horizon is too far for so few lines"
    refused(words, write_certificate, solution, tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_a_proof_that_the_checker_refuses_is_not_written(tmp_path, monkeypatch):
    """The writer is not trusted: what it makes is checked by the script before it is written."""
    solution = solve(MCMP(ROAD, "road", 0.05))
    lines = files.certificate_of(solution)
    monkeypatch.setattr(files, "certificate_of", lambda solution: lines[:-1])
    refused("the answer is not proved: the file ends within a proof", write_certificate, solution,
            tmp_path / "x", error=SolverError)  # fmt: skip
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("size", [0.5, 100.0])
def test_the_tolerance_is_a_share_of_the_objective_or_of_1(size, tmp_path):
    """Of a sure step: claims that are off by less are accepted, by more refused, on each side."""
    model = model_of({"x": {"go": [(1.0, "g", size)]}})
    honest, room = solve(MCMP(model, "x", 0.5)), 1e-3 * max(1.0, size)
    for off in (0.9, 1.1, -0.9, -1.1):
        claimed = replace(honest, objective=size + off * room, lower_bound=size)
        bounded = replace(honest, lower_bound=size + off * room)
        for said in (claimed, bounded) if off > 0 else (claimed,):
            if abs(off) < 1:
                assert write_certificate(said, tmp_path / "x", tolerance=1e-3).lower == Fraction(
                    str(size)
                )
            else:
                refused("the answer is not proved|the policy's objective is", write_certificate,
                        said, tmp_path / "y", tolerance=1e-3, error=SolverError)  # fmt: skip
    assert not (tmp_path / "y").exists()


def test_policies_that_no_certificate_follows(tmp_path):
    """One that changes with time, and one that draws its actions."""
    honest = solve(MCMP(FIRST, "depot", 0.05))
    one, other = honest.policy.policies
    timed = TimedPolicy((one, other))
    drawing = StochasticPolicy.from_actions(FIRST, {"depot": {"alley": 0.5, "road": 0.5}})
    words = "remembers more than the total cost", "draws its actions"
    for policy, word in zip((timed, drawing), words, strict=True):
        forged = replace(honest, policy=MixedPolicy((policy,), np.ones(1)))
        refused(f"cannot be written for a policy that {word}", files.certificate_of, forged)


def test_the_digest_is_that_of_question_and_model(tmp_path):
    problem = MCMP(ROAD, "road", 0.05)
    assert write_certificate(solve(problem), tmp_path / "x").digest == sha256_of(problem)
    assert sha256_of(problem) != sha256_of(MCMP(ROAD, "road", 0.06))
