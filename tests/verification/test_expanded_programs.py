"""The columns that a file's question expands to, beside the library's own program."""

from __future__ import annotations

import json
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import linprog

from cases import published
from forged import COST, DEAD, GOAL, SPENT, lines_stating, state
from formulations import MCMP, S3P, MaxProb
from ssp_lp import solve
from ssp_lp.verification import certificate_lines
from ssp_lp.verification.certificate_file import Statement, program_of
from ssp_lp.verification.expand import Program

MODELS = ["gubs_river4x4", "gubs_river-alt1", "gubs_tireworld1", "prism_attacktree",
          "prism_mdp_simple_t1", "prism_robot_goal1", "prism_robot_goal2", "qcomp_cdrive.2",
          "qcomp_cdrive.3", "qcomp_triangle-tireworld.9"]  # fmt: skip


def optimum(problem, cap=0):
    """The optimum of the expanded program, solved by scipy; a ratio by scaling its goal to 1."""
    statement = Statement(problem)
    asked = certificate_lines.stated(statement.question, "main", None, {})
    program = program_of(asked, statement, Fraction(cap))
    columns = list(program.columns())
    entries = [(column.node, j, 1.0) for j, column in enumerate(columns)]
    entries += [(i, j, -a / one.total) for j, one in enumerate(columns) for a, i in one.moves]
    at, place, values = zip(*entries, strict=True)
    balance = sp.coo_array((values, (at, place)), shape=(program.size, len(columns))).tocsr()
    counts = np.array([list(map(float, column.counts)) for column in columns]).T
    bounds = np.array([float(row.most) for row in program.rows])
    right = np.eye(1, program.size)[0]
    objective, rows = counts[0], counts[1:]
    if problem.ratio:
        objective, rows = np.append(objective, 0.0), np.column_stack([rows, -bounds])
        balance = sp.vstack([
            sp.hstack([balance, sp.coo_array(-right[:, None])]),
            sp.coo_array(np.append(-counts[1], 1.0)[None, :]),
        ]).tocsr()  # fmt: skip
        right, bounds = np.append(0.0 * right, 1.0), 0.0 * bounds
    found = linprog(objective, rows, bounds, balance, right, method="highs")
    assert found.status == 0
    return program.sign * (found.fun + float(program.objective.constant))


@pytest.mark.parametrize("name", MODELS)
def test_the_optimum_is_that_of_the_librarys_program(name):
    model, start = published(name)
    most = solve(MaxProb(model, start)).objective
    budget = 1.0 - 0.9 * most
    asked = [MaxProb(model, start), MCMP(model, start, 1.0, discount=0.95)]
    asked += [
        MCMP(model, start, budget, give_up=give_up, charge_failing_step=charged)
        for give_up in ("anywhere", "attention", "dead_ends") for charged in (True, False)
    ]  # fmt: skip
    for problem in asked:
        known = solve(problem, "lp").objective
        assert optimum(problem) == pytest.approx(known, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("name", ["gubs_tireworld1", "prism_robot_goal1", "qcomp_cdrive.2"])
def test_totals_of_case_s_are_those_of_the_librarys_process(name):
    """From a cap on which the library's is lossless, the relaxation beyond the cap is tight."""
    model, start = published(name)
    budget = 1.0 - 0.9 * solve(MaxProb(model, start)).objective
    problem = S3P(model, start, budget)
    known = solve(problem).objective
    assert optimum(problem, cap=60) == pytest.approx(known, rel=1e-6)


@pytest.mark.parametrize(
    ("asked", "ends", "beyond"),
    [
        ({}, ["wait"], ["wait"]),
        ({"objective": COST}, [], ["wait"]),
        ({"discount": "1/2"}, [], ["wait"]),
        ({"objective": COST, "give_up": "attention"}, ["give up"], ["give up"]),
        ({"give_up": "attention"}, ["give up", "wait"], ["give up", "wait"]),
        ({"failure": "0"}, [], []),
    ],
)
def test_the_columns_of_a_node_are_those_of_the_page(asked, ends, beyond):
    """Of a way, a loop of cost 1 where visits weigh nothing, the goal, and a dead-end's loop."""
    way = state(on=([["1", 1], ["1", 2]], ["1"]))
    risk = [["1", 2], ["1", 3]], ["2"]
    loop = state(on=([["1", 2]], ["1"]), stay=([["1", 1]], ["1"]), risk=risk) | {"sets": ["s"]}
    states = [way, loop, GOAL, {**DEAD, "actions": [["stay", [["1", 3]], ["1"]]]}]
    nothing = {"constant": "0", "terms": [["0", "visits", "s"]]}
    row = {"name": "n", "quantity": nothing, "at_most": "0"}
    asked = {"objective": nothing, "ratio": True, "charge": SPENT, "rows": [row],
             "charge_failing_step": True, "failure": None, **asked}  # fmt: skip
    question, *lines = lines_stating(states, sets=["s"], **asked)
    question = json.loads(question)
    told = [certificate_lines.read_state(line, question) for line in lines[:4]]
    program = Program(certificate_lines.stated(question, "main", None, {}), lambda: told, "0", 4)
    columns = {(column.node, column.name): column.counts for column in program.columns()}
    acts = ["on", "stay", "risk"][: 2 if asked["failure"] else 3]
    known = {0: ["begin"], 1: ["on"], 2: [*acts, *ends], 5: ["on"], 6: [*acts, *beyond]}
    assert list(columns) == [(i, name) for i, some in known.items() for name in some]
    paid = asked["objective"] is COST  # what failing charges, where one gives up
    assert all(columns[2, name] == (paid * (name == "give up"), 1, 0) for name in ends)
    assert all(not any(columns[6, name]) for name in beyond)
