"""Examples on PETSc's ranks: the corridor's closed form; where there is PETSc, local answers."""

import re
import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from examples.distributed import scaling
from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from formulations import MCMP
from ssp_lp import SSP, solve

ROOT = Path(__file__).parents[2]
MISSING = [name for name in ("petsc4py", "mpi4py") if find_spec(name) is None]
MISSING += [] if shutil.which("mpiexec") else ["mpiexec"]
with_petsc = pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")


def test_who_never_runs_walks_the_corridor_at_three_quarters_of_a_cell_a_step():
    rows, n_states, start = scaling.corridor(8)
    every = rows(0, n_states)
    model = SSP.from_arrays(
        pair_offsets=np.append(0, np.cumsum(every.actions)),
        outcome_offsets=np.append(0, np.cumsum(every.outcomes)),
        successors=every.successors,
        probabilities=every.probabilities,
        costs=every.costs,
        goal_states=[n_states - 2],
        treat_actionless_as_dead_ends=True,
    )
    careful, rash = (solve(MCMP(model, start, budget)) for budget in (0.0, 0.2))
    assert careful.objective == pytest.approx(scaling.LENGTH / 0.75, rel=1e-12)
    assert careful.budget_used == 0.0
    assert rash.objective < careful.objective


@with_petsc
def test_the_robot_on_ranks_costs_what_it_does_on_one_process(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    script = str(ROOT / "examples/distributed/robot_on_ranks.py")
    asked = ["--segments", "7", "--headings", "6", "--budget", "0.9"]
    printed = scaling.said(script, *asked, ranks=2)
    grid = RobotGrid(segments=7, headings=6)
    known = solve(MCMP(grid_model(grid), start_state(grid), 0.9))
    (cost,) = re.findall(r"^cost ([\d.]+), certified", printed, re.MULTILINE)
    assert float(cost) == pytest.approx(known.objective, abs=1e-8)
    (again, failure) = re.findall(r"evaluated anew: cost ([\d.]+), failure ([\d.]+)", printed)[0]
    assert float(again) == pytest.approx(known.objective, abs=1e-8)
    assert float(failure) == pytest.approx(0.9, abs=1e-6)
    states = re.findall(r"^rank (\d): states ([\d,]+) \.\. ([\d,]+),", printed, re.MULTILINE)
    assert [int(rank) for rank, *_ in states] == [0, 1]
    assert (states[0][1], states[1][2]) == ("0", "296")


@with_petsc
def test_the_scaling_table_has_a_line_for_each_kind_of_process(capsys, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    asked = ["--robots", "6x4", "--budget", "0.9", "--discounts", "0.99"]
    scaling.main([*asked, "--ranks", "2", "--weak", "200"])
    printed = capsys.readouterr().out
    assert re.findall(r"^(\S.*?)  ", printed, re.MULTILINE) == [
        "local, 1 thread", "2 ranks", "2 ranks"
    ]  # fmt: skip
    differ = re.findall(r"(\S+) \((?:objective|price|failure)\)", printed)
    assert len(differ) == 3
    assert max(map(float, differ)) <= 1e-9
