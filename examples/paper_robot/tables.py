"""The paper's Tables 1 and 2 beside this library's results, as text."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from textwrap import fill
from typing import TypeVar

from examples.paper_robot.study import COMPARED, DESIGNS, IN_BETWEEN, READINGS, Trial
from ssp_lp.analysis.simulation import SimulationReport

PAPER = {
    1.0: {
        "S max": (19.34, 9, 0),
        "M max": (19.32, 12, 0),
        "S mod": (16.10, 2735, 279),
        "M mod": (16.11, 2764, 250),
    },
    100.0: {
        "S max": (19.34, 15, 0),
        "M max": (19.33, 17, 0),
        "S mod": (16.09, 2692, 264),
        "M mod": (16.28, 3083, 0),
    },
}
"""wall cost -> policy -> conditional cost, collisions with A and B, collisions with the wall."""

Trials = Mapping[str, Mapping[str, Trial]]
"""Reading -> design -> trial."""

_Column = TypeVar("_Column", Trial, SimulationReport)

EPISODES = 100_000  # of the paper; exact probabilities are printed as so many of these
_LABEL_WIDTH, _COLUMN_WIDTH, _READING_WIDTH = 36, 11, 20

_EXACT: dict[str, Callable[[Trial], str]] = {
    "objective": lambda t: _fixed(t.evaluation.objective, 4),
    "relative gap of the bound": lambda t: f"{t.gap:.1e}",
    "price of failure": lambda t: _fixed(t.failure_price, 2),
    "deterministic policies mixed": lambda t: str(t.members),
    "discounted failure": lambda t: _fixed(t.evaluation.discounted_failure, 6),
    "failure probability": lambda t: _fixed(t.evaluation.failure_probability, 6),
    "cost given success": lambda t: _fixed(t.evaluation.conditional_cost, 4),
    "collisions with A, B of 100,000": lambda t: _exact_count(t, "obstacle"),
    "collisions with the wall of 100,000": lambda t: _exact_count(t, "wall"),
}
"""Numbers of a design in the grid model."""

_PLAYED: dict[str, Callable[[SimulationReport], str]] = {
    "cost given success": lambda r: _fixed(r.conditional_cost.value, 2),
    "collisions with A, B": lambda r: _count(r.ends.get("obstacle", 0)),
    "collisions with the wall": lambda r: _count(r.ends.get("wall", 0)),
    "any other failure": lambda r: _count(
        sum(n for end, n in r.ends.items() if end not in ("goal", "obstacle", "wall"))
    ),
}
"""Numbers of simulated episodes."""


def table_text(wall_cost: float, trials: Trials, episodes: int) -> str:
    """Return one table: a column per design; the paper's rows first, then each reading's."""
    published = [PAPER[wall_cost].get(design.published) for design in DESIGNS]
    groups = [(name, len(list(some))) for name, some in groupby(d.group for d in DESIGNS)]
    lines = [
        *_heading(f"Stage cost after a collision with the wall: {wall_cost:g}"),
        " " * _LABEL_WIDTH + "".join(name.rjust(_COLUMN_WIDTH * n) for name, n in groups),
        _row("", [design.name for design in DESIGNS]),
        f"The paper, {EPISODES:,} episodes",
        _row("  cost given success", [_fixed(p and p[0], 2) for p in published]),
        _row("  collisions with A, B", [_count(p and p[1]) for p in published]),
        _row("  collisions with the wall", [_count(p and p[2]) for p in published]),
    ]
    for reading in READINGS:
        columns = [trials[reading.name].get(design.name) for design in DESIGNS]
        chains, worlds = ([t and (t.chain, t.world)[k] for t in columns] for k in (0, 1))
        lines += [
            f"Ours, {reading.name}",
            " Exact, on the grid model",
            *(_row(f"  {words}", _cells(columns, of)) for words, of in _EXACT.items()),
            f" Grid model, {episodes:,} episodes",
            *(_row(f"  {words}", _cells(chains, of)) for words, of in _PLAYED.items()),
            f" Continuous world, {episodes:,} episodes",
            *(_row(f"  {words}", _cells(worlds, of)) for words, of in _PLAYED.items()),
        ]
    return "\n".join(lines)


def comparison_text(cheap: Trials, dear: Trials, touching: Mapping[str, SimulationReport]) -> str:
    """Return each reading's numbers of `COMPARED` in its model and in the continuous world.

    cheap, dear: trials at the wall costs 1 and 100.
    touching: reading -> episodes of the cheap trial's policy in a continuous world where touching
        anything on the way is a collision.
    """
    readings = [*READINGS, IN_BETWEEN]
    first, last = ([trials[r.name][COMPARED] for r in readings] for trials in (cheap, dear))
    promised = [t.evaluation.failure_probability for t in first]
    played = [t.world.failure_probability.value for t in first]
    touched = [touching[r.name].failure_probability.value for r in readings]
    rows = {
        "Failures, wall cost 1": [""] * len(readings),
        "  grid model, exact": [f"{share:.2%}" for share in promised],
        "  world, collisions as in the model": [f"{share:.2%}" for share in played],
        "  world, any touch is a collision": [f"{share:.2%}" for share in touched],
        "Collisions with the wall, exact": [""] * len(readings),
        "  of 100,000, wall cost 1": [_exact_count(t, "wall") for t in first],
        "  of 100,000, wall cost 100": [_exact_count(t, "wall") for t in last],
    }
    return "\n".join(
        [
            *_heading(f"{COMPARED}: what the models say, and what becomes of the robot"),
            *(f"{reading.name}: {reading.says}" for reading in readings),
            _row("", [reading.name for reading in readings], _READING_WIDTH),
            *(_row(words, cells, _READING_WIDTH).rstrip() for words, cells in rows.items()),
        ]
    )


def remarks(cheap: Trials, dear: Trials, touching: Mapping[str, SimulationReport]) -> str:
    """Return remarks on the relation of our numbers to the paper's.

    The arguments are those of `comparison_text`.
    """
    names = [reading.name for reading in (*READINGS, IN_BETWEEN)]
    lotteries = [cheap[name][COMPARED] for name in names]
    says = [f"{t.evaluation.failure_probability:.1%}" for t in lotteries]
    does = [f"{t.world.failure_probability.value:.1%}" for t in lotteries]
    touches = [f"{touching[name].failure_probability.value:.1%}" for name in names]
    walls = [[_exact_count(t[name][COMPARED], "wall") for t in (cheap, dear)] for name in names]
    paper_fails = [sum(PAPER[cost][COMPARED][1:]) / EPISODES for cost in (1.0, 100.0)]
    safest = [cheap[name]["S max"].evaluation.conditional_cost for name in names[:2]]
    points = [
        """The paper does not say how it computed transition probabilities or looked for collisions.
        "As in the paper" is a plain reading that reproduces its tables: the heading of a cell is
        its centre, positions are spread 4 x 4 over the cell, the steering error has 4 points, and
        collisions are looked for at 4 points along a step. (The paper's third column, headed
        pi_max^(S) once more, is pi_mod^(S).)""",
        f"""The columns "reconstruction" fit the tables; the paper does not state them. Its M mod
        fails in {paper_fails[0]:.2%} and {paper_fails[1]:.2%} of the episodes, where the discounted
        budget leaves room for {lotteries[0].evaluation.failure_probability:.2%}: it is not the
        optimum at c*. At a c above c* the optimal policy of the game (section 3.2) spends less than
        the budget: its cost is c / 0.05 (in S 0.95 c / 0.05) times its discounted failure. With
        c = 18 in S and c = 17 in M it has the costs and collisions of the tables.""",
        f"""The heading is what diffuses. From a wall cost of 1 to one of 100 the collisions of M
        mod with the wall fall from {walls[0][0]} to {walls[0][1]} of 100,000 with the heading at
        the centre of its cell, and with the heading spread over its cell, all else equal ("in
        between"), from {walls[2][0]} to {walls[2][1]}: a robot whose heading is drawn
        anew within 15 degrees at each step cannot keep off the wall. That a failing run pays the
        wall's cost only once is not the reason: it does so in every model here.""",
        f"""Least failure is decided by the rarest collisions that a model counts. "As in the paper"
        has a policy that never fails, at {safest[0]:.1f} steps; "as the robot moves" has none, and
        pays {safest[1]:.1f} steps for the safest one.""",
        f"""Which model is right about the robot? The real heading lies anywhere in its cell. Of M
        mod "as in the paper" says that {says[0]} fail, and {does[0]} do; "as the robot moves" says
        {says[1]}, and {does[1]} do. So the spread heading is the more honest model of steering: it
        errs on the safe side. Both look for collisions at too few points: where any touch counts,
        {touches[0]} and {touches[1]} fail. The spread heading with 4 points along a step ("in
        between") says {says[2]}, and {touches[2]} fail at any touch.""",
        f"""The discounted budget counts a success at step t as a failure of 1 - 0.999^t. So S mod
        and M mod really fail in {says[0]} of the episodes where 5 % are allowed; the columns "no
        discount" use the whole budget and are cheaper.""",
    ]
    texts = [" ".join(point.split()) for point in points]
    wrapped = [fill(t, 98, initial_indent="- ", subsequent_indent="  ") for t in texts]
    return "\n".join([*_heading("How these numbers relate to the paper's"), *wrapped])


def _heading(words: str) -> list[str]:
    return [words, "=" * len(words)]


def _row(label: str, cells: list[str], width: int = _COLUMN_WIDTH) -> str:
    return label.ljust(_LABEL_WIDTH) + "".join(cell.rjust(width) for cell in cells)


def _cells(columns: Sequence[_Column | None], of: Callable[[_Column], str]) -> list[str]:
    return ["-" if column is None else of(column) for column in columns]


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def _count(value: float | None) -> str:
    return "-" if value is None else f"{int(value):,}"


def _exact_count(trial: Trial, end: str) -> str:
    """Return a probability as an expected number of the paper's episodes."""
    return f"{trial.evaluation.ends.get(end, 0.0) * EPISODES:,.0f}"
