"""Which of its two versions a compiled loop runs in: on one core, or on all that are idle."""

import os

import pytest

numba = pytest.importorskip("numba")

from ssp_lp.compiled import cores  # noqa: E402 (it needs numba)
from ssp_lp.compiled.accelerator import SWITCH  # noqa: E402


@pytest.mark.parametrize(
    ("load", "others"), [(0.0, True), (0.9, True), (1.1, False), (50.0, False)]
)
def test_all_cores_are_woken_where_some_are_idle(load, others, monkeypatch):
    """Long loops alone, unless they are to be compiled; where no load is known, all."""

    def nothing(count):
        for _ in numba.prange(count):
            pass

    monkeypatch.setenv(SWITCH, "numba")
    loop = cores.one_or_all_cores(nothing)
    monkeypatch.setattr(os, "getloadavg", lambda: (os.cpu_count() + load, 0.0, 0.0), raising=False)
    many = cores.many_entries.get()
    single = loop(many - 1)
    with cores.on_all_cores():
        everywhere = loop(1)
    assert single is not everywhere
    assert loop(many) is (everywhere if others else single)
    monkeypatch.delattr(os, "getloadavg")
    assert loop(many) is everywhere
