"""Slips in what functions are given: the error is the library's own and names the part."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import ssp_lp
import ssp_lp.io
import ssp_lp.plotting
from formulations import MCMP, FinitePenalty, compare_criteria
from ssp_lp import SSP, ModelError, solve
from ssp_lp.model.arguments import explained

MODEL = SSP.from_transitions(
    {"a": {"x": [(0.9, "g", 1.0), (0.1, "d", 2.0)]}, "d": {}},
    goal={"g"},
    treat_actionless_as_dead_ends=True,
)
PROBLEM = MCMP(MODEL, "a", failure_budget=0.2)
SOLUTION = solve(PROBLEM)
GRID = ssp_lp.Grid([ssp_lp.Axis(0.0, 1.0, 4)])


def step(point, action, noise):
    return (point[0] + 1.0,), 1.0, 1


WORLD = ssp_lp.ContinuousModel(GRID, [0], step)
KNOWN = {
    **{name: getattr(ssp_lp, name) for name in ssp_lp.__all__},
    **{name: getattr(ssp_lp.io, name) for name in ssp_lp.io.__all__},
    **{name: getattr(ssp_lp.plotting, name) for name in ssp_lp.plotting.__all__},
    **{"M": MODEL, "P": PROBLEM, "S": SOLUTION, "G": GRID, "W": WORLD, "np": np, "step": step},
    **{"MCMP": MCMP, "FinitePenalty": FinitePenalty, "compare_criteria": compare_criteria},
}

TRUTHS = [  # anything would do for a truth value, so that these are looked at in every call
    "MCMP(M, 'a', charge_failing_step='yes')",
    "FinitePenalty(M, 'a', 3.0, charge_failing_step=1)",
    "solve(P, verbose='x')",
    "certify(S, verbose='x')",
    "cross_check(P, verbose='x')",
    "trace_frontier(P, verbose='x')",
    "simulate(S.policy, P, seed=0, verbose='x')",
    "compare_criteria(M, 'a', verbose='x')",
    "progress_shown(1).__enter__()",
    "load_policy('policy.npz', M, check='x')",
    "SSP.from_transitions({'a': {'x': [(1.0, 'g', 1.0)]}}, {'g'}, normalise='x')",
    "SSP.from_transitions({'a': {}}, {'g'}, treat_actionless_as_dead_ends=1)",
    "Axis(0.0, 1.0, 4, periodic='x')",
    "Axis(0.0, 1.0, 4, split_edges=0)",
]

SLIPS = [
    ("Grid(None)", "Grid: axes must be a list of Axis, not None"),
    ("Axis('0', 1.0, 4)", "Axis: low must be a number, not '0'"),
    ("G.cell_of('x')", "Grid.cell_of: points must be numbers"),
    ("G.centre(99)", "cells are whole numbers, 0 .. 3"),
    ("ContinuousModel(None, [0], step)", "grid must be a Grid, not None"),
    ("ContinuousModel(G, 3, step)", "actions must be a list of hashable things, not 3"),
    ("ContinuousModel(G, [0], None)", "step must be a function of 3 arguments, not None"),
    ("ContinuousModel(G, [0], lambda p: p)", "step must be a function of 3 arguments"),
    ("ContinuousModel(G, [0], step, noise=[0.1])", r"noise\[0\] must be a Distribution, not 0.1"),
    ("ContinuousModel(G, [0], step, dead_ends={'w': 'x'})", r"dead_ends\['w'\] must be a number"),
    ("discretise(M)", "discretise: world must be a ContinuousModel, not SSP"),
    ("discretise(ContinuousModel(G, [0], lambda p, a, n: (0.5, 1.0, 0)))", "returned no coordin"),
    ("Distribution(3)", "quantile must be a function of 1 arguments"),
    ("Distribution(lambda q: 'x').at(np.ones(1))", "must return a finite number"),
    ("Samples(10, 0).deviation(None, 3)", "pairs must be a whole number, not None"),
    ("WorldSimulator(W, start=.1)", "start must be a list of numbers or Distribution, not 0.1"),
    ("WorldSimulator(W, start=[.1, .2])", "start needs 1 coordinates, not 2"),
    ("WorldSimulator(M, start=[.1])", "world must be a ContinuousModel"),
    ("SSP.from_transitions({'a': {'x': None}}, {'g'})", r"transitions\['a'\]\['x'\] must be"),
    (
        "SSP.from_transitions({'a': {'x': [(1., ['g'], 1.)]}}, {'g'})",
        "action 'x' of state 'a' leads",
    ),
    ("SSP.from_successors('a', {'a': {}}, {'g'})", "successors must be a function of 1 arguments"),
    (
        "SSP.from_successors('a', lambda s: {}, {'g'}, state_limit='x')",
        "state_limit must be a whole",
    ),
    ("M.action_of(99)", "99 is no pair of the model"),
    ("product(M, Memory(0, lambda a, b: 0))", "update must be a function of 5 arguments"),
    ("product(M, Memory(0, lambda m, s, a, t, c: []))", "a state holds no list"),
    ("DeterministicPolicy.from_actions(M, ['x'])", "actions must be a dict"),
    ("MixedPolicy(None, [1.0])", "MixedPolicy: policies must be a tuple, not None"),
    ("simulate(S.policy, P, episodes=5, seed=0, simulator=W)", "simulator must be a Simulator"),
    ("success_costs(S.policy, P).quantile('x')", "level must be a number, not 'x'"),
    ("fingerprint(P)", r"model must be an SSP, not MCMP.*; it has one: .model"),
    ("save_model(M, None)", "path must be a string or a path, not None"),
    ("load_policy(3, M)", "path must be a string or a path, not 3"),
    ("read_drn('m.drn', goal=None)", "No such file|goal must be a string"),
    ("read_any(None, ['g'])", "path must be a string or a Path, not None"),
    ("write_umb(None, 'm', start='a')", "model must be an SSP, not None"),
    ("from_matrices(3, 1, costs=[1, 1])", "transitions must be"),
    ("from_matrices([np.eye(2)], 1, costs='x')", "costs or rewards are no numbers: 'x'"),
    ("from_gymnasium('FrozenLake-v1')", "an environment is needed, such as"),
    ("rollout(None, S.policy, episodes=3, seed=0)", "of no environment"),
    (
        "rollout(None, S.policy, episodes='x', seed=0)",
        "episodes must be a whole number >= 1, not 'x'",
    ),
    ("load_solution('s.npz', M)", "No such file|problem must be a Problem"),
    ("plot_frontier(S)", "frontier must be a"),
    ("plot_cost_law(S)", "law must be a CostLaw"),
    ("plot_bounds(BoundsRecord(), P)", "plot_bounds takes a solution"),
    (
        "plot_lottery(S, P, {'a': (0, 0)}, {})",
        "policy must be a MixedPolicy.*; it has one: .policy",
    ),
    (
        "plot_grid_policy(S.policy, P, None, {})",
        "cells must be a dict or a function of 1 arguments",
    ),
    ("plot_paths([np.zeros((3, 1))], ['x'])", "a path must be an array"),
    ("plot_cost_law(success_costs(S.policy, P), ax=3)", "ax must be axes of matplotlib"),
    ("row_major(4, 4)('x')", "number must be a whole number, not 'x'"),
    ("compare_criteria(M, 'a', penalties=10)", "penalties must be a list of numbers, not 10"),
]


@pytest.mark.parametrize("call", TRUTHS)
def test_what_is_neither_true_nor_false_is_refused(call: str) -> None:
    flag = re.search(r"(\w+)=[^,]*$", call)
    name = "verbose" if flag is None else flag[1]
    with pytest.raises(ModelError, match=f"{name} must be True or False, not"):
        eval(call, dict(KNOWN))  # noqa: S307


@pytest.mark.parametrize(("slip", "words"), SLIPS, ids=[slip for slip, _ in SLIPS])
def test_what_is_of_a_wrong_type_is_named(
    slip: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if "gym" in slip or "rollout" in slip:
        pytest.importorskip("gymnasium")
    if "plot" in slip:
        pytest.importorskip("matplotlib")
    with pytest.raises((ModelError, FileNotFoundError), match=words):
        eval(slip, dict(KNOWN))  # noqa: S307


def test_other_errors_stay_what_they_are() -> None:
    @explained
    def share(number: int, of: int = 0) -> float:
        return number / of if of else {}["no such key"]

    assert share(1, 2) == 0.5
    with pytest.raises(KeyError, match="no such key"):
        share(1)
    with pytest.raises(ModelError, match=r"share needs 'number': write test_.*share\(number\)"):
        share()
    with pytest.raises(ModelError, match="number must be a whole number, not 'x'") as caught:
        share("x", 2)
    assert isinstance(caught.value.__cause__, TypeError)


def test_a_fault_in_a_function_of_the_users_is_the_users() -> None:
    def broken(point, action, noise):
        return point[7], 1.0, 0

    with pytest.raises(IndexError):
        ssp_lp.discretise(ssp_lp.ContinuousModel(GRID, [0], broken))


def test_what_fits_is_taken_as_it_is() -> None:
    """Whole numbers and reals of numpy's, lists for tuples, arrays for lists, any callable."""
    axis = ssp_lp.Axis(np.float32(0.0), 1, np.int64(4))
    noise = (ssp_lp.Distribution.uniform(0, 0),)
    world = ssp_lp.ContinuousModel(ssp_lp.Grid((axis,)), np.arange(2), step, noise)
    assert ssp_lp.WorldSimulator(world, np.array([0.1])).world is world
    assert ssp_lp.Memory(start=None, update=max).update is max
