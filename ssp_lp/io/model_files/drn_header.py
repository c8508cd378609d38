"""The head of a DRN file: what kind of model follows, and how large it says it is."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.text_file import TextFile

_KINDS = ("MDP", "DTMC")
_NUMBERS = ("double", "rational")
_ONE_LINE = ("@parameters", "@reward_models", "@nr_states", "@nr_choices")


@dataclass(frozen=True)
class DrnHeader:
    """What a DRN file says before its states."""

    reward_models: tuple[str, ...]
    n_states: int
    n_choices: int | None

    def reward_column(self, cost: str | None, file: TextFile) -> int | None:
        """Position of the reward model that is the cost; None: the header names none.

        Raises:
            ModelError: there is none of this name, or several to choose from.
        """
        if cost == "" and not self.reward_models:
            return None  # Storm's model without a name, which the header does not show
        known = ", ".join(map(repr, self.reward_models)) or "none"
        if cost is None and len(self.reward_models) > 1:
            raise ModelError(f"{file.path}: choose one of the reward models, cost=...: {known}")
        if cost is None:
            return 0 if self.reward_models else None
        if cost not in self.reward_models:
            raise ModelError(f"{file.path}: no reward model {cost!r}; there are: {known}")
        return self.reward_models.index(cost)


def read_header(file: TextFile) -> DrnHeader:
    """Read up to the line ``@model``.

    Raises:
        ModelError: naming the line: a section that is unknown, twice there or missing, or a model
            of another type, with parameters or with intervals.
    """
    found: dict[str, str] = {}
    while (line := file.line()) != "@model":
        if line is None:
            raise file.fault("the file ends before @model")
        if not line:
            continue
        name, _, value = line.partition(":")
        if name in found:
            raise file.fault(f"{name} is there twice")
        if name in _ONE_LINE:
            value = file.line() or ""
        elif name not in ("@type", "@value_type"):
            raise file.fault(f"{name[:60]!r} is no section that can be read")
        found[name] = value.strip()
        _check(name, found[name], file)
    if "@type" not in found or "@nr_states" not in found:
        raise file.fault("@type and @nr_states must come before @model")
    return DrnHeader(
        reward_models=tuple(word.strip('"') for word in found.get("@reward_models", "").split()),
        n_states=int(found["@nr_states"]),
        n_choices=int(found["@nr_choices"]) if "@nr_choices" in found else None,
    )


def _check(name: str, value: str, file: TextFile) -> None:
    """Raise :class:`ModelError` for a value that is not understood."""
    if name == "@type" and value.upper() not in _KINDS:
        raise file.fault(f"models of type {value[:60]!r} are not read, only {' and '.join(_KINDS)}")
    if name == "@value_type" and value not in _NUMBERS:
        raise file.fault(f"values of type {value[:60]!r} are not read, only double and rational")
    if name == "@parameters" and value:
        raise file.fault("a model with parameters has no numbers; instantiate it first")
    if name in ("@nr_states", "@nr_choices") and not re.fullmatch(r"\d{1,18}", value, re.ASCII):
        raise file.fault(f"{name} is followed by {value[:60]!r}, which is no number")
