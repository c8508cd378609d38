"""Lower bounds in the VIPR format: read again and derived in fractions; by viprchk where it is."""

from __future__ import annotations

import os
import shutil
import subprocess
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from scipy.optimize import linprog

from formulations import MCMP, S3P, AlphaMCMP, CostBoundedReach, MaxProb, MinCost
from mazes import MAZE
from refusing import refused
from small_models import FIRST
from ssp_lp import end_probability, solve, to_vipr, write_certificate

PROBLEMS = {
    "budget": MCMP(FIRST, "depot", 0.05),
    "least failure": MCMP(MAZE, "start"),
    "limit": MCMP(MAZE, "start", 0.1, constraints={"wreck": end_probability("dead_end") <= 0.07}),
    "share": AlphaMCMP(MAZE, "start", 0.93),
    "given the goal": S3P(FIRST, "depot", 0.05),
    "in time": CostBoundedReach(MAZE, "start", 4.5, 0.2),
    "most": MaxProb(MAZE, "start"),
    "sure": MinCost(MAZE, "start"),
    "horizon": MCMP(MAZE, "start", 0.2, horizon=3),
}
CHECKER = shutil.which(os.environ.get("VIPRCHK", "viprchk"))


class Words:
    """The words of a file, one after the other."""

    def __init__(self, path: Path) -> None:
        self.words = iter(path.read_text(encoding="ascii").split())

    def take(self, *expected: str) -> str:
        word = next(self.words)
        assert not expected or word in expected, word
        return word

    def number(self) -> Fraction:
        return Fraction(self.take())

    def combination(self) -> dict[int, Fraction]:
        """Terms of a sum, none of which is 0 or comes twice."""
        count = int(self.take())
        terms = {int(self.take()): self.number() for _ in range(count)}
        assert len(terms) == count
        assert all(terms.values())
        return terms


def derived(path: Path) -> tuple[Fraction, Fraction, float]:
    """The bound that a file says it derives, that its combination gives, and the optimum."""
    file = Words(path)
    assert (file.take("VER"), file.take("1.1"), file.take("VAR")) == ("VER", "1.1", "VAR")
    size = int(file.take())
    assert [file.take() for _ in range(size)] == [f"x{j}" for j in range(size)]
    assert (file.take("INT"), file.take("0"), file.take("OBJ")) == ("INT", "0", "OBJ")
    file.take("min")
    objective = file.combination()
    file.take("CON")
    count, bounds = int(file.take()), int(file.take())
    assert bounds == size
    rows = []
    for _ in range(count):
        file.take()
        rows.append((file.take("G", "L", "E"), file.number(), file.combination()))
    for j, row in enumerate(rows[:size]):
        assert row == ("G", 0, {j: 1})
    assert (file.take("RTP"), file.take("range")) == ("RTP", "range")
    claimed = file.number()
    for word in ("inf", "SOL", "0", "DER", "1"):
        file.take(word)
    file.take()
    assert (file.take("G"), file.number(), file.take("OBJ")) == ("G", claimed, "OBJ")
    file.take("{"), file.take("lin")
    total, right = dict.fromkeys(range(size), Fraction(0)), Fraction(0)
    for k, weight in file.combination().items():
        side, bound, entries = rows[k]
        assert side == "E" or (weight >= 0) == (side == "G")
        right += weight * bound
        for j, a in entries.items():
            total[j] += weight * a
    assert (file.take("}"), file.take("-1")) == ("}", "-1")
    assert next(file.words, None) is None
    assert {j: a for j, a in total.items() if a} == objective
    return claimed, right, optimum(objective, rows[size:], size)


def optimum(objective: dict[int, Fraction], rows: list[Any], size: int) -> float:
    """Minimise over x >= 0, in double precision."""

    def dense(entries: dict[int, Fraction]) -> list[float]:
        return [float(entries.get(j, 0)) for j in range(size)]

    equal, upper = ([row for row in rows if row[0] == side] for side in "EL")
    found = linprog(
        dense(objective), [dense(row[2]) for row in upper], [float(row[1]) for row in upper],
        [dense(row[2]) for row in equal], [float(row[1]) for row in equal],
    )  # fmt: skip
    return float(found.fun)


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_bound_is_a_combination_of_constraints(name, tmp_path):
    """Of a ratio r the bound is that of N + r F, which is at least r, and next to it.

    The program is that of the problem: a solver finds the same optimum.
    """
    solution = solve(PROBLEMS[name])
    bound = to_vipr(solution, tmp_path / "x.vipr")
    *both, least = derived(tmp_path / "x.vipr")
    assert both == [bound, bound]
    assert least == pytest.approx(float(bound), rel=1e-9)
    sign = -1.0 if name in ("in time", "most") else 1.0
    assert least == pytest.approx(sign * solution.objective, rel=1e-7)
    checked = write_certificate(solution, tmp_path / "x.cert")
    lower = -checked.upper if name in ("in time", "most") else checked.lower
    assert 0 <= bound - lower < Fraction(1, 10**20)


def test_what_no_file_covers_has_no_bound_in_one(tmp_path):
    solution = solve(PROBLEMS["budget"], "deterministic")
    refused("a certificate file cannot be written for MCMP", to_vipr, solution, tmp_path / "x")
    assert not (tmp_path / "x").exists()


@pytest.mark.skipif(CHECKER is None, reason="viprchk is not on the path, nor named by VIPRCHK")
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_published_checker_verifies_it(name, tmp_path):
    to_vipr(solve(PROBLEMS[name]), tmp_path / "x.vipr")
    run = [CHECKER, str(tmp_path / "x.vipr")]
    done = subprocess.run(run, capture_output=True, text=True)  # noqa: S603
    assert done.returncode == 0
    assert "Successfully verified" in done.stdout
