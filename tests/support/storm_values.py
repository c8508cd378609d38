"""Storm asked."""

from typing import Any

import stormpy


def value(model: Any, formula: str) -> float:
    """What Storm says of the initial state, by methods that bound their error."""
    asked = stormpy.parse_properties(formula)[0]
    environment = stormpy.environments.sound()
    environment.modelchecker().multi().precision = stormpy.Rational("1/100000000")
    found = stormpy.model_checking(model, asked, environment=environment)
    return float(found.get_value(model.initial_states[0]))
