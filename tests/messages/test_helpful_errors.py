"""What a new user stumbles over is named, with a remedy, before it changes an answer."""

from __future__ import annotations

import gzip
import pickle
import time
import warnings
from typing import Any

import numpy as np
import pytest

from formulations import MCMP, S3P, AlphaMCMP, CVaR, MaxProb, MinCost, compare_criteria
from formulations.command_line import main
from refusing import refused
from small_models import ROUTES, model_of
from ssp_lp import (
    SSP,
    Axis,
    DeterministicPolicy,
    Grid,
    Memory,
    MixedPolicy,
    ModelError,
    ModelWarning,
    arrival_cost,
    check_certificate,
    cross_check,
    end_probability,
    evaluate,
    expected_cost,
    goal_probability,
    product,
    secondary_cost,
    simulate,
    solve,
    success_costs,
    trace_frontier,
    visits,
    write_certificate,
)
from ssp_lp.compiled import accelerator
from ssp_lp.compiled.deadline import Stop, until
from ssp_lp.io import fingerprint, from_gymnasium, load_policy, read_any, rollout, save_policy
from ssp_lp.methods.labelled_program import program_of
from ssp_lp.policies.policy import generator_of

# Errors name what was probably meant.


ROAD: dict[Any, Any] = {
    "depot": {"alley": [(0.9, "home", 4.0), (0.1, "wreck", 2.0)]},
    "wreck": {},
    (1, 2): {"alley": [(1.0, "home", 1.0)], "road": [(1.0, "home", 1.0)]},
    7: {"alley": [(1.0, "home", 1.0)]},
}
MODEL = model_of(ROAD, "home", labels={"crash": ["wreck"]})
PROBLEM = MCMP(MODEL, "depot", 0.2)
SOLUTION = solve(PROBLEM)


@pytest.mark.parametrize(
    ("asked", "meant"),
    [("deopt", "'depot'"), ("Depot", "'depot'"), ("7", "7"), ("(1,2)", "(1, 2)"), ([1, 2], "(1")],
)
def test_an_unknown_state_has_a_nearest(asked: Any, meant: str) -> None:
    with pytest.raises(ModelError) as caught:
        MODEL.index_of(asked)
    assert f"did you mean {meant}" in str(caught.value)


def test_nothing_near_is_not_guessed() -> None:
    with pytest.raises(ModelError) as caught:
        MODEL.index_of("zzz")
    assert "did you mean" not in str(caught.value)
    with pytest.raises(ModelError, match=r"states are 0 \.\. 1"):
        numbered().index_of(5)


def test_looking_for_the_nearest_is_bounded() -> None:
    n = 300_000
    names = [f"state number {k}" for k in range(n)]
    model = SSP.from_arrays(
        pair_offsets=np.minimum(np.arange(n + 1), n - 1),
        outcome_offsets=np.arange(n),
        successors=np.arange(1, n),
        probabilities=np.ones(n - 1),
        costs=1.0,
        goal_states=[n - 1],
        states=names,
    )
    model.index_of("state number 1")
    began = time.perf_counter()
    with pytest.raises(ModelError, match="did you mean 'state number"):
        model.index_of("state numer 1")
    assert time.perf_counter() - began < 10.0


def test_an_unknown_action_has_a_nearest_or_a_list() -> None:
    with pytest.raises(ModelError, match="did you mean 'alley'"):
        DeterministicPolicy.from_actions(MODEL, {"depot": "aley"})
    with pytest.raises(ModelError, match="it has 'alley', 'road'"):
        DeterministicPolicy.from_actions(MODEL, {(1, 2): "fly"})
    with pytest.raises(ModelError, match="it has none"):
        DeterministicPolicy.from_actions(MODEL, {"wreck": "fly"})
    with pytest.raises(ModelError, match="did you mean 'alley'"):
        limited(secondary_cost({"depot": {"Alley": 1.0}}) <= 1.0)


def limited(limit: Any) -> MCMP:
    return MCMP(MODEL, "depot", constraints={"limit": limit})


def test_unknown_labels_and_ends_have_a_nearest() -> None:
    with pytest.raises(ModelError, match="did you mean 'crash'"):
        limited(visits("crahs") <= 1.0)
    with pytest.raises(ModelError, match="did you mean 'dead_end'"):
        limited(end_probability("dead end") <= 1.0)


def test_a_stranger_among_the_successors_has_a_nearest() -> None:
    with pytest.raises(ModelError, match="did you mean 'home'"):
        SSP.from_transitions({"depot": {"go": [(1.0, "hoem", 1.0)]}}, goal={"home"})


def test_percentages_are_recognised() -> None:
    with pytest.raises(ModelError, match=r"did you mean 0\.05\?"):
        MCMP(MODEL, "depot", failure_budget=5)
    with pytest.raises(ModelError, match=r"did you mean 0\.9\?"):
        AlphaMCMP(MODEL, "depot", 90)
    with pytest.raises(ModelError) as caught:
        MCMP(MODEL, "depot", failure_budget=-0.2)
    assert "did you mean" not in str(caught.value)


def test_rewards_are_recognised() -> None:
    with pytest.raises(ModelError, match=r"state 'a' has a negative cost.*costs=-rewards"):
        SSP.from_transitions({"a": {"go": [(1.0, "b", -1.0)]}}, goal={"b"})


def numbered(probabilities: Any = (0.5, 0.5), **options: Any) -> SSP:
    return SSP.from_arrays(
        pair_offsets=[0, 1, 1],
        outcome_offsets=[0, 2],
        successors=[0, 1],
        probabilities=probabilities,
        costs=1.0,
        goal_states=[1],
        **options,
    )


def test_single_precision_is_divided_out_where_asked() -> None:
    single = np.array([1 / 3, 2 / 3 - 1e-7], dtype=np.float32)
    with pytest.raises(ModelError, match="normalise=True"):
        numbered(single)
    assert numbered(single, normalise=True).probabilities.sum() == pytest.approx(1.0, abs=1e-15)
    table = {"a": {"go": [(1 / 3, "a", 1.0), (0.666667, "g", 1.0)]}}
    with pytest.raises(ModelError, match="normalise=True"):
        SSP.from_transitions(table, goal={"g"})
    for model in (
        SSP.from_transitions(table, goal={"g"}, normalise=True),
        SSP.from_successors("a", table.__getitem__, {"g"}, normalise=True),
    ):
        assert model.probabilities.sum() == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("normalise", [False, True])
def test_what_is_no_rounding_stays_an_error(normalise: bool) -> None:
    with pytest.raises(ModelError, match=r"sum to 0\.9, not to 1$"):
        numbered([0.4, 0.5], normalise=normalise)


def test_a_model_is_no_problem_and_a_solution_no_policy() -> None:
    policy = SOLUTION.policy
    with pytest.raises(ModelError, match=r"solve\(\) takes a problem, such as MCMP\(model"):
        solve(MODEL)  # type: ignore[arg-type]
    for question in (trace_frontier, cross_check):
        with pytest.raises(ModelError, match="takes a problem"):
            question(MODEL)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="MCMP takes an SSP first"):
        MCMP("depot", MODEL)  # type: ignore[arg-type]
    for verb in (evaluate, success_costs):
        with pytest.raises(ModelError, match=r"takes a policy: pass solution\.policy"):
            verb(SOLUTION, PROBLEM)  # type: ignore[arg-type]
        with pytest.raises(ModelError, match="takes a problem"):
            verb(policy, MODEL)  # type: ignore[arg-type]
        with pytest.raises(ModelError, match="takes a policy, such as"):
            verb({"depot": "alley"}, PROBLEM)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=r"pass solution\.policy"):
        simulate(SOLUTION, PROBLEM, seed=0)  # type: ignore[arg-type]


def test_a_policy_of_a_product_is_recognised() -> None:
    task = product(MODEL, Memory(start=0, update=lambda kept, *step: kept))
    plan = solve(MCMP(task, task.start("depot"), 0.2))
    with pytest.raises(ModelError, match="on_original"):
        evaluate(plan.policy, PROBLEM)


def test_a_seed_is_a_generator() -> None:
    by_seed = simulate(SOLUTION.policy, PROBLEM, seed=3, episodes=500)
    by_generator = simulate(SOLUTION.policy, PROBLEM, seed=np.random.default_rng(3), episodes=500)
    assert by_seed.ends == by_generator.ends
    assert SOLUTION.policy.start(0).action("depot") == "alley"
    given = np.random.default_rng(1)
    assert generator_of(given) is given
    for wrong in (-1, 0.5, "0", True, None):
        with pytest.raises(ModelError, match="seed must be a number such as 0"):
            generator_of(wrong)  # type: ignore[arg-type]


def test_values_by_name_have_a_nearest_name() -> None:
    problem = MCMP(MODEL, "depot", 0.2, constraints={"fuel": secondary_cost({}) <= 1.0})
    solution = solve(problem)
    report = simulate(solution.policy, problem, seed=0, episodes=5)
    for values, slip, meant in (
        (solution.prices, "feul", "'fuel'"),
        (solution.secondary_costs, "Fuel", "'fuel'"),
        (solution.evaluation.ends, "crahs", "'crash'"),
        (report.ends, "unfinishd", "'unfinished'"),
        (problem.program().solve().duals, "failur", "'failure'"),
        (problem.program().solve().activity, "fule", "'fuel'"),
        (compare_criteria(MODEL, "depot", penalties=()), "MaxProp", "'MaxProb'"),
    ):
        with pytest.raises(KeyError, match=f"did you mean {meant}"):
            values[slip]
    with pytest.raises(KeyError, match=r"there are 'f(ailure|uel)'"):
        solution.prices["zzz"]
    assert solution.prices.get("zzz") is None


def test_a_goal_that_no_action_leads_to_may_be_misspelt() -> None:
    table = {"depot": {"road": [(1.0, "home", 1.0)]}}
    with pytest.raises(ModelError, match="no action leads to the goal 'Home'; did you mean 'home'"):
        SSP.from_transitions(table, goal={"Home"}, treat_actionless_as_dead_ends=True)
    far = SSP.from_transitions({**table, "home": {"stay": [(1.0, "home", 1.0)]}}, goal={"moon"})
    assert far.goal_mask.sum() == 1  # nothing reads like it: out of reach


def test_successors_that_are_not_listed_are_dead_ends_where_these_need_no_actions() -> None:
    table = {"depot": {"alley": [(0.9, "home", 4.0), (0.1, "wreck", 2.0)]}}
    model = SSP.from_transitions(table, goal={"home"}, treat_actionless_as_dead_ends=True)
    assert solve(MCMP(model, "depot", 0.1)).objective == pytest.approx(3.8, rel=1e-12)
    with pytest.raises(
        ModelError, match="nor a goal; if runs end there, name it in dead_ends; the"
    ):
        SSP.from_transitions(table, goal={"home"})


def test_a_label_of_goals_is_a_way_to_end_and_one_of_places_on_the_way_is_none() -> None:
    table = {
        "depot": {
            "alley": [(0.5, "home", 1.0), (0.4, "inn", 1.0), (0.1, "wreck", 1.0)],
            "road": [(1.0, "home", 3.0)],
        },
        "wreck": {},
    }
    labels = {"cosy": ["inn"], "begun": ["depot"]}
    model = SSP.from_transitions(
        table, goal={"home", "inn"}, state_labels=labels, treat_actionless_as_dead_ends=True
    )
    few = {"few": end_probability("cosy") <= 0.1}
    assert solve(MCMP(model, "depot", 1.0, constraints=few)).objective == pytest.approx(2.5)
    with pytest.raises(ModelError, match="no episode ends in a state labelled 'begun': use visits"):
        solve(MCMP(model, "depot", 1.0, constraints={"few": end_probability("begun") <= 0.1}))


def test_a_budget_that_is_spent_by_giving_up_is_told_of() -> None:
    table = {"depot": {"road": [(1.0, "home", 3.0)], "wait": [(1.0, "depot", 1.0)]}}
    model = SSP.from_transitions(table, goal={"home"})
    assert "give_up='dead_ends' forbids it" in solve(MCMP(model, "depot", 0.2)).summary()
    assert "giving up" not in solve(MCMP(model, "depot", 0.2, give_up="dead_ends")).summary()


# What a new user stumbles over is answered with its name and a remedy.


ROADS = SSP.from_transitions({"depot": ROUTES}, goal={"home"}, dead_ends={"wreck"})
CROSSING = MCMP(ROADS, "depot", failure_budget=0.05)
CSV = """state,action,successor,probability,time,fuel
depot,alley,home,9/10,4,1
depot,alley,wreck,0.1,2,1

depot,road,home,0.99,9,3
depot,road,wreck,0.01,5,3
"""
OPTIONS = {"goal": {"home"}, "cost": ["time", "fuel"], "dead_ends": {"wreck"}}


@pytest.mark.slow
def test_a_policy_of_a_grid_is_rolled_out_in_its_environment():
    """The car is driven up the hill in the environment's own steps, which cost 1 each."""
    gym = pytest.importorskip("gymnasium")
    env = gym.make("MountainCar-v0", max_episode_steps=2_000)
    grid = Grid([Axis(-1.2, 0.6, cells=40), Axis(-0.07, 0.07, cells=40)])
    made = from_gymnasium(env, grid=grid, goal=lambda point: point[0] >= 0.5, start=(-0.5, 0.0))
    policy = solve(MCMP(made.model, made.start)).policy_everywhere()
    report = rollout(env, policy, episodes=5, seed=0, max_steps=2_000)
    assert report.goal + report.failed + report.gave_up + report.truncated == 5
    assert np.array_equal(report.success_costs, np.round(report.success_costs))
    assert report.goal >= 1
    speeds = np.arange(-0.068, 0.07, 0.003)
    cells = {grid.cell_of((x, speed)) for x in (0.505, 0.55, 0.59) for speed in speeds}
    again = from_gymnasium(env, grid=grid, goal=cells, start=(-0.5, 0.0))
    assert fingerprint(again.model) == fingerprint(made.model)


def test_a_criterion_of_a_world_names_its_parts():
    gym = pytest.importorskip("gymnasium")
    world = from_gymnasium(gym.make("FrozenLake-v1"))
    refused(r"it has \.model and \.start: pass them", MCMP, world, 0)


def test_intervals_of_costs_allow_for_what_the_policy_can_pay():
    """A dear loop that the policy never enters does not count; one that it plays is named."""
    loop = {**ROUTES, "wander": [(0.5, "depot", 1000.0), (0.5, "home", 1000.0)]}
    model = SSP.from_transitions({"depot": loop}, goal={"home"}, dead_ends={"wreck"})
    problem = MCMP(model, "depot", failure_budget=0.05)
    report = simulate(solve(problem).policy, problem)
    cost = report.conditional_cost
    assert cost.low <= evaluate(solve(problem).policy, problem).conditional_cost <= cost.high < 9.0
    assert cost.standard_error == pytest.approx(
        report.success_costs.std(ddof=1) / np.sqrt(report.success_costs.size)
    )
    assert f"± {cost.standard_error:.2g} [" in str(cost)
    assert report.note == ""
    tries = SSP.from_transitions({"a": {"try": [(0.5, "a", 1.0), (0.5, "g", 1.0)]}}, goal={"g"})
    problem = MinCost(tries, "a")
    assert (
        "an unseen episode of 500 steps"
        in simulate(solve(problem).policy, problem, max_steps=500).note
    )


def test_models_of_csv_files(tmp_path, capsys):
    path = tmp_path / "roads.csv"
    path.write_text(CSV)
    model = SSP.from_csv(path, **OPTIONS)
    assert solve(MCMP(model, "depot", failure_budget=0.05)).objective == pytest.approx(20 / 3)
    assert list(model.named_costs) == ["time", "fuel"]
    assert np.array_equal(read_any(path, "home", "fuel").model.costs, model.named_costs["fuel"])
    refused("choose one of the reward models .*'time', 'fuel'", read_any, path, "home")
    refused(r"SSP.from_csv\('x.csv', ...\) reads it", SSP.from_frame, "x.csv", goal={"home"})
    words = ["solve", str(path), "--goal", "home", "--start", "depot", "--cost", "time"]
    assert main([*words, "--failure-budget", "0.05", "--dead-ends", "wreck"]) == 0
    assert "6.6666666" in capsys.readouterr().out
    for wrong, told in (
        (CSV.replace("9/10", "most"), "row 2: 'most' in column 'probability' is not a number"),
        (CSV.replace("probability", "chance"), "no column 'probability'"),
        ("", "holds no table"),
    ):
        path.write_text(wrong)
        refused(told, SSP.from_csv, path, **OPTIONS)


def test_wrong_files_are_explained(tmp_path, capsys):
    text, objects, packed = (tmp_path / name for name in ("a.txt", "a.npy", "a.gz"))
    text.write_text("hello")
    np.save(objects, np.array([{}], dtype=object))
    packed.write_bytes(gzip.compress(b"hello"))
    for path in (text, objects):
        told = refused("not an ssp-lp policy file.* save_policy", load_policy, path, ROADS)
        assert "pickle" not in told
        assert "not a certificate: ssp_lp.write_certificate" in check_certificate(path).reason
        assert main(["check", str(path)]) == 1
        assert "not a certificate" in capsys.readouterr().err
    assert not check_certificate(packed).accepted


def test_the_command_line_prints_programs_and_the_path_of_a_page(tmp_path, capsys, monkeypatch):
    (tmp_path / "roads.csv").write_text(CSV.replace("time,fuel", "cost,fuel"))
    monkeypatch.chdir(tmp_path)
    words = ["roads.csv", "--goal", "home", "--start", "depot", "--cost", "cost"]
    assert main(["program", *words, "--failure-budget", "0.05"]) == 0
    printed = capsys.readouterr().out
    assert "alley" in printed
    assert "balance" in printed
    assert main(["explore", *words, "--out", "page.html"]) == 0
    assert str(tmp_path / "page.html") in capsys.readouterr().out


def test_a_comparison_is_a_frame():
    pytest.importorskip("pandas")
    compared = compare_criteria(ROADS, "depot")
    frame = compared.to_frame()
    assert list(frame["criterion"]) == [row.criterion for row in compared.rows]
    row = compared.rows[0]
    assert frame["objective"][0] == pytest.approx(row.numbers[0])


def _press_ctrl_c_in_a_loop():
    with until(float("inf")) as call:
        call.is_interrupted = True
        raise Stop


def test_an_interrupt_before_there_is_an_answer_says_so(monkeypatch, capsys):
    def pressed(*_: object, **__: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("ssp_lp.formulations.command_line._run_command", pressed)
    assert main(["info", "roads.json"]) == 130
    assert "interrupted before there was an answer" in capsys.readouterr().err
    with pytest.raises(KeyboardInterrupt, match="before there was an answer"):
        _press_ctrl_c_in_a_loop()


def test_a_misspelled_accelerator_is_refused_at_once(monkeypatch):
    monkeypatch.setenv("SSP_LP_ACCELERATOR", "nubma")
    refused("must be 'numba' or 'none', not 'nubma'", accelerator.accelerated, 1)
    refused("must be 'numba' or 'none', not 'nubma'", solve, CROSSING)


def test_arrays_as_states_are_refused_with_what_to_write():
    words = r"array of shape \(2,\).*tuple\(array.tolist\(\)\)"
    state = np.array([0, 1])
    step = {"go": [(1.0, state, 1.0)]}
    refused(words, SSP.from_successors, state, lambda _: {}, goal={1})
    refused(words, SSP.from_successors, (0, 0), lambda _: step, goal={1})
    refused(words, SSP.from_transitions, {"a": step}, goal={1})
    refused(words, SSP.from_transitions, {"a": {"go": [(1.0, 1, 1.0)]}}, goal=[state])
    row = {"state": [state], "action": ["a"], "successor": [1], "probability": [1], "cost": [1]}
    refused(words, SSP.from_frame, row, goal={1})


def test_a_convex_program_and_a_model_show_what_concerns_users():
    pytest.importorskip("cvxpy")
    program = program_of(CROSSING).to_cvxpy()
    assert repr(program).startswith("ConvexProgram in cvxpy: ")
    assert "failure" in repr(program)
    program.constraints["few"] = program.x <= 5.0
    assert "few: x <= 5.0" in repr(program)
    assert not [name for name in dir(ROADS) if name.startswith("_")]
    assert {"from_csv", "states", "with_dead_ends"} <= set(dir(ROADS))


def test_solutions_and_problems_in_the_place_of_others_are_named(tmp_path):
    solution = solve(CROSSING)
    refused("solution must be a Solution, not MCMP", write_certificate, CROSSING, tmp_path / "c")
    refused(r"save its .policy instead", save_policy, solution, tmp_path / "p")
    other = SSP.from_transitions({"a": {"go": [(1.0, "b", 1.0)]}}, goal={"b"})
    refused("pass a problem on policy.model", evaluate, solution.policy, MinCost(other, "a"))


# What is misspelled, missing or silently assumed is named before it changes an answer.


DEPOT = SSP.from_transitions({"depot": ROUTES}, goal={"home"}, dead_ends={"wreck"})
DRIVE = MCMP(DEPOT, "depot", failure_budget=0.05)
MISSPELLED = {**ROUTES, "alley": [(0.90, "hoem", 4.0), (0.10, "wreck", 2.0)]}
COLUMNS = [
    ("depot", action, to, chance, cost)
    for action, outcomes in MISSPELLED.items()
    for chance, to, cost in outcomes
]
TABLE = dict(
    zip(
        ("state", "action", "successor", "probability", "cost"),
        map(list, zip(*COLUMNS, strict=True)),
        strict=True,
    )
)


@pytest.mark.parametrize("dead_ends", [{"wreck"}, ["wreck"], lambda state: state == "wreck"])
def test_listed_dead_ends_are_the_only_ones(dead_ends):
    model = SSP.from_transitions({"depot": ROUTES}, goal={"home"}, dead_ends=dead_ends)
    assert solve(MCMP(model, "depot", failure_budget=0.05)).objective == pytest.approx(20 / 3)
    words = "'hoem', where action 'alley' of state 'depot' leads.*did you mean 'home'"
    options = {"goal": {"home"}, "dead_ends": dead_ends}
    refused(words, SSP.from_transitions, {"depot": MISSPELLED}, **options)
    refused(words, SSP.from_frame, TABLE, **options)
    refused(words, SSP.from_successors, "depot", {"depot": MISSPELLED, "wreck": {}, "hoem": {},
            "home": {}}.__getitem__, **options)  # fmt: skip


def test_dead_ends_of_arrays_are_given_by_labels():
    arrays = {
        "pair_offsets": [0, 1, 1, 1],
        "outcome_offsets": [0, 2],
        "successors": [1, 2],
        "probabilities": [0.5, 0.5],
        "costs": 1.0,
        "goal_states": [1],
    }
    assert SSP.from_arrays(**arrays, dead_ends=[2]).n_states == 3
    named = arrays | {"states": ["a", "home", "wreck"]}
    assert SSP.from_arrays(**named, dead_ends={"wreck"}).n_states == 3
    refused("state 'wreck', where .* neither a goal nor", SSP.from_arrays, **named, dead_ends=())
    refused("did you mean 'wreck'", SSP.from_arrays, **named, dead_ends={"wrek"})


def test_a_dead_end_may_have_actions_but_no_way_to_the_goal():
    trap = {"stay": [(1.0, "trap", 1.0)]}
    model = {"a": {"go": [(0.5, "g", 1.0), (0.5, "trap", 1.0)]}, "trap": trap}
    assert SSP.from_transitions(model, goal={"g"}, dead_ends={"trap"}).n_pairs == 2
    for wrong in ("a", "g"):
        words = f"'{wrong}' is listed in dead_ends, but the goal is reached from it"
        refused(words, SSP.from_transitions, model, goal={"g"}, dead_ends={"trap", wrong})


@pytest.mark.parametrize("wrong", ["hoem", "homee", "hume", "ohme"])
def test_an_unlisted_state_that_resembles_another_is_warned_of(wrong):
    model = {"depot": {"go": [(0.9, wrong, 1.0), (0.1, "home", 1.0)]}}
    with pytest.warns(ModelWarning, match=f"'{wrong}' has no actions.*did you mean 'home'"):
        SSP.from_transitions(model, goal={"home"}, treat_actionless_as_dead_ends=True)


def test_names_that_are_numbered_or_listed_are_not_warned_of():
    outcomes = [(0.25, "cell11", 1.0), (0.25, "cell12", 1.0), (0.5, "cell1", 1.0)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for model in (
            {"cell2": {"go": outcomes}},
            {"ward": {"go": [(0.5, "wards", 1.0), (0.5, "cell1", 1.0)]}, "wards": {}},
        ):
            SSP.from_transitions(model, goal={"cell1"}, treat_actionless_as_dead_ends=True)


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("budget", "failure_budget"),
        ("epsilon", "failure_budget"),
        ("gamma", "discount"),
        ("limits", "constraints"),
        ("giveup", "give_up"),
        ("charge_failing", "charge_failing_step"),
    ],
)
def test_a_misspelled_keyword_of_a_criterion_is_named_with_what_was_meant(word, meant):
    words = f"has no argument '{word}'; did you mean '{meant}'"
    refused(words, MCMP, DEPOT, "depot", **{word: 0.05})


def test_misspelled_keywords_of_functions():
    refused("did you mean 'method'", solve, DRIVE, solver="lp")
    refused("did you mean 'time_limit'", solve, DRIVE, timeout=3)
    refused("did you mean 'start'", S3P, DEPOT, initial_state="depot", failure_budget=0.1)
    refused("did you mean 'cost'", SSP.from_transitions, {}, goal={"a"}, reward="time")
    refused("did you mean 'costs'", SSP.from_arrays, rewards=[1.0])
    refused("did you mean 'seed'", simulate, solve(DRIVE).policy, DRIVE, rng=0)
    refused("its arguments: problem", cross_check, DRIVE, colour=3)
    refused("did you mean 'time_limit'", evaluate, solve(DRIVE).policy, DRIVE, timeout=3)
    refused("did you mean 'point_limit'", trace_frontier, DRIVE, points_limit=3)
    refused("CVaR has no argument 'alpha'; its arguments: model, start", CVaR, DEPOT, alpha=0.9)
    refused("did you mean 'policies'", MixedPolicy, policy=(), weights=())


def test_simulation_has_a_seed():
    policy = solve(DRIVE).policy
    played, again = (simulate(policy, DRIVE, episodes=50, **seed) for seed in ({}, {"seed": 0}))
    assert repr(played) == repr(again)


def test_strict_limits_say_what_to_write():
    refused(r"write expected_cost\(\) <= 5", lambda: expected_cost() < 5)
    refused(r"write end_probability\('goal'\) >= 0.5", lambda: goal_probability() > 0.5)
    for function in (expected_cost, visits, secondary_cost, arrival_cost):
        assert pickle.loads(pickle.dumps(function)) is function  # noqa: S301


def test_where_a_limited_cost_stops_to_count_is_a_choice_of_maxprob():
    """Declared failing at ``a`` saves what follows; counted to the dead-end it must be paid."""
    model = SSP.from_transitions(
        {
            "a": {"go": [(1.0, "b", 1.0)]},
            "b": {
                "risk": [(0.4, "two", 1.0), (0.6, "three", 1.0)],
                "stop": [(1.0, "two", 0.0)],
            },
        },
        goal={"three"},
        dead_ends={"two"},
    )
    limit = {"cost": expected_cost() <= 1.5}
    assert solve(MaxProb(model, "a", constraints=limit)).objective == pytest.approx(0.45)
    counted = MaxProb(model, "a", give_up="dead_ends", constraints=limit)
    assert solve(counted).objective == pytest.approx(0.3)
    refused("give_up", MaxProb, model, "a", give_up="never")
