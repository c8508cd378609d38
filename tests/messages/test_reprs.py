"""What a person prints: short, without arrays, and true."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from html.parser import HTMLParser

import numpy as np
import pytest

from formulations import (
    GUBS,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostLimit,
    MaxProb,
    MinProb,
    compare_criteria,
)
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    Formulation,
    MixedPolicy,
    Solution,
    certify,
    cross_check,
    evaluate,
    secondary_cost,
    simulate,
    solve,
    solve_many,
    trace_frontier,
    visits,
)
from ssp_lp.analysis.evaluation import giving_up_in_words
from ssp_lp.game import stationary_game

MODEL = model_of(
    {
        "s": {
            "go": [(0.9, "g", 4.0), (0.04, "pit", 1.0), (0.06, "wall", 1.0)],
            "round": [(0.99, "g", 9.0), (0.01, "wall", 1.0)],
            "loop": [(1.0, "s", 1.0)],
        },
        "pit": {},
        "wall": {},
    },
    labels={"crash <b>": ["wall"]},
)
PROBLEM = MCMP(MODEL, "s", failure_budget=0.3)


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve(PROBLEM)


def failing_line(solution: Solution) -> str:
    lines = [line for line in solution.summary().splitlines() if line.startswith("  failing")]
    assert len(lines) <= 1
    return lines[0].removeprefix("  failing").strip() if lines else ""


def test_the_summary_says_how_the_policy_fails(solution: Solution) -> None:
    ends = solution.evaluation.ends
    told = failing_line(solution)
    assert ends["gave_up"] > 0.2
    for word in ("crash <b>", "dead-end", "gave up"):
        name = {"dead-end": "dead_end", "gave up": "gave_up"}.get(word, word)
        assert f"{word} {ends[name]:.6g}" in told
    assert "wandering" not in told
    gave_up = f"{ends['gave_up']:.6g} by choice, before the first step; give_up='dead_ends' forbids"
    assert gave_up in solution.summary()
    assert failing_line(solve(MaxProb(MODEL, "s"))) == "crash <b> 0.01"


def test_who_never_fails_has_no_line_for_it() -> None:
    sure = SSP.from_transitions({"s": {"go": [(1.0, "g", 2.0)]}}, goal={"g"})
    assert failing_line(solve(MCMP(sure, "s", 0.5))) == ""
    assert failing_line(solve(MinProb(MODEL, "s"))).startswith(("gave up 1", "wandering 1"))


def test_one_policy_is_called_no_lottery(solution: Solution) -> None:
    assert "lottery over 2 (" in solution.summary()
    alone = solve(MCMP(MODEL, "s"))
    assert len(alone.policy.policies) == 1
    assert "no lottery" in alone.summary()


def test_giving_up_later_is_no_giving_up_at_the_start() -> None:
    model = model_of(
        {
            "s": {"on": [(0.5, "g", 1.0), (0.5, "t", 1.0)]},
            "t": {"far": [(1.0, "g", 50.0)], "stay": [(1.0, "t", 1.0)]},
        }
    )
    later = solve(MCMP(model, "s", 0.2))
    assert failing_line(later) == "gave up 0.2"
    assert "0.2 by choice, first in 't'; give_up='dead_ends' forbids it" in later.summary()
    assert "giving up" not in solve(MCMP(model, "s", 0.2, give_up="dead_ends")).summary()
    policy = DeterministicPolicy.from_actions(model, {"s": "on", "t": GIVE_UP})
    problem = MCMP(model, {"s": 0.5, "t": 0.5}, 0.9)
    told = giving_up_in_words(MixedPolicy((policy,), np.ones(1)), problem, 0.75)
    assert told == "0.5 of it before the first step"


def test_wandering_is_told() -> None:
    policy = DeterministicPolicy.from_actions(MODEL, {"s": "loop"})
    assert "wandering 1" in repr(evaluate(policy, PROBLEM))


def test_reprs_are_short(solution: Solution) -> None:
    policy = solution.policy
    assert repr(solution).startswith("Solution(MCMP, failure budget 0.3, exact: objective ")
    assert repr(policy).startswith("MixedPolicy(2 members: ")
    many = MixedPolicy(tuple(policy.policies[:1] * 50), np.full(50, 0.02))
    assert repr(many).endswith("+ ...)")
    assert repr(certify(solution)).startswith("Certificate(verdict accepted, objective ")
    found = [
        solution,
        policy,
        many,
        policy.policies[0],
        solution.evaluation,
        certify(solution),
        simulate(policy, PROBLEM, seed=0, episodes=100, record=100),
        PROBLEM,
        MODEL,
        compare_criteria(MODEL, "s"),
        cross_check(PROBLEM),
        solution.randomised_policy,
    ]
    for one in found:
        assert "\n" not in repr(one)
        assert "array" not in repr(one)
        assert len(repr(one)) < 400, repr(one)


def test_a_frontier_lists_five_points_at_most() -> None:
    text = str(trace_frontier(PROBLEM))
    assert " points, failure " in text.splitlines()[0]
    steep = model_of(
        {"s": {k: [(k / 20, "g", k * k), (1 - k / 20, "d", 0.0)] for k in range(20)}, "d": {}}
    )
    frontier = trace_frontier(MCMP(steep, "s"))
    lines = str(frontier).splitlines()
    assert len(frontier.failure) > 5
    assert len(lines) == 7
    assert lines[1].split() == ["failure", "goal", "cost", "objective", "price"]
    assert f"{frontier.failure[0]:.6g}" in lines[2]
    assert f"{frontier.failure[-1]:.6g}" in lines[-1]


def test_programs_and_measures_read_like_a_page() -> None:
    program = PROBLEM.program()
    assert repr(program).startswith("MCMP, failure budget 0.3\n  minimise")
    assert repr(program.solve()).startswith("objective ")


def test_problems_say_what_was_stated() -> None:
    fuel = secondary_cost({"s": {"go": 2.0}}) + 2 * visits("wall") + 1 <= 3.5
    size = repr(MODEL)
    for problem, told in (
        (PROBLEM, f"MCMP({size}, start='s', failure_budget=0.3)"),
        (MCMP(MODEL, {"s": 1.0}), f"MCMP({size}, start={{'s': 1.0}})"),
        (MCMP(MODEL, "s", give_up="anywhere"), f"MCMP({size}, start='s', give_up='anywhere')"),
        (AlphaMCMP(MODEL, "s", 0.8), f"AlphaMCMP({size}, start='s', reach_fraction=0.8)"),
        (
            S3P(MODEL, "s", 0.3, constraints={"fuel": fuel}),
            f"S3P({size}, start='s', failure_budget=0.3, constraints={{'fuel': "
            "secondary_cost(...) + 2 * visits('wall') + 1 <= 3.5})",
        ),
        (
            ConstrainedCost(MODEL, "s", {"f": CostLimit(np.ones(MODEL.n_pairs), 3.0)}),
            f"ConstrainedCost({size}, start='s', limits={{'f': CostLimit(bound=3.0)}})",
        ),
        (GUBS(MODEL, "s", np.exp, 3.0), f"GUBS({size}, start='s', utility=<exp>, goal_bonus=3.0)"),
    ):
        assert repr(problem) == told


@dataclass(frozen=True, eq=False)
class Own(Formulation):
    """A criterion with words of its own."""

    model: SSP
    start: str
    weight: float = 1.0


@dataclass(frozen=True, eq=False)
class Worded(Own):
    """A criterion with a repr of its own."""

    def __repr__(self) -> str:
        return "worded"


@dataclass(frozen=True, eq=False)
class WordedToo(Worded):
    """One that inherits it."""


def test_criteria_of_ones_own_have_the_short_repr_or_theirs() -> None:
    assert repr(Own(MODEL, "s")) == f"Own({MODEL!r}, start='s')"
    assert repr(Own(MODEL, "s", 2.5)) == f"Own({MODEL!r}, start='s', weight=2.5)"
    assert repr(Worded(MODEL, "s")) == repr(WordedToo(MODEL, "s")) == "worded"


def test_a_long_start_is_counted_not_listed() -> None:
    model = SSP.from_transitions({k: {"go": [(1.0, "g", 1.0)]} for k in range(50)}, goal={"g"})
    assert "start=<dict of 50>" in repr(MCMP(model, dict.fromkeys(range(50), 0.02)))


class Tags(HTMLParser):
    """Counts opened and closed tags."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: set[str] = set()

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)
        self.seen.add(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_notebooks_show_escaped_tables(solution: Solution) -> None:
    limited = MCMP(MODEL, "s", 0.3, constraints={"<i> & co": visits("pit") <= 0.5})
    compared = compare_criteria(MODEL, "s", penalties=())
    program, check = limited.program(), cross_check(PROBLEM)
    for shown in (solution, MODEL, trace_frontier(PROBLEM), compared, program, check):
        tags = Tags()
        tags.feed(shown._repr_html_())
        assert tags.open == []
        assert tags.seen <= {"table", "caption", "tr", "th", "td", "pre", "p"}
    assert "crash &lt;b&gt;" in solution._repr_html_()
    assert "&lt;i&gt; &amp; co" in program._repr_html_()
    assert "MinCost" in compared._repr_html_()
    assert "columns" in check._repr_html_()


def test_a_policy_that_gives_up_is_described() -> None:
    policy = DeterministicPolicy.from_actions(MODEL, {"s": GIVE_UP})
    assert "gives up in 1" in repr(policy)


def test_every_report_has_a_summary() -> None:
    solution = solve(PROBLEM)
    reports = [
        solution,
        evaluate(solution.policy, PROBLEM),
        simulate(solution.policy, PROBLEM, episodes=100, seed=0),
        certify(solution),
        cross_check(PROBLEM),
        trace_frontier(PROBLEM),
        solve_many([PROBLEM], executor=ThreadPoolExecutor(1)),
        PROBLEM.program().solve(),
    ]
    for report in reports:
        lines = report.summary().splitlines()
        assert len(lines) >= 2
        assert max(map(len, lines)) <= 200


def test_an_optimum_of_the_game_prints_in_one_line():
    problem = MCMP(MODEL, "s", 0.05, discount=0.99)
    found = stationary_game(problem)
    assert repr(found).startswith(f"GameSolution(c* {found.objective:.9g}, lower bound ")
    assert len(repr(found)) <= 200
    assert found.summary().splitlines()[2].split() == ["alpha*", f"{found.alpha:.6g}"]
