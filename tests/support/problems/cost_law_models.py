"""Small models whose law of success costs has a closed form; the goal is "g"."""

from fractions import Fraction
from math import ceil, exp, log

import numpy as np

from small_models import model_of

HALF = Fraction(1, 2)
SHARP = {"rel": 2e-8, "abs": 1e-10}
"""The sweeps are right to 1e-12, so that only the certified gap is left."""


def retry(success, cost=1):
    """One action: the goal with the given probability, else again; each try costs the same."""
    return {"x": {"try": [(success, "g", cost), (1 - success, "x", cost)]}}


def retry_within(success, bound):
    """Pr(C <= bound) of `retry`: 1 - (1 - p)^bound."""
    return 1 - (1 - success) ** bound


def retry_quantile(success, level):
    """The least number of tries that is enough with the given probability."""
    return ceil(log(1 - level) / log(1 - success) - 1e-9)


def retry_cvar(success, level):
    """Z + E[(C - z)^+] / (1 - level) at the quantile z: E[(C - z)^+] = (1 - p)^z / p."""
    z = retry_quantile(success, level)
    return z + (1 - success) ** z / success / (1 - level)


def retry_utility(success, risk_factor):
    """E[exp(l C)] = p e^l / (1 - (1 - p) e^l)."""
    return success * exp(risk_factor) / (1 - (1 - success) * exp(risk_factor))


FAST_OR_SAFE = {
    "x": {"fast": [(0.75, "g", 1), (0.25, "d", 1)], "safe": [(1.0, "g", 3)]},
    "d": {},
}
"""Costs 1 and fails with probability 1/4, or costs 3 and does not fail."""

SAFE_OR_FAST = model_of(FAST_OR_SAFE)


def switching_bonus(risk_factor):
    """The bonus from which "safe" is the better: 3/4 (e^l + K) = e^3l + K."""
    return 3 * exp(risk_factor) - 4 * exp(3 * risk_factor)


QUIT_OR_RETRY = {
    "x": {"try": [(0.5, "g", 1), (0.5, "x", 1)], "quit": [(1.0, "d", 0)]},
    "d": {},
}
"""`retry` of 1/2, where one may also fail: within a budget late successes are done without."""

FREE_CYCLE = {
    "x": {"round": [(1.0, "y", 0)], "out": [(0.5, "g", 1), (0.5, "d", 1)]},
    "y": {
        "back": [(1.0, "x", 0)],
        "out": [(0.25, "g", 0), (0.75, "x", 0)],
        "dear": [(1.0, "g", 4)],
    },
    "d": {},
}
"""A loop of cost 0 in which trying is free, so that the goal is reached at cost 0 in the end."""

TWO_LENGTHS = {"x": {"go": [(0.5, "g", 1), (0.25, "g", 2), (0.25, "g", 5)]}}
"""The law is 1 with 1/2, 2 with 1/4, 5 with 1/4: levels 1/2 and 3/4 are met exactly."""

UNREACHABLE = {"x": {"go": [(1.0, "d", 1)]}, "d": {}}
"""No goal that could be reached (the goal is named, and has no way to it)."""


def quit_or_retry_quantile(level, budget):
    """The least B of `QUIT_OR_RETRY`: try at most n times with n least for the budget, or mix.

    A policy that tries n times succeeds with 1 - 2^-n within n, and one that never stops with 1.
    Within the budget the successes beyond B are as few as may be: max(0, 2^-B - budget).
    """
    bound = 0
    while True:
        within, late = 1 - HALF**bound, max(Fraction(0), HALF**bound - budget)
        if within + late > 0 and within >= level * (within + late):
            return bound
        bound += 1


def falling(cost):
    """A utility that is in order."""
    return np.exp(-np.asarray(cost, dtype=float))
