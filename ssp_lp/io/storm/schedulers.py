"""Policies as scheduler files, of the form in which Storm itself writes its schedulers."""

from __future__ import annotations

import json
from collections.abc import Hashable, Iterator
from typing import Any

import numpy as np

from ssp_lp.analysis.chain import Chain, policy_chain
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.exported import Exported, exported, write_text
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph.reachability import attention_pairs, attention_states
from ssp_lp.policies import MixedPolicy, Policy
from ssp_lp.policies.mixed import as_lottery
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.processes.failure_semantics import start_distribution

Situation = tuple[int, int]
"""A state of the file and a memory."""

Decisions = dict[Situation, dict[int, tuple[float, dict[int, int]]]]
"""In each situation the choices, each with its probability and the memory after each successor."""


@explained
def write_scheduler(policy: Policy | MixedPolicy, path: FilePath, *, start: Hashable) -> None:
    """Write a policy as a scheduler, as JSON of the form that Storm exports.

    States "s" and choices "index" are the numbers of :func:`ssp_lp.io.write_drn` and
    :func:`ssp_lp.io.to_stormpy`, "labels" the choice's action. A policy without memory says what
    it does in every state, "undefined" where it has no decision. One with memory has an entry for
    each state and memory "m" that it comes to, with the memory after each successor; memory 0 is
    that of the start. Where a policy gives up, the scheduler surely avoids the goal from then on.

    Args:
        policy: a policy, or a lottery of one member; with several take the equivalent
            ``solution.randomised_policy``, or :func:`~ssp_lp.io.induced_chain`.
        path: the file; gzip if the name ends in .gz.
        start: the initial state.

    Raises:
        ModelError: a lottery of several members, a policy that gives up where every action may
            still lead to the goal, or one without a decision in a state that it reaches.
    """
    members = as_lottery(policy).policies
    if len(members) > 1:
        raise ModelError(
            "a scheduler draws no lottery at the start: write solution.randomised_policy, or the "
            "chain, induced_chain(policy, start)"
        )
    process = exported(policy.model, start)
    begin = start_distribution(policy.model, start)
    chain = policy_chain(policy.model, members[0], begin)
    single = (
        np.unique(chain.memory[~_ended_in_scheduler(chain)]).size <= 1
        and not (chain.give_up > 0.0).any()
    )
    if single:
        memory = int(members[0].start_memory(np.flatnonzero(begin))[0])
        entries = _scheduler_without_memory(members[0], memory, process)
    else:
        entries = _scheduler_with_memory(_SchedulerAutomaton(chain, process).decisions(), process)
    write_text(path, _scheduler_text(entries))


def _scheduler_text(entries: Iterator[dict[str, Any]]) -> Iterator[str]:
    """The scheduler's file in pieces, an entry each."""
    before = "[\n"
    for entry in entries:
        yield before + json.dumps(entry, indent=4, sort_keys=True)
        before = ",\n"
    yield "\n]\n"


def _scheduler_choice(process: Exported, index: int, probability: float) -> dict[str, Any]:
    """A choice of the scheduler, in Storm's words."""
    return {"index": index, "labels": [process.actions[index]], "prob": probability}


def _scheduler_without_memory(
    policy: Policy, memory: int, process: Exported
) -> Iterator[dict[str, Any]]:
    """An entry for each state of the file."""
    model = policy.model
    acting = np.flatnonzero(np.diff(model.pair_offsets))
    found = policy.branches(acting, np.full(acting.size, memory))
    chosen: dict[int, list[dict[str, Any]]] = {state: [] for state in acting.tolist()}
    for situation, pair, chance in zip(*(part.tolist() for part in found), strict=True):
        if pair >= 0 and chance > 0.0:
            index = int(process.choice_of_pair[pair])
            chosen[int(acting[situation])].append(_scheduler_choice(process, index, chance))
    for state, first in enumerate(process.pair_offsets[:-1].tolist()):
        choices = chosen.get(state, [_scheduler_choice(process, first, 1.0)])
        yield {"s": state, "c": choices or "undefined"}


def _scheduler_with_memory(decisions: Decisions, process: Exported) -> Iterator[dict[str, Any]]:
    """An entry for each state and memory that is reached."""
    for (state, memory), choices in sorted(decisions.items()):
        entry: dict[str, Any] = {"s": state, "m": memory, "c": []}
        for index, (chance, after) in sorted(choices.items()):
            updates = [{"s'": successor, "m'": after[successor]} for successor in sorted(after)]
            entry["c"].append(
                _scheduler_choice(process, index, chance) | {"memory-updates": updates}
            )
        yield entry


def _ended_in_scheduler(chain: Chain) -> Any:
    """Which nodes are goals or dead-ends, [nodes]."""
    return chain.model.goal_mask[chain.state] | (chain.dead > 0.0)


class _SchedulerAutomaton:
    """What a policy with a memory does on the states of a file. Grows."""

    def __init__(self, chain: Chain, process: Exported) -> None:
        self._chain, self._process, self._model = chain, process, chain.model
        start = int(chain.memory[int(np.argmax(chain.start))])
        codes = sorted(set(chain.memory.tolist()) - {start})
        self._number = {code: k for k, code in enumerate([start, *codes])}
        self._given_up = len(self._number)  # the memory of having given up
        self._staying = attention_pairs(chain.model, attention_states(chain.model))
        self._found: Decisions = {}

    def decisions(self) -> Decisions:
        """The choices of every state and memory that is reached."""
        moves = self._moves()
        for node in np.flatnonzero(_ended_in_scheduler(self._chain)).tolist():
            self._end(int(self._chain.state[node]), self._memory(node))
        branches = self._chain.branch_node, self._chain.branch_pair, self._chain.branch_probability
        quits: dict[int, float] = {}
        for node, pair, chance in zip(*(part.tolist() for part in branches), strict=True):
            if pair == GIVE_UP_CODE and chance > 0.0:
                quits[node] = chance
            elif chance > 0.0:
                state, memory = int(self._chain.state[node]), self._memory(node)
                self._take(state, memory, pair, chance, moves[node, pair])
        for node, chance in quits.items():  # by actions that are not taken otherwise
            self._quit(int(self._chain.state[node]), self._memory(node), chance)
        return self._found

    def _memory(self, node: int) -> int:
        """The scheduler's memory at a node."""
        return self._number[int(self._chain.memory[node])]

    def _moves(self) -> dict[tuple[int, int], dict[int, int]]:
        """The memory after each outcome, by node and pair."""
        chain, moves = self._chain, dict[tuple[int, int], dict[int, int]]()
        pairs = np.searchsorted(self._model.outcome_offsets, chain.outcome, side="right") - 1
        steps = chain.source, pairs, chain.outcome, chain.target
        for node, pair, outcome, target in zip(*(part.tolist() for part in steps), strict=True):
            moves.setdefault((node, pair), {})[outcome] = self._memory(target)
        return moves

    def _take(
        self, state: int, memory: int, pair: int, chance: float, after: dict[int, int]
    ) -> None:
        """Take a pair; states that pay keep the memory until they have paid."""
        index = int(self._process.choice_of_pair[pair])
        choices, updates = self._found.setdefault((state, memory), {}), {}
        for outcome, then in after.items():
            target = int(self._process.target_of_outcome[outcome])
            updates[target] = then
            if target >= self._model.n_states:
                self._pay(target, then)
        choices[index] = chance, updates

    def _pay(self, state: int, memory: int) -> None:
        """Pay in a state of its own, the scheduler's memory unchanged."""
        index = int(self._process.pair_offsets[state])
        follower = int(self._process.successors[self._process.outcome_offsets[index]])
        self._found[state, memory] = {index: (1.0, {follower: memory})}

    def _end(self, state: int, memory: int) -> None:
        """Stay where nothing happens any more; a dead-end that has actions is left to them."""
        if self._model.pair_offsets[state] < self._model.pair_offsets[state + 1]:
            self._quit(state, memory, 1.0)
            return
        index = int(self._process.pair_offsets[state])
        self._found[state, memory] = {index: (1.0, {state: memory})}

    def _quit(self, state: int, memory: int, chance: float) -> None:
        """Give up: from here on avoid the goal."""
        queue, waiting = [(state, memory, chance)], set[int]()
        while queue:
            here, code, share = queue.pop()
            pair = self._avoiding(here, code)
            begin, end = self._model.outcome_offsets[pair : pair + 2].tolist()
            occurs = [k for k in range(begin, end) if self._model.probabilities[k] > 0.0]
            self._take(here, code, pair, share, dict.fromkeys(occurs, self._given_up))
            for there in {int(self._model.successors[k]) for k in occurs}:
                if (there, self._given_up) in self._found or there in waiting:
                    continue
                waiting.add(there)
                if self._model.pair_offsets[there] < self._model.pair_offsets[there + 1]:
                    queue.append((there, self._given_up, 1.0))
                else:
                    self._end(there, self._given_up)

    def _avoiding(self, state: int, memory: int) -> int:
        """A pair that surely avoids the goal and is not taken for another reason."""
        taken = self._found.get((state, memory), {})
        for pair in range(*self._model.pair_offsets[state : state + 2].tolist()):
            if self._staying[pair] and int(self._process.choice_of_pair[pair]) not in taken:
                return pair
        raise ModelError(
            f"the policy gives up in state {self._model.states[state]!r}, where every action that "
            "it does not take otherwise may lead to the goal: a scheduler cannot say so, "
            "induced_chain(policy, start) can"
        )
