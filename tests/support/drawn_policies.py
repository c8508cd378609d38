"""Drawn models, and policies on them that remember the cost paid."""

from __future__ import annotations

from typing import Any

import numpy as np

from small_models import model_of
from ssp_lp import SSP, CostAwarePolicy
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED

CLOSE = 1e-12
Draw = np.random.Generator


def drawn_model(draw: Draw, costs: list[float]) -> SSP:
    """A few states, some of them dead-ends with and without a label."""
    n = int(draw.integers(2, 8))

    def outcomes() -> list[tuple[float, Any, float]]:
        shares = draw.dirichlet(np.ones(int(draw.integers(1, 4)))).tolist()
        ends = draw.choice(["g", "d", "x"], len(shares), p=[0.25, 0.1, 0.65])
        names = [int(draw.integers(n)) if end == "x" else str(end) for end in ends]
        return [(p, name, float(draw.choice(costs))) for p, name in zip(shares, names, strict=True)]

    steps: dict[Any, Any] = {
        s: {} if draw.random() < 0.1 else {a: outcomes() for a in range(int(draw.integers(1, 4)))}
        for s in range(n)
    }
    labels = {"pit": ["d"]}
    return model_of(steps | {"d": {}}, labels=labels)


def drawn_decisions(draw: Draw, model: SSP, layers: int) -> Any:
    counts = np.diff(model.pair_offsets)
    position = draw.integers(0, np.maximum(counts, 1), (layers, model.n_states))
    position = np.where(draw.random(position.shape) < 0.1, GIVE_UP_CODE, position)
    return np.where(counts > 0, position, UNDECIDED)


def drawn_policy(draw: Draw, model: SSP, *, on_levels: bool) -> CostAwarePolicy:
    layers = int(draw.integers(1, 6))
    tails = drawn_decisions(draw, model, 2)
    tails = np.where(tails < 0, tails, model.pair_offsets[:-1] + tails)
    decisions = drawn_decisions(draw, model, layers)
    if on_levels:
        levels = np.append(0.0, np.cumsum(draw.uniform(0.2, 1.5, layers)))
        beyond = draw.uniform(0.5, 2.0, model.n_states) * levels[-1]
        threshold = np.where(draw.random(model.n_states) < 0.4, -np.inf, beyond)
        return CostAwarePolicy(model, 1.0, decisions, tails, threshold, levels=levels)
    threshold = draw.integers(layers, layers + 6, model.n_states).astype(np.float64)
    return CostAwarePolicy(model, 0.5, decisions, tails, threshold)
