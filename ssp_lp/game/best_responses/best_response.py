"""What the player answers to the adversary's weights: a policy, its two costs, and a bound."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from ssp_lp.policies.policy import Policy


@dataclass(frozen=True, eq=False)
class BestResponse:
    """A deterministic policy that minimises a weighted sum of the game's two costs.

    Where the goal is hardly ever reached J_cond is 1 but for rounding. Its player then counts it
    from ``origin`` 1: minus the success, a sum of its own in which no digit is lost.
    """

    objective: float  # J_obj(x'; pi), exact for the policy
    failing: float  # J_cond(x'; pi) - origin, exact for the policy
    bound: float  # no policy has less of weight * J_obj + weight * failing, at the weights asked
    strategy: Any = None  # the policy in the player's own form
    sweeps: int = 0  # Bellman backups that it took
    origin: float = 0.0  # 0, or 1 where the goal is hardly ever reached

    @property
    def condition(self) -> float:
        """J_cond(x'; pi)."""
        return self.origin + self.failing

    @property
    def success(self) -> float:
        """1 - J_cond: in case S E[gamma^T; goal]."""
        return (1.0 - self.origin) - self.failing

    def payoff(self, objective_weight: float, condition_weight: float) -> float:
        """What the policy pays at other weights, J_cond counted from its origin."""
        return objective_weight * self.objective + condition_weight * self.failing

    def size(self, objective_weight: float, condition_weight: float) -> float:
        """The size of the payoff's parts, to which its rounding is relative."""
        return objective_weight * self.objective + condition_weight * abs(self.failing)


class Player(Protocol):
    """Finds best responses by dynamic programming; one implementation per construction."""

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """A policy of least ``objective_weight * J_obj + condition_weight * J_cond``.

        All responses of a player count J_cond from the same origin.

        Args:
            objective_weight: alpha(M_o) of section 3.2 of the paper, not negative.
            condition_weight: alpha(M_d) * eta / epsilon, not negative.
            accuracy: largest distance between the policy's payoff and its bound, relative to the
                payoff's size.
        """
        ...

    def policy(self, response: BestResponse) -> Policy:
        """The response's policy on the original states."""
        ...


class RatioPlayer(Player, Protocol):
    """A player of case S, whose c* is a ratio."""

    def surplus(self, price: float, accuracy: float) -> float:
        """What every policy has at least of ``J_obj - price * (1 - J_cond)``, rounding counted.

        Where it is not negative, no policy's ``J_obj / (1 - J_cond)`` is less than the price.
        """
        ...
