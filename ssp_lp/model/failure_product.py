"""The product of a model with the failure label: runs continue after the goal is lost.

This product is built for a problem that counts quantities after failing. Its states are (x, "before
failing") and (x, "after failing"), where x is a state of the model; the paper's augmented MDP
(section 3.1.2) calls them (x, s) and (x, f). After failing a run continues to its true end. The
step that fails changes the label: in a dead-end every action does. In an attention state each
action that avoids the goal exists twice: as it is, and with giving up, which changes the label.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, entries_of, offsets_of, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model.graph import (
    dead_ends,
    end_components,
    end_marks,
    reaching_states,
    surely_ending,
)
from ssp_lp.model.product import ProductSSP, ProductStates, copied_parts
from ssp_lp.model.ssp import SSP

BEFORE: Final = "before failing"
"""Memory of a run that has not failed: the paper's label s."""

AFTER: Final = "after failing"
"""Memory of a run that has failed and continues: the paper's label f."""

GIVING_UP: Final = "give up"
"""First part of the name of an action taken together with giving up: ("give up", action)."""


@dataclass(frozen=True, eq=False, repr=False)
class FailureSSP(ProductSSP):
    """A model whose states are (state, failure label); see :func:`label_failing`.

    With n states in the original model, state k is original state k before failing, and state
    ``n + k`` is original state k after failing.
    """

    open_pairs: BoolArray = field(kw_only=True)  # [original pairs] that may be taken after failing
    stops: BoolArray = field(kw_only=True)  # [states] where giving up ends the run
    charged: BoolArray = field(kw_only=True)
    """Mask of pairs; failing in a state costs as much as its cheapest one, [original pairs]."""
    free_pairs: BoolArray = field(kw_only=True)  # [2, original pairs] before and after failing
    charges: bool = field(kw_only=True, default=False)  # whether failing costs anything
    original_pair: IntArray = field(kw_only=True)  # [pairs]
    fails: BoolArray = field(kw_only=True)  # [pairs] that take the label

    @property
    def failure_label(self) -> FailureSSP:
        """The product itself, since its states have the failure label."""
        return self

    @property
    def n_original(self) -> int:
        """Number of states of the original model, which has no failure label."""
        return self.original.n_states

    @cached_property
    def original_outcome(self) -> IntArray:
        """Original outcome from which each outcome of the product is copied, [outcomes]."""
        return np.asarray(entries_of(self.original.outcome_offsets, self.original_pair)[0])

    @cached_property
    def is_open(self) -> BoolArray:
        """Mask of original states in which a run goes on after failing, [original states]."""
        counts = np.bincount(self.original.pair_state[self.open_pairs], minlength=self.n_original)
        return np.asarray(counts > 0)

    @cached_property
    def after(self) -> BoolArray:
        """Mask of states with the label "after failing", [states]."""
        return np.repeat([False, True], self.n_original)

    @cached_property
    def lost(self) -> BoolArray:
        """Mask of states "before failing" whose original state is a dead-end, [states]."""
        dead = dead_ends(self.original)
        return np.append(dead, np.zeros_like(dead))

    @cached_property
    def ended(self) -> BoolArray:
        """Mask of states in which a run is over without the goal, [states]."""
        return (self.lost | self.after) & ~np.tile(self.is_open, 2)

    @cached_property
    def stop_marks(self) -> IntArray:
        """Number that says how a run ends if it stops in a state (``graph.end_marks``), [states].

        In a dead-end the number is that of the dead-end, elsewhere that of giving up.
        """
        marks, gave_up = end_marks(self.original), len(self.state_labels) + 2
        return np.tile(np.where(dead_ends(self.original), marks, gave_up), 2)

    @cached_property
    def end_marks(self) -> IntArray:
        """Number that says how a run ends in a state (``graph.end_marks``), [states]."""
        return np.where(self.goal_mask, 0, np.where(self.ended, self.stop_marks, -1))

    @cached_property
    def priced(self) -> BoolArray:
        """Mask of the pairs by whose costs failing is charged, [pairs].

        Failing in a state costs as much as the cheapest of these pairs of the state.
        """
        before = ~np.append(self.is_open, np.ones(self.n_original, dtype=np.bool_))
        return self.fails | (before[self.pair_state] & self.charged[self.original_pair])

    @cached_property
    def finite(self) -> tuple[BoolArray, BoolArray]:
        """States from which some policy keeps all quantities finite, and the pairs it may use.

        After failing a run may never end, and quantities that are counted for ever are infinite.

        Returns:
            Mask of the states, [states], and of the pairs that never lead out of them, [pairs].
        """
        over = self.ended | self.goal_mask | self.stops
        over[self.pair_state[self._staying]] = True
        return surely_ending(self, over, ~reaching_states(self, over))[:2]

    @cached_property
    def _staying(self) -> BoolArray:
        """Mask of pairs that a run may repeat for ever without adding to any quantity, [pairs]."""
        going = ~self.ended & ~self.goal_mask
        failed = self.fails | self.after[self.pair_state]
        free = self.free_pairs[failed.astype(np.int64), self.original_pair]
        return end_components(self, free & going[self.pair_state])[1]

    @property
    def staying_after(self) -> IntArray:
        """Original pairs that a failed run may repeat for ever without adding to a quantity."""
        return self.original_pair[self._staying & self.after[self.pair_state]]

    def placed(self, states: IntArray, pairs: IntArray) -> IntArray:
        """Return the product's pair by which a state takes an original pair; -1: none, [entries].

        In a dead-end before failing this is the pair that changes the label. In all other states it
        is the pair that keeps the label.

        Args:
            states: states of the product, [entries].
            pairs: original pair to take in each of these states, [entries].
        """
        taking = self.lost[states] & self.is_open[self.original_state[states]]
        return np.asarray(self._places[self.after[states] + 2 * taking, pairs])

    def giving_up_by(self, pairs: IntArray) -> IntArray:
        """Return each original pair's copy in the product that also declares failure, [entries].

        It is -1 where failure cannot be declared.
        """
        return np.asarray(self._places[2, pairs])

    @cached_property
    def _places(self) -> IntArray:
        """Product's copies of each original pair; -1: none, [3, original pairs].

        The rows are the copy before failing that keeps the label, the copy after failing, and the
        copy that changes the label.
        """
        places = np.full((3, self.original.n_pairs), -1, dtype=np.int64)
        kind = np.where(self.fails, 2, self.after[self.pair_state].astype(np.int64))
        places[kind, self.original_pair] = np.arange(self.n_pairs)
        return places

    def moved(self, pairs: IntArray, successors: IntArray, costs: FloatArray) -> IntArray:
        """Return the states after steps, [episodes]; see :meth:`ProductSSP.moved`."""
        failed = self.fails[pairs] | self.after[self.pair_state[pairs]]
        return np.asarray(successors + self.n_original * failed)

    def spread_costs(
        self, costs: FloatArray, charge: FloatArray, *, through: bool = False
    ) -> FloatArray:
        """Return the costs of the product's outcomes, [outcomes], given the costs of the original.

        The step that fails costs the charge instead of its own cost, and later steps cost nothing.

        Args:
            costs: costs of the original's outcomes, [original outcomes].
            charge: cost of failing in each state in which a run goes on, [original states].
            through: count all steps at their original costs, also after failing, without a charge.
        """
        counted = costs[self.original_outcome]
        if through:
            return counted
        counts = np.diff(self.outcome_offsets)
        charged = np.where(self.fails, charge[self.original_state[self.pair_state]], 0.0)
        free = self.fails | self.after[self.pair_state]
        return np.where(np.repeat(free, counts), np.repeat(charged, counts), counted)


def label_failing(
    model: SSP, open_pairs: BoolArray, stops: BoolArray, charged: BoolArray, free_pairs: BoolArray
) -> FailureSSP:
    """Build the product with the failure label, in which runs continue after failing.

    Args:
        model: the model.
        open_pairs: mask of the pairs that may be taken after failing, all in dead-ends and
            attention states, [pairs].
        stops: mask of states in which giving up ends the run, [states].
        charged: mask of pairs; failing in a state costs as much as the cheapest of its pairs in the
            mask, [pairs].
        free_pairs: mask of pairs that add to no quantity, before and after failing, [2, pairs].
    """
    n, state = model.n_states, model.pair_state
    is_open = np.bincount(state[open_pairs], minlength=n) > 0
    taking = np.flatnonzero(open_pairs)  # with the label, first in their states: ties give up
    plain = np.flatnonzero(~(dead_ends(model) & is_open)[state])
    before = np.concatenate([taking, plain])
    before_fails = np.arange(before.size) < taking.size
    order = np.lexsort((before, ~before_fails, state[before]))
    original_pair = np.concatenate([before[order], taking])
    fails = np.append(before_fails[order], np.zeros(taking.size, dtype=np.bool_))
    after = np.arange(original_pair.size) >= before.size
    outcome, lengths = entries_of(model.outcome_offsets, original_pair)
    failed = np.repeat(fails | after, lengths)
    gives_up = fails & ~dead_ends(model)[state[original_pair]]
    names = model.action_names
    own = model.pair_action[original_pair].astype(np.int64)
    label, original_state = (read_only(part) for part in np.divmod(np.arange(2 * n), n))
    pair_offsets = offsets_of(np.bincount(state[original_pair] + n * after, minlength=2 * n))
    graph = pair_offsets, offsets_of(lengths), model.successors[outcome] + n * failed
    parts = copied_parts(model, *graph, original_pair, outcome) | {
        "action_names": (*names, *((GIVING_UP, name) for name in names)),
        "pair_action": read_only(own + len(names) * gives_up),
    }
    return FailureSSP(
        **parts,
        states=ProductStates(model.states, (BEFORE, AFTER), original_state, label),
        goal_mask=read_only(np.append(model.goal_mask, np.zeros(n, dtype=np.bool_))),
        state_labels={
            name: read_only(np.append(members, members + n))
            for name, members in model.state_labels.items()
        },
        is_hidden=True,
        open_pairs=read_only(open_pairs),
        stops=read_only(np.append(stops, np.zeros(n, dtype=np.bool_))),
        charged=read_only(charged),
        free_pairs=read_only(free_pairs),
        original_pair=read_only(original_pair),
        fails=read_only(fails),
    )


def check_label(model: SSP) -> FailureSSP:
    """Return the model, checked to be a product with the failure label.

    Raises:
        ModelError: it is another model.
    """
    if model.failure_label is None:
        raise ModelError("no actions after failing exist, because the problem counts nothing there")
    return model.failure_label
