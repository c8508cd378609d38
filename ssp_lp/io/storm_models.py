"""Storm's models: its programs, archives and sparse models read, and ours handed over to it."""

from __future__ import annotations

import tarfile
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import Argument, ModelError, optional_module
from ssp_lp.io.model_files.raw_model import (
    DEADLOCK,
    FIRST_COST,
    INITIAL,
    FilePath,
    ModelFile,
    RawModel,
    chosen_reward,
    decimal_sum,
    distinct_actions,
    exported,
    finished,
    named_rewards,
)
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import DeadEnds

Constants = str | Mapping[str, Any]
"""What the constants of a program are, such as "N=5,p=0.1"."""

_BEYOND = "_OutOfBoundsBit"
"""Storm's variable of states that it adds where another variable is to leave its bounds; in a
program that is explored again, underscores follow its name."""

_REFUSALS = (RuntimeError, ValueError, IndexError, TypeError, OverflowError, MemoryError)
"""Errors of Storm arrive as errors of Python's own classes, too."""

_AVERAGED = (
    " (The cost differs between outcomes of one action, which Storm could only average: give each "
    "outcome that costs more a step of its own.)"
)

_MATRIX = "choice-to-branches.bin", "branch-to-target.bin", "branch-to-probability.bin"
"""Parts of a UMB archive: offsets, successors and probabilities."""

_STATES_AT_A_TIME = 20_000
"""States handed over at a time: lists of Python numbers are large."""


def _storm() -> Any:
    """The module ``stormpy``.

    Raises:
        MissingDependencyError: it is not installed.
    """
    return optional_module("stormpy", "storm")


def _ask_storm(source: object, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call a function of stormpy's with its log off, which goes to standard output.

    Raises:
        ModelError: Storm refuses; the message names the source and says why in Storm's words.
    """
    stormpy = _storm()
    log = stormpy.developer
    level = log.get_log_level()
    log.set_log_level(log.LogLevel.OFF)
    try:
        return call(*arguments, **options)
    except (*_REFUSALS, stormpy.exceptions.StormError) as error:
        raise ModelError(f"{source}: Storm refuses it: {error}") from error
    finally:
        log.set_log_level(level)


@explained
def read_with_storm(
    path: FilePath,
    *,
    goal: str,
    cost: str | None = None,
    constants: Constants | None = None,
    dead_ends: DeadEnds | None = None,
) -> ModelFile:
    """Read a model through Storm: a program in PRISM's language, in JANI, or a UMB archive.

    States are tuples of the values of their variables, in Storm's order (in JANI followed by the
    names of locations, where an automaton has several); actions bear their labels; costs are those
    of :func:`~ssp_lp.io.from_stormpy`, PRISM's rewards of states and of actions. All rewards are
    ``named_costs``, except those that Storm cannot build or that are negative somewhere. JANI's
    rewards that differ between outcomes of an action cannot be built: Storm could only average
    them.

    Args:
        path: the file; its ending says what it is: .prism, .nm and .pm PRISM's language, .jani, or
            .umb.
        goal: a label, or a condition on the variables such as "x=4 & !broken" (of an archive:
            on labels).
        cost: the name of a reward model ("" for PRISM's without a name), or of a transient variable
            of JANI; None: the only one, or 1 for each action if there is none.
        constants: values of the constants that the program leaves open, as text or by name.
        dead_ends: states from which no action reaches the goal, labels of theirs, or a predicate.
            Any other state without actions that is not a goal is then an error.

    Returns:
        The model and its initial states.

    Raises:
        MissingDependencyError: stormpy is not installed.
        ModelError: Storm refuses the file, the goal or the constants; a model in continuous time,
            with observations or parameters; or naming the state and the action at fault.
        OSError: the file cannot be read.
    """
    file = Path(path)
    with file.open("rb"):  # Storm's own complaint would not be an OSError
        stormpy = _storm()
    if file.suffix == ".umb":
        if constants:
            raise ModelError(f"{file} has no constants: leave ", Argument("constants"), " out")
        options = stormpy.io.UmbImportOptions()
        options.build_choice_labeling = options.build_state_valuations = True
        model = _ask_storm(file, stormpy.build_model_from_umb, str(file), options=options)
        return _model_of_storm(model, goal, _label_formula(goal), cost, str(file), dead_ends)
    if file.suffix == ".jani":
        program, _ = _ask_storm(file, stormpy.parse_jani_model, str(file))
    else:
        program = _ask_storm(
            file, stormpy.parse_prism_program, str(file), prism_compatibility=True, simplify=False
        )
    _check_kind(_ask_storm(file, getattr, program, "model_type").name, file)
    program, _ = _ask_storm(file, stormpy.instantiate_constants, program, constants or {})
    if missing := [constant.name for constant in program.constants if not constant.defined]:
        told = f"{file} has undefined constants: {', '.join(missing)}; give their values ("
        raise ModelError(told, Argument("constants"), ")")
    return _explored_program(stormpy, file, program, goal, cost, dead_ends)


def _explored_program(
    stormpy: Any, file: Path, program: Any, goal: str, cost: str | None, dead_ends: DeadEnds | None
) -> ModelFile:
    """Storm's model of a program without open constants."""

    def asked(source: str, text: str) -> Any:
        """One property of the program."""
        parsed = _ask_storm(source, stormpy.parse_properties, text, program)
        if len(parsed) != 1:
            raise ModelError(f"{source}: one condition, not {len(parsed)}")
        return parsed[0]

    labels = [label.name for label in getattr(program, "labels", ())]  # JANI's are variables
    listed = f" (labels: {', '.join(map(repr, labels))})" if labels else ""
    quoted = f'"{goal}"' if goal in (INITIAL, DEADLOCK, *labels) else goal
    formula = asked(f"{file}, goal {goal!r}{listed}", quoted)
    # a condition that stands alone would have Storm explore no further than where it holds
    wanted = [formula, asked(str(file), "true")]
    known = _reward_names(program)
    place = chosen_reward(file, known, cost)

    def built(rewards: list[str] | None) -> Any:
        """Storm's sparse model with some rewards; None: all."""
        formulas = [f'R{{"{name}"}}min=? [C]' if name else "Rmin=? [C]" for name in rewards or ()]
        conditions = [*wanted, *(asked(str(file), text) for text in formulas)]
        options = _ask_storm(file, stormpy.BuilderOptions, conditions, program)
        options.set_build_all_labels()
        options.set_build_choice_labels()
        options.set_build_state_valuations()
        options.set_scale_and_lift_transition_rewards(False)
        options.set_add_out_of_bounds_state()  # its own check would refuse 0.8 + 0.1 + 0.1
        if rewards is None:
            options.set_build_all_reward_models()
        return _ask_storm(file, stormpy.build_model, program, options=options)

    sparse = _with_most_rewards(built, known, None if cost == FIRST_COST else place, program)
    added = _bookkeeping(program)
    answer = _model_of_storm(sparse, goal, formula, cost, str(file), dead_ends, added)
    if _states_beyond(sparse).size:
        model = answer.model
        names = enumerate(model.states)
        beyond = [k for k, name in names if isinstance(name, tuple) and name[0] == _BEYOND]
        leading = np.flatnonzero(np.isin(model.successors, beyond))
        where = model._describe_outcome(int(leading[0])) if leading.size else "a goal"
        raise ModelError(f"{file}, {where}: a variable leaves its bounds")
    return answer


def _reward_names(program: Any) -> list[str]:
    """Names of the rewards of Storm's program; those of JANI are its transient numbers."""
    if hasattr(program, "reward_models"):
        return sorted(reward.name for reward in program.reward_models)
    numbers = [v for v in program.global_variables if v.is_transient]
    return sorted(v.name for v in numbers if not v.expression_variable.has_boolean_type())


def _with_most_rewards(
    built: Callable[[list[str] | None], Any], names: list[str], place: int | None, program: Any
) -> Any:
    """Storm's model of a program with all rewards; where Storm refuses, with those that it builds.

    Args:
        built: builds the model with some rewards; None: with all.
        names: of the rewards.
        place: of the reward that must be there; None: no one must.
        program: of stormpy.

    Raises:
        ModelError: Storm cannot build the reward that must be there, or the model.
    """
    try:
        return built(None)
    except ModelError:
        kept = [] if place is None else [names[place]]
    try:
        sparse = built(kept)
    except ModelError as error:
        hint = _AVERAGED if kept and _differs_between_outcomes(program, kept[0]) else ""
        raise ModelError(f"{error}{hint}") from error
    for name in names:
        if name not in kept:
            with suppress(ModelError):
                sparse = built([*kept, name])
                kept.append(name)
    return sparse


def _differs_between_outcomes(program: Any, cost: str) -> bool:
    """Whether a program in JANI assigns a variable differently at destinations of one edge."""

    def paid(destination: Any) -> float | str:
        """The value assigned at a destination; as text where it is no number."""
        for each in destination.assignments:
            if each.variable.name == cost:
                value = each.expression
                return str(value) if value.contains_variables() else value.evaluate_as_double()
        return 0.0

    automata = getattr(program, "automata", ())
    edges = [edge for automaton in automata for edge in automaton.edges]
    return any(len({paid(destination) for destination in edge.destinations}) > 1 for edge in edges)


def _bookkeeping(program: Any) -> dict[str, list[str] | None]:
    """Variables of states that Storm adds to those of a program in JANI.

    Returns:
        The names of the locations that they stand for; None: they distinguish no states.
    """
    added: dict[str, list[str] | None] = {}
    automata = list(getattr(program, "automata", ()))
    for variables in (getattr(program, "global_variables", ()), *(a.variables for a in automata)):
        added |= {variable.name: None for variable in variables if variable.is_transient}
    for automaton in automata:
        places = [location.name for location in automaton.locations]
        added[automaton.location_variable.name] = places if len(places) > 1 else None
    return added


@explained
def from_stormpy(
    model: Any, *, goal: str, cost: str | None = None, dead_ends: DeadEnds | None = None
) -> ModelFile:
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
        dead_ends: states from which no action reaches the goal, labels of theirs, or a predicate.
            Any other state without actions that is not a goal is then an error.

    Returns:
        The model and its initial states.

    Raises:
        MissingDependencyError: stormpy is not installed.
        ModelError: a model of another kind, no such goal or cost, or naming the state and the
            action at fault, as where a reward is negative.
    """
    formula = _label_formula(goal)
    return _model_of_storm(model, goal, formula, cost, "the stormpy model", dead_ends)


def _label_formula(goal: str) -> Any:
    """A formula of labels as stormpy's property; None: the goal is a label's name."""
    if '"' not in goal:
        return None
    formula, *_ = _ask_storm(f"goal {goal!r}", _storm().parse_properties, goal)
    return formula


def _model_of_storm(
    model: Any,
    goal: str,
    formula: Any,
    cost: str | None,
    source: str,
    dead_ends: DeadEnds | None,
    added: Mapping[str, Sequence[str] | None] = MappingProxyType({}),
) -> ModelFile:
    """Make a model of Storm's whose goals are the states with a label, or those of a formula.

    Args:
        model: of stormpy.
        goal: the goal's name.
        formula: stormpy's property that says what the goal is; None: the label of its name.
        cost: as in :func:`from_stormpy`.
        source: where the model comes from, for errors.
        dead_ends: as in :func:`from_stormpy`.
        added: variables that Storm added, with the names of their values; None: leave them out.

    Raises:
        ModelError: see :func:`from_stormpy`.
    """
    _check_sparse(model, source)
    labels = {
        name: _members_of(model.labeling.get_states(name))
        for name in sorted(model.labeling.get_labels())
        if not name.startswith("(")
    }
    if formula is not None:
        checking, every = _storm().model_checking, {"only_initial_states": False}
        checked = _ask_storm(source, checking, model, formula, **every)
        if not checked.is_qualitative():
            raise ModelError(
                f"{source}: the goal must say of each state whether it is one, not {goal!r}"
            )
        labels[goal] = _members_of(checked.get_truth_values_vector())
    rewards = dict(sorted(model.reward_models.items()))
    place = chosen_reward(source, list(rewards), cost)
    paid = None if place is None else list(rewards)[place]
    offsets, successors, probabilities = _ask_storm(source, _matrix_of_storm, model)
    pair_offsets = np.arange(model.nr_states + 1)
    if not model.transition_matrix.has_trivial_row_grouping:
        pair_offsets = np.array(model.nondeterministic_choice_indices, dtype=np.int64)
    state = np.repeat(np.arange(model.nr_states), np.diff(pair_offsets))
    models = list(rewards.values()) or [None]
    costs = [_costs_of_storm(reward, state, offsets, successors) for reward in models]
    raw = RawModel(
        pair_offsets=pair_offsets,
        outcome_offsets=offsets,
        successors=successors,
        probabilities=probabilities,
        costs=costs[place or 0],
        named_costs=named_rewards(list(rewards), costs) if rewards else {},
        actions=_ask_storm(source, _action_names_of_storm, model, state, pair_offsets),
        labels=labels,
        states=_ask_storm(source, _state_names_of_storm, model, added),
    )
    return finished(raw, goal, f"{source}, cost {paid!r}" if paid else source, dead_ends)


def _check_kind(kind: str, source: object) -> None:
    """Raise :class:`ModelError` unless Storm's name of a kind of models is one that we read."""
    if kind not in ("MDP", "DTMC"):
        raise ModelError(f"{source} is a {kind}: only MDPs and DTMCs are read")


def _check_sparse(model: Any, source: str) -> None:
    """Raise :class:`ModelError` unless this is a sparse model of floats and of a kind we know."""
    if not hasattr(model, "model_type"):
        raise ModelError(f"{source} must be a model of stormpy, not {type(model).__name__}")
    _check_kind(model.model_type.name, source)
    if not model.is_sparse_model:
        raise ModelError(f"{source} is symbolic: build it with the sparse engine")
    if model.supports_parameters or model.supports_uncertainty or model.is_exact:
        other = "intervals" if model.supports_uncertainty else "fractions"
        numbers = "parameters" if model.supports_parameters else other
        raise ModelError(f"{source} has {numbers} for numbers: build it with floats")


def _members_of(bits: Any) -> IntArray:
    """States or choices of Storm's bit vector, [members]."""
    return np.array(list(bits), dtype=np.int64)


def _matrix_of_storm(model: Any) -> tuple[IntArray, IntArray, FloatArray]:
    """Storm's matrix: where outcomes of each pair begin, their successors and probabilities.

    Storm's bindings hand out entries one by one; its UMB archive holds the arrays as they are.
    """
    formats = _storm().io
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


def _costs_of_storm(
    reward: Any, state: IntArray, offsets: IntArray, successors: IntArray
) -> FloatArray:
    """Cost of each outcome of Storm's model, of state, action and transition, [outcomes]."""
    pair = np.repeat(np.arange(state.size), np.diff(offsets))
    if reward is None:
        return np.ones(pair.size)
    of_pair, of_outcome = np.zeros(state.size), np.zeros(pair.size)
    if reward.has_state_action_rewards:
        of_pair = np.array(reward.state_action_rewards, dtype=np.float64)
    if reward.has_state_rewards:
        of_pair = decimal_sum(of_pair, np.array(reward.state_rewards, dtype=np.float64)[state])
    if reward.has_transition_rewards:
        matrix = reward.transition_rewards
        listed = {
            (k, at.column): at.value for k in range(matrix.nr_rows) for at in matrix.get_row(k)
        }
        keys = zip(pair.tolist(), successors.tolist(), strict=True)
        of_outcome = np.array([listed.get(key, 0.0) for key in keys])
    return decimal_sum(of_pair[pair], of_outcome)


def _action_names_of_storm(
    model: Any, state: IntArray, pair_offsets: IntArray
) -> Sequence[str] | None:
    """Labels of Storm's choices, the position where there is none, [pairs]; None: no labels."""
    if not model.has_choice_labeling():
        return None
    names = np.full(state.size, "", dtype=object)
    for label in sorted(model.choice_labeling.get_labels()):
        here = _members_of(model.choice_labeling.get_choices(label))
        names[here] = np.where(names[here] == "", label, names[here] + f"+{label}")
    bare = np.flatnonzero(names == "")
    names[bare] = list(map(str, (bare - pair_offsets[state[bare]]).tolist()))
    return distinct_actions(names.tolist(), state)


def _state_names_of_storm(
    model: Any, added: Mapping[str, Sequence[str] | None]
) -> Sequence[Hashable] | None:
    """Values of each state's variables, in Storm's order; None: they name no state.

    Args:
        model: of stormpy.
        added: as in :func:`_model_of_storm`.
    """
    if not model.has_state_valuations():
        return None
    valuations = model.state_valuations
    columns = []
    for variable in sorted(valuations.get_all_variables(), key=lambda each: each.name in added):
        words = added.get(variable.name, ())
        if variable.name.rstrip("_") != _BEYOND and words is not None:
            values = _values_of_variable(valuations, variable)
            columns.append([words[cast("int", value)] for value in values] if words else values)
    names: list[Hashable] = list(zip(*columns, strict=True))
    for state in _states_beyond(model).tolist():
        names[state] = _BEYOND, state  # what its variables show is another's
    return names if len(set(names)) == model.nr_states else None


def _states_beyond(model: Any) -> IntArray:
    """States that Storm added where a variable is to leave its bounds, [members]."""
    valuations = model.state_valuations
    for variable in valuations.get_all_variables():
        if variable.name.rstrip("_") == _BEYOND:
            return np.flatnonzero(np.array(_values_of_variable(valuations, variable)))
    return np.zeros(0, dtype=np.int64)


def _values_of_variable(valuations: Any, variable: Any) -> list[Hashable]:
    """Value of Storm's variable in each state, [states]."""
    if variable.has_boolean_type():
        bits = valuations.get_boolean_values(variable)
        holds = np.zeros(len(bits), dtype=np.bool_)
        holds[_members_of(bits)] = True
        return cast("list[Hashable]", holds.tolist())
    if variable.has_integer_type():
        return list(valuations.get_int64_values(variable))
    if variable.has_rational_type():
        return list(valuations.get_double_values(variable))
    return list(valuations.get_string_values(variable))


@explained
def to_stormpy(model: SSP, *, start: Hashable) -> Any:
    """Make Storm's sparse Markov decision process of a model.

    States, labels and costs are those of :func:`ssp_lp.io.write_drn`: state k is the k-th of
    ``model.states``, the labels are the model's, and "goal", "deadlock" for dead-ends, and "init";
    each reward model belongs to actions, and a dearer outcome of one leads through a state
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
    stormpy, process = _storm(), exported(model, start)
    models, offsets, ends = stormpy.models, process.pair_offsets, process.outcome_offsets
    n_states, n_pairs = offsets.size - 1, len(process.costs)
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
    labels, choices = models.StateLabeling(n_states), models.ChoiceLabeling(n_pairs)
    for name, members in process.labels.items():
        labels.add_label(name)
        for state in np.asarray(members).tolist():
            labels.add_label_to_state(name, state)
    for name in dict.fromkeys(process.actions):
        choices.add_label(name)
    for choice, name in enumerate(process.actions):
        choices.add_label_to_choice(name, choice)
    rewards = {
        name: models.SparseRewardModel[float](optional_state_action_reward_vector=costs)
        for name, costs in zip(process.cost_names, process.costs.T.tolist(), strict=True)
    }
    parts = models.SparseModelComponents[float](
        transition_matrix=builder.build(), state_labeling=labels, reward_models=rewards
    )
    parts.choice_labeling = choices
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
    sparse, formats = to_stormpy(model, start=start), _storm().io
    options = formats.UmbExportOptions()
    options.allow_choice_labeling_as_actions = True
    with open(path, "wb"):  # Storm's own complaint would not be an OSError
        pass
    formats.export_to_umb(sparse, str(path), options=options)
