"""Policies that remember their cost: layer by layer they attain what their chain says.

They stop where they have lost the goal, and where they count costs rounded up the law is that of
the costs that are paid.
"""

from collections import defaultdict
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from drawn_policies import CLOSE, drawn_model, drawn_policy
from formulations import EGUBS, GUBS, MCMP, S3P, CostBoundedReach, CostQuantile, CVaR, MinCost
from small_models import model_of
from ssp_lp import (
    SSP,
    CostAwarePolicy,
    MixedPolicy,
    ModelError,
    certify,
    evaluate,
    simulate,
    solve,
    success_costs,
)
from ssp_lp.accumulated_cost import policy_layers
from ssp_lp.accumulated_cost.policy_layers import chain_of_law
from ssp_lp.analysis import evaluation
from ssp_lp.analysis.evaluation import evaluation_of, law_of_chains, layered_measures
from ssp_lp.policies.chain import policy_chain
from ssp_lp.policies.policy import UNDECIDED
from ssp_lp.processes.failure_semantics import start_distribution
from written_models import written

GIVE_UPS = ["attention", "anywhere", "dead_ends"]
either_way = pytest.mark.parametrize("is_compiled", [False, True])
costs = pytest.mark.parametrize("zero", [[], [0.0]], ids=["paying", "free steps"])


def chain_measures(policy, problem, start):
    return evaluation.evaluated_measures(policy_chain(problem.model, policy, start), problem)


@either_way
@costs
@pytest.mark.parametrize("discount", [None, 0.9])
def test_layers_attain_what_the_written_out_chain_does(is_compiled, zero, discount, monkeypatch):
    monkeypatch.setattr(policy_layers, "accelerated", lambda entries, *loops: is_compiled)
    draw, compared = np.random.default_rng(7), 0
    for turn in range(18):
        model = drawn_model(draw, [0.5, 1.0, 1.5, 3.0, *zero])
        policy = drawn_policy(draw, model, on_levels=turn % 3 == 2)
        problems = [S3P(model, {0: 0.5, 1: 0.5}, failure_budget=0.5, discount=discount)] + [
            MCMP(model, 0, 0.5, discount, give_up=give_up, charge_failing_step=turn % 2 == 0)
            for give_up in GIVE_UPS
        ]
        for problem in problems:
            start = start_distribution(model, problem.start)
            found = layered_measures(policy, problem, start, 0)
            try:
                truth = chain_measures(policy, problem, start)
            except ModelError:  # gives up where it may not: the chain names the state
                assert found is None
                continue
            assert found is not None
            compared += 1
            for here, there in zip(found, truth, strict=True):
                assert here == pytest.approx(there, rel=CLOSE, abs=CLOSE)
            assert truth.later.size == 0  # nothing is paid after failing
    assert compared > 30


@either_way
@costs
def test_the_law_of_layers_is_that_of_the_written_out_chain(is_compiled, zero, monkeypatch):
    monkeypatch.setattr(policy_layers, "accelerated", lambda entries, *loops: is_compiled)
    draw, compared = np.random.default_rng(11), 0
    for _ in range(40):
        model = drawn_model(draw, [0.5, 1.0, 1.5, 3.0, *zero])
        policy = drawn_policy(draw, model, on_levels=False)
        start = np.zeros(model.n_states)
        start[:2] = 0.5
        short = chain_of_law(model, policy, start, least_nodes=0)
        chains = (short, policy_chain(model, policy, start))
        found, truth = (law_of_chains([(chain, chain)], np.ones(1)) for chain in chains)
        assert found.goal == pytest.approx(truth.goal, rel=CLOSE, abs=CLOSE)
        assert found.cost == pytest.approx(truth.cost, rel=CLOSE, abs=CLOSE)
        if truth.goal < 1e-9:
            continue
        compared += 1
        for bound in (0.0, 0.5, 1.0, 2.0, 3.5, 7.0, 20.0):
            assert found.within(bound) == pytest.approx(truth.within(bound), rel=CLOSE, abs=CLOSE)
            assert found.excess(bound) == pytest.approx(truth.excess(bound), rel=1e-11, abs=CLOSE)
        for level in (0.0, 0.3123, 0.9456):
            assert found.quantile(level) == truth.quantile(level)
            assert found.tail_mean(level) == pytest.approx(truth.tail_mean(level), rel=1e-11)
        assert found.exponential(-0.3) == pytest.approx(truth.exponential(-0.3), rel=1e-11)
    assert compared > 15


def test_a_missing_decision_is_named_by_the_chain():
    model = written("x go: y 1\n y go: g 1")
    decision, tails = np.full((2, 3), UNDECIDED), np.full((1, 3), UNDECIDED)
    live = [model.index_of(name) for name in "xy"]
    decision[0, live] = 0
    tails[0, live] = model.pair_offsets[live]
    policy = CostAwarePolicy(model, 1.0, decision, tails, np.full(3, 9.0))
    with pytest.raises(ModelError, match="no decision in state 'y'"):
        chain_of_law(model, policy, start_distribution(model, "x"), least_nodes=0)


def test_failing_where_that_is_forbidden_costs_without_end():
    problem = MinCost(written("x go: 0.5 g 1, 0.5 x 1\n x dare: 0.9 g 1, 0.1 d 1"), "x")
    x, start = problem.model.index_of("x"), start_distribution(problem.model, "x")
    tails = np.full((1, 3), UNDECIDED)
    tails[0, x] = 0
    for dares in (0, 1):
        decision = np.full((2, 3), UNDECIDED)
        decision[:, x] = [0, dares]
        policy = CostAwarePolicy(problem.model, 1.0, decision, tails, np.full(3, 9.0))
        found, truth = (
            evaluation_of(of(policy, problem, start), problem).expected_cost
            for of in (partial(layered_measures, least_nodes=0), chain_measures)
        )
        assert found == pytest.approx(truth)
        assert np.isinf(found) == (dares == 1)


@pytest.mark.parametrize("give_up", GIVE_UPS)
def test_free_loops_that_a_layer_never_leaves_fail_once_and_cost_nothing(give_up):
    problem = MCMP(written("x go: 0.5 g 1, 0.5 y 1\n y spin: 0.5 y 0, 0.5 z 0\n y leave: g 5\n"
                           "z spin: y 0"), "x", 1.0, give_up=give_up)  # fmt: skip
    model, start = problem.model, start_distribution(problem.model, "x")
    decision, tails = np.full((2, model.n_states), UNDECIDED), np.full((1, 4), UNDECIDED)
    live = [model.index_of(name) for name in "xyz"]
    decision[:, live], tails[0, live] = 0, model.pair_offsets[live]
    policy = CostAwarePolicy(model, 1.0, decision, tails, np.full(model.n_states, 9.0))
    for found in (
        layered_measures(policy, problem, start, 0),
        chain_measures(policy, problem, start),
    ):
        told = evaluation_of(found, problem)
        assert told.goal_probability == told.failure_probability == pytest.approx(0.5)
        assert told.expected_cost == pytest.approx(1.0)


def test_a_lottery_is_evaluated_the_same_either_way(coarse_robot, monkeypatch):
    solution = solve(S3P(*coarse_robot, failure_budget=0.3))
    assert len(solution.policy.policies) == 2
    written_out = evaluate(solution.policy, solution.problem)
    monkeypatch.setattr(evaluation, "layered_measures", partial(layered_measures, least_nodes=0))
    streamed = evaluate(solution.policy, solution.problem)
    assert streamed.objective == pytest.approx(written_out.objective, rel=CLOSE)
    assert dict(streamed.ends) == pytest.approx(dict(written_out.ends), rel=CLOSE, abs=CLOSE)
    assert certify(solution).accepted


# Where the goal is lost


def drawn_rooms(seed, cheapest):
    """Six rooms with costly ways on, back and out; from most the goal can be avoided for ever."""
    draw, names, choices = np.random.default_rng(seed), [f"r{k}" for k in range(6)], {}
    for k, name in enumerate(names):
        after, back = [*names, "g"][k + 1], names[max(k - 1, 0)]
        cost = draw.integers(cheapest, 5, size=3).tolist()
        share = round(float(draw.uniform(0.1, 0.5)), 2)
        choices[name] = {
            "on": [(1.0 - share, after, cost[0]), (share, back, cost[1])],
            "leap": [(0.8, after, 1), (0.2, draw.choice(["pit", back]), cost[2])],
            "round": [(1.0, back, cost[2])],
        }
    return model_of(choices)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("cheapest", [0, 1])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("criterion", [S3P, CVaR, CostQuantile])
def test_nothing_is_paid_once_the_goal_is_lost(criterion, seed, cheapest, compiled, accelerate):
    if compiled:
        pytest.importorskip("numba")
    accelerate(compiled)
    model = drawn_rooms(seed, cheapest)
    level = {} if criterion is S3P else {"level": 0.7}
    problem = criterion(model, "r0", failure_budget=0.75, **level)
    solution = solve(problem)
    for member in solution.policy.policies:
        chain = policy_chain(model, member, start_distribution(model, "r0"))
        lost = ~chain.reaching(chain.goal > 0)
        assert not chain.per_node(chain.cost)[lost].any()
    found = evaluate(solution.policy, problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-9)
    assert found.failure_probability <= 0.75 + 1e-9
    assert certify(solution).accepted


# Costs that are counted rounded up


def paid_law(policy, model, start):
    """Pr(goal, C = total), run by run: what the policy does, remembers and pays."""
    law = defaultdict(float)
    for member, weight in zip(policy.policies, policy.weights, strict=True):
        begin = np.array([model.index_of(start)])
        runs = {(int(begin[0]), int(member.start_memory(begin)[0]), 0.0): float(weight)}
        while sum(runs.values()) > 1e-13:
            after = defaultdict(float)
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


ONE = written(f"r0 near: 0.5 g 0.5, 0.5 g {np.pi / 3}\n r0 far: g 2")


def rooms(seed):
    """Four rooms in a row, with costs from the reals, a short cut that may fail and a way back."""
    draw, choices = np.random.default_rng(seed), {"pit": {}, "r4": {}}
    for room in range(4):
        after, slow, fast = f"r{room + 1}", *draw.uniform(0.3, 2.0, 2).tolist()
        choices[f"r{room}"] = {
            "walk": [(0.7, after, slow), (0.3, after, 1.7 * slow)],
            "run": [(0.8, after, fast / 3.0), (0.1, "pit", fast), (0.1, f"r{room}", fast)],
        }
    return model_of(choices, "r4")


def utility(costs):
    return np.exp(-0.3 * costs)


EXACT = EGUBS(ONE, "r0", -0.5, 0.1, cost_levels=5)  # its optimum remembers nothing


@pytest.mark.parametrize(
    "problem",
    [
        EXACT,
        GUBS(ONE, "r0", lambda costs: np.exp(-0.5 * costs), 0.1, cost_levels=5),
        EGUBS(rooms(0), "r0", -0.4, 0.2, cost_levels=7),
        GUBS(rooms(1), "r0", utility, 0.3, cost_levels=9),
        CostBoundedReach(rooms(2), "r0", 4.0, 0.3, cost_levels=8),
        CVaR(rooms(3), "r0", 0.8, 0.25, cost_levels=12),
        CostQuantile(rooms(4), "r0", 0.7, 0.25, cost_levels=12),
    ],
    ids=lambda problem: type(problem).__name__,
)
def test_the_law_of_rounded_costs_is_that_of_every_run(problem):
    policy = solve(problem).policy
    rounded = any(isinstance(p, CostAwarePolicy) and p.rounds_up for p in policy.policies)
    assert rounded is (problem is not EXACT)
    truth, law = paid_law(policy, problem.model, "r0"), success_costs(policy, problem)
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
    played = simulate(policy, problem, episodes=4_000, seed=1, confidence=0.9999)
    assert played.conditional_cost.low <= law.conditional_mean <= played.conditional_cost.high
    if problem is EXACT:
        assert law.conditional_mean == pytest.approx(0.25 + np.pi / 6.0)


@pytest.mark.parametrize("seed", range(30))
def test_tails_begin_where_their_thresholds_say(seed):
    """Thresholds anywhere beyond the last level: some that only a last step's cost would reach."""
    draw, model = np.random.default_rng(seed), rooms(seed)
    ends = model.successors == model.index_of("pit")
    model = replace(model, costs=model.costs + 3.0 * ends)  # the dearest steps are last ones
    cap, acts = int(draw.integers(2, 6)), np.diff(model.pair_offsets) > 0
    decision = np.where(acts, draw.integers(0, 2, (cap, model.n_states)), UNDECIDED)
    taken = model.pair_offsets[:-1] + draw.integers(0, 2, (2, model.n_states))
    levels = np.append(0.0, np.cumsum(draw.uniform(0.3, 0.9, cap)))
    early, late = draw.uniform([[0.0], [3.4]], [[1.0], [5.0]], (2, model.n_states))
    threshold = levels[-2] + np.where(draw.random(model.n_states) < 0.5, early, late)
    tails = np.where(acts, taken, UNDECIDED)
    policy = CostAwarePolicy(model, float(levels[1]), decision, tails, threshold, levels=levels)
    law = paid_law(MixedPolicy((policy,), np.ones(1)), model, "r0")
    start = start_distribution(model, "r0")
    problem = S3P(model, "r0", 0.9)
    reached = evaluation_of(layered_measures(policy, problem, start, least_nodes=0), problem)
    assert reached.goal_probability == pytest.approx(sum(law.values()), abs=1e-9)
    paid = sum(total * mass for total, mass in law.items())
    assert reached.success_cost == pytest.approx(paid, rel=1e-8)


def test_more_tails_than_levels():
    """One level, and tails from 2, from 3 and never: a total takes the tail of its own state."""
    stop, on = [(1.0, "home", 1.0)], [(0.5, "home", 10.0), (0.5, "pit", 1.0)]
    begin = {"go": [(1 / 3, "b", 2.0), (1 / 3, "c", 3.0), (1 / 3, "d", 4.0)]}
    ways = {"a": begin} | {s: {"stop": stop, "on": on} for s in "bcd"}
    model = SSP.from_transitions(ways, goal={"home"}, dead_ends={"pit"})
    first, acts = model.pair_offsets[:-1], np.diff(model.pair_offsets) > 0
    late = acts & (np.array(model.states) != "a")
    tails = np.where(acts, [first, first + late], UNDECIDED)
    threshold = np.full(model.n_states, np.inf)
    threshold[[model.index_of("b"), model.index_of("c")]] = 2.0, 3.0
    decision = np.where(acts, 0, UNDECIDED)[None]
    policy = CostAwarePolicy(model, 2.0, decision, tails, threshold, levels=np.array([0.0, 2.0]))
    problem = S3P(model, "a", 1.0)
    start = start_distribution(model, "a")
    reached = evaluation_of(layered_measures(policy, problem, start, least_nodes=0), problem)
    assert reached.goal_probability == pytest.approx(1 / 6 + 1 / 6 + 1 / 3)
    assert evaluate(policy, problem).goal_probability == pytest.approx(2 / 3)
