"""Fetch the key before the door: a task as a memory, drawn before and after.

A robot crosses a warehouse in the wind, past ditches; the key lies on one side, the door on the
other. The task depends on the past, not on the place alone, so it is stated by a memory:
`product(model, Memory(...))` is again a model, every criterion applies, and the policy acts on the
cells and updates the memory itself.

    python examples/formulating/key_and_door.py    # prints the numbers, saves key_and_door.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ssp_lp import MCMP, SSP, Memory, ProductSSP, Solution, on_original, product, solve
from ssp_lp.plotting import plot_grid_policy

PLAN = (
    "##############",
    "#K....~~.....#",
    "#.##......##.#",
    "#.....S......#",
    "#.~~.##.~~~..#",
    "#....##.....D#",
    "##############",
)
MOVES = {"north": (-1, 0), "south": (1, 0), "west": (0, -1), "east": (0, 1)}
SLIP = 0.06  # probability of being blown to each side
BUDGET = 0.1

Cell = tuple[int, int]


def place(cell: Cell) -> tuple[int, int]:
    """Return the place at which a cell is drawn: (x, y), y upwards."""
    return cell[1], -cell[0]


DIRECTIONS = {name: place(move) for name, move in MOVES.items()}
WALLS = [place((r, c)) for r, row in enumerate(PLAN) for c, mark in enumerate(row) if mark == "#"]


def found(mark: str) -> Cell:
    """Return the cell with a mark."""
    return next((r, row.index(mark)) for r, row in enumerate(PLAN) if mark in row)


def warehouse() -> SSP:
    """Build the model of the free cells: ditches are dead-ends, the door the goal, steps cost 1."""
    cells = [(r, c) for r, row in enumerate(PLAN) for c, mark in enumerate(row) if mark not in "#~"]
    ditch = [(r, c) for r, row in enumerate(PLAN) for c, mark in enumerate(row) if mark == "~"]

    def step(cell: Cell, move: tuple[int, int]) -> Cell:
        there = cell[0] + move[0], cell[1] + move[1]
        return cell if PLAN[there[0]][there[1]] == "#" else there

    def outcomes(cell: Cell, move: tuple[int, int]) -> list[tuple[float, Cell, float]]:
        aside = move[1], move[0]
        ends = [(1.0 - 2.0 * SLIP, move), (SLIP, aside), (SLIP, (-aside[0], -aside[1]))]
        return [(p, step(cell, end), 1.0) for p, end in ends]

    transitions = {
        cell: {name: outcomes(cell, move) for name, move in MOVES.items()}
        for cell in cells
        if cell != found("D")
    }
    return SSP.from_transitions(
        transitions | {cell: {} for cell in ditch},
        goal={found("D")},
        state_labels={"ditch": ditch},
        treat_actionless_as_dead_ends=True,
    )


def with_key(model: SSP) -> ProductSSP:
    """Return the warehouse with a memory of whether the key was fetched."""
    key = found("K")
    memory = Memory(
        start=False,
        update=lambda has_key, state, action, successor, cost: has_key or successor == key,
        accepts=lambda has_key: has_key,
    )
    return product(model, memory, start=[found("S")])


def draw(solution: Solution, path: Path) -> None:
    """Draw two plans side by side: the robot's expected visits, and its moves."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.4), layout="constrained")
    for axes, has_key in zip(figure.subplots(1, 2), (False, True), strict=True):
        plot_grid_policy(
            solution.policy,
            solution.problem,
            lambda state, now=has_key: place(state[0]) if state[1] == now else None,
            DIRECTIONS,
            walls=WALLS,
            most_visits=1.2,
            ax=axes,
        )
        if not has_key:
            axes.text(*place(found("K")), "K", ha="center", va="center", weight="bold", size=12)
        axes.set_title("with the key" if has_key else "without the key K")
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> None:
    """Solve the task, print its cost, draw it, simulate one episode."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("key_and_door.png"))
    options = parser.parse_args(arguments)
    model = warehouse()
    made = with_key(model)
    solution = solve(MCMP(made, made.start(found("S")), failure_budget=BUDGET))
    anyhow = solve(MCMP(model, found("S"), failure_budget=BUDGET))
    print(f"{model!r}\n{made!r}, with the memory of the key")
    print(solution.summary())
    print(f"without the key the door would cost {anyhow.objective:.4f}")
    rng = np.random.default_rng(3)
    episode = on_original(solution.policy).start(rng)
    cell, path = found("S"), [found("S")]
    while PLAN[cell[0]][cell[1]] not in "D~":
        action = episode.action(cell)
        row = int(model.pair_offsets[model.index_of(cell)]) + list(MOVES).index(str(action))
        begin, end = model.outcome_offsets[row : row + 2].tolist()
        drawn = rng.choice(np.arange(begin, end), p=model.probabilities[begin:end])
        cell = model.states[int(model.successors[drawn])]
        episode.observe(cell, 1.0)
        path.append(cell)
    print(f"one episode: {len(path) - 1} steps, ends at {PLAN[cell[0]][cell[1]]}")
    draw(solution, options.output)
    print(f"drawn in {options.output}")


if __name__ == "__main__":
    main()
