"""What a policy's chain makes of costs, visits and ends: each quantity that a problem speaks of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ssp_lp.accumulated_cost.policy_layers import giving_up_where_lost
from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_states, dead_ends
from ssp_lp.policies.chain import Chain, policy_chain
from ssp_lp.policies.policy import GIVE_UP_CODE, Policy, as_lottery
from ssp_lp.problem import Problem
from ssp_lp.processes.conditions import Condition, StepTerm, Term
from ssp_lp.processes.failure_semantics import (
    FailureSemantics,
    GiveUp,
    dead_end_charges,
    free_pairs,
    give_up_charges,
    start_distribution,
    survival_of,
)
from ssp_lp.processes.live_rows import costless_pairs


def give_up_costs(
    chain: Chain, semantics: FailureSemantics, free: BoolArray | None = None
) -> FloatArray:
    """Value of giving up at each node of a policy's chain, 0 where it may not, [nodes]."""
    if not chain.give_up.any():
        return np.zeros(len(chain.give_up))
    charge = state_give_up_charges(chain.model, semantics, free)[chain.state]
    return np.where(chain.give_up > 0, charge, 0.0)


def check_giving_up(chain: Chain, problem: Problem) -> None:
    """Check, for a quantity's value, that a policy gives up only where it may.

    That is allowed among pairs that are free in all that the problem minimises and limits.

    Raises:
        ModelError: it does elsewhere.
    """
    semantics, objective = problem.semantics, problem.objective_condition
    limited = (row for condition in problem.conditions for row in condition.rows)
    minimised = None if objective is None else objective.minimised()
    free = free_pairs(problem.model, semantics.aim, limited, minimised)
    forbidden = np.isinf(give_up_costs(chain, semantics, free))
    if forbidden.any():
        state = chain.model.states[int(chain.state[int(np.argmax(forbidden))])]
        raise ModelError(f"the policy gives up in state {state!r}: not with {semantics.give_up!s}")


def lost_costs(
    chain: Chain,
    hopeful: BoolArray,
    semantics: FailureSemantics,
    survival: float,
    free: BoolArray | None = None,
) -> FloatArray:
    """Value of the cost to come at nodes that cannot reach the goal, [nodes].

    Failure is declared there at once, and charged as the semantics says; with ``DEAD_ENDS`` stage
    costs are paid until a dead-end is entered, which costs infinity where that is never.

    Args:
        hopeful: nodes from which the goal is reached with positive probability, [nodes].
        survival: discount of costs to come, 1 for none.
        free: see ``state_give_up_charges``.
    """
    entering = entering_charges(chain.model, semantics)[chain.state]
    lost = ~hopeful & (chain.dead == 0)
    values = np.where(chain.dead > 0, entering, 0.0)
    if not lost.any():
        return values
    if semantics.give_up is not GiveUp.DEAD_ENDS:
        return np.where(
            lost, state_give_up_charges(chain.model, semantics, free)[chain.state], values
        )
    stage = chain.per_node(chain.cost) + survival * chain.ahead(values)
    if survival < 1.0:
        return values + chain.accumulate(np.where(lost, stage, 0.0), lost, survival)
    # lost nodes from which nothing is paid any more, and those that may come to pay for ever
    leaving = (chain.dead > 0) | (chain.give_up > 0) | ~lost
    free = ~chain.reaching(leaving | (chain.per_node(chain.cost) > 0.0))
    infinite = lost & chain.reaching(~chain.reaching(leaving | free))
    values = values + chain.accumulate(np.where(lost, stage, 0.0), lost & ~free & ~infinite)
    return np.where(infinite, np.inf, values)


def state_give_up_charges(
    model: SSP, semantics: FailureSemantics, free: BoolArray | None = None
) -> FloatArray:
    """Charge of giving up in each state, for quantities' values, infinite if forbidden, [states].

    Staying for ever in an end component that costs nothing is free whatever the semantics.

    Args:
        model: the model.
        semantics: where giving up is allowed and whether it is charged.
        free: pairs among which one may stay, [pairs]; None: those that cost nothing.
    """
    wandering = np.zeros(model.n_states, dtype=np.bool_)
    if semantics.give_up is GiveUp.DEAD_ENDS:  # else whoever may stay may give up for as little
        free = costless_pairs(model) if free is None else free
        wandering = model.staying_free(free)
    return model.of_all_states(
        give_up_charges(model, attention_states(model), wandering, semantics)
    )


def entering_charges(model: SSP, semantics: FailureSemantics) -> FloatArray:
    """Charge of entering each dead-end, for quantities' values, 0 elsewhere, [states]."""
    return model.of_all_states(dead_end_charges(model, dead_ends(model), semantics))


def counted_nodes(chain: Chain, problem: Problem, *, declared: bool = False) -> BoolArray:
    """Nodes of a policy's chain at which quantities still count: failing is not declared, [nodes].

    That is where the goal can still be reached; but where a constraint asks for another end, a
    policy on its way there has not failed until it arrives or gives up.

    On states with the label of failing a policy may declare itself that it fails; of another one
    that is said as soon as it has lost the goal, by steps that avoid it surely.

    Args:
        chain: the policy's.
        problem: with what is asked.
        declared: whether the policy declares itself that it fails.
    """
    if problem.model.failure_label is not None:
        quits = chain.give_up > 0
        if not declared:
            quits &= ~attention_states(problem.model)[chain.state]
        over = (chain.goal > 0) | quits
        return chain.reaching(over | (chain.dead > 0) if declared else over)
    if problem.semantics.forbids_failing or not _asks_for_ends(problem):
        return np.asarray(chain.alive | (chain.goal > 0))
    return chain.settling


def lost_situations(policy: Policy, problem: Problem) -> Callable[[IntArray, IntArray], BoolArray]:
    """In which (state, memory) of a policy its chain has failed, as an evaluation counts it.

    Returns:
        A function of states and memories, [situations] each; False for one that the model's own
        steps do not lead to.
    """
    model = problem.model
    if model.failure_label is None and policy.layers() is not None and not _asks_for_ends(problem):
        (stopping,) = giving_up_where_lost(as_lottery(policy)).policies
        return lambda states, memory: stopping.branches(states, memory).pair == GIVE_UP_CODE
    chain = policy_chain(model, policy, start_distribution(model, problem.start))
    lost = lost_nodes(chain, problem, declared=policy.declares_failing)
    keys = (chain.memory * model.n_states + chain.state)[lost]
    return lambda states, memory: np.isin(memory * model.n_states + states, keys)


def lost_nodes(chain: Chain, problem: Problem, *, declared: bool = False) -> BoolArray:
    """Nodes of a policy's chain at which it has failed, as quantities count it, [nodes].

    Args:
        chain: the policy's.
        problem: with what is asked.
        declared: as of :func:`counted_nodes`.
    """
    counted = counted_nodes(chain, problem, declared=declared)
    return np.asarray(~counted & (chain.dead == 0))


def _asks_for_ends(problem: Problem) -> bool:
    """Whether some constraint or the objective asks for an end that is not the goal."""
    return any(condition.wants_ends for condition in asked_quantities(problem))


def asked_quantities(problem: Problem) -> tuple[Condition, ...]:
    """Quantities whose values a problem asks for: those that it limits, and one minimised."""
    objective = problem.objective_condition
    return problem.conditions + (() if objective is None else (objective,))


def cost_after_failing(chain: Chain, counted: BoolArray) -> list[float]:
    """Expected cost from failing until the run ends, [1]; [0] where runs are over with failing.

    Args:
        chain: the policy's.
        counted: nodes at which failure has not been declared, [nodes].
    """
    if (label := chain.model.failure_label) is None:
        return []
    failed = label.after[chain.state[chain.target]] | ~counted[chain.source]
    paid = label.original.costs[label.original_outcome[chain.outcome]]
    later = replace(chain, cost=np.where(failed, paid, 0.0))
    return [value_until_failure(later, chain.settling, FailureSemantics(GiveUp.DEAD_ENDS), 1.0)]


def quantity_values(chain: Chain, counted: BoolArray, problem: Problem) -> list[float]:
    """Value of each quantity that a problem asks for, [quantities]."""
    return [
        asked.constant
        + sum(w * _quantity_value(chain, counted, problem, term) for w, term in asked.terms)
        for asked in asked_quantities(problem)
    ]


def _quantity_value(chain: Chain, counted: BoolArray, problem: Problem, term: Term) -> float:
    """Value of one term of a quantity on a policy's chain: cost, visits, or way to end."""
    survival, semantics = survival_of(problem.discount), problem.semantics
    if term.through and chain.model.failure_label is not None:  # to the true end of the run
        semantics, counted = replace(semantics, give_up=GiveUp.DEAD_ENDS), chain.settling
    if isinstance(term, StepTerm):
        other = replace(chain, model=term.model, cost=term.model.costs[chain.outcome])
        return value_until_failure(other, counted, semantics, survival)
    there = term.states[chain.state].astype(np.float64)
    if not term.final:
        entering = replace(chain, cost=survival * there[chain.target])
        plain = FailureSemantics(semantics.give_up)
        at_once = chain.start @ (there * ((chain.goal > 0) | (chain.dead > 0)))
        free = term.free
        return value_until_failure(entering, counted, plain, survival, free) + float(at_once)
    ended = float(chain.start @ ending_values(chain, there[:, None], survival)[:, 0])
    return complement(ended) if term.others else ended


def ending_values(
    chain: Chain, at_end: FloatArray, survival: float = 1.0, at_stop: FloatArray | float = 0.0
) -> FloatArray:
    """Probability of ending in some nodes, discounted, from each node, [nodes, ways].

    Args:
        chain: the chain.
        at_end: which goals and dead-ends belong to each way, [nodes, ways].
        survival: the discount.
        at_stop: where giving up does, [nodes, ways].
    """
    settling = chain.settling & (chain.goal == 0) & (chain.dead == 0)
    hits = survival * chain.ahead(at_end) + chain.give_up[:, None] * at_stop
    return at_end + chain.accumulate(np.where(settling[:, None], hits, 0.0), settling, survival)


def value_until_failure(
    chain: Chain,
    hopeful: BoolArray,
    semantics: FailureSemantics,
    survival: float,
    free: BoolArray | None = None,
    start: FloatArray | None = None,
) -> float:
    """E[r_tau] from the start: stage costs while the goal is in reach, then what failing costs.

    Args:
        chain: the chain, with the costs that count.
        hopeful: nodes at which failure has not been declared, [nodes].
        semantics: what failing costs.
        survival: the discount.
        free: pairs that are free in these costs, [pairs]; None: those that cost nothing.
        start: mass that enters, [nodes]; None: the chain's own.
    """
    start = chain.start if start is None else start
    lost = lost_costs(chain, hopeful, semantics, survival, free)
    if semantics.forbids_failing:
        lost = np.where(hopeful & (chain.give_up == 0.0), lost, np.inf)
    charged = give_up_costs(chain, semantics, free)
    endless = np.isinf(lost) | np.isinf(charged)
    if endless.any() and (start[chain.reaching(endless)] > 0).any():
        return float("inf")
    lost, charged = np.where(endless, 0.0, [lost, chain.give_up * charged])
    alive = hopeful & (chain.goal == 0) & (chain.dead == 0)
    stage = chain.per_node(chain.cost) + charged + survival * chain.ahead(lost)
    return float(start @ (lost + chain.accumulate(np.where(alive, stage, 0.0), alive, survival)))


def complement(probability: float) -> float:
    """Value of a quantity's complement: 1 less a probability, within [0, 1]."""
    return min(max(1.0 - probability, 0.0), 1.0)
