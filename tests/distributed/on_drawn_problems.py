"""Drawn problems of case M on all ranks beside one process alone: a script for mpiexec.

    mpiexec -n 2 python tests/distributed/on_drawn_problems.py 300

Models have free cycles, several outcomes that lead to one state, and numbers of states that ranks
do not divide; questions have one start or several, discounts, every place to give up, limits that
bind, and some that cannot be kept. Objective, failure and what is limited must be the local ones to
1e-9, the members' own figures those of the local evaluation. Its arguments are how many problems
there are, and the first seed.
"""

import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

from formulations import MCMP, FinitePenalty, LeastQuantity, MaxProb
from partitioned import numbered, partitioned
from random_models import random_choices
from ssp_lp import (
    SSP,
    InfeasibleError,
    ModelError,
    end_probability,
    evaluate,
    secondary_cost,
    solve,
    visits,
)

COMM = MPI.COMM_WORLD
LOOSE = 1e9  # bound of a limit that does not bind
GIVE_UP = ["dead_ends", "attention", "anywhere"]


def drawn_model(rng):
    """A random model with a second cost, in which some outcomes are split in two."""
    n_states = int(rng.integers(4, 60))
    choices = random_choices(rng, n_states, free_share=float(rng.choice([0.0, 0.3, 0.7])))
    for actions in choices.values():
        for name, outcomes in actions.items():
            if rng.random() < 0.3:
                chance, successor, cost = outcomes[0]
                halves = [(0.5 * chance, successor, cost), (0.5 * chance, successor, cost + 1)]
                actions[name] = [*halves, *outcomes[1:]]
    model = SSP.from_transitions(choices, goal={"goal"}, treat_actionless_as_dead_ends=True)
    model = replace(model, named_costs={"fuel": rng.integers(0, 4, model.n_outcomes).astype(float)})
    sets = {"pit": ["pit"], "some": [f"s{k}" for k in range(1, n_states, 3)]}
    return numbered(model.with_labels(sets))


def least_failure(model, question):
    """The least failure of any policy, discounted where the question is."""
    try:
        solve(MCMP(model, **question, failure_budget=0.0))
    except InfeasibleError as error:
        return error.least_discounted_failure or error.least_failure
    return 0.0


def drawn_question(rng, model):
    """A question about a model: a criterion, and what it is asked with."""
    starts = dict.fromkeys(rng.choice(model.n_states, size=4).tolist(), 0.125)
    several = {**starts, 0: 1.0 - 0.125 * (len(starts) - (0 in starts))}
    question = {
        "start": several if rng.random() < 0.4 else 0,
        "discount": [None, None, 0.9, 0.999][int(rng.integers(4))],
        "give_up": str(rng.choice(GIVE_UP)),
    }
    kind = rng.random()
    if kind < 0.1:
        return MaxProb, {"start": question["start"]}
    if kind < 0.2:
        return FinitePenalty, {"start": question["start"], "penalty": float(rng.integers(1, 60))}
    if kind < 0.35:  # at least failure
        del question["discount"]
        return MCMP, question
    least = least_failure(model, question)
    question["failure_budget"] = least + float(rng.choice([-0.1, 0.05, 0.3, 0.8])) * (1.0 - least)
    question["failure_budget"] = max(question["failure_budget"], 0.0)
    if kind < 0.45:
        return LeastQuantity, question | {"quantity": visits("some")}
    quantities = {
        "fuel": secondary_cost("fuel"),
        "some": visits("some"),
        "three": visits(3),
        "pit": end_probability("pit"),
    }
    names = [name for name in quantities if rng.random() < 0.35]
    if not names or question["failure_budget"] < least:
        return MCMP, question
    loose = {name: quantities[name] <= LOOSE for name in names}
    problem = MCMP(model, **question, constraints=loose)
    spent = evaluate(solve(problem).policy, problem).secondary_costs
    share = float(rng.choice([0.7, 0.9, 0.99, 1.1]))
    limits = {name: quantities[name] <= share * spent[name] for name in names}
    return MCMP, question | {"constraints": limits}


def solution_or_error(problem):
    """The local solution, or the error of a problem that has none."""
    try:
        return solve(problem)
    except InfeasibleError as error:
        return error


def check_the_same(model, made, criterion, **asked):
    """All ranks have one answer, as good as the local one, and its policy is worth what it says."""
    problem = criterion(model, **asked)
    known = solution_or_error(problem)
    if isinstance(known, InfeasibleError):
        with pytest.raises(InfeasibleError) as caught:
            made.solve(criterion, **asked)
        assert caught.value.least_failure == pytest.approx(known.least_failure, rel=1e-9, abs=1e-12)
        return "infeasible"
    answer = made.solve(criterion, **asked)
    figures = answer.objective, answer.lower_bound, answer.failure, dict(answer.prices)
    assert COMM.allgather(figures) == [figures] * COMM.size
    assert answer.objective == pytest.approx(known.objective, rel=1e-9, abs=1e-12), problem
    assert answer.gap <= 1e-9, (problem, answer.gap)
    bound = known.objective * (1.0 + 1e-12) + 1e-12
    if criterion is not MaxProb:
        assert answer.lower_bound <= bound, problem
    if problem.failure_budget is not None:
        assert answer.failure <= problem.failure_budget + 1e-10, problem
    for condition in problem.conditions:
        spent, most = answer.spent[condition.name], condition.upper
        assert most is None or spent <= most * (1.0 + 1e-9) + 1e-10, problem
    joined = answer.policy.on(model)
    for member, measured in zip(joined.policies, answer.figures, strict=True):
        own = evaluate(member, problem)
        spent = [own.secondary_costs[name] for name in answer.spent]
        assert measured == pytest.approx(
            [own.objective, own.limited_failure, *spent], rel=1e-9, abs=1e-12
        ), problem
    again = made.evaluate(answer.policy, criterion, **asked)
    assert again.objective == pytest.approx(answer.objective, rel=1e-9, abs=1e-12), problem
    assert again.failure == pytest.approx(answer.failure, rel=1e-9, abs=1e-12), problem
    return "answered"


def check(seed):
    """Put the problem of a seed to one process and to the ranks."""
    rng = np.random.default_rng(seed)
    model = drawn_model(rng)
    criterion, asked = drawn_question(rng, model)
    made = partitioned(model)
    try:
        return check_the_same(model, made, criterion, **asked)
    except ModelError as error:
        if "which ranks do not support" not in str(error):
            raise
        return "refused"


if __name__ == "__main__":
    count, first = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    tally = Counter()
    for seed in range(first, first + count):
        try:
            tally[check(seed)] += 1
        except BaseException:
            print(f"seed {seed}", flush=True)
            raise
    assert tally["refused"] <= 0.2 * count, tally
    if COMM.rank == 0:
        print(f"{COMM.size} ranks: well", tally if count > 100 else "")
