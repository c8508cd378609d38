"""A move that succeeds with some probability, as the outcomes of an action."""

from collections.abc import Hashable
from typing import Any

from examples.domains.parameters import Number

Outcomes = list[tuple[Any, Hashable, Any]]
"""(probability, successor, cost) of each thing that can happen; both numbers are of type Number."""

Actions = dict[Hashable, Outcomes]
"""The actions of a state by name."""


def attempt(chance: Number, success: Hashable, failure: Hashable, cost: Number) -> Outcomes:
    """Return the outcomes `success` with probability `chance`, else `failure`, without zeros."""
    both = [(chance, success, cost), (1 - chance, failure, cost)]
    return [outcome for outcome in both if outcome[0] > 0]
