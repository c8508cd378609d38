"""Mutants of a package of the core, drawn by cosmic-ray, against the tests of its room.

Run from the repository's root, with cosmic-ray installed or named; a scratch copy is mutated::

    pip install cosmic-ray
    python tests/campaigns/mutation.py --packages game policies --count 60 --seed 0

Of all mutants of a package so many are drawn by the seed. Left out are those of annotations, which
nothing runs, and of an operator by one that numbers or values do not have (bits, shifts, identity,
powers, remainders): any test that comes there kills them. Loops run as numpy expressions
(SSP_LP_ACCELERATOR=none), and ``ssp_lp/compiled`` is no package here: its twins are compared with
them by ``tests/compiled``. Prints a table, and the
change of each survivor.
"""

from __future__ import annotations

import argparse
import ast
import json
import random
import re
import shlex
import sqlite3
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from tests.campaigns.planted_faults import environment, scratch_copy

LIMIT = 600
"""Seconds of a processor that the tests of one mutant may take, thrice what they take without."""

BREAKING = re.compile(
    r"_(Add|Sub|Mult?|Div|Mod|FloorDiv|Pow)_(Bit\w+|\wShift|Mod|FloorDiv|Pow)$|_Is(Not)?$"
)
"""Operators of cosmic-ray whose mutants any test that comes there kills."""

ROOMS = {
    "accumulated_cost": "cost_law drawn_laws policy_layers cost_levels programs "
    "-k 'not grids and not CVaR and not cannot_grow'",
    "column_generation": "layered_pricing structures steep_frontiers rare_goals",
    "dynamic_programming": "equations numerics rows_and_nodes",
    "game": "operators game_theorems game_edge_cases bayes_adaptive "
    "-k 'not robot and not feasible'",
    "methods": "numerics frontier deterministic quantiles incumbents cost_law_criteria rounding "
    "constraints_edges "
    "-k 'not no_search_ends and not gap_that and not within_a_budget "
    "and not utility and not finer and not safest'",
    "policies": "policies episodes drawn_laws controller -k 'not distribution'",
    "processes": "rows_and_nodes semantics goal_reach "
    "-k 'not grid and not racetrack and not exponentially'",
    "verification": "certificate certificate_file",
}
"""The test files of each package, the quickest first, without what takes long and says little."""


def tests_of(package: str, folder: Path) -> str:
    """The command line that runs the tests of a package in a copy of the tree."""
    names, _, chosen = ROOMS[package].partition(" -k ")
    paths = [next((folder / "tests").rglob(f"test_{name}.py")) for name in names.split()]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += [str(path.relative_to(folder)) for path in paths]
    said = shlex.join(command) + (f" -k {chosen}" if chosen else "")
    return shlex.join(["bash", "-c", f"ulimit -t {LIMIT}; {said}; exit $?"])


class Mutant(NamedTuple):
    """A mutant, and what the tests of its room said."""

    path: str
    line: int
    operator: str
    outcome: str  # "killed", "timed out", "survived"
    change: str  # as a diff


def annotated_lines(source: str) -> set[tuple[int, int]]:
    """Lines and columns of annotations, which are words here and never run."""
    places: set[tuple[int, int]] = set()
    for node in ast.walk(ast.parse(source)):
        kept = [getattr(node, name, None) for name in ("annotation", "returns")]
        for part in (part for part in kept if isinstance(part, ast.AST)):
            for inner in ast.walk(part):
                if isinstance(inner, ast.expr):
                    first, last = inner.lineno, inner.end_lineno or inner.lineno
                    end = inner.end_col_offset or 0
                    places |= {(first, column) for column in range(inner.col_offset, end)}
                    places |= {(line, c) for line in range(first + 1, last + 1) for c in range(200)}
    return places


def draw(session: Path, folder: Path, count: int, seed: int) -> int:
    """Keep so many mutants of a session, drawn by the seed; how many there were."""
    with sqlite3.connect(session) as database:
        rows = database.execute(
            "SELECT job_id, module_path, start_pos_row, start_pos_col, operator_name "
            "FROM mutation_specs "
            "ORDER BY module_path, operator_name, occurrence, start_pos_row, start_pos_col"
        ).fetchall()
        notes = {path: annotated_lines((folder / path).read_text()) for _, path, *_ in rows}
        live = [
            job
            for job, path, line, column, operator in rows
            if (line, column) not in notes[path] and not BREAKING.search(operator)
        ]
        kept = set(random.Random(seed).sample(live, min(count, len(live))))
        gone = [(job,) for job, *_ in rows if job not in kept]
        for table in ("mutation_specs", "work_items"):
            database.executemany(f"DELETE FROM {table} WHERE job_id = ?", gone)  # noqa: S608
    return len(live)


def results(session: Path) -> Iterator[Mutant]:
    """The mutants of a session that was run."""
    with sqlite3.connect(session) as database:
        for path, line, operator, said, output, diff in database.execute(
            "SELECT module_path, start_pos_row, operator_name, test_outcome, output, diff "
            "FROM mutation_specs NATURAL JOIN work_results ORDER BY module_path, start_pos_row"
        ):
            late = re.search("CPU time limit|^timeout|Killed", output or "")
            outcome = "survived" if "SURVIVED" in said.upper() else "killed"
            yield Mutant(path, line, operator, "timed out" if late else outcome, diff or "")


def mutate(package: str, count: int, seed: int, tool: str) -> tuple[int, list[Mutant]]:
    """How many mutants a package has, and those drawn, each tried by the tests of its room."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        scratch_copy(folder)
        tests = tests_of(package, folder)
        settings, session = folder / "mutation.toml", folder / "mutation.sqlite"
        settings.write_text(
            f"[cosmic-ray]\nmodule-path = {json.dumps('ssp_lp/' + package)}\n"
            f"timeout = {20.0 * LIMIT}\nexcluded-modules = []\n"
            f"test-command = {json.dumps(tests)}\n"
            '[cosmic-ray.distributor]\nname = "local"\n'
        )
        asked = {"cwd": folder, "env": environment(folder), "check": True}
        subprocess.run([tool, "init", settings.name, session.name], **asked)  # noqa: S603
        total = draw(session, folder, count, seed)
        subprocess.run([tool, "baseline", settings.name], **asked)  # noqa: S603
        subprocess.run([tool, "exec", settings.name, session.name], **asked)  # noqa: S603
        return total, list(results(session))


def main(arguments: list[str] | None = None) -> int:
    """Try the mutants of some packages, and print a table and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packages", nargs="+", choices=ROOMS, default=list(ROOMS))
    parser.add_argument("--count", type=int, default=60, help="of each package")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cosmic-ray", default="cosmic-ray", help="the command")
    asked = parser.parse_args(arguments)
    rows = [
        "| package | mutants | drawn | killed | timed out | survived |",
        "|---|---|---|---|---|---|",
    ]
    for package in asked.packages:
        total, tried = mutate(package, asked.count, asked.seed, asked.cosmic_ray)
        counts = Counter(mutant.outcome for mutant in tried)
        columns = [counts[word] for word in ("killed", "timed out", "survived")]
        numbers = " | ".join(f"{number:,}" for number in (total, len(tried), *columns))
        rows.append(f"| `{package}` | {numbers} |")
        for mutant in tried:
            if mutant.outcome == "survived":
                print(
                    f"{mutant.path}:{mutant.line} {mutant.operator}\n{mutant.change}\n", flush=True
                )
    print("\n".join(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
