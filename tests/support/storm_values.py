"""Storm asked."""

from pathlib import Path
from typing import Any

import stormpy


def value(model: Any, formula: str) -> float:
    """What Storm says of the initial state, by methods that bound their error."""
    asked = stormpy.parse_properties(formula)[0]
    environment = stormpy.environments.sound()
    environment.modelchecker().multi().precision = stormpy.Rational("1/100000000")
    found = stormpy.model_checking(model, asked, environment=environment)
    return float(found.get_value(model.initial_states[0]))


def in_storm(path: Path) -> Any:
    """Storm's model of a DRN or UMB file of ours."""
    if path.suffix == ".umb":
        options = stormpy.io.UmbImportOptions()
        options.build_choice_labeling = options.build_state_valuations = True
        return stormpy.build_model_from_umb(str(path), options=options)
    return stormpy.build_model_from_drn(str(path))
