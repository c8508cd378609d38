"""Episodes: a policy is data, what is over stays over, and what cannot be is named."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from formulations import MCMP, S3P
from played import START, ferry, hall, level_policy, remembering, step, task
from small_models import FIRST, TRIES
from ssp_lp import GIVE_UP, DeterministicPolicy, Memory, ModelError, on_original, product, solve
from ssp_lp.io import Controller, write_controller

TRYING = solve(S3P(TRIES, "door", failure_budget=0.125)).policy  # three tries, then it gives up


def written(policy, folder, *, world="model"):
    """A controller that has begun an episode of the policy."""
    write_controller(policy, folder / "controller.json")
    controller = Controller(folder / "controller.json")
    controller.reset(0, world=world)
    return controller


def tries(episode, seed):
    """How often one tries until the episode is over, in a world of one's own."""
    rng, count = np.random.default_rng(seed), 0
    while (action := episode.action("door")) is not GIVE_UP:
        assert action == "try"
        count += 1
        if rng.random() < 0.1:
            return count
        episode.observe("door", 1.0)
    return 3


@pytest.mark.slow
def test_one_policy_plays_in_many_threads():
    def right(seed):
        return tries(TRYING.start(seed), seed) == tries(TRYING.start(seed), seed) <= 3

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(right, range(600)))


def test_a_policy_holds_nothing_of_an_episode():
    before = {name: id(value) for name, value in vars(TRYING).items()}
    stored = pickle.dumps(TRYING)
    episode = TRYING.start(0)
    episode.action("door")
    episode.observe("door", 1.0)
    assert {name: id(value) for name, value in vars(TRYING).items()} == before
    assert pickle.dumps(TRYING) == stored
    assert tries(copy.copy(TRYING).start(0), 3) == tries(TRYING.start(0), 3)
    assert not {"reset", "observe"} & set(dir(TRYING))


def test_what_is_over_stays_over_at_a_goal_and_in_a_dead_end(tmp_path):
    policy = DeterministicPolicy.from_actions(FIRST, {"depot": "alley"})
    for end in ("home", "wreck"):
        for player in (policy.start(), written(policy, tmp_path)):
            assert player.action("depot") == "alley"
            player.observe(end, 4.0)
            for state in (end, "depot", "home"):  # whatever is said of it
                assert player.action(state) is None
            with pytest.raises((ModelError, ValueError), match="episode is over"):
                player.observe("home", 4.0)
        batch = policy.start_many(2)
        assert batch.actions(["depot", end]) == ["alley", None]
        batch.observe([end, "depot"], [4.0, 4.0])
        assert batch.actions(["depot", "depot"]) == [None, None]
        batch.observe(["home", "depot"], [4.0, np.nan])
        assert batch.actions(["depot", "depot"]) == [None, None]


def test_what_is_over_stays_over_after_giving_up(tmp_path):
    """A memory of the user's is not asked about a step that nobody took."""
    asked = []

    def update(memory, state, action, successor, cost):
        asked.append(action)
        return min(memory + 1, 2)

    once = product(TRIES, Memory(start=0, update=update, fails=lambda tried: tried == 2))
    policy = on_original(solve(MCMP(once, once.start("door"), None)).policy)
    runs = policy.start(0), written(policy, tmp_path)
    asked.clear()
    for player, given_up in zip(runs, (GIVE_UP, "give up"), strict=True):
        assert player.action("door") == "try"
        player.observe("door", 1.0)
        for _ in range(2):
            assert player.action("door") == given_up
            with pytest.raises((ModelError, ValueError), match="episode is over"):
                player.observe("door", 1.0)
    batch = policy.start_many(1, 0)
    batch.actions(["door"])
    batch.observe(["door"], [1.0])
    for _ in range(2):
        assert batch.actions(["door"]) == [GIVE_UP]
        batch.observe(["door"], [1.0])
    assert set(asked) == {"try"}


def every_memory():
    """A policy of each kind of memory, and a state in which it acts."""
    yield DeterministicPolicy.from_actions(FIRST, {"depot": "alley"}), "depot"
    yield TRYING, "door"
    yield level_policy(ferry()), "quay"
    yield remembering(task(hall())), START
    yield solve(S3P(ferry(), "quay", failure_budget=0.3, cost_levels=9)).policy, "quay"
    yield solve(MCMP(hall(), START, failure_budget=0.7, horizon=6)).policy, START


def test_every_memory_refuses_costs_that_are_none(tmp_path):
    for policy, start in every_memory():
        for player in (policy.start(0), written(policy, tmp_path)):
            action = player.action(start)
            there, paid = step(policy.model, start, action, np.random.default_rng(1))
            for cost in (np.nan, np.inf, -np.inf, -1.0, -1e-9):
                with pytest.raises((ModelError, ValueError), match="observed cost"):
                    player.observe(there, cost)
            player.observe(there, paid)  # nothing has moved
        batch = policy.start_many(1, 0)
        batch.actions([start])
        with pytest.raises(ModelError, match="observed cost"):
            batch.observe([start], [np.nan])


def test_steps_that_cannot_be_are_named_unless_the_world_is_another(tmp_path):
    policy = DeterministicPolicy.from_actions(hall(), {("hall", k): "fast" for k in range(3)})
    one, batch = policy.start(), policy.start_many(2)
    one.action(START)
    batch.actions([START, START])
    with pytest.raises(
        ModelError, match=r"'fast' of state \('hall', 0\) cannot lead to \('hall', 2"
    ):
        one.observe(("hall", 2), 1.0)
    with pytest.raises(ModelError, match="world='other'"):
        batch.observe([("hall", 1), ("hall", 2)], [1.0, 1.0])
    one.observe(("hall", 1), 1.0)
    with pytest.raises(ModelError, match="was called twice"):
        one.observe(("hall", 1), 1.0)
    with pytest.raises(ModelError, match=r"in state \('hall', 1\) by the last observation"):
        one.action(START)
    controller = written(policy, tmp_path)
    controller.action(START)
    controller.observe(("hall", 1), 1.0)
    with pytest.raises(ValueError, match="was called twice"):
        controller.observe(("hall", 1), 1.0)
    with pytest.raises(ValueError, match="not in state"):
        controller.action(START)
    for free in (policy.start(world="other"), written(policy, tmp_path, world="other")):
        free.action(START)
        for _ in range(2):
            free.observe(("hall", 2), 0.25)
        assert free.action(START) == "fast"
    many = policy.start_many(2, world="other")
    many.actions([START, START])
    many.observe([("hall", 2), ("hall", 3)], [1.0, 1.0])
    assert many.actions([START, START]) == ["fast", None]
    late = solve(MCMP(hall(), START, failure_budget=0.7, horizon=6)).policy
    with pytest.raises(ModelError, match="does not occur"):
        late.start(0).action(("hall", 2))  # no step is taken yet
    for begin in (policy.start, lambda world: policy.start_many(2, world=world)):
        with pytest.raises(ModelError, match=r"world must be 'model' or 'other', not 'moon'"):
            begin(world="moon")
    with pytest.raises(ValueError, match=r"world must be"):
        controller.reset(0, world="moon")
