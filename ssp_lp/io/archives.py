"""The library's own files (.npz): models, policies and solutions as arrays, without pickle.

Each is an archive of numpy arrays with a header in JSON.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, fields, is_dataclass, replace
from enum import Enum
from fractions import Fraction
from hashlib import sha256
from io import SEEK_CUR
from itertools import pairwise
from math import isclose, isfinite
from operator import eq
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import numpy.typing as npt

from ssp_lp import policies
from ssp_lp.arrays import fields_of, read_only
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import Argument, ModelError
from ssp_lp.io.controller import controller_label
from ssp_lp.io.model_files.raw_model import FilePath
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.failure_product import label_failing
from ssp_lp.model.graph import stored_with_model
from ssp_lp.model.product import HorizonSSP, ProductSSP, unroll_steps
from ssp_lp.model.ssp import check_model, check_offsets
from ssp_lp.model.state_rows import StateRows
from ssp_lp.options import Status
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.policies.remembering import (
    CompletePolicy,
    JointMemory,
    LabelledPolicy,
    RememberingPolicy,
)
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import start_distribution
from ssp_lp.solution import Run, Solution, as_solved

Array = npt.NDArray[Any]
AnyPolicy = Policy | MixedPolicy

_VERSION = 1
"""Version of each kind of file."""

_HEADER, _PACKED = "header", b"PK"  # the first bytes of an archive
_LARGEST_HEADER = 1 << 28  # bytes that are unpacked: names of some ten million states


def write_archive(
    path: FilePath, kind: str, header: Mapping[str, Any], arrays: Mapping[str, Array]
) -> None:
    """Write a compressed archive; equal content gives equal bytes.

    Args:
        path: name of the file; no ending is added to it.
        kind: kind of the file, such as "policy".
        header: values that JSON supports.
        arrays: arrays by name.
    """
    whole = {"format": f"ssp-lp {kind}", "version": _VERSION, **header}
    packed = np.frombuffer(json.dumps(whole, default=np.generic.item).encode(), dtype=np.uint8)
    with Path(path).open("wb") as file:
        named: dict[str, Any] = {_HEADER: packed, **arrays}
        np.savez_compressed(file, **named)


class _Arrays(dict[str, Array]):
    """Arrays of an archive by name, each unpacked on first use."""

    def __init__(self, archive: Any) -> None:
        self._archive = archive

    def __missing__(self, name: str) -> Array:
        """Unpack an array and return it in the machine's byte order.

        Raises:
            ModelError: the array is damaged or missing.
        """
        try:
            array = self._archive[name]
        except KeyError as error:
            raise ModelError(f"the array {name} is missing") from error
        except (ValueError, MemoryError) as error:
            raise ModelError(_OTHER_ARRAY.format(name)) from error
        except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds for damage
            raise ModelError(f"the array {name} is damaged: {error}") from error
        self[name] = array.astype(array.dtype.newbyteorder("="), copy=False)
        return self[name]


_OTHER_ARRAY = "the array {} has another type or size than expected"


def _header_of(archive: Any, kind: str) -> Any:
    """Return the header of an archive that numpy has opened.

    Raises:
        ModelError: the header is too large, belongs to another kind of file, or has a later version
            than this library reads.
    """
    header: Any = None
    if _HEADER in archive.files:
        if (size := archive.zip.getinfo(f"{_HEADER}.npy").file_size) > _LARGEST_HEADER:
            raise ModelError(f"its header has {size:,} bytes, more than {_LARGEST_HEADER:,}")
        header = json.loads(archive[_HEADER].tobytes())
    if not isinstance(header, dict):
        raise ModelError("it was not written by ssp-lp")
    if (found := header.get("format", "")) != f"ssp-lp {kind}":
        raise ModelError(f"its format is {str(found)[:60]!r}")
    version = header.get("version")
    if type(version) is not int or not 1 <= version <= _VERSION:
        newer = type(version) is int and version > _VERSION
        remedy = "install a newer ssp-lp" if newer else f"write the {kind} again with this one"
        message = f"it has version {version!r}, this ssp-lp reads up to {_VERSION}: {remedy}"
        raise ModelError(message)
    return header


@contextmanager
def opened_archive(path: FilePath, kind: str) -> Iterator[tuple[Any, dict[str, Array]]]:
    """Open an archive and yield its header and its arrays; nothing in it is executed.

    Raises:
        ModelError: the file, which the error names, is no such archive, has a later version than
            this library reads, or has wrong content.
        OSError: the file cannot be opened.
    """
    with ExitStack() as opened:
        stream = opened.enter_context(Path(path).open("rb"))
        try:
            if stream.read(2) != _PACKED:
                raise ModelError(f"write one by save_{kind} of ssp_lp.io")
            stream.seek(0)
            archive = opened.enter_context(np.load(stream, allow_pickle=False))
            header = _header_of(archive, kind)
        except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds for damage
            raise ModelError(f"{path} is not an ssp-lp {kind} file: {error}") from error
        try:
            yield header, _Arrays(archive)
        except ModelError as error:
            raise ModelError(f"{path}: ", *error.args) from error
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            raise ModelError(f"{path} is damaged: {error!r}") from error


_ARRAYS = {
    **dict.fromkeys(("pair_action", "pair_offsets", "outcome_offsets", "goal_states"), "i8"),
    **dict.fromkeys(("label_offsets", "label_members"), "i8"),
    "successors": "i4",
    "probabilities": "f8",
    "costs": "f8",
}
"""Arrays of a model's file, each one-dimensional."""

_FRACTION = re.compile(r"\d{1,4000}(/\d{1,4000})?", re.ASCII)


@explained
def save_model(model: SSP, path: FilePath) -> None:
    """Write a complete model to an archive for :func:`load_model`.

    Args:
        model: the model; labels of its states and actions are strings, numbers, bools, or tuples of
            these.
        path: name of the file (``.npz`` is usual).

    Raises:
        ModelError: the label of a state or an action is of another type.
    """
    check_model(model, "save_model")

    def stated(names: Sequence[Hashable]) -> list[Any] | None:
        """Return names as JSON values; None if the names are their own positions 0, 1, ... ."""
        if isinstance(names, range):
            return None
        return [name if isinstance(name, float) else label_value(name) for name in names]

    uniform = model.costs.strides == (0,) and model.costs.size > 0
    members = list(model.state_labels.values())
    header = {
        "states": stated(model.states),
        "actions": stated(model.action_names),
        "state_labels": list(model.state_labels),
        "exact_costs": [[cost, str(exact)] for cost, exact in model.exact_costs.items()],
        "named_costs": list(model.named_costs),
    }
    stored = {
        "pair_action": model.pair_action,
        "pair_offsets": model.pair_offsets,
        "outcome_offsets": model.outcome_offsets,
        "successors": model.successors,
        "probabilities": model.probabilities,
        "costs": model.costs[:1] if uniform else model.costs,
        "goal_states": np.flatnonzero(model.goal_mask),
        "label_offsets": np.cumsum([0, *(len(at) for at in members)]),
        "label_members": np.concatenate([np.zeros(0, dtype=np.int64), *members]),
    }
    arrays = {name: stored[name].astype(f"<{kind}") for name, kind in _ARRAYS.items()}
    named = {f"costs {k}": costs for k, costs in enumerate(model.named_costs.values())}
    write_archive(path, "model", header, arrays | named)


class StoredModel:
    """A file of :func:`save_model`, of which any block of states can be read by itself."""

    def __init__(self, path: FilePath) -> None:
        """Read the goals, the sets of states and the number of states.

        Raises:
            ModelError: the file, which the error names, has another format or is damaged.
            OSError: the file cannot be opened.
        """
        self._path = path
        with opened_archive(path, "model") as (header, arrays):
            self._named: list[str] = header["named_costs"]
            ends, members = arrays["label_offsets"], arrays["label_members"]
            self.goal_states = arrays["goal_states"]
            self.state_labels = {
                name: members[ends[k] : ends[k + 1]]
                for k, name in enumerate(header["state_labels"])
            }
        self.n_states = self._read("pair_offsets", 0, 0)[1] - 1

    def rows(self, first: int, end: int) -> StateRows:
        """Return the pairs and outcomes of the states ``first`` .. ``end`` - 1."""
        pairs = self._read("pair_offsets", first, end + 1)[0]
        outcomes = self._read("outcome_offsets", int(pairs[0]), int(pairs[-1]) + 1)[0]
        own = int(outcomes[0]), int(outcomes[-1])
        uniform = self._read("costs", 0, 0)[1] == 1
        return StateRows(
            np.diff(pairs),
            np.diff(outcomes),
            self._read("successors", *own)[0],
            self._read("probabilities", *own)[0],
            float(self._read("costs", 0, 1)[0][0]) if uniform else self._read("costs", *own)[0],
            {name: self._read(f"costs {k}", *own)[0] for k, name in enumerate(self._named)},
        )

    def _read(self, name: str, begin: int, end: int) -> tuple[Array, int]:
        """Return the entries ``begin`` to ``end`` of an array in the file, and the array's length.

        Raises:
            ModelError: the file, which the error names, is damaged.
        """
        try:
            with ZipFile(self._path) as archive, archive.open(f"{name}.npy") as file:
                is_first = np.lib.format.read_magic(file) == (1, 0)
                headers = np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0
                (length, *more), _, kind = headers[not is_first](file)
                if more or kind.hasobject or end > length:
                    raise ValueError(_OTHER_ARRAY.format(name))
                file.seek(begin * kind.itemsize, SEEK_CUR)
                entries = np.frombuffer(file.read((end - begin) * kind.itemsize), dtype=kind)
        except Exception as damage:  # zipfile, zlib and numpy raise a dozen kinds
            raise ModelError(f"{self._path} is damaged: {damage!r}") from damage
        return entries.astype(kind.newbyteorder("=")), length


@explained
def load_model(path: FilePath) -> SSP:
    """Read a model from an archive of :func:`save_model`; nothing in it is executed.

    Args:
        path: the file.

    Returns:
        The same model.

    Raises:
        ModelError: the file, which the error names, has another format or a newer version, or does
            not contain a valid model.
        OSError: the file cannot be opened.
    """
    with opened_archive(path, "model") as (header, arrays):
        for name, kind in _ARRAYS.items():
            if arrays[name].ndim != 1 or arrays[name].dtype != kind:
                raise ModelError(_OTHER_ARRAY.format(name))
        n_states, labels = arrays["pair_offsets"].size - 1, arrays["label_offsets"]
        states, actions = (
            None if header[name] is None else [controller_label(part) for part in header[name]]
            for name in ("states", "actions")
        )
        if states is not None and len(states) != n_states:
            raise ModelError("there must be one name for each state")
        if actions is not None:
            actions = _named_in_archive(actions, arrays["pair_action"], "actions")
        labels_of_states = range(n_states) if states is None else states
        members = _named_in_archive(labels_of_states, arrays["label_members"], "members of labels")
        check_offsets("label_offsets", labels, len(members))
        marked = [members[begin:end] for begin, end in pairwise(labels.tolist())]
        for _, text in header["exact_costs"]:
            if not _FRACTION.fullmatch(text):  # checks the number of digits first
                raise ModelError(f"the exact cost {text[:60]!r} is not a fraction")
        names = ("pair_offsets", "outcome_offsets", "successors", "probabilities", "goal_states")
        plain: dict[str, Any] = {name: arrays[name] for name in names}
        model = SSP.from_arrays(
            **plain,
            costs=arrays["costs"][0] if arrays["costs"].size == 1 else arrays["costs"],
            states=states,
            actions=actions,
            state_labels=dict(zip(header["state_labels"], marked, strict=True)),
            exact_costs={float(cost): Fraction(text) for cost, text in header["exact_costs"]},
            named_costs={
                name: arrays[f"costs {k}"] for k, name in enumerate(header["named_costs"])
            },
            treat_actionless_as_dead_ends=True,
        )
        return replace(model, probabilities=read_only(arrays["probabilities"]))  # not rounded again


def _named_in_archive(names: Sequence[Hashable], numbers: Array, what: str) -> list[Hashable]:
    """Return the names at given positions; ``what`` describes the named things in errors."""
    if ((numbers < 0) | (numbers >= len(names))).any():
        raise ModelError(f"there are {what} without a name")
    return [names[k] for k in numbers.tolist()]


@explained
def save_policy(policy: AnyPolicy, path: FilePath) -> None:
    """Write a policy to an archive: compressed arrays with a header in JSON, no pickle.

    The file has the model's :func:`fingerprint`, not the model: pass the model to
    :func:`load_policy`.

    Args:
        policy: any policy of this library, such as that of a solution, or a lottery over such
            policies.
        path: name of the file, ``policy.npz``, without a further ending.

    Raises:
        ModelError: the policy is of another class, or the model has unsupported labels.
    """
    records = _PolicyRecords()
    write_archive(path, "policy", records.header(policy), records.arrays)


@explained
def load_policy(path: FilePath, model: SSP, *, check: bool = True) -> AnyPolicy:
    """Read a policy from its archive. The model must equal the one that the policy was made for.

    With equal seeds, the saved policy and the policy that is returned play equal episodes.

    Args:
        path: a file of :func:`save_policy`.
        model: the model that the policy acts on. If the policy carries the memory of a product,
            give the product. For a policy with a horizon give the model itself: its product is
            rebuilt.
        check: False: the model may differ (other probabilities, costs or names), as long as every
            state has as many actions as before.

    Raises:
        ModelError: the file has no policy, or its policy is for another model.
    """
    check_model(model, "load_policy")
    with opened_archive(path, "policy") as (header, arrays):
        horizon = header.get("horizon")
        if horizon is not None and not isinstance(model, HorizonSSP):
            begin = arrays[horizon["begin"]]
            if begin.max(initial=0) < model.n_states:  # otherwise the model is another one
                lost = None if horizon["survive"] is None else tuple(horizon["survive"])
                model = unroll_steps(model, horizon["steps"], begin.tolist(), lost)
        label = header.get("label")
        if label is not None and len(arrays[label["open_pairs"]]) == model.n_pairs:
            names = ("open_pairs", "stops", "charged", "free_pairs")
            model = label_failing(model, *(arrays[label[name]] for name in names))
            costs = read_only(arrays[label["costs"]])
            model = replace(model, costs=costs, charges=label["charges"])
        return _policy_in(header, arrays, model, check=check)


def _policy_in(
    header: Mapping[str, Any], arrays: Mapping[str, Array], model: SSP, *, check: bool
) -> AnyPolicy:
    """Return the policy of an archive on a model, as :func:`load_policy` does.

    Raises:
        ModelError: the policy is for another model.
    """
    records = header["policies"]
    kept, remedy = f"the file was made for {header['sizes']}", ""
    if horizon := header.get("horizon"):
        remedy = f"; its policy counts {horizon['steps']:,} steps: give it that horizon"
    elif any(record["kind"] == "remembering" for record in records):
        remedy = "; its policy carries a memory: load it with product(model, memory)"
    if pair_print(model) != header["pairs"]:
        raise ModelError(f"{kept}, whose pairs differ from those of {model!r}{remedy}")
    if check and fingerprint(model) != header["model"]:
        raise ModelError(
            f"{kept} with fingerprint {header['model'][:12]}..., this model has "
            f"{fingerprint(model)[:12]}...: build the same model, or give ",
            Argument("check", False),
            f" if it differs on purpose{remedy}",
        )
    parts: list[AnyPolicy] = []

    def meant(value: Any) -> Any:
        """Return the value that a field's entry stands for.

        A string is the name of an array. A whole number is the number of a policy, and a list holds
        such numbers. Any other entry is the value itself.
        """
        if isinstance(value, str):
            return arrays[value]
        if isinstance(value, list):
            return tuple(parts[k] for k in value)
        return parts[value] if type(value) is int else value

    for record in records:
        kind = _CLASSES[record.pop("kind")]
        on_model = {"model": model} if any(part.name == "model" for part in fields(kind)) else {}
        stated = {name: meant(value) for name, value in record.items() if value is not None}
        parts.append(kind(**stated, **on_model))
    return parts[-1]


_CLASSES: dict[str, type[Any]] = {
    "deterministic": policies.DeterministicPolicy,
    "stochastic": policies.StochasticPolicy,
    "cost aware": policies.CostAwarePolicy,
    "timed": policies.TimedPolicy,
    "mixed": MixedPolicy,
    "remembering": RememberingPolicy,
    "labelled": LabelledPolicy,
    "joint memory": JointMemory,
    "complete": CompletePolicy,
}
"""Classes of policies that a file can store: all of ``ssp_lp/policies``."""


class _PolicyRecords:
    """Records of a policy and of the policies that it contains; the contained ones come first."""

    def __init__(self) -> None:
        self.arrays: dict[str, Array] = {}
        self._records: list[dict[str, Any]] = []
        self._models: dict[int, SSP] = {}  # id -> model of a part
        self._numbers: dict[int, int] = {}  # id of a policy -> number of its record

    def header(self, policy: AnyPolicy) -> dict[str, Any]:
        """Add a policy and return the header of its archive.

        Raises:
            ModelError: the policy cannot be saved, or its parts are on several models.
        """
        self._add(policy)
        if len(self._models) != 1:
            raise ModelError("the parts of the policy are on several models: save each by itself")
        (model,) = self._models.values()
        stated, horizon, label = model, None, None
        if (labelled := model.failure_label) is not None:
            stated = labelled.original
            arrays = {
                "open_pairs": labelled.open_pairs,
                "charged": labelled.charged,
                "costs": labelled.costs,
                "free_pairs": labelled.free_pairs,
                "stops": labelled.stops[: labelled.n_original],
            }
            named = {name: self.add_array(array) for name, array in arrays.items()}
            label = {**named, "charges": labelled.charges}
        if isinstance(stated, HorizonSSP):
            begin = self.add_array(np.flatnonzero(stated.table[:, 0] >= 0))
            horizon = {"steps": stated.steps, "begin": begin, "survive": stated.survive}
        return {
            "model": fingerprint(model),
            "pairs": pair_print(model),
            "sizes": repr(model),
            "policies": self._records,
            "horizon": horizon,
            "label": label,
        }

    def add_array(self, array: Array) -> str:
        """Add an array and return its name."""
        name = f"array{len(self.arrays)}"
        self.arrays[name] = array
        return name

    def _add(self, policy: AnyPolicy) -> int:
        """Return the number of a policy's record, which is added if the policy has none yet.

        Records of the policies that it contains are added first.

        Raises:
            ModelError: the policy or a part of it is of an unsupported class.
        """
        if id(policy) in self._numbers:
            return self._numbers[id(policy)]
        name = next((name for name, kind in _CLASSES.items() if kind is type(policy)), None)
        if name is None:
            own = ": save its .policy instead" if isinstance(policy, Solution) else ""
            kind = type(policy).__name__
            raise ModelError(f"a {kind} cannot be saved: it is none of the library's policies{own}")
        record: dict[str, Any] = {"kind": name}
        for part, value in fields_of(policy, policy).items():
            if isinstance(value, SSP):
                self._models[id(value)] = value
            else:
                record[part] = self._stated(value)
        self._records.append(record)
        return self._numbers.setdefault(id(policy), len(self._records) - 1)

    def _stated(self, value: Any) -> Any:
        """Return the entry that stands for a field's value; see ``meant`` in ``_policy_in``."""
        if isinstance(value, np.ndarray):
            return self.add_array(value)
        if isinstance(value, (Policy, MixedPolicy)):
            return self._add(value)
        if isinstance(value, tuple):
            return [self._add(inner) for inner in value]
        return value if value is None or isinstance(value, bool) else float(value)


_ROUNDING = 1e-9
"""Relative difference up to which budgets that were recomputed from a share count as equal."""


@explained
def save_solution(solution: Solution, path: FilePath) -> None:
    """Write a solution to an archive: policy, numbers, prices, value function, facts of the run.

    The archive does not contain the problem and its model: :func:`load_solution` needs the problem.

    Args:
        solution: solution of ``solve``, or made by hand.
        path: name of the file, ``solution.npz``, without a further ending.

    Raises:
        ModelError: the solution's policy is of a class that cannot be saved.
    """
    as_solved(solution, "save_solution")
    problem, records, values = solution.problem, _PolicyRecords(), solution.value_function
    header = records.header(solution.policy)
    header["problem"] = _solution_words(problem)
    header["start"] = records.add_array(start_distribution(problem.model, problem.start))
    header["numbers"] = {
        "objective": solution.objective,
        "lower_bound": solution.lower_bound,
        "upper_bound": solution.upper_bound,
        "failure_price": solution.failure_price,
        "budget_used": solution.budget_used,
        "note": solution.note,
    }
    header["prices"] = {name: float(price) for name, price in solution.prices.items()}
    header["value_function"] = None if values is None else records.add_array(np.asarray(values))
    header["run"], header["status"] = asdict(solution.run), solution.status.name
    write_archive(path, "solution", header, records.arrays)


@explained
def load_solution(path: FilePath, problem: Problem) -> Solution:
    """Read a solution from its archive; ``certify`` accepts it like the saved solution.

    Args:
        path: a file of :func:`save_solution`.
        problem: the problem that was solved, stated again on the same model.

    Raises:
        ModelError: the file has no solution, the model is another one, or the problem has another
            criterion, start, budget, discount, penalty, or other limits.
    """
    model = problem.unrolled.model
    with opened_archive(path, "solution") as (header, arrays):
        policy = _policy_in(header, arrays, model, check=True)
        _check_problem(problem, header["problem"], arrays[header["start"]])
        if not isinstance(policy, MixedPolicy):
            raise TypeError("no lottery")
        run, values = header["run"], header["value_function"]
        return Solution(
            problem=problem,
            policy=policy,
            value_function=None if values is None else arrays[values],
            run=Run(**{**run, "work": Work(**run["work"])}),
            prices=header["prices"],
            status=Status[header["status"]],
            **header["numbers"],
        )


def _solution_words(problem: Problem) -> dict[str, Any]:
    """Return the arguments of a problem that are stored with its solution, by name."""
    semantics, measure = problem.semantics, problem.semantics.measure
    return {
        "criterion": type(problem).__name__,
        "failure_budget": None if problem.failure_budget is None else float(problem.failure_budget),
        "discount": None if problem.discount is None else float(problem.discount),
        "penalty": float(semantics.penalty),
        "give_up": str(semantics.give_up),
        "measure": None if measure is None else measure.words,
        "limits": {
            condition.name: [float(row.bound) for row in condition.rows]
            for condition in problem.conditions
        },
    }


def _check_problem(problem: Problem, kept: Mapping[str, Any], start: np.ndarray[Any, Any]) -> None:
    """Raise :class:`ModelError` unless a problem has the arguments stored with a solution.

    ``stored_with_model`` has the stored arguments by name, and ``start`` is the stored start,
    [states].
    """
    for name, stated in _solution_words(problem).items():
        saved = kept[name]
        same = saved == stated
        if isinstance(saved, float) and isinstance(stated, float):
            same = isclose(saved, stated, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
        if not same:
            raise ModelError(f"the file answers a problem with {name} = {saved!r}, not {stated!r}")
    if not np.array_equal(start_distribution(problem.model, problem.start), start):
        raise ModelError("the file answers a problem with another start: pass that problem")


_FINGERPRINT_VERSION = "ssp-lp model 1"

_PIECE = 1 << 20
"""Entries of an array that are hashed at a time, so that large models need little memory."""


@explained
@stored_with_model
def fingerprint(model: SSP) -> str:
    """Return the SHA-256 of a model's content, in hexadecimal, cached with the model.

    Equal fingerprints mean equal models. The hash depends on

    - the order of pairs and outcomes;
    - successors, probabilities and costs, with the fractions that costs stand for;
    - goals, and the labels of states, actions and sets of states;
    - for a product, the original model.

    The hash does not depend on the types of arrays, the machine's byte order, the sign of zero, or
    whether state labels 0, 1, ... were given or are the default.

    Each part is hashed as ``name length``, a line feed and its content: arrays as 8-byte
    little-endian whole numbers or IEEE doubles, the rest as JSON with sorted keys.

    Raises:
        ModelError: a label has no representation that is the same in every process.

    Example:
        >>> from ssp_lp import SSP
        >>> model = SSP.from_transitions({"door": {"open": [(1.0, "out", 2.0)]}}, goal={"out"})
        >>> fingerprint(model)[:16]
        '91f3cedaabf4992f'
    """
    digest = sha256(_FINGERPRINT_VERSION.encode())
    arrays: dict[str, Array] = {
        "pair_offsets": model.pair_offsets,
        "outcome_offsets": model.outcome_offsets,
        "successors": model.successors,
        "pair_action": model.pair_action,
        "goal_mask": model.goal_mask,
        "probabilities": model.probabilities,
        "costs": model.costs,
        **{f"cost {name!r}": costs for name, costs in model.named_costs.items()},
    }
    for name, array in arrays.items():
        _hash_array(digest.update, name, array)
    states, actions = (  # their number if they are 0, 1, ...
        len(names) if are_numbers_in_turn(names) else [stated_value(label) for label in names]
        for names in (model.states, model.action_names)
    )
    exact = [[float(k).hex(), str(v)] for k, v in sorted(model.exact_costs.items())]
    labels = {name: members.tolist() for name, members in model.state_labels.items()}
    words: dict[str, Any] = {
        "states": states,
        "actions": actions,
        "state_labels": labels,
        "exact_costs": exact,
    }
    if isinstance(model, ProductSSP):
        words["original"] = fingerprint(model.original)
    for name, value in words.items():
        content = json.dumps(value, sort_keys=True, separators=(",", ":")).encode()
        digest.update(f"\n{name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


@stored_with_model
def pair_print(model: SSP) -> str:
    """Return the SHA-256 of the list that says how many actions each state has.

    A policy can be loaded on a model only if these numbers are those of its own model.
    """
    digest = sha256(b"ssp-lp pairs 1")
    _hash_array(digest.update, "pair_offsets", model.pair_offsets)
    return digest.hexdigest()


def _hash_array(update: Callable[[bytes], None], name: str, array: Array) -> None:
    """Add an array with its name to a hash, whose method ``update`` takes bytes."""
    kind = "<f8" if array.dtype.kind == "f" else "<i8"
    update(f"\n{name} {len(array)}\n".encode())
    for first in range(0, len(array), _PIECE):
        # adding zero turns -0.0 into 0.0
        update((array[first : first + _PIECE] + np.zeros(1, kind)).astype(kind).tobytes())


def label_value(label: Hashable) -> Any:
    """Return a label (str, int, float, bool, None or a tuple of labels) as a JSON value.

    Raises:
        ModelError: it is or contains any other value, or a number that is not finite.
    """
    plain = label.item() if isinstance(label, np.generic) else label
    match plain:
        case Enum():
            pass
        case None | bool() | str():
            return plain
        case int():
            return int(plain)
        case float() if isfinite(plain):
            return plain
        case tuple():
            return [label_value(part) for part in plain]
    raise ModelError(
        f"the label {label!r} cannot be written: use str, int, float, bool, None or tuples of them"
    )


def stated_value(label: Hashable) -> Any:
    """Return a value as JSON that is equal in every process.

    Labels are as in :func:`label_value`. Sets, fractions, members of enumerations and dataclasses
    become JSON objects with their class.

    Raises:
        ModelError: it is or contains any other value.
    """
    match label:
        case Enum():
            return {"member": f"{type(label).__qualname__}.{label.name}"}
        case Fraction():
            return {"fraction": str(label)}
        case frozenset():
            return {"set": sorted((stated_value(part) for part in label), key=repr)}
        case tuple():
            return [stated_value(part) for part in label]
    if is_dataclass(label) and not isinstance(label, type):
        parts = {name: stated_value(part) for name, part in fields_of(label, label).items()}
        return {"class": type(label).__qualname__, "fields": parts}
    return label_value(label)


def are_numbers_in_turn(labels: Sequence[Hashable]) -> bool:
    """Return whether labels are the whole numbers 0, 1, ..., so that an archive can omit them."""
    in_turn = range(len(labels))
    return labels == in_turn or all(map(eq, labels, in_turn))
