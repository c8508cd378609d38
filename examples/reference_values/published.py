"""Published models in exact fractions, and the values expected of them (`tests/data`)."""

import gzip
import json
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

from ssp_lp import SSP

FOLDER = Path(__file__).parents[2] / "tests" / "data"

PUBLISHED = {"give_up": "anywhere", "charge_failing_step": False}
"""Cost that the published values count."""

CLOSE = {"rel": 1e-6, "abs": 1e-9}
"""Precision of the published values."""

NAMES = sorted(path.name.removesuffix(".json.gz") for path in (FOLDER / "models").iterdir())

Transitions = dict[int, dict[str, list[tuple[Fraction, int, Fraction]]]]


@dataclass(frozen=True)
class Case:
    """One model as nested dictionaries of exact fractions; goals have no choices."""

    name: str
    choices: Transitions
    goal: frozenset[int]
    start: int

    def floats(self) -> dict[int, dict[str, list[tuple[float, int, float]]]]:
        """Return the choices in floating point."""
        return {
            state: {
                action: [(float(p), successor, float(cost)) for p, successor, cost in outcomes]
                for action, outcomes in actions.items()
            }
            for state, actions in self.choices.items()
        }


def raw_case(name: str) -> dict[str, Any]:
    """Read one model in the stored form."""
    return json.loads(gzip.decompress((FOLDER / "models" / f"{name}.json.gz").read_bytes()))


@cache
def load_case(name: str, cost: str) -> Case:
    """Read one model with the named cost ("unit": 1 for every choice of a non-goal state)."""
    raw = raw_case(name)
    goal = frozenset(raw["goal"])
    choices: Transitions = {
        state: {
            f"{position}:{choice['name']}": _outcomes(choice, cost)
            for position, choice in enumerate(listed)
        }
        for state, listed in enumerate(raw["choices"])
        if state not in goal
    }
    return Case(name, choices, goal, raw["init"])


def _outcomes(choice: dict[str, Any], cost: str) -> list[tuple[Fraction, int, Fraction]]:
    """Return the outcomes of one choice, all with its cost."""
    paid = Fraction(1) if cost == "unit" else Fraction(choice["rewards"].get(cost, 0))
    return [(Fraction(p), successor, paid) for successor, p in choice["to"]]


@cache
def published(name: str, cost: str = "unit") -> tuple[SSP, int]:
    """Return a model of the library with exact costs, and its start state."""
    case = load_case(name, cost)
    model = SSP.from_transitions(case.choices, goal=case.goal, treat_actionless_as_dead_ends=True)
    return model, case.start


@cache
def expected() -> dict[str, Any]:
    """Read the table of expected values."""
    return json.loads((FOLDER / "expected.json").read_text())
