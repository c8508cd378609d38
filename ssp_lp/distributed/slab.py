"""A rank's part of a model: all of its states, and the pairs of the rank's own alone.

A slab is a model in every respect that concerns one pair at a time: its expected costs, where it
leads, what it counts in a limit. What concerns a whole graph is found by all ranks together
(``graph_sweeps``) and is the same on each: which states have lost the goal, and where it can be
avoided.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, entries_of, offsets_of, read_only
from ssp_lp.distributed.graph_sweeps import on_any, reaching, staying
from ssp_lp.errors import ModelError, in_short
from ssp_lp.io.archives import load_model
from ssp_lp.io.controller import controller_label
from ssp_lp.model import SSP
from ssp_lp.model.graph import Graph, end_components, hopeless_states, pairs_into

_PROBES = 256  # states that are tried to see how many outcomes there are
_PIECE = 1 << 16  # states whose rows are made at a time
_MIXER, _HALF = np.uint64(0x9E3779B97F4A7C15), 32  # an odd number of bits as if drawn
_READ = 1 << 22  # bytes of a file that are passed over at a time


class StateRows(NamedTuple):
    """Rows of some states in a row, one state's pairs after the other's, as arrays."""

    actions: npt.ArrayLike  # [some states] number of pairs of each
    outcomes: npt.ArrayLike  # [their pairs] number of outcomes of each
    successors: npt.ArrayLike  # [their outcomes] numbers of states
    probabilities: npt.ArrayLike  # [their outcomes]
    costs: npt.ArrayLike  # one number for all, or [their pairs], or [their outcomes]
    named_costs: Mapping[str, npt.ArrayLike] = {}  # further ones by name, each as costs


@dataclass(frozen=True, eq=False, repr=False)
class Slab(SSP):
    """The states of a model, and the pairs of a rank's own."""

    comm: Any = field(kw_only=True)  # of mpi4py
    first: int = field(kw_only=True)  # number of the first of the own states
    end: int = field(kw_only=True)  # number of the state behind the last of them
    facts: dict[str, Any] = field(kw_only=True, default_factory=dict)  # of the whole graph

    @property
    def own(self) -> slice:
        """The states of the slab that have their pairs in it."""
        return slice(self.first, self.end)

    @property
    def own_mask(self) -> BoolArray:
        """States of the slab that have their pairs in it, [states]."""
        mask = np.zeros(self.n_states, dtype=np.bool_)
        mask[self.own] = True
        return mask

    @property
    def kept_facts(self) -> dict[str, Any]:
        """Facts about the graph of which the slab is a part, kept by all its copies."""
        return self.facts

    @property
    def predecessors(self) -> Any:
        """Refused: a rank does not know all that leads to a state of its slab.

        Raises:
            ModelError: always.
        """
        raise ModelError("this asks for the whole graph of a model, of which a rank has a part")

    @property
    def graph(self) -> Graph:
        """The slab as a graph of its own, made for one search."""
        return Graph(self.pair_offsets, self.outcome_offsets, self.successors, self.probabilities)

    def of_all_states(self, made: FloatArray) -> FloatArray:
        """What was made of each state's own pairs on all slabs, for all states, [states]."""
        return np.concatenate(self.comm.allgather(made[self.own]))

    def in_all_parts(self, numbers: FloatArray) -> FloatArray:
        """Distinct numbers that were found in any slab, increasing."""
        return np.unique(np.concatenate(self.comm.allgather(numbers)))

    def staying_free(self, free: BoolArray) -> BoolArray:
        """States of the slabs' end components of free pairs, dead-ends left out, [states].

        What moves among states from which one may stay free for ever is gathered on every rank.

        Args:
            free: pairs that cost nothing in what is asked, [pairs].
        """
        graph, own, ended = self.graph, self.own_mask, self.goal_mask | hopeless_states(self)
        acting = self.of_all_states(np.diff(self.pair_offsets).astype(np.float64)) > 0.0
        told = partial(on_any, self.comm)
        kept = staying(self.comm, told, graph, own, free, ended | ~acting)
        if not kept.any():
            return kept
        inside = np.flatnonzero(free & kept[self.pair_state] & ~pairs_into(graph, ~kept))
        entries, lengths = entries_of(self.outcome_offsets, inside)
        moves = self.successors[entries], self.probabilities[entries]
        parts = self.comm.allgather((self.pair_state[inside], lengths, *moves))
        home, lengths, successors, chances = (
            np.concatenate(part) for part in zip(*parts, strict=True)
        )
        counts = np.bincount(home, minlength=self.n_states)
        among = Graph(offsets_of(counts), offsets_of(lengths), successors, chances)
        return end_components(among, np.ones(len(home), dtype=np.bool_))[0] >= 0


def tried_states(
    comm: Any, rows: Callable[[int, int], StateRows], n_states: int
) -> dict[int, float]:
    """Outcomes of some states of a slab's model, by their numbers; each rank tries its share."""
    count = _PROBES if comm.size > 1 else 1  # one rank has all
    probes = np.unique(np.linspace(0, n_states, count, endpoint=False).astype(np.int64))
    own = probes[comm.rank :: comm.size].tolist()
    return {k: 1.0 + float(np.sum(_checked_rows(rows, k, k + 1).outcomes)) for k in own}


def _checked_rows(rows: Callable[[int, int], StateRows], first: int, end: int) -> StateRows:
    """The rows of some of a slab's states, as arrays whose lengths fit.

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
        if not array.size:  # which numpy takes for floats
            arrays[name] = array.astype(np.int32)
    for name in ("actions", "outcomes"):
        if (arrays[name] < 0).any():
            raise ModelError(f"{call}: {name} must be >= 0")
    pairs, outcomes = int(arrays["actions"].sum()), int(arrays["outcomes"].sum())
    wanted = {"actions": (end - first, "one a state"), "outcomes": (pairs, "one a pair"),
              "successors": (outcomes, "one an outcome"),
              "probabilities": (outcomes, "one an outcome")}  # fmt: skip
    for name, (size, why) in wanted.items():
        if arrays[name].size != size:
            raise ModelError(f"{call}: {name} must have length {size}, {why}, not "
                             f"{arrays[name].size}")  # fmt: skip
    costs = {"costs": made.costs} | {
        f"cost {name!r}": paid for name, paid in made.named_costs.items()
    }
    for name, paid in costs.items():
        try:
            shape = np.asarray(paid, dtype=np.float64).shape
        except (TypeError, ValueError) as error:
            raise ModelError(f"{call}: {name} must be numbers, not {in_short(paid)}") from error
        if shape not in ((), (pairs,), (outcomes,)):
            raise ModelError(f"{call}: {name} must be one number, {pairs} (one a pair) or "
                             f"{outcomes} (one an outcome), not of shape {shape}")  # fmt: skip
    most = max(arrays["successors"].max(initial=0), -arrays["successors"].min(initial=0))
    if most <= np.iinfo(np.int32).max:  # else some are no states, which is found later
        arrays["successors"] = arrays["successors"].astype(np.int32, copy=False)
    return made._replace(**arrays)


def balanced_states(comm: Any, tried: Mapping[int, float], n_states: int) -> tuple[int, int]:
    """The own states of a slab, first and end, so that all ranks have about as many outcomes.

    Args:
        comm: of mpi4py.
        tried: what all ranks have made of :func:`tried_states`.
        n_states: of the model.
    """
    probes = sorted(tried)
    states = np.append(np.array(probes), n_states)
    work = np.array([tried[k] for k in probes]) * np.diff(states)
    return _share_of(comm, np.append(0.0, np.cumsum(work)), states)


def part_by_rows(
    rows: Callable[[int, int], StateRows],
    first: int,
    end: int,
    n_states: int,
    goal_states: npt.ArrayLike,
    states: Sequence[Hashable] | None = None,
    state_labels: Mapping[str, Any] | None = None,
) -> SSP:
    """A slab's rows, made piece by piece, as a model in which other states have no pairs.

    Args:
        rows: the rows of the states first .. end - 1.
        first: number of the first of the own states.
        end: number of the state behind the last of them.
        n_states: of the model.
        goal_states: numbers of the goal states.
        states: labels of all states; None: their numbers.
        state_labels: names for sets of states.

    Raises:
        ModelError: naming the state and the action at fault.
    """
    parts: dict[str, list[npt.NDArray[Any]]] = {}
    named: Mapping[str, npt.ArrayLike] = {}
    for k in range(first, max(end, first + 1), _PIECE):
        last = min(k + _PIECE, end)
        piece = _checked_rows(rows, k, last)
        if parts and {*piece.named_costs} != {*named}:
            raise ModelError(f"rows({k}, {last}) has the named costs {sorted(piece.named_costs)}, "
                             f"those before have {sorted(named)}")  # fmt: skip
        named = piece.named_costs
        outcomes = np.asarray(piece.outcomes)
        costs = {"costs": piece.costs}
        costs |= {f"costs {name}": paid for name, paid in piece.named_costs.items()}
        for name in ("actions", "outcomes", "successors", "probabilities"):
            parts.setdefault(name, []).append(np.asarray(getattr(piece, name)))
        for name, paid in costs.items():
            numbers = np.asarray(paid, dtype=np.float64)
            by_pair = numbers.shape == outcomes.shape
            parts.setdefault(name, []).append(np.repeat(numbers, outcomes) if by_pair else numbers)
        del piece, costs
    sizes = [int(outcomes.sum()) for outcomes in parts["outcomes"]]

    def joined(name: str) -> npt.NDArray[Any]:
        """An array of all pieces, which are let go; one number for all stays one."""
        own = parts.pop(name)
        if len(own) == 1 or all(part.ndim == 0 and part == own[0] for part in own):
            return own[0]
        filled = zip(own, sizes, strict=True)
        return np.concatenate([np.full(n, part) if part.ndim == 0 else part for part, n in filled])

    counts = np.zeros(n_states, dtype=np.int64)
    counts[first:end] = joined("actions")
    chances, successors = joined("probabilities"), joined("successors")
    return SSP.from_arrays(
        pair_offsets=offsets_of(counts),
        outcome_offsets=offsets_of(joined("outcomes")),
        successors=successors,
        probabilities=chances,
        costs=joined("costs"),
        named_costs={name.removeprefix("costs "): joined(name) for name in [*parts]},
        goal_states=goal_states,
        states=states,
        state_labels=state_labels,
        treat_actionless_as_dead_ends=True,
    )


def _share_of(comm: Any, work: FloatArray | IntArray, states: IntArray) -> tuple[int, int]:
    """The own states of a slab, by the work that is done up to some states, [some states] each."""
    wanted = work[-1] * np.array([comm.rank, comm.rank + 1]) / comm.size
    first, end = np.interp(wanted, work, states).astype(np.int64).tolist()
    return (0 if comm.rank == 0 else first), (int(states[-1]) if wanted[1] >= work[-1] else end)


def with_facts(comm: Any, part: SSP, first: int, end: int) -> Slab:
    """A model of a rank's own rows as a slab, with what sweeps find of the whole graph.

    All ranks make theirs at the same time.
    """
    own = {one.name: getattr(part, one.name) for one in fields(SSP)}
    slab = Slab(**own, comm=comm, first=first, end=end)
    graph, goal = slab.graph, slab.goal_mask
    every = np.ones(slab.n_pairs, dtype=np.bool_)
    told = partial(on_any, comm)
    hopeless = ~reaching(comm, told, graph, goal)
    attention = staying(comm, told, graph, slab.own_mask, every, goal)
    slab.facts.update(hopeless_states=read_only(hopeless), attention_states=read_only(attention))
    return slab


def rows_checksum(slab: Slab) -> int:
    """A checksum of all slabs' rows and costs, the same on any number of ranks; all ask together.

    Returns:
        The sum modulo 2^64 of mixed words, one of each outcome: its state, its place among the
        state's pairs and outcomes, where it leads, its probability and its costs.
    """
    total, named = 0, [slab.named_costs[name] for name in sorted(slab.named_costs)]
    for first in range(slab.first, slab.end, _PIECE):
        states = np.arange(first, min(first + _PIECE, slab.end) + 1)
        pairs = np.arange(*slab.pair_offsets[states[[0, -1]]].tolist())
        home = np.repeat(states[:-1], np.diff(slab.pair_offsets[states]))
        lengths = np.diff(slab.outcome_offsets)[pairs]
        own = slice(*slab.outcome_offsets[slab.pair_offsets[states[[0, -1]]]].tolist())
        begins = slab.outcome_offsets[slab.pair_offsets[home]]
        words = np.zeros(own.stop - own.start, dtype=np.uint64)
        for one in (
            np.repeat(home, lengths),
            np.repeat(pairs - slab.pair_offsets[home], lengths),
            np.arange(own.start, own.stop) - np.repeat(begins, lengths),
            slab.successors[own].astype(np.int64),
            *(part[own] for part in (slab.probabilities, slab.costs, *named)),
        ):
            words = (words ^ np.ascontiguousarray(one).view(np.uint64)) * _MIXER
            words ^= words >> np.uint64(_HALF)
        total += int(words.sum(dtype=np.uint64))
    return int(sum(slab.comm.allgather(total)) % 2**64)


def part_of_model(comm: Any, model: SSP) -> tuple[SSP, int, int]:
    """A slab's rows of a model that every rank has, with the own states' first and end."""
    first, end = _share_of(comm, model.pair_offsets, np.arange(model.n_states + 1))
    a, b = model.pair_offsets[[first, end]].tolist()
    own = slice(*model.outcome_offsets[[a, b]].tolist())
    plain = {one.name: getattr(model, one.name) for one in fields(SSP)}
    part = SSP(**plain | {
        "pair_offsets": np.clip(model.pair_offsets, a, b) - a,
        "outcome_offsets": model.outcome_offsets[a : b + 1] - own.start,
        "pair_action": model.pair_action[a:b],
        "named_costs": {name: costs[own] for name, costs in model.named_costs.items()},
        **{name: getattr(model, name)[own] for name in ("successors", "probabilities", "costs")},
    })  # fmt: skip
    return part, first, end


def part_in_file(comm: Any, path: str | Path) -> tuple[SSP, int, int]:
    """A slab's rows of a model in the library's own file, with the own states' first and end.

    Args:
        comm: of mpi4py.
        path: as ``save_model`` wrote it.

    Raises:
        ModelError: naming the file: it is none of this format, or what it says makes no model.
        OSError: the file cannot be opened.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return _part_in_archive(comm, archive)
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError) as error:
        load_model(path)  # says what is wrong
        raise ModelError(f"{path} is damaged: {error!r}") from error


def _part_in_archive(comm: Any, archive: zipfile.ZipFile) -> tuple[SSP, int, int]:
    """A slab's rows of a model that an archive's texts and arrays state."""
    texts = json.loads(_part(archive, "header").tobytes())
    if texts.get("format") != "ssp-lp model":
        raise ValueError("no model")
    pair_offsets = _part(archive, "pair_offsets")
    n_states = len(pair_offsets) - 1
    first, end = _share_of(comm, pair_offsets, np.arange(n_states + 1))
    a, b = pair_offsets[[first, end]].tolist()
    outcome_offsets = _part(archive, "outcome_offsets", a, b + 1)
    own = outcome_offsets[[0, -1]].tolist()
    labels, costs = _part(archive, "label_offsets"), _part(archive, "costs", 0, 2)
    uniform, names = len(costs) == 1, texts["named_costs"]
    states, actions = (
        None if texts[name] is None else [controller_label(part) for part in texts[name]]
        for name in ("states", "actions")
    )
    members = _part(archive, "label_members")
    labelled: dict[str, Any] = {
        name: members[labels[k] : labels[k + 1]] for k, name in enumerate(texts["state_labels"])
    }
    if states is not None:
        labelled = {name: [states[k] for k in found.tolist()] for name, found in labelled.items()}
    made = SSP.from_arrays(
        pair_offsets=np.clip(pair_offsets, a, b) - a,
        outcome_offsets=outcome_offsets - own[0],
        successors=_part(archive, "successors", *own),
        probabilities=_part(archive, "probabilities", *own),
        costs=costs[0] if uniform else _part(archive, "costs", *own),
        named_costs={name: _part(archive, f"costs {k}", *own) for k, name in enumerate(names)},
        goal_states=_part(archive, "goal_states"),
        states=states,
        actions=None if actions is None else [
            actions[k] for k in _part(archive, "pair_action", a, b).tolist()
        ],
        state_labels=labelled,
        treat_actionless_as_dead_ends=True,
    )  # fmt: skip
    chances = read_only(_part(archive, "probabilities", *own))  # not rounded again
    return replace(made, probabilities=chances), first, end


def _part(
    archive: zipfile.ZipFile, name: str, begin: int = 0, end: int | None = None
) -> npt.NDArray[Any]:
    """Some entries of a slab's array in an archive; what stands before is passed over."""
    with archive.open(f"{name}.npy") as file:
        version = np.lib.format.read_magic(file)
        read = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else (np.lib.format.read_array_header_2_0)
        )
        shape, _, kind = read(file)
        if len(shape) != 1 or kind.hasobject:
            raise ValueError(f"the array {name} has another type or size than it should")
        end = shape[0] if end is None else min(end, shape[0])
        for some in _lengths(begin * kind.itemsize):
            file.read(some)
        found = np.empty(max(end - begin, 0), dtype=kind)
        view, at = found.view(np.uint8), 0
        for some in _lengths(found.nbytes):
            view[at : at + some] = np.frombuffer(file.read(some), dtype=np.uint8)
            at += some
    return found.astype(kind.newbyteorder("="), copy=False)


def _lengths(size: int) -> list[int]:
    """Lengths of the pieces in which so many bytes of a slab's file are read."""
    return [min(_READ, size - k) for k in range(0, size, _READ)]
