"""Howard's rounds, whose evaluations become exact as the gains shrink, with sweeps in between.

Rounds alone are as many as a run is long. Between two of them a policy is improved in place: where
the components of its chain are small, along them, ends first and back; else by Bellman backups in
the order of the values. What a state gains spreads in both directions: to the states that lead to
it, which come later when ends come first, and, once a better pair leads to a state that had none
before, the other way round.
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import IMPROVEMENT, BoolArray, FloatArray, IntArray, unsigned, weighted
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import STOPS, Stop, check_time, heed, pieces
from ssp_lp.dynamic_programming.bellman import Backup, Work, best_pairs, unsigned_parts
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.leaving import leaving_chain
from ssp_lp.dynamic_programming.linear_systems.strong_components import (
    StrongComponents,
    chosen_components,
)
from ssp_lp.dynamic_programming.linear_systems.system import DIRECT_STATES, EXACT, System
from ssp_lp.errors import SolverError

MOST_ROUNDS = 10_000
"""Rounds that only a defect could need: every round improves what the last one left."""

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
_RISEN = 10.0  # times the last size of the values, which no improvement makes of them
_WORSE = 1e-9
"""Relative rise of a value that is no rounding: improvement never raises one."""

_Found = tuple[IntArray, System, FloatArray, float, Work]
_SOLVED = 256
"""States of a component up to which a dense reduction costs no more than other ways."""

_PASSES = 20  # there and back


def greatest_gain(backup: Backup) -> float:
    """The greatest gain of a change in Howard's rounds, made or left to be rounding."""
    return float((backup.here - backup.minima).max(initial=0.0))


def howard_rounds(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    totals: FloatArray | None,
    floor: float = 0.0,
) -> _Found:
    """The same as ``_howard_rounds``; a stop carries the policy that the rounds had come to."""
    latest = [choice]
    try:
        return _howard_rounds(dynamics, rewards, weights, latest, totals, floor)
    except STOPS as stop:
        heed(stop)
        raise Stop(latest[0]) from stop


def _howard_rounds(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    latest: list[IntArray],
    totals: FloatArray | None,
    floor: float,
) -> _Found:
    """Policy iteration whose evaluations become exact as the gains shrink.

    Args:
        dynamics: the process.
        rewards: [pairs, rewards].
        weights: [rewards].
        latest: the policy to begin with; the last one that was evaluated takes its place.
        totals: about those of the first policy, [states, rewards].
        floor: gain of a step that is none, in units of the values.

    Returns:
        The policy, its equations and totals, the greatest gain that was left to be rounding, and
        the work.
    """
    transitions, pair_cost = dynamics.transitions, weighted(rewards, weights)
    # where a floor is promised, rough evaluations of long runs would undo what sweeps have settled
    accuracy = _ROUGH if dynamics.n_states > DIRECT_STATES and floor == 0.0 else _FINE
    choice, work, rounds, changed_before = latest[0], Work(), 0, np.inf
    before: IntArray | None = None
    scale_before = np.inf
    above: FloatArray | None = None  # values of the last policy, where they were exact
    while True:
        check_time()
        system, choice = _chain_of_round(dynamics, choice, before)
        latest[0] = choice
        totals = system.solve(rewards[choice], totals, accuracy)
        spent, system.products = system.products, 0
        work, rounds = work + Work(1, spent), rounds + 1
        values = weighted(totals, weights)
        if accuracy <= _FINE and above is not None and _rises_in_round(values, above):
            raise SolverError("a policy that was to improve the last one is worse")
        backup = best_pairs(dynamics.pair_offsets, transitions, pair_cost, values, choice)
        exact = system.is_solved_exactly
        missed = 0.0 if exact and accuracy <= _FINE else accuracy
        better, gain, scale = _gains_of_round(backup, values, missed, floor)
        if accuracy > _FINE and scale > _RISEN * scale_before:
            accuracy = _FINE  # improvement raises nothing: evaluations are too rough for such runs
            if not exact:
                scale_before = np.inf
                continue
        scale_before = scale
        if not better.any() and accuracy > _FINE:
            accuracy = _FINE  # only noise was thought greater
            if not exact:
                continue
            better, gain, scale = _gains_of_round(backup, values, 0.0, floor)
        above = values if accuracy <= _FINE else None
        if not better.any():
            return choice, system, totals, gain, work
        if rounds > MOST_ROUNDS:
            raise SolverError("policy iteration goes round in circles")
        before, changed = choice, int(np.count_nonzero(better))
        choice = np.where(better, backup.choice, choice).astype(np.int32, copy=False)
        if changed > _STEADY * changed_before and accelerated(transitions.nnz):
            work = work + _swept_in_round(dynamics, pair_cost, choice, values, floor, system, spent)
        changed_before, wanted = changed, _FORCING * gain / scale
        accuracy = min(wanted if gain > _LAST_GAINS * scale else _FINE, accuracy)


def _chain_of_round(
    dynamics: Dynamics, choice: IntArray, before: IntArray | None
) -> tuple[System, IntArray]:
    """The equations of a policy that leaves, which may differ from what was chosen."""
    if dynamics.n_states <= DIRECT_STATES:  # what is wrong with small ones shows in the totals
        return dynamics.chain(choice), choice
    return leaving_chain(dynamics, choice, before)


def _swept_in_round(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    choice: IntArray,
    values: FloatArray,
    floor: float,
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
        swept = improve_along_chain(dynamics, pair_cost, choice, values, floor)
    if swept is None:
        most = _most_sweeps(dynamics, system, spent)
        swept = _sweep_in_round(dynamics, pair_cost, choice, values, floor, most)
    return Work(swept, 0)


def _gains_of_round(
    backup: Backup, values: FloatArray, missed: float, floor: float
) -> tuple[BoolArray, float, float]:
    """Which states gain more than noise, the greatest gain, and the size of the values."""
    scale = max(float(np.abs(values).max(initial=0.0)), 1e-300)
    noise = IMPROVEMENT * np.abs(backup.here) + floor
    noise = noise + (_NOISE * missed if missed > _FINE else missed) * scale
    better = np.asarray(backup.minima < backup.here - noise)
    return better, greatest_gain(backup), scale


def _rises_in_round(values: FloatArray, above: FloatArray) -> bool:
    """Whether values lie above those of the policy that they were to improve, beyond rounding."""
    scale = float(np.abs(above).max(initial=0.0))
    return not bool((values <= above + _WORSE * scale).all())


def _sweep_in_round(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    choice: IntArray,
    values: FloatArray,
    floor: float,
    most_sweeps: int,
) -> int:
    """In one of Howard's rounds improve by sweeps, in place, while many states change.

    States of small value come first, then last: so news travels both ways, from the ends on and
    towards them.
    """
    from ssp_lp.compiled.improvement import improve_states

    parts = unsigned_parts(dynamics.pair_offsets, dynamics.transitions)
    order = np.argsort(values, kind="stable").astype(np.uint32)
    backward, most = np.ascontiguousarray(order[::-1]), 0
    for sweep in range(1, most_sweeps + 1):
        direction, changed = order if sweep % 2 else backward, 0
        for some in pieces(order.size, dynamics.transitions.nnz):
            changed += improve_states(
                *parts, direction[some], pair_cost, IMPROVEMENT, floor, choice.view(np.uint32),
                values,
            )[0]  # fmt: skip
        most = max(most, changed)
        if changed <= _SETTLED * most and sweep > 1:  # where one way changed nothing, the other may
            return sweep
    return most_sweeps


def _most_sweeps(dynamics: Dynamics, system: System, products: int) -> int:
    """Sweeps of a round that cost about as much as the last evaluation did."""
    if products <= _DIRECT:
        return _SWEEPS
    share = system.matrix.nnz / max(dynamics.transitions.nnz, 1)
    return min(max(int(products * share), _LEAST_SWEEPS), _SWEEPS)


def improve_along_chain(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    choice: IntArray,
    values: FloatArray,
    floor: float = 0.0,
) -> int | None:
    """In Howard's rounds improve a policy, in place, until a pass there and back changes nothing.

    Each pass takes the components anew: those of the chain of the policy as it has become.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        choice: pair of each state of a policy that leaves, [states].
        values: of no better policy, [states].
        floor: gain of a step that is none.

    Returns:
        The number of backups of all states; None where the components are too large.
    """
    found = chosen_components(dynamics.transitions, choice)
    if found.largest > _SOLVED:
        return None
    run, stale = 0, np.ones(dynamics.n_states, dtype=np.bool_)
    for _ in range(_PASSES):
        changed = 0
        for is_forward in (True, False):
            changed += _pass_of_round(
                dynamics, found, pair_cost, choice, values, floor, stale, is_forward
            )
        run += 2
        if not changed:
            break
        found = chosen_components(dynamics.transitions, choice)
        if found.largest > _SOLVED:
            break
    return run


def _pass_of_round(
    dynamics: Dynamics,
    found: StrongComponents,
    pair_cost: FloatArray,
    choice: IntArray,
    values: FloatArray,
    floor: float,
    stale: BoolArray,
    is_forward: bool,
) -> int:
    """One pass along the chain in Howard's rounds, in place; how often a pair was changed."""
    from ssp_lp.compiled.improvement import improve_blocks

    before, count, changed = dynamics.predecessors, found.n_components, 0
    for some in pieces(count, dynamics.transitions.nnz):
        begin, end = (
            (some.start, some.stop) if is_forward else (count - some.stop, count - some.start)
        )
        changed += improve_blocks(
            *unsigned_parts(dynamics.pair_offsets, dynamics.transitions), dynamics.exits,
            unsigned(found.order), found.offsets[begin : end + 1], is_forward, found.largest,
            pair_cost, IMPROVEMENT, floor, unsigned(before.pairs), before.offsets,
            unsigned(dynamics.pair_state), choice.view(np.uint32), values, stale,
        )  # fmt: skip
    return changed
