"""The paper's robot on the ranks of PETSc: each discretises its own cells, and none has them all.

    mpiexec -n 2 python examples/distributed/robot_on_ranks.py --segments 40 --headings 24

finds the least cost within a failure budget of 5 % on 38,403 states in about ten seconds. Without
mpiexec there is one rank. It needs petsc4py and mpi4py (docs/guides/big_models.md).
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

from examples.paper_robot.robot import RobotGrid, continuous_robot, start_state
from formulations import MCMP
from ssp_lp import Quadrature
from ssp_lp.distributed import PartitionedModel, PartitionedSolution


def shared_robot(grid: RobotGrid) -> PartitionedModel:
    """Return the robot's grid model, the rows of each rank's states made by itself."""
    return PartitionedModel.from_continuous(continuous_robot(grid), Quadrature(grid.quadrature))


def report(model: PartitionedModel, answer: PartitionedSolution) -> None:
    """Print, on the first rank alone, who has how much of the model, and the answer."""
    comm, slab = model.ranks.comm, model.slab
    parts = comm.gather((slab.first, slab.end, slab.n_outcomes))
    if comm.rank > 0:
        return
    for rank, (first, end, outcomes) in enumerate(parts):
        print(f"rank {rank}: states {first:,} .. {end - 1:,}, {outcomes:,} outcomes")
    print(f"cost {answer.objective:.9f}, proved to a relative gap of {answer.gap:.1e}")
    print(f"failure probability {answer.failure:.6f}, price {answer.failure_price:.6f}")
    shares = " and ".join(f"{weight:.4f}" for weight in answer.policy.weights)
    print(f"a lottery of {len(answer.policy.weights)} policies, with probabilities {shares}")


def main(arguments: list[str] | None = None) -> None:
    """Make, ask and print."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--segments", type=int, default=20, metavar="N", help="cells a side; 20")
    parser.add_argument("--headings", type=int, default=12, metavar="N", help="of the robot; 12")
    parser.add_argument("--budget", type=float, default=0.05, help="failure budget; 0.05")
    parser.add_argument("--discount", type=float, help="such as 0.999; without it costs are exact")
    given = parser.parse_args(arguments)
    grid = RobotGrid(segments=given.segments, headings=given.headings)
    model = shared_robot(grid)
    asked = {"failure_budget": given.budget, "discount": given.discount}
    report(model, model.solve(MCMP, start=start_state(grid), **asked))


if __name__ == "__main__":
    main()
