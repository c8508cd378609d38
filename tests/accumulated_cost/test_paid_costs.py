"""The law of a policy that counts costs rounded up is that of the costs that are paid."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from formulations import EGUBS, GUBS, S3P, CostBoundedReach, CostQuantile, CVaR
from small_models import model_of
from ssp_lp import SSP, CostAwarePolicy, MixedPolicy, simulate, solve, success_costs
from ssp_lp.analysis.evaluation import layered_measures
from ssp_lp.policies.policy import UNDECIDED

LEFT = 1e-13  # mass of runs that are not followed


def paid_law(policy, model: SSP, start: str) -> dict[float, float]:
    """Pr(goal, C = total), run by run: what the policy does, remembers and pays."""
    law: dict[float, float] = defaultdict(float)
    for member, weight in zip(policy.policies, policy.weights, strict=True):
        begin = np.array([model.index_of(start)])
        runs = {(int(begin[0]), int(member.start_memory(begin)[0]), 0.0): float(weight)}
        while sum(runs.values()) > LEFT:
            after: dict[tuple[int, int, float], float] = defaultdict(float)
            for (state, memory, total), mass in runs.items():
                if model.goal_mask[state]:
                    law[total] += mass
                    continue
                if model.pair_offsets[state] == model.pair_offsets[state + 1]:
                    continue
                pair = member.branches(np.array([state]), np.array([memory])).pair
                if pair[0] < 0:
                    continue
                for k in range(*model.outcome_offsets[pair[0] : pair[0] + 2].tolist()):
                    there, cost = model.successors[k : k + 1], model.costs[k : k + 1]
                    then = int(member.remember(np.array([memory]), pair, there, cost)[0])
                    paid = round(total + float(cost[0]), 12)
                    after[int(there[0]), then, paid] += mass * float(model.probabilities[k])
            runs = after
    return law


def one_state() -> SSP:
    near, far = [(0.5, "g", 0.5), (0.5, "g", np.pi / 3.0)], [(1.0, "g", 2.0)]
    return model_of({"x": {"near": near, "far": far}, "g": {}}, "g")


def rooms(seed: int) -> SSP:
    """Four rooms in a row, with costs from the reals, a short cut that may fail and a way back."""
    draw = np.random.default_rng(seed)
    choices: dict[str, dict[str, list]] = {"pit": {}, "r4": {}}
    for room in range(4):
        after, slow, fast = f"r{room + 1}", *draw.uniform(0.3, 2.0, 2).tolist()
        choices[f"r{room}"] = {
            "walk": [(0.7, after, slow), (0.3, after, 1.7 * slow)],
            "run": [(0.8, after, fast / 3.0), (0.1, "pit", fast), (0.1, f"r{room}", fast)],
        }
    return model_of(choices, "r4")


def utility(costs):
    return np.exp(-0.3 * costs)


EXACT = EGUBS(one_state(), "x", -0.5, 0.1, cost_levels=5)  # its optimum remembers nothing
CASES = [
    (EXACT, "x"),
    (GUBS(one_state(), "x", lambda costs: np.exp(-0.5 * costs), 0.1, cost_levels=5), "x"),
    (EGUBS(rooms(0), "r0", -0.4, 0.2, cost_levels=7), "r0"),
    (GUBS(rooms(1), "r0", utility, 0.3, cost_levels=9), "r0"),
    (CostBoundedReach(rooms(2), "r0", 4.0, 0.3, cost_levels=8), "r0"),
    (CVaR(rooms(3), "r0", 0.8, 0.25, cost_levels=12), "r0"),
    (CostQuantile(rooms(4), "r0", 0.7, 0.25, cost_levels=12), "r0"),
]


@pytest.mark.parametrize(
    ("problem", "start"), CASES, ids=[f"{type(p).__name__} {s}" for p, s in CASES]
)
def test_it_is_that_of_every_run(problem, start: str) -> None:
    solution = solve(problem)
    members = solution.policy.policies
    rounded = any(isinstance(p, CostAwarePolicy) and p.rounds_up for p in members)
    assert rounded is (problem is not EXACT)
    truth, law = (
        paid_law(solution.policy, problem.model, start),
        success_costs(solution.policy, problem),
    )
    totals = np.array(sorted(truth))
    masses = np.array([truth[total] for total in totals.tolist()])
    assert law.goal == pytest.approx(masses.sum(), abs=1e-11)
    assert law.cost == pytest.approx(masses @ totals, rel=1e-10)
    for bound in np.quantile(totals, [0.0, 0.1, 0.3, 0.6]) + 1e-9:
        assert law.within(bound) == pytest.approx(masses[totals <= bound].sum(), abs=1e-11)
    level = 0.637
    reached = totals[np.searchsorted(np.cumsum(masses), level * masses.sum())]
    assert law.quantile(level) == pytest.approx(reached, rel=1e-9)
    assert law.exponential(-0.7) == pytest.approx(masses @ np.exp(-0.7 * totals), rel=1e-10)
    played = simulate(solution.policy, problem, episodes=4_000, rng=1, confidence=0.9999)
    assert played.conditional_cost.low <= law.conditional_mean <= played.conditional_cost.high


def test_one_step_of_two_costs() -> None:
    problem, _ = CASES[0]
    law = success_costs(solve(problem).policy, problem)
    assert law.conditional_mean == pytest.approx(0.25 + np.pi / 6.0)
    assert law.within(0.5) == pytest.approx(0.5)


@pytest.mark.parametrize("seed", range(30))
def test_tails_begin_where_their_thresholds_say(seed: int) -> None:
    """Thresholds anywhere beyond the last level: some that only a last step's cost would reach."""
    draw, model = np.random.default_rng(seed), rooms(seed)
    ends = model.successors == model.index_of("pit")
    model = replace(model, costs=model.costs + 3.0 * ends)  # the dearest steps are last ones
    cap, acts = int(draw.integers(2, 6)), np.diff(model.pair_offsets) > 0
    decision = np.where(acts, draw.integers(0, 2, (cap, model.n_states)), UNDECIDED)
    taken = model.pair_offsets[:-1] + draw.integers(0, 2, (2, model.n_states))
    levels = np.append(0.0, np.cumsum(draw.uniform(0.3, 0.9, cap)))
    early, late = draw.uniform([[0.0], [3.4]], [[1.0], [5.0]], (2, model.n_states))
    beyond = np.where(draw.random(model.n_states) < 0.5, early, late)
    policy = CostAwarePolicy(
        model,
        float(levels[1]),
        decision,
        np.where(acts, taken, UNDECIDED),
        levels[-2] + beyond,
        levels=levels,
    )
    law = paid_law(MixedPolicy((policy,), np.ones(1)), model, "r0")
    problem, start = S3P(model, "r0", 0.9), np.zeros(model.n_states)
    start[model.index_of("r0")] = 1.0
    reached = layered_measures(policy, problem, start, least_nodes=0)
    assert reached is not None
    assert reached.discounted_goal == pytest.approx(sum(law.values()), abs=1e-9)
    paid = sum(total * mass for total, mass in law.items())
    assert reached.discounted_cost == pytest.approx(paid, rel=1e-8)
