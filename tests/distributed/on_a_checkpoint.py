"""A search that a rank's death ends, and another that goes on from its checkpoint: for mpiexec.

Its arguments are the checkpoint's file and "dies", "interrupted" or "resumes".
"""

import os
import signal
import sys

import pytest
from mpi4py import MPI
from on_partitioned_models import partitioned

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from formulations import MCMP
from ssp_lp import ModelError, solve, visits

COMM = MPI.COMM_WORLD
GRID = RobotGrid(segments=12, headings=8)
FEW = {"walls": visits("wall") <= 0.05}


def dies_after(calls, by):
    """What is called after each pricing call: the last rank gets a signal after so many."""
    last = COMM.allgather(os.getpid())[-1]

    def progress(done, *_):
        """Have it killed, as by a system that lacks memory, or interrupted."""
        if done >= calls:
            os.kill(last, by)

    return progress


if __name__ == "__main__":
    path, doing = sys.argv[1:]
    model = grid_model(GRID)
    made, start = partitioned(model), start_state(GRID)
    asked = {"start": start, "failure_budget": 0.5, "give_up": "dead_ends", "constraints": FEW}
    if doing != "resumes":
        by = signal.SIGKILL if doing == "dies" else signal.SIGINT
        made.solve(MCMP, **asked, checkpoint=path, progress=dies_after(3, by))
        sys.exit("nobody died")
    known = solve(MCMP(model, **asked))
    afresh = made.solve(MCMP, **asked)
    resumed = made.solve(MCMP, **asked, checkpoint=path)
    for answer in (afresh, resumed):
        assert answer.objective == pytest.approx(known.objective, rel=1e-9)
        assert answer.gap <= 1e-9
    assert resumed.run.work.backups < afresh.run.work.backups
    again = made.solve(MCMP, **asked, checkpoint=path)
    assert again.objective == pytest.approx(known.objective, rel=1e-9)
    with pytest.raises(ModelError, match=r"the checkpoint .* is of MCMP"):
        made.solve(MCMP, start=start, failure_budget=0.4, checkpoint=path)
    if COMM.gather(True) is not None:
        print(f"{COMM.size} ranks: well")
