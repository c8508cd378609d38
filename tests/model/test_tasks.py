"""Tasks: formulas over finite traces as limits, and as the goal."""

from collections import Counter

import pytest

from formulations import MCMP, S3P, LeastQuantity, MaxProb
from refusing import refused
from ssp_lp import (
    SSP,
    Memory,
    ModelWarning,
    certify,
    evaluate,
    exceeds,
    expected_cost,
    holds,
    on_original,
    product,
    reach,
    simulate,
    solve,
    task,
    visits,
    within,
)
from tests.campaigns import drawn_tasks

HOUSE = SSP.from_transitions(
    {
        "hall": {
            "up": [(0.8, "attic", 1.0), (0.2, "hall", 1.0)],
            "leave": [(0.9, "out", 1.0), (0.1, "pit", 1.0)],
            "wait": [(1.0, "hall", 1.0)],
        },
        "attic": {"down": [(1.0, "hall", 1.0)], "jump": [(0.5, "out", 0.5), (0.5, "pit", 0.5)]},
        "pit": {},
    },
    {"out"},
    state_labels={"key": ["attic"], "door": ["out"]},
    dead_ends=["pit"],
)
KEY_FIRST = task("F key & (!door U key)")


def test_draws_against_the_definition_and_all_histories():
    tally = Counter()
    for seed in range(150):
        assert list(drawn_tasks.told(seed, tally, traces=20)) == []
    assert tally["held"] > 50
    assert tally["reached"] > 30


@pytest.mark.parametrize(
    ("text", "chance"),
    [
        ("F key", 0.9),
        ("F key & (!door U key)", 0.9),
        ("X key", 0.72),  # straight up, then down and out
        ("G !up", 0.9),
        ("F jump", 0.5),
        ("F (key & jump)", 0.5),
        ("X X X true", 0.9),  # three steps: wait, or up and down
        ("!X true", 0.0),  # the first position is the last
        ("F (door & N false)", 0.9),
        ("F (door & X true)", 0.0),
        ("F (up & X !up)", 0.9),
        ("key R !door", 0.9),
        ('G ("up" -> X (key | up))', 0.9),
    ],
)
def test_the_greatest_probability_of_a_task(text, chance):
    broken = LeastQuantity(HOUSE, "hall", quantity=1.0 - holds(task(text)))
    assert solve(broken).objective == pytest.approx(1.0 - chance, abs=1e-9)


def test_a_limit_on_a_task_has_a_price_and_a_proof():
    for criterion in (MCMP, S3P):
        limits = {"key first": holds(KEY_FIRST) >= 0.5}
        problem = criterion(HOUSE, "hall", 0.1, constraints=limits)
        solution = solve(problem)
        assert certify(solution).accepted
        assert solution.secondary_costs["key first"] == pytest.approx(0.5)
        assert solution.prices["key first"] > 0.0
        assert solve(problem, "lp").objective == pytest.approx(solution.objective)
        assert solution.policy.model is HOUSE
    assert "X key" not in str(solution.policy_table())


def test_the_task_as_a_limit_is_the_memory_written_by_hand():
    memory = Memory(
        start=False,
        update=lambda has, state, action, to, cost: has or to == "attic",
        accepts=lambda has: has,
    )
    made = product(HOUSE, memory)
    by_hand = solve(MCMP(made, made.start("hall"), 0.15)).objective
    limits = {"key": holds(task("F key")) >= 0.85}
    assert solve(MCMP(HOUSE, "hall", 0.15, constraints=limits)).objective <= by_hand + 1e-9
    always = {"key": holds(task("F key")) >= 0.9}
    surely = solve(MCMP(HOUSE, "hall", 0.1, constraints=always)).objective
    assert surely == pytest.approx(solve(MCMP(made, made.start("hall"), 0.1)).objective)


def test_a_task_and_totals_together():
    limits = {
        "key": holds(KEY_FIRST) >= 0.6,
        "soon": within(expected_cost(), 3) >= 0.5,
        "late": exceeds(expected_cost(), 5) <= 0.02,
        "visits": visits("hall") <= 2.5,
    }
    problem = MCMP(HOUSE, "hall", 0.2, constraints=limits, horizon=8)
    solution = solve(problem)
    assert certify(solution).accepted
    found = evaluate(solution.policy, problem)
    assert found.secondary_costs["key"] >= 0.6 - 1e-9
    assert found.secondary_costs["soon"] >= 0.5 - 1e-9
    assert found.secondary_costs["late"] <= 0.02 + 1e-9
    played = simulate(solution.policy, problem, episodes=20_000)
    low, high = played.failure_probability.low, played.failure_probability.high
    assert low - 0.01 <= solution.failure_probability <= high + 0.01


def test_the_episode_of_a_task_is_played_on_the_model():
    limits = {"key": holds(KEY_FIRST) >= 0.9}
    episode = solve(MCMP(HOUSE, "hall", 0.1, constraints=limits)).policy.start(0)
    for state, action, to in [
        ("hall", "up", "hall"),
        ("hall", "up", "attic"),
        ("attic", "down", "hall"),
        ("hall", "leave", "out"),
    ]:
        assert episode.action(state) == action
        episode.observe(to, 1.0)
    assert episode.action("out") is None


def test_a_task_as_the_goal():
    made = reach(HOUSE, task("F key"), start=["hall"])
    solution = solve(MCMP(made, made.start("hall"), 0.0))
    assert solution.objective == pytest.approx(1.25)
    episode = on_original(solution.policy).start(0)
    assert episode.action("hall") == "up"
    episode.observe("attic", 1.0)
    assert episode.action("attic") is None
    assert not episode.failed
    back = reach(HOUSE, task("F (key & X !key)"), start=["hall"])
    by_jumping = 1.25 + 0.5  # wherever that ends: the pit has no key either
    assert solve(MCMP(back, back.start("hall"), 0.0)).objective == pytest.approx(by_jumping)
    out = reach(HOUSE, task("F key & F door"), start=["hall"])
    assert solve(MaxProb(out, out.start("hall"))).objective == pytest.approx(0.9)
    assert out.states[int(out.state_labels["goal not accepted"][0])][0] == "out"
    with pytest.warns(ModelWarning, match="the start 'hall' satisfies"):
        reach(HOUSE, task("G !key"), start=["hall"])
    refused("no run from the start satisfies", reach, HOUSE, task("false"), start=["hall"])
    refused(r"reach\(\) takes task", reach, HOUSE, "F key", start=["hall"])
    refused("is not a state", reach, HOUSE, task("F key"), start=["hell"])


def test_the_automaton_prints_and_draws():
    automaton = KEY_FIRST.automaton(HOUSE)
    assert automaton.words == ("(!door U key) & F key", "true")
    words = str(automaton)
    assert "(!door U key) & F key  true" in words
    assert automaton.dot().startswith("digraph {")
    assert '"true" -> "true"' in automaton.dot()


@pytest.mark.parametrize(
    ("text", "told", "column"),
    [
        ("F key &", "a name, a bracket, or one of", 7),
        ("F (key", "expected a closing bracket", 6),
        ("key @ door", "not a name or an operator", 4),
        ("F key) & door", "an operator", 5),
        ("", "a name, a bracket, or one of", 0),
        ("key & U door", "a name, a bracket, or one of", 6),
        ('F "key', "not a name or an operator", 2),
    ],
)
def test_a_caret_shows_where_the_text_is_no_formula(text, told, column):
    words = refused(told, task, text).splitlines()
    assert words[1:] == [f"  {text}", f"  {' ' * column}^"]


def test_names_are_labels_or_actions():
    refused("neither a label of states nor an action; did you mean 'key'", _automaton, "F kay")
    refused("it is a state: give it a label", _automaton, "F attic")
    both = SSP.from_transitions({"a": {"go": [(1.0, "b", 1.0)]}}, {"b"}, state_labels={"go": ["a"]})
    refused("'go' is a state label and an action: rename one", task("F go").automaton, both)
    refused(r"holds\(\) takes a task", holds, "F key")


def _automaton(text):
    return task(text).automaton(HOUSE)


def test_operators_bind_as_documented():
    for text, same in [
        ("!key U door & key", "((!key) U door) & key"),
        ("key | door & up", "key | (door & up)"),
        ("key -> door -> up", "key -> (door -> up)"),
        ("key U door U up", "key U (door U up)"),
        ("key <-> door | up", "key <-> (door | up)"),
        ("X key U door", "(X key) U door"),
        ("F G !key", "F (G (!key))"),
    ]:
        assert task(text).formula == task(same).formula


def test_too_many_names_and_too_deep_formulas_are_refused_by_name():
    model = SSP.from_transitions({"a": {f"a{i}": [(1.0, "g", 1.0)] for i in range(70)}}, goal={"g"})
    every = task(" | ".join(f"a{i}" for i in range(70)))
    refused("it has 70 names, more than 62", every.automaton, model)
    for text in ("(" * 2000 + "a0" + ")" * 2000, "X " * 2000 + "a0"):
        refused("nested too deeply", task, text)
