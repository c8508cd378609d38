"""Every public object and error survives a pickle, a copy and a deep copy, used or not."""

import copy
import enum
import importlib
import inspect
import multiprocessing
import os
import pickle
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import formulations as criteria
import ssp_lp
from small_models import model_of
from ssp_lp import SSPError, errors, io, plotting, solve

COPIES = {
    "pickle": lambda given: pickle.loads(pickle.dumps(given)),  # noqa: S301
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
}
PACKAGES = ("ssp_lp", "formulations", "ssp_lp.io", "ssp_lp.plotting")
MODEL = model_of(
    {
        "x": {
            "go": [(0.5, "g", 1.0), (0.3, "d", 1.0), (0.2, "y", 2.0)],
            "safe": [(0.9, "g", 5.0), (0.1, "d", 1.0)],
        },
        "y": {"go": [(0.5, "g", 1.5), (0.5, "x", 1.0)]},
        "d": {},
    },
    labels={"pit": ["d"]},
)
SURE = model_of({"x": {"go": [(0.5, "g", 1.0), (0.5, "x", 1.0)], "ride": [(1.0, "g", 3.0)]}})
LIMIT = {"fuel": ssp_lp.expected_cost() <= 6.0, "seldom": ssp_lp.visits("y") <= 0.9}
START = "x"
DEAR = ssp_lp.secondary_cost({"x": {"go": 2.0}})


def turned(memory, state, action, successor, cost):
    """A memory that counts to one."""
    return 1


def joy(costs):
    """The less it costs the better."""
    return np.exp(-0.3 * costs)


def hop(at, action, draws):
    """One step of a world on a line."""
    moved = at[0] + draws[0]
    return (moved,), 1.0, np.where(moved > 3.0, 1, 0)


def problems():
    """Every criterion, and what bends one: limits, horizons, shares, discounts, memories."""
    at = MODEL, START
    remembering = ssp_lp.product(MODEL, ssp_lp.Memory(0, turned))
    return [
        criteria.MCMP(*at, failure_budget=0.2),
        criteria.MCMP(*at, failure_budget=0.9, horizon=3),
        criteria.MCMP(*at, failure_budget=0.3, constraints=LIMIT),
        criteria.MCMP(*at, reach_fraction=0.9),
        criteria.MCMP(remembering, (START, 0), failure_budget=0.2),
        criteria.S3P(*at, failure_budget=0.2),
        criteria.S3P(*at, failure_budget=0.2, discount=0.99),
        criteria.S3P(*at, failure_budget=0.3, constraints=LIMIT),
        criteria.AlphaMCMP(*at, 0.9),
        criteria.CVaR(*at, 0.8),
        criteria.CostQuantile(*at, 0.5),
        criteria.CostBoundedReach(*at, 3.0),
        criteria.CostBudgetedMaxProb(*at, 6.0),
        criteria.ConstrainedCost(*at, {"dear": criteria.CostLimit({"x": {"go": 2.0}}, 3.0)}),
        criteria.EGUBS(*at, -0.1, 1.0),
        criteria.GUBS(*at, joy, 5.0),
        criteria.FinitePenalty(*at, 3.0),
        criteria.ISSPUDE(*at),
        criteria.LeastQuantity(*at, ssp_lp.visits("y"), failure_budget=0.4),
        criteria.MaxProb(*at),
        criteria.MinProb(*at),
        criteria.MinCost(SURE, START),
    ]


def of_solving():
    """What the verbs make of every problem; answers are certified after a pickle."""
    for problem in problems():
        solution = solve(problem)
        fresh = COPIES["pickle"](solution)
        assert fresh.policy.model is fresh.problem.model
        assert ssp_lp.certify(fresh).accepted
        again = solve(COPIES["pickle"](problem)).objective
        assert again == pytest.approx(solution.objective, rel=1e-12)
        made = [problem, problem.model, solution, solution.policy, *solution.policy.policies]
        made += [ssp_lp.certify(solution), ssp_lp.evaluate(solution.policy, problem)]
        made += [ssp_lp.simulate(solution.policy, problem, episodes=20, seed=0)]
        made += [ssp_lp.success_costs(solution.policy, problem), solution.policy.start(0)]
        if type(problem).__name__ not in ("CVaR", "CostQuantile"):
            program = problem.program()
            measure = program.solve()
            made += [program, measure, measure.randomised_policy(), measure.mixed_policy()]
            made += [measure.values, *measure.rows]
        yield from made
    convex = criteria.MCMP(MODEL, START, failure_budget=0.2).program().to_cvxpy()
    objective = convex.solve().objective
    assert COPIES["pickle"](convex).solve().objective == pytest.approx(objective, rel=1e-6)
    yield convex
    first = criteria.MCMP(MODEL, START, failure_budget=0.2, discount=0.99)
    yield ssp_lp.cross_check(first)
    yield ssp_lp.write_certificate(solve(criteria.MCMP(MODEL, START, 0.2)), os.devnull)
    yield ssp_lp.trace_frontier(criteria.S3P(MODEL, START, failure_budget=0.3))
    limits = {"seen": ssp_lp.visits(START) <= 2.0}
    yield ssp_lp.trace_frontier(criteria.MCMP(MODEL, START, constraints=limits), "seen")
    effects = solve(criteria.MCMP(MODEL, START, failure_budget=0.2)).what_if()
    yield from (effects, effects.effects[0], effects.effects[0].number)
    box = ssp_lp.Boxes(MODEL, MODEL.probabilities, MODEL.probabilities)
    given = {"give_up": "anywhere", "charge_failing_step": False}
    yield ssp_lp.tighten(criteria.MCMP(MODEL, START, failure_budget=0.2, **given), box)
    yield from (effects.effects[0].number.change, ssp_lp.Parameter("crash", 0.1))
    asked = ssp_lp.sweep(criteria.MCMP, MODEL, START, failure_budget=[0.01, 0.2])
    yield ssp_lp.solve_many(asked, executor=ThreadPoolExecutor(1))
    comparison = criteria.compare_criteria(MODEL, START)
    yield from (comparison, comparison.rows[0])


def of_models():
    """Models of every origin, and what they were made of."""
    noise = ssp_lp.Distribution.discrete([0.0, 1.0, 2.0], [0.3, 0.5, 0.2])
    axis = ssp_lp.Axis(0.0, 3.0, 3)
    world = ssp_lp.ContinuousModel(ssp_lp.Grid([axis]), ["hop"], hop, [noise])
    uniform = ssp_lp.Distribution.uniform(0.0, 3.0)
    yield from (noise, uniform, axis, world, world.grid)
    yield from (ssp_lp.Quadrature(), ssp_lp.Samples(3, 0), ssp_lp.discretise(world))
    yield ssp_lp.WorldSimulator(world, [uniform])
    yield from (ssp_lp.Memory(0, turned), ssp_lp.within_steps(MODEL, 2))
    task = ssp_lp.task("F go & G !pit")
    yield from (task, task.automaton(MODEL), ssp_lp.reach(MODEL, task, start=["x"]))
    yield from (ssp_lp.holds(task) >= 0.5, ssp_lp.within(ssp_lp.visits("y"), 2) >= 0.5)
    counted = ssp_lp.SSP.from_counts(
        [("x", "go", "goal", 9, 1.0), ("x", "go", "y", 1, 1.0)], {"goal"}
    )
    boxes, asked = ssp_lp.Boxes.from_counts(counted), criteria.MaxProb(counted, "x")
    yield from (counted, boxes, ssp_lp.evaluate(solve(asked).policy, asked, box=boxes))
    for made in (ssp_lp.visits("y"), DEAR + ssp_lp.visits("y")):
        yield from (made, made <= 3.0)
    moves = {"x": {"go": 0.5, "safe": 0.5}, "y": {"go": 1.0}}
    yield ssp_lp.StochasticPolicy.from_actions(MODEL, moves)
    constant = ssp_lp.DeterministicPolicy.from_actions(MODEL, {"x": "go", "y": "go"})
    yield ssp_lp.TimedPolicy((constant, constant))
    yield from (criteria.CostLimit({"x": {"go": 2.0}}, 3.0), ssp_lp.GIVE_UP)
    yield from (ssp_lp.GiveUp.ATTENTION, ssp_lp.Status.OPTIMAL, ssp_lp.ColumnGeneration())
    yield from (ssp_lp.LinearProgramming(), ssp_lp.Game(), ssp_lp.DeterministicPolicies())


def of_files(folder):
    """What the rim hands out."""
    yield plotting.Explorer("<!doctype html>")
    record = plotting.BoundsRecord()
    solution = solve(criteria.MCMP(MODEL, START, failure_budget=0.2), progress=record)
    io.write_controller(solution.policy, folder / "controller.json")
    controller = io.Controller(folder / "controller.json")
    controller.reset(3)
    controller.action(START)
    io.write_drn(MODEL, folder / "model.drn", start=START)
    yield from (record, controller, io.read_drn(folder / "model.drn", goal="goal"))
    yield io.StepLimitWarning("cut")


def of_gymnasium():
    """An environment's model, and a rollout in it."""
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("FrozenLake-v1", is_slippery=False)
    world = io.from_gymnasium(env)
    policy = solve(criteria.MaxProb(world.model, world.start)).policy
    yield from (world, world.model, io.rollout(env, policy, episodes=3, seed=0))


def facts(made):
    """What an object says of itself, all that is worked out on demand included."""
    told = {"": repr(made)}
    for name in dir(type(made)) + list(getattr(made, "__dict__", ())):
        if name.startswith("_"):
            continue
        try:
            value = getattr(made, name)
        except SSPError as error:
            value = error
        if not callable(value):
            told[name] = repr(value)
    return {name: re.sub(r" at 0x\w+|\w*tmp\w*", "", text) for name, text in told.items()}


def writable(made):
    """The fields whose arrays may be written to."""
    arrays = {k: v for k, v in getattr(made, "__dict__", {}).items() if isinstance(v, np.ndarray)}
    return {name for name, array in arrays.items() if array.flags.writeable}


def check_copies(made):
    """Used or not it is copied, says the same, and is as read-only."""
    for way, copied in COPIES.items():
        fresh = copied(made)
        known = facts(made)
        assert facts(copied(made)) == known == facts(fresh), (way, made)
        assert writable(copied(made)) <= writable(made), (way, made)
    assert type(fresh) is type(made)


def public_names():
    for package in PACKAGES:
        module = importlib.import_module(package)
        yield from ((name, getattr(module, name)) for name in module.__all__)


@pytest.mark.slow
def test_every_public_object_is_copied(tmp_path, accelerate):
    accelerate(False)  # a loop that is compiled on the way adds in another order
    seen = set()
    for kind in (of_solving, of_models, lambda: of_files(tmp_path), of_gymnasium):
        for made in kind():
            check_copies(made)
            seen.update(type(made).__mro__)
    for name, public in public_names():
        if inspect.isclass(public) and not issubclass(public, BaseException):
            assert public in seen or issubclass(public, enum.Enum), name
        else:
            assert pickle.loads(pickle.dumps(public)) is public, name  # noqa: S301


def test_every_error_says_the_same_after_a_pickle_and_a_copy():
    kinds = [kind for _, kind in inspect.getmembers(errors, inspect.isclass)]
    told = ("a limit", errors.Argument("failure_budget", 0.1))
    carried = {"failure_budget": 0.1, "least_failure": 0.3, "conflicting_rows": ("fuel",)}
    made = [errors.MissingDependencyError("numba", "fast")]
    made += [errors.InfeasibleError(*told, **carried)]
    kinds = [kind for kind in kinds if issubclass(kind, SSPError)]
    made += [kind(*told) for kind in kinds if kind not in map(type, made)]
    for error in made:
        error.add_note("a note")
        for copied in COPIES.values():
            fresh = copied(error)
            assert (type(fresh), str(fresh), fresh.args) == (type(error), str(error), error.args)
            assert vars(fresh) == vars(error)


@pytest.mark.slow
def test_a_pool_hands_on_that_a_problem_is_infeasible():
    """It would wait for ever for an error that cannot be read."""
    asked = [criteria.MCMP(MODEL, START, failure_budget=budget) for budget in (0.2, 0.01)]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map_async(solve, asked[:1]).get(60)[0].failure_probability <= 0.2 + 1e-12
        with pytest.raises(ssp_lp.InfeasibleError, match="budget") as caught:
            pool.map_async(solve, asked).get(60)
    assert caught.value.failure_budget == 0.01
    assert caught.value.least_failure == pytest.approx(0.1)
