"""Policies and solutions in files and tables."""

import contextlib
import importlib
import importlib.util
import json
import os
import pkgutil
import subprocess
import sys
from dataclasses import replace
from enum import Enum
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

import ssp_lp.policies
from formulations import MCMP, S3P, CostQuantile, FinitePenalty, MaxProb
from named_policies import EVERY, made, start_of
from played import START, everywhere, ferry, hall, task, traces
from refusing import refused
from ssp_lp import (
    GIVE_UP,
    SSP,
    MissingDependencyError,
    MixedPolicy,
    ModelError,
    certify,
    evaluate,
    product,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.io import fingerprint, load_policy, load_solution, save_policy, save_solution
from ssp_lp.io.archives import _CLASSES
from ssp_lp.policies.chain import policy_chain
from ssp_lp.policies.policy import Policy, as_lottery
from ssp_lp.policies.remembering import JointMemory, common_memory
from ssp_lp.processes.failure_semantics import start_distribution

# Policies in files: read in another process beside a model built anew, they play the same.


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
        refused("load it with product", load_policy, path, hall())


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
        refused("pairs differ", load_policy, path, ferry(), check=check)


def stated(format="ssp-lp policy", **entries):
    header = json.dumps({"format": format, **entries}).encode()
    return {"header": np.frombuffer(header, dtype=np.uint8)}


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"decision": np.zeros(3)}, "not an ssp-lp policy file"),
        (
            {"header": np.array([{"a": 1}], dtype=object)},
            "not an ssp-lp policy file",
        ),  # never opened
        ({"header": np.frombuffer(b"[1]", dtype=np.uint8)}, "not an ssp-lp policy file"),
        (stated("ssp-lp solution", version=1), "not an ssp-lp policy file"),
        (
            stated("ssp-lp model", version=1),
            "not an ssp-lp policy file: its format is 'ssp-lp model'",
        ),
        (stated(version=99), "version 99, .* newer ssp-lp"),
        (stated(version=0), "version 0, .*: write the policy again"),
    ],
)
def test_files_that_are_none_are_refused(arrays, words, tmp_path):
    path = tmp_path / "policy.npz"
    path.write_text("no archive")
    refused("not an ssp-lp policy file", load_policy, path, hall())
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


def test_a_policy_of_a_horizon_is_read_beside_the_model_as_stated(tmp_path, accelerate):
    accelerate(False)  # the same sums for both evaluations
    problem = S3P(hall(), START, 0.7, horizon=3)
    solution = solve(problem)
    path = saved(solution.policy, tmp_path)
    loaded = load_policy(path, problem.model)
    assert loaded.model is problem.model
    assert evaluate(loaded, problem) == evaluate(solution.policy, problem)
    refused("pairs differ", load_policy, path, with_label("start"))


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


# Tables of policies say what the policies do.


def table_of(policy):
    return {(r.member, r.state, r.memory, r.action): r.probability for r in policy.table()}


def test_a_stationary_policy():
    assert table_of(made()["stochastic"]) == {
        (0, ("hall", 0), None, "fast"): 0.25,
        (0, ("hall", 0), None, ("slow", 1)): 0.75,
        (0, ("hall", 1), None, "fast"): 0.5,
        (0, ("hall", 1), None, GIVE_UP): 0.5,
        (0, ("hall", 2), None, "fast"): 1.0,
    }


@pytest.mark.parametrize("name", EVERY)
def test_what_is_reached_stands_in_the_table(name):
    """Every decision on the policy's chain, played by a person who keeps the memory in words."""
    policy, model = made()[name], made()[name].model
    rows, sums = set(), {}
    for row in policy.table():
        rows.add((row.member, row.state, row.action))
        key = row.member, row.state, row.memory
        sums[key] = sums.get(key, 0.0) + row.probability
    assert all(total == pytest.approx(1.0) for total in sums.values())
    for k, member in enumerate(as_lottery(policy).policies):
        chain = policy_chain(model, member, start_distribution(model, start_of(name)))
        for node, pair in zip(chain.branch_node, chain.branch_pair, strict=True):
            action = GIVE_UP if pair < 0 else model.action_of(int(pair))
            assert (k, model.states[int(chain.state[node])], action) in rows


def test_memories_in_words():
    told = {name: {row.memory for row in made()[name].table()} for name in EVERY}
    aware, cap = told["cost aware"], made()["cost aware"].cap
    assert {k for k in aware if not isinstance(k, str)} <= {float(k) for k in range(cap)}
    assert {k for k in aware if isinstance(k, str)} <= {"tail 0", "tail 1"}
    assert told["timed"] == told["remembering"] == {0, 1, 2}
    assert told["carried"] <= aware
    timed = made()["timed"]
    joint = table_of(JointMemory(common_memory(as_lottery(timed)), timed))
    assert {(k, s, memory[0], a): p for (k, s, memory, a), p in joint.items()} == table_of(timed)


def test_a_frame_needs_pandas(monkeypatch):
    policy = everywhere(hall(), "fast")
    if importlib.util.find_spec("pandas") is None:
        words = r"pip install '\.\[frames\]'"
        refused(words, policy.to_frame, error=MissingDependencyError)
    made = SimpleNamespace(DataFrame=lambda rows, columns: (rows, columns))
    monkeypatch.setitem(sys.modules, "pandas", made)
    rows, columns = policy.to_frame()
    assert rows == [row._asdict() for row in policy.table()]
    assert columns == ["state", "memory", "action", "probability", "member"]


# Solutions in files: read beside the problem stated again, their certificates are the same.


def fuel(bound):
    spent = {("hall", k): {"fast": 2.0, ("slow", 1): 0.5} for k in range(3)}
    return {"fuel": secondary_cost(spent) <= bound}


PROBLEMS = {
    "mcmp": lambda: MCMP(hall(), START, failure_budget=0.2),
    "a share": lambda: MCMP(hall(), START, reach_fraction=0.75),
    "least failure": lambda: MCMP(hall(), START, failure_budget=None),
    "discounted": lambda: MCMP(hall(), START, failure_budget=0.25, discount=0.99),
    "s3p": lambda: S3P(hall(), {START: 0.5, ("hall", 1): 0.5}, failure_budget=0.2),
    "levels": lambda: S3P(ferry(), "quay", failure_budget=0.1),
    "limits": lambda: MCMP(hall(), START, failure_budget=0.2, constraints=fuel(7.0)),
    "maxprob": lambda: MaxProb(hall(), START),
    "penalty": lambda: FinitePenalty(hall(), START, penalty=30.0),
    "quantile": lambda: CostQuantile(hall(), START, 0.5, failure_budget=0.3),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_certificates_are_the_same(name, tmp_path):
    solution = solve(PROBLEMS[name]())
    save_solution(solution, tmp_path / "solution.npz")
    found = load_solution(tmp_path / "solution.npz", PROBLEMS[name]())
    certificate = certify(found)
    assert certificate == certify(solution)
    assert certificate.accepted
    assert found.summary() == solution.summary()
    assert (found.gap, found.prices, found.run) == (solution.gap, solution.prices, solution.run)
    if solution.value_function is not None:
        assert np.array_equal(found.value_function, solution.value_function)
    start = "quay" if name == "levels" else START
    assert traces(found.policy, start, 1) == traces(solution.policy, start, 1)


def test_the_saved_numbers_are_not_believed(tmp_path):
    """A file with a price that proves less than it says: the certificate's gap tells."""
    solution = solve(PROBLEMS["mcmp"]())
    object.__setattr__(solution, "failure_price", 0.5 * solution.failure_price)
    save_solution(solution, tmp_path / "solution.npz")
    found = load_solution(tmp_path / "solution.npz", PROBLEMS["mcmp"]())
    assert certify(found).gap > 1e-3


def mcmp(model=None, start=START, failure_budget=0.2, **options):
    return MCMP(model or hall(), start, failure_budget=failure_budget, **options)


@pytest.mark.parametrize(
    ("name", "other", "words"),
    [
        ("mcmp", lambda: mcmp(hall(4.0)), "fingerprint"),
        ("mcmp", lambda: S3P(hall(), START, failure_budget=0.2), "criterion"),
        ("mcmp", lambda: mcmp(failure_budget=0.21), "failure_budget"),
        ("mcmp", lambda: mcmp(failure_budget=None), "failure_budget"),
        ("mcmp", lambda: mcmp(discount=0.99), "discount"),
        ("mcmp", lambda: mcmp(give_up="anywhere"), "give_up"),
        ("mcmp", lambda: mcmp(start=("hall", 1)), "start"),
        ("mcmp", lambda: mcmp(constraints={"pits": visits("fall") <= 1.0}), "limits"),
        ("mcmp", lambda: CostQuantile(hall(), START, 0.5, failure_budget=0.2), "criterion"),
        ("limits", lambda: mcmp(constraints=fuel(7.5)), r"limits = .*7\.0.* not .*7\.5"),
        ("quantile", lambda: CostQuantile(hall(), START, 0.6, failure_budget=0.3), "measure"),
    ],
)
def test_another_problem_is_refused(name, other, words, tmp_path):
    save_solution(solve(PROBLEMS[name]()), tmp_path / "solution.npz")
    refused(words, load_solution, tmp_path / "solution.npz", other())


def test_a_policy_file_is_no_solution(tmp_path):
    save_policy(solve(mcmp()).policy, tmp_path / "policy.npz")
    refused("not an ssp-lp solution file", load_solution, tmp_path / "policy.npz", mcmp())


@pytest.mark.parametrize("junk", [None, 0, "x", [], {}, [7], 10**12])
def test_a_file_that_says_what_cannot_be_is_damaged(junk, tmp_path):
    """Each entry of the header in turn, and of what the policies are made of."""
    path, problem = tmp_path / "solution.npz", PROBLEMS["s3p"]()
    save_solution(solve(problem), path)
    with np.load(path) as found:
        arrays = dict(found)
    header = json.loads(arrays["header"].tobytes())
    damaged = [{**header, name: junk} for name in header if header[name] != junk]
    for k, record in enumerate(header["policies"]):
        for name in record:
            parts = [*header["policies"]]
            parts[k] = {**record, name: junk}
            damaged.append({**header, "policies": parts})
    for told in damaged:
        arrays["header"] = np.frombuffer(json.dumps(told).encode(), dtype=np.uint8)
        np.savez(path, **arrays)
        with contextlib.suppress(ModelError):
            load_solution(path, problem)
