"""Policies as records: what each class is made of, as values of JSON and named arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ssp_lp.errors import ModelError
from ssp_lp.io.archives.archive import Array, ArrayStore
from ssp_lp.model import SSP
from ssp_lp.policies import (
    CostAwarePolicy,
    DeterministicPolicy,
    MixedPolicy,
    StochasticPolicy,
    TimedPolicy,
)
from ssp_lp.policies.joint_memory import JointMemory
from ssp_lp.policies.policy import Policy
from ssp_lp.policies.remembering import RememberingPolicy

AnyPolicy = Policy | MixedPolicy


@dataclass(frozen=True)
class _Kind:
    """What a class of policies is made of: the names of its fields, by what they hold."""

    made: type[AnyPolicy]
    on_model: bool = False  # whether the model is a field
    numbers: tuple[str, ...] = ()
    arrays: tuple[str, ...] = ()  # or None
    policies: tuple[str, ...] = ()  # or None
    lists: tuple[str, ...] = ()  # of policies


_KINDS: Mapping[str, _Kind] = {
    "deterministic": _Kind(DeterministicPolicy, on_model=True, arrays=("decision",)),
    "stochastic": _Kind(
        StochasticPolicy,
        on_model=True,
        arrays=("situation_key", "offsets", "pair", "probability"),
        policies=("carrier",),
    ),
    "cost aware": _Kind(
        CostAwarePolicy,
        on_model=True,
        numbers=("unit", "rounds_up"),
        arrays=("decision", "tails", "tail_threshold", "tail_table", "levels"),
    ),
    "timed": _Kind(TimedPolicy, lists=("stages",)),
    "mixed": _Kind(MixedPolicy, arrays=("weights",), lists=("policies",)),
    "remembering": _Kind(RememberingPolicy, policies=("inner",)),
    "joint memory": _Kind(JointMemory, policies=("decider",), lists=("keepers",)),
}

_NAME_OF = {kind.made: name for name, kind in _KINDS.items()}

SAVED_CLASSES = frozenset(_NAME_OF)
"""The classes of policies that a file can hold: all of ``ssp_lp/policies``."""


@dataclass
class PolicyRecords:
    """The records of a policy and of all that it is made of; parts stand before the whole."""

    store: ArrayStore
    records: list[dict[str, Any]] = field(default_factory=list)
    models: list[SSP] = field(default_factory=list)  # those that the parts live on
    _known: dict[int, int] = field(default_factory=dict)  # id of a policy -> its record

    def add(self, policy: AnyPolicy) -> int:
        """The number of a policy's record; a policy that occurs twice has one.

        Raises:
            ModelError: it, or a part of it, is of a class that no file can hold.
        """
        if id(policy) in self._known:
            return self._known[id(policy)]
        name = _NAME_OF.get(type(policy))
        if name is None:
            raise ModelError(f"a {type(policy).__name__} cannot be saved: its class is not known")
        kind, record = _KINDS[name], dict[str, Any](kind=name)
        for part in kind.numbers:
            record[part] = float(getattr(policy, part))
        for part in kind.arrays:
            array = getattr(policy, part)
            record[part] = None if array is None else self.store.add(array)
        for part in kind.policies:
            inner = getattr(policy, part)
            record[part] = None if inner is None else self.add(inner)
        for part in kind.lists:
            record[part] = [self.add(inner) for inner in getattr(policy, part)]
        if kind.on_model and not any(policy.model is model for model in self.models):
            self.models.append(policy.model)
        self.records.append(record)
        self._known[id(policy)] = len(self.records) - 1
        return self._known[id(policy)]

    def model(self) -> SSP:
        """The one model that all parts live on: a product, where a memory of it is carried.

        Raises:
            ModelError: there are several.
        """
        if len(self.models) != 1:
            raise ModelError("the parts of the policy live on several models: save each by itself")
        return self.models[0]


def made_of(
    records: list[dict[str, Any]], arrays: Mapping[str, Array], model: SSP
) -> list[AnyPolicy]:
    """The policies of :class:`PolicyRecords`, on a model.

    Raises:
        ModelError: the records do not fit the model.
    """
    made: list[AnyPolicy] = []
    for record in records:
        kind = _KINDS[record["kind"]]
        parts: dict[str, Any] = {"model": model} if kind.on_model else {}
        parts |= {part: record[part] for part in kind.numbers}
        parts |= {part: _found(arrays, record[part]) for part in kind.arrays}
        parts |= {part: _found(made, record[part]) for part in kind.policies}
        parts |= {part: tuple(made[k] for k in record[part]) for part in kind.lists}
        made.append(kind.made(**parts))
    return made


def _found(kept: Any, key: str | int | None) -> Any:
    return None if key is None else kept[key]


def carries_a_memory(records: list[dict[str, Any]]) -> bool:
    """Whether some policy lives on a product and acts on its original model."""
    return any(record["kind"] == "remembering" for record in records)
