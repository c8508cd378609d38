"""Expected totals of a policy's chain with a bound of their error that was verified.

Let t be a super-solution of the run length: t - chain @ t >= 1/2, checked with its rounding. If
computed totals x miss their equations by at most r in every state, then they are wrong by at most
2 r t: (I - chain)^-1 is non-negative. Where r, bounded in working precision, is too large, what x
misses is worked out in twice that precision (``precise``), and x is corrected, as a sum of two
numbers, until the bound is small.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.linear_systems.advantages import (
    advantage_bounds,
    exact_sum,
    precise_advantages,
    safe_advantages,
)
from ssp_lp.dynamic_programming.linear_systems.system import DIRECT_STATES, EXACT, System
from ssp_lp.errors import SolverError

EVALUATED = 1e-12
"""Largest error of totals, relative to the greatest of them, that is let pass uncorrected."""

ROUNDED = 4e-16  # of small chains, where a correction costs next to nothing
_RUN_ACCURACIES = (1e-3, 1e-8)  # of run lengths, which are checked and used times two
CORRECTIONS = 6

_Solve = Callable[[FloatArray, FloatArray | None, float], FloatArray]


@dataclass(frozen=True, eq=False)
class Totals:
    """Expected totals, as sums of two numbers, and how wrong they may be."""

    values: FloatArray  # [states, rewards]
    low: FloatArray  # [states, rewards] what the rounding of the values lost
    runs: FloatArray  # [states] checked: twice this is at least the expected number of steps
    missed: FloatArray  # [rewards] the most by which the equations are missed

    @property
    def error(self) -> FloatArray:
        """Bound of the error of each total, [states, rewards]."""
        return 2.0 * np.outer(self.runs, self.missed)

    def are_within(self, accuracy: float) -> bool:
        """Whether no total is wrong by more, relative to the greatest of its reward."""
        longest = float(self.runs.max(initial=0.0))
        scale = _sizes_of_totals(self.values)
        return bool((2.0 * longest * self.missed <= accuracy * scale).all())


def evaluate_chain(
    system: System,
    rewards: FloatArray,
    solved: FloatArray | None = None,
    *,
    accuracy: float | None = None,
) -> Totals:
    """Expected totals of several rewards, corrected until their error is small.

    Args:
        system: the chain's equations.
        rewards: [states, rewards].
        solved: totals that were worked out before, like ``rewards``.
        accuracy: error, relative to each reward's greatest total, down to which to correct; None:
            rounding for small chains, ``EVALUATED`` for large ones.

    Raises:
        SolverError: the chain holds mass for ever, or its totals cannot be had to
            ``EVALUATED``.
    """
    if accuracy is None:
        accuracy = ROUNDED if system.size <= DIRECT_STATES else EVALUATED
    for solve in (system.solve, lambda right, *_: system.solve_by_reduction(right)):
        try:
            first = solve(rewards, None, EXACT) if solved is None else solved
            totals = _verified_totals(system, rewards, first, solve, accuracy)
        except SolverError:
            if system.closed.size:
                raise
            continue
        finally:
            solved = None
        if totals is not None:
            return totals
    return _reduced_totals(system, rewards)


def _reduced_totals(system: System, rewards: FloatArray) -> Totals:
    """Totals of a chain left so seldom that no residual verifies them, by state reduction alone.

    It subtracts nothing, so that every total of rewards of one sign is accurate whatever the
    condition (Alfa, Xue and Ye 2002); gains and losses are totalled apart.

    Raises:
        SolverError: a component is too large for state reduction.
    """
    k, gains, losses = rewards.shape[1], np.maximum(rewards, 0.0), np.maximum(-rewards, 0.0)
    found = system.solve_by_reduction(np.column_stack([gains, losses, np.ones(system.size)]))
    gained, lost = found[:, :k], found[:, k:-1]
    rounding = 4.0 * MACHINE_EPSILON * (gained + lost).max(axis=0, initial=0.0)
    return Totals(gained - lost, np.zeros_like(gained), found[:, -1], rounding)


def _verified_totals(
    system: System, rewards: FloatArray, x: FloatArray, solve: _Solve, accuracy: float
) -> Totals | None:
    """Totals corrected and verified; None where that fails."""
    runs = system.kept_runs
    if runs is None:
        runs = system.kept_runs = _run_lengths(system, solve)
    if runs is None:
        return None
    longest, low = float(runs.max(initial=0.0)), np.zeros_like(x)
    if accuracy >= EVALUATED:
        plain = Totals(x, low, runs, _missed_by_totals_at_most(system, rewards, x))
        if plain.are_within(accuracy):
            return plain
    before = np.full(rewards.shape[1], np.inf)
    for _ in range(CORRECTIONS):
        # by what totals miss their equations, [states, rewards], and the most of it
        off, missed = np.empty_like(x), np.zeros(rewards.shape[1])
        for j in range(rewards.shape[1]):
            check_time()
            columns = (np.ascontiguousarray(part[:, j]) for part in (rewards, x, low))
            off[:, j], rounding = precise_advantages(
                system.home, system.matrix, system.exits, *columns
            )
            missed[j] = (np.abs(off[:, j]) + rounding).max(initial=0.0)
        scale = _sizes_of_totals(x)
        wrong = 2.0 * longest * missed
        if (wrong <= accuracy * scale).all() or not (missed < 0.5 * before).any():
            break
        before = missed
        x, low = exact_sum(x, low + solve(off, None, EXACT))
    totals = Totals(x, low, runs, missed)
    return totals if totals.are_within(max(accuracy, EVALUATED)) else None


def _missed_by_totals_at_most(system: System, rewards: FloatArray, x: FloatArray) -> FloatArray:
    """The most by which totals miss their equations, bounded in working precision, [rewards]."""
    most = np.empty(rewards.shape[1])
    for j in range(most.size):
        check_time()
        columns = np.ascontiguousarray(rewards[:, j]), np.ascontiguousarray(x[:, j])
        bounds = advantage_bounds(system.home, system.matrix, system.exits, *columns)
        most[j] = max(float(np.abs(bound).max(initial=0.0)) for bound in bounds)
    return most


def _run_lengths(system: System, solve: _Solve) -> FloatArray | None:
    """Total expected steps, checked: at least one half more than what follows them, [states]."""
    ones, half = np.ones((system.size, 1)), np.full(system.size, -0.5)
    for accuracy in _RUN_ACCURACIES:
        runs = solve(ones, None, accuracy)[:, 0]
        if not (np.isfinite(runs).all() and runs.min(initial=0.0) >= 0.0):
            return None
        if (safe_advantages(system.home, system.matrix, system.exits, half, -runs) >= 0.0).all():
            return runs
    return None


def _sizes_of_totals(x: FloatArray) -> FloatArray:
    """The greatest total of each reward, [rewards]; numpy is slow along rows of two numbers."""
    return np.asarray(np.abs(x.T, order="C").max(axis=1, initial=0.0))
