"""Files that ``ssp_lp/io/controller.py`` runs without any other part of the library."""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError
from ssp_lp.io.archives.labels import are_numbers_in_turn, label_value
from ssp_lp.io.controller import GIVE_UP as GIVE_UP_WORD
from ssp_lp.io.model_fingerprint import fingerprint
from ssp_lp.policies import CostAwarePolicy, DeterministicPolicy, MixedPolicy, StochasticPolicy
from ssp_lp.policies.joint_memory import JointMemory
from ssp_lp.policies.mixed import as_lottery
from ssp_lp.policies.policy import UNDECIDED, Policy

_VERSION = 1


def write_controller(policy: Policy | MixedPolicy, path: str | PathLike[str]) -> None:
    """Write a policy as a JSON file that :class:`ssp_lp.io.Controller` runs.

    That class stands in one file of its own, ``ssp_lp/io/controller.py``, which imports nothing but
    the standard library and says what the file holds.

    Args:
        policy: deterministic, stochastic, cost-aware, or a lottery over these.
        path: of the file, ``controller.json``.

    Raises:
        ModelError: the policy is of another class, or a label is no str, int, float, bool, None or
            tuple of them, or an action is called "give up".
    """
    lottery = as_lottery(policy)
    model = lottery.model
    if GIVE_UP_WORD in model.action_names:
        raise ModelError(f"an action is called {GIVE_UP_WORD!r}, which says that a policy gives up")
    told = {
        "format": "ssp-lp controller",
        "version": _VERSION,
        "model": fingerprint(model),
        "states": model.n_states
        if are_numbers_in_turn(model.states)
        else [label_value(label) for label in model.states],
        "actions": [label_value(label) for label in model.action_names],
        "members": [
            {"weight": weight, "memory": _memory(member), "decision": _decisions(member)}
            for member, weight in zip(lottery.policies, lottery.weights.tolist(), strict=True)
        ],
    }
    text = json.dumps(told, separators=(",", ":"), allow_nan=False)
    Path(path).write_text(text + "\n", encoding="utf-8")


def _memory(policy: Policy) -> dict[str, Any] | None:
    """What the policy remembers, as the controller reads it.

    Raises:
        ModelError: the controller does not know such a memory.
    """
    match policy:
        case DeterministicPolicy() | StochasticPolicy(carrier=None):
            return None
        case StochasticPolicy(carrier=Policy() as carrier):
            return _memory(carrier)
        case JointMemory(keepers=(keeper,)):
            return _memory(keeper)
        case CostAwarePolicy():
            table = policy.tail_table
            return {
                "kind": "layers",
                "unit": float(policy.unit),
                "rounds_up": bool(policy.rounds_up),
                "cap": policy.cap,
                "tails": len(policy.tails),
                "threshold": _thresholds(policy.tail_threshold),
                "table": None if table is None else table.tolist(),
                "levels": None if policy.levels is None else policy.levels.tolist(),
                "acting": (policy.tails[0] != UNDECIDED).astype(np.int64).tolist(),
            }
    raise ModelError(f"a controller cannot run a {type(policy).__name__}")


def _thresholds(layers: FloatArray) -> list[float | None]:
    """First layer of the last tail in each state; None for never, 0 for always."""
    return [max(layer, 0.0) if layer < np.inf else None for layer in layers.tolist()]


def _decisions(policy: Policy) -> list[list[Any]]:
    """What the policy does, [memories][states]."""
    states = np.arange(policy.model.n_states)
    return [
        _decisions_at(policy, np.full(states.size, memory, dtype=np.int64))
        for memory in range(_memory_count(policy))
    ]


def _decisions_at(policy: Policy, memory: Any) -> list[Any]:
    model = policy.model
    found = policy.branches(np.arange(model.n_states), memory)
    action = np.append(model.pair_action, 0)  # of a model without pairs, too
    codes = np.where(found.pair < 0, found.pair, action[np.maximum(found.pair, 0)])
    if len(codes) == model.n_states:
        plain: list[Any] = codes.tolist()
        return plain
    choices: list[list[list[Any]]] = [[] for _ in range(model.n_states)]
    branches = zip(
        found.situation.tolist(), codes.tolist(), found.probability.tolist(), strict=True
    )
    for state, code, share in branches:
        choices[state].append([code, share])
    return [choice[0][0] if len(choice) == 1 else choice for choice in choices]


def _memory_count(policy: Policy) -> int:
    match policy:
        case StochasticPolicy(carrier=Policy() as carrier):
            return _memory_count(carrier)
        case JointMemory(keepers=(keeper,)):
            return _memory_count(keeper)
        case CostAwarePolicy():
            return policy.cap + len(policy.tails)
    return 1
