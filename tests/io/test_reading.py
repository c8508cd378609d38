"""The one door by which models of every format come in and go out: the optimum survives."""

from functools import cache

import pytest

from cases import FOLDER, published
from checks import optima
from formulations import MaxProb
from random_models import drawn_model
from refusing import refused
from small_models import ALONE, AWKWARD, FIRST, model_of
from ssp_lp import solve
from ssp_lp.io import from_stormpy, read_any, write_any
from storm_values import in_storm

PUBLISHED = ["gubs_river-alt1", "gubs_river4x4", "prism_robot_goal1", "qcomp_cdrive.3"]
PUBLISHED += ["qcomp_elevators.a-3-3", "qcomp_triangle-tireworld.9", "storm_compromise_x1"]
MODELS = {"first": (FIRST, "depot"), "awkward": (AWKWARD, ("s", 1)), "alone": (ALONE, "g")}
CELLS = {(0, True): {"on": [(0.75, (1, False), 2.0), (0.25, (2, True), 2.0)]}, (2, True): {}}
MODELS["cells"] = model_of(CELLS, (1, False)), (0, True)
MODELS |= {f"drawn {seed}": (drawn_model(seed, 12)[0], "s0") for seed in (0, 2)}
MODELS |= {name: published(name) for name in PUBLISHED}
ENDINGS = ["json", "drn", "npz", "umb"]
SAYS_ITSELF = ("npz", "json", "json.gz")


@cache
def kept(name):
    """A budget, and the optima within it."""
    model, start = MODELS[name]
    budget = 1.0 - 0.8 * solve(MaxProb(model, start)).objective
    return budget, pytest.approx(optima(model, start, budget), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "way"),
    [(name, way) for name in MODELS for way in ENDINGS]
    + [(name, f"{way}.gz") for name in ("first", "awkward") for way in ("json", "drn")]
    + [("first", "drn.xz")]
    + [(name, way) for name in ("first", "awkward", "alone") for way in ("storm.umb", "storm.drn")],
)
def test_whatever_is_written_is_read_again(name, way, tmp_path):
    model, start = MODELS[name]
    path = tmp_path / f"m.{way}"
    write_any(model, path, {start: 1.0} if way == "drn" else start)
    assert path.exists()
    if way.startswith("storm"):
        found = from_stormpy(in_storm(path), goal="goal", cost="cost")
    else:
        found = read_any(path, [] if way in SAYS_ITSELF else ["goal"])
    begin = start if way == "npz" else found.start
    budget, known = kept(name)
    assert optima(found.model, begin, budget) == known
    assert set(found.model.state_labels) - {"paying"} == set(model.state_labels)


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_model_is_read_as_stated(name):
    found = read_any(FOLDER / "models" / f"{name}.json.gz", [], "unit")
    budget, known = kept(name)
    assert optima(found.model, found.start, budget) == known


def test_what_a_format_does_not_have_is_refused(tmp_path):
    write_any(ALONE, tmp_path / "m.npz")
    write_any(ALONE, tmp_path / "m.drn", "g")
    words = r"m\.drn has no constants: leave constants out"
    refused(words, read_any, tmp_path / "m.drn", ["goal"], constants="N=3")
    refused(r"say in which state m\.umb begins", write_any, ALONE, tmp_path / "m.umb")
    refused(r"'m\.txt' ends in none of .*\.umb", write_any, ALONE, tmp_path / "m.txt", "g")
    drawn = {("s", 1): 0.5, "t": 0.5}
    refused("begin in one state", write_any, AWKWARD, tmp_path / "m.drn", drawn)
    program = "dtmc\nconst int N;\nmodule m\n s : [0..N];\n [] s<N -> (s'=s+1);\nendmodule\n"
    (tmp_path / "m.pm").write_text(program, encoding="utf-8")
    found = read_any(tmp_path / "m.pm", ["s=N"], constants="N=3")
    assert (found.start, found.model.n_states) == ((0,), 4)
