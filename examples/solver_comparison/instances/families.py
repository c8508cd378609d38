"""Families of models that differ in structure: acyclic, windy, narrow, hanging together, slow.

Every model has its live states first, then one goal and one trap; its start is state 0.
"""

from collections.abc import Callable

import numpy as np

from ssp_lp import SSP

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
    """Return a ring that is left seldom, by a dear and sure way or a cheap and risky one."""
    here = np.arange(states)
    on, back = (here + 1) % states, (here - 1) % states
    goal, trap = np.full(states, states), np.full(states, states + 1)
    successors = np.stack([np.stack([on, back, goal, trap], 1)] * 2, axis=1)
    sure, risky = [0.6 - leak, 0.4, leak, 0.0], [0.6 - 2 * leak, 0.4, 1.8 * leak, 0.2 * leak]
    probabilities = np.broadcast_to([sure, risky], (states, 2, 4))
    costs = np.stack([1.0 + 0.1 * (here % 7), 1.0 + 0.1 * (here % 5)], axis=1)
    return _model(successors, probabilities, costs)


FAMILIES: dict[str, Callable[..., SSP]] = {
    family.__name__: family for family in (layered, scattered, grid, river, corridor, rooms, ring)
}
"""The families by name; their sizes are one or two whole numbers."""

RANDOM = ("layered", "scattered", "grid", "rooms")
"""Families that are drawn, and take a seed."""

SQUARES = ("scattered", "grid", "corridor", "ring")
"""Families of one size."""

WARM_UP_SIZES = {
    "layered": (80, 100), "scattered": (8_000,), "grid": (100,), "river": (100, 100),
    "corridor": (10_000,), "rooms": (20, 20), "ring": (10_000,),
}  # fmt: skip
"""Sizes that solvers are warmed up with."""


def _cell(name: np.ndarray, side: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return name[np.clip(y, 0, side - 1) * side + np.clip(x, 0, side - 1)]


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
