"""Models of ours as sparse models of Storm, in memory and as UMB archives."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np

from ssp_lp.io.model_files.exported import Exported, exported
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.io.storm.bindings import storm
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained

_STATES_AT_A_TIME = 20_000
"""States handed over at a time: lists of Python numbers are large."""


@explained
def to_stormpy(model: SSP, *, start: Hashable) -> Any:
    """Make Storm's sparse Markov decision process of a model.

    States, labels and costs are those of :func:`ssp_lp.io.write_drn`: state k is the k-th of
    ``model.states``, the labels are the model's, and "goal", "deadlock" for dead-ends, and "init";
    the reward model "cost" belongs to actions, and a dearer outcome of one leads through a state
    labelled "paying" that pays the rest. Choices bear the names of the actions.

    Args:
        model: the model.
        start: the initial state.

    Returns:
        A ``stormpy.models.SparseMdp[float]``.

    Raises:
        MissingDependencyError: stormpy is not installed.
        ModelError: the start is no state, or a label cannot be written.
    """
    stormpy, process = storm(), exported(model, start)
    models = stormpy.models
    parts = models.SparseModelComponents[float](
        transition_matrix=_matrix_for_storm(stormpy, process),
        state_labeling=_state_labels_for_storm(models, process),
        reward_models={
            "cost": models.SparseRewardModel[float](
                optional_state_action_reward_vector=process.costs.tolist()
            )
        },
    )
    parts.choice_labeling = _choice_labels_for_storm(models, process)
    return models.SparseMdp[float](parts)


@explained
def write_umb(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as a UMB archive; states, labels and costs are those of :func:`to_stormpy`.

    Args:
        model: the model.
        path: the file.
        start: the initial state.

    Raises:
        MissingDependencyError: stormpy is not installed.
        ModelError: the start is no state, or a label cannot be written.
        OSError: the file cannot be written.
    """
    found, io = to_stormpy(model, start=start), storm().io
    options = io.UmbExportOptions()
    options.allow_choice_labeling_as_actions = True
    with open(path, "wb"):  # Storm's own complaint would not be an OSError
        pass
    io.export_to_umb(found, str(path), options=options)


def _matrix_for_storm(stormpy: Any, process: Exported) -> Any:
    """The transitions as Storm's matrix; the rows of a state are a group."""
    offsets, ends = process.pair_offsets, process.outcome_offsets
    n_states, n_pairs = offsets.size - 1, process.costs.size
    builder = stormpy.datastructures.SparseMatrixBuilder[float](
        rows=n_pairs,
        columns=n_states,
        entries=process.successors.size,
        has_custom_row_grouping=True,
        row_groups=n_states,
    )
    for first in range(0, n_states, _STATES_AT_A_TIME):
        states = offsets[first : min(first + _STATES_AT_A_TIME, n_states) + 1]
        sizes = np.diff(ends[states[0] : states[-1] + 1])
        some = slice(ends[states[0]], ends[states[-1]])
        builder.add_next_values(
            np.repeat(np.arange(states[0], states[-1]), sizes).tolist(),
            process.successors[some].tolist(),
            process.probabilities[some].tolist(),
            states[:-1].tolist(),
        )
    return builder.build()


def _state_labels_for_storm(models: Any, process: Exported) -> Any:
    """The labels of states, as Storm has them."""
    labels = models.StateLabeling(process.pair_offsets.size - 1)
    for name, members in process.labels.items():
        labels.add_label(name)
        for state in np.asarray(members).tolist():
            labels.add_label_to_state(name, state)
    return labels


def _choice_labels_for_storm(models: Any, process: Exported) -> Any:
    """The names of actions, as Storm's labels of choices."""
    labels = models.ChoiceLabeling(process.costs.size)
    for name in dict.fromkeys(process.actions):
        labels.add_label(name)
    for choice, name in enumerate(process.actions):
        labels.add_label_to_choice(name, choice)
    return labels
