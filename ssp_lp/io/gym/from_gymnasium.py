"""Models from Gymnasium's tabular environments: toy-text, and whatever else has a table ``P``."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import fsum
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ssp_lp.arrays import SINGLE_PRECISION_SUM
from ssp_lp.errors import Argument, ModelError, wrong_argument
from ssp_lp.io.gym.environment import name_of_environment, step_limit_of
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import SSP
from ssp_lp.model.within_steps import HorizonSSP, within_steps

if TYPE_CHECKING:
    import gymnasium

END = "end"
"""Where an environment also goes on from a state that it may end in, the end is ("end", state)."""

CostFunction = Callable[[Any, Any, Any, float], float]
"""``(state, action, next_state, reward) -> cost``."""

Outcome = tuple[float, Hashable, float, bool]
"""Probability, next state, reward, terminated."""

_SAY_GOALS = "say which states are goals: ", Argument("goal")

Table = dict[Hashable, dict[Hashable, list[Outcome]]]


@dataclass(frozen=True, eq=False, repr=False)
class EnvironmentSSP(SSP):
    """The model of an environment, which knows what the environment's steps cost."""

    step_cost: CostFunction = field(kw_only=True)

    @cached_property
    def ends(self) -> frozenset[Hashable]:
        """The environment's states that the model has an end of its own for."""
        return frozenset(
            label[1] for label in self.states if isinstance(label, tuple) and label[0] == END
        )

    def label(self, state: Hashable, terminated: bool) -> Hashable:
        """The model's state for what the environment shows after a step."""
        return (END, state) if terminated and state in self.ends else state


@dataclass(frozen=True, eq=False)
class GymnasiumWorld:
    """An environment as a model, and where its episodes begin."""

    model: EnvironmentSSP | HorizonSSP
    start: Mapping[Hashable, float]  # the model's states, with probabilities
    step_limit: int | None  # steps after which the environment cuts an episode off
    horizon: int | None  # steps within which the model asks for the goal


@explained
def from_gymnasium(
    env: gymnasium.Env[Any, Any],
    *,
    goal: Callable[[Any], bool] | None = None,
    cost: Literal["step", "reward"] | CostFunction = "step",
    horizon: Literal["env"] | int | None = "env",
    start: Hashable | Mapping[Hashable, float] | None = None,
) -> GymnasiumWorld:
    """Build the model of a tabular environment from its table of transitions.

    States in which the environment terminates are goals where every step into them is rewarded,
    dead-ends where none is. A state in which it terminates on one step and goes on after another
    (as Taxi's table lists them) has an end of its own, ("end", state).

    Args:
        env: an environment with ``env.unwrapped.P[state][action]``, a list of (probability, next
            state, reward, terminated). Wrappers that change observations, actions or rewards are
            not seen.
        goal: says of each state of the environment whether it is a goal, whatever the rewards;
            other states in which the environment terminates are dead-ends.
        cost: "step": 1 for each step; "reward": minus the reward where that is negative, else 0
            (so positive rewards count nothing); or ``(state, action, next_state, reward) -> cost``.
        horizon: "env": the goal must be reached within the environment's own step limit
            (``TimeLimit``), where it has one, so that what is certified holds in the environment;
            a number: within so many steps; None: at any time (`rollout` tells of what was cut off).
        start: a state or ``{state: probability}``; None: the environment's own distribution.

    Returns:
        The model, its start and the step limit. With a horizon the model's states are (state,
        steps taken): see :func:`~ssp_lp.model.within_steps.within_steps`.

    Raises:
        MissingDependencyError: gymnasium is not installed.
        ModelError: no table, no start, a wrong table or option, or goals that cannot be told.

    Example:
        >>> import gymnasium
        >>> world = from_gymnasium(gymnasium.make("FrozenLake-v1"))
        >>> world.model, world.start, world.horizon
        (HorizonSSP(1,568 states, 4,288 pairs, 12,864 outcomes, 95 goals), {(0, 0): 1.0}, 100)
    """
    limit = step_limit_of(env)
    table, begin = _table_of(env), _start_of_environment(env, start)
    model = _model_of_environment(_GymListing(table, begin, goal), _cost_function(cost))
    logging.getLogger("ssp_lp.building").info("%r", model)
    if isinstance(horizon, str) and horizon != "env":
        raise wrong_argument("horizon", "be 'env', a number of steps or None", horizon)
    steps = limit if horizon == "env" else horizon
    if steps is None:
        return GymnasiumWorld(model, begin, limit, None)
    unrolled = within_steps(model, steps, start=begin)
    return GymnasiumWorld(unrolled, unrolled.start(begin), limit, steps)


def _table_of(env: gymnasium.Env[Any, Any]) -> Table:
    """The environment's table, with plain numbers, and probabilities that sum to one."""
    listed = getattr(env.unwrapped, "P", None)
    if listed is None:
        name = name_of_environment(env)
        raise ModelError(f"{name} is not tabular: it has no table of transitions, env.unwrapped.P")
    return {
        state: {action: _gym_outcomes(state, action, rows) for action, rows in _entries(actions)}
        for state, actions in _entries(listed)
    }


def _entries(listed: Any) -> list[tuple[Hashable, Any]]:
    """Keys and values of the environment's dict, or positions and entries of a list."""
    rows = listed.items() if isinstance(listed, Mapping) else enumerate(listed)
    return [(gym_value(key), value) for key, value in rows]


def gym_value(value: Any) -> Any:
    """A number of numpy's as one of Python's; anything else as it is."""
    return value.item() if isinstance(value, np.generic) else value


def _gym_outcomes(state: Hashable, action: Hashable, rows: Iterable[Any]) -> list[Outcome]:
    """The environment's outcomes of a pair, checked."""
    found = [(float(p), gym_value(to), float(reward), bool(over)) for p, to, reward, over in rows]
    total = fsum(p for p, *_ in found)
    if abs(total - 1.0) > SINGLE_PRECISION_SUM:
        raise ModelError(
            f"action {action!r} of state {state!r}: the table's probabilities sum to {total:.9g}"
        )
    return [(p / total, to, reward, over) for p, to, reward, over in found if p != 0.0]


def _start_of_environment(
    env: gymnasium.Env[Any, Any], start: Hashable | Mapping[Hashable, float] | None
) -> dict[Hashable, float]:
    """The states in which the environment's episodes begin, with their probabilities."""
    if start is None:
        shares = getattr(env.unwrapped, "initial_state_distrib", None)
        if shares is None:
            told = "the environment has no initial_state_distrib: give "
            raise ModelError(told, Argument("start"))
        start = {state: float(share) for state, share in _entries(shares)}
    if not isinstance(start, Mapping):
        return {gym_value(start): 1.0}
    total = fsum(start.values())
    if not abs(total - 1.0) <= SINGLE_PRECISION_SUM:
        raise ModelError(f"the start's probabilities sum to {total:.9g}")
    return {
        gym_value(state): float(share) / total for state, share in start.items() if share != 0.0
    }


def _cost_function(cost: str | CostFunction) -> CostFunction:
    """What a step of the environment costs, by its name or as given."""
    if callable(cost):
        return cost
    if cost not in _COSTS:
        raise wrong_argument("cost", "be 'step', 'reward' or a function", cost)
    return _COSTS[cost]


def _step_cost(state: Any, action: Any, next_state: Any, reward: float) -> float:
    return 1.0


def _reward_cost(state: Any, action: Any, next_state: Any, reward: float) -> float:
    return max(0.0, -reward)


_COSTS: dict[str, CostFunction] = {"step": _step_cost, "reward": _reward_cost}


def _model_of_environment(listing: _GymListing, cost: CostFunction) -> EnvironmentSSP:
    """The model of an environment: every state of its table, and the ends."""
    label = listing.label
    transitions: dict[Hashable, dict[Hashable, list[tuple[float, Hashable, float]]]] = {
        state: {
            action: [
                (p, label(to, over), cost(state, action, to, reward))
                for p, to, reward, over in rows
            ]
            for action, rows in actions.items()
        }
        for state, actions in listing.going.items()
    }
    for _, to, _, over in listing.steps:
        transitions.setdefault(label(to, over), {})
    goals = [label(state, True) for state in listing.goals]
    plain = SSP.from_transitions(transitions, goals, treat_actionless_as_dead_ends=True)
    fields = {name: getattr(plain, name) for name in SSP.__dataclass_fields__}
    return EnvironmentSSP(**fields, step_cost=cost)


@dataclass(frozen=True)
class _GymListing:
    """An environment's table, and which of its states are ends and goals."""

    table: Table
    begin: Mapping[Hashable, float]
    goal: Callable[[Any], bool] | None

    @cached_property
    def going(self) -> Table:
        """The rows of the environment's states in which an episode may go on."""
        return {s: actions for s, actions in self.table.items() if s not in self._only_ends}

    @cached_property
    def steps(self) -> list[Outcome]:
        """The environment's outcomes listed there."""
        return _gym_steps(self.going)

    @cached_property
    def goals(self) -> frozenset[Hashable]:
        """The environment's states that are goals, or end in one."""
        if self.goal is None:
            return frozenset(_rewarded(self.steps))
        every = {*self.table, *(to for _, to, _, _ in self.steps)}
        return frozenset(s for s in every if self.goal(s))

    def label(self, state: Hashable, over: bool) -> Hashable:
        """The model's state for one of the environment's: an end of its own where it needs one."""
        chosen = self.goal is not None and state in self.goals
        return (END, state) if over and state in self._goes_on and not chosen else state

    @cached_property
    def _goes_on(self) -> frozenset[Hashable]:
        return frozenset(self.begin) | {to for _, to, _, over in _gym_steps(self.table) if not over}

    @cached_property
    def _only_ends(self) -> frozenset[Hashable]:
        return frozenset(to for _, to, _, over in _gym_steps(self.table) if over) - self._goes_on


def _gym_steps(table: Table) -> list[Outcome]:
    """All outcomes in the environment's table."""
    return [row for actions in table.values() for rows in actions.values() for row in rows]


def _rewarded(steps: Iterable[Outcome]) -> list[Hashable]:
    """The states in which the environment terminates with a reward.

    Raises:
        ModelError: there are none, or one is entered with a reward and without.
    """
    rewards: dict[Hashable, list[float]] = {}
    for _, to, reward, over in steps:
        if over:
            rewards.setdefault(to, []).append(reward)
    for to, given in rewards.items():
        if min(given) <= 0.0 < max(given):
            raise ModelError(
                f"state {to!r} ends some episodes with a reward and some without: ", *_SAY_GOALS
            )
    goals = [to for to, given in rewards.items() if min(given) > 0.0]
    if not goals:
        ends = list(rewards)[:5]
        told = f"no step into one of the environment's ends {ends} is rewarded: "
        raise ModelError(told, *_SAY_GOALS)
    return goals
