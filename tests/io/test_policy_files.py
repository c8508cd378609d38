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
from named_policies import EVERY, made, start_of
from played import START, everywhere, ferry, hall, task, traces
from refusing import refused
from ssp_lp import SSP, MixedPolicy, evaluate, product, solve
from ssp_lp.io import fingerprint, load_policy, save_policy
from ssp_lp.io.archives import _CLASSES
from ssp_lp.policies.policy import Policy

ODD = Enum("ODD", "RED")

READER = """
import json, sys
from played import START, hall, traces
from ssp_lp.io import fingerprint, load_policy
model = hall()
played = [traces(load_policy(path, model), START, 7) for path in sys.argv[1:]]
print(json.dumps([fingerprint(model), *played]))
"""


def elsewhere(code, *arguments):
    """What a new process prints."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONHASHSEED": "12345"}
    command = [sys.executable, "-c", code, *arguments]
    ran = subprocess.run(command, capture_output=True, text=True, env=env, check=True)  # noqa: S603
    return ran.stdout


def saved(policy, tmp_path, name="policy"):
    save_policy(policy, tmp_path / f"{name}.npz")
    return tmp_path / f"{name}.npz"


@pytest.mark.parametrize("name", EVERY)
def test_policies_play_the_same_beside_a_model_built_anew(name, tmp_path):
    policy, start = made()[name], start_of(name)
    path = saved(policy, tmp_path)
    model = {"levels": ferry, "remembering": lambda: task(hall())}.get(name, hall)()
    found = load_policy(path, model)
    assert type(found) is type(policy)
    assert found.model is getattr(model, "original", model)
    assert repr(found) == repr(policy)
    assert traces(found, start, 3) == traces(policy, start, 3)
    if name == "remembering":
        refused("load it beside product", load_policy, path, hall())


@pytest.mark.slow
def test_a_new_process_plays_the_same(tmp_path):
    policies = [made()[name] for name in ("solution", "carried")]
    paths = [str(saved(policy, tmp_path, k)) for k, policy in enumerate(policies)]
    known = [fingerprint(hall()), *(traces(policy, START, 7) for policy in policies)]
    assert json.loads(elsewhere(READER, *paths)) == json.loads(json.dumps(known))


def test_another_model_is_refused_unless_it_differs_on_purpose(tmp_path):
    path = saved(everywhere(hall(), "fast"), tmp_path)
    refused(r"fingerprint .* check=False", load_policy, path, hall(4.0))
    found = load_policy(path, hall(4.0), check=False)
    assert found.actions() == everywhere(hall(4.0), "fast").actions()
    for check in (True, False):
        refused("other pairs", load_policy, path, ferry(), check=check)


def stated(format="ssp-lp policy", **entries):
    header = json.dumps({"format": format, **entries}).encode()
    return {"header": np.frombuffer(header, dtype=np.uint8)}


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"decision": np.zeros(3)}, "no ssp-lp policy file"),
        ({"header": np.array([{"a": 1}], dtype=object)}, "no ssp-lp policy file"),  # never opened
        ({"header": np.frombuffer(b"[1]", dtype=np.uint8)}, "no ssp-lp policy file"),
        (stated("ssp-lp solution", version=1), "no ssp-lp policy file"),
        (stated("ssp-lp model", version=1), "no ssp-lp policy file: it says 'ssp-lp model'"),
        (stated(version=99), "version 99, .* newer ssp-lp"),
        (stated(version=0), "version 0, .*: write the policy anew"),
    ],
)
def test_files_that_are_none_are_refused(arrays, words, tmp_path):
    path = tmp_path / "policy.npz"
    path.write_text("no archive")
    refused("no ssp-lp policy file", load_policy, path, hall())
    np.savez(path, **arrays)
    refused(words, load_policy, path, hall())


def test_a_policy_of_a_class_of_its_own_is_refused_by_name(tmp_path):
    class Secretive(Policy):
        start_memory = branches = remember = None

    policy = object.__new__(type("Whim", (Secretive,), {"__abstractmethods__": frozenset()}))
    policy.model = hall()
    lottery = MixedPolicy((policy,), np.ones(1))
    refused("Whim", save_policy, lottery, tmp_path / "policy.npz")
    assert not (tmp_path / "policy.npz").exists()


def test_a_policy_of_a_horizon_is_read_beside_the_model_as_stated(tmp_path):
    problem = S3P(hall(), START, 0.7, horizon=3)
    solution = solve(problem)
    path = saved(solution.policy, tmp_path)
    loaded = load_policy(path, problem.model)
    assert loaded.model is problem.model
    assert evaluate(loaded, problem) == evaluate(solution.policy, problem)
    refused("other pairs", load_policy, path, with_label("start"))


def test_every_class_of_policies_can_be_saved():
    for module in pkgutil.iter_modules(ssp_lp.policies.__path__):
        found = vars(importlib.import_module(f"ssp_lp.policies.{module.name}")).values()
        classes = {made for made in found if isinstance(made, type) and issubclass(made, Policy)}
        public = {made for made in classes if not made.__name__.startswith("_")}
        assert public - {Policy} <= set(_CLASSES.values())


def test_the_same_policy_gives_the_same_file_and_parts_are_kept_once(tmp_path):
    fast = everywhere(hall(), "fast")
    for name, count in (("one", 1), ("again", 1), ("many", 50)):
        save_policy(MixedPolicy((fast,) * count, np.ones(count) / count), tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "again").read_bytes()
    with np.load(tmp_path / "many") as file:
        assert len(file.files) == 3  # header, weights, one decision


def with_label(label):
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
    parts = {"pair_offsets": [0, 1, 1], "outcome_offsets": [0, 1], "successors": [1]}
    parts |= {"probabilities": [1.0], "goal_states": [1]}
    stated = SSP.from_arrays(**parts, costs=[-0.0], states=[np.int64(0), 1], actions=[0])
    assert fingerprint(SSP.from_arrays(**parts, costs=[0.0])) == fingerprint(stated)


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


@pytest.mark.slow
def test_labels_of_many_kinds_can_be_stated_and_others_are_refused():
    labels = [frozenset({"a", "b"}), ODD.RED, Fraction(1, 3), ("x", (1, 2.5, None)), "RED"]
    prints = [fingerprint(with_label(label)) for label in labels]
    assert len(set(prints)) == len(labels)
    code = (
        "from ssp_lp import SSP; from ssp_lp.io import fingerprint\n"
        "found = {frozenset({'b', 'a'}): {'go': [(1.0, 'end', 1.0)]}}\n"
        "print(fingerprint(SSP.from_transitions(found, goal={'end'})))"
    )
    assert elsewhere(code).strip() == prints[0]
    for label in (object(), float("inf"), b"bytes"):
        refused("cannot be written", fingerprint, with_label(label))
