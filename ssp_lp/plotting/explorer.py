"""The explorer: a frontier as an interactive page, without a server or a network.

A slider moves along the values of the bound, such as the failure budget. Between two turning points
of the frontier the optimum is a lottery over the policies of both, of which one is drawn at the
start of an episode. So every probability and expectation on the page is linear in the weight of a
policy: numbers are computed here at the turning points, and the page interpolates between them.
"""

from __future__ import annotations

import html
import json
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import scipy.sparse as sp

from ssp_lp.analysis.evaluation import Evaluation, evaluate, pair_visits, success_costs
from ssp_lp.analysis.simulation import simulate
from ssp_lp.arrays import BoolArray, FloatArray, IntArray, segment_ids
from ssp_lp.errors import ModelError, check_whole, in_short
from ssp_lp.methods.frontier import Frontier
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import end_marks
from ssp_lp.plotting import plane
from ssp_lp.plotting.curves import bounds_along
from ssp_lp.plotting.plane import Places, Point
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem

LARGEST = 3_000_000
"""Greatest number of bytes of a page: larger ones are slow to open."""

_UNSEEN = 1e-2  # share of the successes with greater costs than those drawn
_AROUND = 0.7  # beyond the middles of the outermost cells
_SPREAD = 0.25  # of a cell's side: greatest offset of a run from its middle


@dataclass(frozen=True)
class Explorer:
    """A page to write to a file, or to show in a notebook."""

    page: str  # HTML

    def write(self, path: str | Path) -> None:
        """Write the page to a file whose name ends in .html or .htm."""
        _check_page_name(path)
        Path(path).write_text(self.page, encoding="utf-8")

    def _repr_html_(self) -> str:
        """Return the page in an HTML frame, for notebooks."""
        frame = 'width="100%" height="900" style="border: 0"'
        return f'<iframe srcdoc="{html.escape(self.page)}" {frame}></iframe>'

    def __repr__(self) -> str:
        """Return a line with the size of the page."""
        return f"Explorer({len(self.page.encode()):,} bytes of HTML: write(path) keeps them)"


def _check_page_name(path: str | Path) -> None:
    """Raise :class:`ModelError` unless the name of a file ends in .html or .htm."""
    if Path(path).suffix not in (".html", ".htm"):
        raise ModelError(f"a page's name must end in .html, not {str(path)!r}")


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
    """Return a page on which a slider moves along a frontier.

    The page shows the objective, the price, the lottery, how its runs end, and the distribution of
    its cost. If states have places in the plane, it also shows the decisions and visits in each
    place, and sample runs; otherwise, for a small model, its graph. The policies are evaluated at
    all turning points: ``trace_frontier(point_limit=50)`` keeps the page small.

    Args:
        frontier: result of ``trace_frontier``.
        path: file of the page; None: no file.
        cells: the point (x, y) of each state, the middle of a unit square; None: a state that is a
            pair of numbers is its own point.
        moves: the direction (dx, dy) of each action; None: the mean displacement by the action.
        walls: middles of unit squares that are walls, not states.
        episodes: number of sample runs at each turning point.
        seed: seed of the runs.

    Raises:
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
        message = f"explore() takes a frontier of a problem, not {in_short(frontier)}"
        raise ModelError(f"{message}; trace_frontier(problem) makes one")
    if path is not None:
        _check_page_name(path)
    problem = frontier.problem
    policies = [frontier.policy_at(float(spent)) for spent in frontier.spent]
    data = _numbers(frontier, problem, [evaluate(policy, problem) for policy in policies])
    budgets, low, high = bounds_along(frontier)
    data["curve"] = {
        "budgets": budgets.tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "objective": frontier.objective.tolist(),
        "is_open": bool(frontier.open_segments),
        "maximises": frontier.maximises,
    }
    data["law"] = _laws(policies, problem, frontier.spent <= frontier.region[1])
    points, is_graph = _places(problem, cells), cells is None and not _are_points(problem.model)
    if points is not None:
        data["ground"] = _ground(problem, points, [*walls], is_graph=is_graph)
        data["plane"] = _plane(policies, problem, points, moves, is_graph=is_graph)
        if not is_graph:
            data |= _runs(policies, problem, points, episodes, seed)
    page = _page(frontier, data)
    if len(page.encode()) > LARGEST:
        raise ModelError(
            f"a page of {len(page.encode()):,} bytes is too large to open quickly: trace the "
            "frontier with a smaller point_limit"
        )
    explorer = Explorer(page)
    if path is not None:
        explorer.write(path)
    return explorer


def _numbers(frontier: Frontier, problem: Problem, evaluations: list[Evaluation]) -> dict[str, Any]:
    """Return the numbers that the page shows at turning points, as a list for each name."""
    listed = (entry for each in evaluations for entry in each.ends.items())
    names = list(dict.fromkeys(name for name, share in listed if share > 1e-12))  # else rounding
    reached = np.array([each.goal_probability for each in evaluations])
    paid = np.array([each.conditional_cost for each in evaluations])
    region, spent = frontier.region, frontier.spent
    begin = problem.failure_budget if frontier.over == "failure" else None
    begin = 0.5 * sum(region) if begin is None else begin
    return {
        "over": frontier.over,
        "axis": frontier.axis,
        "ratio": frontier.ratio,
        "spent": spent.tolist(),
        "goal": frontier.goal.tolist(),
        "cost": frontier.cost.tolist(),
        "failure": frontier.failure.tolist(),
        "price": frontier.price.tolist(),
        "region": list(region),
        "begin": float(f"{np.clip(begin, spent[0], spent[-1]):.4g}"),
        "failing": [each.failure_probability for each in evaluations],
        "reached": reached.tolist(),
        "paid": np.where(reached > 0.0, paid * reached, 0.0).tolist(),
        "end_names": [name.replace("_", " ") for name in names],
        "ends": [[each.ends.get(name, 0.0) for name in names] for each in evaluations],
        "quantities": {
            name: [each.secondary_costs[name] for each in evaluations]
            for name in evaluations[0].secondary_costs
        },
    }


def _laws(
    policies: list[MixedPolicy], problem: Problem, in_region: BoolArray
) -> dict[str, Any] | None:
    """Return the bars of the cost distribution at each turning point, all with the same edges.

    None if the goal is never reached, or if there are too many distinct costs.
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
    span = float(np.ptp(costs))
    width = max(min(width, span / 12 or width), span / 60)  # 12 to 60 bars
    edges = np.arange(costs[0] - 0.5 * width, costs[-1] + width, width)
    none = np.zeros(len(edges) - 1)
    mass = [
        none if one is None else np.histogram(one[0], edges, weights=one[1])[0] for one in atoms
    ]
    rows = [_short(row) for row in mass]
    return {"left": edges[:-1].tolist(), "right": edges[1:].tolist(), "mass": rows}


def _short(numbers: FloatArray) -> list[float]:
    """Return numbers rounded to six significant digits."""
    return [float(f"{x:.6g}") for x in numbers.tolist()]


def _are_points(model: SSP) -> bool:
    """Return whether most states are pairs of numbers, which are points in the plane."""
    return sum(map(_is_point, model.states)) > 0.5 * model.n_states


def _is_point(state: object) -> bool:
    """Return whether a state is a pair of numbers."""
    return (
        isinstance(state, tuple)
        and len(state) == 2
        and all(isinstance(x, int | float) and not isinstance(x, bool) for x in state)
    )


def _places(problem: Problem, cells: Places | None) -> FloatArray | None:
    """Return the point of each state, nan for a state without one, [states, 2].

    The result is None if no state has a point, and the model is too large to be drawn as a graph.
    """
    model = problem.model
    if cells is not None:
        return plane.cells_of(model, cells)
    if _are_points(model):
        return plane.points_of(model.states, lambda state: state if _is_point(state) else None)
    return _layout(problem) if model.n_states <= 40 else None


def _layout(problem: Problem) -> FloatArray:
    """Return a point for each state of a graph, [states, 2].

    States stand in columns by their distance from the start, in steps; nan if it is infinite.
    """
    model = problem.model
    begun = np.flatnonzero(problem.start_mass > 0.0)
    rows = segment_ids(model.pair_offsets)[segment_ids(model.outcome_offsets)]
    shape = model.n_states, model.n_states
    links = sp.csr_array((np.ones(model.n_outcomes), (rows, model.successors)), shape=shape)
    steps: FloatArray = sp.csgraph.dijkstra(links, indices=begun, unweighted=True, min_only=True)
    points = np.full((model.n_states, 2), np.nan)
    for step in range(int(steps[np.isfinite(steps)].max()) + 1):
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
    """Return the visits of each cell and the flow along each arrow, at each turning point.

    The flow along an arrow is the expected number of times that its action is taken.
    """
    model, (middles, place) = problem.model, plane.distinct_points(points)
    known = place >= 0
    owner, outcome_pair = segment_ids(model.pair_offsets), segment_ids(model.outcome_offsets)
    source = owner[outcome_pair]
    # in a graph an arrow for each action and successor, otherwise one for each action, as given or
    # along its mean displacement
    to = place[model.successors] if is_graph else place[source]
    if moves is None or is_graph:
        aim = points[model.successors] - points[source]
    else:
        aim = plane.points_of(model.action_names, moves)[model.pair_action][outcome_pair]
    aim = np.nan_to_num(aim) * model.probabilities[:, None]
    drawn = np.flatnonzero(place[source] >= 0)
    keys = np.stack([place[source], to, model.pair_action[outcome_pair]], axis=1)
    arrows, arrow = np.unique(keys[drawn], axis=0, return_inverse=True)
    arrow = arrow.reshape(-1)
    visits, flows = np.zeros((len(policies), len(middles))), np.zeros((len(policies), len(arrows)))
    for k, policy in enumerate(policies):
        pairs, gave_up = pair_visits(policy, problem)
        of_state = gave_up + np.bincount(owner, pairs, model.n_states)
        visits[k] = np.bincount(place[known], of_state[known], len(middles))
        taken = (pairs[outcome_pair] * model.probabilities)[drawn]
        flows[k] = np.bincount(arrow, taken, len(arrows))
    mean = np.zeros((len(arrows), 2))
    np.add.at(mean, arrow, aim[drawn])
    used = (flows.max(axis=0, initial=0.0) > 1e-9) & (np.hypot(*mean.T) > 1e-9)
    mean, arrows = mean[used], arrows[used]
    toward = mean / np.hypot(*mean.T)[:, None]
    begin, end = middles[arrows[:, 0]], middles[arrows[:, 0]] + 0.42 * toward
    if is_graph:
        # arrows back take the other side; actions between two states are drawn side by side
        _, way, count = np.unique(arrows[:, :2], axis=0, return_inverse=True, return_counts=True)
        way = way.reshape(-1)
        rank = np.arange(len(arrows)) - np.searchsorted(way, way)
        gap = 0.07 + np.minimum(0.13, 0.5 / count[way]) * rank
        aside = gap[:, None] * toward[:, ::-1] * [-1.0, 1.0]
        end = middles[arrows[:, 1]] - 0.2 * toward + aside
        begin = begin + 0.2 * toward + aside
    return {
        "middles": middles.tolist(),
        "begin": begin.tolist(),
        "end": end.tolist(),
        "names": [str(model.action_names[k]) for k in arrows[:, 2].tolist()],
        "from": arrows[:, 0].tolist(),
        "visits": [_short(row) for row in visits],
        "flow": [_short(row) for row in flows[:, used]],
    }


def _runs(
    policies: list[MixedPolicy], problem: Problem, points: FloatArray, episodes: int, seed: int
) -> dict[str, Any]:
    """Return sample runs at each turning point, each with its path and its end."""
    model, marks = problem.model, end_marks(problem.model)
    words = ["goal", *model.state_labels, "dead-end", "gave up, or goes on"]
    placed = plane.with_point(points)

    def run_of(path: IntArray) -> dict[str, Any]:
        """Return the states of a path that have a point, and the end of the run."""
        mark = int(marks[int(path[-1])])
        steps = path[placed[path]][:300]  # longer lines hide the plane
        return {"path": steps.tolist(), "goal": mark == 0, "end": words[mark]}

    runs = []
    for policy in policies:
        played = simulate(policy, problem, episodes=max(episodes, 1), seed=seed, record=episodes)
        runs.append([run_of(path) for path in played.paths])
    aside = np.random.default_rng(seed).uniform(-_SPREAD, _SPREAD, (episodes, 2))
    where = np.where(placed[:, None], points, 0.0)
    return {"runs": runs, "points": where.tolist(), "aside": aside.tolist()}


def _ground(
    problem: Problem, points: FloatArray, walls: list[Point], *, is_graph: bool
) -> dict[str, Any]:
    """Return the squares of goals, dead-ends, walls and start, and in a graph the states' names."""
    known = plane.with_point(points)
    everything = np.vstack([points[known], *np.array(walls, dtype=float).reshape(-1, 2)])
    limits = [everything.min(axis=0) - _AROUND, everything.max(axis=0) + _AROUND]
    ground: dict[str, Any] = {
        "limits": np.transpose(limits).tolist(),
        "squares": plane.squares_of(problem, points, walls),
        "side": 0.36 if is_graph else 1.0,
    }
    if is_graph:
        names = [str(state)[:14] for state in problem.model.states]
        ground["names"] = [[names[k], *points[k].tolist()] for k in np.flatnonzero(known).tolist()]
    return ground


def _page(frontier: Frontier, data: dict[str, Any]) -> str:
    problem = frontier.problem
    title = f"{type(problem).__name__}: {'objective' if frontier.maximises else 'least cost'}"
    title = f"{title} against {frontier.axis}"
    template = Template(files("ssp_lp.plotting").joinpath("explorer.html").read_text("utf-8"))
    return template.substitute(
        title=html.escape(title),
        note=html.escape(f"{problem!r}; {frontier._title}"),
        axis=html.escape(frontier.axis),
        over=html.escape(frontier.over),
        data=json.dumps(data).replace("</", "<\\/"),
    )
