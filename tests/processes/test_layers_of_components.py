"""Decisions of many layers pulled back at once, in models whose free components are one place."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ssp_lp import SSP
from ssp_lp.model.graph import attention_states
from ssp_lp.processes.quotient import build_quotient
from ssp_lp.processes.rows import costless_pairs


def halls(seed: int) -> SSP:
    """Three free rings of rooms, with ways out of some of them, and passages that cost."""
    rng, ways = np.random.default_rng(seed), {}
    for hall in range(3):
        for room in range(4):
            here: dict[str, Any] = {"round": [(1.0, (hall, (room + 1) % 4), 0.0)]}
            if rng.random() < 0.7 or room == 0:
                to = "G" if hall == 2 else (hall + 1, int(rng.integers(4)))
                here["out"] = [(0.8, to, 1.0), (0.2, (0, 0), 2.0)]
            if rng.random() < 0.5:
                here["across"] = [(0.5, (hall, (room + 2) % 4), 0.0), (0.5, (hall, 0), 0.0)]
            ways[hall, room] = here
    ways["lone"] = {"in": [(1.0, (0, 1), 1.0)], "far": [(1.0, (1, 1), 3.0)]}
    return SSP.from_transitions(ways, goal={"G"})


@pytest.mark.parametrize("on", [False, True], ids=["numpy", "compiled"])
@pytest.mark.parametrize("seed", range(5))
def test_all_layers_at_once_are_each_by_itself(seed: int, on: bool, accelerate: Any) -> None:
    accelerate(on)
    model = halls(seed)
    quotient = build_quotient(model, free=costless_pairs(model), exits=attention_states(model))
    assert quotient.merged.any()
    rng, first = np.random.default_rng(seed), quotient.pair_offsets[:-1]
    choice = rng.integers(0, np.diff(quotient.pair_offsets), (50, quotient.n_nodes))
    found = quotient.positions(first, choice)
    for layer, positions in zip(choice, found, strict=True):
        pairs = quotient.pull_back(first + layer)
        np.testing.assert_array_equal(
            positions, np.where(pairs < 0, pairs, pairs - model.pair_offsets[:-1])
        )
