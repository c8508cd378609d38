"""Models that no rank of PETSc holds whole, and questions on them.

Each rank makes, or reads, the rows of its own states. The first one searches with vectors over
states, as it does on any process (``column_generation``, ``methods``): whatever takes rows is an
order to all ranks (``dynamics``).
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt

from ssp_lp.analysis.evaluation import Evaluation
from ssp_lp.analysis.simulation import SimulationReport
from ssp_lp.arrays import RELATIVE_GAP, BoolArray, FloatArray, IntArray, ReadOnlyCopies, read_only
from ssp_lp.cargo import Cargo
from ssp_lp.column_generation.column import CONTRADICTION, Proof, two_sided_gap
from ssp_lp.column_generation.compiled_problem import ATTAINABLE, CompiledExplicit
from ssp_lp.column_generation.explicit_pricing import LARGEST, ExplicitPricing
from ssp_lp.column_generation.search import DualGuess
from ssp_lp.compiled.deadline import Stop, until
from ssp_lp.distributed.layers import CompiledLayers, LayeredShare
from ssp_lp.distributed.order import reordered, values_in_first_order
from ssp_lp.distributed.partitioned_policy import PartitionedPolicy
from ssp_lp.distributed.partitioned_pricing import (
    Checkpoint,
    ChosenPairs,
    CompiledPartitioned,
    labelled_share,
)
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.distributed.share import Share
from ssp_lp.distributed.slab import (
    Slab,
    StateRows,
    balanced_states,
    part_by_rows,
    part_in_file,
    part_of_model,
    rows_checksum,
    tried_states,
    with_facts,
)
from ssp_lp.errors import (
    InfeasibleError,
    ModelError,
    OutOfTimeError,
    SolverError,
    check_between_0_and_1,
    check_whole,
    wrong_argument,
)
from ssp_lp.formulation import Formulation
from ssp_lp.methods.approaches import is_shared
from ssp_lp.methods.columns import refined_optimum
from ssp_lp.methods.incumbent import broken_limit
from ssp_lp.methods.refinement import Proved
from ssp_lp.methods.rows import lagrange_bound, proved_at_prices, rows_optimum
from ssp_lp.model import SSP
from ssp_lp.model.continuous_model import ContinuousModel
from ssp_lp.model.discretise import MIDPOINTS, Quadrature, discretised_rows
from ssp_lp.options import ColumnGeneration, Progress, SolveOptions, options_of
from ssp_lp.policies.policy import MOST_EPISODES
from ssp_lp.problem import compiled_constrained, has_rows, requirements
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import Aim, as_percentage, start_distribution
from ssp_lp.solution import CUT_SHORT, Run, Solution
from ssp_lp.verification.certify import Certificate, certificate_of

_SURE = 1e-6  # relative uncertainty of a price in a checkpoint
_FINER = 1e-3  # of the tolerance, where a complement is minimised, which may be much larger
_NOTHING = 1e-12  # worth that is compared with 0
_MOST_SEED = 2**64 - 1


@dataclass(frozen=True, eq=False, repr=False)
class PartitionedSolution(ReadOnlyCopies):
    """The optimum of a question on a partitioned model, the same on every rank."""

    objective: float  # of the lottery, as measured
    lower_bound: float  # of the optimum, certified; of a greatest one it is an upper bound
    failure: float  # of the lottery, discounted where that is limited
    policy: PartitionedPolicy  # each rank has the decisions of its own states
    figures: FloatArray  # [members, 2 + limits] objective, failure, limited quantities, as measured
    prices: Mapping[str, float]  # multiplier of each row, by name
    spent: Mapping[str, float]  # each limited quantity under the lottery, by name
    value_function: FloatArray  # [process states] the checked sub-solution
    run: Run
    problem: Formulation  # on this rank's part of the model
    note: str = ""
    live: BoolArray | None = field(repr=False, default=None)
    """[states] that the process has, where the ranks have the states in an order of their own."""

    def __repr__(self) -> str:
        """One line: what was asked, the objective with its gap, the failure, and the lottery."""
        return (
            f"PartitionedSolution({type(self.problem).__name__}: objective {self.objective:.9g}, "
            f"gap {self.gap:.1e}, failure {self.failure:.6g}, {self.policy!r})"
        )

    @property
    def gap(self) -> float:
        """Relative gap between the partitioned solution's objective and its bound."""
        return two_sided_gap(self.objective, self.lower_bound)

    @property
    def failure_price(self) -> float:
        """Multiplier of the partitioned solution's failure row."""
        return self.prices.get(FAILURE_ROW, 0.0)

    def on(self, problem: Formulation) -> Solution:
        """The same answer to the same problem on a model that every rank holds whole.

        The policy is gathered on every rank: all of them ask together.

        Args:
            problem: with which ``certify`` and ``evaluate`` go on.

        Raises:
            ModelError: it is no problem, or its model has other states.
        """
        if not isinstance(problem, Formulation):
            raise wrong_argument("problem", "be the question on a model held whole, such as "
                                 "MCMP(model, ...)", problem)  # fmt: skip
        values, layers, order = self.value_function, self.policy.below, self.policy.model.order
        if layers and not has_rows(problem):  # values of its layers alone, which ask for the best
            cap = len(layers[0])
            values = np.broadcast_to(np.inf, (cap, values.size // (cap + 1)))
        elif order is not None and self.live is not None:
            values = values_in_first_order(values, self.live, order)
        is_greatest = problem.semantics.sense.constant is not None
        return Solution(
            problem=problem,
            policy=self.policy.on(problem.model),
            objective=self.objective,
            lower_bound=self.objective if is_greatest else self.lower_bound,
            upper_bound=max(self.lower_bound, self.objective) if is_greatest else None,
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
        ranks.agreed(lambda: check_whole("n_states", n_states))
        ranks.alike("models", {"n_states": n_states})
        tried: dict[int, float] = {}
        for some in ranks.comm.allgather(
            ranks.agreed(lambda: tried_states(ranks.comm, rows, n_states))
        ):
            tried |= some
        first, end = balanced_states(ranks.comm, tried, n_states)
        part = ranks.agreed(lambda: part_by_rows(rows, first, end, n_states, *named))
        return cls._of(ranks, part, first, end)

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

        if not isinstance(world, ContinuousModel):
            raise wrong_argument("world", "be a ContinuousModel", world)
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
        return cls._of(ranks, *part)

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
        order = None if order is None else np.asarray(order)

        def named() -> SSP:
            """The model in the order that was asked for."""
            if not isinstance(model, SSP):
                raise wrong_argument("model", "be an SSP", model)
            return model if order is None else reordered(model, order)

        whole = ranks.agreed(named)
        return cls._of(ranks, *part_of_model(ranks.comm, whole), order)

    @classmethod
    def _of(
        cls, ranks: Ranks, part: SSP, first: int, end: int, order: IntArray | None = None
    ) -> PartitionedModel:
        """The partitioned model of which each rank has a part, from the state first on.

        Raises:
            ModelError: the ranks have parts of different models.
        """
        labels = {name: states.tobytes() for name, states in sorted(part.state_labels.items())}
        ranks.alike("models", {
            "the number of states": part.n_states,
            "the set of goal states (its checksum)": crc32(part.goal_mask.tobytes()),
            "the labels of states": [*labels],
            "the labelled states (their checksum)": crc32(b"".join(labels.values())),
            "the named costs": sorted(part.named_costs),
            "the order (its checksum)": None if order is None else crc32(order.tobytes()),
        })  # fmt: skip
        return cls(ranks.together(lambda: with_facts(ranks.comm, part, first, end)), ranks, order)

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
            criterion: such as ``MCMP``, ``S3P`` or ``MaxProb``, stated with what else: ``start=``,
                ``failure_budget=``, ``discount=``, ``constraints=``, ...; secondary costs by name.
                Where the total cost counts, every step must cost something.
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
        began, method = time.perf_counter(), ColumnGeneration()
        ranks = self.ranks

        def stated() -> tuple[Formulation, SolveOptions]:
            """The question and its options."""
            options = options_of(method, tolerance, began, time_limit, progress)
            problem = self._problem(criterion, asked, method)
            if checkpoint is not None and problem.semantics.charge(problem.ratio) is not None:
                raise ModelError("a checkpoint keeps policies of case M: leave it out of this "
                                 "question")  # fmt: skip
            return problem, options

        problem, options = ranks.agreed(stated)
        ranks.alike("questions", _words(problem) | {"checkpoint": checkpoint is not None})
        if problem.semantics.charge(problem.ratio) is not None:
            return self._solved_by_layers(problem, options, began)
        compiled, share, own = self._held(problem)
        rows = None if checkpoint is None else rows_checksum(self.slab)

        def begun() -> CompiledPartitioned:
            """The question for the first rank, with what an earlier run has left."""
            order = self.order
            told = [criterion.__name__, compiled.told, compiled.bounds.tolist()]
            told += [compiled.semantics, compiled.discount, f"{self.slab.n_states} states"]
            told += [f"rows {rows}", f"start {_words(problem)['the start']}"]
            told += [] if order is None else [f"order {crc32(order.tobytes())}"]
            kept = Checkpoint(checkpoint, ", ".join(map(str, told)))
            return CompiledPartitioned.of(ranks, compiled, own, kept)

        answer, parts = self._answered(begun, options, began)
        positions = np.stack([share.positions(part) for part in parts])
        policy = PartitionedPolicy(self, answer.pop("weights"), positions)
        live: Any = own.augmented
        live = None if self.order is None else live.quotient.node_of >= 0
        return PartitionedSolution(policy=policy, problem=problem, live=live, **answer)

    def _solved_by_layers(
        self, problem: Formulation, options: SolveOptions, began: float
    ) -> PartitionedSolution:
        """The answer on the partitioned model where accumulated cost is told apart.

        Raises:
            ModelError: a step costs nothing, or the costs have no common unit.
        """
        ranks = self.ranks
        compiled = ranks.agreed(lambda: compiled_constrained(problem, by_units=True))
        share = ranks.together(lambda: LayeredShare(ranks, compiled))
        ranks.hold(share)

        begun = partial(CompiledLayers.begun, ranks, share)
        answer, parts = self._answered(begun, options, began)
        each = [share.layers.positions(int(number)) for (number,) in parts]
        policy = PartitionedPolicy(
            self,
            answer.pop("weights"),
            np.stack([layers[-1] for layers in each]),
            tuple(layers[:-1] for layers in each),
            share.layers.base.unit,
        )
        return PartitionedSolution(policy=policy, problem=problem, **answer)

    def _answered(
        self, begun: Callable[[], CompiledPartitioned], options: SolveOptions, began: float
    ) -> tuple[dict[str, Any], list[IntArray]]:
        """What the first rank finds on the partitioned model, and each rank's part of the members.

        Args:
            begun: as :func:`_searched` takes it.
            options: likewise.
            began: likewise.
        """
        ranks, members = self.ranks, list[ChosenPairs]()

        def searched() -> dict[str, Any]:
            """What all ranks hear of the answer, on the first rank, which keeps the members."""
            answer, lottery = _searched(begun, options, began)
            members.extend(lottery)
            return answer

        answer = ranks.answered(Cargo(), searched)
        parts = [list(part) for part in zip(*(one.parts for one in members), strict=True)]
        own: list[IntArray] = ranks.comm.scatter(parts or None)
        return answer, own

    def evaluate(self, policy: PartitionedPolicy, criterion: type[Any], **asked: Any) -> Evaluation:
        """Evaluate a policy on the rows of all ranks, exactly, as ``ssp_lp.evaluate`` does.

        All ranks ask together, and get the same.

        Args:
            policy: on this model; an answer's, or one that was loaded.
            criterion: such as ``MCMP``, stated as in :meth:`solve`: which start, what failing
                costs, which quantities are limited.

        Raises:
            ModelError: the policy is of another model, has no decision in a state that it reaches
                or gives up where it may not; or something is asked that needs the whole graph.
        """
        problem = self._measured(policy, criterion, asked)
        return self.ranks.together(lambda: policy.evaluated(problem)[0])

    def certify(self, answer: PartitionedSolution) -> Certificate:
        """Certify an answer: recompute both sides from the rows of all ranks.

        The policy is evaluated on the model. The value function is checked as it stands, by one
        backup of each rank's rows, rounding counted against it, to bound every policy's cost at
        the stated prices; where the time ended before there was one, the best is looked for.
        All ranks ask together, and get the same.

        Returns:
            The certificate. It refuses a policy that breaks the budget or a limit, or is worth
            something else than is stated, and a bound that the value function does not prove.
        """
        ranks = self.ranks

        def checked() -> Formulation:
            """The question that was answered."""
            if not isinstance(answer, PartitionedSolution):
                raise wrong_argument("answer", "be a PartitionedSolution, as solve() gives", answer)
            self._check_policy(answer.policy)
            return answer.problem

        problem = ranks.agreed(checked)
        ranks.alike("questions", _words(problem))
        evaluation, _ = ranks.together(lambda: answer.policy.evaluated(problem))
        compiled, _, own = self._held(problem)

        def proved() -> Proved:
            """What the prices and the values prove, on the first rank."""
            kept = Checkpoint(None, "")
            return _proved(CompiledPartitioned.of(ranks, compiled, own, kept), answer, evaluation)

        found = ranks.answered(Cargo(), proved)
        reason = found.reason or broken_limit(problem, evaluation)
        sides = evaluation, found.bound, found.allowed
        certificate = certificate_of(*sides, reason)
        if certificate.accepted and (claim := _false_claim(answer, evaluation, found.bound)):
            return certificate_of(*sides, claim)
        return certificate

    def simulate(
        self,
        policy: PartitionedPolicy,
        criterion: type[Any],
        *,
        episodes: int = 10_000,
        seed: int,
        max_steps: int = 10_000,
        record: int = 0,
        confidence: float = 0.95,
        **asked: Any,
    ) -> SimulationReport:
        """Play episodes and count how they end, as ``ssp_lp.simulate`` does.

        An episode is with the rank that owns its state, and goes to the owner of the next one. What
        is drawn depends on the seed, the episode and the step alone, so that any number of ranks
        plays the same episodes. All ranks ask together, and get the same.

        Args:
            policy: on this model.
            criterion: such as ``MCMP``, stated as in :meth:`solve`.
            episodes: how many to play.
            seed: a number.
            max_steps: steps after which an episode counts as unfinished.
            record: keep the paths, numbers of states, of this many first episodes.
            confidence: of the intervals; the upper ends of mean costs count the dearest step of the
                model in every step.

        Raises:
            ModelError: wrong arguments, or as of :meth:`evaluate`.
        """

        def check() -> None:
            """Check what is not the question."""
            check_between_0_and_1("confidence", confidence, as_percentage(confidence))
            check_whole("episodes", episodes, most=MOST_EPISODES)
            check_whole("max_steps", max_steps)
            check_whole("record", record, 0)
            check_whole("seed", seed, 0, _MOST_SEED)

        self.ranks.agreed(check)
        settings = episodes, seed, max_steps, record, float(confidence)
        names = "episodes", "seed", "max_steps", "record", "confidence"
        self.ranks.alike("simulations", dict(zip(names, settings, strict=True)))
        problem = self._measured(policy, criterion, asked)
        return self.ranks.together(lambda: policy.simulated(problem, *settings))

    def _held(self, problem: Formulation) -> tuple[CompiledExplicit, Share, ExplicitPricing]:
        """A problem on the partitioned model, compiled, and the rank holds its rows."""
        ranks = self.ranks
        compiled = ranks.agreed(lambda: compiled_constrained(problem))
        share, own = ranks.together(lambda: labelled_share(ranks, compiled))
        ranks.hold(share)
        return compiled, share, own

    def _measured(
        self, policy: PartitionedPolicy, criterion: type[Any], asked: Mapping[str, Any]
    ) -> Formulation:
        """The question by which a policy of the partitioned model is measured, on every rank."""

        def checked() -> Formulation:
            """The question, where the policy is one of this model."""
            self._check_policy(policy)
            return self._problem(criterion, asked)

        problem = self.ranks.agreed(checked)
        self.ranks.alike("questions", _words(problem))
        self.ranks.alike("policies", {"the members' weights": policy.weights.tolist()})
        return problem

    def _check_policy(self, policy: PartitionedPolicy) -> None:
        """Raise :class:`ModelError` unless a policy is one of this partitioned model."""
        if not isinstance(policy, PartitionedPolicy):
            raise wrong_argument("policy", "be a PartitionedPolicy, such as answer.policy", policy)
        if policy.model.slab is not self.slab:
            raise ModelError("the policy is for another model: PartitionedPolicy.load() reads it "
                             "for this one")  # fmt: skip
        if policy.below:
            raise ModelError("a policy that acts on the cost paid is measured on a model held "
                             "whole: answer.on(problem)")  # fmt: skip
        policy.check()

    def _problem(
        self, criterion: type[Any], asked: Mapping[str, Any], method: ColumnGeneration | None = None
    ) -> Formulation:
        """The question on the rank's part of the partitioned model, checked.

        Args:
            criterion: the class.
            asked: its arguments.
            method: that is to solve it; None: a policy is measured.

        Raises:
            ModelError: another question, or one that needs the whole graph.
        """
        if not isinstance(criterion, type):
            raise wrong_argument("criterion", "be a class such as MCMP, its arguments beside it",
                                 criterion)  # fmt: skip
        if asked.get("horizon") is not None or asked.get("reach_fraction") is not None:
            raise ModelError("a partitioned model has no horizon and no reach_fraction: state the "
                             "budget, and steps as a part of the states")  # fmt: skip
        try:
            problem: Formulation = criterion(self.slab, **asked)
        except TypeError as error:
            raise ModelError(f"{criterion.__name__} cannot be stated so: {error}") from error
        if method is None and problem.semantics.counts_law:
            raise ModelError(f"{criterion.__name__} makes something of the law of total costs, "
                             "which is not worked out on a partitioned model")  # fmt: skip
        greatest = problem.semantics.aim is Aim.GREATEST_GOAL  # failing is what is minimised
        if method is not None and not (greatest or is_shared(requirements(problem))):
            raise ModelError("a partitioned model answers costs within a failure budget, not "
                             f"{criterion.__name__} as it is asked")  # fmt: skip
        if method is not None and getattr(problem, "cost_levels", None):
            raise ModelError("a partitioned model knows no cost_levels: its totals are multiples "
                             "of a unit")  # fmt: skip
        is_slack = (problem.failure_budget or 0.0) >= 1.0
        if method is not None and problem.ratio and has_rows(problem) and is_slack:
            raise ModelError(f"{criterion.__name__} within limits takes a failure budget below 1 "
                             "on a partitioned model")  # fmt: skip
        if method is not None and problem.semantics.forbids_failing:
            raise ModelError(f"{criterion.__name__} forbids failing, which asks for the whole "
                             "graph: on a partitioned model give a failure budget")  # fmt: skip
        try:
            is_told = problem.unrolled is problem
        except ModelError:
            is_told = False
        if not is_told:
            raise ModelError("a limit counts what may come after failing, which a partitioned "
                             "model does not tell apart: visits() counts until then")  # fmt: skip
        return problem


def _words(problem: Formulation) -> dict[str, Any]:
    """What is asked of a partitioned model, by name, in words and numbers that ranks compare."""
    begun = start_distribution(problem.model, problem.start)
    places = np.flatnonzero(begun)
    several = crc32(places.tobytes() + begun[places].tobytes())
    return {
        "the criterion": type(problem).__name__,
        "the start": f"state {places[0]}" if places.size == 1 else f"several, checksum {several}",
        "failure_budget": problem.failure_budget,
        "discount": problem.discount,
        "cost_cap": problem.cost_cap,
        "what an episode is worth": re.sub(r" at 0x\w+", "", repr(problem.semantics)),
        "the limits": [(one.name, one.lower, one.upper) for one in problem.conditions],
    }


def _searched(
    begun: Callable[[], CompiledPartitioned], options: SolveOptions, began: float
) -> tuple[dict[str, Any], Sequence[ChosenPairs]]:
    """The search's answer to a question on a partitioned model, on the first rank, and its members.

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
    proved, at = _best_proof(compiled)
    if min(proved, value) > bound + CONTRADICTION * abs(value):  # an earlier run's, without values
        prices, values = at, None
    bound = max(bound, min(proved, value))
    members: Any = lottery.policies  # as pricing pulls them back
    figures = _stated_figures(compiled, members)
    totals = (lottery.weights @ figures).tolist()
    limited = [row.condition.name for row in compiled.side]
    answer = {
        "objective": sense.worth(value),
        "lower_bound": sense.worth(sense.settled_bound(value, bound)),
        "failure": totals[1],
        "figures": read_only(figures),
        "weights": lottery.weights,
        "prices": prices,
        "spent": dict(zip(limited, totals[2:], strict=True)),
        "value_function": read_only(compiled.shared.anything if values is None else values),
        "run": Run(
            options.method,
            f"column generation on {compiled.ranks.comm.size} ranks, {calls} pricing calls",
            calls,
            time.perf_counter() - began,
            work,
        ),
        "note": note,
    }
    return answer, members


def _stated_figures(compiled: CompiledPartitioned, members: Sequence[ChosenPairs]) -> FloatArray:
    """Objective, failure and limited quantities of each member as a partitioned answer has them."""
    figures = np.stack([one.figures for one in members])
    figures[:, 0] = [compiled.sense.worth(cost) for cost in figures[:, 0].tolist()]
    if compiled.ratio:  # each member's own, given that it succeeds
        with np.errstate(divide="ignore", invalid="ignore"):
            figures[:, 0] /= 1.0 - figures[:, 1]
    for place, row in enumerate(compiled.side, 2):
        figures[:, place] = row.sign * (figures[:, place] - row.offset)
    return figures


def _proved(
    compiled: CompiledPartitioned, answer: PartitionedSolution, evaluation: Evaluation
) -> Proved:
    """What prices and values prove of an answer on a partitioned model, on the first rank."""
    pricing, values = compiled.pricing(), np.asarray(answer.value_function)
    budget = 1.0 if compiled.budget is None else compiled.budget
    try:
        if evaluation.limited_failure > budget * (1.0 + ATTAINABLE):  # the least, or too much
            compiled = compiled.settled()
            budget = budget if compiled.budget is None else compiled.budget
        prices, is_known = answer.prices, bool(np.isfinite(values).all())

        def prove(weights: FloatArray) -> Proof:
            """What the values prove as they stand; without any, the best that can be proved."""
            if is_known:
                return pricing.confirmed(weights, values)
            return pricing.prove(weights, pricing.minimise(weights))

        return proved_at_prices(compiled, evaluation, budget, prices, prove)
    except (SolverError, ModelError, InfeasibleError) as error:
        return Proved(evaluation.objective, compiled.sense.worth(0.0), budget, str(error))


def _false_claim(answer: PartitionedSolution, evaluation: Evaluation, bound: float) -> str:
    """What an answer on a partitioned model states that was not found again; empty: nothing."""
    room = CONTRADICTION * max(abs(evaluation.objective), abs(answer.objective)) + _NOTHING
    if not abs(evaluation.objective - answer.objective) <= room:
        return f"the policy is worth {evaluation.objective:.12g}, not {answer.objective:.12g}"
    if not abs(evaluation.limited_failure - answer.failure) <= CONTRADICTION:
        return f"the policy fails with {evaluation.limited_failure:.12g}, not {answer.failure:.12g}"
    if not answer.lower_bound - bound <= room:
        return f"the value function proves {bound:.12g}, not {answer.lower_bound:.12g}"
    return ""


def _best_proof(compiled: CompiledPartitioned) -> tuple[float, dict[str, float]]:
    """The best bound of the checkpoint's proofs, those of earlier runs included, and its prices."""
    best, at = -np.inf, np.zeros(0)
    for weights, least in compiled.shared.kept.proofs:
        priced = weights[1:] > 0.0
        bounds = compiled.bounds[priced]
        if weights[0] == 1.0 and np.isfinite(bounds).all() and (weights <= LARGEST).all():
            bound = lagrange_bound(least, weights[1:][priced], bounds)
            best, at = max((best, at), (bound, weights[1:]), key=lambda proof: proof[0])
    return best, dict(zip(compiled.names, at.tolist(), strict=False))
