"""A model whose costs are split between multiples of a unit, which bounds case S from below.

A step of cost c that goes on becomes two, whose costs are the multiples of a unit next to c, with
probabilities that keep the mean. At a price of failure the value as a function of the cost already
paid is a minimum of affine functions, hence concave, so that no policy of the true model does
better than the best one of this (mathematics, section 8): its optimum is a lower bound, and its
totals are layers of a lattice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction

import numpy as np

from ssp_lp.arrays import SAME_TOTAL, offsets_of, read_only
from ssp_lp.column_generation.compiled_problems.compiled_accumulated_cost import (
    CompiledAccumulatedCost,
)
from ssp_lp.column_generation.initial_columns import DualGuess
from ssp_lp.compiled.deadline import is_late
from ssp_lp.errors import ModelError
from ssp_lp.methods.refinement import RefinedOutcome, refined_optimum
from ssp_lp.methods.rounding_units import rounding_units, short_decimal, span_of_totals
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.options import SolveOptions
from ssp_lp.problem import Problem, by_rows, by_sums, has_rows
from ssp_lp.processes.failure_semantics import start_distribution
from ssp_lp.processes.totals.lattice import totals_of
from ssp_lp.processes.totals.step_sums import MOST_SUMS, step_lattice, sums_in

_WIDEST = 1_000.0  # times as dear may one step be as another, or a unit rounds too much to nothing
_FEW_SUMS = 1_000  # that are told apart exactly rather than by a grid
_SECONDS = 1.5e-8  # that a search takes for each sum and outcome
_MARGIN = 1.25  # beyond a price from a coarser unit: what is paid there still counts for something
_TRIES = 6  # units, until levels are as few as is asked for


def span_to_split(problem: Problem, seconds: float = np.inf) -> float | None:
    """The totals that matter where the costs of a problem are to be split; None: they are not.

    They are in case S where the sums of costs are too many to be told apart, or, where these are
    known to be told apart, if that hardly ends in the time that is left.

    Args:
        problem: the problem.
        seconds: that are left.
    """
    if not _may_be_split(problem):
        return None
    on_grid = by_rows(problem)
    if not on_grid and not (np.isfinite(seconds) and by_sums(problem)):
        return None
    asked: int | None = getattr(problem, "cost_levels", None) if on_grid else MOST_SUMS
    span, most = span_of_steps(problem), _FEW_SUMS if asked is None else int(asked)
    sums = sums_in(problem.model, span, most)
    if on_grid:
        return span if sums is None else None
    many = most if sums is None else len(sums)
    return span if _SECONDS * many * problem.model.n_outcomes > seconds else None


def _may_be_split(problem: Problem) -> bool:
    """Whether costs may be split: case S, failure alone limited, no step far dearer than others."""
    if not problem.ratio or has_rows(problem) or problem.failure_budget is None:
        return False
    if problem.semantics.measure is not None or getattr(problem, "cost_cap", None) is not None:
        return False
    steps = step_lattice(problem.model)[1]
    return len(steps) > 1 and bool(steps[-1] <= _WIDEST * steps[1])


def with_split_costs(model: SSP, unit: Fraction) -> SSP:
    """The model with each step that goes on split between two multiples of a unit.

    The last step of an episode is left as it is: whatever it costs, nothing has to remember it.

    Args:
        model: the model.
        unit: of which costs become multiples.
    """
    ended = dead_ends(model) | model.goal_mask
    units = np.where(ended[model.successors], 0.0, model.costs / float(unit))
    whole = np.floor(units * (1.0 + SAME_TOTAL))
    share = np.clip(units - whole, 0.0, 1.0)  # of the multiple above
    share[share <= SAME_TOTAL * units] = 0.0
    copies = 1 + (share > 0.0)
    outcome = np.repeat(np.arange(model.n_outcomes), copies)
    is_above = np.append(False, outcome[1:] == outcome[:-1])
    part = np.where(is_above, share[outcome], 1.0 - share[outcome])
    cost = totals_of((whole[outcome] + is_above).astype(np.int64), unit)
    return replace(
        model,
        outcome_offsets=read_only(offsets_of(copies)[model.outcome_offsets]),
        successors=read_only(model.successors[outcome]),
        probabilities=read_only(model.probabilities[outcome] * part),
        costs=read_only(np.where(ended[model.successors[outcome]], model.costs[outcome], cost)),
        exact_costs={},
    )


def split_units(problem: Problem, span: float, *, finest: bool = False) -> Iterator[Fraction]:
    """Smaller and smaller units, none of which splits a step into nothing, if these are few.

    Args:
        problem: of case S.
        span: the totals that matter.
        finest: as far as there is room, whatever is asked for.
    """
    cheapest = float(step_lattice(problem.model)[1][1])
    return rounding_units(problem, span, cheapest=cheapest, finest=finest)


def span_of_steps(problem: Problem) -> float:
    """The totals that matter; what a step costs that only ends an episode is not remembered."""
    return span_of_totals(problem, float(step_lattice(problem.model)[1][-1]))


def split_optimum(
    problem: Problem,
    unit: Fraction,
    options: SolveOptions,
    guess: DualGuess | None,
    most: int | None = None,
    reach: float = np.inf,
) -> RefinedOutcome:
    """The optimum with split costs, of a larger unit where levels are more than asked for.

    Where no larger one makes them few enough, they are cut where as many are passed.

    Args:
        problem: of case S.
        unit: of which costs become multiples.
        options: tolerance and limits.
        guess: of the price of failure; None: nothing is known.
        most: levels; None: any number.
        reach: total up to which layers are told apart at first; infinite: a guess is made.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        ModelError: a table of so many layers is too large.
        Stop: the time ended before a policy that keeps to the budget was found.
    """
    budget = 1.0 if problem.failure_budget is None else problem.failure_budget
    for tried in range(_TRIES):
        model = with_split_costs(problem.model, unit)
        start, fixed = start_distribution(model, problem.start), None
        if most is not None and tried + 1 == _TRIES:
            fixed = (most - 0.5) * float(unit)
        cap = None if np.isinf(reach) or fixed else int(np.ceil(_MARGIN * reach / float(unit))) + 1
        compiled = CompiledAccumulatedCost(model, start, problem.discount, fixed, cap)
        outcome = refined_optimum(compiled, budget, options, guess)
        layers = layers_of_split(outcome).process.cap
        if most is None or layers <= most or is_late():
            break
        unit = short_decimal(1.02 * float(unit) * layers / most)
    return outcome


def layers_of_split(outcome: RefinedOutcome) -> CompiledAccumulatedCost:
    """The process that a search on split costs ended with."""
    if not isinstance(outcome.compiled, CompiledAccumulatedCost):
        raise ModelError("split costs need the accumulated-cost process")
    return outcome.compiled
