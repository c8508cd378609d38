"""From the words of a shell to a problem: the criterion, what it takes, and its limits."""

from __future__ import annotations

import re
from argparse import Namespace
from dataclasses import MISSING, fields

import formulations
from formulations.command_line.arguments import CRITERIA, PARAMETERS, option
from formulations.command_line.models import CommandModel, state_named
from ssp_lp import (
    Constraint,
    ModelError,
    Quantity,
    end_probability,
    expected_cost,
    failure_probability,
    goal_probability,
    secondary_cost,
    visits,
)
from ssp_lp.formulation import Problem

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
