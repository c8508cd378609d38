"""A drone's limits on crashes and empty batteries hold when its plan is flown."""

from __future__ import annotations

from pathlib import Path

import pytest

from examples.formulating import drone
from ssp_lp import certify, evaluate, simulate
from ssp_lp.analysis.simulation import proportion_estimate


def test_limits_hold_when_flown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(drone, "CHARGE", 26)
    model, start = drone.town()
    rash, careful = drone.plan(model, start), drone.plan(model, start, **drone.LIMITS)
    assert careful.objective > rash.objective
    ends = evaluate(careful.policy, careful.problem).ends
    for name, most in drone.LIMITS.items():
        assert ends[name] == pytest.approx(careful.secondary_costs[name], abs=1e-9)
        assert ends[name] <= most + 1e-9
    assert certify(careful).gap <= 1e-7
    flights = simulate(careful.policy, careful.problem, episodes=20_000, rng=3)
    for name in (*drone.LIMITS, "landed"):
        flown = proportion_estimate(flights.ends[name], 20_000, 0.9999)
        assert flown.low <= ends[name] <= flown.high
    pytest.importorskip("matplotlib")
    drone.draw({"rash": rash, "careful": careful}, tmp_path / "drone.png")
    assert (tmp_path / "drone.png").stat().st_size > 10_000
