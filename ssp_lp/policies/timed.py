"""Non-stationary policies: decisions that also depend on the number of steps taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained_class
from ssp_lp.policies.policy import Branches, Policy, check_policies


@explained_class
@dataclass(frozen=True, eq=False, repr=False)
class TimedPolicy(Policy):
    """One policy for each time step, the last of them for good (paper, section 3.4).

    The stages must share one memory: each must understand what any other remembers. The memory
    of the whole is ``stage memory * number of stages + stage``.

    Raises:
        ModelError: no stages, or stages on different models.
    """

    stages: tuple[Policy, ...]  # followed at times 0, 1, ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "stages", tuple(self.stages))
        if not self.stages:
            raise ModelError("a timed policy needs at least one stage")
        check_policies(self.stages)
        if any(p.model is not self.stages[0].model for p in self.stages):
            raise ModelError("the stages of a timed policy must act on one model")

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """The model that the stages act on."""
        return self.stages[0].model

    def start_memory(self, states: IntArray) -> IntArray:
        """The first stage and its start memory, [episodes]."""
        return self.stages[0].start_memory(states) * len(self.stages)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The decisions of each situation's stage."""
        inner, stage = np.divmod(memory, len(self.stages))
        nothing = np.zeros(0, dtype=np.int64)
        found = [(nothing, nothing, np.zeros(0))]
        for number in np.unique(stage):
            some = np.flatnonzero(stage == number)
            branch = self.stages[number].branches(states[some], inner[some])
            found.append((some[branch.situation], branch.pair, branch.probability))
        situation, pair, probability = (np.concatenate(part) for part in zip(*found, strict=True))
        order = np.argsort(situation, kind="stable")
        return Branches(situation[order], pair[order], probability[order])

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Move the memory that the stages share, and go on to the next stage."""
        count = len(self.stages)
        inner, stage = np.divmod(memory, count)
        inner = self.stages[0].remember(inner, pairs, successors, costs)
        return np.asarray(inner * count + np.minimum(stage + 1, count - 1))

    def __repr__(self) -> str:
        """One line: the number of stages and the last one."""
        return f"TimedPolicy({len(self.stages):,} stages, then {self.stages[-1]!r})"
