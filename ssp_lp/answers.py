"""Solve many problems side by side with processes, threads or machines; answers keep the order.

Each model is sent to the workers once, in a file that they map into memory. Problems and answers
name their model by its place in this file, so they are small. An answer that arrives is connected
to the caller's own model.
"""

from __future__ import annotations

import gc
import logging
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from dataclasses import dataclass, fields, is_dataclass, replace
from inspect import signature
from itertools import product as combinations
from math import inf, isfinite
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, cast

import numpy as np

from ssp_lp.arrays import RELATIVE_GAP, FloatArray
from ssp_lp.cargo import Models, Store, loaded, models_of
from ssp_lp.errors import (
    ModelError,
    OutOfTimeError,
    SolverError,
    SSPError,
    check_whole,
    did_you_mean,
    in_short,
    is_number,
)
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.report import Report, Table
from ssp_lp.options import Method, deadline_of, options_of, parse_method, progress_shown
from ssp_lp.problem import Problem, as_stated, check_problem
from ssp_lp.solution import Solution
from ssp_lp.solving import solve

Answer = Solution | SSPError
"""Answer to a problem: its solution, or the error that says why there is none."""

_LOG = logging.getLogger("ssp_lp.answers")
_SHOWN = 20  # problems listed in a summary
_AHEAD = 2  # problems queued for each process, so that none idles
_LATE = 2.0  # seconds after the total time limit in which answers in progress may arrive
_ASKED = 3  # attempts at a problem whose process dies
_TOO_LATE = "total_time_limit ended before this problem was solved: allow more time"
_DIED = f"{_ASKED} processes died while solving it, perhaps for lack of memory: solve it by itself"


@explained
def sweep(criterion: Callable[..., Problem], *given: Any, **named: Any) -> list[Problem]:
    """Return the problems of one criterion, one for each combination of the listed arguments.

    Args:
        criterion: such as ``MCMP``.
        given: its arguments in their order. Lists, ranges and arrays are swept, the last one
            fastest; any other value is used in all problems.
        named: its arguments by name, swept in the same way, and parameters of the model.

    Raises:
        ModelError: an argument that the criterion rejects, an empty list, or an ambiguous name.

    Example:
        >>> from ssp_lp import MCMP, SSP
        >>> model = SSP.from_transitions({"depot": {"road": [(1.0, "home", 9.0)]}}, goal={"home"})
        >>> sweep(MCMP, model, "depot", failure_budget=[0.01, 0.05], horizon=[1, None])[1]
        MCMP(SSP(2 states, 1 pairs, 1 outcomes, 1 goals), start='depot', failure_budget=0.01)
    """
    swept: list[Sequence[Any]] = [
        value.tolist()
        if isinstance(value, np.ndarray)
        else value
        if isinstance(value, (list, range))
        else [value]
        for value in (*given, *named.values())
    ]
    for place, values in enumerate(swept):
        if len(values) == 0:
            names = [*(f"argument {k}" for k in range(1, len(given) + 1)), *named]
            raise ModelError(f"nothing to sweep over: {names[place]} is empty")
    labels, made, problems = [*range(len(given)), *named], dict[Any, SSP](), list[Problem]()
    of: Any = 0 if given else "model"  # key of the argument that is the model
    models = swept[labels.index(of)] if of in labels else ()
    known = {name for model in models if isinstance(model, SSP) for name in model.parameters}
    if both := known & {*signature(criterion).parameters} & named.keys():
        raise ModelError(f"{min(both)!r} names a parameter of the model and an argument of the "
                         "criterion: rename the parameter")  # fmt: skip
    taken = signature(criterion).parameters.values()
    if known and not any(part.kind is part.VAR_KEYWORD for part in taken):
        names = [*known, *(part.name for part in taken)]
        for name in (name for name in named if name not in names):
            told = did_you_mean(name, names, "there are")
            raise ModelError(f"{name!r} is neither a parameter of the model nor an argument{told}")
    for chosen in combinations(*swept):
        arguments: dict[Any, Any] = dict(zip(labels, chosen, strict=True))
        moved = {name: arguments.pop(name) for name in labels if name in known}
        if moved:
            model, key = arguments[of], (id(arguments[of]), *moved.values())
            arguments[of] = made[key] = made.get(key) or model.with_parameters(**moved)
        first = [arguments.pop(k) for k in range(len(given))]
        problems.append(criterion(*first, **arguments))
    return problems


@dataclass(frozen=True, eq=False, repr=False)
class Answers(Report):
    """Answers to many problems, in the order of the problems: a solution or an error each."""

    problems: tuple[Problem, ...]
    answers: tuple[Answer, ...]
    seconds: float  # wall clock, in total

    def __len__(self) -> int:
        return len(self.problems)

    def __iter__(self) -> Iterator[Answer]:
        return iter(self.answers)

    def __getitem__(self, place: int) -> Answer:
        """Return the answer to the problem at a position."""
        return self.answers[place]

    @property
    def errors(self) -> Mapping[int, SSPError]:
        """Answers that are errors, by the positions of their problems."""
        return {k: answer for k, answer in enumerate(self) if isinstance(answer, SSPError)}

    @property
    def objectives(self) -> FloatArray:
        """Optimal values of the answers, nan where there is an error, [problems]."""
        return np.array(
            [answer.objective if isinstance(answer, Solution) else np.nan for answer in self]
        )

    def tables(self) -> list[Table]:
        """Return a table with a row for each problem; its text shows the first rows and the errors.

        The columns are the criterion; each argument that differs between problems (models are
        numbered); and objective, certified bound, gap, failure (discounted if the problem is),
        price, seconds, status or class of the error, and message of the error.
        """
        asked = self._varied_arguments()
        stated = zip(*asked.values(), strict=True)
        rows = [(*one, *_facts_of(answer)) for one, answer in zip(stated, self, strict=True)]
        more = len(rows) - _SHOWN
        notes = [f"and {more:,} more: to_frame() has all"] * (more > 0)
        notes += [f"{k}: {error}" for k, error in self.errors.items()][:_SHOWN]
        shown = range(min(len(rows), _SHOWN))
        return [Table(rows, (*asked, *_FACTS), "", notes, shown=shown, hidden=_FRAME_ONLY)]

    def __repr__(self) -> str:
        """Return a line with the number of problems and of errors."""
        failed = f", {len(self.errors):,} of them errors" if self.errors else ""
        return f"Answers({len(self):,}{failed}, {self.seconds:.3g} s)"

    def _varied_arguments(self) -> dict[str, list[Any]]:
        """Return the arguments that differ between problems, name -> [problems]."""
        numbers: dict[int, int] = {}  # id of a model -> number of models before it
        rows: list[dict[str, Any]] = []
        for problem in self.problems:
            stated = vars(problem) | as_stated(problem)
            stated["model"] = numbers.setdefault(id(problem.model), len(numbers))
            parts: Sequence[Any] = fields(problem) if is_dataclass(problem) else ()
            names = [part.name for part in sorted(parts, key=lambda part: part.kw_only is True)]
            values = {name: placed.value for name, placed in problem.model.parameters.items()}
            stated, names = {**values, **stated}, [*names, *(values.keys() - {*names})]
            rows.append({name: _plain(stated.get(name)) for name in names})
        every = dict.fromkeys(name for row in rows for name in row)
        columns = {name: [row.get(name) for row in rows] for name in every}
        several = {k: column for k, column in columns.items() if len(set(map(repr, column))) > 1}
        return {"criterion": [type(problem).__name__ for problem in self.problems], **several}


_FACTS = "objective", "bound", "gap", "failure", "price", "seconds", "status", "error"
_FRAME_ONLY = "bound", "gap", "seconds", "error"  # columns that are not printed


def _plain(value: Any) -> Any:
    """Return an argument of a problem as a table shows it: long values shortened."""
    return value if value is None or isinstance(value, str) or is_number(value) else in_short(value)


def _facts_of(answer: Answer) -> tuple[Any, ...]:
    """Return the facts of an answer, in the order of ``_FACTS``, without evaluating its policy."""
    if isinstance(answer, SSPError):
        return *[None] * 6, type(answer).__name__, str(answer)
    bound = answer.lower_bound if answer.upper_bound is None else answer.upper_bound
    figures = answer.objective, bound, answer.gap, answer.budget_used, answer.failure_price
    return *figures, answer.seconds, answer.status.name.lower(), ""


@explained
def solve_many(
    problems: Iterable[Problem],
    method: Method | str | None = None,
    *,
    executor: Executor | None = None,
    workers: int | None = None,
    tolerance: float = RELATIVE_GAP,
    time_limit: float | None = None,
    total_time_limit: float | None = None,
    progress: Callable[[int, Answer], None] | None = None,
    verbose: bool = False,
) -> Answers:
    """Solve many problems side by side, each as ``solve`` does.

    A process of the built-in pool that dies, such as for lack of memory, is replaced; each problem
    that it may have worked on is sent once more, alone. Ctrl-C ends the call at once with the
    answers so far.

    Args:
        problems: formulations such as ``MCMP(...)``, of any kinds and on any models, such as those
            of :func:`sweep`.
        method: as in ``solve``, for all problems.
        executor: any object with the interface of ``concurrent.futures.Executor``: a pool of
            threads or processes, mpi4py's, Dask's. It is not shut down. None: processes of joblib,
            one thread each.
        workers: processes of the built-in pool; None: one for each core.
        tolerance: relative gap to reach, for each problem.
        time_limit: seconds for each problem, as in ``solve``.
        total_time_limit: seconds for all problems. Then problems in progress end with their best
            policy so far; those not begun have an OutOfTimeError as their answer.
        progress: called with (place, answer) as each answer arrives, in any order.
        verbose: show the number of answers so far (``progress_shown``).

    Returns:
        The answers in the order of the problems: a solution or an ``SSPError`` each (infeasible,
        out of time, stated wrongly, or a SolverError for any other failure).

    Raises:
        ModelError: a wrong argument, or an entry that is not a problem.
        SolverError: no process of the built-in pool could be started.

    Example:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> from ssp_lp import MCMP, SSP
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, treat_actionless_as_dead_ends=True)
        >>> asked = sweep(MCMP, model, "road", failure_budget=[0.0, 0.05])
        >>> solve_many(asked, executor=ThreadPoolExecutor(1)).objectives.round(6).tolist()
        [3.0, 2.0]
    """
    if isinstance(problems, Problem):
        raise ModelError("solve_many() takes several problems: pass a list, or call solve")
    began, asked = time.perf_counter(), [*problems]
    for problem in asked:
        check_problem(problem, "solve_many")
    options_of(parse_method(method), tolerance, began, time_limit, cast("Any", progress))
    left = deadline_of(total_time_limit, 0.0, "total_time_limit")
    if executor is not None and workers is not None:
        raise ModelError("workers is the size of the built-in pool: leave out workers, or executor")
    if workers is not None:
        check_whole("workers", workers)
    from joblib import cpu_count

    order = _Order(method, tolerance, time_limit, time.time() + left)
    with progress_shown(verbose):
        answers = _answers_to(asked, order, executor, workers or cpu_count(), progress)
        made = Answers(tuple(asked), answers, time.perf_counter() - began)
        _LOG.info("%r", made)
    return made


def _answers_to(
    asked: Sequence[Problem],
    order: _Order,
    executor: Executor | None,
    workers: int,
    progress: Callable[[int, Answer], None] | None,
) -> tuple[Answer, ...]:
    """Return the answers of ``solve_many``, in the order of the problems.

    Raises:
        ModelError: a model that cannot be pickled.
        SolverError: no process could be started.
    """
    answers: dict[int, Answer] = {}
    if not asked:
        return ()

    def record(place: int, answer: Answer) -> None:
        """Store an answer, and report it."""
        answers[place], done = answer, len(answers) + 1
        _LOG.debug("%d of %d", done, len(asked), extra={"share": done / len(asked)})
        if progress is not None:
            progress(place, answer)

    with TemporaryDirectory(prefix="ssp-lp-", ignore_cleanup_errors=True) as folder:
        store, path, packed = Store(), Path(folder, "models"), dict[int, bytes]()
        with (
            _Pool(executor, min(workers, len(asked)), store, Models(str(path)), order) as crew,
            path.open("wb") as file,
        ):
            store.load(models_of(asked), file)
            file.flush()
            for place, problem in enumerate(asked):
                try:
                    packed[place] = store.pack(problem)
                except ModelError as error:
                    record(place, error)
            mean = sum(map(len, packed.values())) // max(len(packed), 1)
            told = "%d problems of %d bytes on average, models of %d bytes in all, %s"
            _LOG.info(told, len(asked), mean, file.tell(), crew)
            late = crew.collect(packed, record)
        for place in range(len(asked)):
            if place not in answers:
                record(place, late)
    return tuple(answers[place] for place in range(len(asked)))


class _Order(NamedTuple):
    """Options of ``solve`` for each problem, and the time at which all problems must end."""

    method: Method | str | None
    tolerance: float
    time_limit: float | None
    ends: float  # on the clock of time.time, which machines share


def _answer(models: Models, packed: bytes, order: _Order) -> bytes | None:
    """Solve a packed problem in a worker and return the packed answer.

    None if the worker cannot read the file of models.
    """
    try:
        store = loaded(models)
    except OSError:
        return None
    try:
        problem, left = store.unpack(packed), order.ends - time.time()
        if left <= 0.0:
            raise OutOfTimeError(_TOO_LATE)
        limit = min(left, inf if order.time_limit is None else order.time_limit)
        limited = limit if isfinite(limit) else None
        answer = solve(problem, order.method, tolerance=order.tolerance, time_limit=limited)
        return store.pack(answer)
    except SSPError as error:
        return store.pack(error)
    except Exception as error:  # of one problem; the others go on
        return store.pack(SolverError(f"the solve ended in {type(error).__name__}: {error}"))


class _Pool:
    """Workers: the given executor, or processes of joblib, which are replaced when one dies."""

    def __init__(
        self, given: Executor | None, count: int, store: Store, models: Models, order: _Order
    ) -> None:
        """Start the processes, without waiting for them, unless an executor is given.

        Args:
            given: the executor.
            count: number of processes.
            store: unpacks the answers.
            models: the models.
            order: options and time limit of the problems.
        """
        self._is_own, self._is_broken, self._count = given is None, False, count
        self._room = _AHEAD * count if given is None else inf
        self._executor: Any = self._new_pool() if given is None else given
        self._cargo, self._shipment, self._order = store, models, order
        self._packed: Mapping[int, bytes] = {}
        self._waiting, self._suspects = deque[int](), deque[int]()
        self._deaths = Counter[int]()  # of workers that had the problem in hand, by its place
        self._without_file: set[int] = set()  # places of problems: workers cannot read the file
        self._running: dict[Future[bytes | None], int] = {}
        self._finished: SimpleQueue[Future[bytes | None]] = SimpleQueue()

    def __enter__(self) -> _Pool:
        return self

    def __exit__(self, *raised: object) -> None:
        """Shut down the built-in pool, and release the models that threads of an executor hold."""
        loaded.cache_clear()  # of threads
        if raised[0] is not None:
            self._end()
        elif self._is_own and not self._is_broken:
            self._executor.shutdown()

    def __repr__(self) -> str:
        """Return the number of processes, or the class of the executor."""
        return f"{self._count} processes" if self._is_own else type(self._executor).__name__

    def collect(
        self, packed: Mapping[int, bytes], record: Callable[[int, Answer], None]
    ) -> SSPError:
        """Send out the problems and record answers until all have arrived or the call must end.

        Args:
            packed: place -> problem.
            record: called with each place and its answer.

        Returns:
            The error to record for each problem that has no answer.

        Raises:
            SolverError: no process could be started, or the executor accepts no problem.
        """
        self._packed, missing = packed, len(packed)
        self._waiting.extend(packed)
        try:
            while missing:
                self._submit_problems()
                if self._is_broken and not self._running:
                    if self._is_own and self._restart():
                        continue
                    if missing == len(packed):
                        raise self._error
                    return self._error
                left = self._order.ends + _LATE - time.time()
                future = self._finished.get(timeout=max(left, 0.0) if isfinite(left) else None)
                place = self._running.pop(future)
                if (answer := self._answer_of(place, future)) is not None:
                    missing -= 1
                    record(place, answer)
        except Empty:
            self._end()
        except KeyboardInterrupt:
            self._end()
            return OutOfTimeError("Ctrl-C came before this problem was solved")
        return OutOfTimeError(_TOO_LATE)

    def _end(self) -> None:
        """End the built-in processes at once; a user's executor finishes problems in progress."""
        for future in self._running:
            future.cancel()
        if self._is_own:
            self._is_broken = True
            self._executor.shutdown(kill_workers=True)

    def _submit_problems(self) -> None:
        """Submit problems as long as there is room for them.

        A problem that may have crashed a process is submitted alone.
        """
        running = self._running
        while not self._is_broken:
            alone = bool(self._suspects) or any(self._deaths[place] for place in running.values())
            queue = self._suspects or self._waiting
            if not queue or len(running) >= (1 if alone else self._room):
                return
            place, models = queue.popleft(), self._shipment
            if place in self._without_file:
                models = replace(models, content=Path(models.path).read_bytes())
            try:
                future = self._executor.submit(_answer, models, self._packed[place], self._order)
            except RuntimeError:  # it is broken, or has been shut down
                queue.appendleft(place)
                self._is_broken = True
                return
            running[future] = place
            future.add_done_callback(self._finished.put)

    def _answer_of(self, place: int, future: Future[bytes | None]) -> Answer | None:
        """Return the answer of a worker; None: the problem must be sent again."""
        error = CancelledError() if future.cancelled() else future.exception()
        if isinstance(error, BrokenExecutor):
            self._is_broken = True
            if not self._is_own:
                return self._error
            self._deaths[place] += 1
            if self._deaths[place] == _ASKED:
                return SolverError(_DIED)
            self._suspects.append(place)
            return None
        if error is not None:  # raised by the executor, or while sending
            return SolverError(f"the executor raised {type(error).__name__}: {error}")
        if (packed := future.result()) is not None:
            answer: Answer = self._cargo.unpack(packed)
            return answer
        if place in self._without_file:
            return SolverError("a worker could not read its models: pass the problem to solve")
        self._without_file.add(place)
        self._waiting.appendleft(place)
        return None

    def _restart(self) -> bool:
        """Replace the processes after one died; return whether the new ones start."""
        self._executor = self._new_pool()
        try:
            self._executor.submit(int).result()
        except BrokenExecutor:
            return False
        self._is_broken = False
        return True

    @property
    def _error(self) -> SolverError:
        """Error to record for the remaining problems if no worker can be started any more."""
        if not self._is_own:
            return SolverError("the executor broke or was shut down: pass a new one, or none")
        return SolverError(
            "processes die while they start, perhaps for lack of memory: use fewer workers"
        )

    def _new_pool(self) -> Any:
        """Return the built-in pool, with one thread for compiled loops in each process."""
        from joblib.externals.loky import ProcessPoolExecutor

        alone = {"NUMBA_NUM_THREADS": "1"}
        return ProcessPoolExecutor(self._count, initializer=_prepare_worker, env=alone)


def _prepare_worker() -> None:
    """Prepare a worker: ignore Ctrl-C, and exempt loaded objects from garbage collection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()  # joblib's processes collect garbage once a second
