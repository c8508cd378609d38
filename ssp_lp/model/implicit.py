"""The explored part of an implicit model: the states found so far, and a solvable model of them.

Each state of the fringe (found, but not expanded) has two actions. "Arrive" pays the state's cost
bound and reaches the goal with probability 1 - failure bound. "Fail" never reaches the goal, at no
cost. No continuation in the whole model is better than a mixture of the two, so a bound of the
explored part's optimum is a bound of the whole model's optimum.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    entries_of,
    offsets_of,
    segment_minima,
    segment_sums,
)
from ssp_lp.compiled.deadline import check_time
from ssp_lp.errors import ModelError, in_short, is_number
from ssp_lp.model.graph import Graph, reaching_states
from ssp_lp.model.ssp import SSP, UNEXPLORED, FlatModel, ImplicitSSP
from ssp_lp.model.state_rows import Outcomes, joined_outcomes

BEYOND, LOST = "(a goal beyond)", "(lost beyond)"
"""Added states of the explored part, in which the actions of its fringe end."""

ARRIVE, FAIL = "(arrive)", "(fail)"
"""Added actions: both in fringe states, "fail" also in states that may be dead-ends."""


_NO_BOUNDS: Mapping[str, float] = {}
_NOTHING: Any = None  # until the arrays of the model have been checked


@dataclass(frozen=True, eq=False, repr=False)
class ExploredSSP(SSP):
    """The explored part of an implicit model.

    Its states are, in this order: the expanded states, the fringe, the goals, and two added states
    in which the actions "arrive" (a goal) and "fail" of the fringe end.
    """

    whole: ImplicitSSP = field(kw_only=True, default=_NOTHING)
    n_expanded: int = field(kw_only=True, default=0)
    n_live: int = field(kw_only=True, default=0)  # expanded states and the fringe, which come first
    numbers: IntArray = field(kw_only=True, default=_NOTHING)
    """Number (in the order of finding) of each expanded state, fringe state and goal."""
    may_end: BoolArray = field(kw_only=True, default=_NOTHING)
    """Mask of expanded states with the added action "fail"; see :meth:`Exploration.part`."""
    least_cost: FloatArray = field(kw_only=True, default=_NOTHING)  # [live] cost bounds
    least_failure: FloatArray = field(kw_only=True, default=_NOTHING)  # [live] failure bounds

    @property
    def fringe(self) -> BoolArray:
        """States of the explored part that are found, but not expanded, [states]."""
        place = np.arange(self.n_states)
        return np.asarray((place >= self.n_expanded) & (place < self.n_live))

    def hint(self, state: Hashable) -> str:
        """Return a hint for errors: an unknown state may not have been explored."""
        return f", or was not explored{super().hint(state)}"

    def explored(self) -> SSP:
        """Return the explored part as an ordinary model: states of the fringe are dead-ends.

        They bear the label "unexplored"; actions are those of the whole model.
        """
        pairs = np.flatnonzero(~np.isin(self.pair_action, [
            k for k, name in enumerate(self.action_names) if name in (ARRIVE, FAIL)
        ]))  # fmt: skip
        outcomes, counts = entries_of(self.outcome_offsets, pairs)
        n_states = self.n_states - 2
        return SSP(
            states=self.states[:n_states],
            action_names=self.action_names,
            pair_action=self.pair_action[pairs],
            pair_offsets=offsets_of(np.bincount(self.pair_state[pairs], minlength=n_states)),
            outcome_offsets=offsets_of(counts),
            successors=self.successors[outcomes],
            probabilities=self.probabilities[outcomes],
            costs=self.costs[outcomes],
            goal_mask=self.goal_mask[:n_states],
            state_labels={name: held[held < n_states] for name, held in self.state_labels.items()},
            exact_costs=self.exact_costs,
            named_costs={name: costs[outcomes] for name, costs in self.named_costs.items()},
        )


class Exploration:
    """The states of an implicit model found so far, in lists that grow. Mutable.

    States are numbered in the order in which they are found; the flat lists of the model contain
    the expanded states, in the order of their expansion.
    """

    def __init__(self, whole: ImplicitSSP, named: Iterable[Hashable]) -> None:
        """Find the first states.

        Args:
            whole: the model.
            named: states in which episodes begin, and those that limits name.
        """
        self.whole = whole
        self.flat = FlatModel([], whole.cost)
        self.expanded_policy: list[int] = []  # in the order of expansion
        self.is_goal: list[bool] = []  # and of each state found:
        self.is_expanded: list[bool] = []
        self.cost_bounds: list[float] = []
        self.named_bounds: list[Mapping[str, float]] = []
        self.failure_bounds: list[float] = []
        self.paid: list[float] = []  # on the path by which it was found
        self.labelled: dict[str, list[int]] = {name: [] for name in whole.labels}
        self.queue: list[tuple[float, int]] = []  # of states by paid + cost bound
        for state in named:
            self.flat.place_of(state)
        self._look_at([0.0] * len(self.flat.states))

    def grow(self, states: Iterable[int], most: float) -> None:
        """Expand the given states, then others in the order of A*.

        The next state is that with the least sum of the cost of its path and its cost bound.

        Args:
            states: indices of states.
            most: number of expanded states at which to stop.
        """
        self._expand(states)
        while len(self.expanded_policy) < most and self.queue:
            batch = list[int]()
            size = most - len(self.expanded_policy) if self.whole.is_vectorised else 1
            while self.queue and len(batch) < size:
                batch.append(heapq.heappop(self.queue)[1])
            self._expand(batch)

    def _expand(self, positions: Iterable[int]) -> None:
        """Expand the states with these numbers that are not expanded yet."""
        here = [k for k in dict.fromkeys(positions) if not self.is_expanded[k]]
        flat, states = self.flat.arrays, self.flat.states
        batches = [here] if self.whole.is_vectorised else [[number] for number in here]
        for numbers in filter(None, batches):
            check_time()
            begin, paid = len(flat["costs"]), list[float]()
            if self.whole.is_vectorised:
                self._append_many(numbers)
            else:
                state = states[numbers[0]]
                self.flat.add(state, self.whole.expand(state), goal=False)
            for number in numbers:
                self.is_expanded[number] = True
                self.expanded_policy.append(number)
                end = flat["outcome_offsets"][flat["pair_offsets"][len(self.expanded_policy)]]
                for k in range(begin, end):
                    if flat["successors"][k] == len(self.is_goal) + len(paid):  # found by it
                        paid.append(self.paid[number] + flat["costs"][k])
                begin = end
            self._look_at(paid)

    def _look_at(self, paid: list[float]) -> None:
        """Evaluate goal, bounds and labels of the newest states; queue the states to expand.

        ``paid`` has the cost paid on the path by which each of the newest states was found.
        """
        first, whole = len(self.is_goal), self.whole
        new = self.flat.states[first:]
        if not new:
            return
        goals = self._each(whole.is_goal, new, default=False)
        cost_bound, failure_bound = whole.bounds
        live = [state for state, is_goal in zip(new, goals, strict=True) if not is_goal]
        least_costs = iter(self._each(cost_bound, live, default=0.0))
        least_failures = iter(self._each(failure_bound, live, default=0.0))
        for number, (state, is_goal, spent) in enumerate(zip(new, goals, paid, strict=True), first):
            self.is_goal.append(bool(is_goal))
            self.is_expanded.append(bool(is_goal))
            self.paid.append(spent)
            cost, failure = (0.0, 0.0) if is_goal else (next(least_costs), next(least_failures))
            named, costs = _NO_BOUNDS, [cost]
            if type(cost) is not float and isinstance(cost, Mapping):
                named, costs = cost, [*cost.values()]
                cost = cost.get(whole.cost or next(iter(cost), ""), 0.0)
            for told, bound in (*(("cost", each) for each in costs), ("failure", failure)):
                most = np.inf if told == "cost" else 1.0
                if not ((type(bound) is float or is_number(bound)) and 0.0 <= bound <= most):
                    limits = ">= 0" if told == "cost" else "in [0, 1]"
                    raise ModelError(
                        f"{told}_bound({state!r}) must be a number {limits}, not {in_short(bound)}"
                    )
            self.named_bounds.append(named)
            self.cost_bounds.append(float(cost))
            self.failure_bounds.append(1.0 if cost == np.inf else float(failure))
            for name, members in whole.labels.items():
                if members(state):
                    self.labelled[name].append(number)
            if not is_goal:
                heapq.heappush(self.queue, (spent + self.cost_bounds[-1], number))

    def _each(
        self, function: Callable[[Any], Any] | None, states: list[Any], default: Any
    ) -> list[Any]:
        """Return the values of a function at states; ``default`` if there is no function."""
        if function is None:
            return [default] * len(states)
        if not self.whole.is_vectorised:
            return [function(state) for state in states]
        answers = np.broadcast_to(function(np.array(states, dtype=np.int64)), len(states))
        return list(answers.tolist())

    def _append_many(self, numbers: list[int]) -> None:
        """Append the actions of several states, by one call of a vectorised successor function."""
        flat = self.flat
        states = np.array([flat.states[k] for k in numbers], dtype=np.int64)
        told = {k: np.asarray(v) for k, v in self.whole.expand(states).items()}
        actions, outcomes = told["actions"], told["outcomes"]
        begin, n_outcomes = len(flat.arrays["costs"]), int(outcomes.sum())
        if actions.shape != states.shape or outcomes.shape != (int(actions.sum()),):
            raise ModelError(
                f"for {len(states)} states, successors must return the number of actions of each "
                "state, and the number of outcomes of each action"
            )
        ends, first = np.cumsum(actions), len(flat.arrays["actions"])
        flat.arrays["successors"] += map(flat.place_of, told["successors"].tolist())
        for name in ("probabilities", "costs"):
            numbers_told = np.broadcast_to(told[name], n_outcomes).astype(np.float64)
            flat.arrays[name] += numbers_told.tolist()
        flat.arrays["actions"] += (
            np.arange(len(outcomes)) - np.repeat(ends - actions, actions)
        ).tolist()
        flat.arrays["outcome_offsets"] += (begin + np.cumsum(outcomes)).tolist()
        flat.arrays["pair_offsets"] += (first + ends).tolist()

    def part(self, survival: float, may_end: bool, *, charged: bool) -> ExploredSSP:
        """Return the explored part as a model.

        Args:
            survival: discount factor; 1 without a discount.
            may_end: whether expanded states that reach the goal only through the fringe get a
                further action "fail", since they may turn out to be dead-ends.
            charged: whether this action "fail" costs as much as the state's cheapest action; else
                0.
        """
        is_goal = np.array(self.is_goal, dtype=np.bool_)
        fringe = np.flatnonzero(~np.array(self.is_expanded, dtype=np.bool_))
        goals, n_expanded = is_goal.nonzero()[0], len(self.expanded_policy)
        numbers = np.concatenate([np.array(self.expanded_policy, dtype=np.int64), fringe, goals])
        n_live, n_found = n_expanded + fringe.size, numbers.size
        rows = np.empty(n_found, dtype=np.int64)
        rows[numbers] = np.arange(n_found)
        names = [*self.flat.arrays["named_costs"]]
        own, doubtful = self._own_ways(rows), np.zeros(n_found + 2, dtype=np.bool_)
        blocks = [own]
        if may_end:
            blocks.append(self._ways_lost(own, numbers, n_live, charged=charged))
            doubtful[blocks[-1].owner] = True
        blocks.append(self._ways_out(fringe, n_expanded, survival, names))
        ways = _Ways.joined(blocks)
        lengths, targets, chances, costs = ways.outcomes
        made: Any = ExploredSSP.from_arrays(
            pair_offsets=offsets_of(np.bincount(ways.owner, minlength=n_found + 2)),
            outcome_offsets=offsets_of(lengths),
            successors=targets,
            probabilities=chances,
            costs=costs[:, 0],
            goal_states=np.append(np.arange(n_live, n_found), n_found),
            states=[self.flat.states[k] for k in numbers.tolist()] + [BEYOND, LOST],
            actions=ways.labels,
            exact_costs=self.flat.arrays["exact_costs"],
            named_costs=dict(zip(names, costs[:, 1:].T, strict=True)),
            treat_actionless_as_dead_ends=True,
        )
        labels = {name: np.sort(rows[held]) for name, held in self.labelled.items()}
        labels[UNEXPLORED] = np.append(np.arange(n_expanded, n_live), n_found + 1)
        part: ExploredSSP = replace(
            made,
            whole=self.whole,
            n_expanded=n_expanded,
            n_live=n_live,
            numbers=numbers,
            may_end=doubtful,
            least_cost=np.array(self.cost_bounds)[numbers],
            least_failure=np.array(self.failure_bounds)[numbers],
            state_labels=labels,
        )
        return part

    def _own_ways(self, rows: IntArray) -> _Ways:
        """Return the actions of the expanded states.

        Args:
            rows: position of each found state in the explored part, [states found].
        """
        flat = self.flat.arrays
        counts, lengths = np.diff(flat["pair_offsets"]), np.diff(flat["outcome_offsets"])
        outcomes = Outcomes(
            lengths,
            rows[np.array(flat["successors"], dtype=np.int64)],
            np.array(flat["probabilities"], dtype=np.float64),
            np.array([flat["costs"], *flat["named_costs"].values()], dtype=np.float64).T,
        )
        return _Ways(np.repeat(np.arange(counts.size), counts), outcomes, flat["actions"])

    def _ways_lost(self, own: _Ways, numbers: IntArray, n_live: int, *, charged: bool) -> _Ways:
        """Return the action "fail" of expanded states that reach the goal only through the fringe.

        Args:
            own: actions of the expanded states, which are the first states.
            numbers: for each found state, in the order of the explored part, its number in the
                order of finding.
            n_live: number of states before the goals: the expanded ones and the fringe.
            charged: whether "fail" costs as much as the state's cheapest action; else 0.
        """
        lengths, targets, chances, costs = own.outcomes
        pairs = offsets_of(np.bincount(own.owner, minlength=numbers.size))
        graph, place = Graph(pairs, offsets_of(lengths), targets, chances), np.arange(numbers.size)
        goals, beyond = place >= n_live, place >= len(self.expanded_policy)
        hopeful = goals | (beyond & (np.array(self.failure_bounds)[numbers] < 1.0))
        doubtful = reaching_states(graph, hopeful) & ~reaching_states(graph, goals) & ~beyond
        failing = np.flatnonzero(doubtful)
        paid = np.zeros((failing.size, costs.shape[1]))
        if charged:
            means = segment_sums(chances * costs[:, 0], graph.outcome_offsets)
            paid[:, 0] = segment_minima(means, pairs)[failing]
        once, lost = np.ones(failing.size, dtype=np.int64), np.full(failing.size, numbers.size + 1)
        outcomes = Outcomes(once, lost, np.ones(failing.size), paid)
        return _Ways(failing, outcomes, [FAIL] * failing.size)

    def _ways_out(
        self, fringe: IntArray, n_expanded: int, survival: float, names: list[str]
    ) -> _Ways:
        """Return the actions "arrive" and "fail" of each state of the fringe.

        Args:
            fringe: indices of the states of the fringe, which follow the expanded states.
            n_expanded: number of expanded states.
            survival: discount factor, by which the cost bound is multiplied.
            names: names of the costs.
        """
        beyond = len(self.is_goal)
        fails = np.array(self.failure_bounds)[fringe]
        # "arrive" may lead to the goal or be lost, "fail" is lost
        chances = np.stack([1.0 - fails, fails, np.ones(fringe.size)], axis=1)
        occurs = chances > 0.0
        ends = np.broadcast_to([beyond, beyond + 1, beyond + 1], chances.shape)
        bounds = np.array(
            [
                [self.cost_bounds[k], *(self.named_bounds[k].get(name, 0.0) for name in names)]
                for k in fringe.tolist()
            ]
        ).reshape(fringe.size, 1 + len(names))
        costs = np.zeros((*chances.shape, 1 + len(names)))
        costs[:, 0] = survival * np.where(np.isfinite(bounds), bounds, 0.0)
        lengths = np.stack([occurs[:, :2].sum(axis=1), occurs[:, 2]], axis=1).ravel()
        outcomes = Outcomes(lengths, ends[occurs], chances[occurs], costs[occurs])
        owner = np.repeat(n_expanded + np.arange(fringe.size), 2)
        return _Ways(owner, outcomes, [ARRIVE, FAIL] * fringe.size)


class _Ways(NamedTuple):
    """Actions of states of the explored part, in flat arrays."""

    owner: IntArray  # [pairs] state of each
    outcomes: Outcomes  # of the pairs, with [outcomes, 1 + costs by name]
    labels: list[Hashable]  # [pairs]

    @staticmethod
    def joined(blocks: Sequence[_Ways]) -> _Ways:
        """Return several blocks as one, in the order of their states."""
        owner = np.concatenate([block.owner for block in blocks])
        order = np.argsort(owner, kind="stable")
        outcomes = joined_outcomes([block.outcomes for block in blocks]).rows(order)
        labels = [label for block in blocks for label in block.labels]
        return _Ways(owner[order], outcomes, [labels[k] for k in order.tolist()])
