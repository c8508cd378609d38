"""A rank's part of a model: the pairs of its own states, and the states to which these lead.

A part is a model in every respect that concerns one pair at a time: expected costs, successors, what
a limit counts. Its states are those that the rank knows: its own, then the ghosts, which have no
pairs here. Facts about the whole graph are found by all ranks together and kept with each part.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, offsets_of, read_only
from ssp_lp.distributed.ranks import Halo, Ranks
from ssp_lp.errors import ModelError, in_short
from ssp_lp.io.controller import controller_label
from ssp_lp.model import SSP
from ssp_lp.model.graph import Graph

_PROBES = 256  # states that are tried to see how many outcomes there are
_PIECE = 1 << 16  # states whose rows are made at a time
_READ = 1 << 22  # bytes of a file that are passed over at a time


class StateRows(NamedTuple):
    """Rows of some consecutive states, one state's pairs after the other's, as arrays."""

    actions: npt.ArrayLike  # [some states] number of pairs of each
    outcomes: npt.ArrayLike  # [their pairs] number of outcomes of each
    successors: npt.ArrayLike  # [their outcomes] numbers of states
    probabilities: npt.ArrayLike  # [their outcomes]
    costs: npt.ArrayLike  # one number for all, or [their pairs], or [their outcomes]
    named_costs: Mapping[str, npt.ArrayLike] = {}  # further ones by name, each as costs


Rows = Callable[[int, int], StateRows]
"""Makes the rows of the states first .. end - 1."""


class Described(NamedTuple):
    """What a model is made of besides its rows, the same on every rank."""

    n_states: int
    goal_states: npt.ArrayLike  # numbers of states
    states: Sequence[Hashable] | None = None  # labels; None: numbers
    state_labels: Mapping[str, Any] = {}  # names for sets of states, by their labels


class _Labels(Sequence[Hashable]):
    """Labels of some states of a model."""

    def __init__(self, numbers: IntArray, states: Sequence[Hashable]) -> None:
        """Keep the numbers of the states, and the labels of all states of the model."""
        self._numbers, self._states = numbers, states

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, place: Any) -> Any:
        return self._states[int(self._numbers[place])]


@dataclass(frozen=True, eq=False, repr=False)
class Part(SSP):
    """The states of a model that a rank knows, and the pairs of its own."""

    halo: Halo = field(kw_only=True)  # over the states of the model
    described: Described = field(kw_only=True)
    facts: dict[str, Any] = field(kw_only=True, default_factory=dict)  # of the whole graph
    wanted: set[int] = field(kw_only=True, default_factory=set)
    """Numbers of states that were asked for by their labels and are not known here."""

    @property
    def kept_facts(self) -> dict[str, Any]:  # type: ignore[override]
        """Facts about the graph of which the part is one, for the states known here."""
        return self.facts

    @property
    def predecessors(self) -> Any:
        """Refused: other ranks' pairs lead to states of this part, too.

        Raises:
            ModelError: always.
        """
        raise ModelError("this question needs the whole graph of the model: solve it with "
                         "ssp_lp.solve on a model held whole")  # fmt: skip

    @property
    def graph(self) -> Graph:
        """The part as a graph of its own, made for one search."""
        return Graph(self.pair_offsets, self.outcome_offsets, self.successors, self.probabilities)

    @property
    def own(self) -> BoolArray:
        """States of the part that are the rank's own, [states]."""
        return np.arange(self.n_states) < self.halo.n_own

    def of_all_states(self, made: FloatArray) -> FloatArray:
        """What was made of each own state's pairs, for all states of the part, [states]."""
        return self.halo.filled(made)

    @cached_property
    def _numbers_by_label(self) -> Mapping[Hashable, int]:
        """Number in the model of each label."""
        return {label: k for k, label in enumerate(self.described.states or ())}

    def find(self, state: Hashable) -> int | None:
        """Place in the part of the state with this label; None: the model has none.

        A state that the part does not know is noted as wanted, and any place is returned.
        """
        n_states, labels = self.described.n_states, self.described.states
        try:
            if labels is not None:
                number = self._numbers_by_label.get(state)
            else:
                is_number = isinstance(state, (int, np.integer)) and 0 <= int(state) < n_states
                number = int(state) if is_number else None  # type: ignore[call-overload]
        except TypeError:  # a list, say
            return None
        if number is None:
            return None
        if (place := self.place_of(number)) < 0:
            self.wanted.add(number)
        return max(place, 0)

    def hint(self, state: Hashable) -> str:
        """Clause for errors: what may be meant by what is no state of the model."""
        return f": there are {self.described.n_states:,} states" + (
            f", 0 .. {self.described.n_states - 1}" if self.described.states is None else ""
        )

    def place_of(self, number: int) -> int:
        """Place in the part of the state with this number in the model; -1: it is not known."""
        if self.halo.first <= number < self.halo.end:
            return number - self.halo.first
        found = np.flatnonzero(self.halo.ghosts == number)
        return self.halo.n_own + int(found[0]) if found.size else -1

    def knowing(self, numbers: Iterable[int]) -> Part:
        """Return the part with further states of other ranks as ghosts; all ranks ask together."""
        more = [k for k in dict.fromkeys(numbers) if self.place_of(k) < 0]
        halo, ends = self.halo, np.full(len(more), self.n_pairs, dtype=np.int64)
        halo = Halo(halo.ranks, halo.n_own, np.append(halo.ghosts, np.array(more, dtype=np.int64)))
        members = _labelled(self.described, halo.numbers)
        kept = {one.name: getattr(self, one.name) for one in fields(SSP)}
        return Part(**kept | {
            "pair_offsets": read_only(np.append(self.pair_offsets, ends)),
            "goal_mask": read_only(halo.filled(self.goal_mask)),
            "states": _states(self.described, halo.numbers),
            "state_labels": members,
        }, halo=halo, described=self.described,
           facts={name: read_only(halo.filled(fact)) for name, fact in self.facts.items()})  # fmt: skip


def _states(described: Described, numbers: IntArray) -> Sequence[Hashable]:
    """Labels of states of a part by their numbers in the model."""
    labels = described.states
    return _Labels(numbers, range(described.n_states) if labels is None else labels)


def _labelled(described: Described, numbers: IntArray) -> dict[str, IntArray]:
    """Places of the known members of each set of states that has a name."""
    places = {name: np.isin(numbers, members) for name, members in described.state_labels.items()}
    return {name: read_only(np.flatnonzero(mask)) for name, mask in places.items()}


def made_part(
    ranks: Ranks,
    rows: Rows,
    described: Described,
    bounds: tuple[int, int],
    most_at_once: int = _PIECE,
) -> Part:
    """Make each rank's part, with the facts about the whole graph; all ranks make theirs together.

    Args:
        ranks: all of them.
        rows: makes the rows of some states.
        described: what else there is.
        bounds: number of the first of the own states, and of the state behind the last.
        most_at_once: states whose rows are made at a time.

    Raises:
        ModelError: naming the state and the action at fault, on every rank.
    """
    arrays, ghosts = ranks.agreed(lambda: _own_arrays(rows, described, *bounds, most_at_once))
    n_own = bounds[1] - bounds[0]
    numbers = np.append(np.arange(*bounds), ghosts)

    def checked() -> SSP:
        """Return the part as a model; one that is wrong is made anew, for names in the error."""
        try:
            return SSP.from_arrays(**arrays)
        except ModelError:
            return SSP.from_arrays(**arrays, states=[*_states(described, numbers)])

    plain = ranks.agreed(checked)
    halo = Halo(ranks, n_own, ghosts)
    kept = {one.name: getattr(plain, one.name) for one in fields(SSP)}
    kept |= {"states": _states(described, numbers), "state_labels": _labelled(described, numbers)}
    part = Part(**kept, halo=halo, described=described)
    graph, goal = part.graph, part.goal_mask
    every = np.ones(part.n_pairs, dtype=np.bool_)
    part.facts["hopeless_states"] = read_only(~halo.reaching(graph, goal))
    part.facts["attention_states"] = read_only(halo.staying(graph, every, goal))
    del graph
    # an end of each name is known to all, so that all agree whether an episode ends in it
    lost, ends = part.facts["hopeless_states"], list[int]()
    for members in part.state_labels.values():
        own = members[(members < n_own) & lost[members]]
        least = float(halo.first + own[0]) if own.size else np.inf
        if np.isfinite(least := -float(ranks.greatest(-least))):
            ends.append(int(least))
    return part.knowing(ends)


def _own_arrays(
    rows: Rows, described: Described, first: int, end: int, most_at_once: int
) -> tuple[dict[str, Any], IntArray]:
    """Arrays of a part for ``SSP.from_arrays``, and the numbers of its ghosts."""
    pieces, named = list[StateRows](), set[str]()
    for k in range(first, max(end, first + 1), most_at_once):
        last = min(k + most_at_once, end)
        piece = _checked_rows(rows, k, last)
        if pieces and {*piece.named_costs} != named:
            raise ModelError(f"rows({k}, {last}) has the named costs {sorted(piece.named_costs)}, "
                             f"those before have {sorted(named)}")  # fmt: skip
        named = {*piece.named_costs}
        pieces.append(piece)
    actions, outcomes, successors, probabilities = (
        np.concatenate(part) for part in list(zip(*pieces, strict=True))[:4]
    )
    costs = [piece.costs for piece in pieces]
    every = {"": costs, **{name: [piece.named_costs[name] for piece in pieces] for name in named}}
    paid = {name: _joined(given, pieces) for name, given in every.items()}
    del pieces, costs, every
    inside = (successors >= 0) & (successors < described.n_states)
    remote = inside & ((successors < first) | (successors >= end))
    goals = np.unique(np.asarray(described.goal_states).reshape(-1))
    known_goal = goals[:1][(goals[:1] < first) | (goals[:1] >= end)]  # else a part may have none
    ghosts = np.union1d(np.unique(successors[remote]), known_goal).astype(np.int64)
    n_own = end - first
    places = np.where(inside, successors - first, -1)  # what is no state is named later
    places[remote] = n_own + np.searchsorted(ghosts, successors[remote])
    numbers = np.append(np.arange(first, end), ghosts)
    counts = np.append(actions, np.zeros(len(ghosts), dtype=np.int64))
    arrays = {
        "pair_offsets": offsets_of(counts),
        "outcome_offsets": offsets_of(outcomes),
        "successors": places.astype(np.int32),
        "probabilities": probabilities,
        "costs": paid.pop(""),
        "named_costs": {name: paid[name] for name in sorted(named)},
        "goal_states": np.flatnonzero(np.isin(numbers, goals)),
        "treat_actionless_as_dead_ends": True,
    }
    return arrays, ghosts


def _joined(given: Sequence[Any], pieces: Sequence[StateRows]) -> npt.NDArray[Any]:
    """Costs of all pieces, [outcomes]; one number for all stays one."""
    parts = [np.asarray(paid, dtype=np.float64) for paid in given]
    if all(part.ndim == 0 and part == parts[0] for part in parts):
        return parts[0]
    full = []
    for part, piece in zip(parts, pieces, strict=True):
        outcomes = np.asarray(piece.outcomes)
        by_pair = np.broadcast_to(part, outcomes.shape) if part.ndim == 0 else part
        full.append(np.repeat(by_pair, outcomes) if len(by_pair) == len(outcomes) else by_pair)
    return np.concatenate(full)


def _checked_rows(rows: Rows, first: int, end: int) -> StateRows:
    """Return the rows of some states as arrays whose kinds and lengths fit.

    Raises:
        ModelError: naming the call and the array at fault.
    """
    made, call = rows(first, end), f"rows({first}, {end})"
    if not isinstance(made, StateRows):
        raise ModelError(f"{call} must be StateRows, not {in_short(made)}")
    if not isinstance(made.named_costs, Mapping):
        raise ModelError(f"{call}: named_costs must be costs by name, not "
                         f"{in_short(made.named_costs)}")  # fmt: skip
    arrays: dict[str, Any] = {name: np.asarray(getattr(made, name)) for name in made._fields[:4]}
    for name, array in arrays.items():
        kinds, kind = ("iuf", "numbers") if name == "probabilities" else ("iu", "whole numbers")
        if array.ndim != 1 or (array.size and array.dtype.kind not in kinds):
            raise ModelError(f"{call}: {name} must be one row of {kind}, not {in_short(array)} "
                             f"of {array.dtype}")  # fmt: skip
        if name != "probabilities" and array.dtype.kind != "i":  # numpy takes [] for floats
            arrays[name] = array.astype(np.int64)
        if name in ("actions", "outcomes") and (array < 0).any():
            raise ModelError(f"{call}: {name} must be >= 0")
    pairs, outcomes = int(arrays["actions"].sum()), int(arrays["outcomes"].sum())
    lengths = (end - first, "a state"), (pairs, "a pair"), *((outcomes, "an outcome"),) * 2
    for (name, array), (size, each) in zip(arrays.items(), lengths, strict=True):
        if array.size != size:
            raise ModelError(f"{call}: {name} must have length {size}, one {each}, not "
                             f"{array.size}")  # fmt: skip
    costs = {f"cost {name!r}": paid for name, paid in made.named_costs.items()}
    for name, paid in {"costs": made.costs, **costs}.items():
        try:
            shape = np.asarray(paid, dtype=np.float64).shape
        except (TypeError, ValueError) as error:
            raise ModelError(f"{call}: {name} must be numbers, not {in_short(paid)}") from error
        if shape not in ((), (pairs,), (outcomes,)):
            raise ModelError(f"{call}: {name} must be one number, {pairs} (one a pair) or "
                             f"{outcomes} (one an outcome), not of shape {shape}")  # fmt: skip
    return made._replace(**arrays)


def balanced_bounds(ranks: Ranks, rows: Rows, n_states: int) -> tuple[int, int]:
    """Return the own states, first and end, by which all ranks have about as many outcomes.

    Some states are tried, each rank its share of them.

    Raises:
        ModelError: as of the rows that are tried, on every rank.
    """
    rank, size = ranks.comm.rank, ranks.comm.size
    probes = np.unique(np.linspace(0, n_states, _PROBES, endpoint=False).astype(np.int64))
    probes = probes if size > 1 else probes[:1]  # one rank has all
    mine = probes[rank::size].tolist()
    tried = ranks.agreed(lambda: [np.sum(_checked_rows(rows, k, k + 1).outcomes) for k in mine])
    outcomes = np.zeros(len(probes))
    outcomes[rank::size] = tried
    work = (1.0 + ranks.total(outcomes)) * np.diff(np.append(probes, n_states))
    return _share(ranks, np.append(0.0, np.cumsum(work)), np.append(probes, n_states))


def _share(ranks: Ranks, work: FloatArray, states: IntArray) -> tuple[int, int]:
    """Return the rank's own states, by the work up to some states, [some states] each."""
    wanted = work[-1] * np.linspace(0.0, 1.0, ranks.comm.size + 1)
    bounds = np.interp(wanted, work, states).astype(np.int64)
    bounds[0], bounds[-1] = 0, states[-1]
    return int(bounds[ranks.comm.rank]), int(bounds[ranks.comm.rank + 1])


class ModelFile:
    """A model in the library's own file, of which each rank reads its part."""

    def __init__(self, path: str | Path) -> None:
        """Read what the file says besides rows.

        Raises:
            ModelError: naming the file: it is none of this format, or damaged.
            OSError: the file cannot be opened.
        """
        self._path = Path(path)
        texts = json.loads(self._read("header").tobytes())
        if texts.get("format") != "ssp-lp model":
            raise ModelError(f"{path} is no ssp-lp model file: it says {in_short(texts)}")
        self._named = texts["named_costs"]
        ends, members = self._read("label_offsets"), self._read("label_members")
        states = texts["states"]
        labels = {name: members[ends[k] : ends[k + 1]] for k, name in enumerate(texts["state_labels"])}
        self.n_states = self._length("pair_offsets") - 1
        self.described = Described(
            self.n_states,
            self._read("goal_states"),
            None if states is None else [controller_label(label) for label in states],
            labels,
        )

    def bounds(self, ranks: Ranks) -> tuple[int, int]:
        """Return the own states, first and end, by which all ranks have about as many pairs."""
        step = max(self.n_states // (_PROBES * ranks.comm.size), 1)
        states = np.append(np.arange(0, self.n_states, step), self.n_states)
        some, last = self._read("pair_offsets", step=step), self._read("pair_offsets", self.n_states)
        return _share(ranks, np.append(some[: len(states) - 1], last), states)

    def rows(self, first: int, end: int) -> StateRows:
        """Return the rows of some states; what stands before them in the file is passed over."""
        pairs = self._read("pair_offsets", first, end + 1)
        outcomes = self._read("outcome_offsets", int(pairs[0]), int(pairs[-1]) + 1)
        own = int(outcomes[0]), int(outcomes[-1])
        uniform = self._length("costs") == 1
        return StateRows(
            np.diff(pairs),
            np.diff(outcomes),
            self._read("successors", *own),
            self._read("probabilities", *own),
            self._read("costs")[0] if uniform else self._read("costs", *own),
            {name: self._read(f"costs {k}", *own) for k, name in enumerate(self._named)},
        )

    @contextmanager
    def _opened(self, name: str) -> Iterator[tuple[Any, int, Any]]:
        """Open an array of the file: where its entries begin, how many there are, and their type.

        Raises:
            ModelError: naming the file: it is none of this format, or damaged.
        """
        try:
            with zipfile.ZipFile(self._path) as archive, archive.open(f"{name}.npy") as file:
                version = np.lib.format.read_magic(file)
                first = version == (1, 0)
                headers = np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0
                shape, _, kind = headers[not first](file)
                if len(shape) != 1 or kind.hasobject:
                    raise ValueError(f"the array {name} has another type or size than it should")
                yield file, shape[0], kind
        except (zipfile.BadZipFile, zlib.error, LookupError, ValueError, TypeError, EOFError) as error:
            raise ModelError(f"{self._path} is no ssp-lp model file, or damaged: {error!r}") from error

    def _length(self, name: str) -> int:
        """Return the length of an array in the file."""
        with self._opened(name) as (_, length, _):
            return length

    def _read(
        self, name: str, begin: int = 0, end: int | None = None, step: int = 1
    ) -> npt.NDArray[Any]:
        """Return some entries of an array in the file, which is read piece by piece."""
        with self._opened(name) as (file, length, kind):
            end, at, found = length if end is None else min(end, length), 0, []
            while at < end:
                count = min(_READ // kind.itemsize, (begin if at < begin else end) - at)
                piece = np.frombuffer(file.read(count * kind.itemsize), dtype=kind)
                if len(piece) < count:
                    raise EOFError(f"the array {name} ends early")
                if at >= begin:
                    found.append(piece[(begin - at) % step :: step])
                at += count
            native = kind.newbyteorder("=")
            return np.concatenate([np.zeros(0, native), *found]).astype(native, copy=False)
