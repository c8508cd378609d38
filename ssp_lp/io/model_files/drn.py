"""DRN, Storm's text format of models, state by state."""

from __future__ import annotations

import re
from array import array
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np

from ssp_lp.arrays import offsets_of
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files import raw_model
from ssp_lp.io.model_files.raw_model import FilePath, ModelFile, RawModel
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
"""Section of the header -> pattern of its content, and error for other content. The content of the
last four sections is on a line of its own."""

_LONGEST_LINE = 1 << 24  # characters
_WHOLE = re.compile(r"-?\d{1,18}", re.ASCII)  # of 64 bits
_ENTRY = re.compile(r"(state|action)\s+([^\s\[]+)\s*(?:\[([^\]]*)\])?\s*(.*)")
_LABEL = re.compile(r'"([^"]*)"|(\S+)')
_NO_NAME = "__NOLABEL__"


@explained
def read_drn(
    path: FilePath, *, goal: str, cost: str | None = None, dead_ends: DeadEnds | None = None
) -> ModelFile:
    """Read a model from a DRN file of Storm, plain or packed as Storm does (or by gzip alone).

    The cost of an action is its reward plus that of its state. Actions of goal states are dropped.
    A state with the label "deadlock" that no action leaves becomes a dead-end without actions.
    Other labels become ``state_labels``, except for names that reports use already.

    Args:
        path: the file; its type is MDP or DTMC, its probabilities and rewards are numbers.
        goal: the label of the goal states.
        cost: name of the reward model that is the cost ("" for one without a name); None: the only
            one, or a cost of 1 for each action if the file has none.
        dead_ends: states from which no action reaches the goal, labels of them, or a predicate. Any
            other state without actions that is not a goal is then an error.

    Returns:
        The model, whose states are the numbers of the file, and its initial states.

    Raises:
        ModelError: the model is not valid; the error names the line, or the state and the action.
        OSError: the file cannot be opened.
    """
    file = _DrnFile(Path(path))
    return raw_model.finished(_raw_model(file, cost), goal, file.path, dead_ends)


def _sections_of(file: _DrnFile, lines: Iterator[str]) -> dict[str, str]:
    """Return the sections of a DRN file up to the line ``@model``, by name.

    Raises:
        ModelError: a section is unknown, repeated or missing, or the model has another type,
            parameters or intervals; the error names the line.
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
class _DrnFile:
    """A DRN file: its current line, and the states, actions and outcomes read so far. Mutable."""

    path: Path
    number: int = 0  # of the current line
    text: str = ""  # current line without its comment
    n_rewards: int = 0
    n_states: int = 0
    states_read: int = 0
    is_rewarded: bool = False
    is_action: array[int] = field(default_factory=lambda: array("b"))  # [entries] or a state
    n_outcomes: array[int] = field(default_factory=lambda: array("q"))  # [entries]
    rewards: array[float] = field(default_factory=lambda: array("d"))  # [entries, rewards or 1]
    successors: array[int] = field(default_factory=lambda: array("q"))  # [outcomes]
    probabilities: array[float] = field(default_factory=lambda: array("d"))  # [outcomes]
    names: list[str] = field(default_factory=list)  # [actions]
    labels: dict[str, list[int]] = field(default_factory=dict)

    def lines(self) -> Iterator[str]:
        """Yield the lines without comments and outer spaces.

        Raises:
            ModelError: a line that is too long, no UTF-8, or a broken packed file.
            OSError: the file cannot be opened.
        """
        with raw_model.opened_text(self.path) as file:
            while text := file.readline(_LONGEST_LINE):
                self.number += 1
                if len(text) >= _LONGEST_LINE:
                    raise self.fault("the line is too long for a model")
                self.text = text.partition("//")[0]
                yield self.text.strip()

    def fault(self, complaint: str) -> ModelError:
        """Return an error that names the file and the current line."""
        return ModelError(f"{self.path}, line {self.number}: {complaint}")

    def _float(self, word: str) -> float:
        """Return the number or fraction that a word stands for, or raise :class:`ModelError`."""
        plain = word if word.isascii() and "_" not in word else ""
        above, slash, below = plain.partition("/")
        try:
            return int(above) / int(below) if slash else float(plain)
        except (ValueError, ArithmeticError) as error:
            raise self.fault(f"{word[:60]!r} is not a number") from error

    def add(self, line: str) -> None:
        """Add a line of a state, an action or a transition.

        Raises:
            ModelError: the line is wrong; the error names it.
        """
        if line[:1].isdigit():
            if not self.is_action or not self.is_action[-1]:
                raise self.fault("a transition must follow a state or an action")
            to, _, chance = (part.strip() for part in line.partition(":"))
            if not chance or " " in chance:
                raise self.fault("a transition must be 'successor : probability'")
            if not _WHOLE.fullmatch(to):
                raise self.fault(f"{to[:60]!r} is not a whole number")
            successor = int(to)
            if successor >= self.n_states:
                raise self.fault(f"there is no state {successor}")
            self.n_outcomes[-1] += 1
            self.successors.append(successor)
            self.probabilities.append(self._float(chance))
        elif (match := _ENTRY.fullmatch(line)) is not None:
            self._add_entry(*match.groups())
        elif line:
            raise self.fault("neither a state nor an action nor a transition")

    def _add_entry(self, kind: str, name: str, listed: str | None, rest: str) -> None:
        """Add a state or an action from the parts of its line."""
        is_action = kind == "action"
        if is_action and not self.states_read:
            raise self.fault("an action must follow a state")
        if not is_action and name != str(self.states_read):
            raise self.fault(f"expected state {self.states_read}")
        words = listed.split(",") if listed and listed.strip() else []
        if words and len(words) != (self.n_rewards or 1):
            raise self.fault(f"{len(words)} rewards for {self.n_rewards} reward models")
        self.is_rewarded |= bool(words)
        paid = [self._float(word.strip()) for word in words]
        self.rewards.extend(paid or [0.0] * max(self.n_rewards, 1))
        self.is_action.append(is_action)
        self.n_outcomes.append(0)
        if is_action:
            self.names.append("" if name == _NO_NAME else name)
            return
        if rest[:1] in ("{", "!"):
            raise self.fault("observations and exit rates are not supported")
        labels = [quoted or bare for quoted, bare in _LABEL.findall(rest)]
        if any('"' in label for label in labels):
            raise self.fault("a quotation mark is missing")
        for label in dict.fromkeys(labels):
            self.labels.setdefault(label, []).append(self.states_read)
        self.states_read += 1


def _raw_model(file: _DrnFile, cost: str | None) -> RawModel:
    """Read the header of a DRN file, then its states, actions and transitions.

    Raises:
        ModelError: the error names the wrong line, or the missing cost.
    """
    lines = file.lines()
    header = _sections_of(file, lines)
    # Storm writes a blank after each name, and one name may be ""
    listed = re.split("[ \t]", header.get("@reward_models", "").removesuffix(" "))
    rewards = [word.strip('"') for word in listed]
    rewards = rewards if rewards.count("") == 1 < len(rewards) else [*filter(None, rewards)]
    n_states, n_choices = int(header["@nr_states"]), int(header.get("@nr_choices", -1))
    file.n_rewards, file.n_states = len(rewards), n_states
    for line in lines:
        file.add(line)
    if n_states != file.states_read or n_choices not in (-1, len(file.names)):
        stated = f"{n_states} states" + f" and {n_choices} choices" * (n_choices >= 0)
        there = f"{file.states_read} and {len(file.names)}"
        raise file.fault(f"the header says {stated}, the file has {there}")
    is_action = np.array(file.is_action, dtype=np.bool_)
    state = (np.cumsum(~is_action) - 1)[is_action]
    sizes = np.array(file.n_outcomes)[is_action]
    counts = np.bincount(state, minlength=n_states)
    paid = np.reshape(file.rewards, (is_action.size, -1))
    of_pairs, of_states = paid[is_action].T, paid[~is_action][state].T
    listed = [raw_model.decimal_sum(*each) for each in zip(of_pairs, of_states, strict=True)]
    costs = [np.repeat(paid, sizes) for paid in (listed if rewards or file.is_rewarded else [])]
    offsets = offsets_of(counts)
    return RawModel(
        pair_offsets=offsets,
        outcome_offsets=offsets_of(sizes),
        successors=np.array(file.successors),
        probabilities=np.array(file.probabilities),
        **raw_model.costs_of_rewards(file.path, rewards, costs, cost, len(file.successors)),
        actions=raw_model.distinct_actions(file.names, offsets),
        labels={name: np.array(at, dtype=np.int64) for name, at in file.labels.items()},
    )


@explained
def write_drn(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as a DRN file for Storm, packed if the name ends in .gz or .xz.

    State k of the file is the k-th of ``model.states``. Each cost is written as an action reward,
    the model's own first, called "cost" if it has no name. Goal states are labelled "goal",
    dead-ends "deadlock", the start "init"; goal states and dead-ends get a loop of cost 0.

    DRN has one reward for each action. If outcomes of an action differ in cost, the action pays the
    least of their costs, and a more expensive outcome leads to its successor through an extra state
    labelled "paying", which pays the rest. The total cost of a run is unchanged, and the readers of
    this library remove these states. (In other tools, a quantity that is counted up to a failure
    may lack the rest of the cost of the step that fails.)

    Args:
        model: the model.
        path: the file.
        start: the initial state.

    Raises:
        ModelError: the start is not a state, or a label cannot be written.
    """
    place, lines = Path(path), _drn_lines(raw_model.exported(model, start))
    if place.suffix not in (".gz", ".xz"):
        raw_model.write_text(place, lines)
        return
    with TemporaryFile() as text:  # an archive states the size before the text
        text.writelines(line.encode() for line in lines)
        raw_model.write_tar(place, {place.stem: text}, place.suffix)


def _drn_lines(raw: RawModel) -> Iterator[str]:
    """Yield the lines of a DRN file for an exported model."""
    marks: dict[int, str] = {}  # text after the number of a state: its labels
    for name, members in raw.labels.items():
        shown = name if re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) else f'"{name}"'
        for state in members.tolist():
            marks[state] = f"{marks.get(state, '')} {shown}"
    costs, names = raw_model.costs_of_pairs(raw), raw.actions or ()
    paid = np.column_stack([*costs.values()]).tolist()
    yield f"@type: MDP\n@value_type: double\n@parameters\n\n@reward_models\n{' '.join(costs)}\n"
    yield f"@nr_states\n{raw.pair_offsets.size - 1}\n@nr_choices\n{len(paid)}\n@model\n"
    ends = raw.outcome_offsets.tolist()
    for state, (first, last) in enumerate(pairwise(raw.pair_offsets.tolist())):
        yield f"state {state}{marks.get(state, '')}\n"
        for pair in range(first, last):
            yield f"\taction {names[pair]} [{', '.join(map(repr, paid[pair]))}]\n"
            some = slice(ends[pair], ends[pair + 1])
            moves = raw.successors[some].tolist(), raw.probabilities[some].tolist()
            for successor, chance in zip(*moves, strict=True):
                yield f"\t\t{successor} : {chance!r}\n"
