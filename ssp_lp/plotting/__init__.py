"""Pictures of frontiers, policies, episodes, bounds and laws of costs, with matplotlib."""

from ssp_lp.plotting.bounds_plot import BoundsRecord, plot_bounds
from ssp_lp.plotting.cells import row_major
from ssp_lp.plotting.cost_law_plot import plot_cost_law
from ssp_lp.plotting.frontier_plot import plot_frontier
from ssp_lp.plotting.grid_policy_plot import plot_grid_policy, plot_lottery
from ssp_lp.plotting.paths_plot import plot_episodes, plot_paths

__all__ = [
    "BoundsRecord",
    "plot_bounds",
    "plot_cost_law",
    "plot_episodes",
    "plot_frontier",
    "plot_grid_policy",
    "plot_lottery",
    "plot_paths",
    "row_major",
]
