"""The stochastic shortest path model with dead-ends (paper, section 2.1), and its builders.

The builders check their input; errors name the state and the action.
"""

from __future__ import annotations

import csv
import logging
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property, partial
from itertools import compress, zip_longest
from os import PathLike
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import (
    PROBABILITY_SUM,
    SINGLE_PRECISION_SUM,
    BoolArray,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    read_only,
    segment_sums,
)
from ssp_lp.errors import (
    Argument,
    ModelError,
    ModelWarning,
    check_whole,
    did_you_mean,
    in_short,
    is_number,
    wrong_argument,
)
from ssp_lp.model.arguments import explained, holder_of
from ssp_lp.model.graph import Graph, dead_ends as lost_states, end_components
from ssp_lp.model.parameters import Affine, PlacedParameter
from ssp_lp.model.report import Table

if TYPE_CHECKING:
    from ssp_lp.model.failure_product import FailureSSP

Costs = float | Mapping[str, float]
"""Cost of an outcome: a number, or numbers by name, one of which is the model's own cost."""

Outcomes = Iterable[tuple[float, Hashable, Costs]]

StateSet = Iterable[Hashable] | Callable[[Any], bool]
"""States by their labels, or a predicate on states."""

DeadEnds = str | StateSet
"""States or labels of states of the model, or one label, or a predicate on states."""

ENDS = ("goal", "dead_end", "gave_up", "wandering", "unfinished")
"""Names of the ways in which an episode ends, in reports."""

_ENDS_THERE = "if runs end there, name it in dead_ends; the states:"
_UNHASHABLE = "list, dict, set or array: write tuple(array.tolist())"
_PROGRESS_EVERY = 10_000
_EXPLORING = logging.getLogger("ssp_lp.exploring")
_MOST_COST = 1e150  # its square is still finite
_NO_REWARDS = (
    "costs must be >= 0 (rewards? pass costs=-rewards; a constant added to every step changes "
    "the problem)"
)


@dataclass(frozen=True, eq=False, repr=False)
class SSP(Graph, ReadOnlyCopies):
    """A finite Markov decision process with goal states, in sparse state-action-pair form.

    Build it with :meth:`from_transitions`, :meth:`from_arrays` or :meth:`from_successors`, which
    check their input; the fields below are read-only afterwards. An *outcome* of a pair is
    (probability, successor, cost); two outcomes of a pair may share a successor and differ in
    cost. Goal states are absorbing and free (the paper's state 0): an episode ends there, so
    they have no pairs. A state without pairs that is not a goal is a dead-end.
    """

    states: Sequence[Hashable]  # [states] labels
    action_names: Sequence[Hashable]  # the distinct action labels
    pair_action: IntArray  # [pairs] position in action_names
    costs: FloatArray  # [outcomes], finite and non-negative
    goal_mask: BoolArray  # [states]
    state_labels: Mapping[str, IntArray]  # label -> state indices; for reports only
    exact_costs: Mapping[float, Fraction]  # costs that were given as fractions
    named_costs: Mapping[str, FloatArray] = field(kw_only=True, default_factory=dict)
    """Costs by name, [outcomes] each, for ``secondary_cost("fuel")``.

    If ``costs`` has a name, it is one of them.
    """
    counts: FloatArray | None = field(kw_only=True, default=None)
    """Count of each outcome, [outcomes]; None: the model was not made of counts."""
    parameters: Mapping[str, PlacedParameter] = field(kw_only=True, default_factory=dict)
    """Parameters on which probabilities and costs depend, by name."""

    @classmethod
    @explained
    def from_transitions(
        cls,
        transitions: Mapping[Hashable, Mapping[Hashable, Outcomes]],
        goal: Iterable[Hashable],
        *,
        cost: str | None = None,
        state_labels: Mapping[str, StateSet] | None = None,
        dead_ends: DeadEnds | None = None,
        treat_actionless_as_dead_ends: bool = False,
        normalise: bool = False,
    ) -> SSP:
        """Build a model from nested dicts ``{state: {action: [(probability, successor, cost)]}}``.

        Args:
            transitions: every state that is not a goal must be a key, unless states without actions
                are accepted. Actions of a goal state are ignored: the episode ends there. A cost
                may be a dict of named costs, ``{"time": 4.0, "fuel": 1.5}``, with the same names
                everywhere. Probabilities and costs may be expressions of a
                :class:`ssp_lp.Parameter`.
            goal: the labels of the goal states.
            cost: if costs have names, the name of the model's own cost, which problems minimise;
                other costs can be limited, ``secondary_cost("fuel") <= 3``.
            state_labels: names for sets of states ("wall"), used in reports and limits; each with
                its states, or a predicate on states.
            dead_ends: states from which no action reaches the goal, given by their labels or by a
                predicate. Any other state without actions that is not a goal is then an error.
            treat_actionless_as_dead_ends: without ``dead_ends``, accept all states without actions
                that are not goals.
            normalise: divide probabilities by their sum if it misses 1 by at most 1e-5.

        Returns:
            The model. Its states have the order of the keys, followed by goals that are not keys.

        Raises:
            ModelError: the error names the wrong state and action.

        Example:
            >>> model = SSP.from_transitions(
            ...     {"start": {"go": [(0.9, "goal", 1.0), (0.1, "pit", 1.0)]}, "pit": {}},
            ...     goal={"goal"}, dead_ends={"pit"})
            >>> model.n_states, model.n_pairs, model.n_outcomes
            (3, 1, 2)
        """
        if not isinstance(transitions, Mapping):
            raise ModelError(
                "a model must be {state: {action: [(probability, successor, cost), ...]}}, not "
                f"{in_short(transitions)}"
            )
        goals = dict.fromkeys(no_lone_string(goal, "goal"))
        listed = [*transitions, *(g for g in goals if g not in transitions)]
        is_closed = dead_ends is None and not treat_actionless_as_dead_ends
        flat, n_listed = FlatModel(listed, cost, closed=is_closed), len(listed)
        for state in flat.states:  # it grows if states without actions are not listed
            reached = state in goals
            flat.add(state, {} if reached else transitions.get(state, {}), goal=reached)
        led_to = {flat.states[place] for place in set(flat.arrays["successors"])}
        for state in goals.keys() - led_to - transitions.keys():
            if nearest := did_you_mean(state, (s for s in flat.states if s not in goals)):
                raise ModelError(f"no action leads to the goal {state!r}{nearest}")
        if dead_ends is None:
            _warn_of_misspelled(flat.states, np.arange(len(flat.states)) >= n_listed)
        return cls.from_arrays(
            **flat.arrays,
            state_labels=state_labels,
            dead_ends=dead_ends,
            treat_actionless_as_dead_ends=treat_actionless_as_dead_ends,
            normalise=normalise,
        )

    @classmethod
    @explained
    def from_successors(
        cls,
        start: Hashable | Iterable[Hashable],
        successors: Callable[[Any], Mapping[Hashable, Outcomes]],
        goal: Callable[[Any], bool] | Iterable[Hashable],
        *,
        cost: str | None = None,
        state_limit: int = 1_000_000,
        progress: Callable[[int], None] | None = None,
        state_labels: Mapping[str, StateSet] | None = None,
        dead_ends: DeadEnds | None = None,
        treat_actionless_as_dead_ends: bool = False,
        normalise: bool = False,
    ) -> SSP:
        """Explore a successor function breadth-first from the start and build the model.

        Args:
            start: a state, or a list or set of states, to explore from.
            successors: maps a state to ``{action: [(probability, successor, cost), ...]}``, where
                the cost may be a dict of named costs, as in :meth:`from_transitions`.
            goal: a predicate on states, or the goal states.
            cost: if costs have names, the name of the model's own cost.
            state_limit: greatest number of states; more raise an error.
            progress: called at intervals with the number of states found so far.
            state_labels: names for sets of states, as in ``from_transitions``.
            dead_ends: states from which no action reaches the goal, given by their labels or by a
                predicate. Any other state without actions that is not a goal is then an error.
            treat_actionless_as_dead_ends: without ``dead_ends``, accept all states without actions
                that are not goals.
            normalise: divide probabilities by their sum if it misses 1 by at most 1e-5.

        Raises:
            ModelError: the error names the wrong state and action, or the limit that was passed.
        """
        check_whole("state_limit", state_limit)
        is_goal = _test_of(goal, "goal")
        flat = FlatModel(_first_states(start), cost)
        for done, state in enumerate(flat.states, start=1):  # it grows during the loop
            reached = is_goal(state)
            flat.add(state, {} if reached else successors(state), goal=reached)
            count = len(flat.states)
            if count > state_limit:
                raise ModelError(
                    f"more than state_limit={state_limit:,} states are reachable; raise the limit "
                    f"or bound the model (the last state expanded was {state!r})"
                )
            if done % _PROGRESS_EVERY == 0:
                _EXPLORING.debug("%d states found, %d expanded", count, done)
            if progress is not None and (done % _PROGRESS_EVERY == 0 or done == count):
                progress(count)
        _EXPLORING.info("%d states found", len(flat.states))
        if dead_ends is None:
            idle = np.diff(flat.arrays["pair_offsets"]) == 0
            idle[flat.arrays["goal_states"]] = False
            _warn_of_misspelled(flat.states, idle)
        return cls.from_arrays(
            **flat.arrays,
            state_labels=state_labels,
            dead_ends=dead_ends,
            treat_actionless_as_dead_ends=treat_actionless_as_dead_ends,
            normalise=normalise,
        )

    @classmethod
    @explained
    def implicit(
        cls,
        start: Hashable | Iterable[Hashable],
        successors: Callable[[Any], Any],
        goal: Callable[[Any], Any] | Iterable[Hashable],
        *,
        cost: str | None = None,
        cost_bound: Callable[[Any], Any] | None = None,
        failure_bound: Callable[[Any], Any] | None = None,
        growth: float = 2.0,
        vectorised: bool = False,
        state_labels: Mapping[str, StateSet] | None = None,
    ) -> ImplicitSSP:
        """Create a model from its successor function, explored only as far as a problem needs it.

        ``solve`` explores from the start and repeats two steps. It solves the explored part, in
        which states that were found but not expanded (the fringe) either reach the goal at their
        cost bound and failure bound, or fail at no cost. Then it expands the states of the fringe
        on which the solution depends. If there are none, the solution is optimal for the whole
        model. States without actions that are not goals are dead-ends.

        Args:
            start: a state, or a list or set of states, in which episodes may begin.
            successors: maps a state to ``{action: [(probability, successor, cost), ...]}``, where
                the cost may be a dict of named costs, as in :meth:`from_transitions`. Calls with
                equal states must return equal results.
            goal: a predicate on states, or the goal states.
            cost: if costs have names, the name of the model's own cost.
            cost_bound: maps a state to a lower bound of ``E[cost; goal] / Pr(goal)`` of *every*
                policy from there, also of one that fails often: the least cost of a path to the
                goal is such a bound, and so is h_max; the optimum of ``MinCost`` is not. The bound
                is infinite where no policy reaches the goal. If costs have names, it may be
                ``{name: bound}``. None: 0.
            failure_bound: maps a state to a lower bound of the failure probability of every policy
                from there, undiscounted even if the problem has a discount. None: 0.
            growth: factor by which the explored part grows from round to round, above 1; if
                ``successors`` takes a millisecond or more, 1.25 to 1.5 is faster.
            vectorised: states are whole numbers >= 0, and all functions take an array of them.
                ``successors`` returns ``{"actions": [states] number of actions of each, "outcomes":
                [pairs] number of outcomes of each, "successors", "probabilities", "costs":
                [outcomes]}``; actions are named 0, 1, ... within each state.
            state_labels: names for sets of states, as in ``from_transitions``; with ``vectorised``
                each set is a predicate on one state.

        Returns:
            The model, for ``MCMP(model, start, ...)`` and other criteria of costs and probabilities
            (case M). Functions that need all of its states raise ModelError.

        Raises:
            ModelError: a growth that is not above 1.

        Example:
            >>> from ssp_lp import MCMP, solve
            >>> def steps(k):  # a walk on all whole numbers
            ...     return {"left": [(1.0, k - 1, 1.0)],
            ...             "right": [(0.9, k + 1, 1.0), (0.1, "hole", 1.0)]} if k != "hole" else {}
            >>> walk = SSP.implicit(0, steps, goal={3}, cost_bound=lambda k: abs(k - 3)
            ...                     if k != "hole" else float("inf"))
            >>> solution = solve(MCMP(walk, 0, failure_budget=0.5, give_up="dead_ends"))
            >>> round(solution.objective, 9), solution.policy.action(0)
            (2.71, 'right')
        """
        if not (is_number(growth) and 1.0 < growth < float("inf")):
            raise wrong_argument("growth", "be a number above 1", growth)
        begin = _first_states(start)
        tests = {name: _test_of(members, name) for name, members in (state_labels or {}).items()}
        is_goal = _test_of(goal, "goal")
        if vectorised and not callable(goal):
            is_goal = partial(np.isin, test_elements=np.array([*goal]))
        bounds = cost_bound, failure_bound
        for name, bound in (("cost_bound", cost_bound), ("failure_bound", failure_bound)):
            if not (bound is None or callable(bound)):
                raise wrong_argument(name, "be a function of a state", bound)
        if UNEXPLORED in tests:
            raise ModelError(f"state label {UNEXPLORED!r} is reserved for unexplored states")
        return ImplicitSSP(begin, successors, is_goal, tests, bounds, cost, growth, vectorised)

    @classmethod
    @explained
    def from_frame(
        cls,
        table: Any,
        goal: Iterable[Hashable],
        *,
        state: str | Sequence[str] = "state",
        action: str = "action",
        successor: str | Sequence[str] = "successor",
        probability: str = "probability",
        cost: str | Sequence[str] = "cost",
        state_labels: Mapping[str, StateSet] | None = None,
        dead_ends: DeadEnds | None = None,
        normalise: bool = False,
    ) -> SSP:
        """Build a model from a table of outcomes, a row for each, in any order.

        A state without rows that is not a goal is a dead-end.

        Args:
            table: a ``DataFrame`` of pandas or polars, or any other object with columns by name,
                such as a dict of lists.
            goal: the goal states.
            state: the column of the state in which the action is taken, or several columns, which
                make a tuple.
            action: the column of the action.
            successor: the column of the next state, or as many columns as ``state`` has.
            probability: the column of the probability.
            cost: the column of the cost, or several columns: the first one is the model's own cost,
                and each can be limited, ``secondary_cost("fuel") <= 3``.
            state_labels: names for sets of states, as in ``from_transitions``.
            dead_ends: the states without rows that are not goals; if one is missing here, that is
                an error. None: all are accepted.
            normalise: divide probabilities by their sum if it misses 1 by at most 1e-5.

        Raises:
            ModelError: a column that is missing or of another length, an empty cell, or a wrong
                state or action, which the error names.

        Example:
            >>> table = {"state": ["a", "a"], "action": ["go", "go"], "successor": ["home", "pit"],
            ...          "probability": [0.9, 0.1], "time": [4, 2], "fuel": [1.5, 0.5]}
            >>> model = SSP.from_frame(table, goal={"home"}, cost=["time", "fuel"])
            >>> model.n_outcomes, list(model.named_costs)
            (2, ['time', 'fuel'])
        """
        if isinstance(table, (str, PathLike)):
            raise ModelError(f"the table is a path: SSP.from_csv({str(table)!r}, ...) reads it")
        if isinstance(table, Sequence):
            raise ModelError(
                "the table is a list: give its columns, {'state': [...], ...}, or a frame"
            )
        if not (costs := [cost] if isinstance(cost, str) else [*cost]):
            raise ModelError("cost: name at least one column")
        rows = _rows_of(table, [state, action, successor, probability, *costs])
        options = {"state_labels": state_labels, "dead_ends": dead_ends, "normalise": normalise}
        return cls._from_rows(rows, goal, cost, options)

    @classmethod
    def _from_rows(
        cls,
        rows: Iterable[Sequence[Any]],
        goal: Iterable[Hashable],
        cost: str | Sequence[str],
        options: Mapping[str, Any],
    ) -> SSP:
        """Build a model from rows of outcomes.

        Args:
            rows: a row for each outcome: state, action, successor, probability, then its costs.
            goal: the goal states.
            cost: the name of the cost, or a list of the names of several costs.
            options: further arguments of :meth:`from_transitions`.
        """
        transitions: dict[Hashable, dict[Hashable, list[tuple[float, Hashable, Costs]]]] = {}
        several = not isinstance(cost, str)
        for here, action, there, chance, *paid in rows:
            outcome = dict(zip(cost, paid, strict=True)) if several else paid[0]
            outcomes = transitions.setdefault(here, {}).setdefault(action, [])
            outcomes.append((chance, there, outcome))
        own = cost[0] if several else None
        return cls.from_transitions(
            transitions, goal, cost=own, treat_actionless_as_dead_ends=True, **options
        )

    @classmethod
    @explained
    def from_counts(
        cls,
        table: Any,
        goal: Iterable[Hashable],
        *,
        state: str | Sequence[str] = "state",
        action: str = "action",
        successor: str | Sequence[str] = "successor",
        count: str = "count",
        cost: str | Sequence[str] = "cost",
        state_labels: Mapping[str, StateSet] | None = None,
        dead_ends: DeadEnds | None = None,
    ) -> SSP:
        """Build a model from counted outcomes: probabilities are relative frequencies.

        The counts of rows of the same outcome are added up. ``Boxes.from_counts(model)`` gives an
        interval for each probability. ``posterior_draws(model, 100, seed=0)`` draws models that are
        likely given the counts.

        Args:
            table: a frame or a dict of columns, as in :meth:`from_frame`, or rows ``(state,
                action, successor, count, cost)``, in any order.
            goal: the goal states.
            state: the column of the state, or several, as in :meth:`from_frame`.
            action: the column of the action.
            successor: the column of the next state, or as many columns as ``state`` has.
            count: the column of the outcome's count, a whole number >= 0. A successor that is
                possible but was never seen needs a row of count 0.
            cost: the column of the cost, or several columns, as in :meth:`from_frame`.
            state_labels: names for sets of states, as in ``from_transitions``.
            dead_ends: the states without rows that are not goals, as in :meth:`from_frame`.

        Raises:
            ModelError: as in :meth:`from_frame`, a count that is not a whole number >= 0, or an
                action that was never taken; the error names it.

        Example:
            >>> model = SSP.from_counts(
            ...     [("a", "go", "home", 90, 1.0), ("a", "go", "pit", 10, 1.0)], goal={"home"})
            >>> model.probabilities.tolist(), model.counts.tolist()
            ([0.9, 0.1], [90.0, 10.0])
        """
        costs = [cost] if isinstance(cost, str) else [*cost]
        form = ["state", "action", "successor", "count", *costs]
        needed, goals = ", ".join(form), dict.fromkeys(no_lone_string(goal, "goal"))
        names: list[str | Sequence[str]] = [state, action, successor, count, *costs]
        if isinstance(table, (Sequence, Iterator)):
            listed, names = list(table), [*form]
            for k, row in enumerate(listed):
                is_row = isinstance(row, (Sequence, np.ndarray)) and not isinstance(row, str)
                if not is_row or len(row) != len(form):
                    raise ModelError(f"row {k} of the table must be ({needed}), not {row!r}")
            table = {name: [row[k] for row in listed] for k, name in enumerate(form)}
        tally: dict[Hashable, dict[Hashable, Counter[tuple[Any, ...]]]] = {}
        for row in _rows_of(table, names):
            here, name, there, number, *paid = row
            is_count = is_number(number) and not isinstance(number, bool)
            if not (is_count and number >= 0 and number == number // 1):
                raise ModelError(f"row {row!r} of the table, ({needed}): the count "
                                 f"{number!r} is not a whole number >= 0")  # fmt: skip
            tally.setdefault(here, {}).setdefault(name, Counter())[there, *paid] += int(number)
        if not tally:
            raise ModelError("the table has no rows")
        rows, counts = list[tuple[Any, ...]](), list[int]()
        for here, actions in tally.items():
            for name, seen in actions.items():
                if not (total := seen.total()) and here not in goals:
                    told = f"action {name!r} of state {here!r} has no counts"
                    raise ModelError(f"{told}: leave it out")
                for (there, *paid), n in seen.items():
                    rows.append((here, name, there, n / max(total, 1), *paid))
                counts += [] if here in goals else seen.values()  # actions of goals are ignored
        options = {"state_labels": state_labels, "dead_ends": dead_ends}
        model = cls._from_rows(rows, goals, cost, options)
        return replace(model, counts=read_only(counts, np.float64))

    @classmethod
    @explained
    def from_csv(
        cls,
        path: str | PathLike[str],
        goal: Iterable[Hashable],
        *,
        probability: str = "probability",
        cost: str | Sequence[str] = "cost",
        **options: Any,
    ) -> SSP:
        """Build a model from a CSV file: a row of column names, then a row for each outcome.

        Args:
            path: the file. States and actions are strings; numbers may be fractions such as 1/3.
            goal: the goal states.
            probability: the column of the probability.
            cost: the column of the cost, or several columns, as in :meth:`from_frame`.
            options: further arguments of :meth:`from_frame`.

        Raises:
            ModelError: no such column, a cell that is empty or no number, or a wrong state or
                action, which the error names.
            OSError: the file cannot be read.
        """
        names = [probability, *([cost] if isinstance(cost, str) else cost)]
        table = {
            name: [_number_in_cell(path, name, *at) for at in enumerate(cells, start=2)]
            if name in names
            else cells
            for name, cells in csv_columns(path).items()
        }
        try:
            return cls.from_frame(table, goal, probability=probability, cost=cost, **options)
        except ModelError as error:
            raise ModelError(f"{path}: ", *error.args) from error

    @classmethod
    @explained
    def from_arrays(
        cls,
        *,
        pair_offsets: npt.ArrayLike,
        outcome_offsets: npt.ArrayLike,
        successors: npt.ArrayLike,
        probabilities: npt.ArrayLike,
        costs: npt.ArrayLike,
        goal_states: npt.ArrayLike,
        states: Sequence[Hashable] | None = None,
        actions: Sequence[Hashable] | None = None,
        state_labels: Mapping[str, StateSet] | None = None,
        exact_costs: Mapping[float, Fraction] | None = None,
        named_costs: Mapping[str, npt.ArrayLike] | None = None,
        parameters: Mapping[str, PlacedParameter] | None = None,
        dead_ends: DeadEnds | None = None,
        treat_actionless_as_dead_ends: bool = False,
        normalise: bool = False,
    ) -> SSP:
        """Build a model from CSR arrays; arrays of the right type are not copied.

        Args:
            pair_offsets: [states + 1]; the pairs of state s are ``pair_offsets[s] :
                pair_offsets[s + 1]``.
            outcome_offsets: [pairs + 1]; the outcomes of pair k, in the same way.
            successors: [outcomes], indices of states.
            probabilities: [outcomes].
            costs: one number, or one per pair, or one per outcome.
            goal_states: indices of the goal states, which must have no pairs.
            states: labels of the states; None: their indices.
            actions: [pairs] labels of the actions; None: their position within the state.
            state_labels: names for sets of states, as in ``from_transitions``.
            exact_costs: float cost -> the fraction that it stands for, such as 1/3; other costs
                stand for their shortest decimal. The exact costs determine which accumulated costs
                can occur.
            named_costs: costs by name, in the forms of ``costs``, for ``secondary_cost("fuel")``.
            parameters: parameters by name, with the derivatives of probabilities and costs.
            dead_ends: labels of states from which no action reaches the goal, or a predicate on
                labels. Any other state without pairs that is not a goal is then an error.
            treat_actionless_as_dead_ends: without ``dead_ends``, accept all states without pairs
                that are not goals.
            normalise: divide probabilities by their sum if it differs from 1 by at most 1e-5, as in
                single precision; otherwise the limit is 1e-9.

        Raises:
            ModelError: the error names the wrong state and action.
        """
        pairs = read_only(_indices("pair_offsets", pair_offsets), np.int64)
        outcomes = read_only(_indices("outcome_offsets", outcome_offsets), np.int64)
        n_states, n_pairs, n_outcomes = pairs.size - 1, outcomes.size - 1, int(outcomes[-1:].sum())
        check_offsets("pair_offsets", pairs, n_pairs)
        check_offsets("outcome_offsets", outcomes, n_outcomes)
        names = range(n_states) if states is None else states
        if len(names) != n_states:
            raise ModelError(f"{len(names)} state labels given for {n_states} states")
        if not isinstance(names, range) and len(set(names)) < n_states:
            twice = next(state for state, n in Counter(names).items() if n > 1)
            raise ModelError(f"{twice!r} is the label of several states")
        action_names, pair_action = _action_table(actions, pairs)
        target, chance = _indices("successors", successors), read_only(probabilities, np.float64)
        if target.shape != (n_outcomes,) or chance.shape != (n_outcomes,):
            raise ModelError(f"successors and probabilities must have length {n_outcomes}")
        draft = cls(
            states=names,
            action_names=action_names,
            pair_action=read_only(pair_action),
            pair_offsets=pairs,
            outcome_offsets=outcomes,
            successors=target,
            probabilities=chance,
            costs=_costs_of_outcomes(costs, outcomes),
            goal_mask=goal_mask_of(goal_states, n_states),
            state_labels={},
            exact_costs=dict(exact_costs or {}),
            named_costs={
                k: _costs_of_outcomes(c, outcomes) for k, c in (named_costs or {}).items()
            },
            parameters=dict(parameters or {}),
        )
        strange = (target < 0) | (target >= n_states)
        _refuse_outcomes(draft, strange, "has a successor that is not a state")
        model = replace(
            draft,
            successors=read_only(target, np.int32),
            probabilities=_checked_probabilities(draft, normalise),
            state_labels=_indexed_labels(draft, state_labels or {}),
        )
        _check_idle_states(model, dead_ends, accept=treat_actionless_as_dead_ends)
        return model

    def with_cost(self, name: str) -> SSP:
        """Return the model with one of its named costs as the cost that problems minimise.

        Raises:
            ModelError: the model has no cost of this name.
        """
        return replace(self, costs=self.cost_named(name))

    def with_parameters(self, **values: float) -> SSP:
        """Return the same model with other values of its parameters.

        Args:
            values: new values by name; the other parameters keep their values.

        Raises:
            ModelError: an unknown parameter, a value that is not a number, or a probability or cost
                that is out of range for these values.

        Example: see :class:`ssp_lp.Parameter`.
        """
        model, placed = self, dict(self.parameters)
        for name, value in values.items():
            if name not in placed:
                nearest = did_you_mean(name, placed, "its parameters:")
                raise ModelError(f"the model has no parameter {name!r}{nearest}")
            if not is_number(value):
                raise wrong_argument(name, "be a number", value)
            parameter, rise = placed[name], float(value) - placed[name].value
            placed[name] = replace(parameter, value=float(value))
            model = model.with_moves(parameter.probabilities, parameter.costs, rise)
        try:
            chances = _checked_probabilities(model)
        except ModelError as error:
            told = ", ".join(f"{name}={placed[name].value:g}" for name in values)
            raise ModelError(f"with {told}, {error}") from error
        return replace(model, parameters=placed, probabilities=chances)

    def with_moves(
        self,
        probabilities: Mapping[int, float],
        costs: Mapping[tuple[str, int], float],
        step: float,
    ) -> SSP:
        """Return the model with numbers changed by ``step`` times a derivative, without checks.

        Args:
            probabilities: outcome -> derivative of its probability.
            costs: (name of a cost, as in ``costs_by_name``; outcome) -> derivative of the cost.
            step: factor of all derivatives.
        """
        chances, every = self.probabilities.copy(), dict(self.costs_by_name)
        for outcome, slope in probabilities.items():
            chances[outcome] += step * slope
        every |= {name: np.array(every[name]) for name, _ in costs}
        for (name, outcome), slope in costs.items():
            every[name][outcome] += step * slope
        named = {name: read_only(every[name]) for name in self.named_costs}
        own = read_only(next(iter(every.values())))
        return replace(self, probabilities=read_only(chances), costs=own, named_costs=named)

    @explained
    def with_labels(self, state_labels: Mapping[str, StateSet]) -> SSP:
        """Return the same model with further names for sets of states, as in ``from_transitions``.

        Raises:
            ModelError: an unknown member, or a name that reports use already.

        Example:
            >>> model = SSP.from_transitions({"a": {"go": [(1.0, "b", 1.0)]}}, goal={"b"})
            >>> model.with_labels({"begin": ["a"]}).state_labels["begin"].tolist()
            [0]
        """
        further = _indexed_labels(self, state_labels)
        return replace(self, state_labels={**self.state_labels, **further})

    @explained
    def with_dead_ends(self, dead_ends: DeadEnds | None) -> Self:
        """Check that the states without actions are goals or given dead-ends; return the model.

        Args:
            dead_ends: states from which no action reaches the goal, or labels of states, or a
                predicate on states; a string also matches a state that prints like it, such as 3.
                None: nothing is checked.

        Raises:
            ModelError: a state without actions is neither a goal nor given, or the goal can be
                reached from a given state.
        """
        if dead_ends is not None:
            _check_idle_states(self, dead_ends, accept=False)
        return self

    def __dir__(self) -> list[str]:
        """Return the public names of the model, for completion."""
        return [name for name in super().__dir__() if not name.startswith("_")]

    @property
    def costs_by_name(self) -> Mapping[str, FloatArray]:
        """All costs by name, [outcomes] each; the model's own is first, named "cost" by default."""
        named = self.named_costs
        same = (n for n, c in named.items() if c is self.costs or np.array_equal(c, self.costs))
        own = next(same, "cost" if "cost" not in named else "own cost")
        return {own: self.costs, **{n: costs for n, costs in named.items() if n != own}}

    def cost_named(self, name: str) -> FloatArray:
        """Return a cost by its name, [outcomes].

        Raises:
            ModelError: the model has no cost of this name.
        """
        if name not in self.named_costs:
            nearest = did_you_mean(name, self.named_costs, "its costs by name:")
            raise ModelError(f"the model has no cost {name!r}{nearest}")
        return self.named_costs[name]

    @cached_property
    def _index(self) -> Mapping[Hashable, int]:
        """Indices of states by their labels."""
        return {label: i for i, label in enumerate(self.states)}

    def index_of(self, state: Hashable, place: str = "") -> int:
        """Return the index of the state with a label.

        Args:
            state: the label.
            place: name of the argument with the label, for the error.

        Raises:
            ModelError: no state has the label.
        """
        index = self.find(state)
        if index is None:
            where = f"{place}: " if place else ""
            raise ModelError(f"{where}{state!r} is not a state of the model{self.hint(state)}")
        return index

    def find(self, state: Hashable) -> int | None:
        """Return the index of the state with a label, or None."""
        if isinstance(self.states, range):
            is_index = isinstance(state, (int, np.integer)) and state in self.states
            return int(cast("int", state)) if is_index else None
        try:
            return self._index.get(state)
        except TypeError:  # not hashable, such as a list
            return None

    def hint(self, state: Hashable) -> str:
        """Return a hint for the error about an unknown state."""
        if isinstance(self.states, range):
            return f": states are 0 .. {len(self.states) - 1}"
        return did_you_mean(state, self.states, "its states:")

    def places_of(self, state: Hashable) -> IntArray:
        """Return the indices of the states with a label: one, in a product perhaps several.

        Raises:
            ModelError: no state has the label.
        """
        return np.array([self.index_of(state)])

    def action_of(self, pair: int) -> Hashable:
        """Return the label of the action of a pair; :class:`ModelError` for an unknown pair."""
        try:
            return self.action_names[int(self.pair_action[pair])]
        except (IndexError, TypeError) as error:
            last = len(self.pair_action) - 1
            raise ModelError(f"{pair!r} is not a pair: pairs are 0 .. {last}") from error

    def pairs_of(self, state: int) -> range:
        """Return the pairs of a state."""
        return range(int(self.pair_offsets[state]), int(self.pair_offsets[state + 1]))

    def pair_of(self, state: int, action: Hashable) -> int:
        """Return the pair of a state and an action's label.

        Raises:
            ModelError: the state does not have the action.
        """
        for pair in self.pairs_of(state):
            if self.action_of(pair) == action:
                return pair
        raise ModelError(self.no_such_action(state, action))

    def no_such_action(self, state: int, action: Hashable) -> str:
        """Return an error text for an action that a state lacks; it suggests similar actions."""
        nearest = did_you_mean(action, map(self.action_of, self.pairs_of(state)), "it has")
        return f"state {self.states[state]!r} has no action {action!r}{nearest}"

    def describe_pair(self, pair: int) -> str:
        """Return a pair in words: "action 'go' of state 'start'"."""
        state = int(np.searchsorted(self.pair_offsets, pair, side="right")) - 1
        return f"action {self.action_of(pair)!r} of state {self.states[state]!r}"

    def _describe_outcome(self, outcome: int) -> str:
        """Return the pair of an outcome in words, for an error."""
        pair = int(np.searchsorted(self.outcome_offsets, outcome, side="right")) - 1
        return self.describe_pair(pair)

    def of_all_states(self, made: FloatArray) -> FloatArray:
        """Return values of all states, [states], from those of the states that this object holds.

        An ordinary model holds all states, so the values are returned unchanged. A model that is
        divided among processes overrides this to join the values of its parts.
        """
        return made

    def staying_free(self, free: BoolArray) -> BoolArray:
        """Return a mask of the states that lie in an end component of free pairs, [states].

        Args:
            free: mask of the free pairs, [pairs].
        """
        return np.asarray(end_components(self, free)[0] >= 0)

    @property
    def failure_label(self) -> FailureSSP | None:
        """The model itself if it is a product with the failure label; otherwise None."""
        return None

    @property
    def _sizes(self) -> dict[str, int]:
        """Numbers of states, pairs, outcomes and goals."""
        return {
            "states": len(self.pair_offsets) - 1,
            "pairs": len(self.outcome_offsets) - 1,
            "outcomes": len(self.successors),
            "goals": int(self.goal_mask.sum()),
        }

    def __repr__(self) -> str:
        """Return a line with the sizes."""
        sizes = ", ".join(f"{count:,} {name}" for name, count in self._sizes.items())
        return f"{type(self).__name__}({sizes})"

    def _repr_html_(self) -> str:
        """Return the sizes as a table, for notebooks."""
        return Table([*self._sizes.items()], title=type(self).__name__).html()

    @cached_property
    def cached_facts(self) -> dict[str, Any]:
        """Stored facts about the model's graph, by name (``ssp_lp.model.graph``)."""
        return {}


UNEXPLORED = "unexplored"
"""Label of an implicit model's fringe (found, not expanded), and of the state where it fails."""


class _NotExploredError(ModelError, AttributeError):
    """An attribute of an implicit model needs every state, but some are not explored."""


class ImplicitSSP(SSP):
    """A model given by its successor function (:meth:`SSP.implicit`).

    Its states are unknown before it is solved: functions that need its arrays raise
    :class:`ModelError`.
    """

    parameters: Mapping[str, PlacedParameter] = MappingProxyType({})

    def __init__(
        self,
        begin: Sequence[Hashable],
        expand: Callable[[Any], Any],
        is_goal: Callable[[Any], Any],
        labels: Mapping[str, Callable[[Any], bool]],
        bounds: tuple[Callable[[Any], Any] | None, Callable[[Any], Any] | None],
        cost: str | None,
        growth: float,
        is_vectorised: bool,
    ) -> None:
        """Store the arguments of :meth:`SSP.implicit`; ``bounds`` are of cost and failure."""
        self.begin, self.expand, self.is_goal, self.labels = begin, expand, is_goal, labels
        self.bounds, self.cost, self.growth = bounds, cost, growth
        self.is_vectorised = is_vectorised

    def __getattr__(self, name: str) -> Any:
        """Reject an attribute that needs every state of the model.

        Raises:
            ModelError: always.
        """
        raise _NotExploredError(
            f"an implicit model has no {name!r} before it is explored: take "
            "solution.problem.model, the part that solve explored, or build all of it, "
            "SSP.from_successors(...)"
        )

    def __repr__(self) -> str:
        """Return a line with the first states of episodes and the given bounds."""
        names = zip(("cost_bound", "failure_bound"), self.bounds, strict=True)
        given = "".join(f", {name}=..." for name, bound in names if bound is not None)
        return f"SSP.implicit({', '.join(map(repr, self.begin[:2]))}, ...{given})"

    _repr_html_ = __repr__

    @property
    def assumption(self) -> str:
        """Assumption of every solution in words: the given bounds hold; "" if none is given."""
        words = ("no policy reaches the goal for less than cost_bound, given that it does",
                 "no policy fails less than failure_bound")  # fmt: skip
        given = zip(words, self.bounds, strict=True)
        return " and ".join(word for word, bound in given if bound is not None)


def check_model(model: object, verb: str) -> None:
    """Check that an argument is a model.

    Args:
        model: the argument.
        verb: name of the function that was called, for the error.

    Raises:
        ModelError: it is no model.
    """
    if not isinstance(model, SSP):
        raise ModelError(f"{verb}() takes an SSP, not {in_short(model)}{holder_of(model, SSP)}")


class FlatModel:
    """A model under construction: the states found so far, and flat lists of the pairs. Mutable."""

    def __init__(self, states: list[Any], cost: str | None, *, closed: bool = False) -> None:
        """Begin with given states, all different; if ``closed``, every further state is an error.

        Args:
            states: states that are known from the beginning.
            cost: name of the model's own cost; None: the only cost.
        """
        self.states, self._closed, self._cost = states, closed, cost
        self._index = {state: i for i, state in enumerate(states)}
        lists = ("actions", "goal_states", "successors", "probabilities", "costs")
        self.arrays: dict[str, Any] = {name: [] for name in lists}  # arguments of ``from_arrays``
        self.arrays |= {"states": states, "pair_offsets": [0], "outcome_offsets": [0]}
        self.arrays |= {"exact_costs": {}, "named_costs": {}, "parameters": {}}

    def place_of(self, state: Hashable) -> int:
        """Return the position of a state in the model; a new state is appended."""
        if (place := self._index.get(state)) is None:
            place = self._index[state] = len(self.states)
            self.states.append(state)
        return place

    def add(self, state: Hashable, actions: Any, *, goal: bool) -> None:
        """Append a state's actions and new successors to the model.

        Raises:
            ModelError: actions that are not a dict, an outcome that is not a triple, an entry that
                is not a number, or a state that a closed model does not have.
        """
        if not isinstance(actions, Mapping):
            raise ModelError(
                f"state {state!r} needs a dict {{action: [(probability, successor, cost), ...]}}, "
                f"not {actions!r}"
            )
        flat, index, states = self.arrays, self._index, self.states
        successors, probabilities, costs = flat["successors"], flat["probabilities"], flat["costs"]
        for action, outcomes in actions.items():
            for outcome in outcomes:
                if not isinstance(outcome, (tuple, list)) or len(outcome) != 3:
                    raise ModelError(
                        f"action {action!r} of state {state!r}: an outcome must be a triple "
                        f"(probability, successor, cost), not {outcome!r}"
                    )
                probability, successor, cost = outcome
                try:
                    place = index.get(successor)
                except TypeError as error:
                    raise ModelError(
                        f"action {action!r} of state {state!r} leads to {in_short(successor)}: a "
                        f"state must not contain a {_UNHASHABLE}"
                    ) from error
                if place is None:
                    if self._closed:
                        raise ModelError(
                            f"action {action!r} of state {state!r} leads to {successor!r}, which "
                            "is neither a state of the model nor a goal"
                            f"{did_you_mean(successor, states, _ENDS_THERE)}"
                        )
                    place = index[successor] = len(states)
                    states.append(successor)
                successors.append(place)
                if type(probability) is not float:
                    if isinstance(probability, Affine):
                        self._place(probability, None, state, action)
                    probability = _number(probability, "probability", state, action)
                probabilities.append(probability)
                if type(cost) is not float:
                    named = isinstance(cost, Mapping)
                    cost = (self._paid_by_name if named else self._paid)(cost, state, action)
                costs.append(cost)
            flat["actions"].append(action)
            flat["outcome_offsets"].append(len(successors))
        if any(len(paid) < len(costs) for paid in flat["named_costs"].values()):
            raise ModelError(f"state {state!r} has unnamed costs: name them as elsewhere")
        if self._cost is not None and costs and not flat["named_costs"]:
            raise ModelError(f"no cost is called {self._cost!r}: give each cost a name")
        if goal:
            flat["goal_states"].append(len(flat["pair_offsets"]) - 1)
        flat["pair_offsets"].append(len(flat["actions"]))

    def _place(
        self, expression: Affine, cost: str | None, state: Hashable, action: Hashable
    ) -> None:
        """Record that the next outcome's probability or cost depends on parameters of the model.

        Args:
            expression: expression whose value the number is.
            cost: name of the cost; None: the number is the probability.
            state: state of the outcome, for the error.
            action: action of the outcome, for the error.

        Raises:
            ModelError: a parameter has another value elsewhere in the model.
        """
        outcome, placed = len(self.arrays["costs"]), self.arrays["parameters"]
        for name, value in expression.values.items():
            known = placed.setdefault(name, PlacedParameter(value))
            if known.value != value:
                raise ModelError(
                    f"action {action!r} of state {state!r}: parameter {name!r} has two values: "
                    f"{known.value:g}, {value:g}"
                )
            slope = expression.slopes[name]
            if cost is None:
                known.probabilities[outcome] = slope
            else:
                known.costs[cost, outcome] = slope

    def _paid(self, cost: Any, state: Hashable, action: Hashable, name: str = "cost") -> float:
        """Return a cost as a float; record its fraction or its parameters, if it has any."""
        if isinstance(cost, Affine):
            self._place(cost, name, state, action)
        paid = _number(cost, "cost", state, action)
        if isinstance(cost, Fraction):
            self.arrays["exact_costs"][paid] = cost
        return paid

    def _paid_by_name(self, costs: Mapping[Any, Any], state: Hashable, action: Hashable) -> float:
        """Return the model's own cost of an outcome, and record all its costs by name."""
        named: dict[str, list[float]] = self.arrays["named_costs"]
        where = f"action {action!r} of state {state!r}"
        if not self.arrays["costs"]:
            named |= {name: [] for name in costs}
        if not costs or named.keys() != costs.keys():
            told = "the costs " + ", ".join(map(repr, costs)) if costs else "no costs"
            others = ", ".join(map(repr, named)) or "none by name"
            raise ModelError(f"{where} has {told}, others {others}: name the same costs everywhere")
        if (self._cost is None and len(named) > 1) or self._cost not in (None, *named):
            known = ", ".join(map(repr, named))
            said = "" if self._cost is None else f", not {self._cost!r}"
            raise ModelError("choose the cost to minimise (", Argument("cost"), f"): {known}{said}")
        for name, cost in costs.items():
            named[name].append(self._paid(cost, state, action, name))
        return named[self._cost or next(iter(named))][-1]


def csv_columns(path: str | PathLike[str]) -> dict[str, list[str | None]]:
    """Return the columns of a CSV file by the names in its first row; an empty cell is None.

    Raises:
        ModelError: the file is not a text, or has no rows.
        OSError: it cannot be read.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            head, *rows = [row for row in csv.reader(file) if row] or [[]]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ModelError(f"{path} is not a CSV file: {error}") from error
    if not rows:
        raise ModelError(f"{path} holds no table: a row of names, then a row for each outcome")
    columns = zip_longest(*([cell.strip() or None for cell in row] for row in rows))
    return {name.strip(): [*cells] for name, cells in zip(head, columns, strict=False)}


def _number_in_cell(path: object, name: str, row: int, cell: str | None) -> float | Fraction | None:
    """Return the number in a cell of a CSV file, as a fraction if it is written as one."""
    try:
        return cell if cell is None else Fraction(cell) if "/" in cell else float(cell)
    except (ValueError, ZeroDivisionError) as error:
        complaint = (
            f"{path}, row {row}: {cell!r} in column {name!r} is not a number, such as 0.1 or 1/3"
        )
        raise ModelError(complaint) from error


def _rows_of(table: Any, names: Iterable[str | Sequence[str]]) -> Iterator[tuple[Any, ...]]:
    """Return the rows of some columns of a table; several columns named together make a tuple.

    Raises:
        ModelError: a column does not exist or has another length, or a cell is empty.
    """
    columns = [_column(table, name) for name in names]
    if len({*map(len, columns)}) > 1:
        raise ModelError("the columns of the table have different lengths")
    return zip(*columns, strict=True)


def _column(table: Any, name: str | Sequence[str]) -> list[Any]:
    """Return a column of a table as Python objects; several columns are joined to tuples.

    Raises:
        ModelError: the column does not exist, or a cell is empty.
    """
    if not isinstance(name, str):
        return list(_rows_of(table, name))
    try:
        known = [*(table if isinstance(table, Mapping) else table.columns)]
    except (AttributeError, TypeError) as error:
        raise ModelError(
            f"a table must have columns by name, {{'state': [...], ...}}, not be {in_short(table)}"
        ) from error
    if name not in known:
        nearest = did_you_mean(name, known, "it has")
        raise ModelError(f"the table has no column {name!r}{nearest}")
    column = table[name]
    cells = column.tolist() if isinstance(column, np.ndarray) else list(column)
    for row, cell in enumerate(cells):
        if isinstance(cell, np.generic):
            cell = cells[row] = cell.item()
        check_hashable(cell, f"row {row}, column {name!r} of the table")
        if cell is None or (cell == cell) is not True:  # not a number, or pandas's NA
            raise ModelError(f"row {row} of the table has nothing in the column {name!r}")
    return cells


def _first_states(start: Hashable | Iterable[Hashable]) -> list[Any]:
    """Return the distinct states of an argument that is a state, or a list or set of states."""
    several = isinstance(start, (list, set, frozenset))
    begin = [*cast(Iterable[Any], start)] if several else [start]
    for state in begin:
        check_hashable(state, "start")
    return [*dict.fromkeys(begin)]


def _test_of(members: StateSet, name: str) -> Callable[[Any], Any]:
    """Return the predicate of a set of states that is given by its members or by a predicate."""
    return members if callable(members) else set(no_lone_string(members, name)).__contains__


def no_lone_string(states: Iterable[Hashable], name: str) -> Iterable[Hashable]:
    """Return an argument's states; a single string is an error, not the set of its letters."""
    if isinstance(states, (list, tuple)):
        for state in states:
            check_hashable(state, name)
    if isinstance(states, str):
        raise ModelError(f"{name} must be a set of states, such as {{{states!r}}}, not a string")
    if not isinstance(states, Iterable):
        raise ModelError(f"{name} must be a set of states, not {in_short(states)}")
    return states


def check_hashable(state: Any, where: str) -> None:
    """Raise :class:`ModelError` for a value that cannot be a state; ``where`` is for the error."""
    try:
        hash(state)
    except TypeError as error:
        raise ModelError(
            f"{where}: {in_short(state)} cannot be a state: states must not contain a {_UNHASHABLE}"
        ) from error


def _number(value: Any, what: str, state: Hashable, action: Hashable) -> float:
    """Return a probability or cost as a float; :class:`ModelError` if it is not a number."""
    if not isinstance(value, (str, bytes)):
        with suppress(TypeError, ValueError, OverflowError):
            return float(value)
    complaint = f"action {action!r} of state {state!r} has a {what} that is not a number"
    raise ModelError(f"{complaint}: {in_short(value)}")


def check_offsets(name: str, offsets: IntArray, end: int) -> None:
    """Raise :class:`ModelError` unless a model's ``offsets`` rise from 0 to ``end``."""
    if offsets.ndim != 1 or offsets.size == 0 or offsets[0] != 0 or offsets[-1] != end:
        raise ModelError(f"{name} must be one-dimensional and run from 0 to {end}")
    falls = offsets[1:] < offsets[:-1]
    if falls.any():
        raise ModelError(f"{name} decreases at position {int(np.argmax(falls))}")


def _check_numbers(model: SSP, numbers: FloatArray, what: str, remedy: str = "") -> None:
    """Raise :class:`ModelError` unless all values, one per outcome, are finite and >= 0."""
    _refuse_outcomes(model, np.isnan(numbers), f"has a {what} that is NaN")
    _refuse_outcomes(model, numbers < 0, f"has a negative {what}{remedy}")
    _refuse_outcomes(model, np.isinf(numbers), f"has an infinite {what}")


def _refuse_outcomes(model: SSP, broken: BoolArray, complaint: str) -> None:
    """Raise :class:`ModelError` for the first outcome of a model where ``broken`` is True."""
    if broken.any():
        raise ModelError(f"{model._describe_outcome(int(np.argmax(broken)))} {complaint}")


def _checked_probabilities(model: SSP, normalise: bool = False) -> FloatArray:
    """Check a model's probabilities and costs; return probabilities that sum to 1, [outcomes].

    Args:
        model: the model.
        normalise: accept sums that differ from 1 by up to 1e-5 (single precision), not 1e-9.

    Raises:
        ModelError: a number that is not finite and >= 0, a cost above 1e150, a pair without
            outcomes, or one whose probabilities do not sum to one.
    """
    _check_numbers(model, model.probabilities, "probability")
    for name, costs in [*model.named_costs.items(), ("", model.costs)]:
        paid = costs[:1] if costs.strides == (0,) else costs  # one number for all
        _check_numbers(model, paid, f"cost {name!r}" if name else "cost", f": {_NO_REWARDS}")
        _refuse_outcomes(model, paid > _MOST_COST, f"has a cost above {_MOST_COST:g}: rescale")
    offsets, chances = model.outcome_offsets, model.probabilities
    empty = offsets[1:] == offsets[:-1]
    if empty.any():
        raise ModelError(f"{model.describe_pair(int(np.argmax(empty)))} has no outcomes")
    sums = segment_sums(chances, offsets)
    off = np.abs(sums - 1.0)
    wrong = off > (SINGLE_PRECISION_SUM if normalise else PROBABILITY_SUM)
    if wrong.any():
        pair = int(np.argmax(wrong))
        complaint = f"{model.describe_pair(pair)}: probabilities sum to {sums[pair]:.12g}, not to 1"
        if off[wrong].max() <= SINGLE_PRECISION_SUM:
            complaint += "; normalise=True divides out the rounding of single precision"
        raise ModelError(complaint)
    if np.all(sums == 1.0):
        return chances
    return read_only(chances / np.repeat(sums, np.diff(offsets)))


def _indices(name: str, indices: npt.ArrayLike) -> IntArray:
    """Return an array of indices as int32 or int64; :class:`ModelError` for other types."""
    array = np.asarray(indices)
    if array.size and not np.issubdtype(array.dtype, np.integer):
        raise ModelError(f"{name} must be integers (indices)")
    return read_only(array, np.int64 if array.dtype.itemsize > 4 else np.int32)


def _costs_of_outcomes(costs: npt.ArrayLike, outcome_offsets: IntArray) -> FloatArray:
    """Return the cost of each outcome, [outcomes]; a single number is stored once.

    Args:
        costs: one number, or one per pair, or one per outcome.
        outcome_offsets: [pairs + 1].

    Raises:
        ModelError: costs of another length.
    """
    given = np.asarray(costs, dtype=np.float64)
    n_pairs, n_outcomes = len(outcome_offsets) - 1, int(outcome_offsets[-1])
    if given.ndim == 0 or given.shape == (n_outcomes,):
        return read_only(np.broadcast_to(given, (n_outcomes,)))
    if given.shape == (n_pairs,):
        return read_only(np.repeat(given, np.diff(outcome_offsets)))
    raise ModelError(f"costs must be a number, {n_pairs} or {n_outcomes} numbers")


def _check_idle_states(model: SSP, dead_ends: DeadEnds | None, *, accept: bool) -> None:
    """Check that goals have no pairs, and that other states without pairs are dead-ends.

    Args:
        model: the model.
        dead_ends: states that must not reach the goal; only they and goals may lack pairs.
        accept: if ``dead_ends`` is None, accept all states without pairs.

    Raises:
        ModelError: the error names the wrong state and the remedy.
    """
    acting = np.diff(model.pair_offsets) > 0
    wrong, idle = model.goal_mask & acting, ~(acting | model.goal_mask)
    if wrong.any():
        state = model.states[int(np.argmax(wrong))]
        raise ModelError(f"goal state {state!r} has actions: an episode ends there; drop them")
    if dead_ends is not None:
        declared = np.zeros(model.n_states, dtype=np.bool_)
        declared[_dead_end_members(model, dead_ends)] = True
        hopeful = declared & (acting | model.goal_mask)
        if hopeful.any() and (hopeful := hopeful & ~lost_states(model)).any():
            state = model.states[int(np.argmax(hopeful))]
            raise ModelError(
                f"state {state!r} is listed in dead_ends, but the goal is reached from it"
            )
        idle &= ~declared
    elif accept:
        return
    if idle.any():
        place = int(np.argmax(idle))
        state, entering = model.states[place], np.flatnonzero(model.successors == place)
        others = compress(model.states, ~idle)
        words = map(model._describe_outcome, entering[:1].tolist())
        led = "".join(f", where {outcome} leads," for outcome in words)
        nearest = did_you_mean(state, others) or "; list all dead-ends, dead_ends={...}"
        raise ModelError(
            f"state {state!r}{led} has no actions and is neither a goal nor a dead-end{nearest}"
        )


def _dead_end_members(model: SSP, dead_ends: DeadEnds) -> IntArray:
    """Return the indices of the states that ``dead_ends`` gives, as states or as labels of sets.

    Raises:
        ModelError: an entry is neither a state nor a label.
    """
    labels = model.state_labels
    if callable(dead_ends):
        return _members(model, "dead_ends", dead_ends)
    if isinstance(dead_ends, str) and dead_ends in labels:
        return labels[dead_ends]
    places: list[int] = []
    for entry in no_lone_string(dead_ends, "dead_ends"):
        if model.find(entry) is None and isinstance(entry, str):
            if entry in labels:
                places += labels[entry].tolist()
                continue
            entry = next((state for state in model.states if str(state) == entry), entry)
        if model.find(entry) is None and (nearest := did_you_mean(entry, labels)):
            raise ModelError(f"dead_ends: {entry!r} is neither a state nor a label{nearest}")
        places.append(model.index_of(entry, "dead_ends"))
    return np.array(places, dtype=np.int64)


def _warn_of_misspelled(states: Sequence[Any], idle: BoolArray) -> None:
    """Warn if the name of a state without actions resembles the name of another state.

    Two names resemble each other if they become equal when one letter is left out of each: one name
    has a transposed, a missing or a wrong letter. Names that differ in digits do not.

    Args:
        states: names of the states.
        idle: states without actions that are not listed as dead-ends, [states].
    """
    known = {part: name for name in compress(states, idle) for part in _with_a_letter_less(name)}
    for other in compress(states, ~idle) if known else ():
        near = next((known[part] for part in _with_a_letter_less(other) if part in known), None)
        if near is not None and near.translate(_NO_DIGITS) != other.translate(_NO_DIGITS):
            warnings.warn(
                f"state {near!r} has no actions and counts as a dead-end; did you mean {other!r}? "
                "List the dead-ends, dead_ends={...}, so that any other such state is an error",
                ModelWarning,
                stacklevel=4,
            )
            return


_NO_DIGITS = str.maketrans("", "", "0123456789")


def _with_a_letter_less(name: Any, least: int = 4) -> set[str]:
    """Return a state's name, and all names with one of its letters left out.

    The set is empty for a name that is not text, or that is too short to be compared.
    """
    if not isinstance(name, str) or len(name) < least:
        return set()
    return {name, *(name[:k] + name[k + 1 :] for k in range(len(name)))}


def goal_mask_of(goal_states: npt.ArrayLike, n_states: int) -> BoolArray:
    """Return the mask of a model's goal states from their indices, [states].

    Raises:
        ModelError: no index, or one that is not an index of a state.
    """
    goals = np.asarray(goal_states).reshape(-1)
    if goals.size and not np.issubdtype(goals.dtype, np.integer):
        raise ModelError("goal_states must be indices of states, np.flatnonzero(mask), not a mask")
    goals = goals.astype(np.int64)
    if goals.size == 0:
        raise ModelError(
            "the model has no goal state; name at least one. If episodes only have to survive, "
            "name a state that no action leads to: within_steps(model, 100, survive=True)"
        )
    if goals.min() < 0 or goals.max() >= n_states:
        raise ModelError(f"goal states must be indices of states, 0 .. {n_states - 1}")
    mask = np.zeros(n_states, dtype=np.bool_)
    mask[goals] = True
    return read_only(mask)


def _action_table(
    actions: Sequence[Hashable] | None, pair_offsets: IntArray
) -> tuple[Sequence[Hashable], IntArray]:
    """Return the distinct action labels of a model and, per pair, the position of its label."""
    n_pairs = int(pair_offsets[-1])
    if actions is None:
        counts = np.diff(pair_offsets)
        most = int(counts.max(initial=0))
        position = np.arange(n_pairs) - np.repeat(pair_offsets[:-1], counts)
        return range(most), position.astype(np.min_scalar_type(most))
    if len(actions) != n_pairs:
        raise ModelError(f"{len(actions)} action labels given for {n_pairs} pairs")
    table = {action: k for k, action in enumerate(dict.fromkeys(actions))}
    code = np.fromiter(map(table.__getitem__, actions), np.int32, n_pairs)
    state = np.repeat(np.arange(len(pair_offsets) - 1), np.diff(pair_offsets))
    order = np.lexsort((code, state))
    again = (np.diff(state[order]) == 0) & (np.diff(code[order]) == 0)
    if again.any():
        pair = int(order[int(np.argmax(again))])
        raise ModelError(f"state number {state[pair]} has the action {actions[pair]!r} twice")
    return tuple(table), code


def _indexed_labels(model: SSP, labels: Mapping[str, StateSet]) -> Mapping[str, IntArray]:
    """Return the state labels of a model with their members as sorted indices.

    Raises:
        ModelError: an unknown member, or a name that reports use already.
    """
    indexed = {}
    for name, members in labels.items():
        if name in ENDS:
            raise ModelError(f"state label {name!r} is reserved: reports use {', '.join(ENDS)}")
        indexed[name] = read_only(_members(model, f"state_labels[{name!r}]", members))
    return indexed


def _members(model: SSP, name: str, members: StateSet) -> IntArray:
    """Return sorted indices of a set of a model's states, given by labels or by a predicate.

    Raises:
        ModelError: an unknown member, or a lone string.
    """
    if callable(members):
        places = [place for place, state in enumerate(model.states) if members(state)]
    else:
        places = sorted({model.index_of(state, name) for state in no_lone_string(members, name)})
    return np.array(places, dtype=np.int64)
