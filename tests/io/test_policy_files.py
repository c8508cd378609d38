"""Policies in files: read in another process beside a model built anew, they play the same."""

import importlib
import json
import os
import pkgutil
import subprocess
import sys
from dataclasses import replace
from enum import Enum
from fractions import Fraction

import numpy as np
import pytest

import ssp_lp.policies
from formulations import S3P
from played import START, everywhere, ferry, hall, level_policy, policies, remembering, task, traces
from ssp_lp import SSP, MixedPolicy, ModelError, evaluate, product, solve
from ssp_lp.io import fingerprint, load_policy, save_policy
from ssp_lp.io.archives import _CLASSES
from ssp_lp.policies.policy import Policy

NAMES = sorted(policies(hall()))

READER = """
import json, sys
from played import START, hall, traces
from ssp_lp.io import fingerprint, load_policy
model = hall()
policy = load_policy(sys.argv[1], model)
print(json.dumps([fingerprint(model), traces(policy, START, 7)]))
"""


def elsewhere(code, *arguments):
    """What a new process prints."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONHASHSEED": "12345"}
    ran = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        env=env,
        check=True,
    )
    return ran.stdout


@pytest.mark.parametrize("name", NAMES)
def test_policies_play_the_same_beside_a_model_built_anew(name, tmp_path):
    policy, model = policies(hall())[name], hall()
    save_policy(policy, tmp_path / "policy.npz")
    found = load_policy(tmp_path / "policy.npz", model)
    assert type(found) is type(policy)
    assert found.model is model
    assert repr(found) == repr(policy)
    assert traces(found, START, 3) == traces(policy, START, 3)


@pytest.mark.parametrize("name", ["solution", "carried"])
def test_a_new_process_plays_the_same(name, tmp_path):
    model = hall()
    policy = policies(model)[name]
    save_policy(policy, tmp_path / "policy.npz")
    told = json.loads(elsewhere(READER, str(tmp_path / "policy.npz")))
    played = json.loads(json.dumps(traces(policy, START, 7)))
    assert told == [fingerprint(model), played]


def test_policies_by_cost_levels(tmp_path):
    policy = level_policy(ferry())
    save_policy(policy, tmp_path / "policy.npz")
    found = load_policy(tmp_path / "policy.npz", ferry())
    assert repr(found) == repr(policy)
    assert traces(found, "quay", 5) == traces(policy, "quay", 5)


def test_a_policy_that_carries_a_memory_is_read_beside_the_product(tmp_path):
    policy = remembering(task(hall()))
    save_policy(policy, tmp_path / "policy.npz")
    again = task(hall())
    found = load_policy(tmp_path / "policy.npz", again)
    assert found.model is again.original
    assert traces(found, START, 5) == traces(policy, START, 5)
    with pytest.raises(ModelError, match="load it beside product"):
        load_policy(tmp_path / "policy.npz", hall())


def test_another_model_is_refused_unless_it_differs_on_purpose(tmp_path):
    save_policy(everywhere(hall(), "fast"), tmp_path / "policy.npz")
    with pytest.raises(ModelError, match=r"fingerprint .* check=False"):
        load_policy(tmp_path / "policy.npz", hall(4.0))
    found = load_policy(tmp_path / "policy.npz", hall(4.0), check=False)
    assert found.actions() == everywhere(hall(4.0), "fast").actions()
    for check in (True, False):
        with pytest.raises(ModelError, match="other pairs"):
            load_policy(tmp_path / "policy.npz", ferry(), check=check)


def test_files_that_are_none_are_refused(tmp_path):
    path = tmp_path / "policy.npz"
    path.write_text("no archive")
    with pytest.raises(ModelError, match="no ssp-lp policy file"):
        load_policy(path, hall())
    np.savez(path, decision=np.zeros(3))
    with pytest.raises(ModelError, match="no ssp-lp policy file"):
        load_policy(path, hall())
    np.savez(path, header=np.array([{"a": 1}], dtype=object))  # pickled: never opened
    with pytest.raises(ModelError, match="no ssp-lp policy file"):
        load_policy(path, hall())
    for header, words in (
        ({"format": "ssp-lp solution", "version": 1}, "no ssp-lp policy file"),
        ({"format": "ssp-lp policy", "version": 99}, "version 99, .* newer ssp-lp"),
        ({"format": "ssp-lp policy", "version": 0}, "version 0, .*: write the policy anew"),
        ({"format": "ssp-lp model", "version": 1}, "no ssp-lp policy file: it says 'ssp-lp model'"),
        ([1], "no ssp-lp policy file"),
    ):
        np.savez(path, header=np.frombuffer(json.dumps(header).encode(), dtype=np.uint8))
        with pytest.raises(ModelError, match=words):
            load_policy(path, hall())


def test_a_policy_of_a_class_of_its_own_is_refused_by_name(tmp_path):
    class Secretive(Policy):
        start_memory = branches = remember = None

    policy = object.__new__(type("Whim", (Secretive,), {"__abstractmethods__": frozenset()}))
    policy.model = hall()
    with pytest.raises(ModelError, match="Whim"):
        save_policy(MixedPolicy((policy,), np.ones(1)), tmp_path / "policy.npz")
    assert not (tmp_path / "policy.npz").exists()


def test_a_policy_of_a_horizon_is_read_beside_the_model_as_stated(tmp_path):
    problem = S3P(hall(), START, 0.7, horizon=3)
    solution = solve(problem)
    save_policy(solution.policy, tmp_path / "policy")
    loaded = load_policy(tmp_path / "policy", problem.model)
    assert loaded.model is problem.model
    assert evaluate(loaded, problem) == evaluate(solution.policy, problem)
    with pytest.raises(ModelError, match="other pairs"):
        load_policy(tmp_path / "policy", with_labels("start"))


def test_every_class_of_policies_can_be_saved():
    for module in pkgutil.iter_modules(ssp_lp.policies.__path__):
        found = vars(importlib.import_module(f"ssp_lp.policies.{module.name}")).values()
        classes = {made for made in found if isinstance(made, type) and issubclass(made, Policy)}
        assert classes - {Policy} <= set(_CLASSES.values())


def test_the_same_policy_gives_the_same_file_and_parts_are_kept_once(tmp_path):
    fast = everywhere(hall(), "fast")
    for name, count in (("one", 1), ("again", 1), ("many", 50)):
        save_policy(MixedPolicy((fast,) * count, np.ones(count) / count), tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "again").read_bytes()
    with np.load(tmp_path / "many") as file:
        assert len(file.files) == 3  # header, weights, one decision


class Colour(Enum):
    RED = 1


def with_labels(label):
    return SSP.from_transitions({label: {"go": [(1.0, "end", 1.0)]}}, goal={"end"})


def test_the_fingerprint_is_of_the_content():
    model = hall()
    twin = replace(
        model,
        costs=model.costs.astype(">f8"),
        probabilities=model.probabilities.astype(">f8"),
        successors=model.successors.astype(">i8"),
        pair_offsets=model.pair_offsets.astype("<i4"),
        action_names=list(model.action_names),
    )
    assert fingerprint(twin) == fingerprint(model) == fingerprint(hall())
    assert len(fingerprint(model)) == 64
    numbered = {"pair_offsets": [0, 1, 1], "outcome_offsets": [0, 1], "successors": [1]}
    plain = SSP.from_arrays(**numbered, probabilities=[1.0], costs=[0.0], goal_states=[1])
    stated = SSP.from_arrays(
        **numbered,
        probabilities=[1.0],
        costs=[-0.0],
        goal_states=[1],
        states=[np.int64(0), 1],
        actions=[0],
    )
    assert fingerprint(plain) == fingerprint(stated)


def test_whatever_differs_changes_the_fingerprint():
    model = hall()
    nudged = model.costs.copy()
    nudged[0] = np.nextafter(nudged[0], 2.0)
    chances = model.probabilities.copy()
    chances[[0, 1]] = chances[[1, 0]]
    others = [
        replace(model, costs=nudged),
        replace(model, probabilities=chances),
        replace(model, states=[*model.states[:-1], "exit"]),
        replace(model, action_names=("quick", *model.action_names[1:])),
        replace(model, goal_mask=~model.goal_mask),
        replace(model, state_labels={}),
        replace(model, exact_costs={1.0: Fraction(1)}),
        task(model),
        product(task(model), task(model).memory),
    ]
    assert len({fingerprint(other) for other in (model, *others)}) == len(others) + 1


def test_labels_of_many_kinds_can_be_stated_and_others_are_refused():
    labels = [frozenset({"a", "b"}), Colour.RED, Fraction(1, 3), ("x", (1, 2.5, None)), "RED"]
    prints = [fingerprint(with_labels(label)) for label in labels]
    assert len(set(prints)) == len(labels)
    code = (
        "from ssp_lp import SSP; from ssp_lp.io import fingerprint\n"
        "found = {frozenset({'b', 'a'}): {'go': [(1.0, 'end', 1.0)]}}\n"
        "print(fingerprint(SSP.from_transitions(found, goal={'end'})))"
    )
    assert elsewhere(code).strip() == prints[0]
    for label in (object(), float("inf"), b"bytes"):
        with pytest.raises(ModelError, match="cannot be written"):
            fingerprint(with_labels(label))


def test_episodes_run_side_by_side():
    """Each has a memory of its own."""
    policy = policies(hall())["cost aware"]
    one, other = (policy.start(world="other") for _ in range(2))
    first = one.action(START)
    assert other.action(START) == first
    for _ in range(60):
        one.observe(START, 1.0)
    late = one.action(START)
    assert other.action(START) == policy.start().action(START) == first
    other.observe(START, 60.0)
    assert other.action(START) == late
    lottery = policies(hall())["mixed"]
    rng = np.random.default_rng(0)
    drawn = [lottery.start(rng).action(START) for _ in range(2000)]
    assert np.mean([a == "fast" for a in drawn]) == pytest.approx(0.25, abs=4 * 0.0097)
    with pytest.raises(ModelError, match="generator"):
        lottery.start()
