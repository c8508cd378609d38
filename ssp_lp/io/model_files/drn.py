"""Storm's explicit format DRN: Markov decision processes and Markov chains with numbers."""

from __future__ import annotations

import re
from array import array
from collections.abc import Hashable, Iterator, Sequence

import numpy as np

from ssp_lp.arrays import offsets_of
from ssp_lp.errors import Argument, ModelError
from ssp_lp.io.model_files.raw_model import (
    Exported,
    ModelFile,
    RawModel,
    decimal_sum,
    distinct_actions,
    exported,
    finished,
)
from ssp_lp.io.model_files.text_file import FilePath, TextFile, write_text
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained

_KINDS = ("MDP", "DTMC")
_NUMBERS = ("double", "rational")
_ONE_LINE = ("@parameters", "@reward_models", "@nr_states", "@nr_choices")
_STATE = re.compile(r"state\s+(\d+)\s*(?:\[([^\]]*)\])?\s*(.*)", re.ASCII)
_ACTION = re.compile(r"action\s+([^\s\[]+)\s*(?:\[([^\]]*)\])?\s*(.*)")
_LABEL = re.compile(r'"([^"]*)"|(\S+)')
_NO_NAME = "__NOLABEL__"


@explained
def read_drn(path: FilePath, *, goal: str, cost: str | None = None) -> ModelFile:
    """Read a model from a DRN file of Storm, plain or gzip.

    The cost of an action is its reward plus that of its state. Actions of goal states are dropped,
    and of states with the label "deadlock" that no action leaves: they are dead-ends. Other labels
    of states become ``state_labels``, but for names that reports use for something else.

    Args:
        path: the file; its type is MDP or DTMC, its probabilities and rewards are numbers.
        goal: the label of the goal states.
        cost: the name of a reward model, "" for Storm's without a name; None: the only one, or 1
            for each action if there is none.

    Returns:
        The model, whose states are the numbers of the file, and its initial states.

    Raises:
        ModelError: naming the file and the line, or the state and the action.
        OSError: the file cannot be opened.
    """
    file = TextFile(path, r"//.*")
    lines = file.lines()
    header = _read_header(file, lines)
    rewards = [word.strip('"') for word in header.get("@reward_models", "").split()]
    return finished(_read_body(file, lines, header, rewards, cost), goal, file.path)


def _read_header(file: TextFile, lines: Iterator[str]) -> dict[str, str]:
    """The sections up to the line ``@model``, by name.

    Raises:
        ModelError: naming the line: a section that is unknown, twice there or missing, or a model
            of another type, with parameters or with intervals.
    """
    sections: dict[str, str] = {}
    for line in lines:
        if line == "@model":
            if "@type" not in sections or "@nr_states" not in sections:
                raise file.fault("@type and @nr_states must come before @model")
            return sections
        if not line:
            continue
        name, _, value = line.partition(":")
        if name in sections:
            raise file.fault(f"{name} is there twice")
        if name in _ONE_LINE:
            value = next(lines, "")
        elif name not in ("@type", "@value_type"):
            raise file.fault(f"{name[:60]!r} is no section that can be read")
        sections[name] = value = value.strip()
        shown = repr(value[:60])
        if name == "@type" and value.upper() not in _KINDS:
            raise file.fault(f"models of type {shown} are not read, only {' and '.join(_KINDS)}")
        if name == "@value_type" and value not in _NUMBERS:
            raise file.fault(f"values of type {shown} are not read, only double and rational")
        if name == "@parameters" and value:
            raise file.fault("a model with parameters has no numbers; instantiate it first")
        if name.startswith("@nr") and not re.fullmatch(r"\d{1,18}", value, re.ASCII):
            raise file.fault(f"{name} is followed by {shown}, which is no number")
    raise file.fault("the file ends before @model")


def _reward_column(rewards: Sequence[str], cost: str | None, file: TextFile) -> int | None:
    """Position of the reward model that is the cost; None: the header names none.

    Raises:
        ModelError: there is none of this name, or several to choose from.
    """
    if cost in ("", None) and not rewards:
        return None  # "" is Storm's model without a name, which the header does not show
    known = ", ".join(map(repr, rewards)) or "none"
    if cost is None and len(rewards) > 1:
        told = f"{file.path}: choose one of the reward models ("
        raise ModelError(told, Argument("cost"), f"): {known}")
    if cost is None:
        return 0
    if cost not in rewards:
        raise ModelError(f"{file.path}: no reward model {cost!r}; there are: {known}")
    return rewards.index(cost)


def _read_body(
    file: TextFile,
    lines: Iterator[str],
    header: dict[str, str],
    rewards: Sequence[str],
    cost: str | None,
) -> RawModel:
    """States, actions and transitions, checked against the header.

    Raises:
        ModelError: naming the line at fault.
    """
    column = _reward_column(rewards, cost, file)
    n_states, n_choices = int(header["@nr_states"]), int(header.get("@nr_choices", -1))
    is_rewarded = column is not None
    pair_counts, outcome_counts, successors = array("q"), array("q"), array("q")
    state_rewards, pair_rewards, probabilities = array("d"), array("d"), array("d")
    names: list[str] = []
    labels: dict[str, list[int]] = {}
    for line in lines:
        if line.startswith("s"):
            match = _STATE.fullmatch(line)
            if match is None or int(match[1][:19]) != len(pair_counts):
                raise file.fault(f"state {len(pair_counts)} should come here")
            for label in _labels_of_line(match[3], file):
                labels.setdefault(label, []).append(len(pair_counts))
            paid = _listed_reward(match[2], len(rewards), column, file)
            state_rewards.append(paid or 0.0)
            is_rewarded |= paid is not None
            pair_counts.append(0)
        elif line.startswith("a"):
            match = _ACTION.fullmatch(line)
            if match is None:
                raise file.fault("this is no action")
            if not pair_counts:
                raise file.fault("it stands before any state that it belongs to")
            paid = _listed_reward(match[2], len(rewards), column, file)
            pair_rewards.append(paid or 0.0)
            is_rewarded |= paid is not None
            names.append(match[1] if match[1] != _NO_NAME else str(pair_counts[-1]))
            pair_counts[-1] += 1
            outcome_counts.append(0)
        elif line[:1].isdigit():
            words = line.replace(":", " : ").split()
            if len(words) != 3 or words[1] != ":":
                raise file.fault("a transition is written 'successor : probability'")
            if not pair_counts or not pair_counts[-1]:
                raise file.fault("it stands before any state or action that it belongs to")
            successors.append(file.integer(words[0]))
            if successors[-1] >= n_states:
                raise file.fault(f"there is no state {successors[-1]}")
            probabilities.append(file.float(words[2]))
            outcome_counts[-1] += 1
        elif line:
            raise file.fault("neither a state nor an action nor a transition")
    if n_states != len(pair_counts) or n_choices not in (-1, len(names)):
        told = "" if n_choices < 0 else f" and {n_choices} choices"
        raise file.fault(
            f"the header says {n_states} states{told}, the file has {len(pair_counts)} and "
            f"{len(names)}"
        )
    counts = np.array(pair_counts)
    state = np.repeat(np.arange(n_states), counts)
    paid_by_pair = np.ones(len(names))
    if is_rewarded:
        paid_by_pair = decimal_sum(np.array(pair_rewards), np.array(state_rewards)[state])
    return RawModel(
        pair_offsets=offsets_of(counts),
        outcome_offsets=offsets_of(np.array(outcome_counts)),
        successors=np.array(successors),
        probabilities=np.array(probabilities),
        costs=np.repeat(paid_by_pair, np.array(outcome_counts)),
        actions=distinct_actions(names, state),
        labels={name: np.array(at, dtype=np.int64) for name, at in labels.items()},
    )


def _listed_reward(
    listed: str | None, n_rewards: int, column: int | None, file: TextFile
) -> float | None:
    """The reward that is the cost, of those in brackets; None: there are none."""
    words = listed.split(",") if listed and listed.strip() else []
    if not words:
        return None
    if len(words) != (n_rewards or 1):
        raise file.fault(f"{len(words)} rewards for {n_rewards} reward models")
    return file.float(words[column or 0].strip())


def _labels_of_line(text: str, file: TextFile) -> dict[str, None]:
    """The labels of a state, each in quotation marks or not."""
    if text[:1] in ("{", "!"):
        raise file.fault("observations and exit rates are not read")
    labels = [quoted or bare for quoted, bare in _LABEL.findall(text)]
    if any('"' in label for label in labels):
        raise file.fault("a quotation mark that has no partner")
    return dict.fromkeys(labels)


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
    """The lines of the DRN file."""
    marks: dict[int, str] = {}  # what stands behind the number of a state: its labels
    for name, members in process.labels.items():
        shown = name if re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) else f'"{name}"'
        for state in np.asarray(members).tolist():
            marks[state] = f"{marks.get(state, '')} {shown}"
    n_states, n_pairs = process.pair_offsets.size - 1, process.costs.size
    yield "@type: MDP\n@value_type: double\n@parameters\n\n@reward_models\ncost\n"
    yield f"@nr_states\n{n_states}\n@nr_choices\n{n_pairs}\n@model\n"
    for state, number, pair, cost, moves in process.pairs():
        if number == 0:
            yield f"state {state}{marks.get(state, '')}\n"
        yield f"\taction {process.actions[pair]} [{cost!r}]\n"
        for successor, chance in moves:
            yield f"\t\t{successor} : {chance!r}\n"
