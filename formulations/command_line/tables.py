"""Answers for other programs, and tables for people."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def as_json(answer: Any) -> list[str]:
    """The lines of an answer in JSON; what is no finite number is null."""
    return [json.dumps(_finite(answer), indent=2, ensure_ascii=False)]


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def aligned(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Rows under their headings, each column as wide as what it holds."""
    table = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(map(str.rjust, cells, widths)) for cells in table]
