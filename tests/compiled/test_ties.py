"""Values do not depend on which of several equal actions rounding favours, compiled or not."""

from collections.abc import Callable

import numpy as np
import pytest

import formulations as criteria
from formulations import MCMP
from small_models import model_of
from ssp_lp import SSP, SSPError, evaluate, solve, visits

pytest.importorskip("numba")

Case = tuple[str, Callable[[], object]]


def with_duplicates(seed):
    """A drawn model whose actions may stand twice, turned round or with other last digits."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 12))
    least = seed % 2  # where steps are free
    table = {"pit": {}}
    for state in range(n):
        actions = []
        for _ in range(int(rng.integers(1, 4))):
            size = int(rng.integers(1, 4))
            share = rng.integers(1, 6, size) / 1.0
            after = [("goal", "pit", *range(n))[k] for k in rng.integers(0, n + 2, size)]
            costs = rng.integers(least, 4, size).tolist()
            actions.append(list(zip((share / share.sum()).tolist(), after, costs, strict=True)))
        for action in list(actions):
            if rng.random() < 0.5:
                near = np.nextafter([p for p, _, _ in action], rng.integers(0, 2, len(action)))
                near = near if rng.random() < 0.5 else np.array([p for p, _, _ in action])
                again = [(float(p), x, c) for p, (_, x, c) in zip(near, action, strict=True)]
                turned = again[::-1] if rng.random() < 0.5 else again
                actions.insert(int(rng.integers(0, len(actions) + 1)), turned)
        table[state] = {f"action {k}": action for k, action in enumerate(actions)}
    model = SSP.from_transitions(table, goal={"goal"}, treat_actionless_as_dead_ends=True)
    return model, 0


def mirrored_grid(seed):
    """A slippery grid that is its own mirror image at the diagonal, with holes on both sides."""
    rng = np.random.default_rng(seed)
    n, slip = int(rng.integers(3, 6)), float(rng.choice([0.1, 0.2, 0.3]))
    holes = set()
    for x, y in rng.integers(0, n, (int(rng.integers(0, 3)), 2)).tolist():
        holes |= {(x, y), (y, x)} if 0 < x + y < 2 * n - 2 else set()
    moves = {"east": (1, 0), "north": (0, 1), "west": (-1, 0), "south": (0, -1)}
    table = {}
    for x, y in np.ndindex(n, n):
        if (x, y) == (n - 1, n - 1) or (x, y) in holes:
            continue
        table[x, y] = {}
        for name in rng.permutation(list(moves)).tolist():
            dx, dy = moves[name]
            chances = ((dx, dy), 1 - slip), ((dy, dx), slip / 2), ((-dy, -dx), slip / 2)
            table[x, y][name] = [
                (p, (min(max(x + ex, 0), n - 1), min(max(y + ey, 0), n - 1)), 1.0)
                for (ex, ey), p in chances
            ]
    table |= {hole: {} for hole in holes}
    goal = {(n - 1, n - 1)}
    model = SSP.from_transitions(table, goal=goal, treat_actionless_as_dead_ends=True)
    return model, (0, 0)


def cases(model, start):
    """Every criterion, at budgets between the least failure and none."""
    best = solve(criteria.MaxProb(model, start)).objective
    is_free = bool((model.costs == 0.0).any())  # steps may go round within a layer of totals
    budget = min(1.0 - 0.85 * best, 1.0)
    # where failing has no price, pairs of one cost may fail differently: these are no equals
    for chosen in (None, budget) if is_free else (None, budget, 1.0):
        yield f"MCMP {chosen}", lambda b=chosen: criteria.MCMP(model, start, b)
    yield "MCMP discounted", lambda: criteria.MCMP(model, start, 1.0, discount=0.95)
    yield (
        "MCMP limited",
        lambda: criteria.MCMP(model, start, budget, constraints={"often": visits(start) <= 1.4}),
    )
    yield "MaxProb", lambda: criteria.MaxProb(model, start)
    yield "MinProb", lambda: criteria.MinProb(model, start)
    yield "MinCost", lambda: criteria.MinCost(model, start)
    yield "ISSPUDE", lambda: criteria.ISSPUDE(model, start)
    yield "FinitePenalty", lambda: criteria.FinitePenalty(model, start, 20.0)
    yield "AlphaMCMP", lambda: criteria.AlphaMCMP(model, start, 0.9)
    if is_free:
        return
    for chosen in (None, budget, 1.0):
        yield f"S3P {chosen}", lambda b=chosen: criteria.S3P(model, start, b)
    yield "S3P discounted", lambda: criteria.S3P(model, start, 1.0, discount=0.95)
    yield "CVaR", lambda: criteria.CVaR(model, start, 0.8, budget)
    yield "CostQuantile", lambda: criteria.CostQuantile(model, start, 0.5, budget)
    yield "CostBoundedReach", lambda: criteria.CostBoundedReach(model, start, 6)
    yield "EGUBS", lambda: criteria.EGUBS(model, start, -0.1, 1.0)


@pytest.mark.parametrize("draw", [with_duplicates, mirrored_grid])
@pytest.mark.parametrize("seed", range(3))
def test_compiled_loops_and_numpy_come_to_the_same_value(accelerate, draw, seed):
    accelerate(False)
    model, start = draw(seed)
    for name, made in cases(model, start):
        found = []
        for on in (False, True):
            accelerate(on)
            try:
                found.append(solve(made()))
            except SSPError as error:
                found.append(type(error))
        plain, compiled = found
        if isinstance(plain, type):
            assert plain is compiled, name
            continue
        assert plain.objective == pytest.approx(compiled.objective, rel=1e-9)
        for solution in found:
            again = evaluate(solution.policy, made()).objective
            assert solution.objective == pytest.approx(again, rel=1e-11), name


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("rare", "run", "dearer"), [(1e-5, 1e7, 1e-8), (1e-9, 1e9, 1e-4)])
def test_what_is_rarely_entered_and_hardly_left_is_not_equal_there(
    rare, run, dearer, compiled, accelerate
):
    """Twice the run length of steps there, each nearly equal, would add up at the start."""
    accelerate(compiled)

    def going(cost):
        return [(1.0 / run, "g", cost), (1.0 - 1.0 / run, "r", cost)]

    choices = {
        "a": {"go": [(1.0 - rare, "g", 1.0), (rare, "s", 1.0)]},
        "s": {"dear": going(1.0 + dearer), "cheap": going(1.0)},
        "r": {"on": [(1.0, "s", 1.0)]},
    }
    problem = MCMP(model_of(choices, "g"), "a", 0.1)
    solution = solve(problem)
    assert evaluate(solution.policy, problem).objective == pytest.approx(
        solution.objective, rel=1e-12
    )
    assert solution.objective == pytest.approx(1.0 + rare * (2.0 * run - 1.0), rel=1e-9)
