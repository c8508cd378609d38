"""The paper's robot on the ranks of PETSc: each rank discretises and holds only its own cells.

    mpiexec -n 2 python examples/distributed/robot_on_ranks.py --segments 40 --headings 24

finds the least cost within a failure budget of 5 % on 38,403 states in about ten seconds, and
evaluates the lottery's policies on the rows of all ranks. Without mpiexec there is one rank.
Options of PETSc, such as -ssp_lp_ksp_monitor or -log_view, come last. It needs petsc4py and mpi4py
(docs/solving.md).
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from typing import Any

from examples.paper_robot.robot import RobotGrid, continuous_robot, start_state
from ssp_lp import MCMP, Quadrature
from ssp_lp.distributed import PartitionedModel


def shared_robot(grid: RobotGrid) -> PartitionedModel:
    """Return the robot's grid model, of which each rank builds the rows of its own states."""
    return PartitionedModel.from_continuous(continuous_robot(grid), Quadrature(grid.quadrature))


def report(model: PartitionedModel, **asked: Any) -> list[str]:
    """Solve and evaluate on all ranks; return lines on each rank's part and on the solution."""
    answer = model.solve(MCMP, **asked)
    measured, halo = model.evaluate(answer.policy, MCMP, **asked), model.part.halo
    parts = model.ranks.comm.allgather((halo.first, halo.end, model.part.n_outcomes))
    weights = answer.policy.weights
    return [
        *(
            f"rank {rank}: states {first:,} .. {end - 1:,}, {outcomes:,} outcomes"
            for rank, (first, end, outcomes) in enumerate(parts)
        ),
        f"cost {answer.objective:.9f}, certified to a relative gap of {answer.gap:.1e}",
        f"a failure costs {answer.failure_price:.6f} at the margin",
        f"a lottery of {len(weights)}: {' and '.join(f'{weight:.4f}' for weight in weights)}",
        f"failure charged to the budget {answer.failure:.6f}",
        f"evaluated anew: cost {measured.objective:.9f}, failure {measured.failure:.6f}",
    ]


def main(arguments: list[str] | None = None) -> None:
    """Build the model, solve the problem and print the report."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--segments", type=int, default=20, metavar="N", help="cells a side; 20")
    parser.add_argument("--headings", type=int, default=12, metavar="N", help="of the robot; 12")
    parser.add_argument("--budget", type=float, default=0.05, help="failure budget; 0.05")
    parser.add_argument("--discount", type=float, help="such as 0.999; without it costs are exact")
    given, _ = parser.parse_known_args(arguments)  # others are PETSc's
    grid = RobotGrid(segments=given.segments, headings=given.headings)
    model = shared_robot(grid)
    asked = {"failure_budget": given.budget, "discount": given.discount}
    told = report(model, start=start_state(grid), **asked)
    if model.ranks.comm.rank == 0:
        print("\n".join(told))


if __name__ == "__main__":
    main()
