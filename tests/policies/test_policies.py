"""Policies: built by hand, played one by one or side by side, simulated in another world."""

import numpy as np
import pytest

from formulations import MCMP, S3P
from small_models import FIRST, TRIES
from ssp_lp import (
    GIVE_UP,
    CostAwarePolicy,
    DeterministicPolicy,
    Memory,
    MixedPolicy,
    ModelError,
    StochasticPolicy,
    TimedPolicy,
    acting_everywhere,
    evaluate,
    on_original,
    product,
    simulate,
    solve,
)

STAY, GO = (DeterministicPolicy.from_actions(TRIES, {"door": action}) for action in ("wait", "try"))
PROBLEM = MCMP(TRIES, start="door")


def near(share, expected, draws):
    """Within four standard deviations."""
    return abs(share - expected) < 4 * (expected * (1 - expected) / draws) ** 0.5


def test_an_episode_step_by_step():
    """With budget 1/8 for S3P one tries three times and then fails: 1/2 + 2/4 + 3/8 over 7/8."""
    solution = solve(S3P(TRIES, start="door", failure_budget=0.125))
    assert solution.objective == pytest.approx((0.5 + 0.5 + 0.375) / 0.875)
    episode = solution.policy.start(0)
    with pytest.raises(ModelError, match="before the first action"):
        episode.observe("door", 1.0)
    for _ in range(3):
        assert episode.action("door") == "try"
        for cost in (0.5, -1.0, float("nan"), float("inf")):
            with pytest.raises(ModelError, match="observed cost"):
                episode.observe("door", cost)
        episode.observe("door", 1.0)
    with pytest.raises(ModelError, match="not a state"):
        episode.action("window")
    assert episode.action("door") is GIVE_UP
    everywhere = acting_everywhere(solution.policy).start(0)
    for action in ("try", "try", "try", "wait", "wait"):
        assert everywhere.action("door") == action
        everywhere.observe("door", 1.0)
    assert everywhere.failed
    assert solution.policy.start(0).action("door") == "try"


def test_the_last_stage_of_a_timed_policy_is_followed_for_good():
    policy, states = TimedPolicy((GO, STAY, GO, STAY)), np.array([TRIES.index_of("door")])
    episode, memory, said = policy.start(0), policy.start_memory(states), []
    for _ in range(9):
        said.append(episode.action("door"))
        pair = policy.branches(states, memory).pair
        assert TRIES.action_of(int(pair[0])) == said[-1]
        cost = 1.0 if said[-1] == "try" else 3.0
        episode.observe("door", cost)
        memory = policy.remember(memory, pair, states, np.array([cost]))
    assert said == ["try", "wait", "try"] + 6 * ["wait"]


def test_a_lottery_is_drawn_once():
    lottery = MixedPolicy((STAY, GO), np.array([0.25, 0.75]))
    with pytest.raises(ModelError, match="a seed or a generator"):
        lottery.start()
    rng, drawn = np.random.default_rng(3), []
    for _ in range(2000):
        episode = lottery.start(rng)
        first = episode.action("door")
        assert episode.action("door") == first
        drawn.append(first == "wait")
    assert near(np.mean(drawn), 0.25, 2000)


def test_policies_that_are_none():
    for weights in ([0.5], [-0.5], [np.nan], [0.5, 0.5], []):
        with pytest.raises(ModelError):
            MixedPolicy((GO,), np.array(weights))
    with pytest.raises(ModelError):
        DeterministicPolicy.from_actions(TRIES, {"door": "knock"})
    with pytest.raises(ModelError):
        StochasticPolicy.from_actions(TRIES, {"door": {"try": 0.5}})
    knows_nothing = DeterministicPolicy.from_actions(TRIES, {})
    gives_up = DeterministicPolicy.from_actions(TRIES, {"door": GIVE_UP})
    for ask, words in (
        (lambda: evaluate(gives_up, MCMP(TRIES, "door", give_up="dead_ends")), "gives up"),
        (lambda: evaluate(knows_nothing, PROBLEM), "no decision in state 'door'"),
        (lambda: simulate(knows_nothing, PROBLEM, seed=0), "no decision in state 'door'"),
    ):
        with pytest.raises(ModelError, match=words):
            ask()


@pytest.mark.parametrize(
    ("give_up", "charge", "cost"),
    [
        ("attention", True, 3.0),
        ("attention", False, 0.0),
        ("anywhere", True, 1.0),
        ("dead_ends", True, np.inf),
    ],
)
def test_wandering_is_failure_and_costs_what_the_semantics_say(give_up, charge, cost):
    problem = MCMP(TRIES, start="door", give_up=give_up, charge_failing_step=charge)
    found = evaluate(STAY, problem)
    assert found.failure_probability == found.ends["wandering"] == 1.0
    assert found.expected_cost == pytest.approx(cost)
    assert np.isnan(found.conditional_cost)


def test_a_randomised_policy_by_hand():
    """Success s = 3/8 + 3/8 s, cost c = 3/4 + 3/8 c."""
    policy = StochasticPolicy.from_actions(TRIES, {"door": {"try": 0.75, GIVE_UP: 0.25}})
    problem = MCMP(TRIES, start="door", charge_failing_step=False)
    found = evaluate(policy, problem)
    assert found.goal_probability == pytest.approx(0.6)
    assert found.expected_cost == pytest.approx(1.2)
    assert found.ends["gave_up"] == pytest.approx(0.4)
    report = simulate(policy, problem, episodes=20_000, seed=1, confidence=0.9999)
    assert report.goal_probability.low <= 0.6 <= report.goal_probability.high
    assert report.expected_cost.low <= 1.2 <= report.expected_cost.high


def test_cost_aware_members_share_one_table():
    solution = solve(S3P(TRIES, start="door", failure_budget=0.2))
    assert all(isinstance(p, CostAwarePolicy) for p in solution.policy.policies)
    found = evaluate(solution.randomised_policy, solution.problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-12)
    assert found.failure_probability == pytest.approx(0.2, abs=1e-12)


# Other worlds


class KindDoor:
    """A world in which the second try always succeeds; its world is the number of tries."""

    def reset(self, episodes, rng):
        return np.zeros((episodes, 1)), np.zeros(episodes, dtype=np.int64)

    def step(self, world, pair, rng):
        tried = world + 1
        return tried, np.where(tried[:, 0] >= 2, 1, 0), np.ones(len(pair))


class Broken(KindDoor):
    def step(self, world, pair, rng):
        return world, np.full(len(pair), -1), np.ones(len(pair))


def test_a_world_of_the_users_own():
    asked = {"seed": 0, "episodes": 10, "simulator": KindDoor()}
    report = simulate(GO, PROBLEM, record=3, **asked)
    assert report.ends["goal"] == 10
    assert report.conditional_cost.value == 2.0
    assert [len(path) for path in report.paths] == [3, 3, 3]
    assert simulate(GO, PROBLEM, max_steps=1, **asked).ends["unfinished"] == 10
    with pytest.raises(ModelError, match="returned a state outside"):
        simulate(GO, PROBLEM, seed=0, simulator=Broken())


# Side by side: each episode is what it would be alone


def test_each_remembers_its_own_costs_and_gives_up_by_itself():
    """Three tries, as budget 1/8 allows; an episode that waited has fewer left."""
    policy = solve(S3P(TRIES, start="door", failure_budget=0.125)).policy
    batch = policy.start_many(3, 0)
    assert batch.actions(["door"] * 3) == ["try"] * 3
    batch.observe(["door", "door", "out"], [1.0, 3.0, 1.0])  # what came of it, whatever it was
    assert batch.actions(["door", "door", "out"]) == ["try", GIVE_UP, None]
    batch.observe(["door", "door", "out"], [1.0, 0.0, 0.0])
    assert batch.actions(["door", "out", "door"]) == ["try", GIVE_UP, None]
    batch.observe(["door", "door", "out"], [1.0, 0.0, 0.0])
    assert batch.actions(["door", "door", "out"]) == [GIVE_UP, GIVE_UP, None]


def test_a_lottery_is_drawn_for_each_episode():
    solution = solve(MCMP(FIRST, "depot", failure_budget=0.05))
    actions = solution.policy.start_many(9000, 1).actions(["depot"] * 9000)
    assert near(actions.count("road") / 9000, 5 / 9, 9000)
    mixed = solution.randomised_policy.start_many(9000, 2).actions(["depot"] * 9000)
    assert near(mixed.count("road") / 9000, 5 / 9, 9000)


def test_the_same_seed_plays_the_same_and_one_alone_as_a_single_episode():
    """A policy that draws: with one episode the draws are those of ``start``."""
    policy = solve(MCMP(FIRST, "depot", failure_budget=0.05)).randomised_policy
    for seed in range(20):
        single = policy.start(seed).action("depot")
        assert policy.start_many(1, seed).actions(["depot"]) == [single]
    once, again = (policy.start_many(50, 3).actions(["depot"] * 50) for _ in range(2))
    assert once == again


def test_a_loop_of_ones_own_fails_as_often_as_evaluated():
    rng, episodes = np.random.default_rng(0), 4000
    problem = S3P(TRIES, "door", failure_budget=0.2)
    policy = solve(problem).policy
    batch = policy.start_many(episodes, rng)
    states, going = ["door"] * episodes, True
    while going:
        actions = batch.actions(states)
        states = [
            "out" if action == "try" and rng.random() < 0.5 else state
            for state, action in zip(states, actions, strict=True)
        ]
        batch.observe(states, [3.0 if action == "wait" else 1.0 for action in actions])
        going = any(action not in (None, GIVE_UP) for action in actions)
    failure = evaluate(policy, problem).failure_probability
    assert near(states.count("door") / episodes, failure, episodes)


def test_what_cannot_be_played_is_named():
    lottery = solve(MCMP(FIRST, "depot", failure_budget=0.05)).policy
    with pytest.raises(ModelError, match="needs a seed or a generator"):
        lottery.start_many(2)
    batch = lottery.start_many(2, 0)
    with pytest.raises(ModelError, match="1 states given for 2 episodes"):
        batch.actions(["depot"])
    with pytest.raises(ModelError, match="'nowhere' is not a state"):
        batch.actions(["depot", "nowhere"])
    batch.actions(["depot", "home"])
    with pytest.raises(ModelError, match="1 costs given for 2 episodes"):
        batch.observe(["home", "home"], [1.0])
    with pytest.raises(ModelError, match="episodes must be a whole number >= 1"):
        lottery.start_many(0, 0)


def test_flows_that_underflow_are_shared_evenly():
    """What is never come to takes its decisions alike; elsewhere shares are those of the flow."""
    door, pairs = TRIES.index_of("door"), np.arange(TRIES.n_pairs)
    keys = np.array([door, door, TRIES.n_states + door, TRIES.n_states + door])
    flows = np.array([0.0, 0.0, 1e-300, 3e-300])
    policy = StochasticPolicy.from_flows(TRIES, keys, np.tile(pairs[:2], 2), flows, carrier=GO)
    assert policy.probability.tolist() == pytest.approx([0.5, 0.5, 0.25, 0.75])


def test_a_policy_that_carries_a_memory_ends_when_it_gives_up():
    """Whatever it remembers: unless what it carries goes on after failing, nothing does."""
    counted = product(TRIES, Memory(0, lambda n, *step: min(n + 1, 2)))
    solution = solve(MCMP(counted, counted.start("door"), failure_budget=0.2))
    (policy, *_) = on_original(solution.policy).policies
    assert len(policy.product.memories) == 3
    states = np.full(3, TRIES.index_of("door"))
    assert policy.branches(states, np.arange(3)).memory is None
