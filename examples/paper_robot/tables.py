"""The paper's Tables 1 and 2 beside what this library finds, as text."""

import math
from collections.abc import Mapping
from textwrap import fill

from examples.paper_robot.study import Trial
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

_LABEL_WIDTH, _COLUMN_WIDTH = 34, 11


def table_text(wall_cost: float, trials: list[Trial], episodes: int) -> str:
    """Return one table: a column per policy, the paper's rows first."""
    head = f"Stage cost after a collision with the wall: {wall_cost:g}"
    paper = PAPER.get(wall_cost, {})
    published = [paper.get(t.design.name) for t in trials]
    lines = [
        head,
        "=" * len(head),
        _row("", [t.design.name for t in trials]),
        "Paper, 100,000 episodes",
        _row("  conditional cost", [_fixed(p and p[0], 2) for p in published]),
        _row("  collisions with A, B", [_count(p and p[1]) for p in published]),
        _row("  collisions with the wall", [_count(p and p[2]) for p in published]),
        "Design, exact on the grid model",
        *_design_rows(trials),
        f"Grid model, {episodes:,} episodes",
        *_episode_rows([t.chain for t in trials]),
        f"Continuous world, {episodes:,} episodes",
        *_episode_rows([t.world for t in trials]),
    ]
    return "\n".join(lines)


def remarks(trials: dict[float, list[Trial]]) -> str:
    """Return why our numbers differ from the paper's, with the numbers that show it.

    trials: wall cost -> trials, for the wall costs 1 and 100.
    """
    cheap, dear = ({t.design.name: t for t in trials[cost]} for cost in (1.0, 100.0))
    safest, paper_safest = cheap["S max"].evaluation, PAPER[1.0]["S max"][0]
    lottery, charged = cheap["M mod"], dear["M mod"]
    walls = [t.evaluation.ends["wall"] for t in (lottery, charged)]
    price = charged.solution.failure_price or 0.0
    points = [
        """The paper does not say how it computed the transition probabilities of cells or how it
        detected collisions; nothing here is tuned to its tables. (Its third column, headed
        pi_max^(S) once more, is pi_mod^(S).)""",
        f"""Least failure is decided by the rarest collisions that a model still counts, so its cost
        hangs on those details. Ours counts collisions down to a failure probability of
        {safest.failure_probability:.1e} and pays {safest.conditional_cost:.1f} steps for it; the
        paper's policy takes {paper_safest:.1f}.""",
        f"""The grid model forgets where in its cell the robot stands, so its robot diffuses, also
        into the wall: of the same policy M mod it counts {lottery.chain.ends["wall"]:,} collisions
        with the wall, the continuous world {lottery.world.ends["wall"]:,}.""",
        f"""At a wall cost of 100 the paper's M mod has no wall collisions, ours has. The cost is
        charged once: in the design a collision with the wall costs {price + 100:.0f} (price of
        failure plus charge) where one with an obstacle costs {price + 1:.0f}. That is dear, not
        forbidden: the probability of hitting the wall falls from {walls[0]:.4f} to
        {walls[1]:.4f}.""",
        f"""The discounted budget counts a success at step t as a failure of 1 - 0.999^t. So S mod
        and M mod really fail in {lottery.evaluation.failure_probability:.1%} of the episodes where
        5 % are allowed; the columns "exact" use the whole budget and are cheaper.""",
    ]
    texts = [" ".join(point.split()) for point in points]
    wrapped = [fill(t, 98, initial_indent="- ", subsequent_indent="  ") for t in texts]
    return "\n".join(["Why these numbers differ from the paper's", *wrapped])


def _design_rows(trials: list[Trial]) -> list[str]:
    solutions, evaluations = [t.solution for t in trials], [t.evaluation for t in trials]
    return [
        _row("  objective c*", [_fixed(s.objective, 4) for s in solutions]),
        _row("  relative gap of the bound", [_power(s.gap) for s in solutions]),
        _row("  price of failure", [_fixed(s.failure_price, 2) for s in solutions]),
        _row("  deterministic policies mixed", [str(len(s.policy.policies)) for s in solutions]),
        _row("  failure probability", [_fixed(e.failure_probability, 6) for e in evaluations]),
        _row("  ... in collisions with A, B", [_end(e.ends, "obstacle") for e in evaluations]),
        _row("  ... in collisions with the wall", [_end(e.ends, "wall") for e in evaluations]),
        _row("  conditional cost", [_fixed(e.conditional_cost, 4) for e in evaluations]),
        _row("  seconds to solve", [_fixed(s.seconds, 2) for s in solutions]),
    ]


def _episode_rows(reports: list[SimulationReport]) -> list[str]:
    named = ("goal", "obstacle", "wall")
    others = [sum(n for end, n in r.ends.items() if end not in named) for r in reports]
    return [
        _row("  conditional cost", [_fixed(r.conditional_cost.value, 2) for r in reports]),
        _row("  collisions with A, B", [_count(r.ends.get("obstacle", 0)) for r in reports]),
        _row("  collisions with the wall", [_count(r.ends.get("wall", 0)) for r in reports]),
        _row("  any other failure", [_count(n) for n in others]),
    ]


def _row(label: str, cells: list[str]) -> str:
    return label.ljust(_LABEL_WIDTH) + "".join(cell.rjust(_COLUMN_WIDTH) for cell in cells)


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def _count(value: float | None) -> str:
    return "-" if value is None else f"{int(value):,}"


def _power(value: float) -> str:
    return f"{value:.1e}"


def _end(ends: Mapping[str, float], name: str) -> str:
    return _fixed(ends.get(name, 0.0), 6)
