"""Policy iteration from a policy that leaves: improvement along the structure of a process.

A process of small components is solved in one pass, ends first; others by Howard's rounds. The last
policy is evaluated with a verified bound of its error; where the process is left so seldom that
double precision cannot tell which pair is better, improvement goes on in twice that precision: the
advantage of a pair in a loop that is left with probability q is q times what the choice is worth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import (
    MACHINE_EPSILON,
    TIED,
    FloatArray,
    IntArray,
    expected,
    first_minimisers,
    segment_minima,
    unsigned,
    weighted,
)
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.backward_induction import (
    acyclic_totals,
    is_compiled_backwards,
    is_solved_backwards,
    least_backwards,
)
from ssp_lp.dynamic_programming.bellman import Work, best_pairs, unsigned_parts
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.howard_rounds import MOST_ROUNDS, greatest_gain, howard_rounds
from ssp_lp.dynamic_programming.leaving import leaving_chain
from ssp_lp.dynamic_programming.linear_systems.advantages import precise_advantages
from ssp_lp.dynamic_programming.linear_systems.system import DIRECT_STATES
from ssp_lp.dynamic_programming.linear_systems.totals import (
    CORRECTIONS,
    EVALUATED,
    ROUNDED,
    Totals,
    evaluate_chain,
)
from ssp_lp.errors import SolverError

_UNCERTAIN = 1e-11
"""Relative loss that rounding may hide over a run, from which on precision is doubled."""

_OPEN = 1e-13  # the same of gains that were seen and declined, in small processes
_PRECISE = 1e-24  # accuracy of evaluations in twice the working precision, relative
_WORTHLESS = 1e-16
"""Worth of all gains, relative to the values, for which policies could go round in circles."""

_CLEARLY = 1e-9  # relative: values nearer to each other may differ by rounding alone
_MOVED = 1e-12  # relative: the most that taking the first of equal pairs may move a total
_NEARER = 0.25  # of a step: by so much at least each pair that is taken comes nearer to leaving


@dataclass(frozen=True, eq=False)
class Settled:
    """A policy that no single change of a pair improves, with its expected totals."""

    choice: IntArray  # [states]
    totals: FloatArray  # [states, rewards]
    values: FloatArray  # [states] the totals, weighted
    low: FloatArray  # [states] what the rounding of the values lost, where that was worked out
    runs: FloatArray  # [states] checked: twice this is at least the expected number of steps
    work: Work


def iterate_policy(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    guess: FloatArray | None = None,
    *,
    precise: bool | None = None,
    floor: float = 0.0,
) -> Settled:
    """Policy iteration: minimise the expected total of ``rewards @ weights`` from every state.

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
        precise: compare pairs in twice the working precision, in the end; None: where rounding may
            hide gains.
        floor: gain that is none, in units of the totals.

    Raises:
        Stop: the time ended, with the policy so far.
        SolverError: a policy that never leaves the process, or totals that cannot be verified.
    """
    check_time()
    choice = np.array(choice, dtype=np.int32)
    work, left = Work(1, 0), 0.0
    try:
        one_pass = (
            None if dynamics.is_reused else acyclic_totals(dynamics, choice, rewards, weights)
        )
        if one_pass is not None:
            choice, totals = one_pass
        elif is_solved_backwards(dynamics):
            pair_cost = weighted(rewards, weights)
            choice, values = least_backwards(dynamics, pair_cost, choice)
            if dynamics.is_reused and not precise:  # what is made of all layers is checked
                nothing = np.zeros_like(values)
                return Settled(choice, values[:, None], values, nothing, nothing, work)
            offsets, transitions = dynamics.pair_offsets, dynamics.transitions
            left = greatest_gain(best_pairs(offsets, transitions, pair_cost, values, choice))
            totals = evaluate_policy(dynamics, choice, rewards)
        else:
            found = howard_rounds(dynamics, rewards, weights, choice, guess, floor)
            choice, system, solved, left, work = found
            totals = evaluate_chain(system, rewards[choice], solved)
            work = work + Work(0, system.products)
    except SolverError:
        return improve_precisely(dynamics, rewards, weights, choice, work, floor)
    values = weighted(totals.values, weights)
    if precise is None:
        precise = _may_hide_more(values, totals.runs, left)
    if precise:
        return improve_precisely(dynamics, rewards, weights, choice, work, floor)
    return Settled(choice, totals.values, values, np.zeros_like(values), totals.runs, work)


def _may_hide_more(values: FloatArray, runs: FloatArray, left: float) -> bool:
    """Whether gains that policy iteration left to be rounding may be worth something along a run.

    Args:
        values: [states].
        runs: about the expected steps, [states].
        left: the greatest gain that was seen and declined.
    """
    scale, longest = float(np.abs(values).max(initial=0.0)), float(runs.max(initial=0.0))
    hidden = (left + 4.0 * MACHINE_EPSILON * scale) * longest
    open_ties = len(values) <= DIRECT_STATES and left * longest > _OPEN * scale
    return open_ties or hidden > _UNCERTAIN * scale


def improve_precisely(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    work: Work,
    floor: float = 0.0,
) -> Settled:
    """Policy iteration in twice the working precision.

    Args:
        dynamics: the process.
        rewards: [pairs, rewards].
        weights: [rewards].
        choice: a policy that leaves, [states].
        work: done before.
        floor: worth of all gains that is none, in units of the values.

    Raises:
        Stop: the time ended.
        SolverError: a policy that never leaves, or totals that cannot be verified.
    """
    pair_cost, offsets = weighted(rewards, weights), dynamics.pair_offsets
    before: IntArray | None = None
    last = np.inf
    for _ in range(MOST_ROUNDS):
        check_time()
        system, choice = leaving_chain(dynamics, choice, before)
        priced = evaluate_chain(system, pair_cost[choice][:, None], accuracy=_PRECISE)
        values, low = priced.values[:, 0], priced.low[:, 0]
        ahead, rounding = precise_advantages(
            dynamics.pair_state, dynamics.transitions, dynamics.exits, pair_cost, values, low
        )
        gain = -segment_minima(ahead + rounding, offsets) - 2.0 * float(priced.missed[0])
        better = np.flatnonzero(gain > 0.0)
        work = work + Work(1, system.products)
        most = float(gain.max(initial=0.0))
        worth = 2.0 * float(priced.runs.max(initial=0.0)) * most
        least = _WORTHLESS * float(np.abs(values).max(initial=0.0))
        ended = worth <= floor or (worth <= least and most > 0.5 * last)
        last = most
        if ended or not better.size:
            totals = evaluate_chain(system, rewards[choice])
            return Settled(choice, totals.values, values, low, totals.runs, work)
        before, choice = choice, choice.copy()
        minima = segment_minima(ahead, offsets)
        picks = np.array(offsets[:-1], dtype=np.int32)
        picks[np.diff(offsets) > 0] = first_minimisers(ahead, minima, offsets)
        choice[better] = picks[better]
    raise SolverError("policy iteration goes round in circles")


def evaluate_policy(
    dynamics: Dynamics, choice: IntArray, rewards: FloatArray, accuracy: float | None = None
) -> Totals:
    """Verified totals of a policy: in one go where the process is solved backwards.

    Args:
        dynamics: the process.
        choice: [states].
        rewards: [pairs, rewards].
        accuracy: as ``evaluate_chain`` takes it.

    Raises:
        SolverError: as ``evaluate_chain``.
    """
    if accuracy is None and (one_pass := acyclic_totals(dynamics, choice, rewards)) is not None:
        return one_pass[1]
    if is_solved_backwards(dynamics) and is_compiled_backwards(dynamics):
        totals = _evaluated_policy(dynamics, choice, rewards, accuracy)
        if totals is not None:
            return totals
    return evaluate_chain(dynamics.chain(choice), rewards[choice], accuracy=accuracy)


def _evaluated_policy(
    dynamics: Dynamics, choice: IntArray, rewards: FloatArray, accuracy: float | None
) -> Totals | None:
    """The same compiled; None where the totals cannot be verified."""
    from ssp_lp.compiled.precision import evaluate_precisely

    found, rows, shape = dynamics.components, dynamics.transitions, (len(choice), rewards.shape[1])
    if accuracy is None:
        accuracy = ROUNDED if len(choice) <= DIRECT_STATES else EVALUATED
    x, low, runs, missed = np.empty(shape), np.empty(shape), np.empty(shape[0]), np.empty(shape[1])
    verified = evaluate_precisely(
        unsigned(rows.indptr), unsigned(rows.indices), rows.data, dynamics.exits, unsigned(choice),
        unsigned(found.order), found.offsets, max(found.largest, 1),
        rewards, accuracy, CORRECTIONS, MACHINE_EPSILON, x, low, runs, missed,
    )  # fmt: skip
    if not verified:
        return None
    totals = Totals(x, low, runs, missed)
    return totals if totals.are_within(max(accuracy, EVALUATED)) else None


def switched(
    dynamics: Dynamics, choices: Sequence[IntArray], values: Sequence[FloatArray]
) -> tuple[IntArray, IntArray]:
    """For policy iteration, a policy no worse than any of several, all of which leave.

    Args:
        dynamics: the process.
        choices: the policies, [states] each.
        values: their values, [states] each.

    Returns:
        The policy, and which of the given ones it follows in each state, [states] each.
    """
    choice, least = choices[0], values[0]
    follows = np.zeros(len(choice), dtype=np.int8)
    for k in range(1, len(choices)):
        better = values[k] < least - _CLEARLY * np.abs(least)
        if better.any():
            choice = np.where(better, choices[k], choice).astype(np.int32, copy=False)
            least = np.where(better, values[k], least)
            follows[better] = k
    if follows.any():
        choice = leaving_chain(dynamics, choice, choices[0])[1]
    return choice, follows


def first_of_equals(
    dynamics: Dynamics,
    rewards: FloatArray,
    choice: IntArray,
    totals: FloatArray,
    runs: FloatArray,
    start: FloatArray | None = None,
) -> IntArray:
    """The policy with the first pair of each state that is as good as its own in every total.

    What rounding favoured among equals is not seen in it. No total needs to be worked out again:
    a pair is taken where it keeps to the equations of all totals, up to ``TIED`` of the total
    there, or of that at the start, and comes nearer to leaving, as run lengths measure it. So the
    new policy leaves within four times the run length, and each of its steps moves a total by
    ``TIED``, or by less in long runs: by no more than 1e-12 of it in all, which certificates let
    pass.

    Args:
        dynamics: the process.
        rewards: [pairs, rewards].
        choice: the policy, which leaves, [states].
        totals: its expected totals, [states, rewards].
        runs: as ``Totals.runs``, [states].
        start: where an episode begins, [states]; None: anywhere.

    Returns:
        [states].
    """
    slack = min(TIED, _MOVED * _NEARER / float(runs.max(initial=1.0))) * np.abs(totals)
    if start is not None:
        longest = max(float(expected(start, runs)), 1.0)
        slack = np.maximum(
            slack, min(TIED, _MOVED * _NEARER / longest) * np.abs(expected(start, totals))
        )
    offsets, transitions = dynamics.pair_offsets, dynamics.transitions
    first = choice.astype(np.int32)
    if accelerated(len(transitions.indices)):
        from ssp_lp.compiled.improvement import take_first_of_equals

        take_first_of_equals(
            *unsigned_parts(offsets, transitions), rewards, totals, slack, runs, _NEARER,
            first.view(np.uint32),
        )  # fmt: skip
        return first
    home = dynamics.pair_state
    alike = runs[home] - transitions @ runs >= _NEARER
    ahead = rewards + transitions @ totals
    alike &= (np.abs(ahead - ahead[choice][home]) <= slack[home]).all(axis=1)
    alike[choice] = True
    pairs = np.flatnonzero(alike)
    return pairs[np.flatnonzero(np.diff(home[pairs], prepend=-1))].astype(np.int32)
