"""Products with a memory: each task equal to a model built by hand, and played on the original."""

import numpy as np
import pytest
from scipy.stats import binomtest

from formulations import MCMP, S3P, MaxProb
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    Memory,
    ModelError,
    ProductSSP,
    evaluate,
    on_original,
    product,
    simulate,
    solve,
)

HOUSE = {
    "hall": {
        "key room": [(0.9, "key", 2.0), (0.1, "hall", 1.0)],
        "ward": [(1.0, "ward", 1.0)],
        "door": [(0.95, "door", 4.0), (0.05, "cellar", 1.0)],
    },
    "key": {"back": [(0.8, "hall", 2.0), (0.2, "ward", 1.0)]},
    "ward": {
        "on": [(0.5, "hall", 1.0), (0.4, "door", 1.0), (0.1, "cellar", 0.0)],
        "hide": [(0.7, "hall", 5.0), (0.3, "key", 5.0)],
    },
    "cellar": {},
}


def house():
    return model_of(HOUSE, "door", labels={"below": ["cellar"]})


def unrolled(start, step, accepted, failed):
    """The product written out by hand, from a worklist of (state, memory)."""
    choices, open_states, goals = {}, [(state, start) for state in [*HOUSE, "door"]], set()
    while open_states:
        here = open_states.pop()
        state, kept = here
        if here in choices or here in goals:
            continue
        if state == "door" and accepted(kept) and not failed(kept):
            goals.add(here)
            continue
        choices[here] = {}
        if failed(kept) or state == "door":
            continue
        for action, outcomes in HOUSE[state].items():
            ends = [
                (p, (to, step(kept, state, action, to, cost)), cost) for p, to, cost in outcomes
            ]
            choices[here][action] = ends
            open_states += [end for _, end, _ in ends]
    return SSP.from_transitions(choices, goal=goals, treat_actionless_as_dead_ends=True)


TASKS = {
    "the key before the door": Memory(
        start=False,
        update=lambda has, state, action, to, cost: has or to == "key",
        accepts=lambda has: has,
    ),
    "at most two visits of the ward": Memory(
        start=0,
        update=lambda visits, state, action, to, cost: visits + (to == "ward"),
        fails=lambda visits: visits > 2,
    ),
    "within twelve units of cost": Memory(
        start=0.0,
        update=lambda paid, state, action, to, cost: min(paid + cost, 13.0),
        fails=lambda paid: paid > 12.0,
    ),
    "never hide twice": Memory(
        start=0,
        update=lambda times, state, action, to, cost: times + (action == "hide"),
        fails=lambda times: times > 1,
    ),
}

each_task = pytest.mark.parametrize("memory", TASKS.values(), ids=TASKS.keys())


@each_task
def test_a_task_equals_the_model_built_by_hand(memory):
    made = product(house(), memory)
    by_hand = unrolled(memory.start, memory.update, memory.accepts, memory.fails)
    assert isinstance(made, ProductSSP)
    assert isinstance(made, SSP)
    assert set(made.states) == set(by_hand.states)
    least = solve(MaxProb(by_hand, ("hall", memory.start))).failure_probability
    for criterion in (MCMP, S3P):
        for budget in (None, least + 0.3 * (1.0 - least)):
            found = solve(criterion(made, made.start("hall"), failure_budget=budget))
            known = solve(criterion(by_hand, ("hall", memory.start), failure_budget=budget))
            assert found.objective == pytest.approx(known.objective, rel=1e-9)
            assert found.failure_probability == pytest.approx(known.failure_probability, abs=1e-9)


@each_task
def test_its_policy_plays_on_the_original_model(memory):
    model = house()
    made = product(model, memory)
    least = solve(MaxProb(made, made.start("hall"))).failure_probability
    solution = solve(S3P(made, made.start("hall"), failure_budget=least + 0.2 * (1.0 - least)))
    policy, rng = on_original(solution.policy), np.random.default_rng(1)
    assert policy.model is model
    wins, episodes = 0, 3_000
    for _ in range(episodes):
        episode = policy.start(rng)
        state, kept = "hall", memory.start
        while state not in ("door", "cellar") and not memory.fails(kept):
            action = episode.action(state)
            if action is GIVE_UP:
                break
            outcomes = HOUSE[state][action]
            drawn = rng.choice(len(outcomes), p=[p for p, _, _ in outcomes])
            _, to, cost = outcomes[drawn]
            kept = memory.update(kept, state, action, to, cost)
            episode.observe(to, cost)
            state = to
        wins += state == "door" and memory.accepts(kept) and not memory.fails(kept)
    interval = binomtest(wins, episodes).proportion_ci(0.9999)
    assert interval.low <= solution.goal_probability <= interval.high


def test_the_original_evaluates_it_where_reaching_the_goal_is_all_that_counts():
    """The key is fetched anyway: what the product's policy does is measured on both alike."""
    model = house()
    made = product(model, TASKS["at most two visits of the ward"])
    problem = MCMP(made, made.start("hall"), failure_budget=0.3, give_up="anywhere")
    solution = solve(problem)
    policy = on_original(solution.policy)
    found = evaluate(policy, MCMP(model, "hall", failure_budget=0.3, give_up="anywhere"))
    assert found.goal_probability == pytest.approx(solution.goal_probability, abs=1e-12)
    assert found.expected_cost == pytest.approx(solution.expected_cost, rel=1e-12)


def test_many_episodes_are_simulated_at_once():
    model = house()
    made = product(model, TASKS["the key before the door"])
    solution = solve(MCMP(made, made.start("hall"), failure_budget=0.3))
    mine = MCMP(model, "hall", failure_budget=0.3, give_up="anywhere")
    policy = on_original(solution.policy)
    played = simulate(policy, mine, episodes=4_000, rng=np.random.default_rng(3), confidence=0.9999)
    exact = evaluate(policy, mine)
    assert played.goal_probability.low <= exact.goal_probability <= played.goal_probability.high


def test_cost_aware_policies_carry_both_memories():
    made = product(house(), TASKS["never hide twice"])
    solution = solve(S3P(made, made.start("hall"), failure_budget=0.2))
    policy = on_original(solution.policy)
    episode = policy.start(0)
    assert episode.action("hall") in HOUSE["hall"]
    episode.observe("ward", 1.0)
    assert episode.action("ward") in HOUSE["ward"]


def test_labels_of_the_model_are_kept_and_new_ones_say_why():
    made = product(house(), TASKS["the key before the door"])
    ends = solve(MCMP(made, made.start("hall"), failure_budget=0.5)).evaluation.ends
    assert {"goal", "below", "goal not accepted", "memory fails"} <= set(ends)
    assert made.state_labels["goal not accepted"].tolist() == [made.index_of(("door", False))]
    assert made.start({"hall": 0.5, "key": 0.5}) == {("hall", False): 0.5, ("key", False): 0.5}


def test_a_product_of_a_product_keeps_both_reasons():
    """At most two visits, then the key: labels of the two memories do not hide each other."""
    inner = product(house(), TASKS["at most two visits of the ward"])
    both = product(inner, Memory(
        start=False,
        update=lambda has, state, action, to, cost: has or to[0] == "key",
        accepts=lambda has: has,
    ))  # fmt: skip
    visits = {inner.states[k] for k in inner.state_labels["memory fails"].tolist()}
    assert visits
    marked = {both.states[k][0] for k in both.state_labels["memory fails"].tolist()}
    assert marked <= visits
    assert marked
    solution = solve(MCMP(both, both.start(("hall", 0)), failure_budget=0.5))
    twice = on_original(on_original(solution.policy))
    assert twice.model is inner.original
    problem = MCMP(inner.original, "hall", failure_budget=0.5, give_up="anywhere")
    assert evaluate(twice, problem).goal_probability >= solution.goal_probability - 1e-12


def test_what_is_refused():
    model = house()
    counting = Memory(start=0, update=lambda n, *step: n + 1)
    with pytest.raises(ModelError, match="more than state_limit=50 states"):
        product(model, counting, state_limit=50)
    with pytest.raises(ModelError, match="lives on no product"):
        on_original(solve(MCMP(model, "hall")).policy)
    made = product(model, TASKS["the key before the door"], start=["hall"])
    with pytest.raises(ModelError, match="nowhere"):
        made.start("nowhere")
