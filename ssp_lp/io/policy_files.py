"""Policies in files of their own, to be read beside the model that they were made for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssp_lp.errors import Argument, ModelError
from ssp_lp.io.archive import Array, damage_named, read_archive, write_archive
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.io.model_fingerprint import fingerprint, pair_print
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import check_model
from ssp_lp.model.within_steps import HorizonSSP, unroll_steps
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

_VERSION = 1


@explained
def save_policy(policy: AnyPolicy, path: FilePath) -> None:
    """Write a policy to a file: compressed arrays with a header in JSON, no pickle.

    The file holds the model's :func:`fingerprint`, not the model: :func:`load_policy` is given it.

    Args:
        policy: deterministic, stochastic, cost-aware, by cost levels, timed, a lottery, or one that
            carries the memory of a product.
        path: of the file, ``policy.npz``; no ending is added to it.

    Raises:
        ModelError: the policy is of another class, or the model has labels that cannot be stated.
    """
    records = PolicyRecords()
    write_archive(path, "policy", _VERSION, records.header(policy), records.arrays)


@explained
def load_policy(path: FilePath, model: SSP, *, check: bool = True) -> AnyPolicy:
    """Read a policy beside the model that it was made for, such as one built anew.

    It plays the same episodes as the one that was saved, given the same generator.

    Args:
        path: a file of :func:`save_policy`.
        model: the model; for a policy that carries the memory of a product, the product. One that
            counts the steps of a horizon has its product built anew.
        check: False: the model may differ (other probabilities, costs or names), so long as every
            state has as many actions as before.

    Raises:
        ModelError: the file is none of a policy, or the model is another one.
    """
    check_model(model, "load_policy")
    header, arrays = read_archive(path, "policy", _VERSION)
    with damage_named(path):
        horizon = header.get("horizon")
        if horizon is not None and not isinstance(model, HorizonSSP):
            begin = arrays[horizon["begin"]]
            if begin.max(initial=0) < model.n_states:  # else it is another model: its pairs differ
                model = unroll_steps(model, horizon["steps"], begin.tolist())
        return policy_in(header, arrays, model, check=check)


def policy_in(
    header: Mapping[str, Any], arrays: Mapping[str, Array], model: SSP, *, check: bool
) -> AnyPolicy:
    """The policy that a header tells of; see :func:`load_policy`.

    Raises:
        ModelError: the model is another one.
    """
    records = header["policies"]
    kept, remedy = f"the file was made for {header['sizes']}", ""
    if horizon := header.get("horizon"):
        remedy = f"; its policy counts {horizon['steps']:,} steps: give it that horizon"
    elif any(record["kind"] == "remembering" for record in records):
        remedy = "; its policy carries a memory: load it beside product(model, memory)"
    if pair_print(model) != header["pairs"]:
        raise ModelError(f"{kept}, which has other pairs than {model!r}{remedy}")
    if check and fingerprint(model) != header["model"]:
        raise ModelError(
            f"{kept} with fingerprint {header['model'][:12]}..., this model has "
            f"{fingerprint(model)[:12]}...: build the same model, or give ",
            Argument("check", False),
            f" if it differs on purpose{remedy}",
        )
    return policies_in_file(records, arrays, model)[-1]


AnyPolicy = Policy | MixedPolicy


@dataclass(frozen=True)
class _Kind:
    """What a class of policies is made of: the names of its fields, by what they hold."""

    made: type[AnyPolicy]
    on_model: bool = False  # whether the model is a field
    numbers: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
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
        numbers=("unit",),
        flags=("rounds_up",),
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

    arrays: dict[str, Array] = field(default_factory=dict)
    records: list[dict[str, Any]] = field(default_factory=list)
    models: list[SSP] = field(default_factory=list)  # those that the parts live on
    _known: dict[int, int] = field(default_factory=dict)  # id of a policy -> its record
    _named: dict[Any, str] = field(default_factory=dict)  # content of an array -> its name

    def header(self, policy: AnyPolicy) -> dict[str, Any]:
        """What the header of a file says of a policy, and of the model that it lives on.

        Raises:
            ModelError: the policy cannot be saved, or lives on several models.
        """
        self.add(policy)
        if len(self.models) != 1:
            raise ModelError("the parts of the policy live on several models: save each by itself")
        model = self.models[0]
        known = {"model": fingerprint(model), "pairs": pair_print(model), "sizes": repr(model)}
        horizon = None
        if isinstance(model, HorizonSSP):
            begin = np.flatnonzero(model.positions[:, 0] >= 0)
            horizon = {"steps": model.steps, "begin": self.add_array(begin)}
        return {**known, "policies": self.records, "horizon": horizon}

    def add_array(self, array: Array) -> str:
        """The name under which an array is found again; equal ones are kept once."""
        key = array.dtype.str, array.shape, array.tobytes()
        name = self._named.setdefault(key, f"array{len(self._named)}")
        self.arrays[name] = array
        return name

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
        for part in kind.flags:
            record[part] = bool(getattr(policy, part))
        for part in kind.arrays:
            array = getattr(policy, part)
            record[part] = None if array is None else self.add_array(array)
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


def policies_in_file(
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
        parts |= {part: bool(record[part]) for part in kind.flags}
        parts |= {part: _found_in_file(arrays, record[part]) for part in kind.arrays}
        parts |= {part: _found_in_file(made, record[part]) for part in kind.policies}
        parts |= {part: tuple(made[k] for k in record[part]) for part in kind.lists}
        made.append(kind.made(**parts))
    return made


def _found_in_file(kept: Any, key: str | int | None) -> Any:
    """What a policy's file keeps under a key."""
    return None if key is None else kept[key]
