"""Families of models that differ in structure: acyclic, windy, narrow, connected, slow.

Games, queues and domains of the planning literature are included. Every model's start is state 0;
unless stated otherwise its live states come first, then one goal and one trap.
"""

from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any

import numpy as np

from ssp_lp import SSP
from ssp_lp.arrays import read_only

_SEED = 5
_LAVA = 0.01  # share of cells of a grid that are traps
_WIND = 0.1
_WAIT = 0.1  # probability of a step of a grid that leads nowhere
_CURRENT = 0.4
_DRIFT = 0.02
_SLIP = 1e-3  # probability of the trap over a corridor or a ring, walked carelessly
_LEAK = 1e-5  # probability of leaving the slow ring, per step


def layered(depth: int, width: int, *, seed: int = _SEED) -> SSP:
    """Return layers of states, each with 4 actions of 5 successors in the next one: no cycles."""
    rng, n, (actions, outcomes) = np.random.default_rng(seed), depth * width, (4, 5)
    shape, layer = (n, actions, outcomes), np.repeat(np.arange(depth), width)[:, None, None]
    successors = (layer + 1) * width + rng.integers(0, width, shape)
    successors = np.where(layer == depth - 1, n, successors)
    trapped = rng.random(shape) < 0.2 / depth
    weights = rng.random(shape) + 0.1
    costs = rng.integers(1, 10, (n, actions)).astype(float)
    return _model(np.where(trapped, n + 1, successors), _normalised(weights), costs)


def scattered(states: int, *, seed: int = _SEED) -> SSP:
    """Return a model of 4 actions with 5 successors each, drawn from all states: it mixes fast."""
    rng, shape = np.random.default_rng(seed), (states, 4, 5)
    successors, drawn = rng.integers(0, states, shape), rng.random(shape)
    successors = np.where(drawn < 0.01, states, np.where(drawn > 0.999, states + 1, successors))
    costs = rng.integers(1, 10, shape[:2]).astype(float)
    return _model(successors, _normalised(rng.random(shape) + 0.1), costs)


def grid(side: int, *, wind: float = _WIND, seed: int = _SEED) -> SSP:
    """Return a square with four moves, wind that takes a step further, and lava."""
    rng, n = np.random.default_rng(seed), side * side
    lava = rng.random(n) < _LAVA
    lava[:3] = lava[-3:] = False
    name = np.where(lava, n + 1, np.arange(n))
    name[n - 1] = n
    x, y = np.arange(n) % side, np.arange(n) // side
    successors = np.stack(
        [
            np.stack(
                [_cell(name, side, x + dx, y + dy), _cell(name, side, x + dx, y + dy + 1), name], 1
            )
            for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))
        ],
        axis=1,
    )
    shares = np.array([1.0 - _WAIT - wind, wind, _WAIT])
    costs = np.repeat(rng.integers(1, 4, n)[:, None], 4, axis=1).astype(float)
    return _model(successors, np.broadcast_to(shares, successors.shape), costs)


def river(width: int, height: int, *, current: float = _CURRENT) -> SSP:
    """Return the river of `domains.river`, without its waterfall's cells; costs are 1."""
    column, row = np.divmod(np.arange(width * (height - 1)), height - 1)
    n = column.size

    def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = np.clip(x, 0, width - 1), np.minimum(y, height - 2)
        fallen = np.where(x == width - 1, n, n + 1)
        return np.where(y < 0, fallen, x * (height - 1) + y)

    down = at(column, row - 1)
    water = (column > 0) & (column < width - 1) & (row < height - 2)
    moves = [down, at(column - 1, row), at(column + 1, row), at(column, row + 1)]
    successors = np.stack([np.stack([move, down], 1) for move in moves], axis=1)
    drifting = np.where(water[:, None] & (np.arange(4) > 0), current, 0.0)
    probabilities = np.stack([1.0 - drifting, drifting], axis=-1)
    return _model(successors, probabilities, np.ones((n, 4)))


def corridor(cells: int, *, drift: float = _DRIFT) -> SSP:
    """Return a random walk with a small drift: careless steps drift more and may be the last."""
    here, slip = np.arange(cells), _SLIP / cells
    steps = np.stack([np.maximum(here - 1, 0), here + 1, np.full(cells, cells + 1)], axis=1)
    careless = [0.5 - drift / 2 - slip, 0.5 + drift / 2, slip]
    careful = [0.5 - drift / 4 - slip / 10, 0.5 + drift / 4, slip / 10]
    probabilities = np.broadcast_to([careless, careful], (cells, 2, 3))
    return _model(np.stack([steps, steps], axis=1), probabilities, np.ones((cells, 2)))


def rooms(count: int, side: int, *, seed: int = _SEED) -> SSP:
    """Return windy rooms one after the other, strongly connected each, with doors one way."""
    rng, size = np.random.default_rng(seed), side * side
    n, x, y = count * size, np.arange(size) % side, np.arange(size) // side
    name = np.arange(size)
    inner = np.stack(
        [
            np.stack([_cell(name, side, x + dx, y + dy), _cell(name, side, x + dx, y + dy + 1)], 1)
            for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))
        ],
        axis=1,
    )
    successors = np.arange(count)[:, None, None, None] * size + inner
    successors[:, size - 1] = np.arange(1, count + 1)[:, None, None] * size
    trap = np.full((*successors.shape[:3], 1), n + 1)
    successors = np.concatenate([successors, trap], axis=-1).reshape(n, 4, 3)
    risk = rng.choice([0.0, 1e-4], (n, 4), p=[0.7, 0.3]) / count * 10
    risk.reshape(count, size, 4)[:, :, 0] = 0.0
    kept = (1.0 - risk)[..., None]
    probabilities = np.concatenate([kept * 0.85, kept * 0.15, risk[..., None]], axis=-1)
    return _model(successors, probabilities, rng.integers(1, 4, (n, 4)).astype(float))


def ring(states: int, *, leak: float = _LEAK) -> SSP:
    """Return a ring that is rarely left, by an expensive and sure way or a cheap and risky one."""
    here = np.arange(states)
    on, back = (here + 1) % states, (here - 1) % states
    goal, trap = np.full(states, states), np.full(states, states + 1)
    successors = np.stack([np.stack([on, back, goal, trap], 1)] * 2, axis=1)
    sure, risky = [0.6 - leak, 0.4, leak, 0.0], [0.6 - 2 * leak, 0.4, 1.8 * leak, 0.2 * leak]
    probabilities = np.broadcast_to([sure, risky], (states, 2, 4))
    costs = np.stack([1.0 + 0.1 * (here % 7), 1.0 + 0.1 * (here % 5)], axis=1)
    return _model(successors, probabilities, costs)


def holes(side: int, *, slip: float = 0.2, share: float = 0.07, seed: int = _SEED) -> SSP:
    """Return a square with four moves that slip to either side, and holes; its corners are free.

    A careful robot enters a hole only by slips, so the least failure probability is tiny.
    """
    rng, n = np.random.default_rng(seed), side * side
    x, y = np.arange(n) % side, np.arange(n) // side
    is_hole = (rng.random(n) < share) & (x + y > 2) & (x + y < 2 * side - 4)
    name = np.where(is_hole, n + 1, np.arange(n))
    name[n - 1] = n
    moves = ((1, 0), (0, 1), (-1, 0), (0, -1))
    ahead = np.stack([_cell(name, side, x + dx, y + dy) for dx, dy in moves], axis=1)
    successors = np.stack([ahead, np.roll(ahead, 1, axis=1), np.roll(ahead, -1, axis=1)], axis=-1)
    shares = np.broadcast_to([1.0 - slip, slip / 2, slip / 2], successors.shape)
    return _model(successors, shares, np.ones((n, 4)))


def headings(side: int, *, directions: int = 8, seed: int = _SEED) -> SSP:
    """Return a vehicle on a square that turns by one direction or none, with noise, and holes."""
    rng, cells = np.random.default_rng(seed), side * side
    x, y = np.arange(cells) % side, np.arange(cells) // side
    is_hole = (rng.random(cells) < 0.04) & (x + y > 3) & (x + y < 2 * side - 5)
    angle = 2.0 * np.pi * np.arange(directions) / directions
    dx, dy = np.rint(np.cos(angle)).astype(int), np.rint(np.sin(angle)).astype(int)
    cell, heading = np.divmod(np.arange(cells * directions), directions)
    turned = (heading[:, None] + np.arange(-2, 3)) % directions
    ahead_x, ahead_y = x[cell][:, None] + dx[turned], y[cell][:, None] + dy[turned]
    is_inside = (ahead_x == np.clip(ahead_x, 0, side - 1)) & (
        ahead_y == np.clip(ahead_y, 0, side - 1)
    )
    there = np.clip(ahead_y, 0, side - 1) * side + np.clip(ahead_x, 0, side - 1)
    n, is_goal = cell.size, ahead_x + ahead_y >= 2 * side - 4
    after = np.where(is_inside & ~is_hole[there], there * directions + turned, n + 1)
    after = np.where(is_inside & is_goal, n, after)
    successors = np.stack([after[:, k : k + 3] for k in range(3)], axis=1)
    shares = np.broadcast_to([0.1, 0.8, 0.1], successors.shape)
    return _model(successors, shares, np.broadcast_to([1.5, 1.0, 1.5], (n, 3)))


def racetrack(side: int, *, speed: int = 3, slip: float = 0.1, seed: int = _SEED) -> SSP:
    """Return a car on a square with walls; a step changes its velocity by at most one each way.

    With probability ``slip`` the velocity does not change. A car that leaves the square or ends a
    step in a wall is lost; the goal is the last corner.
    """
    rng, cells, width = np.random.default_rng(seed), side * side, 2 * speed + 1
    is_wall = rng.random(cells) < 0.05
    is_wall[[0, -1]] = False
    cell, velocity = np.divmod(np.arange(cells * width**2), width**2)
    fast_x, fast_y = (part - speed for part in np.divmod(velocity, width))
    pushes = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]

    def after(push_x: int, push_y: int) -> np.ndarray:
        now_x = np.clip(fast_x + push_x, -speed, speed)
        now_y = np.clip(fast_y + push_y, -speed, speed)
        x, y = cell % side + now_x, cell // side + now_y
        is_inside = (np.clip(x, 0, side - 1) == x) & (np.clip(y, 0, side - 1) == y)
        there = np.where(is_inside, y * side + x, 0)
        moved = there * width**2 + (now_x + speed) * width + now_y + speed
        moved = np.where(there == cells - 1, cell.size, moved)
        return np.where(is_inside & ~is_wall[there], moved, cell.size + 1)

    idle = after(0, 0)
    successors = np.stack([np.stack([after(*push), idle], axis=1) for push in pushes], axis=1)
    start = speed * width + speed  # at rest in the first corner
    names = np.append(np.arange(cell.size), [cell.size, cell.size + 1])
    names[[0, start]] = start, 0
    successors = names[successors]
    successors[[0, start]] = successors[[start, 0]]
    shares = np.broadcast_to([1.0 - slip, slip], successors.shape)
    return _model(successors, shares, np.ones((cell.size, len(pushes))))


def tandem(capacity: int, *, arriving: float = 0.22) -> SSP:
    """Return two queues in a row, served fast (expensive) or slowly, until both are empty at once.

    A customer who finds a full queue is lost: the trap. Both are half full at the start.
    """
    width = capacity + 1
    first, second = np.divmod(_begun_at(np.arange(1, width**2), capacity // 2 * (width + 1)), width)
    n = first.size
    name = np.full((width, width), n)
    name[first, second] = here = np.arange(n)
    full = np.full(n, n + 1)
    arrives = np.where(first < capacity, name[np.minimum(first + 1, capacity), second], full)
    passed = np.where(second < capacity, name[first - 1, np.minimum(second + 1, capacity)], full)
    passed, leaves = (
        np.where(first > 0, passed, here),
        np.where(second > 0, name[first, second - 1], here),
    )
    speeds = np.array([[0.25, 0.25], [0.25, 0.45], [0.45, 0.25], [0.45, 0.45]]) * (1.0 - arriving)
    shares = np.column_stack([np.full(4, arriving), speeds, 1.0 - arriving - speeds.sum(axis=1)])
    successors = np.stack([arrives, passed, leaves, here], axis=1)[:, None, :]
    costs = np.array([1.0, 2.0, 2.0, 3.0]) + (first + second)[:, None] // 4
    shape = n, 4, 4
    return _model(np.broadcast_to(successors, shape), np.broadcast_to(shares, shape), costs)


def inventory(capacity: int, days: int) -> SSP:
    """Return a season of daily orders against a random demand: no cycles.

    Orders and stock cost; an unmet demand ends the season in the trap with probability 1/20.
    """
    levels = capacity + 1
    day, stock = np.divmod(np.arange(levels * days), levels)
    ordered = np.arange(0, levels, max(capacity // 4, 1))
    demand = np.arange(capacity // 2 + 1)
    chance = _normalised(np.minimum(demand, demand[-1] - demand) + 1.0)
    filled = np.minimum(stock[:, None] + ordered, capacity)
    left, n = filled[:, :, None] - demand, day.size
    next_day = (day[:, None, None] + 1) * levels + np.maximum(left, 0)
    next_day = np.where(day[:, None, None] == days - 1, n, next_day)
    lost = np.where(left < 0, 0.05, 0.0) * chance
    bought = filled - stock[:, None]
    return _model(
        np.concatenate([next_day, np.full(left.shape, n + 1)], axis=-1),
        np.concatenate([chance - lost, lost], axis=-1),
        2.0 * (bought > 0) + bought + filled // 4,
    )


def sysadmin(machines: int) -> SSP:
    """Return a ring of machines of which one is rebooted a step, until all work at once.

    The fewer of a machine's neighbours work, the likelier it fails. If none works, all is lost.
    At the start every other machine works.
    """
    bits, every = 1 << np.arange(machines), (1 << machines) - 1
    up = _begun_at(np.arange(1, every), int(bits[::2].sum()))
    n = up.size
    name = np.full(every + 1, n)
    name[up], name[0] = np.arange(n), n + 1
    works = (up[:, None] & bits) > 0
    neighbours_down = 2.0 - np.roll(works, 1, axis=1) - np.roll(works, -1, axis=1)
    fails = np.where(works, (0.02 + 0.15 * neighbours_down) / machines, 0.0)
    is_rebooted = np.eye(machines, dtype=bool)
    flips = np.where(is_rebooted, np.where(works, 0.0, 0.5)[:, None, :], fails[:, None, :])
    stays = 1.0 - flips.sum(axis=-1, keepdims=True)
    shape = n, machines, machines + 1
    successors = np.column_stack([name[up[:, None] ^ bits], np.arange(n)])[:, None, :]
    costs = np.repeat(1.0 + (~works).sum(axis=1, keepdims=True), machines, axis=1)
    return _model(np.broadcast_to(successors, shape), np.concatenate([flips, stays], -1), costs)


def factored(variables: int, *, seed: int = _SEED) -> SSP:
    """Return a random domain of truth values; each action sets one, the goal is that all are true.

    An action works with a probability that depends on two other values. If both are false, it may
    lead to the trap.
    """
    rng, n = np.random.default_rng(seed), (1 << variables) - 1
    here, actions = np.arange(n), variables + 2
    successors = np.empty((n, actions, 4), dtype=np.int64)
    shares, costs = np.empty(successors.shape), np.empty((n, actions))
    for action in range(actions):
        made = action if action < variables else int(rng.integers(variables))
        undone, *parents = rng.integers(0, variables, 3).tolist()
        true = sum(here >> parent & 1 for parent in parents)
        works = np.array([0.2, 0.6, 0.95])[true]
        slips, dies = rng.uniform(0.0, 0.3) * (1.0 - works), np.where(true == 0, 0.005, 0.0)
        shares[:, action] = np.stack([works, slips, dies, 1.0 - works - slips - dies], axis=1)
        after = [here | 1 << made, here & ~(1 << undone), np.full(n, n + 1), here]
        successors[:, action] = np.stack(after, axis=1)
        costs[:, action] = rng.integers(1, 5)
    return _model(successors, shares, costs)


def blocks(count: int) -> SSP:
    """Return exploding blocks: one tower to be rebuilt upside down.

    A block that is put down explodes with probability 1/10 (on the table 1/25), which ends the run
    in the trap. Defusing it before takes time.
    """
    start, goal = (((*range(count),),), 0), (((*reversed(range(count)),),), 0)

    def successors(state: Any) -> dict[Hashable, list[tuple[float, Any, float]]]:
        towers, defused = state
        moves: dict[Hashable, list[tuple[float, Any, float]]] = {}
        for tower in towers:
            block, others = tower[-1], [t for t in towers if t is not tower] + [tower[:-1]]
            if not defused >> block & 1:
                safe = towers, defused | 1 << block
                moves["defuse", block] = [(0.9, safe, 3.0), (0.1, state, 3.0)]
            for on in [(), *others[:-1]]:
                built = tuple(sorted([t for t in others if t and t is not on] + [(*on, block)]))
                risk = 0.0 if defused >> block & 1 else (0.1 if on else 0.04)
                is_done = len(built) == 1 and built[0] == goal[0][0]
                after = goal if is_done else (built, defused)
                steps = [(1.0 - risk, after, 1.0), (risk, "trap", 1.0)]
                moves[block, on] = [step for step in steps if step[0] > 0.0]
        return moves

    model = SSP.from_successors(
        start,
        lambda state: {} if state == "trap" else successors(state),
        {goal},
        treat_actionless_as_dead_ends=True,
    )
    return replace(model, states=tuple(range(model.n_states)))


def hub(spokes: int, length: int, *, seed: int = _SEED) -> SSP:
    """Return a hub with long ways, each of which ends at the goal, in the trap, or at the hub."""
    rng, n = np.random.default_rng(seed), 1 + spokes * length
    begins = 1 + length * np.arange(spokes)
    after = np.arange(2, n + 1)
    ends = begins + length - 1
    reached = rng.uniform(0.05, 0.3, spokes)
    lost = rng.uniform(0.0, 0.2, spokes) * reached
    outcomes = np.ones(n - 1 + spokes, dtype=np.int64)
    outcomes[spokes + ends - 1] = 3
    successors = np.concatenate([begins, np.repeat(after, outcomes[spokes:])])
    probabilities = np.ones(len(successors))
    first = spokes + np.cumsum(outcomes[spokes:])[ends - 1] - 3
    for k, (to, share) in enumerate(((n, reached), (n + 1, lost), (0, 1.0 - reached - lost))):
        successors[first + k], probabilities[first + k] = to, share
    return SSP.from_arrays(
        pair_offsets=np.append(0, np.append(spokes + np.arange(n), [n - 1 + spokes] * 2)),
        outcome_offsets=np.append(0, np.cumsum(outcomes)),
        successors=successors.astype(np.int32),
        probabilities=probabilities,
        costs=np.ones(len(successors)),
        goal_states=[n],
        treat_actionless_as_dead_ends=True,
    )


def ladder(rungs: int, ladders: int, *, seed: int = _SEED) -> SSP:
    """Return gambler's ladders, one above the other, climbed timidly or by bold steps."""
    n = rungs * ladders
    here, risk = np.arange(n), np.random.default_rng(seed).uniform(0.0, 2e-4, n)
    down = np.where(here % rungs > 0, here - 1, here)
    steps = np.stack([here + 1, down, np.full(n, n + 1)], axis=1)
    timid = np.broadcast_to([0.5, 0.5, 0.0], (n, 3))
    bold = np.stack([0.55 - risk, np.full(n, 0.45), risk], axis=1)
    successors = np.stack([steps, steps], axis=1)
    return _model(successors, np.stack([timid, bold], axis=1), np.ones((n, 2)))


def priced(model: SSP, *, seed: int = _SEED) -> SSP:
    """Return a model with a real cost between 0.5 and 2 for each of its actions."""
    drawn = np.random.default_rng(seed).uniform(0.5, 2.0, model.n_pairs)
    costs = np.repeat(drawn, np.diff(model.outcome_offsets))
    return replace(model, costs=read_only(costs), exact_costs={})


FAMILIES: dict[str, Callable[..., SSP]] = {
    family.__name__: family
    for family in (
        layered, scattered, grid, river, corridor, rooms, ring,
        holes, headings, racetrack, tandem, inventory, sysadmin, factored, blocks,
    )
}  # fmt: skip
"""The families by name; their sizes are one or two whole numbers."""

RANDOM = ("layered", "scattered", "grid", "rooms", "holes", "headings", "racetrack", "factored")
"""Families that are drawn, and take a seed."""

SQUARES = (
    "scattered", "grid", "corridor", "ring",
    "holes", "headings", "racetrack", "tandem", "sysadmin", "factored", "blocks",
)  # fmt: skip
"""Families of one size."""

WARM_UP_SIZES = {
    "layered": (80, 100), "scattered": (8_000,), "grid": (100,), "river": (100, 100),
    "corridor": (10_000,), "rooms": (20, 20), "ring": (10_000,),
    "holes": (100,), "headings": (40,), "racetrack": (16,), "tandem": (100,),
    "inventory": (100, 100), "sysadmin": (10,), "factored": (12,), "blocks": (4,),
}  # fmt: skip
"""Sizes that solvers are warmed up with."""


def _cell(name: np.ndarray, side: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return name[np.clip(y, 0, side - 1) * side + np.clip(x, 0, side - 1)]


def _begun_at(names: np.ndarray, start: int) -> np.ndarray:
    """Return an array of names, rotated so that the start comes first."""
    return np.roll(names, -int(np.flatnonzero(names == start)[0]))


def _normalised(weights: np.ndarray) -> np.ndarray:
    return weights / weights.sum(axis=-1, keepdims=True)


def _model(successors: np.ndarray, probabilities: np.ndarray, costs: np.ndarray) -> SSP:
    """Return a model; arrays are [live states, actions, outcomes], costs [live states, actions]."""
    n, actions, outcomes = successors.shape
    return SSP.from_arrays(
        pair_offsets=np.append(np.arange(0, actions * n + 1, actions), [actions * n] * 2),
        outcome_offsets=np.arange(0, actions * outcomes * n + 1, outcomes),
        successors=successors.reshape(-1).astype(np.int32),
        probabilities=np.ascontiguousarray(probabilities).reshape(-1),
        costs=costs.reshape(-1),
        goal_states=[n],
        treat_actionless_as_dead_ends=True,
    )
