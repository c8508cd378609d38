"""``ssp-lp frontier``: the least cost for every failure budget at once."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable

from formulations.command_line.criteria import problem_of
from formulations.command_line.models import setting_of
from formulations.command_line.pictures import figure_for
from formulations.command_line.tables import aligned, as_json
from ssp_lp import trace_frontier
from ssp_lp.plotting import plot_frontier

COLUMNS = ("failure", "goal", "cost", "objective", "price")


def run(asked: Namespace) -> Iterable[str]:
    """What is printed."""
    figure = figure_for(asked.plot)
    gap = {} if asked.gap is None else {"gap": asked.gap}
    traced = trace_frontier(
        problem_of(asked, setting_of(asked)),
        point_limit=asked.points,
        time_limit=asked.time_limit,
        **gap,
    )
    if figure is not None:
        plot_frontier(traced, asked.failure_budget, ax=figure.subplots())
        figure.savefig(asked.plot)
    prices = [*traced.price.tolist(), None]
    numbers = (traced.failure, traced.goal, traced.cost, traced.objective)
    rows = list(zip(*(column.tolist() for column in numbers), prices, strict=True))
    if asked.json:
        points = [dict(zip(COLUMNS, row, strict=True)) for row in rows]
        return as_json({"gap": traced.gap, "complete": traced.complete, "points": points})
    if asked.csv:
        cells = [["" if x is None else repr(x) for x in row] for row in rows]
        return [",".join(line) for line in (COLUMNS, *cells)]
    cells = [["-" if x is None else f"{x:.6g}" for x in row] for row in rows]
    return [*aligned(COLUMNS, cells), f"gap {traced.gap:.1e}"]
