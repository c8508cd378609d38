"""How answers leave a command: JSON for other programs, tables, pictures, files of policies."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from formulations.command_line.arguments import option
from formulations.command_line.models import CommandModel
from ssp_lp import ModelError, Solution, SSPError
from ssp_lp.errors import Argument, optional_module
from ssp_lp.io import policy_table, save_policy, write_controller, write_dot, write_scheduler

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def json_answer(answer: Any) -> list[str]:
    """The lines of an answer in JSON; what is no finite number is null."""
    return [json.dumps(_finite_answer(answer), indent=2, ensure_ascii=False)]


def _finite_answer(value: Any) -> Any:
    """An answer in which what is no finite number is None."""
    if isinstance(value, Mapping):
        return {name: _finite_answer(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite_answer(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def with_options(error: SSPError) -> str:
    """An error's message, in which options of the command line stand for Python's arguments."""
    parts = (option(*part) if isinstance(part, Argument) else str(part) for part in error.args)
    return "".join(parts)


def aligned_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Rows under their headings, each column as wide as what it holds."""
    table = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(map(str.rjust, cells, widths)) for cells in table]


def figure_for(path: str | None) -> Figure | None:
    """A figure that can be saved there, known before anything is solved; None: none is asked for.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: no picture has this ending.
    """
    if path is None:
        return None
    module = optional_module("matplotlib.figure", "plot")
    figure: Figure = module.Figure(figsize=(6.4, 4.2), layout="constrained")  # needs no screen
    known = figure.canvas.get_supported_filetypes()
    if Path(path).suffix.removeprefix(".") not in known:
        raise ModelError(f"a picture is written as {', '.join(sorted(known))}, not {path!r}")
    return figure


PolicyWriter = Callable[[Solution, CommandModel, str], None]


def policy_writer(path: str | None) -> PolicyWriter | None:
    """What writes a policy to a file, by the ending of its name; known before anything is solved.

    Raises:
        ModelError: another ending.
    """
    if path is None:
        return None
    for ending, write in _WRITERS.items():
        if path.endswith(ending):
            return write
    raise ModelError(f"a policy is written as {', '.join(_WRITERS)}, not {path!r}")


def _write_answer_table(solution: Solution, of: CommandModel, path: str) -> None:
    """Write the policy of an answer as a table."""
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("state", "memory", "action", "probability", "member"))
        rows.writerows(policy_table(solution.policy))


_WRITERS: dict[str, PolicyWriter] = {
    ".storm.json": lambda solution, of, path: write_scheduler(
        solution.randomised_policy, path, start=of.only_start
    ),
    ".npz": lambda solution, of, path: save_policy(solution.policy, path),
    ".json": lambda solution, of, path: write_controller(solution.policy, path),
    ".dot": lambda solution, of, path: write_dot(solution.policy, path, of.start),
    ".csv": _write_answer_table,
}
