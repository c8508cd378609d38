"""What a model file of another tool holds, and how it becomes a model."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, offsets_of
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.decimals import decimal_sum
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
    :func:`ssp_lp.io.model_files.exported.exported` makes where the outcomes of an action differ in
    cost. What is counted until a failure then holds the whole step again.

    Args:
        raw: what a file says.
        goals: the goal states.
    """
    paying = _paying_in_raw_model(raw, goals)
    if not paying.any() or not (raw.costs >= 0.0).all():  # no sum may hide a wrong cost
        return raw
    sizes = np.diff(raw.outcome_offsets)
    # each paying state's one outcome, at other states anything
    firsts = np.minimum(raw.outcome_offsets[raw.pair_offsets[:-1]], raw.successors.size - 1)
    through = paying[raw.successors]
    rest = np.where(through, raw.costs[firsts[raw.successors]], 0.0)
    targets = np.where(through, raw.successors[firsts[raw.successors]], raw.successors)
    costs = decimal_sum(raw.costs, rest, raw.exact_costs)
    number = np.cumsum(~paying) - 1
    counts = np.diff(raw.pair_offsets)
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


def _paying_in_raw_model(raw: RawModel, goals: IntArray) -> BoolArray:
    """Which states do nothing but pay, [states]."""
    n_states = raw.pair_offsets.size - 1
    paying = np.zeros(n_states, dtype=np.bool_)
    marked = raw.labels.get(PAYING)
    if marked is None or raw.actions is None:
        return paying
    paying[marked] = True
    paying[goals] = False
    paying[raw.labels.get(INITIAL, goals)] = False
    for state in np.flatnonzero(paying).tolist():
        pair, end = raw.pair_offsets[state : state + 2].tolist()
        paying[state] = (
            end == pair + 1 and raw.actions[pair] == PAY and _is_certain_in_raw_model(raw, pair)
        )
    marked = np.flatnonzero(paying)
    followed = raw.successors[raw.outcome_offsets[raw.pair_offsets[marked]]]
    paying[marked[paying[followed]]] = False  # none pays for another
    return paying


def _is_certain_in_raw_model(raw: RawModel, pair: int) -> bool:
    """Whether a pair has one outcome."""
    first, end = raw.outcome_offsets[pair : pair + 2].tolist()
    return bool(end == first + 1 and raw.probabilities[first] == 1.0)


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
    acts[idle] = _leaves_in_raw_model(raw, state, n_states)[idle]
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


def _leaves_in_raw_model(raw: RawModel, state: IntArray, n_states: int) -> BoolArray:
    """Whether some outcome of positive probability leaves each state, [states]."""
    source = np.repeat(state, np.diff(raw.outcome_offsets))
    away = (raw.successors != source) & (raw.probabilities != 0.0)
    leaves = np.zeros(n_states, dtype=np.bool_)
    leaves[source[away]] = True
    return leaves


def distinct_actions(names: Sequence[str], pair_state: IntArray) -> Sequence[str]:
    """Action names of a raw model, distinct in each state: a repeat gets a number, [pairs]."""
    table: dict[str, int] = {}
    code = np.array([table.setdefault(name, len(table)) for name in names], dtype=np.int64)
    order = np.lexsort((code, pair_state))
    again = (np.diff(pair_state[order]) == 0) & (np.diff(code[order]) == 0)
    if not again.any():
        return names
    distinct, taken = list(names), set(zip(pair_state.tolist(), names, strict=True))
    counts: dict[tuple[int, str], int] = {}
    for pair in np.sort(order[1:][again]):
        key = (int(pair_state[pair]), names[pair])
        count = counts.get(key, 2)
        while (key[0], f"{key[1]}#{count}") in taken:
            count += 1
        counts[key] = count + 1
        distinct[pair] = f"{key[1]}#{count}"
        taken.add((key[0], distinct[pair]))
    return distinct
