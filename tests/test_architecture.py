"""The direction of dependency: imports only point to folders listed earlier."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from formulations import MCMP, S3P, CVaR
from ssp_lp import SSP, certify, solve, visits
from tests.support import house
from tests.support.compiled import Switch
from tests.support.house import Way, way_of

ROOT = Path(__file__).parent.parent

ORDER = [
    ("errors", "arrays", "options"),
    ("compiled",),
    ("model", "linear_programming"),
    ("policies", "dynamic_programming"),
    ("processes", "accumulated_cost"),
    ("programs",),
    ("column_generation",),
    ("problem",),
    ("analysis",),
    ("solution",),
    ("methods", "game", "reductions"),
    ("solving", "formulation", "verification", "io", "plotting"),
    ("cargo", "answers", "distributed", "tightening"),
]
WITH_SOLVERS = {"convex_program.py"}

RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}

LP_PATH = ("ssp_lp.linear_programming", "ssp_lp.column_generation.search", "ssp_lp.programs")


def imports_of(path: Path) -> set[str]:
    """Every module that a file imports, function-local imports included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = module_of(node, path)
            found |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return found


def module_of(node: ast.ImportFrom, path: Path) -> str:
    """The full name of the module that a line imports from, relative or not."""
    outer = path.relative_to(ROOT).parts[: -node.level] if node.level else ()
    return ".".join([*outer, *([node.module] if node.module else [])])


def files_of(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@pytest.mark.parametrize("path", files_of("ssp_lp"), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_to_earlier_rooms(path: Path) -> None:
    room = path.relative_to(ROOT / "ssp_lp").parts[0].removesuffix(".py")
    if room in {"__init__", "__main__"}:
        return
    for name in imports_of(path):
        parts = name.removeprefix("ssp_lp.").split(".")
        assert parts[0] != "formulations", f"{path} imports {name}"
        parts = name.split(".")
        if parts[0] == "ssp_lp" and len(parts) > 1 and parts[1] in RANK:
            same = parts[1] == room
            assert same or RANK[parts[1]] <= RANK[room], f"{path.name} imports {name}"


@pytest.mark.parametrize("path", files_of("ssp_lp"), ids=lambda p: str(p.relative_to(ROOT)))
def test_no_solver_outside_its_rooms(path: Path) -> None:
    if path.parts[-2] == "linear_programming" or path.name in WITH_SOLVERS:
        return
    for name in imports_of(path):
        assert name.split(".")[0] not in {"highspy", "clarabel", "cvxpy"}


def test_the_game_never_sees_the_lp_path() -> None:
    for path in files_of("ssp_lp/game"):
        for name in imports_of(path):
            assert not name.startswith(LP_PATH), f"{path.name} imports {name}"


def test_nothing_that_the_game_imports_sees_the_lp_path() -> None:
    """The second opinion is independent: no module that it needs, however far, knows a program."""
    queue, seen = files_of("ssp_lp/game"), set()
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


def test_pricing_and_evaluation_never_see_the_lp_path() -> None:
    pricing = [*(ROOT / "ssp_lp/column_generation").glob("*_pricing.py")]
    chain, evaluation = ROOT / "ssp_lp/policies/chain.py", ROOT / "ssp_lp/analysis/evaluation.py"
    assert len(pricing) == 2
    for path in [*pricing, *files_of("ssp_lp/accumulated_cost"), chain, evaluation]:
        for name in imports_of(path):
            assert not name.startswith(LP_PATH), f"{path.name} imports {name}"


def test_a_page_of_formulations_imports_from_one_place() -> None:
    allowed = {
        "__future__",
        "collections",
        "dataclasses",
        "fractions",
        "functools",
        "math",
        "typing",
    }
    for path in files_of("formulations"):
        if path.name in {"__init__.py", "comparison.py"} or path.parent.name == "command_line":
            continue
        for name in imports_of(path):
            one_place = f"{name}.".startswith("ssp_lp.formulation.")
            assert one_place or name.split(".")[0] in allowed, f"{path.name} imports {name}"


def test_the_page_on_architecture_has_this_order() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    ranks = re.findall(r"^(\d+)\. ((?:`\w+`(?:, )?)+)$", page, flags=re.MULTILINE)
    assert [tuple(re.findall(r"\w+", names)) for _, names in ranks] == ORDER
    assert [int(rank) for rank, _ in ranks] == list(range(1, len(ORDER) + 1))


def test_the_page_on_solving_lists_every_logger() -> None:
    page = (ROOT / "docs" / "solving.md").read_text(encoding="utf-8")
    listed = re.search(r'such as "ssp_lp.search"\. The phases are ([\w\s,]+)\.', page)
    assert listed is not None
    texts = [
        path.read_text(encoding="utf-8") for path in files_of("ssp_lp") + files_of("formulations")
    ]
    named = {name for text in texts for name in re.findall(r'getLogger\([^)]*\.(\w+)"\)', text)}
    assert set(re.split(r",\s+", listed[1])) == named


def test_stops_and_kinds_of_compiled_problems_are_known_in_few_places() -> None:
    """Loops go on with what they have by ``WithIncumbent``; compiled problems say what they are."""
    texts = [
        path.read_text(encoding="utf-8") for path in files_of("ssp_lp") + files_of("formulations")
    ]
    assert sum(text.count("except STOPS") for text in texts) <= 8
    assert not any(re.search(r"isinstance\([^)]*Compiled", text) for text in texts)


@pytest.mark.slow
def test_no_module_imports_itself_by_way_of_others() -> None:
    """Imports that only a type checker sees, and those of a package's own modules, apart."""
    files = files_of("ssp_lp") + files_of("formulations")
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files}
    imported: dict[str, set[str]] = {}
    for name, path in names.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                node.body = []
        lines = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        found = {
            f"{module_of(node, path)}.{alias.name}" for node in lines for alias in node.names
        } | {module_of(node, path) for node in lines}
        imported[name] = {other for other in found if other in names and other != name}
    while ends := {name for name, others in imported.items() if not others & imported.keys()}:
        imported = {name: others for name, others in imported.items() if name not in ends}
    assert not imported


@pytest.mark.slow
def test_no_small_module_serves_one_neighbour_alone() -> None:
    """A module below 200 lines that one module of its own folder imports is a part of that one."""
    files = files_of("ssp_lp") + files_of("formulations")
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files}
    importers: dict[str, set[str]] = {name: set() for name in names}
    stubs = {f"{path.parent.name}.__init__": path for path in ROOT.glob("*/__init__.pyi")}
    for name, path in [*names.items(), *stubs.items()]:  # a stub imports what a package exports
        for other in imports_of(path):
            if other in importers and other != name:
                importers[other].add(name)
    lone = {
        name
        for name, path in names.items()
        if path.name != "__init__.py" and len(path.read_text(encoding="utf-8").splitlines()) < 200
        for user in importers[name]
        if len(importers[name]) == 1 and not user.endswith("__init__")
        if user.rpartition(".")[0] == name.rpartition(".")[0]
    }
    assert not lone


DEPOT = SSP.from_transitions(
    {
        "depot": {
            "alley": [(0.90, "home", 4.0), (0.10, "wreck", 2.0)],
            "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
        },
        "wreck": {},
    },
    goal={"home"},
    treat_actionless_as_dead_ends=True,
)


CASE_M, CASE_S = MCMP(DEPOT, "depot", 0.05), S3P(DEPOT, "depot", 0.05)
TAIL = CVaR(DEPOT, "depot", 0.9, 0.05)
LIMITED = MCMP(DEPOT, "depot", 0.05, constraints={"few": visits("wreck") <= 0.04})
PROVED = solve(CASE_M)
CALLS: dict[str, Callable[[], object]] = {
    "MCMP": lambda: solve(CASE_M),
    "MCMP, lp": lambda: solve(CASE_M, "lp"),
    "S3P": lambda: solve(CASE_S),
    "CVaR": lambda: solve(TAIL),
    "limits": lambda: solve(LIMITED),
    "certify": lambda: certify(PROVED),
    "program": lambda: CASE_S.program().solve(),
}


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("MCMP", Way(33, 226, 609, 464)),
        ("MCMP, lp", Way(39, 279, 1120, 830)),
        ("S3P", Way(38, 325, 1060, 733)),
        ("CVaR", Way(42, 446, 3299, 2108)),
        ("limits", Way(33, 271, 1016, 708)),
        ("certify", Way(35, 189, 650, 436)),
        ("program", Way(46, 503, 3298, 2222)),
    ],
)
def test_a_small_solve_keeps_its_way(name: str, most: Way, accelerate: Switch) -> None:
    """Modules, functions, calls, changes of file of a warm call on three states: they only fall."""
    accelerate(False)  # no small call is worth compiling for
    way = way_of(CALLS[name])
    assert all(is_now <= was for is_now, was in zip(way, most, strict=True)), way


@pytest.mark.slow
@pytest.mark.parametrize(
    ("measure", "most"),
    [
        (house.lines_in_all, 34_672),
        (house.public_classes, 273),
        (house.numeric_constants, 482),
        (house.questions_asked, 12),
        (house.written_past_freezing, 28),
    ],
    ids=lambda one: one.__name__ if callable(one) else "",
)
def test_the_house_only_shrinks(measure: Callable[[], int], most: int) -> None:
    """What is measured may fall, and is then lowered here; to raise it is a decision."""
    assert measure() <= most


@pytest.mark.slow
def test_no_folder_grows() -> None:
    grown = {
        folder: count
        for folder, count in house.lines_by_folder().items()
        if count > LINES.get(folder, 0)
    }
    assert not grown


LINES = {
    "formulations": 420,
    "formulations/command_line": 833,
    "ssp_lp": 2_306,
    "ssp_lp/accumulated_cost": 2_785,
    "ssp_lp/analysis": 1_737,
    "ssp_lp/column_generation": 2_299,
    "ssp_lp/compiled": 1_964,
    "ssp_lp/distributed": 972,
    "ssp_lp/dynamic_programming": 1_931,
    "ssp_lp/game": 996,
    "ssp_lp/io": 2_895,
    "ssp_lp/linear_programming": 441,
    "ssp_lp/methods": 3_420,
    "ssp_lp/model": 3_510,
    "ssp_lp/plotting": 794,
    "ssp_lp/policies": 1_478,
    "ssp_lp/processes": 2_050,
    "ssp_lp/programs": 1_305,
    "ssp_lp/reductions": 446,
    "ssp_lp/verification": 1_850,
}
"""Code lines of each folder."""
