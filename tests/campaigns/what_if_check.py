"""Derivatives of the optimum by the numbers of random problems beside differences of optima.

    python tests/campaigns/what_if_check.py --count 500 --seed 0

Models have 2 to 60 states with loops, free steps, dead-ends with and without actions, ties, one
start or two; problems are MCMP, S3P, MaxProb, MinCost and FinitePenalty with up to three limits, a
discount or a horizon. Of each draw some numbers are moved, alone and in groups, and the problem is
solved again by column generation, four times on each side and at two widths: where both widths
agree, the derivative of that side must be theirs, to 1e-6 of its size. In case M the optimum must
be linear in some bounds and costs up to the stated breakpoints. Prints what differs, and a table of
counts.
"""

import sys
from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from formulations import MCMP, S3P, FinitePenalty, MaxProb, MinCost
from ssp_lp import (
    SSP,
    InfeasibleError,
    SolverError,
    SSPError,
    end_probability,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.analysis.what_if import Change, Effect, WhatIf, what_if
from tests.campaigns.campaign import run

FORWARD = np.array([-25.0, 48.0, -36.0, 16.0, -3.0]) / 12.0  # of the fourth order, one-sided
WIDTHS = 2e-4, 1e-4  # of a step; relative to the greatest step
SETTLED, SAME = 2e-7, 1e-6  # relative differences: of both widths, and of the derivative
EXACT = 1e-11  # relative gap of the optima
LINEAR = 1e-8  # relative distance of an optimum from a line
CRITERIA = ("MCMP", "FinitePenalty", "MaxProb", "MinCost", "S3P")


def drawn_model(rng: np.random.Generator, criterion: str, *, small: bool) -> SSP:
    """A model of some states, whose costs are in [0.5, 3], whole in case S; some steps are free."""
    size = int(rng.integers(2, 6)) if small or rng.random() < 0.8 else int(rng.integers(6, 61))
    ends = ["home", "pit", "fire"] if criterion != "MinCost" else ["home"]
    table: dict[Any, Any] = {}
    for state in range(size):
        table[state] = {}
        for action in range(int(rng.integers(1, 4))):
            count = min(int(rng.integers(1, 4)), size)
            to = [*rng.choice(size, count, replace=False).tolist()]
            to += [str(rng.choice(ends))] if rng.random() < 0.5 else []
            to += ["home"] if rng.random() < 0.5 or action == 0 else []
            to = list(dict.fromkeys(to))
            chances = rng.random(len(to)) + 0.2
            whole = criterion == "S3P"
            costs = (
                rng.integers(1, 4, len(to)) if whole else rng.uniform(0.5, 3.0, len(to)).round(2)
            )
            costs = np.full(len(to), costs[0]) if rng.random() < 0.7 else costs
            costs = 0.0 * costs if rng.random() < 0.1 else costs
            some = zip((chances / chances.sum()).tolist(), to, costs.tolist(), strict=True)
            table[state][f"a{action}"] = [
                (p, s, {"time": c, "fuel": float(rng.integers(0, 3))}) for p, s, c in some
            ]
        if rng.random() < 0.15:  # a tie
            table[state]["again"] = [*table[state]["a0"]]
    table["pit"] = {}
    spare = {"time": 1.0, "fuel": 1.0}, {"time": 2.5, "fuel": 1.0}
    table["fire"] = {f"b{k}": [(1.0, "fire", each)] for k, each in enumerate(spare)}
    used = {to for acts in table.values() for outs in acts.values() for _, to, _ in outs}
    table = {state: acts for state, acts in table.items() if state in used | {*range(size)}}
    return SSP.from_transitions(
        table, {"home"}, cost="time", treat_actionless_as_dead_ends=True,
        state_labels={"lost": lambda state: state == "pit"},
    )  # fmt: skip


def drawn_problem(rng: np.random.Generator, criterion: str, *, small: bool = False) -> Any:
    """A problem that some policy satisfies, with limits that may matter."""
    model = drawn_model(rng, criterion, small=small)
    start = 0 if rng.random() < 0.6 else {0: 0.6, 1: 0.4}
    least = 1.0 - solve(MaxProb(model, start)).objective
    budget = least + (1.0 - least) * float(rng.uniform(0.02, 0.6))
    budget = None if criterion == "MCMP" and rng.random() < 0.1 else budget
    more, penalty = dict[str, Any](), float(rng.uniform(2, 30))
    if criterion in ("MCMP", "FinitePenalty"):
        more["give_up"] = str(rng.choice(["anywhere", "attention", "dead_ends"]))
        more["charge_failing_step"] = bool(rng.random() < 0.5)
    if criterion in ("MCMP", "FinitePenalty", "S3P") and budget is not None and rng.random() < 0.2:
        more["discount"] = float(rng.choice([0.9, 0.97]))
    elif rng.random() < 0.2:
        more["horizon"] = int(rng.integers(3, 8))
    make: dict[str, Any] = {
        "MCMP": lambda **k: MCMP(model, start, budget, **k),
        "S3P": lambda **k: S3P(model, start, budget, **k),
        "FinitePenalty": lambda **k: FinitePenalty(model, start, penalty, **k),
        "MaxProb": lambda **k: MaxProb(model, start, **k),
        "MinCost": lambda **k: MinCost(model, start, **k),
    }
    free = solve(make[criterion](**more))
    return make[criterion](**more, constraints=drawn_limits(rng, free, criterion))


def drawn_limits(rng: np.random.Generator, free: Any, criterion: str) -> dict[str, Any]:
    """Up to three limits somewhat below what the unlimited optimum takes."""
    labels = free.problem.model.state_labels
    known = {"fuel": secondary_cost("fuel"), "early": visits(1)}
    if criterion != "MinCost" and labels["lost"].size:
        known["lost"] = end_probability("lost")
    count = int(rng.choice([0, 1, 2, 3], p=[0.4, 0.35, 0.15, 0.1]))
    limits: dict[str, Any] = {}
    for name in rng.permutation([*known])[:count].tolist():
        wanted = {name: known[name] <= 1e6}
        spent = solve(replaced(free.problem, constraints=wanted)).secondary_costs[name]
        limits[name] = known[name] <= float(spent * rng.uniform(0.85, 1.1))
    return limits


def replaced(problem: Any, **changes: Any) -> Any:
    """The problem with other arguments."""
    from dataclasses import replace

    from ssp_lp.problem import as_stated

    return replace(problem, **changes, **as_stated(problem))


def one_sided(problem: Any, change: Change, sign: float, width: float, middle: float) -> float:
    """The derivative on one side by differences of optima."""
    most = change.most(problem, sign)
    step = sign * min(width, width * 100.0 * most)
    if 4.0 * abs(step) >= most:
        return float("nan")
    optima = [middle]
    for k in range(1, 5):
        optima.append(solve(change.applied(problem, k * step), tolerance=EXACT).objective)
    return float(FORWARD @ optima) / step


def differences(problem: Any, change: Change) -> Iterator[tuple[str, float | None]]:
    """Side and derivative by differences; None: it is not settled."""
    middle = solve(problem, tolerance=EXACT).objective
    for side, sign in (("left", -1.0), ("right", 1.0)):
        try:
            wide, near = (one_sided(problem, change, sign, h, middle) for h in WIDTHS)
        except InfeasibleError:
            yield side, None
            continue
        settled = abs(wide - near) <= SETTLED * (1.0 + abs(near))
        yield side, near if settled else None


def of_the_lottery(problem: Any, effect: Effect) -> Iterator[str]:
    """In case S no optimum beside lies above the line of the lottery, by a cost's slope."""
    middle, slope = solve(problem, tolerance=EXACT).objective, effect.right
    for step in (-0.5, 0.5):
        if slope is not None and effect.number.change.most(problem, step) >= 0.5:
            moved = effect.number.change.applied(problem, step)
            beside, line = -np.inf, middle + slope * step
            with suppress(InfeasibleError):  # the cost of a limit moved, too
                beside = solve(moved, tolerance=EXACT).objective
            if beside > line + SAME * line:
                yield f"{problem!r}: {effect.number.name}: {beside!r} at {step:g}, above {line!r}"


def of_breakpoints(report: WhatIf, effect: Effect, tally: Counter[str]) -> Iterator[str]:
    """In case M the optimum is linear in a bound or the cost up to breakpoints, by bisection."""
    problem, slope = report.problem, effect.derivative
    if slope is None:
        return
    middle, change = solve(problem, tolerance=EXACT).objective, effect.number.change
    for end in report.breakpoints(effect.number):

        def is_linear(step: float) -> bool:
            optimum = solve(change.applied(problem, step), tolerance=EXACT).objective
            return abs(optimum - middle - slope * step) <= LINEAR * (1.0 + abs(optimum))

        low, high = 0.0, 1.2 * end
        if abs(end) < 1e-3 or abs(high) >= change.most(problem, end):
            continue
        for _ in range(16):
            reach = (low + high) / 2.0
            try:
                low, high = (reach, high) if is_linear(reach) else (low, reach)
            except SSPError:  # infeasible, or a negative penalty
                high = reach
        tally["breakpoints"] += 1
        tally["breakpoints at which the slope changes"] += abs(low - end) <= 1e-4 * abs(end)
        if abs(low) < abs(end) * (1.0 - 1e-4):
            yield f"{problem!r}: {effect.number.name}: breakpoint {end!r}, linear to {low!r} only"


def told(report: WhatIf, tally: Counter[str]) -> Iterator[str]:
    """What is wrong with the derivatives of a report."""
    problem = report.problem
    for effect in report.effects:
        change = effect.number.change
        if problem.ratio and any(name == "time" for name, _ in change.costs):
            tally["lines"] += 1
            yield from of_the_lottery(problem, effect)
            continue
        is_minimised = all(name == "time" for name, _ in change.costs)  # of a limit: a hyperbola
        is_linear = effect.number.kind in ("bound", "cost") and is_minimised and not problem.ratio
        rarely = sum(tally[name] for name in CRITERIA) % 20 == 1  # it takes many solves
        if effect is report.effects[0] and is_linear and rarely:
            yield from of_breakpoints(report, effect, tally)
        for side, by_differences in differences(problem, change):
            stated = getattr(effect, side)
            if by_differences is None:
                tally["not settled"] += 1
            elif stated is None:
                tally["not answered"] += 1
                tally[effect.note[:60]] += 1
            else:
                tally["compared"] += 1
                size = 1.0 + abs(by_differences)
                error = abs(stated - by_differences) / size
                tally["kinks"] += side == "right" and effect.derivative is None
                if error > SAME:
                    yield (f"{problem!r}: {effect.number.name}, {side}: {stated!r}, by differences "
                           f"{by_differences!r} {effect.note}")  # fmt: skip


def check(seed: int, tally: Counter[str], asked: Namespace) -> Iterator[str]:
    """What is wrong with the derivatives of the problem of a seed."""
    rng = np.random.default_rng(seed)
    criterion = CRITERIA[seed % len(CRITERIA)]
    try:
        problem = drawn_problem(rng, criterion, small=asked.small)
        solve(problem)
    except InfeasibleError:
        tally["infeasible"] += 1
        return
    tally[criterion] += 1
    chosen = np.random.default_rng(seed)
    share = min(1.0, asked.numbers / problem.model.n_outcomes)

    def some(number: Any) -> str | None:
        draw = chosen.random()
        if number.kind == "bound":
            return number.name if draw < 0.175 * asked.numbers else None
        if draw < share / 6:
            return f"{number.kind} together" if number.kind != "start" else None
        return number.name if draw < share else None

    try:
        report = what_if(problem, by=some)
        yield from told(report, tally)
    except SSPError as error:
        if "after failing" in str(error) or isinstance(error, SolverError):
            tally[f"refused, {type(error).__name__}"] += 1
            return
        yield f"{problem!r}: {type(error).__name__}: {error}"


def add_options(parser: ArgumentParser) -> None:
    """Add the options of the command line."""
    parser.add_argument("--small", action="store_true", help="models of at most 5 states")
    parser.add_argument("--numbers", type=float, default=4.0, help="derivatives of a problem")


def main(arguments: Sequence[str] | None = None) -> int:
    """Check draws from the command line; 1 if anything was wrong."""
    return run(__doc__, check, arguments, count=200, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
