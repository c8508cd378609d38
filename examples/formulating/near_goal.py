"""A large field and a near goal: an implicit model, of which only a part is explored.

Each cell that the robot enters swallows it with the cell's own probability.

    python examples/formulating/near_goal.py --side 10000 --distance 30

With ``--whole`` the whole field is built and solved as well (600 cells to a side take seconds).
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Mapping
from time import perf_counter
from typing import Any

from ssp_lp import MCMP, SSP, certify, solve

Cell = tuple[int, int] | str
Steps = Mapping[str, list[tuple[float, Cell, float]]]

LOST = "lost"
MOVES = {"north": (0, -1), "east": (1, 0), "south": (0, 1), "west": (-1, 0)}


class Field:
    """Cells from (0, 0) to (side - 1, side - 1), the start a third into it, the goal near by."""

    def __init__(self, side: int, distance: int, risk: float = 0.02) -> None:
        """State the field; ``risk`` is the greatest probability that a cell swallows the robot."""
        self.side, self.risk = side, risk
        self.start = side // 3, side // 3
        self.goal = self.start[0] + distance, self.start[1] + distance

    def steps(self, cell: Any) -> Steps:
        """Return the actions of a cell, with their outcomes."""
        if cell == LOST:
            return {}
        x, y = cell
        steps: dict[str, list[tuple[float, Cell, float]]] = {}
        for name, (dx, dy) in MOVES.items():
            u, v = x + dx, y + dy
            if 0 <= u < self.side and 0 <= v < self.side:
                swallowed = self.risk * ((u * 73856093 ^ v * 19349663) % 1000) / 1000
                steps[name] = [(1.0 - swallowed, (u, v), 1.0), (swallowed, LOST, 1.0)]
        return steps

    def least_steps(self, cell: Any) -> float:
        """Return a lower bound of the number of steps from a cell to the goal."""
        if cell == LOST:
            return float("inf")
        return float(abs(cell[0] - self.goal[0]) + abs(cell[1] - self.goal[1]))


def explored(field: Field, budget: float) -> float:
    """Solve by exploring, print the solution and the explored part, return the least cost."""
    model = SSP.implicit(field.start, field.steps, {field.goal}, cost_bound=field.least_steps)
    began = perf_counter()
    solution = solve(MCMP(model, field.start, failure_budget=budget))
    seconds, part = perf_counter() - began, solution.problem.model
    print(f"explored: {solution.objective:.6f} steps, {part.n_states:,} states, {seconds:.2f} s")
    print(certify(solution))
    return solution.objective


def whole(field: Field, budget: float) -> float:
    """Build and solve the whole field, and return the least cost."""
    began = perf_counter()
    most = field.side**2 + 1
    model = SSP.from_successors(
        field.start, field.steps, {field.goal}, state_limit=most, dead_ends={LOST}
    )
    solution = solve(MCMP(model, field.start, failure_budget=budget))
    seconds = perf_counter() - began
    print(f"whole:    {solution.objective:.6f} steps, {model.n_states:,} states, {seconds:.2f} s")
    return solution.objective


def main() -> None:
    """Solve and print."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=10_000, metavar="N", help="cells; 10000")
    parser.add_argument("--distance", type=int, default=30, metavar="N", help="each way; 30")
    parser.add_argument("--budget", type=float, default=0.5, metavar="P", help="of failing; 0.5")
    parser.add_argument("--whole", action="store_true", help="build the whole field, too")
    given = parser.parse_args()
    field = Field(given.side, given.distance)
    explored(field, given.budget)
    if given.whole:
        whole(field, given.budget)


if __name__ == "__main__":
    main()
