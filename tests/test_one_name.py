"""Everything public is imported from ``ssp_lp``, and only when it is first asked for."""

import ast
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

import formulations
import ssp_lp
from formulations.mcmp import MCMP as BY_BARE_NAME
from ssp_lp import MCMP

ROOT = Path(__file__).parent.parent


def run(code: str, cwd: Path = ROOT) -> str:
    """What a new process prints that imports the library from the checkout."""
    command = [sys.executable, "-c", f"import sys; sys.path.append({str(ROOT)!r})\n{code}"]
    return subprocess.run(command, cwd=cwd, check=True, capture_output=True, text=True).stdout  # noqa: S603


def test_type_checkers_and_python_know_the_same_names() -> None:
    stub = ast.parse((ROOT / "ssp_lp" / "__init__.pyi").read_text(encoding="utf-8"))
    lines = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    assert sorted(alias.name for node in lines for alias in node.names) == ssp_lp.__all__
    assert set(formulations.__all__) < set(ssp_lp.__all__) <= set(dir(ssp_lp))
    for name in ssp_lp.__all__:
        assert getattr(ssp_lp, name) is not None


def test_a_criterion_is_one_class_by_either_name() -> None:
    assert BY_BARE_NAME is MCMP is formulations.MCMP
    assert MCMP.__module__ == "ssp_lp.formulations.mcmp"
    assert pickle.loads(b"cformulations.mcmp\nMCMP\n.") is MCMP  # noqa: S301


@pytest.mark.parametrize(
    ("name", "meant"),
    [("slove", "solve"), ("mcpm", "MCMP"), ("Maxprob", "MaxProb"), ("ssp", "SSP")],
)
def test_a_misspelled_name_is_told_the_nearest(name: str, meant: str) -> None:
    words = rf"there is no {name} in ssp_lp; did you mean '{meant}'\?"
    assert not hasattr(ssp_lp, name)
    with pytest.raises(AttributeError, match=words):
        getattr(ssp_lp, name)
    with pytest.raises(ImportError, match=words):
        exec(f"from ssp_lp import {name}")


@pytest.mark.slow
def test_a_room_is_a_name_once_it_is_asked_for_and_nothing_before() -> None:
    code = "import ssp_lp; print('numpy' in sys.modules, ssp_lp.io.__name__, ssp_lp.solve.__name__)"
    assert run(code).split() == ["False", "ssp_lp.io", "solve"]
    later = "scipy.linalg", "scipy.sparse.csgraph", "highspy", "numba"  # until they are needed
    code = f"""
import scipy.sparse  # which older versions follow with linear algebra and graph searches
later = set({later}) - sys.modules.keys()
from ssp_lp import MCMP, SSP, solve
print(later & sys.modules.keys())
"""
    assert run(code).split() == ["set()"]
    code = "import ssp_lp.answers, ssp_lp.solving; from ssp_lp import solve; print(callable(solve))"
    assert run(code).split() == ["True"]


def test_another_package_called_formulations_does_not_matter(tmp_path: Path) -> None:
    (tmp_path / "formulations").mkdir()
    (tmp_path / "formulations" / "__init__.py").write_text("THEIRS = 1\n", encoding="utf-8")
    code = "import formulations; from ssp_lp import MCMP; print(formulations.THEIRS, MCMP.__name__)"
    assert run(code, tmp_path).split() == ["1", "MCMP"]
