"""Sparse models of Storm, in memory, as models of ours."""

from __future__ import annotations

import tarfile
from collections.abc import Hashable, Sequence
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import Argument, ModelError
from ssp_lp.io.model_files.decimals import decimal_sum
from ssp_lp.io.model_files.raw_model import (
    ModelFile,
    RawModel,
    distinct_actions,
    finished,
)
from ssp_lp.io.storm.bindings import ask_storm, storm
from ssp_lp.model.arguments import explained

_MATRIX = "choice-to-branches.bin", "branch-to-target.bin", "branch-to-probability.bin"
"""Parts of a UMB archive: offsets, successors and probabilities."""

BEYOND = "_OutOfBoundsBit"
"""Storm's variable of states that it adds where another variable is to leave its bounds."""

_KINDS = ("MDP", "DTMC")


@explained
def from_stormpy(model: Any, *, goal: str, cost: str | None = None) -> ModelFile:
    """Make a model of a sparse model of Storm's, a Markov decision process or Markov chain.

    The cost of an outcome is what Storm's reward model says of it: the reward of its state, that
    of its action and that of its transition, added as decimals. Actions bear the labels of
    choices, states the values of their variables, where the model was built with them; else both
    are numbers. Actions of goal states are dropped, and of states with the label "deadlock" that
    no action leaves: they are dead-ends. Other labels of states become ``state_labels``, but for
    names that reports use for something else, and conditions that Storm was asked: "(x = 2)".

    Args:
        model: such as ``stormpy.build_model(program)``; its numbers are floats.
        goal: the label of the goal states, or a formula of labels, '"a" & !"b"'.
        cost: the name of a reward model; None: the only one, or 1 for each action if there is none.

    Returns:
        The model and its initial states.

    Raises:
        MissingDependencyError: stormpy is not installed.
        ModelError: a model of another kind, no such goal or cost, or naming the state and the
            action at fault, as where a reward is negative.
    """
    return built_from_storm(model, goal, label_formula(goal), cost, "the stormpy model")


def label_formula(goal: str) -> Any:
    """What a formula of labels says, as stormpy's property; None: the goal is a label's name.

    Raises:
        MissingDependencyError: stormpy is not installed.
        ModelError: Storm refuses the formula.
    """
    if '"' not in goal:
        return None
    formula, *_ = ask_storm(f"goal {goal!r}", storm().parse_properties, goal)
    return formula


def built_from_storm(
    model: Any, goal: str, formula: Any, cost: str | None, source: str
) -> ModelFile:
    """Make a model of Storm's whose goals are the states with a label, or those of a formula.

    Args:
        model: of stormpy.
        goal: the goal's name.
        formula: stormpy's property that says what the goal is; None: the label of its name.
        cost: as in :func:`from_stormpy`.
        source: where the model comes from, for errors.

    Raises:
        ModelError: see :func:`from_stormpy`.
    """
    _check_sparse_storm(model, source)
    labels = {
        name: _members_from_storm(model.labeling.get_states(name))
        for name in _label_names_in_storm(model)
    }
    if formula is not None:
        labels[goal] = ask_storm(source, _states_from_storm, model, formula, goal, source)
    reward, paid = _chosen_storm_reward(model, cost, source)
    offsets, successors, probabilities = ask_storm(source, _matrix_from_storm, model)
    pair_offsets = np.arange(model.nr_states + 1)
    if not model.transition_matrix.has_trivial_row_grouping:
        pair_offsets = np.array(model.nondeterministic_choice_indices, dtype=np.int64)
    state = np.repeat(np.arange(model.nr_states), np.diff(pair_offsets))
    raw = RawModel(
        pair_offsets=pair_offsets,
        outcome_offsets=offsets,
        successors=successors,
        probabilities=probabilities,
        costs=_costs_from_storm(reward, state, offsets, successors),
        actions=ask_storm(source, _action_names_from_storm, model, state, pair_offsets),
        labels=labels,
        states=ask_storm(source, _state_names_from_storm, model),
    )
    return finished(raw, goal, f"{source}, cost {paid!r}" if paid else source)


def check_kind(kind: str, source: object) -> None:
    """Raise :class:`ModelError` unless Storm's name of a kind of models is one that we read."""
    if kind not in _KINDS:
        raise ModelError(f"{source} is a {kind}: only MDPs and DTMCs are read")


def _check_sparse_storm(model: Any, source: str) -> None:
    """Raise :class:`ModelError` unless this is a sparse model of floats and of a kind we know."""
    kind = getattr(getattr(model, "model_type", None), "name", None)
    if kind is None:
        raise ModelError(f"{source} must be a model of stormpy, not {type(model).__name__}")
    check_kind(kind, source)
    if not model.is_sparse_model:
        raise ModelError(f"{source} is symbolic: build it with the sparse engine")
    if model.supports_parameters or model.supports_uncertainty or model.is_exact:
        told = "parameters" if model.supports_parameters else "intervals"
        told = told if model.supports_parameters or model.supports_uncertainty else "fractions"
        raise ModelError(f"{source} has {told} for numbers: build it with floats")


def _label_names_in_storm(model: Any) -> list[str]:
    """The names of labels in Storm's model."""
    return sorted(name for name in model.labeling.get_labels() if not name.startswith("("))


def _members_from_storm(bits: Any) -> IntArray:
    """The states of Storm's bit vector, [members]."""
    return np.array(list(bits), dtype=np.int64)


def _states_from_storm(model: Any, formula: Any, goal: str, source: str) -> IntArray:
    """The states in which Storm says that a formula holds, [members]."""
    found = storm().model_checking(model, formula, only_initial_states=False)
    if not found.is_qualitative():
        raise ModelError(
            f"{source}: the goal must say of each state whether it is one, not {goal!r}"
        )
    return _members_from_storm(found.get_truth_values_vector())


def _matrix_from_storm(model: Any) -> tuple[IntArray, IntArray, FloatArray]:
    """Where the outcomes of each pair begin, their successors and probabilities.

    Storm's bindings hand out entries one by one; its UMB archive holds the arrays as they are.
    """
    formats = storm().io
    options = formats.UmbExportOptions()
    options.compression = formats.CompressionMode.NO_COMPRESSION
    options.value_type = formats.UmbExportValueType.DOUBLE
    with TemporaryDirectory() as folder:
        formats.export_to_umb(model, f"{folder}/model.umb", options=options)
        with tarfile.open(f"{folder}/model.umb", "r:") as archive:
            parts = [archive.extractfile(name) for name in _MATRIX]
            offsets, successors, probabilities = (part.read() for part in parts if part is not None)
    return (
        np.frombuffer(offsets, dtype="<i8"),
        np.frombuffer(successors, dtype="<i8"),
        np.frombuffer(probabilities, dtype="<f8"),
    )


def _chosen_storm_reward(model: Any, cost: str | None, source: str) -> tuple[Any, str]:
    """The reward model that is the cost, and its name; None where the model has none."""
    rewards = dict(model.reward_models)
    if cost is None and not rewards:
        return None, ""
    chosen = next(iter(rewards)) if cost is None and len(rewards) == 1 else cost
    if chosen is None or chosen not in rewards:
        names = ", ".join(sorted(map(repr, rewards))) or "none"
        raise ModelError(
            f"{source}: choose one of the reward models (", Argument("cost"), f"): {names}"
        )
    return rewards[chosen], chosen


def _costs_from_storm(
    reward: Any, state: IntArray, offsets: IntArray, successors: IntArray
) -> FloatArray:
    """The cost of each outcome: of the state, the action and the transition, [outcomes]."""
    pair = np.repeat(np.arange(state.size), np.diff(offsets))
    if reward is None:
        return np.ones(pair.size)
    of_state, of_pair, of_outcome = np.zeros(1), np.zeros(state.size), np.zeros(pair.size)
    if reward.has_state_action_rewards:
        of_pair = np.array(reward.state_action_rewards, dtype=np.float64)
    if reward.has_state_rewards:
        of_state = np.array(reward.state_rewards, dtype=np.float64)
        of_pair = decimal_sum(of_pair, of_state[state])
    if reward.has_transition_rewards:
        matrix, width = reward.transition_rewards, int(successors.max(initial=0)) + 1
        listed = {
            row * width + entry.column: entry.value
            for row in range(matrix.nr_rows)
            for entry in matrix.get_row(row)
        }
        keys = (pair * width + successors).tolist()
        of_outcome = np.array([listed.get(key, 0.0) for key in keys])
    return decimal_sum(of_pair[pair], of_outcome)


def _action_names_from_storm(
    model: Any, state: IntArray, pair_offsets: IntArray
) -> Sequence[str] | None:
    """Labels of choices, the position where there is none, [pairs]; None: no labels at all."""
    if not model.has_choice_labeling():
        return None
    names = np.full(state.size, "", dtype=object)
    for label in sorted(model.choice_labeling.get_labels()):
        here = _members_from_storm(model.choice_labeling.get_choices(label))
        names[here] = np.where(names[here] == "", label, names[here] + f"+{label}")
    bare = np.flatnonzero(names == "")
    names[bare] = list(map(str, (bare - pair_offsets[state[bare]]).tolist()))
    return distinct_actions(names.tolist(), state)


def _state_names_from_storm(model: Any) -> Sequence[Hashable] | None:
    """The values of each state's variables, in Storm's order; None: they name no state."""
    if not model.has_state_valuations():
        return None
    valuations = model.state_valuations
    columns = [
        _values_from_storm(valuations, variable)
        for variable in valuations.get_all_variables()
        if variable.name != BEYOND
    ]
    names: list[Hashable] = list(zip(*columns, strict=True))
    for state in states_beyond(model).tolist():
        names[state] = BEYOND, state  # what its variables show is another's
    return names if len(set(names)) == model.nr_states else None


def states_beyond(model: Any) -> IntArray:
    """States that Storm added where a variable is to leave its bounds, [members]."""
    valuations = model.state_valuations
    for variable in valuations.get_all_variables():
        if variable.name == BEYOND:
            return np.flatnonzero(
                np.array(_values_from_storm(valuations, variable), dtype=np.bool_)
            )
    return np.zeros(0, dtype=np.int64)


def _values_from_storm(valuations: Any, variable: Any) -> list[Hashable]:
    """A variable's value in each state, [states]."""
    if variable.has_boolean_type():
        bits = valuations.get_boolean_values(variable)
        holds = np.zeros(len(bits), dtype=np.bool_)
        holds[_members_from_storm(bits)] = True
        return cast("list[Hashable]", holds.tolist())
    if variable.has_integer_type():
        return list(valuations.get_int64_values(variable))
    if variable.has_rational_type():
        return list(valuations.get_double_values(variable))
    return list(valuations.get_string_values(variable))
