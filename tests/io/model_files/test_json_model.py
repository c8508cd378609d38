"""Models in JSON: three forms, read and written; what is broken is refused by name."""

import gzip
import json
import random
from fractions import Fraction

import numpy as np
import pytest

from cases import FOLDER, load_case
from formulations import MCMP
from small_models import model_of
from ssp_lp import SSP, ModelError, SSPError, solve
from ssp_lp.io.model_files.json_model import model_in_json, parse_json, read_json

ROADS = {
    "depot": {
        "alley": [[0.9, "home", {"cost": 4, "fuel": "1/3"}], [0.1, "wreck", {"cost": 2}]],
        "road": [["99/100", "home", {"cost": 9}], [0.01, "wreck", {"cost": 5}]],
    },
    "wreck": {},
}
DOCUMENT = {"goal": ["end"], "start": "depot", "labels": {"end": ["home"], "crash": ["wreck"]}}


def stated(table, *goal, cost=None):
    return parse_json(json.dumps(table), "roads", goal, cost)


def test_a_table_and_a_document_say_the_same():
    table = stated(ROADS, "home", cost="cost")
    document = stated({**DOCUMENT, "transitions": ROADS}, cost="cost")
    assert (table.start, document.start) == (None, "depot")
    assert list(document.model.state_labels) == ["end", "crash"]
    for name in ("successors", "probabilities", "costs", "goal_mask"):
        assert np.array_equal(getattr(table.model, name), getattr(document.model, name))


def test_costs_by_name():
    roads = {"depot": {"alley": [[1, "home", {"cost": 4, "fuel": "1/3"}]]}}
    fuel = stated(roads, "home", cost="fuel").model
    assert fuel.exact_costs == {1 / 3: Fraction(1, 3)}
    assert stated(roads, "home", cost="unit").model.costs.tolist() == [1.0]
    for wrong in (None, "oil"):
        with pytest.raises(ModelError, match=r"choose one of the costs .*: 'cost', 'fuel'"):
            stated(roads, "home", cost=wrong)


def test_a_published_case_names_its_costs():
    path = FOLDER / "models" / "prism_attacktree.json.gz"
    for cost, hint in ((None, "each step$"), ("sucess", "not 'sucess'; did you mean 'success'")):
        with pytest.raises(ModelError, match=rf"gz: choose .*'cost', 'success', or 'unit'.*{hint}"):
            read_json(path, (), cost)
    assert set(read_json(path, (), "unit").model.costs) == {1.0}


@pytest.mark.parametrize("name", ["prism_robot_goal1", "prism_attacktree"])
def test_published_cases_are_read(name):
    cost = {"prism_robot_goal1": "time", "prism_attacktree": "unit"}[name]
    case = load_case(name, cost)
    own = SSP.from_transitions(case.choices, goal=case.goal, treat_actionless_as_dead_ends=True)
    read = read_json(FOLDER / "models" / f"{name}.json.gz", (), cost)
    mine, theirs = (
        solve(MCMP(model, start, give_up="anywhere", charge_failing_step=False)).objective
        for model, start in ((own, case.start), read)
    )
    assert theirs == pytest.approx(mine, rel=1e-12)


def test_what_is_written_is_read_again(tmp_path):
    model = model_of(
        {(0, "a"): {1: [(0.25, "x", 0.1), (0.75, (0, "a"), Fraction(1, 3))]}},
        "x",
        labels={"first": [(0, "a")]},
    )
    with gzip.open(tmp_path / "m.json.gz", "wt", encoding="utf-8") as file:
        file.writelines(model_in_json(model, {(0, "a"): 1.0}))
    again = read_json(tmp_path / "m.json.gz", ())
    assert again.start == {"(0, 'a')": 1.0}
    for name in ("successors", "probabilities", "costs", "goal_mask", "pair_offsets"):
        assert np.array_equal(getattr(model, name), getattr(again.model, name))
    assert again.model.exact_costs == model.exact_costs
    assert list(again.model.states) == [str(state) for state in model.states]


def test_names_that_read_the_same_are_refused():
    twice = SSP.from_transitions({1: {"a": [(1.0, "1", 1.0)]}}, goal=["1"])
    with pytest.raises(ModelError, match="two states"):
        list(model_in_json(twice))
    twice = SSP.from_transitions({0: {1: [(1.0, 2, 1.0)], "1": [(1.0, 2, 1.0)]}}, goal=[2])
    with pytest.raises(ModelError, match="two actions of state '0'"):
        list(model_in_json(twice))


EXPLICIT = {"format": "explicit-mdp-v1", "init": 0, "goal": [1]}


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ("{", "is no JSON"),
        ("[" * 100_000, "is no JSON"),
        ([1], "must hold"),
        ({"a": [1]}, "state 'a' needs"),
        ({"a": {"go": [[1, "home"]]}}, "action 'go' of state 'a'"),
        ({"a": {"go": [[1, ["home"], 1]]}}, "action 'go' of state 'a'"),
        ({"a": {"go": [[1, "hoem", 1]]}}, "did you mean 'hoem'"),
        ({"a": {"go": [[1, "home", "x"]]}}, "no number"),
        ({"a": {"go": [[1, "home", "1/0"]]}}, "no number"),
        ({"a": {"go": [[1, "home", -1]]}}, "negative cost"),
        ('{"a": {"go": [[1, "home", 1]]}, "a": {}}', "'a' stands twice"),
        ({"goal": [], "transitions": []}, "'transitions' must be an object"),
        ({"goal": [], "labels": {"x": 1}, "transitions": {}}, "label 'x' must be a list"),
        ({"format": "other"}, "format 'other' is not known"),
        (EXPLICIT, "is no explicit-mdp-v1 file"),
        ({**EXPLICIT, "choices": [[{"name": "a", "to": [[1]], "rewards": {}}]]}, "is no explicit"),
    ],
)
def test_what_is_broken_is_refused(table, complaint):
    text = table if isinstance(table, str) else json.dumps(table)
    with pytest.raises(ModelError, match=complaint):
        parse_json(text, "roads", ["home"] if "format" not in table else ())


def test_no_goals_and_no_text(tmp_path):
    with pytest.raises(ModelError, match="does not say which states are goals"):
        stated(ROADS)
    for name, content in (
        ("a.json", b"\xff\xfe"),
        ("a.json.gz", b"\x1f\x8b no"),
        ("b.json.gz", b"{"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ModelError, match=r"is no JSON"):
            read_json(tmp_path / name, ["home"])


def test_mutated_files_give_named_errors():
    rng = random.Random(0)
    text = json.dumps({**DOCUMENT, "transitions": ROADS})
    parts = [
        "{",
        "}",
        "[",
        "]",
        '"',
        ",",
        ":",
        "null",
        "NaN",
        "1e999",
        "-1",
        '"1/0"',
        "{}",
        '"home"',
    ]
    refused = 0
    for _ in range(500):
        letters = list(text)
        for _ in range(rng.randint(1, 4)):
            place = rng.randrange(len(letters))
            letters[place : place + rng.randint(0, 9)] = [rng.choice(parts)]
        try:
            parse_json("".join(letters), "roads", (), rng.choice(["cost", None]))
        except SSPError:
            refused += 1
    assert refused > 400
