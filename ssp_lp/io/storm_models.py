"""Models of Storm: programs and sparse models, read through Storm's UMB archives."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np

from ssp_lp.errors import Argument, ModelError, attributes_of, optional_module
from ssp_lp.io.model_files import raw_model
from ssp_lp.io.model_files.raw_model import FilePath, ModelFile
from ssp_lp.io.model_files.umb import UmbArchive
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import DeadEnds

Constants = str | Mapping[str, Any]
"""Values of a program's constants, such as "N=5,p=0.1"."""

_BEYOND = "_OutOfBoundsBit"
"""Name of a variable by which Storm marks states it adds where another variable would leave its
bounds. If a program is explored again, underscores follow the name."""

_REFUSALS = (RuntimeError, ValueError, IndexError, TypeError, OverflowError, MemoryError)
"""Types of the errors that Storm raises."""

_AVERAGED = (
    " (The cost differs between outcomes of one action, which Storm cannot represent: give each "
    "more expensive outcome a step of its own.)"
)


def _storm() -> Any:
    """Return the module ``stormpy``.

    Raises:
        MissingDependencyError: it is not installed.
    """
    return optional_module("stormpy", "storm")


def _ask_storm(source: object, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call a function of stormpy without its log, which it prints to standard output.

    Raises:
        ModelError: Storm rejects the input; the message has the source and Storm's own words.
    """
    stormpy = _storm()
    log = stormpy.developer
    level = log.get_log_level()
    log.set_log_level(log.LogLevel.OFF)
    try:
        return call(*arguments, **options)
    except (*_REFUSALS, stormpy.exceptions.StormError) as error:
        raise ModelError(f"{source}: Storm rejects it: {error}") from error
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
    """Read a program in PRISM's language or in JANI through Storm.

    A state is the tuple of its variables' values, in Storm's order. In JANI the names of locations
    follow, if an automaton has several. Actions have the program's labels. The cost of an outcome
    is the sum of the rewards of its state and its action, as in :func:`~ssp_lp.io.from_stormpy`.
    All rewards become ``named_costs``, except those that Storm cannot build or that are negative
    somewhere. If a reward in JANI differs between outcomes of an action, Storm builds only the
    average.

    Args:
        path: the file; its ending is .prism, .nm or .pm for PRISM's language, or .jani.
        goal: a label, or a condition on the variables such as "x=4 & !broken".
        cost: name of a reward model ("" for PRISM's without a name), or of a transient variable of
            JANI; None: the only one, or 1 for each action if there is none.
        constants: values of the constants that the program leaves open, as text or by name.
        dead_ends: states from which no action reaches the goal, labels of them, or a predicate. Any
            other state without actions that is not a goal is then an error.

    Returns:
        The model and its initial states.

    Raises:
        MissingDependencyError: stormpy is not installed.
        ModelError: Storm rejects the file, the goal or the constants; a model in continuous time,
            with observations or parameters; or a wrong state and action, which the error names.
        OSError: the file cannot be read.
    """
    file = Path(path)
    with file.open("rb"):  # Storm's own error would not be an OSError
        stormpy = _storm()
    if file.suffix == ".jani":
        program, _ = _ask_storm(file, stormpy.parse_jani_model, str(file))
    else:
        program = _ask_storm(
            file, stormpy.parse_prism_program, str(file), prism_compatibility=True, simplify=False
        )
    _check_kind(_ask_storm(file, getattr, program, "model_type").name, file)
    program, _ = _ask_storm(file, stormpy.instantiate_constants, program, constants or {})
    if missing := [constant.name for constant in program.constants if not constant.defined]:
        message = f"{file} has undefined constants: {', '.join(missing)}; give their values ("
        raise ModelError(message, Argument("constants"), ")")
    return _explored_program(stormpy, file, program, goal, cost, dead_ends)


def _explored_program(
    stormpy: Any, file: Path, program: Any, goal: str, cost: str | None, dead_ends: DeadEnds | None
) -> ModelFile:
    """Explore a program whose constants have values, and return its model."""

    def property_in(source: str, text: str) -> Any:
        """Return the property that a text states; ``source`` is its name in errors."""
        parsed = _ask_storm(source, stormpy.parse_properties, text, program)
        if len(parsed) != 1:
            raise ModelError(f"{source}: there must be one condition, not {len(parsed)}")
        return parsed[0]

    labels = [] if _is_jani(program) else [label.name for label in program.labels]
    listed = f" (labels: {', '.join(map(repr, labels))})" if labels else ""
    quoted = f'"{goal}"' if goal in (raw_model.INITIAL, raw_model.DEADLOCK, *labels) else goal
    formula = property_in(f"{file}, goal {goal!r}{listed}", quoted)
    # given a condition alone, Storm would not explore beyond the states in which it holds
    wanted = [formula, property_in(str(file), "true")]
    reward_names = _reward_names(program)
    place = raw_model.chosen_reward(file, reward_names, cost)

    def built(rewards: list[str] | None) -> Any:
        """Return Storm's sparse model with some rewards; None: all."""
        formulas = [f'R{{"{name}"}}min=? [C]' if name else "Rmin=? [C]" for name in rewards or ()]
        conditions = [*wanted, *(property_in(str(file), text) for text in formulas)]
        options = _ask_storm(file, stormpy.BuilderOptions, conditions, program)
        options.set_build_all_labels()
        options.set_build_choice_labels()
        options.set_build_state_valuations()
        options.set_scale_and_lift_transition_rewards(False)
        options.set_add_out_of_bounds_state()  # its own check would reject 0.8 + 0.1 + 0.1
        if rewards is None:
            options.set_build_all_reward_models()
        return _ask_storm(file, stormpy.build_model, program, options=options)

    sparse = _with_most_rewards(
        built, reward_names, None if cost == raw_model.FIRST_COST else place, program
    )
    answer = _model_of_storm(sparse, goal, formula, cost, str(file), dead_ends, program)
    model = answer.model
    names = enumerate(model.states)
    beyond = [k for k, name in names if isinstance(name, tuple) and name[0] == _BEYOND]
    if beyond:
        leading = np.flatnonzero(np.isin(model.successors, beyond))
        where = model._describe_outcome(int(leading[0])) if leading.size else "a goal"
        raise ModelError(f"{file}, {where}: a variable leaves its bounds")
    return answer


def _is_jani(program: Any) -> bool:
    """Return whether a program of stormpy is in JANI; False for a program of PRISM, or None."""
    return type(program).__name__ == "JaniModel"  # its module depends on the version of stormpy


def _reward_names(program: Any) -> list[str]:
    """Return the names of a program's rewards: in JANI its transient variables that are numbers."""
    if not _is_jani(program):
        return sorted(reward.name for reward in program.reward_models)
    numbers = [v for v in program.global_variables if v.is_transient]
    return sorted(v.name for v in numbers if not v.expression_variable.has_boolean_type())


def _with_most_rewards(
    built: Callable[[list[str] | None], Any], names: list[str], place: int | None, program: Any
) -> Any:
    """Return Storm's model with all rewards, or with as many as Storm can build.

    Args:
        built: function that builds the model with the named rewards; None: with all.
        names: names of the rewards.
        place: position of a reward that is required; None: none is.
        program: program of stormpy.

    Raises:
        ModelError: Storm cannot build the required reward, or the model.
    """
    try:
        return built(None)
    except ModelError:
        kept = [] if place is None else [names[place]]
    try:
        sparse = built(kept)
    except ModelError as error:
        is_averaged = kept and _is_jani(program) and _differs_between_outcomes(program, kept[0])
        raise ModelError(f"{error}{_AVERAGED if is_averaged else ''}") from error
    for name in names:
        if name not in kept:
            with suppress(ModelError):
                sparse = built([*kept, name])
                kept.append(name)
    return sparse


def _differs_between_outcomes(program: Any, cost: str) -> bool:
    """Return whether some edge of a JANI program assigns different costs at its destinations."""

    def paid(destination: Any) -> float | str:
        """Return the value assigned at a destination; as text if it is not a number."""
        for each in destination.assignments:
            if each.variable.name == cost:
                value = each.expression
                return str(value) if value.contains_variables() else value.evaluate_as_double()
        return 0.0

    edges = [edge for automaton in program.automata for edge in automaton.edges]
    return any(len({paid(destination) for destination in edge.destinations}) > 1 for edge in edges)


def _bookkeeping(program: Any) -> dict[str, list[str] | None]:
    """Return the variables that Storm adds to the states of a JANI program.

    Returns:
        A dict from each added variable to the names of the locations that its values stand for, or
        to None if the variable does not distinguish states. Empty if the program is not in JANI.
    """
    added: dict[str, list[str] | None] = {}
    if not _is_jani(program):
        return added
    for variables in (program.global_variables, *(each.variables for each in program.automata)):
        added |= {variable.name: None for variable in variables if variable.is_transient}
    for automaton in program.automata:
        places = [location.name for location in automaton.locations]
        added[automaton.location_variable.name] = places if len(places) > 1 else None
    return added


@explained
def from_stormpy(
    model: Any, *, goal: str, cost: str | None = None, dead_ends: DeadEnds | None = None
) -> ModelFile:
    """Convert a sparse model of Storm, a Markov decision process or Markov chain, to an SSP.

    The cost of an outcome is the sum of Storm's rewards of its state, its action and its
    transition, added as decimals. Actions are named by the labels of choices, and states by the
    values of their variables, if the model was built with them; otherwise both are numbers. Actions
    of goal states are dropped. A state with the label "deadlock" that no action leaves becomes a
    dead-end without actions. Other labels of states become ``state_labels``, except for names that
    reports use already, and conditions that were passed to Storm: "(x = 2)".

    Args:
        model: such as ``stormpy.build_model(program)``; its numbers are floats.
        goal: the label of the goal states, or a formula of labels, '"a" & !"b"'.
        cost: name of a reward model; None: the only one, or 1 for each action if there is none.
        dead_ends: states from which no action reaches the goal, labels of them, or a predicate. Any
            other state without actions that is not a goal is then an error.

    Returns:
        The model and its initial states.

    Raises:
        MissingDependencyError: stormpy is not installed.
        ModelError: a model of another kind, no such goal or cost, or a wrong state and action, for
            instance with a negative reward; the error names them.
    """
    formula = None
    if '"' in goal:
        formula, *_ = _ask_storm(f"goal {goal!r}", _storm().parse_properties, goal)
    return _model_of_storm(model, goal, formula, cost, "the stormpy model", dead_ends)


def _model_of_storm(
    model: Any,
    goal: str,
    formula: Any,
    cost: str | None,
    source: str,
    dead_ends: DeadEnds | None,
    program: Any = None,
) -> ModelFile:
    """Convert a model of Storm to an SSP whose goals satisfy a label or a formula.

    Args:
        model: model of stormpy.
        goal: name of the goal.
        formula: stormpy's property of the goal states; None: the label of this name.
        cost: as in :func:`from_stormpy`.
        source: name of the model in errors.
        dead_ends: as in :func:`from_stormpy`.
        program: the program that Storm explored, if any, to recognise variables that Storm added.

    Raises:
        ModelError: see :func:`from_stormpy`.
    """
    _check_sparse(model, source)
    formats = _storm().io
    options = formats.UmbExportOptions()
    options.compression = formats.CompressionMode.NO_COMPRESSION
    options.value_type = formats.UmbExportValueType.DOUBLE
    options.allow_choice_labeling_as_actions = True
    with TemporaryDirectory() as folder:
        path = f"{folder}/model.umb"
        _ask_storm(source, formats.export_to_umb, model, path, options=options)
        archive = UmbArchive(path)
    raw = archive.raw_model(cost, source)
    labels = {name: at for name, at in raw.labels.items() if not name.startswith("(")}
    if formula is not None:
        checking, every = _storm().model_checking, {"only_initial_states": False}
        checked = _ask_storm(source, checking, model, formula, **every)
        if not checked.is_qualitative():
            raise ModelError(f"{source}: the goal must be a condition on states, not {goal!r}")
        labels[goal] = np.array(list(checked.get_truth_values_vector()), dtype=np.int64)
    states = _state_names(archive, _bookkeeping(program))
    paid = next((name for name, costs in raw.named_costs.items() if costs is raw.costs), "")
    source = f"{source}, cost {paid!r}" if paid else source
    return raw_model.finished(raw._replace(labels=labels, states=states), goal, source, dead_ends)


def _state_names(
    archive: UmbArchive, added: Mapping[str, Sequence[str] | None]
) -> Sequence[Hashable] | None:
    """Return the tuple of each state's variables in Storm's order; None if two tuples are equal.

    Args:
        archive: archive of Storm.
        added: variables that Storm added. A variable is mapped to the names of its values, or to
            None if it is left out of the tuples.
    """
    variables, columns = archive.variables(), list[list[Hashable]]()
    beyond = [name for name in variables if name.rstrip("_") == _BEYOND]
    for name in sorted(variables.keys() - beyond, key=lambda each: (each in added, each)):
        values, words = variables[name], added.get(name, ())
        if words is not None:
            columns.append([words[cast("int", value)] for value in values] if words else values)
    names: list[Hashable] = list(zip(*columns, strict=True))
    for name in beyond:  # other variables show values of another state there
        for state in np.flatnonzero(np.array(variables[name])).tolist():
            names[state] = _BEYOND, state
    return names if names and len(set(names)) == len(names) else None


def _check_kind(kind: str, source: object) -> None:
    """Raise :class:`ModelError` unless a kind of models, by Storm's name, is supported."""
    if kind not in ("MDP", "DTMC"):
        raise ModelError(f"{source} is a {kind}: only MDPs and DTMCs are supported")


def _check_sparse(model: Any, source: str) -> None:
    """Raise :class:`ModelError` unless this is a sparse model of floats and of a supported kind."""
    if not attributes_of(model, "model_type"):
        raise ModelError(f"{source} must be a model of stormpy, not {type(model).__name__}")
    _check_kind(model.model_type.name, source)
    if not model.is_sparse_model:
        raise ModelError(f"{source} is symbolic: build it with the sparse engine")
    if model.supports_parameters or model.supports_uncertainty or model.is_exact:
        other = "intervals" if model.supports_uncertainty else "fractions"
        numbers = "parameters" if model.supports_parameters else other
        raise ModelError(f"the numbers of {source} are {numbers}: build it with floats")
