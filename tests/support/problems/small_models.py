"""Small models for closed forms, written out by hand; the goal is "g"."""

import pytest

from ssp_lp import SSP

EXACT = {"rel": 1e-9, "abs": 1e-12}
each_method = pytest.mark.parametrize("method", ["lp", "columns"])
each_meaning = pytest.mark.parametrize("give_up", ["anywhere", "attention", "dead_ends"])


def model_of(choices):
    """A model whose goal is "g"; states without actions are dead-ends."""
    return SSP.from_transitions(choices, goal={"g"}, treat_actionless_as_dead_ends=True)


FREE_LOOP = {"x": {"loop": [(1.0, "x", 0)], "out": [(1.0, "g", 5)]}}
FREE_PAIR = {
    "x": {"swap": [(1.0, "y", 0)], "out": [(0.5, "g", 1), (0.5, "d", 1)]},
    "y": {"swap": [(1.0, "x", 0)], "out": [(1.0, "g", 6)]},
    "d": {},
}
PAYING_LOOP = {"x": {"loop": [(1.0, "x", 2)], "out": [(1.0, "g", 5)]}}
TWO_MOVES = {"x": {"slow": [(1.0, "g", 2)], "fast": [(0.95, "g", 1), (0.05, "d", 1)]}, "d": {}}

FIRST = SSP.from_transitions(
    {
        "depot": {
            "alley": [(0.90, "home", 4.0), (0.10, "wreck", 2.0)],
            "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
        },
        "wreck": {},
    },
    goal={"home"},
    state_labels={"crash": ["wreck"]},
    treat_actionless_as_dead_ends=True,
)
"""The first problem of the README."""
