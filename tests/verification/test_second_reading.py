"""The model read twice: the rooms that all methods share beside plain loops over fractions."""

import numpy as np
import pytest
from hypothesis import given

from checks import library_model
from formulations import MCMP, S3P
from small_models import FIRST, model_of
from ssp_lp import cross_check
from ssp_lp.processes import failure_semantics
from ssp_lp.verification import cross_check as reading
from strategies import discounts, often, problems, semantics

WAITING = model_of(
    {
        "a": {"go": [(0.5, "g", 2.0), (0.5, "swamp", 1.0)], "wait": [(1.0, "a", 0.0)]},
        "swamp": {"swim": [(1.0, "swamp", 3.0)], "float": [(1.0, "swamp", 1.0)]},
        "g": {},
    },
    "g",
)


@often(20)
@given(drawn=problems(), meaning=semantics, discount=discounts)
def test_drawn_models_are_read_alike(drawn, meaning, discount):
    model = library_model(drawn)
    for criterion, said in ((MCMP, meaning), (S3P, {})):
        stated = criterion(model, drawn.start, failure_budget=0.5, discount=discount, **said)
        assert reading.second_reading(stated).faults == ()


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_what_it_counts(criterion):
    """The swamp is a dead-end, and waiting in a is free: giving up there as well."""
    found = reading.second_reading(criterion(WAITING, "a", failure_budget=0.7))
    assert (found.dead_ends, found.giving_up, found.free, found.faults) == (1, 1, 1, ())
    assert str(found).startswith("read twice: 1 dead-ends, 1 states to give up in, 1 where")


@pytest.mark.parametrize(
    ("room", "wrong", "told"),
    [
        ("dead_end_charges", lambda right: 2.0 * right, "failing in 'swamp' charges 2, by the sec"),
        ("give_up_charges", lambda right: right + 1.0, "failing in 'a' charges 1, by the second"),
        ("attention_states", np.logical_not, "is not a state to give up in"),
        ("hopeless_states", np.zeros_like, "'swamp' is not a dead-end"),
    ],
)
def test_a_misread_model_is_named(monkeypatch, room, wrong, told):
    """Where all methods start from the same mistake they agree; the comparison does not."""
    right = getattr(reading, room)
    monkeypatch.setattr(reading, room, lambda *given: wrong(right(*given)))
    found = cross_check(MCMP(WAITING, "a", failure_budget=0.7, charge_failing_step=True))
    assert not found.disagreeing
    assert not found.agrees
    assert any(told in each for each in found.reading.faults)
    assert found.summary().splitlines()[-1].startswith("THE MODEL IS MISREAD: ")


def test_a_large_model_is_not_read_again(monkeypatch):
    monkeypatch.setattr(reading, "MOST_OUTCOMES", 3)
    found = cross_check(MCMP(FIRST, "depot", failure_budget=0.05))
    assert found.reading is None
    assert found.agrees


def test_charges_come_from_one_room():
    assert reading.dead_end_charges is failure_semantics.dead_end_charges
