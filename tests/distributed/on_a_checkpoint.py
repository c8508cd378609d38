"""A search that a rank's death ends, another that goes on from its checkpoint, and saved policies.

For mpiexec. Its arguments are a folder, and "dies", "interrupted", "resumes", "saves" or "reads".
"""

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from formulations import MCMP
from partitioned import partitioned
from ssp_lp import ModelError, evaluate, solve, visits
from ssp_lp.distributed import PartitionedPolicy

COMM = MPI.COMM_WORLD
GRID = RobotGrid(segments=8, headings=6)
WALLS = {"walls": visits("wall") <= 0.1}


def dies_after(calls, by):
    """What is called after each pricing call: the last rank gets a signal after so many."""
    last = COMM.allgather(os.getpid())[-1]

    def progress(done, *_):
        """Have it killed, as by a system that lacks memory, or interrupted."""
        if done >= calls:
            os.kill(last, by)

    return progress


if __name__ == "__main__":
    path, doing = Path(sys.argv[1]), sys.argv[2]
    model = grid_model(GRID)
    made, start = partitioned(model), start_state(GRID)
    asked = {"start": start, "failure_budget": 0.75, "give_up": "dead_ends", "constraints": WALLS}
    if doing in ("dies", "interrupted"):
        by = signal.SIGKILL if doing == "dies" else signal.SIGINT
        made.solve(MCMP, **asked, checkpoint=path, progress=dies_after(3, by))
        sys.exit("nobody died")
    problem = MCMP(model, **asked)
    if doing == "resumes":
        known, afresh = solve(problem), made.solve(MCMP, **asked)
        resumed = made.solve(MCMP, **asked, checkpoint=path)
        for answer in (afresh, resumed):
            assert answer.objective == pytest.approx(known.objective, rel=1e-9)
            assert answer.gap <= 1e-9
        refused = {"start": start, "failure_budget": 0.8, "checkpoint": path}
        with pytest.raises(ModelError, match=r"checkpoint of .*MCMP.*: name another folder"):
            made.solve(MCMP, **refused)
        with pytest.raises(ModelError, match="must be a folder, and its parent must exist"):
            made.solve(MCMP, **asked, checkpoint=path / "nowhere" / "else")
    elif doing == "saves":
        made.solve(MCMP, **asked).policy.save(path)
    else:
        policy = PartitionedPolicy.load(made, path)
        measured, known = made.evaluate(policy, MCMP, **asked), evaluate(policy.on(model), problem)
        assert measured.objective == pytest.approx(known.objective, rel=1e-9)
        assert measured.failure == pytest.approx(known.failure_probability, rel=1e-9)
        assert measured.spent == pytest.approx(dict(known.secondary_costs), rel=1e-9)
        assert policy.on(model).weights @ measured.figures[:, 0] == pytest.approx(known.objective)
        any_pair = np.where(policy.positions >= 0, 0, policy.positions)  # a policy of one's own
        own = PartitionedPolicy(made.part, policy.weights, any_pair)
        measured, known = made.evaluate(own, MCMP, **asked), evaluate(own.on(model), problem)
        assert measured.failure == pytest.approx(known.failure_probability, rel=1e-9)
        assert measured.objective == pytest.approx(known.objective, rel=1e-9)
        other = partitioned(grid_model(RobotGrid(segments=7, headings=6)))
        with pytest.raises(ModelError, match="for another model, of 387 states"):
            PartitionedPolicy.load(other, path)
    if COMM.gather(True) is not None:
        print(f"{COMM.size} ranks: well")
