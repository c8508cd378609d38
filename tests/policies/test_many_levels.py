"""Policies that tell very many levels of cost apart, from steps of very different costs."""

import numpy as np
import pytest

from formulations import S3P
from ssp_lp import SSP, evaluate, solve
from ssp_lp.compiled.deadline import Stop
from ssp_lp.methods import refinement, rows
from ssp_lp.options import SolveOptions
from ssp_lp.policies import chain
from ssp_lp.processes.failure_semantics import start_distribution

GOAL, PIT = "home", "pit"
WORKS = {
    "a": {
        "try": [(0.1, GOAL, 1e-3), (0.5, "b", 1.0), (0.4, PIT, 1e3)],
        "wait": [(0.6, "a", 1.0), (0.3, "b", 1e3), (0.1, GOAL, 2e3)],
    },
    "b": {
        "try": [(0.3, GOAL, 1e3), (0.3, "a", 1e-3), (0.4, PIT, 1.0)],
        "wait": [(0.7, "b", 2e3), (0.2, "a", 1.0), (0.1, GOAL, 1e-3)],
    },
}


@pytest.fixture(scope="module")
def problem() -> S3P:
    """Costs a millionfold apart, so that totals are told apart on a grid."""
    model = SSP.from_transitions(WORKS, [GOAL], treat_actionless_as_dead_ends=True)
    return S3P(model, "a", failure_budget=0.3, cost_levels=2_000)


def test_a_chain_is_the_same_step_by_step_and_searched_at_once(
    problem: S3P, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever way its nodes are found, nodes, moves and decisions are the same."""
    start = start_distribution(problem.model, problem.start)
    for member in solve(problem, tolerance=1e-2).policy.policies:
        chains = []
        for rounds in (0, 3, 10**9):
            monkeypatch.setattr(chain, "_MANY_ROUNDS", rounds)
            chains.append(chain.policy_chain(problem.model, member, start))
        first, *others = chains
        for other in others:
            for name in ("state", "memory", "start", "dead", "give_up"):
                assert np.array_equal(getattr(first, name), getattr(other, name))
            assert (abs(first.matrix - other.matrix) > 1e-15).nnz == 0
        assert first.n_nodes > 20


def test_a_bound_outlives_the_time_for_evaluating_policies(
    problem: S3P, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the time ends before any policy was evaluated, the bound of the search still counts."""
    optimum = solve(problem)
    assert evaluate(optimum.policy, problem).objective == pytest.approx(optimum.objective)
    assert optimum.gap < 5e-2

    def out_of_time(*_: object) -> None:
        raise Stop

    with monkeypatch.context() as patched:
        patched.setattr(rows, "true_lottery", out_of_time)
        for module in (rows, refinement):
            patched.setattr(module, "is_late", lambda: True)
        with pytest.raises(Stop) as stopped:
            rows.rows_optimum(
                stated := rows.compiled_constrained(problem),
                SolveOptions(1e-6),
                rows.true_figures(problem, stated),
            )
    assert stopped.value.choice.value == np.inf
    assert stopped.value.choice.bound == pytest.approx(optimum.lower_bound, rel=5e-2)
