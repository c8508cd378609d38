"""Exploration: a problem on an implicit model is solved on a sequence of growing explored parts.

Each part is an ordinary model whose optimum is a bound of the whole model's optimum
(:mod:`ssp_lp.model.implicit`). Its fringe is the set of states that were found but not expanded. A
round solves the part and expands the fringe states in doubt: those that the lottery may reach, and
those that decide whether the lottery may fail where it does. The rounds end when no state is in
doubt.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, cast

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray, entries_of, offsets_of, segment_minima, segment_sums
from ssp_lp.compiled.deadline import WithIncumbent, interrupted, until
from ssp_lp.errors import InfeasibleError, ModelError, OutOfTimeError
from ssp_lp.model.graph import attention_pairs, attention_states, drain, reached_along
from ssp_lp.model.implicit import Exploration, ExploredSSP
from ssp_lp.model.ssp import ImplicitSSP
from ssp_lp.options import deadline_of
from ssp_lp.policies import DeterministicPolicy
from ssp_lp.policies.chain import policy_chain
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, MixedPolicy, Policy
from ssp_lp.problem import Problem, limits_of
from ssp_lp.processes.failure_semantics import GiveUp, survival_of
from ssp_lp.processes.quantities import words_visited
from ssp_lp.solution import Solution

_LOG = logging.getLogger("ssp_lp.exploring")
FIRST = 100  # states that are expanded before the first round
_CONTRADICTED = 1e-7  # relative: a policy's value below a bound by more contradicts it


def explore(problem: Any, solve: Callable[..., Solution], time_limit: float | None) -> Solution:
    """Solve a problem on an implicit model by rounds.

    Args:
        problem: a formulation that ``check_explorable`` accepts.
        solve: function that solves the problem on an explored part.
        time_limit: seconds for all rounds.

    Raises:
        ModelError: the successor function or a bound is wrong, or a policy of the explored part
            contradicts a bound.
        InfeasibleError: no policy satisfies all limits, even if unexplored states attain their
            bounds.
        OutOfTimeError: the time limit ended the rounds; the error states the proved bound.
        KeyboardInterrupt: Ctrl-C was pressed before a solution was found.
    """
    began, semantics, whole = time.perf_counter(), problem.semantics, problem.model
    may_end, charged = semantics.give_up is GiveUp.DEAD_ENDS, semantics.charge_failing_step
    final: Solution | None = None
    progress, rounds = "nothing was explored", 0
    with (
        until(deadline_of(time_limit, began)) as deadline,
        suppress(OutOfTimeError),
        WithIncumbent(),
    ):
        exploration = _start_exploration(problem)
        while final is None:
            part = exploration.part(survival_of(problem.discount), may_end, charged=charged)
            left = None if time_limit is None else max(deadline.at - time.perf_counter(), 0.0)
            solution, wanted = _answered(problem.with_arguments(model=part), solve, left)
            rounds += 1
            size = f"{part.n_expanded:,} states explored in {rounds} rounds"
            progress = f"{size}{_bound_in_words(solution)}"
            _LOG.info("%s, %d to expand next", progress, wanted.size)
            if not wanted.size:
                final, progress = solution, size
            elif deadline.is_past():
                break
            else:
                exploration.grow(part.numbers[wanted].tolist(), whole.growth * part.n_expanded)
    if final is None and deadline.is_interrupted:
        raise interrupted(progress)
    if final is None:
        raise OutOfTimeError(
            f"the time limit ended before all states in doubt were explored ({progress}): allow "
            "more time, or give tighter bounds"
        )
    _check_bounds(final)
    reason, seconds = f"{final.run.reason}; {progress}", time.perf_counter() - began
    run = replace(final.run, reason=reason, seconds=seconds, time_limit=time_limit)
    assumed = f"assuming that {whole.assumption}" if whole.assumption else ""
    unmet = _unmet(cast("ExploredSSP", final.problem.model), problem)
    note = "; ".join(filter(None, [assumed, unmet, final.note]))
    return replace(final, policy=_within(final.policy), run=run, note=note)


def _start_exploration(problem: Problem) -> Exploration:
    """Return the exploration of a problem's implicit model after its first expansions.

    It begins at the start and at the states that limits name.
    """
    whole, start = cast("ImplicitSSP", problem.model), problem.start
    begin = [*start] if isinstance(start, Mapping) else [start]
    named = [word for word in _words_of(problem) if word not in whole.labels]
    exploration = Exploration(whole, [*begin, *named])
    exploration.grow([exploration.flat.place_of(state) for state in begin], FIRST)
    return exploration


def _words_of(problem: Problem) -> list[Hashable]:
    """Return the states and labels whose visits a problem's limits count, each once."""
    limits = (limit for _, limit in limits_of(problem))
    return list(dict.fromkeys(word for limit in limits for word in words_visited(limit)))


def _answered(
    problem: Any, solve: Callable[..., Solution], time_limit: float | None
) -> tuple[Solution, IntArray]:
    """Solve a problem on an explored part; return the solution and the states in doubt.

    If failure must be least (no budget) and there are limits, the part may be infeasible, because
    its policies of least failure violate a limit. Then the problem is solved without limits, to
    find the unexpanded states on which the least failure depends.

    Raises:
        ModelError: a limit counts quantities after failing.
        InfeasibleError: no policy satisfies all limits, even if unexplored states attain their
            bounds.
    """
    if problem.unrolled is not problem:
        raise ModelError(
            "a limit counts events after failing, which are not explored: use "
            "give_up='dead_ends', or build the whole model, SSP.from_successors(...)"
        )
    try:
        solution = solve(problem, time_limit=time_limit)
    except InfeasibleError as error:
        if problem.failure_budget is not None or not problem.constraints:
            if problem.model.fringe.any():
                raise _even_at_best(error) from error
            raise
        solution = solve(replace(problem, constraints={}), time_limit=time_limit)
        if not (wanted := states_in_doubt(solution)).size:
            raise
        return solution, wanted
    return solution, states_in_doubt(solution)


def _even_at_best(error: InfeasibleError) -> InfeasibleError:
    """Return the error of the whole model, given that of an infeasible explored part.

    The whole model is infeasible too, since the part assumes the best that its bounds allow.
    """
    return InfeasibleError(
        f"infeasible even if unexplored states attain their bounds: {error}",
        failure_budget=error.failure_budget,
        least_failure=1.0,
        least_discounted_failure=None if error.least_discounted_failure is None else 1.0,
        conflicting_rows=error.conflicting_rows,
        least_failure_bound=error.least_failure_interval[0],
    )


def _unmet(part: ExploredSSP, problem: Problem) -> str:
    """Return a note on states and labels that limits name but that were not found, or ""."""
    unmet = [
        repr(word)
        for word in _words_of(problem)
        if not (
            part.state_labels[str(word)].size
            if word in part.whole.labels
            else word in part.whole.begin or (part.successors == part.index_of(word)).any()
        )
    ]
    return f"limits name states or labels that were not found: {', '.join(unmet)}" if unmet else ""


def _bound_in_words(solution: Solution) -> str:
    """Return in words the bound that a round proves, of the optimum or of the least failure."""
    if solution.problem.failure_budget is None:
        least = solution.least_failure_bound
        return "" if least is None else f", no policy fails less than {least:.9g}"
    if solution.upper_bound is not None:
        return f", the optimum is at most {solution.upper_bound:.9g}"
    return f", the optimum is at least {solution.lower_bound:.9g}"


def states_in_doubt(solution: Solution) -> IntArray:
    """Return the indices of the fringe states on which a solution depends.

    These are the fringe states that the lottery may reach, and those that decide whether a state
    where it fails is one in which failing is allowed.

    Args:
        solution: solution of a problem on an explored part.
    """
    part, semantics = cast("ExploredSSP", solution.problem.model), solution.problem.semantics
    begin = np.flatnonzero(solution.problem.start_mass)
    states, last = np.arange(part.n_states), part.pair_offsets[1:] - 1
    reached, doubts = np.zeros((2, part.n_states), dtype=np.bool_)
    for member in solution.policy.policies:
        branches = member.branches(states, np.zeros_like(states))
        taken = branches.probability > 0.0
        here, pairs = branches.situation[taken], branches.pair[taken]
        seen = _reached(part, pairs[pairs >= 0], begin)
        fails = part.may_end[here] & (pairs == last[here])
        if semantics.give_up is GiveUp.ATTENTION:
            fails |= pairs == GIVE_UP_CODE
        reached |= seen
        doubts[here[fails & seen[here]]] = True
    doubts[part.n_expanded :] = False
    pairs = np.arange(part.pair_offsets[part.n_expanded])
    if semantics.give_up is GiveUp.ATTENTION and doubts.any():
        allowed, settled = _settled(part, charged=semantics.charge_failing_step)
        doubts, pairs = doubts & ~settled, pairs[allowed[pairs]]
    if doubts.any():
        reached |= _reached(part, pairs, np.flatnonzero(doubts))
    return np.flatnonzero(reached & part.fringe)


def _reached(part: ExploredSSP, pairs: IntArray, begin: IntArray) -> BoolArray:
    """Return a mask of the states that can be reached by given pairs alone, [states].

    Args:
        part: the explored part.
        pairs: indices of the pairs that may be taken.
        begin: indices of the states in which the search begins.
    """
    places, counts = entries_of(part.outcome_offsets, np.sort(pairs))
    leads = np.bincount(part.pair_state[np.sort(pairs)], counts, minlength=part.n_states)
    return reached_along(part.successors[places], offsets_of(leads.astype(np.int64)), begin)


def _settled(part: ExploredSSP, *, charged: bool) -> tuple[BoolArray, BoolArray]:
    """Return pairs that may avoid the goal, and states that may surely give up.

    Two cases are compared: every fringe state is an attention state, as in the part, or none is. A
    pair may avoid the goal if all its successors are attention states in the first case. A state
    may surely give up if it is an attention state even in the second case, and if its charge for
    giving up is the same in both.

    Args:
        part: the explored part.
        charged: whether giving up is charged.

    Returns:
        A mask of the pairs, [pairs], and a mask of the states, [states].
    """
    open_pairs, left = np.ones(part.n_pairs, dtype=np.bool_), np.diff(part.pair_offsets)
    idle, beyond = left == 0, part.goal_mask | part.fringe
    drain(part, open_pairs, left, beyond.nonzero()[0])
    known = ~beyond & (idle | (left > 0))
    allowed, sure = (attention_pairs(part, kept) for kept in (attention_states(part), known))
    for costs in [part.costs, *part.named_costs.values()] if charged else []:
        means = segment_sums(part.probabilities * costs, part.outcome_offsets)
        least, least_known = (
            segment_minima(np.where(pairs, means, np.inf), part.pair_offsets)
            for pairs in (allowed, sure)
        )
        known &= least_known <= least
    return allowed, known


def _check_bounds(solution: Solution) -> None:
    """Check an implicit model's bounds against the exact values of a solution's policies.

    Raises:
        ModelError: a policy reaches the goal more often, or at less cost, than a bound says.
    """
    part = cast("ExploredSSP", solution.problem.model)
    start = solution.problem.start_mass
    for member in solution.policy.policies:
        chain = policy_chain(part, member, start)
        goal, cost = chain.arriving()
        nodes = np.flatnonzero((chain.state < part.n_expanded) & (goal > 0.0))
        here, goal, cost = chain.state[nodes], goal[nodes], cost[nodes]
        most = 1.0 - part.least_failure[here]
        least = part.least_cost[here] * goal
        for wrong, name, told, met in (
            (goal > most + _CONTRADICTED, "failure_bound", 1.0 - most, 1.0 - goal),
            (
                cost < (least - _CONTRADICTED) * (1.0 - _CONTRADICTED),
                "cost_bound",
                least / goal,
                cost / goal,
            ),
        ):
            if wrong.any():
                k = int(np.argmax(wrong))
                does = "fails with" if name == "failure_bound" else "reaches the goal for a mean of"
                raise ModelError(
                    f"{name}({part.states[here[k]]!r}) = {told[k]:.9g} is not a bound: a policy "
                    f"{does} {met[k]:.9g} from there"
                )


def _within(lottery: MixedPolicy) -> MixedPolicy:
    """Return a lottery without decisions of deterministic members in states not expanded."""
    members = list[Policy]()
    for member in lottery.policies:
        if isinstance(member, DeterministicPolicy):
            part = cast("ExploredSSP", member.model)
            decision = np.where(part.fringe, UNDECIDED, member.decision)
            member = replace(member, decision=decision)
        members.append(member)
    return replace(lottery, policies=tuple(members))
