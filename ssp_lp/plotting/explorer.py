"""The explorer: a frontier as one page to play with, which needs neither a server nor a network.

A slider moves along the bound. Between two turning points the optimum is their lottery, drawn once
at the start, so that every probability and expectation on the page is linear in its weight: all
numbers are worked out here, at the turning points, and the page mixes two of them.
"""

from __future__ import annotations

import html
import json
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ssp_lp.analysis.evaluation import Evaluation, evaluate, pair_visits, success_costs
from ssp_lp.analysis.simulation import simulate
from ssp_lp.arrays import BoolArray, FloatArray, IntArray, segment_ids
from ssp_lp.errors import ModelError, check_whole, in_short, optional_module
from ssp_lp.methods.frontier import Frontier
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import end_marks
from ssp_lp.plotting.curves import INK, LOOKS
from ssp_lp.plotting.plane import Places, Point, cells_of, points_of, squares_of
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import start_distribution

LARGEST = 3_000_000
"""Bytes of a page: what is larger is slow to open."""

_BLUE, _RED, _GREEN = (look.colour for look in LOOKS[:3])
_FEW, _BARS = 12, 60  # of the law of the total cost, least and most
_UNSEEN = 1e-2  # share of the successes that are costlier than what is drawn
_BUDGETS = 200  # of the band between bounds
_MOST_DRAWN = 40  # states of a model that is drawn as a graph
_LONGEST = 300  # steps of a run that are drawn
_NEVER = 1e-12  # a probability that is the rounding of none
_RARE = 0.02  # of a place's visits: what is taken less often has no arrow
_FAINT = 0.25  # how visible the faintest arrow is
_REACH = 0.42  # of a cell's side: length of an arrow
_BESIDE, _FAN = 0.13, 0.5  # between a graph's arrows from state to state; of all of them at most
_LONG = 14  # characters of a name that is drawn
_SPREAD = 0.25  # of a cell's side: how far from its middle a run may be moved


@dataclass(frozen=True)
class Explorer:
    """A page: write it to a file, or show it in a notebook."""

    page: str  # HTML

    def write(self, path: str | Path) -> None:
        """Write the page; raise :class:`ModelError` unless the name ends in .html or .htm."""
        _check_page_name(path)
        Path(path).write_text(self.page, encoding="utf-8")

    def _repr_html_(self) -> str:
        """The page in a frame of its own, for notebooks."""
        frame = 'width="100%" height="900" style="border: 0"'
        return f'<iframe srcdoc="{html.escape(self.page)}" {frame}></iframe>'

    def __repr__(self) -> str:
        """One line."""
        return f"Explorer({len(self.page.encode()):,} bytes of HTML: write(path) keeps them)"


def _check_page_name(path: str | Path) -> None:
    """Raise :class:`ModelError` for the name of a file in which no browser looks for a page."""
    if Path(path).suffix not in (".html", ".htm"):
        raise ModelError(f"a page is written as .html, not {str(path)!r}")


@explained
def explore(
    frontier: Frontier,
    path: str | Path | None = None,
    *,
    cells: Places | None = None,
    moves: Places | None = None,
    walls: Iterable[Point] = (),
    episodes: int = 20,
    seed: int = 0,
) -> Explorer:
    """A page on which a slider moves along a frontier.

    It shows the objective, the price, the lottery, how that fails, and the law of its cost; where
    states have places, what it does in each, how often it is there, and sample runs; else, of a
    small model, its graph. Everything is worked out at the turning points, each of which has its
    policy evaluated: ``trace_frontier(point_limit=50)`` keeps the page small.

    Args:
        frontier: from ``trace_frontier``.
        path: where to write the page; None: nowhere.
        cells: the (x, y) of a state, the middle of a unit square; None: the state itself, where it
            is a pair of numbers.
        moves: the (dx, dy) that an action aims at; None: where it leads in the mean.
        walls: middles of squares that are no states.
        episodes: sample runs.
        seed: of the runs.

    Raises:
        MissingDependencyError: bokeh is not installed.
        ModelError: no frontier of a problem, or a page that would be too large.

    Example:
        >>> from ssp_lp import MCMP, SSP, trace_frontier
        >>> model = SSP.from_transitions(
        ...     {"s": {"road": [(0.99, "g", 9.0), (0.01, "d", 5.0)],
        ...            "alley": [(0.9, "g", 4.0), (0.1, "d", 2.0)]}, "d": {}},
        ...     goal={"g"}, treat_actionless_as_dead_ends=True)
        >>> page = explore(trace_frontier(MCMP(model, "s")))
    """
    check_whole("episodes", episodes, 0)
    if not isinstance(frontier, Frontier) or frontier.problem is None:
        told = f"explore takes a frontier of a problem, not {in_short(frontier)}"
        raise ModelError(f"{told}; trace_frontier(problem) makes one")
    if path is not None:
        _check_page_name(path)
    plotting, problem = optional_module("bokeh.plotting", "explore"), frontier.problem
    policies = [frontier.policy_at(float(spent)) for spent in frontier.spent]
    evaluations = [evaluate(policy, problem) for policy in policies]
    data = _numbers(frontier, evaluations)
    figures = {
        "frontier": _frontier_figure(plotting, frontier),
        "ends": _ends_figure(plotting, data),
    }
    in_region = frontier.spent <= frontier.region[1]
    if (law := _laws(policies, problem, in_region)) is not None:
        data["law"], figures["law"] = law, _law_figure(plotting, law)
    points, is_graph = _places(problem, cells), cells is None and not _are_points(problem.model)
    if points is not None:
        plane = _plane(policies, problem, points, moves, is_graph=is_graph)
        figures["plane"] = _plane_figure(plotting, problem, points, plane, list(walls))
        data["plane"] = plane
        if not is_graph:
            data |= _runs(policies, problem, points, episodes, seed)
            figures["runs"] = _runs_figure(plotting, problem, points, list(walls))
    page = _page(frontier, data, figures)
    if len(page.encode()) > LARGEST:
        raise ModelError(
            f"a page of {len(page.encode()):,} bytes is too large to open with ease: trace the "
            "frontier with a smaller point_limit"
        )
    explorer = Explorer(page)
    if path is not None:
        explorer.write(path)
    return explorer


def _numbers(frontier: Frontier, evaluations: list[Evaluation]) -> dict[str, Any]:
    """What is told of each turning point."""
    names = list(dict.fromkeys(name for found in evaluations for name in found.ends))
    names = [
        name for name in names if any(found.ends.get(name, 0.0) > _NEVER for found in evaluations)
    ]
    reached = np.array([found.goal_probability for found in evaluations])
    paid = np.array([found.conditional_cost for found in evaluations])
    region, spent = frontier.region, frontier.spent
    problem = frontier.problem if frontier.over == "failure" else None
    asked = None if problem is None else problem.failure_budget
    begin = region[0] + 0.5 * (region[1] - region[0]) if asked is None else asked
    quantities = evaluations[0].secondary_costs
    return {
        "over": frontier.over,
        "ratio": frontier.ratio,
        "spent": spent.tolist(),
        "goal": frontier.goal.tolist(),
        "cost": frontier.cost.tolist(),
        "failure": frontier.failure.tolist(),
        "price": frontier.price.tolist(),
        "region": list(region),
        "begin": float(f"{np.clip(begin, spent[0], spent[-1]):.4g}"),
        "failing": [found.failure_probability for found in evaluations],
        "reached": reached.tolist(),
        "paid": np.where(reached > 0.0, paid * reached, 0.0).tolist(),
        "end_names": [name.replace("_", " ") for name in names],
        "ends": [[found.ends.get(name, 0.0) for name in names] for found in evaluations],
        "quantities": {
            name: [found.secondary_costs[name] for found in evaluations] for name in quantities
        },
    }


def _laws(
    policies: list[MixedPolicy], problem: Problem, in_region: BoolArray
) -> dict[str, Any] | None:
    """How likely each total cost is together with success, in bars that all points share.

    None where the goal is never reached, or costs are too many to follow.
    """
    try:
        laws = [success_costs(policy, problem) for policy in policies]
        atoms = [law.all_but(_UNSEEN * law.goal) if law.goal > 0.0 else None for law in laws]
    except ModelError:
        return None
    shown = [one.costs for one, shows in zip(atoms, in_region, strict=True) if one and shows]
    costs = np.unique(np.concatenate([*shown, []]))
    if not costs.size:
        return None
    width = float(np.diff(costs).min(initial=np.inf)) if len(costs) > 1 else 1.0
    width = max(min(width, np.ptp(costs) / _FEW or width), np.ptp(costs) / _BARS)
    edges = np.arange(costs[0] - 0.5 * width, costs[-1] + width, width)
    none = np.zeros(len(edges) - 1)
    mass = [
        none if one is None else np.histogram(one[0], edges, weights=one[1])[0] for one in atoms
    ]
    rows = [_short(row) for row in mass]
    return {"left": edges[:-1].tolist(), "right": edges[1:].tolist(), "mass": rows}


def _short(numbers: FloatArray) -> list[float]:
    """Numbers that are drawn, with as many digits as a picture shows."""
    return [float(f"{x:.6g}") for x in numbers.tolist()]


def _are_points(model: SSP) -> bool:
    """Whether most states are pairs of numbers: places in the plane."""
    return sum(map(_is_point, model.states)) > 0.5 * model.n_states


def _is_point(state: object) -> bool:
    """Whether a state is a pair of numbers."""
    return (
        isinstance(state, tuple)
        and len(state) == 2
        and all(isinstance(x, int | float) and not isinstance(x, bool) for x in state)
    )


def _places(problem: Problem, cells: Places | None) -> FloatArray | None:
    """Where each state is drawn, nan where nowhere, [states, 2]; None: the model is too large."""
    model = problem.model
    if cells is not None:
        return cells_of(model, cells)
    if _are_points(model):
        return points_of(model.states, lambda state: state if _is_point(state) else None)
    return _layout(problem) if model.n_states <= _MOST_DRAWN else None


def _placed(points: FloatArray) -> BoolArray:
    """Which states lie somewhere, [states]."""
    return np.asarray(~np.isnan(points).any(axis=1))


def _layout(problem: Problem) -> FloatArray:
    """States of a small model by how many steps they are from the start, [states, 2]."""
    model, begun = problem.model, start_distribution(problem.model, problem.start) > 0.0
    steps = np.where(begun, 0, -1)
    queue = deque(np.flatnonzero(begun).tolist())
    ends, pairs = model.outcome_offsets, model.pair_offsets
    while queue:
        state = queue.popleft()
        for after in model.successors[ends[pairs[state]] : ends[pairs[state + 1]]].tolist():
            if steps[after] < 0:
                steps[after] = steps[state] + 1
                queue.append(after)
    points = np.full((model.n_states, 2), np.nan)
    for step in range(int(steps.max()) + 1):
        here = np.flatnonzero(steps == step)
        points[here, 0] = 1.6 * step
        points[here, 1] = 0.5 * (len(here) - 1) - np.arange(len(here)) + 0.15 * (step % 2)
    return points


def _plane(
    policies: list[MixedPolicy],
    problem: Problem,
    points: FloatArray,
    moves: Places | None,
    *,
    is_graph: bool,
) -> dict[str, Any]:
    """Visits of each place, and how much goes along each arrow, at each turning point."""
    model, known = problem.model, _placed(points)
    middles, inverse = np.unique(points[known], axis=0, return_inverse=True)
    place = np.full(model.n_states, -1)
    place[known] = inverse.reshape(-1)
    owner, outcome_pair = segment_ids(model.pair_offsets), segment_ids(model.outcome_offsets)
    if is_graph:  # an arrow for each action's way from state to state, else one for each action
        source, to = owner[outcome_pair], place[model.successors]
        aim, share = points[model.successors] - points[source], model.probabilities
    else:
        aim, source = _aims(model, points, moves), owner
        outcome_pair = np.arange(model.n_pairs, dtype=outcome_pair.dtype)
        share, to = np.ones(model.n_pairs), place[source]
    length = np.hypot(*aim.T)
    drawn = np.flatnonzero((place[source] >= 0) & (length > 1e-9))
    keys = np.stack([place[source], to, model.pair_action[outcome_pair]], axis=1)
    arrows, arrow = np.unique(keys[drawn], axis=0, return_inverse=True)
    arrow = arrow.reshape(-1)
    visits, flows = np.zeros((len(policies), len(middles))), np.zeros((len(policies), len(arrows)))
    for k, policy in enumerate(policies):
        pairs, gave_up = pair_visits(policy, problem)
        of_state = gave_up + np.bincount(owner, pairs, model.n_states)
        visits[k] = np.bincount(inverse.reshape(-1), of_state[known], len(middles))
        flows[k] = np.bincount(arrow, (pairs[outcome_pair] * share)[drawn], len(arrows))
    mean = np.stack(
        [np.bincount(arrow, aim[drawn, axis], len(arrows)) for axis in range(2)], axis=1
    )
    used = (flows.max(axis=0, initial=0.0) > 1e-9) & (np.hypot(*mean.T) > 1e-9)
    mean, arrows = mean[used], arrows[used]
    toward = mean / np.hypot(*mean.T)[:, None]
    begin, end = middles[arrows[:, 0]], middles[arrows[:, 0]] + _REACH * toward
    if is_graph:
        # what goes back takes the other side; actions between two states lie beside each other
        _, way, count = np.unique(arrows[:, :2], axis=0, return_inverse=True, return_counts=True)
        way = way.reshape(-1)
        rank = np.arange(len(arrows)) - np.searchsorted(way, way)
        gap = 0.07 + np.minimum(_BESIDE, _FAN / count[way]) * rank
        aside = gap[:, None] * toward[:, ::-1] * [-1.0, 1.0]
        end = middles[arrows[:, 1]] - 0.2 * toward + aside
        begin = begin + 0.2 * toward + aside
    return {
        "middles": middles,
        "begin": begin,
        "end": end,
        "names": [str(model.action_names[k]) for k in arrows[:, 2].tolist()],
        "is_graph": is_graph,
        "from": arrows[:, 0].tolist(),
        "visits": [_short(row) for row in visits],
        "flow": [_short(row) for row in flows[:, used]],
        "rare": _RARE,
        "faint": _FAINT,
    }


def _aims(model: SSP, points: FloatArray, moves: Places | None) -> FloatArray:
    """Where the action of each pair aims, [pairs, 2]: as told, or where it leads in the mean."""
    if moves is not None:
        return np.nan_to_num(points_of(model.action_names, moves))[model.pair_action]
    pair = segment_ids(model.outcome_offsets)
    step = points[model.successors] - points[segment_ids(model.pair_offsets)[pair]]
    step = np.nan_to_num(step) * model.probabilities[:, None]
    return np.stack([np.bincount(pair, step[:, axis], model.n_pairs) for axis in range(2)], axis=1)


def _runs(
    policies: list[MixedPolicy], problem: Problem, points: FloatArray, episodes: int, seed: int
) -> dict[str, Any]:
    """Sample runs at each turning point, as numbers of states."""
    model, marks = problem.model, end_marks(problem.model)
    words = ["goal", *model.state_labels, "dead-end", "gave up, or goes on"]
    placed = _placed(points)

    def told(path: IntArray) -> dict[str, Any]:
        """One run."""
        mark = int(marks[int(path[-1])])
        steps = path[placed[path]][:_LONGEST]
        return {"path": steps.tolist(), "goal": mark == 0, "end": words[mark]}

    runs = []
    for policy in policies:
        played = simulate(policy, problem, episodes=max(episodes, 1), seed=seed, record=episodes)
        runs.append([told(path) for path in played.paths])
    aside = np.random.default_rng(seed).uniform(-_SPREAD, _SPREAD, (episodes, 2))
    where = np.where(placed[:, None], points, 0.0)
    return {"runs": runs, "points": where.tolist(), "aside": aside.tolist()}


def _figure(plotting: Any, x: str, y: str, height: int = 320, **more: Any) -> Any:
    """A figure as wide as its panel."""
    found = plotting.figure(
        height=height, sizing_mode="stretch_width", x_axis_label=x, y_axis_label=y,
        toolbar_location=None, tools="", **more,
    )  # fmt: skip
    found.grid.grid_line_color = "#e5e5e5"
    found.outline_line_color = None
    found.axis.minor_tick_line_color = None
    return found


def _frontier_figure(plotting: Any, frontier: Frontier) -> Any:
    """The curve, its turning points, the band where tracing was cut short, and where we are."""
    models, region = optional_module("bokeh.models", "explore"), frontier.region
    success = " given success" if frontier.ratio else ""
    y = f"objective{success}"
    ranges = {"x_range": models.Range1d(name="across"), "y_range": models.Range1d(name="up")}
    figure = _figure(plotting, frontier.axis, y, **ranges)
    budgets = np.union1d(
        np.linspace(frontier.spent[0], frontier.spent[-1], _BUDGETS), frontier.spent
    )
    budgets = np.union1d(budgets, np.linspace(*region, _BUDGETS))
    low, high = np.array([frontier.bounds_at(float(b)) for b in budgets]).T
    if frontier.open_segments:
        figure.varea(budgets, low, high, fill_color=_BLUE, fill_alpha=0.2)
    attained = low if frontier.maximises else high
    figure.line(budgets, attained, line_color=_BLUE, line_width=2)
    figure.scatter(frontier.spent, frontier.objective, color=_BLUE, size=5)
    here = models.ColumnDataSource({"x": [], "y": []}, name="here")
    figure.scatter("x", "y", source=here, marker="star", size=18, color=_RED, line_color=INK)
    return figure


def _ends_figure(plotting: Any, data: dict[str, Any]) -> Any:
    """How episodes end, a bar each."""
    models, names = optional_module("bokeh.models", "explore"), data["end_names"]
    source = models.ColumnDataSource({"end": [], "share": [], "told": []}, name="ends")
    across = models.Range1d(0.0, 1.28)
    figure = _figure(plotting, "probability", "", 70 + 34 * len(names),
                     y_range=names[::-1], x_range=across)  # fmt: skip
    figure.xaxis.ticker = [0.0, 0.25, 0.5, 0.75, 1.0]
    figure.ygrid.grid_line_color = None
    figure.hbar(
        y="end", right="share", height=0.6, source=source, fill_color=_BLUE, line_color=None
    )
    figure.text(x="share", y="end", text="told", source=source, x_offset=6, text_baseline="middle",
                text_font_size="12px", text_color=INK)  # fmt: skip
    return figure


def _law_figure(plotting: Any, law: dict[str, Any]) -> Any:
    """The law of the total cost given success."""
    models = optional_module("bokeh.models", "explore")
    source = models.ColumnDataSource({"left": [], "right": [], "share": []}, name="law")
    figure = _figure(plotting, "total cost", "probability given success",
                     x_range=models.Range1d(law["left"][0], law["right"][-1], name="costs"),
                     )  # fmt: skip
    figure.y_range.start = 0.0
    figure.quad(left="left", right="right", top="share", bottom=0, source=source,
                fill_color="#b5d6ea", line_color=_BLUE)  # fmt: skip
    return figure


def _ground(
    plotting: Any, problem: Problem, points: FloatArray, walls: list[Point], graph: bool = False
) -> Any:
    """Places with goals, dead-ends, walls and the start."""
    known = _placed(points)
    everything = np.vstack([points[known], *np.array(walls, dtype=float).reshape(-1, 2)])
    low, high = everything.min(axis=0) - 0.7, everything.max(axis=0) + 0.7
    height = int(np.clip(440 * (high - low)[1] / (high - low)[0], 200, 520))
    figure = _figure(plotting, "", "", height, x_range=(low[0], high[0]), y_range=(low[1], high[1]),
                     match_aspect=not graph)  # fmt: skip
    figure.axis.visible, figure.grid.grid_line_color = False, None
    side = 0.36 if graph else 1.0
    looks = (
        ("#d0d0d0", "white", 1.0),
        (_RED, "#f3d9c9", 1.0),
        (_GREEN, "#d5efe6", 2.0),
        (INK, None, 2.0),
    )
    for squares, (line, fill, width) in zip(squares_of(problem, points), looks, strict=True):
        x, y = np.array(sorted(squares), dtype=float).reshape(-1, 2).T
        inner = side * (0.9 if fill is None else 1.0)
        level = "overlay" if fill is None else "glyph"
        figure.rect(x, y, inner, inner, line_color=line, fill_color=fill, line_width=width,
                    level=level)  # fmt: skip
    if walls:
        x, y = np.array(walls, dtype=float).T
        figure.rect(x, y, 1.0, 1.0, line_color="#595959", fill_color="#595959")
    return figure


def _plane_figure(
    plotting: Any, problem: Problem, points: FloatArray, plane: dict[str, Any], walls: list[Point]
) -> Any:
    """What is done in each place, and how often it is visited; what was drawn leaves the data."""
    models, graph = optional_module("bokeh.models", "explore"), plane.pop("is_graph")
    figure = _ground(plotting, problem, points, walls, graph)
    (x, y), begin, end = plane.pop("middles").T, plane.pop("begin"), plane.pop("end")
    none = np.zeros(len(x))
    columns = {"x": x, "y": y, "alpha": none, "visits": none, "told": [""] * len(x)}
    visits = models.ColumnDataSource(columns, name="visits")
    side, angle = 0.34 if graph else 0.98, np.arctan2(*(end - begin).T[::-1]) - 0.5 * np.pi
    shades = figure.rect("x", "y", side, side, source=visits, fill_color="#6baed6", line_color=None,
                         fill_alpha="alpha")  # fmt: skip
    columns = {"x0": begin[:, 0], "y0": begin[:, 1], "x1": end[:, 0], "y1": end[:, 1]}
    columns |= {"angle": angle, "alpha": 0.0 * angle, "action": plane.pop("names")}
    columns |= {"told": [""] * len(angle), "seen": 0.0 * angle}
    arrows = models.ColumnDataSource(columns, name="arrows")
    shafts = figure.segment("x0", "y0", "x1", "y1", source=arrows, line_alpha="alpha",
                            line_color=INK, line_width=2)  # fmt: skip
    figure.scatter("x1", "y1", angle="angle", marker="triangle", size=8, source=arrows, color=INK,
                   alpha="alpha")  # fmt: skip
    if graph:
        known = _placed(points)
        names = [str(problem.model.states[k])[:_LONG] for k in np.flatnonzero(known).tolist()]
        figure.text(*(points[known] - [0.0, 0.2]).T, names, text_align="center",
                    text_baseline="top", text_font_size="11px", text_color=INK)  # fmt: skip
        arrows.data["name"] = [name[:_LONG] for name in arrows.data["action"]]
        arrows.data["x"], arrows.data["y"] = (0.6 * begin + 0.4 * end).T
        figure.text("x", "y", "name", source=arrows, text_align="center", text_baseline="middle",
                    text_font_size="11px", text_color=_BLUE, text_alpha="seen",
                    background_fill_color="white", background_fill_alpha="seen")  # fmt: skip
    for drawn, tip in (
        (shades, [("expected visits", "@told")]),
        (shafts, [("action", "@action"), ("expected times", "@told")]),
    ):
        figure.add_tools(models.HoverTool(renderers=[drawn], tooltips=tip))
    return figure


def _runs_figure(plotting: Any, problem: Problem, points: FloatArray, walls: list[Point]) -> Any:
    """Sample runs."""
    models = optional_module("bokeh.models", "explore")
    figure = _ground(plotting, problem, points, walls)
    source = models.ColumnDataSource({"xs": [], "ys": [], "colour": [], "end": []}, name="runs")
    lines = figure.multi_line("xs", "ys", source=source, line_color="colour", line_width=1.5,
                              line_alpha=0.6)  # fmt: skip
    figure.add_tools(models.HoverTool(renderers=[lines], tooltips=[("ends", "@end")]))
    return figure


_HEADS = {
    "ends": ("How it ends", ""),
    "law": ("The law of its cost", "at most one success in a hundred costs more than the last bar"),
    "plane": ("What it does, and how often it is there", "green: goal; orange: dead-end; framed: "
              "start; the darker, the more visits"),
    "runs": ("Sample runs", "blue ones reach the goal, orange ones do not"),
}  # fmt: skip


def _page(frontier: Frontier, data: dict[str, Any], figures: dict[str, Any]) -> str:
    """The page as HTML."""
    embed, resources = (
        optional_module(f"bokeh.{part}", "explore") for part in ("embed", "resources")
    )
    script, divs = embed.components(figures)
    more = "".join(
        f"<section><h2>{head}</h2>{note and f'<p class=note>{note}</p>'}{divs[name]}</section>"
        for name, (head, note) in _HEADS.items()
        if name in figures
    )
    problem = frontier.problem
    title = f"{type(problem).__name__}: {'objective' if frontier.maximises else 'least cost'}"
    title = f"{title} against {frontier.axis}"
    template = Template(files("ssp_lp.plotting").joinpath("explorer.html").read_text("utf-8"))
    return template.substitute(
        title=html.escape(title),
        note=html.escape(f"{problem!r}; {frontier._title}"),
        axis=html.escape(frontier.axis),
        over=html.escape(frontier.over),
        resources=resources.Resources(mode="inline", components=["bokeh"]).render(),
        frontier=divs["frontier"],
        more=more,
        script=script,
        data=json.dumps(data).replace("</", "<\\/"),
    )
