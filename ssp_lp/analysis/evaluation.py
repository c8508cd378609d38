"""Exact evaluation of any policy under a problem's semantics, by sparse linear solves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from math import fsum

import numpy as np

from ssp_lp.accumulated_cost.policy_layers import (
    LARGE,
    LayerMoves,
    chains_of_law,
    hopeful_layers,
    landed_chains,
)
from ssp_lp.analysis.quantity_values import (
    check_giving_up,
    complement,
    cost_after_failing,
    counted_nodes,
    ending_values,
    pairs_free_in_all_quantities,
    quantity_values,
    state_give_up_charges,
    value_until_failure,
)
from ssp_lp.analysis.success_costs import measured_law
from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray, IntArray
from ssp_lp.compiled.deadline import limited
from ssp_lp.errors import ModelError, in_short
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import dead_ends, end_marks, stop_marks
from ssp_lp.model.product import ProductSSP
from ssp_lp.model.report import ByName, Facts, Table
from ssp_lp.policies import StochasticPolicy
from ssp_lp.policies.chain import Chain, policy_chain, reached_table
from ssp_lp.policies.policy import GIVE_UP, GIVE_UP_CODE, UNDECIDED, MixedPolicy, Policy
from ssp_lp.policies.remembering import common_memory
from ssp_lp.problem import NEEDED, Problem, on_one_model
from ssp_lp.processes.conditions import OBJECTIVE
from ssp_lp.processes.failure_semantics import (
    Aim,
    GiveUp,
    dead_end_charges,
    start_distribution,
    survival_of,
)
from ssp_lp.processes.live_rows import cost_means


@dataclass(frozen=True, repr=False)
class Evaluation(Facts):
    """Measures of a policy from the start, exact. Costs are in the model's unit."""

    goal_probability: float
    failure_probability: float  # 1 - goal_probability: wandering for ever is failure
    success_cost: float  # E[total cost; goal]
    conditional_cost: float  # E[total cost | goal]; nan if the goal is never reached
    expected_cost: float  # E[r_tau]: until failure is declared, charges included, undiscounted
    objective: float  # what the problem optimises, discounted where it is; penalty or measure
    discounted_failure: float | None  # paper, eq. constrain_condition_approximate
    ends: Mapping[str, float]  # how episodes end: goal, each label, dead_end, gave_up, wandering
    secondary_costs: Mapping[str, float] = field(
        default_factory=dict
    )  # each constrained quantity, by name; as ``objective``
    cost_after_failing: float | None = None  # until the true end; None: runs are over by failing
    discounted_goal: float | None = None  # E[gamma^T; goal]; None: exact

    @property
    def limited_goal(self) -> float:
        """Goal probability of the evaluated policy, without what a budget limits."""
        return self.goal_probability if self.discounted_goal is None else self.discounted_goal

    @property
    def limited_failure(self) -> float:
        """Failure of the evaluated policy that a budget limits: discounted under a discount."""
        surrogate = self.discounted_failure
        return self.failure_probability if surrogate is None else surrogate

    def __post_init__(self) -> None:
        for name in ("ends", "secondary_costs"):
            object.__setattr__(self, name, ByName(getattr(self, name)))

    def tables(self) -> list[Table]:
        """The objective, how episodes end, and the costs."""
        return [
            Table([
                ("objective", self.objective),
                ("goal", self.goal_probability),
                ("failing", failing_in_words(self.ends)),
                ("cost given success", self.conditional_cost),
                ("cost until failure", self.expected_cost),
                ("cost after failing", self.cost_after_failing),
                *self.secondary_costs.items(),
            ])
        ]  # fmt: skip


@explained
def evaluate(
    policy: Policy | MixedPolicy, problem: Problem = NEEDED, *, time_limit: float | None = None
) -> Evaluation:
    """Evaluate a policy exactly, with the stopping time taken from its own chain.

    The paper's tau (section 2.4) is the first time at which the goal cannot be reached any more
    under the policy; the problem's ``give_up`` and ``charge_failing_step`` say what happens then.
    Any policy will do: a solution's, a :class:`DeterministicPolicy` of the user's own, or a
    lottery. The conditional cost of a lottery is the ratio of the weighted sums, never the mean
    of the members' conditional costs.

    Args:
        policy: the policy, on the problem's model.
        problem: says the start, the discount and the semantics.
        time_limit: seconds; None: any number.

    Returns:
        Exact numbers, up to the rounding of linear solves. Only where a criterion asks for the law
        of costs whose sums are too many to tell apart, or of a policy that ``rounds_up``, the
        objective is that of costs rounded up: the true one is as good or better.

    Raises:
        ModelError: the policy has no decision in a state that it reaches, or gives up where the
            problem forbids it.
        OutOfTimeError: the time limit passed before all was known.
    """
    with limited(time_limit, "the policy was evaluated"):
        return evaluate_each(policy, problem)[0]


def evaluate_each(
    policy: Policy | MixedPolicy, problem: Problem = NEEDED
) -> tuple[Evaluation, list[Evaluation]]:
    """The evaluation of a policy, and that of each member of the lottery by itself.

    The members' objectives are their costs where the problem has a measure of the law.

    Raises:
        ModelError: as of :func:`evaluate`.
    """
    lottery, problem = on_one_model(policy, problem, "evaluate")
    start = start_distribution(problem.model, problem.start)
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
    evaluation = evaluation_of(mean_of(members, lottery.weights), problem)
    each = [evaluation_of(member, problem) for member in members]
    if not semantics.counts_law:
        return evaluation, each
    law = measured_law(chains, lottery.weights[lottery.weights > 0.0], semantics)
    return replace(evaluation, objective=semantics.worth_of(law)), each


def evaluation_of(sums: _Measures, problem: Problem) -> Evaluation:
    """The evaluation of a policy from its measures."""
    discounted = problem.discount is not None
    failure, surrogate = sums.failure, sums.discounted_failure
    objective = sums.discounted_cost
    semantics = problem.semantics
    if semantics.aim is not Aim.LEAST_COST:
        objective = sums.discounted_goal
    elif semantics.penalty > 0.0 and not semantics.forbids_failing:
        objective += semantics.penalty * surrogate
    if problem.ratio:
        reached = sums.discounted_goal
        objective = objective / reached if reached > 0 else float("nan")
    secondary = dict(sums.secondary)
    if OBJECTIVE in secondary:  # a quantity is minimised in place of the cost
        objective = secondary.pop(OBJECTIVE)
    return Evaluation(
        goal_probability=sums.goal,
        failure_probability=failure,
        success_cost=sums.success_cost,
        conditional_cost=sums.success_cost / sums.goal if sums.goal > 0 else float("nan"),
        expected_cost=sums.expected_cost,
        objective=objective,
        discounted_failure=surrogate if discounted else None,
        discounted_goal=sums.discounted_goal if discounted else None,
        ends=sums.ends,
        secondary_costs=secondary,
        cost_after_failing=sums.after_failing,
    )


def evaluated_measures(chain: Chain, problem: Problem, *, declared: bool = False) -> _Measures:
    """Measures for a policy's evaluation, on its chain."""
    hopeful = chain.reaching(chain.goal > 0)
    counted = counted_nodes(chain, hopeful, problem, declared=declared)
    check_giving_up(chain, problem.semantics, pairs_free_in_all_quantities(problem))
    mass = np.zeros((chain.n_nodes, 3))
    mass[:, 0] = chain.start
    totals = [
        _chain_totals(chain, hopeful, counted, problem, survival, mass)
        for survival in _survivals(problem)
    ]
    secondary = quantity_values(chain, counted, problem)
    measures = _measures_of(problem, totals, _evaluated_ends(chain, chain.start), secondary)
    return replace(measures, after_failing=cost_after_failing(chain, counted))


def _survivals(problem: Problem) -> list[float]:
    """The discounts under which a policy is measured, the problem's last."""
    return [1.0] if problem.discount is None else [1.0, problem.discount]


GOAL, FAILED, SUCCESS_COST, STOPPED = range(4)


def _chain_totals(
    chain: Chain,
    hopeful: BoolArray,
    counted: BoolArray,
    problem: Problem,
    survival: float,
    mass: FloatArray,
) -> list[float]:
    """Goal, failure, cost of success and cost until failure under one discount, [4].

    Args:
        chain: the chain.
        hopeful: nodes from which the goal can be reached, [nodes].
        counted: nodes at which failure has not been declared, [nodes].
        problem: says the semantics.
        survival: the discount.
        mass: that enters, that times the cost paid before, and what has failed, [nodes, 3].
    """
    entering, paid, lost = mass.T
    alive = hopeful & (chain.goal == 0)
    early = chain.accumulate(chain.per_node(chain.goal[chain.target]), alive, survival)
    weight = np.where(chain.goal[chain.target] > 0, 1.0, survival * early[chain.target])
    cost = chain.accumulate(chain.per_node(weight * chain.cost), alive, survival)
    reached = survival * early + chain.goal
    ended = (~alive & (chain.goal == 0.0)).astype(np.float64)
    leaks = (1.0 - survival) + survival * (chain.ahead(ended) + chain.give_up)
    failed = chain.accumulate(np.where(alive, leaks, 0.0), alive, survival) + ended
    goes_on = problem.semantics.give_up is GiveUp.DEAD_ENDS
    begins = entering + lost if goes_on else entering
    stopped = value_until_failure(chain, counted, problem.semantics, survival, start=begins)
    success = float(entering @ cost + paid @ reached / survival)
    return [float(entering @ reached), float(entering @ failed), success, stopped]


def _evaluated_ends(chain: Chain, start: FloatArray) -> FloatArray:
    """Probability of each way in which episodes end, as of ``end_marks``, [ways]."""
    ways = np.arange(len(chain.model.state_labels) + 3)
    final = ((chain.goal > 0) | (chain.dead > 0))[:, None]
    ends, stops = (
        marks(chain.model)[chain.state][:, None] == ways for marks in (end_marks, stop_marks)
    )
    values = ending_values(chain, np.where(final & ends, 1.0, 0.0), at_stop=stops)
    return np.asarray(start @ values)


def _measures_of(
    problem: Problem,
    totals: Sequence[Sequence[float]],
    ends: FloatArray,
    secondary: Mapping[str, float],
) -> _Measures:
    """The measures of totals by discount, [discounts, 4], and of ways to end, [ways]."""
    first, last = totals[0], totals[-1]
    goal, failure = _both_measures(first[GOAL], first[FAILED])
    kept, surrogate = _both_measures(last[GOAL], last[FAILED])
    names = ["goal", *problem.model.state_labels, "dead_end", "gave_up"]
    shares = dict(zip(names, ends.tolist(), strict=True))
    return _Measures(
        goal=goal,
        failure=failure,
        success_cost=first[SUCCESS_COST],
        expected_cost=first[STOPPED],
        discounted_goal=kept,
        discounted_failure=surrogate,
        discounted_cost=last[SUCCESS_COST if problem.ratio else STOPPED],
        ends=shares | {"wandering": complement(sum(shares.values()))},
        secondary=secondary,
    )


_ROUNDING = 64 * MACHINE_EPSILON
"""As little wandering as this is rounding: it is what the other ends leave of 1."""

_FOLLOWED = 100_000  # nodes of a policy's chain among which the place of giving up is looked for

_WORDS = {"dead_end": "dead-end", "gave_up": "gave up", "wandering": "wandering"}


def ways_to_fail(ends: Mapping[str, float]) -> dict[str, float]:
    """Ways to fail in a policy's evaluation, with their probabilities."""
    return {
        name: share
        for name, share in ends.items()
        if name != "goal" and share > (_ROUNDING if name == "wandering" else 0.0)
    }


def failing_in_words(ends: Mapping[str, float]) -> str:
    """Evaluated ways to fail in a line: "crash 0.03, gave up 0.02"."""
    ways = ways_to_fail(ends).items()
    return ", ".join(f"{_WORDS.get(name, name)} {share:.6g}" for name, share in ways)


def giving_up_in_words(policy: MixedPolicy, problem: Problem, share: float) -> str:
    """Where the evaluated policy gives up first, and how often before the first step.

    Args:
        policy: of the problem.
        problem: says the start.
        share: probability of giving up.
    """
    at_start = giving_up_at_start(policy, problem)
    if at_start > share - _ROUNDING:
        return "before the first step"
    if at_start > 0.0:
        return f"{at_start:.6g} of it before the first step"
    try:
        start = start_distribution(problem.model, problem.start)
        rows = reached_table(policy, start, _FOLLOWED)
    except ModelError:  # too many nodes to look for the place
        return ""
    first = next((row.state for row in rows if row.action is GIVE_UP), None)
    return "" if first is None else f"first in {in_short(first)}"


def giving_up_at_start(policy: MixedPolicy, problem: Problem) -> float:
    """Evaluated probability that the policy gives up before its first step."""
    start = start_distribution(problem.model, problem.start)
    states = np.flatnonzero((start > 0.0) & (np.diff(problem.model.pair_offsets) > 0))
    total = 0.0
    for member, weight in zip(policy.policies, policy.weights, strict=True):
        branches = member.branches(states, member.start_memory(states))
        gives_up = branches.pair == GIVE_UP_CODE
        share = start[states[branches.situation]] * branches.probability
        total += float(weight) * float(share[gives_up].sum())
    return total


def expected_visits(chain: Chain, survival: float = 1.0) -> FloatArray:
    """Evaluated policy's expected visits of each node, those at t weighted survival^t, [nodes].

    Raises:
        ModelError: the policy may wander for ever, so that visits are infinite.
    """
    if survival == 1.0:
        ends = (chain.goal > 0) | (chain.dead > 0) | (chain.give_up > 0)
        if not chain.reaching(ends).all():
            raise ModelError("the policy may wander for ever: its expected visits are infinite")
    return chain.push(chain.start, survival)


def pair_visits(policy: Policy | MixedPolicy, problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Evaluated policy's expected visits of each pair, and probability of giving up per state.

    Returns:
        [pairs] and [states] of the problem's model, whatever the policy remembers and, within a
        horizon, at all times together.

    Raises:
        ModelError: the policy is for another model, or may wander for ever.
    """
    lottery, solved = on_one_model(policy, problem, "pair_visits")
    model, start = solved.model, start_distribution(solved.model, solved.start)
    pairs, gave_up = np.zeros(model.n_pairs), np.zeros(model.n_states)
    for member, weight in zip(lottery.policies, lottery.weights, strict=True):
        chain = policy_chain(model, member, start)
        visits = weight * expected_visits(chain)
        flow, acts = visits[chain.branch_node] * chain.branch_probability, chain.branch_pair >= 0
        np.add.at(pairs, chain.branch_pair[acts], flow[acts])
        np.add.at(gave_up, chain.state, visits * chain.give_up)
    while model is not problem.model and isinstance(model, ProductSSP):
        there = np.zeros(model.original.n_pairs), np.zeros(model.original.n_states)
        np.add.at(there[0], model.original_pair, pairs)
        np.add.at(there[1], model.original_state, gave_up)
        model, (pairs, gave_up) = model.original, there
    return pairs, gave_up


def equivalent_randomised_policy(policy: MixedPolicy, problem: Problem) -> StochasticPolicy:
    """Stationary randomised policy with the evaluated lottery's expected visits of pairs.

    Paper, section 2.2: in each augmented state the action is drawn with the share that it has in
    the lottery's expected visits. Under a discount visits are discounted, so that the discounted
    cost and failure are kept: a stationary policy cannot keep both those and the real ones.
    Members of the state alone are carried along the memory that others need, the accumulated cost
    or the time; members whose memories differ along both. Where time is remembered (section 3.4),
    every visit of a situation has one time, and the distribution over situations is the lottery's
    at each time, not only in total.

    Raises:
        ModelError: a member may wander for ever, or is of a class whose memory is not known.
    """
    policy, problem = on_one_model(policy, problem, "equivalent_randomised_policy")
    model, start = problem.model, start_distribution(problem.model, problem.start)
    survival = survival_of(problem.discount)
    memory = common_memory(policy)
    keys, pairs, flows = [], [], []
    for member, weight in zip(policy.policies, policy.weights, strict=True):
        lifted = member if memory is None else memory.followed_by(member)
        chain = policy_chain(model, lifted, start)
        visits = expected_visits(chain, survival)
        flow = weight * visits[chain.branch_node] * chain.branch_probability
        keys.append((chain.memory * model.n_states + chain.state)[chain.branch_node])
        pairs.append(chain.branch_pair)
        flows.append(flow)
    return StochasticPolicy.from_flows(
        model, np.concatenate(keys), np.concatenate(pairs), np.concatenate(flows), memory
    )


@dataclass(frozen=True)
class _Measures:
    """Quantities of a policy that are linear in the start lottery."""

    goal: float
    failure: float  # 1 - goal, summed from its own exits
    success_cost: float
    expected_cost: float
    discounted_goal: float  # E[gamma^T; goal]
    discounted_failure: float  # 1 - that, likewise
    discounted_cost: float  # case M: discounted E[r_tau]; case S: E[gamma^(T - 1) r_T; goal]
    ends: Mapping[str, float]
    secondary: Mapping[str, float]  # discounted like the cost
    after_failing: float | None = None  # None: runs are over by failing


def mean_of(parts: list[_Measures], weights: FloatArray) -> _Measures:
    """Mean of an evaluation's measures over a lottery; an infinite cost of weight 0 is left out."""
    used = [(p, float(w)) for p, w in zip(parts, weights, strict=True) if w > 0]
    scalars = {
        f.name: sum(w * getattr(p, f.name) for p, w in used)
        for f in fields(_Measures)
        if f.name not in ("ends", "secondary") and getattr(used[0][0], f.name) is not None
    }
    names = list(dict.fromkeys(name for p, _ in used for name in p.ends))
    return _Measures(
        **scalars,
        ends={n: sum(w * p.ends.get(n, 0.0) for p, w in used) for n in names},
        secondary={n: sum(w * p.secondary[n] for p, w in used) for n in used[0][0].secondary},
    )


def layered_measures(
    policy: Policy, problem: Problem, start: FloatArray, least_nodes: int = LARGE
) -> _Measures | None:
    """Measures for the evaluation of a layered policy; None: its chain is to be written out.

    That is where it is small, where the policy remembers something else than its cost, where
    quantities beside the cost are asked for, or where a decision is missing or not allowed,
    which the written-out chain names.

    Args:
        policy: on the problem's model.
        problem: says the semantics and the discount.
        start: distribution over states, [states].
        least_nodes: states times layers from which a policy is not written out.
    """
    model, layers = problem.model, policy.layers()
    if layers is None or layers.count * model.n_states < least_nodes:
        return None
    if problem.conditions or problem.objective_condition is not None:
        return None
    moves, survivals = LayerMoves(model, layers), _survivals(problem)
    hopeful, costs = hopeful_layers(moves)[0], _LayerCosts.of(problem)
    waiting = np.zeros((moves.room, model.n_states, 3 * len(survivals)))
    waiting[0, :, ::3] = start[:, None]
    stopped = np.zeros((2, model.n_states))  # what ends in each state, and what gives up there
    ends, parts = np.zeros(len(model.state_labels) + 3), list[list[list[float]]]()
    for layer, here, pairs, visits in moves.follow(waiting, survivals, hopeful):
        hopes, quits = hopeful[layer, here], pairs == GIVE_UP_CODE
        if (quits & np.isinf(costs.charge[here])).any() or (pairs == UNDECIDED).any():
            return None
        stopped[quits.astype(np.int64), here] += np.where(hopes, visits[:, 0], visits[:, 2])
        each = zip(np.split(visits, len(survivals), axis=1), survivals, strict=True)
        parts.append(
            [costs.totals(here, pairs, hopes, block, survival) for block, survival in each]
        )
    try:
        for tail, mass in landed_chains(moves, waiting):
            parts.append(_landed_totals(tail, mass, problem))
            ends += _evaluated_ends(tail, mass[:, 0] + mass[:, 2])
    except ModelError:
        return None
    marks = np.stack([end_marks(model), stop_marks(model)])
    over = marks >= 0
    ends += np.bincount(marks[over], weights=stopped[over], minlength=ends.size)
    totals = np.apply_along_axis(fsum, 0, np.array(parts))
    if problem.semantics.forbids_failing and totals[0, FAILED] > 0.0:
        totals[:, STOPPED] = np.inf
    return _measures_of(problem, totals.tolist(), ends, {})


def _landed_totals(chain: Chain, mass: FloatArray, problem: Problem) -> list[list[float]]:
    """The totals of mass that goes on by a tail's chain, [discounts, 4].

    Raises:
        ModelError: the tail gives up where it may not.
    """
    hopeful, survivals = chain.reaching(chain.goal > 0), _survivals(problem)
    check_giving_up(chain, problem.semantics, pairs_free_in_all_quantities(problem))
    return [
        _chain_totals(chain, hopeful, hopeful, problem, survival, block)
        for block, survival in zip(np.split(mass, len(survivals), axis=1), survivals, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class _LayerCosts:
    """What a layer of a policy that remembers its cost adds to its totals."""

    model: SSP
    stage: FloatArray  # [pairs]
    charge: FloatArray  # [states] of giving up, infinite where that is not allowed
    stopping: FloatArray  # [states] what failing there costs
    goes_on: bool  # costs go on where the goal is lost, until a dead-end is entered

    @classmethod
    def of(cls, problem: Problem) -> _LayerCosts:
        """What a problem without limits says."""
        model, semantics, dead = problem.model, problem.semantics, dead_ends(problem.model)
        charge = state_give_up_charges(model, semantics)
        entering = dead_end_charges(model, dead, semantics)
        stopping = np.where(dead, entering, np.where(np.isinf(charge), 0.0, charge))
        goes_on = semantics.give_up is GiveUp.DEAD_ENDS
        return cls(model, cost_means(model), charge, stopping, goes_on)

    def totals(
        self, here: IntArray, pairs: IntArray, hopes: BoolArray, visits: FloatArray, survival: float
    ) -> list[float]:
        """Goal, failure, cost of success and cost until failure under one discount, [4].

        Args:
            here: states, [k].
            pairs: [k].
            hopes: where the goal is in reach, [k].
            visits: of one discount, as of ``LayerMoves.follow``, [k, 3].
            survival: the discount.
        """
        mass, paid, lost = visits.T
        at_goal, moving = self.model.goal_mask[here], pairs >= 0
        cost = np.where(moving, self.stage[np.maximum(pairs, 0)], self.stopping[here])
        cost[at_goal] = 0.0
        failed = mass[~hopes].sum() + (1.0 - survival) * mass[hopes & moving].sum()
        costly = ~hopes & (cost > 0.0)
        after = (
            lost[costly] @ cost[costly] if self.goes_on else mass @ (~hopes * self.stopping[here])
        )
        stopped = mass @ (hopes * cost) + after
        return [mass[at_goal].sum(), failed, paid[at_goal].sum() / survival, stopped]


def _both_measures(goal: float, failure: float) -> tuple[float, float]:
    """Evaluated goal and failure within [0, 1]; 0 of either where the other is sure."""
    if failure == 0.0:
        return 1.0, 0.0
    return min(goal, 1.0), 1.0 if goal <= 0.0 else min(failure, 1.0)
