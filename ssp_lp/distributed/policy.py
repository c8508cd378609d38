"""Policies of a partitioned model: each rank holds the decisions of its own states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
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
from ssp_lp.policies.policy import UNDECIDED, check_decisions

_WHOLE = "policy.npz"  # the file of a saved policy that describes its parts
_KIND, _PART = "partitioned policy", "part of a policy"


@dataclass(frozen=True, eq=False, repr=False)
class PartitionedPolicy(ReadOnlyCopies):
    """A lottery over policies of a partitioned model; each rank holds its own states' decisions."""

    part: Part  # of the model
    weights: FloatArray  # [members]
    positions: IntArray  # [members, own states] among the actions, GIVE_UP_CODE or UNDECIDED
    told: Mapping[str, Any] = field(default_factory=dict)  # further data that are saved with it

    def __post_init__(self) -> None:
        self.keep_read_only("weights", dtype=np.float64)
        self.keep_read_only("positions", dtype=np.int32)

    def __repr__(self) -> str:
        """Return the number of states and the members' weights in one line."""
        weights = ", ".join(f"{weight:.6g}" for weight in self.weights)
        return f"PartitionedPolicy({self.part.halo.n_all:,} states, members' weights {weights})"

    def check(self) -> None:
        """Check this rank's part of the policy.

        Raises:
            ModelError: the weights are no distribution, or a decision is not an action of its
                state.
        """
        weights, decision = self.weights, np.full(self.part.n_states, UNDECIDED)
        if not (weights.min(initial=1.0) >= 0.0 and abs(weights.sum() - 1.0) <= 1e-9):
            raise ModelError(f"weights must form a distribution, not {weights.tolist()}")
        if self.positions.shape != (len(weights), self.part.halo.n_own):
            raise ModelError(f"positions have shape {self.positions.shape}, not [policies, states]")
        for own in self.positions:
            decision[: len(own)] = own
            check_decisions(self.part, decision, as_positions=True)

    def on(self, model: SSP) -> MixedPolicy:
        """Return the policy on the same model, not distributed; all ranks must call this.

        Raises:
            ModelError: the model has another number of states.
        """
        every = np.concatenate(self.part.halo.ranks.comm.allgather(self.positions), axis=1)
        if model.n_states != every.shape[1]:
            raise ModelError(f"the policy is for another model, of {every.shape[1]:,} states: this "
                             f"one has {model.n_states:,}")  # fmt: skip
        pairs = np.where(every >= 0, every + model.pair_offsets[:-1], every)
        return MixedPolicy(tuple(DeterministicPolicy(model, own) for own in pairs), self.weights)

    def save(self, folder: str | Path) -> None:
        """Write the policy, one file for each rank; all ranks must call this.

        Args:
            folder: a folder that all ranks can write to, created if missing. An earlier policy in
                this folder is replaced.

        Raises:
            ModelError: the policy has invalid decisions.
            OSError: a file cannot be written.
        """
        halo, whole = self.part.halo, Path(folder) / _WHOLE
        ranks, is_first = halo.ranks, halo.ranks.comm.rank == 0
        ranks.agreed(self.check)
        told = {**self.told, "model": self.part.words}
        bounds = np.array([*ranks.comm.allgather(halo.first), halo.n_all])

        def opened() -> None:
            if is_first:
                whole.parent.mkdir(parents=True, exist_ok=True)
                whole.unlink(missing_ok=True)

        own = whole.with_name(f"part-{ranks.comm.rank:05}.npz")
        said = whole, _KIND, told, {"weights": self.weights, "bounds": bounds}
        ranks.agreed(opened)
        ranks.agreed(partial(write_archive, own, _PART, {}, {"positions": self.positions}))
        ranks.agreed(lambda: write_archive(*said) if is_first else None)

    @classmethod
    def load(cls, model: Any, folder: str | Path) -> PartitionedPolicy:
        """Read a policy; each rank reads the decisions of its own states.

        Args:
            model: the ``PartitionedModel`` for which the policy was saved, by any number of ranks.
            folder: the folder of :meth:`save`.

        Raises:
            ModelError: the policy was saved for another model, or a file is damaged.
            OSError: a file cannot be opened.
        """
        part: Part = model if isinstance(model, Part) else model.part
        folder, words, halo = Path(folder), part.words, part.halo

        def read() -> PartitionedPolicy:
            with opened_archive(folder / _WHOLE, _KIND) as (header, arrays):
                if header["model"] != words:
                    raise ModelError(f"the policy is for another model, of {header['model']}")
                weights, bounds = arrays["weights"], arrays["bounds"].tolist()
            parts = [np.zeros((len(weights), 0), dtype=np.int32)]
            for k, (first, end) in enumerate(pairwise(bounds)):
                if max(first, halo.first) < min(end, halo.end):
                    with opened_archive(folder / f"part-{k:05}.npz", _PART) as (_, arrays):
                        own = slice(max(halo.first - first, 0), halo.end - first)
                        parts.append(arrays["positions"][:, own])
            policy = cls(part, weights, np.concatenate(parts, axis=1), header)
            policy.check()
            return policy

        return halo.ranks.agreed(read)
