"""How a large process begins: with a guess at its cap, which is no policy, and a bound at hand."""

from __future__ import annotations

from fractions import Fraction

import pytest

from examples.domains.navigation import navigation
from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from formulations import MCMP, S3P
from small_models import model_of
from ssp_lp import SSP, certify, solve
from ssp_lp.accumulated_cost.sweep import PartOfSweep, Sweep
from ssp_lp.column_generation import compiled_problem as module
from ssp_lp.column_generation.column import FailureRow, required
from ssp_lp.column_generation.search import _initial_column_within
from ssp_lp.compiled.deadline import Stop
from tests.support.compiled import Switch

pytest.importorskip("numba")


@pytest.fixture
def guessing(monkeypatch: pytest.MonkeyPatch, accelerate: Switch) -> None:
    """Begin as with a large process."""
    monkeypatch.setattr(module, "_LARGE", 0)
    monkeypatch.setattr(Sweep, "one_pass", None)
    accelerate(True)


def _problems() -> list[S3P]:
    grid, (model, start) = RobotGrid(segments=8, headings=8), navigation(6, 5)
    robot = S3P(grid_model(grid), start_state(grid), 0.3)
    return [S3P(model, start, 0.9), S3P(model, start, 0.6), robot]


def test_a_guess_leads_to_the_same_optimum(request: pytest.FixtureRequest) -> None:
    before = [solve(problem) for problem in _problems()]
    request.getfixturevalue("guessing")
    for problem, known in zip(_problems(), before, strict=True):
        compiled = problem.compile()
        assert compiled.pricing().first().policy is None
        found = solve(problem)
        assert found.objective == pytest.approx(known.objective, rel=1e-12)
        assert found.gap <= 1e-9
        certificate = certify(found)
        assert certificate.accepted
        assert certificate.gap <= 1e-9


@pytest.mark.usefixtures("guessing")
@pytest.mark.parametrize("budget", [0.6, 0.9])
def test_a_guess_is_no_policy_to_stop_with(budget: float) -> None:
    """What half a sweep found is taken, though the guess would seem to keep to the budget."""
    model, start = navigation(6, 5)
    pricing = S3P(model, start, 0.9).compile().pricing()
    guess, half = pricing.first(), pricing.minimise(100.0)
    row, swept = FailureRow(budget, ratio=True), required(half.choice)
    part = PartOfSweep(swept, 100.0, 0, None)  # all layers, as it happens
    found = _initial_column_within(pricing, row, Stop(part), guess)
    assert (found.cost, found.failure, found.goal) == (half.cost, half.failure, half.goal)
    assert found.policy is not None


@pytest.mark.parametrize("cost", [1.0, 0.7, Fraction(1, 3)])
def test_the_fewest_steps_are_a_bound(cost: float | Fraction) -> None:
    """Met where the way is sure, else below the optimum."""
    line = {k: {"go": [(1.0, k + 1, cost)]} for k in range(4)}
    sure = S3P(SSP.from_transitions(line, goal={4}), 0, 0.5)
    assert sure.compile().lowest == pytest.approx(4 * float(cost), rel=1e-14)
    assert solve(sure).lower_bound <= solve(sure).objective
    for k in range(4):  # it may wait, for another cost, or fall
        line[k] = {"go": [(0.6, k + 1, cost), (0.2, k, 2 * cost), (0.2, "pit", cost)]}
    line["pit"] = {}
    model = SSP.from_transitions(line, goal={4}, treat_actionless_as_dead_ends=True)
    problem = S3P(model, {0: 0.5, 1: 0.5}, 0.95)
    lowest = problem.compile().lowest
    assert lowest == pytest.approx(3 * float(cost), rel=1e-14)
    assert lowest < solve(problem).objective


def test_a_start_at_the_goal_costs_nothing() -> None:
    model = SSP.from_transitions({0: {"go": [(1.0, "g", 1.0)]}}, goal={"g"})
    assert S3P(model, {0: 0.5, "g": 0.5}, 0.5).compile().lowest == 0.0
    assert S3P(model, {0: 0.5, "g": 0.5}, 0.5, discount=0.9).compile().lowest == 0.0


def test_a_first_policy_that_never_arrives_starts_the_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Dashing is nearest to the goal and arrives with 1e-400; who walks pays 800."""
    length, budget = 400, 0.3
    way: dict[object, object] = {}
    for k in range(length):
        on = k + 1 if k + 1 < length else "goal"
        way[k] = {"dash": [(0.1, on, 1.0), (0.9, "pit", 1.0)], "walk": [(1.0, f"by {k}", 1.0)]}
        way[f"by {k}"] = {"on": [(1.0, on, 1.0)]}
    model = model_of({**way, "pit": {}}, "goal")

    def never(*_: object) -> None:
        raise AssertionError("the least failure is not needed")

    monkeypatch.setattr("ssp_lp.methods.columns.checked_least_failure", never)
    problem = MCMP(model, 0, budget, give_up="anywhere", charge_failing_step=False)
    assert solve(problem).objective == pytest.approx((1.0 - budget) * 2.0 * length, rel=1e-9)
