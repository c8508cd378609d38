"""Policies of a partitioned model: each rank has the decisions of its own states.

They are measured and played where the model's rows lie. The chain of a member is one chain whose
moves lie with the ranks, so that what an evaluation makes of a chain
(``analysis.evaluation``) it makes of this one; all ranks ask the same of it at the same time. A
simulated episode is with the rank that owns its state, and goes to the owner of the next one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ssp_lp.analysis.counted_draws import counted_words, drawn_entries, drawn_outcomes
from ssp_lp.analysis.evaluation import (
    Evaluation,
    evaluated_measures,
    evaluation_of,
    lost_nodes,
    mean_of,
)
from ssp_lp.analysis.simulation import (
    Played,
    SimulationReport,
    failing_charges,
    simulation_report,
)
from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    entries_of,
    offsets_of,
)
from ssp_lp.cargo import Cargo
from ssp_lp.distributed.dynamics import PartitionedDynamics, PartitionedSystem
from ssp_lp.distributed.graph_sweeps import on_any, reaching
from ssp_lp.distributed.order import inverse
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.distributed.share import Share
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.evaluation import evaluate_chain
from ssp_lp.errors import ModelError
from ssp_lp.io.archives import opened_archive, write_archive
from ssp_lp.model import SSP
from ssp_lp.model.graph import (
    Graph,
    attention_states,
    end_marks,
    hopeless_states,
    reached_along,
    stop_marks,
)
from ssp_lp.policies import CostAwarePolicy, DeterministicPolicy, MixedPolicy
from ssp_lp.policies.chain import Chain
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, check_decisions
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import GiveUp, start_distribution

if TYPE_CHECKING:
    from ssp_lp.distributed.partitioned_model import PartitionedModel

_WHOLE = "policy.npz"  # the file of a saved policy that says what the others are
_KIND, _PART = "partitioned policy", "part of a policy"

_EPISODE = np.dtype(
    [
        ("number", np.int64),
        ("member", np.int64),
        ("state", np.int64),
        ("steps", np.int64),
        ("cost", np.float64),  # until failing
        ("charge", np.float64),  # of having lost the goal
        ("lost", np.bool_),
        ("gave_up", np.bool_),
    ]
)
"""What of a simulated episode goes from rank to rank."""


@dataclass(frozen=True, eq=False, repr=False)
class PartitionedPolicy(ReadOnlyCopies):
    """A lottery over policies of a partitioned model; decisions lie with the states' ranks."""

    model: PartitionedModel
    weights: FloatArray  # [members]
    positions: IntArray  # [members, own states] among the actions, GIVE_UP_CODE or UNDECIDED
    below: tuple[IntArray, ...] = ()
    """Where accumulated cost is told apart, what each member does by layers of it, [layers, own
    states] each; the positions are what it does from all of these on."""
    unit: float = 1.0  # cost of a layer

    def __post_init__(self) -> None:
        self.keep_read_only("weights", dtype=np.float64)
        self.keep_read_only("positions")

    def check(self) -> None:
        """Check this rank's part of the partitioned policy.

        Raises:
            ModelError: weights that are no distribution, or a decision that is none of the state's.
        """
        slab = self.model.slab
        shape = len(self.weights), slab.end - slab.first
        if self.positions.shape != shape:
            raise ModelError(f"positions of shape {shape} are needed, not {self.positions.shape}")
        if not (self.weights.min(initial=1.0) >= 0.0 and abs(self.weights.sum() - 1.0) <= 1e-9):
            raise ModelError(f"weights must form a distribution, not {self.weights.tolist()}")
        for positions in self.positions:
            full = np.full(slab.n_states, UNDECIDED, dtype=np.int64)
            full[slab.own] = positions
            check_decisions(slab, full, as_positions=True)

    def __repr__(self) -> str:
        """One line: the members' weights and how many states they decide in."""
        weights = ", ".join(f"{weight:.6g}" for weight in self.weights)
        return f"PartitionedPolicy({self.model.slab.n_states:,} states, members' weights {weights})"

    @property
    def members(self) -> tuple[PartitionedPolicy, ...]:
        """Each member of the partitioned policy by itself."""
        return tuple(
            replace(self, weights=np.ones(1), positions=own[None], below=self.below[k : k + 1])
            for k, own in enumerate(self.positions)
        )

    def gathered(self) -> IntArray:
        """Positions of the partitioned policy, [members, states]; all ranks ask together."""
        return self._of_all_states(self.positions)

    def _of_all_states(self, own: IntArray) -> IntArray:
        """What the partitioned policy has of own states, for all of the model, [rows, states]."""
        every = np.concatenate(self.model.ranks.comm.allgather(own), axis=1)
        return every if self.model.order is None else every[:, inverse(self.model.order)]

    def on(self, model: SSP) -> MixedPolicy:
        """The partitioned policy on the same model, held whole; all ranks ask together.

        Raises:
            ModelError: the model has another number of states.
        """
        n_states = self.model.slab.n_states
        if model.n_states != n_states:
            raise ModelError(f"the policy is for another model, of {n_states:,} states: this one "
                             f"has {model.n_states:,}")  # fmt: skip
        offsets = model.pair_offsets[:-1]
        every = self.gathered().astype(np.int64)
        pairs = np.where(every >= 0, every + offsets, every)
        members = [DeterministicPolicy(model, own) for own in pairs]
        if not self.below:
            return MixedPolicy(tuple(members), self.weights)
        never, layers = np.full(model.n_states, np.inf), map(self._of_all_states, self.below)
        both = zip(layers, pairs, strict=True)
        by_cost = [CostAwarePolicy(model, self.unit, own, tail[None], never) for own, tail in both]
        return MixedPolicy(tuple(by_cost), self.weights)

    def save(self, folder: str | Path) -> None:
        """Write the partitioned policy, each rank a file of its own; all ranks ask together.

        Args:
            folder: that all ranks can write to; it is made if need be. A policy in it is replaced.

        Raises:
            ModelError: it acts on the cost paid so far, or has decisions that are none.
            OSError: a file cannot be written.
        """
        if self.below:
            raise ModelError("a policy that acts on the cost paid is saved from a model held "
                             "whole: save_policy(answer.on(problem).policy, ...)")  # fmt: skip
        ranks, slab, told = self.model.ranks, self.model.slab, _told(self.model)
        ranks.agreed(self.check)
        rank, whole = ranks.comm.rank, Path(folder) / _WHOLE
        bounds = np.array([*ranks.comm.allgather(slab.first), slab.n_states])

        def opened() -> None:
            """Make the folder, and take away what said that the parts are of one policy."""
            if rank == 0:
                whole.parent.mkdir(parents=True, exist_ok=True)
                whole.unlink(missing_ok=True)

        def closed() -> None:
            """Say what the parts are, which all are there now."""
            if rank == 0:
                write_archive(whole, _KIND, told, {"weights": self.weights, "bounds": bounds})

        own = {"positions": self.positions}
        ranks.agreed(opened)
        ranks.agreed(lambda: write_archive(whole.with_name(_part_name(rank)), _PART, {}, own))
        ranks.agreed(closed)

    @classmethod
    def load(cls, model: PartitionedModel, folder: str | Path) -> PartitionedPolicy:
        """Read a partitioned policy, each rank the decisions of its own states.

        Args:
            model: for which it was saved, by any number of ranks.
            folder: of :meth:`save`.

        Raises:
            ModelError: it was saved for another model, or a file is damaged.
            OSError: a file cannot be opened.
        """
        folder, told, slab = Path(folder), _told(model), model.slab

        def read() -> PartitionedPolicy:
            """This rank's part, from all files that have some of it."""
            with opened_archive(folder / _WHOLE, _KIND) as (header, arrays):
                if any(header[name] != known for name, known in told.items()):
                    kept = ", ".join(f"{header[name]:,} {name}" for name in ("states", "pairs"))
                    raise ModelError(f"the policy is for another model, of {kept}")
                weights, bounds = arrays["weights"], arrays["bounds"]
            parts = [np.zeros((len(weights), 0), dtype=np.int32)]
            for k, (first, end) in enumerate(pairwise(bounds.tolist())):
                if max(first, slab.first) < min(end, slab.end):
                    with opened_archive(folder / _part_name(k), _PART) as (_, arrays):
                        own = slice(max(slab.first - first, 0), slab.end - first)
                        parts.append(arrays["positions"][:, own])
            policy = cls(model, weights, np.concatenate(parts, axis=1))
            policy.check()
            return policy

        return model.ranks.agreed(read)

    def chains(self, start: FloatArray) -> Iterator[PartitionedChain]:
        """The chain of each member of the partitioned policy, as far as it is reached.

        Each is made when it is asked for, which all ranks do together.

        Args:
            start: distribution, [states].

        Raises:
            ModelError: a member has no decision in a state that it reaches.
        """
        return (self._chain(positions, start) for positions in self.positions)

    def _chain(self, positions: IntArray, start: FloatArray) -> PartitionedChain:
        """The chain of one member of the partitioned policy."""
        slab, ranks = self.model.slab, self.model.ranks
        dead = hopeless_states(slab)
        decision = np.full(slab.n_states, UNDECIDED, dtype=np.int64)
        decision[slab.own] = np.where(
            positions >= 0, positions + slab.pair_offsets[:-1][slab.own], positions
        )
        deciding = slab.own_mask & ~(slab.goal_mask | dead)
        acting = np.flatnonzero(deciding & (decision >= 0))
        outcome, count = entries_of(slab.outcome_offsets, decision[acting])
        possible = slab.probabilities[outcome] > 0.0
        outcome, source = outcome[possible], np.repeat(acting, count)[possible]
        target = slab.successors[outcome]

        # reached from the start, rank by rank, until nothing is added
        offsets = offsets_of(np.bincount(source, minlength=slab.n_states))
        found, reached = start > 0.0, np.zeros(slab.n_states, dtype=np.bool_)
        while not np.array_equal(found, reached):
            reached = found
            found = on_any(ranks.comm, reached_along(target, offsets, np.flatnonzero(reached)))
        missing = np.flatnonzero(reached & deciding & (decision == UNDECIDED))
        ranks.agreed(lambda: _check_decided(slab, missing))
        state, place = np.flatnonzero(reached), np.cumsum(reached, dtype=np.int32) - 1
        first, end = np.searchsorted(state, [slab.first, slab.end]).tolist()
        quits = slab.of_all_states(np.where(deciding & (decision == GIVE_UP_CODE), 1.0, 0.0))
        moves = reached[source]
        outcome = outcome[moves]
        decided = np.flatnonzero(reached & deciding)
        return PartitionedChain(
            model=slab,
            state=state,
            memory=np.zeros_like(state),
            start=start[state],
            give_up=quits[state],
            dead=dead[state].astype(np.float64),
            source=place[source[moves]],
            target=place[target[moves]],
            probability=slab.probabilities[outcome],
            cost=slab.costs[outcome],
            outcome=outcome,
            branch_node=place[decided],
            branch_pair=decision[decided],
            branch_probability=np.ones(decided.size),
            ranks=ranks,
            own=slice(first, end),
        )

    def evaluated(self, problem: Problem) -> tuple[Evaluation, list[Evaluation]]:
        """Evaluation of the partitioned policy, and of each member, on the rows of all ranks.

        Args:
            problem: on this rank's part of the model.

        Raises:
            ModelError: a member has no decision in a state that it reaches, or gives up where the
                problem forbids it.
        """
        start = start_distribution(self.model.slab, problem.start)
        members = [evaluated_measures(chain, problem) for chain in self.chains(start)]
        each = [evaluation_of(member, problem) for member in members]
        return evaluation_of(mean_of(members, self.weights), problem), each

    def simulated(
        self,
        problem: Problem,
        episodes: int,
        seed: int,
        max_steps: int,
        record: int,
        confidence: float,
    ) -> SimulationReport:
        """Report of simulated episodes of the partitioned policy: see ``PartitionedModel``."""
        played = self._played(problem, episodes, seed, max_steps, record)
        slab, comm = self.model.slab, self.model.ranks.comm
        over = hopeless_states(slab) | slab.goal_mask
        going = np.repeat(~over[slab.pair_state], np.diff(slab.outcome_offsets))
        dearest, most = (
            max(comm.allgather(float(costs.max(initial=0.0))))
            for costs in (slab.costs, slab.costs[going])
        )
        return simulation_report(
            problem, played, confidence, max_steps, max_steps * most, True, dearest
        )

    def _in_first_order(self, places: list[IntArray]) -> IntArray:
        """Places of all ranks' episodes with the states' numbers in the model, [3, places]."""
        every, order = np.concatenate(places, axis=1), self.model.order
        if order is not None:
            every[2] = order[every[2]]
        return every

    def _played(
        self, problem: Problem, episodes: int, seed: int, max_steps: int, record: int
    ) -> Played:
        """Play the partitioned policy's episodes, each where its state lies."""
        slab, comm, marks = self.model.slab, self.model.ranks.comm, end_marks(self.model.slab)
        start, charges = start_distribution(slab, problem.start), failing_charges(problem)
        watched = attention_states(slab) & (marks < 0)  # elsewhere no policy has lost the goal
        watched &= problem.semantics.give_up is not GiveUp.DEAD_ENDS  # which pays until a dead-end
        lost_in = np.zeros(self.positions.shape, dtype=np.bool_)
        for member, chain in zip(lost_in, self.chains(start), strict=True):
            lost = np.zeros(slab.n_states, dtype=np.bool_)
            lost[chain.state] = lost_nodes(chain, problem)
            member[:] = (lost & watched)[slab.own]

        runs = _begun_episodes(start, self.weights, episodes, seed)
        runs = runs[slab.own_mask[runs["state"]]]
        ends = comm.allgather(slab.end)
        ended, seen = [], [_places(runs, record)]
        for step in range(max_steps + 1):
            over = (marks[runs["state"]] >= 0) | runs["gave_up"]
            ended.append(runs[over])
            runs = _travelled(comm, runs[~over], ends)
            if step == max_steps or not comm.allreduce(runs.size):
                break
            here = runs["member"], runs["state"] - slab.first
            newly = lost_in[here] & ~runs["lost"]
            runs["charge"][newly] = charges[1][runs["state"][newly]]
            runs["lost"] |= newly
            position = self.positions[here].astype(np.int64)
            runs["gave_up"] = position == GIVE_UP_CODE
            going = np.flatnonzero(position != GIVE_UP_CODE)
            pairs = position[going] + slab.pair_offsets[runs["state"][going]]
            words = counted_words(seed, runs["number"][going], step + 1)[0]
            outcome = drawn_outcomes(slab, pairs, words)
            paid = slab.costs[outcome]
            runs["cost"][going] += np.where(runs["lost"][going], 0.0, paid)
            runs["state"][going] = slab.successors[outcome]
            runs["steps"][going] += 1
            seen.append(_places(runs[going], record))
        every = np.concatenate(comm.allgather(np.concatenate([*ended, runs])))
        every = every[np.argsort(every["number"])]
        state, gave_up = every["state"], every["gave_up"]
        charge = np.where(gave_up, charges[1][state], charges[0][state])
        return Played(
            mark=np.where(gave_up, stop_marks(slab)[state], marks[state]),
            cost=every["cost"],
            charge=np.where(every["lost"], every["charge"], charge),
            later=np.zeros(episodes),
            steps=every["steps"],
            paths=_paths(self._in_first_order(comm.allgather(np.concatenate(seen, axis=1)))),
        )


@dataclass(frozen=True, eq=False)
class PartitionedChain(Chain):
    """The chain of a partitioned policy: nodes are known everywhere, moves where they begin."""

    ranks: Ranks = field(kw_only=True)
    own: slice = field(kw_only=True)  # nodes whose moves are this rank's

    def _of_all(self, made: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """What each rank made of the chain's own nodes, for all nodes."""
        return np.concatenate(self.ranks.comm.allgather(made[self.own]))

    def per_node(self, move_values: FloatArray) -> FloatArray:
        """Expected value of the next move in the partitioned chain, [nodes]."""
        return self._of_all(super().per_node(move_values))

    def ahead(self, values: FloatArray) -> FloatArray:
        """Expected value of the partitioned chain's next node, [nodes] or [nodes, values]."""
        return self._of_all(super().ahead(values))

    def reaching(self, ends: BoolArray) -> BoolArray:
        """Nodes from which the partitioned chain may come to one of the given nodes, [nodes]."""
        comm = self.ranks.comm
        return reaching(comm, partial(on_any, comm), self._graph, ends)

    @cached_property
    def _graph(self) -> Graph:
        """The partitioned chain's own moves, as a graph of all nodes."""
        first, end, rows = self.own.start, self.own.stop, self.matrix
        before = np.clip(np.arange(self.n_nodes + 1), first, end) - first
        begins = rows.indptr[first : end + 1].astype(np.int64)
        return Graph(before, begins, rows.indices, rows.data)

    def accumulate(
        self, reward: FloatArray, inside: BoolArray, survival: float = 1.0
    ) -> FloatArray:
        """Expected total reward in the partitioned chain: see ``Chain.accumulate``."""
        result, nodes = np.zeros_like(reward), np.flatnonzero(inside)
        if not nodes.size:
            return result
        first, end = np.searchsorted(nodes, [self.own.start, self.own.stop]).tolist()
        rows, exits = self._equations(nodes[first:end], inside, survival)
        before = np.clip(np.arange(nodes.size + 1), first, end) - first
        ranks, process = self.ranks, Dynamics(before, rows, exits)
        nothing = np.zeros((end - first, 0))
        ranks.hold(Share(ranks.comm, ranks.petsc, process, nothing, first, end))

        def totals() -> FloatArray:
            """The verified totals, on the first rank."""
            every = np.arange(nodes.size, dtype=np.int32)
            system = PartitionedSystem(PartitionedDynamics.held_by(ranks), every)
            return evaluate_chain(system, reward[nodes].reshape(nodes.size, -1)).values

        found = ranks.answered(Cargo(), totals)
        result[nodes] = found.reshape(reward[nodes].shape)
        return result


def _check_decided(slab: SSP, missing: IntArray) -> None:
    """Raise :class:`ModelError` where a partitioned policy has to act and has no decision."""
    if missing.size:
        name = slab.states[int(missing[0])]
        raise ModelError(f"the policy has no decision in state {name!r}")


def _part_name(rank: int) -> str:
    """Name of the file of a partitioned policy that a rank writes."""
    return f"part-{rank:05}.npz"


def _told(model: PartitionedModel) -> dict[str, Any]:
    """Words about a model by which a partitioned policy's file knows it; all ranks ask together."""
    slab = model.slab
    actions = np.diff(slab.pair_offsets) * np.arange(1, slab.n_states + 1)
    own = slab.n_pairs, slab.n_outcomes, int(actions.sum())
    pairs, outcomes, actions_by_state = (
        int(sum(part)) for part in zip(*model.ranks.comm.allgather(own), strict=True)
    )
    named = {name: members.tolist() for name, members in slab.state_labels.items()}
    states = None if isinstance(slab.states, range) else [repr(state) for state in slab.states]
    words = json.dumps([states, named, actions_by_state]).encode()
    digest = sha256(words + np.packbits(slab.goal_mask).tobytes()).hexdigest()
    return {"states": slab.n_states, "pairs": pairs, "outcomes": outcomes, "model": digest}


def _begun_episodes(
    start: FloatArray, weights: FloatArray, episodes: int, seed: int
) -> npt.NDArray[Any]:
    """Simulated episodes of all ranks as they begin: states and members drawn, [episodes]."""
    runs, support = np.zeros(episodes, dtype=_EPISODE), np.flatnonzero(start)
    runs["number"] = np.arange(episodes)
    words = counted_words(seed, runs["number"], 0)
    runs["state"] = support[drawn_entries(start[support], words[0])]
    runs["member"] = drawn_entries(weights, words[1])
    return runs


def _travelled(comm: Any, runs: npt.NDArray[Any], ends: list[int]) -> npt.NDArray[Any]:
    """Simulated episodes in the states of this rank, after all went to the owners of theirs."""
    owner = np.searchsorted(ends, runs["state"], side="right")
    order = np.argsort(owner, kind="stable")
    parts = np.split(runs[order], np.searchsorted(owner[order], np.arange(1, comm.size)))
    return np.concatenate(comm.alltoall(parts))


def _places(runs: npt.NDArray[Any], record: int) -> IntArray:
    """Numbers of recorded simulated episodes, steps taken and states, [3, some episodes]."""
    kept = runs[runs["number"] < record]
    return np.stack([kept["number"], kept["steps"], kept["state"]])


def _paths(places: IntArray) -> tuple[IntArray, ...]:
    """States of each recorded simulated episode in the order of its steps."""
    number, _, state = places[:, np.lexsort((places[1], places[0]))]
    return tuple(np.split(state, np.flatnonzero(np.diff(number)) + 1)) if state.size else ()
