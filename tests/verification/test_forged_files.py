"""Files that claim too much, or are strange, are refused by name."""

from __future__ import annotations

import gzip
import json
import tracemalloc
from fractions import Fraction
from hashlib import sha256
from time import process_time

import pytest

from forged import COST, DEAD, GOAL, NOTHING, SPENT, proof, state, verdict
from ssp_lp import check_certificate
from ssp_lp.verification import certificate_lines, prove
from ssp_lp.verification.prove import EXCESS

STEP = state(go=([["1", 1], ["0", 0]], ["1"]))  # of cost 1, to the goal
CHOICE = state(safe=([["1", 1]], ["10"]), risky=([["1", 1], ["1", 2]], ["1"]))
RISK = state(risky=([["1", 1], ["1", 2]], ["1"]))
DETOUR = state(short=([["1", 2]], ["10"]), long=([["1", 1]], ["0"]))  # at no less cost
ONWARD = state(go=([["1", 2]], ["10"]))
LOOP = state(stay=([["1", 0]], ["0"]), go=([["1", 1]], ["5"]))
WAY = [state(on=([["1", 1]], ["5"])), state(on=([["1", 2]], ["5"])), GOAL]  # of cost 10
SAFE = [0, "10", [0, 0, 2, "10", "0"]], [1, "10", [0, 0, 1, "10", "0"]]


def said(path, states, *proofs, **asked):
    """What is proved, or the reason of a refusal."""
    checked = verdict(path, states, *proofs, **asked)
    return (checked.lower, checked.upper) if checked.accepted else checked.reason


# The truth, as honest files prove it.


def one_step(v="1", u="1", ratio=None, **head):
    """A proof of one step to the goal, for 1."""
    head |= {} if ratio is None else {"ratio": ratio, "prices": ["1"]}
    return proof([0, v, [0, 0, 2, u, "0"]], [1, v, [0, 0, 1, u, "0"]], **head)


def risky(price="0", v="1", fails="1", *taken, **head):
    """A proof of cost 1 with a failure of 1/2, in units of 1/2; the cost in case S is 2."""
    own, prices = [0, 1, 2, "2", fails, *taken], [price, *("0" for _ in taken)]
    begin = [0, v, [0, 0, 4, "2", fails, *taken]]
    return proof(begin, [1, v, own], unit=2, prices=prices, **head)


def choosing(price="0", v="1", **head):
    """A proof of a choice whose lottery is half safe and half risky."""
    begin = [0, v, [0, 0, 4, "2", "1"], [1, 0, 2, "20", "0"]]
    node = [1, v, [0, 1, 2, "2", "1"], [1, 0, 1, "20", "0"]]
    head = {"weights": ["1/2", "1/2"], "prices": [price], "unit": 2, **head}
    return proof(begin, node, **head)


def way(slope=1):
    """A proof of two steps of 5, charged so much each, from a cap of 0 on; in case S."""
    one, half, all_of_it = str(slope), str(5 * slope), str(10 * slope)
    begin, first = ([i, all_of_it, [0, 0, t, all_of_it, "0"]] for i, t in ((0, 12), (1, 9)))
    rest = [2, half, [0, 0, 1, half, "0"]], [5, one, [0, 0, 1, one, "0"]]
    return proof(begin, first, *rest, prices=[all_of_it], ratio=all_of_it)


def half_a_way():
    """The same where what exceeds the cap is given up for nothing, at which the goal is reached."""
    begin = [0, "5", [0, 0, 12, "5", "0"]]
    first, second = [1, "5", [0, 0, 9, "5", "0"]], [2, "5", [0, 0, 1, "5", "0"]]
    return proof(begin, first, second, [5, "0", [0, 1, 1, "0", "0"]], prices=["5"], ratio="5")


@pytest.mark.parametrize(
    ("states", "proofs", "asked", "known"),
    [
        ([STEP, GOAL], [one_step()], {}, (1, 1)),
        ([STEP, GOAL], [one_step(ratio="1")], {"ratio": True}, (1, 1)),
        ([CHOICE, GOAL, DEAD], [choosing(v="2", weights=["1", "0"])], {}, (1, 1)),
        ([CHOICE, GOAL, DEAD], [risky("2", "4", ratio="2")], {"ratio": True}, (2, 2)),
        (WAY, [way()], {"ratio": True, "charge": SPENT, "objective": NOTHING}, (10, 10)),
        ([state(on=([["1", 1]], ["1"])), state(on=([["1", 2]], ["1"])), GOAL],
         [proof([0, "2", [0, 0, 4, "2", "0"]], [1, "2", [0, 0, 3, "2", "0"]],
                *([i, "1", [0, 0, 1, "1", "0"]] for i in (2, 5)), prices=["2"], ratio="2")],
         {"ratio": True, "charge": SPENT, "objective": NOTHING}, (2, 2)),
        ([state(go=([["1", 1]], ["3", "7"])), GOAL],
         [proof(*([i, "3", [0, 0, t, "3", "0"]] for i, t in ((0, 2), (5, 1))),
                prices=["3"], ratio="3", cap="4")],
         {"ratio": True, "charge": SPENT, "objective": NOTHING, "costs": 2}, (3, 3)),
        (WAY, [way(3)], {"ratio": True, "charge": [[">=", "0", "0", "3"]], "objective": NOTHING},
         (30, 30)),
        (WAY, [proof(*([i, "12", [0, 0, t, "12", "0"]] for i, t in ((0, 3), (2, 1), (7, 2))),
                     prices=["12"], ratio="12", cap="5")],
         {"ratio": True, "charge": [[">=", "0", "0", "0"], [">=", "4", "0", "2"]],
          "objective": NOTHING}, (12, 12)),
        ([LOOP, GOAL, DEAD], [proof([0, "5", [0, 0, 2, "5", "0"]], [1, "5", [0, 1, 1, "5", "0"]])],
         {"failure": "0", "start": [["2", 0], ["0", 2]]}, (5, 5)),
    ],
)  # fmt: skip
def test_honest_files_prove_what_is_true(states, proofs, asked, known, tmp_path):
    assert said(tmp_path / "x", states, *proofs, **asked) == known


# What would be proved of these if the inequality were not asked for is false.


TOTALS = {"ratio": True, "charge": SPENT, "objective": NOTHING}
HALF = {"ratio": True, "quantile": "1/2", "objective": NOTHING}


def counting(*term):
    """A quantity of one term."""
    return {"constant": "0", "terms": [list(term)]}


def staying(t=1):
    """A member that stays for ever, where that does not count as waiting."""
    begin, node = [0, "0", [0, 0, t + 1, "0", "0"]], [1, "0", [0, 0, t, "0", "0"]]
    return proof(begin, node)


def arriving(value, ratio, cap="2"):
    """A proof of a charge of one step of cost 1, from a node below the cap on."""
    lines = [[i, value, [0, 0, t, value, "0"]] for i, t in ((0, 2), (3, 1))]
    return proof(*lines, cap=cap, ratio=ratio, prices=[ratio])


SHARED = state(
    safe=([["9", 1], ["1", 2]], ["10"]), risky=([["1", 1], ["1", 2]], ["0"]),
)  # fmt: skip


def sharing(weights, least="-18"):
    """A share of 9/10 of a goal that is reached with 9/10 for 10, or with 1/2 for nothing.

    Units are 1/20; the first program has -P(goal) and 1 in its place.
    """
    first = proof([0, least, [0, 0, 2, "-18", "2"]], [1, least, [0, 0, 1, "-18", "2"]], unit=20)
    begin = [0, "250", [0, 0, 2, "200", "2"], [1, 0, 2, "0", "10"]]
    node = [1, "250", [0, 0, 1, "200", "2"], [1, 1, 1, "0", "10"]]
    return [first, proof(begin, node, unit=20, weights=weights, prices=["25"])]


FORGED = {
    "a negative price": (
        [CHOICE, GOAL, DEAD], [risky("-100", "-98", "1", "2")],
        {"rows": [{"name": "time", "quantity": COST, "at_most": "9"}]}, "prices are >= 0",
    ),
    "a price too few": ([STEP, GOAL], [one_step(prices=[])], {}, "0 prices of 1 rows"),
    "negative weights": (
        [CHOICE, GOAL, DEAD], [choosing(weights=["2", "-1"])], {}, "weights are >= 0",
    ),
    "weights of less than 1": ([STEP, GOAL], [one_step(weights=["1/2"])], {}, "weights are >= 0"),
    "no weights": ([STEP, GOAL], [proof([0, "1"], [1, "1"], weights=[])], {}, "weights are >= 0"),
    "values": ([STEP, GOAL], [one_step("2")], {}, "v <= c + sum a v at 1 go fails"),
    "no values ahead": ([STEP, GOAL], [proof([0, "9", [0, 0, 2, "1", "0"]],
                        [1, None, [0, 0, 1, "1", "0"]])], {}, "v is stated after 0 begin"),
    "no values": ([STEP, GOAL], [one_step(None)], {}, "v is stated of the beginning"),
    "a lottery that fails to begin": ([STEP, GOAL], [proof([0, "1"], [1, "1"])], {}, "begins"),
    "values of what is no node": (
        [STEP, GOAL], [proof(*one_step()[1:], [2, "1"])], {}, "each node of the proof has columns",
    ),
    "no decision ahead": ([STEP, GOAL], [proof([0, "1", [0, 0, 2, "1", "0"]], [1, "1"])], {},
                          "decides at each successor"),
    "a decision that there is not": (
        [STEP, GOAL], [proof([0, "1", [0, 0, 2, "0", "0"]], [1, "1", [0, 1, 1, "0", "0"]])], {},
        "member 0 decides on a column at 1 fails",
    ),
    "a row that its constant breaks": (
        [STEP, GOAL],
        [proof([0, "1", [0, 0, 2, "1", "0", "1"]], [1, "1", [0, 0, 1, "1", "0", "1"]],
               prices=["0", "0"])],
        {"rows": [{"name": "r", "quantity": {**COST, "constant": "1"}, "at_most": "1"}]},
        "bound of row r fails by 1.0",
    ),
    "a horizon that some do not see": (
        [state(go=([["1", 0], ["1", 1]], ["1"])), GOAL],
        [proof([0, "0", [0, 0, 4, "2", "1", "0"]], [1, "0", [0, 0, 2, "2", "1", "0"]],
               unit=2, prices=["0", "0"])],
        {"horizon": 1, "rows": [{"name": "late", "quantity": counting("1", "end", "out of time"),
                                 "at_most": "0"}]},
        "member 0 at 1 go u >= c + sum a u",
    ),
    "waiting where the second cost counts": (
        [state(stay=([["1", 0]], ["0", "4"]), go=([["1", 1]], ["0", "5"])), GOAL],
        [proof([0, "0", [0, 0, 2, "0", "1"]], [1, "0", [0, 2, 1, "0", "1"]])],
        {"costs": 2, "objective": counting("1", "cost", 1)},
        "member 0 decides on a column at 1 fails",
    ),
    "waiting where visits count": (
        [{**LOOP, "sets": ["s"]}, GOAL],
        [proof([0, "0", [0, 0, 2, "0", "1", "1"]], [1, "0", [0, 2, 1, "0", "1", "0"]],
               prices=["0", "0"])],
        {"sets": ["s"], "rows": [{"name": "n", "quantity": counting("1", "visits", "s"),
                                  "at_most": "1"}]},
        "member 0 decides on a column at 1 fails",
    ),
    "a policy without an end": ([LOOP, GOAL], [staying()], {"failure": "0"}, "t >= 1 + sum a t"),
    "a cost": ([STEP, GOAL], [one_step(u="0")], {}, "u >= c + sum a u"),
    "a cost of the second member": (
        [DETOUR, ONWARD, GOAL],
        [proof([0, "0", [0, 0, 2, "10", "0"], [1, 0, 4, "0", "0"]],
               [1, "0", [0, 0, 1, "10", "0"], [1, 1, 3, "0", "0"]], [2, "0", [1, 0, 2, "0", "0"]],
               weights=["0", "1"])],
        {}, "member 1 at 2 go u >= c + sum a u",
    ),
    "a failure": ([CHOICE, GOAL, DEAD], [risky(v="2", fails="0")], {}, "u >= c + sum a u"),
    "a broken budget": (
        [CHOICE, GOAL, DEAD], [risky(v="2")], {"failure": "1/4"}, "bound of row failure fails by",
    ),
    "a budget that is broken by 1.5e-24 of itself": (
        [CHOICE, GOAL, DEAD], [risky(v="2")], {"failure": f"0.4{23 * '9'}25"},
        "bound of row failure",
    ),
    "what exceeds the cap": (WAY, [half_a_way()], {**TOTALS, "give_up": "anywhere"}, "as at 2"),
    "a ratio above the price": (
        [CHOICE, GOAL, DEAD], [risky("2", "4", ratio="3")], {"ratio": True}, "price of failure >=",
    ),
    "a ratio above the truth": (
        [CHOICE, GOAL, DEAD], [risky("3", "5", ratio="3")], {"ratio": True}, "objective >= ratio",
    ),
    "a ratio of no goal": (
        [RISK, GOAL, DEAD],
        [proof([0, "0", [0, 0, 2, "1" + 25 * "0", "1" + 24 * "0" + "1"]],
               [1, "0", [0, 0, 1, "1" + 25 * "0", "1" + 24 * "0" + "1"]],
               unit=10**25, ratio="0")],
        {"ratio": True}, "needed: the lottery reaches the goal",
    ),
    "a ratio at a failure of 1": (
        [CHOICE, GOAL, DEAD],
        [proof([0, "3", [0, 0, 2, "10", "0"]], [1, "3", [0, 0, 1, "10", "0"]],
               prices=["5"], ratio="3")],
        TOTALS, "objective >= ratio",
    ),
    "a quantile that is exceeded": (
        [STEP, GOAL],
        [proof(*([i, "-1", [0, 0, t, "-1", "0"]] for i, t in ((0, 2), (1, 1)))),
         *[arriving("1", "1", "3/2")] * 2],
        {**HALF, "answer": "1/2", "failure": "least"}, "exceeds the quantile rarely enough",
    ),
    "a quantile that the total stays below just as often": (
        [state(go=([["1", 1], ["1", 1]], [["1", "10"]])), GOAL],
        [arriving("0", "0", "11"),
         proof(*([i, "1", [0, 0, t, "1", "0"]] for i, t in ((0, 2), (3, 1))),
               unit=2, cap="11", prices=["1/2"], ratio="1/2")],
        {**HALF, "answer": "10"}, "no lottery stays below the quantile often enough",
    ),
    "a quantile that is above the truth": (
        [STEP, GOAL], [arriving("0", "0"), arriving("0", "0")], {**HALF, "answer": "3/2"},
        "no lottery stays below the quantile often enough",
    ),
    "a quantile that a lottery attains by exceeding a row": (
        [state(fast=([["1", 1], ["1", 2]], ["1"]), slow=([["1", 1]], ["10"])), GOAL, DEAD],
        [proof([0, "0", [0, 0, 2, "0", "1"], [1, 0, 2, "2", "0"]],
               [4, "0", [0, 0, 1, "0", "1"], [1, 1, 1, "2", "0"]],
               unit=2, weights=["1/2", "1/2"], cap="2", ratio="0"),
         proof([0, "1", [0, 0, 2, "1", "0"]], [4, "1", [0, 1, 1, "1", "0"]],
               prices=["1"], cap="2", ratio="1")],
        {**HALF, "quantile": "1/3", "answer": "1", "failure": f"0.24{24 * '9'}"},
        "a quantile jumps where the lottery exceeds row failure",
    ),
    "a share's room": (
        [SHARED, GOAL, DEAD], sharing(["3/4", "1/4"]), {"failure": {"share": "9/10"}},
        "bound of row failure",
    ),
    "a least failure": (
        [SHARED, GOAL, DEAD], sharing(["31/40", "9/40"], "-17"), {"failure": {"share": "9/10"}},
        "v <= c",
    ),
    "a share above 1": (
        [SHARED, GOAL, DEAD], sharing(["1/2", "1/2"]), {"failure": {"share": "-1"}},
        "a share is a probability",
    ),
    "a file that goes on": ([STEP, GOAL], [one_step(), one_step()], {}, "lines after its proof"),
    "an answer to no quantile": ([STEP, GOAL], [one_step()], {"answer": "1"}, "an answer is a"),
    "a quantile at a discount": (
        [STEP, GOAL], [arriving("1", "1"), arriving("1", "1")],
        {**HALF, "answer": "1", "discount": "1/2"}, "a quantile is one of the total alone",
    ),
    "a quantile of something else": (
        [STEP, GOAL], [arriving("1", "1")] * 2, {**HALF, "answer": "1", "objective": COST},
        "a quantile is one of the total alone",
    ),
    "a quantile without a goal": (
        [STEP, GOAL], [arriving("1", "1")] * 2, {**HALF, "answer": "1", "ratio": False},
        "a quantile is one of the total alone",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("states", "proofs", "asked", "words"), FORGED.values(), ids=FORGED)
def test_a_claim_that_is_false_is_refused(states, proofs, asked, words, tmp_path):
    reason = said(tmp_path / "x", states, *proofs, **asked)
    assert isinstance(reason, str), reason
    assert any(one in reason for one in words.split("|")), reason


def test_a_share_is_proved(tmp_path):
    """0.81 = 0.775 x 0.9 + 0.225 x 0.5, for 0.775 x 10."""
    asked = {"failure": {"share": "9/10"}}
    proved = said(tmp_path / "x", [SHARED, GOAL, DEAD], *sharing(["31/40", "9/40"]), **asked)
    assert proved == (Fraction(31, 4), Fraction(31, 4))


@pytest.mark.parametrize("total", [0, 1])
def test_a_quantile_is_proved(total, tmp_path):
    """And the text of each program, whose SHA-256 is told, is that of the page on the format."""
    states = [state(go=([["1", 1]], [str(total)])), GOAL]
    proofs = arriving("0", "0"), arriving("1", "1")
    checked = verdict(tmp_path / "x", states, *proofs, answer=str(total), **HALF)
    assert (checked.lower, checked.upper) == (total, total)
    for counts, digest in zip((["0", "0"], ["1", "0"]), checked.programs, strict=True):
        lines = [[4, "0", [["failure", "1", "1"]], []], [0, "begin", 1, [[1, 3]], ["0", "0"]]]
        lines += [[1, "go", 1, [], ["1", "0"]], [3, "go", 1, [], counts]]
        text = "".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines)
        assert digest == sha256(text.encode()).hexdigest()


# Questions and models without a meaning, or with two, are refused.


NEITHER = [
    ([STEP, GOAL], {"discount": "0"}, "a discount lies in"),
    ([STEP, GOAL], {"discount": "2"}, "a discount lies in"),
    ([STEP, GOAL], {"discount": "0." + 3998 * "9"}, "no text of a number"),
    ([STEP, GOAL], {"start": [["2", 0], ["-1", 1]]}, "the start is a distribution"),
    ([STEP, GOAL], {"start": [["0", 0]]}, "the start is a distribution"),
    ([STEP, GOAL], {"start": []}, "the start is a distribution"),
    ([STEP, GOAL], {"start": [["1", 2]]}, "not a whole number below 2"),
    ([STEP, GOAL], {"give_up": "never"}, "give_up is never"),
    ([RISK, GOAL, DEAD], {"failure": "0", "start": [["1", 0], ["1", 1]]},
     "needed: the goal can be reached surely"),
    ([STEP, GOAL], {"objective": {**COST, "square": True}}, "no quantity"),
    ([STEP, GOAL], {"rows": [{"name": "r", "quantity": [], "at_most": "1"}]}, "no quantity"),
    ([STEP, GOAL], {"objective": counting("1", "vists", "goal")}, "no quantity is called vists"),
    ([STEP, GOAL], {"objective": counting("-1", "cost", 0)}, "costs and visits count >= 0"),
    ([STEP, GOAL], {"objective": counting("-1", "visits", "goal")}, "costs and visits count >= 0"),
    ([STEP, GOAL], {"greatest": True}, "count >= 0"),
    ([STEP, GOAL], {"objective": counting("1", "cost", 1)}, "not a whole number below 1"),
    ([{**STEP, "sets": ["s"]}, GOAL], {"sets": ["s"], "objective": counting("1", "end", "s")},
     "not all states end"),
    ([STEP, GOAL], {"objective": counting("1", "end", "s")}, "there is no set"),
    ([{**STEP, "sets": ["s"]}, GOAL], {}, "there is no set s"),
    ([STEP, GOAL], {"rows": [{"name": "r", "quantity": COST}]}, "a row has a name and one bound"),
    ([STEP, GOAL], {"rows": [{"name": "r", "quantity": COST, "at_most": "1", "at_least": "0"}]},
     "a row has a name and one bound"),
    ([STEP, GOAL], {"rows": [{"name": "failure", "quantity": COST, "at_most": "1"}]},
     "two rows are called alike"),
    ([STEP, GOAL], {**TOTALS, "charge": [[">=", "1", "7", "0"]]}, "a charge begins at 0"),
    ([STEP, GOAL], {**TOTALS, "charge": [[">", "0", "7", "0"]]}, "a charge begins at 0"),
    ([STEP, GOAL], {**TOTALS, "charge": [*SPENT, *SPENT]}, "a charge begins at 0"),
    ([STEP, GOAL], {**TOTALS, "charge": [[">=", "0", "1", "0"], [">", "0", "0", "0"]]},
     "the cap is too low"),
    ([STEP, GOAL], {**TOTALS, "charge": SPENT, "greatest": True}, "does not fall in the end"),
    ([{**GOAL, "actions": STEP["actions"]}, GOAL], {}, "a goal has no actions"),
    ([state(go=([["2", 1], ["-1", 0]], ["1"])), GOAL], {}, "chances >= 0 of a sum > 0"),
    ([state(go=([["0", 1]], ["1"])), GOAL], {}, "chances >= 0 of a sum > 0"),
    ([state(go=([], ["1"])), GOAL], {}, "chances >= 0 of a sum > 0"),
    ([state(go=([["1", 1], ["1", 1]], [["2", "-1"]])), GOAL], {}, "costs >= 0"),
    ([state(go=([["1", 1]], [["1", "2"]])), GOAL], {}, "costs >= 0"),
    ([state(go=([["1", 1]], [])), GOAL], {}, "costs of s go"),
    ([state(go=([["1", 1]], 63 * ["1"])), GOAL], {"costs": 63}, "63 is not a whole number below"),
    ([state(go=([["1", 2]], ["1"])), GOAL], {}, "not a whole number below 2"),
    ([state(go=([["1", True]], ["1"])), GOAL], {}, "not a whole number below 2"),
]  # fmt: skip


@pytest.mark.parametrize(("states", "asked", "words"), NEITHER, ids=range(len(NEITHER)))
def test_what_has_no_meaning_is_refused(states, asked, words, tmp_path):
    ratio = {"ratio": "0"} if asked.get("ratio") else {}
    nothing = proof([0, "0", [0, 0, 2, "0", "0"]], [1, "0", [0, 0, 1, "0", "0"]], **ratio)
    assert words in said(tmp_path / "x", states, nothing, **asked)


@pytest.mark.parametrize("cost", [10**15, 10**30, 10**33])
def test_prices_pay_for_what_a_lottery_takes(cost, tmp_path):
    """At an excess that is let pass no price makes "at least" more than "at most"."""
    excess, unit = EXCESS / 2, 4 * 10**24
    half = (1 + excess) / 2
    both = state(free=([[str(1 - half), 1], [str(half), 2]], ["0"]), dear=([["1", 1]], [str(cost)]))
    taken, v = str(half * unit), cost * unit
    for value, words in ((v, ""), (v + 1, "v <= c + sum a v at 1")):
        lines = [0, str(value), [0, 0, 2, "0", taken]], [1, str(value), [0, 0, 1, "0", taken]]
        told = proof(*lines, unit=unit, prices=[str(2 * cost)])
        checked = verdict(tmp_path / "x", [both, GOAL, DEAD], told, failure="1/2")
        assert words in checked.reason
        assert checked.accepted == (not words)
        if checked.accepted:
            assert (checked.lower, checked.upper) == (-cost * excess, 0)
            assert checked.exceeded == {"failure": excess / 2}
            assert "the lottery exceeds row 'failure' by 2.5e-25" in str(checked)
    lines = [0, "0", [0, 0, 2, "0", "1"]], [1, "0", [0, 0, 1, "0", "1"]]
    reason = said(tmp_path / "x", [RISK, GOAL, DEAD], proof(*lines, unit=2), failure="0.4")
    assert "lottery <= bound of row failure" in str(reason) or "u >= c" in str(reason)


# Files that are small and unpack to much, that name things strangely, or ask for much work.


STRANGE = "r\x1b[2J\r\n  at most   0\u202e\u2066\u2028\x00\x9b"
MANY = 3000
SECONDS = 15.0  # of the processor; all of these take less than one where nothing else runs


@pytest.mark.parametrize(
    ("head", "unit", "times", "reason"),
    [
        (b"", b"\0", 150 << 20, "a line is not ended, or has more than 16777216 bytes"),
        (b"[", b"[],", 8 << 20, "a line is not ended, or has more than 16777216 bytes"),
        (b'{"format":"', b"a", 1 << 24, "a line is not ended, or has more than 16777216 bytes"),
        (b"", b"\n", 20 << 20, "the file is damaged: JSONDecodeError"),
        (b"", b"0\n", 20 << 20, "the file is damaged: AttributeError"),
    ],
)
def test_a_small_file_is_not_unpacked_to_a_large_one(head, unit, times, reason, tmp_path):
    (tmp_path / "x").write_bytes(gzip.compress(head + unit * times, 1))
    tracemalloc.start()
    checked = check_certificate(tmp_path / "x")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert checked.reason.startswith(reason)
    assert peak < 80 << 20


def test_lines_in_all_are_limited_by_the_size_of_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(certificate_lines, "LINE", 1 << 12)
    states = [STEP, GOAL, *[{**DEAD, "name": "d" * MANY}] * 100]
    reason = said(tmp_path / "x", states, one_step())
    assert reason == "the lines are too long for so small a file"


@pytest.mark.parametrize("lines", [2, 10**6])
@pytest.mark.parametrize("steps", [10**6, 10**12, 10**300])
def test_a_far_horizon_is_no_work_for_a_small_file(lines, steps, tmp_path):
    """Whatever number of lines the head of the proof claims."""
    began = process_time()
    told = one_step(lines=lines)
    reason = said(tmp_path / "x", [LOOP, GOAL], told, horizon=steps)
    words = "horizon is too far", "not a whole number below", "ends within a proof"
    assert any(word in reason for word in words)
    assert process_time() - began < SECONDS


def test_far_totals_are_no_work_for_a_small_file(tmp_path):
    """Of a loop that costs 1 below a cap of a billion."""
    loop, began = state(stay=([["1", 0]], ["1"]), go=([["1", 1]], ["1"])), process_time()
    reason = said(tmp_path / "x", [loop, GOAL], one_step(ratio="1", cap="1e9"), **TOTALS)
    assert reason == "needed: each node below the cap has a line"
    assert process_time() - began < SECONDS


def test_no_denominator_is_too_long(tmp_path):
    """Thousands of chances with denominators that have nothing in common."""
    odd = [2**61 - 1 + 2 * k for k in range(4 * MANY)]
    many, began = state(go=([[f"1/{d}", 1] for d in odd], ["1"])), process_time()
    reason = said(tmp_path / "x", [many, GOAL], one_step())
    assert reason == "a common denominator is too long"
    assert process_time() - began < SECONDS


@pytest.mark.parametrize(
    "change",
    [
        {"u": "0"},  # the inequality at the state
        {"bound": "0.5"},  # that of the row
        {"start": [[STRANGE, 0]]},
        {"states": [state(**{STRANGE: ([["0", 1]], ["1"])}), GOAL]},
        {"states": [state(**{STRANGE: ([["1", 1]], STRANGE)}), GOAL]},
        {"states": [{**STEP, "sets": [f"{STRANGE} not"]}, GOAL]},
        {"give_up": STRANGE},
        {"failure": STRANGE},
        {"discount": STRANGE},
        {STRANGE: STRANGE},
        {"charge": [[STRANGE] * 4]},
    ],
)
def test_names_in_a_refusal_are_shown_letter_by_letter(change, tmp_path):
    checked = strange(tmp_path / "x", **change)
    assert not checked.accepted
    assert str(checked).isprintable()


def strange(path, *, u="1", bound="1", states=None, taken="1", unit=1, **asked):
    """What is said of a file of one step all of whose names are strange, with a row so called."""
    step = {"name": STRANGE, "sets": [STRANGE], "actions": [[STRANGE, [["1", 1]], ["1"]]]}
    rows = [{"name": STRANGE, "quantity": COST, "at_most": bound}]
    lines = [[i, str(unit), [0, 0, 2 - i, u, "0", taken]] for i in (0, 1)]
    told = proof(*lines, prices=["0", "0"], unit=unit)
    asked = {"rows": rows, "sets": [STRANGE], **asked}
    return verdict(path, states or [step, GOAL], told, **asked)


def test_names_in_a_verdict_are_shown_letter_by_letter(tmp_path):
    unit = 10**30
    checked = strange(
        tmp_path / "x", bound=f"0.{30 * '9'}", u=str(unit), taken=str(unit), unit=unit
    )
    assert (checked.reason, list(checked.exceeded)) == ("", [STRANGE])
    lines = str(checked).split("\n")
    assert all(line.isprintable() for line in lines)
    starts = ["accepted: ", "  SHA-256 ", "  at least ", "  at most ", "  width ", "  the lottery "]
    assert [line[: len(start)] for line, start in zip(lines, starts, strict=True)] == starts


def test_a_headline_is_made_of_the_question_alone(tmp_path):
    """State names are the model's; nothing in a file says in its own words what it asks."""
    asked = {"failure": "1/20", "horizon": 3, "charge_failing_step": True}
    asked["rows"] = [{"name": "time", "quantity": COST, "at_most": "2"}]
    told = proof([0, "1", [0, 0, 2, "1", "0", "1"]], [1, "1", [0, 0, 1, "1", "0", "1"]],
                 prices=["0", "0"])  # fmt: skip
    checked = verdict(tmp_path / "x", [STEP, GOAL], told, **asked)
    assert checked.asked == (
        "least 1 cost 0; from 's' (1); failure 1/20; horizon 3; give_up dead_ends; the failing "
        "step charged; 'time': 1 cost 0 at most 2"
    )
    dearer = {**asked, "objective": {**COST, "constant": "2"}}
    assert "least 1 cost 0 + 2; from" in verdict(tmp_path / "x", [STEP, GOAL], told, **dearer).asked


def test_what_is_no_file_is_refused():
    refused = check_certificate(b"one")
    assert (refused.accepted, refused.reason[:29]) == (False, "bytes is not a path of a file")


def test_a_reason_is_no_longer_than_can_be_read(tmp_path):
    long = "a" * 10**6
    keys = {f"{long} {k}": k for k in range(20)}
    (tmp_path / "x").write_bytes(gzip.compress(json.dumps(keys).encode() + b"\n"))
    assert len(check_certificate(tmp_path / "x").reason) <= prove.REASON


@pytest.mark.parametrize(
    ("terms", "taken"),
    [
        ([], "0"),
        ([["0", "visits", "goal"]], "0"),
        ([["1", "visits", "all"]], "2"),
        ([["1", "end", "dead"]], "0"),
        ([["1", "cost", 0]], "1"),
    ],
)
def test_many_rows_of_many_states_take_the_time_of_their_sum(terms, taken, tmp_path):
    """A small file, which is true: rows count in sets of states, of which few are met."""
    few = MANY // 10
    states = [{**STEP, "sets": ["all"]}, {**GOAL, "sets": ["goal", "all"]}]
    states += [{**DEAD, "sets": ["all", "dead"]}] * few
    quantity = {"constant": "0", "terms": terms}
    rows = [{"name": f"r{k}", "at_most": "4", "quantity": quantity} for k in range(few)]
    at = [[0, "1", [0, 0, 2, "1", "0", *[taken] * few]]]
    at += [[1, "1", [0, 0, 1, "1", "0", *["1" if taken == "2" else taken] * few]]]
    began = process_time()
    told = proof(*at, prices=["0"] * (few + 1))
    asked = {"rows": rows, "sets": ["all", "dead"]}
    assert said(tmp_path / "x", states, told, **asked) == (1, 1)
    assert process_time() - began < SECONDS


def test_a_long_way_of_risks_takes_the_time_of_its_length(tmp_path):
    """From state k one comes to the goal or to k - 1, from state 0 to a dead-end: none is sure."""
    leads = [[["1", k - 1 if k else MANY], ["1", MANY + 1]] for k in range(MANY)]
    chain = [state(go=(outcomes, ["1"])) for outcomes in leads]
    states, began = [*chain, DEAD, GOAL], process_time()
    told = proof([0, "0", [0, 0, 1, "0", "0"]])
    asked = {"start": [["1", MANY + 1]]}
    assert said(tmp_path / "x", states, told, **asked) == (0, 0)
    assert process_time() - began < SECONDS
