"""Policy improvement along the structure of a process, from a policy that leaves it.

A process without cycles is solved in one pass, ends first. On others Howard's rounds alternate with
sweeps of Bellman backups in the order of the policy's own chain, since rounds alone are as many as
a run is long. The last policy is evaluated with a verified bound of its error; where the process is
left so seldom that double precision cannot tell which pair is better, improvement goes on in twice
that precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.accelerator import accelerated
from ssp_lp.arrays import (
    IMPROVEMENT,
    MACHINE_EPSILON,
    BoolArray,
    FloatArray,
    IntArray,
    first_minimisers,
    segment_minima,
    weighted,
)
from ssp_lp.bellman import Backup, best_pairs, unsigned_parts
from ssp_lp.dynamic_programming.chain_evaluation import evaluate_chain
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.linear_system import DIRECT_STATES, EXACT, HOLDS_MASS, System
from ssp_lp.dynamic_programming.precise import precise_advantages
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import SolverError

_ROUGH, _FINE = 0.1, EXACT  # relative residuals of evaluations: the first one, the last one
_LAST_GAINS = 1e-4  # gains, relative to the values, after which evaluations are exact
_FORCING = 0.1  # share of the last gain, relative to the values, that an evaluation may miss by
_NOISE = 0.01  # of a rough residual: changes for less may go back and forth

_STEADY = 0.3
"""Share of the last round's changes from which the next round would hardly be shorter."""

_SWEEPS = 20  # of Bellman backups between two evaluations
_SETTLED = 0.1  # share of the first sweep's changes below which sweeping stops

_MOST_ROUNDS = 10_000
"""Rounds that only a defect could need: every round improves what the last one left."""

_WORSE = 1e-9
"""Relative rise of a value that is no rounding: improvement never raises one."""

_UNCERTAIN = 1e-11
"""Relative loss that rounding may hide over a run, from which on precision is doubled."""

_PRECISE = 1e-24  # accuracy of evaluations in twice the working precision, relative


@dataclass(frozen=True, eq=False)
class Settled:
    """A policy that no single change of a pair improves, with its expected totals."""

    choice: IntArray  # [states]
    totals: FloatArray  # [states, rewards]
    values: FloatArray  # [states] the totals, weighted
    low: FloatArray  # [states] what the rounding of the values lost, where that was worked out
    runs: FloatArray  # [states] checked: twice this is at least the expected number of steps
    work: Work


def improve(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    guess: FloatArray | None = None,
) -> Settled:
    """Minimise the expected total of ``rewards @ weights`` from every state.

    A state changes its pair only for a gain above rounding. Started from a policy whose chain is
    transient, every later policy is transient too, provided that an end component either does not
    exist or costs something (DESIGN, section 4): then the fixed point reached is the optimum.
    That rounding did not lead elsewhere is seen on each chain's graph before it is evaluated.

    Args:
        dynamics: the process.
        rewards: one or more rewards of each pair, [pairs, rewards].
        weights: [rewards].
        choice: pair of the first policy in each state, [states].
        guess: totals to start the first evaluation from, [states, rewards].

    Raises:
        SolverError: a policy that never leaves the process, or totals that cannot be verified.
    """
    choice = np.array(choice, dtype=np.int32)
    pair_cost = weighted(rewards, weights)
    if dynamics.n_states > DIRECT_STATES and dynamics.is_acyclic:
        choice, work = _backward(dynamics, pair_cost), Work(1, 0)
        system, solved, left = dynamics.chain(choice), None, 0.0
    else:
        try:
            found = _settle(dynamics, rewards, weights, choice, guess)
        except SolverError:
            return _precisely(dynamics, rewards, weights, choice, Work())
        choice, system, solved, left, work = found
    taken = rewards[choice]
    try:
        totals = evaluate_chain(system, taken, solved)
    except SolverError:
        return _precisely(dynamics, rewards, weights, choice, work)
    values = weighted(totals.values, weights)
    scale = float(np.abs(values).max(initial=0.0))
    hidden = (left + 4.0 * MACHINE_EPSILON * scale) * float(totals.runs.max(initial=0.0))
    work = work + Work(0, system.products)
    if hidden > _UNCERTAIN * scale:
        return _precisely(dynamics, rewards, weights, choice, work)
    return Settled(choice, totals.values, values, np.zeros_like(values), totals.runs, work)


def _backward(dynamics: Dynamics, pair_cost: FloatArray) -> IntArray:
    """The best pairs of a process without cycles, in one pass."""
    values, choice = np.empty(dynamics.n_states), np.empty(dynamics.n_states, dtype=np.int32)
    if accelerated(dynamics.transitions.nnz):
        from ssp_lp.compiled.sweeps import backward

        parts = unsigned_parts(dynamics.pair_offsets, dynamics.transitions)
        order = dynamics.components.order.view(np.uint32)
        backward(*parts, dynamics.exits, order, pair_cost, choice.view(np.uint32), values)
        return choice
    for level in dynamics.levels:
        ahead = (pair_cost[level.pairs] + level.rows @ values) / level.departs
        values[level.states] = segment_minima(ahead, level.offsets)
        first = first_minimisers(ahead, values[level.states], level.offsets)
        choice[level.states] = level.pairs[first]
    return choice


_Found = tuple[IntArray, System, FloatArray, float, Work]


def _settle(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    totals: FloatArray | None,
) -> _Found:
    """Policy iteration whose evaluations become exact as the gains shrink.

    Returns:
        The policy, its equations and totals, the greatest gain that was left to be rounding, and
        the work.
    """
    offsets, transitions, pair_cost = (
        dynamics.pair_offsets,
        dynamics.transitions,
        weighted(rewards, weights),
    )
    accuracy = _ROUGH if dynamics.n_states > DIRECT_STATES else _FINE
    work, rounds = Work(), 0
    changed_before = np.inf
    before: IntArray | None = None
    above: FloatArray | None = None  # values of the last policy, where they were exact
    while True:
        system, choice = _leaving_chain(dynamics, choice, before)
        totals = system.solve(rewards[choice], totals, accuracy)
        work, rounds = work + Work(1, system.products), rounds + 1
        system.products = 0
        values = weighted(totals, weights)
        if accuracy <= _FINE and above is not None and _rises(values, above):
            raise SolverError("a policy that was to improve the last one is worse")
        backup = best_pairs(offsets, transitions, pair_cost, values, choice)
        better, gain, scale = _gains(backup, values, accuracy)
        above = values if accuracy <= _FINE else None
        if not better.any():
            if accuracy <= _FINE:
                left = float((backup.here - backup.minima).max(initial=0.0))
                return choice, system, totals, left, work
            accuracy = _FINE
            continue
        if rounds > _MOST_ROUNDS:
            raise SolverError("policy iteration goes round in circles")
        before, changed = choice, int(np.count_nonzero(better))
        choice = np.where(better, backup.choice, choice).astype(np.int32, copy=False)
        if changed > _STEADY * changed_before and accelerated(transitions.nnz):
            swept = _sweep(dynamics, pair_cost, system, choice, values)
            work = work + Work(swept, 0)
        changed_before = changed
        accuracy = min(_FORCING * gain / scale if gain > _LAST_GAINS * scale else _FINE, accuracy)


def _gains(backup: Backup, values: FloatArray, accuracy: float) -> tuple[BoolArray, float, float]:
    """Which states gain more than noise, the greatest gain, and the size of the values."""
    scale = max(float(np.abs(values).max(initial=0.0)), 1e-300)
    noise = IMPROVEMENT * np.abs(backup.here)
    if accuracy > _FINE:
        noise = noise + _NOISE * accuracy * scale
    better = np.asarray(backup.minima < backup.here - noise)
    return better, float((backup.here - backup.minima).max(initial=0.0)), scale


def _rises(values: FloatArray, above: FloatArray) -> bool:
    """Whether values lie above those of the policy that they were to improve, beyond rounding."""
    scale = float(np.abs(above).max(initial=0.0))
    return not bool((values <= above + _WORSE * scale).all())


def _sweep(
    dynamics: Dynamics, pair_cost: FloatArray, system: System, choice: IntArray, values: FloatArray
) -> int:
    """Improve by sweeps in the order of the chain, in place, while many states change."""
    from ssp_lp.compiled.sweeps import improve as run

    parts = unsigned_parts(dynamics.pair_offsets, dynamics.transitions)
    order = np.argsort(values, kind="stable").astype(np.uint32)
    backward, most = np.ascontiguousarray(order[::-1]), 0
    for sweep in range(1, _SWEEPS + 1):
        direction = order if sweep % 2 else backward
        changed, _ = run(*parts, direction, pair_cost, IMPROVEMENT, choice.view(np.uint32), values)
        most = max(most, changed)
        if changed <= _SETTLED * most:
            return sweep
    return _SWEEPS


def _leaving_chain(
    dynamics: Dynamics, choice: IntArray, before: IntArray | None
) -> tuple[System, IntArray]:
    """The chain of a policy that leaves: states that no longer do keep the pair they had.

    Raises:
        SolverError: they did not leave before either.
    """
    system = dynamics.chain(choice)
    if dynamics.n_states <= DIRECT_STATES:
        return system, choice
    while (closed := system.closed).size:
        if before is None or np.array_equal(choice[closed], before[closed]):
            raise SolverError(HOLDS_MASS)
        choice = choice.copy()
        choice[closed] = before[closed]
        system = dynamics.chain(choice)
    return system, choice


def _precisely(
    dynamics: Dynamics, rewards: FloatArray, weights: FloatArray, choice: IntArray, work: Work
) -> Settled:
    """Policy iteration in twice the working precision.

    Raises:
        SolverError: a policy that never leaves, or totals that cannot be verified.
    """
    pair_cost, before = weighted(rewards, weights), None
    offsets = dynamics.pair_offsets
    for _ in range(_MOST_ROUNDS):
        system = dynamics.chain(choice)
        while (closed := system.closed).size:
            if before is None or np.array_equal(choice[closed], before[closed]):
                raise SolverError(HOLDS_MASS)
            choice[closed] = before[closed]
            system = dynamics.chain(choice)
        priced = evaluate_chain(system, pair_cost[choice][:, None], accuracy=_PRECISE)
        values, low = priced.values[:, 0], priced.low[:, 0]
        ahead, rounding = precise_advantages(
            dynamics.pair_state, dynamics.transitions, dynamics.exits, pair_cost, values, low
        )
        gain = -segment_minima(ahead + rounding, offsets) - 2.0 * float(priced.missed[0])
        better = np.flatnonzero(gain > 0.0)
        work = work + Work(1, system.products)
        if not better.size:
            totals = evaluate_chain(system, rewards[choice])
            return Settled(choice, totals.values, values, low, totals.runs, work)
        before = choice.copy()
        least = segment_minima(ahead, offsets)
        picks = np.array(offsets[:-1], dtype=np.int32)
        picks[np.diff(offsets) > 0] = first_minimisers(ahead, least, offsets)
        choice[better] = picks[better]
    raise SolverError("policy iteration goes round in circles")
