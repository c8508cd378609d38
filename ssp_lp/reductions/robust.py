"""Robust optima: a problem over boxes of probabilities, restated at the worst probabilities.

A policy is improved against nature, which chooses the worst probabilities in the boxes for this
policy (policy iteration of Hoffman and Karp, Management Science 12, 1966; Iyengar, Mathematics of
Operations Research 30, 2005). At the optimum one choice of probabilities is the worst for the
optimal policy, and no policy does better at this choice. The problem at these probabilities is an
ordinary one. Its certified bound also holds for the robust optimum, since a policy's worst case
over the boxes is at least as bad as its value at one point of the boxes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np

from ssp_lp.analysis.evaluation import evaluate
from ssp_lp.analysis.worst_case import worst_case, worst_charges
from ssp_lp.arrays import (
    IMPROVEMENT,
    LEAST_BUDGET,
    BoolArray,
    FloatArray,
    IntArray,
    expected,
    first_minimisers,
    read_only,
    segment_ids,
    segment_minima,
    segment_sums,
)
from ssp_lp.compiled.deadline import check_time, limited
from ssp_lp.errors import InfeasibleError, ModelError, SolverError
from ssp_lp.model import SSP
from ssp_lp.model.boxes import FORCED, Boxes, forced, greatest_mean
from ssp_lp.model.graph import attention_pairs, attention_states, dead_ends
from ssp_lp.policies import DeterministicPolicy, Policy
from ssp_lp.policies.boxed_chain import MOST_ROUNDS, boxed_chain
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, as_lottery
from ssp_lp.processes.failure_semantics import Aim, FailureSemantics, GiveUp
from ssp_lp.processes.live_rows import costless_pairs
from ssp_lp.solution import Solution

_BESIDE = LEAST_BUDGET
"""Weight of a point inside the boxes, mixed with the worst probabilities to make all outcomes
possible; the failure probability changes by about as much."""


def robust(problem: Any, solve: Callable[..., Solution], time_limit: float | None) -> Solution:
    """Solve a problem over boxes of probabilities.

    Args:
        problem: a formulation that ``check_boxed`` accepts, with ``box``.
        solve: function that solves the problem at given probabilities.
        time_limit: seconds.

    Returns:
        The robust policy, as the solution of the problem at (or near) the worst probabilities. The
        solution's model has these probabilities. ``objective`` is the policy's worst
        value over the boxes, and the bound holds for every policy's worst value.

    Raises:
        InfeasibleError: failing is forbidden, and no policy reaches the goal surely at all
            probabilities in the boxes.
        SolverError: the policy iteration does not converge, or the bound lies above the value.
        OutOfTimeError: the time limit passed before it converged.
    """
    began, boxes, semantics = time.perf_counter(), problem.box, problem.semantics
    start = problem.start_mass
    with limited(time_limit, "the worst probabilities were settled"):
        loss, decision, worst, rounds = settled(boxes, semantics)
        lost = (start > 0.0) & np.isinf(loss)
        if not semantics.forbids_failing:
            check_ends(problem.model, lost)
        elif lost.any():
            state = problem.model.states[int(np.argmax(lost))]
            raise InfeasibleError(
                f"no policy reaches the goal surely from state {state!r} at all probabilities in "
                "the boxes: allow failing (MCMP, FinitePenalty), or collect more counts",
                failure_budget=0.0,
                least_failure=lambda: float(
                    start @ settled(boxes, FailureSemantics(aim=Aim.GREATEST_GOAL))[0]
                ),
            )
    stated = problem.with_arguments(box=None)

    def solve_in_time(at_worst: Any) -> Solution:
        """Solve the problem at some probabilities in the time that is left."""
        spent = time.perf_counter() - began
        return solve(
            at_worst, time_limit=None if time_limit is None else max(time_limit - spent, 0.0)
        )

    solution = solved_at(stated, boxes, worst, solve_in_time)
    at_worst: Any = solution.problem
    model = at_worst.model
    policy, value = as_lottery(DeterministicPolicy(model, decision)), float(expected(start, loss))
    maximised = solution.upper_bound is not None
    if not (maximised or semantics.forbids_failing):
        # Free actions may be repeated for ever, which no change of a single decision leads to:
        # the policy of the ordinary problem may take them.
        ends, own = ending(boxes, semantics)[0], as_lottery(solution.policy).policies[0]
        other = as_lottery(DeterministicPolicy(model, completed(own, decision, ends)))
        if (better := worst_case(other, stated, boxes).objective) < value - LEAST_BUDGET * value:
            policy, value = other, better
    objective = 1.0 - value if maximised else value
    upper = max(solution.upper_bound, objective) if solution.upper_bound is not None else None
    slack = solution.lower_bound - objective
    if not maximised and slack > FORCED * max(abs(objective), 1.0) * len(loss):
        raise SolverError(f"the bound lies {slack:.1e} above the robust value; report the model")
    reason = f"{solution.run.reason}; at the worst probabilities in the boxes, of {rounds} rounds"
    seconds = time.perf_counter() - began
    return replace(
        solution,
        policy=policy,
        objective=objective,
        lower_bound=objective if maximised else min(solution.lower_bound, objective),
        upper_bound=upper,
        budget_used=evaluate(policy, at_worst).failure_probability,
        run=replace(solution.run, reason=reason, seconds=seconds, time_limit=time_limit),
    )


def at_probabilities(problem: Any, probabilities: FloatArray) -> Any:
    """Return the problem on its model with other ``probabilities``, [outcomes]."""
    chosen = read_only(probabilities)
    model = replace(problem.model, probabilities=chosen, counts=None, parameters={})
    return problem.with_arguments(model=model)


def solved_at(
    problem: Any, boxes: Boxes, worst: FloatArray, solve: Callable[[Any], Solution]
) -> Solution:
    """Solve a problem at nature's probabilities, with a bound that holds over the whole boxes.

    Where nature gives an outcome probability 0, more states may be dead-ends or attention states
    than the boxes allow, and failing in them costs too little. In that case the problem is also
    solved at nearby probabilities, at which every outcome that the boxes allow is possible, and the
    solution with the greater bound is returned.

    Args:
        problem: the problem without ``box``.
        boxes: boxes of its model.
        worst: probabilities within the boxes, [outcomes].
        solve: function that solves the problem at given probabilities.
    """
    at_worst, support = at_probabilities(problem, worst), boxes.support
    solution, model = solve(at_worst), at_worst.model
    semantics = problem.semantics
    stops_early = semantics.aim is Aim.LEAST_COST and semantics.give_up is not GiveUp.ANYWHERE
    if semantics.forbids_failing or not stops_early or all(
        np.array_equal(states(model), states(support)) for states in (dead_ends, attention_states)
    ):  # fmt: skip
        return solution
    pair, room = segment_ids(model.outcome_offsets), boxes.high - boxes.low
    least, rooms = (segment_sums(part, model.outcome_offsets)[pair] for part in (boxes.low, room))
    share = np.divide(1.0 - least, rooms, out=np.zeros_like(rooms), where=rooms > 0.0)
    within = boxes.low + share * room
    beside = solve(at_probabilities(problem, worst + _BESIDE * (within - worst)))
    return max(solution, beside, key=lambda one: one.lower_bound)


def completed(policy: Policy, decision: IntArray, ends: IntArray) -> IntArray:
    """Return a policy's decisions, some of them replaced to be allowed over the boxes, [states].

    Args:
        policy: deterministic policy on the model at nature's probabilities. It gives up, or has no
            decision, in states that are attention states or dead-ends at these probabilities only.
        decision: the replacement in such a state, [states]; but if the state has a free action that
            avoids the goal, this action is taken.
        ends: the decisions of :func:`ending`, which say where the boxes allow giving up, [states].
    """
    own, model = cast("DeterministicPolicy", policy).decision, policy.model
    free = np.flatnonzero(attention_pairs(model, attention_states(model)) & costless_pairs(model))
    waiting = np.array(decision)
    waiting[model.pair_state[free]] = free
    undecided = (own == UNDECIDED) | ((own == GIVE_UP_CODE) & (ends != GIVE_UP_CODE))
    return np.where(undecided, waiting, own)


def settled(
    boxes: Boxes, semantics: FailureSemantics, *, safest: bool = False
) -> tuple[FloatArray, IntArray, FloatArray, int]:
    """Return the least worst loss of each state over the boxes, and decisions that attain it.

    Computed by policy iteration. A decision is changed only for a strict gain, so that every policy
    of the iteration surely ends, as the first one does, and cycles of cost 0 are never entered.

    Args:
        boxes: the boxes.
        semantics: where giving up is allowed, and what an episode is worth.
        safest: minimise the failure probability among the policies of finite worst cost.

    Returns:
        Four results. The least worst loss of each state, [states]: cost plus penalty, or the
        failure probability; it is infinite if failing is forbidden and cannot be avoided, or if
        nature can prevent every policy from ending. The decisions that attain it, [states].
        Nature's worst probabilities, [outcomes]. The number of rounds.
    """
    model, only_failing = boxes.support, safest or semantics.aim is Aim.GREATEST_GOAL
    acting = ~(model.goal_mask | dead_ends(model))
    usable = np.ones(model.n_pairs, dtype=np.bool_)
    reward = np.zeros(model.n_outcomes) if only_failing else model.costs
    rank: IntArray = np.zeros(model.n_states, dtype=np.int64)
    top, ends = 0.0, np.where(model.goal_mask, 0.0, 1.0)
    decision = np.where(acting, model.pair_offsets[:-1], UNDECIDED)
    if semantics.forbids_failing:
        rank, decision, usable = _losing(boxes, model.goal_mask)
        acting &= rank == 0
    elif safest or not only_failing:
        decision, charges, rank, usable = ending(boxes, semantics)
        acting &= rank == 0
        ends *= 1.0 if safest else semantics.penalty + charges
    for rounds in range(1, MOST_ROUNDS):
        check_time()
        loss = np.array(ends)
        loss[rank > 0] = top + rank.max() + 1.0 - rank[rank > 0]
        loss = worst_loss(boxes, decision, acting, loss, None if only_failing else ends)
        worst, mean = worst_means(boxes, reward + loss[model.successors])
        mean = np.where(usable, mean, np.inf)
        least = segment_minima(mean, model.pair_offsets)
        known = loss[acting].max(initial=0.0)
        better = acting & (least < loss - IMPROVEMENT * known)
        if not better.any() and known < top:
            loss[rank > 0] = np.inf
            return loss, decision, worst, rounds
        top = 2.0 * known + float(reward.max(initial=0.0)) + 1.0  # above all that can be paid
        best = np.full(model.n_states, UNDECIDED, dtype=np.int64)
        best[np.diff(model.pair_offsets) > 0] = first_minimisers(mean, least, model.pair_offsets)
        decision = np.where(better, best, decision)
    raise SolverError("rounding makes policies over the boxes repeat; please report the model")


def worst_loss(
    boxes: Boxes, decision: IntArray, acting: BoolArray, loss: FloatArray, ends: FloatArray | None
) -> FloatArray:
    """Return the worst loss over the boxes from each state, [states], of a policy that surely ends.

    Args:
        boxes: the boxes.
        decision: decisions of the policy, [states].
        acting: mask of the states from which the policy is followed, [states].
        loss: losses that are returned for states that the policy does not reach, [states].
        ends: loss in each state in which a run may end, [states], to which the costs paid before
            are added; None: the loss is the probability of failing.
    """
    loss = np.array(loss, dtype=np.float64)
    if acting.any():
        plan = DeterministicPolicy(boxes.support, decision)
        boxed = boxed_chain(boxes, plan, acting / acting.sum())
        chain, state = boxed.chain, boxed.chain.state
        loss[state] = boxed.failing() if ends is None else (
            boxed.greatest(chain.cost, ends[state], boxed.acting))  # fmt: skip
    return loss


def worst_means(boxes: Boxes, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the greatest mean of given values over each pair's box, and where it is attained.

    Args:
        boxes: the boxes.
        values: value of each outcome, [outcomes].

    Returns:
        Nature's probabilities, [outcomes], and the means, [pairs].
    """
    offsets = boxes.model.outcome_offsets
    worst = greatest_mean(boxes.low, boxes.high, values, offsets)
    return worst, segment_sums(worst * values, offsets)


def check_ends(model: SSP, trap: BoolArray) -> None:
    """Raise :class:`ModelError` if ``trap`` is not empty.

    Args:
        model: the model.
        trap: mask of the states in which nature can keep a run for ever, [states].
    """
    if trap.any():
        raise ModelError(
            f"state {model.states[int(np.argmax(trap))]!r}: the boxes allow probabilities with "
            "which a run never ends: use give_up='anywhere', or make low positive for the outcomes "
            "that lead to an end"
        )


def ending(
    boxes: Boxes, semantics: FailureSemantics
) -> tuple[IntArray, FloatArray, IntArray, BoolArray]:
    """Return a policy that surely ends, whatever nature does, and gives up wherever it may.

    A state is called lost here if nature can prevent every policy from ending from this state. Not
    ending costs infinitely much.

    Returns:
        Four arrays. The decisions, [states]. The greatest charge over the boxes for giving up in a
        state, or for entering it if it is a dead-end, [states]. The round in which a state was
        found to be lost, 0 if it is not, [states]. A mask of the pairs that never lead to a lost
        state, [pairs].

    Raises:
        ModelError: some outcome in a lost state costs 0, so that not ending might cost nothing.
    """
    model = boxes.support
    acting = ~(model.goal_mask | dead_ends(model))
    stopping, entering = worst_charges(semantics, boxes)
    may_stop = acting & np.isfinite(stopping)
    rank, decision, usable = _losing(boxes, ~acting | may_stop)
    lost = rank > 0
    pair = segment_ids(model.outcome_offsets)
    free = (model.costs == 0.0) & (boxes.high > 0.0) & lost[model.pair_state[pair]]
    check_ends(model, lost & free.any())
    decision = np.where(lost, model.pair_offsets[:-1], decision)
    decision[may_stop] = GIVE_UP_CODE
    return decision, np.where(may_stop, stopping, entering), rank, usable


def _losing(boxes: Boxes, ends: BoolArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Find the lost states: there nature can prevent every policy from surely ending.

    In each round a state is kept if one of its pairs has, whatever nature does, a positive
    probability of leading to an end or to a state that is already kept in this round. The other
    states are lost, and pairs that may lead to them are removed before the next round.

    Args:
        boxes: the boxes.
        ends: mask of the states in which a run ends, such as the goals, [states].

    Returns:
        Three arrays. The round in which each state was lost, 0 if never, [states]. Decisions by
        which the other states surely reach an end, [states]. A mask of the pairs that never lead to
        a lost state, [pairs].
    """
    model = boxes.support
    offsets, successors = model.outcome_offsets, model.successors
    rank = (dead_ends(model) & ~ends).astype(np.int64)
    while True:
        kept = rank == 0
        usable = segment_sums(np.where(kept[successors], 0.0, boxes.high), offsets) == 0.0
        reached, decision = ends.copy(), np.full(model.n_states, UNDECIDED, dtype=np.int64)
        while True:
            check_time()
            near = forced(boxes.low, boxes.high, reached[successors], offsets)
            pairs = np.flatnonzero(near & usable & (kept & ~reached)[model.pair_state])
            if not pairs.size:
                break
            decision[model.pair_state[pairs]] = pairs
            reached[model.pair_state[pairs]] = True
        lost = kept & ~reached
        if not lost.any():
            return rank, decision, usable
        rank[lost] = rank.max() + 1
