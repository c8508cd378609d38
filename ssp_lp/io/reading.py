"""Models from files of any known format: the ending of a file's name says which."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ssp_lp.errors import ModelError
from ssp_lp.io.drn import read_drn
from ssp_lp.io.model_archive import load_model
from ssp_lp.io.model_files.json_model import read_json
from ssp_lp.io.model_files.model_file import ModelFile
from ssp_lp.io.model_files.named_json import StatedModel
from ssp_lp.io.prism import read_prism

Reader = Callable[[Path, Sequence[str], str | None], StatedModel]
"""Reads a file, given the names of the goals and of the cost."""


def read_any(path: str | Path, goal: Sequence[str], cost: str | None = None) -> StatedModel:
    """Read a model from a file, whose name's ending says in which format it is.

    Args:
        path: the file.
        goal: names of the goal states, or of a label of them where the format has labels.
        cost: the name of the cost, where the format has several; None: the only one.

    Raises:
        ModelError: an unknown ending, or no model.
        OSError: the file cannot be read.
    """
    file = Path(path)
    for suffix, reader in READERS.items():
        if file.name.endswith(suffix):
            return reader(file, goal, cost)
    raise ModelError(f"{file.name!r} ends in none of {', '.join(READERS)}")


def _read_drn(path: Path, goal: Sequence[str], cost: str | None) -> StatedModel:
    return _stated(read_drn(path, goal=_label(path, goal), cost=cost))


def _read_prism(path: Path, goal: Sequence[str], cost: str | None) -> StatedModel:
    return _stated(read_prism(path.with_suffix(""), goal=_label(path, goal), cost=cost))


def _read_archive(path: Path, goal: Sequence[str], cost: str | None) -> StatedModel:
    if goal:
        raise ModelError(f"{path.name} says itself which states are goals")
    if cost is not None:
        raise ModelError(f"{path.name} has one cost, without a name")
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
    ".json.gz": read_json,
    ".drn": _read_drn,
    ".drn.gz": _read_drn,
    ".tra": _read_prism,
    ".npz": _read_archive,
}
"""What reads a file, by the ending of its name."""
