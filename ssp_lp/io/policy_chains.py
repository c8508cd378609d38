"""The Markov chain of a policy for other tools: as a model, as a scheduler, as a graph."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, offsets_of
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.raw_model import (
    GOAL,
    Exported,
    FilePath,
    ModelFile,
    exported,
    write_text,
)
from ssp_lp.io.policy_tables import memories_of
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import attention_pairs, attention_states
from ssp_lp.policies import MixedPolicy, Policy
from ssp_lp.policies.chain import Chain, policy_chain, reaching_in_chain
from ssp_lp.policies.policy import GIVE_UP_CODE, as_lottery
from ssp_lp.processes.failure_semantics import start_distribution

START, GAVE_UP = "start", "gave up"
"""States of the chain besides those of the policy: where its lottery is drawn, and its end."""

_MOST_NODES = 300
"""More than this no picture shows; Graphviz would take minutes, too."""

_Rows = tuple[IntArray, IntArray, FloatArray, FloatArray]
"""Source, target, probability and cost of each step."""


def _member_chains(
    policy: Policy | MixedPolicy, start: Hashable | Mapping[Hashable, float]
) -> tuple[MixedPolicy, list[Chain]]:
    """A policy as a lottery, and the chain of each of its members."""
    lottery = as_lottery(policy)
    begin = start_distribution(lottery.model, start)
    return lottery, [policy_chain(lottery.model, member, begin) for member in lottery.policies]


@explained
def induced_chain(
    policy: Policy | MixedPolicy, start: Hashable | Mapping[Hashable, float]
) -> ModelFile:
    """Make the Markov chain of a policy, whatever its memory, as a model with one action.

    Its states are (state, memory), where there is a lottery (member, state, memory); "start", from
    which a free step draws the member and the first state, and "gave up", where the policy gives
    up. A state from which the policy does not come to the goal is an end. Costs stay with their
    outcomes; labels of states are the model's, and "gave up". Any tool that reads the chain's file
    can check what is said of the policy: the chance of the goal is the policy's, and its expected
    total cost is the policy's cost until failure is certain (without that of a failing step).

    Args:
        policy: a policy or a lottery.
        start: a state, or ``{state: probability}``.

    Returns:
        The chain and its initial state, "start".

    Raises:
        ModelError: the start is wrong, or the policy has no decision in a state that it reaches.
    """
    lottery, chains = _member_chains(policy, start)
    model = lottery.model
    firsts = offsets_of(np.array([chain.n_nodes for chain in chains]))
    n_states = int(firsts[-1]) + 2
    draw, end = n_states - 2, n_states - 1
    drawn = zip(lottery.weights, chains, strict=True)
    chance = np.concatenate([weight * chain.start for weight, chain in drawn])
    begun = np.flatnonzero(chance > 0.0)
    parts: list[_Rows] = [(np.full(begun.size, draw), begun, chance[begun], np.zeros(begun.size))]
    parts += [_steps_of_chain(chain, int(firsts[k]), end) for k, chain in enumerate(chains)]
    source, target, chance, cost = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.argsort(source, kind="stable")
    acting, sizes = np.unique(source, return_counts=True)
    states: list[Hashable] = [
        (model.states[state], memory) if len(chains) == 1 else (k, model.states[state], memory)
        for k, chain in enumerate(chains)
        for state, memory in zip(chain.state.tolist(), chain.memory.tolist(), strict=True)
    ]
    states += [START, GAVE_UP]
    model_state = np.concatenate([chain.state for chain in chains])  # [nodes]
    goals = np.flatnonzero(model.goal_mask[model_state])
    if not goals.size:  # a model has a goal, though this one is not reached
        states.append(GOAL)
        goals = np.array([n_states])
        n_states += 1
    labels = {
        name: [states[k] for k in np.flatnonzero(np.isin(model_state, members))]
        for name, members in model.state_labels.items()
    }
    made = SSP.from_arrays(
        pair_offsets=offsets_of(np.bincount(acting, minlength=n_states)),
        outcome_offsets=offsets_of(sizes),
        successors=target[order],
        probabilities=chance[order],
        costs=cost[order],
        goal_states=goals,
        states=states,
        state_labels=labels | {GAVE_UP: [GAVE_UP]},
        exact_costs=model.exact_costs,
        treat_actionless_as_dead_ends=True,
        normalise=True,
    )
    return ModelFile(made, (START,))


def _steps_of_chain(chain: Chain, first: int, end: int) -> _Rows:
    """The steps of one member's chain while the goal is in reach, the last of them giving up."""
    hopeful = reaching_in_chain(chain, chain.goal > 0.0)
    quits = np.flatnonzero((chain.give_up > 0.0) & hopeful)
    moves = np.flatnonzero(hopeful[chain.source])
    return (
        np.concatenate([chain.source[moves], quits]) + first,
        np.concatenate([chain.target[moves] + first, np.full(quits.size, end)]),
        np.concatenate([chain.probability[moves], chain.give_up[quits]]),
        np.concatenate([chain.cost[moves], np.zeros(quits.size)]),
    )


@explained
def write_dot(
    policy: Policy | MixedPolicy,
    path: str | PathLike[str],
    start: Hashable | Mapping[Hashable, float],
    *,
    most_nodes: int = _MOST_NODES,
) -> None:
    """Write what a policy does from a start as a graph: ``dot -Tsvg FILE`` draws it.

    A node is a state with what is remembered, and the action taken there (with its probability, if
    it is drawn); an edge is a step with its probability. Goals have two rings, dead-ends and giving
    up a box. The members of a lottery stand side by side.

    Args:
        policy: any policy of the library.
        path: of the file, ``policy.dot``.
        start: a state, or ``{state: probability}``.
        most_nodes: refuse more nodes than this.

    Raises:
        ModelError: there are more nodes, the policy has no decision in a state that it reaches, or
            is of a class whose memory is not known.
    """
    lottery, chains = _member_chains(policy, start)
    count = sum(chain.n_nodes for chain in chains)
    if count > most_nodes:
        raise ModelError(f"the policy's chain has {count:,} nodes, more than {most_nodes:,}")
    lines = ["digraph policy {", "  rankdir=LR;", "  node [shape=ellipse];"]
    for k, (member, chain) in enumerate(zip(lottery.policies, chains, strict=True)):
        lines.append(f"  subgraph cluster_{k} {{")
        if len(chains) > 1:
            lines.append(f"    label={_dot_text(f'with probability {lottery.weights[k]:.6g}')};")
        lines += [f"    {line}" for line in _dot_nodes(member, chain, k)]
        steps = chain.matrix.tocoo()
        for source, target, chance in zip(steps.row, steps.col, steps.data, strict=True):
            if chance > 0.0:
                share = _dot_text(f"{chance:.6g}")
                lines.append(f"    n{k}_{source} -> n{k}_{target} [label={share}];")
        lines.append("  }")
    Path(path).write_text("\n".join([*lines, "}", ""]), encoding="utf-8")


def _dot_nodes(policy: Policy, chain: Chain, member: int) -> Iterator[str]:
    """The nodes of the graph, as lines of dot."""
    model, told = chain.model, dict(memories_of(policy))
    actions = defaultdict(list)
    branches = zip(chain.branch_node, chain.branch_pair, chain.branch_probability, strict=True)
    for node, pair, probability in branches:
        action = "give up" if pair == GIVE_UP_CODE else f"{model.action_of(int(pair))}"
        share = "" if probability == 1.0 else f" {probability:.6g}"
        actions[int(node)].append(f"{action}{share}")
    for node in range(chain.n_nodes):
        memory = told.get(int(chain.memory[node]))
        goal, dead = chain.goal[node] > 0.0, chain.dead[node] > 0.0
        name = f"{model.states[int(chain.state[node])]}"
        if memory is not None and not (goal or dead):
            name += f" | {memory}"
        boxed = dead or chain.give_up[node] == 1.0
        shape = ", shape=box" if boxed else ", shape=doublecircle" if goal else ""
        if chain.start[node] > 0.0:
            shape += ", penwidth=2"
        yield f"n{member}_{node} [label={_dot_text(chr(10).join([name, *actions[node]]))}{shape}];"


def _dot_text(text: str) -> str:
    """A text in quotation marks, as dot reads it."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'


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
    process, (chain,) = exported(policy.model, start), _member_chains(policy, start)[1]
    acting = chain.memory[~_ended(chain)]
    if np.unique(acting).size <= 1 and not (chain.give_up > 0.0).any():
        memory = int(members[0].start_memory(chain.state[chain.start > 0.0])[0])
        entries = _decisions_without_memory(members[0], memory, process)
    else:
        entries = _Scheduler(chain, process).entries()
    text = ",\n".join(json.dumps(entry, indent=4, sort_keys=True) for entry in entries)
    write_text(path, [f"[\n{text}\n]\n"])


def _choice_entry(process: Exported, index: int, probability: float) -> dict[str, Any]:
    """A choice of the scheduler, in Storm's words."""
    return {"index": index, "labels": [process.actions[index]], "prob": probability}


def _decisions_without_memory(
    policy: Policy, memory: int, process: Exported
) -> Iterator[dict[str, Any]]:
    """An entry for each state of the file."""
    acting = np.flatnonzero(np.diff(policy.model.pair_offsets))
    branches = policy.branches(acting, np.full(acting.size, memory))
    chosen: dict[int, list[dict[str, Any]]] = {state: [] for state in acting.tolist()}
    for situation, pair, chance in zip(*(part.tolist() for part in branches), strict=True):
        if pair >= 0 and chance > 0.0:
            index = int(process.choice_of_pair[pair])
            chosen[int(acting[situation])].append(_choice_entry(process, index, chance))
    for state, first in enumerate(process.pair_offsets[:-1].tolist()):
        choices = chosen.get(state, [_choice_entry(process, first, 1.0)])
        yield {"s": state, "c": choices or "undefined"}


def _ended(chain: Chain) -> Any:
    """Which nodes are goals or dead-ends, [nodes]."""
    return chain.model.goal_mask[chain.state] | (chain.dead > 0.0)


class _Scheduler:
    """What a policy with a memory does on the states of a file. Grows.

    ``choices`` are in each state of the file and memory the choices, each with its probability and
    the memory after each successor.
    """

    def __init__(self, chain: Chain, process: Exported) -> None:
        self._process, self._model = process, chain.model
        self._staying = attention_pairs(chain.model, attention_states(chain.model))
        self._choices: dict[tuple[int, int], dict[int, tuple[float, dict[int, int]]]] = {}
        start = int(chain.memory[int(np.argmax(chain.start))])
        codes = [start, *sorted(set(chain.memory.tolist()) - {start})]
        numbers = {code: k for k, code in enumerate(codes)}
        self._given_up = len(codes)  # the memory of having given up
        memory = [numbers[code] for code in chain.memory.tolist()]
        nodes: list[tuple[int, int]] = list(zip(chain.state.tolist(), memory, strict=True))
        moves: dict[tuple[int, int], dict[int, int]] = {}  # by node and pair
        pairs = np.searchsorted(self._model.outcome_offsets, chain.outcome, side="right") - 1
        steps = chain.source, pairs, chain.outcome, chain.target
        for node, pair, outcome, target in zip(*(part.tolist() for part in steps), strict=True):
            moves.setdefault((node, pair), {})[outcome] = memory[target]
        for node in np.flatnonzero(_ended(chain)).tolist():
            self._end(*nodes[node])
        branches = chain.branch_node, chain.branch_pair, chain.branch_probability
        quits: dict[int, float] = {}
        for node, pair, chance in zip(*(part.tolist() for part in branches), strict=True):
            if pair == GIVE_UP_CODE and chance > 0.0:
                quits[node] = chance
            elif chance > 0.0:
                self._take(nodes[node], pair, chance, moves[node, pair])
        for node, chance in quits.items():  # by actions that are not taken otherwise
            self._quit(*nodes[node], chance)

    def entries(self) -> Iterator[dict[str, Any]]:
        """An entry for each state and memory that is reached."""
        for (state, memory), choices in sorted(self._choices.items()):
            entry: dict[str, Any] = {"s": state, "m": memory, "c": []}
            for index, (chance, after) in sorted(choices.items()):
                updates = [{"s'": successor, "m'": after[successor]} for successor in sorted(after)]
                choice = _choice_entry(self._process, index, chance)
                entry["c"].append(choice | {"memory-updates": updates})
            yield entry

    def _take(self, at: tuple[int, int], pair: int, chance: float, after: dict[int, int]) -> None:
        """Take a pair; states that pay keep the memory until they have paid."""
        process, updates = self._process, dict[int, int]()
        for outcome, then in after.items():
            target = int(process.target_of_outcome[outcome])
            updates[target] = then
            if target >= self._model.n_states:
                pay = int(process.pair_offsets[target])
                follower = int(process.successors[process.outcome_offsets[pay]])
                self._choices[target, then] = {pay: (1.0, {follower: then})}
        choices = self._choices.setdefault(at, {})
        choices[int(process.choice_of_pair[pair])] = chance, updates

    def _end(self, state: int, memory: int) -> None:
        """Stay where nothing happens any more; a dead-end that has actions is left to them."""
        if self._model.pair_offsets[state] < self._model.pair_offsets[state + 1]:
            self._quit(state, memory, 1.0)
            return
        index = int(self._process.pair_offsets[state])
        self._choices[state, memory] = {index: (1.0, {state: memory})}

    def _quit(self, state: int, memory: int, chance: float) -> None:
        """Give up: from here on avoid the goal."""
        queue, waiting = [(state, memory, chance)], set[int]()
        while queue:
            here, code, share = queue.pop()
            pair = self._avoiding(here, code)
            begin, end = self._model.outcome_offsets[pair : pair + 2].tolist()
            occurs = [k for k in range(begin, end) if self._model.probabilities[k] > 0.0]
            self._take((here, code), pair, share, dict.fromkeys(occurs, self._given_up))
            for there in {int(self._model.successors[k]) for k in occurs}:
                if (there, self._given_up) in self._choices or there in waiting:
                    continue
                waiting.add(there)
                if self._model.pair_offsets[there] < self._model.pair_offsets[there + 1]:
                    queue.append((there, self._given_up, 1.0))
                else:
                    self._end(there, self._given_up)

    def _avoiding(self, state: int, memory: int) -> int:
        """A pair that surely avoids the goal and is not taken for another reason."""
        taken = self._choices.get((state, memory), {})
        for pair in range(*self._model.pair_offsets[state : state + 2].tolist()):
            if self._staying[pair] and int(self._process.choice_of_pair[pair]) not in taken:
                return pair
        raise ModelError(
            f"the policy gives up in state {self._model.states[state]!r}, where every action that "
            "it does not take otherwise may lead to the goal: a scheduler cannot say so, "
            "induced_chain(policy, start) can"
        )
