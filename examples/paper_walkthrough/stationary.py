"""Section 3.5 of the paper on the journey, and the linear program beside the game."""

from fractions import Fraction

import numpy as np
from scipy.optimize import linprog

from examples.paper_walkthrough.lottery import ONE, Lottery, adversary, numerator_s, optimum_m
from examples.paper_walkthrough.model import (
    BUDGET,
    FOR_EVER,
    GAMMA,
    START,
    Plan,
    Point,
    Row,
    cost,
    failure,
    journey,
    success_cost,
)
from ssp_lp import MCMP, S3P, Solution, evaluate, solve
from ssp_lp.game import bayes_adaptive, stationary_game, thresholds
from ssp_lp.game.player import label_process
from ssp_lp.processes.failure_semantics import start_distribution

GAMMAS = tuple(1 - Fraction(1, 10**k) for k in (2, 3, 4, 5))
SCAN = tuple(Fraction(k, 20) for k in (2, 4, 6, 8, 10))
LARGE = Fraction(3, 5)
ACCURATE = 1e-10


def section_3_5_m() -> list[Row]:
    """Check c-hat <= c* <= true cost of the stationary policy in case M, all equal as gamma -> 1.

    "P^(M) in P^(S)" in t3-11 means P^(M). c-hat and the true cost differ by E[sum (1 - gamma^t) g]
    <= (1 - gamma) E[sum t g], which is 43/5 (1 - gamma) for the plan (ford, for ever) and less with
    fewer tries.
    """
    model, rows = journey(), []
    for gamma in GAMMAS:
        problem = MCMP(model, start=START, failure_budget=float(BUDGET), discount=float(gamma))
        hat = stationary_game(problem, tolerance=ACCURATE)
        true = evaluate(hat.policy, problem).expected_cost
        star = bayes_adaptive(problem, tolerance=ACCURATE).objective
        # The plans of a stationary lottery: go for ever, or give up at once.
        low = _stationary(optimum_m(gamma, gamma, BUDGET), gamma)
        rows += _sandwich(gamma, (hat.objective, star, true), (
            low.objective,
            optimum_m(ONE, gamma, BUDGET).objective,
            _mean(low, cost(low.safe.plan), cost(low.risky.plan)),
        ), Fraction(43, 5))  # fmt: skip
    exact = solve(MCMP(model, start=START, failure_budget=float(BUDGET))).objective
    return [*rows, Row("exact c*", exact, Fraction(26, 5))]


def section_3_5_s() -> list[Row]:
    """Check c-hat <= c* <= true J^gamma_S3P in case S, where plans depend on accumulated cost.

    M_{o,gamma}^(S) as printed gives gamma^T, Phi a single gamma; T_alpha charges gamma^(T-1). So
    c-hat and the true one differ by at most (1 - gamma) E[(T - 1) r_T; home] / (1 - epsilon), which
    is 139/9 (1 - gamma) for the plan (ford, for ever) and less with fewer tries.
    """
    model, rows = journey(), []
    for gamma in GAMMAS:
        problem = S3P(model, start=START, failure_budget=float(BUDGET), discount=float(gamma))
        hat = stationary_game(problem, tolerance=ACCURATE)
        found = evaluate(hat.policy, problem)
        true = found.success_cost / (1.0 - (found.discounted_failure or 0.0))
        star = bayes_adaptive(problem, tolerance=ACCURATE).objective
        low = numerator_s(gamma, gamma, BUDGET)
        truly = _mean(low, success_cost(low.safe.plan), success_cost(low.risky.plan))
        rows += _sandwich(gamma, (hat.objective, star, true), (
            low.objective / (1 - BUDGET),
            numerator_s(ONE, gamma, BUDGET).objective / (1 - BUDGET),
            truly / (1 - BUDGET),
        ), Fraction(139, 9))  # fmt: skip
    exact = solve(S3P(model, start=START, failure_budget=float(BUDGET))).objective
    return [*rows, Row("exact c*", exact, Fraction(43, 9))]


def _sandwich(
    gamma: Fraction, computed: tuple[float, ...], theory: tuple[Fraction, ...], spread: Fraction
) -> list[Row]:
    """Return rows of one gamma: c-hat, c*, the stationary policy's true value, and their order."""
    names = ("c-hat", "c*", "true value of the stationary policy")
    at = f"gamma = {float(gamma):g}: "
    rows = [Row(at + n, x, y) for n, x, y in zip(names, computed, theory, strict=True)]
    ordered = computed[0] <= computed[1] * (1 + 1e-9) <= computed[2] * (1 + 2e-9)
    rows.append(Row(at + "in this order", float(ordered), 1))
    gap = computed[2] - computed[0]
    rows.append(Row(at + "the gap", gap, theory[2] - theory[0], bound=1e-9 * computed[2]))
    rows.append(Row(at + "the gap closes", gap, 0, bound=float(spread * (1 - gamma))))
    return rows


def _stationary(lottery: Lottery, gamma: Fraction) -> Lottery:
    """Return the optimum as a lottery of plans without a counter of tries.

    With both costs discounted equally, the points of all numbers of tries lie on the segment
    between no try and tries for ever, which are plans of the state alone.
    """
    safe, risky = (
        Point(cost(plan, gamma), failure(plan, gamma), plan)
        for plan in (Plan(True, FOR_EVER), Plan(True, 0))
    )
    return Lottery(safe, risky, lottery.budget)


def _mean(lottery: Lottery, safe: Fraction, risky: Fraction) -> Fraction:
    return safe + lottery.weight * (risky - safe)


def section_3_5_scan() -> list[Row]:
    """Check Theorem 3-1: case S takes the least c* of all epsilon' up to the budget, here 3/5.

    Above the failure of the plan that fails most, (ford, give up), more budget only lowers
    1 - epsilon'.
    """
    riskiest = Plan(True, 0)
    most = failure(riskiest, GAMMA)
    problem = S3P(journey(), start=START, failure_budget=float(LARGE), discount=float(GAMMA))
    budgets = (*SCAN, most, LARGE)
    found = thresholds(problem, [float(e) for e in budgets], tolerance=ACCURATE)
    rows = []
    for budget, threshold in zip(budgets, found, strict=True):
        if budget < most:
            theory = numerator_s(GAMMA, GAMMA, budget).objective
        else:
            theory = success_cost(riskiest, GAMMA)
        name = f"c-hat at epsilon' = {float(budget):.6g}"
        rows.append(Row(name, threshold.high, theory / (1 - budget)))
    least = stationary_game(problem, tolerance=ACCURATE)
    # There every run that gets home has paid 2 at its second step: gamma * 9/20 * 2 over
    # gamma^2 * 9/20.
    return [
        *rows,
        Row("least of them, within epsilon = 3/5", least.objective, 2 / GAMMA),
        Row("epsilon*, where it lies", least.spent, 1 - GAMMA**2 * Fraction(9, 20)),
    ]


def section_duality() -> list[Row]:
    """Compare with the optimum of a linear program and of its dual, also at gamma = 1.

    In case M the dual value is v(depot) - price epsilon, v from Bellman's equation at that price.

    alpha* = c* / (c* + price epsilon) in case M; in case S with c* (1 - epsilon) in place of c*,
    and c* + price in place of the price.
    """
    rows = []
    for discount, gamma in ((None, ONE), (float(GAMMA), GAMMA)):
        for method in ("columns", "lp", "game")[: 2 if discount is None else 3]:
            setting = "exact" if discount is None else f"gamma = {discount:g}"
            for name, make in (("M", MCMP), ("S", S3P)):
                problem = make(
                    journey(), start=START, failure_budget=float(BUDGET), discount=discount
                )
                solution = solve(problem, method=method, tolerance=ACCURATE)
                rows += _dual_rows(f"{name}, {setting}, {method}: ", solution, gamma)
    return [
        *rows,
        *_written_out(),
        Row("M, exact: c* = 26/5", rows[0].computed, Fraction(26, 5)),
        Row("M, exact: price = 7", rows[2].computed, 7),
        Row("M, exact: alpha* = 52/59", rows[3].computed, Fraction(52, 59)),
        Row("S, exact: c* = 43/9", rows[4].computed, Fraction(43, 9)),
        Row("S, exact: price = 110/9", rows[6].computed, Fraction(110, 9)),
        Row("S, exact: alpha* = 43/60", rows[7].computed, Fraction(43, 60)),
    ]


def _written_out() -> list[Row]:
    """Solve the linear program of case M itself: 7 pairs, 4 flow rows, 1 failure row."""
    model = journey()
    problem = MCMP(model, start=START, failure_budget=float(BUDGET))
    # discount=1: no mass is lost, so J_cond is the failure probability.
    start = start_distribution(model, START)
    lp, _ = label_process(model, start, problem.semantics, discount=1.0, later=1.0)
    outflow = np.repeat(np.eye(lp.n_nodes), np.diff(lp.pair_offsets), axis=0)
    flow = (outflow - lp.instant.toarray()).T
    found = linprog(lp.gain_cost, lp.failure[None, :], [float(BUDGET)], flow, lp.start)
    return [
        Row("M, exact, written out: c*", float(lp.gain_cost @ found.x), Fraction(26, 5)),
        Row("M, exact, written out: price", -found.ineqlin.marginals[0], 7),
        Row("M, exact, written out: v(depot)", found.eqlin.marginals[0], Fraction(59, 10)),
    ]


def _dual_rows(name: str, solution: Solution, gamma: Fraction) -> list[Row]:
    """Return rows of primal value, dual value, price and alpha*."""
    best = (numerator_s if solution.problem.ratio else optimum_m)(gamma, gamma, BUDGET)
    share = 1 - BUDGET if solution.problem.ratio else ONE
    c = best.objective / share
    price = best.price - c if solution.problem.ratio else best.price
    weight = adversary(best.objective, best.price, BUDGET)
    return [
        Row(name + "c*", solution.objective, c),
        Row(name + "dual value", solution.lower_bound, c),
        Row(name + "price", solution.failure_price or 0.0, price),
        Row(name + "alpha*", solution.adversary_weight or 0.0, weight),
    ]
