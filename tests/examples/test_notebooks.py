"""The notebooks run from top to bottom, each in at most forty lines, and say what they show."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "notebooks"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("matplotlib", "pandas"):
        pytest.importorskip(package)
    import matplotlib.pyplot as plt

    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(FOLDER)
    plt.switch_backend("agg")
    names: dict[str, object] = {}
    cells = [
        c for c in json.loads(path.read_text(encoding="utf-8"))["cells"] if c["cell_type"] == "code"
    ]
    assert sum(len(re.findall(r"\S.*", "".join(cell["source"]))) for cell in cells) <= 40
    for cell in cells:
        printed: list[str] = []
        names["print"] = lambda *told, to=printed: to.append(" ".join(map(str, told)))
        exec("".join(cell["source"]), names)
        shown = "".join("".join(out.get("text", ())) for out in cell["outputs"])
        for told in re.findall(r"objective c\*\s+\S+", "\n".join(printed)):
            assert told in shown
    plt.close("all")
