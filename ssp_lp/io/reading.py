"""Models from files of any known format: the ending of a file's name says which."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ssp_lp.errors import ModelError
from ssp_lp.io.drn import read_drn
from ssp_lp.io.model_archive import load_model
from ssp_lp.io.model_files.model_file import ModelFile
from ssp_lp.io.prism import read_prism
from ssp_lp.model import SSP
from ssp_lp.model.nearest import did_you_mean


class StatedModel(NamedTuple):
    """A model as a file states it, and where it begins, if the file says so."""

    model: SSP
    start: Hashable | Mapping[Hashable, float] | None = None


Reader = Callable[[Path, Sequence[str]], StatedModel]
"""Reads a file, given the names of the goals."""


def read_any(path: str | Path, goal: Sequence[str]) -> StatedModel:
    """Read a model from a file, whose name's ending says in which format it is.

    Args:
        path: the file.
        goal: names of the goal states, or of a label of them where the format has labels.

    Raises:
        ModelError: an unknown ending, or no model.
        OSError: the file cannot be read.
    """
    file = Path(path)
    for suffix, reader in READERS.items():
        if file.name.endswith(suffix):
            return reader(file, goal)
    raise ModelError(f"{file.name!r} ends in none of {', '.join(READERS)}")


def read_json(path: Path, goal: Sequence[str]) -> StatedModel:
    """Read ``{state: {action: [[probability, successor, cost], ...]}}``; names are words.

    Raises:
        ModelError: no such table, a name twice, no goal, or one that does not occur.
        OSError: the file cannot be read.
    """
    if not goal:
        raise ModelError(f"{path.name} does not say which states are goals: name them")
    try:
        table = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=_without_repetition)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ModelError(f"{path.name} is no JSON: {error}") from error
    if not isinstance(table, dict):
        raise ModelError(f"{path.name} must hold {{state: {{action: [[probability, successor, "
                         "cost], ...]}}")  # fmt: skip
    transitions = {state: _actions(state, actions) for state, actions in table.items()}
    met = {to for actions in transitions.values() for some in actions.values() for _, to, _ in some}
    for name in goal:
        if name not in transitions and name not in met:
            names = [*transitions, *(to for to in met if to not in transitions)]
            raise ModelError(f"the goal {name!r} does not occur{did_you_mean(name, names)}")
    return StatedModel(
        SSP.from_transitions(transitions, set(goal), treat_actionless_as_dead_ends=True)
    )


def _read_drn(path: Path, goal: Sequence[str]) -> StatedModel:
    return _stated(read_drn(path, goal=_label(path, goal)))


def _read_prism(path: Path, goal: Sequence[str]) -> StatedModel:
    return _stated(read_prism(path.with_suffix(""), goal=_label(path, goal)))


def _read_archive(path: Path, goal: Sequence[str]) -> StatedModel:
    if goal:
        raise ModelError(f"{path.name} says itself which states are goals")
    return StatedModel(load_model(path))


def _label(path: Path, goal: Sequence[str]) -> str:
    """The one label of goals."""
    if len(goal) != 1:
        raise ModelError(f"{path.name}: goals are the states of one label")
    return goal[0]


def _stated(file: ModelFile) -> StatedModel:
    states = file.initial_states
    return StatedModel(file.model, states[0] if len(states) == 1 else None)


READERS: dict[str, Reader] = {
    ".json": read_json,
    ".drn": _read_drn,
    ".drn.gz": _read_drn,
    ".tra": _read_prism,
    ".npz": _read_archive,
}
"""What reads a file, by the ending of its name."""


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object, in which no name may stand twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in found if names.count(name) > 1)
        raise ModelError(f"{twice!r} stands twice in one object")
    return found


def _actions(state: str, actions: Any) -> dict[Hashable, list[tuple[Any, Hashable, Any]]]:
    """The actions of a state, successors given as numbers read as words."""
    if not isinstance(actions, dict):
        raise ModelError(f"state {state!r} needs {{action: [[probability, successor, cost], ...]}}")
    return {name: _outcomes(state, name, outcomes) for name, outcomes in actions.items()}


def _outcomes(state: str, action: str, outcomes: Any) -> list[tuple[Any, Hashable, Any]]:
    """The outcomes of an action, checked for their form."""
    found: list[tuple[Any, Hashable, Any]] = []
    for outcome in outcomes if isinstance(outcomes, list) else [outcomes]:
        fits = isinstance(outcome, list) and len(outcome) == 3
        if not fits or not isinstance(outcome[1], (str, int)):
            raise ModelError(
                f"action {action!r} of state {state!r}: an outcome must be [probability, "
                f"successor, cost], not {json.dumps(outcome)}"
            )
        found.append((outcome[0], str(outcome[1]), outcome[2]))
    return found
