"""A rank's part of a model: the pairs of its own states, and the states to which these pairs lead.

A rank is a process of MPI. Its part acts as a model for everything that concerns single pairs:
expected costs, successors, coefficients of a limit. The states of a part are the rank's own states,
followed by the ghosts: states of other ranks to which its pairs lead, and which have no pairs here.
The label of a state is its number in the whole model. Facts about the whole graph, such as its
dead-ends, are computed by all ranks together and stored in each part.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, fields_of, offsets_of, read_only
from ssp_lp.distributed.ranks import Halo, Ranks
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import Graph
from ssp_lp.model.state_rows import Rows, checked_rows

_MIXER, _HALF = np.uint64(0x9E3779B97F4A7C15), np.uint64(32)  # odd, pseudo-random
_PROBES, _STATES = 128, 64  # samples, and most states of each, to estimate numbers of outcomes


@dataclass(frozen=True, eq=False, repr=False)
class Part(SSP):
    """The states of a model that a rank knows, and the pairs of the rank's own states."""

    halo: Halo = field(kw_only=True)  # over the states of the model
    sets: Mapping[str, IntArray] = field(kw_only=True)  # named sets: numbers of their states
    facts: dict[str, Any] = field(kw_only=True, default_factory=dict)  # of the whole graph
    wanted: set[int] = field(kw_only=True, default_factory=set)
    """Numbers of states that were looked up and are not known here."""

    @cached_property
    def cached_facts(self) -> dict[str, Any]:
        """Cache of facts, by name: about the whole graph, and about the costs of the part."""
        return dict(self.facts)

    @property
    def predecessors(self) -> Any:
        """Predecessors are not available: pairs of other ranks also lead to states of this part.

        Raises:
            ModelError: always.
        """
        raise ModelError("ranks cannot search backwards: use ssp_lp.solve on the whole model")

    @property
    def graph(self) -> Graph:
        """The part as a separate graph, built for one search."""
        return Graph(self.pair_offsets, self.outcome_offsets, self.successors, self.probabilities)

    def of_all_states(self, made: FloatArray) -> FloatArray:
        """Extend values of the own states to all states of the part, ghosts included, [states]."""
        return self.halo.with_ghosts(made)

    def find(self, state: Any) -> int | None:
        """Return the index in the part of a state given by its number in the model.

        The result is None if the model has no such state. If the state is in the model but not in
        the part, its number is added to ``wanted`` and 0 is returned.
        """
        if not isinstance(state, (int, np.integer)) or not 0 <= state < self.halo.n_all:
            return None
        places = np.flatnonzero(self.halo.numbers == state)
        if not places.size:
            self.wanted.add(int(state))
        return int(places[0]) if places.size else 0

    def hint(self, state: Any) -> str:
        """Return a clause for errors that names the states of the model."""
        return f": states are 0 .. {self.halo.n_all - 1}"

    @cached_property
    def words(self) -> str:
        """Sizes and a checksum of the whole model; all ranks must read this together.

        The text does not depend on the number of ranks. The checksum is the sum, modulo 2^64, of a
        hash of each outcome: its number in the model, its pair, successor, probability and costs.
        """
        comm, sizes = self.halo.ranks.comm, [self.halo.n_own, self.n_pairs, self.n_outcomes]
        before, every = comm.scan(np.array(sizes)) - sizes, comm.allreduce(np.array(sizes))
        pair = np.repeat(np.arange(self.n_pairs) + before[1], np.diff(self.outcome_offsets))
        named = [self.named_costs[name] for name in sorted(self.named_costs)]
        parts = [pair, self.halo.numbers[self.successors], self.probabilities, self.costs, *named]
        mixed = (np.arange(self.n_outcomes) + before[2]).astype(np.uint64)
        for part in parts:
            mixed = (mixed ^ np.ascontiguousarray(part).view(np.uint64)) * _MIXER
            mixed ^= mixed >> _HALF
        total = sum(comm.allgather(int(mixed.sum(dtype=np.uint64)))) % 2**64
        return f"{every[0]} states, {every[1]} pairs, checksum {total:x}"

    def knowing(self, numbers: Iterable[int]) -> Part:
        """Return the part with further ghosts (states of other ranks); all ranks must call this."""
        more = np.setdiff1d(np.array([*numbers], dtype=np.int64), self.halo.numbers)
        halo = Halo(self.halo.ranks, self.halo.n_own, np.append(self.halo.ghosts, more))
        offsets = np.append(self.pair_offsets, np.full(len(more), self.n_pairs))
        kept = fields_of(self, SSP) | _named(halo, self.sets)
        kept |= {"pair_offsets": read_only(offsets), "goal_mask": halo.with_ghosts(self.goal_mask)}
        facts = {name: halo.with_ghosts(fact) for name, fact in self.facts.items()}
        return Part(**kept, halo=halo, sets=self.sets, facts=facts)


def _named(halo: Halo, sets: Mapping[str, IntArray]) -> dict[str, Any]:
    """Return the fields ``states`` and ``state_labels`` of a part with a halo's known states."""
    labels = {name: np.flatnonzero(np.isin(halo.numbers, of)) for name, of in sets.items()}
    return {"states": array("q", halo.numbers.tobytes()), "state_labels": labels}


def made_part(
    ranks: Ranks, rows: Rows, goals: IntArray, sets: Mapping[str, IntArray], bounds: IntArray
) -> Part:
    """Build each rank's part, with facts about the whole graph; all ranks must call this.

    Args:
        ranks: all ranks.
        rows: returns the rows of a range of states.
        goals: indices of the goal states, ascending.
        sets: indices of the states of each named set.
        bounds: first state of each rank, and the end, [ranks + 1].

    Raises:
        ModelError: a row is invalid; the message names the state and the action.
    """
    first, end = bounds[ranks.comm.rank :][:2].tolist()

    def made() -> tuple[SSP, IntArray]:
        """Return the rank's rows as a model, in which ghosts have no pairs; and the ghosts."""
        own = checked_rows(rows, first, end)
        successors, n_own = np.asarray(own.successors), end - first
        inside = (successors >= 0) & (successors < bounds[-1])
        remote = inside & ((successors < first) | (successors >= end))
        away = goals[:1][(goals[:1] < first) | (goals[:1] >= end)]  # each part has a goal
        ghosts = np.union1d(successors[remote], away).astype(np.int64)
        places = np.where(inside, successors - first, -1).astype(np.int32)  # -1 is refused
        places[remote] = n_own + np.searchsorted(ghosts, successors[remote])
        numbers = np.append(np.arange(first, end), ghosts)
        arrays: dict[str, Any] = {
            "pair_offsets": offsets_of(np.append(own.actions, np.zeros(len(ghosts), np.int64))),
            "outcome_offsets": offsets_of(np.asarray(own.outcomes)),
            "successors": places,
            "goal_states": np.flatnonzero(np.isin(numbers, goals)),
            "treat_actionless_as_dead_ends": True,
            "probabilities": own.probabilities,
            "costs": own.costs,
            "named_costs": own.named_costs,
        }
        try:
            return SSP.from_arrays(**arrays), ghosts
        except ModelError:  # again, so that the error names the states' numbers
            return SSP.from_arrays(**arrays, states=numbers.tolist()), ghosts

    plain, ghosts = ranks.agreed(made)
    halo = Halo(ranks, end - first, ghosts)
    kept = fields_of(plain, SSP) | _named(halo, sets)
    part = Part(**kept, halo=halo, sets=sets)
    goal, every = part.goal_mask, np.ones(part.n_pairs, dtype=np.bool_)
    lost = part.facts["hopeless_states"] = ~halo.reaching(part.graph, goal)
    part.facts["attention_states"] = halo.staying(part.graph, every, goal)
    # all ranks know an end of each set, so that all agree whether an episode ends in it
    own_lost = halo.numbers[: halo.n_own][lost[: halo.n_own]]
    ended = [own_lost[np.isin(own_lost, of)][:1] for of in sets.values()]
    return part.knowing(k for some in ranks.comm.allgather(ended) for one in some for k in one)


def balanced_bounds(ranks: Ranks, rows: Rows, n_states: int) -> IntArray:
    """Divide the states into one range per rank with about equal numbers of outcomes.

    Return the first state of each rank, and the end, [ranks + 1]. The numbers are estimated from a
    sample of states, of which each rank examines a part.

    Raises:
        ModelError: a row of the sample is invalid.
    """
    rank, size = ranks.comm.rank, ranks.comm.size
    ends = np.unique(np.linspace(0, n_states, _PROBES + 1).astype(np.int64))
    pieces = [(k, min(k + _STATES, end)) for k, end in pairwise(ends.tolist())][rank::size]
    some = ranks.agreed(lambda: [np.sum(checked_rows(rows, *own).outcomes) for own in pieces])
    work = np.zeros(len(ends))
    work[1:][rank::size] = 1.0 + np.array(some) / np.diff(pieces).ravel()
    done = np.cumsum(ranks.total(work) * np.diff(ends, prepend=0))
    return np.interp(np.linspace(0.0, done[-1], size + 1), done, ends).astype(np.int64)
