"""A basis at which a simplex method may start."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ssp_lp.arrays import IntArray


@dataclass(frozen=True, eq=False)
class PolicyBasis:
    """Basic columns of a program, besides the scale t of case S."""

    pairs: IntArray  # [states] a policy's pairs, or [states + 1] with one of a second policy
    slack: bool  # whether the failure row's slack is basic: one policy is enough
    pivot_threshold: float = 0.1  # least pivot relative to its column, where there is a choice

    @property
    def stabler(self) -> PolicyBasis:
        """The same, factorised with larger pivots: slower, and more exact.

        At 0.1 the errors of HiGHS's duals can grow from layer to layer of a policy's chain, to
        0.04 after 46 layers of a process whose basis is well conditioned; with 0.5 to 1e-14.
        """
        return replace(self, pivot_threshold=0.5)
