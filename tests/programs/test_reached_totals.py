"""Case S's program has a column for each action at each total that a run can come to, no more."""

from collections import deque

import numpy as np
import pytest

from drawn_programs import DEPOT, drawn_choices, with_room
from formulations import S3P
from ssp_lp import InfeasibleError, evaluate, solve, visits
from ssp_lp.linear_programming.backends import run_backend
from ssp_lp.policies.policy import GIVE_UP
from ssp_lp.programs.occupation_program import rows_program

STARTS = ("a", {"b": 0.5, "d": 0.5}, {"a": 0.75, "b": 0.125, "g": 0.125})


def walked(choices: dict, start: object, cap: float) -> set[tuple]:
    """(state, action, total) along every walk of a model from its start, breadth first."""
    begun = [start] if isinstance(start, str) else list(start)
    places, ahead, taken = {(s, 0.0) for s in begun}, deque((s, 0.0) for s in begun), set()
    while ahead:
        state, paid = ahead.popleft()
        for action, ways in choices.get(state, {}).items():
            taken.add((state, action, paid))
            for chance, successor, cost in ways:
                place = successor, min(paid + cost, cap)
                if chance > 0.0 and place not in places:
                    places.add(place)
                    ahead.append(place)
    return taken


def problems(seed: int, **asked: object):
    """S3P on a drawn model from several starts, with room between least failure and budget."""
    for start in STARTS:
        if (found := with_room(seed, start)) is not None and found[1] < 0.9:
            yield start, S3P(found[0], start, found[1] + 0.5 * (1.0 - found[1]), **asked)


@pytest.mark.parametrize("seed", range(20))
def test_columns_are_those_of_the_walks_from_the_start(seed):
    choices = drawn_choices(seed)
    for cap in (None, 3.0):
        for start, problem in problems(seed, cost_cap=cap):
            program = problem.program()
            last = max(program.augmented.inner.totals.values.tolist())
            labels = [program.label(k) for k in range(program.process.n_pairs)]
            acting = {
                tuple(x) for x in labels if x.action not in (GIVE_UP, "stay for ever", "start")
            }
            open_states = {state for state, _, _ in acting}
            walks = {w for w in walked(choices, start, last) if w[0] in open_states}
            assert acting == walks
            assert len(set(labels)) == len(labels)
            begun = {start} if isinstance(start, str) else set(start)
            assert (labels[-1].action == "start") == bool(begun - open_states)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(7))
def test_nothing_is_lost_with_the_totals_that_no_run_comes_to(seed):
    """The optimum is `solve`'s and the one over all totals; duals and both policies attain it."""
    for limits in ({}, {"seen": visits("a") <= 1.5}):
        for discount in (None, 0.9):
            for _, problem in problems(seed, constraints=limits, discount=discount):
                try:
                    known = solve(problem)
                except InfeasibleError:  # a limit, or what a discount counts as failing
                    continue
                program = problem.program()
                measure = program.solve()
                assert measure.objective == pytest.approx(known.objective, rel=1e-8, abs=1e-8)
                proved = measure.optimal_value_from_dual
                assert proved == pytest.approx(known.objective, rel=1e-8, abs=1e-8)
                whole = program.augmented.inner.process
                if "seen" not in limits:
                    budget = {"failure": (whole.failure, problem.failure_budget)}
                    every = rows_program(whole, budget, ratio=True)
                    answer = run_backend(every, "highs-simplex", np.inf)
                    assert every.cost @ answer.x == pytest.approx(known.objective, rel=1e-7)
                for policy in (measure.mixed_policy(), measure.randomised_policy()):
                    found = evaluate(policy, problem)
                    assert found.objective == pytest.approx(known.objective, rel=1e-7, abs=1e-8)


def test_a_decision_of_one_total_has_a_price_and_values_at_it():
    program = S3P(DEPOT, "depot", failure_budget=0.05).program()
    assert program.linear.matrix.shape == (3, 3)
    measure = program.solve()
    assert measure.visits.tolist() == pytest.approx([5.0 / 9.0, 4.0 / 9.0])
    assert measure.objective == pytest.approx((5.0 * 8.91 + 4.0 * 2.7) / 8.55)
    assert solve(S3P(DEPOT, "depot", 0.05)).explain("depot").cost_paid == 0.0


def test_a_policy_of_the_program_decides_everywhere_below_its_last_total():
    """At a total that no run comes to the policy decides as at the one before."""
    policy = S3P(DEPOT, "depot", failure_budget=0.05).program().solve().mixed_policy()
    for member in policy.policies:
        assert len({row.action for row in member.table()}) == 1
