"""The command ``ssp-lp``: a model in a file, what it holds, and what is best in it.

    ssp-lp info roads.json --goal home --start depot
    ssp-lp solve roads.json --goal home --start depot --criterion mcmp --failure-budget 0.05

A model is ``{state: {action: [[probability, successor, cost], ...]}}`` in JSON (a state without
actions that is no goal is a dead-end), Storm's DRN, PRISM's explicit files or the library's own
archive. The command ends with 0, with 2 for wrong arguments or
models, with 3 where no policy keeps to the budget, and with 1 where a method failed.
"""

from __future__ import annotations

import json
import math
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

from formulations.maxprob import MaxProb
from formulations.mcmp import MCMP
from formulations.s3p import S3P
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    ModelError,
    Solution,
    SolverError,
    SSPError,
    solve,
)
from ssp_lp.formulation import Problem, attention_labels, dead_end_labels
from ssp_lp.io import save_policy
from ssp_lp.io.reading import read_any
from ssp_lp.policies.policy import Policy

WRONG_INPUT, INFEASIBLE, FAILED = 2, 3, 1
"""Exit codes besides 0."""

_CRITERIA = ("maxprob", "mcmp", "s3p")


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
        command.add_argument("model", help="a file: .json, .drn, .drn.gz, .tra or .npz")
        command.add_argument(
            "--goal", nargs="+", default=[], help="the goal states, or their label"
        )
        command.add_argument("--start", help="the state in which an episode begins")
        command.add_argument("--json", action="store_true", help="print the answer as JSON")
    solving.add_argument("--criterion", choices=_CRITERIA, default="mcmp")
    solving.add_argument("--policy-out", help="write the policy to this file (.npz)")
    solving.add_argument("--failure-budget", type=float, help="left out: as low as possible")
    return parser


def _answer(asked: Namespace) -> str:
    """What is printed."""
    stated = read_any(asked.model, asked.goal)
    start = stated.start if asked.start is None else _state_named(stated.model, asked.start)
    if asked.command == "info":
        facts = _facts(stated.model, start)
        if asked.json:
            return json.dumps(facts, indent=2)
        return "\n".join(f"{name:<17} {value:,}" for name, value in facts.items())
    if start is None:
        raise ModelError("say where an episode begins: --start STATE")
    solution = solve(_problem(asked, stated.model, start))
    if asked.policy_out is not None:
        save_policy(solution.policy, asked.policy_out)
    return json.dumps(_told(solution), indent=2) if asked.json else solution.summary()


def _state_named(model: SSP, word: str) -> Hashable:
    """The state that prints as a word; the word itself where there is none, to be told of."""
    return next((state for state in model.states if str(state) == word), word)


def _facts(model: SSP, start: Hashable | Mapping[Hashable, float] | None) -> dict[str, float]:
    """Sizes of a model, and the least failure from the start, if there is one."""
    facts: dict[str, float] = {
        "states": model.n_states,
        "pairs": model.n_pairs,
        "outcomes": model.n_outcomes,
        "goals": int(model.goal_mask.sum()),
        "dead-ends": len(dead_end_labels(model)),
        "attention states": len(attention_labels(model)),
    }
    if start is not None:
        facts["least failure"] = solve(MaxProb(model, start)).failure_probability
    return facts


def _problem(asked: Namespace, model: SSP, start: Hashable | Mapping[Hashable, float]) -> Problem:
    if asked.criterion == "maxprob":
        if asked.failure_budget is not None:
            raise ModelError("maxprob takes no failure budget: it fails as little as possible")
        return MaxProb(model, start)
    criterion = S3P if asked.criterion == "s3p" else MCMP
    return criterion(model, start, asked.failure_budget)


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
