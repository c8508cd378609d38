"""Models that no rank of PETSc holds whole, and questions of case M on them.

Each rank makes, or reads, the rows of its own states. The first one searches with vectors over
states, as it does on any process (``column_generation``, ``methods``): whatever takes rows is an
order to all ranks (``dynamics``).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ssp_lp.arrays import (
    RELATIVE_GAP,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    read_only,
)
from ssp_lp.cargo import Cargo
from ssp_lp.column_generation.column import Column, Proof, relative_gap, required
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, LeastFailure
from ssp_lp.column_generation.explicit_pricing import ExplicitPricing, pricing_weights
from ssp_lp.column_generation.search import DualGuess
from ssp_lp.compiled.deadline import Stop, until
from ssp_lp.distributed.dynamics import PartitionedDynamics
from ssp_lp.distributed.petsc import Petsc
from ssp_lp.distributed.ranks import Ranks, packed_error, unpacked
from ssp_lp.distributed.share import Share
from ssp_lp.distributed.slab import Slab, StateRows, slab_in_file, slab_of, slab_of_model
from ssp_lp.dynamic_programming.dual_bound import DualBound
from ssp_lp.errors import ModelError, OutOfTimeError
from ssp_lp.formulation import Formulation
from ssp_lp.methods.approaches import refusal
from ssp_lp.methods.columns import refined_optimum
from ssp_lp.methods.rows import lagrange_bound, rows_optimum
from ssp_lp.model import SSP
from ssp_lp.model.graph import hopeless_states
from ssp_lp.options import ColumnGeneration, Progress, SolveOptions, options_of
from ssp_lp.policies import DeterministicPolicy, MixedPolicy
from ssp_lp.policies.policy import Branches, Policy
from ssp_lp.problem import compiled_constrained
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.processes.failure_label import label_failure
from ssp_lp.processes.failure_semantics import free_pairs, giving_up_states
from ssp_lp.processes.quotient import build_quotient
from ssp_lp.solution import CUT_SHORT, Run, Solution

_SURE = 1e-6  # relative uncertainty of a price in a checkpoint


@dataclass(frozen=True, eq=False, repr=False)
class ActionPositions(Policy):
    """A policy of a partitioned model: the position of each state's action, or a code."""

    model: SSP
    positions: IntArray  # [states] among the state's actions, GIVE_UP_CODE or UNDECIDED
    figures: FloatArray  # [rewards] cost, failure and rows, measured

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Refused: the model's pairs lie with several ranks.

        Raises:
            ModelError: always.
        """
        raise ModelError("a policy of a partitioned model is played on a whole one: solution.on()")


@dataclass(frozen=True, eq=False)
class PartitionedSolution(ReadOnlyCopies):
    """The optimum of a question on a partitioned model, the same on every rank."""

    objective: float  # of the lottery, as measured
    lower_bound: float  # of the optimum, certified
    failure: float  # of the lottery, discounted where that is limited
    weights: FloatArray  # [members] of the lottery
    positions: IntArray  # [members, states] of actions, or GIVE_UP_CODE or UNDECIDED
    prices: Mapping[str, float]  # multiplier of each row, by name
    spent: Mapping[str, float]  # each limited quantity under the lottery, by name
    value_function: FloatArray  # [process states] the checked sub-solution
    run: Run
    note: str = ""

    @property
    def gap(self) -> float:
        """Relative gap between the partitioned solution's objective and its bound."""
        return relative_gap(self.objective, self.lower_bound)

    @property
    def failure_price(self) -> float:
        """Multiplier of the partitioned solution's failure row."""
        return self.prices.get(FAILURE_ROW, 0.0)

    def on(self, problem: Formulation) -> Solution:
        """The same answer to the same problem on a model that this process holds whole.

        Args:
            problem: with which ``certify`` and ``evaluate`` go on.
        """
        offsets = problem.model.pair_offsets[:-1]
        members = tuple(
            DeterministicPolicy(problem.model, np.where(own >= 0, own + offsets, own))
            for own in self.positions.astype(np.int64)
        )
        return Solution(
            problem=problem,
            policy=MixedPolicy(members, self.weights),
            objective=self.objective,
            lower_bound=self.lower_bound,
            failure_price=self.failure_price + problem.semantics.penalty,
            value_function=self.value_function,
            budget_used=self.failure,
            run=self.run,
            note=self.note,
            prices=self.prices,
        )


@dataclass(frozen=True, eq=False)
class PartitionedModel:
    """A model whose rows lie with the ranks of PETSc, by state, and nowhere all together.

    Under ``mpiexec -n 4 python plan.py`` every rank makes its part, and asks the same:

        model = PartitionedModel.from_rows(rows, n_states, goal_states=[n_states - 1])
        answer = model.solve(MCMP, start=0, failure_budget=0.05)
    """

    slab: Slab  # this rank's part
    ranks: Ranks = field(repr=False)

    @classmethod
    def from_rows(
        cls,
        rows: Callable[[int, int], StateRows],
        n_states: int,
        goal_states: npt.ArrayLike,
        *,
        states: Sequence[Hashable] | None = None,
        state_labels: Mapping[str, Any] | None = None,
    ) -> PartitionedModel:
        """Make each rank's part by a vectorised function on a range of states.

        Args:
            rows: ``rows(first, end)`` gives the rows of the states first .. end - 1, as arrays;
                each rank asks for its own, some ten thousand states at a time.
            n_states: number of states.
            goal_states: numbers of the goal states, which have no actions.
            states: labels of the states; their numbers if left out.
            state_labels: names for sets of states, each given by its states.

        Raises:
            ModelError: naming the state and the action at fault, on every rank.
        """
        ranks = Ranks.all()
        made = ranks.agreed(
            lambda: slab_of(ranks.comm, rows, n_states, goal_states, states, state_labels)
        )
        return cls(made, ranks)

    @classmethod
    def from_file(cls, path: str | Path) -> PartitionedModel:
        """Read each rank's part of a file of ``save_model``.

        Args:
            path: of the file, which every rank can open.

        Raises:
            ModelError: naming the file: it is none of this format, or damaged.
            OSError: the file cannot be opened.
        """
        ranks = Ranks.all()
        return cls(ranks.agreed(lambda: slab_in_file(ranks.comm, path)), ranks)

    @classmethod
    def from_model(cls, model: SSP) -> PartitionedModel:
        """Take each rank's part of a model that all ranks have."""
        ranks = Ranks.all()
        return cls(slab_of_model(ranks.comm, model), ranks)

    def solve(
        self,
        criterion: type[Any],
        *,
        tolerance: float = RELATIVE_GAP,
        time_limit: float | None = None,
        progress: Progress | None = None,
        checkpoint: str | Path | None = None,
        **asked: Any,
    ) -> PartitionedSolution:
        """Solve a question of case M within a failure budget, on all ranks together.

        Args:
            criterion: such as ``MCMP``, stated with what else is given: ``start=``,
                ``failure_budget=``, ``discount=``, ``constraints=``, ...; secondary costs by name.
            tolerance: relative gap to reach.
            time_limit: seconds after which the best lottery so far is the answer, if there is one.
            progress: as ``solve`` takes it; called on the first rank.
            checkpoint: a file of the first rank's, to which each policy and each proof goes that is
                found; a later run of the same question, on any number of ranks, begins with them.

        Raises:
            ModelError: another question, or one that needs the whole graph.
            InfeasibleError: no policy keeps to the budget and the limits.
            OutOfTimeError: the time ended before there was an answer.
        """
        began, method = time.perf_counter(), ColumnGeneration(pricing=Petsc())
        options = options_of(method, tolerance, began, time_limit, progress)
        ranks, cargo = self.ranks, Cargo()
        compiled = ranks.agreed(lambda: self._compiled(criterion, method, asked))
        share, own = _labelled_share(ranks, compiled)
        ranks.hold(share)
        if ranks.comm.rank > 0:
            answer: PartitionedSolution = unpacked(cargo, ranks.serve())
            return answer
        packed = b""
        try:
            kept = Checkpoint(checkpoint, f"{criterion.__name__}, {compiled.told}, "
                              f"{compiled.bounds.tolist()}, {compiled.semantics}, "
                              f"{compiled.discount}, {self.slab.n_states} states")  # fmt: skip
            held = PartitionedDynamics.held_by(ranks)
            pricing = PartitionedPricing(own.augmented, rows=own.rows, shared=held, kept=kept)
            found = _searched(CompiledPartitioned.of(compiled, pricing), options, began)
            packed = cargo.pack(found)
        except BaseException as error:
            packed = packed_error(cargo, error)
            raise
        finally:
            ranks.dismiss(packed)
        return found

    def _compiled(
        self, criterion: type[Any], method: ColumnGeneration, asked: Mapping[str, Any]
    ) -> CompiledExplicit:
        """The question on the rank's part of the partitioned model, checked and compiled.

        Raises:
            ModelError: another question, or one that needs the whole graph.
        """
        if asked.get("horizon") is not None or asked.get("reach_fraction") is not None:
            raise ModelError("a partitioned model has no horizon and no reach_fraction: state the "
                             "budget, and steps as a part of the states")  # fmt: skip
        problem: Formulation = criterion(self.slab, **asked)
        if (refused := refusal(problem, method)) is not None:
            raise refused
        if problem.semantics.forbids_failing:
            raise ModelError(f"{criterion.__name__} forbids failing, which asks for the whole "
                             "graph: on a partitioned model give a failure budget")  # fmt: skip
        try:
            is_told = problem.unrolled is problem
        except ModelError:
            is_told = False
        if not is_told:
            raise ModelError("a limit counts what may come after failing, which a partitioned "
                             "model does not tell apart: visits() counts until then")  # fmt: skip
        return compiled_constrained(problem)


def _labelled_share(ranks: Ranks, compiled: CompiledExplicit) -> tuple[Share, ExplicitPricing]:
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
        wandering = slab.staying_free(free, slab.goal_mask | hopeless_states(slab))
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
    vars(compiled)["augmented"] = labelled
    own = compiled.explicit_pricing

    def anew(discount: float | None) -> Share:
        """The same with another discount."""
        return _labelled_share(ranks, replace(compiled, discount=discount))[0]

    held = labelled.process.dynamics, own.rewards, first, end, labelled, anew
    return Share(comm, ranks.petsc, *held), own


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
        if self._path is not None and self._path.exists():
            try:
                with np.load(self._path, allow_pickle=False) as file:
                    kept = {name: file[name] for name in file.files}
                columns = zip(kept["weights"], kept["figures"], kept["choices"], strict=True)
                self._columns = list(columns)
                self.proofs = [(row[:-1], float(row[-1])) for row in kept["proofs"]]
                known = str(kept["told"])
            except (OSError, ValueError, KeyError) as error:
                raise ModelError(f"{path} is no checkpoint: {error}") from error
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
        weights = pricing_weights(price)
        weights = np.append(weights, np.zeros(self.n_rewards - len(weights)))
        known = [column for column in (*warm, self.kept.nearest(self, weights)) if column]
        known.sort(key=lambda column: float(weights @ column.figures))
        column = super().minimise(price, *known)
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
        weights = pricing_weights(price)
        weights = np.append(weights, np.zeros(self.n_rewards - len(weights)))
        self.kept.keep_proof(weights, proof.bound)
        return proof

    def lowered(
        self, weights: FloatArray, values: FloatArray, choice: IntArray | None = None
    ) -> DualBound:
        """Weighted totals of partitioned pricing, lowered to a checked sub-solution."""
        return self.shared.lower_bound(weights, values)

    def pulled_back(self, column: Column) -> Policy:
        """The positions of the actions that a column of partitioned pricing takes."""
        own = [(pairs,) for pairs in self.shared.own_pairs(required(column.choice))]
        positions = np.concatenate(self.shared.order("positions", (), own))
        own_part: Any = self.augmented
        return ActionPositions(own_part.quotient.model, positions, column.figures)


@dataclass(frozen=True, eq=False)
class CompiledPartitioned(CompiledExplicit):
    """Case M compiled on a partitioned model: whatever asks for rows is an order to the ranks."""

    shared: PartitionedPricing = field(kw_only=True)

    @classmethod
    def of(cls, compiled: CompiledExplicit, pricing: PartitionedPricing) -> CompiledPartitioned:
        """A compiled problem whose pricing the ranks share."""
        own = {part.name: getattr(compiled, part.name) for part in fields(CompiledExplicit)}
        return cls(**own, shared=pricing)

    def pricing(self) -> PartitionedPricing:
        """The partitioned pricing problem, with a price for each row."""
        return self._priced

    @cached_property
    def _priced(self) -> PartitionedPricing:
        """The partitioned pricing problem in the precision that is asked for."""
        return replace(self.shared, precise=True) if self.precise else self.shared

    def least_failure(self) -> LeastFailure:
        """A policy that fails least, whatever it costs: nothing is known of the cost."""
        weights = np.eye(self.shared.n_rewards)[1]
        column = replace(self._priced.minimise(weights), found_at=None)
        return LeastFailure(self._priced.policy(column), column, 0.0)

    def failure_at_least(self, discount: float | None) -> float:
        """The least failure of all policies on the partitioned model, for an error."""
        ranks = self.shared.shared.ranks
        if discount == self.discount and ranks.held_by is self.shared.shared:
            return self.least_failure().column.failure
        ranks.order("label", (discount,))
        kept, held = Checkpoint(None, ""), PartitionedDynamics.held_by(ranks)
        pricing = replace(self.shared, shared=held, kept=kept, begun_from=None)
        return replace(self, discount=discount, shared=pricing).least_failure().column.failure

    def settled(self) -> CompiledPartitioned:
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


def _searched(
    compiled: CompiledPartitioned, options: SolveOptions, began: float
) -> PartitionedSolution:
    """The search's answer to a question on a partitioned model, on the first rank.

    Raises:
        OutOfTimeError: the time ended before there was an answer.
    """
    sense, budget, kept = compiled.sense, compiled.budget, compiled.shared.kept
    budget = 1.0 if budget is None else budget
    try:
        with until(options.deadline):
            if compiled.side or compiled.objective is not None:
                optimum = rows_optimum(compiled, options)
                prices, note = dict(optimum.prices), optimum.note
                value, bound, lottery = optimum.value, optimum.bound, optimum.policy
                values, calls, work = optimum.values, optimum.calls, optimum.work
            else:
                price = kept.price
                guess = DualGuess(price, _SURE) if price else None
                outcome = refined_optimum(compiled, budget, options, guess)
                found, prices = outcome.generated, {FAILURE_ROW: max(outcome.generated.price, 0.0)}
                value, bound, lottery = found.objective, found.lower_bound, outcome.lottery
                values, calls, work = found.values, outcome.calls, outcome.work
                note = "" if found.finished else CUT_SHORT
    except Stop as stop:
        words = str(stop) or "nothing but the model was known by then"
        raise OutOfTimeError(
            f"the time limit ended before there was an answer ({words}): allow more time"
        ) from stop
    bound = max(bound, min(_bound_by_proofs(compiled), value))
    members: Any = lottery.policies  # as pricing pulls them back
    figures = lottery.weights @ np.stack([one.figures for one in members])
    activities = zip(compiled.side, figures[2:].tolist(), strict=True)
    return PartitionedSolution(
        objective=sense.worth(value),
        lower_bound=sense.worth(sense.settled_bound(value, bound)),
        failure=float(figures[1]),
        weights=lottery.weights,
        positions=read_only(np.stack([one.positions for one in members])),
        prices=prices,
        spent={row.condition.name: row.sign * (took - row.offset) for row, took in activities},
        value_function=read_only(compiled.shared.anything if values is None else values),
        run=Run(
            options.method,
            f"column generation on {compiled.shared.shared.ranks.comm.size} ranks, "
            f"{calls} pricing calls",
            calls,
            time.perf_counter() - began,
            work,
        ),
        note=note,
    )


def _bound_by_proofs(compiled: CompiledPartitioned) -> float:
    """The best bound that the proofs of the checkpoint make, those of earlier runs included."""
    best = -np.inf
    for weights, least in compiled.shared.kept.proofs:
        priced = weights[1:] > 0.0
        bounds = compiled.bounds[priced]
        if weights[0] == 1.0 and np.isfinite(bounds).all():
            best = max(best, lagrange_bound(least, weights[1:][priced], bounds))
    return best
