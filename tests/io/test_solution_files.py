"""Solutions in files: read beside the problem stated again, their certificates are the same."""

import contextlib
import json

import numpy as np
import pytest

from formulations import MCMP, S3P, CostQuantile, FinitePenalty, MaxProb
from played import START, ferry, hall, traces
from refusing import refused
from ssp_lp import ModelError, certify, secondary_cost, solve, visits
from ssp_lp.io import load_solution, save_policy, save_solution


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
        ("limits", lambda: mcmp(constraints=fuel(7.5)), r"limits = .*7\.0.* has .*7\.5"),
        ("quantile", lambda: CostQuantile(hall(), START, 0.6, failure_budget=0.3), "measure"),
    ],
)
def test_another_problem_is_refused(name, other, words, tmp_path):
    save_solution(solve(PROBLEMS[name]()), tmp_path / "solution.npz")
    refused(words, load_solution, tmp_path / "solution.npz", other())


def test_a_policy_file_is_no_solution(tmp_path):
    save_policy(solve(mcmp()).policy, tmp_path / "policy.npz")
    refused("no ssp-lp solution file", load_solution, tmp_path / "policy.npz", mcmp())


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
