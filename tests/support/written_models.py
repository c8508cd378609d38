"""Models as text, one line for each action, and models drawn from a palette of costs."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from small_models import model_of
from ssp_lp import SSP


def table(text: str) -> dict[str, dict[str, list[tuple[float, str, float]]]]:
    """Choices from lines ``state action: probability successor cost, ...``.

    What is sure needs no probability. Names end at blanks, colons and commas.
    """
    choices: dict[str, dict[str, list[tuple[float, str, float]]]] = {}
    for line in filter(str.strip, text.splitlines()):
        head, outcomes = line.split(":")
        state, action = head.split()
        parts = [["1", *part.split()][-3:] for part in outcomes.split(",")]
        choices.setdefault(state, {})[action] = [
            (float(Fraction(p)), successor, float(Fraction(cost))) for p, successor, cost in parts
        ]
    return choices


def written(text: str, goal: str = "g", labels: Any = None) -> SSP:
    """The model of `table`; where no line leads on there is a dead-end."""
    return model_of(table(text), goal, labels)


def drawn_table(
    rng: np.random.Generator,
    live: Sequence[str],
    ends: Sequence[str],
    costs: Sequence[float],
    actions: int = 3,
    outcomes: int = 3,
) -> dict[str, dict[str, list[tuple[float, str, float]]]]:
    """Up to so many actions in each live state, each with up to so many drawn outcomes."""
    choices: dict[str, dict[str, list[tuple[float, str, float]]]] = {}
    for state in live:
        choices[state], pool = {}, [*live, state, *ends]
        for action in range(int(rng.integers(1, actions + 1))):
            size = min(int(rng.integers(1, outcomes + 1)), len(pool))
            reached = rng.choice(pool, size=size, replace=False)
            share = rng.integers(1, 5, size=size)
            choices[state][f"a{action}"] = [
                (float(p), str(successor), float(rng.choice(costs)))
                for p, successor in zip(share / share.sum(), reached, strict=True)
            ]
    return choices
