"""Gymnasium's toy-text environments: from the table to a certified policy, played back there."""

import sys
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from formulations import MCMP, S3P, MaxProb
from refusing import refused
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    Memory,
    MissingDependencyError,
    acting_everywhere,
    certify,
    product,
    solve,
)
from ssp_lp.io import StepLimitWarning, from_gymnasium, rollout

gym = pytest.importorskip("gymnasium")


def at_the_end(state):
    """Of the cliff."""
    return state == 47


def check(env, solution, episodes=150, seed=0):
    """Certified, and the failure probability lies in the interval of the simulated one."""
    assert certify(solution).accepted
    report = rollout(env, solution.policy, episodes=episodes, seed=seed, confidence=0.999)
    failure = report.failure_probability
    assert failure.low <= solution.failure_probability <= failure.high
    assert report.goal + report.failed + report.gave_up + report.truncated == report.episodes
    return report


def solved(world, budget, criterion=MCMP):
    return solve(criterion(world.model, world.start, failure_budget=budget))


def least_failure(env, steps, goal=None):
    """By backward induction on the environment's own table."""
    table, start = env.unwrapped.P, env.unwrapped.initial_state_distrib

    def worth(value, to, reward, over):
        if over or (goal is not None and goal(to)):
            return float(reward > 0.0 if goal is None else goal(to))
        return value[to]

    value = np.zeros(len(table))
    for _ in range(steps):
        value = np.array(
            [
                max(sum(p * worth(value, *row) for p, *row in rows) for rows in table[s].values())
                for s in range(len(table))
            ]
        )
    return 1.0 - float(np.asarray(start) @ value)


def environment(*rows, start=(1.0,)):
    """A table that is no environment of Gymnasium's."""
    inside = SimpleNamespace(P=dict(enumerate(rows)), initial_state_distrib=np.array(start))
    return SimpleNamespace(unwrapped=inside)


SMALL_TAXI, ICE = {"max_episode_steps": 14}, {"map_name": "8x8"}
CLIFF = {"goal": at_the_end, "horizon": 100}


@pytest.mark.parametrize(
    ("name", "made", "read", "budget", "steps"),
    [
        ("FrozenLake-v1", {}, {}, 0.3, 100),
        ("FrozenLake-v1", ICE, {}, None, 100),
        ("FrozenLake-v1", ICE | {"max_episode_steps": 60}, {"horizon": 40}, None, 40),
        ("FrozenLake8x8-v1", {}, {}, None, 200),
        ("Taxi-v4", SMALL_TAXI, {}, None, 14),
        ("Taxi-v4", SMALL_TAXI | {"is_rainy": True}, {}, None, 14),
        ("Taxi-v4", {}, {}, 0.05, 200),
        ("CliffWalking-v1", {}, CLIFF, 0.1, 100),
        ("CliffWalkingSlippery-v1", {}, CLIFF, 0.1, 100),
    ],
)
def test_the_least_failure_is_backward_induction(name, made, read, budget, steps):
    env = gym.make(name, **made)
    world = from_gymnasium(env, **read)
    assert world.horizon == steps
    least = least_failure(env, steps, read.get("goal"))
    if budget is None:
        found = solved(world, None).failure_probability
    else:
        found = 1.0 - solve(MaxProb(world.model, world.start)).objective
    assert found == pytest.approx(least, abs=1e-10)
    report = check(env, solved(world, budget))
    assert (report.success_costs <= steps).all()
    assert "goal" in report.summary()
    assert read or world.step_limit == report.step_limit == steps


@pytest.mark.slow
def test_without_the_horizon_the_step_limit_is_told():
    env = gym.make("FrozenLake-v1", map_name="8x8")
    world = from_gymnasium(env, horizon=None)
    assert (world.step_limit, world.horizon, world.start) == (100, None, {0: 1.0})
    solution = solved(world, 0.05)
    with pytest.warns(StepLimitWarning, match="FrozenLake-v1 .*max_episode_steps=100"):
        report = rollout(env, solution.policy, episodes=300, seed=0)
    assert report.truncated > 0
    assert report.failure_probability.low > solution.failure_probability
    endless = gym.make("FrozenLake-v1", map_name="8x8", max_episode_steps=-1)
    assert from_gymnasium(endless).horizon is None
    check(endless, solution)


def test_a_horizon_beyond_the_limit_is_told():
    env = gym.make("FrozenLake-v1", map_name="8x8", max_episode_steps=60)
    long = solved(from_gymnasium(env, horizon=150), 0.3)
    with pytest.warns(StepLimitWarning):
        rollout(env, long.policy, episodes=100, seed=0)


def test_the_cliff_costs_what_the_rewards_say():
    env = gym.make("CliffWalking-v1")
    refused("say which states are goals", from_gymnasium, env)
    world = from_gymnasium(env, goal=at_the_end, cost="reward")
    assert set(world.model.costs.tolist()) == {1.0, 100.0}
    assert solved(world, 0.0).objective == pytest.approx(13.0)


def test_a_fall_may_be_a_failure_by_a_memory():
    """The table sends who falls back to the start; a memory of the cost makes it a failure."""
    env = gym.make("CliffWalkingSlippery-v1")
    world = from_gymnasium(env, goal=at_the_end, cost="reward")
    fell = Memory(
        start=False,
        update=lambda fallen, state, action, to, cost: fallen or cost > 1.0,
        fails=lambda fallen: fallen,
    )
    task = product(world.model, fell, start=world.start)
    check(env, solve(MCMP(task, task.start(world.start), failure_budget=0.3)))


@pytest.mark.slow
def test_taxi_ends_in_states_of_their_own():
    env = gym.make("Taxi-v4", max_episode_steps=20)
    world = from_gymnasium(env, cost="reward")
    assert world.model.costs.max() == 10.0
    check(env, solved(world, 0.05, S3P))
    plain = from_gymnasium(env, horizon=None).model
    ends = [plain.states[k] for k in np.flatnonzero(plain.goal_mask)]
    assert ends == [("end", 0), ("end", 85), ("end", 410), ("end", 475)]
    env = gym.make("Taxi-v4", fickle_passenger=True)
    solution = solved(from_gymnasium(env, horizon=None), 0.0)
    refused("does not list", rollout, env, solution.policy, episodes=100, seed=0)


def test_a_cost_of_the_users_own_and_its_lottery():
    env = gym.make("FrozenLake-v1", is_slippery=False)
    world = from_gymnasium(env, cost=lambda state, action, to, reward: 3.0 if action == 1 else 1.0)
    solution = solved(world, 0.2, S3P)
    report = rollout(env, solution.policy, episodes=300, seed=3, confidence=0.999)
    assert report.conditional_cost.value == pytest.approx(solution.objective) == 3 * 3.0 + 3.0
    assert set(report.success_costs.tolist()) == {12.0}


@pytest.mark.filterwarnings("ignore::ssp_lp.io.StepLimitWarning")
def test_the_goal_predicate_may_name_a_state_on_the_way():
    env = gym.make("FrozenLake-v1")
    world = from_gymnasium(env, goal=lambda state: state == 8, horizon=None)
    assert [world.model.states[k] for k in np.flatnonzero(world.model.goal_mask)] == [8]
    check(env, solved(world, 0.1))


def test_giving_up_ends_the_episode():
    env = gym.make("FrozenLake-v1")
    model = from_gymnasium(env, horizon=None).model
    acting = np.flatnonzero(np.diff(model.pair_offsets))
    choice = {model.states[s]: GIVE_UP for s in acting}
    policy = DeterministicPolicy.from_actions(model, choice)
    report = rollout(env, policy, episodes=7, seed=0)
    assert (report.gave_up, report.goal, report.mean_steps) == (7, 0, 0.0)
    assert np.isnan(report.conditional_cost.value)


def test_what_comes_after_failing_is_played():
    """Who gave up walks on to an end or the limit, and has given up all the same."""
    env = gym.make("FrozenLake-v1")
    model = from_gymnasium(env, horizon=None).model
    acting = np.flatnonzero(np.diff(model.pair_offsets))
    quits = DeterministicPolicy.from_actions(model, {model.states[s]: GIVE_UP for s in acting})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StepLimitWarning)
        report = rollout(env, acting_everywhere(quits, 2), episodes=50, seed=0)
    assert (report.gave_up, report.goal) == (50, 0)
    assert report.mean_steps > 2.0


def test_seeds_repeat_and_steps_are_limited():
    env = gym.make("FrozenLake-v1")
    policy = solved(from_gymnasium(env), 0.3).policy
    costs = [rollout(env, policy, episodes=50, seed=k).success_costs.tolist() for k in (5, 5, 6)]
    assert costs[0] == costs[1] != costs[2]
    assert rollout(env, policy, episodes=5, seed=5, max_steps=1).truncated == 5
    for wrong in ({"episodes": 0}, {"max_steps": 0}, {"confidence": 1.0}):
        refused(None, rollout, env, policy, **{"episodes": 1, "seed": 0, **wrong})
    model = SSP.from_transitions({0: {0: [(1.0, 1, 1.0)]}}, goal={1})
    other = solve(MCMP(model, 0, failure_budget=0.0)).policy
    refused("has no environment", rollout, env, other, episodes=1, seed=0)


def test_single_precision_is_rounding_and_more_is_not():
    third = np.float32(1.0 / 3.0)
    ends = [(third, np.int64(s), np.float32(s == 2), s > 0) for s in range(3)]
    world = from_gymnasium(environment({0: ends}, {}, {}))
    assert world.model.probabilities.tolist() == [1.0 / 3.0] * 3
    assert [type(state) for state in world.model.states] == [int] * 3
    words = "action 0 of state 0: probabilities sum to 0.9"
    refused(words, from_gymnasium, environment({0: [(0.9, 1, 1.0, True)]}, {}))


def test_a_million_outcomes_are_listed_in_little_time():
    """Walks on a ring of lists: as exact as small ones, a microsecond for each outcome at most."""
    size, third = 20_000, 1.0 / 3.0
    table = [
        [[(third, (s + k) % size, float(s + k == size), s + k == size) for k in (0, 1, 2)]] * 2
        for s in range(size)
    ]
    env = environment({0: table[0][0]}, {})
    env.unwrapped.P = table
    began = time.process_time()
    model = from_gymnasium(env, horizon=None).model
    assert time.process_time() - began < 1.0 * 10 * model.n_outcomes / 1e6  # ten times the room
    assert (model.n_states, model.n_outcomes) == (size + 1, 6 * size)
    assert [model.states[k] for k in np.flatnonzero(model.goal_mask)] == [("end", 0)]
    assert set(model.probabilities.tolist()) == {third}


def test_tables_that_cannot_be_read_are_told():
    fine = environment({0: [(1.0, 1, 1.0, True)], 1: [(1.0, 0, 0.0, False)]}, {})
    mixed = environment({0: [(0.5, 1, 1.0, True), (0.5, 1, 0.0, True)]}, {})
    no_start = environment({0: [(1.0, 1, 1.0, True)]}, {})
    del no_start.unwrapped.initial_state_distrib
    for words, env, options in (
        ("outcomes in env.unwrapped.P must be", environment({0: [(1.0, 1, 1.0)]}, {}), {}),
        ("with a reward and some without", mixed, {}),
        ("no table", gym.make("CartPole-v1"), {}),
        ("cost must be", fine, {"cost": "money"}),
        ("horizon must be", fine, {"horizon": "long"}),
        ("start's probabilities", fine, {"start": {0: 0.4}}),
        ("action 0 of state 0", fine, {"cost": lambda state, action, to, reward: -reward}),
        ("give start", no_start, {}),
    ):
        refused(words, from_gymnasium, env, **options)
    assert from_gymnasium(mixed, goal=lambda state: state == 1).model.goal_mask.sum() == 1
    assert from_gymnasium(fine, start=0, horizon=2).start == {(0, 0): 1.0}


@pytest.mark.parametrize("accelerator", ["none", "numba"])
def test_least_failure_where_success_is_rare(accelerator, monkeypatch):
    """Late states hardly ever succeed; exact fractions with 1/3 give the cost."""
    monkeypatch.setenv("SSP_LP_ACCELERATOR", accelerator)
    solution = solved(from_gymnasium(gym.make("FrozenLake-v1", map_name="8x8")), None)
    assert solution.objective == pytest.approx(71.16707488470307, rel=1e-12)
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.gap < 1e-9


def test_the_missing_package_is_named(monkeypatch):
    env = gym.make("FrozenLake-v1")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    words = r"pip install '\.\[gym\]'"
    refused(words, from_gymnasium, env, error=MissingDependencyError)


def test_a_wrapper_that_records_sees_every_step():
    env = gym.make("FrozenLake-v1", render_mode="ansi")
    recorded = gym.wrappers.RenderCollection(env, pop_frames=False, reset_clean=False)
    report = rollout(recorded, solved(from_gymnasium(env), 0.3).policy, episodes=3, seed=1)
    assert len(recorded.render()) >= 3 + 3 * report.mean_steps  # each begins with a picture


def test_intervals_of_rolled_out_costs_allow_for_what_the_policy_and_the_limit_can_cost():
    """Along the cliff there are 13 steps and no way round; on the ice the limit is 100 steps."""
    cliff = gym.make("CliffWalking-v1")
    world = from_gymnasium(cliff, goal={47})
    report = rollout(cliff, solve(MCMP(world.model, world.start)).policy, episodes=5, seed=0)
    assert set(report.success_costs) == {13.0}
    assert report.conditional_cost.high <= 48.0
    lake = gym.make("FrozenLake-v1")
    world = from_gymnasium(lake, horizon=None)
    policy = solve(MCMP(world.model, world.start, failure_budget=0.3)).policy
    with pytest.warns(StepLimitWarning):
        report = rollout(lake, policy, episodes=100, seed=0)
    assert report.success_costs.mean() <= report.conditional_cost.high <= 100.0


def test_a_world_of_many_starts_is_shown_in_a_line():
    world = from_gymnasium(gym.make("Taxi-v4" if "Taxi-v4" in gym.registry else "Taxi-v3"))
    assert len(world.start) == 300
    assert "start=<dict of 300>, horizon=200" in repr(world)


def test_a_rollout_is_the_same_each_time_where_no_seed_is_given():
    env = gym.make("FrozenLake-v1")
    world = from_gymnasium(env)
    policy = solve(MaxProb(world.model, world.start)).policy
    assert str(rollout(env, policy, episodes=20)) == str(rollout(env, policy, episodes=20, seed=0))
