"""Models of every structure: certified, the same compiled or not, and what is known of them."""

from __future__ import annotations

import numpy as np
import pytest

from examples.solver_comparison.instances.families import FAMILIES, grid
from formulations import MCMP, S3P, ConstrainedCost, FinitePenalty, MaxProb
from small_models import model_of
from ssp_lp import SSP, SolverError, certify, evaluate, solve
from ssp_lp.column_generation.column import least_of
from ssp_lp.compiled import accelerator
from ssp_lp.formulation import CostLimit
from tests.support.compiled import Switch

SIZES = {
    "layered": (30, 20), "scattered": (1_500,), "grid": (40,), "river": (20, 60),
    "corridor": (1_500,), "rooms": (15, 10), "ring": (1_500,),
    "holes": (40,), "headings": (14,), "racetrack": (7,), "tandem": (30,), "inventory": (20, 20),
    "sysadmin": (8,), "factored": (9,), "blocks": (4,),
}  # fmt: skip
GAP = 1e-9


@pytest.mark.parametrize("family", FAMILIES)
def test_every_structure_is_solved_to_proof(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At least failure and within a budget, with compiled loops and with numpy."""
    pytest.importorskip("numba")
    model = FAMILIES[family](*SIZES[family])
    least = 1.0 - solve(MaxProb(model, 0)).objective
    for budget in (None, min(2.0 * least + 0.01, 1.0)):
        found = []
        for least_entries in (0, 1 << 62):
            monkeypatch.setattr(accelerator, "least_entries", lambda n=least_entries: n)
            solution = solve(MCMP(model, 0, budget, give_up="dead_ends"))
            proof = certify(solution)
            assert proof.accepted, proof.reason
            assert max(solution.gap, proof.gap) <= GAP
            assert (
                0.0 <= solution.failure_probability <= (1.0 if budget is None else budget) + 1e-12
            )
            found.append(solution.objective)
        assert found[0] == pytest.approx(found[1], rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("side", [20, 60])
def test_windy_grids_agree_with_the_full_program(seed: int, side: int) -> None:
    """The grids on which rough evaluations used to adopt policies that never leave."""
    rng = np.random.default_rng(seed)
    model = grid(side)
    budget = float(rng.uniform(0.01, 0.1))
    give_up = ("anywhere", "attention", "dead_ends")[seed % 3]
    solution = solve(MCMP(model, 0, budget, give_up=give_up))
    assert certify(solution).accepted
    assert solution.gap <= GAP
    if side == 20:
        program = solve(MCMP(model, 0, budget, give_up=give_up), method="lp")
        assert program.objective == pytest.approx(solution.objective, rel=1e-6)


@pytest.mark.parametrize("cells", [3, 200, 3_000])
def test_a_corridor_takes_as_long_as_the_closed_form_says(cells: int) -> None:
    """A walk with drift d that is reflected at 0: n / d - (q / d^2) (1 - (q / p)^n) steps."""
    drift = 0.02
    up, down = 0.5 + drift / 2, 0.5 - drift / 2
    model = model_of(
        {
            cell: {"walk": [(up, cell + 1, 1.0), (down, max(cell - 1, 0), 1.0)]}
            for cell in range(cells)
        },
        cells,
    )
    steps = cells / drift - (down / drift**2) * (1 - (down / up) ** cells)
    solution = solve(MCMP(model, 0))
    assert solution.objective == pytest.approx(steps, rel=1e-10)
    assert solution.failure_probability == 0.0


@pytest.mark.parametrize("power", range(3, 13))
def test_a_sure_action_beats_a_loop_that_is_hardly_left(power: int) -> None:
    """At least failure both are sure; walking costs 1, trying again 1e5 times what it seems."""
    p = 10.0**-power
    q = p / 3
    model = model_of(
        {
            "reset": {"go": [(1 - q, "try", 0.1), (q, "home", 1.0)]},
            "try": {
                "again": [(1 - p, "reset", 0.3), (p, "home", 1.0)],
                "walk": [(1.0, "home", 1.0)],
            },
        },
        "home",
    )
    for criterion in (MCMP, S3P):
        solution = solve(criterion(model, "try"))
        assert solution.objective == 1.0
        assert certify(solution).lower_bound == pytest.approx(1.0, abs=1e-12)
        assert solution.goal_probability == 1.0
        assert solution.failure_probability == 0.0


@pytest.mark.parametrize("power", range(3, 13))
def test_the_better_exit_of_a_slow_loop_is_told(power: int) -> None:
    """Exits of 9 : 1 and 8 : 2, differing by 1e-13 a step: closed form of the better loop."""
    p = 10.0**-power
    q = p / 3
    model = model_of(
        {
            "a": {
                "good": [(1 - q, "b", 0.1), (0.9 * q, "home", 1.0), (0.1 * q, "lost", 0.0)],
                "poor": [(1 - q, "b", 0.2), (0.8 * q, "home", 1.0), (0.2 * q, "lost", 0.0)],
            },
            "b": {
                "again": [(1 - p, "a", 0.3), (0.7 * p, "home", 1.0), (0.3 * p, "lost", 0.0)],
                "leave": [(0.5, "home", 1.0), (0.5, "lost", 0.0)],
            },
            "lost": {},
        },
        "home",
    )
    solution = solve(MaxProb(model, "a"))
    round_trip = q + (1 - q) * p
    assert solution.objective == pytest.approx(
        (0.9 * q + (1 - q) * 0.7 * p) / round_trip, rel=1e-12
    )
    assert solution.objective <= 1.0
    tight = solve(MCMP(model, "a", 0.3))
    assert tight.gap <= GAP
    assert certify(tight).accepted


def test_a_failure_of_one_in_a_trillion_is_not_one_minus_something() -> None:
    model = model_of({"x": {"go": [(1 - 1e-12, "g", 1.0), (1e-12, "d", 0.0)]}, "d": {}})
    solution = solve(FinitePenalty(model, "x", 1e6))
    assert solution.failure_probability == pytest.approx(1e-12, rel=1e-14)
    assert certify(solution).failure == pytest.approx(1e-12, rel=1e-14)


def test_a_state_out_of_reach_does_not_spoil_the_program() -> None:
    """One that hardly leaves its own loop: the full program of a problem of one step."""
    model = SSP.from_transitions(
        {"x": {"go": [(1.0, "g", 1.0)]}, "u": {"loop": [(1 - 1e-9, "u", 1.0), (1e-9, "g", 1.0)]}},
        goal={"g"},
    )
    assert solve(MCMP(model, "x", 0.5), method="lp").objective == pytest.approx(1.0)


def test_limits_that_two_policies_meet_to_the_ninth_digit() -> None:
    """HiGHS takes the master's rows to contradict each other; one policy keeps to them."""
    model = model_of(
        {
            "a": {"go": [(1.0, "b", 0.0)]},
            "b": {
                "dear": [(1 - 1e-11, "c", 0.0), (1e-11, "goal", 0.0)],
                "fair": [(1.0, "c", 0.0)],
            },
            "c": {"stay": [(1 - 1e-9, "c", 1.0), (1e-9, "goal", 1.0)]},
        },
        "goal",
    )
    spent = {"b": {"dear": 2.0, "fair": 1.0}, "c": {"stay": 1.0}}
    limits = {"fuel": CostLimit(spent, 1000000001.4949999)}
    solution = solve(ConstrainedCost(model, "a", limits=limits))
    assert solution.objective == pytest.approx(999999999.995, rel=1e-12)


def test_an_idle_limit_costs_no_accuracy() -> None:
    model = model_of(
        {
            "s": {
                "slip": [(1 - 6.7e-6, "t", 2.0), (6.7e-6, "s", 2.0)],
                "step": [(1.0, "t", 2.0)],
                "wait": [(1.0, "s", 0.0)],
            },
            "t": {"try": [(1 - 1.6e-8, "s", 1.0), (1.6e-8, "goal", 1.0)]},
        },
        "goal",
    )
    idle = {
        "fuel": CostLimit({"s": {"slip": 0.0, "step": 0.0, "wait": 0.0}, "t": {"try": 0.0}}, 0.0)
    }
    plain = solve(MCMP(model, "s", 0.5))
    limited = solve(ConstrainedCost(model, "s", failure_budget=0.5, limits=idle))
    assert limited.objective == pytest.approx(plain.objective, rel=1e-12)
    assert limited.gap <= GAP


def test_a_bound_above_a_value_is_a_contradiction() -> None:
    assert least_of(1.0 + 1e-12, 1.0) == 1.0
    with pytest.raises(SolverError, match="lies below a bound"):
        least_of(2.0, 1.0)


def test_goal_and_failure_are_each_summed_from_their_own_exits() -> None:
    model = grid(30)
    solution = solve(MCMP(model, 0, 0.05))
    found = evaluate(solution.policy, solution.problem)
    assert found.goal_probability + found.failure_probability == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("seldom", "better"), [(2e-4, 1e-10), (1e-3, 1e-11), (1e-4, 1e-10)])
def test_a_pair_that_is_better_by_a_ten_billionth_is_the_only_one(
    seldom: float, better: float, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a loop of two states: the dearer exit succeeds more often, and is all that may be used."""
    pytest.importorskip("numba")
    monkeypatch.setattr(accelerator, "least_entries", lambda: 0 if compiled else 1 << 62)
    q, h = seldom, 0.5 + better
    model = model_of(
        {
            "a": {
                "cheap": [(1 - q, "b", 1.0), (q * 0.5, "g", 1.0), (q * 0.5, "d", 1.0)],
                "dear": [(1 - q, "b", 2.0), (q * h, "g", 2.0), (q * (1 - h), "d", 2.0)],
            },
            "b": {"on": [(1.0, "a", 0.0)]},
            "d": {},
        }
    )
    assert solve(MaxProb(model, "a")).objective == pytest.approx(h, rel=1e-13)
    for criterion in (MCMP, S3P):
        assert solve(criterion(model, "a")).objective == pytest.approx(2.0 / q, rel=1e-10)


def test_a_loop_that_only_pays_in_the_end_is_taken() -> None:
    """Its advantage is 1e-18 a step; from where the policy stands no run is longer than 3 steps."""
    risk, leave = 2.84e-7, 1.27e-11
    model = model_of(
        {
            "a": {"go": [(1.0, "b", 1.0)]},
            "b": {
                "hurry": [(1 - risk, "c", 1.0), (risk, "d", 1.0)],
                "wait": [(1 - leave, "a", 1.0), (leave, "c", 1.0)],
            },
            "c": {"end": [(0.45, "g", 1.0), (0.55, "d", 1.0)]},
            "d": {},
        }
    )
    solution = solve(MaxProb(model, "a"))
    assert solution.objective == pytest.approx(0.45, rel=1e-12)
    assert solution.gap <= GAP
    assert solve(MCMP(model, "a")).objective == pytest.approx(2.0 / leave + 1.0, rel=1e-9)


@pytest.mark.parametrize("compiled", [False, True])
def test_who_gains_nothing_by_giving_up_goes_on(
    compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba")
    monkeypatch.setattr(accelerator, "least_entries", lambda: 0 if compiled else 1 << 62)
    model = SSP.from_transitions({"a": {"go": [(1.0, "g", 0.0)]}}, goal={"g"})
    assert solve(MCMP(model, "a", 1.0, give_up="anywhere")).failure_probability == 0.0


WAITING = {
    "a": {"on": [(1.0, "b", 1.0)], "wait": [(1.0, "a", 1.0)]},
    "b": {"on": [(1.0, "g", 1.0)], "back": [(1.0, "a", 1.0)]},
    "c": {"on": [(1.0, "a", 1.0)], "wait": [(1.0, "c", 0.0)]},
}
ROUND = {
    "a": {
        "go": [(0.5, "b", 0.0), (0.5, "g", 1.0)],
        "pit": [(1.0, "p", 0.0)],
        "dear": [(1.0, "g", 3.0)],
    },
    "b": {"go": [(0.5, "a", 0.0), (0.25, "g", 2.0), (0.25, "p", 1.0)]},
    "p": {},
}


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize(
    ("table", "gamma", "best"), [(WAITING, 0.9, 2.0 / 0.9), (ROUND, None, 1.2)]
)
def test_free_steps_that_go_round_keep_the_bound(
    table: dict, gamma: float | None, best: float, fast: bool, accelerate: Switch
) -> None:
    """Nothing is taken off where giving up is worth nothing exactly, at a budget of 1, too."""
    accelerate(fast)
    for budget in (1.0, 0.9):
        solution = solve(S3P(model_of(table), "a", budget, discount=gamma))
        assert solution.objective == pytest.approx(best, rel=1e-9)
        assert max(solution.gap, certify(solution).gap) <= 1e-8
