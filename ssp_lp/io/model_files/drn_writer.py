"""Storm's explicit format DRN, written."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator

import numpy as np

from ssp_lp.arrays import IntArray
from ssp_lp.io.model_files.exported import Exported, exported, write_text
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained

_STATES_AT_A_TIME = 10_000


@explained
def write_drn(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as a DRN file for Storm; gzip if the name ends in .gz.

    State k of the file is the k-th of ``model.states``. The cost is the action reward "cost".
    Where outcomes of an action differ in cost, the action pays the least, and a dearer outcome
    leads through a state labelled "paying" that pays the rest: each run keeps its total, and our
    readers take the state out again. (For other tools, what is counted up to a failure can lack
    the rest of the step that fails.) Goal states are labelled "goal", dead-ends "deadlock", the
    start "init"; goal states and dead-ends get a free loop.

    Args:
        model: the model.
        path: the file.
        start: the initial state.

    Raises:
        ModelError: the start is no state, or a label cannot be written.
    """
    write_text(path, _drn_text(exported(model, start)))


def _drn_text(process: Exported) -> Iterator[str]:
    """The DRN file in pieces."""
    n_states, n_pairs = process.pair_offsets.size - 1, process.costs.size
    yield "@type: MDP\n@value_type: double\n@parameters\n\n@reward_models\ncost\n"
    yield f"@nr_states\n{n_states}\n@nr_choices\n{n_pairs}\n@model\n"
    marks = _drn_marks(process)
    for first in range(0, n_states, _STATES_AT_A_TIME):
        yield _drn_states_text(process, first, min(first + _STATES_AT_A_TIME, n_states), marks)


def _drn_states_text(process: Exported, first: int, end: int, marks: dict[int, str]) -> str:
    """The lines of the states ``first`` to ``end - 1``."""
    pairs, begin = _drn_part(process.pair_offsets, first, end)
    outcomes, entry = _drn_part(process.outcome_offsets, begin, begin + pairs[-1])
    stop = entry + outcomes[-1]
    moves = [
        f"\t\t{successor} : {chance!r}\n"
        for successor, chance in zip(
            process.successors[entry:stop].tolist(),
            process.probabilities[entry:stop].tolist(),
            strict=True,
        )
    ]
    costs = process.costs[begin : begin + pairs[-1]].tolist()
    lines = []
    for state in range(first, end):
        lines.append(f"state {state}{marks.get(state, '')}\n")
        for k in range(pairs[state - first], pairs[state - first + 1]):
            lines.append(f"\taction {process.actions[begin + k]} [{costs[k]!r}]\n")
            lines += moves[outcomes[k] : outcomes[k + 1]]
    return "".join(lines)


def _drn_part(offsets: IntArray, first: int, end: int) -> tuple[list[int], int]:
    """Offsets of some segments counted from the first of them, and where that begins."""
    begin = int(offsets[first])
    return (offsets[first : end + 1] - begin).tolist(), begin


def _drn_marks(process: Exported) -> dict[int, str]:
    """What stands behind the number of a state: its labels."""
    marks: dict[int, str] = {}
    for name, members in process.labels.items():
        shown = name if re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) else f'"{name}"'
        for state in np.asarray(members).tolist():
            marks[state] = f"{marks.get(state, '')} {shown}"
    return marks
