"""Exact evaluation of any policy under a problem's semantics, by sparse linear solves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np

from ssp_lp.accumulated_cost.policy_layers import (
    ENDLESS,
    FAILS,
    LARGE,
    WRONG,
    LayerMoves,
    LayerSweep,
    TotalledReward,
    chains_of_law,
)
from ssp_lp.analysis.cost_law import measured_law
from ssp_lp.analysis.quantity_values import (
    check_giving_up,
    complement,
    cost_after_failing,
    counted_nodes,
    free_in_everything,
    quantity_values,
    state_give_up_charges,
    value_until_failure,
)
from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray
from ssp_lp.compiled.deadline import limited
from ssp_lp.errors import ModelError
from ssp_lp.model.graph import dead_ends, end_marks, stop_marks
from ssp_lp.model.naming import ByName
from ssp_lp.model.product import ProductSSP
from ssp_lp.policies import StochasticPolicy
from ssp_lp.policies.chain import Chain, policy_chain, reaching_in_chain
from ssp_lp.policies.policy import GIVE_UP_CODE, MixedPolicy, Policy
from ssp_lp.policies.remembering import common_memory
from ssp_lp.problem import NEEDED, Problem, conditions_of, objective_of, on_one_model
from ssp_lp.processes.conditions import OBJECTIVE
from ssp_lp.processes.failure_semantics import (
    Aim,
    GiveUp,
    dead_end_charges,
    start_distribution,
    survival_of,
)
from ssp_lp.processes.rows import cost_means


@dataclass(frozen=True, repr=False)
class Evaluation:
    """What a policy attains from the start. Costs are in the model's unit."""

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

    @property
    def limited_failure(self) -> float:
        """The failure that a budget limits: discounted under a discount, else the real one."""
        surrogate = self.discounted_failure
        return self.failure_probability if surrogate is None else surrogate

    def __post_init__(self) -> None:
        for name in ("ends", "secondary_costs"):
            object.__setattr__(self, name, ByName(getattr(self, name)))

    def __repr__(self) -> str:
        """One line: the objective, how episodes end, and the costs."""
        failing = failing_in_words(self.ends)
        costs = {
            "cost given success": self.conditional_cost,
            "cost until failure": self.expected_cost,
            **({} if (later := self.cost_after_failing) is None else {"cost after failing": later}),
            **self.secondary_costs,
        }
        parts = [
            f"objective {self.objective:.6g}",
            f"goal {self.goal_probability:.6g}",
            *([failing] if failing else []),
            *(f"{name} {cost:.6g}" for name, cost in costs.items()),
        ]
        return f"Evaluation({', '.join(parts)})"


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
    measure = problem.semantics.measure
    members, chains = [], []
    for member, weight in zip(lottery.policies, lottery.weights, strict=True):
        found, chain = layered_measures(member, problem, start), None
        if found is None:
            chain = policy_chain(problem.model, member, start)
            found = _evaluated_measures(chain, problem, declared=member.declares_failing)
        members.append(found)
        if measure is not None and weight > 0.0:  # the law needs it as well
            chains.append(chains_of_law(problem.model, member, start, chain, soon=True))
    evaluation = _evaluation_of(mean_of(members, lottery.weights), problem)
    each = [_evaluation_of(member, problem) for member in members]
    if measure is None:
        return evaluation, each
    law = measured_law(chains, lottery.weights[lottery.weights > 0.0], measure)
    return replace(evaluation, objective=measure.of(law)), each


def _evaluation_of(sums: Measures, problem: Problem) -> Evaluation:
    """The evaluation that measures of a policy make."""
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
        ends=sums.ends,
        secondary_costs=secondary,
        cost_after_failing=sums.after_failing,
    )


def _evaluated_measures(chain: Chain, problem: Problem, *, declared: bool = False) -> Measures:
    """The measures that an evaluation needs, on a policy's chain."""
    gamma = survival_of(problem.discount)
    hopeful = reaching_in_chain(chain, chain.goal > 0)
    alive = hopeful & (chain.goal == 0)
    counted = counted_nodes(chain, hopeful, problem, declared=declared)
    goal, success = _evaluated_success(chain, alive, 1.0)
    early, early_cost = (goal, success) if gamma == 1.0 else _evaluated_success(chain, alive, gamma)
    reached, failed = _evaluated_two_ways(chain, goal, alive, 1.0)
    kept, surrogate = (
        _evaluated_two_ways(chain, early, alive, gamma) if gamma < 1.0 else (reached, failed)
    )
    check_giving_up(chain, problem.semantics, free_in_everything(problem))
    stopped = value_until_failure(chain, counted, problem.semantics, 1.0)
    if problem.ratio:
        target = float(chain.start @ early_cost)
    else:
        target = stopped if gamma == 1.0 else value_until_failure(
            chain, counted, problem.semantics, gamma
        )  # fmt: skip
    return Measures(
        goal=reached,
        failure=failed,
        success_cost=float(chain.start @ success),
        expected_cost=stopped,
        discounted_goal=kept,
        discounted_failure=surrogate,
        discounted_cost=target,
        ends=_evaluated_ends(chain),
        secondary=quantity_values(chain, counted, problem),
        after_failing=cost_after_failing(chain, counted),
    )


def _evaluated_success(
    chain: Chain, alive: BoolArray, survival: float
) -> tuple[FloatArray, FloatArray]:
    """E[survival^(T-1); goal] and E[survival^(T-1) * cost; goal] at nodes before the goal."""
    hit = chain.per_node(chain.goal[chain.target])
    early = chain.accumulate(hit, alive, survival)
    weight = np.where(chain.goal[chain.target] > 0, 1.0, survival * early[chain.target])
    priced = chain.per_node(weight * chain.cost)
    return early, chain.accumulate(priced, alive, survival)


def _evaluated_two_ways(
    chain: Chain, early: FloatArray, alive: BoolArray, survival: float
) -> tuple[float, float]:
    """Probabilities of reaching the goal and of failing, each from its own exits, discounted.

    Args:
        chain: the chain.
        early: E[survival^(T-1); goal], [nodes].
        alive: nodes from which the goal can be reached, [nodes].
        survival: the discount.
    """
    goal = min(float(chain.start @ (survival * early + chain.goal)), 1.0)
    ended = (~alive & (chain.goal == 0.0)).astype(np.float64)
    leaks = (1.0 - survival) + survival * (chain.matrix @ ended + chain.give_up)
    failed = chain.accumulate(np.where(alive, leaks, 0.0), alive, survival)
    failure = min(float(chain.start @ (failed + ended)), 1.0)
    if failure == 0.0:  # decided on the graph: no exit leads to failure
        return 1.0, 0.0
    return goal, 1.0 if goal == 0.0 else failure


def _evaluated_ends(chain: Chain) -> dict[str, float]:
    """Probability of each way in which episodes end."""
    final = (chain.goal > 0) | (chain.dead > 0)
    settling = reaching_in_chain(chain, final | (chain.give_up > 0)) & ~final
    names = ["goal", *chain.model.state_labels, "dead_end", "gave_up"]
    marks = end_marks(chain.model)
    at_end = np.stack([final & (marks[chain.state] == i) for i in range(len(names))], axis=1)
    hits = chain.matrix @ at_end.astype(np.float64)
    hits[np.arange(chain.n_nodes), stop_marks(chain.model)[chain.state]] += chain.give_up
    totals = chain.accumulate(np.where(settling[:, None], hits, 0.0), settling)
    shares = chain.start @ (totals + at_end)
    ends = {name: float(share) for name, share in zip(names, shares, strict=True)}
    return ends | {"wandering": complement(sum(ends.values()))}


_ROUNDING = 64 * MACHINE_EPSILON
"""As little wandering as this is rounding: it is what the other ends leave of 1."""

_WORDS = {"dead_end": "dead-end", "gave_up": "gave up", "wandering": "wandering"}


def ways_to_fail(ends: Mapping[str, float]) -> dict[str, float]:
    """The ends other than the goal that occur, with their probabilities."""
    return {
        name: share
        for name, share in ends.items()
        if name != "goal" and share > (_ROUNDING if name == "wandering" else 0.0)
    }


def failing_in_words(ends: Mapping[str, float], at_start: float = 0.0) -> str:
    """The ways to fail in one line: "crash 0.03, gave up 0.02 (before the first step)".

    Args:
        ends: probability of each end, as in ``Evaluation.ends``.
        at_start: probability of giving up before the first step.
    """
    parts = []
    for name, share in ways_to_fail(ends).items():
        told = f"{_WORDS.get(name, name)} {share:.6g}"
        if name == "gave_up" and at_start > 0.0:
            of_it = "" if at_start > share - _ROUNDING else f"{at_start:.6g} of it "
            told += f" ({of_it}before the first step)"
        parts.append(told)
    return ", ".join(parts)


def giving_up_at_start(policy: MixedPolicy, problem: Problem) -> float:
    """Probability that the policy gives up before its first step."""
    start = start_distribution(problem.model, problem.start)
    states = np.flatnonzero((start > 0.0) & (np.diff(problem.model.pair_offsets) > 0))
    total = 0.0
    for member, weight in zip(policy.policies, policy.weights, strict=True):
        found = member.branches(states, member.start_memory(states))
        gives_up = found.pair == GIVE_UP_CODE
        share = start[states[found.situation]] * found.probability
        total += float(weight) * float(share[gives_up].sum())
    return total


def expected_visits(chain: Chain, survival: float = 1.0) -> FloatArray:
    """Expected number of visits of each node, visits at time t weighted survival^t, [nodes].

    Raises:
        ModelError: the policy may wander for ever, so that visits are infinite.
    """
    if survival == 1.0:
        ends = (chain.goal > 0) | (chain.dead > 0) | (chain.give_up > 0)
        if not reaching_in_chain(chain, ends).all():
            raise ModelError("the policy may wander for ever: its expected visits are infinite")
    return chain.push(chain.start, survival)


def pair_visits(policy: Policy | MixedPolicy, problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Undiscounted expected visits of each pair, and how likely it is given up in each state.

    Returns:
        [pairs] and [states] of the problem's model, whatever the policy remembers and, within a
        horizon, at all times together.

    Raises:
        ModelError: the policy is for another model, or may wander for ever.
    """
    lottery, asked = on_one_model(policy, problem, "pair_visits")
    model, start = asked.model, start_distribution(asked.model, asked.start)
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
    """The stationary randomised policy that visits every pair as often as the lottery does.

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


GOAL, FAILED, SUCCESS_COST, STOPPED = range(4)


@dataclass(frozen=True)
class Measures:
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


def mean_of(parts: list[Measures], weights: FloatArray) -> Measures:
    """Mean of measures over a lottery; an infinite cost of weight 0 does not count."""
    used = [(p, float(w)) for p, w in zip(parts, weights, strict=True) if w > 0]
    scalars = {
        f.name: sum(w * getattr(p, f.name) for p, w in used)
        for f in fields(Measures)
        if f.name not in ("ends", "secondary") and getattr(used[0][0], f.name) is not None
    }
    names = list(dict.fromkeys(name for p, _ in used for name in p.ends))
    return Measures(
        **scalars,
        ends={n: sum(w * p.ends.get(n, 0.0) for p, w in used) for n in names},
        secondary={n: sum(w * p.secondary[n] for p, w in used) for n in used[0][0].secondary},
    )


def layered_measures(
    policy: Policy, problem: Problem, start: FloatArray, least_nodes: int = LARGE
) -> Measures | None:
    """The measures of a policy; None where its chain is to be written out.

    That is where it is small, where the policy remembers something else than its cost, where
    quantities beside the cost are asked for, or where a decision is missing or not allowed,
    which the written-out chain names.

    Args:
        policy: on the problem's model.
        problem: says the semantics and the discount.
        start: distribution over states, [states].
        least_nodes: states times layers from which a policy is not written out.
    """
    layers = policy.layers()
    if layers is None or layers.count * problem.model.n_states < least_nodes:
        return None
    if conditions_of(problem) or objective_of(problem) is not None:
        return None
    quits = any((part == GIVE_UP_CODE).any() for part in (layers.decision, layers.tails))
    charge, semantics = state_give_up_charges(problem.model, problem.semantics), problem.semantics
    columns, names = _measured_columns(problem, np.where(np.isinf(charge), 0.0, charge), quits)
    moves, begins = LayerMoves(problem.model, layers), np.flatnonzero(start)
    sweep = LayerSweep(moves, tuple(columns), np.isinf(charge), semantics.forbids_failing)
    totals, marks = sweep.at_start(begins)
    found = int(np.bitwise_or.reduce(marks))
    if found & WRONG:
        return None
    # the measures from the totals of ``_measured_columns`` at the start, and what may be met
    total = (start[begins] @ totals).tolist()
    later = len(total) - 4 if problem.discount is not None else 0  # where the discounted begin
    goal, failure = _both_measures(total[GOAL], total[FAILED])
    kept, surrogate = _both_measures(total[later + GOAL], total[later + FAILED])
    stopped = float("inf") if found & (ENDLESS | FAILS) else total[STOPPED]
    endless = found & (FAILS if later else ENDLESS | FAILS)
    target = float("inf") if endless else total[later + STOPPED]
    ends = dict.fromkeys(["goal", *problem.model.state_labels, "dead_end", "gave_up"], 0.0)
    ends |= {"goal": total[GOAL]} | dict(zip(names, total[4:], strict=False))
    return Measures(
        goal=goal,
        failure=failure,
        success_cost=total[SUCCESS_COST],
        expected_cost=stopped,
        discounted_goal=kept,
        discounted_failure=surrogate,
        discounted_cost=total[later + SUCCESS_COST] if problem.ratio else target,
        ends=ends | {"wandering": complement(sum(ends.values()))},
        secondary={},
    )


def _measured_columns(
    problem: Problem, charge: FloatArray, gives_up: bool
) -> tuple[list[TotalledReward], list[str]]:
    """What is totalled: the first four undiscounted, then by end, then discounted.

    Args:
        problem: it limits nothing but failure.
        charge: of giving up, [states].
        gives_up: whether the policy does so anywhere.

    Returns:
        The columns, and the names of the ends that may occur, but the goal.
    """
    model, semantics = problem.model, problem.semantics
    goal, dead = model.goal_mask.astype(np.float64), dead_ends(model).astype(np.float64)
    entering = dead_end_charges(model, dead_ends(model), semantics)
    goes_on, stage = semantics.give_up is GiveUp.DEAD_ENDS, cost_means(model)

    def four(survival: float, first: int) -> list[TotalledReward]:
        """Goal, failure, cost of success and cost until failure."""
        leak = 1.0 - survival
        return [
            TotalledReward(goal, survival),
            TotalledReward(dead, survival, each=leak, gives_up=survival, lost=1.0),
            TotalledReward(0.0 * goal, survival, prices=first + GOAL),
            TotalledReward(entering, survival, reward=stage, gives_up=charge, lost=charge,
                   goes_on=goes_on),
        ]  # fmt: skip

    marks, names, ends = end_marks(model), list[str](), list[TotalledReward]()
    for number, name in enumerate((*model.state_labels, "dead_end"), start=1):
        if (marks == number).any():
            names.append(name)
            ends.append(TotalledReward((marks == number).astype(np.float64), until_lost=False))
    if gives_up:
        names.append("gave_up")
        ends.append(TotalledReward(0.0 * goal, until_lost=False, gives_up=1.0))
    found, gamma = four(1.0, 0) + ends, survival_of(problem.discount)
    if gamma < 1.0:
        found += four(gamma, len(found))
    return found, names


def _both_measures(goal: float, failure: float) -> tuple[float, float]:
    """Goal and failure within [0, 1]; none of either where the other is sure."""
    if failure == 0.0:
        return 1.0, 0.0
    return min(goal, 1.0), 1.0 if goal <= 0.0 else min(failure, 1.0)
