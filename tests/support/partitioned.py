"""A model in parts, by its own rows."""

from dataclasses import replace

import numpy as np

from ssp_lp.distributed import PartitionedModel, StateRows


def numbered(model):
    """The model with its states called by their numbers, as ranks call them."""
    return replace(model, states=range(model.n_states))


def partitioned(model):
    """A model of which each rank keeps its part."""

    def rows(first, end):
        """The rows of some states."""
        pairs = slice(*model.pair_offsets[[first, end]].tolist())
        own = slice(*model.outcome_offsets[[pairs.start, pairs.stop]].tolist())
        return StateRows(
            np.diff(model.pair_offsets)[first:end],
            np.diff(model.outcome_offsets)[pairs],
            model.successors[own],
            model.probabilities[own],
            model.costs[own],
            {name: costs[own] for name, costs in model.named_costs.items()},
        )

    goals, labels = np.flatnonzero(model.goal_mask), model.state_labels
    return PartitionedModel.from_rows(rows, model.n_states, goals, state_labels=labels)
