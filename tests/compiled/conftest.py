"""Compiled loops switched on and off."""

from __future__ import annotations

import pytest

from ssp_lp.compiled import accelerator
from tests.support.compiled import Switch


@pytest.fixture
def accelerate(monkeypatch: pytest.MonkeyPatch) -> Switch:
    """Run every loop compiled, or none."""

    def switch(on: bool) -> None:
        monkeypatch.setattr(accelerator, "has_accelerator", lambda: on)
        monkeypatch.setattr(accelerator, "least_entries", lambda: 0)

    return switch
