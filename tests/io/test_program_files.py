"""Models as programs, in PRISM's language and in JANI, read back by Storm."""

import json

import numpy as np
import pytest

from formulations import MCMP, MaxProb
from refusing import refused
from small_models import model_of
from ssp_lp import SSP, end_probability, solve
from ssp_lp.io import read_any, write_any, write_jani, write_prism_program

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
each_ending = pytest.mark.parametrize("ending", [".prism", ".jani"])


@each_ending
def test_storm_reads_the_same_model(ending, tmp_path):
    pytest.importorskip("stormpy")
    model = SSP.from_transitions(
        AWKWARD, {"home"}, cost="time", state_labels={"crash": ["wreck"], "none": []},
        treat_actionless_as_dead_ends=True,
    )  # fmt: skip
    write_any(model, tmp_path / f"m{ending}", "depot")
    limits = {"crash": end_probability("crash") <= 0.004}
    for cost in ("time", "fuel"):
        read = read_any(tmp_path / f"m{ending}", ["goal"], cost)
        again = solve(MCMP(read.model, read.start, 0.05, constraints=limits))
        known = solve(MCMP(model.with_cost(cost), "depot", 0.05, constraints=limits))
        assert again.objective == pytest.approx(known.objective, rel=1e-12)
        assert again.secondary_costs["crash"] == pytest.approx(known.secondary_costs["crash"])


@pytest.mark.parametrize("seed", range(6))
@each_ending
def test_drawn_models_keep_their_optima(ending, seed, tmp_path):
    pytest.importorskip("stormpy")
    rng = np.random.default_rng(seed)

    def drawn():
        """An action to three of eight states at most; 6 acts no more, and 7 is the goal."""
        chances, ends = rng.multinomial(8, [0.25] * 4) / 8, rng.integers(0, 8, 4).tolist()
        outcomes = zip(chances.tolist(), ends, rng.integers(0, 4, 4).tolist(), strict=True)
        return [outcome for outcome in outcomes if outcome[0]]

    model = model_of({k: {a: drawn() for a in range(3)} for k in range(6)}, 7)
    write_any(model, tmp_path / f"m{ending}", 0)
    read = read_any(tmp_path / f"m{ending}", ["goal"])
    most, found = (solve(MaxProb(*one)).objective for one in ((model, 0), (read.model, read.start)))
    assert found == pytest.approx(most, rel=1e-12)
    cost, found = (
        solve(MCMP(*one, 1.0 - 0.9 * most, give_up="dead_ends")).objective
        for one in ((model, 0), (read.model, read.start))
    )
    assert found == pytest.approx(cost, rel=1e-9)


def test_labels_of_many_states(tmp_path):
    table = {k: {"on": [(1.0, k + 1, 1.0)]} for k in range(3_000)}
    model = SSP.from_transitions(table, {3_000}, state_labels={"odd": range(1, 3_000, 2)})
    write_prism_program(model, tmp_path / "m.prism", start=0)
    assert (tmp_path / "m.prism").read_text(encoding="utf-8").count("s=") >= 1_500
    for name in ("m.jani.gz", "m.jani"):
        write_jani(model, tmp_path / name, start=0)
    document = json.loads((tmp_path / "m.jani").read_text(encoding="utf-8"))
    assert len(document["automata"][0]["edges"]) == 3_001


@pytest.mark.parametrize("name", ["a b", "max", "1st"])
def test_what_is_no_word_of_prisms(name, tmp_path):
    model = model_of({0: {"on": [(1.0, 1, 1.0)]}}, 1, {name: [0]})
    refused("no word of PRISM's", write_prism_program, model, tmp_path / "m.prism", start=0)
