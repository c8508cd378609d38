"""Mistakes in a call, a file or a shell are named with their place and what to write."""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ssp_lp
import ssp_lp.io
import ssp_lp.plotting
from formulations import (
    GUBS,
    MCMP,
    S3P,
    CostQuantile,
    CVaR,
    FinitePenalty,
    MaxProb,
    MinCost,
    compare_criteria,
)
from formulations.command_line import main
from refusing import refused
from small_models import ROUTES
from ssp_lp import (
    SSP,
    Axis,
    ColumnGeneration,
    CostLimit,
    DeterministicPolicies,
    DeterministicPolicy,
    LinearProgramming,
    Memory,
    MixedPolicy,
    ModelError,
    StochasticPolicy,
    TimedPolicy,
    certify,
    check_certificate,
    end_probability,
    evaluate,
    on_original,
    product,
    secondary_cost,
    simulate,
    solve,
    success_costs,
    trace_frontier,
    visits,
    within_steps,
    write_certificate,
)
from ssp_lp.io import (
    from_gymnasium,
    load_policy,
    read_any,
    rollout,
    save_model,
    save_policy,
    save_solution,
)
from ssp_lp.model.arguments import explained
from ssp_lp.plotting import explore, plot_cost_law, plot_frontier

# Calls, words and files that do not fit are answered with their place and what to write.


MODEL = SSP.from_transitions({"depot": ROUTES}, goal={"home"}, dead_ends={"wreck"})
PROBLEM = MCMP(MODEL, "depot", failure_budget=0.05)
SOLUTION = solve(PROBLEM)
TRIPS = product(MODEL, Memory(0, lambda memory, *step: memory))


def test_a_problem_is_pickled_by_what_it_holds():
    again = pickle.loads(pickle.dumps(PROBLEM))  # noqa: S301
    assert repr(again) == repr(PROBLEM)
    assert solve(again).objective == SOLUTION.objective


def test_an_argument_that_is_passed_on_is_blamed_on_the_function_that_was_called():
    told = "SSP.from_transitions: state_labels must be a dict or None"
    refused(told, SSP.from_transitions, {}, {"home"}, state_labels=["wreck"])
    row = {"state": ["a"], "action": ["go"], "successor": ["b"], "probability": [1], "cost": [1]}
    refused("SSP.from_frame: state_labels must be", SSP.from_frame, row, {"b"}, state_labels=["a"])


def test_a_word_for_an_action_in_the_place_of_a_state():
    for word, told in (("alle", "did you mean the action 'alley'"), ("road", "it is an action")):
        limit = {"few": visits("depot", word) <= 1.0}
        text = refused(told, MCMP, MODEL, "depot", constraints=limit)
        assert "secondary_cost({state: {" in text
    refused("did you mean 'alley'", PROBLEM.program().visits, "depot", "alle")


def test_starts_that_are_none_say_what_to_write():
    refused("start: 77 is not a state.*; its states: 'depot', 'home', 'wreck'", MCMP, MODEL, 77)
    refused(r"several states are written dict\(zip\(", MCMP, MODEL, ["depot", "home"])
    refused(r"dict\(zip\(.*a state tuple\(array", MCMP, MODEL, np.array([1.0, 0.0, 0.0]))
    gym = pytest.importorskip("gymnasium")
    env = gym.make("FrozenLake-v1")
    for start in (77, {77: 1.0}):
        refused(r"start: 77 .*its states: 0, 1, .* \(16\)", from_gymnasium, env, start=start)
    refused("start must be hashable", from_gymnasium, env, start=np.array([0, 1]))


def test_a_certificate_in_memory_is_no_file():
    for wrong in (SOLUTION, 3, None):
        checked = check_certificate(wrong)
        assert not checked.accepted
        assert "write_certificate(solution, path)" in checked.reason


def test_reports_without_a_success_say_so():
    gym = pytest.importorskip("gymnasium")
    env = gym.make("FrozenLake-v1")
    world = from_gymnasium(env)
    policy = solve(ssp_lp.MaxProb(world.model, world.start)).policy
    report = rollout(env, policy, episodes=2, seed=0, max_steps=2)
    assert report.goal == 0
    lost = SSP.from_transitions(
        {"a": {"go": [(1e-9, "g", 1.0), (1.0 - 1e-9, "d", 1.0)]}}, goal={"g"}, dead_ends={"d"}
    )
    problem = MCMP(lost, "a")
    for told in (report, simulate(solve(problem).policy, problem, episodes=5)):
        assert "unknown: no episode reached the goal" in str(told)
        assert "nan" not in f"{told.summary()}{told!r}"
    assert evaluate(solve(problem).policy, problem).goal_probability == pytest.approx(1e-9)


def test_a_policy_that_never_succeeds_has_no_cost_given_success():
    away = SSP.from_transitions({"a": {"go": [(1.0, "d", 1.0)]}}, goal={"g"}, dead_ends={"d"})
    solution = solve(MCMP(away, "a"))
    for told in (solution.summary(), repr(solution.evaluation)):
        assert "none: the goal is never reached" in told
        assert "nan" not in told
    compared = ssp_lp.compare_criteria(away, "a")
    assert "nan" not in compared.summary()
    assert compared["MaxProb"].numbers[2] is None


@pytest.mark.parametrize(
    ("mistake", "told"),
    [
        (lambda: MCMP(MODEL), r"MCMP needs 'start': write MCMP\(model, start\)"),
        (lambda: MCMP(), r"MCMP needs 'model', 'start'"),
        (lambda: CVaR(MODEL, "depot"), r"CVaR needs 'level': write CVaR\(model, start, level\)"),
        (lambda: MCMP(MODEL, "depot", start="depot"), "is given 'start' twice"),
        (lambda: solve(), r"solve needs 'problem': write solve\(problem\)"),
        (
            lambda: solve(PROBLEM, "lp", 1e-9),
            r"takes \(problem, method\) by position; .*tolerance=",
        ),
        (lambda: SSP.from_transitions({}), "from_transitions needs 'goal'"),
        (lambda: SSP.from_arrays(costs=1.0), "needs 'pair_offsets', .*pair_offsets=..."),
        (lambda: secondary_cost(), "secondary_cost needs 'cost'"),
        (lambda: visits("depot", through_failure=1), "through_failure must be True or False"),
        (lambda: Axis(0, 1), r"Axis needs 'cells': write Axis\(low, high, cells\)"),
        (lambda: Axis(0, 1, n_cells=3), "Axis has no argument 'n_cells'; did you mean 'cells'"),
        (lambda: Memory(0), "Memory needs 'update'"),
        (lambda: within_steps(MODEL), "within_steps needs 'steps'"),
        (lambda: simulate(SOLUTION.policy), "simulate needs 'problem'"),
        (lambda: SOLUTION.explain(), r"Solution.explain needs 'state'"),
        (lambda: SOLUTION.policy.action(), "MixedPolicy.action needs 'state'"),
        (lambda: SOLUTION.policy.start(0, 0), r"MixedPolicy.start takes \(seed\) by position"),
        (lambda: load_policy(), r"load_policy needs 'path', 'model'"),
        (lambda: MCMP(PROBLEM), "MCMP takes an SSP first"),
        (lambda: MCMP(SOLUTION, "depot"), "MCMP takes an SSP first"),
        (lambda: MCMP(model={"depot": ROUTES}, start="depot"), "model must be an SSP"),
        (lambda: MCMP(MODEL, 0.05, "depot"), "failure_budget must be a number"),
        (lambda: MCMP(MODEL, "depot", failure_budget=True), "must be a number or None, not True"),
        (lambda: MCMP(MODEL, {"depot": "all"}), "state 'depot' must be a number"),
        (lambda: MCMP(MODEL, np.array([1.0])), "must be a state or"),
        (lambda: S3P(MODEL, "depot", 0.2, cost_cap="much"), "cost_cap must be a number"),
        (lambda: GUBS(MODEL, "depot", 3.0, 1.0), "utility must be a function"),
        (lambda: CostQuantile(MODEL, "depot", 95), r"did you mean 0\.95"),
        (lambda: CVaR(MODEL, "depot", 95), r"did you mean 0\.95"),
        (lambda: evaluate(SOLUTION), r"pass solution\.policy and its problem"),
        (lambda: evaluate(SOLUTION.policy), "takes a problem"),
        (lambda: evaluate(PROBLEM, SOLUTION.policy), "takes a problem"),
        (lambda: certify(PROBLEM), r"takes a solution from solve\(problem\)"),
        (lambda: save_solution(SOLUTION.policy, "nowhere"), "takes a solution"),
        (lambda: save_policy(SOLUTION, "nowhere"), "cannot be saved"),
        (lambda: load_policy("nowhere", PROBLEM), r"it has one: \.model"),
        (lambda: save_model(PROBLEM, "nowhere"), r"it has one: \.model"),
        (lambda: on_original(SOLUTION), r"pass solution\.policy"),
        (lambda: MixedPolicy((SOLUTION,), [1.0]), r"pass solution\.policy"),
        (lambda: TimedPolicy((SOLUTION,)), r"pass solution\.policy"),
        (lambda: DeterministicPolicy.from_actions(PROBLEM, {}), r"takes an SSP.*\.model"),
        (lambda: StochasticPolicy.from_actions({}, MODEL), "takes an SSP"),
        (lambda: product(Memory(0, lambda *step: 0), MODEL), r"product\(\) takes an SSP"),
        (lambda: product(MODEL, {"key": False}), "takes a Memory after the model"),
        (lambda: within_steps(3, MODEL), r"within_steps\(\) takes an SSP"),
        (lambda: within_steps(MODEL, 3, start="depot"), "start must be a set of states"),
        (lambda: SSP.from_transitions([1], goal={"home"}), "a model must be"),
        (
            lambda: SSP.from_transitions({"depot": ROUTES}, goal=lambda state: True),
            "goal must be a set",
        ),
        (lambda: visits(["crash"]), "names one by one"),
        (lambda: end_probability(["crash"]), "names one by one"),
        (lambda: PROBLEM.program().bounded_by({"failur": 0.1}), "no row is named 'failur'"),
        (lambda: solve(PROBLEM, tolerance="fine"), "tolerance must lie"),
        (lambda: trace_frontier(PROBLEM, gap="fine"), "gap must lie"),
        (lambda: trace_frontier(PROBLEM, point_limit=2.5), "point_limit must be"),
        (lambda: trace_frontier(PROBLEM, time_limit="long"), "time_limit must be"),
        (lambda: trace_frontier(PROBLEM, steepest_price="high"), "steepest_price must be"),
        (lambda: trace_frontier(PROBLEM).objective_at(5), r"did you mean 0\.05"),
        (
            lambda: simulate(SOLUTION.policy, PROBLEM, seed=0, episodes=1e4),
            "episodes must be a who",
        ),
        (lambda: simulate(SOLUTION.policy, PROBLEM, seed=0, record=-1), "record must be a whole"),
        (lambda: simulate(SOLUTION.policy, PROBLEM, seed=0, confidence=95), r"did you mean 0\.95"),
        (lambda: success_costs(SOLUTION.policy, PROBLEM).quantile(95), r"did you mean 0\.95"),
        (lambda: LinearProgramming(solver="highs"), "no argument 'solver'; did you mean 'backend'"),
        (lambda: LinearProgramming(1, 2), r"takes \(backend\) by position"),
        (lambda: ColumnGeneration(1), "ColumnGeneration takes nothing by position"),
        (lambda: DeterministicPolicies(relaxation="game"), "relaxation must be 'columns' or 'lp'"),
        (lambda: MCMP(MODEL, "depot", [0.1, 0.2]), r"sweep\(criterion, ...\) states a problem for"),
        (lambda: MaxProb(MODEL, "depot", give_up="deadends"), "'attention', 'dead_ends'"),
        (lambda: TRIPS.start("depo"), "start: 'depo' is not a state.*did you mean 'depot'"),
        (lambda: MCMP(TRIPS, "depot"), r"start\('depot'\) is the initial one"),
        (lambda: SSP.from_frame([{"state": "a"}], {"b"}), "the table is a list: give its columns"),
        (lambda: SSP.from_transitions({"depot": ROUTES}, {"home"}, dead_ends={"wrek"}), "'wreck'"),
        (lambda: plot_frontier(SOLUTION), r"trace_frontier\(problem\) makes one"),
        (lambda: explore(SOLUTION, "page.html"), r"trace_frontier\(problem\) makes one"),
        (
            lambda: explore(trace_frontier(PROBLEM), "page.png"),
            r"must end in \.html, not 'page.png'",
        ),
        (lambda: plot_cost_law(SOLUTION), r"success_costs\(policy, problem\) makes one"),
        (lambda: write_certificate(PROBLEM, "c"), r"solve\(problem\) makes one"),
        (lambda: PROBLEM.program().with_rows(3), "changed must be a function"),
        (lambda: PROBLEM.program().solve(solver="lp"), "'solver'; did you mean 'backend'"),
        (lambda: CostLimit("fuel"), r"needs 'bound': write CostLimit\(cost, bound\)"),
        (lambda: simulate(None, PROBLEM), r"DeterministicPolicy.from_actions\(model"),
        (lambda: CostQuantile(MODEL, "depot", 0.5).program(), r"CostBoundedReach\(...\).program"),
    ],
)
def test_a_mistake_is_named_with_its_remedy(mistake, told):
    """What is missing, one too many or mixed up."""
    refused(told, mistake)


def test_a_relaxation_may_be_named():
    named, stated = (solve(PROBLEM, DeterministicPolicies(r)) for r in ("lp", LinearProgramming()))
    assert named.objective == stated.objective == pytest.approx(8.96)


def test_a_csv_file_of_something_else_says_which_column_it_lacks(tmp_path):
    path = tmp_path / "other.csv"
    path.write_text("a,b\n1,2\n")
    refused("other.csv has no column 'state'; it has 'a', 'b'", read_any, path, "home")
    path.write_text("sate,action,successor,probability,cost\na,go,home,1,1\n")
    refused("did you mean 'sate'", read_any, path, "home")


def test_a_policy_of_another_environment_says_so():
    gym = pytest.importorskip("gymnasium")
    world = from_gymnasium(gym.make("FrozenLake-v1"))
    policy = solve(MaxProb(world.model, world.start)).policy
    other = gym.make("CliffWalking-v1")
    told = "observed in the environment: the policy's model may be of another one: 36"
    refused(told, rollout, other, policy, episodes=1, seed=0)


# Forty mistakes that people make in a model, a question or a command, and what they are told.


FINE: dict[str, Any] = {
    "depot": {
        "alley": [(0.9, "home", 4.0), (0.1, "wreck", 2.0)],
        "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
    },
    "wreck": {},
}


def model(table: Any = FINE, goal: Any = ("home",), **more: Any) -> SSP:
    return SSP.from_transitions(table, goal, treat_actionless_as_dead_ends=True, **more)


def with_outcome(*outcome: Any) -> dict[str, Any]:
    return {**FINE, "depot": {"road": [outcome]}}


def asked(name: str = "c", limit: Any = None, **more: Any) -> Any:
    return solve(MCMP(model(**more), "depot", 0.05, constraints={name: limit}))


TRIP = S3P(model(), "depot", 0.05)

IN_PYTHON: list[tuple[Callable[[], Any], str]] = [
    (lambda: exec("from ssp_lp import mcpm"), "did you mean 'MCMP'"),
    (lambda: model(goal=()), "the model has no goal state; name at least one"),
    (lambda: model(goal="home"), "goal must be a set of states, such as {'home'}"),
    (lambda: model(goal=("hom",)), "did you mean 'home'?"),
    (lambda: model(goal=("home", "depott")), "did you mean 'depot'?"),
    (lambda: SSP.from_transitions(FINE, ("home",)), "list all dead-ends, dead_ends={...}"),
    (
        lambda: SSP.from_transitions({"a": {"go": [(1.0, "hoem", 1.0)]}, "home": {}}, ("home",)),
        "leads to 'hoem', which is neither a state of the model nor a goal; did you mean 'home'?",
    ),
    (lambda: model(with_outcome("0.9", "home", 1.0)), "a probability that is not a number: '0.9'"),
    (lambda: model(with_outcome(1.0, "home", "4")), "a cost that is not a number: '4'"),
    (lambda: model(with_outcome(0.9, "home", 1.0)), "probabilities sum to 0.9, not to 1"),
    (lambda: model(with_outcome(1.0, "home", -1.0)), "rewards? pass costs=-rewards"),
    (lambda: model(with_outcome(1.0, ["home"], 1.0)), "must not contain a list, dict"),
    (lambda: model(with_outcome(1.0, "home")), "an outcome must be a triple"),
    (lambda: model({"depot": [(1.0, "home", 1.0)]}), "needs a dict {action:"),
    (lambda: model([("depot", "home")]), "a model must be {state: {action:"),
    (lambda: model(state_labels={"crash": ["wrek"]}), "did you mean 'wreck'?"),
    (lambda: model(state_labels={"crash": "wreck"}), "labels['crash'] must be a set of"),
    (lambda: model(state_labels={"goal": ["home"]}), "state label 'goal' is reserved"),
    (lambda: MCMP(model(), "depo", 0.05), "did you mean 'depot'?"),
    (lambda: MCMP(model(), "depot", "5%"), "failure_budget must be a number or None, not '5%'"),
    (lambda: MCMP(model(), "depot", 0.05, give_up="never"), "'dead_ends'"),
    (lambda: solve(MCMP(model(), "depot", 0.001)), "fails with probability at least 0.01"),
    (lambda: solve(MinCost(model(), "depot")), "no policy reaches the goal surely"),
    (lambda: solve(MCMP(model(), "depot", 0.05), "simplex"), "method"),
    (lambda: solve(TRIP, time_limit="5"), "time_limit must be a number of seconds"),
    (lambda: asked(limit=visits("wrek") <= 0.1), "did you mean 'wreck'?"),
    (lambda: asked(limit=end_probability("crash") <= 0.1), "'crash'"),
    (lambda: asked(limit=secondary_cost("fuel") <= 1), "the model has no cost 'fuel'"),
    (lambda: asked(limit=secondary_cost({"depot": {"rode": 1.0}}) <= 1), "did you mean 'road'?"),
    (lambda: asked(limit=0.5), "c"),
    (lambda: trace_frontier(TRIP, over="crash"), "'failure' or the name of a limit"),
    (lambda: simulate(solve(TRIP).policy, MCMP(model(), "depot"), seed=1), "another model"),
    (lambda: SSP.from_frame({"state": ["a"]}, ("b",)), "the table has no column 'action'"),
]  # fmt: skip


@pytest.mark.parametrize(("mistake", "told"), IN_PYTHON, ids=[told for _, told in IN_PYTHON])
def test_a_mistake_in_python_is_named(mistake: Callable[[], Any], told: str) -> None:
    with pytest.raises(Exception) as error:  # noqa: PT011 (which one is the point of the words)
        mistake()
    assert told in str(error.value)
    own = type(error.value).__module__ == "ssp_lp.errors"
    assert own or isinstance(error.value, ImportError)


IN_A_SHELL = [
    ("sovle roads.json", "'sovle'"),
    ("solve roads.json --goal hoem --start depot", "did you mean 'home'?"),
    ("solve roads.json --start depot", "--goal"),
    ("solve roads.json --goal home", "--start"),
    ("solve roads.json --goal home --start depo", "did you mean 'depot'?"),
    ("solve raods.json --goal home", "raods.json"),
    ("solve roads.txt --goal home", "must end in one of"),
    ("solve roads.json --goal home --start depot --criterion mcpm", "'mcpm'"),
    ("solve roads.json --goal home --start depot --failure-budget 5", "did you mean 0.05?"),
    ("solve roads.json --goal home --start depot --failure-budget five", "'five' is not a number"),
    ("solve roads.json --goal home --start depot --criterion cvar", "cvar needs --level"),
    (
        "solve roads.json --goal home --start depot --criterion maxprob --level 1/2",
        "has no --level",
    ),
    ("solve roads.json --goal home --start depot --limit fuel", "a limit is written"),
    ("solve roads.json --goal home --start depot --limit 'cost <= much'", '"much"'),
    ("solve roads.json --goal home --start depot --limit 'fuel <= 3'", "'fuel'"),
    ("solve roads.json --goal home --start depot --limit 'end(crash) <= 0'", "'crash'"),
    ("solve roads.json --goal home --start depot --policy-out plan.txt", ".npz"),
    ("solve roads.json --goal home --start depot --plot law.txt", "png"),
    (
        "solve roads.json --goal home --start depot --property 'P=? [X a]'",
        "is not a supported property",
    ),
    (
        "frontier roads.json --goal home --start depot --over crash",
        "'failure' or the name of a limit",
    ),
    ("solve roads.json --goal home --start depot --failure-budget 0.001", "at least 0.01"),
    ("simulate roads.json --goal home --start depot", "--policy"),
    ("slove roads.json", "there is no 'slove'; did you mean 'solve'?"),
    ("solve roads.json --criterion mcpm", "did you mean 'mcmp'?"),
    ("solve roads.json --criterion xyz", "choose from alpha-mcmp, "),
    ("solve roads.json --budget 0.05", "no --budget; did you mean --failure-budget?"),
    ("solve roads.json --epsilon=0.05", "no --epsilon; did you mean --failure-budget?"),
    ("solve roads.json --gamma 0.9", "did you mean --discount?"),
    ("solve roads.json --metod lp", "did you mean --method?"),
    ("simulate roads.json --policy p.npz --runs 3", "did you mean --episodes?"),
    ("solve roads.json home", "'home' is one word too many"),
    ("solve roads.json --failure_budget 0.1", "did you mean --failure-budget?"),
    *(
        (f"{verb} roads.json --goal home --start depot {words}", told)
        for verb, words, told in (
            ("solve", "--limit 'fuel <= 3'", "quantities are 'cost', 'goal'"),
            ("solve", "--limit 'costs <= 3'", "did you mean 'cost'?"),
            ("solve", "--limit 'visit(depot) <= 3'", "did you mean 'visits(...)'?"),
            ("solve", "--cost fuel", "leave out --cost"),
            ("explore", "--out page.png", "a page's name must end in .html"),
            ("program", "--criterion cvar --level 0.9", "CVaR is not a linear program but"),
            ("solve", "--criterion least-quantity --quantity fuel", "'fuel' is not a quantity of"),
            ("solve", "--dead-ends wrek", "did you mean 'wreck'?"),
        )
    ),
]


@pytest.mark.parametrize(("words", "told"), IN_A_SHELL, ids=[words for words, _ in IN_A_SHELL])
def test_a_mistake_in_a_shell_is_told_in_one_line(
    words: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    import shlex

    monkeypatch.chdir(tmp_path)
    for name in ("roads.json", "roads.txt"):
        Path(name).write_text(json.dumps(FINE), encoding="utf-8")
    try:
        code = main(shlex.split(words))
    except SystemExit as ended:
        code = int(str(ended.code))
    printed = capsys.readouterr()
    assert code in (2, 3)
    assert printed.out == ""
    assert told in printed.err
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("ssp-lp")


def test_costs_that_are_all_zero_are_told() -> None:
    free = {"a": {"go": [(0.9, "home", 0.0), (0.1, "wreck", 0.0)]}, "wreck": {}}
    told = solve(MCMP(model(free), "a", 0.2)).summary()
    assert "every step costs 0" in told
    assert "every step costs 0" not in solve(TRIP).summary()


# Slips in what functions are given: the error is the library's own and names the part.


GAMBLE = SSP.from_transitions(
    {"a": {"x": [(0.9, "g", 1.0), (0.1, "d", 2.0)]}, "d": {}},
    goal={"g"},
    treat_actionless_as_dead_ends=True,
)
BET = MCMP(GAMBLE, "a", failure_budget=0.2)
PLAYED = solve(BET)
GRID = ssp_lp.Grid([ssp_lp.Axis(0.0, 1.0, 4)])


def step(point, action, noise):
    return (point[0] + 1.0,), 1.0, 1


WORLD = ssp_lp.ContinuousModel(GRID, [0], step)
KNOWN = {
    **{name: getattr(ssp_lp, name) for name in ssp_lp.__all__},
    **{name: getattr(ssp_lp.io, name) for name in ssp_lp.io.__all__},
    **{name: getattr(ssp_lp.plotting, name) for name in ssp_lp.plotting.__all__},
    **{"M": GAMBLE, "P": BET, "S": PLAYED, "G": GRID, "W": WORLD, "np": np, "step": step},
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
    ("G.centre(99)", "cells are whole numbers 0 .. 3"),
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
    ("M.action_of(99)", "99 is not a pair"),
    ("product(M, Memory(0, lambda a, b: 0))", "update must be a function of 5 arguments"),
    ("product(M, Memory(0, lambda m, s, a, t, c: []))", "states must not contain a list"),
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
    ("from_matrices([np.eye(2)], 1, costs='x')", "costs or rewards must be numbers, not 'x'"),
    ("from_gymnasium('FrozenLake-v1')", "an environment is needed, such as"),
    ("rollout(None, S.policy, episodes=3, seed=0)", "has no environment"),
    (
        "rollout(None, S.policy, episodes='x', seed=0)",
        "episodes must be a whole number >= 1, not 'x'",
    ),
    ("load_solution('s.npz', M)", "No such file|problem must be a Problem"),
    ("plot_frontier(S)", "frontier must be a"),
    ("plot_cost_law(S)", "law must be a CostLaw"),
    ("plot_bounds(BoundsRecord(), P)", r"plot_bounds\(\) takes a solution"),
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
