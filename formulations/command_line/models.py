"""The model that a command is about: from a file, from standard input, or an environment's."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from ast import literal_eval
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from ssp_lp import SSP, ModelError, within_steps
from ssp_lp.errors import MissingDependencyError
from ssp_lp.io import from_gymnasium
from ssp_lp.io.any_format import read_any
from ssp_lp.io.model_files.json_model import StatedModel, parse_json

ENVIRONMENT = "gym:"
"""What stands before the name of an environment of Gymnasium's."""

Start = Hashable | Mapping[Hashable, float]


@dataclass(frozen=True)
class Setting:
    """A model, where it begins, and the environment that it is of, if it is of one."""

    asked: Namespace
    model: SSP
    stated_start: Start | None
    environment: Any = None

    @property
    def start(self) -> Start:
        """Where an episode begins.

        Raises:
            ModelError: neither the model nor the user says so.
        """
        if self.stated_start is None:
            raise ModelError("say where an episode begins: --start STATE")
        return self.stated_start

    @property
    def only_start(self) -> Start | None:
        """The start; where it is one state for sure, that state, as most formats have it."""
        start = self.stated_start
        return next(iter(start)) if isinstance(start, Mapping) and len(start) == 1 else start

    def state_named(self, word: str) -> Hashable:
        """The state that prints as a word; the word itself where there is none, to be told of."""
        return _state_named(self.model, word)

    def with_cost(self, name: str) -> SSP:
        """The same model with another of its costs.

        Raises:
            ModelError: it has no such cost.
        """
        return setting_of(Namespace(**{**vars(self.asked), "cost": name})).model


def setting_of(asked: Namespace) -> Setting:
    """Read the model that a command names.

    Raises:
        ModelError: no model, or a start that is none.
        MissingDependencyError: an environment, and Gymnasium is not installed.
        OSError: the file cannot be read.
    """
    if asked.model.startswith(ENVIRONMENT):
        return _of_environment(asked)
    if asked.model == "-":
        stated = parse_json(_standard_input(), "standard input", asked.goal, asked.cost)
    else:
        stated = read_any(asked.model, asked.goal, asked.cost, asked.constants)
    model, start = stated
    if asked.start is not None:
        start = _state_named(model, asked.start)
    if asked.horizon in ("env", None):
        return Setting(asked, model, start)
    return Setting(asked, *_within(StatedModel(model, start), asked.horizon))


def _within(stated: StatedModel, steps: int) -> tuple[SSP, Start]:
    """The model that counts steps, and its start."""
    if stated.start is None:
        raise ModelError("--horizon needs a start: --start STATE")
    begin = stated.start if isinstance(stated.start, Mapping) else {stated.start: 1.0}
    counting = within_steps(stated.model, steps, start=begin)
    return counting, counting.start(begin)


@cache
def _standard_input() -> str:
    """All that is read there, once for all the costs of a model."""
    return sys.stdin.read()


def _of_environment(asked: Namespace) -> Setting:
    try:
        import gymnasium
    except ImportError as error:
        raise MissingDependencyError("gymnasium", "gym") from error
    name, *words = asked.model.removeprefix(ENVIRONMENT).split(",")
    arguments = {key: _value(word) for key, _, word in (w.partition("=") for w in words)}
    try:
        environment = gymnasium.make(name, **arguments)
    except (gymnasium.error.Error, TypeError, KeyError, ModuleNotFoundError) as error:
        raise ModelError(f"Gymnasium makes no environment of {asked.model!r}: {error}") from error
    goals = set(asked.goal)
    world = from_gymnasium(
        environment,
        goal=(lambda state: str(state) in goals) if goals else None,
        cost=asked.cost or "step",
        horizon=asked.horizon,
        start=None if asked.start is None else _value(asked.start),
    )
    return Setting(asked, world.model, world.start, environment)


def _value(word: str) -> Any:
    """A word as what it means in Python or JSON: a number, a tuple, true; else itself."""
    for read in (literal_eval, json.loads):
        try:
            return read(word)
        except (ValueError, SyntaxError):
            continue
    return word


def _state_named(model: SSP, word: str) -> Hashable:
    return next((state for state in model.states if str(state) == word), word)
