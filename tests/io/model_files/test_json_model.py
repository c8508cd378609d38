"""Models in JSON: three forms, read and written; what is broken is refused by name."""

import gzip
import json
from fractions import Fraction

import numpy as np
import pytest

from cases import FOLDER, PUBLISHED, published
from formulations import MCMP
from refusing import refused
from small_models import model_of
from ssp_lp import SSP, solve
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


def check_the_same(one, other):
    for name in ("successors", "probabilities", "costs", "goal_mask", "pair_offsets"):
        assert np.array_equal(getattr(one, name), getattr(other, name))
    assert one.exact_costs == other.exact_costs


def test_a_table_and_a_document_say_the_same():
    table = stated(ROADS, "home", cost="cost")
    document = stated({**DOCUMENT, "transitions": ROADS}, cost="cost")
    assert (table.start, document.start) == (None, "depot")
    assert list(document.model.state_labels) == ["end", "crash"]
    check_the_same(table.model, document.model)
    refused("does not list the goal states", stated, ROADS)


def test_costs_by_name():
    roads = {"depot": {"alley": [[1, "home", {"cost": 4, "fuel": "1/3"}]]}}
    assert stated(roads, "home", cost="fuel").model.exact_costs == {1 / 3: Fraction(1, 3)}
    assert stated(roads, "home", cost="unit").model.costs.tolist() == [1.0]
    for wrong in (None, "oil"):
        words = r"choose one of the costs .*: 'cost', 'fuel'"
        refused(words, stated, roads, "home", cost=wrong)
    path = FOLDER / "models" / "prism_attacktree.json.gz"
    for cost, hint in ((None, "each step$"), ("sucess", "not 'sucess'; did you mean 'success'")):
        words = rf"gz: choose .*'cost', 'success', or 'unit'.*{hint}"
        refused(words, read_json, path, (), cost)
    assert set(read_json(path, (), "unit").model.costs) == {1.0}


def test_a_named_cost_may_be_called_like_the_unit():
    """What the file states is read; 1 a step is what stands for it where nothing is stated."""
    table = {
        "a": {"go": [[1.0, "b", {"unit": 5, "time": 2}]]},
        "b": {"on": [[1.0, "g", {"time": 3}]]},
    }
    found = stated(table, "g", cost="unit").model
    assert found.costs.tolist() == [5.0, 1.0]
    assert stated(table, "g", cost="time").model.costs.tolist() == [2.0, 3.0]
    assert stated({"a": table["a"]}, "b", cost="unit").model.costs.tolist() == [5.0]


def test_a_published_cost_is_read():
    model, start = published("prism_robot_goal1", "time")
    found = read_json(FOLDER / "models" / "prism_robot_goal1.json.gz", (), "time")
    mine, theirs = (
        solve(MCMP(*one, **PUBLISHED)).objective
        for one in ((model, start), (found.model, found.start))
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
    check_the_same(model, again.model)
    named = {word: at.tolist() for word, at in model.state_labels.items()}
    assert {word: at.tolist() for word, at in again.model.state_labels.items()} == named
    assert list(named) == ["first"]
    assert list(again.model.states) == [str(state) for state in model.states]


@pytest.mark.parametrize(
    ("table", "goal", "words"),
    [
        ({1: {"a": [(1.0, "1", 1.0)]}}, "1", "two states"),
        ({0: {1: [(1.0, 2, 1.0)], "1": [(1.0, 2, 1.0)]}}, 2, "two actions of state '0'"),
    ],
)
def test_names_that_read_the_same_are_refused(table, goal, words):
    refused(words, lambda: list(model_in_json(SSP.from_transitions(table, goal=[goal]))))


EXPLICIT = {"format": "explicit-mdp-v1", "init": 0, "goal": [1]}


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ("{", "is not JSON"),
        pytest.param("[" * 100_000, "is not JSON", id="nested-too-deeply"),
        ([1], "must contain"),
        ({"a": [1]}, "state 'a' needs"),
        ({"a": {"go": [[1, "home"]]}}, "action 'go' of state 'a'"),
        ({"a": {"go": [[1, ["home"], 1]]}}, "action 'go' of state 'a'"),
        ({"a": {"go": [[1, "hoem", 1]]}}, "did you mean 'hoem'"),
        ({"a": {"go": [[1, "home", "x"]]}}, "not a number"),
        ({"a": {"go": [[1, "home", "1/0"]]}}, "not a number"),
        ({"a": {"go": [[1, "home", -1]]}}, "negative cost"),
        ('{"a": {"go": [[1, "home", 1]]}, "a": {}}', "'a' occurs twice"),
        ({"goal": [], "transitions": []}, "'transitions' must be an object"),
        ({"goal": [], "labels": {"x": 1}, "transitions": {}}, "label 'x' must be a list"),
        ({"format": "other"}, "format 'other' is unknown"),
        (EXPLICIT, "is no explicit-mdp-v1 file"),
        ({**EXPLICIT, "choices": [[{"name": "a", "to": [[1]], "rewards": {}}]]}, "is no explicit"),
    ],
)
def test_what_is_broken_is_refused(table, complaint):
    text = table if isinstance(table, str) else json.dumps(table)
    refused(complaint, parse_json, text, "roads", ["home"] if "format" not in table else ())


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.json", b"\xff\xfe"), ("a.json.gz", b"\x1f\x8b no"), ("b.json.gz", b"{")],
)
def test_what_is_no_text_is_no_json(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    refused("is not? JSON", read_json, tmp_path / name, ["home"])
