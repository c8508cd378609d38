"""Raw models: the arrays in files of other tools, and their conversion to models and back."""

from __future__ import annotations

import gzip
import io
import lzma
import re
import tarfile
import zipfile
import zlib
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, NamedTuple, TextIO

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, offsets_of, run_starts, segment_ids
from ssp_lp.errors import Argument, ModelError
from ssp_lp.model import SSP
from ssp_lp.model.ssp import ENDS, DeadEnds

FilePath = str | PathLike[str]

_GZIP, _XZ, _ZIP = b"\x1f\x8b", b"\xfd7", b"PK"  # the first two bytes of packed files
_GZIP_LEVEL = 6  # the usual compromise of size and time; 9 takes several times as long

_BROKEN = (
    UnicodeDecodeError, EOFError, gzip.BadGzipFile, zlib.error, lzma.LZMAError, tarfile.TarError,
    zipfile.BadZipFile, NotImplementedError,
)  # fmt: skip
"""Errors of a file that is not a text, or cannot be unpacked."""


@contextmanager
def opened_text(path: Path, what: str = "text") -> Iterator[TextIO]:
    """Open a text file of a model for reading.

    It may be plain, packed by gzip or xz, or the only file of an archive as Storm packs its models
    (tar, packed or not, or zip).

    Raises:
        ModelError: no UTF-8, a broken packed file, or an archive of several files.
        OSError: the file cannot be opened.
    """
    with (
        broken_files_named(path, what),
        _unpacked(path) as stream,
        io.TextIOWrapper(stream, encoding="utf-8") as file,
    ):
        yield file


@contextmanager
def broken_files_named(path: Path, what: str) -> Iterator[None]:
    """Turn errors of unpacking or decoding a file in a ``with`` block into :class:`ModelError`."""
    try:
        yield
    except _BROKEN as error:
        raise ModelError(f"{path} is no {what}: {error}") from error


@contextmanager
def _unpacked(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for reading its unpacked bytes."""
    with path.open("rb") as plain:
        packing = plain.read(2)
    if packing == _ZIP:
        with zipfile.ZipFile(path) as archive:
            files = [m for m in archive.infolist() if not (m.is_dir() or m.flag_bits & 1)]
            _check_single(len(files), path)
            with archive.open(files[0]) as member:
                yield member
        return
    opener: Any = {_GZIP: gzip.open, _XZ: lzma.open}.get(packing, open)
    with opener(path, "rb") as stream:
        is_tar = stream.read(tarfile.BLOCKSIZE)[257:262] == b"ustar"
        stream.seek(0)
        if not is_tar:
            yield stream
            return
        with tarfile.open(fileobj=stream, mode="r:") as tar:
            members = [m for m in tar if m.isfile()]
            _check_single(len(members), path)
            yield tar.extractfile(members[0]) or stream


def _check_single(n_files: int, path: Path) -> None:
    """Raise :class:`ModelError` unless an archive contains exactly one readable file."""
    if n_files != 1:
        raise ModelError(f"{path}: an archive must contain one readable file, not {n_files}")


def write_text(path: FilePath, pieces: Iterable[str]) -> None:
    """Write a text piece by piece, packed by gzip if the name of the file ends in .gz."""
    place = Path(path)
    opener: Any = partial(gzip.open, compresslevel=_GZIP_LEVEL) if place.suffix == ".gz" else open
    with opener(place, "wt", encoding="utf-8", newline="\n") as file:
        file.writelines(pieces)


def write_tar(path: FilePath, files: Mapping[str, IO[bytes]], packing: str) -> None:
    """Write files by name as a tar archive, packed by gzip (".gz") or xz (".xz")."""
    with (
        gzip.open(path, "wb", _GZIP_LEVEL) if packing == ".gz" else lzma.open(path, "wb") as packed,
        tarfile.open(fileobj=packed, mode="w:") as archive,
    ):
        for name, file in files.items():
            member = tarfile.TarInfo(name)
            member.size = file.seek(0, io.SEEK_END)
            file.seek(0)
            archive.addfile(member, file)


FIRST_COST = "*"
"""Value of ``cost`` that means the first cost, for a model that is only inspected."""


def chosen_reward(source: object, names: Sequence[str], cost: str | None) -> int | None:
    """Return the position of the reward model that is the cost; None if there is none.

    Args:
        source: name of the model in errors.
        names: names of the reward models; "" for one without a name.
        cost: the name; None: the only one; ``FIRST_COST``: the first one.

    Raises:
        ModelError: no reward model has this name, or there are several to choose from.
    """
    if not names and cost in (None, "", FIRST_COST):
        return None
    if cost == FIRST_COST:
        return 0
    places = [k for k, name in enumerate(names) if cost in (None, name)]
    if len(places) == 1:
        return places[0]
    unknown = "" if cost is None else f"no reward model {cost!r}; "
    choices = ", ".join(map(repr, names)) or "none"
    message = f"{source}: {unknown}choose one of the reward models ("
    raise ModelError(message, Argument("cost"), f"): {choices}")


def costs_of_rewards(
    source: object, names: Sequence[str], rewards: Sequence[FloatArray], cost: str | None, size: int
) -> dict[str, Any]:
    """Return the fields ``costs`` and ``named_costs`` of a raw model.

    The named costs are the reward models whose names are unique. If there are several reward
    models, one without a name is called "". A single reward model without a name is not a named
    cost.

    Args:
        source: name of the model in errors.
        names: names of the reward models.
        rewards: one array for each reward model, [outcomes]; empty: every outcome costs 1.
        cost: name of the cost, as in :func:`chosen_reward`.
        size: number of outcomes.

    Raises:
        ModelError: no reward model has this name, or there are several to choose from.
    """
    place = chosen_reward(source, names, cost)
    named = zip(names, rewards, strict=False)  # rewards without a declared reward model
    return {
        "costs": rewards[place or 0] if rewards else np.ones(size),
        "named_costs": {n: paid for n, paid in named if names.count(n) == 1 and names != [""]},
    }


INITIAL, DEADLOCK, PAYING = "init", "deadlock", "paying"
"""Labels with a meaning in files: initial states, dead-ends, and extra states that pay the rest of
an outcome's cost."""

PAY = "pay"
"""Action of the states that pay."""


class RawModel(NamedTuple):
    """A model as a file contains it: goal states may have actions, too."""

    pair_offsets: IntArray  # [states + 1]
    outcome_offsets: IntArray  # [pairs + 1]
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes]
    costs: FloatArray  # [outcomes]
    actions: Sequence[Hashable] | None  # [pairs]
    labels: Mapping[str, IntArray]  # label -> states
    states: Sequence[Hashable] | None = None
    exact_costs: Mapping[float, Fraction] | None = None
    named_costs: Mapping[str, FloatArray] = MappingProxyType({})  # name -> [outcomes]


def without_paying_states(raw: RawModel, goals: IntArray) -> RawModel:
    """Remove states that only pay, and add their costs to the outcomes that lead to them.

    :func:`exported` adds such states where the outcomes of an action differ in cost. A state only
    pays if it has the label "paying", one action, "pay", and one certain successor. Each outcome
    that leads into the state then leads to this successor, at the sum of both costs. So a quantity
    that is counted until a failure includes the whole cost of the step that fails.

    Args:
        raw: content of the file.
        goals: the goal states.
    """
    counts, sizes = np.diff(raw.pair_offsets), np.diff(raw.outcome_offsets)
    paying = np.zeros(counts.size, dtype=np.bool_)
    barred = {*goals.tolist(), *raw.labels.get(INITIAL, goals).tolist()}
    for state in raw.labels.get(PAYING, goals[:0]).tolist():
        pair = int(raw.pair_offsets[state])
        if state not in barred and counts[state] == 1 and sizes[pair] == 1 and raw.actions:
            is_sure = raw.probabilities[raw.outcome_offsets[pair]] == 1.0
            paying[state] = is_sure and raw.actions[pair] == PAY
    alone = np.flatnonzero(paying)
    follower = raw.successors[raw.outcome_offsets[raw.pair_offsets[alone]]]
    paying[alone[paying[follower]]] = False  # none pays for another
    if not paying.any() or not (raw.costs >= 0.0).all():  # no sum hides a wrong cost
        return raw
    # each paying state's one outcome; at other states arbitrary
    firsts = np.minimum(raw.outcome_offsets[raw.pair_offsets[:-1]], raw.successors.size - 1)
    through = paying[raw.successors]

    def whole(costs: FloatArray) -> FloatArray:
        """Return the cost of each outcome plus that of the paying state after it, [outcomes]."""
        rest = np.where(through, costs[firsts[raw.successors]], 0.0)
        least = np.minimum(costs, rest)  # the sum does not hide a negative one
        return np.where(least < 0.0, least, decimal_sum(costs, rest, raw.exact_costs))

    moved = raw._replace(
        successors=np.where(through, raw.successors[firsts[raw.successors]], raw.successors),
        costs=whole(raw.costs),
        named_costs={name: whole(costs) for name, costs in raw.named_costs.items()},
    )
    left, number = _with_pairs(moved, np.repeat(~paying, counts)), np.cumsum(~paying) - 1
    labels = {name: number[at[~paying[at]]] for name, at in raw.labels.items()}
    if not labels[PAYING].size:
        del labels[PAYING]
    return left._replace(
        pair_offsets=offsets_of(counts[~paying]),
        successors=number[left.successors],
        labels=labels,
        states=raw.states and [raw.states[k] for k in np.flatnonzero(~paying).tolist()],
    )


def _with_pairs(raw: RawModel, kept: BoolArray) -> RawModel:
    """Return a raw model with only the pairs in the mask ``kept``, [pairs]."""
    sizes = np.diff(raw.outcome_offsets)
    outcomes, state = np.repeat(kept, sizes), segment_ids(raw.pair_offsets)
    counts = np.bincount(state[kept], minlength=raw.pair_offsets.size - 1)
    return raw._replace(
        pair_offsets=offsets_of(counts),
        outcome_offsets=offsets_of(sizes[kept]),
        successors=raw.successors[outcomes],
        probabilities=raw.probabilities[outcomes],
        costs=raw.costs[outcomes],
        named_costs={name: costs[outcomes] for name, costs in raw.named_costs.items()},
        actions=raw.actions and [raw.actions[k] for k in np.flatnonzero(kept).tolist()],
    )


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model read from a file of another tool, and its start.

    Attributes:
        model: the model; its states are numbers, or tuples of numbers if the file names them.
        initial_states: the states that the file calls initial.
    """

    model: SSP
    initial_states: tuple[Hashable, ...]

    @property
    def start(self) -> Hashable:
        """The initial state.

        Raises:
            ModelError: the file names no initial state, or several.
        """
        if len(self.initial_states) != 1:
            raise ModelError(
                f"the file names {len(self.initial_states)} initial states: choose a start yourself"
            )
        return self.initial_states[0]


def finished(
    raw: RawModel, goal: str, source: object, dead_ends: DeadEnds | None = None
) -> ModelFile:
    """Build the model from a raw model, with the states of a label as goals.

    Actions of goal states are dropped. A state with the label "deadlock" that no action leaves
    becomes a dead-end without actions. States that only pay the rest of a cost are removed. Named
    costs that are negative or infinite somewhere are left out.

    Args:
        raw: content of the file, with consistent arrays.
        goal: the label of the goal states.
        source: the file, for errors.
        dead_ends: states from which no action reaches the goal, or labels of them ("deadlock" too);
            None: not checked.

    Raises:
        ModelError: no state has the label, wrong numbers, or another dead-end.
    """
    if goal not in raw.labels or not raw.labels[goal].size:
        listed = ", ".join(sorted(map(repr, raw.labels))) or "none"
        raise ModelError(f"{source}: no state has the label {goal!r}; labels: {listed}")
    raw = without_paying_states(raw, raw.labels[goal])
    goals = raw.labels[goal]
    idle, initial = (raw.labels.get(name, goals[:0]) for name in (DEADLOCK, INITIAL))
    state = segment_ids(raw.pair_offsets)
    from_state = np.repeat(state, np.diff(raw.outcome_offsets))
    leaves = np.zeros(raw.pair_offsets.size - 1, dtype=np.bool_)
    leaves[from_state[(raw.successors != from_state) & (raw.probabilities != 0.0)]] = True
    acts = np.ones_like(leaves)
    acts[idle] = leaves[idle]
    acts[goals] = False
    parts = _with_pairs(raw, acts[state])._asdict()
    costs, members = parts.pop("named_costs"), parts.pop("labels")
    states = range(acts.size) if raw.states is None else raw.states
    own = {INITIAL, DEADLOCK, goal, *ENDS}
    labels = {n: [states[k] for k in at.tolist()] for n, at in members.items() if n not in own}
    named = {n: c for n, c in costs.items() if (c >= 0.0).all() and np.isfinite(c).all()}
    try:
        model = SSP.from_arrays(
            **parts,
            goal_states=goals,
            state_labels=labels,
            named_costs=named,
            treat_actionless_as_dead_ends=True,
        )
    except ModelError as error:
        raise ModelError(f"{source}: ", *error.args) from error
    if dead_ends is not None:
        every = {DEADLOCK: [states[k] for k in idle.tolist()]}
        model.with_labels(every).with_dead_ends(dead_ends)
    return ModelFile(model, tuple(model.states[k] for k in initial.tolist()))


def distinct_actions(names: Sequence[str], pair_offsets: IntArray) -> Sequence[str]:
    """Return action names that are distinct in each state, [pairs].

    An unnamed action is named by its position in the state; a repeated name gets a number.
    """
    state = segment_ids(pair_offsets)
    position = np.arange(state.size) - pair_offsets[state]
    taken = dict[tuple[int, str], None]()
    for owner, place, given in zip(state.tolist(), position.tolist(), names, strict=True):
        name, count = given or str(place), 1
        while (owner, name) in taken:
            count += 1
            name = f"{given or place}#{count}"
        taken[owner, name] = None
    return [name for _, name in taken]


GOAL = "goal"

_OWN_ACTIONS = ("stay", PAY)
_BAD_LABEL = re.compile(r'["\\\x00-\x1f]|//')


def exported(model: SSP, start: Hashable) -> RawModel:
    """Return a model as a raw model for another tool, in which each action has one cost.

    If an outcome costs more than the cheapest outcome of its action, it leads to its successor
    through an extra state that pays the difference. The model's states come first, then the extra
    ones. Goal states and dead-ends get a loop. Names of actions and costs become words, distinct
    within a state and among costs. The successors of each pair are in increasing order.

    Args:
        model: the model.
        start: the state that is labelled "init".

    Raises:
        ModelError: the start is not a state, or a label cannot be written.
    """
    occurs = model.probabilities > 0.0
    pair = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))[occurs]
    by_name = model.costs_by_name
    successors, least, following, rests = _split_costs(model, by_name.values(), pair, occurs)
    idle = np.flatnonzero(np.diff(model.pair_offsets) == 0)
    # new numbers of the model's pairs, of the loops of states that had none, of those that pay
    own = np.arange(model.n_pairs) + np.searchsorted(idle, model.pair_state)
    loops = model.pair_offsets[idle] + np.arange(idle.size)
    paying = np.arange(len(rests)) + model.n_pairs + idle.size
    n_pairs = own.size + loops.size + paying.size
    pairs = np.concatenate([own[pair], loops, paying])
    targets = np.concatenate([successors, idle, following])
    chances = np.concatenate([model.probabilities[occurs], np.ones(loops.size + paying.size)])
    order = np.lexsort((targets, pairs))
    pairs, targets = pairs[order], targets[order]
    new = run_starts(pairs) | run_starts(targets)
    costs, code = np.zeros((n_pairs, len(by_name))), np.empty(n_pairs, dtype=np.int64)
    costs[own], costs[paying] = least, rests
    names = [*distinct_words(model.action_names), *_OWN_ACTIONS]
    code[own], code[loops], code[paying] = model.pair_action, len(names) - 2, len(names) - 1
    counts = np.concatenate([np.maximum(np.diff(model.pair_offsets), 1), np.ones_like(paying)])
    paid = costs[pairs[new]].T
    return RawModel(
        pair_offsets=offsets_of(counts),
        outcome_offsets=offsets_of(np.bincount(pairs[new], minlength=n_pairs)),
        successors=targets[new],
        probabilities=np.add.reduceat(chances[order], np.flatnonzero(new)),
        costs=paid[0],
        named_costs=dict(zip(distinct_words(list(by_name)), paid, strict=True)),
        actions=[names[k] for k in code.tolist()],
        labels=_exported_labels(model, start, idle, len(paying)),
    )


def costs_of_pairs(raw: RawModel) -> dict[str, FloatArray]:
    """Return the named costs of each pair of an exported model, [pairs] each."""
    return {name: costs[raw.outcome_offsets[:-1]] for name, costs in raw.named_costs.items()}


def _split_costs(
    model: SSP, costs: Iterable[FloatArray], pair: IntArray, occurs: BoolArray
) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
    """Split the costs of each pair's outcomes into the least cost and the rest.

    The pair pays the least cost. An outcome with a greater cost leads to its successor through an
    extra state, which pays the rest.

    Args:
        model: the model.
        costs: the model's costs, [outcomes of the model] each.
        pair: pair of each possible outcome, [possible outcomes].
        occurs: mask of the possible outcomes, [outcomes of the model].

    Returns:
        The next state of each possible outcome, its successor or an extra state, [possible
        outcomes]; the least costs of each pair, [pairs, costs]; the successor of each extra state,
        [extra states]; and the costs that the extra state pays, [extra states, costs].
    """
    successors = model.successors[occurs].astype(np.int64)
    paid = np.stack([each[occurs] for each in costs], axis=1)
    firsts = np.searchsorted(pair, np.arange(model.n_pairs))
    least = np.minimum.reduceat(paid, firsts) if paid.size else np.zeros((0, paid.shape[1]))
    late = np.flatnonzero((paid > least[pair]).any(axis=1))
    meant = dict(model.exact_costs) | {-cost: -exact for cost, exact in model.exact_costs.items()}
    both = zip(paid[late].T, -least[pair[late]].T, strict=True)
    rest = np.stack([decimal_sum(whole, part, meant) for whole, part in both], axis=1)
    following = successors[late]
    place: IntArray = following
    for column in rest.T:  # outcomes with equal successors and rests share a state that pays
        *_, place = _distinct_pairs(place.astype(np.float64), column)
    _, alone = np.unique(place, return_index=True)
    successors[late] = model.n_states + place
    return successors, least, following[alone], rest[alone]


def distinct_words(names: Sequence[Hashable], other: str = r"[^A-Za-z0-9_.+-]+") -> list[str]:
    """Return names as distinct words; characters that are not allowed become underscores.

    Args:
        names: the names.
        other: pattern of the characters that a word must not have.
    """
    taken: set[str] = set()
    words = []
    for position, name in enumerate(names):
        word = re.sub(other, "_", str(name)).strip("_") or "_"
        while word in taken:
            word += f"_{position}"
        taken.add(word)
        words.append(word)
    return words


def _exported_labels(
    model: SSP, start: Hashable, idle: IntArray, n_paying: int
) -> Mapping[str, IntArray]:
    """Return the labels of an exported model, including "init", "deadlock", "goal" and "paying"."""
    if isinstance(start, Mapping):
        raise ModelError("the file needs one start: name a state, or add one that draws the start")
    goals = np.flatnonzero(model.goal_mask)
    labels = {
        INITIAL: np.array([model.index_of(start)]),
        DEADLOCK: idle[~model.goal_mask[idle]],
        GOAL: goals,
    }
    for name, members in model.state_labels.items():
        if name in labels or not name or _BAD_LABEL.search(name):
            raise ModelError(f"the label {name!r} cannot be written: give it another name")
        labels[name] = members
    own = np.arange(n_paying) + model.n_states
    if n_paying:
        labels[PAYING] = np.concatenate([labels.get(PAYING, own[:0]), own])
    return labels


_MOST_DISTINCT = 100_000
"""Greatest number of distinct pairs of summands that are added exactly; more: as floats."""


def decimal_sum(
    one: FloatArray, other: FloatArray, exact: Mapping[float, Fraction] | None = None
) -> FloatArray:
    """Return the sums of two arrays of costs, exact up to one rounding, [numbers].

    Each float stands for its shortest decimal, such as 0.1, or for the fraction given by ``exact``.

    Args:
        one: first summands, [numbers].
        other: second summands, [numbers].
        exact: float -> the fraction that it stands for, such as 1/3.
    """
    if not (one.any() and other.any()):
        return one if one.any() else other
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return np.asarray(one + other)
    first, second, place = _distinct_pairs(one, other)
    if first.size > _MOST_DISTINCT:
        return np.asarray(one + other)
    meant = exact or {}
    sums = [
        float(sum(meant.get(value, Fraction(repr(value))) for value in pair))
        for pair in zip(first.tolist(), second.tolist(), strict=True)
    ]
    return np.array(sums)[place]


def _distinct_pairs(one: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return the distinct pairs (one[k], other[k]) of finite numbers, sorted.

    Args:
        one: [numbers].
        other: [numbers].

    Returns:
        The first and the second number of each distinct pair, and for each k the position of the
        pair (one[k], other[k]) among them, [numbers].
    """
    both = np.empty(one.size, dtype=np.complex128)  # one number: sorting rows is slow
    both.real, both.imag = one, other
    distinct, place = np.unique(both, return_inverse=True)
    return distinct.real.copy(), distinct.imag.copy(), place.reshape(-1)
