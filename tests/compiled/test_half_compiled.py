"""An exception from outside that ends numba's compiler leaves a process that goes on in numpy."""

import numpy as np
import pytest

from formulations import MCMP
from small_models import FIRST
from ssp_lp import solve
from ssp_lp.compiled import accelerator

numba = pytest.importorskip("numba")
codegen = pytest.importorskip("numba.core.codegen")


class AlarmError(Exception):
    """Such as pytest-timeout raises from the handler of a signal."""


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Every loop is worth compiling, and nothing has been given up."""
    monkeypatch.setenv(accelerator.SWITCH, "numba")
    monkeypatch.setattr(accelerator._loops, "is_given_up", False)
    assert accelerator.accelerated(1, "backups.back_up")


def loops():
    """A loop that calls another one, neither of them compiled yet."""
    inner = numba.njit(lambda number: number + 1.0)
    return numba.njit(lambda numbers: inner(numbers[0]))


@pytest.mark.parametrize("error", [AlarmError, KeyboardInterrupt])
@pytest.mark.parametrize("stage", ["finalize", "add_ir_module"])
def test_after_an_alarm_in_the_compiler_loops_run_in_numpy(monkeypatch, stage, error):
    def ring(*_):
        monkeypatch.delattr(codegen.CPUCodeLibrary, stage)
        raise error

    monkeypatch.setattr(codegen.CPUCodeLibrary, stage, ring)
    with pytest.raises(error):
        loops()(np.zeros(1))
    assert not accelerator.has_accelerator()
    assert not accelerator.accelerated(10**9, "backups.back_up")
    assert solve(MCMP(FIRST, "depot", failure_budget=0.05)).objective == pytest.approx(20 / 3)


def test_a_loop_compiled_while_an_error_is_handled_is_no_half_compiled_one():
    try:
        raise AlarmError
    except AlarmError:
        assert loops()(np.zeros(1)) == 1.0
    assert accelerator.accelerated(1, "backups.back_up")


def test_an_alarm_while_numba_is_loaded_leaves_numpy(monkeypatch):
    def ring(name):
        raise AlarmError(name)

    accelerator._load.cache_clear()
    with monkeypatch.context() as interrupted:
        interrupted.setattr(accelerator.importlib, "import_module", ring)
        with pytest.raises(AlarmError):
            accelerator.has_accelerator()
    assert not accelerator.has_accelerator()
