"""How what a model file of another tool holds becomes a model."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.paying import without_paying_states
from ssp_lp.io.model_files.raw_model import DEADLOCK, INITIAL, RawModel, offsets_of
from ssp_lp.model import SSP
from ssp_lp.model.labels import ENDS


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
        """The one initial state.

        Raises:
            ModelError: the file names none, or several.
        """
        if len(self.initial_states) != 1:
            raise ModelError(
                f"the file names {len(self.initial_states)} initial states: choose a start yourself"
            )
        return self.initial_states[0]


def finished(raw: RawModel, goal: str, source: object) -> ModelFile:
    """Make the model whose goal states bear a label.

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
    """Make a model of which goal states, and idle ones that no action leaves, have no actions.

    Raises:
        ModelError: naming the source, the state and the action at fault.
    """
    n_states = raw.pair_offsets.size - 1
    state = np.repeat(np.arange(n_states), np.diff(raw.pair_offsets))
    sizes = np.diff(raw.outcome_offsets)
    acts = np.ones(n_states, dtype=np.bool_)
    acts[idle] = _leaves(raw, state, n_states)[idle]
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
        raise ModelError(f"{source}: {error}") from error


def _leaves(raw: RawModel, state: IntArray, n_states: int) -> BoolArray:
    """Whether some outcome of positive probability leaves each state, [states]."""
    source = np.repeat(state, np.diff(raw.outcome_offsets))
    away = (raw.successors != source) & (raw.probabilities != 0.0)
    leaves = np.zeros(n_states, dtype=np.bool_)
    leaves[source[away]] = True
    return leaves


def distinct_actions(names: Sequence[str], pair_state: IntArray) -> Sequence[str]:
    """Action names that differ within each state: a repeated one gets a number, [pairs]."""
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
