"""Faults that were found in the criteria of the law of success costs, one minimal case each."""

import pytest

from checks import optimum
from formulations import CVaR
from small_models import model_of


@pytest.mark.parametrize(("failing", "level"), [(0.5, 0.75), (0.9, 0.75), (0.99, 0.75)])
def test_cvar_refutes_thresholds_at_least_failure_without_a_price(failing, level):
    """All policies fail alike: what failing costs is no part of the risk given success.

    "steady" costs 2, "uncertain" 0 or 3, so that its mean is less and its worst quarter costs 3.
    """
    kept = 1.0 - failing
    model = model_of(
        {
            "x": {
                "uncertain": [(4 / 7 * kept, "g", 3), (3 / 7 * kept, "g", 0), (failing, "d", 0)],
                "steady": [(kept, "g", 2), (failing, "d", 0)],
            },
            "d": {},
        }
    )
    assert optimum(CVaR(model, "x", level)) == pytest.approx(2.0, rel=2e-8)
    assert optimum(CVaR(model, "x", level, failing)) == pytest.approx(2.0, rel=2e-8)
