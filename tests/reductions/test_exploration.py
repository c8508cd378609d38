"""Implicit models: the answer is that of the whole model, and what is not known is named."""

from __future__ import annotations

import pytest

from ssp_lp.reductions import exploration
from tests.campaigns.explored_models import compare


@pytest.mark.parametrize("block", range(4))
def test_drawn_models_are_answered_as_when_built_whole(
    block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exploration, "FIRST", 1)
    for seed in range(1000 + 15 * block, 1015 + 15 * block):
        assert "wrong" not in compare(seed)
