"""The paper's robot on three grids, built once, and compiled loops switched on and off."""

from __future__ import annotations

import pytest

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from ssp_lp import SSP
from ssp_lp.compiled import accelerator
from tests.support.compiled import Switch

collect_ignore_glob = ["campaigns/[!t]*", "*/conftest.py"]
"""Campaigns are run by hand, but for the samples in ``campaigns/test_campaigns.py``."""

NAME = 1000
"""Characters of a test's name at most: it is sent between processes with every result."""


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all but the first case of each test slow; refuse names that hold a test's data."""
    met = set[str]()
    for item in items:
        name = item.nodeid.partition("[")[0]
        if name in met:
            item.add_marker(pytest.mark.slow)
        met.add(name)
    if long := [item.nodeid[:100] for item in items if len(item.nodeid) > NAME]:
        raise pytest.UsageError(f"give these tests an id, their names are too long: {long}")


@pytest.fixture(scope="session")
def robot() -> tuple[SSP, int]:
    """The model of the default grid and its start state."""
    return _on(RobotGrid())


@pytest.fixture(scope="session")
def coarse_robot() -> tuple[SSP, int]:
    """The same on a coarse grid."""
    return _on(RobotGrid(segments=8, headings=8))


@pytest.fixture(scope="session")
def small_robot() -> tuple[SSP, int]:
    """A grid whose accumulated-cost process a linear program can still take."""
    return _on(RobotGrid(segments=6, headings=6, quadrature=2))


def _on(grid: RobotGrid) -> tuple[SSP, int]:
    return grid_model(grid), start_state(grid)


@pytest.fixture
def accelerate(monkeypatch: pytest.MonkeyPatch) -> Switch:
    """Run every loop compiled, or none."""

    def switch(on: bool) -> None:
        monkeypatch.setenv(accelerator.SWITCH, "numba" if on else "none")

    return switch
