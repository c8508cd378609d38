"""Memory and seconds by the number of ranks, on the paper's robot and a windy corridor.

    python examples/distributed/scaling.py --ranks 1 2 4 --robots 40x24 80x36 --turns 3

starts mpiexec itself. A turn runs the problem with each number of ranks, and by the local method on
--threads threads, each in separate processes. Ratios are medians over the turns.
Seconds are those of the slowest rank, after a small problem has loaded the compiled loops; memory
is the greatest resident memory of a rank, with Python and all libraries, and the resident memory
before the model was built.

Strong scaling solves the same problem on more ranks: the least cost of the robot, exact and
discounted. Weak scaling gives each rank an equal number of states of a corridor whose width grows
with the number of ranks; the part near the start, and so the cost, does not change.
"""

import json
import os
import subprocess
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.distributed.robot_on_ranks import shared_robot
from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from ssp_lp import MCMP, SSPError, solve
from ssp_lp.distributed import PartitionedModel, StateRows

SETTINGS = {
    "OMP_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "SSP_LP_ACCELERATOR": "numba",  # loops are compiled, however short: all are loaded before
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",  # more ranks than cores
    "OMPI_MCA_mpi_yield_when_idle": "1",  # a rank that waits lets others work
}
LIMIT = 3600  # seconds after which a process has hung
LENGTH = 100  # cells of the corridor from the start to the goal
BESIDE = 0.1  # probability of being blown to either side
SLIPS = 0.05  # of what comes besides: standing still, or a step of one cell
RISKS = 17  # kinds of ground
WORST = 0.02  # probability of falling where the ground is worst
WAYS = ((1, 0), (1, -1), (1, 1), (2, 0))  # cells ahead and across that are meant; the last runs

Results = dict[str, list[dict[str, Any]]]
"""Kind of process -> its measurements, turn by turn."""


def corridor(width: int) -> tuple[Callable[[int, int], StateRows], int, int]:
    """Return a windy corridor with a number of lanes: its rows, their number, and the start.

    Lanes follow each other, so that neighbours are at most LENGTH numbers apart. Running may fail
    on rotten ground; walking never fails. The goal and the hole come after the cells.
    """
    n, middle = width * LENGTH, width // 2
    goal, hole = n, n + 1

    def rows(first: int, end: int) -> StateRows:
        """Return the rows of a range of cells; the goal and the hole have none."""
        here = np.arange(first, min(end, n))
        lane, along = np.divmod(here, LENGTH)
        ground = (7 * along + 5 * (lane - middle)) % RISKS / (RISKS - 1)

        def cell(ahead: int, across: int) -> npt.NDArray[Any]:
            """Return the cell a move leads to: walls stop it, the end is the goal."""
            there = np.clip(lane + across, 0, width - 1) * LENGTH + along + ahead
            return np.where(along + ahead < LENGTH, there, goal)

        successors, chances = [], []
        for ahead, across in WAYS:
            runs = ahead > 1
            risk = WORST * ground + 1e-4 if runs else np.zeros(len(here))
            last = np.full(len(here), hole) if runs else cell(0, 0)
            blown = [cell(ahead - 1, -1), cell(ahead - 1, 1)]
            successors += [cell(ahead, across), *blown, last]
            kept = SLIPS * np.ones(len(here))
            beside = np.full(len(here), BESIDE)
            missed = risk if runs else kept
            chances += [1.0 - 2.0 * beside - missed, beside, beside, missed]
        return StateRows(
            actions=np.where(np.arange(first, end) < n, len(WAYS), 0),
            outcomes=np.full(len(WAYS) * len(here), 4),
            successors=np.stack(successors, axis=1).ravel(),
            probabilities=np.stack(chances, axis=1).ravel(),
            costs=1.0,
        )

    return rows, n + 2, middle * LENGTH


def shared_corridor(width: int) -> tuple[PartitionedModel, int]:
    """Return the corridor, whose rows the ranks build, and its start."""
    rows, n_states, start = corridor(width)
    return PartitionedModel.from_rows(rows, n_states, [n_states - 2]), start


def most_resident() -> float:
    """Return the peak of this process's resident memory, in MB, on Linux."""
    told = Path("/proc/self/status").read_text(encoding="utf-8")
    return next(int(line.split()[1]) for line in told.splitlines() if "VmHWM" in line) / 1024


def measured(world: str, discount: float | None, budget: float, ranks: int) -> Any:
    """Solve a problem, on ranks or locally; return seconds, memory and results (rank 0 only).

    world: such as "40x24", a robot, or "corridor 200", a corridor of 200 lanes.
    ranks: 0: solve in one process, without ranks.
    """
    asked: dict[str, Any] = {"discount": discount}

    def built(world: str) -> tuple[Any, int]:
        """Return the model and the start."""
        if world.startswith("corridor"):
            return shared_corridor(int(world.split()[1]))
        segments, headings = map(int, world.split("x"))
        grid = RobotGrid(segments=segments, headings=headings)
        return (shared_robot if ranks else grid_model)(grid), start_state(grid)

    def answered(model: Any, start: int, budget: float) -> Any:
        """Return the answer."""
        given = {"start": start, "failure_budget": budget, **asked}
        return model.solve(MCMP, **given) if ranks else solve(MCMP(model, **given))

    def gathered(mine: Any) -> list[Any]:
        """Return the values of all ranks, on every rank."""
        return model.ranks.comm.allgather(mine) if ranks else [mine]

    model, start = built("6x4")
    try:
        answered(model, start, 0.9)
        before, began = gathered(most_resident()), perf_counter()
        model, start = built(world)
        made = max(gathered(perf_counter() - began))
        began = perf_counter()
        answer = answered(model, start, budget)
    except SSPError as error:
        return {"refused": str(error)}
    took = max(gathered(perf_counter() - began))
    memory = gathered(most_resident())
    sizes = gathered((model.part if ranks else model).n_outcomes)
    if ranks and model.ranks.comm.rank > 0:
        return None
    return {
        "states": model.part.halo.n_all if ranks else model.n_states,
        "outcomes": sum(sizes),
        "built": made,
        "solved": took,
        "largest": max(memory),
        "all": sum(memory),
        "objective": answer.objective,
        "price": answer.failure_price,
        "failure": answer.failure if ranks else answer.budget_used,
        "gap": answer.gap,
        "before": max(before),
        "calls": answer.run.pricing_calls,
    }


def said(*command: str, ranks: int, threads: int = 1) -> str:
    """Return the output of a Python script on a number of ranks of mpiexec; 0: without mpiexec.

    Raises RuntimeError, with the output, if it fails.
    """
    before = ["mpiexec", "-n", str(ranks)] if ranks else []
    ended = subprocess.run(  # noqa: S603 (this very interpreter)
        [*before, sys.executable, *command],
        env=os.environ | SETTINGS | {"NUMBA_NUM_THREADS": str(threads)},
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT,
    )
    if ended.returncode != 0:
        raise RuntimeError(f"{command} on {ranks} ranks failed:\n{ended.stdout}{ended.stderr}")
    return ended.stdout


def run(question: tuple[Any, ...], ranks: int, threads: int = 1) -> dict[str, Any]:
    """Return the measurements of a separate process; without ranks: the local method."""
    printed = said(
        __file__, "--measure", json.dumps([*question, ranks]), ranks=ranks, threads=threads
    )
    found: dict[str, Any] = json.loads(printed.strip().splitlines()[-1])
    return found


def in_turns(kinds: dict[str, Callable[[], dict[str, Any]]], turns: int) -> Results:
    """Return the measurements of each kind of process, which alternate in turns."""
    results: Results = {name: [] for name in kinds}
    for _ in range(turns):
        for name, measure in kinds.items():
            results[name].append(measure())
    return results


def ratio(results: Results, name: str, base: str, key: str) -> float:
    """Return the median over the turns of the ratio of two kinds of process."""
    pairs = zip(results[name], results[base], strict=True)
    return median(one[key] / other[key] for one, other in pairs)


def lines(results: Results) -> Iterator[str]:
    """Yield a line for each kind of process; shares are relative to one rank, if it has run."""
    answered = {name: turns for name, turns in results.items() if "refused" not in turns[0]}
    base = next((name for name in answered if "rank" in name), next(iter(answered), ""))
    share = f"of {base.split(',')[0]}"
    yield (
        f"{'':18} {'built':>7} {'solved':>8} {share:>10} {'largest':>9} {share:>10} "
        f"{'all MB':>8} {'before':>8} {'calls':>5} "
        f"{'objective':>15} {'price':>12} {'gap':>8}"
    )
    for name, turns in results.items():
        if name not in answered:
            yield f"{name:18} not answered: {turns[0]['refused']}"
            continue
        built, solved, largest, whole = (
            median(one[k] for one in turns) for k in ("built", "solved", "largest", "all")
        )
        longer, larger = (ratio(results, name, base, k) for k in ("solved", "largest"))
        one = turns[0]
        yield (
            f"{name:18} {built:7.2f} {solved:8.2f} {longer:10.2f} {largest:9.0f} {larger:10.2f} "
            f"{whole:8.0f} {one['before']:8.0f} {one['calls']:5} "
            f"{one['objective']:15.9f} {one['price']:12.6f} {one['gap']:8.0e}"
        )
    if len(answered) > 1:
        differ = [f"{spread(answered, k):.0e} ({k})" for k in ("objective", "price", "failure")]
        yield f"{'':18} shares by which they differ: {', '.join(differ)}"


def spread(results: Results, key: str) -> float:
    """Return the relative difference of a figure between all processes."""
    figures = [one[key] for turns in results.values() for one in turns]
    return float(np.ptp(figures) / max(np.abs(figures).max(), 1e-300))


def table(title: str, results: Results) -> None:
    """Print a table, and the machine's load by other work."""
    print(f"\n{title}; load now {os.getloadavg()[0]:.1f}")
    print("\n".join(lines(results)), flush=True)


def named(ranks: int) -> str:
    """Return the name of the kind of process with a number of ranks."""
    return f"{ranks} rank{'s' * (ranks > 1)}"


def strong(given: Namespace) -> None:
    """Print a table for each problem on each robot."""
    for asked in product(given.robots, given.discounts, [given.budget]):
        world, discount, _ = asked
        kinds = {
            f"local, {n} thread{'s' * (n > 1)}": partial(run, asked, 0, n) for n in given.threads
        }
        kinds |= {named(n): partial(run, asked, n) for n in given.ranks}
        results = in_turns(kinds, given.turns)
        told = "exact" if discount is None else f"discount {discount}"
        title = f"robot {world}, {told}"
        for one in [turns[0] for turns in results.values() if "refused" not in turns[0]][:1]:
            title += f": {one['states']:,} states, {one['outcomes']:,} outcomes"
        table(title, results)


def weak(given: Namespace) -> None:
    """Print a table of corridors with a fixed number of states for each rank."""
    kinds = {}
    for n in given.ranks:
        lanes = max(1, given.weak * n // LENGTH)
        kinds[named(n)] = partial(run, (f"corridor {lanes}", None, given.budget), n)
    title = f"corridor, exact: {given.weak:,} states a rank"
    table(title, in_turns(kinds, given.turns))


def discount_of(text: str) -> float | None:
    """Return the discount that an argument names."""
    return None if text == "exact" else float(text)


def main(arguments: list[str] | None = None) -> None:
    """Measure and print, or run as one of the measured processes."""
    cores = len(os.sched_getaffinity(0))
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--ranks", type=int, nargs="+", default=[1, 2], metavar="N", help="1 2")
    add("--threads", type=int, nargs="*", default=[1], metavar="N", help="of the local method; 1")
    add("--robots", nargs="*", default=["20x12"], metavar="SxH", help="segments x headings; 20x12")
    add("--discounts", type=discount_of, nargs="+", default=[None], metavar="D",
        help="numbers, or 'exact', which it is unless asked")  # fmt: skip
    add("--budget", type=float, default=0.05, help="failure budget; 0.05")
    add("--weak", type=int, default=20_000, metavar="N", help="states of a rank, 0: none; 20000")
    add("--turns", type=int, default=1, metavar="N", help="1")
    add("--measure", help="what a process that is started measures")
    given = parser.parse_args(arguments)
    if given.measure:
        found = measured(*json.loads(given.measure))
        if found is not None:
            print(json.dumps(found))
        return
    print(f"{cores} cores, load {os.getloadavg()[0]:.1f} before; seconds, MB", end="")
    shared = [ranks for ranks in given.ranks if ranks > cores]
    told = [
        f"{n} ranks share {cores} cores: at best {n / cores:g} times the seconds" for n in shared
    ]
    print("".join(f"\n{line}" for line in told))
    strong(given)
    if given.weak:
        weak(given)


if __name__ == "__main__":
    main()
