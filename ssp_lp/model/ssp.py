"""The stochastic shortest path model with dead-ends (paper, section 2.1)."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, read_only
from ssp_lp.errors import ModelError, in_short
from ssp_lp.model.arguments import explained
from ssp_lp.model.builders import (
    Outcomes,
    action_table,
    check_idle_states,
    check_offsets,
    check_outcomes,
    cost_array,
    flatten_successors,
    flatten_transitions,
    goal_mask_of,
    index_array,
    indexed_labels,
    unit_sums,
)
from ssp_lp.model.naming import Naming, check_state_names
from ssp_lp.model.predecessors import Graph


@dataclass(frozen=True, eq=False, repr=False)
class SSP(Graph, Naming):
    """A finite Markov decision process with goal states, in sparse state-action-pair form.

    Build it with :meth:`from_transitions`, :meth:`from_arrays` or :meth:`from_successors`, which
    check their input; the fields below are read-only afterwards. An *outcome* of a pair is
    (probability, successor, cost); two outcomes of a pair may share a successor and differ in
    cost. Goal states are absorbing and free (the paper's state 0): an episode ends there, so
    they have no pairs. A state without pairs that is no goal is a dead-end.
    """

    states: Sequence[Hashable]  # [states] labels
    action_names: Sequence[Hashable]  # the distinct action labels
    pair_action: IntArray  # [pairs] position in action_names
    costs: FloatArray  # [outcomes], finite and non-negative
    goal_mask: BoolArray  # [states]
    state_labels: Mapping[str, IntArray]  # label -> state indices; for reports only
    exact_costs: Mapping[float, Fraction]  # costs that were given as fractions

    @classmethod
    @explained
    def from_transitions(
        cls,
        transitions: Mapping[Hashable, Mapping[Hashable, Iterable[tuple[float, Hashable, float]]]],
        goal: Iterable[Hashable],
        *,
        state_labels: Mapping[str, Iterable[Hashable]] | None = None,
        treat_actionless_as_dead_ends: bool = False,
        normalise: bool = False,
    ) -> SSP:
        """Build a model from nested dicts ``{state: {action: [(probability, successor, cost)]}}``.

        Args:
            transitions: every state that is not a goal must be a key. Actions listed at a goal
                state are left out: the episode ends there.
            goal: the labels of the goal states.
            state_labels: names for sets of states ("wall"), used in reports.
            treat_actionless_as_dead_ends: accept states without actions that are not goals.
            normalise: divide out sums of probabilities that miss 1 by up to 1e-5.

        Returns:
            The model, with states numbered in the order of the keys, goals that are no keys last.

        Raises:
            ModelError: naming the state and the action at fault.

        Example:
            >>> model = SSP.from_transitions(
            ...     {"start": {"go": [(0.9, "goal", 1.0), (0.1, "pit", 1.0)]}, "pit": {}},
            ...     goal={"goal"}, treat_actionless_as_dead_ends=True)
            >>> model.n_states, model.n_pairs, model.n_outcomes
            (3, 1, 2)
        """
        return cls.from_arrays(
            **flatten_transitions(transitions, goal),
            state_labels=state_labels,
            treat_actionless_as_dead_ends=treat_actionless_as_dead_ends,
            normalise=normalise,
        )

    @classmethod
    @explained
    def from_successors(
        cls,
        start: Hashable | Iterable[Hashable],
        successors: Callable[[Any], Mapping[Hashable, Outcomes]],
        goal: Callable[[Any], bool] | Iterable[Hashable],
        *,
        state_limit: int = 1_000_000,
        progress: Callable[[int], None] | None = None,
        state_labels: Mapping[str, Callable[[Any], bool]] | None = None,
        treat_actionless_as_dead_ends: bool = False,
        normalise: bool = False,
    ) -> SSP:
        """Explore a successor function breadth-first from the start and build the model.

        Args:
            start: a state, or a list or set of states, to explore from.
            successors: maps a state to ``{action: [(probability, successor, cost), ...]}``.
            goal: a predicate on states, or the goal states.
            state_limit: raise when more states than this are found.
            progress: called now and then with the number of states found so far.
            state_labels: label -> predicate on states.
            treat_actionless_as_dead_ends: accept states without actions that are not goals.
            normalise: divide out sums of probabilities that miss 1 by up to 1e-5.

        Raises:
            ModelError: naming the state and the action at fault, or that the limit was passed.
        """
        flat = flatten_successors(start, successors, goal, state_limit, progress)
        marked = {
            name: [s for s in flat["states"] if holds(s)]
            for name, holds in (state_labels or {}).items()
        }
        return cls.from_arrays(
            **flat,
            state_labels=marked,
            treat_actionless_as_dead_ends=treat_actionless_as_dead_ends,
            normalise=normalise,
        )

    @classmethod
    @explained
    def from_arrays(
        cls,
        *,
        pair_offsets: npt.ArrayLike,
        outcome_offsets: npt.ArrayLike,
        successors: npt.ArrayLike,
        probabilities: npt.ArrayLike,
        costs: npt.ArrayLike,
        goal_states: npt.ArrayLike,
        states: Sequence[Hashable] | None = None,
        actions: Sequence[Hashable] | None = None,
        state_labels: Mapping[str, Iterable[Hashable]] | None = None,
        exact_costs: Mapping[float, Fraction] | None = None,
        treat_actionless_as_dead_ends: bool = False,
        normalise: bool = False,
    ) -> SSP:
        """Build a model from CSR arrays; those of the right type are kept, not copied.

        Args:
            pair_offsets: [states + 1]; the pairs of state s are ``pair_offsets[s] :
                pair_offsets[s + 1]``.
            outcome_offsets: [pairs + 1]; the outcomes of pair k, likewise.
            successors: [outcomes], indices of states.
            probabilities: [outcomes].
            costs: one number, or one per pair, or one per outcome.
            goal_states: indices of the goal states, which must have no pairs.
            states: labels of the states; their indices if left out.
            actions: [pairs] labels of the actions; their position within the state if left out.
            state_labels: names for sets of states, given by their labels.
            exact_costs: the fraction meant by a float cost such as 1/3; others mean their
                shortest decimal. It decides the lattice of accumulated costs.
            treat_actionless_as_dead_ends: accept states without pairs that are not goals.
            normalise: divide out sums of probabilities that miss 1 by up to 1e-5, such as those
                of single precision; else 1e-9 is the limit.

        Raises:
            ModelError: naming the state and the action at fault.
        """
        draft = cls._draft(pair_offsets, outcome_offsets, goal_states, states, actions)
        n_outcomes = int(draft.outcome_offsets[-1])
        target = index_array("successors", successors)
        chance = read_only(probabilities, np.float64)
        if target.shape != (n_outcomes,) or chance.shape != (n_outcomes,):
            raise ModelError(f"successors and probabilities must have length {n_outcomes}")
        stage_cost = cost_array(costs, draft.outcome_offsets)
        check_outcomes(target, chance, stage_cost, draft.n_states, draft._describe_outcome)
        chance = unit_sums(chance, draft.outcome_offsets, draft.describe_pair, normalise=normalise)
        check_idle_states(
            draft.pair_offsets, draft.goal_mask, draft.states, treat_actionless_as_dead_ends
        )
        return replace(
            draft,
            successors=read_only(target, np.int32),
            probabilities=read_only(chance),
            costs=stage_cost,
            state_labels=indexed_labels(state_labels or {}, draft.index_of),
            exact_costs=dict(exact_costs or {}),
        )

    @classmethod
    def _draft(
        cls,
        pair_offsets: npt.ArrayLike,
        outcome_offsets: npt.ArrayLike,
        goal_states: npt.ArrayLike,
        states: Sequence[Hashable] | None,
        actions: Sequence[Hashable] | None,
    ) -> SSP:
        """A model without outcomes: enough to name states and actions while checking the rest."""
        pairs = read_only(index_array("pair_offsets", pair_offsets), np.int64)
        outcomes = read_only(index_array("outcome_offsets", outcome_offsets), np.int64)
        n_states, n_pairs = pairs.size - 1, outcomes.size - 1
        check_offsets("pair_offsets", pairs, n_pairs)
        check_offsets("outcome_offsets", outcomes, int(outcomes[-1]) if outcomes.size else 0)
        names = range(n_states) if states is None else states
        if len(names) != n_states:
            raise ModelError(f"{len(names)} state labels given for {n_states} states")
        check_state_names(names)
        action_names, pair_action = action_table(actions, pairs)
        nothing = read_only(np.zeros(0))
        return cls(
            states=names,
            action_names=action_names,
            pair_action=read_only(pair_action),
            pair_offsets=pairs,
            outcome_offsets=outcomes,
            successors=nothing.astype(np.int32),
            probabilities=nothing,
            costs=nothing,
            goal_mask=goal_mask_of(goal_states, n_states),
            state_labels={},
            exact_costs={},
        )

    @cached_property
    def kept_facts(self) -> dict[str, Any]:
        """What was found out about the model's graph, by name (``ssp_lp.model.graph``)."""
        return {}


def check_model(model: object, verb: str) -> None:
    """Check that what should be a model is one.

    Raises:
        ModelError: a problem or something else; ``verb`` is what was to be done with it.
    """
    if not isinstance(model, SSP):
        told = "; it has one: .model" if isinstance(getattr(model, "model", None), SSP) else ""
        raise ModelError(f"{verb} takes an SSP, not {in_short(model)}{told}")
