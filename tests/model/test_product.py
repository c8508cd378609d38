"""Products with a memory, or a number of steps: equal to what is built by hand, and played."""

import numpy as np
import pytest
from scipy.stats import binomtest

from formulations import MCMP, S3P, MaxProb
from refusing import refused
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    HorizonSSP,
    Memory,
    ProductSSP,
    end_probability,
    evaluate,
    on_original,
    product,
    simulate,
    solve,
    within_steps,
)
from ssp_lp.model.graph import dead_ends
from ssp_lp.model.product import LATE

HOUSE = {
    "hall": {
        "key room": [(0.9, "key", 2.0), (0.1, "hall", 1.0), (0.0, "cellar", 1.0)],
        "ward": [(1.0, "ward", 1.0)],
        "door": [(0.95, "door", 4.0), (0.05, "cellar", 1.0)],
    },
    "key": {"back": [(0.8, "hall", 2.0), (0.2, "ward", 1.0)]},
    "ward": {
        "on": [(0.5, "hall", 1.0), (0.4, "door", 1.0), (0.1, "cellar", 0.0)],
        "hide": [(0.7, "hall", 5.0), (0.3, "key", 5.0)],
        "wait": [(0.5, "ward", 1.0), (0.4, "ward", 3.0), (0.1, "hall", 1.0)],
    },
    "attic": {"jump": [(1.0, "hall", 0.0)]},
    "cellar": {},
}
MODEL = model_of(HOUSE, "door", labels={"below": ["cellar"], LATE: ["ward"]})
TASKS = {
    "the key before the door": Memory(
        start=False,
        update=lambda has, state, action, to, cost: has or to == "key",
        accepts=lambda has: has,
    ),
    "at most two visits of the ward": Memory(
        start=0,
        update=lambda visits, state, action, to, cost: min(visits + (to == "ward"), 3),
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


def unrolled(memory):
    """The product written out by hand, from a worklist of (state, memory)."""
    choices, open_states, goals = {}, [(state, memory.start) for state in [*HOUSE, "door"]], set()
    while open_states:
        here = state, kept = open_states.pop()
        if here in choices or here in goals:
            continue
        failed = memory.fails(kept)
        if state == "door" and memory.accepts(kept) and not failed:
            goals.add(here)
            continue
        choices[here] = {}
        for action, outcomes in ({} if failed else HOUSE.get(state, {})).items():
            choices[here][action] = [
                (p, (to, memory.update(kept, state, action, to, cost)), cost)
                for p, to, cost in outcomes
            ]
            open_states += [end for _, end, _ in choices[here][action]]
    return SSP.from_transitions(choices, goal=goals, treat_actionless_as_dead_ends=True)


@each_task
def test_a_task_equals_the_model_built_by_hand(memory):
    made, by_hand = product(MODEL, memory), unrolled(memory)
    assert isinstance(made, ProductSSP)
    assert set(made.states) == set(by_hand.states)
    least = solve(MaxProb(by_hand, ("hall", memory.start))).failure_probability
    for criterion in (MCMP, S3P):
        for budget in (None, least + 0.3 * (1.0 - least)):
            found = solve(criterion(made, made.start("hall"), failure_budget=budget))
            known = solve(criterion(by_hand, ("hall", memory.start), failure_budget=budget))
            assert found.objective == pytest.approx(known.objective, rel=1e-9)
            assert found.failure_probability == pytest.approx(known.failure_probability, abs=1e-9)


@pytest.mark.slow
@each_task
def test_its_policy_plays_on_the_original_model(memory):
    made = product(MODEL, memory)
    least = solve(MaxProb(made, made.start("hall"))).failure_probability
    solution = solve(S3P(made, made.start("hall"), failure_budget=least + 0.2 * (1.0 - least)))
    policy, rng = on_original(solution.policy), np.random.default_rng(1)
    assert policy.model is MODEL
    wins, episodes = 0, 300
    for _ in range(episodes):
        episode = policy.start(rng)
        state, kept = "hall", memory.start
        while state not in ("door", "cellar") and not memory.fails(kept):
            action = episode.action(state)
            if action is GIVE_UP:
                break
            outcomes = HOUSE[state][action]
            _, to, cost = outcomes[rng.choice(len(outcomes), p=[p for p, _, _ in outcomes])]
            kept = memory.update(kept, state, action, to, cost)
            episode.observe(to, cost)
            state = to
        wins += state == "door" and memory.accepts(kept) and not memory.fails(kept)
    interval = binomtest(wins, episodes).proportion_ci(0.9999)
    assert interval.low <= solution.goal_probability <= interval.high


def test_the_original_evaluates_it_where_reaching_the_goal_is_all_that_counts():
    """What the product's policy does is measured on both alike, and simulated."""
    made = product(MODEL, TASKS["at most two visits of the ward"])
    options = {"failure_budget": 0.3, "give_up": "anywhere"}
    solution = solve(MCMP(made, made.start("hall"), **options))
    policy, problem = on_original(solution.policy), MCMP(MODEL, "hall", **options)
    exact = evaluate(policy, problem)
    assert exact.goal_probability == pytest.approx(solution.goal_probability, abs=1e-12)
    assert exact.expected_cost == pytest.approx(solution.expected_cost, rel=1e-12)
    report = simulate(policy, problem, episodes=4_000, seed=3, confidence=0.9999)
    assert report.goal_probability.low <= exact.goal_probability <= report.goal_probability.high


def test_labels_of_the_model_are_kept_and_new_ones_say_why():
    made = product(MODEL, TASKS["the key before the door"])
    ends = solve(MCMP(made, made.start("hall"), failure_budget=0.5)).evaluation.ends
    assert {"goal", "below", "goal not accepted", "memory fails"} <= set(ends)
    assert made.state_labels["goal not accepted"].tolist() == [made.index_of(("door", False))]
    assert made.start({"hall": 0.5, "key": 0.5}) == {("hall", False): 0.5, ("key", False): 0.5}


def test_a_product_of_a_product_keeps_both_reasons():
    """At most two visits, then the key: labels of the two memories do not hide each other."""
    inner = product(MODEL, TASKS["at most two visits of the ward"])
    key = Memory(
        start=False,
        update=lambda has, state, action, to, cost: has or to[0] == "key",
        accepts=lambda has: has,
    )
    both = product(inner, key)
    visits = {inner.states[k] for k in inner.state_labels["memory fails"].tolist()}
    marked = {both.states[k][0] for k in both.state_labels["memory fails"].tolist()}
    assert visits
    assert marked
    assert marked <= visits
    solution = solve(MCMP(both, both.start(("hall", 0)), failure_budget=0.5))
    twice = on_original(on_original(solution.policy))
    assert twice.model is inner.original
    problem = MCMP(inner.original, "hall", failure_budget=0.5, give_up="anywhere")
    assert evaluate(twice, problem).goal_probability >= solution.goal_probability - 1e-12


def by_name(model):
    """A model as nested dicts, whatever the order of its states."""
    told = {}
    for s, name in enumerate(model.states):
        actions = {}
        for pair in range(*model.pair_offsets[s : s + 2].tolist()):
            some = slice(*model.outcome_offsets[pair : pair + 2].tolist())
            ends = [str(model.states[k]) for k in model.successors[some].tolist()]
            parts = zip(model.probabilities[some], ends, model.costs[some], strict=True)
            actions[model.action_of(pair)] = sorted(parts)
        told[name] = (bool(model.goal_mask[s]), actions)
    return told


@pytest.mark.parametrize("start", [None, ["hall"], ["ward", "attic"]])
@pytest.mark.parametrize("steps", [1, 2, 5])
def test_a_horizon_is_the_product_with_its_memory(steps, start):
    fast = within_steps(MODEL, steps, start=start)
    acting = {state for state in MODEL.states if np.diff(MODEL.pair_offsets)[MODEL.index_of(state)]}
    counting = Memory(
        start=0,
        update=lambda count, state, action, successor, cost: (
            LATE if successor in acting and count + 1 >= steps else count + 1
        ),
        fails=lambda count: count == LATE,
    )
    slow = product(MODEL, counting, start=start)
    assert isinstance(fast, HorizonSSP)
    assert by_name(fast) == by_name(slow)
    lost = {label for label, over in zip(fast.states, dead_ends(fast), strict=True) if over}
    named = [
        {name: {made.states[k] for k in made.state_labels[name]} for name in ("below", LATE)}
        for made in (fast, slow)
    ]
    named[1][LATE] |= {label for label in lost if label[0] != "cellar"}
    assert named[0] == named[1]
    assert {slow.states[k] for k in slow.state_labels["memory fails"]} <= named[0][LATE]
    assert [fast.index_of(label) for label in fast.states] == list(range(fast.n_states))
    assert list(fast.states) == [fast.states[k] for k in range(fast.n_states)]
    assert fast.original_state.tolist() == [MODEL.index_of(state) for state, _ in fast.states]


def test_where_too_few_steps_are_left_the_policy_gives_up():
    walk = {"far": {"go": [(0.5, "near", 1.0), (0.5, "far", 1.0)]}}
    walk["near"] = {"go": [(0.9, "g", 1.0), (0.1, "far", 1.0)]}
    horizon = within_steps(model_of(walk), 3, start=["far"])
    episode = on_original(solve(MCMP(horizon, ("far", 0), failure_budget=None)).policy).start(0)
    for _ in range(2):  # it stays twice: two steps are needed and one is left
        assert episode.action("far") == "go"
        episode.observe("far", 1.0)
    assert episode.action("far") is GIVE_UP


def test_being_late_is_a_way_to_end():
    lock = model_of({"lock": {"try": [(0.5, "g", 1.0), (0.5, "lock", 1.0)]}})
    three, late = within_steps(lock, 3, start=["lock"]), {"late": end_probability(LATE) <= 0.125}
    solution = solve(MaxProb(three, ("lock", 0), constraints=late))
    assert solution.secondary_costs["late"] == pytest.approx(0.125)
    assert solution.objective == pytest.approx(0.875)


def test_a_large_horizon_is_made_without_a_loop_over_states():
    rng, states, wide = np.random.default_rng(0), 2_000, 3
    pairs = 4 * (states - 1)
    model = SSP.from_arrays(
        pair_offsets=[*range(0, pairs + 1, 4), pairs],
        outcome_offsets=np.arange(pairs + 1) * wide,
        successors=rng.integers(0, states, pairs * wide),
        probabilities=rng.dirichlet(np.ones(wide), pairs).ravel(),
        costs=1.0,
        goal_states=[states - 1],
    )
    horizon = within_steps(model, 100)
    assert horizon.n_states == states * 101
    assert "_index" not in vars(horizon)
    assert horizon.states[horizon.index_of((7, 60))] == (7, 60)


def test_what_is_refused():
    counting = Memory(start=0, update=lambda n, *step: n + 1)
    refused("more than state_limit=50 states", product, MODEL, counting, state_limit=50)
    refused("model is not a product", on_original, solve(MCMP(MODEL, "hall")).policy)
    made = product(MODEL, TASKS["the key before the door"], start=["hall"])
    refused("nowhere", made.start, "nowhere")
    for steps in (0, -1, 2.0, True, "many"):
        refused("whole number", within_steps, MODEL, steps)
    words = "no goal can be reached within 1 steps"
    refused(words, within_steps, MODEL, 1, start=["attic"])
    refused("is not a state", within_steps, MODEL, 3, start=["moon"])
    horizon = within_steps(MODEL, 3, start=["hall"])
    for label in ("hall", ("hall", 4), ("attic", 0), ("hall", 3), ("moon", 0)):
        refused("is not a state", horizon.index_of, label)


def test_a_memory_that_has_no_hash_is_that_of_no_state():
    """Of every kind of product: the label is looked up, not found, and refused by name."""
    for model in (product(MODEL, TASKS["never hide twice"]), within_steps(MODEL, 3)):
        assert model.find(("hall", 0)) == model.index_of(("hall", 0))
        assert model.find(("hall", [0])) is None
        refused(r"\('hall', \[0\]\) is not a state", model.index_of, ("hall", [0]))
