"""Models state by state in text: Storm's format DRN, and PRISM's files beside each other."""

from __future__ import annotations

import re
from array import array
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, compress, count, takewhile
from operator import methodcaller
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, offsets_of
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.raw_model import (
    WHOLE,
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
    write_text,
)
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import DeadEnds

_NUMBER = r"[0-9]{1,18}", "{name} is followed by {value!r}, which is no number"
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
"""What a section of the header must be, and what is said of another; the last four have a line of
their own below their names."""

_ENTRY = re.compile(r"(state|action)\s+([^\s\[]+)\s*(?:\[([^\]]*)\])?\s*(.*)")
_ENTRIES = re.compile(r"\n[ \t]*(state|action)[ \t]+([^\s\[]+)[ \t]*(?:\[([^\]\n]*)\])?[ \t]*(.*)")
"""A line of a state or an action, and all such lines of a block of the file."""

_COLONS, _COMMAS = methodcaller("count", ":"), methodcaller("count", ",")
_LABEL = re.compile(r'"([^"]*)"|(\S+)')
_NO_NAME = "__NOLABEL__"


@explained
def read_drn(
    path: FilePath, *, goal: str, cost: str | None = None, dead_ends: DeadEnds | None = None
) -> ModelFile:
    """Read a model from a DRN file of Storm, plain or packed as Storm packs it (or by gzip alone).

    The cost of an action is its reward plus that of its state. Actions of goal states are dropped,
    and of states with the label "deadlock" that no action leaves: they are dead-ends. Other labels
    of states become ``state_labels``, but for names that reports use for something else.

    Args:
        path: the file; its type is MDP or DTMC, its probabilities and rewards are numbers.
        goal: the label of the goal states.
        cost: the name of a reward model, "" for Storm's without a name; None: the only one, or 1
            for each action if there is none.
        dead_ends: states from which no action reaches the goal, labels of theirs, or a predicate.
            Any other state without actions that is not a goal is then an error.

    Returns:
        The model, whose states are the numbers of the file, and its initial states.

    Raises:
        ModelError: naming the file and the line, or the state and the action.
        OSError: the file cannot be opened.
    """
    file = TextFile(path, r"//.*")
    lines = file.lines()
    raw = _drn_body(file, lines, _drn_header(file, lines), cost)
    return finished(raw, goal, file.path, dead_ends)


def _drn_header(file: TextFile, lines: Iterator[str]) -> dict[str, str]:
    """Sections of a DRN file up to the line ``@model``, by name.

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
        if name not in _SECTIONS:
            raise file.fault(f"{name[:60]!r} is no section that can be read")
        pattern, complaint = _SECTIONS[name]
        value = value.strip() if name in ("@type", "@value_type") else next(lines, "")
        sections[name] = value
        if name == "@reward_models":
            sections[name] = file.text.rstrip("\n")  # a reward without a name is a blank more
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

    def add_lines(self, block: str) -> None:
        """Add a block line by line, however it is written.

        Raises:
            ModelError: naming the line at fault.
        """
        for raw_line in block.splitlines():
            self.file.number += 1
            line = raw_line.strip()
            match = _ENTRY.fullmatch(line)
            if match is not None:
                self._add_entry(*match.groups())
            elif line[:1].isdigit():
                if not self.is_action or not self.is_action[-1]:
                    raise self.file.fault("it stands before any state or action that it belongs to")
                successor, probability = _drn_transition(line, self.file, self.n_states)
                self.successors.append(successor)
                self.probabilities.append(probability)
                self.n_outcomes[-1] += 1
            elif line:
                raise self.file.fault("neither a state nor an action nor a transition")

    def _add_entry(self, kind: str, name: str, listed: str | None, rest: str) -> None:
        """Add the line of a state or an action."""
        is_action = kind == "action"
        if is_action and not self.states_read:
            raise self.file.fault("it stands before any state that it belongs to")
        if not is_action and name != str(self.states_read):
            raise self.file.fault(f"state {self.states_read} should come here")
        paid = _listed_rewards(listed, self.n_rewards, self.file)
        self.is_rewarded |= bool(paid)
        self.rewards.extend(paid or [0.0] * max(self.n_rewards, 1))
        self.is_action.append(is_action)
        self.n_outcomes.append(0)
        if is_action:
            self.names.append(name)
        else:
            self._add_labels(self.states_read, rest)
            self.states_read += 1

    def _add_labels(self, state: int, listed: str) -> None:
        """Add a state's labels."""
        for label in _labels_of_line(listed, self.file):
            self.labels.setdefault(label, []).append(state)

    def add_block(self, block: str) -> bool:
        """Add a block of many lines at once, written as Storm writes them.

        Returns:
            Whether it is added; if not, it is written otherwise, or wrong.
        """
        lines = "\n" + block.rstrip()  # comments, such as Storm's on states, leave empty ones
        pieces = _ENTRIES.split(re.sub("\n+", "\n", lines) if "\n\n" in lines else lines)
        moves, kinds, names, listed, rests = (pieces[k::5] for k in range(5))
        is_action = [kind == "action" for kind in kinds]
        is_state = [kind == "state" for kind in kinds]
        nothing = ",".join(["0"] * max(self.n_rewards, 1))
        rewards = [each or nothing for each in listed]
        first, sizes = self.states_read, [*map(_COLONS, moves)]
        numbers = range(first, first + sum(is_state))
        text, paid, n_moves = "".join(moves), ",".join(rewards), sum(sizes)
        words = text.replace(":", " : ").split()
        ends = words[::3]
        follows = self.is_action or (kinds[:1] == ["state"] and not sizes[0])
        if (
            not follows or (sizes[0] and not self.is_action[-1])
            or any(compress(sizes[1:], is_state))  # transitions belong to actions
            or [*compress(names, is_state)] != [*map(str, numbers)]
            or (rewards and paid.count(",") + 1 != max(self.n_rewards, 1) * len(rewards))
            or (self.n_rewards > 1 and len({*map(_COMMAS, rewards)}) > 1)
            or len(words) != 3 * n_moves or words[1::3].count(":") != n_moves
            or text.count("\n") != n_moves or not (n_moves == 0 or "".join(ends).isdigit())
            or "_" in text + paid or not (text + paid).isascii()
        ):  # fmt: skip
            return False
        try:
            probabilities = array("d", map(float, words[2::3]))
            costs = array("d", map(float, paid.split(",") if paid else ()))
        except ValueError:
            return False
        successors = np.fromstring(" ".join(ends), np.int64, sep=" ")
        if successors.max(initial=0) >= self.n_states:
            return False
        if sizes[0]:
            self.n_outcomes[-1] += sizes[0]
        self.n_outcomes += array("q", sizes[1:])
        self.is_action += array("b", is_action)
        self.successors.frombytes(successors.tobytes())
        self.probabilities += probabilities
        self.is_rewarded |= any(listed)
        self.rewards += costs
        self.names += compress(names, is_action)
        for state, rest in zip(numbers, compress(rests, is_state), strict=True):
            if rest:
                self._add_labels(state, rest)
        self.states_read += len(numbers)
        return True


def _drn_body(
    file: TextFile, lines: Iterator[str], header: dict[str, str], cost: str | None
) -> RawModel:
    """States, actions and transitions of a DRN file, checked against its header.

    Raises:
        ModelError: naming the line at fault, or no cost of this name.
    """
    rewards = _drn_reward_names(header.get("@reward_models", ""))
    place = chosen_reward(file.path, rewards, cost)
    n_states, n_choices = int(header["@nr_states"]), int(header.get("@nr_choices", -1))
    read = _Entries(file, len(rewards), n_states)
    file.in_blocks = True
    for block in lines:
        if not read.add_block(block):
            read.add_lines(block)
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
    offsets, names = offsets_of(counts), read.names
    if _NO_NAME in names:
        positions = (np.arange(state.size) - offsets[state]).tolist()
        numbered = zip(names, positions, strict=True)
        names = [str(position) if name == _NO_NAME else name for name, position in numbered]
    return RawModel(
        pair_offsets=offsets,
        outcome_offsets=offsets_of(sizes),
        successors=np.array(read.successors),
        probabilities=np.array(read.probabilities),
        costs=costs[place or 0],
        named_costs=named_rewards(rewards, costs) if rewards else {},
        actions=distinct_actions(names, state),
        labels={name: np.array(at, dtype=np.int64) for name, at in read.labels.items()},
    )


def _drn_reward_names(listed: str) -> list[str]:
    """Names of reward models, each with a blank behind it as Storm writes them: one may be ""."""
    names = [word.strip('"') for word in re.split("[ \t]", listed.removesuffix(" "))]
    return names if names.count("") == 1 < len(names) else list(filter(None, names))


def _drn_transition(line: str, file: TextFile, n_states: int) -> tuple[int, float]:
    """Successor and probability on a line of a DRN file."""
    words = line.replace(":", " : ").split()
    if len(words) != 3 or words[1] != ":":
        raise file.fault("a transition is written 'successor : probability'")
    successor = file.integer(words[0])
    if successor >= n_states:
        raise file.fault(f"there is no state {successor}")
    return successor, file.float(words[2])


def _listed_rewards(listed: str | None, n_rewards: int, file: TextFile) -> list[float]:
    """The rewards in brackets, one for each reward model; none: nothing stands there."""
    words = listed.split(",") if listed and listed.strip() else []
    if words and len(words) != (n_rewards or 1):
        raise file.fault(f"{len(words)} rewards for {n_rewards} reward models")
    return [file.float(word.strip()) for word in words]


def _labels_of_line(text: str, file: TextFile) -> dict[str, None]:
    """Labels of a state in a DRN file, each in quotation marks or not."""
    if text[:1] in ("{", "!"):
        raise file.fault("observations and exit rates are not read")
    labels = [quoted or bare for quoted, bare in _LABEL.findall(text)]
    if any('"' in label for label in labels):
        raise file.fault("a quotation mark that has no partner")
    return dict.fromkeys(labels)


@explained
def write_drn(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as a DRN file for Storm; packed for it if the name ends in .gz or .xz.

    State k of the file is the k-th of ``model.states``. Each cost is an action reward, the model's
    own first, called "cost" where it has no name.
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
    write_archive(path, _drn_text(exported(model, start)))


def _drn_text(process: Exported) -> Iterator[str]:
    """Lines of a DRN file for a model."""
    marks: dict[int, str] = {}  # what stands behind the number of a state: its labels
    for name, members in process.labels.items():
        shown = name if re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) else f'"{name}"'
        for state in np.asarray(members).tolist():
            marks[state] = f"{marks.get(state, '')} {shown}"
    n_states, n_pairs = process.pair_offsets.size - 1, len(process.costs)
    names = " ".join(process.cost_names)
    yield f"@type: MDP\n@value_type: double\n@parameters\n\n@reward_models\n{names}\n"
    yield f"@nr_states\n{n_states}\n@nr_choices\n{n_pairs}\n@model\n"
    for state, number, pair, moves in process.pairs():
        if number == 0:
            yield f"state {state}{marks.get(state, '')}\n"
        paid = ", ".join(map(repr, process.costs[pair].tolist()))
        yield f"\taction {process.actions[pair]} [{paid}]\n"
        for successor, chance in moves:
            yield f"\t\t{successor} : {chance!r}\n"


_COMMENT, _NO_COMMENT = r'^\s*#.*|\s#[^"]*$', r"(?!)"
_NUMBERED = re.compile(r'(\d{1,9})="([^"]*)"', re.ASCII)
_STRUCTURE = re.compile(r'#\s*Reward structure\s*"([^"]*)"')
_TRUTH = {"true": True, "false": False}


@explained
def read_prism(
    path: FilePath, *, goal: str, cost: str | None = None, dead_ends: DeadEnds | None = None
) -> ModelFile:
    """Read a Markov decision process or Markov chain from PRISM's explicit files.

    The files are ``path.tra`` and ``path.lab``; where they are there, ``path.sta``, which names
    the states; and rewards, ``path.srew`` and ``path.trew``, or else ``path1.srew`` and so on, up
    to the first number that is missing or has a .tra of its own. Each may be gzip, with a further
    .gz. Lines that begin with # are comments. The cost of an outcome is the reward
    of its transition plus that of its state. Actions of goal states are dropped, and of states
    with the label "deadlock" that no action leaves: they are dead-ends.

    Args:
        path: the path of the files without an ending, or that of the .tra file.
        goal: the label of the goal states.
        cost: the name of a reward structure, "" for one without a name; None: the only one, or 1
            for each action if there is none.
        dead_ends: states from which no action reaches the goal, labels of theirs, or a predicate.
            Any other state without actions that is not a goal is then an error.

    Returns:
        The model and its initial states: those with the label "init", or state 0.

    Raises:
        ModelError: naming the file and the line, or the state and the action.
    """
    base = _without_ending(path)
    transitions, labels = _existing(base, ".tra"), _existing(base, ".lab")
    if transitions is None or labels is None:
        raise ModelError(f"{base}.tra and {base}.lab must be there")
    table = _read_table(transitions, {2: 2, 3: 3})
    n_states, is_chain = table.header[0], len(table.header) == 2
    ends = table.keys[:, [0, -1]]
    # each state stands on a line, so that a header alone cannot ask for memory
    if n_states > ends.size or (ends < 0).any() or (ends >= n_states).any():
        raise ModelError(
            f"{transitions}: the states of the lines are not those of the header, {n_states}"
        )
    choice = np.zeros(len(ends), dtype=np.int64) if is_chain else table.keys[:, 1]
    order = np.lexsort((choice, ends[:, 0]))
    keys, choice = table.keys[order], choice[order]
    new = (np.diff(keys[:, 0], prepend=-1) != 0) | (np.diff(choice, prepend=-1) != 0)
    firsts = np.flatnonzero(new)
    sizes = [order.size] if is_chain else [firsts.size, order.size]
    if table.header[1:] != sizes:
        raise ModelError(f"{transitions}: the header says {table.header[1:]}, the file has {sizes}")
    owner, names = keys[firsts, 0], None
    if any(table.names):
        first = zip(order[firsts].tolist(), choice[firsts].tolist(), strict=True)
        names = distinct_actions([table.names[k] or str(number) for k, number in first], owner)
    rewards, states = _reward_files(base), _existing(base, ".sta")
    titles = [*map(_reward_name, rewards)]
    place = chosen_reward(base, titles, cost)
    costs = [_costs(*files, n_states, keys) for files in rewards] or [np.ones(len(keys))]
    raw = RawModel(
        pair_offsets=offsets_of(np.bincount(owner, minlength=n_states)),
        outcome_offsets=np.append(firsts, order.size),
        successors=keys[:, -1],
        probabilities=table.values[order],
        costs=costs[place or 0],
        named_costs=named_rewards(titles, costs) if titles else {},
        actions=names,
        labels={"init": np.zeros(1, dtype=np.int64)} | _read_labels(labels, n_states),
        states=None if states is None else _read_states(states, n_states),
    )
    return finished(raw, goal, transitions, dead_ends)


def _without_ending(path: FilePath) -> Path:
    """Path of PRISM's explicit files without the ending of the file of transitions."""
    base = Path(path)
    return base.with_name(base.name.removesuffix(".gz").removesuffix(".tra"))


def _existing(base: Path, ending: str) -> Path | None:
    """PRISM's explicit file with this ending, plain or gzip; None where there is none."""
    files = (base.with_name(base.name + ending + packed) for packed in ("", ".gz"))
    return next((file for file in files if file.is_file()), None)


class _Table(NamedTuple):
    """Lines of some whole numbers with one real number each."""

    header: list[int]
    keys: IntArray  # [lines, columns]
    values: FloatArray  # [lines]
    names: Sequence[str]  # [lines] the word behind the number, "" where there is none


def _read_table(path: Path, widths: dict[int, int]) -> _Table:
    """Read the text of PRISM's file of transitions or rewards.

    Args:
        path: the file.
        widths: how many whole numbers begin a line, by how many numbers the first line has.

    Raises:
        ModelError: naming the line at fault.
    """
    file = TextFile(path, _COMMENT)
    lines = filter(None, file.lines())
    first = next(lines, "").split()
    if len(first) not in widths or not all(re.fullmatch(r"\d{1,18}", w, re.ASCII) for w in first):
        raise file.fault(f"the first line must have {' or '.join(map(str, widths))} whole numbers")
    width, keys, values, names = widths[len(first)], array("q"), array("d"), list[str]()
    for line in lines:
        words = line.split()
        if len(words) not in (width + 1, width + 2):
            raise file.fault(f"the line must have {width + 1} numbers, and perhaps a word")
        keys.extend(map(file.integer, words[:width]))
        values.append(file.float(words[width]))
        names.append("".join(words[width + 1 :]))
    table = np.array(keys).reshape(-1, width)
    return _Table(list(map(int, first)), table, np.array(values), names)


def _read_labels(path: Path, n_states: int) -> dict[str, IntArray]:
    """Read the text of PRISM's labels, ``0="init" 1="deadlock"`` and then ``state: number ...``.

    Raises:
        ModelError: naming the line at fault.
    """
    file = TextFile(path, _COMMENT)
    lines = filter(None, file.lines())
    line = next(lines, "")
    names = dict(_NUMBERED.findall(line))
    if not names or _NUMBERED.sub("", line).strip():
        raise file.fault('the first line must say 0="init" and so on')
    members: dict[str, list[int]] = {number: [] for number in names}
    for state, listed in _entries(file, lines, n_states):
        for number in listed.split():
            if number not in members:
                raise file.fault(f"there is no label {number[:20]}")
            members[number].append(state)
    return {names[k]: np.unique(np.array(at, dtype=np.int64)) for k, at in members.items()}


def _entries(file: TextFile, lines: Iterator[str], n_states: int) -> Iterator[tuple[int, str]]:
    """Lines ``state: ...`` of PRISM's explicit files, taken apart."""
    for line in lines:
        state, colon, listed = line.partition(":")
        if not colon or not WHOLE.fullmatch(state) or not 0 <= int(state) < n_states:
            raise file.fault(f"the line must begin with a state, 0 to {n_states - 1}, and a colon")
        yield int(state), listed


def _read_states(path: Path, n_states: int) -> Sequence[Hashable] | None:
    """Read the text of PRISM's states, ``(x,y)`` and then ``0:(1,2)``: tuples of values.

    Returns:
        The states; None if they are but numbered, by one variable.

    Raises:
        ModelError: naming the line at fault.
    """
    file = TextFile(path, _COMMENT)
    lines = filter(None, file.lines())
    variables = next(lines, "").strip("()").split(",")
    states: list[Hashable] = [None] * n_states
    for state, listed in _entries(file, lines, n_states):
        words = [word.strip() for word in listed.strip().strip("()").split(",")]
        if len(words) != len(variables) or states[state] is not None:
            raise file.fault(f"state {state} is there twice, or has not its variables' values")
        for word in words:
            if word not in _TRUTH and not WHOLE.fullmatch(word):
                raise file.fault(f"{word[:60]!r} is neither a whole number nor true nor false")
        states[state] = tuple(_TRUTH[word] if word in _TRUTH else int(word) for word in words)
    if None in states:
        raise file.fault(f"state {states.index(None)} is missing")
    return None if all(s == (k,) for k, s in enumerate(states)) else states


def _reward_files(base: Path) -> list[tuple[Path | None, Path | None]]:
    """The files of each reward structure, of states and of transitions.

    They are one pair without a number, or else those from 1 up to the first gap; a number with
    transitions of its own is another model's.
    """
    found = []
    for number in chain(("",), map(str, count(1))):
        files = _existing(base, f"{number}.srew"), _existing(base, f"{number}.trew")
        if number and (files == (None, None) or _existing(base, f"{number}.tra")):
            break
        if files != (None, None):
            found.append(files)
            if not number:
                break
    return found


def _reward_name(files: tuple[Path | None, Path | None]) -> str:
    """The name of a reward structure in the comments of its files, "" where it has none.

    Raises:
        ModelError: the two files name different ones.
    """
    names = set()
    for path in filter(None, files):
        heading = takewhile(lambda line: line[:1] in ("", "#"), TextFile(path, _NO_COMMENT).lines())
        names |= {match[1] for match in map(_STRUCTURE.match, heading) if match}
    if len(names) > 1:
        raise ModelError(f"{files[0]} and {files[1]} name different reward structures")
    return "".join(names)


def _costs(
    of_states: Path | None, of_transitions: Path | None, n_states: int, keys: IntArray
) -> FloatArray:
    """Cost of each outcome from PRISM's rewards, of state and transition, [outcomes].

    Raises:
        ModelError: naming the file and what does not fit the transitions.
    """
    by_state, paid = np.zeros(n_states), np.zeros(len(keys))
    if of_states is not None:
        table = _read_rewards(of_states, {2: 1}, n_states)
        by_state[table.keys[:, 0]] = table.values
    if of_transitions is not None:
        width = keys.shape[1]
        table = _read_rewards(of_transitions, {width: width}, n_states)
        rows, known = map(tuple, table.keys.tolist()), list(map(tuple, keys.tolist()))
        listed = dict(zip(rows, table.values.tolist(), strict=True))
        if len(listed) < len(table.values) or not listed.keys() <= set(known):
            raise ModelError(f"{of_transitions}: a transition is there twice, or does not exist")
        paid = np.array([listed.get(key, 0.0) for key in known])
    return decimal_sum(paid, by_state[keys[:, 0]])


def _read_rewards(path: Path, widths: dict[int, int], n_states: int) -> _Table:
    """PRISM's explicit file of rewards; :class:`ModelError` unless it is one of these states."""
    table = _read_table(path, widths)
    state = table.keys[:, 0]
    if table.header[0] != n_states or (state < 0).any() or (state >= n_states).any():
        raise ModelError(f"{path}: the states are not the {n_states} of the transitions")
    if table.header[-1] != state.size:
        raise ModelError(
            f"{path}: the header says {table.header[-1]} rewards, there are {state.size}"
        )
    return table


@explained
def write_prism(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as PRISM's explicit files: .tra, .lab, .sta, .srew and .trew.

    States, costs and labels are those of :func:`ssp_lp.io.write_drn`; each cost is a reward
    structure, of which several are ``path1.trew`` and so on. Where each state is a tuple of as many
    whole numbers or truth values, and each action has one cost, ``path.sta`` names the states so;
    else it numbers them.

    Args:
        model: the model.
        path: the path of the files without an ending, or that of the .tra file.
        start: the initial state.

    Raises:
        ModelError: the start is no state, or a label cannot be written.
    """
    base, process = _without_ending(path), exported(model, start)
    n_states, n_pairs = process.pair_offsets.size - 1, len(process.costs)
    texts: dict[str, Iterable[str]] = {
        ".tra": chain(
            [f"{n_states} {n_pairs} {process.successors.size}\n"],
            (
                f"{state} {number} {successor} {chance!r} {process.actions[pair]}\n"
                for state, number, pair, moves in process.pairs()
                for successor, chance in moves
            ),
        ),
        ".lab": _label_lines(process),
        ".sta": _state_lines(n_states, model),
    }
    for k, name in enumerate(process.cost_names):
        number = "" if len(process.cost_names) == 1 else str(k + 1)
        texts[f"{number}.trew"] = _reward_lines(process, k)
        texts[f"{number}.srew"] = [f'# Reward structure "{name}"\n# State rewards\n{n_states} 0\n']
    for ending, text in texts.items():
        write_text(base.with_name(base.name + ending), text)


def _reward_lines(process: Exported, k: int) -> Iterator[str]:
    """The file of the rewards of transitions that are the k-th cost."""
    costs = process.costs[:, k]
    n_paid = int(np.diff(process.outcome_offsets)[costs != 0.0].sum())
    yield f'# Reward structure "{process.cost_names[k]}"\n# Transition rewards\n'
    yield f"{process.pair_offsets.size - 1} {costs.size} {n_paid}\n"
    for state, number, pair, moves in process.pairs():
        if paid := float(costs[pair]):
            yield from (f"{state} {number} {successor} {paid!r}\n" for successor, _ in moves)


def _label_lines(process: Exported) -> Iterator[str]:
    """PRISM's explicit file of labels, as lines."""
    yield " ".join(f'{k}="{name}"' for k, name in enumerate(process.labels)) + "\n"
    borne: dict[int, list[str]] = {}
    for number, members in enumerate(process.labels.values()):
        for state in np.asarray(members).tolist():
            borne.setdefault(state, []).append(str(number))
    for state in sorted(borne):
        yield f"{state}: {' '.join(borne[state])}\n"


def _state_lines(n_states: int, model: SSP) -> Iterator[str]:
    """PRISM's explicit file of states: their names, if those are tuples, else their numbers."""
    rows: list[tuple[Hashable, ...]] = [s for s in model.states if isinstance(s, tuple)]
    plain = n_states == len(rows) and len(set(map(len, rows))) == 1 and rows[0] != ()
    if not plain or any(type(value) not in (int, bool) for row in rows for value in row):
        yield "(x)\n"
        yield from (f"{k}:({k})\n" for k in range(n_states))
        return
    yield f"({','.join(f'x{k}' for k in range(len(rows[0])))})\n"
    for k, row in enumerate(rows):
        yield f"{k}:({','.join(str(value).lower() for value in row)})\n"
