"""Plots of frontiers, policies, episodes, bounds and cost laws, and an interactive page."""

from ssp_lp.plotting.curves import (
    BoundsRecord as BoundsRecord,
    plot_bounds as plot_bounds,
    plot_cost_law as plot_cost_law,
    plot_frontier as plot_frontier,
    plot_parameter as plot_parameter,
    plot_tornado as plot_tornado,
)
from ssp_lp.plotting.explorer import Explorer as Explorer, explore as explore
from ssp_lp.plotting.plane import (
    plot_episodes as plot_episodes,
    plot_grid_policy as plot_grid_policy,
    plot_lottery as plot_lottery,
    plot_paths as plot_paths,
    row_major as row_major,
)

__all__ = sorted(name for name, value in globals().items() if callable(value) and name[0] != "_")
