"""From the words of a shell to a model, and to a problem: the criterion and its limits."""

from __future__ import annotations

import json
import re
import sys
from argparse import Namespace
from ast import literal_eval
from collections.abc import Hashable, Mapping
from dataclasses import MISSING, dataclass, fields
from functools import cache
from typing import Any

import formulations
from formulations.command_line.arguments import CRITERIA, PARAMETERS, option
from ssp_lp import (
    SSP,
    Constraint,
    ModelError,
    Quantity,
    end_probability,
    expected_cost,
    failure_probability,
    goal_probability,
    secondary_cost,
    visits,
    within_steps,
)
from ssp_lp.errors import optional_module
from ssp_lp.formulation import Problem
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


_LIMIT = re.compile(r"(?P<words>.*?)\s*(?P<sign><=|>=|==)\s*(?P<bound>\S+)")
_TERM = re.compile(r"(?:(?P<factor>[^\s*]+)\s*\*\s*)?(?P<word>[^\s(]+)(?:\((?P<of>.*)\))?")
_PLAIN = {"cost": expected_cost, "goal": goal_probability, "failure": failure_probability}
_OF_STATES = {"visits": visits, "end": end_probability}


def problem_of(asked: Namespace, of: CommandModel) -> Problem:
    """The problem that a command asks about.

    Raises:
        ModelError: the criterion does not take, or lacks, an argument; or it refuses one.
    """
    criterion = getattr(formulations, CRITERIA[asked.criterion])
    takes = {field.name: field for field in fields(criterion) if field.name in PARAMETERS}
    given = {name: getattr(asked, name) for name in PARAMETERS if name in vars(asked)}
    for name in given:
        if name not in takes:
            known = ", ".join(map(option, takes)) or "none"
            raise ModelError(f"{asked.criterion} takes no {option(name)}; its options: {known}")
    for name, field in takes.items():
        if name not in given and field.default is MISSING and name != "failure_budget":
            raise ModelError(f"{asked.criterion} needs {option(name)}: {PARAMETERS[name].help}")
    if "quantity" in given:
        given["quantity"] = _problem_quantity(given["quantity"], of)
    limits: dict[str, Constraint] = {}
    for words in asked.limit:
        name, constraint = _problem_limit(words, of)
        limits[words if name in {"failure", *limits} else name] = constraint
    problem: Problem = criterion(
        of.model, of.start, **given, constraints=limits, horizon=of.horizon
    )
    return problem


def _problem_limit(words: str, of: CommandModel) -> tuple[str, Constraint]:
    """A limit and its name, the words of its quantity.

    Raises:
        ModelError: no quantity, sign and number.
    """
    found = _LIMIT.fullmatch(words.strip())
    if found is None:
        raise ModelError(f'a limit is a quantity, <=, >= or ==, and a number, not "{words}"')
    measured, bound = _problem_quantity(found["words"], of), _problem_number(found["bound"], words)
    if found["sign"] == "<=":
        return found["words"], measured <= bound
    return found["words"], measured >= bound if found["sign"] == ">=" else measured == bound


def _problem_quantity(words: str, of: CommandModel) -> Quantity:
    """A sum of quantities, " + " between them.

    Raises:
        ModelError: what is no quantity of this model.
    """
    terms = [_problem_term(one.strip(), words, of) for one in words.split(" + ")]
    return sum(terms[1:], start=terms[0])


def _problem_term(words: str, whole: str, of: CommandModel) -> Quantity:
    """A term of the sum of quantities that the command's problem limits."""
    found = _TERM.fullmatch(words)
    if found is None:
        raise ModelError(f'"{whole}" is no sum of quantities: cost + 2 * visits(ward)')
    word, states = found["word"], found["of"]
    if word in _OF_STATES and states:
        known = states in of.model.state_labels
        measured = _OF_STATES[word](states if known else state_named(of.model, states))
    elif word in _PLAIN:
        measured = _PLAIN[word]()
    else:
        measured = secondary_cost(of.model_with_cost(word).costs)
    return (
        measured if found["factor"] is None else _problem_number(found["factor"], whole) * measured
    )


def _problem_number(word: str, whole: str) -> float:
    """A number in the words of a problem's limit."""
    try:
        return float(word)
    except ValueError as error:
        raise ModelError(f'"{word}" in "{whole}" is no number') from error
