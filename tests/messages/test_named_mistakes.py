"""Calls, words and files that do not fit are answered with their place and what to write."""

import pickle

import numpy as np
import pytest

import ssp_lp
from formulations import GUBS, MCMP, S3P, CostQuantile, CVaR, MaxProb
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
from ssp_lp.plotting import explore, plot_cost_law, plot_frontier

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
        (lambda: solve(PROBLEM, "lp", 1e-9), r"takes \(problem, method\) by place; .*tolerance="),
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
        (lambda: SOLUTION.policy.start(0, 0), r"MixedPolicy.start takes \(seed\) by place"),
        (lambda: load_policy(), r"load_policy needs 'path', 'model'"),
        (lambda: MCMP(PROBLEM), "MCMP takes an SSP first"),
        (lambda: MCMP(SOLUTION, "depot"), "MCMP takes an SSP first"),
        (lambda: MCMP(model={"depot": ROUTES}, start="depot"), "model must be an SSP"),
        (lambda: MCMP(MODEL, 0.05, "depot"), "failure_budget must be a number"),
        (lambda: MCMP(MODEL, "depot", failure_budget=True), "must be a number or None, not True"),
        (lambda: MCMP(MODEL, {"depot": "all"}), "'depot' is no number"),
        (lambda: MCMP(MODEL, np.array([1.0])), "must be a state or"),
        (lambda: S3P(MODEL, "depot", 0.2, cost_cap="much"), "cost_cap must be a number"),
        (lambda: GUBS(MODEL, "depot", 3.0, 1.0), "utility must be a function"),
        (lambda: CostQuantile(MODEL, "depot", 95), r"did you mean 0\.95"),
        (lambda: CVaR(MODEL, "depot", 95), r"did you mean 0\.95"),
        (lambda: evaluate(SOLUTION), r"pass solution\.policy and its problem"),
        (lambda: evaluate(SOLUTION.policy), "takes a problem"),
        (lambda: evaluate(PROBLEM, SOLUTION.policy), "takes a problem"),
        (lambda: certify(PROBLEM), r"takes a solution, such as solve\(problem\)"),
        (lambda: save_solution(SOLUTION.policy, "nowhere"), "takes a solution"),
        (lambda: save_policy(SOLUTION, "nowhere"), "cannot be saved"),
        (lambda: load_policy("nowhere", PROBLEM), r"it has one: \.model"),
        (lambda: save_model(PROBLEM, "nowhere"), r"it has one: \.model"),
        (lambda: on_original(SOLUTION), r"pass solution\.policy"),
        (lambda: MixedPolicy((SOLUTION,), [1.0]), r"pass solution\.policy"),
        (lambda: TimedPolicy((SOLUTION,)), r"pass solution\.policy"),
        (lambda: DeterministicPolicy.from_actions(PROBLEM, {}), r"takes an SSP.*\.model"),
        (lambda: StochasticPolicy.from_actions({}, MODEL), "takes an SSP"),
        (lambda: product(Memory(0, lambda *step: 0), MODEL), "product takes an SSP"),
        (lambda: product(MODEL, {"key": False}), "takes a Memory after the model"),
        (lambda: within_steps(3, MODEL), "within_steps takes an SSP"),
        (lambda: within_steps(MODEL, 3, start="depot"), "start must be a set of states"),
        (lambda: SSP.from_transitions([1], goal={"home"}), "a model is told as"),
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
        (lambda: ColumnGeneration(1, 2), r"takes \(pricing\) by place"),
        (lambda: DeterministicPolicies(relaxation="game"), "relaxation must be 'columns' or 'lp'"),
        (lambda: MCMP(MODEL, "depot", [0.1, 0.2]), r"sweep\(criterion, ...\) states a problem for"),
        (lambda: MaxProb(MODEL, "depot", give_up="deadends"), "'attention', 'dead_ends'"),
        (lambda: TRIPS.start("depo"), "start: 'depo' is not a state.*did you mean 'depot'"),
        (lambda: MCMP(TRIPS, "depot"), r"start\('depot'\) is where it begins"),
        (lambda: SSP.from_frame([{"state": "a"}], {"b"}), "the table is a list: give its columns"),
        (lambda: SSP.from_transitions({"depot": ROUTES}, {"home"}, dead_ends={"wrek"}), "'wreck'"),
        (lambda: plot_frontier(SOLUTION), r"trace_frontier\(problem\) makes one"),
        (lambda: explore(SOLUTION, "page.html"), r"trace_frontier\(problem\) makes one"),
        (
            lambda: explore(trace_frontier(PROBLEM), "page.png"),
            r"written as \.html, not 'page.png'",
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
    told = "observed in the environment, of which the policy's model may not be: 36"
    refused(told, rollout, other, policy, episodes=1, seed=0)
