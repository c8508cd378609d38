"""Certified reference values: known values lie in the intervals, and the files prove them."""

import csv
import math
from fractions import Fraction

from examples.reference_values import certified_values
from ssp_lp import check_certificate
from ssp_lp.verification import certificate_lines


def test_known_values_lie_in_proved_intervals(tmp_path):
    arguments = ["--models", "prism_robot_goal1", "--budgets", "least", "0.1", "0.5"]
    rows = certified_values.main([*arguments, "--output", str(tmp_path)])
    with (tmp_path / "values.csv").open(newline="") as file:
        assert [row["criterion"] for row in csv.DictReader(file)] == [r.criterion for r in rows]
    # half of all runs reach the goal, after 19/6 and 16/3 - 5/3 steps (tests/data/expected.json)
    known = {"MCMP": Fraction(19, 6), "S3P": Fraction(11, 3), "CVaR-0.9": Fraction(91, 15)}
    for row in rows:
        if row.budget == "0.1":
            assert row.note.startswith("infeasible: every policy fails with probability at least")
            continue
        lower, upper = Fraction(row.lower), Fraction(row.upper)
        assert lower <= known[row.criterion] <= upper
        assert upper - lower < Fraction(1, 10**10)
        if row.criterion.startswith("CVaR"):
            assert tail_mean_of(tmp_path / row.certificate, Fraction(1, 10)) == (lower, upper)
        else:
            assert certificate_lines.main(str(tmp_path / row.certificate), row.sha256) == 0
    assert sum(bool(row.certificate) for row in rows) == 6


def tail_mean_of(folder, tail):
    """The proved interval of a tail mean, in steps of 1, from the files of a folder alone."""
    files = {Fraction(path.stem): check_certificate(path) for path in folder.iterdir()}
    proved = {z: [z + side / tail for side in (f.lower, f.upper)] for z, f in files.items()}
    upper = min(sides[1] for sides in proved.values())
    bounds = [
        max(n, *(low - max(z - n, (n - z) * (1 - tail) / tail) for z, (low, _) in proved.items()))
        for n in range(math.floor(upper) + 2)
    ]
    return rounded(min(bounds), -math.inf), rounded(upper, math.inf)


def rounded(value, outwards):
    """The nearest float, or the next one outwards."""
    near = float(value)
    is_inside = near > value if outwards < 0.0 else near < value
    return Fraction(repr(math.nextafter(near, outwards) if is_inside else near))


def test_turning_points_prove_a_frontier(tmp_path):
    """Half of the runs fail at least, with 11/3 steps; nine tenths may fail after two steps."""
    arguments = ["--models", "prism_robot_goal1", "gubs_tireworld1", "--budgets", "turning"]
    rows = certified_values.main([*arguments, "--output", str(tmp_path)])
    found = {(row.model, row.criterion, row.budget): row for row in rows}
    assert all(row.certificate for row in rows)
    for key, value in {
        ("prism_robot_goal1", "S3P", "0.9"): 2, ("gubs_tireworld1", "S3P", "0.0"): Fraction(11, 2),
        ("gubs_tireworld1", "MCMP", "0.5"): Fraction(3, 2), ("gubs_tireworld1", "MCMP", "1.0"): 0,
    }.items():  # fmt: skip
        assert Fraction(found[key].lower) <= value <= Fraction(found[key].upper)


def test_a_file_of_ones_own_is_answered(tmp_path):
    (tmp_path / "road.json").write_text(
        '{"start": "a", "goal": ["b"], "dead_ends": ["lost"], "transitions": {"a": {'
        '"road": [[0.9, "b", 1], [0.1, "lost", 1]], "path": [[1, "b", 3]]}}}'
    )
    options = ["--file", str(tmp_path / "road.json"), "--budgets", "0.05"]
    rows = certified_values.main([*options, "--output", str(tmp_path)])
    cheapest, given_success, _ = rows
    # half of the runs take the road; all pay what they walk
    assert (cheapest.lower, cheapest.upper) == ("2.0", "2.0")
    assert Fraction(given_success.lower) <= Fraction(39, 19) <= Fraction(given_success.upper)
