"""The best deterministic policy, for a controller without a lottery.

The best lottery attains c*; the best deterministic policy within the budget may cost more. It is
found by branch and bound over the pairs of the process (case S: of state and accumulated cost).

A node is a set of policies: the pairs that some states must take, and pairs that no state takes.
Its lower bound is the value of its best lottery, the Lagrangian bound

    max over prices of  min over its policies of  cost + price * (failure - budget).

It is proved by values of the process at that price, without the excluded pairs. The lottery mixes
two policies: ``inside`` satisfies the budget and may be a better incumbent, ``outside`` violates
it. Both are optimal at the price, and differ in few states, often in one. The node is divided at
the state that contributes most to their difference in failure: one part takes the pair of
``inside`` there, the other part excludes it. Neither part contains both policies, so the bounds of
both parts may rise. The node of least bound is divided first. A node needs no division if every
policy priced in it satisfies the budget: its best lottery is then a single deterministic policy.

The number of nodes may be exponential: the problem is NP-hard (Dolgov and Durfee 2005). The least
bound of all open nodes is a bound at any time, so that a search that is stopped has a certified
gap.

A deterministic optimum is a step function of the budget: it has no price of failure unless the
budget is slack.

A gap may remain, even without a time limit, because the bound covers two kinds of policies that
are not searched:

- policies that leave a collapsed end component by an exit that depends on where they entered it;
- in case S, policies that act beyond the cap in another way than the tail policies do.

Nodes are not divided at collapsed components and beyond the cap. The bound does not cover policies
with more memory than the state of the process: remembered random outcomes would let them randomise.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.process import LayeredProcess
from ssp_lp.arrays import (
    IMPROVEMENT,
    BoolArray,
    FloatArray,
    IntArray,
    first_minimisers,
    segment_minima,
    weighted,
)
from ssp_lp.column_generation.column import Column, FailureRow, Proof, relative_gap, required
from ssp_lp.column_generation.compiled_layers import CompiledLayered
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, CompiledProblem
from ssp_lp.column_generation.explicit_pricing import LOST
from ssp_lp.compiled.deadline import WithIncumbent, is_late
from ssp_lp.dynamic_programming.dual_bound import DualBound, shortfall
from ssp_lp.dynamic_programming.policy_iteration import MOST_ROUNDS, iterate_policy
from ssp_lp.errors import Argument, ModelError, SolverError
from ssp_lp.model.graph import reached_along
from ssp_lp.policies.policy import as_lottery
from ssp_lp.processes.explicit_process import ExplicitProcess, bound_of
from ssp_lp.processes.failure_label import LabelledProcess
from ssp_lp.processes.quotient import Quotient
from ssp_lp.solution import Answer, Solution

if TYPE_CHECKING:
    from ssp_lp.methods.refinement import Optimum

_OPEN = 1e-6  # relative gap above which the cost of determinism is reported as "at most"
_ROUNDING = 1e-13
_SMALL = 1e-10  # relative
"""Feasibility tolerance of the budget, since failure may be summed in another order."""

_TOO_DEAR = 1e100  # cost of an excluded pair
_MOST_PRICES = 60  # most prices of a node, which takes a handful
_LEAST_PRICE = 1e-12  # lowest price, relative to the lottery's: above 0, so that no cycle is free
_STEP = 4.0  # factor between prices until policies lie on both sides of the budget
_SETTLED = 1e-12  # relative improvement of a priced cost that is rounding
_MOST_VISITS = 4_000_000  # most pairs times states of a process whose inverse is kept
_FAR = 0.5  # share of the states that differ from which on a new inverse is computed


def best_deterministic(mixed: Solution, outcome: Optimum[Any], tolerance: float) -> Solution:
    """Solve for the best deterministic policy, given the best lottery.

    The first incumbent is the best policy of the lottery that satisfies the budget; the first lower
    bound is the lottery's.

    Args:
        mixed: the best lottery; its value function is kept.
        outcome: outcome of the search that found it.
        tolerance: relative gap at which to stop.

    Raises:
        ModelError: the process is too large.
    """
    generated, row = outcome.generated, outcome.row
    most = row.budget + min(_ROUNDING, _SMALL * row.budget)
    inside = [column for column in generated.columns if column.failure <= most]
    column = min(inside, key=lambda c: row.objective(c.cost, c.goal))
    value, policy = row.objective(column.cost, column.goal), outcome.compiled.pricing().policy
    incumbent = Answer(policy(column), value, outcome.bound, column.failure)
    search = _PolicySearch(outcome, most, incumbent, tolerance)
    finished = len(generated.columns) == 1 and generated.finished
    if len(generated.columns) > 1 and not is_late():
        with WithIncumbent():
            finished = search.run()
    single = search.best
    gap = relative_gap(single.value, single.bound)
    cost = f"{'at most ' if gap > _OPEN else ''}{max(single.value - mixed.objective, 0.0):.9g}"
    remarks = [
        f"deterministic: the mixed optimum is {mixed.objective:.9g}, determinism costs {cost}"
    ]
    if mixed.note:
        remarks.append(mixed.note)
    if not finished and "stopped" not in mixed.note:
        remarks.append("stopped before the search was finished; the gap is still certified")
    if finished and gap > max(_OPEN, 2.0 * tolerance):
        remarks.append("policies outside the search may be better, by at most the gap")
    is_slack = (
        len(generated.columns) == 1 and mixed.failure_price == mixed.problem.semantics.penalty
    )
    return replace(
        mixed,
        policy=as_lottery(single.policy),
        failure_price=mixed.failure_price if is_slack else None,
        prices=mixed.prices if is_slack else {},
        objective=single.value,
        lower_bound=min(single.bound, single.value),
        budget_used=single.failure,
        note="; ".join(remarks),
    )


@dataclass(eq=False)
class _PolicySearch:
    """A search for the best deterministic policy. Mutable: ``best`` improves."""

    outcome: Optimum[Any]  # outcome of the search for the best lottery
    most: float  # the budget plus a tolerance for rounding
    best: Answer  # the incumbent; its bound holds for every policy
    tolerance: float  # relative

    @cached_property
    def relaxation(self) -> _DeterministicRelaxation:
        """The explicit process, and its relaxation that contains all deterministic policies."""
        return deterministic_relaxation(self.outcome.compiled, self.outcome.kappa)

    def run(self) -> bool:
        """Search by branch and bound; return whether the search was finished."""
        relaxation = self.relaxation
        free = relaxation.may_randomise
        proved, finished = self._branch(relaxation.process, np.zeros_like(free))
        if free.any() and finished:
            proved, finished = self._branch(relaxation.relaxed, free)
        elif free.any():
            proved = -np.inf
        bound = max(proved, self.outcome.bound)
        self.best = replace(self.best, bound=min(bound, self.best.value))
        return finished

    def _branch(self, process: ExplicitProcess, free: BoolArray) -> tuple[float, bool]:
        """Search a process by branch and bound.

        Args:
            process: the process, or its relaxation.
            free: mask of the states at which no node is divided, [states].

        Returns:
            A lower bound of the objective of every policy of the process, and whether the search
            ended before the time limit.
        """
        tree = _Tree(process, self.outcome.row, free, self, self.outcome.kappa)
        with WithIncumbent() as growth:
            tree.grow(self.relaxation.fallback)
        return tree.bound, not tree.nodes and not growth.stop

    def offer(self, column: Column) -> None:
        """Make a column's policy the incumbent if its value on the model is better."""
        relaxation, row = self.relaxation, self.outcome.row
        if row.objective(column.cost, column.goal) >= self.best.value:
            return
        choice = relaxation.completed(required(column.choice))
        for found in () if choice is None else relaxation.measure(choice):
            value = row.objective(found.cost, found.goal)
            if found.failure <= self.most and value < self.best.value:
                policy = relaxation.compiled.pricing().policy(found)
                self.best = Answer(policy, value, self.best.bound, found.failure)

    def is_pruned(self, bound: float) -> bool:
        """Return whether a node with this lower bound has no policy better than the incumbent."""
        return relative_gap(self.best.value, bound) <= self.tolerance


@dataclass(frozen=True, eq=False)
class _Node:
    """A set of policies, with the two policies of its best lottery.

    ``inside`` satisfies the budget, ``outside`` violates it.
    """

    bound: float  # certified lower bound of the objective
    price: float  # of failure, at which the two policies are equally good
    inside: IntArray  # [states]
    outside: IntArray  # [states]
    taken: tuple[int, ...] = ()  # pairs that their states must take
    excluded: tuple[int, ...] = ()  # pairs that no state may take


@dataclass(eq=False)
class _Tree:
    """Branch and bound over the pairs of a process. Mutable: ``nodes`` and ``closed`` change."""

    process: ExplicitProcess
    row: FailureRow
    free: BoolArray  # [states] that may randomise
    search: _PolicySearch  # has the incumbent
    price: float  # of failure, of the best lottery
    nodes: list[tuple[float, int, _Node]] = field(default_factory=list)  # a heap, by their bounds
    closed: float = np.inf  # least bound of the sets that are not divided further
    n_created: int = 0  # number of nodes

    @property
    def bound(self) -> float:
        """Lower bound of the objective of all policies."""
        least = min(self.closed, self.nodes[0][0] if self.nodes else np.inf)
        return least if np.isfinite(least) else -np.inf

    def grow(self, choice: IntArray) -> None:
        """Divide the node of least bound until the gap is closed or time is up.

        Args:
            choice: the pair of each state under a policy that ends every run, [states].
        """
        self._add(_Node(-np.inf, self.price, choice, choice), choice)
        while self.nodes and not is_late():
            node = self.nodes[0][-1]
            pair = -1 if self.search.is_pruned(node.bound) else self._differing(node)
            if pair < 0:
                self.closed = min(self.closed, node.bound)
            else:
                self._add(replace(node, taken=(*node.taken, pair)), node.inside)
                self._add(replace(node, excluded=(*node.excluded, pair)), node.outside)
            heapq.heappop(self.nodes)  # still the first: its parts have no lower bound

    def _differing(self, node: _Node) -> int:
        """Return the pair of ``inside`` that contributes most to the difference in failure.

        By the performance difference lemma, the failure of ``inside`` minus that of ``outside`` is
        a sum over states: visits of ``inside`` times the advantage of its pair over ``outside``.
        The result is -1 if the two policies differ in no state that may be divided.
        """
        process, inside, outside = self.process, node.inside, node.outside
        states = np.flatnonzero((inside != outside) & ~self.free)
        if states.size > 1:
            failure = process.dynamics.chain(outside).solve(process.failure[outside])
            visits = process.dynamics.chain(inside).solve_transposed(process.start)[states]
            pairs = inside[states]
            ahead = process.failure[pairs] + process.transitions[pairs] @ failure - failure[states]
            states = states[[int(np.argmax(visits * np.abs(ahead)))]]
        return int(inside[states[0]]) if states.size else -1

    def _add(self, node: _Node, choice: IntArray) -> None:
        """Compute the bound and the best lottery of a node, and put the node on the heap.

        The node is dropped if its bound excludes a policy better than the incumbent, or if its best
        lottery is not a mixture of two policies. The tree then keeps only the bound.

        Args:
            node: the node; the search for its best price begins at ``node.price``.
            choice: the pair of each state under a policy of the node that ends every run, [states].
        """
        inside: Column | None = None
        outside: Column | None = None
        best, last, price, rewards = -np.inf, None, node.price, self._rewards(node)
        for _ in range(_MOST_PRICES):
            try:
                column = self._priced(rewards, price, choice)
            except SolverError:  # of rounding, near a free cycle
                break
            line, choice = column.cost + price * column.failure, required(column.choice)
            bound = self._objective_bound(price, line)
            if last is None or bound > best:
                best, last = bound, column
            known = [end.cost + price * end.failure for end in (inside, outside) if end]
            if self.row.is_violated_by(column):
                outside = column
            else:
                inside = column
                self.search.offer(column)
            following = self._next_price(price, inside, outside)
            is_settled = len(known) == 2 and line >= min(known) * (1.0 - _SETTLED)
            if is_settled or following == price or self.search.is_pruned(bound):
                break
            price = following
        bound = node.bound if last is None else max(self._proved(rewards, last), node.bound)
        if inside and outside and not self.search.is_pruned(bound):
            ends = required(inside.choice), required(outside.choice)
            part = replace(node, bound=bound, price=price, inside=ends[0], outside=ends[1])
            self.n_created += 1
            heapq.heappush(self.nodes, (bound, self.n_created, part))
        else:
            self.closed = min(self.closed, bound)

    def _rewards(self, node: _Node) -> FloatArray:
        """Return cost, failure and goal of each pair, [pairs, 3].

        Pairs that the node excludes have so large a cost that no optimal policy takes them.
        """
        process, taken = self.process, np.array(node.taken, dtype=np.int64)
        excluded = np.zeros(process.n_states, dtype=np.bool_)
        excluded[process.pair_state[taken]] = True
        excluded = excluded[process.pair_state]
        excluded[taken] = False
        excluded[np.array(node.excluded, dtype=np.int64)] = True
        cost = np.where(excluded, _TOO_DEAR, process.cost)
        return np.stack([cost, process.failure, process.goal], axis=1)

    def _priced(self, rewards: FloatArray, price: float, choice: IntArray) -> Column:
        """Return a column of least ``cost + price * failure``.

        Args:
            rewards: cost, failure and goal, [pairs, 3].
            price: price of failure.
            choice: the policy from which policy iteration starts, [states].
        """
        weights = np.array([1.0, price, 0.0])
        found = self._neighbours.improved(rewards, weights, choice) if self._is_small else None
        if found is None:
            dynamics = self.process.dynamics
            settled = iterate_policy(dynamics, rewards, weights, choice, precise=False)
            found = settled.choice, settled.totals
        cost, failure, goal = (self.process.start @ found[1]).tolist()
        return Column(cost, failure, goal, found[0], price, totals=found[1])

    @cached_property
    def _is_small(self) -> bool:
        """Whether a dense matrix [pairs, states] fits into memory, and every state has a pair."""
        process = self.process
        has_pairs = bool((np.diff(process.pair_offsets) > 0).all())
        return 0 < process.n_pairs * process.n_states <= _MOST_VISITS and has_pairs

    @cached_property
    def _neighbours(self) -> _Neighbours:
        """Policy iteration that reuses the inverse matrix of an earlier policy."""
        return _Neighbours(self.process, np.full(self.process.n_states, -1))

    def _proved(self, rewards: FloatArray, column: Column) -> float:
        """Return a certified lower bound of the objective, at the price of an optimal column."""
        process, weights = self.process, np.array([1.0, column.tail_price, 0.0])
        priced, values = weighted(rewards, weights), weighted(required(column.totals), weights)
        priced -= LOST * priced  # a bound rounds down
        lack, least = shortfall(process.dynamics, priced, values), float(priced.min())
        share = 2.0 * float(lack.max()) / least if least > 0.0 else 0.0
        shrunk = values * (1.0 - share)
        bound = DualBound(shrunk, np.zeros_like(shrunk))
        if share > _SETTLED or shortfall(process.dynamics, priced, shrunk).any():
            bound = bound_of(process, None, priced, values, choice=column.choice)
        return self._objective_bound(column.tail_price, bound.at(process.start))

    def _objective_bound(self, price: float, priced: float) -> float:
        """Return a lower bound of the objective of every policy.

        It follows from ``priced``, a lower bound of ``cost + price * failure`` of every policy.
        """
        return self.row.lower_bound(Proof(price, price, priced, np.zeros(0)))

    def _next_price(self, price: float, inside: Column | None, outside: Column | None) -> float:
        """Return the next price of failure to try in the search for a node's greatest bound.

        The search ends if the result equals ``price``.

        Args:
            price: the price that was tried last.
            inside: the latest column that satisfies the budget, or None.
            outside: the latest column that violates the budget, or None.
        """
        row, least = self.row, _LEAST_PRICE * self.price
        if inside is None:
            if outside is None:
                return price
            wanted = self.search.best.value * (row.required if row.ratio else 1.0)
            enough = 2.0 * (outside.cost - wanted) / row.slack(outside)  # to close it clearly
            return enough if price < enough < _STEP * price else _STEP * price
        if row.ratio:
            least = max(least, row.objective(inside.cost, inside.goal))
        if outside is None:
            return max(least, price / _STEP if price * _STEP**5 > self.price else 0.0)
        slope = (inside.cost - outside.cost) / (row.slack(inside) - row.slack(outside))
        return max(least, slope)


@dataclass(eq=False)
class _Neighbours:
    """Policy iteration that updates the inverse matrix of one policy's equations.

    Mutable: a policy that differs from the stored one in too many states replaces it.
    """

    process: ExplicitProcess
    choice: IntArray  # [states] the policy; -1: none yet
    inverse: FloatArray = field(default_factory=partial(np.zeros, (0, 0)))  # [states, states]
    onward: FloatArray = field(default_factory=partial(np.zeros, (0, 0)))  # [pairs, states] visits

    def improved(
        self, rewards: FloatArray, weights: FloatArray, choice: IntArray
    ) -> tuple[IntArray, FloatArray] | None:
        """Return a policy of least weighted rewards, and its expected totals.

        The result is None if rounding errors of the inverse prevent convergence.

        Args:
            rewards: [pairs, rewards].
            weights: weight of each reward, [rewards].
            choice: the pair of each state under a policy that ends every run, [states].

        Returns:
            The pair of each state, [states], and the totals, [states, rewards].
        """
        process, above = self.process, np.full(len(choice), np.inf)
        offsets, priced = process.pair_offsets, weighted(rewards, weights)
        with np.errstate(all="ignore"):
            for _ in range(MOST_ROUNDS):
                try:
                    totals = self._totals(rewards, choice)
                except np.linalg.LinAlgError:
                    return None
                values = weighted(totals, weights)
                if not (values <= above + IMPROVEMENT * np.abs(above)).all():
                    return None
                ahead = priced + process.transitions @ values
                least, here = segment_minima(ahead, offsets), ahead[choice]
                better = least < here - IMPROVEMENT * np.abs(here)
                if not better.any():
                    return choice, totals
                above = values
                choice = np.where(better, first_minimisers(ahead, least, offsets), choice)
        return None

    def _totals(self, rewards: FloatArray, choice: IntArray) -> FloatArray:
        """Return a policy's expected totals of the rewards, [states, rewards].

        The stored inverse is updated by the Sherman-Morrison-Woodbury formula.
        """
        steps = self.process.transitions
        states = np.flatnonzero(choice != self.choice)
        if states.size > _FAR * choice.size:
            self.choice, states = choice, states[:0]
            self.inverse = np.linalg.inv(np.eye(choice.size) - steps[choice].toarray())
            self.onward = steps @ self.inverse
        totals = self.inverse @ rewards[choice]
        if states.size:
            pairs, before = choice[states], self.choice[states]
            onward = self.onward[np.ix_(pairs, states)] - self.onward[np.ix_(before, states)]
            ahead = steps @ totals
            changes = np.linalg.solve(np.eye(states.size) - onward, ahead[pairs] - ahead[before])
            totals += self.inverse[:, states] @ changes
        return totals


_MOST_PAIRS = 500_000
_ENDLESS = 1e9  # price of failure, relative to 1 + the optimal one, at which no tail gives up


@dataclass(frozen=True, eq=False)
class _DeterministicRelaxation:
    """A process, and a relaxation of it that contains all deterministic policies of the model.

    ``process`` lacks two kinds of deterministic policies: those that leave a collapsed component by
    an exit that depends on where they entered, and, in case S, those that act beyond the cap unlike
    the tail policies. ``relaxed`` contains them as policies that randomise in the states
    ``may_randomise``. Beyond the cap, ``relaxed`` allows every goal probability between the least
    and the greatest, and success costs only the total at which the cap was passed.
    """

    compiled: CompiledProblem
    process: ExplicitProcess
    relaxed: ExplicitProcess
    may_randomise: BoolArray  # [states] reachable from the start
    fallback: IntArray  # [states] pairs of a policy that leaves from every state
    measure: Callable[[IntArray], list[Column]]  # evaluates the policies of a choice exactly

    def completed(self, choice: IntArray) -> IntArray | None:
        """Return a choice, changed to ``fallback`` in the states that no run reaches, [states].

        The result is None if a run under the choice may never end.
        """
        process = self.process
        chain = sp.csr_array(process.transitions[choice])
        chain.eliminate_zeros()
        back, start = sp.csr_array(chain.T), np.flatnonzero(process.start > 0)
        reached = reached_along(chain.indices, chain.indptr, start)
        leaks = process.goal[choice] + process.failure[choice] > 0
        leaves = reached_along(back.indices, back.indptr, np.flatnonzero(leaks))
        if (reached & ~leaves).any():
            return None
        return np.where(reached, choice, self.fallback)


def deterministic_relaxation(compiled: CompiledProblem, price: float) -> _DeterministicRelaxation:
    """Build a process explicitly, with its relaxation for deterministic policies.

    Args:
        compiled: a problem of case M or S.
        price: price of failure of the best lottery.

    Raises:
        ModelError: there are too many pairs.
    """
    exact = compiled.for_program()
    if exact.n_columns > _MOST_PAIRS:
        raise ModelError(
            Argument("method", "deterministic"),
            f": a process of {exact.n_columns:,} pairs is too large (at most "
            f"{_MOST_PAIRS:,}): set a lower ",
            Argument("cost_cap"),
            ", or use a coarser grid of costs",
        )
    process = relaxed = exact.explicit()
    free = np.zeros(process.n_states, dtype=np.bool_)
    if exact.charge is None:
        labelled = cast("CompiledExplicit", exact)
        merged = _merged_nodes(cast("LabelledProcess", labelled.augmented).quotient)
        free[: len(merged)] = merged

        def measure(choice: IntArray) -> list[Column]:
            """Return a list with one column: the choice, evaluated exactly."""
            return [labelled.explicit_pricing.measure(choice.astype(np.int32))]

    else:
        layered = cast("CompiledLayered", exact)
        base, cap, pricing = layered.layer.base, layered.layers, layered.pricing()
        beyond = np.arange((base.width - 1) * base.n_nodes) + cap * base.n_nodes
        free[: cap * base.n_nodes] = np.tile(_merged_nodes(base.quotient), cap)
        free[beyond] = True
        relaxed = _with_loose_tails(process, layered.process, beyond)

        def measure(choice: IntArray) -> list[Column]:
            """Return three columns: the choice with three different tail policies beyond the cap.

            These tails are optimal at ``price``, at price 0, and at a price so high that no tail
            gives up.
            """
            within = choice[: cap * base.n_nodes].reshape(cap, base.n_nodes)
            shift = np.arange(cap)[:, None] * len(base.gain) + base.pair_offsets[:-1]
            tails = (price, 0.0, _ENDLESS * (1.0 + price))
            return [pricing.measure((within - shift).astype(np.int32), tail) for tail in tails]

    return _DeterministicRelaxation(
        compiled=exact,
        process=process,
        relaxed=relaxed,
        may_randomise=free & _reached_states(process),
        fallback=exact.explicit_choice(exact.pricing().minimise(price)),
        measure=measure,
    )


def _with_loose_tails(
    process: ExplicitProcess, layered: LayeredProcess, beyond: IntArray
) -> ExplicitProcess:
    """Return a process in which every policy beyond the cap costs at least a mixture of two tails.

    From accumulated cost r on, success costs at least ``r * E[gamma^(T-1); goal]``, with discount
    gamma and T steps to the goal. Both tails have this least cost. One tail has the least goal
    probability, the other one the greatest.
    """
    base, tails = layered.base, layered.tails
    n_layers = base.width - 1
    first = process.pair_offsets[beyond]
    last = process.pair_offsets[beyond + 1] - 1
    paid = np.repeat(layered.cap + np.arange(n_layers), base.n_nodes) * base.unit / base.survival
    cost, goal, failure = process.cost.copy(), process.goal.copy(), process.failure.copy()
    for pairs, success in ((first, tails.greatest_goal), (last, tails.least_goal)):
        share = np.tile(np.clip(success, 0.0, 1.0), n_layers)
        cost[pairs], goal[pairs], failure[pairs] = paid * share, share, 1.0 - share
    return replace(process, cost=cost, goal=goal, failure=failure)


def _merged_nodes(quotient: Quotient) -> BoolArray:
    """Return a mask of the nodes that stand for several states, [nodes]."""
    members = np.bincount(quotient.node_of[quotient.merged], minlength=quotient.n_nodes)
    return np.asarray(members > 1)


def _reached_states(process: ExplicitProcess) -> BoolArray:
    """Return a mask of the states that are reachable from the start, [states]."""
    rows, start = process.transitions, np.flatnonzero(process.start > 0)
    return reached_along(rows.indices, rows.indptr[process.pair_offsets], start)
