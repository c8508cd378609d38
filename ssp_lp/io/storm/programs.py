"""Files that Storm reads: programs in PRISM's language, JANI, and archives UMB."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ssp_lp.errors import Argument, ModelError
from ssp_lp.io.model_files.raw_model import DEADLOCK, INITIAL, ModelFile
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.io.storm.bindings import ask_storm, storm
from ssp_lp.io.storm.from_storm import (
    BEYOND,
    built_from_storm,
    check_kind,
    label_formula,
    states_beyond,
)
from ssp_lp.io.storm.sound_files import check_jani, check_umb
from ssp_lp.model.arguments import explained

Constants = str | Mapping[str, Any]
"""What the constants of a program are, such as "N=5,p=0.1"."""


@explained
def read_with_storm(
    path: FilePath, *, goal: str, cost: str | None = None, constants: Constants | None = None
) -> ModelFile:
    """Read a model through Storm: a program in PRISM's language, in JANI, or a UMB archive.

    States are tuples of the values of their variables, in Storm's order; actions bear their
    labels; the cost is that of :func:`~ssp_lp.io.from_stormpy`, PRISM's rewards of states and of
    actions. JANI's rewards that differ between outcomes of an action are refused: Storm could
    only average them.

    Args:
        path: the file; its ending says what it is: .prism, .nm and .pm PRISM's language, .jani, or
            .umb.
        goal: a label, or a condition on the variables such as "x=4 & !broken" (of an archive:
            on labels).
        cost: the name of a reward model, or of a transient variable of JANI; None: the only one, or
            1 for each action if there is none.
        constants: values of the constants that the program leaves open, as text or by name.

    Returns:
        The model and its initial states.

    Raises:
        MissingDependencyError: stormpy is not installed.
        ModelError: Storm refuses the file, the goal or the constants; a model in continuous time,
            with observations or parameters; or naming the state and the action at fault.
        OSError: the file cannot be read.
    """
    file = Path(path)
    with file.open("rb"):  # Storm's own complaint would not be an OSError
        stormpy = storm()
    if file.suffix == ".umb":
        check_umb(file)
        return _archived_program(stormpy, file, goal, cost, constants)
    if file.suffix == ".jani":
        check_jani(file)
        program, _ = ask_storm(file, stormpy.parse_jani_model, str(file))
    else:
        program = ask_storm(
            file, stormpy.parse_prism_program, str(file), prism_compatibility=True, simplify=False
        )
    check_kind(ask_storm(file, getattr, program, "model_type").name, file)
    program, _ = ask_storm(file, stormpy.instantiate_constants, program, constants or {})
    return _explored_program(stormpy, file, program, goal, cost)


def _archived_program(
    stormpy: Any, file: Path, goal: str, cost: str | None, constants: Constants | None
) -> ModelFile:
    """The model of a UMB archive."""
    if constants:
        raise ModelError(f"{file} has no constants: leave ", Argument("constants"), " out")
    options = stormpy.io.UmbImportOptions()
    options.build_choice_labeling = options.build_state_valuations = True
    model = ask_storm(file, stormpy.build_model_from_umb, str(file), options=options)
    return built_from_storm(model, goal, label_formula(goal), cost, str(file))


def _explored_program(
    stormpy: Any, file: Path, program: Any, goal: str, cost: str | None
) -> ModelFile:
    """The model that a program without open constants describes."""
    named = f"{file}, goal {goal!r}{_program_labels(program)}"
    formula = _program_property(stormpy, named, _program_condition(program, goal), program)
    # a condition that stands alone would have Storm explore no further than where it holds
    wanted = [formula, _program_property(stormpy, str(file), "true", program)]
    if cost is not None:
        reward = f'R{{"{cost}"}}min=? [C]' if cost else "Rmin=? [C]"
        wanted.append(_program_property(stormpy, f"{file}, cost {cost!r}", reward, program))
    options = ask_storm(file, stormpy.BuilderOptions, wanted, program)
    options.set_build_all_labels()
    options.set_build_choice_labels()
    options.set_build_state_valuations()
    options.set_scale_and_lift_transition_rewards(False)
    options.set_add_out_of_bounds_state()  # its own check would refuse 0.8 + 0.1 + 0.1
    if cost is None:
        options.set_build_all_reward_models()
    model = ask_storm(file, stormpy.build_model, program, options=options)
    found = built_from_storm(model, goal, formula, cost, str(file))
    if states_beyond(model).size:
        names = enumerate(found.model.states)
        beyond = [k for k, name in names if isinstance(name, tuple) and name[0] == BEYOND]
        leading = np.flatnonzero(np.isin(found.model.successors, beyond))
        where = found.model._describe_outcome(int(leading[0])) if leading.size else "a goal"
        raise ModelError(f"{file}, {where}: a variable leaves its bounds")
    return found


def _program_labels(program: Any) -> str:
    """The labels of a program in PRISM's language, for errors."""
    names = ", ".join(repr(label.name) for label in getattr(program, "labels", ()))
    return f" (labels: {names})" if names else ""


def _program_condition(program: Any, goal: str) -> str:
    """The goal as Storm writes it: labels of programs stand in quotation marks."""
    is_label = goal in (INITIAL, DEADLOCK)
    if hasattr(program, "has_label"):  # PRISM's; JANI's labels are variables
        is_label = is_label or program.has_label(goal)
    return f'"{goal}"' if is_label else goal


def _program_property(stormpy: Any, source: str, text: str, program: Any) -> Any:
    """One property of a program."""
    found = ask_storm(source, stormpy.parse_properties, text, program)
    if len(found) != 1:
        raise ModelError(f"{source}: one condition, not {len(found)}")
    return found[0]
