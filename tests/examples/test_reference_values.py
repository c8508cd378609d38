"""Certified reference values: known values lie in the intervals, and the files prove them."""

import csv
from fractions import Fraction

from examples.reference_values import certified_values
from ssp_lp.verification import certificate_lines


def test_known_values_lie_in_proved_intervals(tmp_path):
    arguments = ["--models", "prism_robot_goal1", "--budgets", "least", "0.1", "0.5"]
    rows = certified_values.main([*arguments, "--output", str(tmp_path)])
    with (tmp_path / "values.csv").open(newline="") as file:
        assert [row["criterion"] for row in csv.DictReader(file)] == [r.criterion for r in rows]
    # half of all runs reach the goal, after 19/6 and 16/3 - 5/3 steps (tests/data/expected.json)
    known = {"MCMP": Fraction(19, 6), "S3P": Fraction(11, 3)}
    for row in rows:
        if row.budget == "0.1":
            assert row.note.startswith("infeasible: every policy fails with probability at least")
        elif row.criterion in known:
            lower, upper = Fraction(row.lower), Fraction(row.upper)
            assert lower <= known[row.criterion] <= upper
            assert upper - lower < Fraction(1, 10**11)
            with_file = str(tmp_path / row.certificate)
            assert certificate_lines.main(with_file, row.sha256) == 0
        else:
            assert row.note == "no file: proved in memory"
    assert sum(bool(row.certificate) for row in rows) == 4


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
