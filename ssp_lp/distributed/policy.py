"""Policies of a partitioned model: each rank has the decisions of its own states, and its own file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, ReadOnlyCopies
from ssp_lp.distributed.part import Part
from ssp_lp.errors import ModelError
from ssp_lp.io.archives import opened_archive, write_archive
from ssp_lp.model import SSP
from ssp_lp.policies import DeterministicPolicy, MixedPolicy
from ssp_lp.policies.policy import GIVE_UP_CODE

_WHOLE = "policy.npz"  # the file of a saved policy that says what the others are
_KIND, _PART = "partitioned policy", "part of a policy"
_MIXER, _HALF = np.uint64(0x9E3779B97F4A7C15), np.uint64(32)  # an odd number of bits as if drawn


@dataclass(frozen=True, eq=False, repr=False)
class PartitionedPolicy(ReadOnlyCopies):
    """A lottery over policies of a partitioned model; decisions lie with the states' ranks."""

    part: Part  # of the model
    weights: FloatArray  # [members]
    positions: IntArray  # [members, own states] among the actions, GIVE_UP_CODE or UNDECIDED
    told: Mapping[str, Any] = field(default_factory=dict)  # what else is saved with it

    def __post_init__(self) -> None:
        self.keep_read_only("weights", dtype=np.float64)
        self.keep_read_only("positions")

    def __repr__(self) -> str:
        """One line: the members' weights and how many states they decide in."""
        weights = ", ".join(f"{weight:.6g}" for weight in self.weights)
        states = self.part.described.n_states
        return f"PartitionedPolicy({states:,} states, members' weights {weights})"

    @property
    def members(self) -> tuple[PartitionedPolicy, ...]:
        """Each member of the partitioned policy by itself."""
        return tuple(replace(self, weights=np.ones(1), positions=own[None]) for own in self.positions)

    def check(self) -> None:
        """Check this rank's part of the partitioned policy.

        Raises:
            ModelError: weights that are no distribution, or a decision that is none of the state's.
        """
        n_own, weights = self.part.halo.n_own, self.weights
        shape = len(weights), n_own
        if self.positions.shape != shape:
            raise ModelError(f"positions of shape {shape} are needed, not {self.positions.shape}")
        if not (weights.min(initial=1.0) >= 0.0 and abs(weights.sum() - 1.0) <= 1e-9):
            raise ModelError(f"weights must form a distribution, not {weights.tolist()}")
        actions = np.diff(self.part.pair_offsets)[:n_own]
        wrong = (self.positions < GIVE_UP_CODE - 1) | (self.positions >= actions)
        if self.positions.dtype.kind != "i" or wrong.any():
            state = int(np.flatnonzero(wrong.any(axis=0))[0]) if wrong.any() else 0
            raise ModelError(f"state {self.part.states[state]!r} has the actions 0 .. "
                             f"{actions[state] - 1}: another one is decided on")  # fmt: skip

    def decisions(self) -> IntArray:
        """Pairs of the part or codes, [members, own states]."""
        first = self.part.pair_offsets[:-1][: self.part.halo.n_own]
        own = self.positions.astype(np.int64)
        return np.where(own >= 0, own + first, own)

    def on(self, model: SSP) -> MixedPolicy:
        """Join the partitioned policy on the same model, held whole; all ranks ask together.

        Raises:
            ModelError: the model has another number of states.
        """
        n_states, halo = self.part.described.n_states, self.part.halo
        if model.n_states != n_states:
            raise ModelError(f"the policy is for another model, of {n_states:,} states: this one "
                             f"has {model.n_states:,}")  # fmt: skip
        every = np.concatenate(halo.ranks.comm.allgather(self.positions), axis=1).astype(np.int64)
        pairs = np.where(every >= 0, every + model.pair_offsets[:-1], every)
        return MixedPolicy(tuple(DeterministicPolicy(model, own) for own in pairs), self.weights)

    def save(self, folder: str | Path) -> None:
        """Write the partitioned policy, each rank a file of its own; all ranks ask together.

        Args:
            folder: that all ranks can write to; it is made if need be. A policy in it is replaced.

        Raises:
            ModelError: it has decisions that are none.
            OSError: a file cannot be written.
        """
        halo, whole = self.part.halo, Path(folder) / _WHOLE
        ranks, rank = halo.ranks, halo.ranks.comm.rank
        ranks.agreed(self.check)
        told = {**self.told, **model_words(self.part)}
        bounds = np.array([*ranks.comm.allgather(halo.first), halo.n_all])

        def opened() -> None:
            """Make the folder, and take away what said that the parts are of one policy."""
            if rank == 0:
                whole.parent.mkdir(parents=True, exist_ok=True)
                whole.unlink(missing_ok=True)

        def closed() -> None:
            """Say what the parts are, which all are there now."""
            if rank == 0:
                write_archive(whole, _KIND, told, {"weights": self.weights, "bounds": bounds})

        own = whole.with_name(f"part-{rank:05}.npz"), _PART, {}, {"positions": self.positions}
        for step in (opened, partial(write_archive, *own), closed):
            ranks.agreed(step)

    @classmethod
    def load(cls, model: Any, folder: str | Path) -> PartitionedPolicy:
        """Read a partitioned policy, each rank the decisions of its own states.

        Args:
            model: the ``PartitionedModel`` for which it was saved, by any number of ranks.
            folder: of :meth:`save`.

        Raises:
            ModelError: it was saved for another model, or a file is damaged.
            OSError: a file cannot be opened.
        """
        part: Part = model.part
        folder, words, halo = Path(folder), model_words(part), part.halo

        def read() -> PartitionedPolicy:
            """Read this rank's decisions, from all files that have some of them."""
            with opened_archive(folder / _WHOLE, _KIND) as (header, arrays):
                if any(header[name] != known for name, known in words.items()):
                    kept = ", ".join(f"{header[name]:,} {name}" for name in ("states", "pairs"))
                    raise ModelError(f"the policy is for another model, of {kept}")
                weights, bounds = arrays["weights"], arrays["bounds"]
            parts = [np.zeros((len(weights), 0), dtype=np.int32)]
            for k, (first, end) in enumerate(pairwise(bounds.tolist())):
                if max(first, halo.first) < min(end, halo.end):
                    with opened_archive(folder / f"part-{k:05}.npz", _PART) as (_, arrays):
                        own = slice(max(halo.first - first, 0), halo.end - first)
                        parts.append(arrays["positions"][:, own])
            policy = cls(part, weights, np.concatenate(parts, axis=1), header)
            policy.check()
            return policy

        return halo.ranks.agreed(read)


def model_words(part: Part) -> dict[str, Any]:
    """Sizes and a checksum of a partitioned model, the same on any number of ranks; all ask together.

    The checksum is the sum modulo 2^64 of mixed words, one of each outcome: its state, its place
    among the state's outcomes, its pair's place, its successor, probability and costs.
    """
    if "words" in part.facts:
        words: dict[str, Any] = part.facts["words"]
        return words
    halo, described, total = part.halo, part.described, 0
    begins = part.outcome_offsets[part.pair_offsets[:-1]]
    named = [part.named_costs[name] for name in sorted(part.named_costs)]
    for pairs in np.array_split(np.arange(part.n_pairs), part.n_outcomes // (1 << 20) + 1):
        lengths = np.diff(part.outcome_offsets)[pairs]
        own = slice(*part.outcome_offsets[[pairs[0], pairs[-1] + 1]]) if pairs.size else slice(0)
        home = np.repeat(part.pair_state[pairs].astype(np.int64), lengths)
        mixed = np.zeros(len(home), dtype=np.uint64)
        for one in (
            home + halo.first,
            np.repeat(pairs, lengths) - part.pair_offsets[home],
            np.arange(own.start or 0, own.stop) - begins[home],
            halo.numbers[part.successors[own]],
            *(numbers[own] for numbers in (part.probabilities, part.costs, *named)),
        ):
            mixed = (mixed ^ np.ascontiguousarray(one).view(np.uint64)) * _MIXER
            mixed ^= mixed >> _HALF
        total += int(mixed.sum(dtype=np.uint64))
    goals = part.halo.numbers[: halo.n_own][part.goal_mask[: halo.n_own]].astype(np.uint64) * _MIXER
    own_sizes = part.n_pairs, total, int((goals ^ (goals >> _HALF)).sum(dtype=np.uint64))
    sizes = [sum(column) for column in zip(*halo.ranks.comm.allgather(own_sizes), strict=True)]
    labels = repr(None if described.states is None else [*described.states]).encode()
    digest = sha256(f"{sizes[1] % 2**64} {sizes[2] % 2**64}".encode() + labels).hexdigest()
    part.facts["words"] = {"states": described.n_states, "pairs": sizes[0], "model": digest}
    return model_words(part)
