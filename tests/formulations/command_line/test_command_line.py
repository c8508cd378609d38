"""The command line: what it prints, and how it ends; names and numbers as people write them."""

from __future__ import annotations

import csv
import io
import json
import logging
import shlex
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import formulations
from cases import FOLDER
from formulations import MCMP
from formulations.command_line import main
from formulations.command_line.arguments import CRITERIA, argument_parser
from small_models import model_of
from ssp_lp import ModelError, evaluate, solve
from ssp_lp.io import Controller, load_policy, save_model, write_drn, write_umb
from ssp_lp.io.any_format import read_any
from ssp_lp.options import progress_shown

ROADS = {
    "depot": {
        "alley": [[0.90, "home", 4.0], [0.10, "wreck", 2.0]],
        "road": [[0.99, "home", 9.0], [0.01, "wreck", 5.0]],
    },
    "wreck": {},
    "ferry": {"wait": [[1, "ferry", 1]], "sail": [[1, "home", 2]]},
}
LOCK = {"lock": {"try": [[0.5, "open", 1], [0.5, "lock", 1]]}}
FROM_DEPOT = ("--goal", "home", "--start", "depot")
WITHIN = (*FROM_DEPOT, "--failure-budget", 0.05)

Run = Callable[..., tuple[int, str, str]]
Told = Callable[..., Any]


@pytest.fixture
def roads(tmp_path: Path) -> Path:
    return written(tmp_path, ROADS)


def written(folder: Path, table: Any) -> Path:
    path = folder / "roads.json"
    path.write_text(table if isinstance(table, str) else json.dumps(table), encoding="utf-8")
    return path


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Exit code, what is printed, and what is said of errors."""

    def call(*arguments: object) -> tuple[int, str, str]:
        code = main([str(one) for one in arguments])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return call


@pytest.fixture
def told(run: Run) -> Told:
    """An answer as JSON, beside which nothing is said."""

    def call(*arguments: object) -> Any:
        code, out, err = run(*arguments, "--json")
        assert (code, err, "NaN" in out) == (0, "", False)
        return json.loads(out)

    return call


@pytest.fixture
def refused(run: Run) -> Callable[..., None]:
    """What ends with 2, nothing printed, and a complaint in one line."""

    def call(*arguments: object, complaint: str = "ssp-lp: ") -> None:
        code, out, err = run(*arguments)
        assert (code, out) == (2, "")
        assert complaint in err

    return call


def test_info_counts(roads: Path, run: Run, told: Told) -> None:
    assert told("info", roads, *FROM_DEPOT) == {
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
    code, out, _ = run("info", roads, "--goal", "home")
    assert (code, "dead-ends         1" in out, "least failure" in out) == (0, True, False)


@pytest.mark.parametrize("criterion", ["MCMP", "S3P"])
def test_solve_says_what_the_library_says(
    roads: Path, run: Run, told: Told, criterion: str
) -> None:
    model = read_any(roads, ["home"]).model
    own = solve(getattr(formulations, criterion)(model, "depot", 0.05))
    asked = ["solve", roads, *WITHIN, "--criterion", criterion.lower()]
    code, out, _ = run(*asked)
    assert (code, out.splitlines()[:2]) == (0, own.summary().splitlines()[:2])
    assert "give_up='dead_ends'" not in out
    assert ("--give-up dead_ends" in out) == ("give_up='dead_ends'" in own.summary())
    answer = told(*asked)
    assert answer["objective"] == pytest.approx(own.objective)
    assert answer["failure_probability"] == pytest.approx(0.05)
    assert sum(member["weight"] for member in answer["policy"]) == pytest.approx(1.0)
    if criterion == "MCMP":
        assert {member["actions"]["depot"] for member in answer["policy"]} == {"alley", "road"}
    assert told("solve", roads, "--goal=home", "--start=wreck", "--criterion=maxprob")[
        "conditional_cost"
    ] is None  # fmt: skip
    code, out, err = run("solve", roads, *FROM_DEPOT, "--json", "--verbose")
    assert (code, json.loads(out)["failure_probability"]) == (0, pytest.approx(0.01))
    assert err  # what is told on the way is no answer


def test_what_cannot_be_ends_with_3(roads: Path, run: Run) -> None:
    code, out, err = run("solve", roads, *FROM_DEPOT, "--failure-budget", 0.001)
    assert (code, out, "0.01" in err) == (3, "", True)
    plain = ("solve", roads, "--goal", "home", "--criterion", "min-cost", "--start")
    assert (run(*plain, "depot")[0], run(*plain, "ferry")[0]) == (3, 0)


def test_files_and_parsers_that_refuse(tmp_path: Path, roads: Path, refused: Any) -> None:
    refused("solve", roads)  # which states are goals is not said
    refused("info", tmp_path / "none.json", "--goal", "g")
    with pytest.raises(ModelError, match=r"must end in one of \.json"):
        read_any(tmp_path / "roads.txt", ["g"])
    refused("info", written(tmp_path, "{"), "--goal", "home", complaint="is not JSON")
    numbers = read_any(written(tmp_path, {"0": {"go": [[1, 1, 2.5]]}}), ["1"]).model
    assert list(numbers.states) == ["0", "1"]


def test_the_entry_point_is_there() -> None:
    project = Path(__file__).parents[3] / "pyproject.toml"
    entry = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["scripts"]["ssp-lp"]
    module, _, name = entry.partition(":")
    assert getattr(import_module(module), name) is main


def test_other_formats_and_the_policy_in_a_file(
    tmp_path: Path, run: Run, told: Told, refused: Any
) -> None:
    ways = {"a": [(0.9, 1, 1.0), (0.1, 2, 1.0)], "b": [(1.0, 1, 3.0)]}
    model = model_of({0: ways, 1: {}, 2: {}}, 1)
    write_drn(model, tmp_path / "m.drn", start=0)
    write_umb(model, tmp_path / "m.umb", start=0)
    save_model(model, tmp_path / "m.npz")
    drn, umb, own = (tmp_path / f"m.{ending}" for ending in ("drn", "umb", "npz"))
    for asked in ((drn, "--goal", "goal"), (umb, "--goal", "goal"), (own, "--start", "0")):
        code, out, _ = run("info", *asked)
        assert (code, "attention states" in out) == (0, True)
    policy = tmp_path / "policy.npz"
    chosen = ("solve", drn, "--goal", "goal", "--failure-budget", "0.05", "--policy-out", policy)
    assert told(*chosen)["objective"] == pytest.approx(0.5 * 1.0 + 0.5 * 3.0)
    assert policy.exists()
    refused("info", own, "--goal", "1")


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
def test_every_criterion_with_what_it_takes(roads: Path, told: Told, criterion: str) -> None:
    taken, named = ASKED[criterion], getattr(formulations, CRITERIA[criterion])
    own = solve(named(read_any(roads, ["home"]).model, "depot", **taken))
    words = [f"--{name.replace('_', '-')}={value}" for name, value in taken.items()]
    words = ["--no-charge-failing-step" if "failing-step" in word else word for word in words]
    answer = told("solve", roads, *FROM_DEPOT, "--criterion", criterion, *words)
    assert answer["objective"] == pytest.approx(own.objective, rel=1e-12)


def spending(chance: float, cost: float, lost: float, fuel: float) -> list:
    return [[chance, "home", {"cost": cost, "fuel": fuel}],
            [1.0 - chance, "wreck", {"cost": lost, "fuel": fuel}]]  # fmt: skip


FUEL = {
    "goal": ["home"],
    "start": "depot",
    "labels": {"crash": ["wreck"]},
    "transitions": {
        "depot": {"alley": spending(0.90, 4.0, 2.0, 2.0), "road": spending(0.99, 9.0, 5.0, 1.0)},
        "wreck": {},
    },
}


def test_limits_in_words(tmp_path: Path, told: Told, refused: Any) -> None:
    """The README's limits, and sums of quantities, which are weighed by hand."""
    asked = ("solve", written(tmp_path, FUEL), "--cost", "cost")
    within = (*asked, "--failure-budget", 0.05, "--limit")
    answer = told(*within, "fuel <= 1.3", "--criterion", "s3p")
    assert answer["objective"] == pytest.approx(7.598130841)
    assert answer["limits"]["fuel"]["price"] == pytest.approx(4.626168224)
    for words in (
        "visits(crash) <= 0.028",  # with a share w of the alley 0.01 + 0.09 w: a fifth
        "end(crash) <= 0.028",
        "goal >= 0.972",
        "failure<=0.028",
        "2 * fuel + 10 * visits(wreck) <= 2.68",  # 2 (1 + w) + 0.1 + 0.9 w
    ):
        assert told(*within, words)["objective"] == pytest.approx(0.2 * 3.8 + 0.8 * 8.96)
    least = (*asked, "--criterion", "least-quantity", "--quantity", "fuel", "--limit", "cost <= 6")
    assert told(*least)["objective"] == pytest.approx(1 + (8.96 - 6) / (8.96 - 3.8))
    refused(*least, "--limit", "cost >= 9")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("--start deopt", "did you mean 'depot'"),
        ("--failure-budget 5", "--failure-budget must be a probability, not 5.0; did you mean 0.0"),
        ("--criterion maxprob --failure-budget .1", "has no"),
        ("--limit fuel", "a limit is written"),
        ("--limit oil<=3", "'oil' is not a quantity of this model; quantities are 'cost'"),
        ("--limit fuel<=x", '"x" in "fuel<=x" is not a number'),
        ("--limit x*fuel<=3", "is not a number"),
        ("--limit visits(home<=3", "is not a sum such as"),
        ("--limit visits(depto)<=3", "depto"),
        ("--penalty 3", "mcmp has no --penalty; its options: --failure-budget"),
        ("--criterion cvar", "cvar needs --level"),
        ("--policy-out policy.txt", "'policy.txt' must end in one of .npz, .json, .h, .csv"),
        ("--horizon 0", "--horizon must be a whole number >= 1, not 0"),
        ("--discount .9", "--failure-budget none (least failure) supports no discount: leave"),
        ("--criterion least-quantity", "least-quantity needs --quantity"),
        ("--method game --failure-budget 0.1",
         "give --discount 0.999, or solve the exact problem with --method columns"),
        ("--failure-budget 0.1 --reach-fraction 0.9",
         "give --failure-budget or --reach-fraction, not both"),
        ("--criterion cost-bounded-reach --cost-bound=-1/2",
         "--cost-bound must be a cost, not -1/2"),
    ],
)  # fmt: skip
def test_what_is_asked_wrongly_ends_with_2(
    tmp_path: Path, refused: Any, words: str, complaint: str
) -> None:
    asked = ("solve", written(tmp_path, FUEL), "--cost", "cost")
    refused(*asked, *words.split(), complaint=complaint)


def test_a_start_is_asked_for(roads: Path, refused: Any) -> None:
    refused("solve", roads, "--goal", "home", complaint="--start")


def test_models_go_round_through_every_format(
    roads: Path, run: Run, told: Told, refused: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(roads.parent)
    way = ["roads.json", "a.npz", "b.json.gz", "c.drn", "d.umb", "e.drn.gz", "f.json"]
    goals = {"roads.json": "home", "c.drn": "goal", "d.umb": "goal", "e.drn.gz": "goal"}
    starts = {"roads.json": "depot", "a.npz": "depot"}
    values = []
    for source, target in zip(way, [*way[1:], "-"], strict=True):
        named = [f"--goal={goals[source]}"] if source in goals else []
        named += [f"--start={starts[source]}"] if source in starts else []
        values.append(told("solve", source, *named, "--failure-budget=.05")["objective"])
        assert run("convert", source, target, *named)[0] == 0
    assert values == [pytest.approx(values[0], rel=1e-12)] * len(way)
    refused("convert", "f.json", "g.txt")


def test_a_horizon_is_that_of_the_criterion(
    tmp_path: Path, run: Run, told: Told, refused: Any
) -> None:
    """Answers and policies are those of ``horizon=``: on the model's states, steps counted."""
    model, policy, runner = (written(tmp_path, LOCK), tmp_path / "p.npz", tmp_path / "r.json")
    goal = ("--goal", "open", "--horizon", 3)
    words = (*goal, "--start", "lock")
    assert told("info", model, *words)["least failure"] == pytest.approx(0.125)
    refused("info", model, *goal)
    asked = ("solve", model, *words, "--failure-budget", 0.2)
    code, out, _ = run(*asked, "--policy-out", policy)
    assert (code, "out of time 0.125" in out, "within 3 steps" in out) == (0, True, True)
    assert told(*asked)["ends"]["out of time"] == 0.125
    stated = MCMP(read_any(model, ["open"]).model, "lock", 0.2, horizon=3)
    loaded = load_policy(policy, stated.unrolled.model)
    assert evaluate(loaded, stated).failure_probability == pytest.approx(0.125)
    played = told("simulate", model, *words, "--policy", policy)["failure_probability"]
    assert played["low"] < 0.125 < played["high"]
    assert run(*asked, "--policy-out", runner)[0] == 0
    player = Controller(runner)
    player.reset()
    for _ in range(3):
        assert player.action("lock") == "try"
        player.observe("lock", 1.0)
    assert player.action("lock") == "give up"
    assert run(*asked, "--policy-out", runner, "--everywhere")[0] == 0
    player = Controller(runner)
    player.reset()
    for step in range(6):  # there is nothing else to do
        assert (player.action("lock"), player.failed) == ("try", step >= 3)
        player.observe("lock", 1.0)


def test_the_frontier_in_three_forms(roads: Path, run: Run, told: Told) -> None:
    asked = ("frontier", roads, *FROM_DEPOT)
    points = told(*asked)["points"]
    assert [p["failure"] for p in points] == pytest.approx([0.01, 0.1])
    assert [p["objective"] for p in points] == pytest.approx([8.96, 3.8])
    assert points[0]["price"] == pytest.approx((8.96 - 3.8) / 0.09)
    head, first, *_ = run(*asked, "--csv")[1].splitlines()
    assert head.split(",") == ["failure", "goal", "cost", "objective", "price", "below"]
    assert [float(x) for x in first.split(",")] == list(points[0].values())
    assert "0.01" in run(*asked)[1]
    attack = ("frontier", FOLDER / "models" / "prism_attacktree.json.gz", "--cost", "cost")
    for more, last in ((("--point-limit", 2), "misses the tolerance"), ((), "gap 1.0e-09")):
        code, out, _ = run(*attack, *more)
        assert (code, last in out.splitlines()[0]) == (0, True)


def test_pictures(roads: Path, tmp_path: Path, run: Run, refused: Any) -> None:
    pytest.importorskip("matplotlib")
    for command, ending in (("solve", "png"), ("frontier", "svg")):
        picture = tmp_path / f"{command}.{ending}"
        assert run(command, roads, *WITHIN, "--plot", picture)[0] == 0
        assert picture.stat().st_size > 5000
    wrong = ("solve", roads, *WITHIN, "--plot", tmp_path / "law.txt")
    refused(*wrong, complaint="must end in one of")


def test_a_saved_policy_is_simulated(
    roads: Path, tmp_path: Path, run: Run, told: Told, refused: Any
) -> None:
    for ending in ("json", "csv", "npz"):
        policy = tmp_path / f"policy.{ending}"
        assert run("solve", roads, *WITHIN, "--policy-out", policy)[0] == 0
        assert policy.stat().st_size > 0
    played = (*FROM_DEPOT, "--policy", policy)
    asked = ("simulate", roads, *played, "--confidence", 0.9999)
    answer = told(*asked, "--episodes", 2000)
    assert answer["failure_probability"]["low"] < 0.05 < answer["failure_probability"]["high"]
    assert answer["ends"]["goal"] + answer["ends"]["dead_end"] == answer["episodes"] == 2000
    refused(*asked, "--episodes", 0)
    dearer = tmp_path / "dearer.json"
    dearer.write_text(roads.read_text().replace("9.0", "9.5"))
    refused("simulate", dearer, *played, complaint="or give --no-check if it differs")
    assert run("simulate", dearer, *played, "--no-check")[0] == 0
    other = written(tmp_path, {"depot": {"go": [[1, "home", 1]]}})
    refused("simulate", other, *played, complaint="whose pairs differ")


def test_the_program_is_written(roads: Path, tmp_path: Path, run: Run) -> None:
    asked = ("program", roads, *WITHIN, "--out")
    code, out, _ = run(*asked, tmp_path / "roads.lp")
    assert (code, "failure: <failure, x> <= 0.05" in out) == (0, True)
    assert "failure" in (tmp_path / "roads.lp").read_text(encoding="utf-8")
    assert run(*asked, tmp_path / "roads.txt")[0] == 2


WALKER = """mdp
const int N;
module walker
    x : [0..N] init 0;
    broken : bool init false;
    [run] x < N & !broken -> 0.9 : (x' = x + 1) + 0.1 : (broken' = true);
    [walk] x < N & !broken -> (x' = x + 1);
endmodule
rewards "time" [run] true : 1; [walk] true : 3; endrewards
rewards "fuel" [run] true : 2; [walk] true : 1; endrewards
label "done" = x = N;
"""


def test_a_program_through_storm(tmp_path: Path, told: Told, refused: Any) -> None:
    pytest.importorskip("stormpy")
    (tmp_path / "walker.prism").write_text(WALKER, encoding="utf-8")
    asked = ("solve", tmp_path / "walker.prism", "--goal", "done", "--cost", "time")
    words = ("--constants", "N=1", "--failure-budget", 0.1, "--limit", "fuel <= 1.5")
    answer = told(*asked, *words)
    assert answer["objective"] == pytest.approx(0.5 * 1 + 0.5 * 3)
    chosen = {action for each in answer["policy"] for action in each["actions"].values()}
    assert chosen == {"run", "walk"}
    refused(*asked)


def test_environments(run: Run, told: Told) -> None:
    pytest.importorskip("gymnasium")
    lake = "gym:FrozenLake-v1,is_slippery=false"
    facts = told("info", lake, "--horizon", "none")
    assert (facts["states"], facts["least failure"]) == (16, 0.0)
    corner = ("info", lake, "--goal", "12", "--start", "4", "--horizon")
    assert told(*corner, "2")["least failure"] == 0.0
    assert run(*corner, "1")[0] == 2
    for wrong in ("gym:NoSuchLake-v1", "gym:FrozenLake-v1,depth=3", "gym:CartPole-v1"):
        code, _, err = run("info", wrong)
        assert (code, err.count("ssp-lp: ")) == (2, 1)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_a_criterion_by_its_class_or_its_page(criterion: str) -> None:
    parser, joined = argument_parser(), criterion.replace("-", "")
    for name in (criterion, criterion.upper(), joined, criterion.replace("-", "_")):
        asked = parser.parse_args(["solve", "roads.json", *FROM_DEPOT, "--criterion", name])
        assert asked.criterion == criterion


def test_percentages(roads: Path, told: Told) -> None:
    asked = ("solve", roads, *FROM_DEPOT, "--criterion", "S3P", "--limit", "failure <= 9%")
    for budget, failure in (("5%", 0.05), ("20%", 0.09)):
        answer = told(*asked, "--failure-budget", budget)
        assert answer["failure_probability"] == pytest.approx(failure)


def test_several_budgets_make_a_table(roads: Path, run: Run, told: Told, refused: Any) -> None:
    asked = ("solve", roads, *FROM_DEPOT, "--failure-budget", "0.1%,2%,0.05,none")
    code, out, err = run(*asked)
    assert (code, err) == (0, "")
    assert [line.split()[1:3] for line in out.splitlines()[:5]] == [
        ["failure_budget", "objective"], ["0.001", "-"], ["0.02", "8.38667"], ["0.05", "6.66667"],
        ["-", "8.96"],
    ]  # fmt: skip
    assert "0: every policy fails with probability at least 0.01" in out
    assert "--failure-budget none minimises it" in out
    answers = told(*asked)
    assert [one["failure_budget"] for one in answers] == [0.001, 0.02, 0.05, None]
    assert "at least 0.01" in answers[0]["error"]
    assert answers[2] | {"seconds": 0} == {
        "failure_budget": 0.05, **told("solve", roads, *WITHIN), "seconds": 0,
    }  # fmt: skip
    refused(*asked, "--policy-out", "x.npz", complaint="--policy-out needs a single answer")
    refused(*asked, "--show-policy", complaint="--show-policy needs a single answer")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("", "COMMAND"),
        ("sovle", "'sovle'"),
        ("solve", "MODEL"),
        ("solve x.json --criterion mcpm", "'mcpm'"),
        ("solve x.json --failure-budget 5%%", "'5%%' is not a number"),
        ("solve x.json --failure-budget %", "'%' is not a number"),
        ("solve x.json --quiet --verbose", "not allowed with"),
        ("frontier x.json --json --csv", "not allowed with"),
        ("solve x.json --gaol home", "--gaol"),
    ],
)
def test_errors_are_one_line(words: str, complaint: str, run: Run, capsys: Any) -> None:
    with pytest.raises(SystemExit) as ended:
        run(*words.split())
    told = capsys.readouterr().err
    assert (ended.value.code, told.count("\n")) == (2, 1)
    assert complaint in told
    assert "--help" in told


@pytest.mark.slow
@pytest.mark.parametrize("method", ["lp", "deterministic"])
def test_solvers_print_nothing_beside_the_answer(roads: Path, method: str) -> None:
    """HiGHS would name itself on standard output, which only another process sees."""
    words = ["solve", str(roads), *map(str, WITHIN), "--method", method, "--json"]
    command = [sys.executable, "-m", "ssp_lp", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    assert json.loads(done.stdout)["objective"] >= 6.6


def test_tables_go_into_files(roads: Path, tmp_path: Path, run: Run) -> None:
    path, asked = tmp_path / "frontier.csv", ("frontier", roads, *FROM_DEPOT, "--csv")
    assert run(*asked, path) == (0, "", "")
    code, printed, _ = run(*asked)
    assert (code, printed) == (0, path.read_text(encoding="utf-8"))
    rows = list(csv.DictReader(io.StringIO(printed)))
    assert min(float(row["objective"]) for row in rows) < 4.0


def test_shells_complete(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("shtab")
    for shell in ("bash", "zsh", "tcsh"):
        with pytest.raises(SystemExit) as ended:
            run("--print-completion", shell)
        assert ended.value.code == 0
        assert "failure-budget" in capsys.readouterr().out


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_is_told_what_takes_long(roads: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", terminal := _Terminal())
    monkeypatch.setattr("ssp_lp.options._PATIENCE", 0.0)
    for words in (["--quiet"], []):
        assert not terminal.getvalue()
        assert main(["solve", str(roads), *FROM_DEPOT, *words]) == 0
    assert "compiling" in terminal.getvalue()
    assert "\n" not in terminal.getvalue()
    *_, wiped, left = terminal.getvalue().split("\r")
    assert (wiped.strip(), left) == ("", "")  # nothing is left


def test_a_line_that_does_not_last_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", terminal := _Terminal())
    began, now = time.perf_counter(), [0.0]
    monkeypatch.setattr("ssp_lp.options.time.perf_counter", lambda: began + now[0])
    with progress_shown(lasting=False):
        logging.getLogger("ssp_lp.search").info("soon done")
        assert not terminal.getvalue()
        now[0] = 2.0
        logging.getLogger("ssp_lp.search").info("still at it")
        assert "still at it" in terminal.getvalue()


def timed(chance: float, end: str, paid: float, fuel: float) -> list:
    return [chance, end, {"time": paid, "fuel": fuel}]


NAMED = {
    "start": "depot",
    "goal": [],
    "labels": {"ok": ["home"], "crash": ["wreck"], "lost": ["woods"]},
    "transitions": {
        "depot": {
            "alley": [timed(0.90, "home", 4, 1), timed(0.10, "wreck", 2, 1)],
            "road": [timed(0.99, "home", 9, 2), timed(0.01, "woods", 5, 2)],
        },
        "wreck": {},
        "woods": {},
    },
}


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ('Pmax=? [F "ok"]', "--cost time --criterion maxprob"),
        ('Pmax=?[F<=3 "ok"]', "--cost time --criterion maxprob --horizon 3"),
        ('multi(R{"time"}min=? [F "ok"], P>=0.95 [F "ok"])',
         "--cost time --criterion mcmp --failure-budget 5%"),
        ('multi(R{"time"}min=? [C], P>=0.9 [F "ok"], P<=0.02 [F "crash"], R{"fuel"}<=1.9 [C])',
         '--cost time --failure-budget 0.1 --limit "end(crash) <= 0.02" --limit "fuel <= 1.9"'),
        ('multi(P>=19/20 [F "ok"], R{"fuel"} min = ? [ C ])', "--cost fuel --failure-budget 0.05"),
        ('multi(Pmax=? [F "ok"], R{"time"}<=5 [C])',
         '--cost time --criterion maxprob --limit "time <= 5"'),
    ],
)  # fmt: skip
def test_properties_of_prism_ask_the_same(
    words: str, options: str, tmp_path: Path, told: Told
) -> None:
    model = written(tmp_path, NAMED)
    cost = [] if "R{" in words and "Pmax" not in words else ["--cost", "time"]
    found = told("solve", model, *cost, "--property", words)
    wanted = told("solve", model, "--goal", "ok", *shlex.split(options))
    for name in ("criterion", "failure_probability", "expected_cost", "objective"):
        assert found[name] == pytest.approx(wanted[name])


def test_a_certain_goal_is_asked_for_at_least_cost(tmp_path: Path, told: Told) -> None:
    model = written(tmp_path, {"a": {"go": [[0.5, "b", 2], [0.5, "a", 1]]}})
    found = told("solve", model, "--start", "a", "--property", 'Rmin=? [F "b"]')
    assert (found["objective"], found["criterion"]) == (pytest.approx(3.0), "MinCost")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("multi(", "not a supported property"),
        ('Pmax=? [G "ok"]', "not a supported property"),
        ('Pmin=? [F "ok"]', "the objective must be Pmax=? or Rmin=?"),
        ('R{"time"}max=? [F "ok"]', "the objective must be Pmax=? or Rmin=?"),
        ('P>=0.9 [F "ok"]', "one operator must have =?, not 0"),
        ('multi(Pmax=? [F "ok"], Rmin=? [C])', "one operator must have =?, not 2"),
        ('multi(Rmin=? [C], P<=0.1 [F "crash"])', "must have one goal [F ...], not []"),
        ('multi(Rmin=? [F "ok"], P>=0.9 [F "lost"])', "=? and P>= must have one goal"),
        ('multi(Pmax=? [F "ok"], R{"fuel"}>=2 [C])', "an upper bound only"),
        ('multi(Pmax=? [F "ok"], P>= [F "ok"])', "need a number"),
        ('multi(Pmax=? [F "ok"], P>=x [F "ok"])', "'x' is not a number"),
        ("multi(Rmin=? [C], P>=0.9 [C])", "P needs a target"),
        ('multi(Pmax=? [F<=3 "ok"], P>=0.5 [F "ok"])', "the same number of steps"),
        ('multi(R{"fuel"}min=? [C], P>=0.9 [F "ok"])', "--cost contradicts the property"),
    ],
)
def test_other_properties_are_refused(
    words: str, complaint: str, tmp_path: Path, refused: Any
) -> None:
    asked = ("solve", written(tmp_path, NAMED), "--cost", "time", "--property", words)
    refused(*asked, complaint=complaint)
