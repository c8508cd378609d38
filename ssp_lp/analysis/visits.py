"""Expected visits of a policy, and the randomised policy equivalent to a lottery."""

from __future__ import annotations

import numpy as np

from ssp_lp.analysis.chain import Chain, policy_chain, reaching_in_chain
from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError
from ssp_lp.model.product import ProductSSP
from ssp_lp.policies import MixedPolicy, StochasticPolicy
from ssp_lp.policies.joint_memory import common_memory
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem, on_one_model
from ssp_lp.processes.failure_semantics import start_distribution, survival_of


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
    if asked is problem or not isinstance(model, ProductSSP):
        return pairs, gave_up
    there = np.zeros(problem.model.n_pairs), np.zeros(problem.model.n_states)
    np.add.at(there[0], model.original_pair, pairs)
    np.add.at(there[1], model.original_state, gave_up)
    return there


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
