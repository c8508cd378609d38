"""Pictures for the front page of the documentation: a robot, a drone and a treatment.

A robot crosses the warehouse of `key_and_door.py` as fast as it can when 1, 5 or 20 runs in a
hundred may end in a ditch. The drone and the treatment are those of `examples/notebooks`.

    python examples/formulating/front_page.py --output docs/front
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from examples.formulating.gallery import save
from examples.formulating.key_and_door import PLAN, found, warehouse
from ssp_lp import MCMP, Solution, simulate, solve, trace_frontier
from ssp_lp.plotting import plot_paths

RISKS = (0.01, 0.05, 0.20)
WEST = 4  # the first column of the warehouse that is drawn
RUNS = 100
ROBOT_SEED, DRONE_SEED = 19, 5  # about as many runs fail as are expected to
SPREAD = 0.3  # a path keeps a distance of up to this from the middles of the cells
NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
TOWN = ("..#....H", "..#.m#..", "m....#..", ".#......", ".#..#..m", "S..m#...")
"""The plan of `drone.ipynb`: S the depot, H the hospital, # a tower, m a meadow."""

HOSPITAL = (7, 0)
ENDINGS = {
    "delivered": "deliver",
    "crashed": "crash",
    "fallen": "battery empty",
    "landed": "land",
}
"""How a flight ends, by its last state."""

INK, GROUND, HATCHING = "#333333", "#f6f7f9", "#d9b79c"
LETTERS = {
    "color": INK,
    "size": 12,
    "bbox": {"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none"},
}
COLOURS = {
    "#": "#5b6270",
    "~": "#f3d3bd",
    "m": "#dcebc9",
    "S": "#e3e6ee",
    "D": "#bfe5d3",
    "H": "#bfe5d3",
}
"""Of the squares of a plan, by their marks."""


def pictures() -> Iterator[tuple[str, Axes]]:
    """Each picture by its name; the axes are in a figure of their own."""
    yard = [row[WEST:-1] for row in PLAN[1:-1]]
    ends = {"~": "fall into a ditch", "D": "reach the door"}
    for risk in RISKS:
        axes = ground(yard, {"S": "start", "D": "door"})
        draw_runs(
            axes, crossing(risk), in_the_yard, lambda at: ends.get(PLAN[at[0]][at[1]]), ROBOT_SEED
        )
        yield f"robot_{100 * risk:.0f}", axes
    axes = ground(TOWN, {"S": "depot", "H": "hospital", "m": "meadow"})
    careful = names_of("drone")["careful"]
    draw_runs(axes, careful, over_town, ENDINGS.get, DRONE_SEED)
    yield "drone", axes
    yield "treatment", weeks_against_toxicity(names_of("treatment")["plan"])


def crossing(risk: float) -> Solution:
    """The fastest way through the warehouse that ends in a ditch with at most this probability."""
    return solve(MCMP(warehouse(), found("S"), failure_budget=risk, give_up="dead_ends"))


def in_the_yard(cell: tuple[int, int]) -> tuple[int, int]:
    """Where a cell of the warehouse is drawn."""
    return cell[1] - WEST, 1 - cell[0]


def over_town(state: Any) -> tuple[int, int] | None:
    """Where a state of the drone is drawn; a flight that failed ends at its last cell."""
    if isinstance(state, str):
        return HOSPITAL if state == "delivered" else None
    return state[0], -state[1]


def ground(plan: Sequence[str], words: dict[str, str]) -> Axes:
    """Axes with the squares of a plan (column x, row -y) and the words given for its marks."""
    width, height = max(map(len, plan)), len(plan)
    figure = Figure(figsize=(6.0, 6.0 * height / width + 0.5), layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(-0.5, width - 0.5), ylim=(0.5 - height, 0.5), aspect="equal", facecolor=GROUND)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color("#c9cdd6")
    for y, row in enumerate(plan):
        for x, sign in enumerate(row):
            if sign in COLOURS:
                look = {"facecolor": COLOURS[sign], "edgecolor": HATCHING, "linewidth": 0}
                hatch = "xxx" if sign == "~" else None
                axes.add_patch(Rectangle((x - 0.5, -y - 0.5), 1, 1, hatch=hatch, **look))
            if sign in words:
                axes.text(x, -y, words[sign], ha="center", va="center", zorder=6, **LETTERS)
    return axes


def draw_runs(
    axes: Axes,
    solution: Solution,
    place_of: Callable[[Any], tuple[float, float] | None],
    end_of: Callable[[Any], str | None],
    seed: int,
) -> None:
    """Draw simulated runs over the plan, by how they end."""
    random = np.random.default_rng(seed)
    problem = solution.problem
    report = simulate(solution.policy, problem, episodes=RUNS, seed=random, record=RUNS)
    states = [[problem.model.states[int(index)] for index in path] for path in report.paths]
    ends = [end_of(run[-1]) or "go on" for run in states]
    placed = [[at for state in run if (at := place_of(state)) is not None] for run in states]
    aside = random.uniform(-SPREAD, SPREAD, (RUNS, 2))
    paths = [np.array(run) + shift for run, shift in zip(placed, aside, strict=True)]
    first = next(end for end in ("reach the door", "deliver") if end in ends)
    plot_paths(paths, ends, order=[first], ax=axes)
    for text in axes.get_legend().get_texts():
        text.set_size(12)


def weeks_against_toxicity(plan: Solution) -> Axes:
    """The least weeks of treatment against the toxicity that patients may bear on average."""
    axes = trace_frontier(plan.problem, over="toxicity").plot(whole=True)
    bound, weeks = plan.secondary_costs["toxicity"], plan.objective
    axes.plot([bound], [weeks], "o", color=INK, markersize=9, zorder=6)
    axes.annotate(
        f"toxicity at most {bound:g}:\n{weeks:.1f} weeks",
        (bound, weeks),
        xytext=(18, 26),
        textcoords="offset points",
        size=12,
    )
    axes.set_xlabel("toxicity allowed on average", size=12)
    axes.set_ylabel("weeks of treatment, on average", size=12)
    axes.get_legend().remove()
    return axes


def names_of(notebook: str) -> dict[str, Any]:
    """The names that a notebook's code leaves behind."""
    cells = json.loads((NOTEBOOKS / f"{notebook}.ipynb").read_text(encoding="utf-8"))["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    names: dict[str, Any] = {}
    with chdir(NOTEBOOKS), open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        exec(code, names)  # noqa: S102
    return names


def main(arguments: Sequence[str] | None = None) -> None:
    """Save every picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("front"), help="folder")
    folder = parser.parse_args(arguments).output
    folder.mkdir(parents=True, exist_ok=True)
    for name, axes in pictures():
        save(axes, folder / f"{name}.png")
        print(f"{folder / name}.png")


if __name__ == "__main__":
    main()
