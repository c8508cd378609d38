"""Scripts of `examples`: what each says and draws, and that help is all that happens if asked."""

import inspect
import json
import re
import runpy
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import ssp_lp.io
from examples.domains.inventory import START, season, table
from examples.formulating import drone, many_problems, near_goal, ppddl_file
from examples.formulating.real_costs import LAWS, LEVELS, main as real_costs
from examples.formulating.toy_texts import TASKS
from examples.paper_walkthrough import cross_check
from ssp_lp import WorldSimulator, certify, evaluate, simulate, solve_many
from ssp_lp.analysis.simulation import proportion_estimate

ROOT = Path(__file__).parents[2]
GALLERY = ROOT / "docs" / "gallery"
RUN_BY = re.compile(r"^ *python examples/\S+\.py|__name__ == .__main__.", re.MULTILINE)
SCRIPTS = sorted(
    path
    for path in (ROOT / "examples").rglob("*.py")
    if path.name != "__init__.py" and RUN_BY.search(path.read_text(encoding="utf-8"))
)
assert len(SCRIPTS) >= 12
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
assert len(NOTEBOOKS) >= 3


def test_a_field_is_explored_as_far_as_it_matters(capsys):
    field = near_goal.Field(side=40, distance=5)
    part, whole = near_goal.explored(field, 0.5), near_goal.whole(field, 0.5)
    assert part == pytest.approx(whole, rel=1e-9)
    assert "assuming that" in capsys.readouterr().out


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_help_is_all_that_happens(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(script), run_name="__main__")
    assert not caught.value.code
    printed = capsys.readouterr()
    assert len(printed.out.split()) >= 10
    assert printed.err == ""


def test_more_failing_never_costs_more_on_any_robot(capsys):
    asked = many_problems.questions(4, segments=(5, 6))
    assert len({problem.model for problem in asked}) == 2
    costs = np.reshape(solve_many(asked, executor=ThreadPoolExecutor(1)).objectives, (2, 4))
    assert (np.diff(costs, axis=1) <= 1e-9 * costs[:, 1:]).all()
    many_problems.report(asked[:2], workers=[0])
    assert capsys.readouterr().out.split()[-1] == f"{costs[0, :2].mean():.6f}"


def test_the_season_keeps_to_its_budget_and_the_world_nearly():
    """The grid forgets where in its cell the stock was: what it claims of the world is no proof."""
    ((budget, cost, failure, low, high, world_cost),) = table(budgets=(0.05,), episodes=4000)
    assert abs(failure - budget) < 1e-6
    assert low - 0.01 < failure < high + 0.01
    assert abs(world_cost - cost) < 0.02 * cost


def test_the_week_goes_on_and_the_stock_goes_down():
    world = season(cells=60)
    state = WorldSimulator(world, START)
    begin, cell = state.reset(500, np.random.default_rng(0))
    assert set(cell.tolist()) == {25 * 8}
    after, where, cost = state.step(begin, 4 * cell + 1, np.random.default_rng(1))
    assert (after[:, 1] == 1.5).all()
    assert (after[:, 0] < 35.0).all()
    assert (cost >= 30.0).all()
    assert (where[after[:, 0] < 0.0] == world.end_state("sold out")).all()


@pytest.mark.slow
def test_the_key_and_the_door_and_the_gallery_are_drawn(tmp_path, capsys):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from examples.formulating import front_page, gallery, key_and_door

    key_and_door.main(["--output", str(tmp_path / "plan.png")])
    assert "ends at D" in capsys.readouterr().out
    gallery.main(["--output", str(tmp_path)])
    sizes = {path.stem: path.stat().st_size for path in tmp_path.glob("*.png")}
    shown = {path.stem: path.stat().st_size for path in GALLERY.iterdir()}
    assert set(sizes) == {"plan", *shown}
    assert min(sizes.values()) > 10_000
    assert max(shown.values()) < 80_000
    assert sum(shown.values()) < 500_000
    front_page.main(["--output", str(tmp_path / "front")])
    drawn = {path.name for path in (tmp_path / "front").iterdir()}
    assert drawn == {path.name for path in (ROOT / "docs" / "front").iterdir()}
    matplotlib.pyplot.close("all")


@pytest.mark.slow
def test_the_three_methods_agree_on_a_coarse_robot(capsys):
    grid = ["--segments", "4", "--headings", "3"]
    cross_check.main([*grid, "--budget", "0.98", "--discount", "0.9"])
    printed = capsys.readouterr().out
    assert printed.count("3 methods agree") == 2
    pairs = re.findall(r"alpha\* = ([\d.]+), from c\* and the price ([\d.]+)", printed)
    assert len(pairs) == 2
    assert all(abs(float(weight) - float(identity)) <= 1e-9 for weight, identity in pairs)


@pytest.mark.slow
def test_the_frozen_lake_tells_both_horizons(capsys, monkeypatch):
    pytest.importorskip("gymnasium")
    rollout = ssp_lp.io.rollout
    monkeypatch.setattr(ssp_lp.io, "rollout", lambda *a, **b: rollout(*a, **b | {"episodes": 250}))
    with warnings.catch_warnings():
        runpy.run_path(str(ROOT / "examples/formulating/frozen_lake.py"))
    printed = capsys.readouterr().out
    assert printed.count("certified failure 0.4000") == 2
    with_limit, without = re.findall(r"failure probability +\S+ \[(\S+), (\S+)\]", printed)
    assert float(with_limit[0]) <= 0.4 <= float(with_limit[1])
    assert float(without[0]) > 0.4


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TASKS))
def test_the_certified_failure_of_a_toy_text_is_what_is_played(name):
    solution, report = TASKS[name](100)
    assert certify(solution).accepted
    failure = report.failure_probability
    assert failure.low <= solution.failure_probability <= failure.high
    body = inspect.getsource(TASKS[name]).split('"""')[-1].strip().splitlines()
    assert len(body) <= 8


@pytest.mark.slow
def test_every_law_of_real_costs_and_every_number_of_levels_has_its_line(capsys):
    real_costs(["--sizes", "4", "--time-limit", "2"])
    laws, levels = capsys.readouterr().out.strip().split("\n\n")
    assert [line[:17].strip().split(maxsplit=1)[1] for line in laws.splitlines()[2:]] == list(LAWS)
    rows = [line.split() for line in levels.splitlines()[2:]]
    assert [int(row[0].replace(",", "")) for row in rows] == list(LEVELS)
    assert all(float(lower) <= float(upper) for _, lower, upper, *_ in rows)


SUBURB = (
    "..m...H",
    "...#...",
    ".#.....",
    "...m.#.",
    "S....m.",
)


@pytest.mark.slow
def test_the_drones_limits_hold_when_its_plan_is_flown(monkeypatch, tmp_path):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(drone, "PLAN", SUBURB)
    monkeypatch.setattr(drone, "CHARGE", 13)
    model, start = drone.town()
    rash, careful = drone.plan(model, start), drone.plan(model, start, **drone.LIMITS)
    assert careful.objective > rash.objective
    ends = evaluate(careful.policy, careful.problem).ends
    for name, most in drone.LIMITS.items():
        assert ends[name] == pytest.approx(careful.secondary_costs[name], abs=1e-9)
        assert ends[name] <= most + 1e-9
    assert certify(careful).gap <= 1e-7
    flights = simulate(careful.policy, careful.problem, episodes=5_000, seed=3)
    for name in (*drone.LIMITS, "landed"):
        flown = proportion_estimate(flights.ends[name], 5_000, 0.9999)
        assert flown.low <= ends[name] <= flown.high
    drone.draw({"rash": rash, "careful": careful}, tmp_path / "drone.png")
    assert (tmp_path / "drone.png").stat().st_size > 10_000


@pytest.mark.parametrize("risk", [0.01, 0.05, 0.2])
def test_the_front_page_says_how_long_the_robot_takes(risk):
    pytest.importorskip("matplotlib")
    from examples.formulating import front_page

    page = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    solution = front_page.crossing(risk)
    shown = f"1 run in {1 / risk:.0f} may fail:** {solution.conditional_cost:.1f} steps"
    assert shown in page
    assert solution.failure_probability == pytest.approx(risk, abs=1e-9)


def test_the_readme_names_every_notebook():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for path in NOTEBOOKS:
        assert f"]({path.relative_to(ROOT).as_posix()})" in readme


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_in_at_most_forty_lines_and_says_what_it_shows(path, monkeypatch):
    plt = pytest.importorskip("matplotlib.pyplot")
    pytest.importorskip("pandas")
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(path.parent)
    plt.switch_backend("agg")
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    cells = [cell for cell in cells if cell["cell_type"] == "code"]
    assert sum(len(re.findall(r"\S.*", "".join(cell["source"]))) for cell in cells) <= 40
    names = {}
    for cell in cells:
        printed = []
        names["print"] = lambda *told, to=printed: to.append(" ".join(map(str, told)))
        exec("".join(cell["source"]), names)
        shown = "".join("".join(out.get("text", ())) for out in cell["outputs"])
        for told in re.findall(r"objective c\*\s+\S+", "\n".join(printed)):
            assert told in shown
    plt.close("all")


def test_a_task_in_ppddl_is_explored_where_its_reader_is_installed(capsys):
    solution = ppddl_file.main([])
    if find_spec("skdecide") is None:
        assert solution is None
        assert capsys.readouterr().out.startswith("skipped: pip install")
    else:  # half of the drives take the gorge: 1.8 and 3.4 steps
        assert solution.objective == pytest.approx(2.6, rel=1e-9)
