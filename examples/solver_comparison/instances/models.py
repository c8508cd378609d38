"""The models behind the instances of the comparison, built and ready to be solved."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace

import numpy as np

from examples.domains.domain import Domain
from examples.domains.navigation import navigation
from examples.domains.rectangle_tireworld import rectangle_tireworld
from examples.domains.triangle_tireworld import triangle_tireworld
from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from examples.solver_comparison.instances.families import FAMILIES
from examples.solver_comparison.instances.instance import Instance
from ssp_lp import MCMP, S3P, SSP, MaxProb, MinCost

N_ACTIONS, N_SUCCESSORS = 5, 8
_STATES_PER_END = 200
_RISK = 2e-3  # greatest probability of a trap per risky step
_SEED = 3

_DOMAINS: dict[str, Callable[..., Domain]] = {
    "triangle": triangle_tireworld,
    "rectangle": rectangle_tireworld,
    "navigation": navigation,
}


@dataclass(frozen=True, eq=False)
class ReadyInstance:
    """An instance whose model is built."""

    instance: Instance
    model: SSP
    start: Hashable

    def problem(self) -> MCMP | S3P | MaxProb | MinCost:
        """Return the problem on a copy of the model without results cached by earlier calls."""
        asked, model = self.instance, replace(self.model)
        if asked.case in "PC":
            return (MaxProb if asked.case == "P" else MinCost)(model, self.start)
        if asked.case == "S":
            return S3P(
                model, self.start, asked.failure_budget, asked.discount, cost_cap=asked.cost_cap
            )
        give_up = "attention" if asked.family == "robot" else "dead_ends"
        return MCMP(model, self.start, asked.failure_budget, asked.discount, give_up=give_up)


def build(instance: Instance) -> ReadyInstance:
    """Build an instance's model."""
    if instance.family == "robot":
        grid = RobotGrid(segments=instance.size[0], headings=instance.size[1])
        return ReadyInstance(instance, grid_model(grid), start_state(grid))
    if instance.family in _DOMAINS:
        return ReadyInstance(instance, *_DOMAINS[instance.family](*instance.size))
    family = FAMILIES.get(instance.family, random_model)
    return ReadyInstance(instance, family(*instance.size), start=0)


def random_model(n_states: int) -> SSP:
    """Return a random sparse model: 5 actions of 8 successors each, drawn uniformly.

    One state in 200 is a goal, one a trap without actions. The first action of each state is
    expensive and safe; the others are cheap and enter a trap with a small probability.
    """
    rng = np.random.default_rng([_SEED, n_states])
    n_ends = max(n_states // _STATES_PER_END, 1)
    n_live = n_states - 2 * n_ends
    shape = (n_live, N_ACTIONS, N_SUCCESSORS)
    successors = rng.integers(n_live + n_ends, size=shape, dtype=np.int32)
    probabilities = rng.dirichlet(np.ones(N_SUCCESSORS), size=shape[:2])
    risk = rng.uniform(0.0, _RISK, size=(n_live, N_ACTIONS - 1))
    successors[:, 1:, -1] = rng.integers(n_live + n_ends, n_states, size=risk.shape)
    probabilities[:, 1:, -1] = 0.0
    probabilities[:, 1:] *= ((1.0 - risk) / probabilities[:, 1:].sum(axis=-1))[..., None]
    probabilities[:, 1:, -1] = risk
    costs = rng.integers(1, 6, size=shape[:2])
    costs[:, 0] += 5
    pairs_before = N_ACTIONS * np.minimum(np.arange(n_states + 1), n_live)
    return SSP.from_arrays(
        pair_offsets=pairs_before,
        outcome_offsets=N_SUCCESSORS * np.arange(n_live * N_ACTIONS + 1),
        successors=successors.ravel(),
        probabilities=probabilities.ravel(),
        costs=costs.ravel().astype(np.float64),
        goal_states=np.arange(n_live, n_live + n_ends),
        treat_actionless_as_dead_ends=True,
    )
