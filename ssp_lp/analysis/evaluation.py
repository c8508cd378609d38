"""Exact evaluation of any policy under a problem's semantics, and the law of its total cost."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from math import fsum
from typing import NamedTuple, overload

import numpy as np

from ssp_lp.accumulated_cost.cost_law import CostLaw
from ssp_lp.accumulated_cost.policy_layers import (
    LARGE,
    LayerMoves,
    alive_layers,
    chains_of_law,
    giving_up_where_lost,
    landed_chains,
)
from ssp_lp.analysis.worst_case import WorstCase, worst_case
from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray, IntArray
from ssp_lp.compiled.deadline import limited
from ssp_lp.errors import ModelError, in_short
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.boxes import Boxes
from ssp_lp.model.graph import attention_states, dead_ends, end_marks, stop_marks
from ssp_lp.model.product import ProductSSP
from ssp_lp.model.report import ByName, Facts, Table
from ssp_lp.policies import StochasticPolicy
from ssp_lp.policies.chain import Chain, policy_chain, reached_table
from ssp_lp.policies.policy import GIVE_UP, GIVE_UP_CODE, UNDECIDED, MixedPolicy, Policy, as_lottery
from ssp_lp.policies.remembering import JointMemory, common_memory
from ssp_lp.problem import NEEDED, Problem, on_one_model
from ssp_lp.processes.conditions import OBJECTIVE, Condition, StepTerm, Term
from ssp_lp.processes.failure_semantics import (
    Aim,
    FailureSemantics,
    GiveUp,
    dead_end_charges,
    free_pairs,
    give_up_charges,
    survival_of,
)
from ssp_lp.processes.live_rows import cost_means, costless_pairs


@dataclass(frozen=True, repr=False)
class Evaluation(Facts):
    """Exact measures of a policy, for runs from the problem's start; costs in the model's unit."""

    goal_probability: float
    failure_probability: float  # 1 - goal_probability: wandering for ever is failure
    success_cost: float  # E[total cost; goal]
    conditional_cost: float  # E[total cost | goal]; nan if the goal is never reached
    expected_cost: float  # E[r_tau]: until failure is declared, charges included, undiscounted
    objective: float  # of the problem: discounted if it is, with penalty, or a measure of the law
    discounted_failure: float | None  # paper, eq. constrain_condition_approximate
    ends: Mapping[str, float]  # probability of each end: goal, labels, dead_end, gave_up, wandering
    secondary_costs: Mapping[str, float]  # each constrained quantity, by name; as ``objective``
    cost_after_failing: float | None = None  # until the true end; None: failing ends runs
    discounted_goal: float | None = None  # E[gamma^T; goal]; None: exact

    @property
    def limited_goal(self) -> float:
        """Goal probability; with a discount, the discounted one, E[gamma^T; goal]."""
        return self.goal_probability if self.discounted_goal is None else self.discounted_goal

    @property
    def limited_failure(self) -> float:
        """Failure probability that a budget limits; with a discount, the discounted one."""
        surrogate = self.discounted_failure
        return self.failure_probability if surrogate is None else surrogate

    def tables(self) -> list[Table]:
        """Return a table of the objective, the ends of episodes, and the costs."""
        return [
            Table([
                ("objective", self.objective),
                ("goal", self.goal_probability),
                ("failing", failing_in_words(self.ends)),
                ("cost given success", cost_in_words(self.conditional_cost)),
                ("cost until failure", self.expected_cost),
                ("cost after failing", self.cost_after_failing),
                *self.secondary_costs.items(),
            ])
        ]  # fmt: skip


@overload
def evaluate(
    policy: Policy | MixedPolicy, problem: Problem = ..., *, time_limit: float | None = ...
) -> Evaluation: ...


@overload
def evaluate(
    policy: Policy | MixedPolicy, problem: Problem, *, box: Boxes, time_limit: float | None = ...
) -> WorstCase: ...


@explained
def evaluate(
    policy: Policy | MixedPolicy,
    problem: Problem = NEEDED,
    *,
    box: Boxes | None = None,
    time_limit: float | None = None,
) -> Evaluation | WorstCase:
    """Evaluate a policy exactly.

    A run fails at the first time at which the policy can no longer reach the goal (tau in the
    paper, section 2.4). The problem's ``give_up`` and ``charge_failing_step`` say what the run pays
    then. The policy may be a solution's, your own :class:`DeterministicPolicy`, or a lottery. The
    conditional cost of a lottery is its expected cost of successful runs divided by its goal
    probability, not the mean of the members' conditional costs.

    Args:
        policy: the policy, on the problem's model.
        problem: problem with the start, the discount and the semantics.
        box: intervals of the probabilities. If given, the result is a ``WorstCase``: each measure
            at the probabilities in the intervals that are worst for it. It is exact for a policy
            without memory, and a bound for a lottery.
        time_limit: seconds; None: unlimited.

    Returns:
        Exact numbers, up to the rounding of linear solves. One exception: if the objective needs
        the distribution of the total cost, and there are too many distinct totals or the policy
        ``rounds_up``, costs are rounded up. The true objective is then at least as good.

    Raises:
        ModelError: the policy has no decision in a state that it reaches, or gives up where the
            problem forbids it; with ``box``, a cost given success, a horizon, a discount or
            constraints, which have no worst case there.
        OutOfTimeError: the time limit passed before the evaluation was finished.
    """
    with limited(time_limit, "the policy was evaluated"):
        if box is not None:
            return worst_case(policy, problem, box)
        return evaluate_each(policy, problem)[0]


def evaluate_each(
    policy: Policy | MixedPolicy, problem: Problem = NEEDED
) -> tuple[Evaluation, list[Evaluation]]:
    """Return the evaluation of a lottery, and the evaluation of each of its members.

    If the objective is a measure of the distribution of costs, such as a quantile, only the
    lottery's evaluation has this objective. The objectives of the members are then their costs.

    Raises:
        ModelError: as in :func:`evaluate`.
    """
    lottery, problem = on_one_model(policy, problem, "evaluate")
    start = problem.start_mass
    semantics = problem.semantics
    members, chains = [], []
    for member, weight in zip(lottery.policies, lottery.weights, strict=True):
        measures, chain = layered_measures(member, problem, start), None
        if measures is None:
            chain = policy_chain(problem.model, member, start)
            measures = evaluated_measures(chain, problem, declared=member.declares_failing)
        members.append(measures)
        if semantics.counts_law and weight > 0.0:  # the law needs it as well
            chains.append(chains_of_law(problem.model, member, start, chain, soon=True))
    evaluation = evaluation_of(_mean_of(members, lottery.weights), problem)
    each = [evaluation_of(member, problem) for member in members]
    if not semantics.counts_law:
        return evaluation, each
    law = _measured_law(chains, lottery.weights[lottery.weights > 0.0], semantics)
    return replace(evaluation, objective=semantics.value_of_law(law)), each


def success_figures(policy: Policy, problem: Problem) -> tuple[float, float, float]:
    """Return E[cost; goal], the failure and the goal probability of a policy, nothing else.

    All three are discounted if the problem has a discount.

    Args:
        policy: a policy on the problem's model.
        problem: the problem, in which failing ends a run.
    """
    start = problem.start_mass
    if (measures := layered_measures(policy, problem, start)) is None:
        chain = policy_chain(problem.model, policy, start)
        begun = np.tile(chain.start[:, None] * [1.0, 0.0, 0.0], len(_survivals(problem)))
        measures = _measures_of(_chain_totals(chain, None, problem, begun), _NO_ENDS)
    goal, failure, cost = measures.totals[-1, :3].tolist()
    return cost, failure, goal


@explained
def success_costs(policy: Policy | MixedPolicy, problem: Problem = NEEDED) -> CostLaw:
    """Return the law (distribution) of a policy's total cost on the runs that reach the goal.

    Costs and probabilities are undiscounted, whatever the problem's discount. The law of a lottery
    is the mixture of its members' laws, so its quantile is the quantile of the mixture, not a mean
    of the members' quantiles.

    Args:
        policy: any policy on the problem's model.
        problem: problem with the start.

    Raises:
        ModelError: the policy is for another model, or undecided in a state that it reaches.

    Example:
        >>> from ssp_lp import S3P, SSP, DeterministicPolicy
        >>> model = SSP.from_transitions(
        ...     {"door": {"try": [(0.5, "out", 0.1), (0.5, "door", 0.1)]}}, goal={"out"})
        >>> problem = S3P(model, start="door")
        >>> law = success_costs(DeterministicPolicy.from_actions(model, {"door": "try"}), problem)
        >>> law.within(0.3), law.quantile(0.95)
        (0.875, 0.5)
    """
    lottery, problem = on_one_model(policy, problem, "success_costs")
    return law_of_chains(*_law_chains(lottery, problem))


def measured_costs(policy: MixedPolicy, problem: Problem) -> CostLaw:
    """Return the law (distribution) of costs from which a problem's measure is computed.

    If a member of the lottery acts on costs rounded up, the law has these rounded costs. Exception:
    for a measure that is itself a total cost, such as a quantile, the law has the true costs if it
    can be computed quickly.
    """
    return _measured_law(*_law_chains(policy, problem, soon=True), problem.semantics)


def _law_chains(
    lottery: MixedPolicy, problem: Problem, *, soon: bool = False
) -> tuple[list[tuple[Chain, Chain]], FloatArray]:
    """Return two chains for each member of a lottery, and the weights of the members.

    Total costs of the first chain are the true ones, those of the second are rounded as the member
    rounds them. Members of weight 0 are left out.
    """
    model, start = problem.model, problem.start_mass
    used = lottery.weights > 0.0
    members = [one for one, is_used in zip(lottery.policies, used, strict=True) if is_used]
    return [chains_of_law(model, m, start, soon=soon) for m in members], lottery.weights[used]


def _measured_law(
    chains: Iterable[tuple[Chain, Chain]], weights: FloatArray, semantics: FailureSemantics
) -> CostLaw:
    """Return the law of :func:`measured_costs`, given chains of the members."""
    if semantics.risk is not None and semantics.risk.is_a_total:
        return law_of_chains(chains, weights)
    return law_of_chains(((counted, counted) for _, counted in chains), weights)


def law_of_chains(chains: Iterable[tuple[Chain, Chain]], weights: FloatArray) -> CostLaw:
    """Return the distribution of a lottery's total cost, given chains of its members.

    Args:
        chains: for each member a chain with true costs and one with costs as the member rounds
            them.
        weights: weights of the members, above 0, [members].
    """
    paid, counted = zip(*chains, strict=True)
    rounds = any(own is not other for own, other in zip(paid, counted, strict=True))
    return CostLaw(paid, weights, counted if rounds else ())


class _Measures(NamedTuple):
    """Measures of a policy; a lottery has the weighted means of its members' measures."""

    totals: FloatArray  # [discounts, 4] goal, failure, cost of success, cost until failure
    ends: FloatArray  # [ways] in the order of ``end_marks``, then wandering
    secondary: FloatArray  # [quantities] that the problem limits and minimises
    later: FloatArray  # [1] cost after failing; [0] if failing ends runs


def _mean_of(parts: list[_Measures], weights: FloatArray) -> _Measures:
    """Return the mean of members' measures over a lottery, without members of weight 0."""
    used = np.flatnonzero(weights > 0.0)
    columns = zip(*(parts[k] for k in used), strict=True)
    return _Measures(*(np.tensordot(weights[used], np.stack(c), axes=1) for c in columns))


def evaluation_of(sums: _Measures, problem: Problem) -> Evaluation:
    """Return the evaluation of a policy from its measures."""
    semantics, discounted = problem.semantics, problem.discount is not None
    goal, failure, success_cost, stopped = sums.totals[0].tolist()
    kept, surrogate, *costs = sums.totals[-1].tolist()
    objective = costs[0 if problem.ratio else 1]
    if semantics.aim is not Aim.LEAST_COST:
        objective = kept
    elif semantics.penalty > 0.0 and not semantics.forbids_failing:
        objective += semantics.penalty * surrogate
    if problem.ratio:
        objective = objective / kept if kept > 0 else float("nan")
    asked = _asked_quantities(problem) if sums.secondary.size else ()
    secondary = {one.name: value for one, value in zip(asked, sums.secondary.tolist(), strict=True)}
    if OBJECTIVE in secondary:  # a quantity replaces the cost
        objective = secondary.pop(OBJECTIVE)
    ways = ["goal", *problem.model.state_labels, "dead_end", "gave_up", "wandering"]
    return Evaluation(
        goal_probability=goal,
        failure_probability=failure,
        success_cost=success_cost,
        conditional_cost=success_cost / goal if goal > 0 else float("nan"),
        expected_cost=stopped,
        objective=objective,
        discounted_failure=surrogate if discounted else None,
        discounted_goal=kept if discounted else None,
        ends=ByName(zip(ways, sums.ends.tolist(), strict=True)),
        secondary_costs=ByName(secondary),
        cost_after_failing=next(iter(sums.later.tolist()), None),
    )


def evaluated_measures(chain: Chain, problem: Problem, *, declared: bool = False) -> _Measures:
    """Compute the measures of a policy from its chain.

    Args:
        chain: chain of the policy.
        problem: problem with the semantics and the limits.
        declared: whether the policy itself decides when it has failed (see ``counted_nodes``).
    """
    mass = np.zeros((chain.n_nodes, 3 * len(_survivals(problem))))
    mass[:, ::3] = chain.start[:, None]
    counted = counted_nodes(chain, problem, declared=declared)
    totals = _chain_totals(chain, counted, problem, mass)
    measures = _measures_of(totals, _evaluated_ends(chain, chain.start))
    values = [
        asked.constant
        + sum(w * _quantity_value(chain, counted, problem, term) for w, term in asked.terms)
        for asked in _asked_quantities(problem)
    ]
    later = _cost_after_failing(chain, counted)
    return measures._replace(secondary=np.array(values), later=np.array(later))


def _measures_of(totals: FloatArray, ends: FloatArray) -> _Measures:
    """Return the figures of a policy: totals clipped to possible values, probabilities of ends.

    Args:
        totals: goal, failure, cost of success and cost until failure, [discounts, 4].
        ends: probability of each end in the order of ``end_marks``, [ways]. The probability of
            running for ever ("wandering") is added here.
    """
    for row in totals:  # goal and failure within [0, 1]; either is 0 if the other is sure
        goal, failure = row[[_GOAL, _FAILED]]
        row[_GOAL] = 1.0 if failure == 0.0 else min(goal, 1.0)
        row[_FAILED] = 1.0 if goal <= 0.0 < failure else min(failure, 1.0)
    return _Measures(totals, np.append(ends, complement(float(ends.sum()))), *np.zeros((2, 0)))


def _survivals(problem: Problem) -> list[float]:
    """Return the discounts under which a policy is measured: 1, then the problem's, if any."""
    return [1.0] if problem.discount is None else [1.0, problem.discount]


_NO_ENDS = np.zeros(0)
_GOAL, _FAILED, _STOPPED = 0, 1, 3
"""Columns of the totals of an evaluation."""


def _chain_totals(
    chain: Chain, counted: BoolArray | None, problem: Problem, mass: FloatArray
) -> FloatArray:
    """Return goal, failure, cost of success and cost until failure, [discounts, 4].

    Args:
        chain: the chain.
        counted: nodes at which a run has not failed, [nodes]; None: the cost until failure is not
            needed, and nan.
        problem: problem with the semantics.
        mass: for each discount three columns: the mass that enters, this mass times the cost paid
            before, and the mass that enters after failing, [nodes, 3 * discounts].

    Raises:
        ModelError: the policy gives up where the problem forbids it.
    """
    semantics, totals, stopped = problem.semantics, [], np.nan
    _check_giving_up(chain, problem)
    alive = chain.alive
    ended = np.where(alive | (chain.goal > 0), 0.0, 1.0)
    for k, survival in enumerate(_survivals(problem)):
        entering, paid, lost = mass[:, 3 * k : 3 * k + 3].T
        reached, cost = chain.arriving(survival)
        leaks = (1.0 - survival) + survival * (chain.ahead(ended) + chain.give_up)
        failed = chain.accumulate(np.where(alive, leaks, 0.0), alive, survival) + ended
        begins = entering + lost if semantics.give_up is GiveUp.DEAD_ENDS else entering
        if counted is not None:
            stopped = _value_until_failure(chain, counted, semantics, survival, start=begins)
        success = entering @ cost + paid @ reached / survival
        totals.append([entering @ reached, entering @ failed, success, stopped])
    return np.array(totals)


def _evaluated_ends(chain: Chain, start: FloatArray) -> FloatArray:
    """Return the probability of each end of an episode, in the order of ``end_marks``, [ways]."""
    ways = np.arange(len(chain.model.state_labels) + 3)
    final = ((chain.goal > 0) | (chain.dead > 0))[:, None]
    ends, stops = (
        marks(chain.model)[chain.state][:, None] == ways for marks in (end_marks, stop_marks)
    )
    values = _ending_values(chain, np.where(final & ends, 1.0, 0.0), at_stop=stops)
    return np.asarray(start @ values)


_ROUNDING = 64 * MACHINE_EPSILON
"""Probability of wandering, 1 minus that of all other ends, that counts as rounding."""

_MOST_NODES = 100_000  # of a chain in which the first place of giving up is sought
_WORDS = {"dead_end": "dead-end", "gave_up": "gave up", "wandering": "wandering"}


def cost_in_words(cost: float) -> str:
    """Return a cost as text; nan stands for the cost given success of a policy without success."""
    return "none: the goal is never reached" if cost != cost else f"{cost:.6g}"


def failing_in_words(ends: Mapping[str, float]) -> str:
    """Return a line with the probability of each way to fail: "crash 0.03, gave up 0.02"."""
    least = {"goal": np.inf, "wandering": _ROUNDING}
    ways = ((name, share) for name, share in ends.items() if share > least.get(name, 0.0))
    return ", ".join(f"{_WORDS.get(name, name)} {share:.6g}" for name, share in ways)


def giving_up_in_words(policy: MixedPolicy, problem: Problem, share: float) -> str:
    """Return where a policy gives up, as a phrase: before the first step, or in which state first.

    Args:
        policy: policy on the problem's model.
        problem: problem with the start.
        share: probability of giving up.
    """
    at_start, start = 0.0, problem.start_mass
    states = np.flatnonzero((start > 0.0) & (np.diff(problem.model.pair_offsets) > 0))
    for weight, member in policy.weighted:
        memory = member.start_memory(states)
        branches = member.branches(states, memory)
        begins = start[states[branches.situation]] * branches.probability
        at_start += weight * float(begins[branches.gives_up(memory)].sum())
    if at_start > share - _ROUNDING:
        return "before the first step"
    if at_start > 0.0:
        return f"{at_start:.6g} of it before the first step"
    try:
        rows = reached_table(policy, start, _MOST_NODES)
    except ModelError:  # too many nodes
        return ""
    first = next((row.state for row in rows if row.action is GIVE_UP), None)
    return "" if first is None else f"first in {in_short(first)}"


def pair_visits(policy: Policy | MixedPolicy, problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return a policy's expected visits of each pair, and its probability of giving up by state.

    Returns:
        Two arrays on the problem's model, [pairs] and [states], summed over the policy's memory
        and, within a horizon, over time.

    Raises:
        ModelError: the policy is for another model, or may wander for ever.
    """
    lottery, solved = on_one_model(policy, problem, "pair_visits")
    model, start = solved.model, solved.start_mass
    pairs, gave_up = np.zeros(model.n_pairs), np.zeros(model.n_states)
    for member, weight in zip(lottery.policies, lottery.weights, strict=True):
        chain = policy_chain(model, member, start)
        flow, acts = weight * chain.flows(), chain.branch_pair >= 0
        np.add.at(pairs, chain.branch_pair[acts], flow[acts])
        np.add.at(gave_up, chain.state[chain.branch_node[~acts]], flow[~acts])
    while model is not problem.model and isinstance(model, ProductSSP):
        there = np.zeros(model.original.n_pairs), np.zeros(model.original.n_states)
        np.add.at(there[0], model.original_pair, pairs)
        np.add.at(there[1], model.original_state, gave_up)
        model, (pairs, gave_up) = model.original, there
    return pairs, gave_up


def equivalent_randomised_policy(policy: MixedPolicy, problem: Problem) -> StochasticPolicy:
    """Return the stationary randomised policy with the expected visits of a lottery.

    In each augmented state the policy draws an action with the action's share of the lottery's
    expected visits (paper, section 2.2). The augmented state consists of the state and the memories
    of all members: accumulated cost, time, or both. If time is remembered (section 3.4), the policy
    has the lottery's distribution over augmented states at each time, not only in total.

    With a discount, the discounted visits, cost and failure are those of the lottery; the
    undiscounted cost and failure may differ.

    Raises:
        ModelError: a member may wander for ever, or is of a class with unknown memory.
    """
    policy, problem = on_one_model(policy, problem, "equivalent_randomised_policy")
    model, start = problem.model, problem.start_mass
    survival = survival_of(problem.discount)
    keepers = common_memory(policy)
    keys, pairs, flows = [], [], []
    for member, weight in zip(policy.policies, policy.weights, strict=True):
        lifted = JointMemory(keepers, member) if keepers else member
        chain = policy_chain(model, lifted, start)
        keys.append((chain.memory * model.n_states + chain.state)[chain.branch_node])
        pairs.append(chain.branch_pair)
        flows.append(weight * chain.flows(survival))
    every = np.concatenate(keys), np.concatenate(pairs), np.concatenate(flows)
    carrier = JointMemory(keepers, keepers[0]) if len(keepers) > 1 else next(iter(keepers), None)
    return StochasticPolicy.from_flows(model, *every, carrier)


def layered_measures(
    policy: Policy, problem: Problem, start: FloatArray, least_nodes: int = LARGE
) -> _Measures | None:
    """Return the measures of a layered policy without its chain; None if the chain is needed.

    A layered policy remembers the accumulated cost. The chain is needed if the policy remembers
    more, or if the problem counts quantities other than the cost; it is preferred if it is small.
    It is also needed if a decision is missing or not allowed, for an error that names the decision.

    Args:
        policy: policy on the problem's model.
        problem: problem with the semantics and the discount.
        start: distribution over states, [states].
        least_nodes: states times layers up to which the chain is preferred.
    """
    model, layers = problem.model, policy.layers()
    if layers is None or problem.conditions or problem.objective_condition is not None:
        return None
    moves, survivals = LayerMoves(model, layers), _survivals(problem)
    if not moves.is_soon_followed(least_nodes):
        return None
    hopeful, (stage, charge, stopping) = alive_layers(moves)[0], _layer_costs(problem)
    waiting = np.zeros((moves.room, model.n_states, 3 * len(survivals)))
    waiting[0, :, ::3] = start[:, None]
    stopped = np.zeros((2, model.n_states))  # mass that ends in each state, and that gives up there
    goes_on = problem.semantics.give_up is GiveUp.DEAD_ENDS  # costs are paid after the goal is lost
    charged = stage, stopping, np.isinf(charge), goes_on
    together = moves.follow_evenly(waiting, stopped, survivals, hopeful, charged)
    if together is None:
        return None
    ends, parts = np.zeros(len(model.state_labels) + 3), list(together)
    for layer, here, pairs, visits in moves.follow(waiting, survivals, hopeful, len(parts)):
        hopes, quits = hopeful[layer, here], pairs == GIVE_UP_CODE
        if (quits & np.isinf(charge[here])).any() or (pairs == UNDECIDED).any():
            return None
        stopped[quits.astype(np.int64), here] += np.where(hopes, visits[:, 0], visits[:, 2])
        parts.append(_layer_totals(problem, stage, stopping, here, pairs, hopes, visits))
    try:
        for tail, mass in landed_chains(moves, waiting):
            counted, entering = tail.alive | (tail.goal > 0), mass.sum(axis=0)
            parts.append(_chain_totals(tail, counted, problem, entering))
            ends += _evaluated_ends(tail, entering[:, 0] + entering[:, 2])
    except ModelError:
        return None
    marks = np.stack([end_marks(model), stop_marks(model)])
    over = marks >= 0
    ends += np.bincount(marks[over], weights=stopped[over], minlength=ends.size)
    totals = np.apply_along_axis(fsum, 0, np.array(parts)).astype(np.float64)
    if problem.semantics.forbids_failing and totals[0, _FAILED] > 0.0:
        totals[:, _STOPPED] = np.inf
    return _measures_of(totals, ends)


def _layer_costs(problem: Problem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the costs of pairs and states for the evaluation of a layered policy.

    Returns:
        The mean cost of a step, [pairs]; the charge of giving up, infinite if it is not allowed,
        and the cost of failing, [states] each.
    """
    model, semantics = problem.model, problem.semantics
    charge = state_give_up_charges(model, semantics)
    stopping = np.where(np.isinf(charge), 0.0, charge)
    stopping = np.where(dead_ends(model), entering_charges(model, semantics), stopping)
    return cost_means(model), charge, stopping


def _layer_totals(
    problem: Problem,
    stage: FloatArray,
    stopping: FloatArray,
    here: IntArray,
    pairs: IntArray,
    hopes: BoolArray,
    visits: FloatArray,
) -> FloatArray:
    """Return goal, failure, cost of success and cost until failure of a layer, [discounts, 4].

    Args:
        problem: problem with the semantics and the discount.
        stage: mean cost of a step, [pairs].
        stopping: cost of failing, [states].
        here: the states with mass in the layer, [k].
        pairs: pairs taken in these states, [k].
        hopes: whether the goal can be reached from these states, [k].
        visits: expected visits, with the columns of ``LayerMoves.follow``, [k, 3 * discounts].
    """
    at_goal, moving, rows = problem.model.goal_mask[here], pairs >= 0, list[list[float]]()
    cost = np.where(moving, stage[np.maximum(pairs, 0)], stopping[here])
    cost[at_goal] = 0.0
    costly = ~hopes & (cost > 0.0)
    goes_on = problem.semantics.give_up is GiveUp.DEAD_ENDS
    for k, survival in enumerate(_survivals(problem)):
        mass, paid, lost = visits[:, 3 * k : 3 * k + 3].T
        failed = mass[~hopes].sum() + (1.0 - survival) * mass[hopes & moving].sum()
        after = lost[costly] @ cost[costly] if goes_on else mass @ (~hopes * stopping[here])
        stopped = mass @ (hopes * cost) + after
        rows.append([mass[at_goal].sum(), failed, paid[at_goal].sum() / survival, stopped])
    return np.array(rows)


def _give_up_costs(
    chain: Chain, semantics: FailureSemantics, free: BoolArray | None = None
) -> FloatArray:
    """Return the cost of giving up at each node of a chain, [nodes].

    It is 0 at nodes where the policy does not give up, and infinite where giving up is forbidden.

    Args:
        chain: chain of the policy.
        semantics: where giving up is allowed and whether it is charged.
        free: pairs by which a policy may stay, [pairs]; None: pairs of cost 0.
    """
    if not chain.give_up.any():
        return np.zeros(len(chain.give_up))
    charge = state_give_up_charges(chain.model, semantics, free)[chain.state]
    return np.where(chain.give_up > 0, charge, 0.0)


def _check_giving_up(chain: Chain, problem: Problem) -> None:
    """Check that a policy gives up only where the problem allows it.

    Giving up is also allowed where the policy could instead stay for ever by pairs that add nothing
    to the objective and the limits.

    Raises:
        ModelError: the policy gives up where it is not allowed.
    """
    semantics, objective = problem.semantics, problem.objective_condition
    limited = (row for condition in problem.conditions for row in condition.rows)
    minimised = None if objective is None else objective.minimised()
    free = free_pairs(problem.model, semantics.aim, limited, minimised)
    forbidden = np.isinf(_give_up_costs(chain, semantics, free))
    if forbidden.any():
        state = chain.model.states[int(chain.state[int(np.argmax(forbidden))])]
        raise ModelError(
            f"the policy gives up in state {state!r}: give_up={str(semantics.give_up)!r} forbids it"
        )


def _lost_costs(
    chain: Chain,
    hopeful: BoolArray,
    semantics: FailureSemantics,
    survival: float,
    free: BoolArray | None = None,
) -> FloatArray:
    """Return the expected cost to come at each node from which the goal is out of reach, [nodes].

    It is the charge of failing. With ``DEAD_ENDS`` it is the stage costs until a dead-end is
    entered, infinite if a run may pay for ever. At nodes that can reach the goal it is 0.

    Args:
        chain: chain of the policy.
        hopeful: nodes from which the goal is reached with positive probability, [nodes].
        semantics: where giving up is allowed and whether failing is charged.
        survival: discount of costs to come; 1: no discount.
        free: pairs by which a policy may stay, [pairs]; None: pairs of cost 0.
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
    # lost nodes after which nothing is paid, and those that may lead to paying for ever
    leaving = (chain.dead > 0) | (chain.give_up > 0) | ~lost
    free = ~chain.reaching(leaving | (chain.per_node(chain.cost) > 0.0))
    infinite = lost & chain.reaching(~chain.reaching(leaving | free))
    values = values + chain.accumulate(np.where(lost, stage, 0.0), lost & ~free & ~infinite)
    return np.where(infinite, np.inf, values)


def state_give_up_charges(
    model: SSP, semantics: FailureSemantics, free: BoolArray | None = None
) -> FloatArray:
    """Return the charge of giving up in each state, infinite if forbidden, [states].

    It is 0 in end components of cost 0, where staying for ever is free.

    Args:
        model: the model.
        semantics: where giving up is allowed and whether it is charged.
        free: pairs by which a policy may stay, [pairs]; None: pairs of cost 0.
    """
    wandering = np.zeros(model.n_states, dtype=np.bool_)
    if semantics.give_up is GiveUp.DEAD_ENDS:  # otherwise giving up costs as little as staying
        free = costless_pairs(model) if free is None else free
        wandering = model.staying_free(free)
    return model.of_all_states(give_up_charges(model, wandering, semantics))


def entering_charges(model: SSP, semantics: FailureSemantics) -> FloatArray:
    """Return the charge of entering each dead-end, 0 elsewhere, [states]."""
    return model.of_all_states(dead_end_charges(model, dead_ends(model), semantics))


def counted_nodes(chain: Chain, problem: Problem, *, declared: bool = False) -> BoolArray:
    """Return a mask of a chain's nodes at which a run has not failed, [nodes].

    - In general these are the nodes from which the goal can be reached.
    - If a constraint or the objective counts ends other than the goal, a run has not failed until
      it ends or gives up.
    - If the model's states have a failure label, a policy may itself decide when it has failed. If
      it does not, it has failed as soon as it can no longer reach the goal.

    Args:
        chain: chain of the policy.
        problem: problem with the constraints.
        declared: whether the policy itself decides when it has failed.
    """
    if problem.model.failure_label is not None:
        quits = chain.give_up > 0
        if not declared:
            quits &= ~attention_states(problem.model)[chain.state]
        over = (chain.goal > 0) | quits
        return chain.reaching(over | (chain.dead > 0) if declared else over)
    if problem.semantics.forbids_failing or not _wants_ends(problem):
        return np.asarray(chain.alive | (chain.goal > 0))
    return chain.settling


def lost_situations(policy: Policy, problem: Problem) -> Callable[[IntArray, IntArray], BoolArray]:
    """Return a function that says whether a policy has failed in a state, with a memory.

    Returns:
        A function of states and memories, [k] each, that returns a mask, [k]. A state and memory
        that no run of the policy reaches gets False.
    """
    model = problem.model
    if model.failure_label is None and policy.layers() is not None and not _wants_ends(problem):
        (stopping,) = giving_up_where_lost(as_lottery(policy)).policies
        return lambda states, memory: stopping.branches(states, memory).pair == GIVE_UP_CODE
    chain = policy_chain(model, policy, problem.start_mass)
    counted = counted_nodes(chain, problem, declared=policy.declares_failing)
    lost = ~counted & (chain.dead == 0)
    keys = (chain.memory * model.n_states + chain.state)[lost]
    return lambda states, memory: np.isin(memory * model.n_states + states, keys)


def _wants_ends(problem: Problem) -> bool:
    """Return whether a constraint or the objective counts ends other than the goal."""
    return any(condition.wants_ends for condition in _asked_quantities(problem))


def _asked_quantities(problem: Problem) -> tuple[Condition, ...]:
    """Return the quantities whose values a problem needs: its limits and its objective."""
    objective = problem.objective_condition
    return problem.conditions + (() if objective is None else (objective,))


def _cost_after_failing(chain: Chain, counted: BoolArray) -> list[float]:
    """Return the expected cost from failing to the true end, [1]; [0] if failing ends runs.

    Args:
        chain: chain of the policy.
        counted: nodes at which a run has not failed, [nodes].
    """
    if (label := chain.model.failure_label) is None:
        return []
    failed = label.after[chain.state[chain.target]] | ~counted[chain.source]
    paid = label.original.costs[label.original_outcome[chain.outcome]]
    later = replace(chain, cost=np.where(failed, paid, 0.0))
    return [_value_until_failure(later, chain.settling, FailureSemantics(GiveUp.DEAD_ENDS), 1.0)]


def _quantity_value(chain: Chain, counted: BoolArray, problem: Problem, term: Term) -> float:
    """Return the value of one term of a quantity for a policy: a cost, visits or a probability.

    Args:
        chain: chain of the policy.
        counted: nodes at which a run has not failed, [nodes].
        problem: problem with the semantics and the discount.
        term: the term.
    """
    survival, semantics = survival_of(problem.discount), problem.semantics
    if term.through and chain.model.failure_label is not None:  # to the true end of the run
        semantics, counted = replace(semantics, give_up=GiveUp.DEAD_ENDS), chain.settling
    if isinstance(term, StepTerm):
        other = replace(chain, model=term.model, cost=term.model.costs[chain.outcome])
        return _value_until_failure(other, counted, semantics, survival)
    there = term.states[chain.state].astype(np.float64)
    if not term.final:
        entering = replace(chain, cost=survival * there[chain.target])
        plain = FailureSemantics(semantics.give_up)
        at_once = chain.start @ (there * ((chain.goal > 0) | (chain.dead > 0)))
        free = term.free
        return _value_until_failure(entering, counted, plain, survival, free) + float(at_once)
    ended = float(chain.start @ _ending_values(chain, there[:, None], survival)[:, 0])
    return complement(ended) if term.others else ended


def _ending_values(
    chain: Chain, at_end: FloatArray, survival: float = 1.0, at_stop: FloatArray | float = 0.0
) -> FloatArray:
    """Return the discounted probability of each way to end, for a run from each node.

    Args:
        chain: the chain.
        at_end: 1 where a goal or dead-end is an end of this way, else 0, [nodes, ways].
        survival: discount.
        at_stop: 1 where giving up is an end of this way, else 0, [nodes, ways].

    Returns:
        The probabilities, [nodes, ways].
    """
    settling = chain.settling & (chain.goal == 0) & (chain.dead == 0)
    hits = survival * chain.ahead(at_end) + chain.give_up[:, None] * at_stop
    return at_end + chain.accumulate(np.where(settling[:, None], hits, 0.0), settling, survival)


def _value_until_failure(
    chain: Chain,
    hopeful: BoolArray,
    semantics: FailureSemantics,
    survival: float,
    free: BoolArray | None = None,
    start: FloatArray | None = None,
) -> float:
    """Return E[r_tau] from the start: stage costs until failing, and the charge of failing.

    Args:
        chain: chain with the costs that count.
        hopeful: nodes at which a run has not failed, [nodes].
        semantics: cost of failing.
        survival: the discount.
        free: pairs that are free in these costs, [pairs]; None: pairs of cost 0.
        start: mass that enters, [nodes]; None: the chain's own.
    """
    start = chain.start if start is None else start
    lost = _lost_costs(chain, hopeful, semantics, survival, free)
    if semantics.forbids_failing:
        lost = np.where(hopeful & (chain.give_up == 0.0), lost, np.inf)
    charged = _give_up_costs(chain, semantics, free)
    endless = np.isinf(lost) | np.isinf(charged)
    if endless.any() and (start[chain.reaching(endless)] > 0).any():
        return float("inf")
    lost, charged = np.where(endless, 0.0, [lost, chain.give_up * charged])
    alive = hopeful & (chain.goal == 0) & (chain.dead == 0)
    stage = chain.per_node(chain.cost) + charged + survival * chain.ahead(lost)
    return float(start @ (lost + chain.accumulate(np.where(alive, stage, 0.0), alive, survival)))


def complement(probability: float) -> float:
    """Return 1 minus a probability, clipped to [0, 1]."""
    return min(max(1.0 - probability, 0.0), 1.0)
