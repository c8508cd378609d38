"""Models that no rank of PETSc holds whole, and questions on them.

Each rank makes, or reads, the rows of its own states. The first one searches with vectors over
states, as it does on any process (``column_generation``, ``methods``): whatever takes rows is an
order to all ranks (``dynamics``).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import (
    RELATIVE_GAP,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    read_only,
)
from ssp_lp.cargo import Cargo
from ssp_lp.column_generation.column import two_sided_gap
from ssp_lp.column_generation.compiled_problem import CompiledExplicit
from ssp_lp.column_generation.search import DualGuess
from ssp_lp.compiled.deadline import Stop, until
from ssp_lp.distributed.dynamics import PartitionedDynamics
from ssp_lp.distributed.layers import CompiledLayers, LayeredShare, OwnLayers
from ssp_lp.distributed.order import inverse, reordered, values_in_first_order
from ssp_lp.distributed.partitioned_pricing import (
    Checkpoint,
    CompiledPartitioned,
    PartitionedPricing,
    labelled_share,
)
from ssp_lp.distributed.petsc import Petsc
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.distributed.slab import (
    Slab,
    StateRows,
    balanced_states,
    part_by_rows,
    part_in_file,
    part_of_model,
    tried_states,
    with_facts,
)
from ssp_lp.errors import ModelError, OutOfTimeError
from ssp_lp.formulation import Formulation
from ssp_lp.methods.approaches import refusal
from ssp_lp.methods.columns import refined_optimum
from ssp_lp.methods.rows import lagrange_bound, rows_optimum
from ssp_lp.model import SSP
from ssp_lp.model.continuous_model import ContinuousModel
from ssp_lp.model.discretise import MIDPOINTS, Quadrature, discretised_rows
from ssp_lp.options import ColumnGeneration, Progress, SolveOptions, options_of
from ssp_lp.policies import CostAwarePolicy, DeterministicPolicy, MixedPolicy, Policy
from ssp_lp.problem import compiled_constrained, has_rows
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.solution import CUT_SHORT, Run, Solution

_SURE = 1e-6  # relative uncertainty of a price in a checkpoint
_FINER = 1e-3  # of the tolerance, where a complement is minimised, which may be much larger


@dataclass(frozen=True, eq=False)
class ActionsByCost:
    """What the members of a lottery do by accumulated cost, as each rank has it of its states."""

    slab: Slab = field(repr=False)
    unit: float  # cost of a layer
    positions: tuple[IntArray, ...]  # [layers + 1, own states] each, as PartitionedSolution's

    @property
    def cap(self) -> int:
        """Number of layers below the last, which stands for all costs beyond them."""
        return len(self.positions[0]) - 1

    def members(self, model: SSP, beyond: IntArray) -> Iterator[Policy]:
        """The members on a whole model; all ranks at the same time.

        Args:
            model: on which this process holds all pairs.
            beyond: what each does from the cap on, as pairs of the model or codes, [states].
        """
        never = np.full(model.n_states, np.inf)
        for own, tail in zip(self.positions, beyond, strict=True):
            below = np.concatenate(self.slab.comm.allgather(own[:-1]), axis=1)
            yield CostAwarePolicy(model, self.unit, below, tail[None, :], never)


@dataclass(frozen=True, eq=False)
class PartitionedSolution(ReadOnlyCopies):
    """The optimum of a question on a partitioned model, the same on every rank."""

    objective: float  # of the lottery, as measured
    lower_bound: float  # of the optimum, certified
    failure: float  # of the lottery, discounted where that is limited
    weights: FloatArray  # [members] of the lottery
    figures: FloatArray  # [members, 2 + limits] objective, failure, limited quantities, as measured
    positions: IntArray  # [members, states] of actions, or GIVE_UP_CODE or UNDECIDED
    """Where accumulated cost is told apart, what is done from the cap on."""
    prices: Mapping[str, float]  # multiplier of each row, by name
    spent: Mapping[str, float]  # each limited quantity under the lottery, by name
    value_function: FloatArray  # [process states] the checked sub-solution
    run: Run
    note: str = ""
    layers: ActionsByCost | None = None  # where accumulated cost is told apart

    @property
    def gap(self) -> float:
        """Relative gap between the partitioned solution's objective and its bound."""
        return two_sided_gap(self.objective, self.lower_bound)

    @property
    def failure_price(self) -> float:
        """Multiplier of the partitioned solution's failure row."""
        return self.prices.get(FAILURE_ROW, 0.0)

    def on(self, problem: Formulation) -> Solution:
        """The same answer to the same problem on a model that this process holds whole.

        Where accumulated cost is told apart all ranks ask at the same time: each has its own part.

        Args:
            problem: with which ``certify`` and ``evaluate`` go on.
        """
        model, values, layers = problem.model, self.value_function, self.layers
        own = self.positions.astype(np.int64)
        pairs = np.where(own >= 0, own + model.pair_offsets[:-1], own)
        members: Iterable[Policy]
        if layers is None:
            members = [DeterministicPolicy(model, decision) for decision in pairs]
        else:
            members = layers.members(model, pairs)
            if not has_rows(problem):  # values of its layers alone, which ask for the best
                values = np.broadcast_to(np.inf, (layers.cap, values.size // (layers.cap + 1)))
        return Solution(
            problem=problem,
            policy=MixedPolicy(tuple(members), self.weights),
            objective=self.objective,
            lower_bound=self.lower_bound,
            failure_price=self.failure_price + problem.semantics.penalty,
            value_function=values,
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
    order: IntArray | None = field(repr=False, default=None)  # [states] of the model's own numbers

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
        ranks, named = Ranks.all(), (goal_states, states, state_labels)
        tried: dict[int, float] = {}
        for some in ranks.comm.allgather(
            ranks.agreed(lambda: tried_states(ranks.comm, rows, n_states))
        ):
            tried |= some
        first, end = balanced_states(ranks.comm, tried, n_states)
        part = ranks.agreed(lambda: part_by_rows(rows, first, end, n_states, *named))
        return cls(ranks.together(lambda: with_facts(ranks.comm, part, first, end)), ranks)

    @classmethod
    def from_continuous(
        cls, world: ContinuousModel, points: Quadrature = MIDPOINTS
    ) -> PartitionedModel:
        """Discretise each rank's cells of a continuous world: the rows of ``discretise``'s model.

        Args:
            world: the step function and the grid, the same on every rank.
            points: a ``Quadrature``; samples are drawn in one order and cannot be shared.

        Raises:
            ModelError: samples are asked for, or what ``discretise`` raises, on every rank.
        """

        def rows(first: int, end: int) -> StateRows:
            """The rows of some cells, and of the ends behind them."""
            actions, found = discretised_rows(world, points, first, end)
            return StateRows(actions, np.diff(found.outcome_offsets), *found[1:])

        if not isinstance(points, Quadrature):
            raise ModelError(f"the ranks share points such as Quadrature(4), not {points!r}")
        labels = {name: [world.end_state(name)] for name in world.dead_ends}
        goal = [world.end_state("goal")]
        return cls.from_rows(rows, world.n_states, goal, state_labels=labels)

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
        part = ranks.agreed(lambda: part_in_file(ranks.comm, path))
        return cls(ranks.together(lambda: with_facts(ranks.comm, *part)), ranks)

    @classmethod
    def from_model(cls, model: SSP, order: IntArray | None = None) -> PartitionedModel:
        """Take each rank's part of a model that all ranks have.

        Args:
            model: the same on every rank.
            order: of its states, among the ranks alone, such as :func:`narrow_order`'s; what is
                asked and answered is in the model's own.

        Raises:
            ModelError: some state does not come once in the order.
        """
        ranks = Ranks.all()
        named = model if order is None else ranks.agreed(lambda: reordered(model, order))
        part = part_of_model(ranks.comm, named)
        return cls(ranks.together(lambda: with_facts(ranks.comm, *part)), ranks, order)

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
        """Solve a question within a failure budget, on all ranks together.

        Args:
            criterion: such as ``MCMP`` or ``S3P``, stated with what else is given: ``start=``,
                ``failure_budget=``, ``discount=``, ``constraints=``, ...; secondary costs by name.
                Where the total cost counts, every step must cost something.
            tolerance: relative gap to reach.
            time_limit: seconds after which the best lottery so far is the answer, if there is one.
            progress: as ``solve`` takes it; called on the first rank.
            checkpoint: a file of the first rank's, to which each policy and each proof goes that is
                found; a later run of the same question, on any number of ranks, begins with them.
                For questions of case M.

        Raises:
            ModelError: another question, or one that needs the whole graph.
            InfeasibleError: no policy keeps to the budget and the limits.
            OutOfTimeError: the time ended before there was an answer.
        """
        began, method = time.perf_counter(), ColumnGeneration(pricing=Petsc())
        options = options_of(method, tolerance, began, time_limit, progress)
        ranks = self.ranks
        compiled = ranks.agreed(lambda: self._compiled(criterion, method, asked))
        if compiled.charge is not None:
            return self._solved_by_layers(compiled, options, began, checkpoint)
        share, own = ranks.together(lambda: labelled_share(ranks, compiled))
        ranks.hold(share)

        def searched() -> PartitionedSolution:
            """The answer, on the first rank."""
            order = self.order
            asked_for = [criterion.__name__, compiled.told, compiled.bounds.tolist()]
            asked_for += [compiled.semantics, compiled.discount, f"{self.slab.n_states} states"]
            asked_for += [] if order is None else [f"order {crc32(order.tobytes())}"]
            kept = Checkpoint(checkpoint, ", ".join(map(str, asked_for)))
            held = PartitionedDynamics.held_by(ranks)
            pricing = PartitionedPricing(own.augmented, rows=own.rows, shared=held, kept=kept)
            begun = CompiledPartitioned.of(compiled, pricing)
            answer = _searched(lambda: begun, options, began)
            if order is None:
                return answer
            live: Any = own.augmented
            live = live.quotient.node_of >= 0
            return replace(
                answer,
                positions=read_only(answer.positions[:, inverse(order)]),
                value_function=values_in_first_order(answer.value_function, live, order),
            )

        return ranks.answered(Cargo(), searched)

    def _solved_by_layers(
        self,
        compiled: CompiledExplicit,
        options: SolveOptions,
        began: float,
        checkpoint: str | Path | None,
    ) -> PartitionedSolution:
        """The answer on the partitioned model where accumulated cost is told apart.

        Raises:
            ModelError: a checkpoint is asked for, or a step costs nothing.
        """
        if checkpoint is not None:
            raise ModelError("a checkpoint keeps policies of case M: leave it out of this question")
        ranks = self.ranks
        share = ranks.together(lambda: LayeredShare(ranks, OwnLayers.of(ranks, compiled), 1))
        ranks.hold(share)
        begun = partial(CompiledLayers.begun, ranks, share)
        answer = ranks.answered(Cargo(), lambda: _searched(begun, options, began))
        own = share.layers
        layers = tuple(own.positions(int(number)) for number in answer.positions[:, 0])
        positions = [np.concatenate(ranks.comm.allgather(each[-1])) for each in layers]
        return replace(
            answer,
            positions=read_only(np.stack(positions)),
            layers=ActionsByCost(self.slab, own.base.unit, layers),
        )

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
        charge = problem.semantics.charge(problem.ratio)
        is_layered = charge is not None and problem.failure_budget is not None
        if is_layered:
            if problem.semantics.risk is not None or getattr(problem, "cost_levels", None):
                raise ModelError(f"{criterion.__name__} is not answered on a partitioned model, "
                                 "nor with cost_levels")  # fmt: skip
        elif (refused := refusal(problem, method)) is not None:
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
        return compiled_constrained(problem, by_units=is_layered)


def _searched(
    begun: Callable[[], CompiledPartitioned], options: SolveOptions, began: float
) -> PartitionedSolution:
    """The search's answer to a question on a partitioned model, on the first rank.

    Args:
        begun: compiles the question for the first rank.
        options: tolerance and limits.
        began: on the clock of ``time.perf_counter``.

    Raises:
        OutOfTimeError: the time ended before there was an answer.
    """
    try:
        with until(options.deadline):
            compiled = begun()
            sense, budget, kept = compiled.sense, compiled.budget, compiled.shared.kept
            budget = 1.0 if budget is None else budget
            if compiled.side or compiled.objective is not None:
                optimum = rows_optimum(compiled, options)
                prices, note = dict(optimum.prices), optimum.note
                value, bound, lottery = optimum.value, optimum.bound, optimum.policy
                values, calls, work = optimum.values, optimum.calls, optimum.work
            else:
                price = kept.price
                guess = DualGuess(price, _SURE) if price else None
                finer = 1.0 if sense.constant is None else _FINER
                exactly = replace(options, tolerance=finer * options.tolerance)
                outcome = refined_optimum(compiled, budget, exactly, guess)
                found = outcome.generated
                beyond = found.objective if compiled.ratio else 0.0
                prices = {FAILURE_ROW: max(found.price - beyond, 0.0)}
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
    figures = np.stack([one.figures for one in members])
    figures[:, 0] = [sense.worth(cost) for cost in figures[:, 0].tolist()]
    for place, row in enumerate(compiled.side, 2):
        figures[:, place] = row.sign * (figures[:, place] - row.offset)
    totals = (lottery.weights @ figures).tolist()
    limited = [row.condition.name for row in compiled.side]
    return PartitionedSolution(
        objective=sense.worth(value),
        lower_bound=sense.worth(sense.settled_bound(value, bound)),
        failure=totals[1],
        weights=lottery.weights,
        figures=read_only(figures),
        positions=read_only(np.stack([one.positions for one in members])),
        prices=prices,
        spent=dict(zip(limited, totals[2:], strict=True)),
        value_function=read_only(compiled.shared.anything if values is None else values),
        run=Run(
            options.method,
            f"column generation on {compiled.ranks.comm.size} ranks, {calls} pricing calls",
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
