"""One table, four forms: text, HTML, a frame and CSV have the same rows."""

import csv
import io

import pytest

from ssp_lp.model.report import Facts, Table

ROADS = Table(
    [("alley", 3.8, None), ("road <1>", 8.96, 0.125)],
    ("name", "cost", "share"),
    "two roads",
    ["nothing else"],
    {"cost": 2},
    hidden={"share"},
)


class Weather(Facts):
    """Facts of several kinds, of which two have no value."""

    def tables(self):
        counts = {"sun": 1200, "rain": 0}
        return [Table([("days", 1200), ("of", counts), ("warmth", 20.5, "(mean)"), ("snow", "")])]


def test_text_is_aligned_under_its_title():
    assert ROADS.lines() == [
        "two roads", "  name      cost", "  alley      3.8", "  road <1>     9", "  nothing else"
    ]  # fmt: skip
    assert Table([], ("name",)).lines() == ["no rows"]


def test_a_few_rows_are_shown_and_all_are_kept():
    some = Table(ROADS.rows, ROADS.head, shown=[1])
    assert [line.split()[0] for line in some.lines()] == ["name", "road"]
    assert len(some.records()) == 2


def test_html_is_escaped():
    page = ROADS.html()
    assert "road &lt;1&gt;" in page
    assert page.count("<tr>") == 3


def test_frames_and_csv_have_every_column_and_all_digits():
    assert list(csv.reader(io.StringIO(ROADS.csv()))) == [
        ["name", "cost", "share"], ["alley", "3.8", ""], ["road <1>", "8.96", "0.125"]
    ]  # fmt: skip
    pytest.importorskip("pandas")
    frame = ROADS.to_frame()
    assert frame["cost"].tolist() == [3.8, 8.96]
    assert frame["share"].isna().tolist() == [True, False]


def test_facts_are_one_line_and_those_without_a_value_are_left_out():
    assert repr(Weather()) == "Weather(days 1,200, of sun 1,200, warmth 20.5   (mean))"
    assert Weather().summary().splitlines()[-1] == "warmth  20.5   (mean)"
