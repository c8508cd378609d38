"""The README's code runs, and prints what the README says."""

from __future__ import annotations

import io
import re
import runpy
from contextlib import redirect_stdout
from pathlib import Path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_blocks_run_in_order() -> None:
    namespace: dict[str, object] = {}
    printed: list[str] = []
    namespace["print"] = lambda text: printed.append(str(text))
    for block in re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL):
        exec(block, namespace)
    shown = re.findall(r"```text\n(.*?)```", README, flags=re.DOTALL)
    assert len(printed) >= len(shown) == 3
    for block, told in zip(shown, printed, strict=False):
        check_the_same(block, told)
    check_the_same(shown[0], run_first_problem())


def check_the_same(shown: str, printed: str) -> None:
    """Line by line, but for gaps, which are rounding."""
    for mine, theirs in zip(shown.splitlines(), printed.splitlines(), strict=False):
        assert mine.split("(relative")[0].rstrip() == theirs.split("(relative")[0].rstrip()


def run_first_problem() -> str:
    """What the shortest example prints: the README's first problem."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        runpy.run_path(str(ROOT / "examples/quickstart/first_problem.py"))
    assert "first action: " in printed.getvalue()
    return printed.getvalue()


def test_there_are_two_commands() -> None:
    commands = re.findall(r"```bash\n(.*?)\n```", README, flags=re.DOTALL)
    assert len(commands) == 2
    assert all("\n" not in command for command in commands)
    assert "examples/paper_robot/obstacle_avoidance.py" in commands[0]
    assert "pytest" in commands[1]
