"""Criteria of the law of the total cost where costs have no common unit, beside exact programs.

The reference tells every (state, total) apart in exact fractions, a float being its shortest
decimal; steps that cost something lead on, so that totals are finitely many.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import pytest

from formulations import EGUBS, GUBS, CostBoundedReach, CostQuantile, CVaR
from own_criteria import Lateness
from references import combined
from references.combined import Limit, Program, Task
from small_models import model_of
from ssp_lp import SSP, InfeasibleError, ModelError, certify, evaluate, secondary_cost, solve
from ssp_lp.io import Controller, load_policy, save_policy, write_controller
from ssp_lp.policies import CostAwarePolicy

GROUPS = (("s0", "s1"), ("s2",), ("s3", "s4"))
LIVE = tuple(state for group in GROUPS for state in group)
ENDS = ("home", "home", "wall")
ROOT = 2.0**0.5
PALETTES = {
    "rational": (Fraction(1, 3), Fraction(1, 7), 0.1, 2.5),
    "irrational": (ROOT, 3.0**0.5, float(np.pi), 1.0),
    "mixed": (1e-6, 1e6, ROOT * 5e-6, 3.3),
}


def exact(cost: float | Fraction) -> Fraction:
    return cost if isinstance(cost, Fraction) else Fraction(repr(float(cost)))


class Drawn(NamedTuple):
    """A model, as the library and as the reference sees it, and what may be asked."""

    model: SSP
    task: Task
    program: Program
    totals: list[Fraction]
    level: float
    bound: float
    scale: float
    limits: dict

    def least(self, charge: Callable[[Fraction], float]) -> float | None:
        charged = combined.charged(self.program, charge)
        return combined.least(self.task, self.program, charged, ratio=True)

    def greatest(self, worth: Callable[[Fraction], float]) -> float | None:
        charged = combined.charged(self.program, lambda total: -worth(total))
        found = combined.least(self.task, self.program, charged, ratio=False)
        return None if found is None else -found


def drawn(rng: np.random.Generator, kind: str, *, limited: bool) -> Drawn:
    """Five states in three groups: free steps stay in theirs or lead on, others lead on."""
    palette = rng.permutation(np.array(PALETTES[kind], dtype=object))[:3]
    choices: dict[str, dict[str, list]] = {end: {} for end in ENDS}
    for number, group in enumerate(GROUPS):
        for state in group:
            choices[state] = {}
            for action in range(int(rng.integers(1, 4))):
                free = rng.random() < 0.3
                after = [s for g in GROUPS[number + (not free) :] for s in g]
                count = int(rng.integers(1, 4))
                weights = rng.integers(1, 6, size=count).astype(float)
                choices[state][f"a{action}"] = [
                    (float(w), str(s), 0 if free else palette[rng.integers(3)])
                    for w, s in zip(
                        weights / weights.sum(), rng.choice([*after, *ENDS], count), strict=True
                    )
                ]
    choices["s0"]["go"] = [(0.8, "home", palette[0]), (0.2, "wall", palette[1])]
    model = model_of(choices, "home")
    counted = {
        state: {a: [(p, s, exact(c)) for p, s, c in outs] for a, outs in actions.items()}
        for state, actions in choices.items()
    }
    fuel = {s: {a: float(rng.integers(0, 4)) for a in choices[s]} for s in LIVE}
    most = float(rng.choice([0.5, 1.0, 2.0])) if limited else 0.0
    budget = float(rng.choice([0.2, 0.3, 0.5, 1.0]))
    within = (Limit({"fuel": 1.0}, "<=", most),) if limited else ()
    task = Task(counted, frozenset({"home"}), {"s0": 1.0}, fuel, within, budget)
    program = combined.program(task, 10**12)
    totals = sorted({total for here in program.arrivals for _, total in here})
    bound = float(totals[int(rng.integers(len(totals)))]) * float(rng.choice([1.0, 1.1]))
    limits = {"fuel": secondary_cost(fuel) <= most} if limited else {}
    level = float(rng.choice([0.3, 0.5, 0.8]))
    return Drawn(model, task, program, totals, level, bound, float(totals[-1]) or 1.0, limits)


def tail_mean(d: Drawn) -> float | None:
    share = Fraction(1.0 - d.level)
    found = [d.least(lambda c, z=z: float(z + max(c - z, 0) / share)) for z in d.totals]
    return None if None in found else min(found)


def quantile(d: Drawn) -> float | None:
    for bound in d.totals:
        late = d.least(lambda total, bound=bound: float(total > bound))
        if late is None or late <= 1.0 - d.level + 1e-9:
            return None if late is None else float(bound)
    return None


def utility(scale: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda cost: 1.0 / (1.0 + 3.0 * np.asarray(cost, dtype=float) / scale)


CRITERIA = {
    "CVaR": (lambda d, **k: CVaR(d.model, "s0", d.level, d.task.most_failure, **k), tail_mean),
    "Lateness": (
        lambda d, **k: Lateness(d.model, "s0", d.bound, d.task.most_failure, **k),
        lambda d: d.least(lambda total: max(float(total) - d.bound, 0.0)),
    ),
    "CostQuantile": (
        lambda d, **k: CostQuantile(d.model, "s0", d.level, d.task.most_failure, **k),
        quantile,
    ),
    "CostBoundedReach": (
        lambda d, **k: CostBoundedReach(d.model, "s0", d.bound, d.task.most_failure, **k),
        lambda d: d.greatest(lambda total: float(float(total) <= d.bound * (1.0 + 1e-13))),
    ),
    "GUBS": (
        lambda d, **k: GUBS(d.model, "s0", utility(d.scale), 0.7, **k),
        lambda d: d.greatest(lambda total: float(utility(d.scale)(float(total))) + 0.7),
    ),
    "EGUBS": (
        lambda d, **k: EGUBS(d.model, "s0", -2.0 / d.scale, 0.7, **k),
        lambda d: d.greatest(lambda total: float(np.exp(-2.0 * float(total) / d.scale)) + 0.7),
    ),
}


def posed(name: str, d: Drawn, **more: int) -> tuple[object, float | None]:
    """The problem, and its optimum by the reference; None: there is none."""
    make, answer = CRITERIA[name]
    if name in ("GUBS", "EGUBS"):
        d = d._replace(task=d.task._replace(most_failure=1.0))
    return make(d, constraints=d.limits, **more), answer(d)


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("kind", PALETTES)
@pytest.mark.parametrize("name", CRITERIA)
def test_sums_that_can_occur_give_the_optimum(name: str, kind: str, limited: bool) -> None:
    for seed in range(2):
        d = drawn(np.random.default_rng([seed, len(kind)]), kind, limited=limited)
        problem, expected = posed(name, d)
        if expected is None:
            with pytest.raises(InfeasibleError):
                solve(problem)
            continue
        solution = solve(problem)
        assert solution.objective == pytest.approx(expected, rel=1e-8, abs=1e-12), seed
        certificate = certify(solution)
        assert certificate.accepted, (seed, certificate.reason)
        assert certificate.gap < 1e-8, seed
        assert evaluate(solution.policy, problem).objective == pytest.approx(
            solution.objective, rel=1e-9, abs=1e-15
        )


@pytest.mark.parametrize("name", CRITERIA)
def test_few_levels_bound_the_optimum_from_both_sides(name: str) -> None:
    for seed in range(4):
        d = drawn(np.random.default_rng([7, seed]), "irrational", limited=seed % 3 == 0)
        problem, expected = posed(name, d, cost_levels=3)
        if expected is None:
            with pytest.raises(InfeasibleError):
                solve(problem)
            continue
        solution = solve(problem)
        low, high = solution.lower_bound, solution.objective
        if solution.upper_bound is not None:
            low, high = solution.objective, solution.upper_bound
        room = 1e-9 * max(abs(expected), 1.0)
        assert low - room <= expected <= high + room, seed
        assert certify(solution).accepted, seed
        assert solution.failure_probability <= problem.failure_budget + 1e-9, seed


def test_a_controller_keeps_irrational_totals(tmp_path) -> None:
    """Two hops, straight or across: the second depends on what the first has cost."""
    hops = {
        "straight": [(1.0, "mid", 2.0)],
        "across": [(0.5, "mid", ROOT), (0.5, "mid", 2.0 * ROOT)],
    }
    last = {"sure": [(1.0, "home", ROOT)], "bold": [(0.6, "home", 1.0), (0.4, "sea", 1.0)]}
    model = model_of({"quay": hops, "mid": last, "sea": {}, "home": {}}, "home")
    problem = CostBoundedReach(model, "quay", 1.0 + 2.0 * ROOT)  # in time after any first hop
    solution = solve(problem)
    assert solution.objective == pytest.approx(1.0)  # straight, sure
    problem = CostBoundedReach(model, "quay", 2.0 * ROOT)
    solution = solve(problem)  # across: sure if it was cheap; else neither is in time
    assert solution.objective == pytest.approx(0.5)
    save_policy(solution.policy, tmp_path / "policy.zip")
    loaded = load_policy(tmp_path / "policy.zip", model)
    assert evaluate(loaded, problem).objective == solution.objective
    write_controller(solution.policy, tmp_path / "controller.json")
    controller = Controller(tmp_path / "controller.json")
    controller.reset(0)
    assert controller.action("quay") == "across"
    controller.observe("mid", ROOT * (1.0 + 1e-12))  # an observed cost near a level
    assert controller.action("mid") == "sure"
    assert all(isinstance(p, CostAwarePolicy) for p in solution.policy.policies)


def a_corridor(seed: int) -> SSP:
    """Eight rooms in a row, each left on foot or by a lift that may fall, costs from the reals."""
    rng = np.random.default_rng(seed)
    rooms: dict[str, dict[str, list]] = {}
    for room in range(8):
        after, back = f"r{room + 1}", f"r{max(room - 1, 0)}"
        slow, fast, again = rng.uniform(0.5, 2.0, 3).tolist()
        rooms[f"r{room}"] = {
            "walk": [(0.8, after, slow), (0.2, back, again)],
            "lift": [(0.93, after, fast / 3.0), (0.07, "shaft", fast / 3.0)],
        }
    return model_of({**rooms, "shaft": {}}, "r8")


@pytest.mark.parametrize(
    "problem",
    [
        CostBoundedReach(a_corridor(0), "r0", 9.0, 0.3),
        GUBS(a_corridor(1), "r0", utility(20.0), 0.3),
        CVaR(a_corridor(2), "r0", 0.8, 0.3),
        CostQuantile(a_corridor(3), "r0", 0.8, 0.3),
    ],
    ids=lambda problem: type(problem).__name__,
)
def test_more_levels_of_rounded_costs_leave_less_gap(problem) -> None:
    coarse = solve(replace(problem, cost_levels=64))
    fine = solve(replace(problem, cost_levels=1024))
    assert 2.0 * fine.gap < coarse.gap
    bounds = [
        (s.lower_bound, s.objective) if s.upper_bound is None else (s.objective, s.upper_bound)
        for s in (coarse, fine)
    ]
    assert bounds[0][0] <= bounds[1][0] * (1.0 + 1e-9)
    assert bounds[1][1] <= bounds[0][1] * (1.0 + 1e-9)
    for solution in (coarse, fine):
        told = evaluate(solution.policy, problem)
        assert told.objective == pytest.approx(solution.objective, rel=1e-5)
        assert told.failure_probability <= problem.failure_budget + 1e-9
        certificate = certify(solution)
        assert certificate.accepted
        assert certificate.gap < 2.0 * solution.gap + 1e-4


def test_a_controller_rounds_costs_up_as_its_policy_does(tmp_path) -> None:
    model = a_corridor(4)
    solution = solve(CostBoundedReach(model, "r0", 9.0, 0.3, cost_levels=64))
    policy = next(p for p in solution.policy.policies if isinstance(p, CostAwarePolicy))
    save_policy(policy, tmp_path / "policy.zip")
    loaded = load_policy(tmp_path / "policy.zip", model)
    assert loaded.rounds_up
    write_controller(policy, tmp_path / "controller.json")
    controller = Controller(tmp_path / "controller.json")
    controller.reset(0)
    memory, state = policy.start_memory(np.array([0])), 0
    for after in ("r1", "r2", "r1", "r2", "r3"):
        assert controller.action(model.states[state]) == model.action_of(
            int(loaded.branches(np.array([state]), memory).pair[0])
        )
        controller.observe(after, 0.71)
        there = np.array([model.index_of(after)])
        memory = loaded.remember(memory, np.array([0]), there, np.array([0.71]))
        state = int(there[0])
    assert memory[0] == min(5 * int(np.ceil(0.71 / policy.unit)), policy.cap)


def test_what_is_refused() -> None:
    model = SSP.from_transitions({"a": {"go": [(1.0, "b", ROOT)]}, "b": {}}, goal={"b"})
    with pytest.raises(ModelError, match="cost_levels"):
        CVaR(model, "a", 0.5, cost_levels=0)
