"""The least objective over several limits at once: closed forms, optima inside, refusals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from formulations import GUBS, MCMP, S3P, CVaR
from ssp_lp import (
    SSP,
    InfeasibleError,
    ModelError,
    end_probability,
    evaluate,
    secondary_cost,
    solve,
    trace_frontier,
    trace_surface,
    visits,
)

YARD = SSP.from_transitions(
    {
        "a": {"fast": [(0.9, "g", 1.0), (0.1, "yard", 1.0)], "slow": [(1.0, "g", 10.0)]},
        "yard": {"on": [(0.5, "g", 2.0), (0.5, "pit", 2.0)]},
        "pit": {},
    },
    goal={"g"},
    treat_actionless_as_dead_ends=True,
)


def walk(seed: int) -> SSP:
    """Five places in a row, on each a dear safe way and two cheap ones that fail differently."""
    rng, choices = np.random.default_rng(seed), dict[Any, Any]()
    for k in range(5):
        on, back = "g" if k == 4 else k + 1, max(k - 1, 0)
        pit, ice = 0.08 * rng.random(), 0.08 * rng.random()
        choices[k] = {
            "safe": [(0.9, on, 6.0 + k), (0.1, back, 6.0 + k)],
            "edge": [(0.9 - pit, on, 2.0), (pit, "pit", 2.0), (0.1, back, 2.0)],
            "lake": [(0.8 - ice, on, 1.0), (ice, "ice", 1.0), (0.2, back, 1.0)],
        }
    return SSP.from_transitions(
        choices | {"pit": {}, "ice": {}},
        goal={"g"},
        state_labels={"fall": ["pit"], "cold": ["ice"]},
        treat_actionless_as_dead_ends=True,
    )


def limited(criterion: Callable[..., Any], seed: int, *more: Any) -> Callable[..., Any]:
    model = walk(seed)

    def asked(fall: float, cold: float) -> Any:
        limits = {"fall": end_probability("fall") <= fall, "cold": end_probability("cold") <= cold}
        return criterion(model, 0, *more, constraints=limits)

    return asked


def test_one_way_mixed_with_another_in_closed_form() -> None:
    """A share w of fast fails with w / 20, sees the yard with w / 10 and costs 10 - 8.8 w."""
    problem = MCMP(YARD, "a", constraints={"yard": visits("yard") <= 0.05})
    surface = trace_surface(problem, ["failure", "yard"])
    for failure, yard in [(0.0, 0.0), (0.02, 0.05), (0.05, 0.02), (0.04, 0.2), (1.0, 1.0)]:
        share = min(failure / 0.05, yard / 0.1, 1.0)
        assert surface.bounds_at(failure, yard) == pytest.approx([10.0 - 8.8 * share] * 2)
    lottery = surface.policy_at(0.02, 0.05)
    assert lottery.model is YARD
    assert evaluate(lottery, problem).objective == pytest.approx(6.48)
    assert surface.gap < 1e-12
    assert "objective" in surface.summary()
    assert list(surface.to_frame()) == [
        "failure", "yard", "objective", "price of failure", "price of yard"
    ]  # fmt: skip


def test_a_budget_that_is_traced_may_be_stated_or_not() -> None:
    """What a problem allows of what is traced does not matter, be it the least failure."""
    limits = {"yard": visits("yard") <= 0.05}
    for budget in (None, 0.02, 1.0):
        frontier = trace_frontier(MCMP(YARD, "a", budget, constraints=limits))
        assert frontier.spent == pytest.approx([0.0, 0.025])
        assert frontier.objective == pytest.approx([10.0, 5.6])


CASES = {
    "cost": limited(MCMP, 1, 0.5),
    "cost, some failure": limited(MCMP, 2, 0.08),
    "cost given success": limited(S3P, 3, 0.5),
    "utility": limited(GUBS, 4, lambda cost: np.exp(-0.05 * cost), 1.0),
}


@pytest.mark.parametrize("case", CASES)
def test_no_optimum_lies_outside_the_bounds(case: str) -> None:
    """Optima solved directly lie between both bounds, which lotteries attain."""
    asked, rng = CASES[case], np.random.default_rng(7)
    surface = trace_surface(asked(0.5, 0.5), ["fall", "cold"], gap=2e-2, point_limit=40)
    assert surface.gap <= 2e-2 * (1.0 + 1e-9)
    assert len(surface.objective) > 2
    for fall, cold in (rng.random((8, 2)) * surface.spent.max(axis=0)).tolist():
        low, high = surface.bounds_at(fall, cold)
        optimum = solve(asked(fall, cold))
        assert low * (1.0 - 1e-7) <= optimum.objective <= high * (1.0 + 1e-7)
        found = evaluate(surface.policy_at(fall, cold), asked(fall, cold))
        assert found.secondary_costs["fall"] <= fall + 1e-12
        assert found.secondary_costs["cold"] <= cold + 1e-12
        attained = low if surface.maximises else high
        assert found.objective == pytest.approx(attained, rel=1e-9)


def test_three_limits_at_once() -> None:
    """A surface over failure, falls and cold: failing is no more than both, so it may bind too."""
    asked = CASES["cost"]
    surface = trace_surface(asked(1.0, 1.0), ["failure", "fall", "cold"], gap=5e-2, point_limit=30)
    for bounds in [(0.05, 0.04, 0.04), (0.03, 0.05, 0.01)]:
        problem = asked(*bounds[1:])
        low, high = surface.bounds_at(*bounds)
        optimum = solve(MCMP(problem.model, 0, bounds[0], constraints=problem.constraints))
        assert low * (1.0 - 1e-7) <= optimum.objective <= high * (1.0 + 1e-7)


def test_what_is_no_surface_is_refused() -> None:
    problem = CASES["cost"](0.1, 0.1)
    for over in ("fall", ["fall"], ["fall", "fall"]):
        with pytest.raises(ModelError, match="over must be several different limits"):
            trace_surface(problem, over)
    with pytest.raises(ModelError, match="did you mean 'cold'"):
        trace_surface(problem, ["fall", "colt"])
    limits = problem.constraints
    with pytest.raises(ModelError, match="no linear program"):
        trace_surface(CVaR(problem.model, 0, 0.9, 0.1, constraints=limits), ["fall", "cold"])
    surface = trace_surface(problem, ["fall", "cold"], point_limit=6)
    for bounds in [(0.1,), (0.1, -0.1), (0.1, np.inf), (0.1, "much")]:
        with pytest.raises(ModelError, match="a finite bound >= 0 for each of fall, cold"):
            surface.bounds_at(*bounds)
    with pytest.raises(ModelError, match="point_limit"):
        trace_surface(problem, ["fall", "cold"], point_limit=0)
    must = {"fall": end_probability("fall") <= 0.5, "icy": end_probability("cold") >= 0.9}
    with pytest.raises(InfeasibleError):
        trace_surface(
            MCMP(problem.model, 0, 0.5, constraints={**must, "c": visits(1) <= 2.0}), ["fall", "c"]
        )


def test_where_one_limit_is_tight_more_of_another_helps():
    """The cheapest policy quits and needs no fuel; who may not fail needs up to 5 of it."""
    ways = {
        "a": {
            "fast": [(0.9, "g", 1.0), (0.1, "pit", 1.0)],
            "slow": [(1.0, "g", 10.0)],
            "quit": [(1.0, "pit", 0.5)],
        },
        "pit": {},
    }
    model = SSP.from_transitions(ways, goal={"g"}, treat_actionless_as_dead_ends=True)
    fuel = secondary_cost({"a": {"fast": 2.0, "slow": 5.0, "quit": 0.0}})

    def asked(failure, most):
        return MCMP(model, "a", failure, constraints={"fuel": fuel <= most})

    surface = trace_surface(asked(0.1, 5.0), ["failure", "fuel"])
    for bounds in [(0.05, 5.0), (0.05, 3.5), (0.0, 5.0), (0.3, 2.0), (1.0, 0.0)]:
        assert surface.bounds_at(*bounds) == pytest.approx([solve(asked(*bounds)).objective] * 2)
