"""Problems of case M on all ranks of PETSc beside one process alone: a script for mpiexec.

It ends with an error where the ranks' answers differ from each other or from the local one. Its
argument is how many drawn models there are.
"""

import sys

import numpy as np
import pytest
from mpi4py import MPI

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from formulations import MCMP, S3P, CostBoundedReach, FinitePenalty, LeastQuantity, MaxProb
from random_models import drawn_model
from small_models import FIRST, FREE_PAIR, TWO_MOVES, model_of
from ssp_lp import (
    SSP,
    ColumnGeneration,
    DeterministicPolicies,
    InfeasibleError,
    ModelError,
    certify,
    evaluate,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.cargo import Cargo
from ssp_lp.distributed import Petsc
from ssp_lp.distributed.dynamics import PartitionedDynamics
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.methods.rows import limited_rows
from ssp_lp.problem import compiled_constrained

RANK, SIZE = MPI.COMM_WORLD.rank, MPI.COMM_WORLD.size
BY_PETSC = ColumnGeneration(pricing=Petsc())
DUPLICATES = {
    "x": {
        "go": [
            (0.25, "y", 1.0),
            (0.25, "x", 1.0),
            (0.25, "y", 2.0),
            (0.2, "x", 4.0),
            (0.05, "d", 0),
        ],
        "walk": [(0.5, "y", 4.0), (0.5, "x", 4.0)],
    },
    "y": {"go": [(0.125, "x", 1.0), (0.125, "x", 3.0), (0.74, "g", 1.0), (0.01, "d", 1.0)]},
    "d": {},
}
"""Several outcomes of a pair lead to one state, and some back to where it was taken."""


def problems():
    """Problems within a failure budget, of many sizes, which the ranks do not divide evenly."""
    yield MCMP(FIRST, "depot", 0.05)
    yield MCMP(model_of(TWO_MOVES), "x", 0.02)
    yield MCMP(model_of(DUPLICATES), "x", 0.03)
    yield MCMP(model_of(DUPLICATES), {"x": 0.25, "y": 0.75}, 0.3, discount=0.9)
    yield MCMP(model_of(FREE_PAIR), "x", 0.25)
    few, rarely = visits("wreck") <= 0.04, secondary_cost({"x": {"walk": 2.0}}) <= 2.0
    yield MCMP(FIRST, "depot", 0.09, constraints={"few": few})
    limits = {"rarely": rarely, "seen": visits("y") <= 1.2}
    yield MCMP(model_of(DUPLICATES), "x", 0.115, constraints=limits)
    yield LeastQuantity(model_of(DUPLICATES), "x", visits("y"), failure_budget=0.05)
    yield FinitePenalty(model_of(DUPLICATES), "x", 20.0)
    for seed in range(int(sys.argv[1])):
        model, _ = drawn_model(seed, 11 + 3 * (seed % 12))
        asked = {"start": {"s1": 0.5, "s5": 0.5}, "discount": 0.95, "give_up": "anywhere"}
        for question in ({"start": "s0"}, asked):
            least = least_failure(model, question)
            yield MCMP(model, **question, failure_budget=least + 0.3 * (1.0 - least))
    coarse = RobotGrid(segments=12, headings=8)
    yield MCMP(grid_model(coarse), start_state(coarse), 0.5)


def least_failure(model, question):
    """The least failure of any policy, discounted where the question is."""
    try:
        return solve(MCMP(model, **question, failure_budget=0.0)).budget_used
    except InfeasibleError as error:
        discounted = error.least_discounted_failure
        return error.least_failure if discounted is None else discounted


def check_prices(problem, answer, known):
    """Both answers' prices are the same, or, at a kink, both support the optimum.

    Prices z >= 0 do, by Lagrange, where the least ``cost + z @ activity`` of all policies, less
    ``z @ bounds``, is the optimum.
    """
    compiled = compiled_constrained(problem)
    rows = limited_rows(compiled)
    names = [compiled.names[k - 1] for k in rows.index]
    own, local = (
        np.array([one.prices.get(name, 0.0) for name in names]) for one in (answer, known)
    )
    if np.abs(own - local).max(initial=0.0) <= 1e-9 * np.abs(local).max(initial=0.0):
        return True
    pricing = compiled.pricing()
    for prices in (own, local):
        weights = rows.weights(prices)
        supported = weights @ pricing.minimise(weights).figures - prices @ rows.bounds
        worth = compiled.sense.worth(float(supported))
        assert (prices >= 0.0).all()
        assert worth == pytest.approx(known.objective, rel=1e-9, abs=1e-11), (problem, own, local)
    return False


def check_the_same(problem, *, optima=1):
    """All ranks have one answer on their own model, as proved and as good as the local one.

    Where there may be several optima, they spend the same of what has a price.
    """
    answer, known = solve(problem, BY_PETSC), solve(problem)
    members = answer.policy.policies
    figures = (
        answer.objective, answer.lower_bound, answer.failure_price, answer.budget_used,
        answer.policy.weights.tolist(), [evaluate(one, problem).objective for one in members],
    )  # fmt: skip
    assert MPI.COMM_WORLD.allgather(figures) == [figures] * SIZE
    assert answer.objective == pytest.approx(known.objective, rel=1e-9, abs=1e-12)
    if optima == 1 or answer.failure_price > 0.0:
        assert answer.budget_used == pytest.approx(known.budget_used, rel=1e-9, abs=1e-12)
    assert answer.gap <= 1e-9
    check_prices(problem, answer, known)
    failures = [evaluate(one, problem).limited_failure for one in members]
    assert answer.policy.weights @ failures == pytest.approx(answer.budget_used, rel=1e-9)
    assert answer.policy.model is problem.model
    assert certify(answer).accepted


def check_errors():
    """An error is raised on every rank, and the next problem is answered."""
    with pytest.raises(InfeasibleError) as caught:
        solve(MCMP(FIRST, "depot", 0.001), BY_PETSC)
    assert caught.value.least_failure == pytest.approx(0.01)
    with pytest.raises(InfeasibleError) as caught:
        solve(MCMP(FIRST, "depot", 0.05, constraints={"few": visits("wreck") <= 0.009}), BY_PETSC)
    assert caught.value.conflicting_rows == ("few",)
    for problem in (S3P(FIRST, "depot"), MaxProb(FIRST, "depot"), MCMP(FIRST, "depot")):
        with pytest.raises(ModelError, match="is for costs within a failure budget"):
            solve(problem, BY_PETSC)
    with pytest.raises(ModelError, match="is for costs within a failure budget"):
        solve(MCMP(FIRST, "depot", 0.05), DeterministicPolicies(relaxation=BY_PETSC))
    if SIZE > 1:
        with pytest.raises(ModelError, match="must ask for the same"):
            solve(MCMP(FIRST, "depot", 0.05 + 0.01 * RANK), BY_PETSC)


def check_totals():
    """Where the total cost counts the answer is the local one, too."""
    for problem in (
        S3P(FIRST, "depot", 0.05),
        S3P(model_of(DUPLICATES), "x", 0.1),
        CostBoundedReach(model_of(DUPLICATES), "x", cost_bound=6.0, failure_budget=0.3),
        S3P(FIRST, "depot", 0.09, constraints={"few": visits("wreck") <= 0.04}),
    ):
        answer, known = solve(problem, BY_PETSC), solve(problem)
        assert answer.objective == pytest.approx(known.objective, rel=1e-9), problem
        assert answer.budget_used == pytest.approx(known.budget_used, rel=1e-9), problem
        assert answer.policy.model is problem.model
        assert answer.gap <= 1e-9
        assert certify(answer).accepted


def check_that_equations_are_solved_together():
    """A chain of a long component, which no rank could solve from its own rows."""
    n = 400
    walk = {
        k: {"on": [(0.6, k + 1, 1.0), (0.39, max(k - 1, 0), 1.0), (0.01, 0, 1.0)]} for k in range(n)
    }
    slow = {k: {"safe": [(0.5, k + 1, 1.5), (0.5, k, 1.5)]} for k in range(n)}
    risky = {k: {"dare": [(0.999, k + 1, 1.0), (0.001, -1, 1.0)]} for k in range(n)}
    ways = {k: {**walk[k], **slow[k], **risky[k]} for k in range(n)}
    model = SSP.from_transitions({**ways, -1: {}}, goal={n}, treat_actionless_as_dead_ends=True)
    problem = MCMP(model, 0, 0.1)
    answer = solve(problem, BY_PETSC)
    assert answer.run.products > 0
    check_the_same(problem)


def check_that_dust_costs_no_bound():
    """Where going on is free a value of 1e-119, as sweeps leave it, is taken for nothing."""
    free = {
        "x": {"on": [(0.5, "y", 0.0), (0.5, "g", 0.0)]},
        "y": {"back": [(1.0, "x", 0.0)]},
        "z": {"pay": [(1.0, "x", 1.0)]},
    }
    pricing = compiled_constrained(MCMP(model_of(free), "z", 0.5)).pricing()
    ranks = Ranks.all()

    def bound():
        """Values below those that are stated, checked on all ranks."""
        dynamics = PartitionedDynamics.handed_out(ranks, pricing)
        return dynamics.lower_bound(np.array([1.0, 0.0]), np.array([1e-119, 1e-119, 1.0])).values

    assert ranks.answered(Cargo(), bound) == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)


if __name__ == "__main__":
    for one in problems():
        check_the_same(one)
    check_totals()
    check_errors()
    check_that_equations_are_solved_together()
    check_that_dust_costs_no_bound()
    if MPI.COMM_WORLD.gather(True) is not None:
        print(f"{SIZE} ranks: well")
