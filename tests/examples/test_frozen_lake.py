"""The frozen lake: certified with the step limit, and misled without it."""

import re
import runpy
import warnings
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples/formulating/frozen_lake.py"


def test_the_example_tells_both_horizons(capsys):
    pytest.importorskip("gymnasium")
    with warnings.catch_warnings():
        runpy.run_path(str(EXAMPLE))
    printed = capsys.readouterr().out
    assert printed.count("certified failure 0.4000") == 2
    with_limit, without = re.findall(r"failure \d\.\d+ \[(\d\.\d+), (\d\.\d+)\]", printed)
    assert float(with_limit[0]) <= 0.4 <= float(with_limit[1])
    assert float(without[0]) > 0.4
