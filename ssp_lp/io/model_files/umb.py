"""UMB, the unified Markov binary format: a tar archive of arrays with an index in JSON.

The format is that of https://github.com/pmc-tools/umb, which PRISM, Storm and Modest write.
"""

from __future__ import annotations

import json
import tarfile
from collections.abc import Hashable, Iterable, Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, offsets_of, segment_ids
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files import raw_model
from ssp_lp.io.model_files.raw_model import FilePath, ModelFile, RawModel
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import DeadEnds

_INDEX, _ACTIONS = "index.json", "actions/choices/"
_FORMAT = 1
_UNNAMED = "default"
"""Identifier that Storm gives a reward model without a name."""

_WORD = 64  # bits
_BITS = {"bool": 1, "int": _WORD, "uint": _WORD, "double": _WORD, "rational": 2 * _WORD}
"""Supported types, with their default sizes in bits."""

_VALUES = {"bool": "<u8", "int": "<i8", "uint": "<u8", "double": "<f8"}
"""Types of variables, and numpy's types for the bits of their values."""

_REAL = {"type": "double", "size": 64}
_TRUTH = {"type": "bool", "size": 1}


@explained
def read_umb(
    path: FilePath, *, goal: str, cost: str | None = None, dead_ends: DeadEnds | None = None
) -> ModelFile:
    """Read a model from a UMB archive, plain or packed by gzip or xz.

    The cost of an outcome is the reward of its state, its choice and its branch, added as decimals.
    A state is the tuple of its variables' values if the archive has variables and these tuples are
    distinct, otherwise a number. Actions of goal states are dropped. A state with the label
    "deadlock" that no action leaves becomes a dead-end without actions. Other labels of states
    become ``state_labels``, except for names that reports use already.

    Args:
        path: the file; a Markov decision process or Markov chain in discrete time.
        goal: the label of the goal states.
        cost: name of a reward model, "" for one without a name; None: the only one, or 1 for each
            action if there is none.
        dead_ends: states from which no action reaches the goal, labels of them, or a predicate. Any
            other state without actions that is not a goal is then an error.

    Returns:
        The model and its initial states.

    Raises:
        ModelError: the model is of another kind or not valid; the error names the file, or the
            wrong state and action.
        OSError: the file cannot be read.
    """
    archive = UmbArchive(path)
    raw = archive.raw_model(cost)
    return raw_model.finished(raw._replace(states=archive.states()), goal, archive.path, dead_ends)


class UmbArchive:
    """The arrays of a UMB archive, each with its size checked.

    Sizes in the index are compared with the lengths of the files before memory is allocated, so
    that a damaged index cannot request more memory than the archive needs.
    """

    def __init__(self, path: FilePath) -> None:
        """Read the files of an archive, or raise :class:`ModelError`."""
        self.path = Path(path)
        with (
            raw_model.broken_files_named(self.path, "UMB archive"),
            tarfile.open(self.path) as archive,
        ):
            members = [member for member in archive if member.isfile()]
            opened = [(each.name, archive.extractfile(each)) for each in members]
            self._files = {name.removeprefix("./"): f.read() for name, f in opened if f is not None}
        try:
            self._index = json.loads(self._files.get(_INDEX, b"").decode())
        except (ValueError, RecursionError) as error:
            raise self._fault(f"its {_INDEX} is not JSON: {error}") from error
        if self._stated(self._index, "format-version", int) != _FORMAT:
            raise self._fault(f"its {_INDEX} is not of version {_FORMAT}")
        system = self._stated(self._index, "transition-system", dict)
        players = system.get("#players")
        if system.get("time") != "discrete" or players not in (0, 1):
            raise self._fault("only MDPs and DTMCs are supported")
        if system.get("#observations", 0) != 0:
            raise self._fault("models with observations are not supported")
        self._n_branches = self._size("branch-to-target.bin", 8)
        self._outcomes = self._offsets("choice-to-branches.bin", self._n_branches)
        self._n_choices = self._outcomes.size - 1
        self._pairs = self._offsets("state-to-choices.bin", self._n_choices)
        self._n_states = self._pairs.size - 1
        if not self._n_states:
            raise self._fault("there are no states")
        sizes = self._n_states, self._n_choices, self._n_branches
        for name, size in zip(("#states", "#choices", "#branches"), sizes, strict=True):
            if system.get(name, size) != size:
                stated = system[name]
                raise self._fault(f"the index says {stated} {name[1:]}, the files have {size}")
        self._probability = self._stated(system, "branch-probability-type", dict)

    def raw_model(self, cost: str | None, source: object = None) -> RawModel:
        """Return the model, whose states are numbers.

        Args:
            cost: name of the reward model that is the cost, as in :func:`read_umb`.
            source: name of the model in errors; None: the file.

        Raises:
            ModelError: no such cost, or an array that does not fit.
        """
        successors = self._array("branch-to-target.bin", "<u8", self._n_branches)
        if successors.max(initial=0) >= self._n_states:
            raise self._fault(f"there is no state {successors.max()}")
        described = self._annotations("rewards")
        names = [name for name, _, _ in described]
        rewards = [self._costs(key, each) for _, key, each in described]
        labels = {
            name: np.flatnonzero(self._bits(f"annotations/aps/{key}/states/values.bin"))
            for name, key, _ in self._annotations("aps")
        }
        initial = np.flatnonzero(self._bits("state-is-initial.bin"))
        return RawModel(
            pair_offsets=self._pairs,
            outcome_offsets=self._outcomes,
            successors=successors.astype(np.int64),
            probabilities=self._numbers(
                "branch-to-probability.bin", self._probability, self._n_branches
            ),
            **raw_model.costs_of_rewards(
                source or self.path, names, rewards, cost, self._n_branches
            ),
            actions=self._actions(),
            labels=labels | {raw_model.INITIAL: initial},
        )

    def states(self) -> Sequence[Hashable] | None:
        """Return the tuple of each state's variables, [states]; None if two tuples are equal."""
        names = list(zip(*self.variables().values(), strict=True))
        return names if len(set(names)) == self._n_states else None

    def variables(self) -> dict[str, list[Hashable]]:
        """Return the values of the variables in each state, by name, each [states].

        The result is empty if the archive describes no variables, several classes of states, an
        optional variable, or a variable that is neither a bool nor a number.

        Raises:
            ModelError: the values do not fit their description.
        """
        described = self._stated(self._index, "valuations", dict, {}).get("states", {})
        classes = self._stated(described, "classes", list, [])
        if len(classes) != 1:
            return {}
        name = "valuations/states/valuations.bin"
        width = len(self._files.get(name, b"")) // self._n_states
        rows = self._array(name, "u1", self._n_states * width).reshape(-1, width)
        bits = np.unpackbits(rows, axis=1, bitorder="little")
        columns, place = dict[str, list[Hashable]](), 0
        for part in self._stated(classes[0], "variables", list):
            if "padding" in part:
                place += self._stated(part, "padding", int)
                continue
            kind, size = self._type(self._stated(part, "type", dict))
            if part.get("is-optional") or kind not in _VALUES:
                return {}
            own = np.zeros((self._n_states, _WORD), dtype=np.uint8)
            if place + size > bits.shape[1]:
                raise self._fault("the values of variables are too short for their types")
            own[:, :size] = bits[:, place : place + size]
            if kind == "int":
                own[:, size:] = own[:, [size - 1]]  # the sign
            words = np.packbits(own, axis=1, bitorder="little").view(_VALUES[kind])[:, 0]
            offset = self._stated(part, "offset", int, 0)
            values = words.tolist() if kind == "double" else [v + offset for v in words.tolist()]
            variable = self._stated(part, "name", str)
            columns[variable] = [bool(v) for v in values] if kind == "bool" else values
            place += size
        return columns

    def _annotations(self, group: str) -> list[tuple[str, str, dict[str, Any]]]:
        """Return a group's annotations in the index as (name, key in the index, description)."""
        every = self._stated(self._index, "annotations", dict, {})
        found = []
        for key, described in self._stated(every, group, dict, {}).items():
            default = "" if group == "rewards" and key == _UNNAMED else key
            found.append((self._stated(described, "alias", str, default), key, described))
        return sorted(found, key=lambda each: each[:2])

    def _costs(self, key: str, described: dict[str, Any]) -> FloatArray:
        """Return the cost of each outcome: the rewards of its state, choice and branch."""
        kind, folder = self._stated(described, "type", dict), f"annotations/rewards/{key}"

        def given(entity: str, size: int) -> FloatArray:
            """Return the rewards of states, choices or branches, [size]; 0 without a file."""
            name = f"{folder}/{entity}/values.bin"
            return self._numbers(name, kind, size) if name in self._files else np.zeros(size)

        state = segment_ids(self._pairs)
        of_choice = raw_model.decimal_sum(
            given("choices", self._n_choices), given("states", self._n_states)[state]
        )
        of_branch = given("branches", self._n_branches)
        return raw_model.decimal_sum(of_choice[segment_ids(self._outcomes)], of_branch)

    def _actions(self) -> Sequence[str] | None:
        """Return the name of each pair's action, [pairs]; None if the archive has no names."""
        if f"{_ACTIONS}string-mapping.bin" not in self._files:
            return None
        text = self._files.get(f"{_ACTIONS}strings.bin", b"")
        ends = self._offsets(f"{_ACTIONS}string-mapping.bin", len(text)).tolist()
        with raw_model.broken_files_named(self.path, "UMB archive"):
            words = [text[a:b].decode() for a, b in pairwise(ends)]
        codes = np.zeros(self._n_choices, dtype=np.int64)
        if f"{_ACTIONS}values.bin" in self._files:
            codes = self._array(f"{_ACTIONS}values.bin", "<u4", self._n_choices).astype(np.int64)
        if codes.max(initial=0) >= len(words):
            raise self._fault(f"action code {codes.max()}, but the file lists {len(words)} actions")
        return raw_model.distinct_actions([words[code] for code in codes.tolist()], self._pairs)

    def _stated(self, place: Any, name: str, kind: type, *default: Any) -> Any:
        """Return an entry of the index; raise :class:`ModelError` if its type is not ``kind``.

        A missing entry is replaced by the default, if there is one.
        """
        value = place.get(name, *default) if isinstance(place, dict) else None
        if type(value) is not kind:
            raise self._fault(f"its {_INDEX} needs {name!r}, of type {kind.__name__}")
        return value

    def _type(self, described: dict[str, Any]) -> tuple[str, int]:
        """Return the name of a type and its size in bits."""
        kind = self._stated(described, "type", str)
        most = _BITS.get(kind, 0)
        size = self._stated(described, "size", int, most)
        if not 0 < size <= most or (kind in ("double", "rational") and size != most):
            raise self._fault(f"values of type {kind!r} with {size} bits are not supported")
        return kind, size

    def _numbers(self, name: str, described: dict[str, Any], size: int) -> FloatArray:
        """Return the real numbers in a file, [size]."""
        kind, _ = self._type(described)
        if kind == "double":
            return np.asarray(self._array(name, "<f8", size), dtype=np.float64)
        if kind != "rational":
            raise self._fault(f"{name} has numbers of type {kind!r}, not double or rational")
        halves = self._array(name, "<i8", 2 * size).reshape(-1, 2)
        above, below = halves[:, 0].tolist(), halves.view("<u8")[:, 1].tolist()
        if 0 in below:
            raise self._fault(f"{name} has a denominator of 0")
        return np.array([a / b for a, b in zip(above, below, strict=True)])

    def _bits(self, name: str) -> BoolArray:
        """Return the bools in a file, [states]; all False if the file is missing."""
        if name not in self._files:
            return np.zeros(self._n_states, dtype=np.bool_)
        words = self._array(name, "<u8", -(-self._n_states // 64))
        bits = np.unpackbits(words.view(np.uint8), bitorder="little", count=self._n_states)
        return bits.astype(np.bool_)

    def _offsets(self, name: str, n_targets: int) -> IntArray:
        """Return the offsets in a file: entry k has the targets offsets[k] .. offsets[k + 1] - 1.

        If the archive has no such file, each entry has one target.
        """
        if name not in self._files:
            return np.arange(n_targets + 1)
        offsets = self._array(name, "<i8", self._size(name, 8))
        if offsets.size < 1 or offsets[0] != 0 or offsets[-1] != n_targets:
            raise self._fault(f"{name} must run from 0 to {n_targets}")
        if (np.diff(offsets) < 0).any():
            raise self._fault(f"{name} must not decrease")
        return np.asarray(offsets, dtype=np.int64)

    def _size(self, name: str, width: int) -> int:
        """Return the number of entries in a file, each ``width`` bytes wide."""
        return len(self._files.get(name, b"")) // width

    def _array(self, name: str, kind: str, size: int) -> Any:
        """Return the entries of a file, [size]."""
        data, width = self._files.get(name, b""), np.dtype(kind).itemsize
        if len(data) != size * width:
            raise self._fault(f"{name} has {len(data)} bytes, not {size * width}")
        return np.frombuffer(data, dtype=kind)

    def _fault(self, complaint: str) -> ModelError:
        return ModelError(f"{self.path}: {complaint}")


@explained
def write_umb(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as a UMB archive, packed by gzip.

    States, costs and labels are those of :func:`ssp_lp.io.write_drn`.

    Args:
        model: the model.
        path: the file.
        start: the initial state.

    Raises:
        ModelError: the start is not a state, or a label cannot be written.
        OSError: the file cannot be written.
    """
    raw = raw_model.exported(model, start)
    n_states, named = raw.pair_offsets.size - 1, [*map(str, raw.actions or ())]
    actions = list(dict.fromkeys(named))
    code = {name: k for k, name in enumerate(actions)}
    aps = {name: members for name, members in raw.labels.items() if name != raw_model.INITIAL}
    files = {
        "state-to-choices.bin": _bytes_of(raw.pair_offsets, "<u8"),
        "state-is-initial.bin": _bit_set(raw.labels[raw_model.INITIAL], n_states),
        "choice-to-branches.bin": _bytes_of(raw.outcome_offsets, "<u8"),
        "branch-to-target.bin": _bytes_of(raw.successors, "<u8"),
        "branch-to-probability.bin": _bytes_of(raw.probabilities, "<f8"),
        f"{_ACTIONS}values.bin": _bytes_of([code[name] for name in named], "<u4"),
        f"{_ACTIONS}string-mapping.bin": _bytes_of(
            offsets_of(np.array([*map(len, actions)])), "<u8"
        ),
        f"{_ACTIONS}strings.bin": "".join(actions).encode(),  # words of ASCII
    }
    annotations: dict[str, dict[str, Any]] = {"aps": {}, "rewards": {}}
    for name, key in zip(aps, _identifiers(aps), strict=True):
        annotations["aps"][key] = {"alias": name, "applies-to": ["states"], "type": _TRUTH}
        files[f"annotations/aps/{key}/states/values.bin"] = _bit_set(aps[name], n_states)
    named_costs = raw_model.costs_of_pairs(raw)
    for (name, costs), key in zip(named_costs.items(), _identifiers(named_costs), strict=True):
        annotations["rewards"][key] = {"alias": name, "applies-to": ["choices"], "type": _REAL}
        files[f"annotations/rewards/{key}/choices/values.bin"] = _bytes_of(costs, "<f8")
    index = {
        "format-version": _FORMAT,
        "format-revision": 0,
        "file-data": {"tool": "ssp-lp"},
        "transition-system": {
            "time": "discrete",
            "#players": 1,
            "#states": n_states,
            "#initial-states": 1,
            "#choices": len(named),
            "#choice-actions": len(actions),
            "#branches": raw.successors.size,
            "#branch-actions": 0,
            "#observations": 0,
            "branch-probability-type": _REAL,
        },
        "annotations": annotations,
    }
    every = {_INDEX: json.dumps(index).encode(), **files}
    raw_model.write_tar(path, {name: BytesIO(data) for name, data in every.items()}, ".gz")


def _bytes_of(values: Any, kind: str) -> bytes:
    """Return numbers as the bytes of a file in a UMB archive."""
    return np.asarray(values).astype(kind).tobytes()


def _bit_set(members: IntArray, n_states: int) -> bytes:
    """Return a set of states as the bytes of a file in a UMB archive: one bit for each state."""
    bits = np.zeros(-(-n_states // _WORD) * _WORD, dtype=np.bool_)
    bits[members] = True
    return np.packbits(bits, bitorder="little").tobytes()


def _identifiers(names: Iterable[str]) -> list[str]:
    """Return a distinct identifier for each annotation's name, to name the annotation's files."""
    return raw_model.distinct_words([name.lower() for name in names], r"[^0-9a-z_-]+")
