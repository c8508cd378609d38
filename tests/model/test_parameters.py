"""Parameters: models whose numbers are affine expressions of named ones."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from formulations import MCMP, FinitePenalty, MaxProb
from refusing import refused
from ssp_lp import SSP, Parameter, secondary_cost, solve, solve_many, sweep

CRASH, FUEL = Parameter("crash", 0.1), Parameter("fuel", 2.0)


def road(crash, fuel=2.0):
    """A way whose crash and cost depend on two numbers, and one that does not."""
    return SSP.from_transitions(
        {
            "depot": {
                "alley": [(1 - crash, "home", 2 * fuel), (crash, "wreck", fuel / 2 + 1)],
                "road": [(1.0 - 0.5 * crash, "home", 9.0), (0.5 * crash, "wreck", 9.0)],
            },
            "wreck": {},
        },
        goal={"home"},
        treat_actionless_as_dead_ends=True,
    )


def test_a_model_at_other_values_is_the_model_built_with_them():
    moved = road(CRASH, FUEL).with_parameters(crash=0.3, fuel=5.0)
    built = road(0.3, 5.0)
    np.testing.assert_allclose(moved.probabilities, built.probabilities)
    np.testing.assert_allclose(moved.costs, built.costs)
    assert {name: each.value for name, each in moved.parameters.items()} == {
        "crash": 0.3, "fuel": 5.0}  # fmt: skip


def test_values_may_be_changed_again_and_again():
    model = road(CRASH, FUEL)
    back = model.with_parameters(crash=0.3).with_parameters(crash=0.1)
    np.testing.assert_allclose(back.probabilities, model.probabilities)


def test_expressions_are_affine():
    assert float(1 - 2 * CRASH) == pytest.approx(0.8)
    assert float((CRASH + FUEL) / 2 - FUEL) == pytest.approx(0.05 - 1.0)
    assert repr(1 - CRASH) == "1 - crash"
    assert repr(FUEL - 2 * CRASH) == "fuel - 2 * crash"
    for wrong in (lambda: CRASH * FUEL, lambda: 1 / CRASH, lambda: CRASH**2, lambda: 2**CRASH,
                  lambda: CRASH < 1, lambda: CRASH >= 1):  # fmt: skip
        refused("must be affine", wrong)
    refused("two values", lambda: CRASH + Parameter("crash", 0.2))
    refused("combines with numbers", lambda: CRASH + "1")
    refused("a word", Parameter, "p crash", 0.1)
    refused("not a number", Parameter, "crash", "0.1")
    refused("not a number", Parameter, "crash", True)
    two = [(CRASH, "home", 1.0), (1 - Parameter("crash", 0.2), "pit", 1.0)]
    refused("'go' of state 'a'.*two values: 0.1, 0.2",
            SSP.from_transitions, {"a": {"go": two}, "pit": {}}, {"home"})  # fmt: skip


def test_costs_by_name_take_expressions():
    model = SSP.from_transitions(
        {"a": {"go": [(1.0, "home", {"time": 1.0, "fuel": 3 * FUEL})]}}, {"home"}, cost="time"
    )
    assert model.with_parameters(fuel=1.0).named_costs["fuel"].tolist() == [3.0]
    assert model.with_cost("fuel").with_parameters(fuel=1.0).costs.tolist() == [3.0]


def test_frames_take_expressions():
    table = {"state": ["a", "a"], "action": ["go"] * 2, "successor": ["home", "pit"],
             "probability": [1 - CRASH, CRASH], "cost": [FUEL, 1.0]}  # fmt: skip
    model = SSP.from_frame(table, {"home"})
    assert model.with_parameters(crash=0.4).probabilities.tolist() == [0.6, 0.4]


def test_wrong_values_are_refused_by_name():
    model = road(CRASH, FUEL)
    refused("crash", model.with_parameters, crsh=0.2)
    refused("with crash=1.5, .*negative probability", model.with_parameters, crash=1.5)
    refused("with fuel=-1, .*negative cost", model.with_parameters, fuel=-1.0)
    refused("be a number", model.with_parameters, fuel="much")
    lone = {"a": {"go": [(0.9, "home", 1.0), (CRASH, "pit", 1.0)]}, "pit": {}}
    one_sided = SSP.from_transitions(lone, {"home"}, dead_ends={"pit"})
    refused("sum to", one_sided.with_parameters, crash=0.2)


@pytest.mark.parametrize(
    "ask",
    [
        lambda model: MCMP(model, "depot", 0.07),
        lambda model: FinitePenalty(model, "depot", 30.0, charge_failing_step=True),
        lambda model: MaxProb(model, "depot"),
        lambda model: MCMP(
            model, "depot", 1.0,
            constraints={"use": secondary_cost({"depot": {"alley": 4.0}}) <= 1.0},
        ),
    ],
)  # fmt: skip
def test_derivatives_by_parameters_are_differences(ask):
    model = road(CRASH, FUEL)
    found = solve(ask(model)).what_if(
        by=lambda number: number.name if number.kind == "parameter" else None
    )
    for effect in found.effects:
        name, h = effect.number.name.removeprefix("parameter "), 1e-5
        at = model.parameters[name].value
        optima = [
            solve(ask(model.with_parameters(**{name: at + k * h}))).objective for k in (-1, 1)
        ]
        assert effect.derivative == pytest.approx(np.diff(optima)[0] / (2 * h), rel=1e-6, abs=1e-8)


def test_a_sweep_over_a_parameter():
    problems = sweep(MCMP, road(CRASH, FUEL), "depot", failure_budget=[0.1], crash=[0.05, 0.1])
    answers = solve_many(problems, executor=ThreadPoolExecutor(1))
    assert answers.objectives[1] == pytest.approx(solve(MCMP(road(0.1), "depot", 0.1)).objective)
    assert [row["crash"] for row in answers.tables()[0].records()] == [0.05, 0.1]
    refused("an argument; did you mean 'crash'", sweep, MCMP, road(CRASH), "depot", 0.1, crsh=[0.1])
    refused("there are 'crash', 'model'", sweep, MCMP, road(CRASH), "depot", 0.1, wind=[0.1])


def test_a_sweep_refuses_a_name_of_both_a_parameter_and_an_argument():
    model = road(Parameter("discount", 0.1))
    refused("'discount' names a parameter", sweep, MCMP, model, "depot", discount=[0.2, 0.3])
    assert len(sweep(MCMP, model, "depot", failure_budget=[0.1, 0.2])) == 2
