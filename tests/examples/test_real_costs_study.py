"""The study of costs without a unit says what it found, and what is left."""

from examples.formulating.real_costs import LAWS, LEVELS, main


def test_every_law_of_costs_and_every_number_of_levels_has_its_line(capsys):
    main(["--sizes", "4", "--time-limit", "2"])
    laws, levels = capsys.readouterr().out.strip().split("\n\n")
    assert [line[:17].strip().split(maxsplit=1)[1] for line in laws.splitlines()[2:]] == list(LAWS)
    rows = [line.split() for line in levels.splitlines()[2:]]
    assert [int(row[0].replace(",", "")) for row in rows] == list(LEVELS)
    assert all(float(lower) <= float(upper) for _, lower, upper, *_ in rows)
