"""The toy texts: few lines each, and a simulated failure that agrees with the certified one."""

import inspect

import pytest

from examples.formulating.toy_texts import TASKS
from ssp_lp import certify


@pytest.mark.parametrize("name", sorted(TASKS))
def test_the_certified_failure_is_what_is_played(name):
    solution, report = TASKS[name](100)
    assert certify(solution).accepted
    failure = report.failure_probability
    assert failure.low <= solution.failure_probability <= failure.high
    body = inspect.getsource(TASKS[name]).split('"""')[-1].strip().splitlines()
    assert len(body) <= 8
