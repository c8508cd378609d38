"""Fetch the key before the door: a task as a memory, drawn before and after.

A robot crosses a warehouse in the wind, past ditches; the key lies on one side, the door on the
other. The task is no property of a place but of what happened before, so it is a
memory: `product(model, Memory(...))` is again a model, every criterion applies, and the policy acts
on the cells and carries the memory itself.

    python examples/formulating/key_and_door.py    # prints the numbers, saves key_and_door.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from formulations import MCMP
from ssp_lp import SSP, Memory, ProductSSP, Solution, on_original, product, solve

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


def found(mark: str) -> Cell:
    """The cell that bears a mark."""
    return next((r, row.index(mark)) for r, row in enumerate(PLAN) if mark in row)


def warehouse() -> SSP:
    """Cells that are no walls; the ditch is a dead-end, the door the goal; a step costs 1."""
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
    """The warehouse with the memory of whether the key was fetched."""
    key = found("K")
    memory = Memory(
        start=False,
        update=lambda has_key, state, action, successor, cost: has_key or successor == key,
        accepts=lambda has_key: has_key,
    )
    return product(model, memory, start=[found("S")])


def visits(solution: Solution, made: ProductSSP) -> dict[tuple[Cell, bool], float]:
    """Expected visits of each cell, before and after the key."""
    measure = solution.problem.program().solve()
    counted: dict[tuple[Cell, bool], float] = {}
    for column, amount in enumerate(measure.visits.tolist()):
        state = measure.program.label(column).state
        counted[state] = counted.get(state, 0.0) + amount
    return counted


def draw(solution: Solution, made: ProductSSP, path: Path) -> None:
    """Two plans side by side: where the robot is expected to be, and the likeliest moves."""
    from matplotlib.figure import Figure

    counted = visits(solution, made)
    figure = Figure(figsize=(11.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 2)
    member = solution.policy.policies[int(np.argmax(solution.policy.weights))]
    chosen = member.actions()
    for axis, has_key in zip(axes, (False, True), strict=True):
        image = np.full((len(PLAN), len(PLAN[0])), np.nan)
        for r, row in enumerate(PLAN):
            for c, mark in enumerate(row):
                if mark not in "#~":
                    image[r, c] = counted.get(((r, c), has_key), 0.0)
        shown = axis.imshow(image, cmap="YlGnBu", vmin=0.0, vmax=1.2)
        for r, row in enumerate(PLAN):
            for c, mark in enumerate(row):
                colour = {"#": "0.25", "~": "tab:brown"}.get(mark)
                if colour:
                    axis.add_patch(_square(r, c, colour))
                elif mark in "KDS":
                    axis.text(c, r, mark, ha="center", va="center", weight="bold", color="tab:red")
                if counted.get(((r, c), has_key), 0.0) > 0.02 and mark not in "KDS":
                    move = MOVES.get(chosen.get(((r, c), has_key), ""))
                    if move:
                        start = (c - 0.3 * move[1], r - 0.3 * move[0])
                        end = (c + 0.3 * move[1], r + 0.3 * move[0])
                        axis.annotate("", end, start, arrowprops={"arrowstyle": "->"})
        axis.set_title("with the key" if has_key else "without the key")
        axis.set_xticks([])
        axis.set_yticks([])
    figure.colorbar(shown, ax=axes, label="expected visits", shrink=0.8)
    figure.savefig(path, dpi=150)


def _square(row: int, column: int, colour: str) -> object:
    from matplotlib.patches import Rectangle

    return Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, color=colour)


def main(arguments: Sequence[str] | None = None) -> None:
    """Solve the task, say what it costs, draw it, play one episode."""
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
    policy, rng = on_original(solution.policy), np.random.default_rng(3)
    policy.reset(rng)
    cell, path = found("S"), [found("S")]
    while PLAN[cell[0]][cell[1]] not in "D~":
        action = policy.action(cell)
        row = int(model.pair_offsets[model.index_of(cell)]) + list(MOVES).index(str(action))
        begin, end = model.outcome_offsets[row : row + 2].tolist()
        drawn = rng.choice(np.arange(begin, end), p=model.probabilities[begin:end])
        cell = model.states[int(model.successors[drawn])]
        policy.observe(cell, 1.0)
        path.append(cell)
    print(f"one episode: {len(path) - 1} steps, ends at {PLAN[cell[0]][cell[1]]}")
    draw(solution, made, options.output)
    print(f"drawn in {options.output}")


if __name__ == "__main__":
    main()
