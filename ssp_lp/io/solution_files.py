"""Solutions in files, to be read beside the problem that they answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from math import isclose
from typing import Any

import numpy as np

from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import ModelError
from ssp_lp.io.archive import damage_named, read_archive, write_archive
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.io.policy_files import PolicyRecords, policy_in
from ssp_lp.model.arguments import explained
from ssp_lp.options import Status
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem, conditions_of, unrolled
from ssp_lp.processes.failure_semantics import start_distribution
from ssp_lp.solution import Run, Solution, as_solved

_VERSION = 1

_NUMBERS = (
    "objective",
    "lower_bound",
    "failure_price",
    "budget_used",
    "note",
    "upper_bound",
)

_ROUNDING = 1e-9
"""Relative; a budget that is a share of the greatest goal probability is worked out afresh."""


@explained
def save_solution(solution: Solution, path: FilePath) -> None:
    """Write a solution to a file: its policy, numbers, prices, value function and run.

    The model and the problem are not in it: :func:`load_solution` is given the problem.

    Args:
        solution: of ``solve``, or put together by hand.
        path: of the file, ``solution.npz``; no ending is added to it.

    Raises:
        ModelError: its policy is of a class that cannot be saved.
    """
    as_solved(solution, "save_solution")
    problem, records, values = solution.problem, PolicyRecords(), solution.value_function
    header = records.header(solution.policy)
    header["problem"] = _solution_words(problem)
    header["start"] = records.add_array(start_distribution(problem.model, problem.start))
    header["numbers"] = {name: getattr(solution, name) for name in _NUMBERS}
    header["prices"] = {name: float(price) for name, price in solution.prices.items()}
    header["value_function"] = None if values is None else records.add_array(np.asarray(values))
    header["run"], header["status"] = asdict(solution.run), solution.status.name
    write_archive(path, "solution", _VERSION, header, records.arrays)


@explained
def load_solution(path: FilePath, problem: Problem) -> Solution:
    """Read a solution beside its problem, stated again; ``certify`` says of it what it said before.

    Args:
        path: a file of :func:`save_solution`.
        problem: the problem, on the same model.

    Raises:
        ModelError: the file is none of a solution, the model is another one, or the problem has
            another criterion, start, budget, discount, penalty, or other limits.
    """
    model = unrolled(problem).model
    header, arrays = read_archive(path, "solution", _VERSION)
    with damage_named(path):
        policy = policy_in(header, arrays, model, check=True)
        _check_problem(problem, header["problem"], arrays[header["start"]])
        if not isinstance(policy, MixedPolicy):
            raise TypeError("no lottery")
        run, values = header["run"], header["value_function"]
        return Solution(
            problem=problem,
            policy=policy,
            value_function=None if values is None else arrays[values],
            run=Run(**{**run, "work": Work(**run["work"])}),
            prices=header["prices"],
            status=Status[header["status"]],
            **header["numbers"],
        )


def _solution_words(problem: Problem) -> dict[str, Any]:
    """What in a solution's file tells a problem from others on the same model."""
    semantics, measure = problem.semantics, problem.semantics.measure
    return {
        "criterion": type(problem).__name__,
        "failure_budget": None if problem.failure_budget is None else float(problem.failure_budget),
        "discount": None if problem.discount is None else float(problem.discount),
        "penalty": float(semantics.penalty),
        "give_up": str(semantics.give_up),
        "measure": None if measure is None else measure.words,
        "limits": {
            condition.name: [float(row.bound) for row in condition.rows]
            for condition in conditions_of(problem)
        },
    }


def _check_problem(problem: Problem, kept: Mapping[str, Any], start: np.ndarray[Any, Any]) -> None:
    """Raise :class:`ModelError` unless the file's solution belongs to the problem."""
    for name, stated in _solution_words(problem).items():
        saved = kept[name]
        same = saved == stated
        if isinstance(saved, float) and isinstance(stated, float):
            same = isclose(saved, stated, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
        if not same:
            raise ModelError(
                f"the file answers a problem with {name} = {saved!r}, this one has {stated!r}"
            )
    if not np.array_equal(start_distribution(problem.model, problem.start), start):
        raise ModelError("the file answers a problem with another start")
