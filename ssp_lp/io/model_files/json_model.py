"""Models in JSON files: tables by name, and the explicit form of published cases."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.named_json import (
    UNIT,
    StatedModel,
    chosen_cost,
    named_model,
    stated_model,
)

EXPLICIT = "explicit-mdp-v1"
"""Where the "format" of a file begins so, it lists the choices of numbered states."""

_LONGEST = 1 << 30  # characters of a file, so that a packed one cannot ask for all memory


def read_json(path: Path, goal: Sequence[str], cost: str | None = None) -> StatedModel:
    """Read a model from a file, plain or gzip; see :func:`parse_json`.

    Raises:
        ModelError: no model.
        OSError: the file cannot be read.
    """
    try:
        with (gzip.open if path.suffix == ".gz" else open)(path, "rt", encoding="utf-8") as file:
            text = file.read(_LONGEST)
    except (UnicodeDecodeError, EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ModelError(f"{path.name} is no JSON: {error}") from error
    return parse_json(text, path.name, goal, cost)


def parse_json(text: str, source: str, goal: Sequence[str], cost: str | None = None) -> StatedModel:
    """The model that a text states, a table by name or an explicit case.

    Args:
        text: the JSON.
        source: what to call it in errors.
        goal: names of the goal states, or of a label of them; none: as the text says.
        cost: the name of the cost; None: the only one.

    Raises:
        ModelError: no such table, a name twice, no goal, or one that does not occur.
    """
    try:
        table = json.loads(text, object_pairs_hook=_without_repetition)
    except ModelError:
        raise
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{source} is no JSON: {error}") from error
    if isinstance(table, dict) and isinstance(table.get("format"), str):
        return _explicit(table, source, goal, cost)
    return named_model(table, source, goal, cost)


def _explicit(
    table: Mapping[str, Any], source: str, goal: Sequence[str], cost: str | None
) -> StatedModel:
    """A published case: numbered states, and for each the list of its choices."""
    if not str(table["format"]).startswith(EXPLICIT):
        raise ModelError(f"{source}: the format {table['format'][:40]!r} is not known")
    try:
        choices, labels = table["choices"], dict(table.get("labels", {}))
        goals = {g for one in goal for g in labels.get(one, [one])} or set(table["goal"] or ())
        names = {name for listed in choices for one in listed for name in one["rewards"]}
        transitions = {
            str(state): {
                _named(listed, at): _choice(choice, cost, names) for at, choice in enumerate(listed)
            }
            for state, listed in enumerate(choices)
        }
        marked = {name: [str(s) for s in members] for name, members in labels.items()}
        start = str(table["init"])
    except ModelError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ModelError(f"{source} is no {EXPLICIT} file: {error!r}") from error
    plain = {name: at for name, at in marked.items() if name not in {"goal", "init", "deadlock"}}
    return stated_model(transitions, source, [str(g) for g in goals], plain, start, None)


def _named(listed: Sequence[Any], at: int) -> str:
    """The name of a choice, with its position where another choice of the state has it, too."""
    name = str(listed[at]["name"])
    return name if sum(one["name"] == name for one in listed) == 1 else f"{at}:{name}"


def _choice(choice: Mapping[str, Any], cost: str | None, names: set[str]) -> list[list[Any]]:
    """The outcomes of a choice, whose cost goes with each of them."""
    none_given = dict.fromkeys(names, 0) or {UNIT: 1}
    paid = chosen_cost("its choices", {**none_given, **choice["rewards"]}, cost)
    return [[chance, successor, paid] for successor, chance in choice["to"]]


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object, in which no name may stand twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in found if names.count(name) > 1)
        raise ModelError(f"{twice!r} stands twice in one object")
    return found
