"""Several costs by name: in the builders, in limits, on products, in files and back."""

import json
from fractions import Fraction

import numpy as np
import pytest

from formulations import MCMP, S3P
from formulations.command_line import main
from refusing import refused
from small_models import model_of
from ssp_lp import (
    SSP,
    Memory,
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
    read_any,
    read_drn,
    save_model,
    write_any,
    write_drn,
)

END = {"treat_actionless_as_dead_ends": True}
FRUGAL = {"fuel": secondary_cost("fuel") <= 0.7}
ROWS = [
    ("depot", "alley", 0.90, "home", 4.0, 1.0),
    ("depot", "alley", 0.10, "wreck", 2.0, 1.0),
    ("depot", "road", 0.99, "home", 9.0, 0.5),
    ("depot", "road", 0.01, "wreck", 5.0, 0.25),
]
COLUMNS = ("state", "action", "probability", "successor", "time", "fuel")
TABLE = dict(zip(COLUMNS, map(list, zip(*ROWS, strict=True)), strict=True))
NESTED = {"depot": {"alley": [], "road": []}}
for _, action, chance, successor, time, fuel in ROWS:
    NESTED["depot"][action].append((chance, successor, {"time": time, "fuel": fuel}))


def roads(**changed):
    return SSP.from_frame(TABLE | changed, {"home"}, cost=["time", "fuel"])


def solved(model, start="depot", budget=0.05, **options):
    return solve(MCMP(model, start, budget, **options))


def same(one, other):
    names = ("pair_offsets", "outcome_offsets", "successors", "probabilities", "costs")
    kept, known = ({n: getattr(m, n) for n in names} | {**m.named_costs} for m in (one, other))
    return list(kept) == list(known) and all(np.array_equal(kept[n], known[n]) for n in kept)


def test_every_builder_takes_them():
    pandas, model = pytest.importorskip("pandas"), roads()
    assert same(model, SSP.from_transitions(NESTED, {"home"}, cost="time", **END))
    assert same(model, SSP.from_frame(pandas.DataFrame(TABLE), {"home"}, cost=["time", "fuel"]))
    shuffled = roads(**{name: cells[::-1] for name, cells in TABLE.items()})
    assert solved(shuffled).objective == solved(model).objective
    moves = {"wreck": {}} | NESTED
    explored = SSP.from_successors("depot", moves.__getitem__, {"home"}, cost="fuel", **END)
    assert list(explored.costs_by_name) == ["fuel", "time"]
    assert sorted(explored.costs) == sorted(model.with_cost("fuel").costs)


def test_tuples_of_columns_are_states():
    table = {"x": [0, 0], "y": [0, 0], "do": "rr", "u": [1, 0], "v": [0, 1], "p": [0.5] * 2}
    columns = {"state": ("x", "y"), "successor": ("u", "v"), "action": "do", "probability": "p"}
    model = SSP.from_frame(table | {"c": [1, 1]}, {(1, 0)}, cost="c", **columns)
    assert list(model.states) == [(0, 0), (1, 0), (0, 1)]
    assert solved(model, (0, 0), None).failure_probability == pytest.approx(0.5)


SHARE = (0.7 - 0.4975) / (1.0 - 0.4975)
"""Of the alley: its fuel is 1, the road's 0.99 * 0.5 + 0.01 * 0.25, and 0.7 is to be burnt."""


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("horizon", [None, 3])
def test_a_limit_by_name_is_one_by_array(criterion, horizon):
    model = roads()
    listed = {"fuel": secondary_cost(model.named_costs["fuel"]) <= 0.7}
    named, known = (
        solve(criterion(model, "depot", 0.05, constraints=limits, horizon=horizon))
        for limits in (FRUGAL, listed)
    )
    assert named.objective == pytest.approx(known.objective)
    assert named.secondary_costs["fuel"] == pytest.approx(0.7)
    assert named.failure_probability == pytest.approx(0.1 * SHARE + 0.01 * (1.0 - SHARE))


def test_products_keep_them():
    tired = Memory(0, lambda kept, *_: min(kept + 1, 2))
    at = {"start": {"depot"}}
    for made in (within_steps(roads(), 3, **at), product(roads(), tired, **at)):
        answer = solved(made, made.start("depot"), constraints=FRUGAL)
        assert answer.secondary_costs["fuel"] == pytest.approx(0.7)
        assert "fuel" in made.named_costs


def test_after_failing_they_count_on():
    towing = {"wreck": {"tow": [(1, "yard", {"time": 0, "fuel": 2})]}, "yard": {}}
    labels = {"state_labels": {"towed": ["yard"]}}
    model = SSP.from_transitions(NESTED | towing, {"home"}, cost="time", **labels, **END)
    limits = {
        "towed": end_probability("towed") >= 0.05,
        "fuel": secondary_cost("fuel", through_failure=True) <= 5.0,
    }
    answer = solved(model, constraints=limits)
    assert answer.failure_probability == pytest.approx(0.05)
    share = (0.05 - 0.01) / 0.09
    burnt = share + (1.0 - share) * 0.4975 + 2.0 * 0.05
    assert answer.secondary_costs["fuel"] == pytest.approx(burnt)


@pytest.mark.parametrize("ending", [".json", ".npz", ".drn", ".drn.gz", ".umb"])
def test_files_keep_them(ending, tmp_path):
    model, path = roads(), tmp_path / f"roads{ending}"
    write_any(model, path, "depot")
    limits = FRUGAL | {"time": secondary_cost("time") <= 1e3}
    for cost in ("time", "fuel", "*"):
        read = read_any(path, {".json": ["home"], ".npz": []}.get(ending, ["goal"]), cost)
        name = next(iter(read.model.costs_by_name))
        assert cost in (name, "*")
        assert {*read.model.named_costs} == {"time", "fuel"}
        begin = read.start if read.start is not None else "depot"
        again = solved(read.model, begin, constraints=limits)
        known = solved(model.with_cost(name), constraints=limits)
        assert again.secondary_costs["fuel"] == pytest.approx(known.secondary_costs["fuel"])
        assert again.objective == pytest.approx(known.objective)


def test_the_librarys_own_file_is_the_same(tmp_path):
    third = {"a": {"go": [(1, "home", {"toll": Fraction(1, 3), "km": 2})]}}
    model = SSP.from_transitions(third, {"home"}, cost="toll")
    save_model(model, tmp_path / "m.npz")
    again = load_model(tmp_path / "m.npz")
    assert same(model, again)
    assert again.exact_costs == model.exact_costs == {1 / 3: Fraction(1, 3)}


def test_dearer_outcomes_pay_on_the_way(tmp_path):
    """Written, each cost of an outcome is the least of its action and a rest; read, whole again."""
    rng = np.random.default_rng(7)
    table = {
        k: {
            a: [(0.25, to, {"x": x, "y": y}) for to, x, y in rng.integers(0, 6, (4, 3)).tolist()]
            for a in ("l", "r")
        }
        for k in range(5)
    }
    model = SSP.from_transitions(table, {5}, cost="x")
    write_drn(model, tmp_path / "m.drn", start=0)
    read = read_drn(tmp_path / "m.drn", goal="goal", cost="x").model
    for name in ("x", "y"):
        known, found = (
            solved(each.with_cost(name), 0, None, give_up="dead_ends").objective
            for each in (model, read)
        )
        assert found == pytest.approx(known)


def test_the_command_line_converts_all_and_limits_by_name(tmp_path, capsys):
    path, target = tmp_path / "roads.json", tmp_path / "roads.drn"
    path.write_text(json.dumps(NESTED), encoding="utf-8")
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
        ({"t": 1, "u": 2}, None, r"choose the cost to minimise \(cost\): 't', 'u'"),
        ({"t": 1, "u": 2}, "v", "not 'v'"),
        ({"t": 1, "u": -1}, "t", "a negative cost 'u'"),
        ({"t": 1, "u": float("nan")}, "t", "a cost 'u' that is NaN"),
        ({"t": 1, "u": float("inf")}, "t", "an infinite cost 'u'"),
        ({"t": 1, "u": "2"}, "t", "a cost that is not a number: '2'"),
        (1.0, "t", "give each cost a name"),
        ({}, None, "no costs"),
    ],
)
def test_wrong_costs(table, cost, complaint):
    going = {"a": {"go": [(1.0, "home", table)]}}
    refused(complaint, SSP.from_transitions, going, {"home"}, cost=cost)


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"fuel": [1, 1, 0.5, float("nan")]}, "row 3 of the table has nothing .* column 'fuel'"),
        ({"action": ["alley", None, "road", "road"]}, "row 1"),
        ({"time": [1, 2]}, "different lengths"),
        ({"probability": [0.9, 0.2, 1, 0]}, "sum to 1.1"),
    ],
)
def test_wrong_tables(changed, complaint):
    refused(complaint, roads, **changed)


def test_names_that_are_mixed_or_not_there():
    for first, second in ((1.0, {"t": 1}), ({"t": 1}, 1.0), ({"t": 1}, {"u": 1})):
        moves = {"x": [(1, "home", first)], "y": [(1, "home", second)]}
        refused(r"everywhere|elsewhere", model_of, {"a": moves}, "home")
    refused("did you mean 'time'", SSP.from_frame, TABLE, {"home"}, cost="tim")
    unknown = {"f": secondary_cost("ful") <= 1}
    refused("did you mean 'fuel'", solved, roads(), constraints=unknown)
    alone = SSP.from_frame(TABLE, {"home"}, cost="time")
    refused("its costs by name: none", alone.with_cost, "fuel")
    answer = solved(roads())
    assert evaluate(answer.policy, answer.problem).objective == pytest.approx(answer.objective)


def test_a_reward_model_without_a_name_moves_no_other(tmp_path):
    write_drn(roads(), tmp_path / "m.drn", start="depot")
    text = (tmp_path / "m.drn").read_text(encoding="utf-8").replace("time fuel", '"" fuel')
    (tmp_path / "m.drn").write_text(text, encoding="utf-8")
    read = read_drn(tmp_path / "m.drn", goal="goal", cost="").model
    assert list(read.named_costs) == ["", "fuel"]
    assert set(read.named_costs["fuel"].tolist()) == {1.0, 0.5, 0.25}
    assert set(read.costs.tolist()) == {4.0, 2.0, 9.0, 5.0}


def test_named_costs_are_part_of_the_fingerprint():
    assert fingerprint(roads()) == fingerprint(roads())
    others = roads(fuel=[1.0, 1.0, 0.5, 0.5]), roads().with_cost("fuel")
    assert fingerprint(roads()) not in map(fingerprint, others)
