"""Reading and writing models in any supported format; the ending of a file's name chooses it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ssp_lp.errors import Argument, ModelError, did_you_mean
from ssp_lp.io.archives import load_model, save_model
from ssp_lp.io.model_files.drn import read_drn, write_drn
from ssp_lp.io.model_files.json_model import StatedModel, model_in_json, read_json
from ssp_lp.io.model_files.raw_model import FIRST_COST, ModelFile, chosen_reward, write_text
from ssp_lp.io.model_files.umb import read_umb, write_umb
from ssp_lp.io.storm_models import Constants, read_with_storm
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import DeadEnds, csv_columns

Start = Hashable | Mapping[Hashable, float]

_JSON, _ARCHIVE = (".json", ".json.gz"), ".npz"
_CSV, _OUTCOME = ".csv", ("state", "action", "successor", "probability")
_STORM = (".prism", ".nm", ".pm", ".jani")
_DRN = (".drn", ".drn.gz", ".drn.xz")
_READERS: dict[str, Callable[..., ModelFile]] = {
    **dict.fromkeys(_DRN, read_drn),
    ".umb": read_umb,
    **dict.fromkeys(_STORM, read_with_storm),
}
"""Ending of a file's name -> reader of a format whose goals are the states of one label."""

_WRITERS: dict[str, Callable[..., None]] = {**dict.fromkeys(_DRN, write_drn), ".umb": write_umb}
"""Ending of a file's name -> writer of a format with one initial state."""


@explained
def read_any(
    path: str | Path,
    goal: str | Sequence[str],
    cost: str | None = None,
    constants: Constants | None = None,
    dead_ends: DeadEnds | None = None,
) -> StatedModel:
    """Read a model from a file; the ending of its name gives the format.

    Programs (.prism, .nm, .pm, .jani) are read through Storm (the extra ``storm``).

    Args:
        path: the file.
        goal: the goal states: one or several names of states, the label of a set of states if the
            format has labels, or a condition on the variables of a program.
        cost: name of the cost that problems minimise, if the file has several; None: the only one;
            "*": the first. The others are in the model's ``named_costs``.
        constants: constants of a program, "N=5,p=0.1" or by name.
        dead_ends: states from which no action reaches the goal, labels of them, or a predicate.
            Any other state without actions that is not a goal is then an error.

    Raises:
        MissingDependencyError: the format needs stormpy, which is not installed.
        ModelError: an unknown ending, or a file without a model.
        OSError: the file cannot be read.
    """
    file, goals = Path(path), [goal] if isinstance(goal, str) else goal
    ending = _ending_of(file, (*_JSON, _CSV, _ARCHIVE, *_READERS))
    if constants and ending not in _STORM:
        raise ModelError(f"{file.name} has no constants: leave ", Argument("constants"), " out")
    if ending == _CSV:
        return StatedModel(_csv_model(file, goals, cost, dead_ends))
    if ending in _JSON:
        return read_json(file, goals, cost, dead_ends)
    if ending == _ARCHIVE:
        if goals:
            message = f"{file.name} has the goal states already: leave "
            raise ModelError(message, Argument("goal"), " out")
        model = load_model(file)
        model = model if cost in (None, FIRST_COST) else model.with_cost(cost)
        return StatedModel(model.with_dead_ends(dead_ends))
    if len(goals) != 1:
        message = f"{file}: name the one label whose states are goals ("
        raise ModelError(message, Argument("goal"), ")")
    more: dict[str, Any] = {"constants": constants} if ending in _STORM else {}
    found = _READERS[ending](file, goal=goals[0], cost=cost, dead_ends=dead_ends, **more)
    return StatedModel(found.model, found.start if len(found.initial_states) == 1 else None)


def _csv_model(
    file: Path, goals: Sequence[str], cost: str | None, dead_ends: DeadEnds | None
) -> SSP:
    """Read a model from a CSV file; columns that do not describe outcomes are costs."""
    if not goals:
        message = f"{file.name} does not list the goal states: name them by "
        raise ModelError(message, Argument("goal"))
    columns = csv_columns(file)
    for name in _OUTCOME:
        if name not in columns:
            nearest = did_you_mean(name, columns, "it has")
            raise ModelError(f"{file.name} has no column {name!r}{nearest}")
    names = [name for name in columns if name not in _OUTCOME]
    place = chosen_reward(file, names, cost)
    ordered = names if place is None else [names[place], *names[:place], *names[place + 1 :]]
    return SSP.from_csv(file, goals, cost=ordered or "cost", dead_ends=dead_ends)


@explained
def write_any(model: SSP, path: str | Path, start: Start | None = None) -> None:
    """Write a model to a file; the ending of its name gives the format.

    Args:
        model: the model.
        path: the file.
        start: where episodes begin. It is not written to an .npz file, optional for .json, and
            must be one state for all other formats.

    Raises:
        ModelError: an unknown ending, no start, or names that cannot be written.
        OSError: the file cannot be written.
    """
    file = Path(path)
    ending = _ending_of(file, (*_JSON, _ARCHIVE, *_WRITERS))
    if isinstance(start, Mapping) and len(start) == 1:
        (start,) = start
    if ending in _JSON:
        write_text(file, model_in_json(model, start))
    elif ending == _ARCHIVE:
        save_model(model, file)
    else:
        if start is None:
            raise ModelError(f"say in which state {file.name} begins (", Argument("start"), ")")
        _WRITERS[ending](model, file, start=start)


def _ending_of(file: Path, endings: Sequence[str]) -> str:
    """Return the ending of a file's name; raise :class:`ModelError` if it is not in the list."""
    for ending in endings:
        if file.name.endswith(ending):
            return ending
    raise ModelError(f"{file.name!r} must end in one of {', '.join(endings)}")
