"""Plots of frontiers, policies, episodes, bounds and cost laws, and an interactive page."""

from ssp_lp.plotting.curves import (
    BoundsRecord,
    plot_bounds,
    plot_cost_law,
    plot_frontier,
    plot_parameter,
    plot_tornado,
)
from ssp_lp.plotting.explorer import Explorer, explore
from ssp_lp.plotting.plane import (
    plot_episodes,
    plot_grid_policy,
    plot_lottery,
    plot_paths,
    row_major,
)

__all__ = [
    "BoundsRecord",
    "Explorer",
    "explore",
    "plot_bounds",
    "plot_cost_law",
    "plot_episodes",
    "plot_frontier",
    "plot_grid_policy",
    "plot_lottery",
    "plot_parameter",
    "plot_paths",
    "plot_tornado",
    "row_major",
]
