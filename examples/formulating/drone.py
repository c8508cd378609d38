"""A drone that carries blood to a hospital: at most 2 % crashes, at most 1 % empty batteries.

    S the depot, H the hospital, # a tower, m a meadow on which it may land, . streets

Each minute it flies one cell, or sprints two at three times the charge. Gusts blow it one cell to
the east or to the south. A drone that meets a tower crashes; one with an empty battery falls; on a
meadow it may land, so that the blood does not arrive, and nobody is hurt. Once the remaining charge
does not suffice for the hospital, the delivery has failed, but the next actions still matter:
limits on named ends apply until the true end of the flight.

    python examples/formulating/drone.py    # prints the plans, saves drone.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ssp_lp import S3P, SSP, Solution, end_probability, simulate, solve
from ssp_lp.plotting import plot_episodes

PLAN = (
    "..m....#....m.H",
    ".......#.......",
    "..##...........",
    "..##.....##....",
    ".........##..#.",
    "....m........#.",
    ".........m.....",
    ".##...##.......",
    ".##...##...#..m",
    "...........#...",
    "S....m.........",
)
CHARGE = 30  # units at the depot; a cell takes one, a sprint of two cells three
GUST, SPRINT_GUST = 0.1, 0.2  # probability of being blown a cell to the east, and to the south
WINDS = [], [(1, 0)], [(0, -1)]  # calm, and the two gusts
MOVES = {"north": (0, 1), "east": (1, 0), "south": (0, -1), "west": (-1, 0)}
BUDGET, LIMITS = 0.1, {"crash": 0.02, "battery": 0.01}
ENDS = {"crash": ["crashed"], "battery": ["fallen"], "landed": ["landed"]}

Flight = tuple[int, int, int]
"""Column, row from below, charge left."""


def mark_at(column: int, row: int) -> str:
    """Return the plan's mark of a cell, or of the nearest cell within the plan."""
    inside = min(max(column, 0), len(PLAN[0]) - 1), min(max(row, 0), len(PLAN) - 1)
    return PLAN[len(PLAN) - 1 - inside[1]][inside[0]]


def flown(flight: Flight, path: Sequence[tuple[int, int]], used: int) -> str | Flight:
    """Return the state after a path of single cells, or the end that the drone meets on it."""
    column, row, left = flight
    for east, north in path:
        column = min(max(column + east, 0), len(PLAN[0]) - 1)
        row = min(max(row + north, 0), len(PLAN) - 1)
        if mark_at(column, row) == "#":
            return "crashed"
        if mark_at(column, row) == "H":
            return "delivered"
    return (column, row, left - used) if left > used else "fallen"


def actions(state: str | Flight) -> dict[str, list[tuple[float, str | Flight, float]]]:
    """Return a drone's actions: fly or sprint in four directions, or land; a minute costs 1."""
    if isinstance(state, str):
        return {}
    ways = {name: ([move], 1, GUST) for name, move in MOVES.items()}
    ways |= {f"sprint {name}": ([move] * 2, 3, SPRINT_GUST) for name, move in MOVES.items()}
    found = {}
    for name, (path, used, gust) in ways.items():
        if used <= state[2]:
            blown = [flown(state, [*path, *more], used) for more in WINDS]
            chances = 1.0 - 2.0 * gust, gust, gust
            found[name] = [(p, end, 1.0) for p, end in zip(chances, blown, strict=True)]
    if mark_at(*state[:2]) == "m":
        found["land"] = [(1.0, "landed", 1.0)]
    return found


def town() -> tuple[SSP, Flight]:
    """Return the model and its start."""
    start = 0, 0, CHARGE
    model = SSP.from_successors(
        start,
        actions,
        {"delivered"},
        state_labels=ENDS,
        treat_actionless_as_dead_ends=True,
    )
    return model, start


def plan(model: SSP, start: Flight, **most: float) -> Solution:
    """Find the fastest delivery that fails at most one time in ten, with limits on named ends."""
    limits = {name: end_probability(name) <= bound for name, bound in most.items()}
    return solve(S3P(model, start, BUDGET, constraints=limits))


AT_LAST = {"delivered": (len(PLAN[0]) - 1, len(PLAN) - 1)}
"""Places at which states that are no flights are drawn."""


def draw(plans: dict[str, Solution], path: Path) -> None:
    """Draw sixty flights of each plan over the town, coloured by their ends."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.8), layout="constrained")
    columns, rows = range(len(PLAN[0])), range(len(PLAN))
    places = [(column, row) for column in columns for row in rows]
    for axes, (title, solution) in zip(figure.subplots(1, 2), plans.items(), strict=True):
        plot_episodes(
            solution.policy,
            solution.problem,
            lambda state: AT_LAST.get(state) if isinstance(state, str) else state[:2],
            episodes=60,
            seed=5,
            walls=[place for place in places if mark_at(*place) == "#"],
            ax=axes,
        )
        for place in places:
            if mark_at(*place) in "SHm":
                axes.text(*place, mark_at(*place), ha="center", va="center", weight="bold")
        axes.set_title(title)
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> None:
    """Plan with and without limits, simulate both plans, print how flights end, draw them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("drone.png"))
    options = parser.parse_args(arguments)
    model, start = town()
    print(model)
    plans = {"failure at most 10 %": plan(model, start)}
    plans["crash at most 2 %, battery at most 1 %"] = plan(model, start, **LIMITS)
    for title, solution in plans.items():
        flights = simulate(solution.policy, solution.problem, episodes=100_000, seed=1).ends
        ended = ", ".join(
            f"{name} {count / 1000:.2f} %" for name, count in flights.items() if count
        )
        print(f"{title}\n{solution.summary()}\nflown 100,000 times: {ended}")
    draw(plans, options.output)
    print(f"drawn in {options.output}")


if __name__ == "__main__":
    main()
