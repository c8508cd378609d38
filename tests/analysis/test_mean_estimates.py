"""Intervals of mean costs: they hold for rare dear events, and say what cuts them off."""

from __future__ import annotations

import numpy as np
import pytest

from formulations import MCMP
from small_models import TRIES, model_of
from ssp_lp import SSP, DeterministicPolicy, ModelError, simulate
from ssp_lp.analysis.simulation import greatest_total, mean_estimate

LAWS = {
    "rare and dear": ([1.0, 1000.0], [0.9997, 0.0003]),
    "rare and free": ([0.0, 1000.0], [0.001, 0.999]),
    "a toss": ([1.0, 3.0], [0.5, 0.5]),
    "three kinds": ([0.0, 1.0, 200.0], [0.3, 0.69, 0.01]),
    "always": ([2.0], [1.0]),
}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("size", [20, 1000])
def test_they_cover_the_mean_as_often_as_they_say(name: str, size: int) -> None:
    """At least 95 % of 400 samples, less four deviations of such a count."""
    values, shares = (np.array(part) for part in LAWS[name])
    draw, held, truth = np.random.default_rng(7), 0, float(values @ shares)
    for _ in range(400):
        sample = draw.choice(values, size=size, p=shares)
        found = mean_estimate(sample, 0.95, float(values.max()))
        assert 0.0 <= found.low <= found.value <= found.high <= values.max()
        held += found.low <= truth + 1e-9 and truth - 1e-9 <= found.high
    assert held / 400 >= 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / 400)


def test_the_lower_end_asks_for_no_greatest_cost() -> None:
    """It is the mean of the sample without so much of its upper tail as chance may have added."""
    sample = np.random.default_rng(5).exponential(3.0, 2000)
    found = [mean_estimate(sample, 0.95, most) for most in (100.0, 1e9)]
    assert found[0].low == found[1].low > 2.5
    without = np.sort(sample)[: -int(np.ceil(2000 * np.sqrt(np.log(40.0) / 4000.0)))]
    assert 0.99 * without.sum() / 2000 <= found[0].low <= without.sum() / 2000 + sample.max() * 0.04


def toll() -> SSP:
    """One step, that is dear once in three thousand times."""
    cross = [(0.9997, "home", 1.0), (0.0003, "home", 1000.0)]
    return model_of({"gate": {"cross": cross}, "home": {}}, "home")


def test_a_simulation_that_shows_no_rare_event_knows_of_it() -> None:
    policy = DeterministicPolicy.from_actions(toll(), {"gate": "cross"})
    problem, held = MCMP(policy.model, "gate"), 0
    for seed in range(60):
        report = simulate(policy, problem, episodes=1000, rng=seed)
        for found in (report.conditional_cost, report.expected_cost):
            assert found.high < 40.0
            held += found.low <= 1.2997 <= found.high
    assert held >= 117


def test_the_greatest_total_of_an_episode() -> None:
    """A loop counts as often as there are steps; what is on the way counts once."""
    rooms = {
        "a": {"on": [(0.5, "b", 2.0), (0.5, "c", 9.0)], "skip": [(1.0, "d", 10.0)]},
        "b": {"on": [(1.0, "d", 3.0)]},
        "c": {"on": [(1.0, "d", 1.0)]},
        "d": {"on": [(0.9, "home", 4.0), (0.1, "pit", 50.0)]},
        "pit": {"stay": [(1.0, "pit", 70.0)]},
        "home": {},
    }
    model = SSP.from_transitions(rooms, goal={"home"})
    assert greatest_total(model, 10_000) == 9.0 + 1.0 + 50.0
    assert greatest_total(model, 1) == 50.0
    assert greatest_total(TRIES, 100) == 100 * float(TRIES.costs.max())
    rooms["b"]["back"] = [(1.0, "b", 0.25)]
    assert greatest_total(SSP.from_transitions(rooms, goal={"home"}), 100) == 25.0 + 60.0


def test_costs_that_are_cut_say_so() -> None:
    go = DeterministicPolicy.from_actions(TRIES, {"door": "try"})
    problem = MCMP(TRIES, "door")
    report = simulate(go, problem, episodes=500, rng=0, max_steps=2)
    cut = report.ends["unfinished"]
    assert report.note == f"costs are cut: {cut} episodes were unfinished after 2 steps"
    assert report.note in repr(report)
    assert simulate(go, problem, episodes=500, rng=0).note == ""


def test_more_episodes_than_a_machine_holds_are_refused() -> None:
    go = DeterministicPolicy.from_actions(TRIES, {"door": "try"})
    words = "episodes must be a whole number >= 1 and <= 100,000,000, not 1000000000000"
    with pytest.raises(ModelError, match=words):
        simulate(go, MCMP(TRIES, "door"), episodes=10**12, rng=0)
    with pytest.raises(ModelError, match=words):
        go.start_many(10**12)
