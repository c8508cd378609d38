"""The process of case M on rows that are distributed over ranks, and its pricing problem.

Each rank has the pairs of its own nodes, and knows the values of ghosts: nodes of other ranks to
which these pairs lead. A rank improves a policy in place by sweeps over its own nodes. Between
sweeps the ranks exchange the ghosts' values. PETSc's Krylov methods solve the equations of a
policy.

As on a single process, columns are evaluated with a bound of their error, and a lower bound is
checked by one backup of all rows, rounded down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    IMPROVEMENT,
    MACHINE_EPSILON,
    BoolArray,
    FloatArray,
    IntArray,
    exact_sum,
    fields_of,
    weighted,
)
from ssp_lp.column_generation.column import Column, PricingProblem, Proof, pricing_weights
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, LeastFailure
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.distributed.part import Part
from ssp_lp.distributed.ranks import Halo, Ranks
from ssp_lp.dynamic_programming.bellman import Moves, Work, best_pairs, chosen_rows
from ssp_lp.dynamic_programming.chain_solvers import HOLDS_MASS
from ssp_lp.dynamic_programming.dual_bound import shortfall
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.equations import DIRECT_STATES, EXACT
from ssp_lp.dynamic_programming.evaluation import EVALUATED, RUN_ACCURACY
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.model.graph import Graph, pairs_into
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Branches, Policy
from ssp_lp.processes.failure_label import LabelledProcess, counting_of, label_failure
from ssp_lp.processes.failure_semantics import Aim, GiveUp, free_pairs, giving_up_states
from ssp_lp.processes.quotient import build_quotient

_STEPS = 200  # most steps of a Krylov method in one run
_RUNS = 12  # most runs, or corrections, each of the last one's residual
_FINEST = 1e-8  # least relative residual of one run
_LET_PASS = 1e-9  # relative residual that suffices if no method reaches less
_GATHERED = 1_000_000  # most entries of a policy's rows that are gathered for a factorisation
_PLAIN = 1e-13  # accuracy up to which residuals in working precision suffice
_ROUGH = 1e-6  # accuracy of a policy's values while its pairs still change
_SWEEPS, _EXCHANGED = 8, 4  # sweeps between two evaluations, and between two exchanges
_ROUGH_ROUNDS, _MOST_ROUNDS = 20, 1_000  # rounds of policy iteration: roughly, and in all
_SHRUNK = (0.0, *10.0 ** np.arange(-13.0, 0.0))  # shares by which values move to the floor
_BELOW = 0.1  # share of that share by which all values are lowered
_LOWERINGS = 160  # sweeps of lowering, after which a larger share is tried
_STEEPER = 10.0 ** np.arange(1, 14, 3)  # prices of failure to try, in multiples of the cost
_SAME = 1e-13  # equal failures, relative to the rarer of failure and success


@dataclass(frozen=True, eq=False, repr=False)
class _OwnDecisions(Policy):
    """A policy of a partitioned model: decisions in a rank's own states."""

    model: Part
    positions: IntArray  # [own states] among the actions, GIVE_UP_CODE or UNDECIDED
    rewards: FloatArray  # [rewards] totals of the policy

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Raise an error, since a rank has only the decisions of its own states.

        Raises:
            ModelError: always.
        """
        raise ModelError("a rank lacks other ranks' decisions: use PartitionedPolicy.on(model)")


class _Equations:
    """Equations ``x = rhs + rows @ x`` of a policy, solved by all ranks together."""

    def __init__(self, process: PartitionedProcess, choice: IntArray, values: FloatArray) -> None:
        """Set up the equations of a policy.

        Args:
            process: the process.
            choice: a pair of each own node, [own nodes].
            values: approximate values of the policy, [own nodes]. PETSc's unknowns have the order
                of these values, so that nodes near the ends come first.
        """
        self.halo, self.choice, self.values = process.halo, choice, values
        dynamics = process.dynamics
        self._order, own = np.argsort(values, kind="stable"), np.arange(self.halo.n_own)
        rows = chosen_rows(dynamics.transitions, choice)
        self.moves = Moves(own.astype(np.int32), rows, dynamics.exits[choice])
        self.products, self._entries = 0, self.halo.ranks.total(rows.nnz)

    def leading(self, marked: BoolArray) -> BoolArray:
        """Return a mask of the rank's nodes from which the policy may reach marked nodes."""
        if not self.halo.ranks.any(~marked):
            return marked
        return self.halo.reaching(self._graph, marked)[: self.halo.n_own]

    @cached_property
    def _graph(self) -> Graph:
        """The graph of the policy on own nodes and ghosts; ghosts have no pairs."""
        rows, n = self.moves.transitions, self.halo.n_own
        offsets = np.append(np.arange(n + 1), np.full(self.halo.size - n, n))
        return Graph(offsets, rows.indptr.astype(np.int64), rows.indices, rows.data)

    @cached_property
    def _solver(self) -> tuple[Any, ...]:
        """PETSc's solver (BiCGStab, block ILU; LU if few rows), two vectors, the matrix."""
        halo, order, petsc = self.halo, self._order, self.halo.ranks.petsc
        place, rows = np.empty(halo.n_own), self.moves.transitions
        place[order] = np.arange(halo.n_own)
        numbers = halo.with_ghosts(halo.first + place).astype(petsc.IntType)
        shape = halo.n_own, halo.n_all
        here, parts = halo.first, (rows.data, numbers[rows.indices], rows.indptr)
        # scipy adds up duplicates, of which PETSc would keep the last
        unit = sp.csr_array(sp.eye(*shape, k=here, format="csr"))
        rows = unit - sp.csr_array(parts, shape=shape)[order]
        places = (part.astype(petsc.IntType, copy=False) for part in (rows.indptr, rows.indices))
        csr = *places, rows.data
        matrix = petsc.Mat().createAIJ(size=(shape, shape), csr=csr, comm=halo.ranks.comm)
        ksp, is_small = petsc.KSP().create(halo.ranks.comm), halo.n_all <= DIRECT_STATES
        ksp.setOperators(matrix)
        ksp.setType("preonly" if is_small else "bcgs")
        ksp.getPC().setType("redundant" if is_small else "bjacobi")
        if not is_small:
            ksp.setOptionsPrefix("ssp_lp_")
            ksp.setFromOptions()
        return ksp, *matrix.createVecs(), matrix

    def clear(self) -> None:
        """Destroy PETSc's objects; all ranks must call this, since no garbage collector does it."""
        for one in vars(self).pop("_solver", ()):
            one.destroy()

    def solve(
        self, rhs: FloatArray, guess: FloatArray, accuracy: float, *, precise: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Solve the equations by corrections of a guess.

        Args:
            rhs: right side, [own nodes].
            guess: approximate solution, [own nodes].
            accuracy: greatest residual, relative to the solution, that suffices.
            precise: whether to compute residuals in twice the working precision.

        Returns:
            Two arrays whose sum is the solution, [own nodes] each.

        Raises:
            SolverError: no method reaches the accuracy.
        """
        ranks, filled, moves = self.halo.ranks, self.halo.with_ghosts, self.moves
        x, low = guess, np.zeros_like(guess)
        if not ranks.any(rhs):
            return low, low
        kept, missed, scale = (x, low, rhs), np.inf, 0.0
        ksp, left, step, _ = self._solver
        for _ in range(_RUNS):
            if precise:
                residual, rounding = moves.precise_advantages(rhs, filled(x), filled(low))
            else:
                residual, rounding = rhs - x + moves.transitions @ filled(x), low
            sizes = [size.max(initial=0.0) for size in (np.abs(residual) + rounding, np.abs(x))]
            now, most = ranks.greatest(sizes).tolist()
            if now < missed:
                kept, missed, scale = (x, low, residual), now, most
                if missed <= accuracy * scale:
                    break
            elif ksp.getType() != "preonly" and self._entries <= _GATHERED:  # it is stuck
                ksp.setType("preonly")
                ksp.getPC().setType("redundant")
            else:
                break
            x, low, residual = kept
            share = min(max(0.1 * accuracy * scale / missed, _FINEST), 0.1)
            ksp.setTolerances(share, 0.0, max_it=_STEPS)
            left.array = residual[self._order]
            ksp.solve(left, step)
            self.products += 2 * ksp.getIterationNumber()
            better = np.empty_like(x)
            better[self._order] = step.array
            x, low = exact_sum(x, low + better) if precise else (x + better, low)
        if not missed <= max(accuracy, 0.0 if precise else _LET_PASS) * scale:
            raise SolverError("PETSc cannot solve a policy's equations: try -ssp_lp_ksp_type gmres")
        return kept[:2]

    def runs(self, guess: FloatArray) -> FloatArray:
        """Return checked run lengths t, [own nodes]: 2 t is at least the expected number of steps.

        Raises:
            SolverError: some nodes are never left, or no solver reaches the accuracy.
        """
        half = np.full(self.halo.n_own, -0.5)
        for accuracy in (RUN_ACCURACY, _FINEST, EXACT):
            runs, _ = self.solve(np.ones_like(half), guess, accuracy)
            ahead = self.moves.safe_advantages(half, self.halo.with_ghosts(-runs))
            if not self.halo.ranks.any((ahead < 0.0) | (runs < 0.0)):
                return runs
        raise SolverError(HOLDS_MASS)


@dataclass(frozen=True, eq=False)
class PartitionedProcess(PricingProblem):
    """The process of case M on the rows of all ranks; each rank has the arrays of its own nodes."""

    labelled: LabelledProcess
    halo: Halo  # over the nodes of the process
    rewards: FloatArray  # [own pairs, rewards] cost, failure, rows
    at_once: FloatArray  # [rewards] rewards of start mass on goals and dead-ends
    start: FloatArray  # [own nodes]
    wants_ends: bool  # whether ends other than the goal count, or giving up is not allowed
    stays: IntArray  # [own nodes] a free pair that stays for ever, in place of giving up; -1: none
    kept: Callable[[IntArray, FloatArray], None] | None = None  # called with each new column
    earlier: list[Column] = field(default_factory=list)  # columns of an earlier run

    @property
    def ranks(self) -> Ranks:
        """The ranks that share the process."""
        return self.halo.ranks

    @property
    def dynamics(self) -> Dynamics:
        """Dynamics of the known nodes; ghosts have no pairs."""
        return self.labelled.process.dynamics

    @property
    def n_rewards(self) -> int:
        """Number of rewards: cost, failure and rows."""
        return int(self.rewards.shape[1])

    @property
    def value_shape(self) -> tuple[int, ...]:
        """Shape of a rank's values, [own nodes]."""
        return (self.halo.n_own,)

    @cached_property
    def _leaving(self) -> IntArray:
        """A policy by which every run ends, at the goal if possible, [own nodes]."""
        graph, goal = replace(self.dynamics).graph, self.labelled.process.goal > 0.0
        nearer = self.halo.approaching(graph, goal)
        if self.ranks.any(nearer < 0):
            leaving = self.halo.approaching(graph, self.dynamics.exits > 0.0)
            nearer = np.where(nearer >= 0, nearer, leaving)
        return nearer

    def first(self) -> Column:
        """Return the column of a policy that moves towards the goal."""
        return self._first

    @cached_property
    def _first(self) -> Column:
        """Column of a policy by which every run ends, at the goal if possible."""
        return self.measured(self._leaving)

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Find a column of least priced cost by policy iteration, with totals of bounded error."""
        weights, known = self._weights(price), (*warm, *self.earlier)
        evaluated = [one for one in known if one and one.totals is not None] or [self.first()]
        best = min(evaluated, key=lambda column: float(weights @ column.rewards))
        choice, totals = np.asarray(best.choice), np.asarray(best.totals)
        cost, values = weighted(self.rewards, weights), weighted(totals[:, :-1], weights)
        work, accuracy = Work(), _ROUGH
        for done in range(1, _MOST_ROUNDS + 1):
            accuracy = accuracy if done < _ROUGH_ROUNDS else EXACT
            choice = self._swept(cost, choice, values)
            equations = self._leaving_equations(choice, values)
            values, _ = equations.solve(cost[equations.choice], values, accuracy)
            equations.values = values
            better = self._better(cost, values, equations.choice, accuracy)
            work += Work(1 + _SWEEPS, 0 if better is None else equations.products)
            if better is not None and done < _MOST_ROUNDS:
                equations.clear()
                choice = better
                continue
            # decisions that are free at these weights may count in a limit
            settled = self._staying(self._giving_up(equations))
            if self.ranks.any(settled != equations.choice):
                equations.clear()
                equations = self._leaving_equations(settled, values)
            column = self._measured(equations, totals, weights)
            work, totals = work + column.work, np.asarray(column.totals)
            values = weighted(totals[:, :-1], weights)
            better = self._better(cost, values, equations.choice, EXACT)
            if better is None or accuracy <= EXACT:
                break
            choice, accuracy = better, EXACT
        if self.kept is not None:
            self.kept(self._positions(column), weights)
        return replace(column, work=work)

    def _better(
        self, cost: FloatArray, values: FloatArray, choice: IntArray, accuracy: float
    ) -> IntArray | None:
        """Improve a policy by one backup of all nodes; None: no pair is better.

        Args:
            cost: [own pairs].
            values: values of the policy, [own nodes].
            choice: the policy, [own nodes].
            accuracy: residual of the values, relative to the greatest value.
        """
        offsets = self.dynamics.pair_offsets[: self.halo.n_own + 1]
        known = self.halo.with_ghosts(values)
        backup = best_pairs(offsets, self.dynamics.transitions, cost, known, choice)
        noise = accuracy * self.ranks.greatest(np.abs(values).max(initial=0.0))
        least = IMPROVEMENT * np.abs(backup.current_values) + (noise if accuracy > EXACT else 0.0)
        better = backup.current_values - backup.minima > least
        if not self.ranks.any(better):
            return None
        return np.where(better, backup.choice, choice).astype(np.int32)

    def _weights(self, price: float | FloatArray) -> FloatArray:
        """Return all rewards' weights, given a price of failure or weights of the first rewards."""
        weights = pricing_weights(price)
        return np.append(weights, np.zeros(self.n_rewards - len(weights)))

    def _swept(self, cost: FloatArray, choice: IntArray, values: FloatArray) -> IntArray:
        """Improve a policy, and its values in place, by sweeps of each rank over its own nodes.

        Args:
            cost: [own pairs].
            choice: [own nodes].
            values: values that are at least the policy's, [own nodes].
        """
        n, entries = self.halo.n_own, len(self.dynamics.transitions.indices)
        if self.ranks.any(not accelerated(entries, "policy_improvement.improve_states")):
            return choice  # policy iteration alone converges as well
        full, known = np.zeros(self.halo.size, dtype=np.int32), self.halo.with_ghosts(values)
        full[:n] = choice
        for _ in range(_SWEEPS // _EXCHANGED):
            how = cost, full, known, 0.0, _EXCHANGED
            self.dynamics.improve_by_sweeps(*how, is_sorted_anew=True, states=np.arange(n))
            known = self.halo.with_ghosts(known)
        values[:] = known[:n]
        return full[:n]

    def _leaving_equations(self, choice: IntArray, values: FloatArray) -> _Equations:
        """Set up the equations of a policy, replaced by ``_leaving`` where runs would never end."""
        equations = _Equations(self, choice, values)
        closed = ~equations.leading(equations.moves.exits > 0.0)
        if not self.ranks.any(closed):
            return equations
        return _Equations(self, np.where(closed, self._leaving, choice).astype(np.int32), values)

    def _giving_up(self, equations: _Equations) -> IntArray:
        """Return the policy of some equations, changed to give up in nodes where it has failed.

        A policy has failed in a node if giving up is allowed there and its own decisions no longer
        lead to the goal. If ends other than the goal count, or if the criterion forbids giving up,
        it has failed only in nodes where it stays for ever without cost or other rewards.
        """
        choice = equations.choice
        leads = self.labelled.process.goal[choice] > 0.0
        if self.wants_ends:
            leads = (self.rewards[choice] != 0.0).any(axis=1) | (self.dynamics.exits[choice] > 0.0)
        lost = ~equations.leading(leads) & (self._exits >= 0)
        return np.where(lost, self._exits, choice).astype(np.int32)

    def _staying(self, choice: IntArray) -> IntArray:
        """Return the policy without giving up in components of cost 0 from which it can go on.

        There giving up is replaced by a pair that moves within the component.

        Args:
            choice: a pair of each own node, [own nodes].
        """
        quits = (choice == self._exits) & (self.stays >= 0)
        if not self.ranks.any(quits):
            return choice
        stays = np.where(quits, self.stays, choice)
        onward = _Equations(self, stays, self.start).leading(~quits)
        return np.where(quits & onward, stays, choice).astype(np.int32)

    @cached_property
    def _exits(self) -> IntArray:
        """Pair for giving up of each own node; -1 if giving up is not allowed, [own nodes]."""
        quotient, n = self.labelled.quotient, self.halo.n_own
        exits, gives_up = np.full(quotient.n_nodes, -1), np.flatnonzero(quotient.gives_up)
        exits[quotient.pair_node[gives_up]] = gives_up
        return exits[:n]

    def measured(self, choice: IntArray) -> Column:
        """Evaluate a policy, [own nodes], as a column: its totals to a bounded error.

        Raises:
            SolverError: the policy never leaves some nodes, or no solver reaches the accuracy.
        """
        nothing, cost = np.zeros((self.halo.n_own, self.n_rewards + 1)), np.eye(self.n_rewards)[0]
        return self._measured(_Equations(self, choice, nothing[:, 0]), nothing, cost)

    def _measured(self, equations: _Equations, guess: FloatArray, weights: FloatArray) -> Column:
        """Return the column of the policy that the equations belong to.

        Args:
            equations: equations of the policy, with its values at these weights.
            guess: approximate totals, [own nodes, rewards and steps].
            weights: weights of the rewards, not all 0, [rewards].
        """
        choice, totals, figures = equations.choice, guess.copy(), self.at_once.copy()
        totals[:, -1] = equations.runs(guess[:, -1])
        longest = float(self.ranks.greatest(totals[:, -1].max(initial=0.0)))
        accuracy, last = (
            min(EXACT, EVALUATED / max(2.0 * longest, 1.0)),
            int(np.argmax(weights > 0.0)),
        )
        for k in sorted(range(self.n_rewards), key=last.__eq__):
            rhs, about = np.ascontiguousarray(self.rewards[choice, k]), totals[:, k]
            if k == last:  # the others are known by now
                about = about + (equations.values - weighted(totals[:, :-1], weights)) / weights[k]
            about = np.where(equations.leading(rhs != 0.0), about, 0.0)  # these 0 are exact
            x, _ = equations.solve(rhs, about, _PLAIN)
            x, low = equations.solve(rhs, x, accuracy, precise=True)
            figures[k] += self.ranks.total(self.start @ x + self.start @ low)
            totals[:, k] = x
        equations.clear()
        return Column.of_rewards(figures, choice, totals=totals, work=Work(1, equations.products))

    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Prove a lower bound of every column's priced value from the values of a best policy."""
        totals = np.asarray(best.totals)[:, :-1]
        return self.check(price, weighted(totals, self._weights(price)))

    def minimise_and_prove(self, weights: FloatArray, warm: Column) -> Proof:
        """Find the best column at new weights, and prove the lower bound that it implies."""
        return self.prove(weights, self.minimise(weights, warm))

    def check(self, price: float | FloatArray, values: FloatArray, *, slack: bool = False) -> Proof:
        """Reduce values until one backup confirms them as lower bounds, and return the proof.

        Args:
            price: price of failure, or weights of the rewards.
            values: values of the rank's own nodes, [own nodes].
            slack: ignored.

        Raises:
            ModelError: values of another shape.
        """
        self.check_shape(values)
        weights = self._weights(price)
        values, begun = self._lowered(weights, values), float(weights @ self.at_once)
        parts = self.start * values
        total, size, terms = self.ranks.total([parts.sum(), np.abs(parts).sum(), len(parts)])
        rounding = (terms + self.n_rewards + 4.0) * (size + float(weights @ np.abs(self.at_once)))
        bound = float(total + begun - MACHINE_EPSILON * rounding)
        return Proof(float(weights[1]), float(weights[1]), bound, values)

    def _lowered(self, weights: FloatArray, values: FloatArray) -> FloatArray:
        """Reduce values until none exceeds its backup, as one backup of all rows confirms.

        The values move towards a constant lower bound by the least share s that suffices, which
        leaves a slack of s * g at a step of cost g. At steps of cost 0 values are lowered to those
        of the successors, and by a little more so that the sweeps end.
        """
        dynamics, greatest, n = self.dynamics, self.ranks.greatest, self.halo.n_own
        cost = weighted(self.rewards, weights)
        cost -= 2.0 * self.n_rewards * MACHINE_EPSILON * cost  # a bound rounds down
        leaves = dynamics.exits > 0.0
        floor = -float(greatest(-(cost[leaves] / dynamics.exits[leaves]).min(initial=np.inf)))
        floor = max(floor - 4.0 * MACHINE_EPSILON * floor, 0.0) if np.isfinite(floor) else 0.0
        values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
        most = float(greatest(values.max(initial=0.0)))
        for share in _SHRUNK:
            lowered = floor + (1.0 - share) * (values - floor) - share * _BELOW * most
            lowered = np.maximum(lowered, floor)
            for _ in range(_LOWERINGS if share else 1):
                lack = shortfall(dynamics, cost, self.halo.with_ghosts(lowered))[:n]
                if not self.ranks.any(lack):
                    return np.asarray(lowered)
                below = np.minimum(lowered - lack, np.nextafter(lowered, -np.inf))
                lowered = np.maximum(np.where(lack > 0.0, below, lowered), floor)
        return np.full_like(values, floor)

    def pulled_back(self, column: Column) -> Policy:
        """Return a column as a policy that has the decisions in the rank's own states."""
        part: Any = self.labelled.quotient.model
        return _OwnDecisions(part, self._positions(column), column.rewards)

    @property
    def _live(self) -> BoolArray:
        """Mask of the rank's own states that are nodes of the process, [own states]."""
        part: Any = self.labelled.quotient.model
        return np.asarray(self.labelled.quotient.node_of[: part.halo.n_own] >= 0)

    def _positions(self, column: Column) -> IntArray:
        """Return a column's decisions, [own states]: positions among the actions, or codes."""
        quotient, choice, live = self.labelled.quotient, np.asarray(column.choice), self._live
        positions = np.full(live.size, UNDECIDED, dtype=np.int32)
        stays = (choice == self._exits) & (self.stays >= 0)
        pair = quotient.pair_at[np.where(stays, self.stays, choice)]
        first = quotient.model.pair_offsets[: live.size][live]
        positions[live] = np.where(pair < 0, pair, pair - first)
        return positions

    def choice_of(self, positions: IntArray) -> IntArray:
        """Translate decisions, [own states], to pairs of the process, [own nodes].

        Raises:
            ModelError: a state has no decision, or one that is not allowed.
        """
        quotient, live = self.labelled.quotient, self._live
        taken, first = positions[live], quotient.model.pair_offsets[: live.size][live]
        choice = np.where(taken >= 0, quotient.places[np.maximum(taken, 0) + first], -1)
        choice = np.where(taken == GIVE_UP_CODE, self._exits, choice)
        if (choice < 0).any():
            state = quotient.model.states[int(np.flatnonzero(live)[np.argmax(choice < 0)])]
            raise ModelError(f"the policy has no decision, or no allowed one, in state {state!r}")
        return choice.astype(np.int32)

    def evaluated(self, positions: IntArray) -> Column:
        """Evaluate decisions, [own states], as a column that gives up after it has failed."""
        choice = self.ranks.agreed(lambda: self.choice_of(positions))
        nothing = np.zeros(self.halo.n_own)
        return self.measured(self._giving_up(_Equations(self, choice, nothing)))


def partitioned_process(compiled: CompiledExplicit, **more: Any) -> PartitionedProcess:
    """Build the process of a compiled problem of case M on a part; all ranks must call this.

    Components in which a policy may stay for ever at no cost are not collapsed: each of their
    states has a pair for giving up.

    Args:
        compiled: the problem.
        more: further fields of the process.
    """
    part: Any = compiled.facts.model
    semantics, discount, halo = compiled.semantics, compiled.facts.discount, part.halo
    own = np.arange(part.n_states) < halo.n_own
    exits, free = giving_up_states(part, semantics.give_up), np.zeros(part.n_states, dtype=np.bool_)
    stays = np.full(part.n_states, -1)
    if discount is None and semantics.give_up is GiveUp.DEAD_ENDS:  # else giving up is allowed
        pairs = free_pairs(part, semantics.aim, compiled.side, compiled.objective)
        ended = part.goal_mask | part.facts["hopeless_states"] | (np.diff(part.pair_offsets) == 0)
        free = halo.staying(part.graph, pairs, ended)
        staying = np.flatnonzero(pairs & free[part.pair_state] & ~pairs_into(part.graph, ~free))
        stays[part.pair_state[staying[::-1]]] = staying[::-1]
    quotient = replace(build_quotient(part, exits=(exits | free) & own), merged=free)
    start, live = np.where(own, compiled.facts.start, 0.0), quotient.node_of >= 0
    begun = np.where(live, start, 0.0)
    labelled = label_failure(part, begun, semantics, discount, quotient=quotient)
    counting = counting_of(labelled, start, semantics, discount)
    dead = float(start[quotient.dead].sum())
    cost, at_once = labelled.own_cost, counting.cost(part)[1] + semantics.penalty * dead
    if compiled.objective is not None:
        cost, at_once = compiled.objective.at(counting)
    elif semantics.aim is Aim.GREATEST_GOAL:
        at_once = dead
    rows = [(cost, at_once), (labelled.process.failure, dead)]
    rows += [row.at(counting) for row in compiled.side]
    n_own = int(np.count_nonzero(live & own))
    numbers = np.where(live, halo.ranks.comm.scan(n_own) - n_own + np.cumsum(live) - 1, 0)
    numbers = halo.with_ghosts(numbers.astype(np.float64)).astype(np.int64)
    return PartitionedProcess(
        labelled,
        Halo(halo.ranks, n_own, numbers[live][n_own:]),
        np.stack([row for row, _ in rows], axis=1),
        halo.ranks.total([begun for _, begun in rows]),
        labelled.process.start[:n_own],
        compiled.wants_ends or semantics.give_up is GiveUp.DEAD_ENDS,
        np.append(quotient.places, -1)[stays][live & own],
        **more,
    )


@dataclass(frozen=True, eq=False)
class CompiledPartitioned(CompiledExplicit):
    """A problem of case M, compiled on parts of a model; its process is ``priced``."""

    is_whole = False  # other problems on the model need another process

    def counting_rare_success(self, budget: float | None) -> CompiledPartitioned:
        """Return the problem itself: on ranks, rare success is not counted separately."""
        return self

    def least_failure(self) -> LeastFailure:
        """Find the cheapest policy of least failure, at a high price of failure.

        If a policy of least failure minimises ``cost + price * failure``, it is the cheapest of all
        policies of least failure. If no price is high enough for this, the result is a policy of
        least failure that need not be the cheapest.
        """
        pricing = self.pricing()
        cost, failure = np.eye(2, pricing.n_rewards)
        column = safest = pricing.minimise(failure)
        least = safest.failure + _SAME * min(safest.failure, 1.0 - safest.failure)
        proved = min(max(pricing.prove(failure, safest).bound, 0.0), safest.failure)
        for steep in _STEEPER:
            cheaper = pricing.minimise(cost + steep * max(safest.cost, 1.0) * failure, column)
            if cheaper.failure <= least:
                column = cheaper
                break
        return LeastFailure(pricing.policy(column), column, 0.0, proved)

    def failure_at_least(self, discount: float | None) -> float:
        """Return the least failure probability of all policies, for the message of an error."""
        stated = CompiledExplicit(replace(self.facts, discount=discount), self.semantics)
        return compiled_on_ranks(stated).least_failure().column.failure

    def at_least_failure(self, *known: Column) -> CompiledPartitioned:
        """Return the problem; a budget just below the least failure is replaced by the latter.

        Raises:
            InfeasibleError: the budget is below the least failure by more than rounding.
        """
        least = self.least.column.failure if self.limits_failure else -np.inf
        return self if (self.budget or 0.0) > least else replace(self, budget=least)

    def refined(self, price: float) -> None:
        """Return None, since the process truncates nothing and cannot be refined."""
        return


def compiled_on_ranks(stated: CompiledExplicit, **more: Any) -> CompiledPartitioned:
    """Return a compiled problem with its process on parts of a model; all ranks must call this.

    Args:
        stated: the problem.
        more: further fields of the process.
    """
    priced: Any = partitioned_process(stated, **more)
    return CompiledPartitioned(**fields_of(stated, stated) | {"priced": priced})
