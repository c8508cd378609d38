"""The journey of the walkthrough: six states, solved by hand in fractions.

    depot --drive--> bank (1/2) or crossing (1/2)                              cost 1
    bank --ford--> home (9/10) or wreck (1/10)   bank --bridge--> bridge       cost 1, 2
    bridge --cross--> home (49/50) or wreck (1/50)                             cost 2
    crossing --go--> home (1/2) or crossing (1/2)   crossing --wait--> itself  cost 4, 1

A deterministic policy that may be optimal chooses the way over the river and the number of times
that it tries to go before it gives up at the crossing: waiting first costs more and fails more. The
library's lower bounds, which hold for all policies, confirm it. So each optimum is a lottery over
two of these policies, whose costs and failures are given by the formulas below.
"""

from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

from ssp_lp import GIVE_UP, SSP, DeterministicPolicy
from ssp_lp.policies.remembering import TimedPolicy

START = "depot"
BUDGET = Fraction(1, 10)
GAMMA = Fraction(99, 100)
FOR_EVER = 60
"""Number of tries at which 1/2^tries is below the rounding of every cost here."""

MOST_TRIES = 30
"""Number of tries above which failures differ by less than 1e-9."""


@dataclass(frozen=True)
class Row:
    """A number as computed by the library, and by hand."""

    what: str
    computed: float
    theory: Fraction | float
    bound: float | None = None  # largest distance; None: rounding, 1e-8 of the theory's value

    @property
    def agrees(self) -> bool:
        """Whether the two numbers are equal within the bound."""
        bound = 1e-8 * max(abs(float(self.theory)), 1e-3) if self.bound is None else self.bound
        return abs(self.computed - float(self.theory)) <= bound


class Plan(NamedTuple):
    """A deterministic policy of the journey."""

    ford: bool  # or over the bridge
    tries: int  # at the crossing, before giving up there


class Point(NamedTuple):
    """Cost and failure of a plan."""

    objective: Fraction
    condition: Fraction
    plan: Plan


PLANS = [Plan(ford, m) for ford in (True, False) for m in (*range(MOST_TRIES + 1), FOR_EVER)]


def journey() -> SSP:
    """Return the model; the wreck costs 1 per stage, which is charged once (section 3.1.2)."""
    return SSP.from_transitions(
        {
            "depot": {"drive": [(0.5, "bank", 1), (0.5, "crossing", 1)]},
            "bank": {
                "ford": [(0.9, "home", 1), (0.1, "wreck", 1)],
                "bridge": [(1.0, "bridge", 2)],
            },
            "bridge": {"cross": [(0.98, "home", 2), (0.02, "wreck", 2)]},
            "crossing": {
                "go": [(0.5, "home", 4), (0.5, "crossing", 4)],
                "wait": [(1.0, "crossing", 1)],
            },
            "wreck": {"stay": [(1.0, "wreck", 1)]},
        },
        goal={"home"},
    )


def stationary_policy(model: SSP, plan: Plan) -> DeterministicPolicy:
    """Return a plan with no try, or with tries for ever, as a policy of the state alone."""
    return DeterministicPolicy.from_actions(
        model,
        {
            "depot": "drive",
            "bank": "ford" if plan.ford else "bridge",
            "bridge": "cross",
            "crossing": "go" if plan.tries else GIVE_UP,
        },
    )


def timed_policy(model: SSP, plan: Plan) -> TimedPolicy:
    """Return any plan as a policy of state and time: the first try falls on time 1."""
    going = stationary_policy(model, Plan(plan.ford, FOR_EVER))
    giving_up = stationary_policy(model, Plan(plan.ford, 0))
    return TimedPolicy((going,) * (plan.tries + 1) + (giving_up,))


def failure(plan: Plan, gamma: Fraction = Fraction(1)) -> Fraction:
    """Return J_cond = L_d^gamma = 1 - E[gamma^T; goal]; at gamma = 1 the failure probability."""
    bank = Fraction(9, 10) * gamma if plan.ford else Fraction(49, 50) * gamma**2
    x = gamma / 2
    crossing = x * (1 - x**plan.tries) / (1 - x)
    return 1 - x * (bank + crossing)


def cost(plan: Plan, gamma: Fraction = Fraction(1)) -> Fraction:
    """Return J_obj of case M: E[r_tau], with 1 charged at the wreck and 1 for giving up."""
    bank = 1 + gamma / 10 if plan.ford else 2 + gamma * (2 + gamma / 50)
    x = gamma / 2
    crossing = 4 * (1 - x**plan.tries) / (1 - x) + x**plan.tries
    return 1 + x * (bank + crossing)


def success_cost(plan: Plan, gamma: Fraction = Fraction(1)) -> Fraction:
    """Return J_obj of case S: E[gamma^(T-1) r_T; goal]; k tries cost 1 + 4 k until T = 1 + k."""
    bank = Fraction(9, 10) * 2 if plan.ford else Fraction(49, 50) * gamma * 5
    x = gamma / 2
    crossing = sum((x ** (k - 1) * (1 + 4 * k) for k in range(1, plan.tries + 1)), Fraction(0)) / 2
    return x * (bank + crossing)
