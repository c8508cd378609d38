"""The paper's robot, built once for all tests that need it."""

from __future__ import annotations

import pytest

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from ssp_lp import SSP


@pytest.fixture(scope="session")
def robot() -> tuple[SSP, int]:
    """The model of the default grid and its start state."""
    grid = RobotGrid()
    return grid_model(grid), start_state(grid)
