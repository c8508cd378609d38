"""Files of policies for :class:`ssp_lp.io.Controller`, which runs them."""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ssp_lp import policies
from ssp_lp.arrays import IntArray, segment_ids
from ssp_lp.errors import ModelError
from ssp_lp.io.archives import are_numbers_in_turn, fingerprint, label_value
from ssp_lp.io.controller import GIVE_UP as GIVE_UP_WORD, controller_checksum
from ssp_lp.io.model_files.raw_model import FilePath
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.failure_product import FailureSSP
from ssp_lp.model.graph import dead_ends
from ssp_lp.model.product import HorizonSSP, ProductSSP
from ssp_lp.policies import MixedPolicy, Policy, StochasticPolicy
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, as_lottery
from ssp_lp.policies.remembering import (
    CompletePolicy,
    LabelledPolicy,
    RememberingPolicy,
)

_VERSION = 1


@explained
def write_controller(policy: Policy | MixedPolicy, path: FilePath) -> None:
    """Write a policy as a JSON file that :class:`ssp_lp.io.Controller` runs.

    That class is in a single file, ``ssp_lp/io/controller.py``, which imports only the standard
    library and documents the format.

    Args:
        policy: deterministic, stochastic, cost-aware, of a problem with a horizon or on a product
            with a memory (``on_original``), one that remembers having failed, one that acts
            everywhere (``Solution.policy_everywhere``), or a lottery over these.
        path: name of the file, ``controller.json``.

    Raises:
        ModelError: the policy is of another class, a label is not str, int, float, bool, None or a
            tuple of these, or an action is called "give up".
    """
    lottery = as_lottery(policy)
    model = lottery.model
    if GIVE_UP_WORD in model.action_names:
        raise ModelError(f"an action is called {GIVE_UP_WORD!r}, a reserved word: rename it")
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
            {"weight": weight, **controller_member(member)}
            for member, weight in zip(lottery.policies, lottery.weights.tolist(), strict=True)
        ],
    }
    content["checksum"] = controller_checksum(content)
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    Path(path).write_text(text + "\n", encoding="utf-8")


def controller_member(policy: Policy) -> dict[str, Any]:
    """Return a policy as a member of a lottery in a controller's file.

    Raises:
        ModelError: the controller does not support its memory.
    """
    codes = {name: k for k, name in enumerate(policy.model.action_names)}
    inner = policy.inner if isinstance(policy, CompletePolicy) else policy
    stated = {
        "memory": _controller_memory(inner, codes),
        "decision": _controller_decisions(inner, codes),
        "ends": np.flatnonzero(inner.ended).tolist(),
    }
    if isinstance(policy, CompletePolicy):
        for name, pairs in (("otherwise", policy.otherwise), ("afterwards", policy.afterwards)):
            stated[name] = _positions(policy.model, codes, pairs).tolist()
    return stated


def _positions(model: SSP, codes: Mapping[Hashable, int], pairs: IntArray) -> IntArray:
    """Return the number in the file of each pair's action; negative codes stay unchanged.

    ``codes`` maps the label of an action to its number in the file.
    """
    action = np.array([codes[name] for name in model.action_names] or [0])
    action = np.append(action[model.pair_action], 0)  # of a model without pairs, too
    return np.where(pairs < 0, pairs, action[np.maximum(pairs, 0)])


def _controller_memory(policy: Policy, codes: Mapping[Hashable, int]) -> dict[str, Any] | None:
    """Return the memory of a policy as a controller's file describes it.

    Raises:
        ModelError: the controller does not support such a memory.
    """
    match policy:
        case policies.DeterministicPolicy() | StochasticPolicy(carrier=None):
            return None
        case StochasticPolicy(carrier=Policy() as carrier):
            return _controller_memory(carrier, codes)
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
                "levels": None if policy.levels is None else policy.levels.tolist(),
                "acting": (policy.tails[0] != UNDECIDED).astype(np.int64).tolist(),
            }
    raise ModelError(f"a controller cannot run a {type(policy).__name__}")


def _controller_numbers(product: ProductSSP, codes: Mapping[Hashable, int]) -> dict[str, Any]:
    """Return the entries of a controller's file that say how steps change a product's memory."""
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
        if after.setdefault(tuple(step), {}).setdefault(cost, then) != then:
            told = f"a step to state {product.original.states[step[3]]!r} at cost {cost:g}"
            raise ModelError(f"a controller cannot know the policy's memory after {told}: "
                             "give the outcomes different successors or costs")  # fmt: skip
    moves: list[list[Any]] = []
    for step, by_cost in after.items():
        if len(ends := set(by_cost.values())) > 1:
            moves += [[*step, cost, then] for cost, then in by_cost.items()]
        elif ends != {step[0]}:
            moves.append([*step, None, *ends])
    states = np.arange(product.original.n_states)
    first = product.first_memory(states)
    begun = np.unique(first[product.table[states, first] >= 0]).tolist()
    if len(begun) > 1:
        raise ModelError("the memory begins differently in several starts: use one start")
    return {"kind": "task", "start": begun[0], "moves": moves}


def _labelled_codes(product: FailureSSP, codes: Mapping[Hashable, int]) -> dict[Hashable, int]:
    """Return the number of each action of a product with the failure label.

    With n actions, the number of action k is k, and n + k if it is taken with giving up.
    """
    names = product.original.action_names
    giving_up = zip(product.action_names[len(names) :], names, strict=True)
    return {**codes, **{name: len(codes) + codes[own] for name, own in giving_up}}


def _controller_decisions(policy: Policy, codes: Mapping[Hashable, int]) -> list[list[Any]]:
    """Return a policy's decisions for each value of its innermost memory, then for each state."""
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
    decisions = []
    for memory in range(policy.memory_size or 1):
        branches = policy.branches(np.arange(model.n_states), np.full(model.n_states, memory))
        choice = _positions(model, codes, branches.pair)
        # giving up where it has no decision and all is over
        choice = np.where(over[branches.situation] & (choice == UNDECIDED), GIVE_UP_CODE, choice)
        if len(choice) == model.n_states:  # no random decisions
            decisions.append(choice.tolist())
            continue
        listed: list[list[list[Any]]] = [[] for _ in range(model.n_states)]
        columns = branches.situation, choice, branches.probability
        for state, code, share in zip(*(column.tolist() for column in columns), strict=True):
            listed[state].append([code, share])
        decisions.append([some[0][0] if len(some) == 1 else some for some in listed])
    return decisions
