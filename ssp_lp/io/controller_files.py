"""Files that ``ssp_lp/io/controller.py`` runs without any other part of the library."""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray, segment_ids
from ssp_lp.errors import ModelError
from ssp_lp.io.controller import GIVE_UP as GIVE_UP_WORD, controller_checksum
from ssp_lp.io.model_files.raw_model import FilePath
from ssp_lp.io.model_fingerprint import are_numbers_in_turn, fingerprint, label_value
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import dead_ends
from ssp_lp.model.product import HorizonSSP, ProductSSP
from ssp_lp.policies import CostAwarePolicy, DeterministicPolicy, MixedPolicy, StochasticPolicy
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Policy, as_lottery
from ssp_lp.policies.remembering import JointMemory, RememberingPolicy, memory_size

_VERSION = 1


@explained
def write_controller(policy: Policy | MixedPolicy, path: FilePath) -> None:
    """Write a policy as a JSON file that :class:`ssp_lp.io.Controller` runs.

    That class stands in one file of its own, ``ssp_lp/io/controller.py``, which imports nothing but
    the standard library and says what the file holds.

    Args:
        policy: deterministic, stochastic, cost-aware, of a problem with a horizon or on a product
            with a memory (``on_original``), or a lottery over these.
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
    told = {
        "format": "ssp-lp controller",
        "version": _VERSION,
        "model": fingerprint(model),
        "states": model.n_states
        if are_numbers_in_turn(model.states)
        else [label_value(label) for label in model.states],
        "actions": [label_value(label) for label in model.action_names],
        "ends": np.flatnonzero(model.goal_mask | dead_ends(model)).tolist(),
        "members": [
            {
                "weight": weight,
                "memory": _controller_memory(member, codes),
                "decision": _controller_decisions(member, codes),
            }
            for member, weight in zip(lottery.policies, lottery.weights.tolist(), strict=True)
        ],
    }
    told["checksum"] = controller_checksum(told)
    text = json.dumps(told, separators=(",", ":"), allow_nan=False)
    Path(path).write_text(text + "\n", encoding="utf-8")


def _controller_memory(policy: Policy, codes: Mapping[Hashable, int]) -> dict[str, Any] | None:
    """What the policy remembers, as the controller reads it.

    Raises:
        ModelError: the controller does not know such a memory.
    """
    match policy:
        case DeterministicPolicy() | StochasticPolicy(carrier=None):
            return None
        case StochasticPolicy(carrier=Policy() as carrier):
            return _controller_memory(carrier, codes)
        case JointMemory(keepers=(keeper,)):
            return _controller_memory(keeper, codes)
        case RememberingPolicy(inner=inner, product=product):
            place = {"place": product.table.T.tolist(), "inner": _controller_memory(inner, codes)}
            return _controller_numbers(product, codes) | place
        case CostAwarePolicy():
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
    """How the number of a product's memory goes on, for the controller's file."""
    if isinstance(product, HorizonSSP):
        acting = np.diff(product.original.pair_offsets) > 0
        return {"kind": "steps", "steps": product.steps, "acting": acting.astype(int).tolist()}
    known, numbers = product.table >= 0, np.empty(product.n_states, dtype=np.int64)
    numbers[product.table[known]] = np.nonzero(known)[1]
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


def _controller_decisions(policy: Policy, codes: Mapping[Hashable, int]) -> list[list[Any]]:
    """What the policy does, [memories][states], of the innermost memory and its states."""
    over = np.zeros(policy.model.n_states, dtype=np.bool_)
    while isinstance(policy, RememberingPolicy):
        product, policy = policy.product, policy.inner
        idle = (np.diff(product.pair_offsets) == 0) & ~product.goal_mask
        over = idle | np.where(dead_ends(product), True, over[product.original_state])
    states, actions = np.arange(policy.model.n_states), policy.model.action_names
    code = np.array([codes[name] for name in actions] or [0])
    return [
        _controller_decisions_at(policy, np.full(states.size, memory, dtype=np.int64), code, over)
        for memory in range(memory_size(policy))
    ]


def _controller_decisions_at(
    policy: Policy, memory: Any, code: IntArray, over: BoolArray
) -> list[Any]:
    """What the policy does in each state; it gives up where it has no decision and all is over."""
    model = policy.model
    found = policy.branches(np.arange(model.n_states), memory)
    action = np.append(code[model.pair_action], 0)  # of a model without pairs, too
    codes = np.where(found.pair < 0, found.pair, action[np.maximum(found.pair, 0)])
    codes = np.where(over[found.situation] & (codes == UNDECIDED), GIVE_UP_CODE, codes)
    if len(codes) == model.n_states:
        plain: list[Any] = codes.tolist()
        return plain
    choices: list[list[list[Any]]] = [[] for _ in range(model.n_states)]
    branches = zip(
        found.situation.tolist(), codes.tolist(), found.probability.tolist(), strict=True
    )
    for state, choice, share in branches:
        choices[state].append([choice, share])
    return [choice[0][0] if len(choice) == 1 else choice for choice in choices]
