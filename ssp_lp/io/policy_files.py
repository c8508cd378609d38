"""Policies in files of their own, to be read beside the model that they were made for."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np

from ssp_lp.errors import ModelError
from ssp_lp.io.archives.archive import Archive, ArrayStore, read_archive, write_archive
from ssp_lp.io.archives.policy_records import AnyPolicy, PolicyRecords, carries_a_memory, made_of
from ssp_lp.io.model_fingerprint import fingerprint, pair_print
from ssp_lp.model import SSP
from ssp_lp.model.ssp import check_model
from ssp_lp.model.within_steps import HorizonSSP, unroll

_VERSION = 1


def save_policy(policy: AnyPolicy, path: str | PathLike[str]) -> None:
    """Write a policy to a file: compressed arrays with a header in JSON, no pickle.

    The file holds the model's :func:`fingerprint`, not the model: :func:`load_policy` is given it.

    Args:
        policy: deterministic, stochastic, cost-aware, by cost levels, timed, a lottery, or one that
            carries the memory of a product.
        path: of the file, ``policy.npz``; no ending is added to it.

    Raises:
        ModelError: the policy is of another class, or the model has labels that cannot be stated.
    """
    store = ArrayStore()
    header = policy_header(policy, store)
    write_archive(path, "policy", _VERSION, header, store.arrays)


def load_policy(path: str | PathLike[str], model: SSP, *, check: bool = True) -> AnyPolicy:
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
    return policy_in(read_archive(path, "policy", _VERSION), model, check=check)


def policy_header(policy: AnyPolicy, store: ArrayStore) -> dict[str, Any]:
    """What the header of a file says of a policy, whose arrays go into the store.

    Raises:
        ModelError: the policy cannot be saved.
    """
    records = PolicyRecords(store)
    records.add(policy)
    model = records.model()
    horizon = None
    if isinstance(model, HorizonSSP):
        begin = np.flatnonzero(model.positions[:, 0] >= 0)
        horizon = {"steps": model.steps, "begin": store.add(begin)}
    return {
        "horizon": horizon,
        "model": fingerprint(model),
        "pairs": pair_print(model),
        "sizes": repr(model),
        "policies": records.records,
    }


def policy_in(archive: Archive, model: SSP, *, check: bool) -> AnyPolicy:
    """The policy that a header tells of; see :func:`load_policy`.

    Raises:
        ModelError: the model is another one.
    """
    header, arrays = archive
    records, horizon = header["policies"], header.get("horizon")
    if horizon is not None and not isinstance(model, HorizonSSP):
        begin = arrays[horizon["begin"]]
        if begin.max(initial=0) < model.n_states:  # else it is another model: its pairs differ
            model = unroll(model, horizon["steps"], begin.tolist())
    kept, remedy = f"the file was made for {header['sizes']}", ""
    if carries_a_memory(records):
        remedy = "; its policy carries a memory: load it beside product(model, memory)"
    if pair_print(model) != header["pairs"]:
        raise ModelError(f"{kept}, which has other pairs than {model!r}{remedy}")
    if check and fingerprint(model) != header["model"]:
        raise ModelError(
            f"{kept} with fingerprint {header['model'][:12]}..., this model has "
            f"{fingerprint(model)[:12]}...: build the same model, or give check=False if it "
            f"differs on purpose{remedy}"
        )
    return made_of(records, arrays, model)[-1]
