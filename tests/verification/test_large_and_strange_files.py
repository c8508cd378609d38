"""Certificates that are small and unpack to much, that name things strangely, or have many rows."""

from __future__ import annotations

import gzip
import json
import tracemalloc
from time import process_time

import pytest

from forged import AWAY, COST, DEAD, GOAL, state, verdict
from ssp_lp import check_certificate
from ssp_lp.verification import checker

STEP = state(go=([["1", 1]], ["1"]))
STRANGE = "r\x1b[2J\r\n  at most   0\u202e\u2066\u2028\x00\x9b"
MANY = 3000
SECONDS = 15.0  # of the processor; all of these take less than one where nothing else runs


@pytest.mark.parametrize(
    ("head", "unit", "times", "reason"),
    [
        (b"", b"\0", 150 << 20, "a line has more than 16,777,216 bytes"),
        (b"[", b"[],", 8 << 20, "a line has more than 16,777,216 bytes"),
        (b'{"format":"', b"a", 1 << 24, "a line has more than 16,777,216 bytes"),
        (b"", b"\n", 20 << 20, "the file is damaged: JSONDecodeError"),
        (b"", b"0\n", 20 << 20, "the file is damaged: TypeError"),
    ],
)
def test_a_small_file_is_not_unpacked_to_a_large_one(head, unit, times, reason, tmp_path):
    (tmp_path / "x").write_bytes(gzip.compress(head + unit * times, 1))
    tracemalloc.start()
    said = check_certificate(tmp_path / "x")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert said.reason.startswith(reason)
    assert peak < 80 << 20


def test_lines_in_all_are_limited_by_the_size_of_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(checker, "LINE", 1 << 12)
    proof = [{"v": "1", "members": [[0, "1", "1"]]}, AWAY, *[AWAY] * MANY]
    states = [STEP, GOAL, *[DEAD] * MANY]
    said = verdict(tmp_path / "x", states, {"prices": []}, proof, objective=COST)
    most = (1 << 12) + checker.TIMES * (tmp_path / "x").stat().st_size
    assert said.reason == f"the lines have more than {most:,} bytes"


def strange(path, *, objective="1", budget="1", states=None, taken="0", **asked):
    """A file of one step all of whose names are strange, with a row that is so called."""
    step = {"name": STRANGE, "sets": [STRANGE], "actions": [[STRANGE, [["1", 1]], ["1"]]]}
    row = {"constant": "0", "terms": [["1", "cost", 0]]}
    asked = {
        "rows": [{"name": STRANGE, "quantity": row, "at_most": budget}], "sets": [STRANGE],
        "asked": STRANGE, "objective": COST, **asked,
    }  # fmt: skip
    proof = [{"v": objective, "members": [[0, "1", "1", taken]]}, AWAY]
    return verdict(path, states or [step, GOAL], {"prices": ["0"]}, proof, **asked)


@pytest.mark.parametrize(
    "change",
    [
        {"objective": "2"},  # the inequality at the state
        {"taken": "0.5"},  # that of the row
        {"taken": "1", "budget": "0.5"},  # the row's bound
        {"start": [[STRANGE, 0]]},
        {"states": [state(**{STRANGE: ([["0", 1]], ["1"])}), GOAL], "sets": [STRANGE]},
        {"states": [state(**{STRANGE: ([["1", 1]], STRANGE)}), GOAL]},
        {"states": [{**STEP, "sets": [f"{STRANGE} not"]}, GOAL]},
        {"give_up": STRANGE},
        {"failure": STRANGE},
        {"discount": STRANGE},
        {STRANGE: STRANGE},
        {"objective": "1", "charge": [[STRANGE] * 4]},
    ],
)  # fmt: skip
def test_names_in_a_refusal_are_shown_letter_by_letter(change, tmp_path):
    objective = {k: v for k, v in change.items() if k != "objective"}
    said = strange(tmp_path / "x", objective=change.get("objective", "1"), **objective)
    assert not said.accepted
    assert said.reason.isprintable(), said.reason
    assert str(said).isprintable()


def test_names_in_a_verdict_are_shown_letter_by_letter(tmp_path):
    said = strange(tmp_path / "x", taken="1", budget=f"0.{30 * '9'}")
    assert (said.reason, list(said.exceeded)) == ("", [STRANGE])
    lines = str(said).split("\n")
    assert all(line.isprintable() for line in lines)
    starts = ["accepted: ", "  SHA-256 ", "  at least ", "  at most ", "  width ", "  the lottery "]
    assert [line[: len(start)] for line, start in zip(lines, starts, strict=True)] == starts


def test_a_reason_is_no_longer_than_can_be_read(tmp_path):
    long = "a" * 10**6
    keys = {f"{long} {k}": k for k in range(20)}
    (tmp_path / "x").write_bytes(gzip.compress(json.dumps(keys).encode()))
    assert len(check_certificate(tmp_path / "x").reason) <= 10 * checker.SHOWN


@pytest.mark.parametrize(
    ("terms", "taken"),
    [
        ([], "0"),
        ([["0", "visits", "goal"]], "0"),
        ([["1", "visits", "all"]], "2"),
        ([["2", "visits", "all"], ["-1", "visits", "some"]], "2"),
        ([["1", "end", "dead"]], "0"),
        ([["-1", "end", "goal"]], "0"),
        ([["1", "cost", 0]], "1"),
    ],
)
def test_many_rows_of_many_states_take_the_time_of_their_sum(terms, taken, tmp_path):
    """A file of some 10 kB, which is true: rows count in sets of states, of which few are met."""
    states = [{**STEP, "sets": ["all"]}, {**GOAL, "sets": ["goal", "all"]}]
    states += [{**DEAD, "sets": ["all", "dead"]}] * MANY
    rows = [
        {"name": f"r{k}", "at_most": "4", "quantity": {"constant": "0", "terms": terms}}
        for k in range(MANY)
    ]
    own = {"v": "1", "members": [[0, "1", "1", *[taken] * MANY]]}
    asked = {"rows": rows, "sets": ["all", "some", "dead"], "objective": COST}
    head, began = {"prices": ["0"] * MANY}, process_time()
    said = verdict(tmp_path / "x", states, head, [own, AWAY, *[AWAY] * MANY], **asked)
    assert (said.reason, said.lower, said.upper) == ("", 1, 1)
    assert process_time() - began < SECONDS
    assert (tmp_path / "x").stat().st_size < 16_000


def test_a_long_way_of_risks_takes_the_time_of_its_length(tmp_path):
    """From state k one comes to the goal or to k - 1, from state 0 to a dead-end: none is sure."""
    leads = [[["1", k - 1 if k else MANY], ["1", MANY + 1]] for k in range(MANY)]
    chain = [state(go=(outcomes, ["1"])) for outcomes in leads]
    states, began = [*chain, DEAD, GOAL], process_time()
    asked = {"objective": COST, "start": [["1", MANY + 1]]}
    said = verdict(tmp_path / "x", states, {"prices": []}, [AWAY] * (MANY + 2), **asked)
    assert (said.reason, said.lower, said.upper) == ("", 0, 0)
    assert process_time() - began < SECONDS
