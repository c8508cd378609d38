"""The example that puts the paper's robot by three methods, on a coarse grid."""

import re

from examples.paper_walkthrough import cross_check


def test_the_example_says_that_the_methods_agree(capsys):
    cross_check.main(["--segments", "5", "--headings", "5", "--budget", "0.9"])
    printed = capsys.readouterr().out
    assert printed.count("3 methods agree") == 2
    pairs = re.findall(r"alpha\* = ([\d.]+), from c\* and the price ([\d.]+)", printed)
    assert len(pairs) == 2
    for weight, identity in pairs:
        assert abs(float(weight) - float(identity)) <= 1e-9
