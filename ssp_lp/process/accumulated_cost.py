"""The accumulated cost of case S (paper, section 3.1.1) as a layered substochastic process.

States are (node, layer), the layer being the cost paid so far in units of the cost lattice. Only
one layer's structure is stored: it is the same in all of them. A failing episode costs nothing
here, so where the goal can be avoided for sure (attention states) a policy may fail at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_states
from ssp_lp.process.lattice import common_unit, layers_of
from ssp_lp.process.semantics import survival_of
from ssp_lp.process.skeleton import Skeleton, build_skeleton, costless_pairs


@dataclass(frozen=True, eq=False)
class AccumulatedCost:
    """One layer of the process, and how its pairs lead to the same and to later layers."""

    skeleton: Skeleton
    unit: float  # cost of one layer
    width: int  # layers that one step can reach: 0 .. width - 1 ahead
    survival: float  # the discount, 1 in the exact setting
    steps: sp.csr_array  # [pairs, width * nodes] column = layers ahead * nodes + node
    gain: FloatArray  # [pairs] probability of stepping into the goal (weight gamma^t)
    gain_cost: FloatArray  # [pairs] E[stage cost; step into the goal]
    failure: FloatArray  # [pairs] mass that fails
    start: FloatArray  # [nodes]
    start_goal: float  # start mass on goals
    start_failure: float  # start mass on dead-ends

    @property
    def n_nodes(self) -> int:
        """States of one layer."""
        return self.skeleton.n_nodes

    @property
    def pair_offsets(self) -> IntArray:
        """Pairs of each node, [nodes + 1]."""
        return self.skeleton.pair_offsets

    @cached_property
    def instant(self) -> sp.csr_array:
        """Steps that cost nothing and stay in the layer, [pairs, nodes]."""
        inside = sp.csr_array(self.steps[:, : self.n_nodes])
        inside.sum_duplicates()
        return inside

    @cached_property
    def later(self) -> sp.csr_array:
        """Steps that cost something, [pairs, (width - 1) * nodes]; column 0 is one layer ahead."""
        return sp.csr_array(self.steps[:, self.n_nodes :])


def accumulate_cost(model: SSP, start: FloatArray, discount: float | None) -> AccumulatedCost:
    """Build the process of case S.

    Args:
        model: the model.
        start: distribution over states, [states].
        discount: None keeps real probabilities; a number scales every transition by it.

    Raises:
        ModelError: the costs have no common unit that gives a sane number of layers.
    """
    survival = survival_of(discount)
    free = costless_pairs(model) if discount is None else None
    skeleton = build_skeleton(model, free=free, exits=attention_states(model))
    moving = (skeleton.node_of[model.successors] >= 0) & (model.probabilities > 0)
    paid = model.costs[moving]
    unit = common_unit(paid, model.exact_costs)
    layer = np.zeros(model.n_outcomes, dtype=np.int64)
    layer[moving] = layers_of(paid, unit, model.exact_costs)
    width = int(layer.max(initial=0)) + 1
    to_goal = model.goal_mask[model.successors].astype(np.float64)
    to_dead = skeleton.expectation(skeleton.dead[model.successors].astype(np.float64), 1.0)
    acting = skeleton.pair_at >= 0
    return AccumulatedCost(
        skeleton=skeleton,
        unit=float(unit),
        width=width,
        survival=survival,
        steps=sp.csr_array(skeleton.matrix(model.probabilities, layer, width) * survival),
        gain=skeleton.expectation(to_goal),
        gain_cost=skeleton.expectation(to_goal * model.costs),
        failure=np.where(acting, (1.0 - survival) + survival * to_dead, 1.0),
        start=skeleton.gather(start),
        start_goal=float(start[model.goal_mask].sum()),
        start_failure=float(start[skeleton.dead].sum()),
    )
