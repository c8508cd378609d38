"""Small models written out by hand; where nothing else is said the goal is "g"."""

from fractions import Fraction

import numpy as np
import pytest

from ssp_lp import SSP

EXACT = {"rel": 1e-9, "abs": 1e-12}
each_method = pytest.mark.parametrize("method", ["lp", "columns"])
each_meaning = pytest.mark.parametrize("give_up", ["anywhere", "attention", "dead_ends"])


def model_of(choices, goal="g", labels=None):
    """A model with one goal, in which states without actions are dead-ends."""
    return SSP.from_transitions(
        choices, goal={goal}, state_labels=labels or {}, treat_actionless_as_dead_ends=True
    )


def deciding(state, labels=None, **actions):
    """One state with a choice; the run is over wherever else its actions lead."""
    ends = {to: {} for outcomes in actions.values() for _, to, _ in outcomes if to != "g"}
    return model_of({**ends, state: actions}, labels=labels)


FREE_LOOP = {"x": {"loop": [(1.0, "x", 0)], "out": [(1.0, "g", 5)]}}
FREE_PAIR = {
    "x": {"swap": [(1.0, "y", 0)], "out": [(0.5, "g", 1), (0.5, "d", 1)]},
    "y": {"swap": [(1.0, "x", 0)], "out": [(1.0, "g", 6)]},
    "d": {},
}
PAYING_LOOP = {"x": {"loop": [(1.0, "x", 2)], "out": [(1.0, "g", 5)]}}
TWO_MOVES = {"x": {"slow": [(1.0, "g", 2)], "fast": [(0.95, "g", 1), (0.05, "d", 1)]}, "d": {}}

ROUTES = {
    "alley": [(0.90, "home", 4.0), (0.10, "wreck", 2.0)],
    "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
}
FIRST = model_of({"depot": ROUTES, "wreck": {}}, "home", {"crash": ["wreck"]})
"""The first problem of the README."""

TRIES = model_of(
    {"door": {"try": [(0.5, "out", 1.0), (0.5, "door", 1.0)], "wait": [(1.0, "door", 3.0)]}}, "out"
)
"""One tries until it works, or waits at the door."""

ROAD = model_of(
    {
        "road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)], "safe": [(1.0, "home", 3.0)]},
        "ditch": {},
    },
    "home",
)
"""A fast way that fails once in ten times, and a safe way of three times the cost."""

AWKWARD = model_of(
    {
        ("s", 1): {
            'say "hi"': [(0.5, "t", 0.0), (0.25, "pit", 0.25), (0.25, "g", 1.0)],
            "é b": [(0.5, "t", 0.0), (0.5, "lost", 0.0)],
            "say_hi": [(1.0, ("s", 1), 0.0)],
        },
        "t": {"é b": [(0.5, "g", Fraction(1, 4)), (0.5, "g", 0.3)], "": [(1.0, "cliff", 0.0)]},
        "pit": {},
        "cliff": {},
        "lost": {},
    },
    labels={"the pit": ["pit"], "high": ["cliff", "t"]},
)
"""Labels of several kinds, loops, what costs nothing, costs in fractions, several dead-ends."""

ALONE = model_of({})
"""Nothing but a goal."""


def patience(cost):
    """A utility that is used up at 4."""
    return np.maximum(1.0 - cost / 4.0, 0.0)
