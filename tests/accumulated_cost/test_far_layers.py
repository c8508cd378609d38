"""Laws of runs that take millions of steps: closed forms, and the same laws layer by layer."""

from decimal import ROUND_CEILING, Decimal, localcontext
from itertools import pairwise

import numpy as np
import pytest

from laws import law_of, one_way
from small_models import model_of
from ssp_lp.accumulated_cost import law as following

LEAVING = (1e-3, 1e-6, 1e-9, 1e-12)
LEVELS = (0.0, 0.1, 0.5, 0.9, 0.999)
SLACK = Decimal(1) - Decimal("1e-12")  # of a quantile's level
DIGITS = 60


def tries_until(level, leaving):
    """The least number of tries within which a share of the runs has left."""
    with localcontext(prec=DIGITS):
        share = (1 - Decimal(level) * SLACK).ln() / (1 - Decimal(leaving)).ln()
        return max(int(share.to_integral_value(ROUND_CEILING)), 1)


def still_there(tries, leaving):
    with localcontext(prec=DIGITS):
        return (1 - Decimal(leaving)) ** int(tries)


@pytest.mark.parametrize("leaving", LEAVING)
@pytest.mark.parametrize("level", LEVELS)
def test_a_loop_that_is_hardly_left(leaving, level):
    """Tries until the first success are geometric: all but the first `tries` are (1-p)^tries."""
    law = one_way([(leaving, "G", 1), (1 - leaving, "a", 1)])
    tries = tries_until(level, leaving)
    assert law.quantile(level) == pytest.approx(tries, rel=1e-11, abs=0)
    if leaving * (1 - level) > 1e-10:  # else layers are closer together than rounding
        assert law.quantile(level) == tries
    left = float(still_there(tries, leaving))
    assert law.within(tries) == pytest.approx(float(1 - still_there(tries, leaving)), rel=1e-13)
    assert law.excess(tries) == pytest.approx(left / leaving, rel=1e-13)
    expected = tries + left / leaving / (1 - level)
    assert law.tail_mean(level) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("leaving", LEAVING)
def test_what_is_lost_on_the_way_does_not_change_the_law_of_the_rest(leaving):
    """Failing three times as often as succeeding: the law given success is that of leaving."""
    outcomes = [(leaving / 4, "G", 2), (leaving * 3 / 4, "pit", 9), (1 - leaving, "a", 2)]
    law = one_way(outcomes, pit={})
    tries = tries_until(0.5, leaving)
    assert law.goal == pytest.approx(0.25, rel=1e-14)
    assert law.quantile(0.5) == pytest.approx(2 * tries, rel=1e-11, abs=0)
    half = float(1 - still_there(tries, leaving))
    assert law.within(2 * tries + 1) == pytest.approx(0.25 * half, rel=1e-13)


@pytest.mark.parametrize("leaving", LEAVING)
def test_two_loops_one_after_the_other(leaving):
    """After n tries neither has let through, or the first alone: (1-p)^n + n p (1-p)^(n-1)."""
    law = one_way([(leaving, "b", 1), (1 - leaving, "a", 1)],
                  b={"go": [(leaving, "G", 1), (1 - leaving, "b", 1)]})  # fmt: skip
    for share in (0.1, 1.0, 5.0):
        tries = round(share / leaving)
        with localcontext(prec=DIGITS):
            here = still_there(tries, leaving)
            first = tries * Decimal(leaving) * still_there(tries - 1, leaving)
            late = float(here + first)
        assert law.within(tries) == pytest.approx(1 - late, rel=1e-12)
        assert law.quantile(law.within(tries)) == pytest.approx(tries, rel=1e-10)


def test_free_loops_that_are_hardly_left_count_no_layers():
    """Each layer is a walk of 1e9 free steps, and one in 1e6 layers leads to the goal."""
    stay, pay = 1 - 1e-9, 1e-9
    law = one_way([(stay, "b", 0), (pay, "c", 1)], b={"go": [(1.0, "a", 0)]},
                  c={"go": [(1e-6, "G", 0), (1 - 1e-6, "a", 0)]})  # fmt: skip
    assert law.quantile(0.5) == tries_until(0.5, 1e-6)


def drawn_law(rng):
    """A randomised policy of a small model with steps of cost 0 to 3, which may end in a pit."""
    names = [f"s{i}" for i in range(4)]
    table = {"pit": {}}
    for name in names:
        ends = [*rng.choice(names, 3).tolist(), "G", "pit"]
        weights = rng.integers(1, 9, len(ends)) * np.array([1, 1, 1, 0.02, 0.01])
        shares = weights / weights.sum()
        paid = rng.integers(0, 4, len(ends))
        table[name] = {"go": list(zip(shares.tolist(), ends, paid.tolist(), strict=True))}
    model = model_of(table, "G")
    return lambda: law_of(model, dict.fromkeys(names, "go"), names[0])


@pytest.mark.parametrize("seed", range(12))
def test_many_layers_at_once_as_one_by_one(seed, monkeypatch):
    make = drawn_law(np.random.default_rng(seed))
    monkeypatch.setattr(following, "_MOST_PLACES", 0)
    slow = make()
    monkeypatch.setattr(following, "_MOST_PLACES", 800)
    monkeypatch.setattr(following, "_WORK_OF_POWERS", 0.0)
    monkeypatch.setattr(following, "_FIRST_LAYERS", 2)
    for bound in (0, 1, 2, 7, 40, 300, 1000):
        fast = make()
        assert fast.within(bound) == pytest.approx(slow.within(bound), rel=1e-13)
        assert fast.excess(bound) == pytest.approx(slow.excess(bound), rel=1e-12, abs=1e-300)
    levels = (0.0, 0.3, 0.5, 0.9, 0.999)
    found = [make().quantile(level) for level in levels]
    assert found == [slow.quantile(level) for level in levels]
    assert all(low <= high for low, high in pairwise(found))
