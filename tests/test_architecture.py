"""The direction of dependency: imports only point to what DESIGN lists earlier."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

ORDER = [
    ("errors", "arrays", "accelerator"),
    ("compiled",),
    ("bellman",),
    ("model",),
    ("dynamic_programming",),
    ("policies",),
    ("process",),
    ("program",),
    ("engines", "goal_probability"),
    ("problem",),
    ("chain", "ends", "failing", "estimate", "players"),
    ("live_chain", "layer_powers"),
    ("arrivals",),
    ("cost_law",),
    ("evaluation", "occupation", "simulation"),
    ("solution", "frontier"),
    ("risk",),
    ("certificate",),
    ("crosscheck", "deterministic", "reward", "constrained"),
    ("solve",),
    ("road",),
    ("judge",),
    ("agreement",),
]
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}

LP_PATH = ("ssp_lp.engines.lp", "ssp_lp.engines.column_generation", "ssp_lp.program")


def imports_of(path: Path) -> set[str]:
    """Every module that a file imports, function-local imports included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def files_of(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@pytest.mark.parametrize("path", files_of("ssp_lp"), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_to_earlier_rooms(path: Path) -> None:
    room = path.relative_to(ROOT / "ssp_lp").parts[0].removesuffix(".py")
    if room == "__init__":
        return
    for name in imports_of(path):
        assert not name.startswith("formulations"), f"{path} imports {name}"
        parts = name.split(".")
        if parts[0] == "ssp_lp" and len(parts) > 1 and parts[1] in RANK:
            same = parts[1] == room
            assert same or RANK[parts[1]] <= RANK[room], f"{path.name} imports {name}"


@pytest.mark.parametrize("path", files_of("ssp_lp"), ids=lambda p: str(p.relative_to(ROOT)))
def test_no_solver_outside_the_lp_engine(path: Path) -> None:
    if "engines/lp" in path.as_posix():
        return
    for name in imports_of(path):
        assert name.split(".")[0] not in {"highspy", "clarabel", "cvxpy"}


def test_crosscheck_never_sees_the_lp_path() -> None:
    for path in files_of("ssp_lp/crosscheck"):
        for name in imports_of(path):
            assert not name.startswith(LP_PATH), f"{path.name} imports {name}"


def test_nothing_that_crosscheck_imports_sees_the_lp_path() -> None:
    """The second opinion is independent: no module that it needs, however far, knows a program."""
    queue, seen = files_of("ssp_lp/crosscheck"), set()
    while queue:
        path = queue.pop()
        if path in seen:
            continue
        seen.add(path)
        for name in imports_of(path):
            assert not name.startswith(LP_PATH), f"{path.name} imports {name}"
            assert name.split(".")[0] not in {"highspy", "clarabel", "cvxpy"}
            module = ROOT.joinpath(*name.split("."))
            queue += [p for p in (module.with_suffix(".py"), module / "__init__.py") if p.exists()]
    assert ROOT / "ssp_lp/__init__.py" not in seen


def test_oracles_and_evaluation_never_see_the_lp_path() -> None:
    rooms = [*files_of("ssp_lp/engines/oracles"), ROOT / "ssp_lp/chain.py"]
    for path in [*rooms, ROOT / "ssp_lp/evaluation.py"]:
        for name in imports_of(path):
            assert not name.startswith(LP_PATH), f"{path.name} imports {name}"


def test_formulations_only_state_problems() -> None:
    for path in files_of("formulations"):
        for name in imports_of(path):
            assert name.split(".")[0] in {
                "__future__", "collections", "dataclasses", "formulations", "fractions", "math",
                "ssp_lp", "typing",
            }  # fmt: skip


@pytest.mark.parametrize("package", ["ssp_lp", "formulations"])
def test_no_module_is_longer_than_it_should_be(package: str) -> None:
    long = {p.name: n for p in files_of(package) if (n := len(p.read_text().splitlines())) > 300}
    assert not long
