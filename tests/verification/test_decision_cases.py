"""Trees of cases: whichever way decisions are told apart, no more is proved than the optimum."""

import json
from fractions import Fraction

import numpy as np
import pytest

from formulations import MCMP
from mazes import MAZE
from references.stated import optimum
from small_models import model_of
from ssp_lp import solve
from ssp_lp.verification import checker
from ssp_lp.verification.certificate_file import Statement
from ssp_lp.verification.decision_cases import cases_of_decisions
from ssp_lp.verification.exact_values import proved_bound, values_below
from ssp_lp.verification.lottery import graph_of

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
PROBLEMS = [
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


@pytest.mark.parametrize("problem", PROBLEMS, ids=range(len(PROBLEMS)))
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


@pytest.mark.parametrize("problem", PROBLEMS, ids=range(len(PROBLEMS)))
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
