"""Models from and to files of any known format: the ending of a file's name says which."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ssp_lp.errors import Argument, ModelError
from ssp_lp.io.archives import load_model, save_model
from ssp_lp.io.model_files.drn import read_drn, write_drn
from ssp_lp.io.model_files.json_model import StatedModel, model_in_json, read_json
from ssp_lp.io.model_files.prism import read_prism, write_prism
from ssp_lp.io.model_files.raw_model import ModelFile
from ssp_lp.io.model_files.text_file import write_text
from ssp_lp.io.storm_models import Constants, read_with_storm, write_umb
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained

Reader = Callable[[Path, Sequence[str], str | None], StatedModel]
"""Reads a file, given the names of the goals and of the cost."""


Start = Hashable | Mapping[Hashable, float]


@explained
def read_any(
    path: str | Path,
    goal: str | Sequence[str],
    cost: str | None = None,
    constants: Constants | None = None,
) -> StatedModel:
    """Read a model from a file, whose name's ending says in which format it is.

    Programs (.prism, .nm, .pm, .jani) and .umb are read through Storm (the extra ``storm``).

    Args:
        path: the file.
        goal: name or names of the goal states, or a label of them where the format has labels, or a
            condition on the variables of a program.
        cost: the name of the cost, where the format has several; None: the only one.
        constants: of a program, "N=5,p=0.1" or by name.

    Raises:
        MissingDependencyError: the format needs stormpy, which is not installed.
        ModelError: an unknown ending, or no model.
        OSError: the file cannot be read.
    """
    file = Path(path)
    reader: Reader = _format_by_ending(file, READERS)
    if constants and reader is not _read_with_storm:
        raise ModelError(f"{file.name} has no constants: leave ", Argument("constants"), " out")
    if reader is _read_with_storm:
        reader = partial(_read_with_storm, constants=constants)
    return reader(file, [goal] if isinstance(goal, str) else goal, cost)


@explained
def write_any(model: SSP, path: str | Path, start: Start | None = None) -> None:
    """Write a model to a file, whose name's ending says in which format; .umb through Storm.

    Args:
        model: the model.
        path: the file.
        start: where episodes begin. An .npz file does not say so, .json need not, and the others
            know one state only.

    Raises:
        MissingDependencyError: the format needs stormpy, which is not installed.
        ModelError: an unknown ending, no start, or names that cannot be written.
        OSError: the file cannot be written.
    """
    file = Path(path)
    _format_by_ending(file, WRITERS)(model, file, start)


def _format_by_ending(file: Path, table: Mapping[str, Any]) -> Any:
    """What format the ending of a file's name stands for."""
    for suffix, found in table.items():
        if file.name.endswith(suffix):
            return found
    raise ModelError(f"{file.name!r} ends in none of {', '.join(table)}")


def _format_by_label(read: Callable[..., ModelFile]) -> Callable[..., StatedModel]:
    """A reader of a format whose goals are the states of one label."""

    def labelled(path: Path, goal: Sequence[str], cost: str | None, **more: Any) -> StatedModel:
        """Read a file; its goals are the states of the one label."""
        if len(goal) != 1:
            goals = Argument("goal")
            raise ModelError(f"{path}: name the one label whose states are goals (", goals, ")")
        found = read(path, goal=goal[0], cost=cost, **more)
        states = found.initial_states
        return StatedModel(found.model, states[0] if len(states) == 1 else None)

    return labelled


_read_drn, _read_prism = _format_by_label(read_drn), _format_by_label(read_prism)
_read_with_storm = _format_by_label(read_with_storm)


def _read_archive_format(path: Path, goal: Sequence[str], cost: str | None) -> StatedModel:
    """Read the format of an archive, which says its goals itself."""
    if goal:
        raise ModelError(
            f"{path.name} says itself which states are goals: leave ", Argument("goal"), " out"
        )
    if cost is not None:
        raise ModelError(
            f"{path.name} has one cost, without a name: leave ", Argument("cost"), " out"
        )
    return StatedModel(load_model(path))


def _write_json_format(model: SSP, path: Path, start: Start | None) -> None:
    """Write a model in the format of JSON."""
    write_text(path, model_in_json(model, start))


def _write_archive_format(model: SSP, path: Path, start: Start | None) -> None:
    """Write a model in the format of an archive."""
    save_model(model, path)


def _format_from_one_state(write: Callable[..., None]) -> Callable[[SSP, Path, Start | None], None]:
    """A writer of a format that knows one initial state."""

    def written(model: SSP, path: Path, start: Start | None) -> None:
        """Write a model that begins in one state."""
        if isinstance(start, Mapping) and len(start) == 1:
            (start,) = start
        if start is None:
            raise ModelError(f"say in which state {path.name} begins (", Argument("start"), ")")
        write(model, path, start=start)

    return written


READERS: dict[str, Reader] = {
    ".json": read_json,
    ".json.gz": read_json,
    ".drn": _read_drn,
    ".drn.gz": _read_drn,
    ".tra": _read_prism,
    ".npz": _read_archive_format,
    ".prism": _read_with_storm,
    ".nm": _read_with_storm,
    ".pm": _read_with_storm,
    ".jani": _read_with_storm,
    ".umb": _read_with_storm,
}
"""What reads a file, by the ending of its name."""

WRITERS: dict[str, Callable[[SSP, Path, Start | None], None]] = {
    ".json": _write_json_format,
    ".json.gz": _write_json_format,
    ".drn": _format_from_one_state(write_drn),
    ".drn.gz": _format_from_one_state(write_drn),
    ".tra": _format_from_one_state(write_prism),
    ".npz": _write_archive_format,
    ".umb": _format_from_one_state(write_umb),
}
"""What writes a file, by the ending of its name."""
