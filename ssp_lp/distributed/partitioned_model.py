"""Models whose rows are distributed over several ranks, and the problems on them."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import RELATIVE_GAP, FloatArray, IntArray, ReadOnlyCopies, read_only
from ssp_lp.column_generation.column import two_sided_gap
from ssp_lp.column_generation.search import DualGuess
from ssp_lp.distributed.part import Part, balanced_bounds, made_part
from ssp_lp.distributed.policy import PartitionedPolicy
from ssp_lp.distributed.process import CompiledPartitioned, PartitionedProcess, compiled_on_ranks
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.errors import ModelError, check_whole, wrong_argument
from ssp_lp.formulation import Formulation
from ssp_lp.io.archives import StoredModel
from ssp_lp.methods.columns import refined_optimum
from ssp_lp.methods.rows import rows_optimum
from ssp_lp.model.continuous_model import ContinuousModel
from ssp_lp.model.discretise import MIDPOINTS, Quadrature, discretised_rows
from ssp_lp.model.state_rows import Rows, StateRows
from ssp_lp.options import ColumnGeneration, Progress, SolveOptions, options_of
from ssp_lp.problem import compiled_constrained
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.solution import Run

_SURE = 1e-6  # relative uncertainty of a price in a checkpoint
_AGAIN = 3  # number of policies of an earlier run that are evaluated first
_FINER = 1e-3  # factor of the tolerance if a complement is minimised, which may be much larger
_WHOLE = "solve it with ssp_lp.solve on the whole model"


@dataclass(frozen=True, eq=False)
class Measured(ReadOnlyCopies):
    """Objective, failure and limited quantities of a policy, the same on every rank."""

    objective: float
    failure: float  # discounted if the budget limits the discounted failure
    spent: Mapping[str, float]  # each limited quantity, by name
    figures: FloatArray  # [members, 2 + limits] objective, failure and quantities of each member


@dataclass(frozen=True, eq=False, repr=False)
class PartitionedSolution(Measured):
    """The optimum of a problem on a partitioned model, the same on every rank."""

    lower_bound: float  # certified bound of the optimum; an upper bound if it is a maximum
    policy: PartitionedPolicy  # each rank holds the decisions of its own states
    prices: Mapping[str, float]  # multiplier of each row, by name
    run: Run
    problem: Formulation  # on this rank's part of the model

    def __repr__(self) -> str:
        """Return criterion, objective with gap, failure and lottery in one line."""
        return (
            f"PartitionedSolution({type(self.problem).__name__}: objective {self.objective:.9g}, "
            f"gap {self.gap:.1e}, failure {self.failure:.6g}, {self.policy!r})"
        )

    @property
    def gap(self) -> float:
        """Relative gap between the objective and its bound."""
        return two_sided_gap(self.objective, self.lower_bound)

    @property
    def failure_price(self) -> float:
        """Multiplier of the failure row."""
        return self.prices.get(FAILURE_ROW, 0.0)


@dataclass(frozen=True, eq=False)
class PartitionedModel:
    """A model whose rows are distributed over several ranks by state.

    Under ``mpiexec -n 4 python plan.py`` every rank builds its part, and makes the same calls:

        model = PartitionedModel.from_rows(rows, n_states, goal_states=[n_states - 1])
        answer = model.solve(MCMP, start=0, failure_budget=0.05)
    """

    part: Part  # this rank's part
    ranks: Ranks = field(repr=False)

    @classmethod
    def from_rows(
        cls,
        rows: Rows,
        n_states: int,
        goal_states: npt.ArrayLike,
        *,
        state_labels: Mapping[str, npt.ArrayLike] | None = None,
        bounds: npt.ArrayLike | None = None,
    ) -> PartitionedModel:
        """Build each rank's part by a vectorised function on a range of states.

        Args:
            rows: ``rows(first, end)`` returns the rows of the states first .. end - 1, as arrays;
                each rank calls it for samples of a few states, then for its own states.
            n_states: number of states.
            goal_states: indices of the goal states, which have no actions.
            state_labels: names for sets of states, each given by the indices of its states.
            bounds: first state of each rank, and the end, [ranks + 1]; None: outcomes are balanced.

        Raises:
            ModelError: a row is invalid; the message names the state and the action.
        """
        ranks, named = Ranks(), {"goal_states": goal_states, **(state_labels or {})}

        def checked() -> dict[str, Any]:
            check_whole("n_states", n_states)
            sets = {name: np.unique(np.asarray(of)) for name, of in named.items()}
            for name, of in sets.items():
                if of.size and (of.dtype.kind not in "iu" or of[0] < 0 or of[-1] >= n_states):
                    raise ModelError(f"{name} must be numbers of states, 0 .. {n_states - 1}")
            if not sets["goal_states"].size:
                raise ModelError("the model has no goal state: name at least one in goal_states")
            return sets

        sets = ranks.agreed(checked)
        checksums = {name: crc32(of.astype(np.int64).tobytes()) for name, of in sets.items()}
        ranks.check_same("models", {"n_states": n_states, "checksums of named states": checksums})
        ends = balanced_bounds(ranks, rows, n_states) if bounds is None else bounds
        goals = sets.pop("goal_states")
        part = ranks.together(lambda: made_part(ranks, rows, goals, sets, np.asarray(ends)))
        ranks.check_same("models", {"the named costs": sorted(part.named_costs)})
        return cls(part, ranks)

    @classmethod
    def from_continuous(
        cls, world: ContinuousModel, points: Quadrature = MIDPOINTS
    ) -> PartitionedModel:
        """Discretise each rank's cells of a continuous world, as ``discretise`` does.

        Args:
            world: the step function and the grid, the same on every rank.
            points: a ``Quadrature``; random samples depend on one order and cannot be shared.

        Raises:
            ModelError: ``points`` are random samples, or any error of ``discretise``.
        """

        def rows(first: int, end: int) -> StateRows:
            """Return the rows of some cells; the states after the last cell are ends."""
            actions, outcomes = discretised_rows(world, points, first, end)
            return StateRows(actions, *outcomes)

        if not isinstance(world, ContinuousModel):
            raise wrong_argument("world", "be a ContinuousModel", world)
        if not isinstance(points, Quadrature):
            raise ModelError(f"points must be a Quadrature, such as Quadrature(4), not {points!r}")
        labels = {name: [world.end_state(name)] for name in world.dead_ends}
        return cls.from_rows(rows, world.n_states, [world.end_state("goal")], state_labels=labels)

    @classmethod
    def from_file(cls, path: str | Path) -> PartitionedModel:
        """Read each rank's part of a file of ``save_model``; states and actions are numbers.

        Args:
            path: path of the file, which every rank can open.

        Raises:
            ModelError: the file has another format, or is damaged; the message names it.
            OSError: the file cannot be opened.
        """
        file = Ranks().agreed(lambda: StoredModel(path))
        bounds = np.linspace(0, file.n_states, Ranks().comm.size + 1).astype(np.int64)
        stated = file.rows, file.n_states, file.goal_states
        return cls.from_rows(*stated, state_labels=file.state_labels, bounds=bounds)

    def solve(
        self,
        criterion: type[Any],
        *,
        tolerance: float = RELATIVE_GAP,
        progress: Progress | None = None,
        checkpoint: str | Path | None = None,
        **given: Any,
    ) -> PartitionedSolution:
        """Solve a problem of case M; all ranks must call this.

        Args:
            criterion: a class such as ``MCMP`` or ``MaxProb``. Its arguments are given as keywords:
                ``start=``, ``failure_budget=``, ``discount=``, ``constraints=``, ..., with
                secondary costs by name.
            tolerance: relative gap to reach.
            progress: a callback, see ``solve``; called on the first rank.
            checkpoint: a folder in which each rank saves its part of every policy that is found; a
                later run of the same problem, on any number of ranks, starts from these policies.

        Raises:
            ModelError: the ranks state different problems, or the problem needs the whole graph.
            InfeasibleError: no policy satisfies the budget and the limits.
        """
        began, ranks, method = time.perf_counter(), self.ranks, ColumnGeneration()
        told = progress if ranks.comm.rank == 0 else None
        options = ranks.agreed(lambda: options_of(method, tolerance, began, None, told))
        problem = self._stated(criterion, given)
        ranks.check_same("options", {"tolerance": tolerance, "checkpoint": str(checkpoint)})
        return ranks.together(lambda: self._solved(problem, options, checkpoint))

    def evaluate(self, policy: PartitionedPolicy, criterion: type[Any], **given: Any) -> Measured:
        """Evaluate a policy on the rows of all ranks, to a bounded error; all ranks must call this.

        As in ``ssp_lp.evaluate``, a policy has failed as soon as it can no longer reach the goal by
        its own decisions, in states where it may give up.

        Args:
            policy: a policy on this model: a solution's policy, or a loaded one.
            criterion: a class such as ``MCMP``, with arguments as in :meth:`solve`.

        Raises:
            ModelError: the policy belongs to another model, has no decision in a state, or gives
                up where this is forbidden.
        """
        problem = self._stated(criterion, given)

        def checked() -> None:
            if not isinstance(policy, PartitionedPolicy) or policy.part is not self.part:
                wanted = "be a policy of this model: answer.policy, or PartitionedPolicy.load(...)"
                raise wrong_argument("policy", wanted, policy)
            policy.check()

        self.ranks.agreed(checked)
        self.ranks.check_same("policies", {"the members' weights": policy.weights.tolist()})

        def measured() -> Measured:
            """Evaluate each member as a column of the process."""
            compiled = self._compiled(problem)
            process: Any = compiled.pricing()
            columns = [process.evaluated(own) for own in policy.positions]
            return Measured(**_figures(compiled, policy.weights, columns))

        return self.ranks.together(measured)

    def _stated(self, criterion: type[Any], given: Mapping[str, Any]) -> Formulation:
        """Build a problem on the rank's part of the model, extended by the states that it names.

        Raises:
            ModelError: the ranks state different problems, or the problem needs the whole graph.
        """
        ranks, part = self.ranks, self.part
        while True:
            problem = ranks.caught(partial(_checked_problem, criterion, part, given))
            wanted = set().union(*ranks.comm.allgather(part.wanted))
            part.wanted.clear()
            if not wanted:
                break
            part = part.knowing(wanted)  # an unknown state may have caused an error
        stated: Formulation = ranks.agreed(lambda: problem)
        ranks.check_same("questions", _words(stated))
        return stated

    def _compiled(self, problem: Formulation, **more: Any) -> CompiledPartitioned:
        """Compile a problem on this rank's part, with the same bounds of rows on every rank."""

        def told(row: Any) -> Any:
            """Return a row with the first rank's numbers, the same on all ranks.

            Sums that each rank computes itself may differ by rounding.
            """
            if row is None:
                return None
            own = {"constant": row.constant, "bound": row.bound, "offset": row.offset}
            return replace(row, direct=told(row.direct), **self.ranks.comm.bcast(own))

        plain = self.ranks.agreed(lambda: compiled_constrained(problem))
        told_rows = {"side": tuple(map(told, plain.side)), "objective": told(plain.objective)}
        return compiled_on_ranks(replace(plain, **told_rows), **more)

    def _solved(
        self, problem: Formulation, options: SolveOptions, checkpoint: str | Path | None
    ) -> PartitionedSolution:
        """Find the optimum of a checked problem; all ranks must call this.

        Raises:
            InfeasibleError: no policy satisfies the budget and the limits.
        """
        began = time.perf_counter()
        kept = _Checkpoint(self.part, checkpoint, repr(_words(problem)))
        compiled: Any = self._compiled(problem, kept=kept.keep)
        guess = kept.first_guess(compiled.pricing())
        if compiled.budget is None:
            compiled = compiled.bounded(compiled.least.column.failure, compiled.side)
        if compiled.side or compiled.objective is not None:
            found: Any = rows_optimum(compiled, options)
            prices = found.prices
        else:
            finer = 1.0 if compiled.sense.constant is None else _FINER
            exactly = replace(options, tolerance=finer * options.tolerance)
            found = refined_optimum(compiled, compiled.budget, exactly, guess)
            prices = {FAILURE_ROW: found.price}
        lottery, bound = found.policy, compiled.sense.bound_or_value(found.value, found.bound)
        reason = f"column generation on {self.ranks.comm.size} ranks, {found.calls} pricing calls"
        seconds = time.perf_counter() - began
        positions = np.stack([one.positions for one in lottery.policies])
        return PartitionedSolution(
            **_figures(compiled, lottery.weights, lottery.policies),
            lower_bound=compiled.sense.stated(bound),
            policy=PartitionedPolicy(self.part, lottery.weights, positions),
            prices=prices,
            run=Run(options.method, reason, found.calls, seconds, found.work),
            problem=problem,
        )


class _Checkpoint:
    """A folder with the policies that a search has found, each saved as a partitioned policy."""

    def __init__(self, part: Part, folder: str | Path | None, question: str) -> None:
        """Find the policies of an earlier run; all ranks must call this.

        Raises:
            ModelError: the checkpoint is not a folder, or its parent folder does not exist.
        """
        self._part, self._folder, self._question = part, Path(folder) if folder else None, question

        def found(folder: Path) -> list[Path]:
            if not folder.parent.is_dir() or folder.is_file():
                raise ModelError(f"checkpoint {folder} must be a folder, and its parent must exist")
            return sorted(one.parent for one in folder.glob("*/policy.npz"))

        self._earlier = part.halo.ranks.agreed(lambda: found(Path(folder)) if folder else [])

    def first_guess(self, process: PartitionedProcess) -> DualGuess | None:
        """Evaluate the last policies of an earlier run; return its last price as a first guess.

        Raises:
            ModelError: the policies answer another problem or model, or a file is damaged.
        """
        prices = [0.0, 0.0]
        for one in self._earlier[-_AGAIN:]:
            policy = PartitionedPolicy.load(self._part, one)
            if policy.told["question"] != self._question:
                raise ModelError(f"checkpoint of {policy.told['question']}: name another folder")
            process.earlier.append(process.evaluated(policy.positions[0]))
            prices = policy.told["prices"]
        return DualGuess(prices[1], _SURE) if prices[0] == 1.0 and prices[1] > 0.0 else None

    def keep(self, positions: IntArray, weights: FloatArray) -> None:
        """Save this rank's decisions of a column, with the prices at which the column was found."""
        if self._folder is not None:
            place = self._folder / f"{len(self._earlier):05}"
            told = {"question": self._question, "prices": weights.tolist()}
            PartitionedPolicy(self._part, np.ones(1), positions[None], told).save(place)
            self._earlier.append(place)


def _figures(
    compiled: CompiledPartitioned, weights: FloatArray, members: Sequence[Any]
) -> dict[str, Any]:
    """Return objective, failure and limited quantities of a lottery and of each member."""
    figures = np.stack([one.rewards for one in members])
    figures[:, 0] = [compiled.sense.stated(cost) for cost in figures[:, 0].tolist()]
    for place, row in enumerate(compiled.side, 2):
        figures[:, place] = row.sign * (figures[:, place] - row.offset)
    objective, failure, *spent = (weights @ figures).tolist()
    names = [row.condition.name for row in compiled.side]
    return {"objective": objective, "failure": failure, "figures": read_only(figures),
            "spent": dict(zip(names, spent, strict=True))}  # fmt: skip


def _checked_problem(criterion: type[Any], part: Part, given: Mapping[str, Any]) -> Formulation:
    """Return the problem on a part of the model, after checking that ranks can solve it.

    Raises:
        ModelError: ranks do not support the problem; the message says what to do.
    """
    if not isinstance(criterion, type):
        raise wrong_argument("criterion", "be a class such as MCMP, with keyword arguments",
                             criterion)  # fmt: skip
    name = criterion.__name__
    if given.get("horizon") is not None or given.get("reach_fraction") is not None:
        raise ModelError("ranks support neither horizon nor reach_fraction: make the number of "
                         "steps part of the states, and give failure_budget")  # fmt: skip
    problem: Formulation = criterion(part, **given)
    if problem.semantics.charge(problem.ratio) is not None:
        raise ModelError(f"{name} counts the total cost of a run: {_WHOLE}, or use MCMP on ranks")
    if problem.semantics.forbids_failing or problem.semantics.aim is Aim.LEAST_GOAL:
        raise ModelError(
            f"{name} needs the whole graph: {_WHOLE}, or use MCMP with a failure budget"
        )
    unrolled: object = None
    with suppress(ModelError):
        unrolled = problem.unrolled
    if unrolled is not problem:
        raise ModelError("a limit counts events after failing, which ranks do not support: use "
                         "visits(), which counts until then")  # fmt: skip
    return problem


def _words(problem: Formulation) -> dict[str, Any]:
    """Return a problem as texts and numbers, by name, so that ranks can compare their problems."""
    given = repr((problem.semantics, problem.quantity, problem.start))
    return {
        "the criterion": type(problem).__name__,
        "what an episode is worth, or its start": re.sub(r" at 0x\w+", "", given),
        "failure_budget": problem.failure_budget,
        "discount": problem.discount,
        "the limits": [(one.name, one.lower, one.upper) for one in problem.conditions],
    }
