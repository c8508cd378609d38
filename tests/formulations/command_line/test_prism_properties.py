"""Properties in PRISM's words ask what the options of the command ask."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from formulations.command_line import main

ROADS = {
    "start": "depot",
    "goal": [],
    "labels": {"ok": ["home"], "crash": ["wreck"], "lost": ["woods"]},
    "transitions": {
        "depot": {
            "alley": [
                [0.90, "home", {"time": 4, "fuel": 1}],
                [0.10, "wreck", {"time": 2, "fuel": 1}],
            ],
            "road": [
                [0.99, "home", {"time": 9, "fuel": 2}],
                [0.01, "woods", {"time": 5, "fuel": 2}],
            ],
        },
        "wreck": {},
        "woods": {},
    },
}


@pytest.fixture
def model(tmp_path: Path) -> str:
    path = tmp_path / "roads.json"
    path.write_text(json.dumps(ROADS), encoding="utf-8")
    return str(path)


def answered(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main(["solve", *words, "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ('Pmax=? [F "ok"]', "--cost time --criterion maxprob"),
        ('Pmax=?[F<=3 "ok"]', "--cost time --criterion maxprob --horizon 3"),
        (
            'multi(R{"time"}min=? [F "ok"], P>=0.95 [F "ok"])',
            "--cost time --criterion mcmp --failure-budget 5%",
        ),
        (
            'multi(R{"time"}min=? [C], P>=0.9 [F "ok"], P<=0.02 [F "crash"], R{"fuel"}<=1.9 [C])',
            '--cost time --failure-budget 0.1 --limit "end(crash) <= 0.02" --limit "fuel <= 1.9"',
        ),
        (
            'multi(P>=19/20 [F "ok"], R{"fuel"} min = ? [ C ])',
            "--cost fuel --failure-budget 0.05",
        ),
        (
            'multi(Pmax=? [F "ok"], R{"time"}<=5 [C])',
            '--cost time --criterion maxprob --limit "time <= 5"',
        ),
    ],
)
def test_they_ask_the_same(
    words: str, options: str, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    import shlex

    cost = [] if "R{" in words and "Pmax" not in words else ["--cost", "time"]
    told = answered(capsys, model, *cost, "--property", words)
    wanted = answered(capsys, model, "--goal", "ok", *shlex.split(options))
    for name in ("criterion", "failure_probability", "expected_cost"):
        assert told[name] == pytest.approx(wanted[name])
    assert told["objective"] == pytest.approx(wanted["objective"])


def test_a_certain_goal_is_asked_for_at_least_cost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "walk.json"
    path.write_text('{"a": {"go": [[0.5, "b", 2], [0.5, "a", 1]]}}', encoding="utf-8")
    told = answered(capsys, str(path), "--start", "a", "--property", 'Rmin=? [F "b"]')
    assert told["objective"] == pytest.approx(3.0)
    assert told["criterion"] == "MinCost"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("multi(", "no property that is understood"),
        ('Pmax=? [G "ok"]', "no property that is understood"),
        ('Pmin=? [F "ok"]', "what is asked is Pmax=? or Rmin=?"),
        ('R{"time"}max=? [F "ok"]', "what is asked is Pmax=? or Rmin=?"),
        ('P>=0.9 [F "ok"]', "one operator must ask =?, not 0"),
        ('multi(Pmax=? [F "ok"], Rmin=? [C])', "one operator must ask =?, not 2"),
        ('multi(Rmin=? [C], P<=0.1 [F "crash"])', "one goal must be reached, not []"),
        ('multi(Rmin=? [F "ok"], P>=0.9 [F "lost"])', "one goal must be reached"),
        ('multi(Pmax=? [F "ok"], R{"fuel"}>=2 [C])', "at most so much"),
        ('multi(Pmax=? [F "ok"], P>= [F "ok"])', "a number goes with"),
        ('multi(Pmax=? [F "ok"], P>=x [F "ok"])', "'x' is no number"),
        ("multi(Rmin=? [C], P>=0.9 [C])", "a probability is one of reaching"),
        ('multi(Pmax=? [F<=3 "ok"], P>=0.5 [F "ok"])', "the same number of steps"),
        ('multi(R{"fuel"}min=? [C], P>=0.9 [F "ok"])', "--cost says something else"),
    ],
)
def test_others_are_refused(
    words: str, complaint: str, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["solve", model, "--cost", "time", "--property", words]) == 2
    assert complaint in capsys.readouterr().err
