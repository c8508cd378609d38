"""Forty mistakes that people make in a model, a question or a command, and what they are told."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from formulations import MCMP, S3P, MinCost
from formulations.command_line import main
from ssp_lp import (
    SSP,
    end_probability,
    secondary_cost,
    simulate,
    solve,
    trace_frontier,
    visits,
)

FINE: dict[str, Any] = {
    "depot": {
        "alley": [(0.9, "home", 4.0), (0.1, "wreck", 2.0)],
        "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
    },
    "wreck": {},
}


def model(table: Any = FINE, goal: Any = ("home",), **more: Any) -> SSP:
    return SSP.from_transitions(table, goal, treat_actionless_as_dead_ends=True, **more)


def with_outcome(*outcome: Any) -> dict[str, Any]:
    return {**FINE, "depot": {"road": [outcome]}}


def asked(name: str = "c", limit: Any = None, **more: Any) -> Any:
    return solve(MCMP(model(**more), "depot", 0.05, constraints={name: limit}))


PROBLEM = S3P(model(), "depot", 0.05)

IN_PYTHON: list[tuple[Callable[[], Any], str]] = [
    (lambda: exec("from ssp_lp import mcpm"), "did you mean 'MCMP'"),
    (lambda: model(goal=()), "the model has no goal state; name at least one"),
    (lambda: model(goal="home"), "goal must be a set of states, such as {'home'}"),
    (lambda: model(goal=("hom",)), "did you mean 'home'?"),
    (lambda: model(goal=("home", "depott")), "did you mean 'depot'?"),
    (lambda: SSP.from_transitions(FINE, ("home",)), "list all dead-ends, dead_ends={...}"),
    (
        lambda: SSP.from_transitions({"a": {"go": [(1.0, "hoem", 1.0)]}, "home": {}}, ("home",)),
        "leads to 'hoem', which is neither a state of the model nor a goal; did you mean 'home'?",
    ),
    (lambda: model(with_outcome("0.9", "home", 1.0)), "a probability that is no number: '0.9'"),
    (lambda: model(with_outcome(1.0, "home", "4")), "a cost that is no number: '4'"),
    (lambda: model(with_outcome(0.9, "home", 1.0)), "probabilities sum to 0.9, not to 1"),
    (lambda: model(with_outcome(1.0, "home", -1.0)), "rewards? pass costs=-rewards"),
    (lambda: model(with_outcome(1.0, ["home"], 1.0)), "a state holds no list, dict or set"),
    (lambda: model(with_outcome(1.0, "home")), "an outcome must be a triple"),
    (lambda: model({"depot": [(1.0, "home", 1.0)]}), "needs a dict {action:"),
    (lambda: model([("depot", "home")]), "a model is told as {state: {action:"),
    (lambda: model(state_labels={"crash": ["wrek"]}), "did you mean 'wreck'?"),
    (lambda: model(state_labels={"crash": "wreck"}), "labels['crash'] must be a set of"),
    (lambda: model(state_labels={"goal": ["home"]}), "state label 'goal' is taken"),
    (lambda: MCMP(model(), "depo", 0.05), "did you mean 'depot'?"),
    (lambda: MCMP(model(), "depot", "5%"), "failure_budget must be a number or None, not '5%'"),
    (lambda: MCMP(model(), "depot", 0.05, give_up="never"), "'dead_ends'"),
    (lambda: solve(MCMP(model(), "depot", 0.001)), "fails with probability at least 0.01"),
    (lambda: solve(MinCost(model(), "depot")), "no policy reaches the goal surely"),
    (lambda: solve(MCMP(model(), "depot", 0.05), "simplex"), "method"),
    (lambda: solve(PROBLEM, time_limit="5"), "time_limit must be a number of seconds"),
    (lambda: asked(limit=visits("wrek") <= 0.1), "did you mean 'wreck'?"),
    (lambda: asked(limit=end_probability("crash") <= 0.1), "'crash'"),
    (lambda: asked(limit=secondary_cost("fuel") <= 1), "the model has no cost 'fuel'"),
    (lambda: asked(limit=secondary_cost({"depot": {"rode": 1.0}}) <= 1), "did you mean 'road'?"),
    (lambda: asked(limit=0.5), "c"),
    (lambda: trace_frontier(PROBLEM, over="crash"), "'failure' or the name of a limit"),
    (lambda: simulate(solve(PROBLEM).policy, MCMP(model(), "depot"), seed=1), "another model"),
    (lambda: SSP.from_frame({"state": ["a"]}, ("b",)), "the table has no column 'successor'"),
]  # fmt: skip


@pytest.mark.parametrize(("mistake", "told"), IN_PYTHON, ids=[told for _, told in IN_PYTHON])
def test_a_mistake_in_python_is_named(mistake: Callable[[], Any], told: str) -> None:
    with pytest.raises(Exception) as error:  # noqa: PT011 (which one is the point of the words)
        mistake()
    assert told in str(error.value)
    own = type(error.value).__module__ == "ssp_lp.errors"
    assert own or isinstance(error.value, ImportError)


IN_A_SHELL = [
    ("sovle roads.json", "'sovle'"),
    ("solve roads.json --goal hoem --start depot", "did you mean 'home'?"),
    ("solve roads.json --start depot", "--goal"),
    ("solve roads.json --goal home", "--start"),
    ("solve roads.json --goal home --start depo", "did you mean 'depot'?"),
    ("solve raods.json --goal home", "raods.json"),
    ("solve roads.txt --goal home", "ends in none of"),
    ("solve roads.json --goal home --start depot --criterion mcpm", "'mcpm'"),
    ("solve roads.json --goal home --start depot --failure-budget 5", "did you mean 0.05?"),
    ("solve roads.json --goal home --start depot --failure-budget five", "'five' is no number"),
    ("solve roads.json --goal home --start depot --criterion cvar", "cvar needs --level"),
    (
        "solve roads.json --goal home --start depot --criterion maxprob --level 1/2",
        "takes no --level",
    ),
    ("solve roads.json --goal home --start depot --limit fuel", "a limit is a quantity"),
    ("solve roads.json --goal home --start depot --limit 'cost <= much'", '"much"'),
    ("solve roads.json --goal home --start depot --limit 'fuel <= 3'", "'fuel'"),
    ("solve roads.json --goal home --start depot --limit 'end(crash) <= 0'", "'crash'"),
    ("solve roads.json --goal home --start depot --policy-out plan.txt", ".npz"),
    ("solve roads.json --goal home --start depot --plot law.txt", "png"),
    ("solve roads.json --goal home --start depot --property 'P=? [X a]'", "is no property that is"),
    (
        "frontier roads.json --goal home --start depot --over crash",
        "'failure' or the name of a limit",
    ),
    ("solve roads.json --goal home --start depot --failure-budget 0.001", "at least 0.01"),
    ("simulate roads.json --goal home --start depot", "--policy"),
    ("slove roads.json", "there is no 'slove'; did you mean 'solve'?"),
    ("solve roads.json --criterion mcpm", "did you mean 'mcmp'?"),
    ("solve roads.json --criterion xyz", "choose from alpha-mcmp, "),
    ("solve roads.json --budget 0.05", "no --budget; did you mean --failure-budget?"),
    ("solve roads.json --epsilon=0.05", "no --epsilon; did you mean --failure-budget?"),
    ("solve roads.json --gamma 0.9", "did you mean --discount?"),
    ("solve roads.json --metod lp", "did you mean --method?"),
    ("simulate roads.json --policy p.npz --runs 3", "did you mean --episodes?"),
    ("solve roads.json home", "'home' is one word too many"),
    ("solve roads.json --failure_budget 0.1", "did you mean --failure-budget?"),
    ("program roads.json --criterion cvar", "choose from alpha-mcmp"),
    *(
        (f"{verb} roads.json --goal home --start depot {words}", told)
        for verb, words, told in (
            ("solve", "--limit 'fuel <= 3'", "quantities are 'cost', 'goal'"),
            ("solve", "--limit 'costs <= 3'", "did you mean 'cost'?"),
            ("solve", "--limit 'visit(depot) <= 3'", "did you mean 'visits(...)'?"),
            ("solve", "--cost fuel", "leave out --cost"),
            ("explore", "--out page.png", "a page is written as .html"),
            ("solve", "--criterion least-quantity --quantity fuel", "'fuel' is no quantity of"),
            ("solve", "--dead-ends wrek", "did you mean 'wreck'?"),
        )
    ),
]


@pytest.mark.parametrize(("words", "told"), IN_A_SHELL, ids=[words for words, _ in IN_A_SHELL])
def test_a_mistake_in_a_shell_is_told_in_one_line(
    words: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    import shlex

    monkeypatch.chdir(tmp_path)
    for name in ("roads.json", "roads.txt"):
        Path(name).write_text(json.dumps(FINE), encoding="utf-8")
    try:
        code = main(shlex.split(words))
    except SystemExit as ended:
        code = int(str(ended.code))
    printed = capsys.readouterr()
    assert code in (2, 3)
    assert printed.out == ""
    assert told in printed.err
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("ssp-lp")


def test_costs_that_are_all_zero_are_told() -> None:
    free = {"a": {"go": [(0.9, "home", 0.0), (0.1, "wreck", 0.0)]}, "wreck": {}}
    told = solve(MCMP(model(free), "a", 0.2)).summary()
    assert "every step costs 0" in told
    assert "every step costs 0" not in solve(PROBLEM).summary()
