"""Compiling all inner loops at once, by solving small problems of every kind with them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from functools import partial
from typing import Any

import numpy as np

from ssp_lp import SSP, SSPError, evaluate, simulate, solve, success_costs, visits
from ssp_lp.arrays import IntArray
from ssp_lp.compiled.accelerator import SWITCH, cache_folders, cached_loops
from ssp_lp.errors import optional_module

from ..cost_bounded_reach import CostBoundedReach
from ..maxprob import MaxProb
from ..mcmp import MCMP
from ..min_cost import MinCost
from ..s3p import S3P

_SIDE = 34
"""Of a square: its states exceed those of a chain that is solved directly."""

_LARGE = 360
"""Of a square whose rows are so many that equal ones are shared."""


def compile_loops(_: object = None) -> Iterator[str]:
    """The command ``compile``: the loops that numba's cache lacks, for one core and for all.

    Raises:
        MissingDependencyError: numba is not installed.
    """
    optional_module("numba", "fast")
    from ssp_lp.compiled.cores import on_all_cores

    before, began, wish = cached_loops(), time.perf_counter(), os.environ.get(SWITCH)
    os.environ[SWITCH] = "numba"
    try:
        for everywhere in (False, True):
            for solved in _problems():
                with on_all_cores() if everywhere else nullcontext(), suppress(SSPError):
                    solved()
    finally:
        del os.environ[SWITCH]
        if wish is not None:
            os.environ[SWITCH] = wish
    made = cached_loops() - before
    yield f"loops compiled    {len(made):,} in {time.perf_counter() - began:.0f} s"
    yield f"loops in cache    {len(before | made):,}"
    yield f"cache             {next((str(p) for p in cache_folders() if p.is_dir()), 'none')}"


def _problems() -> Iterator[Callable[[], Any]]:
    """Small problems whose solutions, together, run every loop."""
    windy, small, layered, mixing = _windy(_SIDE), _windy(10), _layered(), _mixing()
    for model in (windy, layered, mixing):
        for problem in (
            MaxProb(model, 0),
            MinCost(model, 0),
            MCMP(model, 0, failure_budget=None),
            MCMP(model, 0, failure_budget=0.5),
            MCMP(model, 0, failure_budget=0.5, discount=0.99),
        ):
            yield partial(solve, problem)
    yield lambda: solve(MCMP(small, 0, failure_budget=0.5, horizon=60))
    limit = {"limit": visits(1) <= 0.5}
    for model in (small, _layered(12, 8)):
        yield partial(_play, S3P(model, 0, failure_budget=0.5))
        yield partial(solve, S3P(model, 0, failure_budget=0.5, constraints=limit))
        yield partial(solve, CostBoundedReach(model, 0, cost_bound=30.0))
    yield lambda: solve(S3P(windy, 0, failure_budget=0.5, cost_cap=60.0))
    yield lambda: solve(MCMP(_windy(60), 0, failure_budget=0.9, discount=0.99), "game")
    yield lambda: solve(S3P(_windy(_LARGE), 0, failure_budget=0.5, cost_cap=2.0))


def _play(problem: Any) -> None:
    """Solve a problem, and ask for the law of what its policy costs."""
    policy = solve(problem).policy
    success_costs(policy, problem).within(20.0)
    evaluate(policy, problem)
    simulate(policy, problem, episodes=10, seed=1)


def _windy(side: int) -> SSP:
    """A square with four moves, wind, and a pit along a part of its edge."""
    x, y = np.arange(side * side) % side, np.arange(side * side) // side
    targets = [
        [np.clip(x + dx + wind, 0, side - 1) + side * np.clip(y + dy, 0, side - 1), x + side * y]
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))
        for wind in (0, 1)
    ]
    moves = np.array(targets).reshape(4, 2, 2, -1)[:, :, 0].transpose(2, 0, 1)
    pit = (x == side - 1) & (y < side // 2)
    moves = np.where(pit[moves], side * side + 1, moves)
    moves[-1] = side * side
    return _model(moves)


def _layered(depth: int = 60, width: int = 20) -> SSP:
    """Layers of states, each leading to the next one: no cycles."""
    rng, n = np.random.default_rng(1), depth * width
    layer = np.repeat(np.arange(depth), width)[:, None, None]
    moves = (layer + 1) * width + rng.integers(0, width, (n, 3, 2))
    moves = np.where(layer == depth - 1, n, moves)
    return _model(np.where(rng.random(moves.shape) < 0.1 / depth, n + 1, moves))


def _mixing(states: int = 2_500) -> SSP:
    """States that lead anywhere, and with each action to an end: one large component."""
    rng = np.random.default_rng(1)
    moves = rng.integers(0, states, (states, 3, 20))
    moves[:, :, 0], moves[:, :, 1] = states, states + (rng.random((states, 3)) < 0.5)
    return _model(moves)


def _model(moves: IntArray) -> SSP:
    """The model of equally likely moves, the goal behind the states, and a dead-end behind it.

    Args:
        moves: successors, [states, actions, outcomes].
    """
    n, actions, outcomes = moves.shape
    return SSP.from_arrays(
        pair_offsets=np.append(np.arange(0, actions * n + 1, actions), [actions * n] * 2),
        outcome_offsets=np.arange(0, moves.size + 1, outcomes),
        successors=moves.ravel().astype(np.int32),
        probabilities=np.full(moves.size, 1.0 / outcomes),
        costs=np.tile([1.0, 2.0, 1.0], n * actions)[: n * actions],
        goal_states=[n],
        treat_actionless_as_dead_ends=True,
    )
