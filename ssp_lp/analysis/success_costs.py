"""The law of the total cost of a policy, within a problem."""

from __future__ import annotations

from collections.abc import Iterable

from ssp_lp.accumulated_cost.arrivals import ChainProspect
from ssp_lp.accumulated_cost.cost_law import CostLaw
from ssp_lp.accumulated_cost.policy_layers import chains_of_law
from ssp_lp.arrays import FloatArray
from ssp_lp.model.arguments import explained
from ssp_lp.policies.chain import Chain
from ssp_lp.policies.policy import MixedPolicy, Policy
from ssp_lp.problem import NEEDED, Problem, on_one_model
from ssp_lp.processes.failure_semantics import FailureSemantics, start_distribution


@explained
def success_costs(policy: Policy | MixedPolicy, problem: Problem = NEEDED) -> CostLaw:
    """The law of a policy's total cost on the runs that reach the goal.

    Costs and probabilities are undiscounted, whatever the problem's discount. The law of a lottery
    is the mixture of its members' laws, so that a quantile is the mixture's, never a mean of the
    members' quantiles.

    Args:
        policy: any policy on the problem's model.
        problem: says the start.

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
    start, used = start_distribution(problem.model, problem.start), lottery.weights > 0.0
    members = [member for member, counts in zip(lottery.policies, used, strict=True) if counts]
    chains = (chains_of_law(problem.model, member, start) for member in members)
    return law_of_chains(chains, lottery.weights[used])


def measured_costs(policy: MixedPolicy, problem: Problem) -> CostLaw:
    """The cost law that a problem's measure goes by: of costs as the policy's members count them.

    Members may round costs up. A measure that is one of the totals goes by costs as they are paid,
    where such a law is soon followed.
    """
    start, used = start_distribution(problem.model, problem.start), policy.weights > 0.0
    members = [member for member, counts in zip(policy.policies, used, strict=True) if counts]
    chains = [chains_of_law(problem.model, member, start, soon=True) for member in members]
    return measured_law(chains, policy.weights[used], problem.semantics)


def measured_law(
    chains: Iterable[tuple[Chain, Chain]], weights: FloatArray, semantics: FailureSemantics
) -> CostLaw:
    """The cost law of :func:`measured_costs` from its members' chains, as :func:`law_of_chains`."""
    if semantics.risk is not None and semantics.risk.is_a_total:
        return law_of_chains(chains, weights)
    return law_of_chains(((counted, counted) for _, counted in chains), weights)


def law_of_chains(chains: Iterable[tuple[Chain, Chain]], weights: FloatArray) -> CostLaw:
    """The cost law of a lottery from its members' chains.

    Args:
        chains: of the members, as costs are paid and as the members count them.
        weights: of the members, > 0, [members].
    """
    each = list(chains)
    paid = tuple(ChainProspect.of(own) for own, _ in each)
    if all(own is counted for own, counted in each):
        return CostLaw(paid, weights)
    return CostLaw(paid, weights, tuple(ChainProspect.of(counted) for _, counted in each))
