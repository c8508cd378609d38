"""How episodes end, by name: the goal, a labelled dead-end, another dead-end."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import IntArray
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import dead_ends


def end_marks(model: SSP) -> IntArray:
    """Number of the way in which an episode ends in each state, -1 where it goes on, [states].

    0 is the goal, 1 .. k the model's labels in their order (at dead-ends that bear them; the
    first label counts), k + 1 a dead-end without a label.
    """
    dead = dead_ends(model)
    mark = np.where(dead, len(model.state_labels) + 1, -1)
    for number, members in reversed(list(enumerate(model.state_labels.values(), start=1))):
        mark[members[dead[members]]] = number
    mark[model.goal_mask] = 0
    return mark
