"""Quantities of a policy from which its evaluation is put together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

from ssp_lp.arrays import FloatArray


@dataclass(frozen=True)
class Measures:
    """Quantities of a policy that are linear in the start lottery."""

    goal: float
    failure: float  # 1 - goal, summed from its own exits
    success_cost: float
    expected_cost: float
    discounted_goal: float  # E[gamma^T; goal]
    discounted_failure: float  # 1 - that, likewise
    discounted_cost: float  # case M: discounted E[r_tau]; case S: E[gamma^(T - 1) r_T; goal]
    ends: Mapping[str, float]
    secondary: Mapping[str, float]  # discounted like the cost


def mean_of(parts: list[Measures], weights: FloatArray) -> Measures:
    """Mean of measures over a lottery; an infinite cost of weight 0 does not count."""
    used = [(p, float(w)) for p, w in zip(parts, weights, strict=True) if w > 0]
    scalars = {
        f.name: sum(w * getattr(p, f.name) for p, w in used)
        for f in fields(Measures)
        if f.name not in ("ends", "secondary")
    }
    names = list(dict.fromkeys(name for p, _ in used for name in p.ends))
    return Measures(
        **scalars,
        ends={n: sum(w * p.ends.get(n, 0.0) for p, w in used) for n in names},
        secondary={n: sum(w * p.secondary[n] for p, w in used) for n in used[0][0].secondary},
    )
