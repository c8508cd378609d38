"""Policies of a product with a memory, acting on the states of the original model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.model.product import ProductSSP, check_product
from ssp_lp.model.within_steps import HorizonSSP
from ssp_lp.policies.mixed import MixedPolicy, as_lottery
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Branches, Policy, check_costs


@dataclass(frozen=True, eq=False, repr=False)
class RememberingPolicy(Policy):
    """A policy of (state, memory) that acts on states and carries the memory itself.

    Its own memory is the product's, and that of the policy besides: ``inner * memories + number``.
    """

    inner: Policy  # on the product

    def __post_init__(self) -> None:
        check_product(self.inner.model)

    @property
    def product(self) -> ProductSSP:
        """The product that the inner policy lives on."""
        return check_product(self.inner.model)

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """The original model."""
        return self.product.original

    @property
    def step_limit(self) -> int | None:
        """The fewest of the products that it was made for."""
        own = self.product.steps if isinstance(self.product, HorizonSSP) else None
        return min((n for n in (own, self.inner.step_limit) if n is not None), default=None)

    def start_memory(self, states: IntArray) -> IntArray:
        """The memory's start, and the inner policy's, [episodes]."""
        product = self.product
        first = product.memory_number[product.memory.start]
        inner = self.inner.start_memory(self._at(states, np.full(len(states), first)))
        return np.asarray(inner * len(product.memories) + first)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The inner policy's decisions, as pairs of the original; giving up where all is lost."""
        product = self.product
        inner, number = np.divmod(memory, len(product.memories))
        here = self._at(states, number)
        found = self.inner.branches(here, inner)
        shift = product.pair_offsets[here] - self.model.pair_offsets[states]
        pair = np.where(found.pair >= 0, found.pair - shift[found.situation], found.pair)
        over = (np.diff(product.pair_offsets) == 0) & ~product.goal_mask
        lost = dead_ends(product)[here][found.situation] & (found.pair == UNDECIDED)
        pair = np.where(over[here][found.situation] | lost, GIVE_UP_CODE, pair)
        return Branches(found.situation, pair, found.probability)

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Update the memory with each step, and the inner policy's, [episodes].

        Raises:
            ModelError: a cost is negative or not finite, or a step leads to a memory that the
                product does not have.
        """
        check_costs(costs)
        product, model = self.product, self.model
        inner, number = np.divmod(memory, len(product.memories))
        steps = np.stack([number, pairs, successors], axis=1).astype(np.float64)
        distinct, back = np.unique(np.column_stack([steps, costs]), axis=0, return_inverse=True)
        after = np.array([self._updated(*step) for step in distinct.tolist()], dtype=np.int64)
        after = after[np.ravel(back)] if after.size else np.zeros(0, dtype=np.int64)
        here = self._at(model.pair_state[pairs], number)
        taken = pairs + product.pair_offsets[here] - model.pair_offsets[model.pair_state[pairs]]
        there = self._at(successors, after)
        moved = self.inner.remember(inner, taken, there, costs)
        return np.asarray(moved * len(product.memories) + after)

    def _updated(self, number: float, pair: float, successor: float, cost: float) -> int:
        """The number of the memory after a step."""
        product, model = self.product, self.model
        state, there = (model.states[int(k)] for k in (model.pair_state[int(pair)], successor))
        kept, action = product.memories[int(number)], model.action_of(int(pair))
        after = product.memory.update(kept, state, action, there, cost)
        if after not in product.memory_number:
            raise ModelError(
                f"the step from {state!r} by {action!r} to {there!r} at cost {cost:g} leads to the "
                f"memory {after!r}, which the product does not have"
            )
        return product.memory_number[after]

    def _at(self, states: IntArray, numbers: IntArray) -> IntArray:
        """The product's states.

        Raises:
            ModelError: a state and a memory that do not occur together.
        """
        found = self.product.table[states, numbers]
        if (found < 0).any():
            k = int(np.argmax(found < 0))
            raise ModelError(
                f"state {self.model.states[int(states[k])]!r} with the memory "
                f"{self.product.memories[int(numbers[k])]!r} does not occur in the product"
            )
        return found

    def __repr__(self) -> str:
        """One line: how many memories there are, and the inner policy."""
        return f"RememberingPolicy({len(self.product.memories):,} memories, {self.inner!r})"


def on_original(policy: Policy | MixedPolicy) -> MixedPolicy:
    """A policy of a product as one remembering its memory on the original model.

    Args:
        policy: such as a solution's, of a problem on ``product(model, memory)``.

    Raises:
        ModelError: it lives on no product.
    """
    lottery = as_lottery(policy)
    members = tuple(RememberingPolicy(member) for member in lottery.policies)
    return MixedPolicy(members, lottery.weights)
