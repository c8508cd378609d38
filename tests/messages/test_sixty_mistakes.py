"""Mistakes of every kind that a user of each part makes are named, with what to do instead."""

import pytest

from formulations import MCMP, CostQuantile, MaxProb
from formulations.command_line import main
from refusing import refused
from ssp_lp import (
    SSP,
    ColumnGeneration,
    CostLimit,
    DeterministicPolicies,
    LinearProgramming,
    Memory,
    product,
    simulate,
    solve,
    trace_frontier,
    write_certificate,
)
from ssp_lp.io import from_gymnasium, read_any, rollout
from ssp_lp.plotting import explore, plot_cost_law, plot_frontier

ROUTES = {
    "alley": [(0.90, "home", 4.0), (0.10, "wreck", 2.0)],
    "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
}
MODEL = SSP.from_transitions({"depot": ROUTES}, goal={"home"}, dead_ends={"wreck"})
PROBLEM = MCMP(MODEL, "depot", failure_budget=0.05)
SOLUTION = solve(PROBLEM)
TRIPS = product(MODEL, Memory(0, lambda memory, *step: memory))


@pytest.mark.parametrize(
    ("mistake", "told"),
    [
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
    refused(told, mistake)


def test_a_relaxation_may_be_named():
    assert DeterministicPolicies("lp") == DeterministicPolicies(LinearProgramming())
    assert solve(PROBLEM, DeterministicPolicies("lp")).objective == pytest.approx(8.96)


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


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("explore {} --out page.png", "a page is written as .html"),
        ("solve {} --criterion least-quantity --quantity fuel", "'fuel' is no quantity of this"),
        ("solve {} --failure_budget 0.1", "did you mean --failure-budget?"),
        ("solve {} --dead-ends wrek", "did you mean 'wreck'?"),
        ("program {} --criterion cvar", "choose from alpha-mcmp"),
    ],
)
def test_a_mistake_in_a_shell_is_named(words, told, tmp_path, capsys):
    path = tmp_path / "roads.json"
    path.write_text('{"depot": {"alley": [[0.9, "home", 4], [0.1, "wreck", 2]]}}')
    try:
        code = main(words.format(f"{path} --goal home --start depot").split())
    except SystemExit as ended:
        code = ended.code
    printed = capsys.readouterr()
    assert (code, printed.out) == (2, "")
    assert told in printed.err
    assert printed.err.count("\n") == 1
