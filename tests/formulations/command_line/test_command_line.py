"""The command line: what it prints, and how it ends."""

from __future__ import annotations

import json
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import formulations
from cases import FOLDER
from formulations import MCMP, S3P
from formulations.command_line import main
from formulations.command_line.arguments import CRITERIA
from small_models import model_of
from ssp_lp import ModelError, evaluate, solve
from ssp_lp.io import Controller, load_policy, save_model, write_drn, write_prism
from ssp_lp.io.any_format import read_any

ROADS = {
    "depot": {
        "alley": [[0.90, "home", 4.0], [0.10, "wreck", 2.0]],
        "road": [[0.99, "home", 9.0], [0.01, "wreck", 5.0]],
    },
    "wreck": {},
    "ferry": {"wait": [[1, "ferry", 1]], "sail": [[1, "home", 2]]},
}


@pytest.fixture
def roads(tmp_path: Path) -> Path:
    return written(tmp_path, ROADS)


def written(folder: Path, table: Any) -> Path:
    path = folder / "roads.json"
    path.write_text(table if isinstance(table, str) else json.dumps(table), encoding="utf-8")
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(one) for one in arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_info_counts(roads: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("info", roads, "--goal", "home")
    code, out, _ = run(capsys, *asked, "--start", "depot", "--json")
    assert code == 0
    assert json.loads(out) == {
        "states": 4,
        "pairs": 4,
        "outcomes": 6,
        "goals": 1,
        "dead-ends": 1,
        "attention states": 2,
        "actions": ["alley", "road", "wait", "sail"],
        "costs": ["cost"],
        "labels": {},
        "least failure": pytest.approx(0.01),
    }
    code, out, _ = run(capsys, *asked)
    assert code == 0
    assert "dead-ends         1" in out
    assert "least failure" not in out


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_solve_says_what_the_library_says(
    roads: Path, capsys: pytest.CaptureFixture[str], criterion: Any
) -> None:
    own = solve(criterion(read_any(roads, ["home"]).model, "depot", 0.05))
    asked = ["solve", roads, "--goal", "home", "--start", "depot", "--failure-budget", 0.05]
    asked += ["--criterion", criterion.__name__.lower()]
    code, out, _ = run(capsys, *asked)
    assert code == 0
    assert out.splitlines()[:2] == own.summary().splitlines()[:2]
    code, out, _ = run(capsys, *asked, "--json")
    told = json.loads(out)
    assert code == 0
    assert told["objective"] == pytest.approx(own.objective)
    assert told["failure_probability"] == pytest.approx(0.05)
    assert sum(member["weight"] for member in told["policy"]) == pytest.approx(1.0)
    if criterion is MCMP:
        assert {member["actions"]["depot"] for member in told["policy"]} == {"alley", "road"}


def test_what_is_told_on_the_way_is_no_answer(
    roads: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("solve", roads, "--goal", "home", "--start", "depot", "--json", "--verbose")
    code, out, err = run(capsys, *asked)
    assert (code, json.loads(out)["failure_probability"]) == (0, pytest.approx(0.01))
    assert err


def test_numbers_that_are_none_are_null(roads: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("solve", roads, "--goal", "home", "--start", "wreck", "--criterion", "maxprob")
    code, out, _ = run(capsys, *asked, "--json")
    assert code == 0
    assert json.loads(out)["conditional_cost"] is None
    assert "NaN" not in out


def test_too_small_a_budget_ends_with_3(roads: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("solve", roads, "--goal", "home", "--start", "depot", "--failure-budget", 0.001)
    code, out, err = run(capsys, *asked)
    assert (code, out) == (3, "")
    assert "0.01" in err


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        (["--start", "deopt"], "did you mean 'depot'"),
        (["--start", "depot", "--failure-budget", "5"], "did you mean 0.05"),
        (["--start", "depot", "--criterion", "maxprob", "--failure-budget", ".1"], "takes no"),
        ([], "--start"),
    ],
)
def test_wrong_arguments_end_with_2(
    roads: Path, capsys: pytest.CaptureFixture[str], changed: list[str], complaint: str
) -> None:
    code, _, err = run(capsys, "solve", roads, "--goal", "home", *changed)
    assert code == 2
    assert complaint in err


def test_what_the_parser_refuses_ends_with_2(roads: Path) -> None:
    assert main(["solve", str(roads)]) == 2  # which states are goals is not said
    for wrong in (["fly"], [], ["solve", str(roads), "--criterion", "x"]):
        with pytest.raises(SystemExit) as caught:
            main(wrong)
        assert caught.value.code == 2


def test_wrong_models_end_with_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "info", written(tmp_path, "{"), "--goal", "home")
    assert code == 2
    assert "is no JSON" in err


def test_files_that_are_not_there_or_not_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, "info", tmp_path / "none.json", "--goal", "g")[0] == 2
    with pytest.raises(ModelError, match=r"ends in none of \.json"):
        read_any(tmp_path / "roads.txt", ["g"])


def test_numbers_may_name_states(tmp_path: Path) -> None:
    model = read_any(written(tmp_path, {"0": {"go": [[1, 1, 2.5]]}}), ["1"]).model
    assert list(model.states) == ["0", "1"]


def test_the_entry_point_is_there() -> None:
    project = Path(__file__).parents[3] / "pyproject.toml"
    entry = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["scripts"]["ssp-lp"]
    module, _, name = entry.partition(":")
    assert getattr(import_module(module), name) is main


def test_other_formats_and_the_policy_in_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = model_of(
        {0: {"a": [(0.9, 1, 1.0), (0.1, 2, 1.0)], "b": [(1.0, 1, 3.0)]}, 1: {}, 2: {}}, 1
    )
    write_drn(model, tmp_path / "m.drn", start=0)
    write_prism(model, tmp_path / "m", start=0)
    save_model(model, tmp_path / "m.npz")
    drn, prism, own = (str(tmp_path / f"m.{ending}") for ending in ("drn", "tra", "npz"))
    for arguments in (
        [drn, "--goal", "goal"],
        [prism, "--goal", "goal"],
        [own, "--start", "0"],
    ):
        assert main(["info", *arguments]) == 0
        assert "attention states" in capsys.readouterr().out
    policy = tmp_path / "policy.npz"
    chosen = ["solve", drn, "--goal", "goal", "--failure-budget", "0.05", "--json"]
    assert main([*chosen, "--policy-out", str(policy)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["objective"] == pytest.approx(0.5 * 1.0 + 0.5 * 3.0)
    assert policy.exists()
    assert main(["info", own, "--goal", "1"]) == 2


ASKED = {
    "alpha-mcmp": {"reach_fraction": 0.95},
    "cost-bounded-reach": {"cost_bound": 5.0},
    "cost-budgeted-maxprob": {"cost_budget": 6.0},
    "cost-quantile": {"level": 0.5, "failure_budget": 0.09},
    "cvar": {"level": 0.9, "failure_budget": 0.05},
    "egubs": {"risk_factor": -0.1, "goal_bonus": 1.0},
    "finite-penalty": {"penalty": 10.0},
    "isspude": {},
    "maxprob": {},
    "mcmp": {"failure_budget": 0.05, "give_up": "dead_ends", "charge_failing_step": False},
    "minprob": {},
    "s3p": {"failure_budget": 0.05, "cost_cap": 30.0},
}


@pytest.mark.parametrize("criterion", sorted(set(CRITERIA) - {"min-cost", "least-quantity"}))
def test_every_criterion_with_what_it_takes(
    roads: Path, capsys: pytest.CaptureFixture[str], criterion: str
) -> None:
    taken = ASKED[criterion]
    own = solve(
        getattr(formulations, CRITERIA[criterion])(
            read_any(roads, ["home"]).model, "depot", **taken
        )
    )
    words = [f"--{name.replace('_', '-')}={value}" for name, value in taken.items()]
    words = [word.replace("--charge-failing-step=False", "--no-charge-failing-step")
             for word in words]  # fmt: skip
    asked = ("solve", roads, "--goal", "home", "--start", "depot", "--json")
    code, out, err = run(capsys, *asked, "--criterion", criterion, *words)
    assert (code, err) == (0, "")
    assert json.loads(out)["objective"] == pytest.approx(own.objective, rel=1e-12)


def test_where_failing_is_forbidden_and_cannot_be_avoided(
    roads: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("solve", roads, "--goal", "home", "--criterion", "min-cost", "--start")
    assert run(capsys, *asked, "depot")[0] == 3
    assert run(capsys, *asked, "ferry")[0] == 0


FUEL = {
    "goal": ["home"],
    "start": "depot",
    "labels": {"crash": ["wreck"]},
    "transitions": {
        "depot": {
            "alley": [
                [0.90, "home", {"cost": 4.0, "fuel": 2.0}],
                [0.10, "wreck", {"cost": 2.0, "fuel": 2.0}],
            ],
            "road": [
                [0.99, "home", {"cost": 9.0, "fuel": 1.0}],
                [0.01, "wreck", {"cost": 5.0, "fuel": 1.0}],
            ],
        },
        "wreck": {},
    },
}


def test_limits_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The README's limits, and sums of quantities, which are weighed by hand."""
    asked = ("solve", written(tmp_path, FUEL), "--cost", "cost", "--json")
    code, out, _ = run(capsys, *asked, "--criterion", "s3p", "--failure-budget", 0.05, "--limit",
                       "fuel <= 1.3")  # fmt: skip
    told = json.loads(out)
    assert (code, told["objective"]) == (0, pytest.approx(7.598130841))
    assert told["limits"]["fuel"]["price"] == pytest.approx(4.626168224)
    for words, weight in (
        ("visits(crash) <= 0.028", 0.2),  # of the alley: 0.01 + 0.09 w
        ("end(crash) <= 0.028", 0.2),
        ("goal >= 0.972", 0.2),
        ("failure<=0.028", 0.2),
        ("2 * fuel + 10 * visits(wreck) <= 2.68", 0.2),  # 2 (1 + w) + 0.1 + 0.9 w
    ):
        code, out, _ = run(capsys, *asked, "--failure-budget", 0.05, "--limit", words)
        assert code == 0
        assert json.loads(out)["objective"] == pytest.approx(3.8 * weight + 8.96 * (1 - weight))
    least = ("--criterion", "least-quantity", "--quantity", "fuel", "--limit")
    code, out, _ = run(capsys, *asked, *least, "cost <= 6")
    share = (8.96 - 6) / (8.96 - 3.8)
    assert (code, json.loads(out)["objective"]) == (0, pytest.approx(1 + share))
    assert run(capsys, *asked, *least, "cost <= 6", "--limit", "cost >= 9")[0] == 2


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--limit", "fuel"], "a limit is a quantity"),
        (["--limit", "oil <= 3"], "choose one of the costs"),
        (["--limit", "fuel <= x"], '"x" in "fuel <= x" is no number'),
        (["--limit", "x * fuel <= 3"], "is no number"),
        (["--limit", "visits(home <= 3"], "is no sum of quantities"),
        (["--limit", "visits(depto) <= 3"], "depto"),
        (["--penalty", "3"], "mcmp takes no --penalty; its options: --failure-budget"),
        (["--criterion", "cvar"], "cvar needs --level"),
        (["--policy-out", "policy.txt"], "a policy is written as .storm.json"),
        (["--horizon", "0"], "--horizon must be a whole number >= 1, not 0"),
        (["--failure-budget", "5"], "--failure-budget must be a probability, not 5.0;"),
        (["--discount", ".9"], "--failure-budget none (least failure) is exact only: leave --disc"),
        (["--criterion", "least-quantity"], "least-quantity needs --quantity"),
        (
            ["--method", "game", "--failure-budget", "0.1"],
            "give --discount 0.999, or solve the exact problem with --method columns",
        ),
        (
            ["--failure-budget", "0.1", "--reach-fraction", "0.9"],
            "give --failure-budget or --reach-fraction, not both",
        ),
        (
            ["--criterion", "cost-bounded-reach", "--cost-bound=-1/2"],
            "--cost-bound must be a cost, not -1/2",
        ),
    ],
)
def test_what_is_asked_wrongly_ends_with_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], complaint: str
) -> None:
    code, out, err = run(capsys, "solve", written(tmp_path, FUEL), "--cost", "cost", *words)
    assert (code, out) == (2, "")
    assert complaint in err


def test_models_go_round_through_every_format(
    roads: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(roads.parent)
    way = ["roads.json", "a.npz", "b.json.gz", "c.drn", "d.tra", "e.drn.gz", "f.json"]
    goals = {"roads.json": ["home"], "c.drn": ["goal"], "d.tra": ["goal"], "e.drn.gz": ["goal"]}
    starts = {"roads.json": ["depot"], "a.npz": ["depot"]}
    values = []
    for source, target in zip(way, [*way[1:], "-"], strict=True):
        told = [f"--goal={goal}" for goal in goals.get(source, [])]
        told += [f"--start={state}" for state in starts.get(source, [])]
        code, out, err = run(capsys, "solve", source, *told, "--failure-budget=.05", "--json")
        assert (code, err) == (0, "")
        values.append(json.loads(out)["objective"])
        assert run(capsys, "convert", source, target, *told)[0] == 0
    assert values == [pytest.approx(values[0], rel=1e-12)] * len(way)
    assert run(capsys, "convert", "f.json", "g.txt")[0] == 2


def test_within_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lock = {"lock": {"try": [[0.5, "open", 1], [0.5, "lock", 1]]}}
    asked = ("info", written(tmp_path, lock), "--goal", "open", "--horizon", 3, "--json")
    code, out, _ = run(capsys, *asked, "--start", "lock")
    assert (code, json.loads(out)["least failure"]) == (0, pytest.approx(0.125))
    assert run(capsys, *asked)[0] == 2


def test_a_horizon_is_that_of_the_criterion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Answers and policies are those of ``horizon=``: on the model's states, steps counted."""
    lock = {"lock": {"try": [[0.5, "open", 1], [0.5, "lock", 1]]}}
    words = ("--goal", "open", "--start", "lock", "--horizon", 3)
    model, policy = str(written(tmp_path, lock)), tmp_path / "policy.npz"
    asked = ("solve", model, *words, "--failure-budget", 0.2)
    code, out, _ = run(capsys, *asked, "--policy-out", policy)
    assert (code, "out of time 0.125" in out, "within 3 steps" in out) == (0, True, True)
    assert json.loads(run(capsys, *asked, "--json")[1])["ends"]["out of time"] == 0.125
    stated = MCMP(read_any(model, ["open"]).model, "lock", 0.2, horizon=3)
    loaded = load_policy(policy, stated.unrolled.model)
    assert evaluate(loaded, stated).failure_probability == pytest.approx(0.125)
    told = json.loads(run(capsys, "simulate", model, *words, "--policy", policy, "--json")[1])
    assert told["failure_probability"]["low"] < 0.125 < told["failure_probability"]["high"]
    runner = tmp_path / "runner.json"
    assert run(capsys, *asked, "--policy-out", runner)[0] == 0
    player = Controller(runner)
    player.reset()
    for _ in range(3):
        assert player.action("lock") == "try"
        player.observe("lock", 1.0)
    assert player.action("lock") == "give up"
    assert run(capsys, *asked, "--policy-out", runner, "--everywhere")[0] == 0
    player = Controller(runner)
    player.reset()
    for step in range(6):  # there is nothing else to do
        assert player.action("lock") == "try"
        assert player.failed == (step >= 3)
        player.observe("lock", 1.0)
    rows = json.loads(run(capsys, "compare", model, *words, "--json")[1])
    assert rows[0] == {**rows[0], "criterion": "MaxProb", "objective": pytest.approx(0.875)}


def test_the_frontier_in_three_forms(roads: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("frontier", roads, "--goal", "home", "--start", "depot")
    told = json.loads(run(capsys, *asked, "--json")[1])
    assert [p["failure"] for p in told["points"]] == pytest.approx([0.01, 0.1])
    assert [p["objective"] for p in told["points"]] == pytest.approx([8.96, 3.8])
    assert told["points"][0]["price"] == pytest.approx((8.96 - 3.8) / 0.09)
    head, first, *_ = run(capsys, *asked, "--csv")[1].splitlines()
    assert head.split(",") == ["failure", "goal", "cost", "objective", "price"]
    assert [float(x) for x in first.split(",")] == list(told["points"][0].values())
    assert "0.01" in run(capsys, *asked)[1]


def test_a_frontier_that_was_cut_short_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("frontier", FOLDER / "models" / "prism_attacktree.json.gz", "--cost", "cost")
    short, whole = (run(capsys, *asked, *more) for more in (("--point-limit", 2), ()))
    assert (short[0], whole[0]) == (0, 0)
    assert "misses the tolerance" in short[1].splitlines()[-1]
    assert whole[1].splitlines()[-1] == "gap 1.0e-09"


def test_pictures(roads: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    asked = (roads, "--goal", "home", "--start", "depot", "--failure-budget", 0.05, "--plot")
    for command, ending in (("solve", "png"), ("frontier", "svg")):
        assert run(capsys, command, *asked, tmp_path / f"{command}.{ending}")[0] == 0
        assert (tmp_path / f"{command}.{ending}").stat().st_size > 5000
    code, out, err = run(capsys, "solve", *asked, tmp_path / "law.txt")
    assert (code, out) == (2, "")
    assert "a picture is written as" in err


def test_a_saved_policy_is_simulated(
    roads: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = (str(roads), "--goal", "home", "--start", "depot")
    for ending in ("npz", "json", "dot", "csv"):
        out = tmp_path / f"policy.{ending}"
        assert run(capsys, "solve", *model, "--failure-budget", 0.05, "--policy-out", out)[0] == 0
        assert out.stat().st_size > 0
    asked = ("simulate", *model, "--policy", tmp_path / "policy.npz", "--confidence", 0.9999)
    told = json.loads(run(capsys, *asked, "--episodes", 2000, "--json")[1])
    assert told["failure_probability"]["low"] < 0.05 < told["failure_probability"]["high"]
    assert told["ends"]["goal"] + told["ends"]["dead_end"] == told["episodes"] == 2000
    assert run(capsys, *asked, "--episodes", 0)[0] == 2
    dearer = tmp_path / "dearer.json"
    dearer.write_text(roads.read_text().replace("9.0", "9.5"))
    asked = ("simulate", dearer, *model[1:], "--policy", tmp_path / "policy.npz")
    code, _, err = run(capsys, *asked)
    assert (code, "or give --no-check if it differs" in err) == (2, True)
    assert run(capsys, *asked, "--no-check")[0] == 0
    other = written(tmp_path, {"depot": {"go": [[1, "home", 1]]}})
    code, _, err = run(capsys, "simulate", other, *model[1:], "--policy", tmp_path / "policy.npz")
    assert code == 2
    assert "has other pairs" in err


def test_the_program_is_written(
    roads: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("program", roads, "--goal", "home", "--start", "depot", "--failure-budget", 0.05)
    code, out, _ = run(capsys, *asked, "--out", tmp_path / "roads.lp")
    assert code == 0
    assert "failure: <failure, x> <= 0.05" in out
    assert "failure" in (tmp_path / "roads.lp").read_text(encoding="utf-8")
    assert run(capsys, *asked, "--out", tmp_path / "roads.txt")[0] == 2


def test_criteria_side_by_side(roads: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("compare", roads, "--goal", "home", "--start", "depot", "--failure-budget", 0.05)
    rows = json.loads(run(capsys, *asked, "--json", "--cost-bound", 4, "--level", 0.9)[1])
    found = {row["criterion"]: row["objective"] for row in rows}
    assert found["MCMP, failure budget 0.05"] == pytest.approx(20 / 3)
    assert found["CostBoundedReach, cost 4"] == pytest.approx(0.9)
    assert found["MinCost"] is None


def test_a_program_through_storm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("stormpy")
    program = """mdp
const int N;
module walker
    x : [0..N] init 0;
    broken : bool init false;
    [run] x < N & !broken -> 0.9 : (x' = x + 1) + 0.1 : (broken' = true);
    [walk] x < N & !broken -> (x' = x + 1);
endmodule
rewards "time"
    [run] true : 1;
    [walk] true : 3;
endrewards
rewards "fuel"
    [run] true : 2;
    [walk] true : 1;
endrewards
label "done" = x = N;
"""
    (tmp_path / "walker.prism").write_text(program, encoding="utf-8")
    asked = ("solve", tmp_path / "walker.prism", "--goal", "done", "--cost", "time", "--json")
    scheduler = tmp_path / "walker.storm.json"
    code, out, err = run(capsys, *asked, "--constants", "N=1", "--failure-budget", 0.1,
                         "--limit", "fuel <= 1.5", "--policy-out", scheduler)  # fmt: skip
    assert (code, err) == (0, "")
    assert json.loads(out)["objective"] == pytest.approx(0.5 * 1 + 0.5 * 3)
    assert {choice["labels"][0] for choice in json.loads(scheduler.read_text())[0]["c"]} == {
        "run",
        "walk",
    }
    assert run(capsys, *asked)[0] == 2


def test_environments(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gymnasium")
    lake = "gym:FrozenLake-v1,is_slippery=false"
    facts = json.loads(run(capsys, "info", lake, "--horizon", "none", "--json")[1])
    assert (facts["states"], facts["least failure"]) == (16, 0.0)
    corner = ("info", lake, "--goal", "12", "--start", "4", "--json", "--horizon")
    assert json.loads(run(capsys, *corner, "2")[1])["least failure"] == 0.0
    assert run(capsys, *corner, "1")[0] == 2
    for wrong in ("gym:NoSuchLake-v1", "gym:FrozenLake-v1,depth=3", "gym:CartPole-v1"):
        code, _, err = run(capsys, "info", wrong)
        assert (code, err.count("ssp-lp: ")) == (2, 1)
