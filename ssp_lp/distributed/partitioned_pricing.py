"""Pricing on a partitioned model: policies, rows and proofs of a process that no rank has whole.

Of a column the first rank has what concerns states; the checkpoint keeps columns and proofs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, cast
from zipfile import BadZipFile

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    FloatArray,
    IntArray,
)
from ssp_lp.column_generation.column import Column, Proof, pricing_weights, required
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, LeastFailure
from ssp_lp.column_generation.explicit_pricing import ExplicitPricing
from ssp_lp.distributed.dynamics import PartitionedDynamics
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.distributed.share import Share
from ssp_lp.dynamic_programming.dual_bound import DualBound
from ssp_lp.dynamic_programming.evaluation import EVALUATED
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.model import SSP
from ssp_lp.policies.policy import Branches, Policy
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.processes.failure_label import FailureLabelled, label_failure
from ssp_lp.processes.failure_semantics import free_pairs, giving_up_states
from ssp_lp.processes.quotient import build_quotient

_STEEPER = 10.0 ** np.arange(1, 14, 3)  # prices of failure, by the cost, for one that fails least
_DUST = 1e-14
"""Below it a total is measured again, from 0 on: what was a guess of nothing may have left it."""
_SAME = 1e-13  # of failing or not, the rarer: distance of failures that are one


@dataclass(frozen=True, eq=False, repr=False)
class ChosenPairs(Policy):
    """A policy of a partitioned model that the search has found: a pair of each process state."""

    model: SSP
    parts: list[IntArray]  # [ranks] of each rank's own states, pairs counted from its first
    figures: FloatArray  # [rewards] cost, failure and rows, measured

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Refused: the model's pairs lie with several ranks.

        Raises:
            ModelError: always.
        """
        raise ModelError("a policy of a partitioned model is played by all ranks: model.simulate()")


def labelled_share(ranks: Ranks, compiled: CompiledExplicit) -> tuple[Share, ExplicitPricing]:
    """A rank's part of the process with the failure label, and of what is counted on it.

    All ranks make theirs at the same time. Where one may stay for ever at no cost anyone may give
    up: the partitioned process is not collapsed there.
    """
    slab: Any = compiled.model
    semantics, discount = compiled.semantics, compiled.discount
    exits = giving_up_states(slab, semantics.give_up)
    wandering = np.zeros(slab.n_states, dtype=np.bool_)
    if discount is None:
        free = free_pairs(slab, semantics.aim, compiled.side, compiled.objective)
        wandering = slab.staying_free(free)
    quotient = build_quotient(slab, exits=(exits | wandering) & slab.own_mask)
    quotient = replace(quotient, merged=wandering)
    setting = compiled.start, semantics, discount
    labelled = label_failure(slab, *setting, quotient=quotient)
    live, comm = quotient.node_of >= 0, ranks.comm
    first, end = (int(np.count_nonzero(live[:k])) for k in (slab.first, slab.end))
    process = labelled.process
    if comm.rank == comm.size - 1:
        end = process.n_states
    elif process.n_states > quotient.n_nodes:  # the source is the last rank's
        labelled = replace(labelled, process=_without_last_pair(process))
    stated = replace(compiled)
    vars(stated)["augmented"] = labelled
    rows, own = labelled.process.dynamics, stated.explicit_pricing
    nothing = sp.csr_array(
        rows.transitions.shape
    )  # the share has the rows, with columns of its own
    labelled = replace(labelled, process=replace(labelled.process, transitions=nothing))
    vars(compiled)["augmented"] = labelled

    def anew(discount: float | None) -> Share:
        """The same with another discount."""
        return labelled_share(ranks, replace(compiled, discount=discount))[0]

    share = Share(comm, ranks.petsc, rows, own.rewards, first, end, labelled, anew)
    return share, replace(own, augmented=labelled)


def _without_last_pair(process: ExplicitProcess) -> ExplicitProcess:
    """A part of a partitioned process without its last state's only pair."""
    offsets = process.pair_offsets.copy()
    offsets[-1] -= 1
    return ExplicitProcess(
        offsets, sp.csr_array(process.transitions[:-1]), process.start,
        process.cost[:-1], process.failure[:-1], process.goal[:-1],
    )  # fmt: skip


class Checkpoint:
    """Policies, and proofs with their prices, that a search on a partitioned model has found.

    They are kept in a file, if there is one, which a later run of the same question goes on from.
    """

    def __init__(self, path: str | Path | None, told: str) -> None:
        """Read what an earlier run has left.

        Args:
            path: of the file; None: nothing is kept.
            told: what the question is.

        Raises:
            ModelError: the file is about another question, or is none.
        """
        self._path, self._told = None if path is None else Path(path), told
        self._columns: list[tuple[FloatArray, FloatArray, IntArray]] = []
        self.proofs: list[tuple[FloatArray, float]] = []
        self._measured: dict[int, Column] = {}
        if self._path is not None and not self._path.parent.is_dir():
            raise ModelError(f"the checkpoint {path} is in no folder: make {self._path.parent}")
        if self._path is not None and self._path.exists():
            try:
                with np.load(self._path, allow_pickle=False) as file:
                    kept = {name: file[name] for name in file.files}
                columns = zip(kept["weights"], kept["figures"], kept["choices"], strict=True)
                self._columns = list(columns)
                self.proofs = [(row[:-1], float(row[-1])) for row in kept["proofs"]]
                known = str(kept["told"])
            except (OSError, EOFError, ValueError, KeyError, TypeError, BadZipFile) as error:
                raise ModelError(
                    f"{path} is no checkpoint: {error}; delete it or name another"
                ) from error
            if known != told:
                raise ModelError(f"the checkpoint {path} is of {known}, not of {told}")
        self.n_begun = len(self._columns)

    @property
    def price(self) -> float | None:
        """Price of failure of the checkpoint's last proof; None: there is none."""
        return float(self.proofs[-1][0][1]) if self.proofs else None

    def nearest(self, pricing: PartitionedPricing, weights: FloatArray) -> Column | None:
        """The earlier run's column of the checkpoint that is worth least, measured; None: none."""
        if not self.n_begun:
            return None
        best = int(np.argmin([weights @ self._columns[k][1] for k in range(self.n_begun)]))
        if best not in self._measured:
            self._measured[best] = pricing.measure(self._columns[best][2])
        return self._measured[best]

    def keep(self, weights: FloatArray, column: Column) -> None:
        """Keep a column in the checkpoint, and the weights at which it was found."""
        if self._path is not None:
            self._columns.append((weights, column.figures, required(column.choice)))
            self._write()

    def keep_proof(self, weights: FloatArray, bound: float) -> None:
        """Keep a lower bound of all weighted totals in the checkpoint."""
        self.proofs.append((weights, bound))
        self._write()

    def _write(self) -> None:
        """Write the checkpoint's file, whole or not at all."""
        if self._path is None or not self._columns:
            return
        weights, figures, choices = (np.stack(part) for part in zip(*self._columns, strict=True))
        proofs = [np.append(weights, bound) for weights, bound in self.proofs]
        beside = self._path.with_name(self._path.name + ".part")
        with beside.open("wb") as file:
            np.savez(
                file, told=np.array(self._told), weights=weights, figures=figures, choices=choices,
                proofs=np.array(proofs).reshape(-1, weights.shape[1] + 1),
            )  # fmt: skip
        beside.replace(self._path)


@dataclass(frozen=True, eq=False)
class PartitionedPricing(ExplicitPricing):
    """Explicit pricing on rows that the ranks of PETSc hold.

    Of the process only what concerns states is looked at here: how many there are, and the start.
    """

    shared: PartitionedDynamics = field(kw_only=True)
    kept: Checkpoint = field(kw_only=True)

    no_gain: ClassVar[float] = EVALUATED  # as finely as ranks evaluate

    @property
    def dynamics(self) -> PartitionedDynamics:
        """Dynamics of the process of partitioned pricing."""
        return self.shared

    @property
    def rewards(self) -> FloatArray:
        """How each reward is made of those that the ranks hold: each is one of them."""
        return np.eye(self.n_rewards)

    @cached_property
    def _leaving(self) -> IntArray:
        """A policy of partitioned pricing that leaves from every state, goal first, [states]."""
        return self.shared.approach()

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Partitioned pricing: a column of least priced cost, kept in the checkpoint."""
        weights = self._weights(price)
        known = [column for column in (*warm, self.kept.nearest(self, weights)) if column]
        known.sort(key=lambda column: float(weights @ column.figures))
        column = super().minimise(price, *known)
        if ((column.figures > 0.0) & (column.figures < _DUST)).any():
            column = self.measure(required(column.choice), column.work, column.found_at)
        self.kept.keep(weights, column)
        return column

    def contracted(self, weights: FloatArray) -> None:
        """Nothing: what is free is not contracted; policies that leave go on to."""
        return

    def check(
        self,
        price: float | FloatArray,
        values: FloatArray,
        *,
        slack: bool = False,
        choice: IntArray | None = None,
    ) -> Proof:
        """Lower values of partitioned pricing, and keep the proof in the checkpoint."""
        proof = super().check(price, values, slack=slack, choice=choice)
        self.kept.keep_proof(self._weights(price), proof.bound)
        return proof

    def _weights(self, price: float | FloatArray) -> FloatArray:
        """Weights of all rewards in partitioned pricing at a price, or at some of the weights."""
        weights = pricing_weights(price)
        return np.append(weights, np.zeros(self.n_rewards - len(weights)))

    def lowered(
        self, weights: FloatArray, values: FloatArray, choice: IntArray | None = None
    ) -> DualBound:
        """Weighted totals of partitioned pricing, lowered to a checked sub-solution."""
        return self.shared.lower_bound(weights, values)

    def pulled_back(self, column: Column) -> Policy:
        """The pairs that a column of partitioned pricing takes, by rank."""
        parts, own = self.shared.own_pairs(required(column.choice)), self._labelled
        return ChosenPairs(own.quotient.model, parts, column.figures)

    @property
    def _labelled(self) -> FailureLabelled:
        """The first rank's part of the process of partitioned pricing."""
        own: Any = self.augmented
        return cast("FailureLabelled", own)

    def confirmed(self, weights: FloatArray, values: FloatArray) -> Proof:
        """Proof by values as they stand, on all ranks' rows; partitioned check() lowers.

        Args:
            weights: of the rewards, >= 0, [rewards].
            values: finite, [states].

        Raises:
            SolverError: they are no sub-solution; it names a state in which they are too high.
        """
        self.check_shape(values)
        parts = self.shared.order(
            "lowered", (weights, -np.inf, 1), [(part,) for part in self.shared.by_state(values)]
        )
        if any(is_lowered for _, is_lowered in parts):
            excess = values - np.concatenate([own for own, _ in parts])
            k, states = int(np.argmax(excess)), self._labelled.quotient.first_states
            model = self._labelled.quotient.model
            where = f"state {model.states[int(states[k])]!r}" if k < len(states) else "the start"
            raise SolverError(f"the value function is no bound: in {where} it is too high by "
                              f"{excess[k]:.3g} at least")  # fmt: skip
        bound, failing = DualBound(values, np.zeros_like(values)), float(weights[1])
        return Proof(failing, failing, bound.at(self.process.start), values)


@dataclass(frozen=True, eq=False)
class CompiledPartitioned(CompiledExplicit):
    """Case M compiled on a partitioned model: whatever asks for rows is an order to the ranks."""

    shared: PartitionedPricing = field(kw_only=True)

    is_whole: ClassVar[bool] = False  # another question is labelled in place of this one

    @classmethod
    def of(
        cls, ranks: Ranks, compiled: CompiledExplicit, own: ExplicitPricing, kept: Checkpoint
    ) -> CompiledPartitioned:
        """A compiled problem whose pricing is that of the rows which the ranks hold.

        Args:
            ranks: which hold theirs.
            compiled: the problem, on the first rank's part of the model.
            own: pricing by the first rank's rows.
            kept: what is found goes there.
        """
        held = PartitionedDynamics.held_by(ranks)
        pricing = PartitionedPricing(own.augmented, rows=own.rows, shared=held, kept=kept)
        stated = {part.name: getattr(compiled, part.name) for part in fields(CompiledExplicit)}
        return cls(**stated, shared=pricing)

    @property
    def ranks(self) -> Ranks:
        """The ranks that share the compiled problem's pricing."""
        return self.shared.shared.ranks

    def pricing(self) -> PartitionedPricing:
        """The partitioned pricing problem, with a price for each row."""
        return self._priced

    @cached_property
    def _priced(self) -> PartitionedPricing:
        """The partitioned pricing problem in the precision that is asked for."""
        return replace(self.shared, precise=True) if self.precise else self.shared

    def least_failure(self) -> LeastFailure:
        """The cheapest of the policies that fail least, by a price of failure at which it does.

        Whatever attains the least of ``cost + price * failure`` and fails least is the cheapest of
        all that do. Where no price is steep enough, one that fails least, whatever it costs.
        """
        pricing, (cost, failure) = self._priced, np.eye(2, self.shared.n_rewards)
        safest = pricing.minimise(failure)
        rarer = min(safest.failure, 1.0 - safest.failure)
        column, least = safest, safest.failure + _SAME * max(rarer, 0.0)
        proved = min(max(pricing.prove(failure, safest).bound, 0.0), safest.failure)
        for steep in _STEEPER if np.isfinite(safest.cost) else ():
            price = steep * max(safest.cost, 1.0)
            cheaper = pricing.minimise(cost + price * failure, column)
            if cheaper.failure <= least:
                column = cheaper
                break
        column = replace(column, found_at=None)
        return LeastFailure(pricing.policy(column), column, 0.0, proved)

    def failure_at_least(self, discount: float | None) -> float:
        """The least failure of all policies on the partitioned model, for an error."""
        ranks = self.ranks
        if discount == self.discount and ranks.held_by is self.shared.shared:
            return self.least_failure().column.failure
        ranks.order("label", (discount,))
        kept, held = Checkpoint(None, ""), PartitionedDynamics.held_by(ranks)
        pricing = replace(self.shared, shared=held, kept=kept, begun_from=None)
        return replace(self, discount=discount, shared=pricing).least_failure().column.failure

    def settled(self, *known: Column) -> CompiledPartitioned:
        """The compiled problem with the least failure as its budget, where that is no less.

        Raises:
            InfeasibleError: the budget is below the least failure by more than rounding.
        """
        if self.budget is None or self.budget >= 1.0:
            return self
        least = self.least.column.failure
        return self if self.budget > least else replace(self, budget=least)

    def refined(self, price: float) -> None:
        """Nothing: the partitioned process truncates nothing."""
        return
