"""Gymnasium's toy-text environments: from the table to a certified policy, played back there."""

import sys
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from formulations import MCMP, S3P, MaxProb
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    Memory,
    MissingDependencyError,
    ModelError,
    acting_everywhere,
    certify,
    product,
    solve,
)
from ssp_lp.io import StepLimitWarning, from_gymnasium, rollout

gym = pytest.importorskip("gymnasium")

CONFIDENCE = 0.999

END_OF_CLIFF = 47


def check_agreement(solution, report):
    """The solution's failure probability lies in the interval of the simulated one."""
    failure = report.failure_probability
    assert failure.low <= solution.failure_probability <= failure.high
    assert report.goal + report.failed + report.gave_up + report.truncated == report.episodes


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


def test_frozen_lake_in_eight_lines():
    env = gym.make("FrozenLake-v1")
    world = from_gymnasium(env)
    solution = solve(MCMP(world.model, world.start, failure_budget=0.3))
    assert certify(solution).accepted
    report = rollout(env, solution.policy, episodes=1000, seed=0, confidence=CONFIDENCE)
    check_agreement(solution, report)
    assert world.step_limit == world.horizon == report.step_limit == 100
    assert "goal" in report.summary()


@pytest.mark.parametrize(
    ("name", "options", "steps"),
    [
        ("FrozenLake-v1", {}, 100),
        ("FrozenLake-v1", {"map_name": "8x8"}, 100),
        ("FrozenLake8x8-v1", {}, 200),
        ("Taxi-v4", {"max_episode_steps": 14}, 14),
        ("Taxi-v4", {"max_episode_steps": 14, "is_rainy": True}, 14),
    ],
)
def test_the_least_failure_is_backward_induction(name, options, steps):
    env = gym.make(name, **options)
    world = from_gymnasium(env)
    solution = solve(MCMP(world.model, world.start, failure_budget=None))
    assert world.horizon == steps
    assert solution.failure_probability == pytest.approx(least_failure(env, steps), abs=1e-10)
    report = rollout(env, solution.policy, episodes=300, seed=1, confidence=CONFIDENCE)
    check_agreement(solution, report)


def test_without_the_horizon_the_step_limit_is_told():
    env = gym.make("FrozenLake-v1", map_name="8x8")
    world = from_gymnasium(env, horizon=None)
    assert (world.step_limit, world.horizon, world.start) == (100, None, {0: 1.0})
    solution = solve(MCMP(world.model, world.start, failure_budget=0.05))
    with pytest.warns(StepLimitWarning, match="FrozenLake-v1 .*max_episode_steps=100"):
        report = rollout(env, solution.policy, episodes=300, seed=0)
    assert report.truncated > 0
    assert report.failure_probability.low > solution.failure_probability
    endless = gym.make("FrozenLake-v1", map_name="8x8", max_episode_steps=-1)
    assert from_gymnasium(endless).horizon is None
    check_agreement(
        solution, rollout(endless, solution.policy, episodes=300, seed=0, confidence=CONFIDENCE)
    )


def test_a_horizon_beyond_the_limit_is_told_and_one_below_it_is_kept():
    env = gym.make("FrozenLake-v1", map_name="8x8", max_episode_steps=60)
    long = from_gymnasium(env, horizon=150)
    solution = solve(MCMP(long.model, long.start, failure_budget=0.3))
    with pytest.warns(StepLimitWarning):
        rollout(env, solution.policy, episodes=100, seed=0)
    short = from_gymnasium(env, horizon=40)
    solution = solve(MCMP(short.model, short.start, failure_budget=None))
    report = rollout(env, solution.policy, episodes=500, seed=0, confidence=CONFIDENCE)
    check_agreement(solution, report)
    assert report.success_costs.max() <= 40.0


@pytest.mark.parametrize("name", ["CliffWalking-v1", "CliffWalkingSlippery-v1"])
def test_cliff_walking_needs_a_goal(name):
    env = gym.make(name)
    with pytest.raises(ModelError, match="say which states are goals"):
        from_gymnasium(env)
    world = from_gymnasium(env, goal=lambda state: state == END_OF_CLIFF, horizon=100)
    solution = solve(MCMP(world.model, world.start, failure_budget=0.1))
    assert certify(solution).accepted
    least = solve(MaxProb(world.model, world.start)).objective
    assert 1.0 - least == pytest.approx(
        least_failure(env, 100, lambda state: state == END_OF_CLIFF), abs=1e-10
    )
    check_agreement(
        solution, rollout(env, solution.policy, episodes=500, seed=0, confidence=CONFIDENCE)
    )


def test_the_cliff_costs_what_the_rewards_say():
    env = gym.make("CliffWalking-v1")
    world = from_gymnasium(env, goal=lambda state: state == END_OF_CLIFF, cost="reward")
    assert set(world.model.costs.tolist()) == {1.0, 100.0}
    solution = solve(MCMP(world.model, world.start, failure_budget=0.0))
    assert solution.objective == pytest.approx(13.0)


def test_a_fall_may_be_a_failure_by_a_memory():
    """The table sends who falls back to the start; a memory of the cost makes it a failure."""
    env = gym.make("CliffWalkingSlippery-v1")
    world = from_gymnasium(env, goal=lambda state: state == END_OF_CLIFF, cost="reward")
    fell = Memory(
        start=False,
        update=lambda fallen, state, action, to, cost: fallen or cost > 1.0,
        fails=lambda fallen: fallen,
    )
    task = product(world.model, fell, start=world.start)
    solution = solve(MCMP(task, task.start(world.start), failure_budget=0.3))
    assert certify(solution).accepted
    report = rollout(env, solution.policy, episodes=500, seed=0, confidence=CONFIDENCE)
    check_agreement(solution, report)


def test_taxi_ends_in_states_of_their_own():
    env = gym.make("Taxi-v4", max_episode_steps=20)
    world = from_gymnasium(env, cost="reward")
    solution = solve(S3P(world.model, world.start, failure_budget=0.05))
    assert certify(solution).accepted
    report = rollout(env, solution.policy, episodes=500, seed=0, confidence=CONFIDENCE)
    check_agreement(solution, report)
    plain = from_gymnasium(env, horizon=None).model
    ends = [plain.states[k] for k in np.flatnonzero(plain.goal_mask)]
    assert ends == [("end", 0), ("end", 85), ("end", 410), ("end", 475)]
    assert world.model.costs.max() == 10.0


def test_taxi_under_its_own_limit():
    env = gym.make("Taxi-v4")
    world = from_gymnasium(env)
    solution = solve(MCMP(world.model, world.start, failure_budget=0.05))
    assert certify(solution).accepted
    report = rollout(env, solution.policy, episodes=300, seed=0, confidence=CONFIDENCE)
    check_agreement(solution, report)


def test_a_table_that_does_not_tell_all_is_found_out():
    env = gym.make("Taxi-v4", fickle_passenger=True)
    world = from_gymnasium(env, horizon=None)
    solution = solve(MCMP(world.model, world.start, failure_budget=0.0))
    with pytest.raises(ModelError, match="does not list"):
        rollout(env, solution.policy, episodes=100, seed=0)


def test_a_cost_of_the_users_own_and_its_lottery():
    env = gym.make("FrozenLake-v1", is_slippery=False)

    def push(state, action, next_state, reward):
        return 3.0 if action == 1 else 1.0  # down

    world = from_gymnasium(env, cost=push)
    solution = solve(S3P(world.model, world.start, failure_budget=0.2))
    report = rollout(env, solution.policy, episodes=300, seed=3, confidence=CONFIDENCE)
    assert report.conditional_cost.value == pytest.approx(solution.objective) == 3 * 3.0 + 3.0
    assert set(report.success_costs.tolist()) == {12.0}


def test_the_goal_predicate_may_name_a_state_on_the_way():
    env = gym.make("FrozenLake-v1")
    world = from_gymnasium(env, goal=lambda state: state == 8, horizon=None)
    solution = solve(MCMP(world.model, world.start, failure_budget=0.1))
    model = world.model
    assert [model.states[k] for k in np.flatnonzero(model.goal_mask)] == [8]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StepLimitWarning)
        report = rollout(env, solution.policy, episodes=500, seed=0, confidence=CONFIDENCE)
    check_agreement(solution, report)


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
    world = from_gymnasium(env)
    policy = solve(MCMP(world.model, world.start, failure_budget=0.3)).policy
    first, again, other = (rollout(env, policy, episodes=50, seed=k) for k in (5, 5, 6))
    assert first.success_costs.tolist() == again.success_costs.tolist()
    assert first.success_costs.tolist() != other.success_costs.tolist()
    assert rollout(env, policy, episodes=5, seed=5, max_steps=1).truncated == 5
    for wrong in ({"episodes": 0}, {"max_steps": 0}, {"confidence": 1.0}):
        with pytest.raises(ModelError):
            rollout(env, policy, **{"episodes": 1, "seed": 0, **wrong})


def test_a_policy_of_another_model_is_refused():
    model = SSP.from_transitions({0: {0: [(1.0, 1, 1.0)]}}, goal={1})
    policy = solve(MCMP(model, 0, failure_budget=0.0)).policy
    with pytest.raises(ModelError, match="of no environment"):
        rollout(gym.make("FrozenLake-v1"), policy, episodes=1, seed=0)


def test_single_precision_is_rounding_and_more_is_not():
    third = np.float32(1.0 / 3.0)
    ends = [(third, np.int64(s), np.float32(s == 2), s > 0) for s in range(3)]
    world = from_gymnasium(environment({0: ends}, {}, {}))
    assert world.model.probabilities.tolist() == [1.0 / 3.0] * 3
    assert [type(state) for state in world.model.states] == [int] * 3
    with pytest.raises(ModelError, match="action 0 of state 0: the table's probabilities sum"):
        from_gymnasium(environment({0: [(0.9, 1, 1.0, True)]}, {}))


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
    with pytest.raises(ModelError, match="an outcome in the table must be"):
        from_gymnasium(environment({0: [(1.0, 1, 1.0)]}, {}))
    fine = environment({0: [(1.0, 1, 1.0, True)], 1: [(1.0, 0, 0.0, False)]}, {})
    mixed = environment({0: [(0.5, 1, 1.0, True), (0.5, 1, 0.0, True)]}, {})
    with pytest.raises(ModelError, match="with a reward and some without"):
        from_gymnasium(mixed)
    assert from_gymnasium(mixed, goal=lambda state: state == 1).model.goal_mask.sum() == 1
    with pytest.raises(ModelError, match="no table"):
        from_gymnasium(gym.make("CartPole-v1"))
    with pytest.raises(ModelError, match="cost must be"):
        from_gymnasium(fine, cost="money")
    with pytest.raises(ModelError, match="horizon must be"):
        from_gymnasium(fine, horizon="long")
    with pytest.raises(ModelError, match="start's probabilities"):
        from_gymnasium(fine, start={0: 0.4})
    with pytest.raises(ModelError, match="action 0 of state 0"):
        from_gymnasium(fine, cost=lambda state, action, to, reward: -reward)
    assert from_gymnasium(fine, start=0, horizon=2).start == {(0, 0): 1.0}
    del fine.unwrapped.initial_state_distrib
    with pytest.raises(ModelError, match="give start"):
        from_gymnasium(fine)


@pytest.mark.parametrize("accelerator", ["none", "numba"])
def test_least_failure_where_success_is_rare(accelerator, monkeypatch):
    """Late states hardly ever succeed; exact fractions with 1/3 give the cost."""
    monkeypatch.setenv("SSP_LP_ACCELERATOR", accelerator)
    world = from_gymnasium(gym.make("FrozenLake-v1", map_name="8x8"))
    solution = solve(MCMP(world.model, world.start, failure_budget=None))
    assert solution.objective == pytest.approx(71.16707488470307, rel=1e-12)
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.gap < 1e-9


def test_the_missing_package_is_named(monkeypatch):
    env = gym.make("FrozenLake-v1")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'ssp-lp\[gym\]'"):
        from_gymnasium(env)
