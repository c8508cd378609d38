"""Mixed policies: a lottery, drawn once at the start, over deterministic policies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained_class
from ssp_lp.policies.policy import Playable, Policy, check_policies

_LISTED = 3  # members that a repr names


@explained_class
@dataclass(frozen=True, eq=False, repr=False)
class MixedPolicy(Playable):
    """A lottery at the start over a few policies (paper, section 2.2).

    Raises:
        ModelError: no members, or weights that are negative or do not sum to one.
    """

    policies: tuple[Policy, ...]
    weights: FloatArray  # [policies]

    def __post_init__(self) -> None:
        object.__setattr__(self, "policies", tuple(self.policies))
        object.__setattr__(self, "weights", read_only(self.weights, np.float64))
        check_policies(self.policies)
        if not self.policies or self.weights.shape != (len(self.policies),):
            raise ModelError("a mixed policy needs one weight for each of its policies")
        weights = self.weights.tolist()
        if not (min(weights) >= 0.0 and abs(sum(weights) - 1.0) <= 1e-9):
            raise ModelError(f"weights must form a distribution, not {weights}")
        if any(p.model is not self.model for p in self.policies):
            raise ModelError("the members of a mixed policy must act on one model")

    @property
    def model(self) -> SSP:
        """The model that the members act on."""
        return self.policies[0].model

    def draw(
        self, episodes: int, rng: np.random.Generator | None
    ) -> tuple[tuple[Policy, ...], IntArray]:
        """The members, and the position of the one that plays each episode, [episodes].

        Raises:
            ModelError: there are several members and no generator.
        """
        if rng is not None:
            return self.policies, rng.choice(len(self.policies), size=episodes, p=self.weights)
        if len(self.policies) > 1:
            raise ModelError("a lottery over policies needs a random generator: start(rng)")
        return self.policies[0].draw(episodes, rng)

    def __repr__(self) -> str:
        """One line: how many members there are, and the first of them with their weights."""
        some = list(zip(self.weights, self.policies, strict=True))[:_LISTED]
        parts = [f"{weight:.6g} x {policy!r}" for weight, policy in some]
        parts += ["..."] if len(self.policies) > _LISTED else []
        count = f"{len(self.policies)} member{'s' if len(self.policies) > 1 else ''}"
        return f"MixedPolicy({count}: {' + '.join(parts)})"


def as_lottery(policy: Policy | MixedPolicy) -> MixedPolicy:
    """The policy as a lottery, of one member if it is none.

    Raises:
        ModelError: it is no policy.
    """
    return policy if isinstance(policy, MixedPolicy) else MixedPolicy((policy,), np.ones(1))
