"""The finite horizon: equal to the product with its memory, and to backward induction."""

from pathlib import Path

import numpy as np
import pytest

from formulations import MCMP, S3P, MaxProb
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    HorizonSSP,
    Memory,
    ModelError,
    certify,
    end_probability,
    evaluate,
    on_original,
    product,
    simulate,
    solve,
    within_steps,
)
from ssp_lp.io import load_policy, save_policy
from ssp_lp.model.graph import dead_ends
from ssp_lp.model.product import LATE

HOUSE = {
    "hall": {
        "door": [(0.6, "out", 1.0), (0.3, "hall", 0.5), (0.1, "cellar", 2.0)],
        "ward": [(1.0, "ward", 1.0), (0.0, "cellar", 1.0)],
    },
    "ward": {
        "wait": [(0.5, "ward", 1.0), (0.5, "ward", 3.0)],
        "crawl": [(0.2, "out", 4.0), (0.8, "hall", 1.0)],
    },
    "attic": {"jump": [(1.0, "hall", 0.0)]},
    "cellar": {},
}


def house():
    return model_of(HOUSE, "out", labels={"below": ["cellar"], LATE: ["ward"]})


def by_name(model):
    """A model as nested dicts, whatever the order of its states."""
    told = {}
    for s, name in enumerate(model.states):
        actions = {}
        for pair in range(int(model.pair_offsets[s]), int(model.pair_offsets[s + 1])):
            some = slice(int(model.outcome_offsets[pair]), int(model.outcome_offsets[pair + 1]))
            actions[model.action_of(pair)] = sorted(
                zip(
                    model.probabilities[some].tolist(),
                    [str(model.states[k]) for k in model.successors[some].tolist()],
                    model.costs[some].tolist(),
                    strict=True,
                )
            )
        told[name] = (bool(model.goal_mask[s]), actions)
    return told


@pytest.mark.parametrize("start", [None, ["hall"], ["ward", "attic"]])
@pytest.mark.parametrize("steps", [1, 2, 5])
def test_it_is_the_product_with_its_memory(steps, start):
    model = house()
    fast = within_steps(model, steps, start=start)
    slow = product(model, fast.memory, start=start)
    assert isinstance(fast, HorizonSSP)
    assert by_name(fast) == by_name(slow)
    lost = {label for label, over in zip(fast.states, dead_ends(fast), strict=True) if over}
    used_up = {slow.states[k] for k in slow.state_labels["memory fails"]}
    for name in ("below", LATE):
        mine = {fast.states[k] for k in fast.state_labels[name]}
        theirs = {slow.states[k] for k in slow.state_labels[name]}
        assert mine == (theirs | {s for s in lost if s[0] != "cellar"} if name == LATE else theirs)
        assert name != LATE or used_up <= mine
    assert [fast.index_of(label) for label in fast.states] == list(range(fast.n_states))
    assert list(fast.states) == [fast.states[k] for k in range(fast.n_states)]
    assert fast.original_state.tolist() == [model.index_of(state) for state, _ in fast.states]


def test_the_step_counts_are_a_memory_written_by_hand():
    """A counter that fails one step later has the same failure, goals in time being accepted."""
    model, steps = house(), 4
    counter = Memory(
        start=0,
        update=lambda count, state, action, to, cost: count + 1,
        accepts=lambda count: count <= steps,
        fails=lambda count: count > steps,
    )
    by_hand = product(model, counter, start=["hall"])
    fast = within_steps(model, steps, start=["hall"])
    for budget in (None, 0.3, 0.6):
        mine = solve(MCMP(fast, ("hall", 0), failure_budget=budget))
        theirs = solve(MCMP(by_hand, ("hall", 0), failure_budget=budget))
        assert mine.failure_probability == pytest.approx(theirs.failure_probability, abs=1e-12)


@pytest.mark.parametrize("steps", [1, 3, 7])
def test_the_greatest_probability_is_backward_induction(steps):
    value = {name: float(name == "out") for name in [*HOUSE, "out"]}
    for _ in range(steps):
        value = {
            name: max(
                (sum(p * value[to] for p, to, _ in ends) for ends in HOUSE[name].values()),
                default=0.0,
            )
            if name != "out"
            else 1.0
            for name in value
        }
    horizon = within_steps(house(), steps, start=["hall", "ward"])
    start = horizon.start({"hall": 0.5, "ward": 0.5})
    solution = solve(MaxProb(horizon, start))
    assert solution.objective == pytest.approx(0.5 * (value["hall"] + value["ward"]), abs=1e-12)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_policies_act_on_the_model_and_carry_the_count(criterion):
    model = house()
    horizon = within_steps(model, 5, start=["hall"])
    solution = solve(criterion(horizon, ("hall", 0), failure_budget=0.3))
    assert certify(solution).accepted
    played = on_original(solution.policy)
    assert played.model is model
    there = evaluate(played, criterion(model, "hall", failure_budget=0.3))
    assert there.failure_probability == pytest.approx(solution.failure_probability, abs=1e-12)
    rng = np.random.default_rng(1)
    report = simulate(played, criterion(model, "hall", failure_budget=0.3), episodes=2000, rng=rng)
    assert report.goal_probability.low <= 1.0 - solution.failure_probability
    assert report.goal_probability.high >= 1.0 - solution.failure_probability


def test_where_too_few_steps_are_left_the_policy_gives_up():
    walk = {"far": {"go": [(0.5, "near", 1.0), (0.5, "far", 1.0)]}}
    walk["near"] = {"go": [(0.9, "out", 1.0), (0.1, "far", 1.0)]}
    model = SSP.from_transitions(walk, goal={"out"})
    horizon = within_steps(model, 3, start=["far"])
    policy = on_original(solve(MCMP(horizon, ("far", 0), failure_budget=None)).policy)
    episode = policy.start(0)
    for _ in range(2):  # it stays twice: two steps are needed and one is left
        assert episode.action("far") == "go"
        episode.observe("far", 1.0)
    assert episode.action("far") is GIVE_UP


def test_being_late_is_a_way_to_end():
    model = SSP.from_transitions(
        {"lock": {"try": [(0.5, "open", 1.0), (0.5, "lock", 1.0)]}}, goal={"open"}
    )
    three = within_steps(model, 3, start=["lock"])
    late = end_probability(LATE) <= 0.125
    solution = solve(MaxProb(three, ("lock", 0), constraints={"late": late}))
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


def test_what_cannot_be_is_told():
    model = house()
    for steps in (0, -1, 2.0, True, "many"):
        with pytest.raises(ModelError, match="whole number"):
            within_steps(model, steps)
    with pytest.raises(ModelError, match="no goal can be reached within 1 steps"):
        within_steps(model, 1, start=["attic"])
    with pytest.raises(ModelError, match="is not a state"):
        within_steps(model, 3, start=["moon"])
    horizon = within_steps(model, 3, start=["hall"])
    for label in ("hall", ("hall", 4), ("attic", 0), ("hall", 3), ("moon", 0)):
        with pytest.raises(ModelError, match="is not a state"):
            horizon.index_of(label)


@pytest.mark.parametrize("steps", [1, 2, 7, 30])
def test_surviving_can_be_the_goal(steps: int, tmp_path: Path) -> None:
    """The greatest probability of going on for so long is one recursion from the end."""
    walk = {
        "rope": {
            "stride": [(0.9, "rope", 1.0), (0.1, "net", 1.0)],
            "rest": [(0.96, "ledge", 4.0), (0.04, "net", 4.0)],
        },
        "ledge": {"wait": [(0.99, "ledge", 0.0), (0.01, "sky", 0.0)], "step": [(1.0, "rope", 2.0)]},
        "net": {},
    }
    model = SSP.from_transitions(walk, goal={"sky"}, treat_actionless_as_dead_ends=True)
    alive = within_steps(model, steps, start=["rope"], survive=True)
    greatest = {"rope": 1.0, "ledge": 1.0, "sky": 1.0, "net": 0.0}
    for _ in range(steps):
        greatest |= {
            state: max(sum(p * greatest[there] for p, there, _ in some) for some in acts.values())
            for state, acts in walk.items()
            if acts
        }
    best = solve(MaxProb(alive, ("rope", 0)))
    assert best.objective == pytest.approx(greatest["rope"], rel=1e-12)
    assert certify(best).accepted
    problem = MCMP(alive, ("rope", 0), failure_budget=1.0 - 0.9 * greatest["rope"])
    solution = solve(problem)
    report = simulate(
        solution.policy,
        problem,
        episodes=4_000,
        rng=np.random.default_rng(steps),
        confidence=0.9999,
    )
    interval = report.failure_probability
    assert interval.low <= solution.budget_used <= interval.high
    save_policy(solution.policy, tmp_path / "alive.npz")
    again = load_policy(tmp_path / "alive.npz", alive)
    assert evaluate(again, problem).failure_probability == pytest.approx(solution.budget_used)


def test_states_that_are_to_be_survived_may_have_actions() -> None:
    """Who lies in the net may stay there for ever: surviving is said by a label."""
    walk = {
        "rope": {"stride": [(0.9, "rope", 1.0), (0.1, "net", 1.0)]},
        "net": {"lie": [(1.0, "net", 0.0)]},
    }
    model = model_of(walk, "nowhere", labels={"fallen": ["net"]})
    for lost in (["fallen"], "fallen"):
        alive = within_steps(model, 5, start=["rope"], survive=lost)
        assert solve(MaxProb(alive, ("rope", 0))).objective == pytest.approx(0.9**5)
    alive = within_steps(model, 5, start=["rope"], survive=True)
    assert solve(MaxProb(alive, ("rope", 0))).objective == pytest.approx(1.0)
    with pytest.raises(ModelError, match="label 'falen'; did you mean 'fallen'"):
        within_steps(model, 5, survive=["falen"])
