"""Every script says what it does when asked for help, and does nothing else."""

import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RUN_BY = re.compile(r"^ *python examples/\S+\.py|__name__ == .__main__.", re.MULTILINE)
SCRIPTS = sorted(
    path
    for path in (ROOT / "examples").rglob("*.py")
    if path.name != "__init__.py" and RUN_BY.search(path.read_text(encoding="utf-8"))
)


def test_there_are_scripts():
    assert len(SCRIPTS) >= 12


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_help_is_all_that_happens(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(script), run_name="__main__")
    assert not caught.value.code
    printed = capsys.readouterr()
    assert len(printed.out.split()) >= 10
    assert printed.err == ""
