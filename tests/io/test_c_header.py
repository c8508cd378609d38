"""Headers of C act as the policies that they were written from, compiled as C99."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from cases import NAMES, expected, published
from drawn_policies import drawn_model, drawn_policy
from formulations import MCMP, S3P, MaxProb
from played import START, ferry, hall, level_policy, policies, remembering, task
from ssp_lp import GIVE_UP, ModelError, acting_everywhere, solve
from ssp_lp.io import write_c_header
from ssp_lp.policies.policy import as_lottery

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
        for step in range(25):
            action = player.action(model.states[state])
            if action is None:
                break
            queries.append(f"{number} {int(step == 0)} {state} {total / unit!r} {uniform!r}")
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
    with pytest.raises(ModelError, match="name in C"):
        write_c_header(policies(hall())["mixed"], tmp_path / "policy.h", name="1st")
