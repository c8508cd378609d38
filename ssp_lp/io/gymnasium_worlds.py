"""Gymnasium's tabular environments as models, and policies played in these environments."""

from __future__ import annotations

import logging
import warnings
from bisect import bisect
from collections import Counter
from collections.abc import Callable, Container, Hashable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache, cached_property, partial
from itertools import chain
from math import fsum
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from ssp_lp.analysis import simulation
from ssp_lp.analysis.simulation import Estimate
from ssp_lp.arrays import (
    SINGLE_PRECISION_SUM,
    BoolArray,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    fields_of,
    offsets_of,
    read_only,
)
from ssp_lp.errors import (
    Argument,
    ModelError,
    attributes_of,
    check_between_0_and_1,
    check_whole,
    did_you_mean,
    in_short,
    optional_module,
    wrong_argument,
)
from ssp_lp.model.arguments import explained
from ssp_lp.model.continuous_model import ContinuousModel, Coordinates, Grid
from ssp_lp.model.discretise import Quadrature, discretise
from ssp_lp.model.graph import dead_ends
from ssp_lp.model.product import ProductSSP, within_steps
from ssp_lp.model.report import Facts, Table
from ssp_lp.model.ssp import SSP, StateSet, no_lone_string
from ssp_lp.policies import MixedPolicy, Policy
from ssp_lp.policies.policy import GIVE_UP_CODE, MOST_EPISODES, UNDECIDED, as_lottery, check_costs
from ssp_lp.policies.remembering import on_original

if TYPE_CHECKING:
    import gymnasium

END = "end"
"""First part of ("end", state), the end in a state in which only some steps terminate."""

CostFunction = Callable[[Any, Any, Any, float], float]
"""``(state, action, next_state, reward) -> cost``."""

_SAY_GOALS = "say which states are goals: ", Argument("goal")


@dataclass(frozen=True, eq=False, repr=False)
class EnvironmentSSP(SSP):
    """The model of an environment; ``step_cost`` is the function that gives the cost of a step."""

    step_cost: CostFunction = field(kw_only=True)

    @cached_property
    def ends(self) -> frozenset[Hashable]:
        """States of the environment in which an episode ends after some steps, not after all."""
        return frozenset(
            label[1] for label in self.states if isinstance(label, tuple) and label[0] == END
        )

    def label(self, state: Hashable, terminated: bool) -> Hashable:
        """Return the model's state that stands for a state of the environment after a step.

        If only some steps into a state terminate, a step that does so leads to the end of the
        state, ("end", state).
        """
        return (END, state) if terminated and state in self.ends else state

    def ends_among(self, listed: Callable[[Any], bool], label: Any) -> bool:
        """Return whether a state of the model means that an episode ended in a listed state.

        Args:
            listed: predicate on states of the environment.
            label: state of the model.
        """
        is_end = isinstance(label, tuple) and label[0] == END
        return listed(label[1]) if is_end else label not in self.ends and bool(listed(label))

    def seen(self, env: Any, observation: Any) -> Any:
        """Return the state of the environment that an observation shows."""
        return _plain(observation)

    def check_step(self, pair: int, state: int) -> None:
        """Raise ModelError unless a pair of the model can lead to this state."""
        if state not in self.successors[slice(*self.outcome_offsets[pair : pair + 2].tolist())]:
            raise ModelError(
                f"{self.describe_pair(pair)} led to {self.states[state]!r}, which the "
                "policy's model does not list: the environment is another one than the model's, or "
                "env.unwrapped.P is incomplete"
            )


@dataclass(frozen=True, eq=False, repr=False)
class GridSSP(EnvironmentSSP):
    """A model of an environment whose states are coordinates; the model's states are grid cells."""

    world: ContinuousModel = field(kw_only=True)
    is_goal: Callable[[Any], bool] = field(kw_only=True)  # of a point in which it terminates

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as a plain SSP, since the environment cannot leave its process."""
        return partial(SSP, **fields_of(self, SSP)), ()

    def seen(self, env: Any, observation: Any) -> tuple[float, ...]:
        """Return the environment's exact coordinates; the observation has them rounded."""
        return tuple(map(float, env.unwrapped.state))

    def label(self, state: Any, terminated: bool) -> int:
        """Return the cell of a point, or after the last step the state of the goal or dead-end."""
        if terminated:
            return self.world.end_state("goal" if self.is_goal(state) else FAILED)
        is_inside = _is_in_box(self.world.grid, state)
        return self.world.grid.cell_of(state) if is_inside else self.world.end_state(OUTSIDE)

    def check_step(self, pair: int, state: int) -> None:
        """Accept every step: some points of a cell were not tried and may lead elsewhere."""


@dataclass(frozen=True, eq=False)
class GymnasiumWorld:
    """An environment as a model, with the start of its episodes."""

    model: SSP  # an EnvironmentSSP, or one of cells; with a horizon a HorizonSSP
    start: Mapping[Hashable, float]  # the model's states, with probabilities
    step_limit: int | None  # steps after which the environment cuts an episode off
    horizon: int | None  # steps within which the model requires the goal
    continuous: ContinuousModel | None = None  # the world that was discretised, of coordinates

    def __repr__(self) -> str:
        """Return a line with the model, where episodes begin, and the horizon."""
        begins = in_short(dict(self.start))
        return f"GymnasiumWorld({self.model!r}, start={begins}, horizon={self.horizon})"


@explained
def from_gymnasium(
    env: gymnasium.Env[Any, Any],
    *,
    goal: StateSet | None = None,
    cost: Literal["step", "reward"] | CostFunction = "step",
    horizon: Literal["env"] | int | None = "env",
    start: Hashable | Mapping[Hashable, float] | None = None,
    grid: Grid | None = None,
    survive: bool = False,
    dead_ends: StateSet | None = None,
) -> GymnasiumWorld:
    """Build the model of an environment from its table of transitions or, without one, on a grid.

    States in which the environment terminates are goals if every step into them is rewarded, and
    dead-ends if none is. If the environment terminates in a state after one step and continues
    after another (as in Taxi's table), the state has a separate end, ("end", state).

    Args:
        env: an environment with ``env.unwrapped.P[state][action]``, a list of (probability, next
            state, reward, terminated). Wrappers that change observations, actions or rewards are
            ignored.
        goal: the goal states, whatever the rewards, or a predicate on states; other states in which
            the environment terminates are dead-ends.
        cost: "step": 1 for each step; "reward": minus the reward if it is negative, else 0
            (positive rewards are ignored); or ``(state, action, next_state, reward) -> cost``.
        horizon: "env": the goal must be reached within the environment's own step limit
            (``TimeLimit``), if it has one, so that certificates hold in the environment; a number:
            within this number of steps; None: at any time (`rollout` reports truncated episodes).
        start: a state or ``{state: probability}``; None: the environment's own distribution. With a
            grid it is a point, or ``{point: probability}``.
        grid: for an environment whose state is an array of coordinates (MountainCar, CartPole): a
            box of the coordinates and its cells. ``goal`` is then a predicate on the points in
            which the environment terminates, or a set of cells of the grid, and ``horizon="env"``
            means no horizon: give the number of steps. In each cell steps are tried from a lattice
            of points, three along each coordinate.
        survive: whether an episode that has not ended by the horizon has reached the goal.
        dead_ends: the states, other than goals, in which the environment terminates, or a predicate
            on states; if one is missing here, that is an error. With a grid: "failed" and
            "outside".

    Returns:
        The model, its start and the step limit. With a horizon the model's states are (state, steps
        taken): see :func:`~ssp_lp.model.product.within_steps`. With a grid they are its cells, and
        ``continuous`` is the discretised world, for ``WorldSimulator``.

    Raises:
        MissingDependencyError: gymnasium is not installed.
        ModelError: no table, no start, a wrong table or option, or goals that do not follow from
            the rewards; ``survive`` without a horizon.

    Example:
        >>> import gymnasium
        >>> world = from_gymnasium(gymnasium.make("FrozenLake-v1"))
        >>> world.model, world.start, world.horizon
        (HorizonSSP(1,568 states, 4,288 pairs, 12,864 outcomes, 95 goals), {(0, 0): 1.0}, 100)
    """
    limit = _step_limit_of(env)
    if not callable(cost) and cost not in _COSTS:
        raise wrong_argument("cost", "be 'step', 'reward' or a function", cost)
    if isinstance(horizon, str) and horizon != "env":
        raise wrong_argument("horizon", "be 'env', a number of steps or None", horizon)
    paid: CostFunction = cost if callable(cost) else _COSTS[cost]
    model: SSP
    begin: Mapping[Hashable, float]
    continuous, steps = None, horizon
    if isinstance(steps, str):  # the environment's own, which is not a horizon of a grid
        steps = limit if grid is None else None
    if grid is None:
        table, begin = _table_of(env), _start_of(env, start)
        _predicate(table, "start", begin)
        model = _model_of_table(table, begin, _predicate(table, "goal", goal), paid)
        if (is_dead_end := _predicate(table, "dead_ends", dead_ends)) is not None:
            model.with_dead_ends(partial(model.ends_among, is_dead_end))
    else:
        if goal is None or start is None:
            missing = "goal" if goal is None else "start"
            raise ModelError("with a grid, give ", Argument(missing), " in coordinates")
        if not callable(goal):
            goal = partial(_is_in_cells, grid, {*no_lone_string(goal, "goal")})
        continuous = continuous_from_gymnasium(env, grid, goal=goal, cost=paid)
        plain = discretise(continuous, Quadrature(3)).with_dead_ends(dead_ends)
        model = GridSSP(**fields_of(plain, SSP), world=continuous, is_goal=goal, step_cost=paid)
        points = start if isinstance(start, Mapping) else {start: 1.0}
        begin = {grid.cell_of(cast("tuple[float, ...]", p)): w for p, w in points.items()}
    logging.getLogger("ssp_lp.building").info("%r", model)
    if steps is None:
        if survive:
            raise ModelError("survive=True needs a number of steps: ", Argument("horizon"))
        return GymnasiumWorld(model, begin, limit, None, continuous)
    ends = () if continuous is None else tuple(continuous.dead_ends)  # absorbing, with actions
    unrolled = within_steps(model, steps, start=begin, survive=ends if survive else False)
    return GymnasiumWorld(unrolled, unrolled.start(begin), limit, steps, continuous)


def _predicate(table: _Table, name: str, listed: StateSet | None) -> Callable[[Any], bool] | None:
    """Return the predicate of a set of the environment's states, None without a set.

    ``name`` is the argument that gives the set, for errors. A predicate is returned unchanged.

    Raises:
        ModelError: a state that the table does not have.
    """
    if listed is None or callable(listed):
        return listed
    members = {_plain(state) for state in no_lone_string(listed, name)}
    for state in members.difference(table.states):
        nearest = did_you_mean(state, table.states, "its states:")
        raise ModelError(f"{name}: {state!r} is not a state of the environment{nearest}")
    return members.__contains__


def _is_in_cells(grid: Grid, cells: Container[Hashable], point: tuple[float, ...]) -> bool:
    """Return whether a point lies in the box of a grid, in one of some cells."""
    return _is_in_box(grid, point) and grid.cell_of(point) in cells


def _is_in_box(grid: Grid, point: tuple[float, ...]) -> bool:
    return not grid.misses(grid.heights(tuple(map(np.asarray, point)))).any()


FAILED, OUTSIDE = "failed", "outside"
"""Dead-ends of a continuous environment: it ended outside the goal, or left the box."""


@explained
def continuous_from_gymnasium(
    env: gymnasium.Env[Any, Any],
    grid: Grid,
    *,
    goal: Callable[[tuple[float, ...]], bool],
    cost: Callable[[tuple[float, ...], Any, tuple[float, ...], float], float] | None = None,
) -> ContinuousModel:
    """Return the continuous world of an environment whose state is an array of coordinates.

    Its step function sets ``env.unwrapped.state`` to a point and takes one step there:
    ``discretise`` makes a model of it, and ``WorldSimulator`` plays policies in the environment's
    own dynamics. Random numbers that the environment draws in a step are drawn once at each point.
    CartPole and MountainCar are such environments.

    Args:
        env: an environment with discrete actions, which is stepped: do not use it elsewhere.
        grid: a box of the coordinates, an axis for each, and its cells.
        goal: predicate on coordinates in which the environment terminates: True means success,
            False the dead-end "failed".
        cost: ``(point, action, next point, reward) -> cost``; None: 1 for each step.

    Raises:
        MissingDependencyError: gymnasium is not installed.
        ModelError: it has no such state, other coordinates than the grid, or other actions.
    """
    _step_limit_of(env)
    bare: Any = env.unwrapped
    bare.reset(seed=0)
    state: Any = attributes_of(bare, "state").get("state")
    if np.shape(state) != (len(grid.axes),):
        raise ModelError(
            f"{_name_of(env)}: env.unwrapped.state must be {len(grid.axes)} coordinates, one for "
            f"each axis, not {in_short(state)}"
        )
    actions = bare.action_space
    if not isinstance(actions, optional_module("gymnasium.spaces", "gym").Discrete):
        raise ModelError(f"{_name_of(env)} has no discrete actions: {actions}")
    kind = np.asarray(state).dtype

    def step(point: Coordinates, action: Hashable, noise: Coordinates) -> Any:
        """Take a step from each of many points, one by one; return points, costs and ends."""
        places = np.broadcast_arrays(*point)
        after = np.empty((len(places), *places[0].shape))
        paid, ends = np.ones(places[0].shape), np.zeros(places[0].shape, dtype=np.int64)
        for at in np.ndindex(places[0].shape):
            here = tuple(float(each[at]) for each in places)
            bare.state = np.array(here, dtype=kind)
            _, reward, terminated, *_ = bare.step(action)
            there = tuple(map(float, bare.state))
            after[:, *at] = there
            if cost is not None:
                paid[at] = cost(here, action, there, float(reward))
            if terminated:
                ends[at] = 1 if goal(there) else 2
                bare.reset()  # some count the steps that are taken after an end
        return tuple(after), paid, ends

    return ContinuousModel(
        grid,
        actions=tuple(range(int(actions.start), int(actions.start + actions.n))),
        step=step,
        dead_ends={FAILED: 0.0, OUTSIDE: 0.0},
        outside=OUTSIDE,
    )


def _step_limit_of(env: gymnasium.Env[Any, Any]) -> int | None:
    """Return the number of steps of the environment's ``TimeLimit``, or None.

    Raises:
        MissingDependencyError: gymnasium is not installed.
        ModelError: the argument is no environment.
    """
    base, wrappers = (optional_module(name, "gym") for name in ("gymnasium", "gymnasium.wrappers"))
    if not attributes_of(env, "unwrapped"):
        message = "an environment is needed, such as gymnasium.make('FrozenLake-v1'), not "
        raise ModelError(f"{message}{in_short(env)}")
    limits, layer = [], env
    while isinstance(layer, base.Wrapper):
        if isinstance(layer, wrappers.TimeLimit):
            limits.append(int(layer._max_episode_steps))
        layer = layer.env
    return min(limits, default=None)


def _name_of(env: Any) -> str:
    """Return the name of an environment, or of its class if it has none."""
    return str(env.spec.id if env.spec is not None else type(env.unwrapped).__name__)


class _Table(NamedTuple):
    """Transitions of an environment as arrays; states that its table lacks come last."""

    states: list[Hashable]  # [states]
    listed: int  # number of states in the table
    pair_state: IntArray  # [pairs]
    actions: list[Hashable]  # [pairs]
    pair: IntArray  # [outcomes]
    probability: FloatArray  # [outcomes], > 0
    target: IntArray  # [outcomes]
    reward: FloatArray  # [outcomes]
    over: BoolArray  # [outcomes] whether an episode terminates


def _table_of(env: gymnasium.Env[Any, Any]) -> _Table:
    """Return the transitions that an environment lists in ``env.unwrapped.P``.

    Raises:
        ModelError: no table, or an outcome that is not four entries.
    """
    listed = attributes_of(env.unwrapped, "P").get("P")
    if listed is None:
        raise ModelError(
            f"{_name_of(env)} is not tabular: it has no table of transitions, env.unwrapped.P; "
            "if its state is coordinates, continuous_from_gymnasium(env, grid, goal=...) makes "
            "a simulator of it for discretise; if you know the probabilities of its steps, "
            "SSP.from_successors takes a function (docs/models.md)"
        )
    # no lists of lists, which would take longer to collect than all the rest
    names, tables = _keys(listed), list(_values(listed))
    index = {_plain(name): k for k, name in enumerate(names)}
    actions = list(map(_plain, chain.from_iterable(map(_keys, tables))))
    outcomes = list(chain.from_iterable(map(_values, tables)))
    pair_state = np.repeat(np.arange(len(tables)), list(map(len, tables)))
    pair = np.repeat(np.arange(len(outcomes)), list(map(len, outcomes)))
    entries = list(chain.from_iterable(outcomes))
    if set(map(len, entries)) - {4}:
        raise ModelError("outcomes in env.unwrapped.P must be (p, state, reward, terminated)")
    flat = list(chain.from_iterable(entries))
    probability, targets = np.array(flat[::4], dtype=np.float64), flat[1::4]
    for state in dict.fromkeys(targets):
        index.setdefault(_plain(state), len(index))
    occurs = probability != 0.0
    return _Table(
        states=list(index),
        listed=len(tables),
        pair_state=pair_state,
        actions=actions,
        pair=pair[occurs],
        probability=probability[occurs],
        target=np.fromiter(map(index.__getitem__, targets), np.int64, len(targets))[occurs],
        reward=np.array(flat[2::4], dtype=np.float64)[occurs],
        over=np.array(flat[3::4], dtype=np.bool_)[occurs],
    )


def _keys(listed: Any) -> Any:
    """Return the keys of a dict, or the positions in a list."""
    return listed if isinstance(listed, Mapping) else range(len(listed))


def _values(listed: Any) -> Any:
    """Return the values of a dict, or the entries of a list."""
    return listed.values() if isinstance(listed, Mapping) else listed


def _plain(value: Any) -> Any:
    """Return a number of numpy as a number of Python, and any other value unchanged."""
    return value.item() if isinstance(value, np.generic) else value


def _start_of(
    env: gymnasium.Env[Any, Any], start: Hashable | Mapping[Hashable, float] | None
) -> dict[Hashable, float]:
    """Return the states in which the environment's episodes begin, with probabilities."""
    if start is None:
        declared = attributes_of(env.unwrapped, "initial_state_distrib")
        if not declared:
            message = "the environment has no initial_state_distrib: give "
            raise ModelError(message, Argument("start"))
        shares = declared["initial_state_distrib"]
        start = dict(zip(_keys(shares), map(float, _values(shares)), strict=True))
    if not isinstance(start, Mapping):
        return {_plain(start): 1.0}
    total = fsum(start.values())
    if not abs(total - 1.0) <= SINGLE_PRECISION_SUM:
        raise ModelError(f"the start's probabilities sum to {total:.9g}")
    return {_plain(state): float(share) / total for state, share in start.items() if share != 0.0}


def _step_cost(state: Any, action: Any, next_state: Any, reward: float) -> float:
    return 1.0


def _reward_cost(state: Any, action: Any, next_state: Any, reward: float) -> float:
    return max(0.0, -reward)


_COSTS: dict[str, CostFunction] = {"step": _step_cost, "reward": _reward_cost}


def _model_of_table(
    table: _Table,
    begin: Mapping[Hashable, float],
    goal: Callable[[Any], bool] | None,
    cost: CostFunction,
) -> EnvironmentSSP:
    """Return the model of an environment's table.

    A state in which only some steps terminate gets a separate end, ("end", state).

    Args:
        table: table of the environment.
        begin: the states in which episodes begin.
        goal: predicate on states; None: the goals are the states in which episodes terminate and
            into which every step is rewarded.
        cost: function that returns the cost of a step.

    Raises:
        ModelError: goals that do not follow from rewards, probabilities that do not sum to one, or
            a cost that is not a number >= 0.
    """
    n_states = len(table.states)
    listed = np.arange(n_states) < table.listed
    goes_on = np.array([state in begin for state in table.states])
    goes_on[table.target[~table.over]] = True
    going = listed.copy()
    going[table.target[table.over]] = False  # an end, unless an episode may go on from there
    going |= listed & goes_on
    steps = np.flatnonzero(going[table.pair_state[table.pair]])
    target, over = table.target[steps], table.over[steps]
    if goal is None:
        goals, parted = _rewarded(table, steps), goes_on
    else:
        listed[target] = True
        asked = zip(listed.tolist(), table.states, strict=True)
        goals = np.array([known and bool(goal(state)) for known, state in asked])
        parted = goes_on & ~goals
    # a separate end of a state from which episodes may go on has a number n_states higher
    led = target + n_states * (over & parted[target])
    reached, first = np.unique(led, return_index=True)
    aims = np.flatnonzero(goals) + n_states * parted[goals]
    numbered = np.concatenate([np.flatnonzero(going), reached[np.argsort(first)], aims])
    order = np.array(list(dict.fromkeys(numbered.tolist())), dtype=np.int64)
    number = np.full(2 * n_states, -1)
    number[order] = np.arange(order.size)
    acting = (going & ~(goals & ~parted))[table.pair_state]
    taken = acting[table.pair[steps]]
    kept = steps[taken]
    costs, exact = _costs_of_outcomes(table, kept, cost)
    plain = SSP.from_arrays(
        pair_offsets=offsets_of(
            np.bincount(number[table.pair_state[acting]], minlength=order.size)
        ),
        outcome_offsets=offsets_of(np.bincount(table.pair[kept], minlength=acting.size)[acting]),
        successors=number[led[taken]],
        probabilities=table.probability[kept],
        costs=costs,
        goal_states=number[aims],
        states=[
            (END, table.states[k - n_states]) if k >= n_states else table.states[k]
            for k in order.tolist()
        ],
        actions=[table.actions[k] for k in np.flatnonzero(acting).tolist()],
        exact_costs=exact,
        treat_actionless_as_dead_ends=True,
        normalise=True,
    )
    return EnvironmentSSP(**fields_of(plain, SSP), step_cost=cost)


def _costs_of_outcomes(
    table: _Table, kept: IntArray, cost: CostFunction
) -> tuple[npt.ArrayLike, dict[float, Fraction]]:
    """Return the costs of some outcomes of a table, and the fraction that each float stands for.

    ``kept`` has the indices of the outcomes. Only costs given as fractions are in the dict.
    """
    if cost is _step_cost:
        return 1.0, {}
    if cost is _reward_cost:
        return np.maximum(-table.reward[kept], 0.0) + 0.0, {}
    pair = table.pair[kept].tolist()
    columns = table.pair_state[pair].tolist(), pair, table.target[kept].tolist()
    names, actions = table.states, table.actions
    paid: list[Any] = [
        cost(names[state], actions[k], names[to], reward)
        for state, k, to, reward in zip(*columns, table.reward[kept].tolist(), strict=True)
    ]
    return paid, {float(one): one for one in paid if isinstance(one, Fraction)}


def _rewarded(table: _Table, steps: IntArray) -> BoolArray:
    """Return a mask of the states in which the environment terminates with a reward, [states].

    ``steps`` are the indices of the outcomes to consider.

    Raises:
        ModelError: no step that terminates is rewarded, or some steps into a state are and others
            are not.
    """
    ending = steps[table.over[steps]]
    to, reward = table.target[ending], table.reward[ending]
    least, most = np.full((2, len(table.states)), np.inf) * [[1.0], [-1.0]]
    np.minimum.at(least, to, reward)
    np.maximum.at(most, to, reward)
    mixed = (least <= 0.0) & (most > 0.0)
    if mixed.any():
        state = table.states[int(to[int(np.argmax(mixed[to]))])]
        raise ModelError(
            f"state {state!r} ends some episodes with a reward and some without: ", *_SAY_GOALS
        )
    goals = (least > 0.0) & (most > 0.0)
    if not goals.any():
        ends = [table.states[k] for k in list(dict.fromkeys(to.tolist()))[:5]]
        message = f"no step into a terminal state, {ends}, has a reward above 0: "
        raise ModelError(message, *_SAY_GOALS)
    return np.asarray(goals)


class StepLimitWarning(UserWarning):
    """The environment cut episodes off by a step limit that the policy's model does not have."""


_ENDS = "goal", "failed", "gave_up", "truncated"  # of an episode in an environment


@dataclass(frozen=True, eq=False, repr=False)
class RolloutReport(Facts, ReadOnlyCopies):
    """Counts of the episodes that were rolled out in an environment."""

    episodes: int
    goal: int  # reached the goal
    failed: int  # ended elsewhere, or where the goal is unreachable
    gave_up: int  # the policy gave up, such as with too few steps left
    truncated: int  # cut off by a limit on the steps
    goal_probability: Estimate
    failure_probability: Estimate  # for any reason
    conditional_cost: Estimate  # mean cost of the episodes that reached the goal
    success_costs: FloatArray  # [goal] their costs
    mean_steps: float
    step_limit: int | None  # of the environment

    def tables(self) -> list[Table]:
        """Return a table of the ends of the episodes and their costs, with intervals."""
        counts = self.goal, self.failed, self.gave_up, self.truncated
        ends = dict(zip(_ENDS, counts, strict=True))
        return [
            Table([
                ("episodes", self.episodes),
                ("ends", ends),
                ("goal probability", self.goal_probability),
                ("failure probability", self.failure_probability),
                ("cost given success", self.conditional_cost),
                ("mean steps", self.mean_steps),
                ("note", "costs are cut where truncated" if self.goal and self.truncated else ""),
            ])
        ]  # fmt: skip


@explained
def rollout(
    env: gymnasium.Env[Any, Any],
    policy: Policy | MixedPolicy,
    *,
    episodes: int,
    seed: int = 0,
    max_steps: int | None = None,
    confidence: float = 0.95,
) -> RolloutReport:
    """Play a policy in the environment, step by step, and count how the episodes end.

    A lottery draws one member for each episode. An episode ends at a goal or a dead-end of the
    model, when the policy gives up, or when it is cut off: by the environment, by the policy's
    horizon, or after ``max_steps``. If the policy has decisions after failing, a failed episode
    goes on, and counts as failed whatever follows.

    Args:
        env: the environment; it is reset before each episode, and not closed. An environment that
            renders each step, or a wrapper that records, shows the policy at play.
        policy: a policy of a problem on ``from_gymnasium(env).model``, or on a product with it.
        episodes: number of episodes.
        seed: seed of the environment and of the policy's draws; equal seeds give equal episodes.
        max_steps: steps after which an episode is cut off; None: 10,000.
        confidence: confidence of the intervals, in (0, 1).

    Raises:
        MissingDependencyError: gymnasium is not installed.
        ModelError: wrong arguments, another policy, or an environment that leaves its table.

    Warns:
        StepLimitWarning: the environment cut off episodes by a step limit that the policy's model
            does not have, so that the certificate need not hold in the environment.
    """
    check_between_0_and_1("confidence", confidence)
    check_whole("episodes", episodes, most=MOST_EPISODES)
    max_steps = 10_000 if max_steps is None else max_steps  # as in ``simulate``
    check_whole("max_steps", max_steps)
    check_whole("seed", seed, 0)
    lottery = as_lottery(policy)
    while isinstance(lottery.model, ProductSSP):
        lottery = on_original(lottery)
    model = lottery.model
    if not isinstance(model, EnvironmentSSP):
        raise ModelError("the policy's model has no environment: make it by from_gymnasium(env)")
    limit, step_limits = _step_limit_of(env), [member.step_limit for member in lottery.policies]
    horizon = None if None in step_limits else min(cast("list[int]", step_limits))
    most = max_steps if horizon is None else min(max_steps, horizon)
    theirs, ours = np.random.SeedSequence(seed).spawn(2)  # one stream would couple their draws
    env.reset(seed=int(theirs.generate_state(1)[0]))
    player = _Player(lottery, np.random.default_rng(ours))
    played = [_play_episode(env, player, most) for _ in range(episodes)]
    count, cut_off = Counter(one.end for one in played), sum(one.is_cut_off for one in played)
    if cut_off and (horizon is None or limit is None or horizon > limit):
        by = "a wrapper of its own" if limit is None else f"TimeLimit, max_episode_steps={limit}"
        warnings.warn(
            f"{_name_of(env)} cut off {cut_off:,} of {episodes:,} episodes ({by}), but the "
            "policy's model has no step limit, or a longer one: build it with a horizon",
            StepLimitWarning,
            stacklevel=3,  # past the rollout and the wrapper that explains its errors
        )
    costs = np.array([one.cost for one in played if one.end == "goal"])
    # points of a cell may lead where the model's outcomes do not
    taken = None if isinstance(model, GridSSP) else simulation.pairs_taken(lottery, model)
    dearest, _ = simulation.greatest_total(model, min(most, limit or most), taken)
    proportion = partial(simulation.proportion_estimate, trials=episodes, confidence=confidence)
    return RolloutReport(
        episodes=episodes,
        **{end: count[end] for end in _ENDS},
        goal_probability=proportion(count["goal"]),
        failure_probability=proportion(episodes - count["goal"]),
        conditional_cost=simulation.mean_estimate(costs, confidence, dearest),
        success_costs=read_only(costs),
        mean_steps=float(np.mean([one.steps for one in played])),
        step_limit=limit,
    )


class _Episode(NamedTuple):
    """Result of an episode."""

    end: str  # a count of the report
    cost: float
    steps: int
    is_cut_off: bool = False  # by the environment


class _Player:
    """The members of a lottery, with their decisions and memories cached."""

    def __init__(self, lottery: MixedPolicy, rng: np.random.Generator) -> None:
        """Prepare the members of a lottery; ``rng`` draws them and their random actions."""
        self.model, self.lottery, self.rng = cast(EnvironmentSSP, lottery.model), lottery, rng
        self.over = dead_ends(lottery.model) | lottery.model.goal_mask  # [states]
        self._branches, self.remember = cache(self._branches_of), cache(_memory_after)
        self.ended = cache(lambda member: member.ended)  # [states], whatever came before

    def decide(self, member: Policy, state: int, memory: int) -> tuple[int, int]:
        """Draw a decision, a pair or GIVE_UP_CODE; return it and the memory after it."""
        pairs, kept, cumulative = self._branches(member, state, memory)
        drawn = 0
        if len(pairs) > 1:
            drawn = min(bisect(cumulative, self.rng.random() * cumulative[-1]), len(pairs) - 1)
        return pairs[drawn], kept[drawn]

    def _branches_of(
        self, member: Policy, state: int, memory: int
    ) -> tuple[list[int], list[int], list[float]]:
        """Return the possible decisions: pairs, memories after each, cumulative probabilities."""
        branches = member.branches(np.array([state]), np.array([memory]))
        kept = branches.kept(np.array([memory]))
        if UNDECIDED in branches.pair:
            raise ModelError(
                f"the policy has no decision in state {self.model.states[state]!r}: "
                "solution.policy_everywhere() has one in every state"
            )
        return branches.pair.tolist(), kept.tolist(), np.cumsum(branches.probability).tolist()


def _memory_after(member: Policy, memory: int, pair: int, state: int, cost: float) -> int:
    """Return the memory of a policy after a step by the given pair into the given state."""
    step = (np.array([part]) for part in (memory, pair, state, cost))
    return int(member.remember(*step)[0])


_SEEN = "observed in the environment: the policy's model may be of another one"


def _play_episode(env: gymnasium.Env[Any, Any], player: _Player, most: int) -> _Episode:
    """Play an episode of at most ``most`` steps in an environment.

    Raises:
        ModelError: the environment leaves its table, or a step has a wrong cost.
    """
    model, over, lottery = player.model, player.over, player.lottery
    member = lottery.policies[int(player.rng.choice(len(lottery.policies), p=lottery.weights))]
    shown, cost, steps = model.seen(env, env.reset()[0]), 0.0, 0
    state, ended = model.index_of(model.label(shown, False), _SEEN), player.ended(member)
    memory, failed = 0 if ended[state] else int(member.start_memory(np.array([state]))[0]), ""
    while not ended[state]:
        pair, kept = player.decide(member, state, memory)
        if pair == GIVE_UP_CODE or kept != memory:
            failed = failed or "gave_up"
        failed, memory = failed or ("failed" if over[state] else ""), kept
        if pair == GIVE_UP_CODE:
            break
        action, before = model.action_of(pair), shown
        seen, reward, terminated, truncated, _ = env.step(action)
        shown = model.seen(env, seen)
        state = model.index_of(model.label(shown, bool(terminated)), _SEEN)
        model.check_step(pair, state)
        if terminated and not over[state]:
            raise ModelError(
                f"the environment terminated in {model.states[state]!r}; env.unwrapped.P does not"
            )
        paid = float(model.step_cost(before, action, shown, float(reward)))
        check_costs(paid)
        cost, steps = cost + paid, steps + 1
        if not ended[state]:
            if truncated or steps == most:
                lost = failed or ("failed" if over[state] else "")
                return _Episode(lost or "truncated", cost, steps, bool(truncated))
            memory = player.remember(member, memory, pair, state, paid)
    return _Episode(failed or ("goal" if model.goal_mask[state] else "failed"), cost, steps)
