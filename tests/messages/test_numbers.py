"""Numbers of every kind, wherever one is taken: used as the float they stand for, or named."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import formulations as criteria
import ssp_lp
from formulations import MCMP, AlphaMCMP
from formulations.command_line import main
from formulations.command_line.arguments import PARAMETERS
from small_models import model_of
from ssp_lp import (
    SSP,
    Distribution,
    ModelError,
    SSPError,
    evaluate,
    goal_probability,
    problem as problems,
    solve,
)
from ssp_lp.compiled import deadline
from ssp_lp.io import from_matrices, save_model

MODEL = model_of(
    {
        "x": {
            "go": [(0.5, "g", 1.0), (0.3, "d", 1.0), (0.2, "y", 2.0)],
            "safe": [(0.9, "g", 5.0), (0.1, "d", 1.0)],
        },
        "y": {"go": [(0.5, "g", 1.5), (0.5, "x", 1.0)]},
        "d": {},
    },
    labels={"pit": ["d"]},
)
SURE = model_of({"x": {"go": [(0.5, "g", 1.0), (0.5, "x", 1.0)], "ride": [(1.0, "g", 3.0)]}})
BEYOND = [10**400, -(10**400), Fraction(10**400), 10**5000, Fraction(1, 3) + 10**5000]
PROBLEM = MCMP(MODEL, "x", failure_budget=0.2)
SOLUTION = solve(PROBLEM)
LAW = ssp_lp.success_costs(SOLUTION.policy, PROBLEM)
FRONTIER = ssp_lp.trace_frontier(PROBLEM)
VISITS = ssp_lp.visits("x")


def joy(costs: Any) -> Any:
    """The less it costs the better."""
    return np.exp(-0.3 * costs)


def hop(at: Any, action: str, draws: Any) -> Any:
    """One step of a world on a line."""
    return (at[0] + draws[0],), 1.0, np.where(at[0] + draws[0] > 3.0, 1, 0)


def world(cost: Any = 0.0) -> ssp_lp.ContinuousModel:
    noise = Distribution.uniform(0.0, 1.0)
    grid = ssp_lp.Grid([ssp_lp.Axis(0.0, 3.0, 3)])
    return ssp_lp.ContinuousModel(grid, ["hop"], hop, [noise], {"pit": cost})


STATED: dict[str, Any] = {
    "MCMP": MCMP(MODEL, "x", failure_budget=0.5, discount=0.75),
    "AlphaMCMP": AlphaMCMP(MODEL, "x", 0.75),
    "S3P": criteria.S3P(MODEL, "x", failure_budget=0.5, discount=0.75, cost_cap=8.0),
    "ISSPUDE": criteria.ISSPUDE(MODEL, "x"),
    "CVaR": criteria.CVaR(MODEL, "x", 0.75, 0.25),
    "CostQuantile": criteria.CostQuantile(MODEL, "x", 0.5, 0.25),
    "CostBoundedReach": criteria.CostBoundedReach(MODEL, "x", 3.0),
    "CostBudgetedMaxProb": criteria.CostBudgetedMaxProb(MODEL, "x", 6.0),
    "EGUBS": criteria.EGUBS(MODEL, "x", -0.125, 1.0),
    "GUBS": criteria.GUBS(MODEL, "x", joy, 5.0, 0.0),
    "FinitePenalty": criteria.FinitePenalty(MODEL, "x", 3.0, discount=0.75),
    "LeastQuantity": criteria.LeastQuantity(MODEL, "x", VISITS, 0.25),
    "MaxProb": criteria.MaxProb(MODEL, "x"),
    "MinProb": criteria.MinProb(MODEL, "x"),
    "MinCost": criteria.MinCost(SURE, "x"),
    "ConstrainedCost": criteria.ConstrainedCost(MODEL, "x", failure_budget=0.5, discount=0.75),
}
NUMBERS = [
    (name, part.name)
    for name, problem in STATED.items()
    for part in fields(problem)
    if "float" in str(part.type) and getattr(problem, part.name) is not None
]


def test_every_criterion_is_here() -> None:
    pages = set(criteria.PAGES)
    assert pages == set(STATED)


@pytest.mark.parametrize(("name", "part"), NUMBERS)
def test_a_criterion_takes_any_number_as_the_float_it_is(name: str, part: str) -> None:
    problem = STATED[name]
    value = getattr(problem, part)
    expected = solve(problem).objective
    for kind in (Fraction, np.float32, np.longdouble):
        stated = replace(problem, **{part: kind(value)})
        assert solve(stated).objective == pytest.approx(expected, rel=1e-9), kind
        assert part == "cost_bound" or repr(stated) == repr(problem)  # which is exact
    for wrong in (*BEYOND, "0.5", 1j, [0.5], np.array([0.5])):
        with pytest.raises(ModelError, match=part) as caught:
            replace(problem, **{part: wrong})
        assert len(str(caught.value)) < 200


def test_a_share_is_no_none() -> None:
    with pytest.raises(ModelError, match="reach_fraction must be a number, not None"):
        AlphaMCMP(MODEL, "x", None)  # type: ignore[arg-type]


CALLS: dict[str, Callable[[Any], Any]] = {
    "tolerance": lambda v: solve(PROBLEM, tolerance=v),
    "time_limit": lambda v: solve(PROBLEM, time_limit=v),
    "horizon": lambda v: replace(PROBLEM, horizon=v),
    "cost_levels": lambda v: criteria.CVaR(MODEL, "x", 0.75, 0.25, cost_levels=v),
    "start": lambda v: MCMP(MODEL, {"x": v}, failure_budget=0.2),
    "within": LAW.within,
    "excess": LAW.excess,
    "quantile": LAW.quantile,
    "tail_mean": LAW.tail_mean,
    "exponential": LAW.exponential,
    "expectation": lambda v: LAW.expectation(joy, v),
    "upto": LAW.upto,
    "all_but": LAW.all_but,
    "objective_at": FRONTIER.objective_at,
    "policy_at": FRONTIER.policy_at,
    "gap": lambda v: ssp_lp.trace_frontier(PROBLEM, gap=v),
    "steepest_price": lambda v: ssp_lp.trace_frontier(PROBLEM, steepest_price=v),
    "point_limit": lambda v: ssp_lp.trace_frontier(PROBLEM, point_limit=v),
    "frontier's time_limit": lambda v: ssp_lp.trace_frontier(PROBLEM, time_limit=v),
    "program's time_limit": lambda v: PROBLEM.program().solve(time_limit=v),
    "bound": lambda v: v >= VISITS,
    "least": lambda v: goal_probability() >= v,
    "value": lambda v: goal_probability() == v,
    "factor": lambda v: v * VISITS,
    "summand": lambda v: VISITS + v,
    "subtrahend": lambda v: VISITS - v,
    "limit": lambda v: criteria.ConstrainedCost(
        MODEL, "x", {"fuel": criteria.CostLimit({"x": {"go": 2.0}}, v)}
    ),
    "listed cost": lambda v: criteria.LeastQuantity(
        MODEL, "x", ssp_lp.secondary_cost({"x": {"go": v}})
    ),
    "array of costs": lambda v: criteria.LeastQuantity(
        MODEL, "x", ssp_lp.secondary_cost([v, 1.0, 1.0])
    ),
    "probability": lambda v: SSP.from_transitions({"a": {"x": [(v, "g", 1.0)]}}, {"g"}),
    "cost": lambda v: SSP.from_transitions({"a": {"x": [(1.0, "g", v)]}}, {"g"}),
    "successors": lambda v: SSP.from_successors("a", lambda s: {"x": [(1.0, "g", v)]}, {"g"}),
    "state_limit": lambda v: SSP.from_successors(
        "a", lambda s: {"x": [(1.0, "g", 1.0)]}, {"g"}, state_limit=v
    ),
    "probabilities": lambda v: arrays(probabilities=[v]),
    "costs": lambda v: arrays(costs=v),
    "offsets": lambda v: arrays(pair_offsets=[0, v, 1]),
    "targets": lambda v: arrays(successors=[v]),
    "goals": lambda v: arrays(goal_states=[v]),
    "matrices": lambda v: from_matrices([np.array([[0, v], [0, 1.0]], dtype=object)], [1]),
    "costs of matrices": lambda v: from_matrices([np.array([[0, 1.0], [0, 1.0]])], [1], costs=v),
    "steps": lambda v: ssp_lp.within_steps(MODEL, v),
    "episodes": lambda v: simulated(episodes=v),
    "max_steps": lambda v: simulated(max_steps=v),
    "record": lambda v: simulated(record=v),
    "confidence": lambda v: simulated(confidence=v),
    "start_many": lambda v: SOLUTION.policy.start_many(v, 0),
    "observe": lambda v: observed(v),
    "weights": lambda v: ssp_lp.MixedPolicy((SOLUTION.policy.policies[0],), np.array([v])),
    "share": lambda v: ssp_lp.StochasticPolicy.from_actions(MODEL, {"x": {"go": v}}),
    "unit": lambda v: ssp_lp.CostAwarePolicy(
        MODEL, v, np.zeros((1, 4), int), np.zeros((1, 4), int), np.zeros(4)
    ),
    "low": lambda v: ssp_lp.Axis(v, 1.0, 4),
    "cells": lambda v: ssp_lp.Axis(0.0, 1.0, v),
    "uniform": lambda v: Distribution.uniform(v, 1.0),
    "atoms": lambda v: Distribution.discrete([v], [1.0]),
    "chances": lambda v: Distribution.discrete([1.0], [v]),
    "points": lambda v: ssp_lp.discretise(world(), ssp_lp.Quadrature(v)),
    "samples": lambda v: ssp_lp.discretise(world(), ssp_lp.Samples(v, 0)),
    "deviation": lambda v: ssp_lp.Samples(5, 0).deviation(2, 3, v),
    "cost of an end": lambda v: ssp_lp.discretise(world(v)),
    "place": lambda v: ssp_lp.WorldSimulator(world(), [v]).reset(1, np.random.default_rng(0)),
    "budgets": lambda v: criteria.compare_criteria(MODEL, "x", failure_budgets=[v]),
    "penalties": lambda v: criteria.compare_criteria(MODEL, "x", penalties=[v]),
    "shares": lambda v: criteria.compare_criteria(MODEL, "x", reach_fractions=[v]),
    "cost_bounds": lambda v: criteria.compare_criteria(MODEL, "x", cost_bounds=[v]),
    "levels": lambda v: criteria.compare_criteria(MODEL, "x", levels=[v]),
    "agreement": lambda v: ssp_lp.cross_check(
        MCMP(MODEL, "x", failure_budget=0.2, discount=0.99), tolerance=v
    ),
}


def arrays(**other: Any) -> SSP:
    given: dict[str, Any] = {"pair_offsets": [0, 1, 1], "outcome_offsets": [0, 1], "costs": 1.0}
    given |= {"successors": [1], "probabilities": [1.0], "goal_states": [1]}
    return SSP.from_arrays(**given | other)


def simulated(**numbers: Any) -> ssp_lp.analysis.simulation.SimulationReport:
    return ssp_lp.simulate(SOLUTION.policy, PROBLEM, seed=0, **{"episodes": 3} | numbers)


def observed(cost: Any) -> None:
    episode = SOLUTION.policy.start(0)
    episode.action("x")
    episode.observe("y", cost)


@pytest.mark.parametrize("call", CALLS)
def test_what_no_float_can_stand_for_is_refused_by_name(call: str) -> None:
    for value in BEYOND:
        with pytest.raises(SSPError) as caught:
            CALLS[call](value)
        assert len(str(caught.value)) < 250


def test_a_law_takes_numbers_alone() -> None:
    for ask in (LAW.within, LAW.excess, LAW.upto, LAW.exponential, LAW.quantile, LAW.tail_mean):
        for wrong in ("0.5", None, 1j, [0.5]):
            with pytest.raises(ModelError, match="must be a number"):
                ask(wrong)  # type: ignore[arg-type]
    assert LAW.within(Fraction(3)) == LAW.within(3) == LAW.within(np.float32(3.0))


@pytest.fixture(scope="module")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> str:
    path: Path = tmp_path_factory.mktemp("models") / "model.npz"
    save_model(MODEL, path)
    return str(path)


OF_CRITERION = {
    "reach_fraction": "alpha-mcmp",
    "penalty": "finite-penalty",
    "level": "cvar",
    "cost_bound": "cost-bounded-reach",
    "cost_budget": "cost-budgeted-maxprob",
    "risk_factor": "egubs",
    "goal_bonus": "egubs",
    "cost_cap": "s3p",
}
TYPED = [name for name, taken in PARAMETERS.items() if taken.type not in (bool, str)]


@pytest.mark.parametrize("name", [*TYPED, "tolerance", "horizon"])
@pytest.mark.parametrize("text", ["1e400", "-1e400", "1e9999999", "nan", "1" + 400 * "0", "1/0"])
def test_the_command_line_names_what_is_no_number(
    capsys: pytest.CaptureFixture[str], model_file: str, name: str, text: str
) -> None:
    asked = ["solve", model_file, "--start", "x", "--criterion", OF_CRITERION.get(name, "mcmp")]
    bonus = ["--goal-bonus", "1"] if name == "risk_factor" else []
    bonus += ["--risk-factor=-1"] if name == "goal_bonus" else []
    bonus += ["--failure-budget", "0.5"] if name in ("discount", "cost_cap", "horizon") else []
    try:
        code = main([*asked, *bonus, f"--{name.replace('_', '-')}={text}"])
    except SystemExit as stop:  # of argparse
        code = int(stop.code or 0)
    assert code == 2
    told = capsys.readouterr().err
    assert f"--{name.replace('_', '-')}" in told


def test_a_budget_of_a_share_is_found_in_the_time_of_the_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Stating, printing and comparing reprs solve nothing; a call finds it before its deadline."""
    inside: list[bool] = []
    worked_out = problems.budget_of_share

    def watched(*given: Any) -> float:
        inside.append(deadline.is_limited())
        return worked_out(*given)

    monkeypatch.setattr(problems, "budget_of_share", watched)
    for horizon in (None, 4):
        for problem in (
            AlphaMCMP(MODEL, "x", 0.75, horizon=horizon),
            MCMP(MODEL, "x", reach_fraction=0.75, horizon=horizon),
        ):
            assert repr(problem) == str(problem)
            assert not inside
            solution = solve(problem, time_limit=60.0)
            assert repr(solution) in solution.summary() or solution.summary()
            assert evaluate(solution.policy, problem).failure_probability <= 1.0
            assert problem.failure_budget == pytest.approx(
                1.0 - 0.75 * solve(criteria.MaxProb(MODEL, "x", horizon=horizon)).objective
            )
            assert inside == [True]
            inside.clear()


def test_a_limit_of_time_is_any_number() -> None:
    began = time.perf_counter()
    assert solve(PROBLEM, time_limit=Fraction(60), tolerance=Fraction(1, 10**6)).gap <= 1e-6
    assert time.perf_counter() - began < 30.0
