"""Case S for costs without a common unit: sums as levels, grids with a proof on both sides."""

from __future__ import annotations

import re
from fractions import Fraction

import numpy as np
import pytest

from formulations import MCMP, S3P
from played import ROOT, ferry
from small_models import model_of
from ssp_lp import (
    SSP,
    InfeasibleError,
    ModelError,
    certify,
    evaluate,
    secondary_cost,
    simulate,
    solve,
)
from ssp_lp.accumulated_cost.totals import (
    Totals,
    _walked_sums,
    common_unit,
    exact_cost,
    layers_of,
    sums_of,
)
from ssp_lp.column_generation.compiled_problem import (
    CompiledAccumulatedCost,
)
from ssp_lp.methods.columns import refined_optimum
from ssp_lp.options import CERTIFYING
from ssp_lp.processes.failure_semantics import start_distribution

COSTS = (0.37, 1.01, 0.5, 2.03, 1.73, 0.11)


def drawn_model(rng: np.random.Generator) -> SSP:
    """A few states with loops, some of them free, and two or three different costs."""
    live = [f"s{i}" for i in range(int(rng.integers(2, 6)))]
    palette = [float(rng.choice(COSTS)) for _ in range(int(rng.integers(2, 4)))]
    choices: dict[str, dict[str, list[tuple[float, str, float]]]] = {}
    for state in live:
        choices[state] = {}
        for action in range(int(rng.integers(1, 4))):
            count = int(rng.integers(1, 4))
            successors = rng.choice([*live, "home", "wall", "home"], size=count)
            weights = rng.integers(1, 6, size=count).astype(float)
            free = rng.random() < 0.15
            choices[state][f"a{action}"] = [
                (float(w), str(s), 0.0 if free else float(rng.choice(palette)))
                for w, s in zip(weights / weights.sum(), successors, strict=True)
            ]
    choices["s0"]["go"] = [(0.7, "home", palette[0]), (0.3, "wall", palette[1])]
    choices |= {"home": {}, "wall": {}}
    return model_of(choices, "home")


@pytest.mark.parametrize("block", range(4))
def test_levels_grids_and_the_lattice(block: int) -> None:
    """All sums as levels give the lattice's optimum; 30 levels bound it from both sides."""
    for seed in range(20 * block, 20 * block + 20):
        rng = np.random.default_rng(seed)
        model = drawn_model(rng)
        budget = float(rng.choice([0.05, 0.1, 0.2, 0.3, 0.5, 1.0]))
        try:
            lattice = CompiledAccumulatedCost(model, start_distribution(model, "s0"))
            known = refined_optimum(lattice, budget, CERTIFYING).generated.objective
        except InfeasibleError:
            with pytest.raises(InfeasibleError):
                solve(S3P(model, "s0", budget, cost_levels=3000))
            continue
        exact = solve(S3P(model, "s0", budget, cost_levels=3000))
        assert exact.objective == pytest.approx(known, rel=1e-8 + exact.gap, abs=1e-9), seed
        assert exact.lower_bound <= known * (1.0 + 1e-9) + 1e-12, seed
        assert exact.gap < 1e-5, seed
        rounded = solve(S3P(model, "s0", budget, cost_levels=30))
        assert rounded.lower_bound <= known * (1.0 + 1e-9) + 1e-12, seed
        assert rounded.objective >= known * (1.0 - 1e-9) - 1e-12, seed
        assert rounded.failure_probability <= budget + 1e-9, seed
        for solution in (exact, rounded):
            assert certify(solution).accepted, seed
            found = evaluate(solution.policy, solution.problem)
            assert found.objective == pytest.approx(solution.objective, rel=1e-9, abs=1e-12), seed


def test_irrational_costs_in_closed_form() -> None:
    """Budget 0.2: one diagonal hop at most, (2 + sqrt(2)) given success."""
    problem = S3P(ferry(), "quay", failure_budget=0.2)
    solution = solve(problem)
    lottery = {"one": (0.2, 0.8 * (2.0 + ROOT)), "two": (0.36, 0.64 * 2.0 * ROOT), "no": (0.0, 4.0)}
    pairs = [
        (a, b) for a in lottery.values() for b in lottery.values() if a[0] <= 0.2 < b[0] or a is b
    ]
    best = min(
        _mixed(a, b, 0.2) for a, b in pairs if a[0] <= 0.2
    )  # the best lottery of two, by hand
    assert solution.objective == pytest.approx(best, rel=1e-9)
    assert solution.gap < 1e-9
    assert certify(solution).accepted
    measure = problem.program().solve()
    assert measure.objective == pytest.approx(best, rel=1e-9)
    for policy in (measure.mixed_policy(), measure.randomised_policy()):
        assert evaluate(policy, problem).objective == pytest.approx(best, rel=1e-9)


def _mixed(one: tuple[float, float], other: tuple[float, float], budget: float) -> float:
    """Cost given success of the mixture of two policies that meets the budget."""
    share = 0.0 if other is one else (budget - one[0]) / (other[0] - one[0])
    cost = (1.0 - share) * one[1] + share * other[1]
    return cost / (1.0 - (1.0 - share) * one[0] - share * other[0])


def test_many_real_costs_are_solved_on_a_grid() -> None:
    """A windy walk with a cost of its own for each step; the gap is honest and small."""
    rng = np.random.default_rng(3)
    choices: dict[int, dict[str, list[tuple[float, object, float]]]] = {}
    for cell in range(12):
        after = "home" if cell == 11 else cell + 1
        back = max(cell - 1, 0)
        run, walk = (float(x) for x in rng.uniform(0.5, 1.5, 2))
        choices[cell] = {
            "run": [(0.85, after, run), (0.1, back, run), (0.05, "sea", run)],
            "walk": [(0.7, after, 2.0 * walk), (0.29, back, walk), (0.01, "sea", walk)],
        }
    model = model_of({**choices, "sea": {}, "home": {}}, "home")
    problem = S3P(model, 0, failure_budget=0.3)
    solution = solve(problem, tolerance=1e-5)
    assert 0.0 <= solution.gap < 1e-4
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.gap < 1e-4
    report = simulate(
        solution.policy,
        problem,
        episodes=20_000,
        rng=np.random.default_rng(1),
        confidence=0.9999,
    )
    for seen, known in (
        (report.goal_probability, solution.goal_probability),
        (report.conditional_cost, solution.conditional_cost),
    ):
        assert seen.low <= known <= seen.high
    coarse = solve(S3P(model, 0, failure_budget=0.3, cost_levels=100), tolerance=1e-9)
    assert coarse.lower_bound <= solution.objective <= coarse.objective * (1.0 + 1e-9)
    told = re.search(r"(\d+) levels", coarse.note)
    assert told is not None
    assert 10 < int(told[1]) <= 100


def test_limits_go_with_levels() -> None:
    """The straight hop burns fuel: at most one of two may be straight, on average."""
    fuel = {state: {"straight": 1.0} for state in ("quay", "mid")}
    limits = {"fuel": secondary_cost(fuel) <= 1.0}
    solution = solve(S3P(ferry(), "quay", failure_budget=0.3, constraints=limits))
    assert solution.secondary_costs["fuel"] <= 1.0 + 1e-9
    assert solution.gap < 1e-9
    assert certify(solution).accepted


def test_sums_and_where_steps_lead() -> None:
    steps = np.array([0.0, 1.0, ROOT])
    sums = sums_of(steps, 3.0, 100)
    assert sums == pytest.approx([0.0, 1.0, ROOT, 2.0, 1.0 + ROOT, 2.0 * ROOT])
    assert sums_of(steps, 30.0, 50) is None
    assert sums_of(steps[:1], 3.0, 100) == pytest.approx([0.0])
    below, share = Totals(np.array([0.0, 1.0, 2.0, 3.0]), steps).leads
    assert below.tolist() == [[0, 1, 1], [1, 2, 2], [2, 3, 3], [3, 3, 3]]
    assert share[:, 2] == pytest.approx([ROOT - 1.0, ROOT - 1.0, 0.0, 0.0])
    assert not share[:, :2].any()


@pytest.mark.parametrize("seed", range(6))
def test_the_sums_that_walks_make(seed: int) -> None:
    """All sums of steps are too many here; those of walks from any state are told by following."""
    rng, n, cap = np.random.default_rng(seed), 7, 9.0
    prices = np.array([0.0, 0.5, 1.01, ROOT, 1.73])
    named = [f"s{i}" for i in range(n)]
    choices: dict[str, dict[str, list[tuple[float, str, float]]]] = {"home": {}}
    steps: list[tuple[int, int, float]] = []
    for i in range(n):
        to, price = rng.integers(0, n, 2), rng.choice(prices, 2)
        choices[named[i]] = {"home": [(1.0, "home", 1.0)]} | {
            f"a{k}": [(1.0, named[to[k]], float(price[k]))] for k in range(2)
        }
        steps += [(i, int(to[k]), float(price[k])) for k in range(2)]
    met = fresh = {(i, 0.0) for i in range(n)}
    while fresh:
        reached = {
            (b, round(total + c, 9)) for (at, total) in fresh for (a, b, c) in steps if a == at
        }
        fresh = {(b, total) for (b, total) in reached if total < cap} - met
        met = met | fresh
    model = model_of(choices, "home")
    kinds = np.unique([c for _, _, c in steps] + [0.0])
    expected = sorted({total for _, total in met})
    assert _walked_sums(model, kinds, cap, len(expected)) == pytest.approx(expected)
    assert _walked_sums(model, kinds, cap, len(expected) - 1) is None


def test_a_sum_of_decimals_is_the_decimal_that_was_meant() -> None:
    assert exact_cost(0.1 * 3) == Fraction(3, 10)
    assert exact_cost(sum([0.1] * 8)) == Fraction(8, 10)
    assert exact_cost(ROOT) == Fraction(repr(ROOT))
    assert exact_cost(0.30000001) == Fraction(30000001, 10**8)
    assert exact_cost(0.3 * (1.0 + 1e-11)) != Fraction(3, 10)
    costs = np.array([0.1 * 3, 0.1, 0.7 + 0.1])
    assert common_unit(costs, {}) == Fraction(1, 10)
    assert layers_of(costs, Fraction(1, 10), {}).tolist() == [3, 1, 8]

    def field(dear: float) -> SSP:
        slow, fast = [(0.9, "b", dear), (0.1, "a", 0.1)], [(0.6, "b", 0.1), (0.4, "wall", 0.1)]
        on = {"go": [(0.8, "home", dear), (0.2, "a", 0.1)]}
        return model_of(
            {"a": {"slow": slow, "fast": fast}, "b": on, "home": {}, "wall": {}}, "home"
        )

    meant, summed = (solve(S3P(field(dear), "a", 0.2)) for dear in (0.3, 0.1 * 3))
    assert summed.objective == pytest.approx(meant.objective, rel=1e-12)
    assert summed.run.reason == meant.run.reason
    assert repr(summed.policy) == repr(meant.policy)


def test_no_sum_of_many_steps_is_lost() -> None:
    """A hundred steps, too many for all sums to be formed at once: quarters from 25 up to a cap."""
    quarters = np.append(0.0, np.arange(25.0, 60.0, 0.25))
    assert sums_of(quarters[:101], 60.0, 141) == pytest.approx(quarters)
    assert sums_of(quarters[:101], 60.0, 140) is None


def test_what_is_refused() -> None:
    with pytest.raises(ModelError, match="cost_levels"):
        S3P(ferry(), "quay", cost_levels=0)
    assert solve(MCMP(ferry(), "quay", 0.0)).objective == pytest.approx(4.0)
    with pytest.raises(ModelError, match="deterministic"):
        solve(S3P(ferry(), "quay", 0.2), "deterministic")


@pytest.mark.parametrize("budget", [0.1, 0.12, 0.15])
def test_a_certificate_finds_the_table_where_more_cost_has_fewer_sums(budget: float) -> None:
    """All sums of six irrational steps are too many soon; those that walks make are few."""
    step = [1.0, 2**0.5, 3**0.5, 5**0.5, 7**0.5, 1.1**0.5]
    choices: dict = {"d": {}}
    for k, cost in enumerate(step):
        following = k + 1 if k < len(step) - 1 else "g"
        choices[k] = {
            "a": [(0.5, following, cost), (0.4, "g", cost + 0.3), (0.1, "d", 1.0)],
            "b": [(0.9, following, 3.0 * cost), (0.08, "g", cost), (0.02, "d", 1.0)],
        }
    model = model_of(choices)
    solution = solve(S3P(model, 0, failure_budget=budget))
    assert solution.gap < 1e-9
    assert certify(solution).gap < 1e-9


@pytest.mark.parametrize("last", [1e4, 1e6])
def test_a_table_that_cannot_grow_is_searched_to_the_end(last: float) -> None:
    """B is left by a dear sure step or a cheap doubtful one; the first table holds all there is.

    A loop at sqrt(2): E[cost] until b is 1 + sqrt(2), so mixing d and e gives the cost by hand.
    """
    choices: dict = {
        "a": {"on": [(0.5, "a", ROOT), (0.5, "b", 1.0)]},
        "b": {
            "d": [(0.9, "g", last), (0.1, "x", 1.0)],
            "e": [(0.5, "g", 1.0), (0.5, "x", 1.0)],
        },
        "x": {},
    }
    model = model_of(choices)
    solution = solve(S3P(model, "a", failure_budget=0.2))
    share = 0.25  # of e: 0.1 + 0.4 * share = 0.2
    mixed = (1 - share) * 0.9 * last + share * 0.5 + 0.8 * (1.0 + ROOT)
    assert solution.objective <= mixed / 0.8 * (1 + 1e-12)
    assert solution.gap < 1e-9
    assert certify(solution).gap < 1e-9
