"""What a new user stumbles over is answered with its name and a remedy."""

import gzip

import numpy as np
import pytest

from formulations import MCMP, MinCost, compare_criteria
from formulations.command_line import main
from refusing import refused
from small_models import ROUTES
from ssp_lp import SSP, Axis, Grid, check_certificate, evaluate, simulate, solve, write_certificate
from ssp_lp.compiled import accelerator
from ssp_lp.compiled.deadline import Stop, until
from ssp_lp.io import fingerprint, from_gymnasium, load_policy, read_any, rollout, save_policy
from ssp_lp.methods.labelled_program import program_of

MODEL = SSP.from_transitions({"depot": ROUTES}, goal={"home"}, dead_ends={"wreck"})
PROBLEM = MCMP(MODEL, "depot", failure_budget=0.05)
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
        (CSV.replace("9/10", "most"), "row 2: 'most' in the column 'probability' is no number"),
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
        told = refused("no ssp-lp policy file.* save_policy", load_policy, path, MODEL)
        assert "pickle" not in told
        assert (
            "no certificate: ssp_lp.write_certificate writes one" in check_certificate(path).reason
        )
        assert main(["check", str(path)]) == 1
        assert "no certificate" in capsys.readouterr().err
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
    compared = compare_criteria(MODEL, "depot")
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
    refused("must be 'numba' or 'none', not 'nubma'", solve, PROBLEM)


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
    program = program_of(PROBLEM).to_cvxpy()
    assert repr(program).startswith("ConvexProgram in cvxpy: ")
    assert "failure" in repr(program)
    program.constraints["few"] = program.x <= 5.0
    assert "few: x <= 5.0" in repr(program)
    assert not [name for name in dir(MODEL) if name.startswith("_")]
    assert {"from_csv", "states", "with_dead_ends"} <= set(dir(MODEL))


def test_solutions_and_problems_in_the_place_of_others_are_named(tmp_path):
    solution = solve(PROBLEM)
    refused("solution must be a Solution, not MCMP", write_certificate, PROBLEM, tmp_path / "c")
    refused(r"it has one that can be: \.policy", save_policy, solution, tmp_path / "p")
    other = SSP.from_transitions({"a": {"go": [(1.0, "b", 1.0)]}}, goal={"b"})
    refused("pass a problem on policy.model", evaluate, solution.policy, MinCost(other, "a"))
