"""The paper's robot with the length of its way and its turns as costs: totals without a unit."""

import pytest

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from examples.paper_robot.true_costs import BUDGET, TOLERANCE, designed, main
from formulations import S3P
from ssp_lp import solve


@pytest.mark.parametrize("turning_cost", [0.0, 0.05])
def test_true_costs_are_proved_and_played_inside_their_intervals(turning_cost):
    grid = RobotGrid(
        segments=12, headings=12, quadrature=2, along_segment=True, turning_cost=turning_cost
    )
    found = designed(grid, episodes=20_000, seed=1)
    assert found.certificate.accepted
    assert found.certificate.gap <= TOLERANCE
    assert found.certificate.objective == pytest.approx(found.solution.objective, rel=1e-9)
    cost, failure = found.chain.conditional_cost, found.chain.failure_probability
    assert cost.low <= found.solution.objective <= cost.high
    assert failure.low <= BUDGET <= failure.high


def test_sums_are_told_apart_on_the_whole_grid_of_the_paper():
    """Some 1,200 sums on 4,800 cells; a table cut short of them proves nothing."""
    grid = RobotGrid(along_segment=True, turning_cost=0.2)
    solution = solve(
        S3P(grid_model(grid), start=start_state(grid), failure_budget=BUDGET), tolerance=TOLERANCE
    )
    assert solution.gap <= TOLERANCE
    assert solution.objective == pytest.approx(3.2077, abs=4e-4)


def test_the_script_prints_a_line_for_a_price_and_draws(tmp_path, capsys):
    asked = ["--episodes", "500", "--segments", "12", "--turning-costs", "0"]
    main([*asked, "--output", str(tmp_path)])
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["turning_cost_0.png"]
