"""Every long stretch of a call looks at the clock: assembly, products, searches on graphs."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp

from formulations import MCMP, S3P
from ssp_lp import SSP, OutOfTimeError, Solution, solve, visits
from ssp_lp.accumulated_cost import written_out
from ssp_lp.compiled import deadline
from ssp_lp.compiled.accelerator import SWITCH
from ssp_lp.compiled.deadline import Deadline
from ssp_lp.model import graph
from ssp_lp.model.product import unroll_steps
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.programs.occupation_program import rows_program


class Counting(Deadline):
    """A deadline that is never met, and counts the looks at it."""

    def __init__(self):
        super().__init__(due=-np.inf)
        self.looks = 0

    def look(self):
        self.looks += 1


def corridor(cells):
    """Cells in a row, two speeds, of which the fast one falls more often."""
    return SSP.from_transitions(
        {
            k: {
                "slow": [(0.9, k + 1, 2.0), (0.1, k, 1.0)],
                "fast": [(0.85, k + 1, 1.0), (0.1, max(k - 1, 0), 1.0), (0.05, "pit", 1.0)],
            }
            for k in range(cells)
        }
        | {"pit": {}},
        goal={cells},
        treat_actionless_as_dead_ends=True,
    )


def test_the_program_is_assembled_in_pieces_and_is_what_it_says(monkeypatch):
    """A look for each hundred entries; the matrix of the definition, entry by entry."""
    monkeypatch.setattr(deadline, "_PIECE", 100)
    rng, n, pairs = np.random.default_rng(3), 40, 120
    steps = sp.csr_array(rng.random((pairs, n)) * (rng.random((pairs, n)) < 0.3) / n)
    offsets = np.arange(0, pairs + 1, 3)
    numbers = [rng.random(pairs) for _ in range(3)]
    process = ExplicitProcess(offsets, steps, np.full(n, 1 / n), *numbers)
    row = np.where(rng.random(pairs) < 0.5, 0.0, rng.random(pairs))
    with Counting() as counted:
        program = rows_program(process, {"fuel": (row, 0.4)}, ratio=True)
    assert counted.looks >= steps.nnz // 100
    balance = np.repeat(np.eye(n), 3, axis=1) - steps.toarray().T
    scale = np.append(-np.append(process.start, 0.4), 0.0)
    own = np.vstack([balance, row, process.goal])
    np.testing.assert_array_equal(program.matrix.toarray(), np.column_stack([own, scale]))


@pytest.mark.parametrize(
    "stretch",
    {
        "layers": lambda model: written_out.steps_of_layers(
            S3P(model, 0, failure_budget=0.9).compile().base,
            lambda kinds: (np.add.outer(np.arange(9), kinds), None),
            10_000,
        ),
        "steps": lambda model: unroll_steps(model, 30, [0]),
        "reaching": lambda model: graph.reaching_states(model, model.goal_mask),
        "approach": lambda model: graph.nearer_pairs(model, graph.goal_pairs(model)),
        "pairs": lambda model: graph.pairs_into(model, model.goal_mask),
        "components": lambda model: graph.end_components(
            model, np.ones(model.n_pairs, dtype=np.bool_)
        ),
    }.items(),
    ids=lambda stretch: stretch[0],
)
def test_a_long_stretch_looks_at_the_clock(stretch, monkeypatch):
    monkeypatch.setenv(SWITCH, "none")
    with Counting() as counted:
        stretch[1](corridor(30))
    assert counted.looks > 0


PROBLEMS = {
    "program": (lambda m: S3P(m, 0, failure_budget=0.6), "lp"),
    "layers": (lambda m: S3P(m, 0, failure_budget=0.6), None),
    "limit": (lambda m: S3P(m, 0, failure_budget=0.6, constraints={"c": visits(1) <= 1.1}), "lp"),
    "horizon": (lambda m: MCMP(m, 0, failure_budget=0.6, horizon=20), None),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", PROBLEMS)
def test_whichever_look_finds_the_time_over_the_call_ends_by_name(kind, monkeypatch):
    """An answer within the budget, above its bound, or OutOfTimeError; never anything else."""
    monkeypatch.setenv(SWITCH, "none")
    make, method = PROBLEMS[kind]
    best, looks, over = solve(make(corridor(12)), method), [0], [10**9]
    began = time.perf_counter()

    def clock():
        """A clock that jumps beyond every limit at one of the looks."""
        looks[0] += 1
        return began + (1e6 if looks[0] > over[0] else 1.0)

    monkeypatch.setattr(deadline, "time", SimpleNamespace(perf_counter=clock))
    solve(make(corridor(12)), method, time_limit=1e5)
    total = looks[0]
    assert total > 10
    for over[0] in range(0, total, max(total // 6, 1)):
        looks[0] = 0
        try:
            answer = solve(make(corridor(12)), method, time_limit=1e5)
        except OutOfTimeError:
            continue
        assert isinstance(answer, Solution)
        assert answer.failure_probability <= 0.6 + 1e-9
        assert answer.lower_bound <= best.objective * (1.0 + 1e-9)
        assert best.lower_bound <= answer.objective * (1.0 + 1e-9)
