"""The command ``ssp-lp``: a model in a file, what it holds, and what is best in it.

    ssp-lp info roads.json --goal home --start depot
    ssp-lp solve roads.json --goal home --start depot --criterion mcmp --failure-budget 0.05

A model is ``{state: {action: [[probability, successor, cost], ...]}}`` in JSON; a state without
actions that is no goal is a dead-end. The command ends with 0, with 2 for wrong arguments or
models, with 3 where no policy keeps to the budget, and with 1 where a method failed.
"""

from __future__ import annotations

import json
import math
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Hashable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from ssp_lp.errors import InfeasibleError, ModelError, SolverError, SSPError
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import attention_states, dead_ends
from ssp_lp.model.nearest import did_you_mean
from ssp_lp.policies import DeterministicPolicy, Policy
from ssp_lp.problem import Problem
from ssp_lp.solution import Solution
from ssp_lp.solve import solve

WRONG_INPUT, INFEASIBLE, FAILED = 2, 3, 1
"""Exit codes besides 0."""

_CRITERIA = {"mcmp": "MCMP", "s3p": "S3P", "maxprob": "MaxProb"}


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
        ModelError: no such table, a name twice, or a goal that does not occur.
        OSError: the file cannot be read.
    """
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


READERS: dict[str, Reader] = {".json": read_json}
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit code.

    Args:
        arguments: those of the command line, if left out.
    """
    asked = _parser().parse_args(arguments)
    try:
        print(_answer(asked))
    except InfeasibleError as error:
        return _complain(error, INFEASIBLE)
    except SolverError as error:
        return _complain(error, FAILED)
    except (SSPError, OSError) as error:
        return _complain(error, WRONG_INPUT)
    return 0


def _complain(error: Exception, code: int) -> int:
    print(f"ssp-lp: {error}", file=sys.stderr)
    return code


def _parser() -> ArgumentParser:
    parser = ArgumentParser(prog="ssp-lp", description="Shortest paths with a failure budget.")
    commands = parser.add_subparsers(dest="command", required=True)
    info = commands.add_parser("info", help="what a model holds")
    solving = commands.add_parser("solve", help="the best policy within a failure budget")
    for command in (info, solving):
        command.add_argument("model", help="a file, such as roads.json")
        command.add_argument("--goal", nargs="+", required=True, help="the goal states")
        command.add_argument("--start", help="the state in which an episode begins")
        command.add_argument("--json", action="store_true", help="print the answer as JSON")
    solving.add_argument("--criterion", choices=sorted(_CRITERIA), default="mcmp")
    solving.add_argument("--failure-budget", type=float, help="left out: as low as possible")
    return parser


def _answer(asked: Namespace) -> str:
    """What is printed."""
    stated = read_any(asked.model, asked.goal)
    start = stated.start if asked.start is None else asked.start
    if asked.command == "info":
        facts = _facts(stated.model, start)
        if asked.json:
            return json.dumps(facts, indent=2)
        return "\n".join(f"{name:<17} {value:,}" for name, value in facts.items())
    if start is None:
        raise ModelError("say where an episode begins: --start STATE")
    solution = solve(_problem(asked, stated.model, start))
    return json.dumps(_told(solution), indent=2) if asked.json else solution.summary()


def _facts(model: SSP, start: Hashable | Mapping[Hashable, float] | None) -> dict[str, float]:
    """Sizes of a model, and the least failure from the start, if there is one."""
    facts: dict[str, float] = {
        "states": model.n_states,
        "pairs": model.n_pairs,
        "outcomes": model.n_outcomes,
        "goals": int(model.goal_mask.sum()),
        "dead-ends": int(dead_ends(model).sum()),
        "attention states": int(attention_states(model).sum()),
    }
    if start is not None:
        facts["least failure"] = solve(_criterion("maxprob")(model, start)).failure_probability
    return facts


def _criterion(name: str) -> Callable[..., Problem]:
    """A criterion by its name, looked up when the command runs: the library knows no page."""
    found: Callable[..., Problem] = getattr(import_module("formulations"), _CRITERIA[name])
    return found


def _problem(asked: Namespace, model: SSP, start: Hashable | Mapping[Hashable, float]) -> Problem:
    if asked.criterion == "maxprob":
        if asked.failure_budget is not None:
            raise ModelError("maxprob takes no failure budget: it fails as little as possible")
        return _criterion("maxprob")(model, start)
    return _criterion(asked.criterion)(model, start, asked.failure_budget)


def _told(solution: Solution) -> dict[str, Any]:
    """A solution as a table for other programs; what is no finite number is null."""
    found = solution.evaluation
    numbers = {
        "objective": solution.objective,
        "lower_bound": solution.lower_bound if solution.upper_bound is None else None,
        "upper_bound": solution.upper_bound,
        "gap": solution.gap,
        "goal_probability": found.goal_probability,
        "failure_probability": found.failure_probability,
        "conditional_cost": found.conditional_cost,
        "expected_cost": found.expected_cost,
        "failure_price": solution.failure_price,
    }
    members = zip(solution.policy.weights.tolist(), solution.policy.policies, strict=True)
    return {
        "criterion": type(solution.problem).__name__,
        **{name: x if x is not None and math.isfinite(x) else None for name, x in numbers.items()},
        "ends": dict(found.ends),
        "policy": [{"weight": weight, **_decisions(member)} for weight, member in members],
        "method": solution.method,
        "seconds": solution.seconds,
    }


def _decisions(policy: Policy) -> dict[str, Any]:
    """The decisions of a policy of the state alone; of another one, what it is."""
    if not isinstance(policy, DeterministicPolicy):
        return {"kind": repr(policy)}
    return {
        "actions": {
            str(state): action if isinstance(action, str) else "give up"
            for state, action in policy.actions().items()
        }
    }
