"""The paper, section by section, on a journey of six states that can be solved by hand.

Prints each number as the library computes it beside its closed form in fractions:

    python examples/paper_walkthrough/walkthrough.py
    python examples/paper_walkthrough/walkthrough.py --robot    # and the robot, gamma towards 1

The model and its closed forms are in `model` and `lottery`, section 2 in `problem`, sections 3.1 to
3.4 in `game`, 3.5 in `stationary`.
"""

import argparse
from collections.abc import Callable, Sequence

from examples.paper_robot.grid import RobotGrid
from examples.paper_walkthrough import game, problem, stationary
from examples.paper_walkthrough.model import Row
from examples.paper_walkthrough.robot import robot_text

SECTIONS: dict[str, Callable[[], list[Row]]] = {
    "2.1 Model": problem.section_2_1,
    "2.2 Policies": problem.section_2_2,
    "2.3 Dead-ends": problem.section_2_3,
    "2.4 Objective functions": problem.section_2_4,
    "2.5 Constraint": problem.section_2_5,
    "3.1 Two MDPs": game.section_3_1,
    "3.2 Two-person zero-sum game (M)": game.section_3_2,
    "3.3 Bayes-adaptive value iteration": game.section_3_3,
    "3.4 The delta mixture (M)": game.section_3_4,
    "3.5 Stationary approximation (M)": stationary.section_3_5_m,
    "3.5 Stationary approximation (S)": stationary.section_3_5_s,
    "3.5 Theorem 3-1 (S)": stationary.section_3_5_scan,
    "Duality: linear program, column generation, game": stationary.section_duality,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print all sections."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", action="store_true", help="also the robot's table (15 s)")
    options = parser.parse_args(arguments)
    for title, section in SECTIONS.items():
        print(table(title, section), end="\n\n", flush=True)
    if options.robot:
        print(robot_text(RobotGrid()))


def table(title: str, section: Callable[[], list[Row]]) -> str:
    """Return a section's remarks and its rows, the two columns and their difference."""
    rows = section()
    width = max(len(row.what) for row in rows)
    remarks = [line.strip() for line in (section.__doc__ or "").splitlines() if line.strip()]
    head = f"  {'':<{width}}  {'computed':>14}  {'by hand':>14}  {'difference':>10}"
    return "\n".join([title, *(f"  {r}" for r in remarks), head,
                      *(_line(row, width) for row in rows)])  # fmt: skip


def _line(row: Row, width: int) -> str:
    difference = float(row.computed) - float(row.theory)
    note = "" if row.bound is None else f"  (within {row.bound:.1e})"
    return (
        f"  {row.what:<{width}}  {row.computed:>14.10g}  {float(row.theory):>14.10g}"
        f"  {difference:>10.1e}{note}"
    )


if __name__ == "__main__":
    main()
