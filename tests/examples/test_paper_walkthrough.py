"""The walkthrough of the paper: every number agrees with its closed form, section by section."""

import re
from functools import cache, partial
from pathlib import Path

import pytest

from examples.paper_robot.grid import RobotGrid
from examples.paper_walkthrough import walkthrough
from examples.paper_walkthrough.model import Row
from examples.paper_walkthrough.robot import robot_text

PAGE = (Path(__file__).parents[2] / "docs/robot.md").read_text(encoding="utf-8")
SECTIONS = dict(walkthrough.SECTIONS)


@cache
def rows_of(title):
    return SECTIONS[title]()


@pytest.mark.parametrize("title", SECTIONS)
def test_section(title):
    rows = rows_of(title)
    assert rows
    wrong = [row for row in rows if not row.agrees]
    assert not wrong


def test_rows_tell_what_does_not_agree():
    assert Row("same", 2.0 + 1e-8, 2).agrees
    assert not Row("off", 2.0 + 1e-7, 2).agrees
    assert Row("near", 2.1, 2, bound=0.11).agrees
    assert not Row("far", 2.1, 2, bound=0.09).agrees


def test_it_prints_all_sections(capsys, monkeypatch):
    sections = {title: partial(rows_of, title) for title in SECTIONS}
    monkeypatch.setattr(walkthrough, "SECTIONS", sections)
    walkthrough.main([])
    told = capsys.readouterr().out
    assert all(title in told for title in sections)


def cells(text):
    """The table that is headed by c-hat, without its head and rule."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    first = next(i for i, line in enumerate(lines) if "c-hat" in line or r"\hat c" in line)
    return [[c.strip() for c in line.strip("|").split("|")] for line in lines[first + 2 :][:5]]


@pytest.mark.slow
def test_the_robots_table_is_that_of_its_page_and_closes():
    found, told = cells(robot_text(RobotGrid())), cells(PAGE)
    exact = float(found[-1][1])
    widths = []
    for mine, theirs in zip(found, told, strict=True):
        assert mine[0] == theirs[0]
        if "infeasible" in mine[1]:
            bound = [re.findall(r"0\.\d+", row[1]) for row in (mine, theirs)]
            assert bound[0] == bound[1] != []
            continue
        low, star, true = (float(c) for c in mine[1:])
        # c* is computed to a relative 1e-7.
        assert [low, star, true] == pytest.approx([float(c) for c in theirs[1:]], rel=3e-7)
        assert exact <= low <= star * (1.0 + 3e-7)
        assert star <= true * (1.0 + 3e-7)
        widths.append(true - low)
    assert [row[0] for row in found if "infeasible" in row[1]] == ["0.99"]
    assert widths == sorted(widths, reverse=True)
