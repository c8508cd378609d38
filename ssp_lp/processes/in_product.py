"""Policies of a model, followed on a product that stands in its place: what on_original undoes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.model.product import ProductSSP
from ssp_lp.policies.mixed import MixedPolicy, as_lottery
from ssp_lp.policies.policy import Branches, Policy
from ssp_lp.policies.remembering import RememberingPolicy


@dataclass(frozen=True, eq=False, repr=False)
class _InProduct(Policy):
    """A policy of the original model that acts in a product, whose memory it does not look at."""

    inner: Policy  # on the original
    model: ProductSSP

    @property
    def monotone(self) -> bool:  # type: ignore[override]
        """As the inner policy's."""
        return self.inner.monotone

    def start_memory(self, states: IntArray) -> IntArray:
        """The inner policy's, [episodes]."""
        return self.inner.start_memory(self.model.original_state[states])

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The inner policy's decisions, as pairs of the product."""
        product, here = self.model, self.model.original_state[states]
        found = self.inner.branches(here, memory)
        shift = product.pair_offsets[states] - product.original.pair_offsets[here]
        pair = np.where(found.pair >= 0, found.pair + shift[found.situation], found.pair)
        return Branches(found.situation, pair, found.probability)

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """The inner policy's, [episodes]."""
        product = self.model
        there = product.original_state[successors]
        return self.inner.remember(memory, product.original_pair[pairs], there, costs)


def on_product(policy: Policy | MixedPolicy, product: ProductSSP) -> MixedPolicy:
    """A policy of the original model as one of a product; what carries its memory is unwrapped.

    Args:
        policy: such as one of :func:`on_original`, or one that knows nothing of the memory.
        product: of the model that the policy acts on.
    """
    lottery = as_lottery(policy)
    members = tuple(
        member.inner
        if isinstance(member, RememberingPolicy) and member.product is product
        else _InProduct(member, product)
        for member in lottery.policies
    )
    return MixedPolicy(members, lottery.weights)
