"""Models as other tools state them: what a file holds, how it becomes a model, and the way back."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, offsets_of
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.checked_arrays import ENDS

INITIAL, DEADLOCK, PAYING = "init", "deadlock", "paying"
"""Labels that the files give a meaning: initial states, dead-ends, and states between outcomes
and their successors that pay what the action has not paid yet."""

PAY = "pay"
"""The action of those states."""


class RawModel(NamedTuple):
    """A model as a file states it: goal states may act, and every state may."""

    pair_offsets: IntArray  # [states + 1]
    outcome_offsets: IntArray  # [pairs + 1]
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes]
    costs: FloatArray  # [outcomes]
    actions: Sequence[Hashable] | None  # [pairs]
    labels: Mapping[str, IntArray]  # label -> states
    states: Sequence[Hashable] | None = None
    exact_costs: Mapping[float, Fraction] | None = None


def without_paying_states(raw: RawModel, goals: IntArray) -> RawModel:
    """Give outcomes the cost that is paid in a state of its own.

    Such a state has the label "paying", one action, "pay", and one certain successor; it is what
    :func:`exported` makes where the outcomes of an action differ in cost. What is counted until a
    failure then holds the whole step again.

    Args:
        raw: what a file says.
        goals: the goal states.
    """
    counts, sizes = np.diff(raw.pair_offsets), np.diff(raw.outcome_offsets)
    none, acts = np.zeros(0, dtype=np.int64), raw.actions or ()
    labelled = np.zeros(counts.size, dtype=np.bool_)
    labelled[raw.labels.get(PAYING, none)] = raw.actions is not None
    labelled[goals] = labelled[raw.labels.get(INITIAL, none)] = False
    alone = np.flatnonzero(labelled & (counts == 1))
    alone = alone[sizes[raw.pair_offsets[alone]] == 1]
    pair = raw.pair_offsets[alone]
    outcome = raw.outcome_offsets[pair]
    pays = np.array([acts[k] == PAY for k in pair.tolist()], dtype=np.bool_)
    pays &= raw.probabilities[outcome] == 1.0
    paying = np.zeros(counts.size, dtype=np.bool_)
    paying[alone[pays]] = True
    paying[alone[pays & paying[raw.successors[outcome]]]] = False  # none pays for another
    if not paying.any() or not (raw.costs >= 0.0).all():  # no sum may hide a wrong cost
        return raw
    # each paying state's one outcome, at other states anything
    firsts = np.minimum(raw.outcome_offsets[raw.pair_offsets[:-1]], raw.successors.size - 1)
    through = paying[raw.successors]
    rest = np.where(through, raw.costs[firsts[raw.successors]], 0.0)
    targets = np.where(through, raw.successors[firsts[raw.successors]], raw.successors)
    costs = decimal_sum(raw.costs, rest, raw.exact_costs)
    number = np.cumsum(~paying) - 1
    pairs = np.repeat(~paying, counts)
    outcomes = np.repeat(pairs, sizes)
    labels = {name: number[at[~paying[at]]] for name, at in raw.labels.items()}
    if not labels[PAYING].size:
        del labels[PAYING]
    kept = np.flatnonzero(~paying).tolist()
    return raw._replace(
        pair_offsets=offsets_of(counts[~paying]),
        outcome_offsets=offsets_of(sizes[pairs]),
        successors=number[targets[outcomes]],
        probabilities=raw.probabilities[outcomes],
        costs=costs[outcomes],
        actions=raw.actions and [raw.actions[k] for k in np.flatnonzero(pairs).tolist()],
        labels=labels,
        states=raw.states and [raw.states[k] for k in kept],
    )


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model read from a file of another tool, and where it starts.

    Attributes:
        model: the model; its states are numbers, or tuples of numbers where the file names them.
        initial_states: the states that the file calls initial.
    """

    model: SSP
    initial_states: tuple[Hashable, ...]

    @property
    def start(self) -> Hashable:
        """The one initial state of a file's raw model.

        Raises:
            ModelError: the file names none, or several.
        """
        if len(self.initial_states) != 1:
            raise ModelError(
                f"the file names {len(self.initial_states)} initial states: choose a start yourself"
            )
        return self.initial_states[0]


def finished(raw: RawModel, goal: str, source: object) -> ModelFile:
    """Make a model of a raw one whose goal states bear a label.

    Actions of goal states are dropped, and of states with the label "deadlock" that no action
    leaves: they are dead-ends. States that only pay what an action has not paid are taken out.

    Args:
        raw: what the file says; its arrays are consistent.
        goal: the label of the goal states.
        source: the file, for errors.

    Raises:
        ModelError: no state bears the label, or the numbers make no model.
    """
    goals = raw.labels.get(goal)
    if goals is None or not goals.size:
        known = ", ".join(sorted(map(repr, raw.labels))) or "none"
        raise ModelError(f"{source}: no state has the label {goal!r}; labels: {known}")
    raw = without_paying_states(raw, goals)
    goals = raw.labels[goal]
    own = {INITIAL, DEADLOCK, goal, *ENDS}
    kept = {name: members for name, members in raw.labels.items() if name not in own}
    none = np.zeros(0, dtype=np.int64)
    idle = raw.labels.get(DEADLOCK, none)
    model = absorbed(raw._replace(labels=kept), goals, idle, str(source))
    initial = raw.labels.get(INITIAL, none)
    return ModelFile(model, tuple(model.states[int(state)] for state in initial))


def absorbed(raw: RawModel, goals: IntArray, idle: IntArray, source: str) -> SSP:
    """Make a raw model's goal states, and idle ones that no action leaves, have no actions.

    Raises:
        ModelError: naming the source, the state and the action at fault.
    """
    n_states = raw.pair_offsets.size - 1
    state = np.repeat(np.arange(n_states), np.diff(raw.pair_offsets))
    sizes = np.diff(raw.outcome_offsets)
    acts = np.ones(n_states, dtype=np.bool_)
    from_state = np.repeat(state, sizes)
    leaves = np.zeros(n_states, dtype=np.bool_)
    leaves[from_state[(raw.successors != from_state) & (raw.probabilities != 0.0)]] = True
    acts[idle] = leaves[idle]
    acts[goals] = False
    pair_kept = acts[state]
    kept = np.repeat(pair_kept, sizes)
    states = range(n_states) if raw.states is None else raw.states
    actions = raw.actions
    if actions is not None and not pair_kept.all():
        actions = [actions[k] for k in np.flatnonzero(pair_kept).tolist()]
    counts = np.bincount(state[pair_kept], minlength=n_states)
    try:
        return SSP.from_arrays(
            pair_offsets=offsets_of(counts),
            outcome_offsets=offsets_of(sizes[pair_kept]),
            successors=raw.successors[kept],
            probabilities=raw.probabilities[kept],
            costs=raw.costs[kept],
            goal_states=goals,
            states=raw.states,
            actions=actions,
            state_labels={
                name: [states[i] for i in at.tolist()] for name, at in raw.labels.items()
            },
            exact_costs=raw.exact_costs,
            treat_actionless_as_dead_ends=True,
        )
    except ModelError as error:
        raise ModelError(f"{source}: ", *error.args) from error


def distinct_actions(names: Sequence[str], pair_state: IntArray) -> Sequence[str]:
    """Action names of a raw model, distinct in each state: a repeat gets a number, [pairs]."""
    table: dict[str, int] = {}
    code = np.array([table.setdefault(name, len(table)) for name in names], dtype=np.int64)
    if np.unique(pair_state * len(table) + code).size == code.size:
        return names
    taken, counts = set(zip(pair_state.tolist(), names, strict=True)), Counter[tuple[int, str]]()
    distinct = []
    for state, name in zip(pair_state.tolist(), names, strict=True):
        counts[state, name] += 1
        own = name
        while counts[state, name] > 1 and (state, own) in taken:
            own = f"{name}#{counts[state, name]}"
            counts[state, name] += (state, own) in taken
        taken.add((state, own))
        distinct.append(own)
    return distinct


GOAL = "goal"

_OWN_ACTIONS = ("stay", PAY)
_BAD_LABEL = re.compile(r'["\\\x00-\x1f]|//')


class Exported(NamedTuple):
    """A Markov decision process with a cost for each action.

    Its states are those of the model, then states that pay: an outcome that costs more than the
    cheapest of its action leads to its successor through one that pays what is missing. Goal
    states and dead-ends stay where they are.
    """

    pair_offsets: IntArray  # [states + 1]
    outcome_offsets: IntArray  # [pairs + 1]
    successors: IntArray  # [outcomes], rising within each pair
    probabilities: FloatArray  # [outcomes]
    costs: FloatArray  # [pairs]
    actions: Sequence[str]  # [pairs] words, distinct within each state
    labels: Mapping[str, IntArray]  # label -> states
    choice_of_pair: IntArray  # [pairs of the model]
    target_of_outcome: IntArray  # [outcomes of the model] the next state; -1: it never occurs

    def pairs(self) -> Iterator[tuple[int, int, int, float, list[tuple[int, float]]]]:
        """State, number in it, pair, cost, and the successors with their probabilities."""
        ends, pair = self.outcome_offsets.tolist(), 0
        for state, (begin, end) in enumerate(pairwise(self.pair_offsets.tolist())):
            for pair in range(begin, end):
                some = slice(ends[pair], ends[pair + 1])
                chances = self.probabilities[some].tolist()
                moves = list(zip(self.successors[some].tolist(), chances, strict=True))
                yield state, pair - begin, pair, float(self.costs[pair]), moves


def exported(model: SSP, start: Hashable) -> Exported:
    """Rewrite a model for another tool.

    Args:
        model: the model.
        start: the state that is labelled "init".

    Raises:
        ModelError: the start is no state, or a label cannot be written.
    """
    occurs = model.probabilities > 0.0
    pair = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))[occurs]
    successors, least, following, rests = _split_costs(model, pair, occurs)
    idle = np.flatnonzero(np.diff(model.pair_offsets) == 0)
    # new numbers of the model's pairs, of the loops of states that had none, of those that pay
    own = np.arange(model.n_pairs) + np.searchsorted(idle, model.pair_state)
    loops = model.pair_offsets[idle] + np.arange(idle.size)
    paying = np.arange(rests.size) + model.n_pairs + idle.size
    n_pairs = own.size + loops.size + paying.size
    pairs = np.concatenate([own[pair], loops, paying])
    targets = np.concatenate([successors, idle, following])
    chances = np.concatenate([model.probabilities[occurs], np.ones(loops.size + paying.size)])
    order = np.lexsort((targets, pairs))
    pairs, targets = pairs[order], targets[order]
    new = (np.diff(pairs, prepend=-1) != 0) | (np.diff(targets, prepend=-1) != 0)
    costs, code = np.zeros(n_pairs), np.empty(n_pairs, dtype=np.int64)
    costs[own], costs[paying] = least, rests
    names = [*_exported_words(model.action_names), *_OWN_ACTIONS]
    code[own], code[loops], code[paying] = model.pair_action, len(names) - 2, len(names) - 1
    counts = np.concatenate([np.maximum(np.diff(model.pair_offsets), 1), np.ones_like(paying)])
    next_state = np.full(model.n_outcomes, -1, dtype=np.int64)
    next_state[occurs] = successors
    return Exported(
        pair_offsets=offsets_of(counts),
        outcome_offsets=offsets_of(np.bincount(pairs[new], minlength=n_pairs)),
        successors=targets[new],
        probabilities=np.add.reduceat(chances[order], np.flatnonzero(new)),
        costs=costs,
        actions=[names[k] for k in code.tolist()],
        labels=_exported_labels(model, start, idle, paying.size),
        choice_of_pair=own,
        target_of_outcome=next_state,
    )


def _split_costs(
    model: SSP, pair: IntArray, occurs: BoolArray
) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
    """Split the costs of outcomes: the least of the pair at once, the rest on the way.

    Args:
        model: the model.
        pair: of each outcome that occurs, [outcomes].
        occurs: [outcomes of the model].

    Returns:
        The next state of each outcome, [outcomes]; the cost of each pair, [pairs]; and of each
        state that pays the one that follows and what it pays, [paying].
    """
    successors, costs = model.successors[occurs].astype(np.int64), model.costs[occurs]
    firsts = np.searchsorted(pair, np.arange(model.n_pairs))
    least = np.minimum.reduceat(costs, firsts) if costs.size else np.zeros(0)
    late = np.flatnonzero(costs > least[pair])
    meant = dict(model.exact_costs) | {-cost: -exact for cost, exact in model.exact_costs.items()}
    rest = decimal_sum(costs[late], -least[pair[late]], meant)
    following, rests, kind = _distinct_pairs(successors[late].astype(np.float64), rest)
    successors[late] = model.n_states + kind
    return successors, least, following.astype(np.int64), rests


def _exported_words(names: Sequence[Hashable]) -> list[str]:
    """Names as distinct words of letters, digits and a few signs."""
    taken: set[str] = set()
    words = []
    for position, name in enumerate(names):
        word = re.sub(r"[^A-Za-z0-9_.+-]+", "_", str(name)).strip("_") or "_"
        while word in taken:
            word += f"_{position}"
        taken.add(word)
        words.append(word)
    return words


def _exported_labels(
    model: SSP, start: Hashable, idle: IntArray, n_paying: int
) -> Mapping[str, IntArray]:
    """The labels of the model, and those that the files give a meaning."""
    if isinstance(start, Mapping):
        raise ModelError("such files begin in one state: name it, or add one that draws the start")
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
"""Distinct pairs of summands beyond which sums are rounded as floats are."""


def decimal_sum(
    one: FloatArray, other: FloatArray, exact: Mapping[float, Fraction] | None = None
) -> FloatArray:
    """Add two arrays of one shape, each number meaning its shortest decimal.

    Args:
        one: [numbers].
        other: [numbers].
        exact: the fraction meant by a float such as 1/3.

    Returns:
        The floats next to the exact sums, [numbers].
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
    """The distinct pairs of finite numbers, sorted.

    Args:
        one: [numbers].
        other: [numbers].

    Returns:
        The first and the second number of each distinct pair, and the place of each given pair
        among them, [numbers].
    """
    both = np.empty(one.size, dtype=np.complex128)  # as one number: sorting rows is slow
    both.real, both.imag = one, other
    distinct, place = np.unique(both, return_inverse=True)
    return distinct.real.copy(), distinct.imag.copy(), place.reshape(-1)
