"""Policy iteration from a policy that ends every run, along the components of a process.

A process of small components is solved in one pass, ends first. A process with a large component is
solved by Howard's rounds of evaluation and improvement, in which evaluations become exact as the
gains shrink. The number of rounds could be as large as the number of steps of a run. Therefore the
policy is also improved in place between two rounds, by Bellman backups of the states in increasing
and in decreasing order of their values. In increasing order, gains spread to the predecessors of a
state. In decreasing order they spread back, once a better pair leads to a new successor.

The last policy is evaluated with a verified bound of its error. If the process is left so rarely
that double precision cannot compare two pairs, improvement continues in twice that precision. In a
loop that is left with probability q, the advantage of a pair is only q times what a policy gains by
taking the pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import (
    IMPROVEMENT,
    MACHINE_EPSILON,
    BoolArray,
    FloatArray,
    IntArray,
    first_minimisers,
    segment_minima,
    unsigned,
    weighted,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import STOPS, Stop, check_time, end_with_incumbent
from ssp_lp.dynamic_programming.bellman import Backup, Work, best_pairs
from ssp_lp.dynamic_programming.chain_solvers import HOLDS_MASS
from ssp_lp.dynamic_programming.dynamics import Dynamics, leaving_chain
from ssp_lp.dynamic_programming.equations import DIRECT_STATES, EXACT, System
from ssp_lp.dynamic_programming.evaluation import (
    NEARLY,
    PRECISE,
    PROVED,
    acyclic_totals,
    evaluate_chain,
    evaluate_policy,
)
from ssp_lp.errors import SolverError

_WORTHLESS = 1e-16
"""Sum of all gains, relative to the values, below which policies could cycle."""

MOST_ROUNDS = 10_000
"""Most rounds; more would be a defect, since every round improves the policy."""

_ROUGH = 0.1  # relative residual of the first evaluation
_LAST_GAINS = 1e-4  # gains, relative to the values, below which evaluations are exact
_FORCING = 0.1  # residual of an evaluation as a share of the last gain, relative to the values
_NOISE = 0.01  # share of a rough residual that a gain must exceed, so that changes do not cycle
_STEADY = 0.3
"""Ratio of changes of two rounds above which sweeps are needed between rounds."""

_SWEEPS = 20  # most sweeps between two evaluations
_LEAST_SWEEPS = 6
_DIRECT = 2  # most passes over a chain by an evaluation that does not iterate
_IN_PLACE = "policy_improvement.improve_states"
_RISEN = 10.0  # growth of the values that no improvement can cause


@dataclass(frozen=True, eq=False)
class IterationResult:
    """A policy that no single change of a pair improves, with its expected totals."""

    choice: IntArray  # [states]
    totals: FloatArray  # [states, rewards]
    values: FloatArray  # [states] the totals, weighted
    low: FloatArray  # [states] rounding error of the values, if it was computed
    runs: FloatArray  # [states] checked: twice this is at least the expected number of steps
    work: Work


@with_twin
def iterate_policy(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    guess: FloatArray | None = None,
    *,
    precise: bool | None = None,
    floor: float = 0.0,
) -> IterationResult:
    """Minimise the expected total of ``rewards @ weights`` from every state by policy iteration.

    A state changes its pair only for a gain above rounding. If the first policy's chain is
    transient, and every end component has a cost, then every later policy is transient as well, and
    the fixed point is the optimum (mathematics, section 4). The graph of each chain is checked
    before its evaluation, because rounding could violate this.

    Args:
        dynamics: the process.
        rewards: one or more rewards of each pair, [pairs, rewards].
        weights: [rewards].
        choice: pair of the first policy in each state, [states].
        guess: totals to start the first evaluation from, [states, rewards].
        precise: whether to compare pairs in twice the working precision at the end; None: if
            rounding may hide gains.
        floor: gain that counts as 0, in units of the totals.

    Raises:
        Stop: the time ended; the error has the policy found so far.
        SolverError: a policy never leaves the process, or totals cannot be verified.
    """
    check_time()
    choice = np.array(choice, dtype=np.int32)
    if choice.min(initial=0) < 0:  # compiled loops do not check pairs
        raise SolverError("policy iteration needs a first policy with a pair for every state")
    work, left, latest = Work(1, 0), 0.0, [choice]
    try:
        one_pass = (
            None if dynamics.is_reused else acyclic_totals(dynamics, choice, rewards, weights)
        )
        if one_pass is not None:
            choice, totals = one_pass
        elif dynamics.is_solved_backwards:
            pair_cost = weighted(rewards, weights)
            choice, values = improve_backwards(dynamics, pair_cost, choice)
            if dynamics.is_reused and not precise:  # the caller checks all layers together
                nothing = np.zeros_like(values)
                return IterationResult(choice, values[:, None], values, nothing, nothing, work)
            offsets, transitions = dynamics.pair_offsets, dynamics.transitions
            left = greatest_gain(best_pairs(offsets, transitions, pair_cost, values, choice))
            totals = evaluate_policy(dynamics, choice, rewards)
        else:
            rounds = howard_rounds(dynamics, rewards, weights, latest, guess, floor)
            choice, system, solved, left, work = rounds
            totals = evaluate_chain(system, rewards[choice], solved)
            work = work + Work(0, system.products)
    except STOPS as stop:
        end_with_incumbent(stop)
        raise Stop(latest[0]) from stop
    except SolverError:
        return improve_precisely(dynamics, rewards, weights, choice, work, floor)
    values = weighted(totals.values, weights)
    if precise is None:
        precise = _gains_may_add_up(values, totals.runs, left)
    if precise:
        return improve_precisely(dynamics, rewards, weights, choice, work, floor)
    return IterationResult(choice, totals.values, values, np.zeros_like(values), totals.runs, work)


def _gains_may_add_up(values: FloatArray, runs: FloatArray, left: float) -> bool:
    """Return whether gains that count as rounding may add up to more than rounding along a run.

    Args:
        values: [states].
        runs: approximate expected steps, [states].
        left: the greatest gain that was not taken.
    """
    scale, longest = float(np.abs(values).max(initial=0.0)), float(runs.max(initial=0.0))
    hidden = (left + 4.0 * MACHINE_EPSILON * scale) * longest
    open_ties = len(values) <= DIRECT_STATES and left * longest > IMPROVEMENT * scale
    return open_ties or hidden > PROVED * scale


def howard_rounds(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    latest: list[IntArray],
    totals: FloatArray | None,
    floor: float,
) -> tuple[IntArray, System, FloatArray, float, Work]:
    """Run Howard's policy iteration: evaluate and improve the policy until no pair is better.

    Args:
        dynamics: the process.
        rewards: [pairs, rewards].
        weights: [rewards].
        latest: list with the first policy; each policy that is evaluated replaces the entry.
        totals: approximate totals of the first policy, [states, rewards].
        floor: gain of a step that counts as 0, in units of the values.

    Returns:
        The policy, its equations and totals, the greatest gain that counted as rounding, and the
        work.
    """
    evaluation = _Evaluation(dynamics, rewards, weights, totals, floor)
    offsets, transitions = dynamics.pair_offsets, dynamics.transitions
    choice, before, work = latest[0], None, Work()
    changed, n_rounds = np.inf, 0
    while True:
        check_time()
        system, choice = evaluation.leaving(choice, before)
        latest[0] = choice
        products = evaluation.evaluate(system, choice)
        values, n_rounds, work = evaluation.values, n_rounds + 1, work + Work(1, products)
        backup = best_pairs(offsets, transitions, evaluation.pair_cost, values, choice)
        better = evaluation.judge(backup)
        if better is None:  # too rough: evaluate the same policy again
            continue
        if not better.any():
            totals = evaluation.totals_of(system, choice)
            return choice, system, totals, greatest_gain(backup), work
        if n_rounds > MOST_ROUNDS:
            raise SolverError("rounding makes policy iteration repeat policies: try a discount")
        before, changed_before, changed = choice, changed, int(np.count_nonzero(better))
        choice = np.where(better, backup.choice, choice).astype(np.int32, copy=False)
        if changed > _STEADY * changed_before and accelerated(dynamics.n_entries, _IN_PLACE):
            # for about as long as the last evaluation, if that was iterative
            share, exact = system.n_entries / max(dynamics.n_entries, 1), system.is_solved_exactly
            as_long = max(int(products * share), _LEAST_SWEEPS)
            sweeps = min(as_long, _SWEEPS) if products > _DIRECT else _SWEEPS
            in_place = evaluation.pair_cost, choice, values, floor, sweeps
            work = work + Work(dynamics.improve_by_sweeps(*in_place, is_sorted_anew=exact), 0)


def greatest_gain(backup: Backup) -> float:
    """Return the greatest gain of a state by the best pair in place of the present one."""
    return float((backup.current_values - backup.minima).max(initial=0.0))


class _Evaluation:
    """The evaluations of Howard's rounds, which become exact as the gains shrink.

    Chains without a large component are always solved exactly. Other chains are solved iteratively,
    to an accuracy a little finer than the last gain. If one reward takes long, only the weighted
    sum of the rewards is evaluated until the last round.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        rewards: FloatArray,
        weights: FloatArray,
        totals: FloatArray | None,
        floor: float,
    ) -> None:
        self.dynamics, self.rewards, self.weights = dynamics, rewards, weights
        self.totals, self.floor, self.pair_cost = totals, floor, weighted(rewards, weights)
        self.values, self._is_single = np.zeros(0), False
        # with a floor, rough evaluations of long runs would undo improvements by sweeps
        rough = dynamics.n_states > DIRECT_STATES and floor == 0.0
        self._accuracy, self._scale = _ROUGH if rough else EXACT, np.inf
        self._above: FloatArray | None = None  # values of the last policy, if exact

    def leaving(self, choice: IntArray, before: IntArray | None) -> tuple[System, IntArray]:
        """Return the chain of an improved policy, and this policy.

        The policy is changed in states from which it would never end a run. If states are few, it
        is not checked, since the evaluation of such a policy fails.
        """
        if self.dynamics.n_states <= DIRECT_STATES:
            return self.dynamics.chain(choice), choice
        return leaving_chain(self.dynamics, choice, before)

    def evaluate(self, system: System, choice: IntArray) -> int:
        """Evaluate a policy, and return the number of passes over its chain.

        Raises:
            SolverError: the policy is worse than the one evaluated before.
        """
        self._is_iterated = not system.is_solved_exactly
        self._is_exact = not self._is_iterated or self._accuracy <= EXACT
        self._is_evaluated = not self._is_single or not self._is_iterated
        if self._is_evaluated:
            self.totals = system.solve(self.rewards[choice], self.totals, self._accuracy)
            self.values = weighted(self.totals, self.weights)
        else:
            self.values = system.solve(self.pair_cost[choice], self.values, self._accuracy)
        self._is_single = self._is_single or system.is_solved_reward_by_reward
        if self._is_exact and self._above is not None:
            rounding = NEARLY * float(np.abs(self._above).max(initial=0.0))
            if not (self.values <= self._above + rounding).all():
                raise SolverError("rounding made the next policy worse: try a discount")
        self._above = self.values if self._is_exact else None
        products, system.products = system.products, 0
        return products

    def judge(self, backup: Backup) -> BoolArray | None:
        """Return a mask of the states that improve by more than the error of the values.

        The result is None if the values are too inaccurate, so that the policy must be evaluated
        again.
        """
        scale = max(float(np.abs(self.values).max(initial=0.0)), 1e-300)
        grown, self._scale = scale > _RISEN * self._scale, scale
        noise = IMPROVEMENT * np.abs(backup.current_values) + self.floor
        if self._is_iterated:
            noise = noise + max(_NOISE * self._accuracy, EXACT) * scale
        better = np.asarray(backup.minima < backup.current_values - noise)
        if not self._is_exact and (grown or not better.any()):
            self._accuracy, self._scale = EXACT, np.inf
            return None
        gain = greatest_gain(backup)
        wanted = _FORCING * gain / scale if gain > _LAST_GAINS * scale else EXACT
        self._accuracy = min(wanted, self._accuracy)
        return better

    def totals_of(self, system: System, choice: IntArray) -> FloatArray:
        """Return the exact totals of the policy that was evaluated last, [states, rewards]."""
        if self._is_evaluated and self.totals is not None:
            return self.totals
        return system.solve(self.rewards[choice], self.totals)


def improve_backwards(
    dynamics: Dynamics, pair_cost: FloatArray, choice: IntArray
) -> tuple[IntArray, FloatArray]:
    """Compute best pairs and values in one backward pass over small components.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        choice: a policy that ends every run, [states].

    Raises:
        SolverError: the policy does not end every run.
    """
    values, choice = np.zeros(dynamics.n_states), choice.copy()
    if dynamics.is_compiled_backwards:
        from ssp_lp.compiled.policy_improvement import improve_components

        strong = dynamics.components
        stuck = improve_components(
            dynamics.rows, unsigned(strong.order), strong.offsets, max(strong.largest, 1),
            pair_cost, IMPROVEMENT, choice.view(np.uint32), values,
        )  # fmt: skip
        if stuck >= 0:
            raise SolverError(HOLDS_MASS)
        return choice, values
    for states, pairs, offsets, rows, escape in dynamics.levels:
        total = pair_cost[pairs] + rows @ values
        ahead = np.full_like(total, np.inf)
        np.divide(total, escape, out=ahead, where=escape > 0.0)
        values[states] = segment_minima(ahead, offsets)
        choice[states] = pairs[first_minimisers(ahead, values[states], offsets)]
    return choice, values


def improve_precisely(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    work: Work,
    floor: float = 0.0,
) -> IterationResult:
    """Run policy iteration in twice the working precision.

    Args:
        dynamics: the process.
        rewards: [pairs, rewards].
        weights: [rewards].
        choice: a policy that ends every run, [states].
        work: work done before.
        floor: sum of all gains that counts as 0, in units of the values.

    Raises:
        Stop: the time ended.
        SolverError: a policy never leaves the process, or totals cannot be verified.
    """
    pair_cost, offsets, last = weighted(rewards, weights), dynamics.pair_offsets, np.inf
    before: IntArray | None = None
    for _ in range(MOST_ROUNDS):
        check_time()
        system, choice = leaving_chain(dynamics, choice, before)
        cost = pair_cost[choice, None]
        priced = evaluate_chain(system, cost, accuracy=PRECISE)
        values, low = priced.values[:, 0], priced.low[:, 0]
        if not np.isfinite(values).all():
            raise SolverError("expected costs are above 1e308: use a larger unit of cost")
        ahead, rounding = dynamics.moves.precise_advantages(pair_cost, values, low)
        gain = -segment_minima(ahead + rounding, offsets) - 2.0 * float(priced.residuals[0])
        work = work + Work(1, system.products)
        most = float(gain.max(initial=0.0))
        worth = 2.0 * float(priced.runs.max(initial=0.0)) * most
        least = _WORTHLESS * float(np.abs(values).max(initial=0.0))
        ended = worth <= floor or (worth <= least and most > 0.5 * last)
        last = most
        if ended or most <= 0.0:
            totals = evaluate_chain(system, rewards[choice])
            return IterationResult(choice, totals.values, values, low, totals.runs, work)
        before, picks = choice, choice.copy()
        best = first_minimisers(ahead, segment_minima(ahead, offsets), offsets)
        picks[np.diff(offsets) > 0] = best
        choice = np.where(gain > 0.0, picks, choice)
    raise SolverError("rounding makes policy iteration repeat policies: try a discount")


def switched(
    dynamics: Dynamics, choices: Sequence[IntArray], values: Sequence[FloatArray]
) -> tuple[IntArray, IntArray]:
    """Combine policies that end every run into one that is at least as good as each of them.

    Args:
        dynamics: the process.
        choices: the policies, [states] each.
        values: their values, [states] each.

    Returns:
        The policy, and the index of the given policy that it follows in each state, [states] each.
    """
    choice, least = choices[0], values[0]
    follows = np.zeros(len(choice), dtype=np.int8)
    for k in range(1, len(choices)):
        better = values[k] < least - NEARLY * np.abs(least)
        if better.any():
            choice = np.where(better, choices[k], choice).astype(np.int32, copy=False)
            least = np.where(better, values[k], least)
            follows[better] = k
    if follows.any():
        choice = leaving_chain(dynamics, choice, choices[0])[1]
    return choice, follows
