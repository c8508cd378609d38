"""DRN, Storm's text format of models, state by state."""

from __future__ import annotations

import re
from array import array
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from ssp_lp.arrays import offsets_of
from ssp_lp.io.model_files.raw_model import (
    Exported,
    FilePath,
    ModelFile,
    RawModel,
    TextFile,
    chosen_reward,
    decimal_sum,
    distinct_actions,
    exported,
    finished,
    named_rewards,
    write_archive,
)
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import DeadEnds

_NUMBER = r"[0-9]{1,18}", "{name} is followed by {value!r}, which is not a number"
_SECTIONS = {
    "@type": ("(?i:MDP|DTMC)", "models of type {value!r} are not read, only MDP and DTMC"),
    "@value_type": (
        "double|rational", "values of type {value!r} are not read, only double and rational"
    ),
    "@parameters": ("", "a model with parameters has no numbers; instantiate it first"),
    "@reward_models": (".*", ""),
    "@nr_states": _NUMBER,
    "@nr_choices": _NUMBER,
}  # fmt: skip
"""Pattern of the content of each section of the header, and the error otherwise; the content of the
last four is on a line of its own."""

_ENTRY = re.compile(r"(state|action)\s+([^\s\[]+)\s*(?:\[([^\]]*)\])?\s*(.*)")
_LABEL = re.compile(r'"([^"]*)"|(\S+)')
_NO_NAME = "__NOLABEL__"


@explained
def read_drn(
    path: FilePath, *, goal: str, cost: str | None = None, dead_ends: DeadEnds | None = None
) -> ModelFile:
    """Read a model from a DRN file of Storm, plain or packed as Storm does (or by gzip alone).

    The cost of an action is its reward plus that of its state. Actions of goal states are dropped.
    If no action leaves a state with the label "deadlock", its actions are dropped: it is a
    dead-end. Other labels become ``state_labels``, except for names that reports use already.

    Args:
        path: the file; its type is MDP or DTMC, its probabilities and rewards are numbers.
        goal: the label of the goal states.
        cost: name of a reward model, "" for Storm's without a name; None: the only one, or 1 for
            each action if there is none.
        dead_ends: states from which no action reaches the goal, labels of them, or a predicate.
            Any other state without actions that is not a goal is then an error.

    Returns:
        The model, whose states are the numbers of the file, and its initial states.

    Raises:
        ModelError: naming the file and the line, or the state and the action.
        OSError: the file cannot be opened.
    """
    file = TextFile(path, "//")
    lines = file.lines()
    raw = _drn_body(file, lines, _drn_header(file, lines), cost)
    return finished(raw, goal, file.path, dead_ends)


def _drn_header(file: TextFile, lines: Iterator[str]) -> dict[str, str]:
    """Return the sections of a DRN file up to the line ``@model``, by name.

    Raises:
        ModelError: naming the line: a section that is unknown, repeated or missing, or a model of
            another type, with parameters or with intervals.
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
            raise file.fault(f"{name} occurs twice")
        if name not in _SECTIONS:
            raise file.fault(f"{name[:60]!r} is not a known section")
        pattern, complaint = _SECTIONS[name]
        value = value.strip() if name in ("@type", "@value_type") else next(lines, "")
        sections[name] = value
        if name == "@reward_models":
            sections[name] = file.text.rstrip("\n")  # unnamed rewards add a blank
        if not re.fullmatch(pattern, value):
            raise file.fault(complaint.format(name=name, value=value[:60]))
    raise file.fault("the file ends before @model")


@dataclass
class _Entries:
    """Lines of a DRN file below its header: states and actions in their order, and transitions."""

    file: TextFile
    n_rewards: int
    n_states: int
    is_action: array[int] = field(default_factory=lambda: array("b"))  # [entries]
    n_outcomes: array[int] = field(default_factory=lambda: array("q"))  # [entries]
    rewards: array[float] = field(default_factory=lambda: array("d"))  # [entries, rewards or 1]
    successors: array[int] = field(default_factory=lambda: array("q"))  # [outcomes]
    probabilities: array[float] = field(default_factory=lambda: array("d"))  # [outcomes]
    names: list[str] = field(default_factory=list)  # [actions]
    labels: dict[str, list[int]] = field(default_factory=dict)
    states_read: int = 0
    is_rewarded: bool = False

    def add(self, line: str) -> None:
        """Add a line of a state, an action or a transition.

        Raises:
            ModelError: naming the line at fault.
        """
        if line[:1].isdigit():
            if not self.is_action or not self.is_action[-1]:
                raise self.file.fault("a transition must follow a state or an action")
            to, _, chance = (part.strip() for part in line.partition(":"))
            if not chance or " " in chance:
                raise self.file.fault("a transition must be 'successor : probability'")
            successor = self.file.integer(to)
            if successor >= self.n_states:
                raise self.file.fault(f"there is no state {successor}")
            self.n_outcomes[-1] += 1
            self.successors.append(successor)
            self.probabilities.append(self.file.float(chance))
        elif (match := _ENTRY.fullmatch(line)) is not None:
            self._add_entry(*match.groups())
        elif line:
            raise self.file.fault("neither a state nor an action nor a transition")

    def _add_entry(self, kind: str, name: str, listed: str | None, rest: str) -> None:
        """Add the line of a state or an action."""
        is_action = kind == "action"
        if is_action and not self.states_read:
            raise self.file.fault("an action must follow a state")
        if not is_action and name != str(self.states_read):
            raise self.file.fault(f"expected state {self.states_read}")
        words = listed.split(",") if listed and listed.strip() else []
        if words and len(words) != (self.n_rewards or 1):
            raise self.file.fault(f"{len(words)} rewards for {self.n_rewards} reward models")
        self.is_rewarded |= bool(words)
        paid = [self.file.float(word.strip()) for word in words]
        self.rewards.extend(paid or [0.0] * max(self.n_rewards, 1))
        self.is_action.append(is_action)
        self.n_outcomes.append(0)
        if is_action:
            self.names.append("" if name == _NO_NAME else name)
            return
        if rest[:1] in ("{", "!"):
            raise self.file.fault("observations and exit rates are not supported")
        labels = [quoted or bare for quoted, bare in _LABEL.findall(rest)]
        if any('"' in label for label in labels):
            raise self.file.fault("a quotation mark is missing")
        for label in dict.fromkeys(labels):
            self.labels.setdefault(label, []).append(self.states_read)
        self.states_read += 1


def _drn_body(
    file: TextFile, lines: Iterator[str], header: dict[str, str], cost: str | None
) -> RawModel:
    """Read states, actions and transitions of a DRN file, checked against its header.

    Raises:
        ModelError: naming the wrong line, or the missing cost.
    """
    # Storm writes a blank after each name, and one name may be ""
    listed = re.split("[ \t]", header.get("@reward_models", "").removesuffix(" "))
    rewards = [word.strip('"') for word in listed]
    rewards = rewards if rewards.count("") == 1 < len(rewards) else [*filter(None, rewards)]
    place = chosen_reward(file.path, rewards, cost)
    n_states, n_choices = int(header["@nr_states"]), int(header.get("@nr_choices", -1))
    read = _Entries(file, len(rewards), n_states)
    for line in lines:
        read.add(line)
    if n_states != read.states_read or n_choices not in (-1, len(read.names)):
        stated = f"{n_states} states" + f" and {n_choices} choices" * (n_choices >= 0)
        there = f"{read.states_read} and {len(read.names)}"
        raise file.fault(f"the header says {stated}, the file has {there}")
    is_action = np.array(read.is_action, dtype=np.bool_)
    state = (np.cumsum(~is_action) - 1)[is_action]
    sizes = np.array(read.n_outcomes)[is_action]
    counts = np.bincount(state, minlength=n_states)
    paid = np.reshape(read.rewards, (is_action.size, -1))
    of_pairs, of_states = paid[is_action].T, paid[~is_action][state].T
    listed = [decimal_sum(*each) for each in zip(of_pairs, of_states, strict=True)]
    is_rewarded = read.is_rewarded or place is not None
    costs = [np.repeat(c, sizes) for c in (listed if is_rewarded else [np.ones(state.size)])]
    offsets = offsets_of(counts)
    return RawModel(
        pair_offsets=offsets,
        outcome_offsets=offsets_of(sizes),
        successors=np.array(read.successors),
        probabilities=np.array(read.probabilities),
        costs=costs[place or 0],
        named_costs=named_rewards(rewards, costs) if rewards else {},
        actions=distinct_actions(read.names, offsets),
        labels={name: np.array(at, dtype=np.int64) for name, at in read.labels.items()},
    )


@explained
def write_drn(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as a DRN file for Storm; packed for it if the name ends in .gz or .xz.

    State k of the file is the k-th of ``model.states``. Each cost is an action reward, the model's
    own first, called "cost" if it has no name. If outcomes of an action differ in cost, the action
    pays the least, and a more expensive outcome leads through a state labelled "paying" that pays
    the rest: each run keeps its total, and our readers remove the state again. (In other tools, a
    quantity counted up to a failure may lack the rest of the step that fails.) Goal states are
    labelled "goal", dead-ends "deadlock", the start "init"; goal states and dead-ends get a free
    loop.

    Args:
        model: the model.
        path: the file.
        start: the initial state.

    Raises:
        ModelError: the start is not a state, or a label cannot be written.
    """
    write_archive(path, _drn_text(exported(model, start)))


def _drn_text(process: Exported) -> Iterator[str]:
    """Yield the lines of a DRN file for a model."""
    marks: dict[int, str] = {}  # text after the number of a state: its labels
    for name, members in process.labels.items():
        shown = name if re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) else f'"{name}"'
        for state in np.asarray(members).tolist():
            marks[state] = f"{marks.get(state, '')} {shown}"
    n_states, n_pairs = process.pair_offsets.size - 1, len(process.costs)
    names = " ".join(process.cost_names)
    yield f"@type: MDP\n@value_type: double\n@parameters\n\n@reward_models\n{names}\n"
    yield f"@nr_states\n{n_states}\n@nr_choices\n{n_pairs}\n@model\n"
    ends, pairs = process.outcome_offsets.tolist(), process.pair_offsets.tolist()
    for state, (first, last) in enumerate(pairwise(pairs)):
        yield f"state {state}{marks.get(state, '')}\n"
        for pair in range(first, last):
            paid = ", ".join(map(repr, process.costs[pair].tolist()))
            yield f"\taction {process.actions[pair]} [{paid}]\n"
            some = slice(ends[pair], ends[pair + 1])
            moves = process.successors[some].tolist(), process.probabilities[some].tolist()
            for successor, chance in zip(*moves, strict=True):
                yield f"\t\t{successor} : {chance!r}\n"
