"""``ssp-lp solve``: the best policy within a failure budget, and its proof."""

from __future__ import annotations

import csv
from argparse import Namespace
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from formulations.command_line.criteria import problem_of
from formulations.command_line.models import Setting, setting_of
from formulations.command_line.pictures import figure_for
from formulations.command_line.tables import as_json
from ssp_lp import (
    GIVE_UP,
    DeterministicPolicy,
    ModelError,
    Solution,
    solve,
    success_costs,
)
from ssp_lp.io import policy_table, save_policy, write_controller, write_dot, write_scheduler
from ssp_lp.plotting import plot_cost_law
from ssp_lp.policies.policy import Policy


def run(asked: Namespace) -> Iterable[str]:
    """What is printed."""
    write, figure = _writer(asked.policy_out), figure_for(asked.plot)
    setting = setting_of(asked)
    tolerance = {} if asked.tolerance is None else {"tolerance": asked.tolerance}
    problem = problem_of(asked, setting)
    solution = solve(problem, asked.method, time_limit=asked.time_limit, **tolerance)
    if write is not None:
        write(solution, setting, asked.policy_out)
    if figure is not None:
        level = {} if asked.level is None else {"level": asked.level}
        plot_cost_law(success_costs(solution.policy, problem), ax=figure.subplots(), **level)
        figure.savefig(asked.plot)
    return as_json(_told(solution)) if asked.json else [solution.summary()]


def _told(solution: Solution) -> dict[str, Any]:
    """A solution as a table for other programs."""
    found = solution.evaluation
    members = zip(solution.policy.weights.tolist(), solution.policy.policies, strict=True)
    return {
        "criterion": type(solution.problem).__name__,
        "objective": solution.objective,
        "lower_bound": solution.lower_bound if solution.upper_bound is None else None,
        "upper_bound": solution.upper_bound,
        "gap": solution.gap,
        "goal_probability": found.goal_probability,
        "failure_probability": found.failure_probability,
        "conditional_cost": found.conditional_cost,
        "expected_cost": found.expected_cost,
        "failure_price": solution.failure_price,
        "limits": {
            name: {"value": value, "price": solution.prices.get(name, 0.0)}
            for name, value in solution.secondary_costs.items()
        },
        "ends": dict(found.ends),
        "policy": [{"weight": weight, **_decisions(member)} for weight, member in members],
        "method": solution.method,
        "seconds": solution.seconds,
        "note": solution.note,
    }


def _decisions(policy: Policy) -> dict[str, Any]:
    """The decisions of a policy of the state alone; of another one, what it is."""
    if not isinstance(policy, DeterministicPolicy):
        return {"kind": repr(policy)}
    return {
        "actions": {
            str(state): "give up" if action is GIVE_UP else str(action)
            for state, action in policy.actions().items()
        }
    }


Writer = Callable[[Solution, Setting, str], None]


def _writer(path: str | None) -> Writer | None:
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


def _write_table(solution: Solution, setting: Setting, path: str) -> None:
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("state", "memory", "action", "probability", "member"))
        rows.writerows(policy_table(solution.policy))


_WRITERS: dict[str, Writer] = {
    ".storm.json": lambda solution, setting, path: write_scheduler(
        solution.randomised_policy, path, start=setting.only_start
    ),
    ".npz": lambda solution, setting, path: save_policy(solution.policy, path),
    ".json": lambda solution, setting, path: write_controller(solution.policy, path),
    ".dot": lambda solution, setting, path: write_dot(solution.policy, path, setting.start),
    ".csv": _write_table,
}
