"""Faults planted by hand, each in a scratch copy of the tree: some test of its room must fail.

Each fault once survived the suite. Run from the repository's root::

    python tests/campaigns/planted_faults.py                 # all of them
    python tests/campaigns/planted_faults.py --seed 3 --count 4   # four, drawn by the seed
    python tests/campaigns/planted_faults.py --only timed
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 240.0
"""Seconds that the tests of a room may take; an endless loop counts as noticed."""


@dataclass(frozen=True)
class Fault:
    """A piece of the source, what is planted in its place, and the tests that should notice."""

    name: str
    path: str
    right: str  # stands once in the file
    wrong: str
    tests: str  # arguments of pytest


GAME = "tests/game tests/theorems/test_game_theorems.py"
FAULTS = (
    Fault(
        "threshold: what is owed is multiplied by the budget",
        "ssp_lp/game/optimum.py",
        "owed = played.game.failure_term(played.alpha, played.origin)",
        "owed = played.game.budget * played.game.failure_term(played.alpha, played.origin)",
        GAME,
    ),
    Fault(
        "threshold: a game's value proves nothing of rounding",
        "ssp_lp/game/optimum.py",
        "return (played.least - owed - rounding) / played.alpha",
        "return (played.least - owed + rounding) / played.alpha",
        GAME,
    ),
    Fault(
        "player: the bound beyond the horizon has not faded",
        "ssp_lp/game/player.py",
        "lowest = self._beyond(totals, weights * [1.0, gamma**horizon])",
        "lowest = self._beyond(totals, weights)",
        GAME,
    ),
    Fault(
        "player: the bound beyond the cap has not faded",
        "ssp_lp/game/player.py",
        "lowest = np.hstack([below, now[1] + self._surplus(every[cap:], now).T])",
        "lowest = np.hstack([below, weights[1] + self._surplus(every[cap:], weights).T])",
        GAME,
    ),
    Fault(
        "player: the surplus beyond the horizon has not faded",
        "ssp_lp/game/player.py",
        "lowest = self._surplus(totals.with_beyond, weights * [1.0, gamma**horizon]).T",
        "lowest = self._surplus(totals.with_beyond, weights).T",
        GAME,
    ),
    Fault(
        "player: success beyond the cap is only bounded by 1",
        "ssp_lp/game/player.py",
        "greatest_goal=1.0 - safest.values,",
        "greatest_goal=np.ones(base.n_nodes),",
        GAME,
    ),
    Fault(
        "dual bound: its sum at the start is not rounded down",
        "ssp_lp/dynamic_programming/dual_bound.py",
        "return total - lost * float(np.finfo(np.float64).eps)",
        "return total",
        "tests/dynamic_programming",
    ),
    Fault(
        "rows: Lagrange's bound is not rounded down",
        "ssp_lp/methods/rows.py",
        "return least - paid - (len(prices) + 1.0) * MACHINE_EPSILON * float(prices @ np.abs(bounds))",  # noqa: E501
        "return least - paid",
        "tests/methods/test_numerics.py",
    ),
    Fault(
        "frontier: proofs are kept by their price alone",
        "ssp_lp/methods/frontier.py",
        "if (price, slack) not in self.proofs:",
        "slack = any(p == price for p, _ in self.proofs) or slack\n"
        "        if (price, slack) not in self.proofs and (price, not slack) in self.proofs:\n"
        "            return self.proofs[price, not slack]\n"
        "        if (price, slack) not in self.proofs:",
        "tests/methods/test_frontier.py",
    ),
    Fault(
        "models in JSON: labels are not written",
        "ssp_lp/io/model_files/json_model.py",
        '"labels": {word: [names[k] for k in at] for word, at in model.state_labels.items()},',
        '"labels": {},',
        "tests/io/model_files",
    ),
    Fault(
        "archives of policies: rounds_up is not written",
        "ssp_lp/io/archives.py",
        "if isinstance(value, SSP):\n                self._models[id(value)] = value",
        'if part.name == "rounds_up":\n                continue\n'
        "            if isinstance(value, SSP):\n                self._models[id(value)] = value",
        "tests/formulations/test_real_costs.py",
    ),
    Fault(
        "controller: rounds_up is not written",
        "ssp_lp/io/controller_file.py",
        '"rounds_up": bool(policy.rounds_up),',
        '"rounds_up": False,',
        "tests/formulations/test_real_costs.py",
    ),
    Fault(
        "controller: a last step off the lattice is refused",
        "ssp_lp/io/controller.py",
        'if not memory["acting"][successor] or number >= memory["cap"]:',
        'if number >= memory["cap"]:',
        "tests/io/test_controller.py",
    ),
    Fault(
        "controller: half-way between two levels the upper one is taken",
        "ssp_lp/io/controller.py",
        "is_below_nearer = total - levels[above - 1] <= levels[above] - total",
        "is_below_nearer = total - levels[above - 1] < levels[above] - total",
        "tests/io/test_controller.py",
    ),
    Fault(
        "policy: half-way between two levels the upper one is taken",
        "ssp_lp/policies/cost_aware.py",
        "is_below = totals - levels[above - 1] <= levels[above] - totals",
        "is_below = totals - levels[above - 1] < levels[above] - totals",
        "tests/io/test_controller.py",
    ),
    Fault(
        "controller: at its threshold the first tail is still followed",
        "ssp_lp/io/controller.py",
        "return cap if threshold is None or reached < threshold else",
        "return cap if threshold is None or reached <= threshold else",
        "tests/io/test_controller.py",
    ),
    Fault(
        "policy: at its threshold the first tail is still followed",
        "ssp_lp/policies/cost_aware.py",
        "layer, is_late = _nearest_cost_level(self.levels, total), total >= threshold",
        "layer, is_late = _nearest_cost_level(self.levels, total), total > threshold",
        "tests/io/test_controller.py",
    ),
    Fault(
        "pricing by layers: part of a sweep is followed at the full price",
        "ssp_lp/column_generation/compiled_layers.py",
        "begun = self._process_from(layer)",
        "begun = self.process",
        "tests/column_generation/test_layered_pricing.py",
    ),
    Fault(
        "timed policies: stages go round in a circle",
        "ssp_lp/policies/remembering.py",
        "return self.joined(moved, np.minimum(stage + 1, len(self.stages) - 1))",
        "return self.joined(moved, (stage + 1) % len(self.stages))",
        "tests/policies/test_policies.py",
    ),
)


def planted(text: str, fault: Fault) -> str:
    """The text of a file with a fault in it.

    Raises:
        ValueError: what the fault replaces does not stand in it once.
    """
    if text.count(fault.right) != 1:
        raise ValueError(f"{fault.path} holds {text.count(fault.right)} times: {fault.right}")
    return text.replace(fault.right, fault.wrong)


def scratch_copy(folder: Path) -> None:
    """Copy the files of the working tree that git knows or does not ignore into a folder."""
    listed = subprocess.run(
        ["git", "ls-files", "-coz", "--exclude-standard"],  # noqa: S607
        cwd=ROOT, capture_output=True, check=True,
    ).stdout.decode()  # fmt: skip
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name)


def environment(folder: Path) -> dict[str, str]:
    """The environment in which the tests of a copy import that copy, without compiled loops."""
    return {**os.environ, "PYTHONPATH": str(folder), "SSP_LP_ACCELERATOR": "none"}


def outcome(folder: Path, tests: str, limit: float) -> str:
    """What the tests of a copy say: "survived", "killed" by the first that fails, "timed out"."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests.split()]
    try:
        ran = subprocess.run(  # noqa: S603
            command, cwd=folder, env=environment(folder), capture_output=True, timeout=limit,
            text=True, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "timed out"
    if ran.returncode == 0:
        return "survived"
    if ran.returncode != 1:
        return f"no tests ran: {ran.stdout[-300:]}"
    failed = [line for line in ran.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return f"killed by {failed[0].split(' ')[1] if failed else '?'}"


def tried(folder: Path, faults: Iterable[Fault], limit: float = LIMIT) -> dict[str, str]:
    """Plant faults in a copy one after the other, and what the tests of their rooms say."""
    said = {}
    for fault in faults:
        path = folder / fault.path
        right, begun = path.read_text(encoding="utf-8"), time.monotonic()
        path.write_text(planted(right, fault), encoding="utf-8")
        try:
            said[fault.name] = outcome(folder, fault.tests, limit)
        finally:
            path.write_text(right, encoding="utf-8")
        print(f"{time.monotonic() - begun:5.0f} s  {fault.name}: {said[fault.name]}", flush=True)
    return said


def main(arguments: list[str] | None = None) -> int:
    """Plant the faults that are asked for; 1 if one of them survived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=len(FAULTS), help="how many, drawn by --seed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="those whose name holds this")
    asked = parser.parse_args(arguments)
    faults = [fault for fault in FAULTS if asked.only in fault.name]
    chosen = random.Random(asked.seed).sample(faults, min(asked.count, len(faults)))
    with TemporaryDirectory() as name:
        scratch_copy(Path(name))
        said = tried(Path(name), sorted(chosen, key=FAULTS.index))
    alive = [fault for fault, what in said.items() if not what.startswith(("killed", "timed"))]
    print(f"{len(said) - len(alive)} of {len(said)} noticed; alive: {alive or 'none'}")
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main())
