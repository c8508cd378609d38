"""What follows failing in a certificate: policies in the checker's product with the label.

The library's product (``label_failing``) ends runs where nothing counts any more, and names each
pair by what it is taken with; the checker's, which it derives by itself, has state x after failing
as state ``shift + x``, and giving up by an action behind that action.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ssp_lp.arrays import read_only
from ssp_lp.model.failure_product import FailureSSP
from ssp_lp.model.graph import Graph
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED
from ssp_lp.verification.checker import Model


def graph_of(model: Model) -> Graph:
    """Graph of a checker's model, the states and pairs of what follows failing among them."""
    moves = [pair[2] for pair in model.pairs]
    entries = [(a / pair[1], y) for pair in model.pairs for a, y, _ in pair[2]]
    chances, successors = np.array(entries, dtype=np.float64).reshape(-1, 2).T
    return Graph(
        pair_offsets=read_only(np.cumsum([0, *map(len, model.of)])),
        outcome_offsets=read_only(np.cumsum([0, *map(len, moves)])),
        successors=read_only(successors, np.int32),
        probabilities=read_only(chances),
    )


def relabelled(
    model: Model, label: FailureSSP, pair_at: Callable[[int, int], int]
) -> Callable[[int, int], int]:
    """Decisions in the checker's product after failing, by state and total; or a code.

    Where the library's run is over, as nothing counts any more, it goes on to any end.

    Args:
        model: the checker's.
        label: the library's product.
        pair_at: pair of the library's product, or a code, by its state and a total.
    """
    n, original = model.shift, label.original
    places, quits = dict[tuple[int, int], int](), dict[int, int]()
    staying: dict[int, list[int]] = {}  # pairs by which one may give up, of the original
    bounds = list(pairwise(original.pair_offsets.tolist()))
    for s in sorted(model.live):
        x = s % n
        # after failing: all actions of a dead-end, else those that avoid the goal
        left = iter(range(*bounds[x]) if s < n or x in model.still else staying[x])
        k = UNDECIDED
        for place in model.of[s]:
            if s < n and s not in model.still and model.pairs[place][2][0][1] >= n:
                quits[k] = place
                staying.setdefault(x, []).append(k)
            else:
                k = next(left)
                places[s, k] = place
    onward = _onward(model)

    def decided(s: int, r: int) -> int:
        """Pair of the checker's product."""
        x = s % n
        p = pair_at(x if s < n else label.n_original + x, r)
        if p >= 0:
            k = int(label.original_pair[p])
            gives_up = bool(label.fails[p]) and s not in model.still
            return quits[k] if gives_up else places[s, k]
        if s in model.still:
            return onward[s]
        if p == GIVE_UP_CODE and x in staying and x not in model.free:
            return quits[staying[x][0]]
        return p

    return decided


def _onward(model: Model) -> dict[int, int]:
    """A way on after failing to where runs end, or may go about for nothing: pairs, or to stop."""
    failed = model.still & model.live
    onward = dict.fromkeys(failed & model.free, GIVE_UP_CODE)
    ahead = [*onward, *model.ended]
    for y in ahead:  # it grows while it is walked
        for k in model.before[y]:
            if (s := model.home[k]) in failed and s not in onward:
                onward[s] = k
                ahead.append(s)
    return onward
