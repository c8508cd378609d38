"""Policy improvement along the structure of a process, from a policy that leaves it.

A process of small components is solved in one pass, ends first. On others Howard's rounds
alternate with sweeps of Bellman backups in the order of the values, since rounds alone are as many
as a run is long. The last policy is evaluated with a verified bound of its error; where the process
is left so seldom that double precision cannot tell which pair is better, improvement goes on in
twice that precision.
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import (
    IMPROVEMENT,
    MACHINE_EPSILON,
    BoolArray,
    FloatArray,
    IntArray,
    weighted,
)
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import STOPS, Stop, check_time, heed, pieces
from ssp_lp.dynamic_programming.bellman import Backup, best_pairs, unsigned_parts
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.linear_systems.system import DIRECT_STATES, EXACT, System
from ssp_lp.dynamic_programming.linear_systems.totals import evaluate_chain
from ssp_lp.dynamic_programming.policy_iteration.backward import (
    evaluate_policy,
    is_solved_backwards,
    least_backwards,
)
from ssp_lp.dynamic_programming.policy_iteration.block_sweeps import improve_along_chain
from ssp_lp.dynamic_programming.policy_iteration.leaving import leaving_chain
from ssp_lp.dynamic_programming.policy_iteration.precise_improvement import improve_precisely
from ssp_lp.dynamic_programming.policy_iteration.settled import MOST_ROUNDS, Settled
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import SolverError

_ROUGH, _FINE = 0.1, EXACT  # relative residuals of evaluations: the first one, the last one
_LAST_GAINS = 1e-4  # gains, relative to the values, after which evaluations are exact
_FORCING = 0.1  # share of the last gain, relative to the values, that an evaluation may miss by
_NOISE = 0.01  # of a rough residual: changes for less may go back and forth

_STEADY = 0.3
"""Share of the last round's changes from which the next round would hardly be shorter."""

_SWEEPS = 20  # of Bellman backups between two evaluations
_LEAST_SWEEPS = 6
_DIRECT = 2  # passes over a chain that an evaluation takes which does not iterate
_SETTLED = 0.1  # share of the first sweep's changes below which sweeping stops

_WORSE = 1e-9
"""Relative rise of a value that is no rounding: improvement never raises one."""

_UNCERTAIN = 1e-11
"""Relative loss that rounding may hide over a run, from which on precision is doubled."""

_OPEN = 1e-13  # the same of gains that were seen and declined, in small processes


def improve(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    guess: FloatArray | None = None,
    *,
    precise: bool = False,
) -> Settled:
    """Minimise the expected total of ``rewards @ weights`` from every state.

    A state changes its pair only for a gain above rounding. Started from a policy whose chain is
    transient, every later policy is transient too, provided that an end component either does not
    exist or costs something (mathematics, section 4): then the fixed point reached is the optimum.
    That rounding did not lead elsewhere is seen on each chain's graph before it is evaluated.

    Args:
        dynamics: the process.
        rewards: one or more rewards of each pair, [pairs, rewards].
        weights: [rewards].
        choice: pair of the first policy in each state, [states].
        guess: totals to start the first evaluation from, [states, rewards].
        precise: compare pairs in twice the working precision in any case.

    Raises:
        Stop: the time ended, with the policy so far.
        SolverError: a policy that never leaves the process, or totals that cannot be verified.
    """
    check_time()
    choice = np.array(choice, dtype=np.int32)
    pair_cost = weighted(rewards, weights)
    work, left = Work(1, 0), 0.0
    try:
        if is_solved_backwards(dynamics):
            choice, values = least_backwards(dynamics, pair_cost, choice)
            if dynamics.is_reused and not precise:  # what is made of all layers is checked
                nothing = np.zeros_like(values)
                return Settled(choice, values[:, None], values, nothing, nothing, work)
            left = _declined(dynamics, pair_cost, values, choice)
            totals = evaluate_policy(dynamics, choice, rewards)
        else:
            found = _settle(dynamics, rewards, weights, choice, guess)
            choice, system, solved, left, work = found
            totals = evaluate_chain(system, rewards[choice], solved)
            work = work + Work(0, system.products)
    except SolverError:
        return improve_precisely(dynamics, rewards, weights, choice, work)
    values = weighted(totals.values, weights)
    if precise or _may_hide_more(values, totals.runs, left):
        return improve_precisely(dynamics, rewards, weights, choice, work)
    return Settled(choice, totals.values, values, np.zeros_like(values), totals.runs, work)


def _may_hide_more(values: FloatArray, runs: FloatArray, left: float) -> bool:
    """Whether gains that were left to be rounding, gathered along a run, may be worth something.

    Args:
        values: [states].
        runs: about the expected steps, [states].
        left: the greatest gain that was seen and declined.
    """
    scale, longest = float(np.abs(values).max(initial=0.0)), float(runs.max(initial=0.0))
    hidden = (left + 4.0 * MACHINE_EPSILON * scale) * longest
    open_ties = len(values) <= DIRECT_STATES and left * longest > _OPEN * scale
    return open_ties or hidden > _UNCERTAIN * scale


def _declined(
    dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray, choice: IntArray
) -> float:
    """The greatest gain that was left to be rounding."""
    return _greatest_gain(
        best_pairs(dynamics.pair_offsets, dynamics.transitions, pair_cost, values, choice)
    )


def _greatest_gain(backup: Backup) -> float:
    return float((backup.here - backup.minima).max(initial=0.0))


_Found = tuple[IntArray, System, FloatArray, float, Work]


def _settle(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    totals: FloatArray | None,
) -> _Found:
    """The same as ``_rounds``; a stop carries the policy that the rounds had come to."""
    latest = [choice]
    try:
        return _rounds(dynamics, rewards, weights, latest, totals)
    except STOPS as stop:
        heed(stop)
        raise Stop(latest[0]) from stop


def _rounds(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    latest: list[IntArray],
    totals: FloatArray | None,
) -> _Found:
    """Policy iteration whose evaluations become exact as the gains shrink.

    Args:
        dynamics: the process.
        rewards: [pairs, rewards].
        weights: [rewards].
        latest: the policy to begin with; the last one that was evaluated takes its place.
        totals: about those of the first policy, [states, rewards].

    Returns:
        The policy, its equations and totals, the greatest gain that was left to be rounding, and
        the work.
    """
    transitions, pair_cost = dynamics.transitions, weighted(rewards, weights)
    accuracy = _ROUGH if dynamics.n_states > DIRECT_STATES else _FINE
    choice, work, rounds, changed_before = latest[0], Work(), 0, np.inf
    before: IntArray | None = None
    above: FloatArray | None = None  # values of the last policy, where they were exact
    while True:
        check_time()
        system, choice = _chain_of(dynamics, choice, before)
        latest[0] = choice
        totals = system.solve(rewards[choice], totals, accuracy)
        spent, system.products = system.products, 0
        work, rounds = work + Work(1, spent), rounds + 1
        values = weighted(totals, weights)
        if accuracy <= _FINE and above is not None and _rises(values, above):
            raise SolverError("a policy that was to improve the last one is worse")
        backup = best_pairs(dynamics.pair_offsets, transitions, pair_cost, values, choice)
        better, gain, scale = _gains(backup, values, accuracy)
        if not better.any() and accuracy > _FINE:
            accuracy = _FINE
            if not system.is_solved_exactly:
                continue
            better, gain, scale = _gains(backup, values, accuracy)  # only noise was thought greater
        above = values if accuracy <= _FINE else None
        if not better.any():
            return choice, system, totals, gain, work
        if rounds > MOST_ROUNDS:
            raise SolverError("policy iteration goes round in circles")
        before, changed = choice, int(np.count_nonzero(better))
        choice = np.where(better, backup.choice, choice).astype(np.int32, copy=False)
        if changed > _STEADY * changed_before and accelerated(transitions.nnz):
            work = work + _swept(dynamics, pair_cost, choice, values, system, spent)
        changed_before, wanted = changed, _FORCING * gain / scale
        accuracy = min(wanted if gain > _LAST_GAINS * scale else _FINE, accuracy)


def _chain_of(
    dynamics: Dynamics, choice: IntArray, before: IntArray | None
) -> tuple[System, IntArray]:
    """The equations of a policy that leaves, which may differ from what was chosen."""
    if dynamics.n_states <= DIRECT_STATES:  # what is wrong with small ones shows in the totals
        return dynamics.chain(choice), choice
    return leaving_chain(dynamics, choice, before)


def _swept(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    choice: IntArray,
    values: FloatArray,
    system: System,
    spent: int,
) -> Work:
    """Improve in place by passes along the chain or, where components are large, by sweeps.

    Args:
        system: the equations of the last policy that was evaluated.
        spent: products that its evaluation took.
    """
    swept = None
    if system.is_solved_exactly:  # where components were large they hardly become small
        swept = improve_along_chain(dynamics, pair_cost, choice, values)
    if swept is None:
        most = _most_sweeps(dynamics, system, spent)
        swept = _sweep(dynamics, pair_cost, choice, values, most)
    return Work(swept, 0)


def _gains(backup: Backup, values: FloatArray, accuracy: float) -> tuple[BoolArray, float, float]:
    """Which states gain more than noise, the greatest gain, and the size of the values."""
    scale = max(float(np.abs(values).max(initial=0.0)), 1e-300)
    noise = IMPROVEMENT * np.abs(backup.here)
    if accuracy > _FINE:
        noise = noise + _NOISE * accuracy * scale
    better = np.asarray(backup.minima < backup.here - noise)
    return better, _greatest_gain(backup), scale


def _rises(values: FloatArray, above: FloatArray) -> bool:
    """Whether values lie above those of the policy that they were to improve, beyond rounding."""
    scale = float(np.abs(above).max(initial=0.0))
    return not bool((values <= above + _WORSE * scale).all())


def _sweep(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    choice: IntArray,
    values: FloatArray,
    most_sweeps: int,
) -> int:
    """Improve by sweeps, in place, while many states change; return how many there were.

    States of small value come first, then last: so news travels both ways, from the ends on and
    towards them.
    """
    from ssp_lp.compiled.linear_systems.sweeps import improve as run

    parts = unsigned_parts(dynamics.pair_offsets, dynamics.transitions)
    order = np.argsort(values, kind="stable").astype(np.uint32)
    backward, most = np.ascontiguousarray(order[::-1]), 0
    for sweep in range(1, most_sweeps + 1):
        direction, changed = order if sweep % 2 else backward, 0
        for some in pieces(order.size, dynamics.transitions.nnz):
            changed += run(
                *parts, direction[some], pair_cost, IMPROVEMENT, choice.view(np.uint32), values
            )[0]
        most = max(most, changed)
        if changed <= _SETTLED * most and sweep > 1:  # where one way changed nothing, the other may
            return sweep
    return most_sweeps


def _most_sweeps(dynamics: Dynamics, system: System, products: int) -> int:
    """Sweeps that cost about as much as the last evaluation did, or many where that was direct."""
    if products <= _DIRECT:
        return _SWEEPS
    share = system.matrix.nnz / max(dynamics.transitions.nnz, 1)
    return min(max(int(products * share), _LEAST_SWEEPS), _SWEEPS)
