"""Evaluation of a policy: expected totals with a verified bound of their error.

Let t be a super-solution of the run length: t - chain @ t >= 1/2, checked with its rounding. If
computed totals x have residuals of at most r in every state, then their error is at most 2 r t,
since (I - chain)^-1 is non-negative. If r, bounded in working precision, is too large, the residual
is computed in twice that precision (``precise_advantages``), and x is corrected, as a sum of two
numbers, until the bound is small.

The advantage of pair u in state s at values v is ``c_u + P_u v - v_s``, written as ``c_u + sum_j
p_uj (v_j - v_s) - exit_u v_s``: if a process is hardly left, all v_j are near v_s, and their
differences matter. Values of twice the working precision are sums ``high + low``; sums and
products are then exact to twice the precision (Dekker 1971; Ogita, Rump and Oishi 2005).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, exact_sum, unsigned, weighted
from ssp_lp.compiled.accelerator import with_twin
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.chain_solvers import HOLDS_MASS
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.equations import DIRECT_STATES, EXACT, System
from ssp_lp.errors import SolverError

EVALUATED = 1e-12
"""Largest error of totals, relative to the greatest of them, that is not corrected."""

_ROUNDED = 4e-16  # accuracy for small chains, where a correction costs little
PRECISE = 1e-24  # accuracy of evaluations in twice the working precision
PROVED = 1e-11
"""Relative gap that rounding may leave between a policy's totals and the bound of all policies."""

PROVED_OF_MANY = 5e-10
"""This gap for many states, where an evaluation in twice the precision takes long."""

NEARLY = 1e-9
"""Relative distance up to which two values may differ by rounding alone."""

RUN_ACCURACY = 1e-3  # accuracy of run lengths, which are checked and multiplied by 1.5 or 2
_FINE_RUN_ACCURACY = 1e-8  # accuracy of run lengths if their check fails
_CORRECTIONS = 6


_Solve = Callable[[FloatArray, FloatArray | None, float], FloatArray]


@dataclass(frozen=True, eq=False)
class Totals:
    """Expected totals, each the sum of two floats, ``values + low``, with a bound of the error."""

    values: FloatArray  # [states, rewards]
    low: FloatArray  # [states, rewards] rounding errors of the values
    runs: FloatArray  # [states] checked: twice this is at least the expected number of steps
    residuals: FloatArray  # [rewards] greatest residual of the equations

    @property
    def error(self) -> FloatArray:
        """Bound of the error of each evaluated total, [states, rewards]."""
        return 2.0 * np.outer(self.runs, self.residuals)

    def are_within(self, accuracy: float) -> bool:
        """Return whether all errors are small relative to the greatest total of their reward."""
        longest = float(self.runs.max(initial=0.0))
        scale = _sizes_of_totals(self.values)
        return bool((2.0 * longest * self.residuals <= accuracy * scale).all())


@with_twin
def evaluate_policy(
    dynamics: Dynamics, choice: IntArray, rewards: FloatArray, accuracy: float | None = None
) -> Totals:
    """Evaluate a policy: expected totals with a verified error.

    A process of small components is evaluated in one compiled pass, ends first.

    Args:
        dynamics: the process.
        choice: a pair of each state, [states].
        rewards: [pairs, rewards].
        accuracy: see ``evaluate_chain``.

    Raises:
        SolverError: see ``evaluate_chain``.
    """
    if accuracy is None and (one_pass := acyclic_totals(dynamics, choice, rewards)) is not None:
        return one_pass[1]
    if dynamics.is_solved_backwards and dynamics.is_compiled_backwards:
        totals = _evaluated_policy(dynamics, choice, rewards, accuracy)
        if totals is not None:
            return totals
    return evaluate_chain(dynamics.chain(choice), rewards[choice], accuracy=accuracy)


def _evaluated_policy(
    dynamics: Dynamics, choice: IntArray, rewards: FloatArray, accuracy: float | None
) -> Totals | None:
    """Evaluate a policy by compiled loops; None if the totals cannot be verified."""
    from ssp_lp.compiled.equations import evaluate_precisely

    strong, rows, shape = dynamics.components, dynamics.transitions, (len(choice), rewards.shape[1])
    if accuracy is None:
        accuracy = _ROUNDED if len(choice) <= DIRECT_STATES else EVALUATED
    x, low, runs, missed = np.empty(shape), np.empty(shape), np.empty(shape[0]), np.empty(shape[1])
    verified = evaluate_precisely(
        unsigned(rows.indptr), unsigned(rows.indices), rows.data, dynamics.exits, unsigned(choice),
        unsigned(strong.order), strong.offsets, max(strong.largest, 1),
        rewards, accuracy, max(accuracy, EVALUATED), _CORRECTIONS, MACHINE_EPSILON,
        x, low, runs, missed,
    )  # fmt: skip
    return Totals(x, low, runs, missed) if verified else None


@with_twin
def acyclic_totals(
    dynamics: Dynamics, choice: IntArray, rewards: FloatArray, weights: FloatArray | None = None
) -> tuple[IntArray, Totals] | None:
    """Compute best pairs and verified totals of a large process without cycles, in one pass.

    Args:
        dynamics: the process.
        choice: a pair of each state, kept if no other pair is better, [states].
        rewards: [pairs, rewards].
        weights: weights of the rewards in the total to minimise, [rewards]; None: evaluate
            ``choice``.

    Returns:
        Pairs and totals; None if the process is small or has cycles, or if rounding may exceed
        ``EVALUATED``.

    Raises:
        SolverError: some state is never left.
    """
    shape = dynamics.n_states, rewards.shape[1]
    if shape[0] <= DIRECT_STATES or not dynamics.is_compiled_backwards:
        return None
    if dynamics.components.largest > 1:
        return None
    from ssp_lp.compiled.policy_improvement import improve_acyclic

    choice, runs, missed, x = choice.copy(), np.empty(shape[0]), np.empty(shape[1]), np.empty(shape)
    cost = weighted(rewards, np.zeros(shape[1]) if weights is None else weights)
    if not improve_acyclic(
        dynamics.rows, unsigned(dynamics.components.order),
        rewards, cost, weights is None, MACHINE_EPSILON, choice.view(np.uint32), x, runs, missed,
    ):  # fmt: skip
        raise SolverError(HOLDS_MASS)
    totals = Totals(x, np.zeros_like(x), runs, missed)
    return (choice, totals) if totals.are_within(EVALUATED) else None


def evaluate_chain(
    system: System,
    rewards: FloatArray,
    solved: FloatArray | None = None,
    *,
    accuracy: float | None = None,
) -> Totals:
    """Evaluate a policy's chain: expected totals of several rewards, with a verified error.

    Args:
        system: the chain's equations.
        rewards: [states, rewards].
        solved: totals that were computed before, [states, rewards].
        accuracy: error to reach by corrections, relative to each reward's greatest total; None:
            rounding for small chains, ``EVALUATED`` for large ones.

    Raises:
        SolverError: the chain never leaves some states, or the error stays above ``EVALUATED``.
    """
    if accuracy is None:
        accuracy = _ROUNDED if system.size <= DIRECT_STATES else EVALUATED
    for solve in (system.solve, lambda right, *_: system.solve_by_reduction(right)):
        try:
            solution = solve(rewards, None, EXACT) if solved is None else solved
            totals = _verified_totals(system, rewards, solution, solve, accuracy)
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
    """Evaluate a chain that is left too rarely to verify residuals, by state reduction alone.

    State reduction subtracts nothing, so that every total of rewards of one sign is accurate,
    whatever the condition number (Alfa, Xue and Ye 2002). Gains and losses are summed separately.

    Raises:
        SolverError: a component is too large for state reduction.
    """
    k, gains, losses = rewards.shape[1], np.maximum(rewards, 0.0), np.maximum(-rewards, 0.0)
    totals = system.solve_by_reduction(np.column_stack([gains, losses, np.ones(system.size)]))
    gained, lost = totals[:, :k], totals[:, k:-1]
    rounding = 4.0 * MACHINE_EPSILON * (gained + lost).max(axis=0, initial=0.0)
    return Totals(gained - lost, np.zeros_like(gained), totals[:, -1], rounding)


def _verified_totals(
    system: System, rewards: FloatArray, x: FloatArray, solve: _Solve, accuracy: float
) -> Totals | None:
    """Correct and verify a policy's totals; None if that fails."""
    runs = system.kept_runs
    if runs is None:
        runs = system.kept_runs = _run_lengths(system, solve)
    if runs is None:
        return None
    longest, low = float(runs.max(initial=0.0)), np.zeros_like(x)
    if accuracy >= EVALUATED:
        plain = Totals(x, low, runs, _greatest_residual(system, rewards, x))
        if plain.are_within(accuracy):
            return plain
    before = np.full(rewards.shape[1], np.inf)
    for _ in range(_CORRECTIONS):
        # residuals, [states, rewards], and their greatest bounds
        off, missed = np.empty_like(x), np.zeros(rewards.shape[1])
        for j in range(rewards.shape[1]):
            check_time()
            columns = [np.ascontiguousarray(part[:, j]) for part in (rewards, x, low)]
            off[:, j], rounding = system.moves.precise_advantages(*columns)
            missed[j] = (np.abs(off[:, j]) + rounding).max(initial=0.0)
        scale = _sizes_of_totals(x)
        wrong = 2.0 * longest * missed
        if (wrong <= accuracy * scale).all() or not (missed < 0.5 * before).any():
            break
        before = missed
        x, low = exact_sum(x, low + solve(off, None, EXACT))
    totals = Totals(x, low, runs, missed)
    return totals if totals.are_within(max(accuracy, EVALUATED)) else None


def _greatest_residual(system: System, rewards: FloatArray, x: FloatArray) -> FloatArray:
    """Return upper bounds of the residuals of a policy's totals, [rewards]."""
    most = np.empty(rewards.shape[1])
    for j in range(most.size):
        check_time()
        columns = np.ascontiguousarray(rewards[:, j]), np.ascontiguousarray(x[:, j])
        bounds = system.moves.advantage_bounds(*columns)
        most[j] = max(float(np.abs(bound).max(initial=0.0)) for bound in bounds)
    return most


def _run_lengths(system: System, solve: _Solve) -> FloatArray | None:
    """Compute run lengths t of a policy, checked to satisfy t - chain @ t >= 1/2, [states]."""
    ones, half = np.ones((system.size, 1)), np.full(system.size, -0.5)
    for accuracy in (RUN_ACCURACY, _FINE_RUN_ACCURACY):
        runs = solve(ones, None, accuracy)[:, 0]
        if not (np.isfinite(runs).all() and runs.min(initial=0.0) >= 0.0):
            return None
        if (system.moves.safe_advantages(half, -runs) >= 0.0).all():
            return runs
    return None


def _sizes_of_totals(x: FloatArray) -> FloatArray:
    """Return the greatest absolute total of each reward, [rewards], fast for few columns."""
    return np.asarray(np.abs(x.T, order="C").max(axis=1, initial=0.0))
