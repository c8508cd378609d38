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
from ssp_lp.errors import optional_module
from ssp_lp.io import from_gymnasium, read_any
from ssp_lp.io.model_files.json_model import parse_json

ENVIRONMENT = "gym:"
"""What stands before the name of an environment of Gymnasium's."""

Start = Hashable | Mapping[Hashable, float]


@dataclass(frozen=True)
class CommandModel:
    """A model, where it begins, and the environment that it is of, if it is of one."""

    asked: Namespace
    model: SSP
    stated_start: Start | None
    horizon: int | None  # steps within which the goal is to be reached
    environment: Any = None

    @property
    def start(self) -> Start:
        """Where an episode of the command's model begins.

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

    @property
    def written_out(self) -> tuple[SSP, Start | None]:
        """A model that needs no horizon beside it, its states counting the steps, and its start.

        Raises:
            ModelError: a horizon without a start.
        """
        if self.horizon is None:
            return self.model, self.stated_start
        begin = self.start if isinstance(self.start, Mapping) else {self.start: 1.0}
        counting = within_steps(self.model, self.horizon, start=begin)
        return counting, counting.start(begin)

    def model_with_cost(self, name: str) -> SSP:
        """The same model with another of its costs.

        Raises:
            ModelError: it has no such cost.
        """
        return command_model(Namespace(**{**vars(self.asked), "cost": name})).model


def command_model(asked: Namespace) -> CommandModel:
    """Read the model that a command names.

    Raises:
        ModelError: no model, or a start that is none.
        MissingDependencyError: an environment, and Gymnasium is not installed.
        OSError: the file cannot be read.
    """
    if asked.model.startswith(ENVIRONMENT):
        return _model_of_environment(asked)
    if asked.model == "-":
        stated = parse_json(_model_from_standard_input(), "standard input", asked.goal, asked.cost)
    else:
        stated = read_any(asked.model, asked.goal, asked.cost, asked.constants)
    model, start = stated
    if asked.start is not None:
        start = state_named(model, asked.start)
    return CommandModel(asked, model, start, None if asked.horizon == "env" else asked.horizon)


@cache
def _model_from_standard_input() -> str:
    """All that is read there, once for all the costs of a model."""
    return sys.stdin.read()


def _model_of_environment(asked: Namespace) -> CommandModel:
    """The model of a Gymnasium environment that the command line names."""
    gymnasium = optional_module("gymnasium", "gym")
    name, *words = asked.model.removeprefix(ENVIRONMENT).split(",")
    arguments = {key: _value_for_model(word) for key, _, word in (w.partition("=") for w in words)}
    try:
        environment = gymnasium.make(name, **arguments)
    except (gymnasium.error.Error, TypeError, KeyError, ModuleNotFoundError) as error:
        raise ModelError(f"Gymnasium makes no environment of {asked.model!r}: {error}") from error
    goals = set(asked.goal)
    world = from_gymnasium(
        environment,
        goal=(lambda state: str(state) in goals) if goals else None,
        cost=asked.cost or "step",
        horizon=None,
        start=None if asked.start is None else _value_for_model(asked.start),
    )
    horizon = world.step_limit if asked.horizon == "env" else asked.horizon
    return CommandModel(asked, world.model, world.start, horizon, environment)


def _value_for_model(word: str) -> Any:
    """A word as what it means in Python or JSON: a number, a tuple, true; else itself."""
    for read in (literal_eval, json.loads):
        try:
            return read(word)
        except (ValueError, SyntaxError):
            continue
    return word


def state_named(model: SSP, word: str) -> Hashable:
    """The state that prints as a word; the word itself where there is none, to be told of."""
    return next((state for state in model.states if str(state) == word), word)
