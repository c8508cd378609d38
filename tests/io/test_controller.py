"""Controllers, in JSON and in C, do what the policy does."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ssp_lp.io.controller
from cases import NAMES, expected, published
from drawn_policies import drawn_model, drawn_policy
from formulations import MCMP, S3P, MaxProb
from named_policies import made, start_of
from played import START, ferry, hall, level_policy, policies, remembering, step, task
from refusing import refused
from ssp_lp import (
    GIVE_UP,
    SSP,
    CostAwarePolicy,
    DeterministicPolicy,
    Memory,
    ModelError,
    acting_everywhere,
    end_probability,
    on_original,
    product,
    solve,
    visits,
)
from ssp_lp.io import Controller, fingerprint, write_c_header, write_controller
from ssp_lp.policies.policy import as_lottery

# Controllers act as the policies that they were written from, with the standard library alone.


SOURCE = Path(ssp_lp.io.controller.__file__)


def written(policy, tmp_path):
    write_controller(policy, tmp_path / "controller.json")
    return Controller(tmp_path / "controller.json")


def acts_the_same(policy, tmp_path, start=START, episodes=60, surprise=20.0):
    """Policy and controller side by side, through random episodes of the model."""
    rng, model, controller = np.random.default_rng(1), policy.model, written(policy, tmp_path)
    for _ in range(episodes):
        episode = policy.start()
        controller.reset()
        state = start
        for _ in range(60):
            action = episode.action(state)
            assert controller.action(state) == ("give up" if action is GIVE_UP else action)
            assert controller.failed == episode.failed
            if action in (GIVE_UP, None):
                break
            state, cost = step(model, state, action, rng)
            cost += surprise * (rng.random() < 0.1)  # so that all of a memory is seen
            episode.observe(state, cost)
            controller.observe(state, cost)


@pytest.mark.parametrize("name", ["deterministic", "gives up", "solution", "levels", "remembering"])
def test_every_member_of_a_policy_acts_the_same(name, tmp_path):
    for member in as_lottery(made()[name]).policies:
        acts_the_same(member, tmp_path, start_of(name))


@pytest.mark.slow
def test_every_memory_of_a_cost_aware_policy(tmp_path):
    """Random decisions, thresholds and tails, so that nothing can be mixed up."""
    model, rng = hall(), np.random.default_rng(5)
    count = np.diff(model.pair_offsets)
    drawn = rng.integers(-1, 2, size=(6, model.n_states))
    tails = rng.integers(0, 2, size=(2, model.n_states)) + model.pair_offsets[:-1]
    drawn, tails = (np.where(count > 0, choice, -2) for choice in (drawn, tails))
    thresholds = np.where(rng.random(model.n_states) < 0.5, 7.0, np.inf)
    policy = CostAwarePolicy(model, 0.5, drawn, tails, thresholds)
    only_tails = replace(policy, decision=np.zeros((0, model.n_states), dtype=np.int64))
    for some in (policy, only_tails):
        acts_the_same(some, tmp_path, episodes=300)


def dear(count, state, action, successor, cost):
    """How often a step was dear: it depends on the cost alone."""
    return min(count + (cost == 2.0), 1)


@pytest.mark.slow
def test_policies_that_count_steps_and_carry_memories_of_tasks(tmp_path):
    """By the action and by the cost, one within the other, with a horizon around both."""
    for criterion in (MCMP, S3P):
        solution = solve(criterion(hall(), START, failure_budget=0.7, horizon=3))
        for member in solution.policy.policies:
            acts_the_same(member, tmp_path, episodes=100)
    both = product(task(hall()), Memory(start=0, update=dear))
    start = both.start((START, 0))
    inner = solve(S3P(both, start, failure_budget=0.6, horizon=6)).policy
    for member in on_original(on_original(inner)).policies:
        acts_the_same(member, tmp_path, episodes=300, surprise=0.0)


@pytest.mark.parametrize("name", ["mixed", "stochastic", "carried"])
def test_random_policies_have_the_same_distribution(name, tmp_path):
    """Frequencies of the first two actions, four standard deviations wide."""
    policy, runs = made()[name], 2000
    controller, rng = written(policy, tmp_path), np.random.default_rng(2)
    twin, mine, theirs = Controller(tmp_path / "controller.json"), {}, {}
    for k in range(runs):
        episode = policy.start(rng, world="other")
        controller.reset(k)
        twin.reset(k)
        for player, found in ((episode, mine), (controller, theirs)):
            first = player.action(START)
            there = START if name == "carried" else ("hall", 1)
            player.observe(there, 1.0)
            second = player.action(there)
            seen = first, "give up" if second is GIVE_UP else second
            found[seen] = found.get(seen, 0) + 1
        assert twin.action(START) == first  # one seed, one episode
    for seen in mine | theirs:
        apart = abs(mine.get(seen, 0) - theirs.get(seen, 0)) / runs
        assert apart <= 4.0 * np.sqrt(2.0 * 0.25 / runs), seen


@pytest.mark.parametrize("name", ["stochastic", "carried", "cost aware", "solution"])
def test_the_file_holds_every_probability(name, tmp_path):
    """Decision by decision, against the policy's table."""
    policy = made()[name]
    write_controller(policy, tmp_path / "controller.json")
    told = json.loads((tmp_path / "controller.json").read_text())
    actions = [tuple(a) if isinstance(a, list) else a for a in told["actions"]] + [GIVE_UP]
    found = {}
    for k, (member, own) in enumerate(
        zip(told["members"], as_lottery(policy).policies, strict=True)
    ):
        words = [word for _, word in own.memories()]
        for word, decisions in zip(words, member["decision"], strict=True):
            for state, choice in zip(policy.model.states, decisions, strict=True):
                for code, share in choice if isinstance(choice, list) else [(choice, 1.0)]:
                    if code >= -1:
                        found[k, state, word, actions[code]] = share
    rows = policy.table()
    assert found == {(r.member, r.state, r.memory, r.action): r.probability for r in rows}


def shelves(**parts):
    """A state with two actions that is left for itself, for one that rests, or for the goal."""
    model = SSP.from_transitions(
        {
            "x": {
                "a": [(0.5, "x", 1.0), (0.25, "rest", 0.5), (0.25, "g", 1.0)],
                "b": [(0.5, "x", 1.0), (0.5, "g", 1.0)],
            },
            "rest": {},
        },
        goal={"g"},
        treat_actionless_as_dead_ends=True,
    )
    drawn = np.array([[k % 2, -2, -2] for k in range(4)])
    tails = np.array([[0, -2, -2], [1, -2, -2]])
    parts = {"unit": 1.0, "tail_threshold": np.array([6.0, np.inf, np.inf])} | parts
    return CostAwarePolicy(model, decision=drawn, tails=tails, **parts)


def played_costs(policy, costs, tmp_path):
    """Actions of a policy and of its controller where each step leads back and costs so much."""
    said = []
    controller, episode = written(policy, tmp_path), policy.start(world="other")
    controller.reset(0, world="other")
    for player in (episode, controller):
        for cost in costs:
            player.action("x")
            player.observe("x", cost)
        said.append(player.action("x"))
    return said


@pytest.mark.parametrize(
    ("costs", "level"),
    [([0.5], 0), ([1.5], 1), ([2.5], 2), ([3.5], 3), ([0.5 + 1e-9], 1), ([1.0, 0.5, 0.5], 1)],
)
def test_a_total_half_way_between_two_levels_is_the_lower_one(costs, level, tmp_path):
    """Levels 0, 1, 2, 3 below 4: even ones take ``a``, odd ones ``b``, in policy and controller."""
    policy = shelves(levels=np.arange(5.0))
    assert played_costs(policy, costs, tmp_path) == ["ab"[level % 2]] * 2


@pytest.mark.parametrize("levels", [None, np.arange(5.0)])
@pytest.mark.parametrize(("total", "action"), [(5.0, "a"), (6.0, "b"), (7.0, "b")])
def test_the_last_tail_begins_at_its_threshold(levels, total, action, tmp_path):
    assert played_costs(shelves(levels=levels), [total], tmp_path) == [action] * 2


def test_a_last_step_may_cost_what_is_no_whole_number_of_units(tmp_path):
    """Where nothing is decided any more nothing is counted: at the goal, and in a state of rest."""
    for there in ("g", "rest"):
        controller, episode = written(shelves(), tmp_path), shelves().start(world="other")
        controller.reset(0, world="other")
        for player in (episode, controller):
            assert player.action("x") == "a"
            player.observe(there, 0.37)
            assert player.action(there) is None


def test_the_last_step_of_a_horizon_may_cost_anything(tmp_path):
    """Two tries, of which both count: what the second one costs is remembered by nobody."""
    tries = SSP.from_transitions(
        {"x": {"a": [(0.5, "x", 1.0), (0.25, "g", 1.0), (0.25, "g", 3.0)]}}, goal={"g"}
    )
    (policy,) = solve(S3P(tries, "x", failure_budget=0.3, horizon=2)).policy.policies
    controller, episode = written(policy, tmp_path), policy.start(world="other")
    controller.reset(0, world="other")
    for player in (episode, controller):
        for cost in (1.0, 0.37):
            assert player.action("x") == "a"
            player.observe("x", cost)
        assert player.action("x") in (GIVE_UP, "give up")
    for player in (policy.start(world="other"), controller):
        if player is controller:
            controller.reset(0, world="other")
        player.action("x")
        words, errors = "not a multiple of the unit", (ModelError, ValueError)
        refused(words, player.observe, "x", 0.37, error=errors)


CLIFF = SSP.from_transitions(
    {
        "a": {"over": [(0.9, "home", 1.0), (0.1, "edge", 1.0)], "round": [(1.0, "home", 3.0)]},
        "edge": {
            "slide": [(0.5, "edge", 1.0), (0.5, "ledge", 2.0)],
            "climb": [(1.0, "home", 9.0)],
        },
        "ledge": {"drop": [(1.0, "grave", 1.0)], "cling": [(0.8, "ledge", 1.0), (0.2, "cave", 0)]},
        "cave": {"sit": [(1.0, "cave", 1.0)]},
        "far": {"fly": [(0.5, "home", 1.0), (0.5, "grave", 1.0)], "walk": [(1.0, "a", 3.0)]},
        "grave": {},
    },
    {"home"},
    state_labels={"crash": ["grave"], "seen": ["ledge"]},
    treat_actionless_as_dead_ends=True,
)


@pytest.mark.slow
@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("horizon", [None, 5])
@pytest.mark.parametrize("name", ["crash", "seen"])
def test_policies_that_remember_having_failed(criterion, horizon, name, tmp_path):
    """Side by side after failing, too, and of those that act everywhere from every state."""
    counted = visits("seen", through_failure=True) if name == "seen" else end_probability("crash")
    limits = {name: counted <= 0.03}
    problem = criterion(CLIFF, "a", 0.1, constraints=limits, horizon=horizon)
    solution = solve(problem)
    for member in solution.policy.policies:
        acts_the_same(member, tmp_path, "a", 60, surprise=0.0)
    for member in solution.policy_everywhere({"cave": "sit"}).policies:
        for start in CLIFF.states:
            acts_the_same(member, tmp_path, start, 6, surprise=0.0)


@pytest.mark.parametrize("name", ["deterministic", "gives up", "cost aware"])
def test_policies_that_act_everywhere(name, tmp_path):
    policy = acting_everywhere(made()[name])
    for start in policy.model.states:
        acts_the_same(policy, tmp_path, start)


def test_the_file_runs_without_the_library(tmp_path):
    """Copied into an empty folder, in a process that sees no installed package."""
    policy = made()["cost aware"]
    write_controller(policy, tmp_path / "controller.json")
    (tmp_path / "controller.py").write_text(SOURCE.read_text(encoding="utf-8"), encoding="utf-8")
    code = (
        "import sys; sys.path.insert(0, '.'); from controller import Controller\n"
        "c = Controller('controller.json'); c.reset(0)\n"
        "print([c.action(('hall', 0)), c.observe(('hall', 0), 99.0), c.action(('hall', 0))])\n"
        "print('numpy' in sys.modules, 'ssp_lp' in sys.modules)"
    )
    told = subprocess.run(  # noqa: S603
        [sys.executable, "-I", "-S", "-c", code],
        cwd=tmp_path, capture_output=True, text=True, check=True, env={**os.environ},
    ).stdout.splitlines()  # fmt: skip
    episode = policy.start()
    first = episode.action(START)
    episode.observe(START, 99.0)
    late = episode.action(START)
    assert told[0] == str([first, None, "give up" if late is GIVE_UP else late])
    assert told[1] == "False False"


def test_what_a_controller_refuses(tmp_path):
    policy = made()["cost aware"]
    controller, other = written(policy, tmp_path), Controller(tmp_path / "controller.json")
    refused("reset", controller.action, START, error=RuntimeError)
    controller.reset()
    refused("before the first action", controller.observe, START, 1.0, error=RuntimeError)
    controller.action(START)
    for cost in (0.5, -1.0, float("nan"), float("inf"), 10**400):
        refused("observed cost", controller.observe, START, cost, error=ValueError)
    for state in ("window", 1.5, None, ["hall", 0], {"hall"}):
        refused("not a state", controller.action, state, error=ValueError)
    refused("not in state 'pit'", controller.action, "pit", error=ValueError)
    other.reset()
    for player in (policy.start(), other):  # a cost beyond all layers
        player.action(START)
        words, errors = "not a multiple of the unit", (ModelError, ValueError)
        refused(words, player.observe, ("hall", 0), 1e30, error=errors)


def test_what_cannot_be_written(tmp_path):
    path = tmp_path / "controller.json"
    refused("TimedPolicy", write_controller, made()["timed"], path)
    for state, action, words in ((frozenset("a"), "go", "cannot be"), ("a", "give up", "called")):
        model = SSP.from_transitions({state: {action: [(1.0, "b", 1.0)]}}, goal={"b"})
        policy = DeterministicPolicy.from_actions(model, {state: action})
        refused(words, write_controller, policy, path)


def test_labels_come_back_as_they_were(tmp_path):
    labels = [("a", (1, 2.5)), 3, 0.1, "x", None, True]
    after = [*labels[1:], "end"]
    steps = zip(labels, after, strict=True)
    rows = {label: {("go", label): [(1.0, to, 1.0)]} for label, to in steps}
    model = SSP.from_transitions(rows, goal={"end"})
    policy = DeterministicPolicy.from_actions(model, {label: ("go", label) for label in labels})
    acts_the_same(policy, tmp_path, labels[0])
    numbered = SSP.from_arrays(
        pair_offsets=[0, 1, 1], outcome_offsets=[0, 1], successors=[1], probabilities=[1.0],
        costs=[1.0], goal_states=[1],
    )  # fmt: skip
    plain = DeterministicPolicy(numbered, np.array([0, -2]))
    acts_the_same(plain, tmp_path, 0)


def test_a_damaged_file_is_refused_with_the_reason(tmp_path):
    """Whatever is cut off, missing or changed, anywhere in it."""
    path = tmp_path / "controller.json"
    write_controller(made()["solution"], path)
    text = path.read_text()
    told = json.loads(text)
    assert Controller(path).model == fingerprint(hall())
    assert repr(Controller(path)) == f"Controller(model {told['model'][:16]}, 5 states, members: 2)"
    damaged = [text[: len(text) // 2], "", "[" * 100_000, text.replace('ht":0.', 'ht":1.')]
    damaged += [json.dumps({k: v for k, v in told.items() if k != name}) for name in told]
    damaged += [json.dumps(told | {name: None}) for name in told]
    damaged += [json.dumps(told | {"ends": [0]}), json.dumps(told | {"version": 2})]
    damaged += ['{"format": "other"}', "[]"]
    for one in damaged:
        path.write_text(one)
        words = r"damaged|is not an ssp-lp controller file|has version"
        refused(words, Controller, path, error=ValueError)
    path.write_bytes(b"\xff\xfe\x00")
    refused("is not an ssp-lp controller file", Controller, path, error=ValueError)


# Headers of C act as the policies that they were written from, compiled as C99.


GCC = shutil.which("gcc") or shutil.which("cc")
LARGE = 1_000

WITH_GOALS = [name for name in NAMES if name != "qcomp23_rov_B10"]  # a query of total rewards

COSTS = {case["model"]: case["cost"] for case in expected()["cases"]}
CODES = {GIVE_UP: -1, None: -2}

needs_gcc = pytest.mark.skipif(GCC is None, reason="there is no compiler of C")


def compiled(named: dict[str, object], folder: Path) -> Path:
    """A program that answers queries "policy begins state total uniform", one a line."""
    includes, branches = [], []
    for k, (name, policy) in enumerate(named.items()):
        write_c_header(policy, folder / f"{name}.h", name=name)
        includes.append(f'#include "{name}.h"')
        branches.append(
            f"if (which == {k}) {{ static {name}_episode e; const {name}_episode none = "
            f"{name}_BEGIN; if (begins) e = none; "
            f'printf("%d\\n", {name}_action(&e, state, total, uniform)); }}'
        )
    lines = ["#include <stdio.h>", *includes, "int main(void) {"]
    lines += ["int which, begins, state; double total, uniform;"]
    lines += ['while (scanf("%d %d %d %lf %lf", &which, &begins, &state, &total, &uniform) == 5) {']
    lines += [*branches, "}", "return 0; }"]
    (folder / "main.c").write_text("\n".join(lines))
    strict = ["-std=c99", "-pedantic-errors", "-Wall", "-Wextra", "-Werror", "-O1"]
    subprocess.run(  # noqa: S603
        [GCC, *strict, "-o", "main", "main.c"], cwd=folder, check=True
    )
    return folder / "main"


def played(policy, number: int, start: int, rng, episodes: int) -> tuple[list[str], list[int]]:
    """Queries of some episodes, begun in different states, and what the policy answers."""
    lottery = as_lottery(policy)
    model, queries, answers = lottery.model, [], []
    upto = np.cumsum(lottery.weights)
    units = {member_unit(member) for member in lottery.policies} - {None}
    unit = next(iter(units), 1.0)
    codes = {name: k for k, name in enumerate(model.action_names)} | CODES
    for episode in range(episodes):
        first = float(rng.random())
        k = min(int(np.searchsorted(upto, first, side="right")), len(upto) - 1)
        player = lottery.policies[k].start(0)
        state, total, uniform = (
            start if episode % 2 else int(rng.integers(model.n_states)),
            0.0,
            first,
        )
        if not episode % 2 and not acts_in(lottery.policies[k], state):
            state = start
        for turn in range(25):
            action = player.action(model.states[state])
            if action is None:
                break
            queries.append(f"{number} {int(turn == 0)} {state} {total / unit!r} {uniform!r}")
            answers.append(codes[action])
            if action is GIVE_UP:
                break
            pair = next(
                p
                for p in range(*model.pair_offsets[state : state + 2].tolist())
                if model.action_of(p) == action
            )
            begin, end = model.outcome_offsets[pair : pair + 2].tolist()
            outcome = int(rng.choice(np.arange(begin, end), p=model.probabilities[begin:end]))
            state, cost = int(model.successors[outcome]), float(model.costs[outcome])
            player.observe(model.states[state], cost)
            total, uniform = total + cost, float(rng.random())
    return queries, answers


def member_unit(member) -> float | None:
    """The unit of what a member counts; None: none, or totals themselves."""
    plan = getattr(member, "inner", member)
    return getattr(plan, "unit", None) if getattr(plan, "levels", None) is None else None


def acts_in(member, state: int) -> bool:
    """Whether a policy has a decision where an episode begins in a state."""
    if member.ended[state]:
        return False
    states = np.array([state])
    return bool((member.branches(states, member.start_memory(states)).pair != -2).all())


def check(named: dict[str, object], start: int, folder: Path, episodes: int = 40) -> None:
    """The same answers, query by query."""
    rng, program = np.random.default_rng(4), compiled(named, folder)
    every = [played(policy, k, start, rng, episodes) for k, policy in enumerate(named.values())]
    queries = [line for lines, _ in every for line in lines]
    told = subprocess.run(  # noqa: S603
        [program], input="\n".join(queries), capture_output=True, text=True, check=True
    ).stdout.split()
    assert [int(word) for word in told] == [answer for _, answers in every for answer in answers]
    assert len(told) > episodes


@needs_gcc
@pytest.mark.parametrize("name", WITH_GOALS[::3])
def test_published_models(name: str, tmp_path: Path) -> None:
    """Stationary, mixed and cost-aware policies, as planned and acting everywhere."""
    model, start = published(name, COSTS.get(name, "unit"))
    budget = min(solve(MaxProb(model, start)).failure_probability + 0.1, 1.0)
    criteria = {"mixed": MCMP} if model.n_states > LARGE else {"mixed": MCMP, "aware": S3P}
    solved = {kind: solve(criterion(model, start, budget)) for kind, criterion in criteria.items()}
    everywhere = {f"{kind}_everywhere": one.policy_everywhere() for kind, one in solved.items()}
    check({kind: one.policy for kind, one in solved.items()} | everywhere, start, tmp_path)


@pytest.mark.slow
@needs_gcc
def test_policies_of_every_kind(tmp_path: Path) -> None:
    made = policies(hall())
    names = ("deterministic", "gives up", "cost aware", "mixed", "solution")
    named = {name.replace(" ", "_"): made[name] for name in names}
    named["quits"] = acting_everywhere(made["gives up"])
    check(named, hall().index_of(START), tmp_path, 200)


@needs_gcc
@pytest.mark.parametrize("on_levels", [False, True])
def test_drawn_policies(on_levels: bool, tmp_path: Path) -> None:
    """Any decisions, tails and thresholds, and totals that are rounded at each step."""
    named = {}
    for seed in range(8):
        draw = np.random.default_rng(seed)
        model = drawn_model(draw, [0.0, 0.5, 1.5])
        policy = drawn_policy(draw, model, on_levels=on_levels)
        named[f"drawn_{seed}"] = policy if seed % 2 else acting_everywhere(policy)
    check(named, 0, tmp_path)


@needs_gcc
def test_totals_that_are_sums(tmp_path: Path) -> None:
    policy = level_policy(ferry())
    check({"ferry": policy}, policy.model.index_of("quay"), tmp_path, 200)


@needs_gcc
def test_actions_that_are_drawn_have_their_probabilities(tmp_path: Path) -> None:
    policy, rng = policies(hall())["stochastic"], np.random.default_rng(0)
    program, model = compiled({"drawn": policy}, tmp_path), policy.model
    for state in range(model.n_states):
        found = policy.branches(np.array([state]), np.array([0]))
        uniform = rng.random(4_000)
        queries = "\n".join(f"0 1 {state} 0 {u!r}" for u in uniform.tolist())
        told = subprocess.run(  # noqa: S603
            [program], input=queries, capture_output=True, text=True, check=True
        ).stdout.split()
        upto = np.cumsum(found.probability)
        drawn = found.pair[np.searchsorted(upto, uniform, side="right")]
        expected_codes = np.where(drawn < 0, drawn, model.pair_action[drawn])
        assert [int(word) for word in told] == expected_codes.tolist()


def test_what_a_header_cannot_hold(tmp_path: Path) -> None:
    for policy, words in (
        (policies(hall())["timed"], "TimedPolicy"),
        (policies(hall())["carried"], "StochasticPolicy"),
        (remembering(task(hall())), "RememberingPolicy"),
    ):
        with pytest.raises(ModelError, match=words):
            write_c_header(policy, tmp_path / "policy.h")
    with pytest.raises(ModelError, match="identifier in C"):
        write_c_header(policies(hall())["mixed"], tmp_path / "policy.h", name="1st")
