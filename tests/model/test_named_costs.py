"""Several costs by name: in the builders, in limits, on products, in files and back."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formulations import MCMP, S3P
from formulations.command_line import main
from ssp_lp import (
    SSP,
    Memory,
    ModelError,
    end_probability,
    evaluate,
    product,
    secondary_cost,
    solve,
    within_steps,
)
from ssp_lp.io import (
    fingerprint,
    load_model,
    read_drn,
    read_prism,
    save_model,
    write_drn,
    write_prism,
)
from ssp_lp.io.any_format import read_any, write_any

ROWS = [
    ("depot", "alley", 0.90, "home", 4.0, 1.0),
    ("depot", "alley", 0.10, "wreck", 2.0, 1.0),
    ("depot", "road", 0.99, "home", 9.0, 0.5),
    ("depot", "road", 0.01, "wreck", 5.0, 0.25),
]
COLUMNS = ("state", "action", "probability", "successor", "time", "fuel")
TABLE = dict(zip(COLUMNS, map(list, zip(*ROWS, strict=True)), strict=True))


def roads(**changed: Any) -> SSP:
    return SSP.from_frame(TABLE | changed, {"home"}, cost=["time", "fuel"])


def nested() -> dict[str, dict[str, list[tuple[Any, str, Any]]]]:
    table: dict[str, dict[str, list[tuple[Any, str, Any]]]] = {}
    for state, action, chance, successor, time, fuel in ROWS:
        outcomes = table.setdefault(state, {}).setdefault(action, [])
        outcomes.append((chance, successor, {"time": time, "fuel": fuel}))
    return table


def same(one: SSP, other: SSP) -> bool:
    names = ("pair_offsets", "outcome_offsets", "successors", "probabilities", "costs")
    fits = all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)
    named, others = one.named_costs, other.named_costs
    return (
        fits
        and list(named) == list(others)
        and all(np.array_equal(named[name], others[name]) for name in named)
    )


def test_every_builder_takes_them() -> None:
    pandas, table = pytest.importorskip("pandas"), nested()
    model = roads()
    assert same(
        model,
        SSP.from_transitions(table, {"home"}, cost="time", treat_actionless_as_dead_ends=True),
    )
    assert same(model, SSP.from_frame(pandas.DataFrame(TABLE), {"home"}, cost=["time", "fuel"]))
    shuffled = {name: cells[::-1] for name, cells in TABLE.items()}
    again = SSP.from_frame(shuffled, {"home"}, cost=["time", "fuel"])
    assert (
        solve(MCMP(again, "depot", 0.05)).objective == solve(MCMP(model, "depot", 0.05)).objective
    )
    explored = SSP.from_successors(
        "depot", lambda state: table.get(state, {}), {"home"}, cost="fuel",
        treat_actionless_as_dead_ends=True,
    )  # fmt: skip
    assert explored.costs_by_name.keys() == {"fuel", "time"}
    assert list(explored.costs_by_name) == ["fuel", "time"]
    assert sorted(explored.costs) == sorted(model.with_cost("fuel").costs)


def test_tuples_of_columns_are_states() -> None:
    table = {
        "x": [0, 0],
        "y": [0, 0],
        "do": "rr",
        "u": [1, 0],
        "v": [0, 1],
        "p": [0.5] * 2,
        "c": [1, 1],
    }
    model = SSP.from_frame(
        table,
        {(1, 0)},
        state=("x", "y"),
        successor=("u", "v"),
        action="do",
        probability="p",
        cost="c",
    )
    assert list(model.states) == [(0, 0), (1, 0), (0, 1)]
    assert solve(MCMP(model, (0, 0))).failure_probability == pytest.approx(0.5)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("horizon", [None, 3])
def test_a_limit_by_name_is_one_by_array(criterion: Any, horizon: int | None) -> None:
    model, told = roads(), {"horizon": horizon}
    named, listed = (
        solve(criterion(model, "depot", 0.05, constraints={"fuel": limit}, **told))
        for limit in (
            secondary_cost("fuel") <= 0.7,
            secondary_cost(model.named_costs["fuel"]) <= 0.7,
        )
    )
    assert named.objective == pytest.approx(listed.objective)
    assert named.secondary_costs["fuel"] == pytest.approx(0.7)
    # the share a of the alley: fuel a + (1 - a) (0.99 * 0.5 + 0.01 * 0.25) = 0.7
    share = (0.7 - 0.4975) / (1.0 - 0.4975)
    assert named.failure_probability == pytest.approx(0.1 * share + 0.01 * (1.0 - share))


def test_products_keep_them() -> None:
    model = roads()
    counting = within_steps(model, 3, start={"depot"})
    tired = product(model, Memory(0, lambda kept, *_: min(kept + 1, 2)), start={"depot"})
    for made, start in ((counting, counting.start("depot")), (tired, tired.start("depot"))):
        answer = solve(MCMP(made, start, 0.05, constraints={"fuel": secondary_cost("fuel") <= 0.7}))
        assert answer.secondary_costs["fuel"] == pytest.approx(0.7)
        assert "fuel" in made.named_costs


def test_after_failing_they_count_on() -> None:
    table = nested()
    table["wreck"] = {"tow": [(1, "yard", {"time": 0, "fuel": 2})]}
    model = SSP.from_transitions(
        {**table, "yard": {}}, {"home"}, cost="time", state_labels={"towed": ["yard"]},
        treat_actionless_as_dead_ends=True,
    )  # fmt: skip
    limits = {
        "towed": end_probability("towed") >= 0.05,
        "fuel": secondary_cost("fuel", through_failure=True) <= 5.0,
    }
    answer = solve(MCMP(model, "depot", 0.05, constraints=limits))
    assert answer.failure_probability == pytest.approx(0.05)
    share = (0.05 - 0.01) / 0.09
    burnt = share + (1.0 - share) * 0.4975 + 2.0 * 0.05
    assert answer.secondary_costs["fuel"] == pytest.approx(burnt)


@pytest.mark.parametrize("ending", [".json", ".npz", ".drn", ".drn.gz", ".tra", ".umb"])
def test_files_keep_them(ending: str, tmp_path: Path) -> None:
    if ending == ".umb":
        pytest.importorskip("stormpy")
    model, path = roads(), tmp_path / f"roads{ending}"
    write_any(model, path, "depot")
    goal = {".json": ["home"], ".npz": []}.get(ending, ["goal"])
    for cost in ("time", "fuel", "*"):
        read = read_any(path, goal, cost)
        name = next(iter(read.model.costs_by_name))
        assert cost in (name, "*")
        begin = read.start if read.start is not None else "depot"
        assert {*read.model.named_costs} == {"time", "fuel"}
        limits = {"fuel": secondary_cost("fuel") <= 0.7, "time": secondary_cost("time") <= 1e3}
        again = solve(MCMP(read.model, begin, 0.05, constraints=limits))
        wanted = solve(MCMP(model.with_cost(name), "depot", 0.05, constraints=limits))
        assert again.secondary_costs["fuel"] == pytest.approx(wanted.secondary_costs["fuel"])
        assert again.objective == pytest.approx(wanted.objective)


def test_the_librarys_own_file_is_the_same(tmp_path: Path) -> None:
    third = {"a": {"go": [(1, "home", {"toll": Fraction(1, 3), "km": 2})]}}
    model = SSP.from_transitions(third, {"home"}, cost="toll")
    assert model.exact_costs == {1 / 3: Fraction(1, 3)}
    save_model(model, tmp_path / "m.npz")
    again = load_model(tmp_path / "m.npz")
    assert same(model, again)
    assert again.exact_costs == model.exact_costs


def test_dearer_outcomes_pay_on_the_way(tmp_path: Path) -> None:
    """Written, each cost of an outcome is the least of its action and a rest; read, whole again."""
    generator = np.random.default_rng(7)
    table = {
        k: {
            a: [
                (0.25, int(to), {"x": float(x), "y": float(y)})
                for to, x, y in generator.integers(0, 6, (4, 3))
            ]
            for a in ("l", "r")
        }
        for k in range(5)
    }
    model = SSP.from_transitions(table, {5}, cost="x")
    write_drn(model, tmp_path / "m.drn", start=0)
    write_prism(model, tmp_path / "m", start=0)
    for read in (
        read_drn(tmp_path / "m.drn", goal="goal", cost="x"),
        read_prism(tmp_path / "m", goal="goal", cost="x"),
    ):
        for name in ("x", "y"):
            costs = [
                solve(MCMP(each.with_cost(name), 0, give_up="dead_ends")).objective
                for each in (model, read.model)
            ]
            assert costs[0] == pytest.approx(costs[1])


def test_the_command_line_converts_all_and_limits_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, target = tmp_path / "roads.json", tmp_path / "roads.drn"
    table = {
        s: {a: [list(o) for o in some] for a, some in acts.items()} for s, acts in nested().items()
    }
    path.write_text(json.dumps(table), encoding="utf-8")
    asked = [str(path), "--goal", "home", "--start", "depot"]
    assert main(["convert", str(path), str(target), *asked[1:]]) == 0
    assert "time fuel" in target.read_text(encoding="utf-8")
    assert main(["info", *asked]) == 0
    assert "time, fuel" in capsys.readouterr().out
    for model in (asked, [str(target), "--goal", "goal"]):
        command = ["solve", *model, "--cost", "time", "--failure-budget", "5%", "--json"]
        assert main([*command, "--limit", "fuel <= 0.7"]) == 0
        assert json.loads(capsys.readouterr().out)["limits"]["fuel"]["value"] == pytest.approx(0.7)
    assert main(["solve", *asked]) == 2
    assert "--cost" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("table", "cost", "complaint"),
    [
        ({"t": 1, "u": 2}, None, "say which cost counts (cost): 't', 'u'"),
        ({"t": 1, "u": 2}, "v", "not 'v'"),
        ({"t": 1, "u": -1}, "t", "a negative cost 'u'"),
        ({"t": 1, "u": float("nan")}, "t", "a cost 'u' that is NaN"),
        ({"t": 1, "u": float("inf")}, "t", "an infinite cost 'u'"),
        ({"t": 1, "u": "2"}, "t", "a cost that is no number: '2'"),
        (1.0, "t", "no names"),
        ({}, None, "no costs"),
    ],
)
def test_wrong_costs(table: Any, cost: str | None, complaint: str) -> None:
    with pytest.raises(ModelError) as refused:
        SSP.from_transitions({"a": {"go": [(1.0, "home", table)]}}, {"home"}, cost=cost)
    assert complaint in str(refused.value)


def test_mixed_names() -> None:
    for first, second in ((1.0, {"t": 1}), ({"t": 1}, 1.0), ({"t": 1}, {"u": 1})):
        with pytest.raises(ModelError, match=r"everywhere|elsewhere"):
            SSP.from_transitions(
                {"a": {"x": [(1, "home", first)], "y": [(1, "home", second)]}}, {"home"}
            )


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        (
            {"fuel": [1, 1, 0.5, float("nan")]},
            "row 3 of the table has nothing in the column 'fuel'",
        ),
        ({"action": ["alley", None, "road", "road"]}, "row 1"),
        ({"time": [1, 2]}, "different lengths"),
        ({"probability": [0.9, 0.2, 1, 0]}, "sum to 1.1"),
    ],
)
def test_wrong_tables(changed: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ModelError) as refused:
        roads(**changed)
    assert complaint in str(refused.value)


def test_what_is_not_there() -> None:
    model = roads()
    with pytest.raises(ModelError, match="did you mean 'time'"):
        SSP.from_frame(TABLE, {"home"}, cost="tim")
    with pytest.raises(ModelError, match="did you mean 'fuel'"):
        solve(MCMP(model, "depot", 0.05, constraints={"f": secondary_cost("ful") <= 1}))
    with pytest.raises(ModelError, match="none by name"):
        SSP.from_frame(TABLE, {"home"}, cost="time").with_cost("fuel")
    answer = solve(MCMP(model, "depot", 0.05))
    assert evaluate(answer.policy, answer.problem).objective == pytest.approx(answer.objective)


def test_a_reward_model_without_a_name_moves_no_other(tmp_path: Path) -> None:
    write_drn(roads(), tmp_path / "m.drn", start="depot")
    text = (tmp_path / "m.drn").read_text(encoding="utf-8").replace("time fuel", '"" fuel')
    (tmp_path / "m.drn").write_text(text, encoding="utf-8")
    read = read_drn(tmp_path / "m.drn", goal="goal", cost="").model
    assert list(read.named_costs) == ["fuel"]
    assert set(read.named_costs["fuel"].tolist()) == {1.0, 0.5, 0.25}
    assert set(read.costs.tolist()) == {4.0, 2.0, 9.0, 5.0}


def test_named_costs_are_part_of_the_fingerprint() -> None:
    assert fingerprint(roads()) == fingerprint(roads())
    assert fingerprint(roads()) != fingerprint(roads(fuel=[1.0, 1.0, 0.5, 0.5]))
    assert fingerprint(roads()) != fingerprint(roads().with_cost("fuel"))
