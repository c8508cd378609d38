"""A backward sweep that is stopped half-way is a whole sweep at a lower price of failure."""

from dataclasses import replace

import pytest

from examples.domains.navigation import navigation
from formulations import S3P
from ssp_lp import evaluate
from ssp_lp.accumulated_cost import sweep
from ssp_lp.accumulated_cost.sweep import Sweep
from ssp_lp.column_generation.column import Column
from ssp_lp.column_generation.layered_pricing import LayeredPricing
from ssp_lp.compiled.deadline import Stop, until


def _stopped(
    monkeypatch: pytest.MonkeyPatch, pricing: LayeredPricing, price: float, layers: int
) -> Column | None:
    """What is known where the time ends after so many layers."""
    looks = []

    def end() -> None:
        looks.append(None)
        if len(looks) > layers:
            raise Stop

    with monkeypatch.context() as patched, until(float("inf")):
        patched.setattr(sweep, "check_time", end)
        with pytest.raises(Stop) as stopped:
            pricing.minimise(price)
    return pricing.incumbent(stopped.value.choice)


@pytest.mark.parametrize("discount", [None, 0.97])
@pytest.mark.parametrize("layers", [8, 25, 40])
def test_layers_swept_by_then_are_an_optimum_at_a_lower_price(
    monkeypatch: pytest.MonkeyPatch, discount: float | None, layers: int
) -> None:
    model, start = navigation(6, 5)
    problem = S3P(model, start, 0.9, discount=discount, cost_cap=60.0)
    pricing = problem.compile().pricing()
    assert isinstance(pricing, LayeredPricing)
    monkeypatch.setattr(Sweep, "one_pass", None)
    found = _stopped(monkeypatch, pricing, 80.0, layers)
    assert found is not None
    process = replace(pricing.process, totals=pricing.process.base.totals(layers))
    paid = (pricing.process.cap - layers) * process.base.unit
    same = replace(pricing, process=process).minimise(80.0 - paid / process.base.survival)
    assert found.failure == pytest.approx(same.failure, rel=1e-13)
    assert found.cost == pytest.approx(same.cost, rel=1e-12)
    assert found.policy is not None
    played = evaluate(found.policy, problem)
    assert played.objective == pytest.approx(found.cost / found.goal, rel=1e-12)


def test_nothing_swept_is_no_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    model, start = navigation(6, 5)
    pricing = S3P(model, start, 0.9, cost_cap=60.0).compile().pricing()
    assert isinstance(pricing, LayeredPricing)
    monkeypatch.setattr(Sweep, "one_pass", None)
    assert _stopped(monkeypatch, pricing, 80.0, 0) is None
