"""Programs of processes that are hardly left: what a row misses by counts a million times."""

import numpy as np
import pytest

from formulations import MCMP, S3P, MaxProb, MinProb
from ssp_lp import SSP, LinearProgramming, solve

_LEAVING = 1e-6


def slow(seed: int) -> SSP:
    """Two states that lead to each other, but for a little, by drawn shares of goal and pit."""
    rng = np.random.default_rng(seed)
    table = {"d": {}}
    for here, there in (("x", "y"), ("y", "x")):
        table[here] = {}
        for action, share in enumerate(rng.uniform(0.2, 0.8, 2).tolist()):
            gone = _LEAVING * float(rng.uniform(0.2, 1.0))
            moves = [(gone * share, "g", 1.0), (gone * (1.0 - share), "d", 1.0)]
            table[here][action] = [*moves, (1.0 - gone, there, float(rng.integers(1, 4)))]
    return SSP.from_transitions(table, goal={"g"}, treat_actionless_as_dead_ends=True)


@pytest.mark.parametrize("backend", ["highs", "clarabel"])
@pytest.mark.parametrize("seed", range(6))
def test_programs_left_once_in_a_million_steps(backend: str, seed: int) -> None:
    if backend == "clarabel":
        pytest.importorskip("clarabel")
    model = slow(seed)
    for criterion in (MaxProb, MinProb):
        problem = criterion(model, "x")
        found = solve(problem, method=LinearProgramming(backend=backend))
        assert found.objective == pytest.approx(solve(problem).objective, rel=1e-9)


@pytest.mark.parametrize("backend", ["highs", "clarabel"])
def test_an_unreachable_loop_that_is_hardly_left(backend: str) -> None:
    """x: 1 unit at a risk of 0.1, or 5 surely: half of each keeps to 0.05."""
    if backend == "clarabel":
        pytest.importorskip("clarabel")
    stays = 1.0 - 1e-9
    table = {
        "x": {"bold": [(0.9, "g", 1.0), (0.1, "d", 1.0)], "sure": [(1.0, "g", 5.0)]},
        "u": {"on": [(stays, "v", 1.0), (1e-9, "g", 1.0)]},
        "v": {"back": [(stays, "u", 1.0), (1e-9, "d", 1.0)], "wait": [(1.0, "u", 2.0)]},
        "d": {},
    }
    model = SSP.from_transitions(table, goal={"g"}, treat_actionless_as_dead_ends=True)
    method = LinearProgramming(backend=backend)
    within = {"failure_budget": 0.05, "give_up": "dead_ends", "charge_failing_step": False}
    assert solve(MCMP(model, "x", **within), method=method).objective == pytest.approx(3.0)
    given_success = solve(S3P(model, "x", failure_budget=0.05), method=method)
    assert given_success.objective == pytest.approx((0.5 * 5.0 + 0.5 * 0.9) / 0.95)
    assert solve(MaxProb(model, "x"), method=method).objective == 1.0
