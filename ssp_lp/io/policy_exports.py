"""Policies for other tools: as tables, chains, graphs, schedulers and controllers."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ssp_lp import policies
from ssp_lp.arrays import segment_ids
from ssp_lp.errors import ModelError
from ssp_lp.io.archives import are_numbers_in_turn, fingerprint, label_value
from ssp_lp.io.controller import GIVE_UP as GIVE_UP_WORD, controller_checksum
from ssp_lp.io.model_files.raw_model import (
    GOAL,
    Exported,
    FilePath,
    ModelFile,
    exported,
    write_text,
)
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.failure_product import FailureSSP
from ssp_lp.model.graph import attention_pairs, attention_states, dead_ends
from ssp_lp.model.product import HorizonSSP, ProductSSP
from ssp_lp.policies import MixedPolicy, Policy, StochasticPolicy
from ssp_lp.policies.chain import Chain, policy_chain
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, as_lottery
from ssp_lp.policies.remembering import (
    CompletePolicy,
    JointMemory,
    LabelledPolicy,
    RememberingPolicy,
    memory_size,
)
from ssp_lp.processes.failure_semantics import start_distribution

START, GAVE_UP = "start", "gave up"
"""States of the chain besides those of the policy: where its lottery is drawn, and its end."""

_MOST_NODES = 300
"""More than this no picture shows; Graphviz would take minutes, too."""


def _member_chains(
    policy: Policy | MixedPolicy, start: Hashable | Mapping[Hashable, float]
) -> tuple[MixedPolicy, list[Chain]]:
    """A policy to be exported as a lottery, and the chain of each member."""
    lottery = as_lottery(policy)
    begin = start_distribution(lottery.model, start)
    return lottery, [policy_chain(lottery.model, member, begin) for member in lottery.policies]


@explained
def induced_chain(
    policy: Policy | MixedPolicy, start: Hashable | Mapping[Hashable, float]
) -> ModelFile:
    """Export a policy's Markov chain, whatever its memory, as a model with one action.

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
    model, drawn = lottery.model, list[tuple[float, Hashable, float]]()
    transitions: dict[Hashable, Any] = {}
    goals: list[Hashable] = []
    labels: dict[str, list[Hashable]] = {name: [] for name in model.state_labels}
    for k, (chain, weight) in enumerate(zip(chains, lottery.weights.tolist(), strict=True)):
        nodes = zip(chain.state.tolist(), chain.memory.tolist(), strict=True)
        named = [(model.states[state], memory) for state, memory in nodes]
        names: list[Hashable] = [*named] if len(chains) == 1 else [(k, *name) for name in named]
        transitions |= {name: {} for name in names}
        goals += [names[node] for node in np.flatnonzero(model.goal_mask[chain.state])]
        for label, members in model.state_labels.items():
            labels[label] += [names[node] for node in np.flatnonzero(np.isin(chain.state, members))]
        begun = np.flatnonzero(chain.start > 0.0)
        drawn += [(weight * float(chain.start[node]), names[node], 0.0) for node in begun]
        # the steps while the goal is in reach, the last of them giving up
        hopeful = chain.reaching(chain.goal > 0.0)
        steps = chain.source, chain.target, chain.probability, chain.cost
        for node, to, chance, cost in zip(*(part.tolist() for part in steps), strict=True):
            if hopeful[node]:
                paid = model.exact_costs.get(cost, cost)
                transitions[names[node]].setdefault(0, []).append((chance, names[to], paid))
        for node in np.flatnonzero((chain.give_up > 0.0) & hopeful).tolist():
            quits = (float(chain.give_up[node]), GAVE_UP, 0.0)
            transitions[names[node]].setdefault(0, []).append(quits)
    made = SSP.from_transitions(
        {**transitions, START: {0: drawn}, GAVE_UP: {}},
        goals or [GOAL],  # a model has a goal, though this one is not reached
        state_labels=labels | {GAVE_UP: [GAVE_UP]},
        treat_actionless_as_dead_ends=True,
        normalise=True,
    )
    return ModelFile(made, (START,))


@explained
def write_dot(
    policy: Policy | MixedPolicy,
    path: str | PathLike[str],
    start: Hashable | Mapping[Hashable, float],
    *,
    most_nodes: int = _MOST_NODES,
) -> None:
    """Export a policy from a start as a graph: ``dot -Tsvg FILE`` draws it.

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
            lines.append(f'    label="with probability {lottery.weights[k]:.6g}";')
        lines += [f"    {line}" for line in _dot_nodes(member, chain, k)]
        steps = chain.matrix.tocoo()
        for source, target, chance in zip(steps.row, steps.col, steps.data, strict=True):
            if chance > 0.0:
                lines.append(f'    n{k}_{source} -> n{k}_{target} [label="{chance:.6g}"];')
        lines.append("  }")
    Path(path).write_text("\n".join([*lines, "}", ""]), encoding="utf-8")


def _dot_nodes(policy: Policy, chain: Chain, member: int) -> Iterator[str]:
    """Nodes of an exported policy's graph, as lines of dot."""
    model, memories = chain.model, dict(policy.memories())
    actions = defaultdict(list)
    branches = zip(chain.branch_node, chain.branch_pair, chain.branch_probability, strict=True)
    for node, pair, probability in branches:
        action = "give up" if pair == GIVE_UP_CODE else f"{model.action_of(int(pair))}"
        share = "" if probability == 1.0 else f" {probability:.6g}"
        actions[int(node)].append(f"{action}{share}")
    for node in range(chain.n_nodes):
        memory = memories.get(int(chain.memory[node]))
        goal, dead = chain.goal[node] > 0.0, chain.dead[node] > 0.0
        silent = memory is None or goal or dead
        name = f"{model.states[int(chain.state[node])]}{'' if silent else f' | {memory}'}"
        boxed = dead or chain.give_up[node] == 1.0
        shape = ", shape=box" if boxed else ", shape=doublecircle" if goal else ""
        width = ", penwidth=2" if chain.start[node] > 0.0 else ""
        label = json.dumps("\n".join([name, *actions[node]]), ensure_ascii=False)
        yield f"n{member}_{node} [label={label}{shape}{width}];"


@explained
def write_scheduler(policy: Policy | MixedPolicy, path: FilePath, *, start: Hashable) -> None:
    """Export a policy as a scheduler, as JSON of the form that Storm writes.

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
    """A choice of an exported scheduler, in Storm's words."""
    return {"index": index, "labels": [process.actions[index]], "prob": probability}


def _decisions_without_memory(
    policy: Policy, memory: int, process: Exported
) -> Iterator[dict[str, Any]]:
    """Entries of an exported scheduler without memory, one for each state."""
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
    """Nodes of an exported policy that are goals or dead-ends, [nodes]."""
    return chain.model.goal_mask[chain.state] | (chain.dead > 0.0)


class _Scheduler:
    """A scheduler for a policy with a memory on the states of a file. Grows.

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
        """Entries of the exported scheduler for each state and memory that is reached."""
        for (state, memory), choices in sorted(self._choices.items()):
            entry: dict[str, Any] = {"s": state, "m": memory, "c": []}
            for index, (chance, after) in sorted(choices.items()):
                updates = [{"s'": successor, "m'": after[successor]} for successor in sorted(after)]
                choice = _choice_entry(self._process, index, chance)
                entry["c"].append(choice | {"memory-updates": updates})
            yield entry

    def _take(self, at: tuple[int, int], pair: int, chance: float, after: dict[int, int]) -> None:
        """Take a pair in an exported scheduler; states that pay keep the memory until they have."""
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
        """Entry of an exported scheduler where an episode is over; a dead-end keeps its actions."""
        if self._model.pair_offsets[state] < self._model.pair_offsets[state + 1]:
            self._quit(state, memory, 1.0)
            return
        index = int(self._process.pair_offsets[state])
        self._choices[state, memory] = {index: (1.0, {state: memory})}

    def _quit(self, state: int, memory: int, chance: float) -> None:
        """Give up in an exported scheduler: from here on avoid the goal."""
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
        """A pair in an exported scheduler that surely avoids the goal and is free to be taken."""
        taken = self._choices.get((state, memory), {})
        for pair in range(*self._model.pair_offsets[state : state + 2].tolist()):
            if self._staying[pair] and int(self._process.choice_of_pair[pair]) not in taken:
                return pair
        raise ModelError(
            f"the policy gives up in state {self._model.states[state]!r}, where every action that "
            "it does not take otherwise may lead to the goal: a scheduler cannot say so, "
            "induced_chain(policy, start) can"
        )


_VERSION = 1


@explained
def write_controller(policy: Policy | MixedPolicy, path: FilePath) -> None:
    """Write a policy as a JSON file that :class:`ssp_lp.io.Controller` runs.

    That class stands in one file of its own, ``ssp_lp/io/controller.py``, which imports nothing but
    the standard library and says what the file holds.

    Args:
        policy: deterministic, stochastic, cost-aware, of a problem with a horizon or on a product
            with a memory (``on_original``), one that remembers having failed, one that acts
            everywhere (``Solution.policy_everywhere``), or a lottery over these.
        path: of the file, ``controller.json``.

    Raises:
        ModelError: the policy is of another class, or a label is no str, int, float, bool, None or
            tuple of them, or an action is called "give up".
    """
    lottery = as_lottery(policy)
    model = lottery.model
    if GIVE_UP_WORD in model.action_names:
        raise ModelError(f"an action is called {GIVE_UP_WORD!r}, which says that a policy gives up")
    codes = {name: k for k, name in enumerate(model.action_names)}
    content = {
        "format": "ssp-lp controller",
        "version": _VERSION,
        "model": fingerprint(model),
        "states": model.n_states
        if are_numbers_in_turn(model.states)
        else [label_value(label) for label in model.states],
        "actions": [label_value(label) for label in model.action_names],
        "goals": np.flatnonzero(model.goal_mask).tolist(),
        "dead_ends": np.flatnonzero(dead_ends(model)).tolist(),
        "members": [
            {"weight": weight, **_controller_member(member, codes)}
            for member, weight in zip(lottery.policies, lottery.weights.tolist(), strict=True)
        ],
    }
    content["checksum"] = controller_checksum(content)
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    Path(path).write_text(text + "\n", encoding="utf-8")


def _controller_member(policy: Policy, codes: Mapping[Hashable, int]) -> dict[str, Any]:
    """A member of a lottery, as the controller reads it."""
    if isinstance(policy, CompletePolicy):
        action = np.array([codes[name] for name in policy.model.action_names], dtype=np.int64)
        action = np.append(action[policy.model.pair_action], 0)  # of a model without pairs, too
        chosen = {
            name: np.where(pairs < 0, pairs, action[np.maximum(pairs, 0)]).tolist()
            for name, pairs in (("otherwise", policy.otherwise), ("afterwards", policy.afterwards))
        }
        return _controller_member(policy.inner, codes) | chosen
    return {
        "memory": _controller_memory(policy, codes),
        "decision": _controller_decisions(policy, codes),
        "ends": np.flatnonzero(policy.ended).tolist(),
    }


def _controller_memory(policy: Policy, codes: Mapping[Hashable, int]) -> dict[str, Any] | None:
    """An exported policy's memory as the controller reads it.

    Raises:
        ModelError: the controller does not know such a memory.
    """
    match policy:
        case policies.DeterministicPolicy() | StochasticPolicy(carrier=None):
            return None
        case StochasticPolicy(carrier=Policy() as carrier):
            return _controller_memory(carrier, codes)
        case JointMemory(keepers=(keeper,)):
            return _controller_memory(keeper, codes)
        case RememberingPolicy(inner=inner, product=product):
            place = {"place": product.table.T.tolist(), "inner": _controller_memory(inner, codes)}
            return _controller_numbers(product, codes) | place
        case LabelledPolicy(inner=inner, product=product):
            n, charged = product.n_original, np.zeros(product.n_original)
            failing = np.flatnonzero(product.fails)
            charge = product.costs[product.outcome_offsets[failing]]
            charged[product.original_state[product.pair_state[failing]]] = charge
            lost = dead_ends(product.original) & product.is_open
            return {
                "kind": "failing",
                "place": [list(range(n)), list(range(n, 2 * n))],
                "lost": np.flatnonzero(lost).tolist(),
                "charge": charged.tolist(),
                "inner": _controller_memory(inner, _labelled_codes(product, codes)),
            }
        case policies.CostAwarePolicy():
            table = policy.tail_table
            return {
                "kind": "layers",
                "unit": float(policy.unit),
                "rounds_up": bool(policy.rounds_up),
                "cap": policy.cap,
                "tails": len(policy.tails),
                "threshold": [  # None for never, 0 for always
                    max(layer, 0.0) if layer < np.inf else None
                    for layer in policy.tail_threshold.tolist()
                ],
                "table": None if table is None else table.tolist(),
                "levels": None if policy.levels is None else policy.levels.tolist(),
                "acting": (policy.tails[0] != UNDECIDED).astype(np.int64).tolist(),
            }
    raise ModelError(f"a controller cannot run a {type(policy).__name__}")


def _controller_numbers(product: ProductSSP, codes: Mapping[Hashable, int]) -> dict[str, Any]:
    """Transitions of an exported product's memory numbers, for the controller's file."""
    if isinstance(product, HorizonSSP):
        acting = np.diff(product.original.pair_offsets) > 0
        return {"kind": "steps", "steps": product.steps, "acting": acting.astype(int).tolist()}
    occurs, numbers = product.table >= 0, np.empty(product.n_states, dtype=np.int64)
    numbers[product.table[occurs]] = np.nonzero(occurs)[1]
    pairs = segment_ids(product.outcome_offsets)
    begin, end = numbers[product.pair_state[pairs]], numbers[product.successors]
    action = np.array([codes[name] for name in product.action_names])[product.pair_action[pairs]]
    here, there = product.original_state[product.pair_state[pairs]], product.original_state
    steps = np.column_stack([begin, here, action, there[product.successors]])
    after: dict[tuple[int, ...], dict[float, int]] = {}
    for step, cost, then in zip(steps.tolist(), product.costs.tolist(), end.tolist(), strict=True):
        after.setdefault(tuple(step), {})[cost] = then
    moves: list[list[Any]] = []
    for step, by_cost in after.items():
        if len(set(by_cost.values())) > 1:
            moves += [[*step, cost, then] for cost, then in by_cost.items()]
        elif (then := next(iter(by_cost.values()))) != step[0]:
            moves.append([*step, None, then])
    return {"kind": "task", "start": product.memory_number[product.memory.start], "moves": moves}


def _labelled_codes(product: FailureSSP, codes: Mapping[Hashable, int]) -> dict[Hashable, int]:
    """The numbers of a model's actions, and of those by which a run gives up, behind them."""
    names = product.original.action_names
    giving_up = zip(product.action_names[len(names) :], names, strict=True)
    return {**codes, **{name: len(codes) + codes[own] for name, own in giving_up}}


def _controller_decisions(policy: Policy, codes: Mapping[Hashable, int]) -> list[list[Any]]:
    """An exported policy's decisions, [memories][states], of its innermost memory."""
    over = np.zeros(policy.model.n_states, dtype=np.bool_)
    while isinstance(policy, RememberingPolicy | LabelledPolicy):
        product, policy = policy.product, policy.inner
        if (label := product.failure_label) is not None:
            codes = _labelled_codes(label, codes)
            over = over[label.original_state] | label.after | label.lost
            continue
        idle = (np.diff(product.pair_offsets) == 0) & ~product.goal_mask
        over = idle | np.where(dead_ends(product), True, over[product.original_state])
    model = policy.model
    action = np.array([codes[name] for name in model.action_names] or [0])
    action = np.append(action[model.pair_action], 0)  # of a model without pairs, too
    decisions = []
    for memory in range(memory_size(policy)):
        branches = policy.branches(np.arange(model.n_states), np.full(model.n_states, memory))
        choice = np.where(branches.pair < 0, branches.pair, action[np.maximum(branches.pair, 0)])
        # it gives up where it has no decision and all is over
        choice = np.where(over[branches.situation] & (choice == UNDECIDED), GIVE_UP_CODE, choice)
        listed: list[list[list[Any]]] = [[] for _ in range(model.n_states)]
        columns = branches.situation, choice, branches.probability
        for state, code, share in zip(*(column.tolist() for column in columns), strict=True):
            listed[state].append([code, share])
        decisions.append([some[0][0] if len(some) == 1 else some for some in listed])
    return decisions
