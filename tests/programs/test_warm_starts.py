"""Programs solved from the optimum at other bounds or starts: the same answers, sooner."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from test_programs import DEPOT
from test_stated_programs import TURNS, drawn

from examples.domains.river import river
from formulations import MCMP, S3P, MaxProb
from ssp_lp import InfeasibleError, solve, visits
from ssp_lp.linear_programming import highs
from ssp_lp.programs.occupation_program import OccupationProgram

SHARES = (0.5, 0.05, 0.9, 0.2, 0.21)


def steps_of(program: OccupationProgram, basis: np.ndarray | None) -> int:
    """Iterations of HiGHS's simplex, to the optimum."""
    solved = program if program.reduced is None else program.reduced.program
    solver = highs._solved_by_highs(solved.linear, "highs-simplex", np.inf, basis)
    assert solver.modelStatusToString(solver.getModelStatus()) == "Optimal"
    return int(solver.getInfo().simplex_iteration_count)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("seed", range(20))
def test_the_optimum_is_that_of_a_program_that_begins_anew(seed: int, criterion: type) -> None:
    model, cap = drawn(seed), {"cost_cap": 12.0} if criterion is S3P else {}
    least = solve(MaxProb(model, "a")).failure_probability
    if least >= 1.0:
        return
    rows = {"seen": visits("a") <= 5.0}
    program = criterion(model, "a", 1.0, constraints=rows, **cap).program()
    warm, points = None, []
    for share in SHARES:
        within = program.bounded_by({"failure": least + share * (1.0 - least)})
        try:
            cold = within.solve()
        except InfeasibleError:
            with pytest.raises(InfeasibleError):
                within.solve(warm_start=warm)
            continue
        warm = within.solve(warm_start=warm)
        assert warm.objective == pytest.approx(cold.objective, rel=1e-9, abs=1e-9)
        assert warm.gap <= 1e-9
        assert warm.residual <= 1e-9
        points.append((within.row("failure").bound, cold.objective, warm.duals["failure"]))
    if criterion is MCMP:  # at kinks one of several duals: a subgradient of the frontier
        for bound, value, dual in points:
            for other, beside, _ in points:
                assert beside >= value - dual * (other - bound) - 1e-7 * (1.0 + abs(value))


def test_a_sweep_takes_a_tenth_of_the_steps() -> None:
    model, start = river(30, 30, current=0.2)
    program = MCMP(model, start, 0.9, give_up="dead_ends").program()
    budgets = np.linspace(0.8, 0.1, 20)
    warm, anew, saved = program.solve(), 0, 0
    assert warm.solver == "highs-ipx"  # whose crossover ends at a basis, too
    for budget in budgets:
        within = program.bounded_by({"failure": float(budget)})
        anew, saved = anew + steps_of(within, None), saved + steps_of(within, warm.basis)
        warm = within.solve(warm_start=warm)
        assert warm.solver == "highs-simplex"
    assert saved <= anew / 10.0


def test_starts_and_costs_change_and_the_basis_stays() -> None:
    model = drawn(3)
    program = MCMP(model, "a", 0.9).program()
    warm = program.solve("highs-simplex")
    for start in ("b", {"b": 0.5, "d": 0.5}, "a"):
        other = program.started(start)
        warm = other.solve(warm_start=warm)
        assert warm.objective == pytest.approx(other.solve().objective, rel=1e-9, abs=1e-9)
    dear = MCMP(replace(model, costs=model.costs + 1.0), "a", 0.9).program()
    found = dear.solve(warm_start=warm)
    assert found.objective == pytest.approx(dear.solve().objective, rel=1e-9, abs=1e-9)


def test_what_is_no_basis_of_the_program_is_left() -> None:
    """Other shapes, other solvers' answers, and any nonsense: the answer is the same."""
    program, rng = MCMP(TURNS, "s", 0.1).program(), np.random.default_rng(7)
    known, beside = program.solve(), MCMP(DEPOT, "depot", 0.05).program().solve()
    assert known.basis is not None
    for basis in (
        None,
        beside.basis,
        np.zeros_like(known.basis),
        np.ones_like(known.basis),
        *(rng.permutation(known.basis) for _ in range(20)),
    ):
        found = program.solve(warm_start=replace(known, basis=basis))
        assert found.objective == pytest.approx(known.objective, rel=1e-9)
        assert found.gap <= 1e-9
    inner = program.solve("clarabel")
    assert inner.basis is None
    assert program.solve("clarabel", warm_start=known).solver == "clarabel"
    told = S3P(TURNS, "s", 0.1).program()
    assert told.solve(warm_start=known).objective == pytest.approx(told.solve().objective)


def test_bounds_that_contradict_are_told_from_a_basis_too() -> None:
    program = MCMP(TURNS, "s", 0.3, constraints={"seldom": visits("s") <= 9.0}).program()
    warm = pickle.loads(pickle.dumps(program.solve()))  # noqa: S301
    with pytest.raises(InfeasibleError):
        program.bounded_by({"failure": 1e-6}).solve(warm_start=warm)
    again = program.bounded_by({"failure": 0.2})
    assert again.solve(warm_start=warm).objective == pytest.approx(again.solve().objective)
