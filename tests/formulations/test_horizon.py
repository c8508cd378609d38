"""A horizon on a criterion: the same as on the model unrolled by hand, acting on the model."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from examples.solver_comparison.instances.families import grid, river, scattered
from formulations import (
    GUBS,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostBoundedReach,
    CostLimit,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
)
from random_models import random_choices
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    Memory,
    ModelError,
    certify,
    cross_check,
    end_probability,
    evaluate,
    expected_cost,
    on_original,
    product,
    secondary_cost,
    simulate,
    solve,
    success_costs,
    trace_frontier,
    visits,
    within_steps,
)
from ssp_lp.analysis.evaluation import pair_visits
from ssp_lp.analysis.simulation import ModelSimulator
from ssp_lp.game import stationary_game
from ssp_lp.io import load_policy, load_solution, save_policy, save_solution
from ssp_lp.model.product import LATE
from tests.support.compiled import assert_same, both

STEPS = 6
SEEDS = (0, 3, 4, 8)  # of which the goal can be reached in so many steps


def drawn(seed: int) -> SSP:
    """A random ring of states."""
    return model_of(random_choices(np.random.default_rng(seed), 7), "goal")


HUT = {
    "camp": {
        "ridge": [(0.8, "top", 3.0), (0.1, "camp", 1.0), (0.1, "gorge", 1.0)],
        "path": [(0.5, "top", 7.0), (0.48, "camp", 2.0), (0.02, "gorge", 2.0)],
        "back": [(1.0, "hut", 2.0)],
    },
    "gorge": {},
    "hut": {},
}


def mountain() -> SSP:
    return model_of(HUT, "top", labels={"fall": ["gorge"]})


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("horizon", [1, 2, 5, 9])
def test_the_greatest_probability_is_backward_induction(seed: int, horizon: int) -> None:
    model = drawn(seed)
    value = model.goal_mask.astype(np.float64)
    for _ in range(horizon):
        ahead = np.add.reduceat(
            model.probabilities * value[model.successors], model.outcome_offsets[:-1]
        )
        best = model.goal_mask.astype(np.float64)
        np.maximum.at(best, model.pair_state, ahead)
        value = best
    at_start = value[model.index_of("s0")]
    assert solve(MaxProb(model, "s0", horizon=horizon)).objective == pytest.approx(at_start)
    if at_start < 1.0:
        with pytest.raises(InfeasibleError) as caught:
            solve(MCMP(model, "s0", 0.5 * (1.0 - at_start), horizon=horizon))
        assert caught.value.least_failure == pytest.approx(1.0 - at_start)
        with pytest.raises(InfeasibleError):
            solve(MinCost(model, "s0", horizon=horizon))


WALKS = {"constraints": {"walks": visits("camp") <= 1.3}}
AGREES = [
    (MCMP, {}, None),
    (MCMP, {}, "deterministic"),
    (MCMP, {"reach_fraction": 0.9}, None),
    (MCMP, {"discount": 0.9}, "lp"),
    (MCMP, {"discount": 0.9}, "game"),
    (S3P, {}, None),
    (S3P, {}, "deterministic"),
    (S3P, {"reach_fraction": 0.8}, None),
    (S3P, {"discount": 0.9}, "game"),
    (S3P, WALKS, None),
    (S3P, {"discount": 0.9} | WALKS, "lp"),
    (AlphaMCMP, {"reach_fraction": 0.7}, None),
    (FinitePenalty, {"penalty": 20.0}, None),
    (GUBS, {"utility": lambda cost: 0.9**cost, "goal_bonus": 0.5}, None),
    (CostQuantile, {"level": 0.5}, None),
    (CVaR, {"level": 0.5}, None),
    (CostBoundedReach, {"cost_bound": 9}, None),
]


@pytest.mark.parametrize(("criterion", "asked", "method"), AGREES)
def test_every_criterion_agrees_with_the_model_unrolled_first(
    criterion: Any, asked: dict[str, Any], method: str | None
) -> None:
    """The policy acts on the model, attains what is said of it, and the proof stands."""
    limited, budgeted = "constraints" in asked, "failure_budget" in criterion.__dataclass_fields__
    within = {"failure_budget": 0.3} if budgeted and "reach_fraction" not in asked else {}
    cases = [(mountain(), 4, {"camp": 1.0}, within)]
    if method is None and not limited:
        cases += [(drawn(seed), STEPS, {"s0": 0.75, "s3": 0.25}, {}) for seed in SEEDS[:3]]
    for model, steps, start, budget in cases:
        first, options = within_steps(model, steps, start=start), dict(asked)
        if limited:
            camps = [label for label in first.states if label[0] == "camp"]
            options["constraints"] = {"walks": visits(*camps) <= 1.3}
        problem = criterion(model, start, **asked, **budget, horizon=steps)
        there = criterion(first, first.start(start), **options, **budget)
        near = 1e-6 if method == "game" else 1e-9
        mine, theirs = solve(problem, method), solve(there, method)
        assert mine.objective == pytest.approx(theirs.objective, rel=near)
        assert mine.policy.model is model
        certificate = certify(mine)
        assert certificate.accepted
        assert certificate.objective == pytest.approx(mine.objective, rel=1e-9)
        for policy in (mine.policy, mine.randomised_policy):
            found = evaluate(policy, problem)
            assert found.objective == pytest.approx(mine.objective, rel=1e-9)
            assert sum(found.ends.values()) == pytest.approx(1.0)


def test_limits_are_stated_in_the_words_of_the_model() -> None:
    model, steps = mountain(), 4
    by_pair = np.array([2.0, 1.0, 0.0])
    by_outcome = np.repeat(by_pair, np.diff(model.outcome_offsets))
    nested = {"camp": {"ridge": 2.0, "path": 1.0}}
    limits = {
        "shelter": end_probability("hut") >= 0.1,
        "walks": visits("camp") <= 1.3,
        "late": end_probability(LATE) <= 0.03,
    }
    found = []
    for fuel in (nested, by_pair, by_outcome):
        rows = {**limits, "fuel": secondary_cost(fuel) <= 1.7}
        problem = MCMP(model, "camp", 0.5, horizon=steps, constraints=rows)
        solution = solve(problem)
        assert certify(solution).accepted
        found.append((solution.objective, dict(solution.secondary_costs)))
        spent = solution.secondary_costs
        assert spent["shelter"] >= 0.1 - 1e-9
        assert spent["walks"] <= 1.3 + 1e-9
        assert spent["late"] == pytest.approx(solution.evaluation.ends[LATE], abs=1e-9)
    assert found[0] == found[1] == found[2]

    unrolled_first = within_steps(model, steps, start=["camp"])
    every = {("camp", t): nested["camp"] for t in range(steps)}
    camps = [label for label in unrolled_first.states if label[0] == "camp"]
    huts = [label for label in unrolled_first.states if label[0] == "hut"]
    theirs = {
        "shelter": end_probability(*huts) >= 0.1,
        "walks": visits(*camps) <= 1.3,
        "late": limits["late"],
        "fuel": secondary_cost(every) <= 1.7,
    }
    again = solve(MCMP(unrolled_first, ("camp", 0), 0.5, constraints=theirs))
    assert found[0][0] == pytest.approx(again.objective, abs=1e-9)
    assert found[0][1] == pytest.approx(dict(again.secondary_costs), abs=1e-9)


def test_limits_of_a_criterion_and_its_own_objective() -> None:
    model = mountain()
    limit = CostLimit({"camp": {"ridge": 1.0}}, 0.4)
    limited = solve(ConstrainedCost(model, "camp", {"ridge": limit}, 0.3, horizon=3))
    assert limited.secondary_costs["ridge"] == pytest.approx(0.4)
    least = solve(LeastQuantity(model, "camp", expected_cost(), 0.3, horizon=3))
    there = within_steps(model, 3, start=["camp"])
    again = solve(LeastQuantity(there, ("camp", 0), expected_cost(), 0.3))
    assert least.objective == pytest.approx(again.objective)
    assert least.problem.objective_condition.minimised().bound == np.inf


def test_an_array_that_fits_a_product_and_its_original_is_refused() -> None:
    model = SSP.from_transitions(
        {"b": {"go": [(0.5, "goal", 1.0), (0.5, "b", 1.0)]}, "a": {"go": [(1.0, "b", 1.0)]}},
        goal={"goal"},
    )
    cost = secondary_cost([1.0, 5.0]) <= 9.0  # of b, a; on (state, time) of (a, 0), (b, 1)
    with pytest.raises(ModelError, match="fits both the product and its original"):
        MCMP(within_steps(model, 2, start=["a"]), ("a", 0), 0.6, constraints={"cost": cost})
    within = solve(MCMP(model, "a", 0.6, horizon=2, constraints={"cost": cost}))
    assert within.secondary_costs["cost"] == pytest.approx(6.0)  # what horizon= makes is unseen


def test_a_product_understands_the_words_of_its_original() -> None:
    unrolled_first = within_steps(mountain(), 3, start=["camp"])
    short = {"walks": visits("camp") <= 1.2, "fuel": secondary_cost({"camp": {"ridge": 1}}) <= 9}
    solution = solve(MCMP(unrolled_first, ("camp", 0), 0.5, constraints=short))
    assert solution.secondary_costs["walks"] <= 1.2 + 1e-9
    with pytest.raises(ModelError, match=r"neither a state nor a label.*did you mean"):
        MCMP(unrolled_first, ("camp", 0), 0.5, constraints={"walks": visits("fal") <= 1.0})
    with pytest.raises(ModelError, match=r"its states are \(state, memory\), start\('camp'\)"):
        MCMP(unrolled_first, "camp", 0.5)


def test_limits_on_the_copies_of_many_states_are_quick() -> None:
    """On a grid, whose states are pairs of numbers as the product's could be."""
    size, began = 60, time.process_time()
    grid = model_of(
        {
            (x, y): {"on": [(1.0, (x, y + 1) if y + 1 < size else (x + 1, 0), 1.0)]}
            for x in range(size)
            for y in range(size)
        },
        (size, 0),
    )
    cost = {state: {"on": 1.0} for state in grid.states[:-1]}
    last = (size - 1, size - 9)
    problem = MCMP(grid, last, 0.5, horizon=20, constraints={"c": secondary_cost(cost) <= 30.0})
    assert solve(problem).secondary_costs["c"] == pytest.approx(9.0)
    task = product(grid, Memory(0, lambda kept, *step: kept), start=[last])
    found = {"c": secondary_cost({last: {"on": 1.0}}) <= 3.0}
    assert solve(MCMP(task, (last, 0), 0.5, constraints=found)).objective == pytest.approx(9.0)
    assert time.process_time() - began < 20.0


def test_playing_and_simulating_know_what_time_it_is() -> None:
    model = mountain()
    problem = MCMP(model, "camp", 0.2, horizon=2)
    solution = solve(problem)
    told = solution.summary()
    assert told.startswith("MCMP, failure budget 0.2, within 2 steps, exact")
    assert "out of time " in told
    assert "horizon=2" in repr(problem)
    report = simulate(solution.policy, problem, episodes=4_000, seed=7)
    assert report.goal_probability.low <= 0.8 <= report.goal_probability.high
    assert report.ends[LATE] > 0
    assert report.ends["unfinished"] == 0
    world = ModelSimulator(model, np.eye(model.n_states)[model.index_of("camp")])
    outside = simulate(solution.policy, problem, episodes=4_000, seed=7, simulator=world)
    assert outside.ends == report.ends
    (path,) = simulate(solution.policy, problem, episodes=1, seed=1, record=1).paths
    assert {model.states[k] for k in path} <= {"camp", "top", "gorge"}
    visited, gave_up = pair_visits(solution.policy, problem)
    walks = {"walks": visits("camp") <= 9.0}
    counted = evaluate(solution.policy, replace(problem, constraints=walks)).secondary_costs
    assert visited.sum() <= counted["walks"] <= 2.0 + 1e-12
    assert gave_up.sum() == pytest.approx(solution.evaluation.ends["gave_up"])

    ignorant = DeterministicPolicy.from_actions(model, {"camp": "path"})
    found = evaluate(ignorant, problem)
    assert found.ends[LATE] == pytest.approx(0.48**2)
    assert found.goal_probability == pytest.approx(0.5 * 1.48)
    assert success_costs(ignorant, problem).within(7.0) == pytest.approx(0.5)
    late = simulate(ignorant, problem, episodes=4_000, seed=7).ends[LATE]
    assert abs(late / 4_000 - 0.48**2) < 4 * np.sqrt(0.48**2 * (1 - 0.48**2) / 4_000)

    episode = solution.policy.start(3)
    for _ in range(2):
        assert episode.action("camp") in ("ridge", "path")
        episode.observe("camp", 1.0)
    assert episode.action("camp") is GIVE_UP
    assert solution.policy.start(3).action("gorge") is None


def test_too_few_steps_left_is_out_of_time_wherever_it_is_found_out() -> None:
    """From b two steps are needed: an episode there with one left ends, and says why."""
    model = model_of(
        {
            "a": {"go": [(0.5, "c", 1.0), (0.5, "b", 1.0)]},
            "b": {"go": [(1.0, "c", 1.0)]},
            "c": {"go": [(0.9, "goal", 1.0), (0.1, "pit", 1.0)]},
            "pit": {"stay": [(1.0, "pit", 1.0)]},
        },
        "goal",
    )
    solution = solve(MCMP(model, "a", horizon=2))
    ends = solution.evaluation.ends
    assert ends[LATE] == pytest.approx(0.5)
    assert ends["dead_end"] == pytest.approx(0.05)
    assert solve(MCMP(model, "a", 1.0, horizon=1)).evaluation.ends[LATE] == 1.0  # at the start


def test_a_goal_that_is_too_far_is_out_of_reach() -> None:
    walk = SSP.from_transitions(
        {"a": {"go": [(1.0, "b", 1.0)]}, "b": {"go": [(1.0, "goal", 1.0)]}}, goal={"goal"}
    )
    assert solve(MaxProb(walk, "a", horizon=1)).objective == 0.0
    for criterion in (MCMP, S3P):
        assert solve(criterion(walk, "a", 0.0, horizon=2)).objective == pytest.approx(2.0)
        with pytest.raises(InfeasibleError) as caught:
            solve(criterion(walk, "a", 0.5, horizon=1))
        assert caught.value.least_failure == 1.0


def test_the_game_the_program_and_the_frontier_know_the_horizon() -> None:
    problem = MCMP(mountain(), "camp", 0.3, 0.95, horizon=3)
    check = cross_check(problem)
    assert check.agrees
    assert sum(method.answer is not None for method in check.methods) == 3
    solution = solve(problem)
    assert stationary_game(problem).objective == pytest.approx(solution.objective, rel=1e-6)
    program = problem.program()
    assert str(program).startswith("MCMP, failure budget 0.3, discount 0.95, within 3 steps")
    measure = program.solve(backend="highs")
    assert measure.objective == pytest.approx(solution.objective, rel=1e-8)
    for policy in (measure.mixed_policy(), on_original(measure.mixed_policy())):
        assert evaluate(policy, problem).objective == pytest.approx(solution.objective, rel=1e-8)
    problem = replace(problem, discount=None)
    frontier = trace_frontier(problem)
    assert frontier.objective_at(0.3) == pytest.approx(solve(problem).objective)
    policy = frontier.policy_at(0.3)
    assert policy.model is problem.model
    assert evaluate(policy, problem).failure_probability == pytest.approx(0.3)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_what_is_saved_is_what_was_found(tmp_path, criterion: type[MCMP] | type[S3P]) -> None:
    problem = criterion(mountain(), "camp", 0.2, horizon=5)
    solution = solve(problem)
    save_solution(solution, tmp_path / "solution.npz")
    again = criterion(mountain(), "camp", 0.2, horizon=5)
    known = load_solution(tmp_path / "solution.npz", again)
    assert known.policy.model is again.model
    assert certify(known) == certify(solution)
    with pytest.raises(ModelError, match="made for HorizonSSP"):
        load_solution(tmp_path / "solution.npz", criterion(mountain(), "camp", 0.2, horizon=4))
    with pytest.raises(ModelError, match="made for HorizonSSP"):
        load_solution(tmp_path / "solution.npz", criterion(mountain(), "camp", 0.2))
    save_policy(solution.policy, tmp_path / "policy.npz")
    for beside in (again.unrolled.model, within_steps(again.model, 5, start=["camp"])):
        policy = load_policy(tmp_path / "policy.npz", beside)
        assert policy.model.states == again.model.states


def test_an_array_that_would_fit_the_unrolled_model_too_is_the_stated_models() -> None:
    """From x to g or y, from y to g: within two steps three outcomes as well, in another order."""
    model = model_of(
        {"y": {"b": [(1.0, "g", 1.0)]}, "x": {"a": [(0.5, "g", 1.0), (0.5, "y", 1.0)]}}
    )
    cost = np.array([1.0, 2.0, 3.0])
    problem = LeastQuantity(model, "x", secondary_cost(cost), horizon=2)
    assert problem.unrolled.model.n_outcomes == model.n_outcomes == 3
    assert solve(problem).objective == pytest.approx(0.5 * 2.0 + 0.5 * (3.0 + 1.0))
    with pytest.raises(ModelError, match="give an array of 2 pairs or 3 outcomes"):
        LeastQuantity(model, "x", secondary_cost(np.ones(4)), horizon=2)
    remembering = product(model, Memory(0, lambda memory, *step: memory + 1))
    within = LeastQuantity(remembering, ("x", 0), secondary_cost({"y": {"b": 8.0}}), horizon=2)
    assert solve(within).objective == pytest.approx(4.0)


def test_what_no_episode_reaches_in_time_has_probability_and_cost_nothing() -> None:
    model = model_of(
        {
            "x": {"a": [(0.5, "g", 1.0), (0.5, "y", 1.0)]},
            "y": {"b": [(1.0, "x", 1.0)]},
            "far": {"c": [(0.9, "pit", 1.0), (0.1, "g", 1.0)]},
            "pit": {},
        },
        labels={"hole": ["pit"]},
    )
    late = {"y": {"b": 3.0}}
    nothing = {
        "pit": end_probability("pit"),
        "hole": end_probability("hole"),
        "far": visits("far"),
        "there": secondary_cost({"far": {"c": 3.0}}),
        "late": secondary_cost(late),
    }
    limits = {name: quantity <= 0.0 for name, quantity in nothing.items()}
    solution = solve(MCMP(model, "x", failure_budget=0.6, horizon=1, constraints=limits))
    assert certify(solution).accepted
    assert evaluate(solution.policy, solution.problem).secondary_costs == dict.fromkeys(limits, 0.0)
    for quantity in nothing.values():
        assert solve(LeastQuantity(model, "x", quantity, horizon=1)).objective == 0.0
    assert solve(LeastQuantity(model, "x", nothing["late"], horizon=3)).objective == 1.5
    for one in ("pit", "hole"):
        with pytest.raises(InfeasibleError):
            solve(MaxProb(model, "x", horizon=2, constraints={"e": end_probability(one) >= 0.1}))
    with pytest.raises(ModelError, match="has no action 'zz'; it has 'c'"):
        LeastQuantity(model, "x", secondary_cost({"far": {"zz": 1.0}}), horizon=1)
    with pytest.raises(ModelError, match="'nowhere' is neither an end"):
        LeastQuantity(model, "x", end_probability("nowhere"), horizon=1)


def test_copies_and_what_cannot_be() -> None:
    model = mountain()
    problem = MCMP(model, "camp", horizon=2, reach_fraction=0.9)
    assert solve(replace(problem, horizon=None)).failure_probability == pytest.approx(
        1.0 - 0.9 * solve(MaxProb(model, "camp")).objective
    )
    longer = replace(problem, horizon=5)
    assert longer.failure_budget < problem.failure_budget
    assert replace(longer, horizon=2).failure_budget == problem.failure_budget
    for wrong in (0, -3, 2.0, True, "many", np.nan):
        with pytest.raises(ModelError, match="horizon must be a whole number >= 1"):
            MCMP(model, "camp", 0.1, horizon=wrong)
    other = solve(MCMP(within_steps(model, 2), ("camp", 0), 0.2)).policy
    with pytest.raises(ModelError, match="another model object; on_original"):
        evaluate(other, MCMP(model, "camp", 0.2, horizon=2))
    assert evaluate(on_original(other), MCMP(model, "camp", 0.2, horizon=2)).ends[LATE] > 0.0


def test_a_horizon_of_too_many_steps_is_refused_at_once() -> None:
    model = SSP.from_transitions({"x": {"a": [(0.5, "g", 1.0), (0.5, "x", 1.0)]}}, goal={"g"})
    with pytest.raises(ModelError, match="are too many"):
        solve(MCMP(model, "x", failure_budget=1.0, horizon=10**9))


@pytest.mark.parametrize("steps", [1, 9, 40])
@pytest.mark.parametrize(
    "model", [river(6, 5), grid(6), scattered(40)], ids=["river", "grid", "any"]
)
def test_steps_are_counted_alike_by_compiled_loops_and_by_numpy(model, steps, accelerate):
    """The product itself, and the greatest probability beside one sweep for each step."""
    pytest.importorskip("numba")

    def counted() -> tuple[object, ...]:
        made = within_steps(replace(model), steps, survive=True)
        names = "pair_offsets", "outcome_offsets", "successors", "probabilities", "goal_mask"
        return *(getattr(made, name) for name in names), made.labels.state, made.labels.number

    assert_same(*both(accelerate, counted))
    reached = model.goal_mask.astype(np.float64)
    for _ in range(steps):
        sums = np.add.reduceat(
            model.probabilities * reached[model.successors], model.outcome_offsets[:-1]
        )
        np.maximum.at(reached, model.pair_state, sums)
    for solution in both(accelerate, lambda: solve(MaxProb(replace(model), 0, horizon=steps))):
        assert solution.objective == pytest.approx(reached[0], rel=1e-12, abs=0.0)
        assert solution.gap <= 1e-12
        assert solution.goal_probability == pytest.approx(reached[0], rel=1e-12, abs=0.0)
        assert certify(solution).accepted


def test_what_a_subclass_derives_from_the_model_follows_the_product() -> None:
    """``__post_init__`` of the subclass counts the states of the model, and then of the product."""

    class Counting(MCMP):
        def __post_init__(self) -> None:
            super().__post_init__()
            object.__setattr__(self, "counted", self.model.n_states)

    model = model_of({"a": {"go": [(0.5, "a", 1.0), (0.5, "g", 1.0)]}})
    problem: Any = Counting(model, "a", 1.0, horizon=3)
    assert problem.counted == model.n_states
    assert problem.unrolled.counted == problem.unrolled.model.n_states > model.n_states
