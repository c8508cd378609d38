"""Models whose rows lie with several ranks, and questions on them."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import RELATIVE_GAP, FloatArray, IntArray, ReadOnlyCopies, read_only
from ssp_lp.column_generation.column import Column, two_sided_gap
from ssp_lp.column_generation.search import DualGuess
from ssp_lp.compiled.deadline import Stop
from ssp_lp.distributed.part import (
    Described,
    ModelFile,
    Part,
    StateRows,
    balanced_bounds,
    made_part,
)
from ssp_lp.distributed.policy import PartitionedPolicy, model_words
from ssp_lp.distributed.process import CompiledPartitioned, OwnDecisions, PartitionedProcess
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.errors import ModelError, OutOfTimeError, SolverError, check_whole, wrong_argument
from ssp_lp.formulation import Formulation
from ssp_lp.methods.columns import refined_optimum
from ssp_lp.methods.rows import rows_optimum
from ssp_lp.model import SSP
from ssp_lp.model.continuous_model import ContinuousModel
from ssp_lp.model.discretise import MIDPOINTS, Quadrature, discretised_rows
from ssp_lp.options import ColumnGeneration, Progress, SolveOptions, options_of
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, MixedPolicy
from ssp_lp.problem import compiled_constrained
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.solution import CUT_SHORT, Run

_SURE = 1e-6  # relative uncertainty of a price in a checkpoint
_FINER = 1e-3  # of the tolerance, where a complement is minimised, which may be much larger


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
    value_function: FloatArray  # [own nodes of the process] the checked sub-solution
    run: Run
    problem: Formulation  # on this rank's part of the model
    note: str = ""

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


@dataclass(frozen=True, eq=False)
class Measured:
    """What a policy of a partitioned model is worth."""

    objective: float
    failure: float  # discounted where that is limited
    spent: Mapping[str, float]  # each limited quantity, by name
    figures: FloatArray  # [members, 2 + limits] the same of each member


@dataclass(frozen=True, eq=False)
class PartitionedModel:
    """A model whose rows lie with several ranks, by state, and nowhere all together.

    Under ``mpiexec -n 4 python plan.py`` every rank makes its part, and asks the same:

        model = PartitionedModel.from_rows(rows, n_states, goal_states=[n_states - 1])
        answer = model.solve(MCMP, start=0, failure_budget=0.05)
    """

    part: Part  # this rank's
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
            states: labels of all states, which every rank keeps; their numbers if left out.
            state_labels: names for sets of states, each given by its states.

        Raises:
            ModelError: naming the state and the action at fault, on every rank.
        """
        ranks = Ranks()

        def described() -> Described:
            """Check what is not rows; labels of states become numbers."""
            check_whole("n_states", n_states)
            labels, members = state_labels or {}, dict[str, Any]()
            if states is not None and not len(set(states)) == len(states) == n_states:
                raise ModelError(f"states must be {n_states} distinct labels")
            number = {} if states is None else {label: k for k, label in enumerate(states)}
            for name, found in labels.items():
                strange = [k for k in found if k not in number] if number else [
                    k for k in found if not 0 <= k < n_states]  # fmt: skip
                if strange:
                    raise ModelError(f"state_labels[{name!r}]: {strange[0]!r} is no state")
                members[name] = np.array([number[k] for k in found] if number else [*found], int)
            return Described(n_states, _checked_goals(goal_states, n_states), states, members)

        described_model = ranks.agreed(described)
        cls._alike(ranks, described_model)
        bounds = balanced_bounds(ranks, rows, n_states)
        return cls(ranks.together(lambda: made_part(ranks, rows, described_model, bounds)), ranks)

    @staticmethod
    def _alike(ranks: Ranks, described: Described) -> None:
        """Check that all ranks describe the same model.

        Raises:
            ModelError: naming what differs.
        """
        labels = {name: np.unique(of).tobytes() for name, of in described.state_labels.items()}
        ranks.alike("models", {
            "n_states": described.n_states,
            "the set of goal states (its checksum)": crc32(np.unique(described.goal_states).data),
            "the labels of states": [*labels],
            "the labelled states (their checksum)": crc32(b"".join(labels.values())),
        })  # fmt: skip

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
            """Return the rows of some cells, and of the ends behind them."""
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
        """Read each rank's part of a file of ``save_model``; actions are numbers by state.

        Args:
            path: of the file, which every rank can open.

        Raises:
            ModelError: naming the file: it is none of this format, or damaged.
            OSError: the file cannot be opened.
        """
        ranks = Ranks()
        file, bounds = ranks.agreed(lambda: (read := ModelFile(path), read.bounds(ranks)))
        cls._alike(ranks, file.described)
        most = max(bounds[1] - bounds[0], 1)
        return cls(ranks.together(
            lambda: made_part(ranks, file.rows, file.described, bounds, most)), ranks)  # fmt: skip

    @classmethod
    def from_model(cls, model: SSP) -> PartitionedModel:
        """Take each rank's part of a model that all ranks have.

        Args:
            model: the same on every rank.
        """
        if not isinstance(model, SSP):
            raise wrong_argument("model", "be an SSP", model)

        def rows(first: int, end: int) -> StateRows:
            """Return the rows of some states."""
            pairs = slice(*model.pair_offsets[[first, end]].tolist())
            own = slice(*model.outcome_offsets[[pairs.start, pairs.stop]].tolist())
            arrays = model.successors, model.probabilities, model.costs
            named = {name: costs[own] for name, costs in model.named_costs.items()}
            actions, outcomes = np.diff(model.pair_offsets), np.diff(model.outcome_offsets)
            return StateRows(actions[first:end], outcomes[pairs], *(a[own] for a in arrays), named)

        labels = {name: [model.states[k] for k in of] for name, of in model.state_labels.items()}
        states = None if isinstance(model.states, range) else model.states
        goals = np.flatnonzero(model.goal_mask)
        return cls.from_rows(rows, model.n_states, goals, states=states, state_labels=labels)

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
        """Solve a question of case M, on all ranks together.

        Args:
            criterion: such as ``MCMP`` or ``MaxProb``, stated with what else: ``start=``,
                ``failure_budget=``, ``discount=``, ``constraints=``, ...; secondary costs by name.
            tolerance: relative gap to reach.
            time_limit: seconds after which the best lottery so far is the answer, if there is one.
            progress: as ``solve`` takes it; called on the first rank.
            checkpoint: a folder to which each policy goes that is found, each rank's part of it; a
                later run of the same question, on any number of ranks, begins with them.

        Raises:
            ModelError: another question, or one that needs the whole graph.
            InfeasibleError: no policy keeps to the budget and the limits.
            OutOfTimeError: the time ended before there was an answer.
        """
        began, ranks, method = time.perf_counter(), self.ranks, ColumnGeneration()
        told = progress if ranks.comm.rank == 0 else None
        options = ranks.agreed(lambda: options_of(method, tolerance, began, time_limit, told))
        problem = self._stated(criterion, asked)
        alike = {"tolerance": tolerance, "time_limit": time_limit, "checkpoint": str(checkpoint)}
        ranks.alike("options", alike)
        return ranks.together(lambda: self._solved(problem, options, began, checkpoint))

    def evaluate(self, policy: PartitionedPolicy, criterion: type[Any], **asked: Any) -> Measured:
        """Evaluate a policy on the rows of all ranks, with a bound of the error.

        All ranks ask together, and get the same. As in ``ssp_lp.evaluate`` a policy has failed as
        soon as it has lost the goal by its own steps, where it may give up.

        Args:
            policy: on this model; an answer's, or one that was loaded.
            criterion: such as ``MCMP``, stated as in :meth:`solve`.

        Raises:
            ModelError: the policy is of another model, has no decision in a state that it reaches
                or gives up where it may not.
        """
        problem = self._stated(criterion, asked)

        def checked() -> None:
            """Check that the policy is one of this model."""
            if not isinstance(policy, PartitionedPolicy):
                wanted = "be a PartitionedPolicy, such as answer.policy"
                raise wrong_argument("policy", wanted, policy)
            if policy.part.described is not self.part.described:
                raise ModelError("the policy is for another model: PartitionedPolicy.load() reads "
                                 "it for this one")  # fmt: skip
            policy.check()

        self.ranks.agreed(checked)
        self.ranks.alike("policies", {"the members' weights": policy.weights.tolist()})
        return self.ranks.together(lambda: self._measured(policy, problem))

    def _stated(self, criterion: type[Any], asked: Mapping[str, Any]) -> Formulation:
        """State a question on the rank's part of the model, with the states that it names.

        Raises:
            ModelError: another question, or one that needs the whole graph, on every rank.
        """
        part, ranks = self.part, self.ranks
        while True:
            problem, error = None, None
            try:
                problem = _checked_problem(criterion, part, asked)
            except Exception as raised:
                error = raised
            wanted = set().union(*ranks.comm.allgather(part.wanted))
            part.wanted.clear()
            if not wanted:
                break
            part = part.knowing(sorted(wanted))  # what a rank did not know may have been at fault

        def made() -> Formulation:
            """Return the problem, or raise what was wrong with it."""
            if problem is None:
                raise error or ModelError("the question cannot be stated")
            return problem

        stated = ranks.agreed(made)
        ranks.alike("questions", _words(stated))
        return stated

    def _compiled(self, problem: Formulation, **more: Any) -> CompiledPartitioned:
        """Compile a question on this rank's part; bounds of rows are those of the first rank."""
        plain = self.ranks.agreed(lambda: compiled_constrained(problem))
        own = [*plain.side, *([] if plain.objective is None else [plain.objective])]
        told = self.ranks.comm.bcast([_numbers_of(row) for row in own])
        rows = [_with_numbers(row, numbers) for row, numbers in zip(own, told, strict=True)]
        stated = {one.name: getattr(plain, one.name) for one in fields(plain)}
        stated["side"] = tuple(rows[: len(plain.side)])
        stated["objective"] = None if plain.objective is None else rows[-1]
        return CompiledPartitioned(**stated, more=more)

    def _solved(
        self,
        problem: Formulation,
        options: SolveOptions,
        began: float,
        checkpoint: str | Path | None,
    ) -> PartitionedSolution:
        """Search, as every rank does, for the optimum of a checked question.

        Raises:
            InfeasibleError: no policy keeps to the budget and the limits.
            OutOfTimeError: the time ended before there was an answer.
        """
        more: dict[str, Any] = {"ends_at": options.deadline}
        if checkpoint is not None:
            kept = _Checkpoint(self.part, Path(checkpoint), _words(problem))
            more |= {"kept": kept.keep, "earlier": []}
        compiled = self._compiled(problem, **more)
        guess = None
        if checkpoint is not None:
            guess = kept.begun(compiled.pricing())
        try:
            if compiled.budget is None:
                compiled = compiled.bounded(compiled.least.column.failure, compiled.side)  # type: ignore[assignment]
            found = _searched(compiled, options, guess)
        except Stop as stop:
            words = str(stop) or "nothing but the model was known by then"
            raise OutOfTimeError(
                f"the time limit ended before there was an answer ({words}): allow more time"
            ) from stop
        members, sense = found.lottery.policies, compiled.sense
        figures = _stated_figures(compiled, [_own(one).figures for one in members])
        totals = (found.lottery.weights @ figures).tolist()
        names = [row.condition.name for row in compiled.side]
        positions = np.stack([_own(one).positions for one in members])
        size = self.ranks.comm.size
        return PartitionedSolution(
            objective=sense.worth(found.value),
            lower_bound=sense.worth(sense.settled_bound(found.value, found.bound)),
            failure=totals[1],
            policy=PartitionedPolicy(self.part, found.lottery.weights, positions),
            figures=read_only(figures),
            prices=found.prices,
            spent=dict(zip(names, totals[2:], strict=True)),
            value_function=found.values,
            run=Run(
                options.method,
                f"column generation on {size} rank{'s' * (size > 1)}, {found.calls} pricing calls",
                found.calls,
                time.perf_counter() - began,
                found.work,
            ),
            problem=problem,
            note=found.note,
        )

    def _measured(self, policy: PartitionedPolicy, problem: Formulation) -> Measured:
        """Measure each member of a policy as a column of the process.

        Raises:
            ModelError: a member has no decision in a state that it reaches, gives up where it may
                not, or stays for ever where that costs something.
        """
        compiled = self._compiled(problem)
        process = compiled.pricing()
        choices = map(process.completed, policy.decisions())
        columns = [process.measured(choice) for choice in choices]
        figures = _stated_figures(compiled, [column.figures for column in columns])
        totals = (policy.weights @ figures).tolist()
        names = [row.condition.name for row in compiled.side]
        spent = dict(zip(names, totals[2:], strict=True))
        return Measured(totals[0], totals[1], spent, read_only(figures))


class _Checkpoint:
    """Policies that a search has found, in a folder: each a partitioned policy, saved as such."""

    def __init__(self, part: Part, folder: Path, question: Mapping[str, Any]) -> None:
        """Read what an earlier run has left; all ranks do so together.

        Raises:
            ModelError: it is about another question or another model, or a file is damaged.
        """
        ranks = part.halo.ranks
        self._part, self._folder, self._question = part, folder, repr(sorted(question.items()))

        def found() -> list[Path]:
            """Return the policies that are there whole."""
            if not folder.parent.is_dir():
                raise ModelError(f"the checkpoint {folder} is in no folder: make {folder.parent}")
            if folder.exists() and not folder.is_dir():
                raise ModelError(f"the checkpoint {folder} is no folder: name another")
            return sorted(one.parent for one in folder.glob("*/policy.npz"))

        every = ranks.comm.bcast(ranks.agreed(found))
        self._earlier = [PartitionedPolicy.load(_Parts(part), one) for one in every]
        self._count = len(every)
        for one in self._earlier:
            if one.told.get("question") != self._question:
                raise ModelError(f"the checkpoint {folder} is of {one.told.get('question')}, not "
                                 f"of {self._question}")  # fmt: skip

    def begun(self, process: PartitionedProcess) -> DualGuess | None:
        """Measure the last policies of an earlier run; their price is where the search begins."""
        for policy in self._earlier[-_AGAIN:]:
            choice = process.completed(policy.decisions()[0])
            process.earlier.append(process.measured(choice))
        weights = self._earlier[-1].told["prices"] if self._earlier else [0.0, 0.0]
        return DualGuess(weights[1], _SURE) if weights[0] == 1.0 and weights[1] > 0.0 else None

    def keep(self, process: PartitionedProcess, weights: FloatArray, column: Column) -> None:
        """Save a column as a policy, with the prices at which it was found."""
        told = {"question": self._question, "prices": weights.tolist()}
        positions = _own(process.pulled_back(column)).positions[None]
        policy = PartitionedPolicy(self._part, np.ones(1), positions, told)
        policy.save(self._folder / f"{self._count:05}")
        self._count += 1


_AGAIN = 3  # policies of an earlier run that are measured to begin with


@dataclass(frozen=True)
class _Parts:
    """What a saved policy is read for."""

    part: Part


@dataclass(frozen=True, eq=False)
class _Found:
    """What the search on a partitioned model ended with."""

    value: float
    bound: float
    lottery: MixedPolicy
    prices: Mapping[str, float]
    values: FloatArray
    calls: int
    work: Any
    note: str


def _searched(
    compiled: CompiledPartitioned, options: SolveOptions, guess: DualGuess | None
) -> _Found:
    """Search for the optimum: of one row by its secant, of several by a linear program.

    Raises:
        Stop: the time ended before there was an answer.
    """
    if compiled.side or compiled.objective is not None:
        optimum = rows_optimum(compiled, options)
        values = compiled.pricing().anything if optimum.values is None else optimum.values
        return _Found(
            optimum.value, optimum.bound, optimum.policy, dict(optimum.prices), values,
            optimum.calls, optimum.work, optimum.note,
        )  # fmt: skip
    budget = 1.0 if compiled.budget is None else compiled.budget
    finer = 1.0 if compiled.sense.constant is None else _FINER
    exactly = replace(options, tolerance=finer * options.tolerance)
    outcome = refined_optimum(compiled, budget, exactly, guess)
    found = outcome.generated
    values = compiled.pricing().anything if found.values is None else found.values
    return _Found(
        found.objective, found.lower_bound, outcome.lottery, {FAILURE_ROW: found.price}, values,
        outcome.calls, outcome.work, "" if found.finished else CUT_SHORT,
    )  # fmt: skip


def _own(policy: Any) -> OwnDecisions:
    """Return a policy as the decisions that the pricing pulled back."""
    if not isinstance(policy, OwnDecisions):
        raise SolverError(f"{policy!r} does not come from the process of a partitioned model")
    return policy


def _stated_figures(compiled: CompiledPartitioned, members: Sequence[FloatArray]) -> FloatArray:
    """Objective, failure and limited quantities of each member, as they were asked for."""
    figures = np.stack(members)
    figures[:, 0] = [compiled.sense.worth(cost) for cost in figures[:, 0].tolist()]
    if compiled.by_goal:
        figures[:, 1] += 1.0
    for place, row in enumerate(compiled.side, 2):
        figures[:, place] = row.sign * (figures[:, place] - row.offset)
    return figures


def _numbers_of(row: Any) -> Any:
    """Return the numbers of a row that follow from sums over known states."""
    return None if row is None else (row.constant, row.bound, row.offset, _numbers_of(row.direct))


def _with_numbers(row: Any, numbers: Any) -> Any:
    """Return a row with the numbers that the first rank has."""
    if row is None:
        return None
    constant, bound, offset, direct = numbers
    own = _with_numbers(row.direct, direct)
    return replace(row, constant=constant, bound=bound, offset=offset, direct=own)


def _checked_goals(goal_states: npt.ArrayLike, n_states: int) -> IntArray:
    """Return the numbers of the goal states, ascending.

    Raises:
        ModelError: there are none, or one is no number of a state.
    """
    goals = np.asarray(goal_states).reshape(-1)
    if not goals.size or goals.dtype.kind not in "iu":
        raise ModelError("goal_states must be numbers of states, at least one")
    if goals.min() < 0 or goals.max() >= n_states:
        raise ModelError(f"goal states must be indices of states, 0 .. {n_states - 1}")
    return np.unique(goals)


def _checked_problem(criterion: type[Any], part: Part, asked: Mapping[str, Any]) -> Formulation:
    """Return the question on a part of the model, where ranks can answer it.

    Raises:
        ModelError: they cannot; it says what to do.
    """
    if not isinstance(criterion, type):
        raise wrong_argument("criterion", "be a class such as MCMP, its arguments beside it",
                             criterion)  # fmt: skip
    name = criterion.__name__
    if asked.get("horizon") is not None or asked.get("reach_fraction") is not None:
        raise ModelError("a partitioned model has no horizon and no reach_fraction: state the "
                         "budget, and steps as a part of the states")  # fmt: skip
    try:
        problem: Formulation = criterion(part, **asked)
    except TypeError as error:
        raise ModelError(f"{name} cannot be stated so: {error}") from error
    if problem.semantics.charge(problem.ratio) is not None:
        raise ModelError(f"{name} counts the total cost of a run, which ranks do not share: solve "
                         "it with ssp_lp.solve on a model held whole, or ask MCMP, the cost until "
                         "failing, of the ranks")  # fmt: skip
    if problem.semantics.forbids_failing:
        raise ModelError(f"{name} forbids failing, which asks for the whole graph: on a "
                         "partitioned model give MCMP a failure budget")  # fmt: skip
    if problem.semantics.aim is Aim.LEAST_GOAL:
        raise ModelError(f"{name} is not answered by ranks: solve it with ssp_lp.solve on a model "
                         "held whole")  # fmt: skip
    try:
        is_told = problem.unrolled is problem
    except ModelError:
        is_told = False
    if not is_told:
        raise ModelError("a limit counts what may come after failing, which a partitioned model "
                         "does not tell apart: visits() counts until then")  # fmt: skip
    return problem


def _words(problem: Formulation) -> dict[str, Any]:
    """Return what is asked, by name, in words and numbers that ranks compare."""
    return {
        "the criterion": type(problem).__name__,
        "the start": repr(problem.start)[:200],
        "failure_budget": problem.failure_budget,
        "discount": problem.discount,
        "what an episode is worth": re.sub(r" at 0x\w+", "", repr(problem.semantics)),
        "what is minimised": re.sub(r" at 0x\w+", "", repr(problem.quantity)),
        "the limits": [(one.name, one.lower, one.upper) for one in problem.conditions],
    }
