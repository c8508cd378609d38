"""Models as programs, in PRISM's language and in JANI, read back by Storm."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from formulations import MCMP, MaxProb
from ssp_lp import SSP, ModelError, end_probability, solve
from ssp_lp.io import write_jani, write_prism_program
from ssp_lp.io.any_format import read_any, write_any

AWKWARD = {
    "depot": {
        "al ley": [(0.90, "home", {"time": 4, "fuel": 1}), (0.10, "wreck", {"time": 2, "fuel": 1})],
        "al-ley": [(1.00, "woods", {"time": 1, "fuel": 0})],
        "mdp": [
            (0.99, "home", {"time": 9, "fuel": 0.5}),
            (0.01, "wreck", {"time": 5, "fuel": 0.25}),
        ],
        "7": [(1 / 3, "home", {"time": 1, "fuel": 9}), (2 / 3, "depot", {"time": 1, "fuel": 9})],
    },
}


@pytest.mark.parametrize("ending", [".prism", ".jani"])
def test_storm_reads_the_same_model(ending: str, tmp_path: Path) -> None:
    pytest.importorskip("stormpy")
    model = SSP.from_transitions(
        AWKWARD, {"home"}, cost="time", state_labels={"crash": ["wreck"], "none": []},
        treat_actionless_as_dead_ends=True,
    )  # fmt: skip
    write_any(model, tmp_path / f"m{ending}", "depot")
    for cost in ("time", "fuel"):
        read = read_any(tmp_path / f"m{ending}", ["goal"], cost)
        limits = {"crash": end_probability("crash") <= 0.004}
        again = solve(MCMP(read.model, read.start, 0.05, constraints=limits))
        wanted = solve(MCMP(model.with_cost(cost), "depot", 0.05, constraints=limits))
        assert again.objective == pytest.approx(wanted.objective, rel=1e-12)
        assert again.secondary_costs["crash"] == pytest.approx(wanted.secondary_costs["crash"])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("ending", [".prism", ".jani"])
def test_drawn_models_keep_their_optima(ending: str, seed: int, tmp_path: Path) -> None:
    pytest.importorskip("stormpy")
    generator = np.random.default_rng(seed)
    table = {
        k: {
            a: [
                (p, int(to), int(cost))
                for p, to, cost in zip(
                    generator.multinomial(8, [0.25] * 4) / 8,
                    generator.integers(0, 8, 4),
                    generator.integers(0, 4, 4),
                    strict=True,
                )
                if p
            ]
            for a in range(3)
        }
        for k in range(6)
    }
    model = SSP.from_transitions(table, {7}, treat_actionless_as_dead_ends=True)
    write_any(model, tmp_path / f"m{ending}", 0)
    read = read_any(tmp_path / f"m{ending}", ["goal"])
    most = [solve(MaxProb(m, s)).objective for m, s in ((model, 0), (read.model, read.start))]
    assert most[0] == pytest.approx(most[1], rel=1e-12)
    budget = 1.0 - 0.9 * most[0]
    costs = [
        solve(MCMP(m, s, budget, give_up="dead_ends")).objective
        for m, s in ((model, 0), (read.model, read.start))
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


def test_labels_of_many_states(tmp_path: Path) -> None:
    table = {k: {"on": [(1.0, k + 1, 1.0)]} for k in range(3_000)}
    model = SSP.from_transitions(table, {3_000}, state_labels={"odd": range(1, 3_000, 2)})
    write_prism_program(model, tmp_path / "m.prism", start=0)
    text = (tmp_path / "m.prism").read_text(encoding="utf-8")
    assert text.count("s=") >= 1_500
    write_jani(model, tmp_path / "m.jani.gz", start=0)
    write_jani(model, tmp_path / "m.jani", start=0)
    document = json.loads((tmp_path / "m.jani").read_text(encoding="utf-8"))
    assert len(document["automata"][0]["edges"]) == 3_001


def test_what_is_no_word_of_prisms(tmp_path: Path) -> None:
    for name in ("a b", "max", "1st"):
        model = SSP.from_transitions({0: {"on": [(1.0, 1, 1.0)]}}, {1}, state_labels={name: [0]})
        with pytest.raises(ModelError, match="no word of PRISM's"):
            write_prism_program(model, tmp_path / "m.prism", start=0)
