"""Case S for costs without a common unit: sums as levels, grids with a proof on both sides."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from formulations import GUBS, MCMP, S3P
from played import ROOT, ferry
from small_models import model_of
from ssp_lp import SSP, InfeasibleError, ModelError, certify, evaluate, secondary_cost, solve
from ssp_lp.accumulated_cost import process
from ssp_lp.accumulated_cost.totals import (
    Totals,
    _sums_of_walks,
    common_unit,
    exact_cost,
    layers_of,
    sums_of,
)
from ssp_lp.column_generation.compiled_layers import CompiledLayered
from ssp_lp.methods.columns import refined_optimum
from ssp_lp.options import CERTIFYING
from ssp_lp.processes.failure_semantics import start_distribution
from written_models import drawn_table, written

COSTS = (0.37, 1.01, 0.5, 2.03, 1.73, 0.11)


def check_proved(solution, gap=1e-09):
    certificate = certify(solution)
    assert certificate.accepted
    assert max(solution.gap, certificate.gap) < gap


@pytest.mark.slow
@pytest.mark.parametrize("block", range(4))
def test_levels_grids_and_the_lattice(block):
    """All sums as levels give the lattice's optimum; 30 levels bound it from both sides."""
    for seed in range(10 * block, 10 * block + 10):
        rng = np.random.default_rng(seed)
        palette = [0.0, *rng.choice(COSTS, 3).tolist()]
        live = [f"s{i}" for i in range(int(rng.integers(2, 6)))]
        choices = drawn_table(rng, live, ["g", "wall", "g"], palette)
        choices["s0"]["go"] = [(0.7, "g", palette[1]), (0.3, "wall", palette[2])]
        model = model_of(choices)
        budget = float(rng.choice([0.05, 0.1, 0.2, 0.3, 0.5, 1.0]))
        try:
            lattice = CompiledLayered.given_success(model, start_distribution(model, "s0"))
            known = refined_optimum(lattice, budget, CERTIFYING).generated.objective
        except InfeasibleError:
            with pytest.raises(InfeasibleError):
                solve(S3P(model, "s0", budget, cost_levels=3000))
            continue
        exact, rounded = (solve(S3P(model, "s0", budget, cost_levels=n)) for n in (3000, 30))
        assert exact.objective == pytest.approx(known, rel=1e-8 + exact.gap, abs=1e-9), seed
        assert exact.gap < 1e-5, seed
        assert rounded.objective >= known * (1.0 - 1e-9) - 1e-12, seed
        assert rounded.failure_probability <= budget + 1e-9, seed
        for solution in (exact, rounded):
            assert solution.lower_bound <= known * (1.0 + 1e-9) + 1e-12, seed
            assert certify(solution).accepted, seed
            found = evaluate(solution.policy, solution.problem)
            assert found.objective == pytest.approx(solution.objective, rel=1e-9, abs=1e-12), seed


def test_irrational_costs_in_closed_form():
    """The best lottery of two, by hand: never across, across once, across twice."""
    problem = S3P(ferry(), "quay", failure_budget=0.2)
    ways = [(0.0, 4.0), (0.2, 0.8 * (2.0 + ROOT)), (0.36, 0.64 * 2.0 * ROOT)]
    mixtures = [ways[0][1], ways[1][1] / 0.8]
    for (safe, paid), (bold, saved) in product(ways[:2], ways[2:]):
        share = (0.2 - safe) / (bold - safe)
        mixtures.append(((1.0 - share) * paid + share * saved) / 0.8)
    best, solution = min(mixtures), solve(problem)
    assert solution.objective == pytest.approx(best, rel=1e-9)
    check_proved(solution)
    measure = problem.program().solve()
    assert measure.objective == pytest.approx(best, rel=1e-9)
    for policy in (measure.mixed_policy(), measure.randomised_policy()):
        assert evaluate(policy, problem).objective == pytest.approx(best, rel=1e-9)


def test_limits_go_with_levels():
    """The straight hop burns fuel: at most one of two may be straight, on average."""
    fuel = {state: {"straight": 1.0} for state in ("quay", "mid")}
    limits = {"fuel": secondary_cost(fuel) <= 1.0}
    solution = solve(S3P(ferry(), "quay", failure_budget=0.3, constraints=limits))
    assert solution.secondary_costs["fuel"] <= 1.0 + 1e-9
    check_proved(solution)


@pytest.mark.parametrize("held", [1, 2, 5, 1_000])
def test_charges_of_arriving_however_many_layers_are_held(held, monkeypatch):
    """From a total k: half of what k + 1 is worth, a quarter of k + 3, and 0.5 for success."""
    monkeypatch.setattr(process, "_TABLE", 2 * held)
    model = written("x go: 0.5 g 1, 0.5 x 2\n x try: 0.25 g 3, 0.75 x 1")
    worth = lambda c: np.maximum(1.0 - np.asarray(c) / 10.0, 0.0)  # noqa: E731
    layers = GUBS(model, "x", worth, 0.5).compile().pricing().process
    for k in (*range(15), 3, 0):
        known = 0.5 * (worth(k + 1) + 0.5), 0.25 * (worth(k + 3) + 0.5)
        assert -layers.charged(k).total == pytest.approx(known, rel=1e-14)


def test_sums_and_where_steps_lead():
    steps = np.array([0.0, 1.0, ROOT])
    sums = sums_of(steps, 3.0, 100)
    assert sums == pytest.approx([0.0, 1.0, ROOT, 2.0, 1.0 + ROOT, 2.0 * ROOT])
    assert sums_of(steps, 30.0, 50) is None
    assert sums_of(steps[:1], 3.0, 100) == pytest.approx([0.0])
    below, share = Totals(np.array([0.0, 1.0, 2.0, 3.0]), steps).leads
    assert below.tolist() == [[0, 1, 1], [1, 2, 2], [2, 3, 3], [3, 3, 3]]
    assert share[:, 2] == pytest.approx([ROOT - 1.0, ROOT - 1.0, 0.0, 0.0])
    assert not share[:, :2].any()
    quarters = np.append(0.0, np.arange(25.0, 60.0, 0.25))  # too many to form all sums at once
    assert sums_of(quarters[:101], 60.0, 141) == pytest.approx(quarters)
    assert sums_of(quarters[:101], 60.0, 140) is None


@pytest.mark.parametrize("seed", range(6))
def test_the_sums_that_walks_make(seed):
    """All sums of steps are too many here; those of walks from any state are told by following."""
    rng, n, cap = np.random.default_rng(seed), 7, 9.0
    to, price = rng.integers(0, n, (n, 2)), rng.choice([0.0, 0.5, 1.01, ROOT, 1.73], (n, 2))
    model = model_of(
        {
            i: {k: [(1.0, int(to[i, k]), float(price[i, k]))] for k in range(2)}
            | {"home": [(1.0, "g", 1.0)]}
            for i in range(n)
        }
    )
    met = fresh = {(i, 0.0) for i in range(n)}
    while fresh:
        reached = {(int(to[i, k]), round(t + price[i, k], 9)) for i, t in fresh for k in range(2)}
        fresh = {(i, total) for i, total in reached if total < cap} - met
        met = met | fresh
    kinds = np.unique(np.append(price, 0.0))
    expected = sorted({total for _, total in met})
    assert _sums_of_walks(model, kinds, cap, len(expected)) == pytest.approx(expected)
    assert _sums_of_walks(model, kinds, cap, len(expected) - 1) is None


def test_a_sum_of_decimals_is_the_decimal_that_was_meant():
    assert exact_cost(0.1 * 3) == Fraction(3, 10)
    assert exact_cost(sum([0.1] * 8)) == Fraction(8, 10)
    assert exact_cost(ROOT) == Fraction(repr(ROOT))
    assert exact_cost(0.30000001) == Fraction(30000001, 10**8)
    assert exact_cost(0.3 * (1.0 + 1e-11)) != Fraction(3, 10)
    costs = np.array([0.1 * 3, 0.1, 0.7 + 0.1])
    assert common_unit(costs, {}) == Fraction(1, 10)
    assert layers_of(costs, Fraction(1, 10), {}).tolist() == [3, 1, 8]

    def field(dear):
        slow, fast = [(0.9, "b", dear), (0.1, "a", 0.1)], [(0.6, "b", 0.1), (0.4, "wall", 0.1)]
        on = {"go": [(0.8, "home", dear), (0.2, "a", 0.1)]}
        return model_of({"a": {"slow": slow, "fast": fast}, "b": on}, "home")

    meant, summed = (solve(S3P(field(dear), "a", 0.2)) for dear in (0.3, 0.1 * 3))
    assert summed.objective == pytest.approx(meant.objective, rel=1e-12)
    assert summed.run.reason == meant.run.reason
    assert repr(summed.policy) == repr(meant.policy)


def test_what_is_refused():
    with pytest.raises(ModelError, match="cost_levels"):
        S3P(ferry(), "quay", cost_levels=0)
    assert solve(MCMP(ferry(), "quay", 0.0)).objective == pytest.approx(4.0)
    with pytest.raises(ModelError, match="deterministic"):
        solve(S3P(ferry(), "quay", 0.2), "deterministic")


@pytest.mark.parametrize("budget", [0.1, 0.12, 0.15])
def test_a_certificate_finds_the_table_where_more_cost_has_fewer_sums(budget):
    """All sums of six irrational steps are too many soon; those that walks make are few."""
    steps = [1.0, 2**0.5, 3**0.5, 5**0.5, 7**0.5, 1.1**0.5]
    choices = {
        k: {
            "a": [(0.5, after, cost), (0.4, "g", cost + 0.3), (0.1, "d", 1.0)],
            "b": [(0.9, after, 3.0 * cost), (0.08, "g", cost), (0.02, "d", 1.0)],
        }
        for k, (cost, after) in enumerate(zip(steps, [1, 2, 3, 4, 5, "g"], strict=True))
    }
    check_proved(solve(S3P(model_of(choices), 0, failure_budget=budget)))


@pytest.mark.slow
@pytest.mark.parametrize("last", [1e4, 1e6])
def test_a_table_that_cannot_grow_is_searched_to_the_end(last):
    """B is left by a dear sure step or a cheap doubtful one; the first table holds all there is.

    A loop at sqrt(2): E[cost] until b is 1 + sqrt(2), so mixing d and e gives the cost by hand.
    """
    model = written(
        f"""
        a on: 0.5 a {ROOT}, 0.5 b 1
        b d: 0.9 g {last}, 0.1 x 1
        b e: 0.5 g 1, 0.5 x 1
        """
    )
    solution = solve(S3P(model, "a", failure_budget=0.2))
    share = 0.25  # of e: 0.1 + 0.4 * share = 0.2
    mixed = (1 - share) * 0.9 * last + share * 0.5 + 0.8 * (1.0 + ROOT)
    assert solution.objective <= mixed / 0.8 * (1 + 1e-12)
    check_proved(solution)


def test_steps_that_no_run_takes_lead_to_layers_too():
    """No run pays 1e-9 twice, but each layer has all pairs: that sum lies below the cap."""
    totals = Totals(np.array([0.0, 1e-9, 1.5e-9, 10.0]), np.array([0.0, 1e-9, 1.5e-9, 3.3]), True)
    assert totals.reached.max() < len(totals.with_beyond)
    assert (np.diff(totals.with_beyond) > 0.0).all()
    risky = [(5 / 7, "home", 1.5e-9), (1 / 7, "walk", 1.5e-9), (1 / 7, "walk", 1e-9)]
    fast = [(0.6, "home", 1.5e-9), (0.2, "home", 3.3), (0.2, "wall", 1e-9)]
    walk = [(0.5, "ditch", 3.3), (0.5, "home", 3.3)]
    choices = {"s": {"risky": risky, "fast": fast}, "walk": {"on": walk}}
    model = SSP.from_transitions(choices, {"home"}, dead_ends={"wall", "ditch"})
    solution = solve(GUBS(model, "s", lambda cost: np.maximum(1.0 - cost / 10.0, 0.0), 0.7))
    assert solution.objective == pytest.approx(5 / 7 + 0.67 / 7 + 0.6, abs=1e-8)
    assert solution.gap <= 1e-9
